"""Pairs of poses of other programs: read as they are, either mounting, and refused where they are none."""

import random
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ArmcalError, DataError
from armcal.measure.reader import ReadRequest
from armcal.plugins import discover
from armcal_tracker.csv_reader import PosePairsReader
from scipy.spatial.transform import Rotation

CONFIG = {
    "arms": {"arm": {"model": {"type": "flange_pose"}}},
    "measurements": {"tracker": {"type": "tip_pose", "noise_mm": 1, "orientation_noise_deg": 0.1}},
}


def pose(rotation: Rotation, place: np.ndarray) -> np.ndarray:
    made = np.eye(4)
    made[:3, :3], made[:3, 3] = rotation.as_matrix(), place
    return made


def pairs(in_hand: bool, count: int = 12) -> list[tuple[np.ndarray, np.ndarray]]:
    """base_T_hand and camera_T_marker of a marker, or a camera, that stands beside the arm."""
    drawn = np.random.default_rng(1)
    turns = Rotation.random(count + 2, random_state=2)
    hands = [pose(turns[i], drawn.uniform(-0.5, 0.5, 3)) for i in range(count)]
    on_hand, beside = (pose(turns[i], drawn.uniform(-0.5, 0.5, 3)) for i in (-1, -2))
    if in_hand:  # camera_T_hand hand_T_base base_T_marker
        return [(hand, on_hand @ np.linalg.inv(hand) @ beside) for hand in hands]
    return [(hand, beside @ hand @ on_hand) for hand in hands]


def of_moveit(made: list[tuple[np.ndarray, np.ndarray]]) -> object:
    return [
        {"effector_wrt_world": hand.ravel().tolist(), "object_wrt_sensor": seen.ravel().tolist()} for hand, seen in made
    ]


def of_easy_handeye(made: list[tuple[np.ndarray, np.ndarray]]) -> object:
    def message(of: np.ndarray) -> dict[str, dict[str, float]]:
        turn = dict(zip("xyzw", Rotation.from_matrix(of[:3, :3]).as_quat().tolist(), strict=True))
        return {"translation": dict(zip("xyz", of[:3, 3].tolist(), strict=True)), "rotation": turn}

    samples = [{"robot": message(hand), "tracking": message(seen)} for hand, seen in made]
    return {"parameters": {"name": ""}, "samples": samples}


def read(path: Path, mounting: str):
    (path.parent / "arm.yaml").write_text(yaml.safe_dump(CONFIG))
    registry = discover()
    system = build_system(load_config(path.parent / "arm.yaml"), registry)
    reader = PosePairsReader(PosePairsReader.Settings(path=path, mounting=mounting))
    return reader.read(ReadRequest(system.arms, system.measurements, ()))


@pytest.mark.parametrize("written", [of_moveit, of_easy_handeye])
@pytest.mark.parametrize("mounting", ["eye_to_hand", "eye_in_hand"])
def test_pairs_are_read_and_the_other_mounting_is_named(written, mounting: str, tmp_path: Path) -> None:
    made, path = pairs(mounting == "eye_in_hand"), tmp_path / "samples.yaml"
    path.write_text(yaml.safe_dump(written(made)))
    dataset = read(path, mounting)
    assert len(dataset) == len(made)
    for i, (hand, seen) in enumerate(made):
        at = {name: float(column[i]) for name, column in dataset.channels.items()}
        turn = Rotation.from_euler("ZYX", [at["arm.rz"], at["arm.ry"], at["arm.rx"]])
        np.testing.assert_allclose(pose(turn, [at[f"arm.{a}"] for a in "xyz"]), hand, atol=1e-9)
        turn = Rotation.from_quat([at[f"tracker.q{a}"] for a in "xyzw"])
        expected = np.linalg.inv(seen) if mounting == "eye_in_hand" else seen
        np.testing.assert_allclose(pose(turn, [at[f"tracker.{a}"] for a in "xyz"]), expected, atol=1e-9)
    other = "eye_in_hand" if mounting == "eye_to_hand" else "eye_to_hand"
    with pytest.raises(DataError, match=f"turns from pair to pair are off by .* with {other}.*") as refused:
        read(path, other)
    assert refused.value.hint == f"Write mounting: {mounting}."


def test_two_hundred_mutated_files_are_refused_or_read(tmp_path: Path) -> None:
    drawn, refusals = random.Random(4), 0
    for number in range(200):
        text = list(yaml.safe_dump((of_moveit, of_easy_handeye)[number % 2](pairs(False, 7))))
        for _ in range(drawn.randint(1, 4)):
            at = drawn.randrange(len(text))
            text[at : at + drawn.randint(0, 30)] = drawn.choice(
                ["", "-", "nan", ": ", "[", "\0", "1e999", "\t", "&a *a"]
            )
        path = tmp_path / "mutated.yaml"
        path.write_text("".join(text))
        try:
            dataset = read(path, "eye_to_hand")
        except ArmcalError as fault:
            refusals += 1
            assert "mutated.yaml" in str(fault) and fault.hint
        else:
            assert all(np.isfinite(column).all() for column in dataset.channels.values())
    assert refusals > 50
