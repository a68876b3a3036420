"""Makers' calibration files: the kinematics YAML of ur_calibration and xarm_ros2, and a UR's own calibration.conf."""

import configparser
import math
import re
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import Location
from armcal.io.plain_files import input_bytes, refuse, text_of

from armcal_makers.frames import KEYS, at_zero, between, dh_frames, placed, pose, tips
from armcal_makers.nodes import AGAIN, Entry, read_section
from armcal_makers.nominal import UR, Nominal, nearest, nominal_arms, ur_rows

MAX_BYTES = 1 << 18
MARK = "# Calibrated by armcal"
"""How files begin that armcal wrote, in which there is no doubt about the order of angles."""
_LONGEST_M = 3.0
_WIDEST = 2 * math.pi + 1e-6
_STEEPEST = 0.1
"""rad: axes that should be square or parallel are never further off."""
_SECTION = re.compile(r"^\s*\[", re.MULTILINE)
_CONF = ("delta_theta", "delta_a", "delta_d", "delta_alpha")
HASH = re.compile(r"calib_\d+")


@dataclass(frozen=True)
class MakersArm:
    """An arm as its maker measured it.

    Attributes:
        nominal: the arm that it is one of.
        frames: parent_T_joint (n x 4 x 4).
        source: what kind of file said so.
        hash: by which the maker's driver knows the calibration (``calib_...``); empty where the file has none.
        moving_axes: the frames, if roll, pitch and yaw are about the moving axes; None where there is one reading.
    """

    nominal: Nominal
    frames: Array
    source: str
    hash: str = ""
    moving_axes: Array | None = None

    def other_order_m(self, commands: Array) -> float | None:
        """How far the flange moves at commands (N x n; rad), at most, between both readings of roll, pitch and yaw.

        ur_calibration computes them about the moving axes, and a URDF takes them about the fixed ones.
        """
        if self.moving_axes is None:
            return None
        apart = tips(self.frames, commands)[:, :3, 3] - tips(self.moving_axes, commands)[:, :3, 3]
        return float(np.linalg.norm(apart, axis=1).max())


def text_in(path: Path) -> str:
    """The text of a maker's file.

    Raises:
        DataError: it cannot be read, or is not UTF-8.
    """
    return text_of(input_bytes(path, MAX_BYTES, "a maker's calibration"), path, "Save the file as UTF-8.")


def read_text(text: str, path: Path, robot: str | None = None) -> MakersArm:
    """An arm from the text of a maker's file.

    Args:
        text: what the file holds.
        path: names it in messages.
        robot: which arm it is (``ur5e``); needed for calibration.conf, which holds only what differs from the nominal
            arm. Elsewhere the nearest arm, and a stated one is checked.

    Raises:
        DataError: what was found, what was expected, the line, and what to do.
    """
    arms = nominal_arms()
    if _SECTION.search(text):
        return _of_conf(text, path, robot, arms)
    if has_offsets(text, path):
        hint = "Offsets of robot_calibration need the --urdf that they belong to; else check which file this is."
        refuse(path, "found numbers alone, expected kinematics:.", hint)
    arm = _of_yaml(read_section(text, path), path, robot, arms)
    return replace(arm, moving_axes=None) if text.startswith(MARK) else arm


def has_offsets(text: str, path: Path) -> bool:
    if _SECTION.search(text):
        return False
    root = read_section(text, path)
    return "kinematics" not in root.entries and all(entry.text is not None for entry in root.entries.values())


def _of_yaml(root: Entry, path: Path, robot: str | None, arms: dict[str, Nominal]) -> MakersArm:
    kinematics = root.section("kinematics")
    keys = [key for key, entry in kinematics.entries.items() if entry.entries]
    known = [arm for arm in arms.values() if set(arm.keys) == set(keys)]
    if not known:
        expected = f"{', '.join(arms['ur5e'].keys)} (UR), or joint1 to joint5, joint6 or joint7 (xArm)"
        kinematics.refuse(f"found the joints {', '.join(keys)[:200] or 'none'}, expected {expected}.", AGAIN)
    rows = [_six(kinematics.section(key)) for key in known[0].keys]
    frames = np.array([pose(row) for row in rows])
    nominal = nearest({arm.name: frames for arm in known}, robot, Location(str(path)))
    if nominal.family is not UR:
        return MakersArm(nominal, frames, nominal.family.format)
    entry = kinematics.entries.get("hash")
    text = (entry.text if entry else None) or ""
    if not HASH.fullmatch(text):
        hint = "Without it the driver cannot tell whose calibration it is. Extract the file from the robot again."
        kinematics.refuse(f"found {repr(text[:40]) if text else 'no hash'}, expected hash: calib_ and a number.", hint)
    return MakersArm(nominal, frames, UR.format, text, np.array([pose(row, "XYZ") for row in rows]))


