"""Public URDFs: each chain that pinocchio reads, with equal poses: ``python -m tests.public_urdfs DIR...``

A folder holds what a package of robot descriptions installs (``example-robot-data``, ``rtb-data``, ``pybullet``).
A chain leads from the root, or from the last link that moves in more than one direction at once, to a leaf.
"""

from __future__ import annotations

import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path
from xml.etree import ElementTree

import casadi as ca
import numpy as np
import pinocchio as pin
from armcal.arm.assembly import Arm
from armcal.arm.model import forward
from armcal_urdf.model import UrdfModel, UrdfSettings

SERIAL = ("revolute", "continuous", "prismatic", "fixed")
POSES = 20
EQUAL_M = 1e-9


def chains_of(text: str) -> Iterator[tuple[str, str]]:
    """Root and leaf of each chain that has at least one joint that moves."""
    above: dict[str, tuple[str, str]] = {}
    parents = set()
    for joint in ElementTree.fromstring(text).iter("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is None or child is None:
            continue
        above[child.get("link", "")] = (parent.get("link", ""), joint.get("type", ""))
        parents.add(parent.get("link", ""))
    for leaf in sorted(set(above) - parents):
        link, moves = leaf, False
        while link in above and above[link][1] in SERIAL:
            link, kind = above[link]
            moves = moves or kind != "fixed"
        if moves:
            yield link, leaf


def difference(text: str, root: str, tip: str) -> float:
    """The largest difference of the tip's pose (m, and 1) between armcal and pinocchio."""
    model = UrdfModel(UrdfSettings.model_validate({"text": text, "root": root, "tip": tip}))
    arm = Arm("arm", "urdf", model, {}, ())
    told = ca.SX.sym("q", len(arm.commanded))
    moved = arm.joint_commands(ca.vertsplit(told))
    base_T_tip = forward(arm.nominal_chain, moved, {}).base_T_tool.matrix()
    tips = ca.Function("f", [told], [ca.densify(base_T_tip), ca.vertcat(*moved)])
    oracle = pin.buildModelFromXML(text)
    data = oracle.createData()
    names = [joint.urdf.name for joint in model.urdf_chain.moving]
    ids = [oracle.getFrameId(link, pin.FrameType.BODY) for link in (root, tip)]
    worst, random = 0.0, np.random.default_rng(0)
    for commands in random.uniform(-2, 2, (POSES, len(arm.commanded))):
        pose, joints = (np.array(part) for part in tips(commands))
        q = pin.neutral(oracle)
        for name, value in zip(names, joints.ravel(), strict=True):
            joint = oracle.joints[oracle.getJointId(name)]
            q[joint.idx_q : joint.idx_q + joint.nq] = [np.cos(value), np.sin(value)] if joint.nq == 2 else [value]
        pin.framesForwardKinematics(oracle, data, q)
        expected = (data.oMf[ids[0]].inverse() * data.oMf[ids[1]]).homogeneous
        worst = max(worst, float(np.abs(pose - expected).max()))
    return worst


def main(folders: list[str]) -> int:
    faults = 0
    for folder in folders:
        counts: Counter[str] = Counter()
        worst = 0.0
        for path in sorted(Path(folder).rglob("*.urdf")):
            data = path.read_bytes()
            try:
                text = data.decode()
                pin.buildModelFromXML(text)
                chains = list(chains_of(text))
            except Exception:
                counts["files that pinocchio does not read"] += 1
                continue
            counts["files"] += 1
            for root, tip in chains:
                counts["chains"] += 1
                try:
                    found = difference(text, root, tip)
                except Exception as error:
                    counts["not read"] += 1
                    print(f"  {path}: {root} to {tip}: {type(error).__name__}: {' '.join(str(error).split())[:300]}")
                    continue
                worst = max(worst, found)
                if found > EQUAL_M:
                    counts["different"] += 1
                    print(f"  {path}: {root} to {tip}: differs by {found:.3g}")
        print(f"{folder}: {dict(counts)}, largest difference {worst:.3g}")
        faults += counts["not read"] + counts["different"]
    return 1 if faults else 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
