"""Exported C code pose by pose, one call each, against pinocchio's rigid forward kinematics in one C++ loop."""

from __future__ import annotations

import ctypes
import subprocess
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array
from armcal.calibration.exporter import ExportRequest, rigid_tools
from armcal.calibration.rigid_chain import numeric_chain
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.functions.compiler import find_compiler
from armcal.plugins import discover
from armcal.run.experiment import Experiment

from benchmarks.pinocchio_loop import compiled
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "exported C code"
POSES = 10_000
CONFIGS = Path(__file__).parents[1] / "configs"
FORWARD = Path(__file__).with_name("pinocchio_forward.cpp")
MOST_RIGID, MOST_ELASTIC = 1.5, 10
"""How many times pinocchio's time the code may take: an arm without springs, and one with springs from a cold start."""
_MOVED_M, _MOVED_RAD, _START_RAD = 0.001, 0.01, 0.01
_PEER = "pinocchio, rigid, C++ loop"
_LOOP = """
#include "arm.h"
/* Every pose by itself: a call of the code, and where keep is 0 from a state of zeros. */
int forward(long poses, const double *commands, double *out, int keep)
{
  double state[ARM_STATE_SIZE] = {0};
  int failed = 0;
  arm_input input = arm_defaults;
  for (long i = 0; i < poses; ++i) {
    for (int j = 0; j < ARM_JOINTS; ++j) input.commands[j] = commands[i * ARM_JOINTS + j];
    for (int k = 0; k < ARM_STATE_SIZE && !keep; ++k) state[k] = 0.0;
    failed += arm_forward(&input, state, out + 12 * i) != ARM_DONE;
  }
  return failed;
}
int jacobian(long poses, const double *commands, double *out)
{
  double state[ARM_STATE_SIZE] = {0}, pose[12];
  int failed = 0;
  arm_input input = arm_defaults;
  for (long i = 0; i < poses; ++i) {
    for (int j = 0; j < ARM_JOINTS; ++j) input.commands[j] = commands[i * ARM_JOINTS + j];
    for (int k = 0; k < ARM_STATE_SIZE; ++k) state[k] = 0.0;
    failed += arm_jacobian(&input, state, pose, out) != ARM_DONE;
  }
  return failed;
}
/* Commands for the poses of a small circle about each pose's own commands, from these. */
int compensate(long poses, const double *commands, const double *targets)
{
  double state[ARM_STATE_SIZE] = {0};
  int failed = 0;
  for (long i = 0; i < poses; ++i) {
    arm_input input = arm_defaults;
    arm_target target = {ARM_POSE, {0}, 1e-9, 1e-9};
    arm_outcome outcome;
    for (int j = 0; j < ARM_JOINTS; ++j) input.commands[j] = commands[i * ARM_JOINTS + j];
    for (int k = 0; k < 12; ++k) target.base_T_tool[k] = targets[12 * i + k];
    for (int k = 0; k < ARM_STATE_SIZE; ++k) state[k] = 0.0;
    failed += arm_compensate(&input, state, &target, 30, &outcome) != ARM_DONE;
  }
  return failed;
}
"""


@dataclass(frozen=True)
class _Subject:
    """An arm with numbers of a calibration, and commands (poses x joints; rad)."""

    arm: Arm
    request: ExportRequest
    commands: Array


def run() -> Iterator[Row]:
    """Rigid, elastic from a cold and a warm start, its Jacobian, and compensation."""
    if find_compiler() is None:
        yield Row(NAME, "exported C code", None, "pinocchio, C++ loop", None, "no C compiler", POSES)
        return
    for subject in (_panda(), _lrm()):
        with tempfile.TemporaryDirectory() as directory:
            yield from _rows(subject, _Code(_built(subject.request, Path(directory)), subject.commands))


class _Code:
    """The exported code of one arm, called for all poses."""

    def __init__(self, library: ctypes.CDLL, commands: Array) -> None:
        self._library, self._count = library, ctypes.c_long(POSES)
        random = np.random.default_rng(3)
        self._commands = np.ascontiguousarray(commands)
        self._path = np.ascontiguousarray(np.cumsum(random.normal(0, 0.01, commands.shape), axis=0) % 1.0)
        self._slopes, self.missed = np.zeros(6 * commands.shape[1]), 0
        self.poses, self._other = np.zeros((POSES, 12)), np.zeros((POSES, 12))
        self._targets = np.zeros((POSES, 12))
        beside = commands + _START_RAD * random.uniform(-1, 1, commands.shape)
        beside = np.clip(beside, commands.min(axis=0), commands.max(axis=0))
        self._forward(np.ascontiguousarray(beside), self._targets, keep=0)

    def forward(self) -> None:
        """Every pose from a cold start."""
        self._forward(self._commands, self.poses, keep=0)

    def follow(self) -> None:
        """A path, every pose from the one before."""
        self._forward(self._path, self._other, keep=1)

    def jacobian(self) -> None:
        """Every pose and its Jacobian from a cold start."""
        self._library.jacobian(self._count, _at(self._commands), _at(self._slopes))

    def compensate(self) -> None:
        """Commands for poses nearby."""
        self.missed = self._library.compensate(self._count, _at(self._commands), _at(self._targets))

    def _forward(self, commands: Array, out: Array, keep: int) -> None:
        if self._library.forward(self._count, _at(commands), _at(out), keep):
            raise RuntimeError("a pose did not settle")


