"""The server: requests from its transports, answers from its workers, until a signal asks for the end."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from armcal.io.signals import Signals

from armcal_serve.calibration_watch import CalibrationWatch
from armcal_serve.dispatcher import Dispatcher
from armcal_serve.poller import Poller
from armcal_serve.protocol import VERSION, Tell
from armcal_serve.transports.transport import Transport
from armcal_serve.worker_pool import WorkerPool

_STEP_S = 0.1
"""How long it may take until a signal, a client that left or a new file is noticed, when nothing else happens."""
_GRACE_S = 10.0
"""How long answers may take after the end was asked for."""

Opening = Callable[[Poller, Dispatcher], Transport]


class Server:
    """Serves one calibration's file.

    Args:
        path: the file, which may be replaced at any time.
        workers: how many processes answer.
        how: commands are found; see ``armcal_serve.worker_pool.WorkerPool``.
        openings: make the transports.
        tell: takes what whoever started it should know.

    Raises:
        InputError: a transport cannot be opened.
    """

    def __init__(
        self, path: Path, workers: int, how: Mapping[str, Any], openings: Sequence[Opening], tell: Tell
    ) -> None:
        self._began = time.monotonic()
        self._tell = tell
        self._poller = Poller()
        self._watch = CalibrationWatch(path)
        self._dispatcher = Dispatcher(self.status)
        self._pool = WorkerPool(workers, self._watch, how, self._poller, self._dispatcher, tell)
        self._transports: list[Transport] = []
        try:
            for opening in openings:
                self._transports.append(opening(self._poller, self._dispatcher))
        except BaseException:
            self._close()
            raise

    def run(self, signals: Signals) -> None:
        """Until a signal asks for the end, or nobody can ask anything any more.

        Raises:
            ArmcalError: the calibration cannot be used.
        """
        try:
            self._pool.begin(self._watch.first())
            while self._pool.tag is None and not signals.finish:
                self._poller.step(_STEP_S)
                self._pool.tend(looking=False)
            if not signals.finish:
                self._serve(signals)
        finally:
            self._close()

    def status(self) -> Mapping[str, Any]:
        """How the server is doing, as an answer."""
        return {
            "armcal_serve": VERSION,
            "ok": True,
            "calibration": self._pool.tag,
            "arms": self._pool.arms,
            "file": {"path": str(self._watch.path), "state": self._watch.state, "why": self._watch.why},
            "requests": self._dispatcher.asked,
            "waiting": self._dispatcher.waiting,
            "clients": sum(transport.clients for transport in self._transports),
            "worker_pids": self._pool.worker_pids,
            "workers_lost": self._pool.lost,
            "up_s": round(time.monotonic() - self._began, 1),
        }

    def _serve(self, signals: Signals) -> None:
        names = [transport.name for transport in self._transports]
        content = {"calibration": self._pool.tag, "arms": self._pool.arms, "by": names}
        self._tell("ready", f"ready: {self._watch.path} by {', '.join(names)}", content)
        gc.collect()
        gc.freeze()
        for transport in self._transports:
            transport.open()
        while not signals.finish and not all(transport.ended for transport in self._transports):
            self._step()
            if signals.status:
                signals.status = False
                tag = self._pool.tag
                number = 0 if tag is None else tag["sequence"]
                sentence = f"calibration {number} is answered from, {self._dispatcher.asked} requests so far; "
                sentence += f"the file is {self._watch.state}. {self._watch.why}"
                self._tell("status", sentence.rstrip(), self.status())
        for transport in self._transports:
            transport.listen_no_more()
        ends = time.monotonic() + _GRACE_S
        while not all(transport.finished for transport in self._transports) and time.monotonic() < ends:
            self._step(looking=False)

    def _step(self, looking: bool = True) -> None:
        self._poller.step(_STEP_S)
        self._pool.tend(looking)
        for transport in self._transports:
            transport.tend()

    def _close(self) -> None:
        for transport in self._transports:
            transport.close()
        self._pool.close()
        self._watch.close()
