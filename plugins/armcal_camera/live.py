"""Images as they come: from a camera of OpenCV, or one by one into a folder."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar

import numpy as np
from armcal.base.config_text import resolve_path
from armcal.base.settings import Settings
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceRefusedError
from armcal.devices.live import LiveCamera, Shot
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.io.plain_files import input_bytes
from armcal.measure.measurement import Measurement
from pydantic import BeforeValidator
from typing_extensions import override

from armcal_camera.images import MOST_BYTES, is_image, opencv
from armcal_camera.images_reader import View, as_the_others, boards_of, corner_channels, look_at

_WAITING = 5  # So many images a driver may hold back: they are older than the moment of asking
_PERIOD_S, _PATIENCE_S = 0.2, 2.0
"""A folder is looked through so often; a file that cannot be read is waited for so long."""
_KINDS = "the number of a camera (0), its device (/dev/video0), an address (rtsp://...), a video, or a folder"


def _named(value: object) -> object:
    text = str(value)
    if isinstance(value, bool) or text.isdecimal() or "://" in text:
        return text
    try:
        return str(resolve_path(value if isinstance(value, str) else text))
    except ConfigError as fault:
        raise ValueError(f"{fault.message} {fault.hint}") from fault


class CameraSettings(Settings):
    """Where images come from.

    ``source`` is the number of a camera as OpenCV counts them, a device, an address or a video; or a folder to which
    another program writes an image for each posture. ``measurement`` names the camera where several are configured.
    """

    source: Annotated[str, BeforeValidator(_named)]
    measurement: str | None = None


class Camera(LiveCamera):
    """The live camera ``opencv``."""

    Settings: ClassVar[type[CameraSettings]] = CameraSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"source": "0"}

    def __init__(self, settings: CameraSettings) -> None:
        self._settings, self.measurement = settings, settings.measurement or ""
        self._folder = Path(settings.source) if Path(settings.source).is_dir() else None
        self.gives_shots = self._folder is not None
        self._views: dict[str, View] = {}
        self._video: Any = None
        self._clock: Clock | None = None
        self._seen: set[str] = set()
        self._arriving: dict[str, tuple[tuple[int, int], float]] = {}
        """Images that are being written: size and time of the file, and since when these have been so."""
        self._looked = -math.inf

    @override
    def open(self, clock: Clock, measurements: Mapping[str, Measurement]) -> None:
        cameras = {name: m for name, m in measurements.items() if boards_of(m)}
        named = self._settings.measurement
        if named not in cameras and (named is not None or len(cameras) != 1):
            message = f"found the cameras {', '.join(cameras) or 'none'} among the measurements, expected "
            message += f"{named}." if named else "one."
            raise ConfigError(
                message, hint="Add a measurement of type camera, or name one: camera: {measurement: NAME}."
            )
        self.measurement = named or next(iter(cameras))
        self._boards = boards_of(cameras[self.measurement])
        self._channels = measurements[self.measurement].channels()
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
        return self._shot(look_at(self._boards, content, "the image"), content, ".png", "the image")

    @override
    def close(self) -> None:
        if self._video is not None:
            self._video.release()
        self._video = self._clock = None

    def _images(self) -> list[Path]:
        assert self._folder is not None
        try:
            return [path for path in self._folder.iterdir() if is_image(path)]
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
        view = look_at(self._boards, content, path.name)
        if view.size is None and now < self._arriving[path.name][1] + _PATIENCE_S:
            return None  # no image yet: it may be cut off
        self._seen.add(path.name)
        return self._shot(view, content, path.suffix.lower(), path.name)

    def _shot(self, view: View, content: bytes, suffix: str, name: str) -> Shot:
        """An image, judged beside those before."""
        key = f"{len(self._views)}"
        view = as_the_others({**self._views, key: view})[key]
        if view.fault:
            return Shot(content, suffix, f"{name}: {view.fault}", fault=f"{name}: {view.fault}.")
        self._views[key] = view
        known = {f"{self.measurement}.{channel.name}" for channel in self._channels}
        read = corner_channels(self.measurement, view.corners[:, None], known)
        values = {channel: float(value[0]) for channel, value in read.items() if np.isfinite(value[0])}
        count = int(np.isfinite(view.corners[:, 0]).sum())
        seen = f"{name}: {count} of {len(view.corners)} corners, edges {2 * view.blur:.1f} px wide"
        return Shot(content, suffix, f"{seen}, seen at {math.degrees(view.oblique):.0f} deg", values)


def _written(path: Path) -> float:
    try:
        return path.stat().st_mtime
    except OSError:
        return math.inf
