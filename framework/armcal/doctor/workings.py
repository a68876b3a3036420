"""Plugins, solvers, the compiler, and the main job: whether an arm can be calibrated here."""

from collections.abc import Iterator, Mapping
from importlib.metadata import entry_points
from typing import Any

from armcal.doctor.finding import Finding
from armcal.doctor.libraries import DISTRIBUTION, Ask, installed

_CORE = "Install armcal anew: pip install --force-reinstall armcal (or pip install -e . in a checkout)."


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
    content = ask("ipopt")
    if "fault" in content:
        text = f"does not solve ({content['fault']}): the estimator ipopt, which is the usual one, does not work"
        hint = "Install casadi anew: pip install --force-reinstall casadi."
        yield Finding("solvers", "IPOPT (in casadi)", "warning", text, hint, content)
    else:
        yield Finding("solvers", "IPOPT (in casadi)", "ok", "solves", detail=content)
    if installed("cvxpy"):
        yield from _convex(ask)
    if installed("filterpy"):
        yield _kalman(ask)


def _kalman(ask: Ask) -> Finding:
    """Its filters, as armcal recalibrate uses them."""
    content = ask("kalman")
    if "fault" in content:
        text = f"does not work ({content['fault']}): armcal recalibrate cannot use its Kalman filters"
        hint = "Install it anew: pip install --force-reinstall filterpy."
        return Finding("solvers", "Kalman filters (filterpy)", "warning", text, hint, content)
    return Finding("solvers", "Kalman filters (filterpy)", "ok", "work")


def _convex(ask: Ask) -> Iterator[Finding]:
    """The solver that armcal asks for, then the others of cvxpy."""
    content = ask("convex")
    faults = dict(content.get("solvers", {}))
    fault = content.get("fault") or faults.pop("CLARABEL", "")
    if fault:
        text = f"does not solve ({fault}): no estimator cvxpy, no certified bound of a plan, no cones"
        hint = "Install them anew: pip install --force-reinstall cvxpy clarabel."
        yield Finding("solvers", "CLARABEL (in cvxpy)", "warning", text, hint, {"fault": fault})
    else:
        yield Finding("solvers", "CLARABEL (in cvxpy)", "ok", "solves")
    for name, own in faults.items():
        text = f"{f'does not solve ({own})' if own else 'solves'}; armcal does not ask for it"
        yield Finding("solvers", f"{name} (in cvxpy)", "note" if own else "ok", text, detail={"fault": own or None})


def compiler(ask: Ask) -> Finding:
    """The optional C compiler."""
    from armcal.doctor.machine import compiler_path

    path = compiler_path()
    slower = "every fit is interpreted by CasADi, with the same numbers: large data take 40 times as long"
    if path is None:
        hint = "If fits are slow: install gcc or clang."
        return Finding("compiler", "C compiler", "note", f"none found, and none is needed; {slower}", hint)
    content = ask("kernel")
    facts = {"path": path, **content}
    if "fault" in content:
        text = f"{path} does not serve ({content['fault']}); {slower}"
        hint = "Name another with ARMCAL_CC, or turn it off with ARMCAL_CC=none."
        return Finding("compiler", "C compiler", "warning", text, hint, facts)
    text = (
        f"{path} makes a kernel with the same numbers in {content['compile_s']:.1f} s, "
        f"{content['times_faster']:.0f} times as fast as without it (optional)"
    )
    return Finding("compiler", "C compiler", "ok", text, detail=facts)


def main_job(ask: Ask) -> Finding:
    """Calibrate a small simulated arm, report and all."""
    content = ask("calibration")
    if "fault" in content:
        text = f"a simulated arm cannot be calibrated: {content['fault']}"
        return Finding("main job", "calibrate", "fault", text, "Mend what is marked above first.", content)
    text = f"a simulated arm was calibrated to {content['off_mm']:.3f} mm, with report and calibration file"
    return Finding("main job", "calibrate", "ok", text, detail=content)
