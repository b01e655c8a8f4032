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
    Real log_area, radius; /* largest ln(l1 l2), and R/b where it stands */
    Real hoop, meridional; /* smallest stresses */
    Real log_stretch;
    Real softening; /* largest share of the stiffness that the voltage takes; 1 where the meridian leans inwards */
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
    Real log1[2], log2[2], t1[2], t2[2];
} Edges;

static void stress_at(Problem *problem, Real log1, Real log2, Stress *out) {
    Real log[3] = {log1, log2, -(log1 + log2)};
    stress(problem, 1, log, out);
}

/* Nominal stress at a clamped edge from the horizontal reaction there, which the energy's derivative with respect to
   the edge's radius tells: a test function is 1 at that edge and 0 at the other. */
static Real pull_at(const Grid *grid, const Points *at, const double *test, Real lam, Real inner) {
    int64_t n = grid->table->points;
    Real both = of(0.0), slope = of(0.0);
    for (int64_t i = 0; i < n; i++) {
        Real on_q = grid->twice[i] * (at->law.t1[i] * at->along[i]);
        both += test[i] * (grid->twice[i] * (at->law.t2[i] * at->around[i]) + on_q);
        slope += test[n + i] * on_q;
    }
    Real level = both + slope * grid->dxi, down = lam * inner;
    return sqrt_of(level * level + down * down) / (inner * inner);
}

/* Where Newton on an edge's stretch starts, and the nominal stress there. A relaxed element is a straight cone: its
   slope tells the pull at its end. */
static Real edge_start(const Problem *problem, const Solved *solved, int64_t end, Real lam, Real *log1,
                         Real *log2) {
    int64_t k = end == 0 ? 0 : solved->elements - 1;
    const Grid *grid = &solved->grid[k];
    const Points *at = &solved->at[k];
    int64_t n = grid->table->points, last = end == 0 ? 0 : n - 1;
    const double *to_end = grid->table->ends + n * end;
    Real inner = end == 0 ? exp_of(-problem->span) : of(1.0);
    *log1 = across(n, to_end, at->log);
    *log2 = problem->log_prestretch;
    if (!solved->folded || !solved->folded[k])
        return pull_at(grid, at, grid->table->edge_tests + 2 * n * end, lam, inner);
    *log2 = across(n, to_end, at->log + n);
    return lam / (at->down[last] * sqrt_of(at->metric[last])) / inner;
}

static void edges(Problem *problem, const Solved *solved, Real lam, Edges *out) {
    Real lnlp = problem->log_prestretch, pull[2], start1[2], start2[2], log[6];
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
            if (k == 3) {
                Mask near = abs_of(out->log1[end] - start1[end]) < 0.1 + 0.5 * abs_of(start1[end] - lnlp);
                out->log1[end] = pick(near, out->log1[end], start1[end]);
                out->log2[end] = pick(near, out->log2[end], start2[end]);
            }
            log[end] = out->log1[end];
            log[2 + end] = out->log2[end];
            log[4 + end] = -(out->log1[end] + out->log2[end]);
        }
        stress(problem, 2, log, &now);
        for (int64_t end = 0; end < 2; end++) {
            Real change = of(0.0), rate = of(0.0);
            if (folded[end]) { /* of one end: the other may be taut */
                rate = -now.h12[end] / now.h22[end];
                change = -now.t2[end] / now.h22[end];
                now.t1[end] += now.h12[end] * change;
                now.h11[end] += now.h12[end] * rate;
                now.t2[end] = of(0.0);
            }
            if (k == 3) continue;
            Real shrink = exp_of(lnlp - out->log1[end]);
            Real step = (pull[end] - now.t1[end] * shrink) / ((now.h11[end] - now.t1[end]) * shrink);
            out->log1[end] += step;
            if (folded[end]) out->log2[end] += change + rate * step;
        }
    }
    memcpy(out->t1, now.t1, sizeof out->t1);
    memcpy(out->t2, now.t2, sizeof out->t2);
}

