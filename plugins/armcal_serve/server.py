"""The server: requests from its transports, answers from its workers, until a signal asks for the end."""

import gc
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from armcal.io.signals import Signals

from armcal_serve.calibration_watch import CalibrationWatch
from armcal_serve.dispatcher import Dispatcher
from armcal_serve.order import Order
from armcal_serve.poller import Poller
from armcal_serve.protocol import VERSION, Notify
from armcal_serve.transports.transport import Transport
from armcal_serve.worker_pool import WorkerPool

_STEP_S = 0.1
"""How long it may take until a signal, a client that left or a new file is noticed, when nothing else happens."""
_GRACE_S = 10.0
"""How long answers may take after the end was asked for."""

Opening = Callable[[Poller, Dispatcher], Transport]


class Server:
    """Serves one calibration's file, which may be replaced at any time; ``order`` is for the first.

    Raises:
        InputError: a transport cannot be opened.
    """

    def __init__(self, order: Order, workers: int, openings: Sequence[Opening], notify: Notify) -> None:
        self._began = time.monotonic()
        self._notify = notify
        self._poller = Poller()
        self._watch = CalibrationWatch(Path(order.shown))
        self._dispatcher = Dispatcher(self.status)
        self._pool = WorkerPool(workers, self._watch, order, self._poller, self._dispatcher, notify)
        self._transports: list[Transport] = []
        try:
            for opening in openings:
                self._transports.append(opening(self._poller, self._dispatcher))
        except BaseException:
            self._close()
            raise

    def run(self, signals: Signals) -> None:
        """Serve until a signal asks for the end, or no transport can bring another request.

        Raises:
            ArmcalError: the calibration cannot be used.
        """
        try:
            self._pool.begin(self._watch.first())
            while self._pool.tag is None and not signals.finish:
                self._poller.step(_STEP_S)
                self._pool.poll(looking=False)
            if signals.finish:
                return
            names = [transport.name for transport in self._transports]
            content = {"calibration": self._pool.tag, "arms": self._pool.arms, "by": names}
            self._notify("ready", f"ready: {self._watch.path} by {', '.join(names)}", content)
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
                    sentence = f"calibration {number} is answered from, {self._dispatcher.requests} requests so far; "
                    sentence += f"the file is {self._watch.state}. {self._watch.why}"
                    self._notify("status", sentence.rstrip(), self.status())
            for transport in self._transports:
                transport.stop_reading()
            ends = time.monotonic() + _GRACE_S
            while not all(transport.finished for transport in self._transports) and time.monotonic() < ends:
                self._step(looking=False)
        finally:
            self._close()

    def status(self) -> Mapping[str, Any]:
        """The answer to a request for the status."""
        return {
            "armcal_serve": VERSION,
            "ok": True,
            "calibration": self._pool.tag,
            "arms": self._pool.arms,
            "file": {"path": str(self._watch.path), "state": self._watch.state, "why": self._watch.why},
            "requests": self._dispatcher.requests,
            "waiting": self._dispatcher.waiting,
            "clients": sum(transport.clients for transport in self._transports),
            "worker_pids": self._pool.worker_pids,
            "workers_lost": self._pool.lost,
            "up_s": round(time.monotonic() - self._began, 1),
        }

    def _step(self, looking: bool = True) -> None:
        self._poller.step(_STEP_S)
        self._pool.poll(looking)
        for transport in self._transports:
            transport.poll()

    def _close(self) -> None:
        for transport in self._transports:
            transport.close()
        self._pool.close()
        self._watch.close()
