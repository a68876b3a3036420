"""Plugins that nobody packaged: one file, named on the command line, found by every process, known to calibrations."""

from __future__ import annotations

import os
import pickle
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from armcal import JointCommand, plugins, use_plugins
from armcal.cli.main import cli
from armcal.errors import PluginError
from armcal.plugins import PluginRegistry, discover
from armcal.testing.contract import check_plugin

GEAR = """
import casadi as ca
from armcal import JointEffect, hookimpl, scalar


class Gear(JointEffect):
    def parameters(self):
        return [scalar(f"sin{joint}", "rad", 0.0, 0.01) for joint in self.joints]

    def displacement(self, command, values):
        return values[f"sin{command.joint}"] * ca.sin(command.commanded) if command.joint in self.joints else 0


@hookimpl
def armcal_register_effects(register):
    register("gear", Gear, "a sine of the angle")
"""


@pytest.fixture(autouse=True)
def _forgotten(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    for variable in (plugins.CHOSEN, plugins.DISABLED):
        monkeypatch.setenv(variable, "")
    yield


def written(path: Path, text: str = GEAR) -> Path:
    path.parent.mkdir(exist_ok=True)
    path.write_text(text, encoding="utf-8")
    return path


def registry(*places: Path, **more: tuple[str, ...]) -> PluginRegistry:
    use_plugins(*places, **more)
    return discover()


def refusal(*places: Path, **more: tuple[str, ...]) -> str:
    with pytest.raises(PluginError) as refused:
        registry(*places, **more)
    assert refused.value.exit_code == 2
    return str(refused.value)


def test_a_file_is_a_plugin_with_its_content_for_a_version(tmp_path: Path) -> None:
    file = written(tmp_path / "wheel.py")
    found = registry(file)
    (plugin,) = (each for each in found.plugins if each.is_file)
    assert (plugin.name, plugin.distribution, plugin.fault) == ("wheel", "wheel.py", "")
    assert found.find("effect", "gear").load()({}, ["q1"]).joints == (1,)
    written(file, f"{GEAR}\n# changed\n")
    (changed,) = (each for each in discover().plugins if each.is_file)
    assert plugin.version.startswith("sha256 ") and changed.version.startswith("sha256 ")
    assert changed.version != plugin.version


def test_a_changed_file_and_another_of_its_name_are_loaded_anew(tmp_path: Path) -> None:
    file = written(tmp_path / "wheel.py")
    first = registry(file).find("effect", "gear").load()
    written(file, GEAR.replace("ca.sin(", "ca.cos("))
    second = registry(file).find("effect", "gear").load()
    third = registry(written(tmp_path / "b" / "wheel.py")).find("effect", "gear").load()
    at_zero = JointCommand(0, 0.0, 0.0), {"sin1": 1.0}
    assert [made({}, ["q1"]).displacement(*at_zero) for made in (first, second, third)] == [0, 1, 0]
    assert list(tmp_path.rglob("__pycache__")) == []
    assert sys.modules[third.__module__].__file__ == str(tmp_path / "b" / "wheel.py")


def test_a_file_keeps_the_contract(tmp_path: Path) -> None:
    found = registry(written(tmp_path / "wheel.py"))
    (plugin,) = (each for each in found.plugins if each.is_file)
    results = check_plugin(plugin, found)
    assert [result for result in results if result.fault] == []
    assert len(results) > 12


def test_a_folder_gives_all_its_files_but_tests_and_hidden_ones(tmp_path: Path) -> None:
    for name in ("one", "two", "test_one", "_helper", "conftest"):
        written(tmp_path / f"{name}.py", GEAR.replace('"gear"', f'"gear_{name}"'))
    names = [plugin.name for plugin in registry(tmp_path).plugins if plugin.is_file]
    assert names == ["one", "two"]


@pytest.mark.slow
def test_a_component_goes_to_another_process_and_back(tmp_path: Path) -> None:
    made = registry(written(tmp_path / "wheel.py")).find("effect", "gear").load()({}, ["q1"])
    code = (
        "import pickle, sys; made = pickle.load(sys.stdin.buffer); print(type(made).__name__, made.joints)\n"
        "from armcal.plugins import discover; assert discover().find('effect', 'gear').load() is type(made)"
    )
    ran = subprocess.run([sys.executable, "-c", code], input=pickle.dumps(made), capture_output=True, check=False)
    assert (ran.returncode, ran.stdout.decode()) == (0, "Gear (1,)\n"), ran.stderr.decode()


def test_only_the_command_line_loads_a_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path / "plugins" / "wheel.py")
    os.chdir(tmp_path)
    for arguments in (["--plugin", str(file), "plugins", "list", "-q"], ["plugins", "list", "-q", f"--plugin={file}"]):
        cli.main(args=arguments, standalone_mode=False)
        assert "wheel" in capsys.readouterr().out.split()
    use_plugins()
    cli.main(args=["plugins", "list", "-q"], standalone_mode=False)
    assert "wheel" not in capsys.readouterr().out.split()


