"""Other readings of recorded joints and positions: exchanged, reversed, of another unit, a row early or late.

And positions in one frame up to a record and in another from there on: the instrument was moved.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, permutations, product

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import Arm
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.base.units import digits
from armcal.errors import DataError, Location
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import Tools, nearest

Wires = Mapping[str, tuple[Mapping[str, float], float]]
"""Channels, each read as a sum of channels times factors, and a summand."""
_DEGREES, _TURN, _MRAD = 180 / np.pi, 360.0, 1000 * np.pi / 180
_ZEROS_DEG = (180, 90, -90)
"""What the zero of a joint is off by: half the counts of a servo, or where another convention has it."""
_MOST_SIGNS = 8
_AXES = "xyz"
_INCH = 25.4
_ROUNDED = 1e-6
_REACH_RATIO = 10.0
_ALIKE = 0.35  # In powers of ten: so alike are two distances of one unit
_FEWEST_ROWS, _NEARLY_ALL, _NEAREST = 3, 0.95, 1e-6
_NEAR = 0.2  # Of their distance from the base: so near are positions to where the nominal arm has them
_TURNED = 0.05
_FAR, _HALVINGS = 3.0, 60
FEWEST_IN_PART = 8  # Records in a part: an alignment has nine numbers
_PARTS, _ROUNDS = (0.25, 0.5, 0.75), 3
_UNITS = {"millimetres": 0.001, "centimetres": 0.01, "metres": 1.0, "inches": _INCH / 1000}
LENGTHS = (10.0, 0.1, 1000.0, 0.001, _INCH, 1 / _INCH, 1000 / _INCH, _INCH / 1000)
"""What lengths are off by that were read in mm, cm, m or inches and taken for another of these."""
_AXIS_LENGTHS = (10.0, 0.1, 1000.0, 0.001)
LEFT_HANDED = "a left-handed frame made right-handed (one axis reversed, or two exchanged)"


def single_joints(arm: Arm) -> list[tuple[str, Wires]]:
    """Each joint's sign, each two joints of a kind exchanged, and all angles, one, or one travel in another unit."""
    joints = tuple(arm.commanded)
    angles = {joint: joint for joint, dimension in arm.commanded.items() if dimension == "angle"}
    readings: list[tuple[str, Wires]] = [
        (f"the sign of {joint} reversed", _wires(arm, {joint: joint}, -1.0)) for joint in joints
    ]
    for one, other in combinations(joints, 2):
        if arm.commanded[one] == arm.commanded[other]:
            readings.append((f"{one} and {other} exchanged", _wires(arm, {one: other, other: one}, 1.0)))
    for factor in (_DEGREES, 1 / _DEGREES, _TURN, _MRAD, 1 / _MRAD):
        readings.append((f"joint angles {factor:.4g} times as large", _wires(arm, angles, factor)))
    for joint in joints:
        units = LENGTHS if joint not in angles else (_DEGREES,) if len(angles) > 1 else ()
        readings += [(f"{joint} {factor:.4g} times as large", _wires(arm, {joint: joint}, factor)) for factor in units]
    for joint, turn in product(angles, _ZEROS_DEG):
        readings.append((f"{turn} deg added to {joint}", _wires(arm, {joint: joint}, 1.0, np.radians(turn))))
    return readings


def coupled_joints(arm: Arm) -> Iterator[tuple[str, Wires]]:
    for joint, other in permutations(arm.commanded, 2):
        for sign in (1.0, -1.0) if arm.commanded[joint] == arm.commanded[other] else ():
            factor = arm.couplings.get(joint, {}).get(other, 0.0) + sign
            stated = f"state couplings: {{{joint}: {{{other}: {factor:g}}}}}" if factor else f"do not couple {joint}"
            words = f"{joint} {'+' if sign > 0 else '-'} {other} taken for {joint}"
            why = "(coupled joints, as the pendant of a Fanuc and the links of a palletiser have them: "
            channels = {f"{arm.name}.{joint}": 1.0, f"{arm.name}.{other}": sign}
            yield f"{words} {why}{stated})", {f"{arm.name}.{joint}": (channels, 0.0)}


