"""Settings of a recalibration, in a file of their own or a section of another."""

from __future__ import annotations

from pathlib import Path

import pytest
from armcal.errors import ConfigError
from armcal_online.settings import load_settings


def test_a_change_of_another_section_than_the_one_that_is_read_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "mission.yaml"
    path.write_text("days: 3\nrecalibrate: {gating: off}\n", encoding="utf-8")
    assert not load_settings(path).gating and load_settings(None).gating
    assert load_settings(path, ["recalibrate.gate.window=6"]).gate.window == 6
    for elsewhere in ("gate.window=6", "evaluator=interpreted", "recalibrates.gating=on"):
        with pytest.raises(ConfigError, match=r"only the section recalibrate .*--set recalibrate\."):
            load_settings(path, [elsewhere])
