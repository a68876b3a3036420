"""Checks on simulators."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.errors import InputError
from armcal.estimate.simulation import SimulationRequest, Simulator
from armcal.measure.measurement import Measurement
from armcal.measure.reader import requested_channels
from armcal.testing.planar import ARM, GRAVITY, TRACKER, WALLS, Tip, Walls, all_parameters, planar_arms
from armcal.testing.results import NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject


def check_simulator(record: Recorder, subject: Subject) -> None:
    """That the same request gives the same records."""
    simulator: Any = record.check("it builds", subject.build)
    if simulator is None:
        return
    method = getattr(simulator, "simulate", None)
    record.check("it simulates", expect, callable(method), f"found simulate = {method!r}, expected a method")
    name = "it gives what every instrument reads, the same each time"
    record.check(name, _repeats, subject, simulator)


def _repeats(subject: Subject, simulator: Simulator) -> None:
    arms = planar_arms([ARM])
    request, first = _suited(simulator, arms, ({TRACKER: Tip()}, {WALLS: Walls()}))
    measurements = request.measurements
    for requested in requested_channels(arms, measurements, measured=True):
        expect(
            first.has(requested.channel) or not requested.required,
            f"found no {requested.channel} in the records, expected every required channel",
        )
    _same(first, simulator.simulate(request), "the second time")
    _same(first, subject.made(subject.settings).simulate(request), "from a second simulator of equal settings")


def _suited(
    simulator: Simulator, arms: Mapping[str, Arm], choices: Sequence[Mapping[str, Measurement]]
) -> tuple[SimulationRequest, Dataset]:
    """The first of some measurements that a simulator's EXAMPLE suits, an instrument or a contact, and its records."""
    refused = []
    for measurements in choices:
        request = SimulationRequest(arms, measurements, all_parameters(arms), GRAVITY)
        try:
            return request, simulator.simulate(request)
        except InputError as fault:
            refused.append(str(fault))
    raise NotRun(f"its EXAMPLE does not suit the arm of the check: {'; '.join(refused)}")


def _same(first: Dataset, again: Dataset, when: str) -> None:
    expect(first.ids == again.ids, f"found other record ids {when}")
    expect(set(first.channels) == set(again.channels), f"found other channels {when}")
    for name, values in first.channels.items():
        expect(bool(np.isfinite(values).all()), f"found numbers in {name} that are not finite")
        expect(bool(np.array_equal(values, again.channels[name])), f"found other numbers in {name} {when}")
