"""The exporter ``urdf``: the URDF that an arm was made from, with its calibrated origins."""

import re
from collections.abc import Iterable, Mapping
from operator import itemgetter
from typing import Any, ClassVar

import casadi as ca
import numpy as np
from armcal.arm.assembly import PLACEMENT, Arm
from armcal.arm.model import forward
from armcal.base.arrays import Array
from armcal.base.quaternions import rotation_matrix, rpy_of
from armcal.base.settings import Settings
from armcal.calibration.exporter import Exported, ExportRequest, random_commands
from armcal.calibration.rigid_chain import numeric_chain, rigid_chain
from armcal.errors import ConfigError, ProblemError
from scipy.spatial.transform import Rotation

from armcal_urdf.model import RPY, XYZ, ChainJoint, UrdfModel, UrdfSettings, turned
from armcal_urdf.robot import UTF8, Three, UrdfJoint, words_of

_ROUNDING = 1e-13  # m or rad: what a solver leaves of a number that nothing moved
_WHITE = b" \t\r\n"
_ATTRIBUTE = re.compile(rb"""\s+(?P<name>[^\s=/>]+)\s*=\s*(?P<value>"[^"]*"|'[^']*')""")
_START_TAG = re.compile(rb"""(?P<name><[^\s/>]+)(?:\s+[^\s=/>]+\s*=\s*(?:"[^"]*"|'[^']*'))*\s*/?>""")


Edit = tuple[int, int, bytes]  # Bytes from an offset to before another become new ones


def _with_origins(text: str, placed: Iterable[tuple[UrdfJoint, Mapping[str, Three]]]) -> str:
    """The text with other ``xyz`` (m) and ``rpy`` (rad) of joints, which were read from this very text."""
    data = text.encode(UTF8)
    edits = sorted((edit for joint, now in placed for edit in _edits(data, joint, now)), key=itemgetter(0))
    parts, here = [], 0
    for start, end, new in edits:
        parts += [data[here:start], new]
        here = end
    return b"".join([*parts, data[here:]]).decode(UTF8)


def _edits(data: bytes, joint: UrdfJoint, now: Mapping[str, Three]) -> list[Edit]:
    changed = {name: numbers for name, numbers in now.items() if numbers != getattr(joint, name)}
    element, origin = joint.element, joint.element.one("origin")
    if not changed:
        return []
    if origin is None:
        # as the joint's first element, on a line of its own if the next thing in it stands on one
        _, _, end = _start_tag(data, element.start)
        inside = data[end:]
        lead = inside[: len(inside) - len(inside.lstrip(_WHITE))].decode(UTF8)
        attributes = " ".join(f'{name}="{_written(numbers, [])}"' for name, numbers in changed.items())
        return [(end, end, f"{lead}<origin {attributes}/>".encode())]
    name_end, values, _ = _start_tag(data, origin.start)
    edits = []
    for name, numbers in changed.items():
        if name in values:
            edits.append((*values[name], _written(numbers, words_of(origin.attributes[name])).encode()))
        else:
            edits.append((name_end, name_end, f' {name}="{_written(numbers, [])}"'.encode()))
    return edits


def _written(numbers: Three, before: list[str]) -> str:
    """Numbers that read back to the last bit; one that did not change, but for rounding, keeps its digits."""
    known = before if len(before) == len(numbers) else ["nan"] * len(numbers)
    pairs = zip(numbers, known, strict=True)
    return " ".join(word if abs(float(word) - now) <= _ROUNDING else repr(now) for now, word in pairs)


def _start_tag(data: bytes, start: int) -> tuple[int, dict[str, tuple[int, int]], int]:
    """Of the start tag at an offset: where its name ends, where each attribute's value stands, and where it ends."""
    match = _START_TAG.match(data, start)
    assert match is not None, "the text is well-formed"
    attributes = _ATTRIBUTE.finditer(data, match.end("name"), match.end())
    values = {m["name"].decode(UTF8): (m.start("value") + 1, m.end("value") - 1) for m in attributes}
    return match.end("name"), values, match.end()


TOLERANCE_M = 1e-9
TOLERANCE_RAD = 1e-9
MOST_SHIFT_MM, MOST_TURN_DEG = 5.0, 3.0  # Beyond these a first joint is not made wrong: it holds where the arm stands


class UrdfExportSettings(Settings):
    """Nothing to set."""


class UrdfExporter:
    """Changes only the numbers of calibrated joints' origins; all other bytes stay."""

    Settings: ClassVar[type[UrdfExportSettings]] = UrdfExportSettings
    EXAMPLE: ClassVar[Mapping[str, Any]] = {}

    def __init__(self, settings: UrdfExportSettings) -> None:
        self._settings = settings

    def export(self, request: ExportRequest) -> Exported:
        """The URDF, read again and compared with the calibrated arm."""
        model = request.arm.model
        if not isinstance(model, UrdfModel):
            raise ConfigError(
                f"the arm {request.name!r} is a model {request.arm.model_name!r}, and no URDF stands behind it.",
                hint="Use armcal convert to make a URDF of it.",
            )
        scope = f"{request.name}.{request.arm.model_name}."
        values = {n.removeprefix(scope): float(v[0]) for n, v in request.values.items() if n.startswith(scope)}
        placed = [
            (joint.urdf, {"xyz": _three(joint.name, XYZ, values), "rpy": _rpy(joint, model.settings, values)})
            for joint in model.urdf_chain.joints
        ]
        old = model.settings
        text = _with_origins(old.text, placed)
        written = UrdfModel(UrdfSettings.model_validate({**old.to_config(), "text": text}))
        _require_same_frames(request.arm, model, written, values)
        pairs = [(getattr(joint, name), numbers) for joint, now in placed for name, numbers in now.items()]
        changed = sum(one != other for before, after in pairs for one, other in zip(before, after, strict=True))
        # what of the calibrated arm is no origin of a joint
        nominal = {block.name: block.nominal for block in request.arm.parameters()}
        moved = [name for name, value in request.values.items() if tuple(value) != nominal[name]]
        masses = sorted({name.split(".")[2] for name in moved if name.startswith(f"{request.name}.links.")})
        left_out = (*request.arm.effects, *(f"the mass of {link}" for link in masses))
        remarks = _placed(request) or _base_moved(model, values)
        return Exported(text.encode(old.encoding or "utf-8"), changed, left_out, remarks=remarks)


