"""A calibrated arm as expressions: against the calibration's own predictions, finite differences and plain formulas."""

from __future__ import annotations

from dataclasses import replace

import casadi as ca
import numpy as np
import pytest
from armcal.arm.statics import LOAD_CHANNELS
from armcal.calibration.compensation import Compensator, Options
from armcal.calibration.inverse import slope_function
from armcal.errors import NotConvergedError
from made_calibrations import made_calibration
from scipy.spatial.transform import Rotation
from small_arms import CONFIGS, calibration, compensator, drawn, predicted, with_options

COUNT = 12
ARMS = ["three", "rigid", "play", "five", "lift", "lrm", "best", "seven"]
LOADS = {
    "payload": 0.15,
    **dict(zip(("payload_x", "payload_y", "payload_z"), (0.01, -0.02, 0.03), strict=True)),
    **dict(zip(("gravity_x", "gravity_y", "gravity_z"), (2.0, -3.0, -8.0), strict=True)),
    **dict(zip(("force_x", "force_y", "force_z"), (0.4, -0.3, 0.2), strict=True)),
    **dict(zip(("torque_x", "torque_y", "torque_z"), (0.02, 0.01, -0.03), strict=True)),
}


def acting(count: int) -> np.ndarray:
    """All loads at once (LOAD_CHANNELS x N), as a calibration's records say them."""
    return np.repeat(np.array([LOADS[channel] for channel in LOAD_CHANNELS])[:, None], count, axis=1)


def apart(one: np.ndarray, two: np.ndarray) -> float:
    return float(np.abs(one - two).max())


@pytest.mark.quick("rigid")
@pytest.mark.parametrize("name", ARMS)
def test_the_tool_is_where_the_calibration_predicts_it(name: str) -> None:
    """Under what the configuration states, and under every load at once, coming from either side."""
    found = compensator(name)
    commands = drawn(found, COUNT)
    assert apart(found.forward(commands), predicted(calibration(name), commands)) < 1e-12
    sides = np.random.default_rng(2).integers(-1, 2, commands.shape).astype(float)
    told = {f"arm.approach.{joint}": sides[:, i] for i, joint in enumerate(found.joints)}
    expected = predicted(calibration(name), commands, **LOADS, **told)
    assert apart(found.forward(commands, acting(COUNT), sides), expected) < 1e-12


def test_the_side_from_which_joints_come_matters_where_they_have_play() -> None:
    found = compensator("play")
    commands = drawn(found, COUNT)
    ones = np.ones_like(commands)
    assert apart(found.forward(commands, approach=ones), found.forward(commands, approach=-ones)) > 1e-4
    assert found.expression.uses(["approach.q2"])
    assert not compensator("three").expression.uses([f"approach.q{i}" for i in (1, 2, 3)])
    assert not compensator("rigid").expression.uses(LOAD_CHANNELS)
    assert compensator("three").expression.uses(["payload"])


def test_gravity_that_is_calibrated_to_be_tilted_pulls_that_way() -> None:
    given = calibration("three")
    values = given.parameters.nominal()
    for axis, tilt in (("rx", 0.2), ("ry", -0.3)):
        values[given.parameters.entries_of(f"statics.gravity_{axis}")] = tilt
    tilted = replace(given, parameters=given.parameters.with_nominal(values))
    found = tilted.compensator(choice="interpreted")
    commands = drawn(found, COUNT)
    assert apart(found.forward(commands), predicted(tilted, commands)) < 1e-12
    turned = Rotation.from_euler("xy", [0.2, -0.3]).apply([0, 0, -9.81])
    stated = {f"gravity_{axis}": turned[i] for i, axis in enumerate("xyz")}
    assert apart(found.forward(commands), predicted(given, commands, **stated)) < 1e-12
    assert apart(found.forward(commands), compensator("three").forward(commands)) > 1e-5


@pytest.mark.slow
def test_both_arms_of_two_stand_where_they_are_predicted() -> None:
    both = made_calibration(CONFIGS / "frida" / "dual_twists.yaml")
    commands = np.random.default_rng(4).uniform(-1, 1, (COUNT, 7))
    assert tuple(both.system.arms) == ("left", "right")
    for arm in both.system.arms:
        found = both.compensator(arm, choice="interpreted")
        assert apart(found.forward(commands), both.forward(commands, arm)) < 1e-12
        had = found.solve(found.targets(both.forward(commands, arm)[:, :3, 3]))
        assert had.reached.all()
        assert apart(both.forward(had.joint_angles, arm)[:, :3, 3], both.forward(commands, arm)[:, :3, 3]) < 1e-9


MIMIC = """<robot name="gripper">
  <link name="base"/><link name="arm"/><link name="slide"/><link name="finger"/>
  <joint name="turn" type="revolute"><parent link="base"/><child link="arm"/><origin xyz="0 0 0.1"/>
    <axis xyz="0 1 0"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="out" type="prismatic"><parent link="arm"/><child link="slide"/><origin xyz="0.2 0 0"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="follows" type="revolute"><parent link="slide"/><child link="finger"/><origin xyz="0.1 0 0"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="1" velocity="1"/>
    <mimic joint="turn" multiplier="-0.7" offset="0.2"/></joint>
  <link name="tip"/>
  <joint name="end" type="fixed"><parent link="finger"/><child link="tip"/><origin xyz="0.15 0 0"/></joint>
</robot>"""


