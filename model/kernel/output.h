/* What a solved state says: model/membrane/output.py, for one taut state. */
#ifndef DEA_OUTPUT_H
#define DEA_OUTPUT_H

#include "refinement.h"

enum {
    FINE = 33,
    POLISH = 3
};
#define FAR 1.2
#define HOOP 0.7

typedef struct {
    double log_area, radius; /* largest ln(l1 l2), and R/b where it stands */
    double hoop, meridional; /* smallest stresses */
    double log_stretch;
    double softening; /* largest share of the stiffness that the voltage takes away */
} Extremes;

/* A solved state: its elements from disk to ring, the state at their points, and which are relaxed; NULL where none. */
typedef struct {
    int64_t elements;
    const Grid *grid;
    const Points *at;
    const int64_t *folded;
} Solved;

/* The state at disk and ring. */
typedef struct {
    double log1[2], log2[2], t1[2], t2[2];
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

/* Where Newton on an edge's stretch starts, and the nominal stress there. A relaxed element is a straight cone: its
   slope tells the pull at its end. */
static double edge_start(const Problem *problem, const Solved *solved, int64_t end, double lam, double *log1,
                         double *log2) {
    int64_t k = end == 0 ? 0 : solved->elements - 1;
    const Grid *grid = &solved->grid[k];
    const Points *at = &solved->at[k];
    int64_t n = grid->table->points, last = end == 0 ? 0 : n - 1;
    const double *to_end = grid->table->ends + n * end;
    double inner = end == 0 ? exp_of(-problem->span) : 1.0;
    *log1 = dot(n, to_end, at->log);
    *log2 = problem->log_prestretch;
    if (!solved->folded || !solved->folded[k])
        return pull_at(grid, at, grid->table->edge_tests + 2 * n * end, lam, inner);
    *log2 = dot(n, to_end, at->log + n);
    return lam / (at->down[last] * sqrt(at->metric[last])) / inner;
}

static void edges(Problem *problem, const Solved *solved, double lam, Edges *out) {
    double lnlp = problem->log_prestretch, pull[2], start1[2], start2[2], log[6];
    int64_t folded[2] = {solved->folded ? solved->folded[0] : 0,
                         solved->folded ? solved->folded[solved->elements - 1] : 0};
    Stress now;
    for (int64_t end = 0; end < 2; end++) {
        pull[end] = edge_start(problem, solved, end, lam, &start1[end], &start2[end]);
        out->log1[end] = start1[end];
        out->log2[end] = start2[end];
    }
    for (int64_t k = 0; k < 4; k++) {
        for (int64_t end = 0; end < 2; end++) {
            if (k == 3 && !(fabs(out->log1[end] - start1[end]) < 0.1 + 0.5 * fabs(start1[end] - lnlp))) {
                out->log1[end] = start1[end];
                out->log2[end] = start2[end];
            }
            log[end] = out->log1[end];
            log[2 + end] = out->log2[end];
            log[4 + end] = -(out->log1[end] + out->log2[end]);
        }
        stress(problem, 2, log, &now);
        for (int64_t end = 0; end < 2; end++) {
            double change = 0.0, rate = 0.0;
            if (folded[end]) { /* of one end: the other may be taut */
                rate = -now.h12[end] / now.h22[end];
                change = -now.t2[end] / now.h22[end];
                now.t1[end] += now.h12[end] * change;
                now.h11[end] += now.h12[end] * rate;
                now.t2[end] = 0.0;
            }
            if (k == 3) continue;
            double shrink = exp_of(lnlp - out->log1[end]);
            double step = (pull[end] - now.t1[end] * shrink) / ((now.h11[end] - now.t1[end]) * shrink);
            out->log1[end] += step;
            if (folded[end]) out->log2[end] += change + rate * step;
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

/* Values at the points, at the FINE points of their element. */
static void refined(const Table *table, const double *values, double *fine) {
    for (int64_t k = 0; k < FINE; k++) fine[k] = 0.0;
    for (int64_t i = 0; i < table->points; i++)
        for (int64_t k = 0; k < FINE; k++) fine[k] += values[i] * table->fine[i * FINE + k];
}

/* Largest value of the polynomial through the points, from the largest of its FINE values on, and its xi. */
static double peak(const Table *table, const double *values, int64_t top, double *xi) {
    int64_t n = table->points;
    double c[MOST_POINTS], value, slope, curve, step = 0.0;
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

/* Largest value over the film, from those at the points of every element and at both edges, and R/b where it stands. */
static double largest(const Solved *solved, const double (*values)[MOST_POINTS], double disk, double ring,
                      double *radius) {
    const Table *table = solved->grid[0].table;
    double best = larger(disk, ring), inside = -INFINITY, most = -INFINITY, fine[FINE], xi;
    int64_t element = 0, place = 0;
    *radius = exp_of(disk >= ring ? solved->grid[0].left : 0.0);
    for (int64_t k = 0; k < solved->elements; k++)
        for (int64_t i = 0; i < table->points; i++) inside = larger(inside, values[k][i]);
    if (!(inside > best)) return best;
    for (int64_t k = 0; k < solved->elements; k++) {
        refined(table, values[k], fine);
        for (int64_t i = 0; i < FINE; i++)
            if (fine[i] > most) {
                most = fine[i];
                element = k;
                place = i;
            }
    }
    double top = peak(table, values[element], place, &xi);
    if (!(top > best)) return best;
    const Grid *grid = &solved->grid[element];
    *radius = exp_of(grid->left + 0.5 * (1.0 + xi) * (grid->right - grid->left));
    return top;
}

/* Largest share of a stiffness that the voltage takes on the way from the pre-stretched film to its widest point. */
static double softened(Problem *problem, const Solved *solved, const Edges *edge) {
    static const double WAY[4] = {0.5, 1.0, 0.25, 0.75}; /* the last two where the way is far */
    int64_t n = solved->grid[0].table->points;
    double start = problem->log_prestretch, log1 = edge->log1[0], log2 = edge->log2[0], most = 0.0;
    for (int64_t k = 0; k < solved->elements; k++) {
        const double *log = solved->at[k].log;
        for (int64_t i = 0; i < n; i++)
            if (log[i] + log[n + i] > log1 + log2) {
                log1 = log[i];
                log2 = log[n + i];
            }
    }
    if (edge->log1[1] + edge->log2[1] > log1 + log2) {
        log1 = edge->log1[1];
        log2 = edge->log2[1];
    }
    double far1 = log1 - start, far2 = log2 - start;
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

static void extremes(Problem *problem, const Solved *solved, double lam, Extremes *out) {
    int64_t n = solved->grid[0].table->points, elements = solved->elements;
    double area[MOST_ELEMENTS][MOST_POINTS], hoop[MOST_ELEMENTS][MOST_POINTS], meridian[MOST_ELEMENTS][MOST_POINTS];
    double log1[MOST_ELEMENTS][MOST_POINTS], log2[MOST_ELEMENTS][MOST_POINTS], place;
    Edges edge;
    edges(problem, solved, lam, &edge);
    out->softening = 0.0;
    for (int64_t k = 0; k < elements; k++) {
        const Points *at = &solved->at[k];
        for (int64_t i = 0; i < n; i++) {
            area[k][i] = -at->log[2 * n + i];
            hoop[k][i] = -at->law.t2[i];
            meridian[k][i] = -at->law.t1[i];
            log1[k][i] = at->log[i];
            log2[k][i] = at->log[n + i];
            if (problem->field != 0.0)
                out->softening =
                    larger(out->softening, 2.0 * at->law.maxwell[i] / (at->law.h11[i] + 2.0 * at->law.maxwell[i]));
        }
    }
    out->log_area = largest(solved, area, edge.log1[0] + edge.log2[0], edge.log1[1] + edge.log2[1], &out->radius);
    out->hoop = -largest(solved, hoop, -edge.t2[0], -edge.t2[1], &place);
    out->meridional = -largest(solved, meridian, -edge.t1[0], -edge.t1[1], &place);
    out->log_stretch = larger(largest(solved, log1, edge.log1[0], edge.log1[1], &place),
                              largest(solved, log2, edge.log2[0], edge.log2[1], &place));
    if (problem->field != 0.0) out->softening = larger(out->softening, softened(problem, solved, &edge));
}

/* Derivatives of the dimensionless force. */
typedef struct {
    double mu[MOST_PARAMETERS], alpha[MOST_PARAMETERS];
    double log_field;      /* with respect to ln(eps V^2/T^2) */
    double log_prestretch; /* at fixed force unit */
    double span, height;
} Derivatives;

/* dF/dp = d/dh (dE/dp): one tangent, with respect to h, serves every parameter p. This adds what one element gives; the
   tangent of the force is `stiffness`, `slope` that of the slopes, `dc` that of the functions. A cut stays at its share
   of the span; the relaxed energy is smooth across it, so its motion changes nothing. */
static void add_derivatives(const Problem *problem, const Grid *grid, const double *w, const Points *at, int64_t folded,
                            double lam, const double *dc, const double *slope, double stiffness, Derivatives *out) {
    const Stress *law = &at->law;
    int64_t n = grid->table->points;
    double te[MOST_POINTS], tq[MOST_POINTS], w1[MOST_POINTS], w2[MOST_POINTS];
    double per_span = 1.0 / problem->span, by_mu[MOST_PARAMETERS], by_alpha[MOST_PARAMETERS];
    strain(grid, dc, te, tq);
    for (int64_t i = 0; i < n; i++) {
        double tw = slope[i], twice = grid->twice[i], once = grid->once[i];
        double d1 = at->along[i] * tq[i] + at->down[i] * tw, around = at->around[i] * te[i];
        double d2 = folded ? at->rate[i] * d1 : around;
        w1[i] = twice * d1;
        w2[i] = twice * d2;
        out->log_field -= law->maxwell[i] * (w1[i] + w2[i]);
        out->log_prestretch += (law->h11[i] + law->h12[i]) * w1[i] + (law->h12[i] + law->h22[i]) * w2[i];
        /* With the span L: R = exp(-L depth), dx = L d(depth), de/dx = (1/L) de/d(depth). */
        double depth = -(0.5 * (grid->right - grid->left) * (grid->table->xi[i] - 1.0) + grid->right) * per_span;
        double e_depth = (at->q[i] - at->e[i]) * per_span, te_depth = (tq[i] - te[i]) * per_span;
        double gp = law->t1[i] * at->along[i];
        double dgp = (law->h11[i] - 2.0 * law->t1[i]) * at->along[i] * d1 + law->t1[i] / at->metric[i] * tq[i] +
                     law->h12[i] * at->along[i] * around;
        out->span += twice * ((per_span - 2.0 * depth) * (law->t1[i] * d1 + law->t2[i] * around) - dgp * e_depth -
                              gp * te_depth) -
                     once * (per_span - depth) * (stiffness * w[i] + lam * tw);
    }
    projected(&problem->law, n, at->log, w1, w2, by_mu, by_alpha);
    for (int64_t k = 0; k < problem->law.moduli; k++) out->mu[k] += by_mu[k];
    for (int64_t k = 0; k < problem->law.shapes; k++) out->alpha[k] += by_alpha[k];
}

#endif
