"""What was commanded and what was reached, frame by frame, in stretches without a gap."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, InputError, Location
from numpy.typing import NDArray

from armcal_lerobot.calibration_file import MotorFile
from armcal_lerobot.motors import Units, is_gripper
from armcal_lerobot.recordings import ACTION, STATE, Frames, Recording

MOST_FRAMES = 100_000
"""Of a larger data set every second, third, ... episode is taken, so that memory stays bounded."""
_START_FRAMES = 5
_FEWEST = 10
_MOST_PERCENT = 105.0
_RADIANS_MOVED = 0.5
"""An arm whose joints all stay within pi, and that moves by so much: in degrees it would hardly move at all."""


@dataclass(frozen=True)
class Stretch:
    """Frames of one episode without a gap: commands and states (N x motors), in degrees where these are known."""

    episode: int
    commanded: Array
    reached: Array


@dataclass(frozen=True)
class Motion:
    """A data set's motion.

    Attributes:
        motors: in the order of the columns.
        units: of each motor's numbers: deg or %.
        fps: frames a second.
        stretches: without gaps.
        frames: how many were taken.
        of: how many there are.
    """

    motors: tuple[str, ...]
    units: tuple[str, ...]
    fps: float
    stretches: tuple[Stretch, ...]
    frames: int
    of: int

    @property
    def starts(self) -> Array:
        first: dict[int, Array] = {}
        for stretch in self.stretches:
            first.setdefault(stretch.episode, np.median(stretch.reached[:_START_FRAMES], axis=0))
        return np.array(list(first.values()))

    def reached_degrees(self) -> dict[str, Array]:
        """States (N) of every motor, deg; of a gripper in percent as they are."""
        states = np.concatenate([stretch.reached for stretch in self.stretches])
        return {name: states[:, i] for i, name in enumerate(self.motors)}


def read_motion(recording: Recording, units: Units, file: MotorFile | None) -> Motion:
    """Commands and states of a data set.

    Args:
        recording: the data set.
        units: of its numbers; the gripper's are always percent.
        file: the follower's calibration, which percent needs to become degrees.

    Raises:
        DataError: it is damaged, or holds too little.
        InputError: the calibration lacks a motor.
    """
    motors = recording.motors
    factors, shown = zip(*(unit_of(name, units, file) for name in motors), strict=True)
    step = max(1, math.ceil(recording.frames / MOST_FRAMES))
    stretches, taken = [], 0
    columns: list[tuple[NDArray[np.int64], NDArray[np.int64], Array, Array]] = []
    for frames in recording.read((ACTION, STATE)):
        require_percent(frames, recording, units)
        keep = frames.episode % step == 0
        if keep.any() and taken < MOST_FRAMES:
            some = frames.chosen(keep)
            columns.append((some.episode, some.frame, some.vectors[ACTION], some.vectors[STATE]))
            taken += len(some)
    if taken < _FEWEST:
        where = Location(str(recording.folder))
        raise DataError(f"found {taken} frames, expected at least {_FEWEST}.", where=where, hint="Record more.")
    episode, frame, action, state = (np.concatenate(parts) for parts in zip(*columns, strict=True))
    require_degrees(recording, units, state.min(axis=0), state.max(axis=0))
    gaps = np.flatnonzero((np.diff(episode) != 0) | (np.diff(frame) != 1)) + 1
    scale = np.array(factors)
    for start, end in pairwise([0, *gaps.tolist(), len(episode)]):
        if end - start >= _FEWEST:
            stretches.append(Stretch(int(episode[start]), action[start:end] * scale, state[start:end] * scale))
    if not stretches:
        where = Location(str(recording.folder), field="frame_index")
        text = f"found no {_FEWEST} frames in a row of one episode."
        raise DataError(text, where=where, hint="Record episodes without gaps.")
    return Motion(motors, shown, recording.fps, tuple(stretches), taken, recording.frames)


def require_percent(frames: Frames, recording: Recording, units: Units) -> None:
    """Raise DataError if states that should be percent are more than their ranges let them be."""
    beyond = np.argwhere(np.abs(frames.vectors[STATE]) > _MOST_PERCENT)
    if units == "percent" and len(beyond):
        row, column = beyond[0]
        text = f"found {frames.vectors[STATE][row, column]:.1f} of {recording.motors[column]}, expected percent."
        hint = "Its numbers are degrees: leave --units percent out."
        raise DataError(text, where=Location(str(frames.file), field=STATE), hint=hint)


def require_degrees(recording: Recording, units: Units, lowest: Array, highest: Array) -> None:
    """Raise DataError if states that should be degrees look like radians, by their ends (motors)."""
    turning = [i for i, name in enumerate(recording.motors) if not is_gripper(name)]
    low, high = lowest[turning], highest[turning]
    widest = float(np.max(high - low, initial=0.0))
    if units == "degrees" and widest > _RADIANS_MOVED and np.max(np.abs([low, high])) <= np.pi:
        text = f"found {low.min():.2f} to {high.max():.2f} in all joints, expected degrees: they look like radians."
        hint = "Multiply joint states and actions by 57.29578, as LeRobot records degrees or percent."
        raise DataError(text, where=Location(str(recording.folder), field=STATE), hint=hint)


def require_motors(file: MotorFile, motors: Sequence[str]) -> None:
    """Raise InputError if a calibration file lacks one of the motors."""
    missing = [name for name in motors if name not in file.motors]
    if missing:
        text = f"found no motor {missing[0]}; it has {', '.join(file.motors)}."
        hint = "Give the calibration file of the arm that the data set was recorded with."
        raise InputError(text, where=Location(str(file.path)), hint=hint)


def unit_of(name: str, units: Units, file: MotorFile | None) -> tuple[float, str]:
    """What turns a motor's numbers into degrees, and the unit that they then have."""
    if is_gripper(name) or (units == "percent" and file is None):
        return 1.0, "%"
    if units == "degrees" or file is None:
        return 1.0, "deg"
    require_motors(file, [name])
    return file.motors[name].degrees_in(units), "deg"
