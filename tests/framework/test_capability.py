"""Capability maps against closed forms, finite differences, other code's predictions, and what must not matter."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.arm.servo import PulseClock, PulseTable, quantised
from armcal.base.dataset import Dataset
from armcal.base.settings import Settings
from armcal.calibration.calibration import Calibration
from armcal.errors import ConfigError, ProblemError
from armcal.measure.contact import ArmsAlone
from armcal.problem.problem import Problem
from armcal_capability.accuracy import steps_at, with_accuracy
from armcal_capability.cells import AreaSearch, cells_of, grouped, voxels_of
from armcal_capability.inverse import Pointing
from armcal_capability.loading import Task, load_designs, load_task
from armcal_capability.mechanics import MechanicsFunction
from armcal_capability.quantities import Weights, dexterity, moves, postures_at, singular_values, weighted
from armcal_capability.settings import AreaSettings, CapabilitySettings, LoadSettings, ToolDirectionSettings
from armcal_capability.subject import Subject
from armcal_capability.summary import design_summaries
from armcal_capability.survey import Survey, outline, spread, survey

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
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
capability: {values: k.yaml}
"""


def planar(folder: Path, x: float = 0.0, z: float = 0.0) -> Subject:
    path = folder / "planar.yaml"
    path.write_text(PLANAR.format(x=x, z=z), encoding="utf-8")
    return load_task(path).subject


def weights(subject: Subject, length: float = 0.1) -> Weights:
    return Weights(subject.slides, length, subject.holding({}))


def mechanics(subject: Subject, load: LoadSettings | None = None) -> MechanicsFunction:
    return MechanicsFunction(subject.expression, load or LoadSettings(), "interpreted")


@pytest.fixture(scope="module")
def lrm() -> Task:
    return load_task(CONFIGS / "designs.yaml", overrides=["capability.samples=3000"])


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Calibration:
    return Calibration.load(demo_calibration)


def test_two_links_reach_exactly_the_annulus(tmp_path: Path) -> None:
    settings = CapabilitySettings.si(
        samples=2000, voxel=0.05, areas={"all": {"low": (-0.6, -0.6, 0.0), "high": (0.6, 0.6, 0.0)}}
    )
    area = survey(planar(tmp_path), settings).areas["all"]
    radius = np.linalg.norm(area.centres[:, :2], axis=1)
    inner, outer = LINKS[0] - LINKS[1], sum(LINKS)
    clear_of_the_rim = np.minimum(abs(radius - inner), abs(radius - outer)) > 1e-4
    expected = (radius > inner) & (radius < outer)
    assert np.array_equal(area.reached[clear_of_the_rim], expected[clear_of_the_rim])
    cell = 0.05**2
    assert area.reached.sum() * cell == pytest.approx(np.pi * (outer**2 - inner**2), rel=0.03)


def test_the_map_of_two_links_covers_the_annulus(tmp_path: Path) -> None:
    found = survey(planar(tmp_path), CapabilitySettings.si(samples=20_000 - 1, voxel=0.02))
    centres = np.linalg.norm(found.voxels.centres[:, :2], axis=1)
    assert centres.max() < sum(LINKS) + 0.015 and centres.min() > LINKS[0] - LINKS[1] - 0.015
    area = np.pi * (sum(LINKS) ** 2 - (LINKS[0] - LINKS[1]) ** 2)
    assert len(centres) * 0.02**2 == pytest.approx(area, rel=0.05)
    assert found.voxels.counts.sum() == len(found.postures) == 19_999


def test_manipulability_of_two_links_is_the_textbook_one(tmp_path: Path) -> None:
    subject = planar(tmp_path)
    angles = np.random.default_rng(1).uniform(-3, 3, (2, 50))
    found = postures_at(mechanics(subject), angles, weights(subject))
    expected = LINKS[0] * LINKS[1] * np.abs(np.sin(angles[1]))
    assert np.allclose(found.values["manipulability"], expected, rtol=0, atol=1e-9)
    # A planar arm moves its tool in two directions; a measure of three would be zero everywhere.
    assert found.values["smallest_mm_per_rad"].min() > 0


