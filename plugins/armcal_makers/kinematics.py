"""Makers' calibration files: the kinematics YAML of ur_calibration and of xarm_ros2; every refusal names its line."""

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from armcal.base.arrays import Array
from armcal.config.yaml_nodes import Node, Origin, entries_of, read_nodes
from armcal.errors import DataError, Location
from armcal.io.plain_files import refuse

from armcal_makers.arms import KEYS, UR, Nominal, nearest, nominal_arms, pose

HASH = re.compile(r"calib_\d+")
_LONGEST_M, _WIDEST = 3.0, 2 * math.pi + 1e-6
_AGAIN = "Extract the file from the robot again."


@dataclass(frozen=True)
class MakersArm:
    """An arm as its maker measured it."""

    nominal: Nominal
    frames: Array  # parent_T_joint (n x 4 x 4)
    hash: str = ""  # by which the maker's driver knows the calibration (calib_...); empty where the file has none


def read_kinematics(text: str, path: Path) -> MakersArm:
    """An arm from the text of a maker's file; ``path`` names it in messages.

    Raises:
        DataError: what was found, what was expected, the line, and what to do.
    """
    if text.lstrip().startswith("[") or "\n[mounting]" in text:
        hint = "Extract it from the robot with ur_calibration."
        refuse(path, "found a controller's calibration.conf, expected the kinematics YAML of the robot.", hint)
    arms = nominal_arms()
    root = read_nodes(text, Origin(str(path), path.parent), plain=str)
    if root is None or not (entries := entries_of(root)):
        hint = "Give the kinematics YAML of ur_calibration or xarm_ros2."
        refuse(path, "it holds no keys, expected a maker's calibration.", hint)
    section = entries.get("kinematics")
    if section is None or not (joints := entries_of(section)):
        listed = ", ".join(list(entries)[:12])
        _refuse(root, (), f"found {listed}, expected kinematics: and numbers under it.", "Check which file this is.")
    keys = [key for key, node in joints.items() if entries_of(node)]
    known = [arm for arm in arms.values() if set(arm.keys) == set(keys)]
    if not known:
        expected = f"{', '.join(arms['ur5e'].keys)} (UR), or joint1 to joint5, joint6 or joint7 (xArm)"
        text = f"found the joints {', '.join(keys)[:200] or 'none'}, expected {expected}."
        _refuse(section, ("kinematics",), text)
    rows = [_six(joints[key], ("kinematics", key)) for key in known[0].keys]
    frames = np.array([pose(row) for row in rows])
    nominal = nearest({arm.name: frames for arm in known}, Location(str(path)))
    if nominal.family is not UR:
        return MakersArm(nominal, frames)
    value = joints["hash"].value if "hash" in joints else ""
    if not (isinstance(value, str) and HASH.fullmatch(value)):
        hint = "Without it the driver cannot tell whose calibration it is. Extract the file from the robot again."
        shown = repr(str(value)[:40]) if value else "no hash"
        _refuse(section, ("kinematics",), f"found {shown}, expected hash: calib_ and a number.", hint)
    return MakersArm(nominal, frames, value)


def _six(section: Node, keys: tuple[str, ...]) -> list[float]:
    """The six numbers of a joint; makers' tools write exponents that configurations refuse."""
    entries, numbers = entries_of(section), []
    if set(entries) != set(KEYS):
        _refuse(section, keys, f"found {', '.join(entries) or 'nothing'}, expected {', '.join(KEYS)}.")
    for key in KEYS:
        node, value = entries[key], math.nan
        if isinstance(node.value, str):
            try:
                value = float(node.value)
            except ValueError:
                value = math.nan
        if not math.isfinite(value):
            shown = repr(node.value[:40]) if isinstance(node.value, str) else "a list or keys"
            _refuse(node, (*keys, key), f"found {shown}, expected a number.")
        if key in "xyz" and abs(value) > _LONGEST_M:
            text = f"found {key} {value:g}, expected metres of a link."
            _refuse(section, keys, text, "Divide millimetres by 1000.")
        if abs(value) > _WIDEST:
            text = f"found {key} {value:g}, expected radians: it looks like degrees."
            _refuse(section, keys, text, "Convert it to radians.")
        numbers.append(value)
    return numbers


def _refuse(node: Node, keys: tuple[str, ...], message: str, hint: str = _AGAIN) -> NoReturn:
    raise DataError(message, where=node.origin.at(node.line, keys), hint=hint)
