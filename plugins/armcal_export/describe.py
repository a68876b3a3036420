"""A calibrated arm as a description, and the rigid arm rebuilt from a description alone."""

from collections.abc import Callable, Mapping

import casadi as ca
import numpy as np
from armcal.arm.assembly import scoped
from armcal.arm.effects import MOUNT, JointCommand, Spring
from armcal.arm.model import Chain, forward
from armcal.arm.statics import MOUNT_FRAME, STATICS, TOOL_FRAME, Load, frame_names, tilted
from armcal.base.arrays import Array
from armcal.calibration.exporter import ExportRequest, random_commands, rigid_tools
from armcal.calibration.rigid_chain import RigidJoint, rigid_chain
from armcal.errors import ProblemError
from scipy.spatial.transform import Rotation

from armcal_export.description import (
    SCHEMA,
    ArmDescription,
    Calibration,
    Effect,
    Follows,
    Joint,
    MassEntry,
    Parameter,
    Pose,
    Servo,
    SpringEntry,
    Statics,
)

_LOADS = (-3.0, -0.5, 0.1, 2.0)
_COMMANDS = ((0.0, 0.0), (0.7, 1.0), (-1.1, -1.0))
"""Commanded displacements (rad or m) and approaches."""
_LINEAR = 1e-12
TOLERANCE = 1e-12
"""m, and entries of rotation matrices, for each metre and radian that a pose is made of."""
REPORT = "Nothing was written. Please report this with the calibration."


def spring_entries(request: ExportRequest, chain: Chain) -> list[SpringEntry]:
    """Every spring of an arm at its calibrated values; ``chain`` is the arm's."""
    values = {name: ca.SX(list(map(float, value))) for name, value in request.values.items()}
    return [
        _entry(name, spring, chain)
        for name, effect in request.arm.effects.items()
        for spring in effect.springs(scoped(values, f"{request.name}.{name}."))
    ]


def _entry(effect: str, spring: Spring, chain: Chain) -> SpringEntry:
    """A spring; one without directions gives about or along its joint's own axis."""
    joint = chain.joints[spring.site - 1] if spring.site else None
    axes = np.array(spring.directions or ((joint.axis,) if joint else ()), dtype=float)
    load, recorded = ca.SX.sym("load", spring.size), ca.SX.sym("recorded", 2)
    command = JointCommand(spring.site - 1, recorded[0], recorded[1]) if spring.site else MOUNT
    given = ca.densify(ca.SX(spring.law(load, command)))
    law = ca.Function("law", [load, recorded], [given, ca.densify(ca.jacobian(given, load))])
    compliance = np.asarray(law(np.zeros(spring.size), _COMMANDS[0])[1].full())
    linear = True
    for loads in np.outer(_LOADS, np.arange(1.0, spring.size + 1)):
        for at in _COMMANDS:
            deflection = np.asarray(law(loads, at)[0].full()).ravel()
            rounding = _LINEAR * float(np.abs(compliance).max())
            linear &= np.allclose(deflection, compliance @ loads, rtol=_LINEAR, atol=rounding)
    return SpringEntry(
        effect=effect,
        site=spring.site,
        axes=axes.tolist(),
        along=not spring.directions and joint is not None and not joint.is_revolute,
        compliance=compliance.tolist(),
        linear=linear,
    )


def chain_of(request: ExportRequest) -> Chain:
    return request.arm.chain({name: ca.SX(list(map(float, value))) for name, value in request.values.items()})


def describe(request: ExportRequest) -> ArmDescription:
    """What the files say.

    Raises:
        ProblemError: the tool hangs on a joint before the last.
    """
    chain, origin = chain_of(request), request.origin
    rigid = rigid_chain(chain)
    return ArmDescription(
        armcal_arm=SCHEMA,
        arm=request.name,
        calibration=Calibration(
            experiment=origin.experiment,
            created=origin.created,
            software=dict(origin.software),
            identity=dict(origin.identity),
            digest=request.digest,
        ),
        joints=[_joint(joint) for joint in rigid.joints],
        base_T_mount=_pose(rigid.base_T_mount),
        base_T_tool=_pose(rigid.base_T_tool),
        effects=_effects(request),
        springs=spring_entries(request, chain),
        masses=_masses(request, chain),
        statics=_statics(request),
        servos=[
            Servo(joint=name, angles_rad=list(table.angles), pulses_s=list(table.pulses), tick_s=clock.tick)
            for name, (table, clock) in request.expression().servos.items()
        ],
        parameters=_parameters(request),
    )


def rebuilt_tools(arm_description: ArmDescription, commands: Array) -> Array:
    """base_T_tool (N x 4 x 4) of the rigid arm that a description specifies, at commands (commanded joints x N).

    The product of exponentials of the joints' screws [Murray1994], from the description alone.
    """
    given = dict(zip([joint.name for joint in arm_description.joints if joint.follows is None], commands, strict=True))
    tools = np.tile(np.eye(4), (commands.shape[1], 1, 1))
    for joint in arm_description.joints:
        follows = joint.follows
        q = given[joint.name] if follows is None else follows.multiplier * given[follows.joint] + follows.offset
        at = _matrix(joint.base_T_joint)
        moved = joint.scale * q
        beside = joint.pitch * moved
        turns, slides = (moved, beside) if joint.kind == "revolute" else (beside, moved)
        tools = tools @ at @ motion(np.array(joint.axis), turns, slides) @ np.linalg.inv(at)
    return np.asarray(tools @ _matrix(arm_description.base_T_tool))


