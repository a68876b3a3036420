"""The compensator of one arm: from targets to commands."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import cached_property, partial

import numpy as np

from armcal.arm.assembly import within_couplings
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array, Mask
from armcal.base.parameters import Parameters
from armcal.base.se3 import evaluated
from armcal.calibration.compensation.counts import Rounding, ServoCounts
from armcal.calibration.compensation.finder import Allowed, Finder, Seeds
from armcal.calibration.compensation.path import PathFinder, with_sides
from armcal.calibration.compensation.reach import Reach, command_limits, reach_of, why_not
from armcal.calibration.compensation.redundancy import Descent
from armcal.calibration.compensation.request import Commands, Options, Targets
from armcal.calibration.compensation.search import Rows, Solutions, Solver, chosen_of
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import APPROACH, Equilibrium, Standing, ToolExpression
from armcal.functions.batch_function import EvaluatorChoice

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
        self._positions, self._poses = _TargetKind(self, turns=False), _TargetKind(self, turns=True)

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
            solutions = with_sides(
                record, towards, targets.approach, lambda sided: self._found(sided, targets, towards)
            )
        return self._commands(record, targets, solutions)

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

    def exact(self, joint_angles: Array, acting: Array) -> Array:
        """The same where joints stand at commands (N x n) to the last digit, as no board sets them.

        ``acting`` is LOAD_CHANNELS x N.

        Raises:
            NotConvergedError: one has no equilibrium.
        """
        nowhere = self.targets(np.zeros((len(joint_angles), 3)))
        record = self._record(replace(nowhere, acting=acting))
        record[: len(self.joints)] = joint_angles.T
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
        """Exact commands, as redundancy asks."""
        goal, kind = _goal(targets), self._kind(targets)
        choice = len(self.joints) > (3 if targets.rotations is None else 6)
        if self.options.redundancy == "nearest":
            return kind.finder(record, goal) if start is None else kind.finder.onward(record, goal, start)

        def score(commands: Array, states: Array, rows: Rows) -> Array:
            return kind.descent.score(record[:, rows], commands, states)

        solutions = kind.finder(record, goal, start, score)
        if choice:
            kind.descent.improve(record, goal, solutions, self._allowed)
        return solutions

    def _commands(self, record: Array, targets: Targets, solutions: Solutions) -> Commands:
        """What is commanded: exact, or the best counts; and where that leads."""
        joints, counts = len(self.joints), None
        record[:joints] = solutions.commands
        rounding = self._kind(targets).rounding
        if rounding is not None:
            counts, record[:joints] = rounding(record, solutions, targets, self._allowed)
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

        def position_can_be_had(rows: Rows) -> Mask:
            return self._positions.finder(record[:, rows], targets.positions[rows].T, commands[:, rows]).there

        why = "are too near to something" + ", or turn a coupled joint too far" * bool(self.expression.arm.couplings)
        parts = (self.joints, self.limits, commands, targets, solutions, had, bounds, position_can_be_had, why)
        return Commands(
            joints=self.joints,
            joint_angles=commands.T.copy(),
            counts=None if counts is None else counts.T.copy(),
            base_T_tool=poses @ self._point_T_tool,
            base_T_point=poses,
            distances=np.linalg.norm(poses[:, :3, 3] - targets.positions, axis=1),
            turns=turns,
            reached=had,
            reasons=why_not(*parts),
            bounds=np.where(had, 0.0, bounds),
            approach=record[joints : 2 * joints].T.copy(),
        )

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
    """What finds commands for positions alone, or (``turns``) whole poses; each part is made when it is first used."""

    def __init__(self, arm: Compensator, turns: bool) -> None:
        self._arm, self._turns = arm, turns

    @cached_property
    def solver(self) -> Solver:
        arm, options = self._arm, self._arm.options
        tolerance, length = (options.reach_m, options.reach_rad), arm._seeds.spread / 2
        return Solver(arm.expression, arm.limits, self._turns, length, tolerance, arm._choice)

    @cached_property
    def finder(self) -> Finder:
        return Finder(self.solver, self._arm._seeds, self._arm._allowed)

    @cached_property
    def descent(self) -> Descent:
        arm = self._arm
        return Descent(arm.expression, arm.options.redundancy, self.solver, arm._choice)

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
