"""Held parameters are judged by what records scatter, not by how many rows they have."""

from pathlib import Path

import numpy as np
from armcal.base.arrays import Array
from armcal.diagnose.causes import HeldParameter, clustered_variance
from armcal.diagnose.fit import FitRows
from armcal.diagnose.residual_structure import structure
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate

RECORDS, ROWS, COLUMNS, DRAWS = 20, 30, 6, 400


def fit_of(slopes: Array, errors: Array) -> tuple[FitRows, Array, Array]:
    """Rows of a fit without its last column, the basis of all columns, and the sum that estimates the last."""
    basis = np.linalg.qr(slopes)[0]
    rows = np.arange(RECORDS * ROWS)
    narrow = np.linalg.qr(slopes[:, :-1])[0]
    residual = errors - narrow @ (narrow.T @ errors)
    fit = FitRows(slopes, residual, rows // ROWS, rows.reshape(RECORDS, ROWS), (), (), ())
    return fit, basis, np.linalg.pinv(slopes)[-1:]


def test_errors_that_rows_of_a_record_share_are_not_taken_for_a_parameter() -> None:
    """As often as the level says, where each record errs as a whole by twice what its rows do."""
    random, p_values, by_rows = np.random.default_rng(0), [], []
    for _ in range(DRAWS):
        slopes = random.normal(size=(RECORDS * ROWS, COLUMNS))
        slopes[:, -1] += np.repeat(random.normal(size=RECORDS), ROWS)
        errors = random.normal(size=RECORDS * ROWS) + 2 * np.repeat(random.normal(size=RECORDS), ROWS)
        rows, basis, sums = fit_of(slopes, errors)
        (variance,), (freedom,) = clustered_variance(rows, basis, sums, 1.0)
        off = -float(sums[0] @ rows.residual)
        p_values.append(HeldParameter("k", "1", 0.0, off, float(np.sqrt(variance)), float(freedom)).p_value)
        by_rows.append(abs(off) > 1.96 * np.linalg.norm(sums) * np.sqrt(np.mean(rows.residual**2)))
        assert 2 < freedom < RECORDS
    assert 0.02 < np.mean(np.array(p_values) < 0.05) < 0.08
    assert np.mean(np.array(p_values) < 0.001) <= 0.005
    assert np.mean(by_rows) > 0.3, "rows taken for independent would find one in vain"


def test_what_records_do_not_show_has_no_deviation_and_is_stated_with_unit() -> None:
    held = HeldParameter("camera.board_bend_x", "m", 0.0, 1.0104e-3, 2.9e-5, 9.0)
    assert str(held) == "camera.board_bend_x is held at 0 mm, but the records put it at 1.010 +- 0.029 mm"
    assert HeldParameter("k", "1", 0.0, 0.0, np.inf, 1.0).p_value == 1.0


def test_play_that_is_held_at_none_reads_no_approach_and_stops_no_run() -> None:
    """The fit of thirty ruler points reads the approach of four joints alone; the fifth has no play to be freed."""
    config = Path(__file__).resolve().parents[2] / "configs" / "so101" / "ruler.yaml"
    fit = calibrate(Experiment.load(config, ["evaluator=interpreted", "validation.folds=0"])).fit
    left = fit.of(structure)
    assert left is not None and left.tested > 20
