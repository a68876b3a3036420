"""What is done with a calibrated arm: ``armcal predict``, ``compensate``, ``export``, ``convert``, ``calibration``."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Literal, TypeVar

import click
import numpy as np
import yaml

from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.quaternions import quaternion_of
from armcal.base.settings import Settings
from armcal.base.units import DIMENSIONLESS, parse_quantity, readable, to_unit
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration import accept as accepted
from armcal.calibration.calibration_file import sealed
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
from armcal.calibration.exporter import (
    POSES,
    Exported,
    Exporter,
    ExportRequest,
    by_own_angles,
    effects_reach,
    leaves_residual_out,
    request_of,
)
from armcal.calibration.intervals import PlusMinus, beyond_records
from armcal.calibration.rigid_chain import rigid_chain
from armcal.cli.common import FILE, Console, accept, arm, point, spare_inputs, speaking, unwritten, within
from armcal.config.validate import validate
from armcal.config.yaml_source import Node, Origin, Reader, as_source, assignment, set_at
from armcal.errors import ArmcalError, ConfigError, InputError, Location, PluginError
from armcal.io.plain_files import check_output, require_new, write_new, write_over, writing
from armcal.measure.checks import noticed, records_of
from armcal.measure.reader import ReadRequest, RequestedChannel, requested_channels
from armcal.measure.tables import column_names, write_csv
from armcal.plugins import PluginRegistry
from armcal.report.document import Document
from armcal.run.compensate import Answer, Bench, check_units, short_texts, write_commands

_MOST_NAMED = 8
_LAYOUT = "Name columns so, or as the calibration's data did, with commas between them and decimal points."


@click.command()
@click.argument("calibration", type=FILE)
@click.option("--poses", required=True, type=FILE, help="A CSV of commanded joint angles.")
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@accept
@speaking
def predict(console: Console, calibration: Path, poses: Path, out: Path, accept: bool) -> None:
    """Predict the tip of the arm in CALIBRATION for each row of commanded joint angles, and how far it may be off."""
    spare_inputs(out, calibration, poses)
    registry = console.registry()
    loaded = Calibration.load(calibration, registry, accept)
    system = loaded.system
    commands = read_commands(registry, loaded, poses)
    _warn_of_missing(console, loaded, commands)
    channels, placed = loaded.predict(commands)
    plus_minus = None
    if not loaded.readable:
        channels = {}
        for arm, tools in zip(system.arms, placed, strict=True):
            turns = np.array([quaternion_of(tool[:3, :3]) for tool in tools]).reshape(-1, 4)
            channels |= {f"{arm}.tool_{axis}": tools[:, i, 3] for i, axis in enumerate("xyz")}
            channels |= {f"{arm}.tool_q{axis}": turns[:, i] for i, axis in enumerate("wxyz")}
    elif loaded.record.prediction is None:
        console.warn("the calibration keeps nothing about the errors of predictions: run it again to have them.")
    else:
        plus_minus = loaded.plus_minus(commands)
        if unknown := [name for name in channels if not np.isfinite(plus_minus.half_widths.get(name, np.nan)).any()]:
            console.warn(f"how far {', '.join(unknown)} may be off is not known: no residual determines it.")
    requested = [*requested_channels(system.arms, loaded.readable, measured=False)]
    if not loaded.readable:
        tool = [(f"tool_{axis}", "length") for axis in "xyz"] + [(f"tool_q{axis}", DIMENSIONLESS) for axis in "wxyz"]
        for own, name, dimension in ((f"{arm}.{name}", name, kind) for arm in system.arms for name, kind in tool):
            names = (own, name) if len(system.arms) == 1 else (own,)
            requested.append(RequestedChannel(own, names, dimension, required=False))
    shown = [channel for channel in requested if channel.channel in channels]
    # Half widths of 90 % intervals with their medians over the poses, 95 % radii in mm, 90 % turns.
    extra, medians, known = dict[str, tuple[str, ...]](), dict[str, float](), plus_minus or PlusMinus({}, {}, {})
    for channel, (column, unit) in column_names(shown).items():
        if channel in known.half_widths:
            widths = to_unit(known.half_widths[channel], unit)
            extra[f"plus_minus_{column}"] = short_texts(widths)
            if np.isfinite(widths).any():
                medians[column] = float(np.nanmedian(widths))
    for column, unit, spans in (("radius95", "mm", known.radii), ("turn90", "deg", known.turns)):
        for name, values in spans.items():
            extra[f"{'' if len(spans) == 1 else f'{name}.'}{column}_{unit}"] = short_texts(to_unit(values, unit))
    kept = loaded.record.prediction
    if kept is not None and kept.ranges:
        beyond, text = beyond_records(kept.ranges, commands, system.arms, plus_minus.unknown if plus_minus else None)
        extra["beyond_records"] = tuple("1" if own else "0" for own in beyond)
        if text:
            console.warn(text)
    write_csv(out, replace(commands, channels=channels, extra=extra), shown)
    _show_predicted(console, commands, out, plus_minus, medians)


def _show_predicted(
    console: Console, commands: Dataset, out: Path, plus_minus: PlusMinus | None, medians: Mapping[str, float]
) -> None:
    typical = {}  # medians over the poses
    if plus_minus is not None and plus_minus.radii:
        half = [plus_minus.half_widths[f"{name}.{axis}"] for name in plus_minus.radii for axis in "xyz"]
        typical["half_width_90_mm"] = float(np.median(np.concatenate(half))) * 1000
        typical["radius_95_mm"] = float(np.median(np.concatenate(list(plus_minus.radii.values())))) * 1000
    if plus_minus is not None and plus_minus.turns:
        turns = np.concatenate(list(plus_minus.turns.values()))
        typical["turn_90_deg"] = float(np.rad2deg(np.median(turns)))
    counts = {"poses": len(commands), "set_aside": len(commands.set_aside)}
    console.result({**counts, "out": str(out), **typical, "half_width_90": medians})
    console.out.print(f"{len(commands)} poses predicted: {out}")
    named = [f"{column} {half:.2g}" for column, half in medians.items()]
    text = ", ".join(named[:_MOST_NAMED]) + (f" and {len(named) - _MOST_NAMED} more" if named[_MOST_NAMED:] else "")
    if typical:  # of a position; else of every column
        text = (
            f"{readable(typical['half_width_90_mm'])} mm a coordinate (90 %), "
            f"{readable(typical['radius_95_mm'])} mm in all (95 %)"
        )
        text += f", {typical['turn_90_deg']:.2g} deg (90 %)" if "turn_90_deg" in typical else ""
    elif text:
        text += " (90 %)"
    if text:
        console.out.print(f"+- {text}, in the median pose", soft_wrap=not typical)


def read_commands(registry: PluginRegistry, loaded: Calibration, poses: Path) -> Dataset:
    """The commands. Measured columns, if there are any, are not read: every row gets its prediction."""
    arms = loaded.system.arms
    requested = requested_channels(arms, {}, measured=False)
    reader_class = registry.find("reader", "csv").load()
    kept = loaded.record.prediction
    named = kept.columns_in(poses, requested) if kept else {}
    reader = reader_class(reader_class.Settings(path=ConfigText(str(poses)), columns=named))
    return noticed(records_of(reader, ReadRequest(arms, {}, requested, layout_hint=_LAYOUT)))


def _warn_of_missing(console: Console, loaded: Calibration, commands: Dataset) -> None:
    order = ("time", "sequence")
    missing = [name for name in loaded.record.environment_columns if not commands.has(name) and name not in order]
    declared = [(f"{arm.name}.{effect}", c.name) for arm in loaded.system.arms.values() for effect, c in arm.declared]
    for effect, name in declared:
        if name in missing:
            console.warn(f"the effect {effect} reads {name}, which these poses do not state: it takes its reference.")
    plain = [name for name in missing if name not in {column for _, column in declared}]
    if plain:
        console.warn(f"the calibration's records had {', '.join(plain)}; these poses take the configured values.")
    for text in commands.warnings:
        console.warn(text)
    kept = loaded.record.prediction
    if kept is not None and kept.drifts and any(map(commands.has, order)):
        text = "these poses are taken for another recording than the calibration's, of whose drift nothing is known."
        console.warn(text)


_SHOWN = 5
_SAME_POINT_M = 1e-5
_AT_THE_TARGET_MM = 1e-3  # A command so near was found, and something else keeps the arm from it
_ARRIVES = {"tool": "by the tool frame's origin", "target": "by the measured target"}


@click.command()
@click.argument("calibration", type=FILE)
@click.option("--targets", required=True, type=FILE, help="A CSV of positions or poses.")
@click.option("--out", required=True, type=FILE, help="The CSV to write.")
@arm
@within
@click.option("--path", "kind", flag_value="path", help="The targets are a path: one after another, without jumps.")
@click.option("--start", multiple=True, metavar="JOINT=ANGLE", help="Where the arm comes from: --start 'q1=10 deg'.")
@point
@click.option(
    "--for",
    "controller",
    type=click.Choice(["nominal"]),
    help="Write poses for a controller that computes the nominal arm's inverse kinematics, in place of commands.",
)
@click.option("--angles", type=click.Choice(["deg", "rad"]), default="deg", show_default=True, help="Unit of commands.")
@accept
@speaking
def compensate(console: Console, calibration: Path, targets: Path, out: Path, angles: str, **options: Any) -> None:
    """Find what to command so that the arm in CALIBRATION, as it really is, arrives at targets."""
    spare_inputs(out, calibration, targets, options["within"])
    registry = console.registry()
    loaded = Calibration.load(calibration, registry, options["accept"])
    bench = Bench.of(loaded, options["arm"], options["within"], registry, options["point"] or "tool")
    goals, given = bench.read(targets, registry)
    for text in given.warnings:
        console.warn(text)
    compensator = bench.compensator(goals)
    check_units(targets, goals, compensator.reach)
    limits = zip(compensator.joints, compensator.limits, strict=True)
    free = [joint for joint, ends in limits if not np.isfinite(ends).all()]
    if free:
        console.warn(f"no limits are known of {', '.join(free)}: commands may lie beyond them. Give --within CONFIG.")
    target = bench.target
    if options["point"] is None and target is not None and target.distance > _SAME_POINT_M:
        x, y, z = 1000 * target.tool_T_target[:3, 3]
        console.warn(
            "these commands bring the tool frame's origin to the targets. The target that "
            f"{target.measurement} measured sits at ({x:.3f}, {y:.3f}, {z:.3f}) mm on the tool and arrives "
            f"{1000 * target.distance:.3g} mm away from them. "
            "To bring that one there, give --point target; otherwise --point tool."
        )
    kinds = compensator.expression.arm.commanded
    begun = dict.fromkeys(compensator.joints, 0.0)  # joints that are not named stand at zero
    for text in options["start"]:
        joint, equals, quantity = (part.strip() for part in text.partition("="))
        at, hint = Location("--start"), "For example --start 'q1=10 deg'."
        if not equals or joint not in begun:
            known = ", ".join(compensator.joints)
            raise InputError(f"found {text!r}, expected JOINT=ANGLE with a joint of {known}.", where=at, hint=hint)
        try:
            begun[joint] = parse_quantity(quantity, kinds[joint])
        except ValueError as fault:
            raise InputError(f"{joint}: {fault}", where=at, hint=hint) from fault
    start = np.array([*begun.values()]) if options["start"] else None
    reach = compensator.follow if options["kind"] == "path" else compensator.solve
    answer = Answer(bench, compensator, goals, reach(goals, start))
    write_commands(out, answer, given, angles, options["controller"] is not None)
    if kept := bench.calibration.record.prediction:
        reached = answer.dataset.subset(np.flatnonzero(answer.commands.reached))
        if text := beyond_records(kept.ranges, reached, {bench.arm: compensator.expression.arm})[1]:
            console.warn(text)
    _show_commands(console, given, answer, out)


def _show_commands(console: Console, given: Dataset, answer: Answer, out: Path) -> None:
    figures, commands, bench = answer.summary(), answer.commands, answer.bench
    missed = [
        {"id": name, "reason": reason, "nearest_mm": 1000 * float(distance) if np.isfinite(distance) else None}
        for name, reason, distance in zip(given.ids, commands.reasons, commands.distances, strict=True)
        if reason
    ]
    set_aside = [{"row": target.row, "reason": target.reason} for target in given.set_aside]
    offset = None if bench.target is None else [1000 * float(x) for x in bench.target.tool_T_target[:3, 3]]
    data = {**figures, "point": bench.point, "target_mm": offset, "missed": missed, "set_aside": set_aside}
    for target in missed[:_SHOWN]:
        away = target["nearest_mm"]
        console.warn(
            f"{target['id']}: {target['reason']}"
            + (f"; the nearest is {away:.3f} mm away" if isinstance(away, float) and away > _AT_THE_TARGET_MM else "")
        )
    if len(missed) > _SHOWN:
        console.warn(f"{len(missed) - _SHOWN} more targets cannot be reached; the file says why")
    for cell in set_aside[:_SHOWN]:
        console.warn(f"row {cell['row']} is set aside: {cell['reason']}")
    headline = f"{figures['reached']} of {figures['targets']} targets are reached, {_ARRIVES[bench.point]}."
    summary_texts = list[str]()
    if figures["reached"]:
        text = f"error {figures['error_mm']:.3g} mm by the calibration's model "
        text += f"(at most {figures['largest_error_mm']:.3g} mm)"
        if figures["nominal_error_mm"] is not None:
            text += f"; nominal commands: {figures['nominal_error_mm']:.3g} mm"
        if figures["radius_95_mm"] is not None:
            text += f"; measured places lie within {figures['radius_95_mm']:.3g} mm (95 %, median)"
        elif not bench.is_judged:
            text += "; how far the tool frame's origin is off is not known: only the target was measured, and where it "
            text += "sits on the tool was fitted (--point target)"
        summary_texts.append(text)
    console.show(Document("Commands", headline, [], summary=summary_texts, data=data), out=str(out))
    console.line(f"commands: {out}")


S = TypeVar("S", bound=Settings)


def settings_from(settings_class: type[S], texts: Sequence[str], option: str) -> S:
    """Settings from ``key=value`` texts, whose values are YAML; a dotted key is a key of a mapping."""
    here = Path.cwd()
    tree = Node(Origin(option, here, numbered=False), 1, {})
    for text in texts:
        assigned = assignment(text, option)
        if assigned is None:
            keys = ", ".join(settings_class.keys())
            raise ConfigError(
                f"found {text!r}, expected a key, '=' and a value.",
                where=Location(option),
                hint=f"The keys are {keys}." if keys else "There is nothing to set.",
            )
        tree = set_at(tree, *assigned)
    return validate(settings_class, as_source(tree, Path(option), Reader(here)))


_NOTHING_MM = 1e-6


@click.command()
@click.argument("calibration", type=FILE)
@click.option("--format", "kind", required=True, metavar="NAME", help="An exporter of `armcal plugins list`.")
@click.option("--out", required=True, type=FILE, help="The file to write.")
@arm
@click.option("--option", "options", multiple=True, metavar="KEY=VALUE", help="A setting of the format: prefix=lrm.")
@click.option("--force", is_flag=True, help="Overwrite files that are there.")
@accept
@speaking
def export(
    console: Console,
    calibration: Path,
    kind: str,
    out: Path,
    arm: str | None,
    options: tuple[str, ...],
    force: bool,
    accept: bool,
) -> None:
    """Write the arm in CALIBRATION in the format of another program.

    Some formats write further files beside --out. What a format cannot hold is reported.
    """
    registry = console.registry()
    try:
        made = registry.find("exporter", kind).load()
    except PluginError as fault:
        known = ", ".join(sorted(c.name for c in registry.components if c.kind == "exporter"))
        if kind not in known.split(", ") and known not in fault.hint:
            raise PluginError(fault.message, hint=f"{fault.hint} The formats are {known}.") from fault
        raise
    exporter: Exporter = made(settings_from(made.Settings, options, "--option"))
    with writing(out, "Give --out a place that can be written."):
        if out.is_dir() or not out.name:
            raise InputError(
                "it is a directory, expected a file.", where=Location(str(out)), hint="Name the file in it."
            )
        spare_inputs(out, calibration)
        check_output(out)
        if not force:
            require_new([out])
    loaded = Calibration.load(calibration, registry, accept)
    request, remark = request_of(loaded, arm, out.name), ""
    if request.arm.couplings and not getattr(exporter, "holds_couplings", False):
        request, remark = by_own_angles(request)
    exported = exporter.export(request)
    exported = replace(exported, remarks=(*exported.remarks, remark)) if remark else exported
    without_residual, moved_m = leaves_residual_out(exporter, request), exported.reach
    of: Literal["everything", "residual"] = "everything" if exported.left_out else "residual"
    if without_residual:
        exported = replace(exported, left_out=(*exported.left_out, "the pose residual"))
    if not exported.left_out:
        moved_m = 0.0
    elif moved_m is None:
        moved_m = effects_reach(loaded, request, of)
    files = {out: exported.content}
    for name, content in exported.companions.items():
        beside = out.with_name(name)
        if beside.is_dir():
            hint = "Move it, or give --out another name."
            raise InputError("it is a directory, expected a file.", where=Location(str(beside)), hint=hint)
        spare_inputs(beside, calibration)
        check_output(beside)
        files[beside] = content
    (write_over if force else write_new)(unwritten(files))  # several exports may share a schema
    _show_exported(console, request, exported, moved_m, list(files), kind)


def _show_exported(
    console: Console, request: ExportRequest, exported: Exported, moved_m: float | None, files: list[Path], kind: str
) -> None:
    apart = None if moved_m is None else moved_m * 1000
    listed = [str(file) for file in files]
    content = {"out": listed[0], "files": listed, "format": kind, "arm": request.name, "changed": exported.changed}
    content |= {"left_out": [*exported.left_out], "left_out_mm": apart, "remarks": [*exported.remarks]}
    console.result(content)
    console.line(f"{request.name}: {exported.changed} numbers changed: {', '.join(listed)}")
    for remark in exported.remarks:
        console.warn(f"{remark}.")
    if exported.left_out:
        words = "the calibrated arm does not settle in all poses"
        if apart is not None:  # less than a thousandth of a micrometre is rounding
            words = f"up to {apart:.3g} mm" if apart >= _NOTHING_MM else "which does not move the tool"
        console.warn(
            f"left out, a {kind} file cannot hold it: {', '.join(exported.left_out)} "
            f"({words}, in {POSES} random poses)."
        )


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
    chain = rigid_chain(original.chain)
    if target == "urdf":
        text = urdf_text(chain, original.arm)
        section = _yaml({"type": "urdf", "text": text})
    else:
        text = section = _yaml(poe_section(chain) if target == "poe" else mdh_section(chain, convention))
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
    _warn_of_what_is_left(console, original, target, off)
    said = (
        f"largest difference over {off.poses} poses: "
        f"{off.position_m:.1e} m in position, {off.angle_rad:.1e} rad in angle"
    )
    content = {"arm": original.arm, "to": target, "poses": off.poses}
    content |= {"largest_position_m": off.position_m, "largest_angle_rad": off.angle_rad}
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


def _yaml(section: Mapping[str, Any]) -> str:
    return yaml.safe_dump({"model": section}, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None)


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


@click.group()
def calibration() -> None:
    """What is done to a calibration.yaml itself."""


@calibration.command("accept")
@click.argument("path", metavar="FILE", type=FILE)
@speaking
def accept_file(console: Console, path: Path) -> None:
    """Take FILE as it is, after it was edited by hand or is to be used with other versions of its plugins.

    All but its hash is checked again. The acceptance is noted in FILE, and every command that uses it says so.
    """
    registry = console.registry()
    noted, was_edited, moved_m = accepted(path, datetime.now(UTC).date().isoformat(), registry)
    if noted is not None:
        write_over({path.resolve(): sealed(noted.record.to_config()).encode()})
    moved = None if moved_m is None else moved_m * 1000
    console.result({"file": str(path), "edited": was_edited, "moved_mm": moved})
    moved_text = (
        "it keeps no check poses" if moved is None else f"tools at its check poses moved by up to {moved:.3f} mm"
    )
    done = "accepted" if noted is not None else "nothing to accept_file, it is as armcal wrote it"
    console.line(f"{done}: {path} ({moved_text})")
