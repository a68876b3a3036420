"""The section ``bench`` of a configuration, and what it names, built: clock, device, tracker."""

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Any, Literal, NamedTuple, Self

import numpy as np
from armcal.arm.assembly import Arm, only_arm
from armcal.base.arrays import Array
from armcal.base.poses import PoseSettings
from armcal.base.settings import Angle, Duration, InputPath, Length, Settings, Temperature, Torque
from armcal.config.system import build_component
from armcal.config.validate import validate
from armcal.devices.clock import Clock, RealClock
from armcal.devices.device import JointDevice
from armcal.devices.link import GuardedLink
from armcal.devices.live import JointStream, LiveCamera, Tracker, TrackerFrame
from armcal.devices.simulated import BenchRequest, RunningBench, SimulatedBench
from armcal.errors import ConfigError
from armcal.measure.rests import far_off, mean_rotation
from armcal.plugins import refuse
from armcal.run.experiment import Experiment
from pydantic import Field, model_validator

from armcal_bench.postures import RecordingSettings


class ServoHeatSettings(Settings):
    """How a servo heats: its winding soon, its case slowly."""

    continuous: Annotated[Torque, Field(gt=0)]  # held for ever, it leads to the limit
    winding_time: Annotated[Duration, Field(gt=0)] = 60.0
    case_time: Annotated[Duration, Field(gt=0)] = 900.0
    winding_share: Annotated[float, Field(ge=0, le=1)] = 0.3  # of the heat; the rest is the case's
    budget: Annotated[float, Field(gt=0, le=1)] = 0.5  # of the limit; 0.5 is safe where each number is wrong by 30 %


class SettleSettings(Settings):
    """When the arm stands."""

    wait: Duration = 0.5  # before the window
    window: Duration = 1.0  # whose mean is taken
    spread: Length = 0.0005  # by which its halves differ at most
    longest: Duration = 15.0  # after which the pose is left
    frames: Annotated[int, Field(ge=2)] = 10


class ArrivalSettings(Settings):
    """How far the arm may be from where it was commanded to be, by distances and turns between measured poses.

    More is no error of the model but a servo that failed, stalls or lost a tooth, or a body that slipped.
    """

    astray: Annotated[Length, Field(gt=0)] = 0.1
    astray_turned: Annotated[Angle, Field(gt=0)] = 0.45
    in_a_row: Annotated[int, Field(ge=1)] = 3  # after which the arm parks and the run ends


class LostSettings(Settings):
    """For how long a tracker is silent, frozen or blind until the arm holds, and parks."""

    hold: Duration = 0.5
    park: Duration = 30.0


class AcquisitionSettings(Settings):
    """How the plan is driven."""

    rate_deg_per_s: Annotated[float, Field(gt=0, le=180)] = 20.0
    period: Duration = 0.02
    limits: dict[str, tuple[Angle, Angle]] = Field(default_factory=dict)  # else those of the plan, else the model's
    park: dict[str, Angle] = Field(default_factory=dict)  # where the arm is safe, cool and left alone; others at zero
    path_step: Angle = 0.0175
    settle: SettleSettings = Field(default_factory=SettleSettings)
    arrival: ArrivalSettings = Field(default_factory=ArrivalSettings)
    lost: LostSettings = Field(default_factory=LostSettings)
    heat: dict[str, ServoHeatSettings] = Field(default_factory=dict)  # without it no heat is reckoned with
    silence: Duration = 1.0  # of the host, after which a board that can parks the arm by itself
    at_end: Literal["release", "hold"] = "release"
    between_joints: Duration = 0.5  # between the first pulses of two joints
    temperature: Temperature | None = None  # of the room; it is written with the data
    angles: Literal["commanded", "measured"] = "commanded"  # that the dataset has; the others stand beside them
    seed: Annotated[int, Field(ge=0)] = 0


_LEAST_OUTLIER_M = 2e-4
_NAMES_SHOWN = 8


NONE = "none"  # In the place of the base body's name: the tracker's world itself stands still with the arm's base

Name = Annotated[str, Field(min_length=1, max_length=100)]


