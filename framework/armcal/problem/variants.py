"""A problem with other records, or with records that weigh otherwise.

Projected onto the model: what would have been measured had the values at hand been the truth. Rank is judged there.
Where a Jacobian depends on measured numbers (a bearing, a contact, a closed chain) their errors turn undetermined
directions into seemingly determined ones.

With other readings: a residual may have another order, sign or unit than its readings less their predictions, or as few
numbers as the rotation vector of a quaternion. What it means for the readings follows from its slope by them: the
smallest change of the readings, each in the size that noise gives it, that changes the residual so.

Correlated by parameters that drift over a recording. A drifting parameter is its value plus a stationary process whose
correlation falls by e over a stated distance in recorded order or time (Ornstein-Uhlenbeck [Rasmussen2006]), exactly so
at the records' own places. It is a covariance of the residuals: the values found stay those of the arm at rest, their
uncertainty counts the drift, and where records lie near others they determine the drift.

How an arm stands in each record (``Motion``): how its joints would move the residuals, and what its sites carry.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, SiteLoads, command_channels, site_loads
from armcal.arm.evaluator import Evaluator
from armcal.arm.pose_residual import CORRECTION, OF_TOOL, PoseResidual, Postures
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Drift, ParameterBlock
from armcal.errors import DataError, ProblemError
from armcal.measure.groups import OTHER
from armcal.measure.measurement import LimitedView, spread_points
from armcal.problem.factor import Factor
from armcal.problem.kernel import GroupedKernel, Kernel
from armcal.problem.problem import Problem
from armcal.problem.records import Correlation, FactorRecords, by_covariance, noise_roots, transformed, whitening_of

_MOST_STEPS = 12
_AT_ZERO = 1e-6  # In units of the noise: a residual below this is none


def projected(problem: Problem, values: Array) -> Problem:
    """The problem of records whose residuals are zero at these values, for judging rank.

    Measured numbers become what the model predicts; where nothing is measured but the joints (a contact), the joint
    angles move to the nearest ones that fit. A record that no angles fit is left as it is, and so are those, the same
    objects, that a Jacobian does not depend on that way.
    """
    shown = as_predicted(problem, values)
    return shown.with_records(
        [
            record if _measured(grouped.kernel.factor) else _fitting_joints(grouped, values, record)
            for grouped, record in shown.pairs
        ]
    )


def as_predicted(problem: Problem, values: Array) -> Problem:
    if not any(_bilinear(kernel.factor.expressed) for kernel in problem.kernels):
        return problem
    shown = zip(problem.kernels, problem.records, predicted(problem, values).records, strict=True)
    return problem.with_records(
        [after if _bilinear(kernel.factor.expressed) else before for kernel, before, after in shown]
    )


def predicted(problem: Problem, values: Array) -> Problem:
    result = []
    for kernel, before, shown in zip(problem.kernels, problem.records, problem.predict(values), strict=True):
        record = before.record.copy()
        for row in _measured(kernel.factor):
            readings = shown.outputs[kernel.factor.output_channels.index(kernel.factor.channels[row])]
            record[row, : before.count] = readings
            record[row, before.count :] = readings[-1] if before.count else 0.0
        result.append(replace(before, record=record))
    return problem.with_records(result)


def factor_at_zero(problem: Problem, values: Array) -> Array:
    """R (m x n) with R'R = J'J of the whitened residuals by coordinates, of the records projected onto the model."""
    return projected(problem, values).triangular_factor(values)


def fits(problem: Problem, values: Array) -> tuple[Mask, ...]:
    residuals = problem.residuals(values)
    return tuple(
        np.ones(residual.shape[1], dtype=bool)
        if _measured(kernel.factor)
        else _whitened(kernel.factor, residual) < _AT_ZERO
        for kernel, residual in zip(problem.kernels, residuals, strict=True)
    )


def joint_channels(factor: Factor) -> tuple[int, ...]:
    """Which rows of a record are commanded joint angles: those of an arm, approaches and corrections aside."""
    own = f"{factor.name}."
    return tuple(
        i
        for i, c in enumerate(factor.channels)
        if "." in c and not c.startswith(own) and ".approach." not in c and f".{CORRECTION}" not in c
    )


def approach_channels(factor: Factor) -> tuple[int, ...]:
    return tuple(i for i, c in enumerate(factor.channels) if ".approach." in c)


def _measured(factor: Factor) -> tuple[int, ...]:
    return tuple(i for i, c in enumerate(factor.channels) if c in factor.output_channels)


def _bilinear(factor: Factor) -> bool:
    rows = _measured(factor)
    if not rows:
        return False
    by_measured = ca.jacobian(factor.residual, factor.record)[:, list(rows)]
    return bool(ca.depends_on(by_measured, ca.vertcat(factor.values, factor.state)))


def _fitting_joints(grouped: GroupedKernel, values: Array, factor_records: FactorRecords) -> FactorRecords:
    """Joint angles moved by Gauss-Newton steps of least length until the residual is gone."""
    factor = grouped.kernel.factor
    rows = list(joint_channels(factor))
    if not rows or not factor_records.count:
        return factor_records
    moved = replace(factor_records, record=factor_records.record.copy(), state=factor_records.state.copy())
    joints = [factor.channels[row] for row in rows]
    for _ in range(_MOST_STEPS):
        residual = grouped.residuals(values, moved)
        if (_whitened(factor, residual) < _AT_ZERO * 1e-3).all():
            break
        slopes = grouped.channel_slopes(values, moved, joints)
        step = np.einsum("nqr,rn->qn", np.linalg.pinv(slopes.transpose(2, 0, 1), rcond=1e-9), residual)
        longest = np.abs(step).max(axis=0)
        moved.record[rows] -= step * np.minimum(1.0, 0.3 / np.maximum(longest, 1e-300))
    reached = _whitened(factor, grouped.residuals(values, moved)) < _AT_ZERO
    return replace(factor_records, record=np.where(reached, moved.record, factor_records.record))


def _whitened(factor: Factor, residual: Array) -> Array:
    return np.asarray(np.abs(residual / np.array(factor.noise)[:, None]).max(axis=0, initial=0.0))


_STEPS = 8
_EXACT = 1e-9  # In units of the noise
_LEAST_SLOPE = 1e-6  # Of the largest one: a residual that changes less with every reading is none of theirs


def reading_slopes(problem: Problem, values: Array) -> tuple[Array | None, ...]:
    """How readings change with residuals, one (N x outputs x n_r; SI) a factor, at the readings in the records.

    None of a factor that reads nothing, and of one of whose residual some part depends on no reading. A reading that
    no residual depends on has slopes of zero: nothing is known of its noise.
    """
    problem.residuals(values)  # leaves the states in equilibrium
    result: list[Array | None] = []
    for grouped, factor_records in problem.pairs:
        factor = grouped.kernel.factor
        if factor.output_channels:
            slopes = grouped.channel_slopes(values, factor_records, factor.output_channels)[
                :, :, : factor_records.count
            ]
            result.append(readings_by_residual(slopes.transpose(2, 0, 1), np.array(factor.noise)))
        else:
            result.append(None)
    return tuple(result)


def disturbed(problem: Problem, values: Array, noise: Sequence[Array]) -> Problem:
    """With readings whose residuals differ by ``noise`` (n_r x N a factor) from those that the records have."""
    before, moved, missing = problem.residuals(values), problem, list(noise)
    for _ in range(_STEPS):
        parts = zip(problem.kernels, moved.records, reading_slopes(moved, values), missing, strict=True)
        moved = problem.with_records([_stepped(k.factor, record, slope, off) for k, record, slope, off in parts])
        residuals = moved.residuals(values)
        missing = [start + added - now for start, added, now in zip(before, noise, residuals, strict=True)]
        if all(
            np.abs(off / np.array(kernel.factor.noise)[:, None]).max(initial=0.0) < _EXACT
            for kernel, off in zip(problem.kernels, missing, strict=True)
            if kernel.factor.output_channels
        ):
            break
    return moved


def _stepped(factor: Factor, factor_records: FactorRecords, slope: Array | None, residual: Array) -> FactorRecords:
    if not factor.output_channels:
        return factor_records
    if slope is None:
        readings = ", ".join(channel.rpartition(".")[2] for channel in factor.output_channels)
        raise ProblemError(
            f"the residual of {factor.name} ({len(factor.noise)} numbers) is not determined by its readings "
            f"{readings}, so their noise is not known.",
            hint="Give the residual no more numbers than there are readings, each of which depends on a reading.",
        )
    record = factor_records.record.copy()
    for row, channel in zip(np.einsum("nor,rn->on", slope, residual), factor.output_channels, strict=True):
        if channel in factor.channels:
            place = factor.channels.index(channel)
            record[place, : factor_records.count] += row
            record[place, factor_records.count :] = record[place, max(factor_records.count - 1, 0)]
    return replace(factor_records, record=record)


def readings_by_residual(by_reading: Array, noise: Array) -> Array | None:
    """The least change of readings for a residual (N x outputs x n_r), from the opposite (N x n_r x outputs).

    ``noise`` is that of the residual's entries (n_r). None where some part of the residual depends on no reading.
    """
    if by_reading.shape[1] > by_reading.shape[2] or not (noise > 0).all():
        return None
    whitened = by_reading / noise[:, None]
    sizes = np.abs(whitened).max(axis=(0, 1), initial=0.0)
    sizes[sizes == 0] = 1.0
    singular = np.linalg.svd(whitened / sizes, compute_uv=False)
    if not (singular[:, -1] > _LEAST_SLOPE * singular[:, 0]).all():
        return None
    return np.asarray(np.linalg.pinv(whitened / sizes) / sizes[:, None] / noise)


def with_joint_noise(problem: Problem, values: Array, noise_scale: float = 1.0) -> Problem:
    """With records whitened by the noise of residuals and of joints together; the same where no joint has any.

    The covariance of a residual is its own plus S diag(sd^2) S', with S its derivative by the joints at these values,
    those of the other record where a measurement lies between two (whose noise several may share: that correlation is
    left out). The whitened residuals are multiplied by ``noise_scale`` afterwards. Below 1 it leaves the joints' noise
    as large as stated: records at few joint angles do not show what the joints are off between these.
    """
    arms = problem.blueprint.arms.values()
    stated = {
        f"{arm.name}.{joint}{which}": arm.joint_noise
        for arm in arms
        for joint, dimension in arm.commanded.items()
        for which in ("", OTHER)
        if arm.joint_noise and dimension == "angle"
    }
    if not stated:
        return problem
    deviations = np.array(list(stated.values())) / min(noise_scale, 1.0)
    slopes = problem.channel_slopes(values, list(stated))
    result = []
    for kernel, record, slope in zip(problem.kernels, problem.records, slopes, strict=True):
        own = whitening_of(kernel.factor, record)
        padded = np.pad(slope, ((0, 0), (0, 0), (0, own.shape[2] - record.count)), mode="edge")
        scaled = transformed(own, padded * deviations[:, None])
        covariance = np.einsum("ikn,jkn->ijn", scaled, scaled) + np.eye(len(own))[:, :, None]
        result.append(replace(record, whitening=transformed(by_covariance(covariance), own)))
    return problem.with_records(result)


def corrected(problem: Problem, arm: Arm, corrections: Array) -> Problem:
    """The problem of records with corrections of an arm (6 + joints x N) in place of theirs."""
    result = []
    for kernel, own in zip(problem.kernels, problem.records, strict=True):
        content = own.record.copy()
        for channel, row in zip(arm.correction_channels, corrections, strict=True):
            if channel in kernel.factor.channels:
                content[kernel.factor.channels.index(channel), : own.count] = row
        result.append(replace(own, record=content, state=own.state.copy()))
    return problem.with_records(result)


@dataclass(frozen=True)
class Moved:
    altogether: Array  # how far corrections move the tool of an arm in each record (N; m)
    parts: Mapping[str, Array]  # ``tool``, and those joints that are corrected, by name


def moved_by(problem: Problem, values: Array, arm: Arm) -> Moved:
    arms = [problem.blueprint.measurements[kernel.factor.name].arms for kernel in problem.kernels]
    place = next(i for i, names in enumerate(arms) if arm.name in names)
    own, channels = problem.records[place], problem.kernels[place].factor.channels
    size, known = len(arm.correction_channels), dict(zip(channels, own.record[:, : own.count], strict=True))
    corrections = np.array([known.get(channel, np.zeros(own.count)) for channel in arm.correction_channels])

    def tools(rows: Sequence[int]) -> Array:
        some = np.zeros((size, own.count))
        some[list(rows)] = corrections[list(rows)]
        shown = corrected(problem, arm, some).predict(values)[place]
        return np.asarray(shown.tools[tuple(arms[place]).index(arm.name), 3])

    none, joints = tools(()), [i for i in range(len(OF_TOOL), size) if np.any(corrections[i])]
    parts = {"tool": range(len(OF_TOOL)), **{arm.joint_names[i - len(OF_TOOL)]: (i,) for i in joints}}
    apart = {name: np.linalg.norm(tools(tuple(rows)) - none, axis=0) for name, rows in parts.items()}
    return Moved(np.linalg.norm(tools(range(size)) - none, axis=0), apart)


def sizes_of(covariances: Sequence[Array]) -> Array:
    """How large that is in each record (N; m): the largest standard deviation of a position (N x n_r x n_r each)."""
    return np.asarray(np.sqrt(np.max([np.einsum("nrr->n", own[:, :3, :3]) for own in covariances], axis=0)))


def unexplained(
    problem: Problem, values: Array, learned: Mapping[str, tuple[PoseResidual, Postures]] | None = None
) -> list[Array]:
    """Covariance of residuals by what learned pose residuals do not know (N x n_r x n_r a factor; SI).

    Those of ``learned``, by arm, take the place of the arms' own. Records must carry corrections; arms that have none,
    or whose pose residual has not learned, add nothing.
    """
    count = problem.count
    total = [np.zeros((count, kernel.factor.rows, kernel.factor.rows)) for kernel in problem.kernels]
    for arm in problem.blueprint.arms.values():
        residual, postures = (learned or {}).get(arm.name, (arm.residual, None))
        if residual is None or not residual.is_learned:
            continue
        slopes = problem.channel_slopes(values, arm.correction_channels)
        for i, (kernel, own, slope) in enumerate(zip(problem.kernels, problem.records, slopes, strict=True)):
            known = dict(zip(kernel.factor.channels, own.record[:, : own.count], strict=True))
            whole = Dataset(("",) * own.count, known)
            here = arm.postures(whole, problem.blueprint.environment) if postures is None else postures
            spread = slope * residual.deviations(here)
            total[i] += np.einsum("rcn,scn->nrs", spread, spread)
    return total


FEW_POINTS = 12


def with_few_points(problem: Problem) -> Problem:
    """The problem with at most so many points of each measurement, spread over all; unchanged beside a drift."""
    many = [kernel.factor.points is not None and len(kernel.factor.points) > FEW_POINTS for kernel in problem.kernels]
    if not any(many) or problem.correlation is not None:
        return problem
    pairs = [
        _thinned(kernel.factor, record) if thin else (kernel.factor, record)
        for kernel, record, thin in zip(problem.kernels, problem.records, many, strict=True)
    ]
    kernels = tuple(replace(kernel, factor=factor) for kernel, (factor, _) in zip(problem.kernels, pairs, strict=True))
    return Problem(replace(problem.compiled, kernels=kernels), tuple(record for _, record in pairs))


def _thinned(factor: Factor, record: FactorRecords) -> tuple[Factor, FactorRecords]:
    assert factor.points is not None
    chosen, per_point = spread_points(factor.points, FEW_POINTS), len(factor.noise) // len(factor.points)
    rows = (per_point * chosen[:, None] + np.arange(per_point)).ravel()
    read = len(record.record) > factor.shared
    channels = factor.channels[: factor.shared]
    small = replace(
        factor,
        channels=(*channels, *(factor.output_channels[row] for row in rows)) if read else channels,
        output_channels=tuple(factor.output_channels[row] for row in rows),
        noise=factor.noise[: len(rows)],
        dimensions=factor.dimensions[: len(rows)],
        points=factor.points[chosen],
    )
    kept = [*range(factor.shared), *(factor.shared + rows if read else [])]
    whitening = record.whitening
    if whitening is not None:
        roots = np.linalg.inv(np.moveaxis(whitening, 2, 0))[:, rows]
        whitening = by_covariance(np.moveaxis(roots @ roots.transpose(0, 2, 1), 0, 2))
    present = None if record.present is None else record.present[rows]
    return small, replace(record, record=record.record[kept], whitening=whitening, present=present)


def as_seen(problem: Problem, values: Array, dataset: Dataset) -> tuple[Dataset, Mask]:
    """The dataset with readings of points out of view missing (NaN), and which records have any reading left (N)."""
    channels, limited, seen = dict(dataset.channels), False, np.zeros(len(dataset), dtype=bool)
    for grouped, record in problem.of(dataset).pairs:
        kernel = grouped.kernel
        own, measurement = kernel.factor.expressed, problem.blueprint.measurements[kernel.factor.name]
        if own.margin is None or kernel.points is None or not isinstance(measurement, LimitedView):
            seen[:] |= bool(kernel.factor.output_channels)
            continue
        here, limited = kernel.points.repeated(record.state), True
        evaluate = Evaluator(own, own.margin)
        margins = kernel.points.joined(evaluate(grouped.values(values, 0), kernel.points.split(record.record), here))
        visible = measurement.visible(margins[:, : record.count])
        per_point = len(kernel.factor.output_channels) // kernel.points.count
        for row, channel in enumerate(kernel.factor.output_channels):
            if channel in channels:
                channels[channel] = np.where(visible[row // per_point], channels[channel], np.nan)
        seen |= visible.any(axis=0)
    return (replace(dataset, channels=channels), seen) if limited else (dataset, np.ones(len(dataset), dtype=bool))


@dataclass(frozen=True)
class Chain:
    channels: tuple[str, ...]  # what parameters drift over (``sequence``, or ``time`` in s)
    places: Array  # of each node in each channel (n_k x channels)

    def nodes(self, dataset: Dataset) -> Indices:
        """All places must be on the chain (N)."""
        own = np.stack([dataset.column(channel) for channel in self.channels], axis=1)
        nodes = np.unique(np.vstack([self.places, own]), axis=0, return_inverse=True)[1].ravel()
        return nodes[len(self.places) :]

    def apart(self, drifts: Sequence[Drift]) -> Array:
        """From each node to the next, in distances over which each parameter forgets (n_k - 1 x drifts)."""
        steps = [np.abs(np.diff(self.places[:, self.channels.index(d.channel)])) / d.over for d in drifts]
        return np.stack(steps, axis=1)


def chain(problem: Problem, *datasets: Dataset) -> Chain | None:
    drifting = _drifting(problem)
    if not drifting:
        return None
    channels = tuple(dict.fromkeys(drift.channel for _, drift in drifting))
    for (block, drift), dataset in itertools.product(drifting, datasets):
        if not dataset.has(drift.channel):
            raise DataError(
                f"{block.name} drifts over {drift.channel}, and the records do not carry it.",
                where=dataset.where(),
                hint=f"Add a column {drift.channel}, or name the one that is: columns: {{{drift.channel}: pose_id}}.",
            )
    columns = [np.concatenate([dataset.column(name) for dataset in datasets]) for name in channels]
    places = np.unique(np.stack(columns, axis=1), axis=0)
    steps = np.diff(places, axis=0)
    if not np.all(np.all(steps >= 0, axis=0) | np.all(steps <= 0, axis=0)):
        raise DataError(
            f"the records do not have the same order by {' and by '.join(channels)}, and parameters drift over both.",
            where=datasets[0].where(),
            hint="Correct the columns, or let all parameters drift over the same one.",
        )
    return Chain(channels, places)


def _drifting(problem: Problem) -> list[tuple[ParameterBlock, Drift]]:
    return [(block, block.drift) for block in problem.parameters.free if block.drift is not None]


def with_drift(problem: Problem, dataset: Dataset, values: Array, along: Chain | None = None) -> Problem:
    """The problem of a dataset whose records are correlated as drifting parameters demand, by slopes at ``values``.

    ``along`` is the chain of a recording that has more records than these.
    """
    along = along or chain(problem, dataset)
    if along is None:
        return problem
    drifting = _drifting(problem)
    shared = problem.unweighted()
    place = {name: i for i, name in enumerate(problem.free_names)}
    chosen, sds = [place[block.name] for block, _ in drifting], np.array([drift.sd for _, drift in drifting])
    slopes, raw = [], []  # by states, each a standard deviation of a parameter's drift
    for kernel, record, jacobian in zip(problem.kernels, shared.records, shared.jacobians(values), strict=True):
        slope = np.moveaxis(jacobian[:, chosen], 1, 2) * sds
        padding = ((0, 0), (0, record.record.shape[1] - record.count), (0, 0))
        slopes.append(np.pad(slope, padding))
        raw.append(np.pad(np.einsum("wrs,swz->rwz", noise_roots(kernel.factor, record), slope), padding))
    node = along.nodes(dataset)
    node = np.pad(node, (0, len(problem.records[0].weight) - len(node)), mode="edge")
    correlation = Correlation(tuple(slopes), tuple(raw), node, along.apart([drift for _, drift in drifting]))
    correlation = correlation.weighted([record.weight for record in problem.records])
    return problem.with_records([replace(record, correlation=correlation) for record in problem.records])


ORDER_CHANNELS = ("sequence", "time")
_STEP_M = 1e-3  # So small that a load that hangs there hardly stands elsewhere
LOADS = ("turn_x", "turn_y", "turn_z", "gravity", "mass", "moment_x", "moment_y", "moment_z")
"""Gravity turned about base axes (rad) and multiplied; a mass at the payload's centre (kg), its moments (kg m)."""


