/* Wrinkled films: model/membrane/tension_field.py and wrinkled_cone.py for one state, from a state of the plain
   equations on. The film is cut where its hoop tension vanishes; a wrinkled element is a straight cone, the others
   (panels) are as in ritz.h. Whatever does not settle is left to others. */
#ifndef DEA_TENSION_FIELD_H
#define DEA_TENSION_FIELD_H

#include "output.h"

enum {
    MOST_CUT_MODES = 18,
    MOST_UNKNOWNS = MOST_ELEMENTS * MOST_CUT_MODES + MOST_ELEMENTS - 1,
    CUT_STEPS = 15,
    WIDTH_STEPS = 8,
    ROUNDS = 4,
};
#define CUT_LEVEL_FACTOR 2.0
#define SOFT_BEFORE_FACTOR 0.2
#define CUT_WEIGHT 0.1
#define CURVED 2.0
#define NEAR 1e-2
#define SLACK_GOALS 5.0 /* times Newton's goal: share of the largest tension that may have a wrong sign */

/* Elements between breaks from disk to ring, and which are wrinkled. */
typedef struct {
    int64_t elements, folded[MOST_ELEMENTS];
    double breaks[MOST_ELEMENTS + 1];
} Zones;

/* A film cut in elements. The unknowns are the modes of its elements, one after the other, then the strains e at the
   cuts; each element has them as coefficients of its modes and of its two hats. */
typedef struct {
    int64_t elements, folded[MOST_ELEMENTS];
    double breaks[MOST_ELEMENTS + 1];
    Grid grid[MOST_ELEMENTS];
    State state[MOST_ELEMENTS];
    double natural[MOST_ELEMENTS][MOST_POINTS]; /* ln(l2) that makes no hoop stress */
} Cut;

/* A wrinkled element. */
typedef struct {
    double u[MOST_POINTS]; /* ln(l1/lp) */
    double cos, sin;
    double pull; /* R S1, in units of G/lp; NaN until the law has told */
} Cone;

/* A cone linearised: how it answers a change of its pull, and what it adds to the film's Newton system. */
typedef struct {
    double rate[MOST_POINTS], rest[MOST_POINTS], change[MOST_POINTS], follow[MOST_POINTS];
    double miss, soft, skew, give, height;
    double share; /* largest Maxwell stress over stress */
    int regular;
} Spring;

/* Newton's system of a film: `Reduced` of more than one element. */
typedef struct {
    int64_t size;
    double matrix[MOST_UNKNOWNS * (MOST_UNKNOWNS + 1) / 2], diagonal[MOST_UNKNOWNS];
    double residual[MOST_UNKNOWNS], coupling[MOST_UNKNOWNS];
    double give, reach;
    int positive;
} System;

static int64_t modes_of(const Cut *cut) { return cut->grid[0].table->modes; }
static int64_t points_of(const Cut *cut) { return cut->grid[0].table->points; }

static void lay_elements(Cut *cut, const Table *table) {
    for (int64_t k = 0; k < cut->elements; k++)
        lay(&cut->grid[k], table, table->modes + 2, cut->breaks[k], cut->breaks[k + 1]);
}

/* Unknown of the strain at a break, -1 at disk and ring; `own` is how many modes come before the cuts. */
static int64_t cut_place(const Cut *cut, int64_t own, int64_t at) {
    return at > 0 && at < cut->elements ? own + at - 1 : -1;
}

/* Coefficients of element k, whose modes begin at `first`, in a vector of the unknowns. */
static void local_part(const Cut *cut, const double *x, int64_t own, int64_t first, int64_t k, double *c) {
    int64_t modes = modes_of(cut);
    for (int64_t i = 0; i < modes; i++) c[i] = x[first + i];
    for (int64_t end = 0; end < 2; end++) {
        int64_t place = cut_place(cut, own, k + end);
        c[modes + end] = place < 0 ? 0.0 : x[place];
    }
}

static void clear_system(System *system, int64_t size) {
    system->size = size;
    for (int64_t i = 0; i < size * (size + 1) / 2; i++) system->matrix[i] = 0.0;
    for (int64_t i = 0; i < size; i++) system->residual[i] = system->coupling[i] = 0.0;
    system->give = system->reach = 0.0;
    system->positive = 1;
}

