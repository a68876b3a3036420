"""An I2C bus with what can go wrong on it: a byte that nobody acknowledges, a line that is held down."""

from collections.abc import Callable, Sequence
from functools import reduce
from operator import and_

from armcal_simulation.boards.pca9685_model import Pca9685Model

ADDRESS_ONLY = -1
"""In the place of a byte's index: the address itself is not acknowledged."""


class BusStuckError(Exception):
    """SDA is held down: no transaction can begin."""


class I2cBus:
    """Chips on two wires; the clock gives seconds."""

    def __init__(self, clock: Callable[[], float], chips: Sequence[Pca9685Model]) -> None:
        self.chips = tuple(chips)
        self._clock = clock
        self._stuck_until = 0.0
        self._planned: list[tuple[int, int]] = []

    def plan_nack(self, byte: int, after: int = 0) -> None:
        """One write, after so many others, is not acknowledged at a byte of its data, or at ``ADDRESS_ONLY``."""
        self._planned.append((after, byte))

    def hold_down(self, seconds: float) -> None:
        self._stuck_until = self._clock() + seconds

    @property
    def stuck(self) -> bool:
        return self._clock() < self._stuck_until

    def write(self, address: int, data: bytes) -> int:
        """From START to STOP.

        Returns:
            how many bytes were acknowledged, the address counted; ``len(data) + 1`` is all.

        Raises:
            BusStuckError: see there.
        """
        self._require_free()
        refused = next((byte for after, byte in self._planned if after == 0), None)
        self._planned = [(after - 1, byte) for after, byte in self._planned if after > 0]
        if refused == ADDRESS_ONLY:
            return 0
        whole = data if refused is None else data[:refused]
        return max((chip.transaction(address, whole) for chip in self.chips), default=0)

    def read(self, address: int, register: int, count: int) -> bytes | None:
        """A register number written, and so many bytes read; None where nobody acknowledges.

        Raises:
            BusStuckError: see there.
        """
        self._require_free()
        answers = [data for chip in self.chips if (data := chip.read(address, register, count)) is not None]
        if not answers:
            return None
        # Several chips that answer at once pull the same line down: zeros win.
        return bytes(reduce(and_, column) for column in zip(*answers, strict=True))

    def _require_free(self) -> None:
        if self.stuck:
            raise BusStuckError
