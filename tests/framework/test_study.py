"""Studies: variants of one configuration, compared fairly; a choice is judged by records it never saw."""

from __future__ import annotations

import csv
import json
import re
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.config.yaml_source import load_variants
from armcal.errors import ConfigError, NotConvergedError, ProblemError
from armcal.estimate.validation import FitTask, fit_and_judge, folds
from armcal.io.parallel import Executor
from armcal.report.study_document import conclusions
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal.run.study import Study, compare
from click.testing import CliRunner, Result

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
FAST = ("evaluator=interpreted",)
COMPILED = ("evaluator=compiled",)
ORDERED = ("data.columns={sequence: pose_id}",)
SMALL = """
extends: arm.yaml
name: small
data: {type: csv, path: demo.csv}
study:
  folds: 3
  seed: 2
  variants:
    none: {}
    angles: {set: {parameters.free: ["arm.mdh.theta[1-3]"]}}
    springs: {extends: angles, add: {parameters.free: ["arm.spring.k[0-2]"]}}
    lengths: {extends: springs, add: {parameters.free: [arm.mdh.after2_z, arm.mdh.base_z]}}
"""
TWO = SMALL.partition("    springs:")[0]
"""The first two of its variants."""


@pytest.fixture
def place(tmp_path: Path) -> Path:
    """A copy of the shipped configurations, to write studies beside."""
    return Path(shutil.copytree(CONFIGS, tmp_path / "configs"))


def _write(place: Path, text: str) -> Path:
    path = place / "study.yaml"
    path.write_text(text)
    return path


def armcal(*arguments: str) -> Result:
    """One command in this process."""
    return CliRunner().invoke(cli, list(arguments))


def _variants(place: Path, section: str, *overrides: str):
    text = f"extends: arm.yaml\nestimator: {{type: cvxpy}}\nstudy:\n  variants:\n{section}"
    return load_variants(_write(place, text), overrides)


def test_a_variant_is_the_whole_configuration_with_its_own_over_it(place: Path) -> None:
    base, read = _variants(
        place,
        "    plain:\n"
        "    whole: {extends: option1.yaml}\n"
        "    free: {extends: whole, set: {parameters.bounds: none, statics.payload_g: 12, estimator.seed: 3}}\n"
        "    more: {extends: [free], add: {parameters.free: [arm.mdh.d3, arm.mdh.d6], parameters.fixed: arm.mdh.d4}}\n",
    )
    data = {name: source.data for name, source in read.items()}
    assert list(data) == ["plain", "whole", "free", "more"]
    assert "study" in base.data and not any("study" in each for each in data.values())
    assert "parameters" not in data["plain"] and data["plain"]["estimator"]["type"] == "cvxpy"
    option1 = Experiment.load(place / "option1.yaml").source.data
    assert data["whole"]["parameters"] == option1["parameters"] and data["whole"]["arms"] == option1["arms"]
    assert data["free"]["parameters"] == {**option1["parameters"], "bounds": "none"}
    assert data["free"]["statics"] == {**option1["statics"], "payload_g": 12}
    assert data["more"]["parameters"]["free"] == [*option1["parameters"]["free"], "arm.mdh.d3", "arm.mdh.d6"]
    assert data["more"]["parameters"]["fixed"] == ["arm.mdh.d4"]
    assert data["free"]["parameters"]["free"] == option1["parameters"]["free"], "adding changed what was extended"
    assert read["free"].where(("parameters", "bounds")).file == str(place / "study.yaml")
    assert read["more"].where(("parameters", "free", 0)).file == str(place / "option1.yaml")


def test_a_file_lies_over_the_study_and_the_command_line_over_the_file_and_what_a_variant_sets_over_both(
    place: Path,
) -> None:
    section = (
        "    file: {extends: option1.yaml}\n"
        "    own: {extends: option1.yaml, set: {estimator.type: ipopt, estimator.starts: 2}}\n"
        "    gone: {extends: option1.yaml, set: {parameters: null}}\n"
    )
    assert _variants(place, section)[1]["file"].data["estimator"]["type"] == "ipopt"
    base, read = _variants(place, section, "estimator.type=kalman", "study.folds=4", "parameters.free.0=arm.mdh.d6")
    assert base.data["study"]["folds"] == 4
    assert read["file"].data["estimator"]["type"] == "kalman"
    assert read["file"].data["parameters"]["free"][0] == "arm.mdh.d6"
    assert read["own"].data["estimator"] == {"type": "ipopt", "starts": 2}
    assert "parameters" not in read["gone"].data


