"""What records and priors say of a scale that a fit holds: the printed size of a board, on which all lengths depend.

Where lengths of the arm are free they grow with the board and no residual shows it; only their priors do. So the scale
is estimated beside the free parameters, to first order at the fit, and said with what would not show.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from armcal.diagnose.fit_rows import FitRows
from armcal.diagnose.gross import Figure
from armcal.diagnose.noise_findings import Finding
from armcal.estimate.estimator import Estimate
from armcal.measure.measurement import HasScale
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.tool_motion import apart_from

MOST_RECORDS = 60
_SURE = 2.0
_UNSEEN = 0.2


@dataclass(frozen=True)
class HeldScale:
    """A scale that was not free.

    Attributes:
        name: of its parameter.
        off: by how much it should differ from the value at which it is held, as a share.
        sd: standard deviation of that, records that err alike counted.
    """

    name: str
    off: float
    sd: float


def held_scales(problem: Problem, estimate: Estimate, records: Sequence[FactorRecords]) -> list[HeldScale]:
    """Of all measurements that have one and hold it; ``records`` with the weights they had in the fit.

    The deviation is the larger of the fit's and of that of sums over records, whose rows may err alike. [Bell2002]
    """
    parameters, names = problem.parameters, []
    for instance, measurement in problem.blueprint.measurements.items():
        name = f"{instance}.{measurement.scale}" if isinstance(measurement, HasScale) else ""
        if name in parameters.names and not parameters[name].free:
            names.append(name)
    return [_held(problem, estimate, records, name) for name in names]


def _held(problem: Problem, estimate: Estimate, records: Sequence[FactorRecords], name: str) -> HeldScale:
    free = [block.name for block in problem.parameters.free]
    blueprint = replace(problem.blueprint, parameters=problem.parameters.with_free([*free, name]))
    kernels = blueprint.kernels(0, dict.fromkeys(blueprint.measurements, "interpreted"))
    rows = FitRows.of(Problem(blueprint.parameters, kernels, blueprint, blueprint.ties()), records, estimate)
    at = blueprint.parameters.coordinate_names.index(name)
    alone = apart_from(np.delete(rows.slopes, at, axis=1), rows.slopes[:, [at]])[:, 0]
    size, unit = float(alone @ alone), float(blueprint.parameters.scales()[at])
    if size <= 0:
        return HeldScale(name, 0.0, np.inf)
    off, data = -float(alone @ rows.residual) / size, len(rows.record_of)
    pulls = alone * (rows.residual + alone * off)
    by_record = np.bincount(rows.record_of, pulls[:data], minlength=records[0].count)
    together = np.sqrt(np.sum(by_record**2) + np.sum(alone[data:] ** 2)) / size
    return HeldScale(name, off * unit, max(estimate.noise_scale / np.sqrt(size), float(together)) * unit)


def held_scale_findings(held: Sequence[HeldScale], figure: Figure) -> list[Finding]:
    """What is said of them in the verdict."""
    findings = []
    for one in held:
        most, contradicts = 2 * one.sd, abs(one.off) > _SURE * one.sd
        put = f"records and priors put it {100 * one.off:+.2g} +- {100 * one.sd:.2g} % from there"
        text = f"{one.name} is held, {'although' if contradicts else 'and'} {put}. "
        if most > _UNSEEN:
            text = f"{one.name} is held: an error of it would not show in these data at all."
        elif not contradicts:
            in_mm = f"{most * figure.reach_mm:.2g} mm at the arm's reach"
            text += f"An error of up to {100 * most:.2g} % would not show ({in_mm})."
        action = "Measure the board over its whole width, and state its size; or free the scale with a prior."
        test = "the scale beside the free parameters, two standard deviations"
        findings.append(Finding("warning" if contradicts else "note", text.strip(), test, action))
    return findings
