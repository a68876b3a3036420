"""The arm as a line of points for a drawing, from a calibration and the joint angles of a record.

It is drawn with what its springs give under the load that the calibration states, as far as that can be found quickly.
casadi and numpy are imported when a calibration is first drawn: a watcher in a terminal has no need of them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import casadi as ca
    import numpy as np
    from armcal.arm.assembly import Arm, ArmInputs
    from armcal.arm.environment import Environment

    Values = Mapping[str, ca.SX]

Points = list[list[float]]
Drawing = Callable[[Mapping[str, float]], dict[str, Points]]

_MOST_PASSES = 60
_SETTLED = 1e-6
_MOST_DEFLECTION = 1.5


def drawing_of(path: Path) -> Drawing:
    """A function from joint angles by name (``arm.q1``; rad or m) to each arm's points in the base frame (mm).

    The points are the base frame's origin, the mount, every joint and the tool. An arm is left out where one of its
    joint angles is missing.

    Raises:
        ArmcalError: not a calibration, or one of a plugin that is not there.
        OSError: it cannot be read.
    """
    import casadi as ca
    from armcal.calibration.calibration import Calibration

    calibration = Calibration.load(path, accept=True)
    environment = calibration.system.environment
    values = {block.name: ca.SX(list(block.nominal)) for block in calibration.parameters.blocks}
    arms = {
        name: (tuple(f"{name}.{joint}" for joint in arm.commanded), _passes(arm, values, environment))
        for name, arm in calibration.system.arms.items()
    }

    def draw(joint_angles: Mapping[str, float]) -> dict[str, Points]:
        drawn = {}
        for name, (joints, function) in arms.items():
            if all(joint in joint_angles for joint in joints):
                at = _settled(function, [joint_angles[joint] for joint in joints])
                drawn[name] = [[round(float(x) * 1000, 2) for x in point] for point in at.T]
        return drawn

    return draw


def _passes(arm: Arm, values: Values, environment: Environment) -> ca.Function:
    """Commands and deflections to the points (3 x n, m) and the deflections that these lead to."""
    import casadi as ca
    from armcal.arm.effects import JointCommand
    from armcal.arm.elastic import elastic_sites, split_deflection
    from armcal.arm.model import forward

    chain, sites = arm.chain(values), elastic_sites(arm.nominal_chain, arm.springs(values))
    commands, deflection = ca.SX.sym("commands", len(arm.commanded)), ca.SX.sym("deflection", arm.deflection_size)
    inputs = _inputs(arm, commands, deflection, environment)
    along, rotations = split_deflection(chain.joints, sites, deflection)
    displacements = [
        joint.offset + along[i] + arm.displacement(values, JointCommand(i, inputs.joint_angles[i], inputs.approach[i]))
        for i, joint in enumerate(chain.joints)
    ]
    frames = forward(chain, displacements, rotations)
    points = [ca.SX.zeros(3), *(site.origin for site in frames.sites), frames.base_T_tool.translation]
    given = deflection if arm.conditions else arm.state(values, inputs).next_deflection
    outputs = [ca.densify(ca.horzcat(*points)), ca.densify(given)]
    return ca.Function("points", [commands, deflection], outputs, {"cse": True})


def _inputs(arm: Arm, commands: ca.SX, deflection: ca.SX, environment: Environment) -> ArmInputs:
    import casadi as ca
    from armcal.arm.assembly import ArmInputs
    from armcal.arm.statics import Load

    told = ca.vertcat(*arm.joint_commands(ca.vertsplit(commands)))
    vectors = (environment.gravity, environment.payload_com, environment.force, environment.torque)
    gravity, payload_com, force, torque = (ca.SX(list(vector)) for vector in vectors)
    load = Load(gravity, ca.SX(environment.payload_mass), payload_com, force, torque)
    return ArmInputs(told, ca.SX.zeros(told.numel()), load, deflection)


def _settled(function: ca.Function, commands: list[float]) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    """The points (3 x n, m) in equilibrium; of the rigid arm where none is found."""
    import numpy as np

    rigid = np.zeros(function.size1_in(1))
    deflection = rigid
    for _ in range(_MOST_PASSES):
        points, given = (np.asarray(dm.full()) for dm in function(commands, deflection))
        before, deflection = deflection, given.ravel()
        if not np.all(np.abs(deflection) < _MOST_DEFLECTION):
            return np.asarray(function(commands, rigid)[0].full())
        if np.all(np.abs(deflection - before) < _SETTLED):
            break
    return points


class Shape:
    """The arm's drawing by the newest calibration there is, read again when it changes.

    Args:
        folder: of the recalibration.
        every: how long a calibration is used before a newer one is looked for (s).
    """

    def __init__(self, folder: Path, every: float = 30.0) -> None:
        self._folder, self._every = folder, every
        self._known: tuple[str, int] | None = None
        self._looked = float("-inf")
        self._draw: Drawing | None = None
        self.fault: str | None = None

    def points(self, joint_angles: Mapping[str, float], started_from: str | None, now: float) -> dict[str, Points]:
        """Each arm's points (mm); empty where there is no calibration yet, or none that can be read.

        Args:
            joint_angles: by name (rad or m).
            started_from: the calibration that the recalibration began with, used until there is a newer one.
            now: seconds on any clock that only goes forward.
        """
        if now - self._looked >= self._every or self._known is None:
            self._look(started_from)
            self._looked = now
        return self._draw(joint_angles) if self._draw else {}

    def _look(self, started_from: str | None) -> None:
        for path in (self._folder / "calibration.yaml", *([Path(started_from)] if started_from else [])):
            try:
                found = (str(path), path.stat().st_mtime_ns)
            except (OSError, ValueError):
                continue
            if found != self._known:
                self._load(path)
                self._known = found
            return

    def _load(self, path: Path) -> None:
        try:
            self._draw, self.fault = drawing_of(path), None
        except Exception as fault:  # whatever is wrong with a calibration, the rest of the page goes on
            self.fault = str(fault)
