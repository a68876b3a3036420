import sys; sys.path[:0]=["/work/main/tests"]
import numpy as np, contact_oracle as co
from armcal.solve.joint_noise import with_joint_noise
from armcal.solve.nuisance import started
from armcal_ipopt.estimator import IpoptEstimator
from contact_oracle import *
data = touches(9, (6, 0), ("front/hole_0", "front/hole_1"), scatter=1e-3)
made = co.Bench({"left": co.the_arm(LEFT, "left", 1e-3)}, {"balls": ball(("left",), socket="mean", noise=1e-4)})
problem, records = made.problem(data)
problem = started(problem, records)
for what in ("joint", "weights", "plain"):
    r = records
    w = np.ones(len(data))
    if what == "joint": r = with_joint_noise(problem, records, problem.parameters.nominal())
    if what == "weights": w = np.where(np.arange(len(data))%2, 1.0, 0.25); r = problem.weighted(records, [w])
    s = IpoptEstimator(IpoptEstimator.Settings()).solve(problem, r, problem.parameters.nominal())
    v = co.by_name(problem.parameters, s.values)
    told = problem.told(s.values, r)[0]
    inside = np.array(data.extra["socket"])=="hole_0"
    m = (told[:,inside]*w[inside]).sum(1)/w[inside].sum()
    print(what, np.abs(m-[v[f"balls.front/hole_0.{a}"] for a in "xyz"]).max()/1e-4, "noises")
