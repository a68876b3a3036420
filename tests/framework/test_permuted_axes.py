"""Data with axes or joints mixed up, or in wrong units, are refused by name; right data never are; lost fits end."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import armcal_ipopt.estimator as ipopt
import contact_oracle as co
import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.cli.main import cli
from armcal.diagnose.data import find_permuted_axes, within
from armcal.diagnose.fit import Prepared
from armcal.errors import DataError, NotConvergedError
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble, calibrate
from armcal_contact.contacts import BallInSocket
from click.testing import CliRunner
from scipy.optimize import minimize

ROOT = Path(__file__).resolve().parents[2]
DEMO = ROOT / "configs" / "lrm_arm" / "demo.yaml"


@pytest.fixture(scope="module")
def demo() -> Prepared:
    return assemble(Experiment.load(DEMO), Stopwatch())


def changed(dataset: Dataset, **columns: str) -> Dataset:
    """Columns made of others, ``tracker__x="-tracker.y"``."""
    made = dict(dataset.channels)
    for name, formula in columns.items():
        sign, channel = (-1, formula[1:]) if formula.startswith("-") else (1, formula)
        made[name.replace("__", ".")] = sign * dataset.column(channel)
    return replace(dataset, channels=made)


def told(ready: Prepared, dataset: Dataset) -> tuple[str, ...]:
    found = find_permuted_axes(ready.problem.of(dataset), dataset)
    return () if found is None else found.readings


def test_right_data_are_not_suspected(demo: Prepared) -> None:
    assert told(demo, demo.dataset) == ()


@pytest.mark.quick("q2")
@pytest.mark.parametrize("joint", ["q1", "q2", "q3", "q4", "q5", "q6"])
def test_a_joint_that_turns_the_other_way_is_named(demo: Prepared, joint: str) -> None:
    sides = {f"arm__{joint}": f"-arm.{joint}", f"arm__approach.{joint}": f"-arm.approach.{joint}"}
    # The wrist turned over by half a turn of q5 puts the target nearly where q6 turning the other way puts it.
    alike = {"q6": ("180 deg added to q5",)}.get(joint, ())
    assert told(demo, changed(demo.dataset, **sides)) == (f"the sign of {joint} reversed", *alike)


@pytest.mark.quick("columns2-the signs of x and z reversed")
@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"x": "tracker.y", "y": "tracker.x"}, "x and y exchanged"),
        ({"y": "-tracker.y"}, "the sign of y reversed"),
        ({"x": "-tracker.x", "z": "-tracker.z"}, "the signs of x and z reversed"),
        ({"x": "tracker.y", "y": "tracker.z", "z": "tracker.x"}, "(z, x, y) taken for (x, y, z)"),
        ({"x": "-tracker.y", "y": "tracker.x"}, "(y, -x, z) taken for (x, y, z)"),
    ],
)
def test_axes_are_named(demo: Prepared, columns: dict[str, str], words: str) -> None:
    """What is told undoes what was done."""
    mixed = {f"tracker__{axis}": formula for axis, formula in columns.items()}
    assert told(demo, changed(demo.dataset, **mixed)) == (words,)


def test_exchanged_joints_are_named(demo: Prepared) -> None:
    exchanged = {
        f"arm__{part}{a}": f"arm.{part}{b}" for part in ("", "approach.") for a, b in (("q2", "q5"), ("q5", "q2"))
    }
    assert told(demo, changed(demo.dataset, **exchanged)) == ("q2 and q5 exchanged",)


@pytest.mark.quick("tracker.-0.1-positions 10 times as large")
@pytest.mark.parametrize(
    ("channels", "factor", "words"),
    [
        ("tracker.", 0.1, "positions 10 times as large"),
        ("tracker.", 10, "positions 0.1 times as large"),
        ("arm.q", np.pi / 180, "joint angles 57.3 times as large"),
        ("arm.q", 180 / np.pi / 1000, "joint angles 17.45 times as large"),
        ("arm.q4", np.pi / 180, "q4 57.3 times as large"),
    ],
)
def test_units_are_named(demo: Prepared, channels: str, factor: float, words: str) -> None:
    scaled = {n: c * factor if n.startswith(channels) else c for n, c in demo.dataset.channels.items()}
    assert told(demo, replace(demo.dataset, channels=scaled)) == (words,)


SCARA = """
arms:
  arm:
    model:
      type: mdh
      convention: standard
      rows: [{a_mm: 300, d_mm: 100}, {a_mm: 200}, {kind: prismatic}]
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
data: {type: csv, path: scara.csv}
parameters: {free: ["arm.mdh.theta?", "arm.mdh.a?"]}
"""


def test_a_travel_in_another_unit_is_named(tmp_path: Path) -> None:
    """A spindle's centimetres in a column of millimetres."""
    random = np.random.default_rng(0)
    first, second, travel = random.uniform([[-1.0], [-1.5], [0.0]], [[1.0], [1.5], [0.2]], (3, 40))
    x, y = (0.3 * turn(first + 0.01) + 0.2 * turn(first + second) for turn in (np.cos, np.sin))
    positions = np.array([x, y, 0.1 + travel]) + random.normal(0, 1e-4, (3, 40))
    (tmp_path / "scara.yaml").write_text(SCARA)

    def prepared(unit_mm: float) -> Prepared:
        table = np.array([*np.degrees([first, second]), travel / unit_mm * 1e3, *(1e3 * positions)]).T
        head = "q1_deg,q2_deg,q3_mm,x_mm,y_mm,z_mm"
        np.savetxt(tmp_path / "scara.csv", table, delimiter=",", header=head, comments="")
        return assemble(Experiment.load(tmp_path / "scara.yaml"), Stopwatch())

    prepared(1.0)
    with pytest.raises(DataError, match="q3 10 times as large"):
        prepared(10.0)


