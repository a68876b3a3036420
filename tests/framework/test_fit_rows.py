"""The rows of a fit: everything that the fit weighed is among them, so that no parameter reduces what is left."""

from __future__ import annotations

from types import SimpleNamespace

import contact_oracle as co
import numpy as np
from armcal.diagnose.fit import FitRows
from armcal.estimate.polish import started
from armcal_contact.contacts import BallInSocket
from armcal_ipopt.estimator import IpoptEstimator

PLACES = {"hole_0": (0.35, 0.1, 0.25), "hole_1": (0.38, 0.12, 0.27)}
NOISE = 1e-3


def test_a_known_distance_of_sockets_keeps_the_size_of_the_arm_from_taking_up_the_residuals() -> None:
    """An arm that is smaller with its sockets has smaller residuals: what keeps its size belongs to the fit."""
    random = np.random.default_rng(0)
    q = [co.touching(co.ELBOW, co.in_socket(place), 20, seed) for seed, place in enumerate(PLACES.values())]
    noisy = [at + random.normal(0, 2 * NOISE, at.shape) for at in q]
    parts = [(co.joints(at), {"position": "here", "socket": name}) for at, name in zip(noisy, PLACES, strict=True)]
    known = {"between": ["hole_0", "hole_1"], "distance": np.hypot(0.03, np.hypot(0.02, 0.02)), "noise": 1e-5}
    ball = BallInSocket(BallInSocket.Settings.si(noise=NOISE, distances=[known]), ("arm",))
    free = ("arm.mdh.a?", "arm.mdh.d?", "arm.mdh.tool_z")
    problem, records = co.Bench({"arm": co.the_arm(co.ELBOW)}, {"balls": ball}, free).problem(co.dataset(parts))
    problem = started(problem.with_records(records))
    solution = IpoptEstimator(IpoptEstimator.Settings()).solve(
        problem.with_records(records), problem.parameters.nominal()
    )
    rows = FitRows.of(problem, SimpleNamespace(values=solution.values))
    assert np.linalg.norm(rows.slopes.T @ rows.residual) < 1e-6 * np.linalg.norm(rows.slopes)
