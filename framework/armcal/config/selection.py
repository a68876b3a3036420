"""Which parameters are free, between which bounds, under which priors."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.settings import Settings
from armcal.base.units import DIMENSIONLESS, UNITS, display_unit, parse_quantity, si_unit
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError

DIMENSION_OF_UNIT = {unit.name: unit.dimension for unit in UNITS.values() if unit == si_unit(unit.dimension)}
Path = tuple[str | int, ...]


class ParameterSettings(Settings):
    """What the fit may change.

    ``free`` and ``fixed`` are globs over parameter names (fixed wins); ``values`` replaces nominal values,
    ``priors`` gives standard deviations about them, both as text with a unit (``0.5 deg``). ``bounds: physical``
    keeps every compliance non-negative; ``none`` (or false) takes all bounds away.
    """

    free: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    bounds: Literal["physical", "none"] | bool = "physical"
    values: dict[str, str | float] = Field(default_factory=dict)
    priors: dict[str, str | float] = Field(default_factory=dict)


def select(parameters: Parameters, settings: ParameterSettings, source: ConfigSource) -> Parameters:
    """Parameters as a configuration wants them.

    Raises:
        ConfigError: a glob matches nothing, a unit is wrong, a prior is not positive, a value is out of bounds.
    """
    at: Path = ("parameters",)
    for key, glob in [*_indexed("free", settings.free), *_indexed("fixed", settings.fixed)]:
        _matching(parameters, glob, source, (*at, *key))
    parameters = with_values(parameters, settings.values, source, (*at, "values"))
    if settings.bounds in ("none", False):
        parameters = parameters.without_bounds()
    for glob, text in settings.priors.items():
        place = (*at, "priors", glob)
        for name in _matching(parameters, glob, source, place):
            deviation = quantity(parameters[name], text, source, place)
            if not deviation > 0 or not math.isfinite(deviation):
                raise ConfigError(
                    f"found a prior of {text}, expected a standard deviation above zero.",
                    where=source.where(place),
                    hint="Give how far from the nominal value the parameter may well be.",
                )
            parameters = parameters.replaced({name: replace(parameters[name], prior_sd=deviation)})
    free = set(parameters.select(settings.free)) - set(parameters.select(settings.fixed))
    return parameters.with_free(free)


def with_values(
    parameters: Parameters, values: Mapping[str, str | float], source: ConfigSource | None, at: Path
) -> Parameters:
    """Other nominal values by exact name, as text with a unit."""
    for name, text in values.items():
        place = (*at, name)
        if name not in parameters.names:
            _matching(parameters, name, source, place)
        block = parameters[name]
        value = quantity(block, text, source, place)
        if fault := block.domain.check(np.array([value])):
            raise ConfigError(f"{name}: {fault}.", where=source.where(place) if source else None)
        parameters = parameters.replaced({name: replace(block, nominal=(value,))})
    return parameters


def quantity(block: ParameterBlock, text: str | float, source: ConfigSource | None, at: Path) -> float:
    """A text with a unit as SI, for a scalar block."""
    where = source.where(at) if source else None
    if block.size != 1:
        raise ConfigError(f"{block.name} has {block.size} entries and cannot be set by one number.", where=where)
    dimension = DIMENSION_OF_UNIT.get(block.unit)
    if dimension in (None, DIMENSIONLESS):
        if isinstance(text, str):
            raise ConfigError(f"found {text!r}, expected a plain number for {block.name}.", where=where)
        return float(text)
    if not isinstance(text, str):
        raise ConfigError(
            f"found {text} without a unit for {block.name}.",
            where=where,
            hint=f"Write its unit as well, such as {text} {display_unit(dimension).name} or {text} {block.unit}.",
        )
    try:
        return parse_quantity(text, dimension)
    except ValueError as fault:
        raise ConfigError(f"{block.name}: {fault}", where=where) from fault


def _indexed(key: str, globs: tuple[str, ...]) -> list[tuple[Path, str]]:
    return [((key, index), glob) for index, glob in enumerate(globs)]


def _matching(parameters: Parameters, glob: str, source: ConfigSource | None, at: Path) -> tuple[str, ...]:
    try:
        return parameters.select([glob])
    except ConfigError as fault:
        where = source.where(at) if source else None
        raise ConfigError(fault.message, where=where, hint=fault.hint) from fault
