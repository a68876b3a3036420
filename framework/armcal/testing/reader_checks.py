"""Checks on readers: what a known file says, and what becomes of damaged ones."""

import math
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from pydantic import ValidationError

from armcal.base.arrays import Array
from armcal.base.dataset import Dataset
from armcal.errors import InputError
from armcal.measure.measurement import Measurement
from armcal.measure.reader import Reader, ReadRequest, requested_channels
from armcal.testing.planar import ARM, QUATERNION, TRACKER, WALLS, Body, Tip, Walls, planar_arms
from armcal.testing.results import ContractError, NotRun, Recorder, expect, raises_only
from armcal.testing.settings_checks import MISSING_FILE, Subject

_TOLERANCE = 1e-9
_REFUSALS = (InputError, ValidationError)
_ANGLES_DEG = np.array([(10.0, -20.0), (30.0, 45.0), (-60.0, 5.0), (90.0, 120.0)])
_LINKS_M = (0.3, 0.25)
_DIGITS = 6
_WRONG = "not_a_number"
_DAMAGED: Mapping[str, bytes] = {
    "empty": b"",
    "NUL bytes": b"\0" * 64,
    "text that is not UTF-8": b"id,q1_deg\n1,\xff\xfe\xfa\n",
    "noise": bytes(np.random.default_rng(8).integers(0, 256, 4096, dtype=np.uint8)),
    "a cut-off line": b'id,q1_deg,q2_deg,x_mm,y_mm,z_mm\n1,10,"20',
}


@dataclass(frozen=True)
class _Source:
    """Files, and what they say to whom.

    Attributes:
        files: by name.
        path: which of them the setting ``path`` names; all of them, the folder, if it is empty.
        channels: the records in SI, by channel.
        measurements: what is measured, by instance.
    """

    files: Mapping[str, bytes]
    path: str
    channels: Mapping[str, Array]
    measurements: Mapping[str, Measurement]

    @property
    def count(self) -> int:
        return len(next(iter(self.channels.values())))


def check_reader(record: Recorder, subject: Subject) -> None:
    """That it refuses what it cannot read as a user's fault, and says of a known file what is in it."""
    with record.needed("it builds"):
        reader = subject.build()
    with record.check("it reads"):
        method = getattr(reader, "read", None)
        expect(callable(method), f"found read = {method!r}, expected a method")
    with record.check("a missing file is refused by an armcal error"):
        _expect_refused(subject, Path(MISSING_FILE), "found a dataset read from a file that is not there")
    for name, content in _DAMAGED.items():
        with record.check(f"damaged files are refused: {name}"), _written({"data": content}) as folder:
            _expect_refused(subject, folder / "data")
    name = "a folder in place of a file, or a file in place of a folder, is refused"
    with record.check(name), _written({"data": b"", "inner/data": b""}) as folder:
        _expect_refused(subject, folder / "inner")
        _expect_refused(subject, folder / "data")
    example = None
    with record.check("it reads a known file in SI, a record a row"):
        example = _known(subject)
    with record.check("it reads the same each time"):
        first, again = (_read_example(subject, _known_before(example)) for _ in range(2))
        same = first.ids == again.ids and set(first.channels) == set(again.channels)
        expect(same, "found other records the second time")
        for name, values in first.channels.items():
            expect(np.array_equal(values, again.channels[name], equal_nan=True), f"found other numbers in {name}")
    with record.check("a cell that is wrong or empty is reported, never passed over"):
        for cell in (_WRONG, ""):
            _expect_reported(subject, _known_before(example), cell)


def _read(subject: Subject, path: Path, measurements: Mapping[str, Measurement]) -> Dataset:
    if "path" not in type(subject.settings).model_fields:
        raise NotRun("its settings have no path")
    arms = planar_arms([ARM])
    request = ReadRequest(arms, measurements, requested_channels(arms, measurements, measured=True))
    with raises_only(*_REFUSALS, expected="armcal.errors.DataError with the file's name"):
        settings = subject.made.Settings.model_validate({**subject.example, "path": str(path)})
        reader: Reader = subject.made(settings)
        return reader.read(request)


def _expect_refused(subject: Subject, path: Path, otherwise: str = "") -> None:
    with suppress(*_REFUSALS):
        dataset = _read(subject, path, {TRACKER: Tip()})
        refused = not otherwise and len(dataset) == 0
        expect(refused, otherwise or f"found {len(dataset)} records made of it, expected it refused")


@contextmanager
def _written(files: Mapping[str, bytes]) -> Iterator[Path]:
    with tempfile.TemporaryDirectory() as name:
        for file, content in files.items():
            path = Path(name, file)
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        yield Path(name)


