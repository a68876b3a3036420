"""A survey: an arm sampled over joint space, mapped cell by cell, and looked at in the areas that matter."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import casadi as ca
import numpy as np
from armcal.arm.model import forward
from armcal.base.arrays import Array
from armcal.errors import ProblemError
from armcal.estimate.estimator import Progress, no_progress
from armcal.functions.batch_function import EvaluatorChoice

from armcal_capability.accuracy import Unexplained, unexplained, with_accuracy
from armcal_capability.cells import AreaMap, AreaSearch, Voxels, voxels_of
from armcal_capability.mechanics import MechanicsFunction
from armcal_capability.quantities import Postures, Weights, postures_at
from armcal_capability.settings import CapabilitySettings
from armcal_capability.subject import Subject

WORTH_COMPILING = 20_000
"""From this many postures on, waiting for the compiler costs less than CasADi's interpreter does."""
MOST_ACROSS = 2000
"""Cells of the map from side to side: a section through it is drawn as a grid of so many by so many."""
MOST_IN_AREA = 500_000
"""Cells of an area: each is searched for."""


@dataclass(frozen=True)
class Survey:
    """What an arm can do.

    Attributes:
        subject: the arm.
        drawn: postures that were drawn.
        clear: of which keep their clearance.
        unsettled: of which have no elastic equilibrium.
        postures: the rest.
        voxels: the map.
        areas: by name.
        unexplained: what the calibration's records leave; None where that is not known.
        outline: the arm's joints and tool at half of its travel (points x 3; m, base frame).
    """

    subject: Subject
    drawn: int
    clear: int
    unsettled: int
    postures: Postures
    voxels: Voxels
    areas: Mapping[str, AreaMap]
    unexplained: Unexplained | None
    outline: Array = field(default_factory=lambda: np.zeros((0, 3)))


def survey(subject: Subject, settings: CapabilitySettings, progress: Progress = no_progress) -> Survey:
    """Survey an arm.

    Raises:
        ConfigError: ``holding`` names a joint that the arm has not.
        ProblemError: no posture keeps its clearance, or none has an equilibrium; or there would be too many cells.
    """
    choice: EvaluatorChoice = "compiled" if settings.samples >= WORTH_COMPILING else "interpreted"
    weights = Weights(subject.slides, settings.length, subject.holding(settings.holding))
    progress("sampling", 0.0)
    _require_few_cells(settings)
    function = MechanicsFunction(subject.expression, settings.loads, choice)
    commands = spread(subject.limits, settings.samples, settings.seed)
    commands = commands[:, subject.allowed(commands)]
    _require(commands.size > 0, f"none of {settings.samples} postures keeps its clearance.", "Check plan.clearance.")
    progress("postures", 0.2)
    postures = postures_at(function, commands, weights)
    _require(
        len(postures) > 0,
        "no posture has an elastic equilibrium under the load.",
        "Check the payload and the force, their units, and the compliances.",
    )
    across = float(np.ptp(postures.positions, axis=0).max()) / settings.voxel
    _require(
        across <= MOST_ACROSS,
        f"the map would have {across:.0f} cells from side to side, expected {MOST_ACROSS} at most.",
        f"Make capability.voxel_mm {1000 * settings.voxel * across / MOST_ACROSS:.2g} or larger.",
    )
    search = AreaSearch(function, subject.limits, subject.allowed, weights, postures)
    progress("areas", 0.5)
    areas = {name: search(area, settings.voxel, settings.postures) for name, area in settings.areas.items()}
    progress("accuracy", 0.7)
    postures = with_accuracy(postures, subject, choice)
    progress("cells", 0.9)
    return Survey(
        subject=subject,
        drawn=settings.samples,
        clear=commands.shape[1],
        unsettled=commands.shape[1] - len(postures),
        postures=postures,
        voxels=voxels_of(postures, settings.voxel),
        areas=areas,
        unexplained=None if subject.calibration is None else unexplained(subject.calibration),
        outline=outline(subject),
    )


def spread(limits: Array, count: int, seed: int) -> Array:
    """So many commands (joints x count) between limits (joints x 2), by a scrambled Sobol sequence.

    More of them begin with the same ones; the same seed gives the same.
    """
    from scipy.stats import qmc

    drawn = qmc.Sobol(len(limits), rng=seed).random_base2(max(0, math.ceil(math.log2(count))))[:count]
    return (limits[:, 0] + drawn * (limits[:, 1] - limits[:, 0])).T.copy()


def outline(subject: Subject) -> Array:
    """Mount, joints and tool, at the middle of the limits (points x 3; m): rigid, nominal."""
    chain = subject.arm.nominal_chain
    commands = subject.arm.joint_commands(subject.limits.mean(axis=1).tolist())
    frames = forward(chain, [joint.offset + ca.SX(commands[i]) for i, joint in enumerate(chain.joints)], {})
    points = [site.origin for site in frames.sites] + [frames.base_T_tool.translation]
    return np.array([np.asarray(ca.evalf(ca.densify(ca.SX(point))).full()).ravel() for point in points])


def _require_few_cells(settings: CapabilitySettings) -> None:
    for name, area in settings.areas.items():
        cells = float(np.prod(np.ceil(np.subtract(area.high, area.low) / settings.voxel)))
        _require(
            cells <= MOST_IN_AREA,
            f"the area {name} would have {cells:.3g} cells, expected {MOST_IN_AREA} at most.",
            "Make capability.voxel_mm larger, or the area smaller; check their units.",
        )


def _require(holds: bool, message: str, hint: str) -> None:
    if not holds:
        raise ProblemError(message, hint=hint)
