"""One client's requests and answers: answers go out in the order in which requests came."""

from collections import deque
from collections.abc import Callable

from armcal.errors import ArmcalError

from armcal_serve.protocol import as_bytes, id_of, refusal

MOST_WAITING = 64  # So many of a client's requests are taken before the first is answered


class Ticket:
    """A request on its way.

    Attributes:
        number: never used twice.
        line: the request.
        arrived: when it came (monotonic seconds).
        tries: how many workers were lost over it.
        answer: None before there is one.
    """

    def __init__(self, number: int, line: bytes, arrived: float, conversation: "Conversation") -> None:
        self.number = number
        self.line = line
        self.arrived = arrived
        self.conversation = conversation
        self.tries = 0
        self.answer: bytes | None = None

    def answered(self, answer: bytes) -> None:
        self.answer = answer
        self.conversation.flush()

    def refused(self, fault: ArmcalError) -> None:
        self.answered(as_bytes(refusal(id_of(self.line), fault)))


class Conversation:
    """The requests of one client that are not answered yet.

    Attributes:
        waiting: tickets that no worker has yet.
        ended: whether the client is gone.
    """

    def __init__(self, send: Callable[[bytes], None]) -> None:
        self.waiting: deque[Ticket] = deque()
        self.ended = False
        self._tickets: deque[Ticket] = deque()
        self._send = send

    @property
    def open(self) -> int:
        return len(self._tickets)

    def ask(self, number: int, line: bytes, arrived: float) -> Ticket:
        ticket = Ticket(number, line, arrived, self)
        self._tickets.append(ticket)
        return ticket

    def flush(self) -> None:
        while self._tickets and self._tickets[0].answer is not None:
            answer = self._tickets.popleft().answer
            if not self.ended and answer is not None:
                self._send(answer)

    def end(self) -> None:
        """Drop all requests: the client is gone."""
        self.ended = True
        self.waiting.clear()
        self._tickets.clear()
