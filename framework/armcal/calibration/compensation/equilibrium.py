"""Where the arm stands for commands, in elastic equilibrium, many commands at once."""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import numpy as np

from armcal.arm.evaluator import Evaluator
from armcal.base.domains import Array
from armcal.calibration.compensation.request import Mask
from armcal.calibration.compensation.step import sample_inputs
from armcal.calibration.tool_expression import ToolExpression
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

_NO_VALUES = np.zeros(0)


@dataclass(frozen=True)
class Standing:
    """Arms in equilibrium: states (n_d x N), tools (N x 4 x 4), and which settled where their springs hold them (N)."""

    states: Array
    base_T_tool: Array
    settled: Mask


class Equilibrium:
    """The equilibria of one arm."""

    def __init__(self, expression: ToolExpression, choice: EvaluatorChoice = "auto") -> None:
        self._size = expression.state.numel()
        many = partial(BatchFunction, sample=sample_inputs(expression), choice=choice)
        self._evaluator = Evaluator(expression, expression.base_T_tool.matrix()[:3, :], many)

    def __call__(self, record: Array, state: Array | None = None) -> Standing:
        """Arms for records (channels x N), from states near or from none."""
        states = self._begun(record, state)
        tools, settled = self._evaluator.settle(_NO_VALUES, record, states)
        return Standing(states, _poses(tools), settled)

    def required(self, record: Array, state: Array | None = None) -> Standing:
        """The same, for records that must settle.

        Raises:
            NotConvergedError: one has no equilibrium.
        """
        states = self._begun(record, state)
        tools = self._evaluator(_NO_VALUES, record, states)
        return Standing(states, _poses(tools), np.ones(record.shape[1], dtype=bool))

    def _begun(self, record: Array, state: Array | None) -> Array:
        return np.zeros((self._size, record.shape[1])) if state is None else state.copy()


def _poses(tools: Array) -> Array:
    """Columns of 3x4 matrices (12 x N) as homogeneous ones (N x 4 x 4)."""
    poses = np.zeros((tools.shape[1], 4, 4))
    poses[:, :3, :] = tools.reshape(4, 3, -1).transpose(2, 1, 0)
    poses[:, 3, 3] = 1.0
    return poses
