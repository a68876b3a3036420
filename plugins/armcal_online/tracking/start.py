"""From a calibration to what a recalibration starts with: problem, belief, noise to expect, what moves beside."""

from __future__ import annotations

import fnmatch
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.domains import Array, Interval
from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.config.selection import quantity
from armcal.errors import ConfigError, Location
from armcal.estimate.online import Gaussian
from armcal.measure.measurement import Measurement
from armcal.measure.partners import PairedMeasurement
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.problem.problem import Problem

from armcal_online.tracking.belief import Belief, ProcessNoise
from armcal_online.tracking.gauss_markov import GaussMarkovState, GaussMarkovStates, shared_error
from armcal_online.tracking.observer import Observer
from armcal_online.tracking.process import variance_rates
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.state_space import StateSpace

_VECTORS = ("gravity", "payload", "force", "torque")


@dataclass(frozen=True)
class FilterSetup:
    """What a recalibration stands on.

    Attributes:
        problem: compiled once.
        space: of its free parameters.
        observer: makes observations of records.
        belief: that of the calibration.
        process_noise: how beliefs fade between records.
        request: what a source should look for.
        left_out: measurements that cannot be taken one record at a time.
    """

    problem: Problem
    space: StateSpace
    observer: Observer
    belief: Belief
    process_noise: ProcessNoise
    request: ReadRequest
    left_out: tuple[str, ...]


def filter_setup(calibration: Calibration, settings: RecalibrateSettings, shares: bool) -> FilterSetup:
    """What a recalibration starts with.

    Args:
        calibration: with its covariance.
        settings: of the recalibration.
        shares: whether what neighbouring records share is followed beside the parameters; else it is noise.

    Raises:
        ConfigError: the calibration keeps no covariance, or a glob or a quantity in the settings is refused.
    """
    measurements = {n: m for n, m in calibration.system.measurements.items() if not isinstance(m, PairedMeasurement)}
    parameters, opened = _parameters(calibration, settings)
    space = StateSpace(parameters)
    problem = Problem.build(
        calibration.system.arms,
        measurements,
        parameters,
        calibration.system.environment,
        _channels(calibration, measurements),
        settings.evaluator,
        groups=calibration.record.groups,
    )
    covariance = _covariance(calibration, space, opened)
    white, gauss_markov, noisy = _errors(calibration, measurements, space, settings, shares)
    size = len(space.scales) + len(gauss_markov)
    mean, start = np.zeros(size), np.eye(size)
    mean[: len(space.scales)] = _unconstrained(calibration, space)
    start[: len(space.scales), : len(space.scales)] = covariance
    return FilterSetup(
        problem,
        space,
        _observer(calibration, problem, space, (gauss_markov, noisy), white),
        Belief(parameters.nominal(), Gaussian(mean, start)),
        ProcessNoise(variance_rates(parameters, settings.process_noise), gauss_markov),
        ReadRequest(
            calibration.system.arms,
            measurements,
            requested_channels(calibration.system.arms, measurements, measured=True),
        ),
        tuple(sorted(set(calibration.system.measurements) - set(measurements))),
    )


def _parameters(calibration: Calibration, settings: RecalibrateSettings) -> tuple[Parameters, dict[str, float]]:
    """Blocks about the calibrated values, those found then free, and the deviations of those opened now."""
    parameters = calibration.parameters
    texts = {entry.name.partition("[")[0] for entry in calibration.record.parameters if entry.free}
    opened: dict[str, float] = {}
    for glob, text in settings.free.items():
        names = fnmatch.filter(parameters.names, glob)
        if not names:
            raise ConfigError(f"no parameter is called {glob!r}.", where=Location(f"free.{glob}"))
        opened |= {n: quantity(parameters[n], text, None, ()) for n in names if n not in texts}
    beyond = {
        block.name: replace(block, domain=Interval())
        for block in parameters.blocks
        if isinstance(block.domain, Interval) and block.domain.check(np.array(block.nominal))
    }
    return parameters.replaced(beyond).with_free([n for n in parameters.names if n in texts or n in opened]), opened


def _covariance(calibration: Calibration, space: StateSpace, opened: Mapping[str, float]) -> Array:
    """Of the scaled coordinates; parameters opened now are known to nobody."""
    known = calibration.uncertainty.record
    own = known.entries
    lower = np.zeros((len(own), len(own)))
    for i, row in enumerate(known.covariance):
        lower[i, : len(row)] = row
    of_entries = lower + np.tril(lower, -1).T
    names = [space.parameters.entry_names[i] for i in space.entries]
    place = [names.index(name) for name in own]
    whole = np.zeros((len(names), len(names)))
    whole[np.ix_(place, place)] = of_entries
    covariance = space.of_entries(space.parameters.nominal(), whole)
    start = 0
    for block in space.parameters.free:
        if block.name in opened:
            at = np.arange(start, start + block.domain.dof)
            covariance[at, at] = (opened[block.name] / block.scale) ** 2
        start += block.domain.dof
    return 0.5 * (covariance + covariance.T)


