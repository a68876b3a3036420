"""Numbers of a servo file changed in its text, so that its comments and its layout stay."""

from collections.abc import Iterator

import yaml
from armcal.base.units import split_suffix
from armcal.config.servo_file import BoardSettings, ServoFile, ServoSettings, board_fields, servo_fields

Edit = tuple[int, int, str]
"""The characters from here to there become this."""


def edited_text(text: str, before: ServoFile, after: ServoFile) -> str | None:
    """A servo file's text with the numbers of ``after`` in place of those of ``before``.

    None where it has no such place: a part stands in another file that this one extends, or is written by an alias (an
    anchor's text would change all that refer to it).
    """
    try:
        if any(isinstance(token, yaml.AliasToken | yaml.AnchorToken) for token in yaml.scan(text)):
            return None
        root = yaml.compose(text, Loader=yaml.SafeLoader)
        edits = [*_of_parts(root, "boards", before, after), *_of_parts(root, "servos", before, after)]
    except (yaml.YAMLError, LookupError):
        return None
    for start, end, new in sorted(edits, reverse=True):
        text = text[:start] + new + text[end:]
    return text


def _of_parts(root: yaml.Node | None, section: str, before: ServoFile, after: ServoFile) -> Iterator[Edit]:
    parts = _value(root, section)
    for name, part in getattr(after, section).items():
        if part != getattr(before, section)[name]:
            yield from _of_part(_value(parts, name), getattr(before, section)[name], part)


def _of_part(
    node: yaml.Node, before: BoardSettings | ServoSettings, after: BoardSettings | ServoSettings
) -> Iterator[Edit]:
    """Every field that changed: its value anew, or key and value where the unit changes or it was not there."""
    was, now = _fields(before), _fields(after)
    for field, (key, text) in now.items():
        if was.get(field) == (key, text):
            continue
        try:
            name, value = _entry(node, field)
        except LookupError:
            end, indent = _end(node.value[-1][1]), " " * node.value[0][0].start_mark.column
            yield end, end, f", {key}: {text}" if _is_flow(node) else f"\n{indent}{key}: {text}"
            continue
        yield name.start_mark.index, _end(value), f"{key}: {text}"


def _fields(part: BoardSettings | ServoSettings) -> dict[str, tuple[str, str]]:
    """Key and text by the field's name without its unit."""
    pairs = board_fields(part) if isinstance(part, BoardSettings) else servo_fields(part)
    return {_bare(key): (key, text) for key, text in pairs}


def _bare(key: str) -> str:
    split = split_suffix(key)
    return key if split is None else split[0]


def _entry(node: yaml.Node | None, field: str) -> tuple[yaml.Node, yaml.Node]:
    pairs = node.value if isinstance(node, yaml.MappingNode) else []
    matches = [(pair[0], pair[1]) for pair in pairs if field in (pair[0].value, _bare(str(pair[0].value)))]
    if not matches:
        raise LookupError(field)
    return matches[0]


def _value(node: yaml.Node | None, field: str) -> yaml.Node:
    return _entry(node, field)[1]


def _end(node: yaml.Node) -> int:
    if not isinstance(node, yaml.CollectionNode) or _is_flow(node) or not node.value:
        return int(node.end_mark.index)
    last = node.value[-1]
    return _end(last[1] if isinstance(last, tuple) else last)


def _is_flow(node: yaml.Node) -> bool:
    return isinstance(node, yaml.CollectionNode) and bool(node.flow_style)
