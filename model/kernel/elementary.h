/* exp, expm1, log and log1p, the same digits on every machine, and without branches, so that loops become vectors.

   An argument beyond what a double can answer gives infinity or NaN, as in the C library. Errors stay below 2.5 units
   in the last place (tests/model/membrane/test_compiled.py). */
#ifndef DEA_ELEMENTARY_H
#define DEA_ELEMENTARY_H

#include <math.h>
#include <stdint.h>
#include <string.h>

/* ln 2 as a number of 33 bits and the rest, so that small multiples of the first are exact. */
#define LN2_HIGH 0x1.62e42fefp-1
#define LN2_LOW 0x1.473de6af278edp-34
#define TO_INTEGER 0x1.8p52 /* added to a number below 2^51 it leaves the nearest integer in the last bits */

static inline double of_bits(uint64_t bits) {
    double value;
    memcpy(&value, &bits, sizeof value);
    return value;
}

static inline uint64_t to_bits(double value) {
    uint64_t bits;
    memcpy(&bits, &value, sizeof bits);
    return bits;
}

/* x = n ln 2 + r with |r| <= ln(2)/2: returns expm1(r) by its Taylor series, and 2^n. */
static inline double expm1_reduced(double x, double *scale) {
    x = x < -708.0 ? -708.0 : x;
    x = x > 709.0 ? 709.0 : x;
    double shifted = x * 1.44269504088896341 + TO_INTEGER;
    double n = shifted - TO_INTEGER;
    double r = (x - n * LN2_HIGH) - n * LN2_LOW;
    *scale = of_bits((to_bits(shifted) + 1023u) << 52);
    /* Even and odd powers apart: two short chains take half as long as one. */
    double z = r * r, odd = 1.0 / 6227020800.0, even = 1.0 / 479001600.0;
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

static inline double exp_of(double x) {
    double scale, part = expm1_reduced(x, &scale);
    double value = scale * part + scale;
    return x > 709.0 ? INFINITY : value;
}

static inline double expm1_of(double x) {
    double scale, part = expm1_reduced(x, &scale);
    double value = scale * part + (scale - 1.0);
    return x > 709.0 ? INFINITY : value;
}

/* ln(u) + rest, for 0 < u < infinity. u = 2^k (1 + f) with 1 + f between sqrt(1/2) and sqrt(2), and
   ln(1 + f) = 2 artanh(s), s = f/(2 + f). */
static inline double log_sum(double u, double rest) {
    const uint64_t root = 0x3fe6a09e667f3bcdu; /* sqrt(1/2) */
    uint64_t bits = to_bits(u) + (0x3ff0000000000000u - root);
    double k = of_bits((bits >> 52) | 0x4330000000000000u) - (0x1p52 + 1023.0);
    double f = of_bits((bits & 0x000fffffffffffffu) + root) - 1.0;
    double s = f / (2.0 + f), z = s * s, half = 0.5 * f * f;
    double zz = z * z, odd = 2.0 / 17.0, even = 2.0 / 19.0;
    odd = odd * zz + 2.0 / 13.0;
    even = even * zz + 2.0 / 15.0;
    odd = odd * zz + 2.0 / 9.0;
    even = even * zz + 2.0 / 11.0;
    odd = odd * zz + 2.0 / 5.0;
    even = even * zz + 2.0 / 7.0;
    double t = 2.0 / 3.0 + z * (odd + z * even);
    return k * LN2_HIGH - ((half - (s * (half + z * t) + (k * LN2_LOW + rest))) - f);
}

static inline double log_of(double x) {
    double value = log_sum(x, 0.0);
    return x >= 0x1p-1022 && x < INFINITY ? value : NAN;
}

/* What 1 + x loses is added as (x - (u - 1))/u. */
static inline double log1p_of(double x) {
    double u = 1.0 + x;
    double value = log_sum(u, (x - (u - 1.0)) / u);
    return x > -1.0 && x < INFINITY ? value : NAN;
}

#endif
