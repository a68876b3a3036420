"""Images out of a recording, read by the reader ``images`` as the printed data section says."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import recorded_bags as bags
import yaml
from armcal.run.experiment import Experiment
from armcal_ros2.bag_command import bag as command
from click.testing import CliRunner

pytest.importorskip("cv2")
from armcal_camera.render import Exposure, Lens, render

from tests.plugins.camera.sheets import CHESSBOARD, SIZE, facing, projected

LENS = Lens((600.0, 600.0), (320.0, 240.0))
BOARD = {"type": "chessboard", "columns": 9, "rows": 6, "square_mm": 25}


@pytest.mark.slow
def test_images_of_a_recording_become_records_of_corners(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ARMCAL_CACHE_DIR", str(tmp_path / "cache"))
    tour = bags.made_tour(tmp_path, rests=4)
    poses = [facing(CHESSBOARD, (0.1 * i, 0.2 - 0.1 * i, 0.05 * i)) for i in range(4)]
    sent = tour.sent(names=[f"joint_{i}" for i in range(1, 7)])
    for (begin, end), pose in zip(tour.rests, poses, strict=True):
        grey = render([(CHESSBOARD, pose)], LENS, SIZE, Exposure())
        own = {"height": 480, "width": 640, "encoding": "mono8", "is_bigendian": 0, "step": 640, "data": grey.ravel()}
        t = (begin + end) / 2
        picture = bags.message("sensor_msgs/msg/Image", header=bags.header(t), **own)
        sent.append((t, "/image", "sensor_msgs/msg/Image", picture))
    bag = bags.write_bag(tmp_path / "bag", sent)
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(command, ["images", str(bag), "--out", "seen"], catch_exceptions=False)
    settings = yaml.safe_load(tour.config.read_text()) | yaml.safe_load(done.stdout[done.stdout.index("data:\n") :])
    settings["measurements"] = {"camera": {"type": "camera", "noise_px": 0.2, "board": BOARD, "image_px": list(SIZE)}}
    settings["parameters"] = {"free": ["camera.*"]}
    (tmp_path / "camera.yaml").write_text(yaml.safe_dump(settings))
    dataset = Experiment.load(tmp_path / "camera.yaml").read()
    assert dataset.ids == tuple(f"rest{i:04d}.pgm" for i in range(1, 5))
    exact = Experiment.load(tour.config).read()
    np.testing.assert_allclose(dataset.stacked(bags.CHANNELS), exact.stacked(bags.CHANNELS), atol=3e-5)
    for i, pose in enumerate(poses):
        expected = projected(LENS, CHESSBOARD.points @ pose[:3, :3].T + pose[:3, 3])
        pixels = [[1000 * dataset.column(f"camera.{axis}_{k}")[i] for axis in "uv"] for k in range(len(expected))]
        np.testing.assert_allclose(pixels, expected, atol=0.1)