def motion(axis: Array, turns: Array, slides: Array) -> Array:
    """About and along a unit vector (N x 4 x 4); rad and m (N each)."""
    result = np.tile(np.eye(4), (len(turns), 1, 1))
    result[:, :3, :3] = Rotation.from_rotvec(turns[:, None] * axis).as_matrix()
    result[:, :3, 3] = slides[:, None] * axis
    return result


def require_same_tools(request: ExportRequest, rebuilt: Callable[[Array], Array]) -> None:
    """What reads back must put the tool (N x 4 x 4, of commands: joints x N) where the rigid arm has it.

    Raises:
        ProblemError: it does not.
    """
    commands = random_commands(request.arm)
    expected = rigid_tools(request.arm, request.values, commands)
    apart = float(np.abs(rebuilt(commands) - expected).max())
    allowed = TOLERANCE * max(1.0, float(np.abs(expected).max()), float(np.abs(commands).max(initial=0.0)))
    if not apart <= allowed:
        raise ProblemError(f"what reads back is {apart:.3g} m or 1 off the calibrated arm.", hint=REPORT)


def _matrix(pose: Pose) -> Array:
    result = np.eye(4)
    result[:3, :3], result[:3, 3] = pose.rotation, pose.position_m
    return result


def _pose(matrix: Array) -> Pose:
    return Pose(position_m=matrix[:3, 3].tolist(), rotation=matrix[:3, :3].tolist())


def _joint(joint: RigidJoint) -> Joint:
    lower, upper = joint.limits or (None, None)
    follows = joint.mimic and Follows(
        joint=joint.mimic.master, multiplier=joint.mimic.multiplier, offset=joint.mimic.offset
    )
    return Joint(
        name=joint.name,
        kind="prismatic" if joint.slides else "revolute",
        base_T_joint=_pose(joint.base_T_joint),
        axis=joint.axis.tolist(),
        scale=joint.scale,
        pitch=joint.pitch,
        lower=lower,
        upper=upper,
        endless=joint.endless,
        follows=follows,
    )


def _effects(request: ExportRequest) -> list[Effect]:
    described: Mapping[str, Mapping[str, object]] = request.description.get("effects", {})
    return [
        Effect(
            name=name,
            type=str(described.get(name, {}).get("type", "")),
            settings={key: value for key, value in described.get(name, {}).items() if key != "type"},
        )
        for name in request.arm.effects
    ]


def _masses(request: ExportRequest, chain: Chain) -> list[MassEntry]:
    frames = forward(chain, [joint.offset for joint in chain.joints], {})
    moved_by, mass_entries = frame_names(chain), []
    for mass in request.arm.masses:
        local = scoped(request.values, f"{request.name}.links.{mass.name}.")
        com = ca.SX([float(local[f"com_{axis}"][0]) for axis in "xyz"])
        if mass.frame == TOOL_FRAME:
            place = frames.base_T_tool.apply(com)
        elif mass.frame == MOUNT_FRAME:
            place = frames.sites[0].origin + ca.mtimes(frames.sites[0].rotation, com)
        else:
            place = frames.named[mass.frame].apply(com)
        last = moved_by[mass.frame]
        mass_entries.append(
            MassEntry(
                name=mass.name,
                mass_kg=float(local["mass"][0]),
                com_m=_numbers(place),
                moved_by=last,
                loads_up_to=last if mass.loads_up_to is None else mass.loads_up_to,
            )
        )
    return mass_entries


def _statics(request: ExportRequest) -> Statics:
    e = request.environment
    nothing = ca.SX.zeros(3)
    tilt = {name.removeprefix(f"{STATICS}."): ca.SX(float(value[0])) for name, value in request.tilt.items()}
    gravity = tilted(Load(ca.SX(list(e.gravity)), ca.SX(0), nothing, nothing, nothing), tilt).gravity
    return Statics(
        gravity_m_s2=_numbers(gravity),
        payload_kg=e.payload_mass if request.payload_stated else None,
        payload_com_m=list(e.payload_com),
        force_N=list(e.force),
        torque_Nm=list(e.torque),
    )


def _parameters(request: ExportRequest) -> list[Parameter]:
    blocks = {block.name: block for block in request.arm.parameters()}
    if not request.entries:
        entries = [
            (name, blocks[key].entry_unit, nominal, float(value))
            for key, numbers in request.values.items()
            for name, nominal, value in zip(blocks[key].entry_names, blocks[key].nominal, numbers, strict=True)
        ]
        unknown = {"free": False, "sd": None, "determined": None}
        return [Parameter(name=n, unit=u, nominal=before, value=now, **unknown) for n, u, before, now in entries]
    return [
        Parameter(
            name=e.name, unit=e.unit, nominal=e.nominal, value=e.value, free=e.free, sd=e.sd, determined=e.determined
        )
        for e in request.entries
    ]


def _numbers(expression: ca.SX) -> list[float]:
    return [float(number) for number in np.asarray(ca.evalf(ca.densify(expression)).full()).ravel()]
