/* Following a state from rest, first h at 0 V, then V at h: model/membrane/continuation.py for the plain equations and
   a film of one element. */
#ifndef DEA_CONTINUATION_H
#define DEA_CONTINUATION_H

#include "convexity.h"

enum {
    MOST_PATH = 60,    /* steps of a path: one that needs more creeps up to its end */
    POWER_STEPS = 100, /* of the inverse iteration */
    GUESS_ROUNDS = 40
};
#define LEAST_STEP 1e-5   /* of the leg; a path that cannot be followed in such steps has ended */
#define FIRST_HEIGHT 0.02 /* share of h where the path begins */
#define CORRECTION 0.3    /* largest relative change of a slope by the corrector: more would be a jump */
#define SOFT 0.1          /* share of the first lowest eigenvalue below which a path that ends has met a limit point */

/* The end of a path. */
typedef struct {
    Grid grid;
    State state;
    double progress; /* where it ended: 0 to 1 raises the disk, 1 to 2 the voltage */
    int64_t steps;
    int reached, limit;
} Trace;

/* Largest relative distance of slopes from others. */
static double jump(int64_t n, const double *w, const double *other) {
    double most = 0.0;
    for (int64_t i = 0; i < n; i++) most = larger(most, fabs(w[i] / other[i] - 1.0));
    return most;
}

static double median(int64_t n, const double *values) {
    double sorted[MOST_POINTS];
    for (int64_t i = 0; i < n; i++) {
        int64_t k = i;
        for (; k > 0 && sorted[k - 1] > values[i]; k--) sorted[k] = sorted[k - 1];
        sorted[k] = values[i];
    }
    return n % 2 ? sorted[n / 2] : 0.5 * (sorted[n / 2 - 1] + sorted[n / 2]);
}

/* One round of `careful_guess`: every point's balance R sigma1 w/(1 + w^2) = lam is solved for ln(w). */
static void balance(Problem *problem, const Grid *grid, int64_t rounds, double *log_lam, double *log_w,
                    double *power) {
    int64_t n = grid->table->points;
    double log[3 * MOST_POINTS], part[MOST_POINTS], pull[MOST_POINTS], most = INFINITY;
    Stress law;
    for (int64_t k = 0; k < rounds && most > 1e-6; k++) {
        for (int64_t i = 0; i < n; i++) {
            double w = exp_of(log_w[i]), square = w * w;
            part[i] = square / (1.0 + square);
            pull[i] = grid->radius[i] * w / (1.0 + square);
            log[i] = 0.5 * log1p_of(square) + problem->log_prestretch;
            log[n + i] = problem->log_prestretch;
            log[2 * n + i] = -(log[i] + log[n + i]);
        }
        stress(problem, n, log, &law);
        for (int64_t i = 0; i < n; i++) {
            pull[i] = log_of(law.t1[i] < 1e-300 ? 1e-300 : law.t1[i]) + log_of(pull[i]);
            power[i] = larger(1.0 - 2.0 * part[i] + part[i] * law.h11[i] / law.t1[i], 0.2);
        }
        if (!(fabs(*log_lam) < INFINITY)) *log_lam = median(n, pull);
        most = 0.0;
        for (int64_t i = 0; i < n; i++) {
            double step = (*log_lam - pull[i]) / power[i];
            log_w[i] += clipped(step, 0.7);
            most = larger(most, fabs(step));
        }
    }
}

/* The first state with r = R held exactly, lam being solved for the height; that of `guess` where there is none. */
static void careful_guess(Problem *problem, const Grid *grid, State *state) {
    int64_t n = grid->table->points;
    double log_w[MOST_POINTS], w[MOST_POINTS], power[MOST_POINTS], log_lam = NAN, miss = INFINITY, total = 0.0;
    guess(problem, grid, state);
    for (int64_t i = 0; i < n; i++) log_w[i] = log_of(smaller(state->w[i], 1.0));
    for (int64_t round = 0; round < GUESS_ROUNDS && fabs(miss) > 1e-3; round++) {
        double reach = 0.0, give = 0.0;
        balance(problem, grid, round == 0 ? 30 : 6, &log_lam, log_w, power);
        for (int64_t i = 0; i < n; i++) {
            w[i] = exp_of(log_w[i]);
            reach += grid->once[i] * w[i];
            give += grid->once[i] * w[i] / power[i];
        }
        miss = log_of(problem->height / reach);
        log_lam += clipped(miss / (give / reach), 2.0);
    }
    double scale = problem->height / dot(n, grid->once, w);
    for (int64_t i = 0; i < n; i++) total += w[i] * scale;
    if (!(fabs(total) < INFINITY)) return;
    for (int64_t i = 0; i < n; i++) state->w[i] = w[i] * scale;
}

/* Put the problem at a place of its path. */
static void go_to(Problem *problem, double height, double field, double progress) {
    double rise = smaller(progress, 1.0);
    problem->height = rise < 1.0 ? height * exp_of((1.0 - rise) * log_of(FIRST_HEIGHT)) : height;
    problem->field = field * smaller(larger(progress - 1.0, 0.0), 1.0);
}

/* The reduced Hessian less `shift`, factored; whether it is positive definite, and the slopes stable. */
static int above(Problem *problem, const Grid *grid, const State *state, double shift, Reduced *system) {
    Points at;
    int64_t modes = grid->table->modes;
    evaluate(problem, grid, state, NULL, &at);
    reduce(grid, state->w, &at, system);
    for (int64_t i = 0; i < modes; i++) system->matrix[i * (i + 1) / 2 + i] -= shift;
    return factor(modes, system->coupling, system->give, system->matrix, system->diagonal) && system->positive;
}

