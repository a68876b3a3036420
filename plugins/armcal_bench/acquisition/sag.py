"""Which joint gives way while the arm should stand: slow motions of the target, compared with those of each joint.

While one joint j turns at the rate w, the target moves by its column of the Jacobian times w. The columns are those of
the nominal, rigid arm, in the frame that the poses themselves lie in (``armcal_bench.measured_frame``).
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.acquisition.heat import Torques
from armcal_bench.acquisition.settings import ArrivalSettings
from armcal_bench.measured_frame import FrameMistake, MeasuredFrame, frame_mistake, frame_of
from armcal_bench.settling import Stand

_ENOUGH = 5


@dataclass(frozen=True)
class Arrival:
    """Compares how far apart the target stood in two poses, and by how much it was turned, with the nominal arm.

    Neither depends on where the tracker's frame, the base body and the tool body are. What is not known of the arm, and
    a target that is not at its nominal place, make them differ as well: the limits have to be generous.
    """

    expected: Array  # ``base_T_tool`` of the nominal, rigid arm in each pose of the plan (N x 4 x 4, m)
    settings: ArrivalSettings  # the limits

    def doubt(self, pose: int, seen: Array, measured: Mapping[int, Array]) -> str:
        """Why the arm is not where it was commanded to be, a sentence; empty if it may be there.

        Args:
            pose: its index.
            seen: ``base_T_target`` (4 x 4, m); the rotation is NaN where it is not known.
            measured: those of other poses by index. The one that fits worst decides, or the next where there are five
                or more: one of them may be wrong itself.
        """
        others = [other for other in measured if other != pose]
        if not others:
            return ""
        before, expected = np.array([measured[other] for other in others]), self.expected[others]
        far = _worst(_distances(before, seen) - _distances(expected, self.expected[pose]))
        turned = _worst(_turns(before, seen) - _turns(expected, self.expected[pose]))
        if far <= self.settings.astray and not turned > self.settings.astray_turned:
            return ""
        angle = "" if np.isnan(turned) else f" and {np.rad2deg(turned):.0f} deg"
        return (
            f"the arm is not where it was commanded to be: measured {1000 * far:.0f} mm{angle} off, as seen from other "
            f"poses (allowed: {1000 * self.settings.astray:.0f} mm, {np.rad2deg(self.settings.astray_turned):.0f} deg)"
        )

    def mistake(self, seen: Mapping[int, Array]) -> FrameMistake | None:
        """What is wrong with the tracker's units or handedness, by ``base_T_target`` of poses by their index.

        Poses that are not where they were commanded to be count as well: in other units none is.
        """
        poses = list(seen)
        return frame_mistake(self.expected[poses], np.array([seen[pose] for pose in poses]).reshape(-1, 4, 4))


def _distances(poses: Array, pose: Array) -> Array:
    return np.asarray(np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1))


def _turns(poses: Array, pose: Array) -> Array:
    """By which angle each is turned from one (rad), whatever frames they are given in."""
    traces = np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3])
    return np.asarray(np.arccos(np.clip((traces - 1) / 2, -1.0, 1.0)))


def _worst(differences: Array) -> float:
    """The largest, or the next where there are enough; NaN where nothing is known."""
    known = np.sort(np.abs(differences[~np.isnan(differences)]))[::-1]
    return float(known[1 if len(known) >= _ENOUGH else 0]) if len(known) else np.nan


_STEP = 1e-4
_LEVER_M = 0.1
_SURE = 5.0  # Standard deviations
_LEFT = 0.2  # Of the squared motion: what the right joint leaves at most
_ALIKE = 9.0
_MINUTE = 60.0
_AS_CONFIGURED = MeasuredFrame(1.0, False, False, np.eye(3), np.zeros(3), np.zeros(3), 0.0)
Poses = Callable[[Array], Array]
"""``base_T_tool`` (N x 4 x 4, m) of the nominal, rigid arm at joint angles (N x joints, rad)."""


@dataclass(frozen=True)
class Sag:
    """A motion while the arm should stand."""

    joints: tuple[str, ...]  # that it could be, the likeliest first; empty where that is not known
    rate: float  # of that joint (rad/s), towards larger angles; NaN where no joint is known
    tip: float  # how fast the target moves (m/s)
    sinks: bool  # whether the joint turns the way of its load
    poses: int  # by how many it was seen

    @property
    def sentence(self) -> str:
        """What was seen, without its full stop."""
        speed = f"{_MINUTE * 1000 * self.tip:.2g} mm/min"
        if not self.joints:
            return (
                f"the target moves by {speed} while the arm should stand (in {self.poses} poses); which joint moves is "
                "not known"
            )
        does = "sinks" if self.sinks else "moves"
        others = f" (or {' or '.join(self.joints[1:])}: these poses cannot distinguish them)" if self.joints[1:] else ""
        return (
            f"{self.joints[0]}{others} {does} by {_MINUTE * math.degrees(abs(self.rate)):.2g} deg/min while it should "
            f"stand: the target moves by {speed} (in {self.poses} poses)"
        )

    @property
    def mend(self) -> str:
        which = self.joints[0] if self.joints else "the joint"
        return (
            f"Look at the screw of {which}'s horn, at its gear and its supply; a servo that is too weak for its load "
            "gives way as well: measure poses in which it carries less."
        )

    @property
    def content(self) -> dict[str, Any]:
        return {
            "joints": list(self.joints),
            "deg_per_min": None if math.isnan(self.rate) else _MINUTE * math.degrees(self.rate),
            "mm_per_min": _MINUTE * 1000 * self.tip,
            "poses": self.poses,
            "what": f"{self.sentence}. {self.mend}",
        }


@dataclass(frozen=True, eq=False)
class SagJudge:
    """Names the joint that gives way."""

    joints: tuple[str, ...]  # by name
    poses: Poses  # of the arm
    torques: Torques  # of the load on each joint (joints, N m) at joint angles (joints, rad), by the sign of the turn

    def sag_of(self, angles: Array, stands: Sequence[Stand], known: tuple[Array, Array]) -> Sag | None:
        """The motion, where it is beyond doubt.

        Args:
            angles: commanded in each stand (N x joints, rad).
            stands: as many.
            known: further poses by which the tracker's frame is found: commanded angles (M x joints, rad), and
                ``base_T_target`` as measured (M x 4 x 4, m).
        """
        if not stands:
            return None
        seen = np.array([stand.base_T_target for stand in stands])
        everything = self.poses(np.vstack([angles, known[0]])), np.concatenate([seen, known[1]])
        rates, sds = (np.array([getattr(stand, name) for stand in stands]) for name in ("rates", "sds"))
        has_rotations = not np.isnan(rates).any()
        used = 6 if has_rotations else 3
        strength = np.sqrt(np.nansum((rates / sds)[:, :used] ** 2, axis=1) / used)
        tip = float(np.sqrt(np.mean(np.sum(rates[:, :3] ** 2, axis=1))))
        moves = int(np.sum(strength > _SURE))
        each_alone = 2 * moves >= len(stands)
        loads = np.array([self.torques(pose) for pose in angles])
        pulls = loads / np.maximum(np.abs(loads).max(axis=0), 1e-9) if np.abs(loads).max() > 0 else np.ones_like(loads)
        size = np.array([1.0] * 3 + [_LEVER_M] * 3)[:used]
        frame = frame_of(*everything)
        if each_alone:
            # An arm that gives way much is soon not where it was commanded to be: then as configured, and at first.
            for tried, count in ((frame, None), (_AS_CONFIGURED, None), (_AS_CONFIGURED, 3), (_AS_CONFIGURED, 1)):
                if tried is not None:
                    columns = self._columns(angles[:count], tried)[:, :, :used] * size
                    if sag := self._one_by_one(columns, rates[:count, :used] * size, pulls[:count], tip):
                        return sag
            return Sag((), math.nan, tip, False, moves)
        if frame is None:
            return None
        columns = self._columns(angles, frame)[:, :, :used] * pulls[:, :, None]
        return self._together(columns, rates[:, :used], sds[:, :used])

    def _one_by_one(self, columns: Array, rates: Array, pulls: Array, tip: float) -> Sag | None:
        """Motions that every stand shows: the joint whose rate is fitted to every stand leaves least."""
        speeds = np.einsum("njk,nk->nj", columns, rates) / np.maximum(np.sum(columns**2, axis=2), 1e-12)
        off = rates[:, None, :] - speeds[:, :, None] * columns
        left = np.sum(off**2, axis=(0, 2)) / float(np.sum(rates**2))
        order = np.argsort(left)
        best, typical = int(order[0]), float(np.median(np.abs(speeds[:, int(order[0])])))
        if left[best] > _LEFT:
            return None
        alike = tuple(self.joints[j] for j in order if left[j] <= max(2 * left[best], _LEFT / 2))
        sinks = bool(np.sum(speeds[:, best] * pulls[:, best]) > 0)
        return Sag(alike, typical if sinks else float(np.median(speeds[:, best])), tip, sinks, len(rates))

    def _together(self, columns: Array, rates: Array, sds: Array) -> Sag | None:
        """A motion that only all stands together show: one joint gives way in proportion to its load."""
        weighted, sizes = columns / sds[:, None, :], rates / sds
        information = np.sum(weighted**2, axis=(0, 2))
        sums = np.einsum("njk,nk->j", weighted, sizes)
        explained = sums**2 / np.maximum(information, 1e-12)
        best = int(np.argmax(explained))
        if explained[best] < _SURE**2:
            return None
        alike = [int(j) for j in np.argsort(-explained) if explained[j] > explained[best] - _ALIKE]
        rate = float(sums[best] / information[best])
        tip = abs(rate) * float(np.sqrt(np.mean(np.sum(columns[:, best, :3] ** 2, axis=1))))
        return Sag(tuple(self.joints[j] for j in alike), rate, tip, rate > 0, len(rates))

    def _columns(self, angles: Array, frame: MeasuredFrame) -> Array:
        """How the target moves with each joint (N x joints x 6, m and rad per rad), in the tracker's axes."""
        columns = np.empty((*angles.shape, 6))
        for j in range(angles.shape[1]):
            step = np.zeros(angles.shape[1])
            step[j] = _STEP
            up, down = self.poses(angles + step), self.poses(angles - step)
            moved = (up - down) / (2 * _STEP)
            turning = moved[:, :3, :3] @ np.swapaxes(up[:, :3, :3], 1, 2)
            turns = np.stack([turning[:, 2, 1], turning[:, 0, 2], turning[:, 1, 0]], axis=1)
            shifts = moved[:, :3, 3] + moved[:, :3, :3] @ frame.target
            columns[:, j] = np.hstack([shifts @ frame.turn.T, turns @ frame.turn.T])
        return columns
