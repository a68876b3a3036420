"""A problem: records, and the arms, measurements and parameters that are compiled once to evaluate them.

Solvers see it posed: residuals and priors over scaled increments from the nominal values. A solver of smooth problems
moves ``x`` (n), increments in their typical scales. A cone solver moves ``c`` (n), coordinates in their typical scales,
in which priors are quadratic and a semidefinite block is a cone.
"""

from __future__ import annotations

import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Self

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, scoped
from armcal.arm.effects import JointCommand
from armcal.arm.statics import Environment
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.se3 import Expression
from armcal.errors import DataError, NotConvergedError, ProblemError
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.groups import (
    NO_GROUP,
    Groups,
    OwnedTie,
    group_name,
    group_numbers,
    groups_of,
    owner_of,
    refuse_lost,
    ties_of,
    with_partners,
)
from armcal.measure.measurement import GroupedMeasurement, Measurement
from armcal.plugins import refuse
from armcal.problem.factor import build_factor
from armcal.problem.kernel import HELD, GroupedKernel, Kernel, Shown, build_kernel
from armcal.problem.records import (
    Correlation,
    FactorRecords,
    applicable,
    correlation_of,
    factor_records,
    mean_shares,
    subset,
    transformed,
    weighted,
)

__all__ = ["Compiled", "FactorRecords", "NormalEquations", "Problem", "triangular"]


@dataclass(frozen=True)
class NormalEquations:
    """Half the squared whitened residuals, gradient (n) and Gauss-Newton Hessian by the free canonical entries."""

    cost: float
    gradient: Array
    hessian: Array

    def chained(self, jacobian: Array) -> NormalEquations:
        return NormalEquations(self.cost, jacobian.T @ self.gradient, jacobian.T @ self.hessian @ jacobian)


@dataclass(frozen=True)
class ExtraRows:
    """Whitened rows that belong to no single record: residual (m) and Jacobian by free entries (m x n)."""

    residual: Array
    jacobian: Array


def stacked(rows: Sequence[ExtraRows], width: int) -> ExtraRows:
    residual = np.concatenate([np.zeros(0), *(row.residual for row in rows)])
    return ExtraRows(residual, np.vstack([np.zeros((0, width)), *(row.jacobian for row in rows)]))


@dataclass(frozen=True)
class TieFunction:
    groups: tuple[str, str]  # the keys
    entries: Indices  # positions in a value vector of what it holds together (n)
    noise: Array  # standard deviation of each entry of its residual
    function: ca.Function  # of those numbers to the residual (m or rad) and its Jacobian
    bend: ca.Function  # of these and a factor for each entry of the residual: second derivative of their product

    @classmethod
    def of(cls, owned: OwnedTie, parameters: Parameters) -> TieFunction:
        entries: list[int] = []
        sides: tuple[dict[str, Expression], dict[str, Expression]] = ({}, {})
        for side, names in zip(sides, owned.names, strict=True):
            for local, full in names.items():
                own = range(len(parameters.entry_names))[parameters.entries_of(full)]
                side[local] = ca.SX.sym(local, len(own))
                entries += own
        symbols = ca.vertcat(*sides[0].values(), *sides[1].values())
        residual = owned.tie.residual(*sides)
        outputs = [ca.densify(residual), ca.densify(ca.jacobian(residual, symbols))]
        function = ca.Function("tie", [symbols], outputs)
        factors = ca.SX.sym("factors", len(owned.tie.noise))
        second = ca.densify(ca.hessian(ca.dot(factors, residual), symbols)[0])
        bend = ca.Function("tie_bend", [symbols, factors], [second])
        return cls(owned.tie.groups, np.array(entries, dtype=np.intp), np.array(owned.tie.noise), function, bend)

    def residual(self, values: Array) -> Array:
        return np.asarray(self.function(values[self.entries])[0]).ravel()

    def rows(self, values: Array, places: Mapping[int, int], width: int) -> ExtraRows:
        """Whitened; ``places`` are those of free entries by position in the value vector."""
        residual, slope = (np.asarray(dm) for dm in self.function(values[self.entries]))
        columns, free = self._free(places)
        jacobian = np.zeros((len(self.noise), width))
        jacobian[:, free] = slope[:, columns]
        return ExtraRows(residual.ravel() / self.noise, jacobian / self.noise[:, None])

    def curvature(self, values: Array, places: Mapping[int, int], width: int) -> Array:
        second = np.asarray(self.bend(values[self.entries], self.residual(values) / self.noise**2))
        columns, free = self._free(places)
        whole = np.zeros((width, width))
        whole[np.ix_(free, free)] = second[np.ix_(columns, columns)]
        return whole

    def _free(self, places: Mapping[int, int]) -> tuple[list[int], list[int]]:
        columns = [column for column, entry in enumerate(self.entries.tolist()) if entry in places]
        return columns, [places[int(self.entries[column])] for column in columns]


