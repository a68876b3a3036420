"""Commands for targets: exact where they can be reached, else nearest, on paths, and in counts."""

from __future__ import annotations

from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from armcal.arm.servo import quantised
from armcal.calibration.compensation import SEEDS, Commands, Compensator, Options, Targets, with_sides
from armcal.calibration.inverse import Seeds, Solutions
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import Equilibrium
from armcal.functions.compiler import find_compiler
from scipy.optimize import least_squares, minimize
from scipy.spatial.transform import Rotation
from small_arms import LRM_LIMITS, calibration, compensator, drawn, exact, predicted, with_options

NEAR_M, NEAR_RAD = 1e-9, 1e-8
NARROW = {f"q{i}": (-1.2, 1.2) for i in range(1, 6)}


def of(found: Compensator, commands: np.ndarray, turns: bool = False, **told) -> Targets:
    """Targets that the arm has at these commands."""
    tools = found.forward(commands, acting(found, len(commands), **told))
    return found.targets(tools[:, :3, 3], tools[:, :3, :3] if turns else None, **told)


def acting(found: Compensator, count: int, **told) -> np.ndarray:
    return found.targets(np.zeros((count, 3)), **told).acting


def arrives(found: Compensator, targets: Targets, commands: Commands, name: str) -> None:
    """All are reached, within the limits, and the calibration's own prediction agrees."""
    assert commands.reached.mean() >= 0.999
    assert set(commands.reasons) == {""}
    assert commands.distances.max() <= NEAR_M
    assert commands.turns.max() <= NEAR_RAD
    assert within(found, commands)
    sides = {f"arm.approach.{joint}": commands.approach[:, i] for i, joint in enumerate(found.joints)}
    tools = predicted(calibration(name), commands.joint_angles, payload=targets.acting[3], **sides)
    assert np.abs(tools - commands.base_T_tool).max() < 1e-10
    assert np.linalg.norm(tools[:, :3, 3] - targets.positions, axis=1).max() < 2 * NEAR_M
    if targets.rotations is not None:
        left = Rotation.from_matrix(tools[:, :3, :3].transpose(0, 2, 1) @ targets.rotations).magnitude()
        assert left.max() < 2 * NEAR_RAD


def within(found: Compensator, commands: Commands) -> bool:
    low, high = found.limits.T
    return bool(((commands.joint_angles >= low - 1e-12) & (commands.joint_angles <= high + 1e-12)).all())


@pytest.mark.quick("False-rigid", "False-three", "True-lift", "True-play", "True-rigid")
@pytest.mark.parametrize("name", ["three", "rigid", "play", "five", "lift", "lrm", "seven"])
@pytest.mark.parametrize("turns", [False, True])
def test_what_the_arm_reaches_is_found_again(name: str, turns: bool) -> None:
    """Positions and whole poses; on arms with fewer joints than a pose has numbers too."""
    found = compensator(name)
    targets = of(found, drawn(found, 70), turns)
    arrives(found, targets, found.solve(targets), name)


@pytest.mark.slow
def test_it_is_found_again_with_every_effect_and_whatever_hangs_on_the_tool() -> None:
    found = compensator("best")
    targets = of(found, drawn(found, 12), payload=0.1)
    arrives(found, targets, found.solve(targets), "best")


def test_each_target_has_its_own_load() -> None:
    """One payload a row gives what each row alone gives."""
    found, payloads = compensator("three"), np.linspace(0, 0.4, 6)
    positions = found.forward(drawn(found, 6))[:, :3, 3]
    together = found.solve(found.targets(positions, payload=payloads))
    arrives(found, found.targets(positions, payload=payloads), together, "three")
    for i in range(6):
        alone = found.solve(found.targets(positions[i], payload=payloads[i]))
        assert np.abs(alone.joint_angles[0] - together.joint_angles[i]).max() < 1e-7
    assert np.abs(together.joint_angles - found.solve(found.targets(positions)).joint_angles).max() > 1e-4


