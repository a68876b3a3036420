"""What requests are answered: against the calibration's own predictions, scipy's rotations, and any input at all."""

from __future__ import annotations

import json
import random
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import yaml
from armcal.arm.servo import PulseClock, PulseTable
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import sealed
from armcal.calibration.compensation import Commands
from armcal.calibration.intervals import beyond_records
from armcal.errors import ConfigError, DataError
from armcal_serve.answers import Answerer, command_rows
from armcal_serve.loading import Loader
from armcal_serve.protocol import ArmRequest
from armcal_serve.served_arm import ServedArm
from scipy.spatial.transform import Rotation
from serving import ROOT, answered, ask, described, foreign, loaded, made, sha256, told, variant

Q_DEG = [10.0, -20.0, 30.0, 40.0, -50.0, 60.0]
NAMES = [f"q{i}" for i in range(1, 7)]
HERE = {"position_mm": [1, 2, 3]}
NEAR = {"position_mm": [300, 60, 150]}
BEGINNING = ("armcal_serve", "id", "ok", "arm")
END = ("beyond_records", "warning", "calibration", "waited_ms", "took_ms")
LOAD = {"payload_g": 150, "gravity_m_s2": [0.5, -0.3, -1.5]}


@pytest.fixture(scope="module")
def path(demo_calibration: Path) -> Path:
    return demo_calibration


@pytest.fixture(scope="module")
def calibration(path: Path) -> Calibration:
    return Calibration.load(path)


@pytest.fixture(scope="module")
def answerer(path: Path) -> Answerer:
    return made(path.read_text())


def position(answer: dict[str, Any], row: int = 0) -> np.ndarray:
    return np.array(answer["tools"][row]["position_mm"])


@pytest.mark.slow
def test_forward_is_the_calibrations_prediction(answerer: Answerer, calibration: Calibration) -> None:
    postures = np.random.default_rng(1).uniform(-90, 90, (5, 6))
    answer = told(answerer, do="forward", joint_angles_deg=postures.tolist())
    assert list(answer) == [*BEGINNING, "tools", *END]
    expected = calibration.forward(np.deg2rad(postures))
    for row, pose in enumerate(expected):
        assert position(answer, row) == pytest.approx(pose[:3, 3] * 1000, abs=1e-6)
        w, *xyz = answer["tools"][row]["quaternion_wxyz"]
        assert Rotation.from_quat([*xyz, w]).as_matrix() == pytest.approx(pose[:3, :3], abs=1e-9)


def test_what_acts_is_what_a_record_would_say(answerer: Answerer, calibration: Calibration) -> None:
    channels = {f"arm.{name}": np.deg2rad([q]) for name, q in zip(NAMES, Q_DEG, strict=True)}
    channels |= {
        "payload": np.array([0.15]),
        **{f"gravity_{a}": np.array([g]) for a, g in zip("xyz", (0.5, -0.3, -1.5), strict=True)},
    }
    poses = calibration.predict(Dataset(("1",), channels))[1]
    answer = told(answerer, do="forward", joint_angles_deg=Q_DEG, **LOAD)
    assert position(answer) == pytest.approx(poses[0][0][:3, 3] * 1000, abs=1e-6)
    assert np.linalg.norm(position(answer) - position(told(answerer, do="forward", joint_angles_deg=Q_DEG))) > 0.1


@pytest.mark.parametrize(
    "said",
    [
        {"joint_angles_deg": [Q_DEG]},
        {"joint_angles_rad": np.deg2rad(Q_DEG).tolist()},
        {"joint_angles_mrad": (1000 * np.deg2rad(Q_DEG)).tolist()},
        {"joints": {f"{name}_deg": q for name, q in zip(reversed(NAMES), reversed(Q_DEG), strict=True)}},
        {"joints": [{f"{name}_rad": float(np.deg2rad(q)) for name, q in zip(NAMES, Q_DEG, strict=True)}]},
        {"joint_angles_deg": Q_DEG, "arm": "arm", "payload_kg": 0, "armcal_serve": 1},
        {"joint_angles_deg": Q_DEG, "approach": {"q1": 1}},
        {"joint_angles_deg": Q_DEG, "approach": [0, 0, 0, 0, 0, 0]},
    ],
)
def test_ways_to_say_the_same(answerer: Answerer, said: dict[str, Any]) -> None:
    reference = position(told(answerer, do="forward", joint_angles_deg=Q_DEG))
    assert position(told(answerer, do="forward", **said)) == pytest.approx(reference, abs=1e-9)


