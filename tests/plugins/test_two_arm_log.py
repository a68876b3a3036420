"""Logs of motor angles: orders and gear ratios, delimiters and headers, still moments, and what is refused."""

from __future__ import annotations

import hashlib

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.errors import ArmcalError, DataError
from armcal.measure.reader import ReadRequest, requested_channels
from armcal.measure.rests import StillSettings, rests
from armcal_contact.contacts import BallInSocket, BallInSocketSettings
from armcal_dualarm.two_arms import ClosedChain, ClosedChainSettings, TwoArmLogReader, TwoArmLogSettings
from armcal_mdh.model import MdhModel, MdhSettings
from pydantic import ValidationError

ORDER = [1, 2, 7, 3, 4, 5, 6]
RATIOS = [100, 100, -100, 100, -101, 100, 100]
LEFT = {"columns": list(range(1, 8)), "order": ORDER, "gear_ratios": RATIOS}
RIGHT = {"columns": list(range(8, 15)), "order": ORDER, "gear_ratios": RATIOS}
BOTH = {"left": LEFT, "right": RIGHT}


def arm(name):
    rows = [{"a": 0.1, "alpha": 1.0}] * 7
    return Arm(name, "mdh", MdhModel(MdhSettings.si(convention="standard", rows=rows)), {}, ())


def request(**arms):
    arms = arms or {"left": arm("left"), "right": arm("right")}
    clamp = ClosedChain(ClosedChainSettings.si(noise=1e-4, orientation_noise=1e-3), tuple(arms))
    return ReadRequest(arms, {"clamp": clamp}, requested_channels(arms, {"clamp": clamp}, measured=True))


def joints(count, seed=1):
    """Both arms' joints from the base (count x 14)."""
    return np.random.default_rng(seed).uniform(-2.5, 2.5, (count, 14))


def motors(angles):
    """What the robot logs: its own joint number n is the joint from the base whose place in ORDER holds n."""
    table = np.empty_like(angles)
    for side in (0, 7):
        for from_base, (own, ratio) in enumerate(zip(ORDER, RATIOS, strict=True)):
            table[:, side + own - 1] = angles[:, side + from_base] * ratio
    return table


def text(table, delimiter=",", header=""):
    return header + "".join(delimiter.join(repr(float(x)) for x in row) + "\n" for row in table)


def read(folder, content, asked=None, **settings):
    path = folder / "log.txt"
    path.write_bytes(content if isinstance(content, bytes) else content.encode())
    given = TwoArmLogSettings.model_validate({"path": path, "arms": BOTH, **settings})
    return TwoArmLogReader(given).read(asked or request())


def refusal(folder, content, asked=None, **settings):
    with pytest.raises(DataError) as caught:
        read(folder, content, asked, **settings)
    assert caught.value.exit_code == 2 and str(folder) in str(caught.value) and caught.value.hint.endswith(".")
    return str(caught.value)


def read_joints(dataset):
    return dataset.stacked([f"{side}.q{i}" for side in ("left", "right") for i in range(1, 8)]).T


def test_joints_come_from_the_base_whatever_the_robot_calls_them(tmp_path):
    angles = joints(20)
    dataset = read(tmp_path, text(motors(angles)))
    np.testing.assert_allclose(read_joints(dataset), angles, rtol=1e-15)
    assert dataset.ids[:2] == ("1", "2") and dataset.rows[-1] == 20
    assert dataset.sha256 == hashlib.sha256((tmp_path / "log.txt").read_bytes()).hexdigest()


def test_the_third_joint_from_the_base_is_the_robots_seventh(tmp_path):
    row = np.zeros((1, 14))
    row[0, 6], row[0, 3] = 50.0, 202.0
    dataset = read(tmp_path, text(row))
    assert dataset.column("left.q3")[0] == -0.5 and dataset.column("left.q5")[0] == -2.0
    assert dataset.column("left.q7")[0] == 0.0 and dataset.column("right.q3")[0] == 0.0


@pytest.mark.parametrize("delimiter", [",", ";", "\t", "|", " ", "   "])
@pytest.mark.parametrize("header", [False, True])
def test_delimiters_and_headers_are_found(tmp_path, delimiter, header):
    angles = joints(5)
    names = [f"{side}{i}" for side in "lr" for i in range(1, 8)]
    content = text(motors(angles), delimiter, delimiter.join(names) + "\r\n" if header else "")
    dataset = read(tmp_path, "\ufeff" + content)
    np.testing.assert_allclose(read_joints(dataset), angles, rtol=1e-15)
    assert dataset.rows == tuple(range(1 + header, 6 + header))


