"""figaroh's calibration of the seven-joint arm, by its documented way: a configuration, a CSV file, a subclass."""

from __future__ import annotations

import logging
import tempfile
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import yaml
from armcal.base.arrays import Array
from figaroh.calibration import BaseCalibration  # type: ignore[import-not-found]
from figaroh.calibration.calibration_tools import calc_updated_fkm  # type: ignore[import-not-found]

from benchmarks import rigid_arm


class _Calibration(BaseCalibration):  # type: ignore[misc]
    """Plain differences of positions: cheaper than figaroh's default residual, and the same cost."""

    def cost_function(self, var: Array) -> Array:
        shown = calc_updated_fkm(self.model, self.data, var, self.q_measured, self.calib_config)
        return np.asarray((self.PEE_measured - shown) / rigid_arm.NOISE_M)


class FigarohFit:
    """Data and parameter list are made ready beforehand; ``solve`` is the fit alone."""

    def __init__(self, angles: Array, tips: Array) -> None:
        logging.getLogger("calibration").setLevel(logging.ERROR)
        model = pin.buildModelFromXML(rigid_arm.urdf())
        robot = SimpleNamespace(model=model, data=model.createData(), q0=pin.neutral(model))
        with tempfile.TemporaryDirectory() as directory:
            data, config = Path(directory) / "data.csv", Path(directory) / "config.yaml"
            joints = [f"q{i}" for i in range(1, angles.shape[1] + 1)]
            header = ",".join(["x1", "y1", "z1", *joints])
            np.savetxt(data, np.hstack([tips, angles]), delimiter=",", header=header, comments="", fmt="%.17g")
            config.write_text(yaml.safe_dump(_config(data, len(angles))), encoding="utf-8")
            self._calibration = _Calibration(robot, str(config))
            # With both frames known its own selection finds a complete set; with unknown ones it does not here.
            self._calibration.calib_config["known_baseframe"] = True
            self._calibration.calib_config["known_tipframe"] = True
            self._calibration.initialize()
        self.variables = len(self._calibration.calib_config["param_name"])
        self._found = np.zeros(self.variables)

    def solve(self) -> None:
        """One fit, no outlier rounds."""
        answer, _ = self._calibration.solve_optimisation(max_iterations=1)
        self._found = answer.x

    def predict(self, angles: Array) -> Array:
        """Tips of the calibrated arm (N x 3)."""
        calibration = self._calibration
        config = {**calibration.calib_config, "NbSample": len(angles)}
        flat = calc_updated_fkm(calibration.model, calibration.data, self._found, angles, config)
        return np.asarray(flat).reshape(3, -1).T


def _config(data: Path, samples: int) -> dict[str, object]:
    task = {
        "type": "kinematic_calibration",
        "kinematics": {"base_frame": "universe", "tool_frame": "tip"},
        "measurements": {"markers": [{"measurable_dof": [True, True, True, False, False, False]}]},
        "parameters": {"calibration_level": "full_params"},
        "data": {"source_file": str(data), "number_of_samples": samples},
    }
    return {"robot": {"name": "arm"}, "tasks": {"calibration": task}}
