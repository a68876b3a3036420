"""ROS 2 parameter files: written and read as ``rcl_yaml_param_parser`` takes them. [ROS2]

Parameters are scalars, or lists whose entries are all of one type: bool, whole number, decimal number or text. Nothing
may be empty or null, and lists hold no lists.
"""

import math
import re
from collections.abc import Mapping
from typing import Any

import yaml

Value = bool | int | float | str | list[bool] | list[int] | list[float] | list[str]
_TRUE = {"y", "Y", "yes", "Yes", "YES", "true", "True", "TRUE", "on", "On", "ON"}
_FALSE = {"n", "N", "no", "No", "NO", "false", "False", "FALSE", "off", "Off", "OFF"}
_WHOLE = re.compile(r"[+-]?(0[xX][0-9a-fA-F]+|[0-9]+)")
_DECIMAL = re.compile(r"[+-]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][+-]?[0-9]+)?|[+-]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)")
_ESCAPES = {'"': '\\"', "\\": "\\\\", "\n": "\\n", "\t": "\\t", "\r": "\\r"}


def ros2_text(node: str, parameters: Mapping[str, Value], comment: str) -> str:
    tree: dict[str, Any] = {}
    for name, value in parameters.items():
        *above, last = name.split(".")
        place = tree
        for step in above:
            place = place.setdefault(step, {})
        place[last] = value
    lines = [f"# {line}" for line in comment.splitlines()]
    lines += [f"{_key(node)}:", "  ros__parameters:"]
    return "\n".join([*lines, *_lines(tree, 2)]) + "\n"


def read_ros2(text: str) -> dict[str, dict[str, Value]]:
    """The parameters of each node, by dotted name.

    Raises:
        ValueError: ROS 2 would not take it.
    """
    root = yaml.compose(text, Loader=yaml.SafeLoader)
    nodes: dict[str, dict[str, Value]] = {}
    for node, content in _entries(root, "the file"):
        held = dict(_entries(content, node))
        if list(held) != ["ros__parameters"]:
            raise ValueError(f"{node} holds {', '.join(held) or 'nothing'}, expected ros__parameters")
        nodes[node] = dict(_flat(held["ros__parameters"], ""))
    return nodes


def _lines(tree: Mapping[str, Any], depth: int) -> list[str]:
    texts = []
    for key, value in tree.items():
        start = "  " * depth + f"{_key(key)}:"
        if isinstance(value, dict):
            texts += [start, *_lines(value, depth + 1)]
        elif isinstance(value, list):
            texts.append(f"{start} [{', '.join(_scalar(item) for item in value)}]")
        else:
            texts.append(f"{start} {_scalar(value)}")
    return texts


def _key(name: str) -> str:
    return name if re.fullmatch(r"[A-Za-z_][A-Za-z0-9_-]*", name) and name not in _TRUE | _FALSE else _quoted(name)


def _scalar(value: bool | int | float | str) -> str:
    if isinstance(value, bool):
        return "true" if value else "false"
    if isinstance(value, str):
        return _quoted(value)
    if isinstance(value, int):
        return str(value)
    if not math.isfinite(value):
        return ".nan" if math.isnan(value) else (".inf" if value > 0 else "-.inf")
    text = repr(float(value))
    mantissa, e, exponent = text.partition("e")
    return f"{mantissa if '.' in mantissa else mantissa + '.0'}{e}{exponent}"


def _quoted(text: str) -> str:
    return '"' + "".join(_ESCAPES.get(c, c if c.isprintable() else f"\\U{ord(c):08x}") for c in text) + '"'


def _entries(node: Any, what: str) -> list[tuple[str, Any]]:
    if not isinstance(node, yaml.MappingNode) or not node.value:
        raise ValueError(f"{what} is no mapping, or an empty one")
    names = [key.value for key, _ in node.value]
    if len(set(names)) < len(names):
        raise ValueError(f"{what} has a key twice")
    return [(key.value, value) for key, value in node.value]


def _flat(node: Any, above: str) -> list[tuple[str, Value]]:
    entries: list[tuple[str, Value]] = []
    for key, value in _entries(node, above or "ros__parameters"):
        name = f"{above}.{key}" if above else key
        if isinstance(value, yaml.MappingNode):
            entries += _flat(value, name)
        elif isinstance(value, yaml.SequenceNode):
            if any(not isinstance(item, yaml.ScalarNode) for item in value.value):
                raise ValueError(f"{name} is a list of lists or of mappings")
            items: Any = [_typed(item, name) for item in value.value]
            if len({type(item) for item in items}) != 1:
                raise ValueError(f"{name} is an empty list, or one of several types")
            entries.append((name, items))
        else:
            entries.append((name, _typed(value, name)))
    return entries


def _typed(node: Any, name: str) -> bool | int | float | str:
    text = str(node.value)
    if node.style in ("'", '"', "|", ">"):
        return text
    if text in ("", "~", "null", "Null", "NULL"):
        raise ValueError(f"{name} is null")
    if text in _TRUE | _FALSE:
        return text in _TRUE
    if _WHOLE.fullmatch(text):
        return int(text, 0) if "x" in text.lower() else int(text)
    if _DECIMAL.fullmatch(text):
        return float(text.lower().replace(".inf", "inf").replace(".nan", "nan"))
    return text
