"""The settings of simulated benches, and their parts, built from them and an experiment."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Annotated, Self, TypeVar

from armcal.arm.assembly import Arm, only_arm
from armcal.arm.joints import unknown_joint
from armcal.arm.loading import holding_function
from armcal.base.poses import PoseSettings
from armcal.base.settings import Angle, InputPath, Settings
from armcal.config.selection import with_values
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, Location
from armcal.run.experiment import Experiment, clearance_check
from pydantic import Field, model_validator

from armcal_simulation.bench.dtrack_sender import DTrackSenderSettings
from armcal_simulation.bench.physics import BenchPhysics, ElasticPose, Seen, Torques, TrackedArm, without_effects
from armcal_simulation.bench.safety import Bounds, SafetySettings
from armcal_simulation.bench.servo_model import JointServo, ServoJointSettings

ALL = "all"  # in the place of a joint's name: settings of all joints, beneath each joint's own


_JointSettings = TypeVar("_JointSettings", bound=ServoJointSettings)


def merged(joints: Mapping[str, _JointSettings], joint: str, made: type[_JointSettings]) -> _JointSettings:
    stated = [joints[name] for name in (ALL, joint) if name in joints]
    return made.si(**{key: getattr(settings, key) for settings in stated for key in settings.model_fields_set})


class BenchTrackerSettings(DTrackSenderSettings):
    """Where its datagrams go, and which of its bodies sit on the tool and at the arm's base (none: nobody sees it)."""

    host: str = "127.0.0.1"
    port: Annotated[int, Field(ge=1, le=65535)] = 5000
    tool: str = "tool"
    base: str | None = "base"

    @model_validator(mode="after")
    def _known(self) -> Self:
        for name in (self.tool, self.base):
            if name is not None and name not in self.bodies:
                raise ValueError(f"found the body {name!r}, expected one of {', '.join(self.bodies)}")
        return self


class BenchTruthSettings(Settings):
    """The truth of a bench: arm, tracker, and what counts as unsafe.

    ``truth`` has the arm's true parameters by name, and ``without_effects`` what the servos here do themselves. Before
    servos are powered the arm hangs as it falls from ``start``. ``measurement`` is the one whose body the tracker sees,
    the only one by default.
    """

    truth: InputPath | None = None
    without_effects: tuple[str, ...] = ()
    measurement: str | None = None
    start: dict[str, Angle] = Field(default_factory=dict)
    world_T_base: PoseSettings = Field(default_factory=PoseSettings)
    tracker: BenchTrackerSettings = Field(default_factory=BenchTrackerSettings.si)
    safety: SafetySettings = Field(default_factory=SafetySettings)
    seed: Annotated[int, Field(ge=0)] = 0


class ServoBenchSettings(BenchTruthSettings):
    """The truth of a bench with boards whose pulses drive hobby servos.

    ``servos`` is a servo file with the true oscillators and pulse tables. ``joints`` has the kind of servo, by joint or
    for ``all``. ``board_id`` and ``states_oscillator_hz`` are what a board reports of itself (0: nothing).
    """

    board_id: str = "SIMULATED"
    states_oscillator_hz: Annotated[int, Field(ge=0, le=2**32 - 1)] = 0
    servos: InputPath
    joints: dict[str, ServoJointSettings] = Field(default_factory=dict)

    def servo_of(self, joint: str) -> ServoJointSettings:
        """What kind of servo drives a joint: its own settings above those of all."""
        return merged(self.joints, joint, ServoJointSettings)


def true_servos(settings: ServoBenchSettings, arm: Arm) -> ServoFile:
    """Boards and servos as they are.

    Raises:
        ConfigError: the file is refused, or names other joints than the arm has.
    """
    file = load_servo_file(settings.servos)
    if missing := sorted(set(arm.commanded) - set(file.servos)):
        hint = "The bench needs the true pulse table of every joint."
        raise ConfigError(f"found no servo for {', '.join(missing)}.", where=Location(str(settings.servos)), hint=hint)
    if fault := unknown_joint(file.servos, arm.commanded):
        raise ConfigError(f"{fault}.", where=Location(str(settings.servos)))
    if fault := unknown_joint([name for name in (*settings.joints, *settings.start) if name != ALL], arm.commanded):
        raise ConfigError(f"bench.simulator: {fault}.")
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
    settings: BenchTruthSettings, tracked: TrackedArm, servos: Mapping[str, JointServo], seen: Seen
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
    return BenchPhysics(servos, Torques(function), ElasticPose(tracked), 1 / settings.tracker.rate_hz, seen)


def bounds_of(experiment: Experiment, pulses: Mapping[str, tuple[float, float]]) -> Bounds:
    plan = experiment.settings.plan
    if plan is None:
        return Bounds({}, None, pulses)
    clearance = plan.clearance and clearance_check(plan.clearance, experiment.system.arms, experiment.source)
    return Bounds(plan.limits, clearance, pulses)
