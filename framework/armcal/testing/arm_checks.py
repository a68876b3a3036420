"""Checks on what is given whole arms: simulators and exporters."""

from collections.abc import Mapping
from pathlib import PurePath
from typing import Any

import numpy as np

from armcal.base.dataset import Dataset
from armcal.calibration.exporter import Exported, ExportRequest
from armcal.errors import InputError
from armcal.estimate.simulation import SimulationRequest, Simulator
from armcal.measure.measurement import Measurement
from armcal.measure.reader import requested_channels
from armcal.testing.planar import ARM, GRAVITY, TRACKER, WALLS, Tip, Walls, all_parameters, planar_arms
from armcal.testing.results import ContractError, NotRun, Recorder, expect, raises_only
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


def check_exporter(record: Recorder, subject: Subject) -> None:
    """That it writes an arm that it did not make, or refuses it as a user's fault."""
    with record.needed("it builds"):
        exporter = subject.build()
    with record.needed("an arm is written, or refused by an armcal error"):
        first = _written(exporter, _request())
    with record.check("it writes the same each time"):
        for other in (exporter, subject.build()):
            expect(_written(other, _request()) == first, "found other content, or another refusal, the second time")
    with record.check("it changes nothing that it is given"):
        request, values = _request(), _request().values
        _written(exporter, request)
        kept = all(np.array_equal(value, values[name]) for name, value in request.values.items())
        expect(kept and set(request.values) == set(values), "it changed the values that it was given")


def _request() -> ExportRequest:
    arm = planar_arms([ARM])[ARM]
    return ExportRequest(ARM, arm, {block.name: np.array(block.nominal) for block in arm.parameters()})


def _written(exporter: Any, request: ExportRequest) -> Exported | str:
    """What it writes, or why it refuses."""
    try:
        with raises_only(InputError):
            exported = exporter.export(request)
    except InputError as refusal:
        return str(refusal)
    if not isinstance(exported, Exported):
        raise ContractError(f"found {type(exported).__name__}, expected armcal.calibration.exporter.Exported")
    for name, content in {"content": exported.content, **exported.companions}.items():
        expect(isinstance(content, bytes), f"found {name} of type {type(content).__name__}, expected bytes")
    for name in exported.companions:
        plain = name == PurePath(name).name and name not in ("", ".", "..") and "\\" not in name
        expect(plain, f"found the companion {name!r}, expected the plain name of a file")
    return exported
