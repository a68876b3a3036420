"""Hands requests to the worker: a client at a time in turn, so that one who asks much does not hold up the others."""

from __future__ import annotations

import contextlib
import time
from collections import deque
from collections.abc import Callable, Iterable, Mapping
from typing import Any

from armcal.errors import ArmcalError, InputError

from armcal_serve.conversation import Conversation, Ticket
from armcal_serve.protocol import as_bytes
from armcal_serve.reading import parsed, request_of
from armcal_serve.worker_process import WorkerProcess

_MOST_TRIES = 2
_LONGEST_STATUS = 4096


class Dispatcher:
    """Takes requests from clients, and gives them to whichever worker answers now.

    Args:
        status: gives the answer to a request for the status; no worker is needed for that.

    Attributes:
        asked: requests so far.
    """

    def __init__(self, status: Callable[[], Mapping[str, Any]]) -> None:
        self.asked = 0
        self._status = status
        self._round: deque[Conversation] = deque()
        self._again: deque[Ticket] = deque()

    @property
    def waiting(self) -> int:
        """Requests that no worker has."""
        return len(self._again) + sum(len(conversation.waiting) for conversation in self._round)

    def ask(self, conversation: Conversation, line: bytes) -> Ticket:
        """A request from a client."""
        self.asked += 1
        ticket = conversation.ask(self.asked, line, time.monotonic())
        if len(line) <= _LONGEST_STATUS and b'"status"' in line:
            with contextlib.suppress(InputError):  # whatever else it is, a worker says what is wrong with it
                request = request_of(parsed(line))
                if request.do == "status":
                    ticket.answered(as_bytes({**self._status(), "id": request.id}))
                    return ticket
        if not conversation.waiting:
            self._round.append(conversation)
        conversation.waiting.append(ticket)
        return ticket

    def refuse(self, conversation: Conversation, fault: ArmcalError) -> None:
        """Answer with an error, in its order, what could not even be taken."""
        self.asked += 1
        conversation.ask(self.asked, b"", time.monotonic()).refused(fault)

    def dispatch(self, workers: Iterable[WorkerProcess]) -> None:
        """Give each worker that has nothing to do a request."""
        for worker in workers:
            if worker.given is None and not worker.gone:
                ticket = self._next()
                if ticket is None:
                    return
                worker.give(ticket)

    def requeue(self, ticket: Ticket, why: ArmcalError) -> None:
        """The request of a worker that was lost; it may have been the cause, and is given up after another loss."""
        ticket.tries += 1
        if ticket.tries < _MOST_TRIES:
            self._again.append(ticket)
        else:
            ticket.refused(why)

    def give_up(self, why: ArmcalError) -> None:
        """Answer all that waits with an error."""
        while (ticket := self._next()) is not None:
            ticket.refused(why)

    def _next(self) -> Ticket | None:
        while self._again:
            ticket = self._again.popleft()
            if not ticket.conversation.ended:
                return ticket
        while self._round:
            conversation = self._round.popleft()
            if not conversation.waiting:
                continue  # its client went away
            ticket = conversation.waiting.popleft()
            if conversation.waiting:
                self._round.append(conversation)
            return ticket
        return None
