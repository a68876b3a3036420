"""Records from images: those of a folder, with a file that says where the arm stood for each; or as they come."""

from __future__ import annotations

import hashlib
import math
import re
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.arrays import Array
from armcal.base.config_text import resolve_path
from armcal.base.dataset import Dataset
from armcal.base.settings import Angle, InputPath, Settings
from armcal.base.units import from_unit
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.live import LiveCamera, Shot
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.io.parallel import Executor, Report
from armcal.io.plain_files import input_bytes, refuse
from armcal.measure.measurement import Measurement
from armcal.measure.reader import ReadRequest
from armcal.measure.tables import write_csv
from pydantic import BeforeValidator, Field
from typing_extensions import override

from armcal_camera.board import Board, opencv
from armcal_camera.camera import Camera
from armcal_camera.detection import MOST_BYTES, detect, grey_image
from armcal_camera.intrinsics import other_size
from armcal_camera.pose_table import read_poses

_FEWEST = 3
_BLURRED = 3.0
_NAMED = 5
_IMAGE = "image"
_IMAGES = frozenset((".png", ".jpg", ".jpeg", ".tif", ".tiff", ".bmp", ".webp", ".pgm", ".ppm", ".pnm"))
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
    corners: Array  # over all boards (K x 2, px)
    fault: str = ""  # why it says nothing
    size: tuple[int, int] | None = None
    blur: float = math.nan  # standard deviation across edges (px)
    sha256: str = ""
    oblique: float = math.nan  # between line of sight and normal of the board that is seen most obliquely (rad)


