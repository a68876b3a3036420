"""Where the arm stood for each image: joint angles, or poses of the flange, from a file.

Hand-eye calibration needs no more than the flange's pose. It is that of a chain of three sliding joints and three
turning ones, so all that works for arms works for it; what its controller gets wrong is noise or an effect of these.

A controller computes the pose that it shows from the joints by its own nominal model, so the same model gives them
back. Of several postures for a pose the sequence decides: the one that moves the joints least from pose to pose.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from armcal.arm.assembly import Arm
from armcal.arm.effects import JOINT_RATE
from armcal.arm.model import Attachment, Chain, Joint
from armcal.arm.statics import Environment
from armcal.base import se3
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.parameters import ParameterBlock, Parameters
from armcal.base.quaternions import nearest_rotation
from armcal.base.settings import Settings
from armcal.base.units import DIMENSIONLESS, split_suffix
from armcal.calibration.compensation import Options, nominal_arm
from armcal.calibration.inverse import different
from armcal.errors import DataError
from armcal.io.plain_files import input_bytes, refuse, text_of
from armcal.measure.checks import read_as, warned
from armcal.measure.measurement import Channel
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal.measure.tables import is_number
from armcal.plugins import discover
from scipy.spatial.transform import Rotation

FLANGE = ("x", "y", "z", "rz", "ry", "rx")
"""Joints of an arm whose flange's pose is read: base_T_flange turns by Rz(rz) Ry(ry) Rx(rx)."""
_STILL = (0.0, 0.0, 0.0)
_AXES = {"x": (1.0, 0.0, 0.0), "y": (0.0, 1.0, 0.0), "z": (0.0, 0.0, 1.0)}
_STARTS = 96


class FlangePoseSettings(Settings):
    """Nothing to set: the flange's pose is recorded."""


class FlangePose:
    """The arm model ``flange_pose``: "joints" x, y, z (m) and rz, ry, rx (rad).

    base_T_flange has the translation (x, y, z) and the rotation Rz(rz) Ry(ry) Rx(rx).
    """

    Settings: ClassVar[type[FlangePoseSettings]] = FlangePoseSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}
    joint_names: tuple[str, ...] = FLANGE

    def __init__(self, settings: FlangePoseSettings) -> None:
        self._settings = settings

    def parameters(self) -> Sequence[ParameterBlock]:
        return ()

    def chain(self, values: Mapping[str, Any]) -> Chain:
        slides = [Joint(axis, se3.identity(), _STILL, direction) for axis, direction in _AXES.items()]
        turns = [Joint(f"r{axis}", se3.identity(), _AXES[axis]) for axis in "zyx"]
        return Chain(se3.identity(), (*slides, *turns), Attachment(6, se3.identity()))


def recovered_joints(arm: Arm, poses: Array, near: Array) -> tuple[Array, Array]:
    """Commands (n x N; rad or m) at which the nominal arm is in these poses, and how many postures each has (N).

    Poses are base_T_tool (N x 4 x 4, m); ``near`` is about where the joints are in the first one (n; rad or m). NaN
    where no posture within the joints' limits reaches a pose.
    """
    nominal = nominal_arm(arm, Parameters(tuple(arm.parameters())), Environment(_STILL), Options())
    targets = nominal.targets(poses[:, :3, 3], poses[:, :3, :3])
    turning = np.array([kind == "angle" for kind in arm.commanded.values()])[:, None]
    endless = turning & ~np.isfinite(nominal.limits).all(axis=1, keepdims=True)
    options = list[Array]()
    for commands in nominal.postures(targets, _STARTS):
        wrapped = np.where(endless, (commands + np.pi) % (2 * np.pi) - np.pi, commands)
        options.append(different(wrapped).T)
    return _shortest(options, near), np.array([len(own) for own in options])


def _shortest(options: list[Array], near: Array) -> Array:
    """One option a pose (n x N), so that joints move least in all; poses without one are passed over (NaN)."""
    commands = np.full((len(near), len(options)), np.nan)
    places = [i for i, own in enumerate(options) if len(own)]
    if not places:
        return commands
    cost, back = np.abs(options[places[0]] - near).sum(axis=1), []
    for before, here in pairwise(places):
        ways = cost[:, None] + np.abs(options[before][:, None] - options[here][None]).sum(axis=2)
        back.append(np.argmin(ways, axis=0))
        cost = ways.min(axis=0)
    chosen = int(np.argmin(cost))
    for number in reversed(range(len(places))):
        commands[:, places[number]] = options[places[number]][chosen]
        chosen = int(back[number - 1][chosen]) if number else chosen
    return commands


