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
CHECKS: dict[str, list[Check]] = {}
"""Of each kind what is checked, in this order, after what every component is checked for."""
NEEDED: set[Check] = set()


def check(*kinds: str, needed: bool = False) -> Callable[[Check], Check]:
    """Make a function a check of these kinds; unless one that is ``needed`` passes, those after it do not run."""

    def listed(function: Check) -> Check:
        for kind in kinds:
            CHECKS.setdefault(kind, []).append(function)
        if needed:
            NEEDED.add(function)
        return function

    return listed


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


@check("reader", "simulator", "exporter", "estimator", "online", "link", "bench", needed=True)
@check("tracker", "joints", "camera", needed=True)
def it_builds(s: Subject) -> None:
    s.built = s.build()
