"""The exporter ``ros2-node``: a file for those who have ROS 2, between its topics and armcal's sockets."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest
from armcal.errors import ConfigError

_TEMPLATE = Path(__file__).with_name("templates") / "node.py.in"
_CHANNELS = {"tip_position": False, "tip_pose": True}
"""Measurements that a node feeds, and whether they read orientations."""


class NodeSettings(Settings):
    """Which measurement feeds the recalibration (the only one unless said), its folder, and the server's socket."""

    measurement: str | None = None
    folder: str = "kept"
    serve_socket: str = "arm.sock"


class Ros2NodeExporter:
    """One Python file; it holds names alone, and asks a served calibration for the rest."""

    Settings: ClassVar[type[NodeSettings]] = NodeSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}
    holds_residual = True

    def __init__(self, settings: NodeSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        s = self._settings
        own = {name: str(i.settings.get("type")) for name, i in request.instruments.items()}
        usable = {name: _CHANNELS[kind] for name, kind in own.items() if kind in _CHANNELS}
        name = s.measurement or (next(iter(usable)) if len(usable) == 1 else "")
        if name not in usable:
            listed = ", ".join(f"{name} ({kind})" for name, kind in own.items()) or "none"
            text = f"found the measurements {listed}, expected {s.measurement or 'one'} "
            hint = f"Give --option measurement=NAME: {', '.join(usable)}." if usable else "A node feeds tip positions."
            raise ConfigError(f"{text}of type tip_position or tip_pose.", hint=hint)
        constants = {
            "ARM": request.name,
            "CALIBRATION": request.digest,
            "JOINTS": list(request.arm.commanded),
            "SLIDING": [joint for joint, kind in request.arm.commanded.items() if kind == "length"],
            "MEASUREMENT": name,
            "IS_POSE": usable[name],
            "FOLDER": s.folder,
            "SERVE_SOCKET": s.serve_socket,
        }
        lines = "\n".join(f"{key} = {value!r}" for key, value in constants.items())
        text = _TEMPLATE.read_text(encoding="utf-8").replace("@CONSTANTS@", lines)
        return Exported(
            text.encode(), 0, remarks=(f"run armcal recalibrate with --from socket --out {s.folder} beside it",)
        )
