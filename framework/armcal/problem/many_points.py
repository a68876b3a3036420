"""Measurements of many points: few of them, enough to judge how records err; and those an instrument would see."""

from dataclasses import replace

import numpy as np

from armcal.arm.evaluator import Evaluator
from armcal.base.arrays import Array, Mask
from armcal.base.dataset import Dataset
from armcal.measure.instrument import LimitedView, spread_points
from armcal.problem.factor import Factor
from armcal.problem.factor_records import FactorRecords, by_covariance
from armcal.problem.problem import Problem

FEW_POINTS = 12


def with_few_points(problem: Problem) -> Problem:
    """The problem with at most so many points of each measurement, spread over all of them.

    The same object where nothing is to be left out, and where a drift correlates the records.
    """
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
