// The reduced solver: E, its gradient and Hessian against the network and the elements called one
// by one, minima against closed forms and other solvers, handles, contact, projection, memory.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"
#include "tss_neural.h"
#include "checker.h"
#include <stdio.h>

static tss_rng rng;
static double rnd(void) { return 2 * tss_rng_uniform(&rng) - 1; }

static double *doubles(size_t count) {
    double *p = (double *)calloc(count + 1, sizeof *p);
    assert_non_null(p);
    return p;
}

static double *randoms(size_t count, double size) {
    double *p = doubles(count);
    for (size_t i = 0; i < count; i++) p[i] = size * rnd();
    return p;
}

static double dot(const double *a, const double *b, size_t n) {
    double s = 0;
    for (size_t i = 0; i < n; i++) s += a[i] * b[i];
    return s;
}

static double norm(const double *a, size_t n) { return sqrt(dot(a, a, n)); }

static double distance(const double *a, const double *b, size_t n) {
    double s = 0;
    for (size_t i = 0; i < n; i++) s += (a[i] - b[i]) * (a[i] - b[i]);
    return sqrt(s);
}

// ---- scenes ---------------------------------------------------------------------------------

enum { MOST = 3 * 64 };

typedef struct scene {
    int dim, nodes, cells, coords;
    double X[MOST], mass[MOST];
    int cell[4 * 200];
    tss_elements *e;
    tss_work *work;
} scene;

// nx × ny (× nz) boxes of 2 triangles or 6 tetrahedra, lx × 1 (× 1).
static void grid(scene *s, int dim, int nx, int ny, int nz, double lx) {
    static const int six[6][4] = {{0, 1, 3, 7}, {0, 3, 2, 7}, {0, 2, 6, 7},
                                  {0, 6, 4, 7}, {0, 4, 5, 7}, {0, 5, 1, 7}};
    memset(s, 0, sizeof *s);
    s->dim = dim, nz = dim == 2 ? 0 : nz;
    int sx = nx + 1, sy = ny + 1;
    for (int i = 0; i < sx * sy * (nz + 1); i++) {
        double p[3] = {lx * (i % sx) / nx, 1.0 * (i / sx % sy) / ny,
                       nz ? 1.0 * (i / sx / sy) / nz : 0};
        for (int a = 0; a < dim; a++) s->X[i * dim + a] = p[a];
    }
    s->nodes = sx * sy * (nz + 1), s->coords = s->nodes * dim;
    for (int b = 0; b < nx * ny * (nz ? nz : 1); b++) {
        int at = (b / nx / ny * sy + b / nx % ny) * sx + b % nx, v[8];
        for (int c = 0; c < 8; c++) v[c] = at + (c & 1) + (c >> 1 & 1) * sx + (c >> 2) * sx * sy;
        int t[6] = {v[0], v[1], v[3], v[0], v[3], v[2]};
        if (dim == 2) memcpy(s->cell + 3 * s->cells, t, sizeof t), s->cells += 2;
        for (int k = 0; dim == 3 && k < 6; k++, s->cells++)
            for (int c = 0; c < 4; c++) s->cell[4 * s->cells + c] = v[six[k][c]];
    }
    for (int i = 0; i < s->coords; i++) s->mass[i] = 0.5 + 0.1 * (i / dim % 7);
}

static tss_elements_def def_of(const scene *s) {
    tss_elements_def d = tss_elements_def_default();
    d.dim = s->dim, d.nodes = s->nodes, d.X = s->X, d.cells = s->cells, d.cell = s->cell;
    d.E = 30, d.nu = 0.35;
    return d;
}

static void scene_make(scene *s, int dim, int nx, int ny, int nz) {
    grid(s, dim, nx, ny, nz, 1.5);
    tss_elements_def d = def_of(s);
    assert_int_equal(tss_elements_create(NULL, &d, &s->e), TSS_OK);
    assert_int_equal(tss_work_create(NULL, &s->work), TSS_OK);
}

static void scene_free(scene *s) { tss_elements_destroy(s->e), tss_work_destroy(s->work); }

// Few cells with weights: what only a cubature touches.
static tss_elements *few_cells(const scene *s) {
    static const int subset[3] = {1, 4, 5};
    static const double weight[3] = {3, 1.5, 2.25};
    tss_elements_def d = def_of(s);
    tss_elements *e;
    d.subset = subset, d.count = 3, d.weight = weight;
    assert_int_equal(tss_elements_create(NULL, &d, &e), TSS_OK);
    return e;
}

enum { NARROW, WIDE, SCATTER, PLAIN, LINEAR, MAPS };

// Every way in which a decoder can end: a matrix with fewer and with more columns than the hidden
// layer, a scaled scatter, nothing, a matrix after one linear layer.
static tss_net *decoder_of(const scene *s, int r, tss_activation a, int map) {
    tss_net_def d = tss_net_def_default();
    int width[4] = {r, 9, 7, 5}, index[MOST];
    double *B = randoms((size_t)s->coords * 11, 0.25);
    for (int i = 0; i < s->coords - 5; i++) index[i] = i + 5;
    d.layers = 3, d.width = width, d.activation = a, d.seed = 11;
    d.outputs = s->coords, d.out_base = s->X, d.out_matrix = B;
    if (map == WIDE) width[3] = 11;
    if (map == LINEAR) d.layers = 1, width[1] = 4;
    if (map == SCATTER) width[3] = s->coords - 5, d.out_index = index, d.out_scale = 0.3;
    if (map == PLAIN) width[3] = s->coords, d.outputs = 0, d.out_base = NULL;
    if (map == SCATTER || map == PLAIN) d.out_matrix = NULL;
    tss_net *n;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    if (map == PLAIN) {  // the bias of the last layer takes the place of x0
        tss_net_info i;
        tss_net_get_info(n, &i);
        for (int k = 0; k < s->coords; k++)
            tss_net_parameters(n)[i.parameters - (size_t)s->coords + (size_t)k] += s->X[k];
    }
    free(B);
    return n;
}

// ---- E, by calling one thing after the other ------------------------------------------------

typedef struct plain {
    const scene *s;
    const tss_net *n;
    const tss_elements *e;
    tss_reduced_def d;
    double q[MOST], force[MOST], handle_x[MOST];
    int handles, handle[64];
} plain;

static double plain_energy(const plain *p, const double *z, double *g) {
    double x[MOST], bar[MOST] = {0}, E = 0;
    int dim = p->s->dim;
    tss_net_forward(p->n, p->s->work, 1, z, x);
    for (int k = 0; k < p->handles; k++)
        memcpy(x + p->handle[k] * dim, p->handle_x + k * dim, (size_t)dim * sizeof *x);
    E = tss_elements_potential(p->e, x, bar);
    for (int i = 0; i < p->s->coords; i++) {
        double m = p->d.h > 0 ? p->s->mass[i] / (p->d.h * p->d.h) : 0;
        E += 0.5 * m * (x[i] - p->q[i]) * (x[i] - p->q[i]) - p->force[i] * x[i];
        bar[i] += m * (x[i] - p->q[i]) - p->force[i];
    }
    for (int k = 0; p->d.sdf && k < (p->d.contact_node ? p->d.contact_count : p->s->nodes); k++) {
        int i = p->d.contact_node ? p->d.contact_node[k] : k;
        double n[3], gap = p->d.sdf(p->d.sdf_user, x + i * dim, n) - p->d.contact_margin;
        double f = p->d.contact_stiffness * (p->d.contact_weight ? p->d.contact_weight[k] : 1);
        if (gap >= 0) continue;
        E += 0.5 * f * gap * gap;
        for (int a = 0; a < dim; a++) bar[i * dim + a] += f * gap * n[a];
    }
    for (int k = 0; k < p->handles; k++)
        for (int a = 0; a < dim; a++) bar[p->handle[k] * dim + a] = 0;
    if (g) {
        memset(g, 0, (size_t)p->n->inputs * sizeof *g);
        tss_net_backward(p->n, p->s->work, 1, z, bar, NULL, g);
    }
    return E;
}

