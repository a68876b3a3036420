"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    """Announce the commands."""
    register(
        "recalibrate",
        "armcal_online.commands.recalibrate:recalibrate",
        "Keep a calibration true, record by record, as they come.",
    )
    register("control", "armcal_online.commands.control:control", "Ask a running recalibration, or tell it what to do.")
    register(
        "replay",
        "armcal_online.commands.replay:replay_command",
        "Make every state of a recalibration again from its journal.",
    )
    register("what-if", "armcal_online.commands.what_if:what_if", "How much one more record would tell, by pose.")
    register(
        "watch", "armcal_online.commands.watch:watch", "Show a recalibration live, in the browser or the terminal."
    )
    register(
        "mission",
        "armcal_online.commands.mission:mission",
        "Simulate a mission, recalibrate over it, judge it by its truth.",
    )
