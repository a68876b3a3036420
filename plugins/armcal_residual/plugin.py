"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_residuals(register: Register) -> None:
    register(
        "gaussian_process",
        "armcal_residual.gaussian_process:GaussianProcess",
        "a Gaussian process over the sines and cosines of the joints",
    )