def _three(joint: str, names: tuple[str, ...], values: Mapping[str, float]) -> Three:
    x, y, z = (values[f"{joint}_{name}"] for name in names)
    return x, y, z


def _rpy(joint: ChainJoint, settings: UrdfSettings, values: Mapping[str, float]) -> Three:
    """As the format has them; those of the file where nothing turned the joint."""
    angles = _three(joint.name, RPY, values)
    nominal = settings.nominal_angles(joint.urdf)
    return joint.urdf.rpy if angles == nominal else turned(angles, settings.quarter_turn(joint.urdf))


def _nominal(model: UrdfModel) -> dict[str, float]:
    return {block.name: float(block.nominal[0]) for block in model.parameters()}


def _require_same_frames(arm: Arm, model: UrdfModel, written: UrdfModel, values: Mapping[str, float]) -> None:
    """All frames in random poses within the limits, as calibrated and as written."""
    commands = random_commands(arm)
    calibrated, again = _frames(arm, model, values, commands), _frames(arm, written, _nominal(written), commands)
    shift = float(np.linalg.norm(calibrated[..., :3, 3] - again[..., :3, 3], axis=-1).max())
    apart = np.linalg.norm(calibrated[..., :3, :3] - again[..., :3, :3], axis=(-2, -1)).max()
    turn = float(apart) / np.sqrt(2)
    if not (shift <= TOLERANCE_M and turn <= TOLERANCE_RAD):
        raise ProblemError(
            f"the URDF with the calibrated numbers is {shift:.3g} m and {turn:.3g} rad off the calibrated arm, "
            f"expected {TOLERANCE_M:g} m and {TOLERANCE_RAD:g} rad at most.",
            hint="Nothing was written. Please report this with the calibration.",
        )


def _frames(arm: Arm, model: UrdfModel, values: Mapping[str, float], commands: Array) -> Array:
    """The tool and every link in the base frame (N x frames x 4 x 4), at commands (joints x N)."""
    chain = model.chain({name: ca.SX(value) for name, value in values.items()})
    expression = ca.SX.sym("commands", commands.shape[0])
    frames = forward(chain, arm.joint_commands(ca.vertsplit(expression)), {})
    poses = [frames.base_T_tool, *frames.named.values()]
    stacked = ca.vertcat(*[ca.vec(ca.densify(pose.matrix())) for pose in poses])
    function = ca.Function("frames", [expression], [stacked], {"cse": True}).map(commands.shape[1])
    return np.asarray(function(commands).full()).T.reshape(commands.shape[1], len(poses), 4, 4).swapaxes(-1, -2)


def _placed(request: ExportRequest) -> tuple[str, ...]:
    """Where the arm stands, which a URDF does not hold: its base is the arm's own."""
    if not request.arm.placement:
        return ()
    scope = f"{request.name}.{PLACEMENT}_"
    x, y, z = (1000 * float(request.values[scope + axis][0]) for axis in XYZ)
    roll, pitch, yaw = np.degrees(rpy_of(rotation_matrix(request.values[f"{scope}rotation"])))
    return (
        f"the URDF begins at the arm's own base; in the measurement frame that base stands at x {x:.3f}, y {y:.3f}, "
        f"z {z:.3f} mm, roll {roll:.4f}, pitch {pitch:.4f}, yaw {yaw:.4f} deg",
    )


def _base_moved(model: UrdfModel, values: Mapping[str, float]) -> tuple[str, ...]:
    """Whether the first joint that moves stands elsewhere than in the file, by more than an arm is made wrong."""
    nominal = _nominal(model)
    chains = [
        numeric_chain(model, {name: np.array(value) for name, value in {**nominal, **changed}.items()})
        for changed in ({}, values)
    ]
    before, now = (rigid_chain(chain).joints[0].base_T_joint for chain in chains)
    shift = 1000 * float(np.linalg.norm(now[:3, 3] - before[:3, 3]))
    turn = float(np.degrees(Rotation.from_matrix(before[:3, :3].T @ now[:3, :3]).magnitude()))
    if shift <= MOST_SHIFT_MM and turn <= MOST_TURN_DEG:
        return ()
    first = model.urdf_chain.moving[0].name
    return (
        f"the first joint, {first}, moved by {shift:.3g} mm and turned by {turn:.3g} deg against its URDF: "
        "if where the arm stands before the instrument is in it, give the arm a placement, free that instead of "
        f"{first}'s origin, and calibrate again",
    )
