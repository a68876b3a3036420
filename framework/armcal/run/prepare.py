"""A problem ready to solve: data read and checked against the model, records split, functions compiled."""

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace

import numpy as np

from armcal.arm.assembly import command_channels, shown_joint
from armcal.arm.effects import JointEffect
from armcal.arm.statics import LOAD_CHANNELS
from armcal.base.dataset import Dataset
from armcal.base.units import digits, to_unit
from armcal.config.system import System
from armcal.diagnose.large_errors import Finding, first_few
from armcal.diagnose.permuted_axes import MUCH_BETTER, find_permuted_axes
from armcal.diagnose.readings import check_reach
from armcal.errors import ConfigError, DataError, Location, ProblemError, noted
from armcal.estimate.estimator import Progress, no_progress
from armcal.estimate.identifiability import require_solvable
from armcal.estimate.polish import mislabelled, restricted, started
from armcal.estimate.profile import profiled
from armcal.estimate.start import Start, aligned_start, with_proposals
from armcal.estimate.validation import Split, error_unit, folds, hold_out, split_by_id, split_by_label
from armcal.measure.groups import first_of_pose
from armcal.measure.measurement import GroupedMeasurement
from armcal.measure.reader import read_ids
from armcal.problem.drift import with_drift
from armcal.problem.finite import require_numbers
from armcal.problem.problem import FactorRecords, Problem
from armcal.problem.readings import with_joint_noise
from armcal.run.experiment import Experiment
from armcal.run.pose_residual import unlearned

_MEND = {
    True: "the order, the directions or the zeros of the joints in the model",
    False: "how the tracker's frame lies",
}
_STILL = {"angle": ("deg", 1.0), "length": ("mm", 1.0)}
"""A joint that moved by less stood still, but for the noise of its reading."""
PAYLOAD = "payload"
_DENSEST, _SHORTEST = 200.0, 0.4
"""kg for each cubic metre of an arm's length (industrial arms and palletisers: 5 to 90); m, what shorter arms count."""


