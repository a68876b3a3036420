"""Elastic sites: what is merged, what stays apart, and what a stacked deflection means."""

from __future__ import annotations

import casadi as ca
import numpy as np
import pytest
from armcal.arm.assembly import Arm, ArmInputs, deflections, elastic_sites, split_deflection
from armcal.arm.effects import MOUNT, JointCommand, JointEffect, Spring
from armcal.arm.model import Attachment, Chain, Joint, forward
from armcal.arm.statics import Load, MassSpec, SiteWrench
from armcal.base import se3
from scipy.spatial.transform import Rotation

X, Y, Z = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)
XYZ = (X, Y, Z)
OBLIQUE = (0.6, 0.0, 0.8)
NONE = (0.0, 0.0, 0.0)
AT_REST = JointCommand(0, ca.DM(0.0), ca.DM(0.0))
COMPLIANCE = np.array([[0.05, 0.01, -0.02], [0.01, 0.04, 0.005], [-0.02, 0.005, 0.06]])


def linear(matrix):
    return lambda load, command: ca.mtimes(ca.DM(np.atleast_2d(matrix)), load)


def chain():
    """A turning joint about z, one about an oblique axis, a sliding one along y."""
    up = se3.translation_along("z", 0.3)
    joints = (
        Joint("turn", up),
        Joint("oblique", se3.translation_along("x", 0.2) @ se3.rotation_about("x", 0.7), OBLIQUE),
        Joint("slide", se3.translation_along("x", 0.15), NONE, Y),
    )
    return Chain(se3.rotation_about("y", 0.4), joints, Attachment(3, up), {"arm": Attachment(1, se3.identity())})


def numbers(expression):
    return np.array(ca.DM(ca.densify(expression)))


# ---------------------------------------------------------------- merging


def test_springs_at_one_site_share_its_coordinates():
    springs = [Spring(2, XYZ, linear(COMPLIANCE)), Spring(0, XYZ, linear(COMPLIANCE)), Spring(2, (), linear(0.1))]
    sites = elastic_sites(chain(), springs)
    assert [(s.site, s.directions, len(s.springs)) for s in sites] == [(2, XYZ, 2), (0, XYZ, 1)]
    assert sum(site.size for site in sites) == 6


def test_springs_about_the_same_axis_need_one_coordinate():
    two = [Spring(1, (), linear(0.1)), Spring(1, (), linear(0.2))]
    assert [(s.directions, s.size) for s in elastic_sites(chain(), two)] == [((), 1)]
    base = [Spring(0, (Y,), linear(0.1)), Spring(0, (Y,), linear(0.2))]
    assert [(s.directions, s.size) for s in elastic_sites(chain(), base)] == [((Y,), 1)]


def test_springs_about_different_axes_need_all_three_coordinates():
    both = [Spring(0, (X,), linear(0.1)), Spring(0, (Y,), linear(0.2))]
    assert [(s.directions, s.size) for s in elastic_sites(chain(), both)] == [(XYZ, 3)]


def test_what_gives_along_a_slide_is_no_rotation_of_it():
    springs = [Spring(3, (), linear(1e-3)), Spring(3, XYZ, linear(COMPLIANCE)), Spring(3, (), linear(2e-3))]
    sites = elastic_sites(chain(), springs)
    assert [(s.site, s.directions, len(s.springs)) for s in sites] == [(3, (), 2), (3, XYZ, 1)]


def test_an_arm_without_springs_has_no_state():
    assert elastic_sites(chain(), []) == ()
    along, rotations = split_deflection(chain().joints, (), ca.SX(0, 1))
    assert [float(x) for x in along] == [0, 0, 0] and rotations == {}
    assert deflections(chain(), forward(chain(), [0, 0, 0], {}), (), (), ()).shape == (0, 1)


# ---------------------------------------------------------------- what springs answer

MERGED = {
    "a matrix and the joint's own axis": [Spring(2, XYZ, linear(COMPLIANCE)), Spring(2, (), linear(0.1))],
    "the joint's own axis and a matrix": [Spring(2, (), linear(0.1)), Spring(2, XYZ, linear(COMPLIANCE))],
    "two axes": [Spring(2, (X,), linear(0.03)), Spring(2, (OBLIQUE,), linear(0.1))],
    "an axis pair and an axis": [Spring(2, (X, Z), linear([[0.03, 0.01], [0.01, 0.02]])), Spring(2, (), linear(0.1))],
    "the axis twice": [Spring(2, (), linear(0.1)), Spring(2, (), linear(0.05))],
    "a law that is not linear": [
        Spring(2, (), lambda t, command: 0.2 * t**3),
        Spring(2, XYZ, lambda m, command: 0.1 * m / ca.sqrt(ca.dot(m, m) + 0.01)),
    ],
}


