"""The plugin contract as a list of checks a kind: what a component must do before a configuration may name it."""

import inspect
import io
import os
import pickle
import random
import subprocess
import sys
from collections.abc import Callable, Mapping, Sequence
from contextlib import redirect_stdout
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from typing import Any, get_args

import click
import numpy as np
from pydantic import ValidationError

from armcal.base.settings import Settings
from armcal.base.units import split_suffix
from armcal.errors import ArmcalError
from armcal.hooks import KINDS
from armcal.plugins import Component, PluginInfo, PluginRegistry
from armcal.testing import arm_checks, bench_checks, data_checks  # noqa: F401 - their checks are listed as they are imported
from armcal.testing.checking import CHECKS, NEEDED, PLUGIN_FAULTS, Check, ContractError, NotRun, Subject, check, expect

MOST_CHARACTERS = 400
_LONGEST_IMPORT_S = 60
_QUANTITIES = (
    "length distance height width depth radius diameter noise angle angles mass payload compliance force torque "
    "temperature acceleration duration timeout"
)
"""Words in the names of settings that are quantities."""


@dataclass(frozen=True)
class CheckResult:
    """What one check found: nothing, if ``fault`` is empty; ``not_run`` says why it could not run."""

    component: str
    check: str
    fault: str = ""
    not_run: str = ""


# --- what every component must do -----------------------------------------------------------------------------------


@check(needed=True)
def it_imports(s: Subject) -> None:
    s.made = s.load()


@check(needed=True)
def it_has_checked_settings_typed_and_with_units(s: Subject) -> None:
    settings_class: Any = getattr(s.made, "Settings", None)
    expect(
        isinstance(settings_class, type) and issubclass(settings_class, Settings),
        f"found Settings = {settings_class!r}, expected a class attribute: a subclass of armcal.base.settings.Settings",
    )
    quantities = settings_class.quantities()
    for name, info in settings_class.model_fields.items():
        bare = info.annotation in (None, Any, object) and not info.description
        expect(not bare, f"found {name} without a type, expected one, or Field(description=...)")
        if name in quantities or info.description or not _holds_floats(info.annotation, info.metadata):
            continue
        expect(
            split_suffix(name) is None and not set(_QUANTITIES.split()) & set(name.split("_")),
            f"found {name}, a number without a unit; expected a type with one, such as Length or Angle "
            "of armcal.base.settings, under a name without one, or Field(description=...) if it has none",
        )


@check(needed=True)
def its_example_is_accepted_kept_by_to_config_and_an_unknown_key_refused(s: Subject) -> None:
    settings_class, example = s.made.Settings, getattr(s.made, "EXAMPLE", {})
    expect(isinstance(example, Mapping), f"found an EXAMPLE that is no mapping of settings: {type(example).__name__}")
    s.example = dict(example)
    fields = settings_class.model_fields
    if s.kind == "reader" and "path" in fields and fields["path"].is_required():
        s.example.setdefault("path", data_checks.MISSING_FILE)
    try:
        s.settings = settings_class.model_validate(s.example)
    except ValidationError as fault:
        if hasattr(s.made, "EXAMPLE"):
            raise
        reason = "it has no EXAMPLE and needs settings"
        if s.kind == "simulator":
            raise NotRun(reason) from fault
        add = "add the class attribute EXAMPLE, a mapping as a configuration would have it"
        raise ContractError(f"{reason}: {add}") from fault
    key = "no_component_has_this_key"
    try:
        settings_class.model_validate({**s.example, key: 1})
    except ValidationError as fault:
        named = any(key in map(str, error["loc"]) for error in fault.errors())
        expect(named, "found an unknown key refused without being named, expected its name in the error")
    else:
        raise ContractError("found an unknown key accepted, expected it refused: keep extra='forbid'")
    again = settings_class.model_validate(s.settings.to_config())
    expect(again == s.settings, f"found {again!r} after to_config(), expected {s.settings!r}")


def it_prints_nothing_and_leaves_the_process_alone(s: Subject) -> None:
    """This check is the last; what is watched was noted before the first."""
    shown = " ".join(s.heard.getvalue().split())[:60]
    rule = "expected that it prints nothing: results are armcal's to print; raise errors or return"
    expect(not s.heard.getvalue(), f"found {shown!r} printed, {rule}")
    now = _process()
    changed = [name for name, value in s.process.items() if now[name] != value]
    expect(not changed, f"found {', '.join(changed)} changed, expected that it leaves the process alone")


def _holds_floats(*parts: Any) -> bool:
    inner = [part_type for part in parts for part_type in (part if isinstance(part, list) else (part,))]
    return any(
        part_type is float or (get_args(part_type) and _holds_floats(*get_args(part_type))) for part_type in inner
    )


def _process() -> dict[str, Any]:
    return {
        "numpy.random (use numpy.random.default_rng(seed))": pickle.dumps(np.random.get_state()),
        "random (use numpy.random.default_rng(seed))": hash(random.getstate()),
        "numpy.seterr (use numpy.errstate)": repr(np.geterr()),
        "the working folder": str(Path.cwd()),
        "os.environ": dict(os.environ),
    }


@check("command")
def it_is_a_click_command_that_says_what_it_does(s: Subject) -> None:
    expect(isinstance(s.made, click.Command), f"found {type(s.made).__name__}, expected a click.Command")
    expect(bool(s.made.help), f"found no help of the command {s.made.name!r}, expected a docstring")


