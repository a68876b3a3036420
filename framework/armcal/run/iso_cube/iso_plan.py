"""A plan of the test of ISO 9283 for a configured arm."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.arm.joints import joint_limits
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Options
from armcal.calibration.tool_expression import arm_expression
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment
from armcal.run.iso_cube.cube import Cube
from armcal.run.iso_cube.cycles import dataset_of_visits, visits
from armcal.run.iso_cube.placement import placed
from armcal.run.plan_clearance import clearance_check
from armcal.run.plan_context import values_about
from armcal.run.plan_poses import JointSpace, spread
from armcal.run.settings import PlanSettings

_POSTURES = 1024
_NO_CLEARANCE = "no clearance is stated (plan.clearance): nothing here keeps the arm from itself or the table."


@dataclass(frozen=True)
class IsoPlan:
    """A cube and its test.

    Attributes:
        cube: where it stands.
        dataset: the visits, in order.
        motion: the largest motion of a joint between poses (rad or m).
        warnings: for the user.
    """

    cube: Cube
    dataset: Dataset
    motion: float
    warnings: tuple[str, ...]


def make_iso_plan(
    experiment: Experiment, size: float | None, cycles: int, directions: int, calibration: Path | None = None
) -> IsoPlan:
    """The test in a cube of this size (m), or the largest that fits; for the rigid nominal arm, or a calibrated one.

    Raises:
        ConfigError: there are several arms, or joints without limits.
        ProblemError: no cube fits.
    """
    arms = experiment.system.arms
    if len(arms) != 1:
        text = f"found {len(arms)} arms ({', '.join(arms)}), expected one."
        raise ConfigError(text, hint="Describe the arm that is to be tested alone.")
    arm, space = next(iter(arms.values())), JointSpace.of(experiment)
    settings = experiment.settings.plan or PlanSettings()
    limits, check = _limits(experiment, settings, space), None
    if settings.clearance is not None:
        check = clearance_check(settings.clearance, arms, experiment.source)
    parameters = values_about(experiment, calibration)
    plain = replace(arm, effects={}, masses=()) if calibration is None else arm
    compensator = Compensator(
        arm_expression(plain, parameters, experiment.system.environment),
        parameters,
        Options(limits={name: (low, high) for name, (low, high) in zip(space.names, limits.tolist(), strict=True)}),
        None if check is None else lambda commands: check(commands).allowed,
    )
    pool = spread(settings.model_copy(update={"count": _POSTURES}), space, limits, check)
    chosen = placed(compensator, pool.dataset.stacked(space.channels), size)
    table, warnings = visits(compensator, chosen, cycles, directions)
    tools = compensator.forward(np.array([visit.command for visit in table]))
    return IsoPlan(
        chosen.cube,
        dataset_of_visits(table, space, tools),
        float(np.ptp(chosen.commands, axis=0).max()),
        warnings if check is not None else (*warnings, _NO_CLEARANCE),
    )


def _limits(experiment: Experiment, settings: PlanSettings, space: JointSpace) -> Array:
    """Of each joint (n x 2), stated or the model's own; ``spread`` refuses a joint without."""
    arm = next(iter(experiment.system.arms.values()))
    own = joint_limits(arm.nominal_chain)
    stated = space.limits(settings)
    model = np.array([own.get(joint) or (-np.inf, np.inf) for joint in arm.commanded], dtype=float)
    return np.where(np.isfinite(stated), stated, model)
