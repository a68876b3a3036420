"""A pose residual is advised where the records can teach one: a draw wire shows no place of the tool."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import yaml
from armcal.diagnose.residual_structure import Carrier, Predicted, _remedies
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from armcal.run.pipeline import calibrate

from tests.clean_runs import _range

CANNOT = "A pose residual cannot learn it from these records"


@pytest.mark.parametrize(("learnable", "said"), [(True, "Learn it: "), (False, CANNOT), (None, "Free what ")])
def test_what_is_advised_is_possible(learnable: bool | None, said: str) -> None:
    rest = Predicted(0.71, 0.05, 40.0, 0.0, 0.0, 0.0, (Carrier("joint", "the angle of q2", 0.7),))
    advice = list(_remedies(rest, learnable))
    assert advice[0].startswith(said) and any(text.startswith("Learn it") for text in advice) == (learnable is True)


@pytest.fixture(scope="module")
def config(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return _range(tmp_path_factory.mktemp("wire"))  # a plugin is registered once in a process


@pytest.mark.slow
@pytest.mark.parametrize("of_several", [False, True])
def test_of_a_draw_wire_joints_own_motion_alone_can_be_learned(config: Path, of_several: bool) -> None:
    """Errors over each joint's own angle go from 0.61 to 0.18 mm; of those that several angles make none is kept."""
    folder = config.parent
    (folder / "clean_truth.yaml").write_text("arm.mdh.theta2: 0.2 deg\n", encoding="utf-8")
    config.write_text(yaml.safe_dump({**yaml.safe_load(config.read_text()), "evaluator": "auto"}), encoding="utf-8")
    experiment = Experiment.load(config, ("simulation.poses.count=200", "simulation.seed=1"))
    dataset = experiment.simulator().simulate(experiment.simulation_request)
    q2, q3, q4 = (dataset.column(f"arm.q{i}") for i in (2, 3, 4))
    off = {"arm.q2": np.sin(q2 + 0.3), "arm.q3": np.sin(2 * q3 + 1), "arm.q4": 0 * q4}
    if of_several:
        off = {"arm.q2": np.cos(q2) + np.cos(q2 + q3) + 0.5 * np.sin(q3), "arm.q3": np.cos(q2 + q3)}
        off["arm.q4"] = 2 * np.sin(q2 + q3) * np.sin(q4)
    moved = {name: dataset.column(name) - np.radians(0.15) * by for name, by in off.items()}
    dataset = replace(dataset, channels={**dataset.channels, **moved})
    write_csv(folder / "data.csv", dataset, experiment.request(measured=True).channels)
    actions = " ".join(finding.action for finding in calibrate(Experiment.load(config)).verdict.findings)
    assert ("Learn it" in actions) == (not of_several)
