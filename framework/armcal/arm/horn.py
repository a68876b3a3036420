"""The horn on the shaft of a hobby servo: a spline of some teeth, on which it may be put a whole tooth off."""

SPLINE_TEETH = 25
"""Of the usual spline."""
TOOTH_DEG = 360 / SPLINE_TEETH


def teeth_text(number: int, tooth_deg: float = TOOTH_DEG) -> str:
    """So many teeth, either way, in words: "2 teeth of its horn (14.4 deg each)"."""
    return f"{abs(number)} {'tooth' if abs(number) == 1 else 'teeth'} of its horn ({tooth_deg:.1f} deg each)"
