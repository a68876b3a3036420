"""A simulated DTrack: it prints noisy poses of bodies and sends them by UDP."""

import contextlib
import math
import socket
from collections import deque
from collections.abc import Mapping
from typing import Annotated, Literal, Self

import numpy as np
from armcal.base.arrays import Array
from armcal.base.settings import Duration
from armcal.devices.live import TrackerFrame
from armcal_simulation.world import Fraction, TrackerModel, TrackerSettings
from pydantic import Field, model_validator

_DAY_S = 86400.0
_LOST = "0 0.000][0.000 0.000 0.000][" + " ".join(["0.000000"] * 9) + "]"

Number = Annotated[int, Field(ge=0, le=999)]


class DTrackSenderSettings(TrackerSettings):
    """``bodies`` gives each body its number in the datagrams (from 0).

    The tracker's clock is ahead by ``clock_offset``, and gains ``clock_skew_ppm``.
    """

    bodies: Annotated[dict[str, Number], Field(min_length=1, default_factory=lambda: {"base": 1, "tool": 2})]
    occluded: dict[str, Fraction] = Field(default_factory=dict)  # type: ignore[assignment]
    lines: Literal["6d", "6di"] = "6d"
    clock_offset: Duration = 0.0
    clock_skew_ppm: Annotated[float, Field(ge=-1e5, le=1e5)] = 0.0
    first_frame: Annotated[int, Field(ge=0, lt=2**32)] = 1

    @model_validator(mode="after")
    def _sane(self) -> Self:
        if len(set(self.bodies.values())) != len(self.bodies):
            raise ValueError("found two bodies of one number, expected each to have its own")
        unknown = set(self.occluded) - set(self.bodies)
        if unknown:
            raise ValueError(f"found {min(unknown)!r} occluded, expected one of {', '.join(self.bodies)}")
        return self


class DTrackSender:
    """Sends to a host and port what a tracker sees."""

    def __init__(self, settings: DTrackSenderSettings, host: str, port: int) -> None:
        self._settings = settings
        self._address = (host, port)
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setblocking(False)
        self._began: float | None = None
        self._under_way: deque[tuple[float, bytes]] = deque()

    def send(self, now: float, frame: TrackerFrame | None) -> None:
        """One frame, and whatever latency has held back until now.

        Args:
            now: the bench's wall clock (unix s).
            frame: None: none is sent.
        """
        self._began = now if self._began is None else self._began
        if frame is not None:
            gained = 1e-6 * self._settings.clock_skew_ppm * (frame.arrived - self._began)
            stamp = frame.arrived + self._settings.clock_offset + gained
            counter = (frame.counter + self._settings.first_frame - 1) % 2**32
            poses = {self._settings.bodies[name]: pose for name, pose in frame.bodies.items()}
            text = datagram(counter, stamp, poses, self._settings.lines)
            self._under_way.append((now + self._settings.latency, text))
        while self._under_way and self._under_way[0][0] <= now:
            with contextlib.suppress(OSError):  # nobody has to listen
                self._socket.sendto(self._under_way.popleft()[1], self._address)

    def close(self) -> None:
        self._socket.close()


class SimulatedDTrack:
    """A tracker's model and its sender. The same seed, times and bodies give the same bytes."""

    def __init__(self, settings: DTrackSenderSettings, host: str, port: int, seed: int) -> None:
        self._model = TrackerModel(settings, tuple(settings.bodies), np.random.default_rng(seed))
        self._sender, self.faults = DTrackSender(settings, host, port), self._model

    def send(self, now: float, bodies: Mapping[str, Array | None]) -> None:
        """A moment (unix s), and ``world_T_body`` (4 x 4, m) by name; None: out of sight."""
        self._sender.send(now, self._model.frame(now, bodies))

    def close(self) -> None:
        self._sender.close()


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
