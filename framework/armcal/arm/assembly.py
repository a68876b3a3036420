"""An arm: a model, its effects and its masses, put together under one instance name; and its elastic state.

Springs that share a site share its coordinates: their deflections add up.
"""

from collections import defaultdict
from collections.abc import Callable, Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Protocol, runtime_checkable

import casadi as ca
import numpy as np

from armcal.arm.effects import MOUNT, XYZ, Condition, JointCommand, JointEffect, Spring, check_springs
from armcal.arm.model import ArmModel, Chain, Frames, Joint, Mimic, Vector3, check_chain, forward
from armcal.arm.pose_residual import OF_TOOL, SURROUNDINGS, PoseResidual, Postures, corrected, correction_names
from armcal.arm.statics import LOAD_CHANNELS, Environment, Load, MassSpec, SiteWrench, effort, joint_efforts, wrenches
from armcal.base import se3
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, declared, scalar
from armcal.base.poses import pose_transform
from armcal.base.se3 import Expression, Transform, column, evaluated
from armcal.errors import ConfigError, DataError, Location


@dataclass(frozen=True)
class ElasticSite:
    """The coordinates of one site's deflection."""

    site: int  # 0 for the mount, i for joint i (from 1)
    # Rotations about these unit vectors of the site's frame; none for a displacement on the joint's own axis
    directions: tuple[Vector3, ...]
    springs: tuple[Spring, ...]  # what deflects there

    @property
    def size(self) -> int:
        return max(1, len(self.directions))


def elastic_sites(chain: Chain, springs: Sequence[Spring]) -> tuple[ElasticSite, ...]:
    """Sites in the order of their springs; a sliding joint's axis is one of its own: what gives along it is no turn."""
    grouped: dict[tuple[int, bool], list[Spring]] = defaultdict(list)
    for spring in springs:
        slides = spring.site > 0 and not spring.directions and not chain.joints[spring.site - 1].is_revolute
        grouped[spring.site, slides].append(spring)
    alike = {key: len({spring.directions for spring in group}) == 1 for key, group in grouped.items()}
    return tuple(
        ElasticSite(key[0], group[0].directions if alike[key] else XYZ, tuple(group)) for key, group in grouped.items()
    )


def deflections(
    chain: Chain,
    frames: Frames,
    acting: Sequence[SiteWrench],
    sites: Sequence[ElasticSite],
    commands: Sequence[JointCommand],
) -> Expression:
    """What each site's coordinates deflect under the wrenches (rad, or m on a sliding joint's axis), stacked."""
    parts = []
    for site in sites:
        pose, wrench = frames.sites[site.site], acting[site.site]
        joint = chain.joints[site.site - 1] if site.site else None
        command = commands[site.site - 1] if site.site else MOUNT
        total = ca.SX(site.size, 1)
        for spring in site.springs:
            axes = spring.directions or ((joint.axis,) if joint else ())
            along = [ca.dot(ca.mtimes(pose.rotation, ca.SX(list(axis))), wrench.moment) for axis in axes]
            if joint is not None and not site.directions:
                along = [effort(joint, pose, wrench)]
            expected = f"{spring.size} deflections (rad, or m): one a direction"
            given = column(spring.law, spring.law(ca.vertcat(*along), command), spring.size, expected)
            total += given if spring.directions == site.directions else ca.mtimes(_matrix(axes), given)
        parts.append(total)
    return ca.vertcat(*parts) if parts else ca.SX(0, 1)


def split_deflection(
    joints: Sequence[Joint], sites: Sequence[ElasticSite], deflection: Expression
) -> tuple[list[Expression], dict[int, Expression]]:
    """A stacked deflection as what it adds to each joint's displacement, and rotation matrices by site."""
    along = [ca.SX(0) for _ in joints]
    rotations: dict[int, Expression] = {}
    start = 0
    for site in sites:
        part, axes = deflection[start : start + site.size], site.directions
        start += site.size
        if not axes:
            along[site.site - 1] = part
        elif len(axes) > 1:
            rotations[site.site] = se3.small_rotation(ca.mtimes(_matrix(axes), part))
        elif axes[0] in XYZ:
            rotations[site.site] = se3.rotation_about("xyz"[XYZ.index(axes[0])], part).rotation
        else:
            rotations[site.site] = se3.rotation_about_unit(ca.SX(list(axes[0])), part)
    return along, rotations


