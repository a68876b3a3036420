"""The golden set: what armcal's commands give, recorded, and compared with what they give now.

``python -m tests.golden`` runs every entry through the real command line in a folder of its own and prints each
difference: command, file, key, expected, found. Names (globs) select entries, ``--write`` records anew, ``--list``
lists them, ``-j N`` runs N at once. The entries are the table at the end of this file; what was recorded is in
``tests/data/golden.json``, a line a value. Entries with data in ``../shared/data`` are skipped where it is absent.

Text is compared word for word: findings, reasons, states, names. Whole numbers are compared exactly. Other numbers may
differ by a millionth of their scale (``RELATIVE``): a converged fit is repeated to about 1e-9 whichever way its sums
are ordered, an iteration that stops at 1e-8 to about 1e-7; a digit that a user would see is never so small. The scale
of a number is its own size; that of a parameter at least its standard deviation; that of a vector, a matrix or a column
its largest entry. A nanometre or a millionth of a degree is nothing. CSV files print so many decimals, and the last one
may be rounded either way. Functions are interpreted, with one thread, so that neither compilers nor processors matter.
Times, paths, hashes, versions and durations are not recorded.
"""

from __future__ import annotations

import argparse
import csv
import fnmatch
import itertools
import json
import math
import os
import re
import shlex
import shutil
import subprocess
import sys
import tempfile
import time
import traceback
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from multiprocessing import get_context
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
SHARED = ROOT.parent / "shared" / "data"
RECORDED = ROOT / "tests" / "data" / "golden.json"
FORK = get_context("fork")
LONGEST_S = 400.0
RELATIVE, ABSOLUTE = 1e-6, 1e-12
WHOLE = 12  # entries of a list, or rows of a table, that are kept one by one; of longer ones sums and three of them
VOLATILE = re.compile(
    r"created|software|identity|provenance|.*sha256|digest|seconds|.*(?:took|waited)_m?s|elapsed.*|duration.*|written|started_at|source|path"
    r"|out|folder|files?|version|plugins|host|pid|port|armcal_\w+|schema.*"
)
REPEATED = re.compile(r"arms|verdict|quality_\w+")  # of a calibration: what its configuration and metrics.json say too
Leaf = Any  # text, number, None, a list of numbers, or a dictionary of a column's sums and rows
Record = dict[str, Leaf]


# ---------------------------------------------------------------- running


@dataclass
class Place:
    """Where an entry runs: a folder with a copy of ``configs`` and, in ``runs``, a folder for each entry."""

    root: Path
    name: str
    outputs: list[str] = field(default_factory=list)  # standard output of each command
    codes: list[int] = field(default_factory=list)  # exit code of each

    @property
    def out(self) -> Path:
        return self.root / "runs" / self.name

    def filled(self, text: str) -> str:
        return text.replace("{out}", f"runs/{self.name}").replace("{shared}", str(SHARED))

    def armcal(self, line: str, given: str = "", until: Callable[[], bool] | None = None) -> None:
        """Run a command to its end, or kill it (SIGKILL) as soon as something holds."""
        words = shlex.split(self.filled(line))
        ended, number = time.monotonic() + LONGEST_S, len(self.codes)
        files = [self.out.with_name(f"{self.name}.{number}.{end}") for end in ("in", "out", "err")]
        files[0].write_text(given)
        process = FORK.Process(target=_in_fork, args=(["armcal", *words], self.root, files))
        process.start()
        while process.exitcode is None and time.monotonic() < ended and not (until and until()):
            process.join(0.02 if until else LONGEST_S)
        if process.exitcode is None:
            process.kill()
            process.join()
        self.codes.append(int(process.exitcode or 0))
        self.outputs.append(files[1].read_text())
        if "Traceback (most" in (said := files[2].read_text()):
            raise RuntimeError(f"armcal {line}\nexit {process.exitcode}\n{said[-2000:]}")


def _in_fork(words: list[str], root: Path, files: list[Path]) -> None:
    from armcal.cli.main import main
    from joblib.externals.loky import get_reusable_executor

    os.chdir(root)
    for path, number in zip(files, range(3), strict=True):
        os.dup2(os.open(path, os.O_RDWR | os.O_CREAT), number)
    sys.stdin, sys.stdout, sys.stderr = (open(n, m, closefd=False) for n, m in enumerate("rww"))  # noqa: SIM115
    sys.argv = words
    try:
        main()
    finally:
        get_reusable_executor().shutdown(wait=True)


