"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_effects(register: Register) -> None:
    register("torsional_spring", "armcal_joints.effects:TorsionalSprings", "springs about joint axes and at the base")
    register("cubic_spring", "armcal_joints.effects:CubicSprings", "springs that soften or stiffen under load")
    register("compliance", "armcal_joints.effects:Compliances", "3x3 compliances at the joints and at the base")
    register("servo_map", "armcal_joints.effects:ServoMap", "a servo's gain, on either side of zero, and offset")
    register("approach_backlash", "armcal_joints.effects:ApproachBacklash", "play, by the direction of approach")
    register("torque_backlash", "armcal_joints.effects:TorqueBacklash", "play, by the sign of the torque")
    register("bearing_play", "armcal_joints.effects:BearingPlay", "bearings that tilt with the moment they carry")
    register("gear_error", "armcal_joints.effects:GearError", "harmonic errors, one and two periods a turn")
    register("quantisation", "armcal_joints.effects:Quantisation", "the angles that a servo board can set")
    register("delay", "armcal_joints.effects:Delay", "recorded joints that lag behind, of an arm that moves")
    register("thermal_length", "armcal_joints.effects:ThermalLength", "links that lengthen with temperature")