def test_a_joint_that_follows_another_is_not_commanded_and_moves_all_the_same(tmp_path) -> None:
    (tmp_path / "arm.urdf").write_text(MIMIC, encoding="utf-8")
    (tmp_path / "arm.yaml").write_text(
        "arms: {arm: {model: {type: urdf, path: arm.urdf, tip: tip}}}\n"
        "statics: {gravity_m_s2: [0, 0, -9.81], payload_g: 0}\n"
        "measurements: {tracker: {type: tip_position, noise_mm: 0.5}}\nestimator: {type: ipopt}\n",
        encoding="utf-8",
    )
    given = made_calibration(tmp_path / "arm.yaml")
    found = given.compensator(choice="interpreted")
    assert found.joints == ("turn", "out")
    commands = drawn(found, COUNT)
    tools = found.forward(commands)
    assert apart(tools, predicted(given, commands)) < 1e-12
    had = found.solve(found.targets(tools[:, :3, 3]))
    assert had.reached.all()
    assert apart(predicted(given, had.joint_angles)[:, :3, 3], tools[:, :3, 3]) < 1e-9
    assert (had.joint_angles >= found.limits[:, 0]).all()
    assert (had.joint_angles <= found.limits[:, 1]).all()


def test_lengths_grow_with_the_temperature_that_is_told() -> None:
    given = calibration("warm")
    found = given.compensator(conditions=("temperature",), choice="interpreted")
    commands = drawn(found, COUNT)
    told = np.linspace(-10, 40, COUNT)
    tools = found.forward(commands, conditions={"temperature": told})
    assert apart(tools, predicted(given, commands, temperature=told)) < 1e-12
    assert apart(found.forward(commands, conditions={"temperature": 20.0}), predicted(given, commands)) < 1e-12
    had = found.solve(found.targets(tools[:, :3, 3], conditions={"temperature": told}))
    assert had.reached.all()
    reached = predicted(given, had.joint_angles, temperature=told)
    assert apart(reached[:, :3, 3], tools[:, :3, 3]) < 1e-9


def test_surroundings_must_be_told_as_they_were_asked_for() -> None:
    """Zero degrees are no answer to what was not said."""
    found = calibration("warm").compensator(conditions=("temperature",), choice="interpreted")
    with pytest.raises(ValueError, match="tell nothing of the surroundings, expected temperature"):
        found.solve(found.targets(np.zeros((1, 3))))
    with pytest.raises(ValueError, match="expected temperature"):
        found.forward(np.zeros((1, 3)))
    with pytest.raises(ValueError, match="tell temperature of the surroundings, expected nothing"):
        compensator("three").solve(compensator("three").targets(np.zeros((1, 3)), conditions={"temperature": 20.0}))


@pytest.mark.parametrize("name", ["three", "play", "lift", "lrm", "best"])
@pytest.mark.quick("best")
def test_slopes_are_those_of_finite_differences(name: str) -> None:
    """In elastic equilibrium, away from zero where some effects branch."""
    found = compensator(name)
    commands = drawn(found, 4, seed=5) + 0.01
    record = np.repeat(found.expression.defaults[:, None], 4, axis=1)
    record[: len(found.joints)] = commands.T
    states = found._equilibrium(record).states
    h = 1e-6
    slopes = np.asarray(slope_function(found.expression, True).map(4)(record, states).full())
    slopes = slopes.reshape(len(found.joints), 6, 4).transpose(2, 1, 0)
    for joint in range(len(found.joints)):
        step = np.zeros(len(found.joints))
        step[joint] = h
        ahead, behind = found.forward(commands + step), found.forward(commands - step)
        moved = (ahead - behind)[:, :3, 3] / (2 * h)
        assert apart(slopes[:, :3, joint], moved) < 1e-7
        turned = Rotation.from_matrix(ahead[:, :3, :3] @ behind[:, :3, :3].transpose(0, 2, 1)).as_rotvec() / (2 * h)
        assert apart(slopes[:, 3:, joint], turned) < 1e-7


def test_to_equilibrium_solves_what_it_says() -> None:
    expression = compensator("best").expression
    right = expression.next_state - expression.state
    solved = expression.to_equilibrium(right)[0]
    record = np.random.default_rng(3).uniform(-0.5, 0.5, expression.record.numel())
    state = np.random.default_rng(4).uniform(-0.01, 0.01, expression.state.numel())
    found = ca.Function("parts", [expression.record, expression.state], [expression.slope(), right, solved])
    slope, given, answer = (np.asarray(each.full()) for each in found(record, state))
    assert apart((np.eye(len(state)) - slope) @ answer, given) < 1e-13


