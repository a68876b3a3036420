"""The bench ``bus_bench_at_line``: smart servos on a bus at a pty, an arm that they carry, and a tracker."""

import math
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from armcal.arm.joints import unknown_joint
from armcal.arm.servo import SPLINE_TEETH
from armcal.devices.simulated import BenchRequest, RunningBench, SimulatedBench
from armcal.errors import ConfigError
from armcal.run.experiment import Experiment
from armcal_simulation.servos import SafetySettings
from armcal_simulation.world import ALL, TrackedArm
from pydantic import Field, field_validator, model_validator
from typing_extensions import override

from tests.simulated_lines.bus_motor import BusMotor, BusMotorSettings
from tests.simulated_lines.bus_registers import TABLES, ServoTable
from tests.simulated_lines.bus_servo import BusServo
from tests.simulated_lines.line_world import BenchAtLine, LineTruthSettings, LineWorld
from tests.simulated_lines.servo_bus import ServoBus

_TURN = 2 * math.pi
_BURNING = 0.95


class BusJointSettings(BusMotorSettings):
    """One servo as it truly is: what a host may believe of it stands under ``bench.device``.

    ``zero_count`` is what it reads at the joint's zero, with its ``homing_offset`` and its horn on the right tooth;
    ``horn_teeth`` says by how many teeth it is not. ``limits`` are its position limits (counts), none by default.
    """

    id: Annotated[int, Field(ge=0, le=252)] = 1
    model: str = "sts3215"
    baud: int | None = None
    zero_count: float = 2048
    direction: Literal[1, -1] = 1
    homing_offset: int = 0
    horn_teeth: int = 0
    limits: tuple[int, int] | None = None

    @field_validator("model")
    @classmethod
    def _known(cls, model: str) -> str:
        if model not in TABLES:
            raise ValueError(f"found {model!r}, expected one of {', '.join(TABLES)}")
        return model

    @property
    def table(self) -> ServoTable:
        return TABLES[self.model]


class BusBenchSettings(LineTruthSettings):
    """The truth of a bench with smart servos; ``joints`` has them by joint, and what ``all`` have in common.

    ``baud`` is that of the servos, ``echo`` whether the adapter hears itself. ``supply_V`` sags by ``supply_ohm``.
    Servos that are switched on together are no offence, for they stay where they stand.
    """

    baud: int = 1_000_000
    echo: bool = False
    supply_V: Annotated[float, Field(gt=0)] = 7.4
    supply_ohm: Annotated[float, Field(ge=0)] = 0.1
    joints: dict[str, BusJointSettings]
    safety: SafetySettings = Field(default_factory=lambda: SafetySettings.si(together=0.0))

    @model_validator(mode="after")
    def _one_protocol(self) -> Self:
        stated = {self.servo_of(joint).table.protocol for joint in self.joints if joint != ALL}
        if len(stated) > 1:
            raise ValueError(f"found servos of {' and '.join(sorted(stated))}, expected one protocol: it is one bus")
        return self

    def baud_code(self, servo: BusJointSettings) -> int:
        """What stands in a servo's baud register.

        Raises:
            ConfigError: the model has no such rate.
        """
        baud = servo.baud or self.baud
        for code, rate in servo.table.bauds.items():
            if rate == baud:
                return code
        rates = ", ".join(map(str, servo.table.bauds.values()))
        raise ConfigError(f"bench.simulator: found {baud} baud, expected one of {rates} for {servo.model}.")


