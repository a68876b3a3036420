"""A simulated bench as a whole: its truth, its arm on servos and its tracker, moved on from event to event."""

import math
from collections.abc import Mapping
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
from armcal.base.settings import Angle, InputPath, Settings
from armcal.config.selection import with_values
from armcal.config.servo_file import ServoFile
from armcal.config.yaml_source import load_config
from armcal.devices.live import TrackerFrame
from armcal.errors import ConfigError, NotConvergedError
from armcal.functions.batch_function import BoundFunction
from armcal.run.experiment import Experiment
from pydantic import Field

from armcal_simulation.bench.safety import Safety, SafetySettings
from armcal_simulation.bench.servo_model import JointServo, ServoHeat, ServoJointSettings
from armcal_simulation.bench.tracker import TrackerModel, TrackerSettings

ALL = "all"  # in the place of a joint's name: settings of all joints, beneath each joint's own
WALL_AT_START = 1893456000.0
"""2030-01-01, 0:00 UTC: no bench is there at two times, and results are the same whenever they are made."""
FALL_STEP_S = 0.02  # how often the torque on a servo that gives way is looked up
SLOW_S = 0.1  # how often torques and heat are, else
_HANGING_S = 60.0
_NO_VALUES = np.zeros(0)
_POSITION, _QUATERNION = ("x", "y", "z"), ("qw", "qx", "qy", "qz")


class FaultRequest(Settings):
    """One fault."""

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
        """What kind of servo drives a joint: its own settings above those of all."""
        stated = [self.joints[name] for name in (ALL, joint) if name in self.joints]
        made = type(stated[-1]) if stated else ServoJointSettings
        return made.si(**{key: getattr(settings, key) for settings in stated for key in settings.model_fields_set})


class TrackedArm:
    """An arm at its true parameters, and the body on its tool that the tracker sees.

    Attributes:
        experiment: whose arm it is; ``arm``: without the effects that its servos have by themselves.

    Raises:
        ConfigError: there are several arms or measurements, the truth is refused, an effect asks for surroundings that
            a bench does not have, or the measurement is no position.
    """

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
        """Holding torques (joints, N m) at joint angles (joints, rad).

        They are those of the true masses on the nominal geometry, from which they hardly differ.
        """
        self._torques.inputs[0][:] = angles
        self._torques.evaluate()
        return [float(torque) for torque in self._torques.outputs[0][0]]

    def pose(self, joint_angles: Array, approaches: Array) -> Array:
        """``base_T_body`` (4x4, m) at joint angles (joints, rad) that were reached from these sides (-1, 0, 1).

        Raises:
            NotConvergedError: the springs do not hold the arm there.
        """
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

    Attributes:
        now: simulated seconds since the bench began.
        servos, heat, torques: by joint; torques (N m) as of the last look.
        tracker_model: sees the bodies; ``safety``: what was unsafe.

    Args:
        settings: the truth.
        tracked: the arm.
        servos: by joint, in the arm's order.
        file: the true servo file, where pulses drive servos.
        log: the file that takes lines on what is unsafe.
        bodies: that the tracker sees, in an order.
        now: when time begins.
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
        """Let time pass; all that happens in it has happened then."""
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
        """Have them happen at their times."""
        self._faults = sorted([*self._faults, *faults], key=lambda fault: fault.at)

    def run_faults(self) -> None:
        """Do those whose time has come."""
        while self._faults and self._faults[0].at <= self.now:
            self.fail(self._faults.pop(0))

    def fail(self, fault: FaultRequest) -> None:
        """Do a fault: here one of the tracker."""
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
        """Servos were commanded something else, or another torque is on them."""
        self._yielding = any(servo.gives_way(self.torques[joint]) for joint, servo in self.servos.items())

    def state(self) -> dict[str, Any]:
        """The truth, as JSON."""
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
        """From the heat and the account of a state."""
        for joint, servo in self.servos.items():
            heat, there = self.heat[joint], before["joints"][joint]
            heat.winding, heat.case, servo.failed = there["winding"], there["case"], there["failed"]
        self.commands_changed()
        self.safety.go_on(before)

    def _move(self, seconds: float) -> None:
        """Let the servos drive until now, and do what is due: at most one event's time at once."""
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
