"""Datagrams on this machine: a request in each, and its answer in one to the sender."""

import contextlib
import socket
from functools import partial
from typing import Any

from armcal.errors import ArmcalError, DataError
from armcal.io.udp import LOOPBACK, bound
from typing_extensions import override

from armcal_serve.conversation import Conversation
from armcal_serve.dispatcher import Dispatcher
from armcal_serve.poller import Poller
from armcal_serve.protocol import as_bytes, id_of, refusal
from armcal_serve.transports.transport import Transport

_LONGEST = 65_507  # What a datagram can hold (bytes)
_MOST_OPEN = 256
_AT_ONCE = 32  # So many are taken before others have their turn


class Datagrams(Transport):
    """Serves a port of the loopback address; clients repeat requests that were lost or came when too many waited.

    Raises:
        InputError: the port cannot be opened.
    """

    ended = False

    def __init__(self, port: int, poller: Poller, dispatcher: Dispatcher) -> None:
        self._poller, self._dispatcher = poller, dispatcher
        self._senders: dict[Any, Conversation] = {}
        self._socket = bound(LOOPBACK, port)

    @property
    def port(self) -> int:
        """Its number; the system's choice where 0 was requested."""
        return int(self._socket.getsockname()[1])

    @property
    @override
    def name(self) -> str:
        return f"udp {LOOPBACK}:{self.port}"

    @property
    @override
    def clients(self) -> int:
        return len(self._senders)

    @property
    @override
    def finished(self) -> bool:
        return not any(sender.open for sender in self._senders.values())

    @override
    def open(self) -> None:
        self._poller.watch(self._socket, self._read)

    def poll(self) -> None:
        for sender, conversation in [*self._senders.items()]:
            if not conversation.open:
                del self._senders[sender]

    @override
    def stop_reading(self) -> None:
        self._poller.watch(self._socket)

    @override
    def close(self) -> None:
        self._poller.watch(self._socket)
        for conversation in self._senders.values():
            conversation.end()
        self._socket.close()

    def _read(self) -> None:
        for _ in range(_AT_ONCE):
            try:
                data, sender = self._socket.recvfrom(_LONGEST + 1)
            except OSError:
                return
            if sum(conversation.open for conversation in self._senders.values()) >= _MOST_OPEN:
                busy = ArmcalError(f"{_MOST_OPEN} requests are waiting.", hint="Ask again in a while.")
                self._send(sender, as_bytes(refusal(None, busy)))
                continue
            conversation = self._senders.get(sender)
            if conversation is None:
                conversation = self._senders[sender] = Conversation(partial(self._send, sender))
            self._dispatcher.ask(conversation, data)

    def _send(self, sender: Any, answer: bytes) -> None:
        if len(answer) > _LONGEST:
            hint = "Ask for fewer targets at a time, or by the socket."
            fault = DataError(f"the answer has more than {_LONGEST} bytes, which no datagram holds.", hint=hint)
            answer = as_bytes(refusal(id_of(answer), fault))
        with contextlib.suppress(OSError):
            self._socket.sendto(answer, socket.MSG_DONTWAIT, sender)
