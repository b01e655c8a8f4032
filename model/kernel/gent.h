/* The Gent law, model/material/gent.py: W = -mu Jm/2 ln(1 - J/Jm); no stress where J reaches Jm. */

static Real gent_inverse(Real share) { return pick(share < 1.0, 1.0 / (1.0 - share), of(NAN)); }

static void gent_derivatives(const Law *law, int64_t n, const Real *log, Stress *out) {
    Real squares[3 * MOST_STATIONS], total[MOST_STATIONS], first[MOST_STATIONS], second[MOST_STATIONS];
    invariant(n, log, squares, total);
    for (int64_t i = 0; i < n; i++) { /* vector */
        Real inverse = gent_inverse(total[i] / law->alpha[0]);
        first[i] = 0.5 * law->mu[0] * inverse;
        second[i] = first[i] * inverse / law->alpha[0];
    }
    invariant_derivatives(n, squares, first, second, out);
}

/* `sum of rate1 d(dW/dL1) + rate2 d(dW/dL2)` by Jm. */
static Real gent_by_limit(const Law *law, int64_t n, const Real *log, const Real *rate1, const Real *rate2) {
    Real squares[3 * MOST_STATIONS], total[MOST_STATIONS], sum = of(0.0);
    invariant(n, log, squares, total);
    for (int64_t i = 0; i < n; i++) {
        Real share = total[i] / law->alpha[0], inverse = gent_inverse(share);
        Real rise = rate1[i] * (squares[i] - squares[2 * n + i]) + rate2[i] * (squares[n + i] - squares[2 * n + i]);
        sum -= law->mu[0] * inverse * share / law->alpha[0] * (inverse * rise);
    }
    return sum;
}
