"""What a recalibration did in a mission, judged against the truth: errors, recovery, availability, decisions."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.base.arrays import Array, Mask
from armcal.estimate.simulation import DAY_S, Mission

from armcal_online.mission.decisions import Finding, Occurrence, Verdict, findings, occurrences
from armcal_online.mission.log import Decision, MissionLog

USABLE = ("nominal", "watch")
FILTER, RECENT = "recalibrated", "refit_recent"
_IN_A_ROW = 3
_RATIO_WINDOW_S = DAY_S


@dataclass(frozen=True)
class ErrorCurve:
    """Mean tip errors over time.

    Attributes:
        times: s since the mission began, in order (T): every record's, and every hour.
        is_hour: which of them are hours (T).
        is_record: which are records' (T).
        errors: m (T), by name: ``frozen`` is the calibration before launch, ``refit`` and ``refit_recent`` robust fits
            of all and of the most recent records where there are enough, ``recalibrated`` the filter.
        levels: T.
    """

    times: Array
    is_hour: Mask
    is_record: Mask
    errors: Mapping[str, Array]
    levels: tuple[str, ...]

    @property
    def frozen(self) -> Array:
        return self.errors["frozen"]

    @property
    def recalibrated(self) -> Array:
        return self.errors[FILTER]


@dataclass(frozen=True)
class EventReport:
    """What became of the events of one moment.

    ``before`` and ``worst`` are mean tip errors (m). Recovery is counted in records that arrived and in s, None if it
    did not come about before the next events or the end, and from an event that grows.
    """

    occurrence: Occurrence
    finding: Finding
    before: float
    worst: float
    records: int | None
    seconds: float | None

    @property
    def aftermath(self) -> str:
        """A few words: after how many records it was over, or how large the error became."""
        if self.occurrence.grows:
            return f"at worst {1000 * self.worst:.1f} mm"
        if self.records is None:
            return "not recovered"
        return f"recovered in {self.records} record{'' if self.records == 1 else 's'}"


@dataclass(frozen=True)
class WorstRatio:
    """The day on which the filter was worst against the robust refit of the most recent records.

    Attributes:
        ratio: of their mean errors on it.
        since: when it begins, s since the mission began.
    """

    ratio: float
    since: float


@dataclass(frozen=True)
class Judgement:
    """A mission's figures.

    ``availability`` is the share of all hours in which the level allowed use and the error was within the limit.
    ``quiet`` (s) is how long nothing was the matter: the time in which alarms are false.
    """

    curve: ErrorCurve
    events: tuple[EventReport, ...]
    false_alarms: tuple[Decision, ...]
    quiet: float
    records: Mapping[str, int]
    availability: float
    limit: float
    worst: WorstRatio | None

    def within(self, name: str) -> float:
        return float((self.curve.errors[name] <= self.limit)[self.curve.is_hour].mean())

    def count(self, verdict: Verdict) -> int:
        return sum(report.finding.verdict == verdict for report in self.events)


def judge(mission: Mission, log: MissionLog, curve: ErrorCurve, limit: float, recovered: float) -> Judgement:
    """Everything but the errors themselves.

    Args:
        mission: records and truth.
        log: what the recalibration did.
        curve: errors over time.
        limit: of the mean tip error for use, m.
        recovered: the error is back within so many times what it was before an event.
    """
    happened = occurrences(mission.events)
    decided, false_alarms = findings(happened, log.decisions)
    ends = [*(occurrence.time for occurrence in happened), mission.seconds][1:]
    reports = [
        _event_report(occurrence, finding, end, curve, recovered)
        for occurrence, finding, end in zip(happened, decided, ends, strict=True)
    ]
    usable = np.array([level in USABLE for level in curve.levels]) & (curve.recalibrated <= limit)
    quiet = np.array([not _is_open(happened, time) for time in curve.times[curve.is_hour].tolist()])
    return Judgement(
        curve=curve,
        events=tuple(reports),
        false_alarms=false_alarms,
        quiet=float(quiet.mean()) * mission.seconds,
        records=_record_count(mission, log, happened),
        availability=float(usable[curve.is_hour].mean()),
        limit=limit,
        worst=_worst_ratio(curve),
    )


def _is_open(happened: Sequence[Occurrence], time: float) -> bool:
    return any(occurrence.is_open(time) for occurrence in happened)


def _event_report(
    occurrence: Occurrence, finding: Finding, end: float, curve: ErrorCurve, recovered: float
) -> EventReport:
    day_before = (curve.times < occurrence.time) & (curve.times >= occurrence.time - DAY_S)
    before = float(np.median(curve.recalibrated[day_before if day_before.any() else slice(1)]))
    after = (curve.times >= occurrence.time) & (curve.times < end)
    following = np.flatnonzero(after & curve.is_record)
    good = curve.recalibrated[following] <= recovered * before
    runs = np.convolve(good, np.ones(_IN_A_ROW), "valid") == _IN_A_ROW if len(good) >= _IN_A_ROW else np.zeros(0)
    first = int(np.argmax(runs)) if runs.any() and not occurrence.grows else None
    return EventReport(
        occurrence=occurrence,
        finding=finding,
        before=before,
        worst=float(curve.recalibrated[after].max(initial=0.0)),
        records=None if first is None else first + 1,
        seconds=None if first is None else float(curve.times[following[first]] - occurrence.time),
    )


def _worst_ratio(curve: ErrorCurve) -> WorstRatio | None:
    """Over the days from the first refit on; None without one."""
    refit = curve.errors.get(RECENT)
    if refit is None or np.array_equal(refit, curve.frozen):
        return None
    begins = curve.times[int(np.argmax(refit != curve.frozen))]
    worst: WorstRatio | None = None
    for since in np.arange(begins, curve.times[-1], _RATIO_WINDOW_S):
        inside = curve.is_hour & (curve.times >= since) & (curve.times < since + _RATIO_WINDOW_S)
        if inside.any():
            ratio = float(curve.recalibrated[inside].mean() / refit[inside].mean())
            worst = WorstRatio(ratio, float(since)) if worst is None or ratio > worst.ratio else worst
    return worst


def _record_count(mission: Mission, log: MissionLog, happened: Sequence[Occurrence]) -> dict[str, int]:
    """What became of the records; good ones are those that were not made outliers, nor exchanged."""
    verdicts = np.array([log.verdicts.get(text, "ignored") for text in mission.records.ids])
    apart = np.array([not _is_open(happened, time) for time in mission.times.tolist()], dtype=bool)
    bad = mission.outliers | mission.exchanged
    rejected, accepted = verdicts == "rejected", verdicts == "accepted"
    return {
        "made": len(verdicts) + mission.lost,
        "lost": mission.lost,
        "arrived": len(verdicts),
        "outliers": int(mission.outliers.sum()),
        "exchanged": int(mission.exchanged.sum()),
        "accepted": int(accepted.sum()),
        "rejected": int(rejected.sum()),
        "ignored": int((verdicts == "ignored").sum()),
        "good_rejected": int((~bad & rejected).sum()),
        "good_rejected_apart": int((~bad & rejected & apart).sum()),
        "outliers_accepted": int((mission.outliers & accepted).sum()),
        "exchanged_accepted": int((mission.exchanged & accepted).sum()),
    }
