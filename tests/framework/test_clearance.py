"""Clearance: distances against brute force and an independent library, frames against the arm's own kinematics."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from armcal.arm import clearance as shapes
from armcal.arm.clearance import (
    ClearanceCheck,
    distance,
    joints_of_frames,
    segment_to_box,
    segment_to_segment,
)
from holding import holding_efforts
from scipy.optimize import minimize

RANDOM = np.random.default_rng(0)


def Point(frame, at=(0, 0, 0)) -> shapes.Point:  # noqa: N802
    return shapes.Point.si(frame=frame, at=_floats(at))


def Capsule(start, end, radius) -> shapes.Capsule:  # noqa: N802
    return shapes.Capsule.si(start=start, end=end, radius=float(radius))


def Clearance(parts, rules, forbidden=()) -> shapes.Clearance:  # noqa: N802
    return shapes.Clearance.si(parts=parts, rules=rules, forbidden=forbidden)


def HalfSpace(point, normal) -> shapes.HalfSpace:  # noqa: N802
    return shapes.HalfSpace.si(type="half_space", point=_floats(point), normal=_floats(normal))


def Rule(between, at_least, besides=()) -> shapes.Rule:  # noqa: N802
    return shapes.Rule.si(between=between, at_least=float(at_least), besides=besides)


def _floats(numbers) -> tuple[float, ...]:
    return tuple(map(float, numbers))


EDGE_CASES = [
    ((0, 0, 0), (1, 0, 0), (0, 1, 0), (1, 1, 0)),  # parallel
    ((0, 0, 0), (1, 0, 0), (2, 0, 0), (3, 0, 0)),  # in one line
    ((0, 0, 0), (2, 0, 0), (1, 0, 0), (3, 0, 0)),  # overlapping in one line
    ((0, 0, 0), (1, 0, 0), (0.5, -1, 0), (0.5, 1, 0)),  # crossing
    ((0, 0, 0), (0, 0, 0), (1, 1, 1), (1, 1, 1)),  # two points
    ((0, 0, 0), (0, 0, 0), (-1, 1, 0), (1, 1, 0)),  # a point and a segment
    ((-1, 1, 0), (1, 1, 0), (0, 0, 0), (0, 0, 0)),
    ((0, 0, 0), (1, 0, 0), (1.5, 1, 0), (1.5, -1, 0)),  # an end and a middle
]


def search(of, starts=9) -> float:
    """The least of a function of numbers between 0 and 1, by many local searches."""
    size = of.__code__.co_argcount
    grid = np.array(np.meshgrid(*[np.linspace(0, 1, starts)] * size)).reshape(size, -1).T
    best = sorted(grid, key=lambda t: of(*t))[:4]
    found = [minimize(lambda t: of(*t) ** 2, t, bounds=[(0, 1)] * size, tol=1e-14).fun for t in best]
    return float(np.sqrt(max(0.0, min(found))))


@pytest.mark.parametrize("case", [*EDGE_CASES, *RANDOM.normal(size=(12, 4, 3))])
def test_segments_are_as_far_apart_as_a_search_finds(case) -> None:
    p1, q1, p2, q2 = (np.array([p], dtype=float) for p in case)
    expected = search(lambda s, t: float(np.linalg.norm(p1 + s * (q1 - p1) - p2 - t * (q2 - p2))))
    assert segment_to_segment(p1, q1, p2, q2)[0] == pytest.approx(expected, abs=1e-6)
    assert segment_to_segment(p2, q2, p1, q1)[0] == pytest.approx(expected, abs=1e-6)


@pytest.mark.parametrize("case", RANDOM.normal(size=(30, 2, 3)) * 1.5)
def test_a_segment_is_as_far_from_a_box_as_a_search_finds(case) -> None:
    low, high = np.array([-0.5, -1.0, -0.2]), np.array([0.5, 0.3, 0.4])
    p, q = case[:1], case[1:]

    def away(t) -> float:
        point = (p + t * (q - p))[0]
        return float(np.linalg.norm(point - np.clip(point, low, high)))

    assert segment_to_box(p, q, low, high)[0] == pytest.approx(search(away, 200), abs=1e-6)


def test_box_distances_of_points_and_of_segments_along_its_sides() -> None:
    low, high = np.zeros(3), np.ones(3)
    p = np.array([[2.0, 0.5, 0.5], [2.0, -5.0, 0.5], [0.5, 0.5, 0.5], [-1.0, 0.5, 0.5], [2.0, 2.0, 2.0]])
    q = np.array([[2.0, 0.5, 0.5], [2.0, 5.0, 0.5], [0.6, 0.5, 0.5], [2.0, 0.5, 0.5], [3.0, 2.0, 2.0]])
    assert np.allclose(segment_to_box(p, q, low, high), [1, 1, 0, 0, np.sqrt(3)])


def test_capsules_agree_with_coal() -> None:
    coal = pytest.importorskip("coal")
    for _ in range(30):
        capsules, bodies = [], []
        for _ in range(2):
            ends, radius = RANDOM.normal(size=(2, 3)), RANDOM.uniform(0.01, 0.2)
            capsules.append(Capsule(Point("base", tuple(ends[0])), Point("base", tuple(ends[1])), radius))
            axis = ends[1] - ends[0]
            length = np.linalg.norm(axis)
            rotation = np.linalg.svd(np.column_stack([axis, np.eye(3)]))[0][:, [1, 2, 0]]
            rotation[:, 2] = axis / length
            rotation[:, 0] *= np.sign(np.linalg.det(rotation))
            bodies.append((coal.Capsule(radius, length), coal.Transform3s(rotation, ends.mean(axis=0))))
        result = coal.DistanceResult()
        (a, at_a), (b, at_b) = bodies
        expected = coal.distance(a, at_a, b, at_b, coal.DistanceRequest(), result)
        assert distance(*capsules, {})[0] == pytest.approx(expected, abs=1e-5)


def test_a_half_space_counts_height_along_its_normal_whatever_its_length() -> None:
    body = Capsule(Point("base", (0, 0, 1)), Point("base", (0, 3, 2)), 0.25)
    assert distance(body, HalfSpace((9, 9, 0.5), (0, 0, 7)), {})[0] == pytest.approx(0.25)
    assert distance(HalfSpace((0, 4, 0), (0, -2, 0)), body, {})[0] == pytest.approx(0.75)


@pytest.fixture(scope="module")
def arm(lrm):
    return lrm.experiment().system.arms["arm"]


def ball(frame, radius=0.0, at=(0.0, 0.0, 0.0)) -> tuple[shapes.Ball, ...]:
    return (shapes.Ball.si(centre=Point(frame, at), radius=float(radius)),)


def test_points_ride_on_the_arm_as_its_kinematics_says(lrm, arm) -> None:
    """The tool's distance from a fixed point, by the compiled problem of a stiff arm."""
    experiment = lrm.experiment()
    q = RANDOM.uniform(-1, 1, (40, 6))
    dataset = lrm.dataset(q)
    stiff = experiment.parameters.with_free(())
    tip = lrm.problem(experiment, dataset, parameters=stiff).predict(stiff.nominal())[0].outputs[:3].T
    origin = (0.1, -0.2, 0.3)
    check = ClearanceCheck(
        arm, Clearance({"tool": ball("tool"), "post": ball("base", 0.01, origin)}, (Rule(("tool", "post"), 0.05),))
    )
    assert np.allclose(check(q.T).margins[0], np.linalg.norm(tip - origin, axis=1) - 0.06, atol=1e-12)


