"""Visits that cannot be of their pose: another unit, another pose's measurement, a jump of the instrument."""

import numpy as np
from armcal.base.arrays import Array
from armcal.errors import DataError, Location

from armcal_capability.acceptance.records import Group, Visits

_APART = 0.1
"""Of the typical distance of the positions that arms reach: no arm repeats as badly."""
_OUTLYING = 8.0
"""Times the typical distance from the middle of the pose."""
_FACTORS = {1000.0: "m", 10.0: "cm", 25.4: "inches", 0.001: "thousandths of the column's unit"}
_NEAR = 0.02
_COMMANDED = 0.3
"""Of the spread of the visits: what may be commanded apart before it is named."""
_MM = 1000.0


def refuse_strangers(visits: Visits, measured: Array, reach: float) -> tuple[str, ...]:
    """Refuse visits that are nowhere near the others of their pose; warn of those that lie out.

    Args:
        visits: to poses.
        measured: positions (N x 3; m, instrument's frame).
        reach: typical distance of the arm's tool from its base (m).

    Raises:
        DataError: with the row, and what it may be.
    """
    middles = {id(group): np.median(measured[group.members], axis=0) for group in visits.groups}
    warnings = []
    for group in visits.groups:
        middle = middles[id(group)]
        off = np.linalg.norm(measured[group.members] - middle, axis=1)
        worst = int(np.argmax(off))
        if off[worst] > _APART * reach:
            _refuse(visits, group, worst, off[worst], measured, {g.pose: middles[id(g)] for g in visits.groups})
        typical = float(np.median(off))
        outlying = np.flatnonzero(off > _OUTLYING * typical) if len(group) > 3 else np.zeros(0, dtype=int)
        if outlying.size:
            index = group.members[outlying[0]]
            warnings.append(
                f"{visits.dataset.source}: {outlying.size} of {len(group)} visits to {group.pose} lie out, the first "
                f"{off[outlying[0]] * _MM:.3g} mm from the middle (line {visits.dataset.rows[index]}), the others "
                f"typically {typical * _MM:.3g} mm. They count: find out why, or take them out."
            )
    return tuple(warnings)


def moved_commands(visits: Visits, commanded: Array, measured: Array) -> tuple[str, ...]:
    """Warn of a pose whose visits were commanded apart: RP takes that for the arm's.

    Args:
        visits: to poses.
        commanded: positions (N x 3; m).
        measured: positions (N x 3; m).
    """
    for group in visits.groups:
        apart, spread = (
            np.linalg.norm(places[group.members] - np.median(places[group.members], axis=0), axis=1)
            for places in (commanded, measured)
        )
        if apart.max() > _COMMANDED * spread.max():
            index = group.members[int(np.argmax(apart))]
            return (
                f"{visits.dataset.source}: visits to {group.pose} were commanded up to {apart.max() * _MM:.3g} mm "
                f"apart (line {visits.dataset.rows[index]}), and RP takes that for the arm's. Give each commanded "
                "pose its own name.",
            )
    return ()


def _refuse(visits: Visits, group: Group, worst: int, off: float, measured: Array, middles: dict[str, Array]) -> None:
    index, dataset = int(group.members[worst]), visits.dataset
    place, size = measured[index], float(np.linalg.norm(measured[index]))
    text = f"it is {off * _MM:.4g} mm from the other visits to {group.pose}"
    hint = "Measure it again, or take it out."
    for factor, unit in _FACTORS.items():
        if np.linalg.norm(factor * place - middles[group.pose]) < _NEAR * factor * size:
            text += f", and among them if its coordinates are in {unit}"
            hint = "Write all rows in the unit of the column names."
    nearest = min(middles, key=lambda pose: float(np.linalg.norm(place - middles[pose])))
    if nearest != group.pose and np.linalg.norm(place - middles[nearest]) < 0.1 * off:
        text += f", and {np.linalg.norm(place - middles[nearest]) * _MM:.3g} mm from those to {nearest}"
        hint = "If two rows were exchanged, put them right."
    field = "pose" if visits.labelled else None
    raise DataError(f"{text}.", where=Location(dataset.source, line=dataset.rows[index], field=field), hint=hint)
