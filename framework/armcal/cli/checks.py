"""``armcal checks``."""

import json
from dataclasses import asdict

import click

from armcal.cli.console import Screen, columned
from armcal.diagnose.checks import DATA_CHECKS, FIT_CHECKS, plugin_checks
from armcal.plugins import discover
from armcal.version import JSON_SCHEMA


@click.command()
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
@click.option("-q", "--quiet", is_flag=True, help="Names only.")
def checks(as_json: bool, quiet: bool) -> None:
    """List what each run asks of its data and of its fit, and how often that warns of sound ones."""
    registry = discover()
    stages = {
        "Of the data, before the fit": [*DATA_CHECKS, *plugin_checks(registry, before_fit=True)],
        "Of the fit": [*FIT_CHECKS, *plugin_checks(registry, before_fit=False)],
    }
    if as_json:
        before, after = stages.values()
        content = [{**asdict(own), "before_fit": own in before} for own in (*before, *after)]
        click.echo(json.dumps({**JSON_SCHEMA, "checks": content}, indent=2))
        return
    for title, part in stages.items():
        if quiet:
            click.echo("\n".join(own.name for own in part))
            continue
        table = columned(title, ("check", "what it asks", "false alarms", "page"), ("check", "what it asks", "page"))
        for own in part:
            table.add_row(own.name, own.question, own.rate, own.page)
        Screen(soft_wrap=False).print(table)
