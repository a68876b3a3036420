"""Physical quantities in settings: field types that hold SI, and reading what a config writes."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Literal, TypeAlias, get_args, get_origin

from pydantic import BeforeValidator, GetCoreSchemaHandler
from pydantic_core import core_schema

from armcal.base.config_text import plain, resolve_path
from armcal.base.units import DIMENSIONLESS, display_unit, from_unit, parse_quantity, si_unit, units_of
from armcal.errors import ConfigError

_STARTS_A_NUMBER = re.compile(r"\s*[+-]?\.?[0-9]")


@dataclass(frozen=True)
class Fault:
    """Stands where a refused value was, so that pydantic reports it at its own field."""

    message: str


@dataclass(frozen=True)
class UnitOf:
    """Marks a float, or a container of floats, as a physical quantity held in SI units."""

    dimension: str

    def __post_init__(self) -> None:
        if self.dimension == DIMENSIONLESS:
            raise ValueError("a dimensionless field has no unit to declare: annotate it as a plain float.")
        units_of(self.dimension)

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        return core_schema.no_info_before_validator_function(_raise_fault, handler(source))


def _raise_fault(value: Any) -> Any:
    if isinstance(value, Fault):
        raise ValueError(value.message)
    return value


Length: TypeAlias = Annotated[float, UnitOf("length")]
Angle: TypeAlias = Annotated[float, UnitOf("angle")]
Mass: TypeAlias = Annotated[float, UnitOf("mass")]
Duration: TypeAlias = Annotated[float, UnitOf("time")]
Acceleration: TypeAlias = Annotated[float, UnitOf("acceleration")]
Compliance: TypeAlias = Annotated[float, UnitOf("compliance")]
Force: TypeAlias = Annotated[float, UnitOf("force")]
Torque: TypeAlias = Annotated[float, UnitOf("torque")]
Temperature: TypeAlias = Annotated[float, UnitOf("temperature")]

_Three: TypeAlias = tuple[float, float, float]
Length3: TypeAlias = Annotated[_Three, UnitOf("length")]
Angle3: TypeAlias = Annotated[_Three, UnitOf("angle")]
Acceleration3: TypeAlias = Annotated[_Three, UnitOf("acceleration")]
Compliance3: TypeAlias = Annotated[_Three, UnitOf("compliance")]
Force3: TypeAlias = Annotated[_Three, UnitOf("force")]
Torque3: TypeAlias = Annotated[_Three, UnitOf("torque")]


def _resolve(value: Any) -> Any:
    if isinstance(value, str):
        try:
            return resolve_path(value)
        except ConfigError as fault:  # pydantic places it; it would not catch an error of ours
            raise ValueError(f"{fault.message} {fault.hint}") from fault
    return value.absolute() if isinstance(value, Path) else value


InputPath: TypeAlias = Annotated[Path, BeforeValidator(_resolve)]
"""A file to read: text is resolved against the config it was written in, and stays below the run's root."""


@dataclass(frozen=True)
class Kind:
    """What a field takes.

    Attributes:
        dimension: of the quantity it holds; None: not a quantity.
        takes_text: ordinary text is a value too (``Angle | Literal["off"]``).
        maps: the quantity may stand inside a mapping by name (``dict[str, Length]``).
    """

    dimension: str | None = None
    takes_text: bool = False
    maps: bool = False


def kind_of(annotations: Iterable[Any]) -> Kind:
    """What a field with these annotations and metadata takes, through unions and containers."""
    kind = Kind()
    for part in annotations:
        origin = get_origin(part)
        if isinstance(part, UnitOf):
            kind = replace(kind, dimension=part.dimension)
        elif part is str or (isinstance(part, type) and issubclass(part, Enum)):
            kind = replace(kind, takes_text=True)
        elif origin is Literal:
            has_word = any(isinstance(word, str) for word in get_args(part))
            kind = replace(kind, takes_text=kind.takes_text or has_word)
        elif origin is not None:
            is_map = isinstance(origin, type) and issubclass(origin, Mapping)
            inner = kind_of(get_args(part)[1:] if is_map else get_args(part))  # a map's keys are names
            kind = Kind(
                kind.dimension or inner.dimension,
                kind.takes_text or inner.takes_text,
                kind.maps or inner.maps or (is_map and inner.dimension is not None),
            )
    return kind


def spelt(name: str, dimension: str) -> str:
    return f"{name}_{display_unit(dimension).name}"


def accepted(name: str, dimension: str) -> str:
    return " or ".join(f"{name}_{u.name}" for u in units_of(dimension))


def example(name: str, dimension: str, value: Any = "...") -> str:
    by_key = f"{spelt(name, dimension)}: {value}"
    if isinstance(value, (list, dict)):
        return by_key
    return f"{by_key} or {name}: {value} {display_unit(dimension).name}"


def has_number(value: Any, kind: Kind) -> bool:
    if isinstance(value, (list, tuple)):
        return any(has_number(entry, kind) for entry in value)
    if isinstance(value, Mapping):
        return kind.maps and any(has_number(entry, kind) for entry in value.values())
    return isinstance(value, (int, float)) and not isinstance(value, bool)


def read_bare(name: str, value: Any, kind: Kind, is_si: bool) -> Any:
    """A quantity under its bare name: its texts carry their units; numbers only where SI is agreed."""
    dimension = kind.dimension or ""
    if is_si and hasattr(value, "tolist"):
        value = value.tolist()  # arrays are welcome from Python
    if not is_si and has_number(value, kind):
        number = plain(value)
        return Fault(f"found {number} with its unit missing: write {example(name, dimension, number)}.")
    return convert(name, value, kind, si_unit(dimension).name)


def convert(name: str, value: Any, kind: Kind, unit: str) -> Any:
    """A quantity in SI, through lists and mappings; what is neither number nor text is left for pydantic."""
    if isinstance(value, (list, tuple)):
        return [convert(name, entry, kind, unit) for entry in value]
    if isinstance(value, Mapping) and kind.maps:
        return {key: convert(name, entry, kind, unit) for key, entry in value.items()}
    if isinstance(value, str):
        return _read_text(name, value, kind)
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    try:
        return from_unit(value, unit)
    except OverflowError:
        return Fault("found a number that is too large, expected a finite one: correct it.")


def _read_text(name: str, text: str, kind: Kind) -> Any:
    dimension = kind.dimension or ""
    if kind.takes_text and not _STARTS_A_NUMBER.match(text):
        return text
    try:
        return parse_quantity(text, dimension)
    except ValueError as fault:
        message = str(fault).removesuffix(".")
        return Fault(f"{message}; or give the unit in the key, {accepted(name, dimension)}.")
