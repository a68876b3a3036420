"""Measurements that are wrong: how many, which, and by how much."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated

import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Length, Settings
from numpy.typing import NDArray
from pydantic import Field


class OutlierSettings(Settings):
    """Some measurements are wrong: how many, and by how much at least (in a random direction)."""

    fraction: Annotated[float, Field(ge=0, le=1)] = 0.0
    size: Length = 0.03


def with_outliers(
    measured: Mapping[str, Array], outliers: OutlierSettings, random: np.random.Generator
) -> tuple[dict[str, Array], NDArray[np.bool_]]:
    """Channels (N each, m) with some records pushed away by once to twice the size, and which those are (N)."""
    count = len(next(iter(measured.values())))
    wrong = random.random(count) < outliers.fraction
    push = random.normal(size=(len(measured), count))
    push *= outliers.size * (1 + random.random(count)) / np.linalg.norm(push, axis=0)
    pushed = {
        channel: values + np.where(wrong, push[row], 0.0) for row, (channel, values) in enumerate(measured.items())
    }
    return pushed, wrong
