"""Moving the arm: along clear paths, never faster than its rate, with the path home known to the board."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import pairwise

import numpy as np
from armcal.base.domains import Array
from armcal.devices.clock import Clock
from armcal.devices.device import JointDevice
from armcal.devices.faults import DeviceRefusedError

from armcal_bench.acquisition.heat import HeatModel, Torques
from armcal_bench.acquisition.motion_gate import MayMove
from armcal_bench.acquisition.path_planner import JointPath, PathPlanner
from armcal_bench.acquisition.run_log import RunLog
from armcal_bench.acquisition.settings import AcquisitionSettings

_LONGEST_STEP = 2.0
"""Periods: after a pause of the host, the arm goes on from where it is and does not catch up."""
_ALIVE_EVERY_S = 0.1
_NOTED_EVERY_S = 1.0
_HEATED_EVERY_S = 0.25
_STILL_RAD = 1e-9
_SAME_HEAT = 1e-4
_MOST_WAYPOINTS = 6
"""So many are given to a board whose memory the whole path does not fit."""
_PLAY_RAD = np.deg2rad(3.0)
"""More than servos have play."""


class ThermalLimit(Exception):  # noqa: N818 - no error: the scheduler lets the servos rest
    """A servo has come to its budget before its time."""


class Drive:
    """The arm as it is commanded.

    Attributes:
        settings: rate, period and the park pose, among others.
        at: the commanded joint angles (joints, rad).
        thermal_state: of the servos, by the model (joints x 2).
        approach: the sign of each joint's last motion, 0 before its first (joints).
    """

    def __init__(
        self,
        device: JointDevice,
        clock: Clock,
        planner: PathPlanner,
        settings: AcquisitionSettings,
        heat: tuple[HeatModel, Torques],
        log: RunLog,
    ) -> None:
        self._device, self._clock, self._planner, self.settings = device, clock, planner, settings
        (self._model, self._torques), self._log = heat, log
        self._joints = device.joint_names
        self._rate = float(np.deg2rad(settings.rate_deg_per_s))
        self._alive = self._noted = self._heated = clock.now()
        self.park = np.array([settings.park.get(joint, 0.0) for joint in self._joints])
        self.at = self.park.copy()
        self.thermal_state = self._model.cold
        self.approach = np.zeros(len(self._joints))

    @property
    def angles(self) -> dict[str, float]:
        """The commanded joint angles (rad)."""
        return self._named(self.at)

    def take_over(self, angles: Mapping[str, float]) -> None:
        """Joint angles (rad) that were commanded before, by this run or another."""
        self.at = np.array([angles.get(joint, self.at[i]) for i, joint in enumerate(self._joints)])

    def forget_approach(self, joint: str) -> None:
        """A joint was energised: it may have jumped from either side."""
        self.approach[self._joints.index(joint)] = 0.0

    def go(self, path: Sequence[Array], may_move: MayMove) -> None:
        """Along a path that begins where the arm is: straight lines in joint space, all joints in proportion.

        Raises:
            ParkRequested, ThermalLimit: it stopped on its path; ``at`` says where.
            DeviceError: the device failed; what was commanded last may have arrived.
        """
        for start, goal in pairwise(path):
            self._guard(start)
            difference, gone, before = goal - start, 0.0, self._clock.now()
            length = float(np.max(np.abs(difference)))
            commanded = self._device.standing(self.angles)
            self.approach = np.where(np.abs(difference) > _STILL_RAD, np.sign(difference), self.approach)
            while gone < length:
                moves = self.tick(may_move)
                now = self._clock.now()
                step = min(now - before, _LONGEST_STEP * self.settings.period) * self._rate
                before = now
                if not moves:
                    self.check_heat()
                    continue
                gone = min(gone + step, length)
                self.at = start + (gone / length) * difference if gone < length else goal.copy()
                standing = self._device.standing(self.angles)
                if standing != commanded:
                    self._device.command(standing)
                    commanded = standing
        self._guard(path[-1])

    def guard_here(self) -> None:
        """Should the host fall silent from now on: home from where the arm stands; see ``go``."""
        self._guard(self.at)

    def guard_still(self) -> None:
        """Should the host fall silent from now on: stay, for joints that hang free make every path unknown."""
        self._device.guard([self.angles], self._rate, self.settings.silence)

    def preload_backlash(self, may_move: MayMove) -> None:
        """Give joints a direction of approach that have none since they were energised: a little away, and back.

        Which side a servo's play lies on is not known before it has moved. See ``go`` for what it raises.
        """
        unknown, here = self.approach == 0, self.at
        for away in (-_PLAY_RAD, _PLAY_RAD):
            there = here + away * unknown
            if unknown.any() and self._planner.within(there) and self._planner.clear(here, there):
                self.go((here, there, here), may_move)
                return

    def stand(self, seconds: float, may_move: MayMove) -> None:
        """Hold for some time; see ``go``."""
        until = self._clock.now() + seconds
        while (left := until - self._clock.now()) > 0:
            self._pause(min(left, _ALIVE_EVERY_S), may_move)

    def tick(self, may_move: MayMove) -> bool:
        """One period of holding; whether the arm may move. See ``go``."""
        return self._pause(self.settings.period, may_move)

    def _pause(self, seconds: float, may_move: MayMove) -> bool:
        self._clock.sleep(seconds)
        self.keep_alive()
        now = self._clock.now()
        if now - self._heated >= _HEATED_EVERY_S:
            self.cool(now - self._heated)
            self._heated = now
        if now - self._noted >= _NOTED_EVERY_S:
            self.note()
        return may_move()

    def keep_alive(self) -> None:
        """Often enough for the device, not more often; while the arm moves too, for a device that failed shows then."""
        now = self._clock.now()
        if now - self._alive >= _ALIVE_EVERY_S:
            self._alive = now
            self._device.keep_alive()

    def path_home(self, start: Array) -> JointPath | None:
        """From a pose (joints, rad) to where the arm parks."""
        return self._planner.find(start, self.park)

    def note(self) -> None:
        """Write down where it is and how hot."""
        self._noted = self._clock.now()
        self._log.note_angles(self.angles, self.named_thermal_state(), self._clock.wall())

    def cool(self, seconds: float) -> None:
        """The servos had this time to cool, with the torque of where the arm is."""
        self.thermal_state = self._model.after(self.thermal_state, self._torques(self.at), seconds)

    def _guard(self, start: Array) -> None:
        """Should the host fall silent: back to where this leg began, which is clear, and home from there.

        Where no path home is found it stays there; the one of another leg must not remain.
        """
        waypoints = [self._named(pose) for pose in self.path_home(start) or (start,)]
        try:
            self._device.guard(waypoints, self._rate, self.settings.silence)
        except DeviceRefusedError:  # more than its memory holds: as far as that goes, which is clear too
            self._device.guard(waypoints[:_MOST_WAYPOINTS], self._rate, self.settings.silence)

    def check_heat(self) -> None:
        """Whether the servos are within their budget.

        Raises:
            ThermalLimit: they are not.
        """
        if self._model.over(self.thermal_state):
            raise ThermalLimit(f"the servo of {self._hottest} has come to its budget")

    @property
    def hottest(self) -> str:
        """The servo that is nearest to its budget, in words."""
        share = float(np.max(self._model.heat(self.thermal_state) / self._model.budget))
        return f"that of {self._hottest} is at {100 * share:.0f} % of its budget"

    @property
    def _hottest(self) -> str:
        return self._joints[int(np.argmax(self._model.heat(self.thermal_state) / self._model.budget))]

    def hotter_than(self, thermal_state: Array) -> bool:
        """Whether a servo is hotter than in a thermal state (joints x 2), and still cools where the arm stands."""
        steady = np.repeat(self._model.steady(self._torques(self.at)), 2, axis=1)
        least = np.maximum(self._model.heat(thermal_state), self._model.heat(steady))
        return bool(np.any(self._model.heat(self.thermal_state) > least + _SAME_HEAT))

    def named_thermal_state(self) -> dict[str, list[float]]:
        """Of winding and case, by joint."""
        return dict(zip(self._joints, self.thermal_state.tolist(), strict=True))

    def _named(self, values: Array) -> dict[str, float]:
        return dict(zip(self._joints, values.tolist(), strict=True))
