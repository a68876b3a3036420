"""A simulated bench: its truth, its arm on servos and its tracker, moved on from event to event."""

import math
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from armcal.arm.assembly import ArmInputs, holding_function, only_arm, scoped
from armcal.arm.evaluator import ElasticPass, Evaluator
from armcal.arm.statics import STATICS, tilted
from armcal.base.arrays import Array
from armcal.base.parameters import Parameters
from armcal.base.poses import PoseSettings, rotation_of
from armcal.base.settings import Angle, Duration, InputPath, Length, Settings
from armcal.config.selection import with_values
from armcal.config.servo_file import ServoFile
from armcal.config.yaml_source import load_config
from armcal.devices.clock import Clock
from armcal.devices.live import REPEATED, Tracker, TrackerFrame
from armcal.errors import ConfigError, NotConvergedError
from armcal.functions.batch_function import BoundFunction
from armcal.run.experiment import Experiment
from pydantic import Field
from typing_extensions import override

from armcal_simulation.servos import JointServo, Safety, SafetySettings, ServoHeat, ServoJointSettings

Fraction = Annotated[float, Field(ge=0, lt=1)]
_MOST_WAITING = 10_000  # frames that nobody takes


class TrackerSettings(Settings):
    """Numbers of a good tracker by default.

    ``noise`` is the standard deviation of each coordinate, ``orientation_noise`` of the turn about each axis of a body.
    The bodies are ``tool`` and ``base``. A body is ``occluded`` for a fraction of the time, for ``occlusion`` on
    average each time. ``lost_frames`` is the fraction of frames that never arrive. A frame arrives ``latency`` after
    its moment. A tracker that was set up wrong gives positions ``length_gain`` times too large, or in a left-handed
    frame: with its axis ``mirrored``.
    """

    rate_hz: Annotated[float, Field(gt=0, le=1000)] = 60.0
    noise: Annotated[Length, Field(ge=0)] = 5e-5
    orientation_noise: Annotated[Angle, Field(ge=0)] = 3e-4
    occluded: dict[Literal["tool", "base"], Fraction] = Field(default_factory=dict)
    occlusion: Annotated[Duration, Field(gt=0)] = 0.2
    lost_frames: Fraction = 0.0
    latency: Annotated[Duration, Field(ge=0)] = 0.0
    length_gain: Annotated[float, Field(gt=0)] = 1.0
    mirrored: Literal["none", "x", "y", "z"] = "none"


class TrackerModel:
    """Sees bodies, in an order that its random numbers go by. The same seed, times and poses give the same frames.

    ``silent``: its frame counter goes on; ``frozen``: it sends the last frame again and again.
    """

    def __init__(self, settings: TrackerSettings, bodies: Sequence[str], random: np.random.Generator) -> None:
        self.hidden: set[str] = set()
        self.silent, self.counter = False, 1
        self.frozen: Literal["no", "rising", "same"] = "no"
        self._settings, self._bodies, self._random = settings, tuple(bodies), random
        self._last: float | None = None
        self._occluded: set[str] = set()
        self._shown: TrackerFrame | None = None

    def frame(self, now: float, bodies: Mapping[str, Array | None]) -> TrackerFrame | None:
        """The frame of a moment (unix s), None if it never arrives, with bodies at ``world_T_body`` (4 x 4, m)."""
        elapsed = 0.0 if self._last is None else now - self._last
        self._last = now
        poses = self._seen(bodies, elapsed)
        is_lost = self._random.random() < self._settings.lost_frames
        if self.frozen == "no" or self._shown is None:
            self._shown = TrackerFrame(self.counter, now, None, poses)
        shown = self._shown
        if self.frozen == "rising":
            shown = replace(shown, counter=self.counter, arrived=now)
        self.counter += 1
        return None if is_lost or self.silent else shown

    def _seen(self, bodies: Mapping[str, Array | None], elapsed: float) -> dict[str, Array | None]:
        """Bodies with noise; as many random numbers are drawn whether they are seen or not."""
        noise = self._random.standard_normal((len(self._bodies), 6))
        chances = self._random.random(len(self._bodies))
        # an occlusion is a two-state chain with the stated fraction and mean time
        end = min(elapsed / self._settings.occlusion, 1.0)
        poses: dict[str, Array | None] = {}
        occluded = {str(body): fraction for body, fraction in self._settings.occluded.items()}
        for row, name in enumerate(self._bodies):
            fraction = occluded.get(name, 0.0)
            if name in self._occluded:
                if chances[row] < end:
                    self._occluded.discard(name)
            elif chances[row] < end * fraction / (1 - fraction):
                self._occluded.add(name)
            pose = bodies.get(name)
            is_hidden = name in self._occluded or name in self.hidden
            poses[name] = None if is_hidden or pose is None else self._noisy(pose, noise[row])
        return poses

    def _noisy(self, pose: Array, noise: Array) -> Array:
        x, y, z = (self._settings.orientation_noise * noise[3:]).tolist()
        # a turn this small, to second order: Rodrigues' formula cut short
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


