"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    """Announce the commands."""
    register(
        "acquire",
        "armcal_bench.commands:acquire_command",
        "Drive a plan with servo board and tracker, and measure it.",
    )
    register(
        "rehearse",
        "armcal_bench.commands:rehearse",
        "Do what acquire or servo does, against a simulated bench.",
    )
    register(
        "record",
        "armcal_bench.commands:record_command",
        "Record postures of an arm that is guided by hand, judged at once.",
    )
    register(
        "servo",
        "armcal_bench.commands:servo",
        "Which pulse makes which angle: servo tables, by tracker or by eye.",
    )
