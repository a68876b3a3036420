"""Records from images: a folder of them, and a file that says where the arm stood for each.

Corners as CSV in long form, for those who detect them with other programs: ``image,board,point,u_px,v_px``.

``board`` counts from 0, and may be left out where there is one; ``point`` counts each board's points from 0. The
centre of an image's first pixel is at 0, 0.
"""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar, Protocol, TypeGuard, runtime_checkable

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import Angle, InputPath, Settings
from armcal.base.units import from_unit
from armcal.errors import DataError, Location
from armcal.io.parallel import Automatic, Report
from armcal.io.plain_files import input_bytes, refuse, write_over
from armcal.measure.reader import ReadRequest
from armcal.measure.tables import open_table
from pydantic import Field, model_validator

from armcal_camera.board import Board
from armcal_camera.detection import detect
from armcal_camera.images import MOST_BYTES, grey_image, is_image
from armcal_camera.pose_table import read_poses

COLUMNS = ("image", "board", "point", "u_px", "v_px")
_MAX_BYTES = 512 * 1024**2
_LAYOUT = f"Give a header {','.join(COLUMNS)} and a line a corner."


def read_corners(path: Path, boards: Sequence[Board]) -> tuple[dict[str, Array], str]:
    """The corners of each image (K x 2 over all boards, px), in the order in which images appear; and their sha256.

    Raises:
        DataError: with line and column.
    """
    with open_table(path, "a CSV file of corners", most=_MAX_BYTES, empty=_LAYOUT) as table:
        header = [cell.strip() for cell in table.first[1]]
        missing = [name for name in COLUMNS if name not in header and (name != "board" or len(boards) > 1)]
        if missing:
            text = f"found the columns {', '.join(header) or 'none'}, expected {', '.join(missing)} as well."
            refuse(path, text, _LAYOUT, 1)
        texts = [header.index(name) for name in ("image", "point", "board") if name in header]
        pixels = [(header.index(name), name) for name in ("u_px", "v_px")]
        read = table.columns(pixels, texts)
    images, points, *named = read.texts
    starts = np.cumsum([0, *(len(board.points) for board in boards)])
    corners: dict[str, Array] = {}
    for i, (line, u, v) in enumerate(zip(read.lines, *read.numbers, strict=True)):
        board = _count(path, line, "board", named[0][i], len(boards)) if named else 0
        point = _count(path, line, "point", points[i], len(boards[board].points))
        own = corners.setdefault(images[i].strip(), np.full((starts[-1], 2), np.nan))
        place = own[starts[board] + point]
        if not np.isnan(place).all():
            refuse(path, f"found the point {point} of this image again.", "Remove one of the lines.", line, "point")
        if np.isinf((u, v)).any():
            column = "u_px" if np.isinf(u) else "v_px"
            refuse(path, "found an infinite number, expected pixels.", "Leave the line out.", line, column)
        place[:] = u, v
    if not corners:
        refuse(path, "found a header and no corners.", _LAYOUT)
    return corners, table.sha256


def corners_text(corners: Mapping[str, Array], boards: Sequence[Board]) -> str:
    """The file that says the same; corners that were not seen are left out."""
    places = [(number, point) for number, board in enumerate(boards) for point in range(len(board.points))]
    lines = [",".join(COLUMNS)]
    for image, pixels in corners.items():
        shown = f'"{image}"' if "," in image else image
        lines += [
            f"{shown},{board},{point},{u:.5f},{v:.5f}"
            for (board, point), (u, v) in zip(places, pixels, strict=True)
            if math.isfinite(u) and math.isfinite(v)
        ]
    return "\n".join([*lines, ""])


def _count(path: Path, line: int, column: str, cell: str, number: int) -> int:
    text = cell.strip()
    if not (text.isascii() and text.isdecimal() and int(text) < number):
        message = f"found {text[:40]!r}, expected a whole number from 0 to {number - 1}."
        refuse(path, message, "Check which board of the measurement it is, and count from 0.", line, column)
    return int(text)


_FEWEST = 3
_BLURRED = 3.0
_NAMED = 5
_IMAGE = "image"
_OTHER_IMAGES = frozenset((".heic", ".heif", ".avif", ".gif", ".dng", ".cr2", ".cr3", ".nef", ".arw", ".raw"))


