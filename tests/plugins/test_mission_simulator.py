"""The simulated mission: each thing that befalls the arm, against an oracle that does not go through the simulator."""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from pathlib import Path

import numpy as np
import pytest
from armcal.errors import ConfigError
from armcal.estimate.simulation import SimulationRequest, approach_of, measured_without_noise
from armcal.run.experiment import Experiment
from armcal_online.mission import MissionPlan
from armcal_online.mission_simulator import (
    DAY_S,
    Mission,
    MissionOfDays,
    MissionSettings,
    gravity_over,
    parsed_rate,
    with_payload,
)
from scipy.spatial.transform import Rotation

pytestmark = pytest.mark.slow

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "mission.yaml"
MOON = np.array([0.0, 0.0, -1.62])
TIP = [f"tracker.{axis}" for axis in "xyz"]
GRAVITY = [f"gravity_{axis}" for axis in "xyz"]
SLIP = {"kind": "slip", "day": 6.4, "joint": "arm.q3", "changes": {"arm.mdh.theta3": "14.4 deg"}}
CREEP = {"kind": "creep", "day": 1, "joint": "arm.q3", "changes": {"arm.mdh.theta3": "1 deg in 1 d"}}
QUIET = {
    "noise": 0.0,
    "creep": {},
    "thermal": {},
    "events": [],
    "power_cuts": [],
    "outliers.fraction": 0,
    "losses.fraction": 0,
    "losses.hours": 0,
    "tilt.most_deg": 0,
    "tilt.error_deg": 0,
}


@lru_cache
def experiment() -> Experiment:
    """The shipped mission's, without the sections that are not an experiment's."""
    return MissionPlan.load(CONFIG).experiment


def request() -> SimulationRequest:
    system = experiment().system
    return SimulationRequest(system.arms, system.measurements, experiment().parameters, system.environment)


def mission(quiet: bool = True, **changes: object) -> Mission:
    """The shipped simulation with other settings (SI); quiet is without anything that disturbs."""
    built = experiment().simulator()
    config = built._settings.to_config()
    for key, value in {**(QUIET if quiet else {}), **changes}.items():
        section, _, name = key.rpartition(".")
        target = config[section] if section else config
        for old in [k for k in target if k.partition("_")[0] == name.partition("_")[0]]:
            del target[old]
        target["noise_m" if key == "noise" else name] = value
    config.pop("noise") if config.get("noise", 1) is None else None
    made = type(built)(MissionSettings.model_validate(config))
    assert isinstance(made, MissionOfDays)
    return made.mission(request())


def tips(made: Mission) -> np.ndarray:
    return made.records.stacked(TIP).T


def tips_at(made: Mission, values: np.ndarray) -> np.ndarray:
    """What the ordinary simulator's forward model gives for one value vector (N x 3)."""
    asked = request()
    fixed = replace(asked, parameters=with_payload(asked.parameters).with_nominal(values))
    exact = measured_without_noise(fixed, made.records)
    return np.array([exact[name] for name in TIP]).T


@pytest.mark.slow
def test_the_same_seed_gives_the_same_mission_and_another_does_not() -> None:
    one, two, other = (mission(quiet=False, days=4, seed=seed, events=[]) for seed in (3, 3, 4))
    assert one.records.ids == two.records.ids and np.array_equal(one.outliers, two.outliers)
    assert all(np.array_equal(one.records.channels[name], two.records.channels[name]) for name in one.records.channels)
    assert len(other.records) != len(one.records) or not np.array_equal(tips(one), tips(other))


def test_records_come_in_order_in_working_hours_at_about_the_stated_rate() -> None:
    made = mission(days=20)
    times = made.times
    assert np.all(np.diff(times) > 0)
    hours = times % DAY_S / 3600
    assert hours.min() >= 8 and hours.max() < 18
    expected = 20 * 10 * 60 / 8
    assert abs(len(times) - expected) < 4 * np.sqrt(expected)
    assert np.all(np.diff(made.records.column("sequence")) == 1)
    assert np.allclose(made.records.column("time"), made.settings.began + times)
    assert made.settings.began == 1930089600.0  # date -d 2031-03-01T00:00:00Z +%s
    assert np.all(made.records.column("payload") == 0)


