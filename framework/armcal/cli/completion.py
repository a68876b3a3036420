"""Values of options, for a shell's completion."""

import click
from click.shell_completion import CompletionItem

from armcal.plugins import discover


def component_names(kind: str, ctx: click.Context, parameter: click.Parameter, incomplete: str) -> list[CompletionItem]:
    """The names that plugins offer, for ``shell_complete``."""
    offered = (c for c in discover().components if c.kind == kind and c.name.startswith(incomplete))
    return [CompletionItem(c.name, help=c.summary) for c in offered]
