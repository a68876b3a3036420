"""A servo calibration from opening the devices to what it leaves behind."""

import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
from armcal.base.arrays import Array
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceIdentity
from armcal.devices.wiring import WiringRecord
from armcal.errors import InputError, Location

from armcal_bench.acquisition.heat import ThermalLimit
from armcal_bench.acquisition.recovery import DeviceLost
from armcal_bench.acquisition.tracker_monitor import MotionGate, StopRequested, TrackerLost, TrackerMonitor, Waits
from armcal_bench.bench import closing
from armcal_bench.hazards import FirstMotion
from armcal_bench.keys import QUIT, OperatorInput
from armcal_bench.measured_frame import FEWEST, FrameMistake, frame_mistake
from armcal_bench.servo.fit import outcome_of
from armcal_bench.servo.record import ANGLE, LEFT_OUT, POSE, Record, begin, check_same, stated_by
from armcal_bench.servo.setup import Mover, ServoDevice, Setup
from armcal_bench.servo.tables import Outcome
from armcal_bench.servo.trial import Move, Verdict, answered, judged, noted, wrapped
from armcal_bench.settling import Settled

_MOST_RESTLESS = 3
_LOOKED_AT_EVERY_S = 1.0
_FAR_GAIN = 8.0
"""Of lengths: in sweeps of one joint after the other a reversed servo resembles a frame with a smaller one."""

ReportProgress = Callable[[str, int, int], None]  # Takes the joint, and how many of its points are done and planned


@dataclass(frozen=True)
class Point:
    """A pulse, and from where it is come to: 1 with rising pulses, -1 with falling ones."""

    joint: str
    counts: int
    came: int


def sweep(mover: Mover, joint: str) -> list[Point]:
    """Rising pulses first, then falling ones, as many of the range as leave room to come from either side."""
    setup = mover.setup
    low, high = setup.ranges[joint]
    margin = setup.settings.approach
    shortest, longest = setup.pulses_of(joint)
    steps = max(round((high - low - 2 * margin) / setup.settings.step), 1)
    at_angles = {mover.counts_at(joint, angle) for angle in np.linspace(low + margin, high - margin, steps + 1)}
    room = mover.approach_counts(joint)
    fits = [
        counts
        for counts in sorted(at_angles)
        if mover.pulse(joint, counts - room) >= shortest and mover.pulse(joint, counts + room) <= longest
    ]
    return [Point(joint, c, 1) for c in fits] + [Point(joint, c, -1) for c in reversed(fits)]


def left(points: Iterable[Point], entries: Iterable[Mapping[str, Any]]) -> list[Point]:
    done = {Point(e["joint"], e["counts"], e["came"]) for e in entries if "counts" in e}
    return [point for point in points if point not in done]


@dataclass
class FrameWatch:
    """Where the target was seen in poses that were commanded, whether the arm stood or not.

    Attributes:
        seen: ``base_T_target`` there, in whatever units and frame the tracker gives it.
    """

    mover: Mover
    expected: list[Array] = field(default_factory=list)  # ``base_T_tool`` of the rigid arm in each pose (4 x 4, m)
    seen: list[Array] = field(default_factory=list)

    def look(self, pose: Mapping[str, float]) -> None:
        """The arm was commanded to this pose (rad by joint); nothing where the target was not seen since."""
        monitor = self.mover.gate.monitor
        if monitor is not None and (stand := monitor.stand()) is not None:
            self.expected.append(self.mover.setup.nominal.tool(pose))
            self.seen.append(stand.base_T_target)

    def mistake(self) -> FrameMistake | None:
        """What is wrong with the tracker's units or handedness; None where nothing is, or too few poses tell."""
        return frame_mistake(np.array(self.expected), np.array(self.seen))


class Restless(StopRequested):
    """Time after time the arm does not come to stand: a servo stalls, or has let go."""


