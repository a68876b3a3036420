"""Sound recordings of six kinds of instrument, and what the verdict says of them: its false alarms.

Each run draws a true arm and a recording of 20 to 300 records with the stated noise, and calibrates as a user would.
Prints a table: ``python -m tests.clean_runs [RUNS] [KIND ...] [--first SEED] [--write]``.
"""

from __future__ import annotations

import argparse
import json
import shutil
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from armcal.base.parameters import Parameters
from armcal.base.units import shown_unit
from armcal.cli.main import cli
from armcal.config.yaml_source import load_config
from armcal.diagnose.checks import DATA_CHECKS, FIT_CHECKS
from armcal.errors import ArmcalError
from armcal.estimate.simulation import SimulationRequest
from armcal.measure.reader import requested_channels
from armcal.measure.tables import write_csv
from armcal.plugins import use_plugins
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from click.testing import CliRunner

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
RECORD = Path(__file__).resolve().parent / "data" / "clean_runs.json"
"""What 200 runs of each kind gave; the rates of the checks are tested by it."""
FEWEST, MOST = 20, 300
LENGTH_SD_M, ANGLE_SD_RAD = 0.001, 0.003
"""How far a true arm is from its drawing."""
INDUSTRIAL = """joint,alpha_deg,a_mm,theta_deg,d_mm
q1,90,0,0,128
q2,0,-612,0,0
q3,0,-572,0,0
q4,90,0,0,164
q5,-90,0,0,116
q6,0,0,0,92
"""
PLACED = {
    **{"arm.mdh.base_x": 0.3, "arm.mdh.base_y": -0.2, "arm.mdh.base_z": 0.1, "arm.mdh.base_rz": 0.2},
    **{"tracker.target_x": 0.06, "tracker.target_y": -0.04, "tracker.target_z": 0.03},
}
"""What no drawing states: where the arm stands, and where the target sits on the tool (m, rad)."""
_SPAN = {f"q{i}": [-120, 120] for i in range(1, 7)}
_RANDOM = {
    "type": "elastic_arm",
    "truth": "clean_truth.yaml",
    "poses": {"kind": "random", "count": 1, "levels_deg": _SPAN},
}

_BOARD = {"camera": {"board": {"type": "chessboard", "columns": 5, "rows": 4, "square_mm": 40}}}
"""Of few corners: what a run costs grows with their square."""


@dataclass(frozen=True)
class Kind:
    """An instrument: ``config`` writes its configuration, ``counted`` overrides it for so many records."""

    config: Callable[[Path], Path]
    counted: Callable[[int], str] = "simulation.poses.count={}".format
    fixed: Path | None = None


@dataclass(frozen=True)
class Outcome:
    """What a run made of a sound recording: ``grade`` is the worst finding's, or ``refused``."""

    kind: str
    seed: int
    records: int
    grade: str
    said: tuple[str, ...]  # of each check that warned, with its name before it
    seconds: float

    @property
    def checks(self) -> set[str]:
        """Names of the checks that warned."""
        return {text.partition(":")[0] for text in self.said}


def _new(*words: str | Path) -> None:
    made = CliRunner().invoke(cli, ["new", *map(str, words)])
    assert made.exit_code == 0, made.output


def _written(path: Path, content: Mapping[str, Any]) -> Path:
    path.write_text(yaml.safe_dump({"evaluator": "interpreted", **content}, sort_keys=False), encoding="utf-8")
    return path


def _position(folder: Path) -> Path:
    """As ``armcal new robot`` begins it from a table of lengths and angles; the tracker's noise is its data sheet's."""
    (folder / "dh.csv").write_text(INDUSTRIAL, encoding="utf-8")
    _new("robot", "arm", "--dh", folder / "dh.csv", "--convention", "standard", "--up", "z", "--out", folder / "arm")
    return _written(
        folder / "arm" / "clean.yaml",
        {"extends": "calibrate.yaml", "noise": {"estimate": False}, "simulation": _RANDOM},
    )


def _pose(folder: Path) -> Path:
    path = _position(folder)
    arm = yaml.safe_load((folder / "arm" / "arm.yaml").read_text(encoding="utf-8"))
    arm["measurements"]["tracker"] |= {"type": "tip_pose", "orientation_noise_deg": 0.02}
    (folder / "arm" / "arm.yaml").write_text(yaml.safe_dump(arm), encoding="utf-8")
    free = [block.name for block in Experiment.load(path).parameters.free]
    content = yaml.safe_load(path.read_text(encoding="utf-8"))
    return _written(path, {**content, "parameters": {"free": [*free, "tracker.target_rotation"]}})


def _range(folder: Path) -> Path:
    """One draw wire from a place that is roughly known, on an arm that stands where its drawing has it."""
    _new("plugin", "draw-wire", "--kind", "measurement", "--out", folder / "wire")
    use_plugins(folder / "wire" / "draw_wire.py")
    table = [line.split(",") for line in INDUSTRIAL.splitlines()]
    rows = [dict(zip(table[0][1:], map(float, row[1:]), strict=True)) for row in table[1:]]
    return _written(
        folder / "range.yaml",
        {
            "arms": {"arm": {"model": {"type": "mdh", "convention": "standard", "rows": rows}}},
            "measurements": {"wire": {"type": "draw_wire", "noise_mm": 0.2, "anchor_mm": [900, 300, -400]}},
            "parameters": {
                "free": ["arm.mdh.theta[2-4]", "arm.mdh.a[23]", "wire.anchor_[xyz]"],
                "priors": {"arm.mdh.theta*": "2 deg", "arm.mdh.a[23]": "10 mm", "wire.anchor_*": "10 mm"},
            },
            "data": {"type": "csv", "path": "data.csv"},
            "validation": {"folds": 5},
            "simulation": _RANDOM,
        },
    )


