"""The report's section of cameras."""

from __future__ import annotations

import sys
from types import SimpleNamespace
from typing import Any

import pytest
from armcal_camera.export import cameras


def test_a_run_without_a_camera_imports_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "armcal_camera.camera", None)  # importing it fails
    measurements = {"tip": SimpleNamespace(noise=lambda: (1e-4,) * 3)}
    system = SimpleNamespace(measurements=measurements, description={"measurements": {"tip": {"type": "tip_position"}}})
    result: Any = SimpleNamespace(system=system)
    assert cameras(result) is None
