"""Which parameters are free, between which bounds, under which priors."""

import math
from collections.abc import Collection, Mapping
from dataclasses import replace
from typing import Literal

import numpy as np
from pydantic import Field

from armcal.base.parameters import Drift, ParameterBlock, Parameters
from armcal.base.settings import Settings
from armcal.base.units import DIMENSIONLESS, UNITS, display_unit, parse_quantity, si_unit
from armcal.config.yaml_source import ConfigSource
from armcal.errors import ConfigError

DIMENSION_OF_UNIT = {unit.name: unit.dimension for unit in UNITS.values() if unit == si_unit(unit.dimension)}
Path = tuple[str | int, ...]
_BY_NAME = ("values", "priors", "drift")


class DriftSettings(Settings):
    """How far a parameter drifts over a recording (standard deviation, with its unit), and how fast.

    ``over`` is the distance over which it forgets: records (``10``; a column ``sequence`` says their order) or time
    (``20 min``; a column ``time_s``).
    """

    sd: str | float
    over: str | float


class ParameterSettings(Settings):
    """What the fit may change.

    ``free`` and ``fixed`` are globs over parameter names (fixed wins); ``values`` replaces nominal values,
    ``priors`` gives standard deviations about them, both as text with a unit (``0.5 deg``). ``bounds: physical``
    keeps every compliance non-negative; ``none`` (or false) takes all bounds away. ``drift`` names free parameters
    that move slowly over the recording.
    """

    free: tuple[str, ...] = ()
    fixed: tuple[str, ...] = ()
    bounds: Literal["physical", "none"] | bool = "physical"
    values: dict[str, str | float] = Field(default_factory=dict)
    priors: dict[str, str | float] = Field(default_factory=dict)
    drift: dict[str, DriftSettings] = Field(default_factory=dict)


def select(parameters: Parameters, settings: ParameterSettings, source: ConfigSource) -> Parameters:
    at: Path = ("parameters",)
    for key, globs in (("free", settings.free), ("fixed", settings.fixed)):
        for index, glob in enumerate(globs):
            _matching(parameters, glob, source, (*at, key, index))
    parameters = with_values(parameters, settings.values, source, (*at, "values"))
    if settings.bounds in ("none", False):
        parameters = parameters.without_bounds()
    for glob, text in settings.priors.items():
        place = (*at, "priors", glob)
        for name in _matching(parameters, glob, source, place):
            deviation = _deviation(parameters[name], text, source, place)
            parameters = parameters.replaced({name: replace(parameters[name], prior_sd=deviation)})
    of_groups = {block.name for block in parameters.nuisances if block.free}
    free = (set(parameters.select(settings.free)) | of_groups) - set(parameters.select(settings.fixed))
    parameters = parameters.with_free(free)
    for glob, stated in settings.drift.items():
        place = (*at, "drift", glob)
        for name in _matching(parameters, glob, source, place):
            block = parameters[name]
            if not block.free or block.size != 1:
                why = f"{name} cannot drift: it is {'a matrix' if block.size != 1 else 'not free'}."
                hint = "Let free numbers drift: add it to parameters.free, under a prior if need be."
                source.refuse(place, why, hint)
            deviation = _deviation(block, stated.sd, source, (*place, "sd"))
            try:
                over = parse_quantity(stated.over, "time") if isinstance(stated.over, str) else float(stated.over)
            except ValueError as fault:
                where, hint = source.where((*place, "over")), "Write records (10) or a time (20 min)."
                raise ConfigError(f"{fault}", where=where, hint=hint) from fault
            if not over > 0 or not math.isfinite(over):
                source.refuse((*place, "over"), f"found {stated.over}, expected a distance above zero.")
            drift = Drift(deviation, over, "time" if isinstance(stated.over, str) else "sequence")
            parameters = parameters.replaced({name: replace(block, drift=drift)})
    return parameters


def without_groups(settings: ParameterSettings, instances: Collection[str]) -> ParameterSettings:
    """The settings less what they say of some instances, whose groups are not known before the records are."""

    def is_other(pattern: str) -> bool:
        return pattern.partition(".")[0] not in instances

    globs = {key: tuple(filter(is_other, getattr(settings, key))) for key in ("free", "fixed")}
    by_name = {key: {p: v for p, v in getattr(settings, key).items() if is_other(p)} for key in _BY_NAME}
    return settings.model_copy(update=globs | by_name)


def _deviation(block: ParameterBlock, text: str | float, source: ConfigSource, at: Path) -> float:
    deviation = quantity(block, text, source, at)
    if not deviation > 0 or not math.isfinite(deviation):
        hint = "Give how far from the nominal value the parameter may well be."
        source.refuse(at, f"found {text}, expected a standard deviation above zero.", hint)
    return deviation


def with_values(
    parameters: Parameters, values: Mapping[str, str | float], source: ConfigSource, at: Path
) -> Parameters:
    """Other nominal values by exact name, as text with a unit; a matrix by its entries (``arm.flex.C3[xx]``)."""
    changed: dict[str, Path] = {}
    for name, text in values.items():
        place = (*at, name)
        owner = name.partition("[")[0]
        if owner not in parameters.names:
            hint = f"Give each its own: {', '.join(_matching(parameters, name, source, place))}."
            source.refuse(place, f"{name} stands for several names: a value is of one parameter.", hint)
        block = parameters[owner]
        if name not in block.entry_names:
            hint = f"Give its entries, each on its own: {', '.join(block.entry_names)}."
            source.refuse(place, f"{name} is no single number.", hint)
        numbers = list(block.nominal)
        i = block.entry_names.index(name)
        is_plain = not isinstance(text, str) and DIMENSION_OF_UNIT.get(block.unit) in (None, DIMENSIONLESS)
        unit = block.unit if is_plain else block.entry_units[i]  # entries of an axis may be plain numbers, in SI
        numbers[i] = quantity(replace(block, unit=unit), text, source, place)
        parameters = parameters.replaced({owner: replace(block, nominal=tuple(numbers))})
        changed[owner] = place
    for owner, place in changed.items():
        if fault := parameters[owner].domain.check(np.array(parameters[owner].nominal)):
            source.refuse(place, f"{owner}: {fault}.")
    return parameters


def quantity(block: ParameterBlock, text: str | float, source: ConfigSource | None, at: Path) -> float:
    """A text with a unit as SI, in the unit of a block's entries."""
    where = source.where(at) if source else None
    dimension = DIMENSION_OF_UNIT.get(block.unit)
    if dimension in (None, DIMENSIONLESS):
        if isinstance(text, str):
            raise ConfigError(f"found {text!r}, expected a plain number for {block.name}.", where=where)
        return float(text)
    if not isinstance(text, str):
        hint = f"Write its unit as well, such as {text} {display_unit(dimension).name} or {text} {block.unit}."
        raise ConfigError(f"found {text} without a unit for {block.name}.", where=where, hint=hint)
    try:
        return parse_quantity(text, dimension)
    except ValueError as fault:
        raise ConfigError(f"{block.name}: {fault}", where=where) from fault


def _matching(parameters: Parameters, glob: str, source: ConfigSource, at: Path) -> tuple[str, ...]:
    try:
        return parameters.select([glob])
    except ConfigError as fault:
        raise ConfigError(fault.message, where=source.where(at), hint=fault.hint) from fault
