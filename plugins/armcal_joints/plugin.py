"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_effects(register: Register) -> None:
    """Announce the effects."""
    register(
        "torsional_spring",
        "armcal_joints.springs:TorsionalSprings",
        "springs about joint axes and at the base",
    )
