"""Joints as a user names them, and their limits: stated by a configuration, else by the arm model."""

from collections.abc import Collection, Iterable, Mapping
from typing import TypeVar

import numpy as np

from armcal.arm.model import Chain
from armcal.base.arrays import Array
from armcal.errors import ConfigError, Location

V = TypeVar("V")
Limits = tuple[float, float]  # Lowest and highest command of a joint (rad or m)
_KINDS = {"angle": "turning ", "length": "sliding "}


def unknown_joint(names: Iterable[str], joints: Collection[str], kind: str = "") -> str:
    """What is wrong with the first name that no joint has; empty where all are joints."""
    for name in names:
        if name not in joints:
            return f"no {kind}joint is called {name!r}; the {kind}joints are {', '.join(joints) or 'none'}"
    return ""


def by_dimension(
    joints: Mapping[str, str],
    turning: Mapping[str, V],
    sliding: Mapping[str, V],
    keys: tuple[str, str] = ("plan.limits", "plan.travel_limits"),
    where: Location | None = None,
) -> dict[str, V]:
    """What is stated of turning and of sliding joints together; ``joints`` has ``angle`` or ``length`` of each."""
    for stated, dimension, key in ((turning, "angle", keys[0]), (sliding, "length", keys[1])):
        known = [joint for joint, own in joints.items() if own == dimension]
        if fault := unknown_joint(stated, known, _KINDS[dimension]):
            raise ConfigError(
                f"{key}: {fault}.", where=where, hint=f"{keys[0]} is of turning joints, {keys[1]} of sliding ones."
            )
    return {**turning, **sliding}


def joint_limits(chain: Chain, *stated: Mapping[str, Limits]) -> dict[str, Limits | None]:
    """Limits of each joint's command, in order: those stated first, else the model's; None where nothing limits it.

    Where joints are coupled, the model's are of their own angles: commands go as far as some of these let them, and
    ``within_couplings`` says which of them do.
    """
    model = {joint.name: joint.limits for joint in chain.joints if joint.mimic is None}
    if any(joint.couplings for joint in chain.joints):
        own = np.array([ends or (-np.inf, np.inf) for ends in model.values()])
        for joint, row in zip(model, np.linalg.inv(coupling_matrix(chain)), strict=True):
            low, high = np.sort(row[row != 0, None] * own[row != 0], axis=1).sum(axis=0).tolist()
            model[joint] = (low, high) if np.isfinite([low, high]).all() else None
    for limits in stated:
        if fault := unknown_joint(limits, model):
            raise ValueError(fault)
    return {joint: next((limits[joint] for limits in stated if joint in limits), own) for joint, own in model.items()}


def require_couplings(joints: Mapping[str, str], couplings: Mapping[str, Mapping[str, float]]) -> None:
    """Couplings of commanded joints (``angle`` or ``length``) must be of others, of their kind, and have an inverse."""
    for joint, others in couplings.items():
        if fault := unknown_joint([joint, *others], joints, "commanded "):
            raise ValueError(fault)
        if wrong := [other for other in others if other == joint or joints[other] != joints[joint]]:
            raise ValueError(f"{joint} is coupled with {wrong[0]}, expected another joint that moves alike")
    rows = [[float(one == other) + couplings.get(one, {}).get(other, 0.0) for other in joints] for one in joints]
    if not np.isfinite(rows).all() or np.linalg.matrix_rank(rows) < len(rows):
        raise ValueError("no commands belong to some angles of the joints that are coupled so")


def coupling_matrix(chain: Chain) -> Array:
    joints = [joint for joint in chain.joints if joint.mimic is None]
    return np.array([[float(one is other) + one.couplings.get(other.name, 0.0) for other in joints] for one in joints])
