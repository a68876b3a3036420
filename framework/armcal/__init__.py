"""armcal finds what a robot arm really is, and how sure it is of each number.

The names below are the public Python interface; each is imported when it is first used, so that
``import armcal`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from armcal.api import Experiment, Run
    from armcal.base.dataset import Dataset
    from armcal.base.parameters import ParameterBlock, Parameters
    from armcal.base.settings import Settings
    from armcal.errors import ArmcalError, InputError, NotConvergedError
    from armcal.hooks import hookimpl
    from armcal.run.pipeline import calibrate
    from armcal.run.result import RunResult
    from armcal.solve.estimator import Estimate
    from armcal.use.calibration import Calibration
    from armcal.use.compensation.compensator import Compensator
    from armcal.use.compensation.request import Commands, Options, Targets

__version__ = "0.1.0"

__all__ = [
    "ArmcalError",
    "Calibration",
    "Commands",
    "Compensator",
    "Dataset",
    "Estimate",
    "Experiment",
    "InputError",
    "NotConvergedError",
    "Options",
    "ParameterBlock",
    "Parameters",
    "Run",
    "RunResult",
    "Settings",
    "Targets",
    "__version__",
    "calibrate",
    "hookimpl",
]

_HOMES = {
    "ArmcalError": "armcal.errors",
    "Calibration": "armcal.use.calibration",
    "Commands": "armcal.use.compensation.request",
    "Compensator": "armcal.use.compensation.compensator",
    "Dataset": "armcal.base.dataset",
    "Estimate": "armcal.solve.estimator",
    "Experiment": "armcal.api",
    "InputError": "armcal.errors",
    "NotConvergedError": "armcal.errors",
    "Options": "armcal.use.compensation.request",
    "ParameterBlock": "armcal.base.parameters",
    "Parameters": "armcal.base.parameters",
    "Run": "armcal.api",
    "RunResult": "armcal.run.result",
    "Settings": "armcal.base.settings",
    "Targets": "armcal.use.compensation.request",
    "calibrate": "armcal.run.pipeline",
    "hookimpl": "armcal.hooks",
}


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'armcal' has no attribute {name!r}")
