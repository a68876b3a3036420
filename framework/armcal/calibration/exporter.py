"""Exporters: calibrated arms in the formats of other programs, and how far what a format leaves out matters."""

import hashlib
import json
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, Protocol

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm
from armcal.arm.joints import joint_limits
from armcal.arm.statics import STATICS, Environment
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.calibration.calibration import Calibration, arm_named
from armcal.calibration.calibration_file import ParameterRecord
from armcal.calibration.rigid_chain import tool_poses
from armcal.calibration.tool_expression import ToolExpression, arm_expression
from armcal.errors import NotConvergedError

POSES = 1000  # So many random poses, within the joints' limits, are compared
_LONGEST_M = 1.0
_FARTHEST = {"angle": math.pi, "length": _LONGEST_M}
_WIDEST = {"angle": 4 * math.pi, "length": 100.0}
_NOTHING = Environment((0.0, 0.0, 0.0))


@dataclass(frozen=True)
class Origin:
    """Where the numbers of an export come from."""

    experiment: str = ""  # the calibration's name
    created: str = ""  # when it was made (ISO 8601)
    software: Mapping[str, str] = field(default_factory=dict)  # versions by name
    identity: Mapping[str, str] = field(default_factory=dict)  # hashes of what it was made from (``arm``, ``data``)


@dataclass(frozen=True)
class Instrument:
    """A measurement as calibrated."""

    settings: Mapping[str, Any]  # its section of the configuration, in SI units (``type`` among them)
    numbers: Mapping[str, float]  # canonical entries by local name (``fx``, ``camera_rotation[w]``)
    deviations: Mapping[str, float | None]  # their standard deviations; None where a number is held


@dataclass(frozen=True)
class ExportRequest:
    """What is to be written: an arm, its instance name, and its calibrated parameters by full name."""

    name: str  # the arm's instance name
    arm: Arm  # the arm
    values: Mapping[str, Array]  # its own calibrated parameters by full name (SI)
    tilt: Mapping[str, Array] = field(default_factory=dict)  # of gravity: ``statics.gravity_rx`` (rad), by full name
    environment: Environment = _NOTHING  # what acts where nothing is said
    payload_stated: bool = True  # whether the calibration says what hangs on the tool
    entries: tuple[ParameterRecord, ...] = ()  # what the calibration says of each number
    description: Mapping[str, Any] = field(default_factory=dict)  # as configured, in SI: ``model``, ``effects``
    origin: Origin = field(default_factory=Origin)  # where the numbers come from
    out: str = ""  # the name of the file that is written, for formats whose files name one another
    instruments: Mapping[str, Instrument] = field(default_factory=dict)  # measurements by name

    def expression(self, conditions: Sequence[str] = ()) -> ToolExpression:
        """The arm as expressions of commands, load and elastic state; ``conditions`` are told, not taken as known."""
        blocks = [replace(b, nominal=tuple(map(float, self.values[b.name]))) for b in self.arm.parameters()]
        tilt = [ParameterBlock(name, "rad", tuple(map(float, value))) for name, value in self.tilt.items()]
        return arm_expression(self.arm, Parameters((*blocks, *tilt)), self.environment, conditions)

    @property
    def digest(self) -> str:
        """SHA-256 of the arm's description and of its calibrated values, by which an export is known again."""
        numbers = {name: [float(x) for x in value] for name, value in {**self.values, **self.tilt}.items()}
        content = {"arm": self.origin.identity.get("arm", ""), "name": self.name, "values": numbers}
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()


@dataclass(frozen=True)
class Exported:
    """A file's content, how many of the arm's numbers changed in it, and what of the arm it cannot hold."""

    content: bytes  # of the file that was asked for
    changed: int  # how many numbers are not the nominal ones
    left_out: tuple[str, ...] = ()  # what the format cannot hold
    companions: Mapping[str, bytes] = field(default_factory=dict)  # further files by name, which are written beside it
    remarks: tuple[str, ...] = ()  # what whoever uses the files should know, a sentence each
    reach: float | None = None  # how far what is left out moves the tool at most (m); None: armcal measures it


class Exporter(Protocol):
    """What a plugin provides to write a calibrated arm in a format of its own.

    One whose files hold what was learned of the pose residual, as those of ``request.expression`` do, has the class
    attribute ``holds_residual = True``. Of any other ``armcal export`` says that it is left out, and how far that moves
    the tool. One whose files take commands has ``holds_couplings = True``; any other is given the arm by its joints
    angles.
    """

    def export(self, request: ExportRequest) -> Exported:
        """The arm in the format, read again and compared before it is handed out.

        Raises:
            InputError: the format cannot hold this arm, or what it needs is not installed.
        """


