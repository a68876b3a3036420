"""Denavit-Hartenberg arms against matrix products written here and against pinocchio."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from armcal.arm.model import forward
from armcal.errors import ConfigError
from armcal_mdh.model import MdhModel, MdhSettings
from pydantic import ValidationError

STEPS = ("x", "y", "z", "rx", "ry", "rz")
EXACT_M = 1e-12


def elementary(kind, amount):
    """One transform as a 4x4 matrix."""
    matrix = np.eye(4)
    if kind in "xyz":
        matrix["xyz".index(kind), 3] = amount
        return matrix
    i, j = {"rx": (1, 2), "ry": (2, 0), "rz": (0, 1)}[kind]
    matrix[i, i] = matrix[j, j] = np.cos(amount)
    matrix[j, i], matrix[i, j] = np.sin(amount), -np.sin(amount)
    return matrix


def product(*transforms):
    result = np.eye(4)
    for kind, amount in transforms:
        result = result @ elementary(kind, amount)
    return result


def dh_row(convention, alpha, a, theta, d):
    """One row of either convention."""
    across, along = (("rx", alpha), ("x", a)), (("rz", theta), ("z", d))
    if convention == "craig":
        return product(*across, *along)
    return product(*along, ("x", a), ("rx", alpha))


def random_settings(random, convention, joints=6):
    """An arm with every kind of row and extra transforms in every place."""

    def steps(most):
        chosen = [str(random.choice(STEPS)) for _ in range(random.integers(0, most + 1))]
        return [{kind: float(random.normal())} for kind in chosen]

    rows = [
        {
            **{name: float(random.normal()) for name in ("alpha", "a", "theta", "d")},
            "kind": "prismatic" if random.random() < 0.3 else "revolute",
            "before": steps(3),
            "after": steps(3),
        }
        for _ in range(joints)
    ]
    return {"convention": convention, "rows": rows, "base": steps(4), "tool": steps(4)}


def by_hand(config, q):
    """The tool and the frame after each row, and each joint's placement for pinocchio."""
    here, rows = product(*(next(iter(s.items())) for s in config["base"])), []
    for row, angle in zip(config["rows"], q, strict=True):
        here = here @ product(*(next(iter(s.items())) for s in row["before"]))
        turned = row["theta"] + (angle if row["kind"] == "revolute" else 0)
        slid = row["d"] + (angle if row["kind"] == "prismatic" else 0)
        here = here @ dh_row(config["convention"], row["alpha"], row["a"], turned, slid)
        here = here @ product(*(next(iter(s.items())) for s in row["after"]))
        rows.append(here)
    return here @ product(*(next(iter(s.items())) for s in config["tool"])), rows


def armcal_frames(model):
    """A function (values, q) -> tool and named frames, with every parameter a symbol."""
    blocks = model.parameters()
    values = ca.SX.sym("v", len(blocks))
    chain = model.chain({block.name: values[i] for i, block in enumerate(blocks)})
    q = ca.SX.sym("q", len(chain.joints))
    frames = forward(chain, [joint.offset + q[i] for i, joint in enumerate(chain.joints)], {})
    outputs = {"tool": frames.base_T_tool.matrix(), **{n: t.matrix() for n, t in frames.named.items()}}
    function = ca.Function("f", [values, q], [ca.densify(m) for m in outputs.values()], ["v", "q"], list(outputs))
    nominal = np.array([block.nominal[0] for block in blocks])
    return lambda q, v=nominal: {k: np.array(m) for k, m in function(v=v, q=q).items()}


def lrm_rows(*changes):
    """Two plain rows, changed in places: (row, key, value)."""
    rows = [{"alpha": 1.5, "d": 0.1}, {"a": 0.2}]
    for row, key, value in changes:
        rows[row][key] = value
    return rows


