"""Records of visits to poses: by pose, cycle and direction, and beside what was commanded, in one frame."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NoReturn, Self, get_args

import numpy as np
from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.quaternions import nearest_turn
from armcal.base.units import DIMENSIONLESS
from armcal.calibration.calibration import Calibration
from armcal.calibration.intervals import PredictionRecord
from armcal.config.system import System, build_component
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.diagnose.readings import check_reach
from armcal.errors import ConfigError, DataError, Location, NotConvergedError
from armcal.estimate.start import BETTER, FAR, placings, pose_words
from armcal.measure.checks import records_of
from armcal.measure.environment import noticed
from armcal.measure.groups import pose_numbers
from armcal.measure.reader import CYCLE, Reader, ReadRequest, RequestedChannel, requested_channels
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import FEWEST as FEWEST_SEEN
from armcal.problem.rigid_alignment import Sighting, Tools, alignments, sighting_of, tools_of, undetermined
from armcal.report.numbers import plural
from armcal.run.experiment import Experiment, with_data
from scipy.spatial.transform import Rotation

from armcal_capability.designs import examined_arm

POSE, DIRECTION, FEWEST = "pose", "direction", 2
_FEWEST_WORDS = "Repeatability needs two visits, ISO 9283 asks for 30"
_REPEATS = "Records of one pose are held out together"
"""In what readers warn of: repeats, which are what is measured here."""
_FAR = 0.1
"""Of the typical distance of the positions that arms reach: no arm repeats as badly."""
_FACTORS = {1000.0: "m", 10.0: "cm", 25.4: "inches", 0.001: "thousandths of the column's unit"}
_NEAR, _MM = 0.02, 1000.0
FrameChoice = Literal["auto", "stated", "found"]
FRAMES = get_args(FrameChoice)
_COMPILED_FROM = 5000


@dataclass(frozen=True)
class ArmToJudge:
    """One arm as described, and as calibrated."""

    system: System  # with the arm, and the one measurement that is judged
    models: Mapping[str, Parameters]  # nominal and, from a calibration, calibrated; free are those without a prior
    source: ConfigSource  # with the section data, which says how records are read
    kept: PredictionRecord | None = None  # of a calibration, if the records are read as its data was
    trained_on: str = ""  # hash of the data that the calibration comes from

    @classmethod
    def load(
        cls,
        path: Path,
        settings: Path | None,
        overrides: Sequence[str],
        records: Path,
        registry: PluginRegistry,
        accept: bool = False,
    ) -> Self:
        """From a calibration or a configuration; ``settings`` is one whose section ``data`` is taken instead."""
        given = load_config(path)
        rules = None if settings is None else load_config(settings, overrides)
        kept, trained_on = None, ""
        if "armcal_calibration" in given.data:
            calibration = Calibration.load(path, registry, accept)
            source = with_data(rules or replace(given, data={**given.data, "data": {"type": "csv"}}), records)
            system, record = calibration.system, calibration.record
            free = {e.name.partition("[")[0] for e in record.parameters if e.free and not e.held_by_prior}
            models = {"nominal": calibration.nominal, "calibrated": calibration.parameters}
            kept, trained_on = None if rules else record.prediction, record.identity.get("data", "")
        else:
            experiment = Experiment.load(path, overrides if rules is None else (), records, registry)
            source = with_data(rules, records) if rules else experiment.source
            system, models = experiment.system, {"nominal": experiment.parameters}
            free = {b.name for b in experiment.parameters.free if b.prior_sd is None and not b.nuisance}
        examined_arm(system, path)
        reading = (n for n, m in system.measurements.items() if {c.name for c in m.channels()}.issuperset("xyz"))
        if (judged := next(reading, None)) is None:
            raise ConfigError(
                f"found {', '.join(system.measurements) or 'no measurement'}, expected one that reads positions.",
                where=Location(str(path)),
                hint="Add a measurement tip_position or tip_pose: accuracy is judged by measured poses.",
            )
        system = replace(system, measurements={judged: system.measurements[judged]})
        models = {name: parameters.with_free(free) for name, parameters in models.items()}
        return cls(system, models, source, kept, trained_on)


@dataclass(frozen=True)
class Group:
    """Visits to one pose from one direction: places of their records, in order of the cycles."""

    pose: str
    direction: str
    members: Indices


@dataclass(frozen=True)
class Visits:
    """Records of poses that were visited again and again."""

    dataset: Dataset
    cycles: Indices  # number of each record's cycle (N)
    groups: tuple[Group, ...]  # in the order in which they first appear
    warnings: tuple[str, ...]

    @property
    def poses(self) -> tuple[str, ...]:
        return tuple(dict.fromkeys(group.pose for group in self.groups))


def read_visits(subject: ArmToJudge, registry: PluginRegistry, path: Path) -> Visits:
    """The records of a table as visits; poses are named by a column, or found by their joint channels.

    Raises:
        DataError: the table is refused, a cycle is no whole number or occurs twice, or a pose has too few visits.
    """
    source, arms = subject.source, subject.system.arms
    cycle = RequestedChannel(CYCLE, (CYCLE,), DIMENSIONLESS, required=False)
    channels = (*requested_channels(arms, subject.system.measurements, measured=True), cycle)
    section = dict(source.data["data"])
    if subject.kept is not None:
        section["columns"] = subject.kept.columns_in(path, channels)
    reader: Reader
    reader, _ = build_component(replace(source, data={**source.data, "data": section}), registry, "reader", ("data",))
    dataset = noticed(records_of(reader, ReadRequest(arms, subject.system.measurements, channels)))
    labelled = POSE in dataset.extra
    poses = [f"pose {n + 1}" for n in pose_numbers(dataset, [*command_channels(arms)])]
    if labelled:
        poses = [text.strip() for text in dataset.extra[POSE]]
    directions = [text.strip() for text in dataset.extra.get(DIRECTION, ("",) * len(dataset))]
    if "" in poses:
        _refuse(dataset, poses.index(""), POSE, "no pose is named.", "Name the pose of every record, or of none.")
    members: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(zip(poses, directions, strict=True)):
        members.setdefault(key, []).append(i)
    cycles = _cycles(dataset, members)
    groups = [Group(*key, np.array(sorted(own, key=lambda i: cycles[i]))) for key, own in members.items()]
    kept = tuple(group for group in groups if len(group.members) >= FEWEST)
    warnings = [text for text in dataset.warnings if _REPEATS not in text]
    again = f"{_FEWEST_WORDS}: measure it again, or take its rows out."
    lost = [group for group in groups if labelled and group.pose not in {own.pose for own in kept}]
    if lost:
        text = f"the pose {lost[0].pose} has one measured visit."
        _refuse(dataset, int(lost[0].members[0]), POSE, text, again)
    if len(kept) < len(groups):
        warnings.append(f"{len(groups) - len(kept)} of {len(groups)} poses were visited once and are left out.")
    if not kept:
        hint = f"{_FEWEST_WORDS}: visit each pose again (armcal plan --iso-cube)."
        raise DataError(f"none of {len(groups)} poses was visited twice.", where=Location(str(path)), hint=hint)
    return Visits(dataset, cycles, kept, tuple(warnings))


def _cycles(dataset: Dataset, members: Mapping[tuple[str, str], Sequence[int]]) -> Indices:
    """The number of each record's cycle: its column, or which visit of its pose it is."""
    if not dataset.has(CYCLE):
        counted = np.zeros(len(dataset), dtype=np.intp)
        for own in members.values():
            counted[own] = np.arange(1, len(own) + 1)
        return counted
    stated = dataset.channels[CYCLE]
    broken = np.flatnonzero(stated != np.round(stated))
    if broken.size:
        text = f"found the cycle {stated[broken[0]]:g}, expected a whole number."
        _refuse(dataset, int(broken[0]), CYCLE, text, "Number the cycles 1, 2, 3, ...")
    for (pose, direction), own in members.items():
        seen: dict[float, int] = {}
        for i in own:
            before = seen.setdefault(stated[i], i)
            if before != i:
                named = f"{pose} from {direction}" if direction else pose
                text = f"found cycle {stated[i]:g} of {named} again; the first is in line {_line(dataset, before)}."
                _refuse(dataset, i, CYCLE, text, "Number each visit of a pose once.")
    return np.asarray(stated, dtype=np.intp)


