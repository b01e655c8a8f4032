/* The Ritz form of the membrane problem and its Newton step: model/membrane/ritz.py, for one state. Equations stand
   there; names are the same. What stands here is about one element; a taut film has no other.

   x = ln(R/b) in [-span, 0]. Unknowns: e = r/R - 1 as a sum of modes (coefficients c), the slope w = -dz/dR at every
   point, and the force lam. q = dr/dR - 1 = e + de/dx. */
#ifndef DEA_RITZ_H
#define DEA_RITZ_H

#include "law.h"

enum {
    MOST_MODES = 64,
    MOST_POINTS = MOST_MODES + 3,
    MOST_ELEMENTS = 5,
    MOST_FUNCTIONS = MOST_MODES + 2, /* with the hats */
    MOST_PAIRS = MOST_FUNCTIONS * (MOST_FUNCTIONS + 1) / 2,
};

/* Modes and quadrature on [-1, 1], made by model/membrane/compiled.py: N modes, then two hats, make
   F = N + 2 functions; Q points; rows before columns. */
typedef struct {
    int64_t modes, points;
    int64_t next;             /* modes of the next resolution */
    const double *xi;         /* (Q) */
    const double *weight;     /* (Q) */
    const double *values;     /* (2, F, Q): functions at the points, their derivatives in xi */
    const double *project;    /* (Q, 2, F): the same, point by point */
    const double *pairs;      /* (Q, 3, F (F+1)/2): products of two functions; one with the other's derivative; both */
    const double *ends;       /* (2, Q): extrapolation to xi = -1 and 1 */
    const double *end_slopes; /* (2, Q): derivative there */
    const double *integrate;  /* (Q, Q): integral from -1 to each point */
    const double *to_modes;   /* (N, Q): modes of a function whose derivative is given */
    const double *edge_tests; /* (2, 2, Q): test functions of disk and ring, each with its derivative */
    const double *fine;       /* (Q, FINE): interpolation to the FINE points */
    const double *fine_xi;    /* (FINE) */
    const double *legendre;   /* (Q, Q): from values at the points to Legendre coefficients */
    const double *carry;      /* (next points, Q): interpolation to the points of the next resolution */
    const double *check;      /* (CHECK_POINTS, Q): to the points of CHECK_MODES */
} Table;

/* A state to solve, dimensionless. */
typedef struct {
    FilmLaw law;
    double field; /* eps (V/T)^2 / G; 0 without voltage */
    double log_prestretch, span, height;
} Posed;

/* The same of every lane, and how many points of its law were computed, in the lanes where these count. */
typedef struct {
    Law law;
    Real field, log_prestretch, span, height;
    Mask counts;
    Whole mechanical, electric, relaxed;
} Problem;

/* A table laid on an element between two values of x; with its hats where it has neighbours. */
typedef struct {
    const Table *table;
    int64_t functions;
    Real left, right;
    Real radius[MOST_POINTS]; /* R/b */
    Real once[MOST_POINTS];   /* weight dx R */
    Real twice[MOST_POINTS];  /* weight dx R^2 */
    Real dxi;                 /* d(xi)/dx */
} Grid;

typedef struct {
    Real c[MOST_FUNCTIONS];
    Real w[MOST_POINTS];
} State;

/* The state at the points. */
typedef struct {
    Real e[MOST_POINTS], q[MOST_POINTS];
    Real log[3 * MOST_POINTS]; /* L1, L2, L3 */
    Stress law;
    Real along[MOST_POINTS];  /* dL1/dp */
    Real down[MOST_POINTS];   /* dL1/dw */
    Real around[MOST_POINTS]; /* dL2/de */
    Real metric[MOST_POINTS]; /* p^2 + w^2 */
    Real hoop[MOST_POINTS];   /* ln(lp r/R), the same as L2 but where relaxed */
    Real rate[MOST_POINTS];   /* dL2/dL1 where relaxed */
} Points;

/* The Newton system after the slopes are eliminated: height = reach + give lam - coupling . dc. */
typedef struct {
    Real matrix[MOST_PAIRS]; /* lower triangle, row by row; after `factor` L below the diagonal and D on it */
    Real diagonal[MOST_FUNCTIONS];
    Real residual[MOST_FUNCTIONS], coupling[MOST_FUNCTIONS];
    Real give, reach;
    Real hw[MOST_POINTS], kqw[MOST_POINTS], kew[MOST_POINTS], gw[MOST_POINTS];
    Mask positive;
} Reduced;

/* One Newton step: the change of the state and the force after it. */
typedef struct {
    Real dc[MOST_FUNCTIONS], dw[MOST_POINTS];
    Real de[MOST_POINTS], dq[MOST_POINTS]; /* that make up dc */
    Real lam;
    Mask stable;
} Step;

