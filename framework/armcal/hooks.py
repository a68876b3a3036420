"""The plugin contract: hook specifications and their version. Imports nothing heavy, so registration is instant.

A plugin is a Python module named by an entry point in the group ``armcal``. It registers named components as
``module:attribute``; a component is imported when a configuration asks for it. ``docs/tools/hooks_page.py`` makes
``docs/hooks.md`` of this file.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, Protocol

import pluggy

PROJECT = "armcal"

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


class Register(Protocol):
    """What registration hooks are handed."""

    def __call__(self, name: str, target: str | type, summary: str = "") -> None:
        """Announce a component.

        Args:
            name: what a configuration calls it (``type: NAME``).
            target: ``module:attribute`` of its class, which is imported when a configuration asks for it; or the class.
            summary: one line for ``armcal plugins list``.
        """


class Command(Protocol):
    """A ``click.Command``, made by ``@click.command()``.

    What it raises as an ``ArmcalError`` becomes one message and an exit code. It imports what it needs when it runs, so
    that ``armcal --help`` stays instant.
    """


@dataclass(frozen=True)
class ComponentKind:
    """One kind of component.

    Attributes:
        hook: that registers it.
        built_as: how armcal builds it.
        protocol: ``module:class`` of what it must have.
        beside: ``module:class`` of what it may have.
    """

    hook: str
    built_as: str
    protocol: str
    beside: tuple[str, ...] = ()


@hookspec
def armcal_register_models(register: Register) -> None:
    """Arm models: the chain of joints, as an expression of its parameters."""


@hookspec
def armcal_register_effects(register: Register) -> None:
    """Joint effects: what stands between the commanded and the real displacement of a joint."""


@hookspec
def armcal_register_residuals(register: Register) -> None:
    """Pose residuals: what the physical model leaves of a tool's pose, learned from records."""


@hookspec
def armcal_register_measurements(register: Register) -> None:
    """Measurements: what an instrument or a contact says of the arm in one record, or in two."""


@hookspec
def armcal_register_readers(register: Register) -> None:
    """Readers: datasets from files."""


@hookspec
def armcal_register_estimators(register: Register) -> None:
    """Batch estimators: all records at once."""


@hookspec
def armcal_register_online_estimators(register: Register) -> None:
    """Online estimators: one record at a time."""


@hookspec
def armcal_register_simulators(register: Register) -> None:
    """Simulators: datasets from a stated truth."""


@hookspec
def armcal_register_exporters(register: Register) -> None:
    """Exporters: a calibrated arm as a file of another program."""


@hookspec
def armcal_register_links(register: Register) -> None:
    """Links: what carries bytes to a servo board."""


@hookspec
def armcal_register_devices(register: Register) -> None:
    """Devices: what moves joints, over a link."""


@hookspec
def armcal_register_trackers(register: Register) -> None:
    """Live trackers: where bodies are, frame by frame."""


@hookspec
def armcal_register_joint_streams(register: Register) -> None:
    """Live joint readings of arms that are guided by hand."""


@hookspec
def armcal_register_cameras(register: Register) -> None:
    """Live cameras: what they see while an arm stands."""


@hookspec
def armcal_register_benches(register: Register) -> None:
    """Simulated benches: what stands in for board, arm and tracker in a rehearsal."""


@hookspec
def armcal_register_commands(register: Register) -> None:
    """Commands: what ``armcal NAME`` runs, a click command that is imported when it is called."""


@hookspec
def armcal_register_report_sections(register: Register) -> None:
    """Report sections: what a plugin adds to ``report.html`` of each run."""


@hookspec
def armcal_run_started(name: str, records: int) -> None:
    """A calibration run begins.

    Args:
        name: of the experiment.
        records: how many records it begins with.
    """


@hookspec
def armcal_record_rejected(row: int, record_id: str, reason: str) -> None:
    """A record was set aside.

    Args:
        row: where it stood in its source (from 1; the line of a CSV file).
        record_id: as written in the source.
        reason: in words.
    """


@hookspec
def armcal_estimate_changed(estimate: Any) -> None:
    """An estimator came to a new estimate.

    Args:
        estimate: an ``armcal.estimate.estimator.Estimate``.
    """


@hookspec
def armcal_run_ended(name: str, folder: str, converged: bool) -> None:
    """A calibration run has written its results.

    Args:
        name: of the experiment.
        folder: where the results are.
        converged: whether the solver did.
    """


def _kind(hook: str, built_as: str, protocol: str, *beside: str) -> ComponentKind:
    contracts = [f"armcal.{target}" for target in (protocol, *beside)]
    return ComponentKind(f"armcal_register_{hook}", built_as, contracts[0], tuple(contracts[1:]))


_KINDS = {
    "model": _kind("models", "Model(settings)", "arm.model:ArmModel", "arm.assembly:MassiveModel"),
    "effect": _kind("effects", "Effect(settings, joint_names)", "arm.effects:JointEffect", "arm.servo:SteppedEffect"),
    "residual": _kind("residuals", "Residual(settings, joint_names)", "arm.pose_residual:PoseResidual"),
    "measurement": _kind(
        "measurements",
        "Measurement(settings, arm_names)",
        "measure.measurement:Measurement",
        "measure.instrument:Instrument",
        *(f"measure.measurement:{name}" for name in ("RecordNoise", "DimensionedResidual", "GroupedMeasurement")),
        "measure.measurement:NamesGroups",
        "measure.groups:PairedMeasurement",
    ),
    "reader": _kind("readers", "Reader(settings)", "measure.reader:Reader"),
    "estimator": _kind(
        "estimators",
        "Estimator(settings)",
        *(f"estimate.estimator:{name}" for name in ("Estimator", "SpreadableEstimator")),
    ),
    "online": _kind("online_estimators", "Estimator(settings)", "estimate.online:OnlineEstimator"),
    "simulator": _kind("simulators", "Simulator(settings)", "estimate.simulation:Simulator"),
    "exporter": _kind("exporters", "Exporter(settings)", "calibration.exporter:Exporter"),
    "link": _kind("links", "Link(settings)", "devices.link:Link", "devices.link:GuardedLink"),
    "device": _kind(
        "devices",
        "Device(settings, joint_names, link or None)",
        *(f"devices.device:{name}" for name in ("JointDevice", "PulseDevice", "MeasuringDevice")),
    ),
    "tracker": _kind("trackers", "Tracker(settings)", "devices.live:Tracker"),
    "joints": _kind("joint_streams", "Stream(settings)", "devices.live:JointStream", "devices.live:RestStream"),
    "camera": _kind("cameras", "Camera(settings)", "devices.live:LiveCamera"),
    "bench": _kind("benches", "Bench(settings)", "devices.simulated:SimulatedBench"),
    "command": _kind("commands", "Command", "hooks:Command"),
    "report_section": _kind("report_sections", "Section(result)", "report.sections:SectionMaker"),
}
COMPONENTS: Mapping[str, ComponentKind] = MappingProxyType(_KINDS)
"""The kinds of component."""

KINDS: Mapping[str, str] = MappingProxyType({kind: component.hook for kind, component in COMPONENTS.items()})
"""The kinds of component and the hook that registers each."""
