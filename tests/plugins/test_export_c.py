"""Exported C code: does it say where the calibrated arm is, how it moves, and what to command?"""

from __future__ import annotations

import errno
import os
import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import casadi as ca
import numpy as np
import pytest
from armcal.base.dataset import Dataset
from armcal.calibration.exporter import Origin, random_commands, request_of
from armcal.errors import ConfigError, InputError, ProblemError
from armcal.functions.compiler import find_compiler
from armcal_export import c_code
from armcal_export.c_code import CExporter, CExportSettings
from scipy.spatial.transform import Rotation

from tests.compiled_arm import DONE, NOT_REACHED, NOT_SETTLED, POSITION, CompiledArm, write
from tests.made_calibrations import following_arm, made_calibration

CONFIGS = Path(__file__).parents[2] / "configs"
LRM = CONFIGS / "lrm_arm"
TABLE = "{angles_deg: [-100, 10, 100], pulses_us: [2460, 1540, 620]}"
TABLES = f"arms.arm.effects.board={{type: quantisation, tables: {{q2: {TABLE}}}}}"
CASES = {
    "elastic": (LRM / "arm.yaml", ()),
    "all effects, 21 states": (LRM / "best.yaml", ()),
    "rigid, limits": (CONFIGS / "mukca" / "panda.yaml", ()),
    "counts and heat": (
        LRM / "arm.yaml",
        ("arms.arm.effects.heat={type: thermal_length}", TABLES, "arms.arm.effects.map={type: servo_map, gains: one}"),
    ),
}

pytestmark = pytest.mark.skipif(find_compiler() is None, reason="no C compiler")


@pytest.fixture(scope="module")
def arms(tmp_path_factory):
    """Each calibration and its compiled code, made when first asked for."""
    made = {}

    def give(name):
        if name not in made:
            config, overrides = CASES.get(name, (None, ()))
            folder = tmp_path_factory.mktemp("code")
            if config is None:
                config = following_arm(folder)
            calibration = made_calibration(config, overrides)
            heat = {"conditions": ("temperature",)} if "heat" in name else {}
            made[name] = calibration, CompiledArm(request_of(calibration, None, "arm_left.c"), folder, **heat)
        return made[name]

    return give


def records_of(compiled, count, seed=3):
    """Random commands, approaches, gravity, payload, force and temperature."""
    random = np.random.default_rng(seed)
    e, n = compiled.expression, compiled.n
    records = np.tile(e.defaults, (count, 1))
    records[:, :n] = random_commands(e.arm, count, seed).T
    records[:, n : 2 * n] = random.integers(-1, 2, (count, n))
    records[:, 2 * n : 2 * n + 3] += random.normal(0, 1.0, (count, 3))
    records[:, 2 * n + 3] += random.uniform(0, 0.1, count)
    records[:, 2 * n + 4 : 2 * n + 7] += random.normal(0, 0.02, (count, 3))
    records[:, 2 * n + 7 : 2 * n + 10] += random.normal(0, 0.3, (count, 3))
    records[:, 2 * n + 10 : 2 * n + 13] += random.normal(0, 0.02, (count, 3))
    records[:, 2 * n + 13 :] = random.uniform(0, 40, (count, records.shape[1] - 2 * n - 13))
    return records


def predicted(calibration, compiled, records):
    """base_T_tool (N x 3 x 4) by the calibration itself, from records by channel."""
    n = compiled.n
    channels = {}
    for i, channel in enumerate(compiled.expression.channels):
        channels[f"arm.{channel}" if i < 2 * n else channel] = np.ascontiguousarray(records[:, i])
    name = compiled.expression.name
    channels = {key.replace("arm.", f"{name}.", 1): values for key, values in channels.items()}
    dataset = Dataset(tuple(map(str, range(len(records)))), channels)
    return calibration.predict(dataset)[1][0][:, :3]


