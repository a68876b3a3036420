"""Whether a calibration is used with the physics that it was made with: components, and predictions at check poses.

The check poses are the protection: they are predicted again whenever a calibration is loaded. Versions and sources
explain what they find.
"""

import hashlib
import sys
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from armcal import plugins
from armcal.arm import assembly
from armcal.arm.assembly import command_channels
from armcal.arm.statics import LOAD_CHANNELS, Environment
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.settings import Settings
from armcal.calibration.intervals import PlusMinus
from armcal.calibration.tool_expression import poses_of
from armcal.config.system import System
from armcal.errors import Location, PluginError
from armcal.measure.groups import PairedMeasurement
from armcal.measure.instrument import ArmsAlone
from armcal.measure.measurement import Measurement
from armcal.measure.reader import requested_channels
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.version import __version__

SHARE = 0.05  # Of a stated half width or radius: predictions that moved by more are not those of the calibration
UNSTATED_M = 1e-5  # The same where no accuracy of the tool is stated: below what any tracker can resolve
CHECK_POSES = 8


class ComponentRecord(Settings):
    """A component that a calibration is made of, and the code behind it: ``source`` is a hash of its package."""

    kind: str
    name: str
    plugin: str
    distribution: str
    version: str
    source: str


class CheckRecord(Settings):
    """Predictions at some recorded commands (SI, a row a record) with all parameters at ``values``.

    Channels of instruments by name, with the least half width of their 90 % intervals; base_T_tool by arm, its upper
    three rows one after another, with the least 95 % radius of a position.
    """

    channels: tuple[str, ...]
    records: tuple[tuple[float, ...], ...]
    values: tuple[float, ...]
    predicted: dict[str, tuple[float, ...]]
    tools: dict[str, tuple[tuple[float, ...], ...]]
    half_widths: dict[str, float]
    radius: float | None = None

    @property
    def commands(self) -> Dataset:
        return Dataset.of_rows(self.channels, self.records, "the check poses")


def readable(system: System) -> Mapping[str, Measurement]:
    """The measurements whose readings a single pose has: a contact reads nothing."""
    measurements = system.measurements.items()
    return {name: m for name, m in measurements if m.channels() and not isinstance(m, PairedMeasurement)}


def predict(system: System, parameters: Parameters, commands: Dataset) -> tuple[dict[str, Array], Array]:
    """What instruments would read (SI, N each by channel) and base_T_tool (arms x N x 4 x 4), in elastic equilibrium.

    Raises:
        NotConvergedError: a record has no equilibrium.
    """
    fixed = parameters.with_free(())
    measurements, names = dict(readable(system)), tuple(system.arms)
    if tuple(next((m.arms for m in measurements.values()), ())) != names:  # the first shows where tools are
        measurements = {"_arms": ArmsAlone(names), **measurements}
    parts = (system.arms, measurements, fixed, system.environment, commands)
    problem = Problem.build(*parts, "interpreted", groups={})
    shown = problem.predict(fixed.nominal())
    return problem.by_channel(shown), poses_of(shown[0].tools)


def components(system: System, registry: PluginRegistry) -> tuple[ComponentRecord, ...]:
    """What a system is made of, armcal's own mechanics first."""
    plugins = {(plugin.name, plugin.module): plugin for plugin in registry.plugins}
    core = ComponentRecord(
        kind="core",
        name="arm",
        plugin="armcal",
        distribution="armcal",
        version=__version__,
        source=_source(assembly.__name__),
    )
    records, used = {("core", "arm"): core}, list[tuple[str, str]]()
    for arm in system.description["arms"].values():
        used.append(("model", arm["model"]["type"]))
        used += [("effect", effect["type"]) for effect in arm.get("effects", {}).values()]
    used += [("measurement", measurement["type"]) for measurement in system.description["measurements"].values()]
    for kind, name in used:
        component = registry.find(kind, name)
        plugin = plugins[component.plugin, component.module]
        records[kind, name] = ComponentRecord(
            kind=kind,
            name=name,
            plugin=plugin.name,
            distribution=plugin.distribution,
            version=plugin.version,
            source=_source(component.target.partition(":")[0]),
        )
    return tuple(records.values())


def require_present(kept: tuple[ComponentRecord, ...], registry: PluginRegistry, where: Location) -> None:
    """Raise PluginError for the first component that no plugin offers."""
    offered = {(component.kind, component.name) for component in registry.components} | {("core", "arm")}
    for record in kept:
        if (record.kind, record.name) not in offered:
            given = f"{record.distribution or record.plugin} {record.version}".strip()
            is_file = record.distribution.endswith(".py")
            raise PluginError(
                f"it was made with the {record.kind} {record.name!r} of the plugin{' file' if is_file else ''} "
                f"{given}, which is not loaded.",
                where=where,
                hint=f"Give that file: --plugin {record.distribution}." if is_file else "Install that plugin.",
            )


