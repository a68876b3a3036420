"""How warm the servos get while they are calibrated, and when they have to rest."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from armcal.base.domains import Array
from armcal.devices.clock import Clock

from armcal_bench.acquisition.heat import HeatModel, Torques

_ENOUGH = 0.8
"""Of the budget: one more point warms a servo by less than the rest of it."""
_COOLED_TO = 0.5


class ThermalState:
    """Followed from cold on, or from where another run left it.

    Args:
        heat: the servos' model, and the torques that heat them.
        joints: in the arm's order.
        base: where the servos rest (rad by joint; others at zero).
        clock: the bench's.
    """

    def __init__(
        self, heat: tuple[HeatModel, Torques], joints: tuple[str, ...], base: Mapping[str, float], clock: Clock
    ) -> None:
        (self._model, self._torques), self._joints, self._clock = heat, joints, clock
        self._state, self._since = self._model.cold, clock.now()
        self._base = self._pose(base)

    def go_on(self, before: Mapping[str, Sequence[float]], standing: Mapping[str, float], seconds: float) -> None:
        """From another run's warmth (winding and case, by joint), after which joints stood at angles (rad) for so long.

        Joints that are not among these angles hang free, and cool.
        """
        self._state = np.array([before.get(joint, (0.0, 0.0)) for joint in self._joints], dtype=float)
        held = np.array([joint in standing for joint in self._joints])
        self._state = self._model.after(self._state, self._torques(self._pose(standing)) * held, max(seconds, 0.0))

    @property
    def by_joint(self) -> dict[str, list[float]]:
        """Of winding and case, by joint."""
        return dict(zip(self._joints, self._state.tolist(), strict=True))

    def pass_to_now(self, angles: Mapping[str, float]) -> None:
        """The servos have stood at these angles (rad) since the last call."""
        now = self._clock.now()
        self._state = self._model.after(self._state, self._torques(self._pose(angles)), now - self._since)
        self._since = now

    @property
    def must_rest(self) -> bool:
        """Whether a servo is near its budget."""
        return bool(np.any(self._model.heat(self._state) > _ENOUGH * self._model.budget))

    @property
    def rest_s(self) -> float:
        """How long to rest in the base pose; infinite where that pose is itself too heavy."""
        return self._model.cooled_in(self._state, self._torques(self._base), _COOLED_TO * self._model.budget)

    @property
    def base_is_too_heavy(self) -> str:
        """The joint that would not cool in the base pose; empty if all do."""
        hot = self._model.too_hot_for_ever(self._torques(self._base), _COOLED_TO)
        return "" if hot is None else self._joints[hot]

    def _pose(self, angles: Mapping[str, float]) -> Array:
        return np.array([angles.get(joint, 0.0) for joint in self._joints])
