"""Hands requests to workers, a client at a time in turn, so that one with many requests does not delay the others."""

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
    """Queues requests of clients, and gives them to workers.

    Args:
        status: gives the answer to a request for the status; no worker is needed for that.

    Attributes:
        requests: requests so far.
    """

    def __init__(self, status: Callable[[], Mapping[str, Any]]) -> None:
        self.requests = 0
        self._status = status
        self._round: deque[Conversation] = deque()
        self._again: deque[Ticket] = deque()

    @property
    def waiting(self) -> int:
        return len(self._again) + sum(len(conversation.waiting) for conversation in self._round)

    def ask(self, conversation: Conversation, line: bytes) -> Ticket:
        """A request from a client."""
        self.requests += 1
        ticket = conversation.ask(self.requests, line, time.monotonic())
        if len(line) <= _LONGEST_STATUS and b'"status"' in line:
            with contextlib.suppress(InputError):  # a worker answers what is wrong with it
                request = request_of(parsed(line))
                if request.do == "status":
                    ticket.answered(as_bytes({**self._status(), "id": request.id}))
                    return ticket
        if not conversation.waiting:
            self._round.append(conversation)
        conversation.waiting.append(ticket)
        return ticket

    def refuse(self, conversation: Conversation, fault: ArmcalError) -> None:
        """Answer a request that cannot be queued with an error, in its order."""
        self.requests += 1
        conversation.ask(self.requests, b"", time.monotonic()).refused(fault)

    def dispatch(self, workers: Iterable[WorkerProcess]) -> None:
        for worker in workers:
            if worker.ticket is None and not worker.gone:
                ticket = self._next()
                if ticket is None:
                    return
                worker.give(ticket)

    def requeue(self, ticket: Ticket, why: ArmcalError) -> None:
        """Repeat the request of a lost worker; it may be the cause, and is refused after a second loss."""
        ticket.tries += 1
        if ticket.tries < _MOST_TRIES:
            self._again.append(ticket)
        else:
            ticket.refused(why)

    def give_up(self, why: ArmcalError) -> None:
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
