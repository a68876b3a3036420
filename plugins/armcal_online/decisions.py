"""The kinds of decisions: what each means, what an operator does about it, and what would confirm it.

A new kind is one entry of ``KINDS`` and its section in docs/decisions.md, which says what happened, in general.
And the first screen for an operator on call, which a recalibration keeps from its own events and writes into
``status.json``. Whether that process still runs is not its own to say: ``present`` asks the control socket.
"""

from __future__ import annotations

import json
import math
import shlex
import time
from collections import deque
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any, Literal, get_args

from armcal.errors import InputError, Location
from armcal.io.json_server import JsonClient

if TYPE_CHECKING:  # the watcher reads this table, and has no need of numpy
    from armcal_online.window_evidence import Size

Level = Literal["nominal", "watch", "suspect", "lost"]  # of health
LEVELS: tuple[Level, ...] = get_args(Level)  # from the best to the worst


@dataclass(frozen=True)
class DecisionKind:
    """``do`` and ``confirm`` are whole sentences for somebody who cannot reach the arm.

    They may hold ``{subject}`` (the joint, instrument or link), ``{candidates}``, ``{calm}`` (how many records in a row
    without trouble improve the level) and ``{good}`` (where to roll back to).
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
    if known > 99.9:
        return "More than 99.9 % sure"
    return f"{known:.1f} % sure" if known > 99 else f"{known:.0f} % sure"


def advice(kind: str, names: Mapping[str, Any]) -> dict[str, str]:
    texts = KINDS[kind]
    return {"do": texts.do.format_map(names), "confirm": texts.confirm.format_map(names)}


def spoken_time(at: float) -> str:
    """A time as people read it: unix seconds as a date (1973 to 5138), seconds of another clock as they are."""
    return f"{datetime.fromtimestamp(at, UTC):%Y-%m-%d %H:%M:%S} UTC" if 1e8 < at < 1e11 else f"at {at:g} s"


STATUS, SOCKET = "status.json", "control.sock"
EVENTS, EARLIER = "events.jsonl", "events.jsonl.1"
SILENT_S = 15.0  # a recalibration that wrote no status for so long hangs, though its process is there
AFTER_THE_END = "Start the recalibration again before the arm's next work: the same command goes on where it stopped."
_OVER = {
    "ended": "The recalibration has ended",
    "stopped": "The recalibration stopped",
    "killed": "The recalibration was killed: no process answers here, and its last sign came",
    "hangs": "The recalibration hangs, or was killed: its last sign came",
}
_NEWEST = 20  # so many of the last readings show how far off the predictions are now
_MOST = 60
_CALM = "some"  # in the advice for a level for which no event stated how many records it takes

Event = Mapping[str, Any]


class Situation:
    """The first screen, kept from events; bounded."""

    def __init__(self) -> None:
        self._begin()

    def _begin(self) -> None:
        self._first: Event | None = None  # since the level was last nominal: the event that names the earliest record
        self._over: Event | None = None  # the change to nominal, or the roll-back, with which the last trouble ended
        self._decision: Event | None = None  # the last decision that meant trouble, also after it
        self._noted: deque[Event] = deque(maxlen=_MOST)
        self._off: deque[tuple[int, float]] = deque(maxlen=_MOST)  # entry and mm of the newest readings

    @classmethod
    def recovered(cls, folder: Path) -> Situation:
        known = cls()
        for name in filter(lambda name: (folder / name).is_file(), (EARLIER, EVENTS)):
            with suppress(OSError), (folder / name).open(encoding="utf-8", errors="replace") as lines:
                for line in lines:
                    with suppress(ValueError, TypeError, KeyError, AttributeError, RecursionError):
                        known.take(json.loads(line))
        return known

    def take(self, event: Event) -> None:
        kind = event["event"]
        if kind == "started" and event.get("resumed") is not True:
            self._begin()
        elif kind == "record" and event.get("residual_mm"):
            size = math.hypot(*event["residual_mm"])
            self._off.extend([(event["sequence"], size)] if math.isfinite(size) else [])
        elif kind in ("decision", "level"):
            level = _meant_level(event)
            if (kind == "level" and level == "nominal") or event.get("kind") == "rollback":
                self._first, self._over = None, event
                self._noted.clear()
            if level in LEVELS[1:] and event.get("kind") != "rollback":
                self._first = event if self._first is None else min(self._first, event, key=_first_record)
                self._noted.append(event)
                self._decision = event if kind == "decision" else self._decision

    def first_screen(self, level: str, good: Event | None, folder: Path) -> dict[str, Any]:
        """The first screen; ``off_mm`` is now, from ``off_of`` readings, ``off_before_mm`` before the last decision.

        ``earlier`` is the last decision where none matters now; ``since`` and ``last_good`` are each a record.
        """
        meant = [event for event in self._noted if _meant_level(event) == level]
        decided = [event for event in meant if event["event"] == "decision"]
        causes = [event for event in decided if event["sequence"] == decided[-1]["sequence"]]  # two may change at once
        cause = causes[-1] if causes else None
        leading = [event for event in meant if event.get("do")]
        newest = [event for event in leading if event["sequence"] == leading[-1]["sequence"]]
        # A decision says it better than the change of level that it makes.
        advice = dict.fromkeys(event["do"] for event in [e for e in newest if e["event"] == "decision"] or newest)
        good = good if self._first is None else self._first.get("last_good")
        back = self._over if self._over and self._over.get("kind") == "rollback" else None
        off = self._off_since(cause or back)
        screen: dict[str, Any] = {
            "do": " ".join(advice) or (back or {}).get("do") or _general_advice(level, good),
            "off_mm": float(f"{median(off):.4g}") if off else None,
            "off_of": len(off),
            "last_good": good,
            "rollback": good and f"armcal control {shlex.quote(str(folder))} rollback {good['sequence']}",
        }
        if cause is not None:
            screen["what"] = " ".join(f"{event['what']} {sure_to(event['sure_percent'])}." for event in causes)
            screen["confirm"] = " ".join(dict.fromkeys(event["confirm"] for event in causes if event.get("confirm")))
            screen["off_before_mm"] = cause.get("tip_error_mm")
        elif self._decision is not None:
            screen["earlier"] = self._decision["sentence"]
        start = self._first or self._over
        if start is not None:
            since = {"sequence": _first_record(start), "id": start.get("since_id")}
            since["at"] = start.get("since_at", start.get("at"))
            screen["since"] = {key: value for key, value in since.items() if value is not None}
        return screen

    def _off_since(self, cause: Event | None) -> Sequence[float]:
        """The newest readings after a decision; where none came yet, the newest alone, but after a roll-back none."""
        place = -1 if cause is None else cause["sequence"]
        after = [mm for sequence, mm in self._off if sequence > place][-_NEWEST:]
        none = cause is not None and cause.get("kind") == "rollback"
        return after or ([] if none else [mm for _, mm in self._off][-1:])


def _meant_level(event: Event) -> Any:
    return event["to"] if event["event"] == "level" else event.get("level")


def _first_record(event: Event) -> int:
    return int(event.get("since", event.get("sequence")) or 0)


def _general_advice(level: str, good: Event | None) -> str:
    words = {str(name): words for name, words in LEVEL_ADVICE.items()}
    if level not in words:
        return "Wait for the first record."
    there = f"record {good.get('id', good['sequence'])}" if good else "the calibration that it began from"
    return words[level].format_map({"calm": _CALM, "good": there})


def is_running(folder: Path) -> bool | None:
    """Whether a process answers at the control socket; None where this user may not ask."""
    try:
        JsonClient(folder / SOCKET, 1.0).close()
    except (PermissionError, TimeoutError):
        return None
    except OSError:
        return False
    return True


def present(folder: Path) -> dict[str, Any]:
    """The newest status in a folder, and whether what wrote it still runs, whatever it wrote last.

    ``life`` is ``waiting`` (before the first status), ``running``, ``ended``, ``stopped`` (by a fault), ``killed`` or
    ``hangs``; ``over`` is a sentence where nothing follows the arm, and ``do`` of the ``situation`` then says so too.
    """
    try:
        read = json.loads((folder / STATUS).read_text(encoding="utf-8", errors="replace"))
        status = read if isinstance(read, dict) else {}
    except (FileNotFoundError, ValueError, RecursionError):
        status = {}
    except OSError as fault:
        where, hint = Location(str(folder / STATUS)), "Ask as the user who recalibrates."
        raise InputError(f"it cannot be read ({fault.strerror}).", where=where, hint=hint) from fault
    life = _life(status, is_running(folder))
    now = dict(status.get("situation") or {"do": "Wait for the first record."})
    over = None
    if life in _OVER:
        at = status.get("at")
        began = f"{_OVER[life]} at {spoken_time(at)}" if at else _OVER[life]
        why = f": {status['fault']}" if life == "stopped" else "."
        over = f"{began}{why} Nothing follows the arm until it is started again; a roll-back works all the same."
        bad = status.get("level") in LEVELS[2:]
        now["do"] = f"{now['do']} {AFTER_THE_END}" if bad else AFTER_THE_END
    return {**status, "folder": str(folder), "situation": now, "life": life, "over": over}


def _life(status: Event, runs: bool | None) -> str:
    silent = time.time() - float(status.get("at") or 0.0) > SILENT_S
    if status.get("finished") and (not runs or silent):
        return "stopped" if status.get("fault") else "ended"
    if not status:
        return "running" if runs else "waiting"
    if runs is False:
        return "killed"
    return "hangs" if silent else "running"
