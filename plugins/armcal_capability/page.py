"""What the pages of this plugin share: a figure's style and bytes, and the page itself."""

import base64
import io
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from armcal.report.page import rendered
from armcal.report.tables import TextTable
from armcal.version import __version__

INK, GRID = "#222222", "#dddddd"
LABEL_POINTS = 9.5


def empty_figure(size: tuple[float, float]) -> Any:
    """A figure of so many inches, drawn without a screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def style(axes: Any, across: str = "", up: str = "") -> None:
    """Axes with labels, without a frame to the right and above."""
    axes.set_xlabel(across, fontsize=LABEL_POINTS, color=INK)
    axes.set_ylabel(up, fontsize=LABEL_POINTS, color=INK)
    axes.tick_params(labelsize=8.5, colors=INK)
    axes.spines[["top", "right"]].set_visible(False)


def png_of(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()


def render_page(
    kind: str,
    title: str,
    sentences: Sequence[str],
    tables: Sequence[TextTable],
    facts: Mapping[str, str],
    picture: bytes = b"",
    description: str = "",
) -> str:
    """One self-contained HTML file; ``kind`` is what it is a page of, ``description`` what a picture (PNG) shows."""
    content = {"kind": kind, "title": title, "sentences": sentences, "tables": tables, "facts": facts}
    content |= {"picture": base64.b64encode(picture).decode(), "description": description, "version": __version__}
    return rendered("page.html.j2", content, Path(__file__).parent)
