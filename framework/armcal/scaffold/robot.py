"""A new robot as drawings give it (rows of a DH table, or a URDF), with errors that name the cell; and its files: its
arm, what to calibrate, a plan, a simulated truth and records of it, and a trial."""

import difflib
import fnmatch
import json
import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from pydantic import ValidationError
from scipy.spatial.transform import Rotation

from armcal.arm.assembly import PLACEMENT, MassiveModel
from armcal.arm.model import Joint
from armcal.arm.statics import plausible_compliance
from armcal.base import domains
from armcal.base.config_text import ConfigText
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.units import display_unit, shown_unit, split_suffix, to_unit
from armcal.calibration.convert import nominal_values
from armcal.calibration.rigid_chain import numeric_chain
from armcal.errors import ConfigError, DataError, InputError, Location
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import MinimalSet, minimal_set
from armcal.estimate.simulation import measured_without_noise
from armcal.measure.checks import records_of
from armcal.measure.reader import ENVIRONMENT, ReadRequest, RequestedChannel
from armcal.measure.tables import spellings, write_csv
from armcal.plugins import PluginRegistry
from armcal.problem.variants import factor_at_zero
from armcal.report.numbers import plural
from armcal.report.page import page
from armcal.report.run_document import plugin_sections, run_document
from armcal.run import result as results
from armcal.run.experiment import Experiment
from armcal.run.pipeline import Stopwatch, assemble, calibrate
from armcal.run.result import RunResult
from armcal.scaffold.plugin_files import check_length, number, rendered, staged, write_texts

Convention = Literal["standard", "craig"]
Range = tuple[float, float]
Unit = Literal["mm", "deg"]
Steps = tuple[tuple[str, float], ...]  # in turn: along x, y, z (m), then about x, y, z (rad)

FEWEST_JOINTS, MOST_JOINTS = 2, 20
ASSUMED_TURN: Range = (-math.radians(120), math.radians(120))  # limits of joints of which none are stated
ASSUMED_TRAVEL: Range = (0.0, 0.2)
MOST = {"angle": 4 * math.pi, "length": 100.0, "mass": 1e5}  # beyond it (rad, m, kg) a number is in another unit
WIDTHS: Mapping[Unit, float] = {"mm": 10.0, "deg": 2.0}
_PARALLEL = 0.02
_NO_STEPS: Steps = tuple((name, 0.0) for name in ("x", "y", "z", "rx", "ry", "rz"))


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
    beta: float = 0.0  # about y, after the row [Hayati1983]
    tilts: bool = False  # whether its axis and the one that ``alpha`` leads to are parallel: ``ry`` then tilts them
    is_fixed: bool = False  # no joint turns or slides it: a step of the base or of the tool

    def steps(self, convention: Convention) -> Steps:
        about_x, along_x = Rotation.from_euler("x", self.alpha), np.array([self.a, 0.0, 0.0])
        about_z, along_z = Rotation.from_euler("z", self.theta), np.array([0.0, 0.0, self.d])
        if convention == "standard":
            turn, place = about_z * about_x * Rotation.from_euler("y", self.beta), about_z.apply(along_z + along_x)
        else:
            turn, place = about_x * about_z, along_x + about_x.apply(along_z)
        angles = turn.as_euler("XYZ")
        return tuple(zip(("x", "y", "z", "rx", "ry", "rz"), [*place.tolist(), *angles.tolist()], strict=True))


@dataclass(frozen=True)
class Robot:
    """What the files of a new robot are made from: rows of a convention, or a URDF."""

    name: str
    joints: tuple[RobotJoint, ...]  # those that are commanded, from the base to the tip
    has_masses: bool  # whether gravity loads it, as far as is known
    preferred: tuple[tuple[str, ...], ...]  # globs of parameters to keep free where there is a choice, the first first
    priors: Mapping[str, Unit] = field(default_factory=dict)  # globs of parameters that have one; units of the widths
    widths: Mapping[Unit, float] = field(default_factory=lambda: WIDTHS)  # how far these may be off (sd)
    convention: Convention = "standard"
    rows: tuple[Row, ...] = ()  # of joints; empty for a URDF
    base: Steps = _NO_STEPS  # of a table that begins with a fixed row
    tool: Steps = ()  # of one that ends with a fixed row
    urdf: bytes = b""
    urdf_file: str = ""
    tip: str = ""  # the link that is the tool
    notes: tuple[str, ...] = ()  # what is ignored in the URDF, and which joints have another name here
    up: tuple[float, float, float] | None = None  # in the tracker's base frame (unit vector); None if not stated
    target: tuple[float, float, float] | None = None  # the tracker's, in the tool's frame (m); None if not stated


