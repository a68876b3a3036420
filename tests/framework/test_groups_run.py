"""Sockets through whole runs: errors by tool position, what judges, and bad input through the command line."""

from __future__ import annotations

from dataclasses import replace

import contact_oracle as co
import numpy as np
import pytest
import yaml
from armcal.cli.main import cli
from armcal.measure.reader import requested_channels
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate
from armcal_mdh.model import MdhModel
from click.testing import CliRunner
from contact_oracle import BALL, DISTANCE, LEFT, NOISE, SPOTS, TIE_NOISE, ball, bench

TRUTH = {"left.mdh.a2": 0.3015, "left.mdh.theta3": 0.008}
FREE = ["left.mdh.a2", "left.mdh.theta2", "left.mdh.theta3"]
MM = 1000.0


def recorded(seed=0, count=7):
    """Postures of the true arm in every socket, read with a little noise."""
    random, parts = np.random.default_rng(seed), []
    for number, (key, spot) in enumerate(SPOTS.items()):
        position, socket = key.split("/")
        q = co.touching(LEFT, co.in_socket(spot, BALL), count, 20 * seed + number, TRUTH, "left")
        parts.append((co.joints(q + random.normal(0, 5e-4, q.shape), "left"), {"position": position, "socket": socket}))
    return co.dataset(parts)


def written(place, data, instrument=None, **sections):
    """A configuration and its records in a folder."""
    arm = MdhModel.Settings.si(**LEFT.settings()).to_config()
    contact = {
        "noise_mm": NOISE * MM,
        "centre_mm": [MM * x for x in BALL],
        "distances": [{"between": ["hole_0", "hole_1"], "distance_mm": DISTANCE * MM, "noise_mm": TIE_NOISE * MM}],
        **(instrument or {}),
    }
    config = {
        "arms": {"left": {"model": {"type": "mdh", **arm}}},
        "measurements": {"balls": {"type": "ball_in_socket", **contact}},
        "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
        "data": {"type": "csv", "path": "touches.csv"},
        "parameters": {"free": FREE},
        "evaluator": "interpreted",
        **sections,
    }
    path = place / "run.yaml"
    path.write_text(yaml.safe_dump(config, sort_keys=False), encoding="utf-8")
    made = bench()
    measurements = {"balls": made.measurements["balls"]}
    write_csv(place / "touches.csv", data, requested_channels({"left": made.arms["left"]}, measurements, measured=True))
    return path


@pytest.fixture(scope="module")
def data():
    return recorded()


@pytest.fixture(scope="module")
def run(data, tmp_path_factory):
    """Trained on two positions, judged by the third."""
    validation = {"train_groups": ["front", "back"]}
    return calibrate(Experiment.load(written(tmp_path_factory.mktemp("run"), data, validation=validation)))


def balls(data, values):
    """Where the ball was in each record (N x 3), and the key of its socket."""
    q = np.stack([data.channels[f"left.q{i}"] for i in range(1, 5)], axis=1)
    keys = [f"{p}/{s}" for p, s in zip(data.extra["position"], data.extra["socket"], strict=True)]
    return co.points(LEFT, q, BALL, values, "left"), np.array(keys)


def means(data, values):
    at, keys = balls(data, values)
    return {key: at[keys == key].mean(axis=0) for key in np.unique(keys)}


@pytest.mark.slow
def test_the_arm_is_found_from_the_trained_positions(run):
    found = co.by_name(run.estimate.parameters, run.estimate.values)
    for name, sd in zip(run.estimate.names, run.estimate.deviations, strict=True):
        if name in TRUTH:
            assert abs(found[name] - TRUTH[name]) < 4 * sd, name
    assert not any("shelf" in name for name in run.estimate.names)
    assert run.fit.problem.blueprint.groups == {"balls": tuple(sorted(SPOTS))}


def test_errors_of_each_position_are_distances_to_its_sockets(run, data):
    """Fitted sockets where they were trained on, means of the postures elsewhere and before."""
    found, nominal = co.by_name(run.estimate.parameters, run.estimate.values), co.named(LEFT, "left")
    assert list(run.groups) == ["back", "front", "shelf"]
    before, keys = balls(data, nominal)
    after, of_nominal, of_found = balls(data, found)[0], means(data, nominal), means(data, found)
    for name, each in run.groups.items():
        inside = np.char.startswith(keys, name + "/")
        fitted = {k: np.array([found[f"balls.{k}.{a}"] for a in "xyz"]) for k in np.unique(keys[inside])}
        sockets = of_found if name == "shelf" else fitted
        left = [np.linalg.norm(x - sockets[k]) for x, k in zip(after[inside], keys[inside], strict=True)]
        expected = [np.linalg.norm(x - of_nominal[k]) for x, k in zip(before[inside], keys[inside], strict=True)]
        assert each["records"] == inside.sum()
        assert each["trained"] == (0 if name == "shelf" else inside.sum())
        assert each["error_mm"] == pytest.approx(MM * np.mean(left), rel=1e-6)
        assert each["nominal_error_mm"] == pytest.approx(MM * np.mean(expected), rel=1e-6)