@pytest.mark.slow
def test_pose_measures_are_those_of_the_weighted_jacobian(lrm: Task) -> None:
    subject, length = lrm.subject, 0.07
    commands = spread(subject.limits, 40, 3)
    function = mechanics(subject)
    found = postures_at(function, commands, weights(subject, length))
    scaled = function(commands).slopes * np.array([1, 1, 1, length, length, length])[:, None]
    for prefix, rows in (("", slice(0, 3)), ("pose_", slice(0, 6))):
        values = np.linalg.svd(scaled[:, rows], compute_uv=False)
        assert np.allclose(found.values[f"{prefix}smallest_mm_per_rad"], 1000 * values[:, -1], atol=1e-4)
        assert np.allclose(found.values[f"{prefix}inverse_condition"], values[:, -1] / values[:, 0], atol=1e-6)
        assert np.allclose(found.values[f"{prefix}manipulability"], np.prod(values, axis=1), atol=1e-12)


def test_a_sliding_joint_counts_by_the_length() -> None:
    slopes = np.zeros((1, 6, 2))
    slopes[0, 0, 0], slopes[0, 1, 1], slopes[0, 5, 1] = 1.0, 0.4, 1.0  # slides along x; turns about z, 0.4 m away
    scaled = weighted(slopes, np.array([True, False]), 0.1)[0]
    assert scaled[0, 0] == pytest.approx(0.1) and scaled[1, 1] == pytest.approx(0.4) and scaled[5, 1] == 0.1


def test_measures_of_a_singular_posture_are_finite() -> None:
    values = singular_values(np.diag([1.0, 0.5, 0.0])[None])
    # The zero is not the arm's inability: another posture moves that way.
    both = np.concatenate([values, [[1.0, 0.5, 0.1]]])
    found = dexterity(both, moves(both))
    assert found["inverse_condition"][0] == pytest.approx(0, abs=1e-8) and found["manipulability"][0] < 1e-8
    assert np.isfinite(found["inverse_condition"]).all()


def test_a_beam_gives_its_compliance_times_the_square_of_its_lever(tmp_path: Path) -> None:
    (tmp_path / "k.yaml").write_text("arm.spring.k1: 0.05 rad/Nm\n", encoding="utf-8")
    (tmp_path / "beam.yaml").write_text(BEAM, encoding="utf-8")
    subject = load_task(tmp_path / "beam.yaml").subject
    function = mechanics(subject, LoadSettings.si(payload=0.1, payload_com=(0.0, 0.0, 0.0)))
    found = postures_at(function, np.zeros((1, 1)), weights(subject))
    # Weight 2 N at 0.2 m, payload 1 N at 0.4 m, in a beam that is nearly level: cosines within 1e-3.
    assert found.values["sag_mm"][0] == pytest.approx(1000 * 0.4 * 0.05 * 2 * 0.2, rel=2e-3)
    assert found.values["deflection_mm"][0] == pytest.approx(1000 * 0.4 * 0.05 * 1 * 0.4, rel=5e-3)
    assert found.values["give_mm_per_N"][0] == pytest.approx(1000 * 0.05 * 0.4**2, rel=5e-3)
    assert abs(found.efforts[0, 0]) == pytest.approx(0.8, rel=2e-3)


def predicted(subject: Subject, parameters_of: str, commands: np.ndarray, acting: dict[str, float]) -> np.ndarray:
    """Tool poses (N x 4 x 4) by the code that fits, which shares no slopes with the maps."""
    task = load_task(Path(parameters_of))
    from armcal.config.system import build_system
    from armcal.config.yaml_source import load_config
    from armcal.plugins import discover
    from armcal_capability.subject import Corrections

    registry, source = discover(), load_config(parameters_of)
    system = build_system(source, registry)
    values, of = task.settings.values, task.settings.values_of
    assert values is not None and of is not None
    parameters = Corrections.read(values, load_config(of), registry).applied(system.parameters()).with_free(())
    count = commands.shape[1]
    channels = {f"arm.{joint}": row for joint, row in zip(subject.expression.joints, commands, strict=True)}
    channels |= {name: np.full(count, value) for name, value in acting.items()}
    dataset = Dataset(tuple(map(str, range(count))), channels)
    alone = {"pose": ArmsAlone(("arm",))}
    problem = Problem.build(system.arms, alone, parameters, system.environment, dataset, "interpreted", groups={})
    return problem.predict(parameters.nominal(), problem.records(dataset))[0].tools[0].transpose(2, 1, 0)