def _read_example(subject: Subject, example: _Source) -> Dataset:
    with _written(example.files) as folder:
        return _read(subject, folder / example.path, example.measurements)


def _known(subject: Subject) -> _Source:
    """The first source that the component reads, when it has read it."""
    refused = []
    for example in _sources(subject.made):
        try:
            dataset = _read_example(subject, example)
        except _REFUSALS as refusal:
            refused.append(str(refusal))
            continue
        text = f" and {len(dataset.set_aside)} set aside"
        expect(len(dataset) == example.count, f"found {len(dataset)} records{text}, expected {example.count}")
        for name, channel in example.channels.items():
            values = dataset.column(name)
            off = float(np.abs(values - channel).max())
            expect(off <= _TOLERANCE, f"{name}: found {values}, expected {channel} (SI)")
        return example
    if hasattr(subject.made, "EXAMPLE_SOURCE"):
        raise ContractError(f"it refuses its own EXAMPLE_SOURCE: {refused[0]}")
    raise NotRun("it reads no plain table, and has no EXAMPLE_SOURCE")


def _known_before(example: _Source | None) -> _Source:
    if example is None:
        raise NotRun("no known file was read")
    return example


def _expect_reported(subject: Subject, example: _Source, cell: str) -> None:
    """The last number of the second to last line becomes this text, in each file that has such a line."""
    files = {name: _with_cell(content, cell) for name, content in example.files.items()}
    if files == dict(example.files):
        raise NotRun("its example is not a table of text separated by commas")
    try:
        dataset = _read_example(subject, replace(example, files=files))
    except _REFUSALS:
        return
    expect(
        len(dataset) + len(dataset.set_aside) == example.count or bool(dataset.warnings),
        f"found {len(dataset)} records and {len(dataset.set_aside)} set aside of {example.count} rows, "
        f"one of them with {cell or 'nothing'!r} in a cell; expected it refused, or set aside with a reason",
    )
    finite = all(np.isfinite(dataset.column(name)).all() for name in example.channels)
    expect(
        len(dataset) < example.count or not finite,
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


def _sources(made: Any) -> Iterator[_Source]:
    """A component's own ``EXAMPLE_SOURCE``, else plain tables of a tip and of a body."""
    own = getattr(made, "EXAMPLE_SOURCE", None)
    if own is None:
        yield _table({TRACKER: Tip()}, ())
        yield _table({TRACKER: Body()}, QUATERNION)
        return
    expect(
        isinstance(own, Mapping) and set(own) == {"files", "path", "channels"},
        f"found EXAMPLE_SOURCE = {own!r}, expected a mapping with files, path and channels",
    )
    files = {name: text.encode() if isinstance(text, str) else text for name, text in own["files"].items()}
    channels = {name: np.array(values, dtype=float) for name, values in own["channels"].items()}
    measures = any(name.startswith(f"{TRACKER}.") for name in channels)
    yield _Source(files, own["path"], channels, {TRACKER: Tip()} if measures else {WALLS: Walls()})


def _table(measurements: Mapping[str, Measurement], more: tuple[str, ...]) -> _Source:
    """Columns by name with their unit, as ``csv`` reads them; the arm is where its nominal parameters say."""
    first, both = np.radians(_ANGLES_DEG[:, 0]), np.radians(_ANGLES_DEG.sum(axis=1))
    upper, fore = _LINKS_M
    x, z = upper * np.cos(first) + fore * np.cos(both), -upper * np.sin(first) - fore * np.sin(both)
    tips = np.round(1000 * np.stack([x, 0 * x, z], axis=1), _DIGITS)
    turned = np.stack([np.cos(both / 2), 0 * both, np.sin(both / 2), 0 * both], axis=1)
    turned *= np.where(turned[:, :1] < 0, -1, 1)
    cells = np.hstack([_ANGLES_DEG, tips, turned[:, : len(more)]])
    header = ",".join(("id", "q1_deg", "q2_deg", "x_mm", "y_mm", "z_mm", *more))
    rows = [",".join((f"r{i}", *(f"{float(cell)!r}" for cell in row))) for i, row in enumerate(cells)]
    names = (f"{ARM}.q1", f"{ARM}.q2", *(f"{TRACKER}.{name}" for name in ("x", "y", "z", *more)))
    factors = (*(math.pi / 180,) * 2, *(1e-3,) * 3, *(1.0,) * len(more))
    channels = {name: factor * cells[:, i] for i, (name, factor) in enumerate(zip(names, factors, strict=True))}
    return _Source({"data.csv": "\n".join([header, *rows, ""]).encode()}, "data.csv", channels, measurements)
