"""What residuals might still depend on: order, joint levels, approach, torques, payload, temperature.

Each dependence is a set of columns: how residuals would move with it, to first order, along the motion of one joint,
along the residual's own entries (base axes for a position), or along the turning of one site.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from numpy.polynomial import legendre

from armcal.arm.assembly import Arm, shown_joint
from armcal.arm.effects import joint_rate
from armcal.arm.loading import SiteLoads
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.base.units import display_unit, to_unit
from armcal.diagnose.held import Moves
from armcal.estimate.freeing import candidates
from armcal.problem.motion import Motion, recorded_order
from armcal.problem.problem import Problem

MOST_LEVELS = 12
"""Levels of a joint are separated one by one up to so many; beyond, by a cubic."""
_SLOW = 3
_CUBIC = 3
_AXES = ("x", "y", "z")
_SYMMETRIC = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
_BOTH_SIDES = "visit the same poses from both sides of {joint}"
_SECOND_LOAD = "repeat some poses with a second payload"
_REPEATS = "repeat one pose at the start, in the middle and at the end"

_SURROUNDINGS = (
    ("payload", "the payload", "torsional_spring or compliance; the payload's centre"),
    ("temperature", "the temperature", "thermal_length"),
)


@dataclass(frozen=True)
class Dependence:
    """One thing that residuals might depend on.

    Attributes:
        kind: ``held``, ``order``, ``level``, ``approach``, ``coupling``, ``torque``, ``moment``, ``delay``,
            ``payload``, ``temperature``; of what is outside of the arm ``step``, ``slip``, ``gravity``, ``load``,
            ``scale``.
        subject: the joint or site, as a user names it; empty where it is none.
        arm: the arm's name; empty where it is none.
        words: what residuals depend on, as the end of a sentence.
        effect: the effect that would model it, and on what; empty if there is none.
        measure: which measurement would show it.
        columns: raw residual by coefficient, one (n_r x N x k) array a factor.
        labels: what each coefficient is (k), for those that have a unit.
        unit: of the coefficients in SI (``rad``, ``m``, ``rad_per_Nm``; ``1`` for shares); empty if they have none.
        jumps: whether it is a change at one place of the recording; the same change elsewhere is no other cause.
    """

    kind: str
    subject: str
    arm: str
    words: str
    effect: str
    measure: str
    columns: tuple[Array, ...]
    labels: tuple[str, ...] = ()
    unit: str = ""
    jumps: bool = False


@dataclass(frozen=True)
class Records:
    """Records that dependences are made from."""

    dataset: Dataset
    motion: Motion

    @property
    def sizes(self) -> tuple[int, ...]:
        return tuple(slope.shape[0] for slope in self.motion.slopes)

    def along(self, joint: str, features: Array) -> tuple[Array, ...]:
        """Features (N x k) along the motion of a joint."""
        return tuple(slope[:, :, None] * features[None] for slope in self.motion.along(joint))

    def axes(self, features: Array) -> tuple[Array, ...]:
        """Features (N x k) along each entry of each factor's residual."""
        whole, place, parts = sum(self.sizes) * features.shape[1], 0, []
        for size in self.sizes:
            part = np.zeros((size, len(features), whole))
            for entry in range(size):
                part[entry, :, place : place + features.shape[1]] = features
                place += features.shape[1]
            parts.append(part)
        return tuple(parts)


def dependences(problem: Problem, motion: Motion, dataset: Dataset, moves: Moves) -> Iterator[Dependence]:
    """Everything that these records could show; what does not vary is left out."""
    arms, here = problem.blueprint.arms, Records(dataset, motion)
    yield from _of_held(problem, moves)
    yield from _of_order(here)
    for name, arm in arms.items():
        loads = motion.loads[name]
        for joint, dimension in arm.commanded.items():
            index = arm.joint_names.index(joint)
            shown = shown_joint(f"{name}.{joint}", arms)
            angle = dimension == "angle"
            yield from _of_level(here, name, f"{name}.{joint}", shown, dimension)
            yield from _of_approach(here, name, joint, shown, "rad" if angle else "m")
            yield from _of_coupling(here, name, arm, joint, shown)
            yield from _of_torque(here, name, f"{name}.{joint}", shown, loads.efforts[index], angle)
        yield from _of_moments(problem, here, arm, loads, len(arms) == 1)
        yield from _of_rates(here, arm, arms)
    for channel, words, effect in _SURROUNDINGS:
        if dataset.has(channel) and np.ptp(dataset.column(channel)) > 0:
            feature = dataset.column(channel)
            columns = here.axes((feature - feature.mean())[:, None] / feature.std())
            measure = _SECOND_LOAD if channel == "payload" else "repeat some poses cold and warm"
            yield Dependence(channel, "", "", words, effect, measure, columns)


