"""The simulated bench ``servo_bench``: a servo board at a pty, an arm of hobby servos, and a tracker."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, ClassVar

from armcal.devices.simulated import BOARD, CLOCK, BenchRequest
from armcal.io.signals import Signals
from armcal.testing import EXAMPLE_TRUTH

from armcal_simulation.bench_settings import ServoBenchSettings
from armcal_simulation.bench_world import BenchWorld
from armcal_simulation.clock_server import ClockServer

EXAMPLE_SERVOS = Path(__file__).with_name("example_servos.yaml")


class ServoBench:
    """The simulated bench ``servo_bench``.

    Everything happens in simulated time, which passes only when the clock's socket is asked to let it pass. The same
    seed and the same requests give the same bytes.
    """

    Settings: ClassVar[type[ServoBenchSettings]] = ServoBenchSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "firmware": "framed",
        "servos": str(EXAMPLE_SERVOS),
        "truth": str(EXAMPLE_TRUTH),
        "joints": {"all": {"backlash_deg": 0.1}, "q2": {"continuous_Nm": 0.8}},
        "tracker": {"port": 5000, "noise_mm": 0.05},
        "seed": 1,
    }

    def __init__(self, settings: ServoBenchSettings) -> None:
        self._settings = settings

    def serve(self, request: BenchRequest) -> None:
        """See ``armcal.devices.simulated.SimulatedBench``.

        Raises:
            ConfigError: the settings do not fit the experiment.
            InputError: the folder cannot be used.
        """
        world = BenchWorld(self._settings, request.experiment, request.folder)
        try:
            server = ClockServer(request.folder / CLOCK, world.answer)
            try:
                with Signals() as signals:
                    world.start(request.folder / BOARD)
                    server.listen()  # after the board: who finds the clock finds the board as well
                    server.serve(world.port, world.attend_line, lambda: world.stopped or signals.finish)
            finally:
                server.close()
        finally:
            world.close()
