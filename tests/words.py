"""Names and phrases that the field has better words for, refused in code, messages and pages: run by ``make lint``."""

from __future__ import annotations

import re
import sys
import tokenize
from collections.abc import Iterator
from pathlib import Path

NAMES = {
    **dict.fromkeys(("told", "found", "each", "wanted", "asked"), "the thing: residuals, estimate, record, candidates"),
    "wished": "preferred",
    "Voice": "Console",
    "Crew": "WorkerPool",
    "Conduct": "AcquisitionRun",
    "Course": "RunOptions, StateReplayer",
    "Eyes": "TrackerMonitor",
    "Looker": "MotionGate",
    "ParkWish": "ParkRequested",
    "StaysLost": "ReconnectError",
    "TooHot": "ThermalLimit",
    "Warmth": "ThermalState",
    "take_up_play": "preload_backlash",
    "Footing": "FilterSetup",
    "Companions": "GaussMarkovStates",
    "Fading": "ProcessNoise",
    "Chart": "StateSpace",
    "Follower": "HypothesisFilter",
    "surprise": "nis",
    "leftover": "residual_structure",
    "misses": "large_errors",
    "mixup": "permuted_axes",
    "told_by_data": "determined_by",
    "nimbleness": "dexterity",
    "Walk": "JournalReplayer",
    "Witness": "ReplayVerifier",
    "Story": "MissionLog",
    "Book": "RecordingLog",
    "foretell": "forecast",
    "Outlook": "ScheduleForecast",
    "Ground": "PlanContext",
}
PHRASES = {
    r"\b(is|are|was|were|be) had\b": "reached",
    r"\bhangs? together\b": "is correlated",
    r"\bordinary size\b": "typical scale",
    r"\bmade[- ]up data\b": "simulated data",
    r"\bnimbleness\b": "dexterity",
    r"\bmix-ups?\b": "permuted or flipped axes",
}
READ = ("*.py", "*.md", "*.j2", "*.yaml")


def names(file: Path) -> Iterator[tuple[int, str, str]]:
    """Line, name and what to say, for each refused name in a module."""
    with file.open("rb") as stream:
        for token in tokenize.tokenize(stream.readline):
            if token.type == tokenize.NAME and token.string in NAMES:
                yield token.start[0], token.string, NAMES[token.string]


def phrases(file: Path) -> Iterator[tuple[int, str, str]]:
    """Line, phrase and what to say, for each refused phrase."""
    for number, line in enumerate(file.read_text("utf-8").splitlines(), 1):
        for pattern, better in PHRASES.items():
            for match in re.finditer(pattern, line, re.IGNORECASE):
                yield number, match[0], better


def main(places: list[str]) -> int:
    """Print what is refused; how many there are, at most 1."""
    count = 0
    for place in map(Path, places):
        for file in [place] if place.is_file() else sorted(f for kind in READ for f in place.rglob(kind)):
            refused = [*phrases(file), *(names(file) if file.suffix == ".py" else ())]
            for line, word, better in sorted(refused):
                print(f"{file}:{line}: {word!r}: say {better}")
                count += 1
    return min(count, 1)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
