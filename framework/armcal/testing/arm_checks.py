"""Checks on what is made of expressions: arm models, joint effects, pose residuals, measurements."""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, TypeVar

import casadi as ca
import numpy as np

from armcal.arm.assembly import MassiveModel, prefixed
from armcal.arm.effects import MOUNT, JointCommand, JointEffect, Spring, check_springs
from armcal.arm.model import Attachment, Chain, Joint, check_chain, forward
from armcal.arm.pose_residual import OF_TOOL, ModelErrors, PoseResidual, Postures
from armcal.arm.statics import MOUNT_FRAME, TOOL_FRAME, frame_names
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, Parameters, declared
from armcal.base.se3 import Expression, Transform, column
from armcal.base.units import ERROR_UNITS, display_unit, si_unit, units_of
from armcal.measure.groups import OTHER
from armcal.measure.measurement import GroupedMeasurement, Measurement
from armcal.measure.reader import surroundings
from armcal.problem.factor import Factor, build_factor
from armcal.problem.readings import readings_by_residual
from armcal.testing.checking import PLUGIN_FAULTS, ContractError, Subject, check, expect
from armcal.testing.planar import ARM, GRAVITY, SkewedArm, all_parameters, planar_arms

C = TypeVar("C")
JOINTS = ("q1", "q2", "q3")
_STEP, _JACOBIAN_TOLERANCE, _ROTATION_TOLERANCE = 1e-5, 1e-6, 1e-9
_LEAST_GAIN, _LEAST_GAIN_M, _MOST_GAIN, _NOTHING = 0.05, 5e-3, 20.0, 1e-9
"""What a unit of a parameter moves, in the same unit: about one. A degree is 0.017 rad, a millimetre 0.001 m."""
_LARGEST = {"m": (100.0, 1.0), "rad": (4 * math.pi, math.pi), "kpx": (20.0, 5.0)}
"""By unit: the largest nominal value, and the largest ordinary correction, that any arm could mean."""
_BRANCHING = "LT LE EQ NE NOT AND OR IF_ELSE_ZERO SIGN FABS FMIN FMAX FLOOR CEIL FMOD COPYSIGN REMAINDER MMIN MMAX"
_CHOICES = {getattr(ca, f"OP_{name}"): name.lower() for name in _BRANCHING.split()}

# --- parameters and expressions of any component --------------------------------------------------------------------


def _declare(s: Subject) -> None:
    """The parameters of a component that was built, in SI units, plausible in them, and able to move."""
    s.blocks = declared(s.built)
    for _, block in scalars(s.blocks, *_LARGEST):
        (largest, widest), worst = _LARGEST[block.unit], max((abs(number) for number in block.nominal), default=0.0)
        expect(
            worst <= largest and block.scale <= widest,
            f"{block.name}: found the nominal value {worst:g} and the scale {block.scale:g} {block.unit}, "
            f"not plausible in their units: expected up to {largest:.3g} and {widest:.3g}: "
            f"is it in {'mm' if block.unit == 'm' else 'deg'}?",
        )
    for block in s.blocks:
        values = np.array(block.nominal, dtype=float)
        sized = f"found {values.size} nominal values, expected {block.size}"
        expect(values.shape == (block.size,), f"{block.name}: {sized}")
        fault = block.domain.check(values)
        expect(not fault, f"{block.name}: its nominal values are outside its domain: {fault}")
        dof = block.domain.dof
        moves = np.linalg.matrix_rank(Parameters((replace(block, free=True),)).retract_jacobian(np.zeros(dof)))
        expect(moves == dof, f"{block.name}: only {moves} of {dof} increments move its nominal value; start elsewhere")
    s.values = symbols(s.blocks)
    s.given = stacked(list(s.values.values()))


def symbols(blocks: Sequence[ParameterBlock]) -> dict[str, Expression]:
    return {block.name: ca.SX.sym(block.name, block.size) for block in blocks}


def near_nominal(blocks: Sequence[ParameterBlock], random: np.random.Generator) -> Array:
    parameters = Parameters(tuple(replace(block, free=True) for block in blocks))
    delta = random.uniform(-1, 1, len(parameters.scales())) * parameters.scales()
    return parameters.retract(np.clip(delta, *parameters.increment_bounds()))


