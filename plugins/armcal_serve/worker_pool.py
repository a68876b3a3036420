"""The workers that answer, those that are made ready for a newer calibration, and those that leave."""

import time
from collections.abc import Mapping
from dataclasses import replace
from typing import Any

from armcal.errors import EXIT_BAD_INPUT, ArmcalError, InputError, Location

from armcal_serve.calibration_watch import LOOK_S, CalibrationWatch, Snapshot
from armcal_serve.dispatcher import Dispatcher
from armcal_serve.order import Order
from armcal_serve.poller import Poller
from armcal_serve.protocol import CalibrationTag, Notify
from armcal_serve.worker_process import WorkerProcess

LONGEST_S = 20.0
"""A request that takes longer costs its worker, and is answered with an error."""
_LONGEST_LOADING_S = 300.0
_GENTLY_S = 15.0
"""On a computer that others keep busy a worker of low priority may never be ready; after so long one of ours is."""
_PAUSE_S = 1.0
"""Before a worker is started again that did not come."""


class WorkerPool:
    """Workers for a file that may be replaced: requests go to those of the newest calibration that is ready.

    A new file gets workers of its own, made ready one after another beside those that answer. When all of them are,
    they get every further request; those before answer what they have, and end. No request ever waits for that.

    Attributes:
        tag: the calibration that is answered from; None before the first is ready.
        arms: what requests can be about, by name.
        lost: workers that crashed or had to be ended.
    """

    def __init__(
        self,
        size: int,
        watch: CalibrationWatch,
        order: Order,
        poller: Poller,
        dispatcher: Dispatcher,
        notify: Notify,
    ) -> None:
        self.tag: CalibrationTag | None = None
        self.arms: Mapping[str, Any] = {}
        self.lost = 0
        self._size, self._watch, self._order = size, watch, order
        self._poller, self._dispatcher, self._notify = poller, dispatcher, notify
        self._served: Snapshot | None = None
        self._active: list[WorkerProcess] = []
        self._next: Snapshot | None = None
        self._next_ready: list[WorkerProcess] = []
        self._making: WorkerProcess | None = None
        self._made_of: Snapshot | None = None
        self._gently = False
        self._leaving: list[WorkerProcess] = []
        self._looks_at = self._may_start_at = 0.0
        self._without_since = time.monotonic()

    @property
    def worker_pids(self) -> list[int]:
        return [worker.pid for worker in self._active]

    def begin(self, snapshot: Snapshot) -> None:
        self._next = snapshot
        self._start(gently=False)

    def poll(self, looking: bool = True) -> None:
        """Do what is due; to be called after every event, and often without.

        Raises:
            ArmcalError: the first calibration cannot be used.
        """
        now = time.monotonic()
        self._poll_making(now)
        for worker in self._active:
            if worker.ticket is not None and now - worker.since > LONGEST_S:
                hint = "Ask for fewer targets at a time."
                worker.ticket.refused(ArmcalError(f"it took longer than {LONGEST_S:g} s.", hint=hint))
                worker.ticket = None
                worker.kill()
        before = len(self._active)
        self._active = [worker for worker in self._active if not self._left(worker)]
        if before and not self._active:
            self._without_since = now
        self._next_ready = [worker for worker in self._next_ready if not self._left(worker)]
        if self._making is None and now >= self._may_start_at:
            self._go_on(now, looking)
        if self._active:
            self._dispatcher.dispatch(self._active)
        elif self._served is not None and now - self._without_since > LONGEST_S:
            hint = "Ask again; the status says what is known."
            self._dispatcher.give_up(ArmcalError("no process answers at present.", hint=hint))
        for worker in [*self._leaving]:
            if worker.gone and worker.ticket is not None:
                fault = ArmcalError("it ended the process that answers, twice.", hint="Do not send it again.")
                unanswered, worker.ticket = worker.ticket, None
                self._dispatcher.requeue(unanswered, fault)
            if not worker.gone and worker.ticket is None:
                worker.leave()
            if worker.gone and worker.ended():
                self._leaving.remove(worker)

    def close(self) -> None:
        for worker in self._active:
            worker.leave()
        idle = [*self._next_ready, *([self._making] if self._making else [])]
        for worker in idle:
            worker.kill()
        for worker in (*self._active, *idle, *self._leaving):
            worker.wait()

    def _go_on(self, now: float, looking: bool) -> None:
        """Start the worker that is needed most, or look for a new calibration."""
        if self._next is not None and self._active:
            self._start(gently=True)
        elif len(self._active) < self._size and self._served is not None:
            self._start(gently=bool(self._active), again=True)
        elif self._next is not None:
            self._start(gently=False)
        elif looking and now >= self._looks_at:
            self._looks_at = now + LOOK_S
            before = self._watch.why
            self._next = self._watch.look()
            if self._next is None and self._watch.why not in ("", before):
                self._notify(self._watch.state, f"{self._watch.path}: {self._watch.why}", {})

    def _start(self, gently: bool, again: bool = False) -> None:
        """Make a worker ready, for the next calibration or ``again`` for the one that is answered from."""
        snapshot = self._served if again else self._next
        assert snapshot is not None
        self._made_of, self._gently, known = snapshot, gently, self.tag
        order = replace(self._order, sha256=snapshot.sha256, gently=gently)
        if known is not None:
            order = replace(order, sequence=known["sequence"] + (not again), arm=known["arm"])
        try:
            self._making = WorkerProcess(order, snapshot.data, self._poller, self.poll)
        except OSError as fault:
            self._not_made(snapshot, ArmcalError(f"no process can be started for it ({fault})."), passing=True)

    def _poll_making(self, now: float) -> None:
        making = self._making
        if making is None:
            return
        if making.state is None and not making.gone:
            if now - making.since <= (_GENTLY_S if self._gently else _LONGEST_LOADING_S):
                return
            if self._gently:
                making.kill()
                self._leaving.append(making)
                self._start(gently=False, again=self._made_of is self._served)
                return
        self._making = None
        state = making.state or {"fault": {"message": "the process that was to load it ended or hangs."}}
        tag = state.get("ready")
        if tag is None or making.gone:
            making.kill()
            self._leaving.append(making)
            content = state.get("fault", {"message": "its process ended."})
            where = Location(content.get("file"), content.get("line"), content.get("field"))
            kind = InputError if content.get("exit_code") == EXIT_BAD_INPUT else ArmcalError
            fault = kind(content["message"], where=where, hint=content.get("hint", ""))
            self._not_made(self._made_of, fault, passing="fault" not in (making.state or {}))
        elif self.tag is not None and tag["sequence"] == self.tag["sequence"]:
            self._active.append(making)
        else:
            self._next_ready.append(making)
            if len(self._next_ready) == self._size or not self._active:
                self._promote(state)

    def _promote(self, state: Mapping[str, Any]) -> None:
        """From now on requests go to the workers of the next calibration."""
        first = self.tag is None
        self._leaving += self._active
        self._active, self._next_ready = self._next_ready, []
        self._served, self._next = self._next, None
        tag: CalibrationTag = state["ready"]
        self.tag, self.arms = tag, state["arms"]
        self._watch.taken()
        for notice in state["notices"]:
            self._notify("notice", notice, {})
        if not first:
            level = f", level {tag['level']}" if tag["level"] else ""
            sentence = f"calibration {tag['sequence']} is answered from, of {tag['created']}{level}"
            self._notify("calibration", sentence, {"calibration": tag})

    def _not_made(self, snapshot: Snapshot | None, fault: ArmcalError, passing: bool) -> None:
        """Give the calibration up; ``passing`` where that is no fault of the file.

        Raises:
            ArmcalError: it was the first.
        """
        self._may_start_at = time.monotonic() + _PAUSE_S
        if self._served is None:
            raise fault
        if snapshot is not self._next:
            return
        for worker in self._next_ready:
            worker.kill()
        self._leaving += self._next_ready
        self._next, self._next_ready = None, []
        self._watch.refused(str(fault), again=passing)
        self._notify("refused", f"the new calibration is not taken: {fault}", {"why": str(fault)})

    def _left(self, worker: WorkerProcess) -> bool:
        if not worker.gone:
            return False
        self.lost += 1
        self._leaving.append(worker)
        self._notify("worker_lost", f"a process that answers ({worker.pid}) is gone; another is started", {})
        return True
