"""Postures: the window of readings that one is the mean of, its labels, its journal, and the dataset that all make."""

import math
import time
from collections import deque
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Self

import numpy as np
from armcal.arm.assembly import Arm, command_channels
from armcal.base.dataset import Dataset
from armcal.base.settings import Angle, Duration, Length, Settings
from armcal.base.units import display_unit, to_unit
from armcal.devices.live import JointSample
from armcal.errors import DataError
from armcal.io.journal import JOURNAL_FILES, Journal
from armcal.measure.groups import record_keys
from armcal.measure.measurement import GroupedMeasurement, Measurement, NamesGroups
from armcal.measure.tables import write_csv
from armcal.run.experiment import Experiment
from pydantic import Field, model_validator

from armcal_bench.run_log import DATASET

_FULL_TURN = 2 * math.pi * (1 + 1e-9)
_LONG_ENOUGH = 0.8  # Of the window: readings need not fall on its ends
_MOST = 100_000


@dataclass(frozen=True)
class JointKinds:
    dimensions: Mapping[str, str]  # ``angle`` or ``length`` by channel, in order
    endless: frozenset[str]  # channels of joints that may turn on and on

    @classmethod
    def of(cls, arms: Mapping[str, Arm]) -> Self:
        dimensions = command_channels(arms)
        endless = {f"{name}.{j.name}" for name, arm in arms.items() for j in arm.nominal_chain.joints if j.endless}
        return cls(dimensions, frozenset(endless & set(dimensions)))

    @property
    def channels(self) -> tuple[str, ...]:
        return tuple(self.dimensions)

    def fault_of(self, angles: Mapping[str, float]) -> str:
        """Why these cannot be joint angles, a sentence; empty if they can."""
        lacking = [channel for channel in self.dimensions if channel not in angles]
        if lacking:
            return f"the readings have no {lacking[0]}: found {len(angles)} joints, expected {len(self.dimensions)}."
        for channel, kind in self.dimensions.items():
            value = angles[channel]
            if not math.isfinite(value):
                return f"the reading of {channel} is {value}, which is no angle."
            if kind == "angle" and channel not in self.endless and abs(value) > _FULL_TURN:
                return (
                    f"{channel} would stand at {value:.6g} rad, more than one turn (2 pi rad): does the stream give "
                    "degrees, or turns of the motor?"
                )
        return ""


@dataclass(frozen=True)
class Mean:
    angles: Mapping[str, float]  # means by channel
    spread: float  # of the joint that moved most (rad or m)
    readings: int
    labels: Mapping[str, str]
    stamp: float | None


class SampleWindow:
    """The newest readings; times are the source's own where it gives them."""

    def __init__(self, kinds: JointKinds, length: float, spread: float, sliding_spread: float, least: int) -> None:
        self._kinds, self._length, self._least = kinds, length, least
        limits = {"angle": spread, "length": sliding_spread}
        self._limits = np.array([limits[kind] for kind in kinds.dimensions.values()])
        self._samples: deque[tuple[float, JointSample]] = deque(maxlen=_MOST)

    def add(self, sample: JointSample) -> None:
        """The next reading; where time or labels jump, those before are forgotten."""
        at = sample.arrived if sample.stamp is None else sample.stamp
        if self._samples:
            last_at, last = self._samples[-1]
            is_other = last.labels != sample.labels or (last.stamp is None) != (sample.stamp is None)
            if is_other or not 0 <= at - last_at <= self._length:
                self._samples.clear()
        self._samples.append((at, sample))
        while at - self._samples[0][0] > self._length * (1 + 1e-9):
            self._samples.popleft()

    def clear(self) -> None:
        self._samples.clear()

    @property
    def is_filling(self) -> bool:
        lasts = self._samples[-1][0] - self._samples[0][0] if self._samples else 0.0
        return len(self._samples) < self._least or lasts < _LONG_ENOUGH * self._length

    def mean(self) -> Mean | str:
        count = len(self._samples)
        if not count:
            return "no joint readings came."
        lasts = self._samples[-1][0] - self._samples[0][0]
        if self.is_filling:
            return (
                f"only {count} readings over {lasts:.2f} s are there, expected {self._least} over "
                f"{self._length:g} s: wait, or let the source send more often."
            )
        newest = self._samples[-1][1]
        rows = np.array([[s.angles[channel] for channel in self._kinds.channels] for _, s in self._samples])
        spreads = np.ptp(rows, axis=0)
        worst = int(np.argmax(spreads / self._limits))
        if spreads[worst] > self._limits[worst]:
            channel = self._kinds.channels[worst]
            unit = display_unit(self._kinds.dimensions[channel]).name
            moved, allowed = (f"{to_unit(amount[worst], unit):.3g} {unit}" for amount in (spreads, self._limits))
            return (
                f"the arm does not stand still: {channel} moved by {moved} within {self._length:g} s "
                f"(allowed: {allowed})."
            )
        return Mean(
            angles=dict(zip(self._kinds.channels, rows.mean(axis=0).tolist(), strict=True)),
            spread=float(spreads[worst]),
            readings=count,
            labels=newest.labels,
            stamp=None if newest.stamp is None else float(np.mean([at for at, _ in self._samples])),
        )


