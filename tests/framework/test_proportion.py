"""Lengths that are all longer in proportion: a known distance, or an instrument's scale, is wrong."""

from __future__ import annotations

from types import SimpleNamespace

import contact_oracle as co
import numpy as np
import pytest
from armcal.diagnose.gross import Figure, Proportion, figure, proportion, size
from armcal.estimate.polish import started
from armcal.estimate.robust import fit
from armcal_contact.contacts import BallInSocket
from armcal_ipopt.estimator import IpoptEstimator
from fits import fit_that_found

IPOPT = IpoptEstimator(IpoptEstimator.Settings())
PLACES = {"hole_0": (0.35, 0.1, 0.25), "hole_1": (0.2, -0.3, 0.35)}
FREE = ("arm.mdh.a?", "arm.mdh.d[34]", "arm.mdh.tool_z")


@pytest.mark.parametrize("factor", [1.0, 1.012])
def test_a_known_distance_that_is_wrong_lengthens_all_links_in_proportion(factor: float) -> None:
    """The links of the true arm differ from nominal by 0.3 mm; its distance between two sockets is stated too long."""
    random = np.random.default_rng(1)
    truth = co.named(co.ELBOW)
    for name in ("a1", "a2", "a3", "d3", "a4", "d4"):
        truth[f"arm.mdh.{name}"] += random.normal(0, 3e-4)
    parts = [
        (co.joints(co.touching(co.ELBOW, co.in_socket(place), 15, seed, truth)), {"position": "here", "socket": name})
        for seed, (name, place) in enumerate(PLACES.items())
    ]
    apart = factor * float(np.linalg.norm(np.subtract(*PLACES.values())))
    known = {"between": ["hole_0", "hole_1"], "distance": apart, "noise": 1e-5}
    ball = BallInSocket(BallInSocket.Settings.si(noise=1e-4, distances=[known]), ("arm",))
    problem, records = co.Bench({"arm": co.the_arm(co.ELBOW)}, {"balls": ball}, FREE).problem(co.dataset(parts))
    problem = started(problem.with_records(records))
    estimate = fit(problem.with_records(records), IPOPT, problem.parameters.nominal()).estimate
    lengths = proportion(problem, estimate)
    assert lengths is not None and lengths.share == pytest.approx(factor - 1, abs=3 * lengths.sd)
    assert lengths.is_clear == (factor > 1)


@pytest.mark.parametrize("each_by", ["a length", "a share of its own"])
def test_links_that_are_each_off_by_their_own_are_seldom_called_a_scale(each_by: str) -> None:
    """Those of a UR5: two long ones carry nearly all of the share."""
    random, lengths, tries = np.random.default_rng(1), np.array([0.089, 0.425, 0.392, 0.109, 0.095, 0.082]), 1000
    sizes = 0.001 * np.ones(6) if each_by == "a length" else 0.005 * lengths
    known = np.zeros((6, 6))
    alarms = [Proportion.of(lengths, lengths + random.normal(0, sizes), known).is_clear for _ in range(tries)]
    assert np.mean(alarms) < (0.02 if each_by == "a length" else 0.06)
    assert Proportion.of(lengths, 1.015 * lengths + random.normal(0, 2e-4, 6), known).is_clear


def test_it_is_a_warning_with_its_size() -> None:
    def told(share: float) -> list[str]:
        own = Figure(1000.0, 1.0 + share, 0.0, 0.0, (), Proportion(5, share, 0.0007, (4.0, 1.5)))
        estimate = SimpleNamespace(verdict=SimpleNamespace(converged=True))
        return [f"{finding.grade}: {finding.text}" for finding in size(fit_that_found(estimate, {figure: own}))]

    (longer,) = told(0.017)
    assert longer.startswith("warning: The 5 free lengths of the arm are 1.7 % (sd 0.07 %) longer than nominal")
    assert told(0.001) == []
