"""The section ``bench`` of a configuration: what moves and measures the arm, and how a measuring run goes."""

from __future__ import annotations

from typing import Any, Literal

from armcal.base.settings import InputPath, Settings
from pydantic import Field

from armcal_bench.acquisition.settings import AcquisitionSettings
from armcal_bench.body_settings import BodySettings
from armcal_bench.recording.settings import RecordingSettings


class SimulatedClockSettings(Settings):
    """The clock of a simulated bench: the path of its socket."""

    simulated: InputPath


class BenchSettings(Settings):
    """Components keep their own settings under ``type``.

    ``bodies`` says which of the tracker's bodies is what. ``clock`` is the machine's, unless a simulated bench is at
    the other end.
    """

    clock: Literal["real"] | SimulatedClockSettings = "real"
    link: dict[str, Any] | None = None
    device: dict[str, Any] | None = None
    tracker: dict[str, Any] | None = None
    joints: dict[str, Any] | None = None
    bodies: BodySettings = Field(default_factory=BodySettings)
    acquisition: AcquisitionSettings = Field(default_factory=AcquisitionSettings)
    recording: RecordingSettings = Field(default_factory=RecordingSettings)
    servo: dict[str, Any] | None = None
    simulator: dict[str, Any] | None = None