static void add_to_matrix(System *system, int64_t i, int64_t j, double value) {
    int64_t row = i > j ? i : j, column = i > j ? j : i;
    system->matrix[row * (row + 1) / 2 + column] += value;
}

/* Add an element, whose modes begin at `first`. */
static void add_element(const Cut *cut, const Reduced *part, int64_t own, int64_t first, int64_t k, System *system) {
    int64_t modes = modes_of(cut), place[MOST_FUNCTIONS];
    const double *row = part->matrix;
    for (int64_t i = 0; i < modes + 2; i++) place[i] = i < modes ? first + i : cut_place(cut, own, k + i - modes);
    for (int64_t i = 0; i < modes + 2; i++, row += i) {
        if (place[i] < 0) continue;
        system->residual[place[i]] += part->residual[i];
        system->coupling[place[i]] += part->coupling[i];
        for (int64_t j = 0; j <= i; j++)
            if (place[j] >= 0) add_to_matrix(system, place[i], place[j], row[j]);
    }
    system->give += part->give;
    system->reach += part->reach;
    if (!part->positive) system->positive = 0;
}

/* The law at a cone's points, relaxed and linearised at the natural width. */
static int folded_law(Problem *problem, int64_t n, const double *u, const double *natural, Stress *law, double *change,
                      double *follow) {
    double log[3 * MOST_POINTS];
    for (int64_t i = 0; i < n; i++) {
        log[i] = u[i] + problem->log_prestretch;
        log[n + i] = natural[i];
        log[2 * n + i] = -(log[i] + log[n + i]);
    }
    stress(problem, n, log, law);
    problem->relaxed += n;
    return relax(n, law, change, follow);
}

/* Cones read from the state of the whole film, with natural widths near enough for Newton to take them along. */
static void read_cones(Problem *problem, Cut *cut, Cone *cones) {
    int64_t n = points_of(cut);
    double e[MOST_POINTS], q[MOST_POINTS], change[MOST_POINTS], follow[MOST_POINTS];
    Stress law;
    for (int64_t k = 0; k < cut->elements; k++) {
        if (!cut->folded[k]) continue;
        const double *w = cut->state[k].w, *once = cut->grid[k].once;
        double across = 0.0, down = 0.0;
        strain(&cut->grid[k], cut->state[k].c, e, q);
        for (int64_t i = 0; i < n; i++) {
            across += once[i] * (1.0 + q[i]);
            down += once[i] * w[i];
            cones[k].u[i] = 0.5 * log1p_of(q[i] * (q[i] + 2.0) + w[i] * w[i]);
        }
        double length = sqrt(across * across + down * down);
        cones[k].cos = across / length;
        cones[k].sin = down / length;
        cones[k].pull = NAN;
    }
    double largest_change = INFINITY;
    for (int64_t step = 0; step < WIDTH_STEPS && largest_change > NEAR; step++) {
        largest_change = 0.0;
        for (int64_t k = 0; k < cut->elements; k++) {
            if (!cut->folded[k]) continue;
            folded_law(problem, n, cones[k].u, cut->natural[k], &law, change, follow);
            for (int64_t i = 0; i < n; i++) {
                cut->natural[k][i] += clipped(change[i], 0.3);
                largest_change = larger(largest_change, fabs(change[i]));
            }
        }
    }
}