class ImagesSettings(Settings):
    """Where images and poses are.

    ``folder`` has the images of a camera, in the order of their names with numbers counted as such (2.png before
    10.png); with several cameras ``{camera: FOLDER}``. ``poses`` is a CSV file of joint angles, perhaps with a column
    ``image`` that names the file; for an arm ``flange_pose`` a table of base_T_flange (12 or 16 numbers a row, m), or
    columns x, y, z and qw, qx, qy, qz; or the settings of a reader, ``{type: pose_csv, path: FILE, euler: ...}``.
    ``corners`` is a CSV file of corners that stands for the images; with ``folder`` it is written. Poses of an arm
    with joints give their angles; ``first`` says about where they are in the first pose.
    """

    poses: InputPath | dict[str, Any]
    folder: InputPath | dict[str, InputPath] | None = None
    corners: InputPath | dict[str, InputPath] | None = None
    first: dict[str, Angle] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _some_images(self) -> ImagesSettings:
        if self.folder is None and self.corners is None:
            raise ValueError("found neither folder nor corners, expected the images, or the corners found in them")
        return self


@runtime_checkable
class SeesBoards(Protocol):
    """A measurement whose channels ``u_K`` and ``v_K`` are the points of its boards."""

    boards: Sequence[Board]


@dataclass(frozen=True)
class View:
    """What one image says: corners over all boards (K x 2, px), why it says nothing, its size, sharpness and path.

    ``oblique`` is the angle between line of sight and normal of the board that is seen most obliquely (rad).
    """

    corners: Array
    fault: str = ""
    size: tuple[int, int] | None = None
    blur: float = float("nan")
    sha256: str = ""
    path: str = ""
    oblique: float = float("nan")


