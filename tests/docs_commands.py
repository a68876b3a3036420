"""Run what the documentation shows, each page in a directory of its own that holds a copy of ``configs``.

What a fence says decides what happens to its block:

- ``console``: each line that begins with ``$`` is run. Where a line after it begins with ``armcal: ``, the command must
  be refused with that message (``...`` stands for anything). ``sh``: the whole block is run as one script.
- ``python``: executed, all of a page's in one namespace, in order.
- any of these or ``yaml``, ``toml``, ``json``, ``csv`` with ``title="NAME"``: written to that file there, and not run.
- ``yaml``, ``json`` and ``toml`` without a title: fragments, which must at least parse (JSON may be one object a line).
- ``py``: a piece of Python that cannot stand alone, such as a signature. ``text``: whatever else must not run.

No other kind is allowed, so that nothing slips by.

A run of shipped configurations that several pages show is made by the first; the others have a copy of its folder.
"""

from __future__ import annotations

import contextlib
import fcntl
import hashlib
import io
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import tomllib
import traceback
from collections.abc import Iterator
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import yaml

ROOT = Path(__file__).resolve().parents[1]
RUN = ("console", "sh", "python")
FRAGMENTS = ("yaml", "json", "toml")
KINDS = (*RUN, *FRAGMENTS, "csv", "py", "text")
DONE_BY_TESTS = {
    "new_robot.md": "tests/framework/test_new_robot.py",
    "write_a_plugin.md": "tests/framework/test_new_plugin.py",
}
"""Pages that a test does word for word, so that doing them here again would only take time."""
AT_ONCE = 3
"""Pages wait, for processes that come and go and for time to pass: two processors are not busy with two."""
KEPT = "ARMCAL_DOCS_KEPT"
"""Names the folder of runs that were made."""
FORK = get_context("fork")
LONGEST_S = 300
_FENCE = re.compile(r"^(?P<indent> *)```(?P<kind>[^\s`]*)(?P<rest>[^`]*)$")
_TITLE = re.compile(r'title="([^"]+)"')


@dataclass(frozen=True)
class Block:
    """A fenced block: its kind, the file it stands for (or none), its first line's number and its text."""

    kind: str
    title: str
    line: int
    text: str


@dataclass
class Outcome:
    """What came of one page: a line for each thing done, and what went wrong."""

    page: str
    lines: list[str] = field(default_factory=list)
    faults: list[str] = field(default_factory=list)
    done: int = 0


def blocks(text: str) -> Iterator[Block]:
    """The fenced blocks of a page, in order."""
    opened: tuple[str, str, int, int] | None = None
    held: list[str] = []
    for number, line in enumerate(text.splitlines(), 1):
        match = _FENCE.match(line)
        if match and opened is None:
            title = _TITLE.search(match["rest"])
            opened, held = (match["kind"], title[1] if title else "", number, len(match["indent"])), []
        elif opened and line.strip() == "```":
            yield Block(opened[0], opened[1], opened[2], "\n".join(held) + "\n")
            opened = None
        elif opened:
            held.append(line[opened[3] :])
    if opened:
        raise ValueError(f"the fence of line {opened[2]} is never closed")


def faults_of(block: Block) -> str:
    """What is wrong with a block before anything runs; empty if nothing."""
    if block.kind not in KINDS:
        return f"the fence says {block.kind!r}, expected one of {', '.join(KINDS)}"
    if block.kind in FRAGMENTS:
        try:
            {"yaml": yaml.safe_load, "json": _json, "toml": tomllib.loads}[block.kind](block.text)
        except (yaml.YAMLError, ValueError) as fault:
            return f"it is not {block.kind}: {fault}"
    return ""


def _json(text: str) -> None:
    """One document, or one a line."""
    try:
        json.loads(text)
    except ValueError:
        for line in text.splitlines():
            json.loads(line)


@dataclass(frozen=True)
class Command:
    """What bash is given, and the message that must come of it; empty where the command must end well."""

    text: str
    refusal: str = ""


