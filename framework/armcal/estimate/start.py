"""Where a fit starts: the base and the target as the records have them, where the configuration has them elsewhere."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy.spatial.transform import Rotation

from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.errors import NotConvergedError
from armcal.estimate.placing import Placing, placings
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.rigid_alignment import Alignment, Tools, alignments, hand_eye, undetermined
from armcal.problem.sighting import Sighting, sighting_of, tools_of

MOST_RECORDS = 300
FAR = 0.03
"""Of the spread of the positions: a start that is off by less is near enough for any fit."""
BETTER = 2.0
"""So many times less must be left for the configuration's start to be given up."""
BEYOND = 4.0
"""Standard deviations of a prior: what is farther contradicts it."""
_MM = 1000.0


@dataclass(frozen=True)
class Start:
    """Where a fit starts.

    Attributes:
        problem: its nominal values are where base and target were found, where the configuration's are far off.
        names: of the parameters that place the arm and the target.
        vectors: values at which they were found, the best first; other parameters are not theirs to say. Those with a
            prior keep their nominal value in ``problem``, and start where they were found.
        alignment: of the nominal arm; None where there is none.
        tools: of the nominal arm as configured, in the records looked at.
        configured, left: typical distance (m) of the arm from the positions, before and after.
        taken: whether the start is elsewhere than the configuration has it.
        gauges: what the positions do not determine of base and target, in words.
        warnings: for the user.
    """

    problem: Problem
    names: tuple[str, ...] = ()
    vectors: tuple[Array, ...] = ()
    alignment: Alignment | None = None
    configured: float = 0.0
    left: float = 0.0
    taken: bool = False
    gauges: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def values(self, problem: Problem) -> tuple[Array, ...]:
        """Where fits of a problem with these parameters may start, the first of them the likeliest."""
        starts, parameters = list[Array](), problem.parameters
        for vector in self.vectors:
            values = parameters.nominal()
            for name in self.names:
                values[parameters.entries_of(name)] = vector[parameters.entries_of(name)]
            starts.append(values)
        return tuple(starts) if self.taken else (parameters.nominal(), *starts)


def aligned_start(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> Start:
    """The start that the records give: the configured one where nothing that may move is far off, or measured.

    Priors are kept: what has one is moved only within it, and is otherwise said to contradict the records.
    """
    nominal = problem.parameters.nominal()
    as_configured = Start(problem)
    try:
        sighting = _sighting(problem, records, dataset)
        if sighting is None:
            return as_configured
        placing, held = placings(problem, records, sighting)
        tools = tools_of(problem, nominal, problem.subset(records, sighting.chosen)[sighting.kernel], sighting.kernel)
        if not held.stands_anywhere:
            return as_configured
        chosen = placing if placing.stands_anywhere else held
        ranked = alignments(tools, sighting.measured, chosen.basis, sighting.turned)
        return _chosen(problem, records, sighting, tools, chosen, ranked) if ranked else as_configured
    except NotConvergedError:
        return as_configured


def _sighting(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> Sighting | None:
    """Of the measurement with most records; None where several arms share a frame, or none is seen."""
    arms = {name for measurement in problem.blueprint.measurements.values() for name in measurement.arms}
    if len(arms) != 1 or not problem.increments:
        return None
    numbers = range(len(problem.kernels))
    seen = [sighting_of(problem, records, dataset, number, MOST_RECORDS) for number in numbers]
    return max((s for s in seen if s is not None), key=lambda s: len(s.chosen), default=None)


def _chosen(
    problem: Problem,
    records: Sequence[FactorRecords],
    sighting: Sighting,
    tools: Tools,
    placing: Placing,
    ranked: Sequence[Alignment],
) -> Start:
    """The best alignment that the free parameters reach, if it is much better than the configuration."""
    configured, some = sighting.off(tools), problem.subset(records, sighting.chosen)[sighting.kernel]
    gauges = undetermined(tools, ranked[0], placing.basis)
    start = Start(problem, placing.names, (), ranked[0], configured, configured, False, gauges)
    if configured <= FAR * sighting.size:
        return start
    reached = [placing.reached(problem, records, sighting, shown_by(a, tools, sighting)) for a in ranked]
    left = [sighting.off(tools_of(problem, values, some, sighting.kernel)) for values in reached]
    order = np.argsort(left)
    best, start = reached[order[0]], replace(start, vectors=tuple(reached[i] for i in order))
    if min(left) * BETTER > configured:
        return start
    beyond = _beyond_priors(problem, best)
    if beyond:
        return replace(start, vectors=(), warnings=(_disagreement(beyond, configured, min(left)),))
    nominal, parameters = problem.parameters.nominal(), problem.parameters
    for name in (name for name in placing.names if parameters[name].prior_sd is None):
        nominal[parameters.entries_of(name)] = best[parameters.entries_of(name)]
    return replace(
        start, problem=replace(problem, parameters=parameters.with_nominal(nominal)), left=min(left), taken=True
    )


def shown_by(alignment: Alignment, tools: Tools, sighting: Sighting) -> Tools:
    """What the instrument sees of the nominal arm that stands there, its body mounted as it was measured."""
    turned = alignment.turn @ tools.rotations
    if sighting.turned is not None:
        turned = turned @ hand_eye(tools.rotations, sighting.turned)[1]
    return Tools(alignment.moved(tools), turned)


def _beyond_priors(problem: Problem, values: Array) -> list[tuple[str, float]]:
    """Parameters that are farther from their nominal values than their priors allow, in standard deviations."""
    parameters = problem.parameters
    moved = parameters.coordinates(parameters.local(values))
    deviations = np.array([b.prior_sd or np.inf for b in parameters.free for _ in range(b.domain.dof)])
    times = np.abs(moved) / deviations
    return [(parameters.coordinate_names[i], float(times[i])) for i in np.argsort(-times) if times[i] > BEYOND]


def _disagreement(beyond: Sequence[tuple[str, float]], configured: float, left: float) -> str:
    named = ", ".join(f"{name} ({times:.0f} standard deviations)" for name, times in beyond[:3])
    return (
        f"The records place the arm's base or the target elsewhere than the configuration does: {named} from its "
        f"prior. There the nominal arm would be typically {left * _MM:.3g} mm off, where the configuration has it "
        f"{configured * _MM:.3g} mm off. The fit starts from the configuration. Correct the values or the frame of the "
        "measurements, or leave the priors out: then base and target are found."
    )


def pose_words(alignment: Alignment) -> str:
    """Where the base frame stands in the instrument's, as people read it."""
    x, y, z = alignment.shift * _MM
    roll, pitch, yaw = Rotation.from_matrix(alignment.turn).as_euler("xyz", degrees=True)
    return f"({x:.1f}, {y:.1f}, {z:.1f}) mm, roll, pitch, yaw ({roll:.2f}, {pitch:.2f}, {yaw:.2f}) deg"
