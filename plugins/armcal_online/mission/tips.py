"""Where an arm's tip is in some fixed poses, for one set of parameter values after another."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmState
from armcal.arm.environment import Environment
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from armcal.base.se3 import Expression
from armcal.config.system import System
from armcal.functions.batch_function import EvaluatorChoice
from armcal.measure.contact import Contact
from armcal.measure.measurement import Measurement
from armcal.problem.factor_records import FactorRecords
from armcal.problem.problem import Problem


class Seen(Contact):
    """An instrument's readings in place of its residual, so that the compiled residual gives them."""

    def __init__(self, instrument: Measurement) -> None:
        self._instrument = instrument
        self.arms = tuple(instrument.arms)
        self._width = len(instrument.channels())

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """What the instrument would read (m)."""
        return ca.vertcat(*self._instrument.outputs(arms, values).values())

    def noise(self) -> tuple[float, ...]:
        """Of no meaning."""
        return (1.0,) * self._width


@dataclass(frozen=True)
class Tips:
    """Fixed poses of an arm, and a problem that gives its tip there.

    Deflections of the last call are where the next one starts, so that values that change little cost little.
    """

    problem: Problem
    records: tuple[FactorRecords, ...]

    @classmethod
    def of(
        cls,
        system: System,
        instrument: str,
        parameters: Parameters,
        changing: Sequence[str],
        poses: Dataset,
        evaluator: EvaluatorChoice,
    ) -> Tips:
        """Compile for values that differ in the blocks ``changing``; in the system's own gravity and load."""
        free = parameters.with_free(changing)
        seen = {instrument: Seen(system.measurements[instrument])}
        environment: Environment = system.environment
        problem = Problem.build(system.arms, seen, free, environment, poses, evaluator, groups={})
        return cls(problem, problem.records(poses))

    def again(self, poses: Dataset) -> Tips:
        """The same, with deflections of its own."""
        return Tips(self.problem, self.problem.records(poses))

    def at(self, values: Array) -> Array:
        """Tips (poses x 3, m) at a value vector.

        Raises:
            NotConvergedError: a pose has no elastic equilibrium.
        """
        return self.problem.residuals(values, self.records)[0].T


def random_poses(records: Dataset, joints: Sequence[str], arm: str, count: int, seed: int) -> Dataset:
    """Poses uniform within the span of some records, each approached from a random side."""
    random, channels = np.random.default_rng(seed), {}
    for joint in joints:
        angles = records.column(f"{arm}.{joint}")
        channels[f"{arm}.{joint}"] = random.uniform(angles.min(), angles.max(), count)
        channels[f"{arm}.approach.{joint}"] = random.choice([-1.0, 1.0], count)
    return Dataset(tuple(map(str, range(count))), channels, source="random poses")
