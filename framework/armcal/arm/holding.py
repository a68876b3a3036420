"""What the joints hold against gravity and load, pose by pose."""

from __future__ import annotations

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.model import Vector3, forward
from armcal.arm.statics import Load, Mass, effort, wrenches
from armcal.base.domains import Array


def holding_efforts(
    arm: Arm, joint_angles: Array, gravity: Vector3, payload: float = 0.0, payload_com: Vector3 = (0.0, 0.0, 0.0)
) -> Array:
    """Static effort on each commanded joint (joints x N; N m or N) at commands (joints x N), rigid and nominal.

    Gravity (m/s^2) in the base frame; the payload (kg) in the tool frame.
    """
    function = holding_function(arm, gravity, payload, payload_com)
    return np.asarray(function.map(joint_angles.shape[1])(joint_angles).full())


def holding_function(
    arm: Arm, gravity: Vector3, payload: float = 0.0, payload_com: Vector3 = (0.0, 0.0, 0.0)
) -> ca.Function:
    """From commands (joints) to what ``holding_efforts`` gives of them, to be called often."""
    chain = arm.nominal_chain
    commands = ca.SX.sym("commands", len(arm.commanded))
    told = arm.joint_commands(ca.vertsplit(commands))
    frames = forward(chain, [joint.offset + told[i] for i, joint in enumerate(chain.joints)], {})
    masses = [Mass(m.name, ca.SX(m.mass), ca.SX(list(m.com)), m.frame, m.loads_up_to) for m in arm.masses]
    nothing = ca.SX.zeros(3)
    load = Load(ca.SX(list(gravity)), ca.SX(payload), ca.SX(list(payload_com)), nothing, nothing)
    acting = wrenches(chain, frames, masses, load)
    efforts = []
    for index, joint in enumerate(chain.joints, start=1):
        if joint.mimic is not None:
            continue
        efforts.append(effort(joint, frames.sites[index], acting[index]))
    return ca.Function("efforts", [commands], [ca.densify(ca.vertcat(*efforts))], {"cse": True})
