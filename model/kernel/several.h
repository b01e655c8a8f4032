/* States of taut films side by side: what membrane.c hands to several.c. */
#ifndef DEA_SEVERAL_H
#define DEA_SEVERAL_H

#include "output.h"

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
    int64_t status; /* what `refine` says of it, SLACK, or OPEN */
    int64_t slack, modes, steps, mechanical, electric;
    double lam, previous, error;
    double c[MOST_FUNCTIONS], w[MOST_POINTS];
    double extremes[EXTREMES], derivatives[DERIVATIVES]; /* of a TAUT one: `Extremes` and `Derivatives` */
} One;

static inline int64_t modes_to_begin_with(const Task *task, double span) {
    return task->first_modes[span <= 2.4 ? 0 : span <= 3.1 ? 1 : 2];
}

/* Whether processor and system have registers for four numbers; told when the library is loaded. */
extern int four_at_once;

void solve_several_narrow(const Task *task, One *states, int64_t count);
void solve_several_wide(const Task *task, One *states, int64_t count);

#endif
