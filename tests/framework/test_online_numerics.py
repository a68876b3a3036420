"""Whether a recalibration's numbers stay sound: over many updates, odd records, restarts, and against a batch."""

from __future__ import annotations

import json
import math
import tracemalloc
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from armcal.base.parameters import Parameters
from armcal.estimate.online import Gaussian
from armcal_kalman.filters import ExtendedFilter, ExtendedSettings
from armcal_online.belief import Belief, Observer, StateSpace
from armcal_online.recalibrator import Recalibrator
from armcal_online.settings import DAY
from armcal_online.sources import Incoming
from armcal_online.state import REMEMBERED, FilterSetup
from online_arm import (
    AXES,
    JOINTS,
    STATES,
    Filtered,
    World,
    begun,
    begun_setup,
    random_poses,
    settings,
    told,
)
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from tests.soak import TIMES

POSE = np.array([0.4, 0.3, -0.5, 0.7, -0.6, 0.4])


def extended(setup: FilterSetup) -> Filtered:
    return Filtered.fresh(ExtendedFilter(ExtendedSettings()), setup)


def still(seed: int, count: int, **given) -> tuple[World, list[dict[str, float]]]:
    """Records of an arm that does not change."""
    arm = World.drawn(seed, wanders=False, **given)
    records = []
    for _ in range(count):
        arm.step()
        records.append(arm.measured())
    return arm, records


