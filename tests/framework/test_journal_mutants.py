"""Journals whose entries or states are whole and say something else: a sentence, never a traceback."""

from __future__ import annotations

import json
import random
import shutil
import sqlite3
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.cli.main import cli
from armcal.io.journal import JOURNAL
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
SETTINGS = "evaluator: interpreted\n"
JUNK: tuple[Any, ...] = (None, True, -1, 1e300, 10**30, "", "x", [], {}, [1], {"a": 1})


@pytest.fixture(scope="module")
def kept(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a recalibration, beside what it began with."""
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
    return here


def _recalibrate(here: Path, out: Path, records: str) -> Result:
    given = [str(here / "run" / "calibration.yaml"), "--from", str(here / f"{records}.csv")]
    return CliRunner().invoke(
        cli, ["recalibrate", *given, "--config", str(here / "settings.yaml"), "--out", str(out), "-q"]
    )


def ended(here: Path, folder: Path, command: str) -> None:
    """With 0, or with 2 and a sentence that says where."""
    if command == "recalibrate":
        done = _recalibrate(here, folder, "then")
    else:
        done = CliRunner().invoke(cli, ["control", str(folder), "rollback", "good"])
    assert done.exception is None or isinstance(done.exception, SystemExit), repr(done.exception)
    assert done.exit_code in (0, 2)
    if done.exit_code == 2:
        assert str(folder) in done.stderr or "journal" in done.stderr or "record was good" in done.stderr
        assert len(done.stderr.strip()) > 40


def _places(content: Any, way: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    if way:
        yield way
    steps = content.items() if isinstance(content, dict) else enumerate(content) if isinstance(content, list) else ()
    for key, value in steps:
        yield from _places(value, (*way, key))


def rewritten(folder: Path, chance: random.Random) -> None:
    """One value of one entry, of a state or of the header is another or is missing."""
    with sqlite3.connect(folder / JOURNAL) as database:
        places = [
            *database.execute("SELECT 'entry', 'content', rowid, content FROM entry").fetchall(),
            *database.execute("SELECT 'checkpoint', 'state', rowid, state FROM checkpoint").fetchall() * 10,
            *database.execute("SELECT 'header', 'content', rowid, content FROM header").fetchall() * 10,
        ]
        table, column, row, text = chance.choice(places)
        content = json.loads(text)
        way = chance.choice([*_places(content)])
        inner = content
        for key in way[:-1]:
            inner = inner[key]
        if isinstance(inner, dict) and chance.random() < 0.4:
            del inner[way[-1]]
        else:
            inner[way[-1]] = chance.choice(JUNK)
        database.execute(f"UPDATE {table} SET {column} = ? WHERE rowid = ?", (json.dumps(content), row))
    database.close()


@pytest.mark.slow
@pytest.mark.parametrize("command", ["recalibrate", "rollback"])
@pytest.mark.parametrize("seeds", [range(8), *shares(8, 300, 3)])
def test_what_says_something_else_ends_with_a_sentence(kept: Path, tmp_path: Path, command: str, seeds: range) -> None:
    for seed in seeds:
        folder = tmp_path / "kept"
        shutil.copytree(kept / "kept", folder)
        rewritten(folder, random.Random(seed))
        ended(kept, folder, command)
        shutil.rmtree(folder)
