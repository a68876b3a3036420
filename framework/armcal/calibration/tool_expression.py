"""A calibrated arm as expressions: where its tool is, for what it is commanded and what acts on it.

All parameters are numbers at their calibrated values; what remains are the commands, the approach, the load and the
elastic state. From these come compensation, maps of what the arm can do, and code for other computers. A server
that loads one calibration of an arm after another has some parameters *tuned*: they are channels too, and nothing is
compiled again.
"""

from collections.abc import Callable, Collection, Hashable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from typing import Any, Literal, Self, TypeVar, get_args

import casadi as ca
import numpy as np
from typing_extensions import override

from armcal.arm.assembly import Arm, ArmInputs, ArmState, scoped
from armcal.arm.evaluator import ElasticPass, Evaluator
from armcal.arm.model import forward
from armcal.arm.servo import PulseClock, PulseTable, SteppedEffect
from armcal.arm.statics import LOAD_CHANNELS, STATICS, Environment, Load, tilted
from armcal.base import se3
from armcal.base.arrays import Array, Mask
from armcal.base.parameters import Parameters
from armcal.base.quaternions import rotation_matrix
from armcal.base.se3 import Expression, Transform, evaluated
from armcal.config.system import System
from armcal.errors import ConfigError
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice
from armcal.measure.measurement import Measurement

APPROACH = "approach."
Made = TypeVar("Made")


@dataclass(frozen=True)
class ToolExpression(ElasticPass):
    """One arm whose parameters are numbers.

    ``channels`` are those of ``record``, a symbol each: the joints (rad or m), ``approach.JOINT`` of each (-1 to 1),
    LOAD_CHANNELS (SI, base frame), conditions, tuned parameters.
    """

    name: str  # the arm's instance name
    arm: Arm  # without effects that only let some displacements be set
    joints: tuple[str, ...]  # the commanded ones (n)
    channels: tuple[str, ...]
    defaults: Array  # of each channel where nothing is said; commands and approaches are zero
    base_T_tool: Transform  # at ``state``
    origins: tuple[Expression, ...]  # of the mount and each joint's frame in the base frame, at ``state`` (3x1; m)
    efforts: Expression  # about or along the axes of all joints of the chain, at ``state`` (N m, N on sliding joints)
    servos: Mapping[str, tuple[PulseTable, PulseClock]]  # by commanded joint, which displacements can be set
    tool_T_point: Transform = field(default_factory=se3.identity)  # the point that ``base_T_tool`` is of (constant)
    conditions: tuple[str, ...] = ()
    tuned: frozenset[str] = frozenset()  # blocks of parameters
    blocks: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # numbers of all parameters, tuned or not
    functions: dict[Hashable, Any] = field(init=False, default_factory=dict, repr=False)  # see ``made``

    def at(self, tool_T_point: Transform) -> Self:
        """The same arm, with another point of its tool (constant) where the tool's frame is."""
        if not self.tuned:
            return replace(self, base_T_tool=self.base_T_tool @ tool_T_point, tool_T_point=tool_T_point)
        symbols = ca.SX.sym("tool_T_point", len(_POINT))  # it may follow from parameters that are tuned
        point = Transform(ca.reshape(symbols[:9], 3, 3), symbols[9:])
        return replace(
            self,
            channels=(*self.channels, *_POINT),
            record=ca.vertcat(self.record, symbols),
            defaults=np.concatenate([self.defaults, _numbers_of(tool_T_point)]),
            base_T_tool=self.base_T_tool @ point,
            tool_T_point=tool_T_point,
        )

    def retuned(self, parameters: Parameters, tool_T_point: Transform, environment: Environment) -> Self | None:
        """The same at other values of its tuned parameters, and other loads where nothing is said, with all functions
        that were made of it so far.

        ``parameters`` are of a calibration of the same arm; None if a value differs that is a constant here.
        """
        if not self.tuned.issuperset(self.differing(parameters)):
            return None
        blocks = _blocks(parameters)
        entries = {entry: value for name in self.tuned for entry, value in _entries(name, blocks[name])}
        entries |= zip(LOAD_CHANNELS, environment.acting, strict=True)
        if _POINT[0] in self.channels:
            entries |= dict(zip(_POINT, _numbers_of(tool_T_point), strict=True))
        places = zip(self.channels, self.defaults, strict=True)
        defaults = np.array([entries.get(channel, default) for channel, default in places])
        retuned = replace(self, defaults=defaults, blocks=blocks, tool_T_point=tool_T_point)
        retuned.functions.update(self.functions)
        return retuned

    def differing(self, parameters: Parameters) -> frozenset[str]:
        """The blocks of parameters that have other values, tuned or not."""
        blocks = _blocks(parameters)
        return frozenset(n for n in blocks.keys() | self.blocks.keys() if blocks.get(n) != self.blocks.get(n))

    def made(self, name: Hashable, make: Callable[[], Made]) -> Made:
        """What depends on the expressions alone, made once: a function that serves the retuned ones too."""
        if name not in self.functions:
            self.functions[name] = make()
        function: Made = self.functions[name]
        return function

    @property
    def commands(self) -> Expression:
        """The part of ``record`` that is commanded (n)."""
        return self.record[: len(self.joints)]

    @property
    def acting(self) -> Expression:
        """The part of ``record`` that acts on the arm, in the order of LOAD_CHANNELS."""
        start = self.channels.index(LOAD_CHANNELS[0])
        return self.record[start : start + len(LOAD_CHANNELS)]

    def records(self, commands: Array) -> Array:
        """Records (channels x N) of commands (n x N) where nothing else is said."""
        record = np.repeat(self.defaults[:, None], commands.shape[1], axis=1)
        record[: len(commands)] = commands
        return record

    def uses(self, channels: Sequence[str]) -> bool:
        chosen = ca.vertcat(*[self.record[self.channels.index(channel)] for channel in channels])
        return bool(ca.depends_on(ca.vertcat(ca.vec(self.base_T_tool.matrix()), self.next_state), chosen))

    @override
    def described(self, index: int, record: Array) -> str:
        return f"command {index + 1}"