// E, ∇E (against the plain path) and ∇²E (against differences of the plain gradient) of what the
// next step would minimise.
static void check_energy(tss_reduced *sim, plain *p, const char *name) {
    enum { R = 3 };
    double z[R], g[R], g2[R], H[R * R], up[R], down[R];
    for (int k = 0; k < R; k++) z[k] = tss_reduced_z(sim)[k] + 0.2 * rnd();
    tss__reduced_prepare(sim);
    double E = plain_energy(p, z, g), size = fabs(E) + norm(g, R);
    double got = tss__reduced_energy(sim, z, g2, NULL);
    if (!(fabs(got - E) < 1e-12 * size) || !(distance(g, g2, R) < 1e-12 * size))
        fail_msg("%s: E %.17g, expected %.17g; gradient off by %g of %g", name, got, E,
                 distance(g, g2, R), size);
    got = tss__reduced_energy(sim, z, g2, H);
    if (!(fabs(got - E) < 1e-12 * size && distance(g, g2, R) < 1e-12 * size))
        fail_msg("%s: with the Hessian, E %.17g, expected %.17g; gradient off by %g of %g", name,
                 got, E, distance(g, g2, R), size);
    for (int a = 0; a < R; a++) {
        double best = INFINITY;
        for (double h = 1e-3; h > 1e-7; h *= 0.2) {
            double keep = z[a], gap = 0;
            z[a] = keep + h, plain_energy(p, z, up);
            z[a] = keep - h, plain_energy(p, z, down);
            z[a] = keep;
            for (int b = 0; b < R; b++) gap += pow((up[b] - down[b]) / (2 * h) - H[a * R + b], 2);
            best = fmin(best, sqrt(gap));
        }
        if (!(best < 1e-7 * (1 + norm(H, R * R))))
            fail_msg("%s: row %d of the Hessian is off by %g of %g", name, a, best, norm(H, R * R));
    }
}

static void test_energy(void **state) {
    (void)state;
    enum { R = 3 };
    for (int dim = 2; dim <= 3; dim++)
        for (int map = 0; map < MAPS; map++)
            for (int kind = 0; kind < 4; kind++) {  // dynamic?, cubature?
                scene s;
                scene_make(&s, dim, 3, 1, 1);
                plain p;
                memset(&p, 0, sizeof p);
                tss_net *n = decoder_of(&s, R, TSS_SILU, map);
                tss_elements *few = few_cells(&s);
                tss_halfspace floor_ = {dim, {0, 0.2, 0}, {0, 1, 0}};
                int touching[4] = {1, 3, 0, 6};
                double area[4] = {1, 0.5, 2, 0.7};
                p.s = &s, p.n = n, p.e = kind & 1 ? few : s.e, p.d = tss_reduced_def_default();
                p.d.decoder = n, p.d.elements = p.e, p.d.mass = s.mass, p.d.h = kind & 2 ? 0.1 : 0;
                p.d.sdf = tss_sdf_halfspace, p.d.sdf_user = &floor_, p.d.contact_stiffness = 7;
                p.d.contact_margin = 0.05;
                if (kind & 1)
                    p.d.contact_count = 4, p.d.contact_node = touching, p.d.contact_weight = area;
                p.d.solver = TSS_PROJECTED_NEWTON;
                p.d.max_iterations = 3;  // states on the way, nowhere special
                tss_reduced *sim;
                assert_int_equal(tss_reduced_create(NULL, &p.d, &sim), TSS_OK);
                for (int i = 0; i < s.coords; i++) p.force[i] = 0.3 * rnd();
                tss_reduced_set_force(sim, p.force);
                double x[MOST], last[MOST];
                memcpy(x, tss_reduced_x(sim), sizeof(double) * (size_t)s.coords);
                memcpy(last, x, sizeof x);
                // Handles come, move, change and go.
                for (int step = 0; step < 6; step++) {
                    static const int sets[6][4] = {{0}, {2, 4, 1}, {2, 4, 1}, {2, 1, 7}, {0}, {0}};
                    p.handles = sets[step][0];
                    for (int k = 0; k < p.handles; k++) {
                        p.handle[k] = sets[step][k + 1];
                        for (int a = 0; a < dim; a++)
                            p.handle_x[k * dim + a] = s.X[p.handle[k] * dim + a] + 0.2 * rnd();
                    }
                    assert_int_equal(tss_reduced_set_handles(sim, p.handles, p.handle, p.handle_x),
                                     TSS_OK);
                    for (int i = 0; i < s.coords; i++) p.q[i] = 2 * x[i] - last[i];
                    char name[96];
                    snprintf(name, sizeof name, "%dD, map %d, kind %d, step %d", dim, map, kind,
                             step);
                    check_energy(sim, &p, name);
                    tss_reduced_info info;
                    assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
                    double g[R], E = plain_energy(&p, tss_reduced_z(sim), g);
                    assert_true(fabs(E - info.energy) < 1e-11 * (1 + fabs(E)));
                    memcpy(last, x, sizeof x);
                    memcpy(x, tss_reduced_x(sim), sizeof(double) * (size_t)s.coords);
                    // f(z) as the network gives it, handles to the bit.
                    double f[MOST];
                    tss_net_forward(n, s.work, 1, tss_reduced_z(sim), f);
                    for (int k = 0; k < p.handles; k++)
                        memcpy(f + p.handle[k] * dim, p.handle_x + k * dim,
                               sizeof(double) * (size_t)dim);
                    assert_true(distance(f, x, (size_t)s.coords) < 1e-14);
                    for (int k = 0; k < p.handles; k++)
                        assert_memory_equal(f + p.handle[k] * dim, x + p.handle[k] * dim,
                                            sizeof(double) * (size_t)dim);
                }
                tss_reduced_destroy(sim), tss_elements_destroy(few), tss_net_destroy(n);
                scene_free(&s);
            }
}

// ---- elements -------------------------------------------------------------------------------

// Eight cells at a time against one by one: at rest, turned, inverted, far; any number of cells.
static void test_lanes(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int count = 1; count <= 18; count += 1 + count / 9)
            for (int kind = 0; kind < 6; kind++) {
                scene s;
                grid(&s, dim, 4, 3, 1, 1.5);
                tss_elements_def d = def_of(&s);
                d.cells = count;
                assert_int_equal(tss_elements_create(NULL, &d, &s.e), TSS_OK);
                double x[MOST], a[MOST] = {0}, b[MOST] = {0}, P, size = 0;
                for (int i = 0; i < s.nodes; i++)
                    for (int c = 0; c < dim; c++) {
                        double X = s.X[i * dim + c], Y = s.X[i * dim + (c + 1) % dim];
                        double turned = dim == 3 || c == 0 ? Y : -Y;  // by 120 or 90 degrees
                        x[i * dim + c] = kind == 0   ? X
                                         : kind == 1 ? turned
                                         : kind == 2 ? X * (c ? 1 : -0.5) + 0.1 * rnd()
                                         : kind == 3 ? X + 1e-9 * rnd()
                                         : kind == 4 ? X + 0.3 * rnd()
                                                     : 0;
                    }
                double Q = tss_elements_potential(s.e, x, a);
                assert_int_equal(tss_elements_jets(s.e, 0, x, NULL, NULL, NULL, &P, NULL, NULL, 1,
                                                   NULL, 0, b, NULL, NULL),
                                 TSS_OK);
                for (int i = 0; i < s.coords; i++) size = fmax(size, fabs(b[i]));
                assert_true(fabs(P - Q) <= 1e-13 * fabs(P) + 1e-28);
                assert_true(distance(a, b, (size_t)s.coords) <= 1e-13 * size + 1e-13);
                assert_true(tss_elements_potential(s.e, x, NULL) == Q);
                tss_elements_destroy(s.e);
            }
}

