"""What residuals might still depend on: parameters that instruments hold, causes, smooth functions of the records.

A parameter of an instrument that a fit holds, a board's size, how it is bent, a lens, is estimated beside the free
ones, to first order. Rows of one record may err alike, as the corners of an image do: the deviation is that of sums
over records, each residual divided by the root of what the fit left of it, and the t-test counts how few records bear
it. [Bell2002]

A cause is a set of columns: how residuals would move with it, to first order, along the motion of one joint, along the
residual's own entries (base axes for a position), or along the turning of one site.

A smooth function is a sum of harmonics whose coefficients shrink as those of a smooth random function would
[Rasmussen2006], whatever the cause. Its odds against noise are those of its marginal likelihood; what of a record it
predicts from the records of other poses is what is not noise.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import combinations
from typing import Self

import numpy as np
from numpy.polynomial import legendre
from scipy.linalg import eigh
from scipy.special import stdtr

from armcal.arm.assembly import Arm, shown_joint
from armcal.arm.effects import joint_rate
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.diagnose.checks import Finding
from armcal.diagnose.fit import Fit, FitRows, thinned, unbiased_roots
from armcal.estimate.identifiability import Measure, candidates
from armcal.measure.measurement import HasScale, Mistake, NamesMistakes
from armcal.problem.problem import Problem
from armcal.problem.variants import Motion, recorded_order

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
    """Mistakes that instruments name and that are there always: each parameter beside those of all others, so that a
    lens does not pass for a bent board."""
    if not fit.converged:
        return ()
    problem, named = fit.problem, list[tuple[Mistake, str, list[str]]]()
    many = len(problem.blueprint.measurements) > 1
    for instance, measurement in problem.blueprint.measurements.items():
        for one in measurement.mistakes() if isinstance(measurement, NamesMistakes) else ():
            if one.course == "always":
                names = [f"{instance}.{own}" for own in one.parameters]
                words = f"{instance}: {one.words}" if many else one.words
                named.append((one, words, [name for name in names if not problem.parameters[name].free]))
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
    rows, parameters = FitRows.of(wider, estimate), wider.parameters
    lengths = np.maximum(np.linalg.norm(rows.slopes, axis=0), 1e-300)
    left, sizes, right = np.linalg.svd(rows.slopes / lengths, full_matrices=False)
    kept, at = sizes > _RANK * sizes[0], [parameters.coordinate_names.index(name) for name in names]
    basis = left[:, kept]
    sums = (right[kept].T / sizes[kept])[at] @ basis.T / lengths[at, None]
    known = np.sum(right[kept][:, at] ** 2, axis=0) > 1 - _DETERMINED
    variance, freedom = clustered_variance(rows, basis, sums, estimate.noise_scale)
    units = parameters.scales()[at]
    off, sd = -sums @ rows.residual * units, np.where(known, np.sqrt(variance) * units, np.inf)
    values = [float(estimate.values[parameters.entries_of(name)][0]) for name in names]
    numbers = zip(names, values, off.tolist(), sd.tolist(), freedom.tolist(), strict=True)
    return {name: HeldParameter(name, problem.parameters[name].unit, *own) for name, *own in numbers}


def clustered_variance(rows: FitRows, basis: Array, sums: Array, noise_scale: float) -> tuple[Array, Array]:
    """Variances of sums (k x rows) of a fit's rows, which took up ``basis``, and their degrees of freedom
    (Satterthwaite's): no less than of independent rows; priors are as wide as they state."""
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
    """The problem as a function of fixed parameters too; its records serve both. Components that, once free, read a
    channel that these records lack (the approach, for play held at none) stay fixed."""
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


def instruments(fit: Fit) -> list[Finding]:
    findings = []
    for one in fit.of(contradictions):
        text = f"{one.words[:1].upper()}{one.words[1:]}: {'; '.join(map(str, one.parameters))} (1 sd)."
        freedom = min(parameter.freedom for parameter in one.parameters)
        test = "beside the free parameters and others that instruments hold, records as clusters; t, at least "
        test += f"{freedom:.0f} degrees of freedom, {100 * MISTAKEN:g} % each"
        free = f"or free {', '.join(parameter.name for parameter in one.parameters)} (parameters.free) with a prior"
        findings.append(Finding("warning", text, test, f"{one.check}; {free}."))
    return findings


MOST_LEVELS = 12  # Levels of a joint are separated one by one up to so many; beyond, by a cubic
_SLOW = 3
_CUBIC = 3
_AXES = ("x", "y", "z")
_SECOND_LOAD = "repeat some poses with a second payload"
_REPEATS = "repeat one pose at the start, in the middle and at the end"
_STEP_MEASURE = "repeat some of the first poses now, and look at what was touched at that time"
_SURROUNDINGS = (
    ("payload", "the payload", "torsional_spring or compliance; the payload's centre", _SECOND_LOAD),
    ("temperature", "the temperature", "thermal_length", "repeat some poses cold and warm"),
)
_MOST_STEPS, _MOST_SLIPS = 40, 12  # Places of jumps that are looked at: of all that is measured, and of each joint
_FEWEST_APART = 4


@dataclass(frozen=True)
class Cause:
    kind: str  # in the arm ``held`` to ``temperature``; outside of it ``step``, ``slip``, ``gravity``, ``load``, ...
    subject: str  # the joint or site, as a user names it; empty where it is none
    words: str  # what residuals depend on, as the end of a sentence
    effect: str  # the effect that would model it, and on what; empty if there is none
    measure: str  # which measurement would show it
    columns: tuple[Array, ...]  # raw residual by coefficient, one (n_r x N x k) array a factor
    labels: tuple[str, ...] = ()  # what each coefficient is (k), for those that have a unit
    unit: str = ""  # of the coefficients in SI (``rad``, ``m``, ``rad_per_Nm``; ``1`` for shares)
    jumps: bool = False  # a change at one place of the recording; the same change elsewhere is no other cause


@dataclass(frozen=True)
class Records:
    """Records whose residuals are looked at, how these move, what was recorded of them, and functions of it."""

    problem: Problem
    rows: FitRows
    dataset: Dataset
    motion: Motion
    positions: tuple[Array, ...] = ()  # what each factor should read of a position (3 x N; m), or nothing (0 x N)
    moves: Moves = field(default_factory=dict)  # by parameters that are held

    @classmethod
    def of(cls, fit: Fit, chosen: Indices) -> Self:
        """Some of the training records, in this order, with the weights that they had."""
        problem, values = with_contradicted(fit, fit.few_acting).subset(chosen), fit.estimate.values
        dataset, rows, parts = fit.ready.trained.subset(chosen), FitRows.of(problem, fit.estimate), []
        bare = [replace(one, weight=np.sign(one.weight), whitening=None, correlation=None) for one in problem.records]
        wider = freed(problem, candidates(problem.parameters))
        chain, places = wider.parameters.entries_jacobian(values), wider.parameters.coordinates_of
        for kernel, block in zip(wider.kernels, wider.with_records(bare).jacobians(values), strict=True):
            noise = np.array(kernel.factor.noise)[:, None, None]
            parts.append(noise * np.einsum("rvn,vc->rnc", block, chain))
        moves = {name: tuple(part[:, :, own] for part in parts) for name, own in places.items()}
        motion, read = fit.motion.subset(fit.split.train[chosen]), predicted_positions(problem, values, dataset)
        return cls(problem, rows, dataset, motion, read, moves)

    @property
    def arms(self) -> Mapping[str, Arm]:
        return self.problem.blueprint.arms

    @cached_property
    def order(self) -> Array:
        return recorded_order(self.dataset)

    @cached_property
    def rank(self) -> Indices:
        """How many records were recorded before each (N)."""
        return np.argsort(np.argsort(self.order, kind="stable"), kind="stable")

    def named(self, channel: str) -> tuple[str, str]:
        """A joint as users know it, and the SI unit of its position."""
        arm, _, joint = channel.partition(".")
        return shown_joint(channel, self.arms), "rad" if self.arms[arm].commanded[joint] == "angle" else "m"

    def along(self, joint: str, features: Array) -> tuple[Array, ...]:
        return tuple(slope[:, :, None] * features[None] for slope in self.motion.along(joint))

    def axes(self, features: Array) -> tuple[Array, ...]:
        sizes = [slope.shape[0] for slope in self.motion.slopes]
        every = np.einsum("rs,nk->rnsk", np.eye(sum(sizes)), features).reshape(sum(sizes), len(features), -1)
        return tuple(np.split(every, np.cumsum(sizes)[:-1]))

    def jumps(self, columns: Sequence[Array], most: int) -> Iterator[tuple[str, tuple[Array, ...]]]:
        """What columns are from one record on, for several places in the recording, and after which it is, in words."""
        if np.ptp(self.order) <= 0:
            return
        ids, inner = np.array(self.dataset.ids)[np.argsort(self.rank)], len(self.rank) - 2 * _FEWEST_APART + 1
        step = max(_FEWEST_APART, -(-inner // most))
        for place in range(_FEWEST_APART + step // 2, _FEWEST_APART + inner, step):
            after = (self.rank >= place)[:, None]
            yield f"whether a record was measured before or after {ids[place]}", tuple(c * after for c in columns)

    @cached_property
    def inputs(self) -> tuple[Input, ...]:
        return tuple(self._inputs())

    def _inputs(self) -> Iterator[Input]:
        def values(channel: str) -> Array | None:
            column = self.dataset.column(channel) if self.dataset.has(channel) else None
            return column if column is not None and np.nanmax(column) > np.nanmin(column) else None

        def of(kind: str, words: str, channel: str, column: Array | None, closed: bool = False) -> Iterator[Input]:
            if column is not None:
                low, high = np.nanmin(column), np.nanmax(column)
                angle = column if closed else np.pi * (column - low) / ((high - low) or 1.0)
                yield Input(kind, words, channel, np.nan_to_num(angle))

        for channel in self.motion.channels:
            arm, _, joint = channel.partition(".")
            shown, unit = self.named(channel)
            yield from of("joint", f"the angle of {shown}", channel, values(channel), unit == "rad")
            side = values(f"{arm}.approach.{joint}")
            yield from of("approach", f"the side {shown} was approached from", channel, side)
        yield from of("time", "time", "", self.order)
        for kind in ("payload", "temperature"):
            yield from of(kind, f"the {kind}", "", values(kind))

    def functions(self, used: Sequence[int]) -> Functions:
        features = np.hstack([self._features(self.inputs[i]) for i in used])
        along = [self._along(self.inputs[i]) for i in used if self.inputs[i].channel]
        return Functions(np.hstack([*along, self._by_entry(features)]), features)

    @cached_property
    def of_time(self) -> tuple[Functions, ...]:
        return (self.functions([i for i, own in enumerate(self.inputs) if own.kind == "time"]),)

    @cached_property
    def of_pose(self) -> tuple[Functions, ...]:
        """Of all inputs but time together, with pairs of joints and all joints; of near poses; of each input alone."""
        joints = [own for own in self.inputs if own.kind == "joint"]
        features = [self._features(own) for own in self.inputs if own.kind != "time"]
        for one, other in combinations(joints, 2):
            if one.channel.partition(".")[0] == other.channel.partition(".")[0]:
                first, second = (_harmonics(own.angle, 1) for own in (one, other))
                features.append(np.einsum("nk,nl->nkl", first, second).reshape(len(first), -1) / 2)
        chords = np.sum([(2 * np.sin((j.angle[:, None] - j.angle) / 2)) ** 2 for j in joints], axis=0)
        near, far = (np.exp(-chords / (2 * length**2)) for length in _POSE_LENGTHS)
        whole = np.hstack([np.zeros((len(chords), 0)), *features])
        smooth = self._of_kernel(whole @ whole.T + far)
        together = replace(smooth, columns=np.hstack([self.of_joints.columns, smooth.columns]))
        alone = [self.functions([i]) for i, own in enumerate(self.inputs) if own.kind != "time"]
        return (together, self._of_kernel(near), *alone)

    def _of_kernel(self, kernel: Array) -> Functions:
        values, vectors = eigh(kernel)
        most = max(1, _MOST_ENTRIES // self.rows.by_record.shape[1])
        kept = np.flatnonzero(values > _SMALLEST * values[-1])[::-1][:most]
        features = np.asarray(vectors[:, kept] * np.sqrt(values[kept]))
        return Functions(self._by_entry(features), features)

    @cached_property
    def of_joints(self) -> Functions:
        """Of each joint's own angle and the side it came from, along its own motion."""
        none = np.zeros((len(self.rows.residual), 0))
        along = np.hstack([none, *(self._along(own) for own in self.inputs if own.channel)])
        return Functions(along, np.zeros((len(self.rows.by_record), 0)))

    def _features(self, own: Input) -> Array:
        return _harmonics(own.angle, self._highest(_FINE) if own.kind == "time" else _COARSE)

    def _highest(self, most: int) -> int:
        return min(most, max(_COARSE, len(self.rows.by_record) // _RECORDS_PER_HARMONIC))

    @cached_property
    def _moved(self) -> Mapping[str, Array]:
        """The data's rows by the motion of each joint, of size 1 over all joints."""
        raw = {one: [slope[:, :, None] for slope in self.motion.along(one)] for one in self.motion.channels}
        moved = {one: self.rows.columns(of)[: len(self.rows.record_of), 0] for one, of in raw.items()}
        of_all = np.mean([np.mean(own**2) for own in moved.values()])
        return {one: own / (np.sqrt(of_all) or 1.0) for one, own in moved.items()}

    def _along(self, own: Input) -> Array:
        most = min(_FINE, _MOST_ALONG // (2 * len(self.motion.channels))) if own.kind == "joint" else _COARSE
        moved, features = self._moved[own.channel], _harmonics(own.angle, self._highest(most))
        columns = np.zeros((len(self.rows.residual), features.shape[1]))
        columns[: len(moved)] = moved[:, None] * features[self.rows.record_of]
        return columns

    def _by_entry(self, features: Array) -> Array:
        """Functions of each entry of a record's residual for itself; none of an entry that did not take part."""
        by_record, size = self.rows.by_record, features.shape[1]
        whitening = self.rows.whitening
        acting = np.abs(self.rows.columns([np.ones((len(w), w.shape[2], 1)) for w in whitening])[:, 0]) > 0
        columns = np.zeros((len(self.rows.residual), size * by_record.shape[1]))
        for entry, own in enumerate(by_record.T):
            columns[own, entry * size : (entry + 1) * size] = features * acting[own, None]
        return columns


def causes_of(here: Records) -> Iterator[Cause]:
    dataset, parameters = here.dataset, here.problem.parameters
    for name in filter(here.moves.__contains__, candidates(parameters)):
        block, measure = parameters[name], "armcal identify --fixed, which judges it on records held out"
        labels, unit = (("off by",), block.unit) if block.domain.dof == 1 else ((), "")
        effect = f"free {name} (parameters.free)"
        yield Cause("held", name, f"{name}, which is held", effect, measure, here.moves[name], labels, unit)
    yield from _of_order(here)
    for name, arm in here.arms.items():
        for joint in arm.commanded:
            channel = f"{name}.{joint}"
            yield from _of_level(here, channel)
            yield from _of_approach(here, channel)
            yield from _of_coupling(here, channel, arm)
            yield from _of_torque(here, channel, here.motion.loads[name].efforts[arm.joint_names.index(joint)])
        yield from _of_moments(here, arm)
        yield from _of_rates(here, arm)
    for channel, words, effect, measure in _SURROUNDINGS:
        if dataset.has(channel) and np.ptp(dataset.column(channel)) > 0:
            feature = dataset.column(channel)
            columns = here.axes((feature - feature.mean())[:, None] / feature.std())
            yield Cause(channel, "", words, effect, measure, columns)
    yield from _of_mistakes(here)
    yield from _of_loads(here)
    yield from _of_instrument(here)
    yield from _of_steps(here)


def _of_order(here: Records) -> Iterator[Cause]:
    order = here.order
    if np.ptp(order) <= 0:
        return
    slow = legendre.legvander(2 * (order - order.min()) / np.ptp(order) - 1, _SLOW)  # with its mean, as a drift has
    words = "the recorded order: what is measured drifts slowly as a whole"
    yield Cause("order", "", words, "parameters.drift on the base's position", _REPEATS, here.axes(slow))
    for channel in here.motion.channels:
        joint = channel.partition(".")[2]
        words = f"the recorded order: {joint} drifts slowly along its own motion"
        effect = f"parameters.drift on the zero of {joint}"
        yield Cause("order", joint, words, effect, _REPEATS, here.along(channel, slow))


def _of_level(here: Records, channel: str) -> Iterator[Cause]:
    command, (shown, si) = here.dataset.column(channel), here.named(channel)
    levels, labels = np.unique(np.round(command[np.isfinite(command)], 9)), tuple[str, ...]()
    if len(levels) < 2:
        return
    if len(levels) <= MOST_LEVELS:
        unit = display_unit("angle" if si == "rad" else "length").name
        features = (np.abs(command[:, None] - levels[None]) < 1e-8).astype(float)
        labels = tuple(f"{to_unit(level, unit):.4g} {unit}" for level in levels)
    else:
        middle, half = (levels[0] + levels[-1]) / 2, (levels[-1] - levels[0]) / 2
        features = legendre.legvander((command - middle) / half, _CUBIC)[:, 1:]
    features = _centred(features, command)
    what, itself = ("angle", "its own motion") if si == "rad" else ("travel", "itself")
    words = f"the {what} of {shown}, along {itself}"
    effect = f"{'' if len(levels) <= _CUBIC else 'gear_error or '}servo_map on {shown}"
    measure = f"command {shown} to levels in between, from both sides"
    yield Cause("level", shown, words, effect, measure, here.along(channel, features), labels, si)
    words = f"the {what} of {shown}, in directions that {shown} does not move"
    effect = f"more free geometry about {shown}, or compliance there"
    measure = f"{_SECOND_LOAD}: what moves is compliance, the rest geometry of {shown}"
    yield Cause("level", shown, words, effect, measure, here.axes(features))


def _of_approach(here: Records, channel: str) -> Iterator[Cause]:
    arm, _, joint = channel.partition(".")
    (shown, si), side = here.named(channel), f"{arm}.approach.{joint}"
    effect, words = f"approach_backlash on {shown}", f"the side {shown} was approached from"
    if here.dataset.has(side):
        came = here.dataset.column(side)
    else:
        command = np.nan_to_num(here.dataset.column(channel))[np.argsort(here.rank)]
        moved = np.sign(np.diff(command, prepend=command[:1]))
        came = moved[np.maximum.accumulate(np.where(moved != 0, np.arange(len(moved)), 0))][here.rank]
        effect += ", with a column for the approach"
        words += ", if it went from pose to pose in the recorded order"
    if _spread(came) > 0:
        sign, measure = np.nan_to_num(-came[:, None]), f"visit the same poses from both sides of {shown}"
        columns, labels = here.along(channel, sign), ("half of its play",)
        yield Cause("approach", shown, f"{words}, along its own motion", effect, measure, columns, labels, si)
        words += f", in directions that {shown} does not move"
        yield Cause("approach", shown, words, "", measure, here.axes(sign))


def _of_coupling(here: Records, channel: str, arm: Arm) -> Iterator[Cause]:
    joint, shown = channel.partition(".")[2], here.named(channel)[0]
    for other, dimension in arm.commanded.items():
        command = here.dataset.column(f"{arm.name}.{other}")
        if other != joint and dimension == arm.commanded[joint] and _spread(command) > 0:
            words = f"the command of {other}, along {shown}'s own motion: {other} moves {shown} with it"
            measure = f"move {other} alone from end to end, and watch {shown}"
            columns = here.along(channel, _centred(np.nan_to_num(command)[:, None], command))
            yield Cause("coupling", f"{other} on {shown}", words, "", measure, columns, ("share",), "1")


def _of_torque(here: Records, channel: str, effort: Array) -> Iterator[Cause]:
    if _spread(effort) <= 1e-9 * max(1.0, float(np.nanmax(np.abs(effort), initial=0.0))):
        return
    effort, (shown, si) = np.nan_to_num(effort), here.named(channel)
    load, per, cubic = ("torque about", "rad_per_Nm", "rad_per_Nm3") if si == "rad" else ("force along", "", "")
    both = f"poses on both sides of zero {load.split()[0]} at {shown}, some with a second payload"
    laws = (
        (f"the {load} {shown}", f"torsional_spring on {shown}", _SECOND_LOAD, effort, "compliance", per),
        (f"the sign of the {load} {shown}", f"torque_backlash on {shown}", both, np.sign(effort), "half its play", si),
        (f"the size of the {load} {shown}, whatever its sign", "", both, np.abs(effort), "slope", per),
        (f"the cube of the {load} {shown}", f"cubic_spring on {shown}", _SECOND_LOAD, effort**3, "cubic term", cubic),
    )
    for words, effect, measure, feature, label, unit in laws:
        if np.ptp(feature) > 0:
            columns = here.along(channel, feature[:, None])
            yield Cause("torque", shown, words, effect, measure, columns, (label,), unit)


def _of_moments(here: Records, arm: Arm) -> Iterator[Cause]:
    """A symmetric compliance at each site, seen by the factors that measure this arm's tip in its base frame."""
    seen, measurements = [], here.problem.blueprint.measurements
    for factor in (kernel.factor for kernel in here.problem.kernels):
        tip = [channel.rpartition(".")[2] for channel in factor.output_channels] == list(_AXES)
        seen.append(tip and tuple(measurements[factor.name].arms) == (arm.name,))
    loads = here.motion.loads[arm.name]
    for site, (moment, lever) in enumerate(zip(loads.moments, loads.levers, strict=True)):
        pairs = [(j, k) for j in range(3) for k in range(j, 3)]
        moved = [lever[:, j] * moment[k] + (lever[:, k] * moment[j] if j != k else 0) for j, k in pairs]
        turned = np.nan_to_num(np.stack(moved, axis=2))
        if not any(seen) or not np.any(turned):
            continue
        sizes = (slope.shape[0] for slope in here.motion.slopes)
        columns = tuple(turned if yes else np.zeros((n, *turned.shape[1:])) for yes, n in zip(seen, sizes, strict=True))
        name = arm.joint_names[site - 1] if site else "the mount"
        if len(here.arms) > 1:
            name = f"{arm.name}.{name}" if site else f"the mount of {arm.name}"
        words = f"the moment that {name} carries, in all directions"
        yield Cause("moment", name, words, f"compliance on {name}", _SECOND_LOAD, columns)


def _of_rates(here: Records, arm: Arm) -> Iterator[Cause]:
    """Joints read before or after the measurement, which moved in between, to first order in that time; and the play of
    all joints at once, which a delay resembles where each moved about as fast, to and fro."""
    names = {joint: joint_rate(joint).name for joint in arm.commanded}
    shared = any(not names.keys().isdisjoint(other.commanded) for other in here.arms.values() if other is not arm)
    if shared or not all(map(here.dataset.has, names.values())):
        return
    rates = {f"{arm.name}.{joint}": np.nan_to_num(here.dataset.column(rate)) for joint, rate in names.items()}
    moved = [here.along(channel, rate[:, None]) for channel, rate in rates.items()]
    columns = tuple(np.sum(parts, axis=0) for parts in zip(*moved, strict=True))
    which = "the joints" if len(here.arms) == 1 else f"the joints of {arm.name}"
    words = f"how fast {which} moved: they were read at another time than the measurement was made"
    effect = "delay on all joints, or synchronise the clocks of joints and instrument"
    measure = "repeat some poses at rest, where a delay has no effect"
    yield Cause("delay", "", words, effect, measure, columns, ("joints",), "s")
    played = [here.along(channel, -np.sign(rate)[:, None]) for channel, rate in rates.items()]
    columns = tuple(np.concatenate(parts, axis=2) for parts in zip(*played, strict=True))
    words, effect = f"which way {which} moved, each along its own motion", "approach_backlash on all joints"
    measure = "move through the same poses slowly and fast: play stays, what a delay does grows with the rates"
    yield Cause("approach", "all joints", words, effect, measure, columns)


def _of_mistakes(here: Records) -> Iterator[Cause]:
    parameters, measurements = here.problem.parameters, here.problem.blueprint.measurements
    for name, measurement in measurements.items():
        for one in measurement.mistakes() if isinstance(measurement, NamesMistakes) else ():
            if one.course == "always" or np.ptp(here.order) <= 0:
                continue
            blocks = [parameters[f"{name}.{p}"] for p in one.parameters]
            shares = [float(block.nominal[0]) if one.together else 1.0 for block in blocks]
            own = [[share * part for part in here.moves[b.name]] for share, b in zip(shares, blocks, strict=True)]
            columns = [np.concatenate(parts, axis=2) for parts in zip(*own, strict=True)]
            moved = [part.sum(axis=2, keepdims=True) for part in columns] if one.together else columns
            subject, words = (name, f"{name}: {one.words}") if len(measurements) > 1 else ("", one.words)
            if one.course == "slowly":
                labels, unit = (("change",), "1") if one.together else ((), "")
                course = tuple(move * (here.rank / max(len(here.rank) - 1, 1) - 0.5)[:, None] for move in moved)
                yield Cause(one.kind, subject, words, "", one.measure, course, labels, unit)
            else:
                for when, jump in here.jumps(moved, _MOST_SLIPS):
                    yield Cause(one.kind, subject, f"{when}: {words}", "", one.measure, jump, jumps=True)


def _of_loads(here: Records) -> Iterator[Cause]:
    if here.motion.by_load:  # slopes by turns of gravity, its size, mass and place of a payload
        by_load = [slope.transpose(0, 2, 1) for slope in here.motion.by_load]  # n_r x N x (gravity's turn, size, load)
        parts = slice(0, 3), slice(3, 4), slice(4, 8)
        gravity, size, load = (tuple(slope[:, :, part] for slope in by_load) for part in parts)
        level = "level the base, or measure its tilt with a spirit level; gravity is stated in the instrument's frame"
        weigh, turns = "weigh what hangs on the tool", tuple(f"turned about {axis}" for axis in _AXES)
        words, effect = "the direction of gravity in the base frame", "statics.gravity_r?, freed"
        yield Cause("gravity", "", words, effect, level, gravity, turns, "rad")
        words = "the size of gravity, or of all masses together"
        yield Cause("gravity", "size", words, "statics.gravity_m_s2", weigh, size, ("share",), "1")
        yield Cause("load", "", "a load at the tool that is not stated", "statics.payload_g", weigh, load)


def _of_instrument(here: Records) -> Iterator[Cause]:
    """What is read along one axis grows with the coordinate on another."""
    if not any(np.any(position) for position in here.positions):
        return
    known = "measure a known length along each axis with the instrument"

    def columns(*entries: tuple[int, int]) -> tuple[Array, ...]:
        parts = tuple(np.zeros((s.shape[0], len(here.dataset), len(entries))) for s in here.motion.slopes)
        for part, own in zip(parts, here.positions, strict=True):
            for k, (row, other) in enumerate(entries if len(own) else ()):
                part[row, :, k] = -own[other]
        return parts

    together = tuple(np.sum(part, axis=2, keepdims=True) for part in columns((0, 0), (1, 1), (2, 2)))
    words = "the instrument's scale, along all axes alike"
    yield Cause("scale", "", words, "", known, together, ("share",), "1")
    for i, axis in enumerate(_AXES):
        words = f"the instrument's scale along {axis}"
        yield Cause("scale", axis, words, "", known, columns((i, i)), ("share",), "1")
    words, pairs = "the instrument's axes, which are not at right angles", ((0, 1), (0, 2), (1, 2))
    labels = tuple(f"between {_AXES[i]} and {_AXES[j]}" for i, j in pairs)
    yield Cause("scale", "axes", words, "", known, columns(*pairs), labels, "rad")


def _of_steps(here: Records) -> Iterator[Cause]:
    once = np.ones((len(here.dataset), 1))
    shifts, effect = here.axes(once), "the records before and after as groups of their own"
    whole = [("what is measured jumps there as a whole", shifts)]
    if any(map(np.any, here.positions)):
        turned = tuple(np.concatenate([shift, np.zeros((*shift.shape[:2], 3))], axis=2) for shift in shifts)
        for part, own in zip(turned, here.positions, strict=True):
            if len(own):
                part[:3, :, -3:] = np.stack([np.cross(axis, own, axisc=0, axisb=0) for axis in np.eye(3)], axis=2)
        whole.append(("what is measured jumps there as a whole, and turns", turned))
    for words, columns in whole:
        for when, jump in here.jumps(columns, _MOST_STEPS):
            yield Cause("step", "", f"{when}: {words}", effect, _STEP_MEASURE, jump, jumps=True)
    for channel in here.motion.channels:
        shown, si = here.named(channel)
        for when, slip in here.jumps(here.along(channel, once), _MOST_SLIPS):
            yield Cause("slip", shown, f"{when}: {shown} slips there", "", _STEP_MEASURE, slip, ("slip",), si, True)


def predicted_positions(problem: Problem, values: Array, dataset: Dataset) -> tuple[Array, ...]:
    """What each factor should read of a position (3 x N; m), 0 where it reads none; nothing (0 x N) of other factors.
    Not what it does read: the noise of that would be taken for a scale."""
    positions = []
    for kernel, off in zip(problem.kernels, problem.residuals(values), strict=True):
        channels = kernel.factor.position_channels
        read = bool(channels) and all(map(dataset.has, channels))
        positions.append(np.nan_to_num(dataset.stacked(channels) - off[:3]) if read else np.zeros((0, len(dataset))))
    return tuple(positions)


def _spread(feature: Array) -> float:
    """From the smallest to the largest; 0 where no record has it, as those of another arm have not."""
    stated = feature[np.isfinite(feature)]
    return float(np.ptp(stated)) if len(stated) else 0.0


def _centred(features: Array, command: Array) -> Array:
    """About their mean (N x k) in the records that state the command, none in the others."""
    known = np.isfinite(command)[:, None]
    return np.asarray(np.where(known, features - features.mean(axis=0, where=known, keepdims=True), 0.0))


def scatter_features(here: Records) -> Iterator[tuple[str, Array]]:
    """On what the scatter may depend; of the positions those of the first instrument that reads some."""
    yield "the recorded order", here.order
    if (place := next((own for own in here.positions if len(own)), None)) is not None:
        yield from ((f"the coordinate {axis}", coordinate) for axis, coordinate in zip(_AXES, place, strict=True))
        yield "the distance from the instrument", np.linalg.norm(place, axis=0)
    for channel in here.motion.channels:
        joint, command = channel.rpartition(".")[2], np.nan_to_num(here.dataset.column(channel))
        middle = (command.min() + command.max()) / 2
        yield f"the command of {joint}", command
        yield f"how far {joint} is from the middle of its commands", np.abs(command - middle)
    for loads in here.motion.loads.values():
        for number, effort in enumerate(loads.efforts, start=1):
            yield f"the load on joint {number}", np.abs(np.nan_to_num(effort))


WILD = 3.0  # A record farther off than so many medians counts as one that is as far off
_FINE, _COARSE = 30, 3  # Highest harmonics: of time and of a joint along its own motion, of anything else
_RECORDS_PER_HARMONIC = 6
_MOST_ALONG, _MOST_ENTRIES = 300, 180  # So many columns at most: of all joints along their own motion, of the entries
_POSE_LENGTHS = (1.0, 2.0)  # In chords of all joints' angles
_SMALLEST = 1e-4
_RATIOS = np.logspace(-4, 3, 29)
_RIDGE = 0.05


@dataclass(frozen=True)
class Input:
    kind: str  # ``joint``, ``approach``, ``time``, ``payload`` or ``temperature``
    words: str
    channel: str  # of the joint; empty where it is none
    angle: Array  # on a circle, or on half of one where it does not close (N; rad)


@dataclass(frozen=True)
class Functions:
    """Functions of some inputs, whose coefficients are alike in size."""

    columns: Array  # (rows x k)
    features: Array  # the same of each record, whichever entry they move (N x r)

    def imitate(self, function: Array) -> float:
        """Which share of a function (N x n_r) they predict of a record from the others."""
        centred = function - function.mean(axis=0)
        total, kernel = float(np.sum(centred**2)), self.features @ self.features.T
        if not total or not np.any(kernel):
            return 0.0
        inverse = np.linalg.inv(kernel / np.mean(np.diag(kernel)) + _RIDGE * np.eye(len(kernel)))
        left = inverse @ centred / np.diag(inverse)[:, None]
        return max(0.0, 1 - float(np.sum(left**2)) / total)


@dataclass(frozen=True)
class Smooth:
    """The likeliest of some functions, free of what a fit takes up."""

    basis: Array  # of the fit (rows x n), orthonormal
    parts: tuple[tuple[Array, Array], ...]  # an orthonormal basis of each (rows x m), and how large it is along it (m)

    @classmethod
    def of(cls, functions: Sequence[Functions], basis: Array) -> Smooth:
        parts = []
        for one in functions:
            columns = one.columns - basis @ (basis.T @ one.columns)
            values, vectors = eigh(columns.T @ columns)
            kept = values > 1e-9 * max(float(values[-1]), 1e-300)
            parts.append((columns @ (vectors[:, kept] / np.sqrt(values[kept])), values[kept]))
        return cls(basis, tuple(parts))

    def gains(self, residuals: Array) -> Array:
        """Logarithms of the odds of the likeliest function in each residual (rows x m), against noise alone (m)."""
        return np.asarray(np.max([self._by_ratio(*part, residuals).max(axis=0) for part in self.parts], axis=0))

    def evidence(self, residual: Array) -> float:
        """The logarithm of the odds in one residual (rows), the choice of a ratio paid for."""
        return float(self.gains(residual[:, None])[0] - np.log(len(self.basis) - self.basis.shape[1]))

    def predicted(self, residual: Array, groups: Sequence[Indices]) -> tuple[Array, float]:
        """The likeliest function in a residual (rows), and which share of squares it predicts: of each group of rows by
        the others, as compared with the fit alone; wild ones are bounded."""
        gains = [self._by_ratio(*part, residual[:, None])[:, 0] for part in self.parts]
        best = int(np.argmax([own.max() for own in gains]))
        (axes, sizes), ratio = self.parts[best], _RATIOS[int(np.argmax(gains[best]))]
        taken = ratio * sizes / (1 + ratio * sizes)
        function, hat = axes @ (taken * (axes.T @ residual)), axes * np.sqrt(taken)
        missed = np.zeros((2, len(groups)))  # with the function, and without it
        for i, own in enumerate(groups):
            kept = (1 + 1e-9) * np.eye(len(own)) - self.basis[own] @ self.basis[own].T
            left = np.linalg.solve(kept - hat[own] @ hat[own].T, (residual - function)[own])
            missed[:, i] = np.linalg.norm(left), np.linalg.norm(np.linalg.solve(kept, residual[own]))
        bounded = np.minimum(missed, WILD * max(float(np.median(missed[1])), 1e-300))
        with_it, without = np.sum(bounded**2, axis=1)
        return function, float(1 - with_it / max(without, 1e-300))

    def _by_ratio(self, axes: Array, sizes: Array, residuals: Array) -> Array:
        total = np.maximum(np.sum(residuals**2, axis=0), 1e-300)
        taken = _RATIOS[:, None] * sizes / (1 + _RATIOS[:, None] * sizes)
        left = np.maximum(total - taken @ (axes.T @ residuals) ** 2, 1e-12 * total)
        penalty = np.sum(np.log1p(_RATIOS[:, None] * sizes), axis=1)[:, None]
        freedom = len(self.basis) - self.basis.shape[1]
        return np.asarray(-0.5 * (freedom * np.log(left / total) + penalty))


def _harmonics(angle: Array, highest: int) -> Array:
    """Cosines and sines of multiples of an angle: the variance of one falls as 1/order, as if any length were as
    likely."""
    order = np.arange(1, 1 + max(1, min(highest, len(np.unique(np.round(angle, 9))) - 1)))
    turned = angle[:, None] * order
    return np.asarray(np.hstack([np.cos(turned), np.sin(turned)]) * np.sqrt(1 / np.tile(order * np.sum(1 / order), 2)))
