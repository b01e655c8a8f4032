/* The membrane's equilibrium, many states after one another: the kernel of model/membrane/solve.py.

   It treats films of one element by the plain equations, followed from rest where the voltage softens them, and by the
   relaxed energy where it does not; every other state is left to the methods for arrays (LEFT_TO_OTHERS). Each state is
   solved by itself with memory of its own on the stack, so that nothing depends on the others. */
#include "from_rest.h"
#include "several.h"

#ifndef SOLVE
#define SOLVE solve_narrow
#define WITH_EXPORTS
#endif

enum {
    BLOCK = 64 /* states that are under way together */
};
#define TWO_PI 6.28318530717958647693
#define SOFTENING 0.35
#define FLAT_HEIGHT 1e-9 /* h/b at which the limit of the flat film is solved */

/* A film in SI units: `record` in film.py. */
typedef struct {
    double disk_radius, ring_radius, thickness, prestretch, shear_modulus, eps_r, permittivity;
    FilmLaw law;
} Film;

/* Derivatives of the force in SI units. */
typedef struct {
    double h, voltage, disk_radius, ring_radius, thickness, prestretch, eps_r;
    double mu[MOST_PARAMETERS], alpha[MOST_PARAMETERS];
} Slopes;

/* What is found of a state, in SI units: _Answer of model/membrane/compiled.py. */
typedef struct {
    double force, peak_field, peak_field_radius, min_hoop_stress, min_meridional_stress, max_stretch, error_estimate;
    double lam; /* the force over its unit */
    int64_t status, iterations, modes, mechanical, electric, relaxed;
    Slopes dforce;
} Answer;

/* The unknowns of a solved state: modes of every element and then the strains at its ends, slopes, natural widths. */
typedef struct {
    int64_t elements, folded[MOST_ELEMENTS];
    double breaks[MOST_ELEMENTS + 1];
    State state[MOST_ELEMENTS];
    double natural[MOST_ELEMENTS][MOST_POINTS];
} Kept;

static double sign_of(double x) { return x > 0.0 ? 1.0 : x < 0.0 ? -1.0 : 0.0; }

static int is_positive(double x) { return x > 0.0 && x < INFINITY; }

static int is_film(const Film *film) {
    return is_law(&film->law) && is_positive(film->disk_radius) && film->disk_radius < film->ring_radius &&
           is_positive(film->ring_radius) && is_positive(film->thickness) && is_positive(film->prestretch) &&
           is_positive(film->shear_modulus) && is_positive(film->eps_r) && is_positive(film->permittivity);
}

/* The state in dimensionless form; returns whether it makes sense, and is one for the kernel. */
static int pose(const Film *film, double h, double voltage, Posed *posed) {
    if (!is_film(film) || !(fabs(h) < INFINITY) || !(fabs(voltage) < INFINITY)) return 0;
    double field = voltage / film->thickness;
    posed->law = film->law;
    for (int64_t k = 0; k < film->law.moduli; k++) posed->law.mu[k] = film->law.mu[k] / film->shear_modulus;
    posed->field = film->permittivity * (field * field) / film->shear_modulus;
    posed->log_prestretch = log_of(film->prestretch);
    posed->span = log_of(film->ring_radius / film->disk_radius);
    posed->height = h == 0.0 ? FLAT_HEIGHT : fabs(h) / film->ring_radius;
    return posed->span > 0.0 && posed->span <= LONGEST && is_positive(posed->height);
}

static Problem problem_of(const Posed *posed) {
    const FilmLaw *law = &posed->law;
    Problem problem = {{law->kind, law->moduli, law->shapes, {0.0}, {0.0}}, posed->field, posed->log_prestretch,
                       posed->span, posed->height, yes(), 0, 0, 0};
    memcpy(problem.law.mu, law->mu, sizeof law->mu);
    memcpy(problem.law.alpha, law->alpha, sizeof law->alpha);
    return problem;
}

