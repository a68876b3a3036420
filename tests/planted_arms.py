"""Rigid arms with undetermined combinations planted by hand, and sound ones."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from armcal.arm.assembly import Arm, prefixed
from armcal.arm.effects import JointEffect
from armcal.arm.statics import Environment
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters, scalar
from armcal.problem.problem import Problem
from armcal_mdh.model import MdhModel
from armcal_tracker.position import TipPosition, TipPositionSettings
from chain_oracle import ChainSpec, Row, jacobian

HALF = np.pi / 2
POSES = 40


@dataclass(frozen=True)
class Servo(JointEffect):
    """A test's own effect: every joint has an offset and a gain error."""

    joints: int

    def parameters(self):
        kinds = (("offset", "rad", 0.05), ("gain", "1", 0.05))
        return tuple(scalar(f"{k}{i}", u, 0.0, s) for k, u, s in kinds for i in range(1, self.joints + 1))

    def displacement(self, command, values):
        i = command.joint
        return values[f"offset{i}"] + values[f"gain{i}"] * command.commanded


def full(name: str) -> str:
    """The full name of a local one of the oracle."""
    if name.startswith("target"):
        return f"tracker.{name}"
    return f"arm.servo.{name}" if name.startswith(("offset", "gain")) else f"arm.mdh.{name}"


@dataclass(frozen=True)
class Case:
    """Free parameters of a chain, held joints, and every planted combination in SI with its cause.

    A pose is uniform in 1.5 rad (0.2 m) to either side, except for joints held at a value,
    about which they ``wiggle`` (rad).
    """

    chain: ChainSpec
    free: tuple[str, ...]
    planted: tuple[tuple[Mapping[str, float], str], ...] = ()
    held: Mapping[int, float] = field(default_factory=dict)
    wiggle: float = 0.0

    def poses(self) -> np.ndarray:
        random = np.random.default_rng(len(self.free))
        span = [1.5 if row.kind == "revolute" else 0.2 for row in self.chain.rows]
        q = random.uniform(-1, 1, (POSES, len(span))) * span
        for joint, value in self.held.items():
            q[:, joint - 1] = value + self.wiggle * random.uniform(-1, 1, POSES)
        return q

    def problem(self, noise: float = 0.0) -> tuple[Problem, tuple[Any, ...], np.ndarray]:
        count, q = len(self.chain.rows), self.poses()
        model = MdhModel(MdhModel.Settings.si(**self.chain.settings()))
        arm = Arm("arm", "mdh", model, {"servo": Servo(count)}, ())
        tracker = TipPosition(TipPositionSettings.si(noise=0.001), ("arm",))
        blocks = [*arm.parameters(), *prefixed("tracker.", tracker.parameters())]
        parameters = Parameters(tuple(blocks)).with_free([full(name) for name in self.free])
        measured = self.chain.tip(self.chain.nominal(), q)
        measured += noise * np.random.default_rng(1).normal(size=measured.shape)
        channels = {f"arm.q{i + 1}": q[:, i] for i in range(count)}
        channels |= {f"tracker.{axis}": measured[:, i] for i, axis in enumerate("xyz")}
        dataset = Dataset(tuple(str(i) for i in range(POSES)), channels)
        surroundings = Environment((0.0, 0.0, -9.81))
        problem = Problem.build({"arm": arm}, {"tracker": tracker}, parameters, surroundings, dataset, "interpreted")
        return problem, problem.of(dataset).records, parameters.nominal()


TWO = ChainSpec((Row(a=0.3), Row(a=0.25)))
"""Two parallel axes."""
TWO_ON_BASE = replace(TWO, base=(("x", 0.1), ("y", 0.2), ("z", 0.05), ("rz", 0.3)))
THREE = ChainSpec((Row(a=0.3), Row(a=0.25), Row(a=0.1)))
ELBOW = ChainSpec((Row(alpha=HALF, d=0.2), Row(a=0.3), Row(a=0.25)), base=(("x", 0.0), ("y", 0.0), ("z", 0.1)))
"""An upright axis, then two parallel level ones."""
WRIST = replace(ELBOW, tool=(("x", 0.05), ("z", 0.03), ("rx", 0.2)))
CRAIG = ChainSpec(
    (Row(), Row(alpha=HALF, a=0.1), Row(a=0.3), Row(alpha=0.4, a=0.2, d=0.1)),
    base=(("x", 0.1), ("rx", 0.3)),
    convention="craig",
    tool=(("x", 0.15),),
)
SLIDE = ChainSpec(
    (Row(kind="prismatic", theta=0.2, d=0.1), Row(a=0.3), Row(alpha=0.5, a=0.2, d=0.1)), base=(("z", 0.3),)
)
DOUBLE = ChainSpec((Row(alpha=0.7, a=0.2, after=(("z", 0.1), ("z", 0.05))), Row(a=0.3, alpha=0.3), Row(a=0.2)))
LENGTHS, ZEROS = ("a1", "a2"), ("theta1", "theta2")


