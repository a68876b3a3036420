"""Whether servos that know where they stand turn their joints as commanded, and from which zeros: by the tracker.

A check is a short measuring run from where the arm stands: each joint turns a little and back.
"""

import csv
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.servo import TOOTH_DEG, teeth_text
from armcal.base.arrays import Array
from armcal.base.poses import NO_TURN
from armcal.devices.device import MeasuringDevice, measured_angles, open_device
from armcal.devices.wiring import WiringRecord
from armcal.errors import ConfigError
from armcal.io.journal import KeptJournal
from armcal.run.experiment import Experiment

from armcal_bench.acquisition.preparation import Prepared, prepare, run_limits
from armcal_bench.acquisition.run_log import measured_by, progress_of
from armcal_bench.bench import SECTION, Bench, closing
from armcal_bench.servo.rigid_arm import RigidArm
from armcal_bench.servo.sighting import BODY, TABLES, Body, BodyFit, By, Corrections, Seen
from armcal_bench.servo.trial import Move, Verdict, judged, noted
from armcal_bench.settling import pose_of

_TURNS_DEG = (12.0, -12.0, 6.0, -6.0)
_BASE = "base"
_LEVER_M, _MODEL_SD_M, _ZERO_SD, _TARGET_SD_M = 0.1, 0.004, math.radians(15.0), 0.01
"""Of the pose of an arm that sags and is not as drawn; of its zeros; of where the tracker's body sits."""
"""Of the splines of hobby and bus servos."""
_REST_DEG, _MOST_TEETH = 5.0, 12
"""The standard deviation of a zero that was set by hand; a horn is a tooth off in one case of ten, two in a hundred."""
_UNREMARKABLE_DEG, _PLAUSIBLE = 10.0, 0.05
_TELLS = (
    "The zeros of {joints} alone cannot tell whether a horn is on another tooth. An earlier calibration can, or the "
    "middle between a joint's stops: turn it there by hand, and see its angle in armcal bus check."
)
_MENDS = {
    "reversed": "Give its direction in bench.device the other sign.",
    "another": "Exchange their ids in bench.device, or their plugs.",
    "still": "Check its plug, its id and whether something blocks it.",
    "gain": "Check its model in bench.device, and whether its horn slips.",
}


@dataclass(frozen=True)
class Zero:
    """How far a joint's zero is off, and its standard deviation (rad)."""

    value: float
    sd: float

    @property
    def is_far(self) -> bool:
        return abs(self.value) >= math.radians(_UNREMARKABLE_DEG)

    @property
    def teeth(self) -> list[tuple[int, float]]:
        degrees, variance = math.degrees(self.value), _REST_DEG**2 + math.degrees(self.sd) ** 2
        weights = {
            k: 0.1 ** abs(k) * math.exp(-((degrees - k * TOOTH_DEG) ** 2) / (2 * variance))
            for k in range(-_MOST_TEETH, _MOST_TEETH + 1)
        }
        total = sum(weights.values())
        likely = [(k, weight / total) for k, weight in weights.items() if weight >= _PLAUSIBLE * total]
        return sorted(likely, key=lambda pair: -pair[1])

    @property
    def is_sure(self) -> bool:
        return len(self.teeth) == 1

    def sentence(self, joint: str) -> str:
        """What it looks like; empty where that is a zero set by hand."""
        if self.is_sure and not self.teeth[0][0] and not self.is_far:
            return ""
        amount = f"{math.degrees(self.value):+.1f} +- {math.degrees(self.sd):.1f} deg"
        causes = []
        for number, share in self.teeth:
            zero = math.degrees(self.value) - number * TOOTH_DEG
            cause = f"{teeth_text(number)} and a zero of {zero:+.1f} deg" if number else "a zero set by hand"
            causes.append(cause if self.is_sure else f"{cause} ({100 * share:.0f} %)")
        mend = " Remount the horn, or move its zero_count." if self.is_far else ""
        return f"{joint} stands {amount} from where its servo says: {', or '.join(causes)}.{mend}"


