"""A session's state as JSON that keeps every bit, and back."""

from __future__ import annotations

import base64
from collections.abc import Mapping
from typing import Any

import numpy as np
from armcal.base.domains import Array
from armcal.errors import DataError
from armcal.estimate.online import Gaussian

from armcal_online.tracking.belief import Belief
from armcal_online.tracking.hypotheses import Candidate, Recent
from armcal_online.tracking.observer import Reading


def encoded(array: Array) -> dict[str, Any]:
    """An array of numbers: shape, and its bytes in base64 (little-endian doubles)."""
    raw = np.ascontiguousarray(array, dtype="<f8").tobytes()
    return {"shape": list(array.shape), "float64": base64.b64encode(raw).decode("ascii")}


def decoded(kept: Mapping[str, Any]) -> Array:
    """The array again.

    Raises:
        DataError: it is not whole.
    """
    raw = np.frombuffer(base64.b64decode(kept["float64"]), dtype="<f8")
    if raw.size != int(np.prod(kept["shape"])):
        raise DataError("an array in the journal is not whole.", hint="Start again from the last calibration.yaml.")
    return np.array(raw.reshape(kept["shape"]), dtype=float)


def belief_kept(belief: Belief) -> dict[str, Any]:
    """A belief; of its covariance, which is symmetric, the lower triangle."""
    covariance = belief.gaussian.covariance
    return {
        "origin": encoded(belief.origin),
        "mean": encoded(belief.gaussian.mean),
        "covariance": encoded(covariance[np.tril_indices(len(covariance))]),
    }


def belief_of(kept: Mapping[str, Any]) -> Belief:
    """The belief again."""
    mean = decoded(kept["mean"])
    covariance = np.zeros((len(mean), len(mean)))
    rows, columns = np.tril_indices(len(mean))
    covariance[rows, columns] = covariance[columns, rows] = decoded(kept["covariance"])
    return Belief(decoded(kept["origin"]), Gaussian(mean, covariance))


def candidate_kept(candidate: Candidate) -> dict[str, Any]:
    """A hypothesis that is followed."""
    kept = belief_kept(candidate.belief)
    return {"place": candidate.place, "log_evidence": candidate.log_evidence, "belief": kept}


def candidate_of(kept: Mapping[str, Any]) -> Candidate:
    """The hypothesis again."""
    return Candidate(int(kept["place"]), float(kept["log_evidence"]), belief_of(kept["belief"]))


def recent_kept(recent: Recent) -> dict[str, Any]:
    """A record of late."""
    return {
        "sequence": recent.sequence,
        "readings": [_reading_kept(reading) for reading in recent.readings],
        "joint_noise": [None if each is None else encoded(each) for each in recent.joint_noise],
        "passed": dict(recent.passed),
        "before": belief_kept(recent.before),
        "rejected": recent.rejected,
        "nis": recent.nis,
        "dof": recent.dof,
    }


def recent_of(kept: Mapping[str, Any]) -> Recent:
    """The record again."""
    return Recent(
        sequence=int(kept["sequence"]),
        readings=tuple(_reading_of(each) for each in kept["readings"]),
        joint_noise=tuple(None if each is None else decoded(each) for each in kept["joint_noise"]),
        passed={str(channel): float(distance) for channel, distance in kept["passed"].items()},
        before=belief_of(kept["before"]),
        rejected=bool(kept["rejected"]),
        nis=float(kept["nis"]),
        dof=int(kept["dof"]),
    )


def _reading_kept(reading: Reading) -> dict[str, Any]:
    return {
        "factor": reading.factor,
        "group": reading.group,
        "record": encoded(reading.record),
        "noise": encoded(reading.noise),
    }


def _reading_of(kept: Mapping[str, Any]) -> Reading:
    return Reading(int(kept["factor"]), decoded(kept["record"]), int(kept["group"]), decoded(kept["noise"]))
