"""Checks of records that hold for every source, and the CSV writer on its own."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.base.units import from_unit
from armcal.errors import EXIT_BAD_INPUT, DataError, InputError, Location
from armcal.measure import checks
from armcal.measure.checks import Layout, check_dataset, layout_of, refuse_joint_count, set_aside_not_finite
from armcal.measure.reader import RequestedChannel
from armcal.measure.tables import column_names, write_csv
from numpy.typing import NDArray

Values = NDArray[np.float64]
JOINTS = ("arm.q1", "arm.q2")
POSITION = ("tracker.x", "tracker.y", "tracker.z")
WANTED = [RequestedChannel("arm.q1", ("arm.q1", "q1"), "angle", True)]


def layout(unit: str = "deg", by_line: bool = True) -> Layout:
    return Layout(
        joints=JOINTS,
        revolute=JOINTS,
        approach=("arm.approach.q1",),
        measured=POSITION,
        columns={"arm.q1": f"q1_{unit}", "arm.q2": f"q2_{unit}", "arm.approach.q1": "approach1", "time": "time_ms"},
        units={"arm.q1": unit, "arm.q2": unit, "time": "ms"},
        by_line=by_line,
    )


def records(count: int = 8, **changed: Values | list[float]) -> Dataset:
    """Different poses; ``arm_q1=...`` replaces the channel ``arm.q1``."""
    steps = np.arange(count, dtype=float)
    channels = {
        "arm.q1": np.radians(12.5 * steps),
        "arm.q2": np.radians(-7.0 * steps),
        "arm.approach.q1": np.sign(steps - 3),
        **{name: 0.1 * i + 0.01 * steps for i, name in enumerate(POSITION)},
    }
    for name, values in changed.items():
        channels[name.replace("_", ".")] = np.asarray(values, dtype=float)
    ids = tuple(f"p{i}" for i in range(count))
    return Dataset(ids, channels, rows=tuple(range(2, count + 2)), source="poses.csv")


def with_row(dataset: Dataset, index: int, other: int, *but: str) -> Dataset:
    """One record made like another, except in some channels."""
    channels = {name: values.copy() for name, values in dataset.channels.items()}
    for name, values in channels.items():
        if name not in but:
            values[index] = values[other]
    return Dataset(dataset.ids, channels, rows=dataset.rows, source=dataset.source)


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(DataError) as caught:
        call()
    assert caught.value.exit_code == EXIT_BAD_INPUT and caught.value.hint.endswith(".")
    return str(caught.value)


def test_good_records_pass_unchanged() -> None:
    dataset = records()
    assert check_dataset(dataset, layout()) is dataset


def test_layout_of_wanted_channels() -> None:
    wanted = (
        RequestedChannel("arm.q1", ("q1",), "angle", True),
        RequestedChannel("arm.approach.q1", ("approach1",), "1", False),
        RequestedChannel("arm.q2", ("q2",), "length", True),
        RequestedChannel("arm.approach.q2", ("approach2",), "1", False),
        RequestedChannel("payload", ("payload",), "mass", False),
        *(RequestedChannel(name, (name,), "length", True) for name in POSITION),
    )
    found = layout_of(wanted, records(), {"arm.q1": "q1_deg"}, {"arm.q1": "deg"}, by_line=False)
    assert found == Layout(
        JOINTS, ("arm.q1",), ("arm.approach.q1",), POSITION, {"arm.q1": "q1_deg"}, {"arm.q1": "deg"}, False
    )


def test_payloads_below_zero_and_times_in_milliseconds_are_refused_and_kelvin_is_warned_of() -> None:
    heavy = records(payload=[0.1, -0.02, 0.1, 0.1, 0.1, 0.1, 0.1, 0.1])
    assert "found a payload of -0.02" in refusal(lambda: check_dataset(heavy, layout()))
    late = records(time=[1.7e12 + 3000 * i for i in range(8)])
    assert "after the year 5000. If these are milliseconds" in refusal(lambda: check_dataset(late, layout()))
    assert check_dataset(records(time=[1.7e9 + 3 * i for i in range(8)]), layout()).warnings == ()
    warm = check_dataset(records(temperature=[295.0] * 8), layout())
    assert "is typically 295 C: are these kelvin?" in warm.warnings[0]
    assert check_dataset(records(temperature=[22.0] * 8), layout()).warnings == ()


def test_rows_are_named_as_rows_unless_they_are_lines() -> None:
    dataset = records(arm_approach_q1=[0.5] * 8)
    assert str(layout().where(dataset, 0, "arm.approach.q1")) == "poses.csv:2, approach1"
    found = refusal(lambda: checks.refuse_impossible(dataset, layout(by_line=False)))
    assert found.startswith("poses.csv, row 2, approach1: found the approach 0.5, expected -1, 0 or 1. Write the sign")


def test_missing_and_infinite_values_are_set_aside() -> None:
    dataset = records(tracker_x=[1, np.nan, 3, 4, np.inf, 6, 7, 8], arm_q1=[0, np.nan, 1, 1, 1, 1, 1, 1])
    kept = set_aside_not_finite(dataset, layout())
    assert kept.ids == ("p0", "p2", "p3", "p5", "p6", "p7")
    assert [(a.row, a.record_id) for a in kept.set_aside] == [(3, "p1"), (6, "p4")]
    assert kept.set_aside[0].reason == "q1_deg is empty or NaN, tracker.x is empty or NaN"
    assert kept.set_aside[1].reason == "tracker.x is infinite"
    (warning,) = kept.warnings
    assert warning == (
        "poses.csv: 2 of 8 records were set aside because values are missing or not finite: tracker.x in 2, "
        "q1_deg in 1 (the first: line 3). Fill them in, or measure these again."
    )


def test_no_record_left() -> None:
    dataset = records(2, tracker_x=[np.nan, np.nan])
    found = refusal(lambda: check_dataset(dataset, layout()))
    assert found.startswith("poses.csv: found no usable record: all 2 were set aside, the first because tracker.x")
    assert "it is empty" in refusal(lambda: checks.require_records(Dataset((), {})))


def test_radians_beyond_a_turn() -> None:
    dataset = records(arm_q2=[0, 1, 2, 6.28, -6.3, 0, 1, 2])
    found = refusal(lambda: checks.refuse_joint_units(dataset, layout("rad")))
    assert found.startswith("poses.csv:6, q2_rad: found -6.3 rad, more than one turn (2 pi rad): are these degrees? If")
    turn = records(arm_q2=[2 * np.pi] * 8)
    checks.refuse_joint_units(turn, layout("rad"))
    checks.refuse_joint_units(dataset, layout("deg"))


def test_a_prismatic_joint_has_no_turn() -> None:
    sliding = Layout(joints=JOINTS, revolute=("arm.q1",), measured=POSITION)
    assert len(check_dataset(records(arm_q2=np.arange(8.0) * 3), sliding)) == 8


def test_degrees_beyond_two_turns_are_refused_unless_the_joint_turns_without_end() -> None:
    """Angles that were converted to degrees twice look like this."""
    twice = from_unit(np.linspace(-57.3, 57.3, 8) * 57.3, "deg")
    found = refusal(lambda: checks.refuse_joint_units(records(arm_q1=twice), layout()))
    assert "more than two turns" in found and "continuous" in found
    checks.refuse_joint_units(records(arm_q1=twice), replace(layout(), revolute=()))


def test_tenths_of_a_degree() -> None:
    whole = from_unit(np.array([0.0, 1000, -900, 450, 5, 7, 11, 13]), "deg")
    found = refusal(lambda: checks.refuse_joint_units(records(arm_q1=whole), layout()))
    assert found.startswith("poses.csv:3, q1_deg: found 1000 deg in a column of whole numbers")
    assert "divide q1_deg by 10" in found
    checks.refuse_joint_units(records(arm_q1=whole * 0.7), layout())  # within 720
    assert "tenths" not in refusal(
        lambda: checks.refuse_joint_units(records(arm_q1=whole + 0.01), layout())
    )  # not whole


def test_degrees_that_may_be_radians() -> None:
    small = from_unit(np.linspace(-1.5, 1.5, 8), "deg")
    dataset = checks.warn_small_degrees(records(arm_q1=small, arm_q2=small), layout())
    (warning,) = dataset.warnings
    assert warning.startswith("poses.csv: no joint angle in q1_deg to q2_deg is beyond 1.5 deg: are these radians?")
    assert not checks.warn_small_degrees(records(arm_q1=small), layout()).warnings  # the other joint moves far
    assert not checks.warn_small_degrees(records(arm_q1=small, arm_q2=small), layout("rad")).warnings


def test_one_id_for_two_records() -> None:
    dataset = records()
    same = Dataset((*dataset.ids[:5], "p1", *dataset.ids[6:]), dataset.channels, rows=dataset.rows, source="poses.csv")
    found = refusal(lambda: check_dataset(same, layout()))
    assert found == (
        "poses.csv:7: the id 'p1' was given to another record before, at line 3, with other values. "
        "Give each record its own id, or remove one of the two."
    )


def test_a_copied_record_with_its_id_is_only_set_aside() -> None:
    dataset = with_row(records(), 5, 1)
    copied = Dataset((*dataset.ids[:5], "p1", *dataset.ids[6:]), dataset.channels, rows=dataset.rows)
    assert check_dataset(copied, layout()).set_aside[0].row == 7


def test_time_that_goes_backwards() -> None:
    moments = np.arange(200.0)
    moments[[50, 120]] = 3.5, 7
    kept = checks.set_aside_backward_time(records(200, time=moments), layout())
    assert [aside.row for aside in kept.set_aside] == [52, 122]
    assert kept.set_aside[0].reason == "its time 3500 ms is before 49000 ms of an earlier record"
    assert "2 of 200 records were set aside because the time goes backwards (the first: line 52)" in kept.warnings[0]
    moments[30] = 1000.0
    found = refusal(lambda: checks.set_aside_backward_time(records(200, time=moments), layout()))
    assert found.startswith("poses.csv:33, time_ms: found 169 of 200 records out of order in time (more than 1 %)")
    assert "Sort the records by time" in found
    assert not checks.set_aside_backward_time(records(4, time=[0, 1, 1, 2]), layout()).set_aside


def frozen(count: int) -> Dataset:
    dataset = records()
    for index in range(2, 1 + count):
        dataset = with_row(dataset, index, 1, *JOINTS)
    return dataset


def test_a_frozen_instrument() -> None:
    kept = checks.set_aside_frozen(frozen(5), layout())
    assert kept.ids == ("p0", "p1", "p6", "p7")
    assert kept.set_aside[0].reason == ("tracker repeats the values of line 3 while the joints moved: it had frozen")
    assert "4 of 8 records were set aside because the instrument had frozen (the first: line 4)" in kept.warnings[0]
    assert not checks.set_aside_frozen(frozen(4), layout()).set_aside


@pytest.mark.parametrize(("decimals", "count"), [(6, 1), (2, 0)])
def test_two_records_alike_to_the_last_digit_are_a_frozen_instrument(decimals: int, count: int) -> None:
    drawn = np.random.default_rng(3)
    numbers = {name: drawn.uniform(0, 1, 40).round(3) for name in JOINTS}
    numbers |= {name: drawn.uniform(0, 1, 40).round(decimals) for name in POSITION}
    for name in POSITION:
        numbers[name][7] = numbers[name][6]
    dataset = Dataset(tuple(f"p{i}" for i in range(40)), numbers)
    assert len(checks.set_aside_frozen(dataset, layout()).set_aside) == count


def test_an_arm_at_rest_is_not_a_frozen_instrument() -> None:
    dataset = records()
    for index in range(2, 7):
        dataset = with_row(dataset, index, 1)
    assert not checks.set_aside_frozen(dataset, layout()).set_aside


def test_one_of_two_instruments_frozen() -> None:
    dataset = frozen(5)
    both = Dataset(dataset.ids, {**dataset.channels, "second.d": np.arange(8.0)}, rows=dataset.rows)
    roles = Layout(joints=JOINTS, measured=(*POSITION, "second.d"))
    assert len(checks.set_aside_frozen(both, roles).set_aside) == 4


def test_a_position_of_zeros_was_not_measured() -> None:
    dataset = records()
    for channel in POSITION:
        dataset.channels[channel][[2, 5]] = 0.0
    dataset.channels[POSITION[0]][6] = 0.0
    kept = check_dataset(dataset, layout())
    assert [(a.row, a.reason) for a in kept.set_aside] == [
        (4, "tracker is exactly (0, 0, 0)"),
        (7, "tracker is exactly (0, 0, 0)"),
    ]
    assert "2 of 8 records were set aside because their position is exactly (0, 0, 0)" in kept.warnings[0]
    dataset.channels.update({channel: np.zeros(8) for channel in POSITION})
    assert not checks.set_aside_zeros(dataset, layout()).set_aside


def test_exact_duplicates() -> None:
    moments = np.arange(8.0)
    dataset = with_row(records(time=moments), 6, 2, "time")
    kept = check_dataset(dataset, layout())
    assert [(a.row, a.reason) for a in kept.set_aside] == [(8, "it is an exact duplicate of line 4")]
    assert "1 of 8 records was set aside because they are exact duplicates (the first: line 8)" in kept.warnings[0]
    assert len(kept.warnings) == 1


def test_negative_zero_is_zero() -> None:
    dataset = with_row(records(), 6, 0)
    dataset.channels["arm.q1"][6] = -0.0
    assert len(checks.set_aside_duplicates(dataset, layout()).set_aside) == 1


def test_poses_to_predict_may_repeat() -> None:
    dataset = with_row(records(), 6, 2)
    assert check_dataset(dataset, Layout(joints=JOINTS, revolute=JOINTS)) is dataset


def test_repeated_poses_count_once() -> None:
    dataset = with_row(with_row(records(), 6, 2, *POSITION), 7, 2, *POSITION)
    kept = check_dataset(dataset, layout())
    assert len(kept) == 8
    assert kept.warnings == (
        "poses.csv: 8 records at 6 poses (the first repeat: line 8 that of line 4). Records of one pose are held out "
        "together, unless you state which train; measure more different ones.",
    )
    from_other_side = with_row(records(), 6, 2, *POSITION, "arm.approach.q1")
    assert "8 records at 7 poses" in check_dataset(from_other_side, layout()).warnings[0]


@pytest.mark.parametrize(
    ("names", "counts", "field"),
    [
        (["q1_deg"], "1 joint columns, the arm has 2", "q2"),
        (["q1_deg", "q2", "q3_rad"], "3 joint columns, the arm has 2", "q3_rad"),
        (["q1_deg", "q2_deg", "q0", "q3", "q3_g"], None, None),
        (["joint1_deg"], None, None),
    ],
)
def test_joint_counts(names: list[str], counts: str | None, field: str | None) -> None:
    wanted = [RequestedChannel(name, (name, name[4:]), "angle", True) for name in JOINTS]
    wanted += [RequestedChannel(f"arm.approach.q{i}", (f"approach{i}",), "1", False) for i in (1, 2)]
    where = Location("poses.csv", line=1)
    if counts is None or field is None:
        refuse_joint_count(names, wanted, where)
        return
    found = refusal(lambda: refuse_joint_count(names, wanted, where))
    assert found.startswith(f"poses.csv:1, {field}: the file has {counts}") and "Use this arm's file" in found


def test_writing_replaces_whole_or_not_at_all(tmp_path: Path) -> None:
    target = tmp_path / "out.csv"
    target.write_text("old")
    dataset = Dataset(("1",), {"arm.q1": np.array([1.0])}, extra={"q1_deg": ("x",)})
    with pytest.raises(DataError, match=r"out\.csv, q1_deg: two columns would be called q1_deg\. Rename"):
        write_csv(target, dataset, WANTED)
    with pytest.raises(DataError, match=r"no column is known for the channel arm\.q1"):
        write_csv(target, dataset, [])
    assert target.read_text() == "old"
    write_csv(target, Dataset(("1",), {"arm.q1": np.array([1.0])}), WANTED, {"angle": "rad"})
    assert target.read_text() == "pose_id,q1_rad\n1,1.0\n"
    assert [path.name for path in tmp_path.iterdir()] == ["out.csv"]
    with pytest.raises(InputError, match=r"cannot be written.*in a folder that is there"):
        write_csv(tmp_path / "none" / "out.csv", Dataset((), {}), WANTED)
    with pytest.raises(ValueError, match="expected one of rad, deg, mrad"):
        column_names(WANTED, {"angle": "mm"})


def test_two_arms_keep_their_own_names() -> None:
    both = [RequestedChannel(f"{arm}.q1", (f"{arm}.q1", "q1"), "angle", True) for arm in ("left", "right")]
    assert column_names(both) == {"left.q1": ("left.q1_deg", "deg"), "right.q1": ("right.q1_deg", "deg")}
