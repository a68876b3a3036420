"""An MJCF model in MuJoCo: its tool with stiff springs, and with its springs in static equilibrium."""

from typing import Any

import numpy as np
from armcal.base.arrays import Array
from armcal.calibration.rigid_chain import RigidChain
from armcal.errors import NotConvergedError

_TURNS, _AT_REST, _FARTHEST, _DIFFERENCE = 60, 1e-12, 1.5, 1e-6


class LoadedModel:
    """A model that MuJoCo took.

    Raises:
        ModuleNotFoundError: MuJoCo is not installed.
        ValueError: it refuses the model.
    """

    def __init__(self, content: bytes, rigid: RigidChain) -> None:
        import mujoco

        self._mujoco: Any = mujoco
        self._model: Any = self._mujoco.MjModel.from_xml_string(content.decode("utf-8"))
        self._data: Any = self._mujoco.MjData(self._model)
        self._rigid = rigid
        self._site = self._model.site("tool").id
        self._places = {joint.name: int(self._model.joint(joint.name).qposadr[0]) for joint in rigid.joints}
        driven = set(self._places.values())
        self._springs = np.array([i for i in range(self._model.nq) if i not in driven], dtype=int)

    def rigid_tool(self, command: Array) -> Array:
        """base_T_tool (4 x 4) with no spring bent, at commands of the commanded joints."""
        self._set(command)
        return self._tool()

    def tool_at_rest(self, command: Array) -> Array:
        """base_T_tool (4 x 4) where the springs balance gravity and the joints stand at their commands.

        Raises:
            NotConvergedError: they find no balance.
        """
        self._set(command)
        if len(self._springs):
            self._settle()
        return self._tool()

    def _set(self, command: Array) -> None:
        content = dict(zip([j.name for j in self._rigid.joints if j.mimic is None], command, strict=True))
        self._data.qpos[:] = 0.0
        for joint in self._rigid.joints:
            q = content[joint.name] if joint.mimic is None else content[joint.mimic.master] * joint.mimic.multiplier
            self._data.qpos[self._places[joint.name]] = q + (joint.mimic.offset if joint.mimic else 0.0)
        self._data.qvel[:] = 0.0

    def _settle(self) -> None:
        """Newton's steps on spring torque minus weight, with slopes by differences."""
        springs = self._springs
        for _ in range(_TURNS):
            missing = self._missing()
            slope = np.empty((len(springs), len(springs)))
            for column, place in enumerate(springs):
                self._data.qpos[place] += _DIFFERENCE
                slope[:, column] = (self._missing() - missing) / _DIFFERENCE
                self._data.qpos[place] -= _DIFFERENCE
            step = np.linalg.solve(slope, -missing)
            longest = float(np.abs(step).max())
            self._data.qpos[springs] += step * min(1.0, 0.3 / max(longest, _AT_REST))
            if longest <= _AT_REST:
                return
            if not np.abs(self._data.qpos[springs]).max() < _FARTHEST:
                break
        if not longest <= 1e-9:
            raise NotConvergedError("the model in MuJoCo finds no balance.", hint="Check masses and compliances.")

    def _missing(self) -> Array:
        """What keeps the springs from rest (N m or N): weight minus spring."""
        self._mujoco.mj_forward(self._model, self._data)
        both = self._data.qfrc_bias - self._data.qfrc_passive
        return np.asarray(both[self._springs])

    def _tool(self) -> Array:
        self._mujoco.mj_kinematics(self._model, self._data)
        result = np.eye(4)
        result[:3, :3] = self._data.site_xmat[self._site].reshape(3, 3)
        result[:3, 3] = self._data.site_xpos[self._site]
        return result
