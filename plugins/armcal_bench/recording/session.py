"""A recording from opening the stream to its end."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from armcal.devices.joint_stream import JointStream
from armcal.devices.line_source import refused_lines_text
from armcal.devices.rest_stream import RestStream
from armcal.errors import ConfigError

from armcal_bench.bench import SECTION, Bench
from armcal_bench.recording.assessor import contacts_of
from armcal_bench.recording.keys import END, Keys
from armcal_bench.recording.labels import Labels
from armcal_bench.recording.messages import Message
from armcal_bench.recording.recorder import Capture, Recorder, Task
from armcal_bench.recording.recording_log import Start, opened_recording_log
from armcal_bench.recording.window import JointKinds

_PERIOD_S = 0.02


@dataclass(frozen=True)
class RecordingOptions:
    """What a recording is told, and whom it tells.

    Attributes:
        folder: where everything of it is kept.
        start: ``anew``, or ``resume`` what is there.
        asked: what makes a posture be captured.
        keys: what a person types.
        asked_to_end: whether somebody wants it to end.
        tell: called with everything that there is to say.
    """

    folder: Path
    start: Start
    asked: Capture
    keys: Keys
    asked_to_end: Callable[[], bool]
    tell: Callable[[Message], None]


def record(bench: Bench, options: RecordingOptions) -> Message:
    """Record until somebody ends it, or the stream ends; how it ended.

    Raises:
        InputError: the configuration, the folder or the stream is refused.
        ArmcalError: the journal cannot be written; all that was told to be kept is.
    """
    experiment = bench.experiment
    contacts_of(experiment)
    kinds = JointKinds.of(experiment.system.arms)
    columns = Labels(experiment.system.measurements, ()).columns
    stream = bench.joints()
    capture = _capture(bench, stream, options.asked)
    with bench.clock() as clock:
        try:
            stream.open(clock, kinds.channels)
            with opened_recording_log(options.folder, options.start, kinds.channels, columns) as log:
                task = Task(
                    experiment,
                    bench.settings.recording,
                    capture,
                    options.folder,
                    lambda: refused_lines_text(stream.refused),
                )
                recorder = Recorder(task, log, clock)
                _tell(options, recorder.begin())
                typed: deque[str] = deque()
                while _goes_on(options, recorder, stream, typed):
                    clock.sleep(_PERIOD_S)
                _tell(options, _rest(recorder, stream))
                return recorder.finished()
        finally:
            stream.close()


def _capture(bench: Bench, stream: JointStream, asked: Capture) -> Capture:
    """A stream that gives rests is captured rest by rest, and not otherwise."""
    if not (isinstance(stream, RestStream) and stream.gives_rests):
        return asked
    if asked == "keys":
        raise ConfigError(
            "the stream gives a sample only when a rest is over, so no key can capture one.",
            where=bench.experiment.source.where((SECTION, "joints", "still")),
            hint="Give --capture still, or leave still out.",
        )
    return "rests"


def _goes_on(options: RecordingOptions, recorder: Recorder, stream: JointStream, typed: deque[str]) -> bool:
    """One round; whether there is to be another."""
    has_ended = stream.ended  # before its last samples are taken
    _tell(options, recorder.take(stream.samples()))
    typed.extend(options.keys.commands())
    if typed:  # one a round, so that each finds fresh readings
        command = typed.popleft()
        if command.strip() == END:
            return False
        _tell(options, recorder.command(command))
    is_unattended = options.keys.ended and options.asked == "keys"
    return not options.asked_to_end() and (bool(typed) or not (has_ended or is_unattended))


def _rest(recorder: Recorder, stream: JointStream) -> list[Message]:
    """What came to rest last."""
    if isinstance(stream, RestStream) and stream.gives_rests:
        return recorder.take(stream.lasting())
    return []


def _tell(options: RecordingOptions, messages: list[Message]) -> None:
    for each in messages:
        options.tell(each)
