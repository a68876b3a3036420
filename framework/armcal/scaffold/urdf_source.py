"""A new robot from a URDF: the file as it is, its joints and their limits."""

from pathlib import Path
from typing import Any

from pydantic import ValidationError

from armcal.arm.assembly import PLACEMENT, MassiveModel
from armcal.arm.model import Joint
from armcal.calibration.convert import nominal_values
from armcal.calibration.rigid_chain import numeric_chain
from armcal.errors import ConfigError, DataError, Location
from armcal.plugins import PluginRegistry
from armcal.scaffold.naming import check_joint_names
from armcal.scaffold.robot import ASSUMED_TRAVEL, ASSUMED_TURN, FEWEST_JOINTS, MOST_JOINTS, Robot, RobotJoint, Unit

_MOST_TRAVEL_RAD = 3.2
"""A turning joint need not be measured over more than one turn."""


def robot_of_urdf(name: str, path: Path, tip: str | None, registry: PluginRegistry) -> Robot:
    """A robot from a URDF; ``tip`` names its last link where the file leaves a choice.

    Raises:
        ConfigError: the file is refused, or has no chain to calibrate.
        PluginError: no plugin reads URDFs.
    """
    where = Location(str(path))
    model = urdf_model(path, tip, registry)
    chain = numeric_chain(model, nominal_values(model))
    joints = tuple(_joint(joint, where) for joint in chain.joints if joint.mimic is None)
    if not FEWEST_JOINTS <= len(joints) <= MOST_JOINTS:
        raise DataError(
            f"found {len(joints)} moving joints between root and tip, expected {FEWEST_JOINTS} to {MOST_JOINTS}.",
            where=where,
            hint="Name the link at the arm's end: --tip LINK.",
        )
    check_joint_names([joint.name for joint in joints], [where] * len(joints))
    priors: dict[str, Unit] = {}  # how far joints may be off the URDF; where the arm stands before the tracker has none
    for moved in chain.joints:  # a joint that follows another too
        priors[f"arm.urdf.{moved.name}_[xyz]"] = "mm"
        priors[f"arm.urdf.{moved.name}_[rpy][oia]*"] = "deg"
    moving = tuple(f"arm.urdf.{moved.name}_*" for moved in chain.joints)
    # Without a placement of its own the tracker's frame would end up in the first joint, and with it in every export.
    placed = ((f"arm.{PLACEMENT}_*",), ("tracker.target_*",))
    return Robot(
        name=name,
        joints=joints,
        has_masses=isinstance(model, MassiveModel) and bool(model.masses()),
        preferred=(*placed, moving, ("arm.urdf.*",), ("arm.spring.*",)),
        priors=priors,
        urdf=path.read_bytes(),
        urdf_file=f"{name}.urdf",
        tip=model.settings.tip,
    )


def urdf_model(path: Path, tip: str | None, registry: PluginRegistry) -> Any:
    """The arm model of a URDF; ``tip`` names its last link where the file leaves a choice.

    Raises:
        ConfigError: the file is refused.
        PluginError: no plugin reads URDFs.
    """
    made = registry.find("model", "urdf").load()
    try:
        return made(made.Settings.model_validate({"path": str(path), **({"tip": tip} if tip else {})}))
    except ValidationError as fault:
        text = "; ".join(str(error["msg"]).removeprefix("Value error, ") for error in fault.errors(include_url=False))
        hint = "Correct the URDF, or choose --tip LINK."
        raise ConfigError(f"{text}.", where=Location(str(path)), hint=hint) from fault


def _joint(joint: Joint, where: Location) -> RobotJoint:
    turns = joint.is_revolute
    if joint.limits is None:
        return RobotJoint(joint.name, turns, ASSUMED_TURN if turns else ASSUMED_TRAVEL, assumed=True)
    low, high = joint.limits
    if not low < high:
        text = f"joint {joint.name!r} has the limits {low:g} and {high:g}, and cannot move."
        raise DataError(text, where=where, hint="Correct them, or make it a fixed joint.")
    if turns and not joint.endless:
        low, high = max(low, -_MOST_TRAVEL_RAD), min(high, _MOST_TRAVEL_RAD)
    return RobotJoint(joint.name, turns, (low, high))
