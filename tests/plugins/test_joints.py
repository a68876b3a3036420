"""Joint effects: every law, alone and with all others, against plain numpy on the LRM arm and on a SCARA arm."""

from __future__ import annotations

import shutil
import sys
from dataclasses import dataclass, field, replace
from pathlib import Path

import casadi as ca
import elastic_chain as chain_oracle
import numpy as np
import oracle
import pytest
import yaml
from armcal.arm.assembly import Arm, ArmInputs, prefixed
from armcal.arm.statics import Environment, Load, MassSpec
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.cli.main import cli
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal_joints.effects import (
    ApproachBacklash,
    BearingPlay,
    Compliances,
    CubicSprings,
    GearError,
    ServoMap,
    ThermalLength,
    TorqueBacklash,
    TorsionalSprings,
)
from armcal_tracker.position import TipPosition, TipPositionSettings
from click.testing import CliRunner
from scipy.spatial.transform import Rotation

ROOT = Path(__file__).resolve().parents[2]
CONFIGS = ROOT / "configs" / "lrm_arm"
POSES = 40
AGREEMENT_M = 1e-9
ENTRIES = ("xx", "xy", "xz", "yy", "yz", "zz")
TABLES = {
    "q1": ((-100, 0, 100), (620, 1540, 2460)),
    "q2": ((-100, 0, 100), (620, 1550, 2450)),
    "q4": ((-100, -20, 30, 100), (2425, 1700, 1400, 600)),
}
"""deg and us; that of q4 falls."""
TRANSITION_NM, BEARING_TRANSITION_NM = 0.03, 0.08


# ---------------------------------------------------------------- the effects in numpy


@dataclass
class Acting:
    """What the effects of an arm do, each written down from its description."""

    q: np.ndarray
    approach: np.ndarray
    warmer: np.ndarray
    moved: np.ndarray
    laws: list = field(default_factory=list)
    slides: list = field(default_factory=list)
    growth: np.ndarray | None = None


def axis_law(give, axis=(0.0, 0.0, 1.0)):
    """A law of the moment about one axis."""
    return lambda moment: np.outer(give(moment @ np.array(axis)), axis)


def in_all_directions(matrix):
    """A law of the whole moment."""
    return lambda moment: moment @ matrix.T


def matrix_of(values, name):
    """The symmetric matrix of six entries."""
    xx, xy, xz, yy, yz, zz = (values[f"{name}[{entry}]"] for entry in ENTRIES)
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


def add_springs(acting, v):
    acting.laws.append((0, axis_law(lambda t: v["k0"] * t, (0.0, 1.0, 0.0))))
    acting.laws += [(i, axis_law(lambda t, k=v[f"k{i}"]: k * t)) for i in range(1, 7)]


def add_cubic(acting, v):
    acting.laws += [(i, axis_law(lambda t, c=v[f"c{i}"]: c * t**3)) for i in range(1, 7)]


def add_compliance(acting, v):
    for site in range(7):
        acting.laws.append((site, in_all_directions(matrix_of(v, f"C{site}"))))


def add_servo(acting, v):
    for i in range(6):
        q = acting.q[:, i]
        gain = np.where(q > 0, v[f"above{i + 1}"], v[f"below{i + 1}"])
        acting.moved[:, i] += gain * q + v[f"offset{i + 1}"]


def add_one_gain(acting, v):
    for i in range(6):
        acting.moved[:, i] += v[f"gain{i + 1}"] * acting.q[:, i] + v[f"offset{i + 1}"]


def add_lag(acting, v):
    for i in range(6):
        acting.moved[:, i] -= v[f"lag{i + 1}"] * acting.approach[:, i]


def add_play(acting, v):
    for i in range(1, 7):
        law = axis_law(lambda t, play=v[f"play{i}"]: play * t / np.hypot(t, TRANSITION_NM))
        acting.laws.append((i, law))


def add_bearings(acting, v):
    for site in range(7):

        def law(moment, tilt=v[f"tilt{site}"]):
            size = np.linalg.norm(moment, axis=1, keepdims=True)
            return tilt * moment / np.hypot(size, BEARING_TRANSITION_NM)

        acting.laws.append((site, law))


def add_gear(acting, v):
    for i in range(6):
        q = acting.q[:, i]
        for turns in (1, 2):
            acting.moved[:, i] += v[f"sin{turns}_{i + 1}"] * np.sin(turns * q)
            acting.moved[:, i] += v[f"cos{turns}_{i + 1}"] * (np.cos(turns * q) - 1)


def on_table(x, at, values):
    """Linear between the points and beyond the ends."""
    at, values = np.array(at, dtype=float), np.array(values, dtype=float)
    order = np.argsort(at)
    at, values = at[order], values[order]
    part = np.clip(np.searchsorted(at, x) - 1, 0, len(at) - 2)
    slope = (values[part + 1] - values[part]) / (at[part + 1] - at[part])
    return values[part] + slope * (x - at[part])