/* Linearise a cone: `Cones.pulled` and `Springs.of`. */
static void spring_of(Problem *problem, const Cut *cut, int64_t k, Cone *cone, Spring *out) {
    const Grid *grid = &cut->grid[k];
    int64_t n = points_of(cut), modes = modes_of(cut);
    Stress law;
    double s1[MOST_POINTS], stretch[MOST_POINTS], excess = 0.0, axial = 0.0;
    out->regular = folded_law(problem, n, cone->u, cut->natural[k], &law, out->change, out->follow);
    out->share = 1.0;
    for (int64_t i = 0; i < n; i++) {
        stretch[i] = exp_of(cone->u[i]);
        s1[i] = law.t1[i] / stretch[i];
        out->rate[i] = stretch[i] / (law.h11[i] - law.t1[i]);
        out->share = larger(out->share, fabs(law.maxwell[i] / law.t1[i]));
        if (!(out->rate[i] > 0.0)) out->regular = 0;
    }
    if (!(fabs(cone->pull) < INFINITY)) {
        double pull = 0.0, length = 0.0;
        for (int64_t i = 0; i < n; i++) {
            pull += grid->once[i] * grid->radius[i] * s1[i];
            length += grid->once[i];
        }
        cone->pull = pull / length;
    }
    for (int64_t i = 0; i < n; i++) {
        out->rest[i] = cone->pull / grid->radius[i] - s1[i];
        excess += grid->once[i] * (expm1_of(cone->u[i]) + stretch[i] * out->rate[i] * out->rest[i]);
        axial += grid->once[i] / grid->radius[i] * stretch[i] * out->rate[i];
    }
    double first = exp_of(grid->left), last = exp_of(grid->right), cos = cone->cos, sin = cone->sin;
    double across = (last - first + excess) / cone->pull;
    out->soft = axial * cos * cos + across * sin * sin;
    out->skew = (axial - across) * cos * sin;
    out->give = axial * across / out->soft;
    out->height = across * cone->pull * sin;
    out->miss = last * cut->state[k].c[modes + 1] - first * cut->state[k].c[modes];
    out->miss -= excess * cos - (last - first) * sin * sin / (1.0 + cos);
    if (!(out->soft > 0.0)) out->regular = 0;
}

/* Add a spring to the system of the panels: `Springs.join`. */
static void join(const Cut *cut, int64_t own, int64_t k, const Cone *cone, const Spring *spring, System *system) {
    double lam = cone->pull * cone->sin, ratio = spring->skew / spring->soft;
    double force = cone->pull * cone->cos + spring->miss / spring->soft + ratio * lam;
    double ends[2] = {-exp_of(cut->grid[k].left), exp_of(cut->grid[k].right)};
    for (int64_t end = 0; end < 2; end++) {
        int64_t place = cut_place(cut, own, k + end);
        if (place < 0) continue;
        system->residual[place] += ends[end] * force;
        system->coupling[place] -= ends[end] * ratio;
        for (int64_t other = 0; other <= end; other++) {
            int64_t beside = cut_place(cut, own, k + other);
            if (beside >= 0) add_to_matrix(system, place, beside, ends[end] * ends[other] / spring->soft);
        }
    }
    system->reach += spring->height + ratio * spring->miss - spring->give * lam;
    system->give += spring->give;
}

/* The cone after a step whose strains at its ends are `dc`, with the force `lam`: `Springs.advance`. Returns its
   largest relative change. */
static double bend(const Cut *cut, int64_t k, const double *dc, double lam, const Spring *spring, Cone *cone,
                   double *natural) {
    const Grid *grid = &cut->grid[k];
    double moved = exp_of(grid->right) * dc[1] - exp_of(grid->left) * dc[0], before = cone->pull * cone->sin;
    double h = cone->pull * cone->cos + (spring->miss + moved - spring->skew * (lam - before)) / spring->soft;
    double pull = sqrt(h * h + lam * lam), most = 0.0, size = 0.0;
    for (int64_t i = 0; i < points_of(cut); i++) {
        double du = spring->rate[i] * (spring->rest[i] + (pull - cone->pull) / grid->radius[i]);
        double wider = spring->change[i] + spring->follow[i] * du;
        most = larger(most, larger(fabs(du), fabs(wider)));
        size = larger(size, fabs(expm1_of(cone->u[i])));
        cone->u[i] += clipped(du, 0.5);
        natural[i] += clipped(wider, 0.5);
    }
    size += cone->sin * cone->sin;
    cone->cos = h / pull;
    cone->sin = lam / pull;
    cone->pull = pull;
    return larger(most / size, fabs(lam / before - 1.0));
}

