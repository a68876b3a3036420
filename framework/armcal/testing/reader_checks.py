"""Checks on readers: what a known file says, and what becomes of damaged ones."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from armcal.base.dataset import Dataset
from armcal.errors import InputError
from armcal.measure.reader import Reader, ReadRequest
from armcal.testing.planar import TRACKER, Tip
from armcal.testing.results import ContractError, NotRun, Recorder, expect
from armcal.testing.settings_checks import MISSING_FILE, Subject
from armcal.testing.sources import Source, request, sources

_TOLERANCE = 1e-9
_WRONG = "not_a_number"
_DAMAGED: Mapping[str, bytes] = {
    "empty": b"",
    "NUL bytes": b"\0" * 64,
    "text that is not UTF-8": b"id,q1_deg\n1,\xff\xfe\xfa\n",
    "noise": bytes(np.random.default_rng(8).integers(0, 256, 4096, dtype=np.uint8)),
    "a cut-off line": b'id,q1_deg,q2_deg,x_mm,y_mm,z_mm\n1,10,"20',
}


def check_reader(record: Recorder, subject: Subject) -> None:
    """That it refuses what it cannot read as a user's fault, and says of a known file what is in it."""
    reader: Any = record.check("it builds", subject.build)
    if reader is None:
        return
    method = getattr(reader, "read", None)
    record.check("it reads", expect, callable(method), f"found read = {method!r}, expected a method")
    record.check("a missing file is refused by an armcal error", _missing_file, subject)
    for name, content in _DAMAGED.items():
        record.check(f"damaged files are refused: {name}", _refuses, subject, content)
    record.check("a folder in place of a file, or a file in place of a folder, is refused", _confused, subject)
    example = record.check("it reads a known file in SI, a record a row", _known, subject)
    record.check("it reads the same each time", _repeats, subject, example)
    record.check("a cell that is wrong or empty is reported, never passed over", _wrong_cells, subject, example)


def _read(subject: Subject, path: str, read_request: ReadRequest | None = None) -> Dataset:
    """What a reader makes of a path; its refusals pass, any other fault is one of its own."""
    if "path" not in type(subject.settings).model_fields:
        raise NotRun("its settings have no path")
    try:
        settings = subject.made.Settings.model_validate({**subject.example, "path": path})
        reader: Reader = subject.made(settings)
        return reader.read(read_request or request({TRACKER: Tip()}))
    except (InputError, ValidationError):
        raise
    except Exception as fault:
        raise ContractError(
            f"found {type(fault).__name__} ({fault}), expected armcal.errors.DataError with the file's name"
        ) from fault


def _missing_file(subject: Subject) -> None:
    try:
        _read(subject, MISSING_FILE)
    except (InputError, ValidationError):
        return
    raise ContractError("found a dataset read from a file that is not there")


def _refuses(subject: Subject, content: bytes) -> None:
    with _written({"data": content}) as folder:
        _no_records(subject, folder / "data")


def _confused(subject: Subject) -> None:
    with _written({"data": b"", "inner/data": b""}) as folder:
        _no_records(subject, folder / "inner")
        _no_records(subject, folder / "data")


def _no_records(subject: Subject, path: Path) -> None:
    try:
        dataset = _read(subject, str(path))
    except (InputError, ValidationError):
        return
    expect(len(dataset) == 0, f"found {len(dataset)} records made of it, expected it refused")


@contextmanager
def _written(files: Mapping[str, bytes]) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        for file, content in files.items():
            path = Path(name, file)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield Path(name)


def _read_example(subject: Subject, example: Source) -> Dataset:
    with _written(example.files) as folder:
        return _read(subject, str(folder / example.path), example.request)


def _known(subject: Subject) -> Source:
    refused = []
    for example in sources(subject.made):
        try:
            read_example = _read_example(subject, example)
        except (InputError, ValidationError) as refusal:
            refused.append(str(refusal))
            continue
        text = f" and {len(read_example.set_aside)} set aside"
        expect(len(read_example) == example.count, f"found {len(read_example)} records{text}, expected {example.count}")
        for name, channel in example.channels.items():
            values = read_example.column(name)
            off = float(np.abs(values - channel).max())
            expect(off <= _TOLERANCE, f"{name}: found {values}, expected {channel} (SI)")
        return example
    if hasattr(subject.made, "EXAMPLE_SOURCE"):
        raise ContractError(f"it refuses its own EXAMPLE_SOURCE: {refused[0]}")
    raise NotRun("it reads no plain table, and has no EXAMPLE_SOURCE")


def _repeats(subject: Subject, example: Source | None) -> None:
    if example is None:
        raise NotRun("no known file was read")
    first, again = _read_example(subject, example), _read_example(subject, example)
    same = first.ids == again.ids and set(first.channels) == set(again.channels)
    expect(same, "found other records the second time")
    for name, values in first.channels.items():
        expect(np.array_equal(values, again.channels[name], equal_nan=True), f"found other numbers in {name}")


def _wrong_cells(subject: Subject, example: Source | None) -> None:
    """The last number of the second to last line is made wrong, then empty, in each file that has such a line."""
    if example is None:
        raise NotRun("no known file was read")
    for cell in (_WRONG, ""):
        damaged = {name: _with_cell(content, cell) for name, content in example.files.items()}
        if damaged == dict(example.files):
            raise NotRun("its example is not a table of text separated by commas")
        try:
            read_example = _read_example(subject, replace(example, files=damaged))
        except (InputError, ValidationError):
            continue
        kept = len(read_example) + len(read_example.set_aside)
        expect(
            kept == example.count or bool(read_example.warnings),
            f"found {len(read_example)} records and {len(read_example.set_aside)} set aside of {example.count} rows, "
            f"one of them with {cell or 'nothing'!r} in a cell; expected it refused, or set aside with a reason",
        )
        finite = all(np.isfinite(read_example.column(name)).all() for name in example.channels)
        expect(
            len(read_example) < example.count or not finite,
            f"found {example.count} records of finite numbers, one of them read from {cell or 'nothing'!r}",
        )


def _with_cell(content: bytes, cell: str) -> bytes:
    lines = content.decode("utf-8", "replace").split("\n")
    filled = [i for i, line in enumerate(lines) if "," in line]
    if len(filled) < 2:
        return content
    at = filled[-2]
    lines[at] = f"{lines[at].rpartition(',')[0]},{cell}"
    return "\n".join(lines).encode()
