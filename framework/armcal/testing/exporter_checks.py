"""Checks on exporters."""

from __future__ import annotations

from pathlib import PurePath
from typing import Any

import numpy as np

from armcal.calibration.exporter import Exported, ExportRequest
from armcal.errors import InputError
from armcal.testing.planar import ARM, planar_arms
from armcal.testing.results import ContractError, NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject


def check_exporter(record: Recorder, subject: Subject) -> None:
    """That it writes an arm that it did not make, or refuses it as a user's fault."""
    exporter: Any = record.check("it builds", subject.build)
    if exporter is None:
        return
    written = record.check("an arm is written, or refused by an armcal error", lambda: _written(exporter, _request()))
    record.check("it writes the same each time", _same, subject, exporter, written)
    record.check("it changes nothing that it is given", _untouched, exporter)


def _request() -> ExportRequest:
    arm = planar_arms([ARM])[ARM]
    return ExportRequest(ARM, arm, {block.name: np.array(block.nominal) for block in arm.parameters()})


def _written(exporter: Any, request: ExportRequest) -> Exported | str:
    """What it writes, or why it refuses."""
    try:
        exported = exporter.export(request)
    except InputError as refusal:
        return str(refusal)
    except Exception as fault:
        raise ContractError(f"found {type(fault).__name__} ({fault}), expected armcal.errors.InputError") from fault
    expect(
        isinstance(exported, Exported),
        f"found {type(exported).__name__}, expected armcal.calibration.exporter.Exported",
    )
    for name, content in {"content": exported.content, **exported.companions}.items():
        expect(isinstance(content, bytes), f"found {name} of type {type(content).__name__}, expected bytes")
    for name in exported.companions:
        plain = name == PurePath(name).name and name not in ("", ".", "..") and "\\" not in name
        expect(plain, f"found the companion {name!r}, expected the plain name of a file")
    result: Exported = exported
    return result


def _same(subject: Subject, exporter: Any, first: Exported | str | None) -> None:
    if first is None:
        raise NotRun("it does not write the planar arm")
    for other in (exporter, subject.made(subject.settings)):
        expect(_written(other, _request()) == first, "found other content, or another refusal, the second time")


def _untouched(exporter: Any) -> None:
    request = _request()
    _written(exporter, request)
    kept = all(np.array_equal(value, _request().values[name]) for name, value in request.values.items())
    expect(kept and set(request.values) == set(_request().values), "it changed the values that it was given")
