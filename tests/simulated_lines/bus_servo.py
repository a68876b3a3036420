"""One smart servo: its registers, what they make its motor do, and how it protects itself.

Where the makers' documents leave open what happens, it does what would hurt most: a servo that is switched on goes
to the goal that stands in its register (Feetech), and a written goal switches it on (Feetech, AX-12).
"""

import math
from collections.abc import Callable

import numpy as np

from tests.simulated_lines.bus_motor import BusMotor
from tests.simulated_lines.bus_packets import ACTION, FACTORY_RESET, PING, READ, REBOOT, REG_WRITE, WRITE
from tests.simulated_lines.bus_registers import Register, ServoTable

UNDERVOLTAGE, ANGLE_LIMIT, OVERHEAT, RANGE, CHECKSUM, OVERLOAD, INSTRUCTION = 1, 2, 4, 8, 16, 32, 64
"""Bits of a status byte; the first, third and sixth also of protocol 2's hardware error status."""
NOT_UNDERSTOOD, BAD_CRC, BEYOND_RANGE, BEYOND_LIMIT, NO_ACCESS, ALERT = 2, 3, 4, 6, 7, 0x80
"""Error numbers of protocol 2."""
_MIDDLE_HERE = 128  # Feetech, in the place of torque on and off: choose the homing offset by which this is the middle
_AIR_C = 25.0
_SHUTDOWN_SHARE, _SHUTDOWN_AFTER_S = 0.9, 1.0  # of Dynamixels, whose table does not say


