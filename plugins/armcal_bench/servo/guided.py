"""Servos measured without a tracker: somebody says when a joint is at an angle."""

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from armcal_bench.acquisition.tracker_monitor import StopRequested
from armcal_bench.keys import QUIT, Wishes
from armcal_bench.servo.mover import Mover
from armcal_bench.servo.record import ANGLE, LEFT_OUT, Record

_LOOK_S = 0.1


@dataclass(frozen=True)
class Target:
    """An angle (rad) that a joint is to be put at, coming with rising pulses (1) or falling ones (-1)."""

    joint: str
    angle: float
    came: int

    @property
    def key(self) -> tuple[str, int, int]:
        return (self.joint, round(math.degrees(self.angle) * 100), self.came)


@dataclass
class Guided:
    """A calibration by eye. What is in the record is not asked for again."""

    mover: Mover
    wishes: Wishes
    record: Record
    say: Callable[[str], None]

    def run(self) -> None:
        """Ask for all that is left.

        Raises:
            StopRequested: somebody stopped it; the arm holds.
            DeviceError: the device fails.
        """
        targets = self.targets()
        lines = [entry for entry in self.record.entries if "target" in entry]
        done = {Target(line["joint"], line["target"], line["came"]).key for line in lines}
        place = next((i for i, target in enumerate(targets) if target.key not in done), len(targets))
        if place == len(targets):
            return
        self.mover.to_base()
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
        """Each joint at its knots, as far as its range leaves room to come from aside, once from either side.

        A range without such room is measured in its middle.
        """
        targets = []
        for joint in self.mover.setup.joints:
            low, high = self.mover.setup.ranges[joint]
            margin = min(self.mover.setup.settings.approach, (high - low) / 2)
            knots = np.clip(self.mover.setup.knots_of(joint), low + margin, high - margin)
            targets += [Target(joint, angle, came) for angle in sorted(set(knots.tolist())) for came in (1, -1)]
        return targets

    def _ask(self, target: Target) -> str:
        """One target: the wish that ended it, ``ok``, ``skip`` or ``back``."""
        joint, mover = target.joint, self.mover
        pulse = mover.pulse(joint, self._within(joint, mover.counts_at(joint, target.angle)))
        side = "rising" if target.came > 0 else "falling"
        self.say(f"put {joint} at {math.degrees(target.angle):g} deg, coming with {side} pulses")
        while True:
            counts = self._within(joint, round(pulse / mover.pulse(joint, 1)))
            if mover.came.get(joint) != target.came or target.came * (counts - mover.counts[joint]) < 0:
                aside = counts - target.came * mover.approach_counts(joint)
                mover.go(joint, self._within(joint, aside))  # from the target's side, with the play taken up
            mover.go(joint, counts)
            set_us = 1e6 * mover.pulse(joint, mover.counts[joint])
            self.say(f"  {joint}: {1e6 * pulse:.0f} us asked, {set_us:.1f} us set")
            wish = next_wish(self.wishes, mover)
            line = {"joint": joint, "target": target.angle, "came": target.came, "at": mover.clock.wall()}
            if wish == "ok":
                measured = {"angle": target.angle, "sd": self.mover.setup.settings.guided_sd}
                self.record.append(ANGLE, {**line, "counts": mover.counts[joint], **measured})
            elif wish == "skip":
                self.record.append(LEFT_OUT, {**line, "why": "it was skipped"})
            if wish in ("ok", "skip", "back"):
                return wish
            pulse = self._stepped(joint, pulse, wish)

    def _stepped(self, joint: str, pulse: float, wish: str) -> float:
        """A pulse (s) after a step in microseconds; as it was where the step is none, or leads out of the range."""
        try:
            step = float(wish)
        except ValueError:
            step = math.nan
        if not math.isfinite(step):
            self.say(f"  {wish!r} is not known: say a step in us (+10, -1), ok, skip, back or quit")
            return pulse
        stepped = pulse + 1e-6 * step
        low, high = self.mover.setup.pulses_of(joint)
        if not low <= stepped <= high:
            allowed = f"{1e6 * low:.0f} to {1e6 * high:.0f} us, which bench.servo.pulses and the servo's range allow"
            self.say(f"  {1e6 * stepped:.0f} us is outside {allowed}")
            return pulse
        return stepped

    def _within(self, joint: str, counts: int) -> int:
        low, high = self.mover.setup.pulses_of(joint)
        tick = self.mover.pulse(joint, 1)
        return min(max(counts, math.ceil(low / tick)), math.floor(high / tick))


def next_wish(wishes: Wishes, mover: Mover) -> str:
    """What somebody wishes next; the arm holds until then.

    Raises:
        StopRequested: it is the end.
    """
    while True:
        wish = wishes.next(_LOOK_S)
        if wish == QUIT or mover.gate.asked_to_end():
            raise StopRequested("it was asked to stop")
        if wish is not None:
            return wish
        mover.device.keep_alive()