def stuck_elbow(angle: float) -> dict[str, float]:
    """a1, a2, theta2 while joint 2 stands: the tip's two coordinates in the upper arm see two of the three."""
    a2 = 0.25
    d_a2 = -a2 * np.cos(angle) / np.sin(angle)
    return {"theta2": 1.0, "a2": d_a2, "a1": -d_a2 * np.cos(angle) + a2 * np.sin(angle)}


PLANTED = {
    "heights of parallel axes": Case(TWO, (*LENGTHS, "d1", "d2"), (({"d1": 1, "d2": -1}, "gauge"),)),
    "a twist behind the last joint": Case(TWO, (*ZEROS, "alpha2"), (({"alpha2": 1}, "gauge"),)),
    "three heights of parallel axes": Case(
        THREE, ("a1", "a2", "d1", "d2", "d3"), (({"d1": 1, "d2": -1}, "gauge"), ({"d2": 1, "d3": -1}, "gauge"))
    ),
    "base yaw and the first zero": Case(TWO_ON_BASE, ("base_rz", *ZEROS), (({"base_rz": 1, "theta1": -1}, "gauge"),)),
    "base height and the first offset": Case(
        TWO_ON_BASE, ("base_z", "d1", "a1"), (({"base_z": 1, "d1": -1}, "gauge"),)
    ),
    "the last length and the tool": Case(
        replace(TWO, tool=(("x", 0.05),)), (*LENGTHS, "tool_x"), (({"a2": 1, "tool_x": -1}, "gauge"),)
    ),
    "two at once": Case(
        TWO_ON_BASE,
        ("base_rz", "theta1", "base_z", "d1", "a1"),
        (({"base_rz": 1, "theta1": -1}, "gauge"), ({"base_z": 1, "d1": -1}, "gauge")),
    ),
    "an elbow that never moved": Case(TWO, (*LENGTHS, "theta2"), ((stuck_elbow(0.4), "poses"),), held={2: 0.4}),
    "a shoulder that never moved": Case(
        TWO_ON_BASE,
        ("base_x", "base_y", "a1", "theta2"),
        (({"a1": 1, "base_x": -np.cos(0.6), "base_y": -np.sin(0.6)}, "poses"),),
        held={1: 0.3},
    ),
    "parallel axes behind an upright one": Case(ELBOW, ("theta1", "d2", "d3"), (({"d2": 1, "d3": -1}, "gauge"),)),
    "base height under an upright axis": Case(
        ELBOW, ("base_x", "base_y", "base_z", "d1", "theta2"), (({"base_z": 1, "d1": -1}, "gauge"),)
    ),
    "craig: the first length": Case(
        replace(CRAIG, base=(("x", 0.1),)), ("base_x", "a1", "theta2"), (({"base_x": 1, "a1": -1}, "gauge"),)
    ),
    "craig: the first twist": Case(
        replace(CRAIG, base=(("rx", 0.3),)), ("base_rx", "alpha1", "a2"), (({"base_rx": 1, "alpha1": -1}, "gauge"),)
    ),
    "one length written twice": Case(
        DOUBLE, ("after1_z", "after1_z_2", "a1"), (({"after1_z": 1, "after1_z_2": -1}, "gauge"),)
    ),
    "a slide and the base": Case(SLIDE, ("base_z", "d1", "theta2"), (({"base_z": 1, "d1": -1}, "gauge"),)),
    "a slide before a turn about its own axis": Case(
        SLIDE, ("theta1", "theta2", "a2"), (({"theta1": 1, "theta2": -1}, "gauge"),)
    ),
    "tool and target": Case(
        replace(WRIST, tool=(("x", 0.05),)),
        ("tool_x", "target_x", "theta3"),
        (({"tool_x": 1, "target_x": -1}, "gauge"),),
    ),
    "a turn of the tool about its own point": Case(WRIST, ("tool_x", "tool_rx"), (({"tool_rx": 1}, "gauge"),)),
    "two effects of the same meaning": Case(
        ELBOW, ("theta2", "offset2", "gain2", "theta3"), (({"theta2": 1, "offset2": -1}, "gauge"),)
    ),
    "the gain of a joint that stood": Case(
        ELBOW, ("theta2", "gain3", "theta3", "d1"), (({"gain3": 1, "theta3": -0.7}, "poses"),), held={3: 0.7}
    ),
    "a joint that stood at zero": Case(ELBOW, ("gain2", "theta2", "a3"), (({"gain2": 1}, "poses"),), held={2: 0.0}),
    "a straight arm's height seen at first order nowhere": Case(
        replace(TWO, tool=(("rx", 0.0), ("z", 0.0))), ("tool_rx", "tool_z", "a1"), (({"tool_rx": 1}, "values"),)
    ),
}

