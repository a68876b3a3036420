"""What every check uses. A check is a function of the component under check; its name is what is checked."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from typing import Any

PLUGIN_FAULTS = (Exception, SystemExit)
"""Whatever a plugin's code may raise; a user's interrupt passes."""


class ContractError(Exception):
    """A component breaks the contract: what was found, and what was expected."""


class NotRun(Exception):  # noqa: N818 (not an error: a reason)
    """A check does not apply; the text says why."""


class Subject(SimpleNamespace):
    """A component under check, and what earlier checks made of it.

    Attributes:
        kind: what it is registered as.
        made: its class.
        example, settings: its example as a configuration would have it, and as settings.
    """

    kind: str
    made: Any
    example: dict[str, Any]
    settings: Any

    def build(self, *arguments: Any) -> Any:
        return self.made(self.settings, *arguments)


Check = Callable[[Subject], None]
NEEDED: set[Check] = set()


def needed(check: Check) -> Check:
    """Mark a check that those after it build on: unless it passes, they do not run."""
    NEEDED.add(check)
    return check


def expect(holds: bool, fault: str) -> None:
    """Raise ContractError unless something holds."""
    if not holds:
        raise ContractError(fault)


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
