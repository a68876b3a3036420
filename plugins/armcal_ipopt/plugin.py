"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_estimators(register: Register) -> None:
    register("ipopt", "armcal_ipopt.estimator:IpoptEstimator", "interior point; bounds, priors; Gauss-Newton or exact")