def test_commands_bring_the_calibrated_arm_there(answerer: Answerer, calibration: Calibration) -> None:
    tool = told(answerer, do="forward", joint_angles_deg=Q_DEG, **LOAD)["tools"][0]
    w, *xyz = tool["quaternion_wxyz"]
    roll_pitch_yaw = Rotation.from_quat([*xyz, w]).as_euler("xyz", degrees=True)  # about fixed axes
    start = (np.array(Q_DEG) + 3).tolist()
    found = []
    for rotation in ({"quaternion_wxyz": tool["quaternion_wxyz"]}, {"rpy_deg": roll_pitch_yaw.tolist()}):
        target = {"position_mm": tool["position_mm"], **rotation}
        answer = told(answerer, do="compensate", targets=target, start_deg=start, units="deg", **LOAD)
        assert list(answer) == [*BEGINNING, "joint_names", "commands", *END]
        (command,) = answer["commands"]
        assert command["reached"] and command["error_mm"] < 1e-5 and command["why_not"] == ""
        found.append(command["joint_angles_deg"])
    assert found[0] == pytest.approx(Q_DEG, abs=1e-5)
    assert found[1] == pytest.approx(Q_DEG, abs=1e-5)


def test_a_path_is_followed_and_what_is_out_of_reach_is_told(answerer: Answerer, calibration: Calibration) -> None:
    near = position(told(answerer, do="forward", joint_angles_deg=Q_DEG))
    targets = [{"position_mm": (near + np.array([0, 0, 2 * i])).tolist()} for i in range(4)]
    answer = told(answerer, do="compensate", targets=targets, start_deg=Q_DEG, path=True)
    commands = np.array([command["joint_angles_rad"] for command in answer["commands"]])
    assert np.abs(np.diff(commands, axis=0)).max() < 0.1
    poses = calibration.forward(commands)
    assert poses[:, :3, 3] * 1000 == pytest.approx(np.array([t["position_mm"] for t in targets]), abs=1e-4)
    far = told(answerer, do="compensate", targets=[{"position_m": [9, 0, 0]}])["commands"][0]
    assert not far["reached"] and far["why_not"] and far["error_mm"] > 8000