class ImagesReader:
    """The reader ``images``: a record an image, whose id is the image's name."""

    Settings: ClassVar[type[ImagesSettings]] = ImagesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"poses": "/no/such/folder/poses.csv", "folder": "/no/such/folder"}

    def __init__(self, settings: ImagesSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """The records, in SI; images that say nothing are set aside, each with its reason.

        Raises:
            DataError: a file is refused, poses and images differ in number, or fewer than three images are left.
            PluginError: OpenCV is not there.
        """
        cameras = {name: tuple(m.boards) for name, m in request.measurements.items() if sees_boards(m)}
        if not cameras:
            message = "found no measurement that sees boards, expected one for the images."
            raise DataError(message, hint="Add a measurement of type camera.")
        dataset = read_poses(self._settings.poses, request, tuple(cameras), self._settings.first)
        named = dataset.extra.get(_IMAGE, ())
        if not all(text.strip() for text in named):  # the others are there for the joints' rates
            dataset = dataset.subset([i for i, text in enumerate(named) if text.strip()])
        count = len(dataset) + len(dataset.set_aside)
        faults: list[dict[int, str]] = []
        known = {w.channel for w in request.channels}

        def of_all(number: int, done: float) -> None:
            request.report((number + done) / len(cameras))

        for number, (name, boards) in enumerate(cameras.items()):
            views = _taken_once(as_the_others(self._views(name, boards, len(cameras), partial(of_all, number))))
            place = str(_own(self._settings.folder or self._settings.corners, name, len(cameras)))
            chosen = _matched(dataset, views, place, count)
            faults.append({i: views[image].fault for i, image in enumerate(chosen) if views[image].fault})
            dataset = _with_corners(dataset, name, [views[image] for image in chosen], known)
            ids = tuple(chosen)
        blind = set.intersection(*(set(fault) for fault in faults))  # of several cameras one will do
        return _left(replace(dataset, ids=ids), {i: "; ".join(fault[i] for fault in faults) for i in blind})

    def _views(self, camera: str, boards: tuple[Board, ...], cameras: int, report: Report) -> dict[str, View]:
        """What each image of a camera says, by its name."""
        folder = _own(self._settings.folder, camera, cameras)
        corners = _own(self._settings.corners, camera, cameras)
        if folder is None:
            assert corners is not None
            given, digest = read_corners(corners, boards)
            return {name: View(pixels, _too_few(pixels), sha256=digest) for name, pixels in given.items()}
        paths = _images_in(folder)
        made = Automatic().map(partial(look, boards), paths, report)
        views = {path.name: replace(view, path=str(path)) for path, view in zip(paths, made, strict=True)}
        if corners is not None:
            seen = {name: view.corners for name, view in _of_one_size(views).items() if not view.fault}
            write_over({corners: corners_text(seen, boards).encode()})
        return views


def sees_boards(measurement: object) -> TypeGuard[SeesBoards]:
    return isinstance(measurement, SeesBoards)


def _own(places: Path | Mapping[str, Path] | None, camera: str, cameras: int) -> Path | None:
    if isinstance(places, Mapping):
        if camera not in places:
            message = f"found {', '.join(places)}, expected the camera {camera} as well."
            raise DataError(message, hint=f"Write {{{camera}: PATH}} in the data section.")
        return places[camera]
    if places is not None and cameras > 1:
        message = f"found one path for {cameras} cameras, expected one for each."
        raise DataError(message, hint=f"Write {{{camera}: PATH, ...}} in the data section.")
    return places


def look(boards: Sequence[Board], path: Path) -> View:
    return look_at(boards, input_bytes(path, MOST_BYTES, "an image"), path.name)


def look_at(boards: Sequence[Board], content: bytes, name: str) -> View:
    """What an image file's content says of boards."""
    digest, nothing = hashlib.sha256(content).hexdigest(), np.full((sum(len(b.points) for b in boards), 2), np.nan)
    try:
        image = grey_image(content, name)
    except DataError as fault:
        return View(nothing, fault.message.rstrip("."), sha256=digest)
    made = [detect(image, board) for board in boards]
    seen = [detection for detection in made if not detection.fault]
    if not seen:
        return View(nothing, "; ".join(d.fault for d in made), image.shape[::-1], sha256=digest)
    corners = np.vstack([np.where(d.fault != "", np.nan, d.corners) for d in made])
    blur, oblique = max(d.blur for d in seen), max(d.oblique for d in seen)
    return View(corners, "", image.shape[::-1], blur, digest, oblique=oblique)


def _images_in(folder: Path) -> list[Path]:
    try:
        files = list(folder.iterdir())
    except OSError as fault:
        refuse(folder, f"it cannot be read as a folder ({fault.strerror}).", "Give the folder of the images.")
    paths = [path for path in files if is_image(path)]
    stems = {path.stem for path in paths}
    others = sorted(p.name for p in files if p.suffix.lower() in _OTHER_IMAGES and p.stem not in stems)
    if others:
        text = f"found {', '.join(others[:_NAMED])} ({len(others)} in all), a kind of image that is not read here."
        refuse(folder, text, "Save these as PNG or JPEG, or move them elsewhere.")
    if not paths:
        refuse(folder, "found no image in it.", "Give the folder of the images: PNG, JPEG, TIFF, BMP, WebP or PGM.")

    def natural(path: Path) -> list[tuple[int, str]]:  # 2.png stands before 10.png
        parts = re.split(r"(\d+)", path.name.lower())
        return [(int(part), "") if part.isdecimal() else (-1, part) for part in parts]

    return sorted(paths, key=natural)


def _too_few(pixels: Array) -> str:
    count = int(np.isfinite(pixels).all(axis=1).sum())
    return "" if count >= 4 else f"it has {count} corners, at least 4 are needed"


def as_the_others(views: Mapping[str, View]) -> dict[str, View]:
    """Views, with a fault where the image differs from the others in size or is far less sharp."""
    return _sharp_enough(_of_one_size(views))


def _taken_once(views: Mapping[str, View]) -> dict[str, View]:
    """Views, with a fault where an image is the very file that another is: the camera was not asked again."""
    first: dict[str, str] = {}
    text = "it is the same image as {}"
    return {
        name: replace(view, fault=text.format(first[view.sha256]))
        if view.path and not view.fault and first.setdefault(view.sha256, name) != name
        else view
        for name, view in views.items()
    }


def _of_one_size(views: Mapping[str, View]) -> dict[str, View]:
    """Views of images that are not as large as most say nothing: another camera took them, or another mode of it."""
    sizes = [view.size for view in views.values() if view.size]
    usual = max(sizes, key=sizes.count, default=None)
    text = "it is {0} x {1} px, the others are {2} x {3}"
    return {
        name: replace(view, fault=text.format(*view.size, *usual))
        if usual and view.size and view.size != usual
        else view
        for name, view in views.items()
    }


def _sharp_enough(views: Mapping[str, View]) -> dict[str, View]:
    """Views that are far less sharp than most say nothing: the camera moved."""
    usual = float(np.nanmedian([view.blur for view in views.values()] + [np.inf]))
    text = "it is blurred: edges are {:.1f} px wide, {:.1f} px in most images"
    return {
        name: replace(view, fault=text.format(2 * view.blur, 2 * usual))
        if not view.fault and view.blur > _BLURRED * usual
        else view
        for name, view in views.items()
    }


def _matched(dataset: Dataset, views: Mapping[str, View], place: str, count: int) -> list[str]:
    """Each record's image: the one that it names, else the one at its place in the order of names."""
    named = dataset.extra.get(_IMAGE)
    by_stem = {Path(name).stem: name for name in views}
    if named is None:
        known = set(views) | set(by_stem)
        others = [own for own, texts in dataset.extra.items() if {Path(t.strip()).name for t in texts} <= known]
        if others:
            refuse(
                dataset.source, f"found the images' names in the column {others[0]}.", "Call it image.", 1, others[0]
            )
        if count != len(views):
            message = f"found {count} poses in {dataset.source} and {len(views)} images, expected as many of each."
            hint = "Remove what does not belong, or name each record's file in a column image."
            raise DataError(message, where=Location(place), hint=hint)
        rows = sorted([*dataset.rows, *(record.row for record in dataset.set_aside)])
        names = list(views)
        return [names[rows.index(row)] for row in dataset.rows]
    chosen = list[str]()
    for row, text in zip(dataset.rows, named, strict=True):
        name = Path(text.strip()).name
        if name not in views and name not in by_stem:
            message = f"found the image {text.strip()[:60]!r}, which is not among the {len(views)} in {place}."
            refuse(dataset.source, message, "Correct its name, or remove the line.", row, _IMAGE)
        chosen.append(name if name in views else by_stem[name])
        if chosen[-1] in chosen[:-1]:
            refuse(dataset.source, f"found the image {chosen[-1]} again.", "Name each image once.", row, _IMAGE)
    return chosen


def corner_channels(camera: str, corners: Array, known: Collection[str]) -> dict[str, Array]:
    """The channels of a camera that are asked for, of corners in images (K x N x 2, px)."""
    values = from_unit(corners, "px")
    return {
        f"{camera}.{axis}_{k}": np.ascontiguousarray(values[k, :, i])
        for k in range(len(values))
        for i, axis in enumerate("uv")
        if f"{camera}.{axis}_{k}" in known
    }


def _with_corners(dataset: Dataset, camera: str, views: Sequence[View], known: set[str]) -> Dataset:
    pixels = [np.full_like(view.corners, np.nan) if view.fault else view.corners for view in views]
    channels = corner_channels(camera, np.stack(pixels, axis=1), known)
    digest = hashlib.sha256("".join([dataset.sha256, *(view.sha256 for view in views)]).encode()).hexdigest()
    return replace(dataset, channels={**dataset.channels, **channels}, sha256=digest)


def _left(dataset: Dataset, faulty: Mapping[int, str]) -> Dataset:
    """The dataset without images that say nothing, which are listed."""
    named: dict[str, list[str]] = {}
    for i, reason in sorted(faulty.items()):
        named.setdefault(reason, []).append(dataset.ids[i])
    shown = "; ".join(f"{', '.join(ids[:_NAMED])}{_more(ids)}: {reason}" for reason, ids in named.items())
    kept = len(dataset) - len(faulty)
    if kept < _FEWEST:
        message = f"found {kept} of {len(dataset)} images that can be used, expected at least {_FEWEST} ({shown})."
        hint = "Check the board's settings (armcal board writes them), and take sharper images of the whole board."
        raise DataError(message, where=Location(dataset.source), hint=hint)
    if not faulty:
        return dataset
    warning = f"{len(faulty)} of {len(dataset)} images are set aside: {shown}."
    return replace(dataset.without(faulty), warnings=(*dataset.warnings, warning))


def _more(names: Sequence[str]) -> str:
    return f" and {len(names) - _NAMED} more" if len(names) > _NAMED else ""
