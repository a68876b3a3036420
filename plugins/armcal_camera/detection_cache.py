"""Detections that were made before, kept on disk by the content of the image and the settings of the board."""

import hashlib
import json
import os
import tempfile
from contextlib import suppress
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.config_text import as_json
from armcal.functions.compiler import cache_directory

from armcal_camera.board import Board
from armcal_camera.detection import VERSION, Detection
from armcal_camera.images import opencv

_KEPT = 20_000


def detection_key(content: bytes, board: Board) -> str:
    rest = json.dumps([board.to_config(), VERSION, opencv().__version__])
    return hashlib.sha256(content + rest.encode()).hexdigest()[:40]


def kept_detection(key: str, board: Board) -> Detection | None:
    """A detection that was kept; None if there is none that is whole."""
    path = _place(key)
    with suppress(OSError, ValueError, TypeError, KeyError):
        stored = json.loads(path.read_text(encoding="utf-8"))
        corners = np.array(stored.pop("corners"), dtype=float).reshape(-1, 2)
        size = stored.pop("found_size")
        numbers: dict[str, Any] = {name: np.nan if value is None else value for name, value in stored.items()}
        if corners.shape == (len(board.points), 2):
            os.utime(path)
            return Detection(corners, found_size=None if size is None else tuple(size), **numbers)
    return None


def keep_detection(key: str, detection: Detection) -> None:
    """Keep it, whole or not at all; a disk that is full or read-only costs nothing but time."""
    path = _place(key)
    with suppress(OSError):
        path.parent.mkdir(parents=True, exist_ok=True, mode=0o700)
        with tempfile.NamedTemporaryFile("w", dir=path.parent, suffix=".tmp", delete=False, encoding="utf-8") as file:
            file.write(as_json({**asdict(detection), "corners": detection.corners.tolist()}, indent=None))
        Path(file.name).replace(path)


def forget_old() -> None:
    with suppress(OSError):
        files = sorted(_place("").parent.glob("*"), key=lambda path: path.stat().st_mtime, reverse=True)
        for path in files[_KEPT:]:
            path.unlink()


def _place(key: str) -> Path:
    return cache_directory() / "corners" / f"{key}.json"
