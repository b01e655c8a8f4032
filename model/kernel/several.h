/* States side by side: what membrane.c hands to several.c. */
#ifndef DEA_SEVERAL_H
#define DEA_SEVERAL_H

#include "tension_field.h"

enum {
    EXTREMES = sizeof(Extremes) / sizeof(Real),
    DERIVATIVES = sizeof(Derivatives) / sizeof(Real),
};

/* What all states of a call share: _Task of model/membrane/compiled.py. */
typedef struct {
    const Table *tables[MOST_MODES + 1]; /* one of so many modes at that place, or none */
    int64_t first_modes[3];              /* to begin with, for films up to the spans 2.4, 3.1 and 4 */
    int64_t relaxed, sensitivities;
    int64_t lanes; /* at most so many states side by side; 0: as many as this processor takes at once */
    double tolerance;
} Task;

/* A state on its way over the resolutions. */
typedef struct {
    Posed posed;
    int64_t status; /* OPEN, FOLDING; then what `refine` says of it, SLACK or WRINKLED */
    int64_t slack, modes, steps, mechanical, electric, relaxed;
    double lam, previous, tail, tail_before, before, error;
    /* The plain state. */
    int64_t plain_modes, plain_steps;
    double c[MOST_FUNCTIONS], w[MOST_POINTS];
    /* And the wrinkled one. */
    Zones zones;
    double cut_c[MOST_ELEMENTS][MOST_CUT_MODES + 2];
    double cut_w[MOST_ELEMENTS][MOST_CUT_MODES + 3], natural[MOST_ELEMENTS][MOST_CUT_MODES + 3];
    double extremes[EXTREMES], derivatives[DERIVATIVES]; /* `Extremes` and `Derivatives` of a solved one */
} One;

static inline int64_t modes_to_begin_with(const Task *task, double span) {
    return task->first_modes[span <= 2.4 ? 0 : span <= 3.1 ? 1 : 2];
}

/* Whether processor and system have registers for four numbers; told when the library is loaded. */
extern int four_at_once;

void solve_several_narrow(const Task *task, One *states, int64_t count);
void solve_several_wide(const Task *task, One *states, int64_t count);

#endif
