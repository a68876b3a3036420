"""Mutated files through real commands: each is taken or refused with a sentence; no traceback, no hang, no hunger."""

from __future__ import annotations

import random
import resource
import shutil
import signal
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from types import FrameType

import pytest
from armcal.base.config_text import shown
from armcal.cli.main import cli
from click.testing import CliRunner
from made_calibrations import written
from small_arms import calibration
from soak import shares

LONGEST_S, MOST_KIB = 20, 1 << 20
_WAITS_S, _ALARMS = 120, (signal.SIGALRM, signal.SIGPROF)
"""Of the clock on the wall, for what waits and computes nothing; a busy machine is not a fault."""
SERVOS = Path(__file__).resolve().parents[2] / "plugins" / "armcal_pca9685" / "example_servos.yaml"
WORDS = (
    b"\0", b"\x1b[31m", b"\xff", b"\xef\xbb\xbf", b"\r", b"\n\n", b"\t", b" ", b"nan", b"-inf", b"1e999", b"1e-400",
    b"-", b":", b"[", b"{", b"]", b"'", b'"', b"#", b"&a ", b"*a", b"!!python/object:os.system ", b"<<: *a", b"~",
    b"null", b"true", b"0x1F", b"010", b"12:30", b"1_000", b"9" * 400, b",", b";", b"=", b"%", b"..",
    "\u202e\u00b5\u4e2d".encode(),
    b"../../etc/passwd", b"/dev/zero", b"<!DOCTYPE a [<!ENTITY b 'c'>]>", b"&#0;", b"</joint>", b"[/x]",
    b" mm", b" deg", b"_m", b"q1", b"- - - ", b"[[[[[[[[", b"{a: {a: {a: ", b"1.0e5", b"0", b"-0.0", b"1,5",
)  # fmt: skip

ARM = """arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{a_mm: 60, alpha_deg: 90}, {a_mm: 200}, {a_mm: 150}]}
    effects: {spring: {type: torsional_spring, joints: [q2]}}
    links: {hand: {mass_g: 50, com_mm: [0, 0, 0], frame: tool}}
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 10}
measurements: {tracker: {type: tip_position, noise_mm: 0.5, target_mm: [1, 2, 3]}}
data: {type: csv, path: data.csv}
parameters: {free: [arm.mdh.theta2, arm.spring.k2], priors: {arm.mdh.theta2: 2 deg}}
simulation:
  type: elastic_arm
  truth: truth.yaml
  seed: 1
  poses: {kind: random, count: 12, levels_deg: {q1: [-90, 90], q2: [-60, 60], q3: [-60, 60]}}
plan: {candidates: continuous, count: 12, limits_deg: {q1: [-90, 90], q2: [-60, 60], q3: [-60, 60]}}
validation: {holdout: 0.2, seed: 1}
evaluator: interpreted
"""
URDF = """<?xml version="1.0"?>
<robot name="r"><link name="base"/><link name="a"><inertial><mass value="1"/></inertial></link><link name="b"/>
  <joint name="q1" type="revolute"><origin xyz="0 0 0.3" rpy="0 0 0.1"/><parent link="base"/><child link="a"/>
    <axis xyz="0 0 1"/><limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="q2" type="revolute"><origin xyz="0.2 0 0"/><parent link="a"/><child link="b"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="1" velocity="1"/></joint>
</robot>
"""
TRUTH = "arm.mdh.theta2: 0.4 deg\narm.spring.k2: 0.02 rad/Nm\n"
TARGETS = "pose_id,x_mm,y_mm,z_mm,payload_g\na,300,20,50,10\nb,250,-40,80,0\n"
IN_URDF = "model: {type: urdf, path: arm.urdf}\n"


@dataclass(frozen=True)
class Case:
    """A file that is mutated, and the command that reads it."""

    file: str
    command: str


CASES = (
    Case("arm.yaml", "check arm.yaml"),
    Case("data.csv", "check arm.yaml"),
    Case("arm.urdf", "simulate urdf.yaml --out o.csv"),
    Case("arm.urdf", "convert urdf.yaml --to poe"),
    Case("truth.yaml", "simulate arm.yaml --out o.csv"),
    Case("arm.yaml", "plan arm.yaml --poses 4 --out o.csv"),
    Case("servos.yaml", "check servos_arm.yaml"),
    Case("targets.csv", "compensate calibration.yaml --targets targets.csv --out o.csv"),
    Case("poses.csv", "predict calibration.yaml --poses poses.csv --out o.csv"),
)