def stacked(parts: Sequence[Expression]) -> Expression:
    """Expressions of any shape as one dense column."""
    return ca.densify(ca.vertcat(ca.SX(0, 1), *[ca.vec(ca.SX(part)) for part in parts]))


def scalars(blocks: Sequence[ParameterBlock], *units: str) -> list[tuple[int, ParameterBlock]]:
    """Blocks of one number in these units, each with its place."""
    places = np.cumsum([0, *(block.size for block in blocks)])
    listed = zip(places.tolist(), blocks, strict=False)
    return [(place, block) for place, block in listed if isinstance(block.domain, Interval) and block.unit in units]


def expect_only(expression: Expression, given: Sequence[Expression]) -> None:
    known = {symbol.element_hash() for input_ in given for symbol in ca.symvar(ca.SX(input_))}
    foreign = sorted({str(s) for s in ca.symvar(ca.SX(expression)) if s.element_hash() not in known})
    expect(not foreign, f"found the symbols {', '.join(foreign)}, expected only those that were given")


def expect_no_choice(expression: Expression, recorded: Expression, given: Expression) -> None:
    """Raise ContractError if an expression chooses by anything but what was recorded, whose numbers are put in."""
    for number in (0.3, -1.2):
        there = ca.substitute(expression, recorded, ca.DM(*recorded.shape) + number)
        function = ca.Function("choices", [given], [ca.densify(there)])
        for operation in map(function.instruction_id, range(function.n_instructions())):
            expect(
                operation not in _CHOICES,
                f"found {_CHOICES.get(operation)} of a parameter or a result, which branches on it; expected a smooth "
                "expression (it may branch on commands and approaches only)",
            )


def expect_derivatives(function: ca.Function, at: Array, what: str, inputs: Sequence[str]) -> None:
    """Raise ContractError unless CasADi's Jacobian of a function of one vector is what differences say."""
    exact = np.asarray(function.jacobian()(at, function(at)), dtype=float)
    expect(bool(np.isfinite(exact).all()), f"the derivative of {what} is not finite")
    for place, name in enumerate(inputs):
        step = np.zeros(len(at))
        step[place] = _STEP * max(1.0, abs(float(at[place])))
        rise = np.asarray(function(at + step)).ravel() - np.asarray(function(at - step)).ravel()
        slope = rise / (2 * step[place])
        allowed = _JACOBIAN_TOLERANCE * max(1.0, float(np.abs(slope).max(initial=0.0)))
        worst = float(np.abs(exact[:, place] - slope).max(initial=0.0))
        expect(worst <= allowed, f"the derivative of {what} by {name} is off by {worst:.1e}, expected {allowed:.1e}")


def expect_all_used(expression: Expression, values: Mapping[str, Expression]) -> None:
    idle = [name for name, symbol in values.items() if not ca.depends_on(ca.SX(expression), symbol)]
    expect(
        not idle,
        f"found that {', '.join(idle)} changes nothing, expected every parameter to have an influence: "
        "is a nominal value used in its place?",
    )


def expect_repeated(picture: Callable[[C], Array], made: C, other: C) -> None:
    """Raise ContractError unless a component, asked twice, and a second one like it give the same numbers."""
    first, second, third = picture(made), picture(made), picture(other)
    expect(np.array_equal(first, second, equal_nan=True), "found other numbers when it was asked a second time")
    expect(
        np.array_equal(first, third, equal_nan=True),
        "found other numbers from a second component of equal settings: it keeps something between calls",
    )


def expect_gain(gain: float, what: str, of: str, unit: str) -> None:
    """Raise ContractError if ``what`` moves by far more or less than about one for each unit of ``of``, if at all."""
    least = _LEAST_GAIN_M if unit == "m" else _LEAST_GAIN
    expect(
        gain <= _NOTHING or least <= gain <= _MOST_GAIN,
        f"found that {what} changes by {gain:.4g} {unit} for each {unit} of {of}, expected about 1: "
        "is one of them in another unit?",
    )


def expect_gains(gains: Array, what: str, blocks: Sequence[ParameterBlock], unit: str, moved: str = "") -> None:
    """``expect_gain`` of each block in a unit."""
    for place, block in scalars(blocks, unit):
        expect_gain(float(gains[place]), what, block.name, moved or unit)


# --- arm models -----------------------------------------------------------------------------------------------------

POSES = 20