/* Smallest eigenvalue of the reduced Hessian, by inverse iteration; 0 where the state is not stable. */
static double lowest(Problem *problem, const Grid *grid, const State *state) {
    Reduced system;
    int64_t modes = grid->table->modes;
    double x[MOST_FUNCTIONS], value = INFINITY, before;
    if (!above(problem, grid, state, 0.0, &system)) return 0.0;
    for (int64_t i = 0; i < modes; i++) x[i] = 1.0 / (double)(i + 1);
    for (int64_t k = 0; k < POWER_STEPS; k++) {
        double size = sqrt(dot(modes, x, x));
        before = value;
        for (int64_t i = 0; i < modes; i++) x[i] /= size;
        substitute(modes, system.matrix, x);
        value = 1.0 / sqrt(dot(modes, x, x));
        if (fabs(value - before) <= 1e-10 * value) break;
    }
    return value;
}

/* One step of a path from `here` to `aim`, predicted by the step `before` it. Returns whether it was made; `found` has
   the state, `jumped` how far the corrector went, `least` the stiffness on the way. */
static int path_step(Problem *problem, const Grid *grid, const State *here, const State *before, double ratio,
                     int charged, int64_t *steps, State *found, double *jumped, double *least) {
    int64_t n = grid->table->points;
    double w[MOST_POINTS];
    *found = *here;
    for (int64_t i = 0; i < n; i++) w[i] = larger(here->w[i] + ratio * (here->w[i] - before->w[i]), 0.3 * here->w[i]);
    double scale = problem->height / dot(n, grid->once, w);
    for (int64_t i = 0; i < n; i++) found->w[i] = w[i] = w[i] * scale;
    for (int64_t k = 0; k < grid->table->modes; k++) found->c[k] = here->c[k] + ratio * (here->c[k] - before->c[k]);
    Iterate last = newton(problem, grid, found, 1e-3, 8);
    *steps += last.steps;
    *jumped = jump(n, found->w, w);
    *least = INFINITY;
    if (!(last.ok && *jumped < CORRECTION)) return 0;
    if (!charged) return 1;
    Stations new, old, middle;
    stations(problem, grid, found, last.lam, &new);
    stations(problem, grid, here, last.lam, &old);
    half_way(&old, &new, &middle);
    /* A step that carries points over a range that is not convex is not a step along a branch. */
    *least = smaller(margin(problem, &new), margin(problem, &middle));
    return *least > 0.0;
}

/* Whether the film narrows below its disk: it may be one that nothing leads to from rest. */
static int leans(const Grid *grid, const State *state) {
    double e[MOST_POINTS], q[MOST_POINTS];
    strain(grid, state->c, e, q);
    for (int64_t i = 0; i < grid->table->points; i++)
        if (q[i] <= -1.0) return 1;
    return 0;
}

/* Follow a state along its path, in steps that it chooses by itself. */
static void follow(Problem *problem, const Table *table, Trace *out) {
    double height = problem->height, field = problem->field, end = field != 0.0 ? 2.0 : 1.0;
    double size = 0.5, before_progress, jumped, least;
    State *here = &out->state, before, found;
    int alive, concave = 0;
    lay(&out->grid, table, table->modes, -problem->span, 0.0);
    /* Most states are found at once at their height without voltage; the others begin low. */
    out->progress = 1.0;
    go_to(problem, height, field, out->progress);
    careful_guess(problem, &out->grid, here);
    Iterate first = newton(problem, &out->grid, here, 1e-3, 15);
    out->steps = first.steps;
    if (!first.ok || leans(&out->grid, here)) {
        out->progress = 0.0;
        go_to(problem, height, field, out->progress);
        careful_guess(problem, &out->grid, here);
        first = newton(problem, &out->grid, here, 1e-3, 25);
        out->steps += first.steps;
    }
    alive = first.ok;
    double begun = alive ? lowest(problem, &out->grid, here) : 0.0;
    before = *here;
    before_progress = out->progress;
    for (int64_t k = 0; k < MOST_PATH && alive && out->progress < end; k++) {
        double aim = smaller(out->progress + size, out->progress < 1.0 ? 1.0 : 2.0);
        double run = out->progress - before_progress, ratio = run > 0.0 ? (aim - out->progress) / run : 0.0;
        go_to(problem, height, field, aim);
        int good =
            path_step(problem, &out->grid, here, &before, ratio, aim > 1.0, &out->steps, &found, &jumped, &least);
        if (good) {
            before = *here;
            *here = found;
            /* At the corner another direction begins: the last step predicts nothing. */
            before_progress = out->progress < 1.0 && aim >= 1.0 ? aim : out->progress;
            out->progress = aim;
            if (jumped < 0.3 * CORRECTION) size *= 2.0;
            concave = 0;
        } else {
            size *= 0.35;
            /* Where the law loses convexity in a step that may not be shorter, the branch has ended there. */
            if (least <= 0.0) concave = 1;
        }
        if (size < LEAST_STEP) alive = 0;
    }
    out->reached = alive && out->progress >= end;
    out->limit = concave;
    if (begun > 0.0) {
        Reduced system;
        go_to(problem, height, field, out->progress);
        if (!above(problem, &out->grid, here, SOFT * begun, &system)) out->limit = 1;
    }
    problem->height = height;
    problem->field = field;
}

#endif
