"""Plugins of an outsider, found as installed ones are, and the commands of armcal run with them."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from armcal.cli.main import cli
from click.testing import CliRunner, Result

SOURCE = Path(__file__).resolve().parent / "data" / "outside_instruments"


def installed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder to work in; the outsider's plugins are on the path, here and in child processes."""
    site = tmp_path / "site"
    info = site / "outside_instruments-1.0.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: outside-instruments\nVersion: 1.0\n")
    (info / "entry_points.txt").write_text("[armcal]\noutside = outside_plugin\n")
    here = tmp_path / "here"
    here.mkdir()
    monkeypatch.chdir(here)
    for place in (SOURCE, site):
        monkeypatch.syspath_prepend(str(place))
    monkeypatch.setenv("PYTHONPATH", os.pathsep.join(map(str, (SOURCE, site))))
    return here


def armcal(*arguments: object, code: int = 0) -> Result:
    """One command in this process, which must end with this exit code and without a traceback."""
    done = CliRunner().invoke(cli, [str(each) for each in arguments])
    shown = f"{done.output}\n{done.stderr}\n{done.exception!r}"
    assert done.exception is None or isinstance(done.exception, SystemExit), shown
    assert done.exit_code == code, shown
    return done


def strict(text: str) -> dict:
    """JSON as the standard has it: no NaN, no Infinity."""

    def refuse(constant: str) -> None:
        raise AssertionError(f"found {constant} in JSON")

    return json.loads(text, parse_constant=refuse)