// ---- projected Newton -----------------------------------------------------------------------

static void check_eigen(int r, const double *A) {
    double *work = doubles((size_t)(r * r)), *V = doubles((size_t)(r * r)), *l = doubles((size_t)r);
    double size = norm(A, (size_t)(r * r)) + 1e-300;
    memcpy(work, A, sizeof(double) * (size_t)(r * r));
    tss__eigen(r, work, V, l);
    for (int a = 0; a < r; a++) {
        for (int b = 0; b <= a; b++)
            assert_true(fabs(dot(V + a * r, V + b * r, (size_t)r) - (a == b)) < 1e-13);
        for (int i = 0; i < r; i++)
            assert_true(fabs(dot(A + i * r, V + a * r, (size_t)r) - l[a] * V[a * r + i]) <=
                        1e-13 * size);
    }
    free(work), free(V), free(l);
}

// Random, rank one, repeated, zero, 1 × 1, and one with a range of 1e12 whose eigenvalues are
// known.
static void test_eigen(void **state) {
    (void)state;
    for (int r = 1; r <= 40; r += 1 + r / 2) {
        double *A = doubles((size_t)(r * r)), *u = randoms((size_t)r, 1);
        check_eigen(r, A);
        for (int a = 0; a < r; a++)
            for (int b = 0; b < r; b++) A[a * r + b] = u[a] * u[b];
        check_eigen(r, A);
        for (int a = 0; a < r; a++) A[a * r + a] += 3;
        check_eigen(r, A);
        for (int a = 0; a < r; a++)
            for (int b = 0; b <= a; b++) A[a * r + b] = A[b * r + a] = rnd();
        check_eigen(r, A);
        for (int a = 0; a < r; a++)  // −u'' on a line: 2 − 2 cos(kπ / (r + 1))
            for (int b = 0; b < r; b++) A[a * r + b] = a == b ? 2 : abs(a - b) == 1 ? -1 : 0;
        double *V = doubles((size_t)(r * r)), *l = doubles((size_t)r);
        tss__eigen(r, A, V, l);
        for (int k = 1; k <= r; k++) {
            double exact = 2 - 2 * cos(3.14159265358979323846 * k / (r + 1)), gap = INFINITY;
            for (int a = 0; a < r; a++) gap = fmin(gap, fabs(l[a] - exact));
            assert_true(gap < 1e-13);
        }
        free(A), free(u), free(V), free(l);
    }
}

// Where P is least; from there on the nonlinear decoders here have one minimum a step.
static void rest_of(const scene *s, const tss_net *n, int r, double *z) {
    tss_reduced_def d = tss_reduced_def_default();
    tss_reduced *sim;
    d.decoder = n, d.elements = s->e, d.h = 0, d.solver = TSS_PROJECTED_NEWTON;
    assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
    assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);
    memcpy(z, tss_reduced_z(sim), (size_t)r * sizeof *z);
    tss_reduced_destroy(sim);
}

// The same minima by all, by projected Newton and BFGS in fewer iterations than by L-BFGS.
static void test_newton(void **state) {
    (void)state;
    enum { R = 4 };
    for (int dim = 2; dim <= 3; dim++) {
        scene s;
        scene_make(&s, dim, 4, 1, 1);
        tss_net *n = decoder_of(&s, R, TSS_SILU, NARROW);
        double *force = randoms((size_t)s.coords, 2), *x = doubles((size_t)s.coords), rest[R];
        int iterations[3] = {0};
        rest_of(&s, n, R, rest);
        for (int k = 0; k < 3; k++) {
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim;
            d.decoder = n, d.elements = s.e, d.mass = s.mass, d.h = 0.1, d.ftol = 0, d.eps = 1e-9;
            d.tol = 1e-10, d.start = rest, d.solver = (tss_reduced_method)k;
            assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
            tss_reduced_set_force(sim, force);
            for (int step = 0; step < 5; step++) {
                tss_reduced_info info;
                assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
                assert_int_equal(info.exit, TSS_EXIT_CONVERGED);
                if (k == TSS_BFGS)  // where it begins, and before that step ends
                    assert_int_equal(info.hessians, step ? 0 : 2);
                else
                    assert_int_equal(info.hessians, k == TSS_LBFGS ? 0 : info.iterations);
                iterations[k] += info.iterations;
            }
            if (k)
                assert_true(distance(x, tss_reduced_x(sim), (size_t)s.coords) < 1e-8);
            else
                memcpy(x, tss_reduced_x(sim), sizeof(double) * (size_t)s.coords);
            assert_true(distance(s.X, x, (size_t)s.coords) > 0.05);
            tss_reduced_destroy(sim);
        }
        print_message("%dD, 5 steps: iterations: L-BFGS %d, projected Newton %d, BFGS %d\n", dim,
                      iterations[TSS_LBFGS], iterations[TSS_PROJECTED_NEWTON],
                      iterations[TSS_BFGS]);
        assert_true(2 * iterations[TSS_PROJECTED_NEWTON] < iterations[TSS_LBFGS]);
        assert_true(iterations[TSS_BFGS] < iterations[TSS_LBFGS]);
        tss_net_destroy(n), scene_free(&s), free(force), free(x);
    }
}

// ---- BFGS -----------------------------------------------------------------------------------

// z times 2^e: all that this changes of a number are its exponents.
static void stretch(tss_net *n, int r, int e) {
    for (int i = 0; i < r * 9; i++)  // the first layer of decoder_of is r × 9
        tss_net_parameters(n)[i] = ldexp(tss_net_parameters(n)[i], -e);
}

// In any unit of z the same states, bit by bit, by as many evaluations; of L-BFGS neither is so.
static void test_bfgs_unit(void **state) {
    (void)state;
    enum { R = 4 };
    scene s;
    scene_make(&s, 3, 4, 1, 1);
    double *force = randoms((size_t)s.coords, 2);
    for (int k = 0; k < 2; k++) {
        double x[MOST];
        int evaluations[3] = {0}, same = 1;
        for (int unit = 0; unit < 3; unit++) {
            rng = tss_rng_seed(5);  // decoder_of draws from it
            tss_net *n = decoder_of(&s, R, TSS_SILU, NARROW);
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim;
            stretch(n, R, 20 * (unit - 1));
            d.decoder = n, d.elements = s.e, d.mass = s.mass, d.h = 0.1;
            if (k) d.solver = TSS_LBFGS;
            assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
            tss_reduced_set_force(sim, force);
            for (int step = 0; step < 8; step++) {
                tss_reduced_info info;
                assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
                assert_true(k || info.exit == TSS_EXIT_CONVERGED);
                evaluations[unit] += info.evaluations;
            }
            size_t bytes = (size_t)s.coords * sizeof *x;
            if (unit)
                same = same && memcmp(x, tss_reduced_x(sim), bytes) == 0;
            else
                memcpy(x, tss_reduced_x(sim), bytes);
            tss_reduced_destroy(sim), tss_net_destroy(n);
        }
        print_message("z times 2^-20, 1, 2^20: %d, %d, %d evaluations of %s\n", evaluations[0],
                      evaluations[1], evaluations[2], k ? "L-BFGS" : "BFGS");
        int alike = evaluations[0] == evaluations[1] && evaluations[1] == evaluations[2];
        assert_int_equal(same && alike, !k);
        assert_true(k || distance(s.X, x, (size_t)s.coords) > 0.05);
    }
    scene_free(&s), free(force);
}