class SimulatedTracker(Tracker):
    """What a session opens in the place of its tracker; ``names`` are the session's own of the bodies."""

    def __init__(self, names: Mapping[str, str]) -> None:
        self._names = names
        self._clock: Clock | None = None
        self._repeated, self._newest = 0, 0
        self._under_way: deque[TrackerFrame] = deque(maxlen=_MOST_WAITING)

    def send(self, frame: TrackerFrame, arrives: float) -> None:
        if self._clock is not None:
            self._under_way.append(replace(frame, arrived=arrives))

    @override
    def open(self, clock: Clock) -> None:
        self._clock = clock

    @override
    def frames(self) -> list[TrackerFrame]:
        frames = []
        while self._clock is not None and self._under_way and self._under_way[0].arrived <= self._clock.now():
            frame = self._under_way.popleft()
            if frame.counter <= self._newest:
                self._repeated += 1
                continue
            self._newest = frame.counter
            frames.append(replace(frame, bodies={self._names[body]: pose for body, pose in frame.bodies.items()}))
        return frames

    @property
    @override
    def refused(self) -> Mapping[str, int]:
        return {REPEATED: self._repeated} if self._repeated else {}

    @override
    def close(self) -> None:
        self._clock = None
        self._under_way.clear()


ALL = "all"  # in the place of a joint's name: settings of all joints, beneath each joint's own
WALL_AT_START = 1893456000.0
"""2030-01-01, 0:00 UTC: no bench is there at two times, and results are the same whenever they are made."""
FALL_STEP_S = 0.02  # how often the torque on a servo that gives way is looked up
SLOW_S = 0.1  # how often torques and heat are, else
_HANGING_S = 60.0
_NO_VALUES = np.zeros(0)
_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


class FaultRequest(Settings):
    kind: Literal[
        "lost", "silent", "frozen", "seen", "unplug", "replug", "reset", "brown_out", "jam", "free", "heat", "put"
    ]
    at: Annotated[float, Field(ge=0)] = 0.0  # when (simulated s)
    joint: str | None = None  # of ``brown_out`` and of servos: whose; all by default
    angle: float = 0.0  # ``put``: where somebody moves the joint by hand (rad); one that holds stays
    body: Literal["tool", "base"] | None = None  # ``lost`` and ``seen``: which; all by default
    counter: Literal["rising", "same"] = "rising"  # ``frozen``: what the frame counter does


