"""The clock of a bench in another process, over its socket."""

from pathlib import Path
from typing import Any

from armcal.devices.clock import Clock
from armcal.errors import InputError, Location
from armcal.io.json_server import JsonClient
from typing_extensions import override

_LONGEST_ANSWER_S = 60.0


class SimulatedClock(Clock):
    """The clock of a simulated bench: time passes there, and only there, while this one sleeps.

    Everything else takes no time at all. When ``sleep`` returns, the bench has done all that it does in that time:
    its arm has moved and its tracker has sent. A request is a JSON object a line on a Unix socket, and so is its
    answer: ``{"advance": s}`` is answered by ``{"now": s, "wall": unix_s}``.

    Raises:
        InputError: no simulated bench answers there.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        try:
            self._client = JsonClient(path, _LONGEST_ANSWER_S)
        except OSError as fault:
            raise self._refusal(str(fault)) from fault
        self._read = self.ask({"advance": 0.0})

    @override
    def now(self) -> float:
        return float(self._read["now"])

    @override
    def wall(self) -> float:
        return float(self._read["wall"])

    @override
    def sleep(self, seconds: float) -> None:
        if seconds > 0:
            self._read = self.ask({"advance": seconds})

    def ask(self, request: dict[str, Any]) -> dict[str, Any]:
        """Any request to the simulated bench, and its answer.

        Raises:
            InputError: the bench is gone, or refuses.
        """
        try:
            answer = self._client.ask(request)
        except OSError as fault:
            raise self._refusal(str(fault)) from fault
        if "error" in answer:
            raise self._refusal(str(answer["error"]))
        return answer

    def close(self) -> None:
        self._client.close()

    def _refusal(self, why: str) -> InputError:
        return InputError(
            f"the simulated bench does not answer ({why}).",
            where=Location(str(self._path)),
            hint="It has ended, or never began.",
        )
