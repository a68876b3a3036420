"""A document as one HTML file: complete in itself, readable offline and without scripts."""

from functools import lru_cache
from pathlib import Path
from typing import Any

from armcal.report.document import Document
from armcal.report.plot import drawn
from armcal.version import __version__

_WORDS = {"bad": "Bad", "warning": "Warning", "note": "Note", "good": "Passed"}
_SYMBOLS = {"bad": "✕", "warning": "!", "note": "i", "good": "✓"}


def page(document: Document) -> str:
    content = {"document": document, "version": __version__, "words": _WORDS, "symbols": _SYMBOLS}
    return str(_template().render(content))


@lru_cache(maxsize=1)
def _template() -> Any:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    environment.tests["a"] = lambda part, kind: type(part).__name__ == kind
    environment.globals["drawn"] = drawn
    return environment.get_template("page.html.j2")
