"""Applications are plugins with commands: any of them can be taken away, and the rest works."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest
from armcal.plugins import discover
from forked import run_code

CONFIG = Path(__file__).parents[1] / "configs" / "lrm_arm" / "demo.yaml"
APPLICATIONS = {
    "bench": {"acquire", "record", "rehearse", "servo"},
    "camera": {"board"},
    "capability": {"acceptance", "capability"},
    "lerobot": {"lerobot"},
    "makers": {"maker"},
    "servobus": {"bus"},
    "online": {"control", "mission", "recalibrate", "watch"},
    "ros2": {"bag"},
    "serve": {"serve"},
}
WITHOUT = """
import importlib.metadata as metadata, sys
from importlib.abc import MetaPathFinder

gone = tuple(sys.argv[1].split(","))

class Gone(MetaPathFinder):
    def find_spec(self, name, path=None, target=None):
        if name.partition(".")[0] in gone:
            raise ModuleNotFoundError(f"No module named {name!r}", name=name)

sys.meta_path.insert(0, Gone())
every = metadata.entry_points
metadata.entry_points = lambda **wanted: [p for p in every(**wanted) if not p.value.startswith(gone)]
sys.argv[0:2] = ["armcal"]
import click
from armcal.cli.main import cli, main
if sys.argv[1:] == ["import-all"]:
    [cli.get_command(click.Context(cli), name) for name in cli.list_commands(None)]
else:
    main()
"""


def without(packages: str, *arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """An ``armcal`` in which neither the files nor the entry points of these packages are there."""
    return run_code(WITHOUT, packages, *map(str, arguments), afresh=True)


def test_applications_announce_their_commands() -> None:
    announced: dict[str, set[str]] = {}
    for component in discover().components:
        if component.kind == "command":
            announced.setdefault(component.plugin, set()).add(component.name)
    assert announced == APPLICATIONS


@pytest.mark.slow
@pytest.mark.parametrize("name", APPLICATIONS)
def test_without_an_application_the_rest_works(name: str) -> None:
    listed = without(f"armcal_{name}", "--help")
    assert listed.returncode == 0, listed.stderr
    shown = {line.split()[0] for line in listed.stdout.splitlines() if line.startswith("  ") and line.split()}
    assert not shown & APPLICATIONS[name]
    assert shown >= set().union(*APPLICATIONS.values()) - APPLICATIONS[name] | {"run", "check"}
    imported = without(f"armcal_{name}", "import-all")
    assert imported.returncode == 0, imported.stderr
    gone = without(f"armcal_{name}", min(APPLICATIONS[name]))
    assert gone.returncode == 2 and "No such command" in gone.stderr and "Traceback" not in gone.stderr


def test_without_any_application_an_arm_is_calibrated(tmp_path: Path) -> None:
    packages = ",".join(f"armcal_{name}" for name in APPLICATIONS)
    done = without(packages, "run", CONFIG, "--out", tmp_path / "run", "--set", "validation.folds=0")
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "calibration.yaml").exists() and (tmp_path / "run" / "report.html").exists()