@pytest.mark.slow
def test_positions_sag_and_deflection_are_those_of_the_fitted_model(lrm: Task) -> None:
    subject, config = lrm.subject, str(CONFIGS / "designs.yaml")
    commands = spread(subject.limits, 12, 5)
    load = LoadSettings.si(payload=0.13, payload_com=(0.0, 0.0, 0.02), force=(0.5, -0.2, 0.1))
    found = postures_at(mechanics(subject, load), commands, weights(subject))
    payload = {"payload": 0.13, "payload_x": 0.0, "payload_y": 0.0, "payload_z": 0.02}
    force = {"force_x": 0.5, "force_y": -0.2, "force_z": 0.1}
    loaded = predicted(subject, config, commands, {**payload, **force})[:, :, 3]
    own = predicted(subject, config, commands, {"payload": 0.0})[:, :, 3]
    free = predicted(subject, config, commands, {f"gravity_{axis}": 0.0 for axis in "xyz"} | {"payload": 0.0})[:, :, 3]
    assert np.allclose(found.positions, loaded, atol=1e-10)
    assert np.allclose(found.values["sag_mm"], 1000 * np.linalg.norm(own - free, axis=1), atol=1e-7)
    assert np.allclose(found.values["deflection_mm"], 1000 * np.linalg.norm(loaded - own, axis=1), atol=1e-7)


@pytest.mark.slow
def test_give_is_the_finite_difference_of_the_fitted_model_under_a_force(lrm: Task) -> None:
    subject, config, step = lrm.subject, str(CONFIGS / "designs.yaml"), 1e-3
    commands = spread(subject.limits, 6, 7)
    found = mechanics(subject, LoadSettings.si(payload=0.1))(commands)
    for axis in range(3):
        ends = [
            predicted(
                subject, config, commands, {"payload": 0.1} | {f"force_{a}": s * (a == "xyz"[axis]) for a in "xyz"}
            )
            for s in (step, -step)
        ]
        slope = (ends[0] - ends[1])[:, :, 3] / (2 * step)
        assert np.allclose(found.compliances[:, :, axis], slope, atol=1e-7)


def test_slopes_by_commands_are_finite_differences_in_equilibrium(lrm: Task) -> None:
    function, step = mechanics(lrm.subject, LoadSettings.si(payload=0.1)), 1e-5
    commands = spread(lrm.subject.limits, 6, 9)
    found = function(commands)
    for joint in range(6):
        moved = np.zeros((6, 1))
        moved[joint] = step
        up, down = function(commands + moved), function(commands - moved)
        assert np.allclose(found.slopes[:, :3, joint], (up.positions - down.positions).T / (2 * step), atol=1e-7)
        turned = np.einsum("ijn,kjn->nik", (up.rotations - down.rotations) / (2 * step), found.rotations)
        axes = np.stack([turned[:, 2, 1], turned[:, 0, 2], turned[:, 1, 0]], axis=1)
        assert np.allclose(found.slopes[:, 3:, joint], axes, atol=1e-6)


@pytest.mark.slow
def test_compiled_and_interpreted_give_the_same(lrm: Task) -> None:
    commands = spread(lrm.subject.limits, 21, 2)
    found = [
        postures_at(
            MechanicsFunction(lrm.subject.expression, lrm.settings.loads, choice), commands, weights(lrm.subject)
        )
        for choice in ("interpreted", "compiled")
    ]
    for name, values in found[0].values.items():
        assert np.allclose(values, found[1].values[name], rtol=1e-6, atol=1e-9), name


def test_the_same_seed_gives_the_same_and_another_seed_another(tmp_path: Path) -> None:
    subject = planar(tmp_path)
    one, again, other = (spread(subject.limits, 100, seed) for seed in (0, 0, 1))
    assert np.array_equal(one, again) and not np.allclose(one, other)
    assert np.array_equal(spread(subject.limits, 300, 0)[:, :100], one)
    assert (one >= subject.limits[:, :1]).all() and (one <= subject.limits[:, 1:]).all()


@pytest.mark.slow
def test_the_order_of_postures_does_not_matter(lrm: Task) -> None:
    postures = postures_at(mechanics(lrm.subject), spread(lrm.subject.limits, 500, 0), weights(lrm.subject))
    shuffled = postures.subset(np.random.default_rng(0).permutation(len(postures)))
    one, two = voxels_of(postures, 0.05), voxels_of(shuffled, 0.05)
    assert np.array_equal(one.places, two.places) and np.array_equal(one.counts, two.counts)
    for name in one.values:
        assert np.allclose(one.values[name], two.values[name], rtol=1e-12), name


