"""Independent pieces of work, one after another, in processes, in threads or on a cluster, through joblib.

A piece of work is a function of one picklable task; results come in the order of the tasks and are the same to the
last bit wherever they were made, as long as BLAS keeps to one thread there (workers and the command line see to it).
"""

import os
import pickle
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from armcal.errors import ArmcalError, InputError, Location
from armcal.io.signals import Interrupts
from armcal.plugins import blaming

T = TypeVar("T")
R = TypeVar("R")
Report = Callable[[float], None]  # Takes which fraction of the work is done

WORTH_WORKERS_S = 6.0  # Starting worker processes takes a second or two: not worth it for less work than this
_SAFE_PATH = "PYTHONSAFEPATH"
_DASK_TIMEOUT = "10s"
_OPTION = Location("--parallel")
_FORMS = "a number of processes, loky:N, threading:N or dask:ADDRESS"


def unreported(fraction: float) -> None:
    """Tells nobody."""


class Executor(Protocol):
    """Does independent pieces of work."""

    def map(self, work: Callable[[T], R], tasks: Sequence[T], report: Report = unreported) -> list[R]:
        """``work`` of each task, in order; the first exception of any ends it and is raised as it was."""


@dataclass(frozen=True)
class Sequential:
    """One after another in this process."""

    def map(self, work: Callable[[T], R], tasks: Sequence[T], report: Report = unreported) -> list[R]:
        results = []
        for number, task in enumerate(tasks):
            report(number / len(tasks))
            results.append(work(task))
        report(1.0)
        return results


@dataclass(frozen=True)
class Automatic:
    """One after another as long as that is quick; what is left then goes to a process on each processor."""

    worth_s: float = WORTH_WORKERS_S

    def map(self, work: Callable[[T], R], tasks: Sequence[T], report: Report = unreported) -> list[R]:
        """As the protocol says."""
        results: list[R] = []
        began = time.perf_counter()
        for number, task in enumerate(tasks):
            done, left = number / len(tasks), len(tasks) - number
            report(done)
            spent = time.perf_counter() - began
            if number and left > 1 and spent / number * left > self.worth_s and _picklable((work, task)):
                break
            results.append(work(task))
        else:
            report(1.0)
            return results
        return results + Workers().map(work, tasks[number:], lambda more: report(done + (1 - done) * more))


@dataclass(frozen=True)
class Workers:
    """A joblib backend."""

    backend: str = "loky"  # ``loky`` (processes), ``threading`` or ``dask``
    count: int | None = None  # how many at once; as many as there are processors, or the cluster's own number, if None
    address: str = ""  # of a dask scheduler

    def map(self, work: Callable[[T], R], tasks: Sequence[T], report: Report = unreported) -> list[R]:
        """As the protocol says.

        Raises:
            InputError: the cluster is not there, or a task cannot be sent to another process.
            ArmcalError: a worker process ended without an answer.
        """
        import joblib

        if not tasks:
            return []
        if self.backend != "threading" and not _picklable((work, tasks[0])):
            raise InputError(
                "a component of this problem cannot be sent to another process.",
                where=_OPTION,
                hint="Use --parallel 1, or --parallel threading:2.",
            )
        results: list[R] = []
        try:
            with self._configured(), Interrupts() as interrupts:
                report(0.0)
                # One at a time: a batch might hold all the long ones.
                at_work = joblib.Parallel(return_as="generator", batch_size=1)
                for result in at_work(joblib.delayed(blaming(work))(task) for task in tasks):
                    results.append(result)
                    report(len(results) / len(tasks))
        except BrokenProcessPool as fault:
            text = f"a worker process ended without an answer ({str(fault).splitlines()[0]})"
            raise ArmcalError(text, where=_OPTION, hint="If memory was short, take fewer processes.") from fault
        except RuntimeError as fault:  # of loky, which is interrupted as it starts, and cannot end what has not begun
            if interrupts.came:
                raise KeyboardInterrupt from fault
            raise
        return results

    @contextmanager
    def _configured(self) -> Iterator[None]:
        import joblib

        count = self.count or (joblib.cpu_count() if self.backend in ("loky", "threading") else -1)
        options: dict[str, Any] = {"backend": self.backend, "n_jobs": count}
        if self.backend == "loky":
            options["inner_max_num_threads"] = 1
        if self.backend == "dask":
            with _dask_client(self.address) as client, joblib.parallel_config(**options, client=client):
                yield
            return
        # Processes started meanwhile do not take a file of the working directory for a library, as the command does
        # not. Loky starts them by ``python -m``, which looks there first, and has no argument for it.
        before = os.environ.get(_SAFE_PATH)
        os.environ[_SAFE_PATH] = "1"
        try:
            with joblib.parallel_config(**options):
                yield
        finally:
            if before is None:
                del os.environ[_SAFE_PATH]
            else:
                os.environ[_SAFE_PATH] = before


def parse_executor(text: str) -> Executor:
    """What ``--parallel`` says.

    Raises:
        InputError: none of the forms.
    """
    backend, _, rest = text.strip().partition(":")
    if text.strip() == "auto":
        return Automatic()
    if backend.isdecimal() and not rest:
        backend, rest = "loky", backend
    if backend in ("loky", "threading") and rest.isdecimal() and 1 <= int(rest) <= 1024:
        return Sequential() if int(rest) == 1 else Workers(backend, int(rest))
    if backend == "dask" and rest:
        return Workers(backend, address=rest)
    raise InputError(f"found {text!r}, expected {_FORMS}.", where=_OPTION, hint="For example --parallel 4.")


def _picklable(what: object) -> bool:
    try:
        pickle.dumps(what)
    except Exception:  # each library has its own way of refusing
        return False
    return True


@contextmanager
def _dask_client(address: str) -> Iterator[Any]:
    try:
        from distributed import Client
    except ImportError as fault:
        hint = 'Install it: pip install "dask[distributed]".'
        raise InputError(f"dask's cluster library is not there ({fault}).", where=_OPTION, hint=hint) from fault
    try:
        client = Client(address, timeout=_DASK_TIMEOUT, set_as_default=False)
    except (OSError, ValueError) as fault:
        hint = "Give the scheduler's address, such as dask:tcp://127.0.0.1:8786."
        raise InputError(f"no dask scheduler answers at {address} ({fault}).", where=_OPTION, hint=hint) from fault
    with client:
        yield client
