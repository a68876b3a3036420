"""``armcal doctor``. What loads a library does so in a process of its own: one that crashes costs that line alone."""

import json
import platform
import signal
import subprocess
import sys
import tempfile
from collections import namedtuple
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from importlib import metadata
from importlib.util import find_spec

import click
from packaging.requirements import Requirement

from armcal.errors import EXIT_BAD_INPUT
from armcal.plugins import DISTRIBUTIONS, discover, extra_of, requirements, said
from armcal.version import JSON_SCHEMA, SOURCES, __version__

EXTRAS = {
    "online": "armcal recalibrate and mission",
    "convex": "the estimator cvxpy, cones in armcal recalibrate",
    "figures": "the figure of armcal mission",
    "lerobot": "LeRobot's data sets",
    "camera": "boards found in images, boards to print (armcal board)",
    "i2c": "servo boards on this computer's own I2C bus (link linux_i2c)",
    "ros2": "recordings of ROS 2 (reader rosbag2, armcal bag)",
    "mujoco": "checking an export for MuJoCo by MuJoCo itself",
}
_MARKS = {"ok": ("ok  ", "green"), "note": ("-   ", None), "warning": ("warn", "yellow"), "fault": ("FAIL", "red")}
_TRIED = "import sys\ntry: {}\nexcept Exception as e: sys.exit(' '.join(f'{{type(e).__name__}}: {{e}}'.split())[:200])"


# One line of the report: a `note` is not there and not needed; a `fault` is that no arm can be calibrated.
Finding = namedtuple("Finding", ("section", "subject", "state", "text", "hint"), defaults=("",))


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
def doctor(as_json: bool) -> None:
    """Say what is installed and what is missing, and calibrate a simulated arm."""
    findings, section = list[Finding](), ""
    for finding in examine():
        findings.append(finding)
        if not as_json:
            click.secho(f"\n{finding.section}\n" * (finding.section != section), bold=True, nl=False)
            mark, hint = (
                click.style(_MARKS[finding.state][0], _MARKS[finding.state][1]),
                f"\n     {finding.hint}" if finding.hint else "",
            )
            click.echo(f"{mark} {finding.subject}: {finding.text}{hint}")
        section = finding.section
    works = findings[-1].state == "ok"
    broken = ", ".join(finding.subject for finding in findings if finding.state in ("warning", "fault"))
    if as_json:
        listed = [finding._asdict() for finding in findings]
        click.echo(json.dumps({**JSON_SCHEMA, "works": works, "findings": listed}, indent=2))
    elif works:
        click.echo(f"\nArms can be calibrated here; what does not work: {broken}." if broken else "\nEverything works.")
    if not works:
        click.echo(f"armcal: arms cannot be calibrated here; what does not work: {broken}.", err=True)
        sys.exit(EXIT_BAD_INPUT)