def test_the_command_line_does_not_undo_what_an_extended_variant_set(place: Path) -> None:
    section = "    one: {extends: option1.yaml, set: {parameters.free: [arm.mdh.d6]}}\n    two: {extends: one}\n"
    _, read = _variants(place, section, "parameters.free=[arm.mdh.d5]")
    assert read["one"].data["parameters"]["free"] == ["arm.mdh.d6"]
    assert read["two"].data["parameters"]["free"] == ["arm.mdh.d6"]


@pytest.mark.parametrize(
    "section, says",
    [
        ("    a: {extend: option1.yaml}\n", ["extend", "extends, set or add"]),
        ("    a: option1.yaml\n", ["option1.yaml", "extends, set or add"]),
        ("    a: {extends: b}\n    b: {}\n", ["no such file", "extends"]),
        ("    a: {extends: ../option1.yaml}\n", ["option1.yaml"]),
        ("    a: {set: {extends: option1.yaml}}\n", ["'extends'", "dotted name"]),
        ("    a: {set: {study.folds: 3}}\n", ["study.folds", "dotted name"]),
        ("    a: {set: {'parameters..free': []}}\n", ["parameters..free", "dotted name"]),
        ("    a: {set: [parameters]}\n", ["dotted names"]),
        ("    a: {set: {parameters.priors.arm.mdh.d?: null}}\n", ["nothing at", "double quotes"]),
        ("    a: {set: {name.inner: 3}}\n    ", []),
        ("    a: {add: {statics.body: mars}}\n", ["earth", "a list to add to", "set:"]),
    ],
)
def test_a_variant_that_cannot_be_is_refused_in_its_own_words(place: Path, section: str, says: list[str]) -> None:
    if not says:
        assert _variants(place, section)[1]["a"].data["name"] == {"inner": 3}
        return
    with pytest.raises(ConfigError) as caught:
        _variants(place, section)
    assert all(word in str(caught.value) for word in says), str(caught.value)
    assert "study.yaml" in str(caught.value) or "option1" in str(caught.value)


@pytest.mark.quick("change0-found no study", "change1-folds", "change2-folds", "change4-kind", "change7-blocks")
@pytest.mark.parametrize(
    "change, says",
    [
        (("study:", "studies:"), "found no study"),
        (("folds: 3", "folds: 1"), "folds"),
        (("folds: 3", "fold: 3"), "folds"),
        (("folds: 3", "reference: other"), "previous or one of none, angles, springs, lengths"),
        (("folds: 3", "kind: models"), "kind"),
        (("folds: 3", "folds: 201"), "201 folds of 200 records"),
        (("folds: 3", "nested: 3"), "nested"),
        (("folds: 3", "blocks: long"), "blocks"),
        (("arm.mdh.theta[1-3]", "arm.mdh.thata1"), "variant angles"),
        (("arm.mdh.base_z]", '"arm.mdh.base_[xyz]", arm.mdh.d1]'), "variant lengths"),
        (("arm.mdh.base_z]", "arm.mdh.base_z], validation.nothing: [1]"), "nothing"),
    ],
)
def test_a_study_that_cannot_be_is_bad_input(place: Path, change: tuple[str, str], says: str) -> None:
    assert change[0] in SMALL
    path = _write(place, SMALL.replace(*change))
    done = armcal("study", str(path), "--out", str(place / "out"), "--set", FAST[0])
    assert done.exit_code == 2, done.output
    assert says in done.output and not (place / "out").exists()


def _run(path: Path, *overrides: str, executor=None):
    return compare(Study.load(path, [*FAST, *overrides]), executor or Executor(1))


@pytest.fixture(scope="module")
def ladder(tmp_path_factory: pytest.TempPathFactory):
    """The result of the small study as it stands."""
    place = Path(shutil.copytree(CONFIGS, tmp_path_factory.mktemp("ladder") / "configs"))
    return _run(_write(place, SMALL))


@pytest.fixture(scope="module")
def two_rungs(tmp_path_factory: pytest.TempPathFactory):
    """The result of the first two of its variants."""
    place = Path(shutil.copytree(CONFIGS, tmp_path_factory.mktemp("two") / "configs"))
    return _run(_write(place, TWO))


@pytest.fixture(scope="module")
def close_choices(tmp_path_factory: pytest.TempPathFactory):
    """The result of the study whose choices are close."""
    place = Path(shutil.copytree(CONFIGS, tmp_path_factory.mktemp("close") / "configs"))
    return _run(_few(place), *COMPILED)