@check("report_section")
def it_is_a_function_of_a_runs_result(s: Subject) -> None:
    expect(callable(s.made), f"found {type(s.made).__name__}, expected a function of a RunResult")
    count = len([p for p in inspect.signature(s.made).parameters.values() if p.default is p.empty])
    expect(count == 1, f"found {count} arguments without a default, expected one: the RunResult")


_OF_ANY = (
    it_imports,
    it_has_checked_settings_typed_and_with_units,
    its_example_is_accepted_kept_by_to_config_and_an_unknown_key_refused,
)
_LAST = it_prints_nothing_and_leaves_the_process_alone


def checks_of(kind: str) -> tuple[Check, ...]:
    if kind in ("command", "report_section"):
        return (it_imports, *CHECKS[kind])
    return (*_OF_ANY, *CHECKS[kind], _LAST)


# --- running them ---------------------------------------------------------------------------------------------------


def assert_contract(component: type | str, kind: str, *, at_least: int | None = None) -> Sequence[CheckResult]:
    """Check a component, for a test of your own.

    Args:
        component: its class, or ``module:attribute`` of it.
        kind: what it is registered as: ``model``, ``effect``, ``measurement`` and so on.
        at_least: so many checks must run; by default all of its kind.

    Returns:
        results: of all checks, those that did not run included.

    Raises:
        AssertionError: it breaks the contract, or fewer checks ran. All faults are listed.
        ValueError: no such kind.
    """
    if kind not in KINDS:
        raise ValueError(f"found the kind {kind!r}, expected one of {', '.join(KINDS)}")
    name = component if isinstance(component, str) else component.__qualname__

    def load() -> Any:
        if isinstance(component, str) and ":" not in component:
            raise ValueError(f"found {component!r}, expected module:attribute")
        return resolve_name(component) if isinstance(component, str) else component

    results = _checked(kind, name, load)
    faults = [f"  {result.check}: {result.fault}" for result in results if result.fault]
    idle = [f"  {result.check}" for result in results if result.not_run]
    ran, expected = len(results) - len(idle), len(checks_of(kind)) if at_least is None else at_least
    if faults:
        raise AssertionError("\n".join([f"{kind} {name} breaks the plugin contract:", *faults]))
    if ran < expected:
        raise AssertionError("\n".join([f"{kind} {name}: {ran} checks ran, expected at least {expected}.", *idle]))
    return results


def check_component(component: Component) -> list[CheckResult]:
    """Every check of the component's kind; what the component raises becomes a fault, never an exception."""
    return _checked(component.kind, component.name, component.load)


def check_plugin(plugin: PluginInfo, registry: PluginRegistry) -> list[CheckResult]:
    """The plugin's registration, then every component that it announced."""
    subject, results = Subject(plugin=plugin, registry=registry), list[CheckResult]()
    for own in (
        it_loads_with_no_hook_that_armcal_does_not_know,
        its_registration_prints_and_imports_nothing_heavy,
        each_component_is_offered_once,
    ):
        results.append(_tried(own, f"plugin {plugin.name}", subject))
        if plugin.fault:
            return results
    return results + [result for component in registry.announced_by(plugin) for result in check_component(component)]


def _checked(kind: str, name: str, load: Callable[[], Any]) -> list[CheckResult]:
    subject = Subject(kind=kind, load=load, heard=io.StringIO(), process=_process())
    results, ended = list[CheckResult](), False
    with redirect_stdout(subject.heard):
        for own in checks_of(kind):
            if not ended or own is _LAST:
                results.append(_tried(own, f"{kind} {name}", subject))
                ended = ended or (own in NEEDED and bool(results[-1].fault or results[-1].not_run))
    return results


def _tried(check: Check, component: str, subject: Subject) -> CheckResult:
    name = check.__name__.replace("_", " ")
    try:
        check(subject)
    except NotRun as reason:
        return CheckResult(component, f"{name} (not run: {reason})", not_run=str(reason))
    except PLUGIN_FAULTS as fault:
        text = " ".join(str(fault).split())
        text = text if isinstance(fault, (ContractError, ArmcalError)) else f"{type(fault).__name__}: {text}"
        shown = text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."
        return CheckResult(component, name, shown)
    return CheckResult(component, name)


def it_loads_with_no_hook_that_armcal_does_not_know(s: Subject) -> None:
    expect(not s.plugin.fault, s.plugin.fault)


def its_registration_prints_and_imports_nothing_heavy(s: Subject) -> None:
    """Seen in a fresh interpreter."""
    if s.plugin.is_file:
        return
    module, mark = s.plugin.module.partition(":")[0], "imported:"
    code = (
        f"import sys; sys.path[:] = {sys.path!r}; import armcal.hooks; before = set(sys.modules); import {module}; "
        f"print({mark!r}, *sorted({{name.partition('.')[0] for name in set(sys.modules) - before}}))"
    )
    ran = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, timeout=_LONGEST_IMPORT_S, check=False
    )
    expect(not ran.returncode, f"{module} does not import by itself: {ran.stderr.strip().splitlines()[-1:]}")
    said, _, imported = ran.stdout.rpartition(mark)
    shown = " ".join(said.split())[:60]
    expect(not shown, f"found {shown!r} printed when {module} is imported, expected nothing")
    known = {module.partition(".")[0], "armcal"}
    foreign = [name for name in imported.split() if name not in known and name not in sys.stdlib_module_names]
    expect(
        not foreign,
        f"found {', '.join(foreign)} imported by {module}, expected only armcal.hooks: "
        "components are imported when they are used",
    )


def each_component_is_offered_once(s: Subject) -> None:
    for component in s.registry.announced_by(s.plugin):
        s.registry.find(component.kind, component.name)