@dataclass(frozen=True)
class Blueprint:
    """Arms, measurements and what else their expressions take; ``channels`` are those that the records carry,
    ``groups`` those that they fall into."""

    arms: Mapping[str, Arm]
    measurements: Mapping[str, Measurement]
    parameters: Parameters
    environment: Environment
    channels: frozenset[str]
    groups: Groups = field(default_factory=dict)

    def with_corrections(self, dataset: Dataset) -> Dataset:
        """With corrections, made once for all, of arms with a pose residual: zero where it has not learned."""
        channels = dict(dataset.channels)
        for arm in self.arms.values():
            if arm.residual is not None and arm.residual.is_learned:
                corrections = arm.residual.corrections(arm.postures(dataset, self.environment))
                channels |= zip(arm.correction_channels, corrections, strict=True)
            elif arm.residual is not None:
                channels |= dict.fromkeys(arm.correction_channels, np.zeros(len(dataset)))
        return replace(dataset, channels=channels) if len(channels) > len(dataset.channels) else dataset

    def kernels(self, records: int, choices: Mapping[str, EvaluatorChoice]) -> tuple[Kernel, ...]:
        shared = (self.arms, self.parameters, self.environment, self.channels)
        return tuple(
            build_kernel(build_factor(name, measurement, *shared), records, choices[name])
            for name, measurement in self.measurements.items()
        )

    def grouped(self, kernels: Sequence[Kernel], parameters: Parameters) -> tuple[GroupedKernel, ...]:
        names, compiled, width = parameters.entry_names, self.parameters, len(parameters.free_entries)
        place = np.full(len(names), HELD, dtype=np.intp)
        place[list(parameters.free_entries)] = np.arange(width)
        entries_of = {b.name: range(len(names))[compiled.entries_of(b.name)] for b in compiled.blocks}
        main = [i for b in compiled.blocks if b.free and not b.nuisance for i in entries_of[b.name]]
        result = []
        for kernel, (instance, measurement) in zip(kernels, self.measurements.items(), strict=True):
            rows, spare = [main], np.zeros(0)
            if isinstance(measurement, GroupedMeasurement):
                owner, local = owner_of(instance, measurement), measurement.group_parameters("")
                spare = np.array([x for block in local for x in block.nominal])
                own = [
                    [i for b in local for i in entries_of[group_name(owner, key, b.name)]]
                    for key in self.groups.get(owner, ())
                ]
                rows = [[*main, *group] for group in own or [[HELD] * len(spare)]]
            entries = np.array(rows, dtype=np.intp).reshape(len(rows), -1)
            free = np.where(entries == HELD, HELD, place[entries])
            result.append(GroupedKernel(kernel, entries, free, width, spare))
        return tuple(result)

    def ties(self) -> tuple[TieFunction, ...]:
        owned = ties_of(self.measurements, self.groups)
        return tuple(TieFunction.of(owned_tie, self.parameters) for owned_tie in owned)

    def bare(self) -> Self:
        """The same, its arms without what they keep of their expressions, which cannot be pickled."""
        return replace(self, arms={name: replace(arm) for name, arm in self.arms.items()})


