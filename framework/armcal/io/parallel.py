"""Independent pieces of work, one after another or in processes, through joblib.

A piece of work is a function of one picklable task; results come in the order of the tasks and are the same to the
last bit wherever they were made, as long as BLAS keeps to one thread there (workers and the command line see to it).
"""

import os
import pickle
import time
from collections.abc import Callable, Sequence
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import TypeVar

from armcal.errors import ArmcalError, InputError, Location
from armcal.io.signals import Interrupts
from armcal.plugins import blaming

T = TypeVar("T")
R = TypeVar("R")
Report = Callable[[float], None]  # Takes which fraction of the work is done

MOST_PROCESSES = 1024
_SAFE_PATH = "PYTHONSAFEPATH"
_OPTION = Location("--parallel")


def unreported(fraction: float) -> None:
    pass


@dataclass(frozen=True)
class Executor:
    """Does independent pieces of work in this process (1) or in several others.

    Where their number is not stated, here as long as that is quick; what remains then goes to a process on each
    processor.
    """

    processes: int | None = None
    worth_s: float = 6.0  # starting worker processes takes a second or two: not worth it for less work than this

    def map(self, work: Callable[[T], R], tasks: Sequence[T], report: Report = unreported) -> list[R]:
        """``work`` of each task, in order; the first exception of any ends it and is raised as it was."""
        results: list[R] = []
        began = time.perf_counter()
        for number, task in enumerate(tasks):
            report(number / len(tasks))
            hands_over = (self.processes or 1) > 1
            if self.processes is None and number and (remaining := len(tasks) - number) > 1:
                spent = time.perf_counter() - began
                hands_over = spent / number * remaining > self.worth_s and _picklable((work, task))
            if hands_over:
                break
            results.append(work(task))
        else:
            report(1.0)
            return results
        import joblib

        tasks, count = tasks[len(results) :], len(tasks)
        if not _picklable((work, tasks[0])):
            text = "a component of this problem cannot be sent to another process."
            raise InputError(text, where=_OPTION, hint="Use --parallel 1.")
        # Processes started meanwhile do not take a file of the working directory for a library, as the command does
        # not. Loky starts them by ``python -m``, which looks there first, and has no argument for it.
        before = os.environ.get(_SAFE_PATH)
        os.environ[_SAFE_PATH] = "1"
        options = {"backend": "loky", "n_jobs": self.processes or joblib.cpu_count(), "inner_max_num_threads": 1}
        try:
            with joblib.parallel_config(**options), Interrupts() as interrupts:
                # One at a time: a batch might hold all the long ones.
                at_work = joblib.Parallel(return_as="generator", batch_size=1)
                for result in at_work(joblib.delayed(blaming(work))(task) for task in tasks):
                    results.append(result)
                    report(len(results) / count)
        except BrokenProcessPool as fault:
            text = f"a worker process ended without an answer ({str(fault).splitlines()[0]})"
            raise ArmcalError(text, where=_OPTION, hint="If memory was short, take fewer processes.") from fault
        except RuntimeError as fault:  # of loky, which is interrupted as it starts, and cannot end what has not begun
            if interrupts.finish:
                raise KeyboardInterrupt from fault
            raise
        finally:
            if before is None:
                del os.environ[_SAFE_PATH]
            else:
                os.environ[_SAFE_PATH] = before
        report(1.0)
        return results


def parse_executor(text: str) -> Executor:
    text = text.strip()
    if text == "auto":
        return Executor()
    if text.isdecimal() and 1 <= int(text) <= MOST_PROCESSES:
        return Executor(int(text))
    hint = "For example --parallel 4."
    raise InputError(f"found {text!r}, expected auto or a number of processes.", where=_OPTION, hint=hint)


def _picklable(what: object) -> bool:
    try:
        pickle.dumps(what)
    except Exception:  # each library has its own way of refusing
        return False
    return True
