"""The kinds of decisions: what each means, what an operator does about it, and what would confirm it.

A new kind is one entry of ``KINDS`` and its section in docs/decisions.md, which says what happened, in general.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Any, Literal, get_args

if TYPE_CHECKING:  # the watcher reads this table, and has no need of numpy
    from armcal_online.tracking.window_evidence import Size

Level = Literal["nominal", "watch", "suspect", "lost"]  # of health
LEVELS: tuple[Level, ...] = get_args(Level)  # from the best to the worst


@dataclass(frozen=True)
class DecisionKind:
    """One kind of decision.

    ``do`` and ``confirm`` are whole sentences for somebody who cannot reach the arm. They may hold ``{subject}`` (the
    joint, instrument or link), ``{candidates}`` (all that it may be), ``{calm}`` (how many records in a row without
    trouble improve the level) and ``{good}`` (where to roll back to).
    """

    do: str  # what to do now
    confirm: str  # what would confirm it, or show that it is wrong
    level: Level | None  # of health that it means; None: it says nothing about the arm
    explains: bool = False  # whether what did not fit is explained by it


KINDS: Mapping[str, DecisionKind] = {
    "joint_slipped": DecisionKind(
        do="Go on with coarse work. Take {calm} records at different poses before precise work.",
        confirm="Take 3 records that differ in {subject} alone: they fit if it slipped. If it slips again, the joint "
        "is loose: keep its load low. If they do not fit, roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "joint_replaced": DecisionKind(
        do="Stop precise work that needs {subject}. Take {calm} records with it at angles over its whole range, "
        "approached from both sides.",
        confirm="Was its servo replaced or restarted? If not, take the same pose three times: readings that differ "
        "from each other mean that the joint is loose.",
        level="watch",
        explains=True,
    ),
    "joint_stepped": DecisionKind(
        do="Go on with coarse work near the newest poses only. Take 3 records with {candidates} at clearly different "
        "angles, one joint at a time.",
        confirm="The decision joint_named follows as soon as a pose distinguishes them.",
        level="watch",
        explains=True,
    ),
    "joint_named": DecisionKind(
        do="Go on with coarse work. Take {calm} records at different poses before precise work.",
        confirm="Take 3 records that differ in {subject} alone: they fit if it was this joint. If they do not, roll "
        "back to {good}.",
        level="watch",
        explains=True,
    ),
    "sensor_moved": DecisionKind(
        do="Go on, in the new frame of {subject}. Measure targets again before the arm goes to them: positions from "
        "before are in the old frame. Take {calm} records at different poses before precise work.",
        confirm="Look at something fixed to the arm's base with {subject}: it appears moved if {subject} moved. If it "
        "did not, the arm changed: roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "payload_changed": DecisionKind(
        do="Go on. State the payload in the records, or let the tool set it down. Take {calm} records at different "
        "poses before precise work.",
        confirm="Is something in the gripper, or was it lost? Set it down and take 3 records: another decision of this "
        "kind takes the load away again. If nothing was picked up or set down, roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "gravity_tilted": DecisionKind(
        do="Go on with coarse work. Check the inclinometer, or state gravity as it is now. Take {calm} records at "
        "different poses before precise work.",
        confirm="Compare the stated direction of gravity with another sensor on the base: they differ by the size of "
        "the decision. If they agree, roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "link_bent": DecisionKind(
        do="Stop work that loads {subject}. Take 20 records at poses that move every joint.",
        confirm="The new records fit if it is bent. If the same decision comes again, it goes on giving way: keep its "
        "load low. If they do not fit, roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "joint_creeping": DecisionKind(
        do="Go on with coarse work; keep the load of {subject} low. State a process_noise for its zero. Take {calm} "
        "records at different poses before precise work.",
        confirm="The decision states how far the zero moves in a day. If it does not, another decision of this kind "
        "ends the trend; if the records do not fit, roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "sensor_drifting": DecisionKind(
        do="Go on, in the frame of {subject}. Measure targets again before the arm goes to them. Check the mount and "
        "the warm-up of {subject}.",
        confirm="Look at something fixed to the arm's base with {subject}, today and tomorrow: it appears to move. If "
        "it does not, the arm changed: roll back to {good}.",
        level="watch",
        explains=True,
    ),
    "one_of_several": DecisionKind(
        do="Stop precise work. Take 10 records at poses that move every joint, near and far, so that loads and lengths "
        "act differently. It is one of {candidates}.",
        confirm="A decision that names the one follows as soon as the records distinguish them.",
        level="suspect",
        explains=True,
    ),
    "drift": DecisionKind(
        do="Go on with coarse work. Take {calm} records at the poses of the work before precise work.",
        confirm="If it comes again within a day, it is no chance: state a larger process_noise, or a larger noise of "
        "the instrument.",
        level="watch",
        explains=True,
    ),
    "general_change": DecisionKind(
        do="Stop precise work. Take 20 records at poses that move every joint.",
        confirm="The new records fit and the level improves if the change is one of the parameters. If it does not "
        "after 20 records, roll back to {good}.",
        level="suspect",
    ),
    "unexplained": DecisionKind(
        do="Stop precise work. Take 10 records at poses that move every joint.",
        confirm="If the new records fit, the others were wrong measurements: look at dust, glare and the target. If "
        "they do not, a decision that names the change follows.",
        level="suspect",
    ),
    "model_no_longer_fits": DecisionKind(
        do="Stop the arm's work. Check the measurements first (target, lens, clock, joint readings). If they were "
        "wrong, roll back to {good}. If they are right, take 40 records all over the workspace, and calibrate "
        "again from the records since.",
        confirm="Go back to 3 poses recorded before: if they are measured as then, the arm is as it was, and the "
        "records between were wrong.",
        level="lost",
    ),
    "clock": DecisionKind(
        do="Go on. Set the clock of what sends the records.",
        confirm="The next records come without this note.",
        level=None,
    ),
    "rollback": DecisionKind(
        do="Take {calm} records at different poses before precise work.",
        confirm="The new records fit if the arm is as it was then.",
        level=None,
    ),
}
"""All kinds, by name."""

EXPLAINED = tuple(name for name, kind in KINDS.items() if kind.explains)
"""Decisions after which what did not fit is explained."""

LEVEL_ADVICE: Mapping[Level, str] = {
    "nominal": "Go on.",
    "watch": "Go on with coarse work. Take {calm} records at different poses before precise work.",
    "suspect": "Stop precise work. Take 10 records at poses that move every joint.",
    "lost": "Stop the arm's work. Roll back to {good}, or calibrate again.",
}
"""What to do at a level that no decision explains."""


@dataclass(frozen=True)
class Decision:
    """Something that was decided."""

    kind: str  # its name in ``KINDS``
    what: str  # what happened, a clause without a full stop
    why: str  # the evidence, a clause without a full stop
    log_odds: float  # of this against everything else that was considered
    since: int  # the number of the first record that it affects
    subject: str = ""  # a joint's channel, a measurement, or that of a cause
    candidates: tuple[str, ...] = ()  # what these records cannot distinguish, the likeliest first
    size: Size | None = None  # of a step

    @property
    def level(self) -> Level:
        return KINDS[self.kind].level or "nominal"

    @property
    def sentence(self) -> str:
        return f"{self.what}. {sure(self.log_odds)}: {self.why}."


def per_cent(log_odds: float) -> float:
    return 100 / (1 + math.exp(-min(max(log_odds, -700.0), 700.0)))


def log_odds_of(by_chance: float) -> float:
    chance = min(max(by_chance, 1e-300), 1.0)
    return math.log1p(-chance) - math.log(chance) if chance < 1 else -700.0


def sure(log_odds: float) -> str:
    return sure_to(per_cent(log_odds))


def sure_to(known: float) -> str:
    """How sure, in words; never ``100 %``."""
    if known > 99.9:
        return "More than 99.9 % sure"
    return f"{known:.1f} % sure" if known > 99 else f"{known:.0f} % sure"


def advice(kind: str, names: Mapping[str, Any]) -> dict[str, str]:
    """``do`` and ``confirm`` of a decision, with the names of its joints, instrument and records."""
    texts = KINDS[kind]
    return {"do": texts.do.format_map(names), "confirm": texts.confirm.format_map(names)}


def spoken_time(at: float) -> str:
    """A time as people read it: unix seconds as a date (1973 to 5138), seconds of another clock as they are."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M:%S} UTC" if 1e8 < at < 1e11 else f"at {at:g} s"
