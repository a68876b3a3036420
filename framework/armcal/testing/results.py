"""Results of checks, and a recorder that no fault of a plugin gets past."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
T = TypeVar("T")

MOST_CHARACTERS = 400
PLUGIN_FAULTS = (Exception, SystemExit)
"""Whatever a plugin's code may raise; a user's interrupt passes."""


@dataclass(frozen=True)
class CheckResult:
    """What one check found: nothing, if ``fault`` is empty.

    A check that could not run says why in ``not_run``, and at the end of ``check``: ``(not run: ...)``.
    """

    component: str
    check: str
    fault: str = ""
    not_run: str = ""


class ContractError(Exception):
    """A component breaks the contract: what was found, and what was expected."""


class NotRun(Exception):  # noqa: N818 (not an error: a reason)
    """A check does not apply; the text says why."""


@dataclass
class Recorder:
    """Runs checks on one component and keeps their results."""

    component: str
    results: list[CheckResult] = field(default_factory=list)

    def check(self, name: str, run: Callable[P, T], /, *arguments: P.args, **options: P.kwargs) -> T | None:
        """Run a check with these arguments; what it returned, or None if it found a fault or did not run."""
        try:
            value = run(*arguments, **options)
        except NotRun as reason:
            self.results.append(CheckResult(self.component, f"{name} (not run: {reason})", not_run=str(reason)))
        except PLUGIN_FAULTS as fault:
            self._add(name, said(fault))
        else:
            self._add(name)
            return value
        return None

    def guard(self, run: Callable[[], None]) -> None:
        """Run several checks; a fault that escapes them becomes a result."""
        try:
            run()
        except PLUGIN_FAULTS as fault:
            self._add("the remaining checks can run", said(fault))

    def _add(self, name: str, fault: str = "") -> None:
        self.results.append(CheckResult(self.component, name, fault))


def said(fault: BaseException) -> str:
    """What a fault says, on one line of bounded length."""
    try:
        text = " ".join(str(fault).split())
    except PLUGIN_FAULTS:
        text = "(its message cannot be read)"
    if not isinstance(fault, ContractError):
        text = f"{type(fault).__name__}: {text}"
    return text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."


def expect(holds: bool, fault: str) -> None:
    """Raise ContractError unless something holds."""
    if not holds:
        raise ContractError(fault)