def refuse_strangers(visits: Visits, measured: Array, reach: float) -> None:
    """Refuse visits that are nowhere near the others of their pose (N x 3; m) for an arm of this reach (m)."""
    middles = {group.pose: np.median(measured[group.members], axis=0) for group in visits.groups}
    for group in visits.groups:
        off = np.linalg.norm(measured[group.members] - middles[group.pose], axis=1)
        worst = int(np.argmax(off))
        if off[worst] <= _FAR * reach:
            continue
        place = measured[group.members[worst]]
        text = f"it is {off[worst] * _MM:.4g} mm from the other visits to {group.pose}"
        hint = "Measure it again, or take it out."
        for factor, unit in _FACTORS.items():
            if np.linalg.norm(factor * place - middles[group.pose]) < _NEAR * factor * np.linalg.norm(place):
                text += f", and among them if its coordinates are in {unit}"
                hint = "Write all rows in the unit of the column names."
        apart = {pose: float(np.linalg.norm(place - middle)) for pose, middle in middles.items()}
        nearest = min(apart, key=lambda pose: apart[pose])
        if nearest != group.pose and apart[nearest] < 0.1 * off[worst]:
            text += f", and {apart[nearest] * _MM:.3g} mm from those to {nearest}"
            hint = "If two rows were exchanged, put them right."
        _refuse(visits.dataset, int(group.members[worst]), POSE, f"{text}.", hint)