def several_joints(arm: Arm) -> Iterator[tuple[str, Wires]]:
    """The signs of several joints, and joints in reverse order or shifted."""
    joints = tuple(arm.commanded)
    for size in range(2, len(joints) + 1) if len(joints) <= _MOST_SIGNS else ():
        for chosen in combinations(joints, size):
            words = f"the signs of {', '.join(chosen[:-1])} and {chosen[-1]} reversed"
            yield words, _wires(arm, {joint: joint for joint in chosen}, -1.0)
    if len(set(arm.commanded.values())) == 1:
        orders = [joints[::-1], *(joints[step:] + joints[:step] for step in range(1, len(joints)))]
        for order in orders if len(joints) > 2 else ():
            yield (
                f"({', '.join(order)}) taken for ({', '.join(joints)})",
                _wires(arm, dict(zip(joints, order, strict=True)), 1.0),
            )


def axes_words(order: Sequence[int], signs: Sequence[float]) -> str:
    moved = [i for i in range(3) if order[i] != i]
    negative = [_AXES[order[i]] for i in range(3) if signs[i] < 0]
    if len(moved) == 2 and not negative:
        return f"{_AXES[moved[0]]} and {_AXES[moved[1]]} exchanged"
    if not moved:
        return f"the sign{'s' * (len(negative) > 1)} of {' and '.join(negative)} reversed"
    taken = (f"{'-' if sign < 0 else ''}{_AXES[axis]}" for axis, sign in zip(order, signs, strict=True))
    return f"({', '.join(taken)}) taken for (x, y, z)"


def _wires(arm: Arm, joints: Mapping[str, str], factor: float, added: float = 0.0) -> Wires:
    return {
        f"{arm.name}.{part}{joint}": ({f"{arm.name}.{part}{other}": scale}, summand)
        for joint, other in joints.items()
        for part, scale, summand in (("", factor, added), ("approach.", float(np.sign(factor)), 0.0))
    }


def turned_axes() -> Iterator[tuple[str, Array]]:
    """All exchanges and signs of axes but none (3 x 3), in words."""
    for order in permutations(range(3)):
        for signs in product((1.0, -1.0), repeat=3):
            turn = np.zeros((3, 3))
            turn[range(3), order] = signs
            if not np.array_equal(turn, np.eye(3)):
                yield axes_words(order, signs), turn


def scaled_positions() -> Iterator[tuple[str, Array]]:
    """Positions, or one axis of them, in another unit (3 x 3), in words."""
    for factor in LENGTHS:
        yield f"positions {factor:.4g} times as large", factor * np.eye(3)
    for axis, factor in product(range(3), _AXIS_LENGTHS):
        scale = np.diag([factor if i == axis else 1.0 for i in range(3)])
        yield f"{_AXES[axis]} {factor:.4g} times as large", scale


def unit_mistaken(factor: float) -> str:
    pairs = product(_UNITS.items(), repeat=2)
    return next(f"{own} among {other}" for (own, size), (other, taken) in pairs if np.isclose(taken / size, factor))


