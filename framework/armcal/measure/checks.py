"""Checks of records that hold for every source: what is refused, what is set aside, what a user is warned of.

Each check takes a dataset (SI) and the layout that says which channel is what. It gives the dataset back, with
records set aside or a warning added, or raises `DataError`. ``check_dataset`` runs them all,
``check_records`` those without which nothing works.
"""

import difflib
import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from types import MappingProxyType

import numpy as np

from armcal.arm.assembly import Arm, shown_joint
from armcal.arm.joints import Limits
from armcal.arm.servo import SteppedEffect
from armcal.base.arrays import Array, Indices, Mask
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.units import UNITS, display_unit, split_suffix, to_unit
from armcal.errors import DataError, Location
from armcal.measure.groups import first_of_pose
from armcal.measure.reader import CYCLE, ENVIRONMENT, Reader, ReadRequest, RequestedChannel
from armcal.plugins import expecting, refuse

_MOVED, _FEWEST_FINE = 1e-3, 10  # rad or m; readings of which none has a number of another: chance repeats none whole
FROZEN_RECORDS = 5  # So many identical measurements in a row, while the joints moved, and the instrument has stopped
MAX_BACKWARD_FRACTION = 0.01
"""Of the records; more of them out of order in time, and the time itself is not to be trusted."""

_NONE: Mapping[str, str] = MappingProxyType({})
_DIGITS = "0123456789"
_MOST_NAMED, _MOST_COUNTED = 12, 3  # missing values of a record, columns that miss some
_FULL_TURN = 2 * math.pi
_SMALL_DEGREES = (0.5, 6.3)
"""A largest joint angle between these, in degrees, is more likely one in radians (6.3 is one turn)."""
_MAX_DEGREES = 720.0
_LATEST_S, _HOTTEST_C = 1e11, 150.0
_VARIES_AT_REST = ("time", "temperature")  # Channels that may differ between a record and its copy
_APPROACH = ".approach."
JUMP_RATIO = 50.0
SHORTEST_JUMP_S = 600.0


@dataclass(frozen=True)
class Layout:
    """What the channels of a dataset are, and what they were called in its source."""

    joints: tuple[str, ...] = ()  # channels of commanded joint displacements, revolute (angle) and prismatic (length)
    revolute: tuple[str, ...] = ()  # those of ``joints`` that turn, but not on and on
    approach: tuple[str, ...] = ()  # channels of approach directions
    measured: tuple[str, ...] = ()  # channels of measured values, ``instance.name``
    columns: Mapping[str, str] = field(default_factory=dict)  # channel to its column in the source, for messages
    units: Mapping[str, str] = field(default_factory=dict)  # channel to the unit that its column declares, else SI
    by_line: bool = False  # whether ``Dataset.rows`` are lines of a text file; otherwise they are row numbers
    deviations: tuple[str, ...] = ()  # channels of their standard deviations
    by_id: bool = False  # whether a record's id says where it stood, better than its row does
    parts: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # measurements that need it; none: all do
    of_points: frozenset[str] = frozenset()  # channels of points, of which a record may lack some but not all
    evidence: frozenset[str] = frozenset()  # channels that only the verdict reads, which a record may lack

    def column(self, channel: str) -> str:
        return self.columns.get(channel, channel)

    def place(self, dataset: Dataset, index: int) -> str:
        if self.by_id:
            return dataset.ids[index]
        return f"{'line' if self.by_line else 'row'} {dataset.row(index)}"

    def where(self, dataset: Dataset, index: int, channel: str | None = None) -> Location:
        column = self.column(channel) if channel else None
        if self.by_line:
            return Location(dataset.source or None, line=dataset.row(index), field=column)
        return dataset.where(index, column)

    def shown(self, channel: str, si_value: float) -> str:
        unit = self.units.get(channel, "1")
        value = to_unit(si_value, unit) if unit in UNITS else si_value
        return f"{value:.10g}" + ("" if unit == "1" else f" {unit}")