@check("model", needed=True)
def the_model_builds_with_joints_and_parameters_in_si_units(s: Subject) -> None:
    s.built = s.build()
    names = s.names = tuple(s.built.joint_names)
    expect(len(names) > 0, "found no joints, expected at least one")
    expect(not any("." in name for name in names), f"found the joints {', '.join(names)}, expected names without dots")
    expect(len(set(names)) == len(names), f"found {', '.join(names)}, expected every name once")
    _declare(s)


@check("model", needed=True)
def its_chain_has_one_joint_for_each_name(s: Subject) -> None:
    s.chain = chain = s.built.chain(s.values)
    check_chain(s.built.chain, chain, s.names)
    both = [joint.name for joint in chain.joints if any(joint.angular) and any(joint.linear)]
    expect(not both, f"joint {', '.join(both)}: found an axis to turn about and one to slide along")
    taken = sorted({MOUNT_FRAME, TOOL_FRAME} & set(chain.frames))
    expect(not taken, f"found a frame called {', '.join(taken)}, which armcal uses itself")
    if isinstance(s.built, MassiveModel):
        frames, masses = frame_names(chain), tuple(s.built.masses())
        odd = [mass for mass in masses if "." in mass.name or mass.mass < 0 or mass.frame not in frames]
        expect(
            not odd, f"found {odd}, expected names without dots, 0 kg or more, and of the frames {', '.join(frames)}"
        )
        names = [mass.name for mass in masses]
        expect(len(set(names)) == len(names), f"found the masses {', '.join(names)}, expected every name once")


@check("model")
def its_chain_depends_on_its_parameters_and_does_not_branch_on_them(s: Subject) -> None:
    chain = s.chain
    transforms = [chain.base_T_mount, chain.tool.joint_T_frame, *(joint.parent_T_joint for joint in chain.joints)]
    transforms += [at.joint_T_frame for at in chain.frames.values()]
    twists = [part for joint in chain.joints if joint.twist is not None for part in joint.twist]
    parts = stacked([*(t.matrix() for t in transforms), *(joint.offset for joint in chain.joints), *twists])
    expect_only(parts, [s.given])
    expect_no_choice(parts, ca.SX(0, 1), s.given)
    expect_all_used(parts, s.values)


@check("model", needed=True)
def random_poses_are_rigid_motions(s: Subject) -> None:
    s.poses, random = _poses(s.given, s.chain), np.random.default_rng(1)
    s.reach = [2.0 if joint.is_revolute else 0.2 for joint in s.chain.joints]
    for _ in range(POSES):
        shown = np.asarray(s.poses(_point(s, random))).reshape(-1, 4, 3).transpose(0, 2, 1)
        rotation = shown[:, :, :3]
        off = rotation @ rotation.transpose(0, 2, 1) - np.eye(3), np.linalg.det(rotation) - 1
        worst = max(float(np.abs(part).max()) for part in off)
        rigid = worst <= _ROTATION_TOLERANCE and bool(np.isfinite(shown).all())
        expect(rigid, f"found a pose that is not finite, or a rotation off orthonormal by {worst:.1e}")


@check("model")
def the_model_is_the_same_each_time(s: Subject) -> None:
    def picture(model: Any) -> Array:
        expect(tuple(model.parameters()) == s.blocks, "found other parameters another time")
        values = symbols(s.blocks)
        poses = _poses(stacked(list(values.values())), model.chain(values))
        return np.asarray(poses(_point(s, np.random.default_rng(4))))

    expect_repeated(picture, s.built, s.build())


@check("model")
def derivatives_of_poses_agree_with_differences(s: Subject) -> None:
    names = (*Parameters(s.blocks).entry_names, *(joint.name for joint in s.chain.joints))
    expect_derivatives(s.poses, _point(s, np.random.default_rng(2)), "the poses", names)


@check("model")
def lengths_move_it_by_lengths_and_angles_by_angles(s: Subject) -> None:  # m for each m, rad for each rad
    random, jacobian = np.random.default_rng(5), s.poses.jacobian()
    points = [_point(s, random) for _ in range(3)]
    slopes = np.array([np.asarray(jacobian(at, s.poses(at)))[:12].reshape(4, 3, -1) for at in points])
    moved = np.linalg.norm(slopes[:, 3], axis=1).max(axis=0)
    expect_gains(moved, "the tool's position", s.blocks, "m")
    turned = np.linalg.norm(slopes[:, :3], axis=(1, 2)).max(axis=0) / np.sqrt(2)
    expect_gains(turned, "the tool's orientation", s.blocks, "rad")


