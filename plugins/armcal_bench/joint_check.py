"""Whether each joint turns as commanded: the right one, the right way, as far as the model has it, and from which zero.

A check is a short measuring run in which each joint turns a little and back. Servos that know where they stand begin
from there, and show by how much their zeros are off.
"""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import combinations, permutations
from typing import Any

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.servo import TOOTH_DEG, teeth_text
from armcal.base.arrays import Array
from armcal.base.poses import NO_TURN
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity, MeasuringDevice, measured_angles, open_device
from armcal.devices.wiring import WiringRecord
from armcal.errors import ConfigError, InputError
from armcal.run.experiment import Experiment
from scipy.spatial.transform import Rotation

from armcal_bench.bench import SECTION, Bench, closing
from armcal_bench.drive import PathPlanner
from armcal_bench.preparation import Prepared, check_park, clearance_of, heat_of, of_poses, run_limits
from armcal_bench.run_log import Log, Progress, measured_by
from armcal_bench.servo_setup import ANYWHERE, BEGUN, POSE
from armcal_bench.session import Conversation, Ending, drive_poses, known_poses
from armcal_bench.tracked_body import (
    BODY,
    TABLES,
    Body,
    BodyFit,
    By,
    Corrections,
    RigidArm,
    body_dataset,
    turn_of_point,
    twist_angles,
)
from armcal_bench.tracker_monitor import FEWEST, Evidence, FrameMistake, StopRequested, pose_of

_LEVER_M = 0.1
_STILL = math.radians(1.5)
_STILL_M = 0.002
_GAIN_OFF = 0.25
_USUAL_M = 0.004  # How far a move of a few degrees lies from the model's, since arms sag and are not as drawn
_UNCLEAR_M = 0.02
_EACH_FAULT, _MOST, _UNSURE = 4.0, 100.0, 4.0
_USUAL_TURN = math.radians(10.0)
_SURE = 40.0


@dataclass(frozen=True)
class Verdict:
    joint: str  # that was commanded
    kind: str  # ``right``, ``reversed``, ``gain``, ``another``, ``still`` or ``unclear``
    sentence: str  # what was seen
    mend: str = ""  # what to do; empty if nothing
    turned: float = math.nan  # the measured angle (rad); NaN where none is known
    other: str = ""  # the joint that moved instead, or that cannot be distinguished


def noted(record: WiringRecord, verdicts: Sequence[Verdict], seen: Mapping[str, Any]) -> None:
    """Write down as checked the joints that turned as commanded, and as no other joint did."""
    right = [verdict.joint for verdict in verdicts if verdict.kind == "right" and not verdict.other]
    try:
        record.note(right, [verdict.joint for verdict in verdicts if verdict.joint not in right], seen)
    except InputError as fault:  # what was seen must not be lost with it
        sentences = " ".join(f"{verdict.sentence} {verdict.mend}".rstrip() for verdict in verdicts)
        message = f"{fault.message} The check itself: {sentences}"
        raise InputError(message, where=fault.where, hint=fault.hint) from fault


@dataclass(frozen=True, eq=False)
class Move:
    """The tool's pose before and after a joint was commanded to turn (rad; 4 x 4, base frame; rotations may be NaN)."""

    joint: str
    commanded: float
    before: Array
    after: Array

    @property
    def is_little(self) -> bool:
        apart = float(np.linalg.norm(self.after[:3, 3] - self.before[:3, 3]))
        if not self.has_rotations:
            return apart < _STILL_M
        return apart < _STILL_M and float(np.max(self.turn.magnitude())) < _STILL

    @property
    def has_rotations(self) -> bool:
        return not (np.isnan(self.before[0, 0]) or np.isnan(self.after[0, 0]))

    @cached_property
    def turn(self) -> Rotation:
        return Rotation.from_matrix((self.after[:3, :3] @ self.before[:3, :3].T)[None])


