"""What a bare word in a config means: the readings that surprise people are refused, each with its mend."""

import math
import re

Scalar = bool | int | float | str | None

_LONGEST_INTEGER = 300

_NULL = frozenset(("", "~", "null", "Null", "NULL"))
_TRUE = frozenset(w for base in ("yes", "true", "on") for w in (base, base.capitalize(), base.upper()))
_FALSE = frozenset(w for base in ("no", "false", "off") for w in (base, base.capitalize(), base.upper()))

_INTEGER = re.compile(r"[-+]?(0|[1-9][0-9]*)")
_HEX = re.compile(r"[-+]?0x[0-9a-fA-F]+")
_FLOAT = re.compile(r"[-+]?([0-9]+\.[0-9]*|\.[0-9]+)([eE][-+][0-9]+)?")
_LOOSE_EXPONENT = re.compile(r"([-+]?)([0-9]+\.?[0-9]*|\.[0-9]+)[eE]([-+]?)([0-9]+)")
_NOT_FINITE = re.compile(r"[-+]?\.(inf|Inf|INF|nan|NaN|NAN)")
_CLOCK = re.compile(r"[-+]?[0-9][0-9_]*(:[0-5]?[0-9])+(\.[0-9_]*)?")
_OCTAL = re.compile(r"[-+]?(0[0-9_]+|0o[0-7_]+|0b[01_]+|0x[0-9a-fA-F_]*_[0-9a-fA-F_]*)")
_UNDERSCORE = re.compile(r"[-+]?[0-9][0-9_]*\.?[0-9_]*([eE][-+]?[0-9_]+)?")


class ScalarError(ValueError):
    """A bare word that YAML would read as something surprising; ``hint`` is what to write instead."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


def read_plain(text: str) -> Scalar:
    """The value of an unquoted scalar.

    Null, booleans (yes, no, on and off too), decimal and 0x integers and decimal fractions are read as YAML
    1.1 does; everything else is text, dates included.

    Raises:
        ScalarError: a number in a spelling that YAML reads otherwise than it looks, or one not finite.
    """
    if text in _NULL:
        return None
    if text in _TRUE or text in _FALSE:
        return text in _TRUE
    if _INTEGER.fullmatch(text):
        if len(text) > _LONGEST_INTEGER:
            raise ScalarError(f"found a number of {len(text)} digits", "Quote it if it is text.")
        return int(text)
    if _HEX.fullmatch(text) and len(text) <= _LONGEST_INTEGER:
        return int(text, 16)
    if _FLOAT.fullmatch(text):
        if not math.isfinite(float(text)):
            raise ScalarError(f"{text} is too large to be a number", "Write a finite number.")
        return float(text)
    _refuse_surprises(text)
    return text


def needs_quotes(text: str) -> bool:
    """Whether a text is refused where it stands bare, as ``1e5`` is, which YAML itself takes for text and writes so."""
    try:
        read_plain(text)
    except ScalarError:
        return True
    return False


def _refuse_surprises(text: str) -> None:
    quoted = f'or "{text}" if it is text'
    if _NOT_FINITE.fullmatch(text):
        raise ScalarError(f"{text} is not a finite number", f"Write a finite number, leave the key out, {quoted}.")
    if match := _LOOSE_EXPONENT.fullmatch(text):
        sign, digits, exponent_sign, exponent = match.groups()
        digits = digits if "." in digits else f"{digits}.0"
        digits = f"0{digits}" if digits.startswith(".") else digits
        clear = f"{sign}{digits}e{exponent_sign or '+'}{exponent}"
        raise ScalarError(f"{text} is text to YAML, not a number", f"Write {clear}, {quoted}.")
    if _CLOCK.fullmatch(text):
        mend = f"Write a number with its unit, for example 90 s, {quoted}."
        raise ScalarError(f"YAML reads {text} in base 60", mend)
    if _OCTAL.fullmatch(text):
        digits = text.lstrip("+-0").replace("_", "")
        sign = "-" if text.startswith("-") else ""
        decimal = f"{sign}{digits}" if digits.isdecimal() else "a decimal number"
        mend = f"Write {decimal}, {quoted}."
        raise ScalarError(f"YAML reads {text} as an octal, binary or hexadecimal number", mend)
    if "_" in text and _UNDERSCORE.fullmatch(text):
        raise ScalarError(f"{text} is a number with underscores", f"Write {text.replace('_', '')}, {quoted}.")
