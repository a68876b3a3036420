"""Plugins without a package: Python files, each a component and its registration.

Which ones are loaded stands in environment variables, so that every process that is started knows them too. A file
``gear.py`` is the module ``armcal.plugin_files.gear``, by which other processes find its components again.
"""

from __future__ import annotations

import hashlib
import importlib
import os
import re
import sys
import traceback
from collections.abc import Iterator, Sequence
from importlib.abc import MetaPathFinder
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.metadata import EntryPoint
from importlib.util import spec_from_file_location
from pathlib import Path
from types import CodeType, ModuleType

from armcal.errors import Location, PluginError

GROUP = "armcal"
CHOSEN, DISABLED = "ARMCAL_PLUGINS", "ARMCAL_DISABLED_PLUGINS"
"""The environment variables: paths of files and folders, and names of plugins, both separated as ``PATH`` is."""
__path__: list[str] = []  # a package, whose modules the finder below finds

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_NO_PLUGINS = ("_", "test_", "conftest")


def use_plugins(*places: str | Path, disabled: Sequence[str] = ()) -> None:
    """Load these files, and all files of these folders, from now on, in this process and those that it starts.

    ``disabled`` are names of plugins that are left out. What a former call named is forgotten.
    """
    os.environ[CHOSEN] = os.pathsep.join(str(Path(place).absolute()) for place in places)
    os.environ[DISABLED] = os.pathsep.join(disabled)


def disabled() -> tuple[str, ...]:
    return _listed(DISABLED)


def files() -> dict[str, Path]:
    """The chosen files by the name of their plugin.

    Raises:
        PluginError: a file or folder is not there or holds no plugin, or two files make plugins of one name.
    """
    paths: dict[str, Path] = {}
    for place in map(Path, _listed(CHOSEN)):
        for file in _files_of(place):
            other = paths.setdefault(file.stem, file)
            if other != file:
                text = f"two plugins are called {file.stem!r}: {other} and {file}."
                raise PluginError(text, hint="Rename one of the files.")
    return paths


def digest(file: Path) -> str:
    return f"sha256 {hashlib.sha256(file.read_bytes()).hexdigest()[:16]}"


class FilePoint(EntryPoint):
    """An entry point whose module is a file."""

    @classmethod
    def of(cls, name: str) -> FilePoint:
        return cls(name, f"{__name__}.{name}", GROUP)

    @property
    def file(self) -> Path:
        return files()[self.name]

    def load(self) -> ModuleType:
        """Import the file, anew where it is another than before.

        Raises:
            PluginError: it does not import; with the line.
        """
        file = self.file
        known = sys.modules.get(self.value)
        if known is not None and (known.__file__, known.armcal_digest) != (str(file), digest(file)):
            del sys.modules[self.value]
        try:
            return importlib.import_module(self.value)
        except (Exception, SystemExit) as fault:  # whatever a user's file does, it is told where
            what = fault.msg if isinstance(fault, SyntaxError) else " ".join(str(fault).split())
            raise PluginError(
                f"it does not import: {type(fault).__name__}: {what}.", where=Location(str(file), _line(fault, file))
            ) from fault


class _Loader(SourceFileLoader):
    """Leaves no compiled file beside the source, whose age could not tell two edits of one second apart."""

    def exec_module(self, module: ModuleType) -> None:
        module.armcal_digest = digest(Path(self.path))  # type: ignore[attr-defined]
        super().exec_module(module)

    def get_code(self, fullname: str) -> CodeType:
        return self.source_to_code(self.get_data(self.path), self.path)


class _Finder(MetaPathFinder):
    """Finds the modules of chosen files, in whatever process."""

    def find_spec(self, fullname: str, path: object = None, target: object = None) -> ModuleSpec | None:
        package, _, name = fullname.rpartition(".")
        file = files().get(name) if package == __name__ else None
        return spec_from_file_location(fullname, file, loader=_Loader(fullname, str(file))) if file else None


def _listed(variable: str) -> tuple[str, ...]:
    return tuple(filter(None, os.environ.get(variable, "").split(os.pathsep)))


def _files_of(place: Path) -> Iterator[Path]:
    """A file itself, or those of a folder that are no tests and do not begin with an underscore."""
    where, hint = Location(str(place)), "as --plugin asks"
    if place.is_dir():
        paths = sorted(file for file in place.glob("*.py") if not file.name.startswith(_NO_PLUGINS))
        if not paths:
            raise PluginError(f"found no plugin in this folder, {hint}.", where=where, hint="Put NAME.py there.")
    elif place.is_file():
        paths = [place]
    else:
        raise PluginError(f"found no such file or folder, {hint}.", where=where, hint="Correct the path.")
    for file in paths:
        if file.suffix != ".py" or not _NAME.fullmatch(file.stem):
            text = "expected the name of a plugin's file, letters, digits, - and _ with .py after them."
            raise PluginError(text, where=Location(str(file)), hint="Rename it.")
        yield file


def _line(fault: BaseException, file: Path) -> int | None:
    """The last line of the file that an exception came through."""
    if isinstance(fault, SyntaxError) and fault.filename == str(file):
        return fault.lineno
    lines = [frame.lineno for frame in traceback.extract_tb(fault.__traceback__) if frame.filename == str(file)]
    return lines[-1] if lines else None


sys.meta_path.append(_Finder())
