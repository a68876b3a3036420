"""What a recalibration makes of outliers, of steps of joints, and of an instrument that was bumped."""

from __future__ import annotations

import copy
import itertools
import math
from dataclasses import dataclass
from functools import cache

import numpy as np
import pytest
from armcal_online.recalibrator import Recalibrator
from online_arm import PROBES, World, begun, predicted, settings, tip_error_mm, told
from scipy.spatial.transform import Rotation

from tests.soak import TIMES

NAMING = ("joint_slipped", "joint_replaced", "joint_named")
RESETS = (*NAMING, "joint_stepped", "sensor_moved", "general_change", "drift", "model_no_longer_fits")
SETTLED = 150
"""Records before something happens."""


@cache
def _shared() -> tuple[Recalibrator, dict]:
    """One recalibrator for all; it is restored to its calibration before each run."""
    recalibrator = begun()
    return recalibrator, recalibrator.snapshot()


@dataclass(frozen=True)
class Ran:
    """A run: error of predictions after each record (mm), decisions by number of records, and what was rejected."""

    errors: np.ndarray
    decisions: tuple[tuple[int, str, str], ...]
    good_rejected: int
    good: int
    caught: int
    outliers: int


def run(recalibrator: Recalibrator, arm: World, count: int, every: int = 1) -> Ran:
    errors, decisions, rejected = [], [], []
    first = recalibrator.state.sequence
    for k in range(1, count + 1):
        events = recalibrator.take(arm.record(), first + k)
        judged = told(events, "record")[0]["verdict"]
        rejected.append((judged == "rejected", arm.was_outlier))
        decisions += [(k, d["kind"], d.get("joint") or "") for d in told(events, "decision")]
        if k % every == 0:
            errors.append(tip_error_mm(arm.setup, recalibrator.values, arm.values))
    table = np.array(rejected)
    return Ran(
        np.array(errors),
        tuple(decisions),
        int(np.sum(table[:, 0] & ~table[:, 1])),
        int(np.sum(~table[:, 1])),
        int(np.sum(table[:, 0] & table[:, 1])),
        int(np.sum(table[:, 1])),
    )


class _Fair(World):
    """Whose poses, noise and walk are the same with outliers as without."""

    def measured(self, q=None):
        state = self.random.bit_generator.state
        one = copy.deepcopy(self.random)
        self.random = one
        channels = super().measured(q)
        self.random = np.random.default_rng()
        self.random.bit_generator.state = state
        self.random.normal(size=20)
        return channels


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [30])
def test_outliers_hardly_matter(seeds: int) -> None:
    recalibrator, fresh = _shared()
    runs: dict[float, list[Ran]] = {0.0: [], 0.05: []}
    for seed in range(seeds):
        for share, done in runs.items():
            recalibrator.restore(fresh)
            done.append(run(recalibrator, _Fair.drawn(seed, outliers=share), 300, 10))
    mean = {share: np.mean([r.errors.mean() for r in done]) for share, done in runs.items()}
    final = {share: np.mean([r.errors[-1] for r in done]) for share, done in runs.items()}
    dirty = runs[0.05]
    wrong = sum(r.good_rejected for r in dirty) / sum(r.good for r in dirty)
    caught = sum(r.caught for r in dirty) / sum(r.outliers for r in dirty)
    print(
        f"\n5 % outliers of 30 mm, {seeds} runs: error {final[0.05]:.3f} mm at the end ({mean[0.05]:.3f} on average), "
        f"clean {final[0.0]:.3f} ({mean[0.0]:.3f}); {100 * wrong:.2f} % of good records rejected, {100 * caught:.1f} % "
        f"of the others"
    )
    assert final[0.05] <= 1.2 * final[0.0]
    assert mean[0.05] <= 1.2 * mean[0.0]
    assert wrong <= 0.003
    assert caught > 0.95


@pytest.mark.slow
def test_without_a_gate_outliers_matter() -> None:
    """The figures above would mean little if they did not."""
    ungated = begun(settings(gating=False))
    found = run(ungated, _Fair.drawn(0, outliers=0.05), 120, 10)
    print(f"\nungated: {found.errors[-1]:.2f} mm at the end, {found.errors.mean():.2f} on average")
    assert found.errors.mean() > 0.8


class Bench:
    """A settled recalibration, and what becomes of it after something has happened; the same records each time."""

    def __init__(self, seed: int, outliers: float = 0.0, count: int = SETTLED) -> None:
        self._recalibrator, fresh = _shared()
        self._recalibrator.restore(fresh)
        self._arm = World.drawn(1000 + seed, outliers=outliers)
        run(self._recalibrator, self._arm, count, count)
        self._snapshot = self._recalibrator.snapshot()

    def after(self, change=lambda arm: None, count: int = 20) -> Ran:
        self._recalibrator.restore(self._snapshot)
        arm = copy.copy(self._arm)
        arm.random = copy.deepcopy(self._arm.random)
        change(arm)
        return run(self._recalibrator, arm, count)

    def gap(self, change) -> float:
        """Mean distance of what is predicted now from what a moved instrument reads (mm)."""
        arm = copy.copy(self._arm)
        change(arm)
        values = arm.setup.space.inside(self._recalibrator.values)
        read = [arm.turn @ arm.tip(q) + arm.bias for q in PROBES]
        far = [np.linalg.norm(predicted(arm.setup, values, q) - r) for q, r in zip(PROBES, read, strict=True)]
        return float(1000 * np.mean(far))