def test_a_plugin_is_left_out_by_name(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    file = written(tmp_path / "wheel.py")
    cli.main(args=["plugins", "list", "-q", "--disable-plugin", "joints", "--plugin", str(file)], standalone_mode=False)
    shown = capsys.readouterr().out.split()
    assert "wheel" in shown and "joints" not in shown
    with pytest.raises(PluginError, match="Left out as --disable-plugin asks: joints"):
        discover().find("effect", "servo_map")
    assert "no plugin is called 'jonts', to be left out. Installed: " in refusal(disabled=("jonts",))


# What can be wrong with a file


def test_a_file_that_is_not_there_is_refused(tmp_path: Path) -> None:
    assert refusal(tmp_path / "none.py").startswith(f"{tmp_path / 'none.py'}: found no such file or folder")
    (tmp_path / "empty").mkdir()
    assert "found no plugin in this folder" in refusal(tmp_path / "empty")
    assert "expected the name of a plugin's file" in refusal(written(tmp_path / "wheel.txt"))


def test_a_file_that_registers_nothing_is_refused(tmp_path: Path) -> None:
    file = written(tmp_path / "wheel.py", GEAR.partition("@hookimpl")[0])
    assert refusal(file).startswith(f"{file}: it registers nothing: write a function armcal_register_")
    unmarked = refusal(written(file, GEAR.replace("@hookimpl", "")))
    assert unmarked.startswith(f"{file}: ") and "is not marked: put @hookimpl before it" in unmarked
    misspelt = refusal(written(file, GEAR.replace("register_effects", "register_efects")))
    assert str(file) in misspelt and "unknown hook 'armcal_register_efects'" in misspelt


@pytest.mark.parametrize(
    ("text", "line", "fault"),
    [
        ("x = 1\nimport no_such_module_of_anybody\n", 2, "ModuleNotFoundError: No module named"),
        ("x = 1\n\ndef broken(:\n    pass\n", 3, "SyntaxError: invalid syntax"),
        ("def inner():\n    return 1 / 0\n\ninner()\n", 2, "ZeroDivisionError: division by zero"),
        ("raise SystemExit(4)\n", 1, "SystemExit: 4"),
    ],
)
def test_a_file_that_does_not_import_is_refused_with_its_line(text: str, line: int, fault: str, tmp_path: Path) -> None:
    file = written(tmp_path / "wheel.py", text)
    assert refusal(file).startswith(f"{file}:{line}: it does not import: {fault}")


def test_two_of_one_name_are_both_named(tmp_path: Path) -> None:
    one, two = written(tmp_path / "a" / "wheel.py"), written(tmp_path / "b" / "wheel.py")
    assert f"two plugins are called 'wheel': {one} and {two}." in refusal(one, two)
    mine = written(tmp_path / "joints.py")
    assert f"two plugins are called 'joints': {mine} and armcal_joints.plugin armcal 0.1.0." in refusal(mine)
    both = registry(one, written(tmp_path / "a" / "cog.py"))
    with pytest.raises(PluginError, match=r"'gear' is offered twice, by cog \(.*cog:Gear\) and wheel \(.*wheel:Gear\)"):
        both.find("effect", "gear")
