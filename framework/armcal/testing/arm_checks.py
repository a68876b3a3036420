"""Checks on what is made of expressions: arm models, joint effects, measurements."""

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product

import casadi as ca
import numpy as np

from armcal.arm.assembly import LocalValues, prefixed
from armcal.arm.effects import MOUNT, JointCommand, JointEffect, check_springs
from armcal.arm.model import ArmModel, Attachment, Chain, Joint, check_chain, forward
from armcal.arm.statics import MOUNT_FRAME, TOOL_FRAME
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.domains import Interval
from armcal.base.parameters import ParameterBlock, Parameters, declared
from armcal.base.se3 import Expression, Transform, column
from armcal.base.units import ERROR_UNITS, display_unit, si_unit
from armcal.measure.measurement import Channel, GroupedMeasurement, Measurement
from armcal.measure.reader import surroundings
from armcal.problem.factor import Factor, build_factor
from armcal.problem.variants import readings_by_residual
from armcal.testing.checking import JOINTS, RESULTS, Subject, check, expect
from armcal.testing.planar import ARM, GRAVITY, SkewedArm, all_parameters, planar_arms

_STEP, _JACOBIAN_TOLERANCE, _ROTATION_TOLERANCE = 1e-5, 1e-6, 1e-9
# What a unit of a parameter moves, in the same unit: about one. A degree is 0.017 rad, a millimetre 0.001 m.
_LEAST_GAINS, _MOST_GAIN, _NOTHING = {"m": 5e-3, "rad": 0.05}, 20.0, 1e-9
# By unit: the largest nominal value, and the largest ordinary correction, that any arm could mean.
_LARGEST = {"m": (100.0, 1.0), "rad": (4 * math.pi, math.pi), "kpx": (20.0, 5.0)}
_BRANCHING = "LT LE EQ NE NOT AND OR IF_ELSE_ZERO SIGN FABS FMIN FMAX FLOOR CEIL FMOD COPYSIGN REMAINDER MMIN MMAX"
_CHOICES = {getattr(ca, f"OP_{name}"): name.lower() for name in _BRANCHING.split()}

# --- the expressions of any component ------------------------------------------------------------------------------


@dataclass(frozen=True)
class View:
    """Something that a component gives, as an expression."""

    what: str
    expression: Expression
    rows: Sequence[str]  # the unit of each number of it (``any``: m or rad), where that is known
    given: Expression  # what it is derived by (column): its parameters, and readings, loads or displacements
    columns: Sequence[tuple[str, str]]  # name and unit of each number that is given; no unit where it is not compared
    points: Sequence[Array]  # values of what is given
    recorded: Expression  # commands and conditions, by which it may choose
    states: Sequence[Array] = (np.zeros(0),)  # values of these

    def at_all(self, expression: Expression) -> Array:
        """An expression at each point and state."""
        function = self.function(expression)
        return np.array([np.asarray(function(*at)) for at in product(self.points, self.states)])

    def function(self, expression: Expression) -> ca.Function:
        return ca.Function("shown", [self.given, self.recorded], [ca.densify(expression)])

    def values(self) -> Array:
        return self.at_all(self.expression)[:, :, 0]

    def slopes(self) -> Array:
        return self.at_all(ca.jacobian(self.expression, self.given))


@check("model", "effect", "measurement", needed=True)
def its_parameters_are_in_si_units_and_plausible_in_them(s: Subject) -> None:
    s.blocks = declared(s.built)
    for block in (own for own in s.blocks if own.unit in _LARGEST and isinstance(own.domain, Interval)):
        (largest, widest), worst = _LARGEST[block.unit], max((abs(number) for number in block.nominal), default=0.0)
        expect(
            worst <= largest and block.scale <= widest,
            f"{block.name}: found the nominal value {worst:g} and the scale {block.scale:g} {block.unit}, "
            f"not plausible in their units: expected up to {largest:.3g} and {widest:.3g}: "
            f"is it in {'mm' if block.unit == 'm' else 'deg'}?",
        )
    for block in Parameters(s.blocks).blocks:
        fault = block.domain.check(np.array(block.nominal, dtype=float))
        expect(not fault, f"{block.name}: its nominal values are outside its domain: {fault}")
    s.values = _symbols(s.blocks)


