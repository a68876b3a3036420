"""Areas, sag and the score against closed forms, finite differences and other code; the command as a user meets it."""

from __future__ import annotations

import csv
import json
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.dataset import Dataset
from armcal.base.settings import Settings
from armcal.cli.main import cli
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, ProblemError
from armcal.measure.measurement import ArmsAlone
from armcal.plugins import discover
from armcal.problem.problem import Problem
from armcal_capability.capability import (
    ORIENTATIONS,
    AreaSearch,
    AreaSettings,
    CapabilitySettings,
    Corrections,
    Design,
    LoadSettings,
    MechanicsFunction,
    Pointing,
    Task,
    ToolDirectionSettings,
    cells_of,
    load_task,
    quantities,
    reach_for,
    solvers_of,
    spread,
    summaries,
    survey,
)
from click.testing import CliRunner, Result

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
QUICK = ("--set", "capability.samples=80", "--set", "capability.voxel_mm=120")
TWO = ("--set", 'capability.designs={"60 deg, as built": {}, 45 deg: {set: {arms.arm.model.base.4.ry_deg: 45}}}')
LINKS = (0.3, 0.25)
PLANAR = """
arms:
  arm:
    model:
      type: mdh
      convention: standard
      base: [{{x_mm: {x}}}, {{z_mm: {z}}}]
      rows:
        - {{alpha_deg: 0, a_mm: 300, theta_deg: 0, d_mm: 0}}
        - {{alpha_deg: 0, a_mm: 250, theta_deg: 0, d_mm: 0}}
      tool: [{{z_mm: 0}}]
statics: {{gravity_m_s2: [0, 0, -9.81], payload_g: 0}}
measurements: {{tracker: {{type: tip_position, noise_mm: 0.5}}}}
plan: {{limits: {{q1: [-180 deg, 180 deg], q2: [-180 deg, 180 deg]}}}}
"""
AREAS = "capability: {areas: {all: {low_mm: [-600, -600, 0], high_mm: [600, 600, 0]}}}\n"
BEAM = """
arms:
  arm:
    model:
      type: mdh
      convention: standard
      base: [{rx_deg: 90}]
      rows: [{alpha_deg: 0, a_mm: 400, theta_deg: 0, d_mm: 0}]
      tool: [{z_mm: 0}]
    effects: {spring: {type: torsional_spring}}
    links: {rod: {mass_g: 200, com_mm: [-200, 0, 0], frame: tool}}
statics: {gravity_m_s2: [0, 0, -10], payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.5}}
plan: {limits: {q1: [-90 deg, 90 deg]}}
capability: {values: k.yaml, areas: {all: {low_mm: [300, 0, -50], high_mm: [400, 0, 50]}}}
"""


def task_of(path: Path, *overrides: str) -> Task:
    return load_task(path, None, overrides, discover())


def only(task: Task) -> Design:
    (design,) = task.designs.values()
    return design


def planar(folder: Path, x: float = 0.0, z: float = 0.0) -> Design:
    path = folder / "planar.yaml"
    path.write_text(PLANAR.format(x=x, z=z) + AREAS, encoding="utf-8")
    return only(task_of(path))


def beam(folder: Path, spring: str, limit: str = "90 deg") -> Design:
    (folder / "k.yaml").write_text(f"arm.spring.k1: {spring}\n", encoding="utf-8")
    (folder / "beam.yaml").write_text(BEAM.replace("90 deg", limit), encoding="utf-8")
    return only(task_of(folder / "beam.yaml"))


def mechanics(design: Design, load: LoadSettings | None = None) -> MechanicsFunction:
    return MechanicsFunction(design.expression, load or LoadSettings(), "interpreted")


@pytest.fixture(scope="module")
def lrm() -> Task:
    return task_of(CONFIGS / "designs.yaml", "capability.samples=3000")


@pytest.fixture(scope="module")
def built(lrm: Task) -> Design:
    return lrm.designs["60 deg, as built"]


