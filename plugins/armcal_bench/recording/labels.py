"""The names of what the arm touches: which columns they fill, and what a key or a typed name stands for."""

from collections.abc import Mapping, Sequence

from armcal.base.dataset import Dataset
from armcal.errors import DataError
from armcal.measure.groups import record_keys
from armcal.measure.measurement import GroupedMeasurement, Measurement, NamesGroups

KEPT = "*"  # A part of a name that stays what it was


class Labels:
    """The labels that the next posture gets.

    Args:
        measurements: by instance; their groups' labels are asked for.
        known: names that digits stand for; those that the measurements' settings speak of where there are none.
    """

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
        """Take a name, ``front/hole_0``, or only its last parts; a digit stands for a known one.

        Returns:
            why it is refused, a sentence; empty if it is taken.
        """
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
