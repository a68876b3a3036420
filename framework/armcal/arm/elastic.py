"""The elastic state of an arm: what its springs give at each site, as few numbers as they need.

Springs that share a site share its coordinates: their deflections add up.
"""

from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca

from armcal.arm.effects import MOUNT, XYZ, JointCommand, Spring
from armcal.arm.model import Chain, Frames, Joint, Vector3
from armcal.arm.statics import SiteWrench, effort
from armcal.base import se3
from armcal.base.se3 import Expression, column


@dataclass(frozen=True)
class ElasticSite:
    """The coordinates of one site's deflection.

    Attributes:
        site: 0 for the mount, i for joint i (from 1).
        directions: rotations about these unit vectors of the site's frame; empty for a displacement on the joint's
            own axis.
        springs: what deflects there.
    """

    site: int
    directions: tuple[Vector3, ...]
    springs: tuple[Spring, ...]

    @property
    def size(self) -> int:
        return max(1, len(self.directions))


def elastic_sites(chain: Chain, springs: Sequence[Spring]) -> tuple[ElasticSite, ...]:
    """Sites in the order in which the springs name them first.

    A sliding joint's own axis is a site of its own: what gives along it is no rotation.
    """
    grouped: dict[tuple[int, bool], list[Spring]] = defaultdict(list)
    for spring in springs:
        slides = spring.site > 0 and not spring.directions and not chain.joints[spring.site - 1].is_revolute
        grouped[spring.site, slides].append(spring)
    alike = {key: len({spring.directions for spring in group}) == 1 for key, group in grouped.items()}
    return tuple(
        ElasticSite(key[0], group[0].directions if alike[key] else XYZ, tuple(group)) for key, group in grouped.items()
    )


def deflections(
    chain: Chain,
    frames: Frames,
    acting: Sequence[SiteWrench],
    sites: Sequence[ElasticSite],
    commands: Sequence[JointCommand],
) -> Expression:
    """What each site's coordinates deflect under the wrenches (rad, or m on a sliding joint's axis), stacked.

    ``commands`` are what each joint was commanded.
    """
    parts = []
    for site in sites:
        pose, wrench = frames.sites[site.site], acting[site.site]
        joint = chain.joints[site.site - 1] if site.site else None
        command = commands[site.site - 1] if site.site else MOUNT
        total = ca.SX(site.size, 1)
        for spring in site.springs:
            axes = spring.directions or ((joint.axis,) if joint else ())
            along = [ca.dot(ca.mtimes(pose.rotation, ca.SX(list(axis))), wrench.moment) for axis in axes]
            if joint is not None and not site.directions:
                along = [effort(joint, pose, wrench)]
            expected = f"{spring.size} deflections (rad, or m): one a direction"
            given = column(spring.law, spring.law(ca.vertcat(*along), command), spring.size, expected)
            total += given if spring.directions == site.directions else ca.mtimes(_matrix(axes), given)
        parts.append(total)
    return ca.vertcat(*parts) if parts else ca.SX(0, 1)


def split_deflection(
    joints: Sequence[Joint], sites: Sequence[ElasticSite], deflection: Expression
) -> tuple[list[Expression], dict[int, Expression]]:
    """A stacked deflection as displacements on joints' own axes and rotations at sites.

    Returns:
        what to add to each joint's displacement, and the rotation matrices by site.
    """
    along = [ca.SX(0) for _ in joints]
    rotations: dict[int, Expression] = {}
    start = 0
    for site in sites:
        part, axes = deflection[start : start + site.size], site.directions
        start += site.size
        if not axes:
            along[site.site - 1] = part
        elif len(axes) > 1:
            rotations[site.site] = se3.small_rotation(ca.mtimes(_matrix(axes), part))
        elif axes[0] in XYZ:
            rotations[site.site] = se3.rotation_about("xyz"[XYZ.index(axes[0])], part).rotation
        else:
            rotations[site.site] = se3.rotation_about_unit(ca.SX(list(axes[0])), part)
    return along, rotations


def _matrix(directions: Sequence[Vector3]) -> Expression:
    return ca.sparsify(ca.horzcat(*[ca.SX(list(axis)) for axis in directions]))
