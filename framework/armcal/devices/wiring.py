"""Whether each servo was seen to move the joint that its configuration names, since that configuration was changed.

``armcal servo --check`` writes what it saw beside the file that names the servos: the servo file of boards that make
pulses, the configuration of servos on a bus. ``armcal acquire`` drives no joint that is not there.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from armcal.base.config_text import plain, resolve_path
from armcal.config.servo_file import ServoFile, digest, load_servo_file
from armcal.config.yaml_source import ConfigSource
from armcal.devices.device import JointDevice, MeasuringDevice
from armcal.errors import InputError, Location
from armcal.io.plain_files import write_whole, writing

_WRONG = ""  # in the place of the fingerprint of a servo that did not do what was commanded


@dataclass(frozen=True)
class WiringRecord:
    """What was checked of servos."""

    stated_in: Path  # the file that names them; the record lies beside it
    digests: Mapping[str, str]  # by joint: a fingerprint (hex) of all that is stated of its servo

    @classmethod
    def of_servo_file(cls, path: Path, file: ServoFile | None = None) -> WiringRecord:
        """Of a servo file, as it stands or as ``file`` has it; see ``load_servo_file`` for what it raises."""
        known = load_servo_file(path) if file is None else file
        return cls(path, {joint: digest({joint: known.calibrated(joint)}) for joint in known.servos})

    @classmethod
    def of_config(cls, source: ConfigSource, joints: Iterable[str]) -> WiringRecord:
        """Of ``bench.device.joints``; what was checked on a simulated bench is not checked on a real one."""
        device = {key: value for key, value in bench_section(source, "device").items() if key != "port"}
        stated = device.get("joints")
        parts = {key.rpartition(".")[2]: part for key, part in stated.items()} if isinstance(stated, dict) else {}
        is_real = bench_section(source).get("simulated") is None
        names = [joint.rpartition(".")[2] for joint in joints]
        texts = {n: json.dumps(plain([parts.get(n, device), is_real]), sort_keys=True, default=str) for n in names}
        return cls(source.path, {name: hashlib.sha256(text.encode()).hexdigest() for name, text in texts.items()})

    @property
    def path(self) -> Path:
        return self.stated_in.with_name(f"{self.stated_in.name}.checked")

    def note(self, right: Iterable[str], others: Iterable[str], seen: Mapping[str, Any]) -> None:
        """Write down which joints were seen to turn as commanded, and which did not or cannot be told from another one.

        ``seen`` has ``adapter``, ``by`` (``tracker``) and ``at`` (unix s). An InputError where it cannot be written.
        """
        wrong = {self._key(joint): {"servo": _WRONG, **seen} for joint in others}
        good = {key: {"servo": self.digests[key], **seen} for key in map(self._key, right)}
        self._write({**self._entries(), **wrong, **good})

    def carry_over(self, after: WiringRecord) -> None:
        """What was checked stays so in a file whose numbers armcal itself has changed; see ``note``."""
        entries = self._entries()
        checked = [joint for joint in self.digests if self._state(entries, joint) == ""]
        if checked:
            self._write({**entries, **{j: {**entries[j], "servo": after.digests[j]} for j in checked}})

    def forget(self, joints: Iterable[str]) -> None:
        """Joints whose servos were changed by themselves are to be checked again; see ``note``."""
        entries, gone = self._entries(), {self._key(joint) for joint in joints}
        if gone & entries.keys():
            self._write({joint: entry for joint, entry in entries.items() if joint not in gone})

    def check(self, joints: Iterable[str], adapter: str = "") -> None:
        """Raise InputError unless all joints were seen to turn, as now stated, on this adapter (empty: not known)."""
        entries, unchecked = self._entries(), dict[str, list[str]]()
        for joint in joints:
            if why := self._state(entries, self._key(joint), adapter):
                unchecked.setdefault(why, []).append(joint)
        if not unchecked:
            return
        named = "; ".join(f"{', '.join(names)}: {why}" for why, names in unchecked.items())
        raise InputError(
            f"found servos that were not checked to move their joint ({named}); nothing was moved.",
            where=Location(str(self.stated_in)),
            hint="With exchanged plugs or ids the wrong joint moves: check them with armcal servo CONFIG --check, or "
            "give --unchecked to drive them without a check.",
        )

    def _key(self, joint: str) -> str:
        """With its arm's name (``arm.q1``) or without."""
        return joint if joint in self.digests else joint.rpartition(".")[2]

    def _state(self, entries: Mapping[str, Any], joint: str, adapter: str = "") -> str:
        """Why a joint is not checked; empty if it is."""
        entry, stated = entries.get(joint), self.digests.get(joint)
        if entry is None or stated is None:
            return "never checked"
        if entry.get("servo") != stated:
            is_wrong = entry.get("servo") == _WRONG
            return "the last check did not find it right" if is_wrong else "changed since it was checked"
        if adapter and adapter != (checked_on := str(entry.get("adapter", ""))):
            return f"checked on {f'the adapter {checked_on}' if checked_on else 'an adapter without an id'}"
        return ""

    def _entries(self) -> dict[str, Any]:
        """By joint; a record that is damaged says nothing, so that its joints are checked again."""
        try:
            content = json.loads(self.path.read_bytes())
        except (OSError, ValueError):
            return {}
        return {joint: e for joint, e in content.items() if isinstance(e, dict)} if isinstance(content, dict) else {}

    def _write(self, entries: Mapping[str, Any]) -> None:
        with writing(self.path, "Make the folder of that file writable, and check again."):
            write_whole(self.path, (json.dumps(entries, indent=2) + "\n").encode())


def wiring_of(source: ConfigSource, device: JointDevice) -> WiringRecord | None:
    """The record that a bench's device needs; None where its servos cannot be checked."""
    if (servos := servo_file_of(source)) is not None:
        return WiringRecord.of_servo_file(servos)
    return WiringRecord.of_config(source, device.joint_names) if isinstance(device, MeasuringDevice) else None


def servo_file_of(source: ConfigSource) -> Path | None:
    """The servo file of a bench's device; None where it has none."""
    stated = bench_section(source, "device").get("servos")
    return resolve_path(stated) if isinstance(stated, str) else None


def bench_section(source: ConfigSource, *parts: str) -> dict[str, Any]:
    """The bench of a configuration, or a part of it, as it is written; empty where there is none."""
    section: Any = source.data
    for part in ("bench", *parts):
        section = section.get(part) if isinstance(section, dict) else None
    return section if isinstance(section, dict) else {}