/* The cones as elements with modes: `whole`. */
static void unroll(Cut *cut, const Cone *cones) {
    const Table *table = cut->grid[0].table;
    int64_t n = table->points, modes = table->modes;
    for (int64_t k = 0; k < cut->elements; k++) {
        if (!cut->folded[k]) continue;
        const Grid *grid = &cut->grid[k];
        const Cone *cone = &cones[k];
        double run[MOST_POINTS], q[MOST_POINTS], slope[MOST_POINTS], half = 1.0 / grid->dxi;
        double left = cut->state[k].c[modes] * exp_of(grid->left);
        for (int64_t i = 0; i < n; i++) {
            double stretch = expm1_of(cone->u[i]);
            q[i] = stretch * cone->cos - cone->sin * cone->sin / (1.0 + cone->cos);
            run[i] = q[i] * grid->radius[i];
            cut->state[k].w[i] = (1.0 + stretch) * cone->sin;
        }
        for (int64_t i = 0; i < n; i++)
            slope[i] = (q[i] - (left + half * dot(n, table->integrate + i * n, run)) / grid->radius[i]) * half;
        for (int64_t i = 0; i < modes; i++) cut->state[k].c[i] = dot(n, table->to_modes + i * n, slope);
    }
}

/* Breaks moved to where the hoop tension of the panels vanishes, in `breaks`; returns the largest shift over an
 * element. */
static double moved_breaks(const Cut *cut, double (*tension)[MOST_POINTS], double *breaks) {
    const Table *table = cut->grid[0].table;
    double new[MOST_ELEMENTS + 1], largest_shift = 0.0;
    memcpy(new, cut->breaks, sizeof new);
    for (int64_t k = 0; k < cut->elements; k++)
        for (int64_t end = 0; end < 2; end++) {
            int64_t beside = end == 0 ? k - 1 : k + 1, at = end == 0 ? k : k + 1;
            if (cut->folded[k] || beside < 0 || beside >= cut->elements || !cut->folded[beside]) continue;
            double side = end == 0 ? 1.0 : -1.0, length = cut->breaks[k + 1] - cut->breaks[k];
            double other = cut->breaks[beside + 1] - cut->breaks[beside];
            double value = dot(table->points, table->ends + end * table->points, tension[k]);
            double slope =
                dot(table->points, table->end_slopes + end * table->points, tension[k]) * cut->grid[k].dxi * side;
            /* Towards the taut zone where it is not taut, away from it where it pulls at the cut. */
            double sign = value > 0.0 ? 1.0 : value < 0.0 ? -1.0 : 0.0;
            double shift = slope > 0.0 ? -value / slope * side : -0.2 * sign * side * length;
            if (!(fabs(shift) < INFINITY)) shift = 0.0;
            double before = at == k ? other : length, after = at == k ? length : other;
            shift = smaller(larger(shift, -0.5 * before), 0.5 * after);
            new[at] += shift;
            largest_shift = larger(largest_shift, fabs(shift) / smaller(length, other));
        }
    memcpy(breaks, new, sizeof new);
    for (int64_t k = 1; k < cut->elements; k++) breaks[k] = smaller(larger(new[k], new[k - 1]), new[k + 1]);
    return largest_shift;
}

/* Newton's system of the panels and springs. */
static void compose(Problem *problem, const Cut *cut, int64_t own, Cone *cones, Points *at, Reduced *part,
                    Spring *spring, System *system) {
    int64_t first = 0;
    clear_system(system, own + cut->elements - 1);
    for (int64_t k = 0; k < cut->elements; k++) {
        if (cut->folded[k]) {
            spring_of(problem, cut, k, &cones[k], &spring[k]);
            join(cut, own, k, &cones[k], &spring[k], system);
            if (!spring[k].regular) system->positive = 0;
        } else {
            evaluate(problem, &cut->grid[k], &cut->state[k], NULL, &at[k]);
            reduce(&cut->grid[k], cut->state[k].w, &at[k], &part[k]);
            add_element(cut, &part[k], own, first, k, system);
            first += modes_of(cut);
        }
    }
}

/* What a step leaves: how much it changed, and the hoop tension of the panels after it. */
typedef struct {
    double slopes, strains, size, bent, maxwell, bent_maxwell;
    double tension[MOST_ELEMENTS][MOST_POINTS];
} Changes;

