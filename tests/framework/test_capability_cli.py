"""``armcal capability`` as a user meets it: what it leaves behind, and what it says to bad input."""

from __future__ import annotations

import csv
import json
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from click.testing import CliRunner, Result

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
QUICK = ("--set", "capability.samples=80", "--set", "capability.voxel_mm=120")
TWO = ("--set", 'capability.designs={"60 deg, as built": {}, 45 deg: {arms.arm.model.base.4.ry_deg: 45}}')


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(each) for each in arguments])


def study(out: Path, *more: str) -> tuple[Path, dict]:
    done = armcal("capability", CONFIGS / "designs.yaml", "--out", out, "--json", *QUICK, *more)
    assert done.exit_code == 0, done.output
    return out, json.loads(done.stdout)


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict]:
    """Two of the shipped designs."""
    return study(tmp_path_factory.mktemp("capability") / "out", *TWO)


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    return demo_calibration


@pytest.mark.slow
def test_every_design_is_told_in_every_area(tmp_path: Path) -> None:
    out, told = study(tmp_path / "out")
    assert next(iter(told["designs"])) == "60 deg, as built" and len(told["designs"]) == 6
    rows = list(csv.DictReader((out / "designs.csv").open()))
    assert [(r["design"], r["area"]) for r in rows] == [(d, a) for d in told["designs"] for a in ("basket", "ground")]
    for row in rows:
        area = told["designs"][row["design"]]["areas"][row["area"]]
        assert float(row["reached"]) == pytest.approx(area["reached"], rel=1e-5)
        assert 0 <= area["held"] <= area["reached"] <= 1
        assert float(row["sag_mm_mean"]) == pytest.approx(area["quantities"]["sag_mm"]["mean"], rel=1e-5)


def test_the_map_has_a_unit_in_every_name_and_is_the_same_in_both_forms(studied: tuple[Path, dict]) -> None:
    out, told = studied
    columns = np.load(out / "map.npz")
    rows = list(csv.reader((out / "map.csv").open()))
    assert rows[0] == list(columns) and rows[0][:4] == ["x_mm", "y_mm", "z_mm", "postures"]
    assert len(rows) - 1 == told["reach"]["cells"] and columns["postures"].sum() == told["postures"]["mapped"]
    for place, name in enumerate(rows[0]):
        assert np.allclose([float(row[place]) for row in rows[1:]], columns[name], rtol=1e-5)
    assert (columns["sag_mm_best"] <= columns["sag_mm_mean"] + 1e-12).all()
    assert (columns["manipulability_best"] >= columns["manipulability_worst"]).all()


def test_the_page_is_complete_in_itself_and_shows_every_figure(studied: tuple[Path, dict]) -> None:
    out, _ = studied
    page = (out / "capability.html").read_text(encoding="utf-8")
    assert "60 deg, as built" in page and "http" not in page.replace("http-equiv", "")
    pictures = {path.stem for path in out.glob("*.png")}
    assert {"reach", "designs", "sag_mm", "give_mm_per_N", "effort_ratio"} <= pictures
    assert page.count("data:image/png;base64,") == len(pictures)
    for path in out.glob("*.png"):
        assert path.read_bytes()[:4] == b"\x89PNG" and path.stat().st_size > 10_000


def test_areas_csv_tells_each_cell(studied: tuple[Path, dict]) -> None:
    out, told = studied
    rows = list(csv.DictReader((out / "areas.csv").open()))
    for design, each in told["designs"].items():
        for name, area in each["areas"].items():
            own = [r for r in rows if (r["design"], r["area"]) == (design, name)]
            assert len(own) == area["cells"]
            assert np.mean([float(r["postures"]) > 0 for r in own]) == pytest.approx(area["reached"])
            assert all((r["sag_mm_mean"] == "") == (float(r["postures"]) == 0) for r in own)


