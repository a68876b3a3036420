"""Simulated benches: what stands in for board, arm and tracker when a command of a bench is rehearsed."""

from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

from armcal.devices.clock import Clock
from armcal.devices.device import JointDevice
from armcal.devices.live import JointStream, Tracker
from armcal.run.experiment import Experiment

ACCOUNT, LOG = "truth.json", "safety.jsonl"
"""In a simulated bench's folder: its state, with what was unsafe, and a line for each that was."""


@dataclass(frozen=True)
class BenchRequest:
    """What a simulated bench works on."""

    experiment: Experiment  # its arm, measurements, nominal parameters, clearance (``plan.clearance``) and limits
    folder: Path  # for account and log; where an account is there, the bench goes on from it
    tool: str  # what the session calls the body on the tool
    base: str  # and the one at the arm's base


class RunningBench(Protocol):
    """A simulated bench while a session uses it. Time passes only while its clock sleeps."""

    clock: Clock  # the session's

    def device(self, configured: JointDevice, is_guarded: bool) -> JointDevice:
        """What is opened in the place of the configured device, which is asked only for joints and settable angles.

        ``is_guarded``: the configured link looks after the arm when its host falls silent.
        """

    def tracker(self, configured: Tracker) -> Tracker:
        """What is opened in the place of the configured tracker."""

    def joints(self, configured: JointStream) -> JointStream:
        """What is opened in the place of the configured stream of joint readings."""

    def close(self) -> None:
        """Let go, and write the account: the state as JSON.

        It has ``offences`` and ``events`` (how many, by kind), and the ``worst`` of each kind: ``joint``, ``value``,
        and the ``limit`` of an offence.
        """


class SimulatedBench(Protocol):
    """What a plugin provides to stand in for a bench."""

    def start(self, request: BenchRequest) -> RunningBench:
        """A bench at its beginning, or from where its account left it.

        Raises:
            ConfigError: its settings do not fit the experiment.
            InputError: the folder cannot be used.
        """
