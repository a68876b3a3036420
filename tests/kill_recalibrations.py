"""Recalibrations in one folder, each a process that is killed at a random moment; the last one is let finish.

One process imports everything and forks the others: a thousand kills take a minute.
"""

from __future__ import annotations

import os
import random
import signal
import sys
import time

import fake_recalibrator


def begun(folder, source, at_end):
    """A recalibration in a process of its own."""
    process = os.fork()
    if process:
        return process
    try:
        fake_recalibrator.main(folder, source, at_end)
    except BaseException as fault:
        print(f"{type(fault).__name__}: {fault}", file=sys.stderr, flush=True)
        os._exit(1)
    os._exit(0)


def main(folder, source, kills, seed, longest_s):
    random_ = random.Random(int(seed))
    for _ in range(int(kills)):
        process = begun(folder, source, "wait")
        time.sleep(random_.uniform(0.0, float(longest_s)))
        os.kill(process, signal.SIGKILL)
        _, status = os.waitpid(process, 0)
        if os.WIFEXITED(status):
            sys.exit(1)  # it ended before it was killed: with an error, for it waits for more
    _, status = os.waitpid(begun(folder, source, "stop"), 0)
    sys.exit(os.waitstatus_to_exitcode(status))


if __name__ == "__main__":
    main(*sys.argv[1:])
