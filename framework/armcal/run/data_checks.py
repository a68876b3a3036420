"""Checks of records against the model before a fit: units, permuted axes, and which way gravity points."""

from collections.abc import Sequence

import numpy as np

from armcal.base.dataset import Dataset
from armcal.config.system import System
from armcal.diagnose.noise_findings import Finding
from armcal.diagnose.permuted_axes import MUCH_BETTER, find_permuted_axes
from armcal.errors import DataError, Location
from armcal.problem.problem import FactorRecords, Problem

_MEND = {
    True: "the order or the directions of the joints in the model",
    False: "how the tracker's frame lies",
}
_REACH_RATIO = 10.0
_ALIKE = 0.35
"""In powers of ten: so alike are two distances of one unit."""
_FEWEST_ROWS, _NEARLY_ALL, _NEAREST = 3, 0.95, 1e-6


def check_reach(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> None:
    """Positions ten times farther out, or nearer, than the model's: a unit is wrong."""
    shown = problem.predict(problem.parameters.nominal(), records)
    for kernel, values in zip(problem.kernels, shown, strict=True):
        channels = kernel.factor.output_channels
        if [channel.rpartition(".")[2] for channel in channels] != ["x", "y", "z"]:
            continue
        far, distances = (np.linalg.norm(x, axis=0) for x in (values[:3], dataset.stacked(channels)))
        ratio, name = distances / np.maximum(far, _NEAREST), kernel.factor.name
        # Some records as far out as the model (ratio 1), all others a thousand or ten times farther or nearer.
        orders = np.log10(np.where(ratio > 0, ratio, np.nan))
        right = np.abs(orders) < _ALIKE
        for power in (3, -3, 1, -1):
            wrong = np.abs(orders - power) < _ALIKE
            if min(right.sum(), wrong.sum()) >= _FEWEST_ROWS and np.mean(right | wrong) >= _NEARLY_ALL:
                first = int(np.argmax(wrong))
                raise DataError(
                    f"{name}: {wrong.sum()} of {len(dataset)} positions are about {10.0**power:g} times as far from "
                    f"the base frame as the model's tip, the others as far (the first: record {dataset.ids[first]}).",
                    where=Location(dataset.source, row=dataset.rows[first] if dataset.rows else None),
                    hint="Write all rows in the unit of the column names.",
                )
        reach, measured = float(np.median(far)), float(np.median(distances))
        if measured > _REACH_RATIO * reach or reach > _REACH_RATIO * measured:
            raise DataError(
                f"{name}: positions are typically {measured:.4g} m from the base frame, the model's tip {reach:.4g} m.",
                where=Location(dataset.source),
                hint="Check the unit in the column names (x_mm or x_m) and the frame of the measurements.",
            )


def check_permuted_axes(
    problem: Problem, records: Sequence[FactorRecords], dataset: Dataset, accept: bool = False
) -> list[Finding]:
    """Positions that do not fit the model, but do once one exchange is undone; with ``accept`` a bad finding.

    Raises:
        DataError: they are such, and not accepted; it names what looks mixed up.
    """
    reading = find_permuted_axes(problem, records, dataset)
    if reading is None:
        return []
    text = (
        f"{reading.measurement}: as they stand, the data are typically {reading.as_given_mm:.3g} mm off the model, "
        f"however its free parameters adapt; with {', or with '.join(reading.readings)}, they are "
        f"{reading.left_mm:.3g} mm off."
    )
    mend = _MEND[reading.of_joints]
    hint = f"Check the unit in the column names; mend columns in the file or by data.columns, or {mend}."
    if accept:
        return [Finding("bad", text, f"limit {MUCH_BETTER:g} times", hint)]
    hint += (
        " If the data are right, the model's nominal values are far off: give better ones, or calibrate as it "
        "stands: armcal run --accept."
    )
    raise DataError(text, where=Location(dataset.source), hint=hint)


def gravity_findings(system: System, dataset: Dataset) -> list[Finding]:
    """A warning where springs bend under weights and the direction of gravity is not stated.

    A tracker's frame may stand in any way: gravity that is turned with it makes wrong compliances, and fits as well.
    """
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