class ImagesReader:
    """The reader ``images``: a record an image, whose id is the image's name."""

    Settings: ClassVar[type[ImagesSettings]] = ImagesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"poses": "/no/such/folder/poses.csv", "folder": "/no/such/folder"}

    def __init__(self, settings: ImagesSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """The records, in SI; images that say nothing are set aside, each with its reason."""
        cameras = {name: m for name, m in request.measurements.items() if isinstance(m, Camera)}
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

        for number, (name, camera) in enumerate(cameras.items()):
            folder = _own(self._settings.folder, name, len(cameras))
            views = _taken_once(_as_the_others(_views(folder, camera.boards, partial(of_all, number))))
            size = next((view.size for view in views.values() if view.size and not view.fault), None)
            stated = camera.settings.intrinsics
            if (
                size
                and stated
                and stated.image
                and (text := other_size(stated.image, (size[0] / 1000, size[1] / 1000)))
            ):
                raise DataError(f"{text}.", where=Location(str(folder)), hint=f"Correct measurements.{name}.")
            chosen = _matched(dataset, views, str(folder), count)
            faults.append({i: views[image].fault for i, image in enumerate(chosen) if views[image].fault})
            seen = [views[image] for image in chosen]
            pixels = [np.full_like(view.corners, np.nan) if view.fault else view.corners for view in seen]
            channels = _corner_channels(name, np.stack(pixels, axis=1), known)
            digest = hashlib.sha256("".join([dataset.sha256, *(view.sha256 for view in seen)]).encode()).hexdigest()
            dataset = replace(dataset, channels={**dataset.channels, **channels}, sha256=digest)
            ids = tuple(chosen)
        blind = set.intersection(*(set(fault) for fault in faults))  # of several cameras one will do
        dataset = _left(replace(dataset, ids=ids), {i: "; ".join(fault[i] for fault in faults) for i in blind})
        if self._settings.corners is not None:
            write_csv(self._settings.corners, dataset, request.channels)
        return dataset


def _own(places: Path | Mapping[str, Path], camera: str, cameras: int) -> Path:
    if isinstance(places, Path) and cameras == 1:
        return places
    if isinstance(places, Mapping) and camera in places:
        return places[camera]
    stated = ", ".join(places) if isinstance(places, Mapping) else f"one folder for {cameras} cameras"
    hint = f"Write folder: {{{camera}: PATH, ...}} in the data section."
    raise DataError(f"found {stated}, expected a folder for the camera {camera} as well.", hint=hint)


def _views(folder: Path, boards: tuple[Board, ...], report: Report) -> dict[str, View]:
    paths = _images_in(folder)
    made = Executor().map(partial(_look, boards), paths, report)
    return {path.name: view for path, view in zip(paths, made, strict=True)}


def _look(boards: Sequence[Board], path: Path) -> View:
    return _look_at(boards, input_bytes(path, MOST_BYTES, "an image"), path.name)


def _look_at(boards: Sequence[Board], content: bytes, name: str) -> View:
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


def _is_image(path: Path) -> bool:
    return path.suffix.lower() in _IMAGES and not path.name.startswith(".")


def _images_in(folder: Path) -> list[Path]:
    try:
        files = list(folder.iterdir())
    except OSError as fault:
        refuse(folder, f"it cannot be read as a folder ({fault.strerror}).", "Give the folder of the images.")
    paths = [path for path in files if _is_image(path)]
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


def _as_the_others(views: Mapping[str, View]) -> dict[str, View]:
    """Views, with a fault where the image differs from most in size (another camera took it) or is far less sharp."""
    sizes = [view.size for view in views.values() if view.size]
    usual = max(sizes, key=sizes.count, default=None)
    blur = float(np.nanmedian([view.blur for view in views.values()] + [np.inf]))

    def judged(view: View) -> View:
        if usual and view.size and view.size != usual:
            return replace(view, fault="it is {} x {} px, the others are {} x {}".format(*view.size, *usual))
        if not view.fault and view.blur > _BLURRED * blur:
            text = f"it is blurred: edges are {2 * view.blur:.1f} px wide, {2 * blur:.1f} px in most images"
            return replace(view, fault=text)
        return view

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


def _corner_channels(camera: str, corners: Array, known: Collection[str]) -> dict[str, Array]:
    values = from_unit(corners, "px")
    return {
        f"{camera}.{axis}_{k}": np.ascontiguousarray(values[k, :, i])
        for k in range(len(values))
        for i, axis in enumerate("uv")
        if f"{camera}.{axis}_{k}" in known
    }


def _left(dataset: Dataset, faulty: Mapping[int, str]) -> Dataset:
    """The dataset without images that say nothing, which are listed."""
    named: dict[str, list[str]] = {}
    for i, reason in sorted(faulty.items()):
        named.setdefault(reason, []).append(dataset.ids[i])
    more = {reason: f" and {len(ids) - _NAMED} more" if len(ids) > _NAMED else "" for reason, ids in named.items()}
    shown = "; ".join(f"{', '.join(ids[:_NAMED])}{more[reason]}: {reason}" for reason, ids in named.items())
    kept = len(dataset) - len(faulty)
    if kept < _FEWEST:
        message = f"found {kept} of {len(dataset)} images that can be used, expected at least {_FEWEST} ({shown})."
        hint = "Check the board's settings (armcal board writes them), and take sharper images of the whole board."
        raise DataError(message, where=Location(dataset.source), hint=hint)
    if not faulty:
        return dataset
    warning = f"{len(faulty)} of {len(dataset)} images are set aside: {shown}."
    return replace(dataset.without(faulty), warnings=(*dataset.warnings, warning))


_WAITING = 5  # So many images a driver may hold back: they are older than the moment of asking
_PERIOD_S, _PATIENCE_S = 0.2, 2.0  # Between looks through a folder; how long a file that cannot be read is waited for
_KINDS = "the number of a camera (0), its device (/dev/video0), an address (rtsp://...), a video, or a folder"


def _named(value: object) -> object:
    text = str(value)
    if isinstance(value, bool) or text.isdecimal() or "://" in text:
        return text
    try:
        return str(resolve_path(value if isinstance(value, str) else text))
    except ConfigError as fault:
        raise ValueError(f"{fault.message} {fault.hint}") from fault


class LiveImagesSettings(Settings):
    """Where images come from.

    ``source`` is the number of a camera as OpenCV counts them, a device, an address or a video; or a folder to which
    another program writes an image for each posture. ``measurement`` names the camera where several are configured.
    """

    source: Annotated[str, BeforeValidator(_named)]
    measurement: str | None = None


class LiveImages(LiveCamera):
    """The live camera ``opencv``."""

    Settings: ClassVar[type[LiveImagesSettings]] = LiveImagesSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"source": "0"}

    def __init__(self, settings: LiveImagesSettings) -> None:
        self._settings, self.measurement = settings, settings.measurement or ""
        self._folder = Path(settings.source) if Path(settings.source).is_dir() else None
        self.gives_shots = self._folder is not None
        self._views: dict[str, View] = {}
        self._video: Any = None
        self._clock: Clock | None = None
        self._seen: set[str] = set()
        # Images that are being written: size and time of the file, and since when these have been so
        self._arriving: dict[str, tuple[tuple[int, int], float]] = {}
        self._looked = -math.inf

    @override
    def open(self, clock: Clock, measurements: Mapping[str, Measurement]) -> None:
        cameras = {name: m for name, m in measurements.items() if isinstance(m, Camera)}
        named = self._settings.measurement
        if named not in cameras and (named is not None or len(cameras) != 1):
            message = f"found the cameras {', '.join(cameras) or 'none'} among the measurements, expected "
            message += f"{named}." if named else "one."
            raise ConfigError(
                message, hint="Add a measurement of type camera, or name one: camera: {measurement: NAME}."
            )
        self.measurement = named or next(iter(cameras))
        self._boards = cameras[self.measurement].boards
        self._channels = cameras[self.measurement].channels()
        cv2, self._clock = opencv(), clock
        if self._folder is not None:
            self._seen = {path.name for path in self._images()}
            return
        source = self._settings.source
        cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # it writes about what is refused here
        self._video = cv2.VideoCapture(int(source) if source.isdecimal() else source)
        if not self._video.isOpened():
            text = "no camera opens there" if source.isdecimal() else "it is no camera, no video and no folder"
            hint = f"Give {_KINDS}, that no other program uses."
            raise DeviceRefusedError(f"{text}, so no images come.", where=Location(f"camera {source}"), hint=hint)

    @override
    def shots(self) -> list[Shot]:
        if self._folder is None or self._clock is None or self._clock.now() < self._looked + _PERIOD_S:
            return []
        self._looked = self._clock.now()
        fresh = sorted((path for path in self._images() if path.name not in self._seen), key=_written)
        return [shot for path in fresh if (shot := self._shot_in(path)) is not None]

    @override
    def shoot(self) -> Shot:
        nothing = Shot(b"", "", "", fault="the camera gave no image: is it still connected?")
        if self._video is None:
            return nothing
        for _ in range(_WAITING):
            self._video.grab()
        is_there, image = self._video.read()
        if not is_there:
            return nothing
        grey = image if image.ndim == 2 else opencv().cvtColor(image, opencv().COLOR_BGR2GRAY)
        content = opencv().imencode(".png", grey)[1].tobytes()
        return self._shot(_look_at(self._boards, content, "the image"), content, ".png", "the image")

    @override
    def close(self) -> None:
        if self._video is not None:
            self._video.release()
        self._video = self._clock = None

    def _images(self) -> list[Path]:
        assert self._folder is not None
        try:
            return [path for path in self._folder.iterdir() if _is_image(path)]
        except OSError as fault:
            text = f"it cannot be read as a folder ({fault.strerror})."
            raise InputError(text, where=Location(str(self._folder)), hint="Give the folder of the images.") from fault

    def _shot_in(self, path: Path) -> Shot | None:
        """What came in a file; None while it is being written."""
        assert self._clock is not None
        now = self._clock.now()
        try:
            state = path.stat().st_size, path.stat().st_mtime_ns
            is_as_before = self._arriving.get(path.name, (None,))[0] == state
            if not is_as_before:
                self._arriving[path.name] = state, now
                return None
            content = input_bytes(path, MOST_BYTES, "an image")
        except (OSError, DataError):
            return None
        view = _look_at(self._boards, content, path.name)
        if view.size is None and now < self._arriving[path.name][1] + _PATIENCE_S:
            return None  # no image yet: it may be cut off
        self._seen.add(path.name)
        return self._shot(view, content, path.suffix.lower(), path.name)

    def _shot(self, view: View, content: bytes, suffix: str, name: str) -> Shot:
        key = f"{len(self._views)}"
        view = _as_the_others({**self._views, key: view})[key]
        if view.fault:
            return Shot(content, suffix, f"{name}: {view.fault}", fault=f"{name}: {view.fault}.")
        self._views[key] = view
        known = {f"{self.measurement}.{channel.name}" for channel in self._channels}
        read = _corner_channels(self.measurement, view.corners[:, None], known)
        values = {channel: float(value[0]) for channel, value in read.items() if np.isfinite(value[0])}
        count = int(np.isfinite(view.corners[:, 0]).sum())
        seen = f"{name}: {count} of {len(view.corners)} corners, edges {2 * view.blur:.1f} px wide"
        return Shot(content, suffix, f"{seen}, seen at {math.degrees(view.oblique):.0f} deg", values)


def _written(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return math.inf