class BenchTruthSettings(Settings):
    """The truth of a bench: arm, servos, tracker, what counts as unsafe, and the faults that happen.

    ``truth`` has the arm's true parameters by name, and ``without_effects`` what the servos here do themselves. Before
    servos are powered the arm hangs as it falls from ``start``. ``measurement`` is the one whose body the tracker sees,
    the only one by default. ``servos`` is a servo file with the true oscillators and pulse tables of boards whose
    pulses drive servos; the device's own where it is not given. ``joints`` has the kind of servo, by joint or for
    ``all``.
    """

    truth: InputPath | None = None
    without_effects: tuple[str, ...] = ()
    measurement: str | None = None
    start: dict[str, Angle] = Field(default_factory=dict)
    servos: InputPath | None = None
    joints: dict[str, ServoJointSettings] = Field(default_factory=dict)
    world_T_base: PoseSettings = Field(default_factory=PoseSettings)
    tracker: TrackerSettings = Field(default_factory=TrackerSettings.si)
    safety: SafetySettings = Field(default_factory=SafetySettings)
    faults: tuple[FaultRequest, ...] = ()
    seed: Annotated[int, Field(ge=0)] = 0

    def servo_of(self, joint: str) -> ServoJointSettings:
        stated = [self.joints[name] for name in (ALL, joint) if name in self.joints]
        made = type(stated[-1]) if stated else ServoJointSettings
        return made.si(**{key: getattr(settings, key) for settings in stated for key in settings.model_fields_set})


class TrackedArm:
    """An arm at its true parameters, and the body on its tool that the tracker sees."""

    def __init__(self, settings: BenchTruthSettings, experiment: Experiment) -> None:
        self.experiment, system = experiment, experiment.system
        arm = only_arm(system.arms, "a servo bench moves a single arm", "Configure each arm's bench on its own.")
        without = settings.without_effects
        if unknown := sorted(set(without) - set(arm.effects)):
            text = f"bench.simulator.without_effects: no effect of {arm.name} is called {unknown[0]!r}."
            raise ConfigError(text, hint=f"Its effects are {', '.join(arm.effects) or 'none'}.")
        effects = {name: effect for name, effect in arm.effects.items() if name not in without}
        self.arm = arm = replace(arm, effects=effects)
        if sliding := [joint for joint, dimension in arm.commanded.items() if dimension != "angle"]:
            raise ConfigError(f"the joint {sliding[0]} slides, expected joints that turn: servos do.")
        if arm.conditions:
            text = f"effects of {arm.name} ask for {', '.join(arm.conditions)}, which a bench does not simulate."
            raise ConfigError(text, hint="Name them under bench.simulator.without_effects.")
        name, measurements = settings.measurement or next(iter(system.measurements)), system.measurements
        if name not in measurements or (settings.measurement is None and len(measurements) > 1):
            text = f"bench.simulator.measurement: found {settings.measurement or 'none'} of {', '.join(measurements)}."
            raise ConfigError(text, hint="Name the measurement whose body the tracker sees.")
        parameters = experiment.parameters
        if settings.truth is not None:
            source = load_config(settings.truth)
            parameters = with_values(parameters, source.data, source, ())
        self._torques = self._holding(parameters)
        self._evaluator = self._elastic(name, parameters)
        self._deflection = np.zeros((arm.deflection_size, 1))

    def torques(self, angles: list[float]) -> list[float]:
        """Holding torques (joints, N m) of the true masses on the nominal geometry, from which they hardly differ."""
        self._torques.inputs[0][:] = angles
        self._torques.evaluate()
        return [float(torque) for torque in self._torques.outputs[0][0]]

    def pose(self, joint_angles: Array, approaches: Array) -> Array:
        """``base_T_body`` (4x4, m) at joint angles (joints, rad) that were reached from these sides (-1, 0, 1)."""
        record = np.concatenate([joint_angles, approaches])[:, None]
        try:
            shown = self._evaluator(_NO_VALUES, record, self._deflection)
        except NotConvergedError:
            self._deflection[:] = 0.0
            raise
        pose = np.eye(4)
        pose[:3] = shown.reshape(4, 3).T
        return pose

    def _holding(self, parameters: Parameters) -> BoundFunction:
        arm, environment, masses = self.arm, self.experiment.system.environment, []
        values = {block.name: float(block.nominal[0]) for block in parameters.blocks if block.size == 1}
        for mass in arm.masses:
            scope = f"{arm.name}.links.{mass.name}"
            x, y, z = (values[f"{scope}.com_{axis}"] for axis in "xyz")
            masses.append(replace(mass, mass=values[f"{scope}.mass"], com=(x, y, z)))
        load = environment.gravity, environment.payload_mass, environment.payload_com
        return BoundFunction(holding_function(replace(arm, masses=tuple(masses)), *load))

    def _elastic(self, name: str, parameters: Parameters) -> Evaluator:
        """From commands and approaches to the body's pose (3x4, column by column)."""
        arm, system = self.arm, self.experiment.system
        values = {block.name: ca.SX(list(block.nominal)) for block in parameters.blocks}
        count = len(arm.commanded)
        record, deflection = ca.SX.sym("record", 2 * count), ca.SX.sym("deflection", arm.deflection_size)
        inputs = ArmInputs(
            ca.vertcat(*arm.joint_commands(ca.vertsplit(record[:count]))),
            ca.vertcat(*arm.joint_approaches(ca.vertsplit(record[count:]))),
            tilted(system.environment.load, scoped(values, f"{STATICS}.")),
            deflection,
        )
        state = arm.state(values, inputs)
        read = system.measurements[name].outputs({arm.name: state}, scoped(values, f"{name}."))
        if not set(_POSITION) <= set(read):
            text = f"the measurement {name} is no position, which a tracker would see."
            raise ConfigError(text, hint="Give a measurement of type tip_position or tip_pose.")
        rotation = state.base_T_tool.rotation  # the tool's where the measurement knows of none
        if set(_QUATERNION) <= set(read):
            rotation = rotation_of(ca.vertcat(*[read[part] for part in _QUATERNION]))
        after = ca.densify(state.next_deflection)
        elastic = ElasticPass(record=record, state=deflection, next_state=after, springs=arm.spring_names)
        return Evaluator(elastic, ca.horzcat(rotation, ca.vertcat(*[read[axis] for axis in _POSITION])))


