"""What an arm was made to do, judged by what reaches its servos, and what of it was unsafe."""

import json
from collections import Counter, deque
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.clearance import ClearanceCheck
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.run.experiment import Experiment, clearance_check

from armcal_simulation.bench.servo_model import JointServo, Positive

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
    """Keeps the log.

    Attributes:
        offences: how many, by kind.
        events: how often pulses began (``first_pulse``) and ended under load (``drop``).

    Args:
        settings: what is unsafe.
        experiment: has joint limits and clearances.
        pulses: the range (s) of each joint whose servo takes pulses.
        servos: by joint.
        log: a file that takes a line of JSON for the first offence of each kind and joint, and for every event.
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
        """What reaches a joint's servo changes, while it carries a torque (N m).

        ``before`` and ``after`` are pulses (s) or angles (rad); None: it is let go. ``step`` is the smallest change
        that can be made.
        """
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
        """Both counters, and the worst of each kind: its joint, and its value and limit as in the log.

        A drop's is how far its joint has fallen (rad) until now.
        """
        self.judge_clearance()
        for joint, angle in self._dropped.items():
            fell = self._servos[joint].angle - angle
            self._weigh("drop", abs(fell), joint=joint, value=fell)
        worst = {kind: entry for kind, (_, entry) in self._worst.items()}
        return {"offences": dict(self.offences), "events": dict(self.events), "worst": worst}

    def go_on(self, account: Mapping[str, Any]) -> None:
        """Count on from a summary."""
        self.offences.update(account["offences"])
        self.events.update(account["events"])
        for kind, entry in account["worst"].items():
            self._weigh(kind, abs(entry["value"] - entry.get("limit", 0.0)), **entry)

    def _weigh(self, kind: str, amount: float, **entry: Any) -> None:
        """Remember it if it is the worst of its kind."""
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
