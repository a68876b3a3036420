"""The calibration that is served: loaded, and loaded again beside those who ask when its file is replaced.

What a calibration of the same arm changes is the numbers of its expressions: they are channels of one expression that
was compiled at the start. So a replaced file costs a fifth of a second of reading and checking, in a thread.
"""

import hashlib
import json
import sys
import threading
import time
import warnings
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, Self

from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import lost_calibration
from armcal.calibration.compensation import Compensator, Options
from armcal.calibration.intervals import PAYLOAD, RecordedRange
from armcal.calibration.tool_expression import Point
from armcal.config.yaml_source import MAX_BYTES
from armcal.errors import ArmcalError, CalibrationWarning, ConfigError, InputError, Location
from armcal.functions.batch_function import EvaluatorChoice
from armcal.io.plain_files import input_file

from armcal_serve.answers import Answerer
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm

LOOK_S = 0.2  # How often the file is looked at
_ORDINARY_C = 20.0
_WORK_S, _REST_S = 0.001, 0.0015

State = Literal["taken", "loading", "refused", "missing"]
# Takes an event's name, a sentence and its fields, for the program that started the server.
Notify = Callable[[str, str, Mapping[str, Any]], None]


@dataclass
class Loader:
    """Makes answerers of one arm's calibrations, each of which takes over what was compiled for the one before.

    Without ``accept``, the first whose level is lost is refused, and a later one answers every request with that error,
    since those before it are no longer valid either.
    """

    shown: str  # the file, as it is called in messages
    within: str = ""  # a configuration whose plan has limits and clearance; empty: none
    point: Point = "tool"  # what forward and compensate are about: the tool's frame, or the target that was measured
    evaluator: EvaluatorChoice = "compiled"  # ``compiled`` where a compiler is found, or ``interpreted``
    accept: bool = False  # whether one whose level is lost answers as any other
    sequence: int = field(init=False, default=0)  # of the calibration that was loaded last
    _arms: Mapping[str, Any] = field(init=False, default_factory=dict)  # its arms, as it describes them
    _options: dict[str, Options] = field(init=False, default_factory=dict)  # by arm, where there are limits
    _last: Mapping[str, ServedArm] = field(init=False, default_factory=dict)  # by name

    def load(self, data: bytes) -> tuple[Answerer, list[str]]:
        """The answerer of a calibration's bytes, and what its users should know of it."""
        sequence = self.sequence + 1
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("ignore")
            warnings.simplefilter("always", CalibrationWarning)
            calibration = Calibration.load(self.shown, accept=self.accept or sequence > 1, content=data)
        record = calibration.record
        if self._arms and record.arms != self._arms:
            hint = "Put a calibration of the same arm there, or start a server of its own for this one."
            raise ConfigError("it is of another arm.", where=Location(self.shown), hint=hint)
        tag = {
            "sequence": sequence,  # 1 for the one that the server began with, one more for each later one
            "created": record.created,
            "sha256": hashlib.sha256(data).hexdigest(),
            "arm": record.identity.get("arm", ""),
            "recalibrated": (record.recalibrated or {}).get("sequence"),
            "level": record.level,
        }
        answerer = Answerer({name: self._served(calibration, name) for name in calibration.system.arms}, tag)
        warm_up(answerer)
        self.sequence, self._arms, self._last = sequence, record.arms, answerer.arms
        if record.level == "lost" and not self.accept:
            answerer = Answerer(answerer.arms, tag, lost_calibration(record, self.shown))
        return answerer, [str(notice.message) for notice in caught]

    def _served(self, calibration: Calibration, name: str) -> ServedArm:
        arm, statics, before = calibration.system.arms[name], calibration.system.statics, self._last.get(name)
        unserved = [f"{c.name} (effect {name}.{effect})" for effect, c in arm.declared if c.name != TEMPERATURE]
        if unserved:
            text = f"the arm {name} changes with {', '.join(unserved)}, which a request cannot state."
            hint = "Use armcal predict or armcal compensate, which read it from a column."
            raise ConfigError(text, where=Location(self.shown), hint=hint)
        heated = None
        if TEMPERATURE in arm.conditions:
            heated = self._compensator(calibration, name, (TEMPERATURE,), before.heated if before else None)
        needs_payload = arm.depends_on_payload and statics.payload is None
        kept, recorded = calibration.record.prediction, None
        if kept is not None and kept.ranges:
            is_known = needs_payload or statics.payload is not None
            ranges = {channel: ends for channel, ends in kept.ranges.items() if channel != PAYLOAD or is_known}
            recorded = RecordedRange.of(ranges, [*(f"{name}.{joint}" for joint in arm.commanded), PAYLOAD], {name: arm})
        compensator = self._compensator(calibration, name, (), before.compensator if before else None)
        return ServedArm(name, dict(arm.commanded), compensator, needs_payload, heated, self.point, recorded)

    def _compensator(
        self, calibration: Calibration, name: str, conditions: tuple[str, ...], before: Compensator | None
    ) -> Compensator:
        """Made of what was compiled for the calibration before, where it can be."""
        if self.within and name not in self._options:
            from armcal.plugins import discover  # late: not needed without limits
            from armcal.run.plan import options_within

            joints = tuple(calibration.system.arms[name].commanded)
            self._options[name] = options_within(Path(self.within), joints, discover())
        options, like = self._options.get(name), before.expression if before else None
        expression = calibration.expression(name, conditions, self.point, calibration.free, like)
        try:
            return Compensator(expression, calibration.parameters, options, self.evaluator)
        except ValueError as fault:
            hint = "Correct the limits in the plan."
            raise ConfigError(f"{fault}.", where=Location(self.within or self.shown), hint=hint) from fault


