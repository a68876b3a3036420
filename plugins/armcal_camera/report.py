"""What the report of a run says of its cameras: how well they are placed, what is left in the images, and where."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import ArmcalError
from armcal.io.plain_files import input_bytes
from armcal.report import svg
from armcal.report.numbers import significant
from armcal.report.sections import ReportSection
from armcal.report.svg import Axis, Box, Figure
from armcal.run.result import RunResult

from armcal_camera.images import MOST_BYTES, grey_image, opencv

if TYPE_CHECKING:  # importing it takes 0.1 s, which a run without a camera must not wait for
    from armcal_camera.camera import Camera

_PX = 1000.0
_MOST_VECTORS, _WORST, _MOST_BYTES = 4000, 8, 200_000
_DRAWN, _ENLARGED = 3, 20.0
_SHORTEST, _LONGEST = 0.004, 0.06  # Of the width of an image: arrows of typical length that can be seen, and told apart
_WIDTH_PX, _QUALITIES = 480, (70, 45, 25, 10)
_COLOURS = {"seen": "#ffd400", "predicted": "#00c2ff", "arrow": "#ff4fa3"}
_CROSS = "m-3 0h6m-3-3v6"


def cameras(result: RunResult) -> ReportSection | None:
    described = result.system.description["measurements"]
    start, parts, count = 0, list[str](), sum(section["type"] == "camera" for section in described.values())
    for name, measurement in result.system.measurements.items():
        rows = len(measurement.noise())
        if described[name]["type"] == "camera":
            own = result.errors.calibrated_residual_mm[start : start + rows]
            residuals = residuals_of(result, name, cast("Camera", measurement), own)
            parts += _of_camera(residuals, _MOST_BYTES // count)
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


@dataclass(frozen=True)
class CameraResiduals:
    """Of one camera what it saw, and how far that is from what was predicted."""

    name: str  # of the measurement
    images: tuple[str, ...]  # what each record is called
    seen: Array  # where corners were seen (2 x P x N, px)
    off: Array  # measured minus predicted (2 x P x N, px; NaN if unseen)
    size: tuple[float, float] | None = None  # width and height of an image (px), where they are stated
    files: tuple[str, ...] = ()  # the path of each image; none where corners were read without images

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
    size = None if camera.image is None else (_PX * camera.image[0], _PX * camera.image[1])
    return CameraResiduals(name, result.dataset.ids, places, off, size, result.dataset.files.get(name, ()))


@dataclass(frozen=True)
class _Photo:
    """An image as a data address, and its width and height (px)."""

    address: str
    size: tuple[float, float]


def drawn_images(residuals: CameraResiduals, most_bytes: int) -> str:
    """The worst images and a typical one with the corners seen and predicted, as HTML; empty if nothing was seen.

    Where an image was not read, or is no longer there, the corners stand alone.

    Args:
        residuals: of one camera.
        most_bytes: for the images in all.
    """
    errors = residuals.by_image
    order = [int(i) for i in np.argsort(-np.nan_to_num(errors, nan=-1.0)) if np.isfinite(errors[i])]
    if not order:
        return ""
    worst, typical = order[:_DRAWN], order[len(order) // 2]
    shown = [(i, "typical" if i == typical else "worst") for i in dict.fromkeys([*worst, typical])]
    figures = "".join(_figure(residuals, i, word, most_bytes // len(shown)) for i, word in shown)
    marks = (("seen", "seen"), ("predicted", "predicted"), ("arrow", "from predicted to seen"))
    key = ", ".join(f'<b style="background:{_COLOURS[c]};padding:0 .5em"></b> {words}' for c, words in marks)
    times = significant(_enlarged(residuals), 1)
    return f'<p>Single images: {key} ({times} times as long).</p><div class="two">{figures}</div>'


def _enlarged(residuals: CameraResiduals) -> float:
    """How many times as long arrows are drawn: 20 times, unless they would be too short or too long for the image."""
    typical, extent = float(np.nanmedian(residuals.by_image)), _extent(residuals)[0]
    if _SHORTEST * extent <= _ENLARGED * typical <= _LONGEST * extent:
        return _ENLARGED
    return svg.nice_step(_SHORTEST * extent / max(typical, 1e-9) * 3)


def _extent(residuals: CameraResiduals) -> tuple[float, float]:
    """Width and height that hold all corners, where no image says its own (px)."""
    if residuals.size is not None:
        return residuals.size
    u, v = np.nanmax(residuals.seen, axis=(1, 2))
    return 1.05 * float(u), 1.05 * float(v)


def _figure(residuals: CameraResiduals, index: int, word: str, most_bytes: int) -> str:
    photo = _photo(residuals.files[index], most_bytes) if residuals.files else None
    width, height = photo.size if photo else _extent(residuals)
    scale, name = svg.HALF / width, residuals.images[index]
    shape = (float(svg.HALF), height * scale)
    back = svg.rect(0, 0, *shape, "#3a424d")
    if photo:
        back = f'<image href="{photo.address}" width="{shape[0]:.0f}" height="{shape[1]:.1f}"/>'
    seen = residuals.seen[:, :, index]
    predicted = seen - residuals.off[:, :, index]
    there = np.isfinite(predicted).all(axis=0)
    seen, predicted = (scale * (corners[:, there] + 0.5) for corners in (seen, predicted))
    tips = predicted + _enlarged(residuals) * (seen - predicted)
    style = '<g style="stroke:{};stroke-width:{};stroke-linecap:round">{}</g>'
    marks = [
        style.format(_COLOURS["arrow"], 1.4, svg.segments(predicted[0], predicted[1], tips[0], tips[1], "")),
        style.format(_COLOURS["predicted"], 1.2, svg.marks(predicted[0], predicted[1], _CROSS, "")),
        style.format(_COLOURS["seen"], 3, svg.dots(seen[0], seen[1], "")),
    ]
    error = significant(float(residuals.by_image[index]))
    words = f"{name} ({word}): {error} px rms, {int(there.sum())} corners"
    drawn = svg.document(f"camera-{residuals.name}-{index}", shape, words, words, [back, *marks])
    return f"<figure>{drawn}<figcaption>{escape(words)}</figcaption></figure>"


def _photo(path: str, most_bytes: int) -> _Photo | None:
    """A small copy of an image file; None where it cannot be read any more."""
    try:
        grey, cv2 = grey_image(input_bytes(Path(path), MOST_BYTES, "an image"), path), opencv()
    except ArmcalError:
        return None
    height, width = grey.shape
    scale = min(1.0, _WIDTH_PX / width)
    small = cv2.resize(grey, (round(scale * width), max(1, round(scale * height))), interpolation=cv2.INTER_AREA)
    for quality in _QUALITIES:
        content = cv2.imencode(".jpg", small, [cv2.IMWRITE_JPEG_QUALITY, quality])[1].tobytes()
        if len(content) * 4 / 3 <= most_bytes:
            return _Photo(f"data:image/jpeg;base64,{base64.b64encode(content).decode()}", (width, height))
    return None
