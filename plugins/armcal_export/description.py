"""What formats hold of a calibrated arm: rigid joints, springs, masses; the arm in equilibrium to compare with; and the
exporters ``yaml`` and ``json``: a description of the arm, read again and compared before it is written.
"""

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from importlib import resources
from typing import Any, ClassVar

import casadi as ca
import numpy as np
import yaml
from armcal.arm.assembly import scoped
from armcal.arm.effects import MOUNT, JointCommand, Spring
from armcal.arm.evaluator import Evaluator
from armcal.arm.model import Chain, forward
from armcal.arm.statics import MOUNT_FRAME, STATICS, TOOL_FRAME, Load, frame_names, tilted
from armcal.base.arrays import Array, Mask
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, changed_numbers
from armcal.calibration.rigid_chain import RigidChain, RigidJoint, rigid_chain
from armcal.calibration.tool_expression import ToolExpression
from armcal.errors import ProblemError
from typing_extensions import override

REPORT = "Nothing was written. Please report this with the calibration."
_LOADS = (-3.0, -0.5, 0.1, 2.0)
_COMMANDS = ((0.0, 0.0), (0.7, 1.0), (-1.1, -1.0))  # Commanded displacements (rad or m) and approaches
_LINEAR = 1e-12


@dataclass(frozen=True)
class ArmSpring:
    """An elastic deflection: axes times (compliance times the load's components along the axes)."""

    effect: str
    site: int  # 0: the mount; i: joint i, from 1, after its motion
    axes: list[list[float]]  # unit vectors in the site's frame; the load is the moment about them
    along: bool  # it slides along its axis, under the force and not the moment
    compliance: list[list[float]]  # rad/(N m), or m/N; under a small load if not linear
    linear: bool


@dataclass(frozen=True)
class ArmMass:
    name: str
    mass_kg: float
    com_m: list[float]  # in the base frame with all commands zero
    moved_by: int  # the joint that moves it, from 1; 0: none
    loads_up_to: int  # the last joint that it was taken to load, from 1


@dataclass(frozen=True)
class ArmContent:
    """An arm at its calibrated values."""

    name: str
    rigid: RigidChain
    springs: tuple[ArmSpring, ...]
    masses: tuple[ArmMass, ...]
    gravity: list[float]  # m/s^2, base frame, as calibrated


def content_of(request: ExportRequest) -> ArmContent:
    values = {name: ca.SX(list(map(float, value))) for name, value in request.values.items()}
    chain, nothing = request.arm.chain(values), ca.SX.zeros(3)
    tilt = {name.removeprefix(f"{STATICS}."): ca.SX(float(value[0])) for name, value in request.tilt.items()}
    load = Load(ca.SX(list(request.environment.gravity)), ca.SX(0), nothing, nothing, nothing)
    springs = [
        _spring(name, spring, chain)
        for name, effect in request.arm.effects.items()
        for spring in effect.springs(scoped(values, f"{request.name}.{name}."))
    ]
    gravity = _numbers(tilted(load, tilt).gravity)
    return ArmContent(request.name, rigid_chain(chain), tuple(springs), _masses(request, chain), gravity)


def _spring(effect: str, spring: Spring, chain: Chain) -> ArmSpring:
    """A spring; one without directions gives about or along its joint's own axis."""
    joint = chain.joints[spring.site - 1] if spring.site else None
    axes = np.array(spring.directions or ((joint.axis,) if joint else ()), dtype=float)
    load, recorded = ca.SX.sym("load", spring.size), ca.SX.sym("recorded", 2)
    command = JointCommand(spring.site - 1, recorded[0], recorded[1]) if spring.site else MOUNT
    given = ca.densify(ca.SX(spring.law(load, command)))
    law = ca.Function("law", [load, recorded], [given, ca.densify(ca.jacobian(given, load))])
    compliance = np.asarray(law(np.zeros(spring.size), _COMMANDS[0])[1].full())
    linear, rounding = True, _LINEAR * float(np.abs(compliance).max())
    for loads in np.outer(_LOADS, np.arange(1.0, spring.size + 1)):
        for at in _COMMANDS:
            deflection = np.asarray(law(loads, at)[0].full()).ravel()
            linear &= np.allclose(deflection, compliance @ loads, rtol=_LINEAR, atol=rounding)
    along = not spring.directions and joint is not None and not joint.is_revolute
    return ArmSpring(effect, spring.site, axes.tolist(), along, compliance.tolist(), linear)


def _masses(request: ExportRequest, chain: Chain) -> tuple[ArmMass, ...]:
    frames = forward(chain, [joint.offset for joint in chain.joints], {})
    moved_by, masses = frame_names(chain), []
    for mass in request.arm.masses:
        local = scoped(request.values, f"{request.name}.links.{mass.name}.")
        com = ca.SX([float(local[f"com_{axis}"][0]) for axis in "xyz"])
        if mass.frame == TOOL_FRAME:
            place = frames.base_T_tool.apply(com)
        elif mass.frame == MOUNT_FRAME:
            place = frames.sites[0].origin + ca.mtimes(frames.sites[0].rotation, com)
        else:
            place = frames.named[mass.frame].apply(com)
        last = moved_by[mass.frame]
        loads_up_to = last if mass.loads_up_to is None else mass.loads_up_to
        masses.append(ArmMass(mass.name, float(local["mass"][0]), _numbers(place), last, loads_up_to))
    return tuple(masses)


