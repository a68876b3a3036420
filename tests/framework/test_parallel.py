"""Independent work on processes: the same numbers, the same faults, no leftovers."""

from __future__ import annotations

import os
import pickle
import signal
import subprocess
import sys
import threading
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from armcal.cli.main import cli, main
from armcal.errors import ArmcalError, ConfigError, InputError, Location
from armcal.estimate.estimator import spread
from armcal.estimate.validation import FitTask, cross_validate, fit_and_judge, folds
from armcal.io.parallel import Executor, parse_executor
from armcal.problem.problem import Problem
from click.testing import CliRunner

CONFIGS = Path(__file__).resolve().parents[2] / "configs" / "lrm_arm"
DEMO = str(CONFIGS / "demo.yaml")


def _setup(lrm, evaluator="interpreted", *overrides):
    experiment = lrm.experiment("demo", "parameters.free=[arm.mdh.theta*, arm.spring.k2]", *overrides)
    dataset = experiment.read()
    return experiment, lrm.problem(experiment, dataset, evaluator), dataset


def _fold_errors(lrm, executor: Executor | None) -> np.ndarray:
    experiment, problem, dataset = _setup(lrm)
    start, splits = experiment.parameters.nominal(), folds(len(dataset), 4, 3)
    problem = problem.of(dataset)
    return cross_validate(problem, splits, experiment.estimator, start, executor=executor).errors


@pytest.mark.parametrize(
    "text, expected",
    [
        ("auto", Executor()),
        ("1", Executor(1)),
        (" 2 ", Executor(2)),
    ],
)
def test_what_the_option_says(text: str, expected: Executor) -> None:
    assert parse_executor(text) == expected


@pytest.mark.parametrize(
    "text", ["", "0", "-1", "2.5", "two", "1025", "loky:2", "threading:2", "dask:tcp://10.0.0.1:8786"]
)
def test_what_the_option_cannot_say_is_bad_input(text: str) -> None:
    done = CliRunner().invoke(cli, ["run", DEMO, "--parallel", text])
    assert done.exit_code == 2
    assert "--parallel" in done.output and "a number of processes" in done.output


@pytest.mark.quick("interpreted")
@pytest.mark.parametrize("evaluator", ["interpreted", "compiled"])
def test_a_problem_sent_elsewhere_gives_the_same_bits(lrm, evaluator: str) -> None:
    _, problem, dataset = _setup(lrm, evaluator)
    problem.of(dataset).residuals(problem.parameters.nominal())  # fills what arms keep of expressions
    sent = pickle.dumps(problem)
    there = pickle.loads(sent)
    assert there is not problem and there.backend == problem.backend
    assert pickle.loads(sent).compiled is there.compiled, "compiled again for every task"
    values = problem.parameters.retract(np.full(problem.increments, 1e-3))
    ours, theirs = (p.of(dataset).normal_equations(values) for p in (problem, there))
    assert ours.cost == theirs.cost
    assert np.array_equal(ours.gradient, theirs.gradient) and np.array_equal(ours.hessian, theirs.hessian)


@pytest.mark.parametrize("executor", [Executor(2), Executor(3), Executor(worth_s=0.0), Executor()])
@pytest.mark.slow
def test_every_backend_gives_the_same_bits(lrm, executor: Executor) -> None:
    assert np.array_equal(_fold_errors(lrm, executor), _fold_errors(lrm, None))


@pytest.mark.slow
def test_the_order_of_folds_does_not_change_a_fold(lrm) -> None:
    """No fit warms another's equilibria."""
    experiment, problem, dataset = _setup(lrm)
    problem, start = problem.of(dataset), experiment.parameters.nominal()
    tasks = [FitTask(problem, experiment.estimator, start, s) for s in folds(len(dataset), 3, 0)]
    forth, back = Executor(1).map(fit_and_judge, tasks), Executor(1).map(fit_and_judge, tasks[::-1])
    for one, other in zip(forth, back[::-1], strict=True):
        assert np.array_equal(one.errors, other.errors)


def _who(task: float) -> tuple[float, int]:
    time.sleep(0.15)
    return task, os.getpid()


@pytest.mark.slow
def test_results_come_in_the_order_of_the_tasks_from_several_processes_and_progress_ends_at_one() -> None:
    told: list[float] = []
    found = Executor(2).map(_who, list(range(8)), told.append)
    assert [task for task, _ in found] == list(range(8))
    assert len({pid for _, pid in found}) == 2 and os.getpid() not in {pid for _, pid in found}
    assert told == sorted(told) and told[-1] == 1.0


