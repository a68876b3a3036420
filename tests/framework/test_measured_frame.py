"""What is wrong with the units or the handedness of measured poses: planted on simulated poses of the LRM arm."""

from __future__ import annotations

from functools import partial
from pathlib import Path

import numpy as np
import pytest
from armcal.base.arrays import Array
from armcal.base.units import length_mistake
from armcal.calibration.rigid_chain import nominal_tools
from armcal.run.experiment import Experiment
from armcal_bench.measured_frame import frame_mistake, frame_of
from scipy.spatial.transform import Rotation

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "bench.yaml"
LIMITS = np.deg2rad([100, 50, 80, 80, 80, 50])


@pytest.fixture(scope="module")
def tools() -> object:
    arm = next(iter(Experiment.load(CONFIG).system.arms.values()))
    return partial(nominal_tools, arm)


def measured(tools, seed: int, count: int, rotations: bool = True) -> tuple[Array, Array, Array]:  # type: ignore[no-untyped-def]
    """Angles, the model's poses, and poses of an arm 2 deg off, in another frame and with the target elsewhere."""
    random = np.random.default_rng(seed)
    angles = random.uniform(-LIMITS, LIMITS, (count, 6))
    frame, seat = np.eye(4), np.eye(4)
    frame[:3, :3], frame[:3, 3] = Rotation.random(random_state=seed).as_matrix(), random.normal(0, 1, 3)
    seat[:3, :3], seat[:3, 3] = Rotation.random(random_state=seed + 99).as_matrix(), random.normal(0, 0.02, 3)
    seen = frame @ tools(angles + random.normal(0, np.deg2rad(2), 6)) @ seat
    if not rotations:
        seen[:, :3, :3] = np.nan
    return angles, tools(angles), seen


def mirrored(seen: Array) -> Array:
    mirror = np.diag([1.0, -1.0, 1.0])
    other = seen.copy()
    other[:, :3, :3], other[:, :3, 3] = mirror @ seen[:, :3, :3] @ mirror, seen[:, :3, 3] @ mirror
    return other


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rotations", "count"), [(True, 3), (False, 4)])
def test_millimetres_for_metres_are_named_by_three_poses(tools, seed: int, rotations: bool, count: int) -> None:  # type: ignore[no-untyped-def]
    _, expected, seen = measured(tools, seed, count, rotations)
    seen[:, :3, 3] *= 1000
    mistake = frame_mistake(expected, seen)
    assert mistake is not None and not mistake.frame.is_mirrored
    assert mistake.frame.gain == pytest.approx(1000, rel=0.3)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(("rotations", "count"), [(True, 5), (False, 8)])
def test_a_left_handed_frame_is_named(tools, seed: int, rotations: bool, count: int) -> None:  # type: ignore[no-untyped-def]
    _, expected, seen = measured(tools, seed, count, rotations)
    mistake = frame_mistake(expected, mirrored(seen))
    assert mistake is not None and mistake.frame.is_mirrored and mistake.frame.gain == pytest.approx(1)


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("rotations", [True, False])
def test_an_arm_in_any_frame_is_no_mistake_and_its_frame_is_found(tools, seed: int, rotations: bool) -> None:  # type: ignore[no-untyped-def]
    for count in (2, 3, 4, 8):
        _, expected, seen = measured(tools, seed, count, rotations)
        assert frame_mistake(expected, seen) is None
    frame = frame_of(expected, seen)
    assert frame is not None and np.linalg.det(frame.turn) == pytest.approx(1)
    true = Rotation.random(random_state=seed).as_matrix()
    assert Rotation.from_matrix(frame.turn.T @ true).magnitude() < np.deg2rad(8)


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize("fault", ["stuck", "astray", "exchanged", "reversed", "still"])
def test_what_servos_do_is_not_called_a_frame(tools, seed: int, fault: str) -> None:  # type: ignore[no-untyped-def]
    angles, expected, _ = measured(tools, seed, 6)
    random, other = np.random.default_rng(seed), angles.copy()
    joint = int(random.integers(6))
    if fault == "stuck":
        other[1:, joint] = other[0, joint]
    elif fault == "astray":
        other[3, joint] += 1.0
    elif fault == "exchanged":
        other[:, [joint, joint - 1]] = other[:, [joint - 1, joint]]
    elif fault == "reversed":
        other[:, joint] *= -1
    else:
        other[:] = other[0]
    assert frame_mistake(expected, tools(other)) is None


@pytest.mark.parametrize(
    ("gain", "names"),
    [(1000, ("mm", "m")), (0.001, ("m", "mm")), (1 / 25.4, ("inch", "mm")), (39.37, ("inch", "m")), (3.3, None)],
)
def test_the_units_of_a_gain_are_those_of_the_table(gain: float, names: tuple[str, str] | None) -> None:
    found = length_mistake(gain)
    assert found == names or (names == ("inch", "m") and found is not None)