// ‖x − y‖_M over ‖X − its centre‖_M.
static double moved(const scene *s, const double *x, const double *y) {
    double gap = 0, size = 0;
    for (int a = 0; a < s->dim; a++) {
        double mean = 0;
        for (int i = a; i < s->coords; i += s->dim) mean += s->X[i] / s->nodes;
        for (int i = a; i < s->coords; i += s->dim) {
            gap += s->mass[i] * (x[i] - y[i]) * (x[i] - y[i]);
            size += s->mass[i] * (s->X[i] - mean) * (s->X[i] - mean);
        }
    }
    return sqrt(gap / size);
}

// Each step ends as near to its minimum as tol says, which projected Newton finds from the same
// state; the tightest takes more evaluations than the loosest. A body at rest takes few.
static void test_bfgs_tol(void **state) {
    (void)state;
    enum { R = 4, STEPS = 6 };
    scene s;
    scene_make(&s, 3, 4, 1, 1);
    tss_net *n = decoder_of(&s, R, TSS_SILU, NARROW);
    double *force = randoms((size_t)s.coords, 0.2), rest[R];
    int loosest = 0;
    rest_of(&s, n, R, rest);
    for (int k = 2; k <= 8; k += 2) {
        tss_reduced_def d = tss_reduced_def_default(), exact = d;
        tss_reduced *sim, *newton;
        tss_reduced_info info;
        int evaluations = 0;
        double most = 0;
        d.decoder = n, d.elements = s.e, d.mass = s.mass, d.h = 0, d.tol = pow(10, -k);
        d.start = rest;
        exact = d, exact.solver = TSS_PROJECTED_NEWTON, exact.eps = 1e-10, exact.ftol = 0;
        assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
        assert_int_equal(tss_reduced_create(NULL, &exact, &newton), TSS_OK);
        for (int step = 0; step < STEPS; step++) {
            double f[MOST];
            for (int i = 0; i < s.coords; i++) f[i] = (1 + 0.2 * step) * force[i];
            tss_reduced_set_force(sim, f), tss_reduced_set_force(newton, f);
            assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
            assert_int_equal(info.exit, TSS_EXIT_CONVERGED);
            evaluations += step ? info.evaluations : 0;  // the first has everything to learn
            assert_int_equal(tss_reduced_step(newton, &info), TSS_OK);
            most = fmax(most, moved(&s, tss_reduced_x(sim), tss_reduced_x(newton)));
        }
        print_message("tol %g: %d evaluations in %d steps, at most %.1e from the minimum\n", d.tol,
                      evaluations, STEPS - 1, most);
        assert_true(most <= d.tol);
        if (k == 2) loosest = evaluations;
        if (k == 8) assert_true(evaluations > loosest);
        // The same forces again: nothing is left to do.
        for (int step = 0; step < 3; step++) assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
        assert_true(info.evaluations <= 4);
        tss_reduced_destroy(sim), tss_reduced_destroy(newton);
    }
    tss_net_destroy(n), scene_free(&s), free(force);
}

static tss_net *mover(const scene *s);

// The floor that a block lay on is gone: the first step of its fall is g h², whatever H knew.
static void test_bfgs_contact_opens(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 3, 3, 1, 1);
    tss_net *n = mover(&s);
    tss_halfspace ground = {3, {0, 0, 0}, {0, 1, 0}};
    tss_reduced_def d = tss_reduced_def_default();
    tss_reduced *sim;
    tss_reduced_info info;
    double force[MOST] = {0};
    for (int i = 0; i < s.nodes; i++) force[3 * i + 1] = -9.81 * s.mass[3 * i];
    d.decoder = n, d.elements = s.e, d.mass = s.mass, d.h = 0.01, d.sdf = tss_sdf_halfspace,
    d.sdf_user = &ground, d.contact_stiffness = 1e7;
    assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
    tss_reduced_set_force(sim, force);
    for (int k = 0; k < 60; k++) assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
    double rest = tss_reduced_x(sim)[1];
    assert_true(rest < 0 && rest > -1e-4);
    ground.point[1] = -10;
    assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
    double fall = rest - tss_reduced_x(sim)[1], g_h2 = 9.81 * d.h * d.h;
    print_message("contact opens: falls %.4g, g h² is %.4g, %d evaluations\n", fall, g_h2,
                  info.evaluations);
    assert_true(fabs(fall - g_h2) < 0.05 * g_h2);
    tss_reduced_destroy(sim), tss_net_destroy(n), scene_free(&s);
}

// Steps so short that a block falls by 1e-8 to 1e-3 of its size in one: each is g h² longer than
// the one before. Nothing is too small to move.
static void test_bfgs_short_steps(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 3, 3, 1, 1);
    tss_net *n = mover(&s);
    double force[MOST] = {0};
    for (int i = 0; i < s.nodes; i++) force[3 * i + 1] = -9.81 * s.mass[3 * i];
    for (double h = 3e-5; h < 2e-2; h *= 1.7) {
        enum { STEPS = 50 };
        tss_reduced_def d = tss_reduced_def_default();
        tss_reduced *sim;
        d.decoder = n, d.elements = s.e, d.mass = s.mass, d.h = h;
        assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
        tss_reduced_set_force(sim, force);
        for (int k = 0; k < STEPS; k++) assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);
        double fall = 9.81 * h * h * STEPS * (STEPS + 1) / 2;
        assert_true(fabs(tss_reduced_x(sim)[1] + fall) < 1e-6 * fall);
        tss_reduced_destroy(sim);
    }
    tss_net_destroy(n), scene_free(&s);
}

// Without inertia: the floor sinks by more than the body; it follows in one step, down to where the
// penalty holds it, though from the floor on nothing but the floor has a curvature.
static void test_bfgs_floor_sinks(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 3, 3, 1, 1);
    tss_net *n = mover(&s);
    tss_halfspace ground = {3, {0, 0, 0}, {0, 1, 0}};
    tss_reduced_def d = tss_reduced_def_default();
    tss_reduced *sim;
    tss_reduced_info info;
    double force[MOST] = {0}, weight = 0, below = 0;
    for (int i = 0; i < s.nodes; i++) {
        force[3 * i + 1] = -9.81 * s.mass[3 * i], weight += 9.81 * s.mass[3 * i];
        below += s.X[3 * i + 1] == 0;
    }
    d.decoder = n, d.elements = s.e, d.mass = s.mass, d.h = 0, d.sdf = tss_sdf_halfspace;
    d.sdf_user = &ground, d.contact_stiffness = 1e7;
    assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
    tss_reduced_set_force(sim, force);
    for (int k = 0; k < 4; k++) {
        ground.point[1] = -1.5 * k;
        assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
        assert_int_equal(info.exit, TSS_EXIT_CONVERGED);
        double rest = ground.point[1] - weight / (1e7 * below);
        print_message("floor at %g: %.2e above rest, %d evaluations\n", ground.point[1],
                      tss_reduced_x(sim)[1] - rest, info.evaluations);
        assert_true(fabs(tss_reduced_x(sim)[1] - rest) < d.tol);
    }
    tss_reduced_destroy(sim), tss_net_destroy(n), scene_free(&s);
}