_POINT = tuple(f"tool_T_point[{i}]" for i in range(12))


def _numbers_of(transform: Transform) -> Array:
    parts = (ca.vec(ca.densify(transform.rotation)), ca.densify(transform.translation))
    return se3.evaluated(ca.vertcat(*parts)).ravel()


def _blocks(parameters: Parameters) -> dict[str, tuple[float, ...]]:
    return {block.name: tuple(map(float, block.nominal)) for block in parameters.blocks if not block.nuisance}


def _entries(name: str, numbers: Sequence[float]) -> list[tuple[str, float]]:
    return [(f"parameter {name}[{i}]", number) for i, number in enumerate(numbers)]


def arm_expression(
    arm: Arm,
    parameters: Parameters,
    environment: Environment,
    conditions: Sequence[str] = (),
    tuned: Collection[str] = (),
) -> ToolExpression:
    """The expressions of an arm at the nominal values of ``parameters``, under what acts where nothing is said.

    ``conditions`` are those of the surroundings that will be stated (``temperature``); others are taken as the
    effects take what is not stated. ``tuned`` parameters are channels of a record, as ``retuned`` needs it.
    """
    idle = [name for name in conditions if name not in arm.conditions]
    if idle:
        known = ", ".join(arm.conditions) or "nothing of the surroundings"
        raise ValueError(f"the arm {arm.name} does not change with {', '.join(idle)}; it changes with {known}")
    stepped = {name: effect for name, effect in arm.effects.items() if isinstance(effect, SteppedEffect)}
    servos = {arm.joint_names[i]: servo for effect in stepped.values() for i, servo in effect.servos().items()}
    smooth = replace(arm, effects={name: effect for name, effect in arm.effects.items() if name not in stepped})
    joints = tuple(arm.commanded)
    blocks = _blocks(parameters)
    symbolic = frozenset(tuned) & blocks.keys()
    entries = dict(entry for name in blocks if name in symbolic for entry in _entries(name, blocks[name]))
    channels = (*joints, *(APPROACH + joint for joint in joints), *LOAD_CHANNELS, *conditions, *entries)
    record = ca.SX.sym("record", len(channels))
    said = dict(zip(channels, ca.vertsplit(record), strict=True))
    values = {name: ca.SX(list(numbers)) for name, numbers in blocks.items()}
    for name in symbolic:
        values[name] = ca.vertcat(*[said[entry] for entry, _ in _entries(name, blocks[name])])
    deflection = ca.SX.sym("deflection", smooth.deflection_size)
    inputs = ArmInputs(
        ca.vertcat(*smooth.joint_commands([said[joint] for joint in joints])),
        ca.vertcat(*smooth.joint_approaches([said[APPROACH + joint] for joint in joints])),
        tilted(Load.of([said[channel] for channel in LOAD_CHANNELS]), scoped(values, f"{STATICS}.")),
        deflection,
        {name: said[name] for name in conditions},
    )
    arm_state = smooth.state(values, inputs)
    stated = entries | dict(zip(LOAD_CHANNELS, environment.acting, strict=True))
    return ToolExpression(
        name=arm.name,
        arm=smooth,
        joints=joints,
        channels=channels,
        defaults=np.array([stated.get(channel, 0.0) for channel in channels]),
        record=record,
        state=deflection,
        next_state=ca.densify(arm_state.next_deflection),
        springs=smooth.spring_names,
        base_T_tool=arm_state.base_T_tool,
        origins=arm_state.origins,
        efforts=ca.densify(arm_state.efforts),
        servos=servos,
        conditions=tuple(conditions),
        tuned=symbolic,
        blocks=blocks,
    )


