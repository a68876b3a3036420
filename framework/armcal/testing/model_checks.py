"""Checks on arm models: names, parameters, chain, kinematics, derivatives, statics."""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np

from armcal.arm.assembly import Arm, MassiveModel
from armcal.arm.environment import Environment
from armcal.arm.model import ArmModel, Chain, forward
from armcal.arm.statics import MOUNT_FRAME, TOOL_FRAME, MassSpec, frame_names
from armcal.base.arrays import Array
from armcal.base.parameters import ParameterBlock
from armcal.base.se3 import Expression, Transform
from armcal.problem.problem import Problem
from armcal.testing.expressions import (
    check_parameters,
    entry_names,
    expect_all_used,
    expect_derivatives,
    expect_gain,
    expect_no_choice,
    expect_only,
    expect_repeated,
    near_nominal,
    scalars,
    stacked,
    symbols,
)
from armcal.testing.planar import ARM, TRACKER, Springs, Tip, all_parameters, commands, dataset
from armcal.testing.results import Recorder, expect
from armcal.testing.settings_checks import Subject

POSES = 20
ROTATION_TOLERANCE = 1e-9
_LOADED = Environment((0.0, 1.0, -9.5), payload_mass=0.1, payload_com=(0.01, 0.0, 0.02))


@dataclass(frozen=True)
class _Kinematics:
    """A model's poses (tool, sites, named frames) as a function of all entries and displacements."""

    blocks: tuple[ParameterBlock, ...]
    chain: Chain
    poses: ca.Function

    def point(self, random: np.random.Generator) -> Array:
        reach = [2.0 if joint.is_revolute else 0.2 for joint in self.chain.joints]
        return np.concatenate([near_nominal(self.blocks, random), random.uniform(-1, 1, len(reach)) * reach])


def check_model(record: Recorder, subject: Subject) -> None:
    """Everything that a problem asks of an arm model."""
    with record.needed("it builds"):
        model: ArmModel = subject.build()
    with record.needed("its joints are named, each once"):
        names = tuple(model.joint_names)
        expect(len(names) > 0, "found no joints, expected at least one")
        for name in names:
            expect(isinstance(name, str) and bool(name), f"found the joint name {name!r}, expected text")
            expect("." not in name, f"found the joint name {name!r}, expected one without a dot")
        expect(len(set(names)) == len(names), f"found {', '.join(names)}, expected every name once")
    blocks = check_parameters(record, model.parameters)
    values = symbols(blocks)
    with record.needed("its chain has one joint for each name"):
        chain = model.chain(values)
        _expect_chain(chain, names)
    if isinstance(model, MassiveModel):
        with record.check("its masses stand in its frames"):
            _expect_masses(model, chain)
    parts = stacked(_parts(chain))
    with record.check("the chain depends on its parameters alone"):
        expect_only(parts, list(values.values()))
    with record.check("the chain does not branch on a parameter"):
        expect_no_choice(parts, ca.SX(0, 1), stacked(list(values.values())))
    with record.check("every parameter has an influence"):
        expect_all_used(parts, values)
    with record.needed("its kinematics can be evaluated"):
        known = _kinematics(blocks, values, chain)
    with record.check("it is the same each time"):
        expect_repeated(lambda made: _picture(made, blocks), model, subject.build())
    _check_poses(record, known)
    with record.check("springs on it settle under gravity"):
        _expect_settled(model, chain)


def _check_poses(record: Recorder, known: _Kinematics) -> None:
    with record.check(f"{POSES} random poses are rigid motions"):
        random = np.random.default_rng(1)
        for _ in range(POSES):
            shown = np.asarray(known.poses(known.point(random))).reshape(-1, 4, 3).transpose(0, 2, 1)
            expect(bool(np.isfinite(shown).all()), "found a pose that is not finite")
            rotation = shown[:, :, :3]
            off = float(np.abs(rotation @ rotation.transpose(0, 2, 1) - np.eye(3)).max())
            expect(off <= ROTATION_TOLERANCE, f"found a rotation off orthonormal by {off:.1e}")
            handed = float(np.abs(np.linalg.det(rotation) - 1).max())
            expect(handed <= ROTATION_TOLERANCE, f"found a rotation with determinant off 1 by {handed:.1e}")
    with record.check("derivatives agree with differences"):
        names = (*entry_names(known.blocks), *(joint.name for joint in known.chain.joints))
        expect_derivatives(known.poses, known.point(np.random.default_rng(2)), "the poses", names)
    with record.check("lengths move it by lengths, and angles by angles"):  # m for each m, rad for each rad
        random, jacobian = np.random.default_rng(5), known.poses.jacobian()
        points = [known.point(random) for _ in range(3)]
        slopes = np.array([np.asarray(jacobian(at, known.poses(at)))[:12].reshape(4, 3, -1) for at in points])
        for place, block in scalars(known.blocks, "m"):
            moved = np.linalg.norm(slopes[:, 3, :, place], axis=1)
            expect_gain(float(moved.max()), "the tool's position", block.name, "m")
        for place, block in scalars(known.blocks, "rad"):
            turned = np.linalg.norm(slopes[:, :3, :, place], axis=(1, 2)) / np.sqrt(2)
            expect_gain(float(turned.max()), "the tool's orientation", block.name, "rad")