def commands(block: Block) -> list[Command]:
    """What a block has run."""
    if block.title or block.kind not in ("console", "sh"):
        return []
    if block.kind == "sh":
        return [Command(block.text)]
    found: list[Command] = []
    for line in map(str.strip, block.text.splitlines()):
        if line.startswith("$ "):
            found.append(Command(line[2:]))
        elif found and (line.startswith("armcal: ") or (found[-1].refusal and line)):
            found[-1] = Command(found[-1].text, f"{found[-1].refusal} {line}".strip())
    return found


def page_outcome(page: Path) -> Outcome:
    """Run one page, in this process's own working directory from now on."""
    told = Outcome(os.path.relpath(page, ROOT))
    with tempfile.TemporaryDirectory(prefix="armcal-docs-") as place:
        shutil.copytree(ROOT / "configs", Path(place) / "configs")
        os.chdir(place)
        namespace: dict[str, Any] = {"__name__": "__main__"}
        for block in blocks(page.read_text(encoding="utf-8")):
            fault = faults_of(block)
            if fault:
                told.faults.append(f"{told.page}:{block.line}: {fault}")
            elif block.title:
                Path(block.title).parent.mkdir(parents=True, exist_ok=True)
                Path(block.title).write_text(block.text, encoding="utf-8")
            elif block.kind == "python":
                _note(told, block, "python", lambda b=block: _execute(b, told.page, namespace))
            for command in commands(block) if not fault else ():
                _note(told, block, command.text, lambda c=command: _ran(c))
        os.chdir(ROOT)
    return told


def _note(told: Outcome, block: Block, what: str, act: Any) -> None:
    """Do one thing, and write down what came of it."""
    began = time.perf_counter()
    said = act()
    shown = f"{told.page}:{block.line}: {what.strip().splitlines()[0]}"
    told.lines.append(f"{'FAIL' if said else 'ok  '} {time.perf_counter() - began:5.1f} s  {shown}")
    told.done += 1
    if said:
        told.faults.append(f"{shown}\n{said}")


def _ran(command: Command) -> str:
    """Run it; what it said, if it did not end as the page has it."""
    words = plain_words(command.text)
    try:
        code, out, err = run_once(words) if words[:1] == ["armcal"] else run_bash(command.text)
    except subprocess.TimeoutExpired:
        return f"it did not end within {LONGEST_S} s"
    said = f"exit {code}\n{out}{err}"
    if not command.refusal:
        return said if code else ""
    told = " ".join(err.split())
    pattern = ".*".join(re.escape(" ".join(part.split())) for part in command.refusal.split("..."))
    return "" if code and re.search(pattern, told) else f"expected: {command.refusal}\n{said}"


def plain_words(text: str) -> list[str]:
    """The words of a command in which a shell has nothing to do but to take off quotes; none of any other."""
    bare = re.sub(r"'[^']*'|\"[^\"$`\\]*\"", "", text)
    return [] if re.search(r"[^\w\s./:=,+@%-]", bare) or "\n" in text.strip() else shlex.split(text)


def run_bash(text: str) -> tuple[int, str, str]:
    """Exit code, output and errors of a script, in processes of its own."""
    done = subprocess.run(["bash", "-ec", text], capture_output=True, text=True, timeout=LONGEST_S, check=False)
    return done.returncode, done.stdout, done.stderr


def run_once(words: list[str]) -> tuple[int, str, str]:
    """The same of one command of armcal; the folder of a run is a copy where a page before has made the same run."""
    folder = Path(words[words.index("--out") + 1]) if words[1] == "run" and "--out" in words[:-1] else None
    kept = os.environ.get(KEPT)
    if not kept or folder is None or folder.exists() or "--data" in words:
        return run_armcal(words)
    state = hashlib.sha256("\0".join(word for word in words if word != str(folder)).encode())
    for path in sorted(path for path in Path("configs").rglob("*") if path.is_file()):
        state.update(f"\0{path}\0".encode() + path.read_bytes())
    made = Path(kept) / state.hexdigest()
    with made.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if made.exists():
            shutil.copytree(made, folder)
            return 0, "", ""
        said = run_armcal(words)
        if said[0] == 0:
            shutil.copytree(folder, made)
        return said


