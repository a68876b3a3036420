"""The exporters ``yaml`` and ``json``: a description of the arm, read again and compared before it is written."""

import json
from collections.abc import Mapping
from dataclasses import asdict
from importlib import resources
from typing import Any, ClassVar, Literal

import yaml
from armcal.base.arrays import Array
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, changed_numbers
from armcal.calibration.rigid_chain import RigidJoint
from armcal.errors import ProblemError
from typing_extensions import override

from armcal_export.content import REPORT, content_of

SCHEMA_FILE = "arm.schema.json"
_SCHEMA = 1
_HEAD = f"# A calibrated robot arm; {SCHEMA_FILE} says what each field means. Units are SI, angles in rad.\n"


class DescriptionSettings(Settings):
    """What is written beside the description.

    Attributes:
        beside: ``schema`` writes the JSON schema into the same folder, ``nothing`` leaves it out.
    """

    beside: Literal["schema", "nothing"] = "schema"


class YamlExporter:
    """As YAML."""

    Settings: ClassVar[type[DescriptionSettings]] = DescriptionSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: DescriptionSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        description = described(request)
        content = self.written(description)
        if self.read(content) != description:
            raise ProblemError("what reads back is not the calibrated arm to the last digit.", hint=REPORT)
        schema = resources.files("armcal_export").joinpath(SCHEMA_FILE)
        beside = {SCHEMA_FILE: schema.read_bytes()} if self._settings.beside == "schema" else {}
        return Exported(content, changed_numbers(request), companions=beside)

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
    effects: Mapping[str, Mapping[str, Any]] = request.description.get("effects", {})
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
                "settings": _plain({key: value for key, value in effects.get(name, {}).items() if key != "type"}),
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
        "parameters": _parameters(request),
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


def _parameters(request: ExportRequest) -> list[dict[str, Any]]:
    if request.entries:
        names, entries = ("name", "unit", "nominal", "value", "free", "sd"), request.entries
        by_data = [one.determined_by and one.determined_by == "data" for one in entries]
        described = [{name: getattr(entry, name) for name in names} for entry in entries]
        return [{**own, "determined": by} for own, by in zip(described, by_data, strict=True)]
    blocks = {block.name: block for block in request.arm.parameters()}
    unknown = {"free": False, "sd": None, "determined": None}
    return [
        {"name": name, "unit": unit, "nominal": nominal, "value": float(value), **unknown}
        for key, numbers in request.values.items()
        for name, unit, nominal, value in zip(
            blocks[key].entry_names, blocks[key].entry_units, blocks[key].nominal, numbers, strict=True
        )
    ]


def _pose(matrix: Array) -> dict[str, Any]:
    return {"position_m": matrix[:3, 3].tolist(), "rotation": matrix[:3, :3].tolist()}


def _floats(numbers: Any) -> list[float]:
    return [float(number) for number in numbers]


def _plain(value: Any) -> Any:
    """Settings as JSON has them: lists for tuples."""
    if isinstance(value, Mapping):
        return {str(key): _plain(own) for key, own in value.items()}
    return [_plain(own) for own in value] if isinstance(value, list | tuple) else value
