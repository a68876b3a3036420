"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_models(register: Register) -> None:
    register("urdf", "armcal_urdf.model:UrdfModel", "a serial chain between two links of a URDF")


@hookimpl
def armcal_register_exporters(register: Register) -> None:
    register("urdf", "armcal_urdf.export:UrdfExporter", "the URDF it was made from, with calibrated origins")
