"""A joint table that lags behind the images of an arm that moves: the delay comes out of the fit, with its interval."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import to_unit
from armcal.diagnose.residual_structure import structure
from armcal.errors import DataError
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate

from tests.plugins.camera.simulated_views import (
    MIDDLE,
    base_T,
    configured,
    estimated,
    numbers,
    pose,
    simulated,
    stand_for_images,
)

STEP_S, LATE_S, IMAGES, EVERY = 0.04, 0.1, 30, 12


def swept(times: Array) -> Array:
    """Joints that swing slowly about the middle of all poses (6 x N, rad)."""
    periods = np.array([3.1, 4.3, 5.3, 3.7, 4.7, 2.9])[:, None]
    return np.asarray(MIDDLE[:, None] + np.deg2rad(9) * np.sin(2 * np.pi * times / periods + np.arange(6)[:, None]))


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with corners seen at their time, and a joint table whose rows are those of 100 ms before."""
    folder = tmp_path_factory.mktemp("late")
    camera = pose((0.05, 0.02, 0.06), (5, 20, -40))
    board = base_T("tool") @ camera @ pose((-0.08, -0.05, 0.8), (8, -6, 3))
    simulated(folder, {"camera": {}}, {**numbers("camera.camera", camera), **numbers("camera.board", board)}, 4)
    times = STEP_S * np.arange(IMAGES * EVERY)
    shot = times[EVERY // 2 :: EVERY]
    experiment = configured(folder, {"camera": {}})
    poses = Dataset(tuple(map(str, range(IMAGES))), {f"arm.q{i + 1}": q for i, q in enumerate(swept(shot))})
    seen = experiment.simulator().simulate(replace(experiment.simulation_request, poses=poses))
    rows = np.stack([[seen.column(f"camera.{axis}_{k}") for axis in "uv"] for k in range(20)])
    corners = {f"{i}.png": to_unit(rows[:, :, i], "px") for i in range(IMAGES)}
    np.savez(folder / "corners.npz", **corners)
    lines = ["image,time_s," + ",".join(f"q{i}_rad" for i in range(1, 7))]
    for number, (time, row) in enumerate(zip(times, swept(times - LATE_S).T, strict=True)):
        image = f"{number // EVERY}.png" if number % EVERY == EVERY // 2 else ""
        lines.append(",".join([image, repr(float(time)), *(repr(float(q)) for q in row)]))
    (folder / "joints.csv").write_text("\n".join([*lines, ""]))
    content = yaml.safe_load((folder / "config.yaml").read_text())
    content["data"] = {"type": "images", "folder": ".", "poses": "joints.csv"}
    content["arms"]["arm"]["effects"] = {"clock": {"type": "delay"}}
    content["parameters"]["free"].append("arm.clock.delay")
    (folder / "late.yaml").write_text(yaml.safe_dump(content))
    return folder


@pytest.fixture(autouse=True)
def _corners(recorded: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    stand_for_images(monkeypatch, dict(np.load(recorded / "corners.npz")))


@pytest.mark.slow
def test_joints_that_are_late_are_late_by_so_much(recorded: Path) -> None:
    estimate = estimated(Experiment.load(recorded / "late.yaml"))
    names = estimate.parameters.coordinate_names
    root = estimate.square_root_information
    place = names.index("arm.clock.delay")
    own = float(np.sqrt(np.linalg.inv(root.T @ root)[place, place]))
    delay = float(estimate.values[estimate.parameters.entry_names.index("arm.clock.delay")])
    assert abs(delay - LATE_S) < 2 * own + 1e-3, "a rate is a mean over two steps of the table"
    assert own < 1e-3


@pytest.mark.slow
def test_late_joints_are_named_without_the_effect(recorded: Path) -> None:
    """From the times of the joint table alone; of a table without times nothing is said of rates."""
    content = yaml.safe_load((recorded / "late.yaml").read_text())
    del content["arms"]["arm"]["effects"]
    content["parameters"]["free"].remove("arm.clock.delay")
    (recorded / "plain.yaml").write_text(yaml.safe_dump(content))
    experiment = Experiment.load(recorded / "plain.yaml")
    left = calibrate(experiment, "test").fit.of(structure)
    assert left is not None
    first = left.structures[0]
    assert first.kind == "delay" and first.odds > 0.9
    late_ms = float(first.size.removeprefix("joints late by about ").split()[0])
    assert abs(late_ms - 1000 * LATE_S) < 100 * LATE_S
    lines = [line.split(",") for line in (recorded / "joints.csv").read_text().splitlines()]
    (recorded / "no_times.csv").write_text("".join(",".join([row[0], *row[2:]]) + "\n" for row in lines))
    plain = Experiment.load(recorded / "plain.yaml", (f"data.poses={recorded / 'no_times.csv'}",)).read()
    assert len(plain) == IMAGES and not plain.has("q1_rate")
    assert experiment.read().has("q1_rate")


def test_rates_are_not_made_of_rows_that_are_far_apart(recorded: Path) -> None:
    lines = (recorded / "joints.csv").read_text().splitlines()
    for name, kept in (
        ("seldom.csv", [lines[0], *(line for line in lines if ".png" in line)]),
        ("timeless.csv", lines),
    ):
        cut = [line.split(",") for line in kept]
        if name == "timeless.csv":
            cut = [[cell for i, cell in enumerate(cells) if i != 1] for cells in cut]
        (recorded / name).write_text("\n".join(",".join(cells) for cells in cut) + "\n")
        with pytest.raises(DataError, match="how fast joints were") as refused:
            Experiment.load(recorded / "late.yaml", (f"data.poses={recorded / name}",)).read()
        assert "time_s" in refused.value.hint
