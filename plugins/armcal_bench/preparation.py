"""A plan made ready to be driven: every pose checked before anything moves, and when the servos have to rest."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import NoReturn

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.clearance import ClearanceCheck
from armcal.arm.joints import joint_limits, unknown_joint
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import SetAside
from armcal.calibration.rigid_chain import nominal_tools
from armcal.devices.device import DeviceRefusedError, JointDevice, MeasuringDevice, standing_at
from armcal.errors import ConfigError, DataError, Location
from armcal.run.experiment import Experiment, clearance_check
from armcal.run.plan import JointSpace, approach_channels, commands_of, read_poses, stated_beyond

from armcal_bench.bench import AcquisitionSettings, Bench
from armcal_bench.drive import JointPath, PathPlanner, travel
from armcal_bench.hazards import COOLED_TO, NEVER, HazardJudge, HeatModel, holding_torques
from armcal_bench.tracker_monitor import Arrival

_AT = ("bench", "acquisition")
_SLACK = 1e-9
_SAMPLES = 8


@dataclass(frozen=True)
class Measure:
    pose: int
    path: JointPath
    seconds: float
    thermal_state: Array


@dataclass(frozen=True)
class Rest:
    path: JointPath
    seconds: float
    thermal_state: Array


@dataclass(frozen=True)
class LeaveOut:
    pose: int
    why: str


Next = Measure | Rest | LeaveOut


@dataclass(frozen=True)
class Scheduler:
    poses: Array  # N x joints, rad
    ids: tuple[str, ...]  # of the poses
    approaches: Array  # from which side each joint is to come (N x joints): 1 from below, -1 from above, 0 either
    park: Array  # where it rests (joints, rad)
    planner: PathPlanner
    model: HeatModel
    rate: float  # of the fastest joint, rad/s
    capture: float  # how long it is expected to stand in a pose, s

    def next(self, at: Array, thermal_state: Array, left: Sequence[int]) -> Next:
        """What to do now; ``left`` are indices of poses, in the plan's order, at least one."""
        pose = left[0]
        step = self._measured(at, thermal_state, pose)
        if isinstance(step, LeaveOut) or self._fits(step):
            return step
        path = self.planner.find(at, self.park)
        if path is None:
            return LeaveOut(pose, "no clear path to where the arm parks was found")
        gone, home = self._driven(path, thermal_state)
        at_rest = self.model.torques(self.park)
        steady = self.model.steady(at_rest)[:, 0]
        for part in (COOLED_TO, 0.25, 0.1, 0.02):  # not colder than it has to be: a rest before every pose takes hours
            limits = np.maximum(part * self.model.budget, 1.02 * steady + 1e-6)
            seconds = self.model.cooled_in(home, at_rest, limits)
            if seconds == NEVER:
                return LeaveOut(pose, f"the servos do not cool enough for pose {self.ids[pose]} where the arm parks")
            cooled = self.model.after(home, at_rest, seconds)
            if self._fits(self._measured(self.park, cooled, pose)):
                return Rest(path, gone + seconds, cooled)
        return LeaveOut(pose, f"pose {self.ids[pose]} needs more torque than the servos bear, even from cold")

    def _measured(self, at: Array, thermal_state: Array, pose: int) -> Measure | LeaveOut:
        path = self.planner.find(at, self.poses[pose])
        if path is None:
            return LeaveOut(pose, f"no clear path to pose {self.ids[pose]} was found")
        gone, there = self._driven(path, thermal_state)
        after = self.model.after(there, self.model.torques(self.poses[pose]), self.capture)
        return Measure(pose, path, gone + self.capture, np.maximum(there, after))

    def _fits(self, step: Measure | LeaveOut) -> bool:
        if isinstance(step, LeaveOut) or self.model.over(step.thermal_state):
            return False
        back = self.planner.find(step.path[-1], self.park)
        return back is None or not self.model.over(self._driven(back, step.thermal_state)[1])

    def _driven(self, path: JointPath, thermal_state: Array) -> tuple[float, Array]:
        """How long a path takes (s), and how warm it leaves the servos, by the torque that heats like it."""
        squares, lengths, torques = [], [], self.model.torques
        for start, goal in pairwise(path):
            parts = [torques(start + t * (goal - start)) ** 2 for t in (np.arange(_SAMPLES) + 0.5) / _SAMPLES]
            squares.append(np.mean(parts, axis=0))
            lengths.append(float(np.max(np.abs(goal - start))))
        if not (length := sum(lengths)):
            return 0.0, thermal_state
        effective = np.sqrt(np.average(squares, axis=0, weights=lengths))
        return length / self.rate, self.model.after(thermal_state, effective, length / self.rate)


@dataclass(frozen=True)
class ScheduleForecast:
    steps: tuple[Next, ...]  # in order
    seconds: float  # from the first move to the last capture
    travel: float  # of the joint that turns most in each move, rad
    resting: float  # s
    hottest: Array  # the largest heat of each joint


