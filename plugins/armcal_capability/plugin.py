"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    """Announce the commands."""
    register(
        "capability", "armcal_capability.command:capability", "What an arm can do where, and which design does it best."
    )
