"""How long a tracker has given no usable frame, and why."""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from armcal.devices.tracker import REPEATED, TrackerFrame

from armcal_bench.bodies import BodySettings, base_fault, repeats, tool_fault

WELL_S = 0.1
"""A tracker whose last frame was usable and came so lately is well."""


class TrackerHealth:
    """Fed with all frames of a tracker from a moment on (s, by the bench's clock)."""

    def __init__(self, bodies: BodySettings, begun: float) -> None:
        self._bodies = bodies
        self._usable_at = begun
        self._last: TrackerFrame | None = None
        self._base_seen = False
        self._why = ""
        self._refused: Mapping[str, int] = {}
        self._refused_before: Mapping[str, int] = {}

    def feed(self, frames: Iterable[TrackerFrame], refused: Mapping[str, int]) -> None:
        """Take in the frames that came, and what the tracker has refused since it was opened (``Tracker.refused``)."""
        self._refused = dict(refused)
        for frame in frames:
            unseen, base = tool_fault(frame, self._bodies), base_fault(frame, self._bodies)
            self._base_seen = self._base_seen or not base
            if not (self._bodies.base_motion == "still" and self._base_seen):
                unseen = unseen or base
            self._why = f"body lost: {unseen}" if unseen else ""
            if not unseen and repeats(frame, self._last, self._bodies):
                self._why = "frozen: each frame is like the one before"
            self._last = frame
            if not self._why:
                self._usable_at = frame.arrived
                self._refused_before = self._refused

    def trouble(self, now: float) -> tuple[float, str]:
        """Seconds since the last usable frame, and why there was none since; (0, "") if all is well."""
        since = now - self._usable_at
        if since < WELL_S and not self._why and self._last is not None:
            return 0.0, ""
        return max(since, 0.0), self._why or self._silence()

    def _silence(self) -> str:
        """Why nothing came, by what was refused since the last usable frame."""
        before = self._refused_before
        risen = {reason: count - before.get(reason, 0) for reason, count in self._refused.items()}
        worst = max(risen, key=lambda reason: risen[reason], default="")
        if not worst or risen[worst] <= 0:
            return "silent: no frame comes"
        if worst == REPEATED:
            return "frozen: the same frame comes again and again"
        return f"silent: what comes cannot be read ({risen[worst]} times: {worst})"
