"""A measuring run against a simulated bench, in a process of its own."""

import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from armcal.devices.clock import SimulatedClock
from armcal.devices.simulated import BOARD, CLOCK
from armcal.errors import EXIT_BAD_INPUT, ArmcalError, ConfigError, InputError, PluginError
from armcal.io.plain_files import writing
from armcal.run.experiment import Experiment

from armcal_bench.bench import SECTION, Bench

_STARTED_IN_S = 60.0
_ENDED_IN_S = 10.0
_FALLEN_IN_S = 5.0


def overrides_for(folder: Path, part: str = "link") -> tuple[str, ...]:
    """The overrides that make a configuration work with the simulated bench in a folder.

    ``part``: of the bench, which has the serial port: see ``part_with_port``.
    """
    there = folder.absolute()
    return (f"bench.clock={{simulated: {there / CLOCK}}}", f"bench.{part}.port={there / BOARD}")


def part_with_port(experiment: Experiment) -> str:
    """``link``, or ``device`` for one that needs no link.

    Raises:
        ConfigError: there is no bench.
    """
    settings = Bench.of(experiment).settings
    return "device" if settings.link is None and settings.device is not None else "link"


def port_instead_of_adapter(experiment: Experiment) -> tuple[str, ...]:
    """Further overrides if its port is named by an adapter: simulated ones have no serial number.

    Raises:
        ConfigError: its link has no serial port, or there is no bench.
    """
    part = part_with_port(experiment)
    stated: dict[str, Any] = getattr(Bench.of(experiment).settings, part) or {}
    try:
        component = experiment.registry.find(part, str(stated.get("type")))
    except PluginError:
        return ()  # whoever builds it says so, and where
    settings = getattr(component.load(), "Settings", None)
    if "port" not in getattr(settings, "model_fields", ("port",)):
        raise ConfigError(
            f"found the {part} {component.name}, expected one with a serial port: simulated boards have nothing else.",
            where=experiment.source.where((SECTION, part)),
            hint=f"Rehearse with the link of the simulated firmware: --set {SECTION}.link='{{type: framed}}'.",
        )
    return (f"{SECTION}.{part}.serial_number=null",) if "serial_number" in stated else ()


@contextmanager
def simulated_bench(config: Path, overrides: Sequence[str], folder: Path) -> Iterator[None]:
    """A simulated bench in a folder, from when it answers until the context ends.

    Raises:
        InputError: the folder cannot be used, or the bench does not start; its own words are in the message.
    """
    make_bench_folder(folder)
    sets = [word for text in overrides for word in ("--set", text)]
    # -P: a file of the working directory called like a library is not taken for it, as it is not by the command.
    command = [sys.executable, "-P", "-m", "armcal.cli", "simulated-bench", str(config), "--dir", str(folder), *sets]
    with (folder / "said.txt").open("w+", encoding="utf-8") as output:
        process = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=output, stderr=output)
        try:
            _wait_for(process, folder)
            yield
        finally:
            process.terminate()
            try:
                process.wait(_ENDED_IN_S)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait()


def truth(folder: Path) -> dict[str, Any]:
    """What the simulated bench knows, once the arm has come to hang: its true state, and what was unsafe.

    Raises:
        InputError: it does not answer.
    """
    clock = SimulatedClock(folder / CLOCK)
    try:
        return clock.ask({"advance": _FALLEN_IN_S, "state": True})
    finally:
        clock.close()


def make_bench_folder(folder: Path) -> None:
    """Make the folder of a simulated bench.

    Raises:
        InputError: it cannot be made.
    """
    with writing(folder, "Give a folder that can be written."):
        folder.mkdir(parents=True, exist_ok=True)


def _wait_for(process: subprocess.Popen[bytes], folder: Path) -> None:
    """Until the simulated bench in a folder answers."""
    until = time.monotonic() + _STARTED_IN_S
    while time.monotonic() < until:
        if process.poll() is not None:
            fault = InputError if process.returncode == EXIT_BAD_INPUT else ArmcalError
            words = (folder / "said.txt").read_text(encoding="utf-8").strip()[-2000:]
            raise fault(f"the simulated bench ended before it began: {words}")
        if (folder / CLOCK).exists():
            try:
                SimulatedClock(folder / CLOCK).close()
                return
            except InputError:
                pass
        time.sleep(0.05)
    raise ArmcalError(f"the simulated bench did not start in {_STARTED_IN_S:.0f} s.")
