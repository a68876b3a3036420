"""Which way gravity points: stated by the configuration or the data, or only assumed."""

from __future__ import annotations

from armcal.base.dataset import Dataset
from armcal.config.system import System
from armcal.diagnose.noise_findings import Finding


def gravity_findings(system: System, dataset: Dataset) -> list[Finding]:
    """A warning where springs bend under weights and nobody stated which way gravity points.

    A tracker's frame may stand in any way: gravity that is turned with it makes wrong compliances, and fits as well.
    """
    if system.statics.gravity is not None or dataset.has("gravity_z"):
        return []
    payload = bool(system.statics.payload) or (dataset.has("payload") and bool(dataset.column("payload").any()))
    bent = [name for name, arm in system.arms.items() if arm.deflection_size and (arm.masses or payload)]
    if not bent:
        return []
    x, y, z = system.environment.gravity
    text = (
        f"Nobody stated which way gravity points: for the springs of {', '.join(bent)} it was assumed to be "
        f"({x:g}, {y:g}, {z:g}) m/s^2 in the frame of the measurements, z up. If that frame is tilted, compliances are "
        "wrong."
    )
    action = "State statics.gravity_m_s2 in that frame, or record it: columns gravity_x_m_per_s2, _y, _z."
    return [Finding("warning", text, action=action)]
