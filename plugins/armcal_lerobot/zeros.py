"""Calibrated zeros as numbers of LeRobot's file: homing offsets moved, ranges kept within the joints' ends."""

from collections.abc import Mapping
from dataclasses import replace
from glob import escape

from armcal.calibration.joint_zeros import Zero
from armcal.errors import InputError, Location

from armcal_lerobot.calibration_file import MotorFile, read_motors
from armcal_lerobot.motors import DEGREES_A_COUNT, LARGEST_OFFSET, Motor, remount


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
    changed = {}
    for name, (zero, sense) in zeros.items():
        motor, counts = file.motors[name], -round(sense * zero.degrees / DEGREES_A_COUNT)
        offset, trim = motor.homing_offset + counts, 0 if motor.turns_freely else abs(counts)
        where = Location(str(file.path), field=f"{name}.homing_offset")
        if abs(offset) > LARGEST_OFFSET:
            limits = f"-{LARGEST_OFFSET} to {LARGEST_OFFSET} (a sign and 11 bits)"
            raise InputError(f"the new offset would be {offset}, expected {limits}.", where=where, hint=remount(offset))
        if motor.range_max - motor.range_min <= 2 * trim:
            text = f"the zero would move by {zero.degrees:+.1f} deg, more than half of the range."
            hint = "Run lerobot-calibrate again, with the joint moved from end to end, then calibrate the arm again."
            raise InputError(text, where=where, hint=hint)
        low, high = motor.range_min + trim, motor.range_max - trim
        changed[name] = replace(motor, homing_offset=offset, range_min=low, range_max=high)
    return changed


def require_not_written(file: MotorFile, zeros: Mapping[str, tuple[Zero, int]]) -> None:
    """Raise InputError if these zeros made the file of an older one beside it: written again they would count twice."""
    for path in sorted(file.path.parent.glob(f"{escape(file.path.stem)}.before-*{file.path.suffix}")):
        old = read_motors(path)
        if set(zeros) <= set(old.motors) and {**old.motors, **rezeroed(old, zeros)} == file.motors:
            hint = "Record anew with this file, and calibrate from those records; or take the old file back first."
            text = f"it has these zeros already: they were written over {path.name}."
            raise InputError(text, where=Location(str(file.path)), hint=hint)
