"""What each library and each extra is for: the module that is imported, and what is lost without it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType


@dataclass(frozen=True)
class Purpose:
    """A library: the module that armcal imports, what is lost without it, and whether calibrating needs it."""

    module: str
    lost: str
    needed: bool = False


_EVERYTHING = "nothing can be calibrated"

LIBRARIES: Mapping[str, Purpose] = MappingProxyType(
    {
        "numpy": Purpose("numpy", _EVERYTHING, needed=True),
        "scipy": Purpose("scipy.optimize", _EVERYTHING, needed=True),
        "casadi": Purpose("casadi", _EVERYTHING, needed=True),
        "pluggy": Purpose("pluggy", "no plugin is found, so nothing can be calibrated", needed=True),
        "pyyaml": Purpose("yaml", "no configuration can be read", needed=True),
        "pydantic": Purpose("pydantic", "no configuration can be checked", needed=True),
        "click": Purpose("click", "the command armcal does not start", needed=True),
        "rich": Purpose("rich.console", "no command but this one runs", needed=True),
        "jinja2": Purpose("jinja2", "no report can be written", needed=True),
        "cvxpy": Purpose("cvxpy", "no estimator cvxpy, no certified bound of a plan, no cones in recalibrate"),
        "matplotlib": Purpose("matplotlib.figure", "no figure of a mission"),
        "pyserial": Purpose("serial", "no servo board on a serial port"),
        "filterpy": Purpose("filterpy.kalman", "armcal recalibrate cannot use its Kalman filters"),
        "typing-extensions": Purpose(
            "typing_extensions", "no application of armcal runs, and some devices do not", needed=True
        ),
        "joblib": Purpose("joblib", "folds, starts and studies run in one process only"),
    }
)

EXTRAS: Mapping[str, str] = MappingProxyType(
    {
        "i2c": "servo boards on this computer's own I2C bus (link linux_i2c)",
        "mujoco": "checking an export for MuJoCo by MuJoCo itself",
        "bench": "make bench: comparing armcal with other programs",
        "docs": "make docs: this documentation as pages",
        "test": "make test: armcal's own tests",
        "dev": "make lint and make types",
    }
)

EXTRA_MODULES: Mapping[str, str] = MappingProxyType({"smbus2": "smbus2", "mujoco": "mujoco", "pin": "pinocchio"})
"""Libraries of extras that are imported to see whether they work; of the others the version is enough."""
