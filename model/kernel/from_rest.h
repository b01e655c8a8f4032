/* Taut and plain states that a cold start may miss, or find on another branch: model/membrane/from_rest.py without its
   wrinkled films. */
#ifndef DEA_FROM_REST_H
#define DEA_FROM_REST_H

#include "continuation.h"

enum {
    CHECK_MODES = 6, /* of a way that is only looked at */
    CHECK_POINTS = CHECK_MODES + 3,
    WAY_STEPS = 8,
    TRACES = 3
};
static const int64_t TRACE_MODES[TRACES] = {10, 16, 24};
#define WAY_GOAL 3e-2
#define CLOSE 2e-3 /* of V^2: a path that ended so close below the wanted voltage is followed again */

/* Whether so many steps of V^2 lead from the state `begun` without voltage to `end`, none of them a jump. */
static int led(Problem *problem, const Grid *grid, const State *begun, const State *end, int64_t steps) {
    State before = *begun, last = *begun;
    double field = problem->field, ahead[CHECK_POINTS];
    int good = 1;
    for (int64_t k = 1; k < steps && good; k++) {
        double share = 1.0 / (double)(steps - k + 1);
        State first = last;
        for (int64_t i = 0; i < CHECK_POINTS; i++) first.w[i] += share * (end->w[i] - first.w[i]);
        for (int64_t i = 0; i < CHECK_MODES; i++) first.c[i] += share * (end->c[i] - first.c[i]);
        before = last;
        last = first;
        problem->field = field * ((double)k / (double)steps);
        Iterate found = newton(problem, grid, &last, WAY_GOAL, WAY_STEPS);
        good = found.ok && jump(CHECK_POINTS, last.w, first.w) < CORRECTION;
    }
    problem->field = field;
    for (int64_t i = 0; i < CHECK_POINTS; i++) ahead[i] = 2.0 * last.w[i] - before.w[i];
    return good && jump(CHECK_POINTS, ahead, end->w) < CORRECTION;
}

/* Whether the state is on the branch from rest: by its energy, or since a few steps of the voltage lead there. `check`
   is the table of CHECK_MODES. */
static int connected(Problem *problem, const Table *check, const Grid *of, const State *state, double lam) {
    State end = *state, begun;
    Grid grid;
    prolong(of->table, check, of->table->check, &end);
    lay(&grid, check, CHECK_MODES, -problem->span, 0.0);
    int good = between(problem, &grid, &end);
    if (!good) {
        double field = problem->field;
        problem->field = 0.0;
        guess(problem, &grid, &begun);
        Iterate found = newton(problem, &grid, &begun, WAY_GOAL, WAY_STEPS);
        problem->field = field;
        good = found.ok && !leans(&grid, &begun) &&
               (led(problem, &grid, &begun, &end, 2) || led(problem, &grid, &begun, &end, 5));
    }
    if (!good) return 0;
    Stations way;
    stations(problem, &grid, &end, lam, &way);
    return margin(problem, &way) > 0.0;
}

/* Follow the state from rest and bring it to its tolerance; a `slack` one is not sought for long. Returns TAUT with the
   state in `grid`, `state`, `found` and `error`; or what it is. `found->steps` has the steps of all. */
static int from_rest(Problem *problem, const Table *const *tables, double tolerance, int slack, Grid *grid,
                     State *state, Iterate *found, double *error) {
    double end = problem->field != 0.0 ? 2.0 : 1.0;
    int64_t steps = 0;
    int unstable = 0, lost = 0;
    for (int64_t k = 0; k < (slack ? 1 : TRACES); k++) {
        Trace path;
        if (!tables[TRACE_MODES[k]]) return NEEDS_TABLE;
        follow(problem, tables[TRACE_MODES[k]], &path);
        steps += path.steps;
        /* Few modes lead smoothly past the end of a film that narrows. */
        if (k + 1 < TRACES && !slack && leans(&path.grid, &path.state)) continue;
        unstable |= path.limit;
        lost = path.reached;
        if (path.reached) {
            *grid = path.grid;
            *state = path.state;
            int settled = settle_plain(problem, tables, tolerance, 0, grid, state, found, error);
            found->steps += steps;
            steps = found->steps;
            if (settled == TAUT && problem->field != 0.0) {
                Stations way;
                stations(problem, grid, state, found->lam, &way);
                if (!(margin(problem, &way) > 0.0)) return slack ? SLACK : UNSTABLE;
            }
            if (settled != UNSETTLED) return settled;
        } else if (path.limit && !(path.progress > end - 1.0 && path.progress > end - CLOSE))
            break;
    }
    found->steps = steps;
    return slack ? SLACK : lost ? LEFT_TO_OTHERS : unstable ? UNSTABLE : NOT_CONVERGED;
}

#endif
