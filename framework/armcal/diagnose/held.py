"""Parameters of instruments that a fit holds, and where records put them: a board's size, how it is bent, a lens.

Each is estimated beside the free parameters, to first order at the fit. Rows of one record may err alike, as the
corners of an image do: the deviation is that of sums over records, each residual divided by the root of what the fit
left of it, and the t-test counts how few records bear it. [Bell2002]
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.special import stdtr

from armcal.base.arrays import Array
from armcal.diagnose.checks import Finding
from armcal.diagnose.fit import Fit, thinned
from armcal.diagnose.fit_rows import FitRows, unbiased_roots
from armcal.estimate.identifiability import Measure
from armcal.measure.measurement import HasScale, Mistake, NamesMistakes
from armcal.problem.problem import Problem

Moves = Mapping[str, tuple[Array, ...]]
"""How raw residuals move with each increment of a parameter, by its name (n_r x N x k a factor)."""
MOST_RECORDS = 60
MISTAKEN = 0.001  # Level of each parameter that a mistake names
OFF = 0.05  # Level of a scale, on which every length depends
_DETERMINED = 1e-6
_RANK = 1e-9


@dataclass(frozen=True)
class HeldParameter:
    name: str  # in full
    unit: str  # SI
    value: float  # at which it is held
    off: float  # by how much it should differ from that
    sd: float  # standard deviation of that, rows of a record that err alike counted; infinite if records do not show it
    freedom: float  # degrees of freedom of that deviation

    @property
    def p_value(self) -> float:
        return 2 * float(stdtr(self.freedom, -abs(self.off) / self.sd))

    def __str__(self) -> str:
        shown = Measure(self.unit, 1.0).shown
        (held, unit), (there, _), (sd, _) = map(shown, (self.value, self.value + self.off, self.sd))
        digits = int(np.clip(1 - np.floor(np.log10(max(sd, 1e-9))), 0, 9))
        at, put = f"{held:.6g} {unit}".rstrip(), f"{there:.{digits}f} +- {sd:.{digits}f} {unit}".rstrip()
        return f"{self.name} is held at {at}, but the records put it at {put}"


@dataclass(frozen=True)
class Contradiction:
    """A mistake with an instrument that records show: ``words`` says which, ``check`` what to do about it."""

    words: str
    check: str
    parameters: tuple[HeldParameter, ...]


def contradictions(fit: Fit) -> tuple[Contradiction, ...]:
    """Mistakes that instruments name and that are there always.

    Each parameter is judged beside all others of such mistakes, so that a lens does not pass for a bent board.
    """
    if not fit.converged:
        return ()
    problem, named = fit.problem, list[tuple[Mistake, str, list[str]]]()
    many = len(problem.blueprint.measurements) > 1
    for instance, measurement in problem.blueprint.measurements.items():
        for one in measurement.mistakes() if isinstance(measurement, NamesMistakes) else ():
            if one.course == "always":
                own = [problem.parameters[f"{instance}.{name}"] for name in one.parameters]
                words = f"{instance}: {one.words}" if many else one.words
                named.append((one, words, [block.name for block in own if not block.free]))
    judged = _held_parameters(fit, problem, [name for *_, names in named for name in names])
    off = {name: one for name, one in judged.items() if one.p_value < MISTAKEN}
    return tuple(
        Contradiction(words, mistake.measure, tuple(off[name] for name in names if name in off))
        for mistake, words, names in named
        if not off.keys().isdisjoint(names)
    )


def with_contradicted(fit: Fit, problem: Problem) -> Problem:
    return freed(problem, [parameter.name for one in fit.of(contradictions) for parameter in one.parameters])


def held_scales(fit: Fit) -> list[tuple[HeldParameter, str]]:
    problem = with_contradicted(fit, fit.problem)
    scaled = [(f"{n}.{m.scale}", m) for n, m in problem.blueprint.measurements.items() if isinstance(m, HasScale)]
    checks = {n: m.scale_check for n, m in scaled if n in problem.parameters.names and not problem.parameters[n].free}
    return [(one, checks[name]) for name, one in _held_parameters(fit, problem, list(checks)).items()]


def _held_parameters(fit: Fit, problem: Problem, names: Sequence[str]) -> dict[str, HeldParameter]:
    """Where records put parameters of one number each that a fit held, by name, each beside the others."""
    if not names:
        return {}
    some = fit.acting.subset(thinned(np.arange(fit.acting.count), MOST_RECORDS))
    estimate, wider = fit.estimate, freed(problem, names).with_records(some.records)
    rows, coordinates = FitRows.of(wider, estimate), wider.parameters.coordinate_names
    lengths = np.maximum(np.linalg.norm(rows.slopes, axis=0), 1e-300)
    left, sizes, right = np.linalg.svd(rows.slopes / lengths, full_matrices=False)
    kept, at = sizes > _RANK * sizes[0], [coordinates.index(name) for name in names]
    basis = left[:, kept]
    sums = (right[kept].T / sizes[kept])[at] @ basis.T / lengths[at, None]
    known = np.sum(right[kept][:, at] ** 2, axis=0) > 1 - _DETERMINED
    variance, freedom = clustered_variance(rows, basis, sums, estimate.noise_scale)
    units = wider.parameters.scales()[at]
    off, sd = -sums @ rows.residual * units, np.where(known, np.sqrt(variance) * units, np.inf)
    values = [float(estimate.values[wider.parameters.entries_of(name)][0]) for name in names]
    numbers = zip(names, values, off.tolist(), sd.tolist(), freedom.tolist(), strict=True)
    return {
        name: HeldParameter(name, problem.parameters[name].unit, value, by, deviation, spare)
        for name, value, by, deviation, spare in numbers
    }


def clustered_variance(rows: FitRows, basis: Array, sums: Array, noise_scale: float) -> tuple[Array, Array]:
    """Variances of sums (k x rows) of a fit's rows, and their degrees of freedom (Satterthwaite's).

    The fit took up an orthonormal ``basis``. No variance is less than that of independent rows; priors are as wide as
    they state.
    """
    data = len(rows.record_of)
    whole = rows.residual - basis @ (basis.T @ rows.residual)
    own, taken = list[Array](), list[Array]()
    by_records = np.zeros(len(sums))
    for record, root in unbiased_roots(rows, basis):
        weighed = sums[:, record] @ root
        by_records += (weighed @ whole[record]) ** 2
        own.append(np.sum(weighed**2, axis=1))
        taken.append(weighed @ basis[record])
    sizes, across = np.array(own), np.einsum("gkn,hkn->kgh", taken, taken, optimize=True)
    pairs = np.einsum("gk,gh->kgh", sizes, np.eye(len(sizes))) - across
    freedom = np.trace(pairs, axis1=1, axis2=2) ** 2 / np.maximum(np.sum(pairs**2, axis=(1, 2)), 1e-300)
    by_priors, apart = np.sum(sums[:, data:] ** 2, axis=1), np.sum(sums[:, :data] ** 2, axis=1)
    freedom *= ((by_records + by_priors) / np.maximum(by_records, 1e-300)) ** 2
    return np.maximum(by_records, noise_scale**2 * apart) + by_priors, np.maximum(freedom, 1.0)


def freed(problem: Problem, names: Sequence[str]) -> Problem:
    """The problem as a function of fixed parameters too; its records serve both.

    Components that, once free, read a channel that these records lack (the approach, for play held at none) stay fixed.
    """
    if not names:
        return problem
    plan = problem.blueprint
    parameters = plan.parameters.with_free([*(block.name for block in plan.parameters.free), *names])
    plan, kept = replace(plan, parameters=parameters), ("channels", "output_channels", "noise", "dimensions", "points")
    kernels = plan.kernels(0, dict.fromkeys(plan.measurements, "interpreted"))
    pairs = [*zip(kernels, problem.kernels, strict=True)]  # of the points that are looked at, which may be few
    if any(k.channels[: k.shared] != own.channels[: own.shared] for k, own in ((a.factor, b.factor) for a, b in pairs)):
        owners = dict.fromkeys(name.rpartition(".")[0] for name in names)
        parts = [[name for name in names if name.rpartition(".")[0] == owner] for owner in owners]
        alike = [name for part in parts if len(parts) > 1 and freed(problem, part) is not problem for name in part]
        return freed(problem, alike)
    same = (replace(k, factor=replace(k.factor, **{n: getattr(own.factor, n) for n in kept})) for k, own in pairs)
    compiled = replace(problem.compiled, parameters=parameters, kernels=tuple(same), blueprint=plan)
    return replace(problem, compiled=compiled)


def moves_of(problem: Problem, values: Array, held: Sequence[str]) -> Moves:
    wider = freed(problem, held)
    bare = [replace(one, weight=np.sign(one.weight), whitening=None, correlation=None) for one in problem.records]
    chain, parts = wider.parameters.entries_jacobian(values), []
    for kernel, block in zip(wider.kernels, wider.with_records(bare).jacobians(values), strict=True):
        noise = np.array(kernel.factor.noise)[:, None, None]
        parts.append(noise * np.einsum("rvn,vc->rnc", block, chain))
    return {name: tuple(part[:, :, own] for part in parts) for name, own in wider.parameters.coordinates_of.items()}


def instruments(fit: Fit) -> list[Finding]:
    findings = []
    for one in fit.of(contradictions):
        text = f"{one.words[:1].upper()}{one.words[1:]}: {'; '.join(map(str, one.parameters))} (1 sd)."
        freedom = min(parameter.freedom for parameter in one.parameters)
        test = (
            f"beside the free parameters and others that instruments hold, records as clusters; t, at least "
            f"{freedom:.0f} degrees of freedom, {100 * MISTAKEN:g} % each"
        )
        free = f"or free {', '.join(parameter.name for parameter in one.parameters)} (parameters.free) with a prior"
        findings.append(Finding("warning", text, test, f"{one.check}; {free}."))
    return findings