@dataclass(frozen=True)
class JointCheck:
    """What each joint did, and how far its zero is off (empty where not all turned as commanded)."""

    verdicts: Sequence[Verdict]
    zeros: Mapping[str, Zero]

    @property
    def far_zeros(self) -> list[str]:
        return [zero.sentence(joint) for joint, zero in self.zeros.items() if zero.is_far]

    @property
    def notes(self) -> list[str]:
        lines = [zero.sentence(joint) for joint, zero in self.zeros.items() if not zero.is_far]
        unsure = [joint for joint, zero in self.zeros.items() if not zero.is_sure]
        return [*filter(None, lines), *([_TELLS.format(joints=", ".join(unsure))] if unsure else [])]


def check_joints(
    loaded: Callable[[tuple[str, ...]], Experiment], folder: Path, drive: Callable[[Prepared, Path, Path], object]
) -> JointCheck:
    """Turn each joint a little, from where the arm stands, and write down which are checked.

    A zero that is far off makes limits and clearances wrong by as much: such a joint does not count as checked.

    Args:
        loaded: the experiment, with further overrides.
        folder: an empty one.
        drive: does the run of a plan, in a folder.

    Raises:
        ConfigError: the device does not know where its joints stand, or the arm stands beyond a limit or too near to
            something.
        InputError: it cannot be written down.
    """
    here, seen = _measured(loaded(()))
    park = ", ".join(f"{joint}: {math.degrees(angle):.4f} deg" for joint, angle in here.items())
    at = f"{SECTION}.acquisition"
    wide = (f"{at}.arrival.astray_mm=5000", f"{at}.arrival.astray_turned_deg=180")
    experiment = loaded((f"{at}.park={{{park}}}", *wide))
    plan = folder / "check.csv"
    base = prepare(experiment, _written(plan, list(here), {_BASE: list(here.values())}))
    poses = {_BASE: base.scheduler.park}
    for i, joint in enumerate(here):
        for turn in np.deg2rad(_TURNS_DEG):
            turned = base.scheduler.park + turn * np.eye(len(here))[i]
            if base.scheduler.planner.within(turned) and base.scheduler.planner.clear(base.scheduler.park, turned):
                poses[joint] = turned
                break
    prepared = prepare(experiment, _written(plan, list(here), poses))
    drive(prepared, plan, folder / "run")
    with KeptJournal(folder / "run") as journal:
        measured = {name: pose_of(record) for name, record in progress_of(journal.entries()).measured.items()}
    commanded = dict(zip(prepared.plan.ids, prepared.scheduler.poses, strict=True))
    check = _judged(experiment, list(here), commanded, measured)
    far = {joint for joint, zero in check.zeros.items() if zero.is_far}
    counted = [replace(v, kind="unclear") if v.joint in far else v for v in check.verdicts]
    noted(WiringRecord.of_config(experiment.source, here), counted, seen)
    return check


def _measured(experiment: Experiment) -> tuple[dict[str, float], dict[str, Any]]:
    """Where the joints stand (rad), within their limits; on which adapter, when, and by what they are checked."""
    bench = Bench.of(experiment)
    device = bench.device()
    if not isinstance(device, MeasuringDevice):
        text = "found a device whose servos do not know where they stand, and no servo file."
        hint = "Name the servo file in bench.device.servos."
        raise ConfigError(text, where=experiment.source.where((SECTION, "device")), hint=hint)
    with bench.clock() as clock, closing(device):
        adapter, here = open_device(device, clock).adapter, measured_angles(device)
        seen = {"adapter": adapter, "by": "tracker", "at": clock.wall()}
    limits = run_limits(experiment, bench.settings.acquisition, bench.arm)
    ends = dict(zip(bench.arm.commanded, limits.tolist(), strict=True))
    return {joint: min(max(here[joint], low), high) for joint, (low, high) in ends.items()}, seen


