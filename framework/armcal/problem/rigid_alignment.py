"""Where a frame stands and where a target sits on a tool, from positions that the nominal arm should show.

Measured positions m_i = B (p_i + R_i o) + b: R_i and p_i are the tool's rotation and the target's nominal place in the
base frame, B and b the pose of that frame in the instrument's, o what the target is off on the tool. For a known o,
B and b are a Procrustes problem [Umeyama1991]; for a known B all else is linear. Many starts, each led to rest by
Gauss-Newton steps whose weights fall with the distance [Huber1981], so that a few wrong records decide nothing.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import islice
from typing import Self

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.quaternions import nearest_turn
from armcal.measure.groups import OTHER
from armcal.problem.problem import Problem

_STEP = 1e-4


def along(problem: Problem, values: Array, direction: Array) -> Array:
    """How tools move along a direction of the parameters in typical scales (tools x 3 x N), by differences."""
    parameters = problem.parameters
    here = parameters.coordinates(parameters.local(values))
    step = _STEP * direction * parameters.scales()
    sides = [parameters.retract(parameters.from_coordinates(here + sign * step)) for sign in (1.0, -1.0)]
    up, down = (tools(problem, side)[0] for side in sides)
    return np.asarray((up - down) / (2 * _STEP))


def tools(problem: Problem, values: Array) -> tuple[Array, Array]:
    """All tools, one for each measurement and arm: places (tools x 3 x N, m) and axes (tools x axis x 3 x N)."""
    tools = np.concatenate([shown.tools for shown in problem.predict(values)])
    return tools[:, 3], tools[:, :3]


def unseen_motions(at: Array, axes: Array) -> list[Array]:
    """Motions of all tools together, and of the point of each tool that is meant: columns (tools * 3 * N)."""
    motions = [np.broadcast_to(axis[None, :, None], at.shape) for axis in np.eye(3)]
    motions += [np.cross(axis[None, :, None], at, axis=1) for axis in np.eye(3)]
    for tool, axis in np.ndindex(len(axes), 3):
        moved = np.zeros((len(axes), *axes.shape[2:]))
        moved[tool] = axes[tool, axis]
        motions.append(moved)
    return [motion.ravel() for motion in motions]


def apart_from(columns: Array, moves: Array) -> Array:
    """What is left of moves (m x k) that columns (m x n) do not make up for."""
    scaled = columns / np.maximum(np.linalg.norm(columns, axis=0), 1e-300)
    return np.asarray(moves - scaled @ np.linalg.lstsq(scaled, moves, rcond=1e-9)[0])


def spread_of(points: Array) -> float:
    """Root mean square distance of points (3 x N) from their middle."""
    return float(np.sqrt(np.sum(np.var(points, axis=1))))


def rigid_fit(points: Array, others: Array) -> tuple[Array, Array]:
    """The turn R (3 x 3) and the shift t (3) that bring points (3 x N) nearest to others. [Umeyama1991]"""
    middle, other = points.mean(axis=1), others.mean(axis=1)
    turn = nearest_turn((others - other[:, None]) @ (points - middle[:, None]).T)
    return turn, other - turn @ middle


FEWEST = 8  # Records: with fewer, nine numbers explain anything
_STARTS, _SHORT, _LONG, _KEPT, _FEW, _QUICK = 8, 8, 20, 2, 60, 5
_SEED = 3
_AT_REST, _SINGULAR = 1e-6, 1e-12
_SAME = 0.02  # Of the spread of the positions: two alignments that show targets so near to each other are one
_UNSEEN, _PART = 1e-3, 0.3
"""Of the best determined direction: what is not determined; of a direction's largest part: what belongs to it."""
_STRIDES, _MOST_PAIRS = (1, 2, 3, 5), 600
_LONGEST_TURN_RAD = 2.6  # Beyond it a rotation vector may jump to the other end of its axis


@dataclass(frozen=True)
class Tools:
    """What the nominal arm shows, in the base frame: places of targets (3 x N, m), rotations of tools (N x 3 x 3)."""

    places: Array
    rotations: Array

    def subset(self, chosen: Indices) -> Self:
        return replace(self, places=self.places[:, chosen], rotations=self.rotations[chosen])