def test_known_distances_are_judged_by_what_the_postures_say(run, data):
    """Not by what the fit made of the sockets, which a known distance pulls to itself."""
    found, nominal = co.by_name(run.estimate.parameters, run.estimate.values), co.named(LEFT, "left")
    for name, each in run.groups.items():
        if name == "shelf":
            assert each["distance_error_mm"] is None
            continue
        for told, values in ((each["nominal_distance_error_mm"], nominal), (each["distance_error_mm"], found)):
            of = means(data, values)
            apart = np.linalg.norm(of[f"{name}/hole_1"] - of[f"{name}/hole_0"])
            assert told == pytest.approx(MM * abs(apart - DISTANCE), rel=1e-5, abs=1e-7)


@pytest.mark.slow
def test_folds_that_leave_a_socket_out_still_judge_it(data, tmp_path):
    """Two postures a socket and many folds: now and then a fold trains on one, or on none."""
    few = data.subset([i for i in range(len(data)) if i % 7 < 2])
    validation = {"folds": 5}
    instrument = {"distances": []}
    result = calibrate(Experiment.load(written(tmp_path, few, instrument, validation=validation)))
    assert result.fit.crossed.failed_folds == 0
    assert np.isfinite(result.errors.cross_validated_mm).all()


# ---------------------------------------------------------------- bad input


def refused(path, *words):
    """Exit 2, no traceback, and the words."""
    result = CliRunner().invoke(cli, ["check", str(path)])
    assert result.exit_code == 2, result.output
    assert "Traceback" not in result.output
    text = " ".join(result.output.split())
    for word in words:
        assert word in text, (word, text)


def with_label(data, label, row=3):
    texts = list(data.extra["socket"])
    texts[row] = label
    return replace(data, extra={**data.extra, "socket": tuple(texts)})


@pytest.mark.parametrize("label", ["ho*le", "hole[0]", "a/b", "'x'"])
def test_a_label_that_is_no_name_is_refused_with_its_line(data, tmp_path, label):
    refused(written(tmp_path, with_label(data, label)), "touches.csv", "5", "letters")


def test_a_blank_label_is_refused_with_its_line(data, tmp_path):
    refused(written(tmp_path, with_label(data, "")), "touches.csv", "5", "socket")


def test_a_missing_label_column_is_refused(data, tmp_path):
    lacking = replace(data, extra={"position": data.extra["position"]})
    refused(written(tmp_path, lacking), "socket", "column")


@pytest.mark.parametrize(
    ("instrument", "words"),
    [
        ({"sockets_of": "nosuch"}, ("nosuch", "balls")),
        ({"arm": "middle"}, ("middle", "left", "run.yaml")),
        ({"noise_mm": 0}, ("noise", "greater than 0", "run.yaml")),
        ({"distances": [{"between": ["a", "a"], "distance_mm": 50, "noise_mm": 1}]}, ("twice", "two sockets")),
        ({"group_labels": ["position", "hole"]}, ("hole",)),
    ],
    ids=["sockets of nobody", "unknown arm", "zero noise", "equal sockets", "another label"],
)
def test_settings_that_do_not_fit_are_refused(data, tmp_path, instrument, words):
    refused(written(tmp_path, data, instrument), *words)


def test_a_position_to_train_on_that_is_not_there_is_refused(data, tmp_path):
    refused(written(tmp_path, data, validation={"train_groups": ["attic"]}), "attic", "shelf")


@pytest.mark.slow
def test_an_arm_that_does_not_know_its_size_is_refused(tmp_path):
    free = ["left.mdh.a?", "left.mdh.d?", "left.mdh.tool_z", "balls.centre_?"]
    instrument = {"distances": [], "centre_mm": [0, 0, 0]}
    refused(
        written(tmp_path, recorded(1, 12), instrument, parameters={"free": free}), "scale is not observable", "length"
    )


def test_spaces_about_a_label_mean_nothing(data, tmp_path):
    spaced = replace(
        data, extra={k: tuple(f"{x} " if i % 2 else x for i, x in enumerate(v)) for k, v in data.extra.items()}
    )
    validation = {"train_groups": ["front", "back"]}
    result = calibrate(Experiment.load(written(tmp_path, spaced, validation=validation)))
    assert list(result.groups) == ["back", "front", "shelf"]
    assert ball(("left",)).group_labels == ("position", "socket")
