"""A calibration's file made ready to answer: read, checked, built and tried, before anybody waits for it."""

from __future__ import annotations

import gc
import json
import tempfile
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from armcal.calibration.calibration import Calibration
from armcal.calibration.calibration_file import lost_calibration
from armcal.calibration.compensation.request import Options, Redundancy
from armcal.calibration.measured_point import Point
from armcal.errors import ArmcalError, ConfigError, InputError, Location
from armcal.functions.batch_function import EvaluatorChoice

from armcal_serve.answering import Answerer
from armcal_serve.protocol import CalibrationTag
from armcal_serve.served_arm import TEMPERATURE, TEMPERATURE_KEY, ServedArm

_TRIES = 20
_LONGEST_S = 1.0
"""Requests of each kind before the first real one: what is made when it is first needed is made then."""
_ORDINARY_C = 20.0


@dataclass(frozen=True)
class Order:
    """Which calibration to make ready.

    Attributes:
        shown: the file as it is called in messages.
        sequence: its number on this server.
        sha256: of its bytes.
        arm: the identity that its arm must have; empty: any.
        redundancy: which of many commands.
        within: a configuration whose plan has limits and clearance; empty: none.
        point: what forward and compensate are about: the tool's frame, or the target that was measured.
        evaluator: ``compiled`` where a compiler is found, or ``interpreted``.
        accept: whether one whose level is lost answers as any other; else the first is refused, and a later
            one, which says of those before it that they no longer hold either, answers with that error.
    """

    shown: str
    sequence: int
    sha256: str
    arm: str = ""
    redundancy: Redundancy = "nearest"
    within: str = ""
    point: Point = "tool"
    evaluator: EvaluatorChoice = "compiled"
    accept: bool = False


def loaded(order: Order, data: bytes) -> Answerer:
    """What answers by these bytes.

    Raises:
        ArmcalError: they are no calibration, one of another arm, or one that cannot be used.
    """
    calibration = _read(order, data)
    calibration_file = calibration.record
    identity = calibration_file.identity.get("arm", "")
    if order.arm and identity != order.arm:
        raise ConfigError(
            f"it is of another arm ({identity[:12]}, expected {order.arm[:12]}).",
            where=Location(order.shown),
            hint="Put a calibration of the same arm there, or start a server of its own for this one.",
        )
    kept = (calibration_file.recalibrated or {}).get("sequence")
    tag: CalibrationTag = {
        "sequence": order.sequence,
        "created": calibration_file.created,
        "sha256": order.sha256,
        "arm": identity,
        "recalibrated": kept if isinstance(kept, int) else None,
        "level": calibration_file.level,
    }
    answerer = Answerer(_arms(calibration, order), tag)
    _tried(answerer)
    gc.collect()
    gc.freeze()
    lost = calibration_file.level == "lost" and not order.accept
    return replace(answerer, fault=lost_calibration(calibration_file, order.shown)) if lost else answerer


def _read(order: Order, data: bytes) -> Calibration:
    with tempfile.TemporaryDirectory(prefix="armcal-serve-") as folder:
        path = Path(folder) / "calibration.yaml"
        path.write_bytes(data)
        with _shown_as(str(path), order.shown):
            return Calibration.load(path, accept=order.accept or order.sequence > 1)


@contextmanager
def _shown_as(path: str, shown: str) -> Iterator[None]:
    """Messages name the file that the user knows."""
    try:
        yield
    except ArmcalError as fault:
        where = fault.where and replace(fault.where, file=(fault.where.file or "").replace(path, shown) or None)
        fault.message, fault.hint = fault.message.replace(path, shown), fault.hint.replace(path, shown)
        raise type(fault)(fault.message, where=where, hint=fault.hint) from fault


def _arms(calibration: Calibration, order: Order) -> Mapping[str, ServedArm]:
    return {name: _arm(calibration, name, order) for name in calibration.system.arms}


def _arm(calibration: Calibration, name: str, order: Order) -> ServedArm:
    arm, statics = calibration.system.arms[name], calibration.system.statics
    joints = tuple(arm.commanded)
    unserved = [
        f"{condition.name} (effect {name}.{effect})"
        for effect, condition in arm.declared
        if condition.name != TEMPERATURE
    ]
    if unserved:
        raise ConfigError(
            f"the arm {name} changes with {', '.join(unserved)}, which a request cannot state.",
            where=Location(order.shown),
            hint="Use armcal predict or armcal compensate, which read it from a column.",
        )
    limits, allowed = _space(order.within, joints) if order.within else ({}, None)
    options = Options(limits=limits, redundancy=order.redundancy)
    try:
        # A request never waits for a compiler, so the compiler is waited for here.
        parts: dict[str, Any] = {"allowed": allowed, "choice": order.evaluator, "point": order.point}
        compensator, heated = calibration.compensator(name, options, **parts), None
        if TEMPERATURE in arm.conditions:
            heated = calibration.compensator(name, options, (TEMPERATURE,), **parts)
    except ValueError as fault:
        hint = "Correct the limits in the plan."
        raise ConfigError(f"{fault}.", where=Location(order.within or order.shown), hint=hint) from fault
    needs_payload = bool(arm.deflection_size) and statics.payload is None
    return ServedArm(name, dict(arm.commanded), compensator, needs_payload, heated, order.point)


def _space(within: str, joints: tuple[str, ...]) -> tuple[Mapping[str, tuple[float, float]], Any]:
    """Limits, and what asks whether the arm may be somewhere; what reads them is not needed without."""
    from armcal.plugins import discover
    from armcal.run.workspace import workspace_of

    space = workspace_of(Path(within), joints, discover())
    return space.limits, space.allowed


def _tried(answerer: Answerer) -> None:
    """Ask everything that can be asked, some times.

    Raises:
        InputError: an arm cannot even be predicted.
    """
    for arm in answerer.arms.values():
        _tried_with(answerer, arm, {})
        if arm.heated is not None:
            with suppress(InputError):  # what is ordinary elsewhere may be too hot for this arm
                _tried_with(answerer, arm, {TEMPERATURE_KEY: _ORDINARY_C})


def _tried_with(answerer: Answerer, arm: ServedArm, said: Mapping[str, float]) -> None:
    began = time.monotonic()
    for i in range(_TRIES):
        posture = {"joints": arm.written([0.05 * (k + 1) + 0.01 * i for k in range(len(arm.joints))], "rad")}
        content = _asked(answerer, arm, {"do": "forward", **posture, **said})
        if not content["ok"]:
            raise InputError(f"the arm {arm.name} cannot be predicted: {content['error']}", hint=content["hint"])
        tool = content["tools"][0]
        for target in (tool, {"position_mm": tool["position_mm"]}):
            for path in (False, True):
                _asked(answerer, arm, {"do": "compensate", "targets": target, "path": path, **said})
        _asked(answerer, arm, {"do": "compensate", "targets": tool, "start_joints": posture["joints"], **said})
        if time.monotonic() - began > _LONGEST_S:
            break


def _asked(answerer: Answerer, arm: ServedArm, request: Mapping[str, Any]) -> dict[str, Any]:
    line = json.dumps({**request, "arm": arm.name, "payload_g": 0})
    return dict(json.loads(answerer.answer(line.encode(), 0.0)))