def by_hand(springs, moment):
    """The rotation vector in the site's frame under a moment in that frame: every law for itself, then added."""
    total = np.zeros(3)
    for spring in springs:
        axes = np.array(spring.directions or (OBLIQUE,))
        total += axes.T @ numbers(spring.law(ca.DM(axes @ moment), AT_REST)).ravel()
    return total


@pytest.mark.parametrize("case", MERGED)
def test_springs_at_one_site_answer_its_moment_with_the_sum_of_their_rotation_vectors(case):
    arm, random = chain(), np.random.default_rng(1)
    sites = elastic_sites(arm, MERGED[case])
    moved = random.uniform(-1, 1, 3)
    frames = forward(arm, list(moved), {})
    moment, force = random.normal(size=3), random.normal(size=3)
    acting = [SiteWrench(ca.DM(moment), ca.DM(force))] * 4
    found = numbers(deflections(arm, frames, acting, sites, [AT_REST] * 3)).ravel()
    rotation = numbers(frames.sites[2].rotation)
    expected = by_hand(MERGED[case], rotation.T @ moment)
    if found.size == 1:
        found = found[0] * np.array(OBLIQUE)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-14)
    along, rotations = split_deflection(
        arm.joints, sites, ca.DM(numbers(deflections(arm, frames, acting, sites, [AT_REST] * 3)))
    )
    turned = Rotation.from_rotvec(float(along[1]) * np.array(OBLIQUE)).as_matrix()
    turned = turned @ (numbers(rotations[2]) if rotations else np.eye(3))
    np.testing.assert_allclose(turned, Rotation.from_rotvec(expected).as_matrix(), rtol=0, atol=1e-13)


def test_a_law_is_given_what_its_own_joint_was_commanded_and_from_where_it_came():
    """Softer the farther the joint is turned, and by another share from either side; the mount is not commanded."""
    springs = [
        Spring(2, (), lambda load, command: (0.1 + 0.2 * command.commanded + 0.05 * command.approach) * load),
        Spring(0, XYZ, lambda load, command: ca.DM([1.0, 2.0, 3.0]) * (0.0 if command is MOUNT else 1.0)),
    ]
    arm, moment = chain(), np.array([0.3, -0.7, 1.1])
    sites, frames = elastic_sites(arm, springs), forward(arm, [0.3, -0.5, 0.1], {})
    commands = [JointCommand(i, ca.DM(at), ca.DM(side)) for i, (at, side) in enumerate([(9, 9), (-0.5, -1), (9, 9)])]
    acting = [SiteWrench(ca.DM(moment), ca.DM.zeros(3))] * 4
    found = numbers(deflections(arm, frames, acting, sites, commands)).ravel()
    torque = OBLIQUE @ numbers(frames.sites[2].rotation).T @ moment
    np.testing.assert_allclose(found, [(0.1 - 0.1 - 0.05) * torque, 0, 0, 0], rtol=0, atol=1e-15)


def test_a_slide_gives_by_the_force_along_it_and_turns_by_the_moment():
    arm = chain()
    springs = [
        Spring(3, XYZ, linear(COMPLIANCE)),
        Spring(3, (), linear(1e-3)),
        Spring(3, (), lambda f, command: 1e-4 * f**3),
    ]
    sites, frames = elastic_sites(arm, springs), forward(arm, [0.3, -0.5, 0.1], {})
    moment, force = np.array([0.3, -0.7, 1.1]), np.array([2.0, 1.0, -3.0])
    found = numbers(
        deflections(arm, frames, [SiteWrench(ca.DM(moment), ca.DM(force))] * 4, sites, [AT_REST] * 3)
    ).ravel()
    rotation = numbers(frames.sites[3].rotation)
    push = rotation[:, 1] @ force
    np.testing.assert_allclose(found[:3], COMPLIANCE @ rotation.T @ moment, rtol=0, atol=1e-15)
    assert found[3] == pytest.approx(1e-3 * push + 1e-4 * push**3, rel=1e-13)
    along, rotations = split_deflection(arm.joints, sites, ca.DM(found))
    assert [float(x) for x in along] == [0, 0, pytest.approx(found[3])] and list(rotations) == [3]