def test_where_the_base_stands_does_not_matter(tmp_path: Path) -> None:
    settings = CapabilitySettings.si(samples=3000, voxel=0.02)
    here, there = (survey(planar(tmp_path, *at), settings) for at in ((0, 0), (2000, -1000)))
    moved = np.array([100, 0, -50])  # in cells
    shared = {tuple(p) for p in here.voxels.places + moved} & {tuple(p) for p in there.voxels.places}
    # A tool on the very edge of a cell may fall to either side.
    assert len(shared) > 0.995 * len(here.voxels.places)
    for name, values in here.postures.values.items():
        assert np.allclose(values, there.postures.values[name], rtol=1e-6, atol=1e-9), name


@pytest.mark.slow
def test_cells_of_another_size_cover_the_same_and_keep_the_mean(lrm: Task) -> None:
    postures = postures_at(mechanics(lrm.subject), spread(lrm.subject.limits, 2000, 0), weights(lrm.subject))
    fine, coarse = voxels_of(postures, 0.02), voxels_of(postures, 0.04)
    assert {tuple(p) for p in fine.places // 2} == {tuple(p) for p in coarse.places}
    for each in (fine, coarse):
        mean = np.average(each.mean("sag_mm"), weights=each.counts)
        assert mean == pytest.approx(postures.values["sag_mm"].mean(), rel=1e-12)
        assert each.values["sag_mm"][0].min() == postures.values["sag_mm"].min()


def test_best_is_the_low_end_of_sag_and_the_high_end_of_manipulability() -> None:
    random = np.random.default_rng(4)
    group = random.integers(0, 5, 60)
    group[group == 3] = 2
    values = {"sag_mm": random.normal(size=60), "manipulability": random.normal(size=60)}
    found = grouped(values, group, 5)
    for name, ends in (("sag_mm", (np.min, np.max)), ("manipulability", (np.max, np.min))):
        for g in (0, 1, 2, 4):
            own = values[name][group == g]
            assert np.allclose(found[name][:, g], [ends[0](own), own.mean(), ends[1](own)])
        assert np.isnan(found[name][:, 3]).all()


def test_cells_fill_an_area_evenly() -> None:
    centres = cells_of(AreaSettings.si(low=(0.0, 0.0, 0.1), high=(0.1, 0.05, 0.1)), 0.03)
    assert len(centres) == 4 * 2 * 1
    assert np.allclose(centres.min(axis=0), (0.0125, 0.0125, 0.1)) and np.allclose(
        centres.max(axis=0)[:2], (0.0875, 0.0375)
    )


@pytest.mark.slow
def test_areas_hold_every_sampled_posture_and_keep_limits_and_direction(lrm: Task) -> None:
    """What plain sampling finds, the search must find, within limits and with the tool pointing as asked."""
    subject = lrm.subject
    tool = {"axis": "z", "along": (0.0, 0.0, -1.0), "within": 0.7}
    area = AreaSettings.si(low=(0.2, -0.15, 0.0), high=(0.4, 0.15, 0.1), tool=tool)
    function = mechanics(subject)
    sampled = postures_at(function, spread(subject.limits, 20_000, 0), weights(subject))
    pointing = Pointing.of(ToolDirectionSettings.si(**tool))
    inside = np.all((sampled.positions >= area.low) & (sampled.positions <= area.high), axis=1)
    inside &= pointing.angles(sampled.rotations) <= 0.7
    size = 0.05
    hit = {tuple(p) for p in np.floor((sampled.positions[inside] - area.low) / size).astype(int)}
    found = AreaSearch(function, subject.limits, subject.allowed, weights(subject), sampled)(area, size, 8)
    places = [tuple(p) for p in np.floor((found.centres - area.low) / size).astype(int)]
    reached = dict(zip(places, found.reached, strict=True))
    assert len(hit) > 20
    missed = [place for place in hit if not reached[place]]  # a corner of a cell may be reached and its centre not
    assert len(missed) <= 0.1 * len(hit)


@pytest.mark.slow
def test_found_postures_are_where_and_how_they_should_be(lrm: Task) -> None:
    from armcal_capability.inverse import reach_for

    subject, function = lrm.subject, mechanics(lrm.subject)
    targets = np.array([[0.3, 0.0, 0.05], [0.32, 0.1, 0.1], [2.0, 0.0, 0.0]]).T
    pointing = Pointing(2, np.array([0.0, 0.0, -1.0]), 0.6)
    starts = spread(subject.limits, 600, 0)
    which = np.arange(600) % 3
    commands, arrived = reach_for(function, targets[:, which], starts, subject.limits, 0.1, pointing)
    assert not arrived[which == 2].any() and arrived[which < 2].mean() > 0.2
    there = function(commands[:, arrived])
    assert np.allclose(there.positions, targets[:, which[arrived]], atol=1.1e-5)
    assert pointing.angles(there.rotations).max() <= 0.6
    assert (commands >= subject.limits[:, :1]).all() and (commands <= subject.limits[:, 1:]).all()


@pytest.mark.slow
def test_clearance_takes_postures_away() -> None:
    settings = CapabilitySettings.si(samples=2000, voxel=0.05)
    task = load_task(CONFIGS / "plan.yaml")
    found = survey(task.subject, settings)
    assert 0 < found.drawn - found.clear < 200
    open_air = survey(replace(task.subject, clearance=None), settings)
    assert open_air.clear == 2000


@pytest.mark.slow
def test_what_the_parameters_leave_open_is_what_predictions_say(calibration: Calibration, tmp_path: Path) -> None:
    subject = of(calibration)
    commands = spread(subject.limits, 15, 1)
    postures = postures_at(mechanics(subject), commands, weights(subject))
    found = with_accuracy(postures, subject, "interpreted").values
    dataset = Dataset(
        tuple(map(str, range(15))),
        {f"arm.{j}": row for j, row in zip(subject.expression.joints, commands, strict=True)},
    )
    spread_of = calibration.plus_minus(dataset).deviations
    noise = 0.0005 * float(calibration.record.noise["scale"])
    square = sum(spread_of[f"tracker.{axis}"] ** 2 - noise**2 for axis in "xyz")
    assert np.allclose(found["known_to_mm"], 1000 * np.sqrt(square), rtol=1e-6)


def of(calibration: Calibration) -> Subject:
    from armcal.config.yaml_source import load_config
    from armcal_capability.subject import of_calibration

    return of_calibration(calibration, load_config(CONFIGS / "plan.yaml"), "demo")


@pytest.mark.slow
def test_the_nominal_error_is_between_two_forward_models(calibration: Calibration) -> None:
    subject = of(calibration)
    commands = spread(subject.limits, 10, 1)
    found = with_accuracy(postures_at(mechanics(subject), commands, weights(subject)), subject, "interpreted").values
    nominal = calibration.parameters.with_nominal(np.array([e.nominal for e in calibration.record.parameters]))
    plain = replace(calibration, parameters=nominal)
    apart = calibration.forward(commands.T)[:, :3, 3] - plain.forward(commands.T)[:, :3, 3]
    assert np.allclose(found["nominal_mm"], 1000 * np.linalg.norm(apart, axis=1), atol=1e-7)


@pytest.mark.slow
def test_steps_of_servos_spread_the_tool_as_rounding_does(calibration: Calibration) -> None:
    table = PulseTable((-1.75, 0.0, 1.75), (0.0006, 0.0015, 0.0025))
    clock = PulseClock(25e6, 121)
    subject = of(calibration)
    servos = dict.fromkeys(subject.expression.joints, (table, clock))
    subject = replace(subject, expression=replace(subject.expression, servos=servos))
    commands = spread(subject.limits, 4000, 1)
    postures = postures_at(mechanics(subject), commands, weights(subject))
    found = with_accuracy(postures, subject, "interpreted").values["quantisation_mm"]
    rounded = np.array([[float(quantised(x, table, clock)) for x in row] for row in commands[:, :400]])
    apart = mechanics(subject)(rounded).positions - postures.positions[:400].T
    rms = 1000 * np.sqrt(np.mean(np.sum(apart**2, axis=0)))
    assert np.sqrt(np.mean(found[:400] ** 2)) == pytest.approx(rms, rel=0.06)
    assert np.allclose(
        steps_at(table, clock, np.array([-1.0, 1.0])), [1.75 / 0.0009 * clock.tick, 1.75 / 0.001 * clock.tick]
    )


def test_expected_errors_are_no_smaller_than_their_parts(calibration: Calibration) -> None:
    subject = of(calibration)
    commands = spread(subject.limits, 10, 1)
    found = with_accuracy(postures_at(mechanics(subject), commands, weights(subject)), subject, "interpreted").values
    assert (found["expected_mm"] >= found["known_to_mm"]).all()


@pytest.mark.slow
def test_a_design_keeps_what_was_found_and_changes_what_it_says(lrm: Task) -> None:
    built, longer, flatter = (lrm.designs[n] for n in ("60 deg, as built", "upper arm + 1 cm", "45 deg"))
    assert np.allclose(outline(built), outline(lrm.subject))
    commands = np.zeros((6, 1))
    at = {n: mechanics(s).weightless(commands).ravel() for n, s in (("built", built), ("longer", longer))}
    along = np.array([np.sin(np.pi / 3), 0, np.cos(np.pi / 3)])
    # The upper arm lies nearly along the mount's axis at zero angles; 1 cm more moves the tool 1 cm that way.
    assert np.allclose(at["longer"] - at["built"], 0.01 * along, atol=6e-4)
    mount = np.array([-0.034975, 0, 0.23608])
    found = mechanics(flatter).weightless(commands).ravel() - mount
    turned = at["built"] - mount
    turn = np.deg2rad(-15)
    about_y = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]])
    # What the bench found of the base stays in the base's axes: a few millimetres do not turn with it.
    assert np.allclose(found, about_y @ turned, atol=2e-3)


