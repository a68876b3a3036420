"""Libraries that only parts of armcal need: which extra of the distribution brings one."""

from __future__ import annotations

from importlib import import_module, metadata
from typing import Any

from armcal.errors import ArmcalError, PluginError

_DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow"}
"""Of modules that are called otherwise than the distribution that they come with."""


def library(module: str, needed_by: str) -> Any:
    """A library that only ``needed_by`` needs ("reading images").

    Raises:
        ArmcalError: it is not installed, or does not load.
    """
    try:
        return import_module(module)
    except ImportError as fault:
        raise missing_library(fault, needed_by) from fault


def missing_library(fault: ImportError, needed_by: str = "this") -> ArmcalError:
    """What to say of a library that is not installed, or does not load.

    Raises:
        ImportError: it is a module of armcal: a fault of ours, not of the installation.
    """
    absent = isinstance(fault, ModuleNotFoundError)
    module = (fault.name or ("armcal" if absent else "")).partition(".")[0]
    if module == "armcal":
        raise fault
    if absent and (extra := extra_of(module)):
        text = f"{needed_by} needs the library {module}, which is not installed."
        return PluginError(text, hint=f"Run pip install 'armcal[{extra}]'.")
    text = f"the library {fault.name} is missing." if absent else f"a library cannot be loaded ({fault})."
    return ArmcalError(
        text, hint="Install armcal anew with all it needs: pip install armcal. `armcal doctor` names what is broken."
    )


def extra_of(module: str) -> str | None:
    """The smallest extra that brings a module; None where none does."""
    from packaging.requirements import Requirement

    try:
        needed = [Requirement(text) for text in metadata.requires("armcal") or []]
        extras = metadata.metadata("armcal").get_all("Provides-Extra") or []
    except metadata.PackageNotFoundError:
        return None
    members = {
        extra: [r.name for r in needed if r.marker and r.marker.evaluate({"extra": extra})]
        for extra in extras
        if extra not in ("test", "dev", "docs", "bench")
    }
    bringing = [extra for extra, names in members.items() if _DISTRIBUTIONS.get(module, module) in names]
    return min(bringing, key=lambda extra: len(members[extra]), default=None)
