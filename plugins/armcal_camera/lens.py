"""Camera models: where a point in the camera's frame appears in the image.

A camera's frame has x to the right of the image, y down, z along the optical axis. Intrinsics are in thousands of
pixels, as the core holds places in an image; pixel (0, 0) is the centre of the upper left one, as OpenCV has it.
"""

from __future__ import annotations

from typing import Any

import casadi as ca
import numpy as np
from armcal.base.domains import Array

DISTORTION = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
"""Names of the distortion coefficients of each model, in OpenCV's order."""
_STEPS = 40
_NO_ANGLE = 1e-24


def pinhole(x: Any, y: Any, distortion: Any) -> tuple[Any, Any]:
    """Normalised coordinates after radial and tangential distortion (k1, k2, p1, p2, k3). [Brown1971]"""
    k1, k2, p1, p2, k3 = (distortion[i] for i in range(5))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def fisheye(x: Any, y: Any, distortion: Any, atan: Any = ca.atan, sqrt: Any = ca.sqrt) -> tuple[Any, Any]:
    """Normalised coordinates of a lens whose image grows with the angle to its axis (k1 to k4). [Kannala2006]"""
    radius = sqrt(x * x + y * y + _NO_ANGLE)
    angle = atan(radius)
    t2 = angle * angle
    k = [distortion[i] for i in range(4)]
    ratio = angle * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / radius
    return x * ratio, y * ratio


def projected(lens: str, point: Any, focal: Any, centre: Any, distortion: Any) -> Any:
    """Where a point in the camera's frame (3x1, m; in front of the camera) appears (2x1), as an expression.

    Args:
        lens: ``pinhole`` or ``fisheye``.
        point: in the camera's frame.
        focal: fx, fy.
        centre: cx, cy.
        distortion: coefficients in the order of ``DISTORTION``.
    """
    distort = pinhole if lens == "pinhole" else fisheye
    x, y = distort(point[0] / point[2], point[1] / point[2], distortion)
    return ca.vertcat(focal[0] * x + centre[0], focal[1] * y + centre[1])


def normalised(lens: str, image: Array, focal: Array, centre: Array, distortion: Array) -> Array:
    """Undistorted x / z and y / z (2 x N) of places in an image (2 x N), by fixed-point iteration."""
    seen = (image - centre[:, None]) / focal[:, None]
    if lens == "fisheye":
        turned = np.hypot(*seen)
        angle = turned.copy()
        for _ in range(_STEPS):
            t2 = angle * angle
            angle = turned / (1 + t2 * np.polyval(distortion[::-1], t2))
        return np.asarray(seen * np.tan(np.clip(angle, 0.0, 1.5)) / np.maximum(turned, 1e-12))
    here = seen.copy()
    for _ in range(_STEPS):
        here = np.asarray(here + (seen - np.array(pinhole(here[0], here[1], distortion))))
    return here
