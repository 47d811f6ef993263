// Tests of contact as energies, on a stand-in for the world: bodies are single tetrahedra (3D) or
// quadrilaterals (2D), an obstacle, free points. Sums and minima are checked against brute force
// over all pairs with the public single-pair functions.
#define TSS_IMPLEMENTATION
#include "mock_world.h"
#include "tss_ipc.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdlib.h>
// cmocka.h needs the three above.
#include <cmocka.h>

// --- the stand-in ------------------------------------------------------------------------------

enum { MAX_NODES = 400, MAX_PRIMS = 800, MAX_ENERGIES = 4 };

struct tss_world {
    tss_host host;
    int dim, n, bodies;
    double x[3 * MAX_NODES], X[3 * MAX_NODES], x_t[3 * MAX_NODES], v[3 * MAX_NODES],
        g[3 * MAX_NODES];
    double mass[MAX_NODES];
    uint8_t kind[MAX_NODES];
    int body[MAX_NODES];
    int points, edges, triangles, point[MAX_NODES], edge[2 * MAX_PRIMS], triangle[3 * MAX_PRIMS];
    uint64_t topology;
    tss_energy_def energy[MAX_ENERGIES];
    int live[MAX_ENERGIES], energies, refuse;  // refuse: energy_add fails from this energy on
    tss_ctx ctx;
};

tss_result tss_world_surface(const tss_world *w, tss_surface *out) {
    tss_surface s = {w->points, w->edges,    w->triangles, w->point,
                     w->edge,   w->triangle, w->topology};
    *out = s;
    return TSS_OK;
}
tss_energy_def tss_energy_def_default(void) {
    tss_energy_def d;
    memset(&d, 0, sizeof d);
    return d;
}
tss_result tss_energy_add(tss_world *w, const tss_energy_def *def, tss_energy *out) {
    if (w->refuse && w->energies + 1 >= w->refuse) return TSS_ERROR_NO_MEMORY;
    w->energy[w->energies] = *def, w->live[w->energies] = 1, *out = w->energies++;
    return TSS_OK;
}
tss_result tss_energy_remove(tss_world *w, tss_energy e) {
    if (w->live[e]) w->energy[e].destroy(w->energy[e].user, &w->host);
    w->live[e] = 0;
    return TSS_OK;
}
const tss_host *tss_world_host(const tss_world *w) { return &w->host; }
int tss_world_dim(const tss_world *w) { return w->dim; }
int tss_world_nodes(const tss_world *w) { return w->n; }
const double *tss_world_positions(const tss_world *w) { return w->x; }
const double *tss_world_rest(const tss_world *w) { return w->X; }
const uint8_t *tss_world_kinds(const tss_world *w) { return w->kind; }

// --- memory that counts and can fail -----------------------------------------------------------

typedef struct memory {
    size_t bytes;
    int calls, fail_at;  // fail_at > 0: the call that returns NULL
} memory;

static void *count_alloc(size_t bytes, size_t align, void *ctx) {
    memory *m = (memory *)ctx;
    if (++m->calls == m->fail_at) return NULL;
    m->bytes += bytes;
    return tss__libc_alloc(bytes, align, NULL);
}
static void count_free(void *p, size_t bytes, void *ctx) {
    ((memory *)ctx)->bytes -= bytes;
    tss__libc_free(p, bytes, NULL);
}

// --- scenes ------------------------------------------------------------------------------------

