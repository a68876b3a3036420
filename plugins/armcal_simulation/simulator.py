"""An arm with a stated truth: poses, command quantisation, noise and outliers from a fixed seed.

The recorded command is the one asked for; the arm stands at the nearest one its servo board can make.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.settings import Angle, InputPath, Length, Settings
from armcal.config.selection import with_values
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError
from armcal.estimate.simulation import SimulationRequest, measured_without_noise, with_channels
from armcal.testing import EXAMPLE_TRUTH
from pydantic import Field, model_validator

from armcal_simulation.motions import approach_of
from armcal_simulation.outliers import OutlierSettings, with_outliers
from armcal_simulation.readings import disturbed, is_orientation


class PoseSettings(Settings):
    """Which poses are visited.

    ``grid``: ``count`` distinct combinations of each joint's ``levels``, in lexicographic order as a grid is
    driven. ``random``: ``count`` poses uniform between the smallest and largest level of each joint. The levels of
    sliding joints stand under ``travel``.
    """

    kind: Literal["grid", "random"] = "grid"
    count: Annotated[int, Field(ge=1)]
    levels: dict[str, Annotated[tuple[Angle, ...], Field(min_length=1)]] = Field(default_factory=dict)
    travel: dict[str, Annotated[tuple[Length, ...], Field(min_length=1)]] = Field(default_factory=dict)

    def of(self, arm: Arm) -> list[Array]:
        """The levels of each joint, in the arm's order (rad, or m on sliding joints).

        Raises:
            ConfigError: a joint has none, or a name is not a joint's.
        """
        turning = {j for j, kind in arm.commanded.items() if kind == "angle"}
        sliding = set(arm.commanded) - turning
        for given, texts, key in ((self.levels, turning, "levels"), (self.travel, sliding, "travel")):
            missing, unknown = sorted(texts - set(given)), sorted(set(given) - texts)
            if missing or unknown:
                raise ConfigError(
                    f"simulation.poses.{key}: missing {missing or 'none'}, unknown {unknown or 'none'}.",
                    hint=f"Give one list for each of {', '.join(sorted(texts)) or 'no joint'}.",
                )
        return [np.array(self.levels.get(j) or self.travel[j]) for j in arm.commanded]


class ElasticArmSettings(Settings):
    """The truth and how it is measured; ``noise`` defaults to what each measurement declares."""

    truth: InputPath
    poses: PoseSettings
    seed: Annotated[int, Field(ge=0)] = 0
    noise: Length | None = None
    quantisation: Angle = 0.0
    outliers: OutlierSettings = Field(default_factory=OutlierSettings)

    @model_validator(mode="after")
    def _sane(self) -> ElasticArmSettings:
        if (self.noise or 0) < 0 or self.quantisation < 0:
            raise ValueError("found a negative noise or quantisation, expected 0 or more")
        return self


class ElasticArmSimulator:
    """The simulator ``elastic_arm``."""

    Settings: ClassVar[type[ElasticArmSettings]] = ElasticArmSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "truth": str(EXAMPLE_TRUTH),
        "poses": {"count": 20, "levels_deg": {"q1": [-60, -20, 20, 60], "q2": [-90, -45, 0, 45, 90]}},
        "seed": 1,
        "quantisation_deg": 0.2,
        "outliers": {"fraction": 0.1},
    }

    def __init__(self, settings: ElasticArmSettings) -> None:
        self._settings = settings

    def simulate(self, request: SimulationRequest) -> Dataset:
        """Records of the first arm's joints in random or grid poses.

        Raises:
            ConfigError: the truth names unknown parameters, or a joint has no levels.
        """
        settings, random = self._settings, np.random.default_rng(self._settings.seed)
        arm = next(iter(request.arms.values()))
        commands = _poses(settings.poses, settings.poses.of(arm), random)
        reached, step = commands.copy(), settings.quantisation
        if step:
            turning = [dimension == "angle" for dimension in arm.commanded.values()]
            reached[turning] = np.round(commands[turning] / step) * step
        named = [f"{arm.name}.{joint}" for joint in arm.commanded]
        approach = approach_of(commands)
        channels = {f"{arm.name}.approach.{j}": approach[i] for i, j in enumerate(arm.commanded)}
        standing = Dataset(
            tuple(str(i) for i in range(1, commands.shape[1] + 1)),
            {**dict(zip(named, reached, strict=True)), **channels},
            source="simulation",
        )
        measured = self._measured(request, standing, random)
        return with_channels(standing, {**dict(zip(named, commands, strict=True)), **measured})

    def _measured(
        self, request: SimulationRequest, standing: Dataset, random: np.random.Generator
    ) -> Mapping[str, Array]:
        true = _with_truth(request, self._settings)
        exact = measured_without_noise(true, standing)
        read = disturbed(true, standing, exact, self._settings.noise, random)
        moved = {channel: values for channel, values in read.items() if not is_orientation(channel)}
        return {**read, **with_outliers(moved, self._settings.outliers, random)[0]}


def _poses(poses: PoseSettings, levels: list[Array], random: np.random.Generator) -> Array:
    """Commands (joints x poses, rad or m)."""
    if poses.kind == "random":
        return np.array([random.uniform(level.min(), level.max(), poses.count) for level in levels])
    total = int(np.prod([len(level) for level in levels]))
    if poses.count > total:
        raise ConfigError(
            f"simulation.poses.count: found {poses.count}, the grid has {total} poses.",
            hint="Give more levels.",
        )
    chosen = np.sort(random.choice(total, poses.count, replace=False))
    indices = np.unravel_index(chosen, [len(level) for level in levels])
    return np.array([level[index] for level, index in zip(levels, indices, strict=True)])


def _with_truth(request: SimulationRequest, settings: ElasticArmSettings) -> SimulationRequest:
    source = load_config(settings.truth)
    parameters = with_values(request.parameters, source.data, source, ())
    return SimulationRequest(request.arms, request.measurements, parameters, request.environment)