def test_a_still_mission_is_what_the_ordinary_forward_model_gives() -> None:
    made = mission(days=1)
    values = made.truth.values_at(np.zeros(1))[0]
    assert np.abs(tips(made) - tips_at(made, values)).max() < 1e-12


@pytest.mark.slow
def test_parameters_that_move_are_those_of_each_record() -> None:
    """Record by record through a model that knows one value vector at a time."""
    made = mission(quiet=False, days=8, noise=0.0, events=[SLIP], **{"outliers.fraction": 0, "tilt.error_deg": 0})
    values = made.truth.values_at(made.times)
    for i in np.linspace(0, len(made.times) - 1, 12).astype(int):
        alone = replace(made, records=made.records.subset([i]))
        assert np.abs(tips(made)[i] - tips_at(alone, values[i])[0]).max() < 1e-10


def stood(days: float, **tilt: float) -> tuple[np.ndarray, np.ndarray]:
    """Gravity in the base frame over some days, true and as the rover reads it (N x 3)."""
    settings = MissionSettings.model_validate({"truth": "truth.yaml", "days": days, "tilt": tilt})
    felt, told = gravity_over(np.linspace(0, days * DAY_S - 1, 4000), settings, MOON, random())
    return np.array([*felt.values()]).T, np.array([*told.values()]).T


def test_a_rover_that_pitches_feels_gravity_tilted_by_as_much_as_stated_anew_after_each_drive() -> None:
    felt, _ = stood(50, most_deg=20, drives_per_day=4)
    assert np.allclose(np.linalg.norm(felt, axis=1), 1.62)
    off = np.degrees(np.arccos(-felt[:, 2] / 1.62))
    assert 15 < off.max() < 20 and len(np.unique(off.round(9))) == pytest.approx(200, abs=45)


def test_the_rover_reads_its_tilt_as_wrong_as_stated() -> None:
    felt, told = stood(100, most_deg=20, drives_per_day=20, error_deg=0.2)
    off = np.degrees(np.arccos(np.clip(np.einsum("ni,ni->n", felt, told) / 1.62**2, -1, 1)))
    # about two axes of three, that of gravity shows nothing
    assert np.sqrt(np.mean(off**2)) == pytest.approx(0.2 * np.sqrt(2), rel=0.08)


def test_records_have_gravity_as_it_is_read_and_the_arm_bends_under_the_true_one() -> None:
    changes = {"tilt.most_deg": 20}
    right = mission(days=3, **changes, **{"tilt.error_deg": 0})
    wrong = mission(days=3, **changes, **{"tilt.error_deg": 1})
    assert np.allclose(tips(right), tips(wrong), atol=1e-12)
    assert not np.allclose(right.records.stacked(GRAVITY), wrong.records.stacked(GRAVITY), atol=1e-3)
    assert np.allclose(np.linalg.norm(wrong.records.stacked(GRAVITY), axis=0), 1.62)
    assert len({tuple(g) for g in right.records.stacked(GRAVITY).T}) > 3


def test_a_slip_shifts_tips_as_the_offset_parameter_does() -> None:
    slip = {"kind": "slip", "day": 1.0, "joint": "arm.q3", "changes": {"arm.mdh.theta3": "14.4 deg"}}
    plain, slipped = mission(days=2), mission(days=2, events=[slip])
    before = plain.times < DAY_S
    assert np.array_equal(tips(plain)[before], tips(slipped)[before])
    values = plain.truth.values_at(np.zeros(1))[0]
    values[plain.truth.parameters.entry_names.index("arm.mdh.theta3")] += np.deg2rad(14.4)
    assert np.abs(tips(slipped)[~before] - tips_at(plain, values)[~before]).max() < 1e-10
    assert set(moved_by(slipped, 1.0)) == {"arm.mdh.theta3"}


