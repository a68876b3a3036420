"""Starts that measurements find by themselves, from what they read: a camera's intrinsics and hand-eye pose."""

from collections.abc import Sequence
from dataclasses import replace

import casadi as ca
import numpy as np

from armcal.arm.effects import JointCommand
from armcal.arm.model import forward
from armcal.arm.statics import BASE_FRAME, TOOL_FRAME
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.base.parameters import ParameterBlock
from armcal.errors import Location, ProblemError
from armcal.estimate.start import BETTER, Start
from armcal.measure.measurement import Carried, borrowed_names
from armcal.measure.points import Certifying, Proposing, Reading
from armcal.problem.problem import FactorRecords, Problem

_TOOL_ROWS = 12


def with_proposals(start: Start, records: Sequence[FactorRecords], dataset: Dataset) -> Start:
    """The start with what measurements propose, where it is much nearer than the configuration.

    A parameter with a prior keeps its nominal value, and starts where it was proposed.

    Raises:
        NotConvergedError: a record has no elastic equilibrium at the nominal values.
        ProblemError: the records leave free parameters open that nothing else holds.
    """
    measurements = [start.problem.blueprint.measurements[kernel.factor.name] for kernel in start.problem.kernels]
    lenders_first = sorted(enumerate(measurements), key=lambda numbered: bool(borrowed_names(numbered[1])))
    for number, measurement in lenders_first:
        if isinstance(measurement, Proposing):
            start = _with_proposal(start, records, dataset, number, measurement)
    return start


def _with_proposal(
    start: Start, records: Sequence[FactorRecords], dataset: Dataset, number: int, measurement: Proposing
) -> Start:
    problem, name = start.problem, start.problem.kernels[number].factor.name
    parameters, nominal = problem.parameters, problem.parameters.nominal()
    before = start.vectors[0] if start.vectors else nominal
    own = _own(problem, name)
    proposal = measurement.propose(_reading(problem, nominal, before, records, dataset, number))
    if any(own[local].prior_sd is None for local in proposal.undetermined):
        hint = f"{proposal.close} Or give priors, or hold {', '.join(proposal.undetermined)}."
        raise ProblemError(f"{name}: {proposal.open}", where=Location(dataset.source or None), hint=hint)
    if not proposal.values:
        return start
    vector, moved = before.copy(), nominal.copy()
    for local, value in proposal.values.items():
        place = parameters.entries_of(own[local].name)
        vector[place] = value
        if own[local].prior_sd is None:
            moved[place] = value
    configured, left = (_typical(problem, values, records, number) for values in (nominal, vector))
    if left * BETTER > configured:
        return start
    names = tuple(own[local].name for local in proposal.values)
    placed = replace(problem, parameters=parameters.with_nominal(moved))
    vectors = (vector, *start.vectors)
    return replace(
        start,
        problem=placed,
        names=(*start.names, *names),
        vectors=vectors,
        configured=configured,
        left=left,
        taken=True,
    )


def certificates(problem: Problem, values: Array, records: Sequence[FactorRecords], dataset: Dataset) -> dict[str, str]:
    """What measurements show of whether another answer could be better, sentences by their names."""
    sentences = {}
    for number, kernel in enumerate(problem.kernels):
        measurement = problem.blueprint.measurements[kernel.factor.name]
        if isinstance(measurement, Certifying):
            reading = _reading(problem, values, values, records, dataset, number)
            sentences[kernel.factor.name] = measurement.certificate(reading)
    return {name: text for name, text in sentences.items() if text}


def _own(problem: Problem, name: str) -> dict[str, ParameterBlock]:
    """Parameters of a measurement by local name."""
    blocks = problem.parameters.blocks
    return {b.name.removeprefix(f"{name}."): b for b in blocks if b.name.startswith(f"{name}.")}


def _reading(
    problem: Problem, own_values: Array, values: Array, records: Sequence[FactorRecords], dataset: Dataset, number: int
) -> Reading:
    """What a measurement read; arm and borrowed parameters are at ``values``, its own at ``own_values``."""
    name, parameters = problem.kernels[number].factor.name, problem.parameters
    own, lent = _own(problem, name), borrowed_names(problem.blueprint.measurements[name])
    borrowed = {local: values[parameters.entries_of(full)] for local, full in lent.items()}
    seen = np.flatnonzero(records[number].measured)
    return Reading(
        carriers_of(problem, values, problem.subset(records, seen), dataset.subset(seen), number),
        {c.removeprefix(f"{name}."): dataset.column(c)[seen] for c in problem.kernels[number].factor.output_channels},
        {**{local: own_values[parameters.entries_of(block.name)] for local, block in own.items()}, **borrowed},
        frozenset(local for local, block in own.items() if block.free),
    )


def carriers_of(
    problem: Problem, values: Array, records: Sequence[FactorRecords], dataset: Dataset, number: int
) -> dict[str, Array]:
    """What carries a measurement in each record (base_T_frame, N x 4 x 4, m): the tool, or frames of a still arm."""
    plan = problem.blueprint
    measurement = plan.measurements[problem.kernels[number].factor.name]
    frames = {BASE_FRAME: np.tile(np.eye(4), (len(dataset), 1, 1))}
    for name in set(measurement.carriers.values()) if isinstance(measurement, Carried) else {TOOL_FRAME}:
        is_tool = name == TOOL_FRAME
        frames[name] = (
            _tools(problem, values, records, number)
            if is_tool
            else _frame(problem, values, dataset, measurement.arms[0], name)
        )
    return frames


def _frame(problem: Problem, values: Array, dataset: Dataset, of: str, name: str) -> Array:
    """A frame of a still arm in each record (base_T_frame, N x 4 x 4, m)."""
    arm, parameters = problem.blueprint.arms[of], problem.parameters
    stated = {name: ca.SX(values[parameters.entries_of(name)]) for name in parameters.names}
    chain, symbols = arm.chain(stated), ca.SX.sym("commands", len(arm.commanded))
    joint_commands = [JointCommand(i, q, ca.SX(0)) for i, q in enumerate(arm.joint_commands(ca.vertsplit(symbols)))]
    moved = [joint.offset + arm.displacement(stated, q) for joint, q in zip(chain.joints, joint_commands, strict=True)]
    pose = ca.densify(forward(chain, moved, {}).named[name].matrix())
    commands = dataset.stacked([f"{arm.name}.{joint}" for joint in arm.commanded])
    shown = ca.Function("carrier", [symbols], [pose]).map(len(dataset))(commands).full()
    return np.asarray(shown.reshape(4, -1, 4).transpose(1, 0, 2))


def _tools(problem: Problem, values: Array, records: Sequence[FactorRecords], number: int) -> Array:
    """base_T_tool of each record (N x 4 x 4, m)."""
    first = len(problem.kernels[number].factor.output_channels)
    shown = problem.grouped[number].predict(values, records[number])[:, : records[number].count]
    tools = np.tile(np.eye(4), (records[number].count, 1, 1))
    tools[:, :3] = shown[first : first + _TOOL_ROWS].reshape(4, 3, -1).transpose(2, 1, 0)
    return tools


def _typical(problem: Problem, values: Array, records: Sequence[FactorRecords], number: int) -> float:
    """The median error of what one measurement read, of the records in which it did."""
    points = records[number].points_of(problem.kernels[number].factor) * records[number].measured
    squares = np.sum(problem.residuals(values, records)[number] ** 2, axis=0)[points > 0]
    errors = np.sqrt(squares / points[points > 0])
    return float(np.median(np.where(np.isfinite(errors), errors, np.inf))) if len(errors) else np.inf
