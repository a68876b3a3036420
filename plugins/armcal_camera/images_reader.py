"""Records from images: a folder of them, and a file that says where the arm stood for each."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.settings import Angle, InputPath, Settings
from armcal.base.units import from_unit
from armcal.errors import DataError, Location
from armcal.io.parallel import Executor, Report
from armcal.io.plain_files import input_bytes, refuse
from armcal.measure.reader import ReadRequest
from armcal.measure.tables import write_csv
from pydantic import Field

from armcal_camera.board import Board
from armcal_camera.detection import detect
from armcal_camera.images import MOST_BYTES, grey_image, is_image
from armcal_camera.intrinsics import other_size
from armcal_camera.pose_table import read_poses

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
    ``corners`` is where the records are written with the corners that were found, as the reader ``csv`` reads them.
    Poses of an arm with joints give their angles; ``first`` says about where they are in the first pose.
    """

    poses: InputPath | dict[str, Any]
    folder: InputPath | dict[str, InputPath]
    corners: InputPath | None = None
    first: dict[str, Angle] = Field(default_factory=dict)


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
        cameras = {name: tuple(boards) for name, m in request.measurements.items() if (boards := boards_of(m))}
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
            folder = _own(self._settings.folder, name, len(cameras))
            views = _taken_once(as_the_others(_views(folder, boards, partial(of_all, number))))
            size = next((view.size for view in views.values() if view.size and not view.fault), None)
            stated = image_size_of_intrinsics(request.measurements[name])
            if size and stated and (text := other_size(stated, (size[0] / 1000, size[1] / 1000))):
                raise DataError(f"{text}.", where=Location(str(folder)), hint=f"Correct measurements.{name}.")
            chosen = _matched(dataset, views, str(folder), count)
            faults.append({i: views[image].fault for i, image in enumerate(chosen) if views[image].fault})
            dataset = _with_corners(dataset, name, [views[image] for image in chosen], known)
            ids = tuple(chosen)
        blind = set.intersection(*(set(fault) for fault in faults))  # of several cameras one will do
        dataset = _left(replace(dataset, ids=ids), {i: "; ".join(fault[i] for fault in faults) for i in blind})
        if self._settings.corners is not None:
            write_csv(self._settings.corners, dataset, request.channels)
        return dataset


def boards_of(measurement: object) -> Sequence[Board]:
    """The boards whose points are the channels ``u_K`` and ``v_K`` of a measurement; none if it is no camera."""
    return getattr(measurement, "boards", ())


def image_size_of_intrinsics(measurement: object) -> tuple[float, float] | None:
    """Width and height (thousands of px) of the images that a camera's stated intrinsics are of, if it has any."""
    intrinsics = getattr(getattr(measurement, "settings", None), "intrinsics", None)
    return intrinsics.image if intrinsics else None


def _own(places: Path | Mapping[str, Path], camera: str, cameras: int) -> Path:
    if isinstance(places, Path) and cameras == 1:
        return places
    if isinstance(places, Mapping) and camera in places:
        return places[camera]
    stated = ", ".join(places) if isinstance(places, Mapping) else f"one folder for {cameras} cameras"
    hint = f"Write folder: {{{camera}: PATH, ...}} in the data section."
    raise DataError(f"found {stated}, expected a folder for the camera {camera} as well.", hint=hint)


def _views(folder: Path, boards: tuple[Board, ...], report: Report) -> dict[str, View]:
    """What each image of a camera says, by its name."""
    paths = _images_in(folder)
    made = Executor().map(partial(look, boards), paths, report)
    return {path.name: view for path, view in zip(paths, made, strict=True)}


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


def as_the_others(views: Mapping[str, View]) -> dict[str, View]:
    """Views, with a fault where the image differs from most in size (another camera took it) or is far less sharp."""
    sizes = [view.size for view in views.values() if view.size]
    usual = max(sizes, key=sizes.count, default=None)
    blur = float(np.nanmedian([view.blur for view in views.values()] + [np.inf]))

    def judged(view: View) -> View:
        if usual and view.size and view.size != usual:
            width, height = view.size
            text = f"it is {width} x {height} px, the others are {usual[0]} x {usual[1]}"
        elif not view.fault and view.blur > _BLURRED * blur:
            text = f"it is blurred: edges are {2 * view.blur:.1f} px wide, {2 * blur:.1f} px in most images"
        else:
            return view
        return replace(view, fault=text)

    return {name: judged(view) for name, view in views.items()}


def _taken_once(views: Mapping[str, View]) -> dict[str, View]:
    """Views, with a fault where an image is the very file that another is: the camera was not asked again."""
    first: dict[str, str] = {}
    return {
        name: replace(view, fault=f"it is the same image as {first[view.sha256]}")
        if not view.fault and first.setdefault(view.sha256, name) != name
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
