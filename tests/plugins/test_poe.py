"""Products of exponentials: against pinocchio's exponentials, on the group, with springs, and what poses determine."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import casadi as ca
import frida
import numpy as np
import pytest
from armcal.arm.assembly import Arm, ArmInputs
from armcal.arm.effects import JointEffect, Spring
from armcal.arm.model import Joint, forward
from armcal.arm.statics import Load, MassSpec, effort, wrenches
from armcal.base import se3
from armcal.base.domains import Direction
from armcal.base.parameters import Parameters
from armcal_poe.model import PoeModel, PoeSettings
from pydantic import ValidationError

EXACT_M = 1e-12
POSES = 10_000
MIXED = {
    "joints": [
        {"kind": "revolute", "axis": [0.1, -0.2, 1.0], "point_m": [0.1, 0.2, 0.0], "offset_deg": 25},
        {"kind": "prismatic", "axis": [1.0, 0.5, -0.3], "offset_mm": -30},
        {"kind": "revolute", "axis": [-1.0, 0.02, 0.1], "point_m": [0.3, 0.0, 0.5], "offset_deg": -70},
        {"kind": "prismatic", "axis": [0.0, 0.0, -1.0], "point_m": [0.1, 0.1, 0.1]},
        {"kind": "revolute", "axis": [0.0, 1.0, 0.0], "point_m": [0.5, 0.1, 0.3]},
    ],
    "tool": {"position_m": [0.6, -0.1, 0.2], "rpy_deg": [20, -40, 130]},
    "mount": {"position_m": [0.0, 0.1, -0.2], "rpy_deg": [10, 20, 30]},
}


def poe(config, **more):
    return PoeModel(PoeSettings.model_validate({**config, **more}))


def kinematics(model):
    """Parameters, and a function (entries, q) -> base_T_tool and the frames of the joints (4 x 4(n + 1))."""
    parameters = Parameters(model.parameters())
    entries = ca.SX.sym("entries", len(parameters.nominal()))
    chain = model.chain({b.name: entries[parameters.entries_of(b.name)] for b in parameters.blocks})
    q = ca.SX.sym("q", len(chain.joints))
    frames = forward(chain, [joint.offset + q[i] for i, joint in enumerate(chain.joints)], {})
    shown = [frames.base_T_tool.matrix(), *(frames.named[f"joint{i + 1}"].matrix() for i in range(len(chain.joints)))]
    return parameters, ca.Function("f", [entries, q], [ca.densify(ca.horzcat(*shown))])


def twists_of(model, parameters, values):
    """Each joint's twist (linear, angular as pinocchio has it), offset, and the tool, from canonical entries."""
    found = []
    for i in range(1, len(model.joint_names) + 1):
        offset = float(values[parameters.entries_of(f"offset{i}")][0])
        if f"axis{i}" in parameters.names:
            entries = values[parameters.entries_of(f"axis{i}")]
            twist = [*entries[3:], *entries[:3]] if len(entries) == 6 else [*entries, 0, 0, 0]
        else:
            names = [f"twist{i}_{e}" for e in ("vx", "vy", "vz", "wx", "wy", "wz")]
            twist = [float(values[parameters.entries_of(name)][0]) for name in names]
        found.append((np.array(twist, dtype=float), offset))
    return found


def by_exponentials(pin, model, parameters, values, q):
    position = [float(values[parameters.entries_of(f"tool_{axis}")][0]) for axis in "xyz"]
    w, *xyz = values[parameters.entries_of("tool_rotation")]
    here = pin.SE3.Identity()
    for (twist, offset), angle in zip(twists_of(model, parameters, values), q, strict=True):
        here = here * pin.exp6(twist * (angle + offset))
    return (here * pin.SE3(pin.Quaternion(w, *xyz).matrix(), np.array(position))).homogeneous


def moved(parameters, seed, size):
    """Entries some way from the nominal ones, in their domains."""
    free = parameters.with_free(parameters.names)
    return free.retract(np.random.default_rng(seed).normal(size=len(free.scales())) * size)


