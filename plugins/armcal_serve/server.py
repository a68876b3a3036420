"""The server: one thread that answers, and one that loads a calibration which takes the place of the one before."""

import gc
import sys
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

from armcal.base.config_text import as_line
from armcal.errors import ArmcalError
from armcal.io.json_server import Answers, JsonServer
from armcal.io.signals import Signals

from armcal_serve.answers import Answerer
from armcal_serve.loading import CalibrationFile, Loader, Order
from armcal_serve.protocol import MAX_LINE_BYTES, VERSION, refusal

_STEP_S = 0.1  # How long it may take until a signal or a new calibration is noticed, when nothing else happens
_GRACE_S = 10.0  # How long answers may take after the end was asked for
_SWITCH_S = 5e-5  # So long the loading thread works on when there is something to answer

Notify = Callable[[str, str, Mapping[str, Any]], None]
"""Takes an event's name, a sentence and its fields, for the program that started the server."""


class Server(Answers):
    """Serves one calibration's file, which may be replaced at any time, at a socket or at a pair of descriptors."""

    def __init__(self, order: Order, notify: Notify, socket: Path | None, streams: tuple[int, int] | None) -> None:
        """Load the calibration, which may take the compiler's time.

        Raises:
            ArmcalError: it cannot be used, or somebody serves the socket.
        """
        self._began = time.monotonic()
        self._notify = notify
        self._file = CalibrationFile(Loader(order))
        self._server = JsonServer(self, MAX_LINE_BYTES)
        self._streams = streams
        self._by = "standard input" if socket is None else f"socket {socket}"
        if socket is not None:
            self._server.listen(socket, "a server is running here.", "Give another --socket.")
        try:
            fault = self._file.take()
            if fault is not None:
                raise fault
        except BaseException:
            self._server.close()
            raise

    def run(self, signals: Signals) -> None:
        """Serve until a signal asks for the end, or no request can come any more."""
        switched = sys.getswitchinterval()
        sys.setswitchinterval(_SWITCH_S)
        gc.collect()
        gc.freeze()
        try:
            with warnings.catch_warnings(), self._file:
                warnings.simplefilter("ignore")
                self._serve(signals)
        finally:
            sys.setswitchinterval(switched)
            self._server.close()

    def begin(self, line: bytes, arrived: float) -> Iterator[bytes | None]:
        return self._served.begin(line, arrived, self.status)

    def refusal(self, fault: ArmcalError) -> bytes:
        return as_line(refusal(None, fault)).encode()

    @property
    def _served(self) -> Answerer:
        assert self._file.served is not None
        return self._file.served

    def status(self) -> Mapping[str, Any]:
        """The answer to a request for the status."""
        served, file = self._served, self._file
        return {
            "armcal_serve": VERSION,
            "ok": True,
            "calibration": served.tag,
            "arms": {name: arm.shown for name, arm in served.arms.items()},
            "file": {"path": str(file.path), "state": file.state, "why": file.why},
            "requests": self._server.requests,
            "waiting": self._server.waiting,
            "clients": self._server.clients,
            "up_s": round(time.monotonic() - self._began, 1),
        }

    def _serve(self, signals: Signals) -> None:
        status = self.status()
        content = {"calibration": status["calibration"], "arms": status["arms"], "by": [self._by]}
        self._say_news()
        self._notify("ready", f"ready: {self._file.path} by {self._by}", content)
        if self._streams is not None:
            self._server.attach(*self._streams)
        while not signals.finish and not self._server.ended:
            self._server.serve(_STEP_S)
            self._say_news()
            if signals.status:
                signals.status = False
                status = self.status()
                sentence = f"calibration {status['calibration']['sequence']} is answered from, {status['requests']} "
                sentence += f"requests so far; the file is {self._file.state}. {self._file.why}"
                self._notify("status", sentence.rstrip(), status)
        self._server.stop_reading()
        ends = time.monotonic() + _GRACE_S
        while not self._server.finished and time.monotonic() < ends:
            self._server.serve(_STEP_S)

    def _say_news(self) -> None:
        while self._file.news:
            self._notify(*self._file.news.pop(0))
