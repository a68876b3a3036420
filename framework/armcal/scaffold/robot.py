"""A robot as drawings give it: joints, masses, rows of a DH table or a URDF, with errors that name the cell."""

import csv
import difflib
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from types import MappingProxyType
from typing import Any, Literal, NoReturn

from pydantic import ValidationError

from armcal.arm.assembly import PLACEMENT, MassiveModel
from armcal.arm.model import Joint
from armcal.base.units import display_unit, from_unit, split_suffix
from armcal.calibration.convert import nominal_values
from armcal.calibration.rigid_chain import numeric_chain
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.io.cells import CellFault, read_cell
from armcal.io.plain_files import input_bytes, refuse, text_of
from armcal.measure.column_match import header_of, match_columns, renamed, spellings
from armcal.measure.reader import ENVIRONMENT, RequestedChannel
from armcal.plugins import PluginRegistry
from armcal.scaffold.plugin_files import check_length

Convention = Literal["standard", "craig"]
Range = tuple[float, float]
Unit = Literal["mm", "deg"]

FEWEST_JOINTS, MOST_JOINTS = 2, 20
ASSUMED_TURN: Range = (-math.radians(120), math.radians(120))
ASSUMED_TRAVEL: Range = (0.0, 0.2)
"""Limits (rad, m) of joints of which none are stated."""
MOST = MappingProxyType({"angle": 4 * math.pi, "length": 100.0, "mass": 1e5})
"""Sizes (rad, m, kg) beyond which a number is in another unit than it says."""
WIDTHS: Mapping[Unit, float] = MappingProxyType({"mm": 10.0, "deg": 2.0})
_PARALLEL = 0.02


@dataclass(frozen=True)
class RobotJoint:
    """A joint: its name, whether it turns or slides, its limits (rad or m), and whether these were only assumed."""

    name: str
    turns: bool
    limits: Range
    assumed: bool = False


@dataclass(frozen=True)
class Mass:
    """A link's mass (kg) and the centre of it (m) in the frame that its row leads to."""

    mass: float
    com: tuple[float, float, float] = (0.0, 0.0, 0.0)


@dataclass(frozen=True)
class Row:
    """A Denavit-Hartenberg row: angles in rad, lengths in m, and the joint that it belongs to."""

    joint: RobotJoint
    alpha: float
    a: float
    theta: float
    d: float
    mass: Mass | None = None
    tilts: bool = False
    """Whether this row's axis and the neighbour that ``alpha`` leads to are parallel: ``ry`` then tilts them."""


@dataclass(frozen=True)
class Robot:
    """What the files of a new robot are made from: rows of a convention, or a URDF.

    Attributes:
        name: of the robot.
        joints: those that are commanded, from the base to the tip.
        has_masses: whether gravity loads it, as far as is known.
        preferred: globs of parameters to keep free where the data lets one choose, the first matter most.
        priors: globs of parameters that have one, each with the unit of its width.
        widths: how far such parameters may be off the drawing (standard deviation), by unit.
        convention: of the rows.
        rows: empty for a URDF.
        urdf: the file's content.
        urdf_file: its name.
        tip: the link that is the tool.
        up: which way is up in the tracker's base frame (unit vector); None if not stated.
        target: where the tracker's target sits in the tool's frame (m), roughly; None if not stated.
    """

    name: str
    joints: tuple[RobotJoint, ...]
    has_masses: bool
    preferred: tuple[tuple[str, ...], ...]
    priors: Mapping[str, Unit] = field(default_factory=dict)
    widths: Mapping[Unit, float] = field(default_factory=lambda: WIDTHS)
    convention: Convention = "standard"
    rows: tuple[Row, ...] = ()
    urdf: bytes = b""
    urdf_file: str = ""
    tip: str = ""
    up: tuple[float, float, float] | None = None
    target: tuple[float, float, float] | None = None


def with_tilts(convention: Convention, rows: tuple[Row, ...]) -> tuple[Row, ...]:
    """The rows, those between parallel axes marked: there rows alone cannot express every small tilt. [Hayati1983]

    ``alpha`` lies between a joint and the next one, in Craig's convention between it and the one before.
    """

    def is_parallel(index: int) -> bool:
        other = index + (1 if convention == "standard" else -1)
        both = 0 <= other < len(rows) and rows[index].joint.turns and rows[other].joint.turns
        return both and abs(math.sin(rows[index].alpha)) < _PARALLEL

    return tuple(replace(row, tilts=is_parallel(index)) for index, row in enumerate(rows))


