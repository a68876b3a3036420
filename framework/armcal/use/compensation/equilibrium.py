"""Where the arm stands for commands: its elastic equilibrium, by Newton's method, many commands at once."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.solve.batch_function import BatchFunction
from armcal.solve.kernel import MOST_DEFLECTION, REST_RAD, EvaluatorChoice
from armcal.use.compensation.request import Mask
from armcal.use.compensation.step import sample_inputs
from armcal.use.tool_expression import ToolExpression

_MOST_STEPS = 50
_LONGEST = 0.3
"""rad: a longer Newton step is shortened."""


@dataclass(frozen=True)
class Standing:
    """Arms in equilibrium: states (n_d x N), tools (N x 4 x 4), and which of them settled (N)."""

    states: Array
    base_T_tool: Array
    settled: Mask


class Equilibrium:
    """The equilibria of one arm."""

    def __init__(self, expression: ToolExpression, choice: EvaluatorChoice = "auto") -> None:
        left = expression.next_state - expression.state
        step = expression.to_equilibrium(left)[0] if expression.state.numel() else left
        tool = ca.vec(expression.base_T_tool.matrix()[:3, :])
        self._size = expression.state.numel()
        function = ca.Function(
            "equilibrium", [expression.record, expression.state], [ca.densify(step), ca.densify(tool)], {"cse": True}
        )
        self._function = BatchFunction(function, sample_inputs(expression), choice)

    def __call__(self, record: Array, state: Array | None = None) -> Standing:
        """Arms for records (channels x N), from states near or from none."""
        count = record.shape[1]
        states = np.zeros((self._size, count)) if state is None else state.copy()
        settled = np.zeros(count, dtype=bool)
        for _ in range(_MOST_STEPS):
            step, tools = self._function(record, states)
            length = np.abs(step).max(axis=0, initial=0.0)
            settled = (length <= REST_RAD) & (np.abs(states).max(axis=0, initial=0.0) <= MOST_DEFLECTION)
            if settled.all() or not np.isfinite(length).any():
                break
            states += step * np.minimum(1.0, _LONGEST / np.maximum(length, _LONGEST))
        return Standing(states, _poses(tools), settled)

    def required(self, record: Array, state: Array | None = None) -> Standing:
        """The same, for records that must settle.

        Raises:
            NotConvergedError: one has no equilibrium.
        """
        standing = self(record, state)
        if not standing.settled.all():
            at = int(np.flatnonzero(~standing.settled)[0])
            raise NotConvergedError(
                f"the elastic equilibrium of command {at + 1} did not settle.",
                hint="The load is more than the springs hold there: command another pose, or a smaller load.",
            )
        return standing


def _poses(tools: Array) -> Array:
    """Columns of 3x4 matrices (12 x N) as homogeneous ones (N x 4 x 4)."""
    poses = np.zeros((tools.shape[1], 4, 4))
    poses[:, :3, :] = tools.reshape(4, 3, -1).transpose(2, 1, 0)
    poses[:, 3, 3] = 1.0
    return poses