def forecast_schedule(scheduler: Scheduler, at: Array, thermal_state: Array, left: Sequence[int]) -> ScheduleForecast:
    """The whole run, as it will be decided step by step if the servos heat as the model says."""
    steps: list[Next] = []
    remaining, heats = list(left), [scheduler.model.heat(thermal_state)]
    while remaining:
        step = scheduler.next(at, thermal_state, remaining)
        steps.append(step)
        if not isinstance(step, Rest):
            remaining.remove(step.pose)
        if not isinstance(step, LeaveOut):
            thermal_state, at = step.thermal_state, step.path[-1]
            heats.append(scheduler.model.heat(thermal_state))
    driven = [step for step in steps if not isinstance(step, LeaveOut)]
    resting = sum(step.seconds for step in driven if isinstance(step, Rest))
    gone, seconds = sum(travel(step.path) for step in driven), sum(step.seconds for step in driven)
    return ScheduleForecast(tuple(steps), seconds, gone, resting, np.max(heats, axis=0))


@dataclass(frozen=True)
class Prepared:
    bench: Bench
    settings: AcquisitionSettings
    device: JointDevice
    scheduler: Scheduler  # over the angles that the device can set nearest to them; with the planner and the heat model
    arrival: Arrival  # whether the arm stands where it was commanded to
    judge: HazardJudge  # of what is dangerous in the first motions and the last
    set_aside: tuple[SetAside, ...] = ()  # rows of the plan that are not driven
    warnings: tuple[str, ...] = ()  # of limits beyond the arm model's own


def prepare(experiment: Experiment, plan: Path) -> Prepared:
    """Read a plan and check it against limits, pulse tables and clearance. Asks no device."""
    bench = Bench.of(experiment)
    settings, arm, device = bench.settings.acquisition, bench.arm, bench.device()
    if settings.angles == "measured" and not isinstance(device, MeasuringDevice):
        text = "found measured, but this device does not know where its servos stand."
        hint = "Leave angles out: the commanded angles are written."
        raise ConfigError(text, where=experiment.source.where((*_AT, "angles")), hint=hint)
    space = JointSpace.of(experiment)
    commands = commands_of(read_poses(experiment, plan), space)
    limits = run_limits(experiment, settings, arm)

    def refuse(row: int, message: str, hint: str, fault: Exception | None = None) -> NoReturn:
        where = Location(str(plan), row=commands.rows[row] if commands.rows else None)
        raise DataError(message, where=where, hint=hint) from fault

    poses = []
    for row, pose in enumerate(commands.stacked(space.channels).T):
        if (outside := _outside(pose, limits)).any():
            joint = int(np.argmax(outside))
            low, high = np.rad2deg(limits[joint])
            text = f"pose {commands.ids[row]} has {device.joint_names[joint]} at {np.rad2deg(pose[joint]):.1f} deg"
            hint = "Nothing was moved. Plan anew with these limits, or take the pose out."
            refuse(row, f"{text}, expected {low:.1f} to {high:.1f}.", hint)
        try:
            poses.append(_nearest_settable(device, pose))  # half a count beyond a limit is the board's affair
        except DeviceRefusedError as fault:
            refuse(row, fault.message, fault.hint, fault)
    where, joints = experiment.source.where((*_AT, "park")), device.joint_names
    if unknown := unknown_joint(settings.park, joints):
        raise ConfigError(f"{unknown}.", where=where)
    park = np.array([settings.park.get(joint, 0.0) for joint in joints])
    if (outside := _outside(park, limits)).any():
        text = f"{joints[int(np.argmax(outside))]} would park outside its limits."
        raise ConfigError(text, where=where, hint="Choose another pose.")
    park = _nearest_settable(device, park)
    # from which side each joint is to come; 0 where the plan does not say
    sides = [commands.column(c) if commands.has(c) else np.zeros(len(commands)) for c in approach_channels(space)]
    approaches = np.nan_to_num(np.array(sides).T.reshape(len(commands), -1))
    prepared = of_poses(bench, settings, device, commands.ids, np.array(poses), approaches, limits, park)
    planner = prepared.scheduler.planner
    for row, pose in enumerate(poses):
        if not planner.allowed(pose):
            hint = "Nothing was moved. Plan anew with this clearance, or take the pose out."
            refuse(row, f"pose {commands.ids[row]} is too near to something.", hint)
    check_park(experiment, planner, prepared.scheduler.model, park, device.joint_names)
    planned = experiment.settings.plan.limits if experiment.settings.plan else {}
    warnings = stated_beyond(experiment, {**planned, **settings.limits})
    return replace(prepared, set_aside=tuple(commands.set_aside), warnings=warnings)


