"""Beyond buckling: an arm is never said to stand where its springs do not hold it."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from armcal.arm.evaluator import MOST_DEFLECTION, lowest, settle
from armcal.calibration.calibration import Calibration
from armcal.cli.main import cli
from armcal.errors import NotConvergedError
from click.testing import CliRunner
from made_calibrations import exact_calibration, written
from scipy.optimize import brentq

LENGTH, MASS, GRAVITY = 0.5, 1.0, 9.81
ARM = """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{a_mm: 500}]}
    effects: {spring: {type: torsional_spring}}
    links: {hand: {mass_g: 1000, com_mm: [0, 0, 0], frame: tool}}
statics: {gravity_m_s2: [-9.81, 0, 0], body: earth, payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.5}}
estimator: {type: ipopt}
"""
"""One link; at zero it stands upright."""


def link(folder: Path, load: float) -> Calibration:
    """The link with a spring of k m g l = ``load``."""
    path = folder / "arm.yaml"
    path.write_text(ARM, encoding="utf-8")
    return exact_calibration(path, {"arm.spring.k1": load / (MASS * GRAVITY * LENGTH)})


def stable_branch(load: float, angle: float) -> float:
    """Where the link comes to rest when it is let go at ``angle`` (0 to pi): the first angle that balances it."""

    def missing(x: float) -> float:
        return x - angle - load * np.sin(x)

    seen = np.linspace(angle, angle + load, 2001)[1:]
    after = int(np.argmax([missing(x) >= 0 for x in seen]))
    return float(brentq(missing, seen[after] - load / 2000, seen[after], xtol=1e-14))


def predicted(folder: Path, load: float, angle: float):
    """``armcal predict`` at one angle: its result, and the angle at which the link stands if it says so."""
    calibration, poses = written(link(folder, load), folder / "calibration.yaml"), folder / "poses.csv"
    poses.write_text(f"q1_rad\n{angle}\n", encoding="utf-8")
    out = folder / "tips.csv"
    result = CliRunner().invoke(cli, ["predict", str(calibration), "--poses", str(poses), "--out", str(out)])
    if result.exit_code:
        return result, None
    head, row = (line.split(",") for line in out.read_text().splitlines())
    x, y = (
        float(row[head.index(f"tracker.{axis}_mm" if f"tracker.{axis}_mm" in head else f"{axis}_mm")]) for axis in "xy"
    )
    return result, float(np.arctan2(y, x))


def test_an_arm_is_not_predicted_to_stand_against_gravity(tmp_path: Path) -> None:
    """k m g l = 2, 0.2 rad off upright: it falls to 2.01 rad; the balance at -0.2 rad is one that nothing holds."""
    result, stands = predicted(tmp_path, 2.0, 0.2)
    assert stands is None and result.exit_code == 3
    assert "q1 11.5 deg" in result.output and "joint q1 of arm would give by more than 1 rad" in " ".join(
        result.output.split()
    )


@pytest.mark.parametrize("load", [0.5, 0.9, 1.1, 1.4])
@pytest.mark.quick("0.9")
def test_near_buckling_an_arm_stands_where_it_falls_to_or_is_refused(tmp_path: Path, load: float) -> None:
    found, said = link(tmp_path, load), 0
    compensator = found.compensator(choice="interpreted")
    for angle in np.linspace(0.02, 3.0, 25):
        truth = stable_branch(load, angle)
        try:
            tips = [found.forward(np.array([[angle]])), compensator.forward(np.array([[angle]]))]
        except NotConvergedError:
            assert truth - angle > 0.9 * MOST_DEFLECTION
            continue
        said += 1
        for tip in tips:
            expected = LENGTH * np.array([np.cos(truth), np.sin(truth)])
            np.testing.assert_allclose(tip[0, :2, 3], expected, rtol=0, atol=1e-9)
    assert said > 10


def test_a_load_balanced_upright_is_refused_once_its_spring_is_too_soft(tmp_path: Path) -> None:
    """No torque at all: repeated passes rest there at once."""
    result, stands = predicted(tmp_path, 0.9, 0.0)
    assert result.exit_code == 0 and stands == pytest.approx(0, abs=1e-12)
    result, stands = predicted(tmp_path, 1.1, 0.0)
    text = " ".join(result.output.split())
    assert stands is None and result.exit_code == 3
    assert "is not stable: the load on joint q1 of arm grows faster than its spring answers" in text
    assert "Bound the compliance of joint q1" in text
    soft = link(tmp_path, 1.1).compensator(choice="interpreted")
    with pytest.raises(NotConvergedError, match="command 1 is not stable"):
        soft.forward(np.zeros((1, 1)))


def test_a_soft_arm_that_hangs_is_held(tmp_path: Path) -> None:
    """k m g l = 3 hanging: passes lead away from the equilibrium, which is stable all the same."""
    found = link(tmp_path, 3.0)
    tip = found.forward(np.array([[np.pi - 0.3]]))[0, :2, 3]
    stands = np.arctan2(tip[1], tip[0])
    assert stands == pytest.approx(stable_branch(3.0, np.pi - 0.3), abs=1e-9)
    assert abs(3.0 * np.cos(stands)) > 1


def test_a_fit_does_not_end_where_springs_do_not_hold_the_arm(tmp_path: Path) -> None:
    """Measurements of an arm that something else held upright, with the compliance known from other poses."""
    (tmp_path / "arm.yaml").write_text(
        ARM + "data: {type: csv, path: poses.csv}\nparameters: {free: [arm.spring.k1]}\nvalidation: {folds: 0}\n",
        encoding="utf-8",
    )
    rows = ["q1_rad,x_mm,y_mm,z_mm"]
    for angle in [0.0, *np.linspace(1.2, 1.7, 12)]:
        stands = stable_branch(1.05, angle) if angle else 0.0
        rows.append(f"{angle},{500 * np.cos(stands)},{500 * np.sin(stands)},0")
    (tmp_path / "poses.csv").write_text("\n".join(rows) + "\n", encoding="utf-8")
    flags = ["--out", str(tmp_path / "run"), "--set", "evaluator=interpreted"]
    result = CliRunner().invoke(cli, ["run", str(tmp_path / "arm.yaml"), *flags])
    assert result.exit_code == 3, result.output
    assert "a record (q1 0.0 deg) is not stable" in " ".join(result.output.split())
    assert not (tmp_path / "run" / "calibration.yaml").exists()


def test_the_search_ends_only_where_the_potential_has_a_minimum() -> None:
    """Random gravity on random springs: U = |d|^2 / 2 - w cos(A d + b), from no deflection."""
    random, held = np.random.default_rng(1), 0
    for _ in range(60):
        mixing, offset, weight = random.normal(size=(3, 3)), random.uniform(-3, 3, 3), random.uniform(0, 1.2, 3)

        state = np.zeros((3, 1))

        def evaluate(places, state=state, mixing=mixing, offset=offset, weight=weight):
            angles = mixing @ state[:, places] + offset[:, None]
            slopes = -np.einsum("ji,jn,jk->nik", mixing, weight[:, None] * np.cos(angles), mixing)
            return -mixing.T @ (weight[:, None] * np.sin(angles)), slopes

        if settle(evaluate, state)[0]:
            held += 1
            following, slopes = evaluate(np.arange(1))
            assert np.abs(following - state).max() < 1e-9
            assert np.linalg.eigvalsh(np.eye(3) - slopes[0]).min() > 0
            assert lowest(slopes)[0] > 0
    assert held > 20