static uint64_t seed_state;
static double uniform(double lo, double hi) {  // splitmix64
    uint64_t z = (seed_state += 0x9e3779b97f4a7c15ULL);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
    return lo + (hi - lo) * (double)((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

static int add_node(tss_world *w, double x, double y, double z, int kind) {
    double p[3] = {x, y, z};
    int i = w->n++;
    for (int a = 0; a < w->dim; a++)
        w->x[i * w->dim + a] = w->X[i * w->dim + a] = w->x_t[i * w->dim + a] = p[a];
    w->mass[i] = kind == TSS_NODE_OBSTACLE ? 0 : 0.5, w->kind[i] = (uint8_t)kind,
    w->body[i] = w->bodies;
    w->point[w->points++] = i;
    return i;
}
static void add_edge(tss_world *w, int a, int b) {
    w->edge[2 * w->edges] = a, w->edge[2 * w->edges++ + 1] = b;
}
static void add_triangle(tss_world *w, int a, int b, int c) {
    int *t = w->triangle + 3 * w->triangles++;
    t[0] = a, t[1] = b, t[2] = c;
}

static void add_tet(tss_world *w, const double at[3], double size, int kind) {
    double v[4][3] = {{1, 1, 1}, {1, -1, -1}, {-1, 1, -1}, {-1, -1, 1}};
    int n[4];
    for (int i = 0; i < 4; i++)
        n[i] = add_node(w, at[0] + size * (v[i][0] + uniform(-0.2, 0.2)),
                        at[1] + size * (v[i][1] + uniform(-0.2, 0.2)),
                        at[2] + size * (v[i][2] + uniform(-0.2, 0.2)), kind);
    for (int i = 0; i < 4; i++)
        for (int k = i + 1; k < 4; k++) add_edge(w, n[i], n[k]);
    add_triangle(w, n[0], n[1], n[2]), add_triangle(w, n[0], n[3], n[1]);
    add_triangle(w, n[0], n[2], n[3]), add_triangle(w, n[1], n[3], n[2]);
    w->bodies++;
}

static void fill_ctx(tss_world *w) {
    tss_ctx *c = &w->ctx;
    memset(c, 0, sizeof *c);
    c->host = &w->host, c->dim = w->dim, c->nodes = w->n, c->h = 0.01, c->ah2 = 1e-4 * 4 / 9;
    c->diagonal = 4, c->X = w->X, c->x_t = w->x_t, c->x_tilde = w->x_t, c->v_t = w->v;
    c->mass = w->mass, c->kind = w->kind, c->body = w->body, c->topology = ++w->topology,
    c->g = w->g;
}

static void empty_world(tss_world *w, int dim) {
    memset(w, 0, sizeof *w);
    w->host = tss_host_default(), w->dim = dim;
}

static double brute_distance(const tss_world *w, const double *x);

// Tetrahedra on a jittered grid, an obstacle below and two free obstacle points; nothing closer
// than about 0.02.
static void make_3d(tss_world *w, uint64_t seed) {
    seed_state = seed;
    do {
        empty_world(w, 3);
        for (int i = 0; i < 18; i++) {
            double at[3] = {0.62 * (i % 3), 0.62 * (i / 3 % 3), 0.62 * (i / 9)};
            for (int a = 0; a < 3; a++) at[a] += uniform(-0.03, 0.03);
            add_tet(w, at, 0.22, TSS_NODE_FREE);
        }
        int a = add_node(w, -1, -0.45, -1, TSS_NODE_OBSTACLE),
            b = add_node(w, 3, -0.45, -1, TSS_NODE_OBSTACLE);
        int c = add_node(w, -1, -0.45, 3, TSS_NODE_OBSTACLE);
        add_triangle(w, a, b, c), add_edge(w, a, b), add_edge(w, b, c), add_edge(w, c, a);
        w->bodies++;
        add_node(w, 0.3, 0.3, 0.3, TSS_NODE_OBSTACLE);
        w->bodies++;
    } while (brute_distance(w, w->x) < 0.02);
    fill_ctx(w);
}

static void make_2d(tss_world *w, uint64_t seed) {
    seed_state = seed;
    do {
        empty_world(w, 2);
        for (int i = 0; i < 16; i++) {
            double x = 0.6 * (i % 4) + uniform(-0.03, 0.03),
                   y = 0.6 * (i / 4) + uniform(-0.03, 0.03);
            int first = w->n;
            for (int k = 0; k < 4; k++)
                add_node(w, x + (k == 1 || k == 2 ? 0.5 : 0) + uniform(-0.02, 0.02),
                         y + (k > 1 ? 0.5 : 0) + uniform(-0.02, 0.02), 0, TSS_NODE_FREE);
            for (int k = 0; k < 4; k++) add_edge(w, first + k, first + (k + 1) % 4);
            w->bodies++;
        }
    } while (brute_distance(w, w->x) < 0.01);
    fill_ctx(w);
}

// --- brute force over all pairs ----------------------------------------------------------------

typedef struct brute {
    double dhat, energy, least, least_ratio;
    int count;
    const double *reference;  // state of the initial distances for least_ratio, or NULL
} brute;

static void brute_pair(const tss_world *w, const double *x, tss_ipc_kind kind, const int *v,
                       brute *b) {
    double y[12], X[12], y0[12], m = 1;
    int n = tss_ipc_pair_nodes(kind), dim = w->dim, fixed = 1;
    for (int i = 0; i < n; i++) fixed &= w->kind[v[i]] != TSS_NODE_FREE;
    int first = kind == TSS_IPC_EDGE_EDGE ? 2 : 1;
    for (int i = 0; i < first; i++)
        for (int k = first; k < n; k++)
            if (v[i] == v[k]) return;
    if (fixed) return;
    for (int i = 0; i < n; i++)
        for (int a = 0; a < dim; a++) {
            y[i * dim + a] = x[v[i] * dim + a], X[i * dim + a] = w->X[v[i] * dim + a];
            y0[i * dim + a] = b->reference ? b->reference[v[i] * dim + a] : 0;
        }
    double d = tss_ipc_distance(kind, dim, y, NULL);
    if (kind == TSS_IPC_EDGE_EDGE) m = tss_ipc_mollifier(y, tss_ipc_mollifier_eps(X), NULL, NULL);
    if (d < b->dhat * b->dhat)
        b->energy += m * tss_ipc_barrier(d, b->dhat * b->dhat, NULL, NULL), b->count++;
    b->least = fmin(b->least, sqrt(d));
    if (b->reference)
        b->least_ratio = fmin(b->least_ratio, sqrt(d / tss_ipc_distance(kind, dim, y0, NULL)));
}

static brute brute_all(const tss_world *w, const double *x, double dhat, const double *reference) {
    brute b = {dhat, 0, HUGE_VAL, HUGE_VAL, 0, reference};
    for (int i = 0; i < w->points; i++)
        for (int k = 0; k < (w->dim == 3 ? w->triangles : w->edges); k++) {
            int v[4] = {w->point[i], 0, 0, 0};
            for (int a = 0; a < w->dim; a++)
                v[1 + a] = w->dim == 3 ? w->triangle[3 * k + a] : w->edge[2 * k + a];
            brute_pair(w, x, w->dim == 3 ? TSS_IPC_POINT_TRIANGLE : TSS_IPC_POINT_EDGE, v, &b);
        }
    for (int i = 0; i < w->edges && w->dim == 3; i++)
        for (int k = i + 1; k < w->edges; k++) {
            int v[4] = {w->edge[2 * i], w->edge[2 * i + 1], w->edge[2 * k], w->edge[2 * k + 1]};
            brute_pair(w, x, TSS_IPC_EDGE_EDGE, v, &b);
        }
    return b;
}

static double brute_distance(const tss_world *w, const double *x) {
    return brute_all(w, x, 1e-9, NULL).least;
}

// --- calling the energies as the core does -----------------------------------------------------

static void must(tss_result r) {
    if (r != TSS_OK) print_message("    %s\n", tss_result_text(r));
    assert_int_equal(r, TSS_OK);
}

static double total(tss_world *w, int e, const tss_stencils *s, const double *x) {
    double sum = 0, out[TSS_BATCH];
    for (int i = 0; i < s->count; i += TSS_BATCH) {
        tss_ids ids = {i, s->count - i < TSS_BATCH ? s->count - i : TSS_BATCH, NULL};
        w->energy[e].value(w->energy[e].user, &w->ctx, x, ids, out);
        for (int k = 0; k < ids.count; k++) sum += out[k];
    }
    return sum;
}

static void total_gradient(tss_world *w, int e, const tss_stencils *s, const double *x, double *g) {
    int a = w->energy[e].arity, dim = w->dim;
    double out[TSS_BATCH * 12];
    memset(g, 0, (size_t)(w->n * dim) * sizeof *g);
    for (int i = 0; i < s->count; i += TSS_BATCH) {
        tss_ids ids = {i, s->count - i < TSS_BATCH ? s->count - i : TSS_BATCH, NULL};
        w->energy[e].gradient(w->energy[e].user, &w->ctx, x, ids, out);
        for (int k = 0; k < ids.count * a; k++)
            for (int c = 0; c < dim; c++) {
                int v = s->node[i * a + k];
                if (v >= 0)
                    g[v * dim + c] += out[k * dim + c];
                else
                    assert_true(out[k * dim + c] == 0);
            }
    }
}

// y = H z for the sum of stencil Hessians; also the smallest zᵀHz of a stencil relative to its
// size.
static double total_hessian(tss_world *w, int e, const tss_stencils *s, const double *x, int psd,
                            const double *z, double *y) {
    int a = w->energy[e].arity, dim = w->dim, ad = a * dim;
    static double out[TSS_BATCH * 144];
    double least = 0;
    memset(y, 0, (size_t)(w->n * dim) * sizeof *y);
    for (int i = 0; i < s->count; i += TSS_BATCH) {
        tss_ids ids = {i, s->count - i < TSS_BATCH ? s->count - i : TSS_BATCH, NULL};
        w->energy[e].hessian(w->energy[e].user, &w->ctx, x, ids, psd, out);
        for (int k = 0; k < ids.count; k++) {
            double zHz = 0, size = 1e-300;
            for (int r = 0; r < ad; r++)
                for (int c = 0; c < ad; c++) {
                    int p = s->node[(i + k) * a + r / dim], q = s->node[(i + k) * a + c / dim];
                    double h = out[k * ad * ad + r * ad + c];
                    assert_true(h == out[k * ad * ad + c * ad + r]);
                    size = fmax(size, fabs(h));
                    if (p < 0 || q < 0) {
                        assert_true(h == 0);
                        continue;
                    }
                    y[p * dim + r % dim] += h * z[q * dim + c % dim];
                    zHz += z[p * dim + r % dim] * h * z[q * dim + c % dim];
                }
            least = fmin(least, zHz / size);
        }
    }
    return least;
}

static tss_ipc *add_contact(tss_world *w, double dhat, double mu) {
    tss_ipc *p;
    tss_ipc_def d = tss_ipc_def_default();
    d.dhat = dhat, d.mu = mu;
    must(tss_ipc_add(w, &d, &p));
    return p;
}

static void remove_all(tss_world *w) {
    for (int e = 0; e < w->energies; e++) tss_energy_remove(w, e);
}

static void random_direction(tss_world *w, double size, double *d) {
    for (int i = 0; i < w->n * w->dim; i++)
        d[i] = w->kind[i / w->dim] == TSS_NODE_FREE ? uniform(-size, size) : 0;
}

static void move(const tss_world *w, const double *x, double t, const double *d, double *y) {
    for (int i = 0; i < w->n * w->dim; i++) y[i] = x[i] + t * d[i];
}

// --- tests -------------------------------------------------------------------------------------

static tss_world world;
static double d_[3 * MAX_NODES], y_[3 * MAX_NODES], g_[3 * MAX_NODES], h_[3 * MAX_NODES],
    z_[3 * MAX_NODES];

static void make(int dim, uint64_t seed) {
    dim == 3 ? make_3d(&world, seed) : make_2d(&world, seed);
}

// Sums over the lists equal brute force, at x and everywhere on a sweep.
static void test_lists_against_brute_force(void **unused) {
    (void)unused;
    tss_world *w = &world;
    for (int dim = 2; dim <= 3; dim++)
        for (uint64_t seed = 1; seed <= 4; seed++) {
            tss_stencils s;
            make(dim, seed);
            tss_ipc *p = add_contact(w, 0.15, 0);
            must(w->energy[0].begin_step(p, &w->ctx));
            must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &s));
            brute b = brute_all(w, w->x, 0.15, NULL);
            tss_ipc_info info;
            tss_ipc_get_info(p, &info);
            assert_true(b.count > 10 && info.active == b.count && info.min_distance == b.least);
            assert_true(fabs(total(w, 0, &s, w->x) - info.kappa * b.energy) <=
                        1e-12 * info.kappa * b.energy);
            random_direction(w, 0.2, d_);
            must(w->energy[0].lists(p, &w->ctx, w->x, d_, 0.7, &s));
            // ... as far as the step may go.
            int culprit;
            double far = w->energy[0].max_step(p, &w->ctx, w->x, d_, 0.7, &culprit);
            assert_true(far > 0 && far <= 0.7);
            for (int k = 0; k <= 7; k++) {
                move(w, w->x, far * k / 7, d_, y_);
                b = brute_all(w, y_, 0.15, NULL);
                assert_true(fabs(total(w, 0, &s, y_) - info.kappa * b.energy) <=
                            1e-12 * info.kappa * b.energy);
            }
            remove_all(w);
        }
}

static void test_derivatives(void **unused) {
    (void)unused;
    tss_world *w = &world;
    for (int dim = 2; dim <= 3; dim++) {
        tss_stencils s;
        make(dim, 5);
        tss_ipc *p = add_contact(w, 0.15, 0);
        must(w->energy[0].begin_step(p, &w->ctx));
        random_direction(w, 1e-3, d_);
        must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
        total_gradient(w, 0, &s, w->x, g_);
        double slope = 0, best = HUGE_VAL, best2 = HUGE_VAL, size = 0;
        for (int i = 0; i < w->n * dim; i++) slope += g_[i] * d_[i];
        total_hessian(w, 0, &s, w->x, 0, d_, h_);
        for (int i = 0; i < w->n * dim; i++) size = fmax(size, fabs(h_[i]));
        for (double t = 1e-1; t > 1e-7; t *= 0.1) {
            double worst = 0;
            move(w, w->x, t, d_, y_), move(w, w->x, -t, d_, z_);
            double fd = (total(w, 0, &s, y_) - total(w, 0, &s, z_)) / (2 * t);
            best = fmin(best, fabs(fd - slope));
            double gy[3 * MAX_NODES], gz[3 * MAX_NODES];
            total_gradient(w, 0, &s, y_, gy), total_gradient(w, 0, &s, z_, gz);
            for (int i = 0; i < w->n * dim; i++)
                worst = fmax(worst, fabs((gy[i] - gz[i]) / (2 * t) - h_[i]));
            best2 = fmin(best2, worst);
        }
        assert_true(best > 0 && best < 1e-7 * fabs(slope));
        assert_true(best2 > 0 && best2 < 1e-5 * size);
        assert_true(total_hessian(w, 0, &s, w->x, 1, d_, h_) > -1e-12);
        remove_all(w);
    }
}

// After max_step nothing has come nearer than the slack, anywhere on the way; the iterate's list
// equals one found anew; with no more motion the whole step is free.
static void test_steps(void **unused) {
    (void)unused;
    tss_world *w = &world;
    int cut = 0;
    for (int dim = 2; dim <= 3; dim++)
        for (uint64_t seed = 11; seed < 17; seed++) {
            tss_stencils s, fresh;
            char text[200];
            int culprit;
            make(dim, seed);
            tss_ipc *p = add_contact(w, 0.1, 0);
            must(w->energy[0].begin_step(p, &w->ctx));
            for (int k = 0; k < 4; k++) {
                random_direction(w, 0.4, d_);
                must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
                double t = w->energy[0].max_step(p, &w->ctx, w->x, d_, 1, &culprit);
                assert_true(t > 0 && t <= 1 && (t == 1) == (culprit < 0));
                for (int q = 1; q <= 10; q++) {
                    move(w, w->x, t * q / 10, d_, y_);
                    assert_true(brute_all(w, y_, 0.1, w->x).least_ratio >= 0.2 * (1 - 1e-9));
                }
                if (culprit >= 0) {
                    w->energy[0].describe(p, &w->ctx, culprit, text, sizeof text);
                    assert_true(culprit < s.count && strstr(text, "of body"));
                    assert_true(brute_all(w, y_, 0.1, w->x).least_ratio <= 0.2 * 1.2);
                    cut++;
                }
                // The line search may take less.
                move(w, w->x, 0.7 * t, d_, y_);
                w->energy[0].after_iterate(p, &w->ctx, w->x, y_);
                memcpy(w->x, y_, sizeof w->x);
                must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &s));
                assert_true(w->energy[0].clearance(p, &w->ctx, w->x) ==
                                fmin(brute_distance(w, w->x), HUGE_VAL) ||
                            brute_distance(w, w->x) >= 0.1);
                int kept[4 * 4000], count = s.count;
                memcpy(kept, s.node, (size_t)(count * (dim + 1)) * sizeof(int));
                w->topology++, w->ctx.topology++;  // forget everything
                must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &fresh));
                assert_int_equal(fresh.count, count);
                assert_memory_equal(kept, fresh.node, (size_t)(count * (dim + 1)) * sizeof(int));
            }
            memset(d_, 0, sizeof d_);
            must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
            assert_true(w->energy[0].max_step(p, &w->ctx, w->x, d_, 1, &culprit) == 1 &&
                        culprit == -1);
            remove_all(w);
        }
    print_message("    %d of 48 steps cut\n", cut);
    assert_true(cut > 20);
}

