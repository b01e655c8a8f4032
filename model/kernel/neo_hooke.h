/* The neo-Hookean law, model/material/neo_hooke.py: W = mu/2 J. */

static void neo_hooke_derivatives(const Law *law, int64_t n, const Real *log, Stress *out) {
    Real squares[3 * MOST_STATIONS], total[MOST_STATIONS], first[MOST_STATIONS], second[MOST_STATIONS];
    invariant(n, log, squares, total);
    for (int64_t i = 0; i < n; i++) { /* vector */
        first[i] = 0.5 * law->mu[0];
        second[i] = of(0.0);
    }
    invariant_derivatives(n, squares, first, second, out);
}
