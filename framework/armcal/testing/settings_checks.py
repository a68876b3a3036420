"""Checks on what every component has: checked settings, and an example of them."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, get_args

from pydantic import ValidationError

from armcal.base.settings import Settings
from armcal.base.units import split_suffix
from armcal.testing.results import ContractError, NotRun, Recorder, expect

MISSING_FILE = "/no/such/folder/measurements"
_UNKNOWN_KEY = "no_component_has_this_key"
_QUANTITIES: Mapping[str, str] = MappingProxyType(
    {
        **dict.fromkeys(("length", "distance", "height", "width", "depth", "radius", "diameter", "noise"), "length"),
        **dict.fromkeys(("angle", "angles", "rotation_vector"), "angle"),
        **dict.fromkeys(("mass", "payload"), "mass"),
        **{word: word for word in ("compliance", "force", "torque", "temperature", "acceleration")},
        **dict.fromkeys(("duration", "timeout"), "time"),
    }
)
"""Words in the names of settings that are quantities, and their dimension."""


@dataclass(frozen=True)
class Subject:
    """A component under check: its class, its example as a configuration would have it, and as settings."""

    made: Any
    example: Mapping[str, Any]
    settings: Settings

    def build(self, *arguments: Any) -> Any:
        return self.made(self.settings, *arguments)


def check_settings(record: Recorder, kind: str, made: Any) -> Subject:
    """The component with settings to build it from."""
    with record.needed("it has checked settings"):
        settings_class: Any = getattr(made, "Settings", None)
        expect(
            isinstance(settings_class, type) and issubclass(settings_class, Settings),
            f"found Settings = {settings_class!r}, expected a class attribute: "
            "a subclass of armcal.base.settings.Settings",
        )
    fields = settings_class.model_fields
    with record.check("every setting is typed or documented"):
        bare = [n for n, info in fields.items() if info.annotation in (None, Any, object) and not info.description]
        expect(not bare, f"found {', '.join(bare)} without a type, expected a type or Field(description=...)")
    with record.check("every quantity has its unit"):
        _expect_units(settings_class)
    with record.needed("its EXAMPLE is a mapping"):
        given = getattr(made, "EXAMPLE", {})
        type_name = type(given).__name__
        expect(isinstance(given, Mapping), f"found EXAMPLE of type {type_name}, expected a mapping of settings")
        example = dict(given)
        if kind == "reader" and "path" in fields and fields["path"].is_required():
            example.setdefault("path", MISSING_FILE)
    with record.check("an unknown key is refused"):
        try:
            settings_class.model_validate({**example, _UNKNOWN_KEY: 1})
        except ValidationError as fault:
            named = any(_UNKNOWN_KEY in map(str, error["loc"]) for error in fault.errors())
            expect(named, "found an unknown key refused without being named, expected its name in the error")
        else:
            raise ContractError("found an unknown key accepted, expected it refused: keep extra='forbid'")
    with record.needed("its example settings are accepted"):
        try:
            settings = settings_class.model_validate(example)
        except ValidationError as fault:
            if hasattr(made, "EXAMPLE"):
                raise
            reason = "it has no EXAMPLE and needs settings"
            if kind == "simulator":
                raise NotRun(reason) from fault
            add = "add the class attribute EXAMPLE, a mapping as a configuration would have it"
            raise ContractError(f"{reason}: {add}") from fault
    with record.check("its settings survive to_config()"):
        again = settings_class.model_validate(settings.to_config())
        expect(again == settings, f"found {again!r} after to_config(), expected {settings!r}")
    return Subject(made, example, settings)


def _expect_units(settings_class: type[Settings]) -> None:
    """No plain number has a quantity's name; one that is none says so in ``Field(description=...)``."""
    quantities = settings_class.quantities()
    for name, info in settings_class.model_fields.items():
        if name in quantities or info.description or not _holds_floats(info.annotation, info.metadata):
            continue
        suffix = split_suffix(name)
        word = next((word for word in name.split("_") if word in _QUANTITIES), None)
        dimension = suffix[1].dimension if suffix else _QUANTITIES[word] if word else ""
        expect(
            not dimension,
            f"found {name}, a number without a unit; expected a type with one ({dimension}), such as Length or Angle "
            "of armcal.base.settings, under a name without one, or Field(description=...) if it has none",
        )


def _holds_floats(*parts: Any) -> bool:
    inner = [part_type for part in parts for part_type in (part if isinstance(part, list) else (part,))]
    return any(
        part_type is float or (get_args(part_type) and _holds_floats(*get_args(part_type))) for part_type in inner
    )
