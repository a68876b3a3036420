"""Correlations with a few poses: squared exponentials of the chords between joint angles. [Rasmussen2006]"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from armcal.base.domains import Array
from armcal.base.settings import Settings
from pydantic import Field
from scipy.linalg import solve_triangular

from armcal_residual.linear import Numbers, PartSettings, Positive

Kind = Literal["angle", "length", "approach"]
_JITTER = 1e-8


class Input(Settings):
    """A number that a process depends on: of which ``joint`` (from 1), and its length ``scale``."""

    of: Kind
    joint: Annotated[int, Field(ge=1)]
    scale: Positive


class TermSettings(Settings):
    """Features of a process: what they depend on, and its poses (M x inputs)."""

    inputs: tuple[Input, ...]
    poses: Numbers


class ProcessSettings(PartSettings):
    """A process of one term, or the sum of several."""

    terms: Annotated[tuple[TermSettings, ...], Field(min_length=1)]


@dataclass(frozen=True)
class Correlations:
    """With poses, as the exponential of a linear function of cosines, sines, numbers and their squares."""

    inputs: tuple[Input, ...]
    middle: Array
    matrix: Array
    constant: Array

    @classmethod
    def of(cls, inputs: Sequence[Input], poses: Array) -> Correlations:
        """With poses (inputs x M)."""
        columns, middle, constant = [], poses.mean(axis=1), np.zeros(poses.shape[1])
        for own, pose, centre in zip(inputs, poses, middle, strict=True):
            weight = own.scale**-2
            if own.of == "angle":
                columns += [weight * np.cos(pose), weight * np.sin(pose)]
                constant -= weight
            else:
                columns += [weight * (pose - centre), np.full_like(pose, -weight / 2)]
                constant -= weight * (pose - centre) ** 2 / 2
        return cls(tuple(inputs), middle, np.column_stack(columns), constant)

    def __call__(self, commands: Any, approaches: Any) -> Any:
        """Of expressions (M x 1), or of arrays (M x N)."""
        symbolic, rows = isinstance(commands, ca.SX), []
        for own, centre in zip(self.inputs, self.middle, strict=True):
            number = (approaches if own.of == "approach" else commands)[own.joint - 1]
            if own.of == "angle":
                rows += [ca.cos(number), ca.sin(number)] if symbolic else [np.cos(number), np.sin(number)]
            else:
                rows += [number - centre, (number - centre) ** 2]
        if symbolic:
            return ca.exp(ca.mtimes(ca.DM(self.matrix), ca.vertcat(*rows)) + ca.DM(self.constant))
        return np.exp(self.matrix @ np.array(rows) + self.constant[:, None])


def roots_of(correlations: Array) -> Array:
    """R with R R' the inverse of correlations between poses (M x M): features times R have independent weights."""
    lower = np.linalg.cholesky(correlations + _JITTER * np.eye(len(correlations)))
    return np.asarray(solve_triangular(lower, np.eye(len(lower)), lower=True).T)