@pytest.mark.parametrize("parametrisation", ["minimal", "full"])
@pytest.mark.parametrize("config", [frida.model(), MIXED], ids=["frida", "mixed"])
@pytest.mark.quick("mixed-full")
def test_poses_are_products_of_pinocchios_exponentials(config, parametrisation):
    """Of nominal and of moved parameters: axes off the nominal ones, and twists with pitch and scale."""
    pin = pytest.importorskip("pinocchio")
    model = poe(config, parametrisation=parametrisation)
    parameters, function = kinematics(model)
    random = np.random.default_rng(1)
    for seed, size in enumerate((0.0, 0.03)):
        values = moved(parameters, seed, size)
        q = random.uniform(-3.1, 3.1, (POSES // 2, len(model.joint_names)))
        slides = [joint.kind == "prismatic" for joint in model._settings.joints]
        q[:, slides] *= 0.2
        found = np.asarray(function.map(len(q))(np.tile(values[:, None], len(q)), q.T).full())
        found = found.reshape(4, len(q), -1).transpose(1, 0, 2)[:, :, :4]
        expected = np.array([by_exponentials(pin, model, parameters, values, row) for row in q])
        np.testing.assert_allclose(found, expected, rtol=0, atol=EXACT_M)


def test_poses_are_those_of_pinocchios_unaligned_joints():
    pin = pytest.importorskip("pinocchio")
    config = {**MIXED, "joints": [{k: v for k, v in j.items() if "offset" not in k} for j in MIXED["joints"]]}
    model, robot, joint, placed = poe(config), pin.Model(), 0, pin.SE3.Identity()
    parameters, function = kinematics(model)
    for stated in config["joints"]:
        point = np.array(stated.get("point_m", [0, 0, 0]), dtype=float)
        axis = np.array(stated["axis"]) / np.linalg.norm(stated["axis"])
        kind = pin.JointModelRevoluteUnaligned if stated["kind"] == "revolute" else pin.JointModelPrismaticUnaligned
        here = pin.SE3(np.eye(3), point)
        joint = robot.addJoint(joint, kind(axis), placed.inverse() * here, f"j{robot.njoints}")
        placed = here
    data = robot.createData()
    nominal = parameters.nominal()
    tool = placed.inverse() * pin.SE3(np.asarray(function(nominal, np.zeros(5)))[:, :4])
    for q in np.random.default_rng(2).uniform(-3, 3, (1000, 5)):
        pin.forwardKinematics(robot, data, q)
        expected = (data.oMi[joint] * tool).homogeneous
        np.testing.assert_allclose(np.asarray(function(nominal, q))[:, :4], expected, rtol=0, atol=EXACT_M)


def test_joint_frames_stay_on_their_axes_at_the_point_nearest_to_the_one_given():
    model = poe(MIXED)
    parameters, function = kinematics(model)
    values = moved(parameters, 3, 0.1)
    offsets = [float(values[parameters.entries_of(f"offset{i}")][0]) for i in range(1, 6)]
    frames = np.asarray(function(values, -np.array(offsets)))[:, 4:].reshape(4, 5, 4).transpose(1, 0, 2)
    for i in (1, 3, 5):
        w, v = np.split(values[parameters.entries_of(f"axis{i}")], 2)
        frame, given = frames[i - 1], np.array(MIXED["joints"][i - 1]["point_m"])
        np.testing.assert_allclose(frame[:3, 2], w, atol=1e-14)
        np.testing.assert_allclose(np.cross(frame[:3, 3], w), v, atol=1e-14)
        assert abs((frame[:3, 3] - given) @ w) < 1e-14
    np.testing.assert_allclose(frames[1][:3, 2], values[parameters.entries_of("axis2")], atol=1e-14)


def test_an_axis_along_z_leaves_the_frame_of_its_joint_unturned():
    _, function = kinematics(poe(frida.model()))
    frame = np.asarray(function(Parameters(poe(frida.model()).parameters()).nominal(), np.zeros(7)))[:, 4:8]
    np.testing.assert_array_equal(frame, np.eye(4))


def test_a_general_motion_is_exact_up_to_a_whole_turn_and_its_slope_at_zero_is_the_twist():
    pin = pytest.importorskip("pinocchio")
    w, v, q = ca.SX.sym("w", 3), ca.SX.sym("v", 3), ca.SX.sym("q")
    motion = ca.densify(se3.turning_motion(w, v, q).matrix())
    function = ca.Function("f", [w, v, q], [motion])
    slope = ca.Function("s", [w, v, q], [ca.jacobian(ca.vec(motion), q)])
    random = np.random.default_rng(4)
    for _ in range(500):
        angular, linear = random.normal(size=3), random.normal(size=3)
        angular *= random.uniform(0.8, 1.2) / np.linalg.norm(angular)
        twist, angle = np.concatenate([linear, angular]), random.uniform(-2 * np.pi, 2 * np.pi) / 1.2
        expected = pin.exp6(twist * angle).homogeneous
        np.testing.assert_allclose(np.asarray(function(angular, linear, angle)), expected, rtol=0, atol=2e-14)
        at_zero = np.asarray(slope(angular, linear, 0)).reshape(4, 4).T
        stated = np.zeros((4, 4))
        stated[:3, :3], stated[:3, 3] = pin.skew(angular), linear
        np.testing.assert_allclose(at_zero, stated, rtol=0, atol=3e-16)


def test_a_whole_turn_comes_back_and_slides_by_its_pitch():
    turned = se3.turning_motion(ca.SX([0, 0, 1.0]), ca.SX([0.3, -0.2, 0.05]), 2 * np.pi)
    found = np.asarray(ca.evalf(ca.densify(turned.matrix())))
    expected = np.eye(4)
    expected[2, 3] = 0.05 * 2 * np.pi
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)


def test_a_sliding_twist_may_turn_a_little_and_is_smooth_where_it_does_not():
    pin = pytest.importorskip("pinocchio")
    w, v, q = ca.SX.sym("w", 3), ca.SX.sym("v", 3), ca.SX.sym("q")
    motion = ca.densify(se3.sliding_motion(w, v, q).matrix())
    function = ca.Function("f", [w, v, q], [motion, ca.jacobian(ca.vec(motion), w)])
    random = np.random.default_rng(5)
    for size in (0.0, 1e-9, 0.1, 0.9):
        angular, linear = random.normal(size=3), random.normal(size=3)
        angular *= size / np.linalg.norm(angular)
        pose, slope = function(angular, linear, 1.0)
        expected = pin.exp6(np.concatenate([linear, angular])).homogeneous
        np.testing.assert_allclose(np.asarray(pose), expected, rtol=0, atol=1e-14)
        for axis in range(3):
            step = 1e-6 * np.eye(3)[axis]
            ends = [pin.exp6(np.concatenate([linear, angular + s])).homogeneous for s in (step, -step)]
            rise = (ends[0] - ends[1]).T.ravel() / 2e-6
            np.testing.assert_allclose(np.asarray(slope)[:, axis], rise, rtol=0, atol=1e-8)


def test_directions_move_on_the_sphere_and_come_back():
    domain, random = Direction(), np.random.default_rng(6)
    for _ in range(50):
        base = random.normal(size=3)
        base, delta = base / np.linalg.norm(base), random.uniform(-1, 1, 2)
        there = domain.retract(base, delta)
        assert abs(np.linalg.norm(there) - 1) < 1e-15
        assert abs(there @ base - np.cos(np.linalg.norm(delta))) < 1e-14
        np.testing.assert_allclose(domain.local(base, there), delta, atol=1e-13)
        steps = [1e-6 * unit for unit in np.eye(2)]
        slope = [(domain.retract(base, delta + s) - domain.retract(base, delta - s)) / 2e-6 for s in steps]
        np.testing.assert_allclose(domain.retract_jacobian(base, delta), np.array(slope).T, atol=1e-9)
    assert "length 2" in domain.check(np.array([0.0, 0.0, 2.0]))


RANKS = [
    ("full", ["twist*", "tool_*"], 48, 48),
    ("full", ["twist*", "offset*"], 49, 48),
    ("minimal", ["axis*", "tool_*"], 34, 34),
    ("minimal", ["axis*", "offset*"], 35, 34),
]


def jacobian_of_poses(parametrisation, patterns):
    """Of 60 generic tip poses' logarithms by increments, whitened by the increments' scales."""
    parameters, function = kinematics(poe(frida.model(), parametrisation=parametrisation))
    free = parameters.with_free(parameters.select(patterns))
    entries, q = ca.SX.sym("entries", len(parameters.nominal())), ca.SX.sym("q", 7)
    pose, measured = function(entries, q)[:, :4], ca.SX.sym("measured", 4, 4)
    turn = ca.mtimes(measured[:3, :3].T, pose[:3, :3])
    vee = ca.vertcat(turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]) / 2
    residual = ca.vertcat(pose[:3, 3] - measured[:3, 3], vee)
    slope = ca.Function("slope", [entries, q, measured], [ca.jacobian(residual, entries)])
    chain = free.entries_jacobian(free.nominal()) * free.scales()
    rows = []
    for angles in np.random.default_rng(7).uniform(-2, 2, (60, 7)):
        here = function(free.nominal(), angles)[:, :4]
        rows.append(np.asarray(slope(free.nominal(), angles, here))[:, list(free.free_entries)] @ chain)
    return free, np.vstack(rows)


