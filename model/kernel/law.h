/* Laws of elastomers, as model/material/law.py has them: an energy W(L1, L2) in the logarithms of the principal
   stretches in the film's plane, with L3 = -(L1 + L2).

   Points stand one after the other: `log` holds L1 of every point, then L2, then L3. Moduli are in units of the shear
   modulus, and so are stresses. */
#ifndef DEA_LAW_H
#define DEA_LAW_H

#include "elementary.h"

enum {
    MOST_PARAMETERS = 8
}; /* moduli, or shape parameters */
enum {
    MOST_STATIONS = 72
}; /* points that a law is asked for at once */

enum {
    OGDEN,
    NEO_HOOKE,
    MOONEY_RIVLIN,
    YEOH,
    GENT,
    LAWS
}; /* LAWS of film.py, in this order */

/* Of a film: `record` in film.py. */
typedef struct {
    int64_t kind, moduli, shapes;
    double mu[MOST_PARAMETERS];    /* moduli */
    double alpha[MOST_PARAMETERS]; /* shape parameters */
} FilmLaw;

/* The same of every lane; a kind and so many parameters are common to all. */
typedef struct {
    int64_t kind, moduli, shapes;
    Real mu[MOST_PARAMETERS], alpha[MOST_PARAMETERS];
} Law;

/* True stresses dW/dL_i and tangents d2W/dL_i dL_j at points; of the film also its Maxwell stress. */
typedef struct {
    Real t1[MOST_STATIONS], t2[MOST_STATIONS];
    Real h11[MOST_STATIONS], h12[MOST_STATIONS], h22[MOST_STATIONS];
    Real maxwell[MOST_STATIONS];
} Stress;

#include "first_invariant.h"
#include "gent.h"
#include "mooney_rivlin.h"
#include "neo_hooke.h"
#include "ogden.h"
#include "yeoh.h"

/* How many moduli and shape parameters each law has; an Ogden series has as many of both as it has terms. */
static inline int is_law(const FilmLaw *law) {
    static const int64_t MODULI[LAWS] = {0, 1, 2, 3, 1}, SHAPES[LAWS] = {0, 0, 0, 0, 1};
    if (law->kind < 0 || law->kind >= LAWS) return 0;
    int64_t terms = law->kind == OGDEN ? law->moduli : 0;
    if (law->moduli < 1 || law->moduli > MOST_PARAMETERS) return 0;
    if (law->moduli != MODULI[law->kind] + terms || law->shapes != SHAPES[law->kind] + terms) return 0;
    for (int64_t k = 0; k < law->moduli; k++)
        if (!(fabs(law->mu[k]) < INFINITY)) return 0;
    for (int64_t k = 0; k < law->shapes; k++)
        if (!(fabs(law->alpha[k]) < INFINITY)) return 0;
    return 1;
}

static void derivatives_of_law(const Law *law, int64_t n, const Real *log, Stress *out) {
    switch (law->kind) {
    case NEO_HOOKE: neo_hooke_derivatives(law, n, log, out); break;
    case MOONEY_RIVLIN: mooney_rivlin_derivatives(law, n, log, out); break;
    case YEOH: yeoh_derivatives(law, n, log, out); break;
    case GENT: gent_derivatives(law, n, log, out); break;
    default: ogden_derivatives(law, n, log, out);
    }
}

/* `sum over points of rate1 d(dW/dL1) + rate2 d(dW/dL2)` by every modulus and every shape parameter. */
static void projected(const Law *law, int64_t n, const Real *log, const Real *rate1, const Real *rate2,
                      Real *by_mu, Real *by_alpha) {
    if (law->kind == OGDEN) {
        ogden_projected(law, n, log, rate1, rate2, by_mu, by_alpha);
        return;
    }
    for (int64_t k = 0; k < law->moduli; k++) {
        Law unit = *law; /* stresses are linear in the moduli */
        Stress of_unit;
        for (int64_t other = 0; other < law->moduli; other++) unit.mu[other] = of(other == k ? 1.0 : 0.0);
        derivatives_of_law(&unit, n, log, &of_unit);
        by_mu[k] = of(0.0);
        for (int64_t i = 0; i < n; i++) by_mu[k] += rate1[i] * of_unit.t1[i] + rate2[i] * of_unit.t2[i];
    }
    if (law->kind == GENT) by_alpha[0] = gent_by_limit(law, n, log, rate1, rate2);
}

#endif