@dataclass(frozen=True)
class Motion:
    channels: tuple[str, ...]  # the command channels of all joints of all arms
    slopes: tuple[Array, ...]  # raw residual by these, one (n_r x joints x N) array a factor (m/rad and the like)
    loads: Mapping[str, SiteLoads]  # of each arm
    by_load: tuple[Array, ...] = ()  # by ``LOADS`` (n_r x 8 x N a factor); empty if nothing gives way under loads

    @classmethod
    def of(cls, problem: Problem, values: Array, dataset: Dataset) -> Motion:
        arms = problem.blueprint.arms
        channels = tuple(command_channels(arms))
        blocks = {b.name: values[problem.parameters.entries_of(b.name)] for b in problem.parameters.blocks}
        acting, loads = np.array(list(_acting(problem, dataset).values())), {}
        for name, arm in arms.items():
            commands = arm.joint_commands([dataset.column(channel) for channel in arm.command_channels])
            loads[name] = site_loads(arm, blocks, np.array(commands), acting)
        slopes = problem.channel_slopes(values, channels)
        elastic = any(len(record.state) for record in problem.records)
        return cls(channels, slopes, loads, _by_load(problem, values, dataset) if elastic else ())

    def subset(self, chosen: Indices) -> Motion:
        loads = {
            name: SiteLoads(load.moments[..., chosen], load.efforts[..., chosen], load.levers[..., chosen])
            for name, load in self.loads.items()
        }
        by_load = tuple(slope[..., chosen] for slope in self.by_load)
        return Motion(self.channels, tuple(slope[..., chosen] for slope in self.slopes), loads, by_load)

    def along(self, channel: str) -> tuple[Array, ...]:
        place = self.channels.index(channel)
        return tuple(slope[:, place] for slope in self.slopes)


