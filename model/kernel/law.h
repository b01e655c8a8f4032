/* Laws of elastomers, as model/material/law.py has them: an energy W(L1, L2) in the logarithms of the principal
   stretches in the film's plane, with L3 = -(L1 + L2).

   Points stand one after the other: `log` holds L1 of every point, then L2, then L3. Moduli are in units of the shear
   modulus, and so are stresses. */
#ifndef DEA_LAW_H
#define DEA_LAW_H

#include "elementary.h"

enum { MOST_PARAMETERS = 8 };   /* moduli, or shape parameters */
enum { MOST_STATIONS = 48 };    /* points that a law is asked for at once */

enum { OGDEN, NEO_HOOKE, MOONEY_RIVLIN, YEOH, GENT, LAWS }; /* LAWS of model/membrane/compiled.py, in this order */

typedef struct {
    int64_t kind, moduli, shapes;
    double mu[MOST_PARAMETERS];    /* moduli */
    double alpha[MOST_PARAMETERS]; /* shape parameters */
} Law;

/* True stresses dW/dL_i and tangents d2W/dL_i dL_j at points; of the film also its Maxwell stress. */
typedef struct {
    double t1[MOST_STATIONS], t2[MOST_STATIONS];
    double h11[MOST_STATIONS], h12[MOST_STATIONS], h22[MOST_STATIONS];
    double maxwell[MOST_STATIONS];
} Stress;

#include "ogden.h"

static void derivatives_of_law(const Law *law, int64_t n, const double *log, Stress *out) {
    ogden_derivatives(law, n, log, out);
}

/* `sum over points of rate1 d(dW/dL1) + rate2 d(dW/dL2)` by every modulus and every shape parameter. */
static void projected(const Law *law, int64_t n, const double *log, const double *rate1, const double *rate2,
                      double *by_mu, double *by_alpha) {
    ogden_projected(law, n, log, rate1, rate2, by_mu, by_alpha);
}

#endif
