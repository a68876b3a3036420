"""Camera models: where a point in the camera's frame appears in the image; and intrinsics, stated or in a file.

A camera's frame has x to the right of the image, y down, z along the optical axis. Intrinsics are in thousands of
pixels, as the core holds places in an image; pixel (0, 0) is the centre of the upper left one, as OpenCV has it. Files
are ROS ``camera_info``, OpenCV's and Kalibr's.
"""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias

import casadi as ca
import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.settings import Settings, UnitOf
from armcal.errors import DataError, Location
from armcal.io.plain_files import input_bytes
from pydantic import Field

from armcal_camera.board import or_file

Lens: TypeAlias = Literal["pinhole", "fisheye"]
Pixels: TypeAlias = Annotated[float, UnitOf("image")]
DISTORTION = {"pinhole": ("k1", "k2", "p1", "p2", "k3"), "fisheye": ("k1", "k2", "k3", "k4")}
"""Names of the distortion coefficients of each model, in OpenCV's order."""
_STEPS = 40
_NO_ANGLE = 1e-24
_MOST_BYTES = 1024**2
_FISHEYE = {"equidistant", "fisheye"}
_PINHOLE = {"plumb_bob", "radtan", "none"}
_MATRIX = ("camera_matrix", "cameraMatrix", "K", "M1")
_DISTORTION = ("distortion_coefficients", "distCoeffs", "distortion", "D", "D1")


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
    """The intrinsics of a file.

    Raises:
        DataError: it is none of the three, or states another distortion model than these have.
    """
    text = input_bytes(Path(path), _MOST_BYTES, "a file of intrinsics").decode("utf-8", "replace")
    try:
        content = yaml.load("\n".join(x for x in text.splitlines() if not x.startswith("%YAML")), _Loader)
    except yaml.YAMLError as fault:
        raise _refused(path, f"it is not YAML ({fault}).") from fault
    if isinstance(content, Mapping):
        content = content.get("cam0", content)
        for read in (_of_matrix, _of_kalibr):
            made = read(content) if isinstance(content, Mapping) else None
            if made is not None:
                return _with_model(path, content, made)
    raise _refused(path, "found no camera matrix in it.")


def _of_matrix(content: Mapping[str, Any]) -> dict[str, Any] | None:
    matrix = next((_numbers(content[key]) for key in _MATRIX if key in content), [])
    if len(matrix) != 9:
        return None
    distortion = next((_numbers(content[key]) for key in _DISTORTION if key in content), [])
    size = [content.get("image_width"), content.get("image_height")]
    return {"numbers": (matrix[0], matrix[4], matrix[2], matrix[5]), "distortion": distortion, "image": size}


def _of_kalibr(content: Mapping[str, Any]) -> dict[str, Any] | None:
    intrinsics = _numbers(content.get("intrinsics"))
    if len(intrinsics) != 4 or content.get("camera_model", "pinhole") != "pinhole":
        return None
    distortion, size = _numbers(content.get("distortion_coeffs")), _numbers(content.get("resolution"))
    return {"numbers": tuple(intrinsics), "distortion": distortion, "image": size}


def _with_model(path: str | Path, content: Mapping[str, Any], made: Mapping[str, Any]) -> IntrinsicsSettings:
    stated, distortion = str(content.get("distortion_model", "plumb_bob")).lower(), tuple(made["distortion"])
    if stated == "rational_polynomial" and not any(distortion[5:]):  # k4 to k6 are zero
        stated, distortion = "plumb_bob", distortion[:5]
    if stated not in _FISHEYE | _PINHOLE:
        known = ", ".join(sorted(_FISHEYE | _PINHOLE))
        raise _refused(path, f"found the distortion model {stated!r}, expected one of {known}.")
    size = made["image"]
    known_size = len(size) == 2 and all(isinstance(x, int | float) and x > 0 for x in size)
    numbers = {key: x / 1000 for key, x in zip(("fx", "fy", "cx", "cy"), made["numbers"], strict=True)}
    return IntrinsicsSettings.si(
        **numbers,
        distortion=distortion,
        model="fisheye" if stated in _FISHEYE else "pinhole",
        image=tuple(x / 1000 for x in size) if known_size else None,
    )


def _numbers(value: Any) -> list[float]:
    """A list of numbers, or the ``data`` of a matrix, row by row; empty where it is neither."""
    entries = value.get("data") if isinstance(value, Mapping) else value
    if not isinstance(entries, Sequence) or isinstance(entries, str):
        return []
    flat = [x for row in entries for x in (row if isinstance(row, Sequence) else [row])]
    return [float(x) for x in flat if isinstance(x, int | float)]


def _refused(path: str | Path, what: str) -> DataError:
    hint = "Give a camera_info YAML of ROS, an OpenCV YAML with camera_matrix, or a camchain of Kalibr."
    return DataError(f"{what}", where=Location(str(path)), hint=hint)


IntrinsicsOrFile: TypeAlias = Annotated[IntrinsicsSettings, or_file(read_intrinsics)]
"""A field of settings with intrinsics, or the path of a file of them; relative to the configuration it stands in."""


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
