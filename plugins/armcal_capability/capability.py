"""``armcal capability``: an arm or designs of it, and areas cell by cell.

Whether the tool reaches them, turned how, held by the servos, and how far it sags there.

Each cell's centre is searched for from the nearest of many postures (``armcal.calibration.inverse``).
"""

from __future__ import annotations

import math
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import casadi as ca
import click
import numpy as np
from armcal.arm.assembly import Arm, only_arm
from armcal.arm.clearance import ClearanceCheck
from armcal.arm.joints import by_dimension, joint_limits, unknown_joint
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.config_text import as_json
from armcal.base.parameters import Parameters
from armcal.base.settings import Angle, Force3, InputPath, Length, Length3, Mass, Settings, Torque
from armcal.calibration.calibration import Calibration
from armcal.calibration.inverse import Aim, Goal, Manner, Solver
from armcal.calibration.tool_expression import Equilibrium, ToolExpression, arm_expression
from armcal.cli.common import Console, command_line, overrides, speaking
from armcal.config.selection import with_values
from armcal.config.system import System, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config, load_variants
from armcal.errors import ConfigError, Location, ProblemError
from armcal.functions.batch_function import BatchFunction, EvaluatorChoice
from armcal.io.plain_files import reserved
from armcal.measure.tables import csv_text
from armcal.plugins import PluginRegistry
from armcal.report.document import Document, Section, Table
from armcal.report.numbers import count
from armcal.run.experiment import PlanSettings, clearance_check
from numpy.typing import NDArray
from pydantic import Field, model_validator

SECTION = "capability"
_RULES = (SECTION, "plan")
_MEND = "Write for example set: {arms.arm.model.rows.1.d_mm: 10}; entries of a list count from 0."
ORIENTATIONS = np.vstack([np.eye(3), -np.eye(3)])
"""Directions of the base frame that the tool's axis points along, for the score."""
MOST_IN_AREA = 500_000  # cells of an area: each is searched for
_WORTH_COMPILING = 20_000
"""From this many postures on, waiting for the compiler costs less than CasADi's interpreter does."""
_LENGTH = 0.1  # metres that a radian counts for, where a tool's place and direction are taken together
_ARRIVED = (1e-5, 5e-4)  # m, rad
_MANNER = Manner(damping=1e-2, patience=12, steps=60)  # few starts a cell: each is followed for longer
_INSIDE = 1e-3  # rad: how far inside the required cone the tool is brought
_ROUND = 4  # starts at once, where one way to reach a cell is enough
_LANES, _MM = 8, 1000.0
_FORCE = "force_x"


class ToolDirectionSettings(Settings):
    """An axis of the tool points ``along`` a direction of the base frame, up to an angle."""

    axis: Literal["x", "y", "z"] = "z"
    along: tuple[float, float, float]
    within: Annotated[Angle, Field(gt=0, le=3.15)]

    @model_validator(mode="after")
    def _has_direction(self) -> Self:
        if not any(self.along):
            raise ValueError("along is zero: give a direction, such as [0, 0, -1] for down")
        return self


class AreaSettings(Settings):
    """A box along the axes of the base frame, between two corners, that the tool is to reach."""

    low: Length3
    high: Length3
    tool: ToolDirectionSettings | None = None

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        if any(low > high for low, high in zip(self.low, self.high, strict=True)):
            raise ValueError("low lies beyond high on an axis: give the smaller coordinates as low")
        return self


class LoadSettings(Settings):
    """What the arm carries at its tool, where it differs from the configured ``statics``."""

    payload: Annotated[Mass, Field(ge=0)] | None = None
    payload_com: Length3 | None = None
    force: Force3 | None = None


