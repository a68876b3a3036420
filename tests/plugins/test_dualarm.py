"""Two arms in one frame: shared sockets tell where they stand, trackers help a closed chain, trades are named."""

from __future__ import annotations

import json
import shutil

import numpy as np
import pytest
import two_arms
import yaml
from armcal.cli.main import cli
from armcal.estimate.identifiability import identify
from click.testing import CliRunner
from scipy.spatial.transform import Rotation
from two_arms import CONFIGS, JOINTS, Case, NumpyArm, offsets_of, placements

BALL = (0.02, -0.01, 0.06)
SOCKETS = {
    "low/hole_0": (0.42, 0.05, 0.25),
    "low/hole_1": (0.42, -0.05, 0.27),
    "middle/hole_0": (0.36, 0.0, 0.36),
    "middle/hole_1": (0.46, 0.02, 0.38),
    "high/hole_0": (0.44, 0.04, 0.47),
    "high/hole_1": (0.4, -0.04, 0.5),
}
SHIFT, TURN = (0.0009, -0.0012, 0.0007), (0.0008, 0.0011, -0.0009)
"""m and rad: where the right arm stands, in the frame in which it is believed to stand."""
PLACEMENT = [*(f"right.placement_{axis}" for axis in "xyz"), *(f"right.placement_rotation[{e}]" for e in "wxyz")]
OFFSETS = {arm: [f"{arm}.poe.offset{i}" for i in JOINTS] for arm in ("left", "right")}
LITTLE = {"right.placement_[xyz]": "1 mm", "right.placement_rotation": "1 mrad"}
CLOSURE = {
    "type": "closed_chain",
    "noise_mm": 0.001,
    "orientation_noise_rad": 1e-6,
    "clamps": {"one": {"position_mm": [0, 0, 120], "rpy_deg": [180, 90, 0]}},
}


def written(folder, truth, **content):
    """A configuration of the two arms with its truth beside it, as a case."""
    shutil.copy(CONFIGS / "two_arms.yaml", folder)
    simulation = {"type": "contacts", "truth": "truth.yaml", "within_deg": 60, "seed": 3, **content.pop("simulation")}
    (folder / "truth.yaml").write_text(yaml.safe_dump(truth))
    path = folder / "case.yaml"
    path.write_text(yaml.safe_dump({"extends": "two_arms.yaml", "simulation": simulation, **content}))
    return Case(path)


def true_placement():
    """base_T_right as it is (4 x 4), and as a truth file says it."""
    moved = np.eye(4)
    moved[:3, :3], moved[:3, 3] = Rotation.from_rotvec(TURN).as_matrix(), SHIFT
    pose = placements()["right"] @ moved
    x, y, z, w = Rotation.from_matrix(pose[:3, :3]).as_quat()
    stated = {name: f"{float(value)!r} m" for name, value in zip(PLACEMENT[:3], pose[:3, 3], strict=True)}
    return pose, stated | {name: float(v) for name, v in zip(PLACEMENT[3:], (w, x, y, z), strict=True)}


def pose_of(found):
    """base_T_right of an estimate (4 x 4)."""
    values = {n: found.values[found.parameters.entries_of(n)] for n in (*PLACEMENT[:3], "right.placement_rotation")}
    w, x, y, z = values["right.placement_rotation"]
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = Rotation.from_quat([x, y, z, w]).as_matrix(), [values[n][0] for n in PLACEMENT[:3]]
    return pose


def apart(one, other):
    """Distance (m) and angle (rad) between two poses."""
    between = np.linalg.inv(one) @ other
    return float(np.linalg.norm(between[:3, 3])), float(Rotation.from_matrix(between[:3, :3]).magnitude())


# ---------------------------------------------------------------- both arms touch the same sockets


@pytest.fixture(scope="module")
def in_sockets(tmp_path_factory):
    """Both arms in six sockets that nobody measured."""
    ball = {"type": "ball_in_socket", "noise_mm": 0.01, "centre_m": list(BALL)}
    stated = {
        f"touches.{key}.{axis}": f"{x} m" for key, spot in SOCKETS.items() for axis, x in zip("xyz", spot, strict=True)
    }
    return written(
        tmp_path_factory.mktemp("sockets"),
        true_placement()[1] | stated,
        measurements={
            "touches": {**ball, "arm": "left"},
            "others": {**ball, "arm": "right", "sockets_of": "touches"},
        },
        parameters={"free": ["right.placement_*"], "priors": LITTLE},
        simulation={"groups": {"touches": list(SOCKETS), "others": list(SOCKETS)}, "count": 8},
    )


