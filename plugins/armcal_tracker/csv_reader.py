"""Records from a CSV file: a header, columns by name with their unit as suffix (``q1_deg``, ``x_mm``).

With orientations in it, too (``pose_csv``).
"""

import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.settings import InputPath, Settings
from armcal.base.units import DIMENSIONLESS, from_unit
from armcal.calibration.rigid_chain import nominal_tools
from armcal.errors import DataError, Location
from armcal.io.plain_files import refuse
from armcal.measure.checks import Layout, read_as, require_records, set_aside, warned
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal.measure.tables import (
    DECIMAL_COMMA,
    Column,
    Header,
    Plan,
    Row,
    Table,
    header_of,
    is_number,
    match_columns,
    open_table,
    read_cell,
    renamed,
    with_point,
)
from pydantic import Field, model_validator
from scipy.spatial.transform import Rotation
from typing_extensions import override


class CsvSettings(Settings):
    """Which file, and what its columns are called.

    ``columns`` maps a name with its unit to the file's own: ``{q1_deg: joint_1_deg}``, or
    ``{q1_deg: J1}`` for a column without its unit. ``decimal`` is the sign before the fraction of every number.
    """

    path: InputPath
    columns: dict[str, str] = Field(default_factory=dict)
    delimiter: Literal[",", ";", "\t", "|"] = ","
    decimal: Literal[".", ","] = "."

    @model_validator(mode="after")
    def _two_signs(self) -> Self:
        if self.decimal == self.delimiter:
            raise ValueError('found a comma as delimiter and as decimal, expected two signs: set delimiter: ";"')
        return self


class CsvReader:
    """The reader ``csv``."""

    Settings: ClassVar[type[CsvSettings]] = CsvSettings

    def __init__(self, settings: CsvSettings) -> None:
        self._settings = settings

    def read(self, request: ReadRequest) -> Dataset:
        """The records of the file, in SI; ``rows`` are lines, the header's being 1."""
        s, source = self._settings, str(self._settings.path)
        with open_table(s.path, delimiter=s.delimiter) as table:
            line, cells = table.first
            header = header_of(cells, source, line, request.layout_hint)
            if len(cells) == 1:
                _refuse_delimiter(header, s.delimiter, table.rest)
            header = renamed(header, s.columns)
            plan = match_columns(header, request.channels)
            dataset = _load(table, header, plan, s.decimal == ",")
        names = {channel: column.name for channel, (column, _) in plan.channels.items()}
        units = {channel: unit for channel, (_, unit) in plan.channels.items()}
        return read_as(dataset, request, names, units)


def _refuse_delimiter(header: Header, delimiter: str, rows: Iterator[Row]) -> None:
    """A header of one cell that holds another delimiter."""
    name = header.columns[0].name
    other = next((d for d in ";\t|," if d in name and d != delimiter), None)
    if other is None:
        return
    _, cells = next(rows, (0, []))
    parts = [part.strip('" ') for part in delimiter.join(cells).split(other)]
    comma = next((part for part in parts if DECIMAL_COMMA.fullmatch(part)), None)
    text = f"found {other!r} between the columns, expected {delimiter!r}"
    written = other.replace("\t", "\\t")
    mend = f'Set delimiter: "{written}" in the data section'
    if comma is None:
        header.refuse_layout(f"{text}.", f"{mend}.")
    text = f"{text}, and numbers with a decimal comma ({comma})."
    header.refuse_layout(text, f'{mend}, and decimal: ",".')


def _load(table: Table, header: Header, plan: Plan, has_commas: bool) -> Dataset:
    """All rows; records without an id are set aside."""
    named, by_name = [*plan.channels.items()], {column.name: column for column in header.columns}
    texts = [column.index for column in plan.extra]

    def number(line: int, cell: str, name: str) -> float:
        return _number(cell, line, by_name[name], header, has_commas)

    read = table.columns(
        [(column.index, column.name) for _, (column, _) in named],
        texts if plan.record_id is None else [*texts, plan.record_id.index],
        number=number,
        plain=not has_commas,
    )
    if not read.lines:
        header.refuse("found a header and no records.", "Add one line a record.")
    ids = [cell.strip() for cell in read.texts[-1]] if plan.record_id else [*map(str, read.lines)]
    channels = {
        channel: from_unit(column, unit) for (channel, (_, unit)), column in zip(named, read.numbers, strict=True)
    }
    extra = {column.known_as: cells for column, cells in zip(plan.extra, read.texts, strict=False)}
    dataset = Dataset(tuple(ids), channels, extra, read.lines, header.source, table.sha256)
    nameless = {i: "its id is empty" for i, name in enumerate(ids) if not name}
    if not nameless:
        return dataset
    warning = f"{header.source}: {len(nameless)} records without an id were set aside. Give each its own id."
    return replace(dataset.without(nameless), warnings=(warning,))