class CapabilitySettings(Settings):
    """The section ``capability`` of a configuration."""

    areas: Annotated[dict[str, AreaSettings], Field(min_length=1)]
    voxel: Annotated[Length, Field(gt=0)] = 0.02  # side of an area's cells
    samples: Annotated[int, Field(ge=8, le=20_000_000)] = 50_000  # postures from which searches start
    seed: Annotated[int, Field(ge=0)] = 0
    postures: Annotated[int, Field(ge=1, le=1000)] = 8  # sought for each cell
    orientation_within: Annotated[Angle, Field(gt=0, le=0.8)] = float(np.radians(30))
    loads: LoadSettings = Field(default_factory=LoadSettings)
    holding: dict[str, Annotated[Torque, Field(gt=0)]] = Field(default_factory=dict)  # of servos, by joint
    values: InputPath | None = None  # a calibration, or values of the arm that values_of describes
    values_of: InputPath | None = None
    designs: dict[str, dict[str, Any] | None] = Field(default_factory=dict)


@dataclass(frozen=True)
class Design:
    expression: ToolExpression
    limits: Array  # of its commands (joints x 2; rad or m)
    clearance: ClearanceCheck | None


@dataclass(frozen=True)
class Task:
    settings: CapabilitySettings
    designs: Mapping[str, Design]


@dataclass(frozen=True)
class Corrections:
    stated: Parameters
    corrected: Parameters

    @classmethod
    def read(cls, path: Path, described: ConfigSource, registry: PluginRegistry) -> Self:
        """From a calibration, which knows what was stated; or from values of a described arm."""
        given = load_config(path)
        if "armcal_calibration" not in given.data:
            stated = build_system(described, registry).parameters()
            return cls(stated, with_values(stated, given.data, given, ()))
        calibration = Calibration.load(path, registry)
        return cls(calibration.nominal, calibration.parameters)

    def applied(self, design: Parameters) -> Parameters:
        """A design's parameters with the same differences from what the design states."""
        blocks = {}
        shared = set(design.names) & set(self.stated.names)
        if not shared:
            raise ConfigError(
                "the values are of an arm that has no parameter in common with this one.",
                hint="Give a calibration, or values, of the same arm: its parameters must be called the same.",
            )
        for name in shared:
            block, before, after = design[name], self.stated[name], self.corrected[name]
            if block.nominal == before.nominal:
                blocks[name] = replace(block, nominal=after.nominal)
            elif block.size == before.size:
                moved = block.domain.local(np.array(before.nominal), np.array(after.nominal))
                there = block.domain.retract(np.array(block.nominal), moved)
                blocks[name] = replace(block, nominal=tuple(float(x) for x in there))
        return design.replaced(blocks)


def load_task(path: Path, rules: Path | None, overrides: Sequence[str], registry: PluginRegistry) -> Task:
    """A calibration or a configuration, with ``capability`` and ``plan`` of another file (``rules``) if given."""
    given = load_config(path)
    is_calibration, config = "armcal_calibration" in given.data, load_config(rules or path, overrides)
    if not (config.data.get(SECTION) or {}).get("areas"):
        raise ConfigError(
            "found no areas, expected boxes that the tool is to reach.",
            where=Location(str(config.path), field=f"{SECTION}.areas"),
            hint="Give capability: {areas: {table: {low_mm: [200, -100, 0], high_mm: [400, 100, 100]}}}, in the "
            "configuration or by --settings FILE.",
        )
    settings = validate(CapabilitySettings, config, (SECTION,))
    base = _with_rules(load_config(path) if rules else config, config)
    corrections: Corrections | None = None
    if is_calibration:
        corrections = Corrections.read(path, config, registry)
    elif settings.values is not None:
        described = base if settings.values_of is None else load_config(settings.values_of)
        corrections = Corrections.read(settings.values, described, registry)
    if not settings.designs and is_calibration:
        calibration = Calibration.load(path, registry)
        arm = examined_arm(calibration.system, path)
        alone = Design(calibration.expression(), *_limits(arm, calibration.system, config, path))
        return Task(settings, {path.name: alone})
    if not settings.designs:
        return Task(settings, {path.name: _design(base, registry, path, corrections)})
    if "arms" not in config.data:
        raise ConfigError(
            "it lists designs and describes no arm.",
            where=Location(str(config.path)),
            hint="Write extends: ARM.yaml in it, with the arm that the designs are of.",
        )
    designs = {}
    for name, source in load_variants(config.path, overrides, listed=(SECTION, "designs"))[1].items():
        try:
            for key in set(source.data) - set(config.data):
                source.refuse((key,), f"found {key!r}, expected the dotted name of a value of the arm.", _MEND)
            designs[name] = _design(_with_rules(source, config), registry, path, corrections)
        except ConfigError as fault:
            raise ConfigError(f"design {name!r}: {fault.message}", where=fault.where, hint=fault.hint) from fault
    return Task(settings, designs)