def test_two_links_reach_exactly_the_annulus_with_their_axis_along_one_of_six_directions(tmp_path: Path) -> None:
    settings = CapabilitySettings.si(
        samples=2000, voxel=0.05, areas={"all": {"low": (-0.6, -0.6, 0.0), "high": (0.6, 0.6, 0.0)}}
    )
    found = survey(planar(tmp_path), settings)
    area = found.areas["all"]
    radius = np.linalg.norm(area.centres[:, :2], axis=1)
    inner, outer = LINKS[0] - LINKS[1], sum(LINKS)
    clear_of_the_rim = np.minimum(abs(radius - inner), abs(radius - outer)) > 1e-4
    expected = (radius > inner) & (radius < outer)
    assert np.array_equal(area.reached[clear_of_the_rim], expected[clear_of_the_rim])
    assert area.reached.sum() * 0.05**2 == pytest.approx(np.pi * (outer**2 - inner**2), rel=0.03)
    assert np.array_equal(area.orientations, area.reached), "the tool's z axis is always that of the base"
    assert found.drawn == found.clear == found.settled == 2000


def test_a_beam_gives_its_compliance_times_the_square_of_its_lever(tmp_path: Path) -> None:
    function = mechanics(beam(tmp_path, "0.05 rad/Nm"), LoadSettings.si(payload=0.1, payload_com=(0.0, 0.0, 0.0)))
    there = function(np.zeros((1, 1)))
    found = quantities(function, np.zeros((1, 1)), there, np.array([1.6]))
    # Weight 2 N at 0.2 m, payload 1 N at 0.4 m, in a beam that is nearly level: cosines within 1e-3.
    assert found["sag_mm"][0] == pytest.approx(1000 * 0.4 * 0.05 * 2 * 0.2, rel=2e-3)
    assert found["deflection_mm"][0] == pytest.approx(1000 * 0.4 * 0.05 * 1 * 0.4, rel=5e-3)
    assert found["effort_ratio"][0] == pytest.approx(0.8 / 1.6, rel=2e-3)


def test_an_area_is_held_where_one_posture_needs_no_more_than_servos_hold(tmp_path: Path) -> None:
    design, size = beam(tmp_path, "0.0 rad/Nm"), 0.02
    area = {"low": (0.0, -0.01, -0.4), "high": (0.4, 0.01, 0.4)}
    settings = CapabilitySettings.si(samples=500, voxel=size, areas={"all": area}, holding={"q1": 0.2})
    area = AreaSettings.si(low=(0.2, 0.0, np.sqrt(0.12)), high=(0.2, 0.0, np.sqrt(0.12)))
    light = AreaSearch(design, replace_settings(settings, holding={"q1": 0.201}))(area)
    heavy = AreaSearch(design, replace_settings(settings, holding={"q1": 0.199}))(area)
    # The rod's 2 N at half of its lever of 0.2 m are 0.2 N m.
    assert light.reached.all() and heavy.reached.all()
    assert light.held is not None and light.held.all() and heavy.held is not None and not heavy.held.any()


def replace_settings(settings: CapabilitySettings, **changes: object) -> CapabilitySettings:
    return settings.model_copy(update=changes)


def predicted(commands: np.ndarray, loads: dict[str, float]) -> np.ndarray:
    """Tool poses (N x 4 x 4) of the LRM arm by the code that fits, which shares no slopes with the survey."""
    registry, source = discover(), load_config(CONFIGS / "designs.yaml")
    system = build_system(source, registry)
    found = Corrections.read(CONFIGS / "truth.yaml", load_config(CONFIGS / "arm.yaml"), registry)
    parameters, count = found.applied(system.parameters()).with_free(()), commands.shape[1]
    channels = {f"arm.q{i + 1}": row for i, row in enumerate(commands)}
    channels |= {name: np.full(count, value) for name, value in loads.items()}
    dataset = Dataset(tuple(map(str, range(count))), channels)
    alone = {"pose": ArmsAlone(("arm",))}
    problem = Problem.build(system.arms, alone, parameters, system.environment, dataset, "interpreted", groups={})
    return problem.of(dataset).predict(parameters.nominal())[0].tools[0].transpose(2, 1, 0)


