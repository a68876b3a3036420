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
    register("control", "armcal_online.commands.control:control", "Query or command a running recalibration.")
    register(
        "replay",
        "armcal_online.commands.replay:replay_command",
        "Make every state of a recalibration again from its journal.",
    )
    register(
        "what-if",
        "armcal_online.commands.what_if:what_if",
        "Rank poses by the information that one more record there would add.",
    )
    register(
        "watch", "armcal_online.commands.watch:watch", "Show a recalibration live, in the browser or the terminal."
    )
    register(
        "mission",
        "armcal_online.commands.mission:mission",
        "Simulate a mission, recalibrate over it, judge it by its truth.",
    )
