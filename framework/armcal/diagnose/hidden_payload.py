"""How large a payload may hang at the tool that nobody stated, and no residual shows it: springs take it up."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from armcal.base.dataset import Dataset
from armcal.diagnose.fit_rows import FitRows
from armcal.diagnose.noise_findings import Finding, first_few
from armcal.estimate.estimator import Estimate
from armcal.problem.motion import LOADS, Motion
from armcal.problem.problem import FactorRecords, Problem

_HIDDEN = 0.5
"""Where more than this share of what a payload does is left, the score tests of unstated loads see it."""
_LEAST_SHARE = 0.1
"""A parameter that takes up less of it is not named."""
_MOST_NAMED = 3


@dataclass(frozen=True)
class HiddenPayload:
    """A mass at the payload's place.

    Attributes:
        sd: its standard deviation if it were free beside the parameters and their priors (kg).
        taken_up: the share of what it does to the residuals that parameters make up for.
        by: those that make up most of it, the first most.
    """

    sd: float
    taken_up: float
    by: tuple[str, ...]


def hidden_payload(
    problem: Problem, records: Sequence[FactorRecords], estimate: Estimate, dataset: Dataset, motion: Motion
) -> HiddenPayload | None:
    """By a fit's weighted training records; None where no payload moves the arm, or records or parameters state it."""
    is_free = any("payload" in block.name for block in problem.parameters.free)
    if not motion.by_load or is_free or any(name.startswith("payload") for name in dataset.channels):
        return None
    rows, at = FitRows.of(problem, records, estimate), LOADS.index("mass")
    mass = rows.columns([slope[:, at, :, None] for slope in motion.by_load])[:, 0]
    sizes = np.linalg.norm(rows.slopes, axis=0)
    shares = np.linalg.lstsq(rows.slopes / np.maximum(sizes, 1e-300), mass, rcond=1e-9)[0]
    left = float(np.linalg.norm(mass - rows.slopes / np.maximum(sizes, 1e-300) @ shares))
    whole = float(np.linalg.norm(mass))
    if not whole or left > _HIDDEN * whole:
        return None
    names = problem.parameters.coordinate_names
    most = [i for i in np.argsort(-np.abs(shares[: len(names)])) if abs(shares[i]) > _LEAST_SHARE * whole]
    return HiddenPayload(estimate.noise_scale / max(left, 1e-300), 1 - left / whole, tuple(names[i] for i in most))


def hidden_payload_findings(hidden: HiddenPayload | None) -> list[Finding]:
    """What the verdict says of it."""
    if hidden is None:
        return []
    text = (
        f"A payload of up to {2000 * hidden.sd:.2g} g that hangs at the tool without being stated would not show: "
        f"{first_few(hidden.by, _MOST_NAMED)} would take up {100 * hidden.taken_up:.0f} % of what it does."
    )
    test = "two standard deviations of a mass beside the free parameters"
    return [Finding("note", text, test, "Weigh what hangs on the tool, and state it: statics.payload_g.")]
