/* Newton at increasing resolution: model/membrane/refinement.py for one taut state, with the same steps, limits and
   error estimate. */
#ifndef DEA_REFINEMENT_H
#define DEA_REFINEMENT_H

#include "ritz.h"

enum {
    MOST_STEPS = 25
};
#define NEWTON_FACTOR 0.3
#define LEVEL_FACTOR 0.5
#define TAIL_FACTOR 2.0
#define FELT 0.6
#define ROUND_OFF 1e-13
#define LEAST_SHARE 0.15
#define CLEARLY_NEGATIVE (-1e-2)
#define ROUND_OFF_TENSION (-1e-9)
#define LONGEST 4.0

/* What a state came to; those from 0 on are numbers of model.membrane.solution.Status. */
enum {
    TAUT = 0,
    WRINKLED = 1,
    SLACK = 2,
    UNSTABLE = 3,
    NOT_CONVERGED = 4,
    LEFT_TO_OTHERS = -1,
    NEEDS_TABLE = -2,
    FOLDED = -3,
    UNSETTLED = -4,
    OPEN = -5,
    FOLDING = -6
};

/* A state after Newton at one resolution. */
typedef struct {
    Real lam;
    Real change; /* largest relative change of a slope or of the meridional stress in the last step */
    Real tail;   /* share of the energy that the last modes carry */
    Real hoop;   /* least hoop over largest meridional stress at the points, before the last step */
    Whole steps;
    Mask ok;
} Iterate;

/* Change of a slope at which Newton's error is just below the tolerance. */
static double goal(double tolerance) { return fmin(0.03, fmax(1e-6, sqrt(0.9 * tolerance / NEWTON_FACTOR))); }

/* Estimated relative error of `now`, after the force `previous` at the resolution before, with the tail `before`; NaN
   where there was none. */
static Real estimate(const Iterate *now, Real previous, Real before, double tolerance, double factor) {
    Real truncated = factor * abs_of((now->lam - previous) / now->lam) + now->tail;
    truncated = larger(truncated, TAIL_FACTOR * sqrt_of(now->tail * before));
    return truncated + NEWTON_FACTOR * (now->change * now->change) + (ROUND_OFF + LEAST_SHARE * tolerance);
}

/* Relative change of the meridional stress at a point by a step. */
static inline Real stressed(const Points *at, int64_t i, Real de, Real dq, Real dw) {
    const Stress *law = &at->law;
    return (law->h11[i] * (at->along[i] * dq + at->down[i] * dw) + law->h12[i] * (at->around[i] * de)) / law->t1[i];
}

/* Add a step to the state in the lanes that are `open`, shortened where a slope would change beyond reason. Returns the
   largest relative change of a slope or of the meridional stress; NaN where there is none. */
static Real advance(const Problem *problem, const Grid *grid, const Points *at, const Step *step, Mask open,
                    State *state) {
    int64_t points = grid->table->points, modes = grid->table->modes;
    Real change = of(0.0), felt = of(0.0), share = of(1.0), sum = step->lam;
    Mask charged = problem->field != 0.0;
    for (int64_t i = 0; i < points; i++) {
        change = larger(change, abs_of(step->dw[i] / state->w[i]));
        felt = larger(felt, abs_of(stressed(at, i, step->de[i], step->dq[i], step->dw[i])));
        sum += step->dw[i];
    }
    felt = FELT * larger(felt, change);
    if (any(charged)) {
        for (int64_t i = 0; i < points; i++) share = larger(share, abs_of(at->law.maxwell[i] / at->law.t1[i]));
        change = pick(charged, change * sqrt_of(share), change);
    }
    Real part = pick(change > 2.0, 2.0 / change, of(1.0));
    open &= finite(sum);
    for (int64_t i = 0; i < points; i++) { /* vector */
        Real w = state->w[i], moved = w + part * step->dw[i];
        moved = pick((change > 0.8) & is_not(moved > 0.2 * w), 0.2 * w, moved);
        state->w[i] = pick(open, moved, w);
    }
    for (int64_t k = 0; k < modes; k++) state->c[k] = pick(open, state->c[k] + part * step->dc[k], state->c[k]);
    return pick(finite(sum), felt, of(NAN));
}

/* Energy of the last mode and a tenth of that of the last but one, over F h. */
static Real tail(const Problem *problem, const Grid *grid, const State *state, const Reduced *system, Real lam) {
    int64_t k = grid->table->modes - 1;
    Real last = state->c[k] * state->c[k] * system->diagonal[k];
    Real fore = state->c[k - 1] * state->c[k - 1] * system->diagonal[k - 1];
    return 0.5 * (last + 0.1 * fore) / (lam * problem->height);
}