FLAT = """
arms: {arm: {model: {type: mdh, convention: standard, rows: [{a_mm: 300}, {a_mm: 200}]}}}
measurements: {tracker: {type: tip_position, noise_mm: 0.1}}
data: {type: csv, path: flat.csv}
parameters: {free: ["arm.mdh.theta?", "arm.mdh.a?"]}
"""


@pytest.mark.parametrize("factor", [1.0, 3.0])
def test_a_reading_that_flattens_what_was_measured_hides_it_and_is_none(tmp_path: Path, factor: float) -> None:
    """An arm that moves in a plane, and heights that mean nothing: a thousandth of them would fit any such arm."""
    random = np.random.default_rng(0)
    first, second = random.uniform([[-1.0], [-1.5]], [[1.0], [1.5]], (2, 40))
    x, y = (0.3 * turn(first + 0.01) + 0.2 * turn(first + second) for turn in (np.cos, np.sin))
    positions = np.array([x, y, random.normal(0, 0.03 * factor, 40)]) + random.normal(0, 1e-4, (3, 40))
    np.savetxt(
        tmp_path / "flat.csv",
        np.array([*np.degrees([first, second]), *(1e3 * positions)]).T,
        delimiter=",",
        header="q1_deg,q2_deg,x_mm,y_mm,z_mm",
        comments="",
    )
    (tmp_path / "flat.yaml").write_text(FLAT)
    ready = assemble(Experiment.load(tmp_path / "flat.yaml"), Stopwatch(), accept=True)
    assert told(ready, ready.dataset) == ()


@pytest.mark.parametrize(("joint", "other", "sign"), [("q3", "q2", "+"), ("q3", "q2", "-"), ("q5", "q4", "+")])
def test_coupled_joints_are_named_with_what_to_state(demo: Prepared, joint: str, other: str, sign: str) -> None:
    read = demo.dataset.column(f"arm.{joint}") - float(f"{sign}1") * demo.dataset.column(f"arm.{other}")
    (first, *_) = told(demo, replace(demo.dataset, channels={**demo.dataset.channels, f"arm.{joint}": read}))
    stated = f"couplings: {{{joint}: {{{other}: {'-' * (sign == '-')}1}}}}"
    assert first.startswith(f"{joint} {sign} {other} taken for {joint}") and stated in first


