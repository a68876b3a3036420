"""Signals become requests that a loop looks at between records."""

import signal
import threading
from collections.abc import Iterable
from types import FrameType
from typing import Any, Self

FINISH = (signal.SIGTERM, signal.SIGINT)
ROTATE = signal.SIGHUP


class Signals:
    """While it is entered, in the main thread: SIGTERM and SIGINT ask for the end; SIGHUP ends nothing by itself."""

    def __init__(self, numbers: Iterable[int] = (*FINISH, ROTATE)) -> None:
        self.finish = self.rotate = False  # what was asked for
        self.before: dict[int, Any] = {number: signal.getsignal(number) for number in numbers}

    def __enter__(self) -> Self:
        self._handle(dict.fromkeys(self.before, self.take))
        return self

    def __exit__(self, *fault: object) -> None:
        self._handle(self.before)

    def _handle(self, handlers: dict[int, Any]) -> None:
        if threading.current_thread() is threading.main_thread():
            for number, handler in handlers.items():
                signal.signal(number, handler)

    def take(self, number: int, frame: FrameType | None) -> None:
        self.finish |= number in FINISH
        self.rotate |= number == ROTATE


class Interrupts(Signals):
    """Notes that Ctrl-C came, for who calls a library that may keep it to itself; what took it before takes it too."""

    def __init__(self) -> None:
        super().__init__([signal.SIGINT] if callable(signal.getsignal(signal.SIGINT)) else [])

    def take(self, number: int, frame: FrameType | None) -> None:
        super().take(number, frame)
        self.before[number](number, frame)
