"""The model's axes put where the tool's turns show them, and what those turns tell of the springs.

What springs give is reckoned by the model, and a model whose axes point a few degrees elsewhere reckons it wrong. Turns
of the tool across the axis of the joint that moves have nothing to do with its servo; they tell the axes, and the
compliances. They are fitted by Gauss-Newton steps [Nocedal2006], every number near its nominal value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from armcal.base.domains import Array
from scipy.linalg import block_diag
from scipy.optimize import lsq_linear
from scipy.spatial.transform import Rotation

from armcal_bench.servo.angles import Springs, Sweeps
from armcal_bench.servo.nominal import NominalArm
from armcal_bench.servo.unknowns import SpringRows

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
            what ``seat`` was turned by since it was first found (3 each, rad).
        compliances: of the springs, less their nominal values (rad/(N m)).
        base, seat: rotations (3x3).
    """

    numbers: Array
    compliances: Array
    base: Array = field(default_factory=lambda: np.eye(3))
    seat: Array | None = None


@dataclass(frozen=True, eq=False)
class _Rows:
    """Weighted rows of one step: of the compliances, of everything else, of the joints' standing, and what is left."""

    springs: Array
    others: Array
    plays: Array
    sizes: Array


def begin(nominal: NominalArm) -> Alignment:
    """The model as it is."""
    return Alignment(np.zeros(len(_sds(nominal))), np.zeros(len(nominal.compliances)))


def seat_of(alignment: Alignment) -> Array:
    """``tool_R_body``."""
    return np.eye(3) if alignment.seat is None else alignment.seat


def shifted(nominal: NominalArm, alignment: Alignment) -> NominalArm:
    """The arm with what was found."""
    values, place = {}, 0
    for name in nominal.angles:
        stated = nominal.values(name)
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
    """One step better; and what the turns tell of the changes of compliances from ``nominal``, whatever the rest is.

    None where no rotations were seen. Without a ``compliance_sd`` (rad/(N m)) compliances stay.
    """
    tracked = {joint: sweep for joint, sweep in sweeps.items() if sweep.by == "rotation"}
    if not tracked:
        return alignment, None
    if alignment.seat is None:
        alignment = replace(alignment, seat=_seat(alignment.base, tracked, springs))
    parts = [_rows(alignment, joint, each, springs[joint]) for joint, each in tracked.items()]
    rows = _Rows(*(np.concatenate([getattr(p, key) for p in parts]) for key in ("springs", "others", "plays", "sizes")))
    sds = np.concatenate([_sds(nominal), np.full(len(parts) * len(nominal.joints), _PLAY_SD)])
    plays = block_diag(*[part.plays for part in parts])
    others = np.vstack([np.hstack([rows.others, plays]), np.diag(1 / sds)])
    slopes = np.vstack([rows.springs, np.zeros((len(sds), len(alignment.compliances)))])
    now = np.concatenate([alignment.numbers, np.zeros(plays.shape[1])])
    sizes = np.concatenate([rows.sizes, -now / sds])
    changes, step = _step(slopes, others, sizes, alignment, nominal, compliance_sd)
    count = len(alignment.numbers)
    left = sizes - slopes @ changes - others @ step
    scale = max(1.0, float(np.linalg.norm(left)) / math.sqrt(max(len(rows.sizes) - len(changes), 1)))
    better = Alignment(
        alignment.numbers + step[:count],
        alignment.compliances + changes,
        Rotation.from_rotvec(step[count - 6 : count - 3]).as_matrix() @ alignment.base,
        seat_of(alignment) @ Rotation.from_rotvec(step[count - 3 : count]).as_matrix(),
    )
    return better, _of_springs(slopes, others, sizes + slopes @ alignment.compliances, scale)


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
    found = lsq_linear(whole, np.concatenate([sizes, -now / compliance_sd]), (low, high), tol=1e-12).x
    return found[: len(now)], found[len(now) :]


def _of_springs(slopes: Array, others: Array, sizes: Array, scale: float) -> SpringRows:
    """The rows with everything else taken out, as few as there are compliances."""
    free = np.linalg.qr(others, mode="complete")[0][:, others.shape[1] :].T
    q, r = np.linalg.qr(free @ slopes)
    return SpringRows(r / scale, q.T @ (free @ sizes) / scale)


def _rows(alignment: Alignment, joint: str, sweeps: Sweeps, springs: Springs) -> _Rows:
    """One joint's: turns across its axis, in the base's axes."""
    found: list[tuple[Array, Array, Array, Array]] = []
    seat = seat_of(alignment)
    for line, pose, sd in zip(sweeps.lines, springs.poses(sweeps, joint), sweeps.sds, strict=True):
        tool, by_angles, by_joints, by_springs = springs.about.turns(pose)
        seen = np.array(line["rotation"])
        off = Rotation.from_matrix(seen @ (alignment.base @ tool @ seat).T).as_rotvec()
        own = alignment.base @ by_joints[:, springs.about.joints.index(joint)]
        across = np.linalg.svd(own[None])[2][1:] / sd
        known = across @ alignment.base
        found.append(
            (
                known @ by_springs,
                np.hstack([known @ by_angles, known @ by_joints, across, across @ seen]),
                known @ by_joints,
                across @ off,
            )
        )
    return _Rows(*(np.concatenate([each[i] for each in found]) for i in range(4)))


def _seat(base: Array, sweeps: Mapping[str, Sweeps], springs: Mapping[str, Springs]) -> Array:
    """How the tracked body sits on the model's tool, on the average."""
    between = [
        (base @ springs[joint].about.turns(pose)[0]).T @ np.array(line["rotation"])
        for joint, sweep in sweeps.items()
        for line, pose in zip(sweep.lines, springs[joint].poses(sweep, joint), strict=True)
    ]
    return np.asarray(Rotation.from_matrix(np.array(between)).mean().as_matrix())


def _sds(nominal: NominalArm) -> Array:
    count = sum(len(nominal.values(name)) for name in nominal.angles)
    return np.concatenate([np.full(count, _ANGLE_SD), np.full(len(nominal.joints), _ZERO_SD), np.full(6, _FRAME_SD)])
