/* What a solved state says: model/membrane/output.py, for one taut state. */
#ifndef DEA_OUTPUT_H
#define DEA_OUTPUT_H

#include "refinement.h"

enum { FINE = 33, POLISH = 3 };
#define FAR 1.2
#define HOOP 0.7

typedef struct {
    double log_area, radius; /* largest ln(l1 l2), and R/b where it stands */
    double hoop, meridional; /* smallest stresses */
    double log_stretch;
    double softening; /* largest share of the stiffness that the voltage takes away */
} Extremes;

/* The state at disk and ring. */
typedef struct {
    double log1[2], t1[2], t2[2];
} Edges;

static void stress_at(Problem *problem, double log1, double log2, Stress *out) {
    double log[3] = {log1, log2, -(log1 + log2)};
    stress(problem, 1, log, out);
}

/* Nominal stress at a clamped edge from the horizontal reaction there, which the energy's derivative with respect to
   the edge's radius tells: a test function is 1 at that edge and 0 at the other. */
static double pull_at(const Grid *grid, const Points *at, const double *test, double lam, double inner) {
    int64_t n = grid->table->points;
    double both = 0.0, slope = 0.0;
    for (int64_t i = 0; i < n; i++) {
        double on_q = grid->twice[i] * (at->law.t1[i] * at->along[i]);
        both += test[i] * (grid->twice[i] * (at->law.t2[i] * at->around[i]) + on_q);
        slope += test[n + i] * on_q;
    }
    double across = both + slope * grid->dxi, down = lam * inner;
    return sqrt(across * across + down * down) / (inner * inner);
}

static void edges(Problem *problem, const Grid *grid, const Points *at, double lam, Edges *out) {
    int64_t n = grid->table->points;
    double lnlp = problem->log_prestretch, pull[2], start[2], log[6];
    Stress now;
    for (int64_t end = 0; end < 2; end++) {
        double inner = end == 0 ? exp_of(-problem->span) : 1.0;
        pull[end] = pull_at(grid, at, grid->table->edge_tests + 2 * n * end, lam, inner);
        out->log1[end] = start[end] = dot(n, grid->table->ends + n * end, at->log);
    }
    for (int64_t k = 0; k < 4; k++) {
        for (int64_t end = 0; end < 2; end++) {
            if (k == 3 && !(fabs(out->log1[end] - start[end]) < 0.1 + 0.5 * fabs(start[end] - lnlp)))
                out->log1[end] = start[end];
            log[end] = out->log1[end];
            log[2 + end] = lnlp;
            log[4 + end] = -(out->log1[end] + lnlp);
        }
        stress(problem, 2, log, &now);
        for (int64_t end = 0; end < 2 && k < 3; end++) {
            double shrink = exp_of(lnlp - out->log1[end]);
            out->log1[end] += (pull[end] - now.t1[end] * shrink) / ((now.h11[end] - now.t1[end]) * shrink);
        }
    }
    memcpy(out->t1, now.t1, sizeof out->t1);
    memcpy(out->t2, now.t2, sizeof out->t2);
}

/* Value and two derivatives of the Legendre series with n coefficients. */
static void series(int64_t n, const double *c, double xi, double *value, double *slope, double *curve) {
    double before = 1.0, now = xi, before1 = 0.0, now1 = 1.0, before2 = 0.0, now2 = 0.0;
    *value = c[0] + c[1] * xi;
    *slope = c[1];
    *curve = 0.0;
    for (int64_t i = 2; i < n; i++) {
        double k = 2.0 * (double)i - 1.0, older = before, older1 = before1, older2 = before2;
        before = now;
        before1 = now1;
        before2 = now2;
        now2 = older2 + k * before1;
        now1 = older1 + k * before;
        now = (k * xi * before - ((double)i - 1.0) * older) / (double)i;
        *value += c[i] * now;
        *slope += c[i] * now1;
        *curve += c[i] * now2;
    }
}

/* Largest value of the polynomial through the points, and its xi. */
static double peak(const Table *table, const double *values, double *xi) {
    int64_t n = table->points, top = 0;
    double fine[FINE], c[MOST_POINTS], value, slope, curve, step = 0.0;
    for (int64_t k = 0; k < FINE; k++) fine[k] = 0.0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < FINE; k++) fine[k] += values[i] * table->fine[i * FINE + k];
    for (int64_t k = 1; k < FINE; k++)
        if (fine[k] > fine[top]) top = k;
    for (int64_t k = 0; k < n; k++) c[k] = 0.0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < n; k++) c[k] += values[i] * table->legendre[i * n + k];
    double low = table->fine_xi[top > 0 ? top - 1 : 0], high = table->fine_xi[top < FINE - 1 ? top + 1 : FINE - 1];
    *xi = table->fine_xi[top];
    for (int64_t k = 0; k < POLISH; k++) {
        series(n, c, *xi, &value, &slope, &curve);
        double aim = curve < 0.0 ? *xi - slope / curve : *xi;
        step = smaller(larger(aim, low), high) - *xi;
        *xi += step;
    }
    return value + step * (slope + 0.5 * curve * step); /* the last step is so short that its cube is nothing */
}

/* Largest value over the film, from those at the points and at both edges, and R/b where it stands. */
static double largest(const Problem *problem, const Grid *grid, const double *values, double disk, double ring,
                      double *radius) {
    double best = larger(disk, ring), inside = values[0], xi;
    *radius = disk >= ring ? exp_of(-problem->span) : 1.0;
    for (int64_t i = 1; i < grid->table->points; i++) inside = larger(inside, values[i]);
    if (!(inside > best)) return best;
    double top = peak(grid->table, values, &xi);
    if (!(top > best)) return best;
    *radius = exp_of(0.5 * problem->span * (xi - 1.0));
    return top;
}

