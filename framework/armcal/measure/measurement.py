"""Measurements: factor types. Each says what one record constrains, as a residual in physical units."""

from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal, Protocol, runtime_checkable

from armcal.arm.assembly import ArmState
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression


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


def borrowed_values(measurement: Measurement, values: Mapping[str, Expression]) -> dict[str, Expression]:
    return {local: values[full] for local, full in borrowed_names(measurement).items()}


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
