"""Images as grey values, and the library OpenCV, which only what reads images needs."""

from io import BytesIO
from pathlib import Path
from typing import Any
from warnings import catch_warnings, simplefilter

import numpy as np
from armcal.errors import DataError, Location, PluginError
from armcal.plugins import library
from numpy.typing import NDArray

Grey = NDArray[np.uint8]  # An image (H x W); the centre of the pixel in column u and row v is at (u, v)

SUFFIXES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".pnm"))
_ENDS = ((b"\x89PNG", b"IEND", 64), (b"\xff\xd8", b"\xff\xd9", 4096))
_KINDS = ("PNG", "JPEG", "TIFF", "BMP", "DIB", "WEBP", "PPM")
_FEWEST_PIXELS, MOST_PIXELS = 1024, 100_000_000
MOST_BYTES = 512 * 1024**2  # Of an image file


def is_image(path: Path) -> bool:
    return path.suffix.lower() in SUFFIXES and not path.name.startswith(".")


def grey_image(content: bytes, source: str) -> Grey:
    """The grey values of an image file, as the sensor has them: an orientation that it states is not applied.

    Colours are averaged as the eye sees them; of more than 8 bits a pixel the brightest hundredth of the image becomes
    255, so that a few dazzling pixels do not darken the rest.

    Raises:
        DataError: it is no image, cut off, or too large: its header says so before anything is decoded.
    """
    cv2 = opencv()
    pixels = _stated_pixels(content)
    if pixels > MOST_PIXELS:
        message = f"found an image of more than {MOST_PIXELS / 1e6:g} million pixels, expected at most so many."
        raise DataError(message, where=Location(source), hint="Save it with fewer pixels, or remove it.")
    cut = any(content.startswith(head) and tail not in content[-last:] for head, tail, last in _ENDS)
    image = None
    if pixels and not cut:
        flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH | cv2.IMREAD_IGNORE_ORIENTATION
        try:
            image = cv2.imdecode(np.frombuffer(content, np.uint8), flags)
        except cv2.error:  # what it does not know it refuses in many ways
            image = None
    if image is None or image.size < _FEWEST_PIXELS:
        message = "the image is cut off." if cut else "it is not an image that can be read."
        raise DataError(message, where=Location(source), hint="Save it as PNG again, or remove it.")
    if image.dtype != np.uint8:
        image = np.rint(np.nan_to_num(image) * (255.0 / max(float(np.percentile(image, 99)), 1e-9))).clip(0, 255)
    return np.ascontiguousarray(image, dtype=np.uint8)


def _stated_pixels(content: bytes) -> float:
    """How many pixels the header of an image file states; 0 where there is no header of a kind that is read."""
    pillow = library("PIL.Image", "looking at images")
    with catch_warnings():
        simplefilter("ignore")
        try:
            with pillow.open(BytesIO(content), formats=_KINDS) as header:
                return float(header.width * header.height)
        except pillow.DecompressionBombError:
            return np.inf
        except Exception:  # broken headers are refused in many ways
            return 0.0


def opencv() -> Any:
    """The module ``cv2``.

    Raises:
        PluginError: it is not installed, or too old to know boards of tags.
    """
    cv2 = library("cv2", "a camera")
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        version = getattr(cv2, "__version__", "of an unknown version")
        hint = "Run pip install --upgrade 'armcal[camera]'."
        raise PluginError(f"found OpenCV {version}, expected at least 4.8.", hint=hint)
    return cv2
