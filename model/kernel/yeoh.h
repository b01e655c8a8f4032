/* The Yeoh law, model/material/yeoh.py: W = C1 J + C2 J^2 + C3 J^3. */

static void yeoh_derivatives(const Law *law, int64_t n, const Real *log, Stress *out) {
    Real squares[3 * MOST_STATIONS], total[MOST_STATIONS], first[MOST_STATIONS], second[MOST_STATIONS];
    Real c1 = law->mu[0], c2 = law->mu[1], c3 = law->mu[2];
    invariant(n, log, squares, total);
    for (int64_t i = 0; i < n; i++) { /* vector */
        first[i] = c1 + total[i] * (2.0 * c2 + total[i] * (3.0 * c3));
        second[i] = 2.0 * c2 + total[i] * (6.0 * c3);
    }
    invariant_derivatives(n, squares, first, second, out);
}