static void test_pattern(void **unused) {
    (void)unused;
    tss_world *w = &world;
    tss_stencils a, b;
    make(3, 21);
    tss_ipc *p = add_contact(w, 0.15, 0);
    must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &a));
    must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &b));
    assert_true(a.pattern == b.pattern && a.count == b.count && a.count > 0);
    w->x[0] += 1e-9;
    must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &b));
    assert_true(a.pattern == b.pattern);
    random_direction(w, 0.2, d_);
    must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &b));
    assert_true(a.pattern != b.pattern && b.count > a.count);
    remove_all(w);
}

static void test_friction(void **unused) {
    (void)unused;
    tss_world *w = &world;
    for (int dim = 2; dim <= 3; dim++) {
        tss_stencils s;
        make(dim, 31);
        tss_ipc *p = add_contact(w, 0.15, 0.4);
        assert_int_equal(w->energies, 2);
        must(w->energy[0].begin_step(p, &w->ctx));
        must(w->energy[1].lists(p, &w->ctx, w->x, NULL, 0, &s));
        assert_true(s.count > 10);
        total_gradient(w, 1, &s, w->x, g_);
        for (int i = 0; i < w->n * dim; i++) assert_true(g_[i] == 0);
        // Displacements around the threshold eps_v h = 4e-5, where f is curved.
        random_direction(w, 3e-5, d_);
        move(w, w->x, 1, d_, y_);
        memcpy(w->x, y_, sizeof y_);
        total_gradient(w, 1, &s, w->x, g_);
        double work = 0, size = 0, best = HUGE_VAL, best2 = HUGE_VAL;
        for (int i = 0; i < w->n * dim; i++) work += g_[i] * d_[i];
        assert_true(work > 0);  // against the motion
        double least = total_hessian(w, 1, &s, w->x, 1, d_, h_);
        assert_true(least > -1e-15);
        for (int i = 0; i < w->n * dim; i++) size = fmax(size, fabs(h_[i]));
        for (double t = 1e-2; t > 1e-6; t *= 0.1) {
            double gy[3 * MAX_NODES], gz[3 * MAX_NODES], worst = 0;
            move(w, w->x, t, d_, y_), move(w, w->x, -t, d_, z_);
            best = fmin(best, fabs((total(w, 1, &s, y_) - total(w, 1, &s, z_)) / (2 * t) - work));
            total_gradient(w, 1, &s, y_, gy), total_gradient(w, 1, &s, z_, gz);
            for (int i = 0; i < w->n * dim; i++)
                worst = fmax(worst, fabs((gy[i] - gz[i]) / (2 * t) - h_[i]));
            best2 = fmin(best2, worst);
        }
        assert_true(best > 0 && best < 1e-7 * work);
        assert_true(best2 > 0 && best2 < 1e-4 * size);
        remove_all(w);
    }
}

