"""One call for a plugin's own tests: that a component keeps the contract, and that enough was checked to say so."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib import import_module
from types import MappingProxyType
from typing import Any

from armcal.hooks import KINDS
from armcal.testing.contract import check_made
from armcal.testing.results import CheckResult

KNOWN_CHECKS: Mapping[str, int] = MappingProxyType(
    {
        "model": 28,
        "effect": 26,
        "measurement": 29,
        "reader": 23,
        "estimator": 22,
        "online": 20,
        "simulator": 14,
        "exporter": 15,
        "link": 18,
        "device": 39,
        "tracker": 18,
        "joints": 19,
        "bench": 13,
        "command": 2,
        "report_section": 2,
    }
)
"""How many checks run on any component of a kind; what a component has beside the rest adds to them."""


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
    results = check_made(kind, name, lambda: _loaded(component))
    faults = [f"  {result.check}: {result.fault}" for result in results if result.fault]
    left = [f"  {result.check}" for result in results if result.not_run]
    ran, expected = len(results) - len(left), KNOWN_CHECKS[kind] if at_least is None else at_least
    if faults:
        raise AssertionError("\n".join([f"{kind} {name} breaks the plugin contract:", *faults]))
    if ran < expected:
        raise AssertionError("\n".join([f"{kind} {name}: {ran} checks ran, expected at least {expected}.", *left]))
    return results


def _loaded(component: type | str) -> Any:
    if not isinstance(component, str):
        return component
    module, colon, attribute = component.partition(":")
    if not colon:
        raise ValueError(f"found {component!r}, expected module:attribute")
    return getattr(import_module(module), attribute)
