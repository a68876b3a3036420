"""The plugin contract as checks: what every component must do before a configuration may name it."""

from __future__ import annotations

import inspect
import subprocess
import sys
from collections.abc import Callable, Mapping
from types import MappingProxyType
from typing import Any

import click

from armcal.plugins import Component, PluginInfo, PluginRegistry
from armcal.testing.board_checks import check_bench, check_device, check_link
from armcal.testing.effect_checks import check_effect
from armcal.testing.estimator_checks import check_estimator
from armcal.testing.exporter_checks import check_exporter
from armcal.testing.live_checks import check_joint_stream, check_tracker
from armcal.testing.manners import watched
from armcal.testing.measurement_checks import check_measurement
from armcal.testing.model_checks import check_model
from armcal.testing.online_checks import check_online
from armcal.testing.reader_checks import check_reader
from armcal.testing.results import CheckResult, ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject, check_settings
from armcal.testing.simulator_checks import check_simulator

__all__ = ["CheckResult", "check_component", "check_plugin"]

_MARK = "imported:"
_LONGEST_IMPORT_S = 60

_CHECKS: Mapping[str, Callable[[Recorder, Subject], None]] = MappingProxyType(
    {
        "model": check_model,
        "effect": check_effect,
        "measurement": check_measurement,
        "reader": check_reader,
        "estimator": check_estimator,
        "online": check_online,
        "simulator": check_simulator,
        "exporter": check_exporter,
        "joints": check_joint_stream,
        "bench": check_bench,
        "tracker": check_tracker,
        "link": check_link,
        "device": check_device,
    }
)


def check_component(component: Component) -> list[CheckResult]:
    """Every check of the component's kind; what the component raises becomes a fault, never an exception."""
    return check_made(component.kind, component.name, component.load)


def check_plugin(plugin: PluginInfo, registry: PluginRegistry) -> list[CheckResult]:
    """The plugin's registration, then every component that it announced."""
    record = Recorder(f"plugin {plugin.name}")
    record.check("it loads, with no hook that armcal does not know", lambda: expect(not plugin.fault, plugin.fault))
    if plugin.fault:
        return record.results
    if not plugin.is_file:
        record.check("its registration imports nothing heavy", _imports_light, plugin.module)
    own = registry.announced_by(plugin)
    for component in own:
        name = f"the {component.kind} {component.name!r} is offered once"
        record.check(name, registry.find, component.kind, component.name)
    return record.results + [result for component in own for result in check_component(component)]


def check_made(kind: str, name: str, load: Callable[[], Any]) -> list[CheckResult]:
    """Every check of a kind on what ``load`` gives: a component's class."""
    record = Recorder(f"{kind} {name}")
    record.guard(lambda: _check_kind(record, kind, load))
    return record.results


def _check_kind(record: Recorder, kind: str, load: Callable[[], Any]) -> None:
    if kind == "command":  # it is imported for one call of armcal, and may do to the process what it needs
        command = record.check("it imports", load)
        record.check("it is a click command that says what it does", _check_command, command)
        return
    if kind == "report_section":
        record.check("it is a function of a run's result", _check_section, record.check("it imports", load))
        return
    with watched(record) as begin:
        made = record.check("it imports", load)
        begin(made)
        subject = None if made is None else check_settings(record, kind, made)
        if subject is not None:
            record.guard(lambda: _CHECKS[kind](record, subject))


def _check_command(made: Any) -> None:
    expect(isinstance(made, click.Command), f"found {type(made).__name__}, expected a click.Command")
    expect(bool(made.help), f"found no help of the command {made.name!r}, expected a docstring")


def _check_section(made: Any) -> None:
    expect(callable(made), f"found {type(made).__name__}, expected a function of a RunResult")
    required = [p for p in inspect.signature(made).parameters.values() if p.default is p.empty]
    expect(len(required) == 1, f"found {len(required)} arguments without a default, expected one: the RunResult")


def _imports_light(target: str) -> None:
    """Import the registration module in a fresh interpreter and see what came with it, and what it said."""
    module = target.partition(":")[0]
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; import armcal.hooks; before = set(sys.modules); import {module}; "
        f"print({_MARK!r}, *sorted({{name.partition('.')[0] for name in set(sys.modules) - before}}))"
    )
    ran = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=_LONGEST_IMPORT_S, check=False
    )
    if ran.returncode:
        raise ContractError(f"{module} does not import by itself: {ran.stderr.strip().splitlines()[-1:]}")
    said, _, imported = ran.stdout.rpartition(_MARK)
    shown = " ".join(said.split())[:60]
    expect(not shown, f"found {shown!r} printed when {module} is imported, expected nothing")
    own = {module.partition(".")[0], "armcal"}
    foreign = [name for name in imported.split() if name not in own and name not in sys.stdlib_module_names]
    expect(
        not foreign,
        f"found {', '.join(foreign)} imported by {module}, expected only armcal.hooks: "
        "components are imported when they are used",
    )