def examined_arm(system: System, path: Path) -> Arm:
    hint = "Describe the arm to be examined alone."
    return only_arm(system.arms, "a single arm is examined", hint, Location(str(path)))


def _design(source: ConfigSource, registry: PluginRegistry, path: Path, corrections: Corrections | None) -> Design:
    system = build_system(source, registry)
    arm, parameters = examined_arm(system, path), system.parameters()
    if corrections is not None:
        parameters = corrections.applied(parameters)
    return Design(arm_expression(arm, parameters, system.environment), *_limits(arm, system, source, path))


def _limits(arm: Arm, system: System, source: ConfigSource, path: Path) -> tuple[Array, ClearanceCheck | None]:
    settings, check = PlanSettings(), None
    if source.data.get("plan") is not None:
        settings = validate(PlanSettings, source, ("plan",))
    if settings.clearance is not None:
        check = clearance_check(settings.clearance, system.arms, source)
    stated = by_dimension(arm.commanded, settings.limits, settings.travel_limits, where=Location(str(path)))
    limits = joint_limits(arm.nominal_chain, stated)
    if missing := [joint for joint, span in limits.items() if span is None]:
        raise ConfigError(
            f"found no limits for {', '.join(missing)}.",
            where=Location(str(path)),
            hint="Give plan: {limits: {q1: [-100 deg, 100 deg], ...}}, in the configuration or by --settings FILE.",
        )
    return np.array([list(span) for span in limits.values() if span is not None]), check


def _with_rules(source: ConfigSource, rules: ConfigSource) -> ConfigSource:
    data = {**source.data, **{key: rules.data[key] for key in _RULES if key in rules.data}}
    marks = {**source.marks, **{place: at for place, at in rules.marks.items() if place and place[0] in _RULES}}
    return replace(source, data=data, marks=marks)


@dataclass(frozen=True)
class Mechanics:
    """A loaded arm in elastic equilibrium at N commands."""

    positions: Array  # of the tool (3 x N; m, base frame)
    rotations: Array  # base_R_tool (3 x 3 x N)
    efforts: Array  # about or along the axes of all joints (joints x N; N m, N)
    states: Array  # deflections (n_d x N)
    settled: Mask  # whether there is an equilibrium (N)


class MechanicsFunction:
    """``Mechanics`` of one arm under one load, for commands (n x N)."""

    def __init__(self, expression: ToolExpression, load: LoadSettings, choice: EvaluatorChoice = "auto") -> None:
        self._channels, self._joints = expression.channels, len(expression.joints)
        self._record = expression.defaults.copy()
        for channel, stated in (("payload", load.payload), ("payload_x", load.payload_com), (_FORCE, load.force)):
            if stated is not None:
                start, values = self._channels.index(channel), np.atleast_1d(stated)
                self._record[start : start + len(values)] = values
        self._equilibrium = Equilibrium(expression, choice)
        inputs, efforts = [expression.record, expression.state], [ca.densify(expression.efforts)]
        function = ca.Function("capability", inputs, efforts, {"cse": True})
        sample = [
            self.records(np.linspace(-1, 1, _LANES) * np.ones((self._joints, 1))),
            np.zeros((expression.state.numel(), _LANES)),
        ]
        self._efforts = BatchFunction(function, sample, choice)

    def __call__(self, commands: Array, states: Array | None = None) -> Mechanics:
        """``states`` are where the search for an equilibrium begins."""
        record = self.records(commands)
        standing = self._equilibrium(record, states)
        tools, settled = standing.base_T_tool, np.asarray(standing.settled, dtype=bool)
        (efforts,) = self._efforts(record, standing.states)
        return Mechanics(tools[:, :3, 3].T, tools[:, :3, :3].transpose(1, 2, 0), efforts, standing.states, settled)

    def tools(self, commands: Array) -> tuple[Array, Mask]:
        standing = self._equilibrium(self.records(commands))
        return standing.base_T_tool, np.asarray(standing.settled, dtype=bool)

    def place(self, commands: Array, idle: tuple[str, ...], states: Array | None = None) -> Array:
        """Where the tool is if nothing acts through some channels of the load (3 x N; m)."""
        record = self.records(commands)
        record[[self._channels.index(channel) for channel in idle]] = 0.0
        return np.asarray(self._equilibrium(record, states).base_T_tool[:, :3, 3].T)

    def records(self, commands: Array) -> Array:
        record = np.repeat(self._record[:, None], commands.shape[1], axis=1)
        record[: self._joints] = commands
        return record