def by_hand(case, data):
    """base_T_right by the mean places of each socket in either arm's frame."""
    keys = [f"{p}/{s}" for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)]
    means = {}
    for arm in ("left", "right"):
        side = NumpyArm(case, arm)
        side.q = np.stack([data.channels[f"{arm}.q{i}"] for i in JOINTS], axis=1)
        mine = ~np.isnan(side.q[:, 0])
        at = np.full((len(keys), 3), np.nan)
        side.q = side.q[mine]
        at[mine] = (side.poses() @ np.array([*BALL, 1.0]))[:, :3]
        means[arm] = np.array([at[mine & (np.array(keys) == key)].mean(axis=0) for key in SOCKETS])
    base = placements()["left"]
    there, here = means["left"] @ base[:3, :3].T + base[:3, 3], means["right"]
    turn, _ = Rotation.align_vectors(there - there.mean(axis=0), here - here.mean(axis=0))
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = turn.as_matrix(), there.mean(axis=0) - turn.apply(here.mean(axis=0))
    return pose


@pytest.mark.slow
def test_shared_sockets_tell_where_the_arms_stand_to_each_other(in_sockets):
    data, (true, _) = in_sockets.records(), true_placement()
    assert len(data) == 2 * 8 * len(SOCKETS)
    assert np.isnan(data.channels["left.q1"]).sum() == np.isnan(data.channels["right.q1"]).sum() == len(data) / 2
    assert max(apart(by_hand(in_sockets, data), true)) < 1e-7, "the simulated postures are not in the sockets"
    found = in_sockets.fit(data)
    assert found.verdict.converged and {*found.determined_by} == {"data"}
    assert found.identifiability.rank == 6 + 3 * len(SOCKETS)
    # Priors of a millimetre pull a little, against joints that are believed to a tenth of a milliradian.
    assert max(apart(pose_of(found), true)) < 2e-5
    assert max(apart(placements()["right"], true)) > 1e-3
    for key, spot in SOCKETS.items():
        place = [found.values[found.parameters.entries_of(f"touches.{key}.{axis}")][0] for axis in "xyz"]
        assert place == pytest.approx(spot, abs=2e-5)


@pytest.mark.slow
def test_with_noise_the_placement_comes_back_within_its_intervals(in_sockets):
    true, _ = true_placement()
    inside, off, by_means = [], [], []
    for seed in range(8):
        data = in_sockets.records(seed)
        found = in_sockets.fit(data)
        truth = in_sockets.true_values[list(found.free_entries)]
        inside += [i.lower <= x <= i.upper for i, x in zip(found.intervals, truth, strict=True)]
        off.append(apart(pose_of(found), true))
        by_means.append(apart(by_hand(in_sockets, data), true))
    assert 0.90 < np.mean(inside) < 0.99
    assert np.all(np.mean(off, axis=0) < 1.05 * np.mean(by_means, axis=0)), "plain means do better"
    assert np.all(np.mean(off, axis=0) > 0.2 * np.mean(by_means, axis=0)), "too good: the truth leaks in"


@pytest.mark.slow
@pytest.mark.parametrize(
    "settings",
    [pytest.param((), marks=pytest.mark.slow), ("validation.holdout=0.3", "validation.folds=3")],
    ids=["all", "judged"],
)
def test_records_that_only_one_arm_takes_part_in_run_from_a_file(in_sockets, tmp_path, settings):
    """The other arm's cells are empty; judging, reports and tests of what is left pass over them."""
    path = tmp_path / "touches.csv"
    made = CliRunner().invoke(cli, ["simulate", str(in_sockets.path), "--out", str(path)])
    assert made.exit_code == 0, made.output
    assert np.isnan(in_sockets.records().channels["left.q7"]).any()
    told, kept = ran(in_sockets, tmp_path, f"data={json.dumps({'type': 'csv', 'path': str(path)})}", *settings)
    assert told["solver"]["converged"] and told["records"]["used"] == 2 * 8 * len(SOCKETS)
    true = dict(zip(in_sockets.problem.parameters.entry_names, in_sockets.true_values, strict=True))
    assert all(abs(kept[n]["value"] - true[n]) < 4.5 * kept[n]["sd"] for n in kept)
    assert set(PLACEMENT) <= {n for n, p in kept.items() if p["determined_by"] == "data"}
    assert told["noise"]["scale"] == pytest.approx(1, abs=0.2)
    assert not told["structure"]["residual_structure"]["structures"]
    if settings:
        held, trained = (told["error_mm"]["calibrated"][who]["mean"] for who in ("cross_validated", "train"))
        assert held == pytest.approx(trained, rel=0.5)


