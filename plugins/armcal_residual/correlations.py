"""Correlations with a few poses: squared exponentials of the chords between joint angles. [Rasmussen2006]"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Annotated, Any, Literal

import casadi as ca
import numpy as np
from armcal.arm.pose_residual import SURROUNDINGS
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from pydantic import Field
from scipy.linalg import solve_triangular

from armcal_residual.linear import Numbers, Positive

Kind = Literal["angle", "length", "approach", "payload", "temperature"]
_JITTER = 1e-8


class Input(Settings):
    """A number that a process depends on: of which ``joint`` (from 1; 0: of none), and its length ``scale``."""

    of: Kind
    joint: Annotated[int, Field(ge=0)]
    scale: Positive

    def number(self, commands: Any, approaches: Any, surroundings: Mapping[str, Any]) -> Any:
        """From commands and approaches (joints x N each) and those of the surroundings that are known; else None."""
        if self.of in SURROUNDINGS:
            return surroundings.get(self.of)
        return (approaches if self.of == "approach" else commands)[self.joint - 1]


class TermSettings(Settings):
    """Features of a process: what they depend on, its poses (M x inputs), and its ``share`` of the whole variance."""

    inputs: tuple[Input, ...]
    poses: Numbers
    share: Positive = 1.0


class ProcessSettings(Settings):
    """What was learned of some corrections: a process of one term, or the sum of several, as weights of M features.

    ``first`` is the place of the first of them, one ``scale`` (m or rad) belongs to each. ``weights`` (M x corrections)
    give the corrections; ``root`` (M x r) their variances: scale^2 times the features' prior variance less the squared
    length of ``root``'s product with them. ``between`` is the mean share of the variance that features left to the
    records that taught it, which stood between its poses. These showed it, so that it is in the noise.
    """

    first: Annotated[int, Field(ge=0)]
    scales: Annotated[tuple[Positive, ...], Field(min_length=1)]
    weights: Numbers
    root: Numbers
    terms: Annotated[tuple[TermSettings, ...], Field(min_length=1)]
    between: Annotated[float, Field(ge=0, le=1)] = 0.0


@dataclass(frozen=True)
class Correlations:
    """With poses, as the exponential of a linear function of cosines, sines, numbers and their squares."""

    inputs: tuple[Input, ...]
    middle: Array
    matrix: Array
    constant: Array

    @classmethod
    def of(cls, inputs: Sequence[Input], poses: Array) -> Correlations:
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

    def __call__(self, commands: Any, approaches: Any, surroundings: Mapping[str, Any]) -> Any:
        """Of expressions (M x 1), or of arrays (M x N). What is not known of the surroundings is in the middle."""
        numbers = [own.number(commands, approaches, surroundings) for own in self.inputs]
        middle = (centre + 0 * commands[0] for centre in self.middle)
        return self.at([own if number is None else number for number, own in zip(numbers, middle, strict=True)])

    def at(self, numbers: Sequence[Any]) -> Any:
        """Of what the inputs are, expressions (M x 1), or arrays (M x N)."""
        symbolic, rows = isinstance(numbers[0], ca.SX), []
        for own, centre, number in zip(self.inputs, self.middle, numbers, strict=True):
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


def share_between(features: Array) -> float:
    """Mean share of a process's variance that independent features (N x M) leave."""
    return float(np.clip(1 - np.mean(np.sum(features**2, axis=1)), 0.0, 1.0))