def test_the_arm_hangs_the_other_way_where_gravity_does() -> None:
    found = compensator("three")
    up = found.targets(found.forward(drawn(found, 5))[:, :3, 3], gravity=np.array([0, 0, 9.81]))
    commands = found.solve(up)
    loads = {f"gravity_{axis}": value for axis, value in zip("xyz", (0, 0, 9.81), strict=True)}
    tools = predicted(calibration("three"), commands.joint_angles, **loads)
    assert np.abs(tools[:, :3, 3] - up.positions).max() < 2 * NEAR_M


def test_the_same_question_has_the_same_answer_in_any_order() -> None:
    found = compensator("five")
    targets = of(found, drawn(found, 40))
    order = np.random.default_rng(3).permutation(40)
    one, two = found.solve(targets), found.solve(targets)
    other = found.solve(targets.subset(order))
    assert (one.joint_angles == two.joint_angles).all()
    assert np.abs(other.joint_angles - one.joint_angles[order]).max() < 1e-7
    fresh = with_options("five", Options()).solve(targets)
    assert (fresh.joint_angles == one.joint_angles).all()


@pytest.mark.slow
def test_other_random_starts_find_all_targets_too() -> None:
    for seed in (1, 2):
        found = with_options("lrm", Options(limits=LRM_LIMITS, seed=seed))
        commands = found.solve(of(found, drawn(found, 20, seed=seed), turns=True))
        assert commands.reached.all()


def test_where_the_arm_stands_is_its_own_nearest_command() -> None:
    for name in ("five", "lrm", "seven"):
        found = compensator(name)
        commands = drawn(found, 5, seed=9)
        for turns in (False, True):
            assert np.abs(found.solve(of(found, commands, turns), commands).joint_angles - commands).max() < 2e-5


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler is here")
def test_c_and_the_interpreter_find_the_same() -> None:
    interpreted = compensator("rigid")
    compiled = calibration("rigid").compensator(choice="compiled")
    assert compiled._equilibrium._evaluator._pass.compiled
    targets = of(interpreted, drawn(interpreted, 30))
    assert np.abs(interpreted.solve(targets).joint_angles - compiled.solve(targets).joint_angles).max() < 1e-7


# -- what cannot be reached --------------------------------------------------------------------------------------------


def nearest_by_scipy(found: Compensator, position: np.ndarray, known: np.ndarray) -> float:
    """How near the arm comes (m), by bounded least squares from what is known and from elsewhere."""
    low, high = np.clip(found.limits, -3.5, 3.5).T
    starts = [np.clip(known, low + 1e-6, high - 1e-6), *np.random.default_rng(0).uniform(low, high, (2, len(low)))]
    tries = [
        least_squares(lambda q: found.forward(q)[0, :3, 3] - position, start, bounds=(low, high), max_nfev=25)
        for start in starts
    ]
    return min(float(np.linalg.norm(each.fun)) for each in tries)


@pytest.mark.parametrize("name", ["three", "five", "lrm"])
@pytest.mark.slow
def test_beyond_its_reach_the_arm_comes_as_near_as_it_can(name: str) -> None:
    found = compensator(name)
    positions = np.array([[1.5, 0.2, 0.1], [0.1, -0.2, 0.9], [-0.4, 0.5, -0.6]])
    commands = found.solve(found.targets(positions))
    tried = found.forward(drawn(found, 1000, widest=np.pi))[:, :3, 3]
    assert not commands.reached.any()
    for i, position in enumerate(positions):
        assert "out of reach: no command comes nearer than" in commands.reasons[i]
        assert commands.bounds[i] <= np.linalg.norm(tried - position, axis=1).min()
        other = nearest_by_scipy(found, position, commands.joint_angles[i])
        assert commands.bounds[i] <= commands.distances[i] <= other + 2e-4
        assert np.linalg.norm(commands.base_T_tool[i, :3, 3] - position) == pytest.approx(commands.distances[i])


