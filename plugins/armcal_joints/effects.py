"""Springs: linear and cubic ones about joint axes [Conenna2024], and 3x3 compliances under a site's full moment."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

import casadi as ca
from armcal.arm.effects import XYZ, EffectSettings, JointCommand, JointEffect, Spring, chosen, joint_rate
from armcal.arm.model import Attachment, Chain
from armcal.arm.servo import PulseClock, PulseTable, SteppedEffect, quantised, without_slope
from armcal.base.config_text import resolve_path
from armcal.base.domains import Domain, Interval, Semidefinite
from armcal.base.parameters import ParameterBlock, scalar
from armcal.base.se3 import Transform
from armcal.base.settings import Compliance, Settings, Temperature, Torque
from armcal.config.servo_file import Angles, CalibratedServo, Oscillator, Pulses, check_longest, load_servo_file
from armcal.errors import ConfigError
from pydantic import BeforeValidator, Field, field_validator, model_validator

EXPANSION_SCALE_PER_K = 5e-5


class ThermalLengthSettings(Settings):
    """The temperature at which lengths are nominal, and whether all links share one coefficient (one material)."""

    reference: Temperature = 20.0
    links: Literal["one", "each"] = "one"


class ThermalLength(JointEffect):
    """The effect ``thermal_length``: ``expansion`` of all links (1/K), or ``expansion1`` to ``expansionN``.

    Link i lies before joint i, the last one between the last joint and the tool. Records need a column
    ``temperature_C``; a prediction without one is made at the reference temperature.
    """

    Settings = ThermalLengthSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"reference_C": 22, "links": "each"}
    conditions = ("temperature",)

    def __init__(self, settings: ThermalLengthSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        links = range(1, len(joint_names) + 2)
        separate = settings.links == "each"
        self._names = tuple(f"expansion{link}" if separate else "expansion" for link in links)

    def parameters(self) -> tuple[ParameterBlock, ...]:
        physical = Interval(lower=0.0)
        return tuple(scalar(name, "per_K", 0.0, EXPANSION_SCALE_PER_K, physical) for name in dict.fromkeys(self._names))

    def shaped(self, chain: Chain, conditions: Mapping[str, Any], values: Mapping[str, Any]) -> Chain:
        """Every link's length, the tool's too, times one plus coefficient times temperature difference.

        A frame moves with the link that it stands on, so that the one at a link's end stays at the next joint.
        """
        warmer = conditions.get("temperature", self.settings.reference) - self.settings.reference
        factors = [1 + values[name] * warmer for name in self._names]
        joints = tuple(
            replace(joint, parent_T_joint=_longer(joint.parent_T_joint, factor))
            for joint, factor in zip(chain.joints, factors[:-1], strict=True)
        )
        frames = {name: _on_longer(at, factors) for name, at in chain.frames.items()}
        return replace(chain, joints=joints, tool=_on_longer(chain.tool, factors), frames=frames)


def _on_longer(at: Attachment, factors: Sequence[Any]) -> Attachment:
    return replace(at, joint_T_frame=_longer(at.joint_T_frame, factors[at.joint]))


def _longer(transform: Transform, factor: Any) -> Transform:
    return Transform(transform.rotation, transform.translation * factor)


GAIN_SCALE = 0.02
OFFSET_SCALE_RAD = 0.02
GEAR_SCALE_RAD = 0.01
_PERIODS = (1, 2)


class ServoMapSettings(EffectSettings):
    """Which joints, and whether each side of zero has a gain of its own (``two``) or both share ``one``.

    An arm model that has joint offsets already (``mdh.theta3``) needs none here: the two trade.
    """

    gains: Literal["one", "two"] = "two"


class ServoMap(JointEffect):
    """The effect ``servo_map``: relative errors of the gain, and an offset (rad).

    ``above3`` holds for commands of joint 3 above zero, ``below3`` below; with one gain it is ``gain3``. A pulse
    table of three points has such a kink, and so a wrong point of it has this effect.
    """

    Settings = ServoMapSettings

    def parameters(self) -> tuple[ParameterBlock, ...]:
        blocks, gains = [], ("above", "below") if self.settings.gains == "two" else ("gain",)
        for joint in self.joints:
            blocks += [scalar(f"{name}{joint}", "1", 0.0, GAIN_SCALE) for name in gains]
            blocks.append(scalar(f"offset{joint}", "rad", 0.0, OFFSET_SCALE_RAD))
        return tuple(blocks)

    def zeros(self) -> dict[str, int]:
        return {f"offset{joint}": joint for joint in self.joints}

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        joint, commanded = command.joint, command.commanded
        if joint not in self.joints:
            return 0
        if self.settings.gains == "one":
            return values[f"gain{joint}"] * commanded + values[f"offset{joint}"]
        above, below = ca.fmax(commanded, 0), ca.fmin(commanded, 0)
        return values[f"above{joint}"] * above + values[f"below{joint}"] * below + values[f"offset{joint}"]


class GearError(JointEffect):
    """The effect ``gear_error``: ``sin1_3`` and ``cos1_3`` (rad) of joint 3 once a turn, ``sin2_3``, ``cos2_3`` twice.

    Cosines count from their value at zero command, so that they do not trade with the joint's offset.
    """

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return tuple(
            scalar(f"{wave}{periods}_{joint}", "rad", 0.0, GEAR_SCALE_RAD)
            for joint in self.joints
            for periods in _PERIODS
            for wave in ("sin", "cos")
        )

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        joint = command.joint
        if joint not in self.joints:
            return 0
        total = ca.SX(0)
        for periods in _PERIODS:
            angle = periods * command.commanded
            total += values[f"sin{periods}_{joint}"] * ca.sin(angle)
            total += values[f"cos{periods}_{joint}"] * (ca.cos(angle) - 1)
        return total


class PulseTableSettings(Settings):
    """Pulse lengths at known angles."""

    angles: Angles
    pulses: Pulses

    @model_validator(mode="after")
    def _usable(self) -> Self:
        PulseTable(self.angles, self.pulses)
        return self


def _read_file(value: Any) -> Any:
    """A servo file's name becomes its content, so that the settings are whole by themselves."""
    if not isinstance(value, str):
        return value
    try:
        file = load_servo_file(resolve_path(value))
    except ConfigError as fault:  # pydantic places it; it would not catch an error of ours
        raise ValueError(str(fault)) from fault
    return {joint: file.calibrated(joint).to_config() for joint in file.servos}


