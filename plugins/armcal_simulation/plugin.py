"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_simulators(register: Register) -> None:
    """Announce the simulator."""
    register("elastic_arm", "armcal_simulation.simulator:ElasticArmSimulator", "an arm with a stated truth")
