"""Registration; imports nothing heavy."""

from armcal.hooks import Register, hookimpl


@hookimpl
def armcal_register_estimators(register: Register) -> None:
    register("cvxpy", "armcal_cvxpy.estimator:CvxpyEstimator", "sequential convex steps; the same answer as ipopt")