/* The answer in SI units. */
static void place(const Film *film, const Problem *problem, double h, double voltage, const Extremes *x, Answer *out) {
    double sign = sign_of(h);
    double b = film->ring_radius, t = film->thickness, lp = film->prestretch, shear = film->shear_modulus;
    out->force = TWO_PI * b * t * shear / (lp * lp) * out->lam * sign;
    out->peak_field = fabs(voltage) / t * exp_of(x->log_area);
    out->peak_field_radius = x->radius * b;
    out->min_hoop_stress = shear * x->hoop;
    out->min_meridional_stress = shear * x->meridional;
    out->max_stretch = exp_of(x->log_stretch);
    out->mechanical = problem->mechanical;
    out->electric = problem->electric;
    out->relaxed = problem->relaxed;
}

/* The derivatives in SI units. */
static void place_slopes(const Film *film, double h, double voltage, const Derivatives *d, Answer *out) {
    double sign = sign_of(h);
    double a = film->disk_radius, b = film->ring_radius, t = film->thickness;
    double lp = film->prestretch, shear = film->shear_modulus, force = out->force;
    double unit = TWO_PI * t * shear / (lp * lp), scale = b * unit * sign;
    Slopes *f = &out->dforce;
    f->h = unit * d->height;
    f->prestretch = (scale * d->log_prestretch - 2.0 * force) / lp;
    f->eps_r = scale * d->log_field / film->eps_r;
    f->voltage = voltage != 0.0 ? 2.0 * scale * d->log_field / voltage : 0.0;
    f->thickness = (force - 2.0 * scale * d->log_field) / t;
    f->disk_radius = -scale * d->span / a;
    f->ring_radius = (force - h * f->h + scale * d->span) / b;
    for (int64_t k = 0; k < film->law.moduli; k++) f->mu[k] = scale / shear * d->mu[k];
    for (int64_t k = 0; k < film->law.shapes; k++) f->alpha[k] = scale * d->alpha[k];
}

static void keep_plain(const Grid *grid, const State *state, Kept *kept) {
    kept->elements = 1;
    kept->folded[0] = 0;
    kept->breaks[0] = grid->left;
    kept->breaks[1] = grid->right;
    kept->state[0] = *state;
}

static void keep_cut(const Cut *cut, Kept *kept) {
    kept->elements = cut->elements;
    memcpy(kept->folded, cut->folded, sizeof kept->folded);
    memcpy(kept->breaks, cut->breaks, sizeof kept->breaks);
    memcpy(kept->state, cut->state, sizeof kept->state);
    memcpy(kept->natural, cut->natural, sizeof kept->natural);
}

/* Write what a solved state says; returns its status, or LEFT_TO_OTHERS where its numbers overflow. */
static int64_t place_all(const Film *film, Problem *problem, double h, double voltage, const Extremes *x,
                         const Iterate *found, int64_t modes, int wrinkled, Answer *out) {
    out->lam = found->lam;
    out->iterations = found->steps;
    out->modes = modes;
    place(film, problem, h, voltage, x, out);
    if (!(fabs(out->force) + out->peak_field + fabs(out->min_hoop_stress) + out->max_stretch < INFINITY))
        return LEFT_TO_OTHERS;
    return wrinkled ? WRINKLED : TAUT;
}

static int is_folded(const Extremes *x) { return !(x->hoop >= ROUND_OFF_TENSION * x->meridional); }

/* Whether there may be another branch near. */
static int is_doubtful(const Extremes *x) { return !(x->meridional > 0.0) || !(x->softening <= SOFTENING); }