@pytest.mark.parametrize(("parametrisation", "patterns", "count", "rank"), RANKS)
def test_tip_poses_determine_as_much_as_they_can(parametrisation, patterns, count, rank):
    """The true ranks of one arm measured by full poses, which were not known when it was calibrated. [Bergstrom2016]"""
    _, jacobian = jacobian_of_poses(parametrisation, patterns)
    sizes = np.linalg.svd(jacobian, compute_uv=False)
    assert jacobian.shape[1] == count
    assert np.sum(sizes > 1e-10 * sizes[0]) == rank
    assert sizes[rank - 1] > 1e-5 * sizes[0]


def test_what_twists_and_offsets_leave_open_is_one_shift_of_joints_one_and_three_against_the_second_axis():
    """Turning the second axis about the first changes nothing if joints 1 and 3, parallel at zero, make up for it."""
    free, jacobian = jacobian_of_poses("full", ["twist*", "offset*"])
    null = np.linalg.svd(jacobian)[2][-1] * free.scales()
    involved = {name for name, part in zip(free.coordinate_names, null, strict=True) if abs(part) > 1e-9}
    assert involved == {"offset1", "offset3", "twist2_wx", "twist2_vy"}


def weights(chain, frames, force):
    """A mass on the tool and one on the second joint, with a force at the tool."""
    masses = [
        MassSpec("tip", ca.SX(0.7), ca.SX([0.1, 0.0, 0.05]), "tool"),
        MassSpec("mid", ca.SX(1.1), ca.SX([0, 0.2, 0.1]), "joint2"),
    ]
    load = Load(ca.SX([1.0, 2.0, -9.0]), ca.SX(0), ca.SX(3, 1), ca.SX(list(force)), ca.SX(3, 1))
    carried = wrenches(chain, frames, masses, load)
    points = [frames.base_T_tool.apply(masses[0].com), frames.named["joint2"].apply(masses[1].com)]
    work = sum((m.mass * ca.dot(p, load.gravity) for m, p in zip(masses, points, strict=True)), ca.SX(0))
    return carried, work + ca.dot(load.force, frames.base_T_tool.translation)