def _unconstrained(calibration: Calibration, space: StateSpace) -> Array:
    """Where the calibration's records would have the coordinates if no bound held any (n)."""
    values = space.parameters.nominal()
    free = values.copy()
    for position, entry in enumerate(calibration.record.parameters):
        if entry.unconstrained is not None:
            free[position] = entry.unconstrained
    return space.between(values, free)


def _errors(
    calibration: Calibration,
    measurements: Mapping[str, Measurement],
    space: StateSpace,
    settings: RecalibrateSettings,
    shares: bool,
) -> tuple[dict[str, Array], GaussMarkovStates, GaussMarkovStates]:
    """Each measurement's own error from record to record, what moves beside the parameters, and drifts
    that count as noise."""
    kept: Mapping[str, Any] = calibration.record.noise.get("scatter") or {}
    scale = _scale(calibration)
    followed = shares and settings.model_error == "calibrated"
    gauss_markov: list[GaussMarkovState] = []
    white = {}
    for name, measurement in measurements.items():
        # Where joints are noisy the residuals scatter with the pose: their noise is carried over to each record.
        noisy = any(calibration.system.arms[arm].joint_noise for arm in measurement.arms)
        told = None if noisy else kept.get(name)
        covariance = np.diag((np.array(measurement.noise()) * scale) ** 2)
        if told is not None:
            covariance = np.array(told["covariance"])
            if followed and told["share"] > 0:
                gauss_markov += shared_error(
                    name, told["share"] * covariance, told["over"], told.get("channel", "record")
                )
                covariance = (1 - told["share"]) * covariance
        white[name] = covariance
    drifts = tuple(_drifts(calibration, space))
    if followed:
        return white, GaussMarkovStates((*drifts, *gauss_markov)), GaussMarkovStates()
    return white, GaussMarkovStates(tuple(gauss_markov)), GaussMarkovStates(drifts)


def _observer(
    calibration: Calibration,
    problem: Problem,
    space: StateSpace,
    beside: tuple[GaussMarkovStates, GaussMarkovStates],
    white: Mapping[str, Array],
) -> Observer:
    freedoms = {name: _freedom(calibration, name) for name in white}
    defaults, unfound = _defaults(calibration), _unfound(calibration)
    return Observer(problem, space, *beside, white, freedoms, defaults, unfound, _scale(calibration))


def _freedom(calibration: Calibration, name: str) -> float:
    """Degrees of freedom with which the noise of a measurement is known; all of the fit's if its own are not kept."""
    kept = (calibration.record.noise.get("scatter") or {}).get(name) or {}
    return float(kept.get("freedom") or max(calibration.record.noise["degrees_of_freedom"], 1))


def _drifts(calibration: Calibration, space: StateSpace) -> list[GaussMarkovState]:
    """The parameters that drifted in the calibration drift anew."""
    recording = calibration.uncertainty.record.recording
    if recording is None:
        return []
    place = {name: i for i, name in enumerate(space.names)}
    return [
        GaussMarkovState(f"drift of {name}", d.over, d.channel, place[name], d.sd / float(space.scales[place[name]]))
        for name, d in recording.drifts.items()
    ]


def _unfound(calibration: Calibration) -> set[str]:
    """Parameters of groups that are not known and that no record of the calibration told of."""
    texts = {entry.name.partition("[")[0] for entry in calibration.record.parameters if entry.free}
    return {block.name for block in calibration.parameters.nuisances if block.free} - texts


def _scale(calibration: Calibration) -> float:
    """Of the residuals against the noise that was stated."""
    return float(calibration.record.noise.get("scale") or 1.0)


def _channels(calibration: Calibration, measurements: Mapping[str, Measurement]) -> Dataset:
    """A record with everything that one may carry: functions are compiled for it."""
    arms = calibration.system.arms
    names = [w.channel for w in requested_channels(arms, measurements, measured=True) if "." in w.channel]
    names += [f"gravity_{axis}" for axis in "xyz"] + ["payload"]
    names += [name for name in calibration.record.environment_columns if name not in names]
    names += [name for arm in arms.values() for name in arm.conditions if name not in names]
    return Dataset(("",), {name: np.ones(1) for name in dict.fromkeys(names)})


def _defaults(calibration: Calibration) -> dict[str, float]:
    """What holds where a record does not say."""
    environment = calibration.system.environment
    vectors = (environment.gravity, environment.payload_com, environment.force, environment.torque)
    found = {
        f"{name}_{axis}": float(value)
        for name, vector in zip(_VECTORS, vectors, strict=True)
        for axis, value in zip("xyz", vector, strict=True)
    }
    approaches = {
        f"{arm.name}.approach.{joint}": 0.0 for arm in calibration.system.arms.values() for joint in arm.commanded
    }
    return {**found, **approaches, "payload": environment.payload_mass}
