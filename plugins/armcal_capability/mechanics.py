"""An arm in many postures: tool, its slopes by commands and by a force, and what the joints hold, in equilibrium."""

from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array, Mask
from armcal.calibration.compensation.step import force_compliance, slopes, twists
from armcal.calibration.tool_expression import Equilibrium, ToolExpression
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

from armcal_capability.settings import LoadSettings

_LANES = 8
_FORCE = "force_x"


@dataclass(frozen=True)
class Mechanics:
    """Loaded arms in elastic equilibrium.

    Attributes:
        positions: of the tool (3 x N; m, base frame).
        rotations: base_R_tool (3 x 3 x N).
        slopes: of the tool by commands (N x 6 x n): metres, then rad about the axes of the base frame.
        compliances: of the tool by a force at it (N x 3 x 3; m/N, base frame).
        efforts: about or along the axes of all joints (joints x N; N m, N).
        states: deflections (n_d x N).
        settled: whether there is an equilibrium (N).
    """

    positions: Array
    rotations: Array
    slopes: Array
    compliances: Array
    efforts: Array
    states: Array
    settled: Mask


class MechanicsFunction:
    """``Mechanics`` of one arm under one load, for commands (joints x N).

    Attributes:
        expression: the arm's.
        is_elastic: whether anything gives.
        is_loaded: whether there is a load beyond the arm's own weight.
    """

    def __init__(self, expression: ToolExpression, load: LoadSettings, choice: EvaluatorChoice = "auto") -> None:
        self.expression = expression
        self._joints, self._states = len(expression.joints), expression.state.numel()
        self._record = expression.defaults.copy()
        for channel, stated in (("payload", load.payload), ("payload_x", load.payload_com), (_FORCE, load.force)):
            if stated is not None:
                start, values = self._place(channel), np.atleast_1d(stated)
                self._record[start : start + len(values)] = values
        force = self._place(_FORCE)
        self.is_elastic = self._states > 0
        self.is_loaded = bool(self._record[self._place("payload")]) or bool(np.any(self._record[force : force + 3]))
        self._equilibrium = Equilibrium(expression, choice)
        made = self._records(np.linspace(-1, 1, _LANES) * np.ones((self._joints, 1)))
        self._function = BatchFunction(_function(expression), [made, np.zeros((self._states, _LANES))], choice)

    def __call__(self, commands: Array, states: Array | None = None) -> Mechanics:
        """Everything; ``states`` are where the search for an equilibrium begins."""
        record, count = self._records(commands), commands.shape[1]
        standing = self._equilibrium(record, states)
        pose, by_commands, by_force, efforts = self._function(record, standing.states)
        return Mechanics(
            positions=pose[9:],
            rotations=pose[:9].reshape(3, 3, count).swapaxes(0, 1),
            slopes=by_commands.reshape(self._joints, 6, count).transpose(2, 1, 0),
            compliances=by_force.reshape(3, 3, count).transpose(2, 1, 0),
            efforts=efforts,
            states=standing.states,
            settled=np.asarray(standing.settled, dtype=bool),
        )

    def without_load(self, commands: Array, states: Array) -> Array:
        """Where the tool is under the arm's own weight alone (3 x N; m), from states near it."""
        record = self._records(commands)
        record[self._place("payload")] = 0.0
        record[self._place(_FORCE) : self._place(_FORCE) + 3] = 0.0
        return self._tool(record, states)

    def weightless(self, commands: Array) -> Array:
        """Where the tool would be if nothing pulled at the arm (3 x N; m)."""
        record = self._records(commands)
        start = self._place(LOAD_CHANNELS[0])
        record[start : start + len(LOAD_CHANNELS)] = 0.0
        return self._tool(record, None)

    def _tool(self, record: Array, states: Array | None) -> Array:
        return np.asarray(self._equilibrium(record, states).base_T_tool[:, :3, 3].T)

    def _records(self, commands: Array) -> Array:
        record = np.repeat(self._record[:, None], commands.shape[1], axis=1)
        record[: self._joints] = commands
        return record

    def _place(self, channel: str) -> int:
        return self.expression.channels.index(channel)


def _function(expression: ToolExpression) -> ca.Function:
    tool = expression.base_T_tool
    pose = ca.vertcat(ca.vec(tool.rotation), tool.translation)
    slope = replace(slopes(expression), corrected=pose)
    shown = [pose, ca.vec(twists(slope)), ca.vec(force_compliance(expression)), expression.efforts]
    outputs = [ca.densify(output) for output in shown]
    return ca.Function("capability", [expression.record, expression.state], outputs, {"cse": True})
