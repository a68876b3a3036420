"""The arm, springs and instrument of the contract's own checks: two links in a vertical plane, and their tip."""

from collections.abc import Mapping, Sequence

import numpy as np

from armcal.arm.assembly import Arm, ArmState
from armcal.arm.model import Attachment, Chain, Joint
from armcal.arm.statics import Environment
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, Parameters, scalar
from armcal.base.se3 import Expression
from armcal.measure.measurement import Channel, Instrument

ARM, TRACKER = "arm", "tracker"
GRAVITY = Environment((0.0, 0.0, -9.81))
NOISE_M = 1e-3


class PlanarArm:
    """Joints q1 and q2 about y; links a1 and a2 along x; ``side`` shifts the arm along y, across its plane."""

    joint_names = ("q1", "q2")
    first_axis = (0.0, 1.0, 0.0)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return (
            scalar("a1", "m", 0.3, 0.01),
            scalar("a2", "m", 0.25, 0.01),
            scalar("theta1", "rad", 0.0, 0.05),
            scalar("theta2", "rad", 0.0, 0.05),
            scalar("side", "m", 0.0, 0.01),
        )

    def chain(self, values: Mapping[str, Expression]) -> Chain:
        upper, fore = (se3.translation_along("x", values[name]) for name in ("a1", "a2"))
        joints = (
            Joint("q1", se3.identity(), self.first_axis, offset=values["theta1"]),
            Joint("q2", upper, (0.0, 1.0, 0.0), offset=values["theta2"]),
        )
        base = se3.translation_along("y", values["side"])
        return Chain(base, joints, Attachment(2, fore), {"elbow": Attachment(1, upper)})


class SkewedArm(PlanarArm):
    """The same, but that q1 turns about z: every point of the tool moves in a way of its own."""

    first_axis = (0.0, 0.0, 1.0)


class Tip(Instrument):
    """The tool's position, without parameters of its own."""

    def __init__(self, arm: str = ARM) -> None:
        self.arms = (arm,)

    def channels(self) -> tuple[Channel, ...]:
        return tuple(Channel(axis, "length") for axis in "xyz")

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> dict[str, Expression]:
        return {axis: self.base_T_tool(arms).translation[i] for i, axis in enumerate("xyz")}

    def noise(self) -> tuple[float, ...]:
        return (NOISE_M,) * 3


def planar_arms(names: Sequence[str], model: type[PlanarArm] = PlanarArm) -> dict[str, Arm]:
    return {name: Arm(name, "planar", model(), {}, ()) for name in names}


def all_parameters(arms: Mapping[str, Arm]) -> Parameters:
    return Parameters(tuple(block for arm in arms.values() for block in arm.parameters()))


def commands(arms: Mapping[str, Arm], count: int, random: np.random.Generator) -> dict[str, Array]:
    """Random commands of every joint: up to 2 rad, or 0.2 m, to either side."""
    return {
        f"{arm.name}.{joint}": random.uniform(-1, 1, count) * (2.0 if dimension == "angle" else 0.2)
        for arm in arms.values()
        for joint, dimension in arm.commanded.items()
    }


def dataset(channels: Mapping[str, Array]) -> Dataset:
    count = len(next(iter(channels.values())))
    return Dataset(tuple(str(i) for i in range(1, count + 1)), dict(channels), source="contract check")
