"""A random selection of what may happen in a mission, to be planted without the operator's knowledge."""

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Any

import numpy as np
from armcal.arm.assembly import Arm
from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.estimate.simulation import SimulationRequest, with_channels
from armcal.problem.problem import Problem

_ALONE = 0.999
_LINK = re.compile(r"(?P<kind>alpha|a)(?P<joint>[0-9]+)")
_FIRST, _LAST = 0.1, 0.85
"""The share of the mission within which events begin, so that there is a before and an after."""
_DAYS_APART = 3.0
_FEWEST, _MOST = 2, 6
_PAIRED = 0.25
"""The share of surprises that come two at once."""


@dataclass(frozen=True)
class Joint:
    """A joint that something may befall: its channel, its parameters by what they are (empty: none), its dimension."""

    name: str
    dimension: str
    offset: str
    play: str
    link: Mapping[str, str]


def befallen(request: SimulationRequest, poses: Dataset) -> tuple[Joint, ...]:
    """The joints of the first arm, with those of its parameters that act as an offset, a play, and a bent link.

    An offset moves the readings in all poses as the joint itself does; a play as the joint does times the direction
    of its last motion. ``a`` and ``alpha`` of a row are the link behind that row's joint; other models name none.
    """
    arm = next(iter(request.arms.values()))
    scalars = [block.name for block in request.parameters.blocks if block.size == 1]
    parameters = request.parameters.with_free(scalars)
    free_names = [block.name for block in parameters.free]
    problem = Problem.build(request.arms, request.measurements, parameters, request.environment, poses, "interpreted")
    values, records = parameters.nominal(), problem.records(poses)
    # Those that are calibrated come first: where several act alike, one of them is meant.
    calibrated = np.array([request.parameters[name].free for name in free_names])
    order = np.argsort(~calibrated, kind="stable")
    names = [free_names[i] for i in order]
    slopes = _columns(problem.jacobians(values, records), [kernel.factor.noise for kernel in problem.kernels])[:, order]
    channels = [*arm.command_channels]
    motions = _columns(problem.channel_slopes(values, records, channels), None)
    rows = len(motions) // len(poses)
    approaches = [np.tile(poses.column(f"{arm.name}.approach.{joint}"), rows) for joint in arm.commanded]
    joints = []
    for i, (joint, dimension) in enumerate(arm.commanded.items()):
        offset, play = (_alike(slopes, names, motions[:, i] * sign) for sign in (1.0, approaches[i]))
        number = i + 1
        scope, link = f"{arm.name}.{arm.model_name}.", {}
        for name in names:
            match = _LINK.fullmatch(name.removeprefix(scope)) if name.startswith(scope) else None
            if match and int(match["joint"]) == number < len(arm.commanded):
                link[match["kind"]] = name
        joints.append(Joint(f"{arm.name}.{joint}", dimension, offset, play, link))
    return tuple(joints)


def _columns(blocks: Sequence[Array], noise: Sequence[Sequence[float]] | None) -> Array:
    parts = []
    for place, block in enumerate(blocks):
        raw = block if noise is None else block * np.array(noise[place])[:, None, None]
        parts.append(np.moveaxis(raw, 1, 2).reshape(-1, block.shape[1]))
    return np.concatenate(parts)


def _alike(slopes: Array, names: Sequence[str], moved: Array) -> str:
    """The first parameter that moves all readings as ``moved`` (rows), up to a factor; empty if none does."""
    size = np.linalg.norm(slopes, axis=0) * np.linalg.norm(moved)
    alike = np.abs(slopes.T @ moved) / np.where(size > 0, size, math.inf)
    return next((name for name, cosine in zip(names, alike, strict=True) if cosine > _ALONE), "")


@dataclass(frozen=True)
class Dice:
    """Draws sizes, rounded as a person would write them."""

    random: np.random.Generator

    def size(self, low: float, high: float) -> float:
        drawn = math.exp(self.random.uniform(math.log(low), math.log(high))) * self.random.choice([-1, 1])
        return float(f"{drawn:.2g}")

    def vector(self, low: float, high: float) -> list[float]:
        direction = self.random.normal(size=3)
        return [float(f"{x:.2g}") for x in direction / np.linalg.norm(direction) * abs(self.size(low, high))]


