"""The check of words: it refuses names and phrases, and passes what is not one of them."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.words import main


@pytest.mark.parametrize(
    ("text", "refused"),
    [
        ("told = 1\n", ["told"]),
        ("def f(found):\n    return [each for each in found]\n", ["found", "each", "each", "found"]),
        ('"""A target that cannot be had."""\n', ["be had"]),
        ('raise ValueError("found 3 values, expected 4")\nuntold = retold = 1\n', []),
    ],
)
def test_what_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str], text: str, refused: list[str]) -> None:
    (tmp_path / "module.py").write_text(text)
    assert main([str(tmp_path)]) == bool(refused)
    lines = capsys.readouterr().out.splitlines()
    assert sorted(line.split("'")[1] for line in lines) == sorted(refused)