@pytest.mark.parametrize("axis", [X, Y, Z, OBLIQUE, (0.0, -1.0, 0.0)], ids=str)
def test_one_coordinate_turns_exactly_about_its_axis(axis):
    """However far: a base spring is no small rotation."""
    sites = elastic_sites(chain(), [Spring(0, (axis,), linear(0.1))])
    for angle in (0.0, 1e-9, 0.3, 2.5):
        _, rotations = split_deflection(chain().joints, sites, ca.DM([angle]))
        expected = Rotation.from_rotvec(angle * np.array(axis)).as_matrix()
        np.testing.assert_allclose(numbers(rotations[0]), expected, rtol=0, atol=1e-15)


# ---------------------------------------------------------------- a whole arm


class Springs(JointEffect):
    """An effect of given springs."""

    def __init__(self, *springs):
        self._springs = springs

    def springs(self, values):
        return self._springs


class Model:
    """The chain above as an arm model."""

    joint_names = ("turn", "oblique", "slide")

    def parameters(self):
        return ()

    def chain(self, values):
        return chain()


def settled(effects, commands):
    """Tool poses in equilibrium under gravity and a wrench."""
    masses = (MassSpec("one", 0.8, (0.05, 0.02, 0.1), "arm"), MassSpec("two", 0.5, (0.0, 0.05, -0.1), "tool"))
    arm = Arm("arm", "model", Model(), effects, masses)
    load = Load(*(ca.DM(x) for x in ([0.3, -1.0, -9.7], 0.1, [0.0, 0.02, 0.03], [0.2, -0.4, 0.3], [0.05, 0, -0.1])))
    state = ca.SX.sym("state", arm.deflection_size)
    q = ca.SX.sym("q", 3)
    values = {block.name: ca.DM(list(block.nominal)) for block in arm.parameters()}
    told = arm.state(values, ArmInputs(q, ca.SX.zeros(3), load, state))
    shown = ca.densify(told.base_T_tool.matrix())
    function = ca.Function("pass", [q, state], [ca.densify(told.next_deflection), shown])
    poses = []
    for each in commands:
        now = np.zeros(arm.deflection_size)
        for _ in range(200):
            now = np.array(function(each, now)[0]).ravel()
        poses.append(np.array(function(each, now)[1]))
    return np.array(poses)


SAME = {
    "an oblique axis and a matrix": (
        {"a": Springs(Spring(2, (), linear(0.08))), "b": Springs(Spring(2, XYZ, linear(COMPLIANCE)))},
        {"a": Springs(Spring(2, XYZ, linear(COMPLIANCE + 0.08 * np.outer(OBLIQUE, OBLIQUE))))},
    ),
    "one effect or two": (
        {"a": Springs(Spring(1, XYZ, linear(COMPLIANCE)), Spring(1, (), linear(0.05)))},
        {"a": Springs(Spring(1, (), linear(0.05))), "b": Springs(Spring(1, XYZ, linear(COMPLIANCE)))},
    ),
    "three axes or a diagonal matrix": (
        {"a": Springs(*(Spring(0, (axis,), linear(k)) for axis, k in zip(XYZ, (0.02, 0.05, 0.03), strict=True)))},
        {"a": Springs(Spring(0, XYZ, linear(np.diag([0.02, 0.05, 0.03]))))},
    ),
    "a joint's own axis or a matrix of rank one": (
        {"a": Springs(Spring(2, (), linear(0.08)))},
        {"a": Springs(Spring(2, XYZ, linear(0.08 * np.outer(OBLIQUE, OBLIQUE))))},
    ),
    "a matrix or its halves": (
        {"a": Springs(Spring(3, XYZ, linear(COMPLIANCE)))},
        {"a": Springs(Spring(3, XYZ, linear(COMPLIANCE / 2))), "b": Springs(Spring(3, XYZ, linear(COMPLIANCE / 2)))},
    ),
    "a spring that gives nothing": (
        {"a": Springs(Spring(1, (), linear(0.05)))},
        {"a": Springs(Spring(1, (), linear(0.05)), Spring(1, XYZ, linear(np.zeros((3, 3)))))},
    ),
}


@pytest.mark.quick("a joint's own axis or a matrix of rank one")
@pytest.mark.parametrize("case", SAME)
def test_the_same_compliance_written_otherwise_is_the_same_arm(case):
    commands = np.random.default_rng(3).uniform(-1, 1, (5, 3)) * [1.5, 1.5, 0.2]
    one, other = (settled(effects, commands) for effects in SAME[case])
    rigid = settled({}, commands)
    assert np.abs(one - rigid).max() > 1e-3
    np.testing.assert_allclose(one, other, rtol=0, atol=1e-12)