@pytest.mark.slow
def test_errors_are_those_of_a_run_with_the_same_folds(place: Path, two_rungs) -> None:
    result = two_rungs
    overrides = [*FAST, "parameters.free=['arm.mdh.theta[1-3]']"]
    overrides += ["validation.holdout=0", "validation.folds=3", "validation.seed=2"]
    run = calibrate(Experiment.load(place / "demo.yaml", overrides))
    angles = result.variant("angles")
    assert np.array_equal(angles.errors_mm, run.errors.cross_validated_mm)
    assert angles.crossed == run.table.calibrated["cross_validated"]
    assert angles.train.mean == pytest.approx(run.table.calibrated["train"].mean, rel=1e-12)
    assert angles.nominal == run.table.nominal["train"]
    assert [v.free for v in result.variants] == [0, 3]
    nothing = result.variant("none")
    assert nothing.crossed == nothing.train == nothing.nominal


@pytest.mark.slow
def test_each_rung_is_compared_with_the_one_before_or_with_one_reference(place: Path, ladder) -> None:
    against = _run(_write(place, SMALL), "study.reference=springs")
    assert [v.change and v.change.against for v in ladder.variants] == [None, "none", "angles", "springs"]
    assert [v.change and v.change.against for v in against.variants] == ["springs", "springs", None, "springs"]
    errors = {v.name: v.errors_mm for v in ladder.variants}
    for v in (*ladder.variants, *against.variants):
        if v.change:
            difference = v.errors_mm - errors[v.change.against]
            assert v.change.mean == pytest.approx(difference.mean())
            assert v.change.helped == np.mean(difference < 0)
    assert ladder.variant("lengths").change == against.variant("lengths").change
    means = [v.crossed.mean for v in ladder.variants]
    assert ladder.best == ladder.variants[int(np.argmin(means))].name


@pytest.mark.slow
def test_studies_are_the_same_on_any_workers(place: Path) -> None:
    path = _write(place, SMALL)
    one, other = _run(path, "study.nested=true"), _run(path, "study.nested=true", executor=Executor(2))
    for a, b in zip(one.variants, other.variants, strict=True):
        assert np.array_equal(a.errors_mm, b.errors_mm) and (a.crossed, a.change) == (b.crossed, b.change)
    assert one.nested.chosen == other.nested.chosen
    assert np.array_equal(one.nested.errors_mm, other.nested.errors_mm)


CLOSE = """
extends: arm.yaml
data: {type: csv, path: few.csv}
study:
  folds: 3
  seed: 1
  nested: true
  variants:
    base: {set: {parameters.free: ["arm.mdh.theta[1-6]", "arm.spring.k[0-4]", "arm.mdh.base_[xyz]", arm.mdh.d5]}}
    a: {extends: base, add: {parameters.free: ["arm.mdh.a[3-5]"]}}
    b: {extends: base, add: {parameters.free: ["arm.mdh.alpha[23]"]}}
    c: {extends: base, add: {parameters.free: ["arm.mdh.tool_[yz]"]}}
"""


