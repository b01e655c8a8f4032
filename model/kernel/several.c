/* States side by side, one in every lane: what `refine`, `refine_cut` and `extremes` do with one state after the other.

   States that go on at the same resolution, with the same zones, are taken together, whatever brought them there. */
#ifndef LANES
#define LANES 2
#define SOLVE_SEVERAL solve_several_narrow
#endif
#include "several.h"

/* States at one resolution; lanes that are left over repeat the first state and count for nothing. */
typedef struct {
    const Task *task;
    int64_t members;
    One *of[LANES];
    Problem problem;
    Grid grid; /* of the plain state */
    State state;
    Real previous, tail_before;
} Pack;

static Mask lanes_where(const Pack *pack, int64_t status) {
    Mask these;
    for (int64_t k = 0; k < LANES; k++) these[k] = -(int64_t)(k < pack->members && pack->of[k]->status == status);
    return these;
}

static void take_up(Pack *pack) {
    Problem *problem = &pack->problem;
    const FilmLaw *first = &pack->of[0]->posed.law;
    problem->law.kind = first->kind;
    problem->law.moduli = first->moduli;
    problem->law.shapes = first->shapes;
    for (int64_t k = 0; k < LANES; k++) {
        const Posed *posed = &pack->of[k]->posed;
        for (int64_t i = 0; i < first->moduli; i++) problem->law.mu[i][k] = posed->law.mu[i];
        for (int64_t i = 0; i < first->shapes; i++) problem->law.alpha[i][k] = posed->law.alpha[i];
        problem->field[k] = posed->field;
        problem->log_prestretch[k] = posed->log_prestretch;
        problem->span[k] = posed->span;
        problem->height[k] = posed->height;
        pack->previous[k] = pack->of[k]->previous;
        pack->tail_before[k] = pack->of[k]->tail_before;
    }
    problem->counts = lanes_where(pack, pack->of[0]->status);
    problem->mechanical = problem->electric = problem->relaxed = counted(problem->counts, 0);
}

/* What the law was asked for goes to the account of every state. */
static void count_up(const Pack *pack) {
    for (int64_t k = 0; k < pack->members; k++) {
        pack->of[k]->mechanical += pack->problem.mechanical[k];
        pack->of[k]->electric += pack->problem.electric[k];
        pack->of[k]->relaxed += pack->problem.relaxed[k];
    }
}

static void lay_plain(Pack *pack, int64_t modes) {
    lay(&pack->grid, pack->task->tables[modes], modes, -pack->problem.span, of(0.0));
}

/* Numbers of every lane from those of the states, and back. */
static void into_lane(const double *from, int64_t numbers, int64_t lane, Real *all) {
    for (int64_t i = 0; i < numbers; i++) all[i][lane] = from[i];
}

/* A first state; those that no tension can hold are told. */
static void begin(Pack *pack) {
    Mask slack = is_slack(&pack->problem);
    for (int64_t k = 0; k < pack->members; k++) {
        pack->of[k]->slack = slack[k] != 0;
        if (slack[k] && pack->task->relaxed) pack->of[k]->status = SLACK;
    }
    pack->problem.counts = lanes_where(pack, OPEN);
    guess(&pack->problem, &pack->grid, &pack->state);
}

static void go_on(Pack *pack) {
    const Table *table = pack->grid.table;
    for (int64_t k = 0; k < LANES; k++) {
        into_lane(pack->of[k]->c, table->modes, k, pack->state.c);
        into_lane(pack->of[k]->w, table->points, k, pack->state.w);
    }
}

static void put_down(const Pack *pack, int64_t lane, const Table *table) {
    One *one = pack->of[lane];
    one->modes = one->plain_modes = table->modes;
    one->plain_steps = one->steps;
    lane_of(pack->state.c, lane, table->modes, one->c);
    lane_of(pack->state.w, lane, table->points, one->w);
}

static int64_t judged(const Task *task, const Table *table, double hoop, int64_t ok, double error) {
    if (task->relaxed && hoop <= CLEARLY_NEGATIVE) return FOLDED;
    if (!ok) return UNSETTLED;
    if (error <= task->tolerance) return TAUT;
    if (table->next > MOST_MODES) return UNSETTLED;
    return task->tables[table->next] ? OPEN : NEEDS_TABLE;
}

/* Keep what solved states of this status say. */
static void keep(Pack *pack, int64_t status, const Extremes *x, const Derivatives *d) {
    for (int64_t k = 0; k < pack->members; k++) {
        if (pack->of[k]->status != status) continue;
        lane_of((const Real *)x, k, EXTREMES, pack->of[k]->extremes);
        if (pack->task->sensitivities) lane_of((const Real *)d, k, DERIVATIVES, pack->of[k]->derivatives);
    }
}

