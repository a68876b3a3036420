"""Components that each break one clause of the contract; the checks must find it."""

from __future__ import annotations

import sys
from dataclasses import replace
from typing import Annotated, Any, ClassVar

import casadi as ca
from armcal.arm.effects import JointEffect, Spring
from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.dataset import Dataset
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.settings import Length, Settings
from armcal.estimate.estimator import Solution, SolverVerdict
from armcal.measure.measurement import Channel
from pydantic import ConfigDict, Field


class Nothing(Settings):
    pass


class Model:
    """Sound; the faulty ones derive from it."""

    Settings: ClassVar[Any] = Nothing
    joint_names: Any = ("a", "b")

    def __init__(self, settings: Any) -> None:
        pass

    def parameters(self) -> Any:
        return (scalar("length", "m", 0.2, 0.01),)

    def chain(self, values: Any) -> Any:
        link = se3.translation_along("x", values["length"])
        joints = tuple(Joint(name, link) for name in ("a", "b"))
        return Chain(se3.identity(), joints, Attachment(2, link))


class NoSettings(Model):
    Settings = dict


class LooseSettings(Model):
    class Settings(Settings):
        model_config = ConfigDict(extra="ignore")


class ForgetfulSettings(Model):
    class Settings(Settings):
        length: Annotated[Length, Field(exclude=True)] = 0.2

        def to_config(self) -> dict[str, Any]:
            return {"length": "0.3 m"}


class NeedsExample(Model):
    class Settings(Settings):
        length: Length


class WrongExample(NeedsExample):
    EXAMPLE: ClassVar[Any] = {"length_deg": 3}


class ExitsWhenBuilt(Model):
    def __init__(self, settings: Any) -> None:
        sys.exit(3)


class OtherJoints(Model):
    joint_names = ("a", "c")


def with_parameter(block: Any) -> type[Model]:
    class Changed(Model):
        def parameters(self) -> Any:
            return (*super().parameters(), block)

    return Changed


DottedParameter = with_parameter(scalar("link.length", "m", 0.2, 0.01))
GlobbedParameter = with_parameter(scalar("length*", "m", 0.2, 0.01))
TwinParameter = with_parameter(scalar("length", "m", 0.2, 0.01))
EndlessParameter = with_parameter(scalar("other", "m", float("nan"), 0.01))
OutsideParameter = with_parameter(scalar("other", "m", -1.0, 0.01, Interval(lower=0.0)))
ShortParameter = with_parameter(ParameterBlock("other", "m", (1.0, 2.0)))
UnscaledParameter = with_parameter(scalar("other", "m", 0.2, 0.0))
MillimetreParameter = with_parameter(scalar("other", "mm", 200.0, 10.0))
FurlongParameter = with_parameter(scalar("other", "furlong", 200.0, 10.0))
NoParameter = with_parameter("other")


class ForeignSymbol(Model):
    def chain(self, values: Any) -> Any:
        return super().chain({"length": values["length"] + ca.SX.sym("elsewhere")})


class Branching(Model):
    def chain(self, values: Any) -> Any:
        return super().chain({"length": ca.if_else(values["length"] > 0.1, values["length"], 0.1)})


class SlantedAxis(Model):
    def chain(self, values: Any) -> Any:
        chain = super().chain(values)
        return replace(chain, joints=(replace(chain.joints[0], angular=(0.0, 1.0, 1.0)), chain.joints[1]))


class LostFrame(Model):
    def chain(self, values: Any) -> Any:
        return replace(super().chain(values), frames={"end": Attachment(3, se3.identity())})


class Shearing(Model):
    def chain(self, values: Any) -> Any:
        sheared = se3.Transform(ca.SX.eye(3) * (1 + values["length"]), ca.SX(3, 1))
        return replace(super().chain(values), base_T_mount=sheared)


class Mirrored(Model):
    def chain(self, values: Any) -> Any:
        mirror = se3.Transform(ca.diag(ca.SX([1, 1, -1])), ca.SX(3, 1))
        return replace(super().chain(values), base_T_mount=mirror)


class Stepped(Model):
    """Its derivative is zero everywhere, and it rises all the same."""

    def chain(self, values: Any) -> Any:
        return super().chain({"length": ca.floor(values["length"] * 1e7) / 1e7})