/* A panel's slopes and hoop tension after the step `dc` of its functions: the first half of `refinement.advance`. */
static void turn(const Cut *cut, int64_t k, const Points *at, const Reduced *part, const double *dc, double lam,
                 double *dw, Changes *seen) {
    const Stress *law = &at->law;
    double de[MOST_POINTS], dq[MOST_POINTS];
    slopes(&cut->grid[k], part, dc, lam, 1, dw);
    strain(&cut->grid[k], dc, de, dq);
    for (int64_t i = 0; i < points_of(cut); i++) {
        double w = cut->state[k].w[i];
        seen->slopes = larger(seen->slopes, fabs(dw[i] / w));
        seen->strains = larger(seen->strains, fabs(dq[i]));
        seen->size = larger(seen->size, fabs(at->q[i]) + w * w);
        seen->maxwell = larger(seen->maxwell, fabs(law->maxwell[i] / law->t1[i]));
        seen->tension[k][i] = law->t2[i] + law->h12[i] * (at->along[i] * dq[i] + at->down[i] * dw[i]) +
                              law->h22[i] * at->around[i] * de[i];
    }
}

/* Add a step to the panels, shortened where a slope would change beyond reason. */
static void add_step(Cut *cut, int64_t own, const double *dc, double (*dw)[MOST_POINTS], double change) {
    double part = change > 2.0 ? 2.0 / change : 1.0;
    int64_t first = 0, modes = modes_of(cut);
    for (int64_t k = 0; k < cut->elements; k++) {
        State *state = &cut->state[k];
        double local[MOST_FUNCTIONS];
        local_part(cut, dc, own, first, k, local);
        for (int64_t i = cut->folded[k] ? modes : 0; i < modes + 2; i++) state->c[i] += part * local[i];
        if (cut->folded[k]) continue;
        for (int64_t i = 0; i < points_of(cut); i++) {
            double w = state->w[i], moved = w + part * dw[k][i];
            state->w[i] = change > 0.8 && !(moved > 0.2 * w) ? 0.2 * w : moved;
        }
        first += modes;
    }
}

/* The share of the energy that the last modes of the panels carry. */
static double tail_of_panels(const Problem *problem, const Cut *cut, const System *system, double lam) {
    double energy = 0.0;
    int64_t modes = modes_of(cut), first = 0;
    for (int64_t k = 0; k < cut->elements; k++) {
        if (cut->folded[k]) continue;
        const double *c = cut->state[k].c, *diagonal = system->diagonal + first;
        energy += c[modes - 1] * c[modes - 1] * diagonal[modes - 1];
        energy += 0.1 * (c[modes - 2] * c[modes - 2] * diagonal[modes - 2]);
        first += modes;
    }
    return 0.5 * energy / (lam * problem->height);
}

/* One step of Newton on the state together with the cuts. Returns the largest change; where that exceeds `aim` the cuts
   have moved. `found` has the force, the tail and whether the state is stable. */
static double cut_step(Problem *problem, Cut *cut, Cone *cones, double aim, Iterate *found) {
    Points at[MOST_ELEMENTS];
    Reduced part[MOST_ELEMENTS];
    Spring spring[MOST_ELEMENTS];
    System system;
    Changes seen = {0.0, 0.0, 1e-300, 0.0, 1.0, 1.0, {{0.0}}};
    double dc[MOST_UNKNOWNS], dw[MOST_ELEMENTS][MOST_POINTS], local[MOST_FUNCTIONS], breaks[MOST_ELEMENTS + 1];
    int64_t modes = modes_of(cut), own = 0, first = 0;
    for (int64_t k = 0; k < cut->elements; k++) own += cut->folded[k] ? 0 : modes;
    compose(problem, cut, own, cones, at, part, spring, &system);
    double lam0 = (problem->height - system.reach) / system.give;
    int positive = factor(system.size, system.coupling, system.give, system.matrix, system.diagonal);
    for (int64_t i = 0; i < system.size; i++) dc[i] = -(system.residual[i] + lam0 * system.coupling[i]);
    substitute(system.size, system.matrix, dc);
    double lam = lam0 + dot(system.size, system.coupling, dc) / system.give;
    for (int64_t k = 0; k < cut->elements; k++) {
        local_part(cut, dc, own, first, k, local);
        if (cut->folded[k]) {
            seen.bent = larger(seen.bent, bend(cut, k, local + modes, lam, &spring[k], &cones[k], cut->natural[k]));
            seen.bent_maxwell = larger(seen.bent_maxwell, spring[k].share);
        } else {
            turn(cut, k, &at[k], &part[k], local, lam, dw[k], &seen);
            first += modes;
        }
    }
    double change = problem->field != 0.0 ? seen.slopes * sqrt(seen.maxwell) : seen.slopes;
    add_step(cut, own, dc, dw, change);
    change = larger(change, larger(CURVED * seen.bent * sqrt(seen.bent_maxwell), seen.strains / seen.size));
    change = larger(change, CUT_WEIGHT * moved_breaks(cut, seen.tension, breaks));
    found->lam = lam;
    found->tail = tail_of_panels(problem, cut, &system, lam);
    found->ok = positive && system.positive && lam > 0.0;
    if (!(fabs(lam) + dot(system.size, dc, dc) < INFINITY)) return NAN;
    if (change <= aim) return change; /* the state belongs to the cuts as they were */
    memcpy(cut->breaks, breaks, sizeof breaks);
    lay_elements(cut, cut->grid[0].table);
    return change;
}