def _symbols(blocks: Sequence[ParameterBlock]) -> dict[str, Expression]:
    return LocalValues({block.name: ca.SX.sym(block.name, block.size) for block in blocks})


def _near_nominal(blocks: Sequence[ParameterBlock], random: np.random.Generator) -> Array:
    parameters = Parameters(tuple(replace(block, free=True) for block in blocks))
    delta = random.uniform(-1, 1, len(parameters.scales())) * parameters.scales()
    return parameters.retract(np.clip(delta, *parameters.increment_bounds()))


def _stacked(parts: Sequence[Expression]) -> Expression:
    return ca.densify(ca.vertcat(ca.SX(0, 1), *[ca.vec(ca.SX(part)) for part in parts]))


def _columns(blocks: Sequence[ParameterBlock], name: str = "") -> list[tuple[str, str]]:
    """Each entry with its unit, if it is a number by itself; under one name for all, if there is one."""
    named = [(own, block) for block in blocks for own in block.entry_names]
    return [(name or own, block.unit if isinstance(block.domain, Interval) else "") for own, block in named]


# --- arm models -----------------------------------------------------------------------------------------------------


@check("model", needed=True)
def its_chain_has_one_joint_for_each_name(s: Subject) -> None:
    chain = s.built.chain(s.values)
    check_chain(s.built.chain, chain, s.built.joint_names)
    taken = sorted({MOUNT_FRAME, TOOL_FRAME} & set(chain.frames))
    expect(not taken, f"found a frame called {', '.join(taken)}, which armcal uses itself")
    s.views = [_poses(s, s.built, s.values)]


@check("model")
def random_poses_are_rigid_motions(s: Subject) -> None:
    shown = s.views[0].values().reshape(-1, 4, 3).transpose(0, 2, 1)
    rotation = shown[:, :, :3]
    off = rotation @ rotation.transpose(0, 2, 1) - np.eye(3), np.linalg.det(rotation) - 1
    worst = max(float(np.abs(part).max()) for part in off)
    rigid = worst <= _ROTATION_TOLERANCE and bool(np.isfinite(shown).all())
    expect(rigid, f"found a pose that is not finite, or a rotation off orthonormal by {worst:.1e}")


def _poses(s: Subject, model: ArmModel, values: Mapping[str, Expression]) -> View:
    """Tool, named frames and sites as a function of all entries and displacements."""
    chain, random = model.chain(values), np.random.default_rng(1)
    moved = ca.SX.sym("displacement", len(chain.joints))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    shown = [frames.base_T_tool, *frames.named.values(), *(Transform(at.rotation, at.origin) for at in frames.sites)]
    reach = [2.0 if joint.is_revolute else 0.2 for joint in chain.joints]
    return View(
        "the pose of the tool or of a frame",
        _stacked([pose.matrix()[:3, :] for pose in shown]),
        ["rad"] * 9 + ["m"] * 3 + [""] * 12 * (len(shown) - 1),
        _stacked([*values.values(), moved]),
        [*_columns(s.blocks), *((joint.name, "") for joint in chain.joints)],
        [np.append(_near_nominal(s.blocks, random), random.uniform(-1, 1, len(reach)) * reach) for _ in range(5)],
        ca.SX(0, 1),
    )


RESULTS["model"] = lambda s, model: (tuple(model.parameters()), _poses(s, model, _symbols(s.blocks)).values())

# --- joint effects, on joints q1, q2 and q3 -------------------------------------------------------------------------

# Command and approach of each joint.
_STATES = [np.array([*at] * len(JOINTS)) for at in product((0.0, 0.4, -1.2, 2.0), (-1.0, 0.0, 1.0))]


@check("effect", needed=True)
def it_gives_displacements_springs_and_a_shape(s: Subject) -> None:
    s.arm = replace(planar_arms((ARM,))[ARM], effects={"effect": s.built})
    surroundings({ARM: s.arm})  # refuses columns without a dimension
    s.views = _of_effect(s, s.built, s.values)


