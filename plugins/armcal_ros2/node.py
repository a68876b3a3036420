"""The exporter ``ros2-node``: a file for those who have ROS 2, between its topics and armcal's sockets."""

import ast
import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest
from armcal.errors import ConfigError, ProblemError

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
        """The file, parsed again and its names compared.

        Raises:
            ConfigError: no measurement gives positions or poses of the tip, or several do and none is named.
            ProblemError: it does not read back.
        """
        s = self._settings
        own = {name: str(i.settings.get("type")) for name, i in request.instruments.items()}
        usable = {name: _CHANNELS[kind] for name, kind in own.items() if kind in _CHANNELS}
        name = s.measurement or (next(iter(usable)) if len(usable) == 1 else "")
        if name not in usable:
            listed = ", ".join(f"{name} ({kind})" for name, kind in own.items()) or "none"
            text = f"found the measurements {listed}, expected {s.measurement or 'one'} "
            hint = f"Give --option measurement=NAME: {', '.join(usable)}." if usable else "A node feeds tip positions."
            raise ConfigError(f"{text}of type tip_position or tip_pose.", hint=hint)
        is_pose = usable[name]
        constants = {
            "ARM": request.name,
            "CALIBRATION": request.digest,
            "JOINTS": list(request.arm.commanded),
            "SLIDING": [joint for joint, kind in request.arm.commanded.items() if kind == "length"],
            "MEASUREMENT": name,
            "IS_POSE": is_pose,
        }
        kind = "PoseStamped" if is_pose else "PointStamped"
        words = {f"={key}": str(value) if value is is_pose else json.dumps(value) for key, value in constants.items()}
        words |= {
            "=SERVE_SOCKET": json.dumps(s.serve_socket),
            "ARM": _comment(request.name),
            "EXPERIMENT": _comment(request.origin.experiment),
            "MEASURED": kind,
            "IMPORTED": kind if is_pose else f"{kind}, PoseStamped",
            "=FOLDER": json.dumps(s.folder),
            "FOLDER": _comment(s.folder),
            "SERVE_SOCKET": _comment(s.serve_socket),
        }
        text = _TEMPLATE.read_text(encoding="utf-8")
        for word, content in words.items():
            text = text.replace(f"@{word}@", content)
        assigned = (node for node in ast.parse(text).body if isinstance(node, ast.Assign))
        read = {ast.unparse(node.targets[0]): node.value for node in assigned}
        if any(ast.literal_eval(read[constant]) != value for constant, value in constants.items()):
            raise ProblemError("the names do not read back as they were written.", hint="Rename the joints.")
        remarks = (f"run armcal recalibrate with --from socket --out {s.folder} beside it",)
        return Exported(text.encode(), 0, remarks=remarks)


def _comment(text: str) -> str:
    return "".join(c if c.isprintable() and c not in '"\\' else " " for c in text)[:80]
