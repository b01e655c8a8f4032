/* Whether a taut state that the voltage softens is on the branch that starts at rest: `connected` in
   model/membrane/from_rest.py, with what it takes from convexity.py and continuation.py. */
#ifndef DEA_CONNECTED_H
#define DEA_CONNECTED_H

#include "output.h"

enum {
    CHECK_MODES = 6,
    CHECK_POINTS = CHECK_MODES + 3,
    WAY_STEPS = 8,
    BETWEEN = 4
};
enum {
    STATIONS = BETWEEN * (CHECK_POINTS + 1) + 1
};
#define WAY_GOAL 3e-2
#define CORRECTION 0.3
#define SAFE 0.96

/* Whether the energy is convex from the taut film with r = R to this state, at every point: whether one multiple of e
   q, whose integral over a clamped film is zero, makes every point convex. */
static int between(Problem *problem, const Grid *grid, const State *state) {
    double e1[MOST_POINTS], q1[MOST_POINTS], low = -INFINITY, high = INFINITY;
    strain(grid, state->c, e1, q1);
    for (int64_t k = 0; k < 3; k++) {
        for (int64_t i = 0; i < grid->table->points; i++) {
            double share = 0.5 * (double)k, e = share * e1[i], p = 1.0 + share * q1[i], w = state->w[i];
            double metric = p * p + w * w, along = p / metric, down = w / metric, around = 1.0 / (1.0 + e);
            Stress law;
            stress_at(problem, 0.5 * log_of(metric) + problem->log_prestretch, log1p_of(e) + problem->log_prestretch,
                      &law);
            double tm = law.t1[0] / metric, d = law.h11[0] - 2.0 * law.t1[0], h12 = law.h12[0];
            double qw = d * along * down, ww = d * down * down + tm, we = h12 * down * around;
            /* The slope is eliminated, as Newton does it. */
            double qq = d * along * along + tm - qw * qw / ww;
            double qe = h12 * along * around - qw * we / ww;
            double ee = (law.h22[0] - law.t2[0]) * around * around - we * we / ww;
            if (!(ww > 0.0 && qq > 0.0 && ee > 0.0)) return 0;
            double room = SAFE * sqrt(qq * ee);
            low = larger(low, -qe - room);
            high = smaller(high, room - qe);
        }
    }
    return low < high;
}

/* Least of the values along `x`, of the parabola through the least and its neighbours. */
static double least_of(int64_t n, const double *x, const double *values) {
    int64_t lowest = 0;
    for (int64_t i = 1; i < n; i++)
        if (values[i] < values[lowest]) lowest = i;
    int64_t k = lowest < 1 ? 1 : lowest > n - 2 ? n - 2 : lowest;
    double y0 = values[k - 1], y1 = values[k], y2 = values[k + 1];
    double d01 = (y1 - y0) / (x[k] - x[k - 1]), d12 = (y2 - y1) / (x[k + 1] - x[k]);
    double curve = (d12 - d01) / (x[k + 1] - x[k - 1]), slope = d01 + curve * (x[k] - x[k - 1]);
    double dip = y1 - 0.25 * slope * slope / curve;
    /* The parabola dips below its points by no more than they differ. */
    double bound = y1 - 0.5 * larger(fabs(y0 - y1), fabs(y2 - y1));
    int inside = lowest == k && curve > 0.0 && fabs(dip) < INFINITY;
    return inside ? smaller(values[lowest], larger(dip, bound)) : values[lowest];
}

/* Least stiffness d2W-star/dl1^2 along the film, between its points too, as a share of what it is without Maxwell
   stress: positive where the law is convex. */
static double margin(Problem *problem, const Grid *grid, const State *state, double lam) {
    int64_t points = grid->table->points, n = 0;
    double log1[MOST_POINTS + 2], hoop[MOST_POINTS + 2], log[3 * STATIONS], rise[STATIONS];
    Points at;
    Edges edge;
    Stress law;
    evaluate(problem, grid, state, NULL, &at);
    Solved solved = {1, grid, &at, NULL};
    edges(problem, &solved, lam, &edge);
    memcpy(log1 + 1, at.log, sizeof(double) * (size_t)points);
    memcpy(hoop + 1, at.log + points, sizeof(double) * (size_t)points);
    log1[0] = edge.log1[0];
    log1[points + 1] = edge.log1[1];
    hoop[0] = hoop[points + 1] = problem->log_prestretch;
    for (int64_t i = 0; i < points + 2; i++)
        for (int64_t k = 0; k < (i < points + 1 ? BETWEEN : 1); k++, n++) {
            double share = (double)k / BETWEEN;
            log[n] = k ? log1[i] + share * (log1[i + 1] - log1[i]) : log1[i];
            log[STATIONS + n] = k ? hoop[i] + share * (hoop[i + 1] - hoop[i]) : hoop[i];
            log[2 * STATIONS + n] = -(log[n] + log[STATIONS + n]);
        }
    stress(problem, STATIONS, log, &law);
    for (int64_t i = 0; i < STATIONS; i++) {
        double stiffness = law.h11[i] - law.t1[i];
        rise[i] = stiffness / fabs(stiffness + law.maxwell[i]);
        if (!(fabs(rise[i]) < INFINITY)) rise[i] = -1.0;
    }
    return least_of(STATIONS, log, rise);
}

/* Largest relative distance of slopes from others. */
static double jump(int64_t n, const double *w, const double *other) {
    double most = 0.0;
    for (int64_t i = 0; i < n; i++) most = larger(most, fabs(w[i] / other[i] - 1.0));
    return most;
}

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
        good = found.ok && (led(problem, &grid, &begun, &end, 2) || led(problem, &grid, &begun, &end, 5));
    }
    return good && margin(problem, &grid, &end, lam) > 0.0;
}

#endif
