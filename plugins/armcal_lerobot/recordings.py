"""LeRobot's data sets, v2.1 and v3; and where the arm stood at rest in them, as records to calibrate from, with a
camera's images of these moments.
"""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, InputError, Location
from armcal.io.plain_files import write_over
from armcal.measure.rests import StillSettings, last_motions, rests
from armcal.measure.tables import csv_text
from armcal.plugins import library

from armcal_lerobot.motor_files import MotorFile, Units, is_gripper, read_json, require_motors, wiring_of

STATE, ACTION = "observation.state", "action"
_MAX_META = 64 << 20
_ROWS_AT_ONCE = 4096
_MOST_FRAMES = 5_000_000  # 46 hours at 30 frames a second: they are in memory at once
_VERSIONS = ("v2.0", "v2.1", "v3.")
_WHOLE = "Take it whole from where it was recorded."
_MOST_PERCENT = 105.0
_REVERSAL_DEG = 0.35  # A command that comes back by less has not reversed; a servo's count is 0.09 deg
_RADIANS_MOVED = 0.5  # An arm whose joints all stay within pi, and that moves by so much: in degrees it hardly moves


@dataclass(frozen=True)
class Stretch:
    """Frames of one episode without a gap: place in it (N), time (N, s), commands and states (N x motors)."""

    episode: int
    frame: Array
    time: Array
    commanded: Array
    reached: Array


