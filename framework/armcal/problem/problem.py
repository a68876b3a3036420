"""A problem: records, and the arms, measurements and parameters that are compiled once to evaluate them."""

import pickle
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache
from typing import Any, Self, cast, overload

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.statics import Environment
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.groups import (
    NO_GROUP,
    Groups,
    group_name,
    group_numbers,
    groups_of,
    owner_of,
    refuse_lost,
    ties_of,
    with_partners,
)
from armcal.measure.measurement import GroupedMeasurement, Measurement
from armcal.problem import factor_records
from armcal.problem.correlation import Correlation
from armcal.problem.factor import build_factor
from armcal.problem.factor_records import FactorRecords, correlation_of, mean_shares, transformed
from armcal.problem.kernel import HELD, GroupedKernel, Kernel, Shown, build_kernel
from armcal.problem.normal_equations import ExtraRows, NormalEquations, TieFunction, stacked


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
        """The records with corrections of the arms that have a pose residual: zero where it has not learned.

        They depend on what was commanded alone, so they are made once, in batches, and no expression holds what was
        learned.
        """
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
        """Each kernel with the places of its values; ``parameters`` are the same blocks with what is free now."""
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


__all__ = ["Compiled", "FactorRecords", "NormalEquations", "Problem", "triangular"]


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

    def evaluated_by(self, evaluator: EvaluatorChoice) -> Self:
        choices = dict.fromkeys(self.blueprint.measurements, evaluator)
        return replace(self, kernels=self.blueprint.kernels(0, choices))

    @cached_property
    def grouped(self) -> tuple[GroupedKernel, ...]:
        """Each kernel with where its values come from, and where its Jacobian goes."""
        return self.blueprint.grouped(self.kernels, self.parameters)

    @cached_property
    def ties(self) -> tuple[TieFunction, ...]:
        """What is known between groups that are free, or free and known.

        A group held because no record belongs to it is not known: a tie to where it starts would be invented.
        """
        free, could = set(self.parameters.free_entries), set(self.blueprint.parameters.free_entries)
        sides = [[set(side.tolist()) for side in tie.sides] for tie in self.known_ties]
        return tuple(
            tie
            for tie, both in zip(self.known_ties, sides, strict=True)
            if any(side & free for side in both) and all(side & free or not side & could for side in both)
        )

    @cached_property
    def places(self) -> dict[int, int]:
        """Of free entries by position in the value vector."""
        return {entry: i for i, entry in enumerate(self.parameters.free_entries)}

    def records(self, dataset: Dataset, weights: Array | None = None) -> tuple[FactorRecords, ...]:
        """A dataset as the kernels read it; ``weights`` (N) multiply each record's squared residual."""
        plan = self.blueprint
        dataset = with_partners(plan.with_corrections(dataset), plan.measurements)
        factors = [kernel.factor for kernel in self.kernels]
        numbers = [group_numbers(dataset, name, m, plan.groups) for name, m in plan.measurements.items()]
        masks = [factor_records.applicable(f, dataset, n) for f, n in zip(factors, numbers, strict=True)]
        # A record that no measurement can read stays with all whose group it names, so that an error names it.
        unread = ~np.any(masks, axis=0)
        readers = [unread if number is None else unread & (number != NO_GROUP) for number in numbers]
        refuse_lost(dataset, plan.measurements, unread & ~np.any(readers, axis=0))
        return tuple(
            factor_records.factor_records(factor, dataset, number, mask | reader, weights)
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
        """The same problem of other records; ``weights`` (N) multiply each one's squared residual."""
        return replace(self, records=self.compiled.records(dataset, weights))

    def with_records(self, records: Sequence[FactorRecords]) -> Self:
        return replace(self, records=tuple(records))

    def with_record(self, number: int, records: FactorRecords) -> Self:
        """With other records of one measurement."""
        return replace(self, records=(*self.records[:number], records, *self.records[number + 1 :]))

    def with_parameters(self, parameters: Parameters, tied: bool = True) -> Self:
        """The same blocks, other ones of them free, or with other nominal values or priors; groups not ``tied``."""
        ties = self.known_ties if tied else ()
        return replace(self, compiled=replace(self.compiled, parameters=parameters, known_ties=ties))

    def with_arms(self, arms: Mapping[str, Arm]) -> Self:
        """With pose residuals that arms have learned, which no kernel holds."""
        return replace(self, compiled=replace(self.compiled, blueprint=replace(self.blueprint, arms=arms)))

    def evaluated_by(self, evaluator: EvaluatorChoice) -> Self:
        """The same problem by another evaluator; ``compiled`` waits for the compiler."""
        return replace(self, compiled=self.compiled.evaluated_by(evaluator))

    @overload
    def subset(self, records: Indices) -> Self: ...
    @overload
    def subset(self, records: Sequence[FactorRecords], chosen: Indices) -> tuple[FactorRecords, ...]: ...
    def subset(
        self, records: Sequence[FactorRecords] | Indices, chosen: Indices | None = None
    ) -> Self | tuple[FactorRecords, ...]:
        """Of some records alone, in that order."""
        if chosen is None:
            return replace(self, records=factor_records.subset(self.records, np.asarray(records)))
        return factor_records.subset(cast(Sequence[FactorRecords], records), chosen)

    def unweighted(self) -> Self:
        """With the weights of all records one, and none correlated."""
        alike = [replace(record, weight=np.ones_like(record.weight), correlation=None) for record in self.records]
        return self.with_records(alike)

    @overload
    def weighted(self, records: Sequence[Array]) -> Self: ...
    @overload
    def weighted(self, records: Sequence[FactorRecords], weights: Sequence[Array]) -> tuple[FactorRecords, ...]: ...
    def weighted(
        self, records: Sequence[FactorRecords] | Sequence[Array], weights: Sequence[Array] | None = None
    ) -> Self | tuple[FactorRecords, ...]:
        """With the weights of records multiplied, factor by factor (N each)."""
        if weights is None:
            return replace(self, records=factor_records.weighted(self.records, cast(Sequence[Array], records)))
        return factor_records.weighted(cast(Sequence[FactorRecords], records), weights)

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
    def known_ties(self) -> tuple[TieFunction, ...]:
        return self.compiled.known_ties

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
        """How many records there are."""
        return self.records[0].count if self.records else 0

    @property
    def correlation(self) -> Correlation | None:
        return correlation_of(self.records)

    @property
    def pairs(self) -> Iterator[tuple[GroupedKernel, FactorRecords]]:
        """Each measurement's kernel with its records."""
        return zip(self.grouped, self.records, strict=True)

    def equations(self, records: Sequence[FactorRecords] | None = None) -> int:
        self = self._of(records)
        own = sum(record.equations(len(grouped.kernel.factor.noise)) for grouped, record in self.pairs)
        return own + sum(len(tie.noise) for tie in self.ties)

    def residuals(self, values: Array, records: Sequence[FactorRecords] | None = None) -> tuple[Array, ...]:
        """Raw residuals in equilibrium, one (n_r x N) matrix a factor."""
        self = self._of(records)
        self.compiled.check_fixed(values)
        return tuple(grouped.residuals(values, record)[:, : record.count] for grouped, record in self.pairs)

    def require_held(self, values: Array, records: Sequence[FactorRecords] | None = None) -> None:
        """Refuse values at which springs do not hold the arm in every record.

        Raises:
            NotConvergedError: a record has no elastic equilibrium, or one that is not stable.
        """
        self = self._of(records)
        self.residuals(values)
        for grouped, record in self.pairs:
            grouped.require_held(values, record)

    def cost(self, values: Array, records: Sequence[FactorRecords] | None = None) -> float:
        """Half the weighted squared whitened residuals."""
        self = self._of(records)
        raw, shared = self.residuals(values), self.correlation
        weighted = self._weighted(self.whitened(raw))
        if shared is not None:
            weighted = shared.independent([residual[:, :, None] for residual in weighted])
        total = sum(0.5 * float(np.sum(residual**2)) for residual in weighted)
        for kernel, record, residual in zip(self.kernels, self.records, raw, strict=True):
            declared_ones = residual / np.array(kernel.factor.noise)[:, None]
            for share in mean_shares(kernel.factor, record):
                total += 0.5 * float(np.sum((declared_ones @ share[: record.count]) ** 2))
        return total + sum(0.5 * float(np.sum((tie.residual(values) / tie.noise) ** 2)) for tie in self.ties)

    def weighted_residuals(self, values: Array, records: Sequence[FactorRecords] | None = None) -> tuple[Array, ...]:
        """Residuals in units of their noise, times the roots of their weights, one (n_r x N) matrix a factor."""
        self = self._of(records)
        return self._weighted(self.whitened_residuals(values))

    def _weighted(self, whitened: Sequence[Array]) -> tuple[Array, ...]:
        pairs = zip(self.records, whitened, strict=True)
        return tuple(residual * np.sqrt(record.weight[: record.count]) for record, residual in pairs)

    def whitened_residuals(self, values: Array, records: Sequence[FactorRecords] | None = None) -> tuple[Array, ...]:
        """Residuals in units of their noise, weights left out, one (n_r x N) matrix a factor."""
        self = self._of(records)
        return self.whitened(self.residuals(values))

    def whitened(self, residuals: Sequence[Array], records: Sequence[FactorRecords] | None = None) -> tuple[Array, ...]:
        """Raw residuals in units of their noise, one (n_r x N) matrix a factor."""
        self = self._of(records)
        return tuple(
            transformed(record.whitening[:, :, : record.count], residual)
            if record.whitening is not None
            else residual / np.array(kernel.factor.noise)[:, None]
            for kernel, record, residual in zip(self.kernels, self.records, residuals, strict=True)
        )

    def normal_equations(self, values: Array, records: Sequence[FactorRecords] | None = None) -> NormalEquations:
        """Cost, gradient and Gauss-Newton Hessian, accumulated in blocks: memory does not grow with the records.

        Correlated records are made independent all at once.
        """
        self = self._of(records)
        entries = len(self.parameters.free_entries)
        cost, gradient, hessian = 0.0, np.zeros(entries), np.zeros((entries, entries))
        for jacobian, residual in self._independent_blocks(values):
            cost += 0.5 * float(np.sum(residual**2))
            gradient = gradient + np.einsum("kvb,kb->v", jacobian, residual)
            hessian = hessian + sum((part @ part.T for part in jacobian), np.zeros((entries, entries)))
        return self._extra(values).added_to(NormalEquations(cost, gradient, hessian))

    def triangular_factor(self, values: Array, records: Sequence[FactorRecords] | None = None) -> Array:
        """R with R'R = J'J of the whitened residuals by coordinates: singular values keep their condition."""
        self = self._of(records)
        chain = self.parameters.entries_jacobian(values)
        triangle = np.zeros((0, self.increments))
        for jacobian, _ in self._independent_blocks(values):
            rows = np.concatenate([chain.T @ part for part in jacobian], axis=1).T
            triangle = triangular(np.vstack([triangle, rows]))
        return triangular(np.vstack([triangle, self._extra(values).jacobian @ chain]))

    def jacobians(self, values: Array, records: Sequence[FactorRecords] | None = None) -> tuple[Array, ...]:
        """Whitened, weighted Jacobians by free canonical entries, one (n_r x n_v x N) array a factor."""
        self = self._of(records)
        self.compiled.check_fixed(values)
        blocks = (grouped.linearised(values, record) for grouped, record in self.pairs)
        whole = (np.concatenate([jacobian for jacobian, _ in of_factor], axis=2) for of_factor in blocks)
        return tuple(jacobian[:, :, : record.count] for jacobian, record in zip(whole, self.records, strict=True))

    def exact_hessian(self, values: Array, records: Sequence[FactorRecords] | None = None) -> Array:
        """The Hessian of ``cost`` by free canonical entries with the curvature of the residuals (n x n).

        Of correlated records the Gauss-Newton one: their curvature would couple all of them. Nor has it the
        curvature of groups' means, where these weigh more than their records say.
        """
        self = self._of(records)
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

    def predict(self, values: Array, records: Sequence[FactorRecords] | None = None) -> tuple[Shown, ...]:
        self = self._of(records)
        self.compiled.check_fixed(values)
        return tuple(grouped.predict(values, record) for grouped, record in self.pairs)

    def by_channel(self, shown: Sequence[Shown]) -> dict[str, Array]:
        """Of what ``predict`` gives, the outputs by channel (N each)."""
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

    def _of(self, records: Sequence[FactorRecords] | None) -> Self:
        return self if records is None else self.with_records(records)


@lru_cache(maxsize=64)
def _from_bytes(written: bytes) -> Compiled:
    blueprint, choices, parameters = pickle.loads(written)
    return Compiled(parameters, blueprint.kernels(0, choices), blueprint, blueprint.ties())


def triangular(rows: Array) -> Array:
    return np.asarray(np.linalg.qr(rows, mode="r"))
