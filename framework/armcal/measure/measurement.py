"""Measurements: factor types. Each says what one record constrains, as a residual in physical units.

What instruments share: each of their readings is what the arm and the instrument say, plus noise.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, Protocol, runtime_checkable

import casadi as ca
import numpy as np
from typing_extensions import override

from armcal.arm.assembly import ArmState
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression, Transform
from armcal.base.settings import Settings
from armcal.plugins import refuse


@dataclass(frozen=True)
class Channel:
    """One measured number: its local name (``x``) and dimension (``length``, ``angle``, ``dimensionless``)."""

    name: str
    dimension: str


class Measurement(Protocol):
    """What a plugin provides to describe an instrument or a contact.

    Parameters have local names; the framework puts the instance before them (``tracker.target_x``).
    """

    @property
    def arms(self) -> tuple[str, ...]:
        """The instance names of the arms that take part."""

    def parameters(self) -> Sequence[ParameterBlock]:
        """Parameters of the instrument itself."""

    @abstractmethod
    def channels(self) -> Sequence[Channel]:
        """The measured numbers it reads from a record."""

    @abstractmethod
    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        """What each channel would read without noise; empty for a contact that reads nothing."""

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """Measured minus predicted, or what a contact leaves open (n x 1, m or rad)."""

    @abstractmethod
    def noise(self) -> Sequence[float]:
        """Standard deviation of each entry of the residual (m or rad)."""


@runtime_checkable
class RecordNoise(Protocol):
    """What a measurement may provide beside the rest: where a record says its own noise."""

    def noise_channels(self) -> Sequence[Sequence[Channel]]:
        """Of each entry of the residual, the channels that may carry its standard deviation, the nearest first."""


@dataclass(frozen=True)
class Tie:
    """What is known between two groups, beside all records: the distance of two sockets.

    ``residual`` takes the values of their parameters, under local names, to what is left open (n x 1, m or rad).
    """

    groups: tuple[str, str]  # their keys
    residual: Callable[[Mapping[str, Expression], Mapping[str, Expression]], Expression]
    noise: tuple[float, ...]  # standard deviation of each entry


@runtime_checkable
class GroupedMeasurement(Protocol):
    """What a measurement provides beside the rest if groups of records share unknowns: a socket, a clamp.

    A group's key is its labels joined by a slash (``front/hole_0``). Its parameters have local names (``x``);
    the framework puts instance and key before them (``sockets.front/hole_0.x``), and gives their values under the
    local names.
    """

    @property
    def group_labels(self) -> tuple[str, ...]:
        """The text columns whose values together say which group a record belongs to; none if all belong to one."""

    @property
    def group_owner(self) -> str | None:
        """The instance whose groups these are; None for its own."""

    def group_parameters(self, group: str) -> Sequence[ParameterBlock]:
        """The numbers of one group, free where they are not known; of every group the same names and domains."""

    def group_starts(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        """The group's parameters by one record alone, to start from; empty to start from the nominal ones."""

    def ties(self, groups: Sequence[str]) -> Sequence[Tie]:
        """What is known between these groups."""

    @property
    def mean_weight(self) -> float:
        """How many times more the mean of a group's residuals weighs than its records say; 1 for independent ones."""


@runtime_checkable
class NamesGroups(Protocol):
    """What a measurement may provide beside the rest if its settings speak of single groups."""

    def named_groups(self) -> Sequence[str]:
        """Globs over keys, each of which records should have; the user is told of those that none has."""


@runtime_checkable
class DimensionedResidual(Protocol):
    """What a measurement may provide beside the rest if its residual is not all lengths."""

    def dimensions(self) -> Sequence[str]:
        """``length`` or ``angle`` of each entry of the residual."""


@runtime_checkable
class Carried(Protocol):
    """What a measurement provides beside the rest if other frames of its arm than the tool may carry its parts."""

    @property
    def carriers(self) -> Mapping[str, str]:
        """By the setting that names it: ``tool``, or a frame of the arm model that a joint moves."""


@runtime_checkable
class Borrowing(Protocol):
    """What a measurement provides beside the rest if some of its parameters may be another's: one board, two cameras.

    The expressions get their values under the same local names as the lender has them.
    """

    @property
    def lender(self) -> str | None:
        """The instance whose parameters these are; None if it borrows none."""

    @property
    def borrowed(self) -> Sequence[str]:
        """Local names of the parameters that are the lender's; ``parameters`` leaves them out."""

    def check_lender(self, lender: Measurement) -> None:
        """Refuse one whose parameters mean something else (ValueError)."""


@runtime_checkable
class Placed(Protocol):
    """What a measurement may provide beside the rest if a pose of its own is what a user wants to know."""

    @property
    def place(self) -> tuple[str, str]:
        """What the names of the pose's parameters begin with (``camera``), and where it is, in words."""