def robot_of_rows(name: str, convention: Convention, rows: tuple[Row, ...]) -> Robot:
    """A robot of Denavit-Hartenberg rows.

    Where its base stands and where the target sits are known least, so these are preferred to the rows beside them.
    Rows between parallel axes are marked: there rows alone cannot express every small tilt. [Hayati1983] ``alpha`` lies
    between a joint and the next one, in Craig's convention between it and the one before.
    """

    def is_parallel(index: int) -> bool:
        other = index + (1 if convention == "standard" else -1)
        both = 0 <= other < len(rows) and rows[index].joint.turns and rows[other].joint.turns
        return both and abs(math.sin(rows[index].alpha)) < _PARALLEL

    if convention != "standard" and any(row.beta for row in rows):
        text = "found beta in a table of the modified convention, in which authors differ on its place."
        raise ConfigError(text, hint="Leave the column out, and write it as before: or after: of a row in arm.yaml.")
    base = rows[0].steps(convention) if rows[0].is_fixed else _NO_STEPS
    tool = rows[-1].steps(convention) if rows[-1].is_fixed else ()
    rows = tuple(row for row in rows if not row.is_fixed)
    rows = tuple(replace(row, tilts=bool(row.beta) or is_parallel(index)) for index, row in enumerate(rows))
    # Between axes that are parallel but for a maker's calibration, d would stand for the tilt, over many metres.
    of_rows = (("arm.mdh.theta*",), ("arm.mdh.*_ry",), ("arm.mdh.a[0-9]*", "arm.mdh.d[0-9]*"), ("arm.mdh.alpha*",))
    priors: dict[str, Unit] = dict.fromkeys(("arm.mdh.theta*", "arm.mdh.alpha*"), "deg")
    priors |= dict.fromkeys(("arm.mdh.after*_ry", "arm.mdh.before*_ry"), "deg")
    priors |= dict.fromkeys(("arm.mdh.a[0-9]*", "arm.mdh.d[0-9]*"), "mm")
    return Robot(
        name=name,
        joints=tuple(row.joint for row in rows),
        has_masses=any(row.mass for row in rows),
        preferred=(("arm.mdh.base_*",), ("tracker.target_*",), *of_rows, ("arm.spring.*",)),
        priors=priors,
        convention=convention,
        rows=rows,
        base=base,
        tool=tool,
    )


_NAME = re.compile(r"[A-Za-z][A-Za-z0-9_-]*")
_TAKEN = frozenset({"x", "y", "z", "id", "pose_id", *(name for name, _ in ENVIRONMENT)})


def robot_name(text: str) -> str:
    check_length(text, text)
    if not _NAME.fullmatch(text):
        fault = f"found the name {text!r}, expected letters, digits, - and _."
        raise InputError(fault, hint="Begin with a letter, as in arm5.")
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


_NUMBERS = {"alpha": "angle", "a": "length", "theta": "angle", "d": "length"}
_OPTIONAL = {"beta": "angle", "mass": "mass", "com_x": "length", "com_y": "length", "com_z": "length"}
_LIMITS = {f"{which} {dimension}": dimension for dimension in ("angle", "length") for which in ("lower", "upper")}
_CHANNELS = {
    name: RequestedChannel(name, (name.partition(" ")[0],), kind, name in _NUMBERS, is_evidence=name not in _NUMBERS)
    for name, kind in (_NUMBERS | _OPTIONAL | _LIMITS).items()
}
_TEXTS = ("name", "joint", "type")
_KINDS = {"": True, "revolute": True, "prismatic": False, "fixed": True}


