"""A servo calibration from opening the devices to what it leaves behind: tracked, guided, or a check of the wiring."""

import math
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from armcal.devices.clock import Clock
from armcal.devices.device import DeviceError, DeviceRefusedError, open_device, state_of
from armcal.devices.wiring import WiringRecord
from armcal.errors import InputError, Location

from armcal_bench.bench import closing
from armcal_bench.drive import Drive
from armcal_bench.hazards import COOLED_TO
from armcal_bench.joint_check import Verdict, check_ended, noted, turned_a_little
from armcal_bench.keys import QUIT, OperatorInput
from armcal_bench.run_log import Log
from armcal_bench.servo_fit import Outcome, outcome_of
from armcal_bench.servo_setup import (
    ANGLE,
    LEFT_OUT,
    KnownServo,
    PulsedJoints,
    Record,
    Setup,
    SweepLog,
    begin,
    check_same,
    pose_name,
    stated_by,
)
from armcal_bench.session import Conversation, drive_poses
from armcal_bench.tracker_monitor import Evidence, FrameMistake, MotionGate, StopRequested

_FAR_GAIN = 8.0
"""Of lengths: in sweeps of one joint after the other a reversed servo resembles a frame with a smaller one."""
_LOOK_S = 0.1
_AS_IT_IS = "its pulses go on as they are, unless the board brings the arm to its base pose"


def measure(setup: Setup, folder: Path, talk: Conversation, how: str) -> None:
    """Measure all that the record in a folder does not hold yet: ``automatic`` by the tracker, or ``guided``."""
    with Record(folder) as record, setup.bench.clock() as clock:
        servos = {} if record.begun is None else stated_by(setup, record.begun)
        if how == "guided":
            targets = targets_of(setup)
            if done_in(record).issuperset(target.key for target in targets):
                return
            device = PulsedJoints(setup, servos)
            with _directed(setup, device, clock, talk, record) as (drive, gate), talk.operator() as operator:
                Guided(setup, device, drive, gate, operator, record, talk.say).run(targets)
        else:
            _tracked(setup, clock, talk, servos, record)


def evaluated(setup: Setup, folder: Path) -> Outcome:
    record = Record(folder)
    if record.begun is None:
        raise InputError("it holds nothing measured.", where=Location(str(folder)), hint="Measure first.")
    stated = stated_by(setup, record.begun)
    servos = [stated[joint] for joint in setup.joints]
    return outcome_of(record.entries, servos, setup.bench.experiment, setup.bench.arm, setup.settings)


def sweep(setup: Setup, device: PulsedJoints, joint: str) -> list[tuple[int, int]]:
    """Counts of a sweep with room to come from either side, rising first, and the sign of the pulses' change."""
    low, high = setup.ranges[joint]
    margin = setup.settings.approach
    shortest, longest = setup.pulses_of(joint)
    steps = max(round((high - low - 2 * margin) / setup.settings.step), 1)
    at_angles = {device.counts(joint, angle) for angle in np.linspace(low + margin, high - margin, steps + 1)}
    room = device.turn_counts(joint, margin)
    fits = [
        counts
        for counts in sorted(at_angles)
        if device.pulse(joint, counts - room) >= shortest and device.pulse(joint, counts + room) <= longest
    ]
    return [(counts, 1) for counts in fits] + [(counts, -1) for counts in reversed(fits)]


