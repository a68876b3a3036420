"""The files of a new plugin: one small component with its registration and a test, as one file or as a package."""

from collections.abc import Mapping
from pathlib import Path
from types import MappingProxyType

from armcal.hooks import KINDS as HOOKS
from armcal.scaffold.naming import PREFIX
from armcal.scaffold.rendering import rendered_file, staged, write_texts

_EXAMPLES: Mapping[str, str] = MappingProxyType(
    {
        "model": "an arm whose joints all turn about parallel axes",
        "effect": "the error of a gear, once a turn of one of its wheels",
        "measurement": "the distance of the tip from a fixed point, read by a draw wire",
        "estimator": "least squares by SciPy's trust region method",
        "reader": "records from a file of JSON objects, one a line",
        "device": "servos on a board that takes pulses in microseconds",
        "exporter": "every parameter of a calibrated arm as plain text",
    }
)
"""What the component of each kind is."""
KINDS = tuple(_EXAMPLES)


def write_plugin(name: str, kind: str, folder: Path, package: bool = False) -> tuple[str, ...]:
    """Write a plugin; gives the files by their place in the folder.

    Args:
        name: of plugin and component, as ``naming.plugin_name`` gives it.
        kind: one of ``KINDS``.
        folder: to be made.
        package: whether it is to be installed, with a registration that imports nothing heavy; else one file.

    Raises:
        InputError: it is there already, or cannot be written.
    """
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