@pytest.mark.slow
def test_work_that_lasts_is_handed_over_and_work_that_does_not_stays() -> None:
    told: list[float] = []
    shared = Executor(worth_s=0.3).map(_who, list(range(8)), told.append)
    assert [task for task, _ in shared] == list(range(8))
    assert shared[0][1] == os.getpid() != shared[-1][1]
    assert told == sorted(told) and told[-1] == 1.0
    assert {pid for _, pid in Executor(worth_s=60).map(_who, [1, 2])} == {os.getpid()}


def test_nothing_to_do_is_done() -> None:
    for executor in (Executor(1), Executor(), Executor(2)):
        assert executor.map(_who, []) == []


def _refuse(task: int) -> int:
    if task == 3:
        raise ConfigError("found 3.", where=Location("a.yaml", 7), hint="Give another.")
    return task


@pytest.mark.parametrize("executor", [Executor(1), Executor(2)])
def test_a_fault_arrives_as_it_was_raised(executor: Executor) -> None:
    with pytest.raises(ConfigError) as caught:
        executor.map(_refuse, list(range(6)))
    fault = caught.value
    assert type(fault) is ConfigError and fault.exit_code == 2
    assert str(fault) == "a.yaml:7: found 3. Give another."
    assert (fault.message, fault.where, fault.hint) == ("found 3.", Location("a.yaml", 7), "Give another.")


def _die(task: int) -> int:
    if task == 2:
        os._exit(9)
    return task


@pytest.mark.slow
def test_a_worker_that_is_killed_is_said_and_the_next_work_finds_new_ones() -> None:
    with pytest.raises(ArmcalError, match="worker process ended"):
        Executor(2).map(_die, list(range(4)))
    assert Executor(2).map(_refuse, [1, 2]) == [1, 2]


def test_what_cannot_be_sent_stays_here_or_is_refused() -> None:
    tasks = [threading.Lock() for _ in range(4)]
    assert Executor(worth_s=0.0).map(_locked, tasks) == [False] * 4
    with pytest.raises(InputError, match="cannot be sent") as caught:
        Executor(2).map(_locked, tasks)
    assert "--parallel 1" in caught.value.hint


def _locked(task: threading.Lock) -> bool:
    return task.locked()


@pytest.mark.slow
def test_starts_of_one_fit_can_be_spread(lrm) -> None:
    experiment, problem, dataset = _setup(lrm, "interpreted", "estimator.starts=4", "estimator.seed=2")
    start = experiment.parameters.nominal()
    found = [
        spread(experiment.estimator, executor).solve(problem.of(dataset), start) for executor in (None, Executor(2))
    ]
    assert np.array_equal(found[0].values, found[1].values)
    assert [replace(each.verdict, seconds=0.0) for each in found].count(replace(found[0].verdict, seconds=0.0)) == 2
    assert found[0].verdict.starts == 4


def test_workers_keep_blas_to_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """Whatever this process was told."""
    monkeypatch.setenv("OPENBLAS_NUM_THREADS", "2")
    found = Executor(2).map(_blas, [None])
    assert found == ["1"]


@pytest.mark.parametrize(("given", "kept"), [(None, "1"), ("2", "2")])
def test_the_command_keeps_blas_to_one_thread_unless_told(
    monkeypatch: pytest.MonkeyPatch, given: str | None, kept: str
) -> None:
    if given is None:
        monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    else:
        monkeypatch.setenv("OPENBLAS_NUM_THREADS", given)
    monkeypatch.setattr(sys, "argv", ["armcal", "--version"])
    with pytest.raises(SystemExit):
        main()
    assert os.environ["OPENBLAS_NUM_THREADS"] == kept


def _blas(task: None) -> str | None:
    return os.environ.get("OPENBLAS_NUM_THREADS")


@pytest.mark.slow
def test_ctrl_c_stops_all_workers(tmp_path: Path) -> None:
    long = ["study", str(CONFIGS / "study_demo.yaml"), "--out", str(tmp_path / "s"), "--parallel", "2"]
    long += ["--set", "study.folds=100", "--set", "evaluator=interpreted"]
    process = subprocess.Popen(
        [sys.executable, "-m", "armcal.cli", *long],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),
    )
    deadline = time.monotonic() + 60
    while len(_members(process.pid)) < 3 and time.monotonic() < deadline:
        time.sleep(0.2)
    time.sleep(1.0)
    workers = _members(process.pid)
    assert len(workers) >= 3, "no workers were started"
    process.send_signal(signal.SIGINT)
    _, told = process.communicate(timeout=60)
    assert process.returncode == 130 and "stopped by Ctrl-C" in told and "Traceback" not in told
    while _members(process.pid) and time.monotonic() < deadline + 30:
        time.sleep(0.2)
    assert _members(process.pid) == []
    assert not (tmp_path / "s" / "study.json").exists()


