"""What every site of an arm carries record by record, and how its turning would move the tip."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal.arm.statics import Load, Mass, effort, wrenches
from armcal.base.domains import Array

LOAD_CHANNELS = (
    *(f"gravity_{axis}" for axis in "xyz"),
    "payload",
    *(f"payload_{axis}" for axis in "xyz"),
    *(f"force_{axis}" for axis in "xyz"),
    *(f"torque_{axis}" for axis in "xyz"),
)
"""What acts on an arm in a record: m/s^2, kg, m, N, N m."""


@dataclass(frozen=True)
class SiteLoads:
    """Loads and levers of all sites (0 the mount, i joint i), on the rigid arm.

    Attributes:
        moments: in the site's own axes, about its origin (sites x 3 x N; N m).
        efforts: about each joint's axis, or along it (joints x N; N m, N on sliding joints).
        levers: how the tip moves in the base frame when a site turns about each of its own axes (sites x 3 x 3 x N;
            base axis by site axis; m/rad).
    """

    moments: Array
    efforts: Array
    levers: Array


def site_loads(arm: Arm, values: Mapping[str, Array], commands: Array, acting: Array) -> SiteLoads:
    """Loads at commands (joints x N; rad or m) under what acts (LOAD_CHANNELS x N).

    ``values`` are the arm's parameter blocks by full name, as a calibration left them; masses are the stated ones.
    """
    count = len(arm.joint_names)
    sites = count + 1
    function = _function(arm, values)
    found = np.asarray(function.map(commands.shape[1])(commands, acting).full())
    moments = found[: 3 * sites].reshape(sites, 3, -1)
    efforts = found[3 * sites : 3 * sites + count]
    levers = found[3 * sites + count :].reshape(sites, 3, 3, -1).swapaxes(1, 2)
    return SiteLoads(moments, efforts, levers)


def _function(arm: Arm, values: Mapping[str, Array]) -> ca.Function:
    """(commands, what acts) -> moments, efforts, levers, stacked."""
    chain = arm.chain({name: ca.SX(list(value)) for name, value in values.items()})
    commands, acting = ca.SX.sym("commands", len(chain.joints)), ca.SX.sym("acting", len(LOAD_CHANNELS))
    frames = forward(chain, [joint.offset + commands[i] for i, joint in enumerate(chain.joints)], {})
    masses = [Mass(m.name, ca.SX(m.mass), ca.SX(list(m.com)), m.frame, m.loads_up_to) for m in arm.masses]
    load = Load(acting[0:3], acting[3], acting[4:7], acting[7:10], acting[10:13])
    loads = wrenches(chain, frames, masses, load)
    moments, efforts, levers = [], [], []
    for index, (site, wrench) in enumerate(zip(frames.sites, loads, strict=True)):
        moments.append(ca.mtimes(site.rotation.T, wrench.moment))
        lever = frames.base_T_tool.translation - site.origin
        levers += [ca.cross(ca.densify(site.rotation[:, axis]), ca.densify(lever)) for axis in range(3)]
        if index:
            efforts.append(effort(chain.joints[index - 1], site, wrench))
    shown = ca.densify(ca.vertcat(*moments, *efforts, *levers))
    return ca.Function("site_loads", [commands, acting], [shown], {"cse": True})