@pytest.mark.parametrize("name", [*CASES, "mimic and slide"])
@pytest.mark.quick("rigid, limits")
def test_the_code_says_where_the_calibrated_arm_is(arms, name):
    calibration, compiled = arms(name)
    records = records_of(compiled, 60)
    if "counts" in name:  # only what counts can set
        for record in records:
            record[1] = compiled.library.lrm_set_angle(1, compiled.library.lrm_counts(1, record[1] / 2))
    expected = predicted(calibration, compiled, records)
    state = None
    for record, pose in zip(records, expected, strict=True):
        status, found, _ = compiled.forward(record)
        assert status == DONE
        np.testing.assert_allclose(found, pose, rtol=0, atol=1e-12)
        status, found, state = compiled.forward(record, state)  # from where the pose before came to rest
        assert status == DONE
        np.testing.assert_allclose(found, pose, rtol=0, atol=1e-12)


@pytest.mark.parametrize("name", [*CASES, "mimic and slide"])
@pytest.mark.slow
def test_defaults_are_the_configured_load(arms, name):
    calibration, compiled = arms(name)
    record, commands = compiled.defaults(), random_commands(compiled.expression.arm, 20, 5).T
    if "heat" in name:
        record[-1] = 20.0
        commands[:, 1] = compiled.library.lrm_set_angle(1, compiled.library.lrm_counts(1, 0.5))
    for command, pose in zip(commands, calibration.forward(commands), strict=True):
        record[: compiled.n] = command
        np.testing.assert_allclose(compiled.forward(record)[1], pose[:3], rtol=0, atol=1e-12)


@pytest.mark.quick("mimic and slide")
@pytest.mark.parametrize("name", [*CASES, "mimic and slide"])
def test_the_jacobian_is_the_slope_of_the_arm_in_equilibrium(arms, name):
    _, compiled = arms(name)
    for record in records_of(compiled, 20, 7):
        status, pose, jacobian = compiled.jacobian(record)
        assert status == DONE
        np.testing.assert_array_equal(pose, compiled.forward(record)[1])
        for joint in range(compiled.n):
            h, ends = 1e-5, []
            for side in (-h, h):
                moved = record.copy()
                moved[joint] += side
                ends.append(compiled.forward(moved)[1])
            linear = (ends[1][:, 3] - ends[0][:, 3]) / (2 * h)
            angular = Rotation.from_matrix(ends[1][:, :3] @ ends[0][:, :3].T).as_rotvec() / (2 * h)
            np.testing.assert_allclose(jacobian[:, joint], np.concatenate([linear, angular]), rtol=0, atol=3e-7)


def test_efforts_are_what_force_and_torque_do_along_the_joints(arms):
    """Virtual work: an effort times a small motion of its joint is the wrench times the tool's motion."""
    _, compiled = arms("rigid, limits")
    n = compiled.n
    for record in records_of(compiled, 10, 11):
        record[2 * n : 2 * n + 3] = 0.0
        status, efforts = compiled.efforts(record)
        assert status == DONE
        wrench = record[2 * n + 7 : 2 * n + 13]
        np.testing.assert_allclose(efforts, compiled.jacobian(record)[2].T @ wrench, rtol=0, atol=1e-10)


@pytest.mark.slow
def test_efforts_bend_the_springs_as_far_as_these_give(arms):
    calibration, compiled = arms("elastic")
    compliances = [calibration.parameters[f"arm.spring.k{joint}"].nominal[0] for joint in range(1, 7)]
    for record in records_of(compiled, 10, 11):
        status, efforts = compiled.efforts(record)
        state = compiled.forward(record)[2]
        assert status == DONE
        np.testing.assert_allclose(state[1:], compliances * efforts, rtol=0, atol=1e-11)


@pytest.mark.quick("rigid, limits")
@pytest.mark.parametrize("name", ["elastic", "all effects, 21 states", "rigid, limits"])
def test_compensated_commands_bring_the_tool_to_its_target(arms, name):
    calibration, compiled = arms(name)
    random, records = np.random.default_rng(5), records_of(compiled, 40, 13)
    targets = [compiled.forward(record)[1] for record in records]
    answers, told = [], records.copy()
    for record, target in zip(told, targets, strict=True):
        record[: compiled.n] += random.uniform(-0.05, 0.05, compiled.n)
        status, commands, outcome = compiled.compensate(record, target)
        assert np.all(commands >= compiled.lower) and np.all(commands <= compiled.upper)
        record[: compiled.n] = commands
        answers.append((status, outcome))
    reached = 0
    poses = predicted(calibration, compiled, told)
    for pose, target, (status, outcome) in zip(poses, targets, answers, strict=True):
        assert outcome.distance_m == pytest.approx(np.linalg.norm(pose[:, 3] - target[:, 3]), abs=1e-12)
        turn = Rotation.from_matrix(pose[:, :3] @ target[:, :3].T).magnitude()
        assert outcome.turn_rad == pytest.approx(turn, abs=1e-8)
        assert (status == DONE) == (outcome.distance_m <= 1e-9 and outcome.turn_rad <= 1e-9)
        reached += status == DONE
    assert reached >= 39


