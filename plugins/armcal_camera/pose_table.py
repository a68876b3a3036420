"""Where the arm stood for each image: joint angles, or poses of the flange, from a file."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.pose_settings import nearest_rotation
from armcal.base.units import DIMENSIONLESS
from armcal.io.cells import is_number
from armcal.io.plain_files import input_bytes, refuse, text_of
from armcal.measure.checks import check_dataset, layout_of
from armcal.measure.measurement import Channel
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal.plugins import discover
from scipy.spatial.transform import Rotation

FLANGE = ("x", "y", "z", "rz", "ry", "rx")
"""Joints of an arm whose flange's pose is read: base_T_flange turns by Rz(rz) Ry(ry) Rx(rx)."""
_QUATERNION = ("qw", "qx", "qy", "qz")
_MAX_BYTES = 256 * 1024**2
_INSTANCE = "flange"


@dataclass(frozen=True)
class _FlangeReading:
    """Stands for a measurement that reads a pose, so that readers of poses read one."""

    arms: tuple[str, ...] = ("",)

    def channels(self) -> tuple[Channel, ...]:
        """A place and a unit quaternion."""
        return (*(Channel(name, "length") for name in "xyz"), *(Channel(name, DIMENSIONLESS) for name in _QUATERNION))


def read_poses(poses: Path | dict[str, Any], request: ReadRequest, cameras: tuple[str, ...]) -> Dataset:
    """The records of a file of poses, without what the cameras read.

    Args:
        poses: the file, or the settings of a reader (``type: csv``, ``type: pose_csv``).
        request: what is asked for.
        cameras: instances whose channels the file has not.

    Raises:
        DataError: with file, line and column.
        PluginError: the reader is not known.
    """
    channels = tuple(w for w in request.channels if w.channel.partition(".")[0] not in cameras)
    rest = {name: m for name, m in request.measurements.items() if name not in cameras}
    request = ReadRequest(request.arms, rest, channels)
    flange = next((arm for arm in request.arms.values() if tuple(arm.commanded) == FLANGE), None)
    if isinstance(poses, Path):
        first = _first_line(poses)
        if flange is not None and first and all(is_number(cell) for cell in first):
            return _table(poses, flange, request)
        settings: dict[str, Any] = {"type": "csv", "path": str(poses)}
        if flange is not None and set(_QUATERNION) <= set(first):
            quaternion = {"columns": _QUATERNION, "order": "wxyz"}
            settings = {"type": "pose_csv", "path": str(poses), "quaternion": quaternion}
    else:
        settings = dict(poses)
    if flange is not None and settings.get("type") == "pose_csv":
        return _flange_poses(settings, flange, request)
    return _reader(settings).read(request)


def _reader(settings: dict[str, Any]) -> Any:
    component = discover().find("reader", str(settings.get("type", "csv"))).load()
    given = {key: value for key, value in settings.items() if key != "type"}
    return component(component.Settings.model_validate(given))


def _first_line(path: Path) -> list[str]:
    text = text_of(input_bytes(path, _MAX_BYTES, "a file of poses"), path, "Save it as text in UTF-8.")
    return next((line.replace(",", " ").split() for line in text.splitlines() if line.strip()), [])


def _flange_poses(settings: dict[str, Any], arm: Arm, request: ReadRequest) -> Dataset:
    """What a reader of poses makes of the file, as the flange's coordinates."""
    reading: Any = _FlangeReading()
    others = tuple(w for w in request.channels if not w.channel.startswith(f"{arm.name}."))
    own = tuple(
        RequestedChannel(f"{_INSTANCE}.{c.name}", (c.name,), c.dimension, True, parts=(_INSTANCE,))
        for c in reading.channels()
    )
    dataset = _reader(settings).read(ReadRequest({}, {_INSTANCE: reading}, (*others, *own)))
    values = {name: dataset.column(f"{_INSTANCE}.{name}") for name in ("x", "y", "z", *_QUATERNION)}
    turns = Rotation.from_quat(np.stack([values[name] for name in ("qx", "qy", "qz", "qw")], axis=1))
    kept = {name: numbers for name, numbers in dataset.channels.items() if not name.startswith(f"{_INSTANCE}.")}
    places = np.stack([values[name] for name in "xyz"])
    return replace(dataset, channels={**kept, **_coordinates(arm, places, turns)})


def _coordinates(arm: Arm, places: Array, turns: Rotation) -> dict[str, Array]:
    rows = [*places, *np.unwrap(turns.as_euler("ZYX"), axis=0).T]
    return {f"{arm.name}.{name}": np.ascontiguousarray(row) for name, row in zip(FLANGE, rows, strict=True)}


def _table(path: Path, arm: Arm, request: ReadRequest) -> Dataset:
    """Rows of 12 or 16 numbers: base_T_flange row by row, metres."""
    content = input_bytes(path, _MAX_BYTES, "a table of flange poses")
    matrices, lines = [], []
    for line, text in enumerate(content.decode("utf-8-sig").splitlines(), start=1):
        cells = text.replace(",", " ").split()
        if not cells:
            continue
        if len(cells) not in (12, 16) or not all(is_number(cell) for cell in cells):
            refuse(
                path, f"found {len(cells)} cells, expected 12 or 16 numbers.", "Give base_T_flange row by row.", line
            )
        matrix = np.array([float(cell) for cell in cells]).reshape(-1, 4)
        if len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            refuse(path, "found a matrix whose last row is not 0 0 0 1.", "Give the matrix row by row.", line)
        try:
            matrix[:3, :3] = nearest_rotation(matrix[:3, :3])
        except ValueError as fault:
            refuse(path, f"{fault}.", "Give base_T_flange row by row, in metres.", line)
        matrices.append(matrix[:3])
        lines.append(line)
    poses = np.array(matrices)
    channels = _coordinates(arm, poses[:, :, 3].T, Rotation.from_matrix(poses[:, :, :3]))
    dataset = Dataset(tuple(map(str, lines)), channels, rows=tuple(lines), source=str(path))
    return check_dataset(dataset, layout_of(request.channels, dataset, {}, {}, by_line=True))