_KINDS = ("slip", "swap", "bend", "creep", "play", "payload", "bump", "bias", "climate")


def _event(kind: str, dice: Dice, joint: Joint) -> dict[str, Any] | None:
    """What befalls a joint, or the payload, the camera or the weather; None where this joint cannot have it."""
    own, unit = {"kind": kind, "joint": joint.name}, "deg" if joint.dimension == "angle" else "mm"
    match kind:
        case "slip" if joint.offset and joint.dimension == "angle":
            return {**own, "parameter": joint.offset, "angle_deg": dice.size(1, 15)}
        case "swap" if joint.offset:
            return {**own, "changes": {joint.offset: f"{dice.size(1, 10):g} {unit}"}}
        case "bend":
            sizes = {"a": f"{dice.size(1, 8):g} mm", "alpha": f"{dice.size(0.5, 4):g} deg"}
            changes = {name: sizes[part] for part, name in joint.link.items()}
            return {**own, "changes": changes} if changes else None
        case "creep":
            change = f"{dice.size(0.05, 0.6):g} {unit} in 1 d"
            return {**own, "parameter": joint.offset, "change": change} if joint.offset else None
        case "play":
            change = f"{abs(dice.size(0.02, 0.2)):g} {unit} in 1 d"
            return {**own, "parameter": joint.play, "change": change} if joint.play else None
        case "payload":
            return {"kind": kind, "mass_g": abs(dice.size(50, 300)), "lever_mm": dice.vector(10, 80)}
        case "bump":
            return {"kind": kind, "shift_mm": dice.vector(2, 20), "turn_deg": dice.vector(0.1, 1.0)}
        case "bias":
            return {"kind": kind, "per_day_mm": dice.vector(0.1, 1.0)}
        case "climate":
            return {"kind": kind, "mean_C": float(dice.random.integers(-60, 30)), "swing_C": abs(dice.size(10, 60))}
    return None


def random_plan(joints: Sequence[Joint], days: float, bends: bool, seed: int) -> dict[str, Any]:
    """Keys of a mission's settings: events, gaps, outliers and exchanged records; the same for a seed.

    ``bends``: whether a payload bends the arm.
    """
    dice = Dice(np.random.default_rng(seed))
    count = int(np.clip(round(days / _DAYS_APART), _FEWEST, _MOST))
    slots = (np.linspace(_FIRST, _LAST, count + 1) * days).tolist()
    events: list[dict[str, Any]] = []
    for first, last in pairwise(slots):
        day = round(float(dice.random.uniform(first, (first + last) / 2)), 2)
        at_once = 2 if dice.random.random() < _PAIRED else 1
        events += [{"day": day, **event} for event in _drawn(dice, joints, bends, at_once)]
    plan: dict[str, Any] = {"events": events}
    if dice.random.random() < 0.5:
        fraction = float(dice.random.choice([0.05, 0.1, 0.2]))
        plan["outliers"] = {"fraction": fraction, "size_mm": 30.0, "largest_mm": 500.0}
    if dice.random.random() < 0.5:
        day, hours = round(float(dice.random.uniform(_FIRST, _LAST) * days), 2), float(dice.random.integers(6, 37))
        plan["losses"] = {"gaps": [{"day": day, "duration_h": hours}]}
    if dice.random.random() < 0.5:
        plan["exchanged"] = {"fraction": float(dice.random.choice([0.01, 0.02, 0.04]))}
    return plan


def _drawn(dice: Dice, joints: Sequence[Joint], bends: bool, count: int) -> list[dict[str, Any]]:
    drawn: list[dict[str, Any]] = []
    while len(drawn) < count:
        kind = _KINDS[dice.random.integers(len(_KINDS))]
        event = _event(kind, dice, joints[dice.random.integers(len(joints))])
        if event is None or (event["kind"] == "payload" and not bends):
            continue
        if all(event.get("joint", event["kind"]) != other.get("joint", other["kind"]) for other in drawn):
            drawn.append(event)
    return drawn


def probing_poses(commands: Dataset, arm: Arm, random: np.random.Generator) -> Dataset:
    sides = {f"{arm.name}.approach.{j}": random.choice([-1.0, 1.0], len(commands)) for j in arm.commanded}
    return replace(with_channels(commands, sides), source="surprise")
