"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_devices(register: Register) -> None:
    register("servobus", "armcal_servobus.device:ServoBusDevice", "serial-bus servos: Feetech STS, Dynamixel X")


@hookimpl
def armcal_register_joint_streams(register: Register) -> None:
    register("servobus", "armcal_servobus.device:ServoBusStream", "serial-bus servos of an arm guided by hand")


@hookimpl
def armcal_register_commands(register: Register) -> None:
    register("bus", "armcal_servobus.command:bus", "Serial-bus servos: find them, check them, set homing offsets.")