@pytest.mark.parametrize("parametrisation", ["minimal", "full"])
def test_the_effort_on_a_joint_is_the_work_per_displacement(parametrisation):
    """With twists of pitch and scale too: a spring on the joint's own axis bears the energy's slope."""
    model = poe(MIXED, parametrisation=parametrisation)
    parameters = Parameters(model.parameters())
    values = moved(parameters, 8, 0.3)
    chain = model.chain({b.name: ca.SX(values[parameters.entries_of(b.name)]) for b in parameters.blocks})
    q = ca.SX.sym("q", 5)
    frames = forward(chain, [q[i] for i in range(5)], {})
    carried, work = weights(chain, frames, (3.0, -1.0, 2.0))
    found = ca.vertcat(*[effort(j, frames.sites[i], carried[i]) for i, j in enumerate(chain.joints, 1)])
    off = ca.Function("off", [q], [found - ca.gradient(work, q)])
    for angles in np.random.default_rng(9).uniform(-0.8, 0.8, (20, 5)):
        assert float(ca.norm_inf(off(angles))) < 1e-13


class OwnSprings(JointEffect):
    """A linear spring on every joint's own axis."""

    def __init__(self, compliance):
        self.compliance = compliance

    def springs(self, values):
        return tuple(Spring(i, (), lambda load, command: self.compliance * load) for i in range(1, 6))