class Effect(JointEffect):
    """Sound; the faulty ones derive from it."""

    Settings: ClassVar[Any] = Nothing
    size = 1
    site = 1
    directions: Any = ()

    def __init__(self, settings: Any, joint_names: Any) -> None:
        pass

    def parameters(self) -> Any:
        return (scalar("k", "rad_per_Nm", 0.01, 0.01),)

    def law(self, load: Any, k: Any) -> Any:
        return k * load

    def springs(self, values: Any) -> Any:
        return (Spring(self.site, self.directions, lambda load, command: self.law(load, values["k"])),)


class TwoDisplacements(Effect):
    def displacement(self, command: Any, values: Any) -> Any:
        return ca.SX([0, 0])


class BranchingDisplacement(Effect):
    def displacement(self, command: Any, values: Any) -> Any:
        return ca.if_else(command.commanded > values["k"], 0.1, 0.0)


class SingularDisplacement(Effect):
    def displacement(self, command: Any, values: Any) -> Any:
        return values["k"] / command.approach


class RecordedDisplacement(Effect):
    """Sound: it branches on what was recorded."""

    def displacement(self, command: Any, values: Any) -> Any:
        return ca.sign(command.approach) * ca.if_else(command.commanded > 0, values["k"], 2 * values["k"])


class FarSite(Effect):
    site = 4


class AxislessBase(Effect):
    site = 0


class LongDirection(Effect):
    directions = ((0.0, 2.0, 0.0),)


class WideLaw(Effect):
    def law(self, load: Any, k: Any) -> Any:
        return ca.vertcat(k * load, 0)


class SingularLaw(Effect):
    def law(self, load: Any, k: Any) -> Any:
        return k * load / ca.sqrt(load**2)


class DeadZoneLaw(Effect):
    def law(self, load: Any, k: Any) -> Any:
        return k * ca.fmax(load - 0.1, 0)


class Measurement:
    """Sound; the faulty ones derive from it."""

    Settings: ClassVar[Any] = Nothing
    dimension = "length"
    deviations: Any = (1e-3,)
    offset = 0.0

    def __init__(self, settings: Any, arm_names: Any) -> None:
        self.arms = tuple(arm_names)

    def parameters(self) -> Any:
        return ()

    def channels(self) -> Any:
        return (Channel("x", self.dimension),)

    def outputs(self, arms: Any, values: Any) -> Any:
        return {"x": arms[self.arms[0]].base_T_tool.translation[0]}

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return measured["x"] - self.outputs(arms, values)["x"] + self.offset

    def noise(self) -> Any:
        return self.deviations


class ManyNoises(Measurement):
    deviations = (1e-3, 1e-3)


class NoNoise(Measurement):
    deviations = (0.0,)


class Biased(Measurement):
    offset = 0.5


class UnknownOutput(Measurement):
    def outputs(self, arms: Any, values: Any) -> Any:
        return {"y": super().outputs(arms, values)["x"]} if self.arms else {}

    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        return measured["x"]


class SingularMeasurement(Measurement):
    def residual(self, arms: Any, measured: Any, values: Any) -> Any:
        difference = super().residual(arms, measured, values)
        return difference * ca.sqrt(-1 - difference**2)


class RefusesArms(Measurement):
    def __init__(self, settings: Any, arm_names: Any) -> None:
        raise ValueError("no arm suits it")


class TwoArms(Measurement):
    """Sound: it takes two arms."""

    def __init__(self, settings: Any, arm_names: Any) -> None:
        self.arms = tuple(arm_names)
        if len(self.arms) != 2:
            raise ValueError("two arms are needed")


class Reader:
    """Sound, without a path; the faulty ones derive from it."""

    Settings: ClassVar[Any] = Nothing

    def __init__(self, settings: Any) -> None:
        self.settings = settings

    def read(self, request: Any) -> Any:
        return Dataset((), {})


class Estimator:
    """Gives the start back as the answer."""

    Settings: ClassVar[Any] = Nothing
    converged: Any = True

    def __init__(self, settings: Any) -> None:
        pass

    def solve(self, problem: Any, start: Any, progress: Any = None) -> Any:
        return Solution(start, SolverVerdict("lazy", "done", self.converged, 0, 0.0))


class Unconverged(Estimator):
    converged = False


class BoundBreaker(Estimator):
    def solve(self, problem: Any, start: Any, progress: Any = None) -> Any:
        return Solution(start + 1, SolverVerdict("bold", "done", True, 0, 0.0))


class Raising(Estimator):
    def solve(self, problem: Any, start: Any, progress: Any = None) -> Any:
        raise ZeroDivisionError("no step")
