"""Waits for many descriptors in one thread, and calls their handlers."""

import selectors
from collections.abc import Callable
from typing import Any

Call = Callable[[], None]


class Poller:
    """A selector whose entries may be of no interest for a while.

    ``poll`` takes regular files too, which are always ready, as standard input may be one.
    """

    def __init__(self) -> None:
        self._selector = selectors.PollSelector()

    def watch(self, place: Any, read: Call | None = None, write: Call | None = None) -> None:
        """Call these when a descriptor can be read or written; with neither it is ignored.

        The handlers of a place are the same whenever it is watched. An ignored place is not registered at all: a peer
        that hung up would be reported for ever.
        """
        events = (selectors.EVENT_READ if read else 0) | (selectors.EVENT_WRITE if write else 0)
        registered = place in self._selector.get_map()
        if not events:
            if registered:
                self._selector.unregister(place)
        elif not registered:
            self._selector.register(place, events, (read, write))
        elif self._selector.get_key(place).events != events:
            self._selector.modify(place, events, (read, write))

    def step(self, longest_s: float) -> None:
        for key, events in self._selector.select(longest_s):
            read, write = key.data
            if self._selector.get_map().get(key.fd) is not key:
                continue  # an earlier handler dropped it, or changed it
            if events & selectors.EVENT_READ:
                read()
            if events & selectors.EVENT_WRITE and self._selector.get_map().get(key.fd) is key:
                write()