def recorded_order(dataset: Dataset) -> Array:
    """Where each record stands in the recording (N): its sequence number, else its time, else its row."""
    for channel in ORDER_CHANNELS:
        if dataset.has(channel) and np.all(np.isfinite(dataset.column(channel))):
            return dataset.column(channel)
    return np.arange(len(dataset), dtype=float)


def recorded_position(dataset: Dataset) -> Indices:
    position = np.empty(len(dataset), dtype=np.intp)
    position[np.argsort(recorded_order(dataset), kind="stable")] = np.arange(len(dataset))
    return position


def _acting(problem: Problem, dataset: Dataset) -> dict[str, Array]:
    """The loads of each record (N each), those of the environment where a record says nothing."""
    return {
        channel: dataset.column(channel) if dataset.has(channel) else np.full(len(dataset), default)
        for channel, default in zip(LOAD_CHANNELS, problem.blueprint.environment.acting, strict=True)
    }


def _by_load(problem: Problem, values: Array, dataset: Dataset) -> tuple[Array, ...]:
    """Raw residual by ``LOADS``, by a problem whose records all carry their loads; ``records`` are in equilibrium."""
    plan, acting = problem.blueprint, _acting(problem, dataset)
    loaded = replace(dataset, channels={**dataset.channels, **acting})
    parts = (plan.arms, plan.measurements, problem.parameters, plan.environment, loaded)
    other = Problem.build(*parts, "interpreted", plan.groups)

    def slopes(of: Dataset) -> tuple[Array, ...]:
        here = zip(other.of(of).records, problem.records, strict=True)
        at_rest = [replace(factor_records, state=before.state.copy()) for factor_records, before in here]
        whole = other.with_records(at_rest).channel_slopes(values, LOAD_CHANNELS[:4])
        return tuple(map(_of_points, problem.kernels, other.kernels, whole))

    g = np.array([acting[f"gravity_{axis}"] for axis in "xyz"])
    ways = np.stack([np.cross(axis, g, axisb=0, axisc=0) for axis in np.eye(3)] + [g], axis=1)
    bare = slopes(loaded)
    pulled = [np.einsum("rgn,gkn->rkn", slope[:, :3], ways) for slope in bare]
    hung = [[slope[:, 3:] for slope in bare]]
    for axis in "xyz":  # what a mass does is linear in its centre
        moved = {**loaded.channels, f"payload_{axis}": acting[f"payload_{axis}"] + _STEP_M}
        shifted = slopes(replace(loaded, channels=moved))
        hung.append([(own[:, 3:] - at) / _STEP_M for own, at in zip(shifted, hung[0], strict=True)])
    return tuple(np.concatenate(own, axis=1) for own in zip(pulled, *hung, strict=True))


def _of_points(kernel: Kernel, whole: Kernel, slopes: Array) -> Array:
    if kernel.factor.points is None:
        return slopes
    every = {channel: row for row, channel in enumerate(whole.factor.output_channels)}
    return slopes[[every[channel] for channel in kernel.factor.output_channels]]