def _number(cell: str, line: int, column: Column, header: Header, has_commas: bool) -> float:
    """One cell; NaN if its value is missing."""
    try:
        if not has_commas:
            return read_cell(cell)
        if "." in cell and is_number(cell):
            hint = 'Write 12,5, or leave decimal: "," out.'
            raise DataError(f"found {cell!r}, expected a decimal comma.", hint=hint)
        return read_cell(with_point(cell) if DECIMAL_COMMA.fullmatch(cell) else cell)
    except DataError as fault:
        where = Location(header.source, line=line, field=column.name)
        if cell.strip() == column.name:
            raise DataError("found the header again.", where=where, hint="Remove this line.") from fault
        is_comma = not (has_commas or header.layout_hint) and DECIMAL_COMMA.fullmatch(cell)
        other = ' Or set decimal: "," in the data section, if all numbers of the file have one.' if is_comma else ""
        raise DataError(fault.message, where=where, hint=fault.hint + other) from fault


QUATERNION = ("qw", "qx", "qy", "qz")


class Orientation(Settings):
    """The columns of base_T_body's rotation as they stand in the file; values are their numbers, a row a record."""

    kind: ClassVar[str]  # What one of them is called
    columns: tuple[str, ...]

    @property
    def declared(self) -> str:
        raise NotImplementedError

    @property
    def names(self) -> Sequence[str]:
        return [f"turn{i}" for i in range(1, len(self.columns) + 1)]

    def fault(self, values: Array) -> Array:
        """How far each is from a rotation or a reflection (N); any three angles are a rotation, three zeros too."""
        return np.zeros(len(values))

    def rotations(self, values: Array) -> Rotation:
        raise NotImplementedError

    def others(self, values: Array) -> Mapping[str, Rotation]:
        """What the columns could mean as well, in words."""
        raise NotImplementedError

    def unusual(self, values: Array) -> Mapping[str, Rotation]:
        """What else they could mean; so many that one has to fit ten times better."""
        return {}


class QuaternionColumns(Orientation):
    """The four columns of a quaternion, as they stand in the file, and in which order its parts stand in them."""

    kind = "quaternion"
    columns: tuple[str, str, str, str]
    order: Literal["xyzw", "wxyz"]

    @property
    @override
    def declared(self) -> str:
        return f"order: {self.order}"

    @property
    @override
    def names(self) -> Sequence[str]:
        return [f"q{part}" for part in self.order]

    @override
    def fault(self, values: Array) -> Array:
        return np.asarray(np.abs(np.linalg.norm(values, axis=1) - 1))

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_quat(values[:, [self.order.index(part) for part in "xyzw"]])

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        """The other order; it is the inverse between two fixed rotations, so that no turn of records shows it."""
        other = "wxyz" if self.order == "xyzw" else "xyzw"
        exchanged = Rotation.from_quat(values[:, [other.index(part) for part in "xyzw"]])
        return {f"order: {other}, or as body_T_base,": exchanged}


class RotationColumns(Orientation):
    """The nine columns of a rotation matrix, row by row."""

    kind = "rotation matrix"
    columns: tuple[str, str, str, str, str, str, str, str, str]

    @property
    @override
    def declared(self) -> str:
        return "the matrix row by row"

    @override
    def fault(self, values: Array) -> Array:
        matrices = values.reshape(-1, 3, 3)
        squares = np.swapaxes(matrices, 1, 2) @ matrices
        return np.asarray(np.abs(squares - np.eye(3)).max(axis=(1, 2)))

    @override
    def rotations(self, values: Array) -> Rotation:
        return Rotation.from_matrix(values.reshape(-1, 3, 3))

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        return {"it column by column, that is as body_T_base,": self.rotations(values).inv()}