def _of_held(problem: Problem, moves: Moves) -> Iterator[Dependence]:
    """Parameters that the fit held, as ``armcal identify --fixed`` judges them."""
    for name in filter(moves.__contains__, candidates(problem.parameters)):
        block, columns = problem.parameters[name], moves[name]
        words, measure = f"{name}, which is held", "armcal identify --fixed, which judges it on records held out"
        one = block.domain.dof == 1
        labels, unit = (("off by",), block.unit) if one else ((), "")
        yield Dependence("held", name, "", words, f"free {name} (parameters.free)", measure, columns, labels, unit)


def _of_order(here: Records) -> Iterator[Dependence]:
    order = recorded_order(here.dataset)
    if np.ptp(order) <= 0:
        return
    place = (order - order.min()) / np.ptp(order)
    slow = legendre.legvander(2 * place - 1, _SLOW)  # with its mean, which a drift has
    yield Dependence(
        "order",
        "",
        "",
        "the recorded order: what is measured drifts slowly as a whole",
        "parameters.drift on the base's position",
        _REPEATS,
        here.axes(slow),
    )
    for channel in here.motion.channels:
        arm, _, joint = channel.partition(".")
        words = f"the recorded order: {joint} drifts slowly along its own motion"
        effect = f"parameters.drift on the zero of {joint}"
        yield Dependence("order", joint, arm, words, effect, _REPEATS, here.along(channel, slow))


def _of_level(here: Records, arm: str, channel: str, shown: str, dimension: str) -> Iterator[Dependence]:
    command = here.dataset.column(channel)
    levels = np.unique(np.round(_stated(command), 9))
    if len(levels) < 2:
        return
    unit = display_unit(dimension)
    if len(levels) <= MOST_LEVELS:
        features = _centred((np.abs(command[:, None] - levels[None]) < 1e-8).astype(float), command)
        labels = tuple(f"{to_unit(level, unit.name):.4g} {unit.name}" for level in levels)
        effect = f"servo_map on {shown}" if len(levels) <= _CUBIC else f"gear_error or servo_map on {shown}"
    else:
        middle, half = (levels[0] + levels[-1]) / 2, (levels[-1] - levels[0]) / 2
        features = _centred(legendre.legvander((command - middle) / half, _CUBIC)[:, 1:], command)
        labels, effect = (), f"gear_error or servo_map on {shown}"
    between = f"command {shown} to levels in between, from both sides"
    si = "rad" if dimension == "angle" else "m"
    along = f"the angle of {shown}, along its own motion" if si == "rad" else f"the travel of {shown}, along itself"
    yield Dependence("level", shown, arm, along, effect, between, here.along(channel, features), labels, si)
    yield Dependence(
        "level",
        shown,
        arm,
        f"the {'angle' if si == 'rad' else 'travel'} of {shown}, in directions that {shown} does not move",
        f"more free geometry about {shown}, or compliance there",
        f"repeat some poses with a second payload: what moves is compliance, the rest geometry of {shown}",
        here.axes(features),
    )


def _of_approach(here: Records, arm: str, joint: str, shown: str, si: str) -> Iterator[Dependence]:
    channel, command = f"{arm}.approach.{joint}", here.dataset.column(f"{arm}.{joint}")
    effect, side = f"approach_backlash on {shown}", f"the side {shown} was approached from"
    if here.dataset.has(channel):
        came = here.dataset.column(channel)
    else:
        place = np.argsort(recorded_order(here.dataset), kind="stable")
        moved = np.sign(np.diff(np.nan_to_num(command[place]), prepend=np.nan_to_num(command[place[:1]])))
        came = np.empty(len(command))
        came[place] = moved[np.maximum.accumulate(np.where(moved != 0, np.arange(len(moved)), 0))]
        effect += ", with a column for the approach"
        side += ", if it went from pose to pose in the recorded order"
    if _spread(came) <= 0:
        return
    sign, measure = np.nan_to_num(-came[:, None]), _BOTH_SIDES.format(joint=shown)
    along = here.along(f"{arm}.{joint}", sign)
    yield Dependence(
        "approach", shown, arm, f"{side}, along its own motion", effect, measure, along, ("half of its play",), si
    )
    words = f"{side}, in directions that {shown} does not move"
    yield Dependence("approach", shown, arm, words, "", measure, here.axes(sign))


def _of_coupling(here: Records, name: str, arm: Arm, joint: str, shown: str) -> Iterator[Dependence]:
    for other, dimension in arm.commanded.items():
        command = here.dataset.column(f"{name}.{other}")
        if other == joint or dimension != arm.commanded[joint] or _spread(command) <= 0:
            continue
        feature = _centred(np.nan_to_num(command)[:, None], command)
        words = f"the command of {other}, along {shown}'s own motion: {other} moves {shown} with it"
        measure = f"move {other} alone from end to end, and watch {shown}"
        columns = here.along(f"{name}.{joint}", feature)
        yield Dependence("coupling", f"{other} on {shown}", name, words, "", measure, columns, ("share",), "1")