def layout_of(
    requested_channels: Sequence[RequestedChannel],
    dataset: Dataset,
    columns: Mapping[str, str],
    units: Mapping[str, str],
    *,
    by_line: bool,
) -> Layout:
    """The layout of a dataset that was read for some wanted channels.

    A channel that has an approach (``arm.approach.q1``) is a joint (``arm.q1``); any other of an instance is measured.
    """
    approach = [w.channel for w in requested_channels if _APPROACH in w.channel]
    moved = {joint.channel for joints in joints_by_arm(requested_channels).values() for joint in joints}
    joints = [w for w in requested_channels if w.channel in moved and dataset.has(w.channel)]
    deviations = [w.channel for w in requested_channels if w.is_deviation]
    measured = [
        w.channel for w in requested_channels if "." in w.channel and w.channel not in {*moved, *approach, *deviations}
    ]
    return Layout(
        joints=tuple(w.channel for w in joints),
        revolute=tuple(w.channel for w in joints if w.dimension == "angle" and not w.is_endless),
        approach=tuple(name for name in approach if dataset.has(name)),
        measured=tuple(name for name in measured if dataset.has(name)),
        columns=columns,
        units=units,
        by_line=by_line,
        deviations=tuple(name for name in deviations if dataset.has(name)),
        parts={w.channel: w.parts for w in requested_channels if w.parts and dataset.has(w.channel)},
        of_points=frozenset(w.channel for w in requested_channels if w.is_of_point and dataset.has(w.channel)),
        evidence=frozenset(w.channel for w in requested_channels if w.is_evidence),
    )


def joints_by_arm(requested_channels: Sequence[RequestedChannel]) -> dict[str, list[RequestedChannel]]:
    """The channels of each arm's joints: those that have an approach."""
    moved = {w.channel.replace(_APPROACH, ".", 1) for w in requested_channels if _APPROACH in w.channel}
    arms: dict[str, list[RequestedChannel]] = {}
    for w in requested_channels:
        if w.channel in moved:
            arms.setdefault(w.channel.rpartition(".")[0], []).append(w)
    return arms


def records_of(reader: Reader, request: ReadRequest) -> Dataset:
    """The records of a reader, checked whether or not it checked them; all that ask one for records ask here.

    Raises:
        DataError: the source is refused.
        PluginError: it returned no dataset, or one without a required channel, or columns of other lengths.
    """
    dataset = reader.read(request)
    with expecting(reader.read, dataset, "a Dataset: ids, and numpy arrays of numbers by channel, one a record"):
        count = len(dataset)
        for name, values in dataset.channels.items():
            if values.shape != (count,) or values.dtype != np.float64:
                given = f"the channel {name!r} of the shape {values.shape}, of {values.dtype}"
                refuse(reader.read, given, f"a numpy array of {count} numbers (float64), one a record")
        if len(dataset.rows) not in (0, count):
            refuse(reader.read, f"{len(dataset.rows)} rows", f"{count} of them, or none")
        for name, texts in dataset.extra.items():
            if len(texts) != count:
                refuse(reader.read, f"{len(texts)} texts as {name!r}", f"{count}, one a record")
        for requested in request.channels:
            if requested.required and not requested.effects and not dataset.has(requested.channel):
                given = f"no channel {requested.channel!r} among {', '.join(dataset.channels) or 'none'}"
                refuse(reader.read, given, "every channel of the request that is required")
    layout = layout_of(request.channels, dataset, {}, {}, by_line=False)
    return check_records(dataset, replace(layout, units=dict.fromkeys(layout.revolute, "deg")))


def read_as(
    dataset: Dataset,
    request: ReadRequest,
    columns: Mapping[str, str] = _NONE,
    units: Mapping[str, str] = _NONE,
    *,
    by_line: bool = True,
    by_id: bool = False,
) -> Dataset:
    """What a reader gives back: its records with all that a request needs, checked; see ``Layout`` for the rest."""
    dataset = with_absent(dataset, request.channels)
    layout = layout_of(request.channels, dataset, columns, units, by_line=by_line)
    return check_dataset(dataset, replace(layout, by_id=by_id))


def check_dataset(dataset: Dataset, layout: Layout) -> Dataset:
    dataset = warn_kelvin(warn_small_degrees(check_records(dataset, layout), layout), layout)
    return warn_repeated_poses(dataset, layout)