def add_quantisation(acting, v):
    tick_us = 122 / 25.0
    for name, (angles, pulses) in TABLES.items():
        i = int(name[1:]) - 1
        asked = on_table(np.degrees(acting.q[:, i]), angles, pulses)
        counts = np.round(asked / tick_us)
        stands = on_table(counts * tick_us, pulses, angles)
        acting.moved[:, i] += np.radians(stands) - acting.q[:, i]


def add_one_expansion(acting, v):
    acting.growth = 1 + np.tile(v["expansion"] * acting.warmer, (7, 1))


def add_expansions(acting, v):
    acting.growth = 1 + np.array([v[f"expansion{i}"] * acting.warmer for i in range(1, 8)])


# ---------------------------------------------------------------- the effects as configured


def per_joint(name, unit, low, high, first=1):
    def draw(random):
        return {f"{name}{i}": (random.uniform(low, high), unit) for i in range(first, 7)}

    return draw


def merged(*draws):
    return lambda random: {k: v for draw in draws for k, v in draw(random).items()}


def matrices(random):
    """Semidefinite ones, some of them singular."""
    values = {}
    for site in range(7):
        root = random.normal(size=(3, 2 if site % 3 == 1 else 3)) * 0.1
        matrix = root @ root.T
        entries = matrix[np.triu_indices(3)]
        values |= {f"C{site}[{e}]": (x, "rad/Nm") for e, x in zip(ENTRIES, entries, strict=True)}
    return values


def per_gear(random):
    kinds = ("sin1", "cos1", "sin2", "cos2")
    return {f"{kind}_{i}": (random.normal() * 0.02, "rad") for i in range(1, 7) for kind in kinds}


SERVO_TABLES = {
    name: {"angles_deg": list(angles), "pulses_us": list(pulses)} for name, (angles, pulses) in TABLES.items()
}
MOST = per_joint("k", "rad/Nm", 0.0, 0.08, first=0)
GAINS = merged(*(per_joint(n, "", -0.05, 0.05) for n in ("above", "below")), per_joint("offset", "rad", -0.05, 0.05))
GAIN = merged(per_joint("gain", "", -0.05, 0.05), per_joint("offset", "rad", -0.05, 0.05))


@dataclass(frozen=True)
class Effect:
    """An effect's settings as written in YAML, random values, and what they do."""

    settings: dict
    values: object
    add: object


EFFECTS = {
    "torsional_spring": Effect({"base_axis": "y"}, MOST, add_springs),
    "cubic_spring": Effect({}, per_joint("c", "rad/Nm^3", -0.02, 0.05), add_cubic),
    "compliance": Effect({"compliance_rad_per_Nm": 0.01}, matrices, add_compliance),
    "servo_map": Effect({"gains": "two"}, GAINS, add_servo),
    "servo_map, one gain": Effect({"gains": "one"}, GAIN, add_one_gain),
    "approach_backlash": Effect({}, per_joint("lag", "rad", -0.02, 0.02), add_lag),
    "torque_backlash": Effect({"transition_Nm": TRANSITION_NM}, per_joint("play", "rad", 0.0, 0.006), add_play),
    "bearing_play": Effect(
        {"transition_Nm": BEARING_TRANSITION_NM}, per_joint("tilt", "rad", 0.0, 0.006, first=0), add_bearings
    ),
    "gear_error": Effect({"joints": "all"}, per_gear, add_gear),
    "quantisation": Effect({"tables": SERVO_TABLES}, lambda random: {}, add_quantisation),
    "thermal_length": Effect(
        {"reference_C": 22}, lambda random: {"expansion": (random.uniform(0, 2e-4), "1/K")}, add_one_expansion
    ),
    "thermal_length, each link": Effect(
        {"links": "each", "reference_C": 22},
        lambda random: {f"expansion{i}": (random.uniform(0, 5e-4), "1/K") for i in range(1, 8)},
        add_expansions,
    ),
}
TOGETHER = tuple(name for name in EFFECTS if name not in ("servo_map, one gain", "thermal_length"))


def configured(folder, names, random, **statics):
    """An experiment from YAML with these effects at random values; and the values by effect."""
    shutil.copy(CONFIGS / "arm.yaml", folder)
    effects, texts, drawn = {"spring": None}, {}, {}
    for number, name in enumerate(names):
        instance = f"e{number}"
        effects[instance] = {"type": name.partition(",")[0], **EFFECTS[name].settings}
        values = EFFECTS[name].values(random)
        drawn[name] = {local: float(value) for local, (value, _) in values.items()}
        for local, (value, unit) in values.items():
            texts[f"arm.{instance}.{local}"] = f"{float(value)!r} {unit}" if unit else float(value)
    config = {
        "extends": "arm.yaml",
        "arms": {"arm": {"effects": effects}},
        "statics": statics,
        "parameters": {"values": texts},
    }
    path = folder / "effects.yaml"
    path.write_text(yaml.safe_dump(config))
    return Experiment.load(path), drawn


