"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register("lerobot", "armcal_lerobot.command:lerobot", "LeRobot's motor calibration files and data sets.")
