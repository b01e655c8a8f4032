/* Taut states side by side, one in every lane: what `refine` and `extremes` do with one state after the other.

   States that go on at the same resolution are taken together, whatever brought them there. */
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
    Grid grid;
    State state;
    Real previous;
} Pack;

static Mask lanes_where(const Pack *pack, int64_t status) {
    Mask these;
    for (int64_t k = 0; k < LANES; k++) these[k] = -(int64_t)(k < pack->members && pack->of[k]->status == status);
    return these;
}

static void take_up(Pack *pack, int64_t modes) {
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
    }
    problem->counts = lanes_where(pack, OPEN);
    problem->mechanical = problem->electric = problem->relaxed = counted(problem->counts, 0);
    lay(&pack->grid, pack->task->tables[modes], modes, -problem->span, of(0.0));
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

static void go_on(Pack *pack, int64_t modes) {
    for (int64_t k = 0; k < LANES; k++) {
        const One *one = pack->of[k];
        for (int64_t i = 0; i < modes; i++) pack->state.c[i][k] = one->c[i];
        for (int64_t i = 0; i < pack->grid.table->points; i++) pack->state.w[i][k] = one->w[i];
    }
}

static void put_down(const Pack *pack, int64_t lane, const Table *table) {
    One *one = pack->of[lane];
    one->modes = table->modes;
    for (int64_t i = 0; i < table->modes; i++) one->c[i] = pack->state.c[i][lane];
    for (int64_t i = 0; i < table->points; i++) one->w[i] = pack->state.w[i][lane];
}

static int64_t judged(const Task *task, const Table *table, double hoop, int64_t ok, double error) {
    if (task->relaxed && hoop <= CLEARLY_NEGATIVE) return FOLDED;
    if (!ok) return UNSETTLED;
    if (error <= task->tolerance) return TAUT;
    if (table->next > MOST_MODES) return UNSETTLED;
    return task->tables[table->next] ? OPEN : NEEDS_TABLE;
}

/* Numbers of one lane, from a structure of nothing but these. */
static void lane_of(const void *all, int64_t lane, int64_t numbers, double *out) {
    for (int64_t i = 0; i < numbers; i++) {
        Real number;
        memcpy(&number, (const char *)all + (size_t)i * sizeof(Real), sizeof(Real));
        out[i] = number[lane];
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
    for (int64_t k = 0; k < pack->members; k++) {
        if (pack->of[k]->status != TAUT) continue;
        lane_of(&x, k, EXTREMES, pack->of[k]->extremes);
        if (pack->task->sensitivities) lane_of(&d, k, DERIVATIVES, pack->of[k]->derivatives);
    }
}

/* Newton at one resolution, and what follows from it. */
static void settle_several(Pack *pack, int64_t modes) {
    const Task *task = pack->task;
    const Table *table = task->tables[modes];
    int64_t settled = 0, open = 0;
    take_up(pack, modes);
    if (pack->of[0]->steps == 0)
        begin(pack);
    else
        go_on(pack, modes);
    Iterate found = newton(&pack->problem, &pack->grid, &pack->state, goal(task->tolerance), MOST_STEPS);
    Real error = estimate(&found, pack->previous, task->tolerance, LEVEL_FACTOR);
    for (int64_t k = 0; k < pack->members; k++) {
        One *one = pack->of[k];
        if (one->status != OPEN) continue;
        one->steps += found.steps[k];
        one->lam = found.lam[k];
        one->error = error[k];
        one->status = judged(task, table, found.hoop[k], found.ok[k], error[k]);
        settled += one->status == TAUT;
        open += one->status == OPEN;
        if (one->status != OPEN) put_down(pack, k, table);
    }
    if (settled) tell(pack, found.lam);
    for (int64_t k = 0; k < pack->members; k++) {
        pack->of[k]->mechanical += pack->problem.mechanical[k];
        pack->of[k]->electric += pack->problem.electric[k];
    }
    if (!open) return;
    const Table *next = task->tables[table->next];
    prolong(table, next, table->carry, &pack->state);
    for (int64_t k = 0; k < pack->members; k++) {
        if (pack->of[k]->status != OPEN) continue;
        pack->of[k]->previous = pack->of[k]->lam;
        put_down(pack, k, next);
    }
}

static int go_together(const One *one, const One *other) {
    return one->posed.law.kind == other->posed.law.kind && one->posed.law.moduli == other->posed.law.moduli &&
           (one->steps == 0) == (other->steps == 0);
}

/* Of the states that are open. */
static int64_t fewest_modes(const One *states, int64_t count) {
    int64_t fewest = MOST_MODES + 1;
    for (int64_t s = 0; s < count; s++)
        if (states[s].status == OPEN && states[s].modes < fewest) fewest = states[s].modes;
    return fewest;
}

void SOLVE_SEVERAL(const Task *task, One *states, int64_t count) {
    for (int64_t s = 0; s < count; s++) {
        One *one = &states[s];
        one->status = OPEN;
        one->modes = modes_to_begin_with(task, one->posed.span);
        if (!task->tables[one->modes]) one->status = NEEDS_TABLE;
        one->steps = one->mechanical = one->electric = one->slack = 0;
        one->previous = NAN;
    }
    for (int64_t modes = fewest_modes(states, count); modes <= MOST_MODES; modes = fewest_modes(states, count))
        for (int64_t first = 0; first < count; first++) {
            Pack pack;
            pack.task = task;
            pack.members = 0;
            for (int64_t s = first; s < count && pack.members < LANES; s++)
                if (states[s].status == OPEN && states[s].modes == modes &&
                    (pack.members == 0 || go_together(pack.of[0], &states[s])))
                    pack.of[pack.members++] = &states[s];
            if (pack.members == 0) break;
            for (int64_t k = pack.members; k < LANES; k++) pack.of[k] = pack.of[0];
            settle_several(&pack, modes);
        }
}