def test_a_swap_changes_offset_gain_and_play() -> None:
    changes = {"arm.mdh.theta2": "-3 deg", "arm.servo.gain2": 0.01, "arm.lag.lag2": "0.15 deg"}
    swap = {"kind": "swap", "day": 0.5, "joint": "arm.q2", "changes": changes}
    made = mission(days=1, events=[swap])
    values = made.truth.values_at(np.array([0.0, 0.9 * DAY_S]))
    moved = dict(zip(made.truth.parameters.entry_names, values[1] - values[0], strict=True))
    assert {name for name, change in moved.items() if change} == set(changes)
    assert moved["arm.mdh.theta2"] == pytest.approx(np.deg2rad(-3))
    assert moved["arm.servo.gain2"] == pytest.approx(0.01) and moved["arm.lag.lag2"] == pytest.approx(np.deg2rad(0.15))


def test_a_bump_is_a_rigid_motion_of_what_is_measured() -> None:
    bump = {"kind": "bump", "day": 1.0, "shift_mm": [3, -2, 1], "turn_deg": [0.2, 0.4, -0.3]}
    plain, bumped = mission(days=2), mission(days=2, events=[bump])
    after = plain.times >= DAY_S
    assert np.array_equal(tips(plain)[~after], tips(bumped)[~after])
    turned = Rotation.from_rotvec([0.2, 0.4, -0.3], degrees=True).apply(tips(plain)[after])
    assert np.abs(turned + np.array([0.003, -0.002, 0.001]) - tips(bumped)[after]).max() < 1e-12
    assert moved_by(bumped, 1.5) == {}
    poses = bumped.truth.camera_T_base_at(np.array([0.0, DAY_S]))
    assert np.array_equal(poses[0], np.eye(4)) and np.allclose(poses[1, :3, 3], [0.003, -0.002, 0.001])


