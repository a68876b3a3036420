"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_simulators(register: Register) -> None:
    """Announce the simulators."""
    register("elastic_arm", "armcal_simulation.simulator:ElasticArmSimulator", "an arm with a stated truth")
    register("contacts", "armcal_simulation.contacts:ContactsSimulator", "postures in sockets and clamps")
    register("mission", "armcal_simulation.mission:MissionOfDays", "a rover's arm over some days, and what befalls it")


@hookimpl
def armcal_register_benches(register: Register) -> None:
    """Announce the simulated benches."""
    register("servo_bench", "armcal_simulation.servo_bench:ServoBench", "a servo board at a pty, an arm, a tracker")
    register("bus_bench", "armcal_simulation.bus_bench:BusBench", "smart servos on a bus at a pty, an arm, a tracker")
