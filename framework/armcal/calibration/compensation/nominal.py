"""What a controller is sent that computes its own inverse kinematics, of the nominal arm."""

from dataclasses import dataclass, replace

import numpy as np

from armcal.base.arrays import Array
from armcal.calibration.calibration import Calibration
from armcal.calibration.compensation.compensator import Compensator
from armcal.calibration.compensation.request import Commands, Options, Targets
from armcal.calibration.measured_point import Point, tool_point
from armcal.calibration.rigid_chain import turn_between
from armcal.calibration.tool_expression import arm_expression


@dataclass(frozen=True)
class Sent:
    """Poses that make the nominal arm's inverse kinematics give the commands of the real arm."""

    poses: Array  # of the point that is brought to targets, in the base frame (N x 4 x 4)
    shifts: Array  # from the targets to these (N x 3; m)
    turns: Array | None  # rotation vectors in the base frame (N x 3; rad); None where only positions count


def nominal_arm(calibration: Calibration, arm: str, point: Point, options: Options) -> Compensator:
    """The arm as its controller has it: nominal parameters, rigid, without effects."""
    plain = replace(calibration.system.arms[arm], effects={}, masses=())
    nominal, system = calibration.nominal, calibration.system
    expression, at = arm_expression(plain, nominal, system.environment), tool_point(point, system, plain.name, nominal)
    return Compensator(expression.at(at) if at else expression, nominal, Options(limits=options.limits))


def sent(nominal: Compensator, targets: Targets, commands: Commands) -> Sent:
    """Where the nominal arm takes commands of the real arm to lead; nan of targets that are not reached."""
    poses = np.where(commands.reached[:, None, None], nominal.forward(commands.joint_angles), np.nan)
    turns = None if targets.rotations is None else turn_between(targets.rotations, poses[:, :3, :3])
    return Sent(poses, np.asarray(poses[:, :3, 3] - targets.positions), turns)
