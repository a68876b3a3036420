"""A recording from opening the stream to its end."""

from collections.abc import Callable, Iterator
from pathlib import Path

from armcal.devices.clock import Clock
from armcal.devices.live import JointStream, LiveCamera, RestStream, samples_of
from armcal.errors import ConfigError
from armcal.plugins import refuse

from armcal_bench.bench import SECTION, Bench, closing
from armcal_bench.journal_folder import Start, opened_journal
from armcal_bench.keys import END, OperatorInput
from armcal_bench.recording.agreement import contacts_of
from armcal_bench.recording.labels import Labels
from armcal_bench.recording.recorder import Capture, Message, Recorder
from armcal_bench.recording.recording_log import IMAGES, OURS, RecordingLog
from armcal_bench.recording.window import JointKinds

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
    """Record until somebody ends it, or the stream ends; how it ended.

    Args:
        bench: what is recorded.
        to: where everything of it is kept, and ``anew``, or ``resume`` what is there.
        capture: what makes a posture be captured; a camera that gives images by itself goes before it.
        keys: what a person types.
        asked_to_end: whether somebody wants it to end.
        show: called with every message.

    Raises:
        InputError: the configuration, the folder or the stream is refused.
        ArmcalError: the journal cannot be written; all postures that were said to be kept are.
    """
    camera = bench.camera()
    channels = JointKinds.of(bench.experiment.system.arms).channels
    columns = Labels(bench.experiment.system.measurements, ()).columns
    header = {"joints": list(channels), "labels": list(columns)}
    stream = bench.joints()
    capture = _capture(bench, capture, stream, camera)
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


def _capture(bench: Bench, chosen: Capture, stream: JointStream, camera: LiveCamera | None) -> Capture:
    """A camera that gives images by itself says when, and so does a stream of rests."""
    if camera is not None and camera.gives_shots:
        chosen = "images"
    if not (isinstance(stream, RestStream) and stream.gives_rests):
        return chosen
    if chosen in ("keys", "images") or camera is not None:
        raise ConfigError(
            "the stream gives a sample only when a rest is over, so no key can capture one, and no image is of it.",
            where=bench.experiment.source.where((SECTION, "joints", "still")),
            hint="Give --capture still, or leave still out.",
        )
    return "rests"


def _messages(
    recorder: Recorder, stream: JointStream, keys: OperatorInput, asked_to_end: Callable[[], bool], clock: Clock
) -> Iterator[Message]:
    """All that happens, as it does, until somebody ends it or the stream ends."""
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
    if isinstance(stream, RestStream) and stream.gives_rests:
        yield from recorder.take(samples_of(stream, "lasting"))
