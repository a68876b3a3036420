"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_models(register: Register) -> None:
    register("mdh", "armcal_mdh.model:MdhModel", "Denavit-Hartenberg rows (standard or craig) with extra transforms")
