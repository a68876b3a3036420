"""Simulated experiments with a known truth and known noise, for the tests of noise and outliers."""

from __future__ import annotations

import numpy as np
import oracle

NOISE_M = 0.0005
FEW = ("k1", "k2", "k3", "k4", "theta2", "theta3", "theta5", "base_x", "base_z", "tool_z", "d5")


def measured(count, seed, outliers=0.0, size=0.02, noise=NOISE_M, joint_sd=0.0):
    """Joint angles, measured points (N x 3) of the oracle's published arm, and which records are wrong.

    ``joint_sd`` (rad, 6) scatters the angles at which the arm really stands.
    """
    rng = np.random.default_rng(seed)
    q = oracle.random_poses(count, seed)
    stood = q + np.broadcast_to(joint_sd, (6,)) * rng.normal(size=q.shape)
    points = oracle.tip(oracle.published(), stood) + noise * rng.normal(size=(count, 3))
    wrong = np.zeros(count, dtype=bool)
    wrong[rng.choice(count, round(outliers * count), replace=False)] = True
    push = rng.normal(size=(count, 3))
    points[wrong] += size * (push / np.linalg.norm(push, axis=1, keepdims=True))[wrong]
    return q, points, wrong


def posed(lrm, q, points, names=FEW, **channels):
    """A problem in these parameters about the published values, its records and its start."""
    experiment = lrm.experiment()
    parameters = experiment.parameters.with_nominal(lrm.vector(experiment.parameters, oracle.PUBLISHED))
    parameters = parameters.with_free([oracle.armcal_name(name) for name in names])
    dataset = lrm.dataset(q, points, **channels)
    problem = lrm.problem(experiment, dataset, "auto", parameters)
    return problem, problem.of(dataset).records, parameters.nominal()


def deviations_off(fit, truth):
    """How many stated standard deviations each free value is from the truth."""
    return (fit.estimate.values - truth)[list(fit.estimate.free_entries)] / fit.estimate.deviations
