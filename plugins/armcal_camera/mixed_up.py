"""Images that cannot be of what is stated: corners in another order, poses in another form, two boards for one.

The turn between two poses and the shift along its axis are the same seen from the hand and from the camera, wherever
the camera sits: pairs of images show what does not belong together before anything is fitted.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from armcal.base.arrays import Array, Indices, Mask
from armcal.errors import ProblemError
from scipy.spatial.transform import Rotation

from armcal_camera.hand_eye import hand_eye, homography

_BENT, _STRAIGHT = 0.05, 0.01
"""Of the size of a board's image: corners of another board, and of this one through an ordinary lens."""
_FEWEST = 8
_TURN_RAD, _SHIFT_M = np.radians(10.0), 0.05
"""What the errors of a nominal arm and of a first guess of the lens may make of pairs."""
_OTHER_RAD, _OTHER_SHARE = np.radians(5.0), 0.15
"""Turns that differ by so much, and by such a share of what the hand turns, are not the same."""
_LEAST_ACROSS, _TIMES_WITHIN, _CLEARLY = 0.15, 5.0, 4.0
"""Of pairs across two groups: the share that contradicts, by that within; and by how much they are further off. Errors
of a nominal arm alone, up to 2 deg a joint, made groups that are 2.8 times further apart than within."""
_POOR, _GOOD, _TIMES_BETTER = 0.02, 0.1, 5.0
"""How far off poses are, as a share of the hand's motion plus rad: what is looked into, and what is well enough."""
_GAINS = (1e-3, 1e-2, 0.0254, 0.1, 10.0, 39.37, 100.0, 1e3)
_ALONE, _TOGETHER, _TIMES_ALONE = 0.35, 0.85, 10.0
"""Of the other images: the share with which one agrees that belongs to another pose, and with which the rest agree; how
many times further off than others it is. In 200 sound recordings one image was 6 times, and agreed with 0.29."""


def require_board_axes(views: Sequence[tuple[Array, Array]]) -> None:
    """Refuse corners that lie as if columns and rows were exchanged; views are whole boards and their images.

    Raises:
        ProblemError: most lie so.
    """
    as_stated, exchanged = [], []
    for points, image in views:
        order = np.lexsort((points[:, 1], points[:, 0]))  # column by column
        size = float(np.max(np.ptp(image, axis=0)))
        as_stated.append(_off(points, image) / size)
        exchanged.append(_off(points[order], image) / size)
    if views and np.median(as_stated) > _BENT and np.median(exchanged) < _STRAIGHT:
        raise ProblemError(
            "the corners of the board lie as if its columns and rows were exchanged.",
            hint="Exchange columns and rows of the board's settings, or count its corners row by row.",
        )


def require_form(moved: Array, seen: Array) -> None:
    """Refuse poses of the hand (N x 4 x 4) that fit camera_T_board (N x 4 x 4) only if they are read in another form.

    Raises:
        ProblemError: in millimetres, inverted, of the next image, and so on they fit far better.
    """
    stated = _misfit(moved, seen)
    if len(moved) < _FEWEST or stated < _POOR:
        return
    forms = [(_misfit(a, b), words) for a, b, words in _forms(moved, seen)]
    best, words = min(forms, key=lambda form: form[0])
    if best < min(_GOOD, stated / _TIMES_BETTER):
        raise ProblemError(
            f"poses of the hand and images do not fit each other as they are read; they do if {words}.",
            hint="Correct that in the file of poses, or in the settings that say how it is read.",
        )


def _misfit(moved: Array, seen: Array) -> float:
    """How far off the best places of camera and board are, as a share of the hand's motion plus rad (medians)."""
    b = np.asarray(np.linalg.inv(seen), dtype=float)
    solved = hand_eye(moved, b)
    if solved is None:
        return np.inf
    here, there = moved @ solved.x, solved.y @ b
    motion = np.median(np.linalg.norm(moved[:, :3, 3] - moved[:, :3, 3].mean(axis=0), axis=1))
    off = np.median(np.linalg.norm((here - there)[:, :3, 3], axis=1))
    turns = Rotation.from_matrix(np.swapaxes(here[:, :3, :3], 1, 2) @ there[:, :3, :3]).magnitude()
    return float(off / max(motion, 1e-9) + np.median(turns))


def _forms(moved: Array, seen: Array) -> Iterator[tuple[Array, Array, str]]:
    """Other forms in which poses and images may have been meant, and what each would mean."""
    yield moved[1:], seen[:-1], "each pose belongs to the image before it"
    yield moved[:-1], seen[1:], "each pose belongs to the image after it"
    yield moved[::-1], seen, "the poses go from the last image to the first"
    as_text = np.argsort(np.argsort([str(i + 1) for i in range(len(moved))]))
    yield moved[as_text], seen, "the poses are in the order of the images 1, 10, 11, ..., 2 (names as text)"
    mirror = np.diag([-1.0, 1.0, 1.0, 1.0])
    yield moved, mirror @ seen @ mirror, "the images are mirrored"
    read = Rotation.from_matrix(moved[:, :3, :3])
    angles, quaternions = read.as_euler("ZYX")[:, ::-1], read.as_quat()
    turns = {
        "": moved[:, :3, :3],
        "rotations are inverted (rows for columns)": np.swapaxes(moved[:, :3, :3], 1, 2),
        "quaternions read as wxyz are xyzw": Rotation.from_quat(np.roll(quaternions, 1, axis=1)).as_matrix(),
        "quaternions read as xyzw are wxyz": Rotation.from_quat(np.roll(quaternions, -1, axis=1)).as_matrix(),
        "rx, ry, rz are a rotation vector": Rotation.from_rotvec(angles).as_matrix(),
        "rx, ry, rz turn about moving axes, x first (XYZ)": Rotation.from_euler("XYZ", angles).as_matrix(),
    }
    forms = [(_posed(turned, moved[:, :3, 3]), words) for words, turned in turns.items()]
    inverse = np.asarray(np.linalg.inv(moved), dtype=float)
    for poses, words in [*forms, (inverse, "poses are those of the base in the flange's frame")]:
        if words:
            yield poses, seen, words
        for gain in _GAINS:
            larger = f"positions are multiplied by {gain:g}, or the board's sizes by {1 / gain:g} (another unit)"
            scaled = _posed(poses[:, :3, :3], gain * poses[:, :3, 3])
            yield scaled, seen, " and ".join(filter(None, (words, larger)))


