"""The units of parameters, read from a calibration without building its arm."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from armcal.online.watch.lenient import text

_LARGEST = 1 << 23


def units_of(path: Path) -> dict[str, str]:
    """By name; empty where the file cannot be read or is no calibration."""
    import yaml  # late: needed only where events of the start are gone

    loader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
    try:
        with path.open("rb") as file:
            content = yaml.load(file.read(_LARGEST), Loader=loader)
    except (OSError, ValueError, RecursionError, yaml.YAMLError):
        return {}
    listed = content.get("parameters") if isinstance(content, Mapping) else None
    entries = [each for each in listed if isinstance(each, Mapping)] if isinstance(listed, list) else []
    known = [(text(entry.get("name")), text(entry.get("unit"))) for entry in entries]
    return {name: unit for name, unit in known if name and unit}
