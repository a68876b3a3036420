"""A servo: it drives to the angle that it is commanded, as fast as it can, gives way under its load, and heats.

Two nodes carry its heat, in units in which a steady loss of 1 heats the winding by 1 above the air:
``loss = (torque / continuous)^2``. The winding lies inside the case, which the air cools; heat 1 is its limit.
And what an arm was made to do, judged by what reaches its servos.
"""

import json
import math
from bisect import bisect_right
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from armcal.arm.clearance import ClearanceCheck
from armcal.arm.servo import PulseTable
from armcal.base.settings import Angle, Duration, Length, Settings, Torque
from armcal.run.experiment import Experiment, clearance_check
from pydantic import Field, model_validator

Positive = Annotated[float, Field(gt=0)]
_NEAR = 1e-12
_HEAT_STEP = 0.05
"""Of the shorter time constant: an explicit step this short stays within some thousandths of the exact course."""


class ServoJointSettings(Settings):
    """What kind of servo drives a joint.

    ``dead_band``: errors of this size or less do not make it move. ``backlash`` is the whole gap between gear and horn,
    ``travel`` where its stops are. A load above ``stall`` turns it; unpowered it gives way to torques above
    ``friction``, at ``fall_deg_per_s``. Steadily under ``continuous`` torque its winding reaches its limit; beyond
    that it fails. ``winding_share`` of that rise lies between winding and case. ``winding_time`` and ``case_time`` are
    the time constants of each node against what it gives its heat to. Under its load the horn slips on the gear by
    ``creep_deg_per_min`` for each N m, as with a loose screw. Its load turns it by ``compliance_deg_per_Nm`` while it
    holds. An encoder on the gear, where the device reads one, sees that, and has ``encoder_noise``.

    Of servos without a pulse table a device does not know that at the commanded angle zero the joint stands at
    ``zero_off``, and ``horn_teeth`` further; one that is ``reversed`` turns it the other way.
    """

    speed_deg_per_s: Positive = 300.0
    dead_band: Annotated[Angle, Field(ge=0)] = 0.0
    backlash: Annotated[Angle, Field(ge=0)] = 0.0
    travel: tuple[Angle, Angle] = (-2.4, 2.4)
    creep_deg_per_min: Annotated[float, Field(ge=0)] = 0.0
    stall: Annotated[Torque, Field(gt=0)] = 4.0
    friction: Annotated[Torque, Field(ge=0)] = 0.05
    fall_deg_per_s: Positive = 60.0
    continuous: Annotated[Torque, Field(gt=0)] = 1.5
    winding_time: Annotated[Duration, Field(gt=0)] = 60.0
    case_time: Annotated[Duration, Field(gt=0)] = 900.0
    winding_share: Annotated[float, Field(gt=0, lt=1)] = 0.3
    compliance_deg_per_Nm: Annotated[float, Field(ge=0)] = 0.0
    encoder_noise: Annotated[Angle, Field(ge=0)] = 4.6e-4
    zero_off: Angle = 0.0
    horn_teeth: int = 0
    reversed: bool = False

    @model_validator(mode="after")
    def _physical(self) -> Self:
        if not self.travel[0] < self.travel[1]:
            raise ValueError("the ends of travel are not in rising order: give [lowest, highest]")
        return self

    @property
    def heat_capacities(self) -> tuple[float, float]:
        return self.winding_time / self.winding_share, self.case_time / (1 - self.winding_share)


