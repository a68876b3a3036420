"""Images of boards from a stated truth: a printed pattern through a lens, with blur, light and noise."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import ConfigError

from armcal_camera.board import Board, dark_rectangles, opencv, outline
from armcal_camera.detection import Grey
from armcal_camera.intrinsics import DISTORTION, normalised
from armcal_camera.start import pose_matrix

_SAMPLES = 4  # along each side of a pixel
_COARSE_PX = 4
_MARGIN = 1  # coarse steps
_MOST_TEXELS = 8192


@dataclass(frozen=True)
class Lens:
    """How rays become pixels; the first pixel's centre is at 0, 0."""

    focal: tuple[float, float]  # fx, fy (px)
    centre: tuple[float, float]  # cx, cy (px)
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)  # in the order of ``DISTORTION``
    model: str = "pinhole"  # or fisheye

    def rays(self, pixels: Array) -> Array:
        numbers = (np.array(part) for part in (self.focal, self.centre, self.distortion))
        return normalised(self.model, pixels, *numbers)


@dataclass(frozen=True)
class Exposure:
    """What makes an image imperfect, and its grey values."""

    blur: float = 0.5  # standard deviation (px), beyond that of the pixels' own size
    noise: float = 0.0  # standard deviation (grey values)
    light: float = 0.0  # how much brighter the right edge is than the left one, as a share of the mean
    dark: float = 30.0
    white: float = 215.0
    background: float = 110.0
    seed: int = 0  # of the noise


def render(placed: Sequence[tuple[Board, Array]], lens: Lens, size: tuple[int, int], exposure: Exposure) -> Grey:
    """The image (width and height in px) of boards, each with camera_T_board (4 x 4, m); later ones cover others."""
    cv2 = opencv()
    rays = _fine_rays(lens, size)
    fine = np.full(rays.shape[:2], exposure.background, np.float32)
    for board, pose in placed:
        low, high = outline(board).reshape(2, 2)
        corners = np.array([(x, y, 0.0, 1.0) for x in (low[0], high[0]) for y in (low[1], high[1])])
        nearest, step = float((corners @ pose.T)[:, 2].min()), board.layout.step
        if nearest <= 0:
            raise ValueError("the board is not all in front of the camera")
        # two texels a pixel where the board is nearest
        texels = min(2 * max(lens.focal) / nearest, _MOST_TEXELS / (max(board.layout.extent) + step))
        width, height = (math.ceil((extent + step) * texels) for extent in board.layout.extent)
        darkness, start = np.zeros((height, width), np.float32), low - step / 2
        for x0, y0, x1, y1 in (dark_rectangles(board) - [*start, *start]) * texels:
            (columns, across), (rows, along) = _coverage(x0, x1), _coverage(y0, y1)
            darkness[rows, columns] += np.outer(along, across).astype(np.float32)
        plane = pose[:3, [0, 1, 3]]
        to_texel = np.array([[texels, 0, -texels * start[0] - 0.5], [0, texels, -texels * start[1] - 0.5], [0, 0, 1.0]])
        places = cv2.perspectiveTransform(rays, to_texel @ np.linalg.inv(plane))
        texture = exposure.white + (exposure.dark - exposure.white) * darkness
        cv2.remap(
            texture.astype(np.float32), places, None, cv2.INTER_LINEAR, dst=fine, borderMode=cv2.BORDER_TRANSPARENT
        )
    image = cv2.resize(fine, size, interpolation=cv2.INTER_AREA)
    if exposure.blur:
        image = cv2.GaussianBlur(image, (0, 0), exposure.blur)
    image = image * (1 + exposure.light * (np.arange(size[0]) / size[0] - 0.5))
    if exposure.noise:
        image = image + np.random.default_rng(exposure.seed).normal(0.0, exposure.noise, image.shape)
    return np.asarray(np.rint(image).clip(0, 255), np.uint8)


def _fine_rays(lens: Lens, size: tuple[int, int]) -> Array:
    """The rays of all samples (H x W x 2); computed on a coarse grid, as they change slowly."""
    cv2 = opencv()
    columns, rows = (math.ceil(length / _COARSE_PX) + 2 * _MARGIN for length in size)
    u, v = ((np.arange(n) - _MARGIN + 0.5) * _COARSE_PX - 0.5 for n in (columns, rows))
    grid = np.stack(np.meshgrid(u, v), axis=2).reshape(-1, 2)
    coarse = lens.rays(grid).reshape(rows, columns, 2).astype(np.float32)
    step, cut = _COARSE_PX * _SAMPLES, _MARGIN * _COARSE_PX * _SAMPLES
    fine = cv2.resize(coarse, (columns * step, rows * step), interpolation=cv2.INTER_LINEAR)
    return np.ascontiguousarray(fine[cut : cut + size[1] * _SAMPLES, cut : cut + size[0] * _SAMPLES])


def _coverage(low: float, high: float) -> tuple[slice, Array]:
    texels = np.arange(math.floor(low), math.ceil(high))
    return slice(texels[0], texels[-1] + 1), np.minimum(texels + 1, high) - np.maximum(texels, low)


_USUAL = Exposure(blur=0.7, noise=2.0, light=0.1)


def rendered_records(camera: Any, frames: Mapping[str, Array], values: Mapping[str, Array]) -> Iterator[bytes]:
    if any(float(values[f"{name}_bend_{axis}"][0]) for name in camera.board_names for axis in "xy"):
        raise ConfigError("found a board that is bent, expected flat ones: images are drawn of these alone.")
    kpx = 1000.0
    focal, centre = ([kpx * float(values[name][0]) for name in names] for names in (("fx", "fy"), ("cx", "cy")))
    size = [kpx * x for x in camera.image] if camera.image else [2 * x for x in centre]
    model = camera.settings.model
    distortion = tuple(float(values[name][0]) for name in DISTORTION[model])
    lens = Lens((focal[0], focal[1]), (centre[0], centre[1]), distortion, model)
    scale = float(values["board_scale"][0])
    carried = np.linalg.inv(frames[camera.camera_frame]) @ frames[camera.board_frame]
    for number, to_camera in enumerate(np.linalg.inv(pose_matrix("camera", values)) @ carried):
        placed = []
        for board, name in zip(camera.boards, camera.board_names, strict=True):
            there = to_camera @ pose_matrix(name, values)
            there[:3, 3] /= scale  # the whole picture of a larger board is that of one nearer by
            placed.append((board, there))
        exposure = Exposure(_USUAL.blur, _USUAL.noise, _USUAL.light, seed=number)
        image = render(placed, lens, (round(size[0]), round(size[1])), exposure)
        yield opencv().imencode(".png", image)[1].tobytes()
