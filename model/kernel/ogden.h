/* Ogden's law, model/material/ogden.py:

       W = sum mu_n/al_n (l1^al_n + l2^al_n + l3^al_n - 3),    dW/dL_i = sum mu_n (l_i^al_n - l_3^al_n). */

static void ogden_derivatives(const Law *law, int64_t n, const Real *log, Stress *out) {
    Real m[3 * MOST_STATIONS]; /* sum mu (l^al - 1) */
    Real a[3 * MOST_STATIONS]; /* sum mu al l^al */
    Real twice_shear = of(0.0);
    for (int64_t k = 0; k < law->moduli; k++) twice_shear += law->mu[k] * law->alpha[k];
    for (int64_t i = 0; i < 3 * n; i++) { /* vector */
        m[i] = of(0.0);
        a[i] = twice_shear;
    }
    for (int64_t k = 0; k < law->moduli; k++) {
        Real mu = law->mu[k], alpha = law->alpha[k];
        for (int64_t i = 0; i < 3 * n; i++) { /* vector */
            Real term = mu * expm1_of(alpha * log[i]);
            m[i] += term;
            a[i] += alpha * term;
        }
    }
    for (int64_t i = 0; i < n; i++) { /* vector */
        out->t1[i] = m[i] - m[2 * n + i];
        out->t2[i] = m[n + i] - m[2 * n + i];
        out->h11[i] = a[i] + a[2 * n + i];
        out->h12[i] = a[2 * n + i];
        out->h22[i] = a[n + i] + a[2 * n + i];
    }
}

static void ogden_projected(const Law *law, int64_t n, const Real *log, const Real *rate1, const Real *rate2,
                            Real *by_mu, Real *by_alpha) {
    Real rates[3 * MOST_STATIONS], powers[3 * MOST_STATIONS];
    for (int64_t i = 0; i < n; i++) { /* vector */
        rates[i] = rate1[i];
        rates[n + i] = rate2[i];
        rates[2 * n + i] = -(rate1[i] + rate2[i]);
    }
    for (int64_t k = 0; k < law->moduli; k++) {
        Real alpha = law->alpha[k], of_mu = of(0.0), of_alpha = of(0.0);
        for (int64_t i = 0; i < 3 * n; i++) powers[i] = expm1_of(alpha * log[i]); /* vector */
        for (int64_t i = 0; i < 3 * n; i++) {
            of_mu += powers[i] * rates[i];
            of_alpha += (powers[i] + 1.0) * log[i] * rates[i];
        }
        by_mu[k] = of_mu;
        by_alpha[k] = law->mu[k] * of_alpha;
    }
}
