"""What a data set says of leader and follower, or two data sets of two arms: named faults, and mm at the gripper."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from armcal.arm.horn import teeth_text
from armcal.base.arrays import Array
from scipy.stats import t as student

from armcal_lerobot.gripper import Cost, Gripper
from armcal_lerobot.motion import Motion
from armcal_lerobot.motors import teeth_of
from armcal_lerobot.tracking import SLOW_A_SECOND, Figure, Torque, Tracking, delayed

_FEWEST_STARTS = 3
_SAME_GAIN = 0.03
_STEADY_START = 5.0
_MOST_POSES = 5000


@dataclass(frozen=True)
class Shift:
    """How far the second data set's episodes begin from the first's, of one motor; ``doubt`` where that says little."""

    motor: str
    unit: str
    start: Figure | None
    doubt: str = ""


def gravity_of(gripper: Gripper, motors: Sequence[str]) -> Torque | None:
    """Gravity about the joint of each motor, in the motor's sense; None for an arm without masses."""
    if not gripper.has_masses:
        return None
    places = {gripper.motor_of(joint)[0]: (i, gripper.motor_of(joint)[1]) for i, joint in enumerate(gripper.joints)}

    def torque(commands: Array) -> Array:
        efforts = gripper.efforts(gripper.angles({name: commands[:, i] for i, name in enumerate(motors)}))
        columns = np.full(commands.shape, np.nan)
        for column, name in enumerate(motors):
            if name in places:
                columns[:, column] = places[name][1] * efforts[places[name][0]]
        return columns

    return torque


def gripper_error(motion: Motion, trackings: Sequence[Tracking], gripper: Gripper) -> tuple[Cost | None, Cost]:
    """How far the gripper is from where it was commanded: at rest (None if it never rests), and of all frames.

    At rest the command is taken as late as the motors follow it.
    """
    delays = [t.delay_s.value for t in trackings if t.delay_s]
    frames = float(np.median(delays)) * motion.fps if delays else 0.0
    moving, rest = [], []
    for stretch in motion.stretches:
        command, state = (_poses(gripper, motion, part) for part in (stretch.commanded, stretch.reached))
        moving.append(np.linalg.norm(gripper.positions(command) - gripper.positions(state), axis=0))
        late = np.apply_along_axis(delayed, 0, stretch.commanded, frames)
        speed = np.abs(np.gradient(late, axis=0)).max(axis=1) * motion.fps
        slow = np.isfinite(speed) & (speed < SLOW_A_SECOND)
        if slow.any():
            held = _poses(gripper, motion, late[slow])
            rest.append(np.linalg.norm(gripper.positions(held) - gripper.positions(state[:, slow]), axis=0))
    return Cost.of(np.concatenate(rest)) if rest else None, Cost.of(np.concatenate(moving))