class AnglesColumns(Orientation):
    """The three columns of roll, pitch and yaw: R = Rz(yaw) Ry(pitch) Rx(roll), turns about fixed axes."""

    kind = "triple of roll, pitch and yaw"
    columns: tuple[str, str, str]
    unit: Literal["deg", "rad"]

    @property
    @override
    def declared(self) -> str:
        return f"R = Rz(yaw) Ry(pitch) Rx(roll) in {self.unit}"

    @property
    def axes(self) -> str:
        """The order of the turns as SciPy has it; empty for a rotation vector."""
        return "xyz"

    @property
    def other_axes(self) -> Mapping[str, str]:
        return {"it as rotation_vector": "", "R = Rx(roll) Ry(pitch) Rz(yaw)": "XYZ"}

    @override
    def rotations(self, values: Array) -> Rotation:
        return _turned(self.axes, values, self.unit)

    @override
    def others(self, values: Array) -> dict[str, Rotation]:
        other = "rad" if self.unit == "deg" else "deg"
        return {
            **{words: _turned(axes, values, self.unit) for words, axes in self.other_axes.items()},
            "it as that of body_T_base": self.rotations(values).inv(),
            f"unit: {other}": _turned(self.axes, values, other),
        }

    @override
    def unusual(self, values: Array) -> dict[str, Rotation]:
        """Each order of the turns, and each sign of the angles."""
        meanings = {}
        for signs in sorted(itertools.product((1, -1), repeat=3), reverse=True, key=sum):
            turned = [name for name, sign in zip(self.columns, signs, strict=True) if sign < 0]
            words = f" with {', '.join(turned)} negated" if turned else ""
            for axes in dict.fromkeys((self.axes, *ORDERS, "")):
                name = f"order: {axes}" if axes else "it as rotation_vector"
                meanings[f"{name}{words}"] = _turned(axes, values * signs, self.unit)
        return meanings


def _turned(axes: str, values: Array, unit: str) -> Rotation:
    degrees = unit == "deg"
    return Rotation.from_euler(axes, values, degrees) if axes else Rotation.from_rotvec(values, degrees)


class EulerColumns(AnglesColumns):
    """The three columns of Euler angles, and their convention, as SciPy has it.

    ``order`` names the axes in the order of the columns: small letters are turns about fixed axes (``xyz``: R = Rz Ry
    Rx, as ``rpy``), capitals about the axes that turned before (``XYZ``: R = Rx Ry Rz).
    """

    kind = "triple of Euler angles"
    order: Annotated[str, Field(pattern="^([xyz]{3}|[XYZ]{3})$")]

    @model_validator(mode="after")
    def _three_turns(self) -> Self:
        if self.order[0] == self.order[1] or self.order[1] == self.order[2]:
            raise ValueError(f"found the order {self.order!r}, expected neighbours to differ: XYZ, ZYX, ZYZ, xyz, ...")
        return self

    @property
    @override
    def declared(self) -> str:
        return f"order: {self.order} in {self.unit}"

    @property
    @override
    def axes(self) -> str:
        return self.order

    @property
    @override
    def other_axes(self) -> Mapping[str, str]:
        return {f"order: {self.order.swapcase()}": self.order.swapcase()}


class VectorColumns(AnglesColumns):
    """The three columns of a rotation vector: its direction is the axis, its length the angle."""

    kind = "rotation vector"

    @property
    @override
    def declared(self) -> str:
        return f"the rotation vector of base_T_body in {self.unit}"

    @property
    @override
    def axes(self) -> str:
        return ""

    @property
    @override
    def other_axes(self) -> Mapping[str, str]:
        return {"it as rpy": "xyz"}


ORDERS = ("xyz", "ZYX", "XYZ", "zyx", "ZYZ", "XZY", "YXZ", "YZX", "ZXY", "xzy", "yxz", "yzx", "zxy", "zyz")
TOLERANCE = 1e-3  # How far a quaternion's length may be from one, or an entry of R^T R from the identity's
MOST_FAULTY = 0.05
_SAMPLES = (".yaml", ".yml", ".samples")
WORST = ((5.0, 3.0), (0.5, 10.0))
"""The declared meaning of the columns is refused if it fits the arm worse than this (deg), and so many times worse than
another; the second where the body hardly turned, as where a probe must face its tracker."""
_ZERO = 1e-6
FEWEST = 6
_STRIDES = (1, 2, 3, 5, 7, 11, 17)
_MOST_PAIRS = 4000
_LARGEST_TURN_RAD = 2.6  # Beyond it a rotation vector may jump to the other end of its axis


