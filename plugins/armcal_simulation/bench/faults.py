"""Faults of a simulated bench as they are stated: checked, and kept until their time."""

import math
from collections.abc import Callable, Collection, Mapping
from difflib import get_close_matches
from heapq import heappop, heappush
from typing import Annotated, Any, Literal

from armcal.base.settings import Settings
from pydantic import Field, ValidationError

Seconds = Annotated[float, Field(ge=0)]


class FaultRequest(Settings):
    """One fault."""

    kind: str  # which
    at: Seconds | None = None  # when (simulated s; now, or at the beginning, by default)
    joint: str | None = None  # of ``brown_out`` and of servos: whose; all by default
    angle: float = 0.0  # ``put``: where somebody moves the joint by hand (rad); one that holds stays
    body: str | None = None  # ``lost`` and ``seen``: which; all by default
    counter: Literal["rising", "same"] = "rising"  # ``frozen``: what the frame counter does


class FaultCalendar:
    """Faults that wait for their time (s); ``known`` are the kinds, joints and bodies that the bench has."""

    def __init__(
        self,
        clock: Callable[[], float],
        apply: Callable[[Any], None],
        known: Mapping[str, Collection[str]],
        requests: type[FaultRequest] = FaultRequest,
    ) -> None:
        self._clock, self._apply, self._known, self._requests = clock, apply, known, requests
        self._waiting: list[tuple[float, int, FaultRequest]] = []
        self._planned = 0

    def plan(self, content: Any) -> None:
        """Take a request; one without a time is done now.

        Raises:
            ValueError: it is none.
        """
        for key, names in self._known.items() if isinstance(content, dict) else ():
            if (name := content.get(key)) is not None and name not in names:
                near = get_close_matches(str(name), names, n=1)
                mend = f"did you mean {near[0]}?" if near else f"expected one of {', '.join(names)}."
                raise ValueError(f"fault: found the {key} {name!r}, which this bench does not have: {mend}")
        try:
            fault = self._requests.model_validate(content)
        except ValidationError as refused:
            first = refused.errors()[0]
            raise ValueError(f"fault: {'.'.join(map(str, first['loc']))}: {first['msg']}") from refused
        if fault.at is None:
            self._apply(fault)
        else:
            self._planned += 1
            heappush(self._waiting, (fault.at, self._planned, fault))

    def next_event(self) -> float:
        return self._waiting[0][0] if self._waiting else math.inf

    def run(self) -> None:
        while self._waiting and self._waiting[0][0] <= self._clock():
            self._apply(heappop(self._waiting)[2])
