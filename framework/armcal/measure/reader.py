"""Readers: where datasets come from, and the channels that they are asked for."""

from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

from armcal.arm.assembly import Arm
from armcal.arm.effects import JOINT_RATE, joint_rate
from armcal.base.dataset import Dataset
from armcal.base.units import DIMENSIONLESS, units_of
from armcal.io.parallel import Report, unreported
from armcal.measure.measurement import Measurement, PointMeasurement, noise_channels


@dataclass(frozen=True)
class RequestedChannel:
    """One number a record may carry."""

    channel: str  # its name in a dataset (``arm.q1``, ``tracker.x``, ``gravity_x``)
    columns: tuple[str, ...]  # names it may have in a file, without the unit suffix, the most specific first
    dimension: str  # of its unit
    required: bool  # whether a record without it is useless
    is_deviation: bool = False  # whether it is the standard deviation of a measured number
    is_endless: bool = False  # whether it is the angle of a joint that may turn on and on
    parts: tuple[str, ...] = ()  # the measurements that need it; none if the record as a whole does, or nothing
    effects: tuple[str, ...] = ()  # the joint effects (``arm.thermal``) that read it
    is_of_point: bool = False  # whether it belongs to one of many points, of which a record may lack some
    is_evidence: bool = False  # whether only the verdict reads it, so that a record that lacks it loses nothing

    @property
    def what(self) -> str:
        readers = " and ".join(self.effects)
        return f"{self.channel}, which the effect {readers} reads" if readers else self.channel


@dataclass(frozen=True)
class ReadRequest:
    """What a reader is asked for: channels, for these arms and measurements (by instance name).

    A reader that takes long calls ``report`` with the fraction of its work that is done. Where no configuration
    describes the file, ``layout_hint`` says what a user does about its columns and signs (a sentence); else the reader
    names settings of the data section.
    """

    arms: Mapping[str, Arm]
    measurements: Mapping[str, Measurement]
    channels: tuple[RequestedChannel, ...]
    report: Report = unreported
    layout_hint: str = ""


class Reader(Protocol):
    """What a plugin provides to read a format. Units end here: datasets are SI."""

    def read(self, request: ReadRequest) -> Dataset:
        """The records of the source.

        Raises:
            DataError: with file, line and column.
        """


CYCLE = "cycle"  # A channel that numbers repeated visits to poses: where it is read, records that agree are no copies
ID_NAMES = ("pose_id", "id")  # Columns that name a record

ENVIRONMENT: tuple[tuple[str, str], ...] = (
    *((f"gravity_{axis}", "acceleration") for axis in "xyz"),
    ("payload", "mass"),
    *((f"payload_{axis}", "length") for axis in "xyz"),
    *((f"force_{axis}", "force") for axis in "xyz"),
    *((f"torque_{axis}", "torque") for axis in "xyz"),
    ("time", "time"),
    ("sequence", DIMENSIONLESS),
    ("temperature", "temperature"),
)
"""Columns that any record may carry, and their dimensions."""


def surroundings(arms: Mapping[str, Arm]) -> dict[str, str]:
    """Columns of what surrounds the arms, with their dimensions: of any record, then those that effects declare.

    ValueError if an effect declares a column whose name, dimension or meaning is not clear.
    """
    known = dict(ENVIRONMENT)
    joints = {joint for arm in arms.values() for joint in arm.commanded}
    for arm in arms.values():
        for effect, condition in arm.declared:
            name, dimension = condition.name, condition.dimension or known.get(condition.name)
            text = f"the effect {arm.name}.{effect} reads the column {name!r}"
            if not name.isidentifier() or name in joints or name in ID_NAMES:
                raise ValueError(f"{text}, expected letters, digits and underscores, and no name of a joint or id")
            if dimension is None:
                raise ValueError(
                    f"{text} without its dimension, expected Condition({name!r}, DIMENSION), or a column that any "
                    f"record may carry: {', '.join(name for name, _ in ENVIRONMENT)}"
                )
            if dimension != DIMENSIONLESS:
                units_of(dimension)
            if dimension == JOINT_RATE and sum(any(c.name == name for _, c in a.declared) for a in arms.values()) > 1:
                raise ValueError(
                    f"{text}, and so does another arm's: a rate is of one joint, so name joints differently"
                )
            if known.setdefault(name, dimension) != dimension:
                raise ValueError(f"{text} as {dimension}, and it is known as {known[name]}: use another name")
    return known


