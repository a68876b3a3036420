"""What is to go of the contract: it works on, warns in Python and on the command line, and only then goes."""

from __future__ import annotations

import json
import os
import subprocess
import sys
import warnings
from collections.abc import Iterator
from importlib.metadata import EntryPoint
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import yaml
from armcal import hooks
from armcal.errors import PluginError
from armcal.hooks import ContractDeprecationWarning
from armcal.plugins import PluginRegistry, discover
from armcal.registration import Specifications
from pluggy import HookspecMarker

PLANTED = Path(__file__).parents[1] / "data" / "planted_faults"
OLD_HOOK = "armcal_arm_parked is deprecated since contract 1.4 and goes with 2.0: write armcal_run_ended"
OLD_ARGUMENT = "the argument seconds of armcal_arm_moved is deprecated since contract 1.4: take duration"
MODEL = """
from armcal.hooks import hookimpl
{more}

@hookimpl
def armcal_register_models(register):
    register({told})
"""
ARM = '"arm", "planted_expressions:Arm"'


def specifications() -> Specifications:
    """A later contract, in which a hook, an argument and a method are to go."""
    spec = HookspecMarker(hooks.PROJECT)

    @spec(warn_on_impl=ContractDeprecationWarning(OLD_HOOK))
    def armcal_arm_parked(arm: str) -> None:
        """The arm was parked."""

    @spec(warn_on_impl_args={"seconds": ContractDeprecationWarning(OLD_ARGUMENT)})
    def armcal_arm_moved(arm: str, duration: float, seconds: float) -> None:
        """The arm has moved."""

    planted = {"armcal_arm_parked": armcal_arm_parked, "armcal_arm_moved": armcal_arm_moved}
    methods = {"model": {"parameters": "write blocks() in its place"}, "effect": {"chain": "leave it out"}}
    return Specifications(SimpleNamespace(**{**vars(hooks), **planted}), deprecated_methods=methods)


def plugin(monkeypatch: pytest.MonkeyPatch, site: Path, name: str, more: str = "", told: str = ARM) -> EntryPoint:
    monkeypatch.syspath_prepend(str(site))
    monkeypatch.syspath_prepend(str(PLANTED))
    monkeypatch.delitem(sys.modules, f"aged_{name}", raising=False)
    (site / f"aged_{name}.py").write_text(MODEL.format(more=more, told=told), encoding="utf-8")
    return EntryPoint(name, f"aged_{name}", "armcal")


def found(*points: EntryPoint, contract: Specifications | None = None) -> tuple[PluginRegistry, list[str]]:
    """The registry, and what was warned of, each by our own kind of warning."""
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("always")
        registry = discover(points, contract)
    assert all(issubclass(each.category, ContractDeprecationWarning) for each in told)
    return registry, [str(each.message) for each in told]


PARKED = "@hookimpl\ndef armcal_arm_parked(arm):\n    raise SystemExit(arm)"
MOVED = "@hookimpl\ndef armcal_arm_moved(seconds):\n    TOLD.append(seconds)\nTOLD = []"