class BusWorld(LineWorld):
    """Smart servos on their bus. Motors are judged by the set points that they follow.

    Raises:
        ConfigError: the settings do not fit the experiment.
    """

    kinds: ClassVar[tuple[str, ...]] = (
        *LineWorld.kinds, "reset", "brown_out", "disconnect", "connect", "jam", "free", "heat", "put",
    )  # fmt: skip

    def __init__(self, settings: BusBenchSettings, experiment: Experiment, folder: Path) -> None:
        tracked = TrackedArm(settings, experiment)
        names = list(tracked.arm.commanded)
        if fault := unknown_joint([joint for joint in (*settings.joints, *settings.start) if joint != ALL], names):
            raise ConfigError(f"bench.simulator: {fault}.")
        if missing := sorted(set(names) - set(settings.joints)):
            text = f"bench.simulator: found no servo for {', '.join(missing)}."
            raise ConfigError(text, hint="Give each joint its id.")
        random = np.random.default_rng([settings.seed, 2])
        self._servos = {joint: _bus_servo(settings, joint, random) for joint in names}
        motors = {joint: servo.motor for joint, servo in self._servos.items()}
        super().__init__(settings, tracked, motors, None, folder)
        supply, chain = (settings.supply_V, settings.supply_ohm), list(self._servos.values())
        self._bus = ServoBus(self.time, chain, self.send, self.baud, random, echo=settings.echo, supply=supply)
        self.split = self._bus.split
        self._setpoints: dict[str, float | None] = dict.fromkeys(names)
        for joint, servo in self._servos.items():
            servo.heat = lambda heat=self.heat[joint]: heat.winding  # type: ignore[misc]

    @override
    def boot(self) -> None:
        self._bus.boot()
        self.moved()

    @override
    def receive(self, data: bytes) -> None:
        self._bus.receive(data)
        self.moved()
        self.commands_changed()

    @override
    def next_event(self) -> float:
        return self._bus.next_event()

    @override
    def run_timers(self) -> None:
        self._bus.run_timers()
        self.moved()
        self.commands_changed()

    @override
    def moved(self) -> None:
        for joint, servo in self._servos.items():
            before, now = self._setpoints[joint], servo.motor.setpoint
            if before != now:
                self._setpoints[joint] = now
                self.safety.committed(joint, self.now, before, now, _TURN / 4096, self.torques[joint])

    @override
    def fail(self, fault: Any) -> None:
        for joint, servo in self._servos.items():
            if fault.joint not in (None, joint):
                continue
            if fault.kind in ("brown_out", "reset"):
                servo.power_cycle()
            elif fault.kind == "disconnect":
                self._bus.absent.add(servo)
            elif fault.kind == "connect":
                self._bus.absent.discard(servo)
            elif fault.kind == "jam":
                servo.motor.stops = (servo.motor.shaft, servo.motor.shaft)
            elif fault.kind == "free":
                servo.motor.stops = servo.motor.settings.travel
            elif fault.kind == "put":
                servo.motor.put(fault.angle)
            elif fault.kind == "heat":
                self.heat[joint].winding = _BURNING
        self.moved()
        self.commands_changed()
        super().fail(fault)

    @override
    def state(self) -> dict[str, Any]:
        servos = {
            joint: {
                "id": servo.id,
                "position": servo.exact_position,
                "homing_offset": servo.offset,
                "status": servo.status(),
                "connected": servo not in self._bus.absent,
                "shaft_rad": servo.motor.shaft,
            }
            for joint, servo in self._servos.items()
        }
        return {**super().state(), "bus": servos, "volts": self._bus.volts()}


class BusBenchAtLine(SimulatedBench):
    """The bench ``bus_bench_at_line``; see ``ServoBenchAtLine``."""

    Settings: ClassVar[type[BusBenchSettings]] = BusBenchSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {"joints": {"q1": {"id": 1}}}

    def __init__(self, settings: BusBenchSettings) -> None:
        self.settings = settings

    @override
    def start(self, request: BenchRequest) -> RunningBench:
        return BenchAtLine(request)

    def serve(self, experiment: Experiment, folder: Path) -> None:
        """Until its end."""
        BusWorld(self.settings, experiment, folder).serve()


def _bus_servo(settings: BusBenchSettings, joint: str, random: np.random.Generator) -> BusServo:
    """A servo with its EEPROM, and its motor, which stands where the arm is put at the start."""
    stated = settings.servo_of(joint)
    table = stated.table
    eeprom = {"id": stated.id, "baud": settings.baud_code(stated)}
    if "homing_offset" in table.by_name:
        eeprom["homing_offset"] = stated.homing_offset
    if stated.limits is not None:
        eeprom |= dict(zip(("min_position", "max_position"), stated.limits, strict=True))
    sign = -1 if table.protocol == "dynamixel2" else 1
    teeth = stated.direction * stated.horn_teeth * _TURN / SPLINE_TEETH / table.count
    zero = stated.zero_count + sign * stated.homing_offset + teeth
    motor = BusMotor(stated, settings.start.get(joint, 0.0))
    return BusServo(table, motor, zero, stated.direction, random, eeprom)
