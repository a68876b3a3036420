"""Settings of a mission run: the calibration to begin with, and how the recalibration is judged."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any

import yaml
from armcal.base.config_text import plain
from armcal.base.settings import InputPath, Length, Settings
from armcal.config.validate import validate
from armcal.config.yaml_source import load_config
from armcal.config.yaml_tree import steps_of
from armcal.errors import ConfigError
from armcal.estimate.simulation import MissionSimulator
from armcal.plugins import PluginRegistry, discover
from armcal.run.experiment import Experiment
from pydantic import Field, model_validator

from armcal_online.tracking.settings import SECTION as RECALIBRATE
from armcal_online.tracking.settings import RecalibrateSettings

SECTION = "mission"


class RefitSettings(Settings):
    """Robust fits that the recalibration is compared with: of the last ``records``, anew after ``every`` so many."""

    records: Annotated[int, Field(ge=10, le=1000)] = 40
    every: Annotated[int, Field(ge=1)] = 10


class MissionRunSettings(Settings):
    """The calibration before launch, and the judge.

    ``experiment`` is a configuration whose simulated records are calibrated first; ``calibration`` a file that is
    there already. The judge compares tips in so many random ``poses``, within the span of the records, with the truth;
    the arm can be used while its level is nominal or watch and the mean error is within ``limit``. It has recovered
    from an event when the error is back within ``recovered`` times what it was in the day before. ``refit`` says which
    robust fits of many records at once the recalibration is compared with.
    """

    experiment: InputPath | None = None
    calibration: InputPath | None = None
    limit: Length = 0.003
    poses: Annotated[int, Field(ge=1, le=5000)] = 200
    seed: Annotated[int, Field(ge=0)] = 0
    recovered: Annotated[float, Field(ge=1)] = 1.5
    refit: RefitSettings = Field(default_factory=RefitSettings)

    @model_validator(mode="after")
    def _one_start(self) -> MissionRunSettings:
        if (self.experiment is None) == (self.calibration is None):
            raise ValueError("found both or neither of experiment and calibration, expected one of them")
        if self.limit <= 0:
            raise ValueError(f"found a limit of {1000 * self.limit:g} mm, expected one above zero")
        return self


@dataclass(frozen=True)
class MissionPlan:
    """A mission's configuration, checked and built, before anything is simulated.

    Attributes:
        experiment: the arm, and the simulator.
        simulator: knows the truth.
        settings: of the run.
        recalibrate: settings of the recalibration.
        planted: where events were drawn at random, what differs from the configuration: these, and overrides.
    """

    experiment: Experiment
    simulator: MissionSimulator
    settings: MissionRunSettings
    recalibrate: RecalibrateSettings
    planted: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def surprised(cls, path: Path, seed: int, overrides: Sequence[str], registry: PluginRegistry) -> MissionPlan:
        """Read a mission, with what its simulator draws from a seed in place of the configured events.

        Raises:
            ConfigError: as ``load``, or what is drawn does not fit the configuration.
        """
        stated = load_config(path, overrides).data.get("simulation")
        none = ("simulation.events=[]",) if isinstance(stated, Mapping) and "events" in stated else ()
        bare = cls.load(path, (*overrides, *none), registry)
        drawn = bare.simulator.planted(bare.experiment.simulation_request, seed)
        one_line: dict[str, Any] = {"default_flow_style": True, "sort_keys": False, "width": 1 << 20}
        written = {key: yaml.safe_dump(value, **one_line).strip() for key, value in drawn.items()}
        texts = (*overrides, *(f"simulation.{key}={text}" for key, text in written.items()))
        planted, data = dict[str, Any](), plain(load_config(path, texts).data)
        for steps in (steps_of(text.partition("=")[0].strip()) or () for text in texts):
            section, key = steps[0], steps[1:2]
            if key:
                planted.setdefault(section, {})[key[0]] = data.get(section, {}).get(key[0])
            else:
                planted[section] = data.get(section)
        return replace(cls.load(path, texts, registry), planted=planted)

    @classmethod
    def load(cls, path: Path, overrides: Sequence[str] = (), registry: PluginRegistry | None = None) -> MissionPlan:
        """Read a mission; its sections ``mission`` and ``recalibrate`` are no part of an experiment.

        Raises:
            ConfigError: a section is missing or refused, or the simulator knows no truth over time.
        """
        source = load_config(path, overrides)
        settings = validate(MissionRunSettings, source, (SECTION,))
        stated = RECALIBRATE in source.data
        recalibrate = validate(RecalibrateSettings, source, (RECALIBRATE,)) if stated else RecalibrateSettings()
        rest = {key: value for key, value in source.data.items() if key not in (SECTION, RECALIBRATE)}
        experiment = Experiment.of(replace(source, data=rest), registry=registry or discover())
        simulator = experiment.simulator()
        if not isinstance(simulator, MissionSimulator):
            raise ConfigError(
                "this simulator knows no truth over time.",
                where=source.where(("simulation", "type")),
                hint="Write simulation: {type: mission, ...}.",
            )
        return cls(experiment, simulator, settings, recalibrate)
