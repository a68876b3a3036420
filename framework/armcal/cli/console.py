"""What a command shows on a screen: names are data."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from rich.console import Console, ConsoleOptions, RenderableType
from rich.segment import Segment

from armcal.base.shown import shown


class Screen(Console):
    """A console on which every text is data: no markup in strings, and no control characters from outside."""

    def __init__(self, **more: Any) -> None:
        super().__init__(highlight=False, markup=False, emoji=False, **more)

    def render(self, renderable: RenderableType, options: ConsoleOptions | None = None) -> Iterator[Segment]:
        """As rich does; texts without control characters, while rich's own control codes stay."""
        for segment in super().render(renderable, options):
            yield segment if segment.control else Segment(shown(segment.text), segment.style)

    def on_broken_pipe(self) -> None:
        """Nobody reads any longer: said to nobody, as ``Outlet`` has it."""
        self.quiet = True