_QUATERNION = ("qw", "qx", "qy", "qz")
_LONGEST_STEP_S = 0.2
_MAX_BYTES = 256 * 1024**2
_INSTANCE = "flange"
_FORMS = (
    "Give base_T_flange row by row, or name the columns in a first line: x_mm,y_mm,z_mm,qw,qx,qy,qz. For angles write "
    "poses: {type: pose_csv, path: FILE, rpy: {columns: [...], unit: deg}}, or euler, or rotation_vector."
)
_TURNS = (("roll", "pitch", "yaw"), ("rx", "ry", "rz"), ("w", "p", "r"), ("a", "b", "c"))
"""Angles of a pose as robots call them."""
_UNREACHED = "the nominal arm reaches this pose in no posture within its joints' limits"


@dataclass(frozen=True)
class _FlangeReading:
    """Stands for a measurement that reads a pose, so that readers of poses read one."""

    arms: tuple[str, ...] = ("",)

    def channels(self) -> tuple[Channel, ...]:
        return (*(Channel(name, "length") for name in "xyz"), *(Channel(name, DIMENSIONLESS) for name in _QUATERNION))


def _in_joints(dataset: Dataset, arm: Arm, first: Mapping[str, float], places: Array, turns: Rotation) -> Dataset:
    """Records (N) with the joints at which the tool is in these poses (3 x N, m); those without any set aside."""
    names = [f"{arm.name}.{name}" for name in arm.commanded]
    if tuple(arm.commanded) == FLANGE:
        return _with(dataset, names, [*places, *np.unwrap(turns.as_euler("ZYX"), axis=0).T])
    tools = np.tile(np.eye(4), (len(dataset), 1, 1))
    tools[:, :3, :3], tools[:, :3, 3] = turns.as_matrix(), places.T
    unknown = sorted(set(first) - set(arm.commanded))
    if unknown:
        have = ", ".join(arm.commanded)
        raise DataError(f"data.first: found {', '.join(unknown)}, expected joints of the arm: {have}.")
    near = np.array([first.get(name, 0.0) for name in arm.commanded])
    commands, postures = recovered_joints(arm, tools, near)
    text = (
        "joint angles are recovered from poses by the nominal arm: of up to "
        f"{int(postures.max(initial=0))} postures a pose the ones that move the joints least. "
        "Check them, or give first: {JOINT: ANGLE} of the first pose and the joints' limits in the model."
    )
    unreached = dict.fromkeys(map(int, np.flatnonzero(~np.isfinite(commands[0]))), _UNREACHED)
    return warned(_with(dataset, names, [*commands]).without(unreached), text)


def _with(dataset: Dataset, names: Sequence[str], rows: Sequence[Array]) -> Dataset:
    own = {name: np.ascontiguousarray(row) for name, row in zip(names, rows, strict=True)}
    return replace(dataset, channels={**dataset.channels, **own})


def read_poses(
    poses: Path | dict[str, Any], request: ReadRequest, cameras: tuple[str, ...], first: Mapping[str, float]
) -> Dataset:
    """The records of a file of poses, or of the settings of a reader, without what the cameras read.

    Of an arm with joints, poses are those of its nominal tool, and give its joint angles (``recovered_joints``);
    ``first`` says about where these are in the first pose, by name (rad or m).
    """
    channels = tuple(w for w in request.channels if w.channel.partition(".")[0] not in cameras)
    rates = [w for w in channels if w.dimension == JOINT_RATE and (w.required or w.is_evidence)]
    channels = tuple(replace(w, required=w.required and w not in rates) for w in channels)
    rest = {name: m for name, m in request.measurements.items() if name not in cameras}
    request = ReadRequest(request.arms, rest, channels)
    arm = next(iter(request.arms.values())) if len(request.arms) == 1 else None
    settings: dict[str, Any] = {"type": "csv", "path": str(poses)} if isinstance(poses, Path) else dict(poses)
    if isinstance(poses, Path) and arm is not None:
        header = _first_line(poses)
        if header and all(is_number(cell) for cell in header):
            return _table(poses, arm, first, request)
        if set(_QUATERNION) <= set(header):
            settings |= {"type": "pose_csv", "quaternion": {"columns": _QUATERNION, "order": "wxyz"}}
        else:
            _refuse_angles_of_pose(poses, header, arm)
    kind = str(settings.pop("type", "csv"))
    component = discover().find("reader", kind).load()
    reader = component(component.Settings.model_validate(settings))
    if arm is not None and kind == "pose_csv":
        return _with_rates(_flange_poses(reader, arm, first, request), rates)
    return _with_rates(reader.read(request), rates)


def _with_rates(dataset: Dataset, rates: Sequence[RequestedChannel]) -> Dataset:
    """Rates of joints (rad/s or m/s) that the file has not, from the times of its rows.

    Times that do not say how fast a joint was are refused, but not where only the verdict would read it.
    """
    missing = [w for w in rates if not dataset.has(w.channel)]
    if not missing:
        return dataset
    hint = (
        f"Give a column time_s and rows at most {_LONGEST_STEP_S:g} s apart (those without an image serve for rates "
        f"alone), or columns {missing[0].channel}_deg_s and so on."
    )
    steps = np.diff(dataset.column("time")) if dataset.has("time") else np.zeros(0)
    if len(steps) < 2 or steps.min() <= 0 or steps.max() > _LONGEST_STEP_S:
        if all(w.is_evidence for w in missing):
            return dataset
        spacing = f"rows up to {steps.max():.3g} s apart" if len(steps) else "no times"
        message = f"found {spacing}, expected how fast joints were: {missing[0].what}."
        raise DataError(message, where=dataset.where(), hint=hint)
    joints = {name.rpartition(".")[2]: name for name in dataset.channels}
    rows = [
        np.gradient(dataset.column(joints[w.channel.removesuffix("_rate")]), dataset.column("time")) for w in missing
    ]
    return _with(dataset, [w.channel for w in missing], rows)