def _tracked(setup: Setup, clock: Clock, talk: Conversation, servos: Mapping[str, KnownServo], record: Record) -> None:
    device = PulsedJoints(setup, servos)
    poses, sides = dict[str, dict[str, float]](), dict[str, dict[str, int]]()
    for joint in setup.joints:
        for counts, came in sweep(setup, device, joint):
            name = pose_name(joint, counts, came)
            poses[name] = {joint: device.angle(joint, counts)}
            sides[name] = {joint: came if device.rises(joint) else -came}
    log, first = SweepLog(record), len(record.entries)

    def is_tolerated(mistake: FrameMistake) -> bool:
        """A left-handed frame cannot be distinguished from reversed servos, one by one."""
        return 1 / _FAR_GAIN < mistake.frame.gain < _FAR_GAIN

    if set(poses) <= set(log.progress.measured):
        with closing(device):
            check_same(setup, record, open_device(device, clock))
        return
    prepared = setup.run(device, poses, sides)
    model = prepared.scheduler.model
    if (hot := model.too_hot_for_ever(model.torques(prepared.scheduler.park), COOLED_TO)) is not None:
        named = f"the servo of {device.joint_names[hot]} would not cool in the base pose, by bench.acquisition.heat"
        hint = "Give bench.servo.base a pose in which it carries less."
        raise InputError(f"{named}; nothing was moved.", hint=hint)
    evidence = Evidence(prepared.arrival, is_tolerated, restless_ends=True)
    same, starts = partial(check_same, setup, record), partial(begin, setup, record)
    ending, _ = drive_poses(prepared, talk, log, clock, evidence, same, starts)
    if ending.how == "refused":
        hint = "Correct that. Then give another --out."
        if first <= 1:
            kept = record.set_aside().name
            hint = f"Correct that. Then give the same command: what was measured is kept as {kept}, and not used."
        raise InputError(f"{ending.sentence}.", where=Location(str(record.path)), hint=hint)
    check_ended(ending, log.progress, len(poses))


@contextmanager
def _directed(
    setup: Setup,
    device: PulsedJoints,
    clock: Clock,
    talk: Conversation,
    record: Record | None = None,
    releases: bool = False,
) -> Iterator[tuple[Drive, MotionGate]]:
    """An arm that somebody moves joint by joint, in its base pose; it holds when it is stopped."""
    prepared, settings = setup.run(device, {"base": {}}), setup.acquisition
    gate = MotionGate(None, clock, settings.lost, talk.asked_to_stop, talk.waits)
    with closing(device):
        identity = open_device(device, clock)
        if record is not None:
            check_same(setup, record, identity)
        start = prepared.judge.first_motion(state_of(device).angles, {}, releases=releases)
        if (start.free or start.hazards) and not talk.may_energise(start):
            raise InputError("the arm may not be moved; nothing was moved.", hint="Say yes, or give --yes.")
        if record is not None:
            begin(setup, record, identity)
        scheduler = prepared.scheduler
        drive = Drive(device, clock, scheduler.planner, settings, scheduler.model, Log())
        try:
            drive.energise({})
            path = drive.path_home(drive.at)
            if path is None:
                hint = "Bring it nearer by armcal servo --guided, or release it and put it there by hand."
                raise DeviceRefusedError("no way to the base pose is clear from where the arm stands.", hint=hint)
            drive.go(path, gate.resting)
            yield drive, gate
        except StopRequested as stop:
            try:
                drive.hold()
            except DeviceError:
                raise StopRequested(f"{stop}, while the board was lost", _AS_IT_IS) from stop
            raise


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

    setup: Setup
    device: PulsedJoints
    drive: Drive
    gate: MotionGate
    operator: OperatorInput
    record: Record
    say: Callable[[str], None]

    def run(self, targets: list[Target]) -> None:
        done, place = done_in(self.record), 0
        while place < len(targets):
            if targets[place].key in done:
                place += 1
            elif self._ask(targets[place]) == "back":
                place = max(place - 1, 0)
                done.discard(targets[place].key)
            else:
                done.add(targets[place].key)

    def _ask(self, target: Target) -> str:
        """One target: the word that ended it, ``ok``, ``skip`` or ``back``."""
        joint, device = target.joint, self.device
        pulse = device.pulse(joint, self._within(joint, device.counts(joint, target.angle)))
        side = "rising" if target.came > 0 else "falling"
        room = device.turn_counts(joint, self.setup.settings.approach)
        self.say(f"put {joint} at {math.degrees(target.angle):g} deg, coming with {side} pulses")
        while True:
            counts = self._within(joint, round(pulse / device.pulse(joint, 1)))
            self._come_to(joint, counts, target.came, self._within(joint, counts - target.came * room))
            set_to = device.counts(joint, self.drive.angles[joint])
            self.say(f"  {joint}: {1e6 * pulse:.0f} us asked, {1e6 * device.pulse(joint, set_to):.1f} us set")
            word = self._next_word()
            line = {"joint": joint, "target": target.angle, "came": target.came, "at": self.drive.clock.wall()}
            if word == "ok":
                measured = {"angle": target.angle, "sd": self.setup.settings.guided_sd}
                self.record.append(ANGLE, {**line, "counts": set_to, **measured})
            elif word == "skip":
                self.record.append(LEFT_OUT, {**line, "why": "it was skipped"})
            if word in ("ok", "skip", "back"):
                return word
            pulse = self._stepped(joint, pulse, word)

    def _come_to(self, joint: str, counts: int, came: int, aside: int) -> None:
        """With rising pulses (1) or falling ones (-1), and the play taken up from the counts ``aside``."""
        drive, device, i = self.drive, self.device, self.drive.joints.index(joint)
        side = int(drive.approach[i]) * (1 if device.rises(joint) else -1)  # from where it came last; 0 not known
        is_past = came * (counts - device.counts(joint, drive.angles[joint])) < 0
        for at in (aside, counts) if side != came or is_past else (counts,):
            goal = drive.at.copy()
            goal[i] = device.angle(joint, at)
            drive.go((drive.at, goal), self.gate.resting)

    def _next_word(self) -> str:
        while True:
            word = self.operator.next(_LOOK_S)
            word = word and word.strip().lower()
            if word == QUIT or self.gate.asked_to_end():
                raise StopRequested("it was asked to stop")
            if word:
                return word
            self.drive.keep_alive()

    def _stepped(self, joint: str, pulse: float, word: str) -> float:
        """A pulse (s) after a step in microseconds; as it was where the step is none, or leads out of the range."""
        try:
            step = float(word)
        except ValueError:
            step = math.nan
        if not math.isfinite(step):
            self.say(f"  {word!r} is not known: say a step in us (+10, -1), ok, skip, back or quit")
            return pulse
        stepped = pulse + 1e-6 * step
        low, high = self.setup.pulses_of(joint)
        if not low <= stepped <= high:
            allowed = f"{1e6 * low:.0f} to {1e6 * high:.0f} us, which bench.servo.pulses and the servo's range allow"
            self.say(f"  {1e6 * stepped:.0f} us is outside {allowed}")
            return pulse
        return stepped

    def _within(self, joint: str, counts: int) -> int:
        low, high = self.setup.pulses_of(joint)
        tick = self.device.pulse(joint, 1)
        return min(max(counts, math.ceil(low / tick)), math.floor(high / tick))