def _step(joint: int, degrees: float):
    return lambda arm: arm.moved(f"arm.mdh.theta{joint}", math.radians(degrees))


missed = pytest.mark.xfail(
    reason="measured over 25 runs: 0.5 deg of joints 1 to 4 is decided within 5 records in 93 %; joint 3 is late "
    "(76 %), whose step moves the tip least"
)
missed_wrist = pytest.mark.xfail(
    reason="measured over 25 runs: 2 deg of joint 5 is decided within 5 records in 68 %; it moves the tip by 1 mm, "
    "hardly three standard deviations, and by nothing in some poses"
)
LONG = pytest.mark.slow


@pytest.mark.slow
@pytest.mark.parametrize(
    ("degrees", "joints", "seeds"),
    [
        (0.5, (1, 2, 3, 4), 1),
        (2.0, (1, 2, 3, 4, 5, 6), 1),
        pytest.param(0.5, (1, 2, 3, 4), 25, marks=[LONG, missed]),
        pytest.param(2.0, (1, 2, 3, 4, 6), 25, marks=LONG),
        pytest.param(2.0, (5,), 25, marks=[LONG, missed_wrist]),
    ],
)
def test_a_small_step_is_decided_soon(degrees: float, joints: tuple[int, ...], seeds: int) -> None:
    """Half a degree of the wrist moves the tip by hardly more than the noise: see the test after this one."""
    soon = {joint: [] for joint in joints}
    for seed in range(seeds):
        bench = Bench(seed)
        for joint in joints:
            found = bench.after(_step(joint, degrees if seed % 2 else -degrees), 8)
            soon[joint].append(next((k for k, kind, _ in found.decisions if kind in RESETS), 99))
    every = np.concatenate(list(soon.values()))
    share = float(np.mean(every <= 5))
    told_by = ", ".join(f"q{j} {np.median(v):.0f} ({100 * np.mean(np.array(v) <= 5):.0f} %)" for j, v in soon.items())
    print(f"\n{degrees:g} deg: decided within 5 records in {100 * share:.0f} %; median by joint (share): {told_by}")
    assert share >= (0.75 if seeds == 1 else 0.95)


@pytest.mark.slow
@pytest.mark.xfail(reason="measured: 1 of 20 is decided within 60 records, after 51; the filter absorbs the others")
def test_half_a_degree_of_the_wrist_is_decided_in_time() -> None:
    soon = {5: [], 6: []}
    for seed in range(10):
        bench = Bench(seed)
        for joint, found in soon.items():
            ran = bench.after(_step(joint, 0.5), 60)
            found.append(next((k for k, kind, _ in ran.decisions if kind in RESETS), 99))
    print(f"\n0.5 deg of the wrist: decided after {soon} records (99: not within 60)")
    assert all(np.mean(np.array(found) <= 5) >= 0.95 for found in soon.values())


@dataclass(frozen=True)
class Recovery:
    named: bool
    first: int
    ratio: float


def _recoveries(seeds: range, outliers: float, joints: tuple[int, ...] = (1, 2, 3, 4, 5, 6)) -> list[Recovery]:
    found = []
    for seed in seeds:
        bench, random = Bench(seed, outliers), np.random.default_rng(seed)
        undisturbed = bench.after()
        for joint in joints:
            size = 14.4 if random.uniform() < 0.3 else random.uniform(2, 15) * random.choice([-1, 1])
            ran = bench.after(_step(joint, size))
            within = np.flatnonzero(ran.errors <= 1.2 * undisturbed.errors)
            named = [who for _, kind, who in ran.decisions if kind in NAMING][:1] == [f"arm.q{joint}"]
            ratio = float(ran.errors[9:].mean() / undisturbed.errors[9:].mean())
            found.append(Recovery(named, int(within[0]) + 1 if len(within) else 99, ratio))
    return found


