"""Sound arm models, effects and measurements, and twins of each with one fault planted."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.effects import JointEffect, Spring
from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.domains import Interval
from armcal.base.parameters import scalar
from armcal.base.settings import Length, Settings
from armcal.measure.measurement import Channel, Contact
from pydantic import ConfigDict

"""Sound components leave it alone."""
DEGREE = math.pi / 180


class ArmSettings(Settings):
    link: Length = 0.3


class Arm:
    """Sound: two joints about z, with links along x."""

    Settings: ClassVar[Any] = ArmSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"link_mm": 250}
    joint_names: Any = ("a", "b")

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    def parameters(self) -> Any:
        return (scalar("link", "m", self.settings.link, 0.01), scalar("zero", "rad", 0.0, 0.05))

    def chain(self, values: Any) -> Any:
        link = se3.translation_along("x", values["link"])
        joints = (Joint("a", link, offset=values["zero"]), Joint("b", link, angular=(0.0, 1.0, 0.0)))
        return Chain(se3.identity(), joints, Attachment(2, link))


class WithBlock(Arm):
    block: ClassVar[Any] = None

    def parameters(self) -> Any:
        return (*super().parameters(), self.block)


class BlockInDegrees(WithBlock):
    block = scalar("tilt", "deg", 3.0, 1.0)

    def chain(self, values: Any) -> Any:
        return replace(super().chain(values), base_T_mount=se3.rotation_about("x", values["tilt"] * DEGREE))


class MillimetresCalledMetres(Arm):
    def parameters(self) -> Any:
        return (scalar("link", "m", 1000 * self.settings.link, 10.0), scalar("zero", "rad", 0.0, 0.05))

    def chain(self, values: Any) -> Any:
        return super().chain({**values, "link": values["link"] / 1000})


class DegreesCalledRadians(Arm):
    def chain(self, values: Any) -> Any:
        return super().chain({**values, "zero": values["zero"] * DEGREE})


class MillimetresInExpression(Arm):
    def chain(self, values: Any) -> Any:
        return super().chain({**values, "link": values["link"] / 1000 + 0.3})


class DottedName(WithBlock):
    block = scalar("tip.x", "m", 0.0, 0.01)


class TwinName(WithBlock):
    block = scalar("link", "m", 0.2, 0.01)


class OutsideItsDomain(WithBlock):
    block = scalar("stretch", "m", -0.1, 0.01, Interval(lower=0.0))


class IdleParameter(WithBlock):
    """The nominal value stands where the parameter should."""

    block = scalar("rise", "m", 0.2, 0.01)

    def chain(self, values: Any) -> Any:
        return replace(super().chain(values), base_T_mount=se3.translation_along("z", 0.2))


class Floored(Arm):
    def chain(self, values: Any) -> Any:
        return super().chain({**values, "link": ca.floor(values["link"] * 1e4) / 1e4})


class NumericBranch(Arm):
    def chain(self, values: Any) -> Any:
        return super().chain({**values, "link": values["link"] if values["link"] > 0.1 else 0.1})


class OutsideNumpy(Arm):
    """The number is taken out of the expression, and its derivative is lost."""

    def chain(self, values: Any) -> Any:
        return super().chain({**values, "link": float(np.hypot(float(values["link"]), 0.0))})


class _Rounded(ca.Callback):
    def __init__(self) -> None:
        super().__init__()
        self.construct("rounded", {})

    def eval(self, arguments: Any) -> Any:
        return [ca.DM(round(float(arguments[0]), 4))]


class CallbackWithoutDerivative(Arm):
    rounded = _Rounded()

    def chain(self, values: Any) -> Any:
        return super().chain({**values, "link": self.rounded(values["link"])})


class RemembersSymbols(Arm):
    """The chain of the first call is given for ever."""

    def chain(self, values: Any) -> Any:
        if not hasattr(self, "_kept"):
            self._kept = super().chain(values)
        return self._kept


class DriftsEachCall(Arm):
    calls = 0

    def chain(self, values: Any) -> Any:
        self.calls += 1
        return super().chain({**values, "link": values["link"] + 1e-6 * self.calls})


class LongAxis(Arm):
    def chain(self, values: Any) -> Any:
        chain = super().chain(values)
        return replace(chain, joints=(replace(chain.joints[0], angular=(0.0, 0.0, 1.1)), chain.joints[1]))


class Stretching(Arm):
    def chain(self, values: Any) -> Any:
        stretched = se3.Transform(ca.diag(ca.SX([1, 1, 1.01])), ca.SX(3, 1))
        return replace(super().chain(values), base_T_mount=stretched)


class OneJointShort(Arm):
    def chain(self, values: Any) -> Any:
        chain = super().chain(values)
        return replace(chain, joints=chain.joints[:1], tool=Attachment(1, se3.identity()))


class Talkative(Arm):
    def chain(self, values: Any) -> Any:
        print("making the chain")
        return super().chain(values)


class Reseeding(Arm):
    def parameters(self) -> Any:
        np.random.seed(0)
        return super().parameters()


class Silencing(Arm):
    def __init__(self, settings: Any) -> None:
        super().__init__(settings)
        np.seterr(all="ignore", divide="raise")


class BareLength(Arm):
    class Settings(Settings):
        length: float = 0.3

    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def parameters(self) -> Any:
        return (scalar("link", "m", self.settings.length, 0.01), scalar("zero", "rad", 0.0, 0.05))


class UnitInItsName(BareLength):
    class Settings(Settings):
        reach_mm: float = 300.0

    def parameters(self) -> Any:
        return (scalar("link", "m", self.settings.reach_mm / 1000, 0.01), scalar("zero", "rad", 0.0, 0.05))


class AcceptsAnyKey(Arm):
    class Settings(ArmSettings):
        model_config = ConfigDict(extra="ignore")


class Springy(JointEffect):
    """Sound: a lag by the approach, and a spring about each joint."""

    Settings: ClassVar[Any] = type("SpringySettings", (Settings,), {})
    direction: ClassVar[tuple[float, float, float]] = (0.0, 0.0, 1.0)

    def __init__(self, settings: Any, joint_names: Any) -> None:
        self.sites = range(1, len(joint_names) + 1)

    def parameters(self) -> Any:
        return (scalar("lag", "rad", 0.0, 0.01), scalar("k", "rad_per_Nm", 0.01, 0.05))

    def displacement(self, command: Any, values: Any) -> Any:
        return -values["lag"] * command.approach

    def law(self, load: Any, k: Any) -> Any:
        return k * load

    def springs(self, values: Any) -> Any:
        return tuple(
            Spring(site, (self.direction,), lambda load, command: self.law(load, values["k"])) for site in self.sites
        )


class LagInDegrees(Springy):
    def displacement(self, command: Any, values: Any) -> Any:
        return super().displacement(command, values) / DEGREE


class DeflectionInDegrees(Springy):
    def law(self, load: Any, k: Any) -> Any:
        return k * load / DEGREE


class LongDirection(Springy):
    direction = (0.0, 1.0, 1.0)


class BranchingLaw(Springy):
    def law(self, load: Any, k: Any) -> Any:
        return ca.if_else(load > 0, k * load, 2 * k * load)


class TwoNumbersAJoint(Springy):
    def displacement(self, command: Any, values: Any) -> Any:
        return ca.vertcat(super().displacement(command, values), 0)


class LearnsFromCommands(Springy):
    """Every joint gets what the joints before it got in the same call."""

    total = 0.0

    def displacement(self, command: Any, values: Any) -> Any:
        self.total += 0.001
        return super().displacement(command, values) + self.total


class Gauge:
    """Sound: the tip's x and z, and where the instrument stands."""

    Settings: ClassVar[Any] = type("GaugeSettings", (Settings,), {})
    axes: ClassVar[str] = "xz"
    deviations: ClassVar[Any] = (1e-3, 1e-3)

    def __init__(self, settings: Any, arm_names: Any) -> None:
        self.arms = tuple(arm_names)[:1]

    def parameters(self) -> Any:
        return (scalar("shift", "m", 0.0, 0.01),)

    def channels(self) -> Any:
        return tuple(Channel(axis, "length") for axis in self.axes)

    def outputs(self, arms: Any, values: Any) -> Any:
        tip = arms[self.arms[0]].base_T_tool.translation
        return {axis: tip["xyz".index(axis)] + values["shift"] for axis in self.axes}

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        shown = self.outputs(arms, values)
        return ca.vertcat(*[measured[axis] - shown[axis] for axis in self.axes])

    def noise(self) -> Any:
        return self.deviations


