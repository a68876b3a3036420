"""Bytes as they come, cut into lines."""

MAX_LINE_BYTES = 1024**2


class LineCutter:
    """Cuts bytes into lines; one that is too long is thrown away while it comes, so that memory stays flat."""

    def __init__(self, longest: int = MAX_LINE_BYTES) -> None:
        self._longest = longest
        self._open = bytearray()
        self._too_long = False

    @property
    def begun(self) -> bool:
        """Whether a line has begun whose end has not come."""
        return bool(self._open) or self._too_long

    def feed(self, data: bytes) -> list[bytes | None]:
        """The lines that are complete now, without their ends; None for one that was too long."""
        *ends, rest = data.split(b"\n")
        lines = []
        for piece in ends:
            self._add(piece)
            lines.append(self.rest())
        self._add(rest)
        return lines

    def rest(self) -> bytes | None:
        """What has come of the line that is open; it is closed by this."""
        line = None if self._too_long else bytes(self._open).removesuffix(b"\r")
        self._open.clear()
        self._too_long = False
        return line

    def _add(self, piece: bytes) -> None:
        if self._too_long or len(self._open) + len(piece) > self._longest:
            self._too_long = True
            self._open.clear()
        else:
            self._open += piece
