"""Commands for 10,000 targets of the simulated LRM arm with 0 to 130 g, against a rigid arm's inverse kinematics.

The peer solves the same poses for the same arm without springs. Below the times stands what the servo board's counts
leave, beside the nominal command and the two ways of [Conenna2024].
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.calibration.compensation import Commands, Compensator, Options, Targets
from armcal.calibration.tool_expression import arm_expression
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.functions.batch_function import EvaluatorChoice
from armcal.run.experiment import Experiment

from benchmarks.lrm import CONFIGS
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "commands for targets"
TARGETS, ROUNDED, SEARCHED = 10_000, 1000, 100
PAYLOAD_KG = 0.13
LIMITS = {f"q{i}": (-np.radians(d), np.radians(d)) for i, d in enumerate((100, 50, 100, 100, 100, 50), start=1)}
BEYOND_M = 0.6
_CUBE_M, _STEPS = 0.01, 9
_TURNS = 30
"""Of the fixed point."""
_HAD_M = 1e-9


@dataclass(frozen=True)
class TrueArm:
    """The simulated arm: with its true parameters, and as it was thought to be."""

    experiment: Experiment
    parameters: Parameters

    @classmethod
    def of(cls, config: str) -> TrueArm:
        """That of a configuration in configs/lrm_arm, with the shipped truth."""
        experiment = Experiment.load(CONFIGS / config)
        stated = load_config(CONFIGS / "truth.yaml")
        truth = with_values(experiment.parameters, stated.data, stated, ())
        return cls(experiment, truth)

    def compensator(self, choice: EvaluatorChoice = "compiled") -> Compensator:
        """Of the arm as it is."""
        system = self.experiment.system
        expression = arm_expression(system.arms["arm"], self.parameters, system.environment)
        return Compensator(expression, self.parameters, Options(limits=LIMITS), choice=choice)

    def exact(self) -> Compensator:
        """Of the arm as it is, but with servos that can be set to the last digit."""
        system = self.experiment.system
        whole = system.arms["arm"]
        smooth = replace(whole, effects={name: e for name, e in whole.effects.items() if name != "counts"})
        expression = arm_expression(smooth, self.parameters, system.environment)
        return Compensator(expression, self.parameters, Options(limits=LIMITS), choice="compiled")

    def rigid(self, parameters: Parameters) -> Compensator:
        """Of the arm without springs or servos, with some parameters."""
        system = self.experiment.system
        plain = replace(system.arms["arm"], effects={}, masses=())
        expression = arm_expression(plain, parameters, system.environment)
        return Compensator(expression, parameters, Options(limits=LIMITS), choice="compiled")

    @property
    def nominal(self) -> Compensator:
        """Of the arm as it was thought to be."""
        return self.rigid(self.experiment.parameters)


def reachable(compensator: Compensator, count: int, seed: int = 0) -> Targets:
    """Poses that the arm takes at random commands, with random payloads."""
    random = np.random.default_rng(seed)
    commands = random.uniform(*compensator.limits.T, (count, len(compensator.joints)))
    nowhere = compensator.targets(np.zeros((count, 3)), payload=random.uniform(0, PAYLOAD_KG, count))
    tools = compensator.forward(commands, nowhere.acting)
    return replace(nowhere, positions=tools[:, :3, 3], rotations=tools[:, :3, :3])


def run() -> Iterator[Row]:
    """The rows of this benchmark."""
    arm = TrueArm.of("demo.yaml")
    targets = reachable(arm.exact(), TARGETS)
    for kind, asked in (("poses", targets), ("positions", replace(targets, rotations=None))):
        yield from _timed(arm, kind, asked)
    few = targets.subset(np.arange(200))
    slow = arm.compensator("interpreted")
    seconds = best_times({"slow": lambda: slow.solve(few)}, 2)["slow"]
    yield Row(NAME, "poses, elastic, no compiler", seconds, "", None, "asked: 1,000 us", len(few))
    beyond = replace(targets, positions=_beyond(targets.positions), rotations=None).subset(np.arange(1000))
    yield _out_of_reach(arm, beyond)


def _timed(arm: TrueArm, kind: str, targets: Targets) -> Iterator[Row]:
    compensator = arm.compensator()
    found = compensator.solve(targets)
    had = found.reached & (found.distances <= _HAD_M)
    peer, note = _toolbox(arm, targets)
    contenders: dict[str, Callable[[], object]] = {"armcal": lambda: compensator.solve(targets)}
    best = best_times({**contenders, **({"peer": peer} if peer else {})}, 4)
    told = f"{100 * had.mean():.2f} % within 1e-6 mm; {note}"
    yield Row(
        NAME, f"{kind}, elastic", best["armcal"], "robotics toolbox, rigid, ik_LM", best.get("peer"), told, len(targets)
    )
    one = targets.subset(np.arange(1))
    single = best_times({"one": lambda: compensator.solve(one)}, 20)["one"]
    yield Row(NAME, f"one of the {kind} by itself", single, "", None)


def _toolbox(arm: TrueArm, targets: Targets) -> tuple[Callable[[], Any] | None, str]:
    """The robotics toolbox on the same poses of the rigid arm, and how many it had."""
    try:
        import roboticstoolbox as rtb
    except ImportError as fault:
        return None, f"no robotics toolbox ({fault})"
    chain = _as_transforms(rtb, arm)
    poses = np.repeat(np.eye(4)[None], len(targets), axis=0)
    poses[:, :3, 3] = targets.positions
    mask = [1.0] * 3 + [0.0 if targets.rotations is None else 1.0] * 3
    random = np.random.default_rng(1)
    commands = random.uniform(*np.array(list(LIMITS.values())).T, (len(targets), len(LIMITS)))
    poses = np.array([np.asarray(chain.fkine(q)) for q in commands])
    had = np.array([chain.ik_LM(pose, mask=mask, joint_limits=True).success for pose in poses])

    def solve() -> None:
        for pose in poses:
            chain.ik_LM(pose, mask=mask, joint_limits=True)

    return solve, f"the toolbox {100 * had.mean():.2f} % within 1e-6 of its own measure"


def _as_transforms(rtb: Any, arm: TrueArm) -> Any:
    """The rigid arm as the toolbox has it."""
    from armcal.calibration.rigid_chain import numeric_chain, rigid_chain

    model = arm.experiment.system.arms["arm"]
    chain = rigid_chain(numeric_chain(model.model, _local(arm)))
    made, here = rtb.ET.SE3(np.eye(4)), np.eye(4)
    for joint, (low, high) in zip(chain.joints, LIMITS.values(), strict=True):
        made = made * rtb.ET.SE3(np.linalg.inv(here) @ joint.base_T_joint) * rtb.ET.Rz(qlim=[low, high])
        here = joint.base_T_joint
    return made * rtb.ET.SE3(np.linalg.inv(here) @ chain.base_T_tool)


def _local(arm: TrueArm) -> dict[str, Array]:
    head = "arm.mdh."
    blocks = arm.parameters.blocks
    return {b.name.removeprefix(head): np.array(b.nominal) for b in blocks if b.name.startswith(head)}


def _beyond(positions: Array) -> Array:
    return positions / np.linalg.norm(positions, axis=1, keepdims=True) * BEYOND_M


def _out_of_reach(arm: TrueArm, targets: Targets) -> Row:
    compensator = arm.compensator()
    found = compensator.solve(targets)
    seconds = best_times({"armcal": lambda: compensator.solve(targets)}, 2)["armcal"]
    apart = 1000 * (found.distances - found.bounds)
    told = f"{int(found.reached.sum())} had; nearest {apart.mean():.2f} mm (at least {apart.min():.2f}) above the bound"
    return Row(NAME, "positions beyond reach", seconds, "", None, told, len(targets))


@dataclass(frozen=True)
class Errors:
    """Position errors of one way to command (m), over the targets that it was tried on."""

    way: str
    errors: Array

    @property
    def text(self) -> str:
        """In mm."""
        mean, high, most = self.errors.mean(), np.percentile(self.errors, 95), self.errors.max()
        return f"{self.way}: mean {1000 * mean:.3f}, 95 % {1000 * high:.3f}, largest {1000 * most:.3f} mm"


def with_counts() -> Iterator[Errors]:
    """Errors that whole counts leave, by the way to command; targets are poses, errors are of the position."""
    arm = TrueArm.of("bench.yaml")
    compensator, rigid, nominal = arm.compensator(), arm.rigid(arm.parameters), arm.nominal
    exactly = arm.exact()
    targets = reachable(exactly, ROUNDED)
    thought = nominal.solve(targets)
    yield Errors("nominal", _away(compensator, thought.joint_angles[thought.reached], targets, thought.reached))
    few = targets.subset(np.arange(SEARCHED))
    yield Errors("fixed point", _fixed_point(compensator, rigid, targets))
    yield Errors(f"search in the 1 cm cube ({SEARCHED} targets)", _cube(compensator, rigid, few))
    exact = exactly.solve(targets)
    rounded = _away(compensator, exact.joint_angles[exact.reached], targets, exact.reached)
    yield Errors("exact commands, each joint to its nearest count", rounded)
    yield Errors("armcal, poses", compensator.solve(targets).distances)
    yield Errors("armcal, positions", compensator.solve(replace(targets, rotations=None)).distances)


def _away(compensator: Compensator, commands: Array, targets: Targets, rows: Any = slice(None)) -> Array:
    """How far the arm is from targets (N; m) at commands (N x n) rounded to counts."""
    some = targets.subset(np.arange(len(targets))[rows])
    stands = compensator.stand(commands, some, np.zeros_like(commands))
    return np.asarray(np.linalg.norm(stands.base_T_tool[:, :3, 3] - some.positions, axis=1))


def _fixed_point(compensator: Compensator, rigid: Compensator, targets: Targets) -> Array:
    """Rigid inverse kinematics of a target that is moved by what the elastic arm missed, again and again."""
    told, best = targets.positions.copy(), np.full(len(targets), np.inf)
    near: Array | None = None
    for _ in range(_TURNS):
        found: Commands = rigid.solve(replace(targets, positions=told), near)
        stands = compensator.stand(found.joint_angles, targets, np.zeros_like(found.joint_angles))
        missed = targets.positions - stands.base_T_tool[:, :3, 3]
        best = np.minimum(best, np.where(found.reached, np.linalg.norm(missed, axis=1), np.inf))
        told, near = told + missed, found.joint_angles
    return best[np.isfinite(best)]


def _cube(compensator: Compensator, rigid: Compensator, targets: Targets) -> Array:
    """The best of rigid inverse kinematics over a cube about the target."""
    side = np.linspace(-_CUBE_M / 2, _CUBE_M / 2, _STEPS)
    moves = np.stack(np.meshgrid(side, side, side), axis=-1).reshape(-1, 3)
    rows = np.repeat(np.arange(len(targets)), len(moves))
    asked = targets.subset(rows)
    told = replace(asked, positions=asked.positions + np.tile(moves, (len(targets), 1)))
    found = rigid.solve(told)
    stands = compensator.stand(found.joint_angles, asked, np.zeros_like(found.joint_angles))
    away = np.linalg.norm(stands.base_T_tool[:, :3, 3] - asked.positions, axis=1)
    best = np.where(found.reached, away, np.inf).reshape(len(targets), -1).min(axis=1)
    return np.asarray(best[np.isfinite(best)])


if __name__ == "__main__":
    from rich import print as show

    for row in run():
        show(row)
    for line in with_counts():
        show(line.text)
