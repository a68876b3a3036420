"""Libraries that only parts of armcal need: which extra of the distribution brings one."""

from __future__ import annotations

from importlib import import_module, metadata
from typing import TYPE_CHECKING, Any

from armcal.errors import ArmcalError, PluginError

if TYPE_CHECKING:
    from packaging.requirements import Requirement

DISTRIBUTIONS = {"cv2": "opencv-python-headless", "PIL": "pillow", "serial": "pyserial", "yaml": "pyyaml"}
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
    name = DISTRIBUTIONS.get(module, module)
    members = {extra: [r.name for r in needed] for extra, needed in requirements().items() if extra}
    bringing = [extra for extra, names in members.items() if name in names]
    return min(bringing, key=lambda extra: len(members[extra]), default=None)


def requirements() -> dict[str, list[Requirement]]:
    """What armcal needs in any case, under the empty name, and what each extra adds; none of what its makers need."""
    from packaging.requirements import Requirement

    try:
        needed = [Requirement(text) for text in metadata.requires("armcal") or []]
        extras = metadata.metadata("armcal").get_all("Provides-Extra") or []
    except metadata.PackageNotFoundError:
        return {}
    always = [r for r in needed if r.marker is None or r.marker.evaluate({"extra": ""})]
    others = [r for r in needed if r.marker and r not in always]
    users = [extra for extra in extras if extra not in ("test", "dev", "docs", "bench")]
    return {
        "": always,
        **{name: [r for r in others if r.marker and r.marker.evaluate({"extra": name})] for name in users},
    }