static void lay(Grid *grid, const Table *table, int64_t functions, Real left, Real right) {
    Real half = 0.5 * (right - left);
    grid->table = table;
    grid->functions = functions;
    grid->left = left;
    grid->right = right;
    grid->dxi = 1.0 / half;
    for (int64_t i = 0; i < table->points; i++) { /* vector */
        Real radius = exp_of(half * (table->xi[i] - 1.0) + right);
        Real once = table->weight[i] * half * radius;
        grid->radius[i] = radius;
        grid->once[i] = once;
        grid->twice[i] = once * radius;
    }
}

/* e and q at the points, or their changes, from the modes' coefficients. */
static void strain(const Grid *grid, const Real *c, Real *e, Real *q) {
    int64_t points = grid->table->points, every = grid->table->modes + 2;
    for (int64_t i = 0; i < points; i++) e[i] = q[i] = of(0.0);
    for (int64_t k = 0; k < grid->functions; k++) {
        const double *value = grid->table->values + k * points, *slope = value + every * points;
        for (int64_t i = 0; i < points; i++) { /* vector */
            e[i] += c[k] * value[i];
            q[i] += c[k] * slope[i];
        }
    }
    for (int64_t i = 0; i < points; i++) q[i] = q[i] * grid->dxi + e[i]; /* vector */
}

/* True stress dW-star/dL_i and its tangent: the law's, less the Maxwell stress k exp(2 (L1 + L2)). */
static void stress(Problem *problem, int64_t n, const Real *log, Stress *out) {
    derivatives_of_law(&problem->law, n, log, out);
    problem->mechanical += counted(problem->counts, n);
    for (int64_t i = 0; i < n; i++) out->maxwell[i] = of(0.0);
    Mask charged = problem->field != 0.0;
    if (!any(charged)) return;
    problem->electric += counted(problem->counts & charged, n);
    for (int64_t i = 0; i < n; i++) { /* vector */
        Real b = pick(charged, problem->field * exp_of(-2.0 * log[2 * n + i]), of(0.0));
        out->maxwell[i] = b;
        out->t1[i] -= b;
        out->t2[i] -= b;
        out->h11[i] -= 2.0 * b;
        out->h12[i] -= 2.0 * b;
        out->h22[i] -= 2.0 * b;
    }
}

/* The law with the hoop stretch eliminated, so that the hoop stress is zero: `relax` in model/material/law.py. Leaves
   dL2 = change + rate dL1; returns whether a natural hoop stretch exists everywhere. */
static Mask relax(int64_t n, Stress *law, Real *change, Real *rate) {
    Mask regular = yes();
    for (int64_t i = 0; i < n; i++) { /* vector */
        regular &= law->h22[i] > 0.0;
        rate[i] = -law->h12[i] / law->h22[i];
        change[i] = -law->t2[i] / law->h22[i];
        law->t1[i] += law->h12[i] * change[i];
        law->h11[i] += law->h12[i] * rate[i];
        law->t2[i] = law->h12[i] = law->h22[i] = of(0.0);
    }
    return regular;
}

/* Strains, stresses and tangents of a state; of a relaxed element with its `natural` ln(l2), else NULL. */
static void evaluate(Problem *problem, const Grid *grid, const State *state, const Real *natural, Points *at) {
    int64_t n = grid->table->points;
    strain(grid, state->c, at->e, at->q);
    for (int64_t i = 0; i < n; i++) { /* vector */
        Real e = at->e[i], q = at->q[i], w = state->w[i], g = (q + 2.0) * q + w * w;
        at->metric[i] = g + 1.0;
        at->along[i] = (q + 1.0) / (g + 1.0);
        at->down[i] = w / (g + 1.0);
        at->around[i] = 1.0 / (e + 1.0);
        at->log[i] = g;
        at->log[n + i] = e;
    }
    for (int64_t i = 0; i < 2 * n; i++) at->log[i] = log1p_of(at->log[i]); /* vector */
    for (int64_t i = 0; i < n; i++) { /* vector */
        Real log1 = 0.5 * at->log[i] + problem->log_prestretch;
        at->hoop[i] = at->log[n + i] + problem->log_prestretch;
        Real log2 = natural ? natural[i] : at->hoop[i];
        at->log[i] = log1;
        at->log[n + i] = log2;
        at->log[2 * n + i] = -(log1 + log2);
    }
    stress(problem, n, at->log, &at->law);
    Real change[MOST_POINTS];
    if (!natural) return;
    relax(n, &at->law, change, at->rate);
    problem->relaxed += counted(problem->counts, n);
}