def test_what_no_reading_explains_is_named_by_none(demo: Prepared) -> None:
    """A zero that no convention has: it was named as another one. And half of a coupling."""
    data = demo.dataset
    wrong = [
        {"arm.q2": data.column("arm.q2") + np.radians(60)},
        {"arm.q3": data.column("arm.q3") + 0.5 * data.column("arm.q2")},
    ]
    for columns in wrong:
        assert told(demo, replace(data, channels={**data.channels, **columns})) == ()


@pytest.mark.quick("q3--90")
@pytest.mark.parametrize(("joint", "turn"), [("q2", 180), ("q3", -90), ("q5", 90)])
def test_a_zero_a_quarter_or_half_a_turn_off_is_named(demo: Prepared, joint: str, turn: int) -> None:
    """Half the counts of a servo, or where another convention has the zero."""
    angles = demo.dataset.column(f"arm.{joint}") - np.radians(turn)
    moved = replace(demo.dataset, channels={**demo.dataset.channels, f"arm.{joint}": angles})
    assert told(demo, moved) == (f"{turn} deg added to {joint}",)


@pytest.mark.parametrize("turned", [None, 2, 3])
def test_a_joint_that_turns_the_other_way_is_named_from_sockets(turned: int | None) -> None:
    """By the places that single records give to a socket: the fit ended in a zero 180 deg off, or not at all."""
    random, places = np.random.default_rng(0), {"hole_0": (0.35, 0.1, 0.25), "hole_1": (0.2, -0.3, 0.35)}
    q = np.vstack([co.touching(co.ELBOW, co.in_socket(place), 12, seed) for seed, place in enumerate(places.values())])
    q += random.normal(0.01, 1e-3, q.shape)
    if turned is not None:
        q[:, turned - 1] *= -1
    data = Dataset(
        tuple(map(str, range(24))),
        co.joints(q),
        {"position": ("here",) * 24, "socket": ("hole_0",) * 12 + ("hole_1",) * 12},
    )
    ball = BallInSocket(BallInSocket.Settings.si(noise=1e-4), ("arm",))
    problem, records = co.Bench({"arm": co.the_arm(co.ELBOW)}, {"balls": ball}).problem(data)
    found = find_permuted_axes(problem.with_records(records), data)
    assert (found and found.readings) == (None if turned is None else (f"the sign of q{turned} reversed",))


@pytest.mark.parametrize("record", [41, 42])
def test_one_record_far_off_is_no_other_reading(demo: Prepared, record: int) -> None:
    x = demo.dataset.channels["tracker.x"].copy()
    x[record] = 2.0
    assert told(demo, replace(demo.dataset, channels={**demo.dataset.channels, "tracker.x": x})) == ()


def test_few_records_tell_nothing(demo: Prepared) -> None:
    mixed = changed(demo.dataset, tracker__x="tracker.y", tracker__y="tracker.x")
    assert told(demo, mixed.subset(range(10))) == ()


@pytest.mark.slow
@pytest.mark.parametrize("turning", [True, False])
def test_a_base_that_may_turn_is_no_mixup(turning: bool) -> None:
    """About x, say, as a tracker lies on its side: the fit can do that by itself, where it may."""
    free = ["arm.mdh.base_[xyz]", "arm.mdh.d[1-5]", *(["arm.mdh.base_rx"] if turning else [])]
    ready = assemble(Experiment.load(DEMO, [f"parameters.free={json.dumps(free)}"]), Stopwatch())
    found = told(ready, changed(ready.dataset, tracker__y="-tracker.z", tracker__z="tracker.y"))
    assert found == (() if turning else ("(x, z, -y) taken for (x, y, z)",))


@pytest.mark.slow
def test_measured_data_are_not_suspected_and_a_flipped_joint_is_named(shared_data: Path) -> None:
    for option in ("option1", "option3", "option5"):
        config = DEMO.with_name(f"{option}.yaml")
        ready = assemble(Experiment.load(config, data=shared_data / "lrm_arm" / "poses.csv"), Stopwatch())
        assert told(ready, ready.dataset) == ()
        assert told(ready, changed(ready.dataset, arm__q5="-arm.q5")) == ("the sign of q5 reversed",)