def test_columns_by_name_with_time_and_labels(tmp_path):
    angles = joints(4)
    names = [f"{side}{i}" for side in "lr" for i in range(1, 8)]
    rows = text(motors(angles), ";").splitlines()
    lines = [f"ms;{';'.join(names)};clamp;note"] + [f"{20 * i};{row};c{i // 2};x" for i, row in enumerate(rows)]
    arms = {side: {**LEFT, "columns": [f"{side[0]}{i}" for i in range(1, 8)]} for side in ("left", "right")}
    dataset = read(tmp_path, "\n".join(lines), arms=arms, time="ms", time_unit="ms", labels={"clamp": "clamp"})
    np.testing.assert_allclose(read_joints(dataset), angles, rtol=1e-15)
    np.testing.assert_allclose(dataset.column("time"), [0, 0.02, 0.04, 0.06])
    assert dataset.extra == {"clamp": ("c0", "c0", "c1", "c1")}


def test_joint_angles_need_neither_order_nor_ratios(tmp_path):
    plain = {"left": {"columns": list(range(1, 8))}, "right": {"columns": list(range(8, 15))}}
    angles = joints(3)
    np.testing.assert_allclose(read_joints(read(tmp_path, text(angles), arms=plain)), angles, rtol=0)


def test_an_arm_without_columns_or_with_empty_cells_is_not_recorded(tmp_path):
    left_only = text(motors(joints(3))[:, :7])
    assert "found no usable record" in refusal(tmp_path, left_only, arms={"left": LEFT})
    arms = {"left": arm("left"), "right": arm("right")}
    apart = {side: BallInSocket(BallInSocketSettings.si(noise=1e-3, arm=side), tuple(arms)) for side in arms}
    asked = ReadRequest(arms, apart, requested_channels(arms, apart, measured=True))
    dataset = read(tmp_path, left_only, asked, arms={"left": LEFT})
    assert len(dataset) == 3 and np.isnan(dataset.column("right.q1")).all()
    rows = text(motors(joints(3))).splitlines()
    rows[1] = ",".join(rows[1].split(",")[:7]) + "," * 7
    dataset = read(tmp_path, "\n".join(rows), asked)
    assert len(dataset) == 3 and np.isnan(dataset.column("right.q4")).tolist() == [False, True, False]


def moving_log(rests, noise=2e-6, seed=4):
    """Rests of 50 rows with motions of 30 rows between (0.01 s a row); joints from the base."""
    random = np.random.default_rng(seed)
    rows = []
    for here, there in zip(rests, [*rests[1:], rests[-1]], strict=True):
        rows += [here + noise * random.uniform(-1, 1, 14) for _ in range(50)]
        rows += [here + (there - here) * (i + 1) / 31 for i in range(30)] if there is not here else []
    return np.array(rows)


@pytest.mark.parametrize("still", [{"samples": 20}, {"window": "0.2 s", "spread_deg": 0.01}, {"window_ms": 400}])
def test_a_continuous_log_is_reduced_to_its_rests(tmp_path, still):
    rests = list(joints(6, seed=7))
    log = moving_log(rests)
    table = np.column_stack([0.01 * np.arange(len(log)), motors(log)])
    arms = {"left": {**LEFT, "columns": list(range(2, 9))}, "right": {**RIGHT, "columns": list(range(9, 16))}}
    dataset = read(tmp_path, text(table), arms=arms, time=1, still=still)
    assert len(dataset) == 6
    np.testing.assert_allclose(read_joints(dataset), rests, rtol=0, atol=2e-6)
    assert dataset.rows == tuple(1 + 80 * i for i in range(6))
    np.testing.assert_allclose(dataset.column("time"), 0.245 + 0.8 * np.arange(6), atol=1e-9)
    assert any("was reduced to 6 still moments, the means of 300 of 450 rows" in text for text in dataset.warnings)


def test_a_rest_ends_with_its_label_and_with_a_pause(tmp_path):
    log = np.repeat(joints(1), 40, axis=0)
    rows = text(motors(log)).splitlines()
    times = 0.01 * np.arange(40) + np.where(np.arange(40) >= 30, 5.0, 0.0)
    lines = [f"{row},{times[i]},{'ab'[i >= 10]}" for i, row in enumerate(rows)]
    dataset = read(tmp_path, "\n".join(lines), time=15, labels={"clamp": 16}, still={"window_s": 0.05})
    assert dataset.rows == (1, 11, 31) and dataset.extra["clamp"] == ("a", "b", "b")


def plainly(joints, stops, spread):
    """Rests by trying every row, for joints that are all there."""
    found, start = [], 0
    while start < len(stops):
        stop = int(stops[start])
        if (np.ptp(joints[:, start:stop], axis=1) <= spread).all():
            while stop < joints.shape[1] and (np.ptp(joints[:, start : stop + 1], axis=1) <= spread).all():
                stop += 1
            found.append(slice(start, stop))
            start = stop
        else:
            start += 1
    return found