def warm_up(answerer: Answerer) -> None:
    """Answer a request of every kind: a request of a client never waits for a compiler."""
    for arm in answerer.arms.values():
        start = arm.written([0.05 * (k + 1) for k in range(len(arm.joints))], "rad")
        known: dict[str, Any] = {"arm": arm.name, "payload_g": 0}
        for request in (known, {**known, TEMPERATURE_KEY: _ORDINARY_C})[: 1 if arm.heated is None else 2]:
            answer = _answer(answerer, {"do": "forward", "joints": start, **request})
            if not answer["ok"] and request is known:
                text = f"the arm {arm.name} cannot be predicted: {answer['error']}"
                raise InputError(text, hint=answer["hint"])
            if answer["ok"]:  # what is ordinary elsewhere may be too hot for this arm
                tool = answer["tools"][0]
                for target in (tool, {"position_mm": tool["position_mm"]}):
                    for more in ({"path": False}, {"path": True}, {"start_joints": start}):
                        _answer(answerer, {"do": "compensate", "targets": target, **more, **request})


def _answer(answerer: Answerer, request: Mapping[str, Any]) -> dict[str, Any]:
    *_, answer = answerer.begin(json.dumps(request).encode(), 0.0)
    return dict(json.loads(answer or b"{}"))


class _Breaks:
    """Makes a thread rest for longer than it works, so that it hardly delays the one that answers."""

    def __init__(self) -> None:
        self._until = 0.0

    def __call__(self, *event: Any) -> None:
        if time.perf_counter() > self._until:
            time.sleep(_REST_S)
            self._until = time.perf_counter() + _WORK_S


class CalibrationFile:
    """A calibration's file, which may be replaced at any time; while it is entered a thread loads what replaces it."""

    def __init__(self, loader: Loader, notify: Notify) -> None:
        self.path = Path(loader.shown)
        self.state: State = "loading"  # of what is there now
        self.why = ""  # a sentence about it where it is not taken
        self.served: Answerer | None = None  # of the last one that could be loaded
        self._loader, self._notify = loader, notify
        self._tried: tuple[int, ...] | None = None
        self._ends = threading.Event()
        self._thread = threading.Thread(target=self._follow, name="armcal-load", daemon=True)

    def __enter__(self) -> Self:
        self._thread.start()
        return self

    def __exit__(self, *fault: object) -> None:
        self._ends.set()
        self._thread.join(1.0)

    def look(self) -> None:
        """Load what is there if it is another file than before."""
        try:
            status = self.path.stat()
        except OSError:
            self._tried = None
            self._not_taken("missing", f"{self.path}: there is no such file; the calibration before is used on.")
            return
        key = (status.st_dev, status.st_ino, status.st_size, status.st_mtime_ns)
        if key != self._tried:
            self._tried = key
            try:
                self.load()
            except ArmcalError as fault:
                self._not_taken("refused", str(fault))

    def load(self) -> None:
        """Load the file, if its bytes are not those that are served."""
        before = self.served
        with input_file(self.path, MAX_BYTES, "a calibration.yaml", ConfigError) as file:
            data = file.read(MAX_BYTES)
        if before is None or hashlib.sha256(data).hexdigest() != before.tag["sha256"]:
            self.state, self.why = "loading", ""
            try:
                self.served, notices = self._loader.load(data)
            except ArmcalError:
                raise
            except Exception as fault:
                text = f"it cannot be used ({type(fault).__name__}: {fault})."
                raise ArmcalError(text, where=Location(str(self.path)), hint="Report it with the file.") from fault
            for notice in notices:
                self._notify("notice", notice, {})
            if before is not None:
                tag = self.served.tag
                level = f", level {tag['level']}" if tag["level"] else ""
                sentence = f"calibration {tag['sequence']} is answered from, of {tag['created']}{level}"
                self._notify("calibration", sentence, {"calibration": tag})
        self.state, self.why = "taken", ""

    def _follow(self) -> None:
        sys.settrace(_Breaks())  # of this thread: called where a function begins
        while not self._ends.wait(LOOK_S):
            self.look()

    def _not_taken(self, state: State, why: str) -> None:
        if (state, why) != (self.state, self.why):
            self._notify(state, f"the new calibration is {state}: {why}", {"why": why})
        self.state, self.why = state, why