class BenchWorld:
    """A bench: its time, and what happens in it. A subclass has what stands between host and servos.

    Torques (N m) are as of the last look; ``file`` is the true servo file, where pulses drive servos.
    """

    def __init__(
        self,
        settings: BenchTruthSettings,
        tracked: TrackedArm,
        servos: Mapping[str, JointServo],
        file: ServoFile | None,
        log: Path,
        bodies: tuple[str, ...] = ("base", "tool"),
        now: float = 0.0,
    ) -> None:
        self.now, self.settings, self.servos = now, settings, dict(servos)
        self._tracked, self._world_T_base, self._bodies = tracked, settings.world_T_base.matrix, bodies
        random = np.random.default_rng([settings.seed, int(now)] if now else settings.seed)
        self.tracker_model = TrackerModel(settings.tracker, bodies, random)
        pulses = {} if file is None else {joint: servo.pulse_range for joint, servo in file.servos.items()}
        self.safety = Safety(settings.safety, tracked.experiment, pulses, self.servos, log)
        self._faults: list[FaultRequest] = []
        self.heat = {joint: ServoHeat(servo.settings) for joint, servo in servos.items()}
        self._frame_s = 1 / settings.tracker.rate_hz
        self._frames, self._slow = int(now / self._frame_s) + 1, int(now / SLOW_S) + 1
        self._pose: Array | None = None
        self._moved, self._yielding = True, True
        self._look_up_torques()
        # The arm falls from where it was put until it hangs, before time begins.
        for _ in range(int(_HANGING_S / FALL_STEP_S)):
            moved = [servo.advance(FALL_STEP_S, self.torques[joint]) for joint, servo in self.servos.items()]
            if not any(moved):
                break
            self._look_up_torques()
        for servo in self.servos.values():
            servo.approach = 0

    def exposed(self, frame: TrackerFrame | None) -> None:
        """The tracker has taken a frame; None: one that never arrives."""

    def next_event(self) -> float:
        """When a timer is due (s)."""
        return math.inf

    def run_timers(self) -> None:
        """Do what is due now."""

    def moved(self) -> None:
        """Time has passed for the motors."""

    def advance(self, seconds: float) -> None:
        end = self.now + seconds
        self.safety.passed(self.now)
        while self.now < end:
            due = min(self._frames * self._frame_s, self._slow * SLOW_S, self.next_event())
            if self._yielding:
                due = min(due, self.now + FALL_STEP_S)
            if self._faults:
                due = min(due, self._faults[0].at)
            before, self.now = self.now, min(end, max(due, self.now))
            self._move(self.now - before)
            self.moved()
            self.run_faults()
            if self.next_event() <= self.now:
                self.run_timers()
                self.safety.passed(self.now)

    def plan(self, *faults: FaultRequest) -> None:
        self._faults = sorted([*self._faults, *faults], key=lambda fault: fault.at)

    def run_faults(self) -> None:
        while self._faults and self._faults[0].at <= self.now:
            self.fail(self._faults.pop(0))

    def fail(self, fault: FaultRequest) -> None:
        tracker, bodies = self.tracker_model, {fault.body} if fault.body else set(self._bodies)
        if fault.kind == "lost":
            tracker.hidden |= bodies
        elif fault.kind == "silent":
            tracker.silent = True
        elif fault.kind == "frozen":
            tracker.frozen = fault.counter
        elif fault.kind == "seen":
            tracker.silent, tracker.frozen = False, "no"
            tracker.hidden -= bodies

    def commands_changed(self) -> None:
        self._yielding = any(servo.gives_way(self.torques[joint]) for joint, servo in self.servos.items())

    def state(self) -> dict[str, Any]:
        base_T_body = self._body_pose()
        joints = {
            joint: {
                "angle_rad": servo.angle,
                "shaft_rad": servo.shaft,
                "target_rad": servo.target,
                "approach": servo.approach,
                "powered": servo.powered,
                "failed": servo.failed,
                "torque_Nm": self.torques[joint],
                "winding": self.heat[joint].winding,
                "case": self.heat[joint].case,
            }
            for joint, servo in self.servos.items()
        }
        return {
            "now": self.now,
            "wall": WALL_AT_START + self.now,
            "joints": joints,
            "base_T_tool": None if base_T_body is None else base_T_body.tolist(),
            "failed": [joint for joint, servo in self.servos.items() if servo.failed],
            **self.safety.summary(),
        }

    def go_on(self, before: Mapping[str, Any]) -> None:
        for joint, servo in self.servos.items():
            heat, there = self.heat[joint], before["joints"][joint]
            heat.winding, heat.case, servo.failed = there["winding"], there["case"], there["failed"]
        self.commands_changed()
        self.safety.go_on(before)

    def _move(self, seconds: float) -> None:
        if seconds > 0:
            moved = False
            for joint, servo in self.servos.items():
                moved |= servo.advance(seconds, self.torques[joint])
            self._moved |= moved
            if moved and self._yielding:
                self._look_up_torques()
        if self.now >= self._slow * SLOW_S:
            self._slow += 1
            self._look_up_torques()
            for joint, servo in self.servos.items():
                heat = self.heat[joint]
                heat.advance(SLOW_S, self.torques[joint] if servo.powered else 0.0)
                if heat.winding >= 1 and not servo.failed:
                    servo.failed, self._yielding = True, True
                    self.safety.failed(joint, self.now, heat.winding)
        if self.now >= self._frames * self._frame_s:
            self._frames += 1
            base_T_body = self._body_pose()
            tool = None if base_T_body is None else self._world_T_base @ base_T_body
            poses = {"tool": tool, "base": self._world_T_base}
            seen = {body: poses.get(body) for body in self._bodies}
            self.exposed(self.tracker_model.frame(WALL_AT_START + self.now, seen))

    def _body_pose(self) -> Array | None:
        """``base_T_body`` (4x4, m); None where the springs do not hold the arm."""
        if self._moved:
            angles = np.array([servo.angle for servo in self.servos.values()])
            approaches = np.array([float(servo.approach) for servo in self.servos.values()])
            try:
                self._pose = self._tracked.pose(angles, approaches)
            except NotConvergedError:
                self._pose = None
            self._moved = False
        return self._pose

    def _look_up_torques(self) -> None:
        torques = self._tracked.torques([servo.angle for servo in self.servos.values()])
        self.torques = dict(zip(self.servos, torques, strict=True))
        self.commands_changed()
