"""Run every command that the documentation shows: lines that begin with ``$`` in ``console`` blocks."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path


def commands(text: str) -> list[str]:
    """The commands of one document, in order."""
    found, inside = [], False
    for line in text.splitlines():
        if line.startswith("```"):
            inside = line.strip() == "```console"
        elif inside and line.startswith("$ "):
            found.append(line[2:])
    return found


def main(places: list[str]) -> int:
    """Run them all; the number of failures."""
    files = [f for place in map(Path, places) for f in (sorted(place.rglob("*.md")) if place.is_dir() else [place])]
    failed = count = 0
    for file in files:
        for command in commands(file.read_text(encoding="utf-8")):
            count += 1
            done = subprocess.run(["bash", "-ec", command], capture_output=True, text=True, timeout=300, check=False)
            print(f"{'ok  ' if done.returncode == 0 else 'FAIL'} {file}: {command}")
            if done.returncode:
                failed += 1
                print(done.stdout, done.stderr, sep="\n")
    print(f"{count - failed} passed, {failed} failed")
    return failed or not count


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