/* What settled states say. */
static void tell(Pack *pack, Real lam) {
    Problem *problem = &pack->problem;
    Points at;
    Extremes x;
    Derivatives d;
    problem->counts = lanes_where(pack, TAUT);
    evaluate(problem, &pack->grid, &pack->state, NULL, &at);
    Solved solved = {1, &pack->grid, &at, NULL};
    extremes(problem, &solved, lam, &x);
    if (pack->task->sensitivities) derivatives_of(problem, &pack->grid, &pack->state, &at, lam, &d);
    keep(pack, TAUT, &x, &d);
}

/* A resolution to begin with, or why there is none. */
static int64_t begun_at(const Task *task, int64_t modes) {
    if (modes > MOST_CUT_MODES) return LEFT_TO_OTHERS;
    return task->tables[modes] ? FOLDING : NEEDS_TABLE;
}

/* Where states that are wrinkled by the plain equations are to be cut. */
static void seek_zones(Pack *pack) {
    Points at;
    Cut whole;
    Tensions seen;
    pack->problem.counts = lanes_where(pack, FOLDED);
    evaluate(&pack->problem, &pack->grid, &pack->state, NULL, &at);
    uncut(&pack->grid, &pack->state, &whole);
    tensions(&whole, &at, &seen);
    for (int64_t k = 0; k < pack->members; k++) {
        One *one = pack->of[k];
        if (one->status != FOLDED) continue;
        one->status = LEFT_TO_OTHERS;
        if (!zones_now(&whole, &seen, k, &one->zones)) continue;
        one->modes = modes_for(&one->zones, pack->task->first_modes);
        one->status = begun_at(pack->task, one->modes);
        one->previous = one->tail_before = NAN;
        one->before = INFINITY;
    }
}

/* Newton at one resolution, and what follows from it. */
static void settle_several(Pack *pack, int64_t modes) {
    const Task *task = pack->task;
    const Table *table = task->tables[modes];
    int64_t count[3] = {0, 0, 0};
    take_up(pack);
    lay_plain(pack, modes);
    if (pack->of[0]->steps == 0)
        begin(pack);
    else
        go_on(pack);
    Iterate found = newton(&pack->problem, &pack->grid, &pack->state, goal(task->tolerance), MOST_STEPS);
    Real error = estimate(&found, pack->previous, pack->tail_before, task->tolerance, LEVEL_FACTOR);
    for (int64_t k = 0; k < pack->members; k++) {
        One *one = pack->of[k];
        if (one->status != OPEN) continue;
        one->steps += found.steps[k];
        one->lam = found.lam[k];
        one->tail = found.tail[k];
        one->error = error[k];
        one->status = judged(task, table, found.hoop[k], found.ok[k], error[k]);
        count[0] += one->status == TAUT;
        count[1] += one->status == FOLDED;
        count[2] += one->status == OPEN;
        if (one->status != OPEN) put_down(pack, k, table);
    }
    if (count[0]) tell(pack, found.lam);
    if (count[1]) seek_zones(pack);
    count_up(pack);
    if (!count[2]) return;
    const Table *next = task->tables[table->next];
    prolong(table, next, table->carry, &pack->state);
    for (int64_t k = 0; k < pack->members; k++) {
        if (pack->of[k]->status != OPEN) continue;
        pack->of[k]->previous = pack->of[k]->lam;
        pack->of[k]->tail_before = pack->of[k]->tail;
        put_down(pack, k, next);
    }
}

/* The elements of wrinkled states, from the plain state when they are new. */
static void cut_several(Pack *pack, const Table *table, Cut *cut) {
    const One *first = pack->of[0];
    cut->elements = first->zones.elements;
    memcpy(cut->folded, first->zones.folded, sizeof cut->folded);
    for (int64_t k = 0; k < LANES; k++) into_lane(pack->of[k]->zones.breaks, cut->elements + 1, k, cut->breaks);
    if (isnan(first->previous)) {
        Points at;
        Cut whole;
        Mask every = pack->problem.counts;
        pack->problem.counts = is_not(yes()); /* they have been counted where the zones were sought */
        lay_plain(pack, first->plain_modes);
        go_on(pack);
        evaluate(&pack->problem, &pack->grid, &pack->state, NULL, &at);
        pack->problem.counts = every;
        uncut(&pack->grid, &pack->state, &whole);
        remap(&whole, &at, table, cut);
        return;
    }
    lay_elements(cut, table);
    for (int64_t k = 0; k < LANES; k++)
        for (int64_t i = 0; i < cut->elements; i++) {
            into_lane(pack->of[k]->cut_c[i], table->modes + 2, k, cut->state[i].c);
            into_lane(pack->of[k]->cut_w[i], table->points, k, cut->state[i].w);
            into_lane(pack->of[k]->natural[i], table->points, k, cut->natural[i]);
        }
}

static void put_down_cut(const Cut *cut, int64_t lane, One *one) {
    const Table *table = cut->grid[0].table;
    one->modes = table->modes;
    breaks_of(cut, lane, one->zones.breaks);
    for (int64_t i = 0; i < cut->elements; i++) {
        lane_of(cut->state[i].c, lane, table->modes + 2, one->cut_c[i]);
        lane_of(cut->state[i].w, lane, table->points, one->cut_w[i]);
        lane_of(cut->natural[i], lane, table->points, one->natural[i]);
    }
}

