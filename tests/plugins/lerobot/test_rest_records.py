"""Rests of a data set: where they were planted, with the image of that moment."""

from __future__ import annotations

import csv
from pathlib import Path

import numpy as np
import pytest
from armcal.errors import DataError, InputError
from click.testing import CliRunner

pytest.importorskip("pyarrow")
from armcal_lerobot.command import lerobot
from armcal_lerobot.motor_files import read_motors
from armcal_lerobot.recordings import open_recording, records_of

from tests.plugins.lerobot.planted import FPS, MOTORS, write_dataset, write_motors

CAMERA = "observation.images.front"
PLACES = ((10.0, -20.0), (-30.0, 15.0), (40.0, 5.0))
"""Angles of the first two motors at rest."""


def with_rests(episodes: int = 2) -> list[tuple[np.ndarray, np.ndarray]]:
    """Each episode rests 30 frames at every place, and moves 20 frames to the next."""
    made = []
    for number in range(episodes):
        action, at = [], np.zeros(6)
        for place in PLACES:
            to = np.array([*place, 0, 0, 0, 50]) + number
            action += [at + (to - at) * k / 20 for k in range(20)] + [to] * 30
            at = to
        values = np.array(action)
        made.append(
            (values, values + np.random.default_rng(number).normal(0, 0.02, values.shape) + [1.5, 0, 0, 0, 0, 0])
        )
    return made


def rows_of(path: Path) -> list[dict[str, str]]:
    with path.open() as stream:
        return list(csv.DictReader(stream))


def called(*arguments: object) -> str:
    return CliRunner().invoke(lerobot, ["rests", *map(str, arguments)], catch_exceptions=False).output


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_rests_are_found_with_the_side_they_came_from(tmp_path: Path, version: str) -> None:
    data, out = write_dataset(tmp_path / "set", with_rests(), version), tmp_path / "rests.csv"
    called(data, "--out", out, "--joint", "shoulder_lift=-q2")
    rows = rows_of(out)
    assert [row["pose_id"].split("_")[0] for row in rows] == ["e000000"] * 3 + ["e000001"] * 3
    pan, lift = (np.array([float(row[name]) for row in rows]) for name in ("shoulder_pan_deg", "q2_deg"))
    np.testing.assert_allclose(pan, [p + n + 1.5 for n in (0, 1) for p, _ in PLACES], atol=0.03)
    np.testing.assert_allclose(lift, [-(q + n) for n in (0, 1) for _, q in PLACES], atol=0.03)
    assert [row["approach_shoulder_pan"] for row in rows] == ["1", "-1", "1"] * 2
    assert [row["approach_q2"] for row in rows] == ["1", "-1", "1"] * 2  # counts and joint turn opposite ways
    called(data, "--out", out, "--angles", "action")
    assert float(rows_of(out)[0]["shoulder_pan_deg"]) == pytest.approx(10.0)


def test_percent_becomes_degrees_by_the_file(tmp_path: Path) -> None:
    data, file = write_dataset(tmp_path / "set", with_rests(1)), read_motors(write_motors(tmp_path / "arm.json"))
    records = records_of(open_recording(data, "percent", file), "action", 0.5, 0.5)
    assert records[0].degrees[MOTORS.index("shoulder_pan")] == pytest.approx(10 * 1137.5 * 360 / 4095 / 100)
    with pytest.raises(InputError, match="percent"):
        open_recording(data, "percent")


def test_no_rest_is_refused(tmp_path: Path) -> None:
    recording = open_recording(write_dataset(tmp_path / "set", with_rests(1)))
    with pytest.raises(DataError, match=r"found no 5 s in which no motor moved by more than 0.5 deg"):
        records_of(recording, "state", 5.0, 0.5)


@pytest.mark.parametrize("version", ["v2.1", "v3.0"])
def test_images_are_of_the_rests(tmp_path: Path, version: str) -> None:
    """Each frame of the video is as bright as its number says."""
    cv2 = pytest.importorskip("cv2")
    made = with_rests()
    data = write_dataset(tmp_path / "set", made, version)
    starts = [0, 0] if version == "v2.1" else [0, len(made[0][0])]
    names = ["episode_000000", "episode_000001"] if version == "v2.1" else ["file-000"]
    place = data / "videos" / ("chunk-000/" + CAMERA if version == "v2.1" else CAMERA + "/chunk-000")
    place.mkdir(parents=True)
    count = 150 if version == "v2.1" else 300
    for name in names:
        video = cv2.VideoWriter(str(place / f"{name}.mp4"), cv2.VideoWriter_fourcc(*"mp4v"), FPS, (64, 48))
        for number in range(count):
            video.write(np.full((48, 64, 3), 20 + number % 50 * 4, np.uint8))
        video.release()
    called(data, "--out", tmp_path / "rests.csv", "--camera", CAMERA, "--images", tmp_path / "images")
    for row in rows_of(tmp_path / "rests.csv"):
        episode, frame = (int(part[1:]) for part in row["pose_id"].split("_"))
        image = cv2.imread(str(tmp_path / "images" / row["image"]))
        assert image.mean() == pytest.approx(20 + (frame + starts[episode]) % 50 * 4, abs=6)
    for path in place.glob("*.mp4"):
        path.write_bytes(path.read_bytes()[:2000])
    with pytest.raises(DataError, match=r"mp4: it ends or is damaged before frame"):
        called(data, "--out", tmp_path / "rests.csv", "--camera", CAMERA, "--images", tmp_path / "images")
    with pytest.raises(DataError, match="side"):
        called(data, "--out", tmp_path / "rests.csv", "--camera", "observation.images.side", "--images", tmp_path / "i")


def test_wrong_joints_and_units_are_refused(tmp_path: Path) -> None:
    made = [(3 * action, 3 * state) for action, state in with_rests(1)]
    data, file = write_dataset(tmp_path / "set", made), write_motors(tmp_path / "arm.json")
    for joint, message in (
        ("elbow_flx=-elbow_flex", "found --joint 'elbow_flx=-elbow_flex'"),
        ("elbow_flex=shoulder_pan", "twice"),
    ):
        with pytest.raises(InputError, match=message):
            called(data, "--out", tmp_path / "rests.csv", "--joint", joint)
    radians = write_dataset(tmp_path / "radians", [(np.radians(a), np.radians(s)) for a, s in with_rests(1)])
    with pytest.raises(DataError, match="they look like radians"):
        called(radians, "--out", tmp_path / "rests.csv")
    with pytest.raises(DataError, match="they look like radians"):
        open_recording(radians)
    with pytest.raises(DataError, match="expected percent"):
        called(data, "--out", tmp_path / "rests.csv", "--units", "percent", "--calibration", file)


def test_states_that_were_copied_from_commands_are_named(tmp_path: Path) -> None:
    made, out = with_rests(1), tmp_path / "rests.csv"
    same = write_dataset(tmp_path / "same", [(state, state) for _, state in made])
    assert "every state is a command" in called(same, "--out", out)
    late = write_dataset(tmp_path / "late", [(np.r_[state[1:], state[-1:]], state) for _, state in made])
    assert "every state is a command" in called(late, "--out", out)
    assert "every state" not in called(write_dataset(tmp_path / "set", made), "--out", out)
