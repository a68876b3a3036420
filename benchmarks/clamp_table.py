"""What a clamp that is 1 cm and 0.1 rad elsewhere costs the joint offsets of two arms, as a table in Markdown.

Run as ``python -m benchmarks.clamp_table [SEEDS]``. Every recording is new postures and new encoder noise; the same one
is fitted with the clamp known exactly, held where it is wrongly believed to be, and in the problem under its prior.
"""

from __future__ import annotations

import json
import sys
from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import yaml
from armcal.base.dataset import Dataset
from armcal.base.parameters import Parameters
from armcal.estimate.estimator import Estimate, estimate
from armcal.estimate.polish import started
from armcal.problem.problem import Problem
from armcal.problem.variants import with_joint_noise
from armcal.run.experiment import Experiment
from numpy.typing import NDArray

CONFIGS = Path(__file__).resolve().parents[1] / "configs" / "frida"
OFFSETS = tuple(f"{arm}.poe.offset{i}" for arm in ("left", "right") for i in range(1, 8))
WAYS = {
    "exact": "clamp known exactly",
    "held": "clamp 1 cm and 0.1 rad elsewhere, held",
    "freed": "clamp 1 cm and 0.1 rad elsewhere, in the problem under its prior",
}


@dataclass(frozen=True)
class ClampErrors:
    """Errors of the 14 offsets (recordings x 14, rad), and of each recording the offsets that only priors hold."""

    errors: NDArray[np.float64]
    held_offsets: tuple[set[str], ...]


@dataclass(frozen=True)
class JointPath:
    """One experiment whose problem is built once."""

    experiment: Experiment
    problem: Problem

    @classmethod
    def of(cls, experiment: Experiment, dataset: Dataset) -> JointPath:
        """Compiled for recordings like this one."""
        system, own = experiment.system, experiment.of_records(dataset)
        parameters: Parameters = own.parameters
        built = (system.arms, system.measurements, parameters, system.environment, dataset)
        return cls(experiment, Problem.build(*built, "interpreted"))

    def fit(self, dataset: Dataset) -> Estimate:
        """From the nominal values, as a run does it."""
        records = self.problem.of(dataset).records
        problem = started(self.problem.with_records(records))
        start = problem.parameters.nominal()
        records = with_joint_noise(problem.with_records(records), start).records
        return estimate(
            problem.with_records(records), self.experiment.estimator.solve(problem.with_records(records), start)
        )


def recording(seed: int) -> Dataset:
    """Of the arms and the bracket as they are."""
    experiment = Experiment.load(CONFIGS / "wrong_clamp.yaml", [f"simulation.seed={seed}"])
    return experiment.simulator().simulate(experiment.simulation_request)


def clamp_study(seeds: Iterable[int]) -> dict[str, ClampErrors]:
    """Of each way, over recordings by these seeds."""
    believed = yaml.safe_load((CONFIGS / "wrong_clamp.yaml").read_text())["measurements"]["closure"]["clamps"]["one"]
    experiments = {
        "exact": Experiment.load(CONFIGS / "dual_known_clamp.yaml"),
        "held": Experiment.load(
            CONFIGS / "dual_known_clamp.yaml", [f"measurements.closure.clamps.one={json.dumps(believed)}"]
        ),
        "freed": Experiment.load(CONFIGS / "wrong_clamp.yaml"),
    }
    true = yaml.safe_load((CONFIGS / "wrong_clamp.truth.yaml").read_text())
    truth = np.array([float(true[name].split()[0]) for name in OFFSETS])
    recordings = [recording(1000 + seed) for seed in seeds]
    ways = {name: JointPath.of(experiment, recordings[0]) for name, experiment in experiments.items()}
    result = {}
    for name, way in ways.items():
        fits = [way.fit(dataset) for dataset in recordings]
        errors = [[found.values[found.parameters.entries_of(n)][0] for n in OFFSETS] for found in fits]
        told = [{n: by == "data" for n, by in zip(own.names, own.determined_by, strict=True)} for own in fits]
        result[name] = ClampErrors(np.array(errors) - truth, tuple({n for n in OFFSETS if not t[n]} for t in told))
    return result


def root_mean_square(errors: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each offset over the recordings."""
    return np.asarray(np.sqrt(np.mean(errors**2, axis=0)))


def main() -> None:
    """Print the table."""
    seeds = int(sys.argv[1]) if len(sys.argv) > 1 else 30
    study = clamp_study(range(seeds))
    lines = [f"Root mean square error of each joint offset over {seeds} recordings, mrad:", ""]
    lines.append("| arm | way | " + " | ".join(f"joint {i}" for i in range(1, 8)) + " | norm of joints 1 to 6 |")
    lines.append("| --- | --- |" + " --- |" * 8)
    for arm, part in (("left", slice(0, 7)), ("right", slice(7, 14))):
        for name, told in WAYS.items():
            size = 1000 * root_mean_square(study[name].errors)[part]
            held = all(f"{arm}.poe.offset7" in found for found in study[name].held_offsets)
            cells = [f"{x:.3g}" for x in size[:6]] + [f"{size[6]:.3g}{' (held by its prior)' if held else ''}"]
            lines.append(f"| {arm} | {told} | {' | '.join(cells)} | {np.linalg.norm(size[:6]):.3g} |")
    sys.stdout.write("\n".join(lines) + "\n")


if __name__ == "__main__":
    main()
