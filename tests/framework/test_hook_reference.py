"""The reference of hooks: made from the specifications, complete, and the page in docs/ is what is made now."""

from __future__ import annotations

import inspect
import re
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from armcal import hooks

from docs.tools.hooks_page import WORDS, ProtocolEntry, Reference, as_markdown, reference

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "hooks.md"


def missing(reference: Reference) -> list[str]:
    """What a reader would not find explained: hooks and methods without a docstring, arguments without a word."""
    gaps = []
    entries = [("", hook) for hook in (reference.register, *(k.hook for k in reference.kinds), *reference.observers)]
    for protocol in _protocols(reference):
        gaps += [f"{protocol.name}: a docstring"] if not protocol.text else []
        entries += [(f"{protocol.name}.", method) for method in protocol.methods]
    for before, entry in entries:
        gaps += [f"{before}{entry.name}: a docstring"] if not entry.text else []
        gaps += [f"{before}{entry.name}: the argument {name}" for name, explained in entry.arguments if not explained]
    return gaps


def idle_words(reference: Reference) -> list[str]:
    """Words of the table above that explain no argument."""
    used = {
        name
        for protocol in _protocols(reference)
        for method in protocol.methods
        for name, explained in method.arguments
        if explained == WORDS.get(name)
    }
    return [word for word in WORDS if word not in used]


def _protocols(reference: Reference) -> list[ProtocolEntry]:
    return [protocol for kind in reference.kinds for protocol in (kind.protocol, *kind.beside)]


def test_the_page_is_what_is_made_now() -> None:
    made = as_markdown(reference())
    assert PAGE.read_text(encoding="utf-8") == made, "run: python docs/tools/hooks_page.py"


def test_every_hook_method_and_argument_is_explained() -> None:
    assert missing(reference()) == []


def test_no_word_is_explained_that_no_method_uses() -> None:
    assert idle_words(reference()) == []


def test_every_specification_is_in_the_reference() -> None:
    """Functions and table of the module are counted here, not by what the reference itself walks over."""
    marked = set(re.findall(r"@hookspec\ndef (\w+)", inspect.getsource(hooks))) | set(hooks.REGISTRATIONS)
    assert all(hasattr(getattr(hooks, name), f"{hooks.PROJECT}_spec") for name in marked)
    found = reference()
    shown = {kind.hook.name for kind in found.kinds} | {observer.name for observer in found.observers}
    assert shown == marked
    assert {kind.kind for kind in found.kinds} == set(hooks.KINDS)
    page = PAGE.read_text(encoding="utf-8")
    for name in marked:
        assert page.count(name) >= 2, name


@pytest.mark.parametrize("kind", hooks.COMPONENTS)
def test_every_public_method_of_a_protocol_is_on_the_page(kind: str) -> None:
    found = next(each for each in reference().kinds if each.kind == kind)
    for entry in (found.protocol, *found.beside):
        module, _, name = entry.name.rpartition(".")
        made = getattr(import_module(module), name)
        members = {m: value for m, value in vars(made).items() if not m.startswith("_")}
        methods = {m for m, value in members.items() if inspect.isfunction(value) or isinstance(value, property)}
        assert {method.name for method in entry.methods} == methods
        explained = inspect.cleandoc(made.__doc__ or "")
        assert all(f"{m}: " in explained for m in members.keys() - methods)
        assert entry.is_base == (not getattr(made, "_is_protocol", False))


def changed(**functions: Any) -> SimpleNamespace:
    """The specifications with hooks added or exchanged."""
    for function in functions.values():
        hooks.hookspec(function)
    return SimpleNamespace(**{**vars(hooks), **functions})


def test_a_hook_without_a_word_is_found() -> None:
    def armcal_arm_parked(arm: str, seconds: float) -> None:
        pass

    found = missing(reference(changed(armcal_arm_parked=armcal_arm_parked)))
    assert "armcal_arm_parked: a docstring" in found
    assert "armcal_arm_parked: the argument arm" in found


def test_an_argument_that_is_not_explained_is_found() -> None:
    def armcal_run_ended(name: str, folder: str, reason: str) -> None:
        """A run has ended.

        Args:
            name: of the experiment.
            folder: where the results are,
                all of them.
        """

    specifications = changed(armcal_run_ended=armcal_run_ended)
    assert missing(reference(specifications)) == ["armcal_run_ended: the argument reason"]
    assert "- `folder`: where the results are, all of them.\n" in as_markdown(reference(specifications))
    assert as_markdown(reference(specifications)) != PAGE.read_text(encoding="utf-8")


def test_the_page_has_no_line_of_markup_left_over() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert "``" not in text.replace("```", "")
    assert "Args:" not in text
    for link in re.findall(r"\]\(#(\w+)\)", text):
        assert f"\n## {link}\n" in text