@dataclass(frozen=True)
class _Wiring:
    moves: Mapping[str, str]
    signs: Mapping[str, int]

    @property
    def faults(self) -> int:
        return sum(a != b for a, b in self.moves.items()) + sum(sign < 0 for sign in self.signs.values())

    def pose(self, base: Mapping[str, float]) -> dict[str, float]:
        return {self.moves[joint]: self.signs[joint] * angle for joint, angle in base.items()}


def judged(moves: Sequence[Move], base: Mapping[str, float], nominal: RigidArm) -> list[Verdict]:
    """What each joint did, by all that was seen together, from a base pose as commanded (rad).

    A swapped or reversed servo stands elsewhere in the base pose too, so that the axes of the joints after it are not
    where the model has them: each wiring with a few faults is tried, and the one that explains all moves with the
    fewest faults is taken.
    """
    seen = [move for move in moves if not move.is_little]
    scored = sorted((_score(wiring, seen, base, nominal), i, wiring) for i, wiring in enumerate(_wirings(tuple(base))))
    best_score, _, best = scored[0]
    near = [wiring for score, _, wiring in scored if score < best_score + _UNSURE]
    axes = nominal.axes(best.pose(base))
    verdicts = []
    for move in moves:
        joint, moved = move.joint, best.moves[move.joint]
        turned, off = _explained(move, *axes[moved])
        others = " or ".join(sorted({wiring.moves[joint] for wiring in near} - {joint}))
        if move.is_little:
            kind, turned, others = "still", 0.0, ""
        elif off > _UNCLEAR_M:
            kind, others = "unclear", ""
        elif moved != joint:
            kind, others = "another", moved
        elif turned * move.commanded < 0:
            kind = "reversed"
        else:
            kind = "gain" if abs(turned / move.commanded - 1) > _GAIN_OFF else "right"
        verdicts.append(_verdict(kind, joint, move.commanded, turned, others))
    return verdicts


def permuted(entries: Sequence[Mapping[str, Any]], joints: Sequence[str], nominal: RigidArm) -> dict[str, str]:
    """Why the tables of joints cannot be what a record has under their names, by joint: servos on others' channels."""
    moves = []
    for joint in joints:
        lines = [e for e in entries if e["kind"] == POSE and e["joint"] == joint and joint in e["told"]]
        pairs = [(a, b) for a, b in combinations(lines, 2) if a["came"] == b["came"]]
        turned = [(float(b["told"][joint] - a["told"][joint]), a, b) for a, b in pairs]
        turned = [turn for turn in turned if abs(turn[0]) >= _USUAL_TURN / 2]
        if turned:  # more than the usual turn shows more of what springs give
            commanded, before, after = min(turned, key=lambda turn: abs(abs(turn[0]) - _USUAL_TURN))
            moves.append(Move(joint, commanded, pose_of(before), pose_of(after)))
    begun = next((entry for entry in entries if entry["kind"] == BEGUN), None)
    if begun is None or not moves:
        return {}
    base = {joint: float(angle) for joint, angle in begun["base"].items() if joint in nominal.joints}
    seen = [move for move in moves if not move.is_little]
    straight, *others = _wirings(tuple(base))
    as_meant = _score(straight, seen, base, nominal)
    if as_meant <= _SURE:
        return {}
    best_score, _, best = min((_score(wiring, seen, base, nominal), i, wiring) for i, wiring in enumerate(others))
    if best_score > as_meant - _SURE:
        return {}
    moved = {move.joint: best.moves[move.joint] for move in seen}
    return {
        joint: f"what turned is {other}: exchange their channels in the servo file, or their plugs, and measure anew"
        for joint, other in moved.items()
        if other != joint
    }


