"""``armcal plan --iso-cube``."""

import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from scipy.spatial.transform import Rotation

from armcal.cli.common import Console
from armcal.cli.console import columned
from armcal.measure.csv_writer import write_csv
from armcal.run.experiment import Experiment
from armcal.run.iso_cube.iso_plan import IsoPlan, make_iso_plan
from armcal.run.iso_cube.placement import NAMES

_MM = 1000.0


def show_iso_plan(
    console: Console, experiment: Experiment, size: float | None, out: Path, options: Mapping[str, Any]
) -> None:
    """Plan the test in a cube of this size (m; None: the largest), write it to ``out`` and show it."""
    began = time.perf_counter()
    plan = make_iso_plan(experiment, size, options["cycles"], options["directions"], options["calibration"])
    write_csv(out, plan.dataset, experiment.request(measured=False).channels)
    content = _content(experiment, plan, options["cycles"])
    console.result({**content, "out": str(out)})
    for text in plan.warnings:
        console.warn(text)
    cube, turned = content["cube"], content["tool_rpy_deg"]
    x, y, z = cube["centre_mm"]
    console.line(
        f"{experiment.name}: cube of {cube['size_mm']:g} mm about ({x:.1f}, {y:.1f}, {z:.1f}) mm, "
        + (f"tool at roll, pitch, yaw {_three(turned)} deg." if turned else "the tool turns from pose to pose.")
    )
    table = columned("Poses of the tool, mm, base frame", ("pose", "x", "y", "z"))
    for name, place in content["poses"].items():
        table.add_row(name, *(f"{coordinate:.1f}" for coordinate in place))
    console.out.print(table)
    console.line(
        f"{content['visits']} visits in {content['cycles']} cycles: {out}  ({time.perf_counter() - began:.1f} s)"
    )
    console.line("Measure each visit, add the columns of the instrument, and give the table to armcal acceptance.")


def _content(experiment: Experiment, plan: IsoPlan, cycles: int) -> dict[str, Any]:
    cube, turned = plan.cube, None
    if cube.rotation is not None:
        turned = Rotation.from_matrix(cube.rotation).as_euler("xyz", degrees=True).tolist()
    return {
        "experiment": experiment.name,
        "cube": {"size_mm": cube.size * _MM, "centre_mm": (cube.centre * _MM).tolist()},
        "tool_rpy_deg": turned,
        "poses": dict(zip(NAMES, (cube.points * _MM).tolist(), strict=True)),
        "cycles": cycles,
        "visits": len(plan.dataset),
        "directions": list(dict.fromkeys(plan.dataset.extra["direction"])),
        "largest_joint_motion_rad_or_m": plan.motion,
        "warnings": list(plan.warnings),
    }


def _three(numbers: Any) -> str:
    return "(" + ", ".join(f"{number:.1f}" for number in numbers) + ")"
