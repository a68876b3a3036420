"""A servo calibration from opening the devices to what it leaves behind."""

from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import cast

from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity
from armcal.devices.wiring import WiringRecord
from armcal.errors import InputError, Location

from armcal_bench.acquisition.recovery import DeviceLost
from armcal_bench.acquisition.tracker_monitor import MotionGate, StopRequested, TrackerMonitor, Waits
from armcal_bench.bench import closing
from armcal_bench.hazards import FirstMotion
from armcal_bench.keys import Wishes
from armcal_bench.measured_frame import FEWEST
from armcal_bench.servo.automatic import Automatic, FrameWatch, ReportProgress
from armcal_bench.servo.guided import Guided, next_wish
from armcal_bench.servo.mover import Mover, ServoDevice
from armcal_bench.servo.outcome import Outcome, outcome_of
from armcal_bench.servo.record import Record, begin, check_same, stated_by
from armcal_bench.servo.setup import Setup
from armcal_bench.servo.trial import Move, Verdict, answered, judged, noted, wrapped

_AS_IT_IS = "its pulses go on as they are, unless the board brings the arm to its base pose"


@dataclass(frozen=True)
class Conversation:
    """How a calibration speaks with whom it is for.

    Attributes:
        asked_to_stop: whether somebody wants it to hold and end.
        may_energise: whether the arm may be moved; called once before anything moves, with what is
            about to move and what is dangerous in it.
        report: takes how far a tracked calibration is.
        say: takes a line, of a guided one.
        wishes: what somebody presses or writes, while it is asked for.
        waits: says what is waited for.
    """

    asked_to_stop: Callable[[], bool]
    may_energise: Callable[[FirstMotion], bool]
    report: ReportProgress
    say: Callable[[str], None]
    wishes: Callable[[], AbstractContextManager[Wishes]]
    waits: Waits = field(default_factory=Waits)


def measure(setup: Setup, folder: Path, talk: Conversation, how: str) -> None:
    """Measure all that the record in a folder does not hold yet: ``automatic`` by the tracker, or ``guided``.

    Raises:
        InputError: the folder, the board or the tracker is refused.
        StopRequested: it was stopped before its end; the arm holds, and what was measured is kept.
        DeviceError: the device is gone; what was measured is kept.
    """
    record = Record(folder)
    with setup.bench.clock() as clock, _opened(setup, clock, talk, record) as (mover, identity):
        if how == "guided":
            begin(setup, record, identity, talk.say)
            with talk.wishes() as wishes:
                Guided(mover, wishes, record, talk.say).run()
            return
        with _monitored(mover):
            _go_on_warm(mover, record)
            begin(setup, record, identity, talk.say)
            Automatic(mover, record, talk.report).run()


def evaluated(setup: Setup, folder: Path) -> Outcome:
    """The tables and oscillators of the record in a folder, from the tables that it was begun with.

    Raises:
        InputError: there is no record, or nothing in it.
    """
    record = Record(folder)
    if record.begun is None:
        raise InputError("it holds nothing measured.", where=Location(str(folder)), hint="Measure first.")
    servos, boards = stated_by(setup, record.begun, setup.joints)
    return outcome_of(record.entries, servos, boards, setup.nominal, setup.settings)


def adapter_of(folder: Path) -> str:
    """The adapter that the record in a folder was measured on; empty if that is not known."""
    return str((Record(folder).begun or {}).get("adapter", ""))


def tried(setup: Setup, talk: Conversation, seen: str) -> list[Verdict]:
    """Move each joint a little, and judge what it did; ``seen`` by the ``tracker`` or by ``somebody``.

    Joints that turned as commanded, and as no other joint did, are written down as checked beside the servo file.

    Raises: as ``measure``.
    """
    record = WiringRecord.of_servo_file(setup.path, setup.file)
    wrap = {joint: wrapped(joint, setup.file.servos[joint].angles, setup.ranges[joint]) for joint in setup.joints}
    away = [verdict for verdict in wrap.values() if verdict is not None]
    if away:  # by such a table no joint can be moved
        noted(record, away, {})
        return away
    with setup.bench.clock() as clock, _opened(setup, clock, talk, None) as (mover, identity):
        if seen == "tracker":
            with _monitored(mover):
                mover.to_base()
                verdicts = _tracked(mover)
        else:
            mover.to_base()
            with talk.wishes() as wishes:
                verdicts = [_by_eye(mover, joint, talk, wishes) for joint in setup.joints]
        noted(record, verdicts, {"adapter": identity.adapter, "by": seen, "at": clock.wall()})
        return verdicts


def park(setup: Setup, talk: Conversation, how: str) -> None:
    """Bring the servos to the base pose, and with ``release`` end their pulses, the tip's first.

    Raises: as ``measure``.
    """
    with setup.bench.clock() as clock, _opened(setup, clock, talk, None, releases=how == "release") as (mover, _):
        mover.to_base()
        mover.guard({})
        if how == "release":
            mover.release()


