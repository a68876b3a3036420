"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_measurements(register: Register) -> None:
    """Announce the measurement."""
    register("tip_position", "armcal_tracker.position:TipPosition", "position of a target on the tool")


@hookimpl
def armcal_register_readers(register: Register) -> None:
    """Announce the reader."""
    register("csv", "armcal_tracker.csv_reader:CsvReader", "columns by name with their unit as suffix")
