"""What the report of a run says of its cameras: how well they are placed, what is left in the images, and where."""

from __future__ import annotations

from html import escape

import numpy as np
from armcal.report import svg
from armcal.report.numbers import significant
from armcal.report.sections import ReportSection
from armcal.report.svg import Axis, Box, Figure
from armcal.run.result import RunResult

from armcal_camera.camera import Camera
from armcal_camera.image_figures import drawn_images
from armcal_camera.residuals import CameraResiduals, residuals_of

_MOST_VECTORS, _WORST, _MOST_BYTES = 4000, 8, 200_000


def cameras(result: RunResult) -> ReportSection | None:
    """Reprojection residuals over the sensor and by image, of every camera of the run."""
    start, parts, count = 0, list[str](), sum(isinstance(m, Camera) for m in result.system.measurements.values())
    for name, measurement in result.system.measurements.items():
        rows = len(measurement.noise())
        if isinstance(measurement, Camera):
            own = result.errors.calibrated_residual_mm[start : start + rows]
            parts += _of_camera(residuals_of(result, name, measurement, own), _MOST_BYTES // count)
        start += rows
    return ReportSection("Cameras", "".join(parts)) if parts else None


def _of_camera(residuals: CameraResiduals, most_bytes: int) -> list[str]:
    figure, errors = _over_the_sensor(residuals), residuals.by_image
    order = [int(i) for i in np.argsort(-np.nan_to_num(errors))[:_WORST]]
    rows = "".join(
        f"<tr><td>{escape(residuals.images[i])}</td><td>{significant(float(errors[i]))}</td>"
        f"<td>{int(np.isfinite(residuals.off[0, :, i]).sum())}</td></tr>"
        for i in order
    )
    table = (
        f"<table><thead><tr><th>image</th><th>rms, px</th><th>corners</th></tr></thead><tbody>{rows}</tbody></table>"
    )
    heading = f"<h3>{escape(residuals.name)}</h3>"
    over = f"<figure>{figure.wide}<figcaption>{escape(figure.caption)}</figcaption></figure>"
    return [heading, over, table, drawn_images(residuals, most_bytes)]


def _over_the_sensor(residuals: CameraResiduals) -> Figure:
    """All residuals of all images as lines from where the corners were seen."""
    there = np.isfinite(residuals.off).all(axis=0)
    places, off = residuals.seen[:, there], residuals.off[:, there]
    step = max(1, places.shape[1] // _MOST_VECTORS)
    places, off = places[:, ::step], off[:, ::step]
    low, high = places.min(axis=1), places.max(axis=1)
    typical = float(np.median(np.linalg.norm(off, axis=0)))
    enlarged = svg.nice_step(0.02 * float(max(high - low)) / max(typical, 1e-9))
    caption = (
        f"Where corners were seen, all images together; lines are measured minus predicted, "
        f"{significant(enlarged, 1)} times enlarged (median {significant(typical)} px). Lines of neighbours that agree "
        "mean that the lens differs from its model; all lines of an image alike, that the arm stood elsewhere."
    )

    def draw(width: float) -> tuple[float, list[str]]:
        box = Box(58, 12, width - 16, 12 + (width - 74) * float((high - low)[1] / (high - low)[0]))
        x, y = Axis(low[0], high[0], box.left, box.right), Axis(low[1], high[1], box.top, box.bottom)
        tips = places + enlarged * off
        parts = svg.frame(box, x, y, ("u, px", "v, px"), (6, 5))
        parts.append(svg.segments(x.at(places[0]), y.at(places[1]), x.at(tips[0]), y.at(tips[1]), "vector"))
        return box.bottom + 48, [*parts, svg.dots(x.at(places[0]), y.at(places[1]), "dot small")]

    title = "Reprojection residuals over the sensor"
    return svg.both(f"camera-{residuals.name}", (title, caption, caption), draw)
