"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl

_HERE = "armcal_simulation"


@hookimpl
def armcal_register_simulators(register: Register) -> None:
    register("elastic_arm", f"{_HERE}.simulators:ElasticArmSimulator", "an arm with a stated truth")
    register("contacts", f"{_HERE}.simulators:ContactsSimulator", "postures in sockets and clamps")


@hookimpl
def armcal_register_benches(register: Register) -> None:
    register("servo_bench", f"{_HERE}.servo_bench:ServoBench", "a board, an arm of servos and a tracker")