def _of_effect(s: Subject, effect: JointEffect, values: Mapping[str, Expression]) -> list[View]:
    """Displacements of all joints, deflections of its springs under any loads, and an arm's shape under conditions."""
    random = np.random.default_rng(2)
    recorded, entries = ca.SX.sym("recorded", 2 * len(JOINTS)), _near_nominal(s.blocks, random)
    of_joint = [JointCommand(i, recorded[2 * i], recorded[2 * i + 1]) for i in range(len(JOINTS))]
    moved = [
        column(effect.displacement, effect.displacement(own, values), 1, "one number (rad or m)") for own in of_joint
    ]
    springs = check_springs(effect.springs, effect.springs(values), len(JOINTS))
    loads = [ca.SX.sym("load", spring.size) for spring in springs]
    laws = [
        column(
            spring.law,
            spring.law(load, of_joint[spring.site - 1] if spring.site else MOUNT),
            spring.size,
            f"{spring.size} x 1 at the site {spring.site}",
        )
        for spring, load in zip(springs, loads, strict=True)
    ]
    count = sum(spring.size for spring in springs)
    conditions = {name: ca.SX.sym(name) for name in s.arm.conditions}
    lengths = [ca.SX.sym(f"l{i}") for i in range(len(JOINTS) + 1)]
    links = [se3.translation_along("x", length) for length in lengths]
    joints = tuple(Joint(name, link) for name, link in zip(JOINTS, links, strict=False))
    shaped = effect.shaped(Chain(se3.identity(), joints, Attachment(len(JOINTS), links[-1])), conditions, values)
    shape = [
        shaped.tool.joint_T_frame.matrix(),
        *(part for j in shaped.joints for part in (j.parent_T_joint.matrix(), j.offset)),
    ]
    given, around = _stacked(list(values.values())), _stacked([*conditions.values(), *lengths])
    under = [np.append(entries, load) for load in (np.zeros(count), random.choice([-1.0, 1.0], count))]
    by, by_load = _columns(s.blocks), [(f"load {i}", "") for i in range(1, count + 1)]
    shape, laws, moved = _stacked(shape), _stacked(laws), _stacked(moved)
    rows = ["any"] * moved.numel(), ["rad"] * count, [""] * shape.numel()
    return [
        View("a joint's displacement", moved, rows[0], given, by, [entries], recorded, _STATES),
        View("a deflection", laws, rows[1], _stacked([given, *loads]), [*by, *by_load], under, recorded, _STATES),
        View("the arm's shape", shape, rows[2], given, by, [entries], around, [np.full(around.numel(), 0.3)]),
    ]


RESULTS["effect"] = lambda s, effect: [
    tuple(effect.parameters()),
    *(view.values() for view in _of_effect(s, effect, _symbols(s.blocks))),
]

# --- measurements, on arms every point of whose tool moves in a way of its own ---------------------------------------

# By dimension: the largest standard deviation (m, rad, kpx) of an example that is worth calibrating with.
_NOISIEST = {"length": 0.1, "angle": 0.5, "image": 0.05}
_INSTRUMENT = "instrument"
_GROUP = "front/hole"


