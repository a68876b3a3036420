"""The plugin contract as checks: what every component must do before a configuration may name it."""

import inspect
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from pkgutil import resolve_name
from types import MappingProxyType
from typing import Any

import click

from armcal.hooks import KINDS
from armcal.plugins import Component, PluginInfo, PluginRegistry
from armcal.testing.arm_checks import check_exporter, check_simulator
from armcal.testing.board_checks import check_bench, check_device, check_link
from armcal.testing.effect_checks import check_effect
from armcal.testing.estimator_checks import check_estimator
from armcal.testing.live_checks import check_camera, check_joint_stream, check_tracker
from armcal.testing.manners import watched
from armcal.testing.measurement_checks import check_measurement
from armcal.testing.model_checks import check_model
from armcal.testing.online_checks import check_online
from armcal.testing.reader_checks import check_reader
from armcal.testing.residual_checks import check_residual
from armcal.testing.results import CheckResult, ContractError, Recorder, expect
from armcal.testing.settings_checks import Subject, check_settings

__all__ = ["KNOWN_CHECKS", "CheckResult", "assert_contract", "check_component", "check_plugin"]

_CHECKS: Mapping[str, tuple[int, Callable[[Recorder, Subject], None] | None]] = MappingProxyType(
    {
        "model": (28, check_model),
        "effect": (26, check_effect),
        "residual": (23, check_residual),
        "measurement": (28, check_measurement),
        "reader": (23, check_reader),
        "estimator": (22, check_estimator),
        "online": (20, check_online),
        "simulator": (14, check_simulator),
        "exporter": (15, check_exporter),
        "link": (18, check_link),
        "device": (31, check_device),
        "tracker": (18, check_tracker),
        "joints": (19, check_joint_stream),
        "camera": (16, check_camera),
        "bench": (13, check_bench),
        "command": (2, None),
        "report_section": (2, None),
    }
)
"""Of each kind: how many checks there are for any component, and what does them on one that has settings."""
KNOWN_CHECKS: Mapping[str, int] = MappingProxyType({kind: count for kind, (count, _) in _CHECKS.items()})
"""How many checks there are for any component of a kind; what a component has beside the rest adds to them."""

_MARK = "imported:"
_LONGEST_IMPORT_S = 60


def assert_contract(component: type | str, kind: str, *, at_least: int | None = None) -> Sequence[CheckResult]:
    """Check a component, for a test of your own.

    Args:
        component: its class, or ``module:attribute`` of it.
        kind: what it is registered as: ``model``, ``effect``, ``measurement`` and so on.
        at_least: so many checks must run; by default as many as on any component of its kind.

    Returns:
        results: of all checks, those that did not run included.

    Raises:
        AssertionError: it breaks the contract, or fewer checks ran. All faults are listed.
        ValueError: no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"found the kind {kind!r}, expected one of {', '.join(KINDS)}")
    name = component if isinstance(component, str) else component.__qualname__
    results = _checked(kind, name, lambda: _loaded(component))
    faults = [f"  {result.check}: {result.fault}" for result in results if result.fault]
    left = [f"  {result.check}" for result in results if result.not_run]
    ran, expected = len(results) - len(left), KNOWN_CHECKS[kind] if at_least is None else at_least
    if faults:
        raise AssertionError("\n".join([f"{kind} {name} breaks the plugin contract:", *faults]))
    if ran < expected:
        raise AssertionError("\n".join([f"{kind} {name}: {ran} checks ran, expected at least {expected}.", *left]))
    return results


def _loaded(component: type | str) -> Any:
    if isinstance(component, str) and ":" not in component:
        raise ValueError(f"found {component!r}, expected module:attribute")
    return resolve_name(component) if isinstance(component, str) else component


def check_component(component: Component) -> list[CheckResult]:
    """Every check of the component's kind; what the component raises becomes a fault, never an exception."""
    return _checked(component.kind, component.name, component.load)


def check_plugin(plugin: PluginInfo, registry: PluginRegistry) -> list[CheckResult]:
    """The plugin's registration, then every component that it announced."""
    record = Recorder(f"plugin {plugin.name}")
    with record.check("it loads, with no hook that armcal does not know"):
        expect(not plugin.fault, plugin.fault)
    if plugin.fault:
        return record.results
    if not plugin.is_file:
        with record.check("its registration imports nothing heavy"):
            _expect_light(plugin.module)
    own = registry.announced_by(plugin)
    for component in own:
        with record.check(f"the {component.kind} {component.name!r} is offered once"):
            registry.find(component.kind, component.name)
    return record.results + [result for component in own for result in check_component(component)]


def _checked(kind: str, name: str, load: Callable[[], Any]) -> list[CheckResult]:
    """Every check of a kind on what ``load`` gives: a component's class."""
    record, (_, check) = Recorder(f"{kind} {name}"), _CHECKS[kind]
    with record.group():
        if check is not None:
            with watched(record) as begin, record.group():
                with record.needed("it imports"):
                    made = load()
                begin(made)
                check(record, check_settings(record, kind, made))
        elif kind == "command":  # it is imported for one call of armcal, and may do to the process what it needs
            with record.needed("it imports"):
                command = load()
            with record.check("it is a click command that says what it does"):
                expect(isinstance(command, click.Command), f"found {type(command).__name__}, expected a click.Command")
                expect(bool(command.help), f"found no help of the command {command.name!r}, expected a docstring")
        else:
            with record.needed("it imports"):
                section = load()
            with record.check("it is a function of a run's result"):
                expect(callable(section), f"found {type(section).__name__}, expected a function of a RunResult")
                needed = [p for p in inspect.signature(section).parameters.values() if p.default is p.empty]
                count = len(needed)
                expect(count == 1, f"found {count} arguments without a default, expected one: the RunResult")
    return record.results


def _expect_light(target: str) -> None:
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
