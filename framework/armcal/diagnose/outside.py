"""What residuals might depend on outside of the arm: gravity, load, the instrument's scale and axes, sudden jumps."""

from collections.abc import Iterator, Sequence

import numpy as np

from armcal.arm.assembly import shown_joint
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.diagnose.dependences import Dependence, Records
from armcal.diagnose.held import Moves
from armcal.measure.measurement import NamesMistakes
from armcal.problem.motion import Motion, recorded_order
from armcal.problem.problem import FactorRecords, Problem

_AXES = ("x", "y", "z")
_MOST_STEPS, _MOST_SLIPS = 40, 12
"""Places at which something may have jumped are looked at: of all that is measured, and of each joint."""
_FEWEST_APART = 4
_LOAD_PARTS = (slice(0, 3), slice(3, 4), slice(4, 8))
"""Of the loads that motion knows slopes by: turns of gravity, its size, mass and place of a payload."""
_STEP_MEASURE = "repeat some of the first poses now, and look at what was touched at that time"


def outside(
    problem: Problem,
    motion: Motion,
    dataset: Dataset,
    positions: Sequence[Array],
    moves: Moves,
) -> Iterator[Dependence]:
    """Everything that these records could show; ``positions`` are what instruments should read."""
    here = Records(dataset, motion)
    yield from _of_mistakes(here, problem, moves)
    if motion.by_load:
        by_load = [slope.transpose(0, 2, 1) for slope in motion.by_load]  # n_r x N x (gravity's turn, size, load)
        level = "level the base, or measure its tilt with a spirit level; gravity is stated in the instrument's frame"
        weigh = "weigh what hangs on the tool"
        turns = tuple(f"turned about {axis}" for axis in _AXES)
        gravity, size, load = (tuple(slope[:, :, part] for slope in by_load) for part in _LOAD_PARTS)
        words, effect = "the direction of gravity in the base frame", "statics.gravity_r?, freed"
        yield Dependence("gravity", "", "", words, effect, level, gravity, turns, "rad")
        words = "the size of gravity, or of all masses together"
        yield Dependence("gravity", "size", "", words, "statics.gravity_m_s2", weigh, size, ("share",), "1")
        words = "a load at the tool that is not stated"
        yield Dependence("load", "", "", words, "statics.payload_g", weigh, load)
    yield from _of_instrument(here, positions)
    yield from _of_steps(here, problem, positions)


def _of_instrument(here: Records, read: Sequence[Array]) -> Iterator[Dependence]:
    """Scale and axes of instruments that measure positions; all of them alike."""
    if not any(np.any(position) for position in read):
        return
    zeros = [np.zeros((size, len(here.dataset), 1)) for size in here.sizes]

    def columns(*entries: tuple[int, int]) -> tuple[Array, ...]:
        """What is read along one axis grows with the coordinate on another: one column for each such pair."""
        parts = []
        for own, zero in zip(read, zeros, strict=True):
            part = np.repeat(zero, len(entries), axis=2)
            for k, (row, other) in enumerate(entries if len(own) else ()):
                part[row, :, k] = -own[other]
            parts.append(part)
        return tuple(parts)

    known = "measure a known length along each axis with the instrument"
    together = tuple(np.sum(part, axis=2, keepdims=True) for part in columns((0, 0), (1, 1), (2, 2)))
    words = "the instrument's scale, along all axes alike"
    yield Dependence("scale", "", "", words, "", known, together, ("share",), "1")
    for i, axis in enumerate(_AXES):
        words = f"the instrument's scale along {axis}"
        yield Dependence("scale", axis, "", words, "", known, columns((i, i)), ("share",), "1")
    words = "the instrument's axes, which are not at right angles"
    labels = tuple(f"between {_AXES[i]} and {_AXES[j]}" for i, j in ((0, 1), (0, 2), (1, 2)))
    yield Dependence("scale", "axes", "", words, "", known, columns((0, 1), (0, 2), (1, 2)), labels, "rad")


def predicted_positions(
    problem: Problem, values: Array, records: Sequence[FactorRecords], dataset: Dataset
) -> tuple[Array, ...]:
    """What each factor should read of a position (3 x N; m), 0 where it reads none; nothing (0 x N) of other factors.

    Not what it does read: the noise of that would be taken for a scale.
    """
    positions = []
    for kernel, off in zip(problem.kernels, problem.residuals(values, records), strict=True):
        channels = kernel.factor.position_channels
        read = bool(channels) and all(map(dataset.has, channels))
        positions.append(np.nan_to_num(dataset.stacked(channels) - off[:3]) if read else np.zeros((0, len(dataset))))
    return tuple(positions)