def _numbers(expression: ca.SX) -> list[float]:
    return [float(number) for number in np.asarray(ca.evalf(ca.densify(expression)).full()).ravel()]


def in_equilibrium(expression: ToolExpression, records: Array) -> tuple[Array, Array, Mask]:
    """By CasADi's interpreter: tools (N x 3 x 4), efforts (N x joints), and which records (N x channels) settle (N)."""
    tool = ca.vec(expression.base_T_tool.matrix()[:3, :].T)
    shown, settled = Evaluator(expression, ca.vertcat(tool, expression.efforts)).settle(
        np.zeros(0), records.T, np.zeros((expression.state.numel(), len(records)))
    )
    return shown[:12].T.reshape(-1, 3, 4), shown[12:].T, settled


SCHEMA_FILE = "arm.schema.json"
_SCHEMA = 1
_HEAD = f"# A calibrated robot arm; {SCHEMA_FILE} says what each field means. Units are SI, angles in rad.\n"


class YamlExporter:
    """As YAML."""

    Settings: ClassVar[type[Settings]] = Settings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: Settings) -> None:
        pass

    def export(self, request: ExportRequest) -> Exported:
        description = described(request)
        content = self.written(description)
        if self.read(content) != description:
            raise ProblemError("what reads back is not the calibrated arm to the last digit.", hint=REPORT)
        schema = resources.files("armcal_export").joinpath(SCHEMA_FILE).read_bytes()
        return Exported(content, changed_numbers(request), companions={SCHEMA_FILE: schema})

    def written(self, description: Mapping[str, Any]) -> bytes:
        text = yaml.dump(
            description, Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110, default_flow_style=None
        )
        return (_HEAD + text).encode("utf-8")

    def read(self, content: bytes) -> dict[str, Any]:
        return dict(yaml.safe_load(content))


class JsonExporter(YamlExporter):
    """As JSON."""

    @override
    def written(self, description: Mapping[str, Any]) -> bytes:
        return f"{json.dumps(description, indent=2, ensure_ascii=False, allow_nan=False)}\n".encode()

    @override
    def read(self, content: bytes) -> dict[str, Any]:
        return dict(json.loads(content))


class _Dumper(yaml.SafeDumper):
    """Rows of numbers on one line, and text of several lines in double quotes, which keep every kind of line end."""

    def ignore_aliases(self, data: Any) -> bool:
        return True


def _quoted(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _quoted)


def described(request: ExportRequest) -> dict[str, Any]:
    """The arm as ``arm.schema.json`` has it."""
    content, origin, statics = content_of(request), request.origin, request.environment
    # as JSON has them: lists for tuples
    effects = json.loads(json.dumps(request.description.get("effects", {}), default=dict))
    return {
        "armcal_arm": _SCHEMA,
        "arm": request.name,
        "calibration": {
            "experiment": origin.experiment,
            "created": origin.created,
            "software": dict(origin.software),
            "identity": dict(origin.identity),
            "digest": request.digest,
        },
        "joints": [_joint(joint) for joint in content.rigid.joints],
        "base_T_mount": _pose(content.rigid.base_T_mount),
        "base_T_tool": _pose(content.rigid.base_T_tool),
        "effects": [
            {
                "name": name,
                "type": str(effects.get(name, {}).get("type", "")),
                "settings": {key: value for key, value in effects.get(name, {}).items() if key != "type"},
            }
            for name in request.arm.effects
        ],
        "springs": [asdict(spring) for spring in content.springs],
        "masses": [asdict(mass) for mass in content.masses],
        "statics": {
            "gravity_m_s2": content.gravity,
            "payload_kg": float(statics.payload_mass) if request.payload_stated else None,
            "payload_com_m": _floats(statics.payload_com),
            "force_N": _floats(statics.force),
            "torque_Nm": _floats(statics.torque),
        },
        "servos": [
            {
                "joint": name,
                "angles_rad": _floats(table.angles),
                "pulses_s": _floats(table.pulses),
                "tick_s": float(clock.tick),
            }
            for name, (table, clock) in request.expression().servos.items()
        ],
        "parameters": [
            {
                **{name: getattr(entry, name) for name in ("name", "unit", "nominal", "value", "free", "sd")},
                "determined": entry.determined_by and entry.determined_by == "data",
            }
            for entry in request.entries
        ],
    }


def _joint(joint: RigidJoint) -> dict[str, Any]:
    lower, upper = map(float, joint.limits) if joint.limits else (None, None)
    mimic = joint.mimic
    return {
        "name": joint.name,
        "kind": "prismatic" if joint.slides else "revolute",
        "base_T_joint": _pose(joint.base_T_joint),
        "axis": joint.axis.tolist(),
        "scale": float(joint.scale),
        "pitch": float(joint.pitch),
        "lower": lower,
        "upper": upper,
        "endless": joint.endless,
        "follows": mimic
        and {"joint": mimic.master, "multiplier": float(mimic.multiplier), "offset": float(mimic.offset)},
    }


def _pose(matrix: Array) -> dict[str, Any]:
    return {"position_m": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist()}


def _floats(numbers: Any) -> list[float]:
    return [float(number) for number in numbers]