def read_rows(path: Path, registry: PluginRegistry) -> tuple[Row, ...]:
    made = registry.find("reader", "csv").load()
    layout = "Begin with a header such as alpha_deg,a_mm,theta_deg,d_mm."
    reader = made(made.Settings(path=ConfigText(str(path))))
    table = records_of(reader, ReadRequest({}, {}, tuple(_CHANNELS.values()), layout_hint=layout))
    for row in table.set_aside:
        raise DataError(f"{row.reason}.", where=Location(str(path), line=row.row), hint="Write a number, 0 for none.")
    for column in table.extra:
        if column not in _TEXTS:
            choices = [*_TEXTS, *(f"{c.columns[0]}_{display_unit(c.dimension).name}" for c in _CHANNELS.values())]
            near = difflib.get_close_matches(column, choices, n=1)
            text = f"found the column {column[:60]!r}, expected some of {', '.join(choices)}."
            hint = f"Did you mean {near[0]}?" if near else layout
            raise DataError(text, where=Location(str(path), field=column[:60]), hint=hint)
    rows = tuple(_row(table, index) for index in range(len(table)))
    places = [Location(str(path), line=line) for line in table.rows]
    moving = [(row.joint.name, place) for row, place in zip(rows, places, strict=True) if not row.is_fixed]
    for between, place in zip(rows[1:-1], places[1:-1], strict=True):
        if between.is_fixed:
            text = f"{between.joint.name} is fixed and stands between joints."
            hint = "Only the first and the last row may be fixed: give a URDF, or rows whose frames stand at joints."
            raise DataError(text, where=place, hint=hint)
    if not FEWEST_JOINTS <= len(moving) <= MOST_JOINTS:
        text = f"found {plural(len(moving), 'joint')}, expected {FEWEST_JOINTS} to {MOST_JOINTS}."
        hint = "Give one line a joint, from the base to the tip."
        raise DataError(text, where=Location(str(path), line=table.rows[-1]), hint=hint)
    check_joint_names(*zip(*moving, strict=True))
    return rows


def _row(table: Dataset, index: int) -> Row:
    def refused(column: str, text: str, hint: str) -> DataError:
        return DataError(text, where=Location(table.source, line=table.rows[index], field=column), hint=hint)

    numbers: dict[str, float] = {}  # of cells that are not empty; SI
    for name, values in table.channels.items():
        value, dimension = float(values[index]), _CHANNELS[name].dimension
        if abs(value) > MOST[dimension]:
            unit = display_unit(dimension).name
            text = f"found {to_unit(value, unit):g} {unit}, expected an arm's {dimension}."
            hint = "Check the column's unit."
            alphas = table.channels["alpha"][max(index - 1, 0) : index + 1]
            parallel = [f"{math.degrees(alpha):.3g}" for alpha in alphas if abs(math.sin(alpha)) < _PARALLEL]
            if name == "d" and parallel:
                hint = f"Nearly parallel axes (alpha {', '.join(parallel)} deg) make d so long. Write the rows in an "
                hint += "arm.yaml, and shorten them: armcal convert arm.yaml --to mdh."
            raise refused(name, text, hint)
        if not math.isnan(value):
            numbers[name] = value
    kind, given = (table.extra[name][index].strip() if name in table.extra else "" for name in ("type", "name"))
    given = given or (table.extra["joint"][index].strip() if "joint" in table.extra else "")
    if kind.lower() not in _KINDS:
        raise refused("type", f"found {kind!r}, expected revolute, prismatic or fixed.", "Leave it empty for revolute.")
    turns = _KINDS[kind.lower()]
    own, moves = ("angle", "turns") if turns else ("length", "slides")
    low, high = (numbers.get(f"{which} {own}") for which in ("lower", "upper"))
    limits = ASSUMED_TURN if turns else ASSUMED_TRAVEL
    if low is None and high is None:
        if wrong := next((name for name in _LIMITS if name in numbers), None):
            hint = f"Write them under {' or '.join(spellings(_CHANNELS[f'lower {own}']))}, or leave them empty."
            raise refused(wrong, f"found a limit of {_LIMITS[wrong]}, and the joint {moves}.", hint)
    elif low is not None and high is not None and low < high:
        limits = low, high
    else:
        text = "found no lower limit below an upper one."
        raise refused(f"lower {own}", text, "Give both, or leave both empty.")
    if numbers.get("mass", 0.0) < 0:
        raise refused("mass", "found a mass below zero.", "Leave it empty where it is not known.")
    mass = None
    if numbers.get("mass"):
        mass = Mass(numbers["mass"], (numbers.get("com_x", 0.0), numbers.get("com_y", 0.0), numbers.get("com_z", 0.0)))
    fixed = kind.lower() == "fixed"
    if fixed and mass:
        raise refused("mass", "found a mass in a fixed row.", "Write it in links: of arm.yaml, with its frame.")
    before = sum(text.strip().lower() == "fixed" for text in table.extra.get("type", ())[:index])
    name = f"q{given or index - before + 1}" if not given or given.isdecimal() else given
    joint = RobotJoint(name, turns, limits, assumed=low is None)
    alpha, a, theta, d = (numbers[channel] for channel in _NUMBERS)
    return Row(joint, alpha, a, theta, d, mass, numbers.get("beta", 0.0), is_fixed=fixed)