def check_records(dataset: Dataset, layout: Layout) -> Dataset:
    """What all that comes after readers relies on, in the order in which one check relies on another.

    Records that passed it pass it again as they are: readers make it with the names and units of their source, and
    ``records_of`` once more, for those that do not.
    """
    dataset = set_aside_without_noise(set_aside_not_finite(dataset, layout), layout)
    refuse_impossible(dataset, layout)
    refuse_joint_units(dataset, layout)
    refuse_conflicting_ids(dataset, layout)
    dataset = set_aside_backward_time(dataset, layout)
    dataset = set_aside_duplicates(set_aside_frozen(set_aside_zeros(dataset, layout), layout), layout)
    return require_records(dataset)


def set_aside_not_finite(dataset: Dataset, layout: Layout) -> Dataset:
    """Set aside records with an infinite value, and those from which nothing can be read.

    A missing value (NaN) in a channel that no measurement owns costs the record. One in a channel of measurements
    (``Layout.parts``) costs it only if no measurement has all it needs; else those that lack something are left out
    of this record, with a warning where they have a part of their own values. Of points a record may lack some, of
    what only the verdict reads all.
    """
    if all(np.isfinite(values).all() for values in dataset.channels.values()):
        return dataset
    complete: dict[str, Mask] = {}  # of each measurement whether a record has all it needs (N)
    seen: dict[str, Mask] = {}  # of each that reads points whether a record has any of them (N)
    for channel, parts in layout.parts.items():
        known = np.isfinite(dataset.column(channel))
        if channel in layout.of_points:
            seen |= {part: seen.get(part, False) | known for part in parts}
        else:
            complete |= {part: complete.get(part, True) & known for part in parts}
    complete |= {part: complete.get(part, True) & some for part, some in seen.items()}
    lost = np.zeros(len(dataset), dtype=bool)
    if complete:
        lost |= ~np.any(list(complete.values()), axis=0)
    for channel, values in dataset.channels.items():
        spared = layout.parts.get(channel) or channel in layout.evidence
        lost |= np.isinf(values) if spared else ~np.isfinite(values)
    faulty = {int(index): _reason(dataset, layout, int(index)) for index in np.flatnonzero(lost)}
    counts = {name: int(np.sum(~np.isfinite(values[lost]))) for name, values in dataset.channels.items()}
    most = sorted((name for name, count in counts.items() if count), key=lambda name: -counts[name])
    listed = ", ".join(f"{layout.column(name)} in {counts[name]}" for name in most[:_MOST_COUNTED])
    more = f" and {len(most) - _MOST_COUNTED} columns more" if len(most) > _MOST_COUNTED else ""
    why = f"values are missing or not finite: {listed}{more}"
    kept = set_aside(dataset, layout, faulty, why, "Fill them in, or measure these again.")
    return _without_incomplete(kept, layout, {part: mask[~lost] for part, mask in complete.items()})


def _reason(dataset: Dataset, layout: Layout, index: int) -> str:
    texts = []
    for channel, values in dataset.channels.items():
        if not np.isfinite(values[index]):
            kind = "is empty or NaN" if np.isnan(values[index]) else "is infinite"
            texts.append(f"{layout.column(channel)} {kind}")
    beyond = f" and {len(texts) - _MOST_NAMED} more" if len(texts) > _MOST_NAMED else ""
    return ", ".join(texts[:_MOST_NAMED]) + beyond


def _without_incomplete(dataset: Dataset, layout: Layout, complete: Mapping[str, Mask]) -> Dataset:
    """Measurements that lack something are made to lack all they read; standard deviations stay numbers."""
    channels = dict(dataset.channels)
    for part, whole in complete.items():
        own = [name for name in layout.measured if name.rpartition(".")[0] == part]
        if whole.all():
            continue
        partly = ~whole & np.any([np.isfinite(channels[name]) for name in own], axis=0) if own else whole & False
        if partly.any():
            first = layout.place(dataset, int(np.argmax(partly)))
            text = f"{part} is left out of {int(partly.sum())} of {len(dataset)} records, which have only a part of "
            dataset = warned(dataset, f"{text}what it needs (the first: {first}). Fill in the rest, or leave out all.")
        for name in own:
            channels[name] = np.where(whole, channels[name], np.nan)
    dataset = replace(dataset, channels=channels)
    for channel in layout.deviations:
        dataset = _with_deviations(dataset, layout, channel)
    return dataset