class ResidualInMillimetres(Gauge):
    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return 1000 * super().residual(arms, measured, values)


class ReadsMillimetres(Gauge):
    """What it would read is in mm, and so is what it takes from the record."""

    def outputs(self, arms: Any, values: Any) -> Any:
        return {axis: 1000 * value for axis, value in super().outputs(arms, values).items()}


class IdleReading(Gauge):
    """It reads a depth that its residual leaves out: nobody knows how noisy that is."""

    def channels(self) -> Any:
        return (*super().channels(), Channel("depth", "length"))

    def outputs(self, arms: Any, values: Any) -> Any:
        return {**super().outputs(arms, values), "depth": arms[self.arms[0]].base_T_tool.translation[1]}

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        shown = self.outputs(arms, values)
        return ca.vertcat(*[measured[axis] - shown[axis] for axis in self.axes])


class SumAndDifference(Gauge):
    """Sound: what it means in readings can be worked out."""

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        off = super().residual(arms, measured, values)
        return ca.vertcat(off[1] - off[0], off[0] + off[1]) / 2**0.5


class OneReadingTwice(Gauge):
    deviations = (1e-3, 1e-3, 1e-3)

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        off = super().residual(arms, measured, values)
        return ca.vertcat(off, off[0])


class NoiseOfAnotherDimension(Gauge):
    def noise_channels(self) -> Any:
        return ((Channel("noise_x", "length"),), (Channel("noise_z", "dimensionless"),))


