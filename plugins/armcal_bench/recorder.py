"""A recording: postures captured from a stream of readings, at a command or when the arm has come to rest."""

from collections import Counter, deque
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from armcal.devices.clock import Clock
from armcal.devices.line_source import refused_lines_text
from armcal.devices.live import (
    JointSample,
    JointStream,
    LiveCamera,
    Shot,
    refused_by,
    samples_of,
    shot_of,
    shots_of,
)
from armcal.errors import InputError
from armcal.io.plain_files import write_over
from armcal.measure.checks import warn_beyond_limits
from armcal.plugins import refuse

from armcal_bench.agreement import Assessment, Assessor, contacts_of
from armcal_bench.bench import Bench, closing
from armcal_bench.keys import END, OperatorInput
from armcal_bench.postures import (
    IMAGES,
    OURS,
    JointKinds,
    Labels,
    Mean,
    Posture,
    RecordingLog,
    SampleWindow,
    dataset_of,
    write_dataset,
)
from armcal_bench.run_log import Start, opened_journal

Capture = Literal["keys", "still", "images"]
"""When postures are captured: at a command, when the arm has stood for a while, or when an image comes."""
KEYS = "c or Enter captures, u takes the last one back, g NAME or a digit names what is touched, s tells more, q ends"
LOOK = "v looks without keeping"
_MOST_UNSEEN = 20  # Images without a board, and none with one: something is wrong for all of them


@dataclass(frozen=True)
class Message:
    kind: str  # ``captured``, ``refused``, ``undone``, ``disagrees``, ``known``, ...
    sentence: str  # for people
    content: Mapping[str, Any] = field(default_factory=dict)  # for programs; JSON


def _captured(posture: Posture, assessment: Assessment) -> Message:
    where = f" in {posture.place}" if posture.place else ""
    offset, doubt = assessment.newest, assessment.doubts.get(posture.name)
    content: dict[str, Any] = {"posture": posture.as_dict(), "doubtful": doubt is not None}
    if offset is not None:
        content["offset"] = offset.__dict__
    if doubt is not None:
        sentence = f"posture {posture.name}{where} is kept, and in doubt."
    elif assessment.why_not:
        sentence = f"posture {posture.name}{where} is kept; it could not be judged: {assessment.why_not}"
    elif offset is None:
        sentence = f"posture {posture.name}{where} is kept; there is none yet to compare it with."
    else:
        sentence = f"posture {posture.name}{where} is kept and agrees: off by {offset}."
    return Message("captured", sentence, content)


def _doubts_changed(before: Assessment, after: Assessment, postures: Sequence[Posture]) -> list[Message]:
    messages, standing = [], {posture.name: posture for posture in postures}
    for name, offset in after.doubts.items():
        if name not in before.doubts:
            place = standing[name].place
            text = f"did it sit right in {place}, and is that its name?" if place else "was it held as the others were?"
            if standing[name].image:
                text = "did the camera, the board or the arm move, or the focus change?"
            sentence = f"posture {name} disagrees by {offset}: {text}"
            if name == postures[-1].name:
                sentence += " u takes it back."
            messages.append(Message("disagrees", sentence, {"posture": name, "offset": offset.__dict__}))
    for name in before.doubts:
        if name in standing and name not in after.doubts and not after.why_not:
            messages.append(Message("agrees_again", f"posture {name} agrees after all.", {"posture": name}))
    return messages


def _added(after: Assessment, before: Assessment) -> tuple[str, float | None]:
    """What is known now of an instrument (empty: nothing), and the share by which its standard deviations fell."""
    ratios = [sd / before.deviations[name] for name, sd in after.deviations.items() if name in before.deviations]
    fell = 1 - float(np.median(ratios)) if ratios else None
    if not after.accuracy:
        return "", fell
    changed = "" if fell is None else f" (standard deviations {'fell' if fell >= 0 else 'rose'} by {abs(fell):.0%})"
    return f"{' '.join(after.accuracy).rstrip('.')}{changed}", fell


def _advised(after: Assessment, before: Assessment) -> list[Message]:
    messages, (text, fell) = [], _added(after, before)
    if text:
        messages.append(Message("known", f"{text}.", {"accuracy": list(after.accuracy), "fell": fell}))
    if after.next is not None:
        sentence = f"next, if the way is clear: about {after.next.text}"
        sentence += f", {1 - after.next.shrink:.0%} less uncertain." if after.next.shrink < 1 else "."
        messages.append(Message("next", sentence, {"joints": after.next.commands, "shrink": after.next.shrink}))
    return messages


