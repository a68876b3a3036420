"""Small arms for compensation, each calibrated without a run: their configurations, and what they are made into."""

from __future__ import annotations

import tempfile
from functools import cache
from pathlib import Path

import numpy as np
from armcal.base.dataset import Dataset
from armcal.calibration.calibration import Calibration
from armcal.calibration.compensation import Compensator, Options
from made_calibrations import made_calibration

CONFIGS = Path(__file__).resolve().parents[1] / "configs"
_REST = """
statics: {gravity_m_s2: [0, 0, -9.81], body: earth, payload_g: 0}
measurements: {tracker: {type: tip_position, noise_mm: 0.5}}
estimator: {type: ipopt}
"""
_TABLE = "angles_deg: [-100, 0, 100], pulses_us"
_QUANTISED = "quantisation: {type: quantisation, tables: {%s}}"
_THREE = """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{a_mm: 60, alpha_deg: 90}, {a_mm: 200}, {a_mm: 150}]}
    effects: {%s}
    links: {forearm: {mass_g: 100, com_mm: [0, 0, 0], frame: row2}, hand: {mass_g: 50, com_mm: [0, 0, 0], frame: tool}}
"""
_SPRING = "spring: {type: torsional_spring}"
_RISING, _FALLING = f"{{{_TABLE}: [620, 1540, 2460]}}", f"{{{_TABLE}: [2460, 1500, 620]}}"

TEXTS = {
    "three": _THREE % _SPRING,
    "rigid": _THREE % "",
    "play": _THREE % f"{_SPRING}, lag: {{type: approach_backlash}}, servo: {{type: servo_map, gains: two}}",
    "warm": _THREE % "heat: {type: thermal_length}",
    "servos": _THREE % f"{_SPRING}, {_QUANTISED % f'q1: {_RISING}, q2: {_FALLING}, q3: {_RISING}'}",
    "mixed": _THREE % f"{_SPRING}, {_QUANTISED % f'q1: {_RISING}, q3: {_FALLING}'}",
    "one": f"""
arms:
  arm:
    model: {{type: mdh, convention: standard, rows: [{{a_mm: 200}}]}}
    effects: {{{_QUANTISED % f"q1: {_RISING}"}}}
""",
    "two_links": """
arms:
  arm:
    model: {type: mdh, convention: standard, rows: [{a_mm: 600}, {a_mm: 200}]}
    effects: {spring: {type: torsional_spring}}
    links: {hand: {mass_g: 50, com_mm: [0, 0, 0], frame: tool}}
""",
    "ten": f"""
arms:
  arm:
    model:
      type: mdh
      convention: standard
      rows: [{{a_mm: 20, alpha_deg: 90}}, {{a_mm: 200}}, {", ".join(["{a_mm: 150}"] * 8)}]
    effects: {{{_QUANTISED % f"q1: {_RISING}, q3: {_FALLING}"}}}
""",
    "five": f"""
arms:
  arm:
    model:
      type: mdh
      convention: standard
      rows: [{{d_mm: 80, alpha_deg: 90}}, {{a_mm: 150}}, {{a_mm: 120, alpha_deg: 20}}, {{alpha_deg: 90}}, {{d_mm: 60}}]
    effects: {{{_SPRING}}}
    links: {{hand: {{mass_g: 80, com_mm: [0, 0, 0], frame: tool}}}}
""",
    "lift": """
arms:
  arm:
    placement: {position_mm: [300, -100, 50], rpy_deg: [10, -20, 130]}
    model:
      type: poe
      joints:
        - {name: column, kind: revolute, axis: [0, 0, 1], point_m: [0, 0, 0]}
        - {name: lift, kind: prismatic, axis: [0, 0.6, 0.8], offset_mm: 20}
        - {name: elbow, kind: revolute, axis: [1, 0, 0], point_m: [0, 0.1, 0.4], offset_deg: -30}
      tool: {position_m: [0.05, 0.3, 0.5], rpy_deg: [0, 90, 10]}
      mount: {position_m: [0, 0, 0.1]}
    effects: {give: {type: torsional_spring}}
""",
}
FILES = {
    "lrm": CONFIGS / "lrm_arm" / "arm.yaml",
    "best": CONFIGS / "lrm_arm" / "best.yaml",
    "seven": CONFIGS / "ball" / "demo.yaml",
}
LRM_LIMITS = {f"q{i}": (-np.radians(d), np.radians(d)) for i, d in enumerate((100, 50, 100, 100, 100, 50), start=1)}


@cache
def calibration(name: str, *overrides: str) -> Calibration:
    """One of the arms above."""
    if name in FILES:
        return made_calibration(FILES[name], overrides)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / f"{name}.yaml"
        path.write_text(TEXTS[name] + _REST, encoding="utf-8")
        return made_calibration(path, overrides)


@cache
def compensator(name: str) -> Compensator:
    """Of one of the arms above with ordinary options; built once, and never compiled."""
    limits = LRM_LIMITS if name in ("lrm", "best") else {}
    return with_options(name, Options(limits=limits))


def with_options(name: str, options: Options, **parts) -> Compensator:
    """Of one of the arms above with options of its own."""
    return calibration(name).compensator(options=options, choice="interpreted", **parts)


def drawn(found: Compensator, count: int, seed: int = 1, widest: float = 1.5) -> np.ndarray:
    """Commands within the limits (count x n; rad or m), and within so much of zero."""
    low, high = np.clip(found.limits, -widest, widest).T
    return np.random.default_rng(seed).uniform(low, high, (count, len(low)))


def predicted(found: Calibration, commands: np.ndarray, arm: str = "arm", **channels) -> np.ndarray:
    """base_T_tool (N x 4 x 4) by the calibration's own prediction, which shares no function with compensation."""
    joints = tuple(found.system.arms[arm].commanded)
    columns = {f"{arm}.{joint}": commands[:, i] for i, joint in enumerate(joints)}
    columns |= {name: np.broadcast_to(values, len(commands)) for name, values in channels.items()}
    return found.predict(Dataset(tuple(map(str, range(len(commands)))), columns))[1][0]


def exact(found: Compensator, commands: np.ndarray, acting: np.ndarray) -> np.ndarray:
    """base_T_tool (N x 4 x 4) where joints stand at commands to the last digit, as no board sets them."""
    record, joints = found.expression.records(commands.T), len(found.joints)
    record[2 * joints : 2 * joints + len(acting)] = acting
    return found._equilibrium.required(record)
