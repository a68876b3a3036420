"""Journals with damaged bytes, and entries that are whole and say something else: a sentence, never a traceback."""

from __future__ import annotations

import json
import random
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.io.journal.frames import decode_frame, encode_frame
from click.testing import CliRunner, Result
from small_arms import TEXTS, calibration, predicted
from soak import shares

CONFIG = """
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.5}}
parameters: {free: ["arm.mdh.theta*", "arm.mdh.a2"]}
estimator: {type: ipopt}
data: {type: csv, path: all.csv}
validation: {holdout: 0, folds: 0}
evaluator: interpreted
"""
SETTINGS = "evaluator: interpreted\njournal: {segment_bytes: 6000}\n"
JUNK: tuple[Any, ...] = (None, True, -1, 1e300, 10**30, "", "x", [], {}, [1], {"a": 1})
COMMANDS = ("recalibrate", "watch")


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a recalibration with several segments, beside what it began with."""
    here = tmp_path_factory.mktemp("mutants")
    chance = np.random.default_rng(1)
    q = chance.uniform(-1, 1, (60, 3))
    tips = 1000 * predicted(calibration("rigid"), q)[:, :3, 3] + 0.5 * chance.normal(size=(60, 3))
    rows = [f"p{i}," + ",".join(map(repr, [*q[i].tolist(), *tips[i].tolist()])) for i in range(60)]
    head = "pose_id,q1_rad,q2_rad,q3_rad,x_mm,y_mm,z_mm"
    for name, chosen in (("all", rows), ("first", rows[:30]), ("then", rows[30:40])):
        (here / f"{name}.csv").write_text("\n".join([head, *chosen]) + "\n", encoding="utf-8")
    (here / "arm.yaml").write_text(TEXTS["rigid"] + CONFIG, encoding="utf-8")
    (here / "settings.yaml").write_text(SETTINGS, encoding="utf-8")
    done = CliRunner().invoke(cli, ["run", str(here / "arm.yaml"), "--out", str(here / "run"), "-q"])
    assert done.exit_code == 0, done.output
    done = _recalibrate(here, here / "kept", "first")
    assert done.exit_code == 0, done.output
    assert len(_files(here / "kept")) >= 3
    return here


def _recalibrate(here: Path, out: Path, records: str) -> Result:
    given = [str(here / "run" / "calibration.yaml"), "--from", str(here / f"{records}.csv")]
    return CliRunner().invoke(
        cli, ["recalibrate", *given, "--config", str(here / "settings.yaml"), "--out", str(out), "-q"]
    )


def _files(folder: Path) -> list[Path]:
    return sorted((folder / "journal").glob("journal-*.log"))


def ended(here: Path, folder: Path, command: str) -> None:
    """With 0, or with 2 and a sentence that says where."""
    if command == "recalibrate":
        done = _recalibrate(here, folder, "then")
    else:
        done = CliRunner().invoke(cli, [command, str(folder), *(["--once"] if command == "watch" else [])])
    assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
    assert done.exit_code in (0, 2)
    if done.exit_code == 2:
        assert str(folder) in done.stderr or "journal" in done.stderr
        assert len(done.stderr.strip()) > 40


def mutant(data: bytes, chance: random.Random) -> bytes:
    """Bytes flipped, written over, cut out, put in, cut off, zeroed as after a power cut, or a line repeated."""
    found, kind = bytearray(data), chance.randrange(7)
    at = chance.randrange(min(len(found), 120) if chance.random() < 0.3 else len(found))
    if kind == 0:
        found[at] ^= 1 << chance.randrange(8)
    elif kind == 1:
        found[at] = chance.randrange(256)
    elif kind == 2:
        del found[at : at + chance.randrange(1, 50)]
    elif kind == 3:
        found[at:at] = chance.randbytes(chance.randrange(1, 20))
    elif kind == 4:
        del found[at:]
    elif kind == 5:
        found[at : at + 512] = bytes(chance.randrange(1, 600))
    else:
        lines = bytes(found).split(b"\n")
        lines.insert(chance.randrange(len(lines)), chance.choice(lines))
        found = bytearray(b"\n".join(lines))
    return bytes(found)


def _places(content: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if way:
        yield way
    steps = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in steps:
        yield from _places(value, (*way, key))


def rewritten(folder: Path, chance: random.Random) -> None:
    """One value of one entry is another or is missing; every checksum is right."""
    frames = []
    for file in _files(folder):
        data, offset, crc = file.read_bytes(), 0, 0
        while offset < len(data):
            frame = decode_frame(data, offset, None, crc)
            offset, crc = frame.end, frame.crc
            frames.append((file, frame.sequence, json.loads(json.dumps(frame.payload))))
    states = [frame for frame in frames if frame[2]["kind"] in ("header", "checkpoint")]
    entry = chance.choice(chance.choice((frames, states)))[2]
    way = chance.choice([*_places(entry.get("content"), ("content",))])
    inner = entry
    for key in way[:-1]:
        inner = inner[key]
    if isinstance(inner, dict) and chance.random() < 0.4:
        del inner[way[-1]]
    else:
        inner[way[-1]] = chance.choice(JUNK)
    crc, texts = 0, dict.fromkeys(_files(folder), b"")
    for file, sequence, payload in frames:
        if not texts[file]:
            payload["previous"], crc = f"{crc:08x}", 0
        line, crc = encode_frame(sequence, json.dumps(payload, separators=(",", ":")).encode(), crc)
        texts[file] += line
    for file, text in texts.items():
        file.write_bytes(text)


@pytest.mark.quick("seeds0-watch")
@pytest.mark.parametrize("command", COMMANDS)
@pytest.mark.parametrize("seeds", [range(2), *shares(2, 300, 3)])
def test_damaged_bytes_end_with_a_sentence(kept: Path, tmp_path: Path, command: str, seeds: range) -> None:
    for seed in seeds:
        chance, folder = random.Random(seed), tmp_path / "kept"
        shutil.copytree(kept / "kept", folder)
        file = chance.choice(_files(folder))
        file.write_bytes(mutant(file.read_bytes(), chance))
        ended(kept, folder, command)
        shutil.rmtree(folder)


@pytest.mark.parametrize("command", COMMANDS[:1])
@pytest.mark.parametrize("seeds", [range(2), *shares(2, 300, 3)])
def test_whole_entries_that_say_something_else_end_with_a_sentence(
    kept: Path, tmp_path: Path, command: str, seeds: range
) -> None:
    for seed in seeds:
        folder = tmp_path / "kept"
        shutil.copytree(kept / "kept", folder)
        rewritten(folder, random.Random(seed))
        ended(kept, folder, command)
        shutil.rmtree(folder)
