"""The model's axes put where the tool's turns show them, and the springs as far as those turns determine them.

What springs give is reckoned by the model, and a model whose axes point a few degrees elsewhere reckons it wrong. Turns
of the tool across the axis of the joint that moves have nothing to do with its servo; they determine the
axes, and the compliances. They are fitted by Gauss-Newton steps [Nocedal2006], every number near its nominal value.
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np
from armcal.base.arrays import Array
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from armcal_bench.servo.angles import Springs, Sweeps
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.problem import SpringRows

_ANGLE_SD = math.radians(4.0)
_ZERO_SD = math.radians(2.0)
_FRAME_SD = math.radians(4.0)
_MOST_SDS = 3.0
_PLAY_SD = math.radians(0.1)
"""Of where a joint stands from one joint's sweep to another's."""


@dataclass(frozen=True, eq=False)
class Alignment:
    """Where the tracker's frames are against the model's, ``base_R_model`` and ``tool_R_body``; the model's numbers.

    Attributes:
        numbers: of the model's angles, then the joints' zeros, less their nominal values; then the tilt of ``base`` and
            what ``seat`` was turned by since it was first estimated (3 each, rad).
        compliances: of the springs, less their nominal values (rad/(N m)).
        base, seat: rotations (3x3).
    """

    numbers: Array
    compliances: Array
    base: Array = field(default_factory=lambda: np.eye(3))
    seat: Array | None = None

    @classmethod
    def of(cls, nominal: NominalArm) -> Self:
        return cls(np.zeros(len(_sds(nominal))), np.zeros(len(nominal.compliances)))

    @property
    def tool_R_body(self) -> Array:  # noqa: N802
        return np.eye(3) if self.seat is None else self.seat


def shifted(nominal: NominalArm, alignment: Alignment) -> NominalArm:
    values, place = {}, 0
    for name in nominal.angles:
        stated = nominal.parameters[name].nominal
        values[name] = tuple(float(v + d) for v, d in zip(stated, alignment.numbers[place:], strict=False))
        place += len(stated)
    zeros = dict(zip(nominal.joints, alignment.numbers[place:].tolist(), strict=False))
    springs = zip(nominal.compliances, alignment.compliances.tolist(), strict=True)
    values |= {name: (nominal.compliance(name) + change,) for name, change in springs}
    return nominal.with_values(values, zeros)


def aligned(
    alignment: Alignment,
    nominal: NominalArm,
    sweeps: Mapping[str, Sweeps],
    springs: Mapping[str, Springs],
    compliance_sd: float,
) -> tuple[Alignment, SpringRows | None]:
    """One step better; and what the turns determine of the changes of compliances from ``nominal``.

    None where no rotations were seen. Without a ``compliance_sd`` (rad/(N m)) compliances stay.
    """
    tracked = {joint: sweep for joint, sweep in sweeps.items() if sweep.by == "rotation"}
    if not tracked:
        return alignment, None
    if alignment.seat is None:
        alignment = replace(alignment, seat=_mean_seat(alignment.base, tracked, springs))
    rows = [_rows(alignment, sweep, springs[joint]) for joint, sweep in tracked.items()]
    by_springs, by_others, by_plays, offs = (list(part) for part in zip(*rows, strict=True))
    sds = np.concatenate([_sds(nominal), np.full(len(rows) * len(nominal.joints), _PLAY_SD)])
    others = np.vstack([np.hstack([np.concatenate(by_others), block_diag(*by_plays)]), np.diag(1 / sds)])
    slopes = np.vstack([np.concatenate(by_springs), np.zeros((len(sds), len(alignment.compliances)))])
    count = len(alignment.numbers)
    sizes = np.concatenate([*offs, -alignment.numbers / sds[:count], np.zeros(len(sds) - count)])
    changes, step = _step(slopes, others, sizes, alignment, nominal, compliance_sd)
    residuals = sizes - slopes @ changes - others @ step
    freedom = max(len(sizes) - len(sds) - len(changes), 1)
    scale = max(1.0, float(np.linalg.norm(residuals)) / math.sqrt(freedom))
    better = Alignment(
        alignment.numbers + step[:count],
        alignment.compliances + changes,
        Rotation.from_rotvec(step[count - 6 : count - 3]).as_matrix() @ alignment.base,
        alignment.tool_R_body @ Rotation.from_rotvec(step[count - 3 : count]).as_matrix(),
    )
    # The rows with everything but the compliances taken out, as few as there are compliances.
    free = np.linalg.qr(others, mode="complete")[0][:, others.shape[1] :].T
    q, r = np.linalg.qr(free @ slopes)
    return better, SpringRows(r / scale, q.T @ (free @ (sizes + slopes @ alignment.compliances)) / scale)


def _step(
    slopes: Array, others: Array, sizes: Array, alignment: Alignment, nominal: NominalArm, compliance_sd: float
) -> tuple[Array, Array]:
    """The changes of the compliances, none of which falls below zero, and of everything else."""
    now = alignment.compliances
    if not compliance_sd:
        return np.zeros(len(now)), np.asarray(np.linalg.lstsq(others, sizes, rcond=None)[0])
    weak = np.hstack([np.eye(len(now)) / compliance_sd, np.zeros((len(now), others.shape[1]))])
    lowest = -now - np.array([nominal.compliance(name) for name in nominal.compliances])
    low = np.concatenate([np.minimum(lowest, 0.0), np.full(others.shape[1], -np.inf)])
    whole = np.vstack([np.hstack([slopes, others]), weak])
    # Springs much softer than that have no equilibrium, and are what a servo that has let go looks like.
    most = np.maximum(lowest + _MOST_SDS * compliance_sd, low[: len(now)] + 1e-9)
    high = np.concatenate([most, np.full(others.shape[1], np.inf)])
    solution = lsq_linear(whole, np.concatenate([sizes, -now / compliance_sd]), (low, high), tol=1e-12).x
    return solution[: len(now)], solution[len(now) :]


def _rows(alignment: Alignment, sweeps: Sweeps, springs: Springs) -> tuple[Array, Array, Array, Array]:
    """One joint's weighted turns across its axis, in the base's axes, two rows a line.

    Slopes by the compliances, by the numbers of an alignment, and by where the joints stand; and what is off.
    """
    tool, by_angles, by_joints, by_springs = springs.about.turns(springs.poses(sweeps.lines))
    seen = sweeps.rotations
    predicted = alignment.base @ tool @ alignment.tool_R_body
    off = Rotation.from_matrix(seen @ np.swapaxes(predicted, 1, 2)).as_rotvec()
    axes = by_joints[:, :, springs.about.joints.index(sweeps.joint)] @ alignment.base.T
    across = np.linalg.svd(axes[:, None])[2][:, 1:] / sweeps.sds[:, None, None]
    known = across @ alignment.base
    by_numbers = np.concatenate([known @ by_angles, known @ by_joints, across, across @ seen], axis=2)
    count = 2 * len(seen)
    by_compliances, by_plays = (known @ by_springs).reshape(count, -1), (known @ by_joints).reshape(count, -1)
    return by_compliances, by_numbers.reshape(count, -1), by_plays, (across @ off[:, :, None]).ravel()


def _mean_seat(base: Array, sweeps: Mapping[str, Sweeps], springs: Mapping[str, Springs]) -> Array:
    """How the tracked body sits on the model's tool, on the average (3x3)."""
    seats = []
    for joint, sweep in sweeps.items():
        tools = springs[joint].about.tools(springs[joint].poses(sweep.lines))
        seats.append(np.swapaxes(base @ tools[:, :3, :3], 1, 2) @ sweep.rotations)
    return np.asarray(Rotation.from_matrix(np.concatenate(seats)).mean().as_matrix())


def _sds(nominal: NominalArm) -> Array:
    """A priori, of ``Alignment.numbers``."""
    count = sum(nominal.parameters[name].size for name in nominal.angles)
    return np.concatenate([np.full(count, _ANGLE_SD), np.full(len(nominal.joints), _ZERO_SD), np.full(6, _FRAME_SD)])
