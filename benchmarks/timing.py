"""Times that survive a busy machine: contenders take turns, and each one's best counts."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

LONG_S = 2.0
"""What takes longer than this the first time is not asked again."""


def best_times(contenders: Mapping[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    """Each contender's shortest time in seconds."""
    best = {name: once(call) for name, call in contenders.items()}
    for _ in range(repeats):
        for name, call in contenders.items():
            if best[name] < LONG_S:
                best[name] = min(best[name], once(call))
    return best


def once(call: Callable[[], object]) -> float:
    """How long a call takes (s)."""
    began = time.perf_counter()
    call()
    return time.perf_counter() - began
