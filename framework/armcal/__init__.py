"""armcal finds what a robot arm really is, and how sure it is of each number.

The names below are the public Python interface, first what runs and uses calibrations, then what plugins are made of;
each is imported when it is first used, so that ``import armcal`` stays light.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from armcal.version import __version__

if TYPE_CHECKING:
    from armcal.api import Experiment as Experiment
    from armcal.api import Run as Run
    from armcal.arm.assembly import ArmState as ArmState
    from armcal.arm.effects import XYZ as XYZ
    from armcal.arm.effects import Condition as Condition
    from armcal.arm.effects import EffectSettings as EffectSettings
    from armcal.arm.effects import JointCommand as JointCommand
    from armcal.arm.effects import JointEffect as JointEffect
    from armcal.arm.effects import Spring as Spring
    from armcal.arm.effects import chosen as chosen
    from armcal.arm.model import Attachment as Attachment
    from armcal.arm.model import Chain as Chain
    from armcal.arm.model import Joint as Joint
    from armcal.arm.pose_residual import ModelErrors as ModelErrors
    from armcal.arm.pose_residual import PoseResidual as PoseResidual
    from armcal.arm.pose_residual import Postures as Postures
    from armcal.base.dataset import Dataset as Dataset
    from armcal.base.domains import Interval as Interval
    from armcal.base.parameters import ParameterBlock as ParameterBlock
    from armcal.base.parameters import Parameters as Parameters
    from armcal.base.parameters import scalar as scalar
    from armcal.base.settings import Angle as Angle
    from armcal.base.settings import Compliance as Compliance
    from armcal.base.settings import Force as Force
    from armcal.base.settings import Length as Length
    from armcal.base.settings import Length3 as Length3
    from armcal.base.settings import Mass as Mass
    from armcal.base.settings import Settings as Settings
    from armcal.base.settings import Temperature as Temperature
    from armcal.base.settings import Torque as Torque
    from armcal.calibration.calibration import Calibration as Calibration
    from armcal.calibration.compensation import Commands as Commands
    from armcal.calibration.compensation import Compensator as Compensator
    from armcal.calibration.compensation import Options as Options
    from armcal.calibration.compensation import Targets as Targets
    from armcal.diagnose.checks import Finding as Finding
    from armcal.errors import ArmcalError as ArmcalError
    from armcal.errors import InputError as InputError
    from armcal.errors import NotConvergedError as NotConvergedError
    from armcal.estimate.estimator import Estimate as Estimate
    from armcal.hooks import hookimpl as hookimpl
    from armcal.measure.measurement import Channel as Channel
    from armcal.measure.measurement import Contact as Contact
    from armcal.measure.measurement import Instrument as Instrument
    from armcal.measure.measurement import InstrumentSettings as InstrumentSettings
    from armcal.plugins import use_plugins as use_plugins
    from armcal.report.document import ReportSection as ReportSection
    from armcal.run.pipeline import calibrate as calibrate
    from armcal.run.result import RunResult as RunResult

_FOR_USERS = {
    "armcal.api": "Experiment Run",
    "armcal.base.dataset": "Dataset",
    "armcal.base.parameters": "ParameterBlock Parameters",
    "armcal.base.settings": "Settings",
    "armcal.errors": "ArmcalError InputError NotConvergedError",
    "armcal.hooks": "hookimpl",
    "armcal.run.pipeline": "calibrate",
    "armcal.run.result": "RunResult",
    "armcal.estimate.estimator": "Estimate",
    "armcal.calibration.calibration": "Calibration",
    "armcal.calibration.compensation": "Commands Compensator Options Targets",
}
"""What runs and uses calibrations."""
_FOR_PLUGINS = {
    "armcal.arm.assembly": "ArmState",
    "armcal.arm.effects": "Condition EffectSettings JointCommand JointEffect Spring XYZ chosen",
    "armcal.arm.model": "Attachment Chain Joint",
    "armcal.arm.pose_residual": "ModelErrors PoseResidual Postures",
    "armcal.base.domains": "Interval",
    "armcal.base.parameters": "scalar",
    "armcal.base.settings": "Angle Compliance Force Length Length3 Mass Temperature Torque",
    "armcal.diagnose.checks": "Finding",
    "armcal.measure.measurement": "Channel Contact Instrument InstrumentSettings",
    "armcal.plugins": "use_plugins",
    "armcal.report.document": "ReportSection",
}
"""What plugins are made of."""
_HOMES = {name: home for homes in (_FOR_USERS, _FOR_PLUGINS) for home, names in homes.items() for name in names.split()}

__all__ = ["__version__", *(name for names in _FOR_USERS.values() for name in names.split())]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(_HOMES[name]), name)
    raise AttributeError(f"module 'armcal' has no attribute {name!r}")