def _poses(given: Expression, chain: Chain) -> ca.Function:
    """Tool, named frames and sites as a function of all entries and displacements."""
    moved = ca.SX.sym("displacement", len(chain.joints))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    shown = [frames.base_T_tool, *frames.named.values(), *(Transform(at.rotation, at.origin) for at in frames.sites)]
    return ca.Function("poses", [stacked([given, moved])], [stacked([pose.matrix()[:3, :] for pose in shown])])


def _point(s: Subject, random: np.random.Generator) -> Array:
    return np.concatenate([near_nominal(s.blocks, random), random.uniform(-1, 1, len(s.reach)) * s.reach])


# --- joint effects, on joints q1, q2 and q3 -------------------------------------------------------------------------


@check("effect", needed=True)
def the_effect_builds_with_parameters_in_si_units(s: Subject) -> None:
    s.built = s.build(JOINTS)
    bases = ", ".join(base.__name__ for base in type(s.built).__bases__)
    expect(isinstance(s.built, JointEffect), f"found that it derives from {bases}, expected armcal.JointEffect")
    s.recorded = ca.SX.sym("recorded", 2 * len(JOINTS))  # command and approach of each joint
    _declare(s)


@check("effect", needed=True)
def it_gives_a_displacement_for_every_joint(s: Subject) -> None:
    s.moved = _displacements(s.built, s.values, s.recorded)


@check("effect")
def its_displacements_are_finite_and_smooth_in_its_parameters(s: Subject) -> None:
    expect_only(s.moved, [s.recorded, s.given])
    expect_no_choice(s.moved, s.recorded, s.given)
    function, entries = ca.Function("displacement", [s.given, s.recorded], [s.moved]), _entries(s, 1)
    for command, approach in product((0.0, 0.3, -1.2), (-1.0, 0.0, 1.0)):
        shown = np.asarray(function(entries, [command, approach] * len(JOINTS))).ravel()
        state = f"for the command {command} from approach {approach:+.0f}"
        expect(bool(np.isfinite(shown).all()), f"found {shown} {state}, expected finite numbers")


@check("effect")
def lengths_and_angles_move_a_joint_by_as_much(s: Subject) -> None:  # at commands and approaches of either sign
    slope = ca.Function("slope", [s.given, s.recorded], [ca.densify(ca.jacobian(s.moved, s.given))])
    entries = _entries(s, 3)
    points = [[command, side] * len(JOINTS) for command in (0.4, -1.2, 2.0) for side in (-1.0, 1.0)]
    gains = np.abs([np.asarray(slope(entries, at)) for at in points]).max(axis=(0, 1), initial=0.0)
    for unit in ("m", "rad"):
        expect_gains(gains, "a joint's displacement", s.blocks, unit)


@check("effect")
def the_effect_is_the_same_each_time(s: Subject) -> None:
    entries = _entries(s, 4)

    def picture(effect: JointEffect) -> Array:
        expect(tuple(effect.parameters()) == s.blocks, "found other parameters another time")
        values = symbols(s.blocks)
        _, loads, laws = _laws(effect, values, s.recorded)
        given, shown = (
            [stacked(list(values.values())), s.recorded, loads],
            stacked([_displacements(effect, values, s.recorded), laws]),
        )
        return np.asarray(ca.Function("all", given, [shown])(entries, [0.4, 1.0] * len(JOINTS), 0.7))

    expect_repeated(picture, s.built, s.build(JOINTS))


@check("effect")
def the_columns_it_reads_are_declared_and_change_its_shape(s: Subject) -> None:
    arm = replace(planar_arms((ARM,))[ARM], effects={"effect": s.built})
    s.conditions = {name: ca.SX.sym(name) for name in arm.conditions}
    surroundings({ARM: arm})
    expect_all_used(_shape(s), s.conditions)


@check("effect", needed=True)
def its_springs_have_a_site_unit_directions_and_one_deflection_a_coordinate(s: Subject) -> None:
    s.springs, s.loads, s.laws = _laws(s.built, s.values, s.recorded)


