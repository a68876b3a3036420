"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    register("closed_chain", "armcal_dualarm.two_arms:ClosedChain", "two arms clamped together at their tools")


@hookimpl
def armcal_register_readers(register: Register) -> None:
    register("two_arm_log", "armcal_dualarm.two_arms:TwoArmLogReader", "motor angles of several arms, perhaps a log")
