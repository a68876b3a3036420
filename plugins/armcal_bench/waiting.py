"""Waiting while the arm stands: what for is said at once and once a minute; a lost device is opened again meanwhile."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, JointDevice
from armcal.devices.faults import DeviceError, DeviceRefusedError

AGAIN_EVERY_S = 0.25
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


@dataclass(frozen=True)
class LostDevice:
    """A device that failed, opened again and again until it works.

    Attributes:
        identity: with which it was opened first; None: any will do.
        longest_s: for so long at most.
        stop: called before each try; raises to give up.
    """

    device: JointDevice
    clock: Clock
    identity: DeviceIdentity | None
    longest_s: float
    waits: Waits
    stop: Callable[[], None]

    def reopened(self, fault: DeviceError, then: Callable[[], None]) -> None:
        """Until ``then`` has run after an opening; when it fails with a ``DeviceError``, both are tried again.

        Raises:
            DeviceError: the last one, when the time is over.
        """
        until = self.clock.now() + self.longest_s
        while (left := until - self.clock.now()) > 0:
            why = f"the arm holds, the device is looked for: {fault.message.rstrip('.')}"
            self.waits.goes_on("device", why, left, self.clock.now())
            self.stop()
            self.clock.sleep(AGAIN_EVERY_S)
            try:
                opened, begun = self.device.open(self.clock), self.identity
                if begun is not None and (opened.digest, opened.name) != (begun.digest, begun.name):
                    raise DeviceRefusedError(
                        f"found {opened.name}, expected {begun.name}, with which the run began.",
                        hint="Connect the board that the run began with.",
                    )
                then()
                self.waits.over("device", self.clock.now())
                return
            except DeviceRefusedError as refused:
                # Another program or another board may hold the port for a while.
                fault = DeviceError(str(refused))
            except DeviceError as again:
                fault = again
        self.waits.given_up("device")
        raise fault
