"""Settings classes and a good configuration that several test files share."""

from __future__ import annotations

from enum import Enum
from pathlib import Path
from typing import Annotated, Literal

from armcal.base.settings import Acceleration3, Angle, Compliance, InputPath, Length, Length3, Mass, Settings
from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource, load_config
from pydantic import Field


class Side(Enum):
    LEFT = "left"
    RIGHT = "right"


class Row(Settings):
    name: str = "row"
    d: Length = 0.0
    theta: Angle | None = None
    com: Length3 = (0, 0, 0)


class Mdh(Settings):
    type: Literal["mdh"]
    rows: tuple[Row, ...]


class Poe(Settings):
    type: Literal["poe"]
    axes: list[Length3]


class Experiment(Settings):
    model: Annotated[Mdh | Poe, Field(discriminator="type")]
    noise: Annotated[Length, Field(gt=0)]
    gravity: Acceleration3 = (0.0, 0.0, -9.81)
    bounds: Angle | Literal["auto"] | bool = "auto"
    compliance: dict[str, Compliance] = Field(default_factory=dict)
    payload: Mass | None = None
    weight: float = 1.0
    folds: int = 5
    strict: bool = True
    side: Side = Side.LEFT
    data: InputPath | None = None
    config: float = 0.0
    default: int = 0


GOOD = """\
model:
  type: mdh
  rows:
    - name: shoulder
      d_mm: 46.9
      theta: 60 deg
    - {com_mm: [0, 2, 3 cm]}
noise_mm: 0.5
compliance_rad_per_Nm: {j1: 0.05, j2: 1 deg_per_Nm}
payload_g: 50
side: right
data: poses.csv
bounds: off
"""


def load(folder: Path, text: str, *overrides: str) -> ConfigSource:
    path = folder / "c.yaml"
    path.write_text(text)
    return load_config(path, overrides)


def check(folder: Path, text: str, *overrides: str) -> Experiment:
    return validate(Experiment, load(folder, text, *overrides))
