"""A simulated six-joint arm for recalibrations: 35 parameters, a calibration of it, its truth, and its records.

The truth is drawn from the calibration's own covariance and wanders as the settings say, so that a consistent
estimator has to show chi-square distributed errors and innovations.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.config_text import plain
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.estimate.online import OnlineEstimator, Update
from armcal.plugins import discover
from armcal.problem.problem import Problem
from armcal_online.belief import Belief, RecordObservation
from armcal_online.recalibrator import Recalibrator
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Incoming
from armcal_online.state import FilterSetup, filter_setup
from made_calibrations import made_record

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "lrm_arm" / "arm.yaml"
NOISE_M = 0.0003
REACH = np.radians([100.0, 50.0, 100.0, 100.0, 100.0, 50.0])
JOINTS = tuple(f"arm.q{i}" for i in range(1, 7))
AXES = tuple(f"tracker.{axis}" for axis in "xyz")
STATES = 35
EVERY_S = 900.0
"""Between two records."""

_MDH = ("alpha1", "a1", "d1", "a2", "d2", "base_rx", "base_ry", "after2_z", "base_x", "base_y", "base_z")
_ROWS = ("alpha2", "alpha3", "alpha4", "alpha5", "a3", "a4", "a5", "d4", "d5", "tool_y", "tool_z")
FREE = (
    *(f"arm.mdh.{name}" for name in (*_MDH, *_ROWS)),
    *(f"arm.mdh.theta{i}" for i in range(1, 7)),
    *(f"arm.spring.k{i}" for i in range(7)),
)
AWAY = {"base_x": "after4_z", "base_y": "d6", "base_z": "a6"}
"""What is free instead of the base where that is held, so that a constant shift of all readings is no parameter's."""
_COMPLIANCE = 0.06
_SD = {"m": 0.001, "rad": 0.01, "rad_per_Nm": 0.008}
_BENCH_POSES = 15


def random_poses(random: np.random.Generator, count: int) -> np.ndarray:
    """Joint angles (count x 6; rad)."""
    return random.uniform(-1, 1, (count, 6)) * REACH


def free_names(held_base: bool) -> tuple[str, ...]:
    """The 35 parameters."""
    return tuple(
        f"arm.mdh.{AWAY[n]}" if held_base and (n := name.rpartition(".")[2]) in AWAY else name for name in FREE
    )


@cache
def calibration(
    noise_mm: float = 0.3,
    sd_factor: float = 1.0,
    held_base: bool = False,
    compliance: float = _COMPLIANCE,
    placement: tuple[str, ...] = (),
) -> Calibration:
    """Of a few bench poses and what was known before; ``sd_factor`` makes it claim more or less than it knows.

    ``placement`` (``position_mm=[300, 0, 0]``) says where the arm stands in the frame that the instrument measures in.
    """
    placed = [f"arms.arm.placement.{each}" for each in placement]
    source = load_config(CONFIG, [f"measurements.tracker.noise_mm={noise_mm}", *placed])
    system = build_system(source, discover())
    parameters = system.parameters({}).with_free(free_names(held_base))
    values = parameters.nominal()
    values[[parameters.entries_of(f"arm.spring.k{i}").start for i in range(7)]] = compliance
    covariance = _prior(system, parameters.with_nominal(values)) * sd_factor**2
    names = [parameters.entry_names[i] for i in parameters.free_entries]
    known = dict(zip(names, np.sqrt(np.diag(covariance)), strict=True))
    units = [unit for block in parameters.blocks for unit in block.entry_units]
    entries = [
        {"name": name, "unit": unit, "nominal": value, "value": value, "free": name in known, "sd": known.get(name)}
        for name, unit, value in zip(parameters.entry_names, units, values.tolist(), strict=True)
    ]
    description = {key: plain(source.data[key]) for key in ("arms", "measurements", "statics")}
    told = {"entries": names, "covariance": [row[: i + 1].tolist() for i, row in enumerate(covariance)]}
    record = made_record(description, entries, parameters.coordinate_names, prediction=told)
    return Calibration(system, system.parameters({}).with_nominal(values), record)


def _prior(system, parameters) -> np.ndarray:
    """Covariance (35 x 35, SI) of what a few poses and ordinary knowledge tell."""
    q = random_poses(np.random.default_rng(7), _BENCH_POSES)
    channels = {name: q[:, i] for i, name in enumerate(JOINTS)} | {name: np.zeros(len(q)) for name in AXES}
    bench = Dataset(tuple(map(str, range(len(q)))), channels)
    problem = Problem.build(system.arms, system.measurements, parameters, system.environment, bench, "interpreted")
    (jacobian,) = problem.of(bench).jacobians(parameters.nominal())
    slopes = np.moveaxis(jacobian, 2, 0)[: len(q)].reshape(-1, STATES)
    known = np.array([_SD[block.unit] for block in parameters.free])
    seen = slopes * known  # in units of the noise already
    covariance = np.linalg.inv(np.eye(STATES) + seen.T @ seen) * np.outer(known, known)
    return 0.5 * (covariance + covariance.T)


def random_walk(factor: float = 1.0, held_base: bool = False) -> dict[str, str]:
    """The random walk made faster by a factor; none for zero."""
    amounts = {} if factor == 0 else {"arm.mdh.theta[1-6]": f"{0.3 * factor} deg in 30 d"}
    return amounts if held_base or factor == 0 else {**amounts, "arm.mdh.base_[xyz]": f"{1.0 * factor} mm in 30 d"}


def settings(**changed) -> RecalibrateSettings:
    """Of a recalibration that walks as the truth does."""
    return RecalibrateSettings.model_validate({"process_noise": random_walk(), **changed})


