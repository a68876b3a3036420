"""Camera models: where a point in the camera's frame appears in the image; and intrinsics, stated or in a file.

A camera's frame has x to the right of the image, y down, z along the optical axis. Intrinsics are in thousands of
pixels, as the core holds places in an image; pixel (0, 0) is the centre of the upper left one, as OpenCV has it. Files
are ROS ``camera_info``, OpenCV's and Kalibr's.
"""

import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import casadi as ca
import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.settings import Settings, UnitOf
from armcal.io.plain_files import input_bytes, refuse
from pydantic import Field

from armcal_camera.board import or_file

Lens: TypeAlias = Literal["pinhole", "fisheye"]
Pixels: TypeAlias = Annotated[float, UnitOf("image")]
DISTORTION = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
"""Names of the distortion coefficients of each model, in OpenCV's order."""
_NUMBER = re.compile(r"[-+.0-9eE]+")
_STEPS = 40
_NO_ANGLE = 1e-24
_MOST_BYTES = 1024**2
_FISHEYE = {"equidistant", "fisheye"}
_PINHOLE = {"plumb_bob", "radtan", "none"}
_MATRIX = ("camera_matrix", "cameraMatrix", "K", "k", "M1")  # k and d: as ros2 topic echo prints them
_DISTORTION = ("distortion_coefficients", "distCoeffs", "distortion", "D", "d", "D1", "distortion_coeffs")
_HINT = "Give a camera_info YAML of ROS, an OpenCV YAML with camera_matrix, or a camchain of Kalibr."


class IntrinsicsSettings(Settings):
    """Focal lengths, principal point and distortion, as OpenCV states them; ``model`` and ``image`` of a file."""

    fx: Annotated[Pixels, Field(gt=0)]
    fy: Annotated[Pixels, Field(gt=0)]
    cx: Pixels
    cy: Pixels
    distortion: tuple[float, ...] = ()
    model: Lens | None = None
    image: tuple[Pixels, Pixels] | None = None


class _Loader(yaml.SafeLoader):
    """Takes OpenCV's matrices for mappings."""


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", yaml.SafeLoader.construct_yaml_map)  # type: ignore[type-var]


def read_intrinsics(path: str | Path) -> IntrinsicsSettings:
    text = input_bytes(Path(path), _MOST_BYTES, "a file of intrinsics").decode("utf-8", "replace")
    try:
        lines = "\n".join(line for line in text.splitlines() if not line.startswith("%YAML"))
        content = next(filter(None, yaml.load_all(lines, _Loader)), None)  # ros2 topic echo parts messages by ---
    except yaml.YAMLError as fault:
        refuse(path, f"it is not YAML ({fault}).", _HINT)
    content = content.get("cam0", content) if isinstance(content, Mapping) else {}
    content = content if isinstance(content, Mapping) else {}

    def numbers_of(*keys: str) -> list[float]:
        key = next((key for key in keys if key in content), "")
        try:
            return _numbers(content[key]) if key else []
        except (KeyError, ValueError, OverflowError):
            refuse(path, f"{key}: found {str(content[key])[:200]}, expected numbers alone.", "Correct it.")

    matrix = numbers_of(*_MATRIX)
    numbers = [matrix[i] for i in (0, 4, 2, 5)] if len(matrix) == 9 else []
    if not numbers and content.get("camera_model", "pinhole") == "pinhole":  # as Kalibr writes them
        numbers = numbers_of("intrinsics")
    if len(numbers) != 4:
        refuse(path, "found no camera matrix in it.", _HINT)
    distortion = tuple(numbers_of(*_DISTORTION))
    sides = [numbers_of(f"image_{side}", side) for side in ("width", "height")]
    size = [x for side in sides for x in side] or numbers_of("resolution")
    stated = str(content.get("distortion_model") or "plumb_bob").lower()
    if stated != "none" and not {*_DISTORTION} & set(content):
        hint = "Give the file whole; of a lens without distortion write distortion_coefficients: [0, 0, 0, 0]."
        refuse(path, f"found a camera matrix, and none of {', '.join(_DISTORTION)}.", hint)
    if min(numbers[:2]) <= 0:
        refuse(
            path, f"found the focal lengths {numbers[0]:g} and {numbers[1]:g}, expected more than 0.", "Correct them."
        )
    if stated == "rational_polynomial" and not any(distortion[5:]):  # k4 to k6 are zero
        stated, distortion = "plumb_bob", distortion[:5]
    if stated not in _FISHEYE | _PINHOLE:
        known = ", ".join(sorted(_FISHEYE | _PINHOLE))
        hint = "Leave intrinsics out, so that they are found from the images, or calibrate the lens with plumb_bob."
        hint = hint if stated == "rational_polynomial" else _HINT
        refuse(path, f"found the distortion model {stated!r}, expected one of {known}.", hint)
    return IntrinsicsSettings.si(
        **{key: x / 1000 for key, x in zip(("fx", "fy", "cx", "cy"), numbers, strict=True)},
        distortion=distortion,
        model="fisheye" if stated in _FISHEYE else "pinhole",
        image=tuple(x / 1000 for x in size) if len(size) == 2 and min(size) > 0 else None,
    )