/* `sum over points of ee e e' + eq (e q' + q e') + qq q q'` for every pair of modes, and of `on_e e + on_q q`. The
   three sums come in terms of a mode's value and of its derivative in xi. */
typedef struct {
    Real pair[3][MOST_POINTS], coupling[2][MOST_POINTS], residual[2][MOST_POINTS];
} Weights;

static void assemble(const Table *table, int64_t functions, const Weights *on, Reduced *system) {
    int64_t every = table->modes + 2, stride = every * (every + 1) / 2, pairs = functions * (functions + 1) / 2;
    for (int64_t k = 0; k < functions; k++) system->coupling[k] = system->residual[k] = of(0.0);
    for (int64_t p = 0; p < pairs; p++) system->matrix[p] = of(0.0);
    for (int64_t i = 0; i < table->points; i++) {
        const double *value = table->project + 2 * i * every, *slope = value + every;
        Real c0 = on->coupling[0][i], c1 = on->coupling[1][i], r0 = on->residual[0][i], r1 = on->residual[1][i];
        for (int64_t k = 0; k < functions; k++) { /* vector */
            system->coupling[k] += c0 * value[k] + c1 * slope[k];
            system->residual[k] += r0 * value[k] + r1 * slope[k];
        }
        const double *both = table->pairs + 3 * i * stride, *mixed = both + stride, *slopes = mixed + stride;
        Real m0 = on->pair[0][i], m1 = on->pair[1][i], m2 = on->pair[2][i];
        for (int64_t p = 0; p < pairs; p++) { /* vector */
            system->matrix[p] += m0 * both[p] + m1 * mixed[p] + m2 * slopes[p];
        }
    }
}

/* Assemble the Newton system of the modes alone: a slope stands alone at its point and is eliminated there. */
static void reduce(const Grid *restrict grid, const Real *restrict w, const Points *restrict at,
                   Reduced *restrict system) {
    const Stress *law = &at->law;
    Weights on;
    Real give[MOST_POINTS], reach[MOST_POINTS], kww[MOST_POINTS];
    int64_t n = grid->table->points;
    for (int64_t i = 0; i < n; i++) { /* vector */
        Real along = at->along[i], down = at->down[i], around = at->around[i];
        Real t1 = law->t1[i], t2 = law->t2[i];
        Real once = grid->once[i], twice = grid->twice[i];
        Real tm = t1 / at->metric[i], d = law->h11[i] - 2.0 * t1, slope = d * down;
        kww[i] = slope * down + tm;
        Real hw = 1.0 / kww[i], kqw = slope * along, h12a = law->h12[i] * around, kew = h12a * down, gw = t1 * down;
        Real thw = tm * hw, hkew = hw * kew, hg = hw * gw;
        Real qq = twice * ((d / at->metric[i] + tm) * thw); /* K_qq - K_qw^2 / K_ww without the cancellation */
        Real eq = twice * (h12a * along * thw);
        Real ee = twice * ((law->h22[i] - t2) * (around * around) - kew * hkew);
        on.pair[0][i] = (ee + eq) + (qq + eq);
        on.pair[1][i] = (qq + eq) * grid->dxi;
        on.pair[2][i] = qq * (grid->dxi * grid->dxi);
        Real on_q = once * (hw * kqw);
        on.coupling[0][i] = once * hkew + on_q;
        on.coupling[1][i] = on_q * grid->dxi;
        on_q = twice * (t1 * along - hg * kqw);
        on.residual[0][i] = twice * (t2 * around - hg * kew) + on_q;
        on.residual[1][i] = on_q * grid->dxi;
        give[i] = once * hw / grid->radius[i];
        reach[i] = once * (w[i] - hg);
        system->hw[i] = hw;
        system->kqw[i] = kqw;
        system->kew[i] = kew;
        system->gw[i] = gw;
    }
    assemble(grid->table, grid->functions, &on, system);
    system->give = system->reach = of(0.0);
    system->positive = yes();
    for (int64_t i = 0; i < n; i++) {
        system->give += give[i];
        system->reach += reach[i];
        system->positive &= kww[i] > 0.0;
    }
}

/* Eliminate the multiplier, which makes the matrix positive definite exactly where the state is stable, and take it
   apart into L D L'. Returns whether it is positive definite; another matrix gets what it gets. */
