"""The plugin contract: hook specifications and their version. Imports nothing heavy, so registration is instant.

A plugin is a Python module named by an entry point in the group ``armcal``. It registers named components as
``module:attribute``; a component is imported when a configuration asks for it.
"""

from __future__ import annotations

from typing import Any, Protocol

import pluggy

PROJECT = "armcal"
CONTRACT_VERSION = "1.3"
"""Version of the plugin contract: the major number changes when an existing plugin would break."""

hookspec = pluggy.HookspecMarker(PROJECT)
hookimpl = pluggy.HookimplMarker(PROJECT)


class Register(Protocol):
    """What registration hooks are handed."""

    def __call__(self, name: str, target: str, summary: str = "") -> None:
        """Announce a component.

        Args:
            name: what a configuration calls it (``type: NAME``).
            target: ``module:attribute`` of its class.
            summary: one line for ``armcal plugins list``.
        """


@hookspec
def armcal_register_models(register: Register) -> None:
    """Arm models: classes built as ``Model(settings)`` that satisfy ``armcal.arm.model.ArmModel``."""


@hookspec
def armcal_register_effects(register: Register) -> None:
    """Joint effects: classes built as ``Effect(settings, joint_names)`` that satisfy ``armcal.arm.effects.JointEffect``."""  # noqa: E501


@hookspec
def armcal_register_measurements(register: Register) -> None:
    """Measurements: built as ``Measurement(settings, arm_names)``; see ``armcal.measure.measurement.Measurement``."""


@hookspec
def armcal_register_readers(register: Register) -> None:
    """Dataset readers: built as ``Reader(settings)``; see ``armcal.measure.reader.Reader``."""


@hookspec
def armcal_register_estimators(register: Register) -> None:
    """Batch estimators: built as ``Estimator(settings)``; see ``armcal.solve.estimator.Estimator``."""


@hookspec
def armcal_register_online_estimators(register: Register) -> None:
    """Online estimators: built as ``Estimator(settings)``; see ``armcal.solve.online.OnlineEstimator``."""


@hookspec
def armcal_register_simulators(register: Register) -> None:
    """Simulators: built as ``Simulator(settings)``; see ``armcal.solve.simulation.Simulator``."""


@hookspec
def armcal_register_exporters(register: Register) -> None:
    """Exporters: built as ``Exporter(settings)``; see ``armcal.use.exporter.Exporter``."""


@hookspec
def armcal_register_links(register: Register) -> None:
    """Links to servo boards: built as ``Link(settings)``; see ``armcal.bench.link.Link``."""


@hookspec
def armcal_register_devices(register: Register) -> None:
    """What moves joints: built as ``Device(settings, joint_names, link)``; see ``armcal.bench.device.JointDevice``."""


@hookspec
def armcal_register_trackers(register: Register) -> None:
    """Live trackers: built as ``Tracker(settings)``; see ``armcal.bench.tracker.Tracker``."""


@hookspec
def armcal_register_joint_streams(register: Register) -> None:
    """Live joint readings: built as ``Stream(settings)``; see ``armcal.bench.joint_stream.JointStream``."""


@hookspec
def armcal_register_benches(register: Register) -> None:
    """Simulated benches: built as ``Bench(settings)``; see ``armcal.bench.simulated.SimulatedBench``."""


@hookspec
def armcal_run_started(name: str, records: int) -> None:
    """A calibration run begins; observers may log it. What they return is ignored."""


@hookspec
def armcal_record_rejected(row: int, record_id: str, reason: str) -> None:
    """A record was set aside."""


@hookspec
def armcal_estimate_changed(estimate: Any) -> None:
    """An estimator came to a new estimate."""


@hookspec
def armcal_run_ended(name: str, folder: str, converged: bool) -> None:
    """A calibration run has written its results."""


KINDS = {
    "model": "armcal_register_models",
    "effect": "armcal_register_effects",
    "measurement": "armcal_register_measurements",
    "reader": "armcal_register_readers",
    "estimator": "armcal_register_estimators",
    "online": "armcal_register_online_estimators",
    "simulator": "armcal_register_simulators",
    "exporter": "armcal_register_exporters",
    "link": "armcal_register_links",
    "device": "armcal_register_devices",
    "tracker": "armcal_register_trackers",
    "joints": "armcal_register_joint_streams",
    "bench": "armcal_register_benches",
}
"""The kinds of component and the hook that registers each."""
