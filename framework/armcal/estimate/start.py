"""Where a fit starts: the base and the target as the records have them, where the configuration has them elsewhere.

Measurements may propose a start of their own from what they read: a camera's intrinsics and hand-eye pose.

Which free parameters say where an arm stands and where the target sits on its tool, and their values for a place.

Nothing declares them: a parameter is the base's if it moves all tools as one rigid motion in the base frame, and the
target's if it moves each by the same motion in its own axes.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.effects import JointCommand
from armcal.arm.model import forward
from armcal.arm.statics import BASE_FRAME, TOOL_FRAME
from armcal.base import domains
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.units import digits
from armcal.errors import NotConvergedError, ProblemError
from armcal.estimate.polish import descended
from armcal.measure.measurement import Carried, Proposing, Reading, borrowed_names
from armcal.problem.problem import PosedProblem, Problem
from armcal.problem.rigid_alignment import (
    Alignment,
    Sighting,
    Tools,
    alignments,
    hand_eye,
    shown_instead,
    sighting_of,
    spread_of,
    tools_of,
    undetermined,
)

_POSES, _STEP = 24, 1e-5
_SAME_MOTION = 0.02  # Of a parameter's motion of the tool: what may differ from one rigid motion
_RANK = 1e-3
_DRAWS, _SEED, _MOST_STEPS, _DAMPING = 12, 5, 30, 1e-4
_REACHED = 1e-3  # Of the spread of the positions: a place is reached


@dataclass(frozen=True)
class _Motion:
    """What a parameter moves as one: the arm, else the target; by each increment (turn times the size, shift)."""

    name: str
    of_base: bool
    twists: tuple[Array, ...]


@dataclass(frozen=True)
class Placing:
    """Free parameters that move the arm as a whole, or the target on its tool."""

    base: tuple[str, ...]  # names of those that move the arm
    target: tuple[str, ...]  # names of those that move the target
    basis: Array  # orthonormal directions in the tool's axes along which these move it (3 x k)
    rank: int  # how many of the six motions the base can make
    shifts: tuple[tuple[str, Array], ...] = ()  # numbers that only shift the target, with the direction (3)

    @property
    def names(self) -> tuple[str, ...]:
        return (*self.base, *self.target)

    @property
    def stands_anywhere(self) -> bool:
        return self.rank == 6

    @classmethod
    def of(cls, motions: Sequence[_Motion]) -> Placing:
        base = tuple(motion for motion in motions if motion.of_base)
        target = tuple(motion for motion in motions if not motion.of_base)
        shifts = [(m.name, m.twists[0][3:]) for m in target if len(m.twists) == 1 and _shifts_only(m.twists[0])]
        rank = _basis([twist for motion in base for twist in motion.twists], 6).shape[1]
        basis = _basis([shift for _, shift in shifts], 3)
        return cls(tuple(m.name for m in base), tuple(m.name for m in target), basis, rank, tuple(shifts))

    def with_target(self, parameters: Parameters, values: Array, offset: Array) -> Array:
        """Values that have the target moved by an offset in the tool's axes (3, m)."""
        moved = values.copy()
        if self.shifts:
            steps = np.linalg.pinv(np.array([shift for _, shift in self.shifts]).T) @ offset
            for (name, _), step in zip(self.shifts, steps, strict=True):
                moved[parameters.entries_of(name)] += step
        return moved

    def reached(self, problem: Problem, sighting: Sighting, shown: Tools) -> Array:
        """The value vector at which the instrument would see ``shown`` in the sighting's records, or nearest to it."""
        few = sighting.thinned(_POSES)
        at = np.searchsorted(sighting.chosen, few.chosen)
        some = shown_instead(problem.subset(few.chosen), sighting.kernel, shown.subset(at))
        alone = [np.full(some.count, float(number == sighting.kernel)) for number in range(len(some.records))]
        own = {name: replace(problem.parameters[name], prior_sd=None) for name in self.names}
        parameters = problem.parameters.replaced(own).with_free(self.names)
        posed = PosedProblem(some.weighted(alone).with_parameters(parameters, tied=False))
        seen = replace(
            few, measured=shown.places[:, at], turned=few.turned if few.turned is None else shown.rotations[at]
        )
        best, least, random = problem.parameters.nominal(), np.inf, np.random.default_rng(_SEED)
        for draw in range(_DRAWS):
            try:
                start = posed.x(_turned(parameters, random) if draw else parameters.nominal())
                values = posed.values(descended(posed, start, _MOST_STEPS, _DAMPING, 1e-9))
                off = seen.off(tools_of(some, values, sighting.kernel))
            except NotConvergedError:
                continue
            if off < least:
                best, least = values, off
            if off <= _REACHED * sighting.size:
                break
        return best