@runtime_checkable
class HasScale(Protocol):
    """What a measurement may provide beside the rest if all lengths that it shows depend on a parameter of its own."""

    @property
    def scale(self) -> str:
        """That parameter's local name, a share (``board_scale``); empty if it is another measurement's."""

    @property
    def scale_check(self) -> str:
        """How a user finds out what it is, as a sentence without its full stop."""


@dataclass(frozen=True)
class Mistake:
    """Something that may have gone wrong with an instrument.

    ``course`` is how it changes over the recording; what is there ``always`` is looked for in those parameters that are
    fixed, each of one number.
    """

    kind: str  # in a word, ``focus``
    words: str  # what residuals then depend on, as the end of a sentence; of what is there always, the sentence
    measure: str  # which measurement would show it, and what to do about it
    parameters: tuple[str, ...]  # local names of what changes
    course: Literal["slowly", "once", "always"]
    together: bool = False  # whether all change by the same share, and not each by itself


@runtime_checkable
class NamesMistakes(Protocol):
    """What a measurement may provide beside the rest if it knows what often goes wrong with it."""

    def mistakes(self) -> Sequence[Mistake]:
        """Each of them is looked for in the residuals of a fit."""


def borrowed_names(measurement: Measurement) -> dict[str, str]:
    if not isinstance(measurement, Borrowing) or measurement.lender is None:
        return {}
    return {local: f"{measurement.lender}.{local}" for local in measurement.borrowed}


def residual_dimensions(measurement: Measurement) -> tuple[str, ...]:
    """Of each entry of the residual; lengths if the measurement does not say."""
    if isinstance(measurement, DimensionedResidual):
        return tuple(measurement.dimensions())
    return ("length",) * len(measurement.noise())


def noise_channels(measurement: Measurement) -> tuple[tuple[Channel, ...], ...]:
    """Of each entry of the residual; empty if the measurement takes no noise from records."""
    if not isinstance(measurement, RecordNoise):
        return ()
    return tuple(tuple(own) for own in measurement.noise_channels())


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
    """The arm that a configuration names, or the only one; else a ValueError."""
    if not arm_names:
        raise ValueError("there is no arm; describe one under arms")
    if text is None and len(arm_names) != 1:
        raise ValueError(f"there are {len(arm_names)} arms ({', '.join(arm_names)}); say which by arm: NAME")
    name = text or arm_names[0]
    if name not in arm_names:
        raise ValueError(f"no arm is called {name!r}; the arms are {', '.join(arm_names)}")
    return name


_Settings = Settings


class InstrumentSettings(Settings):
    """Which arm is measured; the only one unless said."""

    arm: str | None = None


class Instrument(Measurement, ABC):
    """A base for measurements that read something of one arm.

    ``channels``, ``outputs`` and ``noise`` (see ``Measurement``) are all that a subclass must say.

    Attributes:
        Settings: the class of its checked settings.
        settings: its own, checked.
        arms: the instance name of its arm.
    """

    Settings: ClassVar[type[_Settings]] = InstrumentSettings
    arms: tuple[str, ...] = ()

    def __init__(self, settings: Any, arm_names: Sequence[str]) -> None:
        self.settings = settings
        self.arms = (named_arm(settings.arm, arm_names),)

    def parameters(self) -> Sequence[ParameterBlock]:
        """Parameters of the instrument itself, under local names."""
        return ()

    def residual(
        self, arms: Mapping[str, ArmState], measured: Mapping[str, Expression], values: Mapping[str, Expression]
    ) -> Expression:
        """Measured minus predicted, an entry a channel (n x 1, m or rad); angles by the shorter way round."""
        predicted, names = self.outputs(arms, values), [channel.name for channel in self.channels()]
        if set(predicted) != set(names):
            refuse(self.outputs, f"only {', '.join(predicted) or 'none'}", f"every channel: {', '.join(names)}")
        off = {channel: measured[channel.name] - predicted[channel.name] for channel in self.channels()}
        turns = [ca.remainder(x, 2 * ca.pi) if channel.dimension == "angle" else x for channel, x in off.items()]
        return ca.vertcat(*turns)

    def dimensions(self) -> Sequence[str]:
        """``length`` or ``angle`` of each entry of the residual: the channels', or lengths of a residual of its own."""
        if type(self).residual is Instrument.residual:
            return tuple(channel.dimension for channel in self.channels())
        return ("length",) * len(self.noise())

    def noise_channels(self) -> Sequence[Sequence[Channel]]:
        """Of each entry of the residual, the channels that may carry its noise; none takes any from records."""
        return ()

    def base_T_tool(self, arms: Mapping[str, ArmState]) -> Transform:  # noqa: N802
        """Where the tool is, in the base frame of the arm (m)."""
        return arms[self.arms[0]].base_T_tool


