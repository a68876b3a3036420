"""From which side each joint came to where it stands."""

from __future__ import annotations

import numpy as np
from armcal.base.domains import Array


def approach_of(commands: Array) -> Array:
    """The sign of each joint's last motion; 0 before its first (joints x poses)."""
    moves = np.sign(np.diff(commands, axis=1, prepend=commands[:, :1]))
    for column in range(1, moves.shape[1]):
        still = moves[:, column] == 0
        moves[still, column] = moves[still, column - 1]
    return np.asarray(moves)