/* A state that is wrinkled by the plain equations, at the points `at`. */
static int64_t wrinkled_answer(const Task *task, const Film *film, Problem *problem, double h, double voltage,
                               Iterate *found, const Grid *grid, const State *state, Answer *out, Kept *kept) {
    Cut cut;
    Points at[MOST_ELEMENTS];
    Extremes x;
    evaluate(problem, grid, state, NULL, &at[0]);
    int status = fold(problem, task->tables, task->first_modes, task->tolerance, grid, state, at, &cut, found,
                      &out->error_estimate);
    if (status != WRINKLED) return status;
    Solved solved = {cut.elements, cut.grid, at, cut.folded};
    extremes(problem, &solved, found->lam, &x);
    if (is_doubtful(&x)) return LEFT_TO_OTHERS; /* soft ones are followed, all */
    int64_t placed = place_all(film, problem, h, voltage, &x, found, modes_of(&cut), 1, out);
    if (task->sensitivities) {
        Derivatives d;
        cut_derivatives(problem, &cut, at, found->lam, &d);
        place_slopes(film, h, voltage, &d, out);
    }
    if (kept) keep_cut(&cut, kept);
    return placed;
}

/* A solved plain state on the branch from rest, placed. */
static int64_t plain_answer(const Task *task, const Film *film, Problem *problem, double h, double voltage,
                            const Extremes *x, const Iterate *found, const Grid *grid, const State *state,
                            const Points *at, Answer *out, Kept *kept) {
    int wrinkled = x->hoop < ROUND_OFF_TENSION * x->meridional;
    int64_t placed = place_all(film, problem, h, voltage, x, found, grid->table->modes, wrinkled, out);
    if (task->sensitivities) {
        Derivatives d;
        derivatives_of(problem, grid, state, at, found->lam, &d);
        place_slopes(film, h, voltage, &d, out);
    }
    if (kept) keep_plain(grid, state, kept);
    return placed;
}

/* A state that a cold start misses, or may have found on another branch, after so many `steps`. */
static int64_t followed_answer(const Task *task, const Film *film, Problem *problem, double h, double voltage,
                               int slack, int64_t steps, Answer *out, Kept *kept) {
    Grid grid;
    State state;
    Iterate found;
    Points at;
    Extremes x;
    if (task->relaxed) return LEFT_TO_OTHERS;
    int status = from_rest(problem, task->tables, task->tolerance, slack, &grid, &state, &found, &out->error_estimate);
    found.steps += steps;
    out->iterations = found.steps;
    if (status != TAUT) return status;
    evaluate(problem, &grid, &state, NULL, &at);
    Solved solved = {1, &grid, &at, NULL};
    extremes(problem, &solved, found.lam, &x);
    if (!(x.meridional > 0.0)) return slack ? SLACK : LEFT_TO_OTHERS;
    return plain_answer(task, film, problem, h, voltage, &x, &found, &grid, &state, &at, out, kept);
}

/* What follows from the status that `refine` gave a state after its `found->steps`. */
static int64_t continued(const Task *task, const Film *film, Problem *problem, double h, double voltage, int slack,
                         int64_t status, Iterate *found, const Grid *grid, const State *state, Answer *out,
                         Kept *kept) {
    Points at;
    Extremes x;
    if (status == FOLDED) return wrinkled_answer(task, film, problem, h, voltage, found, grid, state, out, kept);
    if (status == UNSETTLED) return followed_answer(task, film, problem, h, voltage, slack, found->steps, out, kept);
    if (status != TAUT) return status;
    evaluate(problem, grid, state, NULL, &at);
    Solved solved = {1, grid, &at, NULL};
    extremes(problem, &solved, found->lam, &x);
    if (task->relaxed && is_folded(&x))
        return wrinkled_answer(task, film, problem, h, voltage, found, grid, state, out, kept);
    int doubtful = is_doubtful(&x);
    if (doubtful && x.meridional > 0.0)
        doubtful = !connected(problem, task->tables[CHECK_MODES], grid, state, found->lam);
    if (doubtful) return followed_answer(task, film, problem, h, voltage, slack, found->steps, out, kept);
    return plain_answer(task, film, problem, h, voltage, &x, found, grid, state, &at, out, kept);
}