def _matrix(directions: Sequence[Vector3]) -> Expression:
    return ca.sparsify(ca.horzcat(*[ca.SX(list(axis)) for axis in directions]))


PLACEMENT = "placement"  # What the blocks of an arm's placement are called


@runtime_checkable
class MassiveModel(Protocol):
    """What an arm model may provide beside the rest: the masses that its source states."""

    def masses(self) -> Sequence[MassSpec]:
        """Each in a named frame of the chain; a configured link of the same name takes its place."""


@dataclass(frozen=True)
class ArmInputs:
    """What one record says of one arm."""

    joint_angles: Expression  # commands (n x 1)
    approach: Expression  # n x 1
    load: Load
    deflection: Expression  # to start from
    conditions: Mapping[str, Expression] = field(default_factory=dict)  # what effects read of the surroundings
    correction: Expression | None = None  # of tool and joints (6 + n x 1); see ``pose_residual``


@dataclass(frozen=True)
class ArmState:
    """An arm in one record: its tool and named frames, and the deflection that its springs answer with."""

    base_T_tool: Transform
    frames: Mapping[str, Transform]
    next_deflection: Expression  # in equilibrium, the deflection that was put in
    efforts: Expression = None  # of gravity and load on each joint's own axis (joints x 1; N m, N on sliding joints)
    origins: tuple[Expression, ...] = ()  # of the mount and of each joint's frame in the base frame (3x1 each; m)