// What H knows is forgotten where the state is set: from there the same bits as a new solver's.
static void test_bfgs_set(void **state) {
    (void)state;
    enum { R = 4 };
    scene s;
    scene_make(&s, 2, 4, 1, 1);
    tss_net *n = decoder_of(&s, R, TSS_SILU, NARROW);
    double *force = randoms((size_t)s.coords, 2), z[3][R];
    tss_reduced_def d = tss_reduced_def_default();
    tss_reduced *sim;
    const double zero[R] = {0};
    d.decoder = n, d.elements = s.e, d.mass = s.mass;
    assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
    tss_reduced_set_force(sim, force);
    for (int run = 0; run < 3; run++) {
        if (run == 2) assert_int_equal(tss_reduced_project(sim, s.X, NULL), TSS_OK);
        if (run) assert_int_equal(tss_reduced_set(sim, zero), TSS_OK);
        for (int k = 0; k < 5; k++) assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);
        memcpy(z[run], tss_reduced_z(sim), sizeof z[run]);
    }
    assert_true(norm(z[0], R) > 0);
    assert_memory_equal(z[0], z[1], sizeof z[0]);
    assert_memory_equal(z[0], z[2], sizeof z[0]);
    tss_reduced_destroy(sim);
    // So many iterations and no more, each lower than the one before.
    double last = INFINITY;
    d.tol = 0;
    for (d.max_iterations = 0; d.max_iterations < 5; d.max_iterations++) {
        tss_reduced_info info;
        assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
        tss_reduced_set_force(sim, force);
        assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
        assert_int_equal(info.exit, TSS_EXIT_ITERATIONS);
        assert_int_equal(info.iterations, d.max_iterations);
        assert_int_equal(tss_reduced_exits(sim)[TSS_EXIT_ITERATIONS], 1);
        assert_true(info.energy < last);
        last = info.energy;
        tss_reduced_destroy(sim);
    }
    tss_net_destroy(n), scene_free(&s), free(force);
}

// ---- contact --------------------------------------------------------------------------------

// f(z) = X + z: the body as a whole.
static tss_net *mover(const scene *s) {
    tss_net_def d = tss_net_def_default();
    int width[2] = {s->dim, s->dim};
    double B[MOST * 3] = {0};
    for (int i = 0; i < s->coords; i++) B[i * s->dim + i % s->dim] = 1;
    d.layers = 1, d.width = width, d.outputs = s->coords, d.out_base = s->X, d.out_matrix = B;
    tss_net *n;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    double *p = tss_net_parameters(n);
    for (int i = 0; i < s->dim * (s->dim + 1); i++)
        p[i] = i < s->dim * s->dim && i % (s->dim + 1) == 0;
    return n;
}

// A block on a floor sinks until k Σ a (depth + margin) is its weight; the floor rises, it follows.
static void test_contact_rest(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int solver = 0; solver < 3; solver++) {
            scene s;
            scene_make(&s, dim, 3, 1, 1);
            tss_net *n = mover(&s);
            tss_halfspace ground = {dim, {5, 0, 1}, {0, 1, 0}};
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim;
            double force[MOST] = {0}, area[64], all = 0, weight = 0;
            for (int i = 0; i < s.nodes; i++) {
                area[i] = 0.1 + 0.05 * (i % 3), all += s.X[i * dim + 1] == 0 ? area[i] : 0;
                force[i * dim + 1] = -9.81 * s.mass[i * dim], weight += 9.81 * s.mass[i * dim];
            }
            d.decoder = n, d.elements = s.e, d.h = 0, d.ftol = 0, d.eps = 1e-8, d.tol = 1e-10;
            d.sdf = tss_sdf_halfspace, d.sdf_user = &ground, d.contact_stiffness = 2000;
            d.contact_margin = 0.03, d.contact_weight = area;
            d.solver = (tss_reduced_method)solver;
            assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
            tss_reduced_set_force(sim, force);
            for (int k = 0; k < 2; k++) {
                ground.point[1] = 0.25 * k;
                tss_reduced_info info;
                assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
                assert_int_equal(info.exit, TSS_EXIT_CONVERGED);
                double height = 0.25 * k + 0.03 - weight / (2000 * all);
                assert_true(fabs(tss_reduced_x(sim)[1] - height) < 1e-9);
            }
            tss_reduced_destroy(sim), tss_net_destroy(n), scene_free(&s);
        }
}

// Distances against geometry, gradients against differences, the centre of a ball.
static void test_sdf(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int k = 0; k < 20; k++) {
            tss_ball ball = {dim, {rnd(), rnd(), rnd()}, 0.7};
            tss_halfspace half = {dim, {rnd(), rnd(), rnd()}, {0.6, -0.8, 0}};
            double x[3] = {2 * rnd(), 2 * rnd(), 2 * rnd()}, n[3], unused[3];
            for (int kind = 0; kind < 2; kind++) {
                double (*f)(void *, const double *, double *) =
                    kind ? tss_sdf_halfspace : tss_sdf_ball;
                void *user = kind ? (void *)&half : (void *)&ball;
                double value = f(user, x, n), h = 1e-6, foot[3];
                assert_true(fabs(norm(n, (size_t)dim) - 1) < 1e-15);
                for (int a = 0; a < dim; a++) {
                    double keep = x[a], up, down;
                    x[a] = keep + h, up = f(user, x, unused);
                    x[a] = keep - h, down = f(user, x, unused);
                    x[a] = keep, foot[a] = x[a] - value * n[a];
                    assert_true(fabs((up - down) / (2 * h) - n[a]) < 1e-8);
                }
                assert_true(fabs(f(user, foot, unused)) < 1e-14);  // the nearest point
            }
            assert_true(tss_sdf_ball(&ball, ball.center, n) == -0.7);
            assert_true(norm(n, (size_t)dim) == 1);
        }
}

// ---- projection -----------------------------------------------------------------------------

static void test_project(void **state) {
    (void)state;
    enum { R = 3 };
    for (int map = 0; map < MAPS; map++)
        for (int dim = 2; dim <= 3; dim++) {
            scene s;
            scene_make(&s, dim, 3, 1, 1);
            tss_net *n = decoder_of(&s, R, TSS_SOFTPLUS, map);
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim;
            tss_reduced_info info;
            double zero[R] = {0}, x[MOST], z[R], f[MOST], bar[MOST], g[R], at[3];
            d.decoder = n, d.elements = s.e, d.mass = s.mass;
            assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
            for (int k = 0; k < R; k++) z[k] = 0.7 * rnd();
            tss_net_forward(n, s.work, 1, z, x);
            // A point of the subspace is found again.
            assert_int_equal(tss_reduced_project(sim, x, &info), TSS_OK);
            assert_int_equal(info.exit, TSS_EXIT_CONVERGED);
            assert_true(distance(tss_reduced_x(sim), x, (size_t)s.coords) < 1e-7);
            assert_true(info.hessians > 0 && info.iterations < 60);
            // At rest there: without forces nothing but the elements moves it; x_t = x_{t−1}.
            assert_memory_equal(sim->phi, sim->phi_last, sim->m * sizeof(double));
            // Beside it: the gradient of the network's own distance vanishes, E is that distance.
            for (int i = 0; i < s.coords; i++) x[i] += 0.05 * rnd();
            assert_int_equal(tss_reduced_set(sim, zero), TSS_OK);
            assert_int_equal(tss_reduced_project(sim, x, &info), TSS_OK);
            assert_int_equal(info.exit, TSS_EXIT_CONVERGED);
            for (int side = -1; side <= 1; side++) {
                memcpy(z, tss_reduced_z(sim), sizeof z);
                z[1] += 1e-3 * side, at[side + 1] = 0;
                tss_net_forward(n, s.work, 1, z, f);
                for (int i = 0; i < s.coords; i++) {
                    at[side + 1] += 0.5 * s.mass[i] * pow(f[i] - x[i], 2);
                    if (side == 0) bar[i] = s.mass[i] * (f[i] - x[i]);
                }
            }
            memset(g, 0, sizeof g);
            tss_net_backward(n, s.work, 1, tss_reduced_z(sim), bar, NULL, g);
            assert_true(norm(g, R) < 1e-8 && at[1] > 1e-3);
            assert_true(at[1] < at[0] && at[1] < at[2] && fabs(at[1] - info.energy) < 1e-11);
            // Bad input: refused, nothing moves.
            memcpy(z, tss_reduced_z(sim), sizeof z);
            x[3] = NAN;
            assert_int_equal(tss_reduced_project(sim, x, NULL), TSS_ERROR_BAD_ARGUMENT);
            assert_memory_equal(z, tss_reduced_z(sim), sizeof z);
            tss_reduced_destroy(sim), tss_net_destroy(n), scene_free(&s);
        }
}

