"""A few harmonics of each joint's error over its own angle, shrunk as far as the evidence says. [MacKay1992]"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Annotated, Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.effects import JointChoice, chosen
from armcal.arm.pose_residual import OF_TOOL, ModelErrors, reached
from armcal.base.arrays import Array
from pydantic import Field
from typing_extensions import override

from armcal_residual.linear import (
    LearnedSettings,
    LinearResidual,
    PartSettings,
    Products,
    packed,
    regressed,
    seen,
    taken_root,
)

_ROWS_PER_FEATURE = 2


class SeriesSettings(PartSettings):
    """Cosines and sines of ``orders`` times the angle of a ``joint`` (from 1)."""

    joint: Annotated[int, Field(ge=1)]
    orders: Annotated[int, Field(ge=1)]


class FourierSettings(LearnedSettings):
    """Which turning ``joints``, how many ``orders`` of each, and what was learned."""

    joints: JointChoice = "all"
    orders: Annotated[int, Field(ge=1, le=200)] = 3
    learned: tuple[SeriesSettings, ...] = ()


class Fourier(LinearResidual):
    """The pose residual ``fourier``: a periodic error of each joint."""

    Settings: ClassVar[type[FourierSettings]] = FourierSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"orders": 2}
    settings: FourierSettings

    def __init__(self, settings: FourierSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        self._joints = chosen(settings.joints, joint_names)
        self.check()

    @override
    def features(self, part: Any, commands: Any, approaches: Any, surroundings: Mapping[str, Any]) -> Any:
        return _harmonics(commands[part.joint - 1], part.orders)

    @override
    def prior_variance(self, part: Any, features: Array) -> Array:
        return np.sum(features**2, axis=0)

    @override
    def learned(self, errors: ModelErrors) -> Fourier | None:
        commands, orders = errors.postures.commands, self.settings.orders
        turning = [joint - 1 for joint in self._joints if errors.dimensions[joint - 1] == "angle"]
        moved = [i + 1 for i in seen(errors, [i for i in turning if np.ptp(commands[i]) > 0])]
        if not moved or _ROWS_PER_FEATURE * 2 * orders * len(moved) > errors.residuals.size:
            return None
        rows = []
        for joint in moved:
            slopes, harmonics = errors.slopes[:, :, len(OF_TOOL) + joint - 1], _harmonics(commands[joint - 1], orders).T
            rows.append(-(slopes[:, :, None] * harmonics[:, None, :]).reshape(-1, 2 * orders))
        features, left = np.hstack(rows), errors.residuals.ravel()
        fitted = regressed(Products.of(features, left), [2 * orders] * len(moved))
        parts = tuple(
            SeriesSettings(
                first=len(OF_TOOL) + joint - 1,
                scales=(float(np.sqrt(variance)),),
                weights=packed(weights),
                root=packed(taken_root(np.eye(2 * orders), fitted.left_of([i]))),
                joint=joint,
                orders=orders,
            )
            for i, (joint, weights, variance) in enumerate(zip(moved, fitted.weights, fitted.variances, strict=True))
            if fitted.is_known(i)
        )
        if not parts:
            return None
        return Fourier(
            self.settings.model_copy(update={"learned": parts, "within": reached(commands)}), self.joint_names
        )


def _harmonics(angle: Any, orders: int) -> Any:
    """Cosines and sines of multiples of an angle (2 orders x 1, or x N)."""
    if isinstance(angle, ca.SX):
        return ca.vertcat(*[wave(order * angle) for order in range(1, orders + 1) for wave in (ca.cos, ca.sin)])
    return np.array([wave(order * angle) for order in range(1, orders + 1) for wave in (np.cos, np.sin)])