class BodySettings(Settings):
    """The bodies by the tracker's own names, and what is known about where they sit."""

    tool: Name = "tool"  # the body on the tool
    base: Name = NONE  # the body that stands still with the arm's base; ``none`` where the tracker's world does
    base_motion: Literal["moving", "still"] = "moving"  # of a still one the poses of a capture are averaged
    # where the base body (or the tracker's world, without one) is in the arm's base frame
    base_T_reference: PoseSettings = Field(default_factory=PoseSettings)
    tool_body_T_target: PoseSettings = Field(default_factory=PoseSettings)  # where the measured target is on the tool

    @model_validator(mode="after")
    def _two_bodies(self) -> Self:
        if self.tool == self.base:
            text = f"found {self.tool!r} for both tool and base"
            raise ValueError(f"{text}, expected two bodies (base: none for no base)")
        return self

    @property
    def has_base(self) -> bool:
        return self.base != NONE


class Capture(NamedTuple):
    # ``base_T_target`` (N x 4 x 4, m), NaN where a frame does not show it; the rotation, too, of a tracker of positions
    poses: Array
    faults: tuple[str, ...]  # why a frame does not show it, a sentence; empty where it does (N)


def in_base(frames: Sequence[TrackerFrame], settings: BodySettings) -> Capture:
    """The target's pose in each frame: base_T_reference reference_T_world world_T_body body_T_target.

    The reference is the base body, in each frame or on the average of these frames, or the tracker's world.
    """
    tool = _stacked(frames, settings.tool)
    faults = [tool_fault(frame, settings) for frame in frames]
    reference = _reference(frames, settings)
    for i in np.flatnonzero(np.isnan(reference).any(axis=(1, 2))).tolist():
        faults[i] = faults[i] or base_fault(frames[i], settings)
    base_T_reference, body_T_target = settings.base_T_reference.matrix, settings.tool_body_T_target.matrix
    seen_at = tool[:, :3, 3]
    if body_T_target[:3, 3].any():  # a target at the body's origin needs no rotation
        seen_at = seen_at + tool[:, :3, :3] @ body_T_target[:3, 3]
    back = np.swapaxes(reference[:, :3, :3], 1, 2)
    from_reference = np.einsum("nij,nj->ni", back, seen_at - reference[:, :3, 3])
    poses = np.full((len(frames), 4, 4), np.nan)
    poses[:, 3] = [0.0, 0.0, 0.0, 1.0]
    poses[:, :3, 3] = from_reference @ base_T_reference[:3, :3].T + base_T_reference[:3, 3]
    poses[:, :3, :3] = base_T_reference[:3, :3] @ back @ tool[:, :3, :3] @ body_T_target[:3, :3]
    poses[[bool(fault) for fault in faults], :3] = np.nan
    return Capture(poses, tuple(faults))


def tool_fault(frame: TrackerFrame, settings: BodySettings) -> str:
    """Why a frame does not show where the target is in the tracker's world; empty if it does."""
    off_origin = any(settings.tool_body_T_target.position)
    return _fault(frame, settings.tool, "tool", ", and the target is not at its origin" if off_origin else None)


def base_fault(frame: TrackerFrame, settings: BodySettings) -> str:
    """Why a frame does not show where the base is; empty if it does, or nobody asks."""
    return _fault(frame, settings.base, "base", "") if settings.has_base else ""


def _fault(frame: TrackerFrame, name: str, role: str, needs_rotation: str | None) -> str:
    pose = frame.bodies.get(name)
    if pose is None:
        others = [other for other, pose in frame.bodies.items() if pose is not None][:_NAMES_SHOWN]
        seen = f"it sees {', '.join(others)}" if others else "it sees none"
        return f"the tracker does not see the {role} body {name!r} ({seen})"
    if needs_rotation is not None and np.isnan(pose[0, 0]):
        return f"the {role} body {name!r} has no orientation{needs_rotation}"
    return ""


def repeats(frame: TrackerFrame, before: TrackerFrame | None, settings: BodySettings) -> bool:
    """Whether a frame shows just what the one before showed, to the last digit: no live tracker does."""
    if before is None:
        return False
    if frame.counter == before.counter:
        return True
    names = (settings.tool, settings.base) if settings.has_base else (settings.tool,)
    pairs = [(frame.bodies.get(name), before.bodies.get(name)) for name in names]
    seen = [(a, b) for a, b in pairs if a is not None and b is not None]
    return len(seen) == len(pairs) and all(a.tobytes() == b.tobytes() for a, b in seen)


