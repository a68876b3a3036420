"""Where an arm stood at rest in a data set, as records to calibrate from, and a camera's images of these moments."""

from __future__ import annotations

import difflib
import shlex
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

import casadi as ca
import numpy as np
from armcal.arm.joints import joint_limits
from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.calibration.tool_expression import arm_expression
from armcal.config.system import build_system
from armcal.config.yaml_source import load_config
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.io.cells import csv_text
from armcal.io.plain_files import write_over
from armcal.measure.rests import StillSettings, rests
from armcal.plugins import PluginRegistry, library

from armcal_lerobot.motor_file import Motor, MotorFile, Units, is_gripper
from armcal_lerobot.recordings import ACTION, STATE, Frames, Recording
from armcal_lerobot.tracking import require_degrees, require_percent, sides, unit_of

_POSES, _SEED = 2000, 1
_STEP_RAD = 1e-3


@dataclass(frozen=True)
class Follows:
    """Which joint a motor turns, and its sense: 1, or -1 where the joint turns the other way."""

    joint: str
    sense: int = 1


@dataclass(frozen=True)
class Cost:
    """Distances at the gripper (mm) over many poses: typical (the median) and largest."""

    typical_mm: float
    largest_mm: float

    @classmethod
    def of(cls, metres: Array) -> Cost:
        """Of distances (N, m)."""
        return cls(1000 * float(np.median(metres)), 1000 * float(np.max(metres)))


class Gripper:
    """An arm whose parameters are numbers: nominal ones of a configuration, calibrated ones of a calibration.

    Attributes:
        joints: those that are commanded, from the base to the tip.
        limits: of each, as the model states them (rad or m); None where it does not.
        has_masses: whether gravity does anything about its joints.
    """

    def __init__(self, path: Path, arm: str | None, wiring: Mapping[str, Follows], registry: PluginRegistry) -> None:
        source = load_config(path)
        if "armcal_calibration" in source.data:
            loaded = Calibration.load(path, registry)
            system, parameters = loaded.system, loaded.parameters
        else:
            # Where the gripper is needs no measurement: a file of the arm alone will do.
            system = build_system(replace(source, data={"measurements": {}, **source.data}), registry)
            parameters = system.parameters()
        self._where, arms = Location(str(path)), tuple(system.arms)
        self.name = arms[0] if arm is None and len(arms) == 1 else arm or ""
        if self.name not in arms:
            text = f"no arm is called {arm!r}." if arm else "found several arms."
            raise ConfigError(text, where=self._where, hint=f"Choose one of {', '.join(arms)} with --arm-name.")
        expression = arm_expression(system.arms[self.name], parameters, system.environment)
        self.joints = expression.joints
        self.limits = joint_limits(system.arms[self.name].nominal_chain)
        unknown = [follows.joint for follows in wiring.values() if follows.joint not in self.joints]
        if unknown:
            hint = f"Its joints are {', '.join(self.joints)}: --joint MOTOR=JOINT."
            raise ConfigError(f"found no joint {unknown[0]!r} in this arm.", where=self._where, hint=hint)
        self._wiring = {joint: (joint, 1) for joint in self.joints}
        self._wiring |= {follows.joint: (motor, follows.sense) for motor, follows in wiring.items()}
        record, rest = expression.defaults, ca.DM.zeros(expression.state.shape)
        commands = ca.SX.sym("commands", len(self.joints))
        full = ca.vertcat(commands, ca.DM(record[len(self.joints) :]))
        outputs = [ca.SX(ca.densify(part)) for part in (expression.base_T_tool.translation, expression.efforts)]
        symbols = ca.Function("rigid", [expression.record, expression.state], outputs)
        self._function = ca.Function("gripper", [commands], list(symbols(full, rest)))
        self.has_masses = bool(np.abs(self.efforts(np.full((len(self.joints), 1), 0.3))).max() > 1e-9)

    def positions(self, angles: Array) -> Array:
        """The tool frame's origin (3 x N; m, base frame) for joint angles (n x N; rad); springs are at rest."""
        return np.asarray(self._function.map(angles.shape[1])(angles)[0].full())

    def efforts(self, angles: Array) -> Array:
        """What gravity does about each joint (n x N; N m)."""
        return np.asarray(self._function.map(angles.shape[1])(angles)[1].full())[: len(self.joints)]

    def moved_m(self, angles: Array, by: Array) -> Array:
        """How far the gripper is moved (N, m) by changes of the joint angles (n x N; rad)."""
        return np.asarray(np.linalg.norm(self.positions(angles + by) - self.positions(angles), axis=0))

    def require(self, motors: Sequence[str]) -> None:
        """Raise InputError unless each joint has a motor of these, and each motor but the gripper's a joint."""
        missing = [joint for joint in self.joints if self._wiring[joint][0] not in motors]
        require_single([self._wiring[joint][0] for joint in self.joints])
        wired = {self._wiring[joint][0] for joint in self.joints}
        idle = [motor for motor in motors if motor not in wired and not is_gripper(motor)]
        if missing:
            stated = self._wiring[missing[0]][0]
            which = "no motor" if stated == missing[0] else f"no motor called {stated!r}"
            text = f"found {which} for the joint {missing[0]}; the motors are {', '.join(motors)}."
            mend = "None of them is without a joint: give the file of this arm, or the configuration of that one."
            if idle:
                nearest = difflib.get_close_matches(missing[0], idle, n=1, cutoff=0.0)[0]
                option = shlex.quote(f"{nearest}={missing[0]}")
                mend = f"Say which one turns it: --joint {option} (or =-{missing[0]})."
            raise InputError(text, where=self._where, hint=mend)

    def motor_of(self, joint: str) -> tuple[str, int]:
        return self._wiring[joint]

    @property
    def ranges(self) -> dict[str, float]:
        """By motor, how far its joint goes by the model (deg); infinite where that turns freely."""
        return {
            self.motor_of(joint)[0]: float(np.degrees(ends[1] - ends[0])) if ends else np.inf
            for joint, ends in self.limits.items()
        }

    def angles(self, degrees: Mapping[str, Array]) -> Array:
        """Joint angles (n x N; rad) of motor angles (N each; deg)."""
        rows = [sense * degrees[motor] for motor, sense in (self._wiring[joint] for joint in self.joints)]
        return np.asarray(np.radians(np.vstack(rows)))

    def poses(self, motors: Mapping[str, Motor]) -> Array:
        """Joint angles (n x N; rad) drawn evenly from the motors' ranges."""
        random = np.random.default_rng(_SEED)
        halves = {name: motor.half_range_deg for name, motor in motors.items()}
        return self.angles({name: random.uniform(-half, half, _POSES) for name, half in halves.items()})

    def per_degree(self, angles: Array) -> dict[str, Cost]:
        """By joint, what one degree costs over poses (n x N; rad)."""
        costs = {}
        for index, joint in enumerate(self.joints):
            by = np.zeros_like(angles)
            by[index] = _STEP_RAD
            costs[joint] = Cost.of(self.moved_m(angles, by) * np.radians(1.0) / _STEP_RAD)
        return costs

    def shifted(self, angles: Array, shifts_deg: Mapping[str, Array]) -> tuple[dict[str, Cost], Cost]:
        """What motors that stand elsewhere cost, by joint and all together.

        Args:
            angles: poses (n x N; rad).
            shifts_deg: by motor, how far it stands from where it did at the same command (N; deg).
        """
        by = self.angles(shifts_deg)
        alone = {}
        for index, joint in enumerate(self.joints):
            own = np.zeros_like(by)
            own[index] = by[index]
            alone[joint] = Cost.of(self.moved_m(angles, own))
        return alone, Cost.of(self.moved_m(angles, by))


