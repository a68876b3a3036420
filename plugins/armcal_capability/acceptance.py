"""``armcal acceptance``: how accurate and repeatable an arm is, by the terms of ISO 9283 [ISO9283].

Accuracy is how far the barycentre of what was attained is from what was commanded, repeatability how far single visits
are from that barycentre. Orientations are rotation vectors of the turn from the commanded to the attained orientation,
in the axes of the frame: to first order the standard's angles a, b, c about x, y, z.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Literal, NoReturn, Self, get_args

import click
import numpy as np
from armcal.arm.assembly import command_channels
from armcal.base.arrays import Array, Indices
from armcal.base.config_text import as_json
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.base.quaternions import nearest_turn
from armcal.base.units import DIMENSIONLESS
from armcal.calibration.calibration import Calibration
from armcal.calibration.intervals import PredictionRecord
from armcal.cli.common import FILE, Console, accept, command_line, overrides, speaking
from armcal.config.system import System, build_component
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.diagnose.readings import check_reach
from armcal.errors import ConfigError, DataError, Location, NotConvergedError
from armcal.estimate.prediction import RADIUS_LEVEL, Spread, quantile
from armcal.estimate.start import BETTER, FAR, placings, pose_words
from armcal.io.cells import csv_text
from armcal.io.folder import reserved
from armcal.measure.checks import records_of
from armcal.measure.environment import noticed
from armcal.measure.groups import pose_numbers
from armcal.measure.reader import CYCLE, Reader, ReadRequest, RequestedChannel, requested_channels
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import FEWEST, Sighting, Tools, alignments, sighting_of, tools_of, undetermined
from armcal.report.numbers import decimals_for, plural
from armcal.report.page import rendered
from armcal.report.tables import TextTable
from armcal.run.experiment import Experiment, with_data
from armcal.version import __version__
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armcal_capability.survey import examined_arm

OURS = ("acceptance.html", "acceptance.json", "acceptance.csv")
ISO_CYCLES = 30  # visits to a pose that the standard asks for
_SECTIONS = {
    "poses": ("Poses: accuracy AP and repeatability RP, position (mm) and orientation (deg)", ("Pose", "Direction")),
    "distances": ("Pairs of poses: distance accuracy AD and repeatability RD (mm)", ("From", "To")),
    "directions": ("Several directions of approach: variation of accuracy vAP (mm)", ("Pose", "Directions")),
}
_BY_AXIS = ("AP_x_mm", "AP_y_mm", "AP_z_mm")  # in the files, not in tables
_LARGEST, _MUCH = 1e4, 0.3
_MOST_ROWS = 40  # of a table on the screen and the page; the CSV has all
_COMMANDED = {
    "nominal": "the nominal arm at the commanded joint positions",
    "calibrated": "the calibrated arm at the same positions",
}
_MM = 1000.0
_TIMES = 3.0  # standard deviations that a repeatability counts
_MOST_PAIRED = 10  # poses of which all pairs are taken; of more, each with the next
_DRAWS, _FEWEST_DRAWS, _MOST_NUMBERS, _SEED = 2000, 200, 1_000_000, 9283
_LOW, _HIGH = (1 - RADIUS_LEVEL) / 2, (1 + RADIUS_LEVEL) / 2
_POSE, _DIRECTION, _FEWEST = "pose", "direction", 2
_FEWEST_WORDS = "Repeatability needs two visits, ISO 9283 asks for 30"
_REPEATS = "Records of one pose are held out together"
"""In what readers warn of: repeats, which are what is measured here."""
_FAR = 0.1  # of the typical distance of the positions that arms reach: no arm repeats as badly
_FACTORS = {1000.0: "m", 10.0: "cm", 25.4: "inches", 0.001: "thousandths of the column's unit"}
_NEAR = 0.02
_FrameChoice = Literal["auto", "stated", "found"]
_FRAMES = get_args(_FrameChoice)
_COMPILED_FROM = 5000


@dataclass(frozen=True)
class Figure:
    """An estimate and its 95 % interval, in one unit (``high`` may be infinite)."""

    value: float
    low: float
    high: float


@dataclass(frozen=True)
class Row:
    """One figure of a pose by a direction, of two poses, or of a pose by several directions."""

    section: str  # poses, distances or directions
    names: tuple[str, str]
    cycles: int
    model: str  # nominal or calibrated; measured where no model has a part in it
    name: str  # with its unit: AP_mm
    figure: Figure


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


@dataclass(frozen=True)
class Comparison:
    """Commanded and attained poses of the measured target by one model of the arm (N records), in one frame."""

    words: str  # where the base is in the instrument's frame
    fitted: int  # how many numbers were found from the positions; 0: base and target are as stated
    commanded: Array  # N x 3; m
    attained: Array  # N x 3; m
    turns: Array | None  # rotation vectors from commanded to attained (N x 3; rad); None: only positions were measured
    warnings: tuple[str, ...] = ()


@click.command()
@click.argument("source", metavar="CALIBRATION|CONFIG", type=FILE)
@click.argument("records", type=FILE)
@click.option("--out", required=True, type=FILE, help="Where the results go.")
@click.option("--settings", type=FILE, help="A configuration whose section data says how RECORDS are read.")
@click.option(
    "--frame",
    type=click.Choice(_FRAMES),
    default="auto",
    show_default=True,
    help="Where the instrument and the target are: as stated, found from RECORDS, or found where they are free.",
)
@accept
@overrides
@speaking
def acceptance(console: Console, source: Path, records: Path, out: Path, frame: _FrameChoice, **given: Any) -> None:
    """Judge an arm by the terms of ISO 9283 from RECORDS of poses that were visited again and again.

    A calibration is set beside its nominal arm; a configuration is judged as its nominal arm.
    """
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    registry = console.registry()
    subject = ArmToJudge.load(source, given["settings"], given["overrides"], records, registry, given["accept"])
    visits = read_visits(subject, registry, records)
    comparisons = {model: compare(subject, model, visits, frame) for model in subject.models}
    rows = list(assess(visits, comparisons))
    warnings = [*visits.warnings, *(f"{model}: {text}" for model, c in comparisons.items() for text in c.warnings)]
    if subject.trained_on and visits.dataset.sha256 == subject.trained_on:
        warnings.append("the calibration was fitted to these very records: measure others to judge it by.")
    noise = next(iter(subject.system.measurements.values())).noise()
    content = _content(rows, visits, comparisons, repeatability_of(_MM * np.array(noise[:3])), warnings)
    texts, tables = _sentences(content, source.name), list(_tables(rows))
    facts = {"command": command_line(), "files": f"{source}, {records}", "sha256 of the records": visits.dataset.sha256}
    shown = [*texts, *(text[:1].upper() + text[1:] for text in warnings)]
    page = {"title": source.name, "sentences": shown, "tables": tables, "facts": facts, "version": __version__}
    lines = [
        (r.section, *r.names, r.cycles, r.model, r.name, r.figure.value, r.figure.low, r.figure.high) for r in rows
    ]
    headings = ("section", "of", "with", "cycles", "model", "figure", "value", "low_95", "high_95")
    figures = [dict(zip(headings, line, strict=True)) for line in lines]
    kept.place(
        {
            "acceptance.csv": csv_text([headings, *lines], ".6g"),
            "acceptance.json": as_json({"source": str(source), **content, "figures": figures}) + "\n",
            "acceptance.html": rendered("acceptance.html.j2", page, Path(__file__).parent),
        }
    )
    console.result({**content, "folder": str(out)})
    for table in tables:
        console.table(table.caption, [words for words, _ in table.headings], table.rows, left=("To", "Direction"))
    for text in warnings:
        console.warn(text)
    for text in texts:
        console.line(text)
    console.line(f"page: {out / 'acceptance.html'}")


def _content(
    rows: Sequence[Row], visits: Visits, comparisons: Mapping[str, Comparison], noise: float, warnings: Sequence[str]
) -> dict[str, Any]:
    """What the figures come to, in mm and deg; ``noise`` is the RP (mm) that the declared noise makes alone."""

    def ends(model: str, name: str) -> dict[str, float] | None:
        values = np.abs([row.figure.value for row in rows if (row.model, row.name) == (model, name)])
        return {"mean": float(np.mean(values)), "most": float(np.max(values))} if len(values) else None

    names = [row.name for row in rows if row.model != "measured" and row.name not in _BY_AXIS]
    sizes = [len(group.members) for group in visits.groups]
    return {
        "records": len(visits.dataset),
        "poses": len(visits.poses),
        "cycles": {"least": min(sizes), "most": max(sizes)},
        "commanded": {m: _COMMANDED[m] for m in comparisons},
        "frames": {m: {"words": c.words, "numbers_found": c.fitted} for m, c in comparisons.items()},
        "summary": {m: {name: ends(m, name) for name in dict.fromkeys(names)} for m in comparisons},
        "repeatability_mm": ends("measured", "RP_mm"),
        "of_instrument_mm": noise,
        "warnings": list(warnings),
    }


def _sentences(content: Mapping[str, Any], name: str) -> list[str]:
    """The result in sentences, what it rests on, and what is to be known of it."""
    rp, ends = content["repeatability_mm"], "{mean:.3g} mm ({most:.3g} mm at the worst pose)"
    accuracy = "; ".join(f"{model} {ends.format(**own['AP_mm'])}" for model, own in content["summary"].items())
    texts = [f"{name}: mean pose accuracy AP {accuracy}; mean repeatability RP {ends.format(**rp)}."]
    for model, frame in content["frames"].items():
        texts.append(f"AP, {model}: commanded is {content['commanded'][model]}; the frame is {frame['words']}.")
    if content["of_instrument_mm"] > _MUCH * rp["mean"]:
        texts.append(
            f"RP holds the instrument's noise, which as declared makes {content['of_instrument_mm']:.2g} mm alone."
        )
    cycles = content["cycles"]
    if cycles["least"] < ISO_CYCLES:
        times = " to ".join(map(str, sorted({*cycles.values()})))
        texts.append(
            f"Poses were visited {times} times; ISO 9283 asks for {ISO_CYCLES} cycles. These are its formulas, "
            "not its test: read the intervals."
        )
    return texts


def _tables(rows: Sequence[Row]) -> Iterator[TextTable]:
    """A table a section: a row a pose or pair, a column a figure."""

    def shown_figure(figure: Figure) -> str:
        decimals = min(decimals_for(max(figure.value - figure.low, abs(figure.value) / 100)), 4)
        high = f"{figure.high:.{decimals}f}" if figure.high < _LARGEST else "?"
        return f"{figure.value:.{decimals}f} ({figure.low:.{decimals}f} to {high})"

    for section, (caption, names) in _SECTIONS.items():
        members: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row.section == section and row.name not in _BY_AXIS:
                members.setdefault(row.names, []).append(row)
        if not members:
            continue
        more = f"; the first {_MOST_ROWS} of {len(members)}" if len(members) > _MOST_ROWS else ""
        shown = [i for i in range(2) if any(own[i] for own in members)]
        headings = [(names[i], False) for i in shown] + [("Cycles", True)]
        for row in next(iter(members.values())):
            words, _, unit = row.name.rpartition("_")
            headings.append((f"{words.replace('_', ' ')} {row.model}".removesuffix(" measured") + f", {unit}", True))
        cells = [
            (*(own[i] for i in shown), str(figures[0].cycles), *(shown_figure(row.figure) for row in figures))
            for own, figures in list(members.items())[:_MOST_ROWS]
        ]
        yield TextTable(f"{caption}, 95 % intervals{more}", tuple(headings), tuple(cells))


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
    labelled = _POSE in dataset.extra
    poses = [f"pose {n + 1}" for n in pose_numbers(dataset, [*command_channels(arms)])]
    if labelled:
        poses = [text.strip() for text in dataset.extra[_POSE]]
    directions = [text.strip() for text in dataset.extra.get(_DIRECTION, ("",) * len(dataset))]
    if "" in poses:
        _refuse(dataset, poses.index(""), _POSE, "no pose is named.", "Name the pose of every record, or of none.")
    members: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(zip(poses, directions, strict=True)):
        members.setdefault(key, []).append(i)
    cycles = _cycles(dataset, members)
    groups = [Group(*key, np.array(sorted(own, key=lambda i: cycles[i]))) for key, own in members.items()]
    kept = tuple(group for group in groups if len(group.members) >= _FEWEST)
    warnings = [text for text in dataset.warnings if _REPEATS not in text]
    again = f"{_FEWEST_WORDS}: measure it again, or take its rows out."
    lost = [group for group in groups if labelled and group.pose not in {own.pose for own in kept}]
    if lost:
        text = f"the pose {lost[0].pose} has one measured visit."
        _refuse(dataset, int(lost[0].members[0]), _POSE, text, again)
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
        _refuse(visits.dataset, int(group.members[worst]), _POSE, f"{text}.", hint)


def compare(subject: ArmToJudge, model: str, visits: Visits, choice: _FrameChoice) -> Comparison:
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
            f"found {records}, expected {FEWEST} of three or more: the instrument's frame cannot be found from fewer.",
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


def assess(visits: Visits, comparisons: Mapping[str, Comparison]) -> Iterator[Row]:
    """All figures: of each pose AP and RP, of pairs of poses AD and RD, of poses by several directions vAP."""
    first, of_pose = next(iter(comparisons.values())), dict[str, list[Group]]()
    attained, turned = _MM * first.attained, first.turns
    for group in visits.groups:
        of_pose.setdefault(group.pose, []).append(group)
        start, own = ("poses", (group.pose, group.direction), len(group.members)), group.members
        for model, comparison in comparisons.items():
            errors = _MM * (comparison.attained - comparison.commanded)[own]
            yield Row(*start, model, "AP_mm", accuracy(errors))
            for axis, along in zip("xyz", errors.T, strict=True):
                yield Row(*start, model, f"AP_{axis}_mm", mean_figure(along))
            for axis, turns in zip("abc", () if comparison.turns is None else comparison.turns[own].T, strict=False):
                yield Row(*start, model, f"AP_{axis}_deg", mean_figure(np.degrees(turns)))
        yield Row(*start, "measured", "RP_mm", repeatability(attained[own]))
        for axis, turns in zip("abc", () if turned is None else turned[own].T, strict=False):
            yield Row(*start, "measured", f"RP_{axis}_deg", spread_figure(np.degrees(turns)))
    # Pairs are of the visits in the same cycle.
    main = {pose: max(groups, key=lambda group: len(group.members)).members for pose, groups in of_pose.items()}
    for names in combinations(main, 2) if len(main) <= _MOST_PAIRED else pairwise(main):
        one, other = (main[name] for name in names)
        _, at_one, at_other = np.intersect1d(visits.cycles[one], visits.cycles[other], return_indices=True)
        one, other = one[at_one], other[at_other]
        if len(one) < _FEWEST:
            continue
        apart = np.linalg.norm(attained[one] - attained[other], axis=1)
        for model, comparison in comparisons.items():
            commanded = _MM * np.linalg.norm(comparison.commanded[one] - comparison.commanded[other], axis=1)
            yield Row("distances", names, len(one), model, "AD_mm", mean_figure(apart - commanded))
        yield Row("distances", names, len(one), "measured", "RD_mm", spread_figure(apart))
    for pose, groups in of_pose.items():
        if len(groups) > 1:
            pairs = combinations([attained[group.members] for group in groups], 2)
            widest = max((barycentres_apart(*pair) for pair in pairs), key=lambda figure: figure.value)
            names, cycles = (pose, ", ".join(g.direction for g in groups)), min(len(g.members) for g in groups)
            yield Row("directions", names, cycles, "measured", "vAP_mm", widest)


def accuracy(errors: Array) -> Figure:
    """AP of one pose from attained minus commanded positions (n x 3): the length of their mean.

    The length of the true mean differs from that of the estimated one by no more than these differ: the interval is
    the radius that holds the mean with 95 %, to either side, and rather too wide than too narrow.
    """
    return _about(float(np.linalg.norm(errors.mean(axis=0))), np.cov(errors.T) / len(errors), len(errors) - 1)


def barycentres_apart(first: Array, second: Array) -> Figure:
    """Of two groups (n x 3 each): of two directions, their part of vAP."""
    size = float(np.linalg.norm(first.mean(axis=0) - second.mean(axis=0)))
    covariance = np.cov(first.T) / len(first) + np.cov(second.T) / len(second)
    return _about(size, covariance, min(len(first), len(second)) - 1)


def repeatability(positions: Array) -> Figure:
    """RP of one pose (n x 3): mean and three standard deviations of the distances from the barycentre.

    The interval is a parametric bootstrap: how a repeatability from n visits varies about the true one where positions
    are normal, with the covariance found. Of few visits it is wide, and lies above the estimate, which is then small.
    """
    estimate, count = float(_repeatability(positions[None])[0]), len(positions)
    values = np.linalg.eigvalsh(np.cov(positions.T))
    draws = max(_FEWEST_DRAWS, min(_DRAWS, _MOST_NUMBERS // count))
    random = np.random.default_rng(_SEED).standard_normal((draws, count, 3))
    drawn = random * np.sqrt(np.maximum(values, 0.0))
    far = np.linalg.norm(drawn, axis=2)
    true = float(far.mean() + _TIMES * far.std())
    if true == 0.0:
        return Figure(estimate, estimate, estimate)
    low, high = np.quantile(_repeatability(drawn) / true, [_LOW, _HIGH])
    return Figure(estimate, estimate / float(high), estimate / float(low) if low > 0 else np.inf)


def repeatability_of(deviations: Array) -> float:
    """RP of normal noise with these standard deviations along x, y and z (3)."""
    far = np.linalg.norm(np.random.default_rng(_SEED).standard_normal((_MOST_NUMBERS, 3)) * deviations, axis=1)
    return float(far.mean() + _TIMES * far.std())


def mean_figure(values: Array) -> Figure:
    mean = float(np.mean(values))
    half = float(quantile(RADIUS_LEVEL, len(values) - 1) * np.std(values, ddof=1) / np.sqrt(len(values)))
    return Figure(mean, mean - half, mean + half)


def spread_figure(values: Array) -> Figure:
    """Three standard deviations."""
    size, freedom = _TIMES * float(np.std(values, ddof=1)), len(values) - 1
    low, high = (np.sqrt(freedom / chi2.ppf(share, freedom)) for share in (_HIGH, _LOW))
    return Figure(size, size * float(low), size * float(high))


def _repeatability(positions: Array) -> Array:
    """Of many groups (m x n x 3)."""
    far = np.linalg.norm(positions - positions.mean(axis=1, keepdims=True), axis=2)
    return np.asarray(far.mean(axis=1) + _TIMES * far.std(axis=1, ddof=1))


def _about(size: float, covariance: Array, freedom: int) -> Figure:
    """A length with the radius that holds its vector with 95 %, from the covariance of this."""
    radius = float(Spread(covariance[None], freedom).radius(RADIUS_LEVEL)[0]) if np.trace(covariance) > 0 else 0.0
    return Figure(size, max(size - radius, 0.0), size + radius)
