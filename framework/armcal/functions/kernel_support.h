/* Vector arithmetic for the generated kernels. GNU C vector extensions; no intrinsics. */
#include <math.h>
#include <stdint.h>
#include <string.h>

#define BOTH __attribute__((unused)) static inline
typedef double V __attribute__((vector_size(8 * LANES)));
typedef int64_t I __attribute__((vector_size(8 * LANES)));

BOTH V broadcast(double x) { return x - (V){0}; }
BOTH V load(const double *from) { V x; memcpy(&x, from, sizeof x); return x; }
BOTH void store(double *to, V x) { memcpy(to, &x, sizeof x); }
BOTH V choose(I mask, V a, V b) { return (V)((mask & (I)a) | (~mask & (I)b)); }

BOTH double s_sign_of(double x) { return x < 0 ? -1 : x > 0 ? 1 : x; }
BOTH double s_less(double a, double b) { return a < b; }
BOTH double s_less_equal(double a, double b) { return a <= b; }
BOTH double s_equal(double a, double b) { return a == b; }
BOTH double s_unequal(double a, double b) { return a != b; }
BOTH double s_negation(double a) { return !(a != 0); }
BOTH double s_both(double a, double b) { return (a != 0) && (b != 0); }
BOTH double s_either(double a, double b) { return (a != 0) || (b != 0); }
BOTH double s_if_else_zero(double a, double b) { return a != 0 ? b : 0; }
BOTH double s_fmin(double a, double b) { return fmin(a, b); }
BOTH double s_fmax(double a, double b) { return fmax(a, b); }
BOTH double s_fabs(double a) { return fabs(a); }
BOTH double s_sine(double x) { return sin(x); }
BOTH double s_cosine(double x) { return cos(x); }

#define LIBRARY1(name) \
  BOTH double s_##name(double x) { return name(x); } \
  BOTH V v_##name(V x) { for (int i = 0; i < LANES; ++i) x[i] = name(x[i]); return x; }
#define LIBRARY2(name) \
  BOTH double s_##name(double x, double y) { return name(x, y); } \
  BOTH V v_##name(V x, V y) { for (int i = 0; i < LANES; ++i) x[i] = name(x[i], y[i]); return x; }
LIBRARY1(sqrt) LIBRARY1(tan) LIBRARY1(asin) LIBRARY1(acos) LIBRARY1(atan) LIBRARY1(exp) LIBRARY1(log)
LIBRARY1(sinh) LIBRARY1(cosh) LIBRARY1(tanh) LIBRARY1(erf) LIBRARY1(floor) LIBRARY1(ceil)
LIBRARY2(atan2) LIBRARY2(pow) LIBRARY2(copysign)

/* What a branch is made of, without a branch: true is 1.0. */
#define MASKED(name, mask) BOTH V v_##name(V a, V b) { return (V)((mask) & (I)broadcast(1.0)); }
MASKED(less, a < b) MASKED(less_equal, a <= b) MASKED(equal, a == b) MASKED(unequal, a != b)
MASKED(both, (a != 0) & (b != 0)) MASKED(either, (a != 0) | (b != 0))
BOTH V v_negation(V a) { return (V)((a == 0) & (I)broadcast(1.0)); }
BOTH V v_if_else_zero(V a, V b) { return (V)((a != 0) & (I)b); }
BOTH V v_fmin(V a, V b) { return choose((a < b) | (b != b), a, b); }
BOTH V v_fmax(V a, V b) { return choose((a > b) | (b != b), a, b); }
BOTH V v_fabs(V a) { return (V)((I)a & INT64_MAX); }
BOTH V v_sign_of(V a) { return choose(a > 0, broadcast(1.0), choose(a < 0, broadcast(-1.0), a)); }

/* Sine and cosine together. The angle is reduced to within pi/4 of a multiple of pi/2 in three parts
   [Cody1980], then Taylor polynomials serve: within 2 units in the last place for |x| below 1e5, beyond
   any joint angle in radians; larger or non-finite angles go to the C library. */
BOTH void v_sincos(V x, V *sine, V *cosine) {
  const double shift = 0x1.8p52;
  V shifted = x * 0x1.45f306dc9c883p-1 + shift;
  I quadrant = (I)shifted;
  V turns = shifted - shift;
  V first = x - turns * 0x1.921fb54400000p+0;
  V second = turns * 0x1.0b4611a600000p-34;
  V r = first - second;
  V low = turns * 0x1.3198a2e037073p-69 - ((first - r) - second);
  V reduced = r - low;
  V z = reduced * reduced;
  V s = broadcast(0x1.952c77030ad4ap-49);
  s = s * z - 0x1.ae7f3e733b81fp-41;
  s = s * z + 0x1.6124613a86d09p-33;
  s = s * z - 0x1.ae64567f544e4p-26;
  s = s * z + 0x1.71de3a556c734p-19;
  s = s * z - 0x1.a01a01a01a01ap-13;
  s = s * z + 0x1.1111111111111p-7;
  s = s * z - 0x1.5555555555555p-3;
  s = reduced + reduced * z * s;
  V c = broadcast(0x1.ae7f3e733b81fp-45);
  c = c * z - 0x1.93974a8c07c9dp-37;
  c = c * z + 0x1.1eed8eff8d898p-29;
  c = c * z - 0x1.27e4fb7789f5cp-22;
  c = c * z + 0x1.a01a01a01a01ap-16;
  c = c * z - 0x1.6c16c16c16c17p-10;
  c = c * z + 0x1.5555555555555p-5;
  V half = 0.5 * z, w = 1.0 - half;
  c = w + (((1.0 - w) - half) + z * z * c);
  I swap = (quadrant & 1) != 0;
  I flip_sine = (quadrant & 2) << 62;
  I flip_cosine = ((quadrant + 1) & 2) << 62;
  *sine = (V)((I)choose(swap, c, s) ^ flip_sine);
  *cosine = (V)((I)choose(swap, s, c) ^ flip_cosine);
  /* Lane by lane, so that no record's numbers depend on its neighbours. */
  for (int i = 0; i < LANES; ++i)
    if (!(fabs(x[i]) < 1e5)) { (*sine)[i] = sin(x[i]); (*cosine)[i] = cos(x[i]); }
}

/* Channel by channel: entry k of a vector of records is at [k * stride]. */
BOTH void gather(V *to, const double *from, long stride, int count) {
  for (int k = 0; k < count; ++k) to[k] = load(from + k * stride);
}
BOTH void scatter(double *to, const V *from, long stride, int count) {
  for (int k = 0; k < count; ++k) store(to + k * stride, from[k]);
}