class RecordingSettings(Settings):
    """How postures are captured."""

    window: Duration = 0.5  # a posture is the mean of the readings of so long
    samples: Annotated[int, Field(ge=2)] = 5  # it has at least so many
    spread: Angle = math.radians(0.2)  # no turning joint moves by more meanwhile
    sliding_spread: Length = 0.0002  # and no sliding one
    stale: Duration = 1.0  # a stream that is silent for longer does not show where the arm stands now
    rest: Duration = 1.0  # with ``--capture still``, how long the arm must stand before it is captured by itself
    moved: Angle = math.radians(5.0)  # and how far a joint must have gone since the posture before
    alike: Angle = math.radians(2.0)  # nearer postures of one group are reported as nearly the same
    groups: tuple[str, ...] = ()  # what the digits stand for; ``*/hole_0`` keeps the part before

    @model_validator(mode="after")
    def _above_zero(self) -> Self:
        for name in ("window", "spread", "sliding_spread", "stale", "rest", "moved", "alike"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} is not above zero")
        return self


KEPT = "*"  # A part of a name that stays what it was


class Labels:
    def __init__(self, measurements: Mapping[str, Measurement], known: Sequence[str]) -> None:
        self._grouped = [m for m in measurements.values() if isinstance(m, GroupedMeasurement)]
        self.columns = tuple(dict.fromkeys(label for m in self._grouped for label in m.group_labels))
        spoken = [n for m in self._grouped if isinstance(m, NamesGroups) and m.group_labels for n in m.named_groups()]
        self.known = tuple(known) or tuple(dict.fromkeys(spoken))
        self.present: dict[str, str] = {}

    @property
    def shown(self) -> str:
        return "/".join(self.present.get(column, "?") for column in self.columns)

    def name(self, text: str) -> str:
        """Take a name, ``front/hole_0``, or its last parts, or a digit for a known one; why it is refused, if it is."""
        if not self.columns:
            return "the measurements ask for no names: every posture belongs to the same group."
        text = text.strip()
        if text.isascii() and text.isdecimal() and self.known:
            if not 1 <= int(text) <= len(self.known):
                return f"{text} stands for no name: {self.known_labels_text()}."
            text = self.known[int(text) - 1]
        parts = [part.strip() for part in text.split("/")]
        if not all(parts) or len(parts) > len(self.columns):
            return f"found the name {text[:60]!r}, expected {'/'.join(self.columns)}, or its last part alone."
        columns = self.columns[len(self.columns) - len(parts) :]
        named = {column: part for column, part in zip(columns, parts, strict=True) if part != KEPT}
        fault = self._fault({**self.present, **named})
        if not fault:
            self.present.update(named)
        return fault

    def of(self, sent: Mapping[str, str]) -> tuple[dict[str, str], str]:
        """The labels of a posture, those that its stream sent before the named ones; and why it cannot have them."""
        labels = {column: (sent.get(column) or self.present.get(column, "")).strip() for column in self.columns}
        missing = [column for column, label in labels.items() if not label]
        if missing:
            example = self.known[0].replace(KEPT, "front") if self.known else "/".join(self.columns)
            why = f"no {' and no '.join(missing)} was named: which one does the arm touch? Type g {example}"
            return labels, f"{why}, or a digit ({self.known_labels_text()})." if self.known else f"{why}."
        return labels, self._fault(labels)

    def known_labels_text(self) -> str:
        return ", ".join(f"{i} {name}" for i, name in enumerate(self.known, start=1))

    def _fault(self, labels: Mapping[str, str]) -> str:
        try:
            for measurement in self._grouped:
                if all(label in labels for label in measurement.group_labels):
                    record_keys(Dataset(("1",), {}, {name: (text,) for name, text in labels.items()}), measurement)
        except DataError as fault:
            return f"{fault.message} {fault.hint}"
        return ""


