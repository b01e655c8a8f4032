/* Wrinkled films: model/membrane/tension_field.py, from a state of the plain equations on. The film is cut where its
   hoop tension vanishes; a wrinkled element is a straight cone, the others (panels) are as in ritz.h. Whatever does not
   settle is left to others. */
#ifndef DEA_TENSION_FIELD_H
#define DEA_TENSION_FIELD_H

#include "wrinkled_cone.h"

enum {
    CUT_STEPS = 15,
    ROUNDS = 4,
};
#define CUT_LEVEL_FACTOR 2.0
#define SOFT_BEFORE_FACTOR 0.2
#define CUT_WEIGHT 0.1
#define CUT_POWER 2.6
#define CUT_GOAL 0.9 /* a cut stays where it has settled: what it lacks must leave room for the rest of the estimate */
#define CURVED 2.0
#define UNSEEN 0.05 /* of the tolerance: share of the pull along the film that a zone which is not cut out may push around */
#define SLACK_GOALS 5.0 /* times Newton's goal: share of the largest tension that may have a wrong sign */

/* Breaks moved to where the hoop tension of the panels vanishes, in `breaks`; returns the largest shift over an
 * element. */
static Real moved_breaks(const Cut *cut, Real (*tension)[MOST_POINTS], Real *breaks) {
    const Table *table = cut->grid[0].table;
    Real new[MOST_ELEMENTS + 1], largest_shift = of(0.0);
    memcpy(new, cut->breaks, sizeof new);
    for (int64_t k = 0; k < cut->elements; k++)
        for (int64_t end = 0; end < 2; end++) {
            int64_t beside = end == 0 ? k - 1 : k + 1, at = end == 0 ? k : k + 1;
            if (cut->folded[k] || beside < 0 || beside >= cut->elements || !cut->folded[beside]) continue;
            double side = end == 0 ? 1.0 : -1.0;
            Real length = cut->breaks[k + 1] - cut->breaks[k];
            Real other = cut->breaks[beside + 1] - cut->breaks[beside];
            Real value = across(table->points, table->ends + end * table->points, tension[k]);
            Real slope =
                across(table->points, table->end_slopes + end * table->points, tension[k]) * cut->grid[k].dxi * side;
            /* Towards the taut zone where it is not taut, away from it where it pulls at the cut. */
            Real sign = pick(value > 0.0, of(1.0), pick(value < 0.0, of(-1.0), of(0.0)));
            Real shift = pick(slope > 0.0, -value / slope * side, -0.2 * sign * side * length);
            shift = pick(finite(shift), shift, of(0.0));
            Real before = at == k ? other : length, after = at == k ? length : other;
            shift = smaller(larger(shift, -0.5 * before), 0.5 * after);
            new[at] += shift;
            largest_shift = larger(largest_shift, abs_of(shift) / smaller(length, other));
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
            system->positive &= spring[k].regular;
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
    Real slopes, stressed, strains, size, bent, maxwell, bent_maxwell;
    Real tension[MOST_ELEMENTS][MOST_POINTS];
} Changes;

/* A panel's slopes and hoop tension after the step `dc` of its functions: the first half of `refinement.advance`. */
static void turn(const Cut *cut, int64_t k, const Points *at, const Reduced *part, const Real *dc, Real lam,
                 Real *dw, Changes *seen) {
    const Stress *law = &at->law;
    Real de[MOST_POINTS], dq[MOST_POINTS];
    slopes(&cut->grid[k], part, dc, lam, 1, de, dq, dw);
    for (int64_t i = 0; i < points_of(cut); i++) {
        Real w = cut->state[k].w[i];
        seen->slopes = larger(seen->slopes, abs_of(dw[i] / w));
        seen->stressed = larger(seen->stressed, abs_of(stressed(at, i, de[i], dq[i], dw[i])));
        seen->strains = larger(seen->strains, abs_of(dq[i]));
        seen->size = larger(seen->size, abs_of(at->q[i]) + w * w);
        seen->maxwell = larger(seen->maxwell, abs_of(law->maxwell[i] / law->t1[i]));
        seen->tension[k][i] = law->t2[i] + law->h12[i] * (at->along[i] * dq[i] + at->down[i] * dw[i]) +
                              law->h22[i] * at->around[i] * de[i];
    }
}

/* Add a step to the panels of `open` lanes, shortened where a slope would change beyond reason. */
static void add_step(Cut *cut, int64_t own, const Real *dc, Real (*dw)[MOST_POINTS], Real change, Mask open) {
    Real part = pick(change > 2.0, 2.0 / change, of(1.0));
    int64_t first = 0, modes = modes_of(cut);
    for (int64_t k = 0; k < cut->elements; k++) {
        State *state = &cut->state[k];
        Real local[MOST_FUNCTIONS];
        local_part(cut, dc, own, first, k, local);
        for (int64_t i = cut->folded[k] ? modes : 0; i < modes + 2; i++)
            state->c[i] = pick(open, state->c[i] + part * local[i], state->c[i]);
        if (cut->folded[k]) continue;
        for (int64_t i = 0; i < points_of(cut); i++) {
            Real w = state->w[i], moved = w + part * dw[k][i];
            moved = pick((change > 0.8) & is_not(moved > 0.2 * w), 0.2 * w, moved);
            state->w[i] = pick(open, moved, w);
        }
        first += modes;
    }
}

/* The share of the energy that the last modes of the panels carry. */
static Real tail_of_panels(const Problem *problem, const Cut *cut, const System *system, Real lam) {
    Real energy = of(0.0);
    int64_t modes = modes_of(cut), first = 0;
    for (int64_t k = 0; k < cut->elements; k++) {
        if (cut->folded[k]) continue;
        const Real *c = cut->state[k].c, *diagonal = system->diagonal + first;
        energy += c[modes - 1] * c[modes - 1] * diagonal[modes - 1];
        energy += 0.1 * (c[modes - 2] * c[modes - 2] * diagonal[modes - 2]);
        first += modes;
    }
    return 0.5 * energy / (lam * problem->height);
}

/* One step of Newton on the state together with the cuts. Returns the largest change; where that exceeds `aim` the cuts
   have moved. `found` has the force, the tail and whether the state is stable. */
static Real cut_step(Problem *problem, Cut *cut, Cone *cones, double aim, Mask open, Iterate *found) {
    Points at[MOST_ELEMENTS];
    Reduced part[MOST_ELEMENTS];
    Spring spring[MOST_ELEMENTS];
    System system;
    Changes seen;
    seen.slopes = seen.stressed = seen.strains = seen.bent = of(0.0);
    seen.size = of(1e-300);
    seen.maxwell = seen.bent_maxwell = of(1.0);
    Real dc[MOST_UNKNOWNS], dw[MOST_ELEMENTS][MOST_POINTS], local[MOST_FUNCTIONS], breaks[MOST_ELEMENTS + 1];
    int64_t modes = modes_of(cut), own = 0, first = 0;
    for (int64_t k = 0; k < cut->elements; k++) own += cut->folded[k] ? 0 : modes;
    compose(problem, cut, own, cones, at, part, spring, &system);
    Real lam0 = (problem->height - system.reach) / system.give;
    Mask positive = factor(system.size, system.coupling, system.give, system.matrix, system.diagonal);
    for (int64_t i = 0; i < system.size; i++) dc[i] = -(system.residual[i] + lam0 * system.coupling[i]);
    substitute(system.size, system.matrix, dc);
    Real lam = lam0 + dot(system.size, system.coupling, dc) / system.give;
    for (int64_t k = 0; k < cut->elements; k++) {
        local_part(cut, dc, own, first, k, local);
        if (cut->folded[k]) {
            Real bent = bend(cut, k, local + modes, lam, &spring[k], open, &cones[k], cut->natural[k]);
            seen.bent = larger(seen.bent, bent);
            seen.bent_maxwell = larger(seen.bent_maxwell, spring[k].share);
        } else {
            turn(cut, k, &at[k], &part[k], local, lam, dw[k], &seen);
            first += modes;
        }
    }
    Real change = pick(problem->field != 0.0, seen.slopes * sqrt_of(seen.maxwell), seen.slopes);
    add_step(cut, own, dc, dw, change, open);
    change = FELT * larger(seen.slopes, seen.stressed);
    change = larger(change, larger(CURVED * seen.bent * sqrt_of(seen.bent_maxwell), seen.strains / seen.size));
    Real shift = moved_breaks(cut, seen.tension, breaks);
    change = larger(change, larger(CUT_WEIGHT * shift, CUT_POWER * shift * sqrt_of(shift)));
    found->lam = pick(open, lam, found->lam);
    found->tail = pick(open, tail_of_panels(problem, cut, &system, lam), found->tail);
    found->ok = (open & positive & system.positive & (lam > 0.0)) | (is_not(open) & found->ok);
    change = pick(finite(abs_of(lam) + dot(system.size, dc, dc)), change, of(NAN));
    Mask moving = open & (change > aim); /* where it has settled the state belongs to the cuts as they were */
    if (!any(moving)) return change;
    for (int64_t k = 0; k <= cut->elements; k++) cut->breaks[k] = pick(moving, breaks[k], cut->breaks[k]);
    lay_elements(cut, cut->grid[0].table);
    return change;
}

/* Newton on the state together with the cuts: `settle`. */
static Iterate settle(Problem *problem, Cut *cut, double aim) {
    aim *= CUT_GOAL;
    Cone cones[MOST_ELEMENTS];
    Mask every = problem->counts, open = every, done = is_not(yes());
    Iterate found = {of(NAN), of(NAN), of(NAN), of(NAN), counted(open, 0), done};
    read_cones(problem, cut, cones);
    for (int64_t k = 0; k < CUT_STEPS && any(open); k++) {
        problem->counts = open;
        found.steps += counted(open, 1);
        found.change = pick(open, cut_step(problem, cut, cones, aim, open, &found), found.change);
        done |= open & (found.change <= aim);
        open &= is_not(done) & finite(found.change);
    }
    problem->counts = every;
    found.ok &= done;
    if (any(done)) unroll(cut, cones);
    return found;
}

/* What the zones are judged by: hoop tension at the FINE points of every element, and where wrinkled the slack in the
   width; the largest of them; how much the film pulls along, and taut elements push around; and the shares of the
   largest and of the pull that may have a wrong sign. */
typedef struct {
    Real fine[MOST_ELEMENTS][FINE], most, pull, push;
    double slack, unseen;
} Tensions;

/* What a taut element pushes around, where its hoop stress has the wrong sign. */
static Real pushed(const Grid *grid, const Real *fine) {
    const double *place = grid->table->fine_xi;
    Real total = of(0.0), before = total, before_x = grid->left;
    for (int64_t i = 0; i < FINE; i++) {
        Real x = grid->left + 0.5 * (1.0 + place[i]) * (grid->right - grid->left), now = larger(-fine[i], of(0.0));
        if (any(now > 0.0)) now *= exp_of(2.0 * x);
        total += 0.5 * (now + before) * (x - before_x);
        before = now;
        before_x = x;
    }
    return total;
}

/* Those of a state, with no wrong sign allowed. */
static void tensions(const Cut *cut, const Points *at, Tensions *out) {
    Real values[MOST_POINTS];
    int64_t n = points_of(cut);
    out->most = out->pull = out->push = of(0.0);
    out->slack = out->unseen = 0.0;
    for (int64_t k = 0; k < cut->elements; k++) {
        for (int64_t i = 0; i < n; i++) {
            values[i] = cut->folded[k] ? at[k].hoop[i] - at[k].log[n + i] : at[k].law.t2[i];
            out->pull += cut->grid[k].twice[i] * at[k].law.t1[i];
        }
        refined(cut->grid[k].table, values, out->fine[k]);
        for (int64_t i = 0; i < FINE; i++) out->most = larger(out->most, abs_of(out->fine[k][i]));
        if (!cut->folded[k]) out->push += pushed(&cut->grid[k], out->fine[k]);
    }
}

/* Share of the largest tension that may have a wrong sign: `wrong_sign`. */
static double wrong_sign(double tolerance) { return SLACK_GOALS * goal(fmax(tolerance, 1e-8)); }

/* Allow the wrong signs of a state that is solved to the tolerance. */
static void allow(Tensions *seen, double tolerance) {
    seen->slack = wrong_sign(tolerance);
    seen->unseen = UNSEEN * tolerance;
}

/* Numbers of one lane. */
static void lane_of(const Real *all, int64_t lane, int64_t numbers, double *out) {
    for (int64_t i = 0; i < numbers; i++) memcpy(&out[i], (const char *)&all[i] + (size_t)lane * 8, 8);
}

static void breaks_of(const Cut *cut, int64_t lane, double *out) {
    for (int64_t k = 0; k <= cut->elements && k <= MOST_ELEMENTS; k++) lane_of(&cut->breaks[k], lane, 1, &out[k]);
}

/* Zones where the hoop tension of those of `old`, at the FINE points, changes sign: `zones`, `_cut`. A sign against an
   element's own kind counts only beyond `bound` where wrinkled and beyond `push` where taut. Returns whether there is a
   wrinkled zone, and not too many. */
static int find_zones(const Zones *old, const double (*fine)[FINE], const double *place, double bound, double push,
                      Zones *out) {
    double before = 0.0, before_x = 0.0;
    out->elements = 1;
    out->breaks[0] = old->breaks[0];
    for (int64_t k = 0; k < old->elements; k++)
        for (int64_t i = 0; i < FINE; i++) {
            double value = fine[k][i], length = old->breaks[k + 1] - old->breaks[k];
            double x = old->breaks[k] + 0.5 * (1.0 + place[i]) * length;
            int64_t folded = old->folded[k] ? value < bound : value < -push;
            if (k == 0 && i == 0) out->folded[0] = folded;
            if (folded != out->folded[out->elements - 1]) {
                if (out->elements == MOST_ELEMENTS) return 0;
                double part = before / (before - value);
                part = fabs(part) < INFINITY ? fmax(0.05, fmin(part, 0.95)) : 0.5;
                out->breaks[out->elements] = before_x + part * (x - before_x);
                out->folded[out->elements++] = folded;
            }
            before = value;
            before_x = x;
        }
    out->breaks[out->elements] = 0.0;
    return out->elements > 1 || out->folded[0];
}

/* The zones that the state of one lane has now. */
static int zones_now(const Cut *cut, const Tensions *seen, int64_t lane, Zones *out) {
    Zones old;
    double own[MOST_ELEMENTS][FINE], most, pull, push;
    old.elements = cut->elements;
    memcpy(old.folded, cut->folded, sizeof old.folded);
    breaks_of(cut, lane, old.breaks);
    for (int64_t k = 0; k < cut->elements; k++) lane_of(seen->fine[k], lane, FINE, own[k]);
    lane_of(&seen->most, lane, 1, &most);
    lane_of(&seen->pull, lane, 1, &pull);
    lane_of(&seen->push, lane, 1, &push);
    double bound = seen->slack * most;
    return find_zones(&old, (const double(*)[FINE])own, cut->grid[0].table->fine_xi, bound,
                      push > seen->unseen * pull ? 0.0 : bound, out);
}

/* Whether one lane has these zones, and every cut still separates two elements. */
static int has_zones(const Cut *cut, const Zones *zones, int64_t lane) {
    double breaks[MOST_ELEMENTS + 1];
    breaks_of(cut, lane, breaks);
    for (int64_t k = 0; k < cut->elements; k++)
        if (!(breaks[k + 1] - breaks[k] > -1e-9 * breaks[0])) return 0;
    return zones->elements == cut->elements && zones->folded[0] == cut->folded[0];
}

/* A film of one element, as one that is not cut. */
static void uncut(const Grid *grid, const State *state, Cut *cut) {
    cut->elements = 1;
    cut->folded[0] = 0;
    cut->breaks[0] = grid->left;
    cut->breaks[1] = grid->right;
    cut->grid[0] = *grid;
    cut->state[0] = *state;
}

/* Modes to begin with, by the length of the longest element. */
static int64_t modes_for(const Zones *zones, const int64_t *first_modes) {
    double longest = 0.0;
    for (int64_t k = 0; k < zones->elements; k++) longest = fmax(longest, zones->breaks[k + 1] - zones->breaks[k]);
    int64_t modes = first_modes[longest <= 2.4 ? 0 : longest <= 3.1 ? 1 : 2];
    return modes < 3 ? 3 : modes;
}

static int64_t panels_of(const Zones *zones) {
    int64_t panels = 0;
    for (int64_t k = 0; k < zones->elements; k++) panels += !zones->folded[k];
    return panels;
}

/* Legendre coefficients of the polynomial through the points of an element. */
static void to_series(const Table *table, const Real *values, Real *c) {
    int64_t n = table->points;
    for (int64_t k = 0; k < n; k++) c[k] = of(0.0);
    for (int64_t i = 0; i < n; i++)
        for (int64_t k = 0; k < n; k++) c[k] += values[i] * table->legendre[i * n + k]; /* vector */
}

/* Its value at x. */
static Real carried_to(const Grid *grid, const Real *c, Real x) {
    Real xi = 2.0 * (x - grid->left) / (grid->right - grid->left) - 1.0, value, slope, curve;
    series(grid->table->points, c, clipped(xi, 1.0), &value, &slope, &curve);
    return value;
}

/* The element of a film that has x; of one that is cut there is one lane only. */
static int64_t element_at(const Cut *cut, Real x) {
    int64_t element = 0;
    for (int64_t k = 1; k < cut->elements; k++) element += any(x > cut->breaks[k]);
    return element;
}

/* What a state of `old` is made of, as series in every element: slope, de/dx, e, ln(l2). */
typedef struct {
    Real w[MOST_POINTS], rise[MOST_POINTS], e[MOST_POINTS], log2[MOST_POINTS];
} Carried;

/* The state of `old`, whose points are `at`, carried to the elements of `cut`. */
static void remap(const Cut *old, const Points *at, const Table *table, Cut *cut) {
    int64_t n = table->points, modes = table->modes, from = points_of(old);
    Carried part[MOST_ELEMENTS];
    Real slope[MOST_POINTS], rise[MOST_POINTS], least = of(INFINITY);
    for (int64_t k = 0; k < old->elements; k++) {
        for (int64_t i = 0; i < from; i++) {
            least = smaller(least, old->state[k].w[i]);
            rise[i] = at[k].q[i] - at[k].e[i];
        }
        to_series(old->grid[0].table, old->state[k].w, part[k].w);
        to_series(old->grid[0].table, rise, part[k].rise);
        to_series(old->grid[0].table, at[k].e, part[k].e);
        to_series(old->grid[0].table, at[k].log + from, part[k].log2);
    }
    lay_elements(cut, table);
    for (int64_t k = 0; k < cut->elements; k++) {
        State *new = &cut->state[k];
        Real half = 1.0 / cut->grid[k].dxi;
        for (int64_t i = 0; i < n; i++) {
            Real x = half * (table->xi[i] + 1.0) + cut->breaks[k];
            int64_t element = element_at(old, x);
            const Grid *grid = &old->grid[element];
            slope[i] = carried_to(grid, part[element].rise, x) * half;
            new->w[i] = larger(carried_to(grid, part[element].w, x), least);
            cut->natural[k][i] = carried_to(grid, part[element].log2, x);
        }
        for (int64_t i = 0; i < modes; i++) new->c[i] = across(n, table->to_modes + i * n, slope);
        for (int64_t end = 0; end < 2; end++) {
            Real x = cut->breaks[k + end];
            int64_t element = element_at(old, x), inside = k + end > 0 && k + end < cut->elements;
            new->c[modes + end] = inside ? carried_to(&old->grid[element], part[element].e, x) : of(0.0);
        }
    }
}

/* The same state with more modes. */
static void prolong_cut(Cut *cut, const Table *to) {
    const Table *from = cut->grid[0].table;
    for (int64_t k = 0; k < cut->elements; k++) {
        State *state = &cut->state[k];
        Real left = state->c[from->modes], right = state->c[from->modes + 1];
        prolong(from, to, from->carry, state);
        for (int64_t i = from->modes; i < to->modes; i++) state->c[i] = of(0.0);
        state->c[to->modes] = left;
        state->c[to->modes + 1] = right;
        carried(to->points, from->points, from->carry, cut->natural[k]);
    }
    lay_elements(cut, to);
}

/* The points of a solved state. */
static void evaluate_cut(Problem *problem, const Cut *cut, Points *at) {
    for (int64_t k = 0; k < cut->elements; k++)
        evaluate(problem, &cut->grid[k], &cut->state[k], cut->folded[k] ? cut->natural[k] : NULL, &at[k]);
}

/* What a state that is one cone is less sure of: two resolutions may agree by chance. `before` is the change of the
   force that led to `previous`. */
static double of_cones(const Zones *zones, double before) {
    return panels_of(zones) == 0 ? SOFT_BEFORE_FACTOR * before : 0.0;
}

#if LANES == 1

/* The film with the elements of `cut`, from the state `old` with the points `at`, to `tolerance`. Returns WRINKLED,
   with the points in `at`. */
static int refine_cut(Problem *problem, const Table *const *tables, int64_t modes, double tolerance, const Cut *old,
                      const Zones *zones, Cut *cut, Points *at, Iterate *found, double *error) {
    double previous = NAN, tail_before = NAN, before = INFINITY, aim = goal(tolerance);
    int64_t steps = found->steps;
    cut->elements = zones->elements;
    memcpy(cut->folded, zones->folded, sizeof cut->folded);
    memcpy(cut->breaks, zones->breaks, sizeof cut->breaks);
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
        *error = estimate(found, previous, tail_before, tolerance, CUT_LEVEL_FACTOR) + of_cones(zones, before);
        if (fabs(previous) < INFINITY) before = fabs((found->lam - previous) / found->lam);
        if (*error <= tolerance) break;
        previous = found->lam;
        tail_before = found->tail;
        modes = tables[modes]->next;
    }
    evaluate_cut(problem, cut, at);
    return WRINKLED;
}