/* One state. Returns its status; `out` has numbers where that is TAUT or WRINKLED. */
static int64_t answer(const Task *task, const Film *film, double h, double voltage, Answer *out, Kept *kept) {
    Posed posed;
    Grid grid;
    State state;
    Iterate found;
    if (!pose(film, h, voltage, &posed)) return LEFT_TO_OTHERS;
    Problem problem = problem_of(&posed);
    /* The plain equations may still have a state with compression around and tension along the film. */
    int slack = is_slack(&problem);
    out->iterations = 0;
    if (slack && task->relaxed) return SLACK;
    int status = refine(&problem, task->tables, modes_to_begin_with(task, posed.span), task->tolerance,
                        task->relaxed != 0, &grid, &state, &found, &out->error_estimate);
    return continued(task, film, &problem, h, voltage, slack, status, &found, &grid, &state, out, kept);
}

/* The same of a state that `solve_several` has brought so far. */
static int64_t completed(const Task *task, const Film *film, double h, double voltage, const One *one, Answer *out) {
    Grid grid;
    State state;
    Extremes x;
    Derivatives d;
    Iterate found = {one->lam, NAN, NAN, NAN, one->steps, one->status == TAUT};
    Problem problem = problem_of(&one->posed);
    problem.mechanical = one->mechanical;
    problem.electric = one->electric;
    problem.relaxed = one->relaxed;
    out->iterations = one->steps;
    out->error_estimate = one->error;
    if (one->status == SLACK || one->status == NEEDS_TABLE || one->status == LEFT_TO_OTHERS) return one->status;
    if (one->status == TAUT || one->status == WRINKLED) {
        int relaxed = one->status == WRINKLED;
        memcpy(&x, one->extremes, sizeof x);
        if (relaxed && is_doubtful(&x)) return LEFT_TO_OTHERS; /* soft ones are followed, all */
        if (relaxed || (!is_doubtful(&x) && !(task->relaxed && is_folded(&x)))) {
            int wrinkled = relaxed || x.hoop < ROUND_OFF_TENSION * x.meridional;
            int64_t placed = place_all(film, &problem, h, voltage, &x, &found, one->modes, wrinkled, out);
            memcpy(&d, one->derivatives, sizeof d);
            if (task->sensitivities) place_slopes(film, h, voltage, &d, out);
            return placed;
        }
    }
    lay(&grid, task->tables[one->plain_modes], one->plain_modes, -problem.span, 0.0);
    memcpy(state.c, one->c, sizeof state.c);
    memcpy(state.w, one->w, sizeof state.w);
    return continued(task, film, &problem, h, voltage, (int)one->slack, one->status, &found, &grid, &state, out, NULL);
}

/* A state without numbers. */
static void leave_blank(Answer *out) {
    out->force = out->peak_field = out->peak_field_radius = out->min_hoop_stress = NAN;
    out->min_meridional_stress = out->max_stretch = out->error_estimate = out->lam = NAN;
    out->modes = out->mechanical = out->electric = out->relaxed = 0;
    Slopes *f = &out->dforce;
    f->h = f->voltage = f->disk_radius = f->ring_radius = f->thickness = f->prestretch = f->eps_r = NAN;
    for (int64_t k = 0; k < MOST_PARAMETERS; k++) f->mu[k] = f->alpha[k] = NAN;
}

static int is_task(const Task *task) {
    for (int64_t modes = 0; modes <= MOST_MODES; modes++) {
        const Table *table = task->tables[modes];
        if (table && (modes < 2 || table->modes != modes || table->points != modes + 3 || table->next <= modes))
            return 0;
    }
    for (int64_t k = 0; k < 3; k++)
        if (task->first_modes[k] < 2 || task->first_modes[k] > MOST_MODES) return 0;
    if (!task->tables[CHECK_MODES]) return 0;
    return task->tolerance >= 1e-12 && task->tolerance <= 1e-2;
}

/* Whether four numbers at once may be computed. */
static int is_wide(const Task *task) { return four_at_once && (task->lanes == 0 || task->lanes > 2); }