def expected_tip(names, drawn, dataset, loads=None):
    """The tip by the oracle."""
    v, count = oracle.nominal(), len(dataset)
    q = np.stack([dataset.column(f"arm.q{i}") for i in range(1, 7)], axis=1)
    approach = np.stack([dataset.column(f"arm.approach.q{i}") for i in range(1, 7)], axis=1)
    offsets = np.array([v[f"theta{i}"] for i in range(1, 7)])
    acting = Acting(q, approach, dataset.column("temperature") - 22, q + offsets)
    for name in names:
        EFFECTS[name].add(acting, drawn[name])
    arm = chain_oracle.lrm(v, count, acting.growth)
    return chain_oracle.tip(arm, acting.moved, loads or oracle.Loads(), acting.laws, acting.slides)


def visited(lrm, seed, count=POSES):
    """Random poses, approaches of all three kinds, temperatures."""
    random = np.random.default_rng(seed)
    approach = random.integers(-1, 2, (count, 6))
    columns = {f"arm.approach.q{i + 1}": approach[:, i] for i in range(6)}
    return lrm.dataset(oracle.random_poses(count, seed), **columns, temperature=random.uniform(-20, 60, count))


def predicted(lrm, experiment, dataset, evaluator="interpreted"):
    """The tip by armcal, at the configured values."""
    problem = lrm.problem(experiment, dataset, evaluator)
    return problem.of(dataset).predict(problem.parameters.nominal())[0].outputs[:3].T


# ---------------------------------------------------------------- laws


def test_the_oracle_of_chains_is_that_of_the_arm_where_both_apply():
    v, q = oracle.published(), oracle.random_poses(50, 1)
    laws = [(0, axis_law(lambda t: v["k0"] * t, (0.0, 1.0, 0.0)))]
    laws += [(i, axis_law(lambda t, k=v[f"k{i}"]: k * t)) for i in range(1, 7)]
    offsets = np.array([v[f"theta{i}"] for i in range(1, 7)])
    found = chain_oracle.tip(chain_oracle.lrm(v, 50), q + offsets, oracle.Loads(), laws)
    np.testing.assert_allclose(found, oracle.tip(v, q), rtol=0, atol=1e-14)


@pytest.mark.quick("approach_backlash", "gear_error", "quantisation", "thermal_length, each link", "thermal_length")
@pytest.mark.parametrize("name", EFFECTS)
def test_an_effect_alone_moves_the_tip_as_its_description_says(lrm, tmp_path, name):
    experiment, drawn = configured(tmp_path, [name], np.random.default_rng(len(name)))
    dataset = visited(lrm, 3)
    found, expected = predicted(lrm, experiment, dataset), expected_tip([name], drawn, dataset)
    np.testing.assert_allclose(found, expected, rtol=0, atol=AGREEMENT_M)
    rigid = expected_tip([], {}, dataset)
    assert np.abs(expected - rigid).max() > 1e5 * AGREEMENT_M, "the effect does nothing here: a test of nothing"


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.slow
def test_all_effects_together_move_the_tip_as_all_descriptions_say(lrm, tmp_path, seed):
    experiment, drawn = configured(tmp_path, TOGETHER, np.random.default_rng(seed))
    dataset = visited(lrm, 10 + seed)
    expected = expected_tip(TOGETHER, drawn, dataset)
    np.testing.assert_allclose(predicted(lrm, experiment, dataset), expected, rtol=0, atol=AGREEMENT_M)


@pytest.mark.slow
def test_effects_act_under_loads_of_every_kind(lrm, tmp_path):
    """Tilted gravity, payload and wrench of each record."""
    names = ("compliance", "cubic_spring", "bearing_play", "torque_backlash", "thermal_length, each link")
    experiment, drawn = configured(tmp_path, names, np.random.default_rng(5))
    random, dataset = np.random.default_rng(6), visited(lrm, 7)
    loads = oracle.Loads(
        gravity=random.normal(size=(POSES, 3)) * 4,
        payload_mass=random.uniform(0, 0.2, POSES),
        payload_com=random.normal(size=(POSES, 3)) * 0.03,
        force=random.normal(size=(POSES, 3)) * 0.5,
        torque=random.normal(size=(POSES, 3)) * 0.1,
    )
    columns = {"payload": loads.payload_mass}
    for name in ("gravity", "payload_com", "force", "torque"):
        short = name.removesuffix("_com")
        columns |= {f"{short}_{axis}": getattr(loads, name)[:, i] for i, axis in enumerate("xyz")}
    dataset = replace(dataset, channels={**dataset.channels, **columns})
    expected = expected_tip(names, drawn, dataset, loads)
    np.testing.assert_allclose(predicted(lrm, experiment, dataset), expected, rtol=0, atol=AGREEMENT_M)


