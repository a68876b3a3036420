"""Commands as a shell's completion needs them: their options, without the libraries that only running them needs."""

import sys
from collections.abc import Iterator
from importlib import import_module
from importlib.machinery import ModuleSpec
from types import ModuleType
from typing import Any, Self

import click
from click.shell_completion import CompletionItem

from armcal.plugins import discover

_REAL = (
    "armcal.calibration.compensation.request",
    "armcal.calibration.measured_point",
    "armcal.errors",
    "armcal.hooks",
    "armcal.planning.criterion",
    "armcal.scaffold.plugin_files",
    "armcal.version",
)
"""Files with the values of options; with the standard library, click, ``armcal.cli`` and the command's neighbours they
are imported as they are."""


def options_of(target: str) -> click.Command:
    """The command at ``module:attribute``, to be completed and never run.

    Its file is imported with placeholders for all that is heavy; what came in meanwhile is forgotten again.
    """
    module, _, attribute = target.partition(":")
    before, finder = set(sys.modules), _Placeholders(module)
    sys.meta_path.insert(0, finder)
    try:
        command: click.Command = getattr(import_module(module), attribute)
        return command
    except Exception:  # a plugin's file that uses at once what it imports
        pass
    finally:
        sys.meta_path.remove(finder)
        for name in set(sys.modules) - before:
            del sys.modules[name]
    whole: click.Command = getattr(import_module(module), attribute)
    return whole


def component_names(kind: str, ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """The names that plugins offer, for ``shell_complete``."""
    offered = (c for c in discover().components if c.kind == kind and c.name.startswith(incomplete))
    return [CompletionItem(c.name, help=c.summary) for c in offered]


class _Placeholder(ModuleType):
    """Stands for whatever was imported: a module, a class to inherit from, a decorator, a constant."""

    __file__ = None

    def __init__(self, name: str) -> None:
        super().__init__(name)
        self.__path__ = []

    def __getattr__(self, name: str) -> Any:
        if name.startswith("__"):
            raise AttributeError(name)
        return _Placeholder(name)

    def __call__(self, *arguments: Any, **more: Any) -> Any:
        return arguments[0] if len(arguments) == 1 and callable(arguments[0]) and not more else self

    def __mro_entries__(self, bases: tuple[Any, ...]) -> tuple[type, ...]:
        return ()

    def __getitem__(self, key: Any) -> Self:
        return self

    def __or__(self, other: Any) -> Self:
        return self

    __ror__ = __or__

    def __iter__(self) -> Iterator[Any]:
        return iter(())


class _Placeholders:
    """An importer of placeholders; what is needed to know a command's options is left to the others."""

    def __init__(self, module: str) -> None:
        self._beside = f"{module.rpartition('.')[0]}."

    def find_spec(self, name: str, path: object = None, target: object = None) -> ModuleSpec | None:
        top, needed = name.partition(".")[0], (self._beside, "armcal.cli.", *_REAL)
        is_real = top in sys.stdlib_module_names or top == "click" or name.startswith(("armcal.cli.", self._beside))
        if is_real or any(f"{file}.".startswith(f"{name}.") for file in needed):
            return None
        return ModuleSpec(name, self, is_package=True)  # type: ignore[arg-type]

    def create_module(self, spec: ModuleSpec) -> ModuleType:
        return _Placeholder(spec.name)

    def exec_module(self, module: ModuleType) -> None:
        """Nothing is to be done."""
