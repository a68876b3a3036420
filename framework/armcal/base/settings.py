"""The base class of checked settings: strict types, and a unit for every physical quantity."""

import difflib
import re
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, is_dataclass, replace
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Annotated, Any, Literal, Self, TypeAlias, get_args, get_origin

from pydantic import BaseModel, BeforeValidator, ConfigDict, GetCoreSchemaHandler, ValidationInfo, model_validator
from pydantic_core import core_schema

from armcal.base.config_text import plain, resolve_path
from armcal.base.units import DIMENSIONLESS, display_unit, from_unit, parse_quantity, si_unit, split_suffix, units_of
from armcal.errors import ConfigError

_STARTS_A_NUMBER = re.compile(r"\s*[+-]?\.?[0-9]")


@dataclass(frozen=True)
class Fault:
    """Stands where a refused value was, so that pydantic reports it at its own field."""

    message: str


@dataclass(frozen=True)
class UnitOf:
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
Compliance: TypeAlias = Annotated[float, UnitOf("compliance")]
Force: TypeAlias = Annotated[float, UnitOf("force")]
Torque: TypeAlias = Annotated[float, UnitOf("torque")]
Temperature: TypeAlias = Annotated[float, UnitOf("temperature")]

_Three: TypeAlias = tuple[float, float, float]
Length3: TypeAlias = Annotated[_Three, UnitOf("length")]
Angle3: TypeAlias = Annotated[_Three, UnitOf("angle")]
Acceleration3: TypeAlias = Annotated[_Three, UnitOf("acceleration")]
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
    dimension: str | None = None  # of the quantity it holds; None: not a quantity
    takes_text: bool = False  # ordinary text is a value too (``Angle | Literal["off"]``)
    maps: bool = False  # the quantity may stand inside a mapping by name (``dict[str, Length]``)


def kind_of(annotations: Iterable[Any]) -> Kind:
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
        if kind.takes_text and not _STARTS_A_NUMBER.match(value):
            return value
        try:
            return parse_quantity(value, kind.dimension or "")
        except ValueError as fault:
            message = str(fault).removesuffix(".")
            return Fault(f"{message}; or give the unit in the key, {accepted(name, kind.dimension or '')}.")
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        return value
    try:
        return from_unit(value, unit)
    except OverflowError:
        return Fault("found a number that is too large, expected a finite one: correct it.")


_SI = "armcal_si"


def _as_config(value: Any) -> Any:
    if isinstance(value, Settings):
        return value.to_config()
    if isinstance(value, BaseModel):
        return value.model_dump(mode="json")
    if is_dataclass(value) and not isinstance(value, type):
        return _as_config(asdict(value))
    if isinstance(value, Mapping):
        return {_as_config(key): _as_config(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple, set, frozenset)):
        entries = sorted(value) if isinstance(value, (set, frozenset)) else value
        return [_as_config(entry) for entry in entries]
    if isinstance(value, Enum):
        return _as_config(value.value)
    return str(value) if isinstance(value, (str, Path)) else value


def _make_scalars_strict(schema: Any) -> None:
    """Set ``strict`` on every scalar, passing over what is not schema."""
    if isinstance(schema, (list, tuple)):
        for part in schema:
            _make_scalars_strict(part)
    elif isinstance(schema, dict):
        if schema.get("type") in ("float", "int", "bool", "str"):
            schema.setdefault("strict", True)
        for key, part in schema.items():
            if key in ("fields", "choices") and isinstance(part, dict):  # keyed by the user's names
                _make_scalars_strict(list(part.values()))
            elif key not in ("default", "metadata", "serialization", "expected", "config", "cls", "ref"):
                _make_scalars_strict(part)