Servos = Annotated[dict[str, CalibratedServo], BeforeValidator(_read_file)]


class QuantisationSettings(Settings):
    """Which angles the board can set: ``servos``, the servo file that drives the board too, or ``tables``.

    ``tables`` have a pulse table a joint, one measured oscillator for all, and its pulse rate or prescale.
    """

    servos: Servos = Field(default_factory=dict)
    tables: dict[str, PulseTableSettings] = Field(default_factory=dict)
    oscillator_hz: Oscillator = 25e6
    rate_hz: Annotated[float, Field(ge=24, le=1526)] = 50.0
    prescale: Annotated[int, Field(ge=3, le=255)] | None = None

    @model_validator(mode="after")
    def _one(self) -> Self:
        if bool(self.servos) == bool(self.tables):
            text = "both servos and tables" if self.tables else "neither servos nor tables"
            raise ValueError(f"found {text}, expected one of them: write servos: servos.yaml")
        if self.servos and (self.oscillator_hz, self.rate_hz, self.prescale) != (25e6, 50.0, None):
            raise ValueError("found a clock beside servos, expected none: the servo file has each board's clock")
        return self

    def clocked(self) -> dict[str, tuple[PulseTable, PulseClock]]:
        """Each joint's table, and the clock of its board."""
        if self.servos:
            return {joint: (servo.table, servo.clock) for joint, servo in self.servos.items()}
        prescale = self.prescale or PulseClock.prescale_for(self.oscillator_hz, self.rate_hz)
        clock = PulseClock(self.oscillator_hz, prescale)
        return {joint: (PulseTable(table.angles, table.pulses), clock) for joint, table in self.tables.items()}


