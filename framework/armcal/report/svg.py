"""Inline SVG drawn by hand: axes, points, lines and text, styled by the page's classes."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from markupsafe import Markup, escape

from armcal.base.arrays import Array
from armcal.report.numbers import MINUS, count, decimals_for, fixed, significant

WIDE, HALF, NARROW = 1040, 504, 344
MONO = 6.7  # Width of a character of the monospaced labels
DIAMOND = "m-3.6 0l3.6-3.6l3.6 3.6l-3.6 3.6z"
_GROUPED = 10_000
_LOG_ALL_STEPS = 2.2
_LOG_SOME_STEPS = 4.0


@dataclass(frozen=True)
class Figure:
    """A figure for wide and for narrow pages; the page shows the one that fits (without a narrow one it scrolls)."""

    title: str
    caption: str
    wide: Markup
    narrow: Markup | None = None


@dataclass(frozen=True)
class Box:
    """The plotting area in pixels."""

    left: float
    top: float
    right: float
    bottom: float


@dataclass(frozen=True)
class Axis:
    """Data from ``low`` to ``high`` onto pixels from ``start`` to ``end``."""

    low: float
    high: float
    start: float
    end: float
    log: bool = False

    def at(self, values: Array | Sequence[float]) -> Array:
        inside = np.clip(np.asarray(values, dtype=float), self.low, self.high)
        low, high = self.low, self.high
        if self.log:
            inside, low, high = np.log10(inside), math.log10(low), math.log10(high)
        return np.asarray(self.start + (inside - low) / (high - low) * (self.end - self.start))

    def of(self, value: float) -> float:
        return float(self.at([value])[0])

    def ticks(self, about: int) -> list[tuple[float, str]]:
        """Round values and their labels."""
        if self.log:
            decades = math.log10(self.high / self.low)
            steps = (1, 2, 5) if decades <= _LOG_ALL_STEPS else (1, 3) if decades <= _LOG_SOME_STEPS else (1,)
            powers = range(math.floor(math.log10(self.low)), math.ceil(math.log10(self.high)) + 1)
            skip = max(1, math.ceil(decades / 8))
            marks = [step * 10.0**p for p in powers if p % skip == 0 for step in steps]
            inside = [v for v in marks if self.low * (1 - 1e-9) <= v <= self.high * (1 + 1e-9)]
            return [(v, significant(v, 1)) for v in inside]
        nice = nice_step((self.high - self.low) / max(about, 1))
        first, last = math.ceil(self.low / nice - 1e-9), math.floor(self.high / nice + 1e-9)
        values = [i * nice for i in range(first, last + 1)]
        step = values[1] - values[0] if len(values) > 1 else abs(values[0]) if values else 1.0
        decimals = decimals_for(step, 1)
        if decimals == 0 and max(abs(self.low), abs(self.high)) >= _GROUPED:
            return [(v, count(round(v)).replace("-", MINUS)) for v in values]
        return [(v, fixed(v, decimals)) for v in values]


def nice_step(rough: float, steps: Sequence[float] = (1, 2, 5, 10, 20)) -> float:
    """One of some numbers (1, 2 or 5) times a power of ten, at least ``rough``."""
    if not math.isfinite(rough) or rough <= 0:
        return 1.0
    power = 10.0 ** math.floor(math.log10(rough))
    return next(step * power for step in steps if step * power >= rough * (1 - 1e-9))


def document(ident: str, size: tuple[float, float], title: str, desc: str, parts: Iterable[str]) -> Markup:
    width, height = size
    return Markup(
        f'<svg role="img" aria-labelledby="{escape(ident)}-t {escape(ident)}-d" viewBox="0 0 {width:.0f} {height:.0f}" '
        f'width="{width:.0f}" height="{height:.0f}"><title id="{escape(ident)}-t">{escape(title)}</title>'
        f'<desc id="{escape(ident)}-d">{escape(desc)}</desc>{"".join(parts)}</svg>'
    )


def both(
    ident: str, words: tuple[str, str, str], draw: Callable[[float], tuple[float, list[str]]], wide: float = WIDE
) -> Figure:
    """Draw a figure at both widths.

    Args:
        ident: its name, unique on the page.
        words: title, description, caption.
        draw: height and parts at a width.
        wide: its width on wide pages.
    """
    title, desc, caption = words
    made = []
    for name, width in (("wide", wide), ("narrow", NARROW)):
        height, parts = draw(width)
        made.append(document(f"{ident}-{name}", (width, height), title, desc, parts))
    return Figure(title, caption, made[0], made[1])


def text(x: float, y: float, content: object, css: str = "", anchor: str = "start", turn: float = 0) -> str:
    turned = f' transform="rotate({turn:g} {x:.1f} {y:.1f})"' if turn else ""
    css = f' class="{css}"' if css else ""
    anchored = f' text-anchor="{anchor}"' if anchor != "start" else ""
    return f'<text x="{x:.1f}" y="{y:.1f}"{anchored}{css}{turned}>{escape(content)}</text>'


def line(x1: float, y1: float, x2: float, y2: float, css: str) -> str:
    return f'<path class="{css}" d="M{x1:.1f} {y1:.1f}L{x2:.1f} {y2:.1f}"/>'


def rect(x: float, y: float, width: float, height: float, fill: str) -> str:
    return f'<rect x="{x:.1f}" y="{y:.1f}" width="{width:.1f}" height="{height:.1f}" fill="{fill}"/>'


def circle(x: float, y: float, radius: float, css: str) -> str:
    return f'<circle cx="{x:.1f}" cy="{y:.1f}" r="{radius:g}" class="{css}"/>'


def polyline(x: Array, y: Array, css: str) -> str:
    points = "L".join(f"{a:.1f} {b:.1f}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    return f'<path class="{css}" d="M{points}"/>' if points else ""


def dots(x: Array, y: Array, css: str, colour: str = "") -> str:
    """Round points, as the caps of lines without length: few bytes each."""
    path = "".join(f"M{a:.1f} {b:.1f}h0" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    stroke = f' stroke="{colour}"' if colour else ""
    return f'<path class="{css}"{stroke} d="{path}"/>' if path else ""


def marks(x: Array, y: Array, shape: str, css: str) -> str:
    """Points of any shape, given as a relative path about the point."""
    path = "".join(f"M{a:.1f} {b:.1f}{shape}" for a, b in zip(x.tolist(), y.tolist(), strict=True))
    return f'<path class="{css}" d="{path}"/>' if path else ""


def segments(x1: Array, y1: Array, x2: Array, y2: Array, css: str) -> str:
    rows = zip(x1.tolist(), y1.tolist(), x2.tolist(), y2.tolist(), strict=True)
    path = "".join(f"M{a:.1f} {b:.1f}L{c:.1f} {d:.1f}" for a, b, c, d in rows)
    return f'<path class="{css}" d="{path}"/>' if path else ""


def frame(box: Box, x: Axis, y: Axis | None, labels: tuple[str, str], about: tuple[int, int]) -> list[str]:
    """Grid, ticks and labels of both axes (labels: x, y); y is left out when None."""
    parts: list[str] = []
    for value, label in x.ticks(about[0]):
        at = x.of(value)
        parts.append(line(at, box.top, at, box.bottom, "grid"))
        parts.append(text(at, box.bottom + 16, label, "tick", "middle"))
    for value, label in y.ticks(about[1]) if y else []:
        at = y.of(value) if y else 0.0
        parts.append(line(box.left, at, box.right, at, "grid"))
        parts.append(text(box.left - 7, at + 4, label, "tick", "end"))
    parts.append(line(box.left, box.bottom, box.right, box.bottom, "axis"))
    parts.append(text((box.left + box.right) / 2, box.bottom + 36, labels[0], "label", "middle"))
    if labels[1]:
        parts.append(text(15, (box.top + box.bottom) / 2, labels[1], "label", "middle", -90))
    return parts


def legend(x: float, width: float, entries: Sequence[tuple[str, str]]) -> tuple[float, list[str]]:
    """Entries (mark drawn about 0 0 within 22 px, words) in as many rows as they need; gives the next free y."""
    parts: list[str] = []
    at, y = x, 12.0
    for mark, words in entries:
        length = 30 + 6.6 * len(words) + 14
        if at > x and at + length > x + width:
            at, y = x, y + 18
        parts.append(f'<g transform="translate({at:.1f} {y:.1f})">{mark}{text(28, 4, words, "tick")}</g>')
        at += length
    return y + 18, parts


def shorten(name: str, most: int = 26) -> str:
    return name if len(name) <= most else f"{name[: most // 2 - 1]}…{name[-(most - most // 2) :]}"
