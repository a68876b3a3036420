"""``armcal acceptance``: how accurate and repeatable an arm is, by the terms of ISO 9283 [ISO9283].

Accuracy is how far the barycentre of what was attained is from what was commanded, repeatability how far single visits
are from that barycentre. Orientations are rotation vectors of the turn from the commanded to the attained orientation,
in the axes of the frame: to first order the standard's angles a, b, c about x, y, z.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import combinations, pairwise
from pathlib import Path
from typing import Any, Literal, NamedTuple, NoReturn, Self, get_args

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
from armcal.cli.common import FILE, Console, accept, overrides, speaking
from armcal.config.system import System, build_component
from armcal.config.yaml_source import ConfigSource, load_config
from armcal.diagnose.data import check_reach
from armcal.errors import ConfigError, DataError, Location, noted
from armcal.estimate.prediction import RADIUS_LEVEL, Spread, quantile
from armcal.estimate.start import BETTER, FAR, pose_words
from armcal.io.plain_files import reserved
from armcal.measure.checks import noticed, records_of
from armcal.measure.groups import pose_numbers
from armcal.measure.reader import CYCLE, Reader, ReadRequest, RequestedChannel, requested_channels
from armcal.measure.tables import csv_text
from armcal.plugins import PluginRegistry
from armcal.problem.problem import Problem
from armcal.problem.rigid_alignment import FEWEST, Sighting, Tools, alignments, sighting_of, tools_of, undetermined
from armcal.report.document import Document, Section, Table
from armcal.report.numbers import decimals_for, plural
from armcal.run.experiment import Experiment, with_data
from scipy.spatial.transform import Rotation
from scipy.stats import chi2

from armcal_capability.capability import examined_arm

OURS = ("acceptance.json", "acceptance.csv")
ISO_CYCLES = 30  # visits to a pose that the standard asks for
_SECTIONS = {
    "poses": ("Poses: accuracy AP and repeatability RP, position (mm) and orientation (deg)", ("Pose", "Direction")),
    "distances": ("Pairs of poses: distance accuracy AD and repeatability RD (mm)", ("From", "To")),
    "directions": ("Several directions of approach: variation of accuracy vAP (mm)", ("Pose", "Directions")),
}
_BY_AXIS = ("AP_x_mm", "AP_y_mm", "AP_z_mm")  # in the files, not in tables
_MM = 1000.0
_TIMES = 3.0  # standard deviations that a repeatability counts
_MOST_PAIRED = 10  # poses of which all pairs are taken; of more, each with the next
_DRAWS, _FEWEST_DRAWS, _MOST_NUMBERS, _SEED = 2000, 200, 1_000_000, 9283
_LOW, _HIGH = (1 - RADIUS_LEVEL) / 2, (1 + RADIUS_LEVEL) / 2
_FAR = 0.1  # of the typical distance of the positions that arms reach: no arm repeats as badly
_Frame = Literal["stated", "found"]


class Figure(NamedTuple):
    """An estimate and its 95 % interval, in one unit (``high`` may be infinite)."""

    value: float
    low: float
    high: float


class Row(NamedTuple):
    """One figure of a pose by a direction, of two poses, or of a pose by several directions."""

    section: str  # poses, distances or directions
    of: str
    other: str
    cycles: int
    model: str  # nominal or calibrated; measured where no model has a part in it
    name: str  # with its unit: AP_mm
    value: float
    low: float
    high: float


_HEADINGS = ("section", "of", "with", "cycles", "model", "figure", "value", "low_95", "high_95")


@dataclass(frozen=True)
class ArmToJudge:
    system: System  # with the arm, and the one measurement that is judged
    models: Mapping[str, Parameters]  # nominal and, from a calibration, calibrated
    source: ConfigSource  # with the section data, which says how records are read
    kept: PredictionRecord | None = None  # of a calibration, if the records are read as its data was
    trained_on: str = ""  # hash of the data that the calibration comes from

    @classmethod
    def load(
        cls, path: Path, overrides: Sequence[str], records: Path, registry: PluginRegistry, accept: bool = False
    ) -> Self:
        """From a calibration or a configuration; of a calibration ``overrides`` say how records are read."""
        given = load_config(path, overrides)
        kept, trained_on = None, ""
        if "armcal_calibration" in given.data:
            calibration = Calibration.load(path, registry, accept)
            section = {"type": "csv", **given.data.get("data", {})}
            source = with_data(replace(given, data={**given.data, "data": section}), records)
            system, record = calibration.system, calibration.record
            models = {"nominal": calibration.nominal, "calibrated": calibration.parameters}
            kept, trained_on = None if overrides else record.prediction, record.identity.get("data", "")
        else:
            experiment = Experiment.load(path, overrides, records, registry)
            source, system, models = experiment.source, experiment.system, {"nominal": experiment.parameters}
        examined_arm(system, path)
        reading = (n for n, m in system.measurements.items() if {c.name for c in m.channels()}.issuperset("xyz"))
        if (judged := next(reading, None)) is None:
            raise ConfigError(
                f"found {', '.join(system.measurements) or 'no measurement'}, expected one that reads positions.",
                where=Location(str(path)),
                hint="Add a measurement tip_position or tip_pose: accuracy is judged by measured poses.",
            )
        system = replace(system, measurements={judged: system.measurements[judged]})
        return cls(system, models, source, kept, trained_on)


@dataclass(frozen=True)
class Visits:
    dataset: Dataset
    cycles: Array  # number of each record's cycle (N)
    groups: Mapping[tuple[str, str], Indices]  # of a pose from a direction, places of its records
    warnings: tuple[str, ...]


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
@click.option(
    "--frame",
    type=click.Choice(get_args(_Frame)),
    default="stated",
    show_default=True,
    help="Where the instrument and the target are: as stated or calibrated, or found from RECORDS.",
)
@accept
@overrides
@speaking
def acceptance(console: Console, source: Path, records: Path, out: Path, frame: _Frame, **given: Any) -> None:
    """Judge an arm by the terms of ISO 9283 from RECORDS of poses that were visited again and again.

    A calibration is set beside its nominal arm; a configuration is judged as its nominal arm. For records of a
    calibration that are no CSV, --set data.type=NAME names their reader.
    """
    kept = click.get_current_context().with_resource(reserved(out, OURS))
    registry = console.registry()
    subject = ArmToJudge.load(source, given["overrides"], records, registry, given["accept"])
    visits = read_visits(subject, registry, records)
    comparisons = {model: compare(subject, model, visits, frame) for model in subject.models}
    rows = list(assess(visits, comparisons))
    warnings = [*visits.warnings, *(f"{model}: {text}" for model, c in comparisons.items() for text in c.warnings)]
    if subject.trained_on and visits.dataset.sha256 == subject.trained_on:
        warnings.append("the calibration was fitted to these very records: measure others to judge it by.")
    noise = next(iter(subject.system.measurements.values())).noise()
    content = _content(rows, visits, comparisons, repeatability_of(_MM * np.array(noise[:3])), warnings)
    figures = [dict(zip(_HEADINGS, row, strict=True)) for row in rows]
    origin = {"source": str(source), "records_sha256": visits.dataset.sha256}
    whole = as_json({**origin, **content, "figures": figures}) + "\n"
    kept.place({"acceptance.csv": csv_text([_HEADINGS, *rows], ".6g"), "acceptance.json": whole})
    for text in warnings:
        console.warn(text)
    headline, *others = _sentences(content, source.name)
    sections = [Section("Figures", parts=list(_tables(rows)), level="always")]
    console.show(
        Document(f"Acceptance of {source.name}", headline, sections, summary=others, data=content), folder=str(out)
    )
    console.line(f"figures: {out / 'acceptance.csv'}")


def _content(
    rows: Sequence[Row], visits: Visits, comparisons: Mapping[str, Comparison], noise: float, warnings: Sequence[str]
) -> dict[str, Any]:
    def ends(model: str, name: str) -> dict[str, float] | None:
        values = np.abs([row.value for row in rows if (row.model, row.name) == (model, name)])
        return {"mean": float(np.mean(values)), "most": float(np.max(values))} if len(values) else None

    names = [row.name for row in rows if row.model != "measured" and row.name not in _BY_AXIS]
    sizes = [len(members) for members in visits.groups.values()]
    return {
        "records": len(visits.dataset),
        "poses": len({pose for pose, _ in visits.groups}),
        "cycles": {"least": min(sizes), "most": max(sizes)},
        "frames": {m: {"words": c.words, "numbers_found": c.fitted} for m, c in comparisons.items()},
        "summary": {m: {name: ends(m, name) for name in dict.fromkeys(names)} for m in comparisons},
        "repeatability_mm": ends("measured", "RP_mm"),
        "of_instrument_mm": noise,
        "warnings": list(warnings),
    }


def _sentences(content: Mapping[str, Any], name: str) -> list[str]:
    rp, ends = content["repeatability_mm"], "{mean:.3g} mm ({most:.3g} mm at the worst pose)"
    accuracy = "; ".join(f"{model} {ends.format(**own['AP_mm'])}" for model, own in content["summary"].items())
    texts = [f"{name}: mean pose accuracy AP {accuracy}; mean repeatability RP {ends.format(**rp)}."]
    for model, frame in content["frames"].items():
        texts.append(
            f"AP, {model}: to the {model} arm at the commanded joint positions; the frame is {frame['words']}."
        )
    noise = content["of_instrument_mm"]
    texts.append(f"RP holds the instrument's noise, which as declared makes {noise:.2g} mm alone.")
    cycles = content["cycles"]
    if cycles["least"] < ISO_CYCLES:
        times = " to ".join(map(str, sorted({*cycles.values()})))
        texts.append(
            f"Poses were visited {times} times; ISO 9283 asks for {ISO_CYCLES} cycles. These are its formulas, "
            "not its test: read the intervals."
        )
    return texts


def _tables(rows: Sequence[Row]) -> Iterator[Table]:
    def shown(row: Row) -> str:
        decimals = min(decimals_for(max(row.value - row.low, abs(row.value) / 100)), 4)
        high = f"{row.high:.{decimals}f}" if row.high < 1e4 else "?"
        return f"{row.value:.{decimals}f} ({row.low:.{decimals}f} to {high})"

    for section, (caption, names) in _SECTIONS.items():
        members: dict[tuple[str, str], list[Row]] = {}
        for row in rows:
            if row.section == section and row.name not in _BY_AXIS:
                members.setdefault((row.of, row.other), []).append(row)
        if not members:
            continue
        used = [i for i in range(2) if any(own[i] for own in members)]
        headings = [*(names[i] for i in used), "Cycles"]
        for row in next(iter(members.values())):
            words, _, unit = row.name.rpartition("_")
            headings.append(f"{words.replace('_', ' ')} {row.model}".removesuffix(" measured") + f", {unit}")
        cells = [(*(own[i] for i in used), str(f[0].cycles), *map(shown, f)) for own, f in members.items()]
        yield Table(f"{caption}, 95 % intervals", headings, cells, left=("To", "Direction"))


def read_visits(subject: ArmToJudge, registry: PluginRegistry, path: Path) -> Visits:
    source, arms = subject.source, subject.system.arms
    cycle = RequestedChannel(CYCLE, (CYCLE,), DIMENSIONLESS, required=False)
    channels = (*requested_channels(arms, subject.system.measurements, measured=True), cycle)
    section = dict(source.data["data"])
    if subject.kept is not None:
        section["columns"] = subject.kept.columns_in(path, channels)
    reader: Reader
    reader, _ = build_component(replace(source, data={**source.data, "data": section}), registry, "reader", ("data",))
    dataset = noticed(records_of(reader, ReadRequest(arms, subject.system.measurements, channels)))
    if "pose" in dataset.extra:
        poses = [text.strip() for text in dataset.extra["pose"]]
    else:
        poses = [f"pose {n + 1}" for n in pose_numbers(dataset, [*command_channels(arms)])]
    directions = [text.strip() for text in dataset.extra.get("direction", ("",) * len(dataset))]
    if "" in poses:
        _refuse(dataset, poses.index(""), "pose", "no pose is named.", "Name the pose of every record, or of none.")
    members: dict[tuple[str, str], list[int]] = {}
    for i, key in enumerate(zip(poses, directions, strict=True)):
        members.setdefault(key, []).append(i)
    # The number of a cycle: its column, or which visit of its pose it is.
    cycles = dataset.channels[CYCLE] if dataset.has(CYCLE) else np.zeros(len(dataset))
    for key, own in members.items():
        if not dataset.has(CYCLE):
            cycles[own] = np.arange(1, len(own) + 1)
        first: dict[float, int] = {}
        for i in own:
            before = first.setdefault(cycles[i], i)
            if before != i:
                named, line = " from ".join(filter(None, key)), _line(dataset, before)
                text = f"found cycle {cycles[i]:g} of {named} again; the first is in line {line}."
                _refuse(dataset, i, CYCLE, text, "Number each visit of a pose once.")
    groups = {key: np.array(own) for key, own in members.items() if len(own) > 1}
    # Readers warn of repeats, which are what is measured here.
    warnings = [text for text in dataset.warnings if "Records of one pose are held out together" not in text]
    needed = "Repeatability needs two visits, ISO 9283 asks for 30"
    if not groups:
        hint = f"{needed}: visit each pose again (armcal plan --iso-cube)."
        raise DataError(f"none of {len(members)} poses was visited twice.", where=Location(str(path)), hint=hint)
    if lost := [" from ".join(filter(None, key)) for key in members if key not in groups]:
        named = ", ".join(lost[:5]) + (", ..." if len(lost) > 5 else "")
        warnings.append(f"{len(lost)} of {len(members)} poses were visited once and are left out ({named}). {needed}.")
    return Visits(dataset, cycles, groups, tuple(warnings))


def refuse_strangers(visits: Visits, measured: Array, reach: float) -> None:
    """Refuse visits that are nowhere near the others of their pose (N x 3; m) for an arm of this reach (m)."""
    middles = {pose: np.median(measured[members], axis=0) for (pose, _), members in visits.groups.items()}
    for (pose, _), members in visits.groups.items():
        off = np.linalg.norm(measured[members] - middles[pose], axis=1)
        worst = int(np.argmax(off))
        if off[worst] <= _FAR * reach:
            continue
        place = measured[members[worst]]
        text = f"it is {off[worst] * _MM:.4g} mm from the other visits to {pose}"
        hint = "Check the units of its coordinates, measure it again, or take it out."
        apart = {other: float(np.linalg.norm(place - middle)) for other, middle in middles.items()}
        nearest = min(apart, key=lambda other: apart[other])
        if nearest != pose and apart[nearest] < 0.1 * off[worst]:
            text += f", and {apart[nearest] * _MM:.3g} mm from those to {nearest}"
            hint = "If two rows were exchanged, put them right."
        _refuse(visits.dataset, int(members[worst]), "pose", f"{text}.", hint)


def compare(subject: ArmToJudge, model: str, visits: Visits, frame: _Frame) -> Comparison:
    system, parameters, dataset = subject.system, subject.models[model], visits.dataset
    problem = Problem.build(
        system.arms, system.measurements, parameters, system.environment, dataset, "interpreted", groups={}
    )
    where = Location(dataset.source)
    sighting = sighting_of(problem, dataset, 0, len(dataset))
    if sighting is None or len(sighting.chosen) < len(dataset):
        raise DataError(
            f"{next(iter(system.measurements))} does not read the position of a target in a frame in each record.",
            where=where,
            hint="Judge by a measurement tip_position or tip_pose, and leave out rows without positions.",
        )
    tools = tools_of(problem, parameters.nominal(), 0)
    if frame == "stated":
        with noted(["where the instrument may stand anywhere, give --frame found."]):
            check_reach(problem, dataset)
    if model == "nominal":
        refuse_strangers(visits, sighting.measured.T, float(np.median(np.linalg.norm(tools.places, axis=0))))
    if frame == "found":
        return _aligned(tools, sighting, where)
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


def _aligned(tools: Tools, sighting: Sighting, where: Location) -> Comparison:
    poses = np.unique(np.round(tools.places, 4), axis=1).shape[1]
    ranked = alignments(tools, sighting.measured, np.eye(3), sighting.turned)
    if not ranked or poses < 3:
        records = f"{len(sighting.chosen)} records of {plural(poses, 'pose')}"
        raise DataError(
            f"found {records}, expected {FEWEST} of three or more: the instrument's frame cannot be found from fewer.",
            where=where,
            hint="Measure more poses, or state where the instrument is and give --frame stated.",
        )
    best = ranked[0]
    fitted = 9 - len(undetermined(tools, best, np.eye(3)))
    commanded = (tools.places + np.einsum("nij,j->in", tools.rotations, best.offset)).T
    x, y, z = best.offset * _MM
    words = (
        f"found from these records: the described base frame at {pose_words(best)} in the instrument's frame, "
        f"the target ({x:.2f}, {y:.2f}, {z:.2f}) mm from where it is stated on the tool"
    )
    turns = None
    if sighting.turned is not None:
        seen = best.turn.T @ sighting.turned
        mounted = nearest_turn(np.einsum("nji,njk->ik", tools.rotations, seen))
        a, b, c = Rotation.from_matrix(mounted).as_rotvec(degrees=True)
        words += f", turned by ({a:.2f}, {b:.2f}, {c:.2f}) deg"
        turns = _turns(tools.rotations @ mounted, seen)
    warnings: tuple[str, ...] = ()
    if 4 * fitted >= 3 * poses:
        share = 100 * np.sqrt(max(1 - fitted / (3 * poses), 0.0))
        warnings = (
            f"{fitted} numbers of base and target were found from the {3 * poses} coordinates of {poses} poses: AP "
            f"shows about {share:.0f} % of what it is. RP, AD, RD and vAP depend on it little or not at all. "
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
    first, of_pose = next(iter(comparisons.values())), dict[str, dict[str, Indices]]()
    attained, turned = _MM * first.attained, first.turns
    for (pose, direction), own in visits.groups.items():
        of_pose.setdefault(pose, {})[direction] = own
        start = ("poses", pose, direction, len(own))
        for model, comparison in comparisons.items():
            errors = _MM * (comparison.attained - comparison.commanded)[own]
            yield Row(*start, model, "AP_mm", *accuracy(errors))
            for axis, along in zip("xyz", errors.T, strict=True):
                yield Row(*start, model, f"AP_{axis}_mm", *mean_figure(along))
            for axis, turns in zip("abc", () if comparison.turns is None else comparison.turns[own].T, strict=False):
                yield Row(*start, model, f"AP_{axis}_deg", *mean_figure(np.degrees(turns)))
        yield Row(*start, "measured", "RP_mm", *repeatability(attained[own]))
        for axis, turns in zip("abc", () if turned is None else turned[own].T, strict=False):
            yield Row(*start, "measured", f"RP_{axis}_deg", *spread_figure(np.degrees(turns)))
    # Pairs are of the visits in the same cycle.
    main = {pose: max(groups.values(), key=len) for pose, groups in of_pose.items()}
    for names in combinations(main, 2) if len(main) <= _MOST_PAIRED else pairwise(main):
        one, other = (main[name] for name in names)
        _, at_one, at_other = np.intersect1d(visits.cycles[one], visits.cycles[other], return_indices=True)
        one, other = one[at_one], other[at_other]
        if len(one) < 2:
            continue
        apart = np.linalg.norm(attained[one] - attained[other], axis=1)
        for model, comparison in comparisons.items():
            commanded = _MM * np.linalg.norm(comparison.commanded[one] - comparison.commanded[other], axis=1)
            yield Row("distances", *names, len(one), model, "AD_mm", *mean_figure(apart - commanded))
        yield Row("distances", *names, len(one), "measured", "RD_mm", *spread_figure(apart))
    for pose, groups in of_pose.items():
        if len(groups) > 1:
            pairs = combinations([attained[own] for own in groups.values()], 2)
            widest = max((barycentres_apart(*pair) for pair in pairs), key=lambda figure: figure.value)
            yield Row(
                "directions", pose, ", ".join(groups), min(map(len, groups.values())), "measured", "vAP_mm", *widest
            )


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
