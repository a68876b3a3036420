"""What an operator reads of a decision: each kind has its words, and the numbers in them are right."""

from __future__ import annotations

import math
import re
from dataclasses import replace
from pathlib import Path
from string import Formatter
from typing import Any, get_args

import numpy as np
import pytest
from armcal.estimate.online import Gaussian
from armcal_online.belief import Belief
from armcal_online.decisions import (
    KINDS,
    LEVEL_ADVICE,
    LEVELS,
    Decision,
    advice,
    log_odds_of,
    per_cent,
    spoken_time,
    sure,
)
from armcal_online.hypotheses import Kind
from armcal_online.recalibrator import Recalibrator, decided, last_good, record_name
from armcal_online.sources import Incoming
from armcal_online.state import REMEMBERED, Arrival, Health, State, remembering, troubled
from online_arm import World, begun, predicted, random_poses, settings, told

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "decisions.md"
SOURCES = ROOT / "plugins" / "armcal_online"
NAMES = ("subject", "candidates", "calm", "good")
SLIP = math.radians(6.0)


def section(kind: str) -> str:
    """What docs/decisions.md says of a kind."""
    of = KINDS[kind]
    subject = {"joint": "the joint", "link": "the link"}.get(kind.partition("_")[0], "the instrument")
    texts = advice(kind, {"subject": subject, "candidates": "these joints", "calm": 16, "good": "the last good record"})
    level = f" The level becomes {of.level}." if of.level else ""
    return f"{level}\n\n- **Do:** {texts['do']}\n- **Confirm:** {texts['confirm']}\n"


# Words


@pytest.mark.parametrize("kind", KINDS)
def test_each_kind_says_what_to_do_and_what_confirms_it(kind: str) -> None:
    of = KINDS[kind]
    for words in (of.do, of.confirm):
        assert words[:1].isupper() or words.startswith("{"), words
        assert words.endswith((".", "?")) and len(words) > 20, words
        assert not re.search(r"\bbench\b|by hand|\btouch\b", words), "nobody is near the arm"
    fields = {name for words in (of.do, of.confirm) for _, name, _, _ in Formatter().parse(words) if name is not None}
    assert fields <= set(NAMES)
    assert of.level is None or of.level in LEVELS


@pytest.mark.parametrize("kind", KINDS)
def test_the_page_of_decisions_has_each_kind_as_it_is(kind: str) -> None:
    what, _, rest = PAGE.read_text().partition(f"## `{kind}`\n\n")[2].partition("\n\n## ")[0].partition("\n\n- **Do:**")
    level, _, advised = section(kind).partition("\n\n- **Do:**")
    assert what.endswith(level) and len(what) > 40, "what happened, in general, and the level"
    assert f"{rest.rstrip()}\n" == advised, f"docs/decisions.md lacks this of {kind}:\n\n{section(kind)}"


def test_whatever_can_be_decided_has_its_kind() -> None:
    """A kind that is written in the sources, or that a hypothesis has, is in the one table."""
    made = {kind for path in SOURCES.glob("*.py") for kind in re.findall(r"\bDecision\(\s*\"(\w+)\"", path.read_text())}
    assert len(made) >= 5
    apart = {"none", "two_changes"}  # of two changes at once each is a decision of its own kind
    assert made | set(get_args(Kind)) - apart <= set(KINDS)
    assert set(LEVEL_ADVICE) == set(LEVELS)


# Per cent


def test_per_cent_grows_with_log_odds_and_is_never_certain() -> None:
    odds = np.linspace(-40, 30, 1401)
    shown = np.array([per_cent(x) for x in odds])
    assert (np.diff(shown) > 0).all() and per_cent(0.0) == 50.0
    assert shown == pytest.approx(100 * np.exp(odds) / (1 + np.exp(odds)), rel=1e-12)
    for extreme in (-math.inf, -1e4, 1e4, math.inf):
        assert 0 <= per_cent(extreme) <= 100
        assert "100" not in sure(extreme)
    words = [float(text.group(1)) for x in odds if (text := re.search(r"([\d.]+) %", sure(float(x))))]
    assert words == sorted(words)
    for chance in (1e-290, 1e-9, 0.01, 0.5, 0.99):
        assert per_cent(log_odds_of(chance)) == pytest.approx(100 * (1 - chance))
    assert log_odds_of(0.0) > 600 and log_odds_of(1.0) == -700.0