@dataclass(frozen=True)
class _Case:
    """A measurement's factor, the blocks of its arms, and all others: its own, and those of one unknown group."""

    factor: Factor
    arm_blocks: tuple[ParameterBlock, ...]
    other_blocks: tuple[ParameterBlock, ...]
    channels: tuple[Channel, ...]

    @classmethod
    def of(cls, measurement: Measurement, s: Subject) -> "_Case":
        arms = planar_arms(s.arguments[0], SkewedArm)
        of_arms, own = all_parameters(arms).blocks, prefixed(f"{_INSTRUMENT}.", s.blocks)
        parameters = Parameters((*of_arms, *own))
        parameters = parameters.with_free(parameters.names)
        channels = tuple(measurement.channels())
        available = frozenset(f"{_INSTRUMENT}.{channel.name}" for channel in channels)
        factor = build_factor(_INSTRUMENT, measurement, arms, parameters, GRAVITY, available, unrolled=True)
        of_group = measurement.group_parameters(_GROUP) if isinstance(measurement, GroupedMeasurement) else ()
        return cls(factor, parameters.blocks[: len(of_arms)], (*parameters.blocks[len(of_arms) :], *of_group), channels)

    def view(self, what: str, expression: Expression, points: Sequence[Array], rows: Sequence[str] = ()) -> View:
        units = {f"{_INSTRUMENT}.{own.name}": own.dimension for own in self.channels}
        read = [
            (name, si_unit(units[name]).name if units.get(name) in ERROR_UNITS else "") for name in self.factor.channels
        ]
        columns = [*_columns(self.arm_blocks, "the arm's parameters"), *_columns(self.other_blocks), *read]
        given = _stacked([self.factor.values, self.factor.record])
        return View(what, expression, rows, given, columns, points, ca.SX(0, 1))

    def point(self, seed: int = 1, off: float = 0.0) -> Array:
        """Values, and a record of what would be read with them; each number of it so far off."""
        random, size = np.random.default_rng(seed), self.factor.values.numel()
        values = _near_nominal((*self.arm_blocks, *self.other_blocks), random)
        at = np.append(values, random.uniform(-1, 1, self.factor.record.numel()))
        outputs = self.view("", self.factor.outputs, [at]).values()[0]
        read = dict(zip(self.factor.output_channels, outputs, strict=True))
        at[size:] = [read.get(name, at[size + i]) + off for i, name in enumerate(self.factor.channels)]
        return at

    def expect_zero(self, at: Array, when: str) -> None:
        worst = float(np.abs(self.view("", self.factor.residual, [at]).values()).max())
        expect(worst <= 1e-9, f"found a residual of {worst:.1e} {when}, expected zero")


@check("measurement", needed=True)
def it_makes_a_residual_with_plausible_noise(s: Subject) -> None:
    case = s.case = _Case.of(s.built, s)
    factor, points = case.factor, [case.point(seed, off=0.01) for seed in range(6)]
    for number, dimension in zip(factor.noise, factor.dimensions, strict=True):
        largest, unit = _NOISIEST.get(dimension, math.inf), si_unit(dimension).name
        most = f"expected up to {largest:g} {unit} in an example: is it in {display_unit(dimension).name}?"
        expect(number <= largest, f"found a noise of {number:g} {unit}, {most}")
    rows = [si_unit(dimension).name for dimension in factor.dimensions]
    s.views = [case.view("the residual", factor.residual, points, rows)]
    s.views.append(case.view("what it reads", factor.outputs, points, [""] * factor.outputs.numel()))
    places = np.cumsum([0, *(block.size for block in (*case.arm_blocks, *case.other_blocks))]).tolist()
    parts = ca.vertsplit(factor.values, places)[len(case.arm_blocks) :]
    named = zip(case.other_blocks, parts, strict=True)
    s.values = {block.name.removeprefix(f"{_INSTRUMENT}."): part for block, part in named}


@check("measurement")
def the_residual_is_zero_where_outputs_are_measured(s: Subject) -> None:
    if s.case.channels and len(s.case.factor.output_channels) == len(s.case.channels):
        s.case.expect_zero(s.case.point(), "where its outputs are measured")


@check("measurement")
def the_residual_is_zero_where_a_group_starts_from_all_that_one_record_says(s: Subject) -> None:
    case, factor = s.case, s.case.factor
    of_group = {block.name for block in case.other_blocks} - {f"{_INSTRUMENT}.{block.name}" for block in s.blocks}
    if of_group and set(factor.nuisance_names) == of_group:
        at, size = case.point(), factor.values.numel()
        starts = case.view("", factor.nuisance_starts, [at]).values()[0]
        at[size - len(starts) : size] = starts
        case.expect_zero(at, "with what the record itself says")


@check("measurement")
def the_noise_of_every_reading_follows_from_its_residual(s: Subject) -> None:
    """Also that a position's residual is x, y, z, measured minus predicted: a run tells axes apart by them."""
    factor = s.case.factor
    if not factor.output_channels:
        return
    by_all = np.pad(s.views[0].slopes()[0, :, factor.values.numel() :], ((0, 0), (0, 1)))  # the last column: of none
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


