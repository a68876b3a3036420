"""Asks a running server over its Unix socket; a short one, for programs in Python."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from armcal.errors import ArmcalError, InputError, Location
from armcal.io.json_server import JsonClient
from typing_extensions import override


class Client(JsonClient):
    """A connection, for requests one after another.

    Raises:
        InputError: no server is there.
    """

    def __init__(self, path: Path, timeout_s: float = 30.0) -> None:
        self._where = Location(str(path))
        try:
            super().__init__(path, timeout_s)
        except OSError as fault:
            hint = "Start `armcal serve CALIBRATION --socket` with this path."
            raise InputError(f"no server answers here ({fault}).", where=self._where, hint=hint) from fault

    @override
    def ask(self, request: Mapping[str, Any]) -> dict[str, Any]:
        """The answer to a request; see docs/serve.md.

        Raises:
            ArmcalError: the server went away, or takes too long.
        """
        try:
            return super().ask(request)
        except OSError as fault:
            raise ArmcalError(f"no answer came ({fault}).", where=self._where, hint="Connect anew.") from fault
