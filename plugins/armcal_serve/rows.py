"""Commands as answers show them: a row a target, in the units that were asked for."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any

from armcal.base.domains import Array
from armcal.base.units import to_unit
from armcal.calibration.compensation.request import Commands

from armcal_serve.protocol import Command, Tool, Units
from armcal_serve.served_arm import ServedArm


def command_rows(arm: ServedArm, commands: Commands, units: Units, tool: Callable[[Array], Tool]) -> list[Command]:
    """One row a target; ``tool`` writes a pose."""
    return [
        {
            **_told(arm, commands, i, units),  # type: ignore[typeddict-item]
            "found": bool(commands.found[i]),
            "why_not": commands.reasons[i],
            "error_mm": float(commands.distances[i]) * 1000,
            "error_deg": math.degrees(float(commands.turns[i])),
            "nearest_mm": float(commands.bounds[i]) * 1000,
            "approach": [round(side) for side in commands.approach[i].tolist()],
            "tool": tool(commands.base_T_tool[i]),
        }
        for i in range(len(commands))
    ]


def _told(arm: ServedArm, commands: Commands, row: int, units: Units) -> dict[str, Any]:
    """What to command, in the units asked for."""
    if units == "rad" or units == "deg":
        values = commands.joint_angles[row]
        if not arm.turns_only:
            return {"joints": arm.written(values.tolist(), units)}
        return {f"joint_angles_{units}": to_unit(values, units).tolist()}
    servos = arm.compensator.expression.servos
    counts = [] if commands.counts is None else commands.counts[row].tolist()
    if units == "counts":
        shown = zip(arm.joints, counts, strict=True)
        return {"counts": [count if name in servos else None for name, count in shown]}
    ticks = [servos[name][1].tick if name in servos else None for name in arm.joints]
    return {"pulse_us": [None if tick is None else n * tick * 1e6 for tick, n in zip(ticks, counts, strict=True)]}
