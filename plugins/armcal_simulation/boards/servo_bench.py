"""The simulated bench ``servo_bench``: a servo board at a pty, an arm of hobby servos, and a tracker."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from armcal.devices.simulated import BenchRequest, SimulatedBench
from armcal.run.experiment import Experiment
from typing_extensions import override

from armcal_simulation.bench.faults import FaultRequest
from armcal_simulation.bench.parts import ServoBenchSettings, bounds_of, tracked_arm, true_servos
from armcal_simulation.bench.serial_line import delimited
from armcal_simulation.bench.servo_model import ServoModel
from armcal_simulation.bench.world import BenchWorld
from armcal_simulation.boards.framed_board import BoardIdentity, FramedBoard
from armcal_simulation.boards.pca9685_model import Commit, I2cBus, Pca9685Model

EXAMPLE_SERVOS = Path(__file__).with_name("example_servos.yaml")
_EEPROM = "eeprom.json"
_SHOWN_VIOLATIONS = 20


class PulseBench(BenchWorld):
    """Boards whose pulses drive hobby servos, behind one firmware.

    Args:
        folder: for what the board keeps when it is off, too.

    Raises:
        ConfigError: the settings do not fit the experiment.
    """

    faults: ClassVar[tuple[str, ...]] = ("reset", "brown_out", "nack", "stuck")

    def __init__(self, settings: ServoBenchSettings, experiment: Experiment, folder: Path) -> None:
        tracked = tracked_arm(settings, experiment)
        file = true_servos(settings, tracked.arm)
        self._models = {
            joint: ServoModel(settings.servo_of(joint), file.servos[joint].table, settings.start.get(joint, 0.0))
            for joint in tracked.arm.commanded
        }
        pulses = {joint: servo.pulse_range for joint, servo in file.servos.items()}
        super().__init__(settings, tracked, self._models, bounds_of(experiment, pulses), folder)
        self._eeprom = folder / _EEPROM
        self._chips = {n: Pca9685Model(self.clock, b.oscillator_hz, b.address) for n, b in file.boards.items()}
        for name, chip in self._chips.items():
            chip.on_commit = partial(self._committed, name)
        self._joints = {(servo.board, servo.channel): joint for joint, servo in file.servos.items()}
        self._bus = I2cBus(self.clock, list(self._chips.values()))
        identity = BoardIdentity(settings.board_id, settings.states_oscillator_hz)
        try:
            boots = int(json.loads(self._eeprom.read_text(encoding="utf-8"))["boots"])
        except (OSError, ValueError, KeyError, TypeError):
            boots = 0
        self._board = FramedBoard(self.clock, self._bus, self.send, identity, boots)
        self.split = delimited(self._board.delimiter)

    @override
    def boot(self) -> None:
        self._board.boot()
        self._eeprom.write_text(json.dumps({"boots": self._board.boots}) + "\n", encoding="utf-8")

    @override
    def receive(self, data: bytes) -> None:
        self._board.receive(data)

    @override
    def next_event(self) -> float:
        return self._board.next_event()

    @override
    def run_timers(self) -> None:
        self._board.run_timers()

    @override
    def fail(self, fault: FaultRequest) -> None:
        if fault.kind in ("reset", "brown_out"):
            if fault.kind == "brown_out":
                for chip in self._chips.values():
                    chip.power_cycle()
            self.boot()
        elif fault.kind == "nack":
            self._bus.plan_nack(fault.byte, fault.after)
        elif fault.kind == "stuck":
            self._bus.hold_down(fault.seconds)

    @override
    def state(self) -> dict[str, Any]:
        broken = [[v.time, name, v.rule] for name, chip in self._chips.items() for v in chip.violations]
        return {
            "pulses_s": {joint: self._chips[b].pulse_s(channel) for (b, channel), joint in self._joints.items()},
            "violations": len(broken),
            "violated": broken[-_SHOWN_VIOLATIONS:],
            "board": {"boots": self._board.boots, "took_over": self._board.guard.took_over},
        }

    def _committed(self, board: str, commit: Commit) -> None:
        joint = self._joints.get((board, commit.channel))
        if joint is not None:
            self.safety.committed(joint, commit, self._chips[board].period_s, self.physics.torques[joint])
            self._models[joint].set_pulse(commit.after)
            self.physics.commands_changed()


class ServoBench(SimulatedBench):
    """The simulated bench ``servo_bench``.

    Everything happens in simulated time, which passes only on requests to the clock's socket. The same
    seed and the same requests give the same bytes.
    """

    Settings: ClassVar[type[ServoBenchSettings]] = ServoBenchSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {
        "servos": str(EXAMPLE_SERVOS),
        "truth": "truth.yaml",
        "joints": {"all": {"backlash_deg": 0.1}, "q2": {"continuous_Nm": 0.8}},
        "tracker": {"port": 5000, "noise_mm": 0.05},
        "seed": 1,
    }

    def __init__(self, settings: ServoBenchSettings) -> None:
        self._settings = settings

    @override
    def serve(self, request: BenchRequest) -> None:
        PulseBench(self._settings, request.experiment, request.folder).serve()