def _six(section: Entry) -> list[float]:
    numbers = section.numbers(KEYS)
    for key, value in zip(KEYS, numbers, strict=True):
        if key in "xyz" and abs(value) > _LONGEST_M:
            section.refuse(f"found {key} {value:g}, expected metres of a link.", "Divide millimetres by 1000.")
        if abs(value) > _WIDEST:
            section.refuse(f"found {key} {value:g}, expected radians: it looks like degrees.", "Convert it to radians.")
    return numbers


def _of_conf(text: str, path: Path, robot: str | None, arms: dict[str, Nominal]) -> MakersArm:
    """Deltas of standard Denavit-Hartenberg rows, added to the nominal ones, and moved back to the links."""
    deltas = _deltas(text, path)
    choices = {name: arm for name, arm in arms.items() if arm.family is UR}
    if robot is None or robot not in choices:
        reason = "it holds only differences from a nominal arm" if robot is None else f"found {robot}"
        refuse(path, f"{reason}, expected a UR.", f"Give --robot, one of {', '.join(choices)}.")
    fitted = {}
    for name, arm in choices.items():
        rows = (row + deltas[key] for row, key in zip(ur_rows(name), _CONF, strict=True))
        zero = at_zero(dh_frames(*rows))
        fitted[name] = between(placed(zero, zero[-1], at_zero(arm.frames)))
    return MakersArm(nearest(fitted, robot, Location(str(path))), fitted[robot], "ur_controller")


def _deltas(text: str, path: Path) -> dict[str, Array]:
    parser = configparser.ConfigParser(interpolation=None, inline_comment_prefixes=("#", ";"))
    try:
        parser.read_string(text)
    except (configparser.DuplicateOptionError, configparser.DuplicateSectionError) as twice:
        what = getattr(twice, "option", twice.section)
        refuse(path, f"found {what} a second time, expected it once.", "Remove one of them.", twice.lineno, what)
    except configparser.Error as fault:
        line = getattr(fault, "lineno", None)
        refuse(path, f"it cannot be read ({type(fault).__name__}).", "Copy the file from the robot again.", line)
    if not parser.has_section("mounting"):
        sections = ", ".join(parser.sections())
        refuse(path, f"found the sections {sections}, expected [mounting].", "Give calibration.conf of a UR.")
    mounting = parser["mounting"]
    status = mounting.get("calibration_status", "2").strip()
    if status != "2":
        hint = "The robot was never calibrated, or not to its end: use the nominal arm."
        refuse(path, f"found calibration_status = {status}, expected 2.", hint, column="calibration_status")
    deltas = {key: _six_numbers(mounting.get(key, ""), path, key) for key in _CONF}
    steepest = np.abs(deltas["delta_alpha"]).max()
    if steepest > _STEEPEST:
        hint = "Convert degrees to radians."
        refuse(path, f"found {steepest:g}, expected at most {_STEEPEST} rad.", hint, column="delta_alpha")
    if deltas["delta_a"][5] or deltas["delta_alpha"][5]:
        refuse(path, "found a or alpha behind the last joint, expected 0.", "Copy the file from the robot again.")
    return deltas


def _six_numbers(text: str, path: Path, key: str) -> Array:
    cells = [cell.strip() for cell in text.strip().removeprefix("[").removesuffix("]").split(",")]
    try:
        numbers = np.array([float(cell) for cell in cells])
    except ValueError:
        numbers = np.array([math.nan])
    if numbers.shape != (6,) or not np.isfinite(numbers).all():
        refuse(path, f"found {text[:60] or 'nothing'!r}, expected [six numbers].", "Copy the file again.", column=key)
    return numbers