@dataclass(frozen=True)
class Arm:
    """One arm of a problem."""

    name: str  # the instance name, first part of every parameter name
    model_name: str  # the model's name within it (``mdh``)
    model: ArmModel
    effects: Mapping[str, JointEffect]  # by their names
    masses: tuple[MassSpec, ...]  # what gravity pulls on
    placement: tuple[ParameterBlock, ...] = ()  # the pose of the model's base in the base frame, where they differ
    joint_noise: float = 0.0  # standard deviation of what a turning joint reads against where it stands (rad)
    residual: PoseResidual | None = None  # what corrects joints and tool, once it is learned
    # By joint, how many times the commands of others its own angle contains beside its own command
    couplings: Mapping[str, Mapping[str, float]] = field(default_factory=dict)

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self.model.joint_names

    @cached_property
    def commanded(self) -> Mapping[str, str]:
        """The joints that records have commands of, with ``angle`` or ``length``: all but those that follow others."""
        joints = zip(self.nominal_chain.joints, self.joint_dimensions, strict=True)
        return {joint.name: dimension for joint, dimension in joints if joint.mimic is None}

    def joint_commands(self, commands: Sequence[Any]) -> list[Any]:
        """What every joint is told (rad or m), couplings added, from the ``commanded`` ones' commands."""
        stated = dict(zip(self.commanded, commands, strict=True))
        content = {
            joint: sum((factor * stated[other] for other, factor in self.couplings.get(joint, {}).items()), own)
            for joint, own in stated.items()
        }
        return self._followed(content, lambda mimic, master: mimic.multiplier * master + mimic.offset)

    def joint_approaches(self, approaches: Sequence[Any]) -> list[Any]:
        """From where every joint came (-1, 0, 1), from the ``commanded`` ones' approaches."""
        content = dict(zip(self.commanded, approaches, strict=True))
        return self._followed(content, lambda mimic, master: float(np.sign(mimic.multiplier)) * master)

    def _followed(self, own: Mapping[str, Any], follow: Callable[[Mimic, Any], Any]) -> list[Any]:
        joints = self.nominal_chain.joints
        return [own[j.name] if j.mimic is None else follow(j.mimic, own[j.mimic.master]) for j in joints]

    @cached_property
    def command_channels(self) -> Mapping[str, str]:
        """Channels of records that carry the commands of the ``commanded`` joints, with ``angle`` or ``length``."""
        return {f"{self.name}.{joint}": dimension for joint, dimension in self.commanded.items()}

    @property
    def correction_channels(self) -> tuple[str, ...]:
        """Channels of records that carry corrections of its tool and joints (see ``pose_residual``)."""
        return tuple(f"{self.name}.{name}" for name in correction_names(self.joint_names))

    def postures(self, dataset: Dataset, environment: Environment) -> Postures:
        stated = {"payload": environment.payload_mass}

        def recorded(channel: str) -> Array:
            default = np.full(len(dataset), stated.get(channel, 0.0))
            return np.nan_to_num(dataset.column(channel)) if dataset.has(channel) else default

        commands = [recorded(channel) for channel in self.command_channels]
        approaches = [recorded(f"{self.name}.approach.{joint}") for joint in self.commanded]
        around = {name: recorded(name) for name in SURROUNDINGS if name in stated or dataset.has(name)}
        return Postures(np.array(self.joint_commands(commands)), np.array(self.joint_approaches(approaches)), around)

    @cached_property
    def joint_dimensions(self) -> tuple[str, ...]:
        return tuple("angle" if joint.is_revolute else "length" for joint in self.nominal_chain.joints)

    @cached_property
    def nominal_chain(self) -> Chain:
        return self.chain(self._nominal)

    @cached_property
    def length(self) -> float:
        steps = [*(joint.parent_T_joint for joint in self.nominal_chain.joints), self.nominal_chain.tool.joint_T_frame]
        return float(sum(np.linalg.norm(evaluated(step.translation)) for step in steps))

    @cached_property
    def _nominal(self) -> dict[str, Expression]:
        return {block.name: ca.SX(list(block.nominal)) for block in self.parameters()}

    def parameters(self) -> tuple[ParameterBlock, ...]:
        blocks = list(prefixed(f"{self.name}.", self.placement))
        blocks += prefixed(self._scope(self.model_name), declared(self.model))
        for name, effect in self.effects.items():
            blocks += prefixed(self._scope(name), declared(effect))
        for mass in self.masses:
            local = [scalar("mass", "kg", mass.mass, 0.1)]
            local += [scalar(f"com_{axis}", "m", x, 0.01) for axis, x in zip("xyz", mass.com, strict=True)]
            blocks += prefixed(self._scope(f"links.{mass.name}"), local)
        return tuple(blocks)

    def chain(self, values: Mapping[str, Expression]) -> Chain:
        chain = self.model.chain(scoped(values, self._scope(self.model_name)))
        check_chain(self.model.chain, chain, self.joint_names)
        if self.couplings:
            joints = (replace(joint, couplings=self.couplings.get(joint.name, {})) for joint in chain.joints)
            chain = replace(chain, joints=tuple(joints))
        if not self.placement:
            return chain
        base_T_model = pose_transform(PLACEMENT, scoped(values, f"{self.name}."))
        return replace(chain, base_T_mount=base_T_model @ chain.base_T_mount)

    def springs(self, values: Mapping[str, Expression]) -> tuple[Spring, ...]:
        every: list[Spring] = []
        for name, effect in self.effects.items():
            springs = effect.springs(scoped(values, self._scope(name)))
            every += check_springs(effect.springs, springs, len(self.joint_names))
        return tuple(every)

    @cached_property
    def deflection_size(self) -> int:
        return len(self.spring_names)

    @property
    def depends_on_payload(self) -> bool:
        """Whether what hangs on the tool moves it: the arm is elastic, or its residual has learned what loads do."""
        return bool(self.deflection_size) or (self.residual is not None and self.residual.knows_load)

    @cached_property
    def spring_names(self) -> tuple[str, ...]:
        sites = elastic_sites(self.nominal_chain, self.springs(self._nominal))
        names = (f"the mount of {self.name}", *(f"joint {joint} of {self.name}" for joint in self.joint_names))
        return tuple(names[site.site] for site in sites for _ in range(site.size))

    def state(self, values: Mapping[str, Expression], inputs: ArmInputs) -> ArmState:
        """One elastic pass: the arm's frames at a deflection, and the deflection these frames lead to."""
        chain = self._shaped(values, inputs)
        sites = elastic_sites(chain, self.springs(values))
        along, rotations = split_deflection(chain.joints, sites, inputs.deflection)
        commands = [JointCommand(i, inputs.joint_angles[i], inputs.approach[i]) for i in range(len(chain.joints))]
        displacements = [
            joint.offset + along[i] + self.displacement(values, commands[i]) for i, joint in enumerate(chain.joints)
        ]
        correction = inputs.correction
        if self.residual is not None and self.residual.is_learned:
            around = {"payload": inputs.load.payload_mass, **inputs.conditions}
            learned = self.residual.correction(inputs.joint_angles, inputs.approach, around)
            correction = learned if correction is None else learned + correction
        if correction is not None:
            of_joints = ca.vertsplit(correction[len(OF_TOOL) :])
            displacements = [own + more for own, more in zip(displacements, of_joints, strict=True)]
        frames = forward(chain, displacements, rotations)
        acting = wrenches(chain, frames, self._masses(values), inputs.load)
        answer = deflections(chain, frames, acting, sites, commands)
        origins = tuple(site.origin for site in frames.sites)
        tool = frames.base_T_tool if correction is None else corrected(frames.base_T_tool, correction)
        return ArmState(tool, frames.named, answer, joint_efforts(chain, frames, acting), origins)

    @property
    def conditions(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(condition.name for _, condition in self.declared))

    @property
    def declared(self) -> tuple[tuple[str, Condition], ...]:
        read = [(name, effect.conditions) for name, effect in self.effects.items()]
        read += [] if self.residual is None else [("residual", self.residual.conditions)]
        return tuple(
            (name, condition if isinstance(condition, Condition) else Condition(condition))
            for name, conditions in read
            for condition in conditions
        )

    def _shaped(self, values: Mapping[str, Expression], inputs: ArmInputs) -> Chain:
        chain = self.chain(values)
        for name, effect in self.effects.items():
            try:
                shaped = effect.shaped(chain, inputs.conditions, scoped(values, self._scope(name)))
            except KeyError as fault:
                missing = fault.args[0]
                if missing in inputs.conditions or missing not in self.conditions:
                    raise
                raise DataError(
                    f"the effect {self._scope(name)[:-1]} reads {missing}, which is not recorded.",
                    hint=f"Add a column {missing} with its unit.",
                ) from fault
            check_chain(effect.shaped, shaped, self.joint_names)
            chain = shaped
        return chain

    def displacement(self, values: Mapping[str, Expression], command: JointCommand) -> Expression:
        """What a joint is told, and what its effects add (rad or m)."""
        total = ca.SX(0)
        for name, effect in self.effects.items():
            added = effect.displacement(command, scoped(values, self._scope(name)))
            total += column(effect.displacement, added, 1, "one number or expression (rad or m)")
        return command.commanded + total

    def _masses(self, values: Mapping[str, Expression]) -> list[MassSpec]:
        result = []
        for mass in self.masses:
            local = scoped(values, self._scope(f"links.{mass.name}"))
            com = ca.sparsify(ca.vertcat(*[local[f"com_{axis}"] for axis in "xyz"]))
            result.append(replace(mass, mass=local["mass"], com=com))
        return result

    def _scope(self, component: str) -> str:
        return f"{self.name}.{component}."