@dataclass(frozen=True)
class Pointing:
    """Where an axis of the tool (0 to 2) is to point: a unit vector of the base frame, and how near (rad)."""

    axis: int
    along: Array
    within: float

    @classmethod
    def of(cls, settings: ToolDirectionSettings) -> Pointing:
        along = np.array(settings.along, dtype=float)
        return cls("xyz".index(settings.axis), along / np.linalg.norm(along), settings.within)

    def angles(self, rotations: Array) -> Array:
        axis = rotations[:, self.axis]
        across = np.linalg.norm(np.cross(axis.T, self.along), axis=1)
        return np.asarray(np.arctan2(across, axis.T @ self.along))


@dataclass(frozen=True)
class AreaMap:
    centres: Array  # cells x 3; m, base frame
    counts: NDArray[np.int64]  # postures found that bring the tool to the centre
    orientations: NDArray[np.int64]  # along how many of ORIENTATIONS the tool's axis can point there
    held: Mask | None  # whether in one posture no servo carries more than it holds; None where that is not stated
    values: Mapping[str, Array]  # by quantity, mean of the postures; not a number where there is none

    @property
    def reached(self) -> Mask:
        return np.asarray(self.counts > 0)


@dataclass(frozen=True)
class Survey:
    drawn: int  # postures
    clear: int  # of which keep their clearance
    settled: int  # of which have an elastic equilibrium
    areas: Mapping[str, AreaMap]


def survey(design: Design, settings: CapabilitySettings) -> Survey:
    for name, area in settings.areas.items():
        cells = float(np.prod(np.ceil(np.subtract(area.high, area.low) / settings.voxel)))
        _require(
            cells <= MOST_IN_AREA,
            f"the area {name} would have {cells:.3g} cells, expected {MOST_IN_AREA} at most.",
            "Make capability.voxel_mm larger, or the area smaller; check their units.",
        )
    search = AreaSearch(design, settings, "compiled" if settings.samples >= _WORTH_COMPILING else "interpreted")
    areas = {name: search(area) for name, area in settings.areas.items()}
    return Survey(settings.samples, search.clear, len(search.positions), areas)


def cells_of(area: AreaSettings, size: float) -> Array:
    """Centres of equal cells that fill a box, none longer than ``size`` (cells x 3; m)."""
    low, high = np.array(area.low), np.array(area.high)
    numbers = np.maximum(np.ceil((high - low) / size - 1e-9), 1).astype(int)
    axes = [low[i] + (np.arange(n) + 0.5) * (high[i] - low[i]) / n for i, n in enumerate(numbers)]
    return np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)


def spread(limits: Array, count: int, seed: int) -> Array:
    """By a scrambled Sobol sequence (joints x count): more begin with the same ones, a seed gives the same again."""
    from scipy.stats import qmc

    drawn = qmc.Sobol(len(limits), rng=seed).random_base2(max(0, math.ceil(math.log2(count))))[:count]
    return (limits[:, 0] + drawn * (limits[:, 1] - limits[:, 0])).T.copy()


