"""Two directories change places in one step, where the system can do that."""

from __future__ import annotations

import ctypes
import errno
import os
from pathlib import Path

_HERE = -100
"""AT_FDCWD: paths are as they are."""
_EXCHANGE = 2
"""RENAME_EXCHANGE"""
_CANNOT = {errno.ENOSYS, errno.EINVAL, errno.EOPNOTSUPP, errno.EBUSY, errno.EXDEV, errno.EPERM, errno.EACCES}


def change_places(one: Path, two: Path) -> bool:
    """Whether they did; nothing has changed where system or file system cannot do it.

    Raises:
        OSError: something else was in the way; nothing has changed.
    """
    library = ctypes.CDLL(None, use_errno=True)
    if not hasattr(library, "renameat2"):
        return False
    if not library.renameat2(_HERE, os.fsencode(one), _HERE, os.fsencode(two), _EXCHANGE):
        return True
    code = ctypes.get_errno()
    if code in _CANNOT:
        return False
    raise OSError(code, os.strerror(code), str(two))
