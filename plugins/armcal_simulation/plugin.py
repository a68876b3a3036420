"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl

_HERE = "armcal_simulation"


@hookimpl
def armcal_register_simulators(register: Register) -> None:
    register("elastic_arm", f"{_HERE}.simulator:ElasticArmSimulator", "an arm with a stated truth")
    register("contacts", f"{_HERE}.contacts:ContactsSimulator", "postures in sockets and clamps")


@hookimpl
def armcal_register_benches(register: Register) -> None:
    register("servo_bench", f"{_HERE}.boards.servo_bench:ServoBench", "a servo board at a pty, an arm, a tracker")
    register("bus_bench", f"{_HERE}.bus.bus_bench:BusBench", "smart servos on a bus at a pty, an arm, a tracker")