/* Value and two derivatives of the Legendre series with n coefficients. */
static void series(int64_t n, const Real *c, Real xi, Real *value, Real *slope, Real *curve) {
    Real before = of(1.0), now = xi, before1 = of(0.0), now1 = of(1.0), before2 = of(0.0), now2 = of(0.0);
    *value = c[0] + c[1] * xi;
    *slope = c[1];
    *curve = of(0.0);
    for (int64_t i = 2; i < n; i++) {
        Real older = before, older1 = before1, older2 = before2;
        double k = 2.0 * (double)i - 1.0;
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
static void refined(const Table *table, const Real *values, Real *fine) {
    for (int64_t k = 0; k < FINE; k++) fine[k] = of(0.0);
    for (int64_t i = 0; i < table->points; i++)
        for (int64_t k = 0; k < FINE; k++) fine[k] += values[i] * table->fine[i * FINE + k]; /* vector */
}

/* A place between two others. */
typedef struct {
    Real low, xi, high;
} Bracket;

/* Largest value of the polynomial through the points, from the largest of its FINE values on; moves `place` there. */
static Real peak(const Table *table, const Real *values, Bracket *place) {
    int64_t n = table->points;
    Real c[MOST_POINTS], value, slope, curve, step = of(0.0);
    for (int64_t k = 0; k < n; k++) c[k] = of(0.0);
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < n; k++) c[k] += values[i] * table->legendre[i * n + k]; /* vector */
    for (int64_t k = 0; k < POLISH; k++) {
        series(n, c, place->xi, &value, &slope, &curve);
        Real aim = pick(curve < 0.0, place->xi - slope / curve, place->xi);
        step = smaller(larger(aim, place->low), place->high) - place->xi;
        place->xi += step;
    }
    return value + step * (slope + 0.5 * curve * step); /* the last step is so short that its cube is nothing */
}

/* Largest value over the film, from those at the points of every element and at both edges, and R/b where it stands. */
static Real largest(const Solved *solved, const Real (*values)[MOST_POINTS], Real disk, Real ring, Real *radius) {
    const Table *table = solved->grid[0].table;
    Real best = larger(disk, ring), inside = of(-INFINITY), most = of(-INFINITY), fine[FINE];
    Real chosen[MOST_POINTS], left = of(0.0), right = of(0.0);
    Bracket place = {of(0.0), of(0.0), of(0.0)};
    for (int64_t i = 0; i < table->points; i++) chosen[i] = of(0.0);
    *radius = exp_of(pick(disk >= ring, solved->grid[0].left, of(0.0)));
    for (int64_t k = 0; k < solved->elements; k++)
        for (int64_t i = 0; i < table->points; i++) inside = larger(inside, values[k][i]);
    if (!any(inside > best)) return best;
    for (int64_t k = 0; k < solved->elements; k++) {
        Mask won = is_not(yes());
        refined(table, values[k], fine);
        for (int64_t i = 0; i < FINE; i++) {
            Mask higher = fine[i] > most;
            most = pick(higher, fine[i], most);
            place.low = pick(higher, of(table->fine_xi[i > 0 ? i - 1 : 0]), place.low);
            place.xi = pick(higher, of(table->fine_xi[i]), place.xi);
            place.high = pick(higher, of(table->fine_xi[i < FINE - 1 ? i + 1 : FINE - 1]), place.high);
            won |= higher;
        }
        if (!any(won)) continue;
        const Grid *grid = &solved->grid[k];
        left = pick(won, grid->left, left);
        right = pick(won, grid->right, right);
        for (int64_t i = 0; i < table->points; i++) chosen[i] = pick(won, values[k][i], chosen[i]);
    }
    Real top = peak(table, chosen, &place);
    Mask there = (inside > best) & (top > best);
    *radius = pick(there, exp_of(left + 0.5 * (1.0 + place.xi) * (right - left)), *radius);
    return pick(there, top, best);
}

/* Largest share of a stiffness that the voltage takes on the way from the pre-stretched film to its widest point. */
static Real softened(Problem *problem, const Solved *solved, const Edges *edge) {
    static const double WAY[4] = {0.5, 1.0, 0.25, 0.75}; /* the last two where the way is far */
    int64_t n = solved->grid[0].table->points;
    Real start = problem->log_prestretch, log1 = edge->log1[0], log2 = edge->log2[0], most = of(0.0);
    Mask every = problem->counts;
    for (int64_t k = 0; k < solved->elements; k++) {
        const Real *log = solved->at[k].log;
        for (int64_t i = 0; i < n; i++) {
            Mask wider = log[i] + log[n + i] > log1 + log2;
            log1 = pick(wider, log[i], log1);
            log2 = pick(wider, log[n + i], log2);
        }
    }
    Mask wider = edge->log1[1] + edge->log2[1] > log1 + log2;
    log1 = pick(wider, edge->log1[1], log1);
    log2 = pick(wider, edge->log2[1], log2);
    Real far1 = log1 - start, far2 = log2 - start;
    Mask asked = every & (problem->field != 0.0);
    for (int64_t k = 0; k < 4; k++) {
        if (k == 2) asked &= far1 + far2 > FAR;
        if (!any(asked)) break;
        Stress law;
        problem->counts = asked;
        stress_at(problem, start + WAY[k] * far1, start + WAY[k] * far2, &law);
        Real twice = 2.0 * law.maxwell[0], along = law.h11[0] + twice, around = law.h22[0] + twice;
        /* Where the elastic law itself gives way there is nothing left to share. */
        Real share = larger(twice / along, HOOP * twice / around);
        share = pick((along > 0.0) & (around > 0.0), share, of(1.0));
        most = pick(asked, larger(most, share), most);
    }
    problem->counts = every;
    return most;
}

/* Whether the film, stretched like a straight cone both ways, would push outwards: no tension can hold it. */
static Mask is_slack(Problem *problem) {
    Mask every = problem->counts, charged = problem->field != 0.0;
    if (!any(charged)) return charged;
    Real cone = problem->height / -expm1_of(-problem->span);
    Real log = problem->log_prestretch + 0.5 * log1p_of(cone * cone);
    Stress law;
    problem->counts = every & charged;
    stress_at(problem, log, log, &law);
    problem->counts = every;
    return charged & (law.t1[0] < 0.0);
}

static void extremes(Problem *problem, const Solved *solved, Real lam, Extremes *out) {
    int64_t n = solved->grid[0].table->points, elements = solved->elements;
    Real area[MOST_ELEMENTS][MOST_POINTS], hoop[MOST_ELEMENTS][MOST_POINTS], meridian[MOST_ELEMENTS][MOST_POINTS];
    Real log1[MOST_ELEMENTS][MOST_POINTS], log2[MOST_ELEMENTS][MOST_POINTS], place;
    Edges edge;
    Mask charged = problem->field != 0.0;
    edges(problem, solved, lam, &edge);
    out->softening = of(0.0);
    for (int64_t k = 0; k < elements; k++) {
        const Points *at = &solved->at[k];
        for (int64_t i = 0; i < n; i++) {
            area[k][i] = -at->log[2 * n + i];
            hoop[k][i] = -at->law.t2[i];
            meridian[k][i] = -at->law.t1[i];
            log1[k][i] = at->log[i];
            log2[k][i] = at->log[n + i];
            Real twice = 2.0 * at->law.maxwell[i];
            out->softening = pick(charged, larger(out->softening, twice / (at->law.h11[i] + twice)), out->softening);
        }
    }
    out->log_area = largest(solved, area, edge.log1[0] + edge.log2[0], edge.log1[1] + edge.log2[1], &out->radius);
    out->hoop = -largest(solved, hoop, -edge.t2[0], -edge.t2[1], &place);
    out->meridional = -largest(solved, meridian, -edge.t1[0], -edge.t1[1], &place);
    out->log_stretch = larger(largest(solved, log1, edge.log1[0], edge.log1[1], &place),
                              largest(solved, log2, edge.log2[0], edge.log2[1], &place));
    if (any(charged)) out->softening = larger(out->softening, softened(problem, solved, &edge));
    for (int64_t k = 0; k < elements; k++)
        for (int64_t i = 0; i < n; i++)
            out->softening = pick(solved->at[k].along[i] <= 0.0, of(1.0), out->softening);
}

/* Derivatives of the dimensionless force. */
typedef struct {
    Real mu[MOST_PARAMETERS], alpha[MOST_PARAMETERS];
    Real log_field;      /* with respect to ln(eps V^2/T^2) */
    Real log_prestretch; /* at fixed force unit */
    Real span, height;
} Derivatives;

/* dF/dp = d/dh (dE/dp): one tangent, with respect to h, serves every parameter p. This adds what one element gives; the
   tangent of the force is `stiffness`, `slope` that of the slopes, `dc` that of the functions. A cut stays at its share
   of the span; the relaxed energy is smooth across it, so its motion changes nothing. */
static void add_derivatives(const Problem *problem, const Grid *grid, const Real *w, const Points *at, int64_t folded,
                            Real lam, const Real *dc, const Real *slope, Real stiffness, Derivatives *out) {
    const Stress *law = &at->law;
    int64_t n = grid->table->points;
    Real te[MOST_POINTS], tq[MOST_POINTS], w1[MOST_POINTS], w2[MOST_POINTS];
    Real per_span = 1.0 / problem->span, by_mu[MOST_PARAMETERS], by_alpha[MOST_PARAMETERS];
    strain(grid, dc, te, tq);
    for (int64_t i = 0; i < n; i++) {
        Real tw = slope[i], twice = grid->twice[i], once = grid->once[i];
        Real d1 = at->along[i] * tq[i] + at->down[i] * tw, around = at->around[i] * te[i];
        Real d2 = folded ? at->rate[i] * d1 : around;
        w1[i] = twice * d1;
        w2[i] = twice * d2;
        out->log_field -= law->maxwell[i] * (w1[i] + w2[i]);
        out->log_prestretch += (law->h11[i] + law->h12[i]) * w1[i] + (law->h12[i] + law->h22[i]) * w2[i];
        /* With the span L: R = exp(-L depth), dx = L d(depth), de/dx = (1/L) de/d(depth). */
        Real depth = -(0.5 * (grid->right - grid->left) * (grid->table->xi[i] - 1.0) + grid->right) * per_span;
        Real e_depth = (at->q[i] - at->e[i]) * per_span, te_depth = (tq[i] - te[i]) * per_span;
        Real gp = law->t1[i] * at->along[i];
        Real dgp = (law->h11[i] - 2.0 * law->t1[i]) * at->along[i] * d1 + law->t1[i] / at->metric[i] * tq[i] +
                     law->h12[i] * at->along[i] * around;
        out->span += twice * ((per_span - 2.0 * depth) * (law->t1[i] * d1 + law->t2[i] * around) - dgp * e_depth -
                              gp * te_depth) -
                     once * (per_span - depth) * (stiffness * w[i] + lam * tw);
    }
    projected(&problem->law, n, at->log, w1, w2, by_mu, by_alpha);
    for (int64_t k = 0; k < problem->law.moduli; k++) out->mu[k] += by_mu[k];
    for (int64_t k = 0; k < problem->law.shapes; k++) out->alpha[k] += by_alpha[k];
}

/* All of them, of a film of one element. */
static void derivatives_of(const Problem *problem, const Grid *grid, const State *state, const Points *at, Real lam,
                           Derivatives *out) {
    Reduced system;
    Step by_height;
    for (int64_t k = 0; k < MOST_PARAMETERS; k++) out->mu[k] = out->alpha[k] = of(0.0);
    out->log_field = out->log_prestretch = out->span = of(0.0);
    reduce(grid, state->w, at, &system);
    factor(grid->table->modes, system.coupling, system.give, system.matrix, system.diagonal);
    tangent(grid, &system, &by_height);
    out->height = by_height.lam;
    add_derivatives(problem, grid, state->w, at, 0, lam, by_height.dc, by_height.dw, by_height.lam, out);
}

#endif
