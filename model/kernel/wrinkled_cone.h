/* Wrinkled elements as straight cones: model/membrane/wrinkled_cone.py. */
#ifndef DEA_WRINKLED_CONE_H
#define DEA_WRINKLED_CONE_H

#include "output.h"

enum {
    MOST_CUT_MODES = 18,
    MOST_UNKNOWNS = MOST_ELEMENTS * MOST_CUT_MODES + MOST_ELEMENTS - 1,
    WIDTH_STEPS = 8,
};
#define NEAR 1e-2

/* Elements between breaks from disk to ring, and which are wrinkled. */
typedef struct {
    int64_t elements, folded[MOST_ELEMENTS];
    double breaks[MOST_ELEMENTS + 1];
} Zones;

/* A film cut in elements. The unknowns are the modes of its elements, one after the other, then the strains e at the
   cuts; each element has them as coefficients of its modes and of its two hats. */
typedef struct {
    int64_t elements, folded[MOST_ELEMENTS];
    Real breaks[MOST_ELEMENTS + 1];
    Grid grid[MOST_ELEMENTS];
    State state[MOST_ELEMENTS];
    Real natural[MOST_ELEMENTS][MOST_POINTS]; /* ln(l2) that makes no hoop stress */
} Cut;

/* A wrinkled element. */
typedef struct {
    Real u[MOST_POINTS]; /* ln(l1/lp) */
    Real cos, sin;
    Real pull; /* R S1, in units of G/lp; NaN until the law has told */
} Cone;

/* A cone linearised: how it answers a change of its pull, and what it adds to the film's Newton system. */
typedef struct {
    Real rate[MOST_POINTS], rest[MOST_POINTS], change[MOST_POINTS], follow[MOST_POINTS];
    Real miss, soft, skew, give, height;
    Real share; /* largest Maxwell stress over stress */
    Mask regular;
} Spring;

