"""A mission's records through the loop that ``armcal recalibrate`` uses."""

from __future__ import annotations

import io
import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from armcal.calibration.calibration import Calibration
from armcal.io.standard_output import StandardOutput
from armcal.plugins import PluginRegistry

from armcal_online.commands.recalibrate import setup_of
from armcal_online.mission.mission import Session
from armcal_online.mission.source import MissionSource, PowerCutError
from armcal_online.running.session import opened
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings


def loop_session(registry: PluginRegistry) -> Session:
    """Sessions in one folder, each going on from the journal there; see ``Session``."""

    def session(
        calibration: Path, settings: RecalibrateSettings, source: MissionSource, folder: Path
    ) -> Sequence[Mapping[str, Any]]:
        recalibrator = Recalibrator.begin(Calibration.load(calibration, registry), settings, registry)
        heard = io.BytesIO()
        setup = setup_of(settings, calibration, folder, StandardOutput(heard))
        try:
            with opened(setup, recalibrator, lambda rows: source) as going:
                going.run()
                if not source.ended:
                    raise KeyboardInterrupt
        except PowerCutError:
            pass
        return [json.loads(line) for line in heard.getvalue().decode().splitlines()]

    return session
