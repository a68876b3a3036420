"""What measured poses say of the run itself: whether the arm is where it was commanded, stands, and in which frame."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.acquisition.settings import ArrivalSettings
from armcal_bench.acquisition.tracker_monitor import StopRequested
from armcal_bench.measured_frame import FEWEST, FrameMistake, frame_mistake
from armcal_bench.settling import Stand, pose_of

_ENOUGH = 5
_SURE, _FEWEST_STANDS = 2.5, 3  # Standard deviations, in each of most stands
_MINUTE = 60.0
_LEAST_SPEED = 0.001 / _MINUTE  # m/s: a servo that comes to rest moves so much


@dataclass(frozen=True)
class Arrival:
    """Compares how far apart the target stood in two poses, and by how much it was turned, with the nominal arm.

    Neither depends on where the tracker's frame, the base body and the tool body are. What is not known of the arm, and
    a target that is not at its nominal place, make them differ as well: the limits have to be generous.
    """

    expected: Array  # ``base_T_tool`` of the nominal, rigid arm in each pose of the plan (N x 4 x 4, m)
    settings: ArrivalSettings  # the limits

    def doubt(self, pose: int, measured: Array, others: Mapping[int, Array]) -> str:
        """Why the arm is not where it was commanded to be, a sentence; empty if it may be there.

        Args:
            pose: its index.
            measured: ``base_T_target`` (4 x 4, m); the rotation is NaN where it is not known.
            others: those of other poses by index. The one that fits worst decides, or the next where there are five or
                more: one of them may be wrong itself.
        """
        places = [place for place in others if place != pose]
        if not places:
            return ""
        before, expected = np.array([others[place] for place in places]), self.expected[places]
        (far, angle), (far_here, angle_here) = _apart(before, measured), _apart(expected, self.expected[pose])
        far, turned = _worst(far - far_here), _worst(angle - angle_here)
        if far <= self.settings.astray and not turned > self.settings.astray_turned:
            return ""
        degrees = "" if np.isnan(turned) else f" and {np.rad2deg(turned):.0f} deg"
        return (
            f"the arm is not where it was commanded to be: measured {1000 * far:.0f} mm{degrees} off, as seen from "
            f"other poses (allowed: {1000 * self.settings.astray:.0f} mm, "
            f"{np.rad2deg(self.settings.astray_turned):.0f} deg)"
        )

    def mistake(self, measured: Mapping[int, Array]) -> FrameMistake | None:
        """What is wrong with the tracker's units or handedness, by ``base_T_target`` of poses by their index.

        Poses that are not where they were commanded to be count as well: in other units none is.
        """
        poses = list(measured)
        return frame_mistake(self.expected[poses], np.array([measured[pose] for pose in poses]).reshape(-1, 4, 4))


def _apart(poses: Array, pose: Array) -> tuple[Array, Array]:
    """How far each is from one (m), and by which angle it is turned (rad), whatever frames they are given in."""
    cosines = (np.einsum("nij,ij->n", poses[:, :3, :3], pose[:3, :3]) - 1) / 2
    return np.linalg.norm(poses[:, :3, 3] - pose[:3, 3], axis=1), np.arccos(np.clip(cosines, -1.0, 1.0))


def _worst(differences: Array) -> float:
    """The largest, or the next where there are enough; NaN where nothing is known."""
    finite = np.sort(np.abs(differences[~np.isnan(differences)]))[::-1]
    return float(finite[1 if len(finite) >= _ENOUGH else 0]) if len(finite) else np.nan


@dataclass(frozen=True)
class Drift:
    """A motion of the target while the arm should stand."""

    speed: float  # root mean square (m/s)
    poses: int  # in how many it was seen

    @classmethod
    def of(cls, stands: Sequence[Stand]) -> "Drift | None":
        """One that most of the stands show, three at least."""
        if len(stands) < _FEWEST_STANDS:
            return None
        rates, sds = (np.array([getattr(stand, name) for stand in stands]) for name in ("rates", "sds"))
        moving = int(np.sum(np.sqrt(np.mean((rates / sds) ** 2, axis=1)) > _SURE))
        speed = float(np.sqrt(np.mean(np.sum(rates**2, axis=1))))
        return cls(speed, moving) if 2 * moving > len(stands) and speed > _LEAST_SPEED else None

    @property
    def sentence(self) -> str:
        speed = _MINUTE * 1000 * self.speed
        return (
            f"the target moves by {speed:.{1 if speed < 10 else 0}f} mm/min while the arm should stand (in "
            f"{self.poses} poses): a joint gives way. Look at the screws of the horns, at gears and supply; a servo "
            "that is too weak for its load gives way as well: measure poses in which it carries less"
        )

    @property
    def content(self) -> dict[str, Any]:
        return {"mm_per_min": _MINUTE * 1000 * self.speed, "poses": self.poses, "what": f"{self.sentence}."}


class Evidence:
    """Everything that was measured, of poses that count and of others.

    Args:
        arrival: compares poses with the model's.
        is_tolerated: whether the run goes on despite a mistake of the tracker's frame; by default it never does.
        fewest: poses that show one.
        restless_ends: whether poses in a row in which the arm does not come to stand end a run, whatever the reason.
    """

    def __init__(
        self,
        arrival: Arrival,
        is_tolerated: Callable[[FrameMistake], bool] = lambda mistake: False,
        fewest: int = FEWEST,
        *,
        restless_ends: bool = False,
    ) -> None:
        self.doubted: dict[int, Mapping[str, Any]] = {}  # what was recorded of poses that do not count, by their index
        self.arrival, self._is_tolerated = arrival, is_tolerated
        self._fewest, self._restless_ends = fewest, restless_ends
        self._stands: list[tuple[int, Stand]] = []
        self._failed = 0

    def stood(self, pose: int, stand: Stand | None) -> None:
        """How the target moved while the arm should stand in a pose; None where it was hardly seen."""
        if stand is not None:
            self._stands.append((pose, stand))

    def succeeded(self, pose: int) -> None:
        self._failed = 0
        self.doubted.pop(pose, None)

    def failed(self, why: str) -> None:
        """The arm did not come to stand in a pose, or stood elsewhere.

        Raises StopRequested where that happened several times in a row, and the target moves meanwhile.
        """
        self._failed += 1
        if self._failed < self.arrival.settings.in_a_row:
            return
        if (drift := self.drift(self._failed)) is not None:
            raise StopRequested(drift.sentence, how="failed")
        if self._restless_ends:
            text = f"the arm did not come to stand {self._failed} times in a row ({why})"
            raise StopRequested(f"{text}: does a servo stall, or let go?", how="failed")

    def drift(self, last: int = 0) -> Drift | None:
        """A motion of the target in the last so many stands, or in all of them."""
        return Drift.of([stand for _, stand in self._stands[-last:]])

    def mistake(self, measured: Mapping[int, Array]) -> FrameMistake | None:
        """What is wrong with the tracker's units or handedness, by ``base_T_target`` of measured poses and others."""
        glimpsed = {pose: stand.base_T_target for pose, stand in self._stands}
        doubted = {pose: pose_of(record) for pose, record in self.doubted.items()}
        seen = {**glimpsed, **measured, **doubted}
        return self.arrival.mistake(seen) if len(seen) >= self._fewest else None

    def refusal(self, measured: Mapping[int, Array]) -> str:
        """Why the run cannot go on with a mistake of units or frame; empty if it can. See ``mistake``."""
        mistake = self.mistake(measured)
        if mistake is None or self._is_tolerated(mistake):
            return ""
        return f"{mistake.sentence}. {mistake.mend} The poses that were measured are kept as they came"