def test_gravity_is_turned_about_the_bases_x_axis_and_then_about_its_y_axis(lrm, tmp_path):
    experiment, drawn = configured(tmp_path, ["compliance"], np.random.default_rng(8))
    parameters = experiment.parameters
    tilt = {"statics.gravity_rx": 0.11, "statics.gravity_ry": -0.07}
    changed = {name: replace(parameters[name], nominal=(angle,)) for name, angle in tilt.items()}
    dataset = visited(lrm, 9)
    problem = lrm.problem(experiment, dataset, "interpreted", parameters.replaced(changed))
    found = problem.of(dataset).predict(problem.parameters.nominal())[0].outputs[:3].T
    turned = Rotation.from_rotvec([0, -0.07, 0]) * Rotation.from_rotvec([0.11, 0, 0])
    expected = expected_tip(["compliance"], drawn, dataset, oracle.Loads(gravity=turned.apply(oracle.EARTH)))
    np.testing.assert_allclose(found, expected, rtol=0, atol=AGREEMENT_M)


def test_a_configured_tilt_turns_the_gravity_of_each_record_too(lrm, tmp_path):
    experiment, drawn = configured(tmp_path, ["compliance"], np.random.default_rng(8))
    changed = replace(experiment.parameters["statics.gravity_ry"], nominal=(0.2,))
    dataset, own = visited(lrm, 9), np.random.default_rng(1).normal(size=(POSES, 3)) * 5
    columns = {f"gravity_{axis}": own[:, i] for i, axis in enumerate("xyz")}
    dataset = replace(dataset, channels={**dataset.channels, **columns})
    parameters = experiment.parameters.replaced({"statics.gravity_ry": changed})
    problem = lrm.problem(experiment, dataset, "interpreted", parameters)
    found = problem.of(dataset).predict(problem.parameters.nominal())[0].outputs[:3].T
    loads = oracle.Loads(gravity=Rotation.from_rotvec([0, 0.2, 0]).apply(own))
    np.testing.assert_allclose(found, expected_tip(["compliance"], drawn, dataset, loads), rtol=0, atol=AGREEMENT_M)


def test_the_tip_moves_with_every_parameter_of_every_effect_as_differences_say(lrm, tmp_path):
    experiment, _ = configured(tmp_path, TOGETHER, np.random.default_rng(2))
    dataset, parameters = visited(lrm, 4, 8), experiment.parameters
    free = [*parameters.select(["arm.e?.*"]), "statics.gravity_rx", "statics.gravity_ry"]
    parameters = parameters.with_free(free).without_bounds()
    problem = lrm.problem(experiment, dataset, "interpreted", parameters)
    records, values = problem.of(dataset).records, parameters.nominal()
    noise = np.array(problem.kernels[0].factor.noise)[:, None, None]
    found = np.concatenate(list(problem.with_records(records).jacobians(values)), axis=2)[:, :, :8] * noise
    for column, entry in enumerate(parameters.free_entries):
        name, sides = parameters.entry_names[entry], []
        step = 1e-4 if ".c" in name else 1e-5
        for sign in (1, -1):
            aside = values.copy()
            aside[entry] += sign * step
            sides.append(problem.with_records(records).residuals(aside)[0])
        numeric = (sides[0] - sides[1]) / (2 * step)
        size = max(np.abs(numeric).max(), 1e-3)
        np.testing.assert_allclose(found[:, column], numeric, rtol=0, atol=2e-6 * size + 1e-8, err_msg=name)


@pytest.mark.slow
def test_compiled_effects_give_the_numbers_of_interpreted_ones(lrm, tmp_path):
    if not (shutil.which("cc") or shutil.which("gcc") or shutil.which("clang")):
        pytest.skip("no C compiler")
    names = ("compliance", "bearing_play", "servo_map", "quantisation", "thermal_length")
    experiment, _ = configured(tmp_path, names, np.random.default_rng(12))
    dataset, parameters = visited(lrm, 13), experiment.parameters
    parameters = parameters.with_free(parameters.select(["arm.e?.*"]))
    models = []
    for evaluator in ("interpreted", "compiled"):
        problem = lrm.problem(experiment, dataset, evaluator, parameters)
        models.append(problem.of(dataset).normal_equations(parameters.nominal()))
    assert problem.backend == "compiled"
    size = np.abs(models[0].hessian).max()
    np.testing.assert_allclose(models[0].cost, models[1].cost, rtol=1e-10)
    np.testing.assert_allclose(models[0].hessian, models[1].hessian, rtol=0, atol=1e-9 * size)


