"""What a problem is compiled from; picklable, so that another process can compile it anew."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Self

import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.environment import Environment
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.groups import Groups, group_name, owner_of, ties_of
from armcal.measure.measurement import GroupedMeasurement, Measurement
from armcal.problem.factor import build_factor
from armcal.problem.grouped_kernel import HELD, GroupedKernel
from armcal.problem.kernel import Kernel, build_kernel
from armcal.problem.normal_equations import TieFunction


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