class PositionInAnotherOrder(Gauge):
    axes = "xyz"
    deviations = (1e-3, 1e-3, 1e-3)

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        off = super().residual(arms, measured, values)
        return ca.vertcat(off[1], off[0], off[2])


class PositionHalved(PositionInAnotherOrder):
    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return Gauge.residual(self, arms, measured, values) / 2


class NoiseInMillimetres(Gauge):
    deviations = (0.5, 0.5)


class OneNoiseTooFew(Gauge):
    deviations = (1e-3,)


class NegativeNoise(Gauge):
    deviations = (1e-3, -1e-3)


class FlatResidual(Gauge):
    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return super().residual(arms, measured, values).T


class MissesAnOutput(Gauge):
    def outputs(self, arms: Any, values: Any) -> Any:
        return {"y": super().outputs(arms, values)["x"]}

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        shown = super().outputs(arms, values)
        return ca.vertcat(*[measured[axis] - shown[axis] for axis in self.axes])


class AddsInsteadOfSubtracting(Gauge):
    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        shown = self.outputs(arms, values)
        return ca.vertcat(*[measured[axis] + shown[axis] for axis in self.axes])


class SteppedResidual(Gauge):
    """Its derivative is zero by the shift, and it rises all the same."""

    def outputs(self, arms: Any, values: Any) -> Any:
        return super().outputs(arms, {"shift": ca.floor(values["shift"] * 1e7) / 1e7})


class ShiftsEachCall(Gauge):
    calls = 0

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        self.calls += 1
        return super().residual(arms, measured, values) + (1e-12 if self.calls % 2 else 0.0)


class Ledge(Contact):
    """Sound: the tip lies on a ledge of unknown height."""

    Settings: ClassVar[Any] = type("LedgeSettings", (Settings,), {})
    group_labels = ("ledge",)

    def __init__(self, settings: Any, arm_names: Any) -> None:
        self.arms = tuple(arm_names)[:1]

    def group_parameters(self, group: str) -> Any:
        return (replace(scalar("height", "m", 0.0, 0.01), free=True),)

    def group_starts(self, arms: Any, values: Any) -> Any:
        return {"height": arms[self.arms[0]].base_T_tool.translation[2]}

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return arms[self.arms[0]].base_T_tool.translation[2] - values["height"]

    def noise(self) -> Any:
        return (1e-3,)


class LedgeInMillimetres(Ledge):
    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return 1000 * super().residual(arms, measured, values)


class TellsTheOppositeHeight(Ledge):
    def group_starts(self, arms: Any, values: Any) -> Any:
        return {"height": -super().group_starts(arms, values)["height"]}
