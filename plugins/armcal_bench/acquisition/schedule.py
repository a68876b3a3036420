"""The poses of a plan one after another, and when the servos have to rest first."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.acquisition.drive import JointPath, PathPlanner, travel
from armcal_bench.acquisition.heat import COOLED_TO, NEVER, HeatModel

_SAMPLES = 8


@dataclass(frozen=True)
class Measure:
    """Go to a pose and measure there."""

    pose: int
    path: JointPath
    seconds: float
    thermal_state: Array


@dataclass(frozen=True)
class Rest:
    """Go to where the arm parks and wait there."""

    path: JointPath
    seconds: float
    thermal_state: Array


@dataclass(frozen=True)
class LeaveOut:
    """A pose that cannot be measured, and why."""

    pose: int
    why: str


Next = Measure | Rest | LeaveOut


@dataclass(frozen=True)
class Scheduler:
    """Decides from where the arm stands, how warm its servos are, and what is left.

    Attributes:
        approaches: from which side each joint of a pose is to come (N x joints): 1 from below, -1 from above, 0 either.
    """

    poses: Array  # N x joints, rad
    ids: tuple[str, ...]  # of the poses
    approaches: Array
    park: Array  # where it rests (joints, rad)
    planner: PathPlanner
    model: HeatModel
    rate: float  # of the fastest joint, rad/s
    capture: float  # how long it is expected to stand in a pose, s

    def next(self, at: Array, thermal_state: Array, left: Sequence[int]) -> Next:
        """What to do now; ``left`` are indices of poses, in the plan's order, at least one."""
        step = self._measured(at, thermal_state, left[0])
        return step if isinstance(step, LeaveOut) or self._fits(step) else self._rested(at, thermal_state, left[0])

    def _measured(self, at: Array, thermal_state: Array, pose: int) -> Measure | LeaveOut:
        path = self.planner.find(at, self.poses[pose])
        if path is None:
            return LeaveOut(pose, f"no clear path to pose {self.ids[pose]} was found")
        there = self.model.after(thermal_state, self._effective(path), travel(path) / self.rate)
        after = self.model.after(there, self.model.torques(self.poses[pose]), self.capture)
        return Measure(pose, path, travel(path) / self.rate + self.capture, np.maximum(there, after))

    def _fits(self, step: Measure | LeaveOut) -> bool:
        """Within the budget there, and on the path to where it rests."""
        if isinstance(step, LeaveOut) or self.model.over(step.thermal_state):
            return False
        back = self.planner.find(step.path[-1], self.park)
        if back is None:
            return True
        home = self.model.after(step.thermal_state, self._effective(back), travel(back) / self.rate)
        return not self.model.over(home)

    def _rested(self, at: Array, thermal_state: Array, pose: int) -> Rest | LeaveOut:
        """A rest down to a part of the budget, and on until the pose fits."""
        path = self.planner.find(at, self.park)
        if path is None:
            return LeaveOut(pose, "no clear path to where the arm parks was found")
        home = self.model.after(thermal_state, self._effective(path), travel(path) / self.rate)
        at_rest = self.model.torques(self.park)
        steady = self.model.steady(at_rest)
        if not self._fits(self._measured(self.park, np.minimum(self.model.cold + steady, thermal_state), pose)):
            return LeaveOut(pose, f"pose {self.ids[pose]} needs more torque than the servos bear, even from cold")
        for part in (COOLED_TO, 0.25, 0.1, 0.02):
            limits = np.maximum(part * self.model.budget, 1.02 * steady[:, 0] + 1e-6)
            seconds = self.model.cooled_in(home, at_rest, limits)
            if seconds == NEVER:
                break
            cooled = self.model.after(home, at_rest, seconds)
            if self._fits(self._measured(self.park, cooled, pose)):
                return Rest(path, travel(path) / self.rate + seconds, cooled)
        return LeaveOut(pose, f"the servos do not cool enough for pose {self.ids[pose]} where the arm parks")

    def _effective(self, path: JointPath) -> Array:
        """The torque that heats as the path does on average (joints, N m)."""
        squares, lengths, torques = [], [], self.model.torques
        for start, goal in pairwise(path):
            parts = [torques(start + t * (goal - start)) ** 2 for t in (np.arange(_SAMPLES) + 0.5) / _SAMPLES]
            squares.append(np.mean(parts, axis=0))
            lengths.append(float(np.max(np.abs(goal - start))))
        if not sum(lengths):
            return torques(path[-1])
        return np.asarray(np.sqrt(np.average(squares, axis=0, weights=lengths)))


@dataclass(frozen=True)
class ScheduleForecast:
    """What a run is expected to take."""

    steps: tuple[Next, ...]  # in order
    seconds: float  # from the first move to the last capture
    travel: float  # of the joint that turns most in each move, rad
    resting: float  # s
    hottest: Array  # the largest heat of each joint


def forecast_schedule(scheduler: Scheduler, at: Array, thermal_state: Array, left: Sequence[int]) -> ScheduleForecast:
    """The whole run, as it will be decided step by step if the servos heat as the model says."""
    steps: list[Next] = []
    remaining, seconds, gone, resting, hottest = list(left), 0.0, 0.0, 0.0, scheduler.model.heat(thermal_state)
    while remaining:
        step = scheduler.next(at, thermal_state, remaining)
        steps.append(step)
        if isinstance(step, LeaveOut):
            remaining.remove(step.pose)
            continue
        if isinstance(step, Measure):
            remaining.remove(step.pose)
        else:
            resting += step.seconds
        seconds, gone = seconds + step.seconds, gone + travel(step.path)
        thermal_state, at = step.thermal_state, step.path[-1]
        hottest = np.maximum(hottest, scheduler.model.heat(thermal_state))
    return ScheduleForecast(tuple(steps), seconds, gone, resting, hottest)