@pytest.mark.slow
def test_sockets_of_their_own_tell_nothing_of_the_placement(in_sockets):
    """What ties the arms is that the sockets are the same."""
    path = in_sockets.path.parent / "apart.yaml"
    content = yaml.safe_load(in_sockets.path.read_text())
    del content["measurements"]["others"]["sockets_of"]
    path.write_text(yaml.safe_dump(content))
    problem = Case(path).experiment.of_records(in_sockets.postures)
    assert len(problem.parameters.nuisances) == 2 * 3 * len(SOCKETS)
    alone = Case(path)
    alone.__dict__["postures"] = in_sockets.postures
    found = alone.fit(in_sockets.records())
    told = {n: by == "data" for n, by in zip(found.names, found.determined_by, strict=True)}
    assert not any(told[name] for name in PLACEMENT)
    assert all(told[name] for name in told if name.startswith("touches."))


# ---------------------------------------------------------------- a tracker beside a closed chain


def tracked(case, count, target):
    """Exact points of the left tool in the base frame, at random joint angles of the left arm alone."""
    side = NumpyArm(case, "left")
    side.q = np.random.default_rng(8).uniform(-1, 1, (count, 7))
    poses = placements()["left"] @ side.poses()
    return side.q, (poses @ np.array([*target, 1.0]))[:, :3]


@pytest.fixture(scope="module")
def mixed(tmp_path_factory):
    """The left arm's offsets and an unknown clamp: the right arm is known, a tracker sees some of the left one."""
    random = np.random.default_rng(4)
    truth = {name: f"{float(x)!r} rad" for name, x in zip(OFFSETS["left"], random.uniform(-0.04, 0.04, 7), strict=True)}
    clamp = {"closure.one.clamp_x": "0.004 m", "closure.one.clamp_y": "-0.003 m", "closure.one.clamp_z": "0.118 m"}
    turned = Rotation.from_euler("xyz", [178, 88, 1], degrees=True).as_quat()
    clamp |= {f"closure.one.clamp_rotation[{e}]": float(x) for e, x in zip("xyzw", turned, strict=True)}
    tracker = {"type": "tip_position", "arm": "left", "noise_mm": 0.02, "target_mm": [15, 20, 40]}
    return written(
        tmp_path_factory.mktemp("mixed"),
        truth | clamp,
        measurements={"closure": {**CLOSURE, "clamps": {}}, "tracker": tracker},
        parameters={"free": ["left.poe.offset*"]},
        data={"type": "csv", "path": "mixed.csv"},
        simulation={"groups": {"closure": ["one"]}, "count": 30},
    )


def mixed_csv(case, records, seed=None):
    """A file of closed chains and tracked points; what a record lacks is an empty cell."""
    q, at = tracked(case, records, (0.015, 0.02, 0.04))
    random = np.random.default_rng(seed)
    noise = 0.0 if seed is None else 1.0
    columns = [f"{arm}.q{i}" for arm in ("left", "right") for i in JOINTS]
    chains = np.stack([case.records(seed).channels[c] for c in columns], axis=1)
    q, at = q + noise * 1e-4 * random.normal(size=q.shape), 1000 * at + noise * 0.02 * random.normal(size=at.shape)
    header = ",".join(["pose_id", *(f"{c}_rad" for c in columns), *(f"tracker.{a}_mm" for a in "xyz")])
    lines = [",".join([f"c{i}", *map(repr, row.tolist()), "", "", ""]) for i, row in enumerate(chains)]
    lines += [
        ",".join([f"t{i}", *map(repr, row.tolist()), *[""] * 7, *map(repr, p.tolist())])
        for i, (row, p) in enumerate(zip(q, at, strict=True))
    ]
    mixed = [lines[i] for i in np.random.default_rng(1).permutation(len(lines))]
    (case.path.parent / "mixed.csv").write_text("\n".join([header, *mixed]) + "\n")


def ran(case, folder, *settings):
    """``armcal run``: its metrics and the free parameters by name."""
    asked = [x for s in ("evaluator=interpreted", *settings) for x in ("--set", s)]
    arguments = ["run", str(case.path), "--out", str(folder / "out"), "--json", *asked]
    result = CliRunner().invoke(cli, arguments)
    assert result.exit_code == 0, result.output
    kept = yaml.safe_load((folder / "out" / "calibration.yaml").read_text())["parameters"]
    return json.loads(result.stdout), {p["name"]: p for p in kept if p["free"]}