@pytest.mark.slow
def test_positions_sag_and_deflection_are_those_of_the_fitted_model(built: Design) -> None:
    commands = spread(built.limits, 12, 5)
    function = mechanics(built, LoadSettings.si(payload=0.13, payload_com=(0.0, 0.0, 0.02), force=(0.5, -0.2, 0.1)))
    there = function(commands)
    found = quantities(function, commands, there, np.full(6, np.inf))
    payload = {"payload": 0.13, "payload_x": 0.0, "payload_y": 0.0, "payload_z": 0.02}
    force = {"force_x": 0.5, "force_y": -0.2, "force_z": 0.1}
    loaded = predicted(commands, {**payload, **force})[:, :, 3]
    own = predicted(commands, {"payload": 0.0})[:, :, 3]
    free = predicted(commands, {f"gravity_{axis}": 0.0 for axis in "xyz"} | {"payload": 0.0})[:, :, 3]
    assert np.allclose(there.positions.T, loaded, atol=1e-10)
    assert np.allclose(found["sag_mm"], 1000 * np.linalg.norm(own - free, axis=1), atol=1e-7)
    assert np.allclose(found["deflection_mm"], 1000 * np.linalg.norm(loaded - own, axis=1), atol=1e-7)


@pytest.mark.slow
def test_compiled_and_interpreted_give_the_same(lrm: Task, built: Design) -> None:
    commands, found = spread(built.limits, 21, 2), []
    for choice in ("interpreted", "compiled"):
        function = MechanicsFunction(built.expression, lrm.settings.loads, choice)
        there = function(commands)
        found.append({**quantities(function, commands, there, np.ones(6)), "positions": there.positions})
    for name, values in found[0].items():
        assert np.allclose(values, found[1][name], rtol=1e-6, atol=1e-9), name


def test_the_same_seed_gives_the_same_and_another_seed_another(tmp_path: Path) -> None:
    limits = planar(tmp_path).limits
    one, again, other = (spread(limits, 100, seed) for seed in (0, 0, 1))
    assert np.array_equal(one, again) and not np.allclose(one, other)
    assert np.array_equal(spread(limits, 300, 0)[:, :100], one)
    assert (one >= limits[:, :1]).all() and (one <= limits[:, 1:]).all()


def test_where_the_base_stands_does_not_matter(tmp_path: Path) -> None:
    found = []
    for x, z in ((0, 0), (2000, -1000)):
        low, high = np.add([(-0.6, -0.6, 0), (0.6, 0.6, 0)], (x / 1000, 0, z / 1000)).tolist()
        settings = CapabilitySettings.si(samples=500, voxel=0.1, areas={"all": {"low": low, "high": high}})
        found.append(survey(planar(tmp_path, x, z), settings).areas["all"])
    assert np.array_equal(found[0].reached, found[1].reached)
    assert np.array_equal(found[0].orientations, found[1].orientations)


def test_cells_fill_an_area_evenly() -> None:
    centres = cells_of(AreaSettings.si(low=(0.0, 0.0, 0.1), high=(0.1, 0.05, 0.1)), 0.03)
    assert len(centres) == 4 * 2 * 1
    assert np.allclose(centres.min(axis=0), (0.0125, 0.0125, 0.1)) and np.allclose(
        centres.max(axis=0)[:2], (0.0875, 0.0375)
    )


@pytest.mark.slow
def test_areas_hold_every_sampled_posture_and_keep_limits_and_direction(lrm: Task, built: Design) -> None:
    """What plain sampling finds, the search must find, within limits and with the tool pointing as asked."""
    tool, size = {"axis": "z", "along": (0.0, 0.0, -1.0), "within": 0.7}, 0.05
    area = AreaSettings.si(low=(0.2, -0.15, 0.0), high=(0.4, 0.15, 0.1), tool=tool)
    settings = CapabilitySettings.si(samples=20_000, voxel=size, postures=8, areas={"all": area})
    search = AreaSearch(built, settings, "interpreted")
    sampled = mechanics(built)(spread(built.limits, 20_000, 0))
    pointing = Pointing.of(ToolDirectionSettings.si(**tool))
    positions = sampled.positions.T
    inside = np.all((positions >= area.low) & (positions <= area.high), axis=1)
    inside &= pointing.angles(sampled.rotations) <= 0.7
    hit = {tuple(p) for p in np.floor((positions[inside] - area.low) / size).astype(int)}
    found = search(area)
    places = [tuple(p) for p in np.floor((found.centres - area.low) / size).astype(int)]
    reached = dict(zip(places, found.reached, strict=True))
    assert len(hit) > 20
    missed = [place for place in hit if not reached[place]]  # a corner of a cell may be reached and its centre not
    assert len(missed) <= 0.1 * len(hit)


