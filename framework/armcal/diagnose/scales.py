"""Scales that residuals may not show: an instrument's, and one that a fit holds, such as the printed size of a board.

Where lengths of the arm are free they grow with the scale and no residual shows it; only their priors do. So a scale
is estimated beside the free parameters, to first order at the fit, and stated with what would not show.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.domains import Array
from armcal.diagnose.fit_rows import FitRows
from armcal.diagnose.gross import Figure
from armcal.diagnose.noise_findings import Finding
from armcal.diagnose.outside import freed
from armcal.estimate.estimator import Estimate
from armcal.measure.measurement import HasScale
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.tool_motion import apart_from

MOST_RECORDS = 60
UNSEEN = 0.2
"""An error of a scale that is larger than this and would not show is said to be of any size."""
_SURE = 2.0


@dataclass(frozen=True)
class HeldScale:
    """A scale that was not free.

    Attributes:
        name: of its parameter.
        off: by how much it should differ from the value at which it is held, as a share.
        sd: standard deviation of that, records that err alike counted.
        check: how a user finds out what it is.
    """

    name: str
    off: float
    sd: float
    check: str


def held_scales(problem: Problem, estimate: Estimate, records: Sequence[FactorRecords]) -> list[HeldScale]:
    """Of all measurements that have one and hold it; ``records`` with the weights they had in the fit.

    The deviation is the larger of the fit's and of that of sums over records, whose rows may err alike. [Bell2002]
    """
    stated, held = problem.blueprint.measurements.items(), []
    scaled = {f"{instance}.{m.scale}": m.scale_check for instance, m in stated if isinstance(m, HasScale)}
    for name, check in scaled.items():
        if name not in problem.parameters.names or problem.parameters[name].free:
            continue
        wider = freed(problem, [problem.parameters[name]])
        rows, at = FitRows.of(wider, records, estimate), wider.parameters.coordinate_names.index(name)
        alone = apart_from(np.delete(rows.slopes, at, axis=1), rows.slopes[:, [at]])[:, 0]
        size, unit, data = float(alone @ alone), float(wider.parameters.scales()[at]), len(rows.record_of)
        off, sd = 0.0, np.inf
        if size > 0:
            off = -float(alone @ rows.residual) / size
            pulls = alone * (rows.residual + alone * off)
            by_record = np.bincount(rows.record_of, pulls[:data], minlength=records[0].count)
            together = np.sqrt(np.sum(by_record**2) + np.sum(alone[data:] ** 2)) / size
            sd = max(estimate.noise_scale / np.sqrt(size), float(together))
        held.append(HeldScale(name, off * unit, sd * unit, check))
    return held


def scale_deviation(problem: Problem, rows: FitRows, positions: Sequence[Array], noise_scale: float) -> float | None:
    """Standard deviation of an instrument's scale if it were free beside the parameters; None without positions.

    Args:
        problem: of the fit.
        rows: of the fit, priors among them.
        positions: what each factor should read (3 x N, or 0 x N; m), in the same records.
        noise_scale: residuals in units of the declared noise.
    """
    if not any(map(len, positions)):
        return None
    raw = [np.zeros((len(k.factor.noise), len(rows.by_record), 1)) for k in problem.kernels]
    for column, position in zip(raw, positions, strict=True):
        column[: len(position), :, 0] = position
    left = float(np.linalg.norm(apart_from(rows.slopes, rows.columns(raw))))
    return noise_scale / left if left > 0 else float("inf")


def scale_findings(figure: Figure, instrument_sd: float | None, held: Sequence[HeldScale]) -> list[Finding]:
    """In which frame the answer is, which error of a scale would not show, and which held scale the data contradict."""
    findings = []
    if instrument_sd is not None:
        text = (
            f"The answer is in the instrument's frame: in it the arm stands {figure.moved_mm:.3g} mm and "
            f"{figure.turned_deg:.2g} deg from where the configuration has it. An error of the instrument's scale "
            f"{_unseen(instrument_sd, figure)}."
        )
        action = "Measure a known length with the instrument, if the scale matters."
        findings.append(Finding("note", text, "two standard deviations of a scale beside the parameters", action))
    for one in held:
        contradicts = abs(one.off) > _SURE * one.sd
        put = f"records and priors put it {100 * one.off:+.2g} +- {100 * one.sd:.2g} % from there"
        text = f"{one.name} is held, {'although' if contradicts else 'and'} {put}."
        if 2 * one.sd > UNSEEN:
            text = f"{one.name} is held: an error of it {_unseen(one.sd, figure)}."
        elif not contradicts:
            text += f" An error {_unseen(one.sd, figure)}."
        action = f"{one.check}; or free the scale with a prior."
        test = "the scale beside the free parameters, two standard deviations"
        findings.append(Finding("warning" if contradicts else "note", text, test, action))
    return findings


def _unseen(sd: float, figure: Figure) -> str:
    """Which errors of a scale would not show: two standard deviations of it."""
    if 2 * sd > UNSEEN:
        return "would not show in these data at all"
    return f"of up to {200 * sd:.2g} % would not show ({2 * sd * figure.reach_mm:.2g} mm at the arm's reach)"