class Recorder:
    def __init__(
        self,
        bench: Bench,
        stream: JointStream,
        capture: Capture,
        folder: Path,
        log: RecordingLog,
        clock: Clock,
        camera: LiveCamera | None = None,
    ) -> None:
        settings = bench.settings.recording
        self._experiment, self._settings = bench.experiment, settings
        self._stream, self.capture, self._folder, self._log, self._clock = stream, capture, folder, log, clock
        self.kinds = JointKinds.of(self._experiment.system.arms)
        self.labels = Labels(self._experiment.system.measurements, settings.groups)
        self._assessor = Assessor(self._experiment, camera)
        self._camera, self._unseen = camera, 0
        self._waiting: deque[tuple[Shot, float]] = deque()
        self._looked_from: Mapping[str, float] = {}
        """Where the arm stood when an image said nothing: not looked from again before it has moved."""
        length = settings.rest if capture == "still" else settings.window
        self._window = SampleWindow(self.kinds, length, settings.spread, settings.sliding_spread, settings.samples)
        self._heard, self._is_silent = clock.now(), False
        self._fault, self._fault_at = "", clock.now()
        self._complaint = ""
        self._assessment = Assessment()
        if log.last is not None:
            self.labels.present.update(log.last.labels)

    def begin(self) -> list[Message]:
        postures = self._log.postures
        if not postures:
            return []
        self._assessment = self._assessor.assessed(postures)
        self._write()
        there = Message("status", f"{len(postures)} postures are there already.", {"postures": len(postures)})
        return [there, *self._known()]

    def take(self, samples: Sequence[JointSample]) -> list[Message]:
        messages: list[Message] = []
        for sample in samples:
            self._fault = self.kinds.fault_of(sample.angles)
            if self._fault:
                self._fault_at = sample.arrived
                self._window.clear()
                continue
            self._window.add(sample)
            if self.capture == "still":
                messages += self._kept_if_elsewhere()
        messages += self._taken_as_they_come()
        if samples and not self._fault:
            self._heard = self._clock.now()  # judging a posture takes a while, in which nobody listens
        is_silent = self._silence() > self._settings.stale
        if is_silent != self._is_silent:
            self._is_silent = is_silent
            heard = Message("heard", "joint readings come again.")
            messages.append(Message("silent", self._silent()) if is_silent else heard)
        return messages

    def _taken_as_they_come(self) -> list[Message]:
        """Postures of images that came by themselves; one waits until enough readings are there."""
        if self._camera is None or not self._camera.gives_shots:
            return []
        self._waiting += [(shot, self._clock.now()) for shot in shots_of(self._camera)]
        messages: list[Message] = []
        while self._waiting:
            shot, came = self._waiting[0]
            mean = self._window.mean()
            if isinstance(mean, str) and self._window.is_filling and self._clock.now() - came < self._settings.stale:
                break
            self._waiting.popleft()
            messages += [_refused(f"{shot.seen}: {mean}")] if isinstance(mean, str) else self._kept(mean, shot)
        return messages

    def command(self, text: str) -> list[Message]:
        word, _, rest = text.strip().partition(" ")
        if word in ("", "c", "v"):
            if self.capture == "images":
                return [_refused("postures are captured when their images come.")]
            if self._fault or self._silence() > self._settings.stale:
                return [_refused(self._silent())]
            mean = self._window.mean()
            if isinstance(mean, str):
                return [_refused(mean)]
            return self._looked(mean) if word == "v" else self._kept(mean)
        if word == "u":
            posture = self._log.undo()
            if posture is None:
                return [_refused("there is no posture to take back.")]
            before = self._assessment
            self._assessment = self._assessor.assessed(self._log.postures)
            self._write()
            messages = [Message("undone", f"posture {posture.name} is taken back.", {"posture": posture.name})]
            return messages + _doubts_changed(before, self._assessment, self._log.postures) + self._known()
        if word == "s":
            return self._status()
        if word == "g" or word.isdecimal():
            fault = self.labels.name(rest if word == "g" else word)
            self._complaint = ""
            shown = self.labels.shown
            return [_refused(fault) if fault else Message("named", f"the arm touches {shown}.", {"name": shown})]
        return [_refused(f"found {text.strip()[:40]!r}: {KEYS}.")]

    def finished(self) -> Message:
        postures, assessment = self._log.postures, self._assessment
        doubts = sorted(assessment.doubts, key=int)
        sentence = f"{len(postures)} postures are recorded"
        sentence += f"; in doubt: {', '.join(doubts)}" if doubts else ""
        content = {"postures": len(postures), "in_doubt": doubts, "images": any(p.image for p in postures)}
        return Message("finished", f"{sentence}.", content)

    def _kept_if_elsewhere(self) -> list[Message]:
        """Capture an arm that has come to rest somewhere else; what hinders that is said once."""
        mean, last = self._window.mean(), self._log.last
        if isinstance(mean, str):
            self._complaint = ""
            return []
        before = [angles for angles in (last and last.angles, self._looked_from) if angles]
        if any(self._apart(mean.angles, angles) < self._settings.moved for angles in before):
            return []
        messages = self._kept(mean)
        if messages[0].kind != "refused":
            return messages
        is_repeated, self._complaint = messages[0].sentence == self._complaint, messages[0].sentence
        return [] if is_repeated else messages

    def _looked(self, mean: Mean) -> list[Message]:
        if self._camera is None:
            return [_refused("there is no camera to look by: give --camera.")]
        shot = shot_of(self._camera)
        if shot.fault:
            return [_refused(shot.fault)]
        posture = self._log.next_posture(mean, self.labels.present, shot.values)
        known = self._assessor.assessed([*self._log.postures, posture])
        text, _ = _added(known, self._assessment)
        return [Message("seen", f"{shot.seen}; with it {text}." if text else f"{shot.seen}.", {"kept": False})]

    def _kept(self, mean: Mean, shot: Shot | None = None) -> list[Message]:
        labels, fault = self.labels.of(mean.labels)
        if fault:
            return [_refused(fault)]
        messages: list[Message] = []
        if self._camera is not None:
            shot = shot or shot_of(self._camera)
            if shot.fault:
                return [self._without_board(mean, shot)]
            messages.append(Message("seen", f"{shot.seen}.", {"kept": True}))
        posture = self._log.next_posture(mean, labels, shot.values if shot else {})
        if shot is not None:
            posture = replace(posture, image=f"{posture.name:0>4}{shot.suffix}")
            write_over({self._folder / IMAGES / posture.image: shot.content})
        self._log.capture(posture)
        self._write()
        postures, before = self._log.postures, self._assessment
        self._assessment = self._assessor.assessed(postures)
        if set(before.doubts) != set(self._assessment.doubts):
            self._write()
        messages += [_captured(posture, self._assessment), *_advised(self._assessment, before)]
        messages += _doubts_changed(before, self._assessment, postures)
        return messages + self._warnings(posture) + self._known()

    def _without_board(self, mean: Mean, shot: Shot) -> Message:
        self._looked_from = mean.angles
        self._unseen += 1
        if self._unseen >= _MOST_UNSEEN and self._log.last is None:
            hint = "Check the board's settings (armcal board writes them), the light and the focus."
            raise InputError(f"found no board in {self._unseen} images; of the last: {shot.fault}", hint=hint)
        return _refused(shot.fault)

    def _status(self) -> list[Message]:
        postures, doubts = self._log.postures, self._assessment.doubts
        by_place = Counter(posture.place for posture in postures)
        listed = ", ".join(f"{count} in {place}" for place, count in by_place.items() if place)
        lines = [f"{len(postures)} postures{f': {listed}' if listed else ''}."]
        lines += [f"posture {name} disagrees by {offset}." for name, offset in doubts.items()]
        lines += [f"the next one touches {self.labels.shown}."] if self.labels.columns else []
        lines += [f"digits: {self.labels.known_labels_text()}."] if self.labels.known else []
        refused = refused_lines_text(refused_by(self._stream))
        lines += [f"{refused}."] if refused else []
        missing = self._assessor.explained(postures)
        content = {"postures": len(postures), "groups": by_place, "name": self.labels.shown}
        content |= {"in_doubt": sorted(doubts, key=int), "missing": list(missing)}
        return [Message("status", "\n".join((*lines, *missing)), content), *self._known()]

    def _warnings(self, posture: Posture) -> list[Message]:
        messages = []
        for other in self._log.postures[:-1]:
            apart = self._apart(posture.angles, other.angles)
            if other.labels == posture.labels and apart < self._settings.alike:
                sentence = f"posture {posture.name} is nearly posture {other.name} again: it adds little that is new."
                messages.append(Message("warning", sentence, {"posture": posture.name, "alike": other.name}))
                break
        experiment = self._experiment
        checked = warn_beyond_limits(dataset_of([posture]), experiment.system.arms, experiment.parameters)
        return messages + [Message("warning", text, {"posture": posture.name}) for text in checked.warnings]

    def _apart(self, one: Mapping[str, float], other: Mapping[str, float]) -> float:
        """The largest difference of a joint (rad); a slide of a metre counts as a radian."""
        return float(np.max([abs(one[channel] - other[channel]) for channel in self.kinds.channels]))

    def _known(self) -> list[Message]:
        known = self._assessment.known
        if known is None:
            return []
        sentence = f"{known.rank} of {known.free} free numbers are determined"
        if known.missing:
            more = len(known.missing) - 1
            sentence += f". Missing: {known.missing[0]}" + (f"; and {more} more, which s lists" if more else "")
        elif known.rank < known.free:
            sentence += f"; {known.free - known.rank} combinations are missing, which s lists"
        if known.vary:
            *others, last = known.vary
            joints = f"{', '.join(others)} and {last}" if others else last
            sentence += f". {joints} would add most: vary {'them' if others else 'it'} more"
        return [Message("known", f"{sentence}.", known.__dict__)]

    def _silence(self) -> float:
        return self._clock.now() - self._heard

    def _silent(self) -> str:
        if self._fault and self._clock.now() - self._fault_at <= self._settings.stale:
            return self._fault
        refused = refused_lines_text(refused_by(self._stream))
        reason = f" ({refused})" if refused else ": is the sender running?"
        return f"no joint readings came for {self._silence():.1f} s{reason}"

    def _write(self) -> None:
        doubts = {name: f"disagrees by {offset}" for name, offset in self._assessment.doubts.items()}
        write_dataset(self._folder, self._experiment, self._log.postures, doubts)


