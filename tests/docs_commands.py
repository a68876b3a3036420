"""Run what the documentation shows: lines that begin with ``$`` in ``console`` blocks, and ``python run`` blocks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def runnable(text: str) -> list[list[str]]:
    """The commands of one document, in order, as argument lists."""
    found: list[list[str]] = []
    kind, block = "", []
    for line in text.splitlines():
        if line.startswith("```"):
            if kind == "python run":
                found.append([sys.executable, "-c", "\n".join(block)])
            kind, block = ("" if kind else line[3:].strip() or "text"), []
        elif kind == "console" and line.startswith("$ "):
            found.append(["bash", "-ec", line[2:]])
        else:
            block.append(line)
    return found


def main(places: list[str]) -> int:
    """Run them all; the number of failures."""
    files = [f for place in map(Path, places) for f in (sorted(place.rglob("*.md")) if place.is_dir() else [place])]
    failed = count = 0
    for file in files:
        for command in runnable(file.read_text(encoding="utf-8")):
            count += 1
            done = subprocess.run(command, capture_output=True, text=True, timeout=300, check=False)
            print(f"{'ok  ' if done.returncode == 0 else 'FAIL'} {file}: {command[2].splitlines()[0]}")
            if done.returncode:
                failed += 1
                print(done.stdout, done.stderr, sep="\n")
    print(f"{count - failed} passed, {failed} failed")
    return failed or not count


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