def check_reach(problem: Problem, dataset: Dataset) -> None:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong, of all records or of some.

    Raises:
        DataError: which, and as which unit they are read.
    """
    shown = problem.predict(problem.parameters.nominal())
    for kernel, own in zip(problem.kernels, shown, strict=True):
        channels = kernel.factor.output_channels
        if [channel.rpartition(".")[2] for channel in channels] != ["x", "y", "z"]:
            continue
        name, measured = kernel.factor.name, dataset.stacked(channels)
        factor, wrong = _in_another_unit(measured, own.outputs[:3])
        if wrong.any():
            first, count = int(np.argmax(wrong)), int(wrong.sum())
            which, more = f"the position of record {dataset.ids[first]} is", ""
            if count > 1:
                which, more = f"{count} of {len(dataset)} positions are", f" (the first: record {dataset.ids[first]})"
            raise DataError(
                f"{name}: {which} about {digits(factor)} times as far from the base frame "
                f"as the model's tip, the others as far{more}: {unit_mistaken(factor)}?",
                where=Location(dataset.source, row=dataset.rows[first] if dataset.rows else None),
                hint="Write all rows in the unit of the column names.",
            )
        far, distances = (float(np.median(np.linalg.norm(x, axis=0))) for x in (own.outputs[:3], measured))
        if distances > _REACH_RATIO * far or far > _REACH_RATIO * distances:
            raise DataError(
                f"{name}: positions are typically {distances:.4g} m from the base frame, the model's tip {far:.4g} m.",
                where=Location(dataset.source),
                hint="Check the unit in the column names (x_mm or x_m) and the frame of the measurements.",
            )


def _in_another_unit(measured: Array, shown: Array) -> tuple[float, Mask]:
    """Positions so many times as far out as the model's (3 x N each, m), where the others are as far; or none.

    Many are known by their distances alone, as where half of them spoil the place of the base. Few are where the model
    has them once they are divided by that, and the others are typically where it has them.
    """
    far, distances, missed = (np.linalg.norm(x, axis=0) for x in (shown, measured, measured - shown))
    far = np.maximum(far, _NEAREST)
    orders = np.log10(np.where(distances > 0, distances, np.nan) / far)
    right = np.abs(orders) < _ALIKE
    # Near the origin any factor comes about by a little that the nominal arm is off.
    far_off = (missed > _NEAR * np.median(far)) & (np.nanmedian(missed / far) < _NEAR)
    best = np.inf, 1.0, np.zeros(len(far), dtype=bool)
    for factor in LENGTHS:
        off = np.abs(orders - np.log10(factor))
        wrong = off < _ALIKE
        if min(right.sum(), wrong.sum()) < _FEWEST_ROWS or np.mean(right | wrong) < _NEARLY_ALL:
            wrong = (np.linalg.norm(measured / factor - shown, axis=0) < _NEAR * far) & far_off
        if wrong.any():
            best = min(best, (float(np.median(off[wrong])), factor, wrong), key=lambda one: one[0])
    return best[1:]


@dataclass(frozen=True)
class TwoFrames:
    """Where the second frame begins (a place among the records), and what both leave (root mean square, m)."""

    begins: int
    left: float


def two_frames(tools: Tools, measured: Array, basis: Array) -> TwoFrames | None:
    """Records (3 x n, m) in recorded order, each part aligned by itself; None where they are too few.

    From a few divisions on, each part is aligned and the division put where both alignments leave least, in turn.
    """
    every = np.arange(measured.shape[1])
    if len(every) < 2 * FEWEST_IN_PART:
        return None
    divisions = []
    for part in _PARTS:
        begins = round(part * len(every))
        for _ in range(_ROUNDS):
            begins = min(max(begins, FEWEST_IN_PART), len(every) - FEWEST_IN_PART)
            halves = [nearest(tools.subset(own), measured[:, own], basis) for own in (every[:begins], every[begins:])]
            squares = [np.sum((measured - alignment.moved(tools)) ** 2, axis=0) for alignment in halves]
            before, after = (np.concatenate([[0.0], np.cumsum(square)]) for square in squares)
            left = before + after[-1] - after
            begins = int(np.argmin(left[FEWEST_IN_PART:-FEWEST_IN_PART])) + FEWEST_IN_PART
            divisions.append(TwoFrames(begins, float(np.sqrt(left[begins] / len(every)))))
    return min(divisions, key=lambda one: one.left)


def rewired(channels: Sequence[str], own: FactorRecords, read_as: Wires) -> FactorRecords:
    read = own.record.copy()
    for channel, (others, added) in read_as.items():
        if channel in channels and all(other in channels for other in others):
            parts = (factor * own.record[channels.index(other)] for other, factor in others.items())
            read[channels.index(channel)] = sum(parts, np.asarray(added))
    return replace(own, record=read, state=np.zeros_like(own.state))


def kept_spread(read: Array, measured: Array) -> float:
    """How far positions are spread as they are read (3 x N, m); as in their thinnest direction where that grew thinner.

    A reading that flattens what was measured hides anything in the direction in which it does.
    """
    own, given = (np.sqrt(np.maximum(np.linalg.eigvalsh(np.cov(p, bias=True)), 0.0)) for p in (read, measured))
    flattened = own[0] * np.linalg.norm(given) < (1 - _ROUNDED) * given[0] * np.linalg.norm(own)
    return float(np.sqrt(len(own)) * own[0] if flattened else np.linalg.norm(own))


@dataclass(frozen=True)
class Adapting:
    """Predicted positions (3 x N, m), and how the free parameters, in typical scales, move them: U S V' (3N x n)."""

    predicted: Array
    ways: Array
    sizes: Array

    def left(self, measured: Array, enough: float = np.inf) -> float:
        """Root mean square distance once the free parameters have adapted to first order, not too far (m).

        Where more than ``enough`` is left however far they adapt, that is given.
        """
        return float(self.left_of_each(measured[None], enough)[0])

    def left_of_each(self, measured: Array, enough: float) -> Array:
        """The same of several readings (k x 3 x N) of what was measured (k)."""
        off = (measured - self.predicted).transpose(0, 2, 1).reshape(len(measured), -1)
        along, unit = off @ self.ways, 3 / max(1, off.shape[1] - len(self.sizes))
        left = np.sum(off**2, axis=1) - np.sum(along**2, axis=1)
        for i in np.flatnonzero(unit * left <= enough**2):
            fitted = self.sizes * within(along[i], self.sizes, _FAR * np.sqrt(len(self.sizes)))
            left[i] += np.sum((along[i] - fitted) ** 2)
        return np.asarray(np.sqrt(unit * np.maximum(left, 0.0)))

    def can_move(self, turn: Array, shift: Array) -> bool:
        moved = (np.cross(Rotation.from_matrix(turn).as_rotvec(), self.predicted.T) + shift).ravel()
        along = self.ways.T @ moved
        return float(moved @ moved - along @ along) <= _TURNED**2 * float(moved @ moved)