@dataclass(frozen=True)
class Recording:
    """A data set, read whole."""

    folder: Path  # with ``meta`` and ``data``
    version: str  # as stated, such as v2.1
    fps: float  # frames a second
    motors: tuple[str, ...]  # in the order of the numbers, which are deg (the gripper's %)
    stretches: tuple[Stretch, ...]  # in order

    def video(self, camera: str, episode: int) -> tuple[Path, int]:
        """A camera's video of an episode, and the frame in it at which the episode begins."""
        videos, first = self.folder / "videos", 0
        path = next(videos.glob(f"chunk-*/{camera}/episode_{episode:06d}.mp4"), videos / camera)
        if self.version.startswith("v3"):
            columns = tuple(f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp"))
            for file in sorted((self.folder / "meta" / "episodes").glob("chunk-*/*.parquet")):
                with _parquet(file) as table:
                    rows = table.read(["episode_index", *columns], use_threads=False).to_pylist()
                for row in (row for row in rows if row.get("episode_index") == episode and columns[0] in row):
                    chunk, number, start = (row[name] for name in columns)
                    path = videos / camera / f"chunk-{int(chunk):03d}" / f"file-{int(number):03d}.mp4"
                    first = round(float(start) * self.fps)
        if not path.is_file():
            hint = "Name a camera of the data set, or take its videos too."
            raise DataError(f"found no video of {camera}, episode {episode}.", where=Location(str(path)), hint=hint)
        return path, first


def open_recording(folder: Path, stored: Units = "degrees", file: MotorFile | None = None) -> Recording:
    """A data set whose numbers are in a unit (the gripper's always in percent); the file is the follower's."""
    if stored == "percent" and file is None:
        raise InputError("found numbers in percent, expected degrees.", hint="Give --calibration FILE as well.")
    path = folder / "meta" / "info.json"
    where = Location(str(path))
    info = read_json(path, _MAX_META, "a LeRobot data set's meta/info.json", "Give the folder with meta and data.")[1]
    info = info if isinstance(info, dict) else {}
    version, fps, frames = (info.get(key) for key in ("codebase_version", "fps", "total_frames"))
    if not str(version).startswith(_VERSIONS):
        text = f"found codebase_version {str(version)[:20]!r}, expected v2.1 or v3.0."
        raise DataError(text, where=where, hint="Convert it with LeRobot's own scripts.")
    if not (
        isinstance(fps, int | float) and 1 <= fps <= 10_000 and isinstance(frames, int) and 1 <= frames <= _MOST_FRAMES
    ):
        most = f"at most {_MOST_FRAMES:,} frames"
        text = f"found fps {fps!r} and total_frames {frames!r}, expected numbers from 1, and {most}."
        raise DataError(text, where=where, hint=_WHOLE)
    state, action = (_motors(info.get("features"), feature, where) for feature in (STATE, ACTION))
    if state != action:
        text = f"found {', '.join(action)} in {ACTION} and {', '.join(state)} in {STATE}, expected the same motors."
        raise DataError(text, where=where, hint="Only joint actions can be compared with joint states.")
    rows = _rows(folder, frames, len(state))
    _require_unit(folder, rows[:, -len(state) :], [not is_gripper(name) for name in state], stored)
    scale = np.ones(len(state))
    if file is not None:
        require_motors(file, state)
        scale = np.array([1.0 if is_gripper(motor) else file.motors[motor].degrees_in(stored) for motor in state])
    return Recording(folder, str(version), float(fps), state, tuple(_stretches(rows, scale)))


def _motors(features: Any, feature: str, where: Location) -> tuple[str, ...]:
    """The names of a feature's motors: shoulder_pan.pos and main_shoulder_pan are shoulder_pan."""
    about = features.get(feature) if isinstance(features, dict) else None
    names = about.get("names") if isinstance(about, dict) else None
    names = next(iter(names.values()), None) if isinstance(names, dict) else names
    if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
        hint = "Only data sets of arms whose joints were recorded can be used."
        raise DataError(f"found no feature {feature} with the names of motors.", where=where, hint=hint)
    return tuple(name.removesuffix(".pos").removeprefix("main_") for name in names)


def _rows(folder: Path, frames: int, motors: int) -> Array:
    """All frames as stored (N x (3 + 2 motors)): episode, place in it, time, commands, states."""
    widths = {"episode_index": 1, "frame_index": 1, "timestamp": 1, ACTION: motors, STATE: motors}
    paths = sorted((folder / "data").glob("chunk-*/*.parquet"))
    count, rows = 0, [np.empty((0, sum(widths.values())))]
    for path in paths:
        with _parquet(path) as table:
            if (count := count + table.metadata.num_rows) <= frames:
                for batch in table.iter_batches(batch_size=_ROWS_AT_ONCE, columns=[*widths], use_threads=False):
                    rows.append(np.hstack([_numbers(path, batch, name, width) for name, width in widths.items()]))
    if count != frames:
        text = f"found {count} frames, expected {frames} (meta/info.json)."
        raise DataError(text, where=Location(str(folder / "data")), hint=_WHOLE)
    return np.vstack(rows)


def _numbers(path: Path, batch: Any, name: str, width: int) -> Array:
    """A column of numbers, or of lists of numbers (N x width)."""
    try:
        values = np.array(batch.column(name).to_pylist(), dtype=float).reshape(batch.num_rows, width)
    except (KeyError, TypeError, ValueError):  # there is no such column, or no number in it
        values = np.full((1, 1), np.nan)
    if not np.isfinite(values).all():
        text = f"found no column, or a row without finite numbers, expected {width} in each row (meta/info.json)."
        raise DataError(text, where=Location(str(path), field=name), hint="Leave that episode out.")
    return values


def _require_unit(folder: Path, states: Array, turning: Sequence[bool], stored: Units) -> None:
    """Refuse states (N x motors) that are degrees in place of percent, or radians in place of degrees."""
    where = Location(str(folder), field=STATE)
    if stored == "percent" and np.abs(states).max() > _MOST_PERCENT:
        hint = "Its numbers are degrees: leave --units percent out."
        raise DataError(f"found {np.abs(states).max():.1f}, expected percent.", where=where, hint=hint)
    joints = states[:, turning]
    if stored == "degrees" and np.ptp(joints, axis=0).max() > _RADIANS_MOVED and np.abs(joints).max() <= np.pi:
        span = f"{joints.min():.2f} to {joints.max():.2f}"
        text = f"found {span} in all joints, expected degrees: they look like radians."
        hint = "Multiply joint states and actions by 57.29578, as LeRobot records degrees or percent."
        raise DataError(text, where=where, hint=hint)


def _stretches(rows: Array, scale: Array) -> Iterator[Stretch]:
    behind = np.arange(len(rows)) - rows[:, 1]  # a place in the data set less that in the episode: alike without a gap
    cuts = np.flatnonzero((np.diff(behind) != 0) | (np.diff(rows[:, 0]) != 0)) + 1
    for part in np.split(rows, cuts):
        commanded, reached = np.split(part[:, 3:], 2, axis=1)
        yield Stretch(int(part[0, 0]), part[:, 1], part[:, 2], commanded * scale, reached * scale)


@contextmanager
def _parquet(path: Path) -> Iterator[Any]:
    parquet = library("pyarrow.parquet", "reading LeRobot's data sets")
    try:
        with parquet.ParquetFile(path, memory_map=True) as table:
            yield table
    except (OSError, ValueError) as fault:  # pyarrow's own errors derive from these
        reason = (str(fault) or type(fault).__name__).splitlines()[0][:120]
        raise DataError(f"it is damaged or cut off ({reason}).", where=Location(str(path)), hint=_WHOLE) from fault


def is_copy(recording: Recording) -> bool:
    """Whether states are the commands of the same frame, or of the one before."""
    frames = [(s.commanded, s.reached) for s in recording.stretches if np.ptp(s.reached, axis=0).any()]
    return bool(frames) and (
        all(np.array_equal(command, state) for command, state in frames)
        or all(np.array_equal(command[:-1], state[1:]) for command, state in frames)
    )


@dataclass(frozen=True)
class RestRecord:
    """A rest: its episode, its middle frame, the motors' mean angles (deg) and the sides they came from (-1, 0, 1)."""

    episode: int
    frame: int
    degrees: Array  # of all motors but the gripper's
    approach: Array

    @property
    def name(self) -> str:
        return f"e{self.episode:06d}_f{self.frame:06d}"


def records_of(recording: Recording, angles: str, window_s: float, spread_deg: float) -> list[RestRecord]:
    """All rests of all episodes, in order: ``angles`` are those of the ``state``, or those of the ``action``."""
    turning = [not is_gripper(name) for name in recording.motors]
    still = StillSettings.si(window=window_s, spread=np.radians(spread_deg))
    records = []
    for stretch in recording.stretches:
        shown = (stretch.commanded if angles == "action" else stretch.reached)[:, turning]
        approach = np.column_stack(
            [last_motions(command, _REVERSAL_DEG) for command in stretch.commanded[:, turning].T]
        )
        for rest in rests(np.radians(shown.T), [], stretch.time, still):
            frame, mean = int(stretch.frame[(rest.start + rest.stop) // 2]), shown[rest.start : rest.stop].mean(axis=0)
            records.append(RestRecord(stretch.episode, frame, mean, approach[rest.stop - 1]))
    if not records:
        text = f"found no {window_s:g} s in which no motor moved by more than {spread_deg:g} deg."
        raise DataError(text, where=Location(str(recording.folder)), hint="Give another --window-s or --spread-deg.")
    return records


def write_records(
    out: Path, motors: Sequence[str], records: Sequence[RestRecord], texts: Sequence[str], has_images: bool
) -> None:
    """Write a CSV: pose_id, angles and approaches of every joint but the gripper's, and the image's name."""
    turning = [name for name in motors if not is_gripper(name)]
    stated = {motor: joint.removeprefix("-") for motor, _, joint in (text.partition("=") for text in texts)}
    wiring = wiring_of([stated.get(name, name) for name in turning], turning, texts)
    columns = [(joint, turning.index(motor), sense) for joint, (motor, sense) in wiring.items()]
    headings = [heading for joint, *_ in columns for heading in (f"{joint}_deg", f"approach_{joint}")]
    rows: list[list[object]] = [["pose_id", *headings, *["image"] * has_images]]
    for record in records:
        row: list[object] = [record.name]
        for _, place, sense in columns:
            row += [float(sense * record.degrees[place]), int(sense * record.approach[place])]
        rows.append([*row, *[f"{record.name}.png"] * has_images])
    write_over({out: csv_text(rows, ".4f").encode()})


def write_images(recording: Recording, camera: str, records: Sequence[RestRecord], folder: Path) -> None:
    """Write a camera's image of each rest as PNG."""
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
