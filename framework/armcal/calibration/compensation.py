"""Compensation: what to command so that the real arm, with its springs, its play and its counts, arrives.

From targets to commands, for positions and poses, one by one or along a path; why a target is not reached; and what a
controller is sent that computes its own inverse kinematics, of the nominal arm.

Along a path an arm keeps to the posture of the target before as long as it can; where it cannot, it jumps to another.
Several postures are followed at once, and one with fewer and shorter jumps is the better one. The sides from which
joints come follow from how they move, and how they move may depend on these where there is backlash.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property, partial
from typing import Any, Self

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from armcal.arm.assembly import Arm, within_couplings
from armcal.arm.joints import joint_limits
from armcal.arm.servo import PulseClock, PulseTable
from armcal.arm.statics import LOAD_CHANNELS, Environment
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.parameters import Parameters
from armcal.base.se3 import Transform, evaluated, identity
from armcal.calibration.inverse import (
    FARTHEST_M,
    Aim,
    Allowed,
    Finder,
    Seeds,
    Solutions,
    Solver,
    chosen_of,
    slope_function,
)
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import (
    APPROACH,
    Equilibrium,
    Standing,
    ToolExpression,
    arm_expression,
    sample_inputs,
)
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice

_ORTHOGONAL = 1e-6


@dataclass(frozen=True)
class Targets:
    """Where the tool shall be; a ValueError for arrays of other shapes, or matrices that are no rotations."""

    positions: Array  # of the tool's origin in the base frame (N x 3; m)
    rotations: Array | None  # base_R_tool (N x 3 x 3); None where only positions count
    acting: Array  # what acts on the arm (LOAD_CHANNELS x N; SI, base frame)
    approach: Array  # from where each joint comes (n x N; -1, 0, 1; 0: not known)
    conditions: Mapping[str, Array] = field(default_factory=dict)  # of the surroundings, by name (N each)

    def __post_init__(self) -> None:
        count = len(self.positions)
        _check("positions", self.positions, (count, 3))
        if np.abs(self.positions).max(initial=0.0) > FARTHEST_M:
            raise ValueError(f"found positions beyond {FARTHEST_M:g} m")
        _check("approach", self.approach, (len(self.approach), count))
        _check("what acts on the arm", self.acting, (len(self.acting), count))
        if self.rotations is None:
            return
        _check("rotations", self.rotations, (count, 3, 3))
        square = self.rotations.transpose(0, 2, 1) @ self.rotations
        off = np.abs(square - np.eye(3)).max(axis=(1, 2)) > _ORTHOGONAL
        bad = np.flatnonzero(off | (np.linalg.det(self.rotations) < 0))
        if bad.size:
            raise ValueError(f"the matrix of target {bad[0] + 1} is no rotation")

    def __len__(self) -> int:
        return len(self.positions)

    @classmethod
    def joined(cls, parts: Sequence[Targets]) -> Targets:
        """Those of several parts, one after another."""
        first = parts[0]
        return cls(
            np.concatenate([part.positions for part in parts]),
            None if first.rotations is None else np.concatenate([part.rotations for part in parts]),
            np.concatenate([part.acting for part in parts], axis=1),
            np.concatenate([part.approach for part in parts], axis=1),
            {name: np.concatenate([part.conditions[name] for part in parts]) for name in first.conditions},
        )

    def subset(self, rows: Indices) -> Targets:
        """Some of them."""
        turned = None if self.rotations is None else self.rotations[rows]
        conditions = {name: values[rows] for name, values in self.conditions.items()}
        return Targets(self.positions[rows], turned, self.acting[:, rows], self.approach[:, rows], conditions)


@dataclass(frozen=True)
class Commands:
    """What to command, and where that leads."""

    joints: tuple[str, ...]  # the commanded joints (n)
    joint_angles: Array  # N x n (rad, or m on sliding joints); of a target that is not reached, the nearest found
    counts: NDArray[np.int64] | None  # of a servo board, to command (N x n; 0 of joints without a pulse table)
    base_T_tool: Array  # where the calibrated arm's tool then is (N x 4 x 4), quantisation and elasticity included
    base_T_point: Array  # and the point that is brought to targets: the tool itself, or the target that was measured
    distances: Array  # from that point to the target (N; m)
    turns: Array  # from its rotation to the target's (N; rad); zeros where only positions count
    reached: Mask  # whether the target is reached, up to what the counts leave (N)
    reasons: tuple[str, ...]  # why not; empty for those that are reached (N)
    bounds: Array  # no command brings the arm nearer than this (N; m); zero where nothing is known
    approach: Array  # from where each joint comes (N x n; -1, 0, 1), as far as that was stated or follows from the path
    moves: Array | None = None  # along a path, of each joint from the target before (N x n; rad or m)

    def __len__(self) -> int:
        return len(self.joint_angles)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Those of several parts of the targets, one after another."""
        columns = {own.name: [getattr(part, own.name) for part in parts] for own in fields(cls)}
        whole: dict[str, Any] = {n: None if own[0] is None else np.concatenate(own) for n, own in columns.items()}
        whole["joints"], whole["reasons"] = parts[0].joints, tuple(why for part in parts for why in part.reasons)
        return cls(**whole)


