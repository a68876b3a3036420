"""Servos measured by a tracker, one joint at a time: up over its range and down again."""

from collections.abc import Callable, Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import InputError, Location

from armcal_bench.acquisition.heat import ThermalLimit
from armcal_bench.acquisition.tracker_monitor import StopRequested, TrackerLost
from armcal_bench.measured_frame import FrameMistake, frame_mistake
from armcal_bench.servo.mover import Mover
from armcal_bench.servo.record import LEFT_OUT, POSE, Record
from armcal_bench.settling import Settled

_MOST_RESTLESS = 3
_LOOKED_AT_EVERY_S = 1.0
_FAR_GAIN = 8.0
"""Of lengths: in sweeps of one joint after the other a reversed servo resembles a frame with a smaller one."""

ReportProgress = Callable[[str, int, int], None]
"""Takes the joint, and how many of its points are done and planned."""


@dataclass(frozen=True)
class Point:
    """A pulse, and from where it is come to: 1 with rising pulses, -1 with falling ones."""

    joint: str
    counts: int
    came: int


def sweep(mover: Mover, joint: str) -> list[Point]:
    """Rising pulses first, then falling ones, as many of the range as leave room to come from either side."""
    setup = mover.setup
    low, high = setup.ranges[joint]
    margin = setup.settings.approach
    shortest, longest = setup.pulses_of(joint)
    steps = max(round((high - low - 2 * margin) / setup.settings.step), 1)
    at_angles = {mover.counts_at(joint, angle) for angle in np.linspace(low + margin, high - margin, steps + 1)}
    room = mover.approach_counts(joint)
    fits = [
        counts
        for counts in sorted(at_angles)
        if mover.pulse(joint, counts - room) >= shortest and mover.pulse(joint, counts + room) <= longest
    ]
    return [Point(joint, c, 1) for c in fits] + [Point(joint, c, -1) for c in reversed(fits)]


def left(points: Iterable[Point], entries: Iterable[Mapping[str, Any]]) -> list[Point]:
    done = {Point(e["joint"], e["counts"], e["came"]) for e in entries if "counts" in e}
    return [point for point in points if point not in done]


@dataclass
class FrameWatch:
    """Where the target was seen in poses that were commanded, whether the arm stood or not.

    Attributes:
        expected: ``base_T_tool`` of the rigid arm in each pose (4 x 4, m).
        seen: ``base_T_target`` there, in whatever units and frame the tracker gives it.
    """

    mover: Mover
    expected: list[Array] = field(default_factory=list)
    seen: list[Array] = field(default_factory=list)

    def look(self, pose: Mapping[str, float]) -> None:
        """The arm was commanded to this pose (rad by joint); nothing where the target was not seen since."""
        monitor = self.mover.gate.monitor
        if monitor is not None and (stand := monitor.stand()) is not None:
            self.expected.append(self.mover.setup.nominal.tool(pose))
            self.seen.append(stand.base_T_target)

    def mistake(self) -> FrameMistake | None:
        """What is wrong with the tracker's units or handedness; None where nothing is, or too few poses tell."""
        return frame_mistake(np.array(self.expected), np.array(self.seen))


class Restless(StopRequested):
    """Time after time the arm does not come to stand: a servo stalls, or has let go."""


@dataclass
class Automatic:
    """A tracked calibration. What is in the record is not measured again."""

    mover: Mover
    record: Record
    report: ReportProgress

    def __post_init__(self) -> None:
        self._frame, self._first, self._restless = FrameWatch(self.mover), len(self.record.entries), 0

    def run(self) -> None:
        """Measure all that is left; the arm ends in its base pose.

        Raises:
            InputError: the tracker's units are not those expected; the arm is in its base pose.
            StopRequested: it was asked for, and the arm holds; or the tracker stays away, or the arm does not come to
                stand: then it is in its base pose.
            DeviceLost: the device is gone and does not come back.
        """
        mover = self.mover
        sweeps = {joint: sweep(mover, joint) for joint in mover.setup.joints}
        if not any(left(points, self._done) for points in sweeps.values()):
            return
        try:
            mover.persist(mover.to_base)
            mover.guard(mover.setup.base)
            for joint, points in sweeps.items():
                for point in left(points, self._done):
                    mover.persist(partial(self._measure, point))
                    self.report(joint, len(points) - len(left(points, self._done)), len(points))
                mover.persist(mover.to_base)
            mover.guard({})
        except (TrackerLost, Restless, InputError) as stop:
            # Nobody may be there for hours, and it could hold a heavy pose.
            mover.gate = replace(mover.gate, monitor=None)  # it may be what failed
            mover.persist(mover.to_base)
            if isinstance(stop, StopRequested):
                stop.arm = "the arm is commanded to hold its base pose"
            raise

    @property
    def _done(self) -> list[Mapping[str, Any]]:
        """Lines of points that are not to be measured now; what an earlier run left out is tried once more."""
        lines = enumerate(self.record.entries)
        return [line for i, line in lines if i >= self._first or line["kind"] != LEFT_OUT]

    def _settled(self, point: Point) -> Settled | str:
        """Where the tool stands at a point, or why that is not known. Servos that get hot rest in the base pose."""
        mover, thermal_state = self.mover, self.mover.thermal_state
        waits, now, acquisition = mover.gate.waits, mover.clock.now, mover.setup.bench.settings.acquisition

        def check_heat() -> None:
            if mover.gate.has_trouble and thermal_state.must_rest:
                raise ThermalLimit("a servo has to rest before the tracker is back")

        while True:
            if thermal_state.must_rest:
                mover.to_base()
                while (left_s := thermal_state.rest_s) > 0:
                    waits.goes_on("rest", "the servos cool in the base pose", left_s, now())
                    mover.stand(min(left_s, _LOOKED_AT_EVERY_S), mover.gate.resting)
                waits.over("rest", now())
            mover.come_to(point.joint, point.counts, point.came)
            with suppress(ThermalLimit):
                return mover.gate.settled(mover.tick, acquisition.settle.longest, check_heat)

    def _measure(self, point: Point) -> None:
        mover, settled = self.mover, self._settled(point)
        line: dict[str, Any] = {"joint": point.joint, "counts": point.counts, "came": point.came}
        line["at"], line["warmth"] = mover.clock.wall(), mover.thermal_state.by_joint
        line["told"] = mover.angles
        self._check_frame()
        if isinstance(settled, str):
            self.record.append(LEFT_OUT, {**line, "why": settled})
            self._restless += 1
            if self._restless >= _MOST_RESTLESS:
                text = f"{point.joint} did not stop moving {self._restless} times in a row ({settled})"
                raise Restless(f"{text}: does a servo stall, or let go?")
            return
        deviations = [float(d) if np.isfinite(d) else None for d in settled.deviations]
        self.record.append(POSE, {**line, **settled.record, "deviations": deviations, "frames": settled.frames})
        self._restless = 0

    def _check_frame(self) -> None:
        """Refuse other units than expected. A left-handed frame cannot be told from a reversed servo, one by one.

        Raises:
            InputError: they are others. What was measured so far by this run is set aside.
        """
        self._frame.look(self.mover.angles)
        mistake = self._frame.mistake()
        if mistake is None or 1 / _FAR_GAIN < mistake.frame.gain < _FAR_GAIN:
            return
        hint = f"{mistake.mend} Then give another --out."
        if self._first <= 1:
            hint = f"{mistake.mend} Then give the same command: what was measured is kept as "
            hint += f"{self.record.set_aside().name}, and not used."
        raise InputError(f"{mistake.sentence}.", where=Location(str(self.record.path)), hint=hint)
