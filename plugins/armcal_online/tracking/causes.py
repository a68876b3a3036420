"""What else may change at once, beside joints and instruments: the payload, the direction of gravity, a bent link.

A link's parameters are read off the arm's chain, whatever its model: those on which the fixed transform behind a joint
depends. What no free parameter can say is no cause here.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import dataclass
from typing import Literal, get_args

import casadi as ca
from armcal.arm.assembly import Arm
from armcal.arm.environment import gravity_tilt, unstated_payload
from armcal.base.se3 import Transform
from armcal.calibration.calibration import Calibration

from armcal_online.tracking.state_space import StateSpace

CauseKind = Literal["payload_changed", "gravity_tilted", "link_bent"]
CAUSES: tuple[CauseKind, ...] = get_args(CauseKind)
PAYLOAD, GRAVITY, LINK = "payload", "gravity", "link "
"""Subjects of these kinds; a link's is followed by the joint that carries it."""


@dataclass(frozen=True)
class Cause:
    """A change at once: its kind, what it is of, and the scaled coordinates that it changes."""

    kind: CauseKind
    subject: str
    coordinates: tuple[int, ...]


def spoken(subject: str) -> str:
    """What a change is of, in words: a joint's channel and a measurement are their own names."""
    if subject.startswith(LINK):
        return f"the link behind {subject.removeprefix(LINK)}"
    return {PAYLOAD: "the payload", GRAVITY: "the direction of gravity"}.get(subject, subject)


def find_causes(calibration: Calibration, space: StateSpace, offsets: Collection[str]) -> tuple[Cause, ...]:
    """Those that the free parameters can follow.

    Args:
        calibration: of the arms.
        space: of the free parameters.
        offsets: parameters that are a joint's own zero: no link's.
    """
    place = {name: i for i, name in enumerate(space.names)}
    named: list[tuple[CauseKind, str, list[str]]] = [
        ("payload_changed", PAYLOAD, [block.name for block in unstated_payload()]),
        ("gravity_tilted", GRAVITY, [block.name for block in gravity_tilt()]),
    ]
    for arm in calibration.system.arms.values():
        named += [("link_bent", LINK + joint, names) for joint, names in _links(arm, space)]
    coordinates = [
        (kind, subject, [n for n in names if n in place and n not in offsets]) for kind, subject, names in named
    ]
    return tuple(Cause(kind, subject, tuple(place[n] for n in names)) for kind, subject, names in coordinates if names)


def _links(arm: Arm, space: StateSpace) -> Iterator[tuple[str, list[str]]]:
    """The free numbers of each link, by the joint that carries it."""
    symbols = {block.name: ca.SX.sym(block.name, block.size) for block in arm.parameters()}
    chain = arm.chain(symbols)
    numbers = {block.name for block in space.parameters.free if block.size == 1 and block.unit in ("m", "rad")}
    free = [name for name in symbols if name in numbers]
    behind = [joint.parent_T_joint for joint in chain.joints[1:]]
    if chain.tool.joint == len(chain.joints):
        behind.append(chain.tool.joint_T_frame)
    for joint, fixed in zip(chain.joints, behind, strict=False):
        yield f"{arm.name}.{joint.name}", [name for name in free if _depends(fixed, symbols[name])]


def _depends(fixed: Transform, symbol: ca.SX) -> bool:
    return bool(ca.depends_on(ca.vertcat(ca.vec(fixed.rotation), fixed.translation), symbol))
