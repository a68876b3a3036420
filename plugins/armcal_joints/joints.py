"""Which joints an effect is on."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Literal

JointChoice = Literal["all"] | tuple[str, ...]


def chosen(wanted: JointChoice, joint_names: Sequence[str]) -> tuple[int, ...]:
    """The numbers (from 1) of the joints wanted, in the order of the chain.

    Raises:
        ValueError: a name is not one of the joints'.
    """
    names = joint_names if wanted == "all" else wanted
    unknown = [name for name in names if name not in joint_names]
    if unknown:
        raise ValueError(f"no joint is called {unknown[0]!r}; the joints are {', '.join(joint_names)}")
    return tuple(i for i, name in enumerate(joint_names, start=1) if name in names)
