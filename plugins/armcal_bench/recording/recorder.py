"""Postures captured from a stream of readings, at a command or when the arm has come to rest; nothing waits here."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np
from armcal.devices.clock import Clock
from armcal.devices.joint_stream import JointSample
from armcal.measure.limits import warn_beyond_limits
from armcal.run.experiment import Experiment

from armcal_bench.recording import messages as messages_of
from armcal_bench.recording.assessor import Assessment, Assessor
from armcal_bench.recording.labels import Labels
from armcal_bench.recording.messages import Message
from armcal_bench.recording.outputs import dataset_of, write_dataset
from armcal_bench.recording.posture import Posture
from armcal_bench.recording.recording_log import RecordingLog
from armcal_bench.recording.settings import RecordingSettings
from armcal_bench.recording.window import JointKinds, Mean, SampleWindow

Capture = Literal["keys", "still", "rests"]
"""When postures are captured: at a command, when the arm has stood for a while, or at each rest of the stream."""
KEYS = "c or Enter captures, u takes the last one back, g NAME or a digit names what is touched, s tells more, q ends"


@dataclass(frozen=True)
class Task:
    """What is recorded, how, and where to.

    Attributes:
        experiment: with contacts.
        settings: when a posture is one.
        capture: what makes one be captured.
        folder: for the dataset.
        why_silent: what the stream says of lines that it passed over; empty if there were none.
    """

    experiment: Experiment
    settings: RecordingSettings
    capture: Capture
    folder: Path
    why_silent: Callable[[], str]


class Recorder:
    """Takes readings and commands, and says what came of them."""

    def __init__(self, task: Task, log: RecordingLog, clock: Clock) -> None:
        s = task.settings
        self._task, self._log, self._clock = task, log, clock
        self.kinds = JointKinds.of(task.experiment.system.arms)
        self.labels = Labels(task.experiment.system.measurements, s.groups)
        self._assessor = Assessor(task.experiment)
        length = s.rest if task.capture == "still" else s.window
        self._window = SampleWindow(self.kinds, length, s.spread, s.sliding_spread, s.samples)
        self._heard, self._is_silent = clock.now(), False
        self._fault, self._fault_at = "", clock.now()
        self._complaint = ""
        self._assessment = Assessment()
        if log.last is not None:
            self.labels.present.update(log.last.labels)

    def begin(self) -> list[Message]:
        """Where an earlier part of the recording had come to."""
        postures = self._log.postures
        if not postures:
            return []
        self._assessment = self._assessor.anew(postures)
        self._write()
        there = Message("status", f"{len(postures)} postures are there already.", {"postures": len(postures)})
        return [there, *self._known()]

    def take(self, samples: Sequence[JointSample]) -> list[Message]:
        """Readings that came."""
        messages: list[Message] = []
        for sample in samples:
            self._fault = self.kinds.fault_of(sample.angles)
            if self._fault:
                self._fault_at = sample.arrived
                self._window.clear()
                continue
            if self._task.capture == "rests":
                messages += self._kept(Mean(sample.angles, 0.0, 1, sample.labels, sample.stamp))
                continue
            self._window.add(sample)
            if self._task.capture == "still":
                messages += self._by_itself()
        if samples and not self._fault:
            self._heard = self._clock.now()  # judging a posture takes a while, in which nobody listens
        return messages + self._hearing()

    def command(self, text: str) -> list[Message]:
        """Something that was typed."""
        word, _, rest = text.strip().partition(" ")
        if word in ("", "c"):
            return self._captured()
        if word == "u":
            return self._undone()
        if word == "s":
            return self._status()
        if word == "g" or word.isdecimal():
            fault = self.labels.name(rest if word == "g" else word)
            self._complaint = ""
            shown = self.labels.shown
            return [_refused(fault) if fault else Message("named", f"the arm touches {shown}.", {"name": shown})]
        return [_refused(f"found {text.strip()[:40]!r}: {KEYS}.")]

    def finished(self) -> Message:
        """How it ended."""
        postures, assessment = self._log.postures, self._assessment
        doubts = sorted(assessment.doubts, key=int)
        sentence = f"{len(postures)} postures are recorded"
        sentence += f"; in doubt: {', '.join(doubts)}" if doubts else ""
        return Message("finished", f"{sentence}.", {"postures": len(postures), "in_doubt": doubts})

    def _captured(self) -> list[Message]:
        if self._task.capture == "rests":
            return [_refused("rests are captured by themselves, when they are over.")]
        if self._fault or self._silence() > self._task.settings.stale:
            return [_refused(self._silent())]
        mean = self._window.mean()
        return [_refused(mean.why_not)] if mean.why_not else self._kept(mean)

    def _by_itself(self) -> list[Message]:
        """Capture an arm that has come to rest somewhere else; what hinders that is told once."""
        mean = self._window.mean()
        if mean.why_not:
            self._complaint = ""
            return []
        last = self._log.last
        if last is not None and self._apart(mean.angles, last.angles) < self._task.settings.moved:
            return []
        kept = self._kept(mean)
        if kept[0].kind == "refused":
            repeated = kept[0].sentence == self._complaint
            self._complaint = kept[0].sentence
            return [] if repeated else kept
        return kept

    def _kept(self, mean: Mean) -> list[Message]:
        labels, fault = self.labels.of(mean.labels)
        if fault:
            return [_refused(fault)]
        posture = self._log.capture(mean.angles, mean.spread, mean.readings, labels, mean.stamp)
        self._write()
        postures, before = self._log.postures, self._assessment
        self._assessment = self._assessor.with_newest(postures)
        if set(before.doubts) != set(self._assessment.doubts):
            self._write()
        messages = [messages_of.captured(posture, self._assessment)]
        messages += messages_of.doubts_changed(before, self._assessment, postures)
        return messages + self._warnings(posture) + self._known()

    def _undone(self) -> list[Message]:
        posture = self._log.undo()
        if posture is None:
            return [_refused("there is no posture to take back.")]
        before = self._assessment
        self._assessment = self._assessor.anew(self._log.postures)
        self._write()
        messages = [Message("undone", f"posture {posture.name} is taken back.", {"posture": posture.name})]
        return messages + messages_of.doubts_changed(before, self._assessment, self._log.postures) + self._known()

    def _status(self) -> list[Message]:
        by_place: dict[str, int] = {}
        for posture in self._log.postures:
            by_place[posture.place] = by_place.get(posture.place, 0) + 1
        listed = ", ".join(f"{count} in {place}" for place, count in by_place.items() if place)
        lines = [f"{len(self._log.postures)} postures{f': {listed}' if listed else ''}."]
        lines += [f"posture {name} disagrees by {offset}." for name, offset in self._assessment.doubts.items()]
        lines += [f"the next one touches {self.labels.shown}."] if self.labels.columns else []
        lines += [f"digits: {self.labels.known_labels_text()}."] if self.labels.known else []
        why = self._task.why_silent()
        lines += [f"{why}."] if why else []
        missing = self._assessor.explained(self._log.postures)
        content = {"postures": len(self._log.postures), "groups": by_place, "name": self.labels.shown}
        content |= {"in_doubt": sorted(self._assessment.doubts, key=int), "missing": list(missing)}
        return [Message("status", "\n".join((*lines, *missing)), content), *self._known()]

    def _warnings(self, posture: Posture) -> list[Message]:
        """A posture much like one before, or beyond the joints' limits."""
        messages = []
        for other in self._log.postures[:-1]:
            apart = self._apart(posture.angles, other.angles)
            if other.labels == posture.labels and apart < self._task.settings.alike:
                sentence = f"posture {posture.name} is nearly posture {other.name} again: it tells little that is new."
                messages.append(Message("warning", sentence, {"posture": posture.name, "alike": other.name}))
                break
        checked = warn_beyond_limits(dataset_of([posture], {}), self._task.experiment.system.arms)
        return messages + [Message("warning", text, {"posture": posture.name}) for text in checked.warnings]

    def _apart(self, one: Mapping[str, float], other: Mapping[str, float]) -> float:
        """The largest difference of a joint (rad); a slide of a metre counts as a radian."""
        return float(np.max([abs(one[channel] - other[channel]) for channel in self.kinds.channels]))

    def _known(self) -> list[Message]:
        return [messages_of.known(self._assessment.known)] if self._assessment.known else []

    def _hearing(self) -> list[Message]:
        """Tell once that nothing comes, and that it comes again."""
        is_silent = self._task.capture != "rests" and self._silence() > self._task.settings.stale
        changed, self._is_silent = is_silent != self._is_silent, is_silent
        if not changed:
            return []
        return [Message("silent", self._silent()) if is_silent else Message("heard", "joint readings come again.")]

    def _silence(self) -> float:
        return self._clock.now() - self._heard

    def _silent(self) -> str:
        if self._fault and self._clock.now() - self._fault_at <= self._task.settings.stale:
            return self._fault
        why = self._task.why_silent()
        reason = f" ({why})" if why else ": is the sender running?"
        return f"no joint readings came for {self._silence():.1f} s{reason}"

    def _write(self) -> None:
        doubts = {name: f"disagrees by {offset}" for name, offset in self._assessment.doubts.items()}
        write_dataset(self._task.folder, self._task.experiment, self._log.postures, doubts)


def _refused(why: str) -> Message:
    return Message("refused", why)