_MOST_TRAVEL_RAD = 3.2  # a turning joint need not be measured over more than one turn


def robot_of_urdf(name: str, path: Path, tip: str | None, registry: PluginRegistry) -> Robot:
    """A robot from a URDF; ``tip`` names its last link where the file leaves a choice."""
    where = Location(str(path))
    made = registry.find("model", "urdf").load()
    try:
        model = made(made.Settings.model_validate({"path": str(path), **({"tip": tip} if tip else {})}))
    except ValidationError as fault:
        text = "; ".join(str(error["msg"]).removeprefix("Value error, ") for error in fault.errors(include_url=False))
        raise ConfigError(f"{text}.", where=where, hint="Correct the URDF, or choose --tip LINK.") from fault
    chain = numeric_chain(model, nominal_values(model))
    joints = tuple(_joint(joint, where) for joint in chain.joints if joint.mimic is None)
    if not FEWEST_JOINTS <= len(joints) <= MOST_JOINTS:
        text = f"found {len(joints)} moving joints between root and tip, expected {FEWEST_JOINTS} to {MOST_JOINTS}."
        hint = "Name the link at the arm's end: --tip LINK."
        raise DataError(text, where=where, hint=hint)
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
        notes=model.settings.notes,
    )


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


# --- its files ---

MOST_UNCERTAIN = 0.5  # in typical scales: what the declared noise leaves less certain is fixed
SIMULATED, RECORDS = "simulated.yaml", "simulated.csv"
NOISE_MM, NOISE_SEED = 0.1, 4
GRAVITY_M_S2 = 9.81
_SMALLEST_REACH_M = 0.01
_TRIED_POSES = 60
_NEARLY_HALF_A_TURN = 3.0
# Of so many, chance makes one verdict in twenty warn; of 100 to 200 one in five: each finding has a level of its own.
RECORDS_MADE = 600
RESULTS = "runs/simulated"
MOST_ERROR = 1.5  # times what the noise alone makes: what misses held-out tips by more has not found the arm
NOISE_ALONE_MM = NOISE_MM * math.sqrt(8 / math.pi)  # mean length of three independent normal numbers
SEED = 1
LENGTH_SD_M, ANGLE_SD_RAD = 0.001, 0.003
# Of the reach: where a target sits whose place was not stated. Most sit beside the last axis, and show more there.
UNSTATED_TARGET = {"tracker.target_x": 0.06, "tracker.target_y": -0.04, "tracker.target_z": 0.03}
_MOST_SD = 2.0
_SPRING = (0.5, 1.5)
_UNITS = frozenset({"m", "rad", "rad_per_Nm"})


def write_robot(robot: Robot, folder: Path, registry: PluginRegistry) -> MinimalSet:
    """Write a new robot's folder, with simulated records of it; gives the parameters chosen."""
    with staged(folder) as place:
        try:
            return _fill(place, robot, registry)
        except InputError as fault:
            text = str(fault).replace(str(place.resolve()), str(folder)).replace(str(place), str(folder))
            reason = f"the files of {robot.name} would be refused: {text}"  # nobody sees them, as they are not kept
            raise InputError(reason, hint="Correct what they are made from.") from fault