def other_size(stated: tuple[float, float], taken: tuple[float, float]) -> str:
    """What to say of intrinsics of other images than were taken (width and height, thousands of px); empty if none."""
    if np.abs(np.subtract(stated, taken)).max() < 0.0015:
        return ""
    (width, height), (wide, tall), ratio = np.rint(np.multiply(1000, stated)), np.rint(np.multiply(1000, taken)), 0.0
    if abs(wide / width - tall / height) < 0.01 * wide / width:
        ratio = wide / width
    mend = f"scale fx, fy, cx and cy by {ratio:g}, or give" if ratio else "give"
    text = f"the intrinsics are of {width:.0f} x {height:.0f} images, these are {wide:.0f} x {tall:.0f}"
    return f"{text}: {mend} those of this resolution"


def _numbers(value: Any) -> list[float]:
    """The numbers of a list, or of the ``data`` of a matrix, row by row; YAML takes 1e-05 for a text.

    Raises:
        KeyError, ValueError, OverflowError: there is no ``data``, or an entry is no finite number.
    """
    entries = value["data"] if isinstance(value, Mapping) else value
    flat = entries if isinstance(entries, list) else [entries]
    if all(isinstance(row, list) for row in flat):
        flat = [x for row in flat for x in row]
    for entry in flat:
        if isinstance(entry, bool) or not _NUMBER.fullmatch(str(entry)) or not math.isfinite(float(str(entry))):
            raise ValueError
    return [float(str(x)) for x in flat]


IntrinsicsOrFile: TypeAlias = Annotated[IntrinsicsSettings, or_file(read_intrinsics)]


def pinhole(x: Any, y: Any, distortion: Any) -> tuple[Any, Any]:
    """Normalised coordinates after radial and tangential distortion (k1, k2, p1, p2, k3). [Brown1971]"""
    k1, k2, p1, p2, k3 = (distortion[i] for i in range(5))
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x), y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y


def fisheye(x: Any, y: Any, distortion: Any) -> tuple[Any, Any]:
    """Normalised coordinates of a lens whose image grows with the angle to its axis (k1 to k4). [Kannala2006]"""
    radius = ca.sqrt(x * x + y * y + _NO_ANGLE)
    angle = ca.atan(radius)
    t2 = angle * angle
    k = [distortion[i] for i in range(4)]
    ratio = angle * (1 + t2 * (k[0] + t2 * (k[1] + t2 * (k[2] + t2 * k[3])))) / radius
    return x * ratio, y * ratio


def projected(lens: str, point: Any, focal: Any, centre: Any, distortion: Any) -> Any:
    """Where a point in the camera's frame (3x1, m; in front of the camera) appears (2x1), as an expression."""
    distort = pinhole if lens == "pinhole" else fisheye
    x, y = distort(point[0] / point[2], point[1] / point[2], distortion)
    return ca.vertcat(focal[0] * x + centre[0], focal[1] * y + centre[1])


def normalised(lens: str, image: Array, focal: Array, centre: Array, distortion: Array) -> Array:
    """Undistorted x / z and y / z (N x 2) of places in an image (N x 2), by fixed-point iteration."""
    seen = (image - centre) / focal
    if lens == "fisheye":
        turned = angle = np.hypot(*seen.T)
        for _ in range(_STEPS):
            t2 = angle * angle
            angle = turned / (1 + t2 * np.polyval(distortion[::-1], t2))
        return np.asarray(seen * np.tan(np.clip(angle, 0.0, 1.5))[:, None] / np.maximum(turned, 1e-12)[:, None])
    here = seen
    for _ in range(_STEPS):
        here = here + (seen - np.array(pinhole(here[:, 0], here[:, 1], distortion)).T)
    return np.asarray(here)