def _with_deviations(dataset: Dataset, layout: Layout, channel: str) -> Dataset:
    """Where a standard deviation is missing the largest one stands; a channel without any is dropped.

    It counts only for contacts, which read nothing that could say whether they were made.
    """
    values = dataset.column(channel)
    missing = np.isnan(values)
    if not missing.any():
        return dataset
    others = {name: numbers for name, numbers in dataset.channels.items() if name != channel}
    if missing.all():
        return replace(dataset, channels=others)
    largest = float(values[~missing].max())
    filled: Array = np.where(missing, largest, values)
    completed = replace(dataset, channels={name: others.get(name, filled) for name in dataset.channels})
    part = channel.rpartition(".")[0]
    if any(name.rpartition(".")[0] == part for name in layout.measured):
        return completed
    text = f"{layout.column(channel)} is empty in {int(missing.sum())} of {len(dataset)} records: if {part} was made "
    return warned(completed, f"{text}there, the largest one stated counts ({layout.shown(channel, largest)}).")


def with_absent(dataset: Dataset, requested_channels: Sequence[RequestedChannel]) -> Dataset:
    """What measurements require and the source cannot have is missing in all records."""
    absent = [w.channel for w in requested_channels if w.required and w.parts and not dataset.has(w.channel)]
    none = np.full(len(dataset), np.nan)
    return replace(dataset, channels={**dataset.channels, **dict.fromkeys(absent, none)}) if absent else dataset


def refuse_joint_count(names: Sequence[str], requested_channels: Sequence[RequestedChannel], where: Location) -> None:
    """Refuse columns (``names``, with their unit suffixes) of an arm with more or fewer joints than the wanted one.

    Not if no column at all is a joint's, which is a matter of names.
    """
    for arm, joints in joints_by_arm(requested_channels).items():
        own = {name for joint in joints for name in joint.columns}
        prefixes = {name.rstrip(_DIGITS) for name in own if name[-1:].isdigit()} - {""}
        owners: dict[str, str] = {}
        for name in names:
            stem, unit = split_suffix(name) or (name, None)
            is_numbered = stem[-1:].isdigit() and stem.rstrip(_DIGITS) in prefixes
            is_motion = unit is not None and unit.dimension in ("angle", "length")
            if stem in own or (is_numbered and is_motion):
                owners[stem] = name
        if owners and len(owners) != len(joints):
            missing = [joint.columns[-1] for joint in joints if owners.keys().isdisjoint(joint.columns)]
            beyond = [name for stem, name in owners.items() if stem not in own]
            raise DataError(
                f"the file has {len(owners)} joint columns, the arm has {len(joints)} (arm {arm}; "
                f"{'missing' if missing else 'not its own'}: {', '.join(missing or beyond or owners.values())}).",
                where=replace(where, field=next(iter(missing or beyond), None)),
                hint="Use this arm's file, or add or remove columns; one that is no joint needs another name.",
            )


def require_records(dataset: Dataset) -> Dataset:
    if len(dataset):
        return dataset
    first = dataset.set_aside[0] if dataset.set_aside else None
    why = f"all {len(dataset.set_aside)} were set aside, the first because {first.reason}" if first else "it is empty"
    raise DataError(
        f"found no usable record: {why}.",
        where=dataset.where(),
        hint="Correct the values, or remove an optional column that is empty.",
    )


def set_aside_without_noise(dataset: Dataset, layout: Layout) -> Dataset:
    """Set aside records that state a standard deviation of zero or less: none could weigh that much."""
    faulty = {
        int(i): f"{layout.column(channel)} is {layout.shown(channel, dataset.column(channel)[i])}, not above zero"
        for channel in filter(dataset.has, layout.deviations)
        for i in np.flatnonzero(dataset.column(channel) <= 0)
    }
    return set_aside(dataset, layout, faulty, "their noise is not above zero", "State the standard deviation.")