def run_armcal(words: list[str]) -> tuple[int, str, str]:
    """The same of one command of armcal, in a fork of this process, which has loaded everything already."""
    with tempfile.TemporaryDirectory(prefix="armcal-docs-") as place:
        out, err = Path(place) / "out", Path(place) / "err"
        process = FORK.Process(target=_main, args=(words, out, err))
        process.start()
        process.join(LONGEST_S)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(words, LONGEST_S)
        return process.exitcode, out.read_text(encoding="utf-8"), err.read_text(encoding="utf-8")


def _main(words: list[str], out: Path, err: Path) -> None:
    from armcal.cli.main import main

    for path, number in ((Path(os.devnull), 0), (out, 1), (err, 2)):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
    sys.stdin, sys.stdout, sys.stderr = (open(n, m, closefd=False) for n, m in enumerate("rww"))  # noqa: SIM115
    sys.argv = words
    with no_workers_left():
        main()


@contextlib.contextmanager
def no_workers_left() -> Iterator[None]:
    """A fork that ends waits for joblib's workers for ever, where the end of a program would end them."""
    from joblib.externals.loky import get_reusable_executor

    try:
        yield
    finally:
        get_reusable_executor().shutdown(wait=True)


def _execute(block: Block, page: str, namespace: dict[str, Any]) -> str:
    """Execute a Python block at its line of the page; the traceback, if it failed."""
    said = io.StringIO()
    try:
        code = compile("\n" * block.line + block.text, page, "exec")
        with contextlib.redirect_stdout(said), contextlib.redirect_stderr(said):
            exec(code, namespace)
    except BaseException:
        return said.getvalue() + traceback.format_exc()
    return ""


def pages_of(places: list[str]) -> list[Path]:
    """The pages in files and folders."""
    found: list[Path] = []
    for place in map(Path, places):
        found += sorted(place.rglob("*.md")) if place.is_dir() else [place]
    return [page.resolve() for page in found]


def outcomes(pages: list[Path]) -> Iterator[Outcome]:
    """What comes of each page, ``AT_ONCE`` at a time, each in a fork of this process."""
    waiting, running = list(pages), {}
    while waiting or running:
        while waiting and len(running) < AT_ONCE:
            ours, theirs = FORK.Pipe(duplex=False)
            process = FORK.Process(target=_send_outcome, args=(waiting[0], theirs))
            process.start()
            theirs.close()
            running[ours] = (process, waiting.pop(0))
        for ours in wait(list(running)):
            process, page = running.pop(ours)
            try:
                yield ours.recv()
            except EOFError:
                yield Outcome(str(page), faults=[f"{page}: its process ended"])
            process.join()


def _send_outcome(page: Path, pipe: Connection) -> None:
    with no_workers_left():
        pipe.send(page_outcome(page))


def load_everything() -> None:
    """What each command would load anew; none compiles for a next run, which would be no page's."""
    import cvxpy  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    from armcal.functions import compiler
    from armcal.plugins import discover
    from armcal.report import page, run_document  # noqa: F401
    from armcal.run import pipeline  # noqa: F401

    discover()
    compiler.compile_in_background = lambda *given: None


def main(places: list[str]) -> int:
    """Run them all, some pages at once; the number of failures."""
    for variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ.setdefault(variable, "1")
    began, done, faults = time.perf_counter(), 0, []
    load_everything()
    with tempfile.TemporaryDirectory(prefix="armcal-cache-") as cache:
        os.environ["ARMCAL_CACHE_DIR"], os.environ[KEPT] = cache, tempfile.mkdtemp(dir=cache)
        for outcome in outcomes([page for page in pages_of(places) if page.name not in DONE_BY_TESTS]):
            for line in outcome.lines:
                print(line, flush=True)
            done += outcome.done
            faults += outcome.faults
    print(*(f"\nFAIL {fault}" for fault in faults), sep="\n")
    print(f"{done} done, {len(faults)} failed, in {time.perf_counter() - began:.0f} s")
    return len(faults) or not done


if __name__ == "__main__":
    sys.exit(min(main(sys.argv[1:]), 100))