def prefixed(scope: str, blocks: Sequence[ParameterBlock]) -> tuple[ParameterBlock, ...]:
    return tuple(replace(block, name=scope + block.name) for block in blocks)


class LocalValues(dict[str, Expression]):
    """Values under local names, which says of an unknown name which ones there are."""

    def __missing__(self, name: str) -> Expression:
        raise KeyError(f"found no parameter {name!r}, expected one of {', '.join(sorted(self)) or 'none'}")


def scoped(values: Mapping[str, Expression], scope: str) -> LocalValues:
    return LocalValues({name.removeprefix(scope): value for name, value in values.items() if name.startswith(scope)})


def command_channels(arms: Mapping[str, Arm]) -> dict[str, str]:
    return {channel: dimension for arm in arms.values() for channel, dimension in arm.command_channels.items()}


def within_couplings(arms: Iterable[Arm], commands: Array) -> Mask:
    """Which commands of all arms (n x N) keep the angles of coupled joints within the model's limits (N)."""
    within, first = np.ones(commands.shape[1], dtype=bool), 0
    for arm in arms:
        own = commands[first : first + len(arm.commanded)]
        first += len(own)
        for joint, angles in zip(arm.nominal_chain.joints, arm.joint_commands([*own]), strict=True):
            if joint.couplings and joint.limits is not None:
                within &= (angles >= joint.limits[0]) & (angles <= joint.limits[1])
    return within