def robot_of_rows(name: str, convention: Convention, rows: tuple[Row, ...]) -> Robot:
    """A robot of Denavit-Hartenberg rows.

    Where its base stands and where the target sits are known least, so these are preferred to the rows beside them.
    """
    rows = with_tilts(convention, rows)
    of_rows = (("arm.mdh.theta*",), ("arm.mdh.a[0-9]*", "arm.mdh.d[0-9]*"), ("arm.mdh.alpha*", "arm.mdh.*_ry"))
    priors: dict[str, Unit] = {
        "arm.mdh.theta*": "deg",
        "arm.mdh.alpha*": "deg",
        "arm.mdh.after*_ry": "deg",
        "arm.mdh.before*_ry": "deg",
        "arm.mdh.a[0-9]*": "mm",
        "arm.mdh.d[0-9]*": "mm",
    }
    return Robot(
        name=name,
        joints=tuple(row.joint for row in rows),
        has_masses=any(row.mass for row in rows),
        preferred=(("arm.mdh.base_*",), ("tracker.target_*",), *of_rows, ("arm.spring.*",)),
        priors=priors,
        convention=convention,
        rows=rows,
    )


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_TAKEN = frozenset({"x", "y", "z", "id", "pose_id", *(name for name, _ in ENVIRONMENT)})


def robot_name(text: str) -> str:
    """The name of a new robot: of its folder and its experiments."""
    check_length(text, text)
    if not _NAME.fullmatch(text):
        raise InputError(
            f"found the name {text!r}, expected letters, digits, - and _.", hint="Begin with a letter, as in arm5."
        )
    return text


def check_joint_names(names: Sequence[str], places: Sequence[Location]) -> None:
    """Refuse names that stand twice, or that a table has other columns for; ``places`` say where each stands."""
    for index, (name, where) in enumerate(zip(names, places, strict=True)):
        if not _NAME.fullmatch(name):
            fault = "expected letters, digits, - and _, the first a letter"
        elif name in _TAKEN or name.startswith(("approach", "noise")):
            fault = "which tables of poses have for something else"
        elif split_suffix(name):
            fault = "which ends like a unit"
        elif name in names[:index]:
            fault = "a second time"
        else:
            continue
        raise DataError(f"found the joint name {name[:60]!r}, {fault}.", where=where, hint="Rename the joint.")


MAX_BYTES = 1 << 20
_NUMBERS = {"alpha": "angle", "a": "length", "theta": "angle", "d": "length"}
_OPTIONAL = {"mass": "mass", "com_x": "length", "com_y": "length", "com_z": "length"}
_LIMITS = {f"{which} {dimension}": dimension for dimension in ("angle", "length") for which in ("lower", "upper")}
_COLUMNS = {
    name: RequestedChannel(name, (name.partition(" ")[0],), dimension, required=name in _NUMBERS)
    for name, dimension in (_NUMBERS | _OPTIONAL | _LIMITS).items()
}
_TEXTS = {"name": "name", "joint": "name", "type": "type", "kind": "type"}
_KINDS = {"": True, "revolute": True, "prismatic": False}
_SHOWN = "alpha_deg,a_mm,theta_deg,d_mm"
_AS_TEXT = "Save the table as CSV text in UTF-8."


@dataclass(frozen=True)
class _Line:
    """One row of the file: its cells by what they say, its line, and the columns' names and units there."""

    source: str
    line: int
    cells: dict[str, str]
    columns: dict[str, tuple[str, str]]

    def refuse(self, name: str, message: str, hint: str) -> NoReturn:
        refuse(self.source, message, hint, self.line, self.columns[name][0])

    def number(self, name: str) -> float | None:
        """A number in SI; None for an empty cell or no such column."""
        text = self.cells.get(name, "")
        if not text:
            return None
        cell, unit = read_cell(text), self.columns[name][1]
        if isinstance(cell, CellFault):
            self.refuse(name, cell.text, "Correct it.")
        if not math.isfinite(cell):
            self.refuse(name, f"found {text!r}, expected a number.", "Correct it.")
        value, dimension = from_unit(cell, unit), _COLUMNS[name].dimension
        if abs(value) > MOST[dimension]:
            self.refuse(name, f"found {text} {unit}, expected an arm's {dimension}.", "Check the column's unit.")
        return value

    def required(self, name: str) -> float:
        number = self.number(name)
        if number is None:
            self.refuse(name, "found nothing, expected a number.", "Write 0 for none.")
        return number


