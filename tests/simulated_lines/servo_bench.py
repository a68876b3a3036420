"""The bench ``servo_bench_at_line``: a servo board at a pty, an arm of hobby servos, and a tracker."""

import json
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

from armcal.base.settings import InputPath
from armcal.devices.simulated import BenchRequest, RunningBench, SimulatedBench
from armcal.run.experiment import Experiment
from armcal_simulation.servo_bench import true_servos
from armcal_simulation.servos import JointServo
from armcal_simulation.world import TrackedArm
from pydantic import Field
from typing_extensions import override

from tests.simulated_lines.framed_board import BoardIdentity, FramedBoard
from tests.simulated_lines.line_world import BenchAtLine, LineTruthSettings, LineWorld
from tests.simulated_lines.pca9685_model import COUNTS, I2cBus, Pca9685Model, PinCommit
from tests.simulated_lines.serial_line import delimited

_EEPROM = "eeprom.json"
_SHOWN_VIOLATIONS = 20


class ServoBenchSettings(LineTruthSettings):
    """``board_id`` (that of the true servo file) and ``states_oscillator_hz`` are what a board reports (0: nothing)."""

    servos: InputPath
    board_id: str = ""
    states_oscillator_hz: int = Field(0, ge=0, le=2**32 - 1)


class PulseBench(LineWorld):
    """Boards whose pulses drive hobby servos, behind one firmware.

    Args:
        folder: for what the board keeps when it is off, too.

    Raises:
        ConfigError: the settings do not fit the experiment.
    """

    kinds: ClassVar[tuple[str, ...]] = (*LineWorld.kinds, "reset", "brown_out", "nack", "stuck")

    def __init__(self, settings: ServoBenchSettings, experiment: Experiment, folder: Path) -> None:
        tracked = TrackedArm(settings, experiment)
        file = true_servos(settings, tracked.arm.commanded)
        self._models = {
            joint: JointServo(settings.servo_of(joint), settings.start.get(joint, 0.0), file.servos[joint].table)
            for joint in tracked.arm.commanded
        }
        super().__init__(settings, tracked, self._models, file, folder)
        self._eeprom = folder / _EEPROM
        self._chips = {n: Pca9685Model(self.time, b.oscillator_hz, b.address) for n, b in file.boards.items()}
        for name, chip in self._chips.items():
            chip.on_commit = partial(self._committed, name)
        self._joints = {(servo.board, servo.channel): joint for joint, servo in file.servos.items()}
        self._bus = I2cBus(self.time, list(self._chips.values()))
        identity = BoardIdentity(
            settings.board_id or next(iter(file.boards.values())).id, settings.states_oscillator_hz
        )
        try:
            boots = int(json.loads(self._eeprom.read_text(encoding="utf-8"))["boots"])
        except (OSError, ValueError, KeyError, TypeError):
            boots = 0
        self._board = FramedBoard(self.time, self._bus, self.send, identity, boots)
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
    def fail(self, fault: Any) -> None:
        if fault.kind in ("reset", "brown_out"):
            if fault.kind == "brown_out":
                for chip in self._chips.values():
                    chip.power_cycle()
            self.boot()
        elif fault.kind == "nack":
            self._bus.plan_nack(fault.byte, fault.after)
        elif fault.kind == "stuck":
            self._bus.hold_down(fault.seconds)
        super().fail(fault)

    @override
    def state(self) -> dict[str, Any]:
        broken = [[v.time, name, v.rule] for name, chip in self._chips.items() for v in chip.violations]
        return {
            **super().state(),
            "pulses_s": {joint: self._chips[b].pulse_s(channel) for (b, channel), joint in self._joints.items()},
            "violations": len(broken),
            "violated": broken[-_SHOWN_VIOLATIONS:],
            "board": {"boots": self._board.boots, "took_over": self._board.guard.took_over},
        }

    def _committed(self, board: str, pin: PinCommit) -> None:
        joint = self._joints.get((board, pin.channel))
        if joint is not None:
            step = self._chips[board].period_s / COUNTS
            self.safety.committed(joint, pin.time, pin.before, pin.after, step, self.torques[joint])
            self._models[joint].command(pin.after)
            self.commands_changed()


class ServoBenchAtLine(SimulatedBench):
    """The bench ``servo_bench_at_line``: a session meets it at its port; ``serve`` is for a process of its own."""

    Settings: ClassVar[type[ServoBenchSettings]] = ServoBenchSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"servos": "servos.yaml"}

    def __init__(self, settings: ServoBenchSettings) -> None:
        self.settings = settings

    @override
    def start(self, request: BenchRequest) -> RunningBench:
        return BenchAtLine(request)

    def serve(self, experiment: Experiment, folder: Path) -> None:
        """Until its end."""
        PulseBench(self.settings, experiment, folder).serve()
