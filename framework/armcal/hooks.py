"""The plugin contract: hook specifications and their version. Imports nothing heavy, so registration is instant.

A plugin is a Python module named by an entry point in the group ``armcal``. It registers named components as
``module:attribute``; a component is imported when a configuration asks for it. ``docs/tools/hooks_page.py`` makes
``docs/hooks.md`` of this file.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
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
    """One kind of component."""

    hook: str  # that registers it
    built_as: str  # how armcal builds it
    protocol: str  # ``module:class`` of what it must have
    beside: tuple[str, ...] = ()  # ``module:class`` of what it may have


REGISTRATIONS = {
    "armcal_register_models": "Arm models: the chain of joints, as an expression of its parameters.",
    "armcal_register_effects": "Joint effects: what stands between a joint's commanded and real displacement.",
    "armcal_register_residuals": "Pose residuals: what the model leaves of a tool's pose, learned from records.",
    "armcal_register_measurements": "Measurements: what an instrument or a contact reads in one record, or in two.",
    "armcal_register_readers": "Readers: datasets from files.",
    "armcal_register_estimators": "Batch estimators: all records at once.",
    "armcal_register_online_estimators": "Online estimators: one record at a time.",
    "armcal_register_simulators": "Simulators: datasets from a stated truth.",
    "armcal_register_exporters": "Exporters: a calibrated arm as a file of another program.",
    "armcal_register_links": "Links: what carries bytes to a servo board.",
    "armcal_register_devices": "Devices: what moves joints, over a link.",
    "armcal_register_trackers": "Live trackers: where bodies are, frame by frame.",
    "armcal_register_joint_streams": "Live joint readings of arms that are guided by hand.",
    "armcal_register_cameras": "Live cameras: what they see while an arm stands.",
    "armcal_register_benches": "Simulated benches: what stands in for board, arm and tracker in a rehearsal.",
    "armcal_register_checks": "Checks: what a plugin asks of the data or of a fit, and says in the verdict.",
    "armcal_register_commands": "Commands: what ``armcal NAME`` runs, a click command, imported when it is called.",
    "armcal_register_report_sections": "Report sections: what a plugin adds to ``report.html`` of each run.",
}
"""The hooks that register components, ``def HOOK(register: Register) -> None``, and what each announces."""


def _specified(hook: str, announced: str) -> Callable[[Register], None]:
    def specification(register: Register) -> None: ...

    specification.__name__ = specification.__qualname__ = hook
    specification.__doc__ = announced
    return hookspec(specification)


globals().update({hook: _specified(hook, announced) for hook, announced in REGISTRATIONS.items()})


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
        "measure.measurement:Instrument",
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
    "joints": _kind("joint_streams", "Stream(settings)", "devices.live:JointStream"),
    "camera": _kind("cameras", "Camera(settings)", "devices.live:LiveCamera"),
    "bench": _kind("benches", "Bench(settings)", "devices.simulated:SimulatedBench"),
    "check": _kind("checks", "check(fit)", "diagnose.checks:CheckFunction"),
    "command": _kind("commands", "Command", "hooks:Command"),
    "report_section": _kind("report_sections", "Section(result)", "report.run_document:SectionMaker"),
}
COMPONENTS: Mapping[str, ComponentKind] = MappingProxyType(_KINDS)
KINDS: Mapping[str, str] = MappingProxyType({kind: component.hook for kind, component in COMPONENTS.items()})
