/* Whether the law under its voltage rises with the meridional stretch at every point of a taut film and between them:
   model/membrane/convexity.py without wrinkled zones. */
#ifndef DEA_CONVEXITY_H
#define DEA_CONVEXITY_H

#include "output.h"

enum {
    BETWEEN = 4, /* pieces of the way from one point to the next */
    MOST_WAY = BETWEEN * (MOST_POINTS + 1) + 1
};
#define SAFE 0.96 /* of the coupling that would make the energy flat */

/* Log stretches along the film from the disk to the ring. */
typedef struct {
    int64_t count;
    double log1[MOST_WAY], hoop[MOST_WAY];
} Stations;

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

/* The points, both edges, and the ways between them cut in pieces. */
static void stations(Problem *problem, const Grid *grid, const State *state, double lam, Stations *out) {
    int64_t points = grid->table->points, n = 0;
    double log1[MOST_POINTS + 2], hoop[MOST_POINTS + 2];
    Points at;
    Edges edge;
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
            out->log1[n] = k ? log1[i] + share * (log1[i + 1] - log1[i]) : log1[i];
            out->hoop[n] = k ? hoop[i] + share * (hoop[i + 1] - hoop[i]) : hoop[i];
        }
    out->count = n;
}

/* Stations half way between those of two states. */
static void half_way(const Stations *one, const Stations *two, Stations *out) {
    out->count = one->count;
    for (int64_t i = 0; i < one->count; i++) {
        out->log1[i] = one->log1[i] + 0.5 * (two->log1[i] - one->log1[i]);
        out->hoop[i] = one->hoop[i] + 0.5 * (two->hoop[i] - one->hoop[i]);
    }
}

/* Least stiffness d2W-star/dl1^2 along the film, as a share of what it is without Maxwell stress: positive where the
   law is convex. */
static double margin(Problem *problem, const Stations *found) {
    double log[3 * MOST_STATIONS], rise[MOST_WAY];
    Stress law;
    for (int64_t first = 0; first < found->count; first += MOST_STATIONS) {
        int64_t n = found->count - first < MOST_STATIONS ? found->count - first : MOST_STATIONS;
        for (int64_t i = 0; i < n; i++) {
            log[i] = found->log1[first + i];
            log[n + i] = found->hoop[first + i];
            log[2 * n + i] = -(log[i] + log[n + i]);
        }
        stress(problem, n, log, &law);
        for (int64_t i = 0; i < n; i++) {
            double stiffness = law.h11[i] - law.t1[i], share = stiffness / fabs(stiffness + law.maxwell[i]);
            rise[first + i] = fabs(share) < INFINITY ? share : -1.0;
        }
    }
    return least_of(found->count, found->log1, rise);
}

#endif
