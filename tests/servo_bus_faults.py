"""Measuring runs of an arm of smart servos while their bus, their power and the tracker fail, by seed."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from bench_runs import BenchRun

CONFIG = Path(__file__).resolve().parents[1] / "configs" / "so101" / "bench.yaml"
JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll")
POSES = 4
_LONGEST_S = 28.0
"""What the run takes when nothing goes wrong."""
_MOST_RESUMED = 4


@dataclass(frozen=True)
class FaultedRun:
    """How a run ended.

    Attributes:
        faults: that were planted.
        endings: of the run and of those that resumed it.
        measured, left_out: ids of poses.
        state: the bench's truth after it.
    """

    faults: list[dict[str, Any]]
    endings: list[str]
    measured: tuple[str, ...]
    left_out: tuple[str, ...]
    state: dict[str, Any]


def write_poses(path: Path, random: np.random.Generator, count: int = POSES) -> None:
    """Poses that are clear of everything, near the front of the arm."""
    low, high = np.array([-80, -50, -50, -40, -80]), np.array([80, 0, 0, 30, 80])
    rows = random.uniform(low, high, (count, 5)).round(2)
    head = ",".join(["pose_id", *(f"{joint}_deg" for joint in JOINTS)])
    lines = [f"p{i}," + ",".join(map(str, row)) for i, row in enumerate(rows, start=1)]
    path.write_text("\n".join([head, *lines]) + "\n", encoding="utf-8")


def faults_of(random: np.random.Generator) -> list[dict[str, Any]]:
    """Some faults at some times; what blinds or unplugs ends some seconds later."""
    faults: list[dict[str, Any]] = []
    for at in np.sort(random.uniform(0.0, _LONGEST_S, int(random.integers(3, 9)))).round(2).tolist():
        kind = str(
            random.choice(["line", "line", "line", "brown_out", "servo", "plug", "unplug", "jam", "heat", "eye"])
        )
        joint, later = str(random.choice(JOINTS)), at + round(float(random.uniform(0.3, 6.0)), 2)
        if kind == "line":
            fault = str(random.choice(["drop", "flip", "late", "duplicate", "split", "reorder"]))
            where = str(random.choice(["to_host", "to_board"]))
            unit = str(random.choice(["frames", "frames", "bytes"]))
            count = int(random.integers(1, 20))
            faults.append({"kind": fault, "direction": where, "unit": unit, "count": count, "at": at})
        elif kind == "brown_out":
            faults.append({"kind": "brown_out", "at": at})
        elif kind == "servo":
            faults.append({"kind": "brown_out", "joint": joint, "at": at})
        elif kind == "heat":
            faults.append({"kind": "heat", "joint": joint, "at": at})
        else:
            begin, end = {
                "plug": ("disconnect", "connect"),
                "unplug": ("unplug", "replug"),
                "jam": ("jam", "free"),
                "eye": ("lost", "seen"),
            }[kind]
            whose = {"joint": joint} if kind in ("plug", "jam") else {}
            faults += [{"kind": begin, "at": at, **whose}, {"kind": end, "at": later, **whose}]
    return faults


def faulted_run(seed: int, folder: Path) -> FaultedRun:
    """One run, resumed until it is done or does not go on."""
    random = np.random.default_rng([seed, 20])
    run = BenchRun(folder, (f"bench.simulator.seed={seed}",), CONFIG, "device")
    write_poses(run.plan, random)
    faults, endings = faults_of(random), []
    with run.simulated() as clock:
        for fault in faults:
            clock.ask({"fault": fault})
        for _ in range(1 + _MOST_RESUMED):
            try:
                ending = run.acquire().ending
            except Exception as refusal:
                endings.append(f"{type(refusal).__name__}: {refusal}")
            else:
                endings.append(f"{ending.how}: {ending.sentence}")
                if ending.how == "done":
                    break
            clock.sleep(60.0)  # somebody comes, and switches the servos off and on, as is said there
            clock.ask({"fault": {"kind": "brown_out"}})
        state = clock.ask({"state": True})
    progress = run.progress()
    return FaultedRun(faults, endings, tuple(progress.measured), tuple(progress.left_out), state)
