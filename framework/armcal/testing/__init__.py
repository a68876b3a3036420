"""What a plugin must keep to, as checks: ``assert_contract`` in a plugin's own tests, or ``armcal plugins check``."""

from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from armcal.testing.contract import assert_contract

__all__ = ["EXAMPLE_TRUTH", "assert_contract"]

EXAMPLE_TRUTH = Path(__file__).with_name("truth.yaml")
"""A truth for a simulator's ``EXAMPLE``: values of the planar arm that the checks put before it."""


def __getattr__(name: str) -> Any:
    """The checks, imported when they are first asked for: components under check import this package too."""
    if name == "assert_contract":
        return getattr(import_module("armcal.testing.contract"), name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
