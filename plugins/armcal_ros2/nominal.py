"""Measured poses beside those of the nominal arm: computed from it, or the wrong way round."""

from collections.abc import Callable

import numpy as np
from armcal.base.arrays import Array
from armcal.calibration.rigid_chain import nominal_tools
from armcal.measure.reader import ReadRequest

NO_NOISE_M = 1e-5
"""Smaller than what any arm errs by."""
_FEWEST = 26
"""Twice the numbers of an affine map of the tool's pose."""
_MUCH_BETTER = 10.0
"""So many times less is left of inverted poses."""


def joint_channels(request: ReadRequest) -> list[str]:
    return [f"{name}.{joint}" for name, arm in request.arms.items() for joint in arm.commanded]


def tool_of(request: ReadRequest, name: str) -> Callable[[Array], Array]:
    """The pose of the nominal tool that a measurement sees (N x 4 x 4, m) at the joints of all arms (N x joints)."""
    own = request.measurements[name].arms[0]
    arm, channels = request.arms[own], joint_channels(request)
    columns = [channels.index(f"{own}.{joint}") for joint in arm.commanded]
    return lambda joints: nominal_tools(arm, joints[:, columns])


def follows(tools: Array, poses: Array) -> bool:
    """Whether measured places (N x 4 x 4, m; nan where there are none) are those of a point on nominal tools."""
    return _left(tools, poses) < NO_NOISE_M


def is_inverted(tools: Array, poses: Array) -> bool:
    """Whether it is the inverses of measured poses (N x 4 x 4; nan where there are none) that move as the tools do."""
    inverted = np.full_like(poses, np.nan)
    turned = np.isfinite(poses).all(axis=(1, 2))
    inverted[turned] = np.linalg.inv(poses[turned])
    return _MUCH_BETTER * _left(tools[turned], inverted[turned]) < _left(tools[turned], poses[turned])


def _left(tools: Array, poses: Array) -> float:
    known = np.isfinite(poses[:, :3, 3]).all(axis=1)
    if known.sum() < _FEWEST:
        return np.inf
    places, moved = poses[known, :3, 3], tools[known, :3].reshape(-1, 12)
    design = np.column_stack([np.ones(len(moved)), moved])
    left = places - design @ np.linalg.lstsq(design, places, rcond=None)[0]
    return float(np.sqrt((left**2).mean()))