class PoseCsvSettings(CsvSettings):
    """As ``csv``, and base_T_body's orientation.

    One of ``quaternion``, ``rotation``, ``rpy``, ``euler`` and ``rotation_vector``.

    ``measurement`` names the measurement that reads orientations; by default the only one.
    """

    quaternion: QuaternionColumns | None = None
    rotation: RotationColumns | None = None
    rpy: AnglesColumns | None = None
    euler: EulerColumns | None = None
    rotation_vector: VectorColumns | None = None
    measurement: str | None = None

    @model_validator(mode="after")
    def _one_orientation(self) -> Self:
        if len(self._given) != 1:
            raise ValueError(
                "expected one of quaternion: {columns: [...], order: xyzw}, rotation: {columns: [...]}, "
                "rpy: {columns: [...], unit: deg}, euler: {columns: [...], order: XYZ, unit: deg} "
                "and rotation_vector: {columns: [...], unit: rad}"
            )
        return self

    @property
    def _given(self) -> list[Orientation]:
        every = (self.quaternion, self.rotation, self.rpy, self.euler, self.rotation_vector)
        return [orientation for orientation in every if orientation is not None]

    @property
    def orientation(self) -> Orientation:
        return self._given[0]


class PoseCsvReader:
    """The reader ``pose_csv``: orientations become unit quaternions, ``INSTANCE.qw`` (never below 0) to ``INSTANCE.qz``."""  # noqa: E501

    Settings: ClassVar[type[PoseCsvSettings]] = PoseCsvSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "path": "/no/such/folder/measurements",
        "quaternion": {"columns": ["qx", "qy", "qz", "qw"], "order": "xyzw"},
    }

    def __init__(self, settings: PoseCsvSettings) -> None:
        self._settings = settings
        self._orientation = settings.orientation

    def read(self, request: ReadRequest) -> Dataset:
        """The records of the file, in SI; ``rows`` are lines, the header's being 1."""
        s, instance = self._settings, self._instance(request)
        if s.path.suffix in _SAMPLES:
            hint = f"Write data: {{type: pose_pairs, path: {s.path.name}, mounting: eye_to_hand}}, or eye_in_hand."
            refuse(s.path, "it is no CSV file; samples of a program for hand-eye calibration are read as pairs.", hint)
        names = [f"{instance}.{name}" for name in self._orientation.names]
        columns = {**s.columns, **dict(zip(names, self._orientation.columns, strict=True))}
        reader = CsvReader(CsvSettings(path=s.path, columns=columns, delimiter=s.delimiter, decimal=s.decimal))
        # the file's numbers in place of the quaternion; they cannot be absent
        quaternion = {f"{instance}.{name}" for name in QUATERNION}
        rest = [channel for channel in request.channels if channel.channel not in quaternion]
        own = [RequestedChannel(name, (name,), DIMENSIONLESS, True, parts=(instance,)) for name in names]
        dataset = reader.read(replace(request, channels=(*rest, *own)))
        dataset = self._without_faulty(dataset, names)
        values = dataset.stacked(names).T
        made = np.flatnonzero(~np.isnan(values).any(axis=1))
        mirrored = np.flatnonzero(np.linalg.det(values[made].reshape(-1, 3, 3)) < 0) if s.rotation else made[:0]
        if mirrored.size:
            text = f"found {mirrored.size} of {len(made)} rotation matrices that are reflections (determinant -1)."
            hint = "Check the order and signs of the columns, and that the frames are right-handed."
            refuse(s.path, text, hint, dataset.rows[made[mirrored[0]]])
        self._refuse_other_meaning(dataset.subset(made), request, instance, values[made])
        return self._with_quaternions(dataset, instance, names, values, made)

    def _instance(self, request: ReadRequest) -> str:
        reading = [name for name, m in request.measurements.items() if {c.name for c in m.channels()} >= {*QUATERNION}]
        named = self._settings.measurement
        if named in reading or (named is None and len(reading) == 1):
            return named or reading[0]
        refuse(
            self._settings.path,
            f"found {', '.join(reading) or 'no measurement'} to read orientations, expected {named or 'one'}.",
            "Add a measurement tip_pose, or set measurement: NAME in the data section.",
        )

    def _without_faulty(self, dataset: Dataset, channels: Sequence[str]) -> Dataset:
        """Set aside what is no rotation; refuse the file if that is more than a few."""
        values, kind, path = dataset.stacked(channels).T, self._orientation.kind, self._settings.path
        made = ~np.isnan(values).any(axis=1)
        off, is_zero = self._orientation.fault(values), np.abs(values).max(axis=1) < _ZERO
        wrong = made & (off > TOLERANCE) & ~is_zero
        if wrong.sum() > MOST_FAULTY * made.sum():
            first = int(np.flatnonzero(wrong)[0])
            text = f"found {wrong.sum()} of {made.sum()} orientations that are no {kind}, the first off by"
            hint = "Check that the columns are those of the orientation, and in this order."
            refuse(path, f"{text} {off[first]:.3g} (more than {TOLERANCE:g}).", hint, dataset.rows[first])
        faulty = {int(i): f"its {kind} is zero" for i in np.flatnonzero(made & (off > TOLERANCE) & is_zero)}
        faulty |= {int(i): f"its {kind} is off by {off[i]:.3g}" for i in np.flatnonzero(wrong)}
        return require_records(
            set_aside(dataset, Layout(by_line=True), faulty, f"the {kind} is none", "Measure these again.")
        )

    def _refuse_other_meaning(self, dataset: Dataset, request: ReadRequest, instance: str, values: Array) -> None:
        """Refuse orientations that turn unlike the nominal arm, where another reading of the columns turns like it."""
        arm = request.arms.get(request.measurements[instance].arms[0])
        if arm is None or not len(dataset):
            return
        nominal = nominal_rotations(arm, dataset)
        declared = np.degrees(misfit(self._orientation.rotations(values), nominal))
        others = {name: np.degrees(misfit(r, nominal)) for name, r in self._orientation.others(values).items()}
        best = min(others, key=lambda name: others[name])
        if declared > WORST[1][0]:
            far = {name: np.degrees(misfit(r, nominal)) for name, r in self._orientation.unusual(values).items()}
            unusual = min(far, key=lambda name: far[name], default=best)
            if unusual in far and far[unusual] < min(declared / WORST[1][1], others[best] / WORST[0][1]):
                others, best = far, unusual
        if any(declared > worst and declared > times * others[best] for worst, times in WORST):
            refuse(
                self._settings.path,
                f"orientations turn unlike the nominal arm: with {self._orientation.declared} the turns between "
                f"records are off by {declared:.2f} deg (median), with {best} by {others[best]:.2f} deg.",
                "Correct the order of the columns or of the turns, or the signs, or give base_T_body's orientation.",
            )

    def _with_quaternions(
        self, dataset: Dataset, instance: str, given: Sequence[str], values: Array, made: Indices
    ) -> Dataset:
        """Unit quaternions, of a sign that does not jump back and forth for nothing."""
        quaternions = np.full((len(dataset), 4), np.nan)
        quaternions[made] = self._orientation.rotations(values[made]).as_quat()[:, [3, 0, 1, 2]]
        negative = quaternions[:, 0] < 0
        quaternions[negative] *= -1
        channels = {name: numbers for name, numbers in dataset.channels.items() if name not in given}
        channels |= {f"{instance}.{name}": quaternions[:, i] for i, name in enumerate(QUATERNION)}
        dataset = replace(dataset, channels=channels)
        if self._settings.quaternion is None or not negative.any():
            return dataset
        text = (
            f"{negative.sum()} of {len(made)} quaternions had qw below 0 and were negated, which is the same rotation."
        )
        return warned(dataset, text)