@dataclass(frozen=True)
class Compiled:
    """Kernels over one set of parameters, which problems of any records share.

    In another process it is compiled anew, once, from its blueprint and by the same evaluators.
    """

    parameters: Parameters
    kernels: tuple[Kernel, ...]
    blueprint: Blueprint
    known_ties: tuple[TieFunction, ...] = ()

    def __reduce__(self) -> tuple[Any, ...]:
        return _from_bytes, (self._bytes,)

    @cached_property
    def _bytes(self) -> bytes:
        choices = {k.factor.name: k.backend.name for k in self.kernels}
        return pickle.dumps((self.blueprint.bare(), choices, self.parameters))

    @cached_property
    def grouped(self) -> tuple[GroupedKernel, ...]:
        return self.blueprint.grouped(self.kernels, self.parameters)

    @cached_property
    def ties(self) -> tuple[TieFunction, ...]:
        """What is known between groups that are free, or free and known.

        A group held because no record belongs to it is not known: a tie to where it starts would be invented.
        """
        free, could = set(self.parameters.free_entries), set(self.blueprint.parameters.free_entries)
        sides = [[set(side.tolist()) for side in np.split(tie.entries, 2)] for tie in self.known_ties]
        return tuple(
            tie
            for tie, both in zip(self.known_ties, sides, strict=True)
            if any(side & free for side in both) and all(side & free or not side & could for side in both)
        )

    @cached_property
    def places(self) -> dict[int, int]:
        return {entry: i for i, entry in enumerate(self.parameters.free_entries)}

    def records(self, dataset: Dataset, weights: Array | None = None) -> tuple[FactorRecords, ...]:
        plan = self.blueprint
        dataset = with_partners(plan.with_corrections(dataset), plan.measurements)
        factors = [kernel.factor for kernel in self.kernels]
        numbers = [group_numbers(dataset, name, m, plan.groups) for name, m in plan.measurements.items()]
        masks = [applicable(f, dataset, n) for f, n in zip(factors, numbers, strict=True)]
        # A record that no measurement can read stays with all whose group it names, so that an error names it.
        unread = ~np.any(masks, axis=0)
        readers = [unread if number is None else unread & (number != NO_GROUP) for number in numbers]
        refuse_lost(dataset, plan.measurements, unread & ~np.any(readers, axis=0))
        return tuple(
            factor_records(factor, dataset, number, mask | reader, weights)
            for factor, number, mask, reader in zip(factors, numbers, masks, readers, strict=True)
        )

    def check_fixed(self, values: Array) -> None:
        fixed = self._compiled_in
        if not np.array_equal(values[fixed], self.parameters.nominal()[fixed]):
            raise ValueError("a fixed parameter differs from the value the problem was compiled with")

    @cached_property
    def _compiled_in(self) -> Indices:
        plan = self.blueprint.parameters
        held = [block.name for block in plan.blocks if not block.free and not block.nuisance]
        return np.array([i for name in held for i in range(*plan.entries_of(name).indices(1 << 30))], dtype=np.intp)