@dataclass
class Automatic:
    """A tracked calibration. What is in the record is not measured again."""

    mover: Mover
    record: Record
    report: ReportProgress

    def __post_init__(self) -> None:
        self._frame, self._first, self._restless = FrameWatch(self.mover), len(self.record.entries), 0

    def run(self) -> None:
        """Measure all that is left; the arm ends in its base pose.

        Raises:
            InputError: the tracker's units are not those expected; the arm is in its base pose.
            StopRequested: it was asked for, and the arm holds; or the tracker stays away, or the arm does not come to
                stand: then it is in its base pose.
            DeviceLost: the device is gone and does not come back.
        """
        mover = self.mover
        sweeps = {joint: sweep(mover, joint) for joint in mover.setup.joints}
        if not any(left(points, self._done) for points in sweeps.values()):
            return
        try:
            mover.persist(mover.to_base)
            mover.guard(mover.setup.base)
            for joint, points in sweeps.items():
                for point in left(points, self._done):
                    mover.persist(partial(self._measure, point))
                    self.report(joint, len(points) - len(left(points, self._done)), len(points))
                mover.persist(mover.to_base)
            mover.guard({})
        except (TrackerLost, Restless, InputError) as stop:
            # Nobody may be there for hours, and it could hold a heavy pose.
            mover.gate = replace(mover.gate, monitor=None)  # it may be what failed
            mover.persist(mover.to_base)
            if isinstance(stop, StopRequested):
                stop.arm = "the arm is commanded to hold its base pose"
            raise

    @property
    def _done(self) -> list[Mapping[str, Any]]:
        """Lines of points that are not to be measured now; what an earlier run left out is tried once more."""
        lines = enumerate(self.record.entries)
        return [line for i, line in lines if i >= self._first or line["kind"] != LEFT_OUT]

    def _settled(self, point: Point) -> Settled | str:
        """Where the tool stands at a point, or why that is not known. Servos that get hot rest in the base pose."""
        mover, thermal_state = self.mover, self.mover.thermal_state
        waits, now, acquisition = mover.gate.waits, mover.clock.now, mover.setup.bench.settings.acquisition

        def check_heat() -> None:
            if mover.gate.has_trouble and thermal_state.must_rest:
                raise ThermalLimit("a servo has to rest before the tracker is back")

        while True:
            if thermal_state.must_rest:
                mover.to_base()
                while (left_s := thermal_state.rest_s) > 0:
                    waits.goes_on("rest", "the servos cool in the base pose", left_s, now())
                    mover.stand(min(left_s, _LOOKED_AT_EVERY_S), mover.gate.resting)
                waits.over("rest", now())
            mover.come_to(point.joint, point.counts, point.came)
            with suppress(ThermalLimit):
                return mover.gate.settled(mover.tick, acquisition.settle.longest, check_heat)

    def _measure(self, point: Point) -> None:
        mover, settled = self.mover, self._settled(point)
        line: dict[str, Any] = {"joint": point.joint, "counts": point.counts, "came": point.came}
        line["at"], line["warmth"] = mover.clock.wall(), mover.thermal_state.by_joint
        line["told"] = mover.angles
        self._check_frame()
        if isinstance(settled, str):
            self.record.append(LEFT_OUT, {**line, "why": settled})
            self._restless += 1
            if self._restless >= _MOST_RESTLESS:
                text = f"{point.joint} did not stop moving {self._restless} times in a row ({settled})"
                raise Restless(f"{text}: does a servo stall, or let go?")
            return
        deviations = [float(d) if np.isfinite(d) else None for d in settled.deviations]
        self.record.append(POSE, {**line, **settled.record, "deviations": deviations, "frames": settled.frames})
        self._restless = 0

    def _check_frame(self) -> None:
        """Refuse other units than expected. A left-handed frame cannot be told from a reversed servo, one by one.

        Raises:
            InputError: they are others. What was measured so far by this run is set aside.
        """
        self._frame.look(self.mover.angles)
        mistake = self._frame.mistake()
        if mistake is None or 1 / _FAR_GAIN < mistake.frame.gain < _FAR_GAIN:
            return
        hint = f"{mistake.mend} Then give another --out."
        if self._first <= 1:
            hint = f"{mistake.mend} Then give the same command: what was measured is kept as "
            hint += f"{self.record.set_aside().name}, and not used."
        raise InputError(f"{mistake.sentence}.", where=Location(str(self.record.path)), hint=hint)


_LOOK_S = 0.1


@dataclass(frozen=True)
class Target:
    """An angle (rad) that a joint is to be put at, coming with rising pulses (1) or falling ones (-1)."""

    joint: str
    angle: float
    came: int

    @property
    def key(self) -> tuple[str, int, int]:
        return (self.joint, round(math.degrees(self.angle) * 100), self.came)