@pytest.mark.parametrize(
    ("request_", "where", "says"),
    [
        ({"do": "forwards"}, "do", "expected one of forward, compensate, status"),
        ({}, "do", "found nothing"),
        ({"do": "forward"}, "joint_angles_deg", "either joint_angles_deg or joints"),
        ({"do": "forward", "joint_angles_deg": Q_DEG, "joints": [{"q1_deg": 1}]}, "joints", "either joint_angles_deg"),
        ({"do": "forward", "joint_angles_deg": Q_DEG[:5]}, "joint_angles.0", "expected 6: q1, q2"),
        ({"do": "forward", "joint_angles": Q_DEG}, "joint_angles", "unit missing"),
        ({"do": "forward", "joint_angels_deg": Q_DEG}, "joint_angels_deg", "did you mean joint_angles_deg?"),
        ({"do": "forward", "joint_angles_deg": {"q1": 1}}, "joint_angles_deg", "expected a list"),
        ({"do": "forward", "joints": {"q1_deg": 1}}, "joints.0", "found no q2"),
        ({"do": "forward", "joints": {"q11_deg": 1}}, "joints.0", "joints are q1, q2"),
        ({"do": "forward", "joints": {"q1": 1}}, "joints.0", "expected a unit of angle"),
        ({"do": "forward", "joints": {"q1_mm": 1}}, "joints.0", "expected a unit of angle"),
        ({"do": "forward", "joints": {"q1_deg": 1, "q1_rad": 1}}, "joints.0", "twice"),
        ({"do": "forward", "joint_angles_deg": []}, "joint_angles", "1 to 1000"),
        ({"do": "forward", "joint_angles_deg": [Q_DEG] * 1001}, "joint_angles", "1 to 1000"),
        ({"do": "forward", "joint_angles_deg": [1, 2, 3, 4, 5, True]}, "joint_angles", "number"),
        ({"do": "forward", "joint_angles_deg": Q_DEG, "payload_g": -1}, "payload_g", "greater than or equal"),
        ({"do": "forward", "joint_angles_deg": Q_DEG, "arm": "left"}, "arm", "no arm 'left'"),
        ({"do": "forward", "joint_angles_deg": Q_DEG, "approach": [2] * 6}, "approach.0", "less than or equal"),
        ({"do": "forward", "joint_angles_deg": Q_DEG, "armcal_serve": 2}, "armcal_serve", "found 2, expected 1"),
        ({"do": "compensate", "targets": [{"position_mm": [1, 2]}]}, "targets.0.position_mm", "at least 3"),
        ({"do": "compensate", "targets": [{"rpy_deg": [1, 2, 3]}]}, "targets.0", "position_mm"),
        ({"do": "compensate", "targets": {"position_mm": [1, 2, 3], "rpi_deg": 1}}, "targets", "rpy_deg?"),
        ({"do": "compensate", "targets": HERE, "start_deg": [1], "start_joints": {"q1_deg": 1}}, "", "one of them"),
        ({"do": "compensate", "targets": HERE | {"quaternion_wxyz": [1, 1, 0, 0]}}, "targets.0", "length"),
        ({"do": "compensate", "targets": [HERE, HERE | {"rpy_deg": [0, 0, 0]}]}, "targets.1", "all of one kind"),
        ({"do": "compensate", "targets": HERE, "units": "counts"}, "units", "no pulse tables"),
        ({"do": "compensate", "targets": HERE, "start_deg": [1]}, "start", "expected 6"),
        ({"do": "compensate", "targets": [{"position_mm": [1e12, 0, 0]}]}, "targets", "this arm reaches 421 mm"),
    ],
)  # fmt: skip
def test_what_is_wrong_is_named_with_its_field(
    answerer: Answerer, request_: dict[str, Any], where: str, says: str
) -> None:
    answer = ask(answerer, id="x", **request_)
    assert list(answer) == ["armcal_serve", "id", "ok", "error", "hint", "where", *END[2:]]
    assert not answer["ok"] and answer["id"] == "x"
    assert says in f"{answer['error']} {answer['hint']}"
    assert answer["where"].startswith(where) or where in answer["error"], answer
    assert "Traceback" not in answer["error"]


@pytest.mark.parametrize(
    "line",
    [
        b"", b"{", b"null", b"7", b'"do"', b"[]", b"\xff\xfe", b"\x00", b'{"do": NaN}', b'{"id": Infinity}',
        b"[" * 100_000,
        b'{"a":' * 50_000, b'{"do": "forward", "joint_angles_rad": [1e999, 0, 0, 0, 0, 0]}', b"9" * 10_000,
        b'{"id": "\\ud800", "do": "forward"}', b'{"do": "forward", "joint_angles_rad": [-1e308, 1e308, 0, 0, 0, 0]}',
        b'{"do": "compensate", "targets": {"position_m": [1e300, -1e300, 1e200]}}', b'{"do": "\\u0073tatus"}',
        b'{"id": {"a": 1}, "do": "status"}', b'{"id": true}', json.dumps({"id": "x" * 1000}).encode(),
    ],
)  # fmt: skip
def test_any_line_has_an_answer(answerer: Answerer, line: bytes) -> None:
    answer = json.loads(answered(answerer, line))
    if "calibration" not in answer:
        assert b"tatus" in line and answer["id"] is None
        return
    assert answer["calibration"]["sequence"] == 1
    if not answer["ok"]:
        assert answer["error"] and "Traceback" not in answer["error"]
    assert told(answerer, do="forward", joint_angles_deg=Q_DEG)