@dataclass(frozen=True)
class Problem:
    """Records, and what evaluates them: values in; residuals, Jacobians, normal equations, cost and predictions out.

    What evaluates them is compiled once; problems of other records, weights or free parameters share it and are made
    at no cost. Whatever evaluates records at values, here and in the rooms below, raises ``NotConvergedError`` where
    one has no elastic equilibrium.

    Value vectors hold all canonical entries. Those that the blueprint fixes are compiled in and must be the nominal
    ones; ``parameters`` may hold more.
    """

    compiled: Compiled
    records: tuple[FactorRecords, ...]  # one entry a measurement, each of all records

    @classmethod
    def build(
        cls,
        arms: Mapping[str, Arm],
        measurements: Mapping[str, Measurement],
        parameters: Parameters,
        environment: Environment,
        dataset: Dataset,
        evaluator: EvaluatorChoice = "auto",
        groups: Groups | None = None,
    ) -> Self:
        """Compile for datasets with the channels of this one, and its groups where none are given."""
        whole = with_partners(dataset, measurements)
        if groups is None:
            groups = groups_of(whole, measurements) if parameters.nuisances else {}
        blueprint = Blueprint(arms, measurements, parameters, environment, frozenset(whole.channels), groups)
        kernels = blueprint.kernels(len(whole), dict.fromkeys(measurements, evaluator))
        compiled = Compiled(parameters, kernels, blueprint, blueprint.ties())
        return cls(compiled, compiled.records(dataset))

    def of(self, dataset: Dataset, weights: Array | None = None) -> Self:
        return replace(self, records=self.compiled.records(dataset, weights))

    def with_records(self, records: Sequence[FactorRecords]) -> Self:
        return replace(self, records=tuple(records))

    def with_record(self, number: int, records: FactorRecords) -> Self:
        return replace(self, records=(*self.records[:number], records, *self.records[number + 1 :]))

    def with_parameters(self, parameters: Parameters, tied: bool = True) -> Self:
        """The same blocks, other ones of them free, or with other nominal values or priors; groups not ``tied``."""
        ties = self.compiled.known_ties if tied else ()
        return replace(self, compiled=replace(self.compiled, parameters=parameters, known_ties=ties))

    def with_arms(self, arms: Mapping[str, Arm]) -> Self:
        """With pose residuals that arms have learned, which no kernel holds."""
        return replace(self, compiled=replace(self.compiled, blueprint=replace(self.blueprint, arms=arms)))

    def evaluated_by(self, evaluator: EvaluatorChoice) -> Self:
        kernels = self.blueprint.kernels(0, dict.fromkeys(self.blueprint.measurements, evaluator))
        return replace(self, compiled=replace(self.compiled, kernels=kernels))

    def subset(self, chosen: Indices) -> Self:
        return replace(self, records=subset(self.records, chosen))

    def unweighted(self) -> Self:
        """With the weights of all records one, and none correlated."""
        alike = [replace(record, weight=np.ones_like(record.weight), correlation=None) for record in self.records]
        return self.with_records(alike)

    def weighted(self, weights: Sequence[Array]) -> Self:
        return replace(self, records=weighted(self.records, weights))

    @property
    def parameters(self) -> Parameters:
        return self.compiled.parameters

    @property
    def kernels(self) -> tuple[Kernel, ...]:
        return self.compiled.kernels

    @property
    def blueprint(self) -> Blueprint:
        return self.compiled.blueprint

    @property
    def grouped(self) -> tuple[GroupedKernel, ...]:
        return self.compiled.grouped

    @property
    def ties(self) -> tuple[TieFunction, ...]:
        return self.compiled.ties

    @property
    def backend(self) -> str:
        return ", ".join(sorted({kernel.backend.name for kernel in self.kernels}))

    @property
    def increments(self) -> int:
        return len(self.parameters.coordinate_names)

    @property
    def free_names(self) -> tuple[str, ...]:
        return tuple(self.parameters.entry_names[i] for i in self.parameters.free_entries)

    @property
    def count(self) -> int:
        return self.records[0].count if self.records else 0

    @property
    def correlation(self) -> Correlation | None:
        return correlation_of(self.records)

    @property
    def pairs(self) -> Iterator[tuple[GroupedKernel, FactorRecords]]:
        return zip(self.grouped, self.records, strict=True)

    def equations(self) -> int:
        own = sum(record.equations(len(grouped.kernel.factor.noise)) for grouped, record in self.pairs)
        return own + sum(len(tie.noise) for tie in self.ties)

    def residuals(self, values: Array) -> tuple[Array, ...]:
        """Raw residuals in equilibrium, one (n_r x N) matrix a factor."""
        self.compiled.check_fixed(values)
        return tuple(grouped.residuals(values, record)[:, : record.count] for grouped, record in self.pairs)

    def residuals_beside(self, training: Self, values: Array) -> tuple[Array, ...]:
        """Raw residuals less the drift that training records of the recording determine, one (n_r x N) a factor."""
        raw, here, there = self.residuals(values), self.correlation, training.correlation
        if here is None or there is None:
            return raw
        return here.taken_off(raw, there.states([r[:, :, None] for r in training.weighted_residuals(values)]))

    def require_held(self, values: Array) -> None:
        """Refuse values at which a record has no elastic equilibrium, or none that is stable (NotConvergedError)."""
        self.residuals(values)
        for grouped, record in self.pairs:
            grouped.require_held(values, record)

    def cost(self, values: Array) -> float:
        """Half the weighted squared whitened residuals."""
        raw, shared = self.residuals(values), self.correlation
        weighted = self.weighted_residuals(values, raw)
        if shared is not None:
            weighted = shared.independent([residual[:, :, None] for residual in weighted])
        total = sum(0.5 * float(np.sum(residual**2)) for residual in weighted)
        for kernel, record, residual in zip(self.kernels, self.records, raw, strict=True):
            declared_ones = residual / np.array(kernel.factor.noise)[:, None]
            for share in mean_shares(kernel.factor, record):
                total += 0.5 * float(np.sum((declared_ones @ share[: record.count]) ** 2))
        return total + sum(0.5 * float(np.sum((tie.residual(values) / tie.noise) ** 2)) for tie in self.ties)

    def weighted_residuals(self, values: Array, raw: Sequence[Array] | None = None) -> tuple[Array, ...]:
        whitened = self.whitened(self.residuals(values) if raw is None else raw)
        pairs = zip(self.records, whitened, strict=True)
        return tuple(residual * np.sqrt(record.weight[: record.count]) for record, residual in pairs)

    def whitened_residuals(self, values: Array) -> tuple[Array, ...]:
        """Residuals in units of their noise, weights left out, one (n_r x N) matrix a factor."""
        return self.whitened(self.residuals(values))

    def whitened(self, residuals: Sequence[Array]) -> tuple[Array, ...]:
        return tuple(
            transformed(record.whitening[:, :, : record.count], residual)
            if record.whitening is not None
            else residual / np.array(kernel.factor.noise)[:, None]
            for kernel, record, residual in zip(self.kernels, self.records, residuals, strict=True)
        )

    def normal_equations(self, values: Array) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian, accumulated in blocks: memory does not grow with the records.

        Correlated records are made independent all at once.
        """
        entries = len(self.parameters.free_entries)
        cost, gradient, hessian = 0.0, np.zeros(entries), np.zeros((entries, entries))
        for jacobian, residual in self._independent_blocks(values):
            cost += 0.5 * float(np.sum(residual**2))
            gradient = gradient + np.einsum("kvb,kb->v", jacobian, residual)
            hessian = hessian + sum((part @ part.T for part in jacobian), np.zeros((entries, entries)))
        extra = self._extra(values)
        cost += 0.5 * float(extra.residual @ extra.residual)
        gradient = gradient + extra.jacobian.T @ extra.residual
        return NormalEquations(cost, gradient, hessian + extra.jacobian.T @ extra.jacobian)

    def triangular_factor(self, values: Array) -> Array:
        """R with R'R = J'J of the whitened residuals by coordinates: singular values keep their condition."""
        chain = self.parameters.entries_jacobian(values)
        triangle = np.zeros((0, self.increments))
        for jacobian, _ in self._independent_blocks(values):
            rows = np.concatenate([chain.T @ part for part in jacobian], axis=1).T
            triangle = triangular(np.vstack([triangle, rows]))
        return triangular(np.vstack([triangle, self._extra(values).jacobian @ chain]))

    def jacobians(self, values: Array) -> tuple[Array, ...]:
        """Whitened, weighted Jacobians by free canonical entries, one (n_r x n_v x N) array a factor."""
        self.compiled.check_fixed(values)
        blocks = (grouped.linearised(values, record) for grouped, record in self.pairs)
        whole = (np.concatenate([jacobian for jacobian, _ in of_factor], axis=2) for of_factor in blocks)
        return tuple(jacobian[:, :, : record.count] for jacobian, record in zip(whole, self.records, strict=True))

    def exact_hessian(self, values: Array) -> Array:
        """The Hessian of ``cost`` by free canonical entries with the curvature of the residuals (n x n).

        Of correlated records the Gauss-Newton one: their curvature would couple all of them. Nor has it the
        curvature of groups' means, where these weigh more than their records say.
        """
        if self.correlation is not None:
            return self.normal_equations(values).hessian
        self.residuals(values)
        total = sum(grouped.exact_hessian(values, record) for grouped, record in self.pairs)
        beside, places = self._extra(values).jacobian, self.compiled.places
        size = len(places)
        bends = sum((tie.curvature(values, places, size) for tie in self.ties), np.zeros((size, size)))
        return total + beside.T @ beside + bends

    def channel_slopes(self, values: Array, channels: Sequence[str]) -> tuple[Array, ...]:
        """d residual / d record channels in equilibrium, one (n_r x channels x N) array a factor; raw, not whitened."""
        self.residuals(values)
        return tuple(
            grouped.channel_slopes(values, record, channels)[:, :, : record.count] for grouped, record in self.pairs
        )

    def predict(self, values: Array) -> tuple[Shown, ...]:
        self.compiled.check_fixed(values)
        return tuple(grouped.predict(values, record) for grouped, record in self.pairs)

    def by_channel(self, shown: Sequence[Shown]) -> dict[str, Array]:
        pairs = [(kernel.factor.output_channels, own.outputs) for kernel, own in zip(self.kernels, shown, strict=True)]
        return {name: row for names, rows in pairs for name, row in zip(names, rows, strict=True)}

    def nuisance_starts(self, values: Array) -> tuple[Array, ...]:
        """Where each record alone has its group's parameters start, one (entries x N) matrix a factor."""
        return tuple(grouped.nuisance_starts(values, record)[:, : record.count] for grouped, record in self.pairs)

    def tie_rows(self, values: Array) -> ExtraRows:
        places = self.compiled.places
        return stacked([tie.rows(values, places, len(places)) for tie in self.ties], len(places))

    def _extra(self, values: Array) -> ExtraRows:
        rows = [self.tie_rows(values)]
        for grouped, record in self.pairs:
            rows += [ExtraRows(residual, jacobian) for jacobian, residual in grouped.linearised_means(values, record)]
        return stacked(rows, len(self.compiled.places))

    def _independent_blocks(self, values: Array) -> Iterator[tuple[Array, Array]]:
        """Blocks whose rows are independent: as they are, or made so where records are correlated."""
        self.compiled.check_fixed(values)
        shared = self.correlation
        if shared is None:
            for grouped, record in self.pairs:
                yield from grouped.linearised(values, record)
            return
        rows = []
        for grouped, record in self.pairs:
            blocks = grouped.linearised(values, record)
            rows.append(np.concatenate([np.concatenate([j, r[:, None]], axis=1) for j, r in blocks], axis=2))
        for made in shared.independent([np.moveaxis(row, 1, 2) for row in rows]):
            yield np.moveaxis(made[:, :, :-1], 1, 2), made[:, :, -1]


