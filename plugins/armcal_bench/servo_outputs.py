"""What a servo calibration leaves behind: the servo file, and its results."""

import errno
import json
import math
import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from armcal.arm.servo import PulseTable
from armcal.base.config_text import finite
from armcal.config.servo_file import BoardSettings, ServoFile, ServoSettings, load_servo_file, servo_file_text
from armcal.io.plain_files import write_whole, writing

from armcal_bench.servo_fit import FittedServo, Outcome
from armcal_bench.servo_setup import next_name

_FAR_CHANGE = 0.1
_SAG_WORTH = math.radians(0.1)


def is_usable(servo: FittedServo) -> bool:
    try:
        PulseTable(servo.angles, servo.pulses)
    except ValueError:
        return False
    return True


def findings(outcome: Outcome) -> list[str]:
    texts = [f"{joint}: the table is left as it was: {why}." for joint, why in outcome.silent.items()]
    for servo in outcome.servos.values():
        texts += list(_of_servo(servo, outcome))
    if outcome.zero == "kept":
        texts.append("zeros: each servo's pulse at 0 deg was kept; the angles were measured from one another.")
    return texts + _of_springs(outcome)


def _of_servo(servo: FittedServo, outcome: Outcome) -> Iterator[str]:
    joint = servo.known.joint
    if not is_usable(servo):
        yield (
            f"{joint}: the pulses found neither rise nor fall with the angle: the table is left as it was. "
            "Look at its linkage."
        )
        return
    before, after = (np.sign(pulses[-1] - pulses[0]) for pulses in (servo.known.table.pulses, servo.pulses))
    if before != after:
        yield (
            f"{joint}: the servo turns the other way than its table said, or the tracker's frame is left-handed: "
            "look which way it turns."
        )
    for angle, is_determined in zip(servo.angles, servo.determined, strict=True):
        beyond = max(servo.reach[0] - angle, angle - servo.reach[1])
        if not is_determined:
            yield f"{joint}: no measurement determines the pulse at {math.degrees(angle):g} deg; it is the stated one."
        elif beyond > math.radians(15):
            yield (
                f"{joint}: the pulse at {math.degrees(angle):g} deg is extrapolated linearly from "
                "the measured range, "
                f"{math.degrees(servo.reach[0]):.0f} to {math.degrees(servo.reach[1]):.0f} deg."
            )
    if before == after and _gain_change(servo) > _FAR_CHANGE:
        yield (
            f"{joint}: its pulses a degree differ from the stated ones by {100 * _gain_change(servo):.0f} %: is it the "
            "servo that was meant, and does the tracker follow this arm's tool?"
        )
    if servo.lag is None:
        yield f"{joint}: it was approached from one side only, so its backlash is not known."
    elif servo.lag < -3 * servo.lag_sd and servo.lag < -math.radians(0.05):
        over = -math.degrees(servo.lag)
        yield f"{joint}: it overshoots by {over:.2f} deg rather than lags: does it stand before it is measured?"
    if servo.scale > 3:
        yield (
            f"{joint}: the spread of the angles is {math.degrees(servo.scatter):.2f} deg, {servo.scale:.0f} times the "
            "stated one; the deviations are enlarged by that."
        )
    for outlier in servo.outliers:
        counts, angle = outlier
        yield f"{joint}: the angle at {counts} counts ({math.degrees(angle):.1f} deg) lies far off and was set aside."


def _gain_change(servo: FittedServo) -> float:
    angles = np.array(servo.angles)
    stated, fitted = np.diff(servo.known.pulses_at(angles)), np.diff(servo.pulses)
    return float(np.max(np.abs(fitted / stated - 1.0)))


