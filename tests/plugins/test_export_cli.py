"""armcal export with formats of several files and of their own settings: all or nothing, and told in words."""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
from pathlib import Path

import pytest
from armcal.cli.main import cli
from click.testing import CliRunner

from tests.made_calibrations import made_calibration, written

CONFIGS = Path(__file__).parents[2] / "configs"


def armcal(*arguments):
    return CliRunner().invoke(cli, [str(argument) for argument in arguments])


@pytest.fixture(scope="module")
def calibration(tmp_path_factory):
    return written(
        made_calibration(CONFIGS / "lrm_arm" / "arm.yaml"), tmp_path_factory.mktemp("c") / "calibration.yaml"
    )


@pytest.fixture(autouse=True)
def no_compiler(monkeypatch):
    monkeypatch.setattr("armcal_export.c_code.find_compiler", lambda: None)


@pytest.mark.slow
def test_every_file_is_written_and_told(calibration, tmp_path):
    ran = armcal(
        "export", calibration, "--format", "c", "--out", tmp_path / "lrm.c", "--option", "prefix=lrm", "--json"
    )
    assert ran.exit_code == 0, ran.output
    told = json.loads(ran.stdout)
    names = ["lrm.c", "lrm.h", "lrm_test.c"]
    assert [Path(each).name for each in told["files"]] == names
    assert sorted(path.name for path in tmp_path.iterdir()) == names
    assert (told["left_out"], told["changed"] > 50) == ([], True)
    assert "not compiled" in told["remarks"][0] and "warning: not compiled" in ran.stderr
    assert b"lrm_forward" in (tmp_path / "lrm.h").read_bytes()


@pytest.mark.slow
def test_nothing_is_written_over_without_force_and_nothing_half(calibration, tmp_path):
    (tmp_path / "arm.h").write_text("mine")
    arguments = ("export", calibration, "--format", "c", "--out", tmp_path / "arm.c")
    ran = armcal(*arguments)
    assert (ran.exit_code, "arm.h: it is there already" in ran.stderr) == (2, True)
    assert [path.name for path in tmp_path.iterdir()] == ["arm.h"]
    assert (tmp_path / "arm.h").read_text() == "mine"
    ran = armcal(*arguments, "--force")
    assert ran.exit_code == 0, ran.output
    assert b"arm_forward" in (tmp_path / "arm.h").read_bytes()
    assert len(list(tmp_path.iterdir())) == 3
    assert armcal(*arguments, "--force").exit_code == 0  # all as it is


@pytest.mark.slow
def test_a_companion_never_takes_the_place_of_the_calibration(calibration, tmp_path):
    here = tmp_path / "arm.schema.json"
    here.write_bytes(calibration.read_bytes())
    ran = armcal("export", here, "--format", "json", "--out", tmp_path / "arm.json", "--force")
    assert (ran.exit_code, "it is one of the inputs" in ran.stderr) == (2, True)
    assert here.read_bytes() == calibration.read_bytes()
    (tmp_path / "sub" / "arm.schema.json").mkdir(parents=True)
    ran = armcal("export", calibration, "--format", "json", "--out", tmp_path / "sub" / "arm.json", "--force")
    assert (ran.exit_code, "it is a directory" in ran.stderr) == (2, True)


@pytest.mark.slow
def test_a_schema_that_several_exports_share_may_be_there(calibration, tmp_path):
    for kind in ("yaml", "json"):
        ran = armcal("export", calibration, "--format", kind, "--out", tmp_path / f"arm.{kind}")
        assert ran.exit_code == 0, ran.output
    assert len(list(tmp_path.iterdir())) == 3


@pytest.mark.slow
def test_without_room_for_a_file_the_others_are_as_they_were(calibration, tmp_path):
    for name in ("arm.c", "arm.h", "arm_test.c"):
        (tmp_path / name).write_text(f"old {name}")
    words = ["export", calibration, "--format", "c", "--out", tmp_path / "arm.c", "--force"]
    ran = subprocess.run(
        [sys.executable, "-m", "armcal.cli", *map(str, words)],
        capture_output=True,
        text=True,
        check=False,
        preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096)),
    )
    assert (ran.returncode, "File too large" in ran.stderr) == (2, True), ran.stderr
    assert sorted(p.name for p in tmp_path.iterdir()) == ["arm.c", "arm.h", "arm_test.c"]
    assert all(path.read_text() == f"old {path.name}" for path in tmp_path.iterdir())


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="rights are those of POSIX")
def test_files_get_the_rights_of_new_files(calibration, tmp_path):
    before = os.umask(0o027)
    try:
        assert armcal("export", calibration, "--format", "c", "--out", tmp_path / "arm.c").exit_code == 0
    finally:
        os.umask(before)
    assert {path.stat().st_mode & 0o777 for path in tmp_path.iterdir()} == {0o640}


@pytest.mark.parametrize(
    ("arguments", "match"),
    [
        (("--format", "cc", "--out", "x.c"), "The formats are c, camera_info, hand_eye, json, mujoco, opencv, ros2"),
        (("--format", "c", "--out", "."), "it is a directory"),
        (("--format", "c", "--out", "a" * 300 + ".c"), "cannot be written"),
        (("--format", "c", "--out", "no/x.c"), "cannot be written"),
        (("--format", "c", "--out", "x.txt"), "expected that of a C file"),
        (("--format", "c", "--out", "x.c", "--option", "prefix=9"), "expected text"),
        (("--format", "c", "--out", "x.c", "--option", "prefix=A"), "no prefix"),
        (("--format", "c", "--out", "x.c", "--option", "prefx=a"), "did you mean prefix"),
        (("--format", "c", "--out", "x.c", "--option", "prefix"), "The keys are prefix, conditions"),
        (("--format", "c", "--out", "x.c", "--option", "=a"), "expected a key"),
        (("--format", "c", "--out", "x.c", "--option", "prefix=[a"), "command line (--option prefix)"),
        (("--format", "c", "--out", "x.c", "--option", "conditions=[heat]"), "nothing of the arm depends on 'heat'"),
        (("--format", "mujoco", "--out", "x.xml", "--option", "gain=-1"), "gain"),
        (("--format", "mujoco", "--out", "x.xml", "--option", "gain=.nan"), "gain"),
        (("--format", "urdf", "--out", "x.urdf", "--option", "a=1"), "unknown key"),
        (("--format", "c", "--out", "x.c", "--arm", "left"), "no arm"),
    ],
)
def test_bad_input_ends_with_2_and_leaves_nothing(calibration, tmp_path, monkeypatch, arguments, match):
    monkeypatch.chdir(tmp_path)
    ran = armcal("export", calibration, *arguments)
    assert ran.exit_code == 2, ran.output
    assert match in ran.stderr
    assert "Traceback" not in ran.output
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("content", [b"", b"\xff\xfe\x00", b"a: 1\n", b"[1, 2]"])
def test_what_is_no_calibration_is_refused(tmp_path, content):
    (tmp_path / "calibration.yaml").write_bytes(content)
    ran = armcal("export", tmp_path / "calibration.yaml", "--format", "yaml", "--out", tmp_path / "x.yaml")
    assert ran.exit_code == 2, ran.output
    assert not (tmp_path / "x.yaml").exists()


def test_mujoco_that_is_not_installed_is_told(calibration, tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "mujoco", None)
    ran = armcal("export", calibration, "--format", "mujoco", "--out", tmp_path / "x.xml")
    assert (ran.exit_code, "pip install 'armcal[mujoco]'" in ran.stderr) == (2, True)