def within(along: Array, sizes: Array, radius: float) -> Array:
    """The steps (n) that come nearest to ``along`` times ``sizes``, no longer than a radius. [Nocedal2006]"""
    steps = along / sizes
    if np.linalg.norm(steps) <= radius:
        return np.asarray(steps)
    low, high = 0.0, float(np.linalg.norm(along * sizes)) / radius
    for _ in range(_HALVINGS):
        damping = (low + high) / 2
        steps = along * sizes / (sizes**2 + damping)
        low, high = (damping, high) if np.linalg.norm(steps) > radius else (low, damping)
    return np.asarray(steps)


def is_place(names: Sequence[str]) -> bool:
    return tuple(name[-1:] for name in names[:3]) == tuple(_AXES)


def apart_in_groups(problem: Problem, number: int, values: Array) -> float:
    """How far single records of a group typically put its place from their middle (m): all are of one without groups.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at these values.
    """
    own = problem.records[number]
    groups = np.zeros(own.count) if own.group is None else own.group[: own.count]
    places = problem.grouped[number].nuisance_starts(values, own)[:3, : own.count]
    members = [np.flatnonzero(groups == group) for group in np.unique(groups[groups >= 0])]
    middles = [np.median(places[:, chosen], axis=1, keepdims=True) for chosen in members]
    away = [places[:, chosen] - middle for chosen, middle in zip(members, middles, strict=True)]
    return float(np.median(np.linalg.norm(np.hstack(away), axis=0))) if away else np.inf