def sample_inputs(expression: ToolExpression) -> list[Array]:
    """A random record and state (8 columns each), to compare two forms of a function."""
    commands = np.random.default_rng(0).uniform(-1, 1, (len(expression.joints), 8))
    return [expression.records(commands), np.zeros((expression.state.numel(), 8))]


@dataclass(frozen=True)
class Standing:
    states: Array  # n_d x N
    base_T_tool: Array  # N x 4 x 4
    settled: Mask  # which stand where their springs hold them (N)


class Equilibrium:
    def __init__(self, expression: ToolExpression, choice: EvaluatorChoice = "auto") -> None:
        self._size = expression.state.numel()
        many = partial(BatchFunction, sample=sample_inputs(expression), choice=choice)
        tool = expression.base_T_tool.matrix()[:3, :]
        self._evaluator = expression.made(("tool", choice), lambda: Evaluator(expression, tool, many))

    def __call__(self, record: Array, state: Array | None = None) -> Standing:
        states = np.zeros((self._size, record.shape[1])) if state is None else state.copy()
        tools, settled = self._evaluator.settle(np.zeros(0), record, states)
        return Standing(states, poses_of(tools.reshape(1, 4, 3, -1))[0], settled)

    def required(self, record: Array) -> Array:
        tools = self._evaluator(np.zeros(0), record, np.zeros((self._size, record.shape[1])))
        return np.asarray(poses_of(tools.reshape(1, 4, 3, -1))[0])


def poses_of(tools: Array) -> Array:
    """Columns of 3x4 matrices (arms x 4 x 3 x N) as homogeneous ones (arms x N x 4 x 4)."""
    poses = np.zeros((len(tools), tools.shape[-1], 4, 4))
    poses[:, :, :3, :] = tools.transpose(0, 3, 2, 1)
    poses[:, :, 3, 3] = 1.0
    return poses


Point = Literal["tool", "target"]  # What arrives: the origin of the tool's frame, or the target that was measured

