"""Recalibration from a ball in printed sockets: no instrument, noisy joints, sockets that were found and others."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli
from click.testing import CliRunner

pytestmark = pytest.mark.slow

BALL = Path(__file__).resolve().parents[2] / "configs" / "ball"


@pytest.fixture(scope="module")
def events(tmp_path_factory: pytest.TempPathFactory) -> list[dict]:
    """The demonstration trains on two positions of the sockets and judges by two others."""
    folder = tmp_path_factory.mktemp("ball")
    ran = CliRunner().invoke(cli, ["run", str(BALL / "demo.yaml"), "--out", str(folder / "run"), "-q"])
    assert ran.exit_code == 0, ran.output
    given = [str(folder / "run" / "calibration.yaml"), "--from", str(BALL / "demo.csv"), "--out", str(folder / "kept")]
    kept = CliRunner().invoke(cli, ["recalibrate", *given])
    assert kept.exit_code == 0, kept.output
    return [json.loads(line) for line in kept.stdout.splitlines()]


def test_records_in_sockets_that_were_found_are_as_surprising_as_their_joints_noise_makes_them(
    events: list[dict],
) -> None:
    """They trained the calibration: they surprise less than new ones, by the share of numbers that the fit used up."""
    used = [event for event in events if event["event"] == "record" and event["id"].startswith(("front", "left"))]
    assert len(used) == 60 and sum(event["verdict"] == "accepted" for event in used) >= 58
    assert 0.6 < np.mean([event["nis"] / event["dof"] for event in used if "nis" in event]) < 1.1


def test_sockets_that_the_calibration_never_found_say_nothing_and_raise_no_alarm(events: list[dict]) -> None:
    others = [event for event in events if event["event"] == "record" and event["id"].startswith(("right", "raised"))]
    assert len(others) == 60 and {event["verdict"] for event in others} == {"ignored"}
    assert "none that the calibration found" in others[0]["why"]
    assert [event for event in events if event["event"] in ("decision", "level")] == []