/* What settled wrinkled states say; those with other zones than they were solved with go on alone. */
static void tell_cut(Pack *pack, const Cut *cut, Real lam) {
    Problem *problem = &pack->problem;
    Points at[MOST_ELEMENTS];
    Tensions seen;
    Extremes x;
    Derivatives d;
    problem->counts = lanes_where(pack, WRINKLED);
    evaluate_cut(problem, cut, at);
    tensions(cut, at, &seen);
    allow(&seen, pack->task->tolerance);
    for (int64_t k = 0; k < pack->members; k++) {
        One *one = pack->of[k];
        Zones now;
        if (one->status != WRINKLED) continue;
        int good = zones_now(cut, &seen, k, &now);
        if (good && has_zones(cut, &now, k)) continue;
        one->status = FOLDED;
        one->steps = one->plain_steps;
    }
    Solved solved = {cut->elements, cut->grid, at, cut->folded};
    extremes(problem, &solved, lam, &x);
    if (pack->task->sensitivities) cut_derivatives(problem, cut, at, lam, &d);
    keep(pack, WRINKLED, &x, &d);
}

/* Newton on wrinkled states and their cuts at one resolution, and what follows from it. */
static void settle_folding(Pack *pack, int64_t modes) {
    const Task *task = pack->task;
    const Table *table = task->tables[modes];
    int64_t solved = 0, open = 0;
    Cut cut;
    take_up(pack);
    cut_several(pack, table, &cut);
    Iterate found = settle(&pack->problem, &cut, goal(task->tolerance));
    Real error = estimate(&found, pack->previous, pack->tail_before, task->tolerance, CUT_LEVEL_FACTOR);
    for (int64_t k = 0; k < pack->members; k++) {
        One *one = pack->of[k];
        one->steps += found.steps[k];
        one->lam = found.lam[k];
        one->tail = found.tail[k];
        one->error = error[k] + of_cones(&one->zones, one->before);
        if (fabs(one->previous) < INFINITY) one->before = fabs((one->lam - one->previous) / one->lam);
        one->status = !found.ok[k]                    ? LEFT_TO_OTHERS
                      : one->error <= task->tolerance ? WRINKLED
                                                      : begun_at(task, table->next);
        solved += one->status == WRINKLED;
        open += one->status == FOLDING;
    }
    if (solved) tell_cut(pack, &cut, found.lam);
    count_up(pack);
    if (!open) return;
    prolong_cut(&cut, task->tables[table->next]);
    for (int64_t k = 0; k < pack->members; k++) {
        if (pack->of[k]->status != FOLDING) continue;
        pack->of[k]->previous = pack->of[k]->lam;
        pack->of[k]->tail_before = pack->of[k]->tail;
        put_down_cut(&cut, k, pack->of[k]);
    }
}

static int go_together(const One *one, const One *other) {
    if (one->posed.law.kind != other->posed.law.kind || one->posed.law.moduli != other->posed.law.moduli) return 0;
    if (one->status == OPEN) return (one->steps == 0) == (other->steps == 0);
    return one->zones.elements == other->zones.elements && one->zones.folded[0] == other->zones.folded[0] &&
           one->plain_modes == other->plain_modes && isnan(one->previous) == isnan(other->previous);
}

/* Of the states that have this status. */
static int64_t fewest_modes(const One *states, int64_t count, int64_t status) {
    int64_t fewest = MOST_MODES + 1;
    for (int64_t s = 0; s < count; s++)
        if (states[s].status == status && states[s].modes < fewest) fewest = states[s].modes;
    return fewest;
}

/* Take the states of this status from resolution to resolution until none has it. */
static void advance_all(const Task *task, One *states, int64_t count, int64_t status) {
    int64_t modes;
    while ((modes = fewest_modes(states, count, status)) <= MOST_MODES)
        for (int64_t first = 0; first < count; first++) {
            Pack pack;
            pack.task = task;
            pack.members = 0;
            for (int64_t s = first; s < count && pack.members < LANES; s++)
                if (states[s].status == status && states[s].modes == modes &&
                    (pack.members == 0 || go_together(pack.of[0], &states[s])))
                    pack.of[pack.members++] = &states[s];
            if (pack.members == 0) break;
            for (int64_t k = pack.members; k < LANES; k++) pack.of[k] = pack.of[0];
            if (status == OPEN)
                settle_several(&pack, modes);
            else
                settle_folding(&pack, modes);
        }
}

void SOLVE_SEVERAL(const Task *task, One *states, int64_t count) {
    for (int64_t s = 0; s < count; s++) {
        One *one = &states[s];
        one->modes = one->plain_modes = modes_to_begin_with(task, one->posed.span);
        one->status = task->tables[one->modes] ? OPEN : NEEDS_TABLE;
        one->steps = one->mechanical = one->electric = one->relaxed = one->slack = 0;
        one->previous = one->tail_before = NAN;
    }
    advance_all(task, states, count, OPEN);
    advance_all(task, states, count, FOLDING);
}