// Who slides on whom decides the coefficient.
static void test_friction_coefficients(void **unused) {
    (void)unused;
    tss_world *w = &world;
    tss_ipc *p;
    make(3, 32);
    tss_ipc_body bodies[3] = {{0, 0.09, -1}, {1, 0.25, -1}, {2, -1, 0}};
    tss_ipc_pair pairs[2] = {{3, 2, 0, 0.7}, {4, 5, 1, -1}};
    tss_ipc_def d = tss_ipc_def_default();
    d.dhat = 0.15, d.mu = 0.5, d.bodies = 3, d.body = bodies, d.pairs = 2, d.pair = pairs;
    must(tss_ipc_add(w, &d, &p));
    assert_true(tss__ipc_mu(p, 7, 8) == 0.5 && tss__ipc_mu(p, 0, 7) == 0.09 &&
                tss__ipc_mu(p, 7, 1) == 0.25);
    assert_true(fabs(tss__ipc_mu(p, 0, 1) - 0.15) < 1e-15 && tss__ipc_mu(p, 2, 3) == 0.7);
    assert_true(tss__ipc_self_off(p, 2) && !tss__ipc_self_off(p, 0));
    // Bodies 4 and 5 pass through each other.
    tss_stencils s;
    random_direction(w, 0.3, d_);
    must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
    int with_4 = 0;
    for (int i = 0; i < s.count; i++) {
        int seen4 = 0, seen5 = 0;
        for (int k = 0; k < 4; k++) {
            int v = s.node[4 * i + k];
            seen4 |= v >= 0 && w->body[v] == 4, seen5 |= v >= 0 && w->body[v] == 5;
        }
        with_4 += seen4;
        assert_false(seen4 && seen5);
    }
    assert_true(with_4 > 0);
    remove_all(w);
}

