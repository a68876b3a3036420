"""What a problem is compiled from; picklable, so that another process can compile it anew."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

from armcal.arm.assembly import Arm
from armcal.arm.environment import Environment
from armcal.base.parameters import Parameters
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.groups import Groups
from armcal.measure.measurement import Measurement
from armcal.problem.factor import build_factor
from armcal.problem.kernel import Kernel, build_kernel


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

    def kernels(self, records: int, choices: Mapping[str, EvaluatorChoice]) -> tuple[Kernel, ...]:
        """A kernel for each measurement, for about so many records, by the evaluator chosen for it."""
        shared = (self.arms, self.parameters, self.environment, self.channels)
        return tuple(
            build_kernel(build_factor(name, measurement, *shared), records, choices[name])
            for name, measurement in self.measurements.items()
        )

    def bare(self) -> Blueprint:
        """The same, its arms without what they keep of their expressions, which cannot be pickled."""
        return replace(self, arms={name: replace(arm) for name, arm in self.arms.items()})