IMAGES = "images"
OURS = (DATASET, *JOURNAL_FILES, IMAGES)
CAPTURED, UNDONE = "captured", "undone"  # Kinds of entries


@dataclass(frozen=True)
class Posture:
    name: str  # its number, counted from 1 over all that were ever captured here
    angles: Mapping[str, float]  # by channel (``arm.q1``; rad, or m of sliding joints)
    spread: float  # the largest less the smallest reading of the joint that moved most (rad or m)
    readings: int  # how many it is the mean of
    at: float  # unix seconds; of two postures the later one's is not the smaller
    labels: Mapping[str, str] = field(default_factory=dict)  # the group it belongs to (a socket's name), by column
    stamp: float | None = None  # when it was, by the source's own clock (s), where it says so
    image: str = ""  # the name of its image's file; empty where none was taken
    values: Mapping[str, float] = field(default_factory=dict)  # what the image says, by channel (``camera.u_3``, SI)

    @property
    def place(self) -> str:
        return "/".join(self.labels.values())

    def as_dict(self) -> dict[str, Any]:
        """As JSON, to be read back by ``Posture(**content)``, numbers bit for bit."""
        return {**self.__dict__, "angles": dict(self.angles), "labels": dict(self.labels), "values": dict(self.values)}


class RecordingLog:
    def __init__(self, journal: Journal) -> None:
        self._journal = journal
        self._postures: dict[str, Posture] = {}
        self.last: Posture | None = None  # captured, undone or not
        self._count = 0
        for entry in journal.entries():
            if entry.kind == CAPTURED:
                self._take(Posture(**entry.content))
            elif entry.kind == UNDONE:
                self._postures.pop(entry.content["name"], None)

    @property
    def postures(self) -> tuple[Posture, ...]:
        return tuple(self._postures.values())

    def next_posture(self, mean: Mean, labels: Mapping[str, str], values: Mapping[str, float]) -> Posture:
        at = max(time.time(), self.last.at if self.last else 0.0)
        name = str(self._count + 1)
        return Posture(name, dict(mean.angles), mean.spread, mean.readings, at, dict(labels), mean.stamp, values=values)

    def capture(self, posture: Posture) -> None:
        self._journal.record(CAPTURED, posture.as_dict())
        self._take(posture)

    def undo(self) -> Posture | None:
        if not self._postures:
            return None
        name = next(reversed(self._postures))
        self._journal.record(UNDONE, {"name": name})
        return self._postures.pop(name)

    def _take(self, posture: Posture) -> None:
        self._postures[posture.name] = self.last = posture
        self._count += 1


def dataset_of(postures: Sequence[Posture], doubts: Mapping[str, str] | None = None) -> Dataset:
    """The postures in the order of capture, at least one; ``doubts`` say why one is not to be trusted, by name."""
    first = postures[0]
    channels = {name: np.array([p.angles[name] for p in postures]) for name in first.angles}
    for name in dict.fromkeys(name for p in postures for name in p.values):
        channels[name] = np.array([p.values.get(name, np.nan) for p in postures])
    channels["time"] = np.array([p.at for p in postures])
    extra = {name: tuple(p.labels[name] for p in postures) for name in first.labels}
    if any(p.image for p in postures):
        extra["image"] = tuple(p.image for p in postures)
    extra["readings"] = tuple(str(p.readings) for p in postures)
    extra["doubt"] = tuple((doubts or {}).get(p.name, "") for p in postures)
    return Dataset(tuple(p.name for p in postures), channels, extra, source="recorded")


def write_dataset(folder: Path, experiment: Experiment, postures: Sequence[Posture], doubts: Mapping[str, str]) -> None:
    if not postures:
        (folder / DATASET).unlink(missing_ok=True)
        return
    dataset = dataset_of(postures, doubts)
    write_csv(folder / DATASET, dataset, experiment.request(measured=True).channels)