static Real hoop_share(int64_t n, const Stress *law) {
    Real least = of(INFINITY), most = of(-INFINITY);
    for (int64_t i = 0; i < n; i++) {
        least = smaller(least, law->t2[i]);
        most = larger(most, law->t1[i]);
    }
    return least / most;
}

/* Newton from `state` until the slopes change by less than `aim`; the error is then its square. */
static Iterate newton(Problem *problem, const Grid *grid, State *state, double aim, int64_t limit) {
    Points at;
    Reduced system;
    Step step;
    Mask open = problem->counts, every = open;
    Iterate found = {of(NAN), of(NAN), of(NAN), of(NAN), counted(open, 0), is_not(yes())};
    for (int64_t k = 0; k < limit && any(open); k++) {
        problem->counts = open;
        evaluate(problem, grid, state, NULL, &at);
        newton_step(problem, grid, state->w, &at, &system, &step);
        found.steps += counted(open, 1);
        found.change = pick(open, advance(problem, grid, &at, &step, open, state), found.change);
        Mask done = open & (found.change <= aim);
        if (any(done)) {
            found.lam = pick(done, step.lam, found.lam);
            found.tail = pick(done, tail(problem, grid, state, &system, step.lam), found.tail);
            found.hoop = pick(done, hoop_share(grid->table->points, &at.law), found.hoop);
            found.ok |= done & step.stable & (step.lam > 0.0);
        }
        open &= is_not(done) & finite(found.change);
    }
    problem->counts = every;
    return found;
}

/* Values at the points carried to others by `matrix`, (to, from). */
static void carried(int64_t to, int64_t from, const double *matrix, Real *values) {
    Real old[MOST_POINTS];
    memcpy(old, values, sizeof(Real) * (size_t)from);
    for (int64_t i = 0; i < to; i++) values[i] = across(from, matrix + i * from, old);
}

/* The state with other modes: `matrix` carries the slopes, which stay above zero. */
static void prolong(const Table *from, const Table *to, const double *matrix, State *state) {
    Real least = state->w[0];
    for (int64_t i = 1; i < from->points; i++) least = smaller(least, state->w[i]);
    for (int64_t k = from->modes; k < to->modes; k++) state->c[k] = of(0.0);
    carried(to->points, from->points, matrix, state->w);
    for (int64_t i = 0; i < to->points; i++)
        state->w[i] = pick(state->w[i] > 0.0, state->w[i], least);
}

#if LANES == 1 /* the way over the resolutions; several.c has its own for many states */

/* The state of `grid` to `tolerance`, at the resolution that it needs. `tables` has one for so many modes at that
   place, or none. `relaxed`: a state whose hoop stress is clearly negative is FOLDED at once. */
static int settle_plain(Problem *problem, const Table *const *tables, double tolerance, int relaxed, Grid *grid,
                        State *state, Iterate *found, double *error) {
    double aim = goal(tolerance), previous = NAN, before = NAN;
    int64_t steps = 0;
    for (;;) {
        *found = newton(problem, grid, state, aim, MOST_STEPS);
        steps += found->steps;
        found->steps = steps;
        if (relaxed && found->hoop <= CLEARLY_NEGATIVE) return FOLDED;
        if (!found->ok) return UNSETTLED;
        *error = estimate(found, previous, before, tolerance, LEVEL_FACTOR);
        if (*error <= tolerance) return TAUT;
        previous = found->lam;
        before = found->tail;
        const Table *now = grid->table;
        if (now->next > MOST_MODES) return UNSETTLED;
        if (!tables[now->next]) return NEEDS_TABLE;
        prolong(now, tables[now->next], now->carry, state);
        lay(grid, tables[now->next], now->next, -problem->span, 0.0);
    }
}

/* The same from the first guess, with so many `modes` to begin with. */
static int refine(Problem *problem, const Table *const *tables, int64_t modes, double tolerance, int relaxed,
                  Grid *grid, State *state, Iterate *found, double *error) {
    if (!tables[modes]) return NEEDS_TABLE;
    lay(grid, tables[modes], modes, -problem->span, 0.0);
    guess(problem, grid, state);
    return settle_plain(problem, tables, tolerance, relaxed, grid, state, found, error);
}

#endif

#endif