@dataclass(frozen=True)
class Stopwatch:
    """Seconds of each stage."""

    began: float = field(default_factory=time.perf_counter)
    seconds: dict[str, float] = field(default_factory=dict)

    @contextmanager
    def stage(self, name: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.seconds[name] = self.seconds.get(name, 0.0) + time.perf_counter() - start

    def total(self) -> float:
        return time.perf_counter() - self.began


@dataclass(frozen=True)
class Prepared:
    """A problem ready to solve: data read and checked, functions compiled."""

    dataset: Dataset  # all records that are used, in SI
    problem: Problem  # compiled, with the arm and the target where ``start`` places them
    records: tuple[FactorRecords, ...]  # the dataset as the problem's factors read it, one entry a measurement
    split: Split  # which records train, and which are held out
    warnings: tuple[str, ...]  # what a user should know before the fit
    start: Start  # where the fit begins
    findings: tuple[Finding, ...] = ()  # of the checks, for the verdict

    @property
    def training(self) -> tuple[FactorRecords, ...]:
        return self.problem.subset(self.records, self.split.train)


def prepare(
    experiment: Experiment,
    watch: Stopwatch,
    accept: bool = False,
    progress: Progress = no_progress,
    dataset: Dataset | None = None,
) -> Prepared:
    """Everything that can be done and refused before solving; see ``assemble``.

    Raises:
        InputError: data, units, counts or rank do not allow a calibration.
    """
    ready = assemble(experiment, watch, accept, progress, dataset)
    with watch.stage("check"), noted(ready.warnings):
        problems = require_solvable(ready.problem.with_records(ready.training), ready.problem.parameters.nominal())
    return replace(ready, warnings=(*ready.warnings, *problems))


def assemble(
    experiment: Experiment,
    watch: Stopwatch,
    accept: bool = False,
    progress: Progress = no_progress,
    dataset: Dataset | None = None,
) -> Prepared:
    """Data read and checked, and the problem that it makes, whether or not it can be solved.

    With ``accept``, data that look mixed up are not refused, but a bad finding. Records that are at hand
    (``dataset``) are not read.

    Raises:
        InputError: data, units or counts do not allow a calibration; its notes are the warnings of the data.
    """
    with watch.stage("read"):
        dataset = experiment.read(progress) if dataset is None else dataset
    with noted(dataset.warnings):
        return _assembled(experiment.of_records(dataset), dataset, watch, accept)


def _assembled(experiment: Experiment, dataset: Dataset, watch: Stopwatch, accept: bool) -> Prepared:
    system = experiment.system
    with watch.stage("build"):
        settings = (experiment.parameters, system.environment)
        problem = Problem.build(system.arms, system.measurements, *settings, dataset, experiment.settings.evaluator)
        start = with_proposals(aligned_start(problem, dataset), dataset)
        problem = started(start.problem)
        require_numbers(problem, dataset)
        problem = acting(problem, dataset)
        records = problem.records
    with watch.stage("check"):
        unlearned(system)
        require_loads(experiment, dataset)
        heavy = mass_findings(system)
        mixed_up, named = check_permuted_axes(problem, records, dataset, accept), mislabelled(problem, dataset)
        check_reach(problem, records, dataset)
        split = split_of(experiment, dataset)
        if not len(split.train):
            raise ProblemError("no record is left to train on.", hint="Hold fewer out, or measure more poses.")
        if experiment.settings.validation.limit is not None and error_unit(problem) != "mm":
            where = experiment.source.where(("validation", "limit"))
            hint = "Leave it out: records are explained that miss by far more than the median."
            raise ConfigError("found a length, and nothing measured is a length.", where=where, hint=hint)
        problem = restricted(problem.subset(split.train)).with_records(records)
        profiled(problem, experiment.settings.uncertainty.profile)
    texts = (*experiment.warnings, *dataset.warnings, *start.warnings, *named, *(one.text for one in heavy))
    ready = Prepared(dataset, problem, records, split, texts, start, (*mixed_up, *heavy))
    if experiment.settings.validation.folds:
        folds_of(experiment, ready)  # refused before the fit rather than after it
    return ready


def acting(problem: Problem, dataset: Dataset) -> Problem:
    """The problem with the noise of joints, and with what drifts."""
    nominal = problem.parameters.nominal()
    return with_drift(with_joint_noise(problem, nominal), dataset, nominal)


def split_of(experiment: Experiment, dataset: Dataset) -> Split:
    """Which records train, and which are held out, as configured.

    Raises:
        ConfigError: no column separates the groups that are asked for, or no record is held out.
    """
    validation = experiment.settings.validation
    if validation.group_by is not None:
        labels_of(experiment, dataset)
    if validation.train_groups:
        return split_by_label(labels_of(experiment, dataset), validation.train_groups)
    if validation.train_ids is not None:
        return split_by_id(dataset.ids, read_ids(validation.train_ids))
    split = hold_out(len(dataset), validation.holdout, validation.seed, experiment.poses(dataset))
    if validation.holdout > 0 and not len(split.holdout):
        raise ConfigError(
            f"a share of {validation.holdout:g} of {len(dataset)} records is no record: none would be held out.",
            where=experiment.source.where(("validation", "holdout")),
            hint="Hold out a quarter (0.25), or none (0) and give folds: 5.",
        )
    return split


def folds_of(experiment: Experiment, ready: Prepared) -> tuple[Split, ...]:
    settings, training = experiment.settings.validation, ready.dataset.subset(ready.split.train)
    return folds(len(training), settings.folds, settings.seed, experiment.poses(training))


def label_of(experiment: Experiment) -> str | None:
    """The text column that separates groups; None if there is none."""
    text = experiment.settings.validation.group_by
    if text is not None:
        return text
    labels = [
        measurement.group_labels
        for measurement in experiment.system.measurements.values()
        if isinstance(measurement, GroupedMeasurement)
    ]
    return next((label[0] for label in labels if label), None)


def labels_of(
    experiment: Experiment, dataset: Dataset, label: str | None = None, where: Location | None = None
) -> tuple[str, ...]:
    """Which group each record belongs to, by the configured column or another ``label`` (``where`` that is asked for).

    Raises:
        ConfigError: no column separates groups.
        DataError: records are grouped by payload, and none states one.
    """
    label = label or label_of(experiment)
    if label == PAYLOAD and not (dataset.has(PAYLOAD) or label in dataset.extra):
        raise DataError(
            "no column states what hung on the tool.",
            where=Location(dataset.source),
            hint="Add a column payload_g to the data, or payloads_g to a simulation.",
        )
    if label is None or not (label in dataset.extra or label == PAYLOAD):
        raise ConfigError(
            f"found no column {label or 'of groups'} in the records; they have {', '.join(dataset.extra) or 'none'}.",
            where=where or experiment.source.where(("validation",)),
            hint=f"Name a text column of the data, or {PAYLOAD}: group_by: NAME.",
        )
    return group_texts(dataset, label)


def group_texts(dataset: Dataset, label: str) -> tuple[str, ...]:
    """A text column as groups are named by it, without spaces about it; a payload to the nearest tenth of a gram."""
    if label in dataset.extra:
        return tuple(text.strip() for text in dataset.extra[label])
    return tuple(f"{tenths / 10:g} g" for tenths in np.round(dataset.column(PAYLOAD) * 10_000).tolist())


def check_permuted_axes(
    problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, accept: bool = False
) -> list[Finding]:
    """Positions that do not fit the model, but do once one exchange is undone; with ``accept`` a bad finding.

    Raises:
        DataError: they are such, and not accepted; it names what looks mixed up.
    """
    reading = find_permuted_axes(problem, records, dataset)
    if reading is None:
        return []
    adapted = "model, however its free parameters adapt" if reading.adapted else "nominal arm"
    text = (
        f"{reading.measurement}: as they stand, the data are typically {digits(reading.as_given_mm)} mm off the "
        f"{adapted}; with {', or with '.join(reading.readings)}, they are "
        f"{digits(reading.left_mm)} mm off."
    )
    mend = _MEND[reading.of_joints]
    hint = f"Check the unit in the column names; mend columns in the file or by data.columns, or {mend}."
    if accept:
        return [Finding("bad", text, f"limit {MUCH_BETTER:g} times", hint)]
    hint += (
        " If the data are right, the model's nominal values are far off: give better ones, or calibrate as it "
        "stands: armcal run --accept."
    )
    raise DataError(text, where=Location(dataset.source), hint=hint)


def still_joints(system: System, dataset: Dataset) -> dict[str, str]:
    still = {}
    for channel, dimension in command_channels(system.arms).items():
        unit, least = _STILL[dimension]
        values = dataset.column(channel) if dataset.has(channel) else np.array([])
        known = to_unit(values[np.isfinite(values)], unit)
        if known.size and np.ptp(known) < least:
            still[channel] = f"{np.mean(known):.4g} {unit}"
    return still


def still_findings(system: System, dataset: Dataset) -> list[Finding]:
    """A warning of joints that stood still in all records that trained."""
    still = still_joints(system, dataset)
    if not still:
        return []
    listed = [f"{shown_joint(c, system.arms)} at {where}" for c, where in still.items()]
    text = (
        f"Hardly moved in the training records: {first_few(listed)}. Predictions elsewhere rest on nominal values and "
        "priors, and no record judges them."
    )
    test = "range, limits " + " and ".join(f"{least:g} {unit}" for unit, least in _STILL.values())
    return [
        Finding("warning", text, test, "Move these joints too, or use the calibration only where they stand there.")
    ]


def same_pose_findings(system: System, dataset: Dataset, split: Split) -> list[Finding]:
    pose = first_of_pose(dataset, [*filter(dataset.has, command_channels(system.arms))])
    count, held = int(np.isin(pose[split.holdout], pose[split.train]).sum()), len(split.holdout)
    if not count:
        return []
    text = (
        f"{count} of {held} held-out records are at poses that trained: their errors show how well a pose repeats, not "
        "how good the model is elsewhere."
    )
    return [Finding("warning", text, "poses alike in all joints, under the same load", "Hold out other poses.")]


def require_loads(experiment: Experiment, dataset: Dataset) -> None:
    """Free springs need something that loads them: a link's mass, a payload, a force or a torque.

    Raises:
        ConfigError: nothing does.
    """
    statics, channels = experiment.system.statics, LOAD_CHANNELS[3:]
    stated = statics.payload or any((*statics.force, *statics.torque))
    if stated or any(dataset.has(channel) and dataset.column(channel).any() for channel in channels):
        return
    free = [block.name for block in experiment.parameters.free]
    for name, arm in experiment.system.arms.items():
        elastic = {effect for effect, one in arm.effects.items() if type(one).springs is not JointEffect.springs}
        springs = [own for own in free if own.startswith(f"{name}.") and own.split(".")[1] in elastic]
        weigh = any(mass.mass for mass in arm.masses) or any(own.startswith(f"{name}.links.") for own in free)
        if springs and arm.deflection_size and not weigh:
            raise ConfigError(
                f"the springs of {name} are free ({first_few(springs)}), and nothing loads them: no link has a mass, "
                "and no payload, force or torque is stated.",
                where=experiment.source.where(("arms", name, "effects")),
                hint=f"State masses (arms.{name}.links: mass, com and frame of each) or statics.payload_g; or take the "
                "springs out. Without loads what bends is taken for lengths.",
            )


def mass_findings(system: System) -> list[Finding]:
    """A warning of masses that no arm of that size has: grams that were read as kilograms."""
    findings = []
    for name, arm in system.arms.items():
        total, size = sum(mass.mass for mass in arm.masses), max(arm.length, _SHORTEST)
        limit = _DENSEST * size**3
        if total > limit:
            worst = max(arm.masses, key=lambda mass: mass.mass)
            text = (
                f"The links of {name} weigh {digits(total)} kg ({worst.name}: {digits(worst.mass)} kg), and the arm is "
                f"{digits(arm.length)} m long from joint to joint: no arm of that length weighs more than "
                f"{digits(limit)} kg. Are these grams?"
            )
            test = f"limit {_DENSEST:g} kg for each cubic metre of the length, {_SHORTEST:g} m at least"
            findings.append(Finding("warning", text, test, f"Correct the masses: arms.{name}.links, or the URDF's."))
    return findings


def gravity_findings(system: System, dataset: Dataset) -> list[Finding]:
    """A warning where springs bend under weights and the direction of gravity is not stated.

    A tracker's frame may stand in any way: gravity that is turned with it makes wrong compliances, and fits as well.
    """
    if system.statics.gravity is not None or dataset.has("gravity_z"):
        return []
    payload = bool(system.statics.payload) or (dataset.has("payload") and bool(dataset.column("payload").any()))
    bent = [name for name, arm in system.arms.items() if arm.deflection_size and (arm.masses or payload)]
    if not bent:
        return []
    x, y, z = system.environment.gravity
    text = (
        f"The direction of gravity is not stated: for the springs of {', '.join(bent)} it was assumed to be "
        f"({x:g}, {y:g}, {z:g}) m/s^2 in the frame of the measurements, z up. If that frame is tilted, compliances are "
        "wrong."
    )
    action = (
        "State statics.gravity_m_s2 in that frame, or add the columns gravity_x_m_s2, gravity_y_m_s2 and gravity_z_m_s2"
        " to the records."
    )
    return [Finding("warning", text, action=action)]