def placings(problem: Problem, sighting: Sighting) -> tuple[Placing, Placing]:
    """Of the free parameters without a prior, and of all free ones."""
    poses = problem.subset(sighting.thinned(_POSES).chosen)
    nominal = problem.parameters.nominal()
    here = tools_of(poses, nominal, sighting.kernel)
    size, motions, held = max(spread_of(here.places), 1e-9), list[_Motion](), list[_Motion]()
    for block in problem.parameters.free:
        if block.nuisance or block.unit not in ("m", "rad", "1"):
            continue
        place, moves = problem.parameters.entries_of(block.name), list[Tools]()
        step = _STEP * block.domain.increment_scale(block.scale)
        for unit in np.eye(block.domain.dof):
            moved = nominal.copy()
            moved[place] = block.domain.retract(np.array(block.nominal), step * unit)
            there = tools_of(poses, moved, sighting.kernel)
            moves.append(Tools((there.places - here.places) / step, (there.rotations - here.rotations) / step))
        for of_base, twist_of in ((True, _base_twist), (False, _tool_twist)):
            twists = [twist for twist in (twist_of(here, move, size) for move in moves) if twist is not None]
            along = of_base or sighting.turned is not None or all(map(_shifts_only, twists))
            if len(twists) == len(moves) and along:
                (motions if block.prior_sd is None else held).append(_Motion(block.name, of_base, tuple(twists)))
                break
    return Placing.of(motions), Placing.of([*motions, *held])


def _base_twist(here: Tools, move: Tools, size: float) -> Array | None:
    """The one motion (turn times the size, shift of the middle) of all tools; None if there is none."""
    turns = _turns(move.rotations @ np.swapaxes(here.rotations, 1, 2))
    arm = here.places - here.places.mean(axis=1, keepdims=True)
    turn, shift = turns.mean(axis=0), move.places.mean(axis=1)
    away = move.places - np.cross(turn, arm.T).T - shift[:, None]
    return _one_motion(np.r_[size * turn, shift], np.c_[size * (turns - turn), away.T], move, size)


def _tool_twist(here: Tools, move: Tools, size: float) -> Array | None:
    """The one motion (turn times the size, shift) of each tool in its own axes; None if there is none."""
    turns = _turns(np.swapaxes(here.rotations, 1, 2) @ move.rotations)
    shifts = np.einsum("nji,jn->ni", here.rotations, move.places)
    turn, shift = turns.mean(axis=0), shifts.mean(axis=0)
    return _one_motion(np.r_[size * turn, shift], np.c_[size * (turns - turn), shifts - shift], move, size)


def _one_motion(twist: Array, away: Array, move: Tools, size: float) -> Array | None:
    total = np.sum(move.places**2) + size**2 * np.sum(move.rotations**2) / 2
    return twist if total > 0 and np.sum(away**2) <= _SAME_MOTION**2 * total else None


def _shifts_only(twist: Array) -> bool:
    return float(np.linalg.norm(twist[:3])) <= _SAME_MOTION * float(np.linalg.norm(twist[3:]))


def _turns(skew: Array) -> Array:
    """The vectors (N x 3) of skew matrices (N x 3 x 3)."""
    return (
        np.stack([skew[:, 2, 1] - skew[:, 1, 2], skew[:, 0, 2] - skew[:, 2, 0], skew[:, 1, 0] - skew[:, 0, 1]], 1) / 2
    )