class BusServo:
    """One servo.

    Attributes:
        table: its model; ``motor``: what turns.
        heat: gives its winding's heat, 1 is what that bears; ``volts``: gives the supply's voltage.

    Args:
        zero: the encoder's count where the joint's angle is zero, without a homing offset.
        direction: 1 where larger counts are larger joint angles, else -1.
        random: the encoder's noise.
        eeprom: values by register that differ from the maker's.
    """

    def __init__(
        self,
        table: ServoTable,
        motor: BusMotor,
        zero: float,
        direction: int,
        random: np.random.Generator,
        eeprom: dict[str, int],
    ) -> None:
        self.table, self.motor = table, motor
        self.heat: Callable[[], float] = lambda: 0.0
        self.volts: Callable[[], float] = lambda: 7.4
        self._zero, self._direction, self._random = zero, direction, random
        self._protocol = table.protocol
        self._memory = bytearray(table.size)
        self._put_initial()
        for name, value in eeprom.items():
            self._put(name, value)
        self._saved = bytes(self._memory)
        self.power_cycle()

    @property
    def id(self) -> int:
        return self.get("id")

    @property
    def baud(self) -> int:
        return self.table.bauds.get(self.get("baud"), 0)

    @property
    def amperes(self) -> float:
        return 0.02 + abs(self.motor.load) * self.motor.settings.stall_A

    @property
    def exact_position(self) -> float:
        raw = self._zero + self._direction * self.motor.shaft / self.table.count
        if self._protocol == "feetech":
            return (raw - self.offset) % self.table.counts
        return raw % self.table.counts + self.offset if self._protocol == "dynamixel2" else raw

    @property
    def offset(self) -> int:
        """The homing offset; 0 where there is none."""
        return self.get("homing_offset") if "homing_offset" in self.table.by_name else 0

    def get(self, name: str) -> int:
        register = self.table.by_name[name]
        return register.decoded(self._memory[register.address : register.address + register.size])

    def power_cycle(self) -> None:
        """A brown-out, or a reboot: all as at power-up, what was saved apart."""
        self._put_initial()
        for register in self.table.registers:
            if register.area == "eeprom":
                there = slice(register.address, register.address + register.size)
                self._memory[there] = self._saved[there]
        self._registered: tuple[int, bytes] | None = None
        self._strained = 0.0
        self._faults = 0
        self.motor.energise(on=False)
        if "max_torque" in self.table.by_name:
            self._put("torque_limit", self.get("max_torque"))
        self._put("goal_position", round(self.exact_position))
        self._apply(("goal_speed", "acceleration", "torque_limit"))

    def pass_time(self, seconds: float) -> None:
        """Look at temperature, voltage and load, and protect what needs it."""
        volts, threshold, longest = self.volts(), _SHUTDOWN_SHARE, _SHUTDOWN_AFTER_S
        if self._protocol == "feetech":
            threshold, longest = self.get("overload_torque") / 100, self.get("protection_time") / 100
        self._strained = self._strained + seconds if abs(self.motor.load) >= threshold - 1e-9 else 0.0
        present = 0
        if not self.get("min_voltage") <= volts * self.table.volt <= self.get("max_voltage"):
            present |= UNDERVOLTAGE
        if self._celsius() > self.get("temperature_limit"):
            present |= OVERHEAT
        if self._strained >= longest:
            present |= OVERLOAD
        if self._protocol == "feetech":
            # the shaft stays weak until torque is switched anew
            self._faults = present | self._faults & OVERLOAD
            if present & OVERLOAD:
                self.motor.torque_share = self.get("protective_torque") / 100
            self._let_go(present & OVERHEAT & self.get("unloading"))
        elif self._protocol == "dynamixel2":
            self._faults |= present & self.get("shutdown")
            self._let_go(self._faults)
        else:
            self._faults = present
            self._let_go(present & self.get("shutdown"))

    def execute(self, code: int, params: bytes) -> tuple[int, bytes]:
        """Follow an instruction to this servo alone.

        Returns:
            the status byte and the data.
        """
        size = 2 if self._protocol == "dynamixel2" else 1
        address = int.from_bytes(params[:size], "little")
        error, data = 0, b""
        if code == PING:
            if size == 2:
                data = self._read(0, 2) + self._read(self.table.by_name["firmware_minor"].address, 1)
        elif code == READ and len(params) == 2 * size:
            count = int.from_bytes(params[size:], "little")
            if address + count > self.table.size and self._protocol != "feetech":
                error = self._error(NO_ACCESS, RANGE)
            else:
                data = self._read(address, count)
        elif code == WRITE and len(params) > size:
            error = self.write(address, params[size:])
        elif code == REG_WRITE and len(params) > size:
            self._registered = address, params[size:]
        elif code == ACTION:
            if self._registered is not None:
                error = self.write(*self._registered)
            self._registered = None
        elif code == REBOOT:
            self.power_cycle()
        elif code == FACTORY_RESET:
            self._put_initial()
            self._saved = bytes(self._memory)
            self.power_cycle()
        else:
            error = self._error(NOT_UNDERSTOOD, INSTRUCTION)
        return self.status(error), data

    def status(self, error: int = 0) -> int:
        if self._protocol == "dynamixel2":
            return error | (ALERT if self._faults else 0)
        return error | self._faults

    def answers(self, code: int) -> bool:
        level = self.get("return_level")
        if self._protocol == "feetech":
            return level > 0 or code in (PING, READ)
        return code == PING or level > 1 or (level == 1 and code == READ)

    def write(self, address: int, data: bytes) -> int:
        """Write bytes; gives the error, 0 where there is none."""
        touched = self.table.touched(address, len(data))
        new = bytearray(self._memory) + bytes(max(0, address + len(data) - self.table.size))
        new[address : address + len(data)] = data
        for register in touched:
            if error := self._refused(register, new):
                return error
        saved = bytearray(self._saved)
        for register in touched:
            there = slice(register.address, register.address + register.size)
            if register.area == "read":
                continue
            self._memory[there] = new[there]
            if register.area == "eeprom" and not (self._protocol == "feetech" and self.get("lock")):
                saved[there] = new[there]
        self._saved = bytes(saved)
        self._apply([register.name for register in touched])
        return 0

    def _refused(self, register: Register, memory: bytearray) -> int:
        """The error that a register's new value is; Feetech's servos never say one."""
        value = register.decoded(memory[register.address : register.address + register.size])
        if self._protocol == "feetech":
            return 0
        if register.area == "read":
            return self._error(NO_ACCESS, RANGE)
        if register.area == "eeprom" and (
            self.get("torque_enable") if self._protocol == "dynamixel2" else self.get("lock")
        ):
            return self._error(NO_ACCESS, RANGE)
        if (register.low is not None and value < register.low) or (register.high is not None and value > register.high):
            return self._error(BEYOND_RANGE, RANGE)
        if register.name == "goal_position" and not self.get("min_position") <= value <= self.get("max_position"):
            return self._error(BEYOND_LIMIT, ANGLE_LIMIT)
        return 0

    def _error(self, number: int, bit: int) -> int:
        return number if self._protocol == "dynamixel2" else bit

    def _apply(self, names: list[str] | tuple[str, ...]) -> None:
        """Do what changed registers ask for, in an order that a single write cannot choose."""
        table, motor = self.table, self.motor
        if "goal_speed" in names:
            motor.speed = self.get("goal_speed") * table.speed_unit or math.inf
        if "acceleration" in names and table.acceleration_unit is not None:
            motor.acceleration = self.get("acceleration") * table.acceleration_unit
        if {"torque_limit", "torque_enable"} & set(names) and "torque_limit" in table.by_name:
            motor.torque_share = min(1.0, self.get("torque_limit") / 1000)
        if "torque_enable" in names:
            self._switch(self.get("torque_enable"))
        elif "goal_position" in names and self._protocol != "dynamixel2" and not self.get("torque_enable"):
            self._put("torque_enable", 1)
            self._switch(1)
        if "goal_position" in names and motor.setpoint is not None:
            self._go()

    def _switch(self, value: int) -> None:
        """Torque on or off."""
        if self._protocol == "feetech" and value == _MIDDLE_HERE:
            raw = self._zero + self._direction * self.motor.shaft / self.table.count
            half = self.table.counts // 2
            self._put("homing_offset", round(raw % self.table.counts) - half)
            self._put("torque_enable", int(self.motor.setpoint is not None))
            return
        if self._protocol == "dynamixel2" and self._faults & self.get("shutdown"):
            self._put("torque_enable", 0)
            return
        if self._protocol == "feetech":
            self._faults &= ~OVERLOAD
        self._strained = 0.0
        if value and self._protocol == "dynamixel2" and self.motor.setpoint is None:
            self._put("goal_position", round(self.exact_position))
        self.motor.energise(on=bool(value))
        if value:
            self._go()

    def _go(self) -> None:
        """Send the motor to the goal in the register; the way to it never crosses the end of the counts."""
        low, high = self.get("min_position"), self.get("max_position")
        goal = self.get("goal_position")
        if low < high:
            goal = min(max(goal, low), high)
        away = (goal - self.exact_position) * self.table.count
        self.motor.goal = self.motor.shaft + self._direction * away

    def _let_go(self, fault: int) -> None:
        if fault and self.motor.setpoint is not None:
            self._put("torque_enable", 0)
            self.motor.energise(on=False)

    def _read(self, address: int, count: int) -> bytes:
        """Bytes of its registers, once what it measures stands there."""
        motor, table = self.motor, self.table
        noise = motor.settings.encoder_noise_counts * self._random.standard_normal()
        position = round(self.exact_position + noise)
        if self._protocol == "feetech":
            position %= table.counts
        elif self._protocol == "dynamixel1":
            position = min(max(position, 0), table.counts - 1)
        rate = self._direction * math.copysign(motor.rate, motor.goal - (motor.setpoint or 0.0)) / table.speed_unit
        load, faults = self._direction * motor.load, self._faults
        values = {
            "position": position,
            "speed": round(rate),
            "load": round(1000 * load),
            "current": round(1000 * self.amperes / 6.5),
            "voltage": round(self.volts() * table.volt),
            "temperature": round(self._celsius()),
            "moving": int(motor.moving),
            "status": faults,
            "registered": int(self._registered is not None),
        }
        for name, value in values.items():
            if name in table.by_name:
                self._put(name, value)
        return bytes(self._memory[address : address + count]).ljust(count, b"\0")

    def _celsius(self) -> float:
        return _AIR_C + self.motor.settings.rise_K * self.heat()

    def _put(self, name: str, value: int) -> None:
        register = self.table.by_name[name]
        self._memory[register.address : register.address + register.size] = register.encoded(value)

    def _put_initial(self) -> None:
        for register in self.table.registers:
            self._put(register.name, register.initial)
