"""What a survey comes to: a few numbers of the map and of each area, for tables and other programs."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from armcal.base.arrays import Array, Mask

from armcal_capability.cells import AreaMap
from armcal_capability.quantities import BY_NAME, CATALOGUE
from armcal_capability.settings import CapabilitySettings
from armcal_capability.survey import Survey

_MM = 1000.0
_LITRE = 1000.0


def summary_of(survey: Survey, settings: CapabilitySettings) -> dict[str, Any]:
    """Of one arm."""
    expression, corner = survey.subject.expression, survey.postures.positions
    return {
        "arm": survey.subject.arm.name,
        "postures": {
            "drawn": survey.drawn,
            "too_little_clearance": survey.drawn - survey.clear,
            "no_equilibrium": survey.unsettled,
            "mapped": len(survey.postures),
        },
        "reach": {
            "cells": len(survey.voxels.counts),
            "cell_mm": survey.voxels.size * _MM,
            "volume_litres": len(survey.voxels.counts) * survey.voxels.size**3 * _LITRE,
            "low_mm": (corner.min(axis=0) * _MM).tolist(),
            "high_mm": (corner.max(axis=0) * _MM).tolist(),
        },
        "length_mm": settings.length * _MM,
        "loads": settings.loads.to_config(),
        "holding_Nm": dict(settings.holding),
        "servos": sorted(expression.servos),
        "unexplained_mm": None
        if survey.unexplained is None
        else {"left": survey.unexplained.left * _MM, "instrument": survey.unexplained.instrument * _MM},
        "cells": statistics_of(survey.voxels.values),
        # the torque (N m; N on sliding joints) that each joint carries over all postures
        "joints_Nm": {
            name: {"median": float(np.median(row)), "p95": float(np.percentile(row, 95)), "most": float(row.max())}
            for name, row in zip(survey.subject.arm.joint_names, np.abs(survey.postures.efforts), strict=True)
        },
        "areas": {name: area_summary(area) for name, area in survey.areas.items()},
    }


def statistics_of(values: Mapping[str, Array]) -> dict[str, dict[str, float | None]]:
    """Over cells: mean and 95 % of the cells' means over postures, the same of their best postures, and the worst.

    95 % is what all but a twentieth of the cells are better than.
    """
    statistics: dict[str, dict[str, float | None]] = {}
    for quantity in CATALOGUE:
        if quantity.name not in values:
            continue
        best, mean, worst = (row[np.isfinite(row)] for row in values[quantity.name])
        statistics[quantity.name] = {
            "mean": _number(np.mean, mean),
            "p95": _bad_end(quantity.name, mean),
            "best_posture_mean": _number(np.mean, best),
            "best_posture_p95": _bad_end(quantity.name, best),
            "worst": _number(np.max if quantity.good == "low" else np.min, worst),
        }
    return statistics


def design_summaries(designs: Mapping[str, Survey]) -> dict[str, dict[str, Any]]:
    """Areas by design; quantities over the cells that all designs reach, so that none is blamed for reaching more."""
    names = next((list(design.areas) for design in designs.values()), [])
    shared = {name: np.all([design.areas[name].reached for design in designs.values()], axis=0) for name in names}
    return {
        design: {name: area_summary(survey.areas[name], shared[name]) for name in names}
        for design, survey in designs.items()
    }


def area_summary(area: AreaMap, among: Mask | None = None) -> dict[str, Any]:
    """How much of it is reached and held, and the quantities there, or ``among`` some cells."""
    chosen = area.reached if among is None else among
    return {
        "cells_compared": int(np.sum(chosen)),
        "cells": len(area.counts),
        "reached": float(np.mean(area.reached)),
        "held": None if area.held is None else float(np.mean(area.held)),
        "postures_per_cell": float(np.mean(area.counts)),
        "quantities": statistics_of({name: rows[:, chosen] for name, rows in area.values.items()}),
    }


def _bad_end(name: str, cells: Array) -> float | None:
    level = 95 if BY_NAME[name].good == "low" else 5
    return float(np.percentile(cells, level)) if len(cells) else None


def _number(of: Any, cells: Array) -> float | None:
    return float(of(cells)) if len(cells) else None