def _members(session: int) -> list[int]:
    """Processes of a session that are not mere zombies."""
    found = []
    for place in Path("/proc").glob("[0-9]*"):
        try:
            state, _, _, owner = (place / "stat").read_text().rpartition(")")[2].split()[:4]
        except OSError:
            continue
        if int(owner) == session and state != "Z":
            found.append(int(place.name))
    return found


def test_a_problem_is_its_own_blueprint(lrm) -> None:
    """What is compiled anew elsewhere is what was asked for here."""
    experiment, problem, dataset = _setup(lrm)
    b = problem.blueprint
    again = Problem.build(b.arms, b.measurements, b.parameters, b.environment, dataset, "interpreted")
    assert b.parameters is problem.parameters and b.channels == frozenset(dataset.channels)
    start = experiment.parameters.nominal()
    pair = [np.vstack(p.of(dataset).residuals(start)) for p in (problem, again)]
    assert np.array_equal(*pair)


HOSTILE = ("armcal", "casadi", "encodings_", "joblib", "json", "multiprocessing", "numpy", "pickle", "scipy", "site")
FEW = ("--set", "validation.folds=2", "--set", "evaluator=interpreted", "-q")


@pytest.fixture
def hostile(tmp_path: Path) -> Path:
    """A working directory with files called like libraries, which leave a trace when they are executed."""
    folder = tmp_path / "downloads"
    folder.mkdir()
    for name in HOSTILE:
        trace = tmp_path / f"executed-{name}"
        (folder / f"{name}.py").write_text(f"open({str(trace)!r}, 'w').close()\nraise ImportError('hostile')\n")
    return folder


@pytest.mark.slow
@pytest.mark.parametrize(
    "command",
    [
        ("run", DEMO, "--out", "../out", "--parallel", "2", *FEW),
        pytest.param(
            ("run", DEMO, "--out", "../out", "--parallel", "2", "--set", "uncertainty.bootstrap=20", *FEW),
            marks=pytest.mark.slow,
        ),
        pytest.param(
            ("study", str(CONFIGS / "study_demo.yaml"), "--out", "../out", "--parallel", "2"), marks=pytest.mark.slow
        ),
        pytest.param(
            ("rehearse", str(CONFIGS / "bench.yaml"), "--plan", "../plan.csv", "--out", "../out"),
            marks=pytest.mark.slow,
        ),
        pytest.param(("doctor",), marks=pytest.mark.slow),
    ],
    ids=["run", "bootstrap", "study", "rehearse", "doctor"],
)
def test_no_process_executes_a_file_of_the_working_directory(hostile: Path, command: tuple[str, ...]) -> None:
    """A numpy.py among downloaded data was executed by every worker."""
    start = Path(sys.executable).with_name("armcal")
    if command[0] == "rehearse":
        plan = ["plan", str(CONFIGS / "bench.yaml"), "--poses", "20", "--out", str(hostile.parent / "plan.csv"), "-q"]
        assert CliRunner().invoke(cli, plan).exit_code == 0
    done = subprocess.run([start, *command], cwd=hostile, capture_output=True, text=True, timeout=500, check=False)
    assert [path.name for path in hostile.parent.glob("executed-*")] == []
    assert done.returncode == 0, done.stdout + done.stderr


def test_ctrl_c_as_the_pool_starts_is_an_interrupt_and_no_fault_of_the_library(monkeypatch) -> None:
    """Loky, interrupted before its thread runs, fails to join it."""

    def interrupted(self, tasks):
        try:
            os.kill(os.getpid(), signal.SIGINT)
            yield from map(time.sleep, [5.0])
        except KeyboardInterrupt:
            raise RuntimeError("cannot join thread before it is started") from None

    monkeypatch.setattr("joblib.Parallel.__call__", interrupted)
    before = signal.signal(signal.SIGINT, signal.default_int_handler)  # a shell's background job ignores it
    try:
        with pytest.raises(KeyboardInterrupt):
            Executor(2).map(abs, [1, 2])
    finally:
        signal.signal(signal.SIGINT, before)