def require_single(names: Sequence[str]) -> None:
    """Raise InputError if a motor turns two joints, or a joint is turned by two motors."""
    twice = next((name for name in names if names.count(name) > 1), None)
    if twice is not None:
        hint = "Where two are exchanged give --joint for both of them."
        raise InputError(f"found {twice} twice, by --joint and by its own name, expected it once.", hint=hint)


def wiring_of(texts: Sequence[str]) -> dict[str, Follows]:
    """``MOTOR=JOINT`` or ``MOTOR=-JOINT`` each.

    Raises:
        InputError: one is neither, or a motor or joint comes twice.
    """
    wiring: dict[str, Follows] = {}
    for text in texts:
        motor, equals, joint = text.partition("=")
        name = joint.removeprefix("-")
        if not (motor and equals and name):
            hint = "Write MOTOR=JOINT, or MOTOR=-JOINT where the joint turns the other way."
            raise InputError(f"found --joint {text!r}, expected MOTOR=JOINT.", hint=hint)
        if motor in wiring or name in {follows.joint for follows in wiring.values()}:
            raise InputError(f"found {motor} or {name} twice among --joint.", hint="Give each motor its own joint.")
        wiring[motor] = Follows(name, -1 if joint.startswith("-") else 1)
    return wiring


_DEG = np.pi / 180


@dataclass(frozen=True)
class RestRecord:
    """A rest: its episode, its middle frame, the motors' mean angles (deg) and the sides they came from (-1, 0, 1)."""

    episode: int
    frame: int
    degrees: Array
    approach: Array

    @property
    def name(self) -> str:
        return f"e{self.episode:06d}_f{self.frame:06d}"


