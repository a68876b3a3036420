"""Names of joints: they begin columns of a table (``q1_deg``) and names of parameters."""

from __future__ import annotations

import re
from collections.abc import Sequence

from armcal.base.units import split_suffix
from armcal.errors import DataError, Location
from armcal.measure.reader import ENVIRONMENT

_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_TAKEN = frozenset({"x", "y", "z", "id", "pose_id", *(name for name, _ in ENVIRONMENT)})


def check_joint_names(names: Sequence[str], places: Sequence[Location]) -> None:
    """Refuse names that stand twice, or that a table has other columns for; ``places`` say where each stands.

    Raises:
        DataError: with the name.
    """
    for index, (name, where) in enumerate(zip(names, places, strict=True)):
        if not _NAME.fullmatch(name):
            fault = "expected letters, digits, - and _, the first a letter"
        elif name in _TAKEN or name.startswith(("approach", "noise")):
            fault = "which tables of poses have for something else"
        elif split_suffix(name):
            fault = "which ends like a unit"
        elif name in names[:index]:
            fault = "a second time"
        else:
            continue
        raise DataError(f"found the joint name {name[:60]!r}, {fault}.", where=where, hint="Rename the joint.")
