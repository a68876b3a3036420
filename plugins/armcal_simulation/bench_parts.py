"""The parts of a simulated bench, built from its settings and an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from armcal.arm.assembly import Arm, MassSpec
from armcal.arm.holding import holding_function
from armcal.arm.joints import unknown_joint
from armcal.base.domains import Array
from armcal.base.pose_settings import PoseSettings
from armcal.base.quaternions import rotation_matrix
from armcal.config.selection import with_values
from armcal.config.servo_file import ServoFile, load_servo_file
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, Location
from armcal.run.experiment import Experiment
from armcal.run.plan_clearance import clearance_check

from armcal_simulation.bench_physics import BenchPhysics, Seen, ServoKind, Torques
from armcal_simulation.bench_settings import ALL, ServoBenchSettings, ServoJointSettings
from armcal_simulation.elastic_pose import ElasticPose, TrackedArm, without_effects
from armcal_simulation.safety import Bounds
from armcal_simulation.servo_heat import HeatPath
from armcal_simulation.servo_model import ServoBuild, ServoModel


def true_servos(settings: ServoBenchSettings, arm: Arm) -> ServoFile:
    """Boards and servos as they are.

    Raises:
        ConfigError: the file is refused, or names other joints than the arm has.
    """
    file = load_servo_file(settings.servos)
    if missing := sorted(set(arm.commanded) - set(file.servos)):
        raise ConfigError(
            f"found no servo for {', '.join(missing)}.",
            where=Location(str(settings.servos)),
            hint="The bench needs the true pulse table of every joint.",
        )
    if fault := unknown_joint(file.servos, arm.commanded):
        raise ConfigError(f"{fault}.", where=Location(str(settings.servos)))
    if fault := unknown_joint([name for name in (*settings.joints, *settings.start) if name != ALL], arm.commanded):
        raise ConfigError(f"bench.simulator: {fault}.")
    return file


def tracked_arm(settings: ServoBenchSettings, experiment: Experiment) -> TrackedArm:
    """The arm at its true parameters, and the measurement whose body is seen.

    Raises:
        ConfigError: there are several arms or measurements, or the truth is refused.
    """
    arms, measurements = experiment.system.arms, experiment.system.measurements
    if len(arms) != 1:
        raise ConfigError(f"found {len(arms)} arms, expected one: a servo bench moves a single arm.")
    arm = without_effects(next(iter(arms.values())), settings.without_effects)
    if sliding := [joint for joint, dimension in arm.commanded.items() if dimension != "angle"]:
        raise ConfigError(f"the joint {sliding[0]} slides, expected joints that turn: servos do.")
    name = settings.measurement or next(iter(measurements))
    if name not in measurements or (settings.measurement is None and len(measurements) > 1):
        raise ConfigError(
            f"bench.simulator.measurement: found {settings.measurement or 'none'} of {', '.join(measurements)}.",
            hint="Name the measurement whose body the tracker sees.",
        )
    parameters = experiment.parameters
    if settings.truth is not None:
        source = load_config(settings.truth)
        parameters = with_values(parameters, source.data, source, ())
    return TrackedArm(arm, name, measurements[name], parameters, experiment.system.environment)


def physics(settings: ServoBenchSettings, tracked: TrackedArm, servos: ServoFile, seen: Seen) -> BenchPhysics:
    """Servos under the arm's weight, hanging as they fell, and the pose they give the arm."""
    arm, environment = tracked.arm, tracked.environment
    kinds = {joint: servo_kind(settings.servo_of(joint)) for joint in arm.commanded}
    models = {
        joint: ServoModel(kind.build, servos.servos[joint].table, settings.start.get(joint, 0.0))
        for joint, kind in kinds.items()
    }
    function = holding_function(
        _at_truth(tracked), environment.gravity, environment.payload_mass, environment.payload_com
    )
    frame_s = 1 / settings.tracker.rate_hz
    return BenchPhysics(models, kinds, Torques(function), ElasticPose(tracked), frame_s, seen)


def servo_kind(settings: ServoJointSettings) -> ServoKind:
    """A servo's build and heat."""
    build = ServoBuild(
        float(np.radians(settings.speed_deg_per_s)),
        settings.dead_band,
        settings.backlash,
        settings.travel,
        settings.stall,
        settings.friction,
        float(np.radians(settings.fall_deg_per_s)),
    )
    heat = HeatPath(settings.continuous, settings.winding_time, settings.case_time, settings.winding_share)
    return ServoKind(build, heat)


def bounds(experiment: Experiment, file: ServoFile) -> Bounds:
    """What the plan allows, and what the servos bear."""
    plan = experiment.settings.plan
    pulses = {joint: servo.pulse_range for joint, servo in file.servos.items()}
    if plan is None:
        return Bounds({}, None, pulses)
    check = None
    if plan.clearance is not None:
        check = clearance_check(plan.clearance, experiment.system.arms, experiment.source)
    return Bounds(plan.limits, check, pulses)


def matrix_of(pose: PoseSettings) -> Array:
    """A pose as a 4x4 matrix (m)."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(np.array(pose.unit_quaternion))
    matrix[:3, 3] = pose.position
    return matrix


def _at_truth(tracked: TrackedArm) -> Arm:
    """The arm with its true masses for nominal ones; its geometry stays nominal, which torques hardly notice."""
    values: Mapping[str, float] = {
        block.name: float(block.nominal[0]) for block in tracked.parameters.blocks if block.size == 1
    }

    def true(mass: MassSpec) -> MassSpec:
        scope = f"{tracked.arm.name}.links.{mass.name}"
        x, y, z = (values[f"{scope}.com_{axis}"] for axis in "xyz")
        return replace(mass, mass=values[f"{scope}.mass"], com=(x, y, z))

    return replace(tracked.arm, masses=tuple(map(true, tracked.arm.masses)))