@pytest.mark.slow
def test_losses_and_outliers_come_in_the_stated_fractions() -> None:
    whole = mission(days=60)
    made = mission(days=60, **{"losses.fraction": 0.1, "losses.hours": 0.2, "outliers.fraction": 0.05})
    count = len(whole.records)
    assert made.lost + len(made.records) == count
    assert made.lost / count == pytest.approx(1 - 0.9 * 0.8, abs=0.04)
    assert set(made.records.ids) < set(whole.records.ids)
    hours = {int(time // 3600) for time in whole.times} - {int(time // 3600) for time in made.times}
    assert len(hours) / 600 == pytest.approx(0.2, abs=0.06)
    assert made.outliers.mean() == pytest.approx(0.05, abs=0.015)
    kept = [whole.records.ids.index(each) for each in made.records.ids]
    away = np.linalg.norm(tips(made) - tips(whole)[kept], axis=1)
    assert np.array_equal(away > 1e-9, made.outliers)
    assert away[made.outliers].min() >= 0.0299 and away[made.outliers].max() <= 0.0601


@pytest.mark.slow
def test_noise_is_as_large_as_stated() -> None:
    clean, noisy = mission(days=20), mission(days=20, noise=0.0005)
    assert np.allclose((tips(noisy) - tips(clean)).std(axis=0), 0.0005, rtol=0.06)


@pytest.mark.slow
def test_temperature_goes_by_day_and_night_and_acts() -> None:
    thermal = {"arm.mdh.theta1": {"per_K": "0.01 deg", "reference_C": 20}}
    still, made = mission(days=2), mission(days=2, thermal=thermal)
    temperature = made.truth.temperature_at(np.array([2, 14, 20]) * 3600.0)
    assert np.allclose(temperature, [-20, 40, 10])
    thermal_state = made.records.column("temperature")
    assert np.allclose(thermal_state, made.truth.temperature_at(made.times))
    values = still.truth.values_at(np.zeros(1))[0]
    for i in (0, len(thermal_state) // 2, len(thermal_state) - 1):
        moved = values.copy()
        moved[made.truth.parameters.entry_names.index("arm.mdh.theta1")] += np.deg2rad(0.01) * (thermal_state[i] - 20)
        alone = replace(made, records=made.records.subset([i]))
        assert np.abs(tips(made)[i] - tips_at(alone, moved)[0]).max() < 1e-10


@pytest.mark.slow
def test_creep_goes_along_a_line_or_walks_at_random() -> None:
    assert parsed_rate("0.05 deg in 30 d") == ("0.05 deg", 30 * DAY_S, False)
    assert parsed_rate("walk 2 mm in 12 h") == ("2 mm", 12 * 3600.0, True)
    line = mission(days=30, creep={"arm.mdh.theta2": "-0.6 deg in 30 d"})
    at = line.truth.parameters.entry_names.index("arm.mdh.theta2")
    moved = np.degrees(np.diff(line.truth.values_at(np.array([0, 10, 30]) * DAY_S)[:, at]))
    assert np.allclose(moved, [-0.2, -0.4])
    ends = []
    for seed in range(25):
        walk = mission(days=9, seed=seed, creep={"arm.mdh.theta[1-6]": "walk 0.3 deg in 9 d"})
        places = [walk.truth.parameters.entry_names.index(f"arm.mdh.theta{i}") for i in range(1, 7)]
        ends.append(np.degrees(np.diff(walk.truth.values_at(np.array([0.0, 9 * DAY_S]))[:, places], axis=0)[0]))
    assert np.std(ends) == pytest.approx(0.3, rel=0.2)
    assert abs(np.corrcoef(np.array(ends).T)[0, 1]) < 0.6


def test_approach_is_the_sign_of_the_last_motion_also_where_a_record_was_lost() -> None:
    whole = mission(days=3)
    angles = np.array([whole.records.column(f"arm.q{i}") for i in range(1, 7)])
    expected = np.hstack([np.zeros((6, 1)), np.sign(np.diff(angles))])
    assert np.array_equal(approach_of(angles), expected)
    made = mission(days=3, **{"losses.fraction": 0.3})
    kept = [whole.records.ids.index(each) for each in made.records.ids]
    assert np.array_equal(made.records.column("arm.approach.q4"), expected[3, kept])


def test_joints_stay_within_their_ranges() -> None:
    made = mission(days=10)
    for joint, most in {"q1": 100, "q2": 50, "q6": 50}.items():
        angles = np.degrees(made.records.column(f"arm.{joint}"))
        assert angles.min() > -most and angles.max() < most and np.ptp(angles) > 1.9 * most


THETA3 = "arm.mdh.theta3"


def moved_by(made: Mission, *days: float) -> dict[str, np.ndarray]:
    """Which entries change between days, by how much on each of them against the mission's beginning (SI)."""
    values = made.truth.values_at(np.array([0.0, *days]) * DAY_S)
    changes = dict(zip(made.truth.parameters.entry_names, (values[1:] - values[0]).T, strict=True))
    return {name: change for name, change in changes.items() if change.any()}


def test_a_creep_begins_on_its_day_adds_to_what_creeps_already_and_ends() -> None:
    event = {"kind": "creep", "day": 1, "joint": "arm.q3", "changes": {THETA3: "2 deg in 1 d"}, "until": 2}
    made = mission(days=3, events=[event], creep={THETA3: "0.3 deg in 1 d"})
    moved = moved_by(made, 0.5, 1, 1.5, 2, 2.9)
    assert set(moved) == {THETA3}
    assert np.allclose(np.degrees(moved[THETA3]), [0.15, 0.3, 1.45, 2.6, 2.87])
    values = made.truth.values_at(made.times)
    for i in (0, len(made.times) // 2, len(made.times) - 1):
        alone = replace(made, records=made.records.subset([i]))
        assert np.abs(tips(made)[i] - tips_at(alone, values[i])[0]).max() < 1e-10
    assert made.settings.events[0].grows and made.settings.events[0].label == "arm.q3 creeps by 2 deg in 1 d"


@pytest.mark.slow
def test_growing_play_moves_tips_apart_by_the_side_they_came_from() -> None:
    event = {"kind": "play", "day": 0, "joint": "arm.q2", "changes": {"arm.lag.lag2": "1 deg in 1 d"}}
    made, still = mission(days=1, events=[event]), mission(days=1)
    # A play is an offset of the joint against the direction of its last motion.
    grown = np.deg2rad(made.times / DAY_S) * made.records.column("arm.approach.q2")
    values = still.truth.values_at(np.zeros(1))[0]
    for i in np.linspace(1, len(made.times) - 1, 5).astype(int):
        offset = values.copy()
        offset[made.truth.parameters.entry_names.index("arm.mdh.theta2")] -= grown[i] * (
            1 + values[made.truth.parameters.entry_names.index("arm.servo.gain2")]
        )
        alone = replace(made, records=made.records.subset([i]))
        assert (
            np.abs(tips(made)[i] - tips_at(alone, offset)[0]).max()
            < 2e-5
            < np.abs(tips(made)[i] - tips(still)[i]).max()
        )


def test_a_bent_link_changes_its_length_and_twist_at_once() -> None:
    event = {
        "kind": "bend",
        "day": 0.5,
        "joint": "arm.q3",
        "changes": {"arm.mdh.a3": "4 mm", "arm.mdh.alpha3": "2 deg"},
    }
    made = mission(days=1, events=[event])
    moved = moved_by(made, 0.49, 0.5)
    assert {name: change[0] for name, change in moved.items()} == {"arm.mdh.a3": 0.0, "arm.mdh.alpha3": 0.0}
    assert moved["arm.mdh.a3"][1] == pytest.approx(0.004)
    assert moved["arm.mdh.alpha3"][1] == pytest.approx(np.deg2rad(2))
    assert made.settings.events[0].label == "link behind arm.q3 bent (4 mm, 2 deg)"


def test_an_unreported_payload_bends_the_arm_and_no_record_shows_it() -> None:
    event = {"kind": "payload", "day": 0.4, "mass_g": 200, "lever_mm": [0, 30, 60], "until": 0.6}
    made, plain = mission(days=1, events=[event]), mission(days=1)
    hung = (made.times >= 0.4 * DAY_S) & (made.times < 0.6 * DAY_S)
    assert hung.any() and np.abs(tips(made) - tips(plain))[~hung].max() < 1e-12
    assert np.all(made.records.column("payload") == 0) and not made.records.has("payload_x")
    told = {"payload": 0.2, "payload_x": 0.0, "payload_y": 0.03, "payload_z": 0.06}
    channels = {name: np.full(len(made.times), value) for name, value in told.items()}
    loaded = replace(made, records=replace(made.records, channels={**made.records.channels, **channels}))
    expected = tips_at(loaded, plain.truth.values_at(np.zeros(1))[0])
    assert np.abs(tips(made) - expected)[hung].max() < 1e-10 < 1e-4 < np.abs(tips(made) - tips(plain))[hung].max()
    assert np.allclose(moved_by(made, 0.3, 0.5, 0.7)["statics.payload"], [0, 0.2, 0])


def test_payloads_at_once_weigh_together_about_their_common_centre() -> None:
    one = {"kind": "payload", "day": 0.1, "mass_g": 100, "lever_mm": [30, 0, 0]}
    other = {"kind": "payload", "day": 0.1, "mass_g": 300, "lever_mm": [0, 0, 40]}
    hung = moved_by(mission(days=1, events=[one, other]), 0.5)
    moments = {"statics.payload_moment_x": 0.003, "statics.payload_moment_z": 0.012}
    assert {name: change[0] for name, change in hung.items()} == pytest.approx({"statics.payload": 0.4, **moments})


def test_a_bias_grows_by_so_much_a_day_whatever_the_pose() -> None:
    event = {"kind": "bias", "day": 1.0, "per_day_mm": [0.5, 0, -0.2], "until": 2.5}
    made, plain = mission(days=3, events=[event]), mission(days=3)
    days = np.clip(made.times / DAY_S, 1.0, 2.5) - 1.0
    assert np.abs(tips(made) - tips(plain) - days[:, None] * [0.0005, 0, -0.0002]).max() < 1e-12
    assert moved_by(made, 2.5) == {}


def test_two_events_of_one_day_come_at_once() -> None:
    pair = [
        {"kind": "slip", "day": 0.5, "joint": f"arm.q{i}", "changes": {f"arm.mdh.theta{i}": "3 deg"}} for i in (2, 4)
    ]
    made = mission(days=1, events=pair)
    assert set(moved_by(made, 0.5)) == {"arm.mdh.theta2", "arm.mdh.theta4"}


@pytest.mark.slow
def test_outliers_are_of_any_size_few_of_them_large() -> None:
    """Log-uniform from 30 to 500 mm: the median is their geometric mean, 122 mm."""
    plain = mission(days=40)
    made = mission(days=40, **{"outliers.fraction": 0.2, "outliers.size_m": 0.03, "outliers.largest_m": 0.5})
    away = np.linalg.norm(tips(made) - tips(plain), axis=1)[made.outliers]
    assert made.outliers.mean() == pytest.approx(0.2, abs=0.02)
    assert away.min() >= 0.0299 and away.max() <= 0.5001
    assert np.median(away) == pytest.approx(np.sqrt(0.03 * 0.5), rel=0.1)


def test_an_unreported_tilt_bends_the_arm_and_no_record_shows_it() -> None:
    tilt = {"kind": "tilt", "day": 0.5, "changes": {"statics.gravity_rx": "10 deg"}}
    made, plain = mission(days=1, events=[tilt]), mission(days=1)
    after = made.times >= 0.5 * DAY_S
    assert np.array_equal(tips(made)[~after], tips(plain)[~after])
    assert np.abs(tips(made) - tips(plain))[after].max() > 1e-4
    assert np.array_equal(made.records.stacked(GRAVITY), plain.records.stacked(GRAVITY))


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"creep": {"arm.mdh.theta9": "1 deg in 3 d"}}, "theta9"),
        ({"creep": {"arm.mdh.theta1": "1 mm in 3 d"}}, "length"),
        ({"events": [{"kind": "slip", "day": 1, "joint": "arm.q9", "changes": {"arm.mdh.theta3": "1 deg"}}]}, "q9"),
        ({"events": [{"kind": "slip", "day": 1, "joint": "arm.q3", "changes": {"arm.mdh.a3": "1 deg"}}]}, "length"),
        ({"events": [{"kind": "bend", "day": 1, "joint": "arm.q9", "changes": {"arm.mdh.a3": "1 mm"}}]}, "q9"),
        ({"events": [{**CREEP, "changes": {"arm.mdh.thetta3": "1 deg in 1 d"}}]}, "thetta3"),
        ({"events": [{**CREEP, "changes": {"arm.mdh.theta3": "3 mm in 1 d"}}]}, "length"),
        ({"records.hours": [18, 8]}, "no record arrives"),
        ({"records.ranges_rad": {"q1": [-1, 1]}}, "q2"),
        ({"records.ranges_rad": {"q7": [-1, 1]}}, "q7"),
    ],
)
def test_what_does_not_fit_the_arm_is_refused(changes: dict[str, object], told: str) -> None:
    with pytest.raises(ConfigError, match=told):
        mission(days=2, **changes)