def _of_springs(outcome: Outcome) -> list[str]:
    if all(servo.by == "somebody" for servo in outcome.servos.values()):
        return []
    if not any(outcome.sag_span.values()):
        return [
            "springs: the model has no deflection of the arm under its weight; the tables contain it. Give the springs "
            "their compliances, or bench.servo.sag: fitted."
        ]
    worst = max(outcome.sag_span, key=lambda joint: outcome.sag_span[joint])
    if outcome.sag_span[worst] < _SAG_WORTH:
        return []
    how = "found with the tables" if outcome.compliances or outcome.undetermined else "the model's"
    return [
        f"springs: over a sweep they turn the tool by up to {math.degrees(outcome.sag_span[worst]):.1f} deg ({worst}); "
        f"that is taken out by compliances that are {how}."
    ]


RESULTS = "servo.json"
_APART = math.radians(0.5)  # Knots that are nearer to the end of a shortened table add nothing


def improved(file: ServoFile, outcome: Outcome, adapter: str = "") -> ServoFile:
    """The servo file with the fitted tables, within pulse ranges; boards without an adapter get that of the record."""
    stated = {"id": adapter}
    boards = {name: board if board.id else board.model_copy(update=stated) for name, board in file.boards.items()}
    servos = dict(file.servos)
    for joint, servo in file.servos.items():
        fitted_servo = outcome.servos.get(joint)
        table = None if fitted_servo is None else _fitted_table(fitted_servo, servo, outcome, boards[servo.board])
        if table is not None:
            servos[joint] = servo.model_copy(update={"angles": table.angles, "pulses": table.pulses})
    return ServoFile(boards, servos)


def _fitted_table(
    fitted_servo: FittedServo, servo: ServoSettings, outcome: Outcome, board: BoardSettings
) -> PulseTable | None:
    if not is_usable(fitted_servo):
        return None
    # Counts stay what they are: the file's board may have another oscillator than that of the record.
    same = outcome.clocks[servo.board].oscillator_hz / board.oscillator_hz
    return _allowed_part(
        PulseTable(fitted_servo.angles, tuple(round(p * same, 9) for p in fitted_servo.pulses)), servo, board
    )


def _allowed_part(table: PulseTable, servo: ServoSettings, board: BoardSettings) -> PulseTable | None:
    allowed, longest = servo.pulse_range, board.clock.longest_pulse
    low, high = max(allowed[0], min(table.pulses)), min(allowed[1], longest, max(table.pulses))
    if (low, high) == (min(table.pulses), max(table.pulses)):
        return table
    if not low < high:
        return None
    ends = sorted((float(table.angle(pulse)), pulse) for pulse in (low, high))
    pairs = list(zip(table.angles, table.pulses, strict=True))
    inner = [(a, p) for a, p in pairs if low < p < high and ends[0][0] + _APART < a < ends[1][0] - _APART]
    return PulseTable(*map(tuple, zip(ends[0], *inner, ends[1], strict=True)))


def write_servo_file(path: Path, file: ServoFile) -> Path | None:
    """Put a servo file in place whole, and keep the one before, whose place is given; None if nothing changed.

    Of a part that stands on one line, as armcal writes it, only that line changes, up to its comment. Where a part
    stands otherwise, the whole file is written anew.
    """
    path = path.resolve()  # of a link, what it leads to
    with writing(path, "Make it writable and give the command again: nothing measured is lost."):
        before = path.read_bytes()
        if not path.stat().st_mode & 0o222:
            raise PermissionError(errno.EACCES, "it is read-only")
        stated = load_servo_file(path)
        if stated == file:
            return None
        kept = next_name(path)
        write_whole(kept, before)
        write_whole(path, _text_of(before.decode(), stated, file).encode())
    return kept


def _text_of(text: str, stated: ServoFile, file: ServoFile) -> str:
    was, now = servo_file_text(stated).splitlines(), servo_file_text(file).splitlines()
    for before, after in zip(was, now, strict=True):
        if before != after:
            name = re.escape(after.partition(": {")[0])
            places = list(re.finditer(rf"(?m)^{name}: \{{[^{{}}&*\n]*\}}(?=[ \t]*(#.*)?$)", text))
            if len(places) != 1:
                return servo_file_text(file)
            text = f"{text[: places[0].start()]}{after}{text[places[0].end() :]}"
    return text