def test_too_near_is_out_of_reach_too() -> None:
    """Links of 600 mm and 200 mm leave a hole in the middle."""
    found = calibration("two_links").compensator(choice="interpreted")
    commands = found.solve(found.targets(np.array([[0.1, 0.0, 0.0], [0.5, 0.1, 0.0]])))
    assert commands.reached.tolist() == [False, False]
    assert commands.bounds[0] == pytest.approx(found.reach.nearest - 0.1, abs=5e-3)
    other = nearest_by_scipy(found, np.array([0.1, 0, 0]), commands.joint_angles[0])
    assert commands.bounds[0] <= commands.distances[0] <= other + 1e-6
    assert "out of reach" in commands.reasons[0]
    assert commands.bounds[1] == 0


def test_nothing_is_said_of_the_reach_where_nothing_is_known() -> None:
    """Sliding joints without limits, and axes beside their frames."""
    assert compensator("lift").reach.farthest == np.inf
    assert compensator("lift").reach.bounds(np.array([[9.0, 0, 0]])) == 0
    assert np.isfinite(compensator("five").reach.farthest)


def test_limits_are_kept_and_named() -> None:
    free = compensator("three")
    found = with_options("three", Options(limits={"q1": (-0.5, 0.5), "q2": (0.0, 1.0)}))
    targets = of(free, np.array([[1.0, 0.5, 0.4], [-1.5, 0.3, 0.2], [0.2, 0.6, 0.3]]))
    commands = found.solve(targets)
    assert commands.reached.tolist() == [False, False, True]
    assert within(found, commands)
    for i in range(2):
        assert "no command was found that reaches it; the nearest has q1" in commands.reasons[i]
        other = nearest_by_scipy(found, targets.positions[i], commands.joint_angles[i])
        assert commands.distances[i] <= other + 1e-6
        assert commands.bounds[i] == 0


def test_a_rotation_that_cannot_be_had_is_told_from_a_position_that_cannot() -> None:
    found = compensator("three")
    place = found.forward(np.array([[0.3, 0.5, -0.4]]))[:, :3, 3]
    commands = found.solve(found.targets(place, Rotation.from_euler("x", [1.0]).as_matrix()))
    assert not commands.reached[0]
    assert "the position can be reached, but not with this rotation" in commands.reasons[0]