// ---- memory and refusals --------------------------------------------------------------------

static int allowance;
static size_t held;
static void *stingy_alloc(size_t bytes, size_t align, void *ctx) {
    (void)align, (void)ctx;
    if (allowance-- <= 0) return NULL;
    held += bytes;
    return malloc(bytes);
}
static void stingy_free(void *p, size_t bytes, void *ctx) {
    (void)ctx;
    held -= bytes;
    free(p);
}

static char logged[256];
static void keep_log(tss_log_level level, const char *text, void *ctx) {
    (void)level, (void)ctx;
    snprintf(logged, sizeof logged, "%s", text);
}

// After creation nothing is allocated, whatever is asked for; creation survives every failure.
static void test_memory(void **state) {
    (void)state;
    enum { R = 3 };
    tss_host h = tss_host_default();
    h.alloc = stingy_alloc, h.free = stingy_free, h.log = keep_log, h.workers = 1;
    for (int solver = 0; solver < 3; solver++)
        for (int cubature = 0; cubature < 2; cubature++) {
            scene s;
            scene_make(&s, 3, 3, 1, 1);
            tss_net *n = decoder_of(&s, R, TSS_ELU, SCATTER);
            tss_elements *few = few_cells(&s);
            tss_ball ball = {3, {0.5, -0.4, 0.5}, 0.6};
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim = NULL;
            d.decoder = n, d.elements = cubature ? few : s.e, d.mass = s.mass;
            d.solver = (tss_reduced_method)solver;
            d.sdf = tss_sdf_ball, d.sdf_user = &ball, d.contact_stiffness = 50;
            int limit = 0;
            for (allowance = 0; tss_reduced_create(&h, &d, &sim) == TSS_ERROR_NO_MEMORY;
                 allowance = ++limit) {
                assert_null(sim);
                assert_int_equal(held, 0);
            }
            assert_true(sim && limit >= 3);
            allowance = 0;
            double force[MOST], x[MOST];
            int all[64];
            for (int i = 0; i < s.coords; i++) force[i] = rnd(), x[i] = s.X[i] + 0.1 * rnd();
            for (int i = 0; i < s.nodes; i++) all[i] = s.nodes - 1 - i;
            tss_reduced_set_force(sim, force);
            for (int k = 0; k < 12; k++) {  // from no handles to all nodes, and back
                int count = k == 6 ? s.nodes : k % 4;
                assert_int_equal(tss_reduced_set_handles(sim, count, all, x), TSS_OK);
                if (k % 5 == 4) assert_int_equal(tss_reduced_project(sim, x, NULL), TSS_OK);
                assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);
                assert_true(isfinite(norm(tss_reduced_x(sim), (size_t)s.coords)));
                if (k == 6) {
                    for (int i = 0; i < s.nodes; i++)
                        assert_memory_equal(tss_reduced_x(sim) + 3 * all[i], x + 3 * i,
                                            3 * sizeof *x);
                }
            }
            assert_int_equal(allowance, 0);
            tss_reduced_destroy(sim);
            assert_int_equal(held, 0);
            tss_elements_destroy(few), tss_net_destroy(n), scene_free(&s);
        }
}

static void test_refusals(void **state) {
    (void)state;
    enum { R = 3 };
    scene s;
    scene_make(&s, 2, 3, 1, 1);
    tss_net *n = decoder_of(&s, R, TSS_SILU, NARROW);
    tss_host h = tss_host_default();
    h.log = keep_log;
    tss_ball ball = {2, {0, 0, 0}, 1};
    tss_reduced_def good = tss_reduced_def_default(), d;
    tss_reduced *sim;
    int far[2] = {0, 99};
    double minus[8] = {1, -1}, zeros[MOST] = {0}, nan3[R] = {0, NAN, 0};
    good.decoder = n, good.elements = s.e, good.mass = s.mass, good.sdf = tss_sdf_ball,
    good.sdf_user = &ball, good.contact_stiffness = 1;
#define REFUSED(change, word)                                                   \
    d = good, change;                                                           \
    assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_ERROR_BAD_ARGUMENT); \
    assert_null(sim), assert_non_null(strstr(logged, word)), logged[0] = 0
    REFUSED(d.decoder = NULL, "fit");
    REFUSED(d.h = -1, "h must");
    REFUSED(d.mass = NULL, "masses");
    REFUSED(d.mass = minus, "mass is");
    REFUSED(d.shift = 0, "shift");
    REFUSED((d.mass = zeros, d.h = 0), "all masses are 0");
    REFUSED(d.tol = -1, "tolerance");
    REFUSED(d.tol = NAN, "tolerance");
    REFUSED(d.solver = (tss_reduced_method)7, "solver");
    REFUSED(d.contact_stiffness = -1, "contact_stiffness");
    REFUSED(d.contact_margin = NAN, "contact_margin");
    REFUSED((d.contact_node = far, d.contact_count = 2), "contact node");
    REFUSED((d.contact_node = far, d.contact_count = -1), "contact_count");
    REFUSED(d.contact_weight = minus, "contact weight");
    REFUSED(d.start = nan3, "start");
    // Handles: refused as a whole.
    assert_int_equal(tss_reduced_create(&h, &good, &sim), TSS_OK);
    int node[2] = {3, 5}, twice[2] = {4, 4};
    double x[4] = {1, 2, 3, 4}, bad[4] = {0, 0, 0, INFINITY};
    assert_int_equal(tss_reduced_set_handles(sim, 2, node, x), TSS_OK);
    assert_int_equal(tss_reduced_set_handles(sim, 2, far, x), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(logged, "out of range"));
    assert_int_equal(tss_reduced_set_handles(sim, 2, twice, x), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(logged, "twice"));
    assert_int_equal(tss_reduced_set_handles(sim, 2, node, bad), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(logged, "finite"));
    assert_int_equal(tss_reduced_set_handles(sim, -1, node, x), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_reduced_set_handles(sim, 1, NULL, x), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);
    assert_memory_equal(tss_reduced_x(sim) + 6, x, 2 * sizeof *x);
    assert_memory_equal(tss_reduced_x(sim) + 10, x + 2, 2 * sizeof *x);
    tss_reduced_destroy(sim), tss_net_destroy(n), scene_free(&s);
}

