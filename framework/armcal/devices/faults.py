"""What goes wrong on a bench."""

from armcal.errors import ArmcalError, InputError


class DeviceError(ArmcalError):
    """A device does not answer as it must; what it was told last may or may not have arrived."""


class DeviceLostError(DeviceError):
    """A device is gone: unplugged, or silent for longer than its link waits. It may come back."""


class DeviceResetError(DeviceError):
    """A device has started anew since it was opened: what it was told before is forgotten."""


class DeviceUnwellError(DeviceError):
    """A device works, and must not go on for long: a servo is too hot, or blocked. Raised once; it can be parked."""


class DeviceRefusedError(InputError):
    """A device is not the one that was calibrated, is used by another program, or cannot do what is asked."""