@check("effect")
def every_parameter_of_the_effect_has_an_influence(s: Subject) -> None:
    expect_all_used(stacked([s.moved, s.laws, _shape(s)]), s.values)


@check("effect")
def its_laws_are_finite_smooth_and_in_rad_at_zero_load_too(s: Subject) -> None:
    expect_only(s.laws, [s.loads, s.recorded, s.given])
    expect_no_choice(s.laws, s.recorded, stacked([s.loads, s.given]))
    states = ([0.0, 0.0], [0.4, 1.0], [-1.2, -1.0])  # command and approach of a joint
    laws = stacked([ca.substitute(s.laws, s.recorded, ca.SX(state * len(JOINTS))) for state in states])
    function, random = ca.Function("laws", [stacked([s.loads, s.given])], [laws]), np.random.default_rng(2)
    entries, count = _entries(s, 2), s.loads.numel()
    names = (*(f"load {i}" for i in range(1, count + 1)), *Parameters(s.blocks).entry_names)
    for load in (np.zeros(count), random.uniform(-2, 2, count)):
        at = np.concatenate([load, entries])
        shown = np.asarray(function(at)).ravel()
        expect(bool(np.isfinite(shown).all()), f"found the deflections {shown} under the loads {load}")
        expect_derivatives(function, at, "the deflections", names)
    # What a parameter in rad adds to a deflection; one in rad/(N m), for each N m.
    slope = ca.Function("slope", [s.given, s.loads], [ca.densify(ca.jacobian(laws, s.given))])
    for unit, most in (("rad", 1.0), ("rad_per_Nm", 2.0)) if s.springs else ():
        loads = most * random.choice([-1, 1], (3, count))
        gains = np.abs([np.asarray(slope(entries, load)) for load in loads]).max(axis=(0, 1), initial=0.0)
        expect_gains(gains / most, "a deflection", s.blocks, unit, "rad")


def _entries(s: Subject, seed: int) -> Array:
    return near_nominal(s.blocks, np.random.default_rng(seed))


def _displacements(effect: JointEffect, values: Mapping[str, Expression], recorded: Expression) -> Expression:
    moved = [effect.displacement(JointCommand(i, *ca.vertsplit(recorded[2 * i : 2 * i + 2])), values) for i in range(3)]
    return stacked([column(effect.displacement, own, 1, "one number (rad or m)") for own in moved])


def _laws(
    effect: JointEffect, values: Mapping[str, Expression], recorded: Expression
) -> tuple[Sequence[Spring], Expression, Expression]:
    """Its springs, their loads, and what they give under these."""
    springs = check_springs(effect.springs, effect.springs(values), len(JOINTS))
    loads, laws, start = ca.SX.sym("loads", sum(spring.size for spring in springs)), [], 0
    for spring in springs:
        of_joint = recorded[2 * spring.site - 2 : 2 * spring.site]
        command = JointCommand(spring.site - 1, *ca.vertsplit(of_joint)) if spring.site else MOUNT
        law = spring.law(loads[start : start + spring.size], command)
        laws.append(column(spring.law, law, spring.size, f"{spring.size} x 1 at the site {spring.site}"))
        start += spring.size
    return springs, loads, stacked(laws)


def _shape(s: Subject) -> Expression:
    links = [se3.translation_along("x", ca.SX.sym(f"l{i}")) for i in range(len(JOINTS) + 1)]
    joints = tuple(Joint(name, link) for name, link in zip(JOINTS, links, strict=False))
    chain = Chain(se3.identity(), joints, Attachment(len(JOINTS), links[-1]))
    shaped = s.built.shaped(chain, s.conditions, s.values)
    moved = [ca.SX(joint.offset) for joint in shaped.joints]
    return stacked([shaped.tool.joint_T_frame.matrix(), *(j.parent_T_joint.matrix() for j in shaped.joints), *moved])


# --- pose residuals, on joints q1, q2 and q3, of a tool that is off by what joint q2 commands ------------------------

_COUNT, _NOISE_M = 240, 1e-4
_LEVERS = 0.3 * np.roll(np.eye(3), 1, axis=0)
"""How the tool moves with each joint (m/rad)."""


