"""Single images in the report: a small copy with marks where corners were seen and predicted, in one file."""

from __future__ import annotations

import base64
import re
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from armcal_camera.report import CameraResiduals, cameras, drawn_images

PIXELS = np.array([[100.0, 300, 500], [80, 200, 320]])


def residuals(files: tuple[str, ...] = (), error: float = 1.0) -> CameraResiduals:
    """Five images of three corners, the third without any; the fifth misses by most."""
    seen = np.repeat(PIXELS[:, :, None], 5, axis=2)
    off = error * np.array([1.0, 2, np.nan, 3, 9]) * np.ones((2, 3, 1))
    return CameraResiduals("camera", ("a", "b", "c", "d", "<e>"), seen, off, (640.0, 480.0), files)


def test_the_worst_and_a_typical_image_are_copied_small(tmp_path: Path) -> None:
    cv2 = pytest.importorskip("cv2", reason="OpenCV is not installed: pip install 'armcal[camera]'")
    paths = [str(tmp_path / f"{i}.png") for i in range(5)]
    for path in paths[:4]:  # the worst is no longer there
        cv2.imwrite(path, np.random.default_rng(1).integers(0, 255, (960, 1280), np.uint8))
    html = drawn_images(residuals(tuple(paths)), 200_000)
    copies = re.findall(r"data:image/jpeg;base64,([^\"]*)", html)
    assert len(copies) == 2 and sum(map(len, copies)) < 200_000
    assert cv2.imdecode(np.frombuffer(base64.b64decode(copies[0]), np.uint8), 0).shape == (360, 480)
    words = re.findall(r"<figcaption>(.*?)</figcaption>", html)
    assert words[0] == "&lt;e&gt; (worst): 12.7 px rms, 3 corners" and len(words) == 3
    assert not drawn_images(residuals(tuple(paths)), 100).count("base64")


def test_arrows_run_from_predicted_through_seen_20_times_as_long() -> None:
    html = drawn_images(residuals(error=0.5), 1)
    assert "(20 times as long)" in html and "<image" not in html
    segment = re.search(r'd="M([\d.]+) ([\d.]+)L([\d.]+) ([\d.]+)', html)
    assert segment is not None
    scale, (x, _, tip, _) = 504 / 640, map(float, segment.groups())
    assert x == pytest.approx(scale * (100 - 4.5 + 0.5), abs=0.06)
    assert tip - x == pytest.approx(20 * scale * 4.5, abs=0.11)


def test_errors_that_would_not_be_seen_are_drawn_longer() -> None:
    html = drawn_images(residuals(error=0.01), 1)
    assert "(500 times as long)" in html


def test_a_camera_that_saw_nothing_has_no_images() -> None:
    assert not drawn_images(residuals(error=np.nan), 1)


def test_a_run_without_a_camera_imports_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "armcal_camera.camera", None)  # importing it fails
    measurements = {"tip": SimpleNamespace(noise=lambda: (1e-4,) * 3)}
    system = SimpleNamespace(measurements=measurements, description={"measurements": {"tip": {"type": "tip_position"}}})
    result: Any = SimpleNamespace(system=system)
    assert cameras(result) is None