def refuse_impossible(dataset: Dataset, layout: Layout) -> None:
    """Refuse an approach that is no sign, a payload below zero, or a time after the year 5000 (milliseconds)."""
    sign = "Write the sign of the joint's last motion before the pose, 0 if it is not known."
    clock = "If these are milliseconds, end the column's name in _ms (time_ms), microseconds in _us."
    kinds: list[tuple[str, Callable[[Array], Mask], str, str]] = [
        ("payload", lambda x: x < 0, "a payload of {}, which is below zero", "Give the mass that hangs on the tool."),
        ("time", lambda x: x > _LATEST_S, "the time {}, after the year 5000", clock),
    ]
    for name in layout.approach:
        kinds.append((name, lambda x: ~np.isin(x, (-1, 0, 1)), "the approach {}, expected -1, 0 or 1", sign))
    for channel, wrong, text, hint in kinds:
        if dataset.has(channel) and (places := np.flatnonzero(wrong(dataset.column(channel)))).size:
            first = int(places[0])
            value = text.format(layout.shown(channel, dataset.column(channel)[first]))
            raise DataError(f"found {value}.", where=layout.where(dataset, first, channel), hint=hint)


def warn_kelvin(dataset: Dataset, layout: Layout) -> Dataset:
    if not dataset.has("temperature") or not len(dataset):
        return dataset
    typical = float(np.nanmedian(dataset.column("temperature")))
    if not typical > _HOTTEST_C:
        return dataset
    column = layout.column("temperature")
    return warned(dataset, f"{column} is typically {typical:.4g} C: are these kelvin? If so, subtract 273.15.")


def refuse_joint_units(dataset: Dataset, layout: Layout) -> None:
    for channel in layout.revolute if len(dataset) else ():
        values, unit, column = _known(dataset, channel), layout.units.get(channel, "rad"), layout.column(channel)
        first = int(np.argmax(np.abs(values)))
        where = layout.where(dataset, first, channel)
        largest = float(np.abs(values[first]))
        if unit != "deg" and largest > _FULL_TURN * (1 + 1e-9):
            raise DataError(
                f"found {layout.shown(channel, values[first])}, more than one turn (2 pi rad): are these degrees?",
                where=where,
                hint=f"If so, rename the column {column} to end in _deg; if not, write angles within one turn.",
            )
        if unit != "deg" or to_unit(largest, "deg") <= _MAX_DEGREES:
            continue
        degrees = to_unit(values, "deg")
        whole = np.abs(degrees - np.round(degrees)).max() < 1e-9 * float(np.abs(degrees).max())
        doubt = "more than two turns."
        mend = f"If the unit is wrong, convert {column}; if not, declare a joint that turns without end (continuous)."
        if whole:
            doubt = "in a column of whole numbers, expected degrees: are these tenths of a degree?"
            mend = f"If so, divide {column} by 10; if not, bring the angles within two turns."
        raise DataError(f"found {layout.shown(channel, values[first])} {doubt}", where=where, hint=mend)


def warn_small_degrees(dataset: Dataset, layout: Layout) -> Dataset:
    """Warn of joints called degrees that hardly move, all of them together."""
    called = [channel for channel in layout.revolute if layout.units.get(channel) == "deg"]
    if not called or not len(dataset):
        return dataset
    largest = max(float(np.abs(to_unit(_known(dataset, channel), "deg")).max()) for channel in called)
    if not _SMALL_DEGREES[0] < largest <= _SMALL_DEGREES[1]:
        return dataset
    names = f"{layout.column(called[0])} to {layout.column(called[-1])}" if len(called) > 1 else called[0]
    return warned(
        dataset,
        f"no joint angle in {names} is beyond {largest:.3g} deg: are these radians? "
        "If so, end the columns' names in _rad.",
    )