/* Newton on the state together with the cuts: `settle`. */
static Iterate settle(Problem *problem, Cut *cut, double aim) {
    Cone cones[MOST_ELEMENTS];
    Iterate found = {NAN, NAN, NAN, NAN, 0, 0};
    read_cones(problem, cut, cones);
    while (found.steps < CUT_STEPS) {
        found.steps++;
        found.change = cut_step(problem, cut, cones, aim, &found);
        if (found.change <= aim) {
            unroll(cut, cones);
            return found;
        }
        if (!(found.change < INFINITY)) break;
    }
    found.ok = 0;
    return found;
}

/* Hoop tension at the FINE points of every element, and where wrinkled the slack in the width; returns the largest. */
static double tensions(const Cut *cut, const Points *at, double (*fine)[FINE]) {
    double values[MOST_POINTS], most = 0.0;
    int64_t n = points_of(cut);
    for (int64_t k = 0; k < cut->elements; k++) {
        for (int64_t i = 0; i < n; i++) values[i] = cut->folded[k] ? at[k].hoop[i] - at[k].log[n + i] : at[k].law.t2[i];
        refined(cut->grid[k].table, values, fine[k]);
        for (int64_t i = 0; i < FINE; i++) most = larger(most, fabs(fine[k][i]));
    }
    return most;
}

/* Share of the largest tension that may have a wrong sign: `wrong_sign`. */
static double wrong_sign(double tolerance) { return SLACK_GOALS * goal(larger(tolerance, 1e-8)); }

/* Zones of the film `old`, where its hoop tension changes sign: `zones`, `_cut`. A sign against an element's own kind
   counts only beyond `bound`. Returns whether there is a wrinkled zone, and not too many. */
static int find_zones(const Cut *old, double (*fine)[FINE], double bound, Zones *out) {
    const double *place = old->grid[0].table->fine_xi;
    double before = 0.0, before_x = 0.0;
    out->elements = 1;
    out->breaks[0] = old->breaks[0];
    for (int64_t k = 0; k < old->elements; k++)
        for (int64_t i = 0; i < FINE; i++) {
            double value = fine[k][i], length = old->breaks[k + 1] - old->breaks[k];
            double x = old->breaks[k] + 0.5 * (1.0 + place[i]) * length;
            int64_t folded = old->folded[k] ? value < bound : value < -bound;
            if (k == 0 && i == 0) out->folded[0] = folded;
            if (folded != out->folded[out->elements - 1]) {
                if (out->elements == MOST_ELEMENTS) return 0;
                double part = smaller(larger(before / (before - value), 0.05), 0.95);
                if (!(fabs(before / (before - value)) < INFINITY)) part = 0.5;
                out->breaks[out->elements] = before_x + part * (x - before_x);
                out->folded[out->elements++] = folded;
            }
            before = value;
            before_x = x;
        }
    out->breaks[out->elements] = 0.0;
    return out->elements > 1 || out->folded[0];
}

static void cut_at(const Zones *zones, Cut *cut) {
    cut->elements = zones->elements;
    memcpy(cut->folded, zones->folded, sizeof cut->folded);
    memcpy(cut->breaks, zones->breaks, sizeof cut->breaks);
}