def _expect_chain(chain: Chain, names: Sequence[str]) -> None:
    expect(isinstance(chain, Chain), f"found a chain of type {type(chain).__name__}, expected Chain")
    joint_names = tuple(joint.name for joint in chain.joints)
    expect(joint_names == tuple(names), f"found the joints {joint_names}, expected {tuple(names)}")
    for joint in chain.joints:
        turns, slides = (float(np.linalg.norm(axis)) for axis in (joint.angular, joint.linear))
        expect(
            sorted((turns, slides)) == [0.0, max(turns, slides)] and abs(max(turns, slides) - 1) <= 1e-9,
            f"joint {joint.name}: found angular {joint.angular} and linear {joint.linear}, "
            "expected a unit vector for one and zeros for the other",
        )
    for name, at in {TOOL_FRAME: chain.tool, **chain.frames}.items():
        expect(0 <= at.joint <= len(names), f"the frame {name} hangs on joint {at.joint}, expected 0 to {len(names)}")
    taken = sorted({MOUNT_FRAME, TOOL_FRAME} & set(chain.frames))
    expect(not taken, f"found a frame called {', '.join(taken)}, which armcal uses itself")


def _expect_masses(model: MassiveModel, chain: Chain) -> None:
    frames, masses = frame_names(chain), tuple(model.masses())
    for mass in masses:
        expect("." not in mass.name, f"found the mass {mass.name!r}, expected a name without a dot")
        expect(mass.mass >= 0, f"the mass {mass.name} is {mass.mass} kg, expected 0 or more")
        expect(mass.frame in frames, f"the mass {mass.name} is in {mass.frame!r}, expected one of {', '.join(frames)}")
    names = [mass.name for mass in masses]
    expect(len(set(names)) == len(names), f"found {', '.join(names)}, expected every name once")


def _parts(chain: Chain) -> list[Expression]:
    transforms = [chain.base_T_mount, chain.tool.joint_T_frame]
    transforms += [joint.parent_T_joint for joint in chain.joints]
    transforms += [at.joint_T_frame for at in chain.frames.values()]
    twists = [part for joint in chain.joints if joint.twist is not None for part in joint.twist]
    return [*(t.matrix() for t in transforms), *(joint.offset for joint in chain.joints), *twists]


def _kinematics(blocks: tuple[ParameterBlock, ...], values: dict[str, Expression], chain: Chain) -> _Kinematics:
    moved = ca.SX.sym("displacement", len(chain.joints))
    frames = forward(chain, [joint.offset + moved[i] for i, joint in enumerate(chain.joints)], {})
    shown = [frames.base_T_tool, *frames.named.values()]
    shown += [Transform(site.rotation, site.origin) for site in frames.sites]
    inputs = stacked([*values.values(), moved])
    poses = ca.Function("poses", [inputs], [stacked([pose.matrix()[:3, :] for pose in shown])])
    return _Kinematics(blocks, chain, poses)


def _picture(model: ArmModel, blocks: tuple[ParameterBlock, ...]) -> Array:
    expect(tuple(model.parameters()) == blocks, "found other parameters another time")
    values = symbols(blocks)
    known = _kinematics(blocks, values, model.chain(values))
    return np.asarray(known.poses(known.point(np.random.default_rng(4))))


def _expect_settled(model: ArmModel, chain: Chain) -> None:
    """Gravity on a small mass in every frame, springs at the base and every joint."""
    frames = [MOUNT_FRAME, *chain.frames, TOOL_FRAME]
    masses = tuple(MassSpec(f"m{i}", 0.02, (0.0, 0.01, 0.0), frame) for i, frame in enumerate(frames))
    arm = Arm(ARM, "model", model, {"spring": Springs(len(chain.joints))}, masses)
    arms, parameters = {ARM: arm}, all_parameters({ARM: arm})
    parameters = parameters.with_free(parameters.names)
    moved = commands(arms, POSES, np.random.default_rng(3))
    measured = {f"{TRACKER}.{axis}": np.zeros(POSES) for axis in "xyz"}
    records = dataset({**moved, **measured})
    problem = Problem.build(arms, {TRACKER: Tip()}, parameters, _LOADED, records, "interpreted")
    read = problem.records(records)
    equations = problem.normal_equations(parameters.nominal(), read)
    expect(bool(np.isfinite(equations.hessian).all()), "found derivatives in equilibrium that are not finite")
    loaded = problem.residuals(parameters.nominal(), read)[0]
    expect(bool(np.isfinite(loaded).all()), "found tip positions in equilibrium that are not finite")
    expect(bool(np.abs(read[0].state).max() > 0), "found no deflection under a load, expected some")