def quantities(function: MechanicsFunction, commands: Array, mechanics: Mechanics, holding: Array) -> dict[str, Array]:
    """Sag by the arm's own weight, how much further the load moves the tool, and the largest share of ``holding``."""
    unloaded = function.place(commands, ("payload", _FORCE, "force_y", "force_z"), mechanics.states)
    values = {
        "sag_mm": np.linalg.norm(unloaded - function.place(commands, LOAD_CHANNELS), axis=0) * _MM,
        "deflection_mm": np.linalg.norm(mechanics.positions - unloaded, axis=0) * _MM,
    }
    if np.isfinite(holding).any():
        values["effort_ratio"] = np.max(np.abs(mechanics.efforts) / holding[:, None], axis=0)
    return values


class AreaSearch:
    def __init__(self, design: Design, settings: CapabilitySettings, choice: EvaluatorChoice = "auto") -> None:
        self._design, self._settings = design, settings
        names = design.expression.arm.joint_names
        if fault := unknown_joint(settings.holding, names):
            raise ConfigError(f"holding: {fault}.")
        self._holding = np.array([settings.holding.get(name, np.inf) for name in names])
        self.function = MechanicsFunction(design.expression, settings.loads, choice)
        self.solvers = solvers_of(design, choice)
        commands = spread(design.limits, settings.samples, settings.seed)
        commands = commands[:, self._allowed(commands)]
        self.clear = commands.shape[1]
        text = f"none of {settings.samples} postures keeps its clearance."
        _require(self.clear > 0, text, "Check plan.clearance.")
        tools, settled = self.function.tools(commands)
        _require(
            bool(settled.any()),
            "no posture has an elastic equilibrium under the load.",
            "Check the payload and the force, their units, and the compliances.",
        )
        self._commands, tools = commands[:, settled], tools[settled]
        self.positions, self._rotations = tools[:, :3, 3], tools[:, :3, :3].transpose(1, 2, 0)

    def __call__(self, area: AreaSettings) -> AreaMap:
        centres = cells_of(area, self._settings.voxel)
        pointing = Pointing.of(area.tool) if area.tool is not None else None
        cell, commands = self._found(centres, self._nearest(centres, pointing), pointing)
        mechanics = self.function(commands)
        cell, settled = cell[mechanics.settled], mechanics.settled
        counts = np.bincount(cell, minlength=len(centres)).astype(np.int64)
        values, held = {}, None
        for name, value in quantities(self.function, commands, mechanics, self._holding).items():
            total = np.bincount(cell, weights=value[settled], minlength=len(centres))
            values[name] = np.divide(total, counts, out=np.full(len(centres), np.nan), where=counts > 0)
            if name == "effort_ratio":
                held = np.zeros(len(centres), dtype=bool)
                held[cell[value[settled] <= 1]] = True
        axis = "xyz".index(area.tool.axis) if area.tool is not None else 2
        return AreaMap(centres, counts, self._orientations(centres, axis), held, values)

    def _orientations(self, centres: Array, axis: int) -> NDArray[np.int64]:
        """Along how many of six directions the tool's axis can point at each centre."""
        count = np.zeros(len(centres), dtype=np.int64)
        for along in ORIENTATIONS:
            pointing = Pointing(axis, along, self._settings.orientation_within)
            nearest, remaining = self._nearest(centres, pointing), np.arange(len(centres))
            for start in range(0, nearest.shape[1], _ROUND):
                cell, _ = self._found(centres[remaining], nearest[remaining, start : start + _ROUND], pointing)
                reached = np.unique(cell)
                count[remaining[reached]] += 1
                remaining = np.delete(remaining, reached)
                if not len(remaining):
                    break
        return count

    def _nearest(self, centres: Array, pointing: Pointing | None) -> Indices:
        """The sampled postures nearest to each centre, the nearest first (cells x postures)."""
        from scipy.spatial import cKDTree

        where, targets = self.positions, centres
        if pointing is not None:
            away = np.maximum(pointing.angles(self._rotations) - pointing.within, 0.0) * _LENGTH
            where, targets = np.column_stack([where, away]), np.column_stack([centres, np.zeros(len(centres))])
        most = min(self._settings.postures, len(where))
        return np.asarray(cKDTree(where).query(targets, k=most)[1]).reshape(len(centres), most)

    def _found(self, centres: Array, starts: Indices, pointing: Pointing | None) -> tuple[Indices, Array]:
        cell = np.repeat(np.arange(len(centres)), starts.shape[1])
        commands = np.asarray(self._commands[:, starts.reshape(-1)])
        commands, arrived = reach_for(self.solvers, self.function.records(commands), centres[cell].T, pointing)
        good = np.flatnonzero(arrived)
        good = good[self._allowed(commands[:, good])] if len(good) else good
        return cell[good], commands[:, good]

    def _allowed(self, commands: Array) -> Mask:
        if self._design.clearance is None:
            return np.ones(commands.shape[1], dtype=bool)
        return self._design.clearance(commands).allowed


