"""Noise of the joints' readings carried over to residuals: against finite differences, scatter, and coverage."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import contact_oracle as co
import numpy as np
import oracle
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.intervals import PredictionRecord, Uncertainty
from armcal.estimate.estimator import estimate
from armcal.estimate.polish import started
from armcal.problem.variants import with_joint_noise
from armcal_contact.contacts import TipDistance
from armcal_ipopt.estimator import IpoptEstimator
from armcal_tracker.position import TipPosition, TipPositionSettings
from chain_oracle import ChainSpec, Row
from contact_oracle import BALL, LEFT, RIGHT, SPOTS, ball, near
from made_calibrations import made_calibration

JOINT_SD, SEAT_SD = 1e-3, 2e-4
SLIDING = ChainSpec((Row(a=0.3, alpha=0.3), Row(kind="prismatic", alpha=co.HALF, theta=0.2, d=0.1), Row(a=0.2, d=0.05)))

DEMO = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm" / "demo.yaml"


def noisy_arm(chain=LEFT, name="left", sd=JOINT_SD):
    return co.the_arm(chain, name, joint_noise=sd)


def seated(count=4, seed=0, key="front/hole_0", chain=LEFT, arm="left", place=BALL):
    position, socket = key.split("/")
    q = co.touching(chain, co.in_socket(SPOTS[key], place), count, seed)
    return q, (co.joints(q, arm), {"position": position, "socket": socket})


def covariances(problem, records, values):
    """What the whitening of each record stands for (factors of N x n x n)."""
    found = []
    for kernel, each in zip(
        problem.kernels, with_joint_noise(problem.with_records(records), values).records, strict=True
    ):
        if each.whitening is None:
            found.append(np.repeat(np.diag(np.array(kernel.factor.noise) ** 2)[None], each.count, axis=0))
        else:
            whitening = np.moveaxis(each.whitening, 2, 0)[: each.count]
            found.append(np.linalg.inv(np.swapaxes(whitening, 1, 2) @ whitening))
    return found


def slopes(chain, q, local, v=None, arm="left"):
    """d point / d joint by central differences (N x 3 x n)."""
    sides = [[co.points(chain, q + s * h, local, v, arm) for s in (1, -1)] for h in 1e-6 * np.eye(q.shape[1])]
    return np.stack([(up - down) / 2e-6 for up, down in sides], axis=-1)


@pytest.mark.parametrize("stated", [None, 5e-4], ids=["declared", "by record"])
def test_the_covariance_is_the_contacts_own_and_what_the_joints_make_of_it(stated):
    q, part = seated(5)
    if stated:
        part = ({**part[0], "balls.noise": np.linspace(1, 2, 5) * stated}, part[1])
    data = co.dataset([part])
    problem, records = co.Bench({"left": noisy_arm()}, {"balls": ball(("left",), noise=SEAT_SD)}).problem(data)
    values = near(problem)
    v = co.by_name(problem.parameters, values)
    found = covariances(problem, records, values)[0]
    own = np.linspace(1, 2, 5) * stated if stated else np.full(5, SEAT_SD)
    by_joint = slopes(LEFT, q, BALL, v)
    expected = own[:, None, None] ** 2 * np.eye(3) + JOINT_SD**2 * by_joint @ np.swapaxes(by_joint, 1, 2)
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-6 * expected.max())


def test_residuals_scatter_as_the_covariance_says():
    """Many readings of one posture, each with its own error of every joint and of the seat."""
    random, count = np.random.default_rng(1), 8000
    q, _ = seated(1, 3)
    read = q + random.normal(0, JOINT_SD, (count, 4))
    data = co.dataset([(co.joints(read, "left"), {"position": "front", "socket": "hole_0"})])
    exact = co.dataset([(co.joints(q, "left"), {"position": "front", "socket": "hole_0"})])
    made = co.Bench({"left": noisy_arm()}, {"balls": ball(("left",), noise=SEAT_SD)})
    problem, records = made.problem(data)
    values = problem.parameters.nominal()
    scattered = problem.with_records(records).residuals(values)[0] + random.normal(0, SEAT_SD, (3, count))
    expected = covariances(problem, problem.of(exact).records, values)[0][0]
    sample = np.cov(scattered)
    size = np.sqrt(np.diag(expected))
    assert np.abs((sample - expected) / np.outer(size, size)).max() < 0.06
    assert size.max() > 1.2 * SEAT_SD, "the joints add hardly anything: the test is empty"
    whitened = with_joint_noise(problem.of(exact), values).records[0].whitening[:, :, 0] @ scattered
    np.testing.assert_allclose(np.cov(whitened), np.eye(3), atol=0.06)


def test_sliding_joints_and_arms_without_noise_add_nothing():
    random = np.random.default_rng(2)
    q = random.uniform(-1, 1, (4, 3)) * [1, 0.1, 1]
    data = co.dataset([(co.joints(q, "left"), {"position": "front", "socket": "hole_0"})])
    problem, records = co.Bench({"left": noisy_arm(SLIDING)}, {"balls": ball(("left",), noise=SEAT_SD)}).problem(data)
    values = problem.parameters.nominal()
    turning = np.stack([slopes_of_sliding(q, i) for i in (0, 2)], axis=-1)
    expected = SEAT_SD**2 * np.eye(3) + JOINT_SD**2 * turning @ np.swapaxes(turning, 1, 2)
    np.testing.assert_allclose(covariances(problem, records, values)[0], expected, rtol=0, atol=1e-6 * expected.max())
    quiet, records = co.Bench({"left": noisy_arm(sd=0.0)}, {"balls": ball(("left",))}).problem(
        co.dataset([seated()[1]])
    )
    same = with_joint_noise(quiet.with_records(records), quiet.parameters.nominal()).records
    assert all(one is other for one, other in zip(same, records, strict=True))


def slopes_of_sliding(q, joint):
    """d ball / d one joint of the arm with a sliding one (N x 3), by the oracle of single poses."""
    zeros = {f"{kind}{i}": 0.0 for kind in ("offset", "gain") for i in (1, 2, 3)}
    at = {**SLIDING.nominal(), **zeros, **{f"target_{a}": x for a, x in zip("xyz", BALL, strict=True)}}
    step = 1e-6 * np.eye(3)[joint]
    return (SLIDING.tip(at, q + step) - SLIDING.tip(at, q - step)) / 2e-6


def test_each_arm_brings_its_own_joints_and_rows_of_the_other_do_not_matter():
    """Tracker rows of one arm and socket rows of another: nan where a row has no such joints."""
    q, part = seated(3, 4)
    other = co.random_joints(RIGHT, 4, 5)
    at = co.points(RIGHT, other)
    seen = {**co.joints(other, "right"), **{f"tracker.{a}": at[:, i] for i, a in enumerate("xyz")}}
    arms = {"left": noisy_arm(), "right": noisy_arm(RIGHT, "right", 3 * JOINT_SD)}
    tracker = TipPosition(TipPositionSettings.si(noise=1e-3, arm="right"), tuple(arms))
    data = co.dataset([part, (seen, {})])
    problem, records = co.Bench(arms, {"balls": ball(noise=SEAT_SD), "tracker": tracker}).problem(data)
    values = problem.parameters.nominal()
    of_ball, of_tracker = covariances(problem, records, values)
    mine = slopes(LEFT, q, BALL)
    expected = SEAT_SD**2 * np.eye(3) + JOINT_SD**2 * mine @ np.swapaxes(mine, 1, 2)
    np.testing.assert_allclose(of_ball[:3], expected, rtol=0, atol=1e-6 * expected.max())
    theirs = slopes(RIGHT, other, (0, 0, 0), None, "right")
    expected = 1e-6 * np.eye(3) + (3 * JOINT_SD) ** 2 * theirs @ np.swapaxes(theirs, 1, 2)
    np.testing.assert_allclose(of_tracker[3:], expected, rtol=0, atol=1e-6 * expected.max())
    weighed = with_joint_noise(problem.with_records(records), values).records
    found = problem.with_records(weighed).normal_equations(values)
    assert np.isfinite(found.hessian).all()
    assert found.cost == pytest.approx(problem.with_records(weighed).cost(values), rel=1e-12)


def test_a_distance_between_two_records_has_the_noise_of_both():
    q, tip = co.random_joints(LEFT, 6, 9), (0.0, 0.01, 0.05)
    partner = ("", "0", "0", "", "3", "1")
    reading = np.where([bool(name) for name in partner], 0.2, np.nan)
    data = co.dataset([({**co.joints(q, "left"), "gauge.distance": reading}, {})])
    data = replace(data, extra={"partner": partner})
    gauge = TipDistance(TipDistance.Settings.si(noise=SEAT_SD, tip=tip), ("left",))
    problem, records = co.Bench({"left": noisy_arm()}, {"gauge": gauge}).problem(data.subset([0, 3, 1, 2, 4, 5]))
    records = problem.with_records(records).subset(np.arange(2, 6)).records
    found = covariances(problem, records, problem.parameters.nominal())[0].ravel()
    at, turns = co.points(LEFT, q, tip), slopes(LEFT, q, tip)
    for row, one in enumerate((1, 2, 4, 5)):
        other = int(partner[one])
        line = (at[one] - at[other]) / np.linalg.norm(at[one] - at[other])
        by_joint = np.concatenate([line @ turns[one], line @ turns[other]])
        assert found[row] == pytest.approx(SEAT_SD**2 + JOINT_SD**2 * by_joint @ by_joint, rel=1e-6)


def test_part_of_the_records_keeps_the_whitening_of_each():
    made = co.Bench({"left": noisy_arm()}, {"balls": ball(("left",), noise=SEAT_SD)})
    problem, records = made.problem(co.dataset([seated(6, 7)[1], seated(5, 8, "shelf/hole_0")[1]]))
    values = near(problem)
    whole, chosen = with_joint_noise(problem.with_records(records), values).records, np.array([9, 2, 5])
    part = problem.with_records(whole).subset(chosen).records
    alone = with_joint_noise(problem.with_records(records).subset(chosen), values).records
    np.testing.assert_allclose(part[0].whitening[:, :, :3], alone[0].whitening[:, :, :3], rtol=1e-12)
    assert problem.with_records(part).cost(values) == pytest.approx(problem.with_records(alone).cost(values), rel=1e-12)
    residual = problem.with_records(records).subset(chosen).residuals(values)[0].T
    precision = np.linalg.inv(covariances(problem, problem.with_records(records).subset(chosen).records, values)[0])
    expected = 0.5 * np.einsum("ni,nij,nj->", residual, precision, residual)
    assert problem.with_records(part).cost(values) == pytest.approx(expected, rel=1e-9)


def test_slopes_by_joints_are_those_in_elastic_equilibrium(lrm):
    """Springs give way when a joint turns: the slope of a soft arm is not that of a rigid one."""
    q = oracle.random_poses(6, 1)
    experiment = lrm.experiment()
    dataset = lrm.dataset(q)
    problem, names = lrm.problem(experiment, dataset), [f"arm.q{i}" for i in range(1, 7)]
    soft = {n: 2 * x for n, x in oracle.published().items() if n.startswith("k")}
    values = lrm.vector(problem.parameters, {n: soft[n] for n in soft})
    found = problem.of(dataset).channel_slopes(values, names)[0]
    for joint, step in enumerate(1e-5 * np.eye(6)):
        sides = [problem.of(lrm.dataset(q + s * step)).residuals(values)[0] for s in (1, -1)]
        np.testing.assert_allclose(found[:, joint], (sides[0] - sides[1]) / 2e-5, rtol=0, atol=1e-7)
    nothing = problem.of(dataset).channel_slopes(values, ["arm.q1", "nobody.q1"])[0]
    np.testing.assert_array_equal(nothing[:, 1], 0.0)
    np.testing.assert_allclose(nothing[:, 0], found[:, 0], atol=1e-12)


# ---------------------------------------------------------------- coverage

FREE = ("left.mdh.a2", "left.mdh.a3", "left.mdh.theta2", "left.mdh.theta3")


def simulated_fits(seeds):
    """Estimates from seeds of joint and seat noise, and the truth by entry name."""
    truth = {**co.named(LEFT, "left"), "left.mdh.a2": 0.303, "left.mdh.theta3": 0.01}
    parts, moves = [], []
    for number, key in enumerate(("front/hole_0", "front/hole_1", "shelf/hole_0", "back/hole_0")):
        q = co.touching(LEFT, co.in_socket(SPOTS[key], BALL), 8, 60 + number, truth, "left")
        moves.append(np.linalg.pinv(slopes(LEFT, q, BALL, truth)))
        position, socket = key.split("/")
        parts.append((co.joints(q, "left"), {"position": position, "socket": socket}))
        truth |= {f"balls.{key}.{a}": x for a, x in zip("xyz", SPOTS[key], strict=True)}
    data, by_place = co.dataset(parts), np.concatenate(moves)
    made = co.Bench({"left": noisy_arm()}, {"balls": ball(("left",), noise=SEAT_SD)}, FREE)
    problem, _ = made.problem(data, "compiled")
    solver = IpoptEstimator(IpoptEstimator.Settings())
    for seed in range(seeds):
        random = np.random.default_rng(1000 + seed)
        seat = np.einsum("nij,nj->ni", by_place, random.normal(0, SEAT_SD, (len(data), 3)))
        off = seat + random.normal(0, JOINT_SD, seat.shape)
        dataset = replace(data, channels={c: x + off[:, i] for i, (c, x) in enumerate(data.channels.items())})
        begun = started(problem.of(dataset))
        begun = with_joint_noise(begun, begun.parameters.nominal())
        solution = solver.solve(begun, begun.parameters.nominal())
        assert solution.verdict.converged
        yield estimate(begun, solution), truth


def inside_and_errors(seeds):
    """How often 95 % intervals hold the truth, and errors in units of their stated deviation (seeds x entries)."""
    held, errors = [], []
    for found, truth in simulated_fits(seeds):
        for name, interval, sd in zip(found.names, found.intervals, found.deviations, strict=True):
            held.append(interval.lower <= truth[name] <= interval.upper)
            value = found.values[found.parameters.entries_of(name)][0]
            errors.append((value - truth[name]) / sd)
    return float(np.mean(held)), np.array(errors).reshape(seeds, -1)


@pytest.mark.slow
def test_a_hundred_seeds_lie_in_their_intervals_as_often_as_they_say():
    share, errors = inside_and_errors(100)
    assert 0.92 <= share <= 0.98
    assert np.sqrt(np.mean(errors**2)) == pytest.approx(1.0, abs=0.1)
    assert np.abs(errors.mean(axis=0)).max() < 0.45, "an estimate is off by more than chance"


@pytest.mark.slow
@pytest.mark.parametrize("scale", [1.0, 0.4])
def test_intervals_of_predictions_have_what_the_joints_noise_makes_of_the_tip(scale: float) -> None:
    """By differences of the predicted tip: servos that are off by 0.1 deg move it, however many poses were fitted.

    Residuals that are smaller than stated, as at the angles of a servo's table, leave that as it is.
    """
    plain, noisy = (made_calibration(DEMO, stated) for stated in ((), ("arms.arm.joint_noise_deg=0.1",)))
    random, step, sd = np.random.default_rng(3), 1e-5, np.deg2rad(0.1)
    channels = {f"arm.q{i}": random.uniform(-0.8, 0.8, 4) for i in range(1, 7)}
    commands = Dataset(tuple("abcd"), channels)
    added = np.zeros((3, 4))
    for name in channels:
        ahead, behind = (replace(commands, channels={**channels, name: channels[name] + s}) for s in (step, -step))
        tips = [np.array([plain.predict(c)[0][f"tracker.{a}"] for a in "xyz"]) for c in (ahead, behind)]
        added += ((tips[0] - tips[1]) / (2 * step) * sd) ** 2
    variances = []
    for calibration in (plain, noisy):
        parameters = calibration.parameters.with_free(["arm.mdh.base_x"])
        known = PredictionRecord(entries=("arm.mdh.base_x",), covariance=((1e-8,),))
        uncertainty = Uncertainty(calibration.system, parameters, parameters.nominal(), known, scale, 1e6)
        deviations = uncertainty.plus_minus(commands).deviations
        variances.append(np.array([deviations[f"tracker.{axis}"] for axis in "xyz"]) ** 2)
    np.testing.assert_allclose(variances[1] - variances[0], added, rtol=1e-4)
