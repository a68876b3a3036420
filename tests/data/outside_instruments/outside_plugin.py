"""Registration of instruments and effects as an outsider writes them: from the docs alone."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    """Announce the instruments."""
    register("load_cell", "outside_instruments:LoadCell", "the weight of the gripper in the flange's axes")
    register("torque_cell", "outside_instruments:TorqueCell", "what the gripper's weight does about the flange")
    register("theodolite", "outside_instruments:Theodolite", "two angles to a mark on the tool")
    register("pixel_camera", "outside_instruments:PixelCamera", "where a mark on the tool is in an image, in pixels")


@hookimpl
def armcal_register_effects(register: Register) -> None:
    """Announce the effects."""
    register("swelling", "outside_instruments:Swelling", "links that grow with the air's humidity")
    register("unread", "outside_instruments:Unread", "reads a column of which it does not state the dimension")
