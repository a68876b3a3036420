"""Results of checks, and a recorder that no fault of a plugin gets past."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field

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


class _Ended(Exception):  # noqa: N818 (not an error: the end of a group of checks)
    """A check failed that the rest of its group needs."""


@dataclass
class Recorder:
    """The results of the checks on one component: each check is the block of a ``with`` statement."""

    component: str
    results: list[CheckResult] = field(default_factory=list)

    @contextmanager
    def check(self, name: str) -> Iterator[None]:
        """Record whether the block ends, finds a fault or does not run; what follows it goes on."""
        result = CheckResult(self.component, name)
        try:
            yield
        except NotRun as reason:
            result = CheckResult(self.component, f"{name} (not run: {reason})", not_run=str(reason))
        except PLUGIN_FAULTS as fault:
            result = CheckResult(self.component, name, said(fault))
        self.results.append(result)

    @contextmanager
    def needed(self, name: str) -> Iterator[None]:
        """The same of a check that those after it build on: unless it passes, their group ends."""
        with self.check(name):
            yield
        if self.results[-1].fault or self.results[-1].not_run:
            raise _Ended

    @contextmanager
    def group(self) -> Iterator[None]:
        try:
            yield
        except _Ended:
            pass
        except PLUGIN_FAULTS as fault:
            self.results.append(CheckResult(self.component, "the remaining checks can run", said(fault)))


def said(fault: BaseException) -> str:
    try:
        text = " ".join(str(fault).split())
    except PLUGIN_FAULTS:
        text = "(its message cannot be read)"
    if not isinstance(fault, ContractError):
        text = f"{type(fault).__name__}: {text}"
    return text if len(text) <= MOST_CHARACTERS else f"{text[: MOST_CHARACTERS - 3]}..."


@contextmanager
def raises_only(*allowed: type[Exception], expected: str = "", when: str = "") -> Iterator[None]:
    """Errors that the block may raise; any other is a fault, which names the first of these or ``expected``."""
    passing: tuple[type[Exception], ...] = (ContractError, *allowed)
    try:
        yield
    except passing:
        raise
    except Exception as fault:
        expected = expected or f"{allowed[0].__module__}.{allowed[0].__name__}"
        raise ContractError(f"found {type(fault).__name__} ({fault}){when}, expected {expected}") from fault


def expect(holds: bool, fault: str) -> None:
    """Raise ContractError unless something holds."""
    if not holds:
        raise ContractError(fault)