def _few(place: Path, spoilt: tuple[int, ...] = ()) -> Path:
    """A study on 40 records, so that choices are close; some with measured values that are far off."""
    lines = (place / "demo.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:161:4]]
    for i in spoilt:
        rows[i][-3:] = [f"{float(x) + 60 * (-1) ** k:.4f}" for k, x in enumerate(rows[i][-3:])]
    (place / "few.csv").write_text("\n".join([lines[0], *(",".join(row) for row in rows)]) + "\n")
    return _write(place, CLOSE)


@pytest.mark.slow
def test_a_nested_choice_is_made_without_the_records_that_judge_it(place: Path, close_choices) -> None:
    clean = close_choices
    assert len(set(clean.nested.chosen)) > 1, "the choices are too clear to test anything"
    for number, outer in enumerate(folds(40, 3, 1)):
        spoilt = _run(_few(place, tuple(outer.holdout.tolist())), *COMPILED)
        assert spoilt.nested.chosen[number] == clean.nested.chosen[number]
        assert np.all(spoilt.nested.errors_mm[outer.holdout] > 40)


@pytest.mark.slow
def test_a_nested_choice_is_that_of_a_plain_loop(place: Path, close_choices) -> None:
    result, study = close_choices, Study.load(_few(place), COMPILED)
    experiments = study.experiments
    made = {}
    for name, e in experiments.items():
        dataset = e.read()
        system = e.system
        problem = _problem(e, system, dataset)
        made[name] = (e, problem.of(dataset))

    def errors(name: str, train: np.ndarray, held: np.ndarray) -> np.ndarray:
        e, problem = made[name]
        split = replace(folds(40, 3, 1)[0], train=train, holdout=held)
        return fit_and_judge(FitTask(problem, e.estimator, e.parameters.nominal(), split)).errors

    chosen, judged = [], np.zeros(40)
    for outer in folds(40, 3, 1):
        inner = folds(len(outer.train), 3, 1)
        means = {
            name: np.mean(np.concatenate([errors(name, outer.train[s.train], outer.train[s.holdout]) for s in inner]))
            for name in experiments
        }
        best = min(means, key=means.get)
        chosen.append(best)
        judged[outer.holdout] = errors(best, outer.train, outer.holdout) * 1000
    assert result.nested.chosen == tuple(chosen)
    assert np.array_equal(result.nested.errors_mm, judged)
    assert result.nested.crossed.mean == pytest.approx(judged.mean())
    naive = result.variant(result.best).crossed.mean
    assert result.nested.crossed.mean >= naive, "the choice looks better than the best that it could choose"


def _problem(experiment: Experiment, system, dataset):
    from armcal.problem.problem import Problem

    return Problem.build(
        system.arms, system.measurements, experiment.parameters, system.environment, dataset, "compiled"
    )


@pytest.mark.slow
def test_variants_must_be_judged_on_the_same_records(place: Path) -> None:
    lines = (place / "demo.csv").read_text().splitlines()
    (place / "other.csv").write_text("\n".join(lines[:-1]) + "\n")
    path = _write(place, TWO.replace("none: {}", "none: {set: {data.path: other.csv}}"))
    with pytest.raises(ProblemError, match=r"not judged on the same records: 199 and 200"):
        _run(path)


@pytest.mark.slow
def test_a_variant_whose_fits_fail_is_never_chosen(place: Path) -> None:
    path = _write(place, SMALL.replace("lengths: {extends: springs,", "lengths: {extends: springs, set: {LIMIT},"))
    path.write_text(path.read_text().replace("LIMIT", "estimator.max_iterations: 1"))
    result = _run(path, "study.nested=true")
    lengths = result.variant("lengths")
    assert lengths.failed_folds == 3 and not lengths.converged and lengths.crossed.count == 0
    assert result.best == "springs" and set(result.nested.chosen) == {"springs"}
    assert any("lengths" in text and "not chosen" in text for text in result.warnings)
    done = armcal("study", str(path), "--out", str(place / "out"), "--set", FAST[0], "--json")
    shown = armcal("study", str(path), "--out", str(place / "shown"), "--set", FAST[0])
    assert "(-)" in shown.output and "not chosen" in shown.output
    assert done.exit_code == 0 and json.loads(done.stdout)["variants"][3]["error_mm"]["cross_validated"]["mean"] is None
    alone = re.sub(r"    (none|angles): .*\n", "", SMALL).replace("extends: angles, ", "")
    with pytest.raises(NotConvergedError, match="of every variant"):
        _run(_write(place, alone), "estimator.max_iterations=1", "study.seed=1", "statics.payload_g=500")


@pytest.mark.slow
def test_a_study_judges_by_every_record_whatever_a_run_would_hold_out(place: Path, ladder) -> None:
    path = _write(place, SMALL + "validation: {holdout: 0.5, folds: 9, seed: 5}\n")
    held = _run(path)
    assert all(np.array_equal(a.errors_mm, b.errors_mm) for a, b in zip(held.variants, ladder.variants, strict=True))


@pytest.mark.slow
def test_a_study_leaves_files_that_agree(place: Path) -> None:
    path, out = _write(place, SMALL), place / "out"
    done = armcal("study", str(path), "--out", str(out), "--set", FAST[0], "--set", "study.nested=true", "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert {p.name for p in out.iterdir()} == {"experiment.yaml", "study.csv", "study.html", "study.json"}
    kept = json.loads((out / "study.json").read_text())
    assert kept == {k: v for k, v in told.items() if k not in ("folder", "schema_version")}
    rows = list(csv.DictReader((out / "study.csv").open()))
    assert len(rows) == kept["records"] == 200
    for variant in kept["variants"]:
        errors = np.array([float(row[f"{variant['name']}_mm"]) for row in rows])
        crossed = variant["error_mm"]["cross_validated"]
        assert errors.mean() == pytest.approx(crossed["mean"], abs=1e-5)
        assert np.percentile(errors, 95) == pytest.approx(crossed["p95"], abs=1e-5)
    nested = np.array([float(row["chosen_inside_mm"]) for row in rows])
    assert nested.mean() == pytest.approx(kept["nested"]["error_mm"]["mean"], abs=1e-5)
    page = (out / "study.html").read_text()
    assert all(f">{v['name']}<" in page for v in kept["variants"])
    assert not re.search(r"(src|href)=[\"'](?!#|data:)", page) and "<script" not in page


@pytest.mark.slow
def test_the_study_that_was_run_can_be_run_again_without_the_files_it_extended(place: Path, tmp_path: Path) -> None:
    text = SMALL.replace("none: {}", "none: {extends: option5.yaml, set: {parameters.bounds: none}}")
    path, out, data = _write(place, text), tmp_path / "out", str(tmp_path / "measured.csv")
    (place / "demo.csv").rename(data)
    first = armcal("study", str(path), "--data", data, "--out", str(out), "--set", FAST[0], "--json")
    assert first.exit_code == 0, first.output
    shutil.rmtree(place)
    again = armcal("study", str(out / "experiment.yaml"), "--data", data, "--out", str(tmp_path / "b"), "--json")
    assert again.exit_code == 0, again.output
    one, other = (json.loads(each.stdout)["variants"] for each in (first, again))
    for a, b in zip(one, other, strict=True):
        assert (a["name"], a["free"], a["error_mm"], a["change_mm"]) == (
            b["name"],
            b["free"],
            b["error_mm"],
            b["change_mm"],
        )


@pytest.mark.slow
def test_an_earlier_study_is_kept_and_a_run_is_not_written_into_one(place: Path) -> None:
    path, out = _write(place, SMALL), place / "out"
    for _ in range(2):
        assert armcal("study", str(path), "--out", str(out), "-q", "--set", FAST[0]).exit_code == 0
    assert (out / "earlier" / "1" / "study.json").is_file()
    assert armcal("run", str(place / "demo.yaml"), "--out", str(out)).exit_code == 2
    foreign = armcal("study", str(path), "--out", str(place))
    assert foreign.exit_code == 2 and "arm.yaml" in foreign.output


@pytest.mark.slow
def test_names_of_variants_are_shown_as_text(place: Path) -> None:
    path = _write(place, TWO.replace("none: {}", "'<b>[bold]': {}"))
    done = armcal("study", str(path), "--out", str(place / "out"), "--set", FAST[0])
    assert done.exit_code == 0, done.output
    assert "<b>" in done.output
    page = (place / "out" / "study.html").read_text()
    assert "<b>" not in page and "&lt;b&gt;" in page


@pytest.mark.slow
def test_the_terminal_says_what_the_page_says(place: Path) -> None:
    done = armcal("study", str(_write(place, SMALL)), "--out", str(place / "out"), "--set", FAST[0])
    told = json.loads((place / "out" / "study.json").read_text())
    for variant in told["variants"]:
        assert variant["name"] in done.output
        assert f"{variant['error_mm']['cross_validated']['mean']:.3f}" in done.output
    assert "Lowest cross-validated error: lengths" in done.output and "records that judge it" in done.output
    quiet = armcal("study", str(_write(place, SMALL)), "--out", str(place / "q"), "-q", "--set", FAST[0])
    assert (quiet.exit_code, quiet.stdout) == (0, "")


@pytest.mark.slow
def test_the_five_options_give_the_published_figures(shared_data: Path, tmp_path: Path) -> None:
    data = str(shared_data / "lrm_arm" / "poses.csv")
    done = armcal("study", str(CONFIGS / "study_options.yaml"), "--data", data, "--out", str(tmp_path / "o"), "--json")
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    crossed = [round(v["error_mm"]["cross_validated"]["mean"], 2) for v in told["variants"]]
    assert crossed == [6.07, 15.53, 16.57, 6.81, 16.86]
    assert round(told["variants"][0]["error_mm"]["train"]["mean"], 3) == 5.886
    assert [v["free"] for v in told["variants"]] == [28, 20, 7, 27, 6]
    assert told["lowest"] == told["simplest_within_one_standard_error"] == "option1"


@pytest.mark.slow
def test_what_a_drift_adds_is_told_apart_from_the_arm(place: Path) -> None:
    """Judged with the drift that training neighbours tell of, and without."""
    drifting = "drift: {extends: angles, set: {parameters.drift: {arm.mdh.theta1: {sd: 1 deg, over: 10}}}}"
    result = _run(_write(place, SMALL.replace("lengths: {", f"{drifting}\n    lengths: {{")), *ORDERED)
    angles, drift = result.variant("angles"), result.variant("drift")
    assert angles.at_rest.mean == pytest.approx(angles.crossed.mean, rel=1e-9)
    assert abs(drift.at_rest.mean - drift.crossed.mean) > 1e-4 and drift.free == 3
    told = [text for text in conclusions(result) if "drift at a record" in text]
    assert len(told) == 1 and told[0].startswith("drift knows") and f"{drift.at_rest.mean:.3f} mm" in told[0]
    assert drift.crossed.mean == pytest.approx(np.mean(drift.errors_mm))