class JointServo:
    """One servo under a load.

    ``angle`` (rad) is of its horn, ``shaft`` of the gear, ahead of backlash; ``approach`` the sign of its last motion.
    With a ``table`` it takes pulses (s), else angles.
    """

    def __init__(self, settings: ServoJointSettings, angle: float, table: PulseTable | None = None) -> None:
        self.settings, self.angle, self.approach, self.failed = settings, angle, 0, False
        self.target: float | None = None
        self.stops = settings.travel
        self._horn, self._slipped, self._creep = angle, 0.0, math.radians(settings.creep_deg_per_min) / 60.0
        self.shaft = angle
        self._driving = False
        self._compliance = math.radians(settings.compliance_deg_per_Nm)
        self._speed, self._fall_speed = math.radians(settings.speed_deg_per_s), math.radians(settings.fall_deg_per_s)
        self._pulses: tuple[float, ...] = ()
        if table is not None:
            order = slice(None, None, 1 if table.pulses[0] < table.pulses[-1] else -1)
            self._pulses, self._angles = table.pulses[order], table.angles[order]

    @property
    def powered(self) -> bool:
        return self.target is not None and not self.failed

    def angle_of(self, command: float) -> float:
        """The angle (rad) that a command asks for: itself, or of a pulse (s), linear between knots and beyond them."""
        if not self._pulses:
            return command
        at = min(max(bisect_right(self._pulses, command), 1), len(self._pulses) - 1)
        p0, p1, a0, a1 = self._pulses[at - 1], self._pulses[at], self._angles[at - 1], self._angles[at]
        return a0 + (command - p0) * (a1 - a0) / (p1 - p0)

    def command(self, command: float | None) -> None:
        before, (low, high) = self.target, self.stops
        self.target = None if command is None else min(max(self.angle_of(command), low), high)
        if self._compliance and before is not None and self.target not in (None, before):
            self.approach = 1 if self.target > before else -1

    def put(self, angle: float) -> None:
        if not self.powered:
            self.shaft = self._horn = self.angle = angle

    def rests(self, torque: float) -> bool:
        """Whether it stays where it is under a torque (N m), as it is driven now."""
        if self.holds(torque):
            error = abs(self._aim(torque) - self.shaft)
            return error <= _NEAR or not (self._driving or error > self.settings.dead_band)
        low, high = self.stops
        at_stop = self.shaft >= high - _NEAR if torque > 0 else self.shaft <= low + _NEAR
        return at_stop or abs(torque) <= self.settings.friction

    def gives_way(self, torque: float) -> bool:
        """Whether the torque on it (N m) must be looked up at short intervals: it turns under its load."""
        return not self.holds(torque) and (self.powered or not self.rests(torque))

    def advance(self, seconds: float, torque: float) -> bool:
        """Let time pass under a torque of its load (N m, turning towards larger angles); whether it moved."""
        slips = bool(self._creep and self.powered and torque)
        if slips:  # the horn, on the gear
            self._slipped += self._creep * torque * seconds
            self.angle = self._horn + self._slipped
        if self.rests(torque):
            return slips
        before = self.shaft
        if self.holds(torque):
            error, step = self._aim(torque) - before, self._speed * seconds
            self._driving = abs(error) > step
            self.shaft += math.copysign(step, error) if self._driving else error
        else:
            step = self._fall_speed * seconds
            low, high = self.stops
            self.shaft = min(max(before + (step if torque > 0 else -step), low), high)
        moved = self.shaft - before
        if moved and not (self._compliance and self.powered):  # what its load turns it by is no motion of its own
            self.approach = 1 if moved > 0 else -1
        # the gear pushes the horn at one end of the gap
        half = self.settings.backlash / 2
        self._horn = min(max(self._horn, self.shaft - half), self.shaft + half)
        self.angle = self._horn + self._slipped
        return bool(moved) or slips

    def holds(self, torque: float) -> bool:
        return self.powered and abs(torque) <= self.settings.stall

    def _aim(self, torque: float) -> float:
        low, high = self.stops
        return min(max((self.target or 0.0) + self._compliance * torque, low), high)


class ServoHeat:
    """Temperatures of winding and case above the air, as fractions of the winding's limit."""

    def __init__(self, settings: ServoJointSettings) -> None:
        self.winding, self.case = 0.0, 0.0
        self._settings, self._capacities = settings, settings.heat_capacities
        self._longest = _HEAT_STEP * min(settings.winding_time, settings.case_time)

    def advance(self, seconds: float, torque: float) -> None:
        share, (winding_capacity, case_capacity) = self._settings.winding_share, self._capacities
        loss = (torque / self._settings.continuous) ** 2
        while seconds > 0:
            step = min(seconds, self._longest)
            to_case = (self.winding - self.case) / share
            to_air = self.case / (1 - share)
            self.winding += step * (loss - to_case) / winding_capacity
            self.case += step * (to_case - to_air) / case_capacity
            seconds -= step


