"""Checks on live trackers and live joint readings: they never wait; damaged bytes are counted, never raised."""

from __future__ import annotations

import socket
import tempfile
import threading
from collections.abc import Callable, Mapping
from operator import methodcaller
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from armcal.devices.clock import RealClock
from armcal.devices.joint_stream import JointSample
from armcal.devices.tracker import TrackerFrame
from armcal.errors import InputError
from armcal.testing.results import ContractError, NotRun, Recorder, expect
from armcal.testing.settings_checks import Subject

T = TypeVar("T")

CHANNELS = ("arm.q1", "arm.q2")
_PATIENCE_S = 5.0
"""Whoever takes longer than this to say what has come is waiting."""
_DAMAGED = (
    b"",
    b"\n",
    b"\xff\xfe\xfd broken\n",
    b"{\n",
    b"[" * 20_000 + b"\n",
    b'{"frame": 1e999, "time_s": NaN, "bodies": {"0": [1]}}\n',
    b"fr 1\r\n6d 1 [0 1.0][nan nan\r\n",
    b"\0" * 100 + b"\n",
    b"1,2,3\n1,2\n,,\n",
    bytes(np.random.default_rng(9).integers(0, 256, 3000, dtype=np.uint8)) + b"\n",
)
_TRIES = 20


def check_tracker(record: Recorder, subject: Subject) -> None:
    """That a tracker opens or refuses as a user's fault, never waits, never raises for what came, and may be closed."""
    _check_source(record, subject, "frames", TrackerFrame)


def check_joint_stream(record: Recorder, subject: Subject) -> None:
    """The same of a stream of joint readings, and that it reports its end."""
    _check_source(record, subject, "samples", JointSample, CHANNELS)


def _check_source(record: Recorder, subject: Subject, method: str, kind: type, *opening: object) -> None:
    """Check a source whose ``method`` gives what has come, objects of ``kind``; it opens with a clock and more."""
    source: Any = record.check("it builds", subject.build)
    if source is None:
        return

    def begin(made: Any) -> None:
        made.open(RealClock(), *opening)

    take = methodcaller(method)
    record.check("it may be closed before it was opened", source.close)
    record.check("it opens, or refuses by an armcal error", _opens, lambda: begin(source))
    record.check(f"{method}() gives a list of {method}, without waiting", _gives, source, take, kind)
    if kind is JointSample:
        record.check("ended says whether nothing more will come", _ended, source)
    record.check("refused counts by reason", lambda: _check_counts(source.refused))
    record.check("it may be closed twice, and gives nothing then", _closes, source, take)
    record.check("damaged bytes are passed over and counted", _survives_damage, subject, begin, take)


def _within(call: Callable[[], T]) -> T:
    """What a call gives, if it does not wait.

    Raises:
        ContractError: it does.
    """
    items: list[T] = []
    raised: list[BaseException] = []

    def run() -> None:
        try:
            items.append(call())
        except BaseException as fault:
            raised.append(fault)

    worker = threading.Thread(target=run, daemon=True)
    worker.start()
    worker.join(_PATIENCE_S)
    if worker.is_alive():
        raise ContractError(f"found it still waiting after {_PATIENCE_S:g} s, expected what has come by now, at once")
    if raised:
        raise raised[0]
    return items[0]


def _opens(begin: Callable[[], None]) -> None:
    try:
        _within(begin)
    except InputError:
        return
    except ContractError:
        raise
    except Exception as fault:
        raise ContractError(f"found {type(fault).__name__} ({fault}), expected armcal.errors.InputError") from fault


def _gives(source: Any, take: Callable[[Any], Any], kind: type) -> None:
    items = _within(lambda: take(source))
    expect(isinstance(items, list), f"found {type(items).__name__}, expected a list")
    for item in items:
        expect(isinstance(item, kind), f"found {type(item).__name__}, expected {kind.__module__}.{kind.__name__}")


def _ended(stream: Any) -> None:
    expect(isinstance(stream.ended, bool), f"found ended = {stream.ended!r}, expected true or false")


def _closes(source: Any, take: Callable[[Any], Any]) -> None:
    source.close()
    source.close()
    expect(_within(lambda: take(source)) == [], "found something that came after close(), expected nothing")


def _check_counts(refused: Any) -> int:
    """How many were passed over; a mapping from reason to count."""
    expect(isinstance(refused, Mapping), f"found {type(refused).__name__}, expected a mapping from reason to count")
    for reason, count in refused.items():
        expect(isinstance(reason, str) and isinstance(count, int), f"found {reason!r}: {count!r}")
    return sum(refused.values())


def _survives_damage(subject: Subject, begin: Callable[[Any], None], take: Callable[[Any], Any]) -> None:
    """Damaged bytes by UDP or in a file: each is passed over, and some of them are counted."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "live")
        path.write_bytes(b"")
        source = subject.made(subject.made.Settings.model_validate(_settings_to_feed(subject, path)))
        try:
            begin(source)
        except InputError as refusal:
            raise NotRun(f"it does not open: {refusal}") from refusal
        try:
            address = getattr(source, "address", None)
            for data in _DAMAGED:
                if address is None:
                    with path.open("ab") as file:
                        file.write(data)
                else:
                    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                        sender.sendto(data, tuple(address))
                _passes_over(lambda: take(source), data)
            for _ in range(_TRIES):
                if _check_counts(source.refused):
                    return
                _within(lambda: take(source))
        finally:
            source.close()
    expect(False, "found nothing in refused after damaged bytes, expected each to be counted by its reason")


def _settings_to_feed(subject: Subject, path: Path) -> Mapping[str, Any]:
    """Settings with a free port, or with a file to which the checks append."""
    example, fields = dict(subject.example), type(subject.settings).model_fields
    if example.get("port") is not None:
        return {**example, "port": 0, **({"host": "127.0.0.1"} if "host" in fields else {})}
    for name in ("path", "source"):
        if name in fields:
            return {**example, name: str(path)}
    raise NotRun("its settings have no port, path or source by which the checks could feed it")


def _passes_over(take: Callable[[], Any], data: bytes) -> None:
    try:
        taken = _within(take)
    except ContractError:
        raise
    except Exception as fault:
        raise ContractError(
            f"found {type(fault).__name__} ({fault}) for the bytes {data[:20]!r}, expected them counted in refused"
        ) from fault
    expect(isinstance(taken, list), f"found {type(taken).__name__}, expected a list")
