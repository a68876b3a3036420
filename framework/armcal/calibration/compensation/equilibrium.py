"""Where the arm stands for commands: its elastic equilibrium, by Newton's method, many commands at once."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from armcal.arm.equilibrium import (
    LONGEST_STEP,
    MOST_DEFLECTION,
    NEAR_REST_RAD,
    REST_RAD,
    Evaluate,
    lowest,
    refusal,
    settle,
)
from armcal.base.domains import Array
from armcal.calibration.compensation.request import Mask
from armcal.calibration.compensation.step import sample_inputs
from armcal.calibration.tool_expression import ToolExpression
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

_MOST_STEPS = 50
_TOGETHER = 4096
"""Records whose slopes are in memory at once."""


@dataclass(frozen=True)
class Standing:
    """Arms in equilibrium: states (n_d x N), tools (N x 4 x 4), and which settled where their springs hold them (N)."""

    states: Array
    base_T_tool: Array
    settled: Mask


class Equilibrium:
    """The equilibria of one arm."""

    def __init__(self, expression: ToolExpression, choice: EvaluatorChoice = "auto") -> None:
        left = expression.next_state - expression.state
        step = expression.to_equilibrium(left)[0] if expression.state.numel() else left
        tool = ca.vec(expression.base_T_tool.matrix()[:3, :])
        self._size, self._expression = expression.state.numel(), expression
        function = ca.Function(
            "equilibrium", [expression.record, expression.state], [ca.densify(step), ca.densify(tool)], {"cse": True}
        )
        self._function = BatchFunction(function, sample_inputs(expression), choice)
        slope = [expression.next_state, expression.slope()]
        function = ca.Function("equilibrium_slope", [expression.record, expression.state], slope, {"cse": True})
        self._slope = BatchFunction(function, sample_inputs(expression), choice)

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
            states += step * np.minimum(1.0, LONGEST_STEP / np.maximum(length, LONGEST_STEP))
        for start in range(0, count if self._size else 0, _TOGETHER):
            part = np.arange(start, min(start + _TOGETHER, count))
            settled[part] &= lowest(self._slopes(record[:, part], states[:, part])(np.arange(len(part)))[1]) > 0
            lost = part[~settled[part]]
            if len(lost):
                # Newton's method may lead to where springs do not hold the arm, though they hold it elsewhere.
                found = np.zeros((self._size, len(lost)))
                settled[lost] = settle(self._slopes(record[:, lost], found), found).sound
                states[:, lost], tools[:, lost] = found, self._function(record[:, lost], found)[1]
        return Standing(states, _poses(tools), settled)

    def _slopes(self, record: Array, states: Array) -> Evaluate:
        """What ``settle`` asks for, of these records at their states."""

        def evaluate(places: NDArray[np.intp]) -> tuple[Array, Array]:
            following, slopes = self._slope(record[:, places], states[:, places])
            return following, slopes.reshape(self._size, self._size, -1).transpose(2, 1, 0)

        return evaluate

    def required(self, record: Array, state: Array | None = None) -> Standing:
        """The same, for records that must settle.

        Raises:
            NotConvergedError: one has no equilibrium.
        """
        standing = self(record, state)
        if not standing.settled.all():
            at = int(np.flatnonzero(~standing.settled)[0])
            own, state = record[:, [at]], standing.states[:, [at]]
            following, slopes = self._slopes(own, state)(np.arange(1))
            far = bool(np.abs(following - state).max() > NEAR_REST_RAD or np.abs(state).max() > MOST_DEFLECTION)
            raise refusal(f"command {at + 1}", self._expression.arm.spring_names, state[:, 0], slopes[0], far)
        return standing


def _poses(tools: Array) -> Array:
    """Columns of 3x4 matrices (12 x N) as homogeneous ones (N x 4 x 4)."""
    poses = np.zeros((tools.shape[1], 4, 4))
    poses[:, :3, :] = tools.reshape(4, 3, -1).transpose(2, 1, 0)
    poses[:, 3, 3] = 1.0
    return poses
