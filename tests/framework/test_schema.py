"""What other programs read stays: keys of JSON and columns of CSV, held by ``tests/data/schema.json``.

Each entry is a command with an arm that is shipped, run to its end; of its output and of the files it leaves the keys
and columns are compared, whatever their values. ``python -m tests.framework.test_schema`` records them anew, which is a
break for every program that reads them.
"""

from __future__ import annotations

import csv
import json
import re
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest
import yaml
from armcal.cli.main import cli
from click.testing import CliRunner

ROOT = Path(__file__).resolve().parents[2]
RECORDED = ROOT / "tests" / "data" / "schema.json"
# Mappings whose keys are names of parameters, groups, joints, designs, libraries, and not of the format.
NAMED = re.compile(
    r"groups|bootstrap\.parameters|noise\.scatter|seconds|provenance\.(versions|plugins)|excitation_rad_or_m"
    r"|expected_sd|(parameters\.)?determined_by|minimal\.sd_ordinary_sizes|designs(\.\*\.areas(\.\*\.quantities)?)?|holding_Nm|candidates\.left_out"
    r"|half_width_90|summary(\.\*)?|frames"
)
SLOW = ("run, poses of a camera", "study", "study, grouped", "capability", "acquire, dry")
DEMO = "configs/lrm_arm/demo.yaml"
FAST = "--set evaluator=interpreted"
RUNS: dict[str, tuple[str, ...]] = {
    "run": (
        f"run {DEMO} --out {{out}}/run --json {FAST} --set uncertainty.bootstrap=2 --set validation.folds=2"
        " --set noise.loss=reject --set validation.limit_mm=1"
        " --set 'statics.gravity_m_s2=[5, 0, -8]' --accept",
    ),
    "run, noise estimated": (
        f"run {DEMO} --out {{out}}/run --json {FAST} --set noise.estimate=true --set validation.folds=0",
    ),
    "run, sockets": (f"run configs/ball/demo.yaml --out {{out}}/run --json {FAST}",),
    "run, poses of a camera": (
        f"run configs/camera/demo.yaml --out {{out}}/run --json {FAST} --set validation.folds=0",
    ),
    "check": (f"check {DEMO} --json",),
    "identify": (f"identify {DEMO} --json --minimal",),
    "study": ("study configs/lrm_arm/study_demo.yaml --out {out}/study --json",),
    "study, grouped": ("study configs/lrm_arm/load_transfer.yaml --out {out}/study --json",),
    "plan": ("plan configs/lrm_arm/plan.yaml --poses 20 --out {out}/plan.csv --json --set plan.sweeps=2",),
    "uses of a calibration": (
        f"run {DEMO} --out {{out}}/run -q {FAST} --set validation.folds=0",
        "predict {out}/run/calibration.yaml --poses configs/lrm_arm/demo.csv --out {out}/predicted.csv --json",
        "compensate {out}/run/calibration.yaml --targets configs/lrm_arm/targets.csv --out {out}/commands.csv --json",
        "plan configs/lrm_arm/plan.yaml --iso-cube auto --cycles 3 --out {out}/iso.csv --json",
        f"simulate {DEMO} --poses {{out}}/iso.csv --out {{out}}/measured.csv --json",
        "acceptance {out}/run/calibration.yaml {out}/measured.csv --out {out}/acceptance --json",
    ),
    "capability": (
        "capability configs/lrm_arm/designs.yaml --out {out}/capability --json --set capability.samples=100"
        " --set capability.voxel_mm=100 --set capability.postures=2",
    ),
    "acquire, dry": (
        "plan configs/lrm_arm/bench.yaml --poses 20 --out {out}/plan.csv --json --set plan.sweeps=2",
        "acquire configs/lrm_arm/bench.yaml --plan {out}/plan.csv --dry-run --json",
    ),
}


def keys(content: Any, path: str = "") -> Iterator[str]:
    """The dotted keys of a document; ``[]`` stands for the items of a list, ``*`` for names that are data."""
    if isinstance(content, Mapping):
        for key, value in content.items():
            name = "*" if NAMED.fullmatch(path) else str(key)
            yield from keys(value, f"{path}.{name}" if path else name)
    elif isinstance(content, list) and any(isinstance(item, Mapping | list) for item in content):
        for item in content:
            yield from keys(item, f"{path}[]")
    else:
        yield path


def schema(name: str, folder: Path) -> dict[str, list[str]]:
    """Of each output of an entry, its keys or columns."""
    found: dict[str, list[str]] = {}
    (out := folder / "out").mkdir()
    for line in RUNS[name]:
        arguments = [word.strip("'") for word in re.findall(r"'[^']*'|\S+", line.format(out=out))]
        ran = CliRunner().invoke(cli, arguments)
        assert ran.exit_code == 0, ran.output
        if "--json" in arguments:
            found[f"armcal {arguments[0]}"] = sorted(set(keys(json.loads(ran.stdout))))
    for path in sorted(out.rglob("*")):
        where = str(path.relative_to(out))
        if path.suffix == ".json":
            found[where] = sorted(set(keys(json.loads(path.read_text()))))
        elif path.suffix == ".csv":
            found[where] = next(csv.reader(path.read_text().splitlines()))
        elif path.name == "calibration.yaml":
            found[where] = sorted(set(yaml.load(path.read_text(), yaml.CSafeLoader)))
    return found


@pytest.mark.parametrize("name", [pytest.param(name, marks=pytest.mark.slow if name in SLOW else ()) for name in RUNS])
def test_keys_and_columns_stay(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(ROOT)
    found, expected = schema(name, tmp_path), json.loads(RECORDED.read_text())[name]
    assert list(found) == list(expected)
    for output, names in expected.items():
        assert found[output] == names, f"{output}: {sorted(set(found[output]) ^ set(names))}"


if __name__ == "__main__":
    recorded = {}
    for entry in RUNS:
        with tempfile.TemporaryDirectory() as place:
            recorded[entry] = schema(entry, Path(place))
    lines = [
        f"{json.dumps(entry)}: {{\n"
        + ",\n".join(f" {json.dumps(output)}: {json.dumps(names)}" for output, names in outputs.items())
        + "\n}"
        for entry, outputs in recorded.items()
    ]
    RECORDED.write_text("{\n" + ",\n".join(lines) + "\n}\n")
