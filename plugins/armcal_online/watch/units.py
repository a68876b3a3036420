"""The units of parameters, read from a calibration without building its arm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from armcal.errors import ArmcalError

from armcal_online.watch.lenient import text


def units_of(path: Path) -> dict[str, str]:
    """By name; empty where the file cannot be read or is no calibration."""
    from armcal.config.yaml_source import load_config  # late: needed only where events of the start are gone

    try:
        listed = load_config(path).data.get("parameters")
    except (ArmcalError, OSError):
        return {}
    entries = [content for content in listed if isinstance(content, Mapping)] if isinstance(listed, list) else []
    known = [(text(entry.get("name")), text(entry.get("unit"))) for entry in entries]
    return {name: unit for name, unit in known if name and unit}
