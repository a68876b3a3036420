"""Programs of armcal as processes of their own that start at once: forks of a server that has loaded the libraries.

A fork has its own working directory, environment, modules and standard streams, and can be asked for whatever a new
process can be, but it spares the second of processor time that NumPy, CasADi and armcal's core need to load.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Mapping
from functools import cache
from multiprocessing.context import ForkServerContext
from pathlib import Path

TESTS = Path(__file__).resolve().parent
LONGEST_S = 120
LIBRARIES = ("casadi", "jinja2", "numpy", "pydantic", "rich.console", "scipy.optimize", "scipy.spatial", "yaml")
CORE = ("cli.check", "cli.plugins", "cli.predict", "cli.run", "cli.simulate", "report.page", "run.result")
Ran = subprocess.CompletedProcess[str]


@cache
def _server() -> ForkServerContext:
    """What forks: a process that has loaded the libraries and armcal's core, but no plugin."""
    context = ForkServerContext()
    context.set_forkserver_preload([*LIBRARIES, *(f"armcal.{name}" for name in CORE)])
    return context


def armcal(
    *words: str,
    cwd: Path | None = None,
    path: Path | None = None,
    environment: Mapping[str, str] | None = None,
) -> Ran:
    """One command of armcal.

    Args:
        words: what stands after ``armcal``.
        cwd: the directory it runs in.
        path: a directory whose modules and distributions it finds first, as PYTHONPATH gives it.
        environment: variables beside those of this process.
    """
    code = "from armcal.cli.main import main\nmain()\n"
    return run_code(code, *words, cwd=cwd, path=path, environment=environment)


def run_code(
    code: str,
    *words: str,
    cwd: Path | None = None,
    path: Path | None = None,
    environment: Mapping[str, str] | None = None,
    afresh: bool = False,
) -> Ran:
    """Python code, as ``python -c`` runs it with these words; ``afresh`` has it load armcal's modules itself."""
    variables = {**os.environ, **(environment or {}), "PYTHONPATH": str(path or "")}
    with tempfile.TemporaryDirectory(prefix="armcal-forked-") as place:
        streams = (os.devnull, f"{place}/out", f"{place}/err")
        what = (code, list(words), str(cwd or Path.cwd()), str(path or ""), variables, streams, afresh)
        process = _server().Process(target=_run, args=what)
        process.start()
        process.join(LONGEST_S)
        if process.exitcode is None:
            process.kill()
            raise subprocess.TimeoutExpired(["armcal", *words], LONGEST_S)
        out, err = (Path(stream).read_text(encoding="utf-8") for stream in streams[1:])
        return Ran(["armcal", *words], process.exitcode, out, err)


def _run(
    code: str, words: list[str], cwd: str, path: str, variables: dict[str, str], streams: tuple[str, ...], afresh: bool
) -> None:
    """In the fork: everything as a new process would have it, then the code."""
    for number, stream in enumerate(streams):
        os.dup2(os.open(stream, os.O_RDWR | os.O_CREAT), number)
    sys.stdin, sys.stdout, sys.stderr = (open(n, m, closefd=False) for n, m in enumerate("rww"))  # noqa: SIM115
    os.environ.clear()
    os.environ.update(variables)
    os.chdir(cwd)
    ours = [each for each in sys.path if not Path(each or cwd).is_relative_to(TESTS)]
    sys.path[:] = [cwd, *([path] if path else []), *(each for each in ours if each not in ("", cwd))]
    if afresh:
        for name in [name for name in sys.modules if name.partition(".")[0] == "armcal"]:
            del sys.modules[name]
    sys.argv = ["armcal", *words]
    try:
        exec(compile(code, "<forked>", "exec"), {"__name__": "__main__"})
    finally:
        if "joblib" in sys.modules:  # a fork that ends waits for its workers, where the end of a program ends them
            from joblib.externals.loky import get_reusable_executor

            get_reusable_executor().shutdown(wait=True)
