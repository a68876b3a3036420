"""The framed serial protocol between a host and a servo board: COBS, frames with a CRC, messages."""
