"""What all figures of this plugin share: an empty one, the style of its axes, and its bytes."""

import base64
import io
from dataclasses import dataclass
from typing import Any, Literal

INK, GRID = "#222222", "#dddddd"
LABEL_POINTS = 9.5


@dataclass(frozen=True)
class Picture:
    """A figure: PNG, title, and words for those who do not see it."""

    name: str
    title: str
    png: bytes
    description: str

    @property
    def data(self) -> str:
        return base64.b64encode(self.png).decode()


def empty_figure(size: tuple[float, float]) -> Any:
    """A figure of so many inches, drawn without a screen."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=size, dpi=120, layout="constrained")
    FigureCanvasAgg(figure)
    return figure


def style(axes: Any, across: str = "", up: str = "", grid: Literal["both", "y", ""] = "both") -> None:
    """Axes with labels, without a frame to the right and above."""
    axes.set_xlabel(across, fontsize=LABEL_POINTS, color=INK)
    axes.set_ylabel(up, fontsize=LABEL_POINTS, color=INK)
    if grid:
        axes.grid(axis=grid, color=GRID, lw=0.6)
    axes.set_axisbelow(True)
    axes.tick_params(labelsize=8.5, colors=INK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)


def png_of(figure: Any) -> bytes:
    stream = io.BytesIO()
    figure.savefig(stream, format="png", metadata={"Software": None})
    return stream.getvalue()