@check("residual", needed=True)
def the_residual_learns_an_error_that_its_commands_explain(s: Subject) -> None:
    residual = s.built = s.build(JOINTS)
    expect(isinstance(residual, PoseResidual), f"found {type(residual).__name__}, expected an armcal.PoseResidual")
    expect(residual.learned(_errors(2)) is None, "found that it learned from 2 records")
    s.learned, s.unseen = residual.learned(_errors(_COUNT)), _errors(2 * _COUNT).postures.subset(slice(_COUNT, None))
    expect(s.learned is not None and s.learned.is_learned, f"found that it learned nothing from {_COUNT} records")
    corrections, size = s.learned.corrections(s.unseen), len(OF_TOOL) + len(JOINTS)
    shape = f"found corrections of {corrections.shape}, expected {size} x {_COUNT}: tool and joints"
    expect(corrections.shape == (size, _COUNT), shape)
    before = _shift(s.unseen.commands)
    left = before - corrections[:3] - _LEVERS @ corrections[len(OF_TOOL) :]
    smaller = float(np.linalg.norm(left) / np.linalg.norm(before))
    expect(smaller < 0.7, f"found unseen errors {smaller:.2f} times as large, expected them smaller")


@check("residual")
def it_is_less_sure_away_from_what_it_learned_and_kept_in_its_settings(s: Subject) -> None:
    turned, away = (Postures(s.unseen.commands + angle, s.unseen.approaches) for angle in (2 * np.pi, np.pi))
    expect(not s.learned.corrections(turned).any(), "found corrections beyond the commands that it learned from")
    near, far = (float(np.linalg.norm(s.learned.deviations(own))) for own in (s.unseen, away))
    expect(0 < near < far, f"found deviations of {near:.3g} near and {far:.3g} away, expected that they grow")
    kept = type(s.learned)(type(s.learned.settings).model_validate(s.learned.settings.to_config()), JOINTS)
    for other in (kept, s.built.learned(_errors(_COUNT))):
        expect_repeated(lambda own: np.vstack([own.corrections(s.unseen), own.deviations(s.unseen)]), s.learned, other)


def _errors(count: int) -> ModelErrors:
    random = np.random.default_rng(5)
    commands = random.uniform(-2, 2, (len(JOINTS), count))
    errors = _shift(commands).T + random.normal(0, _NOISE_M, (count, 3))
    slopes = np.zeros((count, 3, len(OF_TOOL) + len(JOINTS)))
    slopes[:, :, :3], slopes[:, :, len(OF_TOOL) :] = -np.eye(3), -_LEVERS
    postures = Postures(commands, np.zeros_like(commands))
    return ModelErrors(postures, ("angle",) * len(JOINTS), errors / _NOISE_M, slopes / _NOISE_M, 3)


def _shift(commands: Array) -> Array:
    """Of the tool (3 x N; m), by joint q2, which turns it further than its command."""
    return np.asarray(_LEVERS[:, 1:2] * (2e-3 * np.sin(2 * commands[1])))


# --- measurements, on arms every point of whose tool moves in a way of its own ---------------------------------------

ARM_NAMES = ((ARM,), ("left", "right"))
"""The arms that a measurement is built for: one, or if it refuses that, two."""
_NOISIEST = {"length": 0.1, "angle": 0.5, "image": 0.05}
"""By dimension: the largest standard deviation (m, rad, kpx) of an example that is worth calibrating with."""
_POINTS = 6
_INSTRUMENT = "instrument"
_GROUP = "front/hole"