def test_positions_alone_are_reached_by_any_posture(arms):
    _, compiled = arms("rigid, limits")
    for record in records_of(compiled, 20, 17):
        target = compiled.forward(record)[1]
        start = record.copy()
        start[: compiled.n] = np.clip(start[: compiled.n] + 0.1, compiled.lower, compiled.upper)
        target[:, :3] = np.eye(3)  # of no meaning
        status, _, outcome = compiled.compensate(start, target, POSITION)
        assert (status, outcome.turn_rad) == (DONE, 0.0)


def test_what_is_out_of_reach_leaves_the_nearest_commands_within_the_limits(arms):
    _, compiled = arms("rigid, limits")
    record = compiled.defaults()
    record[: compiled.n] = 0.5 * (compiled.lower + compiled.upper)
    target = compiled.forward(record)[1]
    far = target.copy()
    far[:, 3] = [3.0, 0.0, 0.3]
    status, commands, outcome = compiled.compensate(record, far, POSITION, steps=200)
    assert status == NOT_REACHED
    assert np.all(commands >= compiled.lower) and np.all(commands <= compiled.upper)
    record[: compiled.n] = commands
    assert outcome.distance_m == pytest.approx(np.linalg.norm(compiled.forward(record)[1][:, 3] - far[:, 3]), abs=1e-12)
    straight = compiled.jacobian(record)[2][:3]
    pull = straight.T @ (far[:, 3] - compiled.forward(record)[1][:, 3])
    free = (commands > compiled.lower + 1e-9) & (commands < compiled.upper - 1e-9)
    assert np.abs(pull[free]).max() < 1e-3 * np.linalg.norm(far[:, 3])  # no free joint brings it nearer
    status, _, outcome = compiled.compensate(record, target, steps=0)
    assert (status, outcome.steps) == (NOT_REACHED, 0)


@pytest.mark.slow
def test_one_step_is_newtons(arms):
    _, compiled = arms("elastic")
    record = records_of(compiled, 1, 19)[0]
    target = compiled.forward(record)[1]
    start = record.copy()
    start[: compiled.n] += 1e-4
    status, commands, outcome = compiled.step(start, target, 0.0)
    assert status == DONE
    _, pose, jacobian = compiled.jacobian(start)
    turn = Rotation.from_matrix(target[:, :3] @ pose[:, :3].T).as_rotvec()
    wanted = np.linalg.solve(jacobian, np.concatenate([target[:, 3] - pose[:, 3], turn]))
    np.testing.assert_allclose(commands, start[: compiled.n] + wanted, rtol=0, atol=1e-9)
    assert outcome.distance_m == pytest.approx(np.linalg.norm(pose[:, 3] - target[:, 3]), abs=1e-12)


def test_half_a_turn_is_told_and_mended(arms):
    _, compiled = arms("elastic")
    record = compiled.defaults()
    record[: compiled.n] = [0.2, 0.4, -0.3, 0.5, 0.7, 0.1]
    pose = compiled.forward(record)[1]
    for axis in np.eye(3):
        for angle in (np.pi, np.pi - 1e-9, 3.0, 1e-9):
            turned = pose.copy()
            turned[:, :3] = Rotation.from_rotvec(angle * axis).as_matrix() @ pose[:, :3]
            _, _, outcome = compiled.compensate(record, turned, steps=0)
            assert outcome.turn_rad == pytest.approx(angle, abs=2e-8)


@pytest.mark.parametrize("bad", [np.nan, np.inf])
@pytest.mark.parametrize("place", [0, 14, 15])
def test_what_is_no_number_or_never_settles_is_told(arms, bad, place):
    _, compiled = arms("elastic")
    record = compiled.defaults()
    record[place] = bad
    target = compiled.forward(compiled.defaults())[1]
    assert compiled.forward(record)[0] == NOT_SETTLED
    assert compiled.jacobian(record)[0] == NOT_SETTLED
    assert compiled.efforts(record)[0] == NOT_SETTLED
    assert compiled.compensate(record, target)[0] == NOT_SETTLED
    assert compiled.forward(compiled.defaults(), state=np.full(7, bad))[0] == DONE


