"""``armcal replay``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal, cast

import click
from armcal.base.config_text import finite
from armcal.cli.common import Console, overrides, speaking
from armcal.cli.console import say
from armcal.errors import EXIT_BAD_INPUT, EXIT_FAULT, InputError, Location
from armcal.io.journal.files import REAL_FILES, write_whole
from rich.table import Table

from armcal_online.running.replay import (
    WARM_UP,
    JournalReplayer,
    KeptJournal,
    ReplayVerifier,
    compared,
    journal_folder,
    kept_calibration,
    kept_in,
    kept_journal,
    kept_settings,
    replay,
)
from armcal_online.running.session import OURS
from armcal_online.tracking.recalibrator import Recalibrator
from armcal_online.tracking.settings import RecalibrateSettings, load_settings

_Evaluator = Literal["auto", "compiled", "interpreted"]
_EVALUATORS = ("auto", "compiled", "interpreted")


@click.command("replay")
@click.argument("journal", type=click.Path(path_type=Path))
@click.option("--until", type=click.IntRange(min=1), metavar="SEQUENCE", help="Stop after this entry.")
@click.option("--calibration", type=click.Path(path_type=Path), help="Write the calibration as it was then.")
@click.option("--evaluator", type=click.Choice(_EVALUATORS), help="Another evaluator than the journal's.")
@click.option("--config", type=click.Path(path_type=Path), help="What would these settings have done?")
@overrides
@speaking
def replay_command(
    console: Console,
    journal: Path,
    until: int | None,
    calibration: Path | None,
    evaluator: str | None,
    config: Path | None,
    overrides: tuple[str, ...],
) -> None:
    """Make every state of a recalibration again from JOURNAL, and compare each with what was noted of it.

    JOURNAL is the folder of a recalibration, or the journal in it; nothing is written there. With --config or --set,
    what other settings would have done is shown beside what was done, and --calibration writes theirs.
    """
    registry = console.registry()
    folder = journal_folder(journal)
    _check_out(calibration, folder)
    held = kept_journal(folder)
    held.check_until(until)
    header = held.first.header
    other_settings = kept_settings(header, overrides) if overrides else None
    if config is not None:
        other_settings = load_settings(config, overrides)
    with kept_in(folder):
        begun_from = kept_calibration(header, folder, registry)
        session = Recalibrator(begun_from, _evaluated(kept_settings(header), evaluator), registry)
    verifier = ReplayVerifier(session.evaluator)
    with console.progress() as progress:
        done = replay(held, session, verifier, until, progress)
        others: JournalReplayer | None = None
        if other_settings is not None:
            begun = Recalibrator(begun_from, _evaluated(other_settings, evaluator), registry)
            others = replay(held, begun, None, until, progress, "with other settings")
    chosen = others or done
    written = calibration if calibration and not done.difference else None
    if written:
        write_whole(REAL_FILES, written, chosen.session.calibration_text().encode())
    content = _content(held, done, verifier, others, written)
    console.result(content)
    _show(console, content, verifier)
    if written:
        console.line(f"the calibration after entry {chosen.last}: {written}")
    if held.cut is not None:
        console.warn(held.cut.sentence)
    context = click.get_current_context()
    if held.damage is not None:
        say(f"armcal: {held.damage}", err=True)
        context.exit(EXIT_BAD_INPUT)
    if done.difference is not None:
        context.exit(EXIT_FAULT)


def _evaluated(settings: RecalibrateSettings, evaluator: str | None) -> RecalibrateSettings:
    return settings.model_copy(update={"evaluator": cast(_Evaluator, evaluator)}) if evaluator else settings


def _check_out(out: Path | None, folder: Path) -> None:
    if out is None:
        return
    place = out.resolve()
    if place.parent == folder.resolve() or (place.parent == folder.resolve().parent and place.name in OURS):
        raise InputError(
            "it belongs to the recalibration.", where=Location(str(out)), hint="Give --calibration another place."
        )
    if place.is_dir() or not place.parent.is_dir():
        raise InputError("no file can be written there.", where=Location(str(out)), hint="Give a file in a folder.")


def _content(
    held: KeptJournal,
    done: JournalReplayer,
    verifier: ReplayVerifier,
    others: JournalReplayer | None,
    written: Path | None,
) -> dict[str, Any]:
    """Everything that terminal and other programs show."""
    difference = done.difference
    content: dict[str, Any] = {
        "journal": str(held.folder),
        "begun_from": held.first.header["path"],
        "entries": done.entries,
        "first": done.first,
        "last": done.last,
        "states": {"compared": verifier.states, "same_to_the_last_bit": verifier.equal},
        "evaluator": done.session.evaluator,
        "other_evaluator": list(verifier.others),
        "difference": {"after": difference.sequence, "sentence": difference.sentence} if difference else None,
        "damage": str(held.damage) if held.damage else None,
        "cut": held.cut.sentence if held.cut else None,
        "calibration": str(written) if written else None,
        **_outcome(done),
    }
    if others is not None:
        content["other_settings"] = {**_outcome(others), **compared(done, others)}
    return cast(dict[str, Any], finite(content))


def _outcome(done: JournalReplayer) -> dict[str, Any]:
    state = done.session.state
    return {
        "records": done.records,
        "counts": dict(state.counts),
        "level": state.health.level,
        "decisions": [event for event in done.decisions if event["event"] == "decision"],
    }


def _show(console: Console, content: Mapping[str, Any], verifier: ReplayVerifier) -> None:
    first, last, others = content["first"], content["last"], content["other_evaluator"]
    console.line(f"{content['journal']}: begun from {content['begun_from']}, replayed from entry {first} to {last}")
    same = f"another than the journal's: {others[0]}" if others else "as the journal was written"
    console.line(f"evaluator: {content['evaluator']['backend']}, {same}")
    for text in others[1:]:
        console.detail(f"  {text}")
    counts, difference = f"{content['entries']} entries, {verifier.states} states compared", content["difference"]
    if difference is not None:
        console.line(f"{counts}; after entry {difference['after']} they differ. {difference['sentence']}")
    elif verifier.equal == verifier.states:
        console.line(f"{counts}, all the same to the last bit")
    else:
        counts = f"{counts}, {verifier.equal} the same to the last bit"
        console.line(f"{counts}; all {verifier.decisions} decisions and levels are the same")
    if "other_settings" in content:
        console.out.print(_table(content, content["other_settings"]))
    else:
        texts = ", ".join(f"{count} {verdict}" for verdict, count in content["counts"].items())
        console.line(f"{content['records']} records, of these in the estimate: {texts}; level {content['level']}")


def _table(done: Mapping[str, Any], other: Mapping[str, Any]) -> Table:
    """Both courses."""
    table = Table(title="what was done, and what other settings would have done")
    for heading in ("", "done", "with other settings"):
        table.add_column(heading)
    sentences: dict[int, list[str]] = {}
    for place, course in enumerate((done, other)):
        for event in course["decisions"]:
            row = sentences.setdefault(event["sequence"], ["", ""])
            row[place] = f"{row[place]} {event['sentence']}".strip()
    for number, (one, two) in sorted(sentences.items()):
        table.add_row(f"entry {number}", one or "-", two or "-")
    table.add_section()
    for what in done["counts"]:
        table.add_row(what, *(str(course["counts"][what]) for course in (done, other)))
    table.add_row("level at the end", done["level"], other["level"])
    name = f"mean innovation of {other['innovations_compared']} records after the first {WARM_UP} that both accept"
    table.add_row(name, *("-" if size is None else f"{size:.3f} mm" for size in other["mean_innovation_mm"]))
    farthest = other["largest_difference"]
    table.add_row("largest difference of a parameter", "", f"{farthest['sd']:.3g} sd, {farthest['parameter']}")
    return table