@dataclass(frozen=True)
class Comparison:
    """Commanded and attained poses of the measured target by one model of the arm (N records), in one frame."""

    words: str  # where the base is in the instrument's frame
    fitted: int  # how many numbers were found from the positions; 0: base and target are as stated
    commanded: Array  # N x 3; m
    attained: Array  # N x 3; m
    turns: Array | None  # rotation vectors from commanded to attained (N x 3; rad); None: only positions were measured
    warnings: tuple[str, ...] = ()


def compare(subject: ArmToJudge, model: str, visits: Visits, choice: FrameChoice) -> Comparison:
    """The comparison by one model of the arm.

    Raises:
        DataError: positions of the records cannot be compared, or no frame can be found.
    """
    system, parameters, dataset = subject.system, subject.models[model], visits.dataset
    evaluator: Literal["auto", "interpreted"] = "interpreted" if len(dataset) < _COMPILED_FROM else "auto"
    problem = Problem.build(
        system.arms, system.measurements, parameters, system.environment, dataset, evaluator, groups={}
    )
    records, where = problem.records(dataset), Location(dataset.source)
    try:
        sighting = sighting_of(problem, records, dataset, 0, len(dataset))
        if sighting is None or len(sighting.chosen) < len(dataset):
            raise DataError(
                f"{next(iter(system.measurements))} does not read the position of a target in a frame in each record.",
                where=where,
                hint="Judge by a measurement tip_position or tip_pose, and leave out rows without positions.",
            )
        tools = tools_of(problem, parameters.nominal(), records[0], 0)
        if model == "nominal":
            refuse_strangers(visits, sighting.measured.T, float(np.median(np.linalg.norm(tools.places, axis=0))))
        basis, is_turned = np.eye(3), True
        if choice == "auto":
            placing, _ = placings(problem, records, sighting)
            basis, is_turned = placing.basis, bool(set(placing.target) - {name for name, _ in placing.shifts})
        if choice == "found" or (choice == "auto" and placing.stands_anywhere):
            return _aligned(tools, sighting, basis, is_turned, where)
        check_reach(problem, records, dataset)
    except NotConvergedError as fault:
        hint = "Check payload, gravity and compliances, and their units."
        raise DataError(f"the {model} arm has no equilibrium ({fault.message})", where=where, hint=hint) from fault
    off, warnings = sighting.off(tools), []
    if off > FAR * sighting.size:
        ranked = alignments(tools, sighting.measured, np.zeros((3, 0)))
        if ranked and ranked[0].left * BETTER < off:
            warnings.append(
                f"typically {off * _MM:.3g} mm are between commanded and attained positions, and "
                f"{ranked[0].left * _MM:.3g} mm where the records themselves place the base, at "
                f"{pose_words(ranked[0])}. Either the arm is as far off, or the instrument's frame is not the stated "
                "one: then give --frame found."
            )
    words = "as stated: nothing was fitted to these records"
    turns = None if sighting.turned is None else _turns(tools.rotations, sighting.turned)
    return Comparison(words, 0, tools.places.T, sighting.measured.T, turns, tuple(warnings))


