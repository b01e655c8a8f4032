/* Several states at once: the same operations on LANES numbers, one of each state.

   A source says Real where every state has a number of its own, and Mask where it has a yes or no; with LANES 1, as in
   membrane.c, they are double and int. Lanes never meet, and every operation rounds as it does alone, so that a state
   has the same digits in any lane, beside any others, and with any number of lanes. A loop marked "vector" becomes one
   where a state is alone too: a test reads what the compiler says of it. */
#ifndef DEA_LANES_H
#define DEA_LANES_H

#include <math.h>
#include <stdint.h>
#include <string.h>

#ifndef LANES
#define LANES 1
#endif

#if LANES == 1

typedef double Real;
typedef int Mask;
typedef int64_t Whole;
typedef uint64_t Bits;

static inline Real of(double x) { return x; }
static inline Real pick(Mask which, Real yes, Real no) { return which ? yes : no; }
static inline Mask is_not(Mask which) { return !which; }
static inline int any(Mask which) { return which; }
static inline Whole counted(Mask which, int64_t n) { return which ? n : 0; }
static inline Real abs_of(Real x) { return fabs(x); }
static inline Real sqrt_of(Real x) { return sqrt(x); }

#else

typedef double Real __attribute__((vector_size(8 * LANES)));
typedef int64_t Mask __attribute__((vector_size(8 * LANES))); /* every bit set, or none: what a comparison gives */
typedef int64_t Whole __attribute__((vector_size(8 * LANES)));
typedef uint64_t Bits __attribute__((vector_size(8 * LANES)));

static inline Real of(double x) { return x - (Real){0.0}; }
static inline Real pick(Mask which, Real yes, Real no) {
    return (Real)(((Mask)yes & which) | ((Mask)no & ~which));
}
static inline Mask is_not(Mask which) { return ~which; }
static inline int any(Mask which) {
    int64_t some = 0;
    for (int64_t k = 0; k < LANES; k++) some |= which[k];
    return some != 0;
}
static inline Whole counted(Mask which, int64_t n) { return which & n; }
static inline Real abs_of(Real x) { return (Real)((Bits)x & 0x7fffffffffffffffu); }
static inline Real sqrt_of(Real x) {
    for (int64_t k = 0; k < LANES; k++) x[k] = sqrt(x[k]);
    return x;
}

#endif

static inline Mask yes(void) { return of(0.0) == of(0.0); }
static inline Mask finite(Real x) { return abs_of(x) < (double)INFINITY; }
/* Not a number, in whichever place, is the largest and the smallest of all: nothing that was missed is lost. */
static inline Real larger(Real x, Real y) { return pick((x > y) | (x != x), x, y); }
static inline Real smaller(Real x, Real y) { return pick((x < y) | (x != x), x, y); }
static inline Real clipped(Real x, double most) { return smaller(larger(x, of(-most)), of(most)); }

#endif
