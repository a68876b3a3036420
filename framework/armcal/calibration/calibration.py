"""A calibration as a file: everything needed to use it, check it and go on from it."""

import math
import re
import warnings
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Self

import numpy as np

from armcal.base.arrays import Array
from armcal.base.config_text import plain
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.se3 import identity
from armcal.calibration.calibration_file import (
    SHARE,
    UNSTATED_M,
    CalibrationFile,
    CheckRecord,
    components,
    differences,
    identity_of,
    lost_calibration,
    movement,
    predict,
    read_record,
    readable,
)
from armcal.calibration.compensation import Commands, Compensator, Options
from armcal.calibration.intervals import PlusMinus, Uncertainty
from armcal.calibration.tool_expression import Point, ToolExpression, arm_expression, tool_point
from armcal.config.system import System, build_system
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import (
    ArmcalError,
    CalibrationWarning,
    ConfigError,
    DataError,
    InputError,
    Location,
    NotConvergedError,
    PluginError,
)
from armcal.estimate.variance import Component
from armcal.measure.measurement import Measurement
from armcal.plugins import PluginRegistry, discover

_OTHER_PHYSICS = (
    "Install the versions that it names, or run the calibration again; to use its values with today's physics in "
    "spite of that: armcal calibration accept FILE."
)