@contextmanager
def _opened(
    setup: Setup, clock: Clock, talk: Conversation, record: Record | None, *, releases: bool = False
) -> Iterator[tuple[Mover, DeviceIdentity]]:
    device = cast(ServoDevice, setup.bench.device())
    servos = {joint: setup.table_of(joint) for joint in setup.base}
    if record is not None and record.is_measured:
        stated, _ = stated_by(setup, record.entries[0], tuple(setup.base))
        servos = {servo.joint: (servo.table, servos[servo.joint][1]) for servo in stated}
    lost = setup.bench.settings.acquisition.lost
    mover = Mover(setup, device, servos, MotionGate(None, clock, lost, talk.asked_to_stop, talk.waits))
    with closing(device), _held(mover):
        identity = mover.open()
        if record is not None and record.is_measured:
            check_same(setup, record, identity)
        start = setup.judge.first_motion(mover.angles, {}, releases=releases)
        if (start.free or start.hazards) and not talk.may_energise(start):
            raise InputError("the arm may not be moved; nothing was moved.", hint="Say yes, or give --yes.")
        yield mover, identity


@contextmanager
def _held(mover: Mover) -> Iterator[None]:
    try:
        yield
    except StopRequested as stop:
        if not mover.hold():
            raise StopRequested(f"{stop}, while the board was lost", _AS_IT_IS) from stop
        raise
    except DeviceLost as loss:
        if loss.fault is None:
            raise StopRequested(str(loss), _AS_IT_IS) from loss
        raise loss.fault from loss


@contextmanager
def _monitored(mover: Mover) -> Iterator[None]:
    gate, monitor = mover.gate, TrackerMonitor(mover.setup.bench, mover.clock)
    with closing(monitor):
        monitor.open()
        mover.gate = replace(gate, monitor=monitor)
        hint = "Start it, check its address and the names of its bodies; or calibrate with --guided."
        try:
            monitor.await_first_frame(lambda: mover.tick(mover.gate.resting), hint)
            yield
        finally:
            mover.gate = gate


def _go_on_warm(mover: Mover, record: Record) -> None:
    """From where the record's last line left the servos' warmth, where they may have to rest; else from cold on.

    Raises:
        InputError: one would not cool where it is to rest.
    """
    if joint := mover.thermal_state.too_heavy_at_rest:
        text = f"the servo of {joint} would not cool in the base pose, by bench.acquisition.heat; nothing was moved."
        raise InputError(text, hint="Give bench.servo.base a pose in which it carries less.")
    last = next((entry for entry in reversed(record.entries) if "warmth" in entry), None)
    if last is not None:
        mover.thermal_state.go_on(last["warmth"], mover.angles, mover.clock.wall() - float(last["at"]))


def _tracked(mover: Mover) -> list[Verdict]:
    setup, base, moves, unseen, frame = mover.setup, mover.angles, [], [], FrameWatch(mover)
    longest = setup.bench.settings.acquisition.settle.longest
    for joint in setup.joints:
        turn, at = _small_turn(setup, joint), mover.counts[joint]
        before = mover.gate.settled(mover.tick, longest)
        frame.look(base)
        mover.go(joint, mover.counts_at(joint, setup.base[joint] + turn))
        after = mover.gate.settled(mover.tick, longest)
        frame.look({**base, joint: base[joint] + turn})
        mover.go(joint, at)
        if isinstance(before, str) or isinstance(after, str):
            why = before if isinstance(before, str) else after
            unseen.append(Verdict(joint, "unclear", f"{joint}: it was not seen to stand ({why})."))
        else:
            moves.append(Move(joint, turn, before.base_T_target, after.base_T_target))
        _check_frame(frame, ())
    verdicts = [*judged(moves, base, setup.nominal), *unseen]
    _check_frame(frame, verdicts)
    return verdicts


def _check_frame(frame: FrameWatch, verdicts: Sequence[Verdict]) -> None:
    """Refuse other units than expected, or a left-handed frame, which reversed servos resemble.

    Raises:
        InputError: it is one, and not every joint turned as commanded.
    """
    if len(frame.seen) < 2 * FEWEST or (verdicts and all(verdict.kind == "right" for verdict in verdicts)):
        return
    mistake = frame.mistake()
    if mistake is None or (mistake.frame.is_mirrored and not verdicts):
        return
    other = "Or servos of several joints are reversed: look which way each turns." if mistake.frame.is_mirrored else ""
    raise InputError(f"{mistake.sentence}.", hint=f"{mistake.mend} {other}".rstrip())


def _by_eye(mover: Mover, joint: str, talk: Conversation, wishes: Wishes) -> Verdict:
    turn, at = _small_turn(mover.setup, joint), mover.counts[joint]
    mover.go(joint, mover.counts_at(joint, mover.setup.base[joint] + turn))

    def ask(question: str) -> str:
        talk.say(question)
        return next_wish(wishes, mover)

    verdict = answered(joint, turn, ask)
    mover.go(joint, at)
    return verdict


def _small_turn(setup: Setup, joint: str) -> float:
    """Away from the base pose (rad), to the side where the joint's range has room for it."""
    low, high = setup.ranges[joint]
    at, size = setup.base[joint], setup.settings.check
    return size if high - at >= size or high - at >= at - low else -size