def refuse_conflicting_ids(dataset: Dataset, layout: Layout) -> None:
    if len(set(dataset.ids)) == len(dataset):
        return
    contents = _first_alike(dataset, tuple(dataset.channels))
    first: dict[str, int] = {}
    for index, name in enumerate(dataset.ids):
        other = first.setdefault(name, index)
        if contents[other] != contents[index]:
            raise DataError(
                f"the id {name[:40]!r} was given to another record before, at {layout.place(dataset, other)}, "
                "with other values.",
                where=layout.where(dataset, index),
                hint="Give each record its own id, or remove one of the two.",
            )


def set_aside_backward_time(dataset: Dataset, layout: Layout) -> Dataset:
    """Set aside records that are earlier than one before them; refuse more than 1 % of them."""
    if not dataset.has("time") or not len(dataset):
        return dataset
    time = dataset.channels["time"]
    latest = np.maximum.accumulate(time)
    wrong = np.flatnonzero(time < latest)
    faulty = {
        int(i): f"its time {layout.shown('time', time[i])} is before {layout.shown('time', latest[i])} "
        "of an earlier record"
        for i in wrong
    }
    if wrong.size > MAX_BACKWARD_FRACTION * len(dataset):
        raise DataError(
            f"found {wrong.size} of {len(dataset)} records out of order in time (more than 1 %), the first: "
            f"{faulty[int(wrong[0])]}.",
            where=layout.where(dataset, int(wrong[0]), "time"),
            hint="Sort the records by time, or correct the clock.",
        )
    return set_aside(dataset, layout, faulty, "the time goes backwards", "Check the clock.")


def set_aside_frozen(dataset: Dataset, layout: Layout) -> Dataset:
    """Set aside what an instrument repeats while the joints move: all but the first record of such a run."""
    faulty: dict[int, str] = {}
    if not layout.joints:
        return dataset
    joints = np.array([_known(dataset, channel) for channel in layout.joints])
    by_instance: dict[str, list[str]] = {}
    for channel in layout.measured:
        by_instance.setdefault(channel.rpartition(".")[0], []).append(channel)
    for instance, channels in by_instance.items():
        read = dataset.stacked(channels)
        made = np.flatnonzero(~np.isnan(read).any(axis=0))
        for start, stop in _runs(read[:, made]):
            run = made[start:stop]
            if np.ptp(joints[:, run], axis=1).max() > _MOVED:
                since = layout.place(dataset, int(run[0]))
                reason = f"{instance} repeats the values of {since} while the joints moved: it had frozen"
                faulty.update(dict.fromkeys(run[1:].tolist(), reason))
    return set_aside(dataset, layout, faulty, "the instrument had frozen", "Measure these poses again.")


def set_aside_zeros(dataset: Dataset, layout: Layout) -> Dataset:
    """Set aside positions of exactly (0, 0, 0), which many instruments write when they see nothing."""
    faulty: dict[int, str] = {}
    for x in (channel for channel in layout.measured if channel.endswith(".x")):
        instance = x.removesuffix("x")
        position = [instance + axis for axis in "xyz"]
        if set(position) <= set(layout.measured):
            zeros = np.flatnonzero((dataset.stacked(position) == 0).all(axis=0))
            reason = f"{instance[:-1]} is exactly (0, 0, 0)"
            faulty |= dict.fromkeys(zeros.tolist(), reason) if 2 * len(zeros) < len(dataset) else {}
    why = "their position is exactly (0, 0, 0)"
    return set_aside(dataset, layout, faulty, why, "Many instruments write that when they do not see their target.")


def set_aside_duplicates(dataset: Dataset, layout: Layout) -> Dataset:
    if not layout.measured or dataset.has(CYCLE):  # poses to predict may repeat, and visits that are numbered
        return dataset
    alike = _first_alike(dataset, [name for name in dataset.channels if name not in _VARIES_AT_REST])
    reads = ~np.isnan(dataset.stacked(layout.measured)).all(axis=0)  # an arm at rest in a contact is no copy
    faulty = {
        int(i): f"it is an exact duplicate of {layout.place(dataset, int(alike[i]))}"
        for i in np.flatnonzero(reads & (alike != np.arange(len(dataset))))
    }
    return set_aside(dataset, layout, faulty, "they are exact duplicates", "A copy is not another measurement.")