static void test_planes(void **unused) {
    (void)unused;
    tss_world *w = &world;
    for (int dim = 2; dim <= 3; dim++) {
        tss_ipc *p;
        tss_stencils s, f;
        tss_ipc_plane plane = {{0.3, -0.5, 0.1}, {0.1, 2, 0}, 0.3};
        tss_ipc_def d = tss_ipc_def_default();
        int culprit;
        make(dim, 41);
        d.dhat = 0.3, d.kappa = 7, d.planes = 1, d.plane = &plane;
        for (int i = 0; i < w->n; i++) w->x[i * dim + 1] += 0.4, w->x_t[i * dim + 1] += 0.4;
        // The obstacle out of the way: the plane is to stop the fall.
        for (int i = 0; i < w->n; i++)
            if (w->kind[i] != TSS_NODE_FREE) w->x[i * dim + 1] = w->x_t[i * dim + 1] = -50;
        must(tss_ipc_add(w, &d, &p));
        must(w->energy[0].begin_step(p, &w->ctx));
        memset(d_, 0, sizeof d_);
        for (int i = 0; i < w->n; i++) d_[i * dim + 1] = w->kind[i] == TSS_NODE_FREE ? -3 : 0;
        must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
        double t = w->energy[0].max_step(p, &w->ctx, w->x, d_, 1, &culprit), len = sqrt(4.01);
        assert_true(t > 0 && t < 1 && culprit >= 0);
        // One point keeps a fifth of its distance, none less.
        double least = HUGE_VAL;
        for (int i = 0; i < w->n; i++) {
            double s0 = 0, s1 = 0;
            if (w->kind[i] != TSS_NODE_FREE) continue;
            for (int a = 0; a < 2; a++) {
                s0 += plane.normal[a] / len * (w->x[i * dim + a] - plane.origin[a]);
                s1 += plane.normal[a] / len *
                      (w->x[i * dim + a] + t * d_[i * dim + a] - plane.origin[a]);
            }
            least = fmin(least, s1 / s0);
        }
        assert_true(least >= 0.2 && least < 0.2 + 1e-9);
        // Down to there, then derivatives.
        move(w, w->x, t, d_, y_);
        w->energy[0].after_iterate(p, &w->ctx, w->x, y_);
        memcpy(w->x, y_, sizeof y_), memcpy(w->x_t, y_, sizeof y_);
        random_direction(w, 1e-4, d_);
        must(w->energy[0].begin_step(p, &w->ctx));
        must(w->energy[1].lists(p, &w->ctx, w->x, NULL, 0, &f));
        must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
        assert_true(f.count > 0 && f.count < s.count);
        total_gradient(w, 0, &s, w->x, g_);
        double slope = 0, best = HUGE_VAL;
        for (int i = 0; i < w->n * dim; i++) slope += g_[i] * d_[i];
        for (double h = 1e-1; h > 1e-6; h *= 0.1) {
            move(w, w->x, h, d_, y_), move(w, w->x, -h, d_, z_);
            best = fmin(best, fabs((total(w, 0, &s, y_) - total(w, 0, &s, z_)) / (2 * h) - slope));
        }
        assert_true(best > 0 && best < 1e-6 * fabs(slope));
        // Behind the plane the value is infinite.
        memcpy(y_, w->x, sizeof y_);
        for (int i = 0; i < w->n; i++) y_[i * dim + 1] -= w->kind[i] == TSS_NODE_FREE ? 1 : 0;
        assert_true(isinf(total(w, 0, &s, y_)));
        remove_all(w);
    }
}