/* Largest share of a stiffness that the voltage takes on the way from the pre-stretched film to its widest point. */
static double softened(Problem *problem, const Grid *grid, const Points *at, const Edges *edge) {
    static const double WAY[4] = {0.5, 1.0, 0.25, 0.75}; /* the last two where the way is far */
    int64_t n = grid->table->points;
    double start = problem->log_prestretch, far1 = at->log[0] - start, far2 = at->log[n] - start, most = 0.0;
    for (int64_t i = 1; i < n + 2; i++) {
        double log1 = i < n ? at->log[i] : edge->log1[i - n], log2 = i < n ? at->log[n + i] : start;
        if (log1 + log2 > (far1 + start) + (far2 + start)) {
            far1 = log1 - start;
            far2 = log2 - start;
        }
    }
    for (int64_t k = 0; k < (far1 + far2 > FAR ? 4 : 2); k++) {
        Stress law;
        stress_at(problem, start + WAY[k] * far1, start + WAY[k] * far2, &law);
        double twice = 2.0 * law.maxwell[0], along = law.h11[0] + twice, around = law.h22[0] + twice;
        /* Where the elastic law itself gives way there is nothing left to share. */
        double share = along > 0.0 && around > 0.0 ? larger(twice / along, HOOP * twice / around) : 1.0;
        most = larger(most, share);
    }
    return most;
}

static void extremes(Problem *problem, const Grid *grid, const Points *at, double lam, Extremes *out) {
    const Stress *law = &at->law;
    int64_t n = grid->table->points;
    double values[MOST_POINTS], place, lnlp = problem->log_prestretch;
    Edges edge;
    edges(problem, grid, at, lam, &edge);
    const double *log1 = edge.log1;
    for (int64_t i = 0; i < n; i++) values[i] = -at->log[2 * n + i];
    out->log_area = largest(problem, grid, values, log1[0] + lnlp, log1[1] + lnlp, &out->radius);
    for (int64_t i = 0; i < n; i++) values[i] = -law->t2[i];
    out->hoop = -largest(problem, grid, values, -edge.t2[0], -edge.t2[1], &place);
    for (int64_t i = 0; i < n; i++) values[i] = -law->t1[i];
    out->meridional = -largest(problem, grid, values, -edge.t1[0], -edge.t1[1], &place);
    out->log_stretch = larger(largest(problem, grid, at->log, log1[0], log1[1], &place),
                              largest(problem, grid, at->log + n, lnlp, lnlp, &place));
    out->softening = 0.0;
    if (problem->field == 0.0) return;
    for (int64_t i = 0; i < n; i++)
        out->softening = larger(out->softening, 2.0 * law->maxwell[i] / (law->h11[i] + 2.0 * law->maxwell[i]));
    out->softening = larger(out->softening, softened(problem, grid, at, &edge));
}

/* Derivatives of the dimensionless force. */
typedef struct {
    double mu[MOST_PARAMETERS], alpha[MOST_PARAMETERS];
    double log_field;      /* with respect to ln(eps V^2/T^2) */
    double log_prestretch; /* at fixed force unit */
    double span, height;
} Derivatives;

/* dF/dp = d/dh (dE/dp): one tangent, with respect to h, serves every parameter p. */
static void derivatives(const Problem *problem, const Grid *grid, const State *state, const Points *at, double lam,
                        const Step *by_height, Derivatives *out) {
    const Stress *law = &at->law;
    int64_t n = grid->table->points;
    double te[MOST_POINTS], tq[MOST_POINTS], w1[MOST_POINTS], w2[MOST_POINTS];
    double stiffness = by_height->lam, per_span = 1.0 / problem->span;
    strain(grid, by_height->dc, te, tq);
    out->log_field = out->log_prestretch = out->span = 0.0;
    out->height = stiffness;
    for (int64_t i = 0; i < n; i++) {
        double tw = by_height->dw[i], twice = grid->twice[i], once = grid->once[i];
        double d1 = at->along[i] * tq[i] + at->down[i] * tw, d2 = at->around[i] * te[i];
        w1[i] = twice * d1;
        w2[i] = twice * d2;
        out->log_field -= law->maxwell[i] * (w1[i] + w2[i]);
        out->log_prestretch += (law->h11[i] + law->h12[i]) * w1[i] + (law->h12[i] + law->h22[i]) * w2[i];
        /* With the span L: R = exp(-L depth), dx = L d(depth), de/dx = (1/L) de/d(depth). */
        double depth = 0.5 * (1.0 - grid->table->xi[i]);
        double e_depth = (at->q[i] - at->e[i]) * per_span, te_depth = (tq[i] - te[i]) * per_span;
        double gp = law->t1[i] * at->along[i];
        double dgp = (law->h11[i] - 2.0 * law->t1[i]) * at->along[i] * d1 + law->t1[i] / at->metric[i] * tq[i] +
                     law->h12[i] * at->along[i] * d2;
        out->span += twice * ((per_span - 2.0 * depth) * (law->t1[i] * d1 + law->t2[i] * d2) - dgp * e_depth -
                              gp * te_depth) -
                     once * (per_span - depth) * (stiffness * state->w[i] + lam * tw);
    }
    projected(&problem->law, n, at->log, w1, w2, out->mu, out->alpha);
}

#endif
