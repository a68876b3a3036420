"""What each new posture is worth: whether it agrees with the others, and what all of them determine by now."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from armcal.base.dataset import Dataset
from armcal.errors import ArmcalError, ConfigError
from armcal.measure.measurement import Measurement
from armcal.run.experiment import Experiment

from armcal_bench.recording.agreement import Agreement, AgreementJudge, Offset
from armcal_bench.recording.knowledge import Knowledge, explained, knowledge
from armcal_bench.recording.quick_fit import QuickFitter
from armcal_bench.recording.recording_log import Posture, dataset_of

_UNFIT = (ArmcalError, ArithmeticError, ValueError)
"""Faults of postures that no fit can take."""


@dataclass(frozen=True)
class Assessment:
    """What the postures determine, and which of them disagree.

    Attributes:
        newest: how the last posture lies to the others; None where there is nothing to compare it with.
        doubts: postures that disagree, by name.
        known: what is determined; None if that could not be judged.
        why_not: why not, a sentence.
    """

    newest: Offset | None = None
    doubts: Mapping[str, Offset] = field(default_factory=dict)
    known: Knowledge | None = None
    why_not: str = ""


def contacts_of(experiment: Experiment) -> dict[str, Measurement]:
    """The measurements for which a posture is all there is to measure.

    Raises:
        ConfigError: there are none.
    """
    measurements = {name: m for name, m in experiment.system.measurements.items() if not m.channels()}
    if not measurements:
        raise ConfigError(
            "found no measurement that joint angles alone make.",
            where=experiment.source.where(("measurements",)),
            hint="Configure what the arm touches: ball_in_socket, clamped_tool, plane_contact or closed_chain. "
            "What a tracker measures, armcal acquire measures.",
        )
    return measurements


class Assessor:
    """Judges postures, and remembers which were in doubt and where the last fit ended."""

    def __init__(self, experiment: Experiment) -> None:
        self._experiment, self._contacts = experiment, contacts_of(experiment)
        self._doubtful: frozenset[str] = frozenset()
        self._values: Mapping[str, tuple[float, ...]] = {}

    def with_newest(self, postures: Sequence[Posture]) -> Assessment:
        """Judge the last posture, and those before in its light."""
        places = {p.name: i for i, p in enumerate(postures)}
        doubtful = frozenset(places[name] for name in self._doubtful if name in places)
        return self._assessed(postures, lambda judge: judge.with_newest(doubtful))

    def anew(self, postures: Sequence[Posture]) -> Assessment:
        """Judge all together: when one was taken back, or after a break."""
        return self._assessed(postures, lambda judge: judge.anew())

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
            fitter.begin_from(self._values)
            agreement = judge(AgreementJudge(fitter, [p.place for p in postures]))
            known = knowledge(experiment, fitter.problem, fitter.records, dataset)
        except _UNFIT as fault:  # what was captured is safe, and so is what comes
            return Assessment(why_not=str(fault))
        doubts = {postures[place].name: offset for place, offset in agreement.doubtful.items()}
        self._doubtful = frozenset(doubts)
        self._values = agreement.values or self._values
        return Assessment(agreement.newest, doubts, known)

    def _fitter(self, postures: Sequence[Posture]) -> tuple[Experiment, Dataset, QuickFitter]:
        dataset = dataset_of(postures)
        experiment = self._experiment.of_records(dataset)
        return experiment, dataset, QuickFitter(experiment, self._contacts, dataset)
