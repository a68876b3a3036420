"""Measurements: factor types. Each says what one record constrains, as a residual in physical units."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression


@dataclass(frozen=True)
class Channel:
    """One measured number: its local name (``x``) and dimension (``length``, ``angle``, ``dimensionless``)."""

    name: str
    dimension: str


class Measurement(Protocol):
    """What a plugin provides to describe an instrument or a contact.

    Parameters have local names; the framework puts the instance before them (``tracker.target_x``).
    """

    @property
    def arms(self) -> tuple[str, ...]:
        """The instance names of the arms that take part."""

    def parameters(self) -> Sequence[ParameterBlock]:
        """Parameters of the instrument itself."""

    def channels(self) -> Sequence[Channel]:
        """The measured numbers it reads from a record."""

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        """What each channel would read without noise; empty for a contact that reads nothing."""

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """Measured minus predicted, or what a contact leaves open (n x 1, m or rad)."""

    def noise(self) -> Sequence[float]:
        """Standard deviation of each entry of the residual (m or rad)."""


@runtime_checkable
class RecordNoise(Protocol):
    """What a measurement may provide beside the rest: where a record says its own noise."""

    def noise_channels(self) -> Sequence[Sequence[Channel]]:
        """Of each entry of the residual, the channels that may carry its standard deviation, the nearest first."""


def noise_channels(measurement: Measurement) -> tuple[tuple[Channel, ...], ...]:
    """Of each entry of the residual; empty if the measurement takes no noise from records."""
    if not isinstance(measurement, RecordNoise):
        return ()
    return tuple(tuple(own) for own in measurement.noise_channels())
