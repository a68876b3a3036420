"""Python, armcal itself, the libraries that it declares, and its extras."""

from __future__ import annotations

import platform
import sys
from collections.abc import Callable, Iterator, Mapping
from importlib import metadata
from importlib.util import find_spec
from typing import Any

from armcal.doctor.finding import Finding, State
from armcal.doctor.purposes import EXTRA_MODULES, EXTRAS, LIBRARIES, Purpose
from armcal.doctor.requirements import DISTRIBUTION, Requirement, declared, installed
from armcal.version import SOURCES, __version__

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
    purpose = LIBRARIES.get(requirement.key) or Purpose(requirement.key.replace("-", "_"), "a part of armcal")
    version, content = installed(requirement.name), ask("imported", purpose.module)
    facts = {"version": version, "range": requirement.range, "needed": purpose.needed, **content}
    pip = f"pip install '{requirement.name}{requirement.range}'."

    def finding(state: State, text: str, hint: str = "") -> Finding:
        return Finding("libraries", requirement.name, state, text, hint, facts)

    broken: State = "fault" if purpose.needed else "warning"
    if "fault" in content:
        if version is None:
            return finding(broken, f"not installed: {purpose.lost}", f"Install it: {pip}")
        text = f"{version} does not load{_origin(purpose.module)} ({content['fault']}): {purpose.lost}"
        return finding(broken, text, f"{_ANEW} '{requirement.name}{requirement.range}'.")
    shown = f"{version or 'of no known version'}, loads in {content['import_s']:.2f} s"
    if version and not requirement.admits(version):
        return finding("warning", f"{shown}, but armcal asks for {requirement.range}", f"Change it: {pip}")
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
        module = EXTRA_MODULES.get(requirement.key)
        content = ask("imported", module) if module else {}
        if "fault" in content:
            text = f"{requirement.name} does not load ({content['fault']}); for {use}"
            return Finding("extras", name, "warning", text, f"{_ANEW} '{requirement.name}'.", facts)
    old = [f"{r.name} {installed(r.name)} ({r.range})" for r in needed if not r.admits(installed(r.name) or "")]
    if old:
        return Finding("extras", name, "warning", f"out of range: {', '.join(old)}; for {use}", hint, facts)
    return Finding("extras", name, "ok", f"installed; for {use}", detail=facts)


def requirements() -> tuple[tuple[Requirement, ...], Mapping[str, tuple[Requirement, ...]]]:
    """What armcal always needs, and each extra's own; what this list knows where metadata is missing."""
    try:
        everything = declared()
    except metadata.PackageNotFoundError:
        everything = tuple(Requirement(name, "") for name in LIBRARIES)
    always = tuple(r for r in everything if not r.extra)
    names = dict.fromkeys(r.extra for r in everything if r.extra)
    return always, {name: tuple(r for r in everything if r.extra == name) for name in names}
