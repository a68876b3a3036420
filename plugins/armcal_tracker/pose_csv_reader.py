"""Records from a CSV file as ``csv`` reads them, with orientations as quaternions or rotation matrices."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any, ClassVar, NoReturn, Self

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import DIMENSIONLESS
from armcal.calibration.rigid_chain import nominal_tools
from armcal.errors import DataError, Location
from armcal.measure.checks import Layout, require_records
from armcal.measure.layout import set_aside, warned
from armcal.measure.reader import ReadRequest, RequestedChannel
from pydantic import model_validator
from scipy.spatial.transform import Rotation

from armcal_tracker.csv_reader import CsvReader, CsvSettings
from armcal_tracker.orientation import (
    QUATERNION,
    AnglesColumns,
    EulerColumns,
    Orientation,
    QuaternionColumns,
    RotationColumns,
    VectorColumns,
    reflections,
)

TOLERANCE = 1e-3
"""How far a quaternion's length may be from one, or an entry of R^T R from the identity's."""
MOST_FAULTY = 0.05
WORST = ((5.0, 3.0), (0.5, 10.0))
"""The declared meaning of the columns is refused if it fits the arm worse than this (deg), and so many times worse than
another; the second where the body hardly turned, as where a probe must face its tracker."""
_ZERO = 1e-6
FEWEST = 6
_STRIDES = (1, 2, 3, 5, 7, 11, 17)
_MOST_PAIRS = 4000
_LARGEST_TURN_RAD = 2.6
"""Beyond it a rotation vector may jump to the other end of its axis."""


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
        if sum(given is not None for given in self._given()) != 1:
            raise ValueError(
                "expected one of quaternion: {columns: [...], order: xyzw}, rotation: {columns: [...]}, "
                "rpy: {columns: [...], unit: deg}, euler: {columns: [...], order: XYZ, unit: deg} "
                "and rotation_vector: {columns: [...], unit: rad}"
            )
        return self

    def _given(self) -> tuple[Orientation | None, ...]:
        return self.quaternion, self.rotation, self.rpy, self.euler, self.rotation_vector

    @property
    def orientation(self) -> Orientation:
        return next(orientation for orientation in self._given() if orientation is not None)


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
        """The records of the file, in SI; ``rows`` are lines, the header's being 1.

        Raises:
            DataError: with file, line and column; or the orientations are not those of this arm.
        """
        s, instance = self._settings, self._instance(request)
        mapped = {f"{instance}.{name}": own for name, own in self._orientation.mapped().items()}
        columns = {**s.columns, **mapped}
        reader = CsvReader(CsvSettings(path=s.path, columns=columns, delimiter=s.delimiter, decimal=s.decimal))
        # the file's numbers in place of the quaternion; they cannot be absent
        quaternion = {f"{instance}.{name}" for name in QUATERNION}
        rest = [channel for channel in request.channels if channel.channel not in quaternion]
        own = [RequestedChannel(name, (name,), DIMENSIONLESS, True, parts=(instance,)) for name in mapped]
        dataset = reader.read(replace(request, channels=(*rest, *own)))
        dataset = self._without_faulty(dataset, tuple(mapped))
        values = dataset.stacked(tuple(mapped)).T
        made = np.flatnonzero(~np.isnan(values).any(axis=1))
        mirrored = reflections(values[made])
        if mirrored.size:
            text = f"found {mirrored.size} of {len(made)} rotation matrices that are reflections (determinant -1)."
            hint = "Check the order and signs of the columns, and that the frames are right-handed."
            self._refuse(text, hint, dataset.rows[made[mirrored[0]]])
        self._refuse_other_meaning(dataset.subset(made), request, instance, values[made])
        return self._with_quaternions(dataset, instance, values, made)

    def _instance(self, request: ReadRequest) -> str:
        reading = [name for name, m in request.measurements.items() if {c.name for c in m.channels()} >= {*QUATERNION}]
        named = self._settings.measurement
        if named in reading or (named is None and len(reading) == 1):
            return named or reading[0]
        self._refuse(
            f"found {', '.join(reading) or 'no measurement'} to read orientations, expected {named or 'one'}.",
            "Add a measurement tip_pose, or set measurement: NAME in the data section.",
        )

    def _without_faulty(self, dataset: Dataset, channels: tuple[str, ...]) -> Dataset:
        """Set aside what is no rotation; refuse the file if that is more than a few."""
        values, kind = dataset.stacked(channels).T, self._orientation.kind
        made = ~np.isnan(values).any(axis=1)
        off, size = self._orientation.fault(values), self._orientation.size(values)
        zero, wrong = made & (size < _ZERO), made & (size >= _ZERO) & (off > TOLERANCE)
        if wrong.sum() > MOST_FAULTY * made.sum():
            first = int(np.flatnonzero(wrong)[0])
            text = f"found {wrong.sum()} of {made.sum()} orientations that are no {kind}, the first off by"
            hint = "Check that the columns are those of the orientation, and in this order."
            self._refuse(f"{text} {off[first]:.3g} (more than {TOLERANCE:g}).", hint, dataset.rows[first])
        faulty = {int(i): f"its {kind} is zero" for i in np.flatnonzero(zero)}
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
        if any(declared > worst and declared > times * others[best] for worst, times in WORST):
            self._refuse(
                f"orientations turn unlike the nominal arm: with {self._orientation.declared} the turns between "
                f"records are off by {declared:.2f} deg (median), with {best} by {others[best]:.2f} deg.",
                "Correct the order of the columns, or give base_T_body's orientation.",
            )

    def _with_quaternions(self, dataset: Dataset, instance: str, values: Array, made: Array) -> Dataset:
        """Unit quaternions, of a sign that does not jump back and forth for nothing."""
        quaternions = np.full((len(dataset), 4), np.nan)
        quaternions[made] = self._orientation.rotations(values[made]).as_quat()[:, [3, 0, 1, 2]]
        negative = quaternions[:, 0] < 0
        quaternions[negative] *= -1
        given = {f"{instance}.{name}" for name in self._orientation.mapped()}
        channels = {name: numbers for name, numbers in dataset.channels.items() if name not in given}
        channels |= {f"{instance}.{name}": quaternions[:, i] for i, name in enumerate(QUATERNION)}
        dataset = replace(dataset, channels=channels)
        if self._settings.quaternion is None or not negative.any():
            return dataset
        text = (
            f"{negative.sum()} of {len(made)} quaternions had qw below 0 and were negated, which is the same rotation."
        )
        return warned(dataset, text)

    def _refuse(self, message: str, hint: str, line: int | None = None) -> NoReturn:
        raise DataError(message, where=Location(str(self._settings.path), line=line), hint=hint)


def nominal_rotations(arm: Arm, dataset: Dataset) -> Rotation:
    """base_T_tool's rotation of the nominal arm in each record, without its effects."""
    commands = dataset.stacked([*arm.command_channels])
    return Rotation.from_matrix(nominal_tools(arm, commands.T)[:, :3, :3])


