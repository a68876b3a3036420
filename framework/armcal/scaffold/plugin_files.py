"""Files of new projects: a plugin's component with its registration and test; texts from templates, names, folders that
appear whole or not at all."""

import importlib.util
import keyword
import re
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from armcal.config.yaml_source import word
from armcal.errors import InputError, Location
from armcal.hooks import KINDS as HOOKS
from armcal.io.plain_files import writing
from armcal.plugins import PluginRegistry

LONGEST = 20  # characters; lines with a longer name would not fit the width that the plugin's linter asks for
PREFIX = "armcal_"
_PLUGIN = re.compile(r"[a-z][a-z0-9_]*")
TEMPLATES = Path(__file__).with_name("templates")
_DIGITS = 12


def rendered(folder: str, context: Mapping[str, Any]) -> dict[str, str]:
    """All templates of a folder, by the paths of what they make there."""
    names = [path.relative_to(TEMPLATES / folder).as_posix() for path in sorted((TEMPLATES / folder).rglob("*.j2"))]
    return {name.removesuffix(".j2"): rendered_file(f"{folder}/{name}", context) for name in names}


def rendered_file(template: str, context: Mapping[str, Any]) -> str:
    import jinja2

    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(TEMPLATES),
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"word": word, "number": number}
    return environment.get_template(template).render(context)


def number(value: float) -> str:
    """A number as YAML 1.1 and people read it: no exponent, 12 digits."""
    text = np.format_float_positional(float(f"{value:.{_DIGITS}g}"), trim="-")
    return "0" if text == "-0" else text


@contextmanager
def staged(folder: Path) -> Iterator[Path]:
    """A folder beside ``folder`` that takes its place at the end; on any fault nothing is left of it."""
    if folder.exists() or folder.is_symlink():
        hint = "Give another --out, or move it away."
        raise InputError("it is there already.", where=Location(str(folder)), hint=hint)
    with writing(folder, "Give --out a place that can be written."):
        folder.parent.mkdir(parents=True, exist_ok=True)
        place = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
        try:
            yield place
            place.chmod(0o755)
            place.rename(folder)
        finally:
            shutil.rmtree(place, ignore_errors=True)


def write_texts(folder: Path, texts: Mapping[str, str]) -> None:
    for name, text in texts.items():
        path = folder / name
        path.parent.mkdir(parents=True, exist_ok=True)
        path.write_text(text, encoding="utf-8", newline="\n")


def plugin_name(text: str, registry: PluginRegistry) -> str:
    """The name of a new plugin and its component, hyphens made underscores."""
    name = text.replace("-", "_")
    check_length(text, name)
    if name.startswith(PREFIX):
        mend = f"Leave {PREFIX} out: the package gets it by itself."
        raise InputError(f"found the name {text!r}, expected what comes after {PREFIX}.", hint=mend)
    if not _PLUGIN.fullmatch(name) or keyword.iskeyword(name):
        text = f"found the name {text!r}, expected a Python name of small letters, digits, - and _."
        hint = "Begin with a letter, as in draw-wire."
        raise InputError(text, hint=hint)
    taken = next((f"a plugin is called {name!r} already" for plugin in registry.plugins if plugin.name == name), "")
    for own in (component for component in registry.components if component.name == name):
        taken = f"the plugin {own.plugin!r} offers the {own.kind} {name!r} already"
    if importlib.util.find_spec(PREFIX + name) is not None:
        taken = taken or f"a package {PREFIX}{name} is installed already"
    if taken:
        raise InputError(f"{taken}.", hint="Choose another name; `armcal plugins list` shows those that are taken.")
    return name


def check_length(text: str, name: str) -> None:
    if len(name) > LONGEST:
        shown = text if len(text) <= 2 * LONGEST else f"{text[: 2 * LONGEST]}..."
        raise InputError(
            f"found the name {shown!r} of {len(name)} characters, expected at most {LONGEST}.", hint="Shorten it."
        )


_EXAMPLES = {  # what the component of each kind is
    "model": "an arm whose joints all turn about parallel axes",
    "effect": "the error of a gear, once a turn of one of its wheels",
    "measurement": "the distance of the tip from a fixed point, read by a draw wire",
    "estimator": "least squares by SciPy's trust region method",
    "reader": "records from a file of JSON objects, one a line",
    "device": "servos on a board that takes pulses in microseconds",
    "exporter": "every parameter of a calibrated arm as plain text",
}
KINDS = tuple(_EXAMPLES)


def write_plugin(name: str, kind: str, folder: Path, package: bool = False) -> tuple[str, ...]:
    """Write a plugin, one file or a package to be installed; gives the files by their place in the folder."""
    own, title = PREFIX + name, "".join(part.capitalize() for part in name.split("_"))
    context = {
        "name": name,
        "kind": kind,
        "single": not package,
        "package": own,
        "module": f"{own}.{kind}" if package else name,
        "distribution": own.replace("_", "-"),
        "component": f"{title}{kind.capitalize()}",
        "settings": f"{title}Settings",
        "hook": HOOKS[kind],
        "summary": _EXAMPLES[kind],
    }
    sources = {f"{name}.py": f"{kind}/component.py.j2", f"test_{name}.py": f"{kind}/test.py.j2"}
    if package:
        sources = {
            "pyproject.toml": "pyproject.toml.j2",
            f"{own}/__init__.py": "__init__.py.j2",
            f"{own}/{kind}.py": f"{kind}/component.py.j2",
            f"tests/test_{name}.py": f"{kind}/test.py.j2",
        }
    with staged(folder) as place:
        write_texts(place, {path: rendered_file(f"plugin/{source}", context) for path, source in sources.items()})
    return tuple(sorted(sources))
