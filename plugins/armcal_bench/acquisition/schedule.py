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
    """Decides from where the arm stands, how warm its servos are, and what is left."""

    poses: Array  # N x joints, rad
    ids: tuple[str, ...]  # of the poses
    approaches: Array  # from which side each joint is to come (N x joints): 1 from below, -1 from above, 0 either
    park: Array  # where it rests (joints, rad)
    planner: PathPlanner
    model: HeatModel
    rate: float  # of the fastest joint, rad/s
    capture: float  # how long it is expected to stand in a pose, s

    def next(self, at: Array, thermal_state: Array, left: Sequence[int]) -> Next:
        """What to do now; ``left`` are indices of poses, in the plan's order, at least one."""
        pose = left[0]
        step = self._measured(at, thermal_state, pose)
        if isinstance(step, LeaveOut) or self._fits(step):
            return step
        path = self.planner.find(at, self.park)
        if path is None:
            return LeaveOut(pose, "no clear path to where the arm parks was found")
        gone, home = self._driven(path, thermal_state)
        at_rest = self.model.torques(self.park)
        steady = self.model.steady(at_rest)[:, 0]
        for part in (COOLED_TO, 0.25, 0.1, 0.02):  # not colder than it has to be: a rest before every pose takes hours
            limits = np.maximum(part * self.model.budget, 1.02 * steady + 1e-6)
            seconds = self.model.cooled_in(home, at_rest, limits)
            if seconds == NEVER:
                return LeaveOut(pose, f"the servos do not cool enough for pose {self.ids[pose]} where the arm parks")
            cooled = self.model.after(home, at_rest, seconds)
            if self._fits(self._measured(self.park, cooled, pose)):
                return Rest(path, gone + seconds, cooled)
        return LeaveOut(pose, f"pose {self.ids[pose]} needs more torque than the servos bear, even from cold")

    def _measured(self, at: Array, thermal_state: Array, pose: int) -> Measure | LeaveOut:
        path = self.planner.find(at, self.poses[pose])
        if path is None:
            return LeaveOut(pose, f"no clear path to pose {self.ids[pose]} was found")
        gone, there = self._driven(path, thermal_state)
        after = self.model.after(there, self.model.torques(self.poses[pose]), self.capture)
        return Measure(pose, path, gone + self.capture, np.maximum(there, after))

    def _fits(self, step: Measure | LeaveOut) -> bool:
        """Within the budget there, and on the path to where it rests."""
        if isinstance(step, LeaveOut) or self.model.over(step.thermal_state):
            return False
        back = self.planner.find(step.path[-1], self.park)
        return back is None or not self.model.over(self._driven(back, step.thermal_state)[1])

    def _driven(self, path: JointPath, thermal_state: Array) -> tuple[float, Array]:
        """How long a path takes (s), and how warm it leaves the servos, by the torque that heats like it."""
        squares, lengths, torques = [], [], self.model.torques
        for start, goal in pairwise(path):
            parts = [torques(start + t * (goal - start)) ** 2 for t in (np.arange(_SAMPLES) + 0.5) / _SAMPLES]
            squares.append(np.mean(parts, axis=0))
            lengths.append(float(np.max(np.abs(goal - start))))
        if not (length := sum(lengths)):
            return 0.0, thermal_state
        effective = np.sqrt(np.average(squares, axis=0, weights=lengths))
        return length / self.rate, self.model.after(thermal_state, effective, length / self.rate)


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
    remaining, heats = list(left), [scheduler.model.heat(thermal_state)]
    while remaining:
        step = scheduler.next(at, thermal_state, remaining)
        steps.append(step)
        if not isinstance(step, Rest):
            remaining.remove(step.pose)
        if not isinstance(step, LeaveOut):
            thermal_state, at = step.thermal_state, step.path[-1]
            heats.append(scheduler.model.heat(thermal_state))
    driven = [step for step in steps if not isinstance(step, LeaveOut)]
    resting = sum(step.seconds for step in driven if isinstance(step, Rest))
    gone, seconds = sum(travel(step.path) for step in driven), sum(step.seconds for step in driven)
    return ScheduleForecast(tuple(steps), seconds, gone, resting, np.max(heats, axis=0))
