"""The server: requests from its transports, answers from its workers, until a signal asks for the end."""

import contextlib
import gc
import hashlib
import os
import re
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, BinaryIO, Literal

from armcal.config.yaml_source import MAX_BYTES
from armcal.errors import EXIT_BAD_INPUT, ArmcalError, ConfigError, InputError, Location
from armcal.io.plain_files import input_file
from armcal.io.signals import Signals

from armcal_serve.dispatcher import Dispatcher
from armcal_serve.order import Order
from armcal_serve.poller import Poller
from armcal_serve.protocol import VERSION, CalibrationTag, Notify
from armcal_serve.transports.transport import Transport
from armcal_serve.worker_process import WorkerProcess

LOOK_S = 0.2  # How often the file is looked at; a new one must look the same twice
QUIET_S = 5.0  # A file that grows or is changed in place is read when it has not changed for so long
AGAIN_S = 10.0  # A file that could not be tried for no fault of its own is tried again after so long

_LAST_LINE = re.compile(rb"^# sha256 of the lines above: [0-9a-f]{64}\r?\n\Z", re.MULTILINE)
"""What a calibration ends in."""

State = Literal["taken", "settling", "loading", "refused", "missing"]
_Stat = tuple[int, int, int, int]


@dataclass(frozen=True)
class Snapshot:
    """A file's content, all of it from one moment."""

    data: bytes
    sha256: str


class CalibrationWatch:
    """Polls the status of a file, and reads it when it is another one and at rest.

    A file that ``armcal recalibrate`` puts there by renaming is read at the second look. The file that was read last
    stays open, so that its inode's number cannot come back with another file.

    Attributes:
        path: the file.
        state: of the newest file there.
        why: the sentence for it, where it is not taken.
    """

    def __init__(self, path: Path, clock: Callable[[], float] = time.monotonic) -> None:
        self.path = path
        self.state: State = "loading"
        self.why = ""
        self._clock = clock
        self._seen: _Stat | None = None
        self._rests_at = 0.0
        self._tried: _Stat | None = None
        self._tried_sha256 = ""
        self._taken_sha256 = ""
        self._refusal = ""
        self._again_at: float | None = None
        self._held: BinaryIO | None = None

    def first(self) -> Snapshot:
        """The file as it is now.

        Raises:
            ConfigError: it cannot be read, or is not whole.
        """
        where = Location(str(self.path))
        try:
            if not self.path.is_file():
                text = "this is no file" if self.path.exists() else "there is no such file"
                raise ConfigError(f"{text}.", where=where, hint="Give the calibration.yaml of a run.")
            snapshot = self._read()
        except (OSError, ValueError) as fault:
            hint = "Check the path and its permissions."
            raise ConfigError(f"the file cannot be read ({fault}).", where=where, hint=hint) from fault
        if snapshot is None:
            hint = "Start the server again when it is written."
            raise ConfigError("the file changed while it was read.", where=where, hint=hint)
        fault_of = _not_whole(snapshot)
        if fault_of:
            raise ConfigError(fault_of, where=where, hint="Take a whole copy, or run the calibration again.")
        return snapshot

    def look(self) -> Snapshot | None:
        """Another content that came to rest and may be tried; None while there is none."""
        now = self._clock()
        status: _Stat | None = None
        with contextlib.suppress(OSError):
            status = _key(self.path.stat())
        if status is None:
            self._seen = None
            self.state, self.why = "missing", "there is no such file; the calibration before is used on."
            return None
        if self._again_at is not None and now >= self._again_at:
            self._tried, self._tried_sha256, self._again_at = None, "", None
        if status == self._tried:
            self._seen = status
            if self.state == "missing":
                self.state = "taken" if self._tried_sha256 == self._taken_sha256 else "refused"
                self.why = self._refusal
            return None
        if status != self._seen:
            in_place = self._seen is not None and status[:2] == self._seen[:2]
            self._rests_at = now + (QUIET_S if in_place else 0.0)
            self._seen = status
            if in_place:
                why = f"the file is being written in place; it is read {QUIET_S:g} s after the last byte."
                self.state, self.why = "settling", why
            return None
        return self._rested() if now >= self._rests_at else None

    def taken(self) -> None:
        self._taken_sha256, self._refusal = self._tried_sha256, ""
        self.state, self.why = "taken", ""

    def refused(self, why: str, again: bool = False) -> None:
        """The content that was tried last is not used; ``again``: for no fault of its own, so it is tried once more."""
        self._refusal = why
        self.state, self.why = "refused", why
        self._again_at = self._clock() + AGAIN_S if again else None

    def close(self) -> None:
        if self._held is not None:
            self._held.close()
            self._held = None

    def _rested(self) -> Snapshot | None:
        before = self._tried_sha256
        try:
            snapshot = self._read()
        except (OSError, ValueError) as fault:
            self.state, self.why = "refused", f"the file cannot be read ({fault})."
            return None
        except ConfigError as fault:
            self.state, self.why = "refused", fault.message
            return None
        if snapshot is None:
            return None
        if snapshot.sha256 == self._taken_sha256:
            self.state, self.why = "taken", ""
            return None
        if snapshot.sha256 == before:
            self.state, self.why = "refused", self._refusal
            return None
        fault_of = _not_whole(snapshot)
        if fault_of:
            self.refused(fault_of)
            return None
        self.state, self.why = "loading", ""
        return snapshot

    def _read(self) -> Snapshot | None:
        """What is in the file; None if it changed meanwhile. A pipe that took its place is refused, not waited for."""
        file = input_file(self.path, MAX_BYTES, "a calibration.yaml", ConfigError)
        try:
            before = _key(os.fstat(file.fileno()))
            data = file.read(MAX_BYTES)
            if _key(os.fstat(file.fileno())) != before:
                file.close()
                return None
        except BaseException:
            file.close()
            raise
        self.close()
        self._held = file
        self._tried = self._seen = before
        self._tried_sha256 = hashlib.sha256(data).hexdigest()
        return Snapshot(data, self._tried_sha256)


def _not_whole(snapshot: Snapshot) -> str:
    """Why it cannot be a whole calibration; empty if it can."""
    if not snapshot.data:
        return "the file is empty."
    if not snapshot.data.endswith(b"\n"):
        return "the last line of the file has no end: this is no whole calibration."
    if not _LAST_LINE.search(snapshot.data):
        return "the line that ends a calibration is not at the end of the file: this is no whole calibration."
    return ""


def _key(status: os.stat_result) -> _Stat:
    return status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns


LONGEST_S = 20.0  # A request that takes longer costs its worker, and is answered with an error
_LONGEST_LOADING_S = 300.0
_GENTLY_S = 15.0
"""On a computer that others keep busy a worker of low priority may never be ready; after so long one of ours is."""
_PAUSE_S = 1.0  # Before a worker is started again that did not come


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


_STEP_S = 0.1
"""How long it may take until a signal, a client that left or a new file is noticed, when nothing else happens."""
_GRACE_S = 10.0  # How long answers may take after the end was asked for

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
