"""Signals become wishes that the loop looks at between records."""

import signal
import threading
from types import FrameType, TracebackType
from typing import Any, Self

FINISH = (signal.SIGTERM, signal.SIGINT)
STATUS = signal.SIGUSR1
ROTATE = signal.SIGHUP


class Signals:
    """While it is entered: SIGTERM and SIGINT ask for the end, SIGUSR1 for the status, SIGHUP for a new file of events.

    Outside the main thread there are none.

    Attributes:
        finish, status, rotate: what was asked for.
    """

    def __init__(self) -> None:
        self.finish = False
        self.status = False
        self.rotate = False
        self._before: dict[int, Any] = {}

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            for number in (*FINISH, STATUS, ROTATE):
                self._before[number] = signal.signal(number, self._take)
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)
        self._before.clear()

    def _take(self, number: int, frame: FrameType | None) -> None:
        self.finish |= number in FINISH
        self.status |= number == STATUS
        self.rotate |= number == ROTATE


class Interrupts:
    """While it is entered it notes that Ctrl-C came, for whoever calls a library that may keep it to itself.

    Outside the main thread there are none.
    """

    def __init__(self) -> None:
        self.came = False
        self._before: Any = None

    def __enter__(self) -> Self:
        if threading.current_thread() is threading.main_thread():
            self._before = signal.getsignal(signal.SIGINT)
            if callable(self._before):
                signal.signal(signal.SIGINT, self._take)
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        if callable(self._before):
            signal.signal(signal.SIGINT, self._before)

    def _take(self, number: int, frame: FrameType | None) -> None:
        self.came = True
        self._before(number, frame)
