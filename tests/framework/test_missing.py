"""Records that carry some measurements only: what costs a record, and what only one of its measurements."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.errors import DataError
from armcal.measure import checks
from armcal.measure.checks import (
    Layout,
    check_dataset,
    layout_of,
    set_aside_not_finite,
    warn_beyond_limits,
    with_absent,
)
from armcal.measure.reader import ReadRequest, RequestedChannel, evidence_channels, requested_channels
from armcal.testing.planar import Tip, planar_arms
from armcal_contact.contacts import BallInSocket, BallInSocketSettings
from armcal_tracker.csv_reader import CsvReader, CsvSettings
from armcal_tracker.position import TipPosition, TipPositionSettings

NAN, INF = np.nan, np.inf
JOINTS = ("left.q1", "left.q2", "right.q1", "right.q2")


def two_arms() -> tuple[dict[str, Arm], dict[str, Tip]]:
    return planar_arms(["left", "right"]), {"lt": Tip("left"), "rt": Tip("right")}


def wanted() -> tuple[RequestedChannel, ...]:
    return requested_channels(*two_arms(), measured=True)  # type: ignore[arg-type]


def records(count: int = 8, **changed: list[float]) -> Dataset:
    """Both arms and both trackers; ``lt_x=[...]`` replaces the first entries of ``lt.x``."""
    random = np.random.default_rng(1)
    names = (*JOINTS, *(f"{tracker}.{axis}" for tracker in ("lt", "rt") for axis in "xyz"))
    channels = {name: random.uniform(-2, 2, count) for name in names}
    for name, values in changed.items():
        where = name.replace("_", ".")
        channels.setdefault(where, np.ones(count))[: len(values)] = values
    return Dataset(tuple(f"p{i}" for i in range(count)), channels, rows=tuple(range(2, count + 2)), source="a.csv")


def layout(dataset: Dataset) -> Layout:
    return layout_of(wanted(), dataset, {}, {}, by_line=True)


def test_which_measurement_needs_which_channel() -> None:
    parts = {w.channel: w.parts for w in wanted()}
    assert parts["left.q1"] == parts["lt.x"] == ("lt",)
    assert parts["right.q2"] == parts["rt.z"] == ("rt",)
    assert parts["left.approach.q1"] == parts["gravity_x"] == parts["time"] == ()
    arms = planar_arms(["arm"])
    both = {"one": Tip(), "two": TipPosition(TipPositionSettings.si(noise=1e-3), ("arm",))}
    found = {w.channel: w.parts for w in requested_channels(arms, both, measured=True)}
    assert found["arm.q1"] == ("one", "two")
    assert found["two.noise_x"] == ("two",)


def test_a_record_of_one_arm_is_kept_and_the_other_measurement_is_left_out() -> None:
    dataset = records(right_q1=[NAN, NAN], right_q2=[NAN, NAN], rt_x=[NAN, NAN], rt_y=[NAN, NAN], rt_z=[NAN, NAN])
    kept = check_dataset(dataset, layout(dataset))
    assert len(kept) == 8 and not kept.set_aside and not kept.warnings
    assert np.isnan(kept.column("rt.x")[:2]).all() and np.isfinite(kept.column("rt.x")[2:]).all()
    assert np.isfinite(kept.column("lt.x")).all()


def test_a_measurement_that_is_there_in_part_is_left_out_with_one_warning() -> None:
    dataset = records(rt_x=[1, NAN, 1, NAN], right_q1=[1, 1, NAN])
    kept = check_dataset(dataset, layout(dataset))
    assert len(kept) == 8
    assert np.flatnonzero(np.isnan(kept.column("rt.y"))).tolist() == [1, 2, 3]
    assert kept.warnings == (
        "a.csv: rt is left out of 3 of 8 records, which have only a part of what it needs (the first: line 3). "
        "Fill in the rest, or leave out all.",
    )


def test_a_record_from_which_nothing_can_be_had_is_set_aside() -> None:
    dataset = records(rt_x=[NAN], lt_y=[NAN])
    kept = check_dataset(dataset, layout(dataset))
    assert [aside.record_id for aside in kept.set_aside] == ["p0"]
    assert kept.set_aside[0].reason == "lt.y is empty or NaN, rt.x is empty or NaN"


@pytest.mark.parametrize("channel", ["rt_x", "right_q1", "time"])
def test_what_is_infinite_costs_the_record(channel: str) -> None:
    dataset = records(**{channel: [1.0, INF]})
    assert [aside.record_id for aside in set_aside_not_finite(dataset, layout(dataset)).set_aside] == ["p1"]


@pytest.mark.parametrize("channel", ["left_approach_q1", "payload", "temperature"])
def test_what_belongs_to_no_measurement_costs_the_record(channel: str) -> None:
    dataset = records(**{channel: [0.0, NAN]})
    assert [aside.record_id for aside in set_aside_not_finite(dataset, layout(dataset)).set_aside] == ["p1"]


def test_a_missing_rate_which_only_the_verdict_reads_costs_nothing(tmp_path: Path) -> None:
    """Nor does a column that is called a rate and has no unit; of two arms' joints of one name nobody knows whose."""
    arms, tip = planar_arms(["arm"]), {"t": Tip()}
    evidence = evidence_channels(arms)
    assert [(w.channel, w.required) for w in evidence] == [("q1_rate", False), ("q2_rate", False)]
    assert evidence_channels(two_arms()[0]) == ()
    path = tmp_path / "records.csv"
    path.write_text("q1_rad,q2_rad,x_mm,y_mm,z_mm,q1_rate_deg_s,q2_rate\n0,1,2,3,4,180,6\n1,2,3,4,5,,7\n")
    request = ReadRequest(arms, tip, (*requested_channels(arms, tip, measured=True), *evidence))  # type: ignore[arg-type]
    dataset = CsvReader(CsvSettings(path=path)).read(request)  # type: ignore[arg-type]
    assert len(dataset) == 2 and not dataset.warnings and dataset.extra == {"q2_rate": ("6", "7")}
    assert dataset.column("q1_rate") == pytest.approx([np.pi, NAN], nan_ok=True)


