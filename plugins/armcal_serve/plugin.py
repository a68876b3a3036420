"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register("serve", "armcal_serve.command:serve", "Answer forward, compensate and status requests of other programs.")
