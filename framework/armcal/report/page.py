"""Panels of figures as inline SVG: axes, points, lines and words, styled by the page's classes.

Drawn here and not by matplotlib: importing that alone would lengthen a run of two seconds by a fifth, drawing by more.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from markupsafe import Markup, escape

from armcal.base.arrays import Array
from armcal.report.document import Document, Figure, Marks, Panel
from armcal.report.numbers import MINUS, count, decimals_for, fixed, significant
from armcal.version import __version__

WIDTH, HEIGHT = 400.0, 250.0
_LETTER, _ROW = 6.6, 17.0  # of names beside rows, px
_GROUPED = 10_000
_LOG_ALL_STEPS, _LOG_SOME_STEPS = 2.2, 4.0  # decades


@dataclass(frozen=True)
class Axis:
    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, values: Array) -> Array:
        inside = np.clip(np.asarray(values, dtype=float), self.low, self.high)
        low, high = self.low, self.high
        if self.log:
            inside, low, high = np.log10(inside), math.log10(low), math.log10(high)
        return np.asarray(self.start + (inside - low) / (high - low) * (self.end - self.start))

    def ticks(self, about: int) -> list[tuple[float, str]]:
        if self.log:
            decades = math.log10(self.high / self.low)
            steps = (1, 2, 5) if decades <= _LOG_ALL_STEPS else (1, 3) if decades <= _LOG_SOME_STEPS else (1,)
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            skip = max(1, math.ceil(decades / 8))
            marks = [step * 10.0**p for p in powers if p % skip == 0 for step in steps]
            values = [v for v in marks if self.low * (1 - 1e-9) <= v <= self.high * (1 + 1e-9)]
            labels = [significant(v, 1) for v in values]
        else:
            nice = nice_step((self.high - self.low) / about)
            first, last = math.ceil(self.low / nice - 1e-9), math.floor(self.high / nice + 1e-9)
            values, decimals = [i * nice for i in range(first, last + 1)], decimals_for(nice, 1)
            grouped = decimals == 0 and max(abs(self.low), abs(self.high)) >= _GROUPED
            labels = [count(round(v)).replace("-", MINUS) if grouped else fixed(v, decimals) for v in values]
        return list(zip(self.at(np.array(values)).tolist(), labels, strict=True))


def nice_step(rough: float, steps: Sequence[float] = (1, 2, 5, 10, 20)) -> float:
    """One of some numbers (1, 2 or 5) times a power of ten, at least ``rough``."""
    if not math.isfinite(rough) or rough <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(rough))
    return next(step * power for step in steps if step * power >= rough * (1 - 1e-9))


def drawn(figure: Figure, ident: str) -> list[Markup]:
    """Each panel of a figure; ``ident`` is unique on the page."""
    panels = []
    for i, panel in enumerate(figure.panels):
        x, y, bottom = _axes(panel)
        parts = [*([] if panel.bare else _frame(panel, x, y)), *(_marks(marks, x, y) for marks in panel.marks)]
        title, name = f"{figure.title}: {panel.title}" if panel.title else figure.title, escape(f"{ident}-{i}")
        panels.append(
            Markup(
                f'<svg role="img" aria-labelledby="{name}-t {name}-d" viewBox="0 0 {WIDTH:.0f} {bottom:.0f}">'
                f'<title id="{name}-t">{escape(title)}</title><desc id="{name}-d">{escape(figure.said)}</desc>'
                f"{''.join(parts)}</svg>"
            )
        )
    return panels


def _axes(panel: Panel) -> tuple[Axis, Axis, float]:
    of_x = np.concatenate([np.zeros(0), *(m.xy[0] for m in panel.marks)])
    of_y = np.concatenate([np.zeros(0), *(m.xy[1] for m in panel.marks)])
    low, high = _ends(of_x, panel.log)
    left = 45.0 if panel.bare else 52.0
    if panel.rows:
        left = min(max(map(len, panel.rows)), 24) * _LETTER + 14
    top, right = 6.0, WIDTH - (45.0 if panel.bare else 12.0)
    height = _ROW * len(panel.rows) if panel.rows else HEIGHT - 46
    start, end = (-0.7, len(panel.rows) - 0.3) if panel.rows else _ends(of_y, False)
    if panel.equal:
        wide, tall = 1.04 * (high - low), 1.04 * (end - start)
        scale = min((right - left) / wide, 1.15 * (right - left) / tall)
        height = max(tall * scale, 0.35 * WIDTH)
        middle, half = (low + high) / 2, (right - left) / scale / 2
        low, high = middle - half, middle + half
        middle, half = (start + end) / 2, height / scale / 2
        start, end = middle - half, middle + half
    start, end = start if panel.low is None else panel.low, end if panel.high is None else panel.high
    bottom = top + height
    upside_down = panel.down or panel.rows
    y = Axis(start, end, top, bottom) if upside_down else Axis(start, end, bottom, top)
    return Axis(low, high, left, right, panel.log), y, bottom + (2.0 if panel.bare else 40.0)


def _ends(values: Array, log: bool) -> tuple[float, float]:
    values = values[np.isfinite(values)]
    if log:
        values = values[values > 0]
    if not len(values):
        return (0.1, 1.0) if log else (0.0, 1.0)
    low, high = float(values.min()), float(values.max())
    if log:
        return low / 1.15, high * 1.15
    margin = 0.05 * (high - low) or max(abs(high), 1e-9) * 0.1
    return low - (margin if low else 0.0), high + margin


def _frame(panel: Panel, x: Axis, y: Axis) -> list[str]:
    top, bottom = min(y.start, y.end), max(y.start, y.end)
    parts = []
    for at, label in x.ticks(5):
        parts += [_line(at, top, at, bottom, "grid"), _text(at, bottom + 15, label, "tick", "middle")]
    for at, name in zip(y.at(np.arange(len(panel.rows), dtype=float)).tolist(), panel.rows, strict=True):
        label = name if len(name) <= 24 else f"{name[:11]}…{name[-12:]}"
        parts += [_text(x.start - 7, at + 4, label, "mono", "end"), _line(x.start, at, x.end, at, "grid")]
    for at, label in [] if panel.rows else y.ticks(5):
        parts += [_line(x.start, at, x.end, at, "grid"), _text(x.start - 6, at + 4, label, "tick", "end")]
    parts.append(_line(x.start, bottom, x.end, bottom, "axis"))
    parts.append(_text((x.start + x.end) / 2, bottom + 33, panel.x, "label", "middle"))
    if panel.y:
        middle = (top + bottom) / 2
        parts.append(_text(13, middle, panel.y, "label", "middle", f' transform="rotate(-90 13 {middle:.1f})"'))
    return parts


def _marks(marks: Marks, x: Axis, y: Axis) -> str:
    """Points are the caps of lines without length: few bytes each."""
    known = np.isfinite(marks.xy[0]) & np.isfinite(marks.xy[1])
    pixels = zip(x.at(marks.xy[0]).tolist(), y.at(marks.xy[1]).tolist(), known.tolist(), strict=True)
    if marks.texts:
        words = zip(pixels, marks.texts, strict=True)
        return "".join(_text(a, b, text, marks.style, "middle") for (a, b, ok), text in words if ok)
    if marks.style.startswith("dot"):
        path = "".join(f"M{a:.1f} {b:.1f}h0" for a, b, ok in pixels if ok)
    else:
        pen, path = "M", ""
        for a, b, ok in pixels:
            path += f"{pen}{a:.1f} {b:.1f}" if ok else ""
            pen = "L" if ok else "M"
    return f'<path class="{marks.style}" d="{path}"/>' if path else ""


def _text(x: float, y: float, content: str, css: str, anchor: str, more: str = "") -> str:
    return f'<text x="{x:.1f}" y="{y:.1f}" text-anchor="{anchor}" class="{css}"{more}>{escape(content)}</text>'


def _line(x1: float, y1: float, x2: float, y2: float, css: str) -> str:
    return f'<path class="{css}" d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}"/>'


_WORDS = {"bad": "Bad", "warning": "Warning", "note": "Note", "good": "Passed"}
_SYMBOLS = {"bad": "✕", "warning": "!", "note": "i", "good": "✓"}


def page(document: Document) -> str:
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    loader = FileSystemLoader(Path(__file__).parent)
    environment = Environment(loader=loader, autoescape=True, undefined=StrictUndefined, trim_blocks=True)
    environment.lstrip_blocks = True
    environment.tests["a"] = lambda part, kind: type(part).__name__ == kind
    content = {"document": document, "version": __version__, "words": _WORDS, "symbols": _SYMBOLS, "drawn": drawn}
    return environment.get_template("page.html.j2").render(content)
