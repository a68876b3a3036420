"""The exporters ``yaml`` and ``json``: a description of the arm, read again and rebuilt before it is written."""

import json
from collections.abc import Mapping
from importlib import resources
from typing import Any, ClassVar, Literal

import yaml
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, changed_numbers
from armcal.errors import ProblemError
from pydantic import ValidationError
from typing_extensions import override

from armcal_export.describe import REPORT, describe, rebuilt_tools, require_same_tools
from armcal_export.description import SCHEMA_FILE, ArmDescription

_HEAD = "# A calibrated robot arm; {file} says what each field means. Units are SI, angles in rad.\n"


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
        """The description and its schema.

        Raises:
            ProblemError: the tool hangs on a joint before the last, or what reads back is another arm.
        """
        arm_description = describe(request)
        content = self.written(arm_description)
        try:
            again = read_description(content)
        except (ValueError, ValidationError) as fault:
            raise ProblemError(f"the description does not read back: {str(fault)[:300]}.", hint=REPORT) from fault
        require_same_tools(request, lambda commands: rebuilt_tools(again, commands))
        if again != arm_description:
            raise ProblemError("what reads back is not the calibrated arm to the last digit.", hint=REPORT)
        beside = {SCHEMA_FILE: schema()} if self._settings.beside == "schema" else {}
        return Exported(content, changed_numbers(request), companions=beside)

    def written(self, arm_description: ArmDescription) -> bytes:
        text = yaml.dump(
            arm_description.model_dump(mode="json"), Dumper=_Dumper, sort_keys=False, allow_unicode=True, width=110,
            default_flow_style=None,
        )  # fmt: skip
        return (_HEAD.format(file=SCHEMA_FILE) + text).encode("utf-8")


class JsonExporter(YamlExporter):
    """As JSON."""

    @override
    def written(self, arm_description: ArmDescription) -> bytes:
        text = json.dumps(arm_description.model_dump(mode="json"), indent=2, ensure_ascii=False, allow_nan=False)
        return f"{text}\n".encode()


def read_description(content: bytes) -> ArmDescription:
    """A description from YAML or JSON.

    Raises:
        ValueError: it is neither, or not as the schema says.
    """
    text = content.decode("utf-8")
    try:
        return ArmDescription.model_validate_json(json.dumps(json.loads(text)))
    except json.JSONDecodeError:
        pass
    try:
        return ArmDescription.model_validate_json(json.dumps(yaml.safe_load(text), allow_nan=False))
    except yaml.YAMLError as fault:
        raise ValueError(f"it is neither YAML nor JSON ({fault})") from fault


def schema() -> bytes:
    return resources.files("armcal_export").joinpath(SCHEMA_FILE).read_bytes()


class _Dumper(yaml.SafeDumper):
    """Rows of numbers on one line, and text of several lines in double quotes, which keep every kind of line end."""


def _quoted(dumper: yaml.SafeDumper, text: str) -> yaml.ScalarNode:
    return dumper.represent_scalar("tag:yaml.org,2002:str", text, style=None if text.isprintable() else '"')


_Dumper.add_representer(str, _quoted)
