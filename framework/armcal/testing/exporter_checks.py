"""Checks on exporters."""

from __future__ import annotations

from typing import Any

import numpy as np

from armcal.errors import InputError
from armcal.testing.planar import ARM, planar_arms
from armcal.testing.results import ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject
from armcal.use.exporter import Exported, ExportRequest


def check_exporter(record: Recorder, subject: Subject) -> None:
    """That it writes an arm that it did not make, or refuses it as a user's fault."""
    exporter: Any = record.check("it builds", lambda: subject.made(subject.settings))
    if exporter is None:
        return
    record.check(
        "a planar arm is written, the same each time, or refused by an armcal error", lambda: _writes(exporter)
    )


def _writes(exporter: Any) -> None:
    arm = planar_arms([ARM])[ARM]
    request = ExportRequest(ARM, arm, {block.name: np.array(block.nominal) for block in arm.parameters()})
    try:
        found = [exporter.export(request) for _ in range(2)]
    except InputError:
        return
    except Exception as fault:
        raise ContractError(f"found {type(fault).__name__} ({fault}), expected armcal.errors.InputError") from fault
    for each in found:
        expect(isinstance(each, Exported), f"found {type(each).__name__}, expected armcal.use.exporter.Exported")
        expect(isinstance(each.content, bytes), f"found content of type {type(each.content).__name__}, expected bytes")
    expect(found[0] == found[1], "found other content the second time")