def _judged(
    experiment: Experiment, joints: list[str], commanded: Mapping[str, Array], measured: Mapping[str, Array]
) -> JointCheck:
    bench = Bench.of(experiment)
    nominal = RigidArm(bench.arm, experiment.parameters)
    base = dict(zip(joints, commanded[_BASE].tolist(), strict=True))
    seen = [joint for joint in joints if joint in measured and _BASE in measured]
    moves = [
        Move(joint, float(commanded[joint][i] - commanded[_BASE][i]), measured[_BASE], measured[joint])
        for i, joint in enumerate(joints)
        if joint in seen
    ]
    verdicts = _verdicts(moves, base, nominal)
    zeros: dict[str, Zero] = {}
    if len(seen) == len(joints) and {verdict.kind for verdict in verdicts} <= {"right", "unclear"}:
        names = [_BASE, *joints]
        poses = np.array([commanded[name] for name in names]), np.array([measured[name] for name in names])
        scope, stated = measured_by(experiment)[0], experiment.parameters
        axes = [f"{scope}.target_{axis}" for axis in "xyz"]
        target = np.array([stated[name].nominal[0] if name in stated.names else 0.0 for name in axes])
        zeros = _zeros(experiment, bench.arm, joints, poses, target)
        # a zero that is far off turns the axes of the joints after it away from the model's
        verdicts = _verdicts(moves, {joint: base[joint] + zeros[joint].value for joint in joints}, nominal)
    for joint in joints:
        if joint not in seen:
            sentence = f"{joint} was not measured: nowhere to turn to, or the tracker did not see it."
            verdicts.append(Verdict(joint, "unclear", sentence, "Begin from a pose with more room about it."))
    return JointCheck(verdicts, zeros if all(verdict.kind == "right" for verdict in verdicts) else {})


def _verdicts(moves: Sequence[Move], base: Mapping[str, float], nominal: RigidArm) -> list[Verdict]:
    verdicts = judged(moves, base, nominal) if moves else []
    return [replace(verdict, mend=_MENDS.get(verdict.kind, verdict.mend)) for verdict in verdicts]


def _zeros(
    experiment: Experiment, arm: Arm, joints: list[str], poses: tuple[Array, Array], target: Array
) -> dict[str, Zero]:
    """How much the joints' angles are to be enlarged by.

    Args:
        poses: commanded (N x joints, rad), and measured (N x 4 x 4).
        target: as stated (3, m, tool frame).
    """
    commanded, measured = poses
    numbers = {joint: arm.joint_names.index(joint) + 1 for joint in joints}
    names = [f"{arm.name}.{TABLES}.zero{number}" for number in numbers.values()]
    places = [f"{BODY}.seat_{axis}" for axis in "xyz"]
    free = {**dict.fromkeys(names, _ZERO_SD), **dict.fromkeys(places, _TARGET_SD_M)}
    by: By = "position" if np.isnan(measured[:, :3, :3]).any() else "pose"
    count = len(measured)
    angles = dict(zip(joints, commanded.T, strict=True))
    turns, lengths = np.full(count, _MODEL_SD_M / _LEVER_M), np.full(count, _MODEL_SD_M)
    seen = Seen(angles, measured, turns, place_noise=lengths)
    body = Body((arm.name,), by, NO_TURN, tuple(target.tolist()))
    fit = BodyFit(experiment, arm, Corrections({}, list(numbers.values()), ()), body, free, seen)
    fit.fit(seen, np.ones(count))
    sds = fit.deviations(names).tolist()
    return {joint: Zero(fit.value(name), sd) for joint, name, sd in zip(joints, names, sds, strict=True)}


def _written(path: Path, joints: list[str], poses: Mapping[str, Sequence[float] | Array]) -> Path:
    """A plan of poses (rad)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", encoding="utf-8", newline="") as stream:
        writer = csv.writer(stream)
        writer.writerow(["pose_id", *(f"{joint}_deg" for joint in joints)])
        writer.writerows([name, *np.rad2deg(pose).tolist()] for name, pose in poses.items())
    return path
