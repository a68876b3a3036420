"""``armcal plugins`` and ``armcal checks``: what is installed, and what each run asks."""

import json
import sys
from dataclasses import asdict
from typing import Any

import click

from armcal.cli.common import Console, speaking
from armcal.diagnose.checks import DATA_CHECKS, FIT_CHECKS, plugin_checks
from armcal.errors import EXIT_BAD_INPUT, PluginError
from armcal.plugins import discover
from armcal.version import JSON_SCHEMA


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def plugins() -> None:
    """List plugins, or check them."""


@plugins.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
@click.option("-q", "--quiet", is_flag=True, help="Names only.")
@click.option("-v", "--verbose", is_flag=True, help="Where each component is defined, too.")
def list_plugins(as_json: bool, quiet: bool, verbose: bool) -> None:
    """List every plugin and what it provides, without importing any of it."""
    registry = discover()
    if as_json:
        content = []
        for plugin in registry.plugins:
            own = {name: getattr(plugin, name) for name in ("name", "module", "distribution", "version")}
            offered = registry.announced_by(plugin)
            listed = [{key: getattr(c, key) for key in ("kind", "name", "target", "summary")} for c in offered]
            content.append({**own, "fault": plugin.fault or None, "components": listed})
        click.echo(json.dumps({**JSON_SCHEMA, "plugins": content}, indent=2))
    else:
        for plugin in registry.plugins:
            if quiet:
                click.echo(plugin.name)
                continue
            click.echo(f"{plugin.name}  ({plugin.distribution} {plugin.version}, {plugin.module})")
            if plugin.fault:
                click.echo(f"  does not load: {plugin.fault}")
            for component in registry.announced_by(plugin):
                place = f"  [{component.target}]" if verbose else ""
                click.echo(f"  {component.kind:<12} {component.name:<18} {component.summary}{place}")


@plugins.command("check")
@click.argument("name", required=False)
@speaking
def check_plugin(console: Console, name: str | None) -> None:
    """Check the plugin NAME, or all: imports, hooks, and the contract of each component.

    -v names every check, and why one did not run.
    """
    from armcal.testing.contract import check_plugin as checks_of

    registry = discover()
    names = list(dict.fromkeys(plugin.name for plugin in registry.plugins if name in (None, plugin.name)))
    if not names:
        known = ", ".join(p.name for p in registry.plugins)
        raise PluginError(f"no plugin is called {name!r}.", hint=f"Installed: {known}.")
    reports: list[dict[str, Any]] = []
    for text in names:
        chosen = tuple(plugin for plugin in registry.plugins if plugin.name == text)
        results = [result for plugin in chosen for result in checks_of(plugin, registry)]
        rows = [
            {"component": r.component, "check": r.check, "fault": r.fault or None, "not_run": r.not_run or None}
            for r in results
        ]
        wrong, idle = (sum(row[key] is not None for row in rows) for key in ("fault", "not_run"))
        counts = {"ran": len(rows) - idle, "failed": wrong, "not_run": idle}
        broken = "; ".join(plugin.fault for plugin in chosen if plugin.fault)
        reports.append({"plugin": text, "fault": broken or None, **counts, "checks": rows})
    console.result({"plugins": reports} if name is None else reports[0])
    if not (console.json or console.quiet):
        for report in reports:
            for row in report["checks"]:
                if console.verbose or row["fault"]:
                    mark, fault = ("FAIL", f": {row['fault']}") if row["fault"] else ("ok  ", "")
                    click.echo(f"{'--  ' if row['not_run'] else mark} {row['component']}: {row['check']}{fault}")
            left = f", {report['not_run']} not run" if report["not_run"] else ""
            why = f"{left} (-v says why)" if left and not console.verbose else left
            click.echo(f"{report['plugin']}: {report['ran'] - report['failed']} of {report['ran']} checks passed{why}.")
    failed = [report for report in reports if report["failed"]]
    for report in failed:
        click.echo(f"armcal: {report['plugin']}: {report['fault'] or 'it breaks the plugin contract'}", err=True)
    if failed:
        sys.exit(EXIT_BAD_INPUT)


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
