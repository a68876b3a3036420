"""Pairs of poses as programs for hand-eye calibration save them: the hand's in the base, the marker's in the camera."""

import hashlib
import itertools
import math
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

from armcal_tracker.csv_reader import FEWEST, ORDERS, QUATERNION, WORST, misfit, turned_alike

_MAX_BYTES, _TOLERANCE = 16 * 1024**2, 1e-3
_FLANGE = ("x", "y", "z", "rz", "ry", "rx")
_ALIKE, _CLEARLY = 0.01, 25.0  # less than 1 % may be the camera's; of squares, at least five times nearer
_VECTOR = "rotation vectors"
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
        """A record a pair.

        Raises:
            DataError: the file is none of the two, has a pose that is none, or moves as with the other mounting.
        """
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
            hint = f"Write mounting: {other}; or, if the camera is mounted as stated, the hand's poses are inverted."
            refuse(path, f"{text} by {median[other]:.2f} deg with {other}.", hint)
        _refuse_other_angles(path, hand, marker, mounting == "eye_in_hand")
        if mounting == "eye_in_hand":
            markers = np.linalg.inv(markers)
        _refuse_other_lengths(path, hands, markers)
        body = Rotation.from_matrix(markers[:, :3, :3]).as_quat(canonical=True)[:, [3, 0, 1, 2]]
        flange = [*hands[:, :3, 3].T, *hand.as_euler("ZYX").T]
        columns = {f"{arm}.{name}": column for name, column in zip(_FLANGE, flange, strict=True)}
        columns |= {f"{reading[0]}.{axis}": markers[:, i, 3] for i, axis in enumerate("xyz")}
        columns |= {f"{reading[0]}.{name}": body[:, i] for i, name in enumerate(QUATERNION)}
        numbers = tuple(range(1, len(hands) + 1))
        digest = hashlib.sha256(content).hexdigest()
        return Dataset(tuple(map(str, numbers)), columns, rows=numbers, source=str(path), sha256=digest)


def _refuse_other_angles(path: Any, hand: Rotation, marker: Rotation, inverts: bool) -> None:
    """Rotations that fit once the angles are read in another convention: a program before this one mistook them."""

    def left_of(hand: Rotation, marker: Rotation) -> float:
        return misfit(marker.inv() if inverts else marker, hand)

    off, best, text = left_of(hand, marker), math.inf, ""
    if math.degrees(off) < WORST[1][0]:
        return
    for whose, turns in (("hand", hand), ("marker", marker)):
        for taken, meant in itertools.permutations((_VECTOR, *ORDERS), 2):
            numbers = turns.as_rotvec() if taken == _VECTOR else turns.as_euler(taken, suppress_warnings=True)
            clear = np.ones(len(numbers), dtype=bool)
            if meant == _VECTOR:  # of two triples for one rotation that whose length is a turn's
                other = np.remainder(numbers * [1, -1, 1], 2 * math.pi) - math.pi
                is_other, is_own = (np.linalg.norm(x, axis=1) <= math.pi for x in (other, numbers))
                numbers, clear = np.where(is_own[:, None], numbers, other), is_other != is_own
            if clear.sum() < FEWEST:
                continue
            read = Rotation.from_rotvec(numbers) if meant == _VECTOR else Rotation.from_euler(meant, numbers)
            pair = (read, marker) if whose == "hand" else (hand, read)
            left = left_of(*(rotations[clear] for rotations in pair))
            if 0 < left < 0.9 * best:
                names = [name if name == _VECTOR else f"Euler angles {name}" for name in (meant, taken)]
                best, text = left, f"if the {whose}'s {names[0]} were taken for {names[1]}"
    if off > WORST[1][1] * best:
        text = f"turns from pair to pair are off by {math.degrees(off):.2f} deg (median); {text}, by"
        hint = "Correct the program that wrote the rotations (small letters: turns about fixed axes)."
        refuse(path, f"{text} {math.degrees(best):.2f} deg.", hint)


def _refuse_other_lengths(path: Any, hands: Array, markers: Array) -> None:
    """Places of the marker that fit once they are multiplied: it has another size, or one is in another unit.

    The place of the hand is that of the marker less its offset on the hand: linear in the offset, in the place of the
    camera and in that factor, as rotations are known. [Park1994]
    """
    hand, marker = (Rotation.from_matrix(poses[:, :3, :3]) for poses in (hands, markers))
    hand_T_marker, _ = turned_alike(marker, hand)
    if hand_T_marker is None:
        return
    base = (hand * hand_T_marker * marker.inv()).mean()
    count, rows = len(hands), np.zeros((len(hands), 3, 7))
    rows[:, :, :3], rows[:, :, 3:6], rows[:, :, 6] = -hand.as_matrix(), np.eye(3), base.apply(markers[:, :3, 3])
    rows, places = rows.reshape(-1, 7), hands[:, :3, 3].ravel()
    known, _, rank, _ = np.linalg.lstsq(rows, places, rcond=1e-9)
    left = float(np.sum((places - rows @ known) ** 2))
    stated = places - rows[:, 6]
    kept = float(np.sum((stated - rows[:, :6] @ np.linalg.lstsq(rows[:, :6], stated, rcond=1e-9)[0]) ** 2))
    factor = float(known[6])
    if rank < 7 or factor <= 0 or abs(math.log(factor)) < _ALIKE or kept < _CLEARLY * left:
        return
    text = f"the marker's places fit the hand's if they are multiplied by {factor:.4g}: they are then off by"
    off, before = (1000 * math.sqrt(square / count) for square in (left, kept))
    hint = "Correct the size of the marker by this factor, or the unit of one of both: all places are in m."
    refuse(path, f"{text} {off:.3g} mm, by {before:.3g} mm as they stand.", hint)


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
