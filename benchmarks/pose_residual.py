"""The tables of docs/pose_residual.md, from measured data: ``python -m benchmarks.pose_residual DATA [PART ...]``.

``DATA`` has the folders ``ur10_leica`` and ``lrm_arm``; ``PART`` is unseen, series, regions, printed or structureless.
The UR10's configuration is the one that the page shows.
"""

from __future__ import annotations

import itertools
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from armcal.api import Experiment, Run
from armcal.base.dataset import Dataset
from armcal.measure.tables import write_csv
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]

ROOT = Path(__file__).resolve().parents[1]
SERIES = {"A": "grid.csv", "B": "joint_configurations.csv", "C": "random_poses.csv"}
WAYS = {"without": ("arms.arm.residual=null",), "with": ()}
NOISE_M, NOISE_RAD = 0.3e-3, np.radians(0.03)
DRAWS, PLACED_BY, RECORDINGS = 5, 10, 100


@dataclass(frozen=True)
class Bench:
    """Where data are, and where temporary files go."""

    data: Path
    scratch: Path

    @cached_property
    def config(self) -> Path:
        """The UR10's configuration, as the page has it."""
        page = (ROOT / "docs" / "pose_residual.md").read_text()
        block = next(b for b in page.split("```yaml\n")[1:] if "shoulder_pan_joint" in b).partition("```")[0]
        file = self.scratch / "ur10.yaml"
        file.write_text(block)
        return file

    def ur10(self, series: str, *overrides: str, train: Iterable[str] = ()) -> Experiment:
        """Of one series; ``train`` are ids to train on, in place of a random fifth that is held out."""
        file = self.data / "ur10_leica" / SERIES[series]
        ids = list(train)
        if ids:
            listed = self.scratch / "train.csv"
            listed.write_text("\n".join(["pose_id", *ids]) + "\n")
            overrides = (*overrides, "validation.holdout=0", f"validation.train_ids={listed}")
        return Experiment.load(self.config, overrides, file)

    def learned(self, series: str, way: str) -> Run:
        """From four fifths of a series: of the grid the first in time, of the others drawn at random."""
        ids = self.ur10(series).read().ids if series == "A" else ()
        return self.ur10(series, *WAYS[way], train=ids[: len(ids) * 4 // 5]).run()


def unseen(bench: Bench) -> Iterator[str]:
    """A fifth of the random poses, drawn by two seeds."""
    for way, seed in (("without", 1), ("with", 1), ("with", 2)):
        run = bench.ur10("C", *WAYS[way], f"validation.seed={seed}").run()
        yield f"C, {way}, seed {seed}: {_errors(run)}"


def series(bench: Bench) -> Iterator[str]:
    """Each series learned, and judged on the rest of it and on the others."""
    datasets = {name: bench.ur10(name).read() for name in SERIES}
    runs = {name: {way: bench.learned(name, way) for way in WAYS} for name in SERIES}
    for name, way in itertools.product(SERIES, WAYS):
        run = runs[name][way]
        yield f"{name}, {way}: {_errors(run)}; fit {run.result.seconds['fit']:.1f} s"
    for one, other in itertools.permutations(SERIES, 2):
        cells = []
        for run in runs[one].values():
            mm, degrees, explained = judged_elsewhere(run, datasets[other])
            cells.append(f"{mm:.2f} mm, {degrees:.3f} deg (temperature explains {100 * explained:.1f} %)")
        yield f"{one} to {other}: {' -> '.join(cells)}"


def regions(bench: Bench) -> Iterator[str]:
    """Intervals inside and outside of the region of the training records."""
    dataset = bench.ur10("C").read()
    first = dataset.column("arm.shoulder_pan_joint")
    low, high = np.quantile(first, (0.15, 0.85))
    random, inside = np.random.default_rng(0), (first > low) & (first < high)
    within, beyond = (random.permutation(np.flatnonzero(where)) for where in (inside, ~inside))
    train = np.sort(within[:700])
    for way, overrides in WAYS.items():
        calibration = bench.ur10("C", *overrides, train=[dataset.ids[i] for i in train]).run().calibration
        for where, chosen in (("inside", within[700:1100]), ("outside", beyond[:400])):
            judged = dataset.subset(np.sort(chosen))
            off = _positions(judged.channels) - _positions(calibration.predict(judged)[0])
            half = calibration.plus_minus(judged).half_widths
            widths = np.array([half[f"tracker.{axis}"] for axis in "xyz"])
            mean, covered = np.linalg.norm(off, axis=0).mean(), np.mean(np.abs(off) <= widths)
            yield (
                f"{way}, {where}: {1000 * mean:.3f} mm, {100 * covered:.1f} % covered, "
                f"median +- {1000 * np.median(widths):.2f} mm"
            )


def printed(bench: Bench) -> Iterator[str]:
    """The Lunar Rover Mini's arm."""
    folder, config = bench.data / "lrm_arm", ROOT / "configs" / "lrm_arm" / "best.yaml"
    layer = "arms.arm.residual={type: gaussian_process}"
    for way, overrides in (("without", ()), ("with", (layer,))):
        run = Experiment.load(config, overrides, folder / "poses.csv").run()
        known, at_rest = (
            table["cross_validated"].mean for table in (run.result.table.calibrated, run.result.table.at_rest)
        )
        yield f"LRM, {way}: five folds {known:.3f} mm, as in another recording {at_rest:.3f} mm"
        if run.result.pose_residual is not None and run.result.pose_residual.stretches is not None:
            own = run.result.pose_residual.stretches
            yield f"LRM, ten stretches: {own.without:.3f} -> {own.with_it:.3f} mm"
        ids = f"validation.train_ids={folder / 'published_50.csv'}"
        few = Experiment.load(config, (*overrides, ids), folder / "poses.csv").run()
        kept = few.result.pose_residual is not None and few.result.pose_residual.residual is not None
        known, at_rest = (table["holdout"].mean for table in (few.result.table.calibrated, few.result.table.at_rest))
        yield f"LRM, {way}, published 50 (kept: {kept}): {known:.3f} mm, as in another recording {at_rest:.3f} mm"


def structureless(bench: Bench) -> Iterator[str]:
    """Simulated recordings of the Lunar Rover Mini's arm, whose model is right: how many keep a pose residual."""
    config, recording = ROOT / "configs" / "lrm_arm" / "demo.yaml", bench.scratch / "recording.csv"
    overrides = ("validation.folds=0", "arms.arm.residual={type: gaussian_process}")
    kept, worse = 0, []
    for seed in range(RECORDINGS):
        experiment = Experiment.load(config, (*overrides, f"simulation.seed={1000 + seed}"))
        dataset = experiment.simulator().simulate(experiment.simulation_request)
        write_csv(recording, dataset, experiment.request(measured=True).channels)
        outcome = Experiment.load(config, overrides, recording).run().result.pose_residual
        if outcome is not None and outcome.folds is not None:
            kept += outcome.residual is not None
            worse.append(outcome.folds.with_it / outcome.folds.without - 1)
    yield (
        f"no structure: kept in {kept} of {RECORDINGS}; something was learned in {len(worse)}, which made "
        f"unseen errors up to {100 * max(worse, default=0.0):.1f} % worse"
    )


PARTS: dict[str, Callable[[Bench], Iterator[str]]] = {
    part.__name__: part for part in (unseen, series, regions, printed, structureless)
}


def judged_elsewhere(run: Run, other: Dataset) -> tuple[float, float, float]:
    """Mean errors (mm, deg) of another series, placed by ten of its poses, and the share that temperature explains.

    Medians of five draws; of the share, which is of squared errors of positions by a linear regression, the largest.
    """
    values, _ = run.calibration.predict(other)
    predicted, measured = (_poses(one) for one in (values, other.channels))
    temperature, found = other.column("temperature"), []
    for seed in range(DRAWS):
        ten = np.random.default_rng(seed).permutation(len(other))[:PLACED_BY]
        rest = np.setdiff1d(np.arange(len(other)), ten)
        shift, turn = _placed(predicted, measured, ten)
        warmth = temperature[rest] - temperature[rest].mean()
        centred = shift[:, rest] - shift[:, rest].mean(axis=1, keepdims=True)
        explained = np.sum((centred @ warmth) ** 2) / (warmth @ warmth) / np.sum(shift[:, rest] ** 2)
        mean = np.linalg.norm(shift[:, rest], axis=0).mean(), np.linalg.norm(turn[:, rest], axis=0).mean()
        found.append((1000 * mean[0], np.degrees(mean[1]), explained))
    errors = np.array(found)
    return float(np.median(errors[:, 0])), float(np.median(errors[:, 1])), float(errors[:, 2].max())


def _placed(predicted: tuple[Array, Rotation], measured: tuple[Array, Rotation], by: Array) -> tuple[Array, Array]:
    """Errors of positions (3 x N, m) and rotations (3 x N, rad): instrument and probe stand where some records say."""

    def off(at: Array, chosen: Array | slice) -> tuple[Array, Array]:
        frame, probe = Rotation.from_rotvec(at[:3]), Rotation.from_rotvec(at[6:9])
        shown = frame.apply(predicted[0][:, chosen].T + predicted[1][chosen].apply(at[9:])).T + at[3:6, None]
        turned = frame * predicted[1][chosen] * probe
        return measured[0][:, chosen] - shown, (turned.inv() * measured[1][chosen]).as_rotvec().T

    def whitened(at: Array) -> Array:
        shift, turn = off(at, by)
        return np.concatenate([(shift / NOISE_M).ravel(), (turn / NOISE_RAD).ravel()])

    # The probe is about where it was, so that the frame follows from positions alone.
    centres = [place[:, by].mean(axis=1) for place in (predicted[0], measured[0])]
    frame, _ = Rotation.align_vectors((measured[0][:, by].T - centres[1]), (predicted[0][:, by].T - centres[0]))
    start = np.concatenate([frame.as_rotvec(), centres[1] - frame.apply(centres[0]), np.zeros(6)])
    return off(least_squares(whitened, start, x_scale="jac").x, slice(None))


def _positions(channels: Mapping[str, Array]) -> Array:
    return np.array([channels[f"tracker.{axis}"] for axis in "xyz"])


def _poses(channels: Mapping[str, Array]) -> tuple[Array, Rotation]:
    quaternion = np.array([channels[f"tracker.q{axis}"] for axis in "xyzw"])
    return _positions(channels), Rotation.from_quat(quaternion.T)


def _errors(run: Run) -> str:
    """Of records that were held out, and of stretches."""
    turns, outcome = run.result.table.turns, run.result.pose_residual
    degrees = "" if turns is None else f", {turns.calibrated['holdout'].mean:.4f} deg"
    covered = next(iter(run.result.intervals.values())).holdout.stated["90"]
    text = f"{run.result.table.calibrated['holdout'].mean:.4f} mm{degrees}; 90 % intervals cover {100 * covered:.1f} %"
    if outcome is not None and outcome.stretches is not None:
        text += f"; stretches {outcome.stretches.without:.3f} -> {outcome.stretches.with_it:.3f} {outcome.unit}"
        text += f"; {run.result.seconds['pose residual']:.0f} s"
    return text


def main() -> None:
    """Print a line as each figure is found."""
    with tempfile.TemporaryDirectory() as scratch:
        bench = Bench(Path(sys.argv[1]), Path(scratch))
        for name in sys.argv[2:] or PARTS:
            for line in PARTS[name](bench):
                sys.stdout.write(f"{line}\n")
                sys.stdout.flush()


if __name__ == "__main__":
    main()
