"""The section ``bench`` of a configuration, and what it names, built: clock, device, tracker."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, Self

from armcal.arm.assembly import Arm, only_arm
from armcal.base.settings import InputPath, Settings
from armcal.config.system import build_component
from armcal.config.validate import validate
from armcal.devices.clock import Clock, RealClock, SimulatedClock
from armcal.devices.device import JointDevice
from armcal.devices.live import JointStream, LiveCamera, Tracker
from armcal.devices.simulated import SimulatedBench
from armcal.errors import ConfigError
from armcal.plugins import refuse
from armcal.run.experiment import Experiment
from pydantic import Field

from armcal_bench.acquisition.settings import AcquisitionSettings
from armcal_bench.bodies import BodySettings
from armcal_bench.recording.window import RecordingSettings

SECTION = "bench"


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
    camera: dict[str, Any] | None = None
    bodies: BodySettings = Field(default_factory=BodySettings)
    acquisition: AcquisitionSettings = Field(default_factory=AcquisitionSettings)
    recording: RecordingSettings = Field(default_factory=RecordingSettings)
    servo: dict[str, Any] | None = None
    simulator: dict[str, Any] | None = None


class Closable(Protocol):
    """A part of a bench that was opened."""

    def close(self) -> None:
        """Let go of it."""


@contextmanager
def closing(*parts: Closable) -> Iterator[None]:
    """Parts of a bench, each closed at the end whatever another raises; the first fault of all passes."""
    faults = list[BaseException]()
    try:
        yield
    except BaseException as fault:
        faults.append(fault)
    for part in parts:
        try:
            part.close()
        except (Exception, SystemExit) as fault:
            faults.append(fault)
    if faults:
        raise faults[0]


@dataclass(frozen=True)
class Bench:
    """What an experiment's bench is made of; parts are built when they are asked for, and opened by who uses them."""

    experiment: Experiment
    settings: BenchSettings

    @classmethod
    def of(cls, experiment: Experiment) -> Self:
        """The bench of an experiment.

        Raises:
            ConfigError: none is configured, or it is refused.
        """
        if experiment.settings.bench is None:
            hint = "Say what moves and measures the arm: bench: {link: ..., device: ..., tracker: ...}."
            raise ConfigError("found no bench.", where=experiment.source.where((SECTION,)), hint=hint)
        return cls(experiment, validate(BenchSettings, experiment.source, (SECTION,)))

    @property
    def arm(self) -> Arm:
        """The only arm.

        Raises:
            ConfigError: there are several.
        """
        where, hint = self.experiment.source.where(("arms",)), "Configure each arm's bench on its own."
        return only_arm(self.experiment.system.arms, "a bench moves a single arm", hint, where)

    @contextmanager
    def clock(self) -> Iterator[Clock]:
        """The machine's clock, or the simulated bench's.

        Raises:
            InputError: no simulated bench answers.
        """
        if not isinstance(self.settings.clock, SimulatedClockSettings):
            yield RealClock()
            return
        clock = SimulatedClock(self.settings.clock.simulated)
        try:
            yield clock
        finally:
            clock.close()

    def device(self) -> JointDevice:
        """The device, on its link if one is configured.

        Raises:
            ConfigError: refused, or none is configured.
        """
        link = None if self.settings.link is None else self._built("link")
        joints = tuple(self.arm.commanded)
        built: JointDevice = self._built("device", joints, link)
        if built.joint_names != joints:
            refuse(type(built), f"{built.joint_names} as joint_names", f"{joints}, as it was given them")
        return built

    def tracker(self) -> Tracker:
        """The tracker; see ``device``."""
        built: Tracker = self._built("tracker")
        return built

    def joints(self) -> JointStream:
        """The stream of joint readings; see ``device``."""
        built: JointStream = self._built("joints")
        return built

    def camera(self) -> LiveCamera | None:
        return None if self.settings.camera is None else self._built("camera")

    def simulator(self) -> SimulatedBench:
        """The simulated bench; see ``device``."""
        built: SimulatedBench = self._built("simulator", kind="bench")
        return built

    def _built(self, part: str, *context: Any, kind: str = "") -> Any:
        at = (SECTION, part)
        if getattr(self.settings, part) is None:
            text = f"found no {part} of the bench."
            hint = f"Give bench: {{{part}: {{type: NAME, ...}}}}; see armcal plugins list."
            raise ConfigError(text, where=self.experiment.source.where((SECTION,)), hint=hint)
        return build_component(self.experiment.source, self.experiment.registry, kind or part, at, *context)[0]
