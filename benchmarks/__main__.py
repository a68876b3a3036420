"""Run the benchmarks and print one table."""

from __future__ import annotations

import argparse
import fnmatch
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

from rich.console import Console

from benchmarks import (
    batch,
    capability,
    compensate,
    export_c,
    fit_elastic,
    fit_rigid,
    large,
    links,
    online,
    plan,
    serve,
    startup,
    tracker,
)
from benchmarks.report import Row, print_table, write_json


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write the numbers here as well")
    parser.add_argument("--long", action="store_true", help="100,000 poses in the interpreter too")
    parser.add_argument("--only", default="*", metavar="GLOB", help="some, by name")
    chosen = parser.parse_args()
    benchmarks: dict[str, Callable[[], Iterator[Row]]] = {
        "fit_elastic": fit_elastic.run,
        "fit_rigid": fit_rigid.run,
        "batch": batch.run,
        "large": partial(large.run, long=chosen.long),
        "plan": plan.run,
        "capability": capability.run,
        "online": online.run,
        "links": links.run,
        "export_c": export_c.run,
        "serve": serve.run,
        "compensate": compensate.run,
        "startup": startup.run,
        "tracker": tracker.run,
    }
    names = fnmatch.filter(benchmarks, chosen.only)
    if not names:
        parser.error(f"no benchmark is called {chosen.only!r}; there are {', '.join(benchmarks)}")
    progress = Console(stderr=True)
    rows: list[Row] = []
    began = time.perf_counter()
    for name in names:
        progress.print(f"{name} ...", style="dim")
        rows += benchmarks[name]()
    wide = Console(width=None if sys.stdout.isatty() else 160)
    print_table(rows, wide)
    wide.print(f"{time.perf_counter() - began:.0f} s in all", style="dim")
    if chosen.json:
        write_json(rows, chosen.json)


if __name__ == "__main__":
    main()
