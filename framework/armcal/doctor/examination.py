"""All checks, in the order of the report; a check that fails is a finding, and stops none of the others."""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from importlib.metadata import entry_points
from typing import Any

from armcal.doctor import child, libraries, machine
from armcal.doctor.child import Finding, State
from armcal.doctor.libraries import DISTRIBUTION, Ask, installed

Check = Callable[[], Iterable[Finding]]
MOST_AT_ONCE = 4
_CORE = "Install armcal anew: pip install --force-reinstall armcal (or pip install -e . in a checkout)."


def examine(ask: Ask = child.ask) -> Iterator[Finding]:
    """Do everything, several checks at once; findings come in a fixed order as soon as they are there."""
    with ThreadPoolExecutor(max_workers=min(MOST_AT_ONCE, os.cpu_count() or 1)) as pool:
        for future in [pool.submit(_guarded, *check) for check in _checks(ask)]:
            yield from future.result()


def works(findings: Iterable[Finding]) -> bool:
    """Whether an arm can be calibrated."""
    return not any(finding.state == "fault" for finding in findings)


def _guarded(section: str, subject: str, check: Check) -> list[Finding]:
    """What a check finds; where it fails itself, that."""
    try:
        return list(check())
    except (Exception, SystemExit) as fault:  # a broken library that is imported here may raise anything
        return [Finding(section, subject, "warning", f"this cannot be looked at: {child.one_line(fault)}")]


def _checks(ask: Ask) -> Iterator[tuple[str, str, Check]]:
    always, extras = libraries.requirements()
    yield "armcal", "armcal", libraries.itself
    for one in always:
        yield "libraries", one.name, lambda r=one: [libraries.library(r, ask)]  # type: ignore[misc]
    for name, needed in extras.items():
        yield "extras", name, lambda n=name, r=needed: [libraries.extra(n, r, ask)]  # type: ignore[misc]
    yield "plugins", "plugins", lambda: plugins(ask)
    yield "solvers", "solvers", lambda: solvers(ask)
    yield "compiler", "C compiler", lambda: [compiler(ask)]
    yield "compiler", "cache", lambda: [machine.cache()]
    yield "bench", "serial ports", machine.serial_ports
    yield "bench", "I2C buses", machine.i2c_buses
    yield "machine", "room", machine.rooms
    yield "machine", "processors", lambda: [machine.processors()]
    yield "main job", "calibrate", lambda: [main_job(ask)]


def _tried(
    section: str, subject: str, content: Mapping[str, Any], good: str, broken: str, hint: str, state: State = "warning"
) -> Finding:
    """A finding on what a probe gave, which stands in ``good`` or ``broken`` by name; ``state`` where it is broken."""
    if "fault" in content:
        return Finding(section, subject, state, broken.format(**content), hint, content)
    return Finding(section, subject, "ok", good.format(**content), detail=content)


def plugins(ask: Ask) -> Iterator[Finding]:
    """Each plugin: whether its registration loads, then whether its components do."""
    content = ask("components")
    if "fault" in content:
        text = f"cannot be tried together: {content['fault']}"
        yield Finding("plugins", "all plugins", "warning", text, "What stands above and below says more.", content)
        # Registrations may fail on their own, and one of them may end the whole process.
        for point in sorted(entry_points(group=DISTRIBUTION), key=lambda p: p.name):
            own = ask("imported", point.module)
            if "fault" in own:
                text = f"does not load: {own['fault']}"
                yield Finding("plugins", point.name, "warning", text, "Uninstall it.", own)
        return
    if not content["plugins"]:
        yield Finding("plugins", "plugins", "fault", "found none, not even armcal's own", _CORE)
    for plugin in content["plugins"]:
        yield _plugin(plugin)


def _plugin(facts: Mapping[str, Any]) -> Finding:
    name, count, broken = facts["name"], facts["components"], facts["broken"]
    origin = f"({facts['distribution']})"
    if facts["fault"]:
        text = f"{origin} is left out: {facts['fault']}"
        return Finding("plugins", name, "warning", text, "Repair, update or uninstall it.", facts)
    if broken:
        lost = ", ".join(f"{b['kind']} {b['name']}" for b in broken)
        if all("extra" in b for b in broken):
            extra = broken[0]["extra"]
            text = f"{origin} {count} components; not without the extra {extra}: {lost}"
            return Finding("plugins", name, "note", text, f"If you want that: pip install 'armcal[{extra}]'.", facts)
        text = f"{origin} {len(broken)} of {count} do not load: {lost} ({broken[0]['fault']})"
        return Finding("plugins", name, "warning", text, f"armcal plugins check {name} says more.", facts)
    return Finding("plugins", name, "ok", f"{origin} {count} component{'' if count == 1 else 's'}", detail=facts)


def solvers(ask: Ask) -> Iterator[Finding]:
    """A tiny problem for each."""
    broken = "does not solve ({fault}): the estimator ipopt, which is the usual one, does not work"
    hint = "Install casadi anew: pip install --force-reinstall casadi."
    yield _tried("solvers", "IPOPT (in casadi)", ask("ipopt"), "solves", broken, hint)
    if installed("cvxpy"):  # the solver that armcal asks for, then the others
        content = ask("convex")
        faults = dict(content.get("solvers", {}))
        fault = content.get("fault") or faults.pop("CLARABEL", "")
        broken = "does not solve ({fault}): no estimator cvxpy, no certified bound of a plan, no cones"
        hint = "Install them anew: pip install --force-reinstall cvxpy clarabel."
        yield _tried("solvers", "CLARABEL (in cvxpy)", {"fault": fault} if fault else {}, "solves", broken, hint)
        for name, own in faults.items():
            text = f"{f'does not solve ({own})' if own else 'solves'}; armcal does not ask for it"
            yield Finding("solvers", f"{name} (in cvxpy)", "note" if own else "ok", text, detail={"fault": own or None})
    if installed("filterpy"):  # as armcal recalibrate uses it
        broken = "does not work ({fault}): armcal recalibrate cannot use its Kalman filters"
        hint = "Install it anew: pip install --force-reinstall filterpy."
        yield _tried("solvers", "Kalman filters (filterpy)", ask("kalman"), "work", broken, hint)


def compiler(ask: Ask) -> Finding:
    """The optional C compiler."""
    path = machine.compiler_path()
    slower = "every fit is interpreted by CasADi, with the same numbers: large data take 40 times as long"
    if path is None:
        hint = "If fits are slow: install gcc or clang."
        return Finding("compiler", "C compiler", "note", f"none found, and none is needed; {slower}", hint)
    good = "{path} makes a kernel with the same numbers in {compile_s:.1f} s, {times_faster:.0f} times as fast as "
    good += "without it (optional)"
    hint = "Name another with ARMCAL_CC, or turn it off with ARMCAL_CC=none."
    content = {"path": path, **ask("kernel")}
    return _tried("compiler", "C compiler", content, good, f"{{path}} does not serve ({{fault}}); {slower}", hint)


def main_job(ask: Ask) -> Finding:
    """Calibrate a small simulated arm, report and all."""
    good = "a simulated arm was calibrated to {off_mm:.3f} mm, with report and calibration file"
    broken, hint = "a simulated arm cannot be calibrated: {fault}", "Mend what is marked above first."
    return _tried("main job", "calibrate", ask("calibration"), good, broken, hint, "fault")