@pytest.mark.parametrize(
    ("limits", "said"),
    [
        ({"q2": (1.0, -1.0)}, "the limits of q2, 1 to -1, leave it no room"),
        ({"q2": (1.0, 1.0)}, "leave it no room"),
        ({"q2": (np.nan, 1.0)}, "leave it no room"),
        ({"elbow": (0.0, 1.0)}, "no joint is called 'elbow'; the joints are q1, q2, q3"),
    ],
)
def test_limits_that_are_none_are_refused(limits, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        with_options("rigid", Options(limits=limits))


@pytest.mark.parametrize("limits", [(5.0, np.inf), (-np.inf, -5.0), (7.0, 14.0), (-30.0, 30.0), (8.0, 60.0)])
def test_starts_lie_within_limits_however_they_lie(limits) -> None:
    """A whole turn is open in each of these, so that all is reached as without limits."""
    found = with_options("rigid", Options(limits={"q1": limits}))
    seeds = Seeds(found.expression, Equilibrium(found.expression, "interpreted"), found.limits, SEEDS, 0)
    starts = seeds.commands[0]
    assert limits[0] <= starts.min() < starts.max() <= limits[1]
    assert np.ptp(starts) > 6
    free = compensator("rigid")
    commands = found.solve(of(free, drawn(free, 10)))
    assert commands.reached.all()
    assert within(found, commands)


@pytest.mark.parametrize(
    ("given", "said"),
    [
        ({"positions": np.zeros((2, 4))}, r"positions of the shape \(2, 4\), expected \(2, 3\)"),
        ({"positions": []}, "positions of the shape"),
        ({"positions": [[np.nan, 0, 0]]}, "positions that are not finite"),
        ({"positions": [[np.inf, 0, 0]]}, "positions that are not finite"),
        ({"positions": [[1e200, 0, 0]]}, r"positions beyond 1e\+06 m"),
        ({"positions": np.zeros((1, 3)), "rotations": np.zeros((2, 3, 3))}, "rotations of the shape"),
        ({"positions": np.zeros((1, 3)), "rotations": 2 * np.eye(3)}, "the matrix of target 1 is no rotation"),
        ({"positions": np.zeros((1, 3)), "rotations": np.diag([1.0, 1, -1])}, "is no rotation"),
        ({"positions": np.zeros((1, 3)), "rotations": np.full((3, 3), np.nan)}, "rotations that are not finite"),
        ({"positions": np.zeros((1, 3)), "approach": np.zeros((1, 2))}, r"shape \(1, 2\), expected 1 x 3"),
        ({"positions": np.zeros((1, 3)), "payload": np.nan}, "not finite"),
    ],
)
def test_targets_that_are_none_are_refused(given, said: str) -> None:
    with pytest.raises(ValueError, match=said):
        compensator("rigid").targets(**given)


def test_commands_of_another_arm_are_refused() -> None:
    found = compensator("rigid")
    targets = found.targets(np.zeros((2, 3)))
    for bad in (np.zeros(2), np.zeros((3, 3)), np.full(3, np.nan)):
        with pytest.raises(ValueError, match="found"):
            found.solve(targets, bad)
        with pytest.raises(ValueError, match="found"):
            found.follow(targets, bad)
    with pytest.raises(ValueError, match="expected 1 x 3"):
        found.forward(np.zeros((1, 2)))


def test_no_targets_have_no_commands() -> None:
    found = compensator("three")
    for turns in (None, np.zeros((0, 3, 3))):
        nothing = found.targets(np.zeros((0, 3)), turns)
        for commands in (found.solve(nothing), found.solve(nothing, np.zeros(3)), found.follow(nothing)):
            assert len(commands) == 0
            assert commands.joint_angles.shape == (0, 3)


def test_more_than_the_springs_hold_is_not_had() -> None:
    found = compensator("three")
    commands = found.solve(found.targets(found.forward(drawn(found, 3))[:, :3, 3], payload=300.0))
    assert not commands.reached.any()
    assert all(commands.reasons)


# -- where the arm may be ------------------------------------------------------------------------------------------


def test_clearance_chooses_the_other_posture() -> None:
    """Elbow down is forbidden."""
    found = with_options("rigid", Options(allowed=lambda q: q[2] > 0))
    free = compensator("rigid")
    commands = found.solve(of(free, np.array([[0.3, 0.8, -0.9], [0.5, 0.9, -0.5], [0.1, 0.2, 0.7]])))
    assert commands.reached.all()
    assert (commands.joint_angles[:, 2] > 0).all()


@pytest.mark.parametrize("name", ["rigid", "servos"])
def test_clearance_that_forbids_everything_says_so(name: str) -> None:
    found = with_options(name, Options(allowed=lambda q: np.zeros(q.shape[1], dtype=bool)))
    commands = found.solve(of(compensator(name), np.array([[0.3, 0.8, -0.9], [0.1, 0.2, 0.7]])))
    assert not commands.reached.any()
    assert set(commands.reasons) == {"all commands found that reach it are too near to something"}


def test_counts_that_stand_too_near_are_not_had() -> None:
    """Exact commands are allowed, all counts about them are not."""
    at = np.array([0.3, 0.8, -0.9])
    found = with_options("servos", Options(allowed=lambda q: np.abs(q - at[:, None]).max(axis=0) < 1e-5))
    target = exact(compensator("servos"), at[None], acting(found, 1))[:, :3, 3]
    commands = found.solve(found.targets(target), at)
    assert not commands.reached[0]
    assert commands.reasons[0] == "all commands found that reach it are too near to something"


# -- which of many -------------------------------------------------------------------------------------------------


def improved(found: Compensator, cost, position: np.ndarray, starts: np.ndarray) -> float:
    """The least cost of commands that have a position, by another optimiser."""
    low, high = found.limits.T
    scale = cost(starts[0])
    best = np.inf
    for start in starts:
        answer = minimize(
            lambda q: cost(q) / scale,
            np.clip(start, low, high),
            method="SLSQP",
            bounds=np.stack([low, high], axis=1),
            constraints={"type": "eq", "fun": lambda q: 10 * (found.forward(q)[0, :3, 3] - position)},
            options={"maxiter": 40, "ftol": 1e-9},
        )
        if np.linalg.norm(found.forward(answer.x)[0, :3, 3] - position) < 1e-6:
            best = min(best, float(answer.fun) * scale)
    return best


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, pytest.param(5, marks=pytest.mark.slow)])
def test_the_nearest_commands_cannot_be_bettered(count: int) -> None:
    """From where they are, limits included, nor from elsewhere."""
    found = with_options("five", Options(limits=NARROW))
    elsewhere = drawn(found, 8, seed=6)
    start = np.array([0.9, -0.8, 1.0, -1.0, 0.6])
    targets = of(found, drawn(found, count, seed=11))
    commands = found.solve(targets, start)
    assert commands.reached.all()
    assert within(found, commands)
    for i in range(count):

        def cost(q: np.ndarray) -> float:
            return float(((q - start) ** 2).sum())

        mine = cost(commands.joint_angles[i])
        starts = np.concatenate([commands.joint_angles[i : i + 1], elsewhere])
        assert mine <= 1.001 * improved(found, cost, targets.positions[i], starts)


