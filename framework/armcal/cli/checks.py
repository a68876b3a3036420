"""``armcal checks``."""

from dataclasses import asdict

import click

from armcal.cli.common import Console, speaking
from armcal.diagnose.checks import DATA_CHECKS, FIT_CHECKS, plugin_checks


@click.command()
@speaking
def checks(console: Console) -> None:
    """List what each run asks of its data and of its fit, and how often that warns of sound ones."""
    registry = console.registry()
    before = [*DATA_CHECKS, *plugin_checks(registry, before_fit=True)]
    after = [*FIT_CHECKS, *plugin_checks(registry, before_fit=False)]
    console.result({"checks": [{**asdict(own), "before_fit": own in before} for own in (*before, *after)]})
    for title, part in (("Of the data, before the fit", before), ("Of the fit", after)):
        rows = [(own.name, own.question, own.rate, own.page) for own in part]
        console.table(title, ("check", "what it asks", "false alarms", "page"), rows, left=("what it asks", "page"))