def requested_channels(
    arms: Mapping[str, Arm], measurements: Mapping[str, Measurement], measured: bool
) -> tuple[RequestedChannel, ...]:
    """Every channel a problem of these arms and measurements can use.

    ``measured`` says whether measured values are required (a calibration) or may be absent (a prediction).
    """
    requested: list[RequestedChannel] = []
    for arm in arms.values():
        parts = tuple(name for name, measurement in measurements.items() if arm.name in measurement.arms)
        requested += _arm_channels(arm, len(arms) == 1, parts)
    read: dict[str, list[str]] = {}
    for arm in arms.values():
        for effect, condition in arm.declared:
            read.setdefault(condition.name, []).append(f"{arm.name}.{effect}")
    requested += [
        RequestedChannel(name, (name,), dimension, measured and name in read, effects=tuple(read.get(name, ())))
        for name, dimension in surroundings(arms).items()
    ]
    read_channels = {instance: tuple(m.channels()) for instance, m in measurements.items()}
    local = Counter(channel.name for channels in read_channels.values() for channel in channels)
    for instance, channels in read_channels.items():
        of_point = isinstance(measurements[instance], PointMeasurement)
        for channel in channels:
            own = f"{instance}.{channel.name}"
            names, parts = _names(own, (channel.name,), local[channel.name] == 1), (instance,)
            requested.append(
                RequestedChannel(own, names, channel.dimension, measured, parts=parts, is_of_point=of_point)
            )
    return (*requested, *_deviations(measurements)) if measured else tuple(requested)


def evidence_channels(arms: Mapping[str, Arm]) -> tuple[RequestedChannel, ...]:
    """What no effect reads and the verdict does: the rates of joints, of a name that only one arm has."""
    joints = Counter(joint for arm in arms.values() for joint in arm.commanded)
    taken = {*surroundings(arms), *joints, *ID_NAMES}
    rates = {rate.name for joint, count in joints.items() if count == 1 and (rate := joint_rate(joint))} - taken
    return tuple(RequestedChannel(name, (name,), JOINT_RATE, False, is_evidence=True) for name in sorted(rates))


def _deviations(measurements: Mapping[str, Measurement]) -> Iterator[RequestedChannel]:
    by_instance = {
        instance: {channel.name: channel for own in noise_channels(measurement) for channel in own}
        for instance, measurement in measurements.items()
    }
    local: list[str] = [name for channels in by_instance.values() for name in channels]
    for instance, channels in by_instance.items():
        for channel in channels.values():
            own = f"{instance}.{channel.name}"
            names = _names(own, (channel.name,), local.count(channel.name) == 1)
            yield RequestedChannel(own, names, channel.dimension, False, is_deviation=True, parts=(instance,))


def _arm_channels(arm: Arm, alone: bool, parts: tuple[str, ...]) -> Iterator[RequestedChannel]:
    endless = {joint.name for joint in arm.nominal_chain.joints if joint.endless}
    for index, (joint, dimension) in enumerate(arm.commanded.items(), start=1):
        own = f"{arm.name}.{joint}"
        names = _names(own, (joint,), alone)
        yield RequestedChannel(own, names, dimension, True, is_endless=joint in endless, parts=parts)
        approach = (f"approach{index}", f"approach_{joint}")
        yield RequestedChannel(
            f"{arm.name}.approach.{joint}", _names(f"{arm.name}.{approach[0]}", approach, alone), DIMENSIONLESS, False
        )


def _names(own: str, short: Sequence[str], alone: bool) -> tuple[str, ...]:
    return (own, *short) if alone else (own,)
