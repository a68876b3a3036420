"""Observability indices against their definitions, written out in plain numpy."""

from __future__ import annotations

import numpy as np
import pytest
from armcal.planning.candidates import observability


def _jacobian(seed: int = 0, rows: int = 30, columns: int = 5) -> np.ndarray:
    random = np.random.default_rng(seed)
    return random.normal(size=(rows, columns)) * np.geomspace(1, 100, columns)


def test_indices_are_those_of_the_jacobian() -> None:
    jacobian = _jacobian()
    values = np.linalg.svd(jacobian, compute_uv=False)
    found = observability(values, 30)
    information = jacobian.T @ jacobian
    assert found.o1 == pytest.approx(np.linalg.det(information) ** (1 / 10) / np.sqrt(30))
    assert found.o2 == pytest.approx(1 / np.linalg.cond(jacobian))
    assert found.o3 == pytest.approx(np.sqrt(np.linalg.eigvalsh(information)[0]))
    assert found.o4 == pytest.approx(found.o3**2 / np.linalg.norm(jacobian, 2))
    inverse_root = np.linalg.svd(np.linalg.pinv(jacobian), compute_uv=False)
    assert found.o5 == pytest.approx(5 / inverse_root.sum())


def test_the_means_stand_between_the_ends_and_in_order() -> None:
    values = np.array([8.0, 4.0, 1.0])
    found = observability(values, 1 << 2)
    assert found.o3 < found.o5 < found.o1 * 2 < 8.0


def test_equal_singular_values_are_perfect() -> None:
    found = observability(np.full(4, 3.0), 9)
    assert found.__dict__ == pytest.approx({"o1": 1.0, "o2": 1.0, "o3": 3.0, "o4": 3.0, "o5": 3.0})


def test_order_does_not_matter_and_scale_does_as_defined() -> None:
    values = np.linalg.svd(_jacobian(), compute_uv=False)
    one, two = observability(values, 30), observability(10 * values[::-1], 30)
    for name, factor in {"o1": 10, "o2": 1, "o3": 10, "o4": 10, "o5": 10}.items():
        assert getattr(two, name) == pytest.approx(factor * getattr(one, name))


def test_measuring_every_pose_twice_leaves_the_mean_index_alone_and_raises_the_others() -> None:
    jacobian = _jacobian()
    once = observability(np.linalg.svd(jacobian, compute_uv=False), 30)
    twice = observability(np.linalg.svd(np.vstack([jacobian, jacobian]), compute_uv=False), 60)
    assert twice.o1 == pytest.approx(once.o1)
    assert twice.o2 == pytest.approx(once.o2)
    assert twice.o3 == pytest.approx(np.sqrt(2) * once.o3)


def test_an_undetermined_direction_leaves_nothing() -> None:
    assert set(observability(np.array([2.0, 1.0, 0.0]), 30).__dict__.values()) == {0.0}
    assert set(observability(np.array([2.0, 1.0, 1e-17]), 2).__dict__.values()) == {0.0}


def test_many_large_values_do_not_overflow() -> None:
    found = observability(np.full(400, 1e8), 400)
    assert found.o1 == pytest.approx(1e8 / 20)
    assert found.o5 == pytest.approx(1e8)


@pytest.mark.parametrize(
    ("values", "equations"), [([], 3), ([1.0], 0), ([1.0, -1.0], 3), ([np.nan], 3), ([np.inf, 1.0], 3)]
)
def test_nonsense_is_refused(values: list[float], equations: int) -> None:
    with pytest.raises(ValueError, match="singular values"):
        observability(np.array(values), equations)