def test_neighbours_exceptions_and_fixed_parts_are_not_paired(arm) -> None:
    moved_by = joints_of_frames(arm)
    parts = {f"link{i}": ball(f"row{i}") for i in range(1, 6)} | {
        "tool": ball("tool"),
        "base": ball("base"),
        "post": ball("base"),
    }
    clearance = Clearance(parts, ())

    def pairs(*between, besides=()):
        return set(clearance.pairs(Rule(between, 0.1, besides), moved_by))

    assert pairs("base", "post") == set()
    assert pairs("tool", "link*") == {("link1", "tool"), ("link2", "tool"), ("link3", "tool"), ("link4", "tool")}
    assert pairs("tool", "link*", besides=("link[12]",)) == {("link3", "tool"), ("link4", "tool")}
    assert ("base", "link1") not in pairs("everything", "base") and ("base", "link2") in pairs("everything", "base")


def test_the_worst_pair_of_a_rule_counts_and_touching_is_allowed(arm) -> None:
    parts = {"tool": ball("tool"), "near": ball("base", 0.1, (0.4, 0, 0.3)), "far": ball("base", 0.1, (9, 0, 0))}
    q = np.zeros((6, 1))
    apart = ClearanceCheck(arm, Clearance(parts, (Rule(("tool", "near"), 0.0),)))(q).margins[0, 0]
    both = ClearanceCheck(arm, Clearance(parts, (Rule(("tool", "everything"), 0.0),)))(q).margins[0, 0]
    assert both == apart
    assert ClearanceCheck(arm, Clearance(parts, (Rule(("tool", "near"), apart),)))(q).allowed.all()
    assert not ClearanceCheck(arm, Clearance(parts, (Rule(("tool", "near"), apart + 1e-9),)))(q).allowed.any()