def read_rows(path: Path) -> tuple[Row, ...]:
    """The rows of a table."""
    lines = _lines(path, text_of(input_bytes(path, MAX_BYTES, "a CSV file, a table of joints"), path, _AS_TEXT))
    rows = tuple(_row(line, number) for number, line in enumerate(lines, start=1))
    if not FEWEST_JOINTS <= len(rows) <= MOST_JOINTS:
        raise DataError(
            f"found {len(rows)} {'joint' if len(rows) == 1 else 'joints'}, expected {FEWEST_JOINTS} to {MOST_JOINTS}.",
            where=Location(str(path), line=lines[-1].line if lines else None),
            hint="Give one line a joint, from the base to the tip.",
        )
    check_joint_names([row.joint.name for row in rows], [Location(str(path), line=line.line) for line in lines])
    return rows


def _lines(path: Path, text: str) -> list[_Line]:
    reader = csv.reader(text.splitlines(keepends=True), strict=True)
    lines: list[_Line] = []
    columns: dict[str, tuple[int, str, str]] = {}
    width = 0
    try:
        for cells in reader:
            line = reader.line_num
            if not any(cell.strip() for cell in cells):
                continue
            if not columns:
                columns, width = _header(path, line, cells), len(cells)
                continue
            if len(cells) != width:
                hint = "Leave a cell empty if its value is not known, and write decimal points (12.5), no commas."
                refuse(path, f"found {len(cells)} cells, expected {width} as in the header.", hint, line)
            shown = {name: cells[place].strip() for name, (place, _, _) in columns.items()}
            lines.append(_Line(str(path), line, shown, {name: (own, unit) for name, (_, own, unit) in columns.items()}))
    except csv.Error as fault:
        refuse(path, f"found a line that is not CSV ({fault}).", "Close every quote.", max(1, reader.line_num))
    if not columns:
        refuse(path, "it is empty.", f"Begin with the header {_SHOWN}.")
    return lines


def _header(path: Path, line: int, cells: list[str]) -> dict[str, tuple[int, str, str]]:
    """The columns by what they say: place, name and unit, which is empty of texts."""
    header = header_of(cells, str(path), line, f"Begin with a header such as {_SHOWN}.")
    names = [column.name for column in header.columns]
    other = next((character for character in ";\t|" if len(names) == 1 and character in names[0]), None)
    if other:
        header.refuse(f"found {other!r} between the columns, expected ','.", "Write commas.")
    matched = match_columns(renamed(header, {}), tuple(_COLUMNS.values())).channels
    columns = {name: (own.index, own.name, unit) for name, (own, unit) in matched.items()}
    taken = {index for index, _, _ in columns.values()}
    for column in header.columns:
        if column.name in _TEXTS:
            columns[_TEXTS[column.name]] = (column.index, column.name, "")
        elif column.index not in taken:
            choices = [*_TEXTS, *(f"{w.columns[0]}_{display_unit(w.dimension).name}" for w in _COLUMNS.values())]
            near = difflib.get_close_matches(column.name, choices, n=1)
            hint = f"Did you mean {near[0]}?" if near else header.layout_hint
            text = f"found the column {column.name[:60]!r}, expected some of {', '.join(choices)}."
            header.refuse(text, hint, column.name[:60])
    return columns


def _row(line: _Line, number: int) -> Row:
    kind, name = line.cells.get("type", "").lower(), line.cells.get("name", "")
    if kind not in _KINDS:
        line.refuse("type", f"found {kind!r}, expected revolute or prismatic.", "Leave it empty for revolute.")
    turns = _KINDS[kind]
    name = f"q{name or number}" if not name or name.isdecimal() else name
    limits = _limits(line, turns)
    joint = RobotJoint(name, turns, limits or (ASSUMED_TURN if turns else ASSUMED_TRAVEL), limits is None)
    alpha, a, theta, d = (line.required(own) for own in _NUMBERS)
    mass, *com = (line.number(own) or 0.0 for own in _OPTIONAL)
    if mass < 0:
        line.refuse("mass", "found a mass below zero.", "Leave it empty where it is not known.")
    return Row(joint, alpha, a, theta, d, (Mass(mass, (com[0], com[1], com[2])) if mass else None))


