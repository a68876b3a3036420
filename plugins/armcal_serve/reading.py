"""From a line to a request, or to what is wrong with it."""

import difflib
import json
from pathlib import Path
from typing import Any, NoReturn

from armcal.config.validate import validate
from armcal.config.yaml_source import ConfigSource
from armcal.errors import DataError, InputError, Location

from armcal_serve.protocol import REQUESTS, VERSION, Request

_EXAMPLE = '{"id": 1, "do": "status"}'


def parsed(line: bytes) -> Any:
    """The JSON in a line.

    Raises:
        DataError: it is not JSON.
    """
    try:
        return json.loads(line.decode("utf-8-sig"), parse_constant=_not_finite)
    except UnicodeDecodeError as fault:
        message = f"the request holds the byte 0x{line[fault.start]:02x}, which is not UTF-8 text."
        raise DataError(message, hint="Send UTF-8.") from fault
    except RecursionError as fault:
        raise DataError("the request is nested too deeply.", hint=f"Send an object such as {_EXAMPLE}.") from fault
    except ValueError as fault:
        text = f"the request is not JSON ({_short(str(fault))})."
        raise DataError(text, hint=f"Send an object a line, such as {_EXAMPLE}.") from fault


def request_of(fields: Any) -> Request:
    """A request, checked.

    Raises:
        InputError: it is none; the message names the field.
    """
    words = ", ".join(REQUESTS)
    if not isinstance(fields, dict):
        short = _short(json.dumps(fields))
        raise DataError(f"found {short}, expected an object.", hint=f"Send an object such as {_EXAMPLE}.")
    word = fields.get("do")
    if not isinstance(word, str) or word not in REQUESTS:
        near = difflib.get_close_matches(word, REQUESTS, n=1) if isinstance(word, str) else []
        short = f"found {_short(json.dumps(word))}" if "do" in fields else "found nothing"
        hint = f"Did you mean {near[0]}?" if near else f"For example {_EXAMPLE}."
        raise DataError(f"{short}, expected one of {words}.", where=Location(field="do"), hint=hint)
    if fields.get("armcal_serve", VERSION) != VERSION:
        short = _short(json.dumps(fields["armcal_serve"]))
        where = Location(field="armcal_serve")
        raise DataError(f"found version {short}, expected {VERSION}.", where=where, hint="Leave it out, or say 1.")
    try:
        return REQUESTS[word].model_validate(fields)
    except ValueError:
        pass
    hint = "Send what docs/serve.md shows."
    try:  # the same check says what is wrong in the words of a configuration
        validate(REQUESTS[word], ConfigSource(fields, {(): Location()}, Path(), Path(), ()))
    except InputError:
        raise
    except Exception as fault:  # not even that is possible
        raise DataError(f"the request is refused ({type(fault).__name__}).", hint=hint) from fault
    raise DataError("the request is refused.", hint=hint)


def _not_finite(word: str) -> NoReturn:
    raise ValueError(f"{word} is no number")


def _short(text: str) -> str:
    return text if len(text) <= 80 else f"{text[:77]}..."
