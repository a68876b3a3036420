"""What the poses of a measuring run show of the tracker's frame and of joints that give way, as it goes on."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.acquisition.arrival import Arrival
from armcal_bench.acquisition.sag import Sag, SagJudge
from armcal_bench.acquisition.tracker_monitor import StopRequested
from armcal_bench.settling import Stand, pose_of


class FrameRefused(StopRequested):
    """The tracker's units or handedness are not those that are expected."""


class JointGivesWay(StopRequested):
    """A joint moves while the arm should stand, pose after pose."""


class Evidence:
    """Everything that was seen, of poses that count as measured and of others.

    Args:
        poses: commanded, by index (N x joints, rad).
        arrival: compares poses with the model's.
        sag: names a joint that gives way.

    Attributes:
        doubted: what was recorded of poses that do not count as measured, by their index.
    """

    def __init__(self, poses: Array, arrival: Arrival, sag: SagJudge) -> None:
        self.doubted: dict[int, Mapping[str, Any]] = {}
        self.arrival, self._poses, self._sag = arrival, poses, sag
        self._stands: list[tuple[int, Stand]] = []
        self._failed = 0

    def stood(self, pose: int, stand: Stand | None) -> None:
        """How the target moved while the arm should stand in a pose; None where it was hardly seen."""
        if stand is not None:
            self._stands.append((pose, stand))

    def succeeded(self, pose: int) -> None:
        self._failed = 0
        self.doubted.pop(pose, None)

    def failed(self, measured: Mapping[int, Array]) -> None:
        """The arm did not come to stand in a pose, or stood elsewhere.

        Args:
            measured: ``base_T_target`` (4 x 4, m) of measured poses, by their index.

        Raises:
            JointGivesWay: that happened several times in a row, and a joint is the reason.
        """
        self._failed += 1
        sag = self.gives_way(measured, self._failed) if self._failed >= self.arrival.settings.in_a_row else None
        if sag is not None and sag.joints:
            raise JointGivesWay(f"{sag.sentence}. {sag.mend}".rstrip("."))

    def gives_way(self, measured: Mapping[int, Array], last: int = 0) -> Sag | None:
        """A joint that gives way, by the last so many stands, or all of them. See ``failed``."""
        stands = self._stands[-last:]
        if not stands:
            return None
        seen = np.array(list(measured.values())).reshape(-1, 4, 4)
        angles = self._poses[[pose for pose, _ in stands]]
        return self._sag.sag_of(angles, [stand for _, stand in stands], (self._poses[list(measured)], seen))

    def check_frame(self, measured: Mapping[int, Array]) -> None:
        """Refuse other units or another frame than expected, by everything that was seen. See ``failed``.

        Raises:
            FrameRefused: they are others.
        """
        glimpsed = {pose: stand.base_T_target for pose, stand in self._stands}
        doubted = {pose: pose_of(record) for pose, record in self.doubted.items()}
        if (mistake := self.arrival.mistake({**glimpsed, **measured, **doubted})) is not None:
            kept = "The poses that were measured are kept as they came"
            raise FrameRefused(f"{mistake.sentence}. {mistake.mend} {kept}")
