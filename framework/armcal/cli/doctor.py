"""``armcal doctor``. What loads a library does so in a process of its own: one that crashes costs that line alone."""

import json
import os
import platform
import signal
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import asdict, dataclass
from importlib import metadata
from importlib.util import find_spec
from pathlib import Path

import click
from packaging.requirements import Requirement

from armcal.errors import EXIT_BAD_INPUT
from armcal.plugins import DISTRIBUTIONS, discover, extra_of, requirements, said
from armcal.version import JSON_SCHEMA, SOURCES, __version__

LARGEST_MM = 1.0
"""Of the demonstration's held-out error: its noise alone is 0.8 mm."""
EXTRAS = {
    "online": "armcal recalibrate and mission",
    "convex": "the estimator cvxpy, cones in armcal recalibrate",
    "figures": "the figures of armcal mission and capability",
    "lerobot": "LeRobot's data sets",
    "camera": "boards found in images, boards to print (armcal board)",
    "i2c": "servo boards on this computer's own I2C bus (link linux_i2c)",
    "ros2": "recordings of ROS 2 (reader rosbag2, armcal bag)",
    "mujoco": "checking an export for MuJoCo by MuJoCo itself",
}
_MARKS = {"ok": ("ok  ", "green"), "note": ("-   ", None), "warning": ("warn", "yellow"), "fault": ("FAIL", "red")}
_TRIED = "import sys\ntry: {}\nexcept Exception as e: sys.exit(' '.join(f'{{type(e).__name__}}: {{e}}'.split())[:200])"


@dataclass(frozen=True)
class Finding:
    """One line of the report: a ``note`` is not there and not needed; a ``fault`` is that no arm can be calibrated."""

    section: str
    subject: str
    state: str
    text: str
    hint: str = ""


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
def doctor(as_json: bool) -> None:
    """Say what is installed and what is missing, and calibrate a simulated arm."""
    findings: list[Finding] = []
    for finding in examine():
        if not as_json:
            if finding.section not in [before.section for before in findings]:
                click.secho(f"\n{finding.section}", bold=True)
            mark, colour = _MARKS[finding.state]
            hint = f"\n     {finding.hint}" if finding.hint else ""
            click.echo(f"{click.style(mark, fg=colour)} {finding.subject}: {finding.text}{hint}")
        findings.append(finding)
    works = not any(finding.state == "fault" for finding in findings)
    broken = ", ".join(f.subject for f in findings if f.state in ("warning", "fault"))
    if as_json:
        content = {**JSON_SCHEMA, "works": works, "findings": [asdict(finding) for finding in findings]}
        click.echo(json.dumps(content, indent=2))
    elif works:
        rest = f"Arms can be calibrated here; what does not work: {broken}."
        click.echo(f"\n{rest if broken else 'Everything works.'}")
    if not works:
        click.echo(f"armcal: arms cannot be calibrated here; what does not work: {broken}.", err=True)
        sys.exit(EXIT_BAD_INPUT)


def examine() -> Iterator[Finding]:
    """Look at everything, in the order of the report."""
    python = f"{platform.python_version()} ({sys.executable}), {platform.platform()}"
    yield Finding("armcal", "Python", "ok", python)
    yield Finding("armcal", "armcal", "ok", f"{__version__} in {SOURCES}")
    yield from _libraries()
    out, fault = in_child("from armcal.cli.doctor import components; components()")
    if fault:
        hint = "armcal plugins check NAME tries one."
        yield Finding("plugins", "all plugins", "warning", f"cannot be loaded: {fault}", hint)
    else:
        yield from (Finding(*line) for line in json.loads(out.splitlines()[-1]))
    out, fault = in_child("from armcal.functions.compiler import find_compiler; print(find_compiler() or '')")
    text = "none found, and none is needed: large data take 40 times as long, with the same numbers"
    yield Finding("compiler", "C compiler", "ok" if out else "note", out.strip() or text)
    yield from _serial_ports()
    yield _main_job()


def in_child(code: str, *arguments: str, longest_s: float = 120.0) -> tuple[str, str]:
    """What a line of Python prints in a fresh interpreter, and its fault: one line, empty where there is none."""
    # -P: a file of the working directory called like a library is not taken for it, as it is not by the command.
    command = [sys.executable, "-P", "-c", _TRIED.format(code), *arguments]
    try:
        done = subprocess.run(
            command, capture_output=True, text=True, errors="replace", timeout=longest_s, stdin=subprocess.DEVNULL
        )
    except subprocess.TimeoutExpired:
        return "", f"it did not end within {longest_s:.0f} s"
    if done.returncode < 0:
        return "", f"the process crashed ({signal.strsignal(-done.returncode)})"
    if done.returncode or not done.stdout.strip():
        last = done.stderr.strip().rpartition("\n")[2]
        return "", last or f"the process ended with {done.returncode} and no answer"
    return done.stdout, ""


def _libraries() -> Iterator[Finding]:
    """What armcal declares, itself first, then what its extras do."""
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
        broken = [hint for _, state, _, hint in wrong if state != "note"]
        text = "; ".join([f"{name} {text}" for name, _, text, _ in wrong] or ["installed"])
        hint = f"If you want that: pip install 'armcal[{extra}]'." if wrong else ""
        state = "warning" if broken else "note" if wrong else "ok"
        yield Finding("extras", extra, state, f"{text}; for {EXTRAS[extra]}", broken[0] if broken else hint)


def look_at(requirement: Requirement) -> tuple[str, str, str]:
    """Whether a library is there (else a ``note``), imports, and is in the range (else a ``warning``); what to do."""
    name, pip = requirement.name, f"'{requirement.name}{requirement.specifier}'."
    pip = "-e . in the checkout." if name == "armcal" else pip
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
        hint = "Repair, update or uninstall it." if state == "warning" else ""
        findings.append(("plugins", plugin.name, state, text, hint))
    click.echo(json.dumps(findings))


def _serial_ports() -> Iterator[Finding]:
    """Those that may not be opened. None is: opening resets many boards."""
    for path in sorted(p for names in ("ttyACM*", "ttyUSB*", "ttyAMA*") for p in Path("/dev").glob(names)):
        with suppress(KeyError, OSError):  # its group has no name, or it was just unplugged
            if not os.access(path, os.R_OK | os.W_OK):
                text = f"this serial port of the group {path.group()} may not be opened by you"
                hint = f"If it is a group for ports: sudo usermod -aG {path.group()} $USER, then log in again."
                yield Finding("bench", str(path), "warning", text, hint)


def _main_job() -> Finding:
    with tempfile.TemporaryDirectory(prefix="armcal-doctor-") as place:
        _, fault = in_child("from armcal.cli.main import main; main()", "demo", "--out", f"{place}/demo")
        if not fault:
            metrics = json.loads(Path(place, "demo", "results", "metrics.json").read_text(encoding="utf-8"))
            off_mm = metrics["error_mm"]["calibrated"]["holdout"]["mean"]
            if off_mm < LARGEST_MM:
                return Finding("main job", "calibrate", "ok", f"a simulated arm was calibrated to {off_mm:.2f} mm")
            fault = f"it is off by {off_mm:.2f} mm, expected less than {LARGEST_MM:g} mm"
    text = f"a simulated arm cannot be calibrated: {fault}"
    return Finding("main job", "calibrate", "fault", text, "Mend what is marked above first.")
