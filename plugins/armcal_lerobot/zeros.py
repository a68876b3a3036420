"""Calibrated zeros as numbers of LeRobot's file: homing offsets moved, ranges kept within the joints' ends."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import ParameterRecord
from armcal.errors import InputError, Location
from armcal.plugins import PluginRegistry

from armcal_lerobot.calibration_file import MotorFile
from armcal_lerobot.motors import DEGREES_A_COUNT, LARGEST_OFFSET, Motor, remount

_MODEL_ZERO = re.compile(r"(theta|offset)(\d+)")
_SERVO_MAP = "servo_map"


@dataclass(frozen=True)
class Zero:
    """How far a joint stands from its command at zero (deg), with its standard deviation."""

    degrees: float
    sd_deg: float


def zeros_of(path: Path, arm: str | None, registry: PluginRegistry) -> tuple[dict[str, Zero], dict[str, str]]:
    """The zeros that a calibration found, by joint; and joints without one, with the reason.

    A zero is the offset of a ``servo_map`` as it stands, and what a model's own ``theta`` or ``offset`` differs from
    its drawing.

    Raises:
        ConfigError: the calibration is refused.
        InputError: it has no zero, or several arms and none was named.
    """
    loaded, where = Calibration.load(path, registry), Location(str(path))
    arms = loaded.system.arms
    if arm not in arms and (arm is not None or len(arms) > 1):
        raise InputError(f"found the arms {', '.join(arms)}.", where=where, hint="Choose one with --arm-name NAME.")
    chosen = arms[arm or next(iter(arms))]
    described = loaded.system.description["arms"][chosen.name].get("effects") or {}
    maps = {name for name, effect in described.items() if effect.get("type") == _SERVO_MAP}
    zeros: dict[str, Zero] = {}
    reasons = dict.fromkeys(chosen.commanded, "its zero was not free")
    for entry in loaded.record.parameters:
        _, part, local = (*entry.name.split(".", 2), "", "")[:3]
        match = _MODEL_ZERO.fullmatch(local)
        owned = entry.name.startswith(f"{chosen.name}.") and match and entry.unit == "rad"
        if not owned or match is None or not (part in maps or part == chosen.model_name):
            continue
        joint = chosen.joint_names[int(match[2]) - 1]
        if joint in chosen.commanded:
            _take(zeros, reasons, joint, entry, part in maps)
    if not zeros:
        hint = "Free them in parameters.free (arm.EFFECT.offset*, of an effect servo_map), and run again."
        raise InputError("found no calibrated zero of a joint.", where=where, hint=hint)
    return zeros, {joint: reason for joint, reason in reasons.items() if joint not in zeros}


def _take(zeros: dict[str, Zero], reasons: dict[str, str], joint: str, entry: ParameterRecord, is_map: bool) -> None:
    if entry.free and (entry.sd is None or not entry.determined):
        reasons[joint] = f"the records do not determine {entry.name}"
        return
    value = entry.value if is_map else entry.value - entry.nominal
    if not entry.free and not (is_map and value):
        return
    before = zeros.get(joint, Zero(0.0, 0.0))
    sd = math.hypot(before.sd_deg, math.degrees(entry.sd or 0.0))
    zeros[joint] = Zero(before.degrees + math.degrees(value), sd)


def rezeroed(file: MotorFile, zeros: Mapping[str, tuple[Zero, int]]) -> dict[str, Motor]:
    """Motors whose zero is where the calibration has it, by name.

    The homing offset moves the zero. The range stays about the same middle, since that is zero in degrees, and loses at
    both ends what the zero moved: so the joint goes nowhere that the file did not let it go before.

    Args:
        file: as it is.
        zeros: by motor, its joint's zero and the sense of the joint.

    Raises:
        InputError: an offset is larger than a servo stores, or nothing is left of a range.
    """
    return {name: _moved(file, file.motors[name], zero, sense) for name, (zero, sense) in zeros.items()}


def _moved(file: MotorFile, motor: Motor, zero: Zero, sense: int) -> Motor:
    counts = -round(sense * zero.degrees / DEGREES_A_COUNT)
    offset, trim = motor.homing_offset + counts, 0 if motor.turns_freely else abs(counts)
    where = Location(str(file.path), field=f"{motor.name}.homing_offset")
    if abs(offset) > LARGEST_OFFSET:
        text = f"the new offset would be {offset}, expected -{LARGEST_OFFSET} to {LARGEST_OFFSET} (a sign and 11 bits)."
        raise InputError(text, where=where, hint=remount(offset))
    if motor.range_max - motor.range_min <= 2 * trim:
        text = f"the zero would move by {zero.degrees:+.1f} deg, more than half of the range."
        hint = "Run lerobot-calibrate again, with the joint moved from end to end, then calibrate the arm again."
        raise InputError(text, where=where, hint=hint)
    return replace(motor, homing_offset=offset, range_min=motor.range_min + trim, range_max=motor.range_max - trim)
