"""Records held out by group: trained at one payload or place, judged at another; no record judges its own fit."""

from __future__ import annotations

import csv
import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.io.parallel import Executor
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal.run.study import Study, StudyResult, compare
from click.testing import CliRunner, Result

pytestmark = pytest.mark.slow

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
STUDY = """
extends: load_transfer.yaml
name: small
evaluator: interpreted
simulation: {poses: {count: 60}}
study:
  folds: 3
  variants:
    elastic: {set: {parameters.free: ["arm.mdh.theta?", "arm.spring.k[0-4]"]}}
    kinematic: {set: {parameters.free: ["arm.mdh.theta?"]}}
"""


def armcal(*arguments: str) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, list(arguments))


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A copy of the shipped configurations with a small study; its truth is what the elastic variant can say."""
    folder = Path(shutil.copytree(CONFIGS, tmp_path / "configs"))
    lines = (folder / "truth.yaml").read_text().splitlines()
    kept = [line for line in lines if "theta" in line or line.startswith(tuple(f"arm.spring.k{i}" for i in range(5)))]
    (folder / "truth.yaml").write_text("\n".join(kept) + "\n")
    (folder / "study.yaml").write_text(STUDY)
    return folder


def _run(path: Path, *overrides: str, data: Path | None = None, executor=None) -> StudyResult:
    return compare(Study.load(path, overrides, data), executor or Executor(1))


def _mean(result: StudyResult, variant: str, trained: tuple[str, ...], judged: str) -> float:
    cells = [c for c in result.cells if (c.variant, c.trained_at, c.judged_at) == (variant, trained, judged)]
    assert len(cells) == 1
    return cells[0].error_mm.mean


def _measured(place: Path, grams: dict[float, int], column: str = "payload_g") -> Path:
    """A CSV of simulated records, so many at each payload."""
    rows: list[dict[str, str]] = []
    for number, (payload, count) in enumerate(grams.items()):
        out = place / f"at_{number}.csv"
        sets = [f"statics.payload_g={payload}", f"simulation.seed={number}", f"simulation.poses.count={count}"]
        done = armcal(
            "simulate", str(place / "load_transfer.yaml"), "--out", str(out), *(x for s in sets for x in ("--set", s))
        )
        assert done.exit_code in (0, 2), done.output
        for row in csv.DictReader(out.open()):
            rows.append({**row, "pose_id": f"{number}-{row['pose_id']}", column: f"{payload}"})
    whole = place / "measured.csv"
    with whole.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    return whole


@pytest.fixture
def plain(place: Path) -> Path:
    """The study's configuration without its study, for runs and simulations."""
    text = (place / "load_transfer.yaml").read_text().replace("  payloads_g: [0, 66.3]\n", "")
    (place / "load_transfer.yaml").write_text(text.partition("\nstudy:")[0] + "\n")
    (place / "study.yaml").write_text(STUDY.replace("study:\n", "study:\n  group_by: payload\n"))
    return place


@pytest.mark.slow
def test_only_the_elastic_model_carries_over(place: Path) -> None:
    result = _run(place / "study.yaml", "simulation.payloads_g=[0, 250]")
    assert result.simulated and result.groups == {"0 g": 60, "250 g": 60}
    for trained, judged in (("0 g", "250 g"), ("250 g", "0 g")):
        at_home = _mean(result, "elastic", (judged,), judged)
        assert _mean(result, "elastic", (trained,), judged) < 1.15 * at_home < 1.15
        assert _mean(result, "kinematic", (trained,), judged) > 10 * at_home
    assert _mean(result, "elastic", ("0 g", "250 g"), "250 g") < 1.0
    assert _mean(result, "kinematic", (), "250 g") == _mean(result, "elastic", (), "250 g") > 10


