"""Boards: their settings, where their points are, and which of them can be told apart."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.base.settings import Settings
from armcal_camera.board import Board, BoardOrFile, require_distinct
from pydantic import ValidationError


class _Sheet(Settings):
    board: BoardOrFile


CHESSBOARD = {"type": "chessboard", "columns": 9, "rows": 6, "square_mm": 25}
CHARUCO = {"type": "charuco", "columns": 7, "rows": 5, "square_mm": 30, "marker_mm": 22}
APRILGRID = {"type": "aprilgrid", "columns": 3, "rows": 2, "tag_mm": 50, "spacing_mm": 10}
TAG = {"type": "tag", "id": 3, "tag_mm": 50}


def board(settings: dict[str, object] | str) -> Board:
    return _Sheet.model_validate({"board": settings}).board


@pytest.mark.parametrize(
    ("settings", "count", "some"),
    [
        (CHESSBOARD, 54, {0: (0, 0), 1: (0.025, 0), 9: (0, 0.025), 53: (0.2, 0.125)}),
        (CHARUCO, 24, {0: (0, 0), 5: (0.15, 0), 6: (0, 0.03)}),
        (APRILGRID, 24, {0: (0, 0.05), 1: (0.05, 0.05), 3: (0, 0), 7: (0.06, 0), 15: (0, 0.06)}),
        (TAG, 4, {0: (-0.025, -0.025), 2: (0.025, 0.025)}),
    ],
)
def test_points_stand_where_the_docstring_says(
    settings: dict[str, object], count: int, some: dict[int, tuple[float, float]]
) -> None:
    points = board(settings).points
    assert points.shape == (count, 3)
    for index, (x, y) in some.items():
        np.testing.assert_allclose(points[index], (x, y, 0), atol=1e-15)


@pytest.mark.parametrize("settings", [CHESSBOARD, CHARUCO, APRILGRID, TAG])
def test_a_board_may_stand_in_a_file_of_its_own(tmp_path: Path, settings: dict[str, object]) -> None:
    path = tmp_path / "board.yaml"
    path.write_text(yaml.safe_dump({"board": board(settings).to_config()}))
    assert board(str(path)) == board(settings)


@pytest.mark.parametrize(
    ("settings", "text"),
    [
        (CHARUCO | {"marker_mm": 31}, "expected the marker to be smaller"),
        (CHARUCO | {"dictionary": "DICT_5X5_50", "first_id": 40}, "ids up to 56, expected at most 49"),
        (APRILGRID | {"family": "big"}, "found the family 'big', expected one of 16h5"),
        (APRILGRID | {"family": "36h12"}, "found the family '36h12', expected one of 16h5"),
        (CHESSBOARD | {"columns": 2}, "greater than or equal to 3"),
        ({"type": "chessboard", "columns": 9, "rows": 6, "square": 25}, "square_mm: 25"),
        ("no/such.yaml", "there is no such file"),
    ],
)
def test_a_board_that_cannot_be_is_refused(settings: dict[str, object] | str, text: str) -> None:
    with pytest.raises(ValidationError, match=text):
        board(settings)


def test_boards_that_look_alike_are_refused() -> None:
    turned = CHESSBOARD | {"columns": 6, "rows": 9}
    with pytest.raises(ValueError, match="look alike"):
        require_distinct([board(CHESSBOARD), board(turned)])
    with pytest.raises(ValueError, match="the tag 3 of 36h11"):
        require_distinct([board(APRILGRID), board(TAG)])
    require_distinct([board(CHESSBOARD), board(CHARUCO), board(APRILGRID), board(TAG | {"id": 6})])