def nominal_rotations(arm: Arm, dataset: Dataset) -> Rotation:
    """base_T_tool's rotation of the nominal arm in each record, without its effects."""
    commands = dataset.stacked([*arm.command_channels])
    return Rotation.from_matrix(nominal_tools(arm, commands.T)[:, :3, :3])


def misfit(measured: Rotation, nominal: Rotation) -> float:
    """How far measured turns between records are from the nominal ones (rad, the median of pairs of records)."""
    return turned_alike(measured, nominal)[1]


def turned_alike(measured: Rotation, nominal: Rotation) -> tuple[Rotation | None, float]:
    """tool_T_body's rotation, None of too few records, and how far turns between records are off with it (rad).

    Turns from record to record, seen from the body, are the nominal ones seen from the tool: both sets of rotation
    vectors differ by one rotation, which is found first. [Park1994] Angles alone would not do: they stay the same
    when a quaternion's components are exchanged, and when all rotations are inverted.
    """
    index = np.arange(len(nominal))
    pairs = [(index[:-stride], index[stride:]) for stride in _STRIDES if stride < len(nominal)]
    if not pairs:
        return None, 0.0
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    step = max(1, len(first) // _MOST_PAIRS)
    first, second = first[::step], second[::step]
    turned = (nominal[first].inv() * nominal[second]).as_rotvec()
    seen = (measured[first].inv() * measured[second]).as_rotvec()
    usable = np.linalg.norm(turned, axis=1) < _LARGEST_TURN_RAD
    turned, seen = turned[usable], seen[usable]
    if len(turned) < FEWEST:
        return None, 0.0
    left, _, right = np.linalg.svd(turned.T @ seen)
    tool_T_body = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    off = float(np.median(np.linalg.norm(turned @ tool_T_body - seen, axis=1)))
    return Rotation.from_matrix(tool_T_body), off