# ---------------------------------------------------------------- what a user may rely on


def test_a_spring_and_a_matrix_at_one_site_are_the_matrix_with_the_spring_added(lrm, tmp_path):
    """At each joint the spring adds to zz, at the base (about y) to yy."""
    names = ("torsional_spring", "compliance")
    experiment, drawn = configured(tmp_path, names, np.random.default_rng(20))
    springs, flex = drawn["torsional_spring"], dict(drawn["compliance"])
    for site in range(7):
        flex[f"C{site}[{'zz' if site else 'yy'}]"] += springs[f"k{site}"]
    dataset = visited(lrm, 21)
    together = expected_tip(["compliance"], {"compliance": flex}, dataset)
    np.testing.assert_allclose(predicted(lrm, experiment, dataset), together, rtol=0, atol=AGREEMENT_M)


def test_effects_on_some_joints_leave_the_others_alone(lrm, tmp_path):
    some = {
        "compliance": {"joints": ["q5", "q2"], "base": False, "compliance_rad_per_Nm": 0.01},
        "servo_map": {"joints": ["q3"], "gains": "one"},
        "gear_error": {"joints": ["q4"]},
        "torsional_spring": {"joints": ["q6"]},
        "bearing_play": {"joints": ["q1"], "base": True},
    }
    shutil.copy(CONFIGS / "arm.yaml", tmp_path)
    effects = {"spring": None, **{name: {"type": name, **given} for name, given in some.items()}}
    path = tmp_path / "some.yaml"
    path.write_text(yaml.safe_dump({"extends": "arm.yaml", "arms": {"arm": {"effects": effects}}}))
    names = [name for name in Experiment.load(path).parameters.names if name.split(".")[1] in some]
    expected = {
        *("arm.compliance.C2", "arm.compliance.C5", "arm.servo_map.gain3", "arm.servo_map.offset3"),
        *(f"arm.gear_error.{kind}_4" for kind in ("sin1", "cos1", "sin2", "cos2")),
        *("arm.torsional_spring.k6", "arm.bearing_play.tilt0", "arm.bearing_play.tilt1"),
    }
    assert set(names) == expected


def test_where_the_approach_is_not_recorded_a_joint_stands_in_the_middle_of_its_play(lrm, tmp_path):
    experiment, _ = configured(tmp_path, ["approach_backlash"], np.random.default_rng(22))
    q = oracle.random_poses(10, 23)
    found = predicted(lrm, experiment, lrm.dataset(q))
    np.testing.assert_allclose(found, oracle.tip(oracle.nominal(), q), rtol=0, atol=1e-12)


def test_without_a_temperature_lengths_are_those_of_the_reference(lrm, tmp_path):
    experiment, _ = configured(tmp_path, ["thermal_length"], np.random.default_rng(24))
    q = oracle.random_poses(10, 25)
    found = predicted(lrm, experiment, lrm.dataset(q))
    np.testing.assert_allclose(found, oracle.tip(oracle.nominal(), q), rtol=0, atol=1e-12)


def test_frames_on_a_link_move_with_its_length(lrm, tmp_path):
    """The frame at the end of a link stays where the next joint is: warm, too."""
    experiment, drawn = configured(tmp_path, ["thermal_length, each link"], np.random.default_rng(26))
    arm, dataset = experiment.system.arms["arm"], visited(lrm, 27, 5)
    values = {b.name: ca.SX(list(b.nominal)) for b in experiment.parameters.blocks}
    nothing = ca.SX.zeros(3)
    load = Load(nothing, ca.SX(0), nothing, nothing, nothing)
    q = np.stack([dataset.column(f"arm.q{i}") for i in range(1, 7)], axis=1)
    warm = {"temperature": ca.SX(62.0)}
    growth = [1 + 40 * drawn["thermal_length, each link"][f"expansion{i}"] for i in range(1, 8)]
    chain = chain_oracle.lrm(oracle.nominal(), 5, np.tile(np.array(growth)[:, None], (1, 5)))
    offsets = np.array([oracle.nominal()[f"theta{i}"] for i in range(1, 7)])
    zeros = np.zeros((5, 7, 3)), np.zeros((5, 6))
    sites = chain_oracle.sites_of(chain, q + offsets, *zeros)
    for i in range(5):
        state = arm.state(values, ArmInputs(ca.SX(q[i]), ca.SX.zeros(6), load, ca.SX(0, 1), warm))
        ends = [np.array(ca.DM(state.frames[f"row{j}"].translation)).ravel() for j in range(1, 6)]
        np.testing.assert_allclose(ends, [site[i, :3, 3] for site in sites[2:]], rtol=0, atol=1e-13)


