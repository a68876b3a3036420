"""Taking a calibration on purpose that was edited by hand, or that is to be used with other physics."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import CalibrationFile, read_record
from armcal.calibration.physics import predict
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError, Location, NotConvergedError
from armcal.plugins import PluginRegistry


@dataclass(frozen=True)
class Accepted:
    """A calibration as it is accepted.

    Attributes:
        calibration: with a note of its acceptance and predictions at its check poses as they are now.
        was_edited: its content is not what armcal wrote.
        was_needed: false for one that is as armcal wrote it, with the same versions.
        moved_m: how far tools at its check poses are from where they were predicted (m); None if it keeps none.
    """

    calibration: Calibration
    was_edited: bool
    was_needed: bool
    moved_m: float | None


def accept(path: Path, day: str, registry: PluginRegistry) -> Accepted:
    """Check a calibration again in all but its hash, as of a day.

    Raises:
        ConfigError: it is no calibration, its parts do not fit one another, or a value is outside of its interval.
        PluginError: it needs a plugin that is not there.
    """
    source, is_whole = read_record(path, changed=True)
    loaded, where = Calibration.built(source, path, registry), Location(str(path))
    _check_values(loaded.record, source)
    how = "made with other versions" if is_whole else "edited by hand"
    noted = replace(loaded, record=loaded.record.model_copy(update={"accepted": f"{how} and accepted on {day}"}))
    try:
        moved, kept = None, loaded.record.checks
        if kept is not None:
            tools = predict(loaded.system, loaded.parameters, kept.commands)[1]
            before = np.array([kept.tools[arm] for arm in loaded.system.arms]).reshape(*tools.shape[:2], 3, 4)
            moved = float(np.linalg.norm(tools[:, :, :3, 3] - before[..., 3], axis=-1).max())
        remade = noted.checked(kept.commands if kept else None, registry)
    except (NotConvergedError, ArithmeticError, LookupError, TypeError, ValueError) as fault:
        text = f"the arm cannot be predicted with it ({type(fault).__name__}: {fault})."
        raise ConfigError(text, where=where, hint="Undo the last edits, or run the calibration again.") from fault
    same = remade.record.model_copy(update={"accepted": loaded.record.accepted}) == loaded.record
    return Accepted(remade, not is_whole, not (is_whole and same), moved)


def _check_values(record: CalibrationFile, source: ConfigSource) -> None:
    """Each value lies in its interval, and a fixed one is its nominal value.

    Raises:
        ConfigError: one does not.
    """
    for index, entry in enumerate(record.parameters):
        where = source.where(("parameters", index, "value"))
        low, high = (-np.inf if entry.lower is None else entry.lower, np.inf if entry.upper is None else entry.upper)
        if entry.free and not low <= entry.value <= high:
            raise ConfigError(
                f"{entry.name} is {entry.value:g} {entry.unit}, expected {low:g} to {high:g}, its own lower and upper.",
                where=where,
                hint="Correct the value, or widen the interval if you know better.",
            )
        if not entry.free and entry.value != entry.nominal:
            raise ConfigError(
                f"{entry.name} is fixed at {entry.nominal:g} {entry.unit}, and its value is {entry.value:g}.",
                where=where,
                hint="Write the same number for nominal and value.",
            )
