"""Parameters over time, in bounded memory: the change of each since the start, and its standard deviation."""

from collections import deque
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from armcal.base.units import UNITS, display_unit

from armcal_online.watch.events import number, rounded, text, whole

T = TypeVar("T")

MOST_PARAMETERS = 256
_RECENT, _OLDER = 200, 200
_COMPLIANCE = {"rad_per_Nm": "deg_per_Nm"}


class Thinned(Generic[T]):
    """The newest ``recent`` items, and at most ``older`` of those before them, spread evenly.

    Args:
        recent: how many are kept whole.
        older: how many of the others are kept.
        shorten: what of an item is kept when it is no longer one of the newest.
    """

    def __init__(self, recent: int, older: int, shorten: Callable[[T], T] = lambda item: item) -> None:
        self._recent: deque[T] = deque()
        self._older: list[T] = []
        self._most = (recent, older)
        self._stride, self._passed = 1, 0
        self._shorten = shorten

    def add(self, item: T) -> None:
        self._recent.append(item)
        if len(self._recent) <= self._most[0]:
            return
        oldest = self._recent.popleft()
        if self._passed % self._stride == 0:
            self._older.append(self._shorten(oldest))
        self._passed += 1
        if len(self._older) > self._most[1]:
            del self._older[1::2]
            self._stride *= 2

    def __iter__(self) -> Iterator[T]:
        yield from self._older
        yield from self._recent

    def __len__(self) -> int:
        return len(self._older) + len(self._recent)


@dataclass(frozen=True)
class Followed:
    """One parameter: where it started (SI), and the unit it is shown in."""

    name: str
    unit: str
    shown_unit: str
    factor: float
    start: float
    start_sd: float | None

    def state(self) -> dict[str, Any]:
        """For pages: in the unit shown."""
        sd = None if self.start_sd is None else self.start_sd * self.factor
        return {
            "name": self.name,
            "unit": self.shown_unit,
            "start": rounded(self.start * self.factor, 12),
            "start_sd": rounded(sd, 4),
        }


class Estimates:
    """The estimates of all parameters, in bounded memory.

    Attributes:
        conversions: how often rows that were kept were converted to other units.
    """

    def __init__(self) -> None:
        self.conversions = 0
        self._followed: dict[str, Followed] = {}
        self._rows: Thinned[dict[str, Any]] = Thinned(_RECENT, _OLDER)

    def start(self, event: Mapping[str, Any], step: int) -> dict[str, Any] | None:
        """The values at a start (taken at a step of ``History``); where a parameter started before, its start stays."""
        listed = event.get("parameters")
        entries = [entry for entry in listed if isinstance(entry, Mapping)] if isinstance(listed, list) else []
        estimates = {}
        for entry in entries:
            name, value = text(entry.get("name")), number(entry.get("value"))
            if name is not None and value is not None:
                estimates[name] = (value, number(entry.get("sd")))
                self._follow(name, estimates[name], entry.get("unit"))
        return self._row(event, estimates, step)

    def take(self, event: Mapping[str, Any], step: int) -> dict[str, Any] | None:
        """An estimate as a row: columns in the order of the parameters."""
        listed = event.get("parameters")
        estimates = {}
        for key, pair in listed.items() if isinstance(listed, Mapping) else ():
            name, value = text(key), number(pair[0]) if isinstance(pair, list) and pair else None
            if name is not None and value is not None:
                estimates[name] = (value, number(pair[1]) if len(pair) > 1 else None)
                self._follow(name, estimates[name], None)
        return self._row(event, estimates, step)

    def state(self) -> dict[str, Any]:
        return {"parameters": [followed.state() for followed in self._followed.values()], "rows": list(self._rows)}

    @property
    def without_unit(self) -> bool:
        """Whether there are parameters whose unit no event gave: the start was rotated away."""
        return any(not followed.unit for followed in self._followed.values())

    def add_units(self, units: Mapping[str, str]) -> None:
        """Units by name, where none is known yet; rows that are kept are converted to them."""
        for index, (name, known) in enumerate(self._followed.items()):
            if known.unit or name not in units:
                continue
            followed = Followed(name, *_shown(units[name]), known.start, known.start_sd)
            self._followed[name] = followed
            self.conversions += 1
            for row in self._rows:
                for column in (row["change"], row["sd"]):
                    if index < len(column) and column[index] is not None:
                        column[index] = rounded(column[index] * followed.factor)

    def _follow(self, name: str, estimate: tuple[float, float | None], unit: Any) -> None:
        known = self._followed.get(name)
        if known is None and len(self._followed) < MOST_PARAMETERS:
            self._followed[name] = Followed(name, *_shown(unit), *estimate)
        elif known is not None and isinstance(unit, str):
            self.add_units({name: unit})

    def _row(
        self, event: Mapping[str, Any], estimates: Mapping[str, tuple[float, float | None]], step: int
    ) -> dict[str, Any] | None:
        if not estimates:
            return None
        change: list[float | None] = []
        deviations: list[float | None] = []
        for name, followed in self._followed.items():
            value, sd = estimates.get(name, (None, None))
            change.append(None if value is None else rounded((value - followed.start) * followed.factor))
            deviations.append(None if sd is None else rounded(sd * followed.factor, 4))
        row = {
            "event": "estimate",
            "step": step,
            "sequence": whole(event.get("sequence")) or 0,
            "at": number(event.get("at")),
            "change": change,
            "sd": deviations,
        }
        self._rows.add(row)
        return row


def _shown(unit: Any) -> tuple[str, str, float]:
    name = text(unit) or ""
    if name not in UNITS:
        return name, name, 1.0
    shown = UNITS[_COMPLIANCE[name]] if name in _COMPLIANCE else display_unit(UNITS[name].dimension)
    return name, "" if shown.name == "1" else shown.name.replace("_per_", "/"), UNITS[name].factor / shown.factor