def test_the_refusal_names_file_and_cause(tmp_path: Path) -> None:
    header, *rows = DEMO.with_suffix(".csv").read_text().splitlines()
    path = tmp_path / "swapped.csv"
    path.write_text("\n".join([header.replace("x_mm,y_mm", "y_mm,x_mm"), *rows]))
    result = CliRunner().invoke(cli, ["run", str(DEMO), "--data", str(path), "--out", str(tmp_path / "out")])
    assert result.exit_code == 2 and "Traceback" not in result.output
    text = " ".join(result.output.split())
    assert "swapped.csv" in text and "with x and y exchanged" in text and "data.columns" in text


def test_steps_within_a_radius_are_the_best_there() -> None:
    random = np.random.default_rng(3)
    along, sizes = random.normal(size=5), random.uniform(0.1, 2.0, 5)
    for radius in (0.1, 1.0, 5.0):
        found = within(along, sizes, radius)
        inside = {"type": "ineq", "fun": lambda z, r=radius: r**2 - z @ z}
        best = minimize(lambda z: np.sum((along - sizes * z) ** 2), np.zeros(5), constraints=[inside], tol=1e-12)
        assert np.linalg.norm(found) <= radius * (1 + 1e-9)
        np.testing.assert_allclose(found, best.x, atol=2e-4)


def test_a_fit_against_a_wall_ends(demo: Prepared, monkeypatch: pytest.MonkeyPatch) -> None:
    """From its third point on no step has an equilibrium: it says so after a few line searches, not after 500."""
    start, asked, stood = demo.problem.parameters.nominal(), [], []
    cost, model = ipopt.PosedProblem.cost, ipopt.PosedProblem.model

    def walled(posed: ipopt.PosedProblem, x: np.ndarray) -> float:
        asked.append(x)
        return np.inf if len(stood) > 2 else cost(posed, x)

    def counted(posed: ipopt.PosedProblem, x: np.ndarray) -> ipopt.NormalEquations:
        stood.append(x)
        return model(posed, x)

    monkeypatch.setattr(ipopt.PosedProblem, "cost", walled)
    monkeypatch.setattr(ipopt.PosedProblem, "model", counted)
    estimator = ipopt.IpoptEstimator(ipopt.IpoptSettings())
    found = estimator.solve(demo.training, start)
    assert not found.verdict.converged and "stuck" in found.verdict.status
    assert len(asked) < 1000


@pytest.mark.slow
def test_folds_of_a_lost_fit_are_not_tried(monkeypatch: pytest.MonkeyPatch) -> None:
    experiment = Experiment.load(DEMO, ["estimator.max_iterations=2"])
    monkeypatch.setattr("armcal.run.pipeline.cross_validate", lambda *parts: pytest.fail("a fold was tried"))
    result = calibrate(experiment)
    assert not result.estimate.verdict.converged
    assert "axes, units and frame" in result.verdict.findings[0].action


@pytest.mark.slow
def test_a_lost_fit_whose_residuals_cannot_be_taken_says_what_to_look_at(monkeypatch: pytest.MonkeyPatch) -> None:
    def nowhere(*parts: object) -> None:
        raise NotConvergedError("the elastic equilibrium of a record did not settle.")

    monkeypatch.setattr("armcal.estimate.robust.estimate", nowhere)
    with pytest.raises(NotConvergedError, match=r"ipopt did not converge \(Maximum.*axes, units and frame"):
        calibrate(Experiment.load(DEMO, ["estimator.max_iterations=2"]))
    with pytest.raises(NotConvergedError, match="did not settle"):
        calibrate(Experiment.load(DEMO))


def test_a_record_without_equilibrium_leaves_the_others_as_they_were(demo: Prepared) -> None:
    """So that the next trial point starts where the last good one ended."""
    problem, nominal = demo.problem, demo.problem.parameters.nominal()
    records = problem.subset(np.arange(40)).records
    expected = problem.with_records(records).residuals(nominal)[0]
    before, soft = records[0].state.copy(), nominal.copy()
    for i in range(7):
        soft[problem.parameters.entries_of(f"arm.spring.k{i}")] = 50.0
    with pytest.raises(NotConvergedError):
        problem.with_records(records).residuals(soft)
    np.testing.assert_array_equal(records[0].state, before)
    np.testing.assert_allclose(problem.with_records(records).residuals(nominal)[0], expected, rtol=0, atol=1e-12)
