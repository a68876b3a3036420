"""Which postures agree with the others, judged anew with each posture that comes.

A posture is compared with what a fit without it expects there; it disagrees where chance would make it lie so far off
once in ten thousand postures (F, the noise being estimated). In a group where more postures disagree than agree the
majority is right. What disagrees takes no part in the fits that judge the others.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from armcal.base.dataset import Dataset
from armcal.base.units import to_unit
from armcal.devices.live import LiveCamera
from armcal.errors import ArmcalError, ConfigError
from armcal.measure.measurement import Measurement
from armcal.run.experiment import Experiment
from scipy.special import fdtri

from armcal_bench.recording.knowledge import Advice, Knowledge, advice, explained, knowledge
from armcal_bench.recording.quick_fit import Fitted, PredictedResidual, QuickFitter
from armcal_bench.recording.recording_log import Posture, dataset_of
from armcal_bench.recording.window import JointKinds

_CHANCE = 1e-4
_CHANCE_LATER = 1e-5
"""For postures that agreed when they came: they are judged again and again."""
_LOOKED_AT = 1e-2
"""A posture this unlikely is fitted without, to see."""
_MOST_DROPPED_AT_ONCE = 3
_UNFIT = (ArmcalError, ArithmeticError, ValueError)
"""Faults of postures that no fit can take."""


@dataclass(frozen=True)
class Offset:
    """How far a posture lies from where the others expect it, and how far was to be expected (root mean square).

    Turns are zero for contacts that turn freely; pixels are a corner's, root mean square over the image.
    """

    off_mm: float
    expected_mm: float
    off_deg: float = 0.0
    expected_deg: float = 0.0
    off_px: float = 0.0
    expected_px: float = 0.0

    def __str__(self) -> str:
        kinds = [("mm", self.off_mm, self.expected_mm), ("deg", self.off_deg, self.expected_deg)]
        kinds = [*kinds, ("px", self.off_px, self.expected_px)]
        parts = [f"{_short(off)} {unit} (expected {_short(known)})" for unit, off, known in kinds if known > 0]
        return " and ".join(parts) or "nothing"


@dataclass(frozen=True)
class Agreement:
    """Which postures agree.

    Attributes:
        doubtful: those that disagree, by place (from 0).
        newest: of the last one; None where there is nothing to compare it with.
        values: of the last fit, to begin the next one from.
        fitted: the last fit.
    """

    doubtful: Mapping[int, Offset] = field(default_factory=dict)
    newest: Offset | None = None
    values: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    fitted: Fitted | None = None


class AgreementJudge:
    """Judges the postures of a fitter; ``groups`` are their names of groups (N)."""

    def __init__(self, fitter: QuickFitter, groups: Sequence[str]) -> None:
        self._fitter, self._groups = fitter, np.array(groups, dtype=object)
        self._last = len(groups) - 1

    def with_newest(self, doubtful: frozenset[int]) -> Agreement:
        """Judge the last posture, and with it those before, of which some were in doubt.

        Raises:
            NotConvergedError: a posture has no elastic equilibrium.
        """
        before = self._active(doubtful | {self._last})
        if not before.any():
            return Agreement()
        fitted = self._fitter.fit(before)
        newest = self._predicted(fitted, self._last)
        candidates = [*doubtful] if newest is None else [*doubtful, self._last]
        disagreeing = {one for one in candidates if self._disagrees(fitted, one, _CHANCE)}
        own = {int(i) for i in np.flatnonzero(self._groups == self._groups[self._last])}
        majority = own & disagreeing
        if len(majority) > len(own - disagreeing):  # more of the group in doubt than not: they are right if they agree
            others = (disagreeing - majority) | (own - disagreeing)
            fitted = self._fitter.fit(self._active(others))
            left_out = self._fitter.left_out(fitted)
            if not any(_is_beyond(*left_out[one], fitted.freedom, _CHANCE) for one in majority):
                disagreeing = others
        return replace(self._settled(disagreeing), newest=None if newest is None else _offset(newest))

    def anew(self) -> Agreement:
        return self._settled(set())

    def _active(self, doubtful: frozenset[int] | set[int]) -> np.ndarray[tuple[int], np.dtype[np.bool_]]:
        used = np.ones(len(self._groups), dtype=bool)
        used[list(doubtful)] = False
        return used

    def _predicted(self, fitted: Fitted, one: int) -> PredictedResidual | None:
        """None for a posture in whose group nothing was fitted."""
        alike = (self._groups == self._groups[one]) & fitted.used
        return self._fitter.predicted(fitted, one) if alike.any() else None

    def _disagrees(self, fitted: Fitted, one: int, chance: float) -> bool:
        predicted = self._predicted(fitted, one)
        return predicted is not None and _is_beyond(predicted.distance, predicted.numbers, fitted.freedom, chance)

    def _settled(self, doubtful: set[int]) -> Agreement:
        """Drop fitted postures that disagree with the others of their group, the farthest first."""
        rounds = _MOST_DROPPED_AT_ONCE if doubtful or self._last < 0 else max(_MOST_DROPPED_AT_ONCE, self._last // 3)
        fitted = self._fitter.fit(self._active(doubtful))
        for _ in range(rounds):
            ratios = {
                one: distance / _limit(numbers, fitted.freedom, _LOOKED_AT)
                for one, (distance, numbers) in self._fitter.left_out(fitted).items()
                if np.sum((self._groups == self._groups[one]) & fitted.used) >= 2
            }
            worst = max(ratios, key=lambda one: ratios[one], default=None)
            if worst is None or ratios[worst] <= 1:
                break
            without = self._fitter.fit(self._active(doubtful | {worst}))
            if not self._disagrees(without, worst, _CHANCE_LATER):
                break
            doubtful, fitted = doubtful | {worst}, without
        offsets = {one: _offset(self._fitter.predicted(fitted, one)) for one in sorted(doubtful)}
        return Agreement(offsets, values=self._fitter.free_values(fitted), fitted=fitted)


def _is_beyond(distance: float, numbers: int, freedom: float, chance: float) -> bool:
    return distance > _limit(numbers, freedom, chance)


def _limit(numbers: int, freedom: float, chance: float) -> float:
    return float(numbers * fdtri(numbers, max(freedom, 1.0), 1.0 - chance))


def _offset(predicted: PredictedResidual) -> Offset:
    numbers = []
    for dimension, unit in (("length", "mm"), ("angle", "deg"), ("image", "px")):
        own = predicted.dimensions == dimension
        points = max(np.sum(own) / 2, 1) if dimension == "image" else 1
        off = np.sum(predicted.residual[own] ** 2) / points
        expected = np.sum(np.diag(predicted.covariance)[own]) / points
        numbers += [to_unit(float(np.sqrt(square)), unit) for square in (off, expected)]
    return Offset(*map(float, numbers))


def _short(number: float) -> str:
    return f"{number:.2g}" if number < 10 else f"{number:.0f}"


@dataclass(frozen=True)
class Assessment:
    """What the postures determine, and which of them disagree.

    Attributes:
        newest: how the last posture lies to the others; None where there is nothing to compare it with.
        doubts: postures that disagree, by name.
        known: what is determined; None if that could not be judged.
        advice: how well an instrument's parameters are known, and what to take next.
        why_not: why not, a sentence.
    """

    newest: Offset | None = None
    doubts: Mapping[str, Offset] = field(default_factory=dict)
    known: Knowledge | None = None
    why_not: str = ""
    advice: Advice = field(default_factory=Advice)


def contacts_of(experiment: Experiment, camera: LiveCamera | None) -> dict[str, Measurement]:
    """The measurements for which a posture, and a camera's image of it, is all there is to measure.

    Raises:
        ConfigError: there are none.
    """
    seen = "" if camera is None else camera.measurement
    measurements = {n: m for n, m in experiment.system.measurements.items() if n == seen or not m.channels()}
    if not measurements:
        raise ConfigError(
            "found no measurement that joint angles alone make.",
            where=experiment.source.where(("measurements",)),
            hint="Configure what the arm touches: ball_in_socket, clamped_tool, plane_contact or closed_chain. "
            "With a camera give --camera. What a tracker measures, armcal acquire measures.",
        )
    return measurements


class Assessor:
    """Judges postures, and remembers which were in doubt and where the last fit ended."""

    def __init__(self, experiment: Experiment, camera: LiveCamera | None) -> None:
        self._experiment, self._contacts = experiment, contacts_of(experiment, camera)
        self._joints = JointKinds.of(experiment.system.arms).dimensions
        self._doubtful: frozenset[str] = frozenset()
        self._values: Mapping[str, tuple[float, ...]] = {}

    def with_newest(self, postures: Sequence[Posture]) -> Assessment:
        places = {p.name: i for i, p in enumerate(postures)}
        doubtful = frozenset(places[name] for name in self._doubtful if name in places)
        return self._assessed(postures, lambda judge: judge.with_newest(doubtful))

    def anew(self, postures: Sequence[Posture]) -> Assessment:
        """Judge all together: when one was taken back, or after a break."""
        return self._assessed(postures, lambda judge: judge.anew())

    def tried(self, postures: Sequence[Posture]) -> Assessment:
        remembered = self._doubtful, self._values
        try:
            return self.with_newest(postures)
        finally:
            self._doubtful, self._values = remembered

    def explained(self, postures: Sequence[Posture]) -> tuple[str, ...]:
        """Everything that is not determined yet, and why; it takes a moment."""
        if not postures:
            return ()
        try:
            experiment, dataset, fitter = self._fitter(postures)
            return explained(experiment, fitter.problem, fitter.records, dataset)
        except _UNFIT as fault:
            return (str(fault),)

    def _assessed(self, postures: Sequence[Posture], judge: Callable[[AgreementJudge], Agreement]) -> Assessment:
        if not postures:
            return Assessment()
        try:
            experiment, dataset, fitter = self._fitter(postures)
            agreement = judge(AgreementJudge(fitter, [p.place for p in postures]))
            known = knowledge(experiment, fitter.problem, fitter.records, dataset)
            outlook = Advice()
            if agreement.fitted is not None:
                outlook = advice(fitter, agreement.fitted, dataset, self._joints)
        except _UNFIT as fault:  # what was captured is safe, and so is what comes
            return Assessment(why_not=str(fault))
        doubts = {postures[place].name: offset for place, offset in agreement.doubtful.items()}
        self._doubtful = frozenset(doubts)
        self._values = agreement.values or self._values
        return Assessment(agreement.newest, doubts, known, advice=outlook)

    def _fitter(self, postures: Sequence[Posture]) -> tuple[Experiment, Dataset, QuickFitter]:
        dataset = dataset_of(postures)
        experiment = self._experiment.of_records(dataset)
        return experiment, dataset, QuickFitter(experiment, self._contacts, dataset, self._values)