@pytest.mark.parametrize("seed", range(20))
def test_rests_are_those_that_trying_every_row_finds(seed):
    random = np.random.default_rng(seed)
    log = np.cumsum(random.normal(size=(3, 400)) * random.choice([0.0, 0.02, 1.0], 400, p=[0.6, 0.35, 0.05]), axis=1)
    samples = int(random.integers(2, 20))
    settings = StillSettings.si(samples=samples, spread=0.1)
    assert rests(log, (), None, settings) == plainly(log, np.arange(samples, 401), 0.1)
    time = np.cumsum(random.uniform(0.0, 0.02, 400))
    stops = [next((j + 1 for j in range(i + 1, 400) if time[j] - time[i] >= 0.1), None) for i in range(400)]
    timed = StillSettings.si(window=0.1, spread=0.1)
    assert rests(log, (), time, timed) == plainly(log, [stop for stop in stops if stop], 0.1)


def test_creeping_joints_are_not_at_rest(tmp_path):
    creeping = joints(1) + np.linspace(0, 0.1, 100)[:, None]
    found = refusal(tmp_path, text(motors(creeping)), still={"samples": 10, "spread_deg": 0.1})
    assert "found no moment at which no joint moves by more than 0.1 deg" in found


@pytest.mark.parametrize(
    ("content", "settings", "said"),
    [
        ("", {}, "log.txt: it is empty"),
        (text(motors(joints(2))) + "1,2\n", {}, "log.txt:3: found 2 cells, expected 14 as in the first row"),
        (text(motors(joints(2))[:, :13]), {}, "log.txt:1: found 13 columns, expected a column 14"),
        (
            text(motors(joints(1))) + "x," + text(motors(joints(1)))[:-1].partition(",")[2],
            {},
            "2, column 1: found 'x', exp",
        ),
        (text(100 * motors(joints(2))), {}, "left.q1 would stand at"),
        (
            "a,b\n1,2\n",
            {"arms": {"left": {**LEFT, "columns": list("abcdefg")}}},
            "log.txt:1, g: no column g, expected it",
        ),
        (
            text(motors(joints(2))),
            {"labels": {"clamp": "clamp"}},
            "found no header, expected one with the column clamp",
        ),
        (text(motors(joints(2))), {"arms": {"middle": LEFT}}, "no arm is called 'middle'; the arms are left, right"),
        (
            text(motors(joints(2))),
            {"arms": {"left": {"columns": [1, 2]}}},
            "2 columns for the arm left, which has 7 joints",
        ),
        (b"1,\xff\n", {}, "log.txt:1: found the byte 0xff at offset 2, which is not UTF-8 text"),
        ("a,a\n" * 2, {"arms": {"left": {"columns": list("abcdefg")}}}, "found the column a 2 times"),
    ],
)
def test_what_is_refused_and_where(tmp_path, content, settings, said):
    assert said in refusal(tmp_path, content, **settings)


def test_the_place_of_an_angle_beyond_a_turn_is_told(tmp_path):
    table = motors(joints(4))
    table[2, 6] = 700.0
    found = refusal(tmp_path, text(table))
    assert "log.txt:3, column 7: left.q3 would stand at -7 rad there, more than one turn (2 pi rad)" in found
    assert "Check order and gear_ratios" in found


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"arms": {}}, "at least 1"),
        ({"arms": {"left": {**LEFT, "order": [1, 2, 3, 4, 5, 6, 6]}}}, "expected each of 1 to 7 once"),
        ({"arms": {"left": {**LEFT, "gear_ratios": [100] * 6}}}, "expected one for each of 7 columns"),
        ({"arms": {"left": {**LEFT, "gear_ratios": [100] * 6 + [0]}}}, "found 0"),
        ({"arms": {"left": LEFT, "right": LEFT}}, "the column 1 is given twice"),
        ({"time": 3}, "the column 3 is given twice"),
        ({"still": {"window_s": 1}}, "needs the column of the time"),
        ({"still": {}}, "either window_s or samples"),
        ({"still": {"samples": 1}}, "greater than or equal to 2"),
        ({"still": {"samples": 5, "spread_deg": 0}}, "greater than 0"),
    ],
    ids=str,
)
def test_settings_that_make_no_sense(settings, said):
    with pytest.raises(ValidationError, match=said):
        TwoArmLogSettings.model_validate({"path": "log.txt", "arms": BOTH, **settings})


def test_damaged_logs_are_read_or_refused_by_an_armcal_error(tmp_path):
    random, refused, asked = np.random.default_rng(6), 0, request()
    whole = bytearray(text(motors(joints(6))).encode())
    for number in range(200):
        raw = bytearray(whole)
        for at in random.integers(len(raw), size=random.integers(1, 4)):
            raw[at] = random.choice([*b",;\n\t -.e9x", random.integers(256)])
        raw = raw[: random.integers(len(raw))] if number % 5 == 0 else raw
        try:
            read(tmp_path, bytes(raw), asked, still={"samples": 2, "spread_deg": 400} if number % 2 else None)
        except ArmcalError as fault:
            assert fault.exit_code == 2 and fault.hint
            refused += 1
    assert 20 < refused < 200