def test_a_column_of_temperatures_is_read_and_needed_where_an_effect_asks_for_it(tmp_path):
    rows = (CONFIGS / "demo.csv").read_text().splitlines()[:40]
    warm = ["temperature_C", *(str(15 + 0.5 * i) for i in range(39))]
    (tmp_path / "warm.csv").write_text("\n".join(f"{row},{t}" for row, t in zip(rows, warm, strict=True)) + "\n")
    (tmp_path / "cold.csv").write_text("\n".join(rows) + "\n")
    setting = ["arms.arm.effects.warm={type: thermal_length}"]
    dataset = Experiment.load(CONFIGS / "demo.yaml", setting, data=tmp_path / "warm.csv").read()
    np.testing.assert_allclose(dataset.column("temperature"), 15 + 0.5 * np.arange(39))
    told = check(setting[0], data=tmp_path / "cold.csv")
    assert told.exit_code == 2 and "temperature" in told.output and "Traceback" not in told.output


# ---------------------------------------------------------------- another arm


LINKS_M, HEIGHT_M = (0.25, 0.2), 0.3
SCARA_MASSES = (("upper_arm", 1, 0.9, (0.12, 0, 0)), ("forearm", 2, 0.6, (0.09, 0, 0)), ("tool", 3, 0.4, (0, 0, 0.05)))


def scara(effects, q, gravity, **columns):
    """The tip of the SCARA arm of the plugin example, by armcal, at the effects' values."""
    sys.path.insert(0, str(ROOT / "tests" / "data" / "scara_plugin" / "src"))
    try:
        from armcal_scara.model import ScaraArm
    finally:
        sys.path.pop(0)
    model = ScaraArm(ScaraArm.Settings.si(upper=LINKS_M[0], fore=LINKS_M[1], height=HEIGHT_M))
    masses = tuple(MassSpec(frame, mass, com, frame) for frame, _, mass, com in SCARA_MASSES)
    arm = Arm("arm", "scara", model, {name: effect for name, (effect, _) in effects.items()}, masses)
    tracker = TipPosition(TipPositionSettings.si(noise=0.001), ("arm",))
    parameters = Parameters((*arm.parameters(), *prefixed("t.", tracker.parameters())))
    values = parameters.nominal()
    for instance, (_, given) in effects.items():
        for name, value in given.items():
            values[parameters.entries_of(f"arm.{instance}.{name}")] = value
    parameters = parameters.with_nominal(values)
    channels = {f"arm.{joint}": q[:, i] for i, joint in enumerate(model.joint_names)}
    dataset = Dataset(tuple(map(str, range(len(q)))), {**channels, **columns})
    environment = Environment(tuple(gravity), force=(0.4, -0.2, 0.7))
    problem = Problem.build({"arm": arm}, {"t": tracker}, parameters, environment, dataset, "interpreted")
    return problem.of(dataset).predict(values)[0].outputs[:3].T


def scara_chain(count, growth=(1, 1, 1, 1)):
    parents = [
        oracle.shift(0, 0, growth[0] * HEIGHT_M, count),
        *(oracle.shift(f * length, 0, 0, count) for f, length in zip(growth[1:], LINKS_M, strict=False)),
    ]
    links = [chain_oracle.Link(parent) for parent in parents[:2]]
    links.append(chain_oracle.Link(parents[2], (0.0, 0.0, -1.0), slides=True))
    one = oracle.homogeneous(count)
    bodies = tuple(chain_oracle.Body(joint, one, mass, com, joint) for _, joint, mass, com in SCARA_MASSES)
    return chain_oracle.Chain(one, tuple(links), one, bodies)


NAMES = ("shoulder", "elbow", "quill")
MATRIX = np.array([[0.05, 0.01, -0.02], [0.01, 0.04, 0.005], [-0.02, 0.005, 0.06]])
GRAVITY = np.array([1.0, -9.0, -3.0])


def full(site):
    return site, in_all_directions(MATRIX)


def play_law(play, transition=0.05):
    return lambda t: play * t / np.hypot(t, transition)


