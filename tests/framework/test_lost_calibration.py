"""A calibration whose recalibration ended at the level lost: nothing uses it as if it held, unless told to."""

from __future__ import annotations

from pathlib import Path

import pytest
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.errors import ConfigError
from armcal_online.state import calibration_text
from armcal_serve.loading import Loader
from click.testing import CliRunner, Result
from online_arm import CONFIG, begun, calibration, settings
from serving import ask, loaded, made

CONFIGS = CONFIG.parent
WHY = "4 of the last 8 records do not fit."
COMMANDS = {
    "predict": ("predict", "{0}", "--poses", CONFIGS / "demo.csv", "--out", "{1}"),
    "compensate": ("compensate", "{0}", "--targets", CONFIGS / "targets.csv", "--out", "{1}"),
    "export": ("export", "{0}", "--format", "yaml", "--out", "{1}"),
    "serve": ("serve", "{0}", "--evaluator", "interpreted"),
    "capability": ("capability", "{0}", "--settings", CONFIGS / "capability.yaml", "--out", "{1}"),
    "recalibrate": ("recalibrate", "{0}", "--from", CONFIGS / "demo.csv", "--out", "{1}"),
}


def text_of(level: str) -> str:
    """What a recalibration at a level publishes."""
    session = begun(settings(evaluator="interpreted"))
    told = {"records": {}, "sequence": 17, "time_s": 0.0, "level": level, "why": WHY}
    return calibration_text(calibration(), session.setup, session.state.belief, told)


@pytest.fixture(scope="module")
def texts() -> dict[str, str]:
    return {level: text_of(level) for level in ("suspect", "lost")}


@pytest.fixture
def lost(texts: dict[str, str], tmp_path: Path) -> Path:
    path = tmp_path / "calibration.yaml"
    path.write_text(texts["lost"], encoding="utf-8")
    return path


def armcal(name: str, path: Path, *more: str) -> Result:
    arguments = [str(each).format(path, path.parent / "out") for each in COMMANDS[name]]
    return CliRunner().invoke(cli, [*arguments, *more])


@pytest.mark.parametrize("name", COMMANDS)
def test_every_use_refuses_it(name: str, lost: Path) -> None:
    done = armcal(name, lost)
    assert done.exit_code == 2, done.output
    said = " ".join(done.stderr.split())
    assert "its level is lost, as of record 17: 4 of the last 8 records do not fit." in said
    assert not (lost.parent / "out").exists()


@pytest.mark.parametrize("name", ["predict", "compensate", "export"])
def test_it_is_used_where_that_is_asked_for_with_a_warning(name: str, lost: Path) -> None:
    done = armcal(name, lost, "--accept")
    assert done.exit_code == 0, done.output
    assert f"is lost: {WHY}" in " ".join(done.stderr.split())
    assert (lost.parent / "out").exists()


def test_its_headline_is_not_that_of_the_run_any_more(texts: dict[str, str], lost: Path) -> None:
    assert Calibration.load(lost, accept=True).record.verdict["headline"] == f"Lost, do not use: {WHY}"
    lost.write_text(texts["suspect"], encoding="utf-8")
    found = Calibration.load(lost).record
    assert found.level == "suspect" and found.verdict == calibration().record.verdict


@pytest.mark.slow
def test_a_server_answers_with_the_level_and_with_an_error_once_it_is_lost(
    texts: dict[str, str],
) -> None:
    """That the file before is no longer used either: its arm is the one that moved."""
    request = {"do": "forward", "joint_angles_deg": [0, 0, 0, 0, 0, 0]}
    loader = Loader("c.yaml", evaluator="interpreted")
    answer = ask(loaded(loader, texts["suspect"]), **request)
    assert answer["ok"] and answer["calibration"]["level"] == "suspect"
    with pytest.raises(ConfigError, match="its level is lost, as of record 17"):
        made(texts["lost"])
    lost = loaded(loader, texts["lost"])
    for kind in ("forward", "compensate"):
        asked = request if kind == "forward" else {"do": kind, "targets": [{"position_mm": [300, 0, 100]}]}
        answer = ask(lost, **asked)
        assert not answer["ok"] and "its level is lost" in answer["error"]
        assert answer["calibration"]["level"] == "lost"
    answer = ask(made(texts["lost"], accept=True), **request)
    assert answer["ok"] and answer["calibration"]["level"] == "lost"