@pytest.mark.slow
def test_orientations_are_areas_reached_with_the_tool_along_each_of_six_directions(lrm: Task, built: Design) -> None:
    box = {"low": (0.2, -0.15, 0.0), "high": (0.4, 0.15, 0.2)}
    settings = CapabilitySettings.si(samples=3000, voxel=0.05, postures=12, areas={"all": box})
    search = AreaSearch(built, settings, "interpreted")
    each = [
        search(AreaSettings.si(**box, tool={"along": tuple(along), "within": settings.orientation_within})).reached
        for along in ORIENTATIONS
    ]
    assert np.array_equal(search(AreaSettings.si(**box)).orientations, np.sum(each, axis=0))
    assert 0 < np.sum(each) < np.size(each)


@pytest.mark.slow
def test_found_postures_are_where_and_how_they_should_be(built: Design) -> None:
    function, limits = mechanics(built), built.limits
    targets = np.array([[0.3, 0.0, 0.05], [0.32, 0.1, 0.1], [2.0, 0.0, 0.0]]).T
    pointing = Pointing(2, np.array([0.0, 0.0, -1.0]), 0.6)
    starts, which = spread(limits, 600, 0), np.arange(600) % 3
    solvers = solvers_of(built, "interpreted")
    commands, arrived = reach_for(solvers, function.records(starts), targets[:, which], pointing)
    assert not arrived[which == 2].any() and arrived[which < 2].mean() > 0.2
    there = function(commands[:, arrived])
    assert np.allclose(there.positions, targets[:, which[arrived]], atol=1.1e-5)
    assert pointing.angles(there.rotations).max() <= 0.6
    assert (commands >= limits[:, :1]).all() and (commands <= limits[:, 1:]).all()


@pytest.mark.slow
def test_clearance_takes_postures_away() -> None:
    area = {"low": (0.2, -0.1, 0.1), "high": (0.3, 0.1, 0.2)}
    settings = CapabilitySettings.si(samples=2000, voxel=0.05, areas={"all": area})
    design = only(task_of(CONFIGS / "capability.yaml"))
    found = survey(design, settings)
    assert 0 < found.drawn - found.clear < 200
    assert survey(replace(design, clearance=None), settings).clear == 2000


@pytest.mark.slow
def test_a_design_keeps_what_was_found_and_changes_what_it_says(lrm: Task) -> None:
    commands, at = np.zeros((6, 1)), {}
    for name in ("60 deg, as built", "upper arm + 1 cm", "45 deg"):
        at[name] = mechanics(lrm.designs[name]).place(commands, LOAD_CHANNELS).ravel()
    built, longer, flatter = at.values()
    along = np.array([np.sin(np.pi / 3), 0, np.cos(np.pi / 3)])
    # The upper arm lies nearly along the mount's axis at zero angles; 1 cm more moves the tool 1 cm that way.
    assert np.allclose(longer - built, 0.01 * along, atol=6e-4)
    mount, turn = np.array([-0.034975, 0, 0.23608]), np.deg2rad(-15)
    about_y = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    # What the bench found of the base stays in the base's axes: a few millimetres do not turn with it.
    assert np.allclose(flatter - mount, about_y @ (built - mount), atol=2e-3)


def test_corrections_are_those_of_the_arm_that_the_values_belong_to(built: Design) -> None:
    """Else the rover's arm would stand where the bench's did, 80 mm away."""
    arm = built.expression
    mount = ca.Function("mount", [arm.record, arm.state], [arm.origins[0]])
    place = mount(arm.records(np.zeros((6, 1))), np.zeros(arm.state.numel())).full().ravel()
    assert place == pytest.approx([-0.034975, 0, 0.23608], abs=0.02)