@dataclass(frozen=True)
class Alignment:
    turn: Array  # of the base frame (3 x 3)
    shift: Array  # of it (3, m)
    offset: Array  # by which the target is moved, in the tool's axes (3, m)
    left: float  # typical distance that is left (median, m)

    def moved(self, tools: Tools) -> Array:
        """Where targets are then, in the instrument's frame (3 x N, m)."""
        places = tools.places + np.einsum("nij,j->in", tools.rotations, self.offset)
        return np.asarray(self.turn @ places + self.shift[:, None])

    def back(self, measured: Array) -> Array:
        return np.asarray(self.turn.T @ (measured - self.shift[:, None]))


def alignments(tools: Tools, measured: Array, basis: Array, turned: Array | None = None) -> tuple[Alignment, ...]:
    """Alignments that no step improves on, the best first; empty with too few records.

    ``measured`` are positions in the instrument's frame (3 x N, m), ``basis`` directions in the tool's axes along which
    the target may be elsewhere (3 x k), ``turned`` measured rotations of a body on the tool (N x 3 x 3), if any.
    """
    if measured.shape[1] < FEWEST:
        return ()
    few = np.arange(0, measured.shape[1], max(1, measured.shape[1] // _FEW))
    some, seen = tools.subset(few), measured[:, few]
    starts = [_started(some, seen, *start) for start in _starts(tools, measured, basis, turned)]
    short = sorted(_led(some, seen, basis, starts, _SHORT), key=lambda alignment: alignment.left)
    near, apart = _SAME * spread_of(measured), list[Alignment]()
    for start in short:
        if len(apart) < _KEPT and all(_between(tools, start, other) > near for other in apart):
            (alignment,) = _led(tools, measured, basis, [start], _LONG)
            if all(_between(tools, alignment, other) > near for other in apart):
                apart.append(alignment)
    return tuple(sorted(apart, key=lambda alignment: alignment.left))


def nearest(tools: Tools, measured: Array, basis: Array) -> Alignment:
    few = np.arange(0, measured.shape[1], max(1, measured.shape[1] // _FEW))
    some, seen = tools.subset(few), measured[:, few]
    starts = [_started(some, seen, *start) for start in islice(_starts(some, seen, basis, None), _QUICK)]
    best = min(_led(some, seen, basis, starts, _SHORT), key=lambda alignment: alignment.left)
    return _led(tools, measured, basis, [best], _QUICK)[0]


def _between(tools: Tools, one: Alignment, other: Alignment) -> float:
    return float(np.median(np.linalg.norm(one.moved(tools) - other.moved(tools), axis=0)))


def undetermined(tools: Tools, alignment: Alignment, basis: Array) -> tuple[str, ...]:
    """Combinations of base and target that such positions do not determine, in words."""
    shown = alignment.moved(tools)
    slopes = _slopes(shown.T, alignment.turn @ tools.rotations @ basis)
    slopes[:, :, :3] /= max(spread_of(shown), _SINGULAR)
    _, sizes, directions = np.linalg.svd(slopes.reshape(-1, slopes.shape[2]), full_matrices=False)
    words = [f"the base {how} {axis}" for how in ("about", "along") for axis in "xyz"]
    for column in basis.T:
        axis, numbers = int(np.argmax(np.abs(column))), ", ".join(f"{x:.2g}" for x in column)
        words.append(f"the target along {'xyz'[axis] if np.abs(column[axis]) > 1 - _UNSEEN else f'({numbers})'}")
    parts = [
        [word for word, part in zip(words, np.abs(direction), strict=True) if part > _PART * np.abs(direction).max()]
        for direction in directions[sizes < _UNSEEN * sizes.max()]
    ]
    return tuple(" with ".join(part) for part in parts)


def hand_eye(rotations: Array, turned: Array) -> tuple[Array, Array]:
    """B and X (3 x 3 each) of rotations M_i = B R_i X (N x 3 x 3 each), by turns between records. [Park1994]"""
    index = np.arange(len(rotations))
    pairs = [(index[:-step], index[step:]) for step in _STRIDES if step < len(index)]
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    every = slice(None, None, max(1, -(-len(first) // _MOST_PAIRS)))
    first, second = first[every], second[every]
    both = [np.swapaxes(of[first], 1, 2) @ of[second] for of in (rotations, turned)]
    nominal, seen = (Rotation.from_matrix(turn).as_rotvec() for turn in both)
    usable = np.linalg.norm(nominal, axis=1) < _LONGEST_TURN_RAD
    mounted = nearest_turn(nominal[usable].T @ seen[usable])
    return nearest_turn(np.einsum("nij,kj,nlk->il", turned, mounted, rotations)), mounted


def _starts(tools: Tools, measured: Array, basis: Array, turned: Array | None) -> Iterator[tuple[Array, Array | None]]:
    """Offsets of the target (3, m), and turns of the base where they are known; the first as configured."""
    yield np.zeros(3), None
    if turned is not None:
        yield np.zeros(3), hand_eye(tools.rotations, turned)[0]
    if not basis.shape[1]:
        return
    # Of the linear problem m = M p + N vec(R) + b: M is near B, N[i, 3 j + k] near B[i, j] o[k].
    columns = np.vstack([tools.places, tools.rotations.reshape(-1, 9).T])
    columns = columns - columns.mean(axis=1, keepdims=True)
    solved = np.linalg.lstsq(columns.T, (measured - measured.mean(axis=1, keepdims=True)).T, rcond=1e-6)[0].T
    turn = nearest_turn(solved[:, :3])
    yield basis @ (basis.T @ np.einsum("ijk,ij->k", solved[:, 3:].reshape(3, 3, 3), turn) / 3), turn
    random = np.random.default_rng(_SEED)
    for _ in range(_STARTS):
        yield basis @ random.normal(scale=0.5 * spread_of(measured), size=basis.shape[1]), None


def _started(tools: Tools, measured: Array, offset: Array, turn: Array | None) -> Alignment:
    points = tools.places + np.einsum("nij,j->in", tools.rotations, offset)
    if turn is None:
        turn, shift = rigid_fit(points, measured)
    else:
        shift = np.median(measured - turn @ points, axis=1)
    return Alignment(turn, shift, offset, np.inf)


def _led(tools: Tools, measured: Array, basis: Array, starts: Sequence[Alignment], steps: int) -> list[Alignment]:
    """Each start after Gauss-Newton steps, to rest or so many; the base turns about the middle of the targets."""
    size, seen, ways = max(spread_of(measured), _SINGULAR), measured.T, tools.rotations @ basis
    turn, shift, offset = (np.array([getattr(s, name) for s in starts]) for name in ("turn", "shift", "offset"))
    moving = np.arange(len(starts))
    for _ in range(steps):
        now, shown = turn[moving], _shown(tools, turn[moving], shift[moving], offset[moving])
        slopes = _slopes(shown, now[:, None] @ ways)
        slopes[..., :3] /= size
        off = seen - shown
        distance = np.sqrt(np.sum(off**2, axis=2))
        root = 1 / np.sqrt(np.maximum(distance, 1.5 * np.median(distance, axis=1, keepdims=True) + _SINGULAR))
        weighted = (slopes * root[..., None, None]).reshape(len(now), -1, slopes.shape[3])
        gradient = weighted.transpose(0, 2, 1) @ (off * root[..., None]).reshape(len(now), -1, 1)
        sizes, axes = np.linalg.eigh(weighted.transpose(0, 2, 1) @ weighted)
        kept = np.where(sizes > _SINGULAR * sizes[:, -1:], sizes, np.inf)
        step = (axes @ (axes.transpose(0, 2, 1) @ gradient / kept[..., None]))[..., 0]
        further, middle = Rotation.from_rotvec(step[:, :3] / size).as_matrix(), shown.mean(axis=1)
        shift[moving] = (further @ (shift[moving] - middle)[..., None])[..., 0] + middle + step[:, 3:6]
        turn[moving], offset[moving] = further @ now, offset[moving] + step[:, 6:] @ basis.T
        moving = moving[np.linalg.norm(step, axis=1) >= _AT_REST * size]
        if not len(moving):
            break
    left = np.median(np.linalg.norm(seen - _shown(tools, turn, shift, offset), axis=2), axis=1)
    return [Alignment(t, s, o, float(own)) for t, s, o, own in zip(turn, shift, offset, left, strict=True)]


def _shown(tools: Tools, turns: Array, shifts: Array, offsets: Array) -> Array:
    """Where targets are by k alignments, in the instrument's frame (k x N x 3, m)."""
    places = tools.places.T + (tools.rotations @ offsets[:, None, :, None])[..., 0]
    return np.asarray(places @ turns.transpose(0, 2, 1) + shifts[:, None])


def _slopes(shown: Array, along: Array) -> Array:
    """How targets (... x N x 3) move by a turn about their middle, a shift, and along directions (... x N x 3 x n)."""
    arm = shown - shown.mean(axis=-2, keepdims=True)
    slopes = np.zeros((*shown.shape, 6 + along.shape[-1]))
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        slopes[..., after, axis], slopes[..., last, axis] = -arm[..., last], arm[..., after]
    slopes[..., 3:6] = np.eye(3)
    slopes[..., 6:] = along
    return slopes


_SAME_M = 1e-6
_QUATERNION = ("qw", "qx", "qy", "qz")


@dataclass(frozen=True)
class Sighting:
    """Records of a measurement that reads positions in a frame, all of one arm."""

    kernel: int  # which measurement
    chosen: Indices  # places of its records (n)
    measured: Array  # positions (3 x n, m)
    turned: Array | None = None  # rotations of the body that was measured (n x 3 x 3); None where only positions are

    @property
    def size(self) -> float:
        return spread_of(self.measured)

    def subset(self, places: Indices) -> Self:
        turned = None if self.turned is None else self.turned[places]
        return replace(self, chosen=self.chosen[places], measured=self.measured[:, places], turned=turned)

    def thinned(self, most: int) -> Self:
        return self.subset(np.arange(0, len(self.chosen), max(1, -(-len(self.chosen) // most))))

    def off(self, tools: Tools) -> float:
        squares = np.sum((self.measured - tools.places) ** 2, axis=0)
        if self.turned is not None:
            turns = Rotation.from_matrix(np.swapaxes(tools.rotations, 1, 2) @ self.turned).magnitude()
            squares = squares + (self.size * turns) ** 2
        return float(np.sqrt(np.median(squares)))


def sighting_of(problem: Problem, dataset: Dataset, number: int, most: int) -> Sighting | None:
    """At most so many records of a measurement; None of one that reads no positions of a single arm in a frame."""
    factor = problem.kernels[number].factor
    channels = factor.position_channels
    if not channels or factor.dimensions[:3] != ("length",) * 3 or not all(map(dataset.has, channels)):
        return None
    if any(OTHER in name for name in factor.channels) or len(problem.blueprint.measurements[factor.name].arms) != 1:
        return None
    whole = np.flatnonzero(problem.records[number].measured)
    chosen = whole[:: max(1, -(-len(whole) // most))] if len(whole) else whole
    if not len(chosen):
        return None
    some, values = problem.subset(chosen), problem.parameters.nominal()
    measured, shown = dataset.stacked(channels)[:, chosen], some.predict(values)[number].outputs[:3]
    if not np.allclose(some.residuals(values)[number][:3], measured - shown, atol=_SAME_M):
        return None
    quaternion = [f"{factor.name}.{part}" for part in _QUATERNION]
    reads_turn = set(quaternion) <= set(factor.output_channels) and all(map(dataset.has, quaternion))
    turned = _rotations(dataset.stacked(quaternion)[:, chosen]) if reads_turn else None
    return Sighting(number, chosen, measured, turned)


def tools_of(problem: Problem, values: Array, number: int) -> Tools:
    """What a measurement's arm shows in each of its records: of the body if its rotation is read, else of the tool."""
    shown = problem.grouped[number].predict(values, problem.records[number])
    parts = [channel.rpartition(".")[2] for channel in problem.kernels[number].factor.output_channels]
    if set(_QUATERNION) <= set(parts):
        return Tools(shown.outputs[:3], _rotations(shown.outputs[[parts.index(part) for part in _QUATERNION]]))
    return Tools(shown.outputs[:3], np.ascontiguousarray(np.transpose(shown.tools[0, :3], (2, 1, 0))))


def _rotations(quaternions: Array) -> Array:
    return np.asarray(Rotation.from_quat(quaternions[[1, 2, 3, 0]].T).as_matrix())


def shown_instead(problem: Problem, number: int, shown: Tools) -> Problem:
    """The problem as if the instrument of one measurement had seen this."""
    factor, record = problem.kernels[number].factor, problem.records[number]
    changed = record.record.copy()
    turned = Rotation.from_matrix(shown.rotations).as_quat()[:, [3, 0, 1, 2]].T
    readings = dict(zip((*"xyz", *_QUATERNION), (*shown.places, *turned), strict=True))
    for row, channel in enumerate(factor.channels):
        name, _, part = channel.rpartition(".")
        if name == factor.name and part in readings and channel in factor.output_channels:
            changed[row, : record.count] = readings[part]
            changed[row, record.count :] = readings[part][-1]
    own = replace(record, record=changed, state=record.state.copy(), correlation=None, present=None)
    return problem.with_record(number, own)
