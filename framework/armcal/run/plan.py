"""A pose plan: which poses to measure, how good they are, how good any could be, and in which order to visit them."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.errors import ProblemError
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import Identifiability, analyse, measures_of
from armcal.planning.candidates import Candidates, deviations, whitened_rows
from armcal.planning.criterion import Observability, criterion, observability
from armcal.planning.exchange import Allowed, Plan, choose, refine, value_of
from armcal.planning.relaxation import Task
from armcal.run.experiment import Experiment
from armcal.run.plan_approaches import (
    PLANNED,
    approach_channels,
    come_from_both_sides,
    depends_on_approach,
    reachable,
    with_approaches,
    with_poses_between,
)
from armcal.run.plan_context import (
    PlanContext,
    as_if_measured,
    in_order_of_visit,
    parameters_of,
    plan_context,
    problem_of,
)
from armcal.run.plan_poses import (
    JointSpace,
    Pool,
    clearance_of,
    counts_text,
    dataset_of,
    given_records,
    pool_of,
    same_poses,
)
from armcal.run.settings import PlanSettings

_MORE = "Plan more poses, give the records that are there already (--given), or give priors."


@dataclass(frozen=True)
class Certificate:
    """The bound on the criterion of every plan from these candidates, and how near the plan comes."""

    bound: float
    efficiency: float


@dataclass(frozen=True)
class PlanResult:
    """A plan and what is known of it.

    Attributes:
        dataset: the poses in the order of visit, each with the approach that was planned, else that this order gives.
        pool: the candidates.
        given: how many records were there before.
        equations: how many residual numbers the plan and the records before give.
        value: of the criterion.
        log_det: log determinant of the information by coordinates in their typical scales, at the nominal values.
        certificate: None where the goal has none.
        observability: O1 to O5, of plan, records before and priors.
        names: of the coordinates.
        deviations: standard deviations before and after (2 x n, SI; infinite where undetermined).
        identifiability: after the plan.
        travel_s: of the whole visit.
        peak: of the moving average of squared holding torque beside the plan's largest; None where nothing is held.
        starts: of the exchange.
        refined: poses that were moved through joint space.
    """

    dataset: Dataset
    pool: Pool
    given: int
    equations: int
    value: float
    log_det: float
    certificate: Certificate | None
    observability: Observability
    names: tuple[str, ...]
    deviations: Array
    identifiability: Identifiability
    travel_s: float
    peak: float | None
    starts: int
    refined: int


def make_plan(
    experiment: Experiment,
    count: int,
    listed: Path | None = None,
    records: Path | None = None,
    calibration: Path | None = None,
    progress: Progress = no_progress,
) -> PlanResult:
    """Plan so many poses: of ``listed`` candidates or the configured ones, after ``records``, about a calibration.

    Raises:
        InputError: settings, candidates or records are refused, or so many poses cannot determine the parameters.
    """
    settings = experiment.settings.plan or PlanSettings()
    space = JointSpace.of(experiment)
    parameters = parameters_of(experiment, calibration)
    check = clearance_of(experiment)
    progress("candidates", 0.0)
    pool = pool_of(experiment, settings, space, listed, check)
    both = come_from_both_sides(pool, space, space.limits(settings), settings.seed)
    first = as_if_measured(experiment, both.dataset.subset([0]))
    pool = both if depends_on_approach(problem_of(experiment, parameters, first)) else pool
    given = None if records is None else given_records(experiment, records)
    if given is not None and settings.repeats == 1 and pool.kind != "continuous":
        again = same_poses(pool.dataset.stacked(space.channels), given.stacked(space.channels))
        pool = pool.without(again, "measured already")
    if len(pool.dataset) * settings.repeats < count:
        left_out = f" ({counts_text(pool.left_out)} left out)" if pool.left_out else ""
        raise ProblemError(
            f"found {len(pool.dataset)} candidates{left_out}, too few for {count} poses.",
            hint="Ask for fewer poses, give more candidates, or allow plan.repeats.",
        )
    context = plan_context(experiment, settings, space, parameters, given)
    progress("planning", 0.2)
    candidates = Candidates(context.base, context.rows(pool.dataset))
    task = Task(candidates, criterion(settings.goal), count, settings.repeats)
    plan, refined = _chosen(task, settings, parameters), 0
    if pool.kind == "continuous" and settings.sweeps:
        progress("refinement", 0.5)
        allowed = (lambda q: np.ones(q.shape[1], dtype=bool)) if check is None else check
        task, plan, pool, refined = _refined(context, task, plan, pool, allowed)
    progress("bound", 0.8)
    return _result(context, task, _between(context, task, plan, pool), pool, refined)


def _identifiability(task: Task, chosen: Indices, parameters: Parameters) -> Identifiability:
    names = parameters.coordinate_names
    return analyse(task.candidates.triangle(chosen), np.ones(len(names)), names, measures_of(parameters))


def _chosen(task: Task, settings: PlanSettings, parameters: Parameters) -> Plan:
    """The plan; refused where candidates, or so few of them, leave something open."""
    candidates = task.candidates
    most = _identifiability(task, np.arange(candidates.count), parameters)
    if most.undetermined:
        raise ProblemError(
            f"even all {candidates.count} candidates leave {len(most.undetermined)} combinations undetermined: "
            f"{'; '.join(str(combination) for combination in most.undetermined)}.",
            hint="Fix one parameter of each, give it a prior, or give other candidates.",
        )
    before = int(np.linalg.matrix_rank(candidates.base)) if candidates.base.size else 0
    numbers = task.count * candidates.rows.shape[0]
    if numbers < candidates.size - before:
        raise ProblemError(
            f"{task.count} poses give {numbers} equations, and {candidates.size - before} of {candidates.size} "
            "parameters are not determined yet.",
            hint=_MORE,
        )
    plan = choose(task, settings.starts, settings.seed)
    known = _identifiability(task, plan.chosen, parameters)
    if known.undetermined:
        raise ProblemError(
            f"{task.count} poses leave {len(known.undetermined)} combinations undetermined: "
            f"{'; '.join(str(combination) for combination in known.undetermined)}.",
            hint=_MORE,
        )
    return plan


def _refined(
    context: PlanContext, task: Task, plan: Plan, pool: Pool, allowed: Allowed
) -> tuple[Task, Plan, Pool, int]:
    """The chosen poses moved through joint space, and chosen again from all candidates and these."""
    space, limits = context.space, context.space.limits(context.settings)
    sides = approach_channels(space) if pool.dataset.has(approach_channels(space)[0]) else ()
    channels, count = (*space.channels, *sides), len(space.channels)
    before = pool.dataset.stacked(channels)[:, plan.chosen]
    limits = np.vstack([limits, np.tile([-1.0, 1.0], (len(sides), 1))])
    problem = problem_of(context.experiment, context.parameters, as_if_measured(context.experiment, pool.dataset))

    def dataset_at(poses: Array) -> Dataset:
        plain = dataset_of(poses[:count], space)
        return (
            with_approaches(plain, space, reachable(poses[:count], poses[count:], limits[:count])) if sides else plain
        )

    def rows(poses: Array) -> Array:
        return whitened_rows(
            problem, context.parameters.nominal(), as_if_measured(context.experiment, dataset_at(poses))
        )

    known, by = task.candidates.known(), task.criterion
    after = refine(before, limits, known, by, rows, lambda q: allowed(q[:count]), context.settings.sweeps)
    moved = np.flatnonzero(np.any(after != before, axis=0))
    if not len(moved):
        return task, plan, pool, 0
    number = task.candidates.count
    poses = np.concatenate([pool.dataset.stacked(channels), after[:, moved]], axis=1)
    pool = replace(pool, dataset=dataset_at(poses))
    together = np.concatenate([task.candidates.rows, rows(after[:, moved])], axis=1)
    task = replace(task, candidates=Candidates(context.base, together))
    begin = plan.chosen.copy()
    begin[moved] = number + np.arange(len(moved))
    plan = choose(task, 0, context.settings.seed, begin)
    return task, plan, pool, int(np.sum(plan.chosen >= number))


def _between(context: PlanContext, task: Task, plan: Plan, pool: Pool) -> Plan:
    """The plan with some poses between the levels of the others, where servos have play and poses can be anywhere."""
    space = context.space
    if pool.kind != "continuous" or not pool.dataset.has(approach_channels(space)[0]):
        return plan
    poses = pool.dataset.stacked(space.channels)
    chosen = with_poses_between(poses, space.limits(context.settings), plan.chosen)
    return replace(plan, chosen=chosen, value=value_of(task.candidates, task.criterion, chosen))


def _result(context: PlanContext, task: Task, plan: Plan, pool: Pool, refined: int) -> PlanResult:
    """A plan's figures; the relaxation bounds criteria that are sums over eigenvalues."""
    parameters, chosen = context.parameters, pool.dataset.subset(plan.chosen)
    certificate = None
    if task.criterion.trace is not None:
        bound = plan.relaxation.bound
        certificate = Certificate(bound, task.criterion.efficiency(plan.value, bound, task.candidates.size))
    measured = Task(Candidates(context.base, context.rows(chosen)), criterion("D"), task.count)
    everything = np.arange(task.count)
    triangle = measured.candidates.triangle(everything)
    given = 0 if context.given is None else len(context.given)
    equations = (task.count + given) * measured.candidates.rows.shape[0] + len(context.priors)
    dataset, seconds, hottest = in_order_of_visit(context, chosen, keeps_approaches=pool.kind in PLANNED)
    return PlanResult(
        dataset=dataset,
        pool=pool,
        given=given,
        equations=equations,
        value=plan.value,
        log_det=value_of(measured.candidates, measured.criterion, everything),
        certificate=certificate,
        observability=observability(np.linalg.svd(triangle, compute_uv=False).astype(float), equations),
        names=parameters.coordinate_names,
        deviations=np.array([deviations(part) for part in (context.base, triangle)]) * parameters.scales(),
        identifiability=_identifiability(measured, everything, parameters),
        travel_s=seconds,
        peak=hottest,
        starts=plan.starts,
        refined=refined,
    )
