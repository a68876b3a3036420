"""Bends and loads are named, and not blamed on a healthy joint; what is named reaches the published calibration."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Mapping
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal_online.mission import MissionPlan, before_launch
from armcal_online.recalibrator import Recalibrator
from armcal_online.sources import Incoming
from armcal_online.state import Health
from online_arm import AXES, JOINTS, World, begun, calibration, told

CONFIG = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "mission.yaml"
DAYS = 6
NAMING = ("joint_slipped", "joint_replaced", "joint_stepped", "joint_named", "sensor_moved")


def test_a_level_gets_no_better_than_its_best() -> None:
    health = Health("suspect", 0, "Something changed.", "watch")
    for _ in range(10):
        health = health.calmed(2)
    assert health.level == "watch" and "not known" in health.sentence
    assert health.troubled("lost", "It is lost.").best == "watch"


class Loaded(World):
    """An arm whose load no record states: a payload (kg) and where gravity pulls (m/s^2)."""

    load: Mapping[str, float] = {}

    def tip(self, q: np.ndarray) -> np.ndarray:
        channels = dict(zip(JOINTS, q.tolist(), strict=True)) | dict.fromkeys(AXES, 0.0) | dict(self.load)
        (reading,) = self.setup.observer.readings(channels, {})
        return -self.setup.observer.linearise(self.values, reading)[0]


def bent(arm: Loaded) -> None:
    arm.moved("arm.mdh.alpha3", math.radians(3))
    arm.moved("arm.mdh.a3", 0.004)


def loaded(arm: Loaded) -> None:
    arm.load = {"payload": 0.2, "payload_y": 0.03}


def tilted(arm: Loaded) -> None:
    arm.load = {"gravity_x": 9.81 * math.sin(0.2), "gravity_z": -9.81 * math.cos(0.2)}


CAUSES = {"link_bent": bent, "payload_changed": loaded, "gravity_tilted": tilted}


@pytest.mark.slow
@pytest.mark.parametrize("kind", CAUSES)
def test_a_cause_is_named_with_its_size_and_no_joint_is(kind: str) -> None:
    arm, session = Loaded.drawn(2), begun()
    decisions = []
    for k in range(1, 81):
        if k == 41:
            CAUSES[kind](arm)
        decisions += told(session.take(arm.record(), k), "decision")
    assert [event["kind"] for event in decisions] == [kind]
    (event,) = decisions
    assert event["sequence"] - 40 <= 10
    published = calibration_of(session.calibration_text())
    probe = {name: np.zeros(1) for name in JOINTS}
    predicted_m = published.predict(Dataset(("",), probe))[0]
    seen = np.array([predicted_m[axis][0] for axis in AXES])
    assert np.linalg.norm(seen - arm.tip(np.zeros(6))) < 0.001
    if kind == "payload_changed":
        assert event["size_g"] == pytest.approx(200, abs=60)
        assert published.system.statics.payload == pytest.approx(0.2, abs=0.06)
    elif kind == "gravity_tilted":
        assert event["size_deg"] == pytest.approx(math.degrees(0.2), abs=2)
    else:
        assert event["link"] == "arm.q3" and "arm.mdh.alpha3 by +" in event["what"]


def calibration_of(text: str) -> Calibration:
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "calibration.yaml"
        path.write_text(text)
        return Calibration.load(path)


@pytest.mark.slow
def test_what_no_decision_has_opened_is_not_published() -> None:
    session = begun()
    session.take(World.drawn(1).record(), 1)
    assert not [name for name in session.estimate if name.startswith("statics.")]
    published = calibration_of(session.calibration_text())
    assert not [e.name for e in published.record.parameters if e.free and e.name.startswith("statics.")]
    assert published.record.statics == calibration().record.statics


EVENTS = {
    "nothing": ("[]", ()),
    "payload": ("[{kind: payload, day: 3.4, mass_g: 300}]", ("payload_changed",)),
    "bent upper link": ("[{kind: bend, day: 3.4, joint: arm.q3, changes: {arm.mdh.alpha3: 2 deg}}]", ("link_bent",)),
    "bent forearm": (
        "[{kind: bend, day: 3.4, joint: arm.q4, changes: {arm.mdh.alpha4: 3 deg, arm.mdh.a4: -2 mm}}]",
        ("link_bent",),
    ),
}
SIZES = (30, 100, 300, 500)


@cache
def launched(folder: Path) -> Calibration:
    return Calibration.load(before_launch(MissionPlan.load(CONFIG, ("evaluator=interpreted",)), folder))


def decided(folder: Path, *overrides: str) -> list[Mapping[str, Any]]:
    """The decisions of a mission."""
    plan = MissionPlan.load(CONFIG, (f"simulation.days={DAYS}", "evaluator=interpreted", *overrides))
    mission, session = plan.simulated(), Recalibrator(launched(folder), plan.recalibrate)
    decisions = []
    for k, name in enumerate(mission.records.ids, 1):
        channels = {channel: float(column[k - 1]) for channel, column in mission.records.channels.items()}
        decisions += told(session.take(Incoming(name, channels, {}, channels["time"], "mission", k), k), "decision")
    return decisions


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("bench")


CASES = [(name, seed) for name in EVENTS for seed in (20310301, 1, 2)]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "seed"), CASES)
def test_a_cause_that_is_no_joints_is_not_blamed_on_one(name: str, seed: int, bench: Path) -> None:
    events, allowed = EVENTS[name]
    found = decided(bench, f"simulation.events={events}", f"simulation.seed={seed}")
    print(f"{name}: {[(event['kind'], event['sentence'][:60]) for event in found]}")
    assert {event["kind"] for event in found} <= set(allowed)
    assert bool(found) == bool(allowed)


@pytest.mark.slow
@pytest.mark.parametrize("size_mm", SIZES)
def test_outliers_of_a_mission_change_nothing_whatever_their_size(size_mm: int, bench: Path) -> None:
    found = decided(bench, "simulation.events=[]", f"simulation.outliers.size_mm={size_mm}")
    assert [event["kind"] for event in found] == []


@pytest.mark.slow
@pytest.mark.parametrize(("one", "other"), [(1, 4), (2, 3), (2, 6), (3, 5)])
def test_two_slips_of_a_mission_are_both_named(one: int, other: int, bench: Path) -> None:
    slips = [
        f"{{kind: slip, day: 3.4, joint: arm.q{joint}, changes: {{arm.mdh.theta{joint}: {size} deg}}}}"
        for joint, size in ((one, 6), (other, -10))
    ]
    found = decided(bench, f"simulation.events=[{', '.join(slips)}]")
    assert {event["joint"] for event in found if event["kind"] in NAMING} == {f"arm.q{one}", f"arm.q{other}"}
    assert {event["kind"] for event in found} <= set(NAMING)
