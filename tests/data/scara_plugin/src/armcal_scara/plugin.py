"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_models(register: Register) -> None:
    """Announce the model."""
    register("scara", "armcal_scara.model:ScaraArm", "two parallel axes and a quill that slides along them")
