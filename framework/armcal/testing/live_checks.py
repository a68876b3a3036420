"""What live sources of frames and readings share: they never wait, and damaged bytes are counted, never raised."""

from __future__ import annotations

import socket
import tempfile
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from armcal.errors import InputError
from armcal.testing.results import ContractError, NotRun, expect
from armcal.testing.settings_checks import Subject

T = TypeVar("T")

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


def within(call: Callable[[], T]) -> T:
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


def opens(opened: Callable[[], Any]) -> None:
    """Open, or be refused as a user's fault."""
    try:
        within(opened)
    except (InputError, ContractError):
        raise
    except Exception as fault:
        raise ContractError(f"found {type(fault).__name__} ({fault}), expected armcal.errors.InputError") from fault


def check_counts(refused: Any) -> int:
    """How many were passed over; a mapping from reason to count."""
    expect(isinstance(refused, Mapping), f"found {type(refused).__name__}, expected a mapping from reason to count")
    for reason, count in refused.items():
        expect(isinstance(reason, str) and isinstance(count, int), f"found {reason!r}: {count!r}")
    return sum(refused.values())


def survives_damage(subject: Subject, begin: Callable[[Any], None], take: Callable[[Any], Any]) -> None:
    """Damaged bytes by UDP or in a file: each is passed over, and some of them are counted.

    Args:
        subject: the source; its settings have a ``port``, a ``path`` or a ``source``.
        begin: opens one.
        take: what came.
    """
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder, "live")
        path.write_bytes(b"")
        made = subject.made(subject.made.Settings.model_validate(_fed(subject, path)))
        try:
            begin(made)
        except InputError as refusal:
            raise NotRun(f"it does not open: {refusal}") from refusal
        try:
            send = _sender(made, path)
            for data in _DAMAGED:
                send(data)
                _taken(lambda: take(made), data)
            for _ in range(_TRIES):
                if check_counts(made.refused):
                    return
                within(lambda: take(made))
        finally:
            made.close()
    expect(False, "found nothing in refused after damaged bytes, expected each to be counted by its reason")


def _fed(subject: Subject, path: Path) -> Mapping[str, Any]:
    """Settings by which the checks can feed it."""
    example, fields = dict(subject.example), type(subject.settings).model_fields
    if example.get("port") is not None:
        return {**example, "port": 0, **({"host": "127.0.0.1"} if "host" in fields else {})}
    for name in ("path", "source"):
        if name in fields:
            return {**example, name: str(path)}
    raise NotRun("its settings have no port, path or source by which the checks could feed it")


def _sender(made: Any, path: Path) -> Callable[[bytes], None]:
    address = getattr(made, "address", None)
    if address is None:
        return lambda data: _append(path, data)
    return lambda data: _send(tuple(address), data)


def _append(path: Path, data: bytes) -> None:
    with path.open("ab") as file:
        file.write(data)


def _send(address: tuple[Any, ...], data: bytes) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        sender.sendto(data, address)


def _taken(take: Callable[[], Any], data: bytes) -> None:
    try:
        taken = within(take)
    except ContractError:
        raise
    except Exception as fault:
        raise ContractError(
            f"found {type(fault).__name__} ({fault}) for the bytes {data[:20]!r}, expected them counted in refused"
        ) from fault
    expect(isinstance(taken, list), f"found {type(taken).__name__}, expected a list")
