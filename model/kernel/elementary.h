/* exp, expm1, log and log1p, the same digits on every machine, and without branches, so that loops become vectors.

   An argument beyond what a double can answer gives infinity or NaN, as in the C library. Errors stay below 2.5 units
   in the last place (tests/model/membrane/test_compiled.py). */
#ifndef DEA_ELEMENTARY_H
#define DEA_ELEMENTARY_H

#include "lanes.h"

/* ln 2 as a number of 33 bits and the rest, so that small multiples of the first are exact. */
#define LN2_HIGH 0x1.62e42fefp-1
#define LN2_LOW 0x1.473de6af278edp-34
#define TO_INTEGER 0x1.8p52 /* added to a number below 2^51 it leaves the nearest integer in the last bits */

static inline Real of_bits(Bits bits) {
    Real value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline Bits to_bits(Real value) {
    Bits bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

/* x = n ln 2 + r with |r| <= ln(2)/2: returns expm1(r) by its Taylor series, and 2^n. */
static inline Real expm1_reduced(Real x, Real *scale) {
    x = pick(x < -708.0, of(-708.0), x);
    x = pick(x > 709.0, of(709.0), x);
    Real shifted = x * 1.44269504088896341 + TO_INTEGER;
    Real n = shifted - TO_INTEGER;
    Real r = (x - n * LN2_HIGH) - n * LN2_LOW;
    *scale = of_bits((to_bits(shifted) + 1023u) << 52);
    /* Even and odd powers apart: two short chains take half as long as one. */
    Real z = r * r, odd = of(1.0 / 6227020800.0), even = of(1.0 / 479001600.0);
    odd = odd * z + 1.0 / 39916800.0;
    even = even * z + 1.0 / 3628800.0;
    odd = odd * z + 1.0 / 362880.0;
    even = even * z + 1.0 / 40320.0;
    odd = odd * z + 1.0 / 5040.0;
    even = even * z + 1.0 / 720.0;
    odd = odd * z + 1.0 / 120.0;
    even = even * z + 1.0 / 24.0;
    odd = odd * z + 1.0 / 6.0;
    even = even * z + 0.5;
    return r + z * (even + r * odd);
}

static inline Real exp_of(Real x) {
    Real scale, part = expm1_reduced(x, &scale);
    Real value = scale * part + scale;
    return pick(x > 709.0, of(INFINITY), value);
}

static inline Real expm1_of(Real x) {
    Real scale, part = expm1_reduced(x, &scale);
    Real value = scale * part + (scale - 1.0);
    return pick(x > 709.0, of(INFINITY), value);
}

/* ln(u) + rest, for 0 < u < infinity. u = 2^k (1 + f) with 1 + f between sqrt(1/2) and sqrt(2), and
   ln(1 + f) = 2 artanh(s), s = f/(2 + f). */
static inline Real log_sum(Real u, Real rest) {
    const uint64_t root = 0x3fe6a09e667f3bcdu; /* sqrt(1/2) */
    Bits bits = to_bits(u) + (0x3ff0000000000000u - root);
    Real k = of_bits((bits >> 52) | 0x4330000000000000u) - (0x1p52 + 1023.0);
    Real f = of_bits((bits & 0x000fffffffffffffu) + root) - 1.0;
    Real s = f / (2.0 + f), z = s * s, half = 0.5 * f * f;
    Real zz = z * z, odd = of(2.0 / 17.0), even = of(2.0 / 19.0);
    odd = odd * zz + 2.0 / 13.0;
    even = even * zz + 2.0 / 15.0;
    odd = odd * zz + 2.0 / 9.0;
    even = even * zz + 2.0 / 11.0;
    odd = odd * zz + 2.0 / 5.0;
    even = even * zz + 2.0 / 7.0;
    Real t = 2.0 / 3.0 + z * (odd + z * even);
    return k * LN2_HIGH - ((half - (s * (half + z * t) + (k * LN2_LOW + rest))) - f);
}

static inline Real log_of(Real x) {
    Real value = log_sum(x, of(0.0));
    return pick((x >= 0x1p-1022) & finite(x), value, of(NAN));
}

/* What 1 + x loses is added as (x - (u - 1))/u. */
static inline Real log1p_of(Real x) {
    Real u = 1.0 + x;
    Real value = log_sum(u, (x - (u - 1.0)) / u);
    return pick((x > -1.0) & finite(x), value, of(NAN));
}

#endif
