"""``armcal replay``: a journal alone gives every state again, and says what other settings would have done."""

from __future__ import annotations

import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.base.settings import Settings
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.errors import DataError
from armcal.estimate.estimator import no_progress
from armcal.functions.compiler import find_compiler
from armcal.io.journal.journal import JournalLimits
from armcal.io.journal.reader import read_entries, read_segments, read_until
from armcal.plugins import discover
from armcal.run.experiment import Experiment
from armcal_online.running.loop import Pace, Recalibration
from armcal_online.running.replay import DiffersError, ReplayVerifier, kept_calibration, kept_journal, replay
from armcal_online.running.session import Setup, opened
from armcal_online.sources.source import Incoming
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings
from armcal_online.tracking.state import State
from click.testing import CliRunner, Result
from fake_recalibrator import FakeRecalibrator
from recalibrations import Listed, PowerCutError, made, run, stepping, steps

pytestmark = pytest.mark.slow

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "configs" / "lrm_arm" / "demo.yaml"
SETTINGS = RecalibrateSettings(evaluator="interpreted", process_noise={"arm.mdh.theta*": "0.1 deg in 30 d"})
PACE = Pace(checkpoint_records=30, digest_records=7)


def armcal(*arguments: object) -> Result:
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


def told(*arguments: object) -> dict[str, Any]:
    done = armcal("replay", *arguments, "--json")
    assert done.exit_code == 0, done.output
    found: dict[str, Any] = json.loads(done.stdout)
    return found


@pytest.fixture(scope="module")
def calibration(demo_calibration: Path) -> Path:
    """The demonstration's."""
    return demo_calibration


def records() -> list[Incoming]:
    """The demonstration's poses, ten minutes apart: two outliers, then a joint's offset steps by 6 degrees."""
    data, found = Experiment.load(DEMO).read(), []
    for i, name in enumerate(data.ids):
        channels = {channel: float(values[i]) for channel, values in data.channels.items()} | {"time": 600.0 * i}
        if i in (20, 55):
            channels["tracker.y"] += 0.08
        if i >= 70:
            channels["arm.q3"] += np.radians(6.0)
        found.append(Incoming(name, channels, {}, 1e9 + i, "demo.csv", i + 1))
    return found


def going(folder: Path, calibration: Path, source: Listed, settings: Settings) -> Any:
    assert isinstance(settings, RecalibrateSettings)
    session = Recalibrator(Calibration.load(calibration), settings)
    return opened(Setup(folder, calibration, pace=PACE), session, source)


def sequence_of(folder: Path, name: str) -> int:
    return next(e.sequence for e in read_entries(folder / "journal") if e.kind == "record" and e.content["id"] == name)


def wandered(open_: Recalibration, folder: Path, names: Sequence[str]) -> None:
    """A rollback, a pause, and a rollback across a rollback."""
    steps(open_, 40)
    open_.roll_back(sequence_of(folder, names[24]))
    steps(open_, 10)
    open_.pause()
    open_.resume()
    steps(open_, 8)
    open_.roll_back(sequence_of(folder, names[44]))


def last_segment(folder: Path) -> Path:
    return max((folder / "journal").glob("journal-*.log"))