// Sizes whose products would not fit an int are refused before anything is read.
static void test_sizes(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 3, 1, 1);
    tss_net *n = decoder_of(&s, 3, TSS_SILU, NARROW);
    const int big = 2147483647;
    double one[8] = {0};
    tss_elements_def d = def_of(&s);
    tss_elements *e;
    assert_int_equal(tss_net_jets(n, s.work, 1, 40000, one, one, NULL, one, NULL, NULL),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_net_jets(n, s.work, 1 << 20, 3000, one, one, NULL, one, NULL, NULL),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_net_forward(n, s.work, big, one, one), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_net_backward(n, s.work, big, one, one, NULL, NULL),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_reduced_potential(n, s.e, s.work, big, one, one, NULL, NULL),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_reduced_second(n, s.e, s.work, big / 2, one, one, one, one),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_lipschitz_estimate(n, s.e, s.work, 2, big, one, one),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(
        tss_loss_unsupervised(n, s.e, s.work, NULL, 1, 1, 0, big, one, 1, one, NULL, NULL),
        TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_elements_jets(s.e, 40000, one, one, NULL, NULL, one, NULL, NULL, 1, NULL,
                                       0, NULL, NULL, NULL),
                     TSS_ERROR_BAD_ARGUMENT);
    d.cells = 1 << 28;
    assert_int_equal(tss_elements_create(NULL, &d, &e), TSS_ERROR_BAD_ARGUMENT);
    d = def_of(&s), d.nodes = big;
    assert_int_equal(tss_elements_create(NULL, &d, &e), TSS_ERROR_BAD_ARGUMENT);
    tss_net_destroy(n), scene_free(&s);
}

// A wall that says nothing (NaN) ends the line search, and the state stays what it was.
static double no_answer(void *user, const double *x, double *n) {
    (void)user, (void)x;
    n[0] = n[1] = NAN;
    return NAN;
}

static void test_nan(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 3, 1, 1);
    tss_net *n = decoder_of(&s, 3, TSS_SILU, NARROW);
    for (int solver = 0; solver < 3; solver++) {
        tss_reduced_def d = tss_reduced_def_default();
        tss_reduced *sim;
        tss_reduced_info info;
        d.decoder = n, d.elements = s.e, d.mass = s.mass, d.sdf = no_answer,
        d.contact_stiffness = 1;
        d.solver = (tss_reduced_method)solver;
        assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
        assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
        assert_int_equal(info.exit, TSS_EXIT_LINE_SEARCH);
        for (int k = 0; k < 3; k++) assert_true(tss_reduced_z(sim)[k] == 0);
        tss_reduced_destroy(sim);
    }
    tss_net_destroy(n), scene_free(&s);
}

// ---- a decoder as a basis -------------------------------------------------------------------

// f(z) = X + B mlp(z) with f(0) = X: no biases, and B is 0 at the pinned end.
static tss_net *pinned_decoder(const scene *s, int r) {
    tss_net_def d = tss_net_def_default();
    int width[3] = {r, 8, 6};
    double B[MOST * 6];
    for (int i = 0; i < s->coords * 6; i++) {
        double reach = s->X[i / 6 / s->dim * s->dim];
        B[i] = 0.4 * reach * sin(0.9 * (i % 6 + 1) * reach + i / 6 % s->dim + 2 * (i % 6));
    }
    d.layers = 2, d.width = width, d.activation = TSS_SILU, d.seed = 4, d.outputs = s->coords;
    d.out_base = s->X, d.out_matrix = B;
    tss_net *n;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    double *p = tss_net_parameters(n);
    for (int o = 0; o < 8; o++) p[r * 8 + o] = 0;
    for (int o = 0; o < 6; o++) p[r * 8 + 8 + 8 * 6 + o] = 0;
    for (int i = 0; i < r * 8; i++) p[i] *= 3;  // well curved
    return n;
}

typedef struct bar {
    scene s;
    double lame[2], mass[MOST];
    tss_world *w;
    tss_net *n;
    tss_decoder_basis *basis;
    check *judge;
} bar;

static void bar_iterate(const double *x0, const double *x1, void *ctx) {
    bar *b = (bar *)ctx;
    if (b->judge) (void)check_segment(b->judge, x0, x1);
}

enum { BAR = 4 };

static void bar_make(bar *b, int dim, tss_mode mode, double gravity, const tss_net *encoder) {
    memset(b, 0, sizeof *b);
    grid(&b->s, dim, 4, 1, 1, 1.5);
    tss_elements_def ed = def_of(&b->s);
    ed.E = 3e4, tss_lame(ed.E, ed.nu, &b->lame[0], &b->lame[1]);
    assert_int_equal(tss_elements_create(NULL, &ed, &b->s.e), TSS_OK);
    tss_world_def wd = tss_world_def_default();
    tss_body_def bd = tss_body_def_default();
    int pin[8], pins = 0;
    for (int i = 0; i < b->s.nodes; i++)
        if (b->s.X[i * dim] == 0) pin[pins++] = i;
    wd.dim = dim, wd.dt = 0.05, wd.host.workers = 1, wd.tol = 1e-9;
    wd.gravity[0] = wd.gravity[2] = 0, wd.gravity[1] = gravity;
    wd.on_iterate = bar_iterate, wd.on_iterate_ctx = b;
    assert_int_equal(tss_world_create(&wd, &b->w), TSS_OK);
    bd.nodes = b->s.nodes, bd.X = b->s.X, bd.cells = b->s.cells, bd.cell = b->s.cell;
    bd.pins = pins, bd.pin = pin, bd.material.kind = TSS_CUSTOM_MATERIAL;
    bd.material.density = tss_neural_density, bd.material.user = b->lame, bd.material.has_C = 1;
    bd.material.E = ed.E, bd.material.nu = ed.nu;
    assert_int_equal(tss_body_add(b->w, &bd, NULL), TSS_OK);
    assert_int_equal(tss_world_prepare(b->w), TSS_OK);
    for (int i = 0; i < b->s.coords; i++) b->mass[i] = tss_world_masses(b->w)[i / dim];
    b->n = pinned_decoder(&b->s, BAR);
    assert_int_equal(tss_decoder_basis_create(NULL, dim, b->n, encoder, b->mass, NULL, &b->basis),
                     TSS_OK);
    tss_subspace_def sd = tss_subspace_def_default();
    sd.mode = mode;
    assert_int_equal(tss_subspace_add(b->w, &sd, NULL), TSS_OK);
    tss_basis_def d = tss_basis_custom(BAR, NULL, tss_decoder_basis_refresh, b->basis);
    assert_int_equal(tss_basis_add(b->w, 0, &d, NULL), TSS_OK);
}

static void bar_free(bar *b) {
    tss_world_destroy(b->w), tss_decoder_basis_destroy(b->basis), tss_net_destroy(b->n);
    tss_elements_destroy(b->s.e);
}

// One step from a state of the subspace, without nodes: the world moves in the tangent, the reduced
// solver on the manifold. What lies between them is of second order in the displacement.
static void test_basis_order(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        double last = 0;
        for (double gravity = 0.5; gravity > 5e-3; gravity *= 0.25) {
            bar b;
            bar_make(&b, dim, TSS_MODE_SUBSPACE, gravity, NULL);
            double force[MOST];
            for (int i = 0; i < b.s.coords; i++) force[i] = i % dim == 1 ? b.mass[i] * gravity : 0;
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim;
            d.decoder = b.n, d.elements = b.s.e, d.mass = b.mass, d.tol = 1e-9;
            assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
            tss_reduced_set_force(sim, force);
            tss_step_info info;
            assert_int_equal(tss_world_step(b.w, &info), TSS_OK);
            assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);
            const double *x = tss_reduced_x(sim);
            double moved = distance(x, b.s.X, (size_t)b.s.coords);
            double gap = distance(x, tss_world_positions(b.w), (size_t)b.s.coords);
            print_message("basis, %dD, gravity %.3f: moved %.2e, off by %.2e\n", dim, gravity,
                          moved, gap);
            assert_true(moved > 1e-5 && gap > 1e-12 && gap < 0.2 * moved);
            if (last > 0) assert_true(gap < 0.1 * last);  // a sixteenth
            last = gap;
            tss_reduced_destroy(sim), bar_free(&b);
        }
    }
}

