"""The golden set: what armcal's commands give, recorded, and compared with what they give now.

``python -m tests.golden`` runs every entry through the real command line in a folder of its own and prints each
difference: command, file, key, expected, found. Names (globs) select entries, ``--write`` records anew, ``--list``
lists them, ``-j N`` runs N at once. The entries are the table of ``tests/golden_entries.py``; what was recorded is in
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
import json
import math
import os
import re
import shutil
import sys
import tempfile
import time
import traceback
import xml.etree.ElementTree as ElementTree
import zlib
from collections.abc import Iterator, Mapping, Sequence
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from tests.golden_entries import ENTRIES, FORK, ROOT, SHARED, Entry, Place

RECORDED = ROOT / "tests" / "data" / "golden.json"
THREADS = ("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "MKL_NUM_THREADS")
RELATIVE, ABSOLUTE = 1e-6, 1e-12
WHOLE = 12  # entries of a list, or rows of a table, that are kept one by one; of longer ones sums and three of them
VOLATILE = re.compile(
    r"at|created|written|started_at|seconds|.*(?:took|waited)_m?s|elapsed.*|duration.*|source|path|out|folder|files?"
    r"|software|version|plugins|evaluator|identity|provenance|.*sha256|digests?|config|host|pid|process|port"
    r"|armcal_\w+|schema.*"
)
REPEATED = re.compile(r"arms|verdict|quality_\w+")  # of a calibration: what its configuration and metrics.json say too
Leaf = Any  # text, number, None, a list of numbers, or a dictionary of a column's sums and rows
Record = dict[str, Leaf]


# ---------------------------------------------------------------- running


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
        if VOLATILE.fullmatch(name):
            continue
        cells = [row[name] or "" for row in rows]
        try:
            numbers = np.array([float(cell or "nan") for cell in cells])
        except ValueError:
            yield name, _joined(cells)
            continue
        if name == "time_s" and 1.7e9 < np.nanmax(numbers) < 1.89e9:  # of the machine; simulated ones are later
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
    """Each entry, run in a fork of this process: its records, or what went wrong, and its processor time (s)."""
    waiting, running, done = list(entries), dict[Connection, tuple[Entry, Any]](), set[str]()
    while waiting or running:
        ready = [e for e in waiting if done.issuperset(e.needs)]
        for entry in ready[: at_once - len(running)]:
            waiting.remove(entry)
            ours, theirs = FORK.Pipe(duplex=False)
            process = FORK.Process(target=_send, args=(entry, root, theirs))
            process.start()
            theirs.close()
            running[ours] = (entry, process)
        for ours in wait(list(running)):
            entry, process = running.pop(ours)
            try:
                found, took = ours.recv()
            except EOFError:
                found, took = "its process ended", 0.0
            process.join()
            done.add(entry.name)
            yield entry, found, took


def _send(entry: Entry, root: Path, pipe: Connection) -> None:
    try:
        found: dict[str, Record] | str = run(entry, root)
    except Exception:
        found = traceback.format_exc(limit=-2)
    pipe.send((found, sum(os.times()[:4])))


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
    os.environ["ARMCAL_CC"] = "none"
    os.environ["PATH"] = f"{Path(sys.executable).parent}{os.pathsep}{os.environ['PATH']}"
    load_everything()
    with tempfile.TemporaryDirectory(prefix="armcal-golden-") as place:
        root = asked.keep.resolve() if asked.keep else Path(place)
        shutil.copytree(ROOT / "configs", root / "configs", dirs_exist_ok=True)
        os.environ["ARMCAL_CACHE_DIR"] = str(root / "cache")
        return compare_or_write(entries, root, asked.j, asked.write)


def compare_or_write(entries: Sequence[Entry], root: Path, at_once: int, write: bool) -> int:
    recorded = json.loads(RECORDED.read_text()) if RECORDED.exists() else {}
    began, wrong, done, spent = time.monotonic(), 0, 0, 0.0
    skipped = {e.name for e in entries if e.shared and not (SHARED / e.shared).is_dir()}
    for entry in entries:
        if set(entry.needs) & skipped:
            skipped.add(entry.name)
    for name in sorted(skipped):
        print(f"skip {name}: it needs data in {SHARED}", flush=True)
    for entry, found, took in outcomes([e for e in entries if e.name not in skipped], root, at_once):
        done, spent = done + 1, spent + took
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
    took = f"{time.monotonic() - began:.0f} s, of processors {spent:.0f} s"
    print(f"{done} done, {wrong} differ, {len(skipped)} skipped; {took}")
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


if __name__ == "__main__":
    if any(os.environ.get(name) != "1" for name in THREADS):  # BLAS reads it when NumPy is loaded, which was before
        again = [sys.executable, "-m", "tests.golden", *sys.argv[1:]]
        os.execve(sys.executable, again, {**os.environ, **dict.fromkeys(THREADS, "1")})
    sys.exit(main(sys.argv[1:]))