@pytest.mark.parametrize("seeds", [1, pytest.param(25, marks=pytest.mark.slow)])
@pytest.mark.parametrize("outliers", [0.0, 0.05])
@pytest.mark.slow
def test_a_slipped_joint_is_named_and_recovered(seeds: int, outliers: float) -> None:
    found = _recoveries(range(seeds), outliers)
    named, soon = np.mean([r.named for r in found]), np.mean([r.first <= 10 for r in found])
    ratios = [r.ratio for r in found]
    print(
        f"\nsteps of 2 to 15 deg, {100 * outliers:g} % outliers, {len(found)} cases: the right joint named in "
        f"{100 * named:.1f} %, within 1.2 times the undisturbed error in 10 records in {100 * soon:.1f} % (median "
        f"{np.median([r.first for r in found]):.0f}); records 10 to 20 together: {np.median(ratios):.2f} times it "
        f"(median), at most 1.2 times in {100 * np.mean(np.array(ratios) <= 1.2):.1f} %"
    )
    assert named >= 0.95 if seeds > 1 else named == 1
    assert soon >= (0.95 if seeds > 1 else 0.8)


@pytest.mark.slow
@pytest.mark.parametrize("seeds", [1, 6])
def test_two_joints_that_slip_at_once_are_both_named(seeds: int) -> None:
    """Within five records; a refit of the last 40 records would need 39 to 42."""
    found = []
    for seed in range(seeds):
        bench, random = Bench(seed, outliers=0.05), np.random.default_rng(seed)
        undisturbed = bench.after()
        every = list(itertools.combinations(range(1, 7), 2))
        for one, other in every if seeds > 1 else every[3:4]:
            sizes = random.uniform(4, 15, 2) * random.choice([-1, 1], 2)

            def change(arm: World, both=((one, sizes[0]), (other, sizes[1]))) -> None:
                for joint, size in both:
                    _step(joint, size)(arm)

            ran = bench.after(change)
            named = {(kind, who) for k, kind, who in ran.decisions if kind in NAMING}
            right = {who for _, who in named} == {f"arm.q{one}", f"arm.q{other}"}
            last = max((k for k, kind, _ in ran.decisions if kind in NAMING), default=99)
            found.append((right, last, ran.errors[-1] / undisturbed.errors[-1]))
    right, last, ratio = np.array(found).T
    print(
        f"\ntwo slips at once, {len(found)} cases: both named and no other in {100 * right.mean():.0f} %, after "
        f"{np.median(last):.0f} records ({last.max():.0f} at most); error after 20 records {np.median(ratio):.2f} "
        f"times that without (median)"
    )
    assert right.mean() >= 0.9 and np.median(last) <= 5
    assert np.median(ratio) < 1.3


def _bump(shift_mm: tuple[float, float, float], turn_deg: tuple[float, float, float]):
    def change(arm: World) -> None:
        arm.bias = np.array(shift_mm) / 1000
        arm.turn = Rotation.from_rotvec(np.radians(turn_deg)).as_matrix()

    return change


BUMPS = {
    "20 mm": ((20, 10, -15), (0, 0, 0)),
    "3 mm and half a degree": ((3, -2, 1), (0.2, 0.4, -0.3)),
    "3 mm": ((3, -2, 1), (0, 0, 0)),
}


late = pytest.mark.xfail(reason="measured over 15 runs: decided within 5 records in 93 %, within 7 in all")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("bump", "seeds"),
    [
        *(pytest.param(bump, 1, marks=[pytest.mark.slow] if bump == "20 mm" else []) for bump in BUMPS),
        *(pytest.param(b, 15, marks=[pytest.mark.slow, *([late] if b == "3 mm" else [])]) for b in BUMPS),
    ],
)
def test_an_instrument_that_was_bumped_is_found_anew(bump: str, seeds: int) -> None:
    first, kinds, left = [], [], []
    for seed in range(seeds):
        bench = Bench(3 + seed)
        ran = bench.after(_bump(*BUMPS[bump]), 20)
        decided = [(k, kind) for k, kind, _ in ran.decisions if kind in RESETS] or [(99, "nothing")]
        first.append(decided[0][0])
        kinds.append(decided[0][1])
        left.append(bench.gap(_bump(*BUMPS[bump])))
    counted = ", ".join(f"{kind} {kinds.count(kind)}" for kind in sorted(set(kinds)))
    print(
        f"\nbump of {bump}: decided after {np.median(first):.0f} records, {max(first)} at most ({counted}); "
        f"predictions {np.median(left):.2f} mm off after 20 records, {max(left):.2f} at most"
    )
    assert np.mean(np.array(first) <= 5) >= 0.95
    assert np.median(left) < 0.7
    assert kinds.count("sensor_moved") >= 0.9 * seeds


@pytest.mark.slow
@pytest.mark.parametrize("count", [400, 10_000 * TIMES])
def test_outliers_alone_never_reset_anything(count: int) -> None:
    recalibrator, fresh = _shared()
    recalibrator.restore(fresh)
    ran = run(recalibrator, World.drawn(77, outliers=0.05), count, count)
    resets = [each for each in ran.decisions if each[1] in RESETS]
    suspicions = len(ran.decisions) - len(resets)
    print(
        f"\n{count} records with 5 % outliers: {len(resets)} resets, {suspicions} suspicions, "
        f"{100 * ran.good_rejected / ran.good:.3f} % of good records rejected, error {ran.errors[-1]:.3f} mm"
    )
    assert not resets
