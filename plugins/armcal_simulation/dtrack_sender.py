"""A simulated DTrack: it prints noisy poses of bodies and sends them by UDP, and fails as trackers do."""

from __future__ import annotations

import contextlib
import socket
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from armcal.base.domains import Array

from armcal_simulation.dtrack_sender_settings import DTrackSenderSettings
from armcal_simulation.dtrack_text import datagram


@dataclass
class TrackerFaults:
    """What is wrong with the tracker now; to be changed at any time.

    Attributes:
        hidden: bodies that it cannot see.
        silent: it sends nothing, while its frame counter goes on.
        frozen: it sends the last frame again and again, with a ``rising`` counter or the ``same``.
        skew_ppm: how much its clock gains on top of the settings.
    """

    hidden: set[str] = field(default_factory=set)
    silent: bool = False
    frozen: Literal["no", "rising", "same"] = "no"
    skew_ppm: float = 0.0


class DTrackSender:
    """Sends to a host and port. The same seed, times and bodies give the same bytes.

    Attributes:
        faults: see there.
    """

    def __init__(self, settings: DTrackSenderSettings, host: str, port: int, seed: int) -> None:
        self.faults = TrackerFaults()
        self._settings = settings
        self._random = np.random.default_rng(seed)
        self._address = (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._counter = settings.first_frame
        self._last: float | None = None
        self._ahead = settings.clock_offset
        self._occluded: set[str] = set()
        self._frame: tuple[int, float, dict[int, Array | None]] | None = None
        self._under_way: deque[tuple[float, bytes]] = deque()

    def send(self, now: float, bodies: Mapping[str, Array | None]) -> None:
        """One frame, and whatever latency has held back until now.

        Args:
            now: the bench's wall clock (unix s); it must not go back.
            bodies: ``world_T_body`` (4 x 4, m) by the names in ``settings.bodies``; None: out of sight.
        """
        elapsed = 0.0 if self._last is None else now - self._last
        self._last = now
        self._ahead += elapsed * 1e-6 * (self._settings.clock_skew_ppm + self.faults.skew_ppm)
        seen = self._seen(bodies, elapsed)
        lost = self._random.random() < self._settings.lost_frames
        if self.faults.frozen == "no" or self._frame is None:
            self._frame = self._counter, now + self._ahead, seen
        counter, stamp, shown = self._frame
        if self.faults.frozen == "rising":
            counter, stamp = self._counter, now + self._ahead
        self._counter = (self._counter + 1) % 2**32
        if not (lost or self.faults.silent):
            text = datagram(counter, stamp, shown, self._settings.lines)
            self._under_way.append((now + self._settings.latency, text))
        while self._under_way and self._under_way[0][0] <= now:
            self._emit(self._under_way.popleft()[1])

    def close(self) -> None:
        """Let go of the socket; may be called twice."""
        self._socket.close()

    def _emit(self, data: bytes) -> None:
        with contextlib.suppress(OSError):  # nobody has to listen
            self._socket.sendto(data, self._address)

    def _seen(self, bodies: Mapping[str, Array | None], elapsed: float) -> dict[int, Array | None]:
        """Bodies by number, with noise; as many random numbers are drawn whether they are seen or not."""
        numbers = self._settings.bodies
        unknown = set(bodies) - set(numbers)
        if unknown:
            raise ValueError(f"found the body {min(unknown)!r}, expected one of {', '.join(numbers)}")
        noise = self._random.standard_normal((len(numbers), 6))
        chances = self._random.random(len(numbers))
        found: dict[int, Array | None] = {}
        for row, (name, number) in enumerate(numbers.items()):
            self._occlude(name, float(chances[row]), elapsed)
            pose = bodies.get(name)
            hidden = pose is None or name in self._occluded or name in self.faults.hidden
            found[number] = None if hidden or pose is None else self._noisy(pose, noise[row])
        return found

    def _occlude(self, name: str, chance: float, elapsed: float) -> None:
        """Begin or end an occlusion: a two-state chain with the stated fraction and mean time."""
        fraction = self._settings.occluded.get(name, 0.0)
        end = min(elapsed / self._settings.occlusion, 1.0)
        if name in self._occluded:
            if chance < end:
                self._occluded.discard(name)
        elif chance < end * fraction / (1 - fraction):
            self._occluded.add(name)

    def _noisy(self, pose: Array, noise: Array) -> Array:
        x, y, z = (self._settings.orientation_noise * noise[3:]).tolist()
        # a turn this small, to second order: Rodrigues' formula cut short, far below a printed digit
        turn = np.array(
            [
                [1 - (y * y + z * z) / 2, x * y / 2 - z, x * z / 2 + y],
                [x * y / 2 + z, 1 - (x * x + z * z) / 2, y * z / 2 - x],
                [x * z / 2 - y, y * z / 2 + x, 1 - (x * x + y * y) / 2],
            ]
        )
        found = np.array(pose, dtype=float)
        found[:3, 3] += self._settings.noise * noise[:3]
        found[:3, :3] = found[:3, :3] @ turn
        return found
