"""Mechanics of 200,000 postures of the elastic arm: place, slopes, sag, deflection, torques; against plain numpy."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from armcal.base.arrays import Array
from armcal.config.yaml_source import load_config
from armcal.plugins import discover
from armcal_capability.capability import LoadSettings, Mechanics, MechanicsFunction, load_task, quantities, spread

from benchmarks import lrm, lrm_numpy
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "capability"
POSTURES = 200_000
_STEP = 1e-6
_BLOCK = 20_000


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    overrides = (f"capability.values={lrm.CONFIGS / 'truth.yaml'}", "plan.clearance=null")
    (design,) = load_task(lrm.CONFIGS / "capability.yaml", None, overrides, discover()).designs.values()
    commands, holding = spread(design.limits, POSTURES, 0), np.array([np.inf] * 3 + [0.28] + [np.inf] * 2)
    function = MechanicsFunction(design.expression, LoadSettings.si(payload=0.1), "compiled")
    found: dict[str, tuple[Mechanics, dict[str, Array]]] = {}
    by_hand: dict[str, Array] = {}

    def ours() -> None:
        mechanics = function(commands)
        found["ours"] = mechanics, quantities(function, commands, mechanics, holding)

    def numpy_way() -> None:
        by_hand["sag"], by_hand["slopes"] = _by_hand(commands)

    times = best_times({"ours": ours, "numpy": numpy_way}, repeats=2)
    apart = np.abs(found["ours"][1]["sag_mm"] - 1000 * by_hand["sag"]).max()
    note = (
        f"sag agrees to {apart:.1g} mm; armcal's time is for torques and a payload too, the peer's for sag and slopes"
    )
    work = f"{POSTURES:,} postures: place, slopes, sag, deflection, torques"
    yield Row(NAME, work, times["ours"], "numpy, finite differences", times["numpy"], note, POSTURES)


def _by_hand(commands: Array) -> tuple[Array, Array]:
    """Sag (m; N) and the position's slopes by the commands (N x 3 x 6; m/rad) in every posture."""
    values = {name.rpartition(".")[2]: text for name, text in load_config(lrm.CONFIGS / "truth.yaml").data.items()}
    p = lrm_numpy.NOMINAL | {name: float(str(text).split()[0]) for name, text in values.items()}
    stiff = p | {f"k{i}": 0.0 for i in range(7)}
    parts = []
    for start in range(0, commands.shape[1], _BLOCK):
        angles = commands[:, start : start + _BLOCK].T
        state = np.zeros((len(angles), 7))
        tip = lrm_numpy.tip(p, angles, state)
        sag = np.linalg.norm(tip - lrm_numpy.tip(stiff, angles, np.zeros_like(state)), axis=1)
        slopes = [_slope(p, angles, state, joint) for joint in range(6)]
        parts.append((sag, np.stack(slopes, axis=2)))
    return np.concatenate([sag for sag, _ in parts]), np.concatenate([slopes for _, slopes in parts])


def _slope(p: lrm_numpy.Numbers, angles: Array, state: Array, joint: int) -> Array:
    step = np.zeros(6)
    step[joint] = _STEP
    ends = [lrm_numpy.tip(p, angles + sign * step, state.copy()) for sign in (1, -1)]
    return np.asarray((ends[0] - ends[1]) / (2 * _STEP))
