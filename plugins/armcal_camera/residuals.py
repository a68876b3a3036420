"""What a run leaves of each corner in the images of a camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from armcal.base.domains import Array
from armcal.run.result import RunResult

from armcal_camera.camera import Camera

_PX = 1000.0


@dataclass(frozen=True)
class CameraResiduals:
    """Of one camera what it saw, and how far that is from what was predicted.

    Attributes:
        name: of the measurement.
        images: what each record is called.
        seen: where corners were seen (2 x P x N, px).
        off: measured minus predicted (2 x P x N, px; NaN if unseen).
        size: width and height of an image (px), where they are stated.
        files: the path of each image; none where corners were read without images.
    """

    name: str
    images: tuple[str, ...]
    seen: Array
    off: Array
    size: tuple[float, float] | None = None
    files: tuple[str, ...] = ()

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
