"""A robot that was never calibrated: what is known of it before anything was measured."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from types import MappingProxyType
from typing import Literal

Convention = Literal["standard", "craig"]
Range = tuple[float, float]
Unit = Literal["mm", "deg"]

FEWEST_JOINTS, MOST_JOINTS = 2, 20
ASSUMED_TURN: Range = (-math.radians(120), math.radians(120))
ASSUMED_TRAVEL: Range = (0.0, 0.2)
"""Limits (rad, m) of joints of which none are stated."""
MOST = MappingProxyType({"angle": 4 * math.pi, "length": 100.0, "mass": 1e5})
"""Sizes (rad, m, kg) beyond which a number is in another unit than it says."""
WIDTHS: Mapping[Unit, float] = MappingProxyType({"mm": 10.0, "deg": 2.0})
_PARALLEL = 0.02


@dataclass(frozen=True)
class RobotJoint:
    """A joint: its name, whether it turns or slides, its limits (rad or m), and whether these were only assumed."""

    name: str
    turns: bool
    limits: Range
    assumed: bool = False


@dataclass(frozen=True)
class Mass:
    """A link's mass (kg) and the centre of it (m) in the frame that its row leads to."""

    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Row:
    """A Denavit-Hartenberg row: angles in rad, lengths in m, and the joint that it belongs to."""

    joint: RobotJoint
    alpha: float
    a: float
    theta: float
    d: float
    mass: Mass | None = None
    tilts: bool = False
    """Whether this row's axis and the neighbour that ``alpha`` leads to are parallel: ``ry`` then tilts them."""


@dataclass(frozen=True)
class Robot:
    """What the files of a new robot are made from: rows of a convention, or a URDF.

    Attributes:
        name: of the robot.
        joints: those that are commanded, from the base to the tip.
        has_masses: whether gravity loads it, as far as is known.
        preferred: globs of parameters to keep free where the data lets one choose, the first matter most.
        priors: globs of parameters that have one, each with the unit of its width.
        widths: how far such parameters may be off the drawing (standard deviation), by unit.
        convention: of the rows.
        rows: empty for a URDF.
        urdf: the file's content.
        urdf_file: its name.
        tip: the link that is the tool.
        up: which way is up in the tracker's base frame (unit vector); None if not stated.
        target: where the tracker's target sits in the tool's frame (m), roughly; None if not stated.
    """

    name: str
    joints: tuple[RobotJoint, ...]
    has_masses: bool
    preferred: tuple[tuple[str, ...], ...]
    priors: Mapping[str, Unit] = field(default_factory=dict)
    widths: Mapping[Unit, float] = field(default_factory=lambda: WIDTHS)
    convention: Convention = "standard"
    rows: tuple[Row, ...] = ()
    urdf: bytes = b""
    urdf_file: str = ""
    tip: str = ""
    up: tuple[float, float, float] | None = None
    target: tuple[float, float, float] | None = None


def with_tilts(convention: Convention, rows: tuple[Row, ...]) -> tuple[Row, ...]:
    """The rows, those between parallel axes marked: there rows alone cannot express every small tilt. [Hayati1983]

    ``alpha`` lies between a joint and the next one, in Craig's convention between it and the one before.
    """

    def is_parallel(index: int) -> bool:
        other = index + (1 if convention == "standard" else -1)
        both = 0 <= other < len(rows) and rows[index].joint.turns and rows[other].joint.turns
        return both and abs(math.sin(rows[index].alpha)) < _PARALLEL

    return tuple(replace(row, tilts=is_parallel(index)) for index, row in enumerate(rows))


def robot_of_rows(name: str, convention: Convention, rows: tuple[Row, ...]) -> Robot:
    """A robot of Denavit-Hartenberg rows.

    Where its base stands and where the target sits are known least, so these are preferred to the rows beside them.
    """
    rows = with_tilts(convention, rows)
    of_rows = (("arm.mdh.theta*",), ("arm.mdh.a[0-9]*", "arm.mdh.d[0-9]*"), ("arm.mdh.alpha*", "arm.mdh.*_ry"))
    priors: dict[str, Unit] = {
        "arm.mdh.theta*": "deg",
        "arm.mdh.alpha*": "deg",
        "arm.mdh.after*_ry": "deg",
        "arm.mdh.before*_ry": "deg",
        "arm.mdh.a[0-9]*": "mm",
        "arm.mdh.d[0-9]*": "mm",
    }
    return Robot(
        name=name,
        joints=tuple(row.joint for row in rows),
        has_masses=any(row.mass for row in rows),
        preferred=(("arm.mdh.base_*",), ("tracker.target_*",), *of_rows, ("arm.spring.*",)),
        priors=priors,
        convention=convention,
        rows=rows,
    )
