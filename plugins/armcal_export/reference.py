"""The arm in elastic equilibrium by CasADi's interpreter: what every exported form of it is compared with."""

from __future__ import annotations

from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.arm.equilibrium import lowest
from armcal.base.domains import Array
from armcal.calibration.exporter import random_commands
from armcal.calibration.tool_expression import ToolExpression
from armcal.errors import NotConvergedError

AT_REST = 1e-14
"""rad or m; rounding leaves about as much."""
_NEAR_REST = 1e-10
_PASSES, _STEPS = 100, 50
_LONGEST_STEP, _FARTHEST = 0.3, 1.5
_PAYLOAD_KG, _FORCE_N = 0.05, 0.5


@dataclass(frozen=True)
class Reference:
    """What the arm does.

    Attributes:
        records: what was told, columns of ``ToolExpression.channels`` (N x channels).
        base_T_tool: N x 3 x 4.
        efforts: of all joints of the chain (N x joints).
    """

    records: Array
    base_T_tool: Array
    efforts: Array


class Equilibrium:
    """An arm's functions of record and elastic state."""

    def __init__(self, expression: ToolExpression) -> None:
        e = expression
        shown = ca.densify(ca.vec(e.base_T_tool.matrix()[:3, :].T))
        one_pass = [e.record, e.state]
        self._size = e.state.numel()
        self._pass = ca.Function("once", one_pass, [e.next_state], {"cse": True})
        self._shown = ca.Function("shown", one_pass, [shown, e.efforts], {"cse": True})
        self._newton: ca.Function | None = None
        self._expression = expression

    def at(self, record: Array) -> tuple[Array, Array]:
        """The tool (3 x 4) and the efforts of one record.

        Raises:
            NotConvergedError: it has no equilibrium.
        """
        pose, efforts = self._shown(record, self.state(record))
        return np.asarray(pose.full()).reshape(3, 4), np.asarray(efforts.full()).ravel()

    def state(self, record: Array) -> Array:
        """Where the springs come to rest: by passes, and where these lead away by Newton's steps."""
        state, before = np.zeros(self._size), np.inf
        for _ in range(_PASSES):
            following = np.asarray(self._pass(record, state).full()).ravel()
            moved = float(np.abs(following - state).max(initial=0.0))
            if not np.abs(following).max(initial=0.0) < _FARTHEST:
                break
            state = following
            if moved <= AT_REST or (moved < 100 * AT_REST and moved >= before):
                return state
            before = moved
        return self._by_newton(record)

    def _by_newton(self, record: Array) -> Array:
        if self._newton is None:
            e = self._expression
            self._newton = ca.Function("slope", [e.record, e.state], [e.next_state, e.slope()], {"cse": True})
        state, length = np.zeros(self._size), np.inf
        for _ in range(_STEPS):
            following, slope = (dm.full() for dm in self._newton(record, state))
            step = np.linalg.solve(np.eye(self._size) - slope, following.ravel() - state)
            length = float(np.abs(step).max())
            if not np.isfinite(length):
                break
            state = state + step * min(1.0, _LONGEST_STEP / max(length, AT_REST))
            if length <= AT_REST:
                break
        held = lowest(self._newton(record, state)[1].full()[None])[0] > 0
        if not (held and length <= _NEAR_REST and np.abs(state).max() <= _FARTHEST):
            raise NotConvergedError(
                "the arm has no elastic equilibrium in a pose within its limits.",
                hint="Check masses and compliances: springs this soft do not hold the arm.",
            )
        return state


def reference_of(expression: ToolExpression, count: int) -> Reference:
    """Random poses within the limits; of two, one under a further payload and force. Those that settle.

    Raises:
        NotConvergedError: none settles.
    """
    random = np.random.default_rng(2)
    commands = random_commands(expression.arm, count)
    records = np.tile(expression.defaults, (count, 1))
    joints = len(expression.joints)
    records[:, :joints] = commands.T
    records[:, joints : 2 * joints] = random.integers(-1, 2, (count, joints))
    place = expression.channels.index
    records[1::2, place("payload")] += random.uniform(0, _PAYLOAD_KG, count)[1::2]
    records[1::2, place("force_x")] += random.uniform(-_FORCE_N, _FORCE_N, count)[1::2]
    equilibrium, kept, found = Equilibrium(expression), [], []
    for record in records:
        try:
            found.append(equilibrium.at(record))
        except NotConvergedError:
            continue
        kept.append(record)
    if not kept:
        equilibrium.at(records[0])
    return Reference(np.array(kept), np.array([pose for pose, _ in found]), np.array([each for _, each in found]))