def targets_of(setup: Setup) -> list[Target]:
    """Each joint at its knots, from either side, as far as its range leaves room for that; else in its middle."""
    targets = []
    for joint in setup.joints:
        low, high = setup.ranges[joint]
        margin = min(setup.settings.approach, (high - low) / 2)
        knots = np.clip(setup.knots_of(joint), low + margin, high - margin)
        targets += [Target(joint, angle, came) for angle in sorted(set(knots.tolist())) for came in (1, -1)]
    return targets


def done_in(record: Record) -> set[tuple[str, int, int]]:
    lines = [entry for entry in record.entries if "target" in entry]
    return {Target(line["joint"], line["target"], line["came"]).key for line in lines}


def tried(setup: Setup, talk: Conversation) -> list[Verdict]:
    """Move each joint a little, judge by the tracker what it did, and note which are checked."""
    record = WiringRecord.of_servo_file(setup.path, setup.file)
    turns: dict[str, float] = {}
    for joint in setup.joints:
        (low, high), at, size = setup.ranges[joint], setup.base[joint], setup.settings.check
        turns[joint] = size if high - at >= size or high - at >= at - low else -size  # to where it has room
    with setup.bench.clock() as clock:
        device = PulsedJoints(setup)
        turned = turned_a_little(lambda poses: setup.run(device, poses), setup.base, turns, talk, clock)
        verdicts = turned.judged(setup.base, setup.nominal)
        noted(record, verdicts, {"adapter": turned.identity.adapter, "by": "tracker", "at": clock.wall()})
    return verdicts


def park(setup: Setup, talk: Conversation, how: str) -> None:
    device, releases = PulsedJoints(setup), how == "release"
    with setup.bench.clock() as clock, _directed(setup, device, clock, talk, releases=releases) as (drive, _):
        drive.hold()
        if releases:
            drive.release()
