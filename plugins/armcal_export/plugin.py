"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_exporters(register: Register) -> None:
    register("c", "armcal_export.c_code:CExporter", "C99: kinematics in equilibrium, Jacobian, efforts, compensation")
    register("yaml", "armcal_export.description:YamlExporter", "the arm as numbers that explain themselves")
    register("json", "armcal_export.description:JsonExporter", "the same as yaml, with its schema")
    register("mujoco", "armcal_export.mujoco_model:MujocoExporter", "an MJCF model with springs; needs armcal[mujoco]")
