"""The two-arm robot's configurations as problems that are built once and fitted often, and its arms in plain numpy."""

from __future__ import annotations

import importlib.util
import json
import sys
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path

import frida
import numpy as np
import yaml
from armcal.base.dataset import Dataset
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.estimate.estimator import estimate
from armcal.estimate.identifiability import require_solvable
from armcal.estimate.polish import started
from armcal.estimate.simulation import SimulationRequest
from armcal.problem.problem import Problem
from armcal.problem.variants import with_joint_noise
from armcal.run.experiment import Experiment

ROOT = Path(__file__).resolve().parents[1]
CONFIGS = ROOT / "configs" / "frida"
JOINTS = range(1, 8)
TWIST = ("wx", "wy", "wz", "vx", "vy", "vz")


def clamp_table():
    """The module ``benchmarks.clamp_table``, which is no part of any package on the path."""
    name = "clamp_table"
    if name not in sys.modules:
        spec = importlib.util.spec_from_file_location(name, ROOT / "benchmarks" / "clamp_table.py")
        sys.modules[name] = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(sys.modules[name])
    return sys.modules[name]


def number(text):
    """A value of a truth file in SI."""
    return float(str(text).split()[0])


@dataclass(frozen=True)
class Case:
    """A configuration with settings of its own; everything is built once."""

    path: Path
    settings: tuple[str, ...] = ()

    @classmethod
    def load(cls, name, joint_noise=None, clamp=None, priors=None):
        """``joint_noise`` (rad) is what the arms state; ``clamp`` is where the bracket is, and known to be."""
        settings = []
        if joint_noise is not None:
            arms = yaml.safe_load((CONFIGS / f"{name}.yaml").read_text())["extends"]
            names = ("left", "right") if arms == "two_arms.yaml" else ("arm",)
            settings += [f"arms.{arm}.joint_noise_rad={joint_noise}" for arm in names]
        settings += [f"measurements.closure.clamps.one={json.dumps(clamp)}"] if clamp else []
        settings += [f"parameters.priors={json.dumps(priors)}"] if priors else []
        return cls(CONFIGS / f"{name}.yaml", tuple(settings))

    @cached_property
    def experiment(self):
        return Experiment.load(self.path, [*self.settings, "simulation.joint_noise_rad=0"])

    @property
    def truth_file(self):
        return str(self.experiment.source.data["simulation"]["truth"])

    @cached_property
    def postures(self):
        """Records whose joints read exactly."""
        experiment = self.experiment
        system = experiment.system
        request = SimulationRequest(system.arms, system.measurements, experiment.parameters, system.environment)
        return experiment.simulator().simulate(request)

    @cached_property
    def truth(self):
        """What the truth states, by entry."""
        stated = yaml.safe_load((self.path.parent / self.truth_file).read_text())
        return {name: number(value) for name, value in stated.items()}

    @cached_property
    def problem(self):
        own = self.experiment.of_records(self.postures)
        system = own.system
        built = (system.arms, system.measurements, own.parameters, system.environment, self.postures)
        return Problem.build(*built, "interpreted")

    @property
    def nominal(self):
        return self.problem.parameters.nominal()

    @cached_property
    def true_values(self):
        source = load_config(self.path.parent / self.truth_file)
        return with_values(self.problem.parameters, source.data, source, ()).nominal()

    def records(self, seed=None):
        """The postures as noisy encoders read them; exactly without a seed."""
        return self.told({}, seed)

    def told(self, moved, seed=None):
        """The same places of the joints, read by encoders that are off by more than the truth's offsets (rad)."""
        random = np.random.default_rng(seed)
        channels = {}
        for channel, angles in self.postures.channels.items():
            arm, _, joint = channel.partition(".")
            noise = self.experiment.system.arms[arm].joint_noise if seed is not None else 0.0
            offset = moved.get(f"{arm}.poe.offset{joint[1:]}", 0.0)
            channels[channel] = angles - offset + noise * random.normal(size=len(angles))
        return replace(self.postures, channels=channels)

    def _asked(self, dataset):
        records = self.problem.of(dataset).records
        problem = started(self.problem.with_records(records))
        return problem, with_joint_noise(problem.with_records(records), problem.parameters.nominal()).records

    def fit(self, dataset):
        """As a run does it, from the nominal values."""
        problem, records = self._asked(dataset)
        solution = self.experiment.estimator.solve(problem.with_records(records), problem.parameters.nominal())
        return estimate(problem.with_records(records), solution)

    def warnings(self, dataset):
        """What is said before the fit."""
        problem, records = self._asked(dataset)
        return require_solvable(problem.with_records(records), problem.parameters.nominal())

    def closing_error(self, values, dataset: Dataset, part):
        """Mean length of the closing error's position (m) or rotation (rad)."""
        residual = self.problem.of(dataset).residuals(values)[0]
        return float(np.linalg.norm(residual[part], axis=0).mean())


def offsets_of(found, names):
    """Values of an estimate by name."""
    return np.array([found.values[found.parameters.entries_of(n)][0] for n in names])


# ---------------------------------------------------------------- in plain numpy


