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
from armcal.arm.joints import Limits, joint_limits
from armcal.arm.statics import LOAD_CHANNELS, Environment
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.parameters import Parameters
from armcal.base.se3 import Transform, evaluated, identity
from armcal.calibration.counts import Rounding, ServoCounts
from armcal.calibration.inverse import FARTHEST_M, Aim, Allowed, Finder, Seeds, Solutions, Solver, chosen_of
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import APPROACH, Equilibrium, Standing, ToolExpression, arm_expression
from armcal.functions.batch_function import EvaluatorChoice

_ORTHOGONAL = 1e-6


@dataclass(frozen=True)
class Targets:
    """Where the tool shall be.

    Attributes:
        positions: of the tool's origin in the base frame (N x 3; m).
        rotations: base_R_tool (N x 3 x 3); None where only positions count.
        acting: what acts on the arm (LOAD_CHANNELS x N; SI, base frame).
        approach: from where each joint comes (n x N; -1, 0, 1; 0: not known).
        conditions: of the surroundings, by name (N each).

    Raises:
        ValueError: arrays of other shapes, numbers that are none, or matrices that are no rotations.
    """

    positions: Array
    rotations: Array | None
    acting: Array
    approach: Array
    conditions: Mapping[str, Array] = field(default_factory=dict)

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
    """What to command, and where that leads.

    Attributes:
        joints: the commanded joints (n).
        joint_angles: what to command (N x n; rad, or m on sliding joints); of a target that cannot be reached, the
            nearest that was found.
        counts: of a servo board, to command (N x n; 0 of joints without a pulse table); None for an arm without one.
        base_T_tool: where the calibrated arm's tool then is (N x 4 x 4), quantisation and elasticity included.
        base_T_point: and the point that is brought to targets: the tool itself, or the target that was measured.
        distances: from that point to the target (N; m).
        turns: from its rotation to the target's (N; rad); zeros where only positions count.
        reached: whether the target is reached, up to what the counts leave (N).
        reasons: why not; empty for those that are reached (N).
        bounds: no command brings the arm nearer than this (N; m); zero where nothing is known.
        moves: along a path, of each joint from the target before (N x n; rad or m); None for single targets.
        approach: from where each joint comes (N x n; -1, 0, 1), as far as that was stated or follows from the path.
    """

    joints: tuple[str, ...]
    joint_angles: Array
    counts: NDArray[np.int64] | None
    base_T_tool: Array
    base_T_point: Array
    distances: Array
    turns: Array
    reached: Mask
    reasons: tuple[str, ...]
    bounds: Array
    approach: Array
    moves: Array | None = None

    def __len__(self) -> int:
        return len(self.joint_angles)

    @classmethod
    def joined(cls, parts: Sequence[Self]) -> Self:
        """Those of several parts of the targets, one after another."""
        columns: dict[str, Any] = {
            part.name: [getattr(commands, part.name) for commands in parts] for part in fields(cls)
        }
        whole: dict[str, Any] = {
            name: None if column[0] is None else np.concatenate(column) for name, column in columns.items()
        }
        whole["joints"], whole["reasons"] = parts[0].joints, tuple(why for part in parts for why in part.reasons)
        return cls(**whole)


@dataclass(frozen=True)
class Options:
    """How commands are chosen.

    Attributes:
        limits: lowest and highest command by joint (rad or m), instead of the model's.
        reach_m: targets of this size count as had (m).
        reach_rad: and of this size of turn (rad).
        seed: of the random starts.
    """

    limits: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    reach_m: float = 1e-9
    reach_rad: float = 1e-8
    seed: int = 0