def _posed(rotations: Array, places: Array) -> Array:
    poses = np.tile(np.eye(4), (len(places), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = rotations, places
    return poses


def require_one_board(moved: Array, seen: Array, ids: Sequence[str]) -> None:
    """Refuse poses of the hand (N x 4 x 4) and camera_T_board (N x 4 x 4) of which pairs contradict each other.

    Raises:
        ProblemError: some images show another board, or hand and images do not match.
    """
    if len(moved) < _FEWEST:
        return
    (turns, shifts), (other_turns, other_shifts) = _pairs(moved), _pairs(np.asarray(np.linalg.inv(seen), dtype=float))
    off, slid = abs(turns - other_turns), abs(shifts - other_shifts)
    agree, apart = (off < _TURN_RAD) & ((slid < _SHIFT_M) | np.isnan(slid)), ~np.eye(len(moved), dtype=bool)
    alone = _contradicting(agree, off, slid)
    if len(alone):
        names = ", ".join(ids[i] for i in alone)
        raise ProblemError(
            f"the hand does not move to {names} as the board is seen to move, while the other "
            f"{len(moved) - len(alone)} images agree with their poses.",
            hint="Check which image belongs to which pose, or leave these out.",
        )
    first = np.linalg.eigh(agree - np.mean(agree[apart]))[1][:, -1] > 0
    groups = sorted((np.flatnonzero(which) for which in (first, ~first)), key=len)
    further = max(_times_further(off, *groups), _times_further(slid, *groups)) if len(groups[0]) >= 3 else 0.0
    if further > _CLEARLY:
        across = float(np.mean(~agree[np.ix_(*groups)]))
        within = max(float(np.mean(~agree[np.ix_(group, group)])) for group in groups)
        if across > max(_LEAST_ACROSS, _TIMES_WITHIN * within):
            raise ProblemError(
                f"{len(groups[0])} of {len(moved)} images show a board that stands elsewhere than in the others: "
                "two boards, or one that was moved.",
                hint="Leave the images of one of them out, or state both (boards: [...]); they must not look alike.",
            )
    if np.median(off[apart]) > max(_OTHER_RAD, _OTHER_SHARE * np.median(turns[apart])):
        raise ProblemError(
            "the hand does not turn between images as the board is seen to turn: typically "
            f"{np.degrees(np.median(off[apart])):.0f} deg off.",
            hint="Check the order and signs of the joints and their unit, and which image belongs to which pose.",
        )


def _contradicting(agree: Mask, *off: Array) -> Indices:
    """Images that agree with few of the others, where those agree among themselves; none if they are many.

    Each must be further off than others are: a board seen small, or at the edge of a first guess of the lens, is off.
    """
    share = (agree.sum(axis=1) - agree.diagonal()) / (len(agree) - 1)
    typical = [np.nanmedian(np.where(np.eye(len(own), dtype=bool), np.nan, own), axis=1) for own in off]
    is_far = np.any([own > _TIMES_ALONE * np.nanmedian(own) for own in typical], axis=0)
    is_alone = (share < _ALONE) & is_far
    alone, rest = np.flatnonzero(is_alone), np.flatnonzero(~is_alone)
    is_group = len(alone) >= 3 and np.mean(agree[np.ix_(alone, alone)]) > _TOGETHER
    if is_group or not 0 < len(alone) <= len(agree) / 4 or np.mean(agree[np.ix_(rest, rest)]) < _TOGETHER:
        return np.zeros(0, dtype=np.intp)
    return alone


def _times_further(off: Array, first: Indices, second: Indices) -> float:
    apart = np.where(np.eye(len(off), dtype=bool), np.nan, off)
    within = max(float(np.nanmedian(apart[np.ix_(group, group)])) for group in (first, second))
    return float(np.nanmedian(apart[np.ix_(first, second)])) / max(within, 1e-9)


def _pairs(poses: Array) -> tuple[Array, Array]:
    """Of the motion between any two poses how far it turns (rad) and shifts along its axis (m; nan without a turn)."""
    between = np.linalg.inv(poses)[:, None] @ poses[None]
    vectors = Rotation.from_matrix(between[..., :3, :3].reshape(-1, 3, 3)).as_rotvec().reshape(*between.shape[:2], 3)
    turns = np.linalg.norm(vectors, axis=2)
    with np.errstate(invalid="ignore", divide="ignore"):
        shifts = np.abs(np.sum(vectors * between[..., :3, 3], axis=2) / np.where(turns > _TURN_RAD, turns, np.nan))
    return turns, shifts


def _off(points: Array, image: Array) -> float:
    shown = np.c_[points[:, :2], np.ones(len(points))] @ homography(points[:, :2], image).T
    return float(np.sqrt(np.mean(np.sum((shown[:, :2] / shown[:, 2:] - image) ** 2, axis=1))))
