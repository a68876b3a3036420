"""A history of bounded length: the newest at full detail, older ones fewer and fewer."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from typing import Generic, TypeVar

T = TypeVar("T")


class Thinned(Generic[T]):
    """The newest ``recent`` items, and at most ``older`` of those before them, spread evenly.

    Args:
        recent: how many are kept whole.
        older: how many of the others are kept.
        shorten: what of an item is kept when it is no longer one of the newest.
    """

    def __init__(self, recent: int, older: int, shorten: Callable[[T], T] = lambda item: item) -> None:
        self._recent: deque[T] = deque()
        self._older: list[T] = []
        self._most = (recent, older)
        self._stride, self._passed = 1, 0
        self._shorten = shorten

    def add(self, item: T) -> None:
        """The newest item."""
        self._recent.append(item)
        if len(self._recent) <= self._most[0]:
            return
        oldest = self._recent.popleft()
        if self._passed % self._stride == 0:
            self._older.append(self._shorten(oldest))
        self._passed += 1
        if len(self._older) > self._most[1]:
            del self._older[1::2]
            self._stride *= 2

    def __iter__(self) -> Iterator[T]:
        yield from self._older
        yield from self._recent

    def __len__(self) -> int:
        return len(self._older) + len(self._recent)