@pytest.mark.slow
@pytest.mark.parametrize(
    ("updates", "walk"),
    [
        (2_000, 1.0),
        pytest.param(1_000_000, 1.0, marks=pytest.mark.slow),
        pytest.param(1_000_000, 0.0, marks=pytest.mark.slow),
    ],
)
def test_the_covariance_stays_sound_over_many_updates(updates: int, walk: float) -> None:
    _, records = still(3, 400)
    one, lowest = extended(begun_setup(walk=walk)), math.inf
    for k in range(updates):
        one.take(records[k % len(records)])
        covariance = one.belief.gaussian.covariance
        assert (covariance == covariance.T).all()
        if k % max(1, updates // 200) == 0:
            lowest = min(lowest, float(np.linalg.eigvalsh(covariance)[0]))
    lowest = min(lowest, float(np.linalg.eigvalsh(one.belief.gaussian.covariance)[0]))
    print(f"\n{updates} updates, walk {walk:g}: smallest eigenvalue {lowest:.2e}")
    assert lowest > 1e-12


def test_a_repeated_pose_tells_nothing_of_what_it_does_not_determine() -> None:
    arm = World.drawn(5, wanders=False)
    one = extended(begun_setup(walk=0.0))
    root = np.linalg.cholesky(one.belief.gaussian.covariance)
    for _ in range(100):
        arm.step()
        one.take(arm.measured(POSE))
    inverse = np.linalg.inv(root)
    left = np.linalg.eigvalsh(inverse @ one.belief.gaussian.covariance @ inverse.T)
    print(
        f"\n100 times one pose: variance left of its three directions {left[:3]}, of the others at least {left[3]:.5f}"
    )
    assert (left[:3] < 0.2).all()
    assert left[3] > 0.99
    assert left[-1] <= 1 + 1e-9


def belief_of(recalibrator: Recalibrator) -> bytes:
    belief = recalibrator.state.belief
    return b"".join(a.tobytes() for a in (belief.origin, belief.gaussian.mean, belief.gaussian.covariance))


def record(arm: World, sequence: int, **changed: float) -> Incoming:
    channels = {**arm.measured(POSE), **{name.replace("_", "."): value for name, value in changed.items()}}
    return Incoming(f"odd{sequence}", channels, {}, arm.now, "list", sequence)


@pytest.fixture(scope="module")
def warm() -> tuple[Recalibrator, dict, World]:
    recalibrator, arm = begun(settings(clock={"longest_age": "2 h"})), World.drawn(11)
    for sequence in range(1, 31):
        recalibrator.take(arm.record(), sequence)
    return recalibrator, recalibrator.snapshot(), arm


ODD = {
    "an hour back": lambda arm: {"time": arm.now - 3600},
    "a second back": lambda arm: {"time": arm.now - 1},
    "a joint not a number": lambda arm: {"arm_q3": math.nan},
    "a joint infinite": lambda arm: {"arm_q3": math.inf},
    "a joint where none stands": lambda arm: {"arm_q3": 1e4},
    "a position not a number": lambda arm: {"tracker_y": math.nan},
    "a position infinite": lambda arm: {"tracker_y": -math.inf},
}


@pytest.mark.parametrize("what", ODD)
def test_an_odd_record_leaves_the_belief_as_it_was(what: str, warm) -> None:
    recalibrator, snapshot, arm = warm
    recalibrator.restore(snapshot)
    before = belief_of(recalibrator)
    (event,) = recalibrator.take(record(arm, 31, **ODD[what](arm)), 31)
    assert event["verdict"] == "ignored" and event["why"]
    assert belief_of(recalibrator) == before
    assert recalibrator.state.counts["ignored"] == 1


def test_a_stale_record_leaves_the_belief_as_it_was(warm) -> None:
    recalibrator, snapshot, arm = warm
    recalibrator.restore(snapshot)
    before = belief_of(recalibrator)
    late = replace(record(arm, 31, time=arm.now + 60), arrived=arm.now + 60 + 3 * 3600)
    (event,) = recalibrator.take(late, 31)
    assert event["verdict"] == "ignored" and belief_of(recalibrator) == before


def test_a_position_far_beyond_any_reach_is_rejected_without_a_trace(warm) -> None:
    recalibrator, snapshot, arm = warm
    recalibrator.restore(snapshot)
    before = recalibrator.state.belief
    first = recalibrator.take(record(arm, 31, tracker_y=1e9, time=arm.now), 31)[0]
    assert first["verdict"] == "rejected"
    after = recalibrator.state.belief
    assert (after.gaussian.mean == before.gaussian.mean).all() and (after.origin == before.origin).all()


@pytest.mark.parametrize("ahead", [365.25 * DAY, 50 * 365.25 * DAY])
def test_a_clock_that_jumps_ahead_counts_as_its_longest_step(ahead: float, warm) -> None:
    recalibrator, snapshot, arm = warm
    read, beliefs = record(arm, 31), []
    for step in (DAY, ahead):
        recalibrator.restore(snapshot)
        jumped = replace(read, channels={**read.channels, "time": arm.now + step}, arrived=arm.now + step)
        events = recalibrator.take(jumped, 31)
        assert told(events, "record")[0]["verdict"] == "accepted"
        beliefs.append(belief_of(recalibrator))
    assert beliefs[0] == beliefs[1]


@pytest.mark.slow
def test_a_time_that_is_no_number_counts_as_none(warm) -> None:
    recalibrator, snapshot, arm = warm
    recalibrator.restore(snapshot)
    (event, *_) = recalibrator.take(record(arm, 31, time=math.nan), 31)
    assert event["verdict"] == "accepted"
    assert recalibrator.state.clock.now == arm.now
    assert np.isfinite(recalibrator.state.belief.gaussian.covariance).all()


def _steadily(recalibrator: Recalibrator, fresh: dict, count: int) -> tuple[dict, list[int]]:
    """The state after so many records with outliers, 15 s apart, and memory in use at tenths of them."""
    recalibrator.restore(fresh)
    arm, used = World.drawn(21, outliers=0.02), []
    for sequence in range(1, count + 1):
        recalibrator.take(arm.record(seconds=15.0), sequence)
        if sequence % (count // 10) == 0 and tracemalloc.is_tracing():
            used.append(tracemalloc.get_traced_memory()[0])
    return recalibrator.snapshot(), used


@pytest.mark.slow
@pytest.mark.parametrize("count", [200, 24 * 240 * TIMES])
def test_days_need_no_more_memory_and_come_out_the_same_twice(count: int) -> None:
    """A day; seven with ``ARMCAL_SOAK=7``, of which tracing memory makes a quarter of an hour."""
    recalibrator = begun()
    fresh = recalibrator.snapshot()
    tracemalloc.start()
    try:
        state, used = _steadily(recalibrator, fresh, count)
    finally:
        tracemalloc.stop()
    print(f"\n{count} records: memory {[round(u / 1024) for u in used]} KiB at tenths of them")
    full = max(1, math.ceil(10 * REMEMBERED / count) - 1)  # from then on the oldest is forgotten
    assert used[-1] <= 1.05 * used[full]
    assert _steadily(recalibrator, fresh, count)[0] == state


@pytest.mark.slow
@pytest.mark.parametrize("every", [1, 3])
def test_a_restored_state_goes_on_as_if_nothing_had_been(every: int) -> None:
    """At such records of a run in which a joint slips: a snapshot as a journal keeps it, taken up by another."""
    one, other, arm = begun(), begun(), World.drawn(31, outliers=0.05)
    records, snapshots, states, decided = [], [], [], 0
    for sequence in range(1, 41):
        if sequence == 22:
            arm.moved("arm.mdh.theta2", math.radians(8))
        snapshots.append(json.dumps(one.snapshot()))
        records.append(arm.record())
        decided += len(told(one.take(records[-1], sequence), "decision"))
        states.append(json.dumps(one.snapshot()))
    assert decided
    for k, kept in list(enumerate(snapshots))[::every]:
        other.restore(json.loads(kept))
        far = len(records) if k in (21, 22, 24) else min(k + 3, len(records))
        for i in range(k, far):
            other.take(Incoming.from_dict(json.loads(json.dumps(records[i].as_dict()))), i + 1)
            assert json.dumps(other.snapshot()) == states[i], (k, i)


@pytest.mark.slow
def test_both_evaluators_agree() -> None:
    one, other = begun_setup(), begun_setup(evaluator="interpreted")
    if one.problem.backend != "compiled":
        pytest.skip("no compiler here: there is one evaluator")
    random, worst = np.random.default_rng(1), 0.0
    for _ in range(60):
        spread = np.sqrt(np.diag(one.belief.gaussian.covariance)) * random.normal(size=STATES)
        values = one.space.inside(one.space.moved(one.belief.origin, 3 * spread))
        angles = dict(zip(JOINTS, random_poses(random, 1)[0].tolist(), strict=True))
        (reading,) = one.observer.readings(angles | dict.fromkeys(AXES, 0.0), {})
        for a, b in zip(
            one.observer.linearise(values, reading), other.observer.linearise(values, reading), strict=True
        ):
            worst = max(worst, float(np.abs(a - b).max() / np.abs(a).max()))
    filters = extended(one), extended(other)
    arm = World.drawn(2)
    for _ in range(300):
        arm.step()
        channels = arm.measured()
        for each in filters:
            each.take(channels)
    sd = np.sqrt(np.diag(filters[0].belief.gaussian.covariance))
    off = one.space.between(filters[0].belief.values(one.space), filters[1].belief.values(one.space))
    apart = float(np.abs(off / sd).max())
    print(f"\ncompiled against interpreted: {worst:.1e} relative; after 300 updates {apart:.1e} standard deviations")
    assert worst < 1e-12
    assert apart < 1e-8


def ended(setup: FilterSetup, records: Sequence[dict[str, float]]) -> tuple[np.ndarray, np.ndarray]:
    """Mean (about the calibration) and covariance after records, with no process noise."""
    one = extended(setup)
    for channels in records:
        one.take(channels)
    return setup.space.between(setup.belief.origin, one.belief.values(setup.space)), one.belief.gaussian.covariance


def test_the_order_of_records_does_not_matter_where_nothing_wanders() -> None:
    _, records = still(8, 80)
    mean, covariance = ended(begun_setup(walk=0.0), records)
    for order in (records[::-1], [records[i] for i in np.random.default_rng(0).permutation(len(records))]):
        other, others = ended(begun_setup(walk=0.0), order)
        off = np.abs(other - mean) / np.sqrt(np.diag(covariance))
        print(f"\nanother order: {off.max():.3f} standard deviations")
        assert off.max() < 0.1
        assert np.sqrt(np.diag(others)) == pytest.approx(np.sqrt(np.diag(covariance)), rel=0.05)


def test_the_unit_of_length_does_not_matter() -> None:
    """Lengths counted in another unit are coordinates scaled otherwise."""
    setup = begun_setup()
    blocks = [replace(b, scale=b.scale * (1000.0 if b.unit == "m" else 0.1)) for b in setup.space.parameters.blocks]
    space = StateSpace(Parameters(tuple(blocks)).with_free([b.name for b in setup.space.parameters.free]))
    ratio = setup.space.scales / space.scales
    old = setup.observer
    scaled = replace(
        setup,
        space=space,
        observer=Observer(
            setup.problem,
            space,
            old.gauss_markov,
            type(old.gauss_markov)(),
            old._noise,
            {"tracker": 1000.0},
            {**old._defaults},
        ),
        belief=Belief(
            setup.belief.origin,
            Gaussian(setup.belief.gaussian.mean * ratio, setup.belief.gaussian.covariance * np.outer(ratio, ratio)),
        ),
        process_noise=replace(setup.process_noise, rates=setup.process_noise.rates * ratio**2),
    )
    one, other, arm = extended(setup), extended(scaled), World.drawn(4)
    for _ in range(100):
        arm.step()
        channels = arm.measured()
        one.take(channels), other.take(channels)
    sd = np.sqrt(np.diag(one.belief.gaussian.covariance))
    off = setup.space.between(one.belief.values(setup.space), other.belief.values(space)) / sd
    assert np.abs(off).max() < 1e-6
    assert np.sqrt(np.diag(other.belief.gaussian.covariance)) / ratio == pytest.approx(sd, rel=1e-6)


@pytest.mark.slow
def test_where_the_instrument_stands_does_not_matter() -> None:
    """The same arm measured in a frame that is shifted and turned about the upright."""
    moved = begun(settings(), placement=("position_mm=[700, -250, 120]", "rpy_deg=[0, 0, 130]"))
    plain, arm = begun(), World.drawn(6)
    turn = Rotation.from_euler("z", 130, degrees=True).as_matrix()
    for sequence in range(1, 81):
        taken = arm.record()
        plain.take(taken, sequence)
        read = turn @ [taken.channels[a] for a in AXES] + [0.7, -0.25, 0.12]
        channels = {**taken.channels, **dict(zip(AXES, read.tolist(), strict=True))}
        moved.take(replace(taken, channels=channels), sequence)
    sd = np.sqrt(np.diag(plain.state.belief.gaussian.covariance))
    space = plain.setup.space
    one, other = (r.state.belief.values(r.setup.space)[r.setup.space.entries] for r in (plain, moved))
    assert plain.state.counts == moved.state.counts
    assert (np.abs(one - other) <= 1e-6 * space.scales * sd).all()


SMALL = 0.004
"""rad/Nm; half a standard deviation of what is known of a compliance."""


def batch(setup: FilterSetup, records: Sequence[dict[str, float]]) -> np.ndarray:
    """The values that all records and the prior make likeliest within the bounds, by scipy."""
    prior = np.linalg.cholesky(np.linalg.inv(setup.belief.gaussian.covariance)).T
    space, origin, mean = setup.space, setup.belief.origin, setup.belief.gaussian.mean
    readings = [setup.observer.readings(each, {})[0] for each in records]
    weight = np.linalg.inv(np.linalg.cholesky(readings[0].noise))

    def residual(place: np.ndarray) -> np.ndarray:
        values = space.moved(origin, place)
        return np.concatenate(
            [prior @ (place - mean), *(weight @ setup.observer.linearise(values, r)[0] for r in readings)]
        )

    def jacobian(place: np.ndarray) -> np.ndarray:
        values = space.moved(origin, place)
        return np.vstack([prior, *(-weight @ setup.observer.linearise(values, r)[1] for r in readings)])

    lower, upper = np.full(STATES, -np.inf), np.full(STATES, np.inf)
    at, coordinates, low, high = space.bounds
    lower[coordinates] = (low - origin[at]) / space.scales[coordinates]
    upper[coordinates] = (high - origin[at]) / space.scales[coordinates]
    start = np.clip(np.zeros(STATES), lower + 1e-6, upper - 1e-6)
    found = least_squares(residual, start, jacobian, bounds=(lower, upper), xtol=1e-14, ftol=1e-14, gtol=1e-10)
    return space.moved(origin, found.x)


def stiff(setup: FilterSetup, seed: int) -> World:
    """An arm that does not bend, whose other parameters are as likely as that leaves them."""
    arm, space, belief = World.drawn(seed, setup, wanders=False), setup.space, setup.belief
    springs = [space.names.index(f"arm.spring.k{i}") for i in range(7)]
    place = np.linalg.cholesky(belief.gaussian.covariance) @ np.random.default_rng(seed).normal(size=STATES)
    wanted = -SMALL / space.scales[springs]
    own = belief.gaussian.covariance[np.ix_(springs, springs)]
    place += belief.gaussian.covariance[:, springs] @ np.linalg.solve(own, wanted - place[springs])
    arm.values = space.inside(space.moved(belief.origin, place))
    return arm


@pytest.mark.slow
@pytest.mark.parametrize("bounded", [False, True])
def test_the_filter_ends_where_a_batch_of_all_records_does(bounded: bool) -> None:
    compliance = {"compliance": SMALL} if bounded else {}
    one = begun(settings(process_noise={}, gating=False), **compliance)
    arm = stiff(one.setup, 11) if bounded else World.drawn(9, one.setup, wanders=False)
    springs, records = [one.setup.space.parameters.entries_of(f"arm.spring.k{i}").start for i in range(7)], []
    for sequence in range(1, 121):
        taken = arm.record()
        records.append(taken.channels)
        one.take(taken, sequence)
        assert (one.values[springs] >= 0).all()
    space, covariance = one.setup.space, one.state.belief.gaussian.covariance
    off = space.between(batch(one.setup, records), one.values) / np.sqrt(np.diag(covariance))
    held = int(np.sum(space.inside(one.state.belief.values(space)) != one.state.belief.values(space)))
    print(f"\n120 records, {held} compliances beyond their bounds: {np.abs(off).max():.3f} sd from the batch at most")
    assert bool(held) == bounded
    assert np.abs(off).max() < 0.1
    # The covariance is that of the belief without bounds: the information of prior and records.
    slopes = [one.setup.observer.linearise(one.values, one.setup.observer.readings(each, {})[0])[1] for each in records]
    whole = np.linalg.inv(one.setup.belief.gaussian.covariance) + sum(s.T @ s for s in slopes) / 0.0003**2
    expected = np.sqrt(np.diag(np.linalg.inv(whole)))
    assert np.sqrt(np.diag(covariance)) == pytest.approx(expected, rel=0.05)
