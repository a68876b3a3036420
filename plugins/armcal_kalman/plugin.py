"""Registration."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_online_estimators(register: Register) -> None:
    register("extended", "armcal_kalman.filters:ExtendedFilter", "iterated extended Kalman filter")
    register("unscented", "armcal_kalman.filters:UnscentedFilter", "unscented Kalman filter")
    register("window", "armcal_kalman.filters:WindowEstimator", "the last records solved together again and again")