static Mask factor(int64_t n, const Real *coupling, Real give, Real *matrix, Real *diagonal) {
    Mask positive = yes();
    Real *row = matrix;
    for (int64_t i = 0; i < n; i++, row += i) {
        Real share = coupling[i] / give;
        for (int64_t j = 0; j <= i; j++) row[j] += share * coupling[j];
        diagonal[i] = row[i];
        const Real *other = matrix;
        for (int64_t j = 0; j < i; j++, other += j)
            for (int64_t k = 0; k < j; k++) row[j] -= row[k] * other[k];
        other = matrix;
        for (int64_t j = 0; j < i; j++, other += j) {
            Real part = row[j] / other[j];
            row[i] -= part * row[j];
            row[j] = part;
        }
        positive &= row[i] > 0.0;
    }
    return positive;
}

/* Solve the factored system in place. */
static void substitute(int64_t n, const Real *matrix, Real *x) {
    const Real *row = matrix;
    for (int64_t i = 0; i < n; i++, row += i)
        for (int64_t j = 0; j < i; j++) x[i] -= row[j] * x[j];
    row = matrix;
    for (int64_t i = 0; i < n; i++, row += i) x[i] /= row[i];
    for (int64_t i = n - 1; i >= 0; i--) {
        row = matrix + i * (i + 1) / 2;
        for (int64_t j = 0; j < i; j++) x[j] -= row[j] * x[i];
    }
}

/* How the slopes follow a change `dc` of the modes, and so of the strains, with the force `lam`. */
static void slopes(const Grid *grid, const Reduced *system, const Real *dc, Real lam, int gradient, Real *de, Real *dq,
                   Real *dw) {
    strain(grid, dc, de, dq);
    for (int64_t i = 0; i < grid->table->points; i++) { /* vector */
        Real rest = lam / grid->radius[i] - (gradient ? system->gw[i] : of(0.0));
        dw[i] = (rest - dq[i] * system->kqw[i] - de[i] * system->kew[i]) * system->hw[i];
    }
}

static Real dot(int64_t n, const Real *x, const Real *y) {
    Real total = of(0.0);
    for (int64_t i = 0; i < n; i++) total += x[i] * y[i];
    return total;
}

/* The same with a row of a table. */
static Real across(int64_t n, const double *row, const Real *values) {
    Real total = of(0.0);
    for (int64_t i = 0; i < n; i++) total += row[i] * values[i];
    return total;
}

/* The Newton step at a state; `system` is left factored. */
static void newton_step(const Problem *problem, const Grid *grid, const Real *w, const Points *at, Reduced *system,
                        Step *step) {
    int64_t modes = grid->table->modes;
    reduce(grid, w, at, system);
    Real lam0 = (problem->height - system->reach) / system->give;
    Mask positive = factor(modes, system->coupling, system->give, system->matrix, system->diagonal);
    for (int64_t k = 0; k < modes; k++) step->dc[k] = -(system->residual[k] + lam0 * system->coupling[k]);
    substitute(modes, system->matrix, step->dc);
    step->lam = lam0 + dot(modes, system->coupling, step->dc) / system->give;
    step->stable = positive & system->positive;
    slopes(grid, system, step->dc, step->lam, 1, step->de, step->dq, step->dw);
}

/* The derivative of the state and of the force with respect to h/b, from a factored system. */
static void tangent(const Grid *grid, const Reduced *system, Step *by_height) {
    int64_t modes = grid->table->modes;
    for (int64_t k = 0; k < modes; k++) by_height->dc[k] = -(system->coupling[k] / system->give);
    substitute(modes, system->matrix, by_height->dc);
    by_height->lam = (1.0 + dot(modes, system->coupling, by_height->dc)) / system->give;
    slopes(grid, system, by_height->dc, by_height->lam, 0, by_height->de, by_height->dq, by_height->dw);
}

/* A first state: r = R, and slopes that follow the power law w ~ R^(-1/n) of the film at its mean slope. */
static void guess(Problem *problem, const Grid *grid, State *state) {
    int64_t n = grid->table->points;
    Real mean = problem->height / -expm1_of(-problem->span), square = mean * mean;
    Real log1 = 0.5 * log1p_of(square) + problem->log_prestretch, log2 = problem->log_prestretch;
    Real log[3] = {log1, log2, -(log1 + log2)};
    Stress law;
    stress(problem, 1, log, &law);
    Real part = square / (1.0 + square);
    Real power = 1.0 - 2.0 * part + part * law.h11[0] / law.t1[0];
    power = pick((law.t1[0] > 0.0) & (power > 0.5), power, of(1.0));
    for (int64_t k = 0; k < grid->table->modes; k++) state->c[k] = of(0.0);
    for (int64_t i = 0; i < n; i++) { /* vector */
        state->w[i] = exp_of(0.5 * problem->span * (1.0 - grid->table->xi[i]) / power);
    }
    Real scale = problem->height / dot(n, grid->once, state->w);
    for (int64_t i = 0; i < n; i++) state->w[i] *= scale; /* vector */
}

#endif
