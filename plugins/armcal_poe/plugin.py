"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_models(register: Register) -> None:
    register("poe", "armcal_poe.model:PoeModel", "a product of exponentials: one screw a joint, in the base frame")
