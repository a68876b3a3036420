"""armcal finds what a robot arm really is, and how sure it is of each number.

The names below are the public Python interface, first what runs and uses calibrations, then what plugins are made of;
each is imported when it is first used, so that ``import armcal`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from armcal.api import Experiment, Run
    from armcal.arm.assembly import ArmState as ArmState
    from armcal.arm.effects import XYZ as XYZ
    from armcal.arm.effects import Condition as Condition
    from armcal.arm.effects import EffectSettings as EffectSettings
    from armcal.arm.effects import JointCommand as JointCommand
    from armcal.arm.effects import JointEffect as JointEffect
    from armcal.arm.effects import Spring as Spring
    from armcal.arm.effects import chosen as chosen
    from armcal.base.dataset import Dataset
    from armcal.base.domains import Interval as Interval
    from armcal.base.parameters import ParameterBlock, Parameters
    from armcal.base.parameters import scalar as scalar
    from armcal.base.settings import Angle as Angle
    from armcal.base.settings import Length as Length
    from armcal.base.settings import Length3 as Length3
    from armcal.base.settings import Settings
    from armcal.errors import ArmcalError, InputError, NotConvergedError
    from armcal.hooks import hookimpl
    from armcal.measure.contact import Contact as Contact
    from armcal.measure.instrument import Instrument as Instrument
    from armcal.measure.instrument import InstrumentSettings as InstrumentSettings
    from armcal.measure.measurement import Channel as Channel
    from armcal.plugin_files import use_plugins as use_plugins
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
_FOR_PLUGINS = {
    "ArmState": "armcal.arm.assembly",
    "Channel": "armcal.measure.measurement",
    "Contact": "armcal.measure.contact",
    "Instrument": "armcal.measure.instrument",
    "InstrumentSettings": "armcal.measure.instrument",
    "Angle": "armcal.base.settings",
    "Condition": "armcal.arm.effects",
    "EffectSettings": "armcal.arm.effects",
    "Interval": "armcal.base.domains",
    "JointCommand": "armcal.arm.effects",
    "JointEffect": "armcal.arm.effects",
    "Length": "armcal.base.settings",
    "Length3": "armcal.base.settings",
    "Spring": "armcal.arm.effects",
    "XYZ": "armcal.arm.effects",
    "chosen": "armcal.arm.effects",
    "scalar": "armcal.base.parameters",
    "use_plugins": "armcal.plugin_files",
}


def __getattr__(name: str) -> Any:
    home = _HOMES.get(name) or _FOR_PLUGINS.get(name)
    if home:
        return getattr(import_module(home), name)
    raise AttributeError(f"module 'armcal' has no attribute {name!r}")
