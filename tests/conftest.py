"""What several test files share: the shipped LRM arm as experiments, datasets and problems."""

from __future__ import annotations

import fcntl
import gc
import os
import shutil
import sys
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import pytest
import yaml

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT / "tests"))  # for `import oracle`

# BLAS keeps to one thread, as the command line has it. It reads this when NumPy is loaded, so nothing above loads
# NumPy. Its threads wait by turning: two test workers on two processors would wait for each other, and factorising
# a small matrix would take a hundred times as long.
for _variable in ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS"):
    os.environ.setdefault(_variable, "1")

# Tests read calibrations some hundred times: libyaml gives the same as Python's own reader, ten times faster.
if hasattr(yaml, "CSafeLoader"):
    yaml.safe_load = partial(yaml.load, Loader=yaml.CSafeLoader)


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Members of a parametrised test whose ids its ``quick`` mark does not name are slow."""
    named: dict[str, set[str]] = {}
    for item in items:
        mark = item.get_closest_marker("quick")
        if mark is None:
            continue
        family, _, member = item.nodeid.partition("[")
        left = named.setdefault(family, set(mark.args))
        if member[:-1] in mark.args:
            left.discard(member[:-1])
        else:
            item.add_marker(pytest.mark.slow)
    missing = [f"{family}[{member}]" for family, left in named.items() for member in left]
    if missing and not any("::" in each for each in config.args):
        raise pytest.UsageError(f"quick: found no {', '.join(missing)}; name members by their ids")


def pytest_collection_finish() -> None:
    """What was imported and collected stays: the garbage collector does not look through it again and again."""
    gc.freeze()


@pytest.fixture(scope="session")
def of_this_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder that all workers of this test run share."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session", autouse=True)
def _own_cache(of_this_run: Path) -> Iterator[None]:
    """Compiled kernels go to a directory of this test run, never to the user's cache."""
    place = of_this_run / "armcal-cache"
    place.mkdir(mode=0o700, exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ARMCAL_CACHE_DIR", str(place))
        yield


@pytest.fixture(scope="session", autouse=True)
def _no_compiling_for_later() -> Iterator[None]:
    """Where a command goes on with the interpreter, none compiles for a next run that would have it by chance."""
    from armcal.functions import compiler

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(compiler, "compile_in_background", lambda *given: None)
        yield


@pytest.fixture(scope="module", autouse=True)
def _surroundings_as_before() -> Iterator[None]:
    """What a module's tests set in the environment and on the path does not reach those of the next."""
    environment, path = dict(os.environ), [*sys.path]
    yield
    for name in os.environ.keys() - environment.keys() - {"PYTEST_CURRENT_TEST"}:
        del os.environ[name]
    os.environ.update(environment)
    sys.path[:] = path


@pytest.fixture(scope="session")
def repository() -> Path:
    """The root of the checkout."""
    return ROOT


@pytest.fixture(scope="session")
def demo_run(of_this_run: Path) -> Path:
    """The folder of a run of the shipped demonstration without cross-validation, made by the worker that is first."""
    from armcal.cli.main import cli
    from click.testing import CliRunner

    folder = of_this_run / "demo-run"
    with (of_this_run / "demo-run.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not (folder / "calibration.yaml").is_file():
            settings = ("--set", "validation.folds=0", "--set", "evaluator=interpreted")
            demo = str(ROOT / "configs" / "lrm_arm" / "demo.yaml")
            done = CliRunner().invoke(cli, ["run", demo, "--out", str(folder), "-q", *settings])
            assert done.exit_code == 0, done.output
    return folder


@pytest.fixture(scope="module")
def demo_calibration(demo_run: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The calibration of that run, in a copy of its folder that is the module's own."""
    return Path(shutil.copytree(demo_run, tmp_path_factory.mktemp("demo") / "run")) / "calibration.yaml"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The measured data beside the checkout; tests that need it are skipped where it is not there."""
    place = ROOT.parent / "shared" / "data"
    if not place.is_dir():
        pytest.skip(f"no measured data at {place}")
    return place


@dataclass(frozen=True)
class LrmArm:
    """The shipped configurations of the LRM arm, with datasets made of plain arrays."""

    configs: Path

    def experiment(self, name="option1", *overrides):
        """A shipped experiment by its file name."""
        from armcal.run.experiment import Experiment

        return Experiment.load(self.configs / f"{name}.yaml", overrides)

    @staticmethod
    def dataset(q, measured=None, **channels):
        """Joint angles (N x 6), measured points (N x 3; zeros by default) and further channels."""
        import numpy as np
        from armcal.base.dataset import Dataset

        measured = np.zeros((len(q), 3)) if measured is None else measured
        columns = {f"arm.q{i + 1}": q[:, i] for i in range(q.shape[1])}
        columns |= {f"tracker.{axis}": measured[:, i] for i, axis in enumerate("xyz")}
        columns |= {name: np.asarray(values, dtype=float) for name, values in channels.items()}
        return Dataset(tuple(str(i) for i in range(len(q))), columns)

    @staticmethod
    def problem(experiment, dataset, evaluator="interpreted", parameters=None):
        """The compiled problem of an experiment, perhaps with other parameters."""
        from armcal.problem.problem import Problem

        system = experiment.system
        chosen = experiment.parameters if parameters is None else parameters
        return Problem.build(system.arms, system.measurements, chosen, system.environment, dataset, evaluator)

    @staticmethod
    def vector(parameters, values):
        """A value vector: the nominal one with some of the oracle's values in it."""
        import oracle

        vector = parameters.nominal()
        for name, value in values.items():
            vector[parameters.entries_of(oracle.armcal_name(name))] = value
        return vector


@pytest.fixture(scope="session")
def lrm() -> LrmArm:
    """The LRM arm as it ships."""
    return LrmArm(ROOT / "configs" / "lrm_arm")