static void test_kappa(void **unused) {
    (void)unused;
    tss_world *w = &world;
    tss_ipc_info info;
    tss_stencils s;
    make(3, 51);
    tss_ipc *p = add_contact(w, 0.15, 0);
    // The force that contact must balance, known to be 5e3 times −∇B.
    must(w->energy[0].begin_step(p, &w->ctx));
    must(w->energy[0].lists(p, &w->ctx, w->x, NULL, 0, &s));
    tss_ipc_get_info(p, &info);
    double diag2 = 16, d = 1e-16 * diag2, dhat2 = 0.15 * 0.15, b2;
    tss_ipc_barrier(d, dhat2, NULL, &b2);
    double low = 1e11 * 0.5 / (4e-16 * diag2 * b2) / w->ctx.ah2;
    assert_true(fabs(info.kappa_min - low) < 1e-12 * low &&
                fabs(info.kappa_max - 100 * low) < 1e-10 * low);
    total_gradient(w, 0, &s, w->x, g_);
    double k = info.kappa;
    assert_true(k >= info.kappa_min);
    for (int i = 0; i < w->n * 3; i++)
        w->g[i] = w->kind[i / 3] == TSS_NODE_FREE ? -30 * low * w->ctx.ah2 * g_[i] / k : 1e9;
    must(w->energy[0].begin_step(p, &w->ctx));
    tss_ipc_get_info(p, &info);
    assert_true(fabs(info.kappa - 30 * low) < 1e-9 * low);
    for (int i = 0; i < w->n * 3; i++) w->g[i] *= 1e6;
    must(w->energy[0].begin_step(p, &w->ctx));
    tss_ipc_get_info(p, &info);
    assert_true(info.kappa == info.kappa_max);
    // Saved, restored, refused.
    char data[64];
    size_t size = w->energy[0].state(p, NULL, 0, 1);
    assert_true(w->energy[0].state(p, data, sizeof data, 1) == size);
    for (int i = 0; i < w->n * 3; i++) w->g[i] = 0;
    must(w->energy[0].begin_step(p, &w->ctx));
    assert_true(w->energy[0].state(p, data, size, 0) == size);
    tss_ipc_info again;
    tss_ipc_get_info(p, &again);
    assert_true(again.kappa == info.kappa);
    assert_true(w->energy[0].state(p, data, size - 1, 0) == 0);
    data[0] ^= 1;
    assert_true(w->energy[0].state(p, data, size, 0) == 0);
    remove_all(w);
}

// Doubled when a pair stays below 1e-9 l and shrinks; not when it grows or is new. Raised eightfold
// at once when a pair has been far inside d̂ for three iterates, whichever way it moves.
static void test_kappa_doubling(void **unused) {
    (void)unused;
    tss_world *w = &world;
    const double gap[5] = {3e-9, 2e-9, 3e-9, 1.5e-9, 1e-3};
    const int factor[5] = {1, 2, 8, 2, 1};
    tss_ipc_info info;
    double before;
    empty_world(w, 3);
    seed_state = 1;
    double at[3] = {0, 0, 0};
    add_tet(w, at, 0.2, TSS_NODE_FREE);
    int tip = add_node(w, 0, 0, 5, TSS_NODE_FREE);
    w->bodies++;
    fill_ctx(w);
    tss_ipc *p = add_contact(w, 0.01, 0);
    must(w->energy[0].begin_step(p, &w->ctx));
    // A point beside corner 0, outward.
    for (int i = 0; i < 5; i++) {
        tss_stencils s;
        double len = sqrt(w->x[0] * w->x[0] + w->x[1] * w->x[1] + w->x[2] * w->x[2]);
        for (int a = 0; a < 3; a++) y_[a] = w->x[a] * (1 + gap[i] / len);
        double d[3 * MAX_NODES] = {0};
        for (int a = 0; a < 3; a++) d[3 * tip + a] = y_[a] - w->x[3 * tip + a];
        must(w->energy[0].lists(p, &w->ctx, w->x, d, 1, &s));
        tss_ipc_get_info(p, &info), before = info.kappa;
        move(w, w->x, 1, d, z_);
        assert_int_equal(w->energy[0].after_iterate(p, &w->ctx, w->x, z_), factor[i] > 1);
        memcpy(w->x, z_, sizeof z_);
        tss_ipc_get_info(p, &info);
        assert_true(info.kappa == before * factor[i]);
    }
    remove_all(w);
}

static void test_memory_cap(void **unused) {
    (void)unused;
    tss_world *w = &world;
    tss_ipc *p;
    tss_stencils s;
    tss_ipc_info info;
    int culprit;
    make(3, 61);
    tss_ipc_def d = tss_ipc_def_default();
    d.dhat = 0.05, d.max_candidates = 700;
    must(tss_ipc_add(w, &d, &p));
    random_direction(w, 0.5, d_);
    must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
    double t = w->energy[0].max_step(p, &w->ctx, w->x, d_, 1, &culprit);
    tss_ipc_get_info(p, &info);
    assert_true(info.candidates <= 700 && info.shortened == 1 && t > 0 && t <= 0.5);
    remove_all(w);
}