def _check(what: str, array: Array, shape: tuple[int, ...]) -> None:
    if array.shape != shape:
        raise ValueError(f"found {what} of the shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise ValueError(f"found {what} that are not finite numbers")


def command_limits(expression: ToolExpression, stated: Mapping[str, Limits]) -> Array:
    """Lowest and highest command of each joint (n x 2; rad or m), infinite where nothing limits it.

    ``stated`` take the place of the model's. A servo's pulse table is known between its ends only, so a joint with one
    stays between them too.

    Raises:
        ValueError: limits of a joint that is not there, or in falling order.
    """
    known = joint_limits(expression.arm.nominal_chain, stated)
    limits = np.array([known[joint] or (-np.inf, np.inf) for joint in expression.joints])
    for i, joint in enumerate(expression.joints):
        if joint in expression.servos:
            angles = expression.servos[joint][0].angles
            limits[i] = max(limits[i, 0], angles[0]), min(limits[i, 1], angles[-1])
        if not limits[i, 0] < limits[i, 1]:
            raise ValueError(f"the limits of {joint}, {limits[i, 0]:g} to {limits[i, 1]:g}, leave it no room")
    return limits


@dataclass(frozen=True)
class Reach:
    """The shell about a point that the tool cannot leave.

    A joint turns about its frame's origin, and so do its springs: the distance of two joints' origins next to each
    other never changes, whatever is commanded and whatever gives. A point beyond the sum of all of them, or nearer than
    the longest exceeds the others, is out of reach.

    Attributes:
        farthest: m; infinite where nothing is known, as of arms whose joints turn about axes beside their frames, or
            whose lengths change with the surroundings.
    """

    centre: Array  # the mount's origin (m; base frame)
    farthest: float
    nearest: float  # m

    def bounds(self, positions: Array) -> Array:
        """No command brings the tool nearer to positions (N x 3; m) than this (N; m)."""
        away = np.linalg.norm(positions - self.centre, axis=1)
        return np.asarray(np.maximum(np.maximum(away - self.farthest, self.nearest - away), 0.0))


def reach_of(arm: Arm, parameters: Parameters, limits: Array, tool_T_point: Transform | None = None) -> Reach:
    """What an arm reaches at most, with the values of ``parameters``; limits (n x 2) of the commanded joints.

    It is reached with the tool's origin, or with another point of the tool.
    """
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


@dataclass(frozen=True)
class Path:
    """Commands along a path.

    Attributes:
        moves: of each joint to each target from the one before it (n x N; rad or m; 0 for the first without a start).
    """

    solutions: Solutions  # the commands for each target
    approach: Array  # from where each joint came (n x N)
    moves: Array


class PathFinder:
    """Follows targets, one after another."""

    def __init__(self, finder: Finder, joints: int, tells_approach: bool) -> None:
        """``tells_approach``: whether it matters from where a joint comes."""
        self._finder, self._joints, self._tells_approach = finder, joints, tells_approach

    def __call__(self, record: Array, target: Array, start: Array | None) -> Iterator[Path | None]:
        """Follow targets (3 or 12 x N) under records (channels x N) from commands (n), or from wherever is best.

        None after each target, for a server with other clients; the path at last.
        """
        at = start[:, None] if start is not None else self._finder.postures(record[:, :1], target[:, :1], _STARTS)[0]
        at = at[:, :_POSTURES] if at.size else self._finder.first(record[:, :1], target[:, :1]).commands
        count, wide = target.shape[1], at.shape[1]
        solutions: list[Solutions] = []
        sides = np.zeros((count, self._joints, wide))
        moves = np.zeros((count, self._joints, wide))
        side, spoilt = np.zeros_like(at), np.zeros(wide, dtype=int)
        for i in range(count):
            rows = np.full(wide, i)
            if i == 0 and start is None:
                following = self._finder.onward(record[:, rows], target[:, rows], at)
            else:
                following, side = self._next(record[:, rows], target[:, rows], at, side)
                moves[i], sides[i] = following.commands - at, side
            solutions.append(following)
            at = following.commands
            spoilt += (np.abs(moves[i]).max(axis=0) > _JUMP).astype(int) + ~following.there
            kept = np.asarray(spoilt == spoilt.min())
            if not kept.all():
                solutions = [candidates.subset(kept) for candidates in solutions]
                sides, moves, at, side = sides[:, :, kept], moves[:, :, kept], at[:, kept], side[:, kept]
                wide, spoilt = int(kept.sum()), spoilt[kept]
            yield None
        longest = np.abs(moves).max(axis=1)
        best = int((longest.max(axis=0) + longest.mean(axis=0)).argmin())
        columns = zip(*(vars(candidates).values() for candidates in solutions), strict=True)
        along = Solutions(*(np.stack([column[..., best] for column in part], axis=-1) for part in columns))
        yield Path(along, sides[:, :, best].T, moves[:, :, best].T)

    def _next(self, record: Array, target: Array, at: Array, side: Array) -> tuple[Solutions, Array]:
        if not self._tells_approach:
            solutions = self._finder.onward(record, target, at)
            return solutions, sides_of(solutions.commands - at, side)
        record = record.copy()
        solutions = with_sides(record, at, side, lambda sided: self._finder.onward(sided, target, at))
        return solutions, record[self._joints : 2 * self._joints]


def sides_of(moved: Array, before: Array) -> Array:
    """The side (-1, 0, 1) from which joints come that moved so far, and came from a side before (n x N each)."""
    return np.where(np.abs(moved) > _STILL, np.sign(moved), before)


def with_sides(record: Array, at: Array, before: Array, search: Callable[[Array], Solutions]) -> Solutions:
    """Commands found under the sides from which they make the joints come; these are left in the record.

    A joint that comes from the one side only if commanded from the other has no side: it gets 0, and its play
    counts as uncertainty.

    Args:
        record: channels x N; the joints' commands and then their sides stand first.
        at: commands from which the joints come (n x N).
        before: the sides from which they came there (n x N).
        search: from a record to commands.
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


SEEDS = 512
PART = 8  # Targets that a request of many is answered by at a time


class Compensator:
    """From targets to commands for one calibrated arm; built once, asked often.

    Attributes:
        expression: the arm's.
        options: how commands are chosen.
        limits: lowest and highest command by joint (n x 2; rad or m).
        reach: how far it reaches at all.
    """

    def __init__(
        self,
        expression: ToolExpression,
        parameters: Parameters,
        options: Options | None = None,
        allowed: Allowed | None = None,
        choice: EvaluatorChoice = "auto",
    ) -> None:
        """Build it.

        Args:
            expression: the calibrated arm's.
            parameters: its calibrated values.
            options: how commands are chosen.
            allowed: from commands (n x N) to whether the arm may be there (N).
            choice: of evaluator: compiled C, or CasADi's interpreter.

        Raises:
            ValueError: limits of a joint that is not there, or in falling order.
        """
        self.expression, self.options = expression, options or Options()
        coupled = partial(within_couplings, [expression.arm]) if expression.arm.couplings else None
        self._allowed = (lambda q: allowed(q) & coupled(q)) if allowed and coupled else allowed or coupled
        self.limits = command_limits(expression, self.options.limits)
        self.reach: Reach = reach_of(expression.arm, parameters, self.limits, expression.tool_T_point)
        self._point_T_tool = np.linalg.inv(evaluated(expression.tool_T_point.matrix()))
        self._equilibrium = Equilibrium(expression, choice)
        self._counts = ServoCounts(expression.joints, expression.servos) if expression.servos else None
        self._seeds = Seeds(expression, self._equilibrium, self.limits, SEEDS, self.options.seed)
        self._choice: EvaluatorChoice = choice
        self._positions, self._poses = _TargetKind(self, "position"), _TargetKind(self, "pose")

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
        """Commands for each target by itself.

        Args:
            targets: where the tool shall be.
            start: commands from which the arm comes (n or N x n). ``nearest`` is near to them; without any the first
                commands that are found are taken.

        Raises:
            ValueError: another number of commands.
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
        return self._kind(targets).finder.postures(self._record(targets), _goal(targets), starts)

    def follow(self, targets: Targets, start: Array | None = None) -> Commands:
        """Commands along a path: one target after another, without jumps where that can be.

        ``start`` (n) is where the arm stands; without it the best of several postures for the first target. The sides
        from which joints come follow from the path.

        Raises:
            ValueError: as of ``solve``.
        """
        if not len(targets):
            return replace(self.solve(targets, start), moves=np.zeros((0, len(self.joints))))
        return Commands.joined([part for part in self.following(targets, start) if part is not None])

    def following(self, targets: Targets, start: Array | None = None) -> Iterator[Commands | None]:
        """The same a little at a time, for a server with other clients: None while it searches, then part by part.

        Raises:
            ValueError: as of ``solve``.
        """
        record = self._record(targets)
        finder = PathFinder(self._kind(targets).finder, len(self.joints), self._tells_approach)
        at = None if start is None else self._commanded(start, 1)[:, 0]
        path = None
        for step in finder(record, _goal(targets), at):
            path = step
            yield None
        assert path is not None
        record[len(self.joints) : 2 * len(self.joints)] = path.approach
        for first in range(0, len(targets), PART):
            rows = np.arange(first, min(first + PART, len(targets)))
            part = self._commands(chosen_of(record, rows), targets.subset(rows), path.solutions.subset(rows))
            yield replace(part, moves=path.moves[:, rows].T)

    def onward(self, targets: Targets, at: Array) -> Commands:
        """Commands for targets straight on from others (N x n): no other posture is looked for."""
        record = self._record(targets)
        solutions = self._kind(targets).finder.straight(record, _goal(targets), self._commanded(at, len(targets)))
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

        Raises:
            ValueError: another number of commands, or of conditions.
            NotConvergedError: one has no equilibrium.
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
        """What the board makes of commands (n x N)."""
        if self._counts is None:
            return commands
        return self._counts.angles(self._counts.counts(commands), commands)

    def _found(self, record: Array, targets: Targets, start: Array | None) -> Solutions:
        """Exact commands: the nearest to those from which the arm comes, or the first that are found."""
        finder = self._kind(targets).finder
        return finder.first(record, _goal(targets)) if start is None else finder.onward(record, _goal(targets), start)

    def _commands(self, record: Array, targets: Targets, solutions: Solutions) -> Commands:
        """What is commanded: exact, or the best counts; and where that leads."""
        joints, counts = len(self.joints), None
        record[:joints] = solutions.commands
        rounding = self._kind(targets).rounding
        if rounding is not None:
            counts, record[:joints] = rounding(record, solutions, _goal(targets), self._allowed)
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
        """A sentence for each target that is not reached; empty for the others."""
        barred = "are too near to something" + ", or turn a coupled joint too far" * bool(self.expression.arm.couplings)
        lost, turned = np.flatnonzero(~had), np.zeros(len(had), dtype=bool)
        near = lost[(bounds[lost] == 0) & ~solutions.forbidden[lost]]
        if targets.rotations is not None and near.size:
            turned[near] = self._positions.finder.first(record[:, near], targets.positions[near].T).there
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

    def _kind(self, targets: Targets) -> _TargetKind:
        return self._positions if targets.rotations is None else self._poses

    @cached_property
    def _tells_approach(self) -> bool:
        """Whether it matters from where a joint comes."""
        names = [f"{APPROACH}{joint}" for joint in self.joints]
        return self.expression.uses(names)


class _TargetKind:
    """What finds commands for one kind of target; each part is made when it is first used."""

    def __init__(self, arm: Compensator, aim: Aim) -> None:
        self._arm, self._aim = arm, aim

    @cached_property
    def solver(self) -> Solver:
        arm, options = self._arm, self._arm.options
        tolerance, length = (options.reach_m, options.reach_rad), arm._seeds.spread / 2
        return Solver(arm.expression, arm.limits, self._aim, length, tolerance, arm._choice)

    @cached_property
    def finder(self) -> Finder:
        return Finder(self.solver, self._arm._seeds, self._arm._allowed)

    @cached_property
    def rounding(self) -> Rounding | None:
        """To counts of servos; None where there are none."""
        arm = self._arm
        if arm._counts is None:
            return None
        return Rounding(arm.expression, arm._counts, arm._equilibrium, self.solver, arm._choice)


def _goal(targets: Targets) -> Array:
    """As the solver takes it (3 or 12 x N)."""
    if targets.rotations is None:
        return targets.positions.T
    return np.concatenate([targets.positions.T, targets.rotations.transpose(0, 2, 1).reshape(-1, 9).T])


@dataclass(frozen=True)
class Sent:
    """Poses that make the nominal arm's inverse kinematics give the commands of the real arm."""

    poses: Array  # of the point that is brought to targets, in the base frame (N x 4 x 4)
    shifts: Array  # from the targets to these (N x 3; m)
    turns: Array | None  # rotation vectors in the base frame (N x 3; rad); None where only positions count


def nominal_arm(
    arm: Arm, parameters: Parameters, environment: Environment, options: Options, tool_T_point: Transform | None = None
) -> Compensator:
    """The arm as its controller has it: rigid, without effects, at the nominal values of ``parameters``."""
    expression = arm_expression(replace(arm, effects={}, masses=()), parameters, environment)
    return Compensator(expression if tool_T_point is None else expression.at(tool_T_point), parameters, options)


def sent(nominal: Compensator, targets: Targets, commands: Commands) -> Sent:
    """Where the nominal arm takes commands of the real arm to lead; nan of targets that are not reached."""
    poses = np.where(commands.reached[:, None, None], nominal.forward(commands.joint_angles), np.nan)
    turns = None if targets.rotations is None else turn_between(targets.rotations, poses[:, :3, :3])
    return Sent(poses, np.asarray(poses[:, :3, 3] - targets.positions), turns)