def _score(wiring: _Wiring, seen: Sequence[Move], base: Mapping[str, float], nominal: RigidArm) -> float:
    axes = nominal.axes(wiring.pose(base))
    score = _EACH_FAULT * wiring.faults
    for move in seen:
        turned, off = _explained(move, *axes[wiring.moves[move.joint]])
        usual = _USUAL_M * max(abs(move.commanded) / _USUAL_TURN, 1.0)
        score += min((off / usual) ** 2, _MOST)
        score += _MOST if turned * wiring.signs[move.joint] * move.commanded < 0 else 0.0
    return score


def _wirings(joints: tuple[str, ...]) -> Iterator[_Wiring]:
    for count in (0, 2, 3):
        for chosen in combinations(joints, count):
            for order in permutations(chosen):
                if any(a == b for a, b in zip(chosen, order, strict=True)):
                    continue
                moves = {**{joint: joint for joint in joints}, **dict(zip(chosen, order, strict=True))}
                for reversed_ones in range(3):
                    for turned in combinations(joints, reversed_ones):
                        yield _Wiring(moves, {joint: -1 if joint in turned else 1 for joint in joints})


def swapped(verdicts: list[Verdict]) -> list[str]:
    went = {v.joint: v.other for v in verdicts if v.kind == "another"}
    return [
        f"{a} and {b} are swapped: exchange their channels in the servo file, or their plugs."
        for a, b in went.items()
        if went.get(b) == a and a < b
    ]


def _explained(move: Move, axis: Array, origin: Array) -> tuple[float, float]:
    """The turn about an axis (rad) that is nearest to what was seen, and how far from it that is (m)."""
    p, q = move.before[:3, 3] - origin, move.after[:3, 3] - origin
    if not move.has_rotations:
        turned = turn_of_point(p, q, axis)
        return turned, float(np.linalg.norm(Rotation.from_rotvec(turned * axis).apply(p) - q))
    turned = float(twist_angles(move.turn, axis)[0])
    by_joint = Rotation.from_rotvec(turned * axis)
    left = float(np.max((move.turn * by_joint.inv()).magnitude()))
    return turned, float(np.linalg.norm(by_joint.apply(p) - q)) + _LEVER_M * left


def _verdict(kind: str, joint: str, commanded: float, turned: float, other: str = "") -> Verdict:
    size, seen = f"{math.degrees(commanded):+.1f} deg", f"{math.degrees(turned):+.1f} deg"
    alike = (
        f" It cannot be distinguished from {other} in this base pose: choose one that bends the arm between them."
        if other
        else ""
    )
    sentences = {
        "right": (f"{joint} turned by {seen}, commanded {size}.{alike}", ""),
        "reversed": (
            f"{joint} turned by {seen}, commanded {size}: the other way.{alike}",
            "Give its pulses in the servo file in the opposite order, or turn the joint's sign in the model.",
        ),
        "gain": (
            f"{joint} turned by {seen}, commanded {size}: the wrong size.{alike}",
            "Check its servo's type and its table's angles; then calibrate it.",
        ),
        "another": (
            f"{joint} was commanded {size}, and {other} turned by {seen}.",
            f"Give {joint} the channel of {other} in the servo file, or change the plugs.",
        ),
        "still": (f"{joint} was commanded {size} and did not move.", "Check its plug, its channel and its supply."),
        "unclear": (
            f"{joint} was commanded {size}, and what moved is no joint of the model.",
            "Check that the tracker follows the tool, and the pose of its base (bench.bodies).",
        ),
    }
    sentence, mend = sentences[kind]
    return Verdict(joint, kind, sentence, mend, turned, other)


_TURNS_DEG = (12.0, -12.0, 6.0, -6.0)
IN_BASE = "the arm is commanded to hold its base pose"
_MODEL_SD_M, _ZERO_SD, _TARGET_SD_M = 0.004, math.radians(15.0), 0.01
"""Of the pose of an arm that sags and is not as drawn; of its zeros; of where the tracker's body sits."""
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


