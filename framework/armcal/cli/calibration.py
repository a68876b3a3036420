"""``armcal calibration``."""

from datetime import UTC, datetime
from pathlib import Path

import click

from armcal.calibration.calibration import accept as accepted
from armcal.calibration.calibration_file import sealed
from armcal.cli.common import FILE, Console, speaking
from armcal.io.plain_files import write_over


@click.group()
def calibration() -> None:
    """What is done to a calibration.yaml itself."""


@calibration.command()
@click.argument("path", metavar="FILE", type=FILE)
@speaking
def accept(console: Console, path: Path) -> None:
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
    done = "accepted" if noted is not None else "nothing to accept, it is as armcal wrote it"
    console.line(f"{done}: {path} ({moved_text})")
