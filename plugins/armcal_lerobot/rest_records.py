"""Where an arm stood at rest in a data set, as records to calibrate from, and a camera's images of these moments."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, InputError, Location
from armcal.io.cells import csv_text
from armcal.io.file_set import write_over
from armcal.measure.rests import StillSettings, rests
from armcal.plugins import library

from armcal_lerobot.calibration_file import MotorFile
from armcal_lerobot.gripper import Follows, require_single
from armcal_lerobot.motion import require_degrees, require_percent, unit_of
from armcal_lerobot.motors import Units, is_gripper
from armcal_lerobot.recordings import ACTION, STATE, Frames, Recording
from armcal_lerobot.tracking import sides

_DEG = np.pi / 180


@dataclass(frozen=True)
class RestRecord:
    """A rest: its episode, its middle frame, the motors' mean angles (deg) and the sides they came from (-1, 0, 1)."""

    episode: int
    frame: int
    degrees: Array
    approach: Array

    @property
    def name(self) -> str:
        return f"e{self.episode:06d}_f{self.frame:06d}"


def records_of(
    recording: Recording,
    units: Units,
    file: MotorFile | None,
    angles: Literal["state", "action"],
    window_s: float,
    spread_deg: float,
) -> list[RestRecord]:
    """All rests of all episodes, in order.

    Raises:
        DataError: the data set is damaged, or no rest is in it.
        InputError: percent without a calibration file, or no length of time.
    """
    if not (window_s > 0 and spread_deg > 0):
        raise InputError("found a window or spread of zero or less.", hint="Give --window-s and --spread-deg above 0.")
    if units == "percent" and file is None:
        raise InputError("found numbers in percent, expected degrees.", hint="Give --calibration FILE as well.")
    factors = np.array([unit_of(name, units, file)[0] for name in recording.motors])
    still = StillSettings.si(window=window_s, spread=spread_deg * _DEG)
    records = []
    lowest, highest = np.full(len(factors), np.inf), np.full(len(factors), -np.inf)
    for frames in _episodes(recording):
        require_percent(frames, recording, units)
        lowest = np.minimum(lowest, frames.vectors[STATE].min(axis=0))
        highest = np.maximum(highest, frames.vectors[STATE].max(axis=0))
        shown = frames.vectors[STATE if angles == "state" else ACTION] * factors
        moved = np.column_stack([sides(column)[0] for column in (frames.vectors[ACTION] * factors).T])
        turning = [i for i, name in enumerate(recording.motors) if not is_gripper(name)]
        for rest in rests(shown.T[turning] * _DEG, [], frames.time, still):
            part, middle = slice(rest.start, rest.stop), (rest.start + rest.stop) // 2
            records.append(
                RestRecord(
                    int(frames.episode[0]), int(frames.frame[middle]), shown[part].mean(axis=0), moved[rest.stop - 1]
                )
            )
    require_degrees(recording, units, lowest, highest)
    if not records:
        text = f"found no {window_s:g} s in which no motor moved by more than {spread_deg:g} deg."
        raise DataError(text, where=Location(str(recording.folder)), hint="Give another --window-s or --spread-deg.")
    return records


def write_records(
    out: Path, motors: Sequence[str], records: Sequence[RestRecord], wiring: Mapping[str, Follows], has_images: bool
) -> None:
    """Write a CSV: pose_id, angles and approaches of every joint but the gripper's, and the image's name.

    Raises:
        InputError: the wiring names no motor of these, or a joint twice.
    """
    unknown = [name for name in wiring if name not in motors]
    if unknown:
        hint = f"Its motors are {', '.join(motors)}: --joint MOTOR=JOINT."
        raise InputError(f"found no motor {unknown[0]!r} in the data set.", hint=hint)
    require_single([wiring.get(name, Follows(name)).joint for name in motors])
    turned = [(i, wiring.get(name, Follows(name))) for i, name in enumerate(motors) if not is_gripper(name)]
    columns = [name for _, follows in turned for name in (f"{follows.joint}_deg", f"approach_{follows.joint}")]
    rows: list[list[object]] = [["pose_id", *columns, *(["image"] if has_images else [])]]
    for record in records:
        row: list[object] = [record.name]
        for i, follows in turned:
            row += [float(follows.sense * record.degrees[i]), int(follows.sense * record.approach[i])]
        rows.append([*row, f"{record.name}.png"] if has_images else row)
    write_over({out: csv_text(rows, ".4f").encode()})


def write_images(recording: Recording, camera: str, records: Sequence[RestRecord], folder: Path) -> None:
    """Write a camera's image of each rest as PNG.

    Raises:
        DataError: a video is missing, or ends before a rest.
        PluginError: OpenCV is not installed.
    """
    cv2 = library("cv2", "reading videos")
    by_video: dict[Path, list[tuple[int, RestRecord]]] = {}
    for record in records:
        path, first = recording.video(camera, record.episode)
        by_video.setdefault(path, []).append((first + record.frame, record))
    folder.mkdir(parents=True, exist_ok=True)
    for path, places in by_video.items():
        capture, at = cv2.VideoCapture(str(path)), 0
        try:
            for place, record in sorted(places, key=lambda pair: pair[0]):
                while at < place and capture.grab():
                    at += 1
                there, image = capture.read()
                if not there:
                    text = f"it ends or is damaged before frame {place}, expected an image there."
                    raise DataError(text, where=Location(str(path)), hint="Take the video again, whole.")
                at += 1
                write_over({folder / f"{record.name}.png": cv2.imencode(".png", image)[1].tobytes()})
        finally:
            capture.release()


def _episodes(recording: Recording) -> Iterator[Frames]:
    """The frames of one episode after another; only one is held at a time."""
    held: list[Frames] = []
    for frames in recording.read((ACTION, STATE)):
        edges = np.flatnonzero(np.diff(frames.episode)) + 1
        for start, end in zip([0, *edges], [*edges, len(frames)], strict=True):
            part = frames.chosen(slice(start, end))
            if held and held[0].episode[0] != part.episode[0]:
                yield _joined(held)
                held = []
            held.append(part)
    if held:
        yield _joined(held)


def _joined(parts: Sequence[Frames]) -> Frames:
    episode, frame, time = (np.concatenate([getattr(p, name) for p in parts]) for name in ("episode", "frame", "time"))
    vectors = {name: np.concatenate([p.vectors[name] for p in parts]) for name in parts[0].vectors}
    return Frames(parts[0].file, episode, frame, time, vectors)