def warn_repeated_poses(dataset: Dataset, layout: Layout) -> Dataset:
    """Warn of poses that were measured more than once: they count for less than as many different ones."""
    if not layout.measured or not layout.joints:
        return dataset
    alike = first_of_pose(dataset, layout.joints)
    repeats = np.flatnonzero(alike != np.arange(len(dataset)))
    if not repeats.size:
        return dataset
    again, before = layout.place(dataset, int(repeats[0])), layout.place(dataset, int(alike[repeats[0]]))
    return warned(
        dataset,
        f"{len(dataset)} records at {len(dataset) - repeats.size} poses (the first repeat: {again} that of {before}). "
        "Records of one pose are held out together, unless you state which train; measure more different ones.",
    )


def _known(dataset: Dataset, channel: str) -> Array:
    """A channel with zeros for what was not recorded."""
    values = dataset.column(channel)
    return np.where(np.isnan(values), 0.0, values)


def _runs(values: Array) -> list[tuple[int, int]]:
    """Begin and end of what is repeated: two records already, where no number of three or more ever comes again."""
    different = len(np.unique(values, axis=1).T)
    is_fine = len(values) >= 3 and different >= _FEWEST_FINE
    is_fine = is_fine and all(len(np.unique(row)) == different for row in values)
    changes = np.flatnonzero((values[:, 1:] != values[:, :-1]).any(axis=0)) + 1
    edges = np.concatenate([[0], changes, [values.shape[1]]])
    long = np.flatnonzero(np.diff(edges) >= (2 if is_fine else FROZEN_RECORDS))
    return [(int(edges[i]), int(edges[i + 1])) for i in long]


def _first_alike(dataset: Dataset, channels: Sequence[str]) -> Indices:
    table = np.ascontiguousarray(dataset.stacked(channels).T) + 0.0  # -0.0 and 0.0 are one value
    table[np.isnan(table)] = np.nan  # and so are all that are missing
    data, step = table.tobytes(), table.itemsize * table.shape[1]
    first: dict[bytes, int] = {}
    firsts = (first.setdefault(data[i * step : (i + 1) * step], i) for i in range(len(dataset)))
    return np.fromiter(firsts, dtype=np.intp, count=len(dataset))


def set_aside(dataset: Dataset, layout: Layout, faulty: Mapping[int, str], why: str, mend: str) -> Dataset:
    if not faulty:
        return dataset
    first = layout.place(dataset, min(faulty))
    count = f"{len(faulty)} of {len(dataset)} records {'was' if len(faulty) == 1 else 'were'} set aside"
    return warned(dataset.without(faulty), f"{count} because {why} (the first: {first}). {mend}")


def warned(dataset: Dataset, text: str) -> Dataset:
    place = f"{dataset.source}: " if dataset.source else ""
    return replace(dataset, warnings=(*dataset.warnings, place + text))


def require_conditions(dataset: Dataset, requested_channels: Sequence[RequestedChannel]) -> None:
    for channel in requested_channels:
        if channel.effects and channel.required and not dataset.has(channel.channel):
            raise DataError(
                f"found no {channel.what}.",
                where=dataset.where(field=channel.channel),
                hint="Use a source that records it, or remove the effect.",
            )


def noticed(dataset: Dataset) -> Dataset:
    """The dataset with a warning for each unused column that looks like a misspelt one, and for a jump in time.

    Refuses a vector that has some of its components only; the missing ones are not guessed.
    """
    for vector in ("gravity", "force", "torque", "payload"):
        parts = [f"{vector}_{axis}" for axis in "xyz"]
        missing = [name for name in parts if not dataset.has(name)]
        if 0 < len(missing) < 3:
            raise DataError(
                f"{vector} has no {', '.join(missing)}.",
                where=Location(dataset.source),
                hint="Give all three components, 0 where there is none.",
            )
    known, texts = [name for name, _ in ENVIRONMENT], []
    for column in dataset.extra:
        split = split_suffix(column)
        near = difflib.get_close_matches(split[0], known, n=1, cutoff=0.8) if split else []
        if near:
            texts.append(f"the column {column} is kept but not used: was {near[0]} meant?")
    if dataset.has("time") and len(dataset) > 2:
        # Pauses so long that arm or tracker may have been touched, or a clock set.
        steps = np.diff(dataset.column("time"))
        limit = max(JUMP_RATIO * float(np.median(steps)), SHORTEST_JUMP_S)
        texts += [
            f"{steps[i]:.0f} s pass between the records {dataset.ids[i]} and {dataset.ids[i + 1]}: if anything was "
            "moved there, calibrate the parts on their own."
            for i in np.flatnonzero(steps > limit)[:5]
        ]
    return replace(dataset, warnings=(*dataset.warnings, *texts))


