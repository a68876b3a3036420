"""What the formats ``yaml`` and ``json`` say of an arm: every field with its unit, its frame and its meaning."""

from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field

SCHEMA = 1
SCHEMA_FILE = "arm.schema.json"

Vector = Annotated[list[float], Field(min_length=3, max_length=3)]
Rotation = Annotated[list[Vector], Field(min_length=3, max_length=3)]


class _Entry(BaseModel):
    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False, strict=True)


class Pose(_Entry):
    """A frame in another one."""

    position_m: Vector = Field(description="Where the frame's origin is.")
    rotation: Rotation = Field(description="Rows of the rotation matrix: its columns are the frame's axes.")


class Calibration(_Entry):
    """Where the numbers come from."""

    experiment: str
    created: str = Field(description="ISO 8601.")
    software: dict[str, str]
    identity: dict[str, str] = Field(description="SHA-256 of what the calibration was made from.")
    digest: str = Field(description="SHA-256 of the arm's description and its calibrated values.")


class Follows(_Entry):
    """A joint's displacement is multiplier times that of another joint's command, plus offset."""

    joint: str
    multiplier: float
    offset: float = Field(description="rad or m.")


class Joint(_Entry):
    """A joint at zero command: it moves what is beyond it about or along its axis."""

    name: str
    kind: Literal["revolute", "prismatic"]
    base_T_joint: Pose = Field(description="Its frame in the base frame with all commands zero.")
    axis: Vector = Field(description="Unit vector in its own frame, through its origin.")
    scale: float = Field(description="How far it moves for a command of one (rad per rad, m per m).")
    pitch: float = Field(description="Of a revolute joint how far it slides as it turns (m/rad); else rad/m.")
    lower: float | None = Field(description="Lowest command (rad or m); null where none is known.")
    upper: float | None = Field(description="Highest command (rad or m); null where none is known.")
    endless: bool = Field(description="Whether it may turn on and on.")
    follows: Follows | None = Field(description="The joint that it follows; null for one that is commanded.")


class Effect(_Entry):
    """What stands between command and motion; its parameters are those named ARM.NAME.*."""

    name: str
    type: str
    settings: dict[str, Any] = Field(description="As in armcal's configuration, SI units in the keys.")


class SpringEntry(_Entry):
    """An elastic deflection at a site: axes times (compliance times the load's components along the axes)."""

    effect: str
    site: int = Field(description="0: the mount; i: joint i, from 1, after its motion.")
    axes: list[Vector] = Field(description="Unit vectors in the site's frame; the load is the moment about them.")
    along: bool = Field(description="Whether it slides along its axis, under the force and not the moment.")
    compliance: list[list[float]] = Field(description="rad/(N m), or m/N; under a small load if not linear.")
    linear: bool


class MassEntry(_Entry):
    """A mass of the arm."""

    name: str
    mass_kg: float
    com_m: Vector = Field(description="Its centre in the base frame with all commands zero.")
    moved_by: int = Field(description="The joint that moves it, from 1; 0: none.")
    loads_up_to: int = Field(description="The last joint that it was taken to load, from 1.")


class Statics(_Entry):
    """What acts on the arm where nothing is said."""

    gravity_m_s2: Vector = Field(description="In the base frame, as calibrated.")
    payload_kg: float | None = Field(description="On the tool, beside the masses; null where it was not stated.")
    payload_com_m: Vector = Field(description="In the tool frame.")
    force_N: Vector
    torque_Nm: Vector


class Servo(_Entry):
    """Pulses of a joint's servo, linear between the points and beyond them."""

    joint: str
    angles_rad: list[float]
    pulses_s: list[float]
    tick_s: float = Field(description="Length of one count of the board.")


class Parameter(_Entry):
    """A number of the calibration."""

    name: str
    unit: str
    nominal: float
    value: float
    free: bool
    sd: float | None = Field(description="Standard deviation; null where it is not known.")
    determined: bool | None = Field(description="Whether the measurements determined it.")


class ArmDescription(_Entry):
    """A calibrated arm. All units are SI, angles in rad.

    Rigid kinematics: base_T_tool(q) = S1(q1) ... Sn(qn) base_T_tool(0), where Si moves along joint i's axis as it
    stands at zero command: a turn by scale * q about it and a slide by pitch * scale * q along it (revolute), or a
    slide by scale * q and a turn by pitch * scale * q (prismatic).
    """

    armcal_arm: Literal[1] = Field(description="Version of this schema.")
    arm: str
    calibration: Calibration
    joints: list[Joint] = Field(description="From the base to the tool.")
    base_T_mount: Pose = Field(description="What joint 1 stands on, in the base frame.")
    base_T_tool: Pose = Field(description="The tool in the base frame with all commands zero, without effects.")
    effects: list[Effect]
    springs: list[SpringEntry]
    masses: list[MassEntry]
    statics: Statics
    servos: list[Servo]
    parameters: list[Parameter]
