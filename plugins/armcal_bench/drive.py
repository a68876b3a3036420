"""Moving the arm: along clear paths, never faster than its rate, with the path home known to the board."""

import heapq
import math
from collections.abc import Callable, Mapping, Sequence
from functools import cached_property
from itertools import pairwise

import numpy as np
from armcal.arm.clearance import ClearanceCheck
from armcal.base.arrays import Array
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceRefusedError, JointDevice, measured_angles, standing_at, state_of

from armcal_bench.bench import AcquisitionSettings
from armcal_bench.hazards import HeatModel, ThermalState
from armcal_bench.run_log import ENERGISED, Log
from armcal_bench.tracker_monitor import MayMove, unguarded

_SPREAD = 256
_TRIED_AT_ONCE = 24
_ESCAPES = 32
_NEARER_M = 1e-6

JointPath = tuple[Array, ...]
"""Joint angles to go through in turn, in straight lines of joint space; the start is the first."""


class PathPlanner:
    """Straight lines where they are clear; else a lazy roadmap through ``known`` poses and others. [Bohlin2000]"""

    def __init__(self, check: ClearanceCheck | None, limits: Array, known: Array, step: float, seed: int = 0) -> None:
        self._check, self._limits, self._known, self._step, self._seed = check, limits, known, step, seed
        self._clear: dict[frozenset[bytes], bool] = {}
        self.meanwhile: Callable[[], None] = lambda: None  # called during a search, which may take seconds

    def allowed(self, pose: Array) -> bool:
        return self._check is None or bool(self._check(pose[:, None]).allowed[0])

    def within(self, pose: Array) -> bool:
        return bool(np.all((pose >= self._limits[:, 0]) & (pose <= self._limits[:, 1])))

    def trouble(self, joints: Sequence[str], pose: Array) -> str:
        rows = zip(joints, np.degrees(pose), np.degrees(self._limits), strict=True)
        parts = [
            f"{joint} stands at {angle:.1f} deg, beyond {low:.1f} to {high:.1f} deg"
            for joint, angle, (low, high) in rows
            if not low <= angle <= high
        ]
        return ", ".join([*parts, *filter(None, [self._check.worst(pose) if self._check else ""])])

    def clear(self, start: Array, goal: Array) -> bool:
        if self._check is None:
            return True
        key = frozenset((start.tobytes(), goal.tobytes()))
        if key not in self._clear:
            self.meanwhile()
            self._clear[key] = bool(self._check(self._line(start, goal)).allowed.all())
        return self._clear[key]

    def _line(self, start: Array, goal: Array) -> Array:
        count = int(np.ceil(np.max(np.abs(goal - start)) / self._step)) + 1
        return np.asarray(start[:, None] + np.linspace(0.0, 1.0, max(count, 2)) * (goal - start)[:, None])

    def find(self, start: Array, goal: Array) -> JointPath | None:
        """A clear path, or None if none was found.

        An arm that stands too near to something, by a board's rounding or after a fault, first goes straight to a pose
        that is clear, on a line that comes nowhere nearer than where the arm stands.
        """
        if self._check is None or self.clear(start, goal):
            return (start, goal)
        if self.allowed(start):
            return self._shortest(np.vstack([start[None], goal[None], self._roadmap]))
        nodes = np.vstack([goal[None], self._roadmap])
        away = np.max(np.abs(nodes - start), axis=1)
        for node in nodes[np.argsort(away, kind="stable")[:_ESCAPES]]:
            if not self.allowed(node):
                continue
            margins = np.minimum(self._check(self._line(start, node)).margins, 0.0)
            if np.all(np.diff(margins, axis=1) >= -_NEARER_M) and (onward := self.find(node, goal)) is not None:
                return (start, *onward)
        return None

    @cached_property
    def _roadmap(self) -> Array:
        from scipy.stats import qmc

        drawn = qmc.Sobol(len(self._limits), rng=self._seed).random(_SPREAD)
        poses = self._limits[:, 0] + drawn * (self._limits[:, 1] - self._limits[:, 0])
        nodes = np.vstack([self._known, poses])
        if self._check is not None:
            nodes = nodes[self._check(np.ascontiguousarray(nodes.T)).allowed]
        return np.unique(nodes, axis=0)

    def _shortest(self, nodes: Array) -> JointPath | None:
        """A* from the first node to the second; the length of a line is that of the joint that turns most."""
        left = np.max(np.abs(nodes - nodes[1]), axis=1)
        best, before, done = {0: 0.0}, {0: 0}, set()
        queue = [(float(left[0]), 0)]
        while queue:
            _, here = heapq.heappop(queue)
            if here == 1:
                path = [here]
                while path[-1] != 0:
                    path.append(before[path[-1]])
                return tuple(nodes[i] for i in reversed(path))
            if here in done:
                continue
            done.add(here)
            away = np.max(np.abs(nodes - nodes[here]), axis=1)
            nearest = [int(i) for i in np.argsort(away, kind="stable")[1 : _TRIED_AT_ONCE + 1]]
            for there in nearest if 1 in nearest else [*nearest, 1]:
                length = best[here] + float(away[there])
                if there in done or length >= best.get(there, np.inf) or not self.clear(nodes[here], nodes[there]):
                    continue
                best[there], before[there] = length, here
                heapq.heappush(queue, (length + float(left[there]), there))
        return None