/* From a plain state of one element, whose points are `at`, to the wrinkled one at `tolerance`; other zones than before
   once more. Returns WRINKLED, with the points in `at`. */
static int fold(Problem *problem, const Table *const *tables, const int64_t *first_modes, double tolerance,
                const Grid *grid, const State *state, Points *at, Cut *cut, Iterate *found, double *error) {
    Cut old;
    Zones zones, now;
    Tensions seen;
    uncut(grid, state, &old);
    tensions(&old, at, &seen);
    int good = zones_now(&old, &seen, 0, &zones);
    for (int64_t round = 0; round < ROUNDS && good; round++) {
        int64_t modes = modes_for(&zones, first_modes);
        int status = refine_cut(problem, tables, modes, tolerance, &old, &zones, cut, at, found, error);
        if (status != WRINKLED) return status;
        tensions(cut, at, &seen);
        allow(&seen, tolerance);
        good = zones_now(cut, &seen, 0, &now);
        if (good && has_zones(cut, &now, 0)) return WRINKLED;
        old = *cut;
        zones = now;
    }
    return LEFT_TO_OTHERS;
}

#endif

/* Derivatives of the force of a wrinkled film, every element with its modes. */
static void cut_derivatives(const Problem *problem, const Cut *cut, const Points *at, Real lam, Derivatives *out) {
    Reduced part[MOST_ELEMENTS];
    System system;
    Real dc[MOST_UNKNOWNS], local[MOST_FUNCTIONS], de[MOST_POINTS], dq[MOST_POINTS], dw[MOST_POINTS];
    int64_t modes = modes_of(cut), own = cut->elements * modes;
    clear_system(&system, own + cut->elements - 1);
    for (int64_t k = 0; k < cut->elements; k++) {
        reduce(&cut->grid[k], cut->state[k].w, &at[k], &part[k]);
        add_element(cut, &part[k], own, k * modes, k, &system);
    }
    factor(system.size, system.coupling, system.give, system.matrix, system.diagonal);
    for (int64_t i = 0; i < system.size; i++) dc[i] = -(system.coupling[i] / system.give);
    substitute(system.size, system.matrix, dc);
    Real stiffness = (1.0 + dot(system.size, system.coupling, dc)) / system.give;
    for (int64_t k = 0; k < MOST_PARAMETERS; k++) out->mu[k] = out->alpha[k] = of(0.0);
    out->log_field = out->log_prestretch = out->span = of(0.0);
    out->height = stiffness;
    for (int64_t k = 0; k < cut->elements; k++) {
        local_part(cut, dc, own, k * modes, k, local);
        slopes(&cut->grid[k], &part[k], local, stiffness, 0, de, dq, dw);
        add_derivatives(problem, &cut->grid[k], cut->state[k].w, &at[k], cut->folded[k], lam, local, dw, stiffness,
                        out);
    }
}

#endif
