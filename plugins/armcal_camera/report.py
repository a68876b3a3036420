"""What the report of a run says of its cameras: what is left in the images, and where."""

from __future__ import annotations

from typing import TYPE_CHECKING, cast

import numpy as np
from armcal.base.arrays import Array
from armcal.report.document import Figure, Marks, Panel, Part, ReportSection, Table
from armcal.report.numbers import significant
from armcal.report.page import nice_step
from armcal.run.result import RunResult

if TYPE_CHECKING:  # importing it takes 0.1 s, which a run without a camera must not wait for
    from armcal_camera.camera import Camera

_PX = 1000.0
_MOST_VECTORS, _WORST = 4000, 8


def cameras(result: RunResult) -> ReportSection | None:
    described = result.system.description["measurements"]
    start, parts = 0, list[Part]()
    for name, measurement in result.system.measurements.items():
        rows = len(measurement.noise())
        if described[name]["type"] == "camera":
            own = result.errors.calibrated_residual_mm[start : start + rows]
            places, off = _residuals(result, name, cast("Camera", measurement), own)
            parts += [_over_the_sensor(name, places, off), _by_image(name, result.dataset.ids, off)]
        start += rows
    return ReportSection("Cameras", parts=parts) if parts else None


def _residuals(result: RunResult, name: str, camera: Camera, residual: Array) -> tuple[Array, Array]:
    """Where one camera saw corners, and measured minus predicted (2 x P x N each, px); NaN of those not seen."""
    shape = (len(camera.points), 2, len(result.dataset))
    seen = result.dataset.stacked([f"{name}.{channel.name}" for channel in camera.channels()])
    places, off = (rows.reshape(shape).transpose(1, 0, 2) for rows in (_PX * seen, residual))
    return places, np.where(np.isfinite(places).all(axis=0), off, np.nan)


def _by_image(name: str, images: tuple[str, ...], off: Array) -> Table:
    square, count = np.nansum(off**2, axis=(0, 1)), np.isfinite(off[0]).sum(axis=0)
    errors = np.sqrt(square / np.maximum(count, 1))
    order = [int(i) for i in np.argsort(-errors)[:_WORST] if count[i]]
    rows = [(images[i], significant(float(errors[i])), str(count[i])) for i in order]
    return Table(f"{name}: the images with the largest errors", ("Image", "rms, px", "Corners"), rows)


def _over_the_sensor(name: str, places: Array, off: Array) -> Figure:
    """All residuals of all images as lines from where the corners were seen."""
    there = np.isfinite(off).all(axis=0)
    places, off = places[:, there], off[:, there]
    step = max(1, places.shape[1] // _MOST_VECTORS)
    places, off = places[:, ::step], off[:, ::step]
    typical = float(np.median(np.linalg.norm(off, axis=0)))
    enlarged = nice_step(0.02 * float(np.ptp(places, axis=1).max()) / max(typical, 1e-9))
    caption = (
        f"Where corners were seen, all images together; lines are measured minus predicted, "
        f"{significant(enlarged, 1)} times enlarged (median {significant(typical)} px). Lines of neighbours that agree "
        "mean that the lens differs from its model; all lines of an image alike, that the arm stood elsewhere."
    )
    lines = np.stack([places, places + enlarged * off, np.full(places.shape, np.nan)], axis=2).reshape(2, -1)
    marks = [Marks("vector", lines), Marks("dot small", places)]
    panel = Panel("", marks, "u, px", "v, px", equal=True, down=True)
    return Figure(f"{name}: reprojection residuals over the sensor", caption, caption, [panel], columns=1)