SPEED_SLACK = 1.05
_TICK_S = 0.02  # hosts command at ticks: a command of a window's first moment may be of one tick before
_AT_ONCE = 512
_AT_REST_S = 1.0
_NO_TIME = -1e9
_FOUND_RAD = 0.02
"""A first pulse that turns its joint by less takes it up where it stands: beyond a limit, that is nobody's offence."""


class SafetySettings(Settings):
    """What the arm must not be made to do, judged by the true servos.

    The commanded speed over ``window`` may be above ``rate_deg_per_s`` by a twentieth and one count. Joint limits and
    clearances are the plan's, less what a host cannot know of the true tables. Pulses are those that the true servo
    file's servos bear, less what a host cannot know of the true oscillator. A joint that is taken up where it stands,
    beyond a limit or too near to something, may stay there and come back, and go no further. Two joints whose pulses
    begin within ``together`` were not energised one at a time.
    """

    rate_deg_per_s: Positive = 20.0
    window: Duration = 0.25
    limits_slack: Angle = 0.035
    clearance_slack: Length = 0.005
    pulse_slack: Duration = 2e-5
    together: Duration = 0.1


class Safety:
    """Counts offences by kind, and events: pulses that begin (``first_pulse``) or end under load (``drop``).

    The log has a line for the first offence of each kind and joint, and for every event.
    """

    def __init__(
        self,
        settings: SafetySettings,
        experiment: Experiment,
        pulses: Mapping[str, tuple[float, float]],
        servos: Mapping[str, JointServo],
        log: Path,
    ) -> None:
        self.offences: Counter[str] = Counter()
        self.events: Counter[str] = Counter()
        self._settings, self._servos, self._log, self._pulses = settings, servos, log, pulses
        self._limits: Mapping[str, tuple[float, float]] = {}
        self._clearance: ClearanceCheck | None = None
        if (plan := experiment.settings.plan) is not None:
            self._limits = plan.limits
            if plan.clearance:
                self._clearance = clearance_check(plan.clearance, experiment.system.arms, experiment.source)
        self._commanded: dict[str, float] = {}
        self._past: dict[str, deque[tuple[float, float]]] = {joint: deque() for joint in servos}
        self._first_pulse: tuple[float, str] = (_NO_TIME, "")
        self._logged: set[tuple[str, str]] = set()
        self._worst: dict[str, tuple[float, dict[str, Any]]] = {}
        self._dropped: dict[str, float] = {}
        self._moved = self._taken_up = False
        self._beyond: dict[str, float] = {}
        self._inherited = 0.0
        self._poses: list[tuple[float, bool, list[float]]] = []

    def committed(
        self, joint: str, now: float, before: float | None, after: float | None, step: float, torque: float
    ) -> None:
        """``before`` and ``after`` are pulses (s) or angles (rad), None: let go; ``step`` is their smallest change."""
        servo, settings = self._servos[joint], self._settings
        if after is None:
            self._commanded.pop(joint, None)
            self._past[joint].clear()
            if abs(torque) > servo.settings.friction:
                self._dropped[joint] = servo.angle
                self._note("drop", joint, now, torque)
            return
        angle = servo.angle_of(after)
        if before is None:
            last, other = self._first_pulse
            if other != joint and now - last < settings.together * (1 - 1e-9):
                self._offend("energised_together", joint, now, now - last, settings.together)
            self._first_pulse, jump = (now, joint), angle - servo.angle
            self._dropped.pop(joint, None)
            self._beyond.pop(joint, None)
            if abs(jump) < _FOUND_RAD:
                self._beyond[joint], self._taken_up = angle, True
            self._weigh("first_pulse", abs(jump), joint=joint, value=jump)
            self._note("first_pulse", joint, now, jump)
        else:
            self._judge_speed(joint, now, angle, abs(servo.angle_of(after + step) - angle))
        self._commanded[joint] = angle
        self._past[joint].append((now, angle))
        judged = (
            ("limits", angle, self._limits, settings.limits_slack),
            ("pulse", after, self._pulses, settings.pulse_slack),
        )
        for kind, value, bounds, slack in judged:
            low, high = bounds.get(joint, (-np.inf, np.inf))
            if kind == "limits" and joint in self._beyond:
                if low <= value <= high:
                    del self._beyond[joint]
                low, high = min(low, self._beyond.get(joint, low)), max(high, self._beyond.get(joint, high))
            if not low - slack <= value <= high + slack:
                self._offend(kind, joint, now, value, low - slack if value < low else high + slack)
        self._moved = True

    def failed(self, joint: str, now: float, heat: float) -> None:
        self._offend("heat", joint, now, heat, 1.0)

    def passed(self, now: float) -> None:
        """Time goes on from here: the arm is driven to what the pins command now."""
        if not self._moved or self._clearance is None:
            if self._poses and now - self._poses[-1][0] > _AT_REST_S:
                self.judge_clearance()
            return
        self._moved = False
        if len(self._commanded) == len(self._servos):
            self._poses.append((now, self._taken_up, [self._commanded[joint] for joint in self._servos]))
            self._taken_up = False
            if len(self._poses) >= _AT_ONCE:
                self.judge_clearance()

    def judge_clearance(self) -> None:
        check, poses = self._clearance, self._poses
        if check is None or not poses:
            return
        margins = check(np.array([angles for _, _, angles in poses]).T).margins.min(axis=0)
        self._poses = []
        for (now, taken_up, _), margin in zip(poses, margins.tolist(), strict=True):
            self._inherited = min(0.0, margin) if taken_up else max(self._inherited, min(0.0, margin))
            limit = self._inherited - self._settings.clearance_slack
            if margin < limit:
                self._offend("clearance", "", now, margin, limit)

    def summary(self) -> dict[str, Any]:
        """The worst of each kind is as in the log; of a drop, how far its joint has fallen (rad) until now."""
        self.judge_clearance()
        for joint, angle in self._dropped.items():
            fell = self._servos[joint].angle - angle
            self._weigh("drop", abs(fell), joint=joint, value=fell)
        worst = {kind: entry for kind, (_, entry) in self._worst.items()}
        return {"offences": dict(self.offences), "events": dict(self.events), "worst": worst}

    def go_on(self, account: Mapping[str, Any]) -> None:
        self.offences.update(account["offences"])
        self.events.update(account["events"])
        for kind, entry in account["worst"].items():
            self._weigh(kind, abs(entry["value"] - entry.get("limit", 0.0)), **entry)

    def _weigh(self, kind: str, amount: float, **entry: Any) -> None:
        if kind not in self._worst or amount > self._worst[kind][0]:
            self._worst[kind] = amount, entry

    def _judge_speed(self, joint: str, now: float, angle: float, count: float) -> None:
        window, past = self._settings.window, self._past[joint]
        while len(past) > 1 and past[1][0] <= now - window:
            past.popleft()
        most = np.radians(self._settings.rate_deg_per_s)
        worst = 0.0
        for since, before in past:
            seconds = min(max(now - since, window), window + _TICK_S)
            worst = max(worst, (abs(angle - before) - count) / seconds)
        if worst > SPEED_SLACK * most:
            self._offend("speed", joint, now, worst, SPEED_SLACK * most)

    def _offend(self, kind: str, joint: str, now: float, value: float, limit: float) -> None:
        self.offences[kind] += 1
        self._weigh(kind, abs(value - limit), joint=joint, value=value, limit=limit)
        if (kind, joint) in self._logged:
            return
        self._logged.add((kind, joint))
        self._write(time=now, offence=kind, joint=joint or None, value=value, limit=limit)

    def _note(self, kind: str, joint: str, now: float, value: float) -> None:
        self.events[kind] += 1
        self._write(time=now, event=kind, joint=joint, value=value)

    def _write(self, **content: object) -> None:
        self._log.parent.mkdir(parents=True, exist_ok=True)
        with self._log.open("a", encoding="utf-8") as file:
            file.write(json.dumps({key: value for key, value in content.items() if value is not None}) + "\n")