@pytest.mark.parametrize("arms", [12, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_random_arms_and_poses_agree_with_the_matrix_product_of_the_convention(convention, arms):
    """Random arms with revolute and prismatic joints and extra transforms, 20 poses each."""
    random = np.random.default_rng(1)
    for _ in range(arms):
        config = random_settings(random, convention)
        frames = armcal_frames(MdhModel(MdhSettings.si(**config)))
        for q in random.uniform(-3, 3, (20, 6)):
            tool, rows = by_hand(config, q)
            found = frames(q)
            np.testing.assert_allclose(found["tool"], tool, rtol=0, atol=EXACT_M * 10)
            np.testing.assert_allclose(found["row4"], rows[3], rtol=0, atol=EXACT_M * 10)


@pytest.mark.quick("craig-12")
@pytest.mark.parametrize("arms", [12, pytest.param(50, marks=pytest.mark.slow)])
@pytest.mark.parametrize("convention", ["standard", "craig"])
def test_random_arms_and_poses_agree_with_pinocchio(convention, arms):
    """20 poses of each arm; pinocchio's joints are put together from placements, one joint after the other."""
    pin = pytest.importorskip("pinocchio")
    random = np.random.default_rng(2)
    for _ in range(arms):
        config = random_settings(random, convention)
        model, tool = pinocchio_arm(pin, config)
        data, frames = model.createData(), armcal_frames(MdhModel(MdhSettings.si(**config)))
        for q in random.uniform(-3, 3, (20, 6)):
            pin.forwardKinematics(model, data, q)
            expected = data.oMi[model.njoints - 1].homogeneous @ tool
            np.testing.assert_allclose(frames(q)["tool"], expected, rtol=0, atol=EXACT_M * 10)


def pinocchio_arm(pin, config):
    """A pinocchio model, and the tool in its last joint's frame."""
    model, joint = pin.Model(), 0
    pending = product(*(next(iter(s.items())) for s in config["base"]))
    for row in config["rows"]:
        pending = pending @ product(*(next(iter(s.items())) for s in row["before"]))
        link = product(("rx", row["alpha"]), ("x", row["a"]))
        if config["convention"] == "craig":
            pending, link = pending @ link, np.eye(4)
        slides = row["kind"] == "prismatic"
        placement = pin.SE3(pending @ product(("rz", row["theta"]), ("z", row["d"])))
        kind = pin.JointModelPZ() if slides else pin.JointModelRZ()
        joint = model.addJoint(joint, kind, placement, f"j{model.njoints}")
        pending = link @ product(*(next(iter(s.items())) for s in row["after"]))
    return model, pending @ product(*(next(iter(s.items())) for s in config["tool"]))


@pytest.mark.slow
def test_the_shipped_arm_is_the_oracles_arm(lrm):
    import oracle

    model = lrm.experiment().system.arms["arm"].model
    frames, q = armcal_frames(model), oracle.random_poses(1000, 3)
    _, expected = oracle.poses(oracle.nominal(), q, np.zeros((len(q), 7)))
    for i, row in enumerate(q):
        found = frames(row)
        for name in ("tool", "upper_arm", "forearm", "hand", "row2", "row4"):
            np.testing.assert_allclose(found[name], expected[name][i], rtol=0, atol=EXACT_M)


def test_parameters_of_extra_transforms_on_one_axis_get_numbers_and_act_in_their_order():
    base = [{"z": 0.1}, {"rx": 0.3}, {"z": 0.2}, {"rx": 0.4}, {"z": 0.3}]
    model = MdhModel(MdhSettings.si(convention="standard", rows=lrm_rows(), base=base))
    names = [block.name for block in model.parameters()][:5]
    assert names == ["base_z", "base_rx", "base_z_2", "base_rx_2", "base_z_3"]
    assert [block.nominal[0] for block in model.parameters()][:5] == [0.1, 0.3, 0.2, 0.4, 0.3]
    values = np.array([block.nominal[0] for block in model.parameters()])
    values[:5] = 1, 2, 3, 4, 5
    expected = product(("z", 1), ("rx", 2), ("z", 3), ("rx", 4), ("z", 5), ("z", 0.1), ("rx", 1.5))
    np.testing.assert_allclose(armcal_frames(model)(np.zeros(2), values)["row1"], expected, rtol=0, atol=1e-14)


def test_extra_transforms_before_and_after_a_row_stand_on_their_own_side_of_the_joint():
    rows = lrm_rows((1, "before", [{"x": 0.3}]), (1, "after", [{"x": 0.05}, {"ry": 0.2}]))
    frames = armcal_frames(MdhModel(MdhSettings.si(convention="standard", rows=rows)))
    q = np.array([0.4, -0.7])
    first = product(("rz", q[0]), ("z", 0.1), ("rx", 1.5))
    expected = first @ product(("x", 0.3), ("rz", q[1]), ("x", 0.2), ("x", 0.05), ("ry", 0.2))
    np.testing.assert_allclose(frames(q)["row2"], expected, rtol=0, atol=1e-15)


def test_a_frame_marker_names_the_place_it_stands_at_and_the_joint_that_moves_it():
    rows = lrm_rows(
        (0, "before", [{"frame": "stand"}, {"z": 1.0}]),
        (0, "after", [{"x": 0.3}, {"frame": "middle"}, {"x": 0.4}]),
        (1, "before", [{"y": 0.1}, {"frame": "elbow"}]),
    )
    settings = MdhSettings.si(convention="standard", rows=rows, tool=[{"frame": "flange"}, {"z": 0.2}])
    model = MdhModel(settings)
    chain = model.chain({block.name: ca.SX(block.nominal[0]) for block in model.parameters()})
    moved_by = {name: at.joint for name, at in chain.frames.items()}
    assert moved_by == {"stand": 0, "middle": 1, "elbow": 1, "row1": 1, "row2": 2, "flange": 2}
    found = armcal_frames(model)(np.array([0.5, 0.6]))
    one = product(("z", 1.0), ("rz", 0.5), ("z", 0.1), ("rx", 1.5), ("x", 0.3))
    np.testing.assert_allclose(found["stand"], np.eye(4), rtol=0, atol=0)
    np.testing.assert_allclose(found["middle"], one, rtol=0, atol=1e-15)
    np.testing.assert_allclose(found["elbow"], one @ product(("x", 0.4), ("y", 0.1)), rtol=0, atol=1e-15)
    np.testing.assert_allclose(found["tool"], found["flange"] @ elementary("z", 0.2), rtol=0, atol=1e-15)


def test_angles_are_angles_and_lengths_are_lengths():
    steps = [{kind: 0.1} for kind in STEPS]
    rows = [{"before": steps, "after": steps}]
    model = MdhModel(MdhSettings.si(convention="craig", rows=rows, base=steps, tool=[*steps, *steps]))
    for block in model.parameters():
        last = block.name.removesuffix("_2").rpartition("_")[2]
        angular = last.startswith("r") or block.name in ("alpha1", "theta1")
        assert block.unit == ("rad" if angular else "m"), block.name
    assert len({block.name for block in model.parameters()}) == 4 + 6 * 5


def test_joints_are_called_as_configured_else_q1_to_qn():
    plain = MdhModel(MdhSettings.si(convention="craig", rows=lrm_rows()))
    assert plain.joint_names == ("q1", "q2")
    named = MdhModel(MdhSettings.si(convention="craig", rows=lrm_rows(), joints=["shoulder", "elbow"]))
    assert named.joint_names == ("shoulder", "elbow")


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"convention": None}, "convention"),
        ({"convention": "modified"}, "convention"),
        ({"rows": []}, "rows"),
        ({"joints": ["one"]}, "1 joint names for 2 rows"),
        ({"joints": ["one", "two", "three"]}, "3 joint names for 2 rows"),
        ({"joints": ["one", "one"]}, "one"),
        ({"base": [{"frame": "here"}]}, "base"),
        ({"tool": [{"frame": "row1"}]}, "row1"),
        ({"tool": [{"frame": "tool"}]}, "tool"),
        ({"tool": [{"frame": "a"}, {"frame": "a"}]}, "'a' is taken"),
        ({"tool": [{"x": 1.0, "y": 1.0}]}, "one transform"),
        ({"tool": [{}]}, "one transform"),
        ({"tool": [{"x": 1.0, "frame": "a"}]}, "one transform"),
        ({"tool": [{"w": 1.0}]}, "w"),
        ({"rows": lrm_rows((0, "kind", "screw"))}, "kind"),
    ],
    ids=str,
)
def test_an_arm_that_does_not_make_sense_is_refused(change, said):
    config = {"convention": "standard", "rows": lrm_rows(), **change}
    with pytest.raises(ValidationError, match=said):
        MdhSettings.si(**{key: value for key, value in config.items() if value is not None})


def test_a_configuration_without_a_convention_is_refused_before_anything_is_built(tmp_path):
    from armcal.run.experiment import Experiment

    text = "arms: {arm: {model: {type: mdh, rows: [{d_mm: 1}]}}}\nstatics: {gravity_m_s2: [0, 0, -9.81]}\n"
    path = tmp_path / "arm.yaml"
    path.write_text(text + "measurements: {t: {type: tip_position, noise_mm: 1}}\n", encoding="utf-8")
    with pytest.raises(ConfigError, match="convention"):
        Experiment.load(path)
