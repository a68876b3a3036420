"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    register("closed_chain", "armcal_dualarm.closure:ClosedChain", "two arms clamped together at their tools")


@hookimpl
def armcal_register_readers(register: Register) -> None:
    register("two_arm_log", "armcal_dualarm.log_reader:TwoArmLogReader", "motor angles of several arms, perhaps a log")
