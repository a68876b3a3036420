"""``armcal record --camera``: images from a folder and from a video, kills, and what ``armcal run`` makes of it."""

from __future__ import annotations

import csv
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from armcal.cli.main import cli
from armcal.testing import assert_contract
from armcal_camera.images_reader import LiveImages
from click.testing import CliRunner
from recordings import QUICK, ROOT, GuidedArm, Recording, recorded

DEMO = ROOT / "configs" / "camera" / "demo.yaml"
SIZE = (480, 360)
FREE = ["camera.camera_*", "camera.board_[xyzr]*", "camera.[fc][xy]"]


@dataclass(frozen=True)
class Shots:
    """A configuration, and images with the joint angles at which they were taken."""

    config: Path
    rows: list[dict[str, str]]

    def angles(self, number: int) -> dict[str, float]:
        return {name: float(value) for name, value in self.rows[number].items() if name.endswith("_deg")}

    def image(self, number: int) -> bytes:
        return (self.config.parent / "images" / self.rows[number]["image"]).read_bytes()


@pytest.fixture(scope="module")
def shots(tmp_path_factory: pytest.TempPathFactory) -> Shots:
    """Drawn by the command, of the demo's camera with fewer pixels and a smaller board."""
    folder = tmp_path_factory.mktemp("shots")
    truth = yaml.safe_load((DEMO.parent / "truth.yaml").read_text())
    truth = {name: value for name, value in truth.items() if name.startswith("camera.")}
    truth |= {"camera.fx": "414 px", "camera.fy": "413 px", "camera.cx": "237 px", "camera.cy": "182 px"}
    content = {**yaml.safe_load(DEMO.with_name("arm.yaml").read_text()), **yaml.safe_load(DEMO.read_text())}
    content["measurements"]["camera"] |= {"noise_px": 0.1, "image_px": [*SIZE]}
    content["measurements"]["camera"]["board"] = {"type": "chessboard", "columns": 5, "rows": 4, "square_mm": 40}
    content["simulation"]["poses"]["count"] = 8
    content |= {"data": {"type": "csv", "path": "none.csv"}, "parameters": {"free": FREE}}
    content |= {"validation": {"holdout": 0, "folds": 0}}
    content.pop("extends")
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth))
    (folder / "config.yaml").write_text(yaml.safe_dump(content))
    command = ["simulate", str(folder / "config.yaml"), "--out", str(folder / "poses.csv")]
    done = CliRunner().invoke(cli, [*command, "--images", str(folder / "images")])
    assert done.exit_code == 0, done.output
    with (folder / "poses.csv").open() as file:
        return Shots(folder / "config.yaml", list(csv.DictReader(file)))


@pytest.fixture
def arm() -> Iterator[GuidedArm]:
    guided = GuidedArm()
    yield guided
    guided.close()


@pytest.fixture
def started() -> Iterator[list[Recording]]:
    going: list[Recording] = []
    yield going
    for one in going:
        one.close()


def begun(started: list[Recording], arm: GuidedArm, shots: Shots, out: Path, source: Path, *more: str) -> Recording:
    going = Recording(out, arm.source, "--camera", str(source), *QUICK, *more, config=shots.config)
    started.append(going)
    going.ready()
    return going