def test_nothing_of_today_is_to_go(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    registry, told = found(plugin(monkeypatch, tmp_path, "plain"))
    assert told == []
    assert registry.plugins[0].notices == ()
    with warnings.catch_warnings():
        warnings.simplefilter("error", ContractDeprecationWarning)
        for component in discover().components:
            if component.module.startswith("armcal_"):
                component.load()


def test_an_old_hook_warns_once_and_works(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    registry, told = found(plugin(monkeypatch, tmp_path, "hook", PARKED), contract=specifications())
    assert told == [f"plugin hook (aged_hook): {OLD_HOOK}"]
    assert registry.plugins[0].notices == (OLD_HOOK,)
    assert registry.faults == ()
    assert registry.find("model", "arm").name == "arm"
    with pytest.raises(SystemExit, match="left"):
        registry.notify("armcal_arm_parked", arm="left")


def test_an_old_argument_warns_once_and_is_still_given(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    registry, told = found(plugin(monkeypatch, tmp_path, "argument", MOVED), contract=specifications())
    assert told == [f"plugin argument (aged_argument): {OLD_ARGUMENT}"]
    assert registry.notify("armcal_arm_moved", arm="left", duration=2.0, seconds=2.0) == []
    assert sys.modules["aged_argument"].TOLD == [2.0]  # type: ignore[attr-defined]


def test_the_new_argument_alone_does_not_warn(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    point = plugin(monkeypatch, tmp_path, "new", MOVED.replace("seconds", "duration"))
    assert found(point, contract=specifications())[1] == []


def test_an_old_hook_is_no_hook_of_a_contract_without_it(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """What the next major version does, after the warnings: the plugin is left out, and says why."""
    registry, told = found(plugin(monkeypatch, tmp_path, "gone", PARKED))
    assert told == []
    assert "unknown hook 'armcal_arm_parked'" in registry.faults[0].fault


def test_an_old_method_warns_when_the_component_is_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    registry, told = found(plugin(monkeypatch, tmp_path, "method"), contract=specifications())
    assert told == [], "nothing is imported before it is used"
    with pytest.warns(ContractDeprecationWarning, match=r"has parameters\(\), which is deprecated: write blocks\(\)"):
        made = registry.find("model", "arm").load()
    assert made.__name__ == "Arm"


def test_an_old_name_warns_when_it_is_asked_for(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    old = '"old_arm", "planted_expressions:Arm", "as arm", deprecated="use arm"'
    registry, told = found(plugin(monkeypatch, tmp_path, "name", told=f"{ARM})\n    register({old}"))
    assert told == []
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert registry.find("model", "arm").deprecated == ""
    with pytest.warns(ContractDeprecationWarning, match="model 'old_arm' of the plugin name is deprecated: use arm"):
        assert registry.find("model", "old_arm").load() is registry.find("model", "arm").load()


@pytest.mark.parametrize("told", [f"{ARM}, deprecated=True", f"{ARM}, 3", "None, 'a:b'", "'a', 3"])
def test_registering_what_is_no_text_is_a_fault(monkeypatch: pytest.MonkeyPatch, tmp_path: Path, told: str) -> None:
    registry, _ = found(plugin(monkeypatch, tmp_path, "strange", told=told))
    assert "TypeError: register() was given" in registry.faults[0].fault


# The contract that a plugin was written for


@pytest.mark.parametrize("asked", ["1.4", "1.0", "1.3"])
def test_a_plugin_of_this_contract_or_an_older_minor_is_taken(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, asked: str
) -> None:
    registry, _ = found(plugin(monkeypatch, tmp_path, "fitting", f'ARMCAL_CONTRACT = "{asked}"'))
    assert registry.faults == ()
    assert registry.find("model", "arm")


REFUSED = {
    '"1.5"': "it is written for contract 1.5, and armcal {version} has contract 1.4. It needs an armcal of contract 1, "
    "from 1.5 on: update armcal.",
    '"1.40"': "from 1.40 on: update armcal.",
    '"2.0"': "It needs an armcal of contract 2, from 2.0 on: update armcal.",
    '"0.9"': "It needs an armcal of contract 0: update the plugin, or install an older armcal for it.",
    "1.4": "found ARMCAL_CONTRACT = 1.4, expected text such as '1.4'.",
    '"1"': "found ARMCAL_CONTRACT = '1', expected text such as '1.4'.",
    '"1.4\\n"': "expected text such as '1.4'.",
    '"newest"': "found ARMCAL_CONTRACT = 'newest', expected text such as '1.4'.",
}


@pytest.mark.parametrize("asked", REFUSED)
def test_a_plugin_of_another_contract_is_left_out_and_says_what_it_needs(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, asked: str
) -> None:
    from armcal import __version__

    good = plugin(monkeypatch, tmp_path, "good")
    bad = plugin(monkeypatch, tmp_path, "bad", f"ARMCAL_CONTRACT = {asked}", told='"other", "planted_expressions:Arm"')
    registry, _ = found(good, bad)
    (fault,) = registry.faults
    assert fault.name == "bad"
    assert fault.fault.endswith(REFUSED[asked].format(version=__version__))
    assert registry.find("model", "arm")
    with pytest.raises(PluginError, match="may have had it: bad: "):
        registry.find("model", "other")


def test_the_contract_is_the_one_that_these_tests_are_of() -> None:
    assert hooks.CONTRACT_VERSION == "1.4"


# On the command line


@pytest.fixture
def site(tmp_path: Path) -> Iterator[Path]:
    """A folder of installed plugins, one of which announces an old name."""
    old = '"old_mdh", "armcal_mdh.model:MdhModel", "as mdh", deprecated="use mdh"'
    (tmp_path / "aged_cli.py").write_text(MODEL.format(more="", told=old), encoding="utf-8")
    (tmp_path / "aged_late.py").write_text(
        MODEL.format(more='ARMCAL_CONTRACT = "1.9"', told='"late", "a:b"'), encoding="utf-8"
    )
    folder = tmp_path / "aged-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: aged\nVersion: 1.0\n", encoding="utf-8")
    (folder / "entry_points.txt").write_text("[armcal]\ncli = aged_cli\nlate = aged_late\n", encoding="utf-8")
    yield tmp_path


def armcal(*arguments: str, site: Path) -> subprocess.CompletedProcess[str]:
    environment = {**os.environ, "PYTHONPATH": str(site), "ARMCAL_CC": "none", "COLUMNS": "1000"}
    command = [sys.executable, "-m", "armcal.cli", *arguments]
    return subprocess.run(command, capture_output=True, text=True, cwd=site, env=environment, check=False)


def experiment(site: Path, model: str) -> Path:
    rows = [{"a_mm": 200, "alpha_deg": 90}, {"a_mm": 100}]
    content: dict[str, Any] = {
        "name": "aged",
        "arms": {arm: {"model": {"type": model, "convention": "standard", "rows": rows}} for arm in ("left", "right")},
        "statics": {"gravity_m_s2": [0, 0, -9.81], "payload_g": 0},
        "measurements": {"tracker": {"type": "tip_position", "noise_mm": 0.1, "arm": "left"}},
        "data": {"type": "csv", "path": "data.csv"},
        "simulation": {
            "type": "elastic_arm",
            "truth": "truth.yaml",
            "poses": {
                "count": 4,
                "levels_deg": {"q1": [0, 9], "q2": [0, 9]},
            },
        },
        "parameters": {},
    }
    path = site / f"{model}.yaml"
    path.write_text(yaml.safe_dump(content), encoding="utf-8")
    (site / "truth.yaml").write_text("{}\n", encoding="utf-8")
    return path


def test_the_command_line_tells_an_old_name_once(site: Path) -> None:
    ran = armcal("simulate", experiment(site, "old_mdh").name, "--out", "data.csv", site=site)
    assert ran.returncode == 0, ran.stderr
    lines = [line for line in ran.stderr.splitlines() if "old_mdh" in line]
    assert lines == ["warning: model 'old_mdh' of the plugin cli is deprecated: use mdh."]
    assert "DeprecationWarning" not in ran.stderr


def test_the_command_line_says_nothing_of_a_name_that_nobody_uses(site: Path) -> None:
    ran = armcal("simulate", experiment(site, "mdh").name, "--out", "data.csv", site=site)
    assert ran.returncode == 0, ran.stderr
    assert "deprecated" not in ran.stderr
    assert ran.stderr.count("\n") == 1
    assert ran.stderr.startswith("warning: plugin late (aged_late) is left out: it is written for contract 1.9, and ")


def test_quiet_is_quiet(site: Path) -> None:
    ran = armcal("simulate", experiment(site, "old_mdh").name, "--out", "data.csv", "-q", site=site)
    assert ran.returncode == 0, ran.stderr
    assert ran.stderr == ""


def test_the_list_shows_what_is_to_go(site: Path) -> None:
    listed = armcal("plugins", "list", site=site)
    assert "old_mdh            as mdh  (deprecated: use mdh)" in listed.stdout
    assert "does not load: it is written for contract 1.9" in listed.stdout
    content = json.loads(armcal("plugins", "list", "--json", site=site).stdout)
    components = [c for p in content["plugins"] if p["name"] == "cli" for c in p["components"]]
    assert [c["deprecated"] for c in components] == ["use mdh"]
