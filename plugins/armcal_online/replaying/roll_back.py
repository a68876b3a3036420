"""Setting back the estimate of a recalibration that has ended, however it ended: by its own journal, and nothing else.

The same is done as in one that runs: the journal gets an entry, the state is that of then, ``calibration.yaml`` is
replaced. Nothing is lost: the journal keeps every record, and another roll-back goes forth again.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from armcal.errors import InputError, Location
from armcal.io.journal.journal import JournalLimits
from armcal.plugins import PluginRegistry

from armcal_online.replaying.kept_journal import kept_calibration, kept_in, kept_journal, kept_settings
from armcal_online.running.control import GOOD, entry_named, rolled_back
from armcal_online.running.session import JOURNAL, Setup, opened
from armcal_online.sources.source import Incoming, Source
from armcal_online.tracking.recalibrator import Recalibrator


class NoRecords(Source):
    """A source that has ended."""

    keeps_records = True
    ended = True

    def incoming(self, wait_s: float) -> Incoming | None:
        """None."""
        return None


def roll_back_ended(folder: Path, to: int | str, registry: PluginRegistry) -> Mapping[str, Any]:
    """Set the estimate in the folder of a recalibration that does not run back; see ``rolled_back``.

    Raises:
        InputError: there is no journal, it is in use, or there is nothing to go back to.
        DataError: the journal is damaged, or does not reach there.
    """
    journal = folder / JOURNAL
    if not journal.is_dir():
        hint = "Give the folder that armcal recalibrate was given as --out."
        raise InputError("there is no journal of a recalibration.", where=Location(str(folder)), hint=hint)
    held = kept_journal(journal)
    if isinstance(to, str) and to != GOOD:
        to = entry_named(journal, to)
    held.check_until(to if isinstance(to, int) else None, "rollback")
    header = held.first.header
    with kept_in(journal):
        calibration = kept_calibration(header, journal, registry)
        session = Recalibrator(calibration, kept_settings(header), registry)
    setup = Setup(
        folder=folder,
        calibration=Path(str(header.get("path", ""))),
        limits=JournalLimits(total_bytes=1 << 62),  # nothing of the past goes for this
        kept=header,
    )
    with opened(setup, session, NoRecords()) as loop:
        reply = rolled_back(loop, to)
        loop.finishing = "The estimate was set back after the end."
        loop.run()
    return reply