# -- paths ---------------------------------------------------------------------------------------------------------


def line(found: Compensator, one, two, count: int = 15) -> np.ndarray:
    """Commands that go evenly from one to another (rad)."""
    return np.linspace(one, two, count)


@pytest.mark.parametrize(("name", "turns"), [("three", False), ("lrm", True), ("five", False)])
def test_a_path_that_can_be_had_is_followed_without_jumps(name: str, turns: bool) -> None:
    found = compensator(name)
    ends = drawn(found, 2, seed=21, widest=0.5)
    ends[:, 4:5] = [[0.5], [0.8]]  # of six joints, the one that must not pass through zero, where two axes meet
    along = line(found, ends[0], ends[1])
    targets = of(found, along, turns)
    told, chosen = found.follow(targets, along[0]), found.follow(targets)
    for commands in (told, chosen):
        assert commands.reached.all()
        assert commands.distances.max() <= NEAR_M
        moves = np.diff(commands.joint_angles, axis=0)
        assert moves == pytest.approx(commands.moves[1:], abs=1e-9)
        assert np.abs(moves).max() < 0.35
    assert np.abs(told.moves[0]).max() < 1e-6
    assert not chosen.moves[0].any()
    if name != "five":
        assert np.abs(told.joint_angles - along).max() < 1e-6


def test_the_side_from_which_joints_come_follows_from_the_motion() -> None:
    found = compensator("play")
    there = line(found, [0.2, 0.3, 0.5], [0.5, 0.6, 0.2])
    exact = found.forward(there)[:, :3, 3]
    forth = found.follow(found.targets(exact), there[0] - np.array([0.05, 0.05, -0.05]))
    assert forth.reached.all()
    moved = np.diff(forth.joint_angles, axis=0)
    assert (np.sign(moved) == forth.approach[1:]).all()
    assert (forth.approach[1:] == [1, 1, -1]).all()
    back = found.follow(found.targets(exact[::-1]), forth.joint_angles[-1])
    assert back.reached.all()
    assert (back.approach[1:] == [-1, -1, 1]).all()
    assert np.abs(back.joint_angles[::-1][:-1] - forth.joint_angles[:-1]).max() > 1e-3  # the play is taken up
    sides = {f"arm.approach.q{i + 1}": forth.approach[:, i] for i in range(3)}
    tools = predicted(calibration("play"), forth.joint_angles, **sides)
    assert np.abs(tools[:, :3, 3] - exact).max() < 2 * NEAR_M


def found_at(commands: np.ndarray) -> Solutions:
    """As a search would find them."""
    return replace(Solutions.nothing(len(commands), 0, commands.shape[1]), commands=commands)


