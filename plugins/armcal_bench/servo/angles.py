"""From lines of the record to angles observed at pulses."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from armcal.base.arrays import Array

from armcal_bench.servo.nominal import By, NominalArm
from armcal_bench.servo.problem import Observation
from armcal_bench.servo.record import ANGLE, POSE
from armcal_bench.servo.settings import ServoCalibrationSettings
from armcal_bench.servo.turning import NoTurnError, Turning, mean_angle, turning_of_positions, turning_of_rotations

_LEAST_SEEN_M = 1e-4
_FARTHEST_AXIS = math.radians(30.0)
_MOST_OFF_AXIS = math.radians(10.0)
"""Springs, and axes that are not as drawn, give less."""
_CHECK_IT = "is another servo on its channel? Look with armcal servo --check"
Entry = Mapping[str, Any]


@dataclass(frozen=True, eq=False)
class Sweeps:
    """A joint's lines that show angles, and these angles.

    Attributes:
        lines: of the record.
        angles: of the joint (rad), what springs give taken out as far as it is known.
        sds: of these (rad).
        by: what showed them; None: somebody's eyes.
        turning: how the tool turned, where a tracker saw it.
    """

    lines: tuple[Entry, ...]
    angles: Array
    sds: Array
    by: By | None = None
    turning: Turning | None = None

    @property
    def joint(self) -> str:
        return str(self.lines[0]["joint"])

    @property
    def rotations(self) -> Array:
        """``base_R_body`` as the tracker saw it (N x 3 x 3)."""
        return np.array([line["rotation"] for line in self.lines])

    @property
    def counts(self) -> list[int]:
        return [int(line["counts"]) for line in self.lines]

    @property
    def approaches(self) -> list[int]:
        """From where the angle came: 1 from below."""
        counts = np.array(self.counts)
        falls = len(set(self.counts)) > 1 and np.polyfit(counts - counts.mean(), self.angles, 1)[0] < 0
        return [-int(line["came"]) if falls else int(line["came"]) for line in self.lines]


@dataclass(frozen=True, eq=False)
class Springs:
    """An arm with its springs, and where a joint stood in each line: what they give there can be taken out.

    Attributes:
        about: the arm, with the compliances as well as they are known.
        angles: of the joint (rad), line by line.
        seat: ``tool_R_body``, how the tracked body sits on the model's tool (3x3).
    """

    about: NominalArm
    angles: tuple[float, ...]
    seat: Array = field(default_factory=lambda: np.eye(3))

    def given(self, lines: Sequence[Entry]) -> Array:
        """What springs give in each line (N x 4 x 4): a rotation in the body's axes, a translation in the base's."""
        given = self.about.give(self.poses(lines))
        given[:, :3, :3] = self.seat.T @ given[:, :3, :3] @ self.seat
        return given

    def poses(self, lines: Sequence[Entry]) -> list[dict[str, float]]:
        """All joints' angles (rad), line by line."""
        return [{**line["told"], line["joint"]: angle} for line, angle in zip(lines, self.angles, strict=True)]


def sweeps_of(
    entries: Sequence[Entry],
    joint: str,
    nominal: NominalArm,
    settings: ServoCalibrationSettings,
    springs: Springs | None = None,
) -> Sweeps | str:
    """A joint's angles, or why they are not known."""
    poses = [e for e in entries if e["kind"] == POSE and e["joint"] == joint]
    by_eye = list({(e["target"], e["came"]): e for e in entries if e["kind"] == ANGLE and e["joint"] == joint}.values())
    if not poses and not by_eye:
        return "nothing was measured"
    if not poses:
        return Sweeps(tuple(by_eye), np.array([e["angle"] for e in by_eye]), np.array([e["sd"] for e in by_eye]))
    given = np.tile(np.eye(4), (len(poses), 1, 1)) if springs is None else springs.given(poses)
    try:
        return _tracked(poses, joint, nominal, settings, given)
    except NoTurnError as fault:
        return str(fault)


def observations_of(sweeps: Sweeps, nominal: NominalArm, springs: Springs | None) -> list[Observation]:
    """As a fit takes them. Of what springs give, the change of compliances from ``nominal`` is left to the fit."""
    joint = sweeps.joint
    rows = list(zip(sweeps.counts, sweeps.approaches, sweeps.angles.tolist(), sweeps.sds.tolist(), strict=True))
    if springs is None or sweeps.by is None:
        return [Observation(joint, *row) for row in rows]
    about = springs.about
    changes = np.array([about.compliance(name) - nominal.compliance(name) for name in about.compliances])
    slopes = about.slopes(joint, springs.poses(sweeps.lines), sweeps.by)
    return [
        Observation(joint, *row, -float(slope @ changes), dict(zip(about.compliances, slope, strict=True)))
        for row, slope in zip(rows, slopes, strict=True)
    ]


def _tracked(
    poses: Sequence[Entry], joint: str, nominal: NominalArm, settings: ServoCalibrationSettings, given: Array
) -> Sweeps:
    """By the tool's rotations, or its positions where a rotation is missing; ``given`` by springs (N x 4 x 4).

    Raises:
        NoTurnError: the tool did not turn, or not about this joint's axis.
    """
    # Where the other joints stood: the median, since each had the same pulse every time.
    names = sorted({name for e in poses for name in e["told"]} - {joint})
    others = {name: float(np.median([e["told"][name] for e in poses if name in e["told"]])) for name in names}
    axis = nominal.axis(joint, {**others, joint: 0.0})[0]
    deviations = np.array([[d or 0.0 for d in e["deviations"]] for e in poses])
    by: By = "position" if any(e["rotation"] is None for e in poses) else "rotation"
    if by == "rotation":
        rotations = np.array([e["rotation"] for e in poses]) @ np.swapaxes(given[:, :3, :3], 1, 2)
        turning = turning_of_rotations(rotations, axis)
        off_axis = turning.off_axis
        absolute = [nominal.angle_of_rotation(joint, others, rotation) for rotation in rotations]
        sds = np.linalg.norm((turning.axis @ rotations) * deviations[:, 3:], axis=1)
    else:
        positions = np.array([e["position"] for e in poses]) - given[:, :3, 3]
        turning = turning_of_positions(positions, axis, settings.least_radius)
        radius = turning.radius or math.inf
        off_axis = turning.off_axis / radius
        absolute = [nominal.angle_of_position(joint, others, position) for position in positions]
        sds = np.maximum(np.sqrt(np.mean(deviations[:, :3] ** 2, axis=1)), _LEAST_SEEN_M) / radius
    apart = math.acos(min(abs(float(turning.axis @ axis)), 1.0))
    if apart > _FARTHEST_AXIS:
        raise NoTurnError(
            f"the tool turned about an axis that is {math.degrees(apart):.0f} deg from this joint's: {_CHECK_IT}"
        )
    if off_axis > _MOST_OFF_AXIS:
        raise NoTurnError(f"the tool did not turn about one axis (it is {math.degrees(off_axis):.0f} deg off it)")
    angles = turning.angles + mean_angle(np.array(absolute) - turning.angles)
    return Sweeps(tuple(poses), angles, np.hypot(sds, settings.rotation_sd), by, turning)