/* States side by side, `which` of a call's films they are of, and where their answers go. */
static void solve_block(const Task *task, const Film *films, int64_t film_count, const int64_t *which, int64_t states,
                        const double *h, const double *voltage, Answer *answers) {
    One ones[BLOCK];
    int64_t place[BLOCK], count = 0;
    for (int64_t s = 0; s < states; s++) {
        int good = which[s] >= 0 && which[s] < film_count;
        if (good && pose(&films[which[s]], h[s], voltage[s], &ones[count].posed)) place[count++] = s;
    }
    if (is_wide(task))
        solve_several_wide(task, ones, count);
    else
        solve_several_narrow(task, ones, count);
    for (int64_t k = 0; k < count; k++) {
        int64_t s = place[k];
        answers[s].status = completed(task, &films[which[s]], h[s], voltage[s], &ones[k], &answers[s]);
    }
}

/* Solve the states (films[which[s]], h[s], voltage[s]), in SI units; `kept` takes their unknowns, or is NULL. Returns
   how many states have no answer here, or -1 where the task itself makes no sense. */
int64_t SOLVE(const Task *task, const Film *films, int64_t film_count, const int64_t *which, int64_t states,
              const double *h, const double *voltage, Answer *answers, Kept *kept) {
    int64_t left = 0, alone = kept || states < 2 || task->lanes == 1;
    if (!is_task(task)) return -1;
    for (int64_t s = 0; s < states; s++) answers[s].status = LEFT_TO_OTHERS;
    for (int64_t s = 0; s < states && alone; s++)
        if (which[s] >= 0 && which[s] < film_count)
            answers[s].status =
                answer(task, &films[which[s]], h[s], voltage[s], &answers[s], kept ? &kept[s] : NULL);
    for (int64_t s = 0; s < states && !alone; s += BLOCK)
        solve_block(task, films, film_count, which + s, states - s < BLOCK ? states - s : BLOCK, h + s, voltage + s,
                    answers + s);
    for (int64_t s = 0; s < states; s++) {
        if (answers[s].status < 0) answers[s].iterations = 0, left++;
        if (answers[s].status < 0 || answers[s].status > WRINKLED) leave_blank(&answers[s]);
    }
    return left;
}

#ifdef WITH_EXPORTS /* membrane_wide.c has no more than what stands above */

#ifdef _WIN32
#define EXPORT __declspec(dllexport)
#else
#define EXPORT __attribute__((visibility("default")))
#endif

int64_t solve_wide(const Task *task, const Film *films, int64_t film_count, const int64_t *which, int64_t states,
                   const double *h, const double *voltage, Answer *answers, Kept *kept);

/* `SOLVE` as this processor does it. */
EXPORT int64_t dea_kernel_solve(const Task *task, const Film *films, int64_t film_count, const int64_t *which,
                                int64_t states, const double *h, const double *voltage, Answer *answers, Kept *kept) {
    return (is_wide(task) ? solve_wide : solve_narrow)(task, films, film_count, which, states, h, voltage, answers,
                                                       kept);
}

/* One state and what is found of it: `One` in model/membrane/compiled.py. */
typedef struct {
    double h, voltage;
    Answer answer;
    Kept kept;
} Single;

/* Solve one state; returns its status. */
EXPORT int64_t dea_kernel_solve_one(const Task *task, const Film *film, Single *one) {
    const int64_t first = 0;
    dea_kernel_solve(task, film, 1, &first, 1, &one->h, &one->voltage, &one->answer, &one->kept);
    return one->answer.status;
}

/* Whether no tension can hold the film: 1 or 0, or -1 where that is left to others. */
EXPORT int64_t dea_kernel_hangs_slack(const Film *film, double h, double voltage) {
    Posed posed;
    if (!pose(film, h, voltage, &posed)) return -1;
    Problem problem = problem_of(&posed);
    return is_slack(&problem);
}

/* exp, expm1, log, log1p of n numbers, for tests. */
EXPORT void dea_kernel_elementary(int64_t kind, int64_t n, const double *x, double *out) {
    for (int64_t i = 0; i < n; i++)
        out[i] = kind == 0 ? exp_of(x[i]) : kind == 1 ? expm1_of(x[i]) : kind == 2 ? log_of(x[i]) : log1p_of(x[i]);
}

#endif