def test_designs_are_compared_where_all_of_them_reach(tmp_path: Path) -> None:
    settings = CapabilitySettings.si(
        samples=500, voxel=0.1, areas={"all": {"low": (-0.8, -0.8, 0.0), "high": (0.8, 0.8, 0.0)}}
    )
    found = {"here": survey(planar(tmp_path), settings), "away": survey(planar(tmp_path, 300), settings)}
    told = summaries(found)
    both = np.sum(found["here"].areas["all"].reached & found["away"].areas["all"].reached)
    assert told["here"]["areas"]["all"]["cells_compared"] == told["away"]["areas"]["all"]["cells_compared"] == both
    for name, own in found.items():
        assert told[name]["areas"]["all"]["reached"] == pytest.approx(own.areas["all"].reached.mean())
        assert told[name]["score"] == own.areas["all"].orientations.sum()


def test_a_design_that_sets_nothing_of_the_arm_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.yaml"
    text = PLANAR.format(x=0, z=0) + AREAS.replace("}}}\n", "}}, designs: {a: {set: {arm.model.rows.0.a_mm: 5}}}}\n")
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match="design 'a': found 'arm', expected the dotted name of a value of the arm"):
        task_of(path)
    path.write_text(text.replace("arm.model.rows.0", "arms.arm.model.rows.7"), encoding="utf-8")
    with pytest.raises(ConfigError, match="index '7'"):
        task_of(path)
    path.write_text(text.replace("set: {arm.model.rows.0.a_mm: 5}", "arms.arm.model.rows.0.a_mm: 5"), encoding="utf-8")
    with pytest.raises(ConfigError, match="expected extends, set or add"):
        task_of(path)


def test_a_load_that_nothing_holds_leaves_no_posture(tmp_path: Path) -> None:
    box = {"low": (0.3, 0.0, 0.0), "high": (0.4, 0.0, 0.0)}
    settings = CapabilitySettings.si(samples=16, loads={"payload": 50.0}, areas={"a": box})
    with pytest.raises(ProblemError, match="no posture has an elastic equilibrium"):
        survey(beam(tmp_path, "50 rad/Nm", "20 deg"), settings)


def test_settings_come_back_from_their_own_config() -> None:
    settings = CapabilitySettings.si(
        samples=100, areas={"a": {"low": (0, 0, 0), "high": (1, 1, 1)}}, holding={"q1": 0.3}, loads={"payload": 0.1}
    )
    again = CapabilitySettings.model_validate(settings.to_config())
    assert again == settings and isinstance(again, Settings)


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


@pytest.mark.slow
def test_every_design_has_its_areas_and_its_score(tmp_path: Path) -> None:
    _, told = study(tmp_path / "out")
    assert next(iter(told["designs"])) == "60 deg, as built" and len(told["designs"]) == 7
    for design in told["designs"].values():
        assert list(design["areas"]) == ["basket", "ground"]
        assert design["score"] == sum(area["orientations"] for area in design["areas"].values())
        assert design["most"] == 6 * sum(area["cells"] for area in design["areas"].values())
        for area in design["areas"].values():
            assert 0 <= area["held"] <= area["reached"] <= 1 and area["quantities"]["sag_mm"]["mean"] > 5


@pytest.mark.slow
def test_by_the_score_the_choice_of_the_arms_authors_is_the_best_of_the_designs(tmp_path: Path) -> None:
    more = ("--set", "capability.samples=5000", "--set", "capability.voxel_mm=40", "--set", "capability.postures=8")
    _, told = study(tmp_path / "out", *more)
    scores = {name: design["score"] for name, design in told["designs"].items()}
    assert max(scores, key=lambda name: scores[name]) == "60 deg, + 1 and + 2 cm"
    assert min(scores, key=lambda name: scores[name]) == "45 deg"


@pytest.mark.slow
def test_areas_csv_has_each_cell(studied: tuple[Path, dict]) -> None:
    out, told = studied
    rows = list(csv.DictReader((out / "areas.csv").open()))
    for design, each in told["designs"].items():
        for name, area in each["areas"].items():
            own = [r for r in rows if (r["design"], r["area"]) == (design, name)]
            assert len(own) == area["cells"]
            assert np.mean([int(r["postures"]) > 0 for r in own]) == pytest.approx(area["reached"])
            assert sum(int(r["orientations"]) for r in own) == area["orientations"]
            assert all((r["sag_mm"] == "") == (int(r["postures"]) == 0) for r in own)