def _fill(place: Path, robot: Robot, registry: PluginRegistry) -> MinimalSet:
    """First with nothing free, to see what there is; then with everything; then with what the records determine."""
    nothing = MinimalSet((), (), (), {})
    if robot.urdf:
        (place / robot.urdf_file).write_bytes(robot.urdf)
    _write(place, robot, nothing, {})
    experiment = Experiment.load(place / SIMULATED, registry=registry)
    parameters = experiment.parameters
    masses = [b for b in parameters.blocks if b.name.startswith("arm.links.") and b.name.endswith(".mass")]
    weight_N = GRAVITY_M_S2 * sum(block.nominal[0] for block in masses)
    random = np.random.default_rng(SEED)
    commands = {f"arm.{j.name}": random.uniform(*j.limits, _TRIED_POSES) for j in robot.joints}
    poses = Dataset(tuple(str(i) for i in range(_TRIED_POSES)), commands)
    exact = measured_without_noise(experiment.simulation_request, poses)
    tips = np.array([exact[f"tracker.{axis}"] for axis in "xyz"])
    reach = float(np.linalg.norm(tips - tips.mean(axis=1, keepdims=True), axis=0).max())  # from the middle of all
    if not reach > _SMALLEST_REACH_M:
        text = f"in all poses the tip stays within {1000 * reach:.3g} mm."
        hint = "Check the lengths a and d and their units."
        raise InputError(text, hint=hint)
    target = {} if robot.target else {name: share * reach for name, share in UNSTATED_TARGET.items()}
    true = _made_up(parameters, weight_N * reach, target, robot.widths)
    _write(place, robot, nothing, _as_text(parameters, true))
    experiment = Experiment.load(place / SIMULATED, registry=registry)
    dataset = experiment.simulator().simulate(experiment.simulation_request)
    write_csv(place / RECORDS, dataset, experiment.request(measured=True).channels)
    freed = f"parameters.free={json.dumps(_candidates(parameters))}"
    chosen = _choose_free(Experiment.load(place / SIMULATED, [freed], registry=registry), robot, target)
    _write(place, robot, chosen, _as_text(parameters, true))
    return chosen


def _choose_free(experiment: Experiment, robot: Robot, target: Mapping[str, float]) -> MinimalSet:
    """A minimal set of the experiment's free parameters, for its training records (see ``armcal identify``).

    A target whose place was not stated is taken to sit there (m): on the last axis it would not show all that it does.
    """
    ready = assemble(experiment, Stopwatch())
    parameters = ready.problem.parameters
    values = experiment.parameters.nominal()  # as drawn, not where the records place it: springs would seem loaded
    for name, place in target.items():
        values[parameters.entries_of(name)] = place
    triangle = factor_at_zero(ready.training, values)
    free = [block.name for block in parameters.free]
    preferred = [
        [name for name in free if any(fnmatch.fnmatchcase(name, glob) for glob in globs)] for globs in robot.preferred
    ]
    return minimal_set(triangle, parameters, preferred, most_uncertain=MOST_UNCERTAIN)


def _write(place: Path, robot: Robot, choice: MinimalSet, true: Mapping[str, str]) -> None:
    held = {glob: unit for glob, unit in robot.priors.items() if fnmatch.filter(choice.kept, glob)}
    priors = {glob: f"{number(robot.widths[unit])} {unit}" for glob, unit in held.items()}
    context: dict[str, Any] = {
        "robot": robot,
        "name": robot.name,
        "choice": choice,
        "priors": priors,
        "truth": true,
        "gravity": [number(-GRAVITY_M_S2 * along) for along in robot.up or ()],
        "noise_mm": number(NOISE_MM),
        "count": RECORDS_MADE,
        "truth_seed": SEED,
        "seed": NOISE_SEED,
        "shown": _shown,
        "levels": _levels,
        "steps": _steps,
        "turning": [joint for joint in robot.joints if joint.turns],
        "sliding": [joint for joint in robot.joints if not joint.turns],
        "assumed": [joint.name for joint in robot.joints if joint.assumed],
    }
    write_texts(place, rendered("robot", context))


def _shown(value: float, dimension: str) -> str:
    return number(to_unit(value, display_unit(dimension).name))