def _of_torque(
    here: Records, arm: str, channel: str, shown: str, effort: Array, revolute: bool
) -> Iterator[Dependence]:
    if _spread(effort) <= 1e-9 * max(1.0, float(np.abs(_stated(effort)).max(initial=0.0))):
        return
    effort = np.nan_to_num(effort)
    load, per = ("torque about", "rad_per_Nm") if revolute else ("force along", "")
    si, cubic = ("rad", "rad_per_Nm3") if revolute else ("m", "")
    both = f"poses on both sides of zero {load.split()[0]} at {shown}, some with a second payload"
    laws = (
        (f"the {load} {shown}", f"torsional_spring on {shown}", _SECOND_LOAD, effort, "compliance", per),
        (f"the sign of the {load} {shown}", f"torque_backlash on {shown}", both, np.sign(effort), "half its play", si),
        (f"the size of the {load} {shown}, whatever its sign", "", both, np.abs(effort), "slope", per),
        (f"the cube of the {load} {shown}", f"cubic_spring on {shown}", _SECOND_LOAD, effort**3, "cubic term", cubic),
    )
    for words, effect, measure, feature, label, unit in laws:
        if np.ptp(feature) > 0:
            columns = here.along(channel, feature[:, None])
            yield Dependence("torque", shown, arm, words, effect, measure, columns, (label,), unit)


def _of_moments(problem: Problem, here: Records, arm: Arm, loads: SiteLoads, alone: bool) -> Iterator[Dependence]:
    """A symmetric compliance at each site, seen by the factors that measure this arm's tip in its base frame."""
    seen = [
        [channel.rpartition(".")[2] for channel in factor.output_channels] == list(_AXES)
        and tuple(problem.blueprint.measurements[factor.name].arms) == (arm.name,)
        for factor in (kernel.factor for kernel in problem.kernels)
    ]
    if not any(seen):
        return
    for site, (moment, lever) in enumerate(zip(loads.moments, loads.levers, strict=True)):
        moved = []
        for j, k in _SYMMETRIC:
            one = lever[:, j] * moment[k]
            moved.append(one if j == k else one + lever[:, k] * moment[j])
        tip = np.nan_to_num(np.stack(moved, axis=2))
        if not np.any(tip):
            continue
        zeros = (np.zeros((size, tip.shape[1], tip.shape[2])) for size in here.sizes)
        columns = tuple(tip if yes else none for yes, none in zip(seen, zeros, strict=True))
        name = arm.joint_names[site - 1] if site else "the mount"
        shown = name if alone else (f"{arm.name}.{name}" if site else f"the mount of {arm.name}")
        words = f"the moment that {shown} carries, in all directions"
        yield Dependence("moment", shown, arm.name, words, f"compliance on {shown}", _SECOND_LOAD, columns)


def _of_rates(here: Records, arm: Arm, arms: Mapping[str, Arm]) -> Iterator[Dependence]:
    """Joints read before or after the measurement, which moved in between: to first order in that time.

    Beside it the play of all joints at once, which a delay resembles where each moved about as fast, to and fro.
    """
    names = {joint: joint_rate(joint).name for joint in arm.commanded}
    shared = any(not names.keys().isdisjoint(other.commanded) for other in arms.values() if other is not arm)
    if shared or not all(map(here.dataset.has, names.values())):
        return
    rates = {f"{arm.name}.{joint}": np.nan_to_num(here.dataset.column(rate)) for joint, rate in names.items()}
    moved = [here.along(channel, rate[:, None]) for channel, rate in rates.items()]
    columns = tuple(np.sum(parts, axis=0) for parts in zip(*moved, strict=True))
    which = "the joints" if len(arms) == 1 else f"the joints of {arm.name}"
    words = f"how fast {which} moved: they were read at another time than the measurement was made"
    effect = "delay on all joints, or synchronise the clocks of joints and instrument"
    measure = "repeat some poses at rest, where a delay has no effect"
    yield Dependence("delay", "", arm.name, words, effect, measure, columns, ("joints",), "s")
    played = [here.along(channel, -np.sign(rate)[:, None]) for channel, rate in rates.items()]
    columns = tuple(np.concatenate(parts, axis=2) for parts in zip(*played, strict=True))
    words, effect = f"which way {which} moved, each along its own motion", "approach_backlash on all joints"
    measure = "move through the same poses slowly and fast: play stays, what a delay does grows with the rates"
    yield Dependence("approach", "all joints", arm.name, words, effect, measure, columns)


def _stated(feature: Array) -> Array:
    """Without the records that do not have it: those of another arm."""
    return feature[np.isfinite(feature)]


def _spread(feature: Array) -> float:
    """From the smallest to the largest; 0 where no record has it."""
    stated = _stated(feature)
    return float(np.ptp(stated)) if len(stated) else 0.0


def _centred(features: Array, command: Array) -> Array:
    """About their mean (N x k) in the records that state the command, none in the others."""
    known = np.isfinite(command)
    centred = np.zeros_like(features)
    centred[known] = features[known] - features[known].mean(axis=0)
    return centred
