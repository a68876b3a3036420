"""The servos of joints, by name: what they read, and goals, torque and speed."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from armcal.devices.device import DeviceError

from armcal_servobus.bus import Bus
from armcal_servobus.finding import alarms_of, read_number
from armcal_servobus.joints import ServoJoint

_TIME_BYTES = 2
"""Between goal and speed some have a time to be taken, which is zero here: the speed holds."""


@dataclass(frozen=True)
class ServoReading:
    """What a servo says while it works.

    Attributes:
        position, goal: counts, as its registers have them.
        has_torque: whether it holds.
        load: share of full torque (-1 to 1), or its current (A) where the model says that.
        voltage: V.
        temperature: deg C.
        alarms: in words.
    """

    position: int
    goal: int
    has_torque: bool
    load: float
    voltage: float
    temperature: float
    alarms: tuple[str, ...] = ()


class Servos:
    """All of a bus; each call is an exchange or two for all of them."""

    def __init__(self, bus: Bus, joints: Mapping[str, ServoJoint]) -> None:
        self._bus, self._joints = bus, joints
        self._goals: dict[str, int] = {}
        self._speeds: dict[str, int] = {}

    def reading(self, joint: str) -> ServoReading:
        return self.readings((joint,))[joint]

    def readings(self, names: Iterable[str] | None = None) -> dict[str, ServoReading]:
        """Of all joints, or of some.

        Raises:
            DeviceError: one does not answer, or not well.
        """
        joints = [self._joints[name] for name in (self._joints if names is None else names)]
        values: dict[str, dict[str, int]] = {joint.name: {} for joint in joints}
        by_polled: dict[tuple[tuple[int, int], ...], list[ServoJoint]] = {}
        for joint in joints:
            by_polled.setdefault(joint.model.polled, []).append(joint)
        for polled, alike in by_polled.items():
            for stretch in polled:
                together = all(joint.model.reads_together for joint in alike)
                data = self._bus.read_all([joint.id for joint in alike], *stretch, together=together)
                for joint in alike:
                    model = joint.model
                    names_there = [name for name in model.registers if model.holds(name, stretch)]
                    values[joint.name] |= {name: model.unpack(name, data[joint.id], stretch[0]) for name in names_there}
        readings = {}
        for joint in joints:
            own, registers = values[joint.name], joint.model.registers
            readings[joint.name] = ServoReading(
                position=own["position"],
                goal=own["goal"],
                has_torque=bool(own["torque"]),
                load=own["load"] * registers["load"].unit,
                voltage=own["voltage"] * registers["voltage"].unit,
                temperature=float(own["temperature"]),
                alarms=alarms_of(self._bus, joint.id, joint.model),
            )
        return readings

    def positions(self) -> dict[str, int]:
        """Counts of all joints, in one exchange; quicker than ``readings``."""
        positions: dict[str, int] = {}
        by_model: dict[tuple[int, int, bool], list[ServoJoint]] = {}
        for joint in self._joints.values():
            register = joint.model.registers["position"]
            by_model.setdefault((register.address, register.size, joint.model.reads_together), []).append(joint)
        for (address, size, together), alike in by_model.items():
            data = self._bus.read_all([joint.id for joint in alike], address, size, together=together)
            positions |= {joint.name: joint.model.unpack("position", data[joint.id]) for joint in alike}
        return positions

    def set_motion(self, joint: ServoJoint, speed: float, acceleration: float) -> None:
        """How fast a servo turns by itself at most (rad/s, rad/s^2). Zero would be no limit, so it is never written."""
        for name, value in (("acceleration", acceleration), ("speed", speed)):
            if name in joint.model.registers:
                register = joint.model.registers[name]
                most = 254 if register.size == 1 else 1023 if joint.model.counts == 1024 else 32767
                unit = register.unit if register.unit != 1.0 else joint.model.step
                number = min(max(round(value / unit), 1), most)
                self._write(joint, name, number)
                if name == "speed":
                    self._speeds[joint.name] = number

    def hold(self, joint: ServoJoint, count: int) -> None:
        """Torque on, at a count that is where it stands."""
        self._write(joint, "goal", count)
        self._write(joint, "torque", 1)
        self._write(joint, "goal", count)  # some servos set their goal anew when torque comes on
        self._goals[joint.name] = count

    def release(self, joint: ServoJoint) -> None:
        """Torque off, read back.

        Raises:
            DeviceError: it is still on.
        """
        self._goals.pop(joint.name, None)
        self._write(joint, "torque", 0)
        if read_number(self._bus, joint.id, joint.model, "torque"):
            text = f"the torque of {joint.name} (id {joint.id}) did not go off."
            raise DeviceError(text, where=self._bus.where, hint="Hold the arm and switch the servos' power off.")

    def command(self, goals: Mapping[str, int]) -> None:
        self._goals |= goals
        places: dict[tuple[int, int], dict[int, bytes]] = {}
        for name, goal in goals.items():
            address, data = self._with_speed(self._joints[name], goal)
            places.setdefault((address, len(data)), {})[self._joints[name].id] = data
        for (address, _), by_id in places.items():
            self._bus.write_all(address, by_id)

    def repeat(self, readings: Mapping[str, ServoReading], powered: Iterable[str]) -> None:
        """Command once more what did not arrive: a goal for all at once is acknowledged by nobody.

        Raises:
            DeviceError: a servo does not take its goal.
        """
        chosen = set(powered) & set(self._goals)
        missed = {name: self._goals[name] for name in readings if name in chosen}
        missed = {name: goal for name, goal in missed.items() if readings[name].goal != goal}
        for name, goal in missed.items():
            self._bus.write(self._joints[name].id, *self._with_speed(self._joints[name], goal))

    def _with_speed(self, joint: ServoJoint, goal: int) -> tuple[int, bytes]:
        """The address and the bytes that set a goal, and the speed in the same go where its register is at hand.

        A servo that started anew has forgotten its speed, and some switch their torque on with the next goal.
        """
        model = joint.model
        first, speed, data = model.registers["goal"], model.registers.get("speed"), model.pack("goal", goal)
        between = -1 if speed is None else speed.address - first.address - first.size
        if joint.name not in self._speeds or not 0 <= between <= _TIME_BYTES:
            return first.address, data
        return first.address, data + bytes(between) + model.pack("speed", self._speeds[joint.name])

    def _write(self, joint: ServoJoint, name: str, value: int) -> None:
        self._bus.write(joint.id, joint.model.registers[name].address, joint.model.pack(name, value))