def _first_line(path: Path) -> list[str]:
    text = text_of(input_bytes(path, _MAX_BYTES, "a file of poses"), path, "Save it as text in UTF-8.")
    lines = (line for line in text.splitlines() if line.strip() and not line.startswith("#"))
    return next((line.replace(",", " ").split() for line in lines), [])


def _refuse_angles_of_pose(path: Path, header: Sequence[str], arm: Arm) -> None:
    """Refuse columns of a place and of three turns where joint angles are expected: conventions of turns differ."""
    names = {(split_suffix(name) or (name,))[0].lower(): name for name in header}
    turns = next((three for three in _TURNS if names.keys() >= {*three, "x", "y", "z"}), None)
    if turns is None or names.keys() >= {name.lower() for name in arm.commanded}:
        return
    place, columns = (", ".join(names[name] for name in three) for three in ("xyz", turns))
    unit = "rad" if columns.endswith("_rad") else "deg"
    refuse(
        path,
        f"found {place}, {columns}: a pose of the flange by three angles, which robots write in several ways.",
        f"Say which: poses: {{type: pose_csv, path: {path.name}, rpy: {{columns: [{columns}], unit: {unit}}}}} for "
        "turns about the fixed axes x, y, z (roll, pitch, yaw); euler, with its order, for turns about moving axes; "
        "rotation_vector for an axis times an angle (Universal Robots). A quaternion is qw, qx, qy, qz.",
        1,
    )


def _flange_poses(reader: Any, arm: Arm, first: Mapping[str, float], request: ReadRequest) -> Dataset:
    reading: Any = _FlangeReading()
    others = tuple(w for w in request.channels if not w.channel.startswith(f"{arm.name}."))
    own = tuple(
        RequestedChannel(f"{_INSTANCE}.{c.name}", (c.name,), c.dimension, True, parts=(_INSTANCE,))
        for c in reading.channels()
    )
    dataset = reader.read(ReadRequest({}, {_INSTANCE: reading}, (*others, *own)))
    places, turns = (
        dataset.stacked([f"{_INSTANCE}.{name}" for name in names]) for names in ("xyz", ("qx", "qy", "qz", "qw"))
    )
    kept = {name: numbers for name, numbers in dataset.channels.items() if not name.startswith(f"{_INSTANCE}.")}
    return _in_joints(replace(dataset, channels=kept), arm, first, places, Rotation.from_quat(turns.T))


def _rows(text: str) -> list[tuple[int, list[str]]]:
    written = ((i, line.replace(",", " ").split()) for i, line in enumerate(text.splitlines(), start=1))
    rows = [(i, cells) for i, cells in written if cells and not cells[0].startswith("#")]
    if len(rows) % 4 or any(len(cells) != 4 for _, cells in rows):
        return rows
    return [(rows[i][0], [cell for _, cells in rows[i : i + 4] for cell in cells]) for i in range(0, len(rows), 4)]


def _table(path: Path, arm: Arm, first: Mapping[str, float], request: ReadRequest) -> Dataset:
    """base_T_flange in metres, row by row: 12 or 16 numbers a line, or a matrix in four lines of four."""
    content = input_bytes(path, _MAX_BYTES, "a table of flange poses")
    matrices, lines = [], []
    for line, cells in _rows(content.decode("utf-8-sig")):
        if len(cells) not in (12, 16) or not all(is_number(cell) for cell in cells):
            refuse(path, f"found {len(cells)} cells, expected 12 or 16 numbers.", _FORMS, line)
        matrix = np.array([float(cell) for cell in cells]).reshape(-1, 4)
        if len(matrix) == 4 and np.abs(matrix[3] - [0, 0, 0, 1]).max() > 1e-6:
            refuse(path, "found a matrix whose last row is not 0 0 0 1.", "Give the matrix row by row.", line)
        try:
            matrix[:3, :3] = nearest_rotation(matrix[:3, :3])
        except ValueError as fault:
            refuse(path, f"{fault}.", "Give base_T_flange row by row, in metres.", line)
        matrices.append(matrix[:3])
        lines.append(line)
    poses = np.array(matrices)
    bare = Dataset(tuple(map(str, lines)), {}, rows=tuple(lines), source=str(path))
    return read_as(_in_joints(bare, arm, first, poses[:, :, 3].T, Rotation.from_matrix(poses[:, :, :3])), request)
