"""From a tracker's bodies to the arm's base frame: against products of matrices written out, and scipy's means."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.devices.live import TrackerFrame
from armcal.measure.rests import mean_rotation, turns_from
from armcal_bench.bench import BodySettings, in_base, repeats
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

SITED = {
    "base": "1",
    "tool": "2",
    "base_T_reference": {"position_mm": [10, -20, 30], "rpy_deg": [5, 10, 170]},
    "tool_body_T_target": {"position_mm": [0, 40, 65], "rpy_deg": [0, 90, 0]},
}


def settings(**changes: object) -> BodySettings:
    return BodySettings.model_validate({**SITED, **changes})


def pose(seed: int, spread: float = 1.0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    found = np.eye(4)
    found[:3, :3] = Rotation.from_rotvec(rng.normal(0, spread, 3)).as_matrix()
    found[:3, 3] = rng.normal(0, spread, 3)
    return found


def without_rotation(found: np.ndarray) -> np.ndarray:
    found = found.copy()
    found[:3, :3] = np.nan
    return found


def frame(counter: int, base: np.ndarray | None, tool: np.ndarray | None) -> TrackerFrame:
    return TrackerFrame(counter, counter / 60, None, {"1": base, "2": tool})


def test_the_chain_of_transforms() -> None:
    s = settings()
    frames = [frame(i, pose(i), pose(100 + i)) for i in range(5)]
    found = in_base(frames, s)
    assert found.faults == ("",) * 5
    for i, got in enumerate(found.poses):
        reference_T_world = np.linalg.inv(pose(i))
        expected = s.base_T_reference.matrix @ reference_T_world @ pose(100 + i) @ s.tool_body_T_target.matrix
        np.testing.assert_allclose(got, expected, atol=1e-12)


def test_stated_sites_are_what_they_say() -> None:
    found = settings().base_T_reference.matrix
    np.testing.assert_allclose(found[:3, 3], [0.01, -0.02, 0.03])
    expected = Rotation.from_euler("xyz", [5, 10, 170], degrees=True).as_matrix()
    np.testing.assert_allclose(found[:3, :3], expected, atol=1e-12)


def test_without_a_base_body_the_world_is_the_reference() -> None:
    found = in_base([frame(1, None, pose(7))], settings(base="none"))
    s = settings()
    expected = s.base_T_reference.matrix @ pose(7) @ s.tool_body_T_target.matrix
    np.testing.assert_allclose(found.poses[0], expected, atol=1e-12)


@pytest.mark.slow
@given(st.integers(0, 10_000), st.sampled_from(["moving", "still"]))
def test_moving_the_world_changes_nothing(seed: int, motion: str) -> None:
    s = settings(base_motion=motion)
    frames = [(pose(i, 1e-3), pose(50 + i)) for i in range(6)]
    moved_T_world = pose(20_000 + seed)
    here = in_base([frame(i, b, t) for i, (b, t) in enumerate(frames)], s)
    there = in_base([frame(i, moved_T_world @ b, moved_T_world @ t) for i, (b, t) in enumerate(frames)], s)
    np.testing.assert_allclose(here.poses, there.poses, atol=1e-9)


@pytest.mark.parametrize("motion", ["moving", "still"])
def test_a_base_and_tool_that_move_together_stand_still(motion: str) -> None:
    s = settings(base_motion="moving")
    base_T_tool = pose(3)
    frames = [frame(i, pose(i), pose(i) @ base_T_tool) for i in range(20)]
    found = in_base(frames, s).poses
    np.testing.assert_allclose(found, np.tile(found[0], (20, 1, 1)), atol=1e-12)


def test_a_still_base_keeps_its_noise_out_and_may_be_lost_for_a_while() -> None:
    rng = np.random.default_rng(1)
    base, tool = pose(1), pose(2)
    frames = []
    for i in range(200):
        shaken = base.copy()
        shaken[:3, 3] += rng.normal(0, 1e-3, 3)
        frames.append(frame(i, None if 50 < i < 100 else shaken, tool))
    still, moving = (in_base(frames, settings(base_motion=motion)) for motion in ("still", "moving"))
    assert not any(still.faults)
    assert sum(bool(fault) for fault in moving.faults) == 49
    assert np.ptp(still.poses[:, :3, 3], axis=0).max() < 1e-12
    assert np.nanstd(moving.poses[:, :3, 3], axis=0).min() > 0.8e-3
    expected = in_base([frame(0, base, tool)], settings()).poses[0]
    np.testing.assert_allclose(still.poses[0][:3, 3], expected[:3, 3], atol=4e-4)


def test_a_base_seen_far_off_once_does_not_move_the_mean() -> None:
    frames = [frame(i, pose(1), pose(2)) for i in range(30)]
    elsewhere = pose(1)
    elsewhere[0, 3] += 0.5
    s = settings(base_motion="still")
    clean = in_base(frames, s).poses[0]
    np.testing.assert_allclose(in_base([*frames, frame(30, elsewhere, pose(2))], s).poses[0], clean, atol=1e-12)


@pytest.mark.parametrize(("base", "tool", "word"), [(None, 1, "base"), (1, None, "tool"), (None, None, "tool")])
def test_lost_bodies_are_named_with_what_is_seen(base: int | None, tool: int | None, word: str) -> None:
    seen = TrackerFrame(
        1,
        0.0,
        None,
        {"1": base and pose(1), "2": tool and pose(2), "7": pose(3)},  # type: ignore[dict-item]
    )
    found = in_base([seen], settings())
    assert np.isnan(found.poses[0, :3]).all()
    assert f"{word} body '{SITED[word]}'" in found.faults[0] and "7" in found.faults[0]


def test_positions_alone() -> None:
    at_origin = settings(tool_body_T_target={})
    tool = without_rotation(pose(2))
    found = in_base([frame(1, pose(1), tool)], at_origin)
    expected = in_base([frame(1, pose(1), pose(2))], at_origin)
    assert found.faults == ("",)
    np.testing.assert_allclose(found.poses[0, :3, 3], expected.poses[0, :3, 3], atol=1e-12)
    assert np.isnan(found.poses[0, :3, :3]).all()


def test_positions_alone_do_not_tell_where_a_target_off_the_origin_is() -> None:
    found = in_base([frame(1, pose(1), without_rotation(pose(2)))], settings())
    assert "has no orientation" in found.faults[0] and np.isnan(found.poses[0, :3, 3]).all()


@pytest.mark.parametrize("motion", ["moving", "still"])
def test_a_base_without_orientation_tells_nothing(motion: str) -> None:
    found = in_base([frame(1, without_rotation(pose(1)), pose(2))], settings(base_motion=motion))
    assert "base body '1' has no orientation" in found.faults[0]


def test_no_frames() -> None:
    for motion in ("moving", "still"):
        assert in_base([], settings(base_motion=motion)).poses.shape == (0, 4, 4)


def test_one_body_for_two_is_refused() -> None:
    with pytest.raises(ValidationError, match="expected two bodies"):
        BodySettings(tool="1", base="1")


@given(st.integers(0, 10_000), st.integers(1, 40), st.floats(0.001, 0.8))
def test_the_mean_rotation_is_scipys(seed: int, count: int, spread: float) -> None:
    rng = np.random.default_rng(seed)
    middle = Rotation.random(random_state=seed)
    rotations = middle * Rotation.from_rotvec(rng.normal(0, spread, (count, 3)))
    found = mean_rotation(rotations.as_matrix())
    np.testing.assert_allclose(found, rotations.mean().as_matrix(), atol=1e-9)
    assert np.linalg.det(found) > 0


def test_turns_come_back() -> None:
    rng = np.random.default_rng(4)
    mean, turns = pose(5)[:3, :3], rng.normal(0, 0.1, (10, 3))
    rotations = mean @ Rotation.from_rotvec(turns).as_matrix()
    np.testing.assert_allclose(turns_from(mean, rotations), turns, atol=1e-12)


def test_what_repeats() -> None:
    s = settings()
    first = frame(1, pose(1), pose(2))
    assert not repeats(first, None, s)
    assert repeats(frame(2, pose(1), pose(2)), first, s)
    assert repeats(frame(1, pose(3), pose(4)), first, s)
    assert not repeats(frame(2, pose(1) + 1e-9, pose(2)), first, s)
    assert not repeats(frame(2, None, pose(2)), first, s)
    assert repeats(frame(2, None, pose(2)), first, settings(base="none"))
    assert not repeats(frame(2, None, None), frame(1, None, None), s)
