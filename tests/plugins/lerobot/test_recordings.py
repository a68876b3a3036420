"""LeRobot's data sets, v2.1 and v3: the same numbers from both, and every damage named with its file."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from armcal.errors import DataError, PluginError

pytest.importorskip("pyarrow")
import pyarrow as pa
import pyarrow.parquet as pq
from armcal_lerobot.recordings import STATE, Recording, open_recording

from tests.plugins.lerobot.planted import MOTORS, episodes, write_dataset

VERSIONS = ("v2.1", "v3.0")


@pytest.fixture(params=VERSIONS)
def folder(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    return write_dataset(tmp_path / "data_set", episodes(count=3, frames=60), request.param)


def files(folder: Path) -> list[Path]:
    return sorted((folder / "data").rglob("*.parquet"))


def rewritten(path: Path, **columns: object) -> None:
    table = pq.read_table(path)
    for name, values in columns.items():
        place = table.schema.get_field_index(name)
        table = table.remove_column(place) if values is None else table.set_column(place, name, values)
    pq.write_table(table, path)


def all_of(recording: Recording) -> list:
    return list(recording.stretches)


@pytest.mark.parametrize("version", VERSIONS)
def test_numbers_are_those_that_were_recorded(tmp_path: Path, version: str) -> None:
    made = episodes(count=3, frames=5000)
    recording = open_recording(write_dataset(tmp_path / "set", made, version))
    assert recording.motors == MOTORS and recording.fps == 30
    read = all_of(recording)
    assert [stretch.episode for stretch in read] == [0, 1, 2]
    for stretch, (action, state) in zip(read, made, strict=True):
        np.testing.assert_allclose(stretch.commanded, action, atol=1e-4)
        np.testing.assert_allclose(stretch.reached, state, atol=1e-4)


def test_a_gap_ends_a_stretch(folder: Path) -> None:
    path = files(folder)[0]
    frames = pq.read_table(path).num_rows
    table = pq.read_table(path).take([row for row in range(frames) if not 20 <= row < 25])
    pq.write_table(table, path)
    info = folder / "meta" / "info.json"
    info.write_text(info.read_text().replace('"total_frames": 180', '"total_frames": 175'))
    stretches = open_recording(folder).stretches
    assert [(s.episode, int(s.frame[0]), len(s.frame)) for s in stretches][:2] == [(0, 0, 20), (0, 25, 35)]


def test_a_file_that_was_cut_off_is_named(folder: Path) -> None:
    path = files(folder)[-1]
    path.write_bytes(path.read_bytes()[:-300])
    with pytest.raises(DataError, match=rf"{path.name}: it is damaged or cut off"):
        all_of(open_recording(folder))


def test_a_file_damaged_inside_is_named(folder: Path) -> None:
    path = files(folder)[0]
    content = bytearray(path.read_bytes())
    content[4:200] = bytes(196)
    path.write_bytes(content)
    with pytest.raises(DataError, match=path.name):
        all_of(open_recording(folder))


def test_a_missing_column_is_named(folder: Path) -> None:
    rewritten(files(folder)[0], **{STATE: None})
    with pytest.raises(DataError, match=rf"{files(folder)[0].name}, {STATE}: found no column"):
        all_of(open_recording(folder))


@pytest.mark.parametrize("wrong", [[0.0] * 5, [0.0] * 5 + [float("nan")], None])
def test_rows_without_the_numbers_of_all_motors_are_refused(folder: Path, wrong: list | None) -> None:
    path = files(folder)[0]
    rows = pq.read_table(path).num_rows
    rewritten(path, action=pa.array([[0.0] * 6] * (rows - 1) + [wrong]))
    with pytest.raises(DataError, match=rf"{path.name}, action: .* expected 6 in each row"):
        all_of(open_recording(folder))
    rewritten(path, action=pa.array(["x"] * rows))
    with pytest.raises(DataError, match="expected 6 in each row"):
        all_of(open_recording(folder))


def test_missing_frames_are_named(folder: Path) -> None:
    path = files(folder)[0]
    pq.write_table(pq.read_table(path).slice(0, 50), path)
    with pytest.raises(DataError, match=r"found \d+ frames, expected 180 \(meta/info\.json\)"):
        all_of(open_recording(folder))
    for file in files(folder):
        file.unlink()
    with pytest.raises(DataError, match=r"found 0 frames, expected 180"):
        all_of(open_recording(folder))


@pytest.mark.parametrize(
    ("changed", "text"),
    [
        ({"codebase_version": "v1.6"}, "expected v2.1 or v3.0"),
        ({"fps": "30"}, "found fps '30' and total_frames"),
        ({"total_frames": 10**30}, "and total_frames 1000"),
        ({"total_frames": 0}, "and total_frames 0, expected numbers from 1"),
        ({"features": []}, "found no feature observation.state"),
        ({"features": {"action": 3, "observation.state": [1]}}, "found no feature observation.state"),
        ({"features": {"observation.state": {"dtype": "float32", "shape": ["x"]}}}, "found no feature observation"),
        ({"features": {"action": {"dtype": "float32", "shape": [6]}}}, "found no feature observation.state"),
    ],
)
def test_meta_data_that_cannot_be_used_are_refused(folder: Path, changed: dict, text: str) -> None:
    path = folder / "meta" / "info.json"
    path.write_text(json.dumps({**json.loads(path.read_text()), **changed}))
    with pytest.raises(DataError, match=text):
        open_recording(folder)
    path.write_text("{")
    with pytest.raises(DataError, match="it is not JSON"):
        open_recording(folder)


def test_actions_of_other_motors_are_refused(folder: Path) -> None:
    path = folder / "meta" / "info.json"
    info = json.loads(path.read_text())
    info["features"]["action"]["names"] = ["x", "y", "z", "roll", "pitch", "yaw"]
    path.write_text(json.dumps(info))
    with pytest.raises(DataError, match="expected the same motors"):
        open_recording(folder)


def test_without_pyarrow_one_sentence(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "pyarrow.parquet", None)
    with pytest.raises(PluginError, match=r"needs the library pyarrow.*pip install 'armcal\[lerobot\]'"):
        all_of(open_recording(folder))
