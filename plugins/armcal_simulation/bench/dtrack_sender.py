"""A simulated DTrack: it prints noisy poses of bodies and sends them by UDP, and fails as trackers do."""

import contextlib
import math
import socket
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Angle, Duration, Length, Settings
from pydantic import Field, model_validator

_DAY_S = 86400.0
_LOST = "0 0.000][0.000 0.000 0.000][" + " ".join(["0.000000"] * 9) + "]"

Number = Annotated[int, Field(ge=0, le=999)]
Fraction = Annotated[float, Field(ge=0, lt=1)]


class DTrackSenderSettings(Settings):
    """Numbers of a good tracker by default.

    ``noise`` is the standard deviation of each coordinate, ``orientation_noise`` of the turn about each axis of a body.
    ``bodies`` gives each body its number in the datagrams (from 0). A body is ``occluded`` for a fraction of the time,
    for ``occlusion`` on average each time. ``lost_frames`` is the fraction of datagrams that never arrive. A datagram
    arrives ``latency`` after its moment. The tracker's clock is ahead by ``clock_offset``, and gains ``clock_skew_ppm``.
    A tracker that was set up wrong gives positions ``length_gain`` times too large, or in a left-handed frame: with its
    axis ``mirrored``.
    """  # noqa: E501

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 60.0
    bodies: Annotated[dict[str, Number], Field(min_length=1, default_factory=lambda: {"base": 1, "tool": 2})]
    lines: Literal["6d", "6di"] = "6d"
    noise: Annotated[Length, Field(ge=0)] = 5e-5
    orientation_noise: Annotated[Angle, Field(ge=0)] = 3e-4
    occluded: dict[str, Fraction] = Field(default_factory=dict)
    occlusion: Annotated[Duration, Field(gt=0)] = 0.2
    lost_frames: Fraction = 0.0
    latency: Annotated[Duration, Field(ge=0)] = 0.0
    clock_offset: Duration = 0.0
    clock_skew_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    length_gain: Annotated[float, Field(gt=0)] = 1.0
    mirrored: Literal["none", "x", "y", "z"] = "none"
    first_frame: Annotated[int, Field(ge=0, lt=2**32)] = 1

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if len(set(self.bodies.values())) != len(self.bodies):
            raise ValueError("found two bodies of one number, expected each to have its own")
        unknown = set(self.occluded) - set(self.bodies)
        if unknown:
            raise ValueError(f"found {min(unknown)!r} occluded, expected one of {', '.join(self.bodies)}")
        return self


@dataclass
class TrackerFaults:
    """What is wrong with the tracker now; to be changed at any time.

    Attributes:
        frozen: it sends the last frame again and again, with a ``rising`` counter or the ``same``.
    """

    hidden: set[str] = field(default_factory=set)  # bodies that it cannot see
    silent: bool = False  # it sends nothing, while its frame counter goes on
    frozen: Literal["no", "rising", "same"] = "no"
    skew_ppm: float = 0.0  # how much its clock gains on top of the settings


class DTrackSender:
    """Sends to a host and port. The same seed, times and bodies give the same bytes."""

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
            with contextlib.suppress(OSError):  # nobody has to listen
                self._socket.sendto(self._under_way.popleft()[1], self._address)

    def close(self) -> None:
        self._socket.close()

    def _seen(self, bodies: Mapping[str, Array | None], elapsed: float) -> dict[int, Array | None]:
        """Bodies by number, with noise; as many random numbers are drawn whether they are seen or not."""
        numbers = self._settings.bodies
        unknown = set(bodies) - set(numbers)
        if unknown:
            raise ValueError(f"found the body {min(unknown)!r}, expected one of {', '.join(numbers)}")
        noise = self._random.standard_normal((len(numbers), 6))
        chances = self._random.random(len(numbers))
        # an occlusion is a two-state chain with the stated fraction and mean time
        end = min(elapsed / self._settings.occlusion, 1.0)
        poses: dict[int, Array | None] = {}
        for row, (name, number) in enumerate(numbers.items()):
            fraction = self._settings.occluded.get(name, 0.0)
            if name in self._occluded:
                if chances[row] < end:
                    self._occluded.discard(name)
            elif chances[row] < end * fraction / (1 - fraction):
                self._occluded.add(name)
            pose = bodies.get(name)
            hidden = name in self._occluded or name in self.faults.hidden
            poses[number] = None if hidden or pose is None else self._noisy(pose, noise[row])
        return poses

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
        disturbed = np.array(pose, dtype=float)
        disturbed[:3, 3] += self._settings.noise * noise[:3]
        disturbed[:3, :3] = disturbed[:3, :3] @ turn
        disturbed[:3, 3] *= self._settings.length_gain
        if (axis := self._settings.mirrored) != "none":
            mirror = np.diag([-1.0 if name == axis else 1.0 for name in "xyz"])
            disturbed[:3, :3] = mirror @ disturbed[:3, :3] @ mirror
            disturbed[:3, 3] = mirror @ disturbed[:3, 3]
        return disturbed


def datagram(counter: int, stamp: float, bodies: Mapping[int, Array | None], lines: str) -> bytes:
    """One frame as DTrack prints it: millimetres, degrees, and matrices column by column. [DTrack2]

    Args:
        counter: its number.
        stamp: seconds of the tracker's clock; what is sent counts from midnight.
        bodies: ``world_T_body`` (4 x 4, m) by number; None where it is not seen: ``6d`` leaves it out,
            ``6di`` lists it as lost.
        lines: ``6d`` or ``6di``.
    """
    blocks: list[str] = []
    for number, pose in sorted(bodies.items(), key=lambda entry: entry[0]):
        if pose is None:
            blocks += [f"[{number} {_LOST}"] if lines == "6di" else []
            continue
        rows = pose.tolist()
        place = " ".join(f"{1000 * row[3]:.3f}" for row in rows[:3])
        matrix = " ".join(f"{rows[row][column]:.6f}" for column in range(3) for row in range(3))
        if lines == "6di":
            blocks.append(f"[{number} 2 0.000][{place}][{matrix}]")
        else:
            turn = " ".join(f"{angle:.4f}" for angle in angles_deg(rows))
            blocks.append(f"[{number} 1.000][{place} {turn}][{matrix}]")
    # the clock shows microseconds: rounding must not make it show 86400.000000
    of_day = math.floor((stamp % _DAY_S) * 1e6) / 1e6
    head = f"fr {counter}\r\nts {of_day:.6f}\r\n6dcal {len(bodies)}\r\n"
    return f"{head}{lines} {len(blocks)} {' '.join(blocks)}\r\n".encode("ascii")


def angles_deg(rotation: list[list[float]]) -> tuple[float, float, float]:
    """Of R = Rx(first) Ry(second) Rz(third) (degrees). [DTrack2]"""
    second = math.asin(min(max(rotation[0][2], -1.0), 1.0))
    first = math.atan2(-rotation[1][2], rotation[2][2])
    third = math.atan2(-rotation[0][1], rotation[0][0])
    return math.degrees(first), math.degrees(second), math.degrees(third)