@pytest.mark.slow
def test_images_of_a_folder_are_kept_judged_and_read_by_a_run(
    tmp_path: Path, shots: Shots, arm: GuidedArm, started: list[Recording]
) -> None:
    out, incoming = tmp_path / "out", tmp_path / "incoming"
    incoming.mkdir()
    arm.stand(shots.angles(0))
    going = begun(started, arm, shots, out, incoming)
    (incoming / "blank.png").write_bytes(cv2.imencode(".png", np.full(SIZE[::-1], 90, np.uint8))[1].tobytes())
    assert going.told("refused")["sentence"] == "blank.png: the chessboard was not found."
    for number in range(6):
        arm.stand(shots.angles(number))
        if number == 3:
            going.process.kill()  # nothing that was said to be kept is lost
            going.process.wait()
            going = begun(started, arm, shots, out, incoming, "--resume")
        (incoming / f"{number}.png").write_bytes(shots.image(number))
        assert going.told("seen", "refused")["sentence"].startswith(f"{number}.png: 20 of 20 corners, edges ")
        kept = going.told("captured")
        assert kept["posture"]["image"] == f"{number + 1:04d}.png"
        if number == 1:
            assert "Turn the hand about another axis too" in kept["sentence"]
    known = going.told("known")
    assert "its place on the hand is known to" in known["sentence"] and known["fell"] > 0.05
    assert len(going.told("next")["joints"]) == 6
    assert going.finish() == 0
    assert [row["image"] for row in recorded(out)] == [f"{number + 1:04d}.png" for number in range(6)]
    for number in range(6):
        assert (out / "images" / f"{number + 1:04d}.png").read_bytes() == shots.image(number)
    reading = f"data={{type: images, folder: {out / 'images'}, poses: {out / 'dataset.csv'}}}"
    done = CliRunner().invoke(cli, ["run", str(shots.config), "--set", reading, "--out", str(tmp_path / "run")])
    assert done.exit_code == 0, done.output
    written = yaml.safe_load((tmp_path / "run" / "calibration.yaml").read_text())["parameters"]
    found = {p["name"]: p["value"] for p in written}
    assert abs(found["camera.camera_x"] - 0.042) < 0.003 and abs(found["camera.camera_z"] - 0.055) < 0.003


@pytest.mark.slow
def test_a_camera_is_asked_at_a_key_and_looks_without_keeping(
    tmp_path: Path, shots: Shots, arm: GuidedArm, started: list[Recording]
) -> None:
    video = tmp_path / "camera.avi"
    writer = cv2.VideoWriter(str(video), cv2.VideoWriter_fourcc(*"FFV1"), 30, SIZE)
    for number in (0, 1):
        for _ in range(6):  # five of which a driver may hold back
            writer.write(cv2.imdecode(np.frombuffer(shots.image(number), np.uint8), cv2.IMREAD_COLOR))
    writer.release()
    arm.stand(shots.angles(0))
    going = begun(started, arm, shots, tmp_path / "out", video)
    time.sleep(0.2)
    going.type("v")
    assert going.told("seen", "refused")["kept"] is False
    assert going.capture()["posture"]["name"] == "1"
    assert going.capture()["sentence"] == "the camera gave no image: is it still connected?"
    assert going.finish() == 0
    assert len(recorded(tmp_path / "out")) == 1


@pytest.mark.parametrize(
    ("source", "sentence"),
    [
        ("97", "camera 97: no camera opens there, so no images come."),
        ("none.avi", "it is no camera, no video and no fo"),
    ],
)
def test_no_such_camera(tmp_path: Path, shots: Shots, source: str, sentence: str) -> None:
    done = CliRunner().invoke(
        cli,
        [
            "record",
            str(shots.config),
            "--from",
            "-",
            "--capture",
            "still",
            "--camera",
            source,
            "--out",
            str(tmp_path / "o"),
        ],
    )
    assert done.exit_code == 2 and sentence in done.output.replace("\n", " ")


@pytest.mark.slow
def test_no_board_in_twenty_images(tmp_path: Path, shots: Shots, arm: GuidedArm) -> None:
    incoming = tmp_path / "incoming"
    incoming.mkdir()
    arm.stand(shots.angles(0))
    line = [sys.executable, "-m", "armcal.cli", "record", str(shots.config), "--out", str(tmp_path / "out"), *QUICK]
    line += ["--from", arm.source, "--camera", str(incoming)]
    going = subprocess.Popen(line, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    try:
        until = time.monotonic() + 30
        while not (tmp_path / "out" / "images").is_dir() and time.monotonic() < until:
            time.sleep(0.05)
        blank = cv2.imencode(".png", np.full(SIZE[::-1], 90, np.uint8))[1].tobytes()
        for number in range(20):
            (incoming / f"{number}.png").write_bytes(blank)
        _, error = going.communicate(timeout=30)
        assert going.returncode == 2 and "found no board in 20 images" in error and "Traceback" not in error
    finally:
        going.kill()


def test_keeps_the_contract() -> None:
    assert_contract(LiveImages, "camera")
