"""Checks on live trackers and live joint readings: they never wait; damaged bytes are counted, never raised."""

import socket
import threading
from collections.abc import Callable, Mapping
from contextlib import closing, suppress
from operator import methodcaller
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, TypeVar

import numpy as np

from armcal.devices.clock import RealClock
from armcal.devices.live import JointSample, TrackerFrame
from armcal.errors import InputError
from armcal.testing.results import ContractError, NotRun, Recorder, expect, raises_only
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
    _check_source(record, subject, "samples", JointSample, CHANNELS)


def check_camera(record: Recorder, subject: Subject) -> None:
    """That a live camera opens or refuses as a user's fault, never waits for an image, and may be closed twice."""
    with record.needed("it builds"):
        camera = subject.build()
    with record.check("it may be closed before it was opened"):
        camera.close()
    with record.check("without a camera's measurement it refuses by an armcal error"):
        opened = False
        with suppress(InputError), raises_only(InputError):
            _within(lambda: camera.open(RealClock(), {}))
            opened = True
        expect(not opened, "found it open, expected a refusal")
    with record.check("gives_shots says whether images come by themselves"):
        expect(isinstance(camera.gives_shots, bool), f"found {camera.gives_shots!r}, expected true or false")
    with record.check("it may be closed twice, and gives nothing then"):
        camera.close()
        camera.close()
        expect(_within(camera.shots) == [], "found an image after close(), expected none")


def _check_source(record: Recorder, subject: Subject, method: str, kind: type, *opening: object) -> None:
    """Check a source whose ``method`` gives what has come, objects of ``kind``; it opens with a clock and more."""
    with record.needed("it builds"):
        source = subject.build()
    take = methodcaller(method)
    with record.check("it may be closed before it was opened"):
        source.close()
    with record.check("it opens, or refuses by an armcal error"), suppress(InputError), raises_only(InputError):
        _within(lambda: source.open(RealClock(), *opening))
    with record.check(f"{method}() gives a list of {method}, without waiting"):
        for item in _listed(source, take):
            name = type(item).__name__
            expect(isinstance(item, kind), f"found {name}, expected {kind.__module__}.{kind.__name__}")
    if kind is JointSample:
        with record.check("ended says whether nothing more will come"):
            expect(isinstance(source.ended, bool), f"found ended = {source.ended!r}, expected true or false")
    with record.check("refused counts by reason"):
        _counted(source.refused)
    with record.check("it may be closed twice, and gives nothing then"):
        source.close()
        source.close()
        expect(_within(lambda: take(source)) == [], "found something that came after close(), expected nothing")
    with record.check("damaged bytes are passed over and counted"), TemporaryDirectory() as folder:
        path = Path(folder, "live")
        path.write_bytes(b"")
        damaged = subject.made(subject.made.Settings.model_validate(_settings_to_feed(subject, path)))
        try:
            damaged.open(RealClock(), *opening)
        except InputError as refusal:
            raise NotRun(f"it does not open: {refusal}") from refusal
        with closing(damaged):
            _expect_damage_counted(damaged, take, path)


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


def _listed(source: Any, take: Callable[[Any], Any]) -> list[Any]:
    items = _within(lambda: take(source))
    expect(isinstance(items, list), f"found {type(items).__name__}, expected a list")
    return list(items)


def _counted(refused: Any) -> int:
    expect(isinstance(refused, Mapping), f"found {type(refused).__name__}, expected a mapping from reason to count")
    for reason, count in refused.items():
        expect(isinstance(reason, str) and isinstance(count, int), f"found {reason!r}: {count!r}")
    return sum(refused.values())


def _expect_damage_counted(source: Any, take: Callable[[Any], Any], path: Path) -> None:
    """Damaged bytes by UDP or in a file: each is passed over, and some of them are counted."""
    address = getattr(source, "address", None)
    for data in _DAMAGED:
        if address is None:
            with path.open("ab") as file:
                file.write(data)
        else:
            with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
                sender.sendto(data, tuple(address))
        with raises_only(expected="them counted in refused", when=f" for the bytes {data[:20]!r}"):
            _listed(source, take)
    for _ in range(_TRIES):
        if _counted(source.refused):
            return
        _within(lambda: take(source))
    raise ContractError("found nothing in refused after damaged bytes, expected each to be counted by its reason")


def _settings_to_feed(subject: Subject, path: Path) -> Mapping[str, Any]:
    example, fields = dict(subject.example), type(subject.settings).model_fields
    if isinstance(example.get("port"), int):  # not that of a serial line
        return {**example, "port": 0, **({"host": "127.0.0.1"} if "host" in fields else {})}
    for name in ("path", "source"):
        if name in fields:
            return {**example, name: str(path)}
    raise NotRun("its settings have no port, path or source by which the checks could feed it")