@pytest.mark.slow
def test_a_second_study_keeps_the_first_and_gives_the_same(tmp_path: Path) -> None:
    out = tmp_path / "out"
    for _ in range(2):
        done = armcal("capability", CONFIGS / "capability.yaml", "--out", out, "-q", *QUICK)
        assert done.exit_code == 0, done.output
    assert (out / "earlier" / "1" / "areas.csv").read_text() == (out / "areas.csv").read_text()


@pytest.mark.slow
def test_a_calibration_brings_its_springs_and_corrects_designs(demo_calibration: Path, tmp_path: Path) -> None:
    for name, only_one in (("alone", ()), ("designs", ("--set", "capability.designs={one: {}}"))):
        rules = CONFIGS / "designs.yaml" if name == "designs" else CONFIGS / "capability.yaml"
        arguments = ("--settings", rules, "--out", tmp_path / name, "--json", *QUICK, *only_one)
        done = armcal("capability", demo_calibration, *arguments)
        assert done.exit_code == 0, done.output
        (design,) = json.loads(done.stdout)["designs"].values()
        assert max(area["quantities"]["sag_mm"]["mean"] or 0 for area in design["areas"].values()) > 5


def test_a_calibration_without_areas_or_limits_says_how_to_give_them(demo_calibration: Path, tmp_path: Path) -> None:
    refused(tmp_path, demo_calibration, says=("found no areas", "--settings FILE"))
    area = "capability.areas={a: {low_mm: [0, 0, 0], high_mm: [100, 100, 100]}}"
    refused(tmp_path, demo_calibration, "--set", area, says=("no limits for q1", "--settings FILE"))


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
    "capability.designs={a: {set: {arms.arm.model.base.4.ry_degree: 45}}}-says15",
    "capability.voxel=5-says8",
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
        ("capability.voxel=5", ("voxel",)),
        ("capability.loads={payload_g: -1}", ("capability.loads.payload_g", "greater than or equal to 0")),
        ("capability.areas={a: {low_mm: [1, 0, 0], high_mm: [0, 0, 0]}}", ("low lies beyond high",)),
        ("capability.areas={a: {low_mm: [0, 0], high_mm: [0, 0, 0]}}", ("capability.areas.a.low",)),
        ("capability.basket=1", ("unknown key 'basket'",)),
        ("capability.values=nowhere.yaml", ("there is no such file",)),
        ("plan.limits={q9: [0 deg, 1 deg]}", ("no turning joint is called 'q9'",)),
        ("capability.designs={a: {set: {arms.arm.model.base.4.ry_degree: 45}}}", ("design 'a'", "ry_degree")),
        ("capability.designs={a: 3}", ("capability.designs.a", "expected keys and values")),
        ("capability.areas=null", ("found no areas", "low_mm")),
    ],
)
def test_bad_settings_are_refused_in_words(tmp_path: Path, setting: str, says: tuple[str, ...]) -> None:
    refused(tmp_path, CONFIGS / "designs.yaml", *QUICK, "--set", setting, says=says)


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
    (tmp_path / "else.yaml").write_text("name: x\n" + AREAS, encoding="utf-8")
    refused(tmp_path, tmp_path / "else.yaml", says=("arms",))
    refused(tmp_path, CONFIGS / "plan.yaml", "--settings", tmp_path / "none.yaml", says=("there is no such file",))


def test_a_place_that_is_not_ours_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "mine.txt").write_text("mine", encoding="utf-8")
    done = armcal("capability", CONFIGS / "designs.yaml", "--out", tmp_path, *QUICK)
    assert done.exit_code == 2 and "mine.txt" in done.output
    done = armcal("capability", CONFIGS / "designs.yaml", "--out", tmp_path / "mine.txt", *QUICK)
    assert done.exit_code == 2 and "it is a file" in done.output


def test_two_arms_are_refused(tmp_path: Path) -> None:
    two = next(path for path in sorted(CONFIGS.parent.rglob("*.yaml")) if path.parent.name == "frida")
    area = "capability.areas={a: {low_mm: [0, 0, 0], high_mm: [100, 100, 100]}}"
    done = armcal("capability", two, "--out", tmp_path / "o", "--set", area)
    assert done.exit_code == 2 and "Traceback" not in done.output