class Quantisation(SteppedEffect):
    """The effect ``quantisation``: no parameters; the difference between the command and what the board can set.

    A joint without a table is not quantised. A servo file has all joints, and may have servos that are none.
    """

    Settings = QuantisationSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "tables": {"q1": {"angles_deg": [-100, 0, 100], "pulses_us": [620, 1540, 2460]}}
    }

    def __init__(self, settings: QuantisationSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        chosen(tuple(settings.tables), joint_names)
        missing = [joint for joint in joint_names if settings.servos and joint not in settings.servos]
        if missing:
            raise ValueError(f"the servo file has no servo {', '.join(missing)}; it has {', '.join(settings.servos)}")
        clocked = settings.clocked()
        self._servos = {joint_names.index(joint): clocked[joint] for joint in clocked if joint in joint_names}
        for table, clock in self._servos.values():
            check_longest(table, clock)

    def servos(self) -> Mapping[int, tuple[PulseTable, PulseClock]]:
        return dict(self._servos)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        servo = self._servos.get(command.index)
        return 0 if servo is None else without_slope(quantised(command.commanded, *servo) - command.commanded)


_SCALE_S = 0.01


class Delay(JointEffect):
    """The effect ``delay``: recorded joints are those of ``delay`` (s) before the measurement and have moved on since.

    Records need a column ``NAME_rate`` of each joint (``q1_rate_deg_s``); the reader ``images`` has them from the times
    of its joint table. A prediction without rates is one at rest.
    """

    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: EffectSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        rates = {joint: joint_rate(joint_names[joint - 1]) for joint in self.joints}
        self._rates, self.conditions = {joint: rate.name for joint, rate in rates.items()}, tuple(rates.values())

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return (scalar("delay", "s", 0.0, _SCALE_S),)

    def shaped(self, chain: Chain, conditions: Mapping[str, Any], values: Mapping[str, Any]) -> Chain:
        joints = list(chain.joints)
        for number, name in self._rates.items():
            joint = joints[number - 1]
            joints[number - 1] = replace(joint, offset=joint.offset + values["delay"] * conditions.get(name, 0.0))
        return replace(chain, joints=tuple(joints))


COMPLIANCE_SCALE_RAD_PER_NM = 0.05
CUBIC_SCALE_RAD_PER_NM3 = 0.05
PLAY_SCALE_RAD = 0.01
_AXES = dict(zip("xyz", XYZ, strict=True))


class SiteSprings(JointEffect):
    """Springs of one law with a number each: at joints, and at the base where the settings say so."""

    letter: ClassVar[str]  # of the sites' parameters, before the number: 0 for the base, i for joint i
    unit: ClassVar[str] = "rad"
    scale: ClassVar[float] = PLAY_SCALE_RAD
    domain: ClassVar[Domain] = Interval(lower=0.0)
    nominal: tuple[float, ...] = (0.0,)

    @property
    def sites(self) -> tuple[int, ...]:
        return (0, *self.joints) if getattr(self.settings, "base", False) else self.joints

    def parameters(self) -> tuple[ParameterBlock, ...]:
        own = (self.unit, self.nominal, self.domain, self.scale)
        return tuple(ParameterBlock(f"{self.letter}{site}", *own) for site in self.sites)

    def springs(self, values: Mapping[str, Any]) -> tuple[Spring, ...]:
        return tuple(self.spring(site, values[f"{self.letter}{site}"]) for site in self.sites)

    def spring(self, site: int, value: Any) -> Spring:
        raise NotImplementedError


class TorsionalSpringSettings(EffectSettings):
    """Which joints have a spring about their axis, and whether the base has one."""

    base_axis: Literal["x", "y", "z"] | None = None
    compliance: Compliance = 0.0

    @property
    def base(self) -> bool:
        return self.base_axis is not None

    @field_validator("compliance")
    @classmethod
    def _physical(cls, value: float) -> float:
        if value < 0:
            raise ValueError(f"a compliance of {value:g} rad/(N m) is below zero: no spring pushes with its load")
        return value


class TorsionalSprings(SiteSprings):
    """The effect ``torsional_spring``: ``k1`` to ``kn`` about the joints' axes, ``k0`` at the base (rad/(N m)).

    The base's spring turns about an axis of the frame that carries joint 1, under the moment of everything
    about that frame's origin. The physical bound k >= 0 is part of the parameters' domain.
    """

    letter, unit, scale = "k", "rad_per_Nm", COMPLIANCE_SCALE_RAD_PER_NM
    Settings = TorsionalSpringSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"base_axis": "y", "compliance_rad_per_Nm": 0.01}

    def __init__(self, settings: TorsionalSpringSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        self.nominal = (settings.compliance,)

    def spring(self, site: int, value: Any) -> Spring:
        directions = () if site else (_AXES[self.settings.base_axis],)
        return Spring(site, directions, lambda load, command: value * load)


class CubicSprings(SiteSprings):
    """The effect ``cubic_spring``: ``c1`` to ``cn`` (rad/(N m)^3) times the third power of the torque about the axis.

    It stands beside a linear spring. A negative value is a spring that stiffens; alone it would push back.
    """

    letter, unit, scale, domain = "c", "rad_per_Nm3", CUBIC_SCALE_RAD_PER_NM3, Interval()

    def spring(self, site: int, value: Any) -> Spring:
        return Spring(site, (), lambda load, command: value * load * load * load)


class ComplianceSettings(EffectSettings):
    """Which joints give in all directions, whether the base does, and how much about every axis before any data.

    The compliance must be above zero where a matrix is fitted: a factor of it cannot leave zero.
    """

    base: bool = True
    compliance: Annotated[Compliance, Field(gt=0)] = 0.01


class Compliances(SiteSprings):
    """The effect ``compliance``: symmetric positive semidefinite matrices ``C0`` (base) and ``C1`` to ``Cn`` (rad/(N m)).

    The rotation vector of a site is its matrix times the moment of everything beyond about the site's origin, both
    in the site's frame: the mount's, and joint i's after its rotation. (Before its rotation joint 1's frame moves
    with the mount's, and only the sum of their matrices would be determined.)
    """  # noqa: E501

    letter, unit, scale, domain = "C", "rad_per_Nm", COMPLIANCE_SCALE_RAD_PER_NM, Semidefinite()
    Settings = ComplianceSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"compliance_rad_per_Nm": 0.02}

    def __init__(self, settings: ComplianceSettings, joint_names: Sequence[str]) -> None:
        super().__init__(settings, joint_names)
        c = settings.compliance
        self.nominal = (c, 0.0, 0.0, c, 0.0, c)

    def spring(self, site: int, value: Any) -> Spring:
        xx, xy, xz, yy, yz, zz = (value[i] for i in range(6))
        matrix = ca.vertcat(ca.horzcat(xx, xy, xz), ca.horzcat(xy, yy, yz), ca.horzcat(xz, yz, zz))
        return Spring(site, XYZ, lambda moment, command: ca.mtimes(matrix, moment))


