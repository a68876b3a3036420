"""The library OpenCV, which only what reads images needs."""

from __future__ import annotations

from typing import Any

from armcal.errors import PluginError
from armcal.extras import library


def opencv() -> Any:
    """The module ``cv2``.

    Raises:
        PluginError: it is not installed, or too old to know boards of tags.
    """
    cv2 = library("cv2", "looking at images")
    if not hasattr(getattr(cv2, "aruco", None), "ArucoDetector"):
        version = getattr(cv2, "__version__", "of an unknown version")
        hint = "Run pip install --upgrade 'armcal[camera]'."
        raise PluginError(f"found OpenCV {version}, expected at least 4.8.", hint=hint)
    return cv2