@lru_cache(maxsize=64)
def _from_bytes(written: bytes) -> Compiled:
    blueprint, choices, parameters = pickle.loads(written)
    return Compiled(parameters, blueprint.kernels(0, choices), blueprint, blueprint.ties())


def triangular(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r"))


class PosedProblem:
    """Half the squared whitened residuals of a problem plus priors."""

    def __init__(self, problem: Problem) -> None:
        self.problem = problem
        self.scales = problem.parameters.increment_scales()
        self.coordinate_scales = problem.parameters.scales()
        self._prior = problem.parameters.prior_information() * self.coordinate_scales**2

    def bounds(self) -> tuple[Array, Array]:
        """Lower and upper bounds of ``x``, and of ``c``: only numbers have them, and theirs are the same."""
        lower, upper = self.problem.parameters.increment_bounds()
        return lower / self.scales, upper / self.scales

    def x(self, values: Array) -> Array:
        return self.problem.parameters.local(values) / self.scales

    def values(self, x: Array) -> Array:
        return self.problem.parameters.retract(x * self.scales)

    def coordinates(self, x: Array) -> Array:
        return self.problem.parameters.coordinates(x * self.scales) / self.coordinate_scales

    def from_coordinates(self, c: Array) -> Array:
        return self.problem.parameters.from_coordinates(c * self.coordinate_scales) / self.scales

    def cost(self, x: Array) -> float:
        """Residuals and priors; infinite where a record has no elastic equilibrium."""
        try:
            return self.problem.cost(self.values(x)) + self._prior_cost(x)
        except NotConvergedError:
            return float("inf")

    def model(self, x: Array) -> NormalEquations:
        data = self.problem.normal_equations(self.values(x))
        gradient, hessian = self._chained(x, data)
        curvature = self.problem.parameters.curvature(self._entry_gradient(x, data.gradient))
        hessian = hessian + curvature * np.outer(self.scales, self.scales)
        return NormalEquations(data.cost + self._prior_cost(x), gradient, hessian)

    def convex_model(self, x: Array) -> NormalEquations:
        chain = self.problem.parameters.entries_jacobian(self.values(x)) * self.coordinate_scales
        data = self.problem.normal_equations(self.values(x)).chained(chain)
        gradient = data.gradient + self._prior * self.coordinates(x)
        return NormalEquations(data.cost + self._prior_cost(x), gradient, data.hessian + np.diag(self._prior))

    def by_increments(self, x: Array, model: NormalEquations) -> NormalEquations:
        """A model by ``c`` at the place of ``x`` as one by ``x``, with all of the curvature of ``c``."""
        chain = self._coordinates_jacobian(x)
        by_entries = self.problem.parameters.entries_jacobian(self.values(x)) @ (
            model.gradient / self.coordinate_scales
        )
        curvature = self.problem.parameters.curvature(by_entries, convex=False) * np.outer(self.scales, self.scales)
        moved = model.chained(chain)
        return NormalEquations(moved.cost, moved.gradient, moved.hessian + curvature)

    def exact_hessian(self, x: Array) -> Array:
        data = self.problem.normal_equations(self.values(x))
        exact = NormalEquations(0.0, data.gradient, self.problem.exact_hessian(self.values(x)))
        curvature = self.problem.parameters.curvature(self._entry_gradient(x, data.gradient))
        return self._chained(x, exact)[1] + curvature * np.outer(self.scales, self.scales)

    def _chained(self, x: Array, data: NormalEquations) -> tuple[Array, Array]:
        """Gradient and Hessian by ``x`` of data, by canonical entries, and priors, by coordinates."""
        parameters, delta = self.problem.parameters, x * self.scales
        by_data = data.chained(parameters.retract_jacobian(delta) * self.scales)
        by_prior = self._coordinates_jacobian(x)
        weighted = by_prior.T * self._prior
        return by_data.gradient + weighted @ self.coordinates(x), by_data.hessian + weighted @ by_prior

    def _coordinates_jacobian(self, x: Array) -> Array:
        jacobian = self.problem.parameters.coordinates_jacobian(x * self.scales)
        return jacobian * self.scales / self.coordinate_scales[:, None]

    def _entry_gradient(self, x: Array, data: Array) -> Array:
        by_prior = self._prior * self.coordinates(x) / self.coordinate_scales
        return data + self.problem.parameters.entries_jacobian(self.values(x)) @ by_prior

    def _prior_cost(self, x: Array) -> float:
        return 0.5 * float(self._prior @ self.coordinates(x) ** 2) if self._prior.any() else 0.0


def require_numbers(problem: Problem, dataset: Dataset) -> None:
    """Refuse a problem whose residuals or derivatives are no numbers (NaN, infinite) at the nominal values.

    The error names the record that has no number where the measurement needs one, the method of the effect whose
    displacement is none (PluginError), or measurement and record, or parameters.
    """
    nominal = problem.parameters.nominal()
    for kernel, own, residual in zip(problem.kernels, problem.records, problem.residuals(nominal), strict=True):
        lost = np.flatnonzero(own.measured & ~np.isfinite(residual).all(axis=0))
        if len(lost):
            record = dataset.ids[lost[0]]
            numbers = zip(kernel.factor.channels, own.record[:, lost[0]], strict=True)
            if empty := [channel for channel, number in numbers if not np.isfinite(number)]:
                text = f"found no number for {', '.join(empty)} in the record {record}."
                hint = "A reader refuses or sets aside such records: armcal.measure.checks.read_as does."
                raise DataError(text, where=dataset.where(int(lost[0])), hint=hint)
            _check_displacements(problem, dataset)
            raise ProblemError(
                f"the measurement {kernel.factor.name} predicts no number (NaN) for the record {record} at the nominal "
                "values.",
                hint="Correct its outputs or residual, the arm model, or a spring's law there.",
            )
    slopes = np.diag(problem.normal_equations(nominal).hessian)
    if names := [name for name, slope in zip(problem.free_names, slopes, strict=True) if not np.isfinite(slope)]:
        raise ProblemError(
            f"the derivative of the residuals by {', '.join(names)} is no number (NaN or infinite) at the nominal "
            "values.",
            hint="Start from other values, or correct the component that has these parameters.",
        )


def _check_displacements(problem: Problem, dataset: Dataset) -> None:
    plan, nominal = problem.blueprint, problem.parameters.nominal()
    for arm in plan.arms.values():
        postures = arm.postures(dataset, plan.environment)
        values = {block.name: ca.SX.sym(block.name, block.size) for block in arm.parameters()}
        entries = np.concatenate([nominal[problem.parameters.entries_of(name)] for name in values])
        for name, effect in arm.effects.items():
            for index, joint in enumerate(arm.joint_names):
                command, approach = ca.SX.sym("command"), ca.SX.sym("approach")
                local = scoped(values, f"{arm.name}.{name}.")
                moved = ca.SX(effect.displacement(JointCommand(index, command, approach), local))
                inputs = [ca.vertcat(*values.values()), command, approach]
                function = ca.Function("displacement", inputs, [ca.densify(moved)])
                shown = np.asarray(function(entries, postures.commands[[index]], postures.approaches[[index]])).ravel()
                if len(lost := np.flatnonzero(~np.isfinite(shown))):
                    at = f"{postures.commands[index, lost[0]]:.4g}"
                    given = f"{shown[lost[0]]} for {joint} commanded to {at} (record {dataset.ids[lost[0]]})"
                    refuse(effect.displacement, given, "a number (rad or m)")
