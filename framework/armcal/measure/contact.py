"""What contacts share: a socket, a clamp or a plane reads nothing but the joints."""

from collections.abc import Mapping, Sequence
from typing import Any

import casadi as ca

from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression, Transform
from armcal.base.settings import Settings
from armcal.measure.measurement import Channel, Tie


class Contact:
    """A base for measurements that only constrain; what a contact is, its subclass says.

    See ``GroupedMeasurement`` for what each method gives.
    """

    group_owner: str | None = None
    mean_weight: float = 1.0

    def parameters(self) -> tuple[ParameterBlock, ...]:
        """None of its own."""
        return ()

    def channels(self) -> tuple[Channel, ...]:
        """None: the joints are all that is read."""
        return ()

    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> dict[str, Expression]:
        """None."""
        return {}

    def ties(self, groups: Sequence[str]) -> tuple[Tie, ...]:
        """Nothing is known between groups."""
        return ()


class ContactSettings(Settings):
    """What all contacts of one arm are told: which arm, and the text columns that name what it touches."""

    arm: str | None = None
    group_labels: tuple[str, ...] = ()


class OneArmContact(Contact):
    """A contact of one arm."""

    def __init__(self, settings: Any, arm_names: Sequence[str]) -> None:
        self.settings = settings
        self.arms = (named_arm(settings.arm, arm_names),)
        self.group_labels = settings.group_labels

    def base_T_tool(self, arms: Mapping[str, ArmState]) -> Transform:  # noqa: N802
        return arms[self.arms[0]].base_T_tool


class ArmsAlone(Contact):
    """No instrument at all: it only makes the poses of arms known."""

    def __init__(self, arms: Sequence[str]) -> None:
        self.arms = tuple(arms)

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """Where the tools are (3 an arm, m)."""
        return ca.vertcat(*[arms[name].base_T_tool.translation for name in self.arms])

    def noise(self) -> tuple[float, ...]:
        return (1.0,) * (3 * len(self.arms))


def named_arm(text: str | None, arm_names: Sequence[str]) -> str:
    """The arm that a configuration names, or the only one.

    Raises:
        ValueError: there is no such arm, or several and none is named.
    """
    if not arm_names:
        raise ValueError("there is no arm; describe one under arms")
    if text is None and len(arm_names) != 1:
        raise ValueError(f"there are {len(arm_names)} arms ({', '.join(arm_names)}); say which by arm: NAME")
    name = text or arm_names[0]
    if name not in arm_names:
        raise ValueError(f"no arm is called {name!r}; the arms are {', '.join(arm_names)}")
    return name