def test_channels_are_in_the_order_that_is_written_down() -> None:
    expression = calibration("warm").expression(conditions=("temperature",))
    joints = ("q1", "q2", "q3")
    assert expression.channels == (*joints, *(f"approach.{j}" for j in joints), *LOAD_CHANNELS, "temperature")
    said = dict(zip(expression.channels, expression.defaults, strict=True))
    assert said["gravity_z"] == -9.81
    assert not any(value for name, value in said.items() if name != "gravity_z")
    assert expression.commands.numel() == 3
    assert expression.acting.numel() == len(LOAD_CHANNELS)


def test_steps_of_servos_are_left_out_and_told() -> None:
    """The expression is smooth; ``forward`` takes the counts, and so does the prediction."""
    given, found = calibration("servos"), compensator("servos")
    assert set(found.expression.servos) == {"q1", "q2", "q3"}
    assert set(compensator("mixed").expression.servos) == {"q1", "q3"}
    assert not compensator("three").expression.servos
    commands = drawn(found, 200)
    assert apart(found.forward(commands), predicted(given, commands)) < 1e-12
    smooth = replace(found.expression, servos={})
    exact = Compensator(smooth, given.parameters, Options(), choice="interpreted").forward(commands)
    assert 1e-4 < apart(found.forward(commands), exact) < 2e-2


def test_efforts_are_what_gravity_does_about_the_axes() -> None:
    """By energy: the torque about a joint is how fast the masses' height grows as it turns, rigid arm."""
    given = made_calibration_without_springs()
    found = given.compensator(choice="interpreted")
    commands = drawn(found, 6)
    function = ca.Function("efforts", [found.expression.record], [found.expression.efforts])
    for q in commands:
        record = found.expression.defaults.copy()
        record[:3] = q
        held = np.asarray(function(record).full()).ravel()
        for joint in range(3):
            step = np.zeros(3)
            step[joint] = 1e-6
            lifted = (found.forward(q + step)[0, 2, 3] - found.forward(q - step)[0, 2, 3]) / 2e-6
            assert held[joint] == pytest.approx(-0.25 * 9.81 * lifted, abs=1e-8)


def made_calibration_without_springs():
    """The rigid arm whose only mass, 250 g, hangs on the tool."""
    given = calibration("rigid", "statics.payload_g=250", "arms.arm.links={}")
    assert given.system.environment.payload_mass == 0.25
    return given


def test_an_arm_whose_springs_cannot_hold_it_has_no_tool() -> None:
    heavy = compensator("three")
    load = acting(1) * 0
    load[3], load[2] = 300.0, -9.81
    with pytest.raises(NotConvergedError, match="command 1 did not settle"):
        heavy.forward(np.array([[0.0, 0.3, 0.2]]), load)


@pytest.mark.slow
def test_moving_the_base_moves_the_targets_and_not_the_commands() -> None:
    """Gravity turned with it."""
    plain, moved = calibration("three"), calibration("three", "arms.arm.placement={position_mm: [500, 0, 200]}")
    one, two = compensator("three"), moved.compensator(choice="interpreted")
    commands = drawn(one, COUNT)
    assert "arm.placement_x" in moved.parameters.names
    values = moved.parameters.nominal()
    for entry, value in zip(plain.parameters.entry_names, plain.parameters.nominal(), strict=True):
        values[moved.parameters.entry_names.index(entry)] = value
    shift = np.array([0.5, 0.0, 0.2])
    for i, axis in enumerate("xyz"):
        values[moved.parameters.entries_of(f"arm.placement_{axis}")] = shift[i]
    same = replace(moved, parameters=moved.parameters.with_nominal(values))
    two = same.compensator(options=with_options("three", Options()).options, choice="interpreted")
    here, there = one.forward(commands), two.forward(commands)
    assert apart(here[:, :3, 3] + shift, there[:, :3, 3]) < 1e-12
    first = one.solve(one.targets(here[:, :3, 3]), commands[0])
    second = two.solve(two.targets(there[:, :3, 3]), commands[0])
    assert first.reached.all()
    assert apart(first.joint_angles, second.joint_angles) < 1e-6


def test_a_condition_that_the_arm_does_not_change_with_is_refused() -> None:
    with pytest.raises(ValueError, match="the arm arm does not change with humidity; it changes with temperature"):
        calibration("warm").compensate(np.array([[0.2, 0.1, 0.2]]), payload=0.0, conditions={"humidity": 0.4})
    with pytest.raises(ValueError, match="does not change with temperature; it changes with nothing"):
        calibration("three").expression(conditions=("temperature",))


def test_the_shortest_call_takes_conditions_too() -> None:
    position = np.array([[0.2, 0.1, 0.2]])
    given = calibration("warm")
    cold = given.compensate(position, payload=0.0)
    warm = given.compensate(position, payload=0.0, conditions={"temperature": 80.0})
    for commands, told in ((cold, {}), (warm, {"temperature": 80.0})):
        assert apart(predicted(given, commands.joint_angles, **told)[:, :3, 3], position) < 1e-8
    assert apart(warm.joint_angles, cold.joint_angles) > 1e-4