@dataclass(frozen=True)
class Calibration:
    """A calibrated arm."""

    system: System  # arms, measurements and statics
    parameters: Parameters  # all blocks; their nominal values are the calibrated ones
    record: CalibrationFile  # the file's content

    @classmethod
    def load(
        cls,
        path: str | Path,
        registry: PluginRegistry | None = None,
        accept: bool = False,
        content: bytes | None = None,
    ) -> Self:
        """Read a calibration; a ``CalibrationWarning`` for what its user should know of it.

        ``accept``: even one whose recalibration found that it no longer holds; ``content`` is what the file holds,
        where it need not be there.

        Raises:
            ConfigError: not a calibration, of another schema, damaged, changed since it was written, lost, of a bad
                verdict that was not accepted, or made with other physics than that of the plugins that are there now.
            PluginError: it needs a plugin that is not there.
        """
        registry = registry or discover()
        loaded = cls.built(read_record(path, content=content)[0], path, registry)
        if loaded.record.level == "lost" and not accept:
            raise lost_calibration(loaded.record, path)
        for notice in loaded.notices(path, registry):
            warnings.warn(f"the calibration {notice}", CalibrationWarning, stacklevel=2)
        return loaded

    @classmethod
    def built(cls, source: ConfigSource, path: str | Path, registry: PluginRegistry) -> Self:
        """The calibration in a file that was read, whatever its predictions were when it was written."""
        where, record = Location(str(path)), validate(CalibrationFile, source)
        if not record.converged:
            hint = "Run the calibration again with better start values or more data."
            raise ConfigError("the solver did not converge: these values are no calibration.", where=where, hint=hint)
        if not (record.verdict.get("usable", True) or record.verdict.get("accepted", False)):
            hint = "Correct the data or the configuration; or, if you know better, run again with --accept."
            raise ConfigError(f"its verdict is bad: {record.verdict['findings'][0]}", where=where, hint=hint)
        rows, count = record.information.square_root, len(record.information.increments)
        if [len(row) for row in rows] != [count] * count:
            text = "its information does not fit its parameters: the file was cut or damaged."
            raise ConfigError(text, where=where, hint="Take a whole copy, or run the calibration again.")
        description = {key: plain(source.data[key]) for key in ("arms", "measurements", "statics")}
        if identity_of(description) != record.identity.get("arm"):
            text = "the description of the arm does not match its identity: the file was edited or damaged."
            raise ConfigError(text, where=where, hint="Change the experiment's configuration and run it again.")
        offered = {(component.kind, component.name) for component in registry.components} | {("core", "arm")}
        for kept in record.components:
            if (kept.kind, kept.name) not in offered:
                given = f"{kept.distribution or kept.plugin} {kept.version}".strip()
                is_file = kept.distribution.endswith(".py")
                raise PluginError(
                    f"it was made with the {kept.kind} {kept.name!r} of the plugin{' file' if is_file else ''} "
                    f"{given}, which is not loaded.",
                    where=where,
                    hint=f"Give that file: --plugin {kept.distribution}." if is_file else "Install that plugin.",
                )
        system = build_system(source, registry)
        parameters = system.parameters(record.groups)
        values = {entry.name: entry.value for entry in record.parameters}
        if tuple(values) != parameters.entry_names:
            differing = ", ".join(sorted(set(values) ^ set(parameters.entry_names))[:5]) or "their order differs"
            changed = "; ".join(differences(record.components, components(system, registry)))
            raise ConfigError(
                f"its parameters are not those of its arm: {differing}.",
                where=where,
                hint=f"It was made with {changed or 'another version of a plugin'}; run the calibration again.",
            )
        return cls(system, parameters.with_nominal(np.array(list(values.values()))), record)

    def checked(self, commands: Dataset | None, registry: PluginRegistry) -> Self:
        """The same with what its components are now and predictions at check poses (no poses: none)."""
        checks = None
        if commands is not None:
            stated = self.plus_minus(commands) if self.record.prediction and self.readable else None
            channels, tools = predict(self.system, self.parameters, commands)
            widths = {} if stated is None else {n: float(np.min(w)) for n, w in stated.half_widths.items()}
            radii = [] if stated is None else [float(np.min(radius)) for radius in stated.radii.values()]
            names = tuple(commands.channels)
            checks = CheckRecord(
                channels=names,
                records=tuple(tuple(row) for row in commands.stacked(names).T.tolist()),
                values=tuple(self.parameters.nominal().tolist()),
                predicted={name: tuple(row.tolist()) for name, row in channels.items() if np.isfinite(row).all()},
                tools={
                    name: tuple(tuple(pose[:3].ravel().tolist()) for pose in poses)
                    for name, poses in zip(self.system.arms, tools, strict=True)
                },
                half_widths={name: width for name, width in widths.items() if np.isfinite(width) and width > 0},
                radius=min((radius for radius in radii if np.isfinite(radius) and radius > 0), default=None),
            )
        physics = {"checks": checks, "components": components(self.system, registry)}
        return replace(self, record=self.record.model_copy(update=physics))

    def notices(self, path: str | Path, registry: PluginRegistry) -> list[str]:
        """What its user should know, the rest of a sentence each: what was accepted, versions whose predictions agree.

        Raises:
            ConfigError: the physics is not that which it was made with: its check poses are predicted elsewhere.
        """
        texts, record = [], self.record
        if record.level == "lost":
            texts.append(f"is lost: {(record.recalibrated or {}).get('why')}")
        if not record.verdict.get("usable", True):
            texts.append(f"is used although its verdict is bad: {record.verdict['findings'][0]}")
        if record.accepted:
            texts.append(f"was {record.accepted}: no records stand behind what it predicts now.")
        changed = differences(record.components, components(self.system, registry))
        made_with = f" It was made with {'; '.join(changed)}." if changed else ""
        if record.checks is None:
            return [*texts, f"keeps no check poses.{made_with}"] if changed else texts
        try:
            tool_m, share, name = movement(self.system, self.parameters, record.checks)
        except (ArmcalError, ValueError) as fault:
            text = f"its check poses cannot be predicted any more ({fault})."
            raise ConfigError(f"{text}{made_with}", where=Location(str(path)), hint=_OTHER_PHYSICS) from fault
        if share > SHARE:
            stated = f"{name} by {share:.2g} times its stated accuracy (limit {SHARE:g})"
            if name in record.checks.tools and record.checks.radius is None:
                stated = f"no accuracy is stated for them (limit {UNSTATED_M * 1000:g} mm)"
            raise ConfigError(
                f"the physics is another than when it was written: at its {len(record.checks.records)} check poses "
                f"tools moved by up to {tool_m * 1000:.3g} mm; {stated}.{made_with}",
                where=Location(str(path)),
                hint=_OTHER_PHYSICS,
            )
        if changed:
            agree = f"predictions at its {len(record.checks.records)} check poses agree to {tool_m * 1000:.1g} mm"
            texts.append(f"was made with {'; '.join(changed)}; {agree}.")
        return texts

    @property
    def nominal(self) -> Parameters:
        """The parameters as they were before the calibration."""
        return self.parameters.with_nominal(np.array([entry.nominal for entry in self.record.parameters]))

    @property
    def readable(self) -> Mapping[str, Measurement]:
        """The measurements whose readings a single pose has: a contact reads nothing."""
        return readable(self.system)

    def predict(self, commands: Dataset) -> tuple[dict[str, Array], Array]:
        """What instruments would read and where the tools of all arms are, in elastic equilibrium.

        Args:
            commands: records with joint angles; load and gravity where they differ from the configured ones.

        Returns:
            values (N) by channel (SI), and base_T_tool (arms x N x 4 x 4).

        Raises:
            DataError: the arm is elastic and neither records nor calibration say what hangs on the tool.
            NotConvergedError: a record has no equilibrium.
        """
        self.require_payload(commands.has("payload"), commands.source)
        return predict(self.system, self.parameters, commands)

    def require_payload(self, stated: bool, source: str | None = None) -> None:
        """A DataError where neither calibration nor records state the payload of an arm whose place depends on it."""
        arms = self.system.arms.values()
        if any(arm.depends_on_payload for arm in arms) and self.system.statics.payload is None and not stated:
            elastic = any(arm.deflection_size for arm in arms)
            raise DataError(
                f"the arm {'is elastic' if elastic else 'has learned what loads do'} and its payload is not stated.",
                where=Location(source or None),
                hint="Add a column payload_g; the calibration was made with one.",
            )

    @property
    def free(self) -> frozenset[str]:
        """The parameters that the records were fitted by."""
        return frozenset(entry.name.partition("[")[0] for entry in self.record.parameters if entry.free)

    @property
    def uncertainty(self) -> Uncertainty:
        """How far its predictions may be off.

        Raises:
            ConfigError: the file does not say, or what it says does not fit its parameters.
        """
        kept, noise = self.record.prediction, self.record.noise
        if kept is None:
            raise ConfigError(
                "the calibration keeps nothing about the errors of its predictions.",
                hint="It was written by an earlier version; run the calibration again.",
            )
        entries = self.record.parameters
        names = tuple(entry.name for entry in entries if entry.free)
        if kept.entries != names or [len(row) for row in kept.covariance] != [*range(1, len(names) + 1)]:
            raise ConfigError(
                "the covariance in the calibration does not fit its free parameters.",
                hint="The file was edited or damaged; run the calibration again.",
            )
        fitted = self.nominal.with_free(self.free)
        try:
            listed: list[dict[str, Any]] = noise.get("components", [])
            stated: list[dict[str, Any]] = [{k: math.nan if v is None else v for k, v in own.items()} for own in listed]
            components = tuple(Component(**own) for own in stated)
            measure = (float(noise["scale"]), float(noise["degrees_of_freedom"]))
        except (KeyError, TypeError, ValueError) as fault:
            text = f"the noise in the calibration cannot be read ({type(fault).__name__}: {fault})."
            raise ConfigError(text, hint="The file was edited or damaged; run the calibration again.") from fault
        system = replace(self.system, measurements=self.readable)
        return Uncertainty(system, fitted, self.parameters.nominal(), kept, *measure, components)

    def plus_minus(self, commands: Dataset) -> PlusMinus:
        """How far measurements at these commands may lie from ``predict``.

        Where something drifts, in another recording than the calibration's.

        Raises:
            ConfigError: the calibration does not say.
            NotConvergedError: a record has no equilibrium.
        """
        return self.uncertainty.plus_minus(commands)

    def expression(
        self,
        arm: str | None = None,
        conditions: Sequence[str] = (),
        point: Point = "tool",
        tuned: Collection[str] = (),
        like: ToolExpression | None = None,
    ) -> ToolExpression:
        """One arm (the first if no name is given) as expressions of commands, load and elastic state.

        ``point`` says what is where the tool's frame is: that frame itself, or the ``target`` that was measured.
        ``tuned`` parameters are channels. ``like`` is such an expression of another calibration of the same arm: where
        only tuned parameters and statics differ, it and what was compiled for it serve on; else what differs is tuned.

        Raises:
            ValueError: no such arm.
            ConfigError: there is no such point, or no measurement reads the target.
        """
        system, name = self.system, self._named(arm)
        at = tool_point(point, system, name, self.parameters)
        if like is not None:
            retuned = like.retuned(self.parameters, at or identity(), system.environment)
            if retuned is not None:
                return retuned
            tuned = {*tuned, *like.tuned, *like.differing(self.parameters)}
        own = arm_expression(system.arms[name], self.parameters, system.environment, conditions, tuned)
        return own if at is None else own.at(at)

    def compensator(
        self,
        arm: str | None = None,
        options: Options | None = None,
        conditions: Sequence[str] = (),
        point: Point = "tool",
        **parts: Any,
    ) -> Compensator:
        """What finds commands for one arm (the first if no name is given); build it once and ask it often.

        ``conditions`` of the surroundings are those that targets will tell, ``point`` is what arrives at them (see
        ``expression``); ``parts`` are further ones of ``Compensator``.

        Raises:
            ValueError: no such arm, or limits of a joint that it does not have.
            ConfigError: there is no such point, or no measurement reads the target that shall arrive.
        """
        return Compensator(self.expression(arm, conditions, point), self.parameters, options, **parts)

    def compensate(
        self,
        positions: Array,
        rotations: Array | None = None,
        start: Array | None = None,
        arm: str | None = None,
        options: Options | None = None,
        point: Point = "tool",
        **recorded: Any,
    ) -> Commands:
        """What to command so that the tool is at positions (N x 3; m; base frame), turned as base_R_tool (N x 3 x 3).

        With the ``point`` ``target`` the target that was measured arrives there, in place of the tool frame's origin.

        ``start`` (n or N x n; rad or m) is where the arm comes from, ``recorded`` the rest of ``Compensator.targets``:
        payload, gravity, approach, conditions of the surroundings. Who asks often keeps a ``compensator``.

        Raises:
            ValueError: no such arm, limits of a joint that it does not have, or arrays of other shapes.
            DataError: the arm is elastic and nothing says what hangs on the tool.
            ConfigError: there is no such point, or no measurement reads the target that shall arrive.
        """
        self.require_payload(recorded.get("payload") is not None)
        compensator = self.compensator(arm, options, tuple(recorded.get("conditions") or ()), point)
        return compensator.solve(compensator.targets(positions, rotations, **recorded), start)

    def _named(self, arm: str | None) -> str:
        name = arm or next(iter(self.system.arms))
        if name not in self.system.arms:
            raise ValueError(f"no arm is called {name!r}; the arms are {', '.join(self.system.arms)}")
        return name

    def forward(self, joint_angles: Array, arm: str | None = None) -> Array:
        """base_T_tool (N x 4 x 4) at commanded joint angles (N x n; rad, or m on sliding joints).

        Raises:
            ValueError: no such arm, or the number of joints differs.
            NotConvergedError: a record has no equilibrium.
        """
        name = self._named(arm)
        joints = tuple(self.system.arms[name].commanded)
        angles = np.atleast_2d(np.asarray(joint_angles, dtype=float))
        if angles.shape[1] != len(joints):
            raise ValueError(f"found {angles.shape[1]} joint angles a row, the arm {name} has {len(joints)} joints")
        channels = {f"{name}.{joint}": angles[:, i] for i, joint in enumerate(joints)}
        commands = Dataset(tuple(str(i) for i in range(len(angles))), channels)
        alone = replace(self.system, arms={name: self.system.arms[name]}, measurements={})
        poses = replace(self, system=alone).predict(commands)[1]
        return np.asarray(poses[0])


