"""Pairs of poses of other programs: read as they are, either mounting, and refused where they are none."""

import random
import re
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ArmcalError, DataError
from armcal.measure.reader import ReadRequest
from armcal.plugins import discover
from armcal_tracker.pose_pairs import PosePairsReader
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
    assert refused.value.hint.startswith(f"Write mounting: {mounting};")


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


def noisy(made: list[tuple[np.ndarray, np.ndarray]], seed: int, turn_deg: float, place_mm: float):
    """The pairs with noise of what a camera sees."""
    drawn = np.random.default_rng(seed)
    return [
        (
            hand,
            seen
            @ pose(Rotation.from_rotvec(np.deg2rad(drawn.normal(0, turn_deg, 3))), drawn.normal(0, place_mm / 1000, 3)),
        )
        for hand, seen in made
    ]


MISTAKES = {
    "a marker of another size": (
        lambda hand, seen: (hand, pose(Rotation.from_matrix(seen[:3, :3]), 1.25 * seen[:3, 3])),
        r"if they are multiplied by 0\.[78]\d+: they are then off by .* Correct the size of the marker",
    ),
    "places in mm": (
        lambda hand, seen: (pose(Rotation.from_matrix(hand[:3, :3]), 1000 * hand[:3, 3]), seen),
        r"if they are multiplied by (100\d|99\d)",
    ),
    "Euler angles in another order": (
        lambda hand, seen: (
            pose(Rotation.from_euler("xyz", Rotation.from_matrix(hand[:3, :3]).as_euler("XYZ")), hand[:3, 3]), seen
        ),
        "if the hand's Euler angles XYZ were taken for Euler angles xyz, by",
    ),
    "a rotation vector as angles": (
        lambda hand, seen: (
            hand, pose(Rotation.from_euler("xyz", Rotation.from_matrix(seen[:3, :3]).as_rotvec()), seen[:3, 3])
        ),
        "if the marker's rotation vectors were taken for Euler angles xyz, by",
    ),
}  # fmt: skip


@pytest.mark.parametrize("mounting", ["eye_to_hand", "eye_in_hand"])
@pytest.mark.parametrize("mistake", MISTAKES)
def test_what_a_program_before_mistook_is_named(mistake: str, mounting: str, tmp_path: Path) -> None:
    spoil, words = MISTAKES[mistake]
    made, path = noisy(pairs(mounting == "eye_in_hand", 24), 1, 0.1, 0.5), tmp_path / "samples.yaml"
    path.write_text(yaml.safe_dump(of_moveit([spoil(hand, seen) for hand, seen in made])))
    with pytest.raises(DataError) as refused:
        read(path, mounting)
    assert re.search(words, f"{refused.value} {refused.value.hint}"), refused.value


@pytest.mark.parametrize("sets", [8, pytest.param(200, marks=pytest.mark.slow)])
def test_sound_pairs_are_not_refused(sets: int, tmp_path: Path) -> None:
    """Of 7 to 40 pairs, of good cameras and bad ones."""
    drawn, path = np.random.default_rng(5), tmp_path / "samples.yaml"
    for number in range(sets):
        in_hand, count = bool(number % 2), int(drawn.integers(7, 41))
        made = noisy(pairs(in_hand, count), number, 10 ** drawn.uniform(-2, 0.5), 10 ** drawn.uniform(-1, 1))
        path.write_text(yaml.safe_dump(of_moveit(made), default_flow_style=True))
        assert len(read(path, "eye_in_hand" if in_hand else "eye_to_hand")) == count