def _basis(columns: Sequence[Array], size: int) -> Array:
    """Orthonormal directions (size x k) that columns make, each column counted alike; axes where they can be."""
    unit = [column / np.linalg.norm(column) for column in columns if np.linalg.norm(column) > 0]
    left, sizes, _ = np.linalg.svd(np.array(unit).reshape(-1, size).T, full_matrices=False)
    left = left[:, sizes > _RANK * sizes.max(initial=0.0)]
    within, directions = left @ left.T, list[Array]()
    for _ in range(left.shape[1]):
        direction = within[:, int(np.argmax(np.diag(within)))]
        directions.append(direction / np.linalg.norm(direction))
        within = within - np.outer(directions[-1], directions[-1] @ within)
    return np.array(directions).reshape(-1, size).T


def _turned(parameters: Parameters, random: np.random.Generator) -> Array:
    values = parameters.nominal()
    for block in parameters.free:
        place = parameters.entries_of(block.name)
        if isinstance(block.domain, domains.Rotation):
            values[place] = Rotation.random(random_state=random).as_quat()[[3, 0, 1, 2]]
        elif isinstance(block.domain, domains.Interval) and block.unit == "rad":
            drawn = random.uniform(-np.pi, np.pi)
            values[place] = np.clip(values[place] + drawn, block.domain.lower, block.domain.upper)
    return values


MOST_RECORDS = 300
FAR = 0.03  # Of the spread of the positions: a start that is off by less is near enough for any fit
BETTER = 2.0  # So many times less must be left for the configuration's start to be given up
BEYOND = 4.0  # Standard deviations of a prior: what is farther contradicts it
_MM = 1000.0


@dataclass(frozen=True)
class Start:
    """Where a fit starts; parameters with a prior keep their nominal value in ``problem``, and start in ``vectors``."""

    problem: Problem  # its nominal values are where base and target were found, where the configuration's are far off
    names: tuple[str, ...] = ()  # of the parameters that place the arm and the target
    vectors: tuple[Array, ...] = ()  # values at which they were found, the best first; of no other parameters
    alignment: Alignment | None = None  # of the nominal arm; None where there is none
    configured: float = 0.0  # typical distance (m) of the arm from the positions
    left: float = 0.0  # the same from where they were found
    taken: bool = False  # whether the start is elsewhere than the configuration has it
    gauges: tuple[str, ...] = ()  # what the positions do not determine of base and target, in words
    warnings: tuple[str, ...] = ()  # for the user

    def values(self, problem: Problem) -> tuple[Array, ...]:
        starts, parameters = list[Array](), problem.parameters
        for vector in self.vectors:
            values = parameters.nominal()
            for name in self.names:
                values[parameters.entries_of(name)] = vector[parameters.entries_of(name)]
            starts.append(values)
        return tuple(starts) if self.taken else (parameters.nominal(), *starts)


def aligned_start(problem: Problem, dataset: Dataset) -> Start:
    """The start that the records give: the configured one where nothing that may move is far off, or measured.

    Priors are kept: what has one is moved only within it, and is otherwise said to contradict the records.
    """
    nominal = problem.parameters.nominal()
    as_configured = Start(problem)
    try:
        # Of the measurement with most records; none where several arms share a frame.
        arms = {name for measurement in problem.blueprint.measurements.values() for name in measurement.arms}
        if len(arms) != 1 or not problem.increments:
            return as_configured
        seen = [sighting_of(problem, dataset, i, MOST_RECORDS) for i in range(len(problem.kernels))]
        sighting = max((s for s in seen if s is not None), key=lambda s: len(s.chosen), default=None)
        if sighting is None:
            return as_configured
        placing, held = placings(problem, sighting)
        tools = tools_of(problem.subset(sighting.chosen), nominal, sighting.kernel)
        if not held.stands_anywhere:
            return as_configured
        chosen = placing if placing.stands_anywhere else held
        ranked = alignments(tools, sighting.measured, chosen.basis, sighting.turned)
        return _chosen(problem, sighting, tools, chosen, ranked) if ranked else as_configured
    except NotConvergedError:
        return as_configured