def examine() -> Iterator[Finding]:
    python = f"{platform.python_version()} ({sys.executable}), {platform.platform()}; armcal in {SOURCES}"
    yield Finding("armcal", "Python", "ok", python)
    needs = {name: needed for name, needed in requirements().items() if name != "all"}
    always = [Requirement(f"armcal=={__version__}"), *needs.pop("", [])]
    every = {r.name: r for r in [*always, *(r for needed in needs.values() for r in needed)]}
    with ThreadPoolExecutor(max_workers=4) as pool:
        looked = dict(zip(every, pool.map(look_at, every.values()), strict=True))
    for name in [r.name for r in always]:
        state, text, hint = looked[name]
        yield Finding("libraries", name, "warning" if state == "note" else state, text, hint)
    for extra, needed in needs.items():
        wrong = [(r.name, *looked[r.name]) for r in needed if looked[r.name][0] != "ok"]
        broken = [("warning", hint) for _, state, _, hint in wrong if state != "note"]
        state, hint = (
            [*broken, ("note", f"If you want that: pip install 'armcal[{extra}]'.")][0] if wrong else ("ok", "")
        )
        text = "; ".join([f"{name} {text}" for name, _, text, _ in wrong] or ["installed"])
        yield Finding("extras", extra, state, f"{text}; for {EXTRAS[extra]}", hint)
    out, fault = in_child("from armcal.cli.doctor import components; components()")
    odd = ("plugins", "all plugins", "warning", f"cannot be loaded: {fault}", "armcal plugins check NAME tries one.")
    yield from (Finding(*line) for line in ([odd] if fault else json.loads(out.splitlines()[-1])))
    out, _ = in_child("from armcal.functions.compiler import find_compiler; print(find_compiler() or '')")
    text = "none found, and none is needed: large data take 40 times as long, with the same numbers"
    yield Finding("compiler", "C compiler", "ok" if out else "note", out.strip() or text)
    with tempfile.TemporaryDirectory(prefix="armcal-doctor-") as place:  # the run's own verdict ends it where it is off
        _, fault = in_child("from armcal.cli.main import main; main()", "demo", "--out", f"{place}/demo")
    text = f"a simulated arm cannot be calibrated: {fault}" if fault else "a simulated arm was calibrated"
    yield Finding("main job", "calibrate", *(("fault", text, "Mend what is marked above.") if fault else ("ok", text)))


def in_child(code: str, *arguments: str, longest_s: float = 120.0) -> tuple[str, str]:
    """What a line of Python prints in a fresh interpreter, and its fault: one line, empty where there is none."""
    # -P: a file of the working directory called like a library is not taken for it, as it is not by the command.
    command, quiet = [sys.executable, "-P", "-c", _TRIED.format(code), *arguments], subprocess.DEVNULL
    try:
        done = subprocess.run(command, capture_output=True, text=True, errors="replace", timeout=longest_s, stdin=quiet)
    except subprocess.TimeoutExpired:
        return "", f"it did not end within {longest_s:.0f} s"
    if done.returncode < 0:
        return "", f"the process crashed ({signal.strsignal(-done.returncode)})"
    if done.returncode or not done.stdout.strip():
        said_last = done.stderr.strip().rpartition("\n")[2]
        return "", said_last or f"the process ended with {done.returncode} and no answer"
    return done.stdout, ""


def look_at(requirement: Requirement) -> tuple[str, str, str]:
    """Whether a library is there (else a ``note``), imports, and is in the range (else a ``warning``); what to do."""
    name = requirement.name
    pip = "-e . in the checkout." if name == "armcal" else f"'{name}{requirement.specifier}'."
    try:
        version = metadata.version(name)
    except metadata.PackageNotFoundError:
        return "note", "is not installed", f"Run pip install {pip}"
    module = next((m for m, other in DISTRIBUTIONS.items() if other == name), name.replace("-", "_"))
    _, fault = in_child(f"import {module}; print('loaded')")
    if fault:
        text = f"{version} does not load from {getattr(find_spec(module), 'origin', 'anywhere')} ({fault})"
        return "warning", text, f"Run pip install --force-reinstall {pip}"
    if not requirement.specifier.contains(version, prereleases=True):
        return "warning", f"{version} is not in the range {requirement.specifier}", f"Run pip install {pip}"
    return "ok", version, ""


def components() -> None:
    """In a child: load every component, and print a finding for each plugin."""
    findings, registry = [], discover()
    for plugin in registry.plugins:
        own, faults, absent = registry.announced_by(plugin), [plugin.fault] if plugin.fault else [], 0
        for component in own:
            try:
                component.load()
            except Exception as fault:
                cause = fault.__cause__
                absent += isinstance(cause, ModuleNotFoundError) and extra_of(cause.name or "") is not None
                faults.append(said(fault))
        state = "ok" if not faults else "note" if absent == len(faults) else "warning"
        text = "; ".join([f"({plugin.distribution} {plugin.version}) components: {len(own)}", *faults])
        findings.append(
            ("plugins", plugin.name, state, text, "Repair, update or uninstall it." if state == "warning" else "")
        )
    click.echo(json.dumps(findings))
