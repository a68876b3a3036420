"""Denavit-Hartenberg rows with extra elementary transforms before and after any row.

Two conventions go by the name MDH, so the convention must be stated: ``standard`` rows are
Rot_z(theta) Trans_z(d) Trans_x(a) Rot_x(alpha) [Denavit1955], ``craig`` rows are
Rot_x(alpha) Trans_x(a) Rot_z(theta) Trans_z(d) [Craig2005].
"""

from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

from armcal.arm.model import Attachment, Chain, Joint
from armcal.base import se3
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Transform
from armcal.base.settings import Angle, Length, Settings
from pydantic import Field, model_validator

LENGTH_SCALE_M = 0.01
ANGLE_SCALE_RAD = 0.05
_MOTIONS = ("x", "y", "z", "rx", "ry", "rz")


class Step(Settings):
    """One elementary transform (``z_mm: 103.5``, ``rx_deg: 90``), or a name for the frame reached here."""

    x: Length | None = None
    y: Length | None = None
    z: Length | None = None
    rx: Angle | None = None
    ry: Angle | None = None
    rz: Angle | None = None
    frame: str | None = None

    @model_validator(mode="after")
    def _one_thing(self) -> Self:
        given = [name for name in (*_MOTIONS, "frame") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(f"a step is one transform or one frame name, found {given or 'none'}; write several steps")
        return self

    @property
    def motion(self) -> tuple[str, float] | None:
        """Which transform, and its nominal value (m or rad)."""
        return next(((n, float(getattr(self, n))) for n in _MOTIONS if getattr(self, n) is not None), None)


class Row(Settings):
    """One joint's row."""

    alpha: Angle = 0.0
    a: Length = 0.0
    theta: Angle = 0.0
    d: Length = 0.0
    kind: Literal["revolute", "prismatic"] = "revolute"
    before: tuple[Step, ...] = ()
    after: tuple[Step, ...] = ()


class MdhSettings(Settings):
    """An arm in Denavit-Hartenberg rows."""

    convention: Literal["standard", "craig"]
    rows: Annotated[tuple[Row, ...], Field(min_length=1)]
    base: tuple[Step, ...] = ()
    tool: tuple[Step, ...] = ()
    joints: tuple[str, ...] = ()

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        if self.joints and len(self.joints) != len(self.rows):
            raise ValueError(f"{len(self.joints)} joint names for {len(self.rows)} rows")
        if len(set(self.joints)) < len(self.joints):
            raise ValueError(f"a joint name stands twice in {', '.join(self.joints)}")
        if any(step.frame for step in self.base):
            raise ValueError("base: a frame cannot be named here; the frame at its end is called 'mount'")
        steps = [*(step for row in self.rows for step in (*row.before, *row.after)), *self.tool]
        names = [step.frame for step in steps if step.frame]
        reserved = {"mount", "tool", *(f"row{i}" for i in range(1, len(self.rows) + 1))}
        taken = [n for n in names if names.count(n) > 1 or n in reserved]
        if taken:
            raise ValueError(f"frame name {taken[0]!r} is taken; choose another")
        return self


class MdhModel:
    """The arm model ``mdh``: parameters ``alpha1 a1 theta1 d1 ...``, ``base_x``, ``after2_z``, ``tool_ry``, ..."""

    Settings: ClassVar[type[MdhSettings]] = MdhSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "convention": "standard",
        "base": [{"z_mm": 80}, {"ry_deg": 60}],
        "rows": [
            {"alpha_deg": 90, "d_mm": 47},
            {"alpha_deg": -90, "a_mm": 100, "after": [{"frame": "upper_arm"}, {"z_mm": 20}]},
            {"kind": "prismatic", "theta_deg": 30, "before": [{"rx_deg": 5}]},
        ],
        "tool": [{"z_mm": 73}],
    }

    def __init__(self, settings: MdhSettings) -> None:
        self._settings = settings

    @property
    def joint_names(self) -> tuple[str, ...]:
        return self._settings.joints or tuple(f"q{i}" for i in range(1, len(self._settings.rows) + 1))

    def parameters(self) -> tuple[ParameterBlock, ...]:
        blocks = [_block(name, value) for name, value in self._step_values("base", self._settings.base)]
        for i, row in enumerate(self._settings.rows, start=1):
            blocks += [_block(n, v) for n, v in self._step_values(f"before{i}", row.before)]
            blocks += [_block(f"{name}{i}", getattr(row, name)) for name in ("alpha", "a", "theta", "d")]
            blocks += [_block(n, v) for n, v in self._step_values(f"after{i}", row.after)]
        return tuple(blocks + [_block(n, v) for n, v in self._step_values("tool", self._settings.tool)])

    def chain(self, values: Mapping[str, Any]) -> Chain:
        joints: list[Joint] = []
        frames: dict[str, Attachment] = {}
        pending = se3.identity()
        for i, row in enumerate(self._settings.rows, start=1):
            alpha, a, theta, d = (values[f"{name}{i}"] for name in ("alpha", "a", "theta", "d"))
            pending = self._steps(f"before{i}", row.before, values, i - 1, pending, frames)
            link = se3.translation_along("x", a) @ se3.rotation_about("x", alpha)
            if self._settings.convention == "craig":
                pending, link = pending @ link, se3.identity()
            slide, turn = se3.translation_along("z", d), se3.rotation_about("z", theta)
            name = self.joint_names[i - 1]
            if row.kind == "revolute":
                joints.append(Joint(name, pending, offset=theta))
                pending = slide @ link
            else:
                joints.append(Joint(name, pending @ turn, (0.0, 0.0, 0.0), (0.0, 0.0, 1.0), d))
                pending = link
            pending = self._steps(f"after{i}", row.after, values, i, pending, frames)
            frames[f"row{i}"] = Attachment(i, pending)
        last = len(joints)
        tool = self._steps("tool", self._settings.tool, values, last, pending, frames)
        base = self._steps("base", self._settings.base, values, 0, se3.identity(), {})
        return Chain(base, tuple(joints), Attachment(last, tool), frames)

    @staticmethod
    def _step_values(place: str, steps: tuple[Step, ...]) -> Iterator[tuple[str, float]]:
        seen: dict[str, int] = {}
        for step in steps:
            if step.motion is None:
                continue
            kind, value = step.motion
            seen[kind] = seen.get(kind, 0) + 1
            yield f"{place}_{kind}" + (f"_{seen[kind]}" if seen[kind] > 1 else ""), value

    def _steps(
        self,
        place: str,
        steps: tuple[Step, ...],
        values: Mapping[str, Any],
        joint: int,
        start: Transform,
        frames: dict[str, Attachment],
    ) -> Transform:
        names = self._step_values(place, steps)
        here = start
        for step in steps:
            if step.motion is None:
                frames[str(step.frame)] = Attachment(joint, here)
                continue
            kind, value = step.motion[0], values[next(names)[0]]
            turns = kind.startswith("r")
            here = here @ (se3.rotation_about(kind[1], value) if turns else se3.translation_along(kind, value))
        return here


def _block(name: str, value: float) -> ParameterBlock:
    angular = name.startswith(("alpha", "theta")) or "_r" in name
    return scalar(name, "rad", value, ANGLE_SCALE_RAD) if angular else scalar(name, "m", value, LENGTH_SCALE_M)