_QUATERNION = ("qw", "qx", "qy", "qz")
_SAME_M = 1e-9


@dataclass(frozen=True)
class MeasuredPoint:
    """What a measurement reads of a tool.

    Where free parameters of the measurement say where the target sits (``fitted``), the records determine where the
    target goes, and not where the tool's origin is beside it.
    """

    measurement: str  # its instance name
    tool_T_target: Array  # the pose of the target (4 x 4)
    fitted: bool = False

    @property
    def distance(self) -> float:
        return float(np.linalg.norm(self.tool_T_target[:3, 3]))

    @property
    def transform(self) -> Transform:
        pose = ca.DM(self.tool_T_target)
        return Transform(ca.sparsify(ca.SX(pose[:3, :3])), ca.sparsify(ca.SX(pose[:3, 3])))


def measured_point(system: System, name: str, parameters: Parameters) -> MeasuredPoint | None:
    """The target of an arm's first measurement that reads a place in the base frame; None if no measurement does.

    ``parameters`` have the calibrated values as nominal ones. The target stands on the tool if it has the same place
    there in two postures: an instrument with a frame of its own, or a point of another link, has not.
    """
    arm, values = system.arms[name], {b.name: ca.SX(list(b.nominal)) for b in parameters.blocks if not b.nuisance}
    for instance, measurement in system.measurements.items():
        channels = {channel.name for channel in measurement.channels()}
        if tuple(measurement.arms) != (name,) or not channels.issuperset("xyz"):
            continue
        own = scoped(values, f"{instance}.")
        first, second = (_on_tool(measurement, arm, values, own, angle) for angle in (0.0, 0.3))
        if np.abs(first - second).max() <= _SAME_M:
            free = scoped({block.name: block.scale for block in parameters.free}, f"{instance}.")
            elsewhere = {name: value + free.get(name, 0.0) for name, value in own.items()}
            moved = _on_tool(measurement, arm, values, elsewhere, 0.0)
            return MeasuredPoint(instance, first, bool(np.abs(moved - first)[:3, 3].max() > _SAME_M))
    return None


def tool_point(point: Point, system: System, name: str, parameters: Parameters) -> Transform | None:
    """Where the point that arrives is on the tool of an arm; None for the tool's frame itself."""
    if point not in get_args(Point):
        raise ConfigError(
            f"found the point {point!r}.", hint=f"Expected one of {', '.join(map(repr, get_args(Point)))}."
        )
    if point == "tool":
        return None
    target = measured_point(system, name, parameters)
    if target is None:
        raise ConfigError(
            f"no measurement reads the place of a target on the tool of {name!r} in the base frame.",
            hint="Leave the point target out: then the tool frame's origin arrives.",
        )
    return target.transform


def _on_tool(
    measurement: Measurement, arm: Arm, values: Mapping[str, ca.SX], own: Mapping[str, ca.SX], angle: float
) -> Array:
    """tool_T_target (4 x 4) as the measurement has it where every command is ``angle`` (rad or m)."""
    chain = arm.chain(values)
    moved = arm.joint_commands([ca.SX(angle)] * len(arm.commanded))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    state = ArmState(frames.base_T_tool, frames.named, ca.SX(0, 1), ca.SX.zeros(len(chain.joints)))
    read = measurement.outputs({arm.name: state}, own)
    names = ("x", "y", "z", *(_QUATERNION if set(_QUATERNION) <= set(read) else ()))
    numbers = np.array([evaluated(read[name]).item() for name in names])
    base_T_tool = evaluated(frames.base_T_tool.matrix())
    base_T_target = base_T_tool.copy()
    base_T_target[:3, 3] = numbers[:3]
    if len(numbers) > len("xyz"):
        base_T_target[:3, :3] = rotation_matrix(numbers[3:])
    return np.asarray(np.linalg.inv(base_T_tool) @ base_T_target)
