"""``armcal lerobot``: motor calibration files checked and given calibrated zeros, rests taken out of data sets."""

import sys
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
from armcal.cli.common import FILE, Console, speaking
from armcal.errors import InputError

if TYPE_CHECKING:
    from armcal_lerobot.motor_files import Gripper, Units

_ABOVE_ZERO = click.FloatRange(min=0, min_open=True)
_UNITS = click.option(
    "--units",
    type=click.Choice(["degrees", "percent"]),
    default="degrees",
    show_default=True,
    help="Of recorded numbers, as use_degrees was.",
)
_ARM_NAME = click.option("--arm-name", metavar="NAME", help="Which arm, where there are several.")
_JOINTS = click.option(
    "--joint",
    "joints",
    multiple=True,
    metavar="MOTOR=JOINT",
    help="Which joint a motor turns, where names differ; =-JOINT where it turns the other way.",
)


@click.group()
def lerobot() -> None:
    """LeRobot's motor calibration files and data sets: files checked, rests found, and zeros written back."""


def _of_arm(command: Any) -> Any:
    config = click.option("--arm", "config", type=FILE, help="The arm's configuration or calibration: gives mm.")
    return config(_ARM_NAME(_JOINTS(command)))


@lerobot.command()
@click.argument("calibration", type=FILE)
@click.argument("other", type=FILE, required=False)
@_UNITS
@_of_arm
@speaking
def check(console: Console, calibration: Path, other: Path | None, units: "Units", **of_arm: Any) -> None:
    """Check a calibration file; what its zeros cost in mm.

    With OTHER (yesterday's file and today's) also how far the same command moves each joint, and the gripper.
    """
    from armcal_lerobot.motor_files import checked, read_motors

    file, second = read_motors(calibration), read_motors(other) if other else None
    console.show(checked(file, second, _gripper(console, list(file.motors), **of_arm), units))


@lerobot.command()
@click.argument("calibration", type=FILE)
@click.option("--model", default="sts3215", show_default=True, help="Of the servos.")
@_of_arm
@speaking
def joints(console: Console, calibration: Path, model: str, **of_arm: Any) -> None:
    """A calibration file as sections of a configuration: the joints of a servo bus, and limits of a plan."""
    from armcal_lerobot.motor_files import bus_joints, read_motors

    file = read_motors(calibration)
    text = bus_joints(file, _gripper(console, list(file.motors), **of_arm), model)
    console.result({"text": text})
    if not console.json:
        click.echo(text, nl=False)


@lerobot.command()
@click.argument("calibrated", metavar="CALIBRATION_YAML", type=FILE)
@click.argument("calibration", metavar="LEROBOT_JSON", type=FILE)
@_ARM_NAME
@_JOINTS
@click.option("--yes", is_flag=True, help="Write without a question.")
@speaking
def zeros(
    console: Console, calibrated: Path, calibration: Path, arm_name: str | None, joints: Sequence[str], yes: bool
) -> None:
    """Write calibrated zeros into LeRobot's file.

    What changes is shown first, and a question asked. The records must have been taken with this very file. Its old
    content is kept beside it.
    """
    from armcal.calibration.calibration import zeros_of

    from armcal_lerobot.motor_files import read_motors, require_not_written, rezeroed, wiring_of

    file = read_motors(calibration)
    calibrated_zeros, kept = zeros_of(calibrated, arm_name, console.registry())
    wiring = wiring_of(list(calibrated_zeros), list(file.motors), joints, kept)
    changed = rezeroed(file, calibrated_zeros, wiring)
    if changed:
        require_not_written(file, calibrated_zeros, wiring)
    for joint, reason in kept.items():
        console.warn(f"{joint} keeps its zero: {reason}")
    fields, rows = ("homing_offset", "range_min", "range_max"), []
    for joint, zero in calibrated_zeros.items():
        old = file.motors[wiring[joint][0]]
        if new := changed.get(old.name):
            cells = (f"{getattr(old, field)} -> {getattr(new, field)}" for field in fields)
            rows.append((old.name, f"{zero.degrees:+.2f}", f"{zero.sd_deg:.2f}", *cells))
    console.table("What changes in the file", ("motor", "zero, deg", "sd", *fields), rows)
    content = {"changed": {name: asdict(motor) for name, motor in changed.items()}, "kept": kept}
    if not (changed and (yes or _is_agreed(calibration))):
        console.result({**content, "written": False})
        console.line("nothing was written" if changed else "no zero moves by a count: nothing was written")
        return
    before = file.write(changed)
    console.result({**content, "written": True, "before": str(before)})
    console.line(f"written: {calibration}; the old file: {before}")
    console.line(
        "LeRobot notices at the next connect that file and motors differ: press ENTER there to take the file. Then set "
        "the zeros in the configuration to 0, and record anew: old data sets have the old zeros."
    )


@lerobot.command()
@click.argument("dataset", type=FILE)
@click.option("--calibration", type=FILE, help="The follower's calibration file: turns percent into degrees.")
@_UNITS
@click.option("--out", type=FILE, required=True, help="The CSV file to write, a row a rest.")
@click.option("--window-s", type=_ABOVE_ZERO, default=0.5, show_default=True, help="How long no motor moves.")
@click.option("--spread-deg", type=_ABOVE_ZERO, default=0.5, show_default=True, help="By more than this.")
@click.option("--angles", type=click.Choice(["state", "action"]), default="state", show_default=True, help="Which.")
@click.option("--camera", metavar="FEATURE", help="Whose images at rest are written: observation.images.wrist.")
@click.option("--images", type=FILE, help="The folder for them.")
@_JOINTS
@speaking
def rests(
    console: Console,
    dataset: Path,
    units: "Units",
    calibration: Path | None,
    out: Path,
    camera: str | None,
    images: Path | None,
    joints: Sequence[str],
    **how: Any,
) -> None:
    """Where an arm rested in a data set, as records.

    A CSV to calibrate from, and a camera's images of these moments.
    """
    from armcal_lerobot.motor_files import read_motors
    from armcal_lerobot.recordings import is_copy, open_recording, records_of, write_images, write_records

    if (camera is None) != (images is None):
        raise InputError("found one of --camera and --images, expected both.", hint="Give both, or none.")
    recording = open_recording(dataset, units, read_motors(calibration) if calibration else None)
    if is_copy(recording):
        console.warn("every state is a command: one was copied from the other, and nothing was measured of the arm.")
    records = records_of(recording, **how)
    if camera is not None and images is not None:
        write_images(recording, camera, records, images)
    write_records(out, recording.motors, records, joints, images is not None)
    console.result({"rests": len(records), "out": str(out), "images": str(images or "")})
    console.line(f"{len(records)} rests: {out}" + (f", images in {images}" if images else ""))


def _gripper(
    console: Console, motors: Sequence[str], config: Path | None, arm_name: str | None, joints: Sequence[str]
) -> "Gripper | None":
    """The arm, if one was given, with its motors; None without."""
    if config is None:
        if joints or arm_name:
            raise InputError("found --joint or --arm-name without --arm.", hint="Give --arm CONFIG.")
        return None
    from armcal_lerobot.motor_files import Gripper

    return Gripper(config, arm_name, motors, joints, console.registry())


def _is_agreed(path: Path) -> bool:
    if not sys.stdin.isatty():
        text = f"there is no terminal to ask whether {path} may be written; nothing was written."
        raise InputError(text, hint="Give --yes.")
    return click.confirm(f"Write {path}?", err=True)