def test_with_one_measurement_any_missing_value_costs_the_record() -> None:
    random = np.random.default_rng(2)
    arms, tip = planar_arms(["arm"]), {"t": Tip()}
    needed = [w for w in requested_channels(arms, tip, measured=True) if w.required]
    for w in needed:
        channels = {each.channel: random.uniform(-1, 1, 6) for each in needed}
        channels[w.channel][3] = NAN
        dataset = Dataset(tuple("abcdef"), channels)
        kept = check_dataset(dataset, layout_of(needed, dataset, {}, {}, by_line=True))
        assert [aside.record_id for aside in kept.set_aside] == ["d"], w.channel


def test_checks_of_joints_see_past_what_is_missing() -> None:
    dataset = records(right_q1=[NAN, NAN, 7.0], rt_x=[NAN, NAN])
    with pytest.raises(DataError, match=r"a\.csv:4, right\.q1: found 7"):
        check_dataset(dataset, layout(dataset))
    tenths = replace(layout(dataset), units={"right.q1": "deg"})
    whole = records(right_q1=[NAN, *np.radians([900.0, 10, 20, 30, 40, 50, 60])])
    with pytest.raises(DataError, match="tenths of a degree"):
        checks.refuse_joint_units(whole, tenths)
    small = records(right_q1=[NAN, *np.radians(np.linspace(1, 1.5, 7))])
    (warning,) = checks.warn_small_degrees(small, tenths).warnings
    assert "beyond 1.5 deg" in warning
    none = records(right_q1=[NAN] * 8)
    checks.refuse_joint_units(none, layout(none))
    assert not checks.warn_small_degrees(none, tenths).warnings


def test_an_instrument_is_frozen_by_what_it_reads_not_by_what_it_does_not() -> None:
    gaps = records(12, rt_x=[NAN] * 12, rt_y=[NAN] * 12, rt_z=[NAN] * 12)
    assert not checks.set_aside_frozen(gaps, layout(gaps)).set_aside
    every_other: dict[str, list[float]] = {f"rt_{axis}": [0.5, NAN] * 6 for axis in "xyz"}
    frozen = records(12, **every_other)
    aside = checks.set_aside_frozen(frozen, layout(frozen)).set_aside
    assert [each.record_id for each in aside] == ["p2", "p4", "p6", "p8", "p10"]
    assert "repeats the values of line 2" in aside[0].reason


def test_copies_are_found_among_records_with_gaps() -> None:
    dataset = records(rt_x=[NAN] * 8, rt_y=[NAN] * 8, rt_z=[NAN] * 8)
    for values in dataset.channels.values():
        values[5] = -values[2] if np.isnan(values[2]) else values[2]  # a NaN of another sign is a NaN
    assert [a.record_id for a in check_dataset(dataset, layout(dataset)).set_aside] == ["p5"]