def test_no_command_comes_of_what_is_no_number(arms):
    """Where there are limits too: fmin and fmax would make a limit of it."""
    _, compiled = arms("rigid, limits")
    record = compiled.defaults()
    record[: compiled.n] = 0.5 * (compiled.lower + compiled.upper)
    target = compiled.forward(record)[1]
    broken = record.copy()
    broken[2] = np.nan
    status, commands, _ = compiled.compensate(broken, target)
    assert status == NOT_SETTLED
    np.testing.assert_array_equal(commands, broken[: compiled.n])
    target[1, 3] = np.nan
    for status, commands, _ in (compiled.compensate(record, target), compiled.step(record, target, 0.0)):
        assert status == NOT_REACHED
        np.testing.assert_array_equal(commands, record[: compiled.n])


def test_arms_that_passes_lead_astray_settle_by_newton(arms):
    """Under 24 times gravity repeated passes move away from the equilibrium, which is there all the same."""
    _, compiled = arms("elastic")
    e, astray = compiled.expression, 0
    function = ca.Function("once", [e.record, e.state], [e.next_state, e.slope()])
    for command in np.random.default_rng(0).uniform(-1.5, 1.5, (40, compiled.n)):
        record = compiled.defaults()
        record[: compiled.n] = command
        record[14] *= 24
        status, _, state = compiled.forward(record)
        if status == DONE:
            following, slope = (each.full() for each in function(record, state))
            np.testing.assert_allclose(following.ravel(), state, rtol=0, atol=1e-10)
            assert np.linalg.eigvals(slope).real.max() < 1, "springs do not hold the arm there"
            astray += np.abs(np.linalg.eigvals(slope)).max() > 1.0
    assert astray > 5


@pytest.mark.slow
def test_slopes_column_by_column_are_the_same(arms, monkeypatch, tmp_path):
    calibration, compiled = arms("elastic")
    monkeypatch.setattr(c_code, "MOST_WHOLE", 0)
    other = CompiledArm(request_of(calibration, None, "other.c"), tmp_path)
    assert b"Column by column" in other.exported.content
    assert b"Column by column" not in compiled.exported.content
    for record in records_of(compiled, 10, 23):
        np.testing.assert_allclose(other.jacobian(record)[2], compiled.jacobian(record)[2], rtol=0, atol=1e-11)


@pytest.mark.slow
def test_counts_are_those_of_the_board(arms):
    _, compiled = arms("counts and heat")
    table, clock = compiled.expression.servos["q2"]
    for angle in np.random.default_rng(1).uniform(-1.7, 1.7, 200):
        counts = compiled.library.lrm_counts(1, angle)
        assert counts == round(np.interp(angle, table.angles, table.pulses) / clock.tick)
        order = np.argsort(table.pulses)
        back = np.interp(counts * clock.tick, np.array(table.pulses)[order], np.array(table.angles)[order])
        assert compiled.library.lrm_set_angle(1, counts) == pytest.approx(back, abs=1e-12)
    assert compiled.library.lrm_counts(0, 0.1) == -1
    assert compiled.library.lrm_counts(1, 1e9) == -1
    assert compiled.library.lrm_counts(1, np.nan) == -1
    assert np.isnan(compiled.library.lrm_set_angle(0, 100))


