"""The arm in elastic equilibrium by CasADi's interpreter: what every exported form of it is compared with."""

from dataclasses import dataclass

import casadi as ca
import numpy as np
from armcal.arm.evaluator import Evaluator
from armcal.base.arrays import Array, Mask
from armcal.calibration.exporter import random_commands
from armcal.calibration.tool_expression import ToolExpression
from armcal.errors import NotConvergedError

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


def in_equilibrium(expression: ToolExpression, records: Array) -> tuple[Array, Array, Mask]:
    """Tools (N x 3 x 4), efforts (N x joints) and which records (N x channels) have an equilibrium (N)."""
    tool = ca.vec(expression.base_T_tool.matrix()[:3, :].T)
    shown, settled = Evaluator(expression, ca.vertcat(tool, expression.efforts)).settle(
        np.zeros(0), records.T, np.zeros((expression.state.numel(), len(records)))
    )
    return shown[:12].T.reshape(-1, 3, 4), shown[12:].T, settled


def reference_of(expression: ToolExpression, count: int) -> Reference:
    """Random poses within the limits; of two, one under a further payload and force. Those that settle.

    Raises:
        NotConvergedError: none settles.
    """
    random = np.random.default_rng(2)
    commands = random_commands(expression.arm, count)
    records, joints = expression.records(commands).T.copy(), len(expression.joints)
    records[:, joints : 2 * joints] = random.integers(-1, 2, (count, joints))
    place = expression.channels.index
    records[1::2, place("payload")] += random.uniform(0, _PAYLOAD_KG, count)[1::2]
    records[1::2, place("force_x")] += random.uniform(-_FORCE_N, _FORCE_N, count)[1::2]
    tools, efforts, settled = in_equilibrium(expression, records)
    if not settled.any():
        raise NotConvergedError(
            "the arm has no elastic equilibrium in a pose within its limits.",
            hint="Check masses and compliances: springs this soft do not hold the arm.",
        )
    return Reference(records[settled], tools[settled], efforts[settled])
