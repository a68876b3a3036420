"""Python, armcal itself, the libraries that it declares, and its extras."""

import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from importlib import metadata
from importlib.util import find_spec
from types import MappingProxyType
from typing import Any

from packaging.requirements import Requirement
from packaging.utils import canonicalize_name

from armcal.doctor.child import Finding, State
from armcal.version import SOURCES, __version__

DISTRIBUTION = "armcal"


@dataclass(frozen=True)
class Purpose:
    """A library: the module that armcal imports, what is lost without it, and whether calibrating needs it."""

    module: str
    lost: str
    needed: bool = False


_EVERYTHING = "nothing can be calibrated"

LIBRARIES: Mapping[str, Purpose] = MappingProxyType(
    {
        "numpy": Purpose("numpy", _EVERYTHING, needed=True),
        "scipy": Purpose("scipy.optimize", _EVERYTHING, needed=True),
        "casadi": Purpose("casadi", _EVERYTHING, needed=True),
        "pluggy": Purpose("pluggy", "no plugin is found, so nothing can be calibrated", needed=True),
        "pyyaml": Purpose("yaml", "no configuration can be read", needed=True),
        "pydantic": Purpose("pydantic", "no configuration can be checked", needed=True),
        "click": Purpose("click", "the command armcal does not start", needed=True),
        "rich": Purpose("rich.console", "no command but this one runs", needed=True),
        "jinja2": Purpose("jinja2", "no report can be written", needed=True),
        "pyserial": Purpose("serial", "no servo board on a serial port"),
        "typing-extensions": Purpose(
            "typing_extensions", "no application of armcal runs, and some devices do not", needed=True
        ),
        "packaging": Purpose("packaging", "armcal doctor does not run", needed=True),
        "joblib": Purpose("joblib", "folds, starts and studies run in one process only"),
    }
)

EXTRAS: Mapping[str, str] = MappingProxyType(
    {
        "online": "armcal recalibrate and mission",
        "convex": "the estimator cvxpy, certified bounds of a plan for E, cones in armcal recalibrate",
        "figures": "the figures of armcal mission, capability and acceptance",
        "lerobot": "LeRobot's data sets",
        "camera": "boards found in images, boards to print (armcal board)",
        "i2c": "servo boards on this computer's own I2C bus (link linux_i2c)",
        "ros2": "recordings of ROS 2 (reader rosbag2, armcal bag)",
        "mujoco": "checking an export for MuJoCo by MuJoCo itself",
        "bench": "make bench: comparing armcal with other programs",
        "docs": "make docs: this documentation as pages",
        "test": "make test: armcal's own tests",
        "dev": "make lint and make types",
    }
)

EXTRA_MODULES: Mapping[str, str] = MappingProxyType(
    {
        "cvxpy": "cvxpy",
        "filterpy": "filterpy.kalman",
        "matplotlib": "matplotlib.figure",
        "smbus2": "smbus2",
        "mujoco": "mujoco",
        "pin": "pinocchio",
    }
)
"""Libraries of extras that are imported to see whether they work; of the others the version is enough."""


Ask = Callable[..., Mapping[str, Any]]
"""``armcal.doctor.child.ask``, or what a test puts in its place."""

_ANEW = "Install it anew: pip install --force-reinstall"


def itself() -> Iterator[Finding]:
    """Python and armcal."""
    where = str(SOURCES)
    version = platform.python_version()
    facts = {"version": version, "executable": sys.executable, "platform": platform.platform()}
    yield Finding("armcal", "Python", "ok", f"{version} ({sys.executable}), {platform.platform()}", detail=facts)
    version_text = installed(DISTRIBUTION)
    facts = {"version": __version__, "metadata": version_text or "", "path": where}
    if version_text is None:
        text, hint = "it can be imported, but is not installed: no plugin is found", "Install it: pip install -e ."
        yield Finding("armcal", "armcal", "fault", f"{__version__} in {where}: {text}", hint, facts)
    elif version_text != __version__:
        text = f"{__version__} in {where}, but it was installed as {version_text}: plugins may be missing"
        yield Finding("armcal", "armcal", "warning", text, "Install it anew: pip install -e .", facts)
    else:
        yield Finding("armcal", "armcal", "ok", f"{version_text}, in {where}", detail=facts)


