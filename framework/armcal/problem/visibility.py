"""Which points an instrument with a limited view would see in poses that are only thought of."""

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from armcal.arm.evaluator import Evaluator
from armcal.base.dataset import Dataset
from armcal.base.domains import Array
from armcal.measure.points import LimitedView
from armcal.problem.problem import Problem


def as_seen(problem: Problem, values: Array, dataset: Dataset) -> tuple[Dataset, NDArray[np.bool_]]:
    """The dataset with readings of points out of view missing (NaN), and which records have any reading left (N).

    Raises:
        NotConvergedError: a record has no elastic equilibrium at these values.
    """
    channels, limited, seen = dict(dataset.channels), False, np.zeros(len(dataset), dtype=bool)
    for kernel, grouped, record in zip(problem.kernels, problem.grouped, problem.records(dataset), strict=True):
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
