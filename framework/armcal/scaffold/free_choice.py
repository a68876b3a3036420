"""Which parameters of a new robot to free: all that its poses determine, and none that another one stands in for."""

from __future__ import annotations

import fnmatch
from dataclasses import dataclass

from armcal.diagnose.minimal import minimal_set
from armcal.problem.projection import factor_at_zero
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble
from armcal.scaffold.robot import Robot

MOST_UNCERTAIN = 0.5
"""In typical scales: what the declared noise leaves less certain than this is held."""


@dataclass(frozen=True)
class FreeChoice:
    """Names to free, names that these stand in for, names that the data hardly determines."""

    kept: tuple[str, ...]
    redundant: tuple[str, ...]
    left_out: tuple[str, ...]


def choose_free(experiment: Experiment, robot: Robot) -> FreeChoice:
    """A minimal set of the experiment's free parameters, for its training records (see ``armcal identify``)."""
    ready = assemble(experiment, Stopwatch())
    parameters = ready.problem.parameters
    triangle = factor_at_zero(ready.problem, parameters.nominal(), ready.training)
    free = [block.name for block in parameters.free]
    preferred = [
        [name for name in free if any(fnmatch.fnmatchcase(name, glob) for glob in globs)] for globs in robot.preferred
    ]
    minimal = minimal_set(triangle, parameters, preferred, most_uncertain=MOST_UNCERTAIN)
    return FreeChoice(
        minimal.kept,
        tuple(dropped.name for dropped in minimal.redundant),
        tuple(dropped.name for dropped in minimal.left_out),
    )