@dataclass(frozen=True)
class Turned:
    identity: DeviceIdentity
    moves: Sequence[Move]
    unseen: Sequence[Verdict]  # of joints that were not seen to stand
    measured: Mapping[str, Array]  # ``base_T_target`` by pose (4 x 4, m)
    mistake: FrameMistake | None  # of the tracker's frame

    def judged(self, base: Mapping[str, float], nominal: RigidArm) -> list[Verdict]:
        """What each joint did; InputError where one seems to turn wrongly in another frame than expected."""
        verdicts = [*(judged(self.moves, base, nominal) if self.moves else []), *self.unseen]
        if self.mistake is None or all(verdict.kind == "right" for verdict in verdicts):
            return verdicts
        reversed_ones = "Or servos of several joints are reversed: look which way each turns."
        hint = f"{self.mistake.mend} {reversed_ones if self.mistake.frame.is_mirrored else ''}".rstrip()
        raise InputError(f"{self.mistake.sentence}.", hint=hint)


def turned_a_little(
    prepare: Callable[[Mapping[str, Mapping[str, float]]], Prepared],
    base: Mapping[str, float],
    turns: Mapping[str, float],
    talk: Conversation,
    clock: Clock,
) -> Turned:
    """Turn joints one by one from the base pose, as a measuring run that is prepared for the poses by their ids."""
    poses: dict[str, dict[str, float]] = {}
    for joint, turn in turns.items():
        poses |= {f"base {joint}": {}, joint: {joint: base[joint] + turn}}
    prepared, log, ids = prepare(poses), Log(), tuple(poses)
    evidence = Evidence(prepared.arrival, lambda mistake: mistake.frame.is_mirrored, 2 * FEWEST)
    ending, identity = drive_poses(prepared, talk, log, clock, evidence)
    if ending.how == "refused":
        raise InputError(f"{ending.sentence}.", hint="Correct that, and check again.")
    check_ended(ending, log.progress, len(ids))
    seen = known_poses(ids, log.progress)
    measured = {ids[place]: pose for place, pose in seen.items()}
    moves, unseen = [], []
    for joint, turn in turns.items():
        missing = next((name for name in (f"base {joint}", joint) if name not in measured), None)
        if missing is None:
            moves.append(Move(joint, turn, measured[f"base {joint}"], measured[joint]))
        else:
            why = log.progress.left_out.get(missing, "it was not measured")
            unseen.append(Verdict(joint, "unclear", f"{joint}: it was not seen to stand ({why})."))
    return Turned(identity, moves, unseen, measured, evidence.mistake(seen))


def check_ended(ending: Ending, progress: Progress, total: int) -> None:
    is_over = len(progress.measured) + len(progress.left_out) >= total
    if ending.how == "held":
        raise StopRequested(ending.sentence, ending.arm)
    if ending.how == "parked" or (ending.how == "failed" and not is_over):
        raise StopRequested(ending.sentence, IN_BASE)


