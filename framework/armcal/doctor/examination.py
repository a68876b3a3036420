"""All checks, in the order of the report; a check that fails is a finding, and stops none of the others."""

import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass

from armcal.doctor import child, libraries, machine, workings
from armcal.doctor.finding import Finding

Check = Callable[[], Iterable[Finding]]
MOST_AT_ONCE = 4


@dataclass(frozen=True)
class _Named:
    """A check, and what a finding is called when the check itself fails."""

    section: str
    subject: str
    check: Check


def examine(ask: libraries.Ask = child.ask) -> Iterator[Finding]:
    """Do everything, several checks at once; findings come in a fixed order as soon as they are there."""
    with ThreadPoolExecutor(max_workers=min(MOST_AT_ONCE, os.cpu_count() or 1)) as pool:
        waiting: list[Future[list[Finding]]] = [pool.submit(_guarded, named) for named in _checks(ask)]
        for future in waiting:
            yield from future.result()


def works(findings: Iterable[Finding]) -> bool:
    """Whether an arm can be calibrated."""
    return not any(finding.state == "fault" for finding in findings)


def _guarded(named: _Named) -> list[Finding]:
    try:
        return list(named.check())
    except (Exception, SystemExit) as fault:  # a broken library that is imported here may raise anything
        text = f"this cannot be looked at: {child.one_line(fault)}"
        return [Finding(named.section, named.subject, "warning", text)]


def _checks(ask: libraries.Ask) -> Iterator[_Named]:
    always, extras = libraries.requirements()
    yield _Named("armcal", "armcal", libraries.itself)
    for one in always:
        yield _Named("libraries", one.name, lambda r=one: [libraries.library(r, ask)])  # type: ignore[misc]
    for name, needed in extras.items():
        yield _Named("extras", name, lambda n=name, r=needed: [libraries.extra(n, r, ask)])  # type: ignore[misc]
    yield _Named("plugins", "plugins", lambda: workings.plugins(ask))
    yield _Named("solvers", "solvers", lambda: workings.solvers(ask))
    yield _Named("compiler", "C compiler", lambda: [workings.compiler(ask)])
    yield _Named("compiler", "cache", lambda: [machine.cache()])
    yield _Named("bench", "serial ports", machine.serial_ports)
    yield _Named("bench", "I2C buses", machine.i2c_buses)
    yield _Named("machine", "room", machine.rooms)
    yield _Named("machine", "processors", lambda: [machine.processors()])
    yield _Named("main job", "calibrate", lambda: [workings.main_job(ask)])