@pytest.mark.parametrize(
    ("changes", "told"),
    [
        ({"creep": {"arm.mdh.theta1": "1 deg"}}, "amount and a time"),
        ({"start": "2031-03-01"}, "zone"),
        ({"start": "soon"}, "date"),
        ({"events": [{"kind": "slip", "day": 0, "joint": "arm.q3", "parameter": "arm.mdh.theta3"}]}, "changes"),
        ({"events": [{"kind": "quake", "day": 0}]}, "quake"),
        ({"events": [{**CREEP, "day": 1}]}, "before the mission ends"),
        ({"events": [{**CREEP, "day": 0.5, "until": 0.4}]}, "a later day"),
        ({"events": [{"kind": "payload", "day": 0, "mass_g": 0}]}, "greater than 0"),
        ({"events": [{"kind": "bias", "day": 0, "per_day_mm": [0, 0, 0]}]}, "does not grow"),
        ({"outliers": {"size_mm": 50, "largest_mm": 40}}, "larger largest"),
    ],
)
def test_settings_that_make_no_sense_are_refused_in_words(changes: dict[str, object], told: str) -> None:
    with pytest.raises(ValueError, match=told):
        MissionSettings.model_validate({"truth": "truth.yaml", "days": 1, **changes})


def random() -> np.random.Generator:
    return np.random.default_rng(5)