def check_joints(experiment: Experiment, talk: Conversation) -> JointCheck:
    """Turn each joint of servos that know where they stand a little, and write down which are checked.

    A zero that is far off makes limits and clearances wrong by as much: such a joint does not count as checked.
    """
    bench = Bench.of(experiment)
    own = bench.settings.acquisition.model_copy(update={"arrival": ANYWHERE})
    device, arm = bench.device(), bench.arm
    if not isinstance(device, MeasuringDevice):
        text = "found a device whose servos do not know where they stand, and no servo file."
        hint = "Name the servo file in bench.device.servos."
        raise ConfigError(text, where=experiment.source.where((SECTION, "device")), hint=hint)
    limits, joints = run_limits(experiment, own, arm), tuple(arm.commanded)
    nominal = RigidArm(arm, experiment.parameters)
    with bench.clock() as clock:
        with closing(device):
            open_device(device, clock)
            here = measured_angles(device)
        base = np.clip([here[joint] for joint in joints], limits[:, 0], limits[:, 1])
        park = dict(zip(joints, base.tolist(), strict=True))
        own = own.model_copy(update={"park": park})
        planner = PathPlanner(clearance_of(experiment, arm), limits, base[None], own.path_step)
        check_park(experiment, planner, heat_of(experiment, own, arm), base, joints)
        turns: dict[str, float] = {}
        for i, joint in enumerate(joints):
            for turn in np.deg2rad(_TURNS_DEG).tolist():
                turned = base + turn * np.eye(len(joints))[i]
                if planner.within(turned) and planner.clear(base, turned):
                    turns[joint] = turn
                    break
        commanded: dict[str, Array] = {}

        def prepare(poses: Mapping[str, Mapping[str, float]]) -> Prepared:
            for name, pose in poses.items():
                commanded[name] = np.array([{**park, **pose}[joint] for joint in joints])
            angles = np.array(list(commanded.values()))
            return of_poses(bench, own, device, tuple(poses), angles, np.zeros_like(angles), limits, base)

        turned_ones = turned_a_little(prepare, park, turns, talk, clock)
        at = clock.wall()
    verdicts, zeros = turned_ones.judged(park, nominal), dict[str, Zero]()
    if len(turned_ones.moves) == len(joints) and {verdict.kind for verdict in verdicts} <= {"right", "unclear"}:
        zeros = _zeros(experiment, arm, commanded, turned_ones.measured)
        # a zero that is far off turns the axes of the joints after it away from the model's
        verdicts = turned_ones.judged({joint: park[joint] + zeros[joint].value for joint in joints}, nominal)
    verdicts = [replace(verdict, mend=_MENDS.get(verdict.kind, verdict.mend)) for verdict in verdicts]
    for joint in joints:
        if joint not in turns:
            sentence = f"{joint} was not measured: there is nowhere to turn to."
            verdicts.append(Verdict(joint, "unclear", sentence, "Begin from a pose with more room about it."))
    if any(verdict.kind != "right" for verdict in verdicts):
        zeros = {}
    counted = [replace(v, kind="unclear") if v.joint in zeros and zeros[v.joint].is_far else v for v in verdicts]
    seen = {"adapter": turned_ones.identity.adapter, "by": "tracker", "at": at}
    noted(WiringRecord.of_config(experiment.source, here), counted, seen)
    return JointCheck(verdicts, zeros)


def _zeros(
    experiment: Experiment, arm: Arm, commanded: Mapping[str, Array], measured: Mapping[str, Array]
) -> dict[str, Zero]:
    """How much the joints' angles (rad, by pose, in the arm's order) are to be enlarged by."""
    scope, stated = measured_by(experiment)[0], experiment.parameters
    axes = [f"{scope}.target_{axis}" for axis in "xyz"]
    target = tuple(float(stated[name].nominal[0]) if name in stated.names else 0.0 for name in axes)
    poses, count = np.array(list(measured.values())), len(measured)
    angles = dict(zip(arm.commanded, np.array([commanded[name] for name in measured]).T, strict=True))
    numbers = [arm.joint_names.index(joint) + 1 for joint in arm.commanded]
    names = [f"{arm.name}.{TABLES}.zero{number}" for number in numbers]
    places = [f"{BODY}.seat_{axis}" for axis in "xyz"]
    free = {**dict.fromkeys(names, _ZERO_SD), **dict.fromkeys(places, _TARGET_SD_M)}
    by: By = "position" if np.isnan(poses[:, :3, :3]).any() else "pose"
    noise = np.full(count, _MODEL_SD_M / _LEVER_M), np.full(count, _MODEL_SD_M)
    seen = body_dataset(arm.name, angles, poses, noise)
    body = Body((arm.name,), by, NO_TURN, target)
    fit = BodyFit(experiment, arm, Corrections({}, numbers, ()), body, free, seen)
    fit.fit(seen, np.ones(count))
    sds = fit.deviations(names).tolist()
    return {joint: Zero(fit.value(name), sd) for joint, name, sd in zip(arm.commanded, names, sds, strict=True)}
