/* The Mooney-Rivlin law, model/material/mooney_rivlin.py: W = C1 (I1 - 3) + C2 (I2 - 3). */

static void mooney_rivlin_derivatives(const Law *law, int64_t n, const Real *log, Stress *out) {
    Real stresses[3 * MOST_STATIONS], moduli[3 * MOST_STATIONS];
    Real c1 = 2.0 * law->mu[0], c2 = 2.0 * law->mu[1];
    for (int64_t i = 0; i < 3 * n; i++) { /* vector */
        Real square = expm1_of(2.0 * log[i]), inverse = expm1_of(-2.0 * log[i]);
        stresses[i] = c1 * square - c2 * inverse;
        moduli[i] = 2.0 * (c1 * (square + 1.0) + c2 * (inverse + 1.0));
    }
    for (int64_t i = 0; i < n; i++) { /* vector */
        out->t1[i] = stresses[i] - stresses[2 * n + i];
        out->t2[i] = stresses[n + i] - stresses[2 * n + i];
        out->h11[i] = moduli[i] + moduli[2 * n + i];
        out->h12[i] = moduli[2 * n + i];
        out->h22[i] = moduli[n + i] + moduli[2 * n + i];
    }
}