def shown_joint(channel: str, arms: Collection[str]) -> str:
    """A joint, by the channel of its commands, as people call it: ``q1``, or ``left.q1`` of several arms."""
    return channel.partition(".")[2] if len(arms) == 1 else channel


def only_arm(arms: Mapping[str, Arm], purpose: str, hint: str, where: Location | None = None) -> Arm:
    """The arm of a system that has one; ``purpose`` says why one is expected."""
    if len(arms) != 1:
        raise ConfigError(
            f"found {len(arms)} arms ({', '.join(arms)}), expected one: {purpose}.", where=where, hint=hint
        )
    return next(iter(arms.values()))


@dataclass(frozen=True)
class SiteLoads:
    """Loads and levers of all sites (0 the mount, i joint i), on the rigid arm."""

    moments: Array  # in the site's own axes, about its origin (sites x 3 x N; N m)
    efforts: Array  # about each joint's axis, or along it (joints x N; N m, N on sliding joints)
    levers: Array  # of the tip in the base frame by turns about the site's axes (sites x 3 x 3 x N; m/rad)


def site_loads(arm: Arm, values: Mapping[str, Array], commands: Array, acting: Array) -> SiteLoads:
    """Loads at commands (joints x N; rad or m) under what acts (LOAD_CHANNELS x N).

    ``values`` are the arm's parameter blocks by full name, as a calibration left them; masses are the stated ones.
    """
    chain = arm.chain({name: ca.SX(list(value)) for name, value in values.items()})
    joints, what = ca.SX.sym("commands", len(chain.joints)), ca.SX.sym("acting", len(LOAD_CHANNELS))
    frames, wrenches_of = _rigid_statics(arm, chain, ca.vertsplit(joints), Load.of(ca.vertsplit(what)))
    moments, levers = [], []
    for site, wrench in zip(frames.sites, wrenches_of, strict=True):
        moments.append(ca.mtimes(site.rotation.T, wrench.moment))
        lever = frames.base_T_tool.translation - site.origin
        levers += [ca.cross(ca.densify(site.rotation[:, axis]), ca.densify(lever)) for axis in range(3)]
    stacked = ca.densify(ca.vertcat(*moments, joint_efforts(chain, frames, wrenches_of), *levers))
    function = ca.Function("site_loads", [joints, what], [stacked], {"cse": True})
    loads = np.asarray(function.map(commands.shape[1])(commands, acting).full())
    sites, ends = len(frames.sites), (3 * len(frames.sites), 3 * len(frames.sites) + len(chain.joints))
    by_site = loads[ends[1] :].reshape(sites, 3, 3, -1).swapaxes(1, 2)
    return SiteLoads(loads[: ends[0]].reshape(sites, 3, -1), loads[ends[0] : ends[1]], by_site)


def holding_function(
    arm: Arm, gravity: Vector3, payload: float = 0.0, payload_com: Vector3 = (0.0, 0.0, 0.0)
) -> ca.Function:
    """From commands (joints) to the static effort on each (N m or N), rigid and nominal.

    Gravity (m/s^2) is in the base frame, the payload (kg, m) in the tool frame.
    """
    chain, commands = arm.nominal_chain, ca.SX.sym("commands", len(arm.commanded))
    load = Environment(gravity, payload, payload_com).load
    frames, loads = _rigid_statics(arm, chain, arm.joint_commands(ca.vertsplit(commands)), load)
    efforts = ca.vertsplit(ca.densify(joint_efforts(chain, frames, loads)))
    own = [held for held, joint in zip(efforts, chain.joints, strict=True) if joint.mimic is None]
    return ca.Function("efforts", [commands], [ca.vertcat(*own)], {"cse": True})


def _rigid_statics(
    arm: Arm, chain: Chain, commands: Sequence[Expression], load: Load
) -> tuple[Frames, tuple[SiteWrench, ...]]:
    """Frames and wrenches without effects, with the stated masses; ``commands`` are of all joints of the chain."""
    frames = forward(chain, [joint.offset + commands[i] for i, joint in enumerate(chain.joints)], {})
    masses = [replace(mass, mass=ca.SX(mass.mass), com=ca.SX(list(mass.com))) for mass in arm.masses]
    return frames, wrenches(chain, frames, masses, load)
