"""Causes of errors planted in recordings of an arm of six joints, most of them no dependence that is tested as such."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from armcal.base.dataset import Dataset
from armcal.diagnose.residual_structure import ResidualStructure, structure
from armcal.estimate.estimator import Estimate
from armcal.estimate.robust import fit
from armcal.estimate.simulation import SimulationRequest, measured_without_noise
from armcal.problem.problem import Problem
from armcal.run.experiment import Experiment
from armcal_ipopt.estimator import IpoptEstimator
from scipy.spatial.transform import Rotation

from tests.fits import fit_of

DEG = np.pi / 180
NOISE_M = 1e-4
COUNT = 150
LIMITS = np.array([150, 70, 100, 150, 100, 150]) * DEG
AXES = ("x", "y", "z")
ARM = """
name: six
arms:
  arm:
    model:
      type: mdh
      convention: standard
      base: [{x_mm: 0}, {y_mm: 0}, {z_mm: 0}, {rx_deg: 0}, {ry_deg: 0}]
      rows:
        - {d_mm: 300, a_mm: 50, alpha_deg: 90}
        - {a_mm: 400}
        - {a_mm: 40, alpha_deg: 90}
        - {d_mm: 350, alpha_deg: -90}
        - {alpha_deg: 90}
        - {d_mm: 80}
    effects: {spring: {type: torsional_spring}}
    links:
      upper: {mass_g: 3000, com_mm: [-150, 0, 30], frame: row2}
      fore: {mass_g: 2000, com_mm: [0, 20, 100], frame: row4}
      hand: {mass_g: 800, com_mm: [0, 0, 40], frame: row6}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.1, target_mm: [30, 20, 50]}}
estimator: {type: ipopt}
data: {type: csv, path: none.csv}
"""
FREE = (
    *(f"arm.mdh.theta{i}" for i in range(1, 6)),
    *(f"arm.mdh.{name}" for name in ("a2", "a3", "d4", "alpha1", "alpha3")),
    *(f"arm.mdh.base_{step}" for step in ("x", "y", "z", "rx", "ry")),
    *(f"tracker.target_{axis}" for axis in AXES),
    *(f"arm.spring.k{i}" for i in (2, 3, 5)),
)
SPRINGS = {f"arm.spring.k{i}": 2e-5 * (1 + i / 3) for i in range(1, 7)}

Change = Callable[[np.ndarray, np.random.Generator], np.ndarray]


@dataclass(frozen=True)
class Cause:
    """What is planted.

    Attributes:
        truth: parameters by what they are off (SI), all of them held in the fit.
        stands: how joints really stand (N x 6), by their commands and the order of the records.
        read: what is read of true positions (N x 3) at these commands.
        right: words that the name of the cause has; none where nothing that is named can be right.
    """

    truth: Mapping[str, float] | None = None
    stands: Callable[[np.ndarray], np.ndarray] | None = None
    read: Callable[[np.ndarray, np.ndarray], np.ndarray] | None = None
    after: Mapping[str, float] | None = None
    right: tuple[str, ...] = ()


def turned(degrees: float, axis: Sequence[float]) -> np.ndarray:
    return Rotation.from_rotvec(degrees * DEG * np.array(axis)).as_matrix()


def joint(number: int, turn: Callable[[np.ndarray], np.ndarray]) -> Callable[[np.ndarray], np.ndarray]:
    return lambda q: q + np.outer(turn(q), np.eye(6)[number - 1])


def when(q: np.ndarray) -> np.ndarray:
    """Time, from 0 to 1."""
    return np.arange(len(q)) / (len(q) - 1)


def tilting(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    return np.array([turned(0.4 * t, (0, 1, 0)) @ one for t, one in zip(when(q), p, strict=True)])


def growing(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """Along what the first joint turns, fast at first."""
    along = np.stack([np.sin(q[:, 0]), -np.cos(q[:, 0]), 0 * q[:, 0]], axis=1)
    return p + 0.002 * (1 - np.exp(-5 * when(q)))[:, None] * along


def bent(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """An instrument's distance, off by a square."""
    return p * (1 + 0.02 * (np.linalg.norm(p, axis=1) - 0.5) ** 2)[:, None]


