"""What a verdict rests on beside the estimate: structure left in residuals, misses, and what priors alone hold."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.diagnose.held import Contradiction
from armcal.diagnose.large_errors import LargeErrors
from armcal.diagnose.residual_structure import ResidualStructure
from armcal.diagnose.unseen import Elsewhere, HiddenPayload, Rounding
from armcal.estimate.estimator import Estimate
from armcal.estimate.prediction import NewRecording
from armcal.planning.candidates import whitened_rows
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import along, apart_from, tools, unseen_motions

UNSEEN = 400
UP_TO_FRAMES = "where the base stands and which point of the tool is meant"
_MM = 1000.0


@dataclass(frozen=True)
class PriorsAlone:
    """What combinations that only priors hold do to the tip.

    Attributes:
        between_mm: the same at any pose: where joints stand between recorded positions too, approached from either
            recorded side.
    """

    worst_mm: float  # the largest standard deviation of the tip that they leave, over the poses looked at
    between_mm: float
    poses: int  # how many unseen poses of each kind were looked at
    up_to: str = ""  # motions that were left out, because nothing that was measured sees them; empty where none were


@dataclass(frozen=True)
class Evidence:
    """All of it; what was not looked at, or is not known, is None.

    ``unit`` is that of all errors, mm or mrad; ``name`` what they are errors of; ``noise`` how far noise puts each
    record off (N), and of how many numbers that is.
    """

    structure: ResidualStructure | None = None
    large_errors: LargeErrors | None = None
    priors_alone: PriorsAlone | None = None
    unit: str = "mm"
    new_recording: NewRecording | None = None
    hidden_payload: HiddenPayload | None = None
    contradictions: tuple[Contradiction, ...] = ()
    name: str = "Tip"
    rounding: Rounding | None = None
    elsewhere: Elsewhere | None = None
    noise: tuple[Array, float] | None = None

    def as_dict(self) -> dict[str, Any]:
        """For metrics.json."""
        alone = self.priors_alone
        return {
            "residual_structure": self.structure and asdict(self.structure),
            "large_errors": self.large_errors and asdict(self.large_errors),
            "priors_alone": alone
            and {"worst_mm": alone.worst_mm, "between_mm": alone.between_mm, "poses": alone.poses},
            "elsewhere": self.elsewhere and asdict(self.elsewhere),
            "hidden_payload": self.hidden_payload and asdict(self.hidden_payload),
            "contradictions": [asdict(one) for one in self.contradictions],
            "rounding": self.rounding and asdict(self.rounding),
        }


def unseen_poses(dataset: Dataset, channels: Sequence[str], between: bool = False) -> Dataset:
    """Poses that combine what single joints did in the records: a joint's command and approach are of one of them.

    ``between``: a joint stands anywhere between its recorded ends instead, approached as in any of its records.
    """
    random = np.random.default_rng(0)
    together = random.integers(0, len(dataset), UNSEEN)
    values = {name: column[together] for name, column in dataset.channels.items()}
    for channel in channels:
        arm, _, joint = channel.partition(".")
        known = np.flatnonzero(np.isfinite(dataset.column(channel)))  # of two arms one may not be recorded
        if not len(known):
            continue
        drawn = known[random.integers(0, len(known), UNSEEN)]
        for own in (channel, f"{arm}.approach.{joint}"):
            if dataset.has(own):
                values[own] = dataset.column(own)[drawn]
        if between:
            recorded = dataset.column(channel)[known]
            values[channel] = random.uniform(recorded.min(), recorded.max(), UNSEEN)
    return Dataset(tuple(str(i) for i in range(UNSEEN)), values)


def priors_alone(problem: Problem, estimate: Estimate, poses: Dataset, between: Dataset) -> PriorsAlone | None:
    """How far the tip at both kinds of ``unseen_poses`` depends on combinations that the data does not determine.

    Their covariance is what the priors give them, V (V'PV)^-1 V' over the undetermined directions V.

    Returns:
        None if there are none, or if no prior holds one of them.
    """
    null = estimate.identifiability.null
    scales = estimate.parameters.scales()
    information = null * (scales**2 * estimate.parameters.prior_information()) @ null.T
    if not len(null) or not len(poses) or np.linalg.cond(information) > 1 / np.finfo(float).eps:
        return None
    covariance: Array = np.asarray(np.linalg.inv(information), dtype=float)
    worst = []
    for kind in (poses, between):
        moved = _tip_motions(problem, estimate.values, kind, null)
        variance = np.einsum("trnk,kl,trnl->tn", moved, covariance, moved)
        worst.append(float(np.sqrt(np.max(np.maximum(variance, 0.0)))) * _MM)
    return PriorsAlone(worst[0], max(worst), len(poses), "" if _position_rows(problem) else UP_TO_FRAMES)


def elsewhere(problem: Problem, estimate: Estimate, poses: Dataset) -> Elsewhere | None:
    """How far tools at unseen poses are off for the parameters' uncertainty; None where no record is a contact."""
    if not problem.blueprint.groups or not len(poses):
        return None
    scales = estimate.parameters.scales()
    of_arm = np.array([not block.nuisance for block in estimate.parameters.coordinate_blocks], dtype=bool)
    root = np.linalg.pinv(estimate.parameters.entries_jacobian(estimate.values) * scales)
    covariance = (root @ estimate.covariance @ root.T)[np.ix_(of_arm, of_arm)]
    sizes, vectors = np.linalg.eigh(covariance)
    kept = sizes > np.finfo(float).eps * sizes.max(initial=0.0)
    if not kept.any():
        return None
    directions = np.zeros((int(kept.sum()), len(scales)))
    directions[:, of_arm] = (vectors[:, kept] * np.sqrt(sizes[kept])).T
    moved = _tip_motions(problem, estimate.values, poses, directions)
    rms = float(np.sqrt(np.mean(np.sum(moved**2, axis=(1, 3))))) * _MM
    return Elsewhere(rms, len(poses), "" if _position_rows(problem) else UP_TO_FRAMES)


def _tip_motions(problem: Problem, values: Array, poses: Dataset, null: Array) -> Array:
    """How the tips (T, or the one position that is read) move along the directions (T x 3 x N x K; m)."""
    if rows := _position_rows(problem):
        noise = np.concatenate([kernel.factor.noise for kernel in problem.kernels])
        return np.asarray((whitened_rows(problem, values, poses)[rows] * noise[rows, None, None] @ null.T)[None])
    records = problem.of(poses).records  # nothing reads a position: of the tools, up to what no contact could see
    at, axes = tools(problem.with_records(records), values)
    moves = np.array([along(problem.with_records(records), values, direction).ravel() for direction in null]).T
    return apart_from(np.array(unseen_motions(at, axes)).T, moves).reshape(len(at), 3, -1, moves.shape[1])


def _position_rows(problem: Problem) -> list[int]:
    start = 0
    for kernel in problem.kernels:
        factor = kernel.factor
        if factor.position_channels and factor.dimensions[:3] == ("length",) * 3:
            return list(range(start, start + 3))
        start += len(factor.noise)
    return []