static void test_forces_and_touches(void **unused) {
    (void)unused;
    tss_world *w = &world;
    for (int dim = 2; dim <= 3; dim++) {
        static tss_ipc_contact list[4000];
        static tss_ipc_touch touch[400];
        tss_stencils s;
        int count, touches, began = 0, ended = 0, rubbing = 0;
        double sum[3] = {0}, size = 0;
        make(dim, 71);
        tss_ipc *p = add_contact(w, 0.15, 0.4);
        assert_int_equal(tss_ipc_contacts(p, 0, NULL, &count), TSS_ERROR_NOT_PREPARED);
        must(w->energy[0].begin_step(p, &w->ctx));
        random_direction(w, 0.05, d_);
        must(w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s));
        double t = w->energy[0].max_step(p, &w->ctx, w->x, d_, 1, &count);
        move(w, w->x, 0.9 * t, d_, y_);
        w->energy[0].after_iterate(p, &w->ctx, w->x, y_);
        memcpy(w->x, y_, sizeof y_);
        must(tss_ipc_contacts(p, 4000, list, &count));
        brute b = brute_all(w, w->x, 0.15, NULL);
        assert_int_equal(count, b.count);
        must(tss_ipc_forces(p, g_));
        memset(h_, 0, sizeof h_);
        for (int i = 0; i < count; i++) {
            assert_true(list[i].distance < 0.15 && list[i].distance > 0 && list[i].force >= 0);
            for (int k = 0; k < 4; k++)
                for (int a = 0; a < dim && list[i].node[k] >= 0; a++)
                    h_[list[i].node[k] * dim + a] +=
                        list[i].coef[k] * (list[i].force * list[i].normal[a] + list[i].friction[a]);
            for (int a = 0; a < dim; a++) rubbing += list[i].friction[a] != 0;
        }
        for (int i = 0; i < w->n * dim; i++) sum[i % dim] += g_[i], size = fmax(size, fabs(g_[i]));
        for (int a = 0; a < dim; a++)
            assert_true(fabs(sum[a]) < 1e-9 * size);  // action and reaction
        assert_true(rubbing > 0);
        // Without mollified pairs and with every rubbing pair still active the two agree exactly;
        // lagged friction of pairs that parted is in the forces only. Compare without friction too.
        remove_all(w);
        w->energies = 0;
        p = add_contact(w, 0.15, 0);
        memcpy(w->x_t, w->x, sizeof w->x);
        must(w->energy[0].begin_step(p, &w->ctx));
        must(tss_ipc_contacts(p, 4000, list, &count));
        must(tss_ipc_forces(p, g_));
        memset(h_, 0, sizeof h_);
        double mollified = 0;
        for (int i = 0; i < count; i++) {
            double y[12], X[12];
            for (int k = 0; k < 4 && dim == 3 && list[i].kind == TSS_IPC_EDGE_EDGE; k++)
                for (int a = 0; a < 3; a++)
                    y[3 * k + a] = w->x[3 * list[i].node[k] + a],
                              X[3 * k + a] = w->X[3 * list[i].node[k] + a];
            if (dim == 3 && list[i].kind == TSS_IPC_EDGE_EDGE)
                mollified += tss_ipc_mollifier(y, tss_ipc_mollifier_eps(X), NULL, NULL) < 1
                                 ? list[i].force
                                 : 0;
            for (int k = 0; k < 4; k++)
                for (int a = 0; a < dim && list[i].node[k] >= 0; a++)
                    h_[list[i].node[k] * dim + a] +=
                        list[i].coef[k] * list[i].force * list[i].normal[a];
        }
        size = 0;
        for (int i = 0; i < w->n * dim; i++) size = fmax(size, fabs(g_[i]));
        for (int i = 0; mollified == 0 && i < w->n * dim; i++)
            assert_true(fabs(g_[i] - h_[i]) < 1e-9 * size);
        // Bodies that touch: now nothing is new; then all fly apart.
        must(tss_ipc_touches(p, 400, touch, &touches));
        assert_true(touches > 5);
        for (int i = 0; i < touches; i++)
            assert_true(!touch[i].began && !touch[i].ended && touch[i].a < touch[i].b &&
                        touch[i].force >= 0);
        for (int i = 0; i < w->n * dim; i++) w->x[i] = 2 * w->body[i / dim] + w->x[i];
        must(tss_ipc_touches(p, 400, touch, &count));
        assert_int_equal(count, touches);
        for (int i = 0; i < count; i++) ended += touch[i].ended;
        assert_int_equal(ended, touches);
        memcpy(w->x_t, w->x, sizeof w->x);
        must(w->energy[0].begin_step(p, &w->ctx));
        for (int i = 0; i < w->n * dim; i++) w->x[i] -= 2 * w->body[i / dim];
        must(tss_ipc_touches(p, 400, touch, &count));
        for (int i = 0; i < count; i++) began += touch[i].began;
        assert_true(began == touches && count == touches);
        remove_all(w);
    }
}

static int issues[3];
static char first_error[240];
static void count_issue(tss_severity s, const char *text, void *arg) {
    (void)arg;
    if (s == TSS_SEVERITY_ERROR && !issues[s])
        snprintf(first_error, sizeof first_error, "%s", text);
    issues[s]++;
}

static void test_doctor(void **unused) {
    (void)unused;
    tss_world *w = &world;
    for (int dim = 2; dim <= 3; dim++) {
        make(dim, 81);
        tss_ipc *p;
        tss_ipc_plane plane = {{0, -5, 0}, {0, 1, 0}, 0};
        tss_ipc_def d = tss_ipc_def_default();
        d.planes = 1, d.plane = &plane;
        must(tss_ipc_add(w, &d, &p));
        memset(issues, 0, sizeof issues);
        w->energy[0].check(p, &w->ctx, w->x, count_issue, NULL);
        assert_true(issues[0] == 1 && issues[1] == 0 && issues[2] == 0);
        tss_ipc_info info;
        tss_ipc_get_info(p, &info);
        assert_true(fabs(info.dhat - 4e-3) < 1e-15 && !strcmp(info.dhat_from, "diagonal"));
        // Body 1 into body 0.
        int per = dim == 3 ? 4 : 4;
        for (int i = per; i < 2 * per; i++) w->x[i * dim] -= 0.4;
        memset(issues, 0, sizeof issues);
        w->energy[0].check(p, &w->ctx, w->x, count_issue, NULL);
        assert_true(issues[2] > 0);
        assert_true(strstr(first_error, dim == 3 ? "pierces" : "crosses") != NULL);
        for (int i = 0; i < w->n; i++) w->x[i * dim + 1] -= 10;
        memset(issues, 0, sizeof issues), first_error[0] = 0;
        w->energy[0].check(p, &w->ctx, w->x, count_issue, NULL);
        assert_true(issues[2] >= 2);
        remove_all(w);
        // A short edge bounds d̂.
        make(dim, 81);
        w->X[dim] = w->X[0] + 1e-3;
        for (int a = 1; a < dim; a++) w->X[dim + a] = w->X[a];
        p = add_contact(w, 0, 0);
        w->energy[0].check(p, &w->ctx, w->x, count_issue, NULL);
        tss_ipc_get_info(p, &info);
        assert_true(fabs(info.dhat - 5e-4) < 1e-12 && !strcmp(info.dhat_from, "shortest edge"));
        remove_all(w);
    }
}