def exponential(twist, displacement):
    """exp(twist * displacement) (N x 4 x 4) of one twist (w, v) and many displacements. [Murray1994]"""
    w, v = np.array(twist[:3]), np.array(twist[3:])
    length = np.linalg.norm(w)
    motion = np.tile(np.eye(4), (len(displacement), 1, 1))
    if length == 0:
        motion[:, :3, 3] = displacement[:, None] * v
        return motion
    x, y, z = w / length
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    turn = (length * displacement)[:, None, None]
    motion[:, :3, :3] += np.sin(turn) * cross + (1 - np.cos(turn)) * (cross @ cross)
    left = turn * np.eye(3) + (1 - np.cos(turn)) * cross + (turn - np.sin(turn)) * (cross @ cross)
    motion[:, :3, 3] = left @ (v / length)
    return motion


def inverse(poses):
    """Of rigid motions (N x 4 x 4)."""
    back = np.tile(np.eye(4), (len(poses), 1, 1))
    back[:, :3, :3] = poses[:, :3, :3].transpose(0, 2, 1)
    back[:, :3, 3] = -np.einsum("nji,nj->ni", poses[:, :3, :3], poses[:, :3, 3])
    return back


def small(poses):
    """The twist of motions near none (N x 6): position, rotation."""
    r = poses[:, :3, :3]
    turn = 0.5 * np.stack([r[:, 2, 1] - r[:, 1, 2], r[:, 0, 2] - r[:, 2, 0], r[:, 1, 0] - r[:, 0, 1]], axis=1)
    return np.hstack([poses[:, :3, 3], turn])


class NumpyArm:
    """One arm at the truth of a case, with its joint angles; ``moved`` is one number changed a little."""

    def __init__(self, case, arm):
        q = np.stack([case.postures.channels[f"{arm}.q{i}"] for i in JOINTS], axis=1)
        self.q, truth = q[:: max(1, len(q) // 40)], case.truth
        self.offsets = np.array([truth.get(f"{arm}.poe.offset{i}", 0.0) for i in JOINTS])
        self.twists = []
        for i, (point, axis) in enumerate(frida.AXES, start=1):
            nominal = (float(x) for x in (*axis, *np.cross(point, axis)))
            self.twists.append([truth.get(f"{arm}.poe.axis{i}[{e}]", x) for e, x in zip(TWIST, nominal, strict=True)])
        self.tool = np.eye(4)
        self.tool[:3, :3], self.tool[:3, 3] = frida.TOOL["rotation"], frida.TOOL["position_m"]

    def poses(self, kind="", joint=0, entry=0, size=0.0):
        """The tool in the arm's own base (N x 4 x 4)."""
        nudge = exponential(size * np.eye(6)[entry], np.ones(1))
        back, here = inverse(nudge), np.tile(np.eye(4), (len(self.q), 1, 1))
        for i in range(7):
            twist, turn, mine = np.array(self.twists[i]), self.q[:, i] + self.offsets[i], i == joint
            if mine and kind == "twists":
                twist[entry] += size
            motion = exponential(twist, turn + size * (mine and kind == "offsets"))
            here = here @ (nudge @ motion @ back if mine and kind == "axes" else motion)
        return here @ self.tool @ (nudge if kind == "tools" else np.eye(4))

    @staticmethod
    def numbers(kind):
        """The joint and the entry of each number of a kind."""
        if kind == "offsets":
            return [(i, 0) for i in range(7)]
        return [(0, k) for k in range(6)] if kind == "tools" else [(i, k) for i in range(7) for k in range(6)]


def placements():
    """The two bases as printed, as proper motions."""
    found = {}
    for arm, printed in yaml.safe_load((CONFIGS / "two_arms.yaml").read_text())["arms"].items():
        one, _, two = np.linalg.svd(np.array(printed["placement"]["rotation"]))
        found[arm] = np.eye(4)
        found[arm][:3, :3], found[arm][:3, 3] = one @ two, printed["placement"]["position_m"]
    return found


def oracle_slopes(case, arms, columns, step=1e-5):
    """d closing error / d numbers at the truth (6 N x n), by finite differences.

    An axis has six numbers here, two of which move nothing. ``point`` and ``clamp`` are a pose that all records share,
    ``placement`` is that of the right arm.
    """
    alone = "arm" in arms
    sides = {arm: NumpyArm(case, arm) for arm in (["arm"] if alone else ["left", "right"])}
    bases = placements()

    def closed(moved="", *change):
        at = {arm: side.poses(*(change if arm == moved else ())) for arm, side in sides.items()}
        if alone:
            return at["arm"]
        nudge = exponential(change[-1] * np.eye(6)[change[-2]], np.ones(1)) if moved == "placement" else np.eye(4)
        return inverse(bases["left"] @ at["left"]) @ bases["right"] @ nudge @ at["right"]

    here = closed()
    if not alone:
        assert np.abs(here - here[0]).max() < 1e-8, "the chain does not close at the truth"
    back, found = inverse(here), []
    changes = [
        (arm, kind, *place)
        for arm in arms
        for kind in columns
        if kind in ("offsets", "twists", "axes", "tools")
        for place in NumpyArm.numbers(kind)
    ]
    changes += [("placement", k) for k in range(6)] if "placement" in columns else []
    for change in changes:
        up, down = (closed(*change, sign * step) for sign in (1, -1))
        found.append(((small(back @ up) - small(back @ down)) / (2 * step)).ravel())
    if {"point", "clamp"} & set(columns):
        found += list(np.tile(np.eye(6), (len(here), 1)).T)
    return np.array(found).T
