"""What the model says of one joint's motion: its axis, the tool, and what the springs add to it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Literal

import casadi as ca
import numpy as np
from armcal.arm.assembly import Arm, ArmInputs, scoped
from armcal.arm.environment import Environment
from armcal.arm.model import forward
from armcal.arm.statics import Load
from armcal.base.domains import Array
from armcal.base.parameters import Parameters
from scipy.spatial.transform import Rotation

from armcal_bench.servo.turning import twist_angles

By = Literal["rotation", "position"]
"""What shows a turn about an axis."""
_COMPLIANCE_UNIT = "rad_per_Nm"
_SMALL = 1e-4
_PASSES = 40
_STEADY = 1e-10


@dataclass(frozen=True)
class NominalArm:
    """An arm at the parameters' nominal values. Joint angles are by joint, in rad; those not named are zero.

    Attributes:
        arm: the arm.
        parameters: whose nominal values are taken.
        environment: gravity and load.
        changed: values in place of the nominal ones, by parameter.
        zeros: what the joints' angles are to be enlarged by (rad).
    """

    arm: Arm
    parameters: Parameters
    environment: Environment
    changed: Mapping[str, tuple[float, ...]] = field(default_factory=dict)
    zeros: Mapping[str, float] = field(default_factory=dict)

    @classmethod
    def of(cls, arm: Arm, parameters: Parameters, environment: Environment) -> NominalArm:
        """An arm without those of its effects that have no springs: its joints stand where they are said to."""
        nominal = {block.name: ca.SX(list(block.nominal)) for block in arm.parameters()}
        springy = {
            name: effect
            for name, effect in arm.effects.items()
            if effect.springs(scoped(nominal, f"{arm.name}.{name}."))
        }
        return cls(replace(arm, effects=springy), parameters, environment)

    @property
    def joints(self) -> tuple[str, ...]:
        """Those that are commanded."""
        return tuple(self.arm.commanded)

    @cached_property
    def compliances(self) -> tuple[str, ...]:
        """The arm's springs, by parameter."""
        mine = [block for block in self.arm.parameters() if block.unit == _COMPLIANCE_UNIT and block.size == 1]
        return tuple(block.name for block in mine)

    @cached_property
    def _nominal(self) -> dict[str, Any]:
        stated = {b.name: list(self.parameters[b.name].nominal) for b in self.arm.parameters()}
        return {**stated, **{name: list(values) for name, values in self.changed.items()}}

    @property
    def has_stiffness(self) -> bool:
        """Whether any spring gives, at the nominal values."""
        return any(self._nominal[name][0] > 0 for name in self.compliances)

    def tool(self, angles: Mapping[str, float]) -> Array:
        """The rigid ``base_T_tool`` (4x4)."""
        return np.asarray(self._rigid(self._commands(angles))[0].full())

    def axis(self, joint: str, angles: Mapping[str, float]) -> tuple[Array, Array]:
        """A joint's axis in the base frame: its direction (unit) and a point on it (m)."""
        return self.axes(angles)[joint]

    def axes(self, angles: Mapping[str, float]) -> dict[str, tuple[Array, Array]]:
        """The same of all joints."""
        _, axes, origins = (np.asarray(dm.full()) for dm in self._rigid(self._commands(angles)))
        return {name: (axes[:, i], origins[:, i]) for i, name in enumerate(self.arm.joint_names)}

    def angle_of_rotation(self, joint: str, angles: Mapping[str, float], rotation: Array) -> float:
        """The angle (rad) of a joint at which the rigid model's tool turns nearest to a rotation (3x3)."""
        at_zero = {**angles, joint: 0.0}
        axis, _ = self.axis(joint, at_zero)
        turned = Rotation.from_matrix(np.array([rotation @ self.tool(at_zero)[:3, :3].T]))
        return float(twist_angles(turned, axis)[0])

    def angle_of_position(self, joint: str, angles: Mapping[str, float], position: Array) -> float:
        """The same by where the tool is (3, m)."""
        at_zero = {**angles, joint: 0.0}
        axis, origin = self.axis(joint, at_zero)
        seen, model = (_across(p - origin, axis) for p in (position, self.tool(at_zero)[:3, 3]))
        return float(np.arctan2(axis @ np.cross(model, seen), model @ seen))

    def give(self, angles: Mapping[str, float]) -> Array:
        """What the springs put between the tool of the stiff arm and of the real one (4x4).

        The rotation is in the tool's axes, the translation in the base's (m).
        """
        still, bent = self._stiff(angles), self._bent(angles)[0]
        given = np.eye(4)
        given[:3, :3], given[:3, 3] = still[:3, :3].T @ bent[:3, :3], bent[:3, 3] - still[:3, 3]
        return given

    def sag(self, joint: str, angles: Mapping[str, float], by: By = "rotation") -> float:
        """How far the springs turn the tool about a joint's axis (rad), by its rotation or by its position."""
        return self._turned(joint, angles, self._stiff(angles), self._bent(angles)[0], by)

    def slopes(self, joint: str, angles: Mapping[str, float], by: By = "rotation") -> Array:
        """How much more that would be for each of the compliances (rad per rad/(N m))."""
        here, deflection = self._bent(angles)
        values, commands = self._copies(angles, len(self.compliances))
        for column, name in enumerate(self.compliances):
            values[self._places[name].start, column] += _SMALL
        more = self._bent_many(values, commands, deflection)
        return np.array([self._turned(joint, angles, here, each, by) / _SMALL for each in more])

    def compliance(self, name: str) -> float:
        """A spring's, by parameter (rad/(N m))."""
        return float(self._nominal[name][0])

    def with_values(self, values: Mapping[str, tuple[float, ...]], zeros: Mapping[str, float]) -> NominalArm:
        """The same arm with other values of parameters, and other zeros of its joints (rad)."""
        other = NominalArm(self.arm, self.parameters, self.environment, {**self.changed, **values}, zeros)
        # These do not hang on what was changed, and take long.
        same = ("_state", "compliances", "angles", "_places")
        other.__dict__.update({name: self.__dict__[name] for name in same if name in self.__dict__})
        return other

    @cached_property
    def angles(self) -> tuple[str, ...]:
        """The parameters of its geometry that are angles."""
        scope = f"{self.arm.name}.{self.arm.model_name}."
        return tuple(b.name for b in self.arm.parameters() if b.unit == "rad" and b.name.startswith(scope))

    def values(self, name: str) -> tuple[float, ...]:
        """A parameter's, as taken here."""
        return tuple(float(value) for value in self._nominal[name])

    def turns(self, angles: Mapping[str, float]) -> tuple[Array, Array, Array, Array]:
        """How the tool turns with each number of ``angles``, with each joint, and with each compliance.

        The tool's rotation (3x3), and the turns in the base's axes: 3 x numbers and 3 x joints (rad per rad), and
        3 x compliances (rad per rad/(N m)).
        """
        tool, deflection = self._bent(angles)
        first = [i for name in self.angles for i in self._places[name]]
        springs = [self._places[name].start for name in self.compliances]
        values, commands = self._copies(angles, len(first) + len(self.joints) + len(springs))
        ends = (len(first), len(first) + len(self.joints))
        values[first, np.arange(ends[0])] += _SMALL
        commands[np.arange(len(self.joints)), np.arange(*ends)] += _SMALL
        values[springs, np.arange(ends[1], values.shape[1])] += _SMALL
        turned = self._bent_many(values, commands, deflection)[:, :3, :3]
        found = Rotation.from_matrix(turned @ tool[:3, :3].T).as_rotvec().T / _SMALL
        return tool[:3, :3], found[:, : ends[0]], found[:, ends[0] : ends[1]], found[:, ends[1] :]

    def _copies(self, angles: Mapping[str, float], count: int) -> tuple[Array, Array]:
        """Values and commands, column by column, to be changed."""
        return np.tile(np.asarray(self._values.full()), (1, count)), np.tile(
            self._commands(angles)[:, None], (1, count)
        )

    def _bent_many(self, values: Array, commands: Array, start: Any) -> Array:
        """The tools in equilibrium (N x 4 x 4), column by column, from a deflection near all of them."""
        count = values.shape[1]
        if not count:
            return np.zeros((0, 4, 4))
        function, deflection = self._state.map(count), ca.repmat(start, 1, count)
        for _ in range(_PASSES):
            placed, new = function(values, commands, deflection)
            if not new.numel() or float(ca.norm_inf(ca.vec(new - deflection))) < _STEADY:
                break
            deflection = new
        return np.asarray(placed.full()).reshape(4, count, 4).transpose(1, 0, 2)

    @cached_property
    def _places(self) -> dict[str, range]:
        blocks = self.arm.parameters()
        ends = np.cumsum([0, *(b.size for b in blocks)])
        return {b.name: range(int(i), int(j)) for b, i, j in zip(blocks, ends, ends[1:], strict=False)}

    def _turned(self, joint: str, angles: Mapping[str, float], before: Array, after: Array, by: By) -> float:
        axis, origin = self.axis(joint, angles)
        if by == "rotation":
            turned = Rotation.from_matrix(np.array([after[:3, :3] @ before[:3, :3].T]))
            return float(twist_angles(turned, axis)[0])
        arm = _across(before[:3, 3] - origin, axis)
        return float(axis @ np.cross(arm, after[:3, 3] - before[:3, 3])) / max(float(arm @ arm), 1e-12)

    def _stiff(self, angles: Mapping[str, float]) -> Array:
        nothing = ca.DM.zeros(self.arm.deflection_size)
        return np.asarray(self._state(self._values, self._commands(angles), nothing)[0].full())

    def _bent(self, angles: Mapping[str, float], start: Any = None) -> tuple[Array, Any]:
        """The tool in equilibrium, and the deflection there."""
        commands = self._commands(angles)
        deflection = ca.DM.zeros(self.arm.deflection_size) if start is None else start
        for _ in range(_PASSES):
            placed, new = self._state(self._values, commands, deflection)
            if not new.numel() or float(ca.norm_inf(new - deflection)) < _STEADY:
                break
            deflection = new
        return np.asarray(placed.full()), deflection

    def _commands(self, angles: Mapping[str, float]) -> Array:
        return np.array([float(angles.get(joint, 0.0)) + self.zeros.get(joint, 0.0) for joint in self.joints])

    @cached_property
    def _values(self) -> Any:
        return ca.DM([float(number) for block in self.arm.parameters() for number in self._nominal[block.name]])

    @cached_property
    def _state(self) -> ca.Function:
        """Values, commands and a deflection to the tool, and to the deflection that follows."""
        blocks = self.arm.parameters()
        stacked = ca.SX.sym("values", sum(b.size for b in blocks))
        values = {name: stacked[places.start : places.stop] for name, places in self._places.items()}
        commands = ca.SX.sym("commands", len(self.joints))
        deflection = ca.SX.sym("deflection", self.arm.deflection_size)
        told = ca.vertcat(*self.arm.joint_commands(ca.vertsplit(commands)))
        e = self.environment
        acting = (list(e.gravity), e.payload_mass, list(e.payload_com), list(e.force), list(e.torque))
        conditions = {name: ca.SX(0) for name in self.arm.conditions}
        load = Load(*(ca.SX(each) for each in acting))
        state = self.arm.state(values, ArmInputs(told, ca.SX.zeros(told.numel()), load, deflection, conditions))
        out = [ca.densify(state.base_T_tool.matrix()), ca.densify(state.next_deflection)]
        return ca.Function("state", [stacked, commands, deflection], out, {"cse": True})

    @cached_property
    def _rigid(self) -> ca.Function:
        """Commands to the tool, and each joint's axis and origin, at the nominal values and without effects."""
        chain = self.arm.chain({name: ca.SX(value) for name, value in self._nominal.items()})
        commands = ca.SX.sym("commands", len(self.joints))
        told = self.arm.joint_commands(ca.vertsplit(commands))
        frames = forward(chain, [joint.offset + told[i] for i, joint in enumerate(chain.joints)], {})
        sites = frames.sites[1:]
        axes = [ca.mtimes(s.rotation, ca.SX(list(j.axis))) for s, j in zip(sites, chain.joints, strict=True)]
        out = [frames.base_T_tool.matrix(), ca.horzcat(*axes), ca.horzcat(*[s.origin for s in sites])]
        return ca.Function("rigid", [commands], [ca.densify(x) for x in out], {"cse": True})


def _across(vector: Array, axis: Array) -> Array:
    return np.asarray(vector - (vector @ axis) * axis)
