"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_readers(register: Register) -> None:
    """Announce the reader."""
    register("images", "armcal_camera.images_reader:ImagesReader", "images of boards, and where the arm stood for each")


@hookimpl
def armcal_register_commands(register: Register) -> None:
    """Announce the command."""
    register("board", "armcal_camera.board_command:board", "Write a board to print, and its settings.")