@pytest.mark.slow
def test_thousands_of_damaged_requests(answerer: Answerer) -> None:
    chance = random.Random(5)
    whole = [
        {"id": 7, "do": "forward", "joint_angles_deg": [Q_DEG], **LOAD},
        {"id": 8, "do": "forward", "joints": {f"{n}_deg": 1.5 for n in NAMES}, "approach": {"q1": 1}},
        {"id": 9, "do": "compensate", "targets": [HERE | {"rpy_deg": [1, 2, 3]}], "start_deg": Q_DEG},
    ]  # fmt: skip
    odd = [b"null", b"[]", b"{}", b'"', b"1e400", b"-", b",", b"\xc3", b"true", b"[[", b"}}", b'"q9_deg":1', b"\x00"]
    for _ in range(3000):
        line = bytearray(json.dumps(chance.choice(whole)).encode())
        for _ in range(chance.randint(1, 4)):
            at = chance.randrange(len(line) + 1)
            line[at : at + chance.choice((0, 0, 1, 3, 12))] = chance.choice(odd)
        answer = json.loads(answered(answerer, bytes(line)))
        assert answer["ok"] in (True, False) and "failed (" not in answer.get("error", "")


def fake_arm(**dimensions: str) -> ServedArm:
    table = PulseTable((-1.0, 1.0), (0.001, 0.002))
    servos = {"q1": (table, PulseClock(25e6, 121))}
    return ServedArm("a", dimensions, SimpleNamespace(expression=SimpleNamespace(servos=servos)), False)


def commands(counts: Any = None) -> Commands:
    one = np.zeros(1)
    return Commands(
        joints=("q1", "s"),
        joint_angles=np.array([[0.5, 0.02]]),
        counts=counts,
        base_T_tool=np.eye(4)[None],
        base_T_point=np.eye(4)[None],
        distances=one + 1e-3,
        turns=one + np.pi / 180,
        reached=one > -1,
        reasons=("",),
        bounds=one,
        approach=np.array([[-1.0, 0.0]]),
    )


def test_counts_pulses_and_sliding_joints() -> None:
    arm = fake_arm(q1="angle", s="length")
    counted = commands(counts=np.array([[307, 0]]))
    (row,) = command_rows(arm, counted, "counts")
    assert (
        row["counts"] == [307, None]
        and row["approach"] == [-1, 0]
        and row["error_mm"] == 1.0
        and row["error_deg"] == pytest.approx(1.0)
    )
    (row,) = command_rows(arm, counted, "pulse_us")
    assert row["pulse_us"] == [pytest.approx(307 * 122 / 25), None]
    (row,) = command_rows(arm, commands(), "deg")
    assert row["joints"] == {"q1_deg": pytest.approx(28.64788975654116), "s_mm": 20.0}
    assert arm.posture({"s_mm": 5, "q1_deg": 180}, "joints.0") == pytest.approx([np.pi, 0.005])
    with pytest.raises(DataError, match="prismatic"):
        arm.posture([1.0, 2.0], "joint_angles.0")


def test_poses_beyond_the_records_are_named(answerer: Answerer, calibration: Calibration) -> None:
    """In the words of ``armcal predict``; commands are judged as postures are."""
    ranges = calibration.record.prediction.ranges if calibration.record.prediction else {}
    edges = np.rad2deg([ranges[f"arm.{name}"] for name in NAMES])
    middle = edges.mean(axis=1)
    far = middle + 0.7 * np.ptp(edges, axis=1) * (np.arange(6) == 1)
    answer = told(answerer, do="forward", joint_angles_deg=[middle.tolist(), far.tolist()])
    channels = {f"arm.{name}": np.deg2rad([a, b]) for name, a, b in zip(NAMES, middle, far, strict=True)}
    _, sentence = beyond_records(ranges, Dataset(("1", "2"), channels), calibration.system.arms)
    assert answer["beyond_records"] == [1] and answer["warning"] == sentence and "(q2 " in sentence
    moves = {"targets": answer["tools"], "path": True, "start_deg": middle.tolist()}
    heavy = told(answerer, do="compensate", **moves, payload_kg=9)
    assert heavy["beyond_records"] == [0, 1] and "payload 9000 g, recorded" in heavy["warning"]
    assert told(answerer, do="compensate", targets=answer["tools"][0], start_deg=middle.tolist())["warning"] == ""