def _stacked(frames: Sequence[TrackerFrame], name: str) -> Array:
    nothing = np.full((4, 4), np.nan)
    poses = [frame.bodies.get(name) for frame in frames]
    return np.array([nothing if pose is None else pose for pose in poses]).reshape(-1, 4, 4)


def _reference(frames: Sequence[TrackerFrame], settings: BodySettings) -> Array:
    if not settings.has_base:
        return np.tile(np.eye(4), (len(frames), 1, 1))
    stacked = _stacked(frames, settings.base)
    seen = stacked[~np.isnan(stacked).any(axis=(1, 2))]
    if settings.base_motion == "moving" or not len(seen):
        return stacked
    kept = seen[~far_off(seen[:, None, :3, 3], _LEAST_OUTLIER_M)]
    mean = np.eye(4)
    mean[:3, :3], mean[:3, 3] = mean_rotation(kept[:, :3, :3]), kept[:, :3, 3].mean(axis=0)
    return np.tile(mean, (len(frames), 1, 1))


SECTION = "bench"


class BenchSettings(Settings):
    """Components keep their own settings under ``type``."""

    simulated: InputPath | None = None  # the folder of a simulated bench that stands in for the real parts
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


@contextmanager
def closing(*parts: Any) -> Iterator[None]:
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
    experiment: Experiment
    settings: BenchSettings

    @classmethod
    def of(cls, experiment: Experiment) -> Self:
        if experiment.settings.bench is None:
            hint = "Say what moves and measures the arm: bench: {link: ..., device: ..., tracker: ...}."
            raise ConfigError("found no bench.", where=experiment.source.where((SECTION,)), hint=hint)
        return cls(experiment, validate(BenchSettings, experiment.source, (SECTION,)))

    @property
    def arm(self) -> Arm:
        where, hint = self.experiment.source.where(("arms",)), "Configure each arm's bench on its own."
        return only_arm(self.experiment.system.arms, "a bench moves a single arm", hint, where)

    @cached_property
    def simulation(self) -> RunningBench | None:
        if self.settings.simulated is None:
            return None
        simulator: SimulatedBench = self._built("simulator", kind="bench")
        bodies = self.settings.bodies
        return simulator.start(BenchRequest(self.experiment, self.settings.simulated, bodies.tool, bodies.base))

    @contextmanager
    def clock(self) -> Iterator[Clock]:
        if self.simulation is None:
            yield RealClock()
            return
        with closing(self.simulation):
            yield self.simulation.clock

    def device(self) -> JointDevice:
        """The device, on its link if one is configured, or what stands in for it; ConfigError where it is refused."""
        link = None if self.settings.link is None else self._built("link")
        joints = tuple(self.arm.commanded)
        built: JointDevice = self._built("device", joints, link)
        if built.joint_names != joints:
            refuse(type(built), f"{built.joint_names} as joint_names", f"{joints}, as it was given them")
        return built if self.simulation is None else self.simulation.device(built, isinstance(link, GuardedLink))

    def tracker(self) -> Tracker:
        built: Tracker = self._built("tracker")
        return built if self.simulation is None else self.simulation.tracker(built)

    def joints(self) -> JointStream:
        built: JointStream = self._built("joints")
        return built if self.simulation is None else self.simulation.joints(built)

    def camera(self) -> LiveCamera | None:
        return None if self.settings.camera is None else self._built("camera")

    def _built(self, part: str, *context: Any, kind: str = "") -> Any:
        at = (SECTION, part)
        if getattr(self.settings, part) is None:
            text = f"found no {part} of the bench."
            hint = f"Give bench: {{{part}: {{type: NAME, ...}}}}; see armcal plugins list."
            raise ConfigError(text, where=self.experiment.source.where((SECTION,)), hint=hint)
        return build_component(self.experiment.source, self.experiment.registry, kind or part, at, *context)[0]
