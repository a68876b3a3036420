"""What a board is told to do by itself when its host falls silent."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

from armcal.devices.link import GuardedLink

from armcal_pca9685.servo import Servo


@dataclass(frozen=True)
class Guard:
    """Where to go, by joint in counts, how fast (rad/s), and after which silence (s)."""

    waypoints: tuple[Mapping[str, int], ...]
    rate: float
    after_s: float

    def tell(self, link: GuardedLink, servos: Mapping[str, Servo], standing: Mapping[str, int]) -> None:
        """Hand it to the board, for the joints that have pulses.

        A joint that a waypoint does not name stays where the waypoint before left it, or where it stands.
        """
        named = {joint for waypoint in self.waypoints for joint in waypoint}
        joints = [joint for joint in servos if joint in named and joint in standing]
        places = {joint: servos[joint].place for joint in joints}
        at = {joint: standing[joint] for joint in joints}
        ways = []
        for waypoint in self.waypoints:
            at = {joint: waypoint.get(joint, counts) for joint, counts in at.items()}
            ways.append({places[joint]: counts for joint, counts in at.items()})
        rates = {places[joint]: servos[joint].counts_per_s(self.rate) for joint in joints}
        link.guard(ways if joints else [], rates, self.after_s)