def _shipped(config: Path, **changes: Any) -> Callable[[Path], Path]:
    """A configuration of the demos, with truths of its own."""

    def written(folder: Path) -> Path:
        shutil.copytree(config.parent, folder / config.parent.name)
        simulation = {**load_config(config).data["simulation"], "truth": "clean_truth.yaml"}
        content = {"extends": config.name, "simulation": simulation, **changes}
        return _written(folder / config.parent.name / "clean.yaml", content)

    return written


KINDS: Mapping[str, Kind] = {
    "range": Kind(_range),
    "position": Kind(_position),
    "pose": Kind(_pose),
    "pixels": Kind(
        _shipped(CONFIGS / "camera" / "demo.yaml", measurements=_BOARD), fixed=CONFIGS / "camera" / "truth.yaml"
    ),
    "sockets": Kind(
        _shipped(CONFIGS / "ball" / "demo.yaml"),
        lambda count: f"simulation.count={max(6, count // 8)}",
        CONFIGS / "ball" / "truth.yaml",
    ),
    "two arms": Kind(_shipped(CONFIGS / "frida" / "dual_known_clamp.yaml"), "simulation.count={}".format),
}


def _truth(parameters: Parameters, fixed: Path | None, random: np.random.Generator) -> dict[str, str]:
    """True values: each free number off its drawing by chance, what ``fixed`` says of anything else as it is there."""
    values: dict[str, str] = {} if fixed is None else dict(load_config(fixed).data)
    for block in parameters.free:
        if block.size > 1 or block.name in PLACED or block.unit not in ("m", "rad"):
            continue
        off = random.normal() * (LENGTH_SD_M if block.unit == "m" else ANGLE_SD_RAD)
        if not (fixed is not None and block.name.startswith("camera.")):
            values[block.name] = f"{(block.nominal[0] + off) * 1000:.6f} m{block.unit}"
    placed = {name: shift for name, shift in PLACED.items() if name in parameters.names and parameters[name].free}
    units = {name: shown_unit(parameters[name].unit) for name in placed}
    return {**values, **{name: f"{units[name][0] * shift:.6f} {units[name][1]}" for name, shift in placed.items()}}


def run(kind: str, seed: int, config: Path) -> Outcome:
    """One recording, read from its CSV file and calibrated as ``config`` of this kind says."""
    random, stated = np.random.default_rng([seed, *kind.encode()]), KINDS[kind]
    count = int(np.exp(random.uniform(np.log(FEWEST), np.log(MOST))))
    experiment = Experiment.load(config, [stated.counted(count), f"simulation.seed={seed}"])
    truth = _truth(experiment.parameters, stated.fixed, random)
    (config.parent / "clean_truth.yaml").write_text(yaml.safe_dump(truth), encoding="utf-8")
    system, began = experiment.system, time.process_time()
    request = SimulationRequest(system.arms, system.measurements, experiment.parameters, system.environment)
    dataset = experiment.simulator().simulate(request)
    data = config.parent / "clean.csv"
    write_csv(data, dataset, list(requested_channels(system.arms, system.measurements, measured=True)))
    try:
        result = calibrate(Experiment.load(config, (), data))
    except ArmcalError as fault:
        return Outcome(kind, seed, len(dataset), "refused", (f"refused: {fault}",), time.process_time() - began)
    seconds = time.process_time() - began
    grades = [finding.grade for finding in result.verdict.findings]
    grade = next((own for own in ("bad", "warning") if own in grades), "good")
    subjects = [*((check, result.fit.ready) for check in DATA_CHECKS), *((check, result.fit) for check in FIT_CHECKS)]
    said = tuple(
        f"{check.name}: {finding.grade}: {finding.text} [{finding.test}]"
        for check, subject in (subjects if grade != "good" else ())
        for finding in check.findings(subject)
        if finding.grade in ("bad", "warning") and check.name != "before"
    )
    return Outcome(kind, seed, len(dataset), grade, said, seconds)


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """Of one kind: how many runs, their grades, and how many of them each check warned of."""
    grades, checks = Counter(one.grade for one in outcomes), Counter(name for one in outcomes for name in one.checks)
    return {"runs": len(outcomes), "grades": dict(grades), "checks": dict(checks.most_common())}


def main() -> None:
    """Print of each kind its grades and the checks that warned; ``--write`` keeps them as the tests expect them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("runs", nargs="?", type=int, default=200)
    parser.add_argument("kinds", nargs="*", default=[*KINDS])
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--write", action="store_true")
    words = parser.parse_args()
    for kind in words.kinds:
        use_plugins()
        with tempfile.TemporaryDirectory() as place:
            config = KINDS[kind].config(Path(place))
            outcomes = [run(kind, seed, config) for seed in range(words.first, words.first + words.runs)]
        for outcome in outcomes:
            for text in outcome.said:
                print(f"    {outcome.seed:4} {text[:160]}")
        own, seconds = summary(outcomes), sum(outcome.seconds for outcome in outcomes)
        print(f"{kind:10} {own}, {seconds:.0f} s", flush=True)
        if words.write:
            kept = json.loads(RECORD.read_text(encoding="utf-8")) if RECORD.exists() else {}
            RECORD.write_text(json.dumps({**kept, kind: own}, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