def results(outcome: Outcome, changed: ServoFile) -> dict[str, Any]:
    return {
        "servos": {joint: _servo(servo, outcome, changed) for joint, servo in outcome.servos.items()},
        "compliances_rad_per_Nm": {name: {"value": v, "sd": sd} for name, (v, sd) in outcome.compliances.items()},
        "not_told": {"servos": dict(outcome.silent), "compliances": list(outcome.undetermined)},
        "findings": [*findings(outcome), *_narrowed(outcome, changed)],
    }


def _is_written(fitted_servo: FittedServo, outcome: Outcome, changed: ServoFile) -> bool:
    servo = changed.servos[fitted_servo.known.joint]
    return _fitted_table(fitted_servo, servo, outcome, changed.boards[servo.board]) is not None


def _narrowed(outcome: Outcome, changed: ServoFile) -> list[str]:
    sentences = []
    for joint, fitted_servo in outcome.servos.items():
        servo, stated = changed.servos[joint], fitted_servo.known.table.angles
        meant = min(stated[0], fitted_servo.angles[0]), max(stated[-1], fitted_servo.angles[-1])
        if not _is_written(fitted_servo, outcome, changed):
            if is_usable(fitted_servo):
                sentences.append(
                    f"{joint}: the table is left as it was: no pulse that was found is in the servo's pulse_range."
                )
        elif servo.angles[0] > meant[0] + _APART or servo.angles[-1] < meant[1] - _APART:
            low, high = (1e6 * pulse for pulse in servo.pulse_range)
            shortened = (fitted_servo.angles[0], fitted_servo.angles[-1]) != (servo.angles[0], servo.angles[-1])
            why = f"the servo's pulse_range is {low:g} to {high:g} us" if shortened else "bench.servo.knots ends there"
            sentences.append(
                f"{joint}: its table reaches from {math.degrees(servo.angles[0]):.1f} to "
                f"{math.degrees(servo.angles[-1]):.1f} deg, not from {math.degrees(meant[0]):.1f} to "
                f"{math.degrees(meant[1]):.1f} deg: {why}."
            )
    return sentences


def write_results(folder: Path, summary: Mapping[str, Any]) -> None:
    with writing(folder, "Give another --out."):
        write_whole(folder / RESULTS, (json.dumps(summary, indent=2, allow_nan=False) + "\n").encode())


def _servo(servo: FittedServo, outcome: Outcome, changed: ServoFile) -> dict[str, Any]:
    stated = servo.known.pulses_at(np.array(servo.angles))
    slopes = np.gradient(np.array(servo.pulses), np.array(servo.angles))  # by a knot's neighbours (s/rad)
    slopes[np.abs(slopes) <= 1e-9] = math.nan
    columns = (servo.angles, servo.pulses, servo.pulse_sds, servo.determined, stated.tolist(), slopes.tolist())
    return {
        "board": servo.known.board,
        "knots": [
            {
                "angle_deg": math.degrees(angle),
                "pulse_us": 1e6 * pulse,
                "sd_us": finite(1e6 * sd),
                "told": is_determined,
                "before_us": 1e6 * before,
                "change_us": 1e6 * (pulse - before),
                "change_deg": math.degrees((before - pulse) / slope),
            }
            for angle, pulse, sd, is_determined, before, slope in zip(*columns, strict=True)
        ],
        "backlash_deg": None if servo.lag is None else 2 * math.degrees(servo.lag),
        "backlash_sd_deg": finite(2 * math.degrees(servo.lag_sd)),
        "scatter_deg": math.degrees(servo.scatter),
        "observations": servo.used,
        "set_aside": len(servo.outliers),
        "seen_by": servo.by,
        "written": _is_written(servo, outcome, changed),
    }
