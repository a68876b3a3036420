"""What the report of a run says of its cameras: how well they are placed, what is left in the images, and where."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, cast

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import ArmcalError
from armcal.io.plain_files import input_bytes
from armcal.report.document import Figure, Marks, Panel, Part, ReportSection, Table
from armcal.report.numbers import significant
from armcal.report.plot import nice_step
from armcal.run.result import RunResult

from armcal_camera.images import MOST_BYTES, grey_image, opencv

if TYPE_CHECKING:  # importing it takes 0.1 s, which a run without a camera must not wait for
    from armcal_camera.camera import Camera

_PX = 1000.0
_MOST_VECTORS, _WORST, _MOST_BYTES = 4000, 8, 200_000
_DRAWN, _ENLARGED = 3, 20.0
_SHORTEST, _LONGEST = 0.004, 0.06  # Of the width of an image: arrows of typical length that can be seen, and told apart
_WIDTH_PX, _QUALITIES = 480, (70, 45, 25, 10)


def cameras(result: RunResult) -> ReportSection | None:
    described = result.system.description["measurements"]
    start, parts, count = 0, list[Part](), sum(section["type"] == "camera" for section in described.values())
    for name, measurement in result.system.measurements.items():
        rows = len(measurement.noise())
        if described[name]["type"] == "camera":
            own = result.errors.calibrated_residual_mm[start : start + rows]
            residuals = residuals_of(result, name, cast("Camera", measurement), own)
            parts += [_over_the_sensor(residuals), _by_image(residuals), *drawn_images(residuals, _MOST_BYTES // count)]
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


def drawn_images(residuals: CameraResiduals, most_bytes: int) -> list[Part]:
    """The worst images and a typical one with the corners seen and predicted; nothing if none was seen.

    Where an image was not read, or is no longer there, the corners stand alone.

    Args:
        residuals: of one camera.
        most_bytes: for the images in all.
    """
    errors = residuals.by_image
    order = [int(i) for i in np.argsort(-np.nan_to_num(errors, nan=-1.0)) if np.isfinite(errors[i])]
    if not order:
        return []
    worst, typical = order[:_DRAWN], order[len(order) // 2]
    shown = [(i, "typical" if i == typical else "worst") for i in dict.fromkeys([*worst, typical])]
    panels = [_image(residuals, i, word, most_bytes // len(shown)) for i, word in shown]
    caption = f"Arrows, from predicted to seen, are {significant(_enlarged(residuals), 1)} times as long."
    said = "; ".join(panel.title for panel in panels)
    return [Figure(f"{residuals.name}: single images", said, caption, panels)]


def _enlarged(residuals: CameraResiduals) -> float:
    """How many times as long arrows are drawn: 20 times, unless they would be too short or too long for the image."""
    typical, extent = float(np.nanmedian(residuals.by_image)), _extent(residuals)[0]
    if _SHORTEST * extent <= _ENLARGED * typical <= _LONGEST * extent:
        return _ENLARGED
    return nice_step(_SHORTEST * extent / max(typical, 1e-9) * 3)


def _extent(residuals: CameraResiduals) -> tuple[float, float]:
    """Width and height that hold all corners, where no image says its own (px)."""
    if residuals.size is not None:
        return residuals.size
    u, v = np.nanmax(residuals.seen, axis=(1, 2))
    return 1.05 * float(u), 1.05 * float(v)


def _image(residuals: CameraResiduals, index: int, word: str, most_bytes: int) -> Panel:
    photo = _photo(residuals.files[index], most_bytes) if residuals.files else None
    backdrop, size = photo or ("", _extent(residuals))
    seen = residuals.seen[:, :, index]
    predicted = seen - residuals.off[:, :, index]
    there = np.isfinite(predicted).all(axis=0)
    seen, predicted = seen[:, there] + 0.5, predicted[:, there] + 0.5
    marks = [
        Marks("arrow", _lines(predicted, predicted + _enlarged(residuals) * (seen - predicted)), name="arrow"),
        Marks("dot predicted", predicted, name="predicted"),
        Marks("dot seen", seen, name="seen"),
    ]
    error = significant(float(residuals.by_image[index]))
    title = f"{residuals.images[index]} ({word}): {error} px rms, {int(there.sum())} corners"
    return Panel(title, marks, bare=True, backdrop=backdrop, size=size)


def _photo(path: str, most_bytes: int) -> tuple[str, tuple[float, float]] | None:
    """A small copy of an image file as a data address, and the size of the file (px); None if unreadable."""
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
            return f"data:image/jpeg;base64,{base64.b64encode(content).decode()}", (width, height)
    return None