@dataclass(frozen=True)
class _Case:
    """A measurement's factor, the blocks of its arms, and all others: its own, and those of one unknown group."""

    factor: Factor
    arm_blocks: tuple[ParameterBlock, ...]
    other_blocks: tuple[ParameterBlock, ...]

    @classmethod
    def of(cls, measurement: Measurement, s: Subject) -> "_Case":
        arms = planar_arms(s.arms, SkewedArm)
        of_arms, own = all_parameters(arms).blocks, prefixed(f"{_INSTRUMENT}.", s.blocks)
        parameters = Parameters((*of_arms, *own))
        parameters = parameters.with_free(parameters.names)
        available = frozenset(f"{_INSTRUMENT}.{channel.name}" for channel in measurement.channels())
        factor = build_factor(_INSTRUMENT, measurement, arms, parameters, GRAVITY, available, unrolled=True)
        of_group = measurement.group_parameters(_GROUP) if isinstance(measurement, GroupedMeasurement) else ()
        return cls(factor, parameters.blocks[: len(of_arms)], (*parameters.blocks[len(of_arms) :], *of_group))

    @property
    def blocks(self) -> tuple[ParameterBlock, ...]:
        return (*self.arm_blocks, *self.other_blocks)

    def point(self, seed: int = 1, off: float = 0.0) -> Array:
        """Values, and a record of what would be read with them; each number of it so far off."""
        random, size = np.random.default_rng(seed), self.factor.values.numel()
        at = np.concatenate([near_nominal(self.blocks, random), random.uniform(-1, 1, self.factor.record.numel())])
        read = dict(zip(self.factor.output_channels, self.numbers(self.factor.outputs, at), strict=True))
        at[size:] = [read.get(name, at[size + i]) + off for i, name in enumerate(self.factor.channels)]
        return at

    def function(self, expression: Expression) -> ca.Function:
        return ca.Function("shown", [stacked([self.factor.values, self.factor.record])], [stacked([expression])])

    def numbers(self, expression: Expression, at: Array) -> Array:
        return np.asarray(self.function(expression)(at)).ravel()

    def slope(self, at: Array) -> Array:
        """Of the residual, by values and record."""
        function = self.function(self.factor.residual)
        return np.asarray(function.jacobian()(at, function(at)))

    def expect_zero(self, at: Array, when: str) -> None:
        worst = float(np.abs(self.numbers(self.factor.residual, at)).max())
        expect(worst <= 1e-9, f"found a residual of {worst:.1e} {when}, expected zero")


@check("measurement", needed=True)
def the_measurement_builds_with_parameters_in_si_units(s: Subject) -> None:
    refused = []
    for names in ARM_NAMES:
        try:
            s.built, s.arms = s.build(names), names
            break
        except PLUGIN_FAULTS as fault:
            refused.append(f"{', '.join(names)}: {fault}")
    else:
        raise ContractError("it refuses every choice of arms; " + "; ".join(refused))
    unknown = [name for name in s.built.arms if name.removesuffix(OTHER) not in s.arms]
    usual = f"found the arms {tuple(s.built.arms)}, expected some of {s.arms}"
    expect(len(s.built.arms) > 0 and not unknown, usual)
    _declare(s)


@check("measurement", needed=True)
def its_channels_have_names_and_dimensions(s: Subject) -> None:
    s.channels = tuple(s.built.channels())
    listed = [channel.name for channel in s.channels]
    plain = len(set(listed)) == len(listed) and all(map(str.isidentifier, listed))
    expect(plain, f"found the channels {', '.join(listed)}, expected every name once, of letters, digits, underscores")
    for channel in s.channels:
        if channel.dimension != "1":
            units_of(channel.dimension)


@check("measurement", needed=True)
def it_makes_a_residual_with_plausible_noise(s: Subject) -> None:
    s.case = _Case.of(s.built, s)
    factor = s.case.factor
    for number, dimension in zip(factor.noise, factor.dimensions, strict=False):
        largest, unit = _NOISIEST.get(dimension, math.inf), si_unit(dimension).name
        most = f"expected up to {largest:g} {unit} in an example: is it in {display_unit(dimension).name}?"
        expect(number <= largest, f"found a noise of {number:g} {unit}, {most}")
    expect_only(stacked([factor.residual, factor.outputs]), [factor.values, factor.record])


@check("measurement")
def the_residual_is_zero_where_outputs_are_measured(s: Subject) -> None:
    if s.channels and set(s.case.factor.output_channels) == {f"{_INSTRUMENT}.{own.name}" for own in s.channels}:
        s.case.expect_zero(s.case.point(), "where its outputs are measured")


@check("measurement")
def its_jacobian_is_finite_and_agrees_with_differences(s: Subject) -> None:
    case = s.case
    function, names = case.function(case.factor.residual), [own for block in case.blocks for own in block.entry_names]
    expect_derivatives(function, case.point(off=0.01), "the residual", (*names, *case.factor.channels))


@check("measurement")
def the_measurement_is_the_same_each_time(s: Subject) -> None:
    def picture(made: Measurement) -> Array:
        same = tuple(made.parameters()) == s.blocks
        expect(same, "found other parameters another time, expected them from its settings alone")
        case = _Case.of(made, s)
        shown = stacked([case.factor.residual, case.factor.outputs, case.factor.nuisance_starts])
        return np.concatenate([case.numbers(shown, s.case.point()), case.factor.noise])

    expect_repeated(picture, s.built, s.build(s.arms))