def _steps(steps: Steps) -> str:
    units = {name: ("angle", "deg") if len(name) == 2 else ("length", "mm") for name, _ in steps}
    return ", ".join(f"{{{name}_{units[name][1]}: {_shown(value, units[name][0])}}}" for name, value in steps)


def _levels(joint: RobotJoint) -> list[str]:
    """Low, middle and high, in deg or mm; a third of a turn apart where the ends would be one angle, or beyond it."""
    middle, half = 0.5 * sum(joint.limits), 0.5 * (joint.limits[1] - joint.limits[0])
    if joint.turns and half > _NEARLY_HALF_A_TURN:
        half = 2 * math.pi / 3
    return [_shown(value, "angle" if joint.turns else "length") for value in (middle - half, middle, middle + half)]


@dataclass(frozen=True)
class Trial:
    """How the calibration went, and tip errors on held-out records (mm)."""

    result: RunResult
    nominal_mm: float
    calibrated_mm: float

    @property
    def fault(self) -> str:
        """What is wrong; empty if the files work."""
        verdict = self.result.estimate.verdict
        bad = [finding.text for finding in self.result.verdict.findings if finding.grade == "bad"]
        if not verdict.converged:
            return f"{verdict.name} did not converge ({verdict.status})"
        if bad or self.calibrated_mm <= MOST_ERROR * NOISE_ALONE_MM:
            return bad[0] if bad else ""
        error = f"the error at held-out tips is {self.calibrated_mm:.3f} mm"
        return f"{error}, and the noise alone makes {NOISE_ALONE_MM:.3f} mm"


def try_out(folder: Path, registry: PluginRegistry, command: str = "", progress: Progress = no_progress) -> Trial:
    """Calibrate on the simulated records, as ``armcal run`` does."""
    watch, experiment = Stopwatch(), Experiment.load(folder / SIMULATED, registry=registry)
    result = calibrate(experiment, command, progress, watch)
    result.seconds["total"] = watch.total()
    document = run_document(result, plugin_sections(result, registry)[0])
    with results.reserved(folder / RESULTS) as held:
        results.write(held, result, experiment, page(document))
    held_out = (of["holdout"].mean for of in (result.table.nominal, result.table.calibrated))
    return Trial(result, *(math.nan if error is None else error for error in held_out))


def _candidates(parameters: Parameters) -> tuple[str, ...]:
    """What a first calibration may look for: placement, geometry, springs, the target; no masses, no gravity."""
    return tuple(
        block.name
        for block in parameters.blocks
        if block.unit in _UNITS
        and (block.size == 1 or isinstance(block.domain, domains.Rotation))
        and not fnmatch.fnmatch(block.name, "arm.links.*")
        and not block.name.startswith("statics.")
    )


def _made_up(
    parameters: Parameters, load_Nm: float, target: Mapping[str, float], widths: Mapping[Unit, float]
) -> dict[str, float]:
    """True values (SI) of every candidate that is one number; a rotation stays as it was stated.

    A joint bears ``load_Nm``, the moment of the arm's whole weight at its full reach; 0 if its masses are not known.
    Parameters of the target are off by ``target`` (m) beside that. Errors are no larger than the priors' ``widths``.
    """
    random = np.random.default_rng(SEED)
    deviations = {"m": min(LENGTH_SD_M, 1e-3 * widths["mm"]), "rad": min(ANGLE_SD_RAD, math.radians(widths["deg"]))}
    names = [name for name in _candidates(parameters) if parameters[name].size == 1]
    values = {}
    for name in names:
        block = parameters[name]
        if block.unit == "rad_per_Nm":
            drawn = float(random.uniform(*_SPRING))
            error = drawn * plausible_compliance(load_Nm) if load_Nm > 0 else 0.0
        else:
            error = deviations[block.unit] * float(np.clip(random.normal(), -_MOST_SD, _MOST_SD))
        values[name] = float(block.nominal[0]) + error + target.get(name, 0.0)
    return values


def _as_text(parameters: Parameters, values: Mapping[str, float]) -> dict[str, str]:
    lines = {}
    for name, value in values.items():
        factor, unit = shown_unit(parameters[name].unit)
        lines[name] = f"{number(float(f'{factor * value:.6g}'))} {unit}"
    return lines