def changed_numbers(request: ExportRequest) -> int:
    nominal = {block.name: block.nominal for block in request.arm.parameters()}
    return sum(float(a) != b for n, value in request.values.items() for a, b in zip(value, nominal[n], strict=True))


def request_of(calibration: Calibration, arm: str | None, out: str = "") -> ExportRequest:
    """What a calibration says of one arm, of its only one if no name is given; ``out`` names the file to be written."""
    arms, name = calibration.system.arms, arm_named(calibration.system.arms, arm)
    values = {block.name: np.array(block.nominal) for block in calibration.parameters.blocks}
    own = {block.name for block in arms[name].parameters()}
    record, instruments = calibration.record, {}
    for instrument, settings in record.measurements.items():
        scope = f"{instrument}."
        kept = {e.name.removeprefix(scope): e for e in record.parameters if e.name.startswith(scope)}
        numbers = {local: entry.value for local, entry in kept.items()}
        instruments[instrument] = Instrument(settings, numbers, {local: entry.sd for local, entry in kept.items()})
    return ExportRequest(
        name,
        arms[name],
        {key: value for key, value in values.items() if key in own},
        tilt={key: value for key, value in values.items() if key.startswith(f"{STATICS}.")},
        environment=calibration.system.environment,
        payload_stated=calibration.system.statics.payload is not None,
        description=record.arms[name],
        entries=tuple(e for e in record.parameters if e.name.partition("[")[0] in own),
        origin=Origin(record.experiment, record.created, record.software, record.identity),
        out=out,
        instruments=instruments,
    )


def random_commands(arm: Arm, count: int = POSES, seed: int = 1) -> Array:
    """Commands of the commanded joints within their limits (joints x N; rad or m), up to a half turn without any."""
    random = np.random.default_rng(seed)
    rows = []
    for joint, limits in joint_limits(arm.nominal_chain).items():
        kind = arm.commanded[joint]
        low, high = limits or (-_FARTHEST[kind], _FARTHEST[kind])
        widest = _WIDEST[kind]
        rows.append(random.uniform(max(low, -widest), min(high, widest), count))
    return np.array(rows)


def by_own_angles(request: ExportRequest) -> tuple[ExportRequest, str]:
    """The arm by its joints' own angles, without couplings, and what whoever uses its file should know."""
    sums = []
    for joint, others in request.arm.couplings.items():
        parts = "".join(f" {'-' if f < 0 else '+'} {f'{abs(f):g} ' * (abs(f) != 1)}{o}" for o, f in others.items() if f)
        sums.append(f"{joint} = {joint}{parts} as commanded")
    remark = f"the file takes the joints' own angles: {', '.join(sums)}"
    return replace(request, arm=replace(request.arm, couplings={})), remark


def rigid_tools(arm: Arm, values: Mapping[str, Array], commands: Array) -> Array:
    """base_T_tool (N x 4 x 4) without effects, at commands (joints x N) and parameters by full name."""
    chain = arm.chain({name: ca.SX(list(value)) for name, value in values.items()})
    return tool_poses(chain, np.stack(arm.joint_commands([*commands]), axis=1))


def leaves_residual_out(exporter: Exporter, request: ExportRequest) -> bool:
    residual = request.arm.residual
    return residual is not None and residual.is_learned and not getattr(exporter, "holds_residual", False)


def effects_reach(
    calibration: Calibration, request: ExportRequest, of: Literal["everything", "residual"] = "everything"
) -> float | None:
    """How far the calibrated arm is from the same one without effects and pose residual, at most over random poses (m).

    With ``of`` the residual from the same one without that alone. Under the configured gravity and load, no load where
    none is configured. None where an elastic arm does not settle in all poses.
    """
    commands = random_commands(request.arm)
    statics = calibration.system.statics
    if statics.payload is None:
        statics = statics.model_copy(update={"payload": 0.0})
    alone = replace(calibration.system, arms={request.name: request.arm}, measurements={}, statics=statics)
    channels = {f"{request.name}.{joint}": row for joint, row in zip(request.arm.commanded, commands, strict=True)}
    poses = Dataset(tuple(str(i) for i in range(commands.shape[1])), channels)
    bare = replace(alone, arms={request.name: replace(request.arm, residual=None)})
    try:
        tools = replace(calibration, system=alone).predict(poses)[1][0]
        if of == "residual":
            others = replace(calibration, system=bare).predict(poses)[1][0]
        else:
            others = rigid_tools(request.arm, request.values, commands)
    except NotConvergedError:
        return None
    apart = tools[:, :3, 3] - others[:, :3, 3]
    return float(np.linalg.norm(apart, axis=1).max())