def test_springs_on_general_twists_settle_where_the_energy_is_least():
    """Total energy (springs, weights) has no slope at the equilibrium that the framework's own iteration finds."""
    model, compliance = poe(MIXED, parametrisation="full"), 0.002
    parameters = Parameters(model.parameters())
    values = moved(parameters, 10, 0.2)
    masses = (MassSpec("tip", 0.7, (0.1, 0.0, 0.05), "tool"), MassSpec("mid", 1.1, (0.0, 0.2, 0.1), "joint2"))
    arm = Arm("arm", "poe", model, {"spring": OwnSprings(compliance)}, masses)
    mass_blocks = {b.name: ca.SX(list(b.nominal)) for b in arm.parameters() if b.name.startswith("arm.links")}
    named = {f"arm.poe.{b.name}": ca.SX(values[parameters.entries_of(b.name)]) for b in parameters.blocks}
    state = ca.SX.sym("state", arm.deflection_size)
    angles = np.array([0.3, 0.1, -0.5, 0.05, 0.7])
    load = Load(ca.SX([1.0, 2.0, -9.0]), ca.SX(0), ca.SX(3, 1), ca.SX([3.0, -1.0, 2.0]), ca.SX(3, 1))
    inputs = ArmInputs(ca.SX(angles), ca.SX.zeros(5), load, state)
    step = ca.Function("step", [state], [arm.state({**named, **mass_blocks}, inputs).next_deflection])
    settled = ca.DM.zeros(5)
    for _ in range(60):
        settled = step(settled)
    chain = arm.chain({**named, **mass_blocks})
    moves = [joint.offset + angles[i] + state[i] for i, joint in enumerate(chain.joints)]
    _, work = weights(chain, forward(chain, moves, {}), (3.0, -1.0, 2.0))
    slope = ca.Function("slope", [state], [ca.gradient(ca.sumsqr(state) / (2 * compliance) - work, state)])
    assert float(ca.norm_inf(slope(settled))) < 1e-10
    assert float(ca.norm_inf(settled)) > 1e-3


def test_a_plain_joint_and_the_same_twist_move_alike():
    twist = (ca.SX([0, 0, 1.0]), ca.SX.zeros(3))
    plain = Joint("q", se3.identity())
    for angle in (0.0, 0.4, -2.5):
        off = plain.motion(ca.SX(angle)).matrix() - replace(plain, twist=twist).motion(ca.SX(angle)).matrix()
        assert float(ca.norm_inf(ca.evalf(ca.densify(off)))) < 1e-15


@pytest.mark.slow
@pytest.mark.parametrize("parametrisation", ["minimal", "full"])
def test_both_parametrisations_keep_the_contract(parametrisation):
    from armcal.plugins import Component
    from armcal.testing.contract import check_component

    class Made(PoeModel):
        EXAMPLE: ClassVar = {**PoeModel.EXAMPLE, "parametrisation": parametrisation}

    class Loaded(Component):
        def load(self):
            return Made

    results = check_component(Loaded("model", "poe", "armcal_poe.model:PoeModel", "", "poe"))
    assert [f"{r.check}: {r.fault}" for r in results if r.fault] == []
    assert len(results) > 10