def wobbling(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The first joint's axis, twice and three times a turn."""
    return p + 0.001 * np.stack([np.cos(2 * q[:, 0]), np.sin(2 * q[:, 0]), np.cos(3 * q[:, 0])], axis=1)


def waving(q: np.ndarray, p: np.ndarray) -> np.ndarray:
    """The base, to and fro."""
    return p + 0.001 * np.sin(14 * np.pi * when(q))[:, None] * [1, 0.5, 0.2]


CAUSES: Mapping[str, Cause] = {
    "a held length a1": Cause({"arm.mdh.a1": 0.004}, right=("arm.mdh.a1",)),
    "a held length d6 and target_z": Cause({"tracker.target_z": 0.004}, right=("target_z", "d6")),
    "a held length d3": Cause({"arm.mdh.d3": 0.004}, right=("arm.mdh.d3", "arm.mdh.d2")),
    "a held length a4": Cause({"arm.mdh.a4": 0.004}, right=("arm.mdh.a4",)),
    "a held length a2 of 30 mm": Cause({"arm.mdh.a2": 0.03}, right=("arm.mdh.a2",)),
    "a held twist alpha2": Cause({"arm.mdh.alpha2": 0.5 * DEG}, right=("arm.mdh.alpha2",)),
    "a held twist alpha4": Cause({"arm.mdh.alpha4": 0.5 * DEG}, right=("arm.mdh.alpha4",)),
    "a held zero theta3": Cause({"arm.mdh.theta3": 0.5 * DEG}, right=("arm.mdh.theta3", "zero of q3")),
    "a held base": Cause({"arm.mdh.base_x": 0.005}, right=("base_x", "shift of what is measured")),
    "a held tilt of 3 deg": Cause({"arm.mdh.base_rx": 3 * DEG}, right=("base_rx",)),
    "a held target": Cause({"tracker.target_x": 0.004}, right=("target_x",)),
    "a target that moved": Cause(after={"tracker.target_x": 0.004, "tracker.target_y": -0.002}, right=("target",)),
    "a tracker that turned": Cause(
        read=lambda q, p: np.where(when(q)[:, None] < 0.5, p, p @ turned(0.5, (0.8, 0, 0.6)).T),
        right=("jumps there", "turns"),
    ),
    "a third harmonic": Cause(stands=joint(3, lambda q: 0.3 * DEG * np.sin(3 * q[:, 2])), right=("of q3,",)),
    "a gear of square law": Cause(stands=joint(2, lambda q: 0.4 * DEG * q[:, 1] ** 2), right=("of q2,",)),
    "sag of q5 by q2 and q3": Cause(stands=joint(5, lambda q: 0.3 * DEG * np.cos(q[:, 1] + q[:, 2]))),
    "a table that tilts": Cause(read=tilting, right=("drifts", "changes with time")),
    "wrong masses": Cause(
        {"arm.links.fore.mass": 6.0, "arm.links.fore.com_x": 0.3}, right=("arm.links", "size of gravity")
    ),
    "a link that grew": Cause(read=growing, right=("changes with time",)),
    "an instrument that bends": Cause(read=bent),
    "two joints together": Cause(stands=joint(4, lambda q: 0.3 * DEG * np.sin(q[:, 1]) * np.sin(2 * q[:, 4]))),
    "an axis that wobbles": Cause(read=wobbling, right=("of q1, in",)),
    "waves of the base": Cause(read=waving, right=("changes with time",)),
    "play that grows with the load": Cause(
        stands=joint(2, lambda q: 0.2 * DEG * np.sign(np.diff(q[:, 1], prepend=0)) * (1 + np.cos(q[:, 1]))),
        right=("the side q2",),
    ),
}


def experiment(folder: Path) -> Experiment:
    (folder / "six.yaml").write_text(ARM)
    return Experiment.load(folder / "six.yaml")


def recording(
    base: Experiment, cause: Cause, seed: int, q: np.ndarray | None = None, noise: float = NOISE_M
) -> Dataset:
    """Random poses, or ``q``, of an arm whose free parameters differ from nominal, with the cause in them."""
    random, system = np.random.default_rng(seed), base.system
    q = random.uniform(-1, 1, (COUNT, 6)) * LIMITS if q is None else q
    count = len(q)
    offs = {n: random.normal(scale=0.001 if "theta" not in n and "alpha" not in n else 0.003) for n in FREE[:10]}
    offs |= SPRINGS | {"arm.mdh.base_x": 0.002 * random.normal(), "tracker.target_y": 0.001 * random.normal()}
    sign = random.choice([-1.0, 1.0])
    free = free_of(cause)
    offs = {n: off for n, off in offs.items() if n in free or n in SPRINGS}

    def positions(more: Mapping[str, float]) -> np.ndarray:
        values = base.parameters.nominal()
        for changes, factor in ((offs, 1.0), (more, sign)):
            for name, off in changes.items():
                values[base.parameters.entries_of(name)] += factor * off
        stands = q if cause.stands is None else cause.stands(q)
        data = dataset_of(stands, np.zeros((count, 3)))
        request = SimulationRequest(
            system.arms, system.measurements, base.parameters.with_nominal(values), system.environment
        )
        shown = measured_without_noise(request, data)
        return np.stack([shown[f"tracker.{axis}"] for axis in AXES], axis=1)

    points = positions(cause.truth or {})
    if cause.after is not None:
        place = random.integers(count // 3, 2 * count // 3)
        points[place:] = positions(cause.after)[place:]
    if cause.read is not None:
        points = cause.read(q, points)
    return dataset_of(q, points + noise * random.normal(size=points.shape))


def free_of(cause: Cause) -> list[str]:
    return [name for name in FREE if name not in (cause.truth or {})]


def dataset_of(q: np.ndarray, points: np.ndarray) -> Dataset:
    channels = {f"arm.q{i + 1}": q[:, i] for i in range(6)}
    channels |= {f"tracker.{axis}": points[:, i] for i, axis in enumerate(AXES)}
    return Dataset(tuple(str(i) for i in range(len(q))), channels)


def fitted(base: Experiment, cause: Cause, dataset: Dataset) -> tuple[Problem, Estimate]:
    system = base.system
    parameters = base.parameters.with_free(free_of(cause))
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, dataset, "interpreted")
    return problem, fit(problem, IpoptEstimator(IpoptEstimator.Settings()), parameters.nominal()).estimate


def left(base: Experiment, cause: Cause, dataset: Dataset) -> ResidualStructure:
    found = structure(fit_of(*fitted(base, cause, dataset), dataset))
    assert found is not None
    return found


def graded(found: ResidualStructure, cause: Cause) -> str:
    """``wrong`` where a cause is named alone that is not the planted one; ``right``, ``open``, or ``nothing``."""
    alone = [s for s in found.worthwhile if not s.alternatives]
    if any(not any(word in s.words for word in cause.right) for s in alone):
        return "wrong"
    if alone:
        return "right"
    return "open" if found.worthwhile else "nothing"