Step = str | Callable[[Place], None]


@dataclass(frozen=True)
class Entry:
    name: str
    does: str
    steps: tuple[Step, ...]  # commands of armcal (``{out}`` is the entry's folder), or functions
    reads: tuple[str, ...]  # its files, globs too (``FILE:COLUMN,...``); ``0.out``: what the first command printed
    needs: tuple[str, ...] = ()  # entries whose folders it uses

    @property
    def shared(self) -> str:
        found = [m[1] for step in self.steps if isinstance(step, str) if (m := re.search(r"\{shared\}/(\w+)", step))]
        return found[0] if found else ""


def run(entry: Entry, root: Path) -> dict[str, Record]:
    """What came of it: a record for each file that is read, and the exit codes."""
    place = Place(root, entry.name)
    place.out.mkdir(parents=True)
    for step in entry.steps:
        if isinstance(step, str):
            place.armcal(step)
        else:
            step(place)
    found: dict[str, Record] = {"exit codes": {"": place.codes}}
    for read in entry.reads:
        name, _, columns = read.partition(":")
        if re.fullmatch(r"\d+\.out", name):
            found[name] = record_of_text(place.outputs[int(name[:-4])], root)
        else:
            for path in sorted(place.out.glob(name)) or [place.out / name]:
                record = record_of(path, root)
                kept = {k: v for k, v in record.items() if not columns or k in ("rows", *columns.split(","))}
                found[str(path.relative_to(place.out))] = kept
    return found


# ---------------------------------------------------------------- what is recorded of a file


def record_of(path: Path, root: Path) -> Record:
    """Of a file, by its kind."""
    text = path.read_text()
    if path.suffix == ".csv":
        return dict(_columns(list(csv.DictReader(text.splitlines()))))
    if path.suffix in (".yaml", ".yml"):
        content = yaml.load(text, yaml.CSafeLoader)
        if "armcal_calibration" in content:
            content = {k: v for k, v in content.items() if not REPEATED.fullmatch(k)}
        return dict(_leaves("", content, root))
    if path.suffix in (".urdf", ".xml"):
        return dict(_elements("", ElementTree.fromstring(text)))
    return record_of_text(text, root)


def record_of_text(text: str, root: Path) -> Record:
    """JSON, JSON lines, or lines of words."""
    try:
        return dict(_leaves("", json.loads(text), root))
    except ValueError:
        pass
    lines = text.splitlines()
    try:
        return dict(_leaves("", [json.loads(line) for line in lines], root))
    except ValueError:
        return {str(i): _plain(line, root) for i, line in enumerate(lines)}


def _plain(text: str, root: Path) -> str:
    text = re.sub(r"\b20\d\d-\d\d-\d\dT[\d:.+Z-]+", "TIME", text)
    return text.replace(str(root), "ROOT").replace(str(SHARED), "SHARED").replace(str(ROOT), "REPOSITORY")


def _leaves(key: str, value: Any, root: Path) -> Iterator[tuple[str, Leaf]]:
    """A document, flat: dotted keys, items of lists by their name where they have one."""
    if isinstance(value, Mapping):
        value = {str(name): one for name, one in value.items() if not VOLATILE.fullmatch(str(name))}
        if (
            key
            and value
            and len(value) <= WHOLE
            and all(x is None or isinstance(x, int | float) for x in value.values())
        ):
            yield key, {name: _short(x) if isinstance(x, float) else x for name, x in value.items()}
            return
        for name, one in value.items():
            yield from _leaves(f"{key}.{name}" if key else name, one, root)
    elif isinstance(value, list) and value and all(isinstance(x, Mapping) for x in value):
        yield from _items(key, value, root)
    elif isinstance(value, list) and _numeric(value):
        yield key, _array(value)
    elif isinstance(value, list) and all(isinstance(x, str) and len(x) < 40 for x in value):
        yield key, _joined([_plain(x, root) for x in value])
    elif isinstance(value, list):
        for i, one in enumerate(value):
            yield from _leaves(f"{key}.{i}" if key else str(i), one, root)
    elif isinstance(value, float):
        yield key, _short(value)
    elif isinstance(value, int | bool) or value is None:
        yield key, value
    else:
        yield key, _plain(str(value), root)


