/* The loop over records. N_RECORD, N_STATE, N_RESIDUAL and N_VALUES are defined by the generated file, and so are
   pass(c, record, state; next, residual) and linearise(c, record, state; next, residual, jacobian).
   Arrays are stored channel by channel: entry k of record i is at [k * stride + i]; n is a multiple of LANES. */
#define AT_LEAST_ONE(n) ((n) > 0 ? (n) : 1)

/* The largest change of any state; infinite if any is not a number, so that a broken record is never at rest. */
static double furthest(const V *a, const V *b) {
  double largest = 0;
  for (int k = 0; k < N_STATE; ++k)
    for (int i = 0; i < LANES; ++i) {
      double change = fabs(a[k][i] - b[k][i]);
      if (isnan(change)) return INFINITY;
      if (change > largest) largest = change;
    }
  return largest;
}

/* Fixed-point passes from the stored state until no lane moves more than the tolerance. Gives 0 when at rest. */
static int settle(const double *c, const V *record, V *state, V *residual, double tolerance, int most) {
  V next[AT_LEAST_ONE(N_STATE)];
  for (int turn = 0; turn < most; ++turn) {
    pass(c, record, state, next, residual);
    double moved = furthest(next, state);
    for (int k = 0; k < N_STATE; ++k) state[k] = next[k];
    if (moved <= tolerance) return 0;
    if (!(moved < 1e3)) return 1;
  }
  return 1;
}

/* Residuals in equilibrium. Gives the number of vectors of records that did not settle. */
long armcal_residuals(long n, long stride, const double *values, const double *record, double *state,
                      double *residual, long residual_stride, double tolerance, int most) {
  double c[PASS_HOISTED];
  long unsettled = 0;
  pass_hoist(values, c);
  for (long i = 0; i < n; i += LANES) {
    V u[AT_LEAST_ONE(N_RECORD)], d[AT_LEAST_ONE(N_STATE)], r[N_RESIDUAL];
    gather(u, record + i, stride, N_RECORD);
    gather(d, state + i, stride, N_STATE);
    unsettled += settle(c, u, d, r, tolerance, most);
    scatter(state + i, d, stride, N_STATE);
    scatter(residual + i, r, residual_stride, N_RESIDUAL);
  }
  return unsettled;
}

/* Residuals and Jacobian in equilibrium; linearise() carries what is left of the state's error to second order. */
long armcal_linearise(long n, long stride, const double *values, const double *record, double *state,
                      double *residual, long residual_stride, double *jacobian, long jacobian_stride,
                      double tolerance, int most) {
  double c[PASS_HOISTED], cl[LINEARISE_HOISTED];
  long unsettled = 0;
  pass_hoist(values, c);
  linearise_hoist(values, cl);
  for (long i = 0; i < n; i += LANES) {
    V u[AT_LEAST_ONE(N_RECORD)], d[AT_LEAST_ONE(N_STATE)], next[AT_LEAST_ONE(N_STATE)], r[N_RESIDUAL];
    V jac[AT_LEAST_ONE(N_RESIDUAL * N_VALUES)];
    gather(u, record + i, stride, N_RECORD);
    gather(d, state + i, stride, N_STATE);
    if (N_STATE) unsettled += settle(c, u, d, r, tolerance, most);
    linearise(cl, u, d, next, r, jac);
    scatter(state + i, next, stride, N_STATE);
    scatter(residual + i, r, residual_stride, N_RESIDUAL);
    scatter(jacobian + i, jac, jacobian_stride, N_RESIDUAL * N_VALUES);
  }
  return unsettled;
}
