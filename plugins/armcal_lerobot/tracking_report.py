"""The comparison of leader and follower as numbers, tables and a page."""

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from armcal.cli.common import Console
from armcal.report.page import rendered
from armcal.version import __version__

from armcal_lerobot.comparison import (
    copy_findings,
    costs_at,
    findings_of,
    gravity_of,
    gripper_error,
    poses_of,
    shift_findings,
    shifts,
)
from armcal_lerobot.gripper import Gripper
from armcal_lerobot.motion import Motion
from armcal_lerobot.tracking import Tracking, trackings

LIMITS_OF_DATA = (
    "What one data set cannot show: its unit (degrees are assumed; else --units percent), a wrong zero of leader or "
    "follower (the follower is sent the leader's numbers and answers in its own), and play between a servo's encoder "
    "and the link. Compare two calibration files (armcal lerobot check), two data sets, or measure the gripper (armcal "
    "run)."
)
_FIGURES = ("delay_s", "gain", "offset", "backlash", "load")
Table = tuple[str, tuple[str, ...], list[list[str]]]
"""Caption, headings and rows."""


def compare_content(motions: Sequence[Motion], gripper: Gripper | None) -> dict[str, Any]:
    """Everything that one data set says, or two, and what differs from the first to the second."""
    followed = [trackings(m, gravity_of(gripper, m.motors) if gripper else None) for m in motions]
    sets = [_content(motion, of_set, gripper) for motion, of_set in zip(motions, followed, strict=True)]
    content: dict[str, Any] = {"sets": sets, "cannot_show": LIMITS_OF_DATA}
    if len(motions) < 2:
        return content
    moved = shifts(*motions)
    motors: dict[str, Any] = {}
    for shift in moved:
        one, two = (next(t for t in of_set if t.motor == shift.motor) for of_set in followed)
        entry: dict[str, Any] = {"unit": shift.unit, "doubt": shift.doubt}
        entry["start"] = asdict(shift.start) if shift.start else None
        for key in _FIGURES:
            first, second = getattr(one, key), getattr(two, key)
            entry[key] = asdict(second.minus(first)) if first and second else None
        motors[shift.motor] = entry
    if gripper is not None:
        figures = {s.motor: s.start.value for s in moved if s.start and s.unit == "deg"}
        for name, cost in costs_at(gripper, poses_of(motions[0], gripper), figures).items():
            motors[name]["start_mm"] = cost
    return {**content, "between": {"motors": motors, "findings": shift_findings(moved, *motions)}}


def show_compare(console: Console, content: Mapping[str, Any]) -> None:
    """The tables, what was found, and what the data cannot say."""
    for caption, headings, rows in _tables(content):
        console.table(caption, headings, rows)
    for text in _sentences(content):
        console.line(text)


def page(content: Mapping[str, Any], command: str) -> str:
    names = " and ".join(Path(folder).name for folder in content["data"])
    shown = {"title": names, "sentences": _sentences(content), "tables": _tables(content)}
    return rendered("compare.html.j2", {**shown, "command": command, "version": __version__}, Path(__file__).parent)


def _content(motion: Motion, followed: Sequence[Tracking], gripper: Gripper | None) -> dict[str, Any]:
    content: dict[str, Any] = {
        "frames": motion.frames,
        "of_frames": motion.of,
        "episodes": len(motion.starts),
        "motors": {t.motor: asdict(t) for t in followed},
        "findings": [*copy_findings(motion), *findings_of(followed)],
    }
    if gripper is None:
        return content
    angles, (at_rest, moving) = poses_of(motion, gripper), gripper_error(motion, followed, gripper)
    content["gripper_mm"] = {"at_rest": asdict(at_rest) if at_rest else None, "moving": asdict(moving)}
    for key in ("offset", "backlash"):
        figures = {t.motor: figure.value for t in followed if t.unit == "deg" and (figure := getattr(t, key))}
        for name, cost in costs_at(gripper, angles, figures).items():
            content["motors"][name][f"{key}_mm"] = cost
    return content


def _tables(content: Mapping[str, Any]) -> list[Table]:
    tables: list[Table] = []
    for folder, of_set in zip(content["data"], content["sets"], strict=True):
        name, motors = Path(folder).name, of_set["motors"]
        rows = [[motor, *_followed(entry), _shown(entry["delay_s"], 1000, 0)] for motor, entry in motors.items()]
        caption = f"State against command, 95 % intervals: {name}"
        tables.append((caption, ("motor", "unit", "gain", "offset", "backlash", "delay, ms"), rows))
        loaded = {motor: entry for motor, entry in motors.items() if entry["load"] or "offset_mm" in entry}
        rows = [
            [motor, _shown(entry["load"], 1, 2), *(_mm(entry.get(f"{key}_mm")) for key in ("offset", "backlash"))]
            for motor, entry in loaded.items()
        ]
        if rows:
            at_gripper = ("motor", "deg per N m", "offset, mm", "backlash, mm")
            tables.append((f"By gravity, and at the gripper: {name}", at_gripper, rows))
    if "between" in content:
        motors = content["between"]["motors"]
        rows = [
            [motor, entry["unit"], _shown(entry["start"], 1, 2), _mm(entry.get("start_mm")), *_followed(entry)[2:]]
            for motor, entry in motors.items()
        ]
        shown = ("motor", "unit", "begins", "mm", "offset", "backlash")
        tables.append(("The second data set less the first", shown, rows))
    return tables


def _followed(entry: Mapping[str, Any]) -> list[str]:
    return [entry["unit"], _shown(entry["gain"], 1, 3), *(_shown(entry[key], 1, 2) for key in ("offset", "backlash"))]


def _sentences(content: Mapping[str, Any]) -> list[str]:
    texts = []
    for folder, of_set in zip(content["data"], content["sets"], strict=True):
        name = Path(folder).name
        texts += [f"{name}: {text}" for text in of_set["findings"]]
        if (error := of_set.get("gripper_mm")) is not None:
            rest, moving = error["at_rest"], error["moving"]
            sizes = f"{rest['typical_mm']:.1f} mm typically and {rest['largest_mm']:.1f} mm at most" if rest else ""
            texts.append(
                f"{name}: the gripper is off its command by {sizes or 'an unknown distance'} at rest, by "
                f"{moving['typical_mm']:.1f} mm and {moving['largest_mm']:.1f} mm over all frames, where it trails."
            )
        for motor, entry in of_set["motors"].items():
            texts += [f"{name}: {motor}: {doubt}." for doubt in entry["doubts"]]
        if of_set["frames"] < of_set["of_frames"]:
            used = f"{of_set['frames']} of {of_set['of_frames']} frames"
            texts.append(f"{name}: {used} were used, of episodes evenly chosen.")
    between = content.get("between", {"findings": [], "motors": {}})
    texts += between["findings"]
    texts += [f"{motor}: {entry['doubt']}." for motor, entry in between["motors"].items() if entry["doubt"]]
    return [*texts, content["cannot_show"]]


def _shown(figure: Mapping[str, float] | None, factor: float, decimals: int) -> str:
    """A number and half of its interval; a dash where it is not known."""
    if figure is None:
        return "-"
    half = (figure["high"] - figure["low"]) / 2 * factor
    return f"{figure['value'] * factor:.{decimals}f} ±{half:.{decimals}f}"


def _mm(value: float | None) -> str:
    return "-" if value is None else f"{value:.1f}"