def poses_of(motion: Motion, gripper: Gripper) -> Array:
    """Joint angles (n x N; rad) that a data set's states have, at most 5000."""
    degrees = motion.reached_degrees()
    step = max(1, motion.frames // _MOST_POSES)
    return gripper.angles({name: values[::step] for name, values in degrees.items()})


def shifts(one: Motion, two: Motion) -> tuple[Shift, ...]:
    """How far apart the episodes of two data sets begin, by motor of the first; arms rest where they are put."""
    made = []
    for index, motor in enumerate(one.motors):
        first, second = one.starts[:, index], two.starts[:, two.motors.index(motor)]
        if min(len(first), len(second)) < _FEWEST_STARTS:
            made.append(Shift(motor, one.units[index], None, f"fewer than {_FEWEST_STARTS} episodes in one of them"))
            continue
        spreads = [float(np.std(starts, ddof=1)) for starts in (first, second)]
        error = np.hypot(*(s / np.sqrt(len(v)) for s, v in zip(spreads, (first, second), strict=True)))
        half = float(student.ppf(0.975, min(len(first), len(second)) - 1) * error)
        apart = float(second.mean() - first.mean())
        doubt = "episodes begin at different poses" if max(spreads) > _STEADY_START else ""
        made.append(Shift(motor, one.units[index], Figure(apart, apart - half, apart + half), doubt))
    return tuple(made)


def copy_findings(motion: Motion) -> list[str]:
    """Whether states are a copy of the commands, of the same frame or of the one before: then nothing was measured."""
    moves = any(np.ptp(stretch.reached, axis=0).any() for stretch in motion.stretches)
    for late, frame in enumerate(("same frame", "frame before")):
        pairs = ((s.commanded[: len(s.commanded) - late], s.reached[late:]) for s in motion.stretches)
        if moves and all(np.array_equal(*pair) for pair in pairs):
            return [
                f"Every state is the command of the {frame}: one was copied from the other, and not measured. What "
                "follows says nothing about the arm."
            ]
    return []


def findings_of(trackings: Sequence[Tracking]) -> list[str]:
    """What is wrong between command and state, a sentence each."""
    known = [t for t in trackings if t.delay_s]
    early = [t for t in known if t.delay_s and t.delay_s.high < 0]
    texts = []
    if early and 2 * len(early) > len(known):
        ahead = float(np.median([-t.delay_s.value for t in early if t.delay_s]))
        texts.append(
            f"Leader and follower are exchanged: the commands follow the states, by {1000 * ahead:.0f} ms, in "
            f"{len(early)} of {len(known)} motors. action should be the leader's joints, observation.state the "
            "follower's."
        )
    for t in trackings:
        if t.gain and t.gain.high < 0:
            texts.append(f"{t.motor} is inverted: its state moves {t.gain.value:+.2f} times as far as its command.")
            continue
        if t.gain and (t.gain.low > 1 + _SAME_GAIN or t.gain.high < 1 - _SAME_GAIN):
            texts.append(
                f"{t.motor} moves {t.gain.value:.3f} times as far as commanded: ranges that differ between leader and "
                "follower, or something that stops it."
            )
        if t.offset and t.unit == "deg" and (teeth := teeth_of(t.offset.value)):
            off = f"{t.offset.value:+.1f} deg from its command"
            texts.append(f"{t.motor} stands {off}: {teeth_text(teeth)} would explain that.")
    return texts


def shift_findings(moved: Sequence[Shift], one: Motion, two: Motion) -> list[str]:
    """What the shifts say, a sentence each."""
    texts = []
    for shift in moved:
        if shift.start is None or shift.doubt or not (shift.start.low > 0 or shift.start.high < 0):
            continue
        apart = shift.start.value
        first, second = (float(m.starts[:, m.motors.index(shift.motor)].mean()) for m in (one, two))
        teeth = teeth_of(apart) if shift.unit == "deg" else 0
        if abs(first + second) < abs(apart) / 5 and abs(first) > 10:
            texts.append(f"{shift.motor} is inverted in one of them: it begins at {first:+.1f} and {second:+.1f}.")
        elif teeth:
            texts.append(f"{shift.motor} begins {apart:+.1f} deg elsewhere: {teeth_text(teeth)} would explain that.")
        elif abs(apart) > 1.0:
            texts.append(
                f"{shift.motor} begins {apart:+.1f} {shift.unit} elsewhere: its zero differs, or where it was put."
            )
    return texts


def costs_at(gripper: Gripper, angles: Array, figures: Mapping[str, float]) -> dict[str, float]:
    """Median mm at the gripper of angles (deg) by motor, over poses (n x N; rad)."""
    each_degree = {gripper.motor_of(joint)[0]: cost for joint, cost in gripper.per_degree(angles).items()}
    return {name: abs(value) * each_degree[name].typical_mm for name, value in figures.items() if name in each_degree}


def _poses(gripper: Gripper, motion: Motion, values: Array) -> Array:
    return gripper.angles({name: values[:, i] for i, name in enumerate(motion.motors)})