def records_of(
    recording: Recording,
    units: Units,
    file: MotorFile | None,
    angles: Literal["state", "action"],
    window_s: float,
    spread_deg: float,
) -> list[RestRecord]:
    """All rests of all episodes, in order.

    Raises:
        DataError: the data set is damaged, or no rest is in it.
        InputError: percent without a calibration file, or no length of time.
    """
    if not (window_s > 0 and spread_deg > 0):
        raise InputError("found a window or spread of zero or less.", hint="Give --window-s and --spread-deg above 0.")
    if units == "percent" and file is None:
        raise InputError("found numbers in percent, expected degrees.", hint="Give --calibration FILE as well.")
    factors = np.array([unit_of(name, units, file)[0] for name in recording.motors])
    still = StillSettings.si(window=window_s, spread=spread_deg * _DEG)
    records = []
    lowest, highest = np.full(len(factors), np.inf), np.full(len(factors), -np.inf)
    for frames in _episodes(recording):
        require_percent(frames, recording, units)
        lowest = np.minimum(lowest, frames.vectors[STATE].min(axis=0))
        highest = np.maximum(highest, frames.vectors[STATE].max(axis=0))
        shown = frames.vectors[STATE if angles == "state" else ACTION] * factors
        moved = np.column_stack([sides(column)[0] for column in (frames.vectors[ACTION] * factors).T])
        turning = [i for i, name in enumerate(recording.motors) if not is_gripper(name)]
        for rest in rests(shown.T[turning] * _DEG, [], frames.time, still):
            part, middle = slice(rest.start, rest.stop), (rest.start + rest.stop) // 2
            records.append(
                RestRecord(
                    int(frames.episode[0]), int(frames.frame[middle]), shown[part].mean(axis=0), moved[rest.stop - 1]
                )
            )
    require_degrees(recording, units, lowest, highest)
    if not records:
        text = f"found no {window_s:g} s in which no motor moved by more than {spread_deg:g} deg."
        raise DataError(text, where=Location(str(recording.folder)), hint="Give another --window-s or --spread-deg.")
    return records


def write_records(
    out: Path, motors: Sequence[str], records: Sequence[RestRecord], wiring: Mapping[str, Follows], has_images: bool
) -> None:
    """Write a CSV: pose_id, angles and approaches of every joint but the gripper's, and the image's name.

    Raises:
        InputError: the wiring names no motor of these, or a joint twice.
    """
    unknown = [name for name in wiring if name not in motors]
    if unknown:
        hint = f"Its motors are {', '.join(motors)}: --joint MOTOR=JOINT."
        raise InputError(f"found no motor {unknown[0]!r} in the data set.", hint=hint)
    require_single([wiring.get(name, Follows(name)).joint for name in motors])
    turned = [(i, wiring.get(name, Follows(name))) for i, name in enumerate(motors) if not is_gripper(name)]
    columns = [name for _, follows in turned for name in (f"{follows.joint}_deg", f"approach_{follows.joint}")]
    rows: list[list[object]] = [["pose_id", *columns, *(["image"] if has_images else [])]]
    for record in records:
        row: list[object] = [record.name]
        for i, follows in turned:
            row += [float(follows.sense * record.degrees[i]), int(follows.sense * record.approach[i])]
        rows.append([*row, f"{record.name}.png"] if has_images else row)
    write_over({out: csv_text(rows, ".4f").encode()})


def write_images(recording: Recording, camera: str, records: Sequence[RestRecord], folder: Path) -> None:
    """Write a camera's image of each rest as PNG.

    Raises:
        DataError: a video is missing, or ends before a rest.
        PluginError: OpenCV is not installed.
    """
    cv2 = library("cv2", "reading videos")
    by_video: dict[Path, list[tuple[int, RestRecord]]] = {}
    for record in records:
        path, first = recording.video(camera, record.episode)
        by_video.setdefault(path, []).append((first + record.frame, record))
    folder.mkdir(parents=True, exist_ok=True)
    for path, places in by_video.items():
        capture, at = cv2.VideoCapture(str(path)), 0
        try:
            for place, record in sorted(places, key=lambda pair: pair[0]):
                while at < place and capture.grab():
                    at += 1
                there, image = capture.read()
                if not there:
                    text = f"it ends or is damaged before frame {place}, expected an image there."
                    raise DataError(text, where=Location(str(path)), hint="Take the video again, whole.")
                at += 1
                write_over({folder / f"{record.name}.png": cv2.imencode(".png", image)[1].tobytes()})
        finally:
            capture.release()


def _episodes(recording: Recording) -> Iterator[Frames]:
    """The frames of one episode after another; only one is held at a time."""
    held: list[Frames] = []
    for frames in recording.read((ACTION, STATE)):
        edges = np.flatnonzero(np.diff(frames.episode)) + 1
        for start, end in zip([0, *edges], [*edges, len(frames)], strict=True):
            part = frames.chosen(slice(start, end))
            if held and held[0].episode[0] != part.episode[0]:
                yield _joined(held)
                held = []
            held.append(part)
    if held:
        yield _joined(held)


def _joined(parts: Sequence[Frames]) -> Frames:
    episode, frame, time = (np.concatenate([getattr(p, name) for p in parts]) for name in ("episode", "frame", "time"))
    vectors = {name: np.concatenate([p.vectors[name] for p in parts]) for name in parts[0].vectors}
    return Frames(parts[0].file, episode, frame, time, vectors)