@pytest.mark.slow
def test_closed_chains_and_tracked_points_in_one_file_give_what_neither_gives_alone(mixed, tmp_path):
    still = ("arms.left.joint_noise_rad=0", "arms.right.joint_noise_rad=0")
    mixed_csv(mixed, 12)
    told, kept = ran(mixed, tmp_path, *still)
    assert told["records"]["used"] == 42 and told["solver"]["converged"]
    assert told["parameters"]["undetermined"] == [] and all(p["determined_by"] == "data" for p in kept.values())
    assert len(kept) == 7 + 7
    truth = dict(zip(mixed.problem.parameters.entry_names, mixed.true_values, strict=True))
    for name, p in kept.items():
        if "rotation" not in name:
            assert p["value"] == pytest.approx(truth[name], abs=1e-7), name
    turn = [np.array([p[f"closure.one.clamp_rotation[{e}]"] for e in "wxyz"]) for p in
            ({n: x["value"] for n, x in kept.items()}, truth)]  # fmt: skip
    assert abs(turn[0] @ turn[1]) == pytest.approx(1, abs=1e-12)
    # Without the tracker the last joint trades with the clamp; a prior is then what holds it.
    mixed_csv(mixed, 0)
    alone, kept = ran(mixed, tmp_path, 'parameters.priors={"left.poe.offset7": "0.05 rad"}')
    assert (
        alone["parameters"]["determined_by"]["left.poe.offset7"] == kept["left.poe.offset7"]["determined_by"] == "prior"
    )
    assert kept["left.poe.offset3"]["determined_by"] == "data"


@pytest.mark.slow
def test_noisy_closed_chains_and_tracked_points_hold_the_truth_in_their_intervals(mixed, tmp_path):
    truth = dict(zip(mixed.problem.parameters.entry_names, mixed.true_values, strict=True))
    inside = []
    for seed in range(3):
        mixed_csv(mixed, 12, seed)
        told, kept = ran(mixed, tmp_path)
        assert told["noise"]["scale"] == pytest.approx(1, abs=0.2)
        inside += [kept[name]["lower"] <= truth[name] <= kept[name]["upper"] for name in OFFSETS["left"]]
    assert np.mean(inside) > 0.85


# ---------------------------------------------------------------- where the bases stand, beside a closed chain


@pytest.fixture(scope="module")
def chained(tmp_path_factory):
    """Offsets of both arms and the right one's placement, under a prior of a millimetre and a milliradian."""
    truth = {n: f"{0.01 * (-1) ** i * (1 + i / 7):.4f} rad" for i, n in enumerate(OFFSETS["left"] + OFFSETS["right"])}
    priors = {**LITTLE, "*.poe.offset*": "0.05 rad"}
    return written(
        tmp_path_factory.mktemp("chained"),
        truth | true_placement()[1],
        measurements={"closure": CLOSURE},
        parameters={"free": ["left.poe.offset*", "right.poe.offset*", "right.placement_*"], "priors": priors},
        simulation={"groups": {"closure": ["one"]}, "count": 40},
    )


FIRST = {"left.poe.offset1", "right.poe.offset1"}


def test_the_placement_trades_with_the_first_joint_of_each_arm_and_both_are_named(chained):
    data = chained.records(1)
    problem, records = chained.problem, chained.problem.of(data).records
    known = identify(problem.with_records(records), problem.parameters.nominal())
    assert (known.rank, len(known)) == (18, 20)
    combinations = [set(dict(each.terms)) for each in known.undetermined]
    assert len(combinations) == 2
    for combination in combinations:
        assert combination & FIRST and combination - FIRST <= {
            *(f"right.placement_{a}" for a in "xyz"),
            *(f"right.placement_rotation<r{a}>" for a in "xyz"),
        }
    assert set.union(*combinations) & FIRST == FIRST
    turning = next(c for c in combinations if c & FIRST == {"right.poe.offset1"})
    assert turning == {"right.poe.offset1", "right.placement_rotation<rz>"}
    found = chained.fit(data)
    told = {n: by == "data" for n, by in zip(found.names, found.determined_by, strict=True)}
    assert {n for n in told if "offset" in n and not told[n]} == FIRST


def test_the_rank_with_a_placement_is_that_of_plain_numpy(chained):
    case = Case(CONFIGS / "dual_known_clamp.yaml")
    slopes = two_arms.oracle_slopes(case, ["left", "right"], ["offsets", "placement"])
    values = np.linalg.svd(slopes / np.linalg.norm(slopes, axis=0), compute_uv=False)
    assert int(np.sum(values > 1e-6 * values[0])) == 18 and len(values) == 20


@pytest.mark.slow
def test_a_placement_in_the_problem_costs_the_other_joints_little_and_one_left_out_costs_all(chained):
    """What does not trade comes back; with the placement held where it is believed nothing does."""
    held = Case(chained.path, ('parameters.free=["left.poe.offset*", "right.poe.offset*"]', "parameters.priors={}"))
    names = [n for arm in OFFSETS.values() for n in arm if n not in FIRST]
    true = np.array([chained.truth[n] for n in names])
    freed_off, held_off = [], []
    for seed in range(6):
        data = chained.records(seed)
        freed_off.append(offsets_of(chained.fit(data), names) - true)
        held.__dict__["postures"] = chained.postures
        held_off.append(offsets_of(held.fit(data), names) - true)
    assert np.sqrt(np.mean(np.square(freed_off))) < 1e-4
    assert np.sqrt(np.mean(np.square(held_off))) > 10 * np.sqrt(np.mean(np.square(freed_off)))