@dataclass(frozen=True)
class Proposal:
    """Where a measurement's own parameters may start."""

    values: Mapping[str, Array] = field(default_factory=dict)  # canonical entries by local name, of what was found
    open: str = ""  # what the records leave open, a sentence; empty if nothing
    close: str = ""  # which further records would close it, a sentence
    undetermined: tuple[str, ...] = ()  # local names of the parameters that are left open


@dataclass(frozen=True)
class Reading:
    """What a measurement read in N records, and where its arm was.

    ``frames`` are base_T_tool of each record (N x 4 x 4, m) as ``tool``, and ``base``; of one that is ``Carried``, the
    poses of its carriers.
    """

    frames: Mapping[str, Array]
    channels: Mapping[str, Array]  # each channel (N; NaN where it is missing), by local name
    values: Mapping[str, Array]  # canonical entries of all its parameters, by local name
    free: frozenset[str]  # local names of those that may move
    ids: tuple[str, ...]  # what each record is called


@runtime_checkable
class Proposing(Protocol):
    """What a measurement provides beside the rest if it finds its own parameters without a fit: a hand-eye pose."""

    def propose(self, reading: Reading) -> Proposal:
        """Its parameters from what it read, those that are free."""


@runtime_checkable
class PointMeasurement(Protocol):
    """What a measurement provides beside the rest if it reads the same of each of many points.

    Its channels and its residual go point by point, ``u_0, v_0, u_1, v_1, ...``; its residual is measured minus
    predicted. A record may lack points: one of which a channel is missing (NaN) costs its rows, not the record.
    """

    @property
    @abstractmethod
    def points(self) -> Array:
        """What distinguishes the points (P x k), in a number or several each."""

    @abstractmethod
    def point_channels(self) -> Sequence[Channel]:
        """What is read of one point."""

    @abstractmethod
    def point_outputs(
        self, arms: Mapping[str, ArmState], values: Mapping[str, Expression], point: Expression
    ) -> Expression:
        """What each of these would read without noise, of a point (k numbers)."""


@runtime_checkable
class LimitedView(Protocol):
    """What a measurement of many points provides beside the rest if it does not see all of them from everywhere."""

    def point_margin(
        self, arms: Mapping[str, ArmState], values: Mapping[str, Expression], point: Expression
    ) -> Expression:
        """A number above zero where a point is in view."""

    def visible(self, margins: Array) -> Mask:
        """Which points can be read (P x N) with these margins (P x N): of some boards all or none."""


@runtime_checkable
class Rendering(Protocol):
    """What a measurement of points in images provides beside the rest if it can draw the images."""

    def rendered(self, frames: Mapping[str, Array], values: Mapping[str, Array]) -> Iterator[bytes]:
        """An image file (PNG) of each record.

        Args:
            frames: base_T_frame of each record (N x 4 x 4, m), by the name of the frame, as in ``Proposing``.
            values: canonical entries of its parameters, by local name.

        Raises:
            PluginError: a library is not there.
        """


class PointInstrument(Instrument, PointMeasurement):
    """A base for such instruments of one arm: points, their channels, outputs and noise are all that differs."""

    @abstractmethod
    def point_noise(self) -> Sequence[float]:
        """Standard deviation of each of these."""

    @property
    def point_names(self) -> Sequence[str]:
        return [str(number) for number in range(len(self.points))]

    @override
    def channels(self) -> Sequence[Channel]:
        return [Channel(f"{c.name}_{name}", c.dimension) for name in self.point_names for c in self.point_channels()]

    @override
    def outputs(self, arms: Mapping[str, ArmState], values: Mapping[str, Expression]) -> Mapping[str, Expression]:
        shown = ca.vertcat(*(self.point_outputs(arms, values, ca.SX(list(point))) for point in self.points))
        return {channel.name: shown[i] for i, channel in enumerate(self.channels())}

    @override
    def noise(self) -> Sequence[float]:
        return tuple(self.point_noise()) * len(self.points)


def spread_points(points: Array, most: int) -> Indices:
    """At most so many of the points (N x k), in order: each next one as far as can be from those before it."""
    if len(points) <= most:
        return np.arange(len(points))
    chosen, apart = [0], np.linalg.norm(points - points[0], axis=1)
    while len(chosen) < most:
        chosen.append(int(np.argmax(apart)))
        apart = np.minimum(apart, np.linalg.norm(points - points[chosen[-1]], axis=1))
    return np.sort(np.array(chosen, dtype=np.intp))