static void test_bad_arguments(void **unused) {
    (void)unused;
    tss_world *w = &world;
    tss_ipc *p = (tss_ipc *)w;
    make(3, 91);
    tss_ipc_def good = tss_ipc_def_default(), d;
    tss_ipc_plane flat = {{0, 0, 0}, {0, 0, 0}, 0};
    assert_int_equal(tss_ipc_add(NULL, &good, &p), TSS_ERROR_BAD_ARGUMENT);
    assert_null(p);
    assert_int_equal(tss_ipc_add(w, NULL, NULL), TSS_ERROR_BAD_ARGUMENT);
#define BAD(field, value) \
    d = good, d.field = value, assert_int_equal(tss_ipc_add(w, &d, &p), TSS_ERROR_BAD_ARGUMENT)
    BAD(cookie, 0);
    BAD(dhat, -1);
    BAD(dhat, NAN);
    BAD(dhat_rel, 0);
    BAD(kappa, -1);
    BAD(mu, HUGE_VAL);
    BAD(eps_v, -1);
    BAD(slack, 0);
    BAD(slack, 1);
    BAD(friction_iterations, 0);
    BAD(max_candidates, 0);
    BAD(planes, 1);
    d = good, d.planes = 1, d.plane = &flat;
    assert_int_equal(tss_ipc_add(w, &d, &p), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_ipc_remove(NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(w->energies, 0);
    good.mu = 0.5, w->refuse = 1;
    assert_int_equal(tss_ipc_add(w, &good, &p), TSS_ERROR_NO_MEMORY);
    w->refuse = 2;
    assert_int_equal(tss_ipc_add(w, &good, &p), TSS_ERROR_NO_MEMORY);
    assert_null(p);
    assert_int_equal(w->live[0], 0);
    w->refuse = 0, w->energies = 0;
    must(tss_ipc_add(w, &good, &p));
    must(tss_ipc_remove(p));
    assert_int_equal(w->live[0] + w->live[1], 0);
}

// One step with every allocation failed in turn: an error or the same result, nothing lost. And a
// second step of the same kind allocates nothing.
static tss_result one_step(tss_world *w, tss_ipc *p, double *energy) {
    tss_stencils s;
    int culprit;
    tss_result r = w->energy[0].begin_step(p, &w->ctx);
    if (r == TSS_OK) r = w->energy[0].lists(p, &w->ctx, w->x, d_, 1, &s);
    if (r != TSS_OK) return r;
    double t = w->energy[0].max_step(p, &w->ctx, w->x, d_, 1, &culprit);
    move(w, w->x, t, d_, y_);
    w->energy[0].after_iterate(p, &w->ctx, w->x, y_);
    r = w->energy[0].lists(p, &w->ctx, y_, NULL, 0, &s);
    if (r == TSS_OK) *energy = total(w, 0, &s, y_);
    return r;
}

static void test_allocations(void **unused) {
    (void)unused;
    tss_world *w = &world;
    memory m = {0, 0, 0};
    double right = 0, again = 0;
    int fails = 0;
    for (int k = 0; k < 400; k++) {
        tss_ipc *p;
        make(3, 101);
        m.calls = 0, m.fail_at = k;
        w->host.alloc = count_alloc, w->host.free = count_free, w->host.memory_ctx = &m;
        w->ctx.host = &w->host;
        random_direction(w, 0.2, d_);
        tss_ipc_def d = tss_ipc_def_default();
        d.dhat = 0.1, d.mu = 0.3;
        tss_result r = tss_ipc_add(w, &d, &p);
        assert_true(r == TSS_OK ? p != NULL : p == NULL);
        if (r == TSS_OK) {
            r = one_step(w, p, k ? &again : &right);
            assert_true(r == TSS_OK || r == TSS_ERROR_NO_MEMORY);
            if (r == TSS_OK && k) assert_true(again == right);
            m.fail_at = 0;
            must(one_step(w, p, &again));
            assert_true(again == right);
            int calls = m.calls;
            must(one_step(w, p, &again));
            assert_true(m.calls == calls || r != TSS_OK);
        }
        fails += r != TSS_OK;
        remove_all(w);
        assert_int_equal(m.bytes, 0);
        if (k && m.calls < k) break;
    }
    print_message("    %d failures survived\n", fails);
    assert_true(fails > 20);
}

static void test_threads(void **unused) {
    (void)unused;
    tss_world *w = &world;
    double energy[2], first[3 * MAX_NODES];
    for (int workers = 1; workers <= 2; workers++) {
        tss_ipc *p;
        make(3, 111);
        w->host.workers = workers == 1 ? 1 : 4;
        random_direction(w, 0.2, d_);
        p = add_contact(w, 0.1, 0.3);
        must(one_step(w, p, &energy[workers - 1]));
        if (workers == 1)
            memcpy(first, y_, sizeof first);
        else
            assert_memory_equal(first, y_, (size_t)(3 * w->n) * sizeof(double));
        remove_all(w);
    }
    assert_true(energy[0] == energy[1]);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_lists_against_brute_force),
        cmocka_unit_test(test_derivatives),
        cmocka_unit_test(test_steps),
        cmocka_unit_test(test_pattern),
        cmocka_unit_test(test_friction),
        cmocka_unit_test(test_friction_coefficients),
        cmocka_unit_test(test_planes),
        cmocka_unit_test(test_kappa),
        cmocka_unit_test(test_kappa_doubling),
        cmocka_unit_test(test_memory_cap),
        cmocka_unit_test(test_forces_and_touches),
        cmocka_unit_test(test_doctor),
        cmocka_unit_test(test_bad_arguments),
        cmocka_unit_test(test_allocations),
        cmocka_unit_test(test_threads),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
