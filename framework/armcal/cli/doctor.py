"""``armcal doctor``. It imports as little as it can: it must speak where armcal's own libraries are broken."""

import json
import sys

import click

from armcal.doctor.child import Finding
from armcal.doctor.examination import examine, works
from armcal.errors import EXIT_BAD_INPUT
from armcal.version import JSON_SCHEMA

_MARKS = {"ok": "ok  ", "note": "-   ", "warning": "warn", "fault": "FAIL"}
_COLOURS = {"ok": "green", "note": None, "warning": "yellow", "fault": "red"}


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
@click.option("-q", "--quiet", is_flag=True, help="Say only what is broken.")
@click.option("-v", "--verbose", is_flag=True, help="Give a hint on what is merely not there, too.")
def doctor(as_json: bool, quiet: bool, verbose: bool) -> None:
    """Say what is installed, what works, what is missing and what that costs. Nothing is changed, no port is opened."""
    findings: list[Finding] = []
    for finding in examine():
        if not as_json:
            _show(finding, finding.section != (findings[-1].section if findings else ""), quiet, verbose)
        findings.append(finding)
    healthy = works(findings)
    if as_json:
        click.echo(json.dumps({**JSON_SCHEMA, "works": healthy, "findings": [f.as_dict() for f in findings]}, indent=2))
    elif not quiet:
        warnings = sum(finding.state == "warning" for finding in findings)
        text = "Everything works."
        if not healthy:
            text = "Arms cannot be calibrated here; mend what is marked FAIL."
        elif warnings:
            text = (
                f"Arms can be calibrated here. {warnings} of the rest {'is' if warnings == 1 else 'are'} marked warn."
            )
        click.echo(f"\n{text}")
    if not healthy:
        broken = ", ".join(f.subject for f in findings if f.state == "fault")
        click.echo(f"armcal: arms cannot be calibrated here, see: {broken}.", err=True)
        sys.exit(EXIT_BAD_INPUT)


def _show(finding: Finding, begins: bool, quiet: bool, verbose: bool) -> None:
    if quiet and finding.state not in ("warning", "fault"):
        return
    if begins and not quiet:
        click.secho(f"\n{finding.section}", bold=True)
    mark = click.style(_MARKS[finding.state], fg=_COLOURS[finding.state])
    click.echo(f"{mark} {finding.subject}: {finding.text}")
    if finding.hint and (verbose or finding.state != "note"):
        click.echo(f"     {finding.hint}")
