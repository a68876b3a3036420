"""Checks of data, before a fit and beside one: what is mixed up, in another unit, too heavy, or stood still."""

import numpy as np

from armcal.arm.assembly import command_channels, shown_joint
from armcal.base.dataset import Dataset
from armcal.base.units import digits, to_unit
from armcal.config.system import System
from armcal.diagnose.checks import Finding, first_few
from armcal.diagnose.fit import Fit, Prepared
from armcal.diagnose.permuted_axes import MUCH_BETTER, find_permuted_axes
from armcal.diagnose.readings import check_reach
from armcal.measure.groups import first_of_pose

_MEND = {
    True: "the order, the directions or the zeros of the joints in the model",
    False: "how the tracker's frame lies",
}
_STILL = {"angle": ("deg", 1.0), "length": ("mm", 1.0)}
"""A joint that moved by less stood still, but for the noise of its reading."""
_DENSEST, _SHORTEST = 200.0, 0.4
"""kg for each cubic metre of an arm's length (industrial arms and palletisers: 5 to 90); m, what shorter arms count."""


def mixed_up(ready: Prepared) -> list[Finding]:
    """Positions that do not fit the model, but do once one exchange is undone."""
    reading = find_permuted_axes(ready.problem, ready.dataset)
    if reading is None:
        return []
    adapted = "model, however its free parameters adapt" if reading.adapted else "nominal arm"
    text = (
        f"{reading.measurement}: as they stand, the data are typically {digits(reading.as_given_mm)} mm off the "
        f"{adapted}; with {', or with '.join(reading.readings)}, they are "
        f"{digits(reading.left_mm)} mm off."
    )
    mend = _MEND[reading.of_joints]
    hint = f"Check the unit in the column names; mend columns in the file or by data.columns, or {mend}."
    return [Finding("bad", text, f"limit {MUCH_BETTER:g} times", hint)]


def reach(ready: Prepared) -> list[Finding]:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong.

    Raises:
        DataError: which, and as which unit they are read.
    """
    check_reach(ready.problem, ready.dataset)
    return []


def masses(ready: Prepared) -> list[Finding]:
    """Masses that no arm of that size has: grams that were read as kilograms."""
    findings = []
    for name, arm in ready.system.arms.items():
        total, size = sum(mass.mass for mass in arm.masses), max(arm.length, _SHORTEST)
        limit = _DENSEST * size**3
        if total > limit:
            worst = max(arm.masses, key=lambda mass: mass.mass)
            text = (
                f"The links of {name} weigh {digits(total)} kg ({worst.name}: {digits(worst.mass)} kg), and the arm is "
                f"{digits(arm.length)} m long from joint to joint: no arm of that length weighs more than "
                f"{digits(limit)} kg. Are these grams?"
            )
            test = f"limit {_DENSEST:g} kg for each cubic metre of the length, {_SHORTEST:g} m at least"
            findings.append(Finding("warning", text, test, f"Correct the masses: arms.{name}.links, or the URDF's."))
    return findings


def still_joints(system: System, dataset: Dataset) -> dict[str, str]:
    still = {}
    for channel, dimension in command_channels(system.arms).items():
        unit, least = _STILL[dimension]
        values = dataset.column(channel) if dataset.has(channel) else np.array([])
        known = to_unit(values[np.isfinite(values)], unit)
        if known.size and np.ptp(known) < least:
            still[channel] = f"{np.mean(known):.4g} {unit}"
    return still


def still(fit: Fit) -> list[Finding]:
    """Joints that stood still in all records that trained."""
    stood = still_joints(fit.system, fit.ready.trained)
    if not stood:
        return []
    listed = [f"{shown_joint(c, fit.system.arms)} at {where}" for c, where in stood.items()]
    text = (
        f"Hardly moved in the training records: {first_few(listed)}. Predictions elsewhere rest on nominal values and "
        "priors, and no record judges them."
    )
    test = "range, limits " + " and ".join(f"{least:g} {unit}" for unit, least in _STILL.values())
    return [
        Finding("warning", text, test, "Move these joints too, or use the calibration only where they stand there.")
    ]


def same_poses(fit: Fit) -> list[Finding]:
    dataset, split = fit.dataset, fit.split
    pose = first_of_pose(dataset, [*filter(dataset.has, command_channels(fit.system.arms))])
    count, held = int(np.isin(pose[split.holdout], pose[split.train]).sum()), len(split.holdout)
    if not count:
        return []
    text = (
        f"{count} of {held} held-out records are at poses that trained: their errors show how well a pose repeats, not "
        "how good the model is elsewhere."
    )
    return [Finding("warning", text, "poses alike in all joints, under the same load", "Hold out other poses.")]


def gravity(of: Prepared | Fit) -> list[Finding]:
    """Whether springs bend under weights and the direction of gravity is not stated.

    A tracker's frame may stand in any way: gravity that is turned with it makes wrong compliances, and fits as well.
    """
    system, dataset = of.system, of.dataset
    if system.statics.gravity is not None or dataset.has("gravity_z"):
        return []
    payload = bool(system.statics.payload) or (dataset.has("payload") and bool(dataset.column("payload").any()))
    bent = [name for name, arm in system.arms.items() if arm.deflection_size and (arm.masses or payload)]
    if not bent:
        return []
    x, y, z = system.environment.gravity
    text = (
        f"The direction of gravity is not stated: for the springs of {', '.join(bent)} it was assumed to be "
        f"({x:g}, {y:g}, {z:g}) m/s^2 in the frame of the measurements, z up. If that frame is tilted, compliances are "
        "wrong."
    )
    action = (
        "State statics.gravity_m_s2 in that frame, or add the columns gravity_x_m_s2, gravity_y_m_s2 and gravity_z_m_s2"
        " to the records."
    )
    return [Finding("warning", text, action=action)]