TOLERANCE = {"angle": 1e-3, "length": 1e-4}
"""How far beyond a limit (rad, m) a command may be: limits are often rounded."""


def own_limits(arm: Arm, parameters: Parameters) -> dict[str, Limits]:
    """The limits of the model, by joint, of its commands (rad or m): zeros that effects state are taken off."""
    zeros = dict.fromkeys(arm.joint_names, 0.0)
    for name, effect in arm.effects.items():
        for parameter, number in effect.zeros().items():
            zeros[arm.joint_names[number - 1]] += parameters[f"{arm.name}.{name}.{parameter}"].nominal[0]
    known = {joint.name: joint.limits for joint in arm.nominal_chain.joints if joint.limits is not None}
    return {joint: (low - zeros[joint], high - zeros[joint]) for joint, (low, high) in known.items()}


def warn_beyond_limits(dataset: Dataset, arms: Mapping[str, Arm], parameters: Parameters) -> Dataset:
    of_limits, of_tables = list[str](), list[str]()
    for name, arm in arms.items():
        if not len(dataset) or not all(map(dataset.has, arm.command_channels)):
            continue
        commands = arm.joint_commands([dataset.column(channel) for channel in arm.command_channels])
        joints = dict(zip(arm.joint_names, zip(arm.joint_dimensions, commands, strict=True), strict=True))
        for joint, ends in own_limits(arm, parameters).items():
            shown, (dimension, angles) = shown_joint(f"{name}.{joint}", arms), joints[joint]
            of_limits += _beyond(f"{shown} is beyond its limits", angles, ends, TOLERANCE[dimension], dimension)
        stepped = [effect.servos() for effect in arm.effects.values() if isinstance(effect, SteppedEffect)]
        for index, (table, clock) in (servo for servos in stepped for servo in servos.items()):
            shown, ends = shown_joint(f"{name}.{arm.joint_names[index]}", arms), (table.angles[0], table.angles[-1])
            half = clock.tick / table.least_slope / 2  # a board rounds to whole counts
            of_tables += _beyond(f"{shown} is beyond its pulse table", commands[index], ends, half, "angle")
    texts = [f"{'; '.join(of_limits)}: check the joints' order, signs and units."] if of_limits else []
    if of_tables:
        texts.append(
            f"{'; '.join(of_tables)}: pulses there are guessed along a straight line. Check the zero of the servo file "
            "(libraries that count from 0 to 180 deg have the middle at 90), or measure the table that far."
        )
    return replace(dataset, warnings=(*dataset.warnings, *texts))


def _beyond(what: str, values: Array, ends: Limits, tolerance: float, dimension: str) -> list[str]:
    over = np.maximum(ends[0] - values, values - ends[1])  # below zero inside
    over = np.nan_to_num(over, nan=-np.inf, neginf=-np.inf)
    if not (count := int(np.sum(over > tolerance))):
        return []
    worst = to_unit(float(values[int(np.argmax(over))]), display_unit(dimension).name)
    spread = span_text((float(np.nanmin(values)), float(np.nanmax(values))), dimension)
    return [f"{what} {span_text(ends, dimension)} in {count} of {len(values)} records, at worst {worst:.4g} ({spread})"]


def span_text(ends: Limits, dimension: str) -> str:
    """Two ends (rad or m) as people read them: ``-100 to 100 deg``."""
    unit = display_unit(dimension).name
    return " to ".join(f"{to_unit(end, unit):.4g}" for end in ends) + f" {unit}"
