"""LeRobot's data sets, v2.1 (a parquet file an episode) and v3 (many episodes a file), read a batch at a time."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, NoReturn

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, Location
from armcal.io.plain_files import input_bytes, text_of
from armcal.plugins import library
from numpy.typing import NDArray

from armcal_lerobot.motor_file import read_json

STATE, ACTION = "observation.state", "action"
_NUMBERS = ("timestamp", "episode_index", "frame_index")
_VECTOR_TYPES = ("float32", "float64", "int64", "int32")
_MAX_META = 64 << 20
_ROWS_AT_ONCE = 4096
_MOST_NUMBERS = 1000
_EPISODE_FILE = re.compile(r"episode_(\d+)\.parquet")
_KNOWN = ("v2.0", "v2.1", "v3.")
_RECORD_AGAIN = "Take the file again from where it was recorded."


@dataclass(frozen=True)
class Frames:
    """Some frames in a row: their file, episode (N), frame in it (N), time (N, s), vectors (N x size) by feature."""

    file: Path
    episode: NDArray[np.int64]
    frame: NDArray[np.int64]
    time: Array
    vectors: Mapping[str, Array]

    def __len__(self) -> int:
        return len(self.time)

    def chosen(self, which: Any) -> Frames:
        """Those of a slice or an index."""
        vectors = {name: values[which] for name, values in self.vectors.items()}
        return Frames(self.file, self.episode[which], self.frame[which], self.time[which], vectors)


@dataclass(frozen=True)
class Recording:
    """A data set on disk."""

    folder: Path  # with ``meta`` and ``data``
    version: str  # as stated, such as v2.1
    fps: float  # frames a second
    frames: int  # how many ``meta/info.json`` states
    names: Mapping[str, tuple[str, ...]]  # of the numbers of each vector feature, such as the motors
    files: tuple[Path, ...]  # parquet files in their order
    lengths: Mapping[int, int] = field(default_factory=dict)  # frames by episode, as far as the meta data state them

    @cached_property
    def motors(self) -> tuple[str, ...]:
        """The motors of the state, which those of the action must be too.

        Raises:
            DataError: the two differ.
        """
        state, action = (tuple(motor_name(name) for name in self.names[part]) for part in (STATE, ACTION))
        if state != action:
            text = f"found {', '.join(action)} in {ACTION} and {', '.join(state)} in {STATE}, expected the same motors."
            raise DataError(
                text, where=_info(self.folder), hint="Only joint actions can be compared with joint states."
            )
        twice = next((name for name in state if state.count(name) > 1), None)
        if twice is not None:
            text = f"found the motor {twice!r} twice, expected it once."
            raise DataError(text, where=_info(self.folder), hint="Correct the names of the features.")
        return state

    def video(self, camera: str, episode: int) -> tuple[Path, int]:
        """A camera's video of an episode, and the frame in it at which the episode begins.

        Raises:
            DataError: there is no such video.
        """
        videos = self.folder / "videos"
        if self.version.startswith("v2"):
            there = sorted(videos.glob(f"chunk-*/{camera}/episode_{episode:06d}.mp4"))
            path, first = (there[0] if there else videos / camera), 0
        else:
            path, first = self._part_of_video(camera, episode)
        if not path.is_file():
            shown = ", ".join(sorted({str(file.parent.relative_to(videos)) for file in videos.rglob("*.mp4")}))
            text = f"found no video of {camera}, episode {episode}; found {shown[:200] or 'none'}."
            raise DataError(text, where=Location(str(path)), hint="Name a camera of the data set, or take its videos.")
        return path, first

    def _part_of_video(self, camera: str, episode: int) -> tuple[Path, int]:
        """Of v3, where a file holds many episodes."""
        columns = tuple(f"videos/{camera}/{name}" for name in ("chunk_index", "file_index", "from_timestamp"))
        for path in sorted((self.folder / "meta" / "episodes").glob("chunk-*/*.parquet")):
            for batch in _batches(path, ("episode_index", *columns)):
                episodes = batch.column("episode_index").to_pylist()
                if episode in episodes:
                    chunk, file, start = (batch.column(name)[episodes.index(episode)].as_py() for name in columns)
                    place = self.folder / "videos" / camera / f"chunk-{int(chunk):03d}" / f"file-{int(file):03d}.mp4"
                    return place, round(float(start) * self.fps)
        return self.folder / "videos" / camera, 0

    def read(self, features: Sequence[str]) -> Iterator[Frames]:
        """All frames, at most 4096 at a time, none of two files.

        Raises:
            DataError: a file is damaged or cut off, a column is missing, or a vector has another length.
        """
        counted: dict[int, int] = {}
        for file in self.files:
            done = 0
            for batch in _batches(file, (*_NUMBERS, *features)):
                numbers = {name: _numbers(batch.column(name), file, name, done) for name in _NUMBERS}
                sizes = {name: len(self.names[name]) for name in features}
                vectors = {name: _vectors(batch.column(name), file, name, sizes[name], done) for name in features}
                done += batch.num_rows
                if not batch.num_rows:
                    continue
                episode, frame = (numbers[name].astype(np.int64) for name in _NUMBERS[1:])
                for one, count in zip(*(part.tolist() for part in np.unique(episode, return_counts=True)), strict=True):
                    counted[one] = counted.get(one, 0) + count
                yield Frames(file, episode, frame, numbers["timestamp"], vectors)
        for one, length in self.lengths.items():
            if counted.get(one, 0) != length:
                text = f"found {counted.get(one, 0)} frames of episode {one}, expected {length} (its meta data)."
                raise DataError(text, where=Location(str(self.folder / "data")), hint=_RECORD_AGAIN)


def open_recording(folder: Path) -> Recording:
    """A data set's meta data and files.

    Raises:
        DataError: it is no data set of LeRobot, of a version that is not known, or files are missing.
        PluginError: pyarrow is not installed.
    """
    where = _info(folder)
    if not folder.is_dir():
        hint = "Give the folder that holds meta and data."
        raise DataError("it is no folder, expected a LeRobot data set.", where=Location(str(folder)), hint=hint)
    _, info = read_json(folder / "meta" / "info.json", _MAX_META, "a LeRobot data set's meta/info.json", _RECORD_AGAIN)
    if not isinstance(info, dict):
        raise DataError("found no object.", where=where, hint=_RECORD_AGAIN)
    version = str(info.get("codebase_version", ""))
    if not version.startswith(_KNOWN):
        text = f"found codebase_version {version[:20]!r}, expected v2.1 or v3.0."
        raise DataError(text, where=where, hint="Convert it with LeRobot's own scripts.")
    fps, frames = (info.get(key) for key in ("fps", "total_frames"))
    if not (isinstance(fps, int | float) and 1 <= fps <= 10_000 and isinstance(frames, int) and 1 <= frames < 1 << 53):
        text = f"found fps {fps!r} and total_frames {frames!r}, expected numbers from 1."
        raise DataError(text, where=where, hint="Take it whole from where it was recorded.")
    names = _vector_names(info, where)
    files = tuple(sorted((folder / "data").glob("chunk-*/*.parquet")))
    if not files:
        text = "found no file data/chunk-*/*.parquet."
        raise DataError(text, where=Location(str(folder)), hint="Give the folder that holds meta and data.")
    lengths = _lengths_of_lines(folder, files) if version.startswith("v2") else _lengths_of_tables(folder)
    return Recording(folder, version, float(fps), frames, names, files, lengths)


def motor_name(name: str) -> str:
    """A motor by the name of its number: ``shoulder_pan.pos`` and ``main_shoulder_pan`` are shoulder_pan."""
    return name.removesuffix(".pos").removeprefix("main_")


def _vector_names(info: Mapping[str, Any], where: Location) -> dict[str, tuple[str, ...]]:
    features = info.get("features")
    if not isinstance(features, dict):
        raise DataError("found no features.", where=where, hint="Take it whole from where it was recorded.")
    names = {}
    for feature, about in features.items():
        about = about if isinstance(about, dict) else {}
        shape, stated = about.get("shape"), about.get("names")
        if str(about.get("dtype")) not in _VECTOR_TYPES or not isinstance(shape, list) or len(shape) != 1:
            continue
        if type(shape[0]) is not int or not 1 <= shape[0] <= _MOST_NUMBERS:
            continue
        listed = next(iter(stated.values()), None) if isinstance(stated, dict) else stated
        listed = listed if isinstance(listed, list) and len(listed) == shape[0] else range(shape[0])
        names[feature] = tuple(map(str, listed))
    for feature in (STATE, ACTION):
        if feature not in names:
            shown = ", ".join(features) or "none"
            text = f"found no feature {feature}, expected it as a vector of numbers; found {shown[:200]}."
            raise DataError(text, where=where, hint="Only data sets of arms whose joints were recorded can be used.")
    return names


def _lengths_of_lines(folder: Path, files: Sequence[Path]) -> dict[int, int]:
    """Of v2: frames by episode; each must have its file."""
    path = folder / "meta" / "episodes.jsonl"
    lengths: dict[int, int] = {}
    lines = text_of(input_bytes(path, _MAX_META, "a list of episodes"), path, "Save it as UTF-8.").splitlines()
    for number, line in enumerate(lines, start=1):
        try:
            entry = json.loads(line) if line.strip() else None
            if entry is not None:
                lengths[int(entry["episode_index"])] = int(entry["length"])
        except (ValueError, KeyError, TypeError, OverflowError) as fault:
            text = "found a line without episode_index and length."
            raise DataError(text, where=Location(str(path), line=number), hint=_RECORD_AGAIN) from fault
    there = {int(match[1]) for file in files if (match := _EPISODE_FILE.fullmatch(file.name))}
    missing = [episode for episode in lengths if episode not in there]
    if missing:
        shown = ", ".join(f"episode_{episode:06d}.parquet" for episode in missing[:3])
        more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
        text = f"found no file {shown}{more}, expected one for each line of meta/episodes.jsonl."
        raise DataError(text, where=Location(str(folder / "data")), hint=_RECORD_AGAIN)
    return lengths


def _lengths_of_tables(folder: Path) -> dict[int, int]:
    lengths: dict[int, int] = {}
    for path in sorted((folder / "meta" / "episodes").glob("chunk-*/*.parquet")):
        for batch in _batches(path, ("episode_index", "length")):
            columns = (batch.column(name).to_pylist() for name in ("episode_index", "length"))
            lengths.update(zip(*columns, strict=True))
    return lengths


def _batches(file: Path, columns: Sequence[str]) -> Iterator[Any]:
    """Rows of a parquet file, some at a time; what the library raises of a damaged one is a DataError with the file."""
    parquet = library("pyarrow.parquet", "reading LeRobot's data sets")
    try:
        with parquet.ParquetFile(file, memory_map=True) as table:
            there = table.schema_arrow.names
            for column in columns:
                if column not in there:
                    hint = "Record the data set again, or take out this file."
                    _refuse(file, column, f"found no column {column}; found {', '.join(there)[:200]}.", hint)
            yield from table.iter_batches(batch_size=_ROWS_AT_ONCE, columns=list(columns), use_threads=False)
    except (OSError, ValueError, KeyError) as fault:  # pyarrow's own errors derive from these
        text = f"it is damaged or cut off ({str(fault).splitlines()[0][:120] if str(fault) else type(fault).__name__})."
        raise DataError(text, where=Location(str(file)), hint=_RECORD_AGAIN) from fault


def _numbers(column: Any, file: Path, name: str, done: int) -> Array:
    values = column.to_numpy(zero_copy_only=False)
    if values.dtype.kind not in "fiu":
        _refuse(file, name, f"found {column.type}, expected numbers.", _RECORD_AGAIN)
    _require_finite(np.asarray(values, dtype=float), file, name, done)
    return np.asarray(values, dtype=float)


def _vectors(column: Any, file: Path, name: str, size: int, done: int) -> Array:
    """A column of lists (N x size)."""
    if column.null_count:
        row = int(np.argmax(column.is_null().to_numpy(zero_copy_only=False)))
        _refuse(file, name, "found nothing, expected a vector.", _RECORD_AGAIN, done + row + 1)
    if size == 1 and not hasattr(column, "flatten"):
        return _numbers(column, file, name, done)[:, None]
    if not hasattr(column.type, "value_type"):
        _refuse(file, name, f"found {column.type}, expected a list of {size} numbers.", _RECORD_AGAIN)
    lengths = np.asarray(column.value_lengths().to_numpy(zero_copy_only=False), dtype=float)
    wrong = np.flatnonzero(lengths != size)
    if len(wrong):
        text = f"found {lengths[wrong[0]]:.0f} numbers, expected {size} as in meta/info.json."
        _refuse(file, name, text, _RECORD_AGAIN, done + int(wrong[0]) + 1)
    values = np.asarray(column.flatten().to_numpy(zero_copy_only=False), dtype=float).reshape(-1, size)
    _require_finite(values, file, name, done)
    return values


def _require_finite(values: Array, file: Path, name: str, done: int) -> None:
    bad = ~np.isfinite(values.reshape(len(values), -1)).all(axis=1)
    if bad.any():
        text = "found a number that is not finite."
        _refuse(file, name, text, "Leave that episode out.", done + int(np.argmax(bad)) + 1)


def _info(folder: Path) -> Location:
    return Location(str(folder / "meta" / "info.json"))


def _refuse(file: Path, column: str, message: str, hint: str, row: int | None = None) -> NoReturn:
    raise DataError(message, where=Location(str(file), field=column, row=row), hint=hint)