def of_poses(
    bench: Bench,
    settings: AcquisitionSettings,
    device: JointDevice,
    ids: tuple[str, ...],
    poses: Array,
    approaches: Array,
    limits: Array,
    park: Array,
) -> Prepared:
    experiment, arm = bench.experiment, bench.arm
    settable = np.array(
        [
            [_last_settable(device, joint, float(inside), float(end)) for end in ends]
            for joint, inside, ends in zip(device.joint_names, park, limits, strict=True)
        ]
    )
    check, known = clearance_of(experiment, arm), np.vstack([park, poses])
    planner = PathPlanner(check, settable, known, settings.path_step, settings.seed)
    heat = heat_of(experiment, settings, arm)
    rate, capture = float(np.deg2rad(settings.rate_deg_per_s)), settings.settle.wait + settings.settle.window + 0.5
    scheduler = Scheduler(poses, ids, approaches, park, planner, heat, rate, capture)
    judge = HazardJudge(device.joint_names, limits, heat.torques, park)
    arrival = Arrival(nominal_tools(arm, poses), settings.arrival)
    return Prepared(bench, settings, device, scheduler, arrival, judge)


def run_limits(experiment: Experiment, settings: AcquisitionSettings, arm: Arm) -> Array:
    source, plan = experiment.source, experiment.settings.plan
    if sliding := [joint for joint, dimension in arm.commanded.items() if dimension != "angle"]:
        text = f"the joint {sliding[0]} slides, expected joints that turn: servos move angles."
        hint = "Measure this arm with its own controller, and read its data."
        raise ConfigError(text, where=source.where(("arms",)), hint=hint)
    where = source.where((*_AT, "limits"))
    try:
        limits = joint_limits(arm.nominal_chain, settings.limits, plan.limits if plan else {})
    except ValueError as fault:
        raise ConfigError(f"{fault}.", where=where) from fault
    if missing := [joint for joint, ends in limits.items() if ends is None]:
        text = f"found no limits of the joint {missing[0]}."
        raise ConfigError(text, where=where, hint=f"Give them: limits: {{{missing[0]}: [-100 deg, 100 deg]}}.")
    return np.array([ends for ends in limits.values() if ends is not None])


def check_park(
    experiment: Experiment, planner: PathPlanner, heat: HeatModel, park: Array, joints: tuple[str, ...]
) -> None:
    where = experiment.source.where((*_AT, "park"))
    if not planner.allowed(park):
        raise ConfigError("the pose where the arm parks is too near to something.", where=where, hint="Choose another.")
    torque = heat.torques(park)
    if (hot := heat.too_hot_for_ever(torque)) is not None:
        share = 100 * float(heat.steady(torque)[hot, 0] / heat.budget[hot])
        raise ConfigError(
            f"the servo of {joints[hot]} would not cool where the arm parks: it carries {abs(torque[hot]):.2f} N m at "
            f"{np.rad2deg(park[hot]):.1f} deg, which heats it to {share:.0f} % of its budget.",
            where=where,
            hint="Choose a pose in which it carries less.",
        )


def _nearest_settable(device: JointDevice, pose: Array) -> Array:
    standing = standing_at(device, dict(zip(device.joint_names, pose.tolist(), strict=True)))
    return np.array([standing[joint] for joint in device.joint_names])


def _last_settable(device: JointDevice, joint: str, inside: float, beyond: float) -> float:
    """The angle (rad) nearest to ``beyond`` that the device has a pulse for, from an angle that it has one for."""
    angle = beyond
    while True:
        try:
            device.standing({joint: angle})
            inside = angle
        except DeviceRefusedError:
            beyond = angle
        if abs(beyond - inside) <= _SLACK:
            return inside
        angle = (inside + beyond) / 2


def _outside(pose: Array, limits: Array) -> Mask:
    return np.asarray((pose < limits[:, 0] - _SLACK) | (pose > limits[:, 1] + _SLACK))


def clearance_of(experiment: Experiment, arm: Arm) -> ClearanceCheck | None:
    plan = experiment.settings.plan
    if plan is None or plan.clearance is None:
        return None
    return clearance_check(plan.clearance, {arm.name: arm}, experiment.source)


def heat_of(experiment: Experiment, settings: AcquisitionSettings, arm: Arm) -> HeatModel:
    where = experiment.source.where((*_AT, "heat"))
    if settings.heat and not arm.masses and not experiment.system.environment.payload_mass:
        text = "heat is to be reckoned with, and no part of the arm has a mass: no joint would hold anything."
        hint = "Give the masses of the links (arms.NAME.links), or leave heat out."
        raise ConfigError(text, where=where, hint=hint)
    try:
        return HeatModel.of(tuple(arm.commanded), settings.heat, holding_torques(arm, experiment.system.environment))
    except ValueError as fault:
        raise ConfigError(f"{fault}.", where=where) from fault