SCARA_CASES = {
    "torsional_spring": (
        (TorsionalSprings(TorsionalSprings.Settings.si(base_axis="x"), NAMES), {"k0": 0.05, "k1": 0.02, "k3": 1e-3}),
        [(0, axis_law(lambda t: 0.05 * t, (1.0, 0, 0))), (1, axis_law(lambda t: 0.02 * t))],
        [(3, lambda f: 1e-3 * f)],
    ),
    "cubic_spring": (
        (CubicSprings(CubicSprings.Settings.si(), NAMES), {"c2": 0.03, "c3": 1e-4}),
        [(2, axis_law(lambda t: 0.03 * t**3))],
        [(3, lambda f: 1e-4 * f**3)],
    ),
    "torque_backlash": (
        (TorqueBacklash(TorqueBacklash.Settings.si(), NAMES), {"play1": 0.01, "play3": 2e-3}),
        [(1, axis_law(play_law(0.01)))],
        [(3, play_law(2e-3))],
    ),
    "compliance": (
        (
            Compliances(Compliances.Settings.si(compliance=0.01), NAMES),
            {f"C{i}": MATRIX[np.triu_indices(3)] for i in range(4)},
        ),
        [full(i) for i in range(4)],
        [],
    ),
    "bearing_play": (
        (BearingPlay(BearingPlay.Settings.si(), NAMES), {"tilt0": 0.004, "tilt3": 0.006}),
        [
            (site, lambda m, tilt=tilt: tilt * m / np.hypot(np.linalg.norm(m, axis=1, keepdims=True), 0.05))
            for site, tilt in ((0, 0.004), (3, 0.006))
        ],
        [],
    ),
}


@pytest.mark.quick("bearing_play", "cubic_spring", "torque_backlash", "torsional_spring")
@pytest.mark.parametrize("cases", [(name,) for name in SCARA_CASES] + [tuple(SCARA_CASES)], ids="+".join)
def test_springs_hold_a_sliding_joint_by_force_and_every_site_by_moment(cases):
    random = np.random.default_rng(30)
    q = np.column_stack([random.uniform(-1.5, 1.5, (20, 2)), random.uniform(0, 0.15, 20)])
    found = scara({name: SCARA_CASES[name][0] for name in cases}, q, GRAVITY)
    laws = [law for name in cases for law in SCARA_CASES[name][1]]
    slides = [slide for name in cases for slide in SCARA_CASES[name][2]]
    loads = oracle.Loads(gravity=GRAVITY, force=np.array([0.4, -0.2, 0.7]))
    np.testing.assert_allclose(
        found, chain_oracle.tip(scara_chain(20), q, loads, laws, slides), rtol=0, atol=AGREEMENT_M
    )


def test_displacements_on_a_sliding_joint_are_lengths():
    random = np.random.default_rng(31)
    q = np.column_stack([random.uniform(-1.5, 1.5, (20, 2)), random.uniform(-0.1, 0.15, 20)])
    approach, warm = random.choice([-1.0, 1.0], (20, 3)), random.uniform(0, 40, 20)
    effects = {
        "servo": (ServoMap(ServoMap.Settings.si(), NAMES), {"above3": 0.02, "below3": -0.03, "offset3": 1e-3}),
        "lag": (ApproachBacklash(ApproachBacklash.Settings.si(), NAMES), {"lag1": 0.01, "lag3": 5e-4}),
        "gear": (GearError(GearError.Settings.si(joints=("elbow",)), NAMES), {"cos2_2": 0.02}),
        "warm": (
            ThermalLength(ThermalLength.Settings.si(links="each"), NAMES),
            {"expansion1": 1e-3, "expansion3": 2e-3},
        ),
    }
    columns = {f"arm.approach.{name}": approach[:, i] for i, name in enumerate(NAMES)}
    found = scara(effects, q, GRAVITY, **columns, temperature=warm)
    moved = q.copy()
    moved[:, 2] += np.where(q[:, 2] > 0, 0.02, -0.03) * q[:, 2] + 1e-3 - 5e-4 * approach[:, 2]
    moved[:, 0] -= 0.01 * approach[:, 0]
    moved[:, 1] += 0.02 * (np.cos(2 * q[:, 1]) - 1)
    grown = scara_chain(20, (1 + 1e-3 * (warm - 20), 1.0, 1 + 2e-3 * (warm - 20)))
    np.testing.assert_allclose(found, chain_oracle.tip(grown, moved, oracle.Loads(gravity=GRAVITY)), rtol=0, atol=1e-12)


# ---------------------------------------------------------------- refused


def check(*settings, data=None):
    """``armcal check`` of the shipped demo with these settings."""
    arguments = ["check", str(CONFIGS / "demo.yaml"), *(x for s in settings for x in ("--set", s))]
    return CliRunner().invoke(cli, arguments + (["--data", str(data)] if data else []))


def table(angles="[-100, 0, 100]", pulses="[620, 1540, 2460]", joint="q1", **more):
    rest = "".join(f", {key}: {value}" for key, value in more.items())
    return f"{{type: quantisation, tables: {{{joint}: {{angles_deg: {angles}, pulses_us: {pulses}}}}}{rest}}}"


