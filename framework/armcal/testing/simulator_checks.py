"""Checks on simulators."""

from collections.abc import Mapping

import numpy as np

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
    with record.needed("it builds"):
        simulator: Simulator = subject.build()
    with record.check("it simulates"):
        method = getattr(simulator, "simulate", None)
        expect(callable(method), f"found simulate = {method!r}, expected a method")
    with record.check("it gives what every instrument reads, the same each time"):
        request, first = _suited(simulator)
        for requested in requested_channels(request.arms, request.measurements, measured=True):
            given = first.has(requested.channel) or not requested.required
            expect(given, f"found no {requested.channel} in the records, expected every required channel")
        _expect_same(first, simulator.simulate(request), "the second time")
        _expect_same(first, subject.build().simulate(request), "from a second simulator of equal settings")


def _suited(simulator: Simulator) -> tuple[SimulationRequest, Dataset]:
    """What a simulator's EXAMPLE suits, an instrument or a contact, and its records of it."""
    arms, refused = planar_arms([ARM]), []
    choices: tuple[Mapping[str, Measurement], ...] = ({TRACKER: Tip()}, {WALLS: Walls()})
    for measurements in choices:
        request = SimulationRequest(arms, measurements, all_parameters(arms), GRAVITY)
        try:
            return request, simulator.simulate(request)
        except InputError as fault:
            refused.append(str(fault))
    raise NotRun(f"its EXAMPLE does not suit the arm of the check: {'; '.join(refused)}")


def _expect_same(first: Dataset, again: Dataset, when: str) -> None:
    expect(first.ids == again.ids, f"found other record ids {when}")
    expect(set(first.channels) == set(again.channels), f"found other channels {when}")
    for name, values in first.channels.items():
        expect(bool(np.isfinite(values).all()), f"found numbers in {name} that are not finite")
        expect(bool(np.array_equal(values, again.channels[name])), f"found other numbers in {name} {when}")
