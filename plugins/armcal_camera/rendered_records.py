"""Images of what a camera sees in simulated records: its boards, scaled and placed as the truth has them."""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, Protocol

import numpy as np
from armcal.base.domains import Array
from armcal.errors import ConfigError
from scipy.spatial.transform import Rotation

from armcal_camera.board import Board
from armcal_camera.lens import DISTORTION
from armcal_camera.library import opencv
from armcal_camera.render import Exposure, Lens, render

_USUAL = Exposure(blur=0.7, noise=2.0, light=0.1)


class _Seeing(Protocol):
    """What is needed of the measurement ``camera``."""

    @property
    def settings(self) -> Any: ...
    @property
    def boards(self) -> Sequence[Board]: ...
    @property
    def board_names(self) -> Sequence[str]: ...
    @property
    def camera_frame(self) -> str: ...
    @property
    def board_frame(self) -> str: ...
    @property
    def image(self) -> tuple[float, float] | None: ...


def rendered_records(camera: _Seeing, frames: Mapping[str, Array], values: Mapping[str, Array]) -> Iterator[bytes]:
    """The image file of each record; see ``Rendering``.

    Raises:
        ConfigError: the truth has a bent board, which cannot be drawn.
    """
    if any(float(values[f"{name}_bend_{axis}"][0]) for name in camera.board_names for axis in "xy"):
        raise ConfigError("found a board that is bent, expected flat ones: images are drawn of these alone.")
    kpx = 1000.0
    focal, centre = ([kpx * float(values[name][0]) for name in names] for names in (("fx", "fy"), ("cx", "cy")))
    size = [kpx * x for x in camera.image] if camera.image else [2 * x for x in centre]
    model = camera.settings.model
    distortion = tuple(float(values[name][0]) for name in DISTORTION[model])
    lens = Lens((focal[0], focal[1]), (centre[0], centre[1]), distortion, model == "fisheye")
    scale = float(values["board_scale"][0])
    carried = np.linalg.inv(frames[camera.camera_frame]) @ frames[camera.board_frame]
    for number, to_camera in enumerate(np.linalg.inv(_pose("camera", values)) @ carried):
        placed = []
        for board, name in zip(camera.boards, camera.board_names, strict=True):
            there = to_camera @ _pose(name, values)
            there[:3, 3] /= scale  # the whole picture of a larger board is that of one nearer by
            placed.append((board, there))
        exposure = Exposure(_USUAL.blur, _USUAL.noise, _USUAL.light, seed=number)
        image = render(placed, lens, (round(size[0]), round(size[1])), exposure)
        yield opencv().imencode(".png", image)[1].tobytes()


def _pose(name: str, values: Mapping[str, Array]) -> Array:
    """4 x 4 (m)."""
    pose = np.eye(4)
    pose[:3, :3] = Rotation.from_quat(values[f"{name}_rotation"], scalar_first=True).as_matrix()
    pose[:3, 3] = [float(values[f"{name}_{axis}"][0]) for axis in "xyz"]
    return pose