Solvers = Mapping[bool, Solver]  # for positions; and (True) with a direction of the tool


def solvers_of(design: Design, choice: EvaluatorChoice) -> Solvers:
    aims: dict[bool, Aim] = {False: "position", True: "direction"}
    parts = (_LENGTH, _ARRIVED, choice)
    return {turns: Solver(design.expression, design.limits, aim, *parts) for turns, aim in aims.items()}


def reach_for(solvers: Solvers, records: Array, targets: Array, pointing: Pointing | None = None) -> tuple[Array, Mask]:
    """Commands within limits that bring the tool to targets (3 x N; m) from those of records; which arrive."""
    if pointing is not None:
        inside = max(pointing.within - _INSIDE, 0.0)
        stated = np.concatenate([pointing.along, np.eye(3)[pointing.axis], [inside]])
        targets = np.concatenate([targets, np.repeat(stated[:, None], targets.shape[1], axis=1)])
    solver = solvers[pointing is not None]
    solutions = solver(Goal(records, np.zeros((solver.states, targets.shape[1])), targets), _MANNER)
    return solutions.commands, solutions.there


def _require(holds: bool, message: str, hint: str) -> None:
    if not holds:
        raise ProblemError(message, hint=hint)


OURS = ("capability.json", "areas.csv")
_MM = 1000.0
_SHORT = {"sag_mm": "Sag, mm", "deflection_mm": "Load, mm", "effort_ratio": "Torque"}
_CAPTION = (
    "Held: by the servos too. Score: tool orientations reached, of six a point, summed over the points. Sag by the "
    "arm's own weight, further deflection by the load, and torque as a share of what servos hold: means over the "
    "points that all designs reach"
)


@click.command()
@click.argument("source", metavar="CALIBRATION|CONFIG", type=click.Path(path_type=Path))
@click.option("--out", required=True, type=click.Path(path_type=Path), help="Where the results go.")
@click.option(
    "--settings", type=click.Path(path_type=Path), help="A configuration whose sections capability and plan to take."
)
@overrides
@speaking
def capability(console: Console, source: Path, out: Path, settings: Path | None, overrides: tuple[str, ...]) -> None:
    """Survey what an arm can do in areas: what it reaches and holds, how far it sags; designs of it by one score."""
    began = time.perf_counter()
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    task = load_task(source, settings, overrides, console.registry())
    surveys: dict[str, Survey] = {}
    with console.progress() as progress:
        for i, (name, design) in enumerate(task.designs.items()):
            progress("designs", i / len(task.designs))
            surveys[name] = survey(design, task.settings)
    designs, rules = summaries(surveys), task.settings
    content = {"source": str(source), "cell_mm": rules.voxel * _MM, "loads": rules.loads.to_config()}
    content |= {"samples": rules.samples, "seed": rules.seed, "holding_Nm": dict(rules.holding), "designs": designs}
    kept.place(
        {
            "areas.csv": _areas_text(surveys),
            "capability.json": as_json({"command": command_line(), **content}) + "\n",
        }
    )
    best = max(designs, key=lambda name: designs[name]["score"])
    has = f"{best} has the most, " if len(designs) > 1 else ""
    score = f"{count(designs[best]['score'])} of {count(designs[best]['most'])}"
    headline = f"Score, points times tool orientations reached: {has}{score}."
    areas = Section("Areas", parts=[_table(designs)], level="always")
    console.show(Document(f"Capability of {source.name}", headline, [areas], data=content), folder=str(out))
    console.line(f"results: {out}  ({time.perf_counter() - began:.1f} s)")


