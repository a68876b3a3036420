"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register(
        "capability",
        "armcal_capability.capability:capability",
        "What an arm can do where, and which design does it best.",
    )
    register(
        "acceptance",
        "armcal_capability.acceptance:acceptance",
        "How accurate and repeatable an arm is, by the terms of ISO 9283.",
    )