// The columns: orthonormal in M, and the span of differences of f.
static void test_basis_columns(void **state) {
    (void)state;
    bar b;
    bar_make(&b, 3, TSS_MODE_SUBSPACE, 0, NULL);
    double z[BAR] = {0.4, -0.3, 0.2, 0.5}, near_[BAR] = {0.38, -0.28, 0.2, 0.5}, x[MOST], up[MOST],
           down[MOST], U[MOST * BAR];
    tss_work *work;
    tss_work_create(NULL, &work);
    tss_net_forward(b.n, work, 1, z, x);
    tss_ctx c;
    memset(&c, 0, sizeof c);
    c.dim = 3, c.nodes = b.s.nodes, c.x_t = x;
    assert_int_equal(tss_decoder_basis_set(b.basis, near_), TSS_OK);
    tss_decoder_basis_refresh(b.basis, &c, 0, b.s.nodes, U);
    assert_true(distance(tss_decoder_basis_z(b.basis), z, BAR) < 1e-6);
    for (int p = 0; p < BAR; p++)
        for (int q = 0; q <= p; q++) {
            double s = 0;
            for (int i = 0; i < b.s.coords; i++) s += b.mass[i] * U[i * BAR + p] * U[i * BAR + q];
            if (!(fabs(s - (p == q)) < 1e-9)) fail_msg("columns %d, %d: %g", p, q, s);
        }
    for (int a = 0; a < BAR; a++) {
        double keep = z[a], rest[MOST], all = 0;
        z[a] = keep + 1e-5, tss_net_forward(b.n, work, 1, z, up);
        z[a] = keep - 1e-5, tss_net_forward(b.n, work, 1, z, down);
        z[a] = keep;
        for (int i = 0; i < b.s.coords; i++) rest[i] = (up[i] - down[i]) / 2e-5;
        all = norm(rest, (size_t)b.s.coords);
        for (int p = 0; p < BAR; p++) {
            double s = 0;
            for (int i = 0; i < b.s.coords; i++) s += b.mass[i] * U[i * BAR + p] * rest[i];
            for (int i = 0; i < b.s.coords; i++) rest[i] -= s * U[i * BAR + p];
        }
        assert_true(norm(rest, (size_t)b.s.coords) < 1e-6 * all);
    }
    // Another body: columns of 0.
    for (int i = 0; i < MOST * BAR; i++) U[i] = 1;
    tss_decoder_basis_refresh(b.basis, &c, 0, 3, U);
    for (int i = 0; i < 9 * BAR; i++) assert_true(U[i] == 0);
    tss_work_destroy(work), bar_free(&b);
}

// The adaptive solver with this basis: every step converges, nothing inverts, nodes are added; with
// and without an encoder, whose z depends on the positions alone.
static void test_basis_adaptive(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int with = 0; with < 2; with++) {
            bar b;
            scene s;
            tss_net *encoder = NULL;
            grid(&s, dim, 4, 1, 1, 1.5);
            if (with) {
                tss_net_def d = tss_net_def_default();
                int width[3] = {5, 6, BAR};
                double *A = randoms((size_t)s.coords * 5, 0.1);
                d.layers = 2, d.width = width, d.inputs = s.coords, d.in_base = s.X,
                d.in_matrix = A;
                assert_int_equal(tss_net_create(NULL, &d, &encoder), TSS_OK);
                free(A);
            }
            bar_make(&b, dim, TSS_MODE_ADAPTIVE, -9.81, encoder);
            check_mesh m;
            memset(&m, 0, sizeof m);
            int body[64] = {0}, all[64];
            unsigned char fixed[64] = {0};
            for (int i = 0; i < s.nodes; i++) fixed[i] = s.X[i * dim] == 0, all[i] = i;
            m.dim = dim, m.nodes = s.nodes, m.rest = b.s.X, m.cells = b.s.cell,
            m.n_cells = b.s.cells, m.body = body, m.kinematic = fixed, m.points = all,
            m.n_points = s.nodes;
            b.judge = check_begin(&m, tss_world_positions(b.w));
            int most = 0;
            double moved = 0;
            for (int step = 0; step < 12; step++) {
                tss_step_info info;
                assert_int_equal(tss_world_step(b.w, &info), TSS_OK);
                assert_int_equal(info.status, TSS_STEP_CONVERGED);
                assert_true(info.min_J > 0 && info.active_modes <= BAR);
                most = info.enriched_nodes > most ? info.enriched_nodes : most;
                moved = fmax(moved, distance(tss_world_positions(b.w), b.s.X, (size_t)b.s.coords));
            }
            check_report r = check_end(b.judge);
            assert_true(r.ok);
            print_message("adaptive, %dD: moved %.2f, up to %d of %d nodes\n", dim, moved, most,
                          b.s.nodes);
            assert_true(moved > 0.1);
            bar_free(&b), tss_net_destroy(encoder);
        }
}

static void test_basis_refusals(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 3, 3, 1, 1);
    tss_net *n = decoder_of(&s, 3, TSS_SILU, SCATTER);
    tss_host h = tss_host_default();
    tss_decoder_basis *b;
    double nan3[3] = {0, NAN, 0};
    h.alloc = stingy_alloc, h.free = stingy_free, h.log = keep_log, allowance = 100;
    assert_int_equal(tss_decoder_basis_create(&h, 4, n, NULL, NULL, NULL, &b),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_decoder_basis_create(&h, 3, n, n, NULL, NULL, &b), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(logged, "encoder"));
    assert_int_equal(tss_decoder_basis_create(&h, 3, n, NULL, NULL, nan3, &b),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(held, 0);
    int limit = 0;
    for (allowance = 0; tss_decoder_basis_create(&h, 3, n, NULL, NULL, NULL, &b) != TSS_OK;
         allowance = ++limit)
        assert_true(b == NULL && held == 0);
    assert_true(limit > 3);
    assert_int_equal(tss_decoder_basis_set(b, nan3), TSS_ERROR_BAD_STATE);
    tss_decoder_basis_destroy(b);
    assert_int_equal(held, 0);
    tss_net_destroy(n), scene_free(&s);
}

static int setup(void **state) {
    (void)state;
    rng = tss_rng_seed(5);
    return 0;
}

int main(void) {
#define T(f) cmocka_unit_test_setup(f, setup)
    const struct CMUnitTest tests[] = {
        T(test_energy),
        T(test_lanes),
        T(test_eigen),
        T(test_newton),
        T(test_bfgs_unit),
        T(test_bfgs_tol),
        T(test_bfgs_contact_opens),
        T(test_bfgs_short_steps),
        T(test_bfgs_floor_sinks),
        T(test_bfgs_set),
        T(test_contact_rest),
        T(test_sdf),
        T(test_project),
        T(test_memory),
        T(test_refusals),
        T(test_sizes),
        T(test_nan),
        T(test_basis_order),
        T(test_basis_columns),
        T(test_basis_adaptive),
        T(test_basis_refusals),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
