"""A recalibrator of a few lines, and a process that recalibrates with it: for tests of what is around it."""

from __future__ import annotations

import hashlib
import json
import os
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path
from unittest.mock import patch

from armcal.errors import DataError
from armcal.io.lines import StandardOutput
from armcal.measure.reader import ReadRequest, RequestedChannel
from armcal_online import loop
from armcal_online.commands import header_of, opened
from armcal_online.settings import RecalibrateSettings
from armcal_online.sources import Lines, RowParser, open_source

HEADER = "pose_id,q1_deg,q2_deg,x_mm,y_mm,z_mm"
CALIBRATION = "armcal_calibration: 0\n"
PACE = {"CALIBRATION_GAP_S": 0.0, "STATUS_S": 0.05, "CHECKPOINT_RECORDS": 25}
"""In place of the loop's own, while a fake runs."""


def request():
    """Two joints and a tracker."""
    joints = [RequestedChannel(f"arm.q{i}", (f"arm.q{i}", f"q{i}"), "angle", True, parts=("tracker",)) for i in (1, 2)]
    ways = [RequestedChannel(f"arm.approach.q{i}", (f"approach{i}",), "dimensionless", False) for i in (1, 2)]
    place = [
        RequestedChannel("time", ("time",), "time", False),
        RequestedChannel("payload", ("payload",), "mass", False),
    ]
    measured = [
        RequestedChannel(f"tracker.{a}", (f"tracker.{a}", a), "length", True, parts=("tracker",)) for a in "xyz"
    ]
    return ReadRequest({}, {}, (*joints, *ways, *place, *measured))


def row(number, note=None):
    """A line of a CSV."""
    cells = f"p{number},{number % 90}.5,{-number % 70}.25,{100 + number}.125,{number / 7!r},30"
    return cells if note is None else f"{cells},{note}"


class FakeRecalibrator:
    """Sums that hang on the order and on every bit of what was taken."""

    def __init__(self, differs=0.0, settings=None):
        self.request = request()
        self.settings = settings or RecalibrateSettings(output={"calibration_every_records": 10})
        self.ids = hashlib.sha256().hexdigest()
        self.total = 0.1 + differs
        self.count = 0

    def take(self, incoming, sequence, passed_over=""):
        if passed_over:
            return ({**self._event(incoming, sequence, "ignored"), "why": f"Passed over: {passed_over}."},)
        if incoming.record_id == "refused":
            raise DataError("it is refused.")
        if incoming.fault:
            return (self._event(incoming, sequence, "ignored"),)
        self.ids = hashlib.sha256(f"{self.ids} {incoming.record_id} {sequence}".encode()).hexdigest()
        self.total = (self.total * 1.1 + sum(incoming.channels.values())) % 1000.0
        self.count += 1
        told = [self._event(incoming, sequence, "accepted")]
        if self.count % 20 == 0:
            sentence = f"Record {self.count} decides."
            told.append({"event": "decision", "sequence": sequence, "at": 0.0, "kind": "drift", "sentence": sentence})
        return tuple(told)

    def _event(self, incoming, sequence, verdict):
        event = {"event": "record", "sequence": sequence, "id": incoming.record_id, "at": incoming.arrived}
        return {**event, "verdict": verdict, "why": incoming.fault, "nis": self.total}

    def snapshot(self):
        return {"ids": self.ids, "total": self.total, "count": self.count}

    def restore(self, snapshot):
        self.ids, self.total, self.count = snapshot["ids"], snapshot["total"], snapshot["count"]

    def digest(self):
        return hashlib.sha256(f"{self.ids} {self.total!r} {self.count}".encode()).hexdigest()

    def status(self):
        return {"level": "nominal", "count": self.count, "digest": self.digest()}

    def calibration_text(self):
        return json.dumps({"armcal_calibration": 1, "count": self.count, "total": self.total}) + "\n"

    def rolled_back_event(self, sequence, to):
        return {"event": "decision", "sequence": sequence, "at": 0.0, "kind": "rollback", "to": to, "sentence": "Back."}

    def started_event(self, resumed):
        return {"event": "started", "level": "nominal"}


@contextmanager
def begun(folder, fake, source, stream=None, pace=PACE):
    """A recalibration from a calibration that lies beside the folder."""
    calibration = Path(folder).with_suffix(".start.yaml")
    if not calibration.exists():
        calibration.parent.mkdir(parents=True, exist_ok=True)
        calibration.write_text(CALIBRATION)
    header = header_of(Path(folder), calibration, fake)
    with patch.multiple(loop, **pace), opened(Path(folder), header, fake, source, StandardOutput(stream)) as going:
        yield going


def main(folder, source, at_end):
    """Recalibrate with the fake, as the command does; a file that is to be waited for comes through ``tail``."""
    fake = FakeRecalibrator()
    rows = RowParser(fake.request, {})
    if at_end == "wait":
        followed = ["tail", "-n", "+1", "-F", "-s", "0.02", "--pid", str(os.getpid()), source]
        tail = subprocess.Popen(followed, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL)
        records = Lines(rows, tail.stdout.fileno())
    else:
        records = open_source(source, rows)
    with begun(folder, fake, records, sys.stdout.buffer) as going:
        going.run()


if __name__ == "__main__":
    main(*sys.argv[1:])
