"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl

_COMMANDS = {
    "recalibrate": ("commands:recalibrate", "Keep a calibration true, record by record, as they come."),
    "control": ("commands:control", "Query or command a running recalibration."),
    "watch": ("watch:watch", "Show a recalibration live, in the browser."),
    "mission": ("mission:mission", "Simulate a mission, recalibrate over it, compare that with its truth."),
}


@hookimpl
def armcal_register_commands(register: Register) -> None:
    for name, (target, summary) in _COMMANDS.items():
        register(name, f"armcal_online.{target}", summary)


@hookimpl
def armcal_register_simulators(register: Register) -> None:
    target = "armcal_online.mission_simulator:MissionOfDays"
    register("mission", target, "a rover's arm over some days, and what befalls it")