def _items(key: str, items: list[Mapping[str, Any]], root: Path) -> Iterator[tuple[str, Leaf]]:
    """A list of mappings: each, or of a long one its columns, and the value of each that has a name."""
    names = [str(x.get("name", i)) for i, x in enumerate(items)]
    named = len(set(names)) == len(names) and all("name" in x for x in items)
    names = names if named else [str(i) for i in range(len(items))]
    if len(items) <= WHOLE:
        for name, one in zip(names, items, strict=True):
            rest = {k: v for k, v in one.items() if not (named and k == "name")}
            yield from _leaves(f"{key}.{name}" if key else name, rest, root)
        return
    yield f"{key} (items)", len(items)
    for column in dict.fromkeys(k for one in items for k in one if not VOLATILE.fullmatch(str(k))):
        cells = [one.get(column) for one in items]
        here = f"{key} ({column})"
        if named and column in ("value", "sd"):
            yield from ((f"{key}.{name}.{column}", x) for name, x in zip(names, cells, strict=True) if x is not None)
        elif all(x is None or isinstance(x, int | float) for x in cells):
            yield here, _sums(np.array([math.nan if x is None else x for x in cells], dtype=float))
        elif all(x is None or (isinstance(x, str) and len(x) < 40) for x in cells):
            yield here, _joined([_plain(x or "", root) for x in cells])
        else:
            for name, one in zip(names, cells, strict=True):
                yield from _leaves(f"{key}.{name}.{column}", one, root)


def _joined(words: list[str]) -> str:
    """Many short words as one text, or as its checksum."""
    text = ", ".join(words)
    return (
        text
        if len(text) < 1500
        else f"checksum {zlib.crc32(text.encode()):08x} of {len(words)}: {words[0]} ... {words[-1]}"
    )


def _numeric(value: Any) -> bool:
    if isinstance(value, list):
        return bool(value) and all(map(_numeric, value))
    return isinstance(value, int | float) and not isinstance(value, bool)


def _array(value: list[Any]) -> Leaf:
    try:
        whole = np.array(value, dtype=float)
    except ValueError:  # rows of several lengths
        whole = np.concatenate([np.ravel(row) for row in value]).astype(float)
    if whole.ndim == 1 and len(whole) <= WHOLE:
        return [_short(x) for x in whole]
    return {"shape": "x".join(map(str, whole.shape)), **_sums(whole.ravel())}