@pytest.fixture(scope="module")
def whole(calibration: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A recalibration with all that may happen to one, its calibration gone since."""
    base = tmp_path_factory.mktemp("whole")
    begun_from, folder, every = base / "start.yaml", base / "out", records()[:110]
    shutil.copy(calibration, begun_from)
    names = [record.record_id for record in every]
    with pytest.raises(PowerCutError), going(folder, begun_from, Listed(every[:80], cut=True), SETTINGS) as open_:
        wandered(open_, folder, names)
        open_.run()
    # What a kill leaves: the last notes are lost, and a line is half written.
    lines = last_segment(folder).read_bytes().splitlines(keepends=True)
    while b'"note":true' in lines[-1]:
        lines.pop()
    last_segment(folder).write_bytes(b"".join(lines) + lines[-1][:40])
    with going(folder, begun_from, Listed(every), SETTINGS) as open_:
        open_.run()
    begun_from.write_text("gone")
    return folder


@pytest.mark.slow
def test_every_state_comes_out_again_to_the_last_bit(whole: Path, tmp_path: Path) -> None:
    before = {path.name: path.read_bytes() for path in sorted((whole / "journal").iterdir())}
    out = tmp_path / "again.yaml"
    found = told(whole, "--calibration", out)
    assert found["states"]["compared"] == found["states"]["same_to_the_last_bit"] >= 15
    assert found["records"] == 110 and found["difference"] is found["damage"] is None and found["other_evaluator"] == []
    kinds = [decision["kind"] for decision in found["decisions"]]
    assert kinds.count("rollback") == 2 and any(kind.startswith("joint") for kind in kinds), kinds
    again, left = (yaml.safe_load(path.read_text()) for path in (out, whole / "calibration.yaml"))
    assert {k: v for k, v in again.items() if k != "created"} == {k: v for k, v in left.items() if k != "created"}
    assert before == {path.name: path.read_bytes() for path in sorted((whole / "journal").iterdir())}
    done = armcal("replay", whole / "journal", "--until", 60)
    assert done.exit_code == 0 and "all the same to the last bit" in done.output


@pytest.mark.slow
def test_the_calibration_as_it_was_at_any_entry(whole: Path, tmp_path: Path) -> None:
    checkpoint = [segment.checkpoint for segment in read_segments(whole / "journal")][2]
    session = Recalibrator(Calibration.load(whole / "calibration.yaml"), SETTINGS)
    session.restore(checkpoint.content["state"])
    out = tmp_path / "then.yaml"
    told(whole, "--until", checkpoint.sequence, "--calibration", out)
    written = yaml.safe_load(out.read_text())
    values = dict(zip(session.setup.space.parameters.entry_names, session.values.tolist(), strict=True))
    assert {entry["name"]: entry["value"] for entry in written["parameters"]}.items() <= values.items()
    assert written["recalibrated"]["sequence"] == checkpoint.content["state"]["sequence"]
    assert armcal("predict", out, "--poses", DEMO.with_suffix(".csv"), "--out", tmp_path / "p.csv").exit_code == 0


@pytest.mark.slow
@pytest.mark.skipif(find_compiler() is None, reason="no C compiler")
def test_another_evaluator_decides_alike(whole: Path) -> None:
    found = told(whole, "--evaluator", "compiled")
    assert any(text.startswith("backend") for text in found["other_evaluator"])
    assert found["states"]["compared"] >= 15 > found["states"]["same_to_the_last_bit"]
    assert found["decisions"] and found["difference"] is None
    done = armcal("replay", whole, "--evaluator", "compiled")
    assert done.exit_code == 0 and "another than the journal's" in done.output
    assert "decisions and levels are the same" in done.output


@pytest.mark.slow
def test_other_settings_are_told_beside_what_was_done(whole: Path, tmp_path: Path) -> None:
    until = read_until(whole / "journal", sequence_of(whole, records()[79].record_id))[1][-1].sequence
    same = told(whole, "--set", "gate.probability=0.999", "--until", until)
    assert same["other_settings"]["counts"] == same["counts"]
    assert same["other_settings"]["decisions"] == same["decisions"]
    assert same["other_settings"]["largest_difference"]["sd"] == 0
    assert same["other_settings"]["mean_innovation_mm"][0] == same["other_settings"]["mean_innovation_mm"][1] > 0
    config = tmp_path / "open.yaml"
    config.write_text("evaluator: interpreted\ngating: 'off'\n")
    other = told(whole, "--config", config, "--until", until)["other_settings"]
    assert other["counts"]["rejected"] == 0 < same["counts"]["rejected"]
    assert other["largest_difference"]["sd"] > 1
    assert [d["kind"] for d in other["decisions"] if d["kind"].startswith("joint")] == []
    done = armcal("replay", whole, "--config", config, "--until", 30)
    assert done.exit_code == 0 and "with other settings" in done.output and "mean innovation" in done.output


def test_damage_is_told_and_everything_before_it_is_replayed(whole: Path, tmp_path: Path) -> None:
    damaged = tmp_path / "damaged"
    shutil.copytree(whole, damaged)
    entry = [entry for entry in read_entries(whole / "journal") if entry.kind == "record"][30]
    path = damaged / "journal" / f"journal-{entry.segment:08d}.log"
    data = bytearray(path.read_bytes())
    data[entry.offset + 60] ^= 1
    path.write_bytes(bytes(data))
    done = armcal("replay", damaged, "--calibration", tmp_path / "c.yaml")
    assert done.exit_code == 2 and "damaged at byte" in done.stderr and path.name in done.stderr
    assert "all the same to the last bit" in done.stdout
    assert f"to {entry.sequence - 1}" in done.stdout
    wanted = told(whole, "--until", entry.sequence - 1, "--calibration", tmp_path / "d.yaml")
    assert wanted["last"] == entry.sequence - 1
    one, other = (yaml.safe_load((tmp_path / name).read_text())["parameters"] for name in ("c.yaml", "d.yaml"))
    assert one == other


@pytest.mark.slow
def test_a_state_or_a_decision_that_differs_is_told(whole: Path, calibration: Path) -> None:
    header = next(read_segments(whole / "journal")).header
    journal = kept_journal(whole / "journal")
    nudged = Recalibrator(Calibration.load(calibration), SETTINGS)
    belief = nudged.state.belief
    mean = belief.gaussian.mean.copy()
    mean[0] += 1e-9
    moved = replace(belief, gaussian=replace(belief.gaussian, mean=mean))
    nudged.state = State(moved, moved)
    done = replay(journal, nudged, ReplayVerifier(header["evaluator"]), None, no_progress)
    assert done.difference is not None and done.entries < 10
    drift = {"event": "decision", "kind": "drift", "sequence": 7, "sentence": "A drift."}
    with pytest.raises(DiffersError, match="noted was"):
        ReplayVerifier({}).compare_events(7, [drift], [])
    with pytest.raises(DiffersError, match="noted was nothing"):
        ReplayVerifier({}).unnoted_events(7, [drift])


def test_what_cannot_be_replayed_ends_with_2(whole: Path, tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    for arguments, expected in (
        ((tmp_path / "gone",), "no such folder"),
        ((tmp_path / "empty",), "no journal here"),
        ((whole, "--until", 100000), "found no entry 100000"),
        ((whole, "--calibration", whole / "calibration.yaml"), "belongs to the recalibration"),
        ((whole, "--calibration", whole / "journal" / "c.yaml"), "belongs to the recalibration"),
        ((whole, "--calibration", tmp_path / "no" / "c.yaml"), "no file can be written"),
        ((whole, "--set", "gaet.probability=0.9"), "gaet"),
        ((whole, "--config", tmp_path / "gone.yaml"), "gone.yaml"),
    ):
        done = armcal("replay", *arguments)
        assert done.exit_code == 2 and expected in done.stderr and done.stdout == "", (arguments, done.output)


def replayed(folder: Path, compares: bool = True) -> tuple[Any, FakeRecalibrator]:
    fake: Any = FakeRecalibrator()
    verifier = ReplayVerifier(fake.evaluator) if compares else None
    done = replay(kept_journal(folder / "journal"), fake, verifier, None, no_progress)
    return done, fake


def test_a_journal_that_dropped_its_beginning_goes_on_from_what_it_keeps(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with stepping(folder, Listed(made(1, 40))) as (open_, _):
        steps(open_, 39)
        open_.roll_back(sequence_of(folder, "p8"))
        steps(open_, 1)
    limits = JournalLimits(segment_bytes=3000, total_bytes=12000)
    left = run(folder, Listed(made(1, 90)), limits=limits)
    journal = kept_journal(folder / "journal")
    assert journal.first.number > 1
    done, fake = replayed(folder)
    assert done.difference is None and fake.digest() == left.digest()


def test_a_rollback_to_what_is_no_longer_kept_goes_on_at_the_checkpoint_after_it(tmp_path: Path) -> None:
    folder = tmp_path / "out"
    with stepping(folder, Listed(made(1, 60))) as (open_, _):
        steps(open_, 58)
        open_.roll_back(sequence_of(folder, "p8"))
        steps(open_, 10)
        end = open_.status()["digest"]
    segments = sorted((folder / "journal").glob("journal-*.log"))
    for path in segments[:2]:
        path.unlink()
    done, fake = replayed(folder)
    assert done.difference is None and fake.digest() == end
    assert [event["to"] for event in done.decisions if event["event"] == "decision" and "to" in event] == [
        sequence_of_first(done)
    ]
    with pytest.raises(DataError, match="no longer holds"):
        replayed(folder, compares=False)


def sequence_of_first(done: Any) -> int:
    """Where the rollback went."""
    return int(next(event["to"] for event in done.decisions if "to" in event))


def test_a_journal_without_its_calibration_is_refused(whole: Path) -> None:
    header = next(read_segments(whole / "journal")).header
    for changed in ({"text": None}, {"text": header["text"] + " "}):
        with pytest.raises(DataError, match="calibration"):
            kept_calibration({**header, **changed}, whole, discover())
