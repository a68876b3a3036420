"""Whether a problem predicts numbers at its nominal values, and which component does not."""

import casadi as ca
import numpy as np

from armcal.arm.assembly import scoped
from armcal.arm.effects import JointCommand
from armcal.base.dataset import Dataset
from armcal.errors import DataError, ProblemError
from armcal.plugins import refuse
from armcal.problem.problem import Problem


def require_numbers(problem: Problem, dataset: Dataset) -> None:
    """Refuse a problem whose residuals or derivatives are no numbers (NaN, infinite) at the nominal values.

    Raises:
        DataError: a record has no number where the measurement needs one.
        PluginError: the displacement of an effect is none; with its method.
        ProblemError: another residual or a derivative is none; with measurement and record, or parameters.
    """
    nominal = problem.parameters.nominal()
    for kernel, own, residual in zip(problem.kernels, problem.records, problem.residuals(nominal), strict=True):
        lost = np.flatnonzero(own.measured & ~np.isfinite(residual).all(axis=0))
        if len(lost):
            record = dataset.ids[lost[0]]
            numbers = zip(kernel.factor.channels, own.record[:, lost[0]], strict=True)
            if empty := [channel for channel, number in numbers if not np.isfinite(number)]:
                text = f"found no number for {', '.join(empty)} in the record {record}."
                hint = "A reader refuses or sets aside such records: armcal.measure.checks.check_dataset does."
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
    """Refuse an effect that displaces a joint by no number in a record."""
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