@pytest.mark.slow
def test_a_second_study_keeps_the_first_and_gives_the_same(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for _ in range(2):
        done = armcal("capability", CONFIGS / "plan.yaml", "--out", out, "-q", *QUICK)
        assert done.exit_code == 0, done.output
    assert (out / "earlier" / "1" / "map.csv").read_text() == (out / "map.csv").read_text()


@pytest.mark.slow
def test_a_calibration_is_surveyed_with_its_accuracy(calibration: Path, tmp_path: Path) -> None:
    rules = CONFIGS / "capability.yaml"
    done = armcal("capability", calibration, "--settings", rules, "--out", tmp_path / "o", "--json", *QUICK)
    assert done.exit_code == 0, done.output
    cells = json.loads(done.stdout)["cells"]
    assert 0.05 < cells["known_to_mm"]["mean"] < cells["expected_mm"]["mean"] < cells["nominal_mm"]["mean"]
    assert cells["quantisation_mm"]["mean"] > 0.3
    assert "Expected error" in (tmp_path / "o" / "capability.html").read_text(encoding="utf-8")


@pytest.mark.slow
def test_a_calibration_corrects_designs(calibration: Path, tmp_path: Path) -> None:
    only = (
        "--set",
        "capability.designs={45 deg: {arms.arm.model.base.4.ry_deg: 45}}",
        "--set",
        "capability.areas=null",
    )
    rules = CONFIGS / "designs.yaml"
    done = armcal("capability", calibration, "--settings", rules, "--out", tmp_path / "o", "--json", *QUICK, *only)
    assert done.exit_code == 0, done.output
    told = json.loads(done.stdout)
    assert told["designs"]["45 deg"]["cells"]["sag_mm"]["mean"] > 5  # springs came with the calibration


def test_a_calibration_without_limits_says_how_to_give_them(calibration: Path, tmp_path: Path) -> None:
    refused(tmp_path, calibration, says=("no limits for q1", "--settings FILE"))


def refused(folder: Path, source: object, *arguments: object, says: tuple[str, ...]) -> None:
    done = armcal("capability", source, "--out", folder / "refused", *arguments)
    assert done.exit_code == 2, done.output
    assert done.output.startswith("armcal: ") and "Traceback" not in done.output
    for text in says:
        assert text in done.output, done.output
    assert not (folder / "refused").exists()


@pytest.mark.quick(
    "capability.basket=1-says12",
    "capability.designs={a: 3}-says16",
    "capability.designs={a: {arms.arm.model.base.4.ry_degree: 45}}-says15",
    "capability.length=5-says8",
    "capability.samples=many-says3",
)
@pytest.mark.parametrize(
    ("setting", "says"),
    [
        ("capability.voxel_mm=0", ("capability.voxel", "greater than 0")),
        ("capability.voxel_mm=.nan", ("capability.voxel",)),
        ("capability.voxel_mm=0.1", ("the area basket would have 1.15e+09 cells", "capability.voxel_mm larger")),
        ("capability.samples=many", ("capability.samples", "whole number")),
        ("capability.samples=1", ("capability.samples",)),
        ("capability.holding_Nm={q9: 1}", ("no joint is called 'q9'", "q1, q2")),
        ("capability.holding_Nm={q4: 0}", ("capability.holding_Nm.q4", "greater than 0")),
        ("capability.holding={q4: 1}", ("both holding_Nm and holding",)),
        ("capability.length=5", ("unit missing",)),
        ("capability.loads={payload_g: -1}", ("capability.loads.payload_g", "greater than or equal to 0")),
        ("capability.areas={a: {low_mm: [1, 0, 0], high_mm: [0, 0, 0]}}", ("low lies beyond high",)),
        ("capability.areas={a: {low_mm: [0, 0], high_mm: [0, 0, 0]}}", ("capability.areas.a.low",)),
        ("capability.basket=1", ("unknown key 'basket'",)),
        ("capability.values=nowhere.yaml", ("there is no such file",)),
        ("plan.limits={q9: [0 deg, 1 deg]}", ("no turning joint is called 'q9'",)),
        ("capability.designs={a: {arms.arm.model.base.4.ry_degree: 45}}", ("design 'a'", "ry_degree")),
        ("capability.designs={a: 3}", ("capability.designs.a", "expected keys and values")),
    ],
)
def test_bad_settings_are_refused_in_words(tmp_path: Path, setting: str, says: tuple[str, ...]) -> None:
    refused(tmp_path, CONFIGS / "designs.yaml", *QUICK, "--set", setting, says=says)


def test_a_map_of_too_many_cells_is_refused_before_it_fills_the_memory(tmp_path: Path) -> None:
    says = ("cells from side to side, expected 2000 at most", "Make capability.voxel_mm 0.")
    refused(tmp_path, CONFIGS / "plan.yaml", *QUICK, "--set", "capability.voxel_mm=0.01", says=says)


@pytest.mark.parametrize("fault", [ModuleNotFoundError("No module", name="matplotlib"), ImportError("libfreetype")])
def test_a_missing_or_broken_library_is_told_before_the_survey(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, fault: ImportError
) -> None:
    def failing(name: str) -> None:
        assert name == "matplotlib"
        raise fault

    monkeypatch.setattr("armcal_capability.command.import_module", failing)
    monkeypatch.setattr("armcal_capability.command.survey", lambda *_: pytest.fail("it surveyed first"))
    done = armcal("capability", CONFIGS / "plan.yaml", "--out", tmp_path / "out", *QUICK)
    assert done.exit_code in (1, 2) and isinstance(done.exception, SystemExit)
    assert "Traceback" not in done.output
    if isinstance(fault, ModuleNotFoundError):
        assert "armcal capability needs the library matplotlib" in done.output and "'armcal[figures]'" in done.output
    else:
        assert "cannot be loaded (libfreetype)" in done.output and "armcal doctor" in done.output


@pytest.mark.slow
def test_bad_files_are_refused_in_words(tmp_path: Path) -> None:
    refused(tmp_path, tmp_path / "none.yaml", says=("there is no such file",))
    refused(tmp_path, tmp_path, says=("it is a directory",))
    (tmp_path / "empty.yaml").write_text("", encoding="utf-8")
    refused(tmp_path, tmp_path / "empty.yaml", says=("the file is empty",))
    (tmp_path / "latin.yaml").write_bytes("name: Gerät\n".encode("latin-1"))
    refused(tmp_path, tmp_path / "latin.yaml", says=("is not UTF-8",))
    (tmp_path / "list.yaml").write_text("[1, 2]\n", encoding="utf-8")
    refused(tmp_path, tmp_path / "list.yaml", says=("found a list at the top",))
    (tmp_path / "else.yaml").write_text("name: x\n", encoding="utf-8")
    refused(tmp_path, tmp_path / "else.yaml", says=("arms",))
    refused(tmp_path, CONFIGS / "plan.yaml", "--settings", tmp_path / "none.yaml", says=("there is no such file",))


def test_a_place_that_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine", encoding="utf-8")
    done = armcal("capability", CONFIGS / "plan.yaml", "--out", tmp_path, *QUICK)
    assert done.exit_code == 2 and "mine.txt" in done.output
    done = armcal("capability", CONFIGS / "plan.yaml", "--out", tmp_path / "mine.txt", *QUICK)
    assert done.exit_code == 2 and "it is a file" in done.output


def test_two_arms_are_refused(tmp_path: Path) -> None:
    two = next(path for path in sorted(CONFIGS.parent.rglob("*.yaml")) if path.parent.name == "frida")
    done = armcal("capability", two, "--out", tmp_path / "o")
    assert done.exit_code == 2 and "Traceback" not in done.output