def _rows(subject: _Subject, code: _Code) -> Iterator[Row]:
    peer = _pinocchio(subject)
    calls: dict[str, Callable[[], object]] = {
        "forward kinematics": code.forward,
        "along a path": code.follow,
        "with Jacobian": code.jacobian,
        "compensation to 1e-9 m": code.compensate,
    }
    missing = peer if isinstance(peer, str) else ""
    times = best_times(calls if isinstance(peer, str) else {**calls, _PEER: peer.run}, repeats=5)
    elastic = subject.arm.deflection_size > 0
    name = "LRM arm, 7 springs" if elastic else "rigid Panda"
    notes = {
        "forward kinematics": f"asked: at most {MOST_ELASTIC if elastic else MOST_RIGID:g} times",
        "compensation to 1e-9 m": f"{code.missed} of {POSES} not reached; starts {_START_RAD} rad off",
    }
    if not elastic and not isinstance(peer, str):
        apart = np.abs(code.poses.reshape(-1, 3, 4) - peer.tools()).max()
        notes["forward kinematics"] += f"; agree to {apart:.1g} m"
    for work in calls:
        note = "; ".join(each for each in (notes.get(work, ""), missing) if each)
        yield Row(NAME, f"{name}, {work}", times[work], _PEER, times.get(_PEER), note, POSES)


def _panda() -> _Subject:
    experiment = Experiment.load(CONFIGS / "mukca" / "panda.yaml")
    arm = next(iter(experiment.system.arms.values()))
    random = np.random.default_rng(1)
    moves = {"m": _MOVED_M, "rad": _MOVED_RAD}
    values = {b.name: np.array(b.nominal) + random.normal(0, moves.get(b.unit, 0.0), b.size) for b in arm.parameters()}
    return _subject(arm, values, experiment)


def _lrm() -> _Subject:
    experiment = Experiment.load(CONFIGS / "lrm_arm" / "demo.yaml")
    arm = experiment.system.arms["arm"]
    truth = load_config(CONFIGS / "lrm_arm" / "truth.yaml")
    parameters = with_values(experiment.system.parameters(), truth.data, truth, ())
    own = {block.name for block in arm.parameters()}
    values = {b.name: np.array(b.nominal) for b in parameters.blocks if b.name in own}
    return _subject(arm, values, experiment)


def _subject(arm: Arm, values: Mapping[str, Array], experiment: Experiment) -> _Subject:
    request = ExportRequest(arm.name, arm, values, environment=experiment.system.environment, out="arm.c")
    low, high = np.array([j.limits or (-1.5, 1.5) for j in arm.nominal_chain.joints]).T
    commands = np.random.default_rng(2).uniform(low, high, (POSES, len(arm.commanded)))
    return _Subject(arm, request, commands)


def _built(request: ExportRequest, directory: Path) -> ctypes.CDLL:
    made = discover().find("exporter", "c").load()
    exported = made(made.Settings(prefix="arm")).export(request)
    files = {"arm.c": exported.content, **exported.companions, "loop.c": _LOOP.encode()}
    for name, content in files.items():
        (directory / name).write_bytes(content)
    target = directory / "arm.so"
    command = [str(find_compiler()), "-std=c99", "-O2", "-fPIC", "-shared", "-o", str(target)]
    subprocess.run([*command, "arm.c", "loop.c", "-lm"], cwd=directory, check=True)
    return ctypes.CDLL(str(target))


class _Pinocchio:
    """Forward kinematics of an arm whose joints turn about z."""

    def __init__(self, library: ctypes.CDLL, placements: Array, angles: Array) -> None:
        library.kinematics.argtypes = [ctypes.c_int, ctypes.c_long, *[ctypes.c_void_p] * 3]
        self._library, self._placements, self._angles = library, placements, angles
        self._found = np.zeros((POSES, 12))

    def run(self) -> None:
        """All poses."""
        joints = self._angles.shape[1]
        self._library.kinematics(joints, POSES, _at(self._placements), _at(self._angles), _at(self._found))

    def tools(self) -> Array:
        """base_T_tool (N x 3 x 4)."""
        return np.concatenate([self._found[:, :9].reshape(-1, 3, 3), self._found[:, 9:, None]], axis=2)


def _pinocchio(subject: _Subject) -> _Pinocchio | str:
    """The same arm without its springs, or what is missing."""
    library = compiled(FORWARD)
    if isinstance(library, str):
        return library
    arm = subject.arm
    scope = f"{arm.name}.{arm.model_name}."
    local = {n.removeprefix(scope): v for n, v in subject.request.values.items() if n.startswith(scope)}
    chain = numeric_chain(arm.model, local)
    if any(joint.angular != (0.0, 0.0, 1.0) or joint.twist is not None for joint in chain.joints):
        raise RuntimeError("the loop's joints turn about z")
    poses = [joint.parent_T_joint for joint in chain.joints]
    poses[0] = chain.base_T_mount @ poses[0]
    matrices = [ca.evalf(ca.densify(pose.matrix())).full() for pose in (*poses, chain.tool.joint_T_frame)]
    flat = np.array([np.concatenate([m[:3, :3].ravel(), m[:3, 3]]) for m in matrices])
    offsets = np.array([float(ca.evalf(ca.SX(joint.offset))) for joint in chain.joints])
    peer = _Pinocchio(library, flat, np.ascontiguousarray(subject.commands + offsets))
    peer.run()
    expected = rigid_tools(arm, subject.request.values, subject.commands.T)[:, :3]
    if not np.allclose(peer.tools(), expected, rtol=0, atol=1e-12):
        raise RuntimeError("pinocchio was given another arm")
    return peer


def _at(array: Array) -> ctypes.c_void_p:
    return ctypes.c_void_p(array.ctypes.data)