/* Value at x of the polynomial through the points of an element. */
static double carried_to(const Grid *grid, const double *values, double x) {
    int64_t n = grid->table->points;
    double xi = 2.0 * (x - grid->left) / (grid->right - grid->left) - 1.0, value, slope, curve, c[MOST_POINTS];
    for (int64_t k = 0; k < n; k++) c[k] = 0.0;
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < n; k++) c[k] += values[i] * grid->table->legendre[i * n + k];
    series(n, c, clipped(xi, 1.0), &value, &slope, &curve);
    return value;
}

/* The element of a film that has x. */
static int64_t element_at(const Cut *cut, double x) {
    int64_t element = 0;
    for (int64_t k = 1; k < cut->elements; k++) element += x > cut->breaks[k];
    return element;
}

/* The state of `old`, whose points are `at`, carried to the elements of `cut`. */
static void remap(const Cut *old, const Points *at, const Table *table, Cut *cut) {
    int64_t n = table->points, modes = table->modes, from = points_of(old);
    double rise[MOST_ELEMENTS][MOST_POINTS], slope[MOST_POINTS], least = INFINITY;
    for (int64_t k = 0; k < old->elements; k++)
        for (int64_t i = 0; i < from; i++) {
            least = smaller(least, old->state[k].w[i]);
            rise[k][i] = at[k].q[i] - at[k].e[i]; /* de/dx */
        }
    lay_elements(cut, table);
    for (int64_t k = 0; k < cut->elements; k++) {
        State *new = &cut->state[k];
        double half = 1.0 / cut->grid[k].dxi;
        for (int64_t i = 0; i < n; i++) {
            double x = half * (table->xi[i] + 1.0) + cut->breaks[k];
            int64_t of = element_at(old, x);
            slope[i] = carried_to(&old->grid[of], rise[of], x) * half;
            new->w[i] = larger(carried_to(&old->grid[of], old->state[of].w, x), least);
            cut->natural[k][i] = carried_to(&old->grid[of], at[of].log + from, x);
        }
        for (int64_t i = 0; i < modes; i++) new->c[i] = dot(n, table->to_modes + i * n, slope);
        for (int64_t end = 0; end < 2; end++) {
            double x = cut->breaks[k + end];
            int64_t of = element_at(old, x), inside = k + end > 0 && k + end < cut->elements;
            new->c[modes + end] = inside ? carried_to(&old->grid[of], at[of].e, x) : 0.0;
        }
    }
}

/* The same state with more modes. */
static void prolong_cut(Cut *cut, const Table *to) {
    const Table *from = cut->grid[0].table;
    for (int64_t k = 0; k < cut->elements; k++) {
        State *state = &cut->state[k];
        double left = state->c[from->modes], right = state->c[from->modes + 1];
        prolong(from, to, from->carry, state);
        for (int64_t i = from->modes; i < to->modes; i++) state->c[i] = 0.0;
        state->c[to->modes] = left;
        state->c[to->modes + 1] = right;
        carried(to->points, from->points, from->carry, cut->natural[k]);
    }
    lay_elements(cut, to);
}

/* Whether every cut still separates two elements. */
static int admissible(const Cut *cut) {
    for (int64_t k = 0; k < cut->elements; k++)
        if (!(cut->breaks[k + 1] - cut->breaks[k] > -1e-9 * cut->breaks[0])) return 0;
    return 1;
}

/* The film with the elements of `cut`, from the state `old` with the points `at`, to `tolerance`. `first_modes`: to
   begin with, by the length of the longest element. Returns WRINKLED, with the points in `at`. */
