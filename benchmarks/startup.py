"""Whole commands, from the shell's point of view, as multiples of a Python that does nothing."""

from __future__ import annotations

import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from benchmarks.lrm import CONFIGS
from benchmarks.report import Row
from benchmarks.timing import once

NAME = "commands"
PEER = "python -c pass"
REPEATS = 7
_COMPILER_LIMIT_S = 60


class CommandFailedError(Exception):
    """A command gave an exit code; the message is its last words."""


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    armcal = Path(sys.executable).with_name("armcal")
    if not armcal.exists():
        yield Row(NAME, "armcal", None, PEER, None, f"no command beside {sys.executable}: pip install -e .")
        return
    with tempfile.TemporaryDirectory() as scratch:
        demo = [str(armcal), "run", str(CONFIGS / "demo.yaml"), "--quiet", "--out", str(Path(scratch) / "out")]
        bare = [sys.executable, "-c", "pass"]
        for name, command in {
            "armcal --help": [str(armcal), "--help"],
            "armcal plugins list": [str(armcal), "plugins", "list"],
            "armcal run demo.yaml, compiled before": demo,
        }.items():
            yield _row(name, command, bare)
        yield _first_run(demo, bare, Path(scratch))


def _row(name: str, command: Sequence[str], bare: Sequence[str]) -> Row:
    try:
        _call(command)
        _settle()
        pairs = [(once(lambda: _call(command)), once(lambda: _call(bare))) for _ in range(REPEATS)]
    except CommandFailedError as fault:
        return Row(NAME, name, None, PEER, None, f"failed: {fault}")
    ours, peers = (statistics.median(times) for times in zip(*pairs, strict=True))
    return Row(NAME, name, ours, PEER, peers)


def _first_run(demo: Sequence[str], bare: Sequence[str], scratch: Path) -> Row:
    """With nothing compiled yet; the compiler goes on in the background, so each run waits for the last one's."""
    name = "armcal run demo.yaml, empty cache"
    ours, peers = [], []
    for number in range(3):
        cache = scratch / f"cache{number}"
        environment = {**os.environ, "ARMCAL_CACHE_DIR": str(cache)}
        try:
            ours.append(once(lambda: _call(demo, environment)))  # noqa: B023 - called at once
        except CommandFailedError as fault:
            return Row(NAME, name, None, PEER, None, f"failed: {fault}")
        _settle(cache)
        peers.append(once(lambda: _call(bare)))
    return Row(NAME, name, statistics.median(ours), PEER, statistics.median(peers))


def _call(command: Sequence[str], environment: Mapping[str, str] | None = None) -> None:
    out = Path(command[-1]) if "--out" in command else None
    if out is not None and out.exists():
        shutil.rmtree(out)
    done = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
    if done.returncode:
        words = done.stderr.strip().splitlines()
        raise CommandFailedError(words[-1] if words else f"exit code {done.returncode}")


def _settle(cache: Path | None = None) -> None:
    """Wait until no compiler works in the background."""
    from armcal.functions.compiler import cache_directory

    directory = cache or cache_directory()
    until = time.monotonic() + _COMPILER_LIMIT_S
    while time.monotonic() < until and any(directory.glob(".build-*")):
        time.sleep(0.1)