@check("measurement")
def its_groups_have_the_same_parameters_which_a_record_fits(s: Subject) -> None:
    measurement, case = s.built, s.case
    if not isinstance(measurement, GroupedMeasurement):
        return
    keys = ("", _GROUP, f"{_GROUP}_2")
    shapes = {tuple((b.name, b.domain, b.unit) for b in measurement.group_parameters(key)) for key in keys[:2]}
    expect(len(shapes) == 1, "found groups with different parameters, expected the same names, domains and units")
    names, own = case.factor.nuisance_names, {block.name for block in measurement.group_parameters(_GROUP)}
    if names and set(names) == own:  # one record says all of them
        at, size = case.point(), case.factor.values.numel()
        starts = case.numbers(case.factor.nuisance_starts, at)
        at[size - len(starts) : size] = starts
        case.expect_zero(at, "with what the record itself says")


@check("measurement")
def every_parameter_of_the_measurement_has_an_influence(s: Subject) -> None:
    case, places = s.case, np.cumsum([0, *(block.size for block in s.case.blocks)]).tolist()
    parts = zip(case.blocks, ca.vertsplit(case.factor.values, places), strict=True)
    own = {block.name.removeprefix(f"{_INSTRUMENT}."): part for block, part in parts if block in case.other_blocks}
    expect_all_used(stacked([case.factor.residual, case.factor.outputs]), own)


@check("measurement")
def its_residual_is_in_m_and_rad(s: Subject) -> None:
    """What a length or an angle, of a parameter or as it is read, changes in a residual of the same dimension."""
    case, factor = s.case, s.case.factor
    slope = np.abs([case.slope(case.point(seed, off=0.01)) for seed in range(_POINTS)]).max(axis=0)
    gains: list[tuple[str, str, Array]] = []
    for unit in ("m", "rad"):
        of_arms = [place for place, _ in scalars(case.arm_blocks, unit)]
        others = scalars(case.blocks, unit)[len(of_arms) :]
        gains += [(unit, block.name, slope[:, place]) for place, block in others]
        gains.append((unit, "the arm's parameters", slope[:, of_arms].max(axis=1)))
    for channel in s.channels:
        name = f"{_INSTRUMENT}.{channel.name}"
        if name in factor.channels and channel.dimension in ERROR_UNITS:
            by_reading = slope[:, factor.values.numel() + factor.channels.index(name)]
            gains.append((si_unit(channel.dimension).name, f"the channel {channel.name}", by_reading))
    units = np.array([si_unit(dimension).name for dimension in factor.dimensions])
    for unit, name, moved in gains:
        expect_gain(float(moved[units == unit].max(initial=0.0)), "the residual", name, unit)


@check("measurement")
def the_noise_of_every_reading_follows_from_its_residual(s: Subject) -> None:
    """Also that a position's residual is x, y, z, measured minus predicted: a run tells axes apart by them."""
    case, factor = s.case, s.case.factor
    if not factor.output_channels:
        return
    by_all = np.pad(case.slope(case.point())[:, factor.values.numel() :], ((0, 0), (0, 1)))  # the last column: of none
    places = [factor.channels.index(name) if name in factor.channels else -1 for name in factor.output_channels]
    by_reading = by_all[:, places]
    names = [name.rpartition(".")[2] for name in factor.output_channels]
    idle = [name for name, column in zip(names, by_reading.T, strict=True) if not np.any(column)]
    expect(not idle, f"found that no residual depends on the reading {', '.join(idle)}, expected its noise in one")
    expect(
        readings_by_residual(by_reading[None], np.array(factor.noise)) is not None,
        f"found {len(by_reading)} residuals that the readings {', '.join(names)} do not each determine, expected that "
        "noise of the residual can be worked out as noise of the readings",
    )
    if set("xyz") <= set(names):
        of_position = by_reading[:3, [names.index(axis) for axis in "xyz"]]
        expect(
            bool(np.allclose(of_position, np.eye(3), atol=1e-6)),
            f"found a position's residual that changes by {np.round(of_position, 3).tolist()} with x, y and z, "
            "expected measured minus predicted of x, y and z in this order",
        )