def test_the_tool_stays_out_of_forbidden_boxes_and_balls(arm) -> None:
    q = RANDOM.uniform(-1, 1, (6, 6000))  # more than are checked at once
    nothing = ClearanceCheck(
        arm, Clearance({"tool": ball("tool"), "origin": ball("base")}, (Rule(("tool", "origin"), 0.3),))
    )
    near = ~nothing(q).allowed
    region = ClearanceCheck(arm, Clearance({}, (), ball("base", 0.3)))
    assert 0 < near.sum() < 6000 and np.array_equal(near, ~region(q).allowed)
    box = shapes.Box.si(type="box", low=(0.2, -0.1, 0.0), high=(0.5, 0.1, 0.3))
    axes = [
        ClearanceCheck(
            arm,
            Clearance(
                {"tool": ball("tool"), "wall": (HalfSpace(tuple(corner), tuple(n)),)}, (Rule(("tool", "wall"), 0.0),)
            ),
        )
        for corner, sign in ((box.low, -1), (box.high, 1))
        for n in sign * np.eye(3)
    ]
    inside = np.all([~check(q).allowed for check in axes], axis=0)
    assert 0 < inside.sum() < 6000
    assert np.array_equal(inside, ~ClearanceCheck(arm, Clearance({}, (), (box,)))(q).allowed)


@pytest.mark.slow
def test_holding_efforts_are_the_slope_of_potential_energy(arm) -> None:
    """By central differences of -sum m g.p, with every mass on the joint that moves it."""
    gravity = (1.0, -2.0, -9.0)
    physical = replace(arm, masses=tuple(replace(m, loads_up_to=None) for m in arm.masses))
    points = [*((m.mass, Point(m.frame, m.com)) for m in physical.masses), (0.3, Point("tool", (0.01, 0.02, 0.03)))]

    def energy(q) -> float:
        total = 0.0
        for mass, point in points:
            for axis in range(3):
                # The height over a wall: the coordinate of the point along an axis.
                wall = HalfSpace((0, 0, 0), tuple(np.eye(3)[axis]))
                parts = {"a": (Capsule(point, point, 0.0),), "b": (wall,)}
                check = ClearanceCheck(physical, Clearance(parts, ()))
                total -= mass * gravity[axis] * float(check._apart(("a", "b"), _where(check, q), 1)[0])
        return total

    q = RANDOM.uniform(-1, 1, 6)
    efforts = holding_efforts(physical, q[:, None], gravity, 0.3, (0.01, 0.02, 0.03))[:, 0]
    for joint in range(6):
        e = np.eye(6)[joint] * 1e-5
        assert -(energy(q + e) - energy(q - e)) / 2e-5 == pytest.approx(efforts[joint], abs=1e-6)


def _where(check, q):
    stacked = np.asarray(check._function(q).full()).reshape(-1, 3)
    return {point: stacked[i : i + 1] for i, point in enumerate(check._points)}