def test_no_range_is_no_promise(answerer: Answerer) -> None:
    arm = replace(answerer.arms["arm"], recorded=None)
    assert arm.beyond_records(np.zeros((1, 6)), np.zeros((13, 1))) == (None, "")


def test_an_elastic_arm_whose_payload_nobody_states_asks_for_it(answerer: Answerer) -> None:
    arm = replace(answerer.arms["arm"], needs_payload=True)
    with pytest.raises(DataError, match="states its payload"):
        arm.loads(ArmRequest(do="forward"))
    assert arm.loads(ArmRequest.si(do="forward", payload=0.1))[3, 0] == 0.1


@pytest.mark.slow
def test_only_a_whole_calibration_of_the_same_arm_is_made_ready(path: Path, answerer: Answerer) -> None:
    text = path.read_text()
    loader = Loader("c.yaml", evaluator="interpreted")
    loaded(loader, text)
    moved = loaded(loader, variant(text, 1))
    assert moved.tag["sequence"] == 2
    here, there = (position(told(a, do="forward", joint_angles_deg=Q_DEG)) for a in (answerer, moved))
    assert there - here == pytest.approx([0, 0, 10], abs=1e-6)
    assert moved.tag["sha256"] == sha256(variant(text, 1))
    for wrong, why in (
        (foreign(text), "another arm"),
        (sealed({**yaml.safe_load(text), "converged": False}), "did not converge"),
        (text.replace("converged: true", "converged: false"), "edited or damaged"),
        ("armcal_calibration: 1\n", "it was cut"),
        ("\x00\n", r"c\.yaml"),
        (text.rpartition("\n#")[0] + "\n", "does not end in the hash of its content: it was cut"),
    ):
        with pytest.raises(ConfigError, match=why) as caught:
            loaded(loader, wrong)
        assert caught.value.exit_code == 2


@pytest.mark.slow
def test_commands_stay_within_what_a_configuration_allows(path: Path) -> None:
    text, folder = path.read_text(), ROOT / "configs" / "lrm_arm"
    config = shutil.copytree(folder, path.with_name("configs")) / "plan.yaml"
    plan = config.read_text().replace("q1: [-100 deg, 100 deg]", "q1: [-5 deg, 5 deg]")
    config.write_text(plan)
    narrow = made(text, within=str(config))
    for q1, found in ((3.0, True), (30.0, False)):
        target = told(narrow, do="forward", joint_angles_deg=[q1, -20, 30, 40, -50, 20])["tools"][0]
        (command,) = told(narrow, do="compensate", targets=target, units="deg")["commands"]
        assert command["reached"] is found and abs(command["joint_angles_deg"][0]) <= 5 + 1e-9
    with pytest.raises(ConfigError, match="no plan"):
        made(text, within=str(folder / "demo.yaml"))


@pytest.mark.slow
def test_no_beginning_of_a_calibration_is_taken_for_one(path: Path) -> None:
    """However a writer is interrupted."""
    lines, loader = path.read_text().splitlines(keepends=True), Loader("c.yaml", evaluator="interpreted")
    for end in random.Random(3).sample(range(len(lines)), 60):
        with pytest.raises(ConfigError):
            loader.load("".join(lines[:end]).encode())


