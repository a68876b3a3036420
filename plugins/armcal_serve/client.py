"""Asks a running server over its Unix socket; a short one, for programs in Python."""

import json
import socket
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

from armcal.errors import ArmcalError, InputError, Location
from armcal.io.unix_socket import short_address


class Client:
    """A connection, for requests one after another.

    Raises:
        InputError: no server is there.
    """

    def __init__(self, path: Path, timeout_s: float = 30.0) -> None:
        self._where = Location(str(path))
        self._connection = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        self._connection.settimeout(timeout_s)
        try:
            with short_address(path) as address:
                self._connection.connect(address)
        except OSError as fault:
            self._connection.close()
            hint = "Start `armcal serve CALIBRATION --socket` with this path."
            raise InputError(f"no server answers here ({fault}).", where=self._where, hint=hint) from fault
        self._answers = self._connection.makefile("rb")

    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to a request; see ``armcal_serve.protocol``.

        Raises:
            ArmcalError: the server went away, or takes too long.
        """
        try:
            self._connection.sendall(json.dumps(request).encode() + b"\n")
            line = self._answers.readline()
        except OSError as fault:
            raise ArmcalError(f"no answer came ({fault}).", where=self._where, hint="Connect anew.") from fault
        if not line:
            raise ArmcalError("the server closed the connection.", where=self._where, hint="Connect anew.")
        return dict(json.loads(line))

    def close(self) -> None:
        self._answers.close()
        self._connection.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, fault: BaseException | None, at: TracebackType | None) -> None:
        self.close()
