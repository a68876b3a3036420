"""``armcal lerobot``: what motor calibration files and data sets say of an arm, and calibrated zeros back into them."""

import sys
from dataclasses import asdict
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import FILE, Console, speaking
from armcal.errors import InputError

from armcal_lerobot.motor_file import Units, read_motors

_JOINT_HELP = "Which joint a motor turns, where names differ; =-JOINT where it turns the other way."


@click.group()
def lerobot() -> None:
    """LeRobot's motor calibration files and recorded data sets: checked, compared, and zeros written back."""


def _of_arm(command: Any) -> Any:
    config = click.option("--arm", "config", type=FILE, help="The arm's configuration or calibration: gives mm.")
    name = click.option("--arm-name", metavar="NAME", help="Which arm, where there are several.")
    joint = click.option("--joint", "joints", multiple=True, metavar="MOTOR=JOINT", help=_JOINT_HELP)
    return config(name(joint(command)))


_UNITS = click.option(
    "--units",
    type=click.Choice(["degrees", "percent"]),
    default="degrees",
    show_default=True,
    help="Of recorded numbers, as use_degrees was.",
)


@lerobot.command()
@click.argument("calibration", type=FILE)
@click.argument("other", type=FILE, required=False)
@_UNITS
@_of_arm
@speaking
def check(console: Console, calibration: Path, other: Path | None, **given: Any) -> None:
    """Check a calibration file; what its zeros cost in mm.

    With OTHER (yesterday's file and today's) also how far the same command moves each joint, and the gripper.
    """
    from armcal_lerobot.comparison import check_content, show_check

    file, second = read_motors(calibration), read_motors(other) if other else None
    gripper = _gripper(console, list(file.motors), **given)
    content = check_content(file, second, gripper, given["units"])
    console.result(content)
    for note in content["notes"]:
        console.warn(note)
    show_check(console, content)


@lerobot.command()
@click.argument("calibration", type=FILE)
@click.option("--model", default="sts3215", show_default=True, help="Of the servos.")
@_of_arm
@speaking
def joints(console: Console, calibration: Path, model: str, **given: Any) -> None:
    """A calibration file as sections of a configuration.

    The joints of a servo bus, limits of a plan, zeros and priors of a servo map.
    """
    from armcal_lerobot.comparison import sections

    file = read_motors(calibration)
    gripper = _gripper(console, list(file.motors), **given)
    text = sections(file, gripper, model)
    console.result({"text": text})
    if not console.json:
        click.echo(text, nl=False)


@lerobot.command()
@click.argument("calibrated", metavar="CALIBRATION_YAML", type=FILE)
@click.argument("calibration", metavar="LEROBOT_JSON", type=FILE)
@click.option("--arm-name", metavar="NAME", help="Which arm, where there are several.")
@click.option("--joint", "joints", multiple=True, metavar="MOTOR=JOINT", help=_JOINT_HELP)
@click.option("--yes", is_flag=True, help="Write without a question.")
@speaking
def zeros(console: Console, calibrated: Path, calibration: Path, arm_name: str | None, yes: bool, **given: Any) -> None:
    """Write calibrated zeros into LeRobot's file.

    What changes is shown first, and a question asked. The records must have been taken with this very file. Its old
    content is kept beside it.
    """
    from armcal.calibration.joint_zeros import zeros_of

    from armcal_lerobot.comparison import require_not_written, rezeroed, show_zeros, wired_zeros

    file = read_motors(calibration)
    known, left = zeros_of(calibrated, arm_name, console.registry())
    wired = wired_zeros(known, left, file, given["joints"])
    changed = {name: motor for name, motor in rezeroed(file, wired).items() if motor != file.motors[name]}
    if changed:
        require_not_written(file, wired)
    for joint, reason in left.items():
        console.warn(f"{joint} keeps its zero: {reason}")
    show_zeros(console, file, changed, wired)
    content = {"changed": {name: asdict(motor) for name, motor in changed.items()}, "kept": left}
    if not changed:
        console.result({**content, "written": False})
        console.line("no zero moves by a count: nothing was written")
        return
    if not (yes or _agreed(calibration)):
        console.result({**content, "written": False})
        console.line("nothing was written")
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
@_of_arm
@speaking
def compare(console: Console, dataset: Path, calibration: Path | None, units: Units, **given: Any) -> None:
    """How a follower follows its commands, joint by joint.

    Offset, gain, backlash and delay from recorded data, with intervals.
    """
    from armcal_lerobot.comparison import compare_content, document
    from armcal_lerobot.recordings import open_recording
    from armcal_lerobot.tracking import read_motion

    file = read_motors(calibration) if calibration else None
    motion = read_motion(open_recording(dataset), units, file)
    gripper = _gripper(console, list(motion.motors), **given)
    if gripper and units == "percent" and file is None:
        raise InputError("found numbers in percent, expected degrees for mm.", hint="Give --calibration FILE as well.")
    console.show(document({"data": str(dataset), **compare_content(motion, gripper)}))


