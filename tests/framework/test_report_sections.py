"""Sections of the report that plugins bring: shown, passed over, and never at the cost of a calibration."""

from __future__ import annotations

import json

import pytest
from armcal.cli.main import cli
from click.testing import CliRunner

PLUGIN = '''
"""Sections of the report."""

from armcal import ReportSection, hookimpl


def largest(result):
    error = result.errors.calibrated_mm.max()
    return ReportSection("The largest <error>", f"<p>It is <b>{error:.3f} mm</b>.</p>")


def nothing(result):
    return None


def broken(result):
    return result.no_such_number


def text(result):
    return "just text"


@hookimpl
def armcal_register_report_sections(register):
    for name in ("largest", "nothing", "broken", "text"):
        register(name, f"{__name__}:{name}", "a section")
'''


@pytest.mark.slow
def test_a_run_shows_them_and_a_broken_one_is_a_warning(repository, tmp_path):
    (tmp_path / "numbers.py").write_text(PLUGIN, encoding="utf-8")
    demo, out = str(repository / "configs" / "lrm_arm" / "demo.yaml"), tmp_path / "out"
    settings = (
        "--set",
        "validation.folds=0",
        "--set",
        "evaluator=interpreted",
        "--plugin",
        str(tmp_path / "numbers.py"),
    )
    ran = CliRunner().invoke(cli, ["run", demo, "--out", str(out), "--json", *settings])
    assert ran.exit_code == 0, ran.output
    page = (out / "report.html").read_text(encoding="utf-8")
    assert "The largest &lt;error&gt;" in page and "plugin-nothing" not in page
    worst = max(json.loads(ran.stdout)["error_mm"]["calibrated"][part]["max"] for part in ("train", "holdout"))
    assert f"<p>It is <b>{worst:.3f} mm</b>.</p>" in page
    for fault in (
        "'broken' failed: AttributeError",
        "'text' failed: TypeError: found str, expected an armcal.ReportSec",
    ):
        assert fault in " ".join(ran.stderr.split())
        assert fault.replace("'", "&#39;") in page
