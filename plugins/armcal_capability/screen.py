"""The tables of pages on a terminal."""

from armcal.cli.common import Console
from rich.box import SIMPLE_HEAD
from rich.table import Table as ScreenTable

from armcal_capability.capability_page import Table


def show_table(console: Console, table: Table) -> None:
    """One table; numbers stand to the right."""
    shown = ScreenTable(title=table.caption, title_justify="left", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    for words, number in table.headings:
        shown.add_column(words, justify="right" if number else "left")
    for row in table.rows:
        shown.add_row(*row)
    console.out.print(shown)
