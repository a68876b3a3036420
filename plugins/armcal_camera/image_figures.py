"""Single images in the report: what was seen in the worst ones and in a typical one, and what was predicted."""

from __future__ import annotations

import base64
from dataclasses import dataclass
from html import escape
from pathlib import Path

import numpy as np
from armcal.base.domains import Array
from armcal.errors import ArmcalError
from armcal.io.plain_files import input_bytes
from armcal.report import svg
from armcal.report.numbers import significant

from armcal_camera.images import MOST_BYTES, grey_image
from armcal_camera.library import opencv
from armcal_camera.residuals import CameraResiduals

_WORST, _ENLARGED = 3, 20.0
_SHORTEST, _LONGEST = 0.004, 0.06
"""Of the width of an image: arrows of typical length that can be seen, and told apart."""
_WIDTH_PX, _QUALITIES = 480, (70, 45, 25, 10)
_COLOURS = {"seen": "#ffd400", "predicted": "#00c2ff", "arrow": "#ff4fa3"}
_CROSS = "m-3 0h6m-3-3v6"


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
    worst, typical = order[:_WORST], order[len(order) // 2]
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
    marks = _marks(scale * (seen[:, there] + 0.5), scale * (predicted[:, there] + 0.5), _enlarged(residuals))
    error = significant(float(residuals.by_image[index]))
    words = f"{name} ({word}): {error} px rms, {int(there.sum())} corners"
    drawn = svg.document(f"camera-{residuals.name}-{index}", shape, words, words, [back, *marks])
    return f"<figure>{drawn}<figcaption>{escape(words)}</figcaption></figure>"


def _marks(seen: Array, predicted: Array, enlarged: float) -> list[str]:
    """Corners seen, predicted, and the arrows between them (2 x n each, px of the figure)."""
    tips = predicted + enlarged * (seen - predicted)
    style = '<g style="stroke:{};stroke-width:{};stroke-linecap:round">{}</g>'
    return [
        style.format(_COLOURS["arrow"], 1.4, svg.segments(predicted[0], predicted[1], tips[0], tips[1], "")),
        style.format(_COLOURS["predicted"], 1.2, svg.marks(predicted[0], predicted[1], _CROSS, "")),
        style.format(_COLOURS["seen"], 3, svg.dots(seen[0], seen[1], "")),
    ]


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