def misfit(measured: Rotation, nominal: Rotation) -> float:
    """How far measured turns between records are from the nominal ones (rad, the median of pairs of records).

    Turns from record to record, seen from the body, are the nominal ones seen from the tool: both sets of rotation
    vectors differ by one rotation, which is found first. [Park1994] Angles alone would not do: they stay the same
    when a quaternion's components are exchanged, and when all rotations are inverted.
    """
    index = np.arange(len(nominal))
    pairs = [(index[:-stride], index[stride:]) for stride in _STRIDES if stride < len(nominal)]
    if not pairs:
        return 0.0
    first, second = (np.concatenate(ends) for ends in zip(*pairs, strict=True))
    step = max(1, len(first) // _MOST_PAIRS)
    first, second = first[::step], second[::step]
    turned = (nominal[first].inv() * nominal[second]).as_rotvec()
    seen = (measured[first].inv() * measured[second]).as_rotvec()
    usable = np.linalg.norm(turned, axis=1) < _LARGEST_TURN_RAD
    turned, seen = turned[usable], seen[usable]
    if len(turned) < FEWEST:
        return 0.0
    left, _, right = np.linalg.svd(turned.T @ seen)
    tool_T_body = left @ np.diag([1.0, 1.0, np.linalg.det(left @ right)]) @ right
    return float(np.median(np.linalg.norm(turned @ tool_T_body - seen, axis=1)))