def test_sides_are_told_as_the_joints_move() -> None:
    """One joint forth, one back; one that stays keeps the side from which it came."""
    at, before, record = np.zeros((3, 1)), np.array([[-1.0], [0.0], [-1.0]]), np.zeros((8, 1))
    goes = np.array([[0.1], [-0.2], [0.0]])
    found = with_sides(record, at, before, lambda told: found_at(goes - 0.1 * goes * told[3:6]))
    assert record[3:6].ravel().tolist() == [1, -1, -1]
    assert found.commands.ravel() == pytest.approx([0.09, -0.22, 0.0])


def test_a_joint_that_can_come_from_neither_side_has_none() -> None:
    """Told that it comes from below it must come from above, and the other way round; the other joint is sure."""
    record = np.zeros((4, 2))

    def search(told: np.ndarray) -> Solutions:
        moved = np.stack([np.where(told[2] > 0, -0.1, 0.1), np.array([0.3, -0.3])])
        moved[0, 1] = 0.2
        return found_at(moved)

    found = with_sides(record, np.zeros((2, 2)), np.zeros((2, 2)), search)
    assert record[2:].tolist() == [[0, 1], [1, -1]]
    assert found.commands[0].tolist() == [0.1, 0.2]


def test_a_single_command_comes_from_where_the_arm_stands() -> None:
    found = compensator("play")
    start = np.array([0.1, 0.9, 0.2])
    targets = of(found, np.array([[0.3, 0.5, 0.7]]))
    commands = found.solve(targets, start)
    assert commands.reached[0]
    assert (commands.approach[0] == np.sign(commands.joint_angles[0] - start)).all()
    sides = {f"arm.approach.q{i + 1}": commands.approach[:, i] for i in range(3)}
    tool = predicted(calibration("play"), commands.joint_angles, **sides)
    assert np.abs(tool[:, :3, 3] - targets.positions).max() < 2 * NEAR_M


def test_a_path_that_must_jump_says_where() -> None:
    """The column hardly turns past 90 degrees: behind the arm it must turn round and fold over."""
    found = with_options("rigid", Options(limits={"q1": (-1.6, 1.6)}))
    free = compensator("rigid")
    along = line(free, [1.2, 0.9, -2.0], [1.9, 0.9, -2.0], 15)
    commands = found.follow(of(free, along), along[0])
    assert commands.reached.all()
    assert within(found, commands)
    longest = np.abs(commands.moves).max(axis=1)
    jump = int(np.argmax(longest))
    assert longest[jump] > 1
    assert (np.delete(longest, jump) < 0.3).all()
    assert 1.6 < along[jump, 0] < 1.7


def test_a_place_out_of_reach_does_not_end_a_path() -> None:
    found = compensator("rigid")
    along = line(found, [0.0, 0.5, -0.8], [0.6, 0.7, -0.8], 9)
    positions = found.forward(along)[:, :3, 3]
    positions[4] *= 3
    commands = found.follow(found.targets(positions), along[0])
    assert commands.reached.tolist() == [True] * 4 + [False] + [True] * 4
    assert "out of reach" in commands.reasons[4]


# -- counts --------------------------------------------------------------------------------------------------------


def set_angles(found: Compensator, commands: np.ndarray) -> np.ndarray:
    """Where a board puts joints that are told these commands, by the effect's own formula."""
    made = commands.copy()
    for i, joint in enumerate(found.joints):
        if joint in found.expression.servos:
            made[:, i] = [float(quantised(q, *found.expression.servos[joint])) for q in commands[:, i]]
    return made


@pytest.mark.parametrize("name", ["servos", "mixed", "one"])
def test_commands_are_what_the_board_sets(name: str) -> None:
    """Counts, the angles that they make, and the prediction at those angles tell of one place."""
    found = compensator(name)
    targets = of(found, drawn(found, 30))
    commands = found.solve(targets)
    assert commands.reached.all()
    assert np.abs(set_angles(found, commands.joint_angles) - commands.joint_angles).max() < 1e-12
    for i, joint in enumerate(found.joints):
        if joint not in found.expression.servos:
            assert (commands.counts[:, i] == 0).all()
            continue
        table, clock = found.expression.servos[joint]
        made = [float(table.angle(count * clock.tick)) for count in commands.counts[:, i]]
        assert np.abs(made - commands.joint_angles[:, i]).max() < 1e-12
    tools = predicted(calibration(name), commands.joint_angles)
    assert np.abs(tools - commands.base_T_tool).max() < 1e-12
    assert np.linalg.norm(tools[:, :3, 3] - targets.positions, axis=1) == pytest.approx(commands.distances, abs=1e-12)
    assert within(found, commands)