def _chosen(problem: Problem, sighting: Sighting, tools: Tools, placing: Placing, ranked: Sequence[Alignment]) -> Start:
    """The best alignment that the free parameters reach, if it is much better than the configuration."""
    configured, some = sighting.off(tools), problem.subset(sighting.chosen)
    gauges = undetermined(tools, ranked[0], placing.basis)
    start = Start(problem, placing.names, (), ranked[0], configured, configured, False, gauges)
    if configured <= FAR * sighting.size:
        return start
    mounted = np.eye(3) if sighting.turned is None else hand_eye(tools.rotations, sighting.turned)[1]
    shown = [Tools(a.moved(tools), a.turn @ tools.rotations @ mounted) for a in ranked]
    reached = [placing.reached(problem, sighting, tools_shown) for tools_shown in shown]
    left = [sighting.off(tools_of(some, values, sighting.kernel)) for values in reached]
    order = np.argsort(left)
    best, start = reached[order[0]], replace(start, vectors=tuple(reached[i] for i in order))
    if min(left) * BETTER > configured:
        return start
    disagreement = _disagreement(problem, best, configured, min(left))
    if disagreement:
        return replace(start, vectors=(), warnings=(disagreement,))
    nominal, parameters = problem.parameters.nominal(), problem.parameters
    for name in (name for name in placing.names if parameters[name].prior_sd is None):
        nominal[parameters.entries_of(name)] = best[parameters.entries_of(name)]
    return replace(start, problem=problem.with_parameters(parameters.with_nominal(nominal)), left=min(left), taken=True)


def _disagreement(problem: Problem, values: Array, configured: float, left: float) -> str:
    """Which parameters are farther from their nominal values than their priors allow; empty if none is."""
    parameters = problem.parameters
    moved = parameters.coordinates(parameters.local(values))
    times = np.abs(moved) / np.array([block.prior_sd or np.inf for block in parameters.coordinate_blocks])
    beyond = [(parameters.coordinate_names[i], times[i]) for i in np.argsort(-times)[:3] if times[i] > BEYOND]
    named = ", ".join(f"{name} ({times:.0f} standard deviations)" for name, times in beyond)
    return named and (
        f"The records place the arm's base or the target elsewhere than the configuration does: {named} from its "
        f"prior. There the nominal arm would be typically {digits(left * _MM)} mm off, where the configuration has it "
        f"{digits(configured * _MM)} mm off. The fit starts from the configuration. Correct the values or the frame of "
        "the measurements, or leave the priors out: then base and target are found."
    )


def pose_words(alignment: Alignment) -> str:
    x, y, z = alignment.shift * _MM
    roll, pitch, yaw = Rotation.from_matrix(alignment.turn).as_euler("xyz", degrees=True)
    return f"({x:.1f}, {y:.1f}, {z:.1f}) mm, roll, pitch, yaw ({roll:.2f}, {pitch:.2f}, {yaw:.2f}) deg"


def with_proposals(start: Start, dataset: Dataset) -> Start:
    """The start with what measurements propose, where it is much nearer than the configuration.

    A parameter with a prior keeps its nominal value, and starts where it was proposed.
    """
    measurements = [start.problem.blueprint.measurements[kernel.factor.name] for kernel in start.problem.kernels]
    lenders_first = sorted(enumerate(measurements), key=lambda numbered: bool(borrowed_names(numbered[1])))
    for number, measurement in lenders_first:
        if not isinstance(measurement, Proposing):
            continue
        problem, name = start.problem, start.problem.kernels[number].factor.name
        parameters, nominal = problem.parameters, problem.parameters.nominal()
        before = start.vectors[0] if start.vectors else nominal
        own = _own(problem, name)
        proposal = measurement.propose(_reading(problem, nominal, before, dataset, number))
        if any(own[local].prior_sd is None for local in proposal.undetermined):
            hint = f"{proposal.close} Or give priors, or hold {', '.join(proposal.undetermined)}."
            raise ProblemError(f"{name}: {proposal.open}", where=dataset.where(), hint=hint)
        if not proposal.values:
            continue
        vector, moved = before.copy(), nominal.copy()
        for local, value in proposal.values.items():
            place = parameters.entries_of(own[local].name)
            vector[place] = value
            if own[local].prior_sd is None:
                moved[place] = value
        configured, left = (_typical(problem, values, number) for values in (nominal, vector))
        if left * BETTER <= configured:
            names = (*start.names, *(own[local].name for local in proposal.values))
            placed, vectors = problem.with_parameters(parameters.with_nominal(moved)), (vector, *start.vectors)
            elsewhere = replace(start, problem=placed, names=names, vectors=vectors)
            start = replace(elsewhere, configured=configured, left=left, taken=True)
    return start


