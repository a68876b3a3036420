"""The check of servos that know where they stand: inverted joints, exchanged ids, and wrong teeth are named."""

from __future__ import annotations

from pathlib import Path

import pytest
from armcal.cli.main import cli
from armcal_bench.acquisition.rehearsal import overrides_for
from bench_runs import BenchRun
from click.testing import CliRunner

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "so101" / "bench.yaml"
SERVO = "bench.simulator.joints."


def checked(folder: Path, *sets: str) -> tuple[int, str, dict[str, int]]:
    """Exit code, what was printed, and the bench's offences."""
    run = BenchRun(folder, sets, CONFIG, "device")
    port = run.experiment.settings.bench["tracker"]["port"]  # type: ignore[index]
    with run.simulated() as clock:
        more = (f"bench.tracker.port={port}", *overrides_for(run.bench, "device"))
        words = [word for text in more for word in ("--set", text)]
        done = CliRunner().invoke(cli, ["servo", str(CONFIG), "--check", "--yes", *words])
        offences = clock.ask({"state": True})["offences"]
    return done.exit_code, " ".join(done.output.split()), offences


def test_joints_that_turn_as_commanded_are_right(tmp_path: Path) -> None:
    code, text, offences = checked(tmp_path)
    assert (code, offences) == (0, {}), text
    assert text.count("deg, commanded +12.0 deg.") == 5


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        (["elbow_flex.direction=-1"], "the other way. Give its direction in bench.device the other sign."),
        (["elbow_flex.id=4", "wrist_flex.id=3"], "Exchange their ids in bench.device, or their plugs."),
        (["elbow_flex.horn_teeth=-1"], "elbow_flex stands +13"),
        (["wrist_flex.horn_teeth=-1"], "wrist_flex stands +18"),
        (["elbow_flex={id: 2}"], "Two servos may have the id 2"),
    ],
)
def test_what_is_wrong_is_named_and_nothing_unsafe_is_done(tmp_path: Path, changes: list[str], says: str) -> None:
    code, text, offences = checked(tmp_path, *(SERVO + change for change in changes))
    assert code != 0
    assert says in text
    assert offences == {}
