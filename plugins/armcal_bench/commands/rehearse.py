"""``armcal rehearse``: the commands of a bench against a simulated one."""

import json
import math
import sys
from pathlib import Path
from typing import Any

import click
from armcal.cli.common import Console
from armcal.devices.simulated import ACCOUNT, LOG
from armcal.errors import EXIT_DONE, EXIT_INCOMPLETE, InputError
from armcal.io.journal import has_journal

from armcal_bench.acquisition.preparation import prepare
from armcal_bench.acquisition.run_log import BENCH
from armcal_bench.commands.acquire import driven, exit_code_of, schedule_forecast, show_forecast, show_outcome
from armcal_bench.commands.common import FILE, always, load, on_bench
from armcal_bench.commands.servo import servo

_ANGLE = 180 / math.pi
_UNITS = {
    **dict.fromkeys(("limits", "first_pulse", "drop"), (_ANGLE, "deg")),
    "speed": (_ANGLE, "deg/s"),
    "clearance": (1e3, "mm"),
    "pulse": (1e6, "us"),
    "heat": (1e2, "% of the servo's limit"),
    "energised_together": (1.0, "s apart"),
}
"""Of the bench's own account: what its numbers are multiplied by, and the unit that they then have."""


@click.command()
@click.option("--plan", type=FILE, help="Rehearse armcal acquire: the poses to measure, as armcal plan writes them.")
@click.option("--servo", "how", type=click.Choice(["tracked", "guided", "check"]), help="Rehearse armcal servo.")
@click.option("--out", required=True, type=FILE, help="The folder to keep data, journal and the simulated bench in.")
@click.option("--resume", is_flag=True, help="Go on with the measuring run in that folder.")
@on_bench
def rehearse(
    console: Console,
    config: Path,
    plan: Path | None,
    how: str | None,
    out: Path,
    resume: bool,
    overrides: tuple[str, ...],
) -> None:
    """Do what armcal acquire or armcal servo does, on the simulated bench of CONFIG; report the loads on its arm.

    The servo file stays as it is.
    """
    if (plan is None) == (how is None):
        hint = "Give one of them: a measuring run is rehearsed, or a calibration of servos."
        raise InputError(f"found {'neither' if plan is None else 'both'} of --plan and --servo.", hint=hint)
    bench = out / BENCH
    if not (resume or has_journal(out)):
        for name in (ACCOUNT, LOG):
            (bench / name).unlink(missing_ok=True)
    simulated = (*overrides, f"bench.simulated={bench.absolute()}")
    if plan is not None:
        code = _measured(console, config, plan, out, simulated, resume=resume)
    else:
        code = _servos(console, config, out, simulated, str(how))
    account = _account(bench)
    if account:
        _show(console, account)
    sys.exit(EXIT_INCOMPLETE if code == EXIT_DONE and any(account.get("offences", {}).values()) else code)


def _measured(
    console: Console, config: Path, plan: Path, out: Path, overrides: tuple[str, ...], *, resume: bool
) -> int:
    """A measuring run; its exit code."""
    prepared = prepare(load(console, config, overrides), plan)
    for text in prepared.warnings:
        console.danger(text)
    if not console.json:
        show_forecast(console, prepared, schedule_forecast(prepared))
    outcome = driven(console, prepared, plan, (out, "resume" if resume else "anew"), always, unchecked=True)
    outcome.summary["truth"] = _account(out / BENCH)
    show_outcome(console, outcome, config, out)
    return exit_code_of(outcome)


def _servos(console: Console, config: Path, out: Path, overrides: tuple[str, ...], how: str) -> int:
    """A calibration of servos, or their check; its exit code."""
    given: dict[str, Any] = {"config": config, "overrides": overrides, "may_energise": always, "keep": True}
    given |= {"as_json": console.json, "quiet": console.quiet, "verbose": console.verbose}
    given |= {"check": True} if how == "check" else {"out": out, "guided": how == "guided"}
    try:
        click.get_current_context().invoke(servo, **given)
    except SystemExit as ending:
        return int(ending.code or EXIT_DONE)
    return EXIT_DONE


def _account(bench: Path) -> dict[str, Any]:
    """What the simulated bench wrote of its arm; empty where nothing happened there."""
    try:
        account: dict[str, Any] = json.loads((bench / ACCOUNT).read_bytes())
    except FileNotFoundError:
        return {}
    return account


def _show(console: Console, account: dict[str, Any]) -> None:
    """What the simulated arm had to bear: how often, and the worst of each kind."""
    offences, worst = account.get("offences", {}), account.get("worst", {})
    counted = []
    for kind, count in offences.items():
        if count:
            factor, unit = _UNITS.get(kind, (1.0, ""))
            limit = f"{factor * worst[kind]['limit']:.1f} {unit}" if kind in worst else ""
            worst_text = f" (worst: {_amount(kind, worst[kind])}, where {limit} is the limit)" if limit else ""
            counted.append(f"{kind} {count} times{worst_text}")
    console.line(f"on the simulated arm's side, unsafe was: {'; '.join(counted) or 'nothing'}.")
    for kind, what in (("first_pulse", "the largest jump at a first pulse"), ("drop", "the deepest fall when let go")):
        if kind in worst:
            console.line(f"{what}: {_amount(kind, worst[kind])}.")


def _amount(kind: str, entry: dict[str, Any]) -> str:
    factor, unit = _UNITS.get(kind, (1.0, ""))
    return f"{entry['joint'] or 'the arm'} {factor * entry['value']:.1f} {unit}".rstrip()