def test_a_printed_rotation_is_taken_for_the_nearest_proper_one():
    blocks = {b.name: b for b in poe(frida.model(tool=frida.BASE)).parameters()}
    q = np.array(blocks["tool_rotation"].nominal)
    assert abs(np.linalg.norm(q) - 1) < 1e-15


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"joints": []}, "joints"),
        ({"joints": [{"axis": [0, 0, 1], "point_m": [0, 0, 0]}]}, "kind"),
        ({"joints": [{"kind": "revolute", "axis": [0, 0, 0], "point_m": [0, 0, 0]}]}, "axis of length 0"),
        ({"joints": [{"kind": "revolute", "axis": [0, 0, 1]}]}, "point"),
        ({"joints": [{"kind": "revolute", "axis": [0, 0, 1], "point": [0, 0, 0]}]}, "unit"),
        ({"joints": [{"kind": "revolute", "axis": [0, 0, 1], "point_m": [0, 0, 0], "offset_mm": 3}]}, "offset"),
        ({"joints": [{"kind": "prismatic", "axis": [0, 0, 1], "offset_deg": 3}]}, "offset"),
        ({"joints": [{"kind": "prismatic", "axis": [0, 0, 1], "name": "q2"}] * 2}, "stands twice"),
        ({"joints": [{"kind": "prismatic", "axis": [0, 0, 1], "name": "a.b"}]}, "without a dot"),
        ({"tool": None}, "tool"),
        ({"tool": {"position_m": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, 0.99]]}}, "no rotation"),
        ({"tool": {"position_m": [0, 0, 0], "rotation": [[1, 0, 0], [0, 1, 0], [0, 0, -1]]}}, "reflection"),
        ({"parametrisation": "most"}, "parametrisation"),
    ],
    ids=str,
)
def test_an_arm_that_does_not_make_sense_is_refused(change, said):
    config = {key: value for key, value in {**frida.model(), **change}.items() if value is not None}
    with pytest.raises(ValidationError, match=said):
        PoeSettings.model_validate(config)


CALIBRATION = """
arms: {arm: {model: MODEL}}
statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.05}}
data: {type: csv, path: measured.csv}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 5
  poses:
    kind: random
    count: 120
    levels_rad: {q1: [-2, 2], q3: [-2, 2], q5: [-2, 2]}
    travel_mm: {q2: [-200, 200], q4: [-200, 200]}
parameters: {free: ["arm.poe.axis?", "arm.poe.tool_?"]}
estimator: {type: ipopt}
"""


@pytest.mark.slow
def test_axes_are_found_by_calibration(tmp_path):
    """Offsets that are wrong in truth turn every axis beyond them; the axes that are found make up for it."""
    import json

    from armcal.calibration.calibration import Calibration
    from armcal.cli.main import cli
    from click.testing import CliRunner

    path = tmp_path / "experiment.yaml"
    path.write_text(CALIBRATION.replace("MODEL", json.dumps({"type": "poe", **MIXED})), encoding="utf-8")
    wrong = {"offset1": 0.03, "offset3": -0.05, "offset4": 0.01}
    nominal = {b.name: b.nominal[0] for b in poe(MIXED).parameters()}
    units = {name: "m" if name == "offset4" else "rad" for name in wrong}
    truth = [f"arm.poe.{name}: {nominal[name] + by!r} {units[name]}\n" for name, by in wrong.items()]
    (tmp_path / "truth.yaml").write_text("".join(truth), encoding="utf-8")
    for command in (
        ["simulate", str(path), "--out", str(tmp_path / "measured.csv")],
        ["run", str(path), "--out", str(tmp_path / "run"), "--set", "evaluator=interpreted"],
    ):
        done = CliRunner().invoke(cli, command)
        assert done.exit_code == 0, done.output
    calibration = Calibration.load(tmp_path / "run" / "calibration.yaml")
    for name in calibration.parameters.names:
        if ".axis" in name:
            block = calibration.parameters[name]
            assert block.domain.check(np.array(block.nominal)) == ""
    parameters, function = kinematics(poe(MIXED))
    values = parameters.nominal()
    for name, by in wrong.items():
        values[parameters.entries_of(name)] += by
    q = np.random.default_rng(12).uniform(-1, 1, (50, 5)) * [2, 0.2, 2, 0.2, 2]
    expected = np.array([np.asarray(function(values, row))[:3, 3] for row in q])
    assert np.abs(calibration.forward(q)[:, :3, 3] - expected).max() < 1e-4