def test_corrections_are_those_of_the_arm_that_the_values_belong_to(lrm: Task) -> None:
    """Else the rover's arm would stand where the bench's did, 80 mm away."""
    assert outline(lrm.subject)[0] == pytest.approx([-0.034975, 0, 0.23608])
    tool = mechanics(lrm.subject).weightless(np.zeros((6, 1))).ravel()
    assert np.linalg.norm(tool - outline(lrm.subject)[-1]) < 0.03


def test_designs_are_compared_where_all_of_them_reach(tmp_path: Path) -> None:
    settings = CapabilitySettings.si(
        samples=500, voxel=0.1, areas={"all": {"low": (-0.8, -0.8, 0.0), "high": (0.8, 0.8, 0.0)}}
    )
    found: dict[str, Survey] = {
        "here": survey(planar(tmp_path), settings),
        "away": survey(planar(tmp_path, 300), settings),
    }
    told = design_summaries(found)
    both = np.sum(found["here"].areas["all"].reached & found["away"].areas["all"].reached)
    assert told["here"]["all"]["cells_compared"] == told["away"]["all"]["cells_compared"] == both
    assert told["here"]["all"]["reached"] == pytest.approx(found["here"].areas["all"].reached.mean())


def test_a_design_that_sets_nothing_of_the_arm_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "d.yaml"
    text = PLANAR.format(x=0, z=0) + "capability: {designs: {a: {arm.model.rows.0.a_mm: 5}}}\n"
    path.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"dotted name of a value of the arm"):
        load_designs(path)
    path.write_text(text.replace("arm.model.rows.0", "arms.arm.model.rows.7"), encoding="utf-8")
    with pytest.raises(ConfigError, match="index '7'"):
        load_designs(path)


def test_a_load_that_nothing_holds_leaves_no_posture(tmp_path: Path) -> None:
    (tmp_path / "k.yaml").write_text("arm.spring.k1: 50 rad/Nm\n", encoding="utf-8")
    (tmp_path / "beam.yaml").write_text(BEAM.replace("90 deg", "20 deg"), encoding="utf-8")
    subject = load_task(tmp_path / "beam.yaml").subject
    settings = CapabilitySettings.si(samples=16, loads={"payload": 50.0})
    with pytest.raises(ProblemError, match="no posture has an elastic equilibrium"):
        survey(subject, settings)


def test_settings_come_back_from_their_own_config() -> None:
    settings = CapabilitySettings.si(
        samples=100, areas={"a": {"low": (0, 0, 0), "high": (1, 1, 1)}}, holding={"q1": 0.3}, loads={"payload": 0.1}
    )
    again = CapabilitySettings.model_validate(settings.to_config())
    assert again == settings and isinstance(again, Settings)