static int refine_cut(Problem *problem, const Table *const *tables, const int64_t *first_modes, double tolerance,
                      const Cut *old, Cut *cut, Points *at, Iterate *found, double *error) {
    double longest = 0.0, previous = NAN, before = INFINITY, aim = goal(tolerance);
    int64_t steps = found->steps, panels = 0;
    for (int64_t k = 0; k < cut->elements; k++) {
        longest = larger(longest, cut->breaks[k + 1] - cut->breaks[k]);
        panels += !cut->folded[k];
    }
    int64_t modes = first_modes[longest <= 2.4 ? 0 : longest <= 3.1 ? 1 : 2];
    if (modes < 3) modes = 3;
    for (;;) {
        if (modes > MOST_CUT_MODES) return LEFT_TO_OTHERS;
        if (!tables[modes]) return NEEDS_TABLE;
        if (!(fabs(previous) < INFINITY))
            remap(old, at, tables[modes], cut);
        else
            prolong_cut(cut, tables[modes]);
        *found = settle(problem, cut, aim);
        steps += found->steps;
        found->steps = steps;
        if (!found->ok) return LEFT_TO_OTHERS;
        *error = estimate(found, previous, tolerance, CUT_LEVEL_FACTOR);
        if (panels == 0) { /* of a film that is one cone two resolutions may agree by chance */
            *error += SOFT_BEFORE_FACTOR * before;
            if (fabs(previous) < INFINITY) before = fabs((found->lam - previous) / found->lam);
        }
        if (*error <= tolerance) break;
        previous = found->lam;
        modes = tables[modes]->next;
    }
    for (int64_t k = 0; k < cut->elements; k++)
        evaluate(problem, &cut->grid[k], &cut->state[k], cut->folded[k] ? cut->natural[k] : NULL, &at[k]);
    return WRINKLED;
}

/* From a plain state of one element, whose points are `at`, to the wrinkled one at `tolerance`; other zones than before
   once more. Returns WRINKLED, with the points in `at`. */
static int fold(Problem *problem, const Table *const *tables, const int64_t *first_modes, double tolerance,
                const Grid *grid, const State *state, Points *at, Cut *cut, Iterate *found, double *error) {
    Cut old;
    Zones zones, now;
    double fine[MOST_ELEMENTS][FINE];
    old.elements = 1;
    old.folded[0] = 0;
    old.breaks[0] = grid->left;
    old.breaks[1] = 0.0;
    old.grid[0] = *grid;
    old.state[0] = *state;
    tensions(&old, at, fine);
    int good = find_zones(&old, fine, 0.0, &zones);
    for (int64_t round = 0; round < ROUNDS && good; round++) {
        cut_at(&zones, cut);
        int status = refine_cut(problem, tables, first_modes, tolerance, &old, cut, at, found, error);
        if (status != WRINKLED) return status;
        double bound = tensions(cut, at, fine) * wrong_sign(tolerance);
        good = find_zones(cut, fine, bound, &now);
        if (good && now.elements == zones.elements && now.folded[0] == zones.folded[0] && admissible(cut))
            return WRINKLED;
        old = *cut;
        zones = now;
    }
    return LEFT_TO_OTHERS;
}

/* Derivatives of the force of a wrinkled film, every element with its modes. */
static void cut_derivatives(const Problem *problem, const Cut *cut, const Points *at, double lam, Derivatives *out) {
    Reduced part[MOST_ELEMENTS];
    System system;
    double dc[MOST_UNKNOWNS], local[MOST_FUNCTIONS], dw[MOST_POINTS];
    int64_t modes = modes_of(cut), own = cut->elements * modes;
    clear_system(&system, own + cut->elements - 1);
    for (int64_t k = 0; k < cut->elements; k++) {
        reduce(&cut->grid[k], cut->state[k].w, &at[k], &part[k]);
        add_element(cut, &part[k], own, k * modes, k, &system);
    }
    factor(system.size, system.coupling, system.give, system.matrix, system.diagonal);
    for (int64_t i = 0; i < system.size; i++) dc[i] = -(system.coupling[i] / system.give);
    substitute(system.size, system.matrix, dc);
    double stiffness = (1.0 + dot(system.size, system.coupling, dc)) / system.give;
    memset(out, 0, sizeof *out);
    out->height = stiffness;
    for (int64_t k = 0; k < cut->elements; k++) {
        local_part(cut, dc, own, k * modes, k, local);
        slopes(&cut->grid[k], &part[k], local, stiffness, 0, dw);
        add_derivatives(problem, &cut->grid[k], cut->state[k].w, &at[k], cut->folded[k], lam, local, dw, stiffness,
                        out);
    }
}

#endif