@pytest.mark.slow
@pytest.mark.parametrize("point", ["tool", "target"])
def test_a_calibration_that_takes_the_place_of_another_answers_by_its_own_numbers(path: Path, point: str) -> None:
    """Nothing is made anew but its numbers; where it frees another parameter, all of it is."""
    text = path.read_text()
    loader = Loader("c.yaml", evaluator="interpreted", point=point)  # type: ignore[arg-type]
    first = loaded(loader, text)
    content = yaml.safe_load(variant(text, 2))
    fixed = next(entry for entry in content["parameters"] if not entry["free"] and entry["name"] == "arm.mdh.d2")
    fixed["value"] = fixed["nominal"] = fixed["value"] + 0.004
    for changed, shared in ((variant(text, 1), True), (sealed(content), False), (text, True)):
        found, expected = loaded(loader, changed), made(changed, point=point)
        kept = found.arms["arm"].compensator.expression.record is first.arms["arm"].compensator.expression.record
        assert kept is shared or changed == text
        for request in ({"do": "forward", "joint_angles_deg": Q_DEG}, {"do": "compensate", "targets": NEAR}):
            one, other = told(found, **request), told(expected, **request)
            assert one["calibration"]["sha256"] == other["calibration"]["sha256"]
            posture = {"do": "forward", "joint_angles_deg": Q_DEG}
            assert position(told(found, **posture)) == pytest.approx(position(told(expected, **posture)), abs=1e-9)
            if request["do"] == "compensate":
                angles = [answer["commands"][0]["joint_angles_rad"] for answer in (one, other)]
                assert angles[0] == pytest.approx(angles[1], abs=1e-7)


@pytest.mark.slow
def test_other_statics_are_taken_with_the_calibration(path: Path) -> None:
    """As a recalibration writes them that found another payload on the arm."""
    text = path.read_text()
    content = yaml.safe_load(text)
    content["statics"]["payload_kg"] = 0.4
    heavy, loader = described(content), Loader("c.yaml", evaluator="interpreted")
    first = loaded(loader, text)
    found, expected = loaded(loader, heavy), made(heavy)
    assert found.arms["arm"].compensator.expression.record is first.arms["arm"].compensator.expression.record
    posture = {"do": "forward", "joint_angles_deg": Q_DEG}
    places = [position(told(one, **posture)) for one in (found, expected, first)]
    assert places[0] == pytest.approx(places[1], abs=1e-9)
    assert np.linalg.norm(places[0] - places[2]) > 0.5
    stated = [position(told(one, **posture, payload_g=150)) for one in (found, first)]
    assert stated[0] == pytest.approx(stated[1], abs=1e-9)


def test_many_targets_are_answered_as_each_alone_a_slice_at_a_time(answerer: Answerer) -> None:
    postures = np.random.default_rng(2).uniform(-60, 60, (100, 6))
    tools = told(answerer, do="forward", joint_angles_deg=postures.tolist())["tools"]
    for path in (False, True):
        request = {"do": "compensate", "targets": tools[: 20 if path else 100], "path": path, "start_deg": Q_DEG}
        slices = list(answerer.begin(json.dumps(request).encode(), 0.0))
        assert len(slices) > 20 and not any(slices[:-1])
        commands = json.loads(slices[-1] or b"")["commands"]
        assert len(commands) == len(request["targets"])
        if not path:
            for i in (0, 50, 99):
                alone = told(answerer, do="compensate", targets=tools[i], start_deg=Q_DEG)["commands"][0]
                assert commands[i]["joint_angles_rad"] == pytest.approx(alone["joint_angles_rad"], abs=1e-6)
    tools[77]["rpi_deg"] = 1
    answer = ask(answerer, do="compensate", targets=tools)
    assert "rpy_deg?" in answer["error"] and answer["where"].startswith("targets.77")


def test_a_request_that_raises_is_answered(answerer: Answerer, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ServedArm, "loads", lambda *given: 1 / 0)
    answer = ask(answerer, id=3, do="forward", joint_angles_deg=Q_DEG)
    assert answer["id"] == 3 and "it failed (ZeroDivisionError: division by zero)" in answer["error"]
    monkeypatch.undo()
    assert told(answerer, do="forward", joint_angles_deg=Q_DEG)
