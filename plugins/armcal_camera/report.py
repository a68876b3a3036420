"""What the report of a run says of its cameras: what is left in the images, and where."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, cast

import numpy as np
from armcal.base.arrays import Array
from armcal.report.document import Figure, Marks, Panel, Part, ReportSection, Table
from armcal.report.numbers import significant
from armcal.report.plot import nice_step
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
            residuals = residuals_of(result, name, cast("Camera", measurement), own)
            parts += [_over_the_sensor(residuals), _by_image(residuals)]
        start += rows
    return ReportSection("Cameras", parts=parts) if parts else None


def _by_image(residuals: CameraResiduals) -> Table:
    errors, seen = residuals.by_image, np.isfinite(residuals.off[0]).sum(axis=0)
    order = [int(i) for i in np.argsort(-np.nan_to_num(errors))[:_WORST]]
    rows = [(residuals.images[i], significant(float(errors[i])), str(seen[i])) for i in order]
    return Table(f"{residuals.name}: the images with the largest errors", ("Image", "rms, px", "Corners"), rows)


def _over_the_sensor(residuals: CameraResiduals) -> Figure:
    """All residuals of all images as lines from where the corners were seen."""
    there = np.isfinite(residuals.off).all(axis=0)
    places, off = residuals.seen[:, there], residuals.off[:, there]
    step = max(1, places.shape[1] // _MOST_VECTORS)
    places, off = places[:, ::step], off[:, ::step]
    typical = float(np.median(np.linalg.norm(off, axis=0)))
    enlarged = nice_step(0.02 * float(np.ptp(places, axis=1).max()) / max(typical, 1e-9))
    caption = (
        f"Where corners were seen, all images together; lines are measured minus predicted, "
        f"{significant(enlarged, 1)} times enlarged (median {significant(typical)} px). Lines of neighbours that agree "
        "mean that the lens differs from its model; all lines of an image alike, that the arm stood elsewhere."
    )
    marks = [Marks("vector", _lines(places, places + enlarged * off)), Marks("dot small", places)]
    panel = Panel("", marks, "u, px", "v, px", equal=True, down=True)
    return Figure(f"{residuals.name}: reprojection residuals over the sensor", caption, caption, [panel], columns=1)


def _lines(starts: Array, ends: Array) -> Array:
    """Lines between places (2 x N each), as one that breaks (2 x 3N)."""
    return np.stack([starts, ends, np.full(starts.shape, np.nan)], axis=2).reshape(2, -1)


@dataclass(frozen=True)
class CameraResiduals:
    """Of one camera what it saw, and how far that is from what was predicted."""

    name: str  # of the measurement
    images: tuple[str, ...]  # what each record is called
    seen: Array  # where corners were seen (2 x P x N, px)
    off: Array  # measured minus predicted (2 x P x N, px; NaN if unseen)

    @property
    def by_image(self) -> Array:
        """Root mean square of the distances (N, px); NaN where nothing was seen."""
        square, count = np.nansum(self.off**2, axis=(0, 1)), np.isfinite(self.off[0]).sum(axis=0)
        return np.asarray(np.sqrt(np.where(count > 0, square, np.nan) / np.maximum(count, 1)))


def residuals_of(result: RunResult, name: str, camera: Camera, residual: Array) -> CameraResiduals:
    """The rows of one camera (px), those of corners that were not seen left out."""
    shape = (len(camera.points), 2, len(result.dataset))
    seen = result.dataset.stacked([f"{name}.{channel.name}" for channel in camera.channels()])
    places, off = (rows.reshape(shape).transpose(1, 0, 2) for rows in (_PX * seen, residual))
    off = np.where(np.isfinite(places).all(axis=0), off, np.nan)
    return CameraResiduals(name, result.dataset.ids, places, off)
