"""Settings checked against the configuration they came from: every fault at once, each at its own line."""

import difflib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, TypeVar

from pydantic import ValidationError

from armcal.base.settings import Fault, Settings
from armcal.config.yaml_source import ConfigSource, Step, dotted, find_key
from armcal.errors import ConfigError

S = TypeVar("S", bound=Settings)

_MOST_LISTED = 50
_LIST = ("a list", "write [a, b] or one '- ' line each")
_KEYS = ("keys and values", "write indented 'key: value' lines")
# What pydantic expected, and what to do, by its error type.
_EXPECTED: Mapping[str, tuple[str, str]] = {
    "float_type": ("a number", "write it without quotes, with a decimal point"),
    "int_type": ("a whole number", "write it without quotes and without a decimal point"),
    "bool_type": ("true or false", "write one of them without quotes"),
    "string_type": ("text", "put it in double quotes"),
    "none_required": ("nothing", "leave the key out"),
    "path_type": ("the path of a file", "write it as text"),
    **dict.fromkeys(("list_type", "tuple_type", "set_type"), _LIST),
    **dict.fromkeys(("dict_type", "mapping_type", "model_type", "model_attributes_type"), _KEYS),
}


@dataclass(frozen=True)
class _Finding:
    """One of pydantic's errors, placed in the config."""

    path: tuple[Step, ...]
    unions: tuple[tuple[Step, ...], ...]  # the paths of those that it is under
    value: str
    expected: str
    mend: str
    message: str  # in place of these three

    @property
    def text(self) -> str:
        end = "" if self.mend.endswith("?") else "."
        return self.message or f"found {self.value}, expected {self.expected}: {self.mend}{end}"


def validate(
    settings_class: type[S], source: ConfigSource, at: tuple[Step, ...] = (), beside: Collection[str] = ()
) -> S:
    """Check the part of a configuration below a path, but for keys ``beside`` that are another's.

    A ConfigError lists every fault with its file, line and field, what was found, what was expected and what to do.
    """
    raw: Any = source.data
    for step in at:
        if (key := find_key(raw, step)) is None:
            keys = ", ".join(settings_class.keys())
            hint = f"Write '{at[-1]}:' with some of {keys}."
            source.refuse(at, f"found no {dotted(at)!r}, expected keys and values.", hint)
        raw = raw[key]
    if beside and isinstance(raw, dict):
        raw = {key: value for key, value in raw.items() if key not in beside}
    try:
        return settings_class.model_validate(raw)
    except ValidationError as fault:
        findings = [_finding(error, raw) for error in fault.errors(include_url=False)]
        placed = [(source.where((*at, *finding.path)), finding.text) for finding in _settle(findings)]
        placed.sort(key=lambda place: (place[0].file or "", place[0].line or 0))
        first, others = placed[0], placed[1:]
        lines = [first[1], *(f"{where}: {text}" for where, text in others[: _MOST_LISTED - 1])]
        if len(placed) > _MOST_LISTED:
            lines.append(f"and {len(placed) - _MOST_LISTED} more.")
        if others:
            lines.append(f"Correct these {len(placed)} places.")
        raise ConfigError("\n".join(lines), where=first[0]) from fault


def _finding(error: Mapping[str, Any], raw: Any) -> _Finding:
    kind, refused = str(error["type"]), error["input"]
    path: list[Step] = []
    unions: list[tuple[Step, ...]] = []
    value, is_fault = raw, isinstance(refused, Fault)
    loc: Sequence[Step] = error["loc"]
    for index, step in enumerate(loc):
        key = find_key(value, step)
        if key is not None:
            value = value[key]
            path.append(key)
        elif (
            index == len(loc) - 1
            and (kind == "missing" or is_fault)
            and isinstance(value, dict if isinstance(step, str) else list)
        ):  # a key or an index of the value, not a union member
            path.append(step)
        else:
            unions.append(tuple(path))
    shown, expected, mend, message = _shown(value, refused), "", "", ""
    text, context = str(error["msg"]), error.get("ctx", {})
    if isinstance(refused, Fault):
        message = refused.message
    elif kind == "missing" and isinstance(loc[-1], int) and isinstance(value, list):
        path.pop()
        message = f"found a list of {len(value)} values, expected at least {loc[-1] + 1}: add the missing ones."
    elif kind in ("missing", "union_tag_not_found"):
        key = str(loc[-1] if kind == "missing" else context.get("discriminator")).strip("'")
        message = f"found nothing, expected the key {key!r}: write '{key}: ...'."
    elif kind in _EXPECTED:
        expected, mend = _EXPECTED[kind]
    elif kind in ("value_error", "assertion_error"):
        message = text.split(", ", 1)[1]
    elif kind in ("literal_error", "enum"):
        expected = str(context.get("expected"))
        mend = _nearest(refused, expected.replace(" or ", ", "))
    elif kind == "union_tag_invalid":
        tags, tag = str(context.get("expected_tags")), context.get("tag")
        shown, expected, mend = f"the {context.get('discriminator')} {tag!r}", f"one of {tags}", _nearest(tag, tags)
    elif kind in ("too_short", "too_long"):
        least = context.get("min_length")
        expected = f"at most {context.get('max_length')}" if least is None else f"at least {least}"
        mend = "remove the rest" if least is None else "add what is missing"
    else:
        expected = text.removeprefix("Input should be ")
        expected, mend = expected[:1].lower() + expected[1:], "correct it"
    return _Finding(tuple(path), tuple(unions), shown, expected, mend, message)


def _nearest(value: Any, choices: str) -> str:
    near = difflib.get_close_matches(str(value), [word.strip(" '") for word in choices.split(",")], n=1)
    return f"did you mean {near[0]}?" if near else "write one of these"


def _shown(value: Any, refused: Any) -> str:
    """A value as its writer knows it; with what it became, where a unit was converted."""
    if isinstance(value, str):
        text = str(value) if len(value) <= 60 else f"{value[:57]}..."
        shown = f"the text {text!r}"
    elif isinstance(value, bool):
        shown = str(value).lower()
    elif isinstance(value, (dict, list)):
        shown = f"a list of {len(value)} values" if isinstance(value, list) else "keys and values"
    else:
        shown = "nothing" if value is None else str(value)
    is_number = isinstance(refused, (int, float)) and not isinstance(refused, bool)
    return f"{shown} ({refused} in SI units)" if is_number and refused != value else shown


def _settle(findings: Sequence[_Finding]) -> list[_Finding]:
    """Of each union what is wrong within the value, if a member has its shape; then one finding for each place."""
    entered = {union for finding in findings for union in finding.unions if len(finding.path) > len(union)}
    places: dict[tuple[Step, ...], list[_Finding]] = {}
    for finding in findings:
        if not any(union == finding.path and union in entered for union in finding.unions):
            places.setdefault(finding.path, []).append(finding)
    return [merged for same in places.values() for merged in _merged(same)]


def _merged(same: Sequence[_Finding]) -> Iterable[_Finding]:
    findings = list({f.message: f for f in same if f.message}.values())
    if findings or len(same) == 1:
        return findings or same
    expected = " or ".join(dict.fromkeys(f.expected for f in same))
    mends = list(dict.fromkeys(f.mend for f in same))
    return [replace(same[0], expected=expected, mend=mends[0] if len(mends) == 1 else "write one of these")]
