"""``armcal convert``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import click
import yaml

from armcal.calibration.convert import (
    Convention,
    ConvertSource,
    Difference,
    difference,
    load_source,
    mdh_section,
    poe_section,
    reload,
    urdf_text,
)
from armcal.calibration.rigid_chain import rigid_chain
from armcal.cli.common import FILE, Console, arm, spare_inputs, speaking
from armcal.errors import ArmcalError, PluginError
from armcal.io.plain_files import write_over
from armcal.plugins import PluginRegistry

LARGEST = 1e-9  # m and rad: a conversion that is further off is not written


@click.command()
@click.argument("source", metavar="CONFIG_OR_CALIBRATION", type=FILE)
@click.option("--to", "target", required=True, type=click.Choice(["mdh", "poe", "urdf"]), help="The form to write.")
@arm
@click.option(
    "--convention",
    type=click.Choice(["standard", "craig"]),
    default="standard",
    show_default=True,
    help="Of Denavit-Hartenberg rows.",
)
@click.option("--out", default=None, type=FILE, help="The file to write [default: print it].")
@speaking
def convert(
    console: Console, source: Path, target: str, arm: str | None, convention: Convention, out: Path | None
) -> None:
    """Write the geometry of an arm in another form, if that is exact.

    Of a configuration the nominal geometry, of a calibration the calibrated one. What was written is read back and
    compared with the original over 10,000 random poses.
    """
    if out is not None:
        spare_inputs(out, source)
    registry = console.registry()
    original = load_source(source, arm, registry)
    text, section = _sections(original, target, convention)
    off = _verified(original, section, target, registry)
    _warn_of_what_is_left(console, original, target, off)
    said = (
        f"largest difference over {off.poses} poses: "
        f"{off.position_m:.1e} m in position, {off.angle_rad:.1e} rad in angle"
    )
    content = {
        "arm": original.arm,
        "to": target,
        "poses": off.poses,
        "largest_position_m": off.position_m,
        "largest_angle_rad": off.angle_rad,
    }
    if out is None:
        console.result({**content, "text": text})
        if not console.json:
            click.echo(text, nl=False)
        console.err.print(said, soft_wrap=True)
        return
    write_over({out: text.encode()})
    console.result({**content, "out": str(out)})
    console.line(f"{original.arm} as {target} written: {out}")
    console.line(said)


def _sections(original: ConvertSource, target: str, convention: Convention) -> tuple[str, str]:
    """What to write, and the section ``model:`` that reads it."""
    chain = rigid_chain(original.chain)
    if target == "urdf":
        text = urdf_text(chain, original.arm)
        return text, _yaml({"type": "urdf", "text": text})
    section = _yaml(poe_section(chain) if target == "poe" else mdh_section(chain, convention))
    return section, section


def _yaml(section: Mapping[str, Any]) -> str:
    return yaml.safe_dump({"model": section}, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None)


def _verified(original: ConvertSource, section: str, target: str, registry: PluginRegistry) -> Difference:
    try:
        off = difference(original.chain, reload(section, registry))
    except PluginError as fault:
        hint = f"Install the plugin that offers the model {target}."
        raise PluginError(f"what would be written cannot be checked: {fault.message}", hint=hint) from fault
    if not max(off.position_m, off.angle_rad) <= LARGEST:
        raise ArmcalError(
            f"the converted arm differs by up to {off.position_m:.1e} m and {off.angle_rad:.1e} rad, "
            f"more than {LARGEST:g}.",
            hint="Nothing was written. Please report this with the arm.",
        )
    return off


def _warn_of_what_is_left(console: Console, original: ConvertSource, target: str, off: Difference) -> None:
    left = list(original.left)
    known = [joint.name for joint in original.chain.joints if joint.limits]
    if known and target != "urdf":
        left.append(f"limits ({', '.join(known)})")
    if left and not off.same_mount:
        left.append("the mount, about which springs at the base deflect")
    if left:
        console.err.print(f"not converted: {'; '.join(left)}", soft_wrap=True)
    unknown = [joint.name for joint in original.chain.joints if not joint.is_revolute and not joint.limits]
    if target == "urdf" and unknown:
        console.warn(f"the travel of {', '.join(unknown)} is not known; the URDF states none.")
