"""Kill a writer of a journal again and again at random moments, and look for what it had acknowledged.

Run as ``python journal_killer.py FOLDER KILLS SEED``; prints what is wrong, and how many entries were acknowledged.
"""

from __future__ import annotations

import itertools
import os
import random
import signal
import sys
import time
from pathlib import Path

from armcal.io.journal import Journal, KeptJournal

LIMIT = 200_000


def content(life: int, number: int) -> dict:
    """What a life's n-th entry says; some span several sectors."""
    rng = random.Random(life * 100_003 + number)
    return {"n": number, "life": life, "x": [rng.gauss(0, 1) for _ in range(rng.choice((1, 3, 60)))]}


def live(folder: Path, life: int, tell: int) -> None:
    """Append until killed; a line for each acknowledged entry."""
    with Journal(folder, {"life": life}, LIMIT) as journal:
        number = 0
        while True:
            sequence = journal.record("record", content(life, number))
            os.write(tell, b"%d %d\n" % (sequence, number))
            journal.note("decision", content(life, -number))
            number += 1
            if number % 20 == 0:
                journal.put_checkpoint(content(life, number))


def kill_once(folder: Path, life: int, rng: random.Random) -> int:
    """One life; the number of entries it acknowledged, all of them found again."""
    hear, tell = os.pipe()
    child = os.fork()
    if not child:
        os.close(hear)
        try:
            live(folder, life, tell)
        finally:
            os._exit(1)
    os.close(tell)
    lines = os.fdopen(hear)
    said = list(itertools.islice(lines, rng.randrange(5)))
    time.sleep(rng.uniform(0, 0.003))
    os.kill(child, signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status), f"the writer of life {life} ended by itself"
    with lines:
        said = [tuple(map(int, line.split())) for line in (*said, *lines)]
    with KeptJournal(folder) as journal:
        found = {entry.sequence: entry for entry in journal.entries()}
    # A writer that had the processor for long has filled more than the journal keeps: its oldest entries went.
    oldest = min(found, default=0)
    assert not said or said[-1][0] in found, f"life {life}: its last acknowledged entry is lost"
    for sequence, number in (each for each in said if each[0] >= oldest):
        assert sequence in found, f"life {life}: entry {sequence} was acknowledged and is lost"
        assert found[sequence].content == content(life, number), f"life {life}: entry {sequence} is another"
    return len(said)


def main(folder: str, kills: str, seed: str) -> None:
    """Print the count of acknowledged entries."""
    rng = random.Random(int(seed))
    total = sum(kill_once(Path(folder), life, rng) for life in range(int(kills)))
    with KeptJournal(Path(folder)) as journal:
        journal.verify()
    print(total)


if __name__ == "__main__":
    main(*sys.argv[1:])