@lerobot.command()
@click.argument("dataset", type=FILE)
@click.option("--out", type=FILE, required=True, help="The CSV file to write, a row a rest.")
@click.option("--window-s", type=float, default=0.5, show_default=True, help="How long no motor moves.")
@click.option("--spread-deg", type=float, default=0.5, show_default=True, help="By more than this.")
@click.option(
    "--angles", type=click.Choice(["state", "action"]), default="state", show_default=True, help="Which ones."
)
@click.option(
    "--camera", metavar="FEATURE", help="A camera whose images at rest are written, as observation.images.wrist."
)
@click.option("--images", type=FILE, help="The folder for them.")
@click.option("--calibration", type=FILE, help="The follower's calibration file: turns percent into degrees.")
@click.option("--joint", "joints", multiple=True, metavar="MOTOR=JOINT", help=_JOINT_HELP)
@_UNITS
@speaking
def rests(console: Console, dataset: Path, out: Path, calibration: Path | None, units: Units, **given: Any) -> None:
    """Where an arm rested in a data set, as records.

    A CSV to calibrate from, and a camera's images of these moments.
    """
    from armcal_lerobot.recordings import open_recording
    from armcal_lerobot.rest_records import records_of, wiring_of, write_images, write_records

    if (given["camera"] is None) != (given["images"] is None):
        raise InputError("found one of --camera and --images, expected both.", hint="Give both, or none.")
    file, recording = read_motors(calibration) if calibration else None, open_recording(dataset)
    records = records_of(recording, units, file, given["angles"], given["window_s"], given["spread_deg"])
    if given["camera"] is not None:
        write_images(recording, given["camera"], records, given["images"])
    write_records(out, recording.motors, records, wiring_of(given["joints"]), given["camera"] is not None)
    console.result({"rests": len(records), "out": str(out), "images": str(given["images"] or "")})
    console.line(f"{len(records)} rests: {out}" + (f", images in {given['images']}" if given["images"] else ""))


def _gripper(console: Console, motors: list[str], **given: Any) -> Any:
    """The arm, if one was given, whose motors are there; None without."""
    if given["config"] is None:
        if given["joints"] or given["arm_name"]:
            raise InputError("found --joint or --arm-name without --arm.", hint="Give --arm CONFIG.")
        return None
    from armcal_lerobot.rest_records import Gripper, wiring_of

    gripper = Gripper(given["config"], given["arm_name"], wiring_of(given["joints"]), console.registry())
    gripper.require(motors)
    return gripper


def _agreed(path: Path) -> bool:
    if not sys.stdin.isatty():
        text = f"there is no terminal to ask whether {path} may be written; nothing was written."
        raise InputError(text, hint="Give --yes.")
    return click.confirm(f"Write {path}?", err=True)