def _sums(numbers: np.ndarray, decimals: int | None = None) -> dict[str, Any]:
    """Of many numbers: their sum, a sum that their order matters to, the largest, and three of them."""
    finite = np.nan_to_num(numbers, nan=0.0, posinf=0.0, neginf=0.0)
    weights = np.linspace(0.0, 1.0, len(numbers))
    found: dict[str, Any] = {"count": len(numbers), "finite": int(np.isfinite(numbers).sum())}
    found |= {"sum": _short(finite.sum()), "weighted": _short(finite @ weights)}
    found |= {"largest": _short(np.abs(finite).max(initial=0.0))}
    found["some"] = [_short(numbers[i]) for i in sorted({0, len(numbers) // 2, len(numbers) - 1})]
    return found if decimals is None else {**found, "decimals": decimals}


def _short(x: float) -> float:
    return float(f"{x:.13g}")


def _columns(rows: Sequence[Mapping[str, str]]) -> Iterator[tuple[str, Leaf]]:
    """Of a table: numbers by their sums and some rows, words by a checksum and some rows."""
    yield "rows", len(rows)
    for name in rows[0] if rows else ():
        cells = [row[name] or "" for row in rows]
        try:
            numbers = np.array([float(cell or "nan") for cell in cells])
        except ValueError:
            yield name, _joined(cells)
            continue
        decimals = max(len(cell.partition(".")[2]) if "e" not in cell else 16 for cell in cells)
        yield name, _sums(numbers, decimals)


def _elements(key: str, element: ElementTree.Element) -> Iterator[tuple[str, Leaf]]:
    """XML, flat: elements by their name, and what their attributes say."""
    here = f"{key}/{element.tag}" + (f"[{element.get('name')}]" if element.get("name") else "")
    for name, text in element.attrib.items():
        try:
            yield f"{here}@{name}", [float(x) for x in text.split()]
        except ValueError:
            yield f"{here}@{name}", text
    tags = [child.tag + child.get("name", "") for child in element]
    for i, child in enumerate(element):
        again = tags[:i].count(tags[i])
        yield from _elements(here + (f"#{again}" if again else ""), child)


# ---------------------------------------------------------------- comparing


def differences(expected: Record, found: Record) -> list[tuple[str, Leaf, Leaf]]:
    """Key, expected, found of each value that differs; None stands for what is not there."""
    wrong: list[tuple[str, Leaf, Leaf]] = []
    for key in dict.fromkeys([*expected, *found]):
        one, other = expected.get(key), found.get(key)
        if key not in expected or key not in found or not same(one, other, _spread(key, expected), _unit(key)):
            wrong.append((key, one if key in expected else "(nothing)", other if key in found else "(nothing)"))
    return wrong


def _unit(key: str) -> float:
    """What is nothing of a quantity: a nanometre, a millionth of a degree; hardly anything of another."""
    return 1e-6 if re.search(r"_(mm|deg)\b", key) else ABSOLUTE


def _spread(key: str, record: Record) -> float:
    """The standard deviation beside a parameter's value, which is its scale where it is larger."""
    beside = record.get(f"{key.removesuffix('.value')}.sd") if key.endswith(".value") else 0.0
    return abs(beside) if isinstance(beside, int | float) else 0.0


def same(one: Leaf, other: Leaf, scale: float = 0.0, least: float = ABSOLUTE) -> bool:
    """Whether two leaves are the same but for what rounding does."""
    if isinstance(one, dict) and isinstance(other, dict):
        if "weighted" in one:
            return one.keys() == other.keys() and _same_sums(one, other, least)
        spread = abs(one.get("sd") or 0.0)
        return one.keys() == other.keys() and all(
            same(one[k], other[k], spread * (k == "value"), max(least, _unit(k))) for k in one
        )
    if isinstance(one, list) and isinstance(other, list):
        largest = max((abs(x) for x in one if isinstance(x, int | float) and math.isfinite(x)), default=0.0)
        return len(one) == len(other) and all(same(a, b, largest, least) for a, b in zip(one, other, strict=True))
    if isinstance(one, float) and isinstance(other, int | float) and not isinstance(other, bool):
        if not (math.isfinite(one) and math.isfinite(other)):
            return repr(one) == repr(float(other))
        return abs(one - other) <= least + RELATIVE * max(abs(one), scale)
    return type(one) is type(other) and one == other


def _same_sums(one: dict[str, Any], other: dict[str, Any], least: float) -> bool:
    count, scale, digit = one["count"], one["largest"], 1.1 * 10.0 ** -one.get("decimals", 16)
    for key in one:
        if key in ("sum", "weighted", "largest"):
            allowed = (least + RELATIVE * scale + digit) * (1 if key == "largest" else math.sqrt(count))
            if abs(one[key] - other[key]) > allowed:
                return False
        elif key == "some":
            if not all(same(a, b, scale + digit / RELATIVE, least) for a, b in zip(one[key], other[key], strict=True)):
                return False
        elif key != "decimals" and one[key] != other[key]:
            return False
    return True


def shown(value: Leaf) -> str:
    text = value if isinstance(value, str) else json.dumps(value)
    return text if len(text) < 400 else text[:400] + " ..."


# ---------------------------------------------------------------- the whole set


def load_everything() -> None:
    """What each command would load anew: they run in forks of this process."""
    import armcal.cli.main  # noqa: F401
    import casadi  # noqa: F401
    import cvxpy  # noqa: F401
    import matplotlib.pyplot  # noqa: F401
    import scipy.optimize
    import scipy.stats  # noqa: F401
    from armcal.plugins import discover

    discover()


def chosen(patterns: Sequence[str]) -> list[Entry]:
    """By names or globs, with what they need, in the table's order."""
    unknown = [p for p in patterns if not fnmatch.filter([e.name for e in ENTRIES], p)]
    if unknown:
        sys.exit(f"golden: no entry is called {', '.join(unknown)}; --list shows them")
    wanted = {e.name for e in ENTRIES if not patterns or any(fnmatch.fnmatch(e.name, p) for p in patterns)}
    for entry in reversed(ENTRIES):
        wanted |= set(entry.needs) if entry.name in wanted else set()
    return [entry for entry in ENTRIES if entry.name in wanted]


def outcomes(
    entries: Sequence[Entry], root: Path, at_once: int
) -> Iterator[tuple[Entry, dict[str, Record] | str, float]]:
    """Each entry, run in a fork of this process: its records, or what went wrong, and how long it took."""
    waiting, running, done = list(entries), dict[Connection, tuple[Entry, Any, float]](), set[str]()
    while waiting or running:
        ready = [e for e in waiting if done.issuperset(e.needs)]
        for entry in ready[: at_once - len(running)]:
            waiting.remove(entry)
            ours, theirs = FORK.Pipe(duplex=False)
            process = FORK.Process(target=_send, args=(entry, root, theirs))
            process.start()
            theirs.close()
            running[ours] = (entry, process, time.monotonic())
        for ours in wait(list(running)):
            entry, process, began = running.pop(ours)
            try:
                found = ours.recv()
            except EOFError:
                found = "its process ended"
            process.join()
            done.add(entry.name)
            yield entry, found, time.monotonic() - began


def _send(entry: Entry, root: Path, pipe: Connection) -> None:
    try:
        pipe.send(run(entry, root))
    except Exception:
        pipe.send(traceback.format_exc(limit=-2))


def main(words: Sequence[str]) -> int:
    """Compare or record; 1 if anything differs."""
    parser = argparse.ArgumentParser(prog="python -m tests.golden", description=__doc__.partition("\n")[0])
    parser.add_argument("names", nargs="*", help="entries to run, globs too [default: all]")
    parser.add_argument("--write", action="store_true", help="record what they give now")
    parser.add_argument("--list", action="store_true", help="list the entries")
    parser.add_argument("-j", type=int, default=1, metavar="N", help="so many at once")
    parser.add_argument("--keep", type=Path, help="run in this folder, and leave it")
    asked = parser.parse_args(words)
    entries = chosen(asked.names)
    if asked.list:
        for entry in entries:
            print(f"{entry.name:24} {entry.does}" + (f"  [shared: {entry.shared}]" if entry.shared else ""))
        return 0
    os.environ.update(ARMCAL_CC="none", OPENBLAS_NUM_THREADS="1", OMP_NUM_THREADS="1", MKL_NUM_THREADS="1")
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    load_everything()
    with tempfile.TemporaryDirectory(prefix="armcal-golden-") as place:
        root = asked.keep.resolve() if asked.keep else Path(place)
        shutil.copytree(ROOT / "configs", root / "configs", dirs_exist_ok=True)
        os.environ["ARMCAL_CACHE_DIR"] = str(root / "cache")
        return compare_or_write(entries, root, asked.j, asked.write)


def compare_or_write(entries: Sequence[Entry], root: Path, at_once: int, write: bool) -> int:
    recorded = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    began, wrong, done = time.monotonic(), 0, 0
    skipped = {e.name for e in entries if e.shared and not (SHARED / e.shared).is_dir()}
    for entry in entries:
        if set(entry.needs) & skipped:
            skipped.add(entry.name)
    for name in sorted(skipped):
        print(f"skip {name}: it needs data in {SHARED}", flush=True)
    for entry, found, took in outcomes([e for e in entries if e.name not in skipped], root, at_once):
        done += 1
        if isinstance(found, str):
            wrong += 1
            print(f"FAIL {entry.name}\n{found}", flush=True)
            continue
        before = recorded.get(entry.name, {})
        lines = [
            f"  {file}: {key}\n    expected {shown(a)}\n    found    {shown(b)}"
            for file in dict.fromkeys([*before, *found])
            for key, a, b in differences(before.get(file, {}), found.get(file, {}))
        ]
        lines = [] if write and not before else lines
        wrong += bool(lines)
        print(f"{'FAIL' if lines else 'ok  '} {took:5.1f} s  {entry.name}", *lines, sep="\n", flush=True)
        if write:
            recorded[entry.name] = found
            RECORDED.write_text(written({e.name: recorded[e.name] for e in ENTRIES if e.name in recorded}))
        elif lines:
            print("  of", *(s if isinstance(s, str) else s.__name__ for s in entry.steps), sep="\n     ", flush=True)
    print(f"{done} done, {wrong} differ, {len(skipped)} skipped, in {time.monotonic() - began:.0f} s")
    return int(wrong > 0 and not write)


def written(recorded: Mapping[str, Mapping[str, Record]]) -> str:
    """As JSON, a line a value."""
    lines = ["{"]
    for e, (name, files) in enumerate(recorded.items()):
        lines.append(f"{json.dumps(name)}: {{")
        for f, (file, values) in enumerate(files.items()):
            lines.append(f" {json.dumps(file)}: {{")
            rows = [f"  {json.dumps(k)}: {json.dumps(v, ensure_ascii=False)}" for k, v in values.items()]
            lines.append(",\n".join(rows))
            lines.append(" }" + "," * (f + 1 < len(files)))
        lines.append("}" + "," * (e + 1 < len(recorded)))
    return "\n".join(line for line in lines if line) + "\n}\n"


# ---------------------------------------------------------------- the entries

FIT = ("calibration.yaml", "metrics.json", "residuals.csv")


def entry(name: str, does: str, *steps: Step, reads: Sequence[str] = FIT, needs: Sequence[str] = ()) -> Entry:
    return Entry(name, does, steps, tuple(reads), tuple(needs))


def page(name: str, *titles: str) -> Step:
    """Files that a page of the documentation shows, into the entry's folder."""

    def files(place: Place) -> None:
        text = (ROOT / "docs" / name).read_text()
        for title in titles:
            found = re.search(rf'^```\w+ title="{re.escape(title)}"\n(.*?)^```', text, re.M | re.S)
            assert found, title
            (place.out / title).write_text(found[1])

    return files


def text(name: str, content: str) -> Step:
    """A file in the entry's folder."""

    def file(place: Place) -> None:
        (place.out / name).write_text(content)

    return file


def grid(name: str, *levels: Sequence[float]) -> Step:
    """Targets at the nodes of a grid, row by row to and fro, the tool turned by half a turn, with 50 g."""

    def nodes(place: Place) -> None:
        number = {node: i for i, node in enumerate(itertools.product(*levels), 1)}
        rows = ["pose_id,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg,payload_g"]
        for i, x in enumerate(levels[0]):
            for j, y in enumerate(levels[1][:: (-1) ** i]):
                for z in levels[2][:: (-1) ** (i * len(levels[1]) + j)]:
                    rows.append(f"{number[x, y, z]},{x},{y},{z},0,0,180,50")
        (place.out / name).write_text("\n".join(rows) + "\n")

    return nodes


def thinned(source: str, name: str, every: int) -> Step:
    """Each so many rows of a CSV file, into the entry's folder."""

    def rows(place: Place) -> None:
        head, *lines = (place.root / source).read_text().splitlines()
        (place.out / name).write_text("\n".join([head, *lines[::every]]) + "\n")

    return rows


def typed(line: str, given: str) -> Step:
    """A command in a process of its own, and what it reads from its standard input."""

    def command(place: Place) -> None:
        words = [sys.executable, "-m", "armcal.cli", *shlex.split(place.filled(line))]
        done = subprocess.run(words, input=given, capture_output=True, text=True, cwd=place.root, check=False)
        place.codes.append(done.returncode)
        place.outputs.append(done.stdout)

    return command


def c_self_test(place: Place) -> None:
    """The exported C code and its test program, compiled and run."""
    for source in sorted(place.out.glob("*_test.c")):
        files = [source, source.with_name(source.name.replace("_test.c", ".c"))]
        program = source.with_suffix("")
        subprocess.run(["cc", "-std=c99", "-O1", *files, "-lm", "-o", program], check=True)
        done = subprocess.run([program], check=False, capture_output=True, text=True)
        program.with_suffix(".txt").write_text(f"exit {done.returncode}\n{done.stdout}")


LRM = "{shared}/lrm_arm/poses.csv"
MUKCA = {
    "panda-front_center": "panda_2_clean",
    "kuka-front": "kuka_14",
    "kuka-left_back": "kuka_14",
    "kinova-left": "dinova_1",
    "kinova-lower_left": "dinova_1",
    "kinova-front": "dinova_1",
}
RANKS = (
    "one_known_point",
    "one_unknown_point",
    "several_points",
    "dual_known_clamp",
    "dual_one_known_arm",
    "dual_twists",
    "dual_twists_tools_held",
    "twists_and_offsets",
    "wrong_clamp",
)
LEAST = (
    "identify configs/lrm_arm/all_45.yaml --data configs/lrm_arm/demo.csv --most 28 --prefer 'arm.mdh.alpha[2-5]'"
    " --prefer 'arm.spring.k?' --prefer 'arm.mdh.a[3-5]' --prefer 'arm.mdh.theta?' --prefer 'arm.mdh.d[45]'"
    " --prefer 'arm.mdh.base_[xyz]' --prefer 'arm.mdh.tool_[yz]' --prefer arm.mdh.after2_z --json"
)
POSES = (
    "pose_id,x_mm,y_mm,z_mm,roll_deg,pitch_deg,yaw_deg\n1,403,90,67,180,0,90\n2,240,-60,260,180,10,0\n3,900,0,0,0,0,0\n"
)
LOADED = "pose_id,x_mm,y_mm,z_mm,payload_g\nnone,200,50,300,0\nsome,200,50,300,60\nmuch,200,50,300,130\n"
ASKED = "\n".join(
    map(
        json.dumps,
        [
            {"id": 1, "do": "forward", "joint_angles_deg": [10, -20, 30, 40, -50, 60]},
            {"id": 2, "do": "forward", "joint_angles_deg": [10, -20, 30, 40, -50, 60], "payload_g": 100},
            {"id": 3, "do": "compensate", "targets": [{"position_mm": [403, 90, 67]}], "units": "deg"},
            {"id": 4, "do": "compensate", "targets": [{"position_mm": [1403, 90, 67]}], "units": "deg"},
            {"id": 5, "do": "compensate", "targets": [{"position_mm": [403, 90, 67], "rpy_deg": [180, 0, 90]}],
             "start_deg": [0, 0, 0, 0, 0, 0]},
            {"id": 6, "do": "compensate", "path": True, "targets": [{"position_mm": [240, y, 260]} for y in (-9, 9)]},
            {"id": 7, "do": "forward", "joint_angels_deg": [1]},
            {"id": 8, "do": "forward", "joint_angles_deg": [10, -20]},
        ],
    )
)  # fmt: skip

ENTRIES: tuple[Entry, ...] = (
    entry("lrm-demo", "the simulated LRM arm, option 1", "run configs/lrm_arm/demo.yaml --out {out} -q"),
    *(
        entry(
            f"lrm-option{i}",
            f"option {i} on the 313 measured poses",
            f"run configs/lrm_arm/option{i}.yaml --data {LRM} --out {{out}} -q --accept",
        )
        for i in range(1, 6)
    ),
    entry(
        "lrm-published-50",
        "option 1 on the published 50 poses, k0 to k6",
        f"run configs/lrm_arm/option1.yaml --data {LRM} --out {{out}} -q --accept --set parameters.bounds=none"
        " --set validation.train_ids={shared}/lrm_arm/published_50.csv",
    ),
    entry("lrm-check", "what is known before solving", "check configs/lrm_arm/demo.yaml --json", reads=["0.out"]),
    entry("identify", "which of 45 parameters are determined; 28 of them", LEAST, reads=["0.out"]),
    entry(
        "study",
        "three variants compared",
        "study configs/lrm_arm/study_demo.yaml --out {out} -q",
        reads=["*.json", "*.csv"],
    ),
    entry(
        "load-transfer",
        "fitted with one payload, judged with another, both ways",
        "study configs/lrm_arm/load_transfer.yaml --out {out} -q",
        reads=["study.csv"],
    ),
    entry(
        "capability-designs",
        "designs of the arm compared",
        "capability configs/lrm_arm/designs.yaml --out {out} -q --set capability.samples=200"
        " --set capability.voxel_mm=100 --set capability.postures=2",
        reads=["areas.csv", "capability.json"],
    ),
    entry(
        "predict",
        "where the calibrated arm goes",
        "predict runs/lrm-demo/calibration.yaml --poses configs/lrm_arm/demo.csv --out {out}/predicted.csv",
        reads=["predicted.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-position",
        "commands that reach positions, within limits and clearance",
        "compensate runs/lrm-demo/calibration.yaml --targets configs/lrm_arm/targets.csv"
        " --within configs/lrm_arm/plan.yaml --out {out}/commands.csv --json",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-pose",
        "commands that reach poses, one of them too far",
        text("targets.csv", POSES),
        "compensate runs/lrm-demo/calibration.yaml --targets {out}/targets.csv --out {out}/commands.csv --json"
        " --redundancy least_sag",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-path",
        "commands along a path",
        "compensate runs/lrm-demo/calibration.yaml --targets configs/lrm_arm/path.csv --path"
        " --within configs/lrm_arm/plan.yaml --out {out}/commands.csv --json",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-payload",
        "commands under three payloads",
        text("targets.csv", LOADED),
        "compensate runs/lrm-demo/calibration.yaml --targets {out}/targets.csv --out {out}/commands.csv --json"
        " --start 'q1=10 deg' --angles rad",
        reads=["0.out", "commands.csv"],
        needs=["lrm-demo"],
    ),
    entry(
        "compensate-nominal",
        "what to send to a controller that only knows the nominal arm, over a grid",
        grid("targets.csv", [220, 240, 260, 280], [-30, -10, 10, 30], [300, 320, 340]),
        "compensate runs/lrm-demo/calibration.yaml --targets {out}/targets.csv --path --for nominal"
        " --within configs/lrm_arm/plan.yaml --out {out}/sent.csv -q",
        reads=["sent.csv:pose_id,dx_mm,dy_mm,dz_mm,turn_x_rad,turn_y_rad,turn_z_rad"],
        needs=["lrm-demo"],
    ),
    entry(
        "export-c",
        "C code of the calibrated arm, and its self-test",
        "export runs/lrm-demo/calibration.yaml --format c --out {out}/lrm.c --json",
        c_self_test,
        reads=["0.out", "lrm_test.txt"],
        needs=["lrm-demo"],
    ),
    entry(
        "export-others",
        "the calibrated arm as YAML and JSON",
        "export runs/lrm-demo/calibration.yaml --format yaml --out {out}/arm.yaml --json",
        "export runs/lrm-demo/calibration.yaml --format json --out {out}/arm.json --json",
        reads=["0.out", "1.out", "arm.yaml", "arm.json"],
        needs=["lrm-demo"],
    ),
    entry(
        "convert",
        "the nominal arm in other forms",
        "convert configs/lrm_arm/arm.yaml --to poe --json",
        "convert configs/lrm_arm/arm.yaml --to mdh --convention craig --json",
        "convert configs/lrm_arm/arm.yaml --to urdf --json",
        reads=["0.out", "1.out", "2.out"],
    ),
    entry(
        "serve",
        "answers of the server, refusals among them",
        typed("serve runs/lrm-demo/calibration.yaml --workers 1 --evaluator interpreted", ASKED + "\n"),
        reads=["0.out"],
        needs=["lrm-demo"],
    ),
    entry(
        "frida-ranks",
        "which parameters one arm and two arms in contact determine",
        *(thinned(f"configs/frida/{name.removesuffix('_tools_held')}.csv", f"{name}.csv", 4) for name in RANKS),
        *(f"identify configs/frida/{name}.yaml --data {{out}}/{name}.csv --json" for name in RANKS),
        reads=[f"{i}.out" for i in range(len(RANKS))],
    ),
    entry("two-arms", "two arms joined by a clamp", "run configs/frida/dual_known_clamp.yaml --out {out} -q"),
    entry("two-arms-wrong-clamp", "the clamp found too", "run configs/frida/wrong_clamp.yaml --out {out} -q"),
    *(
        entry(
            f"mukca-{name}",
            f"a {name.partition('-')[0]}'s ball in sockets, trained on {name.partition('-')[2]}",
            f"run configs/mukca/{name.partition('-')[0]}.yaml --data {{shared}}/mukca/{folder} --out {{out}} -q"
            f" --accept --set validation.train_groups=[{name.partition('-')[2]}]",
        )
        for name, folder in MUKCA.items()
    ),
    entry("ball", "a simulated arm of seven joints, its ball in sockets", "run configs/ball/demo.yaml --out {out} -q"),
    entry(
        "export-urdf",
        "the arm's own URDF, calibrated",
        "export runs/ball/calibration.yaml --format urdf --out {out}/arm.urdf --json",
        reads=["0.out", "arm.urdf"],
        needs=["ball"],
    ),
    entry("camera", "a camera on the hand", "run configs/camera/demo.yaml --out {out} -q"),
)


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
