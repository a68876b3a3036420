"""Registration."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_online_estimators(register: Register) -> None:
    register("extended", "armcal_kalman.filters:ExtendedFilter", "iterated extended Kalman filter")
