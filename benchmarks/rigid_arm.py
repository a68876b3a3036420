"""A seven-joint arm of a Panda's dimensions: for armcal as Craig's rows, for pinocchio and figaroh as a URDF."""

from __future__ import annotations

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.run.experiment import Experiment

ROWS = [  # alpha (deg), a (m), d (m): Rot_x(alpha) Trans_x(a) Rot_z(theta) Trans_z(d)
    (0, 0, 0.333), (-90, 0, 0), (90, 0, 0.316), (90, 0.0825, 0), (-90, -0.0825, 0.384), (90, 0, 0), (90, 0.088, 0.107),
]  # fmt: skip
TOOL = (0.05, 0.0, 0.15)
MASSES_KG = (3.0, 3.5, 3.0, 2.7, 2.5, 1.5, 0.7)
NOISE_M = 1e-4
RIGID = [  # what tip positions tell of this arm: 31 numbers
    *("arm.mdh.base_[xy]", "arm.mdh.base_ry", "arm.mdh.alpha[1-7]", "arm.mdh.a[2-7]"),
    *("arm.mdh.theta[1-6]", "arm.mdh.d[1-7]", "arm.mdh.tool_[xy]"),
]


def experiment(free: list[str], *, elastic: bool = False) -> Experiment:
    """armcal's view of it; ``elastic`` adds masses and a spring a joint."""
    rows = [{"alpha_deg": alpha, "a_mm": 1000 * a, "d_mm": 1000 * d} for alpha, a, d in ROWS]
    base = [{"x_mm": 0}, {"y_mm": 0}, {"ry_deg": 0}]
    tool = [{f"{axis}_mm": 1000 * at} for axis, at in zip("xyz", TOOL, strict=True)]
    arm: dict[str, Any] = {"model": {"type": "mdh", "convention": "craig", "base": base, "rows": rows, "tool": tool}}
    if elastic:
        arm["effects"] = {"spring": {"type": "torsional_spring"}}
        arm["links"] = {
            f"link{i}": {"mass_kg": mass, "com_mm": [10, 20, 40], "frame": f"row{i}"}
            for i, mass in enumerate(MASSES_KG, start=1)
        }
    config = {
        "arms": {"arm": arm},
        "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
        "measurements": {"tracker": {"type": "tip_position", "noise_mm": 1000 * NOISE_M}},
        "parameters": {"free": free},
        "estimator": {"type": "ipopt"},
    }
    with tempfile.TemporaryDirectory() as directory:
        path = Path(directory) / "arm.yaml"
        path.write_text(yaml.safe_dump(config), encoding="utf-8")
        return Experiment.load(path)


def dataset(angles: Array, tips: Array) -> Dataset:
    """Records as armcal takes them."""
    channels = {f"arm.q{i}": column for i, column in enumerate(angles.T, start=1)}
    channels |= {f"tracker.{axis}": column for axis, column in zip("xyz", tips.T, strict=True)}
    return Dataset(tuple(map(str, range(len(angles)))), channels)


def placements() -> Array:
    """Each joint's placement in its parent and the tip's (8 x 4 x 4)."""
    result = np.tile(np.eye(4), (len(ROWS) + 1, 1, 1))
    for at, (alpha, a, d) in zip(result, ROWS, strict=False):
        cosine, sine = np.cos(np.deg2rad(alpha)), np.sin(np.deg2rad(alpha))
        at[1:3, 1:3] = [[cosine, -sine], [sine, cosine]]
        at[:3, 3] = a, -sine * d, cosine * d
    result[-1, :3, 3] = TOOL
    return result


def tips(placements: Array, angles: Array) -> Array:
    """Where the tip of a rigid arm with these placements goes (N x 3)."""
    here = np.tile(np.eye(4), (len(angles), 1, 1))
    for at, q in zip(placements, angles.T, strict=False):
        turn = np.tile(np.eye(4), (len(q), 1, 1))
        turn[:, 0, 0] = turn[:, 1, 1] = np.cos(q)
        turn[:, 1, 0], turn[:, 0, 1] = np.sin(q), -np.sin(q)
        here = here @ at @ turn
    return np.asarray((here @ placements[-1])[:, :3, 3])


@dataclass(frozen=True)
class _Joint:
    number: int
    roll: float
    at: Array

    def urdf(self) -> str:
        """The joint and the link it moves."""
        xyz = " ".join(f"{number:.17g}" for number in self.at)
        return (
            f'<link name="l{self.number}"/><joint name="q{self.number}" type="revolute">'
            f'<parent link="l{self.number - 1}"/><child link="l{self.number}"/><axis xyz="0 0 1"/>'
            f'<limit lower="-2.5" upper="2.5" effort="1" velocity="1"/>'
            f'<origin xyz="{xyz}" rpy="{self.roll:.17g} 0 0"/></joint>'
        )


def urdf() -> str:
    """The arm as a URDF; joints q1 to q7, frame ``tip``."""
    joints = [
        _Joint(i, float(np.deg2rad(row[0])), at[:3, 3]).urdf()
        for i, (row, at) in enumerate(zip(ROWS, placements(), strict=False), start=1)
    ]
    tool = (
        f'<link name="tip"/><joint name="tool" type="fixed"><parent link="l{len(ROWS)}"/><child link="tip"/>'
        f'<origin xyz="{TOOL[0]} {TOOL[1]} {TOOL[2]}"/></joint>'
    )
    return f'<robot name="arm"><link name="l0"/>{"".join(joints)}{tool}</robot>'
