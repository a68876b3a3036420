"""A table of faults planted at two simulated benches: what was planted, what armcal named, what it left unnamed."""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest
import yaml

from tests.framework.test_bench_faults_named import acquired
from tests.own_arms import POST, TOWER, OwnArm, said_by

pytestmark = pytest.mark.slow
TRACKER = "bench.simulator.tracker"


@dataclass(frozen=True)
class Planted:
    """A fault, how it is planted, the command to name it, and the words that do (none: it stays unnamed)."""

    what: str
    words: str
    command: str = "acquire"
    settings: tuple[tuple[str, Any], ...] = ()
    swap: tuple[str, str] | None = None
    servo: tuple[str, dict[str, Any]] | None = None


def wiring(kind: dict[str, Any]) -> list[Planted]:
    """Faults of plugs and servos."""
    one, other = kind["joints"][0], kind["joints"][1]
    truth = yaml.safe_load(kind["servos"])["servos"][other]
    reverse = {"pulses_us": truth["pulses_us"][::-1]}
    longer = {"angles_deg": [1.5 * angle for angle in truth["angles_deg"]]}
    return [
        Planted(f"{one} and {other} plugged into each other", "are swapped", "check", swap=(one, other)),
        Planted(f"{other} turns the other way", f"{other} turned by .*the other way", "check", servo=(other, reverse)),
        Planted(
            f"{other} is a servo of 1.5 times the range", f"{other}.*the wrong size", "check", servo=(other, longer)
        ),
    ]


def tracker() -> list[Planted]:
    """Units and handedness."""
    return [
        Planted("millimetres for metres", "as if mm came where m", settings=((f"{TRACKER}.length_gain", 1000),)),
        Planted("metres for millimetres", "as if m came where mm", settings=((f"{TRACKER}.length_gain", 0.001),)),
        Planted("inches for millimetres", "as if inch came", settings=((f"{TRACKER}.length_gain", 1 / 25.4),)),
        Planted("left-handed frame", "left-handed", settings=((f"{TRACKER}.mirrored", "z"),)),
        Planted("left-handed frame", "left-handed", "check", settings=((f"{TRACKER}.mirrored", "y"),)),
    ]


def sags(joint: str, speeds: tuple[float, ...]) -> list[Planted]:
    """A horn that slips, in deg/min for each N m; the slowest is below what stands of a second show."""
    key = f"bench.simulator.joints.{joint}.creep_deg_per_min"
    named = [
        Planted(
            f"{joint} slips {s:g} deg/min/N m",
            "the target moves by .* while the arm should stand",
            settings=((key, s),),
        )
        for s in speeds[:-1]
    ]
    return [*named, Planted(f"{joint} slips {speeds[-1]:g} deg/min/N m", "", settings=((key, speeds[-1]),))]


CASES = [
    (kind, planted)
    for kind, joint, speeds in ((TOWER, "lift", (300.0, 60.0, 0.3)), (POST, "b", (600.0, 150.0, 1.0)))
    for planted in (*wiring(kind), *tracker(), *sags(joint, speeds))
]


def named_by(folder: Path, kind: dict[str, Any], planted: Planted) -> tuple[int, str]:
    """The exit code, and what was said."""
    arm = OwnArm(folder, kind, **dict(planted.settings))
    if planted.swap:
        arm.swap(*planted.swap)
    if planted.servo:
        truth = yaml.safe_load(kind["servos"])
        truth["servos"][planted.servo[0]].update(planted.servo[1])
        (folder / "true.yaml").write_text(yaml.safe_dump(truth))
    with arm.run.simulated():
        if planted.command == "check":
            done = arm.armcal("servo", "--check", "--yes", sets=("bench.acquisition.settle.longest_s=3",))
            return done.exit_code, said_by(done)
        return acquired(arm, "--set", "bench.acquisition.settle.longest_s=5")


def test_what_is_planted_is_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    lines, wrong = [], []
    for number, (kind, planted) in enumerate(CASES):
        code, said = named_by(tmp_path / str(number), kind, planted)
        hit = re.search(planted.words, said) if planted.words else None
        named = "named" if hit else "left unnamed"
        lines.append(f"{kind['id']:<6}{planted.what:<46}{planted.command:<9}exit {code}  {named}")
        if bool(hit) != bool(planted.words) or (hit and code == 0):
            wrong.append(f"{lines[-1]}: {said[-600:]}")
    with capsys.disabled():
        print("\n" + "\n".join(lines))
    assert not wrong, "\n".join(wrong)
