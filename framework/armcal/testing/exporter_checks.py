"""Checks on exporters."""

from pathlib import PurePath
from typing import Any

import numpy as np

from armcal.calibration.exporter import Exported, ExportRequest
from armcal.errors import InputError
from armcal.testing.planar import ARM, planar_arms
from armcal.testing.results import ContractError, Recorder, expect, raises_only
from armcal.testing.settings_checks import Subject


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
