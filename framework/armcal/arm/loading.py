"""Statics of the rigid arm: what its sites carry and its joints hold, and how a turn of a site moves the tip."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.model import Chain, Frames, Vector3, forward
from armcal.arm.statics import LOAD_CHANNELS, Environment, Load, SiteWrench, joint_efforts, wrenches
from armcal.base.arrays import Array
from armcal.base.se3 import Expression


@dataclass(frozen=True)
class SiteLoads:
    """Loads and levers of all sites (0 the mount, i joint i), on the rigid arm.

    Attributes:
        levers: how the tip moves in the base frame when a site turns about each of its own axes (sites x 3 x 3 x N;
            base axis by site axis; m/rad).
    """

    moments: Array  # in the site's own axes, about its origin (sites x 3 x N; N m)
    efforts: Array  # about each joint's axis, or along it (joints x N; N m, N on sliding joints)
    levers: Array


def site_loads(arm: Arm, values: Mapping[str, Array], commands: Array, acting: Array) -> SiteLoads:
    """Loads at commands (joints x N; rad or m) under what acts (LOAD_CHANNELS x N).

    ``values`` are the arm's parameter blocks by full name, as a calibration left them; masses are the stated ones.
    """
    chain = arm.chain({name: ca.SX(list(value)) for name, value in values.items()})
    joints, what = ca.SX.sym("commands", len(chain.joints)), ca.SX.sym("acting", len(LOAD_CHANNELS))
    frames, wrenches_of = _rigid_statics(arm, chain, ca.vertsplit(joints), Load.of(ca.vertsplit(what)))
    moments, levers = [], []
    for site, wrench in zip(frames.sites, wrenches_of, strict=True):
        moments.append(ca.mtimes(site.rotation.T, wrench.moment))
        lever = frames.base_T_tool.translation - site.origin
        levers += [ca.cross(ca.densify(site.rotation[:, axis]), ca.densify(lever)) for axis in range(3)]
    stacked = ca.densify(ca.vertcat(*moments, joint_efforts(chain, frames, wrenches_of), *levers))
    function = ca.Function("site_loads", [joints, what], [stacked], {"cse": True})
    loads = np.asarray(function.map(commands.shape[1])(commands, acting).full())
    sites, ends = len(frames.sites), (3 * len(frames.sites), 3 * len(frames.sites) + len(chain.joints))
    by_site = loads[ends[1] :].reshape(sites, 3, 3, -1).swapaxes(1, 2)
    return SiteLoads(loads[: ends[0]].reshape(sites, 3, -1), loads[ends[0] : ends[1]], by_site)


def holding_function(
    arm: Arm, gravity: Vector3, payload: float = 0.0, payload_com: Vector3 = (0.0, 0.0, 0.0)
) -> ca.Function:
    """From commands (joints) to the static effort on each (N m or N), rigid and nominal, to be called often.

    Gravity (m/s^2) in the base frame; the payload (kg) in the tool frame.
    """
    chain, commands = arm.nominal_chain, ca.SX.sym("commands", len(arm.commanded))
    load = Environment(gravity, payload, payload_com).load
    frames, loads = _rigid_statics(arm, chain, arm.joint_commands(ca.vertsplit(commands)), load)
    efforts = ca.vertsplit(ca.densify(joint_efforts(chain, frames, loads)))
    own = [held for held, joint in zip(efforts, chain.joints, strict=True) if joint.mimic is None]
    return ca.Function("efforts", [commands], [ca.vertcat(*own)], {"cse": True})


def _rigid_statics(
    arm: Arm, chain: Chain, commands: Sequence[Expression], load: Load
) -> tuple[Frames, tuple[SiteWrench, ...]]:
    """Frames and wrenches without effects, with the stated masses; ``commands`` are of all joints of the chain."""
    frames = forward(chain, [joint.offset + commands[i] for i, joint in enumerate(chain.joints)], {})
    masses = [replace(mass, mass=ca.SX(mass.mass), com=ca.SX(list(mass.com))) for mass in arm.masses]
    return frames, wrenches(chain, frames, masses, load)
