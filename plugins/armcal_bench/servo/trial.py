"""Whether each joint of a new arm turns as commanded: the right one, the right way, as far as the model has it."""

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import combinations, permutations
from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.devices.wiring import WiringRecord
from armcal.errors import InputError
from scipy.spatial.transform import Rotation

from armcal_bench.servo.record import BEGUN, POSE
from armcal_bench.servo.rigid_arm import RigidArm, turn_of_point, twist_angles
from armcal_bench.settling import pose_of

_LEVER_M = 0.1
_STILL = math.radians(1.5)
_STILL_M = 0.002
_GAIN_OFF = 0.25
_USUAL_M = 0.004  # How far a move of a few degrees lies from the model's, since arms sag and are not as drawn
_UNCLEAR_M = 0.02
_EACH_FAULT, _MOST, _UNSURE = 4.0, 100.0, 4.0
_USUAL_TURN = math.radians(10.0)
_SURE = 40.0
_TURN = 2 * math.pi


@dataclass(frozen=True)
class Verdict:
    """What a joint did."""

    joint: str  # that was commanded
    kind: str  # ``right``, ``reversed``, ``gain``, ``another``, ``still``, ``wrapped`` or ``unclear``
    sentence: str  # what was seen
    mend: str = ""  # what to do; empty if nothing
    turned: float = math.nan  # the measured angle (rad); NaN where none is known
    other: str = ""  # the joint that moved instead, or that cannot be distinguished


def noted(record: WiringRecord, verdicts: Sequence[Verdict], seen: Mapping[str, Any]) -> None:
    """Write down as checked the joints that turned as commanded, and as no other joint did.

    Raises:
        InputError: it cannot be written; what was seen is said.
    """
    right = [verdict.joint for verdict in verdicts if verdict.kind == "right" and not verdict.other]
    try:
        record.note(right, [verdict.joint for verdict in verdicts if verdict.joint not in right], seen)
    except InputError as fault:  # what was seen must not be lost with it
        sentences = " ".join(f"{verdict.sentence} {verdict.mend}".rstrip() for verdict in verdicts)
        message = f"{fault.message} The check itself: {sentences}"
        raise InputError(message, where=fault.where, hint=fault.hint) from fault


@dataclass(frozen=True, eq=False)
class Move:
    """What was seen when a joint was commanded to turn (rad): the tool's pose before and after (4 x 4, base frame).

    Rotations may be NaN.
    """

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
    """Which joint each command moves, and with which sign."""

    moves: Mapping[str, str]
    signs: Mapping[str, int]

    @property
    def faults(self) -> int:
        return sum(a != b for a, b in self.moves.items()) + sum(sign < 0 for sign in self.signs.values())

    def pose(self, base: Mapping[str, float]) -> dict[str, float]:
        """Where the joints stand then (rad)."""
        return {self.moves[joint]: self.signs[joint] * angle for joint, angle in base.items()}


def judged(moves: Sequence[Move], base: Mapping[str, float], nominal: RigidArm) -> list[Verdict]:
    """What each joint did, by all that was seen together.

    A swapped or reversed servo stands elsewhere in the base pose too, so that the axes of the joints after it are not
    where the model has them: each wiring with a few faults is tried, and the one that explains all moves with the
    fewest faults is taken.

    Args:
        moves: one of each joint that was tried.
        base: the angles of all joints that the pulses command (rad).
        nominal: the model.
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


def wrapped(joint: str, table: tuple[float, ...], limits: tuple[float, float]) -> Verdict | None:
    """Whether a table's angles lie a turn away from where the joint moves (rad)."""
    turns = round((sum(table) / len(table) - sum(limits) / 2) / _TURN)
    if not turns:
        return None
    return Verdict(
        joint,
        "wrapped",
        f"{joint}: its table says {math.degrees(table[0]):.0f} to {math.degrees(table[-1]):.0f} deg, "
        f"{turns:+d} turn{'s' * (abs(turns) != 1)} away from the joint's {math.degrees(limits[0]):.0f} to "
        f"{math.degrees(limits[1]):.0f} deg.",
        f"Subtract {360 * turns} deg from its angles in the servo file.",
    )


def answered(joint: str, commanded: float, ask: Callable[[str], str]) -> Verdict:
    size = f"{math.degrees(commanded):+.0f} deg"
    wish = ask(
        f"{joint} was commanded to turn by {size}. y: it did, r: the other way, o: another joint did, n: nothing moved"
    )
    kinds = {"y": ("right", commanded), "r": ("reversed", -commanded), "o": ("another", math.nan), "n": ("still", 0.0)}
    kind, turned = kinds.get(wish, ("unclear", math.nan))
    return _verdict(kind, joint, commanded, turned, "another joint" if kind == "another" else "")


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
            f"{joint} was commanded {size}, and {other} turned{'' if math.isnan(turned) else f' by {seen}'}.",
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
