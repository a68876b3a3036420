"""A recalibration as it stood at its beginning, from what its journal says of its writer."""

from __future__ import annotations

import hashlib
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml
from armcal.calibration.calibration import Calibration
from armcal.errors import DataError, InputError, Location
from armcal.plugins import PluginRegistry

from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings, load_settings

JOURNAL = "journal"


def journal_folder(path: Path) -> Path:
    """The journal in the folder of a recalibration, or the journal itself.

    Raises:
        InputError: there is no such folder.
    """
    if not path.is_dir():
        hint = "Give the folder of a recalibration, or the journal in it."
        raise InputError("there is no such folder.", where=Location(str(path)), hint=hint)
    return path / JOURNAL if (path / JOURNAL).is_dir() else path


def kept_calibration(header: Mapping[str, Any], folder: Path, registry: PluginRegistry) -> Calibration:
    """The calibration that the recalibration began from.

    Raises:
        DataError: the journal does not keep it, or not as it was.
        ConfigError, PluginError: it is none that this version reads.
    """
    text = header.get("text")
    if not isinstance(text, str):
        hint = "It was written by an earlier version of armcal: replay it with that one."
        raise DataError("the journal does not hold its calibration.", where=Location(str(folder)), hint=hint)
    if hashlib.sha256(text.encode()).hexdigest() != header.get("calibration"):
        hint = "Nothing can be replayed from it: take another copy of the journal."
        raise DataError("the calibration in the journal is not whole.", where=Location(str(folder)), hint=hint)
    with tempfile.TemporaryDirectory(prefix="armcal-") as held:
        path = Path(held) / "calibration.yaml"
        path.write_bytes(text.encode())
        return Calibration.load(path, registry)


def kept_settings(header: Mapping[str, Any], overrides: Sequence[str] = ()) -> RecalibrateSettings:
    """The settings that the recalibration ran with, changed by overrides (``a.b=value``).

    Raises:
        ConfigError: this version does not know one, or an override is refused.
    """
    with tempfile.TemporaryDirectory(prefix="armcal-") as held:
        path = Path(held) / "journal.yaml"
        path.write_text(yaml.safe_dump(dict(header.get("settings") or {})), encoding="utf-8")
        return load_settings(path, overrides)


def begun(calibration: Calibration, settings: RecalibrateSettings, registry: PluginRegistry) -> Recalibrator:
    """A session at its beginning.

    Raises:
        ConfigError, PluginError: see ``Recalibrator.begin``.
    """
    return Recalibrator.begin(calibration, settings, registry)
