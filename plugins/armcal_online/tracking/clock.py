"""Time as records state it: taken in small steps; clocks jump and are set back."""

from __future__ import annotations

from dataclasses import dataclass, replace

from armcal_online.tracking.settings import ClockSettings


@dataclass(frozen=True)
class Clock:
    """The time (s) of the newest record, and how many in a row have been older since, the latest at ``behind``."""

    now: float | None = None
    late: int = 0
    behind: float = 0.0


@dataclass(frozen=True)
class Tick:
    """The clock after a record, the time that parameters had to wander (s), why the record is stale, what was odd."""

    clock: Clock
    passed: float
    stale: str = ""
    note: str = ""


def ticked(clock: Clock, time: float | None, arrived: float, settings: ClockSettings) -> Tick:
    """The clock after a record; one without a time leaves it as it was.

    A clock that jumps ahead counts as its longest step. One that was set back makes records stale until enough of them
    agree on the new time.
    """
    if time is None:
        return Tick(clock, 0.0)
    if settings.longest_age is not None and arrived - time > settings.longest_age:
        return Tick(clock, 0.0, f"it was measured {_span(arrived - time)} before it arrived")
    if clock.now is None:
        return Tick(Clock(time), 0.0)
    step = time - clock.now
    if step < -settings.tolerance:
        late = clock.late + 1 if clock.late and time >= clock.behind else 1
        if late >= settings.reset_after:
            note = f"{late} records in a row are older than one before them: the clock is taken to have been set back"
            return Tick(Clock(time), 0.0, note=note)
        return Tick(replace(clock, late=late, behind=time), 0.0, f"it is {_span(-step)} older than the last record")
    if step > settings.longest_step:
        note = f"the clock went ahead by {_span(step)}; parameters are let wander for {_span(settings.longest_step)}"
        return Tick(Clock(time), settings.longest_step, note=note)
    return Tick(Clock(max(time, clock.now)), max(step, 0.0))


def _span(seconds: float) -> str:
    for size, unit in ((86400.0, "d"), (3600.0, "h"), (60.0, "min")):
        if abs(seconds) >= size:
            return f"{seconds / size:.3g} {unit}"
    return f"{seconds:.3g} s"
