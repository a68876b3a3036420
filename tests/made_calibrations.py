"""Calibrations without a run: the arm of a configuration, its parameters moved as a fit might have moved them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from armcal.base.config_text import plain
from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import CalibrationFile, identity_of, sealed
from armcal.config.system import System, build_system
from armcal.config.yaml_source import load_config
from armcal.plugins import discover

_MOVES = {"m": 0.002, "rad": 0.02, "1": 0.02, "kg": 0.005, "rad_per_Nm3": 0.02, "per_K": 2e-5}
_COMPLIANCE = 0.03

FOLLOWING = """<robot name="r"><link name="base"/><link name="a"/><link name="b"/><link name="c"/>
  <link name="hand"><inertial><origin xyz="0 0 0.1"/><mass value="1.5"/></inertial></link>
  <joint name="turn" type="revolute"><origin xyz="0 0 0.3"/><parent link="base"/><child link="a"/>
    <axis xyz="0 0.6 0.8"/>    <limit lower="-2" upper="2" effort="1" velocity="1"/></joint>
  <joint name="slide" type="prismatic"><origin xyz="0.1 0 0" rpy="0.3 0.2 0.1"/><parent link="a"/><child link="b"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="0.3" effort="1" velocity="1"/></joint>
  <joint name="same" type="revolute"><origin xyz="0 0 0.2"/><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
    <mimic joint="turn" multiplier="-0.5" offset="0.1"/></joint>
  <joint name="last" type="continuous"><origin xyz="0.2 0 0"/><parent link="c"/><child link="hand"/><axis xyz="0 1 0"/>
    </joint></robot>"""
FOLLOWING_CONFIG = """
arms:
  arm:
    model: {type: urdf, path: arm.urdf}
    effects: {spring: {type: torsional_spring, joints: [same, last]}}
statics: {gravity_m_s2: [0, 1, -9.81], payload_g: 200, payload_com_mm: [0, 0, 50], force_N: [1, 0, 0]}
measurements: {tracker: {type: tip_position, noise_mm: 0.01}}
"""


def following_arm(folder: Path) -> Path:
    """The configuration of an arm with a joint that slides, one that follows and one that turns on and on."""
    (folder / "arm.urdf").write_text(FOLLOWING, encoding="utf-8")
    (folder / "a.yaml").write_text(FOLLOWING_CONFIG, encoding="utf-8")
    return folder / "a.yaml"


def made_record(
    description: Mapping[str, Any], entries: Sequence[Mapping[str, Any]], increments: Sequence[str], **more: Any
) -> CalibrationFile:
    """A calibration's file without a run: unit noise, unit information on the increments."""
    return CalibrationFile.model_validate(
        {
            "armcal_calibration": 1,
            "created": "2031-01-01T00:00:00+00:00",
            "experiment": "made up",
            "converged": True,
            "software": {},
            "identity": {"arm": identity_of(description)},
            "noise": {"scale": 1.0, "degrees_of_freedom": 1000},
            "quality_mm": {},
            "verdict": {},
            **description,
            "parameters": entries,
            "information": {"increments": increments, "square_root": np.eye(len(increments)).tolist()},
            **more,
        }
    )


@cache
def made_calibration(config: Path, overrides: tuple[str, ...] = (), seed: int = 1) -> Calibration:
    """Every parameter of the arms moved at random; springs of 0.03 rad/(N m) or so, play and lag of a few mrad."""
    system = build_system(load_config(config, overrides), discover())
    return _made(system, _moved(system.parameters({}), np.random.default_rng(seed)))


def exact_calibration(config: Path, values: Mapping[str, float]) -> Calibration:
    """The arm of a configuration, with these values of parameters and the nominal ones of all others."""
    system = build_system(load_config(config), discover())
    parameters = system.parameters({})
    numbers = zip(parameters.entry_names, parameters.nominal().tolist(), strict=True)
    return _made(system, [values.get(name, nominal) for name, nominal in numbers])


def _made(system: System, values: Sequence[float]) -> Calibration:
    parameters = system.parameters({})
    own = {block.name for arm in system.arms.values() for block in arm.parameters()}
    free = [name for name in parameters.names if name in own]
    units = [unit for block in parameters.blocks for unit in block.entry_units]
    nominal = parameters.nominal()
    entries = [
        {
            "name": name,
            "unit": unit,
            "nominal": before,
            "value": value,
            "free": name.partition("[")[0] in own,
            "sd": 1e-4 if name.partition("[")[0] in own else None,
        }
        for name, unit, before, value in zip(parameters.entry_names, units, nominal.tolist(), values, strict=True)
    ]
    known = parameters.with_free(free)
    description = {key: plain(system.description[key]) for key in ("arms", "measurements", "statics")}
    record = made_record(description, entries, known.coordinate_names)
    return Calibration(system, parameters.with_nominal(np.array(values)), record)


def written(calibration: Calibration, path: Path) -> Path:
    """The calibration as a file."""
    path.write_text(sealed(calibration.record.to_config()), encoding="utf-8")
    return path


def _moved(parameters, random: np.random.Generator) -> list[float]:
    values: list[float] = []
    for block in parameters.blocks:
        if block.size == 6 and block.unit == "rad_per_Nm":
            root = random.normal(size=(3, 3)) * np.sqrt(_COMPLIANCE / 3)
            matrix = root @ root.T
            values += matrix[np.triu_indices(3)].tolist()
        elif block.unit == "rad_per_Nm":
            values.append(_COMPLIANCE * random.uniform(0.5, 1.5))
        elif "play" in block.name or "lag" in block.name or "tilt" in block.name:
            values.append(abs(random.normal(0, 0.004)))
        elif block.size == 1 and block.name.partition(".")[0] != "statics":
            values.append(block.nominal[0] + random.normal(0, _MOVES.get(block.unit, 0.0)))
        else:
            values += list(block.nominal)
    return values