def _refused(why: str) -> Message:
    return Message("refused", why)


_PERIOD_S = 0.02
_SAME = {"joints": "set of joints", "labels": "set of labels"}
"""What a recording that is resumed must have been begun with: entries of the journal's header, and their names."""


def record(
    bench: Bench,
    to: tuple[Path, Start],
    capture: Capture,
    keys: OperatorInput,
    asked_to_end: Callable[[], bool],
    show: Callable[[Message], None],
) -> Message:
    camera = bench.camera()
    channels = JointKinds.of(bench.experiment.system.arms).channels
    columns = Labels(bench.experiment.system.measurements, ()).columns
    header = {"joints": list(channels), "labels": list(columns)}
    stream = bench.joints()
    if camera is not None and camera.gives_shots:
        capture = "images"
    with bench.clock() as clock, closing(stream, *(() if camera is None else (camera,))):
        if camera is not None:
            camera.open(clock, bench.experiment.system.measurements)
            if camera.measurement not in bench.experiment.system.measurements:
                known = ", ".join(bench.experiment.system.measurements)
                refuse(type(camera), f"{camera.measurement!r} as measurement", f"one of {known}")
        contacts_of(bench.experiment, camera)
        stream.open(clock, channels)
        with opened_journal(*to, OURS, header, "recording", _SAME) as journal:
            if camera is not None:
                (to[0] / IMAGES).mkdir(exist_ok=True)
            recorder = Recorder(bench, stream, capture, to[0], RecordingLog(journal), clock, camera)
            for message in _messages(recorder, stream, keys, asked_to_end, clock):
                show(message)
            return recorder.finished()


def _messages(
    recorder: Recorder, stream: JointStream, keys: OperatorInput, asked_to_end: Callable[[], bool], clock: Clock
) -> Iterator[Message]:
    yield from recorder.begin()
    while True:
        has_ended = stream.ended  # before its last samples are taken
        yield from recorder.take(samples_of(stream))
        command = keys.next()  # one a round, so that each finds fresh readings
        if command is not None:
            if command.strip() == END:
                break
            yield from recorder.command(command)
        is_over = has_ended or (keys.ended and recorder.capture == "keys")
        if asked_to_end() or (is_over and command is None):
            break
        clock.sleep(_PERIOD_S)
