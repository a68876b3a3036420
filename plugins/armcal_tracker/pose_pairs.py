"""Pairs of poses as programs for hand-eye calibration save them: the hand's in the base, the marker's in the camera."""

import hashlib
from collections.abc import Mapping, Sequence
from typing import Any, ClassVar, Literal

import numpy as np
import yaml
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.io.plain_files import input_bytes, refuse, text_of
from armcal.measure.reader import ReadRequest
from scipy.spatial.transform import Rotation

from armcal_tracker.csv_reader import QUATERNION, WORST, misfit

_MAX_BYTES, _TOLERANCE = 16 * 1024**2, 1e-3
_FLANGE = ("x", "y", "z", "rz", "ry", "rx")
_HINT = "Give the file of samples that moveit_calibration or easy_handeye2 saved, whole."


class PosePairsSettings(Settings):
    """The file, and where the camera is; ``eye_in_hand`` measures the hand's camera from the marker."""

    path: InputPath
    mounting: Literal["eye_in_hand", "eye_to_hand"]


class PosePairsReader:
    """The reader ``pose_pairs``: for the arm ``flange_pose`` and one measurement ``tip_pose``."""

    Settings: ClassVar[type[PosePairsSettings]] = PosePairsSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"path": "/no/such/folder/samples.yaml", "mounting": "eye_to_hand"}

    def __init__(self, settings: PosePairsSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """A record a pair; refused where the pairs move as with the other mounting."""
        path, mounting = self._settings.path, self._settings.mounting
        arm = next((name for name, a in request.arms.items() if set(a.commanded) == set(_FLANGE)), None)
        reading = [name for name, m in request.measurements.items() if {c.name for c in m.channels()} >= {*QUATERNION}]
        if arm is None or len(reading) != 1:
            hint = "Write model: {type: flange_pose}, and one measurement tip_pose."
            refuse(path, "found no arm of which the flange's pose is read, or no one measurement of poses.", hint)
        content = input_bytes(path, _MAX_BYTES, "a file of pairs of poses")
        hands, markers = _pairs(path, content)
        hand, marker = Rotation.from_matrix(hands[:, :3, :3]), Rotation.from_matrix(markers[:, :3, :3])
        off = {"eye_to_hand": misfit(marker, hand), "eye_in_hand": misfit(marker.inv(), hand)}
        other = next(name for name in off if name != mounting)
        if any(np.degrees(off[mounting]) > worst and off[mounting] > times * off[other] for worst, times in WORST):
            median = {name: np.degrees(angle) for name, angle in off.items()}
            text = f"turns from pair to pair are off by {median[mounting]:.2f} deg (median) with {mounting}, and"
            refuse(path, f"{text} by {median[other]:.2f} deg with {other}.", f"Write mounting: {other}.")
        if mounting == "eye_in_hand":
            markers = np.linalg.inv(markers)
        body = Rotation.from_matrix(markers[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
        flange = [*hands[:, :3, 3].T, *hand.as_euler("ZYX").T]
        columns = {f"{arm}.{name}": column for name, column in zip(_FLANGE, flange, strict=True)}
        columns |= {f"{reading[0]}.{axis}": markers[:, i, 3] for i, axis in enumerate("xyz")}
        columns |= {f"{reading[0]}.{name}": body[:, i] for i, name in enumerate(QUATERNION)}
        numbers = tuple(range(1, len(hands) + 1))
        digest = hashlib.sha256(content).hexdigest()
        return Dataset(tuple(map(str, numbers)), columns, rows=numbers, source=str(path), sha256=digest)


def _pairs(path: Any, content: bytes) -> tuple[Array, Array]:
    """base_T_hand and camera_T_marker (N x 4 x 4 each)."""
    try:
        samples = yaml.load(text_of(content, path, _HINT), getattr(yaml, "CSafeLoader", yaml.SafeLoader))
    except (yaml.YAMLError, RecursionError, ValueError) as fault:
        refuse(path, f"it is not YAML ({' '.join(str(fault).split())[:200]}).", _HINT)
    if isinstance(samples, Mapping):  # of easy_handeye2
        samples = samples.get("samples")
    if not isinstance(samples, Sequence) or isinstance(samples, str) or not samples:
        refuse(path, "found no list of samples in it.", _HINT)
    keys = [("effector_wrt_world", "object_wrt_sensor"), ("robot", "tracking")]
    made = []
    for number, sample in enumerate(samples, start=1):
        pair = next((k for k in keys if isinstance(sample, Mapping) and {*k} <= set(sample)), None)
        if pair is None:
            refuse(path, f"sample {number}: found no {' and no '.join(f'{a}, {b}' for a, b in keys)}.", _HINT)
        poses = [_pose(sample[key]) for key in pair]
        for key, pose in zip(pair, poses, strict=True):
            if pose is None:
                text = f"sample {number}, {key}: found no pose, expected 16 numbers of a matrix, row by row, or"
                refuse(path, f"{text} a translation and a rotation.", "Correct it, or remove the sample.")
        made.append(poses)
    return np.array(made)[:, 0], np.array(made)[:, 1]


def _pose(value: Any) -> Array | None:
    """A pose (4 x 4); None of what is none."""
    pose = np.eye(4)
    try:
        if isinstance(value, Mapping):
            place, turn = value["translation"], value["rotation"]
            quaternion = np.array([float(turn[name]) for name in "xyzw"])
            if abs(np.linalg.norm(quaternion) - 1) > _TOLERANCE:
                return None
            pose[:3, :3] = Rotation.from_quat(quaternion).as_matrix()
            pose[:3, 3] = [float(place[name]) for name in "xyz"]
        else:
            pose = np.array(value, dtype=float).reshape(4, 4)
    except (KeyError, TypeError, ValueError):
        return None
    turn = pose[:3, :3]
    is_rotation = np.abs(turn.T @ turn - np.eye(3)).max() < _TOLERANCE and np.linalg.det(turn) > 0
    return pose if np.isfinite(pose).all() and is_rotation and np.array_equal(pose[3], [0, 0, 0, 1]) else None
