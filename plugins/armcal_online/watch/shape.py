"""The arm as a line of points for a drawing, from a calibration and the joint angles of a record.

It is drawn in elastic equilibrium under the load that the calibration states. casadi and numpy are imported when a
calibration is first drawn: a watcher in a terminal has no need of them.
"""

from collections.abc import Callable, Mapping
from pathlib import Path

Points = list[list[float]]
Drawing = Callable[[Mapping[str, float]], dict[str, Points]]


def drawing_of(path: Path) -> Drawing:
    """A function from joint angles by name (``arm.q1``; rad or m) to each arm's points in the base frame (mm).

    The points are the base frame's origin, the mount, every joint and the tool. An arm is left out where one of its
    joint angles is missing, and drawn rigid where it has no elastic equilibrium.

    Raises:
        ArmcalError: not a calibration, or one of a plugin that is not there.
        OSError: it cannot be read.
    """
    import casadi as ca
    import numpy as np
    from armcal.calibration.calibration import Calibration
    from armcal.calibration.tool_expression import Equilibrium

    calibration = Calibration.load(path, accept=True)
    arms = {}
    for name in calibration.system.arms:
        expression = calibration.expression(name)
        line = ca.horzcat(ca.SX.zeros(3), *expression.origins, expression.base_T_tool.translation)
        points = ca.Function("points", [expression.record, expression.state], [ca.densify(line)], {"cse": True})
        arms[name] = (expression, Equilibrium(expression, "interpreted"), points)

    def draw(joint_angles: Mapping[str, float]) -> dict[str, Points]:
        drawn = {}
        for name, (expression, equilibrium, points) in arms.items():
            joints = [f"{name}.{joint}" for joint in expression.joints]
            if all(joint in joint_angles for joint in joints):
                record = expression.defaults.copy()
                record[: len(joints)] = [joint_angles[joint] for joint in joints]
                standing = equilibrium(record[:, None])
                deflection = np.where(standing.settled, standing.states, 0.0)
                drawn[name] = (points(record, deflection).full().T * 1000).round(2).tolist()
        return drawn

    return draw


class Shape:
    """The arm's drawing by the newest calibration in a folder; it is looked for a newer one ``every`` so many s."""

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
            self._looked = now
            for path in (self._folder / "calibration.yaml", *([Path(started_from)] if started_from else [])):
                try:
                    version = (str(path), path.stat().st_mtime_ns)
                except (OSError, ValueError):
                    continue
                if version != self._known:
                    self._known = version
                    try:
                        self._draw, self.fault = drawing_of(path), None
                    except Exception as fault:  # whatever is wrong with a calibration, the rest of the page goes on
                        self.fault = str(fault)
                break
        return self._draw(joint_angles) if self._draw else {}