@pytest.mark.parametrize("name", ["servos", "mixed"])
def test_no_counts_nearby_are_better(name: str) -> None:
    """All of two to either side, tried on the arm; the linear choice may miss by little."""
    found = compensator(name)
    where = drawn(found, 12, seed=8)
    positions = exact(found, where, acting(found, 12))[:, :3, 3]
    commands = found.solve(found.targets(positions))
    servos = [found.expression.servos.get(joint) for joint in found.joints]
    for i in range(12):
        offsets = [range(-2, 3) if servo else (0,) for servo in servos]
        tried = []
        for steps in product(*offsets):
            q = commands.joint_angles[i].copy()
            for joint, (servo, step) in enumerate(zip(servos, steps, strict=True)):
                if servo:
                    q[joint] = float(servo[0].angle((commands.counts[i, joint] + step) * servo[1].tick))
            tried.append(q)
        tools = exact(found, np.array(tried), acting(found, len(tried)))
        best = np.linalg.norm(tools[:, :3, 3] - positions[i], axis=1).min()
        assert commands.distances[i] <= 1.05 * best + 1e-7


def test_the_best_counts_are_better_than_the_nearest_ones() -> None:
    found = compensator("servos")
    where = drawn(found, 60, seed=4)
    positions = exact(found, where, acting(found, 60))[:, :3, 3]
    rounded = found.forward(where)[:, :3, 3]
    commands = found.solve(found.targets(positions), where)
    nearest = np.linalg.norm(rounded - positions, axis=1)
    assert (commands.distances <= nearest + 1e-9).all()
    assert commands.distances.mean() < 0.9 * nearest.mean()


@pytest.mark.parametrize("falling", [False, True])
def test_commands_between_two_counts_go_where_the_effect_puts_them(falling: bool) -> None:
    found = compensator("servos")
    joint = 1 if falling else 0
    table, clock = found.expression.servos[found.joints[joint]]
    pulses = (np.arange(200, 400) + 0.5) * clock.tick
    edges = np.array([float(table.angle(pulse)) for pulse in pulses])
    for q in (edges + 1e-9, edges - 1e-9):
        commands = np.zeros((len(q), 3))
        commands[:, joint] = q
        assert np.abs(found._set(commands.T).T[:, joint] - set_angles(found, commands)[:, joint]).max() < 1e-12


def test_counts_stay_within_limits() -> None:
    limits = {"q1": (0.0, 0.4), "q2": (-1.0, 1.0)}
    found = with_options("servos", Options(limits=limits))
    start = np.array([0.2, 0.1, 0.7])
    edge = np.array([[0.4, 0.5, 0.7], [0.0, 1.0, 0.7], [0.2, -1.0, 0.7]])
    commands = found.solve(found.targets(exact(found, edge, acting(found, 3))[:, :3, 3]), start)
    assert commands.reached.all()
    assert within(found, commands)


def test_many_joints_without_servos_cost_nothing() -> None:
    """Two servos among ten joints: only theirs are combined."""
    found = calibration("ten").compensator(choice="interpreted")
    targets = of(found, drawn(found, 20))
    commands = found.solve(targets)
    assert commands.reached.all()
    assert (np.delete(commands.counts, [0, 2], axis=1) == 0).all()


def test_a_half_turn_between_rotations_is_one():
    """Its sine is zero, as that of no turn."""
    turned = np.stack([np.diag([1.0, -1, -1]), np.diag([-1.0, 1, -1]), np.diag([-1.0, -1, 1]), np.eye(3)])
    turns = turn_between(np.broadcast_to(np.eye(3), turned.shape), turned)
    np.testing.assert_allclose(np.abs(turns), np.pi * np.vstack([np.eye(3), np.zeros(3)]), atol=1e-12)
