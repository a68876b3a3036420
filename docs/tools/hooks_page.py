"""Make the page of hooks and kinds of component from their specifications: ``python docs/tools/hooks_page.py``.

Signatures and docstrings become ``docs/hooks.md``; a test compares the two.
"""

from __future__ import annotations

import ast
import inspect
import re
import textwrap
import typing
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from types import FunctionType, MappingProxyType
from typing import Any

from armcal import hooks

_METHODS: Any = (FunctionType, property)
_SECTION = re.compile(r"^(Args|Attributes|Raises|Returns):$")
_ENTRY = re.compile(r"^(\w+): (.*)$")

WORDS: Mapping[str, str] = MappingProxyType(
    {
        "address": "of a device on the bus, 7 bits.",
        "after_s": "how long the host must have been silent (s).",
        "angle": "of a joint, as commanded (rad).",
        "angles": "by joint name, as commanded (rad).",
        "arms": "each arm that takes part, by instance name, as it stands in the record.",
        "chain": "the arm that its model describes.",
        "channels": "what to listen for, each an arm's joint: `arm.q1`.",
        "count": "how many bytes.",
        "counts_per_s": "how fast each channel may go, by address and channel.",
        "data": "all bytes of the transaction.",
        "group": "its key: its labels joined by a slash.",
        "groups": "the keys of all groups that the records have.",
        "joint": "a joint's name.",
        "measured": "what the record says, by the local names of the channels (SI).",
        "progress": "receives what is being done, and which fraction of it is done.",
        "pulse": "its length (s).",
        "register": "the number of the first register.",
        "targets": "ON and OFF counts, by address and channel.",
        "values": "the parameters, as CasADi expressions under their local names, a block's entries in a column.",
        "waypoints": "where to go, in order: angles by joint (rad), of a link counts by address and channel.",
    }
)
"""Arguments of several methods that their docstrings do not explain again."""


@dataclass(frozen=True)
class Entry:
    """A hook or a method: how it is called, what it does, what each argument is, what it raises."""

    name: str
    call: str
    text: str
    arguments: tuple[tuple[str, str], ...]
    raises: tuple[tuple[str, str], ...] = ()


@dataclass(frozen=True)
class ProtocolEntry:
    """What a component has, or may have beside: ``module.class``, its docstring, its methods.

    ``is_base``: it is a class to derive from, which gives the methods defaults.
    """

    name: str
    text: str
    methods: tuple[Entry, ...]
    is_base: bool = False


@dataclass(frozen=True)
class KindEntry:
    """A kind of component."""

    kind: str
    hook: Entry
    built_as: str
    protocol: ProtocolEntry
    beside: tuple[ProtocolEntry, ...]


@dataclass(frozen=True)
class Reference:
    """All of a contract."""

    register: Entry
    kinds: tuple[KindEntry, ...]
    observers: tuple[Entry, ...]


def reference(specifications: Any = hooks) -> Reference:
    """Of a module of specifications, such as ``armcal.hooks``."""
    kinds = tuple(
        KindEntry(
            kind,
            _entry(getattr(specifications, component.hook)),
            component.built_as,
            _protocol(component.protocol),
            tuple(map(_protocol, component.beside)),
        )
        for kind, component in specifications.COMPONENTS.items()
    )
    registering = {component.hook for component in specifications.COMPONENTS.values()}
    marked = [f for f in vars(specifications).values() if hasattr(f, f"{hooks.PROJECT}_spec")]
    observers = tuple(_entry(hook) for hook in marked if hook.__name__ not in registering)
    register = _entry(specifications.Register.__call__, "register")
    return Reference(register, kinds, observers)


def _protocol(target: str) -> ProtocolEntry:
    module, _, name = target.partition(":")
    made = getattr(import_module(module), name)
    text = inspect.cleandoc(made.__doc__ or "")
    methods = [
        _entry(getattr(member, "fget", member), name, text, isinstance(member, property))
        for name, member in vars(made).items()
        if not name.startswith("_") and isinstance(member, _METHODS)
    ]
    return ProtocolEntry(f"{module}.{name}", text, tuple(methods), not getattr(made, "_is_protocol", False))


def _entry(function: Callable[..., Any], name: str = "", around: str = "", is_property: bool = False) -> Entry:
    """A function as the reference shows it; ``around`` is the docstring of its class."""
    name = name or function.__name__
    text, sections = _sections(inspect.cleandoc(function.__doc__ or ""))
    # Annotations are shown as they are written, whether or not Python evaluates them.
    written = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    assert isinstance(written, ast.FunctionDef)
    arguments = tuple(
        (p, _explained(p, function, sections.get("Args", {}), f"{around}\n{text}"))
        for p in inspect.signature(function).parameters
        if p != "self"
    )
    shown = (*written.args.posonlyargs, *written.args.args, *written.args.kwonlyargs)
    defaults = dict(zip(reversed(shown), reversed((*written.args.defaults, *written.args.kw_defaults)), strict=False))
    parts = [
        ast.unparse(a) + (f" = {ast.unparse(default)}" if (default := defaults.get(a)) is not None else "")
        for a in shown
        if a.arg != "self"
    ]
    call = name if is_property else f"{name}({', '.join(parts)})"
    if written.returns is not None and ast.unparse(written.returns) != "None":
        call += f" -> {ast.unparse(written.returns)}"
    return Entry(name, call, text, arguments, tuple(sections.get("Raises", {}).items()))