def library(requirement: Requirement, ask: Ask) -> Finding:
    """One library that armcal declares: whether it imports, in what time, and whether its version is in the range."""
    key, range_text = canonicalize_name(requirement.name), str(requirement.specifier)
    purpose = LIBRARIES.get(key) or Purpose(key.replace("-", "_"), "a part of armcal")
    version, content = installed(requirement.name), ask("imported", purpose.module)
    facts = {"version": version, "range": range_text, "needed": purpose.needed, **content}
    pip = f"pip install '{requirement.name}{range_text}'."

    def finding(state: State, text: str, hint: str = "") -> Finding:
        return Finding("libraries", requirement.name, state, text, hint, facts)

    broken: State = "fault" if purpose.needed else "warning"
    if "fault" in content:
        if version is None:
            return finding(broken, f"not installed: {purpose.lost}", f"Install it: {pip}")
        text = f"{version} does not load{_origin(purpose.module)} ({content['fault']}): {purpose.lost}"
        return finding(broken, text, f"{_ANEW} '{requirement.name}{range_text}'.")
    shown = f"{version or 'of no known version'}, loads in {content['import_s']:.2f} s"
    if version and not requirement.specifier.contains(version, prereleases=True):
        return finding("warning", f"{shown}, but armcal asks for {range_text}", f"Change it: {pip}")
    return finding("ok", shown)


def _origin(module: str) -> str:
    """Where a module is taken from: another file may stand in a library's way."""
    try:
        spec = find_spec(module.partition(".")[0])
    except (ImportError, ValueError):
        return ""
    return f" from {spec.origin}" if spec and spec.origin else ""


def extra(name: str, needed: tuple[Requirement, ...], ask: Ask) -> Finding:
    """One extra: what of it is missing, and what it would be good for."""
    use = EXTRAS.get(name, "what its name says")
    missing = [r.name for r in needed if installed(r.name) is None]
    facts = {"missing": missing, "for": use}
    hint = f"If you want that: pip install '{DISTRIBUTION}[{name}]'."
    if missing:
        return Finding("extras", name, "note", f"not here: {', '.join(missing)}; for {use}", hint, facts)
    for requirement in needed:
        module = EXTRA_MODULES.get(canonicalize_name(requirement.name))
        content = ask("imported", module) if module else {}
        if "fault" in content:
            text = f"{requirement.name} does not load{_origin(module or '')} ({content['fault']}); for {use}"
            return Finding("extras", name, "warning", text, f"{_ANEW} '{requirement.name}'.", facts)
    versions = [(r, installed(r.name) or "0") for r in needed]
    old = [f"{r.name} {v} ({r.specifier})" for r, v in versions if not r.specifier.contains(v, prereleases=True)]
    if old:
        return Finding("extras", name, "warning", f"out of range: {', '.join(old)}; for {use}", hint, facts)
    return Finding("extras", name, "ok", f"installed; for {use}", detail=facts)


def installed(name: str) -> str | None:
    """The installed version of a distribution, or None."""
    try:
        return metadata.version(name)
    except metadata.PackageNotFoundError:
        return None


def requirements() -> tuple[tuple[Requirement, ...], Mapping[str, tuple[Requirement, ...]]]:
    """What armcal always needs, and each extra's own (``all`` has none); without metadata, what is listed here."""
    try:
        everything = [Requirement(text) for text in metadata.requires(DISTRIBUTION) or []]
        names = list(metadata.metadata(DISTRIBUTION).get_all("Provides-Extra") or [])
    except metadata.PackageNotFoundError:
        everything, names = [Requirement(name) for name in LIBRARIES], []
    always = tuple(r for r in everything if r.marker is None or r.marker.evaluate({"extra": ""}))
    others = [r for r in everything if r.marker and r not in always]
    names = [name for name in names if name != "all"]
    return always, {name: tuple(r for r in others if r.marker and r.marker.evaluate({"extra": name})) for name in names}
