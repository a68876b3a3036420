"""Unix sockets with a path that may be long, which only the owner may connect to."""

import os
import socket
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from stat import S_ISSOCK

from armcal.errors import InputError, Location

_PATH_BYTES = 100  # A longer path does not fit a Unix socket's address


@contextmanager
def short_address(path: Path) -> Iterator[str]:
    """A socket's address, which is short: by the folder's descriptor where the path is long."""
    if len(os.fsencode(path)) <= _PATH_BYTES:
        yield str(path)
        return
    folder = os.open(path.parent, os.O_RDONLY | os.O_DIRECTORY)
    try:
        yield f"/proc/self/fd/{folder}/{path.name}"
    finally:
        os.close(folder)


def listening(path: Path, taken: str, hint: str, backlog: int) -> socket.socket:
    """A listener that does not block; a socket that nobody serves any more is replaced.

    Args:
        path: where.
        taken: the sentence for a socket that somebody serves.
        hint: which option to change.
        backlog: how many may wait to be accepted.

    Raises:
        InputError: somebody serves it, something else is there, or it cannot be made.
    """
    where = Location(str(path))
    listener = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    try:
        with short_address(path) as address:
            vacate(path, taken, hint)
            mask = os.umask(0o177)
            try:
                listener.bind(address)
            finally:
                os.umask(mask)
        listener.listen(backlog)
        listener.setblocking(False)
    except (OSError, ValueError) as fault:
        listener.close()
        message = f"the socket cannot be made ({fault})."
        raise InputError(
            message, where=where, hint=f"{hint} It has to be on a writable disk of this machine."
        ) from fault
    except BaseException:
        listener.close()
        raise
    return listener


def vacate(path: Path, taken: str, hint: str) -> None:
    """Take away a socket that nobody serves any more; see ``listening``.

    Raises:
        InputError: somebody serves it, or something else is there.
    """
    where = Location(str(path))
    try:
        kind = path.lstat().st_mode
    except FileNotFoundError:
        return
    if not S_ISSOCK(kind):
        raise InputError("it is not a socket.", where=where, hint=f"Remove it, or {hint[:1].lower()}{hint[1:]}")
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe, short_address(path) as address:
        probe.settimeout(1.0)
        try:
            probe.connect(address)
        except (ConnectionRefusedError, FileNotFoundError):
            path.unlink(missing_ok=True)
            return
        except OSError:
            pass
    raise InputError(taken, where=where, hint=hint)
