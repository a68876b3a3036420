"""Whether the arm stands where it was commanded to, by poses compared with each other and with the model's."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.acquisition.settings import ArrivalSettings
from armcal_bench.measured_frame import FrameMistake, frame_mistake

_ENOUGH = 5


@dataclass(frozen=True)
class Arrival:
    """Compares how far apart the target stood in two poses, and by how much it was turned, with the nominal arm.

    Neither depends on where the tracker's frame, the base body and the tool body are. What is not known of the arm, and
    a target that is not at its nominal place, make them differ as well: the limits have to be generous.

    Attributes:
        expected: ``base_T_tool`` of the nominal, rigid arm in each pose of the plan (N x 4 x 4, m).
        settings: the limits.
    """

    expected: Array
    settings: ArrivalSettings

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