def _own(problem: Problem, name: str) -> dict[str, ParameterBlock]:
    blocks = problem.parameters.blocks
    return {b.name.removeprefix(f"{name}."): b for b in blocks if b.name.startswith(f"{name}.")}


def _reading(problem: Problem, own_values: Array, values: Array, dataset: Dataset, number: int) -> Reading:
    """Arm and borrowed parameters are at ``values``, its own at ``own_values``."""
    name, parameters = problem.kernels[number].factor.name, problem.parameters
    own, lent = _own(problem, name), borrowed_names(problem.blueprint.measurements[name])
    borrowed = {local: values[parameters.entries_of(full)] for local, full in lent.items()}
    seen = np.flatnonzero(problem.records[number].measured)
    return Reading(
        carriers_of(problem.subset(seen), values, dataset.subset(seen), number),
        {c.removeprefix(f"{name}."): dataset.column(c)[seen] for c in problem.kernels[number].factor.output_channels},
        {**{local: own_values[parameters.entries_of(block.name)] for local, block in own.items()}, **borrowed},
        frozenset(local for local, block in own.items() if block.free),
        tuple(dataset.ids[i] for i in seen),
    )


def carriers_of(problem: Problem, values: Array, dataset: Dataset, number: int) -> dict[str, Array]:
    """What carries a measurement in each record (base_T_frame, N x 4 x 4, m): the tool, or frames of a still arm."""
    factor = problem.kernels[number].factor
    measurement, still = problem.blueprint.measurements[factor.name], np.tile(np.eye(4), (len(dataset), 1, 1))
    frames = {BASE_FRAME: still}
    for name in set(measurement.carriers.values()) if isinstance(measurement, Carried) else {TOOL_FRAME}:
        if name == TOOL_FRAME:
            columns = problem.grouped[number].predict(values, problem.records[number]).tools[0]
            frames[name] = np.concatenate([columns.transpose(2, 1, 0), still[:, 3:]], axis=1)
        else:
            frames[name] = _frame(problem, values, dataset, measurement.arms[0], name)
    return frames


def _frame(problem: Problem, values: Array, dataset: Dataset, of: str, name: str) -> Array:
    arm, parameters = problem.blueprint.arms[of], problem.parameters
    stated = {name: ca.SX(values[parameters.entries_of(name)]) for name in parameters.names}
    chain, symbols = arm.chain(stated), ca.SX.sym("commands", len(arm.commanded))
    joint_commands = [JointCommand(i, q, ca.SX(0)) for i, q in enumerate(arm.joint_commands(ca.vertsplit(symbols)))]
    moved = [joint.offset + arm.displacement(stated, q) for joint, q in zip(chain.joints, joint_commands, strict=True)]
    pose = ca.densify(forward(chain, moved, {}).named[name].matrix())
    commands = dataset.stacked([*arm.command_channels])
    shown = ca.Function("carrier", [symbols], [pose]).map(len(dataset))(commands).full()
    return np.asarray(shown.reshape(4, -1, 4).transpose(1, 0, 2))


def _typical(problem: Problem, values: Array, number: int) -> float:
    points = problem.records[number].points_of(problem.kernels[number].factor) * problem.records[number].measured
    squares = np.sum(problem.residuals(values)[number] ** 2, axis=0)[points > 0]
    errors = np.sqrt(squares / points[points > 0])
    return float(np.median(np.where(np.isfinite(errors), errors, np.inf))) if len(errors) else np.inf