def test_limits_are_told_of_records_that_have_the_joint() -> None:
    from armcal.arm.model import Chain
    from armcal.testing.planar import PlanarArm

    class Limited(PlanarArm):
        def chain(self, values: object) -> Chain:
            found = super().chain(values)  # type: ignore[arg-type]
            return replace(found, joints=tuple(replace(joint, limits=(-1.0, 1.0)) for joint in found.joints))

    arm = Arm("arm", "planar", Limited(), {}, ())
    dataset = Dataset(("a", "b", "c"), {"arm.q1": np.array([NAN, 1.5, 0.1]), "arm.q2": np.zeros(3)})
    (warning,) = warn_beyond_limits(dataset, {"arm": arm}, Parameters(())).warnings
    assert "in 1 of 3 records, at worst 85.94" in warning


def test_absent_channels_are_missing_everywhere() -> None:
    dataset = Dataset(("a",), {"left.q1": np.ones(1), "left.q2": np.ones(1)})
    found = with_absent(dataset, wanted())
    assert set(found.channels) == {*JOINTS, *(f"{t}.{axis}" for t in ("lt", "rt") for axis in "xyz")}
    assert np.isnan(found.column("rt.x")).all() and found.column("left.q1") is dataset.column("left.q1")
    assert with_absent(found, wanted()) is found


HEADER = "pose_id,q1_rad,q2_rad,x_mm,y_mm,z_mm,tracker.noise_mm,sockets.noise_mm,position,socket\n"


def read(folder: Path, text: str) -> Dataset:
    """One arm with a tracker and a ball."""
    arms = planar_arms(["arm"])
    ball = BallInSocket(BallInSocketSettings.si(noise=1e-4), ("arm",))
    both = {"tracker": TipPosition(TipPositionSettings.si(noise=1e-3), ("arm",)), "sockets": ball}
    (folder / "poses.csv").write_text(text)
    request = ReadRequest(arms, both, requested_channels(arms, both, measured=True))
    return CsvReader(CsvSettings(path=folder / "poses.csv")).read(request)


def test_tracker_rows_and_socket_rows_in_one_file(tmp_path: Path) -> None:
    rows = ["a,0.1,0.2,1,2,3,0.5,,,", "b,0.2,0.3,,,,,0.2,front,hole_0", "c,0.3,0.4,,,,,0.3,front,hole_1"]
    dataset = read(tmp_path, HEADER + "\n".join(rows))
    assert dataset.ids == ("a", "b", "c")
    np.testing.assert_array_equal(np.isnan(dataset.column("tracker.x")), [False, True, True])
    assert np.isfinite(dataset.column("tracker.noise")).all() and (dataset.column("tracker.noise") > 0).all()
    np.testing.assert_allclose(dataset.column("sockets.noise"), [3e-4, 2e-4, 3e-4])
    assert dataset.extra["socket"] == ("", "hole_0", "hole_1")
    (warning,) = dataset.warnings
    assert "sockets.noise_mm is empty in 1 of 3 records" in warning and "(0.3 mm)" in warning


def test_a_reading_without_its_noise_is_left_out(tmp_path: Path) -> None:
    rows = ["a,0.1,0.2,1,2,3,,0.2,f,s", "b,0.2,0.3,1,3,4,0.5,0.2,f,s"]
    dataset = read(tmp_path, HEADER + "\n".join(rows))
    np.testing.assert_array_equal(np.isnan(dataset.column("tracker.y")), [True, False])
    assert "tracker is left out of 1 of 2 records" in dataset.warnings[0]


def test_a_column_of_noise_that_is_empty_is_none(tmp_path: Path) -> None:
    rows = ["a,0.1,0.2,1,2,3,0.5,,f,s", "b,0.2,0.3,1,3,4,0.5,,f,s"]
    dataset = read(tmp_path, HEADER + "\n".join(rows))
    assert len(dataset) == 2 and not dataset.has("sockets.noise") and not dataset.warnings


def test_a_robot_at_rest_in_its_socket_is_no_copy(tmp_path: Path) -> None:
    rows = ["a,0.1,0.2,1,2,3,,,,", "b,0.2,0.3,,,,,,f,s", "c,0.2,0.3,,,,,,f,s", "d,0.1,0.2,1,2,3,,,,"]
    dataset = read(tmp_path, (HEADER + "\n".join(rows)).replace(",tracker.noise_mm,sockets.noise_mm", ",t,u"))
    assert dataset.ids == ("a", "b", "c")