class ApproachBacklash(JointEffect):
    """The effect ``approach_backlash``: ``lag1`` to ``lagn`` (rad), half the difference between both directions.

    A joint that came from below (approach +1) stops ``lag`` short of its command; a negative value overshoots. Where
    the approach is not recorded (0) the joint is taken in the middle.
    """

    def parameters(self) -> tuple[ParameterBlock, ...]:
        return tuple(scalar(f"lag{joint}", "rad", 0.0, PLAY_SCALE_RAD) for joint in self.joints)

    def displacement(self, command: JointCommand, values: Mapping[str, Any]) -> Any:
        return -values[f"lag{command.joint}"] * command.approach if command.joint in self.joints else 0


class TorqueBacklashSettings(EffectSettings):
    """Which joints, and the torque at which 71 % of the play is taken up: it keeps the equilibrium smooth."""

    transition: Annotated[Torque, Field(gt=0)] = 0.05


class TorqueBacklash(SiteSprings):
    """The effect ``torque_backlash``: ``play1`` to ``playn`` (rad), half the play that the sign of the torque decides.

    play * torque / sqrt(torque^2 + transition^2): a smooth sign, so that the elastic equilibrium has a derivative.
    """

    letter = "play"
    Settings = TorqueBacklashSettings

    def spring(self, site: int, value: Any) -> Spring:
        floor = self.settings.transition**2
        return Spring(site, (), lambda torque, command: value * torque / ca.sqrt(torque * torque + floor))


class BearingPlaySettings(TorqueBacklashSettings):
    """Which joints' bearings, and the base, have play; and the moment at which 71 % of it is taken up."""

    base: bool = True


class BearingPlay(SiteSprings):
    """The effect ``bearing_play``: ``tilt0`` (base) and ``tilt1`` to ``tiltn`` (rad), half a bearing's angular play.

    The part of the arm beyond a bearing tilts with the moment that it carries, whatever its direction, as far as the
    play lets it: tilt * moment / sqrt(|moment|^2 + transition^2).
    """

    letter = "tilt"
    Settings = BearingPlaySettings

    def spring(self, site: int, value: Any) -> Spring:
        floor = self.settings.transition**2
        return Spring(site, XYZ, lambda moment, command: value * moment / ca.sqrt(ca.dot(moment, moment) + floor))
