"""``armcal export``."""

from __future__ import annotations

import os
import tempfile
from pathlib import Path

import click

from armcal.base.settings import Settings
from armcal.cli.common import Voice, speaking
from armcal.errors import InputError, Location
from armcal.plugins import PluginRegistry, discover
from armcal.use.calibration import Calibration
from armcal.use.exporter import POSES, Exported, Exporter, ExportRequest, effects_reach, request_of


@click.command()
@click.argument("calibration", type=click.Path(path_type=Path))
@click.option("--format", "kind", required=True, metavar="NAME", help="The format to write: urdf.")
@click.option("--out", required=True, type=click.Path(path_type=Path), help="The file to write.")
@click.option("--arm", metavar="NAME", help="Which arm, where there are several.")
@click.option("--force", is_flag=True, help="Overwrite a file that is there.")
@speaking
def export(voice: Voice, calibration: Path, kind: str, out: Path, arm: str | None, force: bool) -> None:
    """Write the arm in CALIBRATION in the format of another program, with its calibrated geometry."""
    registry = discover()
    voice.plugin_faults(registry)
    exporter = _exporter(registry, kind)
    _check_place(out, calibration, force)
    loaded = Calibration.load(calibration, registry)
    request = request_of(loaded, arm)
    found = exporter.export(request)
    reach = effects_reach(loaded, request) if found.left_out else 0.0
    _write(out, found.content, force)
    _tell(voice, request, found, reach, out, kind)


def _exporter(registry: PluginRegistry, kind: str) -> Exporter:
    made = registry.find("exporter", kind).load()
    settings: type[Settings] = made.Settings
    exporter: Exporter = made(settings())
    return exporter


def _check_place(out: Path, calibration: Path, force: bool) -> None:
    where = Location(str(out))
    if out.is_dir():
        raise InputError("it is a directory, expected a file.", where=where, hint="Name the file in it.")
    if out.exists() and calibration.exists() and out.samefile(calibration):
        raise InputError("it is the calibration itself.", where=where, hint="Give another --out.")
    if out.exists() and not force:
        raise InputError("it is there already.", where=where, hint="Give another --out, or --force to overwrite it.")


def _write(out: Path, content: bytes, force: bool) -> None:
    """The whole file or none of it; without ``force`` never over one that appeared in the meantime."""
    where = Location(str(out))
    try:
        descriptor, staged = tempfile.mkstemp(prefix=f".{out.name}.", dir=out.parent)
        try:
            with os.fdopen(descriptor, "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            Path(staged).chmod(0o666 & ~_umask())
            if force or not out.exists():
                os.replace(staged, out)
            else:
                raise InputError("it is there already.", where=where, hint="Give another --out, or --force.")
        finally:
            Path(staged).unlink(missing_ok=True)
    except OSError as fault:
        hint = "Give --out a place that can be written."
        raise InputError(f"it cannot be written ({fault.strerror}).", where=where, hint=hint) from fault


def _umask() -> int:
    """What new files' rights are reduced by; it can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


def _tell(voice: Voice, request: ExportRequest, found: Exported, reach: float | None, out: Path, kind: str) -> None:
    apart = None if reach is None else reach * 1000
    voice.result(
        {
            "out": str(out),
            "format": kind,
            "arm": request.name,
            "changed": found.changed,
            "left_out": list(found.left_out),
            "left_out_mm": apart,
        }
    )
    voice.out.print(f"{request.name}: {found.changed} numbers changed: {out}", markup=False, soft_wrap=True)
    if found.left_out:
        words = "the calibrated arm does not settle in all poses" if apart is None else f"up to {apart:.3f} mm"
        voice.warn(
            f"left out, a {kind} file cannot hold it: {', '.join(found.left_out)} ({words}, in {POSES} random poses)."
        )