@dataclass
class Guided:
    """A calibration by eye. What is in the record is not asked for again."""

    mover: Mover
    wishes: OperatorInput
    record: Record
    say: Callable[[str], None]

    def run(self) -> None:
        """Ask for all that is left.

        Raises:
            StopRequested: somebody stopped it; the arm holds.
            DeviceError: the device fails.
        """
        targets = self.targets()
        lines = [entry for entry in self.record.entries if "target" in entry]
        done = {Target(line["joint"], line["target"], line["came"]).key for line in lines}
        place = next((i for i, target in enumerate(targets) if target.key not in done), len(targets))
        if place == len(targets):
            return
        self.mover.to_base()
        while place < len(targets):
            if targets[place].key in done:
                place += 1
                continue
            if self._ask(targets[place]) == "back":
                place = max(place - 1, 0)
                done.discard(targets[place].key)
            else:
                done.add(targets[place].key)

    def targets(self) -> list[Target]:
        """Each joint at its knots, as far as its range leaves room to come from aside, once from either side.

        A range without such room is measured in its middle.
        """
        targets = []
        for joint in self.mover.setup.joints:
            low, high = self.mover.setup.ranges[joint]
            margin = min(self.mover.setup.settings.approach, (high - low) / 2)
            knots = np.clip(self.mover.setup.knots_of(joint), low + margin, high - margin)
            targets += [Target(joint, angle, came) for angle in sorted(set(knots.tolist())) for came in (1, -1)]
        return targets

    def _ask(self, target: Target) -> str:
        """One target: the wish that ended it, ``ok``, ``skip`` or ``back``."""
        joint, mover = target.joint, self.mover
        pulse = mover.pulse(joint, self._within(joint, mover.counts_at(joint, target.angle)))
        side = "rising" if target.came > 0 else "falling"
        self.say(f"put {joint} at {math.degrees(target.angle):g} deg, coming with {side} pulses")
        while True:
            counts = self._within(joint, round(pulse / mover.pulse(joint, 1)))
            if mover.came.get(joint) != target.came or target.came * (counts - mover.counts[joint]) < 0:
                aside = counts - target.came * mover.approach_counts(joint)
                mover.go(joint, self._within(joint, aside))  # from the target's side, with the play taken up
            mover.go(joint, counts)
            set_us = 1e6 * mover.pulse(joint, mover.counts[joint])
            self.say(f"  {joint}: {1e6 * pulse:.0f} us asked, {set_us:.1f} us set")
            wish = next_wish(self.wishes, mover)
            line = {"joint": joint, "target": target.angle, "came": target.came, "at": mover.clock.wall()}
            if wish == "ok":
                measured = {"angle": target.angle, "sd": self.mover.setup.settings.guided_sd}
                self.record.append(ANGLE, {**line, "counts": mover.counts[joint], **measured})
            elif wish == "skip":
                self.record.append(LEFT_OUT, {**line, "why": "it was skipped"})
            if wish in ("ok", "skip", "back"):
                return wish
            pulse = self._stepped(joint, pulse, wish)

    def _stepped(self, joint: str, pulse: float, wish: str) -> float:
        """A pulse (s) after a step in microseconds; as it was where the step is none, or leads out of the range."""
        try:
            step = float(wish)
        except ValueError:
            step = math.nan
        if not math.isfinite(step):
            self.say(f"  {wish!r} is not known: say a step in us (+10, -1), ok, skip, back or quit")
            return pulse
        stepped = pulse + 1e-6 * step
        low, high = self.mover.setup.pulses_of(joint)
        if not low <= stepped <= high:
            allowed = f"{1e6 * low:.0f} to {1e6 * high:.0f} us, which bench.servo.pulses and the servo's range allow"
            self.say(f"  {1e6 * stepped:.0f} us is outside {allowed}")
            return pulse
        return stepped

    def _within(self, joint: str, counts: int) -> int:
        low, high = self.mover.setup.pulses_of(joint)
        tick = self.mover.pulse(joint, 1)
        return min(max(counts, math.ceil(low / tick)), math.floor(high / tick))


def next_wish(wishes: OperatorInput, mover: Mover) -> str:
    """What somebody wishes next; the arm holds until then.

    Raises:
        StopRequested: it is the end.
    """
    while True:
        word = wishes.next(_LOOK_S)
        word = word and word.strip().lower()
        if word == QUIT or mover.gate.asked_to_end():
            raise StopRequested("it was asked to stop")
        if word:
            return word
        mover.device.keep_alive()


_AS_IT_IS = "its pulses go on as they are, unless the board brings the arm to its base pose"


@dataclass(frozen=True)
class Conversation:
    """How a calibration speaks with whom it is for.

    Attributes:
        may_energise: whether the arm may be moved; called once before anything moves, with what is
            about to move and what is dangerous in it.
    """

    asked_to_stop: Callable[[], bool]  # whether somebody wants it to hold and end
    may_energise: Callable[[FirstMotion], bool]
    report: ReportProgress  # takes how far a tracked calibration is
    say: Callable[[str], None]  # takes a line, of a guided one
    wishes: Callable[
        [], AbstractContextManager[OperatorInput]
    ]  # what somebody presses or writes, while it is asked for
    waits: Waits = field(default_factory=Waits)  # says what is waited for


def measure(setup: Setup, folder: Path, talk: Conversation, how: str) -> None:
    """Measure all that the record in a folder does not hold yet: ``automatic`` by the tracker, or ``guided``.

    Raises:
        InputError: the folder, the board or the tracker is refused.
        StopRequested: it was stopped before its end; the arm holds, and what was measured is kept.
        DeviceError: the device is gone; what was measured is kept.
    """
    with (
        Record(folder) as record,
        setup.bench.clock() as clock,
        _opened(setup, clock, talk, record) as (mover, identity),
    ):
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
    return outcome_of(record.entries, servos, boards, setup.bench.experiment, setup.bench.arm, setup.settings)


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


def _by_eye(mover: Mover, joint: str, talk: Conversation, wishes: OperatorInput) -> Verdict:
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