@dataclass(frozen=True)
class Options:
    """How commands are chosen."""

    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)  # by joint (rad or m), not the model's
    reach_m: float = 1e-9  # targets of this size count as had (m)
    reach_rad: float = 1e-8  # and of this size of turn (rad)
    seed: int = 0  # of the random starts
    allowed: Allowed | None = None  # from commands (n x N) to whether the arm may be there (N)


def _check(what: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"found {what} of the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"found {what} that are not finite numbers")


@dataclass(frozen=True)
class Reach:
    """The shell about a point that the tool cannot leave.

    A joint turns about its frame's origin, and so do its springs: the distance of two joints' origins next to each
    other never changes, whatever is commanded and whatever gives. A point beyond the sum of all of them, or nearer than
    the longest exceeds the others, is out of reach. Nothing is known of arms whose joints turn about axes beside their
    frames, or whose lengths change with the surroundings.
    """

    centre: Array  # the mount's origin (m; base frame)
    farthest: float  # m; infinite where nothing is known
    nearest: float  # m

    def bounds(self, positions: Array) -> Array:
        """No command brings the tool nearer to positions (N x 3; m) than this (N; m)."""
        away = np.linalg.norm(positions - self.centre, axis=1)
        return np.asarray(np.maximum(np.maximum(away - self.farthest, self.nearest - away), 0.0))


def reach_of(arm: Arm, parameters: Parameters, limits: Array, tool_T_point: Transform | None = None) -> Reach:
    """What an arm reaches at most with the tool's origin or another point of it; ``limits`` of commands (n x 2)."""
    values = {block.name: ca.SX(list(block.nominal)) for block in parameters.blocks if not block.nuisance}
    chain = arm.chain(values)
    centre = evaluated(chain.base_T_mount.translation).ravel()
    slides = any(not joint.is_revolute for joint in chain.joints)
    if any(joint.twist is not None for joint in chain.joints) or arm.conditions or (slides and arm.effects):
        return Reach(centre, np.inf, 0.0)
    links = [float(np.linalg.norm(evaluated(joint.parent_T_joint.translation))) for joint in chain.joints]
    end = chain.tool.joint_T_frame @ (tool_T_point or identity())
    links.append(float(np.linalg.norm(evaluated(end.translation))))
    # how far sliding joints move at most (m)
    travel = 0.0
    places = {joint: i for i, joint in enumerate(arm.commanded)}
    for joint in chain.joints:
        if not joint.is_revolute:
            own = limits[places[joint.name]] if joint.name in places else np.array([-np.inf, np.inf])
            travel += float(np.abs(own + evaluated(joint.offset).item()).max())
    total = sum(links) + travel
    nearest = 0.0 if travel else max(0.0, 2 * max(links) - total)
    return Reach(centre, total, nearest)


_POSTURES, _STARTS = 12, 48  # Followed at once along a path; and the starts from which they are looked for
_JUMP = 0.5  # A longer move (rad or m) between neighbouring targets is a jump
_ROUNDS = 3
_STILL = 1e-9  # A joint that moves by less (rad or m) keeps its side


def sides_of(moved: Array, before: Array) -> Array:
    """The side (-1, 0, 1) from which joints come that moved so far, and came from a side before (n x N each)."""
    return np.where(np.abs(moved) > _STILL, np.sign(moved), before)


def with_sides(record: Array, at: Array, before: Array, search: Callable[[Array], Solutions]) -> Solutions:
    """Commands found under the sides from which they make the joints come; these are left in the record.

    ``at`` are the commands from which the joints come, ``before`` the sides from which they came there (n x N each). A
    joint that comes from the one side only if commanded from the other has no side: it gets 0, and its play counts as
    uncertainty.
    """
    place = slice(len(at), 2 * len(at))
    record[place] = before
    for _ in range(_ROUNDS):
        solutions = search(record)
        sides = sides_of(solutions.commands - at, before)
        side_record = record[place].copy()
        if (sides == side_record).all():
            return solutions
        record[place] = sides
    record[place] = np.where(sides == side_record, side_record, 0.0)
    return search(record)


Counts = NDArray[np.int64]
_MOST_PAIRS = 20_000
_WIDEST = 2  # Counts to either side of the exact one
_ROUNDED_AT_ONCE = 64
TRIED = 4  # Combinations that are tried on the arm


class ServoCounts:
    """From commands to counts and back, for joints of which some have a servo."""

    def __init__(self, joints: Sequence[str], servos: Mapping[str, tuple[PulseTable, PulseClock]]) -> None:
        self._servos = [servos.get(joint) for joint in joints]
        self._stepped = [i for i, servo in enumerate(self._servos) if servo is not None]
        wide = _WIDEST
        while wide > 1 and (2 * wide + 1) ** len(self._stepped) > _MOST_PAIRS:
            wide -= 1
        self._offsets = np.arange(-wide, wide + 1)

    def counts(self, commands: Array) -> Counts:
        whole = np.zeros(commands.shape, dtype=np.int64)
        for i, servo in enumerate(self._servos):
            if servo is not None:
                table, clock = servo
                whole[i] = np.floor(_piecewise(commands[i], table.angles, table.pulses) / clock.tick + 0.5)
        return whole

    def angles(self, counts: Counts, commands: Array) -> Array:
        """What counts make (n x N; rad); joints without a pulse table stand at their commands."""
        made = commands.copy()
        for i, servo in enumerate(self._servos):
            if servo is not None:
                table, clock = servo
                order = slice(None) if table.pulses[0] < table.pulses[-1] else slice(None, None, -1)
                made[i] = _piecewise(counts[i] * clock.tick, table.pulses[order], table.angles[order])
        return made

    def near(self, commands: Array, limits: Array) -> tuple[Counts, Array]:
        """Counts to either side of commands (n x N), and what they make (n x o x N each; rad).

        None beyond the limits (n x 2), where the nearest stands in.
        """
        middle = self.counts(commands)
        moved = np.where(middle[:, None, :] == 0, 0, self._offsets[None, :, None])
        counts = middle[:, None, :] + moved
        exact = np.repeat(commands[:, None, :], len(self._offsets), axis=1)
        shape = (len(commands), -1)
        angles = self.angles(counts.reshape(shape), exact.reshape(shape)).reshape(counts.shape)
        slack = 1e-9
        beyond = (angles < limits[:, :1, None] - slack) | (angles > limits[:, 1:, None] + slack)
        inside = np.where(beyond, np.inf, np.abs(angles - exact)).argmin(axis=1, keepdims=True)
        counts = np.where(beyond, np.take_along_axis(counts, inside, axis=1), counts)
        angles = np.where(beyond, np.take_along_axis(angles, inside, axis=1), angles)
        return counts, angles

    def best(self, near: tuple[Counts, Array], commands: Array, slopes: Array, left: Array) -> tuple[Counts, Array]:
        """The combinations with the least error to first order: counts and angles (n x N x TRIED), the best first.

        ``near`` is what can be set about the exact ``commands`` (n x N), ``slopes`` are the weighted rows of the tool
        (N x m x n), and ``left`` is what the exact commands leave (m x N).
        """
        counts, angles = near
        moved = (angles - commands[:, None, :]).transpose(2, 0, 1)
        half = (len(self._stepped) + 1) // 2
        parts = self._stepped[:half], self._stepped[half:]
        first, second = (_sums(slopes, moved, part) for part in parts)
        aim = left.T[:, None, :] - first[0]
        cost = np.einsum("nai,nai->na", aim, aim)[:, :, None] - 2 * aim @ second[0].transpose(0, 2, 1)
        cost += np.einsum("nbi,nbi->nb", second[0], second[0])[:, None, :]
        flat = cost.reshape(len(cost), -1)
        few = np.argpartition(flat, min(TRIED, flat.shape[1] - 1), axis=1)[:, :TRIED]
        chosen = np.concatenate([first[1][few // cost.shape[2]], second[1][few % cost.shape[2]]], axis=2)
        place = np.full((len(commands), *few.shape), len(self._offsets) // 2)
        place[self._stepped] = chosen.transpose(2, 0, 1)
        joint, target = np.arange(len(commands))[:, None, None], np.arange(len(cost))[None, :, None]
        return counts[joint, place, target], angles[joint, place, target]


def _sums(slopes: Array, moved: Array, joints: Sequence[int]) -> tuple[Array, Indices]:
    """What all combinations of some joints' offsets do (N x combinations x m), and the combinations."""
    wide = moved.shape[2]
    places = np.indices((wide,) * len(joints)).reshape(len(joints), wide ** len(joints)).T
    total = np.zeros((len(moved), len(places), slopes.shape[1]))
    for column, joint in enumerate(joints):
        effect = moved[:, joint, :, None] * slopes[:, None, :, joint]
        total += effect[:, places[:, column]]
    return total, places


def _piecewise(x: Array, at: Sequence[float], values: Sequence[float]) -> Array:
    knots, known = np.asarray(at), np.asarray(values)
    cell = np.clip(np.searchsorted(knots, x) - 1, 0, len(knots) - 2)
    slope = (known[cell + 1] - known[cell]) / (knots[cell + 1] - knots[cell])
    return np.asarray(known[cell] + slope * (x - knots[cell]))


@dataclass(frozen=True)
class Rounding:
    """The best counts, for the targets of a solver.

    The tool's error is nearly linear over a few counts, so the joints are split in two halves, all combinations of
    each half are laid out, and the pairs of them that cancel best are tried on the arm itself.
    """

    slope: BatchFunction  # see ``slope_function``
    counts: ServoCounts
    equilibrium: Equilibrium
    solver: Solver

    def __call__(
        self, record: Array, exact: Array, states: Array, target: Array, allowed: Allowed | None
    ) -> tuple[Counts, Array]:
        """Counts and what they make (n x N each) for records with the exact commands, and targets (3 or 12 x N)."""
        if record.shape[1] > _ROUNDED_AT_ONCE:
            starts = range(0, record.shape[1], _ROUNDED_AT_ONCE)
            columns = [slice(start, start + _ROUNDED_AT_ONCE) for start in starts]
            parts = [self(record[:, s], exact[:, s], states[:, s], target[:, s], allowed) for s in columns]
            return np.hstack([counts for counts, _ in parts]), np.hstack([commands for _, commands in parts])
        joints, count = exact.shape
        left = _left(self.equilibrium(record, states).base_T_tool, target)
        weights = np.array([1.0] * 3 + [self.solver.length] * (len(left) - 3))[:, None]
        weighted = self.slope(record, states)[0].reshape(joints, len(left), count).transpose(2, 1, 0) * weights
        near = self.counts.near(exact, self.solver.limits)
        counts, commands = self.counts.best(near, exact, weighted, left * weights)
        tried = np.repeat(record, TRIED, axis=1)
        tried[:joints] = commands.reshape(joints, -1)
        standing = self.equilibrium(tried, np.repeat(states, TRIED, axis=1))
        away = _left(standing.base_T_tool, np.repeat(target, TRIED, axis=1))
        cost = ((away * weights) ** 2).sum(axis=0)
        barred = ~standing.settled if allowed is None else ~(standing.settled & allowed(tried[:joints]))
        best = np.where(barred, np.inf, cost).reshape(count, TRIED).argmin(axis=1)
        rows = np.arange(count)
        return counts[:, rows, best], commands[:, rows, best]


def _left(tools: Array, target: Array) -> Array:
    """From tools (N x 4 x 4) to targets (3 or 12 x N): m, and rad in the base frame (3 or 6 x N)."""
    away = target[:3] - tools[:, :3, 3].T
    if len(target) == len(away):
        return np.asarray(away)
    rotations = target[3:].T.reshape(-1, 3, 3).transpose(0, 2, 1)
    return np.concatenate([away, turn_between(tools[:, :3, :3], rotations).T])


SEEDS = 512
PART = 8  # Targets that a request of many is answered by at a time


class Compensator:
    """From targets to commands for one calibrated arm; built once, asked often.

    ``limits`` are the lowest and highest command by joint (n x 2; rad or m), ``reach`` how far it reaches at all.
    """

    def __init__(
        self,
        expression: ToolExpression,
        parameters: Parameters,
        options: Options | None = None,
        choice: EvaluatorChoice = "auto",
    ) -> None:
        """Of a calibrated arm and its values, by compiled C or CasADi's interpreter.

        Raises:
            ValueError: limits of a joint that is not there, or in falling order.
        """
        self.expression, self.options = expression, options or Options()
        coupled = partial(within_couplings, [expression.arm]) if expression.arm.couplings else None
        allowed = self.options.allowed
        self._allowed = (lambda q: allowed(q) & coupled(q)) if allowed and coupled else allowed or coupled
        known = joint_limits(expression.arm.nominal_chain, self.options.limits)
        self.limits = np.array([known[joint] or (-np.inf, np.inf) for joint in expression.joints])
        for i, joint in enumerate(expression.joints):
            if joint in expression.servos:  # its pulse table is known between its ends only
                angles = expression.servos[joint][0].angles
                self.limits[i] = max(self.limits[i, 0], angles[0]), min(self.limits[i, 1], angles[-1])
            if not self.limits[i, 0] < self.limits[i, 1]:
                low, high = self.limits[i]
                raise ValueError(f"the limits of {joint}, {low:g} to {high:g}, leave it no room")
        self.reach: Reach = reach_of(expression.arm, parameters, self.limits, expression.tool_T_point)
        self._point_T_tool = np.linalg.inv(evaluated(expression.tool_T_point.matrix()))
        self._equilibrium = Equilibrium(expression, choice)
        self._counts = ServoCounts(expression.joints, expression.servos) if expression.servos else None
        self._seeds = Seeds(expression, self._equilibrium, self.limits, SEEDS, self.options.seed)
        self._choice: EvaluatorChoice = choice
        self._kinds: dict[Aim, tuple[Finder, Rounding | None]] = {}

    @property
    def joints(self) -> tuple[str, ...]:
        """The commanded ones."""
        return self.expression.joints

    def targets(
        self,
        positions: Array,
        rotations: Array | None = None,
        payload: Array | float | None = None,
        gravity: Array | None = None,
        approach: Array | None = None,
        conditions: Mapping[str, Array | float] | None = None,
    ) -> Targets:
        """Targets from arrays.

        Args:
            positions: N x 3 (m; base frame).
            rotations: base_R_tool (N x 3 x 3); None where only positions count.
            payload: kg (one number or N); the calibration's where it is None.
            gravity: m/s^2 (3 or N x 3; base frame).
            approach: from where each joint comes (N x n; -1, 0, 1).
            conditions: of the surroundings, by name (one number or N; SI, temperatures in degrees Celsius): all that
                the compensator was built for.

        Raises:
            ValueError: arrays of other shapes, numbers that are none, or matrices that are no rotations.
        """
        positions = np.atleast_2d(np.asarray(positions, dtype=float))
        count, joints = len(positions), len(self.joints)
        acting = np.repeat(self.expression.defaults[2 * joints : 2 * joints + len(LOAD_CHANNELS), None], count, axis=1)
        if payload is not None:
            acting[LOAD_CHANNELS.index("payload")] = payload
        if gravity is not None:
            acting[:3] = np.broadcast_to(np.asarray(gravity, dtype=float), (count, 3)).T
        sides = np.zeros((joints, count)) if approach is None else self._commanded(approach, count)
        turned = None if rotations is None else np.asarray(rotations, dtype=float).reshape(-1, 3, 3)
        columns = {name: np.broadcast_to(value, count) for name, value in (conditions or {}).items()}
        return Targets(positions, turned, acting, sides, columns)

    def solve(self, targets: Targets, start: Array | None = None) -> Commands:
        """Commands for each target by itself: those nearest to ``start``, else the first that are found.

        ``start`` are commands from which the arm comes (n or N x n); a ValueError for another number of them.
        """
        record = self._record(targets)
        towards = None if start is None else self._commanded(start, len(targets))
        if towards is None or not self._tells_approach or targets.approach.any():
            solutions = self._found(record, targets, towards)
        else:
            search = partial(self._found, targets=targets, start=towards)
            solutions = with_sides(record, towards, targets.approach, search)
        return self._commands(record, targets, solutions)

    def postures(self, targets: Targets, starts: int = _STARTS) -> list[Array]:
        """The commands of all postures that are found of each target from so many starts (n x k each)."""
        return self._finder(targets).postures(self._record(targets), _goal(targets), starts)

    def follow(self, targets: Targets, start: Array | None = None) -> Commands:
        """Commands along a path: one target after another, without jumps where that can be.

        ``start`` (n) is where the arm stands; without it the best of several postures for the first target. The sides
        from which joints come follow from the path.
        """
        if not len(targets):
            return replace(self.solve(targets, start), moves=np.zeros((0, len(self.joints))))
        return Commands.joined([part for part in self.following(targets, start) if part is not None])

    def following(self, targets: Targets, start: Array | None = None) -> Iterator[Commands | None]:
        """The same a little at a time, for a server with other clients: None while it searches, then part by part."""
        record, goal, finder = self._record(targets), _goal(targets), self._finder(targets)
        if start is None:
            at = finder.postures(record[:, :1], goal[:, :1], _STARTS)[0]
            at = at[:, :_POSTURES] if at.size else finder.first(record[:, :1], goal[:, :1]).commands
        else:
            at = self._commanded(start, 1)
        count, wide, steps = len(targets), at.shape[1], list[Solutions]()
        moves, sides = np.zeros((count, *at.shape)), np.zeros((count, *at.shape))
        side, spoilt = np.zeros_like(at), np.zeros(wide, dtype=int)
        for i in range(count):
            rows = np.full(wide, i)
            here, target = record[:, rows], goal[:, rows]
            if (i == 0 and start is None) or not self._tells_approach:
                steps.append(finder.onward(here, target, at))
            else:
                steps.append(with_sides(here, at, side, partial(finder.onward, target=target, at=at)))
            if i or start is not None:
                moves[i] = steps[-1].commands - at
                side = here[len(at) : 2 * len(at)] if self._tells_approach else sides_of(moves[i], side)
                sides[i] = side
            at = steps[-1].commands
            spoilt += (np.abs(moves[i]).max(axis=0) > _JUMP).astype(int) + ~steps[-1].there
            kept = np.asarray(spoilt == spoilt.min())
            if not kept.all():
                steps = [candidates.subset(kept) for candidates in steps]
                sides, moves, at, side = sides[:, :, kept], moves[:, :, kept], at[:, kept], side[:, kept]
                wide, spoilt = int(kept.sum()), spoilt[kept]
            yield None
        longest = np.abs(moves).max(axis=1)
        best = int((longest.max(axis=0) + longest.mean(axis=0)).argmin())
        record[len(self.joints) : 2 * len(self.joints)] = sides[:, :, best].T
        for first in range(0, count, PART):
            rows = np.arange(first, min(first + PART, count))
            along = Solutions.joined([steps[row].subset(slice(best, best + 1)) for row in rows])
            part = self._commands(chosen_of(record, rows), targets.subset(rows), along)
            yield replace(part, moves=moves[rows, :, best])

    def onward(self, targets: Targets, at: Array) -> Commands:
        """Commands for targets straight on from others (N x n): no other posture is looked for."""
        record = self._record(targets)
        solutions = self._finder(targets).straight(record, _goal(targets), self._commanded(at, len(targets)))
        return self._commands(record, targets, solutions)

    def forward(
        self,
        joint_angles: Array,
        acting: Array | None = None,
        approach: Array | None = None,
        conditions: Mapping[str, Array | float] | None = None,
    ) -> Array:
        """Where the point that is brought to targets is (N x 4 x 4) at commands (N x n) as they are, in equilibrium.

        ``acting`` is LOAD_CHANNELS x N, the calibration's without it; ``approach`` N x n; ``conditions`` as of targets.
        A NotConvergedError if one has no equilibrium.
        """
        count = len(np.atleast_2d(joint_angles))
        commands = self._commanded(joint_angles, count)
        record = self._record(self.targets(np.zeros((count, 3)), conditions=conditions))
        record[: len(commands)] = self._set(commands)
        if approach is not None:
            record[len(commands) : 2 * len(commands)] = np.asarray(approach, dtype=float).T
        if acting is not None:
            record[2 * len(commands) : 2 * len(commands) + len(LOAD_CHANNELS)] = acting
        return self._equilibrium.required(record)

    def stand(self, joint_angles: Array, targets: Targets, approach: Array) -> Standing:
        """Where the arm stands at commands (N x n), rounded to counts, under what acts on it at targets."""
        record = self._record(replace(targets, approach=approach.T))
        record[: len(self.joints)] = self._set(joint_angles.T)
        return self._equilibrium(record)

    def _commanded(self, given: Array, count: int) -> Array:
        """One row for all, or a row for each, as the searches take it (n x N)."""
        numbers = np.asarray(given, dtype=float)
        if numbers.shape not in {(len(self.joints),), (1, len(self.joints)), (count, len(self.joints))}:
            raise ValueError(f"found numbers of the shape {numbers.shape}, expected {count} x {len(self.joints)}")
        if not np.isfinite(numbers).all():
            raise ValueError("found commands that are not finite numbers")
        return np.broadcast_to(numbers, (count, len(self.joints))).T.copy()

    def _set(self, commands: Array) -> Array:
        if self._counts is None:
            return commands
        return self._counts.angles(self._counts.counts(commands), commands)

    def _found(self, record: Array, targets: Targets, start: Array | None) -> Solutions:
        finder = self._finder(targets)
        return finder.first(record, _goal(targets)) if start is None else finder.onward(record, _goal(targets), start)

    def _commands(self, record: Array, targets: Targets, solutions: Solutions) -> Commands:
        joints, counts = len(self.joints), None
        record[:joints] = solutions.commands
        rounding = self._kind("position" if targets.rotations is None else "pose")[1]
        if rounding is not None:
            exact = solutions.commands, solutions.states
            counts, record[:joints] = rounding(record, *exact, _goal(targets), self._allowed)
            if self._allowed is not None:
                barred = solutions.there & ~self._allowed(record[:joints])
                solutions.there[barred], solutions.forbidden[barred] = False, True
        standing = self._equilibrium(record, None if counts is not None else solutions.states)
        poses, had = standing.base_T_tool, solutions.there & standing.settled
        bounds = self.reach.bounds(targets.positions)
        turns = np.zeros(len(poses))
        if targets.rotations is not None:
            turns = np.linalg.norm(turn_between(poses[:, :3, :3], targets.rotations), axis=1)
        commands = record[:joints]

        return Commands(
            joints=self.joints,
            joint_angles=commands.T.copy(),
            counts=None if counts is None else counts.T.copy(),
            base_T_tool=poses @ self._point_T_tool,
            base_T_point=poses,
            distances=np.linalg.norm(poses[:, :3, 3] - targets.positions, axis=1),
            turns=turns,
            reached=had,
            reasons=self._reasons(record, targets, solutions, had, bounds),
            bounds=np.where(had, 0.0, bounds),
            approach=record[joints : 2 * joints].T.copy(),
        )

    def _reasons(
        self, record: Array, targets: Targets, solutions: Solutions, had: Mask, bounds: Array
    ) -> tuple[str, ...]:
        barred = "are too near to something" + ", or turn a coupled joint too far" * bool(self.expression.arm.couplings)
        lost, turned = np.flatnonzero(~had), np.zeros(len(had), dtype=bool)
        near = lost[(bounds[lost] == 0) & ~solutions.forbidden[lost]]
        if targets.rotations is not None and near.size:
            turned[near] = self._kind("position")[0].first(record[:, near], targets.positions[near].T).there
        reasons = [""] * len(had)
        for row in lost.tolist():
            if solutions.there[row]:
                reasons[row] = "the load is more than the springs hold there"
            elif bounds[row] > 0:
                reasons[row] = f"out of reach: no command comes nearer than {1000 * bounds[row]:.1f} mm"
            elif solutions.forbidden[row]:
                reasons[row] = f"all commands found that reach it {barred}"
            else:
                q, (low, high) = record[: len(self.joints), row], self.limits.T
                ends = [self.joints[i] for i in np.flatnonzero((q <= low + 1e-6) | (q >= high - 1e-6))]
                text = "the position can be reached, but not with this rotation"
                reasons[row] = text if turned[row] else "no command was found that reaches it"
                reasons[row] += f"; the nearest has {', '.join(ends)} at the limit" * bool(ends)
        return tuple(reasons)

    def _record(self, targets: Targets) -> Array:
        joints, count = len(self.joints), len(targets)
        record = self.expression.records(np.zeros((joints, count)))
        record[joints : 2 * joints] = targets.approach
        record[2 * joints : 2 * joints + len(LOAD_CHANNELS)] = targets.acting
        conditions = self.expression.conditions
        if set(targets.conditions) != set(conditions):
            text, expected = (", ".join(names) or "nothing" for names in (targets.conditions, conditions))
            raise ValueError(f"found targets that tell {text} of the surroundings, expected {expected}")
        for name, values in targets.conditions.items():
            record[self.expression.channels.index(name)] = values
        return record

    def _finder(self, targets: Targets) -> Finder:
        return self._kind("position" if targets.rotations is None else "pose")[0]

    def _kind(self, aim: Aim) -> tuple[Finder, Rounding | None]:
        """What finds commands for one kind of target, and rounds them to counts of servos; made when first used."""
        if aim not in self._kinds:
            tolerance = (self.options.reach_m, self.options.reach_rad)
            parts = (self.limits, aim, self._seeds.spread / 2, tolerance, self._choice)
            finder = Finder(Solver(self.expression, *parts), self._seeds, self._allowed)
            rounding, turns = None, aim == "pose"
            if self._counts is not None:
                sample, choice = sample_inputs(self.expression), self._choice
                make = partial(BatchFunction, slope_function(self.expression, turns), sample, choice)
                slope = self.expression.made(("slope", turns, choice), make)
                rounding = Rounding(slope, self._counts, self._equilibrium, finder.solver)
            self._kinds[aim] = finder, rounding
        return self._kinds[aim]

    @cached_property
    def _tells_approach(self) -> bool:
        names = [f"{APPROACH}{joint}" for joint in self.joints]
        return self.expression.uses(names)


def _goal(targets: Targets) -> Array:
    """As the solver takes it (3 or 12 x N)."""
    if targets.rotations is None:
        return targets.positions.T
    return np.concatenate([targets.positions.T, targets.rotations.transpose(0, 2, 1).reshape(-1, 9).T])


def nominal_arm(
    arm: Arm, parameters: Parameters, environment: Environment, options: Options, tool_T_point: Transform | None = None
) -> Compensator:
    """The arm as its controller has it: rigid, without effects, at the nominal values of ``parameters``."""
    expression = arm_expression(replace(arm, effects={}, masses=()), parameters, environment)
    return Compensator(expression if tool_T_point is None else expression.at(tool_T_point), parameters, options)


def sent(nominal: Compensator, commands: Commands) -> Array:
    """Poses of the point that arrives (N x 4 x 4; base frame) that make the nominal arm's inverse kinematics give the
    commands of the real arm; nan of targets that are not reached.
    """
    return np.where(commands.reached[:, None, None], nominal.forward(commands.joint_angles), np.nan)
