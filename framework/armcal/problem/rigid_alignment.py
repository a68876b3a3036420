"""Where a frame stands and where a target sits on a tool, from positions that the nominal arm should show.

Measured positions m_i = B (p_i + R_i o) + b: R_i and p_i are the tool's rotation and the target's nominal place in the
base frame, B and b the pose of that frame in the instrument's, o what the target is off on the tool. For a known o,
B and b are a Procrustes problem [Umeyama1991]; for a known B all else is linear. Many starts, each led to rest by
Gauss-Newton steps whose weights fall with the distance [Huber1981], so that a few wrong records decide nothing.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import islice

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.base.arrays import Array, Indices
from armcal.base.quaternions import nearest_turn
from armcal.problem.tool_motion import rigid_fit, spread_of

FEWEST = 8
"""Records: with fewer, nine numbers explain anything."""
_STARTS, _SHORT, _LONG, _KEPT, _FEW, _QUICK = 8, 8, 20, 2, 60, 5
_SEED = 3
_AT_REST, _SINGULAR = 1e-6, 1e-12
_SAME = 0.02
"""Of the spread of the positions: two alignments that show targets so near to each other are one."""
_UNSEEN, _PART = 1e-3, 0.3
"""Of the best determined direction: what is not determined; of a direction's largest part: what belongs to it."""
_STRIDES, _MOST_PAIRS = (1, 2, 3, 5), 600
_LONGEST_TURN_RAD = 2.6
"""Beyond it a rotation vector may jump to the other end of its axis."""


@dataclass(frozen=True)
class Tools:
    """What the nominal arm shows, in the base frame: places of targets (3 x N, m), rotations of tools (N x 3 x 3)."""

    places: Array
    rotations: Array

    def subset(self, chosen: Indices) -> Tools:
        return Tools(self.places[:, chosen], self.rotations[chosen])


@dataclass(frozen=True)
class Alignment:
    """A pose of the base frame in the instrument's, and a place of the target.

    Attributes:
        turn, shift: of the base frame (3 x 3; 3, m).
        offset: by which the target is moved, in the tool's axes (3, m).
        left: typical distance that is left (median, m).
    """

    turn: Array
    shift: Array
    offset: Array
    left: float

    def moved(self, tools: Tools) -> Array:
        """Where targets are then, in the instrument's frame (3 x N, m)."""
        places = tools.places + np.einsum("nij,j->in", tools.rotations, self.offset)
        return np.asarray(self.turn @ places + self.shift[:, None])

    def back(self, measured: Array) -> Array:
        """Measured positions in the base frame (3 x N, m)."""
        return np.asarray(self.turn.T @ (measured - self.shift[:, None]))


def alignments(tools: Tools, measured: Array, basis: Array, turned: Array | None = None) -> tuple[Alignment, ...]:
    """Alignments that no step improves on, the best first; empty with too few records.

    Args:
        tools: of the nominal arm.
        measured: positions in the instrument's frame (3 x N, m).
        basis: directions in the tool's axes along which the target may be elsewhere (3 x k).
        turned: measured rotations of a body on the tool (N x 3 x 3), if any.
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
    """How targets move (... x N x 3 x 6+n) by a turn about their middle, a shift, and along directions of the offset.

    Args:
        shown: where they are (... x N x 3, m).
        along: those directions in the instrument's frame (... x N x 3 x n).
    """
    arm = shown - shown.mean(axis=-2, keepdims=True)
    slopes = np.zeros((*shown.shape, 6 + along.shape[-1]))
    for axis in range(3):
        after, last = (axis + 1) % 3, (axis + 2) % 3
        slopes[..., after, axis], slopes[..., last, axis] = -arm[..., last], arm[..., after]
    slopes[..., 3:6] = np.eye(3)
    slopes[..., 6:] = along
    return slopes