@cache
def begun_setup(
    noise_mm: float = 0.3,
    sd_factor: float = 1.0,
    held_base: bool = False,
    walk: float = 1.0,
    evaluator: str = "compiled",
) -> FilterSetup:
    """What a filter of the arm stands on; the observer's buffers are shared."""
    given = settings(evaluator=evaluator, process_noise=random_walk(walk, held_base))
    return filter_setup(calibration(noise_mm, sd_factor, held_base), given)


@dataclass
class World:
    """The arm as it is.

    Attributes:
        setup: for its predictions, chart and random walk.
        random: for all chance.
        values: true ones; a test may change them.
        now: s.
        bias: of what the instrument reads (3; m).
        turn: of the frame that it reads in (3 x 3).
        outliers: share of records with an error of ``outlier`` (standard deviation of a coordinate; m).
        wanders: whether the truth walks.
    """

    setup: FilterSetup
    random: np.random.Generator
    values: np.ndarray
    now: float = 1e9
    bias: np.ndarray = field(default_factory=lambda: np.zeros(3))
    turn: np.ndarray = field(default_factory=lambda: np.eye(3))
    outliers: float = 0.0
    outlier: float = 0.03
    wanders: bool = True
    count: int = 0
    was_outlier: bool = False

    @classmethod
    def drawn(cls, seed: int, setup: FilterSetup | None = None, **given) -> World:
        """A truth drawn from the calibration's covariance."""
        setup, random = setup or begun_setup(), np.random.default_rng(seed)
        root = np.linalg.cholesky(setup.belief.gaussian.covariance)
        values = setup.space.moved(setup.belief.origin, root @ random.normal(size=STATES))
        return cls(setup, random, setup.space.inside(values), **given)

    def step(self, seconds: float = EVERY_S) -> None:
        """Time passes."""
        self.now += seconds
        if self.wanders:
            moved = np.sqrt(self.setup.process_noise.rates * seconds) * self.random.normal(size=STATES)
            self.values = self.setup.space.moved(self.values, moved)

    def tip(self, q: np.ndarray) -> np.ndarray:
        """Where the target is (3; m)."""
        return predicted(self.setup, self.values, q)

    def measured(self, q: np.ndarray | None = None) -> dict[str, float]:
        """The channels of a record at joint angles (6; rad), at random ones if none are given."""
        q = random_poses(self.random, 1)[0] if q is None else q
        read = self.turn @ self.tip(q) + self.bias + NOISE_M * self.random.normal(size=3)
        self.was_outlier = bool(self.random.uniform() < self.outliers)
        if self.was_outlier:
            read = read + self.outlier * self.random.normal(size=3)
        joints = dict(zip(JOINTS, q.tolist(), strict=True))
        return {**joints, **dict(zip(AXES, read.tolist(), strict=True)), "time": self.now}

    def record(self, q: np.ndarray | None = None, seconds: float = EVERY_S) -> Incoming:
        """The next record."""
        self.step(seconds)
        self.count += 1
        return Incoming(f"p{self.count}", self.measured(q), {}, self.now, "list", self.count)

    def moved(self, name: str, by: float) -> None:
        """Change a true parameter."""
        values = self.values.copy()
        values[self.setup.space.parameters.entries_of(name)] += by
        self.values = values


def predicted(setup: FilterSetup, values: np.ndarray, q: np.ndarray) -> np.ndarray:
    """Where the target is at joint angles (6; rad), by a value vector (3; m)."""
    (reading,) = setup.observer.readings(dict(zip(JOINTS, q.tolist(), strict=True)) | dict.fromkeys(AXES, 0.0), {})
    return -setup.observer.linearise(values, reading)[0]


PROBES = random_poses(np.random.default_rng(99), 25)


def tip_error_mm(setup: FilterSetup, values: np.ndarray, truth: np.ndarray) -> float:
    """Mean distance over probing poses between two value vectors' tips."""
    inside = setup.space.inside(values)
    far = [np.linalg.norm(predicted(setup, inside, q) - predicted(setup, truth, q)) for q in PROBES]
    return float(1000 * np.mean(far))


def nees(setup: FilterSetup, belief: Belief, truth: np.ndarray) -> float:
    """Squared Mahalanobis distance of the truth, chi-square with 35 degrees of freedom."""
    off = setup.space.between(belief.values(setup.space), truth)
    return float(off @ np.linalg.solve(belief.gaussian.covariance[:STATES, :STATES], off))


@dataclass
class Filtered:
    """An estimator on its own: no gate, no judgement."""

    setup: FilterSetup
    estimator: OnlineEstimator
    belief: Belief

    @classmethod
    def fresh(cls, estimator: OnlineEstimator, setup: FilterSetup) -> Filtered:
        """At the calibration."""
        return cls(setup, estimator, setup.belief)

    def seen(self, belief: Belief, channels: Mapping[str, float]) -> RecordObservation:
        """A record as a belief looks at it."""
        readings = self.setup.observer.readings(channels, {})
        return self.setup.observer.observation(belief, readings)

    def take(self, channels: Mapping[str, float], seconds: float = EVERY_S) -> Update:
        """One record."""
        before = self.setup.process_noise.faded(self.belief, {"time": seconds})
        update = self.estimator.update(before.gaussian, self.seen(before, channels))
        self.belief = before.updated(self.setup.space, update.posterior)
        return update


def begun(given: RecalibrateSettings | None = None, **of) -> Recalibrator:
    """A recalibrator of the arm; ``of`` is for ``calibration``."""
    return Recalibrator(calibration(**of), given or settings())


def told(events: Iterable[Mapping[str, Any]], kind: str) -> list[Mapping[str, Any]]:
    """Those events of a kind."""
    return [event for event in events if event["event"] == kind]