@pytest.mark.slow
def test_a_cell_at_another_load_is_a_run_at_one_judged_on_the_other(plain: Path) -> None:
    data = _measured(plain, {0: 40, 66.3: 30})
    result = _run(plain / "study.yaml", data=data)
    ids = [row["pose_id"] for row in csv.DictReader(data.open())]
    for trained, judged, prefix in (("0 g", "66.3 g", "0-"), ("66.3 g", "0 g", "1-")):
        train = plain / "train.csv"
        train.write_text("\n".join(["pose_id", *(i for i in ids if i.startswith(prefix))]) + "\n")
        sets = ["parameters.free=['arm.mdh.theta?', 'arm.spring.k[0-4]']", "evaluator=interpreted"]
        by_payload = ("validation.group_by=payload", f"validation.train_groups=[{trained}]")
        for asked in ((f"validation.train_ids={train}",), by_payload):
            run = calibrate(Experiment.load(plain / "load_transfer.yaml", [*sets, *asked], data))
            held = run.table.calibrated["holdout"]
            assert held.mean == pytest.approx(_mean(result, "elastic", (trained,), judged), rel=1e-9)
        assert list(run.groups) == ["0 g", "66.3 g"]
        cell = next(
            c for c in result.cells if (c.variant, c.trained_at, c.judged_at) == ("elastic", (trained,), judged)
        )
        assert not cell.cross_validated and cell.error_mm.count == held.count
        assert cell.error_mm.mean == pytest.approx(held.mean, rel=1e-9)
        assert cell.error_mm.p95 == pytest.approx(held.p95, rel=1e-9)


@pytest.mark.slow
def test_records_that_were_measured_give_what_their_simulation_gave(place: Path, tmp_path: Path) -> None:
    simulated = _run(place / "study.yaml")
    out = place / "out"
    assert armcal("study", str(place / "study.yaml"), "--out", str(out)).exit_code == 0
    from armcal.measure.tables import write_csv

    experiment = Study.load(place / "study.yaml").experiments["elastic"]
    data = tmp_path / "measured.csv"
    write_csv(data, simulated.dataset, experiment.request(measured=True).channels)
    if "payload_g" not in data.read_text().splitlines()[0]:
        lines = data.read_text().splitlines()
        grams = simulated.dataset.column("payload") * 1000
        rows = [f"{line},{g:.1f}" for line, g in zip(lines[1:], grams, strict=True)]
        data.write_text("\n".join([f"{lines[0]},payload_g", *rows]) + "\n")
    measured = _run(place / "study.yaml", data=data)
    assert not measured.simulated and measured.dataset.ids == simulated.dataset.ids
    for one, other in zip(simulated.cells, measured.cells, strict=True):
        assert (one.variant, one.trained_at, one.judged_at, one.cross_validated) == (
            other.variant,
            other.trained_at,
            other.judged_at,
            other.cross_validated,
        )
        assert one.error_mm.mean == pytest.approx(other.error_mm.mean, rel=1e-6)


@pytest.mark.slow
def test_no_figure_rests_on_a_record_that_it_judges(plain: Path) -> None:
    """Measured values far off at one payload change nothing that was trained and judged at the other."""
    data = _measured(plain, {0: 20, 66.3: 20})
    clean = _run(plain / "study.yaml", data=data)
    rows = list(csv.DictReader(data.open()))
    for row in rows:
        if row["payload_g"] == "66.3":
            row["x_mm"] = f"{float(row['x_mm']) + 50:.6f}"
    with data.open("w", newline="") as file:
        writer = csv.DictWriter(file, list(rows[0]))
        writer.writeheader()
        writer.writerows(rows)
    spoilt = _run(plain / "study.yaml", data=data)
    here = np.arange(40) < 20
    for variant in ("elastic", "kinematic"):
        key = (variant, ("0 g",))
        assert np.array_equal(clean.trained_mm[key][here], spoilt.trained_mm[key][here])
        assert np.all(spoilt.trained_mm[key][~here] > clean.trained_mm[key][~here] + 20)
        assert np.array_equal(clean.trained_mm[variant, ("0 g", "66.3 g")], clean.variant(variant).errors_mm)


@pytest.mark.slow
def test_payloads_are_told_apart_to_a_tenth_of_a_gram(plain: Path) -> None:
    everything = _run(plain / "study.yaml", data=_measured(plain, {120: 10, 66.3: 20, 66.32: 5, 0: 20}))
    assert list(everything.groups.items()) == [("0 g", 20), ("66.3 g", 25), ("120 g", 10)]
    assert {c.trained_at for c in everything.cells} == {(), ("0 g",), ("66.3 g",), ("120 g",), tuple(everything.groups)}


