"""A request's targets, shared out to compensators: one is told how warm the arm is, the other takes its reference."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Targets
from armcal.errors import DataError, Location

from armcal_serve.protocol import CompensateRequest
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm


@dataclass(frozen=True)
class Share:
    """Targets that one compensator answers.

    Attributes:
        compensator: of the arm.
        targets: with all that the compensator must be told.
        places: of these targets in the request.
    """

    compensator: Compensator
    targets: Targets
    places: Sequence[int]


def shares(arm: ServedArm, request: CompensateRequest, targets: Targets) -> list[Share]:
    """All targets to one compensator; to two where some targets tell the temperature and others do not.

    Raises:
        DataError: the arm does not change with the temperature; or some targets of a path tell it and others do not.
    """
    told = [request.temperature if target.temperature is None else target.temperature for target in request.targets]
    warm = [place for place, value in enumerate(told) if value is not None]
    if not warm:
        return [Share(arm.compensator, targets, range(len(told)))]
    field = TEMPERATURE_KEY if request.temperature is not None else f"targets.{warm[0]}.{TEMPERATURE_KEY}"
    heated = arm.at_temperature(field)
    rest = [place for place, value in enumerate(told) if value is None]
    if rest and request.path:
        raise DataError(
            "found targets of a path with a temperature and targets without, expected all of one kind.",
            where=Location(field=f"targets.{rest[0]}"),
            hint=f"Give {TEMPERATURE_KEY} for all of the request, or for each target.",
        )
    temperatures = np.array([told[place] for place in warm], dtype=float)
    known = replace(targets.subset(np.array(warm)), conditions={TEMPERATURE: temperatures})
    found = [Share(heated, known, warm)]
    return [*found, Share(arm.compensator, targets.subset(np.array(rest)), rest)] if rest else found
