"""Simulated benches: what stands in for board, arm and tracker when a measuring run is rehearsed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from armcal.run.experiment import Experiment

BOARD, CLOCK, LOG = "board", "clock", "safety.jsonl"
"""In a simulated bench's folder: the serial port (a link to a pty), the clock's socket, and what was unsafe."""


@dataclass(frozen=True)
class BenchRequest:
    """What a simulated bench works on.

    Attributes:
        experiment: its arm, measurements, nominal parameters, clearance (``plan.clearance``) and limits.
        folder: where ``board``, ``clock`` and the log are to be; it is there.
    """

    experiment: Experiment
    folder: Path


class SimulatedBench(Protocol):
    """What a plugin provides to stand in for a bench, at the far end of a real pty and a real socket."""

    def serve(self, request: BenchRequest) -> None:
        """Answer on the port and the clock's socket until SIGTERM, or until the clock's socket asks ``{"stop": true}``.

        Requests of the clock's socket, beside ``{"advance": s}``: ``{"state": true}`` gives the truth, ``{"fault":
        {...}}`` plants a fault. Returns when it is to stop.

        Raises:
            ConfigError: its settings do not fit the experiment.
            InputError: the folder cannot be used.
        """