def _of_steps(here: Records, problem: Problem, read: Sequence[Array]) -> Iterator[Dependence]:
    """Something that moved once, between two records."""
    order = recorded_order(here.dataset)
    if np.ptp(order) <= 0:
        return
    ids = [here.dataset.ids[i] for i in np.argsort(order, kind="stable")]
    rank = np.argsort(np.argsort(order, kind="stable"), kind="stable")
    turns = [np.zeros((size, len(rank), 3)) for size in here.sizes]
    for part, own in zip(turns, read, strict=True):
        part[: len(own)] = np.stack([np.cross(axis, own, axisc=0, axisb=0) for axis in np.eye(3)], 2) if len(own) else 0
    for place in _places(len(rank), _MOST_STEPS):
        after = (rank >= place).astype(float)[:, None]
        words = f"whether a record was measured before or after {ids[place]}: what is measured jumps there as a whole"
        effect, shifts = "the records before and after as groups of their own", here.axes(after)
        yield Dependence("step", "", "", words, effect, _STEP_MEASURE, shifts, jumps=True)
        if any(map(np.any, turns)):
            both = tuple(np.concatenate(p, axis=2) for p in zip(shifts, (t * after for t in turns), strict=True))
            yield Dependence("step", "", "", f"{words}, and turns", effect, _STEP_MEASURE, both, jumps=True)
    for channel in here.motion.channels:
        arm, _, joint = channel.partition(".")
        shown = shown_joint(channel, problem.blueprint.arms)
        si = "rad" if problem.blueprint.arms[arm].commanded[joint] == "angle" else "m"
        for place in _places(len(rank), _MOST_SLIPS):
            along = here.along(channel, (rank >= place).astype(float)[:, None])
            words = f"whether a record was measured before or after {ids[place]}: {shown} slips there"
            yield Dependence("slip", shown, arm, words, "", _STEP_MEASURE, along, ("slip",), si, jumps=True)


def _of_mistakes(here: Records, problem: Problem, moves: Moves) -> Iterator[Dependence]:
    """What instruments say may have gone wrong with them meanwhile."""
    order, many = recorded_order(here.dataset), len(problem.blueprint.measurements) > 1
    ranked = np.argsort(order, kind="stable")
    rank = np.argsort(ranked, kind="stable")
    for name, measurement in problem.blueprint.measurements.items():
        for one in measurement.mistakes() if isinstance(measurement, NamesMistakes) else ():
            if one.course == "always":
                continue
            blocks = [problem.parameters[f"{name}.{p}"] for p in one.parameters]
            shares = [float(block.nominal[0]) if one.together else 1.0 for block in blocks]
            own = [[share * part for part in moves[b.name]] for share, b in zip(shares, blocks, strict=True)]
            columns = [np.concatenate(parts, axis=2) for parts in zip(*own, strict=True)]
            moved = [part.sum(axis=2, keepdims=True) for part in columns] if one.together else columns
            subject, words = (name if many else ""), f"{name}: {one.words}" if many else one.words
            labels, unit = (("change",), "1") if one.together and one.course != "once" else ((), "")
            if np.ptp(order) > 0 and one.course == "slowly":
                course = tuple(move * (rank / max(len(rank) - 1, 1) - 0.5)[:, None] for move in moved)
                yield Dependence(one.kind, subject, "", words, "", one.measure, course, labels, unit)
            elif np.ptp(order) > 0:
                for place in _places(len(rank), _MOST_SLIPS):
                    jump = tuple(move * (rank >= place)[:, None] for move in moved)
                    at = f"whether a record was measured before or after {here.dataset.ids[ranked[place]]}: {words}"
                    yield Dependence(one.kind, subject, "", at, "", one.measure, jump, jumps=True)


def _places(count: int, most: int) -> list[int]:
    inner = np.arange(_FEWEST_APART, count - _FEWEST_APART + 1)
    step = max(_FEWEST_APART, -(-len(inner) // most))
    return [int(i) for i in inner[step // 2 :: step]]
