"""The workspace: two views of the tip positions, coloured by an error or another length."""

from dataclasses import dataclass

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.report import svg
from armcal.report.numbers import count, decimals_for, fixed, plural, significant
from armcal.report.svg import Axis, Box, Figure
from armcal.run.result import RunResult

MOST_POINTS = 4000
"""More positions than this are thinned out."""
_MOST_VECTORS = 500
_COLOURS = ("#9bd93c", "#4ac16d", "#1fa187", "#277f8e", "#365c8d", "#46327e", "#440154")
"""Light to dark, distinct with any colour vision."""
_STEPS = (1, 1.5, 2, 2.5, 3, 4, 5, 6, 8, 10, 20)
_NAMES = "xyz"


@dataclass(frozen=True)
class Coloured:
    """What colours the tip positions.

    Attributes:
        key: of the figures on the page.
        numbers: one a record (N).
        unit: theirs.
        name: of one of them.
        vectors: lines from the positions (3 x N; mm), if they are to be drawn.
    """

    key: str
    numbers: Array
    unit: str
    name: str
    vectors: Array | None = None


def views(result: RunResult) -> list[Figure]:
    errors = result.errors
    return _views(
        result, Coloured("workspace", errors.calibrated_mm, errors.unit, "calibrated error", _vectors(result))
    )


def moved_views(result: RunResult) -> list[Figure]:
    """The same of how far a pose residual moves the tip; empty where none was learned."""
    moved = result.pose_residual and result.pose_residual.moved
    if not moved:
        return []
    return _views(result, Coloured("pose-residual", 1000 * moved.altogether, "mm", "shift by the pose residual"))


def _views(result: RunResult, what: Coloured) -> list[Figure]:
    position = result.errors.position_mm
    if position.shape[0] < 3:
        return []
    known = np.flatnonzero(np.isfinite(what.numbers) & np.isfinite(position[:3]).all(axis=0))
    if not len(known):
        return []
    chosen = known
    if len(known) > MOST_POINTS:  # evenly through the recorded order, and the worst in any case
        worst = known[np.argsort(-what.numbers[known], kind="stable")[:50]]
        even = known[np.linspace(0, len(known) - 1, MOST_POINTS - 50).astype(np.intp)]
        chosen = np.unique(np.concatenate([even, worst]))
    chosen = chosen[np.argsort(what.numbers[chosen], kind="stable")]
    return [_view(position, what, chosen, len(known), axes) for axes in ((0, 1), (0, 2))]


def _vectors(result: RunResult) -> Array | None:
    """Residual vectors, where the residual is one measured position."""
    residual = result.errors.calibrated_residual_mm
    if result.errors.unit != "mm":
        return None
    ends = [name.removesuffix(".x") for name in result.dataset.channels if name.endswith(".x")]
    positions = [p for p in ends if result.dataset.has(f"{p}.y") and result.dataset.has(f"{p}.z")]
    return residual if residual.shape[0] == 3 and len(positions) == 1 else None


def _view(position: Array, what: Coloured, chosen: Indices, total: int, axes: tuple[int, int]) -> Figure:
    shown = position[list(axes)][:, chosen]
    across, up = (_NAMES[i] for i in axes)
    numbers, unit = what.numbers[chosen], what.unit
    vectors = what.vectors[:, chosen] if what.vectors is not None and len(chosen) <= _MOST_VECTORS else None
    if vectors is not None and not np.isfinite(vectors).all():
        vectors = None
    step = svg.nice_step(float(np.percentile(numbers, 98)) / len(_COLOURS), _STEPS)
    enlarged = _enlargement(shown, vectors)
    caption = f"Predicted tip positions; the darker, the larger the {what.name}."
    if enlarged:
        caption += f" Lines: residuals, {significant(enlarged, 1)} times enlarged."
    if len(chosen) < total:
        caption += f" {count(len(chosen))} of {count(total)} drawn, evenly chosen, the 50 worst among them."
    said = (
        f"{plural(len(chosen), 'tip position')} seen along {({'xy': 'z', 'xz': 'y'})[across + up]}; the largest "
        f"{what.name}, {significant(float(numbers[-1]))} {unit}, "
        f"at {across} {shown[0, -1]:.0f}, {up} {shown[1, -1]:.0f} mm."
    )

    def draw(width: float) -> tuple[float, list[str]]:
        box, x, y = _equal_axes(shown, width)
        parts = svg.frame(box, x, y, (f"{across}, mm", f"{up}, mm"), (5, 6))
        if vectors is not None and enlarged:
            tips = shown + enlarged * vectors[list(axes)]
            parts.append(svg.segments(x.at(shown[0]), y.at(shown[1]), x.at(tips[0]), y.at(tips[1]), "vector"))
        level = np.minimum((numbers / step).astype(int), len(_COLOURS) - 1)
        css = "dot" if len(chosen) <= 1000 else "dot small"
        for number, colour in enumerate(_COLOURS):
            here = level == number
            parts.append(svg.dots(x.at(shown[0, here]), y.at(shown[1, here]), css, colour))
        parts += _colour_key(box, step, f"{what.name}, {unit}")
        return box.bottom + 104, parts

    title = "Workspace from above (x, y)" if up == "y" else "Workspace from the side (x, z)"
    return svg.both(f"{what.key}-{across}{up}", (title, said, caption), draw, svg.HALF)


def _enlargement(shown: Array, vectors: Array | None) -> float:
    if vectors is None:
        return 0.0
    long = float(np.percentile(np.linalg.norm(vectors, axis=0), 95))
    extent = float(np.ptp(shown, axis=1).max())
    return svg.nice_step(extent / 15 / long / 2) if long > 0 and extent > 0 else 0.0


def _equal_axes(shown: Array, width: float) -> tuple[Box, Axis, Axis]:
    middle = (shown.max(axis=1) + shown.min(axis=1)) / 2
    extent = np.maximum(np.ptp(shown, axis=1) * 1.08, 10.0)
    left, right, top, tallest = 58.0, width - 16, 10.0, width * 0.86
    scale = min((right - left) / extent[0], tallest / extent[1])
    height = max(extent[1] * scale, 0.35 * width)
    box = Box(left, top, right, top + height)
    half = np.array([right - left, height]) / scale / 2
    x = Axis(float(middle[0] - half[0]), float(middle[0] + half[0]), box.left, box.right)
    return box, x, Axis(float(middle[1] - half[1]), float(middle[1] + half[1]), box.bottom, box.top)


def _colour_key(box: Box, step: float, words: str) -> list[str]:
    width = min((box.right - box.left) / len(_COLOURS), 44.0)
    left = (box.left + box.right - width * len(_COLOURS)) / 2
    y = box.bottom + 50
    parts = [svg.rect(left + i * width, y, width, 10, colour) for i, colour in enumerate(_COLOURS)]
    decimals = decimals_for(step, 2 if round(step / 10 ** np.floor(np.log10(step)), 6) % 1 else 1)
    for i in range(len(_COLOURS)):
        parts.append(svg.text(left + i * width, y + 24, fixed(i * step, decimals), "tick", "middle"))
    return [*parts, svg.text((box.left + box.right) / 2, y + 44, f"{words}; the darkest: and more", "tick", "middle")]
