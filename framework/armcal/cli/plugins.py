"""``armcal plugins``."""

from __future__ import annotations

import json
import sys
from typing import Any

import click

from armcal.errors import EXIT_BAD_INPUT, PluginError
from armcal.hooks import CONTRACT_VERSION
from armcal.plugins import PluginInfo, PluginRegistry, discover


@click.group(context_settings={"help_option_names": ["-h", "--help"]})
def plugins() -> None:
    """List plugins, or check one."""


@plugins.command("list")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
@click.option("-q", "--quiet", is_flag=True, help="Names only.")
@click.option("-v", "--verbose", is_flag=True, help="Where each component is defined, too.")
def list_plugins(as_json: bool, quiet: bool, verbose: bool) -> None:
    """List every plugin and what it provides, without importing any of it."""
    registry = discover()
    if as_json:
        click.echo(json.dumps(_content(registry), indent=2))
    else:
        for plugin in registry.plugins:
            _show(plugin, registry, quiet, verbose)


def _show(plugin: PluginInfo, registry: PluginRegistry, quiet: bool, verbose: bool) -> None:
    if quiet:
        click.echo(plugin.name)
        return
    click.echo(f"{plugin.name}  ({plugin.distribution} {plugin.version}, {plugin.module})")
    if plugin.fault:
        click.echo(f"  does not load: {plugin.fault}")
    for component in registry.announced_by(plugin):
        place = f"  [{component.target}]" if verbose else ""
        click.echo(f"  {component.kind:<12} {component.name:<18} {component.summary}{place}")


def _content(registry: PluginRegistry) -> dict[str, Any]:
    return {
        "contract": CONTRACT_VERSION,
        "plugins": [
            {
                "name": plugin.name,
                "module": plugin.module,
                "distribution": plugin.distribution,
                "version": plugin.version,
                "fault": plugin.fault or None,
                "components": [
                    {"kind": c.kind, "name": c.name, "target": c.target, "summary": c.summary}
                    for c in registry.announced_by(plugin)
                ],
            }
            for plugin in registry.plugins
        ],
    }


@plugins.command("check")
@click.argument("name")
@click.option("--json", "as_json", is_flag=True, help="Print the result as JSON on standard output.")
@click.option("-q", "--quiet", is_flag=True, help="Say nothing but errors.")
@click.option("-v", "--verbose", is_flag=True, help="Name every check.")
def check_plugin(name: str, as_json: bool, quiet: bool, verbose: bool) -> None:
    """Check the plugin NAME: its import, its hooks, and the contract of each component."""
    from armcal.testing.contract import check_plugin as checks_of

    registry = discover()
    chosen = [plugin for plugin in registry.plugins if plugin.name == name]
    if not chosen:
        known = ", ".join(p.name for p in registry.plugins)
        raise PluginError(f"no plugin is called {name!r}.", hint=f"Installed: {known}.")
    results = [result for plugin in chosen for result in checks_of(plugin, registry)]
    broken = "; ".join(plugin.fault for plugin in chosen if plugin.fault)
    failed = [result for result in results if result.fault]
    if as_json:
        rows = [{"component": r.component, "check": r.check, "fault": r.fault or None} for r in results]
        click.echo(json.dumps({"plugin": name, "fault": broken or None, "checks": rows}, indent=2))
    elif not quiet:
        for result in results:
            if verbose or result.fault:
                mark, fault = ("FAIL", f": {result.fault}") if result.fault else ("ok  ", "")
                click.echo(f"{mark} {result.component}: {result.check}{fault}")
        click.echo(f"{name}: {len(results) - len(failed)} of {len(results)} checks passed.")
    if failed:
        click.echo(f"armcal: {name}: {broken or 'it breaks the plugin contract'}", err=True)
        sys.exit(EXIT_BAD_INPUT)
