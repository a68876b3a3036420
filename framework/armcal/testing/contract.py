"""The plugin contract as a list of checks a kind: what a component must do before a configuration may name it."""

import io
import os
import pickle
import random
import sys
from collections.abc import Callable, Sequence
from contextlib import redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from pkgutil import resolve_name
from traceback import extract_tb
from typing import Any, get_args

import numpy as np
from pydantic import ValidationError

from armcal.base.settings import Settings
from armcal.base.units import split_suffix
from armcal.hooks import KINDS
from armcal.plugins import Component, PluginInfo, PluginRegistry, said
from armcal.testing import arm_checks, bench_checks, data_checks  # noqa: F401 - their checks are listed as they are imported
from armcal.testing.checking import (
    CHECKS,
    NEEDED,
    RESULTS,
    Check,
    ContractError,
    NotRun,
    Subject,
    check,
    expect,
    it_is_the_same_each_time,
)

MOST_CHARACTERS = 400
_QUANTITIES = (  # words in the names of settings that are quantities
    "length distance height width depth radius diameter noise angle angles mass payload compliance force torque "
    "temperature acceleration duration timeout"
)


@dataclass(frozen=True)
class CheckResult:
    component: str
    check: str
    fault: str = ""  # what it found
    not_run: str = ""  # why it could not run


# --- what every component must do -----------------------------------------------------------------------------------


@check("", needed=True)
def it_imports(s: Subject) -> None:
    s.made = s.load()
    s.file = getattr(sys.modules.get(getattr(s.made, "__module__", "")), "__file__", "")


@check("", needed=True)
def its_settings_are_checked_and_their_numbers_have_units(s: Subject) -> None:
    settings_class: Any = getattr(s.made, "Settings", None)
    expect(
        isinstance(settings_class, type) and issubclass(settings_class, Settings),
        f"found Settings = {settings_class!r}, expected a class attribute: a subclass of armcal.base.settings.Settings",
    )
    quantities = settings_class.quantities()
    for name, info in settings_class.model_fields.items():
        if name in quantities or info.description or not _holds_floats(info.annotation, info.metadata):
            continue
        expect(
            split_suffix(name) is None and not set(_QUANTITIES.split()) & set(name.split("_")),
            f"found {name}, a number without a unit; expected a type with one, such as Length or Angle "
            "of armcal.base.settings, under a name without one, or Field(description=...) if it has none",
        )


@check("", needed=True)
def its_example_is_accepted_kept_by_to_config_and_an_unknown_key_refused(s: Subject) -> None:
    settings_class, s.example = s.made.Settings, dict(getattr(s.made, "EXAMPLE", {}))
    if s.kind == "reader" and "path" in settings_class.model_fields:
        s.example.setdefault("path", "/no/such/folder/measurements")
    try:
        s.settings = settings_class.model_validate(s.example)
    except ValidationError as fault:
        if hasattr(s.made, "EXAMPLE"):
            raise
        reason = "it has no EXAMPLE and needs settings"
        add = "add the class attribute EXAMPLE, a mapping as a configuration would have it"
        raise ContractError(f"{reason}: {add}") from fault
    with suppress(ValidationError):
        settings_class.model_validate({**s.example, "no_component_has_this_key": 1})
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


def checks_of(kind: str) -> tuple[Check, ...]:
    if kind not in CHECKS:  # a command, or a section of the report
        return (it_imports,)
    if kind == "check":  # a function without settings
        return (it_imports, *CHECKS[kind], it_prints_nothing_and_leaves_the_process_alone)
    repeated = (it_is_the_same_each_time,) if kind in RESULTS else ()
    return (*CHECKS[""], *CHECKS[kind], *repeated, it_prints_nothing_and_leaves_the_process_alone)


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
    subject, results = Subject(plugin=plugin, registry=registry, file=""), list[CheckResult]()
    for own in (it_loads_with_no_hook_that_armcal_does_not_know, each_component_is_offered_once):
        results.append(_tried(own, f"plugin {plugin.name}", subject))
        if plugin.fault:
            return results
    return results + [result for component in registry.announced_by(plugin) for result in check_component(component)]


def _checked(kind: str, name: str, load: Callable[[], Any]) -> list[CheckResult]:
    subject = Subject(kind=kind, load=load, file="", heard=io.StringIO(), process=_process())
    results, ended = list[CheckResult](), False
    with redirect_stdout(subject.heard):
        for own in checks_of(kind):
            if not ended or own is it_prints_nothing_and_leaves_the_process_alone:
                results.append(_tried(own, f"{kind} {name}", subject))
                ended = ended or (own in NEEDED and bool(results[-1].fault or results[-1].not_run))
    return results


def _tried(check: Check, component: str, subject: Subject) -> CheckResult:
    name = check.__name__.replace("_", " ")
    try:
        check(subject)
    except NotRun as reason:
        return CheckResult(component, f"{name} (not run: {reason})", not_run=str(reason))
    except (Exception, SystemExit) as fault:  # whatever a plugin's code may raise; a user's interrupt passes
        text = " ".join(str(fault).split()) if isinstance(fault, ContractError) else said(fault)
        lines = [frame for frame in extract_tb(fault.__traceback__) if frame.filename == subject.file]
        shown = text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."
        place = f" ({Path(lines[-1].filename).name}:{lines[-1].lineno})" if lines else ""
        return CheckResult(component, name, f"{shown}{place}")
    return CheckResult(component, name)


def it_loads_with_no_hook_that_armcal_does_not_know(s: Subject) -> None:
    expect(not s.plugin.fault, s.plugin.fault)


def each_component_is_offered_once(s: Subject) -> None:
    for component in s.registry.announced_by(s.plugin):
        s.registry.find(component.kind, component.name)