def test_a_time_is_a_date_only_where_it_can_be_one() -> None:
    assert spoken_time(1041.5) == "at 1041.5 s"
    assert spoken_time(1.93e9) == "2031-02-27 23:06:40 UTC"
    assert record_name(7, Arrival("r3", 7, 12.0)) == "record r3 (at 12 s, entry 7)"
    assert record_name(7, None) == "entry 7"


# What is remembered


def test_no_record_is_good_from_the_first_that_a_decision_affects() -> None:
    belief = Belief(np.zeros(1), Gaussian(np.zeros(1), np.eye(1)))
    arrivals = tuple(Arrival(f"p{n}", n, float(n), is_good=n < 9) for n in range(1, 10))
    state = State(belief, ids=arrivals, sequence=9)
    found = Decision("unexplained", "Some records do not fit", "chance", 9.0, since=6)
    after = troubled(state, [found], is_good=False)
    assert [arrival.sequence for arrival in after.ids if arrival.is_good] == [1, 2, 3, 4, 5]
    assert last_good(after) == {"sequence": 5, "id": "p5", "at": 5.0}
    assert troubled(state, [], is_good=True).ids == (*arrivals[:-1], replace(arrivals[-1], is_good=True))


def test_at_a_worse_level_a_decision_advises_what_the_level_does() -> None:
    belief = Belief(np.zeros(1), Gaussian(np.zeros(1), np.eye(1)))
    found = Decision("drift", "Records miss by more than stated", "chance", 20.0, since=6)
    for level in LEVELS:
        state = State(belief, health=Health(level))
        event = decided(state, found, None, 16)
        worse = LEVELS.index(level) > LEVELS.index("watch")
        assert event["do"].startswith(LEVEL_ADVICE[level][:20] if worse else KINDS["drift"].do[:20])


def test_the_last_good_record_is_known_however_long_ago_it_was() -> None:
    belief = Belief(np.zeros(1), Gaussian(np.zeros(1), np.eye(1)))
    state = State(belief)
    for n in range(1, 3 * REMEMBERED):
        state = remembering(state, Arrival(f"p{n}", n, float(n), is_good=n <= 5))
    assert len(state.ids) == REMEMBERED and state.good == Arrival("p5", 5, 5.0, True)
    assert state.good_before(10_000) == state.good and state.good_before(5) is None
    assert State.from_dict(state.as_dict()).good == state.good
    state = remembering(state, Arrival("new", 10_000, 1.0, is_good=True))
    assert state.good_before(10_000) == state.good
    newest = state.good_before(10_001)
    assert newest is not None and newest.record_id == "new"


# A slip, and records that no arm explains


def taken(session: Recalibrator, records: list[Incoming], first: int) -> list[dict[str, Any]]:
    return [event for k, record in enumerate(records, first) for event in session.take(record, 10 + k)]


@pytest.fixture(scope="module")
def slipped() -> tuple[World, list[dict[str, Any]], float]:
    """A world, the events of a slip at its 31st record, and the median tip error (mm) that the slip makes."""
    session, world = begun(), World.drawn(3)
    events = taken(session, [world.record() for _ in range(30)], 1)
    before = world.values.copy()
    world.moved("arm.mdh.theta2", SLIP)
    poses = random_poses(np.random.default_rng(1), 300)
    away = [predicted(world.setup, world.values, q) - predicted(world.setup, before, q) for q in poses]
    events += taken(session, [world.record() for _ in range(12)], 31)
    return world, events, 1000 * float(np.median(np.linalg.norm(away, axis=1)))