SOUND = {
    "a planar arm": Case(TWO, (*LENGTHS, *ZEROS)),
    "a planar arm on a base that may shift": Case(TWO_ON_BASE, (*LENGTHS, *ZEROS, "base_x", "base_y")),
    "a planar arm and one height": Case(TWO, (*LENGTHS, *ZEROS, "d1")),
    "the second height": Case(TWO, ("d2", *LENGTHS)),
    "three links": Case(THREE, ("a1", "a2", "a3", "theta1", "theta2", "theta3")),
    "twists of parallel axes": Case(THREE, ("alpha1", "alpha2", "a1", "d3")),
    "an elbow arm": Case(ELBOW, ("d1", "a2", "a3", "theta1", "theta2", "theta3")),
    "an elbow arm on its base": Case(ELBOW, ("base_x", "base_y", "base_z", "a2", "a3", "theta1", "theta2", "theta3")),
    "an elbow arm's twists": Case(ELBOW, ("alpha1", "alpha2", "a1", "theta1", "theta2", "theta3", "d2")),
    "the target on an elbow arm": Case(ELBOW, ("target_x", "target_y", "target_z", "a2", "theta1", "theta2")),
    "a tool's lengths": Case(WRIST, ("tool_x", "tool_z", "theta1", "theta2")),
    "craig": Case(CRAIG, ("a2", "a3", "a4", "alpha2", "alpha3", "alpha4", "theta1", "theta2", "theta3", "theta4")),
    "craig with its base": Case(CRAIG, ("base_x", "base_rx", "theta1", "theta2", "a3", "d4")),
    "a slide": Case(SLIDE, ("d1", "theta2", "theta3", "a2", "a3")),
    "a slide's twist": Case(SLIDE, ("alpha1", "a1", "theta3", "d3")),
    "one of two equal lengths": Case(DOUBLE, ("after1_z", "a1", "a2", "theta1")),
    "offsets and gains": Case(ELBOW, ("offset1", "offset2", "offset3", "gain1", "gain2", "gain3")),
    "an elbow that stood, and what it leaves": Case(TWO, ("a1", "theta1"), held={2: 0.4}),
    "a shoulder that stood, and what it leaves": Case(TWO_ON_BASE, ("a1", "a2", "theta2"), held={1: 0.3}),
    "axes parallel but for half a degree": Case(
        ChainSpec((Row(a=0.3, alpha=np.radians(0.5)), Row(a=0.25))), (*LENGTHS, "d1", "d2")
    ),
    "a joint that hardly moved": Case(ELBOW, ("theta2", "gain2", "a3", "theta3"), held={2: 0.3}, wiggle=0.01),
}


def same_span(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether the rows of two matrices span the same space."""
    if len(one) != len(other):
        return False
    both = [np.linalg.qr(rows.T)[0] for rows in (one, other)]
    return bool(np.linalg.svd(both[0].T @ both[1], compute_uv=False).min() > 1 - 1e-9)


def as_rows(combinations: Sequence[Mapping[str, float]], names: Sequence[str], scales: np.ndarray) -> np.ndarray:
    """Combinations in SI as rows in typical scales."""
    return np.array([[each.get(name, 0.0) for name in names] for each in combinations]).reshape(-1, len(names)) / scales


def oracle_null(case: Case, scales: Mapping[str, float]) -> np.ndarray:
    """What plain numpy says is undetermined, in typical scales of ``case.free``."""
    q = case.poses()
    slopes = jacobian(lambda v: case.chain.tip(v, q), case.chain.nominal(), case.free)
    _, values, directions = np.linalg.svd(slopes * [scales[full(name)] for name in case.free])
    return directions[int(np.sum(values > 1e-8 * values[0])) :]