def arm_named(arms: Collection[str], arm: str | None, where: Location | None = None, option: str = "--arm NAME") -> str:
    """The arm of this name, or the only one if there is no name; ConfigError if there is none such, or are several."""
    if arm is None and len(arms) > 1:
        raise ConfigError(f"found the arms {', '.join(arms)}.", where=where, hint=f"Choose one with {option}.")
    name = next(iter(arms)) if arm is None else arm
    if name not in arms:
        raise ConfigError(f"no arm is called {name!r}.", where=where, hint=f"The arms are {', '.join(arms)}.")
    return name


def accept(path: Path, day: str, registry: PluginRegistry) -> tuple[Calibration | None, bool, float | None]:
    """Check a calibration again in all but its hash, as of a day.

    Gives it with a note of its acceptance and predictions at its check poses as they are now, None where it is as
    armcal wrote it, with the same versions; whether its content was edited; and how far tools at its check poses are
    from where they were predicted (m), None if it keeps none.
    """
    source, is_whole = read_record(path, changed=True)
    loaded, where = Calibration.built(source, path, registry), Location(str(path))
    for index, entry in enumerate(loaded.record.parameters):
        stands = source.where(("parameters", index, "value"))
        low, high = (-np.inf if entry.lower is None else entry.lower, np.inf if entry.upper is None else entry.upper)
        if entry.free and not low <= entry.value <= high:
            raise ConfigError(
                f"{entry.name} is {entry.value:g} {entry.unit}, expected {low:g} to {high:g}, its own lower and upper.",
                where=stands,
                hint="Correct the value, or widen the interval if you know better.",
            )
        if not entry.free and entry.value != entry.nominal:
            raise ConfigError(
                f"{entry.name} is fixed at {entry.nominal:g} {entry.unit}, and its value is {entry.value:g}.",
                where=stands,
                hint="Write the same number for nominal and value.",
            )
    how = "made with other versions" if is_whole else "edited by hand"
    noted = replace(loaded, record=loaded.record.model_copy(update={"accepted": f"{how} and accepted on {day}"}))
    try:
        moved, kept = None, loaded.record.checks
        if kept is not None:
            tools = predict(loaded.system, loaded.parameters, kept.commands)[1]
            before = np.array([kept.tools[arm] for arm in loaded.system.arms]).reshape(*tools.shape[:2], 3, 4)
            moved = float(np.linalg.norm(tools[:, :, :3, 3] - before[..., 3], axis=-1).max())
        remade = noted.checked(kept.commands if kept else None, registry)
    except (NotConvergedError, ArithmeticError, LookupError, TypeError, ValueError) as fault:
        text = f"the arm cannot be predicted with it ({type(fault).__name__}: {fault})."
        raise ConfigError(text, where=where, hint="Undo the last edits, or run the calibration again.") from fault
    same = remade.record.model_copy(update={"accepted": loaded.record.accepted}) == loaded.record
    return None if is_whole and same else remade, not is_whole, moved