@pytest.mark.slow
def test_a_decision_names_its_record_its_cost_and_where_to_go_back(slipped: Any) -> None:
    _, events, median_mm = slipped
    decision = told(events, "decision")[0]
    assert decision["kind"] == "joint_slipped" and decision["joint"] == "arm.q2"
    assert (decision["since"], decision["since_id"], decision["since_at"]) == (41, "p31", pytest.approx(1e9 + 31 * 900))
    assert decision["last_good"] == {"sequence": 40, "id": "p30", "at": pytest.approx(1e9 + 30 * 900)}
    assert decision["tip_error_mm"] == pytest.approx(median_mm, rel=0.5)
    assert "last 8 recorded poses" in decision["tip_error_is"]
    assert decision["sure_percent"] == per_cent(decision["log_odds"]) > 99
    assert decision["what"].startswith("Joint arm.q2 slipped by +")
    for words in ("record p31 (2001-09-09 09:31:40 UTC, entry 41)", "% sure", "mm off"):
        assert words in decision["sentence"]
    assert "log odds" not in decision["sentence"] + decision["why"]
    assert "roll back to record p30" in decision["confirm"] and "16 records" in decision["do"]
    level = told(events, "level")[0]
    assert level["to"] == "watch" and level["do"] and level["last_good"]["id"] == "p30"


@pytest.mark.slow
def test_records_that_nothing_explains_say_stop_and_where_to_go_back() -> None:
    """Readings that have nothing to do with the arm: the tip error is how far they lie off."""
    session, world = begun(), World.drawn(5)
    events = taken(session, [world.record() for _ in range(20)], 1)
    chance = np.random.default_rng(2)
    wrong = []
    for _ in range(40):
        record = world.record()
        shift = {f"tracker.{axis}": record.channels[f"tracker.{axis}"] + chance.normal(0, 0.1) for axis in "xyz"}
        wrong.append(Incoming(record.record_id, {**record.channels, **shift}, {}, record.arrived, "list", 1))
    events = taken(session, wrong, 21)
    decisions = told(events, "decision")
    lost = next(decision for decision in decisions if decision["kind"] == "model_no_longer_fits")
    assert lost["do"].startswith("Stop the arm's work.") and "roll back to record p20 (" in lost["do"]
    odd = next(decision for decision in decisions if decision["kind"] == "unexplained")
    assert odd["last_good"] == lost["last_good"] and lost["tip_error_mm"] > 10
    late = [r for r in told(events, "record") if odd["since"] <= r["sequence"] <= odd["sequence"]]
    away = [float(np.linalg.norm(record["residual_mm"])) for record in late]
    assert len(away) >= 4 and odd["tip_error_mm"] == pytest.approx(np.median(away), rel=0.01)
    assert lost["last_good"]["id"] == "p20" and lost["since"] > 30
    for decision in decisions:
        assert decision["what"] and decision["do"] and decision["confirm"] and 0 <= decision["sure_percent"] <= 100
    assert session.status()["last_good"]["id"] == "p20"


@pytest.mark.slow
def test_a_clock_that_jumps_says_what_to_do() -> None:
    session, world = begun(settings(clock={"longest_step_h": 1})), World.drawn(1)
    taken(session, [world.record()], 1)
    (note,) = told(taken(session, [world.record(seconds=1e6)], 2), "decision")
    assert note["kind"] == "clock" and note["what"] == note["sentence"] and note["do"].startswith("Go on.")


def test_a_decision_knows_its_level() -> None:
    assert Decision("drift", "It drifts", "so it is", 3.0, 1).level == "watch"
    assert Decision("drift", "It drifts", "so it is", 3.0, 1).sentence == "It drifts. 95 % sure: so it is."
    with pytest.raises(KeyError):
        _ = Decision("unheard_of", "", "", 0.0, 1).level
