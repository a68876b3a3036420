"""Rigid Denavit-Hartenberg chains in plain numpy: an independent forward model that shares no code with armcal.

A chain is written as data: ``base``, ``rows`` and ``tool`` with values in SI; parameters go by the names that armcal's
``mdh`` model gives them. The measured point is ``target_x/y/z`` in the tool frame.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Steps = Sequence[tuple[str, float]]


@dataclass(frozen=True)
class Row:
    """One joint; ``after`` are extra elementary transforms."""

    alpha: float = 0.0
    a: float = 0.0
    theta: float = 0.0
    d: float = 0.0
    kind: str = "revolute"
    after: Steps = ()


@dataclass(frozen=True)
class ChainSpec:
    """A chain, its convention and its extra transforms."""

    rows: tuple[Row, ...]
    base: Steps = ()
    tool: Steps = ()
    convention: str = "standard"

    def settings(self) -> dict[str, Any]:
        """The same as settings of the ``mdh`` model, SI."""

        def steps(given: Steps) -> list[dict[str, float]]:
            return [{kind: float(value)} for kind, value in given]

        numbers = ("alpha", "a", "theta", "d")
        rows = [
            {**{n: float(getattr(row, n)) for n in numbers}, "kind": row.kind, "after": steps(row.after)}
            for row in self.rows
        ]
        return {"convention": self.convention, "rows": rows, "base": steps(self.base), "tool": steps(self.tool)}

    def nominal(self) -> dict[str, float]:
        """Every parameter by its local name; the target and effects at zero."""
        values = dict(named("base", self.base))
        for i, row in enumerate(self.rows, start=1):
            values |= {f"{name}{i}": getattr(row, name) for name in ("alpha", "a", "theta", "d")}
            values |= dict(named(f"after{i}", row.after))
        values |= dict(named("tool", self.tool))
        values |= {f"target_{axis}": 0.0 for axis in "xyz"}
        values |= {f"{kind}{i}": 0.0 for kind in ("offset", "gain") for i in range(1, len(self.rows) + 1)}
        return values

    def tip(self, v: Mapping[str, float], q: np.ndarray) -> np.ndarray:
        """The target in the base frame (N x 3) at commands (N x n)."""
        return np.array([self._one(v, row) for row in q])

    def _one(self, v: Mapping[str, float], q: np.ndarray) -> np.ndarray:
        here = _along(v, "base", self.base)
        for i, row in enumerate(self.rows, start=1):
            moved = q[i - 1] * (1 + v[f"gain{i}"]) + v[f"offset{i}"]
            turn, slide = (moved, 0.0) if row.kind == "revolute" else (0.0, moved)
            motion = elementary("rz", v[f"theta{i}"] + turn) @ elementary("z", v[f"d{i}"] + slide)
            link = elementary("x", v[f"a{i}"]) @ elementary("rx", v[f"alpha{i}"])
            here = here @ (motion @ link if self.convention == "standard" else link @ motion)
            here = here @ _along(v, f"after{i}", row.after)
        target = np.array([v["target_x"], v["target_y"], v["target_z"], 1.0])
        return (here @ _along(v, "tool", self.tool) @ target)[:3]


def named(place: str, steps: Steps) -> list[tuple[str, float]]:
    """The steps' parameter names and values; the second of a kind in one place ends in ``_2``."""
    seen: dict[str, int] = {}
    found = []
    for kind, value in steps:
        seen[kind] = seen.get(kind, 0) + 1
        found.append((f"{place}_{kind}" + (f"_{seen[kind]}" if seen[kind] > 1 else ""), value))
    return found


def elementary(kind: str, amount: float) -> np.ndarray:
    """A rotation about (``rx``) or translation along (``x``) an axis (4 x 4)."""
    matrix = np.eye(4)
    axis = "xyz".index(kind[-1])
    if kind.startswith("r"):
        i, j = [(1, 2), (2, 0), (0, 1)][axis]
        matrix[i, i] = matrix[j, j] = np.cos(amount)
        matrix[j, i], matrix[i, j] = np.sin(amount), -np.sin(amount)
    else:
        matrix[axis, 3] = amount
    return matrix


def jacobian(function: Any, values: Mapping[str, float], names: Sequence[str], step: float = 1e-5) -> np.ndarray:
    """d function(values).ravel() / d names by central differences of fourth order."""
    columns = []
    for name in names:
        sides = [np.ravel(function({**values, name: values[name] + k * step})) for k in (1, -1, 2, -2)]
        columns.append((8 * (sides[0] - sides[1]) - (sides[2] - sides[3])) / (12 * step))
    return np.stack(columns, axis=1)


def _along(v: Mapping[str, float], place: str, steps: Steps) -> np.ndarray:
    matrix = np.eye(4)
    for name, (kind, _) in zip([n for n, _ in named(place, steps)], steps, strict=True):
        matrix = matrix @ elementary(kind, v[name])
    return matrix
