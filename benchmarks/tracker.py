"""Frames of a tracker: DTrack's datagrams from a socket to poses, beside the serial line that brings such data."""

from __future__ import annotations

import socket
from collections.abc import Iterator

import numpy as np
from armcal.devices.clock import RealClock
from armcal_tracker.trackers import DTrackSettings, DTrackTracker

from benchmarks.report import Row
from benchmarks.timing import best_times
from tests.simulated_lines.dtrack_sender import datagram

NAME = "tracker"
FRAMES = 5000
AT_ONCE = 50
"""As many as a socket holds without losing any."""
BAUD = 115_200
BITS_A_BYTE = 10
"""Eight, a start and a stop."""


def run() -> Iterator[Row]:
    """Frames of four bodies."""
    turned = np.eye(4)
    turned[:3, :3] = [[0.36, 0.48, -0.8], [-0.8, 0.6, 0.0], [0.48, 0.64, 0.6]]
    data = [datagram(i, i / 60, dict.fromkeys(range(4), turned), "6d") for i in range(FRAMES)]
    seconds = best_times({"read": lambda: _read(data)}, repeats=3)["read"]
    size = sum(map(len, data))
    serial = size * BITS_A_BYTE / BAUD
    note = f"{size / seconds / 1e6:.1f} MB/s"
    yield Row(NAME, f"{FRAMES} frames of 4 bodies", seconds, "a line of 115,200 baud", serial, note, FRAMES)


def _read(data: list[bytes]) -> None:
    tracker = DTrackTracker(DTrackSettings(port=0, host="127.0.0.1"))
    tracker.open(RealClock())
    found = 0
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        for begin in range(0, FRAMES, AT_ONCE):
            for each in data[begin : begin + AT_ONCE]:
                sender.sendto(each, tracker.address)
            found += len(tracker.frames())
    tracker.close()
    assert found == FRAMES, found