def summaries(surveys: Mapping[str, Survey]) -> dict[str, dict[str, Any]]:
    content: dict[str, dict[str, Any]] = {}
    for design, own in surveys.items():
        areas = dict[str, dict[str, Any]]()
        for name, area in own.areas.items():
            among = np.all([other.areas[name].reached for other in surveys.values()], axis=0)
            known = {q: means[among] if among.any() else np.array([np.nan]) for q, means in area.values.items()}
            areas[name] = {
                "cells": len(area.counts),
                "cells_compared": int(np.sum(among)),
                "reached": float(np.mean(area.reached)),
                "held": None if area.held is None else float(np.mean(area.held)),
                "orientations": int(np.sum(area.orientations)),
                "postures_per_cell": float(np.mean(area.counts)),
                "quantities": {
                    q: {"mean": float(np.mean(means)), "p95": float(np.percentile(means, 95))}
                    for q, means in known.items()
                },
            }
        content[design] = {
            "postures": {"drawn": own.drawn, "clear": own.clear, "in_equilibrium": own.settled},
            "score": sum(area["orientations"] for area in areas.values()),
            "most": len(ORIENTATIONS) * sum(area["cells"] for area in areas.values()),
            "areas": areas,
        }
    return content


def _table(designs: Mapping[str, Mapping[str, Any]]) -> Table:
    """A row an area, and one for the score of several areas; the name of a design stands in its first row."""
    areas = list(next(iter(designs.values()))["areas"].values())
    is_held, shown = areas[0]["held"] is not None, [name for name in _SHORT if name in areas[0]["quantities"]]
    rows = []
    for design, own in designs.items():
        for number, (name, area) in enumerate(own["areas"].items()):
            row = [design if number == 0 else "", name, _share(area["reached"]), _share(area["held"])]
            row += [count(area["orientations"]), *(_number(area["quantities"][q]["mean"]) for q in shown)]
            rows.append(row)
        if len(areas) > 1:
            rows.append(["", "total", "", "", count(own["score"]), *([""] * len(shown))])
    headings = ["Design", "Area", "Reached", "Held", "Score", *(_SHORT[name] for name in shown)]
    kept = [i for i in range(len(headings)) if (i or len(designs) > 1) and (is_held or i != 3)]
    return Table(_CAPTION, [headings[i] for i in kept], [[row[i] for i in kept] for row in rows], left=("Area",))


def _areas_text(surveys: Mapping[str, Survey]) -> str:
    headings: list[str] = []
    rows: list[tuple[Any, ...]] = []
    for design, own in surveys.items():
        for name, area in own.areas.items():
            columns = dict(zip(("x_mm", "y_mm", "z_mm"), (area.centres * _MM).T, strict=True))
            columns |= {"postures": area.counts, "orientations": area.orientations}
            columns |= ({} if area.held is None else {"held": area.held.astype(int)}) | dict(area.values)
            headings = headings or ["design", "area", *columns]
            rows += [(design, name, *row) for row in zip(*(c.tolist() for c in columns.values()), strict=True)]
    return csv_text([headings, *rows], ".6g")


def _number(value: float) -> str:
    return "-" if not np.isfinite(value) else f"{value:.3g}" if abs(value) < 1000 else f"{value:.0f}"


def _share(value: float | None) -> str:
    return "-" if value is None else f"{100 * value:.1f} %"
