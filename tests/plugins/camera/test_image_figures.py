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
from armcal.report.document import Document, Figure
from armcal.report.page import page
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
    (figure,) = drawn_images(residuals(tuple(paths)), 200_000)
    assert isinstance(figure, Figure)
    copies = [panel.backdrop.partition("base64,")[2] for panel in figure.panels if panel.backdrop]
    assert len(copies) == 2 and sum(map(len, copies)) < 200_000
    assert cv2.imdecode(np.frombuffer(base64.b64decode(copies[0]), np.uint8), 0).shape == (360, 480)
    assert figure.panels[0].title == "<e> (worst): 12.7 px rms, 3 corners" and len(figure.panels) == 3
    assert figure.panels[1].size == (1280, 960) and copies[0] in page(Document("", "", [], picture=figure))
    (bare,) = drawn_images(residuals(tuple(paths)), 100)
    assert isinstance(bare, Figure) and not any(panel.backdrop for panel in bare.panels)


def test_arrows_run_from_predicted_through_seen_20_times_as_long() -> None:
    (figure,) = drawn_images(residuals(error=0.5), 1)
    assert isinstance(figure, Figure) and "20 times as long" in figure.caption
    arrow = figure.panels[0].marks[0]
    assert arrow.xy[0][:2].tolist() == pytest.approx([100 - 4.5 + 0.5, 100 - 4.5 + 0.5 + 20 * 4.5])
    drawn = page(Document("", "", [], picture=figure))
    segment = re.search(r'class="arrow" d="M([\d.]+) [\d.]+L([\d.]+) ', drawn.partition('viewBox="0 0 400')[2])
    assert segment is not None and "<image" not in drawn
    assert float(segment[1]) == pytest.approx(400 / 640 * 96, abs=0.06)


def test_errors_that_would_not_be_seen_are_drawn_longer() -> None:
    (figure,) = drawn_images(residuals(error=0.01), 1)
    assert isinstance(figure, Figure) and "500 times as long" in figure.caption


def test_a_camera_that_saw_nothing_has_no_images() -> None:
    assert not drawn_images(residuals(error=np.nan), 1)


def test_a_run_without_a_camera_imports_none(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "armcal_camera.camera", None)  # importing it fails
    measurements = {"tip": SimpleNamespace(noise=lambda: (1e-4,) * 3)}
    system = SimpleNamespace(measurements=measurements, description={"measurements": {"tip": {"type": "tip_position"}}})
    result: Any = SimpleNamespace(system=system)
    assert cameras(result) is None
