"""The truth of a simulated bench: its settings, and the arm, servos and bounds that they make."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Literal

from armcal.arm.assembly import Arm, only_arm
from armcal.arm.joints import unknown_joint
from armcal.arm.loading import holding_function
from armcal.arm.servo import SPLINE_TEETH, PulseClock, PulseTable
from armcal.base.poses import PoseSettings
from armcal.base.settings import Angle, InputPath, Settings
from armcal.config.selection import with_values
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, Location
from armcal.run.experiment import Experiment, clearance_check
from pydantic import Field

from armcal_simulation.bench.faults import FaultRequest
from armcal_simulation.bench.physics import BenchPhysics, ElasticPose, Seen, Torques, TrackedArm, without_effects
from armcal_simulation.bench.safety import Bounds, SafetySettings
from armcal_simulation.bench.servo_model import JointServo, ServoJointSettings
from armcal_simulation.bench.tracker import TrackerSettings

ALL = "all"  # in the place of a joint's name: settings of all joints, beneath each joint's own
_TOOTH = 2 * math.pi / SPLINE_TEETH


class BenchJointSettings(ServoJointSettings):
    """A joint's servo, and what a device does not know of it, where that has no pulse table.

    At the commanded angle zero the joint stands at ``zero_off``, and ``horn_teeth`` further; a servo that is
    ``reversed`` turns it the other way.
    """

    zero_off: Angle = 0.0
    horn_teeth: int = 0
    reversed: bool = False


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
    joints: dict[str, BenchJointSettings] = Field(default_factory=dict)
    world_T_base: PoseSettings = Field(default_factory=PoseSettings)
    tracker: TrackerSettings = Field(default_factory=TrackerSettings.si)
    safety: SafetySettings = Field(default_factory=SafetySettings)
    faults: tuple[FaultRequest, ...] = ()
    seed: Annotated[int, Field(ge=0)] = 0

    def servo_of(self, joint: str) -> BenchJointSettings:
        """What kind of servo drives a joint: its own settings above those of all."""
        stated = [self.joints[name] for name in (ALL, joint) if name in self.joints]
        made = type(stated[-1]) if stated else BenchJointSettings
        return made.si(**{key: getattr(settings, key) for settings in stated for key in settings.model_fields_set})


@dataclass(frozen=True)
class TrueAngle:
    """How commanded angles reach a servo that takes angles: as what the joint would stand at (rad)."""

    direction: Literal[1, -1]
    off: float
    slope: float = 1.0  # the least change of a position with the angle
    step: float = 2 * math.pi / 4096  # a count of usual encoders

    def position(self, angle: float) -> float:
        """What is written to the servo for a commanded angle (rad)."""
        return angle

    def angle(self, position: float) -> float:
        """The commanded angle (rad) of what is written."""
        return position

    def arriving(self, position: float) -> float:
        """What reaches the servo."""
        return self.direction * position + self.off

    def read(self, shaft: float) -> float:
        """The angle (rad) that its encoder gives where its shaft stands."""
        return self.direction * (shaft - self.off)


@dataclass(frozen=True)
class TruePulse:
    """How commanded angles reach a servo by pulses: as whole counts of a clock that runs other than is stated."""

    stated: PulseTable
    clock: PulseClock
    true_clock: PulseClock

    @property
    def slope(self) -> float:
        """In counts."""
        return self.stated.least_slope / self.clock.tick

    @property
    def step(self) -> float:
        return self.true_clock.tick

    def position(self, angle: float) -> float:
        """The counts of a commanded angle (rad)."""
        return float(self.clock.counts(self.stated.pulse(angle)))

    def angle(self, position: float) -> float:
        """The angle (rad) by the stated table."""
        return float(self.stated.angle(round(position) * self.clock.tick))

    def arriving(self, position: float) -> float:
        """The pulse at the pin (s)."""
        return round(position) * self.true_clock.tick

    def read(self, shaft: float) -> float:
        """The angle (rad) of an encoder at the shaft, which these servos do not have."""
        return shaft


def true_servos(settings: BenchTruthSettings, arm: Arm, stated: Path | None = None) -> ServoFile | None:
    """Boards and servos as they are, by the settings' servo file or the device's; None where there is neither.

    Raises:
        ConfigError: the file is refused, or names other joints than the arm has.
    """
    if fault := unknown_joint([name for name in (*settings.joints, *settings.start) if name != ALL], arm.commanded):
        raise ConfigError(f"bench.simulator: {fault}.")
    if (path := settings.servos or stated) is None:
        return None
    file = load_servo_file(path)
    if missing := sorted(set(arm.commanded) - set(file.servos)):
        hint = "The bench needs the true pulse table of every joint."
        raise ConfigError(f"found no servo for {', '.join(missing)}.", where=Location(str(path)), hint=hint)
    if fault := unknown_joint(file.servos, arm.commanded):
        raise ConfigError(f"{fault}.", where=Location(str(path)))
    return file


def tracked_arm(settings: BenchTruthSettings, experiment: Experiment) -> TrackedArm:
    """The arm at its true parameters, and the measurement whose body is seen.

    Raises:
        ConfigError: there are several arms or measurements, or the truth is refused.
    """
    measurements, hint = experiment.system.measurements, "Configure each arm's bench on its own."
    arm = without_effects(
        only_arm(experiment.system.arms, "a servo bench moves a single arm", hint), settings.without_effects
    )
    if sliding := [joint for joint, dimension in arm.commanded.items() if dimension != "angle"]:
        raise ConfigError(f"the joint {sliding[0]} slides, expected joints that turn: servos do.")
    name = settings.measurement or next(iter(measurements))
    if name not in measurements or (settings.measurement is None and len(measurements) > 1):
        text = f"bench.simulator.measurement: found {settings.measurement or 'none'} of {', '.join(measurements)}."
        raise ConfigError(text, hint="Name the measurement whose body the tracker sees.")
    parameters = experiment.parameters
    if settings.truth is not None:
        source = load_config(settings.truth)
        parameters = with_values(parameters, source.data, source, ())
    return TrackedArm(arm, name, measurements[name], parameters, experiment.system.environment)


def physics_of(
    settings: BenchTruthSettings, tracked: TrackedArm, servos: Mapping[str, JointServo], seen: Seen, now: float = 0.0
) -> BenchPhysics:
    """Servos under the arm's weight, hanging as they fell, and the pose they give the arm.

    Torques are those of the true masses on the nominal geometry, from which they hardly differ.
    """
    arm, environment = tracked.arm, tracked.environment
    values = {block.name: float(block.nominal[0]) for block in tracked.parameters.blocks if block.size == 1}
    masses = []
    for mass in arm.masses:
        scope = f"{arm.name}.links.{mass.name}"
        x, y, z = (values[f"{scope}.com_{axis}"] for axis in "xyz")
        masses.append(replace(mass, mass=values[f"{scope}.mass"], com=(x, y, z)))
    function = holding_function(
        replace(arm, masses=tuple(masses)), environment.gravity, environment.payload_mass, environment.payload_com
    )
    return BenchPhysics(servos, Torques(function), ElasticPose(tracked), 1 / settings.tracker.rate_hz, seen, now)


def bounds_of(experiment: Experiment, file: ServoFile | None) -> Bounds:
    """What the experiment allows the arm, and the servos of a file their pulses."""
    pulses = {} if file is None else {joint: servo.pulse_range for joint, servo in file.servos.items()}
    plan = experiment.settings.plan
    if plan is None:
        return Bounds({}, None, pulses)
    clearance = plan.clearance and clearance_check(plan.clearance, experiment.system.arms, experiment.source)
    return Bounds(plan.limits, clearance, pulses)


@dataclass(frozen=True)
class Wire:
    """Where a device's joint leads: to the servo of a joint (none: to nothing), and how its angles reach that."""

    joint: str | None
    path: TrueAngle | TruePulse


def wires_of(
    settings: BenchTruthSettings, arm: Arm, stated: ServoFile | None, true: ServoFile | None
) -> dict[str, Wire]:
    """By the device's names of joints. With exchanged plugs they lead to each other's servos."""
    if stated is None or true is None:
        servos = {joint: settings.servo_of(joint) for joint in arm.commanded}
        offs = {joint: servo.zero_off + servo.horn_teeth * _TOOTH for joint, servo in servos.items()}
        return {j: Wire(j, TrueAngle(-1 if servos[j].reversed else 1, offs[j])) for j in servos}
    places = {(true.boards[s.board].address, s.channel): joint for joint, s in true.servos.items()}
    wires = {}
    for joint in arm.commanded:
        if (servo := stated.servos.get(joint)) is None:
            continue
        board = stated.boards[servo.board]
        led_to = places.get((board.address, servo.channel))
        named = true.servos[led_to if led_to is not None else joint]
        clock = PulseClock(true.boards[named.board].oscillator_hz, board.prescale)
        wires[joint] = Wire(led_to, TruePulse(servo.table, board.clock, clock))
    return wires
