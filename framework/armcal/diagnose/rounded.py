"""Joint angles that were rounded when they were recorded: the arm stood between them.

Where all recorded angles of some joints are whole multiples of one step, each may be off by up to half of it. Such
errors are carried to what is measured by the joints' slopes. What they would leave is compared with what is left: in
size and, by likelihood, in how it is spread over poses and directions. Servos that stand at whole commands leave less.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from scipy.special import chdtri

from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import digits, display_unit, from_unit, si_unit, to_unit, unit
from armcal.diagnose.fit_rows import FitRows
from armcal.diagnose.gross import MOST_RECORDS, thinned
from armcal.diagnose.noise_findings import Finding, first_few
from armcal.diagnose.smooth import CLEAR
from armcal.estimate.estimator import Estimate
from armcal.problem.motion import Motion
from armcal.problem.problem import FactorRecords, Problem

LEVEL = 0.05
COMPARABLE = 2.0
"""Variances, each less than so many times the other."""
_RESOLUTION = 1e-9
"""Of the steps that are looked for, in units of the file: finer than readings of joints, coarser than floats."""
_NOISES = np.logspace(-4, 0, 41)
"""What the instrument may leave beside the rounding, in shares of the variance that is left."""


@dataclass(frozen=True)
class Rounding:
    """Commands of joints that seem to have been rounded.

    Attributes:
        step: of which they are whole multiples (rad or m).
        unit: in which it was sought.
        joints: by channel.
        leaves: what the rounding alone leaves, root mean square over records, in thousandths of the SI unit of errors.
        residual: what the fit leaves, likewise.
        log_odds: of this rounding beside even noise, against even noise alone.
    """

    step: float
    unit: str
    joints: tuple[str, ...]
    leaves: float
    residual: float
    log_odds: float


def rounding(
    problem: Problem,
    records: Sequence[FactorRecords],
    estimate: Estimate,
    dataset: Dataset,
    motion: Motion,
    predicted: float,
) -> Rounding | None:
    """The likeliest rounding that explains what a fit leaves beyond the declared noise; None where none does.

    Args:
        problem: of the fit.
        records: those that trained, with the weights they had and the noise as declared.
        estimate: what was found.
        dataset, motion: of the same records.
        predicted: which share of the residuals' variance other records predict: that is no rounding.
    """
    share = min(1.0, max(estimate.degrees_of_freedom, 1.0) / max(problem.equations(records), 1))
    chosen = thinned(np.arange(len(dataset)), MOST_RECORDS)
    records, dataset, motion = problem.subset(records, chosen), dataset.subset(chosen), motion.subset(chosen)
    rows = FitRows.of(problem, records, estimate)
    left = rows.residual[rows.by_record] / np.sqrt(share)
    count = int(np.count_nonzero(left))
    variance = float(np.sum(left**2)) / max(count, 1)
    if variance * share * count <= chdtri(max(share * count, 1.0), LEVEL / 2):
        return None
    slopes = rows.columns([np.nan_to_num(slope).transpose(0, 2, 1) for slope in motion.slopes]) / np.sqrt(12)
    roundings = []
    for name, step, joints in _steps(problem, dataset, motion):
        errors = step * slopes[:, joints]
        own = np.where(left[:, :, None] == 0, 0.0, errors[rows.by_record])
        size = float(np.sum(own**2)) / count
        if (variance - 1) / COMPARABLE <= size <= COMPARABLE * (1 - predicted) * variance:
            squares = [np.mean(rows.errors(rows.residual) ** 2) / share]
            squares.append(np.mean(np.sum([rows.errors(column) ** 2 for column in errors.T], axis=0)))
            residual, leaves = (1000 * np.sqrt(squares)).tolist()
            channels = tuple(np.array(motion.channels)[joints].tolist())
            roundings.append(Rounding(step, name, channels, leaves, residual, _log_odds(left, own)))
    best = max(roundings, key=lambda one: one.log_odds, default=None)
    return None if best is None or best.log_odds < CLEAR else best


def _steps(problem: Problem, dataset: Dataset, motion: Motion) -> Iterator[tuple[str, float, Mask]]:
    """The step of each joint that moved, in each unit, and the joints that have multiples of it (rad or m)."""
    by_unit = dict[str, Array]()
    for place, channel in enumerate(motion.channels):
        arm, _, joint = channel.partition(".")
        command = dataset.column(channel)
        command = command[np.isfinite(command)]
        dimension = problem.blueprint.arms[arm].commanded[joint]
        for name in (display_unit(dimension).name, si_unit(dimension).name) if np.ptp(command) > 0 else ():
            whole = np.round(to_unit(command, name) / _RESOLUTION).astype(np.int64)
            by_unit.setdefault(name, np.zeros(len(motion.channels), dtype=np.int64))[place] = np.gcd.reduce(whole)
    for name, steps in by_unit.items():
        for step in np.unique(steps[steps > 0]):
            yield name, from_unit(float(step) * _RESOLUTION, name), (steps > 0) & (steps % step == 0)


def _log_odds(left: Array, errors: Array) -> float:
    """Of residuals (N x rows) from errors (N x rows x joints) beside even noise, against even noise alone.

    Both have one variance that is free, that of the even noise. Entries that are absent are 0.
    """
    sizes, axes = np.linalg.eigh(errors @ errors.transpose(0, 2, 1))
    sizes, squares = np.maximum(sizes, 0.0), np.einsum("nsr,ns->nr", axes, left) ** 2
    present = int(np.count_nonzero(left))
    variance = float(np.sum(left**2)) / present
    both = [
        np.sum(np.log(noise + sizes) + squares / (noise + sizes)) - (left.size - present) * np.log(noise)
        for noise in variance * _NOISES
    ]
    return float(present * (np.log(variance) + 1) - min(both)) / 2


def rounding_findings(rounded: Rounding | None, of_errors: str = "mm") -> list[Finding]:
    """What the verdict says of it; ``of_errors`` is the unit of errors."""
    if rounded is None:
        return []
    arms = list(dict.fromkeys(channel.partition(".")[0] for channel in rounded.joints))
    names = [channel if len(arms) > 1 else channel.partition(".")[2] for channel in rounded.joints]
    turning, step = unit(rounded.unit).dimension == "angle", digits(to_unit(rounded.step, rounded.unit), 4)
    text = (
        f"All recorded {'angles' if turning else 'travels'} of {first_few(names, len(names))} are multiples of {step} "
        f"{rounded.unit}. If they were rounded while the arm stood between them, that alone leaves "
        f"{digits(rounded.leaves)} {of_errors} (root mean square); the fit leaves {digits(rounded.residual)} "
        f"{of_errors}, spread over poses and directions as errors of rounding are."
    )
    test = f"variances within a factor of {COMPARABLE:g}; likelihood against even noise, over 20 to 1"
    action = "Record where the joints stand, with all digits."
    if turning:
        sd = digits(to_unit(rounded.step / np.sqrt(12), "deg"))
        keys = " and ".join(f"arms.{arm}.joint_noise_deg: {sd}" for arm in arms)
        action += f" If that cannot be, state what they are off by: {keys}."
    return [
        Finding("warning", text, test, f"{action} If nothing was rounded, the joints miss their commands by as much.")
    ]