KINDS = (
    *("torsional_spring", "cubic_spring", "compliance", "servo_map"),
    *("approach_backlash", "torque_backlash", "bearing_play", "gear_error"),
)
BAD = {
    **{f"{kind} on an unknown joint": (f"{{type: {kind}, joints: [q3, q9]}}", ("q9", "q1")) for kind in KINDS},
    "a table for an unknown joint": (table(joint="elbow"), ("elbow", "q1")),
    "a joint that is no list": ("{type: servo_map, joints: q3}", ("joints",)),
    "torque_backlash, negative transition": ("{type: torque_backlash, transition_Nm: -0.1}", ("greater than 0",)),
    "torque_backlash, no transition": ("{type: torque_backlash, transition_Nm: 0}", ("greater than 0",)),
    "bearing_play, negative transition": ("{type: bearing_play, transition_Nm: -0.1}", ("greater than 0",)),
    "bearing_play, no transition": ("{type: bearing_play, transition_Nm: 0}", ("greater than 0",)),
    "a transition in another unit": ("{type: bearing_play, transition_mm: 1}", ("transition",)),
    "pulses that turn back": (table(pulses="[620, 1540, 1400]"), ("turn back",)),
    "pulses that stay": (table(pulses="[620, 620, 1400]"), ("turn back",)),
    "angles that fall": (table(angles="[100, 0, -100]"), ("rise",)),
    "more pulses than angles": (table(pulses="[620, 1540, 2000, 2460]"), ("3 angles and 4 pulses",)),
    "one point": (table(angles="[0]", pulses="[1500]"), ("two at least",)),
    "a prescale below the board's": (table(prescale=2), ("prescale", "3")),
    "a prescale above the board's": (table(prescale=256), ("prescale", "255")),
    "a prescale that is no whole number": (table(prescale=121.5), ("prescale",)),
    "an oscillator of another board": (table(oscillator_hz="1000000"), ("oscillator_hz",)),
    "a rate that the board's prescale cannot reach": (table(oscillator_hz="30000000", rate_hz=24), ("prescale",)),
    "pulses longer than the period": (table(rate_hz=1000), ("pulse",)),
    "a pulse of no length": (table(pulses="[0, 1540, 2460]"), ("pulse",)),
    "compliance at zero": ("{type: compliance, compliance_rad_per_Nm: 0}", ("greater than 0",)),
    "compliance below zero": ("{type: compliance, compliance_rad_per_Nm: -0.01}", ("greater than 0",)),
    "compliance in another unit": ("{type: compliance, compliance_mm: 1}", ("compliance",)),
    "a spring below zero": ("{type: torsional_spring, compliance_rad_per_Nm: -0.1}", ("below zero",)),
    "a base axis that is none": ("{type: torsional_spring, base_axis: w}", ("base_axis",)),
    "three gains": ("{type: servo_map, gains: three}", ("gains",)),
    "links neither one nor each": ("{type: thermal_length, links: some}", ("links",)),
    "a reference in another unit": ("{type: thermal_length, reference_mm: 20}", ("reference",)),
    "a setting that is none": ("{type: gear_error, periods: 3}", ("periods",)),
}


@pytest.mark.parametrize("case", BAD)
def test_bad_settings_of_an_effect_are_refused_with_their_place(case):
    setting, words = BAD[case]
    told = check(f"arms.arm.effects.e={setting}")
    text = " ".join(told.output.split())
    assert told.exit_code == 2, text
    assert "Traceback" not in text
    for word in words:
        assert word in text, (word, text)


VALUES = {
    "no semidefinite matrix": ("compliance, compliance_rad_per_Nm: 0.01", "arm.e.C3[xy]: 0.1 rad/Nm", "eigenvalue"),
    "a whole matrix as one number": ("compliance, compliance_rad_per_Nm: 0.01", "arm.e.C3: 0.1 rad/Nm", "entries"),
    "negative play": ("torque_backlash", "arm.e.play2: -0.1 deg", "outside"),
    "negative tilt": ("bearing_play", "arm.e.tilt0: -0.1 deg", "outside"),
    "links that shrink": ("thermal_length", "arm.e.expansion: -1e-5 1/K", "outside"),
    "a cubic compliance as a linear one": ("cubic_spring", "arm.e.c2: 0.1 rad/Nm", "rad"),
}


@pytest.mark.parametrize("case", VALUES)
def test_values_that_no_part_can_have_are_refused(case):
    kind, value, word = VALUES[case]
    name, _, text = value.partition(": ")
    told = check(f"arms.arm.effects.e={{type: {kind}}}", f'parameters.values={{"{name}": {text}}}')
    text = " ".join(told.output.split())
    assert told.exit_code == 2 and "Traceback" not in text and word in text, text