def _aligned(tools: Tools, sighting: Sighting, basis: Array, is_turned: bool, where: Location) -> Comparison:
    """With the base, and the target along a basis (3 x k) and turned on the tool, where the records have them."""
    poses = np.unique(np.round(tools.places, 4), axis=1).shape[1]
    ranked = alignments(tools, sighting.measured, basis, sighting.turned)
    if not ranked or poses < 3:
        records = f"{len(sighting.chosen)} records of {plural(poses, 'pose')}"
        raise DataError(
            f"found {records}, expected {FEWEST_SEEN} of three or more: the instrument's frame cannot be found from "
            "fewer.",
            where=where,
            hint="Measure more poses, or state where the instrument is and give --frame stated.",
        )
    best = ranked[0]
    fitted = 6 + basis.shape[1] - len(undetermined(tools, best, basis))
    commanded = (tools.places + np.einsum("nij,j->in", tools.rotations, best.offset)).T
    words = f"found from these records: the described base frame at {pose_words(best)} in the instrument's frame"
    if basis.shape[1]:
        x, y, z = best.offset * _MM
        words += f", the target ({x:.2f}, {y:.2f}, {z:.2f}) mm from where it is stated on the tool"
    turns = None
    if sighting.turned is not None:
        seen, mounted = best.turn.T @ sighting.turned, np.eye(3)
        if is_turned:
            mounted = nearest_turn(np.einsum("nji,njk->ik", tools.rotations, seen))
            a, b, c = Rotation.from_matrix(mounted).as_rotvec(degrees=True)
            words += f", turned by ({a:.2f}, {b:.2f}, {c:.2f}) deg"
        turns = _turns(tools.rotations @ mounted, seen)
    warnings: tuple[str, ...] = ()
    remaining = 1 - fitted / (3 * poses)
    if remaining <= 0.75:
        much = f"by about {100 * (1 - np.sqrt(remaining)):.0f} %" if remaining > 0 else "to nothing, whatever it does"
        warnings = (
            f"{fitted} numbers of base and target were found from the {3 * poses} coordinates of {poses} poses, which "
            f"makes AP smaller, {much}. RP, AD, RD and vAP depend on it little or not at all. "
            "State the frame (--frame stated), or measure more poses.",
        )
    return Comparison(words, fitted, commanded, best.back(sighting.measured).T, turns, warnings)


def _turns(commanded: Array, attained: Array) -> Array:
    """Rotation vectors (N x 3) from rotations to others (N x 3 x 3 each), in the frame's axes."""
    return np.asarray(Rotation.from_matrix(attained @ np.swapaxes(commanded, 1, 2)).as_rotvec())


def _line(dataset: Dataset, index: int) -> int:
    return dataset.rows[index] if dataset.rows else index + 1


def _refuse(dataset: Dataset, index: int, field: str, message: str, hint: str) -> NoReturn:
    raise DataError(message, where=Location(dataset.source, line=_line(dataset, index), field=field), hint=hint)
