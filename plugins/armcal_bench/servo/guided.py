"""Servos measured without a tracker: somebody says when a joint is at an angle."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from armcal_bench.servo.keys import QUIT, Wishes
from armcal_bench.servo.mover import Mover, StoppedError
from armcal_bench.servo.record import ANGLE, LEFT_OUT, Record
from armcal_bench.servo.setup import Setup
from armcal_bench.servo.sweep import approach_counts, to_base

_LOOK_S = 0.1


@dataclass(frozen=True)
class Target:
    """An angle (rad) that a joint is to be put at, coming with rising pulses (1) or falling ones (-1)."""

    joint: str
    angle: float
    came: int

    @property
    def key(self) -> tuple[str, int, int]:
        """Tells it from others, angles to a hundredth of a degree."""
        return (self.joint, round(math.degrees(self.angle) * 100), self.came)


@dataclass
class Guided:
    """A calibration by eye. What is in the record is not asked for again."""

    setup: Setup
    mover: Mover
    wishes: Wishes
    record: Record
    say: Callable[[str], None]

    def run(self) -> None:
        """Ask for all that is left.

        Raises:
            StoppedError: somebody stopped it; the arm holds.
            DeviceError: the device fails.
        """
        targets = self.targets()
        done = {key_of(entry) for entry in self.record.entries if "target" in entry}
        place = next((i for i, target in enumerate(targets) if target.key not in done), len(targets))
        if place == len(targets):
            return
        to_base(self.setup, self.mover)
        while place < len(targets):
            if targets[place].key in done:
                place += 1
                continue
            if self._ask(targets[place]) == "back":
                place = max(place - 1, 0)
                done.discard(targets[place].key)
            else:
                done.add(targets[place].key)

    def targets(self) -> list[Target]:
        """Each joint at its knots, as far as its range leaves room to come from aside, once from either side."""
        found = []
        for joint in self.setup.joints:
            low, high = self._inner(joint)
            for angle in sorted({float(np.clip(knot, low, high)) for knot in self.setup.knots_of(joint)}):
                found += [Target(joint, angle, 1), Target(joint, angle, -1)]
        return found

    def _inner(self, joint: str) -> tuple[float, float]:
        """The range (rad) less what an angle is come to from aside; its middle where there is no such room."""
        low, high = self.setup.ranges[joint]
        margin = min(self.setup.settings.approach, (high - low) / 2)
        return low + margin, high - margin

    def _ask(self, target: Target) -> str:
        """One target: the wish that ended it, ``ok``, ``skip`` or ``back``."""
        joint, mover = target.joint, self.mover
        pulse = mover.pulse(joint, self._within(joint, mover.counts_at(joint, target.angle)))
        self.say(f"put {joint} at {math.degrees(target.angle):g} deg, coming with {_side(target.came)} pulses")
        while True:
            self._come(target, self._within(joint, round(pulse / mover.pulse(joint, 1))))
            self.say(f"  {joint}: {1e6 * pulse:.0f} us asked, {1e6 * mover.pulse(joint, mover.told[joint]):.1f} us set")
            wish = self._wish()
            if wish == "ok":
                said = {"angle": target.angle, "sd": self.setup.settings.guided_sd}
                self.record.append(ANGLE, {**self._here(target), "counts": mover.told[joint], **said})
                return wish
            if wish == "skip":
                self.record.append(LEFT_OUT, {**self._here(target), "why": "it was skipped"})
                return wish
            if wish == "back":
                return wish
            pulse = self._changed(joint, pulse, wish)

    def _changed(self, joint: str, pulse: float, wish: str) -> float:
        try:
            step = float(wish)
        except ValueError:
            step = math.nan
        if not math.isfinite(step):
            self.say(f"  {wish!r} is not known: say a step in us (+10, -1), ok, skip, back or quit")
            return pulse
        wanted = pulse + 1e-6 * step
        low, high = self.setup.pulses_of(joint)
        if not low <= wanted <= high:
            allowed = f"{1e6 * low:.0f} to {1e6 * high:.0f} us, which bench.servo.pulses and the servo's range allow"
            self.say(f"  {1e6 * wanted:.0f} us is outside {allowed}")
            return pulse
        return wanted

    def _come(self, target: Target, counts: int) -> None:
        """To a pulse from the target's side, with the play taken up."""
        joint, mover = target.joint, self.mover
        if mover.came.get(joint) != target.came or target.came * (counts - mover.told[joint]) < 0:
            aside = counts - target.came * approach_counts(self.setup, mover, joint)
            mover.go(joint, self._within(joint, aside))
        mover.go(joint, counts)

    def _within(self, joint: str, counts: int) -> int:
        """The nearest counts that are allowed."""
        low, high = self.setup.pulses_of(joint)
        tick = self.mover.pulse(joint, 1)
        return min(max(counts, math.ceil(low / tick)), math.floor(high / tick))

    def _wish(self) -> str:
        while True:
            wish = self.wishes.next(_LOOK_S)
            if wish == QUIT or self.mover.asked_to_stop():
                raise StoppedError("it was asked to stop")
            if wish is not None:
                return wish
            self.mover.device.keep_alive()

    def _here(self, target: Target) -> dict[str, Any]:
        return {
            "joint": target.joint,
            "target": target.angle,
            "came": target.came,
            "at": self.mover.clock.wall(),
        }


def key_of(entry: Mapping[str, Any]) -> tuple[str, int, int]:
    """Which target a line of the record is about."""
    return Target(str(entry["joint"]), float(entry["target"]), int(entry["came"])).key


def _side(came: int) -> str:
    return "rising" if came > 0 else "falling"
