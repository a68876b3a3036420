"""The arm that is judged, and the reader of its records: from a configuration, or from a calibration."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Self

from armcal.base.parameters import Parameters
from armcal.calibration.calibration import Calibration
from armcal.config.system import System
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.errors import ConfigError, Location
from armcal.measure.measurement import Measurement
from armcal.plugins import PluginRegistry
from armcal.run.experiment import Experiment, with_data

from armcal_capability.subject import examined_arm

CSV = {"type": "csv"}


@dataclass(frozen=True)
class ArmToJudge:
    """One arm as described, and as calibrated.

    Attributes:
        name: of the file that describes it.
        system: with the arm, and the one measurement that is judged.
        models: parameters by ``nominal`` and, from a calibration, ``calibrated``; free are those without a prior.
        source: with the section ``data``, which says how records are read.
        columns: what the calibration's data called its columns.
        trained_on: the hash of the data that the calibration comes from; empty where there is none.
        files: that were read, for provenance.
    """

    name: str
    system: System
    models: Mapping[str, Parameters]
    source: ConfigSource
    columns: Mapping[str, str] = field(default_factory=dict)
    trained_on: str = ""
    files: tuple[Path, ...] = ()

    @property
    def measurement(self) -> tuple[str, Measurement]:
        return next(iter(self.system.measurements.items()))

    @classmethod
    def load(
        cls,
        path: Path,
        settings: Path | None,
        overrides: Sequence[str],
        records: Path,
        registry: PluginRegistry,
        accept: bool = False,
    ) -> Self:
        """From a calibration or a configuration; ``settings`` is one whose section ``data`` is taken instead.

        Raises:
            ConfigError: a file is refused, there are several arms, or no measurement reads positions of a target.
            PluginError: a component is missing or broken.
        """
        given = load_config(path)
        rules = None if settings is None else load_config(settings, overrides)
        if "armcal_calibration" in given.data:
            calibration = Calibration.load(path, registry, accept)
            source = with_data(rules or replace(given, data={**given.data, "data": dict(CSV)}), records)
            record, kept = calibration.record, calibration.record.prediction
            free = {e.name.partition("[")[0] for e in record.parameters if e.free and not e.held_by_prior}
            fitted = calibration.parameters.with_free(free)
            models = {"nominal": calibration.nominal.with_free(free), "calibrated": fitted}
            system = calibration.system
            columns = dict(kept.columns) if kept and rules is None else {}
            files, trained_on = _files(path, source), record.identity.get("data", "")
            return cls(path.name, _judged(system, path), models, source, columns, trained_on, files)
        experiment = Experiment.load(path, overrides if rules is None else (), records, registry)
        source = with_data(rules, records) if rules else experiment.source
        free = {b.name for b in experiment.parameters.free if b.prior_sd is None and not b.nuisance}
        models = {"nominal": experiment.parameters.with_free(free)}
        return cls(path.name, _judged(experiment.system, path), models, source, files=_files(path, source))


def _files(path: Path, source: ConfigSource) -> tuple[Path, ...]:
    return tuple(dict.fromkeys((path, *map(Path, source.files))))


def _judged(system: System, path: Path) -> System:
    """With the measurement that reads positions of a target on the only arm."""
    examined_arm(system, str(path))
    chosen = {name: m for name, m in system.measurements.items() if {c.name for c in m.channels()}.issuperset("xyz")}
    if not chosen:
        raise ConfigError(
            f"found {', '.join(system.measurements) or 'no measurement'}, expected one that reads positions.",
            where=Location(str(path)),
            hint="Add a measurement tip_position or tip_pose: accuracy is judged by measured poses.",
        )
    first = next(iter(chosen))
    return replace(system, measurements={first: chosen[first]})