_MODEL_ZERO = re.compile(r"(theta|offset)(\d+)")


@dataclass(frozen=True)
class Zero:
    degrees: float  # how far a joint stands from its command at zero
    sd_deg: float


def zeros_of(path: Path, arm: str | None, registry: PluginRegistry) -> tuple[dict[str, Zero], dict[str, str]]:
    """The zeros that a calibration found, by joint; and joints without one, with the reason.

    A zero is what a joint effect states as one (``JointEffect.zeros``), as it stands, and what a model's own ``theta``
    or ``offset`` differs from its drawing.
    """
    loaded, where = Calibration.load(path, registry), Location(str(path))
    arms = loaded.system.arms
    chosen = arms[arm_named(arms, arm, where, "--arm-name NAME")]
    stated = {f"{chosen.name}.{n}.{p}": j for n, effect in chosen.effects.items() for p, j in effect.zeros().items()}
    zeros: dict[str, Zero] = {}
    reasons = dict.fromkeys(chosen.commanded, "its zero was not free")
    for entry in loaded.record.parameters:
        match = _MODEL_ZERO.fullmatch(entry.name.removeprefix(f"{chosen.name}.{chosen.model_name}."))
        number = stated.get(entry.name, int(match[2]) if match and entry.unit == "rad" else 0)
        if not number or (joint := chosen.joint_names[number - 1]) not in chosen.commanded:
            continue
        if entry.free and (entry.sd is None or entry.determined_by != "data"):
            reasons[joint] = f"the records do not determine {entry.name}"
            continue
        value = entry.value if entry.name in stated else entry.value - entry.nominal
        if entry.free or (entry.name in stated and value):
            before = zeros.get(joint, Zero(0.0, 0.0))
            sd = math.hypot(before.sd_deg, math.degrees(entry.sd or 0.0))
            zeros[joint] = Zero(before.degrees + math.degrees(value), sd)
    if not zeros:
        hint = "Free them in parameters.free (arm.EFFECT.offset*, of an effect servo_map), and run again."
        raise InputError("found no calibrated zero of a joint.", where=where, hint=hint)
    return zeros, {joint: reason for joint, reason in reasons.items() if joint not in zeros}
