/* Laws of the first invariant alone, model/material/first_invariant.py: W = f(J), J = l1^2 + l2^2 + l3^2 - 3. */

/* l_i^2 - 1 at points, (3, n), and J. */
static void invariant(int64_t n, const Real *log, Real *squares, Real *total) {
    for (int64_t i = 0; i < 3 * n; i++) squares[i] = expm1_of(2.0 * log[i]); /* vector */
    for (int64_t i = 0; i < n; i++) total[i] = squares[i] + squares[n + i] + squares[2 * n + i]; /* vector */
}

/* From df/dJ and d2f/dJ2. */
static void invariant_derivatives(int64_t n, const Real *squares, const Real *first, const Real *second,
                                  Stress *out) {
    for (int64_t i = 0; i < n; i++) { /* vector */
        Real x = squares[i], y = squares[n + i], z = squares[2 * n + i];
        Real by1 = 2.0 * (x - z), by2 = 2.0 * (y - z); /* dJ/dL_i */
        Real through = 4.0 * (z + 1.0);                /* d2J/dL1 dL2 */
        out->t1[i] = first[i] * by1;
        out->t2[i] = first[i] * by2;
        out->h11[i] = first[i] * (4.0 * (x + 1.0) + through) + second[i] * by1 * by1;
        out->h12[i] = first[i] * through + second[i] * by1 * by2;
        out->h22[i] = first[i] * (4.0 * (y + 1.0) + through) + second[i] * by2 * by2;
    }
}