def _explained(parameter: str, function: Callable[..., Any], summaries: Mapping[str, str], text: str) -> str:
    """From its own docstring, the class's, the words above, or the docstring of its type."""
    if parameter in summaries:
        return summaries[parameter]
    if f"``{parameter}``" in text:
        return "see above."
    if parameter in WORDS:
        return WORDS[parameter]
    try:
        hint = typing.get_type_hints(function).get(parameter)
    except (NameError, TypeError):  # of a type that is only imported for type checkers
        return ""
    if isinstance(hint, type) and hint.__module__.partition(".")[0] == "armcal" and hint.__doc__:
        first = inspect.cleandoc(hint.__doc__).split("\n\n")[0]
        return f"`{hint.__module__}.{hint.__name__}`. {' '.join(first.split())}"
    return ""


def _sections(text: str) -> tuple[str, dict[str, dict[str, str]]]:
    """A docstring without its sections, and the entries of each (``Args``, ``Raises``)."""
    kept, sections, inside, last = list[str](), dict[str, dict[str, str]](), "", ""
    for line in text.splitlines():
        heading = _SECTION.match(line)
        if heading:
            inside = heading[1]
            sections[inside] = {}
        elif inside and line.startswith("    "):
            entry = _ENTRY.match(line[4:])
            if entry:
                last = entry[1]
                sections[inside][last] = entry[2]
            elif last:
                sections[inside][last] += f" {line.strip()}"
        elif line or not inside:
            inside = ""
            kept.append(line)
    return "\n".join(kept).strip(), sections


def as_markdown(reference: Reference) -> str:
    """The page ``docs/hooks.md``."""
    lines = [
        "# Hooks and kinds of component",
        "",
        "This page is made from armcal's own specifications by `docs/tools/hooks_page.py`. Do not",
        "edit it. How to write a plugin is in [write a plugin](write_a_plugin.md).",
        "",
        "A registration module marks each hook with `@hookimpl` and may leave out any hook, and any argument of one.",
        "",
        "| Kind | Hook | Built as | Derives from, or must have |",
        "| --- | --- | --- | --- |",
    ]
    for kind in reference.kinds:
        row = (f"[{kind.kind}](#{kind.kind})", f"`{kind.hook.name}`")
        lines.append(f"| {' | '.join((*row, f'`{kind.built_as}`', f'`{kind.protocol.name}`'))} |")
    lines += [
        "",
        "`settings` are the component's own checked `Settings`, `joint_names` the commanded joints of its arm from",
    ]
    lines += ["the base, `arm_names` all arms' instance names, `link` the link of the bench.", ""]
    lines += ["## Announcing a component", "", *_markdown(reference.register)]
    lines += ["## Observers", "", "They are notified of what happens; what they return is ignored.", ""]
    for hook in reference.observers:
        lines += [f"### `{hook.name}`", "", *_markdown(hook)]
    for kind in reference.kinds:
        lines += [f"## {kind.kind}", "", _marked(kind.hook.text), ""]
        lines += [f"Announced in `{kind.hook.call}`, built as `{kind.built_as}`.", ""]
        for protocol in (kind.protocol, *kind.beside):
            must, may = ("Derives from", "May derive from") if protocol.is_base else ("Must have", "May have")
            may = must if protocol is kind.protocol else may
            lines += [f"### {may}: `{protocol.name}`", "", *_paragraphs(protocol.text)]
            for method in protocol.methods:
                lines += _markdown(method)
    return "\n".join(lines).rstrip() + "\n"


def _markdown(entry: Entry) -> list[str]:
    call = entry.call
    if len(call) > 110:  # an argument a line
        head, _, rest = call.partition("(")
        inner, _, after = rest.rpartition(")")
        arguments = "".join(f"    {part},\n" for part in re.split(r", (?=\w+: )", inner))
        call = f"{head}(\n{arguments}){after}"
    lines = ["```py", call, "```", "", *_paragraphs(entry.text)]
    listed = [f"- `{name}`: {_marked(explained)}" for name, explained in entry.arguments]
    listed += [f"- raises `{error}`: {_marked(why)}" for error, why in entry.raises]
    return [*lines, *listed, ""] if listed else lines


def _paragraphs(text: str) -> list[str]:
    plain, sections = _sections(text)
    lines = [line for part in plain.split("\n\n") for line in (_marked(" ".join(part.split())), "")]
    attributes = [f"- `{name}`: {_marked(said)}" for name, said in sections.get("Attributes", {}).items()]
    return [*lines, *attributes, ""] if attributes else lines


def _marked(text: str) -> str:
    return text.replace("``", "`")


if __name__ == "__main__":
    Path(__file__).resolve().parents[1].joinpath("hooks.md").write_text(as_markdown(reference()), encoding="utf-8")
