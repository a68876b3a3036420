"""What every check uses. A check is a function of the component under check; its name is what is checked."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np


class ContractError(Exception):
    """A component breaks the contract: what was found, and what was expected."""


class NotRun(Exception):  # noqa: N818 (not an error: a reason)
    """A check does not apply; the text says why."""


class Subject(SimpleNamespace):
    """A component under check, and what earlier checks made of it."""

    kind: str  # what it is registered as
    made: Any  # its class
    example: dict[str, Any]  # as a configuration would have it
    settings: Any  # of its example
    arguments: tuple[Any, ...]  # what it was built with last, beside its settings

    def build(self, *arguments: Any) -> Any:
        self.arguments = arguments
        return self.made(self.settings, *arguments)

    def with_settings(self, **settings: Any) -> Any:
        return self.made(self.made.Settings.model_validate({**self.example, **settings}))


Check = Callable[[Subject], None]
CHECKS: dict[str, list[Check]] = {}  # by kind, in this order, after what every component is checked for
NEEDED: set[Check] = set()
RESULTS: dict[str, Callable[[Subject, Any], object]] = {}  # by kind what a component gives: the same each time


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
    if not holds:
        raise ContractError(fault)


JOINTS = ("q1", "q2", "q3")
_BUILT_OF: dict[str, tuple[tuple[Any, ...], ...]] = {  # beside its settings: the first that it does not refuse
    "effect": ((JOINTS,),),
    "residual": ((JOINTS,),),
    "measurement": ((("arm",),), (("left", "right"),)),
}


@check("model", "effect", "residual", "measurement", "reader", "simulator", "exporter", needed=True)
@check("estimator", "online", "link", "bench", "tracker", "joints", "camera", needed=True)
def it_builds(s: Subject) -> None:
    choices = _BUILT_OF.get(s.kind, ((),))
    for arguments in choices:
        try:
            s.built = s.build(*arguments)
            break
        except Exception:
            if arguments == choices[-1]:
                raise


def it_is_the_same_each_time(s: Subject) -> None:
    """To the last bit: asked twice, and a second one of equal settings."""
    first = RESULTS[s.kind](s, s.built)
    again = {
        "when it was asked a second time": s.built,
        "from a second component of equal settings: it keeps something between calls": s.build(*s.arguments),
    }
    for when, built in again.items():
        try:
            np.testing.assert_equal(RESULTS[s.kind](s, built), first)
        except AssertionError as difference:
            raise ContractError(f"found other results {when}") from difference
