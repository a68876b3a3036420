"""A plugin for tests: a fixed camera sees the corners of a board on the tool; two rows of a residual a corner."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from importlib.metadata import EntryPoint
from typing import Any, ClassVar

import casadi as ca
from armcal.base.settings import Length, Settings
from armcal.hooks import Register, hookimpl
from armcal.measure.measurement import Channel

ENTRY_POINT = EntryPoint("board_camera", "board_camera", "armcal")
_DISTANCE = 1.2
"""m, from the base along its x axis; the camera looks back."""
_FOCAL = 0.008
"""m"""


class BoardSettings(Settings):
    """Corners in columns and rows, the length between them, and the noise of a place in the image."""

    columns: int
    rows: int
    square: Length
    noise: Length


class Board:
    """Channels ``u0``, ``v0``, ``u1``, ...: where the image of each corner is (m)."""

    Settings: ClassVar[type[BoardSettings]] = BoardSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"columns": 2, "rows": 1, "square_mm": 20, "noise_mm": 0.004}

    def __init__(self, settings: BoardSettings, arm_names: Sequence[str]) -> None:
        self._settings, self.arms = settings, (arm_names[0],)

    def parameters(self) -> tuple[()]:
        return ()

    def channels(self) -> tuple[Channel, ...]:
        count = self._settings.columns * self._settings.rows
        return tuple(Channel(f"{axis}{i}", "length") for i in range(count) for axis in "uv")

    def outputs(self, arms: Mapping[str, Any], values: Mapping[str, Any]) -> dict[str, Any]:
        base_T_tool, found = arms[self.arms[0]].base_T_tool, {}
        across = range(self._settings.columns)
        for i, (row, column) in enumerate((r, c) for r in range(self._settings.rows) for c in across):
            corner = ca.DM([column * self._settings.square, row * self._settings.square, 0.0])
            seen = ca.mtimes(base_T_tool.rotation, corner) + base_T_tool.translation
            depth = _DISTANCE - seen[0]
            found |= {f"u{i}": _FOCAL * seen[1] / depth, f"v{i}": _FOCAL * seen[2] / depth}
        return found

    def residual(self, arms: Mapping[str, Any], measured: Mapping[str, Any], values: Mapping[str, Any]) -> Any:
        return ca.vertcat(*[measured[name] - value for name, value in self.outputs(arms, values).items()])

    def noise(self) -> tuple[float, ...]:
        return (self._settings.noise,) * len(self.channels())

    def dimensions(self) -> tuple[str, ...]:
        return ("length",) * len(self.channels())


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    register("board", "board_camera:Board", "corners of a board on the tool, seen by a fixed camera")
