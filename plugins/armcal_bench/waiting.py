"""Waiting while the arm stands: what for is said at once and once a minute."""

from collections.abc import Callable
from dataclasses import dataclass, field

_SAID_EVERY_S = 60.0


@dataclass
class Waits:
    """What is waited for, by kind (``tracker``, ``device``, ``rest``): since when, and when that was said last (s).

    Args:
        say: takes a sentence.
    """

    say: Callable[[str], None] = lambda text: None
    _since: dict[str, tuple[float, float]] = field(default_factory=dict)

    def goes_on(self, kind: str, why: str, left_s: float, now: float) -> None:
        """It is waited for at the time ``now`` (s), ``left_s`` longer at most; to be called often."""
        since, said = self._since.get(kind, (now, now))
        if kind not in self._since:
            self.say(f"{why}; waiting for up to {duration(left_s)}.")
        elif now - said >= _SAID_EVERY_S:
            self.say(f"{why}; waiting for {duration(now - since)} now, for up to {duration(left_s)} more.")
        else:
            return
        self._since[kind] = since, now

    def given_up(self, kind: str) -> None:
        """It is waited for no longer, in vain: whoever gives up reports it."""
        self._since.pop(kind, None)

    def over(self, kind: str, now: float) -> None:
        """It is waited for no longer; nothing where it was not."""
        if kind in self._since:
            since, _ = self._since.pop(kind)
            self.say(f"going on after {duration(now - since)}.")


def duration(seconds: float) -> str:
    """For people."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"