/* Newton's system of a film: `Reduced` of more than one element. */
typedef struct {
    int64_t size;
    Real matrix[MOST_UNKNOWNS * (MOST_UNKNOWNS + 1) / 2], diagonal[MOST_UNKNOWNS];
    Real residual[MOST_UNKNOWNS], coupling[MOST_UNKNOWNS];
    Real give, reach;
    Mask positive;
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
static void local_part(const Cut *cut, const Real *x, int64_t own, int64_t first, int64_t k, Real *c) {
    int64_t modes = modes_of(cut);
    for (int64_t i = 0; i < modes; i++) c[i] = x[first + i];
    for (int64_t end = 0; end < 2; end++) {
        int64_t place = cut_place(cut, own, k + end);
        c[modes + end] = place < 0 ? of(0.0) : x[place];
    }
}

static void clear_system(System *system, int64_t size) {
    system->size = size;
    for (int64_t i = 0; i < size * (size + 1) / 2; i++) system->matrix[i] = of(0.0);
    for (int64_t i = 0; i < size; i++) system->residual[i] = system->coupling[i] = of(0.0);
    system->give = system->reach = of(0.0);
    system->positive = yes();
}

static void add_to_matrix(System *system, int64_t i, int64_t j, Real value) {
    int64_t row = i > j ? i : j, column = i > j ? j : i;
    system->matrix[row * (row + 1) / 2 + column] += value;
}

/* Add an element, whose modes begin at `first`. */
static void add_element(const Cut *cut, const Reduced *part, int64_t own, int64_t first, int64_t k, System *system) {
    int64_t modes = modes_of(cut), place[MOST_FUNCTIONS];
    const Real *row = part->matrix;
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
    system->positive &= part->positive;
}

/* The law at a cone's points, relaxed and linearised at the natural width. */
static Mask folded_law(Problem *problem, int64_t n, const Real *u, const Real *natural, Stress *law, Real *change,
                      Real *follow) {
    Real log[3 * MOST_POINTS];
    for (int64_t i = 0; i < n; i++) {
        log[i] = u[i] + problem->log_prestretch;
        log[n + i] = natural[i];
        log[2 * n + i] = -(log[i] + log[n + i]);
    }
    stress(problem, n, log, law);
    problem->relaxed += counted(problem->counts, n);
    return relax(n, law, change, follow);
}

/* Cones read from the state of the whole film, with natural widths near enough for Newton to take them along. */
static void read_cones(Problem *problem, Cut *cut, Cone *cones) {
    int64_t n = points_of(cut);
    Real e[MOST_POINTS], q[MOST_POINTS], change[MOST_POINTS], follow[MOST_POINTS];
    Stress law;
    for (int64_t k = 0; k < cut->elements; k++) {
        if (!cut->folded[k]) continue;
        const Real *w = cut->state[k].w, *once = cut->grid[k].once;
        Real level = of(0.0), down = of(0.0);
        strain(&cut->grid[k], cut->state[k].c, e, q);
        for (int64_t i = 0; i < n; i++) {
            level += once[i] * (1.0 + q[i]);
            down += once[i] * w[i];
            cones[k].u[i] = 0.5 * log1p_of(q[i] * (q[i] + 2.0) + w[i] * w[i]);
        }
        Real length = sqrt_of(level * level + down * down);
        cones[k].cos = level / length;
        cones[k].sin = down / length;
        cones[k].pull = of(NAN);
    }
    Mask every = problem->counts, going = every;
    for (int64_t step = 0; step < WIDTH_STEPS && any(going); step++) {
        Real most = of(0.0);
        problem->counts = going;
        for (int64_t k = 0; k < cut->elements; k++) {
            if (!cut->folded[k]) continue;
            folded_law(problem, n, cones[k].u, cut->natural[k], &law, change, follow);
            for (int64_t i = 0; i < n; i++) {
                Real width = cut->natural[k][i];
                cut->natural[k][i] = pick(going, width + clipped(change[i], 0.3), width);
                most = larger(most, abs_of(change[i]));
            }
        }
        going &= most > NEAR;
    }
    problem->counts = every;
}

/* Linearise a cone: `Cones.pulled` and `Springs.of`. */
static void spring_of(Problem *problem, const Cut *cut, int64_t k, Cone *cone, Spring *out) {
    const Grid *grid = &cut->grid[k];
    int64_t n = points_of(cut), modes = modes_of(cut);
    Stress law;
    Real s1[MOST_POINTS], stretch[MOST_POINTS], excess = of(0.0), axial = of(0.0);
    out->regular = folded_law(problem, n, cone->u, cut->natural[k], &law, out->change, out->follow);
    out->share = of(1.0);
    for (int64_t i = 0; i < n; i++) {
        stretch[i] = exp_of(cone->u[i]);
        s1[i] = law.t1[i] / stretch[i];
        out->rate[i] = stretch[i] / (law.h11[i] - law.t1[i]);
        out->share = larger(out->share, abs_of(law.maxwell[i] / law.t1[i]));
        out->regular &= out->rate[i] > 0.0;
    }
    Mask unknown = is_not(finite(cone->pull));
    if (any(unknown)) {
        Real pull = of(0.0), length = of(0.0);
        for (int64_t i = 0; i < n; i++) {
            pull += grid->once[i] * grid->radius[i] * s1[i];
            length += grid->once[i];
        }
        cone->pull = pick(unknown, pull / length, cone->pull);
    }
    for (int64_t i = 0; i < n; i++) {
        out->rest[i] = cone->pull / grid->radius[i] - s1[i];
        excess += grid->once[i] * (expm1_of(cone->u[i]) + stretch[i] * out->rate[i] * out->rest[i]);
        axial += grid->once[i] / grid->radius[i] * stretch[i] * out->rate[i];
    }
    Real first = exp_of(grid->left), last = exp_of(grid->right), cos = cone->cos, sin = cone->sin;
    Real level = (last - first + excess) / cone->pull;
    out->soft = axial * cos * cos + level * sin * sin;
    out->skew = (axial - level) * cos * sin;
    out->give = axial * level / out->soft;
    out->height = level * cone->pull * sin;
    out->miss = last * cut->state[k].c[modes + 1] - first * cut->state[k].c[modes];
    out->miss -= excess * cos - (last - first) * sin * sin / (1.0 + cos);
    out->regular &= out->soft > 0.0;
}

/* Add a spring to the system of the panels: `Springs.join`. */
static void join(const Cut *cut, int64_t own, int64_t k, const Cone *cone, const Spring *spring, System *system) {
    Real lam = cone->pull * cone->sin, ratio = spring->skew / spring->soft;
    Real force = cone->pull * cone->cos + spring->miss / spring->soft + ratio * lam;
    Real ends[2] = {-exp_of(cut->grid[k].left), exp_of(cut->grid[k].right)};
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
   largest relative change; only cones of `open` lanes bend. */
static Real bend(const Cut *cut, int64_t k, const Real *dc, Real lam, const Spring *spring, Mask open,
                 Cone *cone, Real *natural) {
    const Grid *grid = &cut->grid[k];
    Real moved = exp_of(grid->right) * dc[1] - exp_of(grid->left) * dc[0], before = cone->pull * cone->sin;
    Real h = cone->pull * cone->cos + (spring->miss + moved - spring->skew * (lam - before)) / spring->soft;
    Real pull = sqrt_of(h * h + lam * lam), most = of(0.0), size = of(0.0);
    for (int64_t i = 0; i < points_of(cut); i++) {
        Real du = spring->rate[i] * (spring->rest[i] + (pull - cone->pull) / grid->radius[i]);
        Real wider = spring->change[i] + spring->follow[i] * du;
        most = larger(most, larger(abs_of(du), abs_of(wider)));
        size = larger(size, abs_of(expm1_of(cone->u[i])));
        cone->u[i] = pick(open, cone->u[i] + clipped(du, 0.5), cone->u[i]);
        natural[i] = pick(open, natural[i] + clipped(wider, 0.5), natural[i]);
    }
    size += cone->sin * cone->sin;
    cone->cos = pick(open, h / pull, cone->cos);
    cone->sin = pick(open, lam / pull, cone->sin);
    cone->pull = pick(open, pull, cone->pull);
    return larger(most / size, abs_of(lam / before - 1.0));
}

/* The cones as elements with modes: `whole`. */
static void unroll(Cut *cut, const Cone *cones) {
    const Table *table = cut->grid[0].table;
    int64_t n = table->points, modes = table->modes;
    for (int64_t k = 0; k < cut->elements; k++) {
        if (!cut->folded[k]) continue;
        const Grid *grid = &cut->grid[k];
        const Cone *cone = &cones[k];
        Real run[MOST_POINTS], q[MOST_POINTS], slope[MOST_POINTS], half = 1.0 / grid->dxi;
        Real left = cut->state[k].c[modes] * exp_of(grid->left);
        for (int64_t i = 0; i < n; i++) {
            Real stretch = expm1_of(cone->u[i]);
            q[i] = stretch * cone->cos - cone->sin * cone->sin / (1.0 + cone->cos);
            run[i] = q[i] * grid->radius[i];
            cut->state[k].w[i] = (1.0 + stretch) * cone->sin;
        }
        for (int64_t i = 0; i < n; i++)
            slope[i] = (q[i] - (left + half * across(n, table->integrate + i * n, run)) / grid->radius[i]) * half;
        for (int64_t i = 0; i < modes; i++) cut->state[k].c[i] = across(n, table->to_modes + i * n, slope);
    }
}

#endif
