"""``armcal export``."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeVar

import click

from armcal.base.settings import Settings
from armcal.calibration.calibration import Calibration
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
from armcal.cli.common import FILE, Console, accept, arm, spare_inputs, speaking, unwritten
from armcal.config.validate import validate
from armcal.config.yaml_nodes import Node, Origin, assignment, set_at
from armcal.config.yaml_source import Reader, as_source
from armcal.errors import ConfigError, InputError, Location, PluginError
from armcal.io.plain_files import check_output, require_new, write_new, write_over, writing

S = TypeVar("S", bound=Settings)


def settings_from(settings_class: type[S], texts: Sequence[str], option: str) -> S:
    """Settings from ``key=value`` texts, whose values are YAML; a dotted key is a key of a mapping.

    Args:
        settings_class: what they must make.
        texts: in the order given.
        option: by which they were given, such as ``--option``, for messages.

    Raises:
        ConfigError: a text is not of that form, or the settings are refused.
    """
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
    exported, moved_m = _with_what_is_left_out(exporter, loaded, request, exported)
    files = _files(out, exported, calibration)
    (write_over if force else write_new)(unwritten(files))  # several exports may share a schema
    _show(console, request, exported, moved_m, list(files), kind)


def _with_what_is_left_out(
    exporter: Exporter, loaded: Calibration, request: ExportRequest, exported: Exported
) -> tuple[Exported, float | None]:
    """The same with the pose residual named where it is left out; how far all that is moves the tool (m)."""
    without_residual = leaves_residual_out(exporter, request)
    if not exported.left_out and not without_residual:
        return exported, 0.0
    of: Literal["everything", "residual"] = "everything" if exported.left_out else "residual"
    moved_m = effects_reach(loaded, request, of) if exported.reach is None else exported.reach
    if without_residual:
        exported = replace(exported, left_out=(*exported.left_out, "the pose residual"))
    return exported, moved_m


def _files(out: Path, exported: Exported, calibration: Path) -> dict[Path, bytes]:
    files = {out: exported.content}
    for name, content in exported.companions.items():
        beside = out.with_name(name)
        if beside.is_dir():
            hint = "Move it, or give --out another name."
            raise InputError("it is a directory, expected a file.", where=Location(str(beside)), hint=hint)
        spare_inputs(beside, calibration)
        check_output(beside)
        files[beside] = content
    return files


def _show(
    console: Console, request: ExportRequest, exported: Exported, moved_m: float | None, files: list[Path], kind: str
) -> None:
    apart = None if moved_m is None else moved_m * 1000
    console.result(
        {
            "out": str(files[0]),
            "files": [str(file) for file in files],
            "format": kind,
            "arm": request.name,
            "changed": exported.changed,
            "left_out": list(exported.left_out),
            "left_out_mm": apart,
            "remarks": list(exported.remarks),
        }
    )
    listed = ", ".join(str(file) for file in files)
    console.line(f"{request.name}: {exported.changed} numbers changed: {listed}")
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
