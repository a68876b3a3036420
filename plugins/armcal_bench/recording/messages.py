"""Messages of a recording: a kind, a sentence for people, and the same as numbers for programs."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from armcal_bench.recording.assessor import Assessment
from armcal_bench.recording.knowledge import Knowledge
from armcal_bench.recording.recording_log import Posture

_MOST_MISSING = 1


@dataclass(frozen=True)
class Message:
    """One event of a recording.

    Attributes:
        kind: ``captured``, ``refused``, ``undone``, ``named``, ``disagrees``, ``agrees_again``, ``known``, ``status``,
            ``warning``, ``silent``, ``heard``, ``finished``.
        sentence: for people.
        content: for programs; JSON.
    """

    kind: str
    sentence: str
    content: Mapping[str, Any] = field(default_factory=dict)


def captured(posture: Posture, assessment: Assessment) -> Message:
    """A posture is safe, and agrees or has nothing to be compared with."""
    where = f" in {posture.place}" if posture.place else ""
    offset, doubt = assessment.newest, assessment.doubts.get(posture.name)
    content: dict[str, Any] = {"posture": posture.as_dict(), "doubtful": doubt is not None}
    if offset is not None:
        content["offset"] = offset.__dict__
    if doubt is not None:
        sentence = f"posture {posture.name}{where} is kept, and in doubt."
    elif assessment.why_not:
        sentence = f"posture {posture.name}{where} is kept; it could not be judged: {assessment.why_not}"
    elif offset is None:
        sentence = f"posture {posture.name}{where} is kept; there is none yet to compare it with."
    else:
        sentence = f"posture {posture.name}{where} is kept and agrees: off by {offset}."
    return Message("captured", sentence, content)


def doubts_changed(before: Assessment, after: Assessment, postures: Sequence[Posture]) -> list[Message]:
    """Postures that disagree now and did not before, and the other way round."""
    messages, standing = [], {posture.name: posture for posture in postures}
    for name, offset in after.doubts.items():
        if name not in before.doubts:
            place = standing[name].place
            text = f"did it sit right in {place}, and is that its name?" if place else "was it held as the others were?"
            sentence = f"posture {name} disagrees by {offset}: {text}"
            if name == postures[-1].name:
                sentence += " u takes it back."
            messages.append(Message("disagrees", sentence, {"posture": name, "offset": offset.__dict__}))
    for name in before.doubts:
        if name in standing and name not in after.doubts and not after.why_not:
            messages.append(Message("agrees_again", f"posture {name} agrees after all.", {"posture": name}))
    return messages


def known(knowledge: Knowledge) -> Message:
    """How much is determined, and what would help."""
    sentence = f"{knowledge.rank} of {knowledge.free} free numbers are determined"
    if knowledge.missing:
        first = "; ".join(knowledge.missing[:_MOST_MISSING])
        more = len(knowledge.missing) - _MOST_MISSING
        sentence += f". Missing: {first}" + (f"; and {more} more, which s lists" if more > 0 else "")
    elif knowledge.rank < knowledge.free:
        sentence += f"; {knowledge.free - knowledge.rank} combinations are missing, which s lists"
    if knowledge.vary:
        *others, last = knowledge.vary
        joints = f"{', '.join(others)} and {last}" if others else last
        sentence += f". {joints} would add most: vary {'them' if others else 'it'} more"
    return Message("known", f"{sentence}.", knowledge.__dict__)