def _of_measurement(s: Subject, measurement: Measurement) -> object:
    case = _Case.of(measurement, s)
    shown = _stacked([case.factor.residual, case.factor.outputs, case.factor.nuisance_starts])
    return tuple(measurement.parameters()), case.factor.noise, case.view("", shown, [s.case.point()]).values()


RESULTS["measurement"] = _of_measurement

# --- any of them ----------------------------------------------------------------------------------------------------


@check("model", "effect", "measurement")
def every_parameter_has_an_influence(s: Subject) -> None:
    shown = _stacked([view.expression for view in s.views])
    idle = [name for name, symbol in s.values.items() if not ca.depends_on(shown, symbol)]
    expect(
        not idle,
        f"found that {', '.join(idle)} changes nothing, expected every parameter to have an influence: "
        "is a nominal value used in its place?",
    )


@check("model", "effect")
def it_does_not_branch_on_a_parameter_or_a_result(s: Subject) -> None:
    """It may branch on what is recorded, whose numbers are put in."""
    for view in s.views:
        for state in view.states:
            there = ca.substitute(view.expression, view.recorded, ca.SX(state))
            function = ca.Function("choices", [view.given], [ca.densify(there)])
            for operation in map(function.instruction_id, range(function.n_instructions())):
                expect(
                    operation not in _CHOICES,
                    f"found {_CHOICES.get(operation)} of a parameter or a result in {view.what}, which branches on it; "
                    "expected a smooth expression (it may branch on commands and approaches only)",
                )


@check("model", "effect", "measurement", needed=True)
def its_derivatives_are_finite_and_agree_with_differences(s: Subject) -> None:
    for view in s.views:
        function, slopes = view.function(view.expression), iter(view.slopes())
        for point, state in product(view.points, view.states):
            slope = next(slopes)
            finite = bool(np.isfinite(slope).all()) and bool(np.isfinite(np.asarray(function(point, state))).all())
            where = ", ".join(f"{name} = {number:.3g}" for (name, _), number in zip(view.columns, point, strict=True))
            where += f", with {state[:2].tolist()} recorded" if state.size else ""
            expect(finite, f"found that {view.what} or a derivative of it is not finite at {where}")
            for place, (name, _) in enumerate(view.columns):
                step = np.zeros(len(point))
                step[place] = _STEP * max(1.0, abs(float(point[place])))
                rise = np.asarray(function(point + step, state) - function(point - step, state)).ravel()
                rise /= 2 * step[place]
                allowed = _JACOBIAN_TOLERANCE * max(1.0, float(np.abs(rise).max(initial=0.0)))
                worst = float(np.abs(slope[:, place] - rise).max(initial=0.0))
                fault = f"the derivative of {view.what} by {name} is off by {worst:.1e}, expected {allowed:.1e}"
                expect(worst <= allowed, fault)


@check("model", "effect", "measurement")
def what_it_gives_is_in_m_and_rad_as_its_parameters_are(s: Subject) -> None:
    """A unit of a parameter or of a reading moves it by about one of the same unit, if at all."""
    for view in s.views:
        slopes = np.abs(view.slopes()).max(axis=0)
        for name, unit in sorted(set(view.columns)):
            moved = "rad" if unit == "rad_per_Nm" else unit  # under loads of 1 N m
            rows = [i for i, own in enumerate(view.rows) if own == moved or (own == "any" and unit in _LEAST_GAINS)]
            columns = [i for i, own in enumerate(view.columns) if own == (name, unit)]
            gain, least = float(slopes[np.ix_(rows, columns)].max(initial=0.0)), _LEAST_GAINS.get(moved, math.inf)
            expect(
                moved not in _LEAST_GAINS or gain <= _NOTHING or least <= gain <= _MOST_GAIN,
                f"found that {view.what} changes by {gain:.4g} {moved} for each {unit} of {name}, expected about 1: "
                "is one of them in another unit?",
            )
