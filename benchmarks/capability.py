"""200,000 postures of the elastic arm, all that is mapped of them, against plain numpy with finite differences."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from armcal.base.arrays import Array
from armcal.config.yaml_source import load_config
from armcal_capability.loading import load_task
from armcal_capability.mechanics import MechanicsFunction
from armcal_capability.quantities import Postures, Weights, postures_at
from armcal_capability.settings import LoadSettings
from armcal_capability.survey import spread

from benchmarks import lrm, lrm_numpy
from benchmarks.report import Row
from benchmarks.timing import best_times

NAME = "capability map"
POSTURES = 200_000
_STEP = 1e-6
_BLOCK = 20_000


def run() -> Iterator[Row]:
    """Rows of this benchmark."""
    overrides = (f"capability.values={lrm.CONFIGS / 'truth.yaml'}", "plan.clearance=null")
    subject = load_task(lrm.CONFIGS / "plan.yaml", overrides=overrides).subject
    commands = spread(subject.limits, POSTURES, 0)
    function = MechanicsFunction(subject.expression, LoadSettings.si(payload=0.1), "compiled")
    weights = Weights(subject.slides, 0.1, subject.holding({"q4": 0.28}))
    found: dict[str, Postures] = {}
    by_hand: dict[str, Array] = {}

    def ours() -> None:
        found["ours"] = postures_at(function, commands, weights)

    def numpy_way() -> None:
        by_hand["sag"], by_hand["smallest"] = _by_hand(commands)

    times = best_times({"ours": ours, "numpy": numpy_way}, repeats=2)
    values = found["ours"].values
    apart = np.abs(values["sag_mm"] - 1000 * by_hand["sag"]).max()
    note = (
        f"sag agrees to {apart:.1g} mm; armcal's time is for all quantities ({len(values)}, under a payload too), the "
        f"peer's for sag and singular values alone"
    )
    work = f"{POSTURES:,} postures, all quantities"
    yield Row(NAME, work, times["ours"], "numpy, finite differences", times["numpy"], note, POSTURES)


def _by_hand(commands: Array) -> tuple[Array, Array]:
    """Sag (m) and the smallest singular value of the position's slope (m/rad) in every posture."""
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
        parts.append((sag, np.linalg.svd(np.stack(slopes, axis=2), compute_uv=False)[:, -1]))
    return np.concatenate([sag for sag, _ in parts]), np.concatenate([smallest for _, smallest in parts])


def _slope(p: lrm_numpy.Numbers, angles: Array, state: Array, joint: int) -> Array:
    step = np.zeros(6)
    step[joint] = _STEP
    ends = [lrm_numpy.tip(p, angles + sign * step, state.copy()) for sign in (1, -1)]
    return np.asarray((ends[0] - ends[1]) / (2 * _STEP))