@pytest.mark.slow
def test_any_workers_give_the_same(place: Path) -> None:
    one, other = (_run(place / "study.yaml", executor=e) for e in (Executor(1), Executor(2)))
    assert one.cells == other.cells
    assert all(np.array_equal(one.trained_mm[key], other.trained_mm[key], equal_nan=True) for key in one.trained_mm)


@pytest.mark.parametrize(
    "setting, says",
    [
        ("simulation.payloads_g=[0]", "a second payload"),
        ("simulation.payloads_g=[0, 0.00001]", "a second payload"),
        ("simulation.payloads_g=[0, -5]", "payloads_g"),
        ("simulation.payloads_g=[]", "a column payload_g"),
        ("simulation.payloads=[0, 66.3]", "found both payloads_g and payloads"),
        ("simulation.payloads_mm=[0, 66.3]", "payloads"),
        ("study.kind=load_transfer", "kind"),
        ("study.group_by=colour", "found no column colour"),
        ("simulation=null", "found no data"),
        ("simulation.poses.count=2", "too few records"),
        ("study.variants.elastic.set={parameters.free: ['arm.mdh.*']}", "variant elastic"),
    ],
)
def test_a_study_of_loads_that_cannot_be_is_bad_input(place: Path, setting: str, says: str) -> None:
    done = armcal("study", str(place / "study.yaml"), "--out", str(place / "out"), "--set", setting)
    assert done.exit_code == 2, done.output
    assert says in done.output and not (place / "out").exists()


@pytest.mark.slow
def test_measured_records_must_say_their_payload(plain: Path) -> None:
    data = _measured(plain, {0: 12, 66.3: 12})
    silent = plain / "silent.csv"
    lines = [line.rpartition(",")[0] for line in data.read_text().splitlines()]
    silent.write_text("\n".join(lines) + "\n")
    for path, says in ((silent, "payload_g"), (CONFIGS / "demo.csv", "payload_g"), (plain / "nowhere.csv", "nowhere")):
        done = armcal("study", str(plain / "study.yaml"), "--data", str(path), "--out", str(plain / "out"))
        assert done.exit_code == 2 and says in done.output, done.output
    one = _measured(plain, {66.3: 12})
    done = armcal("study", str(plain / "study.yaml"), "--data", str(one), "--out", str(plain / "out"))
    assert done.exit_code == 2 and "66.3 g (12)" in done.output


@pytest.mark.slow
def test_the_files_agree_with_the_terminal(place: Path) -> None:
    out = place / "out"
    done = armcal("study", str(place / "study.yaml"), "--out", str(out), "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["group_by"] == "payload" and told["groups"] == {"0 g": 60, "66.3 g": 60}
    rows = list(csv.DictReader((out / "study.csv").open()))
    for cell in told["cells"]:
        if not cell["trained_at"]:
            continue
        alone = len(cell["trained_at"]) == 1
        trained = "_trained_at_" + cell["trained_at"][0].replace(" ", "_") if alone else ""
        errors = [float(r[f"{cell['variant']}{trained}_mm"]) for r in rows if r["payload"] == cell["judged_at"]]
        assert np.mean(errors) == pytest.approx(cell["error_mm"]["mean"], abs=1e-5)
        assert cell["cross_validated"] == (cell["judged_at"] in cell["trained_at"])
    shown = armcal("study", str(place / "study.yaml"), "--out", str(out))
    assert "elastic" in shown.output and "against" in shown.output and "*" in shown.output
    assert "66.3 g" in (out / "study.html").read_text()


@pytest.mark.slow
def test_the_shipped_study_runs(tmp_path: Path) -> None:
    done = armcal("study", str(CONFIGS / "load_transfer.yaml"), "--out", str(tmp_path / "o"), "--json")
    assert done.exit_code == 0, done.output
    means = {
        (c["variant"], tuple(c["trained_at"]), c["judged_at"]): c["error_mm"]["mean"]
        for c in json.loads(done.stdout)["cells"]
    }
    for trained, judged in (("0 g", "66.3 g"), ("66.3 g", "0 g")):
        assert means["elastic", (trained,), judged] < 1.1 * means["elastic", (judged,), judged] < 1.1
        assert means["kinematic", (trained,), judged] > 10