@pytest.mark.slow
def test_the_code_keeps_no_state_and_its_header_serves_cpp(arms, tmp_path):
    _, compiled = arms("elastic")
    write(compiled.exported, "arm_left.c", tmp_path)
    subprocess.run([find_compiler(), "-std=c99", "-O0", "-c", "arm_left.c"], cwd=tmp_path, check=True)
    if shutil.which("nm"):
        listed = subprocess.run(["nm", "arm_left.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
        assert not [line for line in listed.splitlines() if line.split()[-2] in "BbCS"]
        unknown = {line.split()[-1] for line in listed.splitlines() if line.split()[-2] == "U"}
        assert not unknown & {"malloc", "calloc", "realloc", "free", "printf"}
    if shutil.which("g++"):
        (tmp_path / "x.cpp").write_text('#include "arm_left.h"\nint main() { return lrm_defaults.payload > 1; }\n')
        subprocess.run(["g++", "-Wall", "-Werror", "-fsyntax-only", "x.cpp"], cwd=tmp_path, check=True)


@pytest.mark.slow
def test_the_test_program_passes_and_notices_another_arm(arms, tmp_path):
    _, compiled = arms("elastic")
    write(compiled.exported, "arm_left.c", tmp_path)

    def run():
        command = [find_compiler(), "-std=c99", "-O0", "arm_left.c", "arm_left_test.c", "-lm", "-o", "t"]
        subprocess.run(command, cwd=tmp_path, check=True)
        return subprocess.run(["./t"], cwd=tmp_path, capture_output=True, text=True, check=False)

    good = run()
    assert good.returncode == 0, good.stdout
    assert "found for 24 of 24" in good.stdout
    text = (tmp_path / "arm_left.c").read_text()
    (tmp_path / "arm_left.c").write_text(text.replace("cos(", "1e-9 + cos(", 1))
    bad = run()
    assert bad.returncode == 1
    assert "poses: " in bad.stdout


@pytest.mark.slow
def test_what_differs_or_warns_is_not_handed_out(monkeypatch):
    request = request_of(made_calibration(CONFIGS / "mukca" / "panda.yaml"), None, "arm.c")
    whole = c_code.filled

    def spoilt(old, new):
        def give(template, prefix, **places):
            return whole(template, prefix, **places).replace(old, new)

        return give

    monkeypatch.setattr(c_code, "filled", spoilt("  record[3] = input->payload;", "  record[3] = 0.0;"))
    with pytest.raises(ProblemError, match="differs from the calibrated arm"):
        CExporter(CExportSettings()).export(request)
    monkeypatch.setattr(c_code, "filled", spoilt("  double largest = 0.0;", "  double largest = 0.0; int unused;"))
    with pytest.raises(ProblemError, match="does not compile"):
        CExporter(CExportSettings()).export(request)


def test_without_a_compiler_the_code_is_written_and_that_is_said(monkeypatch):
    monkeypatch.setattr("armcal_export.c_code.find_compiler", lambda: None)
    request = request_of(made_calibration(LRM / "arm.yaml"), None, "arm.c")
    assert "not compiled" in CExporter(CExportSettings()).export(request).remarks[0]


def test_without_room_to_compile_the_temporary_folder_is_named(monkeypatch):
    def full(*given, **more):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr("armcal_export.c_code.find_compiler", lambda: "cc")
    monkeypatch.setattr("armcal_export.c_code.tempfile.TemporaryDirectory", full)
    request = request_of(made_calibration(LRM / "arm.yaml"), None, "arm.c")
    with pytest.raises(InputError, match=r"the temporary folder: it cannot be written .*set TMPDIR"):
        CExporter(CExportSettings()).export(request)


@pytest.mark.slow
def test_names_of_any_kind_do_no_harm(tmp_path):
    request = request_of(made_calibration(CONFIGS / "mukca" / "panda.yaml"), None, "arm_arm.c")
    hostile = 'a */ b \\ "c" ??/ \n#error "é"'
    request = replace(request, origin=Origin(hostile, "*/", {"armcal": "/*"}, {"arm": hostile}))
    exported = CExporter(CExportSettings(prefix="arm_x")).export(request)
    assert set(exported.companions) == {"arm_arm.h", "arm_arm_test.c"}
    assert b'#include "arm_arm.h"' in exported.content
    assert b"int arm_x_forward(" in exported.content


def test_unfit_requests_are_refused():
    request = request_of(made_calibration(LRM / "arm.yaml"), None, "arm.c")
    for out in ("arm.cpp", "a b.c", "../arm.c", "é.c"):
        with pytest.raises(InputError, match="expected that of a C file"):
            CExporter(CExportSettings()).export(replace(request, out=out))
    with pytest.raises(ConfigError, match="depends on 'temperature'"):
        CExporter(CExportSettings(conditions=("temperature",))).export(request)
    for prefix in ("9a", "A", "a-b", "é", "a b"):
        with pytest.raises(ValueError, match="prefix"):
            CExportSettings(prefix=prefix)