@pytest.fixture
def desk(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder with a file of each kind, none of them at fault."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("armcal.functions.compiler.find_compiler", lambda: None)
    written(calibration("three"), tmp_path / "calibration.yaml")
    urdf = ARM.replace(ARM.splitlines()[2].strip() + "\n", IN_URDF).replace(", q3: [-60, 60]", "")
    urdf = urdf.replace("links: {hand: {mass_g: 50, com_mm: [0, 0, 0], frame: tool}}", "links: {}")
    urdf = urdf.replace("parameters: {free: [arm.mdh.theta2, arm.spring.k2], priors: {arm.mdh.theta2: 2 deg}}\n", "")
    (tmp_path / "urdf_truth.yaml").write_text("arm.urdf.q2_x: 201 mm\narm.spring.k2: 0.002 rad/Nm\n", encoding="utf-8")
    urdf = urdf.replace("truth.yaml", "urdf_truth.yaml")
    texts = {"arm.yaml": ARM, "urdf.yaml": urdf, "arm.urdf": URDF, "truth.yaml": TRUTH}
    servos = "effects: {servo: {type: quantisation, servos: servos.yaml}, spring:"
    texts |= {"targets.csv": TARGETS, "servos_arm.yaml": ARM.replace("effects: {spring:", servos)}
    for name, text in texts.items():
        (tmp_path / name).write_text(text, encoding="utf-8")
    third = "  q3: {board: front, channel: 2, angles_deg: [-100.0, 0.0, 100.0], pulses_us: [620.0, 1540.0, 2460.0]}\n"
    (tmp_path / "servos.yaml").write_text(SERVOS.read_text(encoding="utf-8") + third, encoding="utf-8")
    assert call("simulate arm.yaml --out data.csv")[0] == 0
    shutil.copy(tmp_path / "data.csv", tmp_path / "poses.csv")
    return tmp_path


def call(command: str) -> tuple[int, str]:
    """Exit code and what was said; what nobody caught is raised."""
    ran = CliRunner().invoke(cli, command.split())
    if ran.exception is not None and not isinstance(ran.exception, SystemExit):
        raise ran.exception
    return ran.exit_code, ran.output


def mutated(data: bytes, dice: random.Random) -> bytes:
    """One to three small faults, as editors, disks, programs and people make them."""
    for _ in range(dice.choice((1, 1, 1, 2, 3))):
        data = dice.choice(FAULTS)(data, dice)
    return data


def _flipped(data: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(max(1, len(data)))
    return data[:at] + bytes([data[at] ^ (1 << dice.randrange(8))]) + data[at + 1 :] if data else data


def _cut(data: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(len(data) + 1)
    return data[:at] + data[at + dice.choice((1, 2, 10, 100, 10_000)) :]


def _doubled(data: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(len(data) + 1)
    return data[:at] + data[at : at + dice.choice((1, 5, 40))] * dice.choice((2, 3, 50)) + data[at:]


def _put(data: bytes, dice: random.Random) -> bytes:
    at = dice.randrange(len(data) + 1)
    return data[:at] + dice.choice(WORDS) * dice.choice((1, 1, 1, 300)) + data[at:]


def _number(data: bytes, dice: random.Random) -> bytes:
    """A number becomes something else."""
    places = [i for i in range(len(data)) if data[i : i + 1].isdigit()]
    if not places:
        return data
    at = end = dice.choice(places)
    while data[end : end + 1].isdigit() or data[end : end + 1] == b".":
        end += 1
    return data[:at] + dice.choice(WORDS) + data[end:]


def _lines(data: bytes, dice: random.Random) -> bytes:
    """Lines change places, go, or come twice."""
    lines = data.splitlines(keepends=True)
    if lines:
        one, other = dice.randrange(len(lines)), dice.randrange(len(lines))
        lines[one], lines[other] = lines[other], lines[one]
        lines[one : one + 1] = [lines[one]] * dice.choice((0, 1, 2))
    return b"".join(lines)


FAULTS: tuple[Callable[[bytes, random.Random], bytes], ...] = (_flipped, _cut, _doubled, _put, _number, _lines)


def tried(desk: Path, seed: int) -> str:
    """What went wrong with one mutation; empty if nothing did."""
    dice = random.Random(seed)
    case = CASES[seed % len(CASES)]
    path = desk / case.file
    whole = path.read_bytes()
    path.write_bytes(mutated(whole, dice))

    def late(number: int, frame: FrameType | None) -> None:
        raise TimeoutError(f"not done within {LONGEST_S} s")

    earlier = [signal.signal(each, late) for each in _ALARMS]
    signal.setitimer(signal.ITIMER_PROF, LONGEST_S)
    signal.alarm(_WAITS_S)
    try:
        code, said = call(case.command)
    except Exception as fault:  # whatever it is, it would be a traceback
        return f"seed {seed}, {case.file}, {case.command}: {type(fault).__name__}: {fault}"
    finally:
        signal.alarm(0)
        signal.setitimer(signal.ITIMER_PROF, 0)
        for each, before in zip(_ALARMS, earlier, strict=True):
            signal.signal(each, before)
        path.write_bytes(whole)
    fault = "" if code in (0, 2, 3) else f"exit code {code}"
    fault = fault or ("" if "Traceback" not in said and shown(said) == said else "a traceback or a control character")
    fault = fault or ("" if code == 0 or "armcal: " in said else "no sentence")
    return fault and f"seed {seed}, {case.file}, {case.command}: {fault}: {said[-300:]}"


def hunger_kib() -> int:
    """The most memory that this process had so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


@pytest.mark.slow
def test_the_files_are_taken_as_they_are(desk: Path) -> None:
    for case in CASES:
        code, said = call(case.command)
        assert code == 0, f"{case.command}: {said}"


@pytest.mark.parametrize("seeds", shares(0, 2000, 8))
def test_mutated_files_are_taken_or_refused_with_a_sentence(desk: Path, seeds: range) -> None:
    before = hunger_kib()
    faults = [fault for seed in seeds if (fault := tried(desk, seed))]
    assert not faults, "\n".join(faults)
    assert hunger_kib() - before < MOST_KIB


def test_a_truth_that_names_several_parameters_is_refused(desk: Path) -> None:
    (desk / "truth.yaml").write_text("arm.mdh.theta*: 0.4 deg\n", encoding="utf-8")
    code, said = call("simulate arm.yaml --out o.csv")
    assert code == 2 and "truth.yaml:1" in said and "stands for several names" in said and "arm.mdh.theta2" in said