def differences(kept: tuple[ComponentRecord, ...], now: tuple[ComponentRecord, ...]) -> list[str]:
    """What is another than it was, a phrase each: versions, and sources of the same version."""
    texts: dict[str, None] = {}
    present = {(record.kind, record.name): record for record in now}
    for old in kept:
        new = present.get((old.kind, old.name))
        if new is None or new == old:
            continue
        if (old.distribution, old.version) != (new.distribution, new.version):
            texts[f"{_release(old)}, now {_release(new)}"] = None
        elif old.kind == "core":
            texts[f"the mechanics of {_release(old)}, now with another source"] = None
        else:
            texts[f"the {old.kind} {old.name} of {_release(old)}, now with another source"] = None
    return list(texts)


def check_poses(system: System, dataset: Dataset, candidates: Indices) -> Dataset | None:
    """Some of the candidates (rows of a dataset) as commands; None where no record has all joints."""
    names = {requested.channel for requested in requested_channels(system.arms, {}, measured=False)} & set(
        dataset.channels
    )
    joints = tuple(command_channels(system.arms))
    if not set(joints) <= names:
        return None
    known = np.asarray(np.isfinite(dataset.stacked(joints)).all(axis=0))
    rows = np.array([row for row in candidates if known[row]], dtype=np.intp)
    if not len(rows):
        return None
    rows = rows[np.unique(np.linspace(0, len(rows) - 1, CHECK_POSES).round().astype(int))]
    chosen = {name: dataset.column(name)[rows] for name in dataset.channels if name in names}
    finite = {name: column for name, column in chosen.items() if np.isfinite(column).all()}
    return Dataset(tuple(str(row + 1) for row in rows), finite)


def check_record(system: System, parameters: Parameters, commands: Dataset, stated: PlusMinus | None) -> CheckRecord:
    """Predictions with the parameters at their nominal values, and what is stated about their accuracy.

    Raises:
        NotConvergedError: a record has no equilibrium.
    """
    channels, tools = predict(system, parameters, commands)
    widths = {} if stated is None else {n: float(np.min(w)) for n, w in stated.half_widths.items()}
    radii = [] if stated is None else [float(np.min(radius)) for radius in stated.radii.values()]
    names = tuple(commands.channels)
    return CheckRecord(
        channels=names,
        records=tuple(tuple(row) for row in commands.stacked(names).T.tolist()),
        values=tuple(parameters.nominal().tolist()),
        predicted={name: tuple(row.tolist()) for name, row in channels.items() if np.isfinite(row).all()},
        tools={
            name: tuple(tuple(pose[:3].ravel().tolist()) for pose in poses)
            for name, poses in zip(system.arms, tools, strict=True)
        },
        half_widths={name: width for name, width in widths.items() if np.isfinite(width) and width > 0},
        radius=min((radius for radius in radii if np.isfinite(radius) and radius > 0), default=None),
    )


def under_load(kept: CheckRecord, environment: Environment) -> CheckRecord:
    """The same, its commands with the payload that they were predicted with: it may be stated otherwise from now on."""
    stated = zip(LOAD_CHANNELS, environment.acting, strict=True)
    silent = {c: value for c, value in stated if c.startswith("payload") and c not in kept.channels}
    records = tuple((*record, *silent.values()) for record in kept.records)
    return kept.model_copy(update={"channels": (*kept.channels, *silent), "records": records})


def movement(system: System, parameters: Parameters, kept: CheckRecord) -> tuple[float, float, str]:
    """How far predictions at the check poses are from those that are kept.

    The farthest that a tool moved (m), or a point 1 m from it by its rotation; the largest movement of a channel or
    tool, in units of what is stated for it; and the name of that channel or arm.

    Raises:
        NotConvergedError: a record has no equilibrium now.
        ValueError: what is kept does not fit the system.
    """
    channels, tools = predict(system, parameters.with_nominal(np.array(kept.values)), kept.commands)
    shares, tool_m = {}, 0.0
    for name, poses in zip(system.arms, tools, strict=True):
        before = np.array(kept.tools.get(name, ()), dtype=float).reshape(len(poses), 3, 4)
        apart = float(np.linalg.norm(poses[:, :3] - before, axis=1).max())
        shares[name] = apart / (UNSTATED_M / SHARE if kept.radius is None else kept.radius)
        tool_m = max(tool_m, apart)
    for name, width in kept.half_widths.items():
        if name in kept.predicted:
            after = channels.get(name, np.full(len(kept.records), np.nan))
            shares[name] = float(np.abs(after - kept.predicted[name]).max()) / width
    worst = max(shares, key=lambda name: np.inf if np.isnan(shares[name]) else shares[name])
    return tool_m, float(np.nan_to_num(shares[worst], nan=np.inf)), worst


def _source(module: str) -> str:
    """A hash of the source files of a module's package, or of the module alone; empty where they cannot be read."""
    loaded = sys.modules.get(module)
    file = getattr(loaded, "__file__", None)
    if not file:
        return ""
    path, digest = Path(file), hashlib.sha256()
    try:
        packaged = getattr(loaded, "__package__", "") not in ("", plugins.__name__)
        for module_file in sorted(path.parent.glob("*.py")) if packaged else [path]:
            digest.update(f"{module_file.name}\0".encode() + module_file.read_bytes() + b"\0")
    except OSError:
        return ""
    return digest.hexdigest()[:16]


def _release(component: ComponentRecord) -> str:
    if component.distribution:
        return f"{component.distribution} {component.version}"
    return f"the plugin {component.plugin}"