class Settings(BaseModel):
    """Checked, frozen settings.

    Unknown keys, text for numbers, booleans for numbers, and values that are not finite are refused. A field
    of type `Length`, `Angle`, `Mass` and so on is a quantity: it holds SI, and outside it is written with its
    unit, either in the key (``d_mm: 46.9``) or in the value (``d: 46.9 mm``, which wins over the key's).
    """

    model_config = ConfigDict(
        frozen=True,
        extra="forbid",
        allow_inf_nan=False,
        validate_default=True,
        protected_namespaces=(),
    )

    @classmethod
    def si(cls, **values: Any) -> Self:
        """Build from numbers in SI units under bare names, nested mappings included.

        Raises:
            pydantic.ValidationError: a value is refused.
        """
        return cls.model_validate(values, context={_SI: True})

    @classmethod
    def quantities(cls) -> dict[str, str]:
        """The dimension of each field that is a physical quantity, by field name."""
        kinds = ((name, kind.dimension) for name, kind in cls._kinds().items())
        return {name: dimension for name, dimension in kinds if dimension is not None}

    @classmethod
    def keys(cls) -> tuple[str, ...]:
        """The keys of these settings as a config writes them, quantities in a customary unit (``d_mm``)."""
        quantities = cls.quantities()
        return tuple(spelt(name, quantities[name]) if name in quantities else name for name in cls.model_fields)

    def to_config(self) -> dict[str, Any]:
        """The settings as a config: SI units in the keys; validating it gives equal settings, bit for bit."""
        kinds = type(self)._kinds()
        config: dict[str, Any] = {}
        for name in type(self).model_fields:
            value = _as_config(getattr(self, name))
            dimension = kinds[name].dimension
            if dimension is not None and has_number(value, kinds[name]):
                config[f"{name}_{si_unit(dimension).name}"] = value
            else:
                config[name] = value
        return config

    @classmethod
    @cache
    def _kinds(cls) -> Mapping[str, Kind]:
        """What each field takes; worked out once a class, as settings are read and written often."""
        return {name: kind_of((info.annotation, *info.metadata)) for name, info in cls.model_fields.items()}

    @classmethod
    def __get_pydantic_core_schema__(cls, source: Any, handler: GetCoreSchemaHandler) -> core_schema.CoreSchema:
        """Strict scalars, while lists still make tuples and texts still make paths and enumerations."""
        schema = handler(source)
        _make_scalars_strict(schema)
        return schema

    @model_validator(mode="before")
    @classmethod
    def _read_units(cls, data: Any, info: ValidationInfo) -> Any:
        if not isinstance(data, Mapping):
            return data
        is_si = bool(info.context) and isinstance(info.context, dict) and bool(info.context.get(_SI))
        kinds = cls._kinds()
        result: dict[Any, Any] = {}
        written: dict[str, str] = {}
        for key, value in data.items():
            name, read = cls._read_entry(key, value, kinds, is_si)
            if name in written:
                read = Fault(f"found both {written[name]} and {key}, expected one of them: remove the other.")
            written[name] = key
            result[name] = read
        for name, kind in kinds.items():
            if kind.dimension is not None and name not in result and cls.model_fields[name].is_required():
                mend = example(name, kind.dimension)
                result[name] = Fault(f"found nothing, expected {kind.dimension}: write {mend}.")
        return result

    @classmethod
    def _read_entry(cls, key: Any, value: Any, kinds: Mapping[str, Kind], is_si: bool) -> tuple[Any, Any]:
        if key in kinds:
            kind = kinds[key]
            return key, value if kind.dimension is None else read_bare(key, value, kind, is_si)
        split = split_suffix(key) if isinstance(key, str) else None
        if split is not None and split[0] in kinds:
            name, unit = split
            kind = kinds[name]
            if kind.dimension == unit.dimension:
                return name, convert(name, value, kind, unit.name)
            if kind.dimension is not None:
                mend = accepted(name, kind.dimension)
                return name, Fault(f"found {key} ({unit.dimension}), expected {kind.dimension}: write {mend}.")
        return key, Fault(cls._unknown(key)) if cls.model_config.get("extra") == "forbid" else value

    @classmethod
    def _unknown(cls, key: Any) -> str:
        spellings: dict[str, str] = {name: name for name in cls.model_fields}
        for name, dimension in cls.quantities().items():
            spellings[name] = spelt(name, dimension)
            spellings.update({f"{name}_{u.name}": f"{name}_{u.name}" for u in units_of(dimension)})
        near = difflib.get_close_matches(str(key), spellings, n=1)
        if near:
            return f"found the unknown key {str(key)!r}: did you mean {spellings[near[0]]}?"
        return f"found the unknown key {str(key)!r}, expected one of {', '.join(cls.keys()) or 'no keys'}."