def _limits(line: _Line, turns: bool) -> Range | None:
    own, moves = ("angle", "turns") if turns else ("length", "slides")
    low, high = (line.number(f"{which} {own}") for which in ("lower", "upper"))
    if low is None and high is None:
        wrong = next((name for name, dimension in _LIMITS.items() if dimension != own and line.cells.get(name)), None)
        if wrong:
            names = " or ".join(spellings(_COLUMNS[f"lower {own}"]))
            text = f"found a limit of {_LIMITS[wrong]}, and the joint {moves}."
            line.refuse(wrong, text, f"Write them under {names}, or leave them empty.")
        return None
    if low is None or high is None or not low < high:
        first = next(name for name, dimension in _LIMITS.items() if dimension == own and name in line.cells)
        line.refuse(first, "found no lower limit below an upper one.", "Give both, or leave both empty.")
    return low, high


_MOST_TRAVEL_RAD = 3.2
"""A turning joint need not be measured over more than one turn."""


def robot_of_urdf(name: str, path: Path, tip: str | None, registry: PluginRegistry) -> Robot:
    """A robot from a URDF; ``tip`` names its last link where the file leaves a choice."""
    where = Location(str(path))
    model = urdf_model(path, tip, registry)
    chain = numeric_chain(model, nominal_values(model))
    joints = tuple(_joint(joint, where) for joint in chain.joints if joint.mimic is None)
    if not FEWEST_JOINTS <= len(joints) <= MOST_JOINTS:
        raise DataError(
            f"found {len(joints)} moving joints between root and tip, expected {FEWEST_JOINTS} to {MOST_JOINTS}.",
            where=where,
            hint="Name the link at the arm's end: --tip LINK.",
        )
    check_joint_names([joint.name for joint in joints], [where] * len(joints))
    priors: dict[str, Unit] = {}  # how far joints may be off the URDF; where the arm stands before the tracker has none
    for moved in chain.joints:  # a joint that follows another too
        priors[f"arm.urdf.{moved.name}_[xyz]"] = "mm"
        priors[f"arm.urdf.{moved.name}_[rpy][oia]*"] = "deg"
    moving = tuple(f"arm.urdf.{moved.name}_*" for moved in chain.joints)
    # Without a placement of its own the tracker's frame would end up in the first joint, and with it in every export.
    placed = ((f"arm.{PLACEMENT}_*",), ("tracker.target_*",))
    return Robot(
        name=name,
        joints=joints,
        has_masses=isinstance(model, MassiveModel) and bool(model.masses()),
        preferred=(*placed, moving, ("arm.urdf.*",), ("arm.spring.*",)),
        priors=priors,
        urdf=path.read_bytes(),
        urdf_file=f"{name}.urdf",
        tip=model.settings.tip,
    )


def urdf_model(path: Path, tip: str | None, registry: PluginRegistry) -> Any:
    """The arm model of a URDF; ``tip`` names its last link where the file leaves a choice."""
    made = registry.find("model", "urdf").load()
    try:
        return made(made.Settings.model_validate({"path": str(path), **({"tip": tip} if tip else {})}))
    except ValidationError as fault:
        text = "; ".join(str(error["msg"]).removeprefix("Value error, ") for error in fault.errors(include_url=False))
        hint = "Correct the URDF, or choose --tip LINK."
        raise ConfigError(f"{text}.", where=Location(str(path)), hint=hint) from fault


def _joint(joint: Joint, where: Location) -> RobotJoint:
    turns = joint.is_revolute
    if joint.limits is None:
        return RobotJoint(joint.name, turns, ASSUMED_TURN if turns else ASSUMED_TRAVEL, assumed=True)
    low, high = joint.limits
    if not low < high:
        text = f"joint {joint.name!r} has the limits {low:g} and {high:g}, and cannot move."
        raise DataError(text, where=where, hint="Correct them, or make it a fixed joint.")
    if turns and not joint.endless:
        low, high = max(low, -_MOST_TRAVEL_RAD), min(high, _MOST_TRAVEL_RAD)
    return RobotJoint(joint.name, turns, (low, high))