def travel(path: Sequence[Array]) -> float:
    """How far a path goes: of each leg, the joint that turns most (rad)."""
    return float(sum(np.max(np.abs(b - a)) for a, b in pairwise(path)))


_ALIVE_EVERY_S = 0.1
_NOTED_EVERY_S = 1.0
_HEATED_EVERY_S = 0.25
_RELEASED_EVERY_S = 0.25
_SAME_RAD = 1e-9
_MOST_WAYPOINTS = 6  # So many are given to a board whose memory the whole path does not fit
_PLAY_RAD = np.deg2rad(3.0)  # More than servos have play
_TAKEN_UP_RAD = np.deg2rad(1.5)  # A turn by less may end within the play, on neither side of it


class Drive:
    """An arm that is commanded step by step along paths: between two steps the board hears that the host lives."""

    def __init__(
        self,
        device: JointDevice,
        clock: Clock,
        planner: PathPlanner,
        settings: AcquisitionSettings,
        heat: HeatModel,
        log: Log,
    ) -> None:
        self.device, self.clock, self.joints = device, clock, device.joint_names
        self.thermal_state = ThermalState(heat, device.joint_names, clock)
        self._alive = self._heated = self._noted = clock.now()
        self._planner, self.settings, self._log = planner, settings, log
        self._rate = float(np.deg2rad(settings.rate_deg_per_s))
        self.park = np.array([settings.park.get(joint, 0.0) for joint in self.joints])
        self.at = self.park.copy()  # the commanded joint angles (joints, rad)
        self._is_energised = False
        # The sign of each joint's last motion; 0 before its first, and where that took up no play.
        self.approach = np.zeros(len(self.joints))
        # How far each has turned since it last turned back (rad, with its sign).
        self._one_way = np.zeros(len(self.joints))

    @property
    def angles(self) -> dict[str, float]:
        return self._named(self.at)

    def take_over(self, angles: Mapping[str, float]) -> None:
        self.at = np.array([angles.get(joint, self.at[i]) for i, joint in enumerate(self.joints)])

    def energise(self, known: Mapping[str, float]) -> None:
        """Take up what the device does; joints without pulses get theirs, one by one.

        They get the angles (rad) that were commanded last before this run where these are ``known``, else those at
        which they park. What the device measures goes before both.
        """
        last = self.angles if self._is_energised else {**self.angles, **known}
        self.take_over({**last, **self.measured(), **state_of(self.device).angles})
        self._is_energised = True
        # Should the host fall silent from now on: stay, for joints that hang free make every path unknown.
        self.device.guard([self.angles], self._rate, self.settings.silence)
        for i, (joint, angle) in enumerate(self.angles.items()):
            if joint not in state_of(self.device).angles:
                self._log.record(ENERGISED, {"joint": joint, "angle": angle, "at": self.clock.wall()})
                self.device.energise(joint, angle)
                self.approach[i] = self._one_way[i] = 0.0  # it may have jumped from either side
                self.stand(self.settings.between_joints, unguarded)
        self._guard(self.at)

    def standing(self) -> dict[str, float]:
        commanded, angles = standing_at(self.device, self.angles), state_of(self.device).angles
        for joint, angle in commanded.items():
            if joint not in angles or abs(angles[joint] - angle) > _SAME_RAD:
                stands = f"{math.degrees(angles[joint]):.2f} deg" if joint in angles else "no pulses"
                text = f"found {stands} for {joint}, expected {math.degrees(angle):.2f} deg, as commanded."
                raise DeviceError(text, hint="Look at the board's power and bus, and whether another program uses it.")
        return commanded

    def measured(self) -> dict[str, float]:
        return measured_angles(self.device)

    def go(self, path: Sequence[Array], may_move: MayMove) -> None:
        """Along a path that begins where the arm is: straight lines in joint space, all joints in proportion.

        StopRequested and ThermalLimit stop it on its path; what was commanded before a DeviceError may have arrived.
        """
        for start, goal in pairwise(path):
            self._guard(start)
            difference, gone, before = goal - start, 0.0, self.clock.now()
            length = float(np.max(np.abs(difference)))
            commanded = standing_at(self.device, self.angles)
            # On which side of their play joints come to lie.
            turned, signs = np.abs(difference) > _SAME_RAD, np.sign(difference)
            further = difference + np.where(self._one_way * signs > 0, self._one_way, 0.0)
            self._one_way = np.where(turned, further, self._one_way)
            lies = (np.abs(self._one_way) >= _TAKEN_UP_RAD) | (self.approach == signs)
            self.approach = np.where(turned, np.where(lies, signs, 0.0), self.approach)
            while gone < length:
                moves = self.tick(may_move)
                now = self.clock.now()
                # After a pause of the host the arm goes on from where it is: a step that catches up is a jump.
                step = min(now - before, self.settings.period) * self._rate
                before = now
                if not moves:
                    self.thermal_state.check()
                    continue
                gone = min(gone + step, length)
                self.at = start + (gone / length) * difference if gone < length else goal.copy()
                standing = standing_at(self.device, self.angles)
                if standing != commanded:
                    self.device.command(standing)
                    commanded = standing
        self._guard(path[-1])

    def preload_backlash(self, sides: Array, may_move: MayMove) -> None:
        """Come to the pose from the stated sides (1 from below, -1 from above, 0 as it came): a little away, and back.

        A joint that has had no direction since it was energised comes from either side: which side its play lies on is
        not known before. What limits or obstacles do not allow is left out.
        """
        unknown, here = self.approach == 0, self.at
        wrong = (sides != 0) & (self.approach != sides)
        signs = np.where(wrong, sides, 0.0)
        for away in (signs + (unknown & ~wrong), signs - (unknown & ~wrong), 1.0 * unknown, -1.0 * unknown):
            there = here - _PLAY_RAD * away
            if away.any() and self._planner.within(there) and self._planner.clear(here, there):
                self.go((here, there, here), may_move)
                return

    def stand(self, seconds: float, may_move: MayMove) -> None:
        until = self.clock.now() + seconds
        while (left := until - self.clock.now()) > 0:
            self._pause(min(left, _ALIVE_EVERY_S), may_move)

    def tick(self, may_move: MayMove) -> bool:
        return self._pause(self.settings.period, may_move)

    def _pause(self, seconds: float, may_move: MayMove) -> bool:
        if self.clock.now() - self._noted >= _NOTED_EVERY_S:
            self.note()
        self.clock.sleep(seconds)
        self.keep_alive()
        now = self.clock.now()
        if now - self._heated >= _HEATED_EVERY_S:
            self._heated = now
            self.thermal_state.pass_to_now(self.angles)
        return may_move()

    def keep_alive(self) -> None:
        """Often enough for the device, not more often; while the arm moves too, for a device that failed shows then."""
        now = self.clock.now()
        if now - self._alive >= _ALIVE_EVERY_S:
            self._alive = now
            self.device.keep_alive()

    def release(self) -> None:
        """End all pulses, one by one, the tip's first."""
        for joint in reversed(self.joints):
            self.device.release(joint)
            self.clock.sleep(_RELEASED_EVERY_S)

    @property
    def trouble(self) -> str:
        return self._planner.trouble(self.joints, self.at)

    def path_home(self, start: Array) -> JointPath | None:
        return self._planner.find(start, self.park)

    def hold(self) -> None:
        """The arm is to stay where it is when the host falls silent."""
        self.device.guard([self.angles], self._rate, self.settings.silence)

    def note(self) -> None:
        self._noted = self.clock.now()
        self._log.note_angles(self.angles, self.thermal_state.by_joint, self.clock.wall())

    def _guard(self, start: Array) -> None:
        """Should the host fall silent: back to where this leg began, which is clear, and home from there.

        Where no path home is found it stays there; the one of another leg must not remain.
        """
        waypoints = [self._named(pose) for pose in self.path_home(start) or (start,)]
        try:
            self.device.guard(waypoints, self._rate, self.settings.silence)
        except DeviceRefusedError:  # more than its memory holds: as far as that goes, which is clear too
            self.device.guard(waypoints[:_MOST_WAYPOINTS], self._rate, self.settings.silence)

    def _named(self, values: Array) -> dict[str, float]:
        return dict(zip(self.joints, values.tolist(), strict=True))
