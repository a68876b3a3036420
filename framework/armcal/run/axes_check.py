"""Are axes or joints exchanged or reversed in the data? Then no parameters can mend it, and a fit may lead nowhere."""

from __future__ import annotations

from collections.abc import Sequence

from armcal.base.dataset import Dataset
from armcal.diagnose.permuted_axes import find_permuted_axes
from armcal.errors import DataError, Location
from armcal.problem.problem import FactorRecords, Problem

_MEND = {
    True: "the order or the directions of the joints in the model",
    False: "how the tracker's frame lies",
}


def check_permuted_axes(problem: Problem, records: Sequence[FactorRecords], dataset: Dataset) -> None:
    """Positions that do not fit the model, but do once one exchange is undone.

    Raises:
        DataError: they are such; it names what looks mixed up.
    """
    reading = find_permuted_axes(problem, records, dataset)
    if reading is None:
        return
    raise DataError(
        f"{reading.measurement}: as they stand, the data are typically {reading.as_given_mm:.3g} mm off the model, "
        f"however its free parameters adapt; with {', or with '.join(reading.readings)}, they are "
        f"{reading.left_mm:.3g} mm off.",
        where=Location(dataset.source),
        hint=f"Mend these columns in the file or by data.columns, or {_MEND[reading.of_joints]}. "
        "If the data are right, the model's nominal values are far off: give better ones.",
    )
