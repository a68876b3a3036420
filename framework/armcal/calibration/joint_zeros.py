"""The zeros of joints that a calibration found: what is written back to the arm's own servos or files."""

import math
import re
from dataclasses import dataclass
from pathlib import Path

from armcal.calibration.calibration import Calibration
from armcal.errors import InputError, Location
from armcal.plugins import PluginRegistry

_MODEL_ZERO = re.compile(r"(theta|offset)(\d+)")


@dataclass(frozen=True)
class Zero:
    """How far a joint stands from its command at zero (deg), with its standard deviation."""

    degrees: float
    sd_deg: float


def zeros_of(path: Path, arm: str | None, registry: PluginRegistry) -> tuple[dict[str, Zero], dict[str, str]]:
    """The zeros that a calibration found, by joint; and joints without one, with the reason.

    A zero is what a joint effect states as one (``JointEffect.zeros``), as it stands, and what a model's own ``theta``
    or ``offset`` differs from its drawing.

    Raises:
        ConfigError: the calibration is refused.
        InputError: it has no zero, or several arms and none was named.
    """
    loaded, where = Calibration.load(path, registry), Location(str(path))
    arms = loaded.system.arms
    if arm not in arms and (arm is not None or len(arms) > 1):
        raise InputError(f"found the arms {', '.join(arms)}.", where=where, hint="Choose one with --arm-name NAME.")
    chosen = arms[arm or next(iter(arms))]
    stated = {f"{chosen.name}.{n}.{p}": j for n, effect in chosen.effects.items() for p, j in effect.zeros().items()}
    zeros: dict[str, Zero] = {}
    reasons = dict.fromkeys(chosen.commanded, "its zero was not free")
    for entry in loaded.record.parameters:
        match = _MODEL_ZERO.fullmatch(entry.name.removeprefix(f"{chosen.name}.{chosen.model_name}."))
        number = stated.get(entry.name, int(match[2]) if match and entry.unit == "rad" else 0)
        if not number or (joint := chosen.joint_names[number - 1]) not in chosen.commanded:
            continue
        if entry.free and (entry.sd is None or entry.determined_by != "data"):
            reasons[joint] = f"the records do not determine {entry.name}"
            continue
        value = entry.value if entry.name in stated else entry.value - entry.nominal
        if entry.free or (entry.name in stated and value):
            before = zeros.get(joint, Zero(0.0, 0.0))
            sd = math.hypot(before.sd_deg, math.degrees(entry.sd or 0.0))
            zeros[joint] = Zero(before.degrees + math.degrees(value), sd)
    if not zeros:
        hint = "Free them in parameters.free (arm.EFFECT.offset*, of an effect servo_map), and run again."
        raise InputError("found no calibrated zero of a joint.", where=where, hint=hint)
    return zeros, {joint: reason for joint, reason in reasons.items() if joint not in zeros}
