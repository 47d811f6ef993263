// Neural subspaces: every derivative against central differences of something computed another way,
// estimators against the exact loss, bits under threads and across files, and training that learns.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_neural.h"
#include <stdio.h>
#include <unistd.h>

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

// ---- central differences --------------------------------------------------------------------

typedef double value_fn(void *ctx, double t);

// The best agreement of (f(h) − f(−h)) / 2h with the analytic slope over a sweep of steps, relative
// to scale; the two must not be the same number, or one was computed from the other.
static void check_slope(const char *name, value_fn *f, void *ctx, double slope, double scale,
                        double tol) {
    double best = INFINITY, worst_step = 0;
    int equal = 0, steps = 0;
    for (double h = 1e-1; h > 3e-8; h *= 0.2, steps++) {
        double fd = (f(ctx, h) - f(ctx, -h)) / (2 * h);
        double error = fabs(fd - slope) / scale;
        equal += fd == slope;
        if (error < best) best = error, worst_step = h;
    }
    if (!(best <= tol))
        fail_msg("%s: slope %g is off by %g of %g (step %g)", name, slope, best, scale, worst_step);
    if (equal == steps) fail_msg("%s: bit-equal to its differences", name);
}

// Moves an array along a direction: x = x0 + t d.
static void move(double *x, const double *x0, const double *d, double t, size_t n) {
    for (size_t i = 0; i < n; i++) x[i] = x0[i] + t * d[i];
}

// ---- scenes ---------------------------------------------------------------------------------

typedef struct scene {
    int dim, nodes, cells, coords;
    double X[3 * 64];
    int cell[4 * 200];
    tss_elements *e;
    tss_work *work;
    double mass[3 * 64];
} scene;

// A grid of nx × ny (× nz) boxes, two triangles or six tetrahedra each.
static void grid(scene *s, int dim, int nx, int ny, int nz, double lx, double ly) {
    static const int six[6][4] = {{0, 1, 3, 7}, {0, 3, 2, 7}, {0, 2, 6, 7},
                                  {0, 6, 4, 7}, {0, 4, 5, 7}, {0, 5, 1, 7}};
    memset(s, 0, sizeof *s);
    s->dim = dim;
    if (dim == 2) nz = 0;
    int sx = nx + 1, sy = ny + 1;
    for (int k = 0; k <= nz; k++)
        for (int j = 0; j <= ny; j++)
            for (int i = 0; i <= nx; i++) {
                double p[3] = {lx * i / nx, ly * j / ny, nz ? ly * k / nz : 0};
                for (int a = 0; a < dim; a++) s->X[s->nodes * dim + a] = p[a];
                s->nodes++;
            }
    for (int k = 0; k < (nz ? nz : 1); k++)
        for (int j = 0; j < ny; j++)
            for (int i = 0; i < nx; i++) {
                int at = (k * sy + j) * sx + i, v[8];
                for (int b = 0; b < 8; b++)
                    v[b] = at + (b & 1) + (b >> 1 & 1) * sx + (b >> 2) * sx * sy;
                if (dim == 2) {
                    int t[6] = {v[0], v[1], v[3], v[0], v[3], v[2]};
                    memcpy(s->cell + 3 * s->cells, t, sizeof t), s->cells += 2;
                }
                for (int t = 0; dim == 3 && t < 6; t++, s->cells++)
                    for (int b = 0; b < 4; b++) s->cell[4 * s->cells + b] = v[six[t][b]];
            }
    s->coords = s->nodes * dim;
    for (int i = 0; i < s->coords; i++) s->mass[i] = 0.5 + 0.1 * (i % 7);
}

static tss_elements_def def_of(const scene *s) {
    tss_elements_def d = tss_elements_def_default();
    d.dim = s->dim, d.nodes = s->nodes, d.X = s->X, d.cells = s->cells, d.cell = s->cell;
    d.E = 3, d.nu = 0.35;
    return d;
}

static void scene_make(scene *s, int dim, int nx, int ny, int nz) {
    grid(s, dim, nx, ny, nz, 1.5, 1);
    tss_elements_def d = def_of(s);
    assert_int_equal(tss_elements_create(NULL, &d, &s->e), TSS_OK);
    assert_int_equal(tss_work_create(NULL, &s->work), TSS_OK);
}

static void scene_free(scene *s) { tss_elements_destroy(s->e), tss_work_destroy(s->work); }

// A decoder of the scene: r → 7 → 6 → p with a matrix, or → all coordinates but the first five.
static tss_net *decoder_of(const scene *s, int r, tss_activation a, int matrix, uint64_t seed) {
    tss_net_def d = tss_net_def_default();
    int width[4] = {r, 7, 6, matrix ? 5 : s->coords - 5}, index[200];
    double *B = randoms((size_t)s->coords * 5, 0.3);
    for (int i = 0; i < s->coords - 5; i++) index[i] = i + 5;
    d.layers = 3, d.width = width, d.activation = a, d.seed = seed;
    d.outputs = s->coords, d.out_base = s->X;
    if (matrix)
        d.out_matrix = B;
    else
        d.out_index = index, d.out_scale = 0.4;
    tss_net *n;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    free(B);
    return n;
}

static tss_net *encoder_of(const scene *s, int r, tss_activation a) {
    tss_net_def d = tss_net_def_default();
    int width[3] = {5, 6, r};
    double *A = randoms((size_t)s->coords * 5, 0.5);
    d.layers = 2, d.width = width, d.activation = a, d.seed = 77;
    d.inputs = s->coords, d.in_base = s->X, d.in_matrix = A;
    tss_net *n;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    free(A);
    return n;
}

static size_t count_of(const tss_net *n) {
    tss_net_info i;
    tss_net_get_info(n, &i);
    return i.parameters;
}

// ---- activations ----------------------------------------------------------------------------

typedef struct act_ctx {
    tss_activation a;
    int order;
    double s;
} act_ctx;

static double act_value(void *ctx, double t) {
    act_ctx *c = (act_ctx *)ctx;
    double d[4];
    tss__n_activate(c->a, c->s + t, d);
    return d[c->order];
}

static void test_activations(void **state) {
    (void)state;
    const double at[] = {-30, -4, -1.3, -0.2, 0.3, 0.9, 2.5, 6, 40};
    for (int a = 0; a < TSS_ACTIVATIONS; a++)
        for (size_t i = 0; i < sizeof at / sizeof *at; i++)
            for (int o = 0; o < 3; o++) {
                act_ctx c = {(tss_activation)a, o, at[i]};
                double d[4];
                tss__n_activate(c.a, c.s, d);
                if (a == TSS_ELU && fabs(at[i]) < 0.15) continue;
                if (d[o + 1] == 0 || d[o + 1] == 1) continue;  // exact there
                check_slope("activation", act_value, &c, d[o + 1], 1, 1e-8);
            }
    // Values from their definitions; the ends overflow nowhere; ELU's second derivative at 0 is 1.
    double d[4];
    tss__n_activate(TSS_SOFTPLUS, 0, d), assert_true(fabs(d[0] - log(2)) < 1e-15);
    tss__n_activate(TSS_SILU, 1, d), assert_true(fabs(d[0] - 1 / (1 + exp(-1))) < 1e-15);
    tss__n_activate(TSS_GELU, 1, d), assert_true(fabs(d[0] - 0.84134474606854293) < 1e-14);
    tss__n_activate(TSS_ELU, -1, d), assert_true(fabs(d[0] - (exp(-1) - 1)) < 1e-15);
    tss__n_activate(TSS_ELU, 0, d), assert_true(d[0] == 0 && d[1] == 1 && d[2] == 1 && d[3] == 1);
    for (int a = 0; a < TSS_ACTIVATIONS; a++)
        for (double s = -1000; s <= 1000; s += 500) {
            tss__n_activate((tss_activation)a, s, d);
            for (int o = 0; o < 4; o++) assert_true(isfinite(d[o]));
            if (s > 0) assert_true(fabs(d[0] - s) < 1e-12 && d[1] == 1);
        }
}

// ---- networks -------------------------------------------------------------------------------

// The same map in the plainest loops, from the documented layout of θ.
static void plain_net(tss_net *n, const tss_net_def *d, const double *in, double *out) {
    double h[400], s[400];
    const double *p = tss_net_parameters(n);
    for (int i = 0; i < d->width[0]; i++) {
        h[i] = d->in_matrix ? 0 : in[i];
        for (int k = 0; d->in_matrix && k < d->inputs; k++)
            h[i] += (in[k] - (d->in_base ? d->in_base[k] : 0)) * d->in_matrix[k * d->width[0] + i];
    }
    for (int l = 0; l < d->layers; l++) {
        int a = d->width[l], b = d->width[l + 1];
        for (int o = 0; o < b; o++) {
            s[o] = p[a * b + o];
            for (int i = 0; i < a; i++) s[o] += h[i] * p[i * b + o];
            h[o + 200] = l + 1 == d->layers ? s[o] : s[o] > 0 ? s[o] : exp(s[o]) - 1;  // ELU
        }
        memcpy(h, h + 200, 200 * sizeof *h), p += (a + 1) * b;
    }
    int last = d->width[d->layers], n_out = d->outputs ? d->outputs : last;
    for (int i = 0; i < n_out; i++) out[i] = d->out_base ? d->out_base[i] : 0;
    for (int i = 0; i < last; i++) {
        if (!d->out_matrix)
            out[d->out_index ? d->out_index[i] : i] += (d->outputs ? d->out_scale : 1) * h[i];
        for (int k = 0; d->out_matrix && k < n_out; k++)
            out[k] += d->out_matrix[k * last + i] * h[i];
    }
}

static void test_forward(void **state) {
    (void)state;
    double *A = randoms(13 * 9, 1), *B = randoms(21 * 11, 1), *base = randoms(21, 1),
           *x = randoms(37 * 13, 1);
    int index[11] = {20, 3, 5, 1, 0, 9, 11, 13, 2, 17, 6}, width[4] = {9, 17, 5, 11};
    tss_work *w;
    tss_work_create(NULL, &w);
    for (int kind = 0; kind < 6; kind++)
        for (int layers = 1; layers <= 3; layers += 2) {
            tss_net_def d = tss_net_def_default();
            int short_width[2] = {9, 11};
            d.layers = layers, d.width = layers == 1 ? short_width : width, d.seed = 5;
            if (kind & 1) d.in_matrix = A, d.inputs = 13, d.in_base = kind & 2 ? base : NULL;
            if (kind / 2 == 1)
                d.outputs = 21, d.out_index = index, d.out_base = base, d.out_scale = 0.7;
            if (kind / 2 == 2) d.outputs = 21, d.out_matrix = B, d.out_base = base;
            tss_net *n;
            tss_net_info info;
            assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
            tss_net_get_info(n, &info);
            assert_int_equal(info.inputs, kind & 1 ? 13 : 9);
            double out[37 * 21], want[21];
            for (int batch = 1; batch <= 37; batch += 12) {
                assert_int_equal(tss_net_forward(n, w, batch, x, out), TSS_OK);
                for (int s = 0; s < batch; s++) {
                    plain_net(n, &d, x + s * info.inputs, want);
                    for (int i = 0; i < info.outputs; i++)
                        assert_true(fabs(out[s * info.outputs + i] - want[i]) < 1e-12);
                }
            }
            tss_net_destroy(n);
        }
    tss_work_destroy(w);
    free(A), free(B), free(base), free(x);
}

// The parameters are uniform within ±1/√inputs of their layer, and the seed alone decides.
static void test_initial(void **state) {
    (void)state;
    int width[3] = {100, 200, 50};
    tss_net_def d = tss_net_def_default();
    d.layers = 2, d.width = width, d.seed = 9;
    tss_net *a, *b, *c;
    tss_net_create(NULL, &d, &a), tss_net_create(NULL, &d, &b), d.seed = 10,
                                                                tss_net_create(NULL, &d, &c);
    double *p = tss_net_parameters(a), mean = 0, square = 0;
    size_t first = 101 * 200, all = count_of(a);
    assert_int_equal(all, 101 * 200 + 201 * 50);
    for (size_t i = 0; i < all; i++) assert_true(fabs(p[i]) <= 1 / sqrt(i < first ? 100 : 200));
    for (size_t i = 0; i < first; i++) mean += p[i], square += p[i] * p[i];
    assert_true(fabs(mean / (double)first) < 4 * 0.1 / sqrt(3 * (double)first));
    assert_true(fabs(square / (double)first * 300 - 1) < 0.03);
    assert_memory_equal(p, tss_net_parameters(b), all * sizeof *p);
    assert_true(memcmp(p, tss_net_parameters(c), all * sizeof *p) != 0);
    tss_net_destroy(a), tss_net_destroy(b), tss_net_destroy(c);
}

typedef struct net_ctx {  // S = ⟨seed, net(in)⟩ along a direction in θ or in
    tss_net *n;
    tss_work *w;
    int batch, outputs;
    double *x0, *x, *dir, *seed, *out, *in;
    size_t count;
} net_ctx;

static double net_value(void *ctx, double t) {
    net_ctx *c = (net_ctx *)ctx;
    move(c->x, c->x0, c->dir, t, c->count);
    tss_net_forward(c->n, c->w, c->batch, c->in, c->out);
    move(c->x, c->x0, c->dir, 0, c->count);
    return dot(c->out, c->seed, (size_t)(c->batch * c->outputs));
}

static void test_backward(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    for (int a = 0; a < TSS_ACTIVATIONS; a++)
        for (int kind = 0; kind < 3; kind++) {
            tss_net *n = kind == 2 ? encoder_of(&s, 3, (tss_activation)a)
                                   : decoder_of(&s, 3, (tss_activation)a, kind, 3);
            tss_net_info info;
            tss_net_get_info(n, &info);
            int batch = 9;
            size_t P = info.parameters, N = (size_t)(batch * info.inputs);
            double *in = randoms(N, 1), *seed = randoms((size_t)(batch * info.outputs), 1);
            double *gp = doubles(P), *gi = doubles(N),
                   *out = doubles((size_t)(batch * info.outputs));
            assert_int_equal(tss_net_backward(n, s.work, batch, in, seed, gp, gi), TSS_OK);
            double *p = tss_net_parameters(n);
            for (int which = 0; which < 2; which++) {
                size_t count = which ? N : P;
                double *x = which ? in : p, *dir = randoms(count, 1), *x0 = doubles(count);
                memcpy(x0, x, count * sizeof *x);
                net_ctx c = {n, s.work, batch, info.outputs, x0, x, dir, seed, out, in, count};
                double slope = dot(which ? gi : gp, dir, count);
                check_slope("backward", net_value, &c, slope, 1 + fabs(slope), 1e-8);
                free(dir), free(x0);
            }
            // Added to, not overwritten; each may be left out.
            double *twice = doubles(P);
            memcpy(twice, gp, P * sizeof *gp);
            tss_net_backward(n, s.work, batch, in, seed, twice, NULL);
            for (size_t i = 0; i < P; i++) assert_true(twice[i] == 2 * gp[i]);
            free(in), free(seed), free(gp), free(gi), free(out), free(twice);
            tss_net_destroy(n);
        }
    scene_free(&s);
}

typedef struct jet_ctx {
    tss_net *n;
    tss_work *w;
    const double *z, *D, *C, *seed;
    int k, r, outputs, order, along;
} jet_ctx;

// order 0: ⟨seed, x(z + t D_along)⟩; 1: ⟨seed, Σ_b C_along,b x_b(z + t D_along)⟩, by first-order
// jets.
static double jet_value(void *ctx, double t) {
    jet_ctx *c = (jet_ctx *)ctx;
    double z[8], x[200], x1[8 * 200], s = 0;
    move(z, c->z, c->D + c->along * c->r, t, (size_t)c->r);
    tss_net_jets(c->n, c->w, 1, c->k, z, c->D, NULL, x, x1, NULL);
    if (c->order == 0) return dot(x, c->seed, (size_t)c->outputs);
    for (int b = 0; b < c->k; b++)
        s += c->C[c->along * c->k + b] * dot(x1 + b * c->outputs, c->seed, (size_t)c->outputs);
    return s;
}

static double jet_second(void *ctx, double t) {  // Σ_a of order 1, each along its own direction
    jet_ctx c = *(jet_ctx *)ctx;
    double s = 0;
    for (c.along = 0; c.along < c.k; c.along++) s += jet_value(&c, t);
    return s;
}

static void test_net_jets(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 2, 2, 0);
    for (int a = 0; a < TSS_ACTIVATIONS; a++)
        for (int matrix = 0; matrix < 2; matrix++) {
            enum { R = 3, K = 4 };
            tss_net *n = decoder_of(&s, R, (tss_activation)a, matrix, 11);
            double *z = randoms(R, 1), *D = randoms(K * R, 1), *C = randoms(K * K, 1),
                   *seed = randoms(200, 1);
            double x[200], x1[K * 200], x2[200];
            for (int i = 0; i < K; i++)
                for (int j = 0; j < i; j++) C[i * K + j] = C[j * K + i];
            assert_int_equal(tss_net_jets(n, s.work, 1, K, z, D, C, x, x1, x2), TSS_OK);
            jet_ctx c = {n, s.work, z, D, C, seed, K, R, s.coords, 0, 0};
            for (c.along = 0; c.along < K; c.along++)
                check_slope("y_a", jet_value, &c,
                            dot(x1 + c.along * s.coords, seed, (size_t)s.coords), 1, 1e-8);
            c.order = 1;
            check_slope("y_2", jet_second, &c, dot(x2, seed, (size_t)s.coords), 1, 1e-8);
            free(z), free(D), free(C), free(seed);
            tss_net_destroy(n);
        }
    scene_free(&s);
}

// ---- elements -------------------------------------------------------------------------------

// P as printed in peers.md §4a: λ' = λ + μ, α = 1 + μ/λ', less its rest value. Areas by cross
// products.
static double plain_potential(const scene *s, const double *x) {
    double P = 0, mu, la;
    int d = s->dim;
    tss_lame(3, 0.35, &mu, &la);
    double l = la + mu, alpha = 1 + mu / l;
    for (int k = 0; k < s->cells; k++) {
        const int *v = s->cell + k * (d + 1);
        double e[2][9], F[9], inv[9], det[2], norm = 0, J;
        for (int w = 0; w < 2; w++) {
            const double *p = w ? x : s->X;
            for (int r = 0; r < d; r++)
                for (int c = 0; c < d; c++) e[w][r * d + c] = p[v[c + 1] * d + r] - p[v[0] * d + r];
            double *m = e[w];
            det[w] = d == 2
                         ? m[0] * m[3] - m[1] * m[2]
                         : m[0] * (m[4] * m[8] - m[5] * m[7]) - m[1] * (m[3] * m[8] - m[5] * m[6]) +
                               m[2] * (m[3] * m[7] - m[4] * m[6]);
        }
        for (int r = 0; r < d; r++)  // inverse by cofactors
            for (int c = 0; c < d; c++) {
                const double *m = e[0];
                int r1 = (c + 1) % d, r2 = (c + 2) % d, c1 = (r + 1) % d, c2 = (r + 2) % d;
                inv[r * d + c] =
                    (d == 2 ? ((r + c) % 2 ? -1 : 1) * m[r1 * 2 + c1]
                            : m[r1 * 3 + c1] * m[r2 * 3 + c2] - m[r1 * 3 + c2] * m[r2 * 3 + c1]) /
                    det[0];
            }
        for (int r = 0; r < d; r++)
            for (int c = 0; c < d; c++) {
                F[r * d + c] = 0;
                for (int m = 0; m < d; m++) F[r * d + c] += e[1][r * d + m] * inv[m * d + c];
                norm += F[r * d + c] * F[r * d + c];
            }
        J = det[1] / det[0];
        double rest = 0.5 * (mu * d + l * (1 - alpha) * (1 - alpha));
        P += det[0] / (d == 2 ? 2 : 6) * (0.5 * (mu * norm + l * (J - alpha) * (J - alpha)) - rest);
    }
    return P;
}

static void test_potential(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        scene s;
        scene_make(&s, dim, 2, 2, 1);
        size_t n = (size_t)s.coords;
        double *x = doubles(n), *g = doubles(n), *d = randoms(n, 1);
        assert_true(fabs(tss_elements_potential(s.e, s.X, g)) < 1e-28);
        for (size_t i = 0; i < n; i++) assert_true(fabs(g[i]) < 1e-14);
        for (int trial = 0; trial < 5; trial++) {  // up to inverted cells
            for (size_t i = 0; i < n; i++) x[i] = s.X[i] + 0.3 * trial * rnd();
            double P = tss_elements_potential(s.e, x, NULL), want = plain_potential(&s, x);
            assert_true(fabs(P - want) < 1e-12 * (1 + fabs(want)));
        }
        // A rotation and a shift cost nothing.
        for (int i = 0; i < s.nodes; i++) {
            const double *X = s.X + i * dim;
            x[i * dim] = 0.6 * X[0] - 0.8 * X[1] + 3, x[i * dim + 1] = 0.8 * X[0] + 0.6 * X[1] - 1;
            if (dim == 3) x[i * dim + 2] = X[2];
        }
        assert_true(fabs(tss_elements_potential(s.e, x, NULL)) < 1e-26);
        // Small strains: μ ε:ε + λ/2 tr² times the volume, for a uniform strain.
        double mu, la, h = 1e-5, volume = 1.5;
        tss_lame(3, 0.35, &mu, &la);
        memcpy(x, s.X, n * sizeof *x);
        for (int i = 0; i < s.nodes; i++) x[i * dim] += h * (s.X[i * dim] + 0.5 * s.X[i * dim + 1]);
        double linear = volume * h * h * (mu * (1 + 2 * 0.25 * 0.25) + 0.5 * la);
        assert_true(fabs(tss_elements_potential(s.e, x, NULL) / linear - 1) < 1e-4);
        scene_free(&s);
        free(x), free(g), free(d);
    }
}

// A weighted subset is what its cells' own sums say; its coordinates are the nodes it touches.
static void test_subset(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 3, 2, 1, 1);
    double *x = doubles((size_t)s.coords), sum = 0;
    int list[3] = {7, 2, 11};
    double weight[3] = {2.5, 0, 1.25};
    for (int i = 0; i < s.coords; i++) x[i] = s.X[i] + 0.2 * rnd();
    tss_elements_def d = def_of(&s);
    tss_elements *e;
    d.subset = list, d.count = 1;
    for (int k = 0; k < 3; k++) {
        d.subset = list + k;
        assert_int_equal(tss_elements_create(NULL, &d, &e), TSS_OK);
        sum += weight[k] * tss_elements_potential(e, x, NULL);
        tss_elements_destroy(e);
    }
    d.subset = list, d.count = 3, d.weight = weight;
    assert_int_equal(tss_elements_create(NULL, &d, &e), TSS_OK);
    assert_true(e->used < s.nodes);
    assert_true(fabs(tss_elements_potential(e, x, NULL) - sum) < 1e-12 * sum);
    // Through a decoder only the touched coordinates are made: the same numbers all the same.
    for (int matrix = 0; matrix < 2; matrix++) {
        tss_net *n = decoder_of(&s, 3, TSS_SILU, matrix, 4);
        double z[6] = {0.3, -0.2, 0.7, -1, 0.1, 0.4}, P[2], g[6], out[400], gx[400] = {0},
               gz[6] = {0};
        assert_int_equal(tss_reduced_potential(n, e, s.work, 2, z, P, g, NULL), TSS_OK);
        tss_net_forward(n, s.work, 2, z, out);
        for (int i = 0; i < 2; i++) {
            double direct = tss_elements_potential(e, out + i * s.coords, gx + i * s.coords);
            assert_true(fabs(P[i] - direct) < 1e-12 * (1 + direct));
        }
        tss_net_backward(n, s.work, 2, z, gx, NULL, gz);
        for (int i = 0; i < 6; i++) assert_true(fabs(g[i] - gz[i]) < 1e-12 * (1 + fabs(gz[i])));
        tss_net_destroy(n);
    }
    tss_elements_destroy(e), scene_free(&s), free(x);
}

enum { K3 = 3 };
typedef struct el_ctx {
    scene *s;
    double *x, *x1, *x2, *C;  // the state
    double *dx, *dx1, *dx2;   // a direction in all of it
    double alpha, beta[K3], gamma;
    int what;  // 0: P along x1[0]; 1: Σ C_ab P_b along x1[a], and P along x2; 2: the seeded sum
    int along;
} el_ctx;

static double el_value(void *ctx, double t) {
    el_ctx *c = (el_ctx *)ctx;
    size_t n = (size_t)c->s->coords;
    double P, P1[K3], P2, *x = doubles(n), *x1 = doubles(n * K3), *x2 = doubles(n), out = 0;
    if (c->what < 2) {
        move(x, c->x, c->along < K3 ? c->x1 + (size_t)c->along * n : c->x2, t, n);
        tss_elements_jets(c->s->e, K3, x, c->x1, NULL, NULL, &P, P1, NULL, 0, NULL, 0, NULL, NULL,
                          NULL);
        out = P;
        if (c->what == 1 && c->along < K3) out = dot(c->C + c->along * K3, P1, K3);
    } else {
        move(x, c->x, c->dx, t, n), move(x1, c->x1, c->dx1, t, n * K3),
            move(x2, c->x2, c->dx2, t, n);
        tss_elements_jets(c->s->e, K3, x, x1, c->C, x2, &P, P1, &P2, 0, NULL, 0, NULL, NULL, NULL);
        out = c->alpha * P + dot(c->beta, P1, K3) + c->gamma * P2;
    }
    free(x), free(x1), free(x2);
    return out;
}

static double el_second(void *ctx, double t) {
    el_ctx c = *(el_ctx *)ctx;
    double s = 0;
    for (c.along = 0; c.along <= K3; c.along++) s += el_value(&c, t);
    return s;
}

static void test_element_jets(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int trial = 0; trial < 4;
             trial++) {  // at rest, deformed, inverted in places, flattened
            scene s;
            scene_make(&s, dim, 2, 1, 1);
            size_t n = (size_t)s.coords;
            double amount[4] = {0, 0.15, 0.8, 0}, P, P1[K3], P2;
            double *x = doubles(n), *x1 = randoms(n * K3, 1), *x2 = randoms(n, 1),
                   *C = randoms(K3 * K3, 1);
            for (size_t i = 0; i < n; i++)
                x[i] = trial == 3 && i % (size_t)dim == 1 ? 0 : s.X[i] + amount[trial] * rnd();
            for (int a = 0; a < K3; a++)
                for (int b = 0; b < a; b++) C[a * K3 + b] = C[b * K3 + a];
            double *dx = randoms(n, 1), *dx1 = randoms(n * K3, 1), *dx2 = randoms(n, 1);
            double *gx = doubles(n), *gx1 = doubles(n * K3), *gx2 = doubles(n);
            el_ctx c = {&s, x, x1, x2, C, dx, dx1, dx2, 0.7, {0.3, -0.8, 1.1}, 1.3, 0, 0};
            assert_int_equal(tss_elements_jets(s.e, K3, x, x1, C, x2, &P, P1, &P2, c.alpha, c.beta,
                                               c.gamma, gx, gx1, gx2),
                             TSS_OK);
            for (c.along = 0; c.along < K3; c.along++)
                check_slope("P_a", el_value, &c, P1[c.along], 1 + fabs(P1[c.along]), 1e-8);
            c.what = 1;
            check_slope("P_2", el_second, &c, P2, 1 + fabs(P2), 1e-8);
            c.what = 2;
            double slope = dot(gx, dx, n) + dot(gx1, dx1, n * K3) + dot(gx2, dx2, n);
            check_slope("reverse", el_value, &c, slope, 1 + fabs(slope), 1e-8);
            scene_free(&s);
            free(x), free(x1), free(x2), free(C), free(dx), free(dx1), free(dx2), free(gx),
                free(gx1), free(gx2);
        }
}

typedef struct density_ctx {
    double lame[2], F[9], A[9], B[9];
    int dim, what;
} density_ctx;

static double density_value(void *ctx, double t) {  // psi; P:B; B:C:B along A
    density_ctx *c = (density_ctx *)ctx;
    double F[9], psi, P[9], C[81], s = 0;
    int dd = c->dim * c->dim;
    move(F, c->F, c->A, t, (size_t)dd);
    tss_neural_density(c->lame, c->dim, 1, NULL, F, &psi, P, C);
    if (c->what == 0) return psi;
    if (c->what == 1) return dot(P, c->B, (size_t)dd);
    for (int i = 0; i < dd; i++) s += c->B[i] * dot(C + i * dd, c->B, (size_t)dd);
    return s;
}

// First, second and third derivatives of the density, at J > 0, J < 0, J = 0 and F = 0.
static void test_density(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int trial = 0; trial < 8; trial++) {
            density_ctx c = {{1.3, 2.1}, {0}, {0}, {0}, dim, 0};
            int dd = dim * dim;
            double P[9], C[81], psi, third[9] = {0};
            for (int i = 0; i < dd; i++) c.F[i] = rnd(), c.A[i] = rnd(), c.B[i] = rnd();
            for (int i = 0; i < dd && trial == 0; i++) c.F[i] = 0;
            for (int i = 0; i < dim && trial == 1; i++) c.F[i] = c.F[dim + i];  // two equal rows
            tss_neural_density(c.lame, dim, 1, NULL, c.F, &psi, P, C);
            check_slope("psi'", density_value, &c, dot(P, c.A, (size_t)dd), 10, 1e-9);
            double second = 0;
            for (int i = 0; i < dd; i++) {
                second += c.A[i] * dot(C + i * dd, c.B, (size_t)dd);
                for (int j = 0; j < dd; j++)
                    assert_true(fabs(C[i * dd + j] - C[j * dd + i]) < 1e-14);
            }
            c.what = 1;
            check_slope("psi''", density_value, &c, second, 10, 1e-9);
            tss__n_cell q;
            tss__cell_at(&q, dim, 1.3, 2.1 + 1.3, c.F);
            tss__cell_ddd(&q, 1, c.B, c.B, third);
            c.what = 2;
            check_slope("psi'''", density_value, &c, dot(third, c.A, (size_t)dd), 10, 1e-9);
        }
}

// ---- reduced --------------------------------------------------------------------------------

typedef struct red_ctx {
    scene *s;
    tss_net *n;
    const double *z, *dir, *along;
    int what, r;
} red_ctx;

static double red_value(void *ctx, double t) {  // P, or ∇P·along, at z + t dir
    red_ctx *c = (red_ctx *)ctx;
    double z[8], P, g[8];
    move(z, c->z, c->dir, t, (size_t)c->r);
    tss_reduced_potential(c->n, c->s->e, c->s->work, 1, z, &P, c->what ? g : NULL, NULL);
    return c->what ? dot(g, c->along, (size_t)c->r) : P;
}

static void test_reduced(void **state) {
    (void)state;
    enum { R = 4, B = 3 };
    for (int dim = 2; dim <= 3; dim++)
        for (int a = 0; a < TSS_ACTIVATIONS; a++)
            for (int matrix = 0; matrix < 2; matrix++) {
                scene s;
                scene_make(&s, dim, 2, 1, 1);
                tss_net *n = decoder_of(&s, R, (tss_activation)a, matrix, 21);
                double *z = randoms(B * R, 1), *u = randoms(B * R, 1), *v = randoms(B * R, 1);
                double P[B], g[B * R], H[B * R * R], uHv[B], vHu[B], P0[B], g0[B * R];
                assert_int_equal(tss_reduced_potential(n, s.e, s.work, B, z, P, g, H), TSS_OK);
                assert_int_equal(tss_reduced_potential(n, s.e, s.work, B, z, P0, g0, NULL), TSS_OK);
                assert_int_equal(tss_reduced_second(n, s.e, s.work, B, z, u, v, uHv), TSS_OK);
                assert_int_equal(tss_reduced_second(n, s.e, s.work, B, z, v, u, vHu), TSS_OK);
                for (int i = 0; i < B; i++) {
                    assert_true(fabs(P[i] - P0[i]) <= 1e-13 * (1 + P[i]));
                    red_ctx c = {&s, n, z + i * R, u + i * R, v + i * R, 0, R};
                    double slope = dot(g + i * R, u + i * R, R), second = 0,
                           scale = 1 + fabs(slope);
                    check_slope("∇P", red_value, &c, slope, scale, 1e-8);
                    for (int k = 0; k < R; k++) {
                        const double *row = H + (i * R + k) * R;
                        second += u[i * R + k] * dot(row, v + i * R, R);
                        for (int m = 0; m < R; m++)
                            assert_true(fabs(row[m] - H[(i * R + m) * R + k]) <
                                        1e-11 * (1 + fabs(row[m])));
                        assert_true(fabs(g[i * R + k] - g0[i * R + k]) < 1e-12 * scale);
                    }
                    // The Hessian goes forward over reverse, the jet forward alone.
                    assert_true(fabs(uHv[i] - second) < 1e-11 * (1 + fabs(second)));
                    assert_true(fabs(uHv[i] - vHu[i]) < 1e-11 * (1 + fabs(second)));
                    c.what = 1;
                    check_slope("∇²P", red_value, &c, second, 1 + fabs(second), 1e-7);
                }
                tss_net_destroy(n), scene_free(&s);
                free(z), free(u), free(v);
            }
}

// ---- losses ---------------------------------------------------------------------------------

typedef struct loss_ctx {
    scene *s;
    tss_net *dec, *enc;
    tss_lipschitz_def lip;
    int kind;  // 0 reconstruction, 1 unsupervised, 2 Lipschitz
    int batch, r;
    double *data, *z, *probe, *dir, *x, *x0;
    size_t count;
} loss_ctx;

static double loss_run(loss_ctx *c, double weight, double *gd, double *ge, double *gz) {
    double loss = 0;
    tss_result r = TSS_OK;
    if (c->kind == 0)
        r = tss_loss_reconstruction(c->dec, c->enc, c->s->work, c->s->mass, c->batch, c->data,
                                    weight, &loss, gd, ge);
    if (c->kind == 1)
        r = tss_loss_unsupervised(c->dec, c->s->e, c->s->work, c->s->mass, 0.8, 0.6, 1e-3, c->batch,
                                  c->z, weight, &loss, NULL, gd);
    if (c->kind == 2)
        r = tss_loss_lipschitz(c->dec, c->s->e, c->s->work, &c->lip, c->batch, c->z, c->probe,
                               weight, &loss, gd, gz);
    assert_int_equal(r, TSS_OK);
    return loss;
}

static double loss_value(void *ctx, double t) {
    loss_ctx *c = (loss_ctx *)ctx;
    move(c->x, c->x0, c->dir, t, c->count);
    double loss = loss_run(c, 1, NULL, NULL, NULL);
    move(c->x, c->x0, c->dir, 0, c->count);
    return loss;
}

// The gradient of the loss in an array x against differences along a random direction.
static void check_loss(loss_ctx *c, const char *name, double *x, const double *g, size_t count,
                       double weight) {
    c->x = x, c->count = count, c->dir = randoms(count, 0.5), c->x0 = doubles(count);
    memcpy(c->x0, x, count * sizeof *x);
    double slope = dot(g, c->dir, count) / weight, size = fabs(loss_run(c, 1, NULL, NULL, NULL));
    check_slope(name, loss_value, c, slope, fabs(slope) + 0.1 * size, 2e-7);
    free(c->dir), free(c->x0);
}

static void check_losses(int dim, tss_activation a, int matrix) {
    enum { R = 3, B = 5 };
    scene s;
    scene_make(&s, dim, 2, 1, 1);
    tss_net *dec = decoder_of(&s, R, a, matrix, 31), *enc = encoder_of(&s, R, a);
    size_t nd = count_of(dec), ne = count_of(enc);
    double *data = doubles((size_t)(B * s.coords)), *z = randoms(B * R, 1),
           *probe = randoms(2 * R * R, 1.5);
    for (int i = 0; i < B * s.coords; i++) data[i] = s.X[i % s.coords] + 0.2 * rnd();
    for (int kind = 0; kind < 2 + 7; kind++) {
        static const int probes[9] = {0, 0, 1, 1, 1, 1, 1, 3, 3};
        loss_ctx c = {&s,
                      dec,
                      enc,
                      tss_lipschitz_def_default(),
                      kind < 2 ? kind : 2,
                      B,
                      R,
                      data,
                      z,
                      probe,
                      NULL,
                      NULL,
                      NULL,
                      0};
        char name[80];
        if (kind >= 2) {
            c.lip.order = kind < 5 ? kind - 2 : 2;
            c.lip.estimator = kind < 5   ? TSS_LIPSCHITZ_EXACT
                              : kind % 2 ? TSS_LIPSCHITZ_UV
                                         : TSS_LIPSCHITZ_U;
            c.lip.probes = probes[kind];
            if (c.lip.estimator == TSS_LIPSCHITZ_EXACT) c.probe = NULL;
        }
        if (a == TSS_ELU && kind >= 4) continue;  // σ'' jumps: the loss itself has kinks in θ
        double *gd = doubles(nd), *ge = doubles(ne), *gz = doubles(B * R), weight = 1.7;
        loss_run(&c, weight, gd, ge, kind >= 2 ? gz : NULL);
        snprintf(name, sizeof name, "loss %d, activation %d, %dD, matrix %d", kind, (int)a, dim,
                 matrix);
        check_loss(&c, name, tss_net_parameters(dec), gd, nd, weight);
        if (kind == 0) check_loss(&c, name, tss_net_parameters(enc), ge, ne, weight);
        if (kind >= 2) check_loss(&c, name, z, gz, B * R, weight);
        if (kind == 4) {
            c.lip.undivided = 1;
            memset(gz, 0, B * R * sizeof *gz), memset(gd, 0, nd * sizeof *gd);
            loss_run(&c, weight, gd, NULL, gz);
            check_loss(&c, name, z, gz, B * R, weight),
                check_loss(&c, name, tss_net_parameters(dec), gd, nd, weight);
        }
        if (kind >= 2) {  // some coordinates where a script has them, another place for each sample
            int index[3] = {s.coords - 1, 0, 4};
            double *value = doubles(3 * B);
            for (int i = 0; i < 3 * B; i++) value[i] = s.X[index[i % 3]] + 0.2 * rnd();
            tss_held held = {3, index, value};
            c.lip.held = &held, c.lip.undivided = 0;
            memset(gz, 0, B * R * sizeof *gz), memset(gd, 0, nd * sizeof *gd);
            loss_run(&c, weight, gd, NULL, gz);
            snprintf(name, sizeof name, "loss %d, held, activation %d, %dD, matrix %d", kind,
                     (int)a, dim, matrix);
            check_loss(&c, name, tss_net_parameters(dec), gd, nd, weight);
            check_loss(&c, name, z, gz, B * R, weight);
            free(value);
        }
        free(gd), free(ge), free(gz);
    }
    tss_net_destroy(dec), tss_net_destroy(enc), scene_free(&s);
    free(data), free(z), free(probe);
}

static void test_losses(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int a = 0; a < TSS_ACTIVATIONS; a++)
            for (int matrix = 0; matrix < 2; matrix++) check_losses(dim, (tss_activation)a, matrix);
}

// Held coordinates: the same as a decoder whose rows there are 0 and whose base is the value; with
// a value for each sample, φ is what each sample has alone. All cells and a subset; the cubature
// too.
static void test_held(void **state) {
    (void)state;
    enum { R = 3, B = 4, P = 5, HELD = 4 };
    for (int part = 0; part < 2; part++) {
        scene s;
        scene_make(&s, 3, 2, 1, 1);
        if (part) {
            int some[5] = {0, 2, 3, 5, 6};
            tss_elements_def d = def_of(&s);
            d.count = 5, d.subset = some;
            tss_elements_destroy(s.e);
            assert_int_equal(tss_elements_create(NULL, &d, &s.e), TSS_OK);
        }
        size_t n = (size_t)s.coords;
        double *basis = randoms(n * P, 0.4), *pinned = doubles(n * P), *base = doubles(n),
               *value = doubles(B * HELD), *z = randoms(B * R, 1), *probe = randoms(2 * R, 1),
               loss[2], lip[2], error[2];
        int index[HELD] = {7, 1, s.coords - 2, 12}, width[3] = {R, 6, P}, subset[2][4], count[2];
        tss_net *net[2];
        for (int k = 0; k < B * HELD; k++) value[k] = s.X[index[k % HELD]] + 0.1 * (k % HELD);
        memcpy(pinned, basis, n * P * sizeof *basis), memcpy(base, s.X, n * sizeof *base);
        for (int h = 0; h < HELD; h++) {
            base[index[h]] = value[h];
            for (int k = 0; k < P; k++) pinned[index[h] * P + k] = 0;
        }
        for (int k = 0; k < 2; k++) {
            tss_net_def d = tss_net_def_default();
            d.layers = 2, d.width = width, d.activation = TSS_SILU, d.seed = 5;
            d.outputs = s.coords, d.out_base = k ? base : s.X, d.out_matrix = k ? pinned : basis;
            assert_int_equal(tss_net_create(NULL, &d, &net[k]), TSS_OK);
        }
        tss_held held = {HELD, index, value};
        for (int o = 0; o < 4; o++) {
            double *g[2] = {doubles(count_of(net[0])), doubles(count_of(net[0]))},
                   *gz[2] = {doubles(B * R), doubles(B * R)};
            tss_lipschitz_def d = tss_lipschitz_def_default();
            d.order = o < 3 ? o : 2, d.estimator = o < 3 ? TSS_LIPSCHITZ_EXACT : TSS_LIPSCHITZ_U;
            for (int k = 0; k < 2; k++) {
                d.held = k ? NULL : &held;
                assert_int_equal(tss_loss_lipschitz(net[k], s.e, s.work, &d, B, z,
                                                    o < 3 ? NULL : probe, 1, &loss[k], g[k], gz[k]),
                                 TSS_OK);
                tss_lipschitz_estimate_held(net[k], s.e, s.work, d.order, d.held, B, z, &lip[k]);
            }
            assert_true(fabs(loss[0] / loss[1] - 1) < 1e-11 && fabs(lip[0] / lip[1] - 1) < 1e-11);
            for (size_t i = 0; i < count_of(net[0]); i++)
                assert_true(fabs(g[0][i] - g[1][i]) <= 1e-9 * (fabs(g[1][i]) + loss[1]));
            for (int i = 0; i < B * R; i++)
                assert_true(fabs(gz[0][i] - gz[1][i]) <= 1e-9 * (fabs(gz[1][i]) + loss[1]));
            free(g[0]), free(g[1]), free(gz[0]), free(gz[1]);
        }
        for (int k = 0; k < 2; k++) {
            tss_cubature_def c = tss_cubature_def_default();
            double weight[4];
            c.count = 4, c.held = k ? NULL : &held;
            assert_int_equal(tss_cubature_select(net[k], s.e, s.work, &c, B, z, subset[k], weight,
                                                 &count[k], &error[k]),
                             TSS_OK);
        }
        assert_true(count[0] == count[1] &&
                    memcmp(subset[0], subset[1], (size_t)count[0] * sizeof(int)) == 0);
        assert_true(fabs(error[0] - error[1]) < 1e-9);
        index[0] = s.coords;  // out of range
        assert_int_equal(tss_lipschitz_estimate_held(net[0], s.e, s.work, 2, &held, B, z, lip),
                         TSS_ERROR_BAD_ARGUMENT);
        index[0] = 7, held.value = NULL;
        assert_int_equal(tss_lipschitz_estimate_held(net[0], s.e, s.work, 2, &held, B, z, lip),
                         TSS_ERROR_BAD_ARGUMENT);
        tss_net_destroy(net[0]), tss_net_destroy(net[1]), scene_free(&s);
        free(basis), free(pinned), free(base), free(value), free(z), free(probe);
    }
}

// One step of Adam with an eps so large that it goes down the gradient: Eq. (10) of the frames
// drawn, held coordinates where each frame has them, against differences in all parameters of both
// networks.
typedef struct held_step {
    scene *s;
    tss_model m;
    double *frames, *theta[2], *dir[2];
    size_t count[2];
    int held[2], drawn[9];
} held_step;

static double held_step_loss(void *ctx, double t) {
    held_step *c = (held_step *)ctx;
    enum { BATCH = 4, LIP = 5, R = 3 };
    size_t n = (size_t)c->s->coords;
    double *x = doubles(9 * n), z[LIP * R], value[LIP * 2], loss[2];
    tss_net *net[2] = {c->m.decoder, c->m.encoder};
    for (int k = 0; k < 2; k++)
        move(tss_net_parameters(net[k]), c->theta[k], c->dir[k], t, c->count[k]);
    for (int i = 0; i < 9; i++)
        memcpy(x + (size_t)i * n, c->frames + (size_t)c->drawn[i] * n, n * sizeof *x);
    tss_lipschitz_def d = tss_lipschitz_def_default();
    tss_held held = {2, c->held, value};
    for (int i = 0; i < 2 * LIP; i++)
        value[i] = x[(size_t)(BATCH + i / 2) * n + (size_t)c->held[i % 2]];
    d.held = &held;
    tss_loss_reconstruction(net[0], net[1], c->s->work, c->s->mass, BATCH, x, 1, &loss[0], NULL,
                            NULL);
    tss_net_forward(net[1], c->s->work, LIP, x + BATCH * n, z);
    tss_loss_lipschitz(net[0], c->s->e, c->s->work, &d, LIP, z, NULL, 1, &loss[1], NULL, NULL);
    for (int k = 0; k < 2; k++)
        memcpy(tss_net_parameters(net[k]), c->theta[k], c->count[k] * sizeof(double));
    free(x);
    return loss[0] + 0.3 * loss[1];
}

static void test_held_training(void **state) {
    (void)state;
    enum { R = 3, FRAMES = 7 };
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    held_step c = {.s = &s, .held = {s.coords - 1, 2}};
    size_t n = (size_t)s.coords;
    c.m.decoder = decoder_of(&s, R, TSS_SILU, 1, 3), c.m.encoder = encoder_of(&s, R, TSS_SILU),
    c.m.rng = tss_rng_seed(4);
    tss_net *net[2] = {c.m.decoder, c.m.encoder};
    c.frames = doubles(FRAMES * n);
    for (size_t i = 0; i < FRAMES * n; i++) c.frames[i] = s.X[i % n] + 0.2 * rnd();
    for (int k = 0; k < 2; k++) {
        c.count[k] = count_of(net[k]), c.theta[k] = doubles(c.count[k]),
        c.dir[k] = randoms(c.count[k], 0.5);
        memcpy(c.theta[k], tss_net_parameters(net[k]), c.count[k] * sizeof(double));
    }
    tss_rng draws = c.m.rng;
    for (int i = 0; i < 9; i++) c.drawn[i] = (int)(tss_rng_uniform(&draws) * FRAMES);
    tss_training_def d = tss_training_def_default();
    tss_training *t;
    d.model = &c.m, d.elements = s.e, d.mass = s.mass, d.frames = c.frames, d.frame_count = FRAMES;
    d.batch = 4, d.lipschitz_batch = 5, d.lipschitz_weight = 0.3, d.held_count = 2, d.held = c.held;
    d.adam.eps = 1e9, d.adam.rate = 1e6;
    assert_int_equal(tss_training_create(NULL, &d, &t), TSS_OK);
    assert_int_equal(tss_training_step(t, NULL), TSS_OK);
    double slope = 0;
    for (int k = 0; k < 2; k++)
        for (size_t i = 0; i < c.count[k]; i++)
            slope += (c.theta[k][i] - tss_net_parameters(net[k])[i]) * 1e3 * c.dir[k][i];
    double size = held_step_loss(&c, 0);
    check_slope("training, held", held_step_loss, &c, slope, fabs(slope) + 0.1 * size, 1e-5);
    tss_training_destroy(t);
    c.held[0] = s.coords;
    assert_int_equal(tss_training_create(NULL, &d, &t), TSS_ERROR_BAD_ARGUMENT);
    for (int k = 0; k < 2; k++) free(c.theta[k]), free(c.dir[k]);
    free(c.frames), tss_model_free(&c.m), scene_free(&s);
}

// Values of all losses from their formulas, with Hessians and positions of the public functions.
static void test_loss_values(void **state) {
    (void)state;
    enum { R = 3, B = 4 };
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    tss_net *dec = decoder_of(&s, R, TSS_GELU, 1, 8), *enc = encoder_of(&s, R, TSS_GELU);
    double *z = randoms(B * R, 1), P[B], g[B * R], H[B * R * R], x[B * 200],
           *data = randoms((size_t)(B * s.coords), 1);
    double code[B * R], loss, parts[2], sum = 0, most[3] = {0}, lip[3] = {0}, repulsion = 0;
    tss_reduced_potential(dec, s.e, s.work, B, z, P, g, H), tss_net_forward(dec, s.work, B, z, x);
    for (int i = 0; i < B; i++)
        for (int j = 0; j < B; j++) {
            double dz = 0, df = 0, d[3] = {(P[i] - P[j]) * (P[i] - P[j]), 0, 0};
            if (i == j) continue;
            for (int a = 0; a < R; a++)
                dz += pow(z[i * R + a] - z[j * R + a], 2),
                    d[1] += pow(g[i * R + a] - g[j * R + a], 2);
            for (int a = 0; a < R * R; a++) d[2] += pow(H[i * R * R + a] - H[j * R * R + a], 2);
            for (int a = 0; a < s.coords; a++)
                df += s.mass[a] * pow(x[i * s.coords + a] - x[j * s.coords + a], 2);
            repulsion += pow(log(sqrt(df) / (0.6 * sqrt(dz))), 2) / (B * (B - 1));
            for (int o = 0; o < 3; o++)
                lip[o] += d[o] / dz / (B * (B - 1)), most[o] = fmax(most[o], sqrt(d[o] / dz));
        }
    for (int o = 0; o < 3; o++) {
        tss_lipschitz_def d = tss_lipschitz_def_default();
        double estimate;
        d.order = o;
        tss_loss_lipschitz(dec, s.e, s.work, &d, B, z, NULL, 1, &loss, NULL, NULL);
        tss_lipschitz_estimate(dec, s.e, s.work, o, B, z, &estimate);
        assert_true(fabs(loss / lip[o] - 1) < 1e-11 && fabs(estimate / most[o] - 1) < 1e-11);
    }
    double lost[B * R], estimate;  // a sample that is not finite is not passed over
    memcpy(lost, z, sizeof lost), lost[R] = NAN;
    tss_lipschitz_estimate(dec, s.e, s.work, 2, B, lost, &estimate);
    assert_true(isnan(estimate));
    memcpy(lost, z, sizeof lost), memcpy(lost + R, lost, R * sizeof *lost);  // the same one twice
    tss_lipschitz_estimate(dec, s.e, s.work, 2, B, lost, &estimate);
    assert_true(estimate > 0 && isfinite(estimate));
    tss_loss_unsupervised(dec, s.e, s.work, s.mass, 0.8, 0.6, 0, B, z, 1, &loss, parts, NULL);
    assert_true(fabs(parts[1] / repulsion - 1) < 1e-11);
    assert_true(fabs(parts[0] / ((P[0] + P[1] + P[2] + P[3]) / 4) - 1) < 1e-12);
    assert_true(fabs(loss / (parts[0] + 0.8 * parts[1]) - 1) < 1e-14);
    tss_net_forward(enc, s.work, B, data, code), tss_net_forward(dec, s.work, B, code, x);
    for (int i = 0; i < B * s.coords; i++) sum += s.mass[i % s.coords] * pow(x[i] - data[i], 2) / B;
    tss_loss_reconstruction(dec, enc, s.work, s.mass, B, data, 1, &loss, NULL, NULL);
    assert_true(fabs(loss / sum - 1) < 1e-12);
    tss_net_destroy(dec), tss_net_destroy(enc), scene_free(&s), free(z), free(data);
}

// z = T y: the same manifold, the Hessian Tᵀ∇²P T, the encoder beside it; L_C of a training with
// the spread T⁻¹ is what it was, and so is its gradient in what T does not touch. Singular: nothing
// changes.
static void test_change_z(void **state) {
    (void)state;
    enum { R = 3, B = 4 };
    const double T[R * R] = {2, 0.5, 0, -1, 1, 0.3, 0, 0.2, 0.1},
                       flat[R * R] = {1, 2, 0, 2, 4, 0, 0, 0, 1};
    scene s;
    scene_make(&s, 2, 2, 2, 0);
    int hidden = 6, width_d[3] = {R, hidden, s.coords}, width_e[3] = {s.coords, hidden, R};
    tss_net_def nd = tss_net_def_default();
    tss_model m;
    memset(&m, 0, sizeof m);
    nd.layers = 2, nd.width = width_d, nd.activation = TSS_SILU, nd.outputs = s.coords,
    nd.out_base = s.X;
    assert_int_equal(tss_net_create(NULL, &nd, &m.decoder), TSS_OK);
    nd = tss_net_def_default(), nd.layers = 2, nd.width = width_e, nd.seed = 3;
    assert_int_equal(tss_net_create(NULL, &nd, &m.encoder), TSS_OK);
    double y[B * R], z[B * R], code[2][B * R], H[2][B * R * R];
    double *x = (double *)calloc((size_t)(3 * B * s.coords), sizeof *x), *x2 = x + B * s.coords,
           *data = x2 + B * s.coords;
    for (int i = 0; i < B * R; i++) y[i] = 0.3 * tss_rng_normal(&rng);
    for (int i = 0; i < B * R; i++)
        z[i] = T[i % R * R] * y[i - i % R] + T[i % R * R + 1] * y[i - i % R + 1] +
               T[i % R * R + 2] * y[i - i % R + 2];
    for (int i = 0; i < B * s.coords; i++) data[i] = s.X[i % s.coords] + 0.1 * tss_rng_normal(&rng);
    tss_net_forward(m.decoder, s.work, B, z, x),
        tss_net_forward(m.encoder, s.work, B, data, code[0]);
    tss_reduced_potential_held(m.decoder, s.e, s.work, NULL, B, z, NULL, NULL, H[0]);
    assert_int_equal(tss_model_change_z(&m, flat), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_model_change_z(&m, NULL), TSS_ERROR_BAD_ARGUMENT);
    tss_net_forward(m.decoder, s.work, B, z, x2);
    assert_memory_equal(x, x2, (size_t)(B * s.coords) * sizeof *x);
    assert_int_equal(tss_model_change_z(&m, T), TSS_OK);
    tss_net_forward(m.decoder, s.work, B, y, x2),
        tss_net_forward(m.encoder, s.work, B, data, code[1]);
    for (int i = 0; i < B * s.coords; i++) assert_true(fabs(x[i] - x2[i]) < 1e-13);
    for (int i = 0; i < B * R; i++) {  // T code[1] = code[0]
        const double *c = code[1] + i - i % R, *t = T + i % R * R;
        assert_true(fabs(t[0] * c[0] + t[1] * c[1] + t[2] * c[2] - code[0][i]) < 1e-13);
    }
    tss_reduced_potential_held(m.decoder, s.e, s.work, NULL, B, y, NULL, NULL, H[1]);
    for (int i = 0; i < B * R * R; i++) {
        double sum = 0, size = 0;
        for (int k = 0; k < R * R; k++) {
            sum +=
                T[k / R * R + i % (R * R) / R] * H[0][i - i % (R * R) + k] * T[k % R * R + i % R];
            size = fmax(size, fabs(H[0][i - i % (R * R) + k]));
        }
        assert_true(fabs(sum - H[1][i]) < 1e-12 * size);
    }
    // Training without rate: L_C before and after, of the same normal samples.
    double loss[2], S[R * R];
    for (int i = 0; i < R * R; i++) {  // T⁻¹ by cofactors
        int a = i % R, b = i / R, p = (a + 1) % R, q = (a + 2) % R, u = (b + 1) % R,
            w = (b + 2) % R;
        double det = T[0] * (T[4] * T[8] - T[5] * T[7]) - T[1] * (T[3] * T[8] - T[5] * T[6]) +
                     T[2] * (T[3] * T[7] - T[4] * T[6]);
        S[i] = (T[p * R + u] * T[q * R + w] - T[p * R + w] * T[q * R + u]) / det;
    }
    tss_net_destroy(m.encoder), m.encoder = NULL;
    for (int k = 0; k < 2; k++) {  // k = 0: y and S; then back to z
        tss_training_def d = tss_training_def_default();
        tss_training *t;
        tss_training_info info;
        d.model = &m, d.elements = s.e, d.batch = 8, d.sigma = 0.3, d.spread = k == 0 ? S : NULL,
        d.adam.rate = 1e-300;
        m.rng = tss_rng_seed(5);
        if (k == 1) assert_int_equal(tss_model_change_z(&m, S), TSS_OK);
        assert_int_equal(tss_training_create(NULL, &d, &t), TSS_OK);
        assert_int_equal(tss_training_step(t, &info), TSS_OK);
        loss[k] = info.loss, tss_training_destroy(t);
    }
    assert_true(fabs(loss[1] / loss[0] - 1) < 1e-11);
    tss_model_free(&m), scene_free(&s), free(x);
}

// Means of the estimators, loss and gradient, lie within five standard errors of the exact loss.
static void test_unbiased(void **state) {
    (void)state;
    enum { R = 4, B = 4, N = 3000 };
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    tss_net *dec = decoder_of(&s, R, TSS_SILU, 1, 8);
    size_t P = count_of(dec);
    double *z = randoms(B * R, 1), *g = doubles(P), *dir = randoms(P, 1), exact, probe[2 * R * 2],
           spread[2];
    tss_lipschitz_def d = tss_lipschitz_def_default();
    tss_loss_lipschitz(dec, s.e, s.work, &d, B, z, NULL, 1, &exact, g, NULL);
    double slope = dot(g, dir, P);
    const uint64_t seed = 20240917;
    print_message("estimators: seed %llu, %d samples\n", (unsigned long long)seed, N);
    for (int kind = 0; kind < 4; kind++) {
        tss_rng r = tss_rng_seed(seed + (uint64_t)kind);
        double m[2] = {0, 0}, v[2] = {0, 0}, want[2] = {exact, slope};
        d.estimator = kind % 2 ? TSS_LIPSCHITZ_U : TSS_LIPSCHITZ_UV, d.probes = 1 + kind / 2;
        for (int k = 0; k < N; k++) {
            double sample[2];
            for (int i = 0; i < 2 * R * d.probes; i++) probe[i] = tss_rng_normal(&r);
            memset(g, 0, P * sizeof *g);
            tss_loss_lipschitz(dec, s.e, s.work, &d, B, z, probe, 1, sample, g, NULL);
            sample[1] = dot(g, dir, P);
            for (int q = 0; q < 2; q++) m[q] += sample[q] / N, v[q] += sample[q] * sample[q] / N;
        }
        for (int q = 0; q < 2; q++) {
            double error = sqrt((v[q] - m[q] * m[q]) / N);
            print_message("  %s, %d probe(s), %s: %g ± %g, exact %g\n",
                          kind % 2 ? "|dH u|^2" : "(u dH v)^2", d.probes, q ? "slope" : "loss",
                          m[q], error, want[q]);
            assert_true(error > 0 && fabs(m[q] - want[q]) < 5 * error);
            if (q == 0 && kind < 2) spread[kind] = error;
        }
    }
    assert_true(spread[1] < 0.7 * spread[0]);  // ‖ΔH u‖² has the smaller variance
    tss_net_destroy(dec), scene_free(&s), free(z), free(g), free(dir);
}

// ---- threads --------------------------------------------------------------------------------

static void backwards(int blocks, tss_task *task, void *arg, void *ctx) {
    (void)ctx;
    for (int b = blocks - 1; b >= 0; b--) task(b, b % 2, arg);
}

static void test_threads(void **state) {
    (void)state;
    enum { R = 4, B = 19 };
    scene s;
    scene_make(&s, 3, 2, 1, 1);
    tss_net *dec = decoder_of(&s, R, TSS_SILU, 1, 8), *enc = encoder_of(&s, R, TSS_SILU);
    size_t nd = count_of(dec), ne = count_of(enc);
    double *z = randoms(B * R, 1), *data = randoms((size_t)(B * s.coords), 1), probe[2 * R];
    for (int i = 0; i < 2 * R; i++) probe[i] = rnd();
    size_t total = 5 * nd + ne + B * R;
    double *first = NULL;
    for (int run = 0; run < 5; run++) {
        tss_host h = tss_host_default();
        tss_work *w;
        double *g = doubles(total), lip;
        h.workers = run + 1;
        if (run == 4) h.parallel_for = backwards;
        assert_int_equal(tss_work_create(&h, &w), TSS_OK);
        tss_loss_reconstruction(dec, enc, w, s.mass, B, data, 1, NULL, g, g + 5 * nd);
        tss_loss_unsupervised(dec, s.e, w, s.mass, 1, 1, 1e-8, B, z, 1, NULL, NULL, g + nd);
        for (int est = 0; est < 3; est++) {
            tss_lipschitz_def d = tss_lipschitz_def_default();
            d.estimator = (tss_estimator)est;
            tss_loss_lipschitz(dec, s.e, w, &d, B, z, est ? probe : NULL, 1, &lip,
                               g + (2 + est) * (int)nd, g + 5 * nd + ne);
        }
        if (first) assert_memory_equal(first, g, total * sizeof *g);
        if (first)
            free(g);
        else
            first = g;
        tss_work_destroy(w);
    }
    tss_net_destroy(dec), tss_net_destroy(enc), scene_free(&s), free(z), free(data), free(first);
}

// ---- Adam -----------------------------------------------------------------------------------

// With a constant gradient both moments are exact after bias correction: every step moves by
// rate · g / (|g| + eps), so the path is a sum of rates.
static void test_adam(void **state) {
    (void)state;
    tss_adam_def d = tss_adam_def_default();
    tss_adam *a;
    d.rate = 0.01, d.decay = 0.5, d.decay_every = 20, d.warmup = 8;
    double x[3] = {1, -2, 0.5}, g[3] = {3, -1e-4, 250}, want[3] = {1, -2, 0.5};
    assert_int_equal(tss_adam_create(NULL, &d, 3, &a), TSS_OK);
    for (int t = 0; t < 50; t++) {
        double rate = 0.01 * pow(0.5, t / 20) * (t < 8 ? (t + 1) / 8.0 : 1);
        assert_true(fabs(tss_adam_rate(a) - rate) < 1e-17);
        for (int i = 0; i < 3; i++) want[i] -= rate * g[i] / (fabs(g[i]) + 1e-8);
        tss_adam_update(a, 0, 2, x, g), tss_adam_update(a, 2, 1, x + 2, g + 2), tss_adam_advance(a);
    }
    for (int i = 0; i < 3; i++) assert_true(fabs(x[i] - want[i]) < 1e-12);
    assert_int_equal(tss_adam_steps(a), 50);
    // A badly scaled quadratic, ½ Σ k (x − c)²: the minimum is known.
    d = tss_adam_def_default(), d.rate = 0.05, d.decay = 0.5, d.decay_every = 200;
    assert_int_equal(tss_adam_set(a, &d, 1), TSS_OK);
    const double k[3] = {100, 1, 0.01}, c[3] = {1, -1, 2};
    for (int t = 0; t < 3000; t++) {
        for (int i = 0; i < 3; i++) g[i] = k[i] * (x[i] - c[i]);
        tss_adam_update(a, 0, 3, x, g), tss_adam_advance(a);
    }
    for (int i = 0; i < 3; i++) assert_true(fabs(x[i] - c[i]) < 1e-3);
    d.beta1 = 0.5;
    assert_int_equal(tss_adam_set(a, &d, 0), TSS_ERROR_BAD_ARGUMENT);
    d.beta1 = 1;
    assert_int_equal(tss_adam_set(a, &d, 1), TSS_ERROR_BAD_ARGUMENT);
    tss_adam_destroy(a);
}

// ---- models ---------------------------------------------------------------------------------

static void model_of(const scene *s, int supervised, tss_model *m) {
    memset(m, 0, sizeof *m);
    rng = tss_rng_seed(2);
    m->decoder = decoder_of(s, 3, TSS_SILU, supervised, 15);
    if (supervised) m->encoder = encoder_of(s, 3, TSS_SILU);
    m->rng = tss_rng_seed(4);
}

static unsigned char *saved(const tss_model *m, size_t *size) {
    *size = tss_model_save(m, NULL, 0);
    unsigned char *p = (unsigned char *)malloc(*size);
    assert_non_null(p);
    assert_int_equal(tss_model_save(m, p, *size - 1), 0);
    assert_int_equal(tss_model_save(m, p, *size), *size);
    return p;
}

static void refused(const unsigned char *p, size_t size, const char *word) {
    tss_model m;
    char why[160];
    assert_int_equal(tss_model_load(NULL, p, size, &m, why, sizeof why), TSS_ERROR_FORMAT);
    if (!strstr(why, word)) fail_msg("\"%s\" does not say \"%s\"", why, word);
    assert_true(!m.decoder && !m.encoder && !m.adam);
    assert_int_equal(tss_model_load(NULL, p, size, &m, NULL, 0), TSS_ERROR_FORMAT);
}

static void put64(unsigned char *p, uint64_t x) {
    for (int k = 0; k < 8; k++) p[k] = (unsigned char)(x >> 8 * k);
}

static void reseal(unsigned char *p,
                   size_t size) {  // a forger's checksum, written here from the document
    uint64_t h = 14695981039346656037u;
    for (size_t i = 0; i < size; i++)
        if (i < 24 || i >= 32) h = (h ^ p[i]) * 1099511628211u;
    put64(p + 24, h);
}

static void test_files(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 1, 1, 0);
    for (int supervised = 0; supervised < 2; supervised++) {
        tss_model m, copy;
        model_of(&s, supervised, &m);
        tss_adam_def ad = tss_adam_def_default();
        size_t params = count_of(m.decoder) + (m.encoder ? count_of(m.encoder) : 0), size, size2;
        assert_int_equal(tss_adam_create(NULL, &ad, params, &m.adam), TSS_OK);
        unsigned char *p = saved(&m, &size), *q, *bad = (unsigned char *)malloc(size + 8);
        assert_memory_equal(p, "tssNEUR\n", 8);
        assert_int_equal(tss_model_load(NULL, p, size, &copy, NULL, 0), TSS_OK);
        q = saved(&copy, &size2);
        assert_int_equal(size, size2), assert_memory_equal(p, q, size);
        double z[3] = {0.1, 0.2, 0.3}, a[64], b[64];
        tss_net_forward(m.decoder, s.work, 1, z, a), tss_net_forward(copy.decoder, s.work, 1, z, b);
        assert_memory_equal(a, b, (size_t)s.coords * sizeof *a);
        tss_model_free(&copy), free(q);
        // Every byte in turn: refused. Resealed, so that the checksum is right: refused or loaded,
        // and what loads can be run and saved (under the sanitisers in make sanitize).
        for (size_t i = 0; i < size; i++) {
            memcpy(bad, p, size), bad[i] ^= (unsigned char)(1 + i % 255);
            refused(bad, size,
                    i < 8    ? "not a tss_neural file"
                    : i < 16 ? "version"
                    : i < 24 ? "bytes"
                             : "checksum");
            if (i < 32) continue;
            reseal(bad, size);
            if (tss_model_load(NULL, bad, size, &copy, NULL, 0) != TSS_OK) continue;
            tss_net_info info;
            tss_net_get_info(copy.decoder, &info);
            if (info.inputs <= 3 && info.outputs <= 64)
                tss_net_forward(copy.decoder, s.work, 1, z, b);
            tss_model_free(&copy);
        }
        for (size_t cut = 0; cut < size; cut += 1 + cut / 20)
            refused(p, cut, cut < 80 ? "not a" : "cut short");
        memcpy(bad, p, size), put64(bad + 8, 7), reseal(bad, size), refused(bad, size, "version 7");
        // Absurd sizes behind a right checksum ask for no memory.
        memcpy(bad, p, size), put64(bad + 80, 1u << 30), reseal(bad, size),
            refused(bad, size, "number of layers");
        memcpy(bad, p, size), put64(bad + 80 + 56 + 8, 1 << 26), reseal(bad, size),
            refused(bad, size, "the decoder needs");
        memcpy(bad, p, size), put64(bad + 80 + 56, UINT64_MAX), reseal(bad, size),
            refused(bad, size, "a width");
        memcpy(bad, p, size), put64(bad + size - 8, 0x7FF8000000000000u), reseal(bad, size),
            refused(bad, size, "not finite");
        memcpy(bad, p, size), memset(bad + size, 0, 8), put64(bad + 16, size + 8),
            reseal(bad, size + 8);
        refused(bad, size + 8, "behind the end");
        free(bad), free(p), tss_model_free(&m);
    }
    scene_free(&s);
}

static void test_paths(void **state) {
    (void)state;
    scene s;
    tss_model m, copy;
    char path[64], why[160];
    snprintf(path, sizeof path, "/tmp/test_neural_%ld.tssn", (long)getpid());
    scene_make(&s, 3, 2, 2, 1);
    model_of(&s, 1, &m);
    assert_int_equal(tss_model_write(NULL, &m, path), TSS_OK);
    m.step = 12;
    assert_int_equal(tss_model_write(NULL, &m, path), TSS_OK);  // over the old one
    assert_int_equal(tss_model_read(NULL, path, &copy, why, sizeof why), TSS_OK);
    assert_int_equal(copy.step, 12);
    // What a reader would refuse is not written, and the old file stays.
    double *theta = tss_net_parameters(m.decoder), kept = theta[0];
    theta[0] = NAN;
    assert_int_equal(tss_model_save(&m, NULL, 0), 0);
    assert_int_equal(tss_model_write(NULL, &m, path), TSS_ERROR_BAD_ARGUMENT);
    theta[0] = kept, tss_model_free(&copy);
    assert_int_equal(tss_model_read(NULL, path, &copy, why, sizeof why), TSS_OK);
    size_t a, b;
    unsigned char *p = saved(&m, &a), *q = saved(&copy, &b);
    assert_int_equal(a, b), assert_memory_equal(p, q, a);
    tss_model_free(&copy), free(p), free(q);
    remove(path);
    assert_int_equal(tss_model_read(NULL, path, &copy, why, sizeof why), TSS_ERROR_FILE);
    assert_non_null(strstr(why, path));
    assert_int_equal(tss_model_read(NULL, "/tmp", &copy, why, sizeof why), TSS_ERROR_FILE);
    assert_int_equal(tss_model_write(NULL, &m, "/nowhere/at/all"), TSS_ERROR_FILE);
    tss_model_free(&m);
    assert_int_equal(tss_model_write(NULL, &m, path), TSS_ERROR_BAD_ARGUMENT);
    scene_free(&s);
}

static tss_training_def training_of(scene *s, tss_model *m, double *frames) {
    tss_training_def d = tss_training_def_default();
    d.model = m, d.elements = s->e, d.mass = s->mass, d.batch = 6;
    if (m->encoder)
        d.frames = frames, d.frame_count = 20;
    else
        d.ramp = 30;
    d.lipschitz_weight = 1e-3, d.lipschitz_from = 10, d.lipschitz_batch = 4;
    d.lipschitz.estimator = TSS_LIPSCHITZ_U;
    d.adam.warmup = 5, d.adam.decay = 0.8, d.adam.decay_every = 7;
    return d;
}

// 24 steps at once, and in pieces through files: the same bytes.
static void test_resume(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    double *frames = randoms((size_t)(20 * s.coords), 1);
    for (int supervised = 0; supervised < 2; supervised++) {
        unsigned char *end[2];
        size_t size[2];
        for (int run = 0; run < 2; run++) {
            tss_model m;
            model_of(&s, supervised, &m);
            for (int done = 0; done < 24;) {
                int upto = run ? done + 5 < 24 ? done + 5 : 24 : 24;
                tss_training_def d = training_of(&s, &m, frames);
                tss_training *t;
                assert_int_equal(tss_training_create(NULL, &d, &t), TSS_OK);
                for (; done < upto; done++) {
                    tss_training_info info;
                    assert_int_equal(tss_training_step(t, &info), TSS_OK);
                    assert_true(!info.skipped && (info.lipschitz > 0) == (done >= 10));
                }
                tss_training_destroy(t);
                size_t bytes;
                unsigned char *p = saved(&m, &bytes);
                tss_model_free(&m);
                assert_int_equal(tss_model_load(NULL, p, bytes, &m, NULL, 0), TSS_OK);
                free(p);
            }
            end[run] = saved(&m, &size[run]);
            assert_int_equal(m.step, 24);
            tss_model_free(&m);
        }
        assert_int_equal(size[0], size[1]);
        assert_memory_equal(end[0], end[1], size[0]);
        free(end[0]), free(end[1]);
    }
    free(frames), scene_free(&s);
}

// A gradient whose square overflows is skipped like one that is not finite: moments stay finite,
// and what is saved can be loaded.
static void test_huge_gradient(void **state) {
    (void)state;
    scene s;
    tss_model m, copy;
    tss_training *t;
    tss_training_info info;
    scene_make(&s, 2, 2, 1, 0);
    double *frames = randoms((size_t)(20 * s.coords), 1);
    for (int i = 0; i < s.coords; i++) s.mass[i] = 1e200;
    model_of(&s, 1, &m);
    tss_training_def d = training_of(&s, &m, frames);
    assert_int_equal(tss_training_create(NULL, &d, &t), TSS_OK);
    assert_int_equal(tss_training_step(t, &info), TSS_OK);
    assert_true(info.skipped && isfinite(info.loss));
    size_t size;
    unsigned char *p = saved(&m, &size);
    assert_int_equal(tss_model_load(NULL, p, size, &copy, NULL, 0), TSS_OK);
    tss_training_destroy(t), tss_model_free(&m), tss_model_free(&copy);
    free(p), free(frames), scene_free(&s);
}

// ---- errors ---------------------------------------------------------------------------------

static char logged[1024];
static void keep_log(tss_log_level level, const char *text, void *ctx) {
    (void)level, (void)ctx;
    snprintf(logged, sizeof logged, "%s", text);
}

static void test_refusals(void **state) {
    (void)state;
    tss_host h = tss_host_default();
    h.log = keep_log;
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    int width[3] = {2, 3, 4}, index[4] = {0, 1, 1, 2};
    tss_net *n;
    tss_net_def good = tss_net_def_default(), d;
    good.layers = 2, good.width = width;
#define REFUSED(change, word)                                                             \
    d = good, change;                                                                     \
    assert_int_equal(tss_net_create(&h, &d, &n), TSS_ERROR_BAD_ARGUMENT), assert_null(n); \
    assert_non_null(strstr(logged, word))
    REFUSED(d.layers = 0, "layers");
    REFUSED(d.layers = 65, "layers");
    REFUSED(d.width = NULL, "widths");
    REFUSED(d.activation = TSS_ACTIVATIONS, "activation");
    REFUSED(d.out_scale = NAN, "out_scale");
    REFUSED(d.out_scale = 0.5, "out_scale");  // no outputs: it would be ignored
    REFUSED((d.out_scale = 0.5, d.out_matrix = s.X, d.outputs = 2), "out_scale");
    REFUSED(d.outputs = 5, "last width");
    REFUSED((d.outputs = 5, d.out_index = index), "twice");
    REFUSED((d.outputs = 2, d.out_index = index), "out of range");
    REFUSED(d.out_base = s.X, "without outputs");
    REFUSED(d.in_base = s.X, "in_base");
    REFUSED((d.in_matrix = s.X, d.inputs = 0), "inputs");
    double nan4[16] = {NAN};
    REFUSED((d.out_matrix = nan4, d.outputs = 4), "not finite");
    tss_elements *e;
    tss_elements_def ed = def_of(&s);
    int flat[3] = {0, 1, 2}, far[3] = {0, 1, 99}, twist[3] = {0, 3, 1};
    ed.cells = 1, ed.cell = flat,
    assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_MESH);
    ed.cell = far, assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_MESH);
    ed.cell = twist, assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_MESH);
    ed = def_of(&s), ed.nu = 0.5,
    assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_MATERIAL);
    ed = def_of(&s), ed.subset = far, ed.count = 3,
    assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_ARGUMENT);
    double minus = -1;
    ed.count = 1, ed.weight = &minus,
    assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_ARGUMENT);
    ed = def_of(&s), ed.dim = 4,
    assert_int_equal(tss_elements_create(&h, &ed, &e), TSS_ERROR_BAD_ARGUMENT);
    // Calls that do not fit each other.
    double z[8] = {0}, out[64];
    tss_net_create(NULL, &good, &n);
    assert_int_equal(tss_reduced_potential(n, s.e, s.work, 1, z, out, NULL, NULL),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_net_forward(n, s.work, 0, z, out), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_net_jets(n, s.work, 1, 1, z, z, NULL, NULL, NULL, out),
                     TSS_ERROR_BAD_ARGUMENT);
    tss_training *t;
    tss_training_def td = tss_training_def_default();
    assert_int_equal(tss_training_create(&h, &td, &t), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(logged, "decoder"));
    // A decoder with a first map has no place in training: said at once, not by each step.
    double *frames = randoms((size_t)(20 * s.coords), 1);
    int wide[3] = {8, 3, 8};
    tss_model m;
    model_of(&s, 1, &m), tss_net_destroy(m.decoder);
    d = good, d.width = wide, d.inputs = 3, d.in_matrix = frames, d.outputs = s.coords;
    wide[2] = s.coords;
    assert_int_equal(tss_net_create(NULL, &d, &m.decoder), TSS_OK);
    td = training_of(&s, &m, frames), td.elements = NULL, td.lipschitz_weight = 0;
    assert_int_equal(tss_training_create(&h, &td, &t), TSS_ERROR_BAD_ARGUMENT), assert_null(t);
    assert_non_null(strstr(logged, "in_matrix"));
    tss_model_free(&m), free(frames);
    tss_net_destroy(n), scene_free(&s);
}

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

// Every allocation fails in turn: NO_MEMORY, nothing leaks, and the next try works.
static void test_no_memory(void **state) {
    (void)state;
    scene s;
    scene_make(&s, 2, 2, 1, 0);
    double *frames = randoms((size_t)(20 * s.coords), 1);
    tss_host h = tss_host_default();
    h.alloc = stingy_alloc, h.free = stingy_free, h.workers = 1;
    tss_model m;
    size_t size;
    model_of(&s, 1, &m);
    unsigned char *p = saved(&m, &size);
    tss_model_free(&m);
    int done = 0, failures = 0;
    for (int limit = 0; !done && limit < 100; limit++) {
        allowance = limit;
        tss_training *t = NULL;
        tss_result r = tss_model_load(&h, p, size, &m, NULL, 0);
        if (r == TSS_OK) {
            tss_training_def d = training_of(&s, &m, frames);
            d.lipschitz_from = 0;
            r = tss_training_create(&h, &d, &t);
            for (int k = 0; r == TSS_OK && k < 2; k++) r = tss_training_step(t, NULL);
        }
        if (r == TSS_OK)
            done = 1;
        else
            failures++, assert_int_equal(r, TSS_ERROR_NO_MEMORY);
        // After a failure in a step the next one goes on.
        allowance = 1000;
        if (t) assert_int_equal(tss_training_step(t, NULL), TSS_OK);
        tss_training_destroy(t), tss_model_free(&m);
        assert_int_equal(held, 0);
    }
    assert_true(done && failures > 8);
    // A step without memory is as if it had not been called, the ramp's scale included.
    size_t size2;
    tss_training *t;
    model_of(&s, 0, &m);
    tss_training_def d = training_of(&s, &m, NULL);
    allowance = 1000;
    assert_int_equal(tss_training_create(&h, &d, &t), TSS_OK);
    unsigned char *before = saved(&m, &size), *after;
    allowance = 0;
    assert_int_equal(tss_training_step(t, NULL), TSS_ERROR_NO_MEMORY);
    after = saved(&m, &size2);
    assert_int_equal(size, size2), assert_memory_equal(before, after, size);
    tss_training_destroy(t), tss_model_free(&m), free(before), free(after);
    assert_int_equal(held, 0);
    free(p), free(frames), scene_free(&s);
}

// ---- cubature -------------------------------------------------------------------------------

// The relative error of a subset, from reduced gradients alone.
static double subset_error(const scene *s, const tss_net *n, int count, const int *subset,
                           const double *weight, int samples, const double *z) {
    enum { R = 4 };
    tss_elements_def d = def_of(s);
    tss_elements *e;
    double *a = doubles((size_t)samples * R), *b = doubles((size_t)samples * R), gap = 0;
    d.subset = subset, d.count = count, d.weight = weight;
    assert_int_equal(tss_elements_create(NULL, &d, &e), TSS_OK);
    tss_reduced_potential(n, s->e, s->work, samples, z, NULL, a, NULL);
    tss_reduced_potential(n, e, s->work, samples, z, NULL, b, NULL);
    for (int i = 0; i < samples; i++) {
        double size = dot(a + i * R, a + i * R, R);
        for (int k = 0; k < R; k++) gap += pow(a[i * R + k] - b[i * R + k], 2) / size / samples;
    }
    free(a), free(b), tss_elements_destroy(e);
    return sqrt(gap);
}

static void test_cubature(void **state) {
    (void)state;
    enum { R = 4, N = 20 };
    for (int dim = 2; dim <= 3; dim++) {
        scene s;
        scene_make(&s, dim, 6, 3, 1);
        tss_net *n = decoder_of(&s, R, TSS_SILU, 1, 3);
        double *z = randoms(N * R, 1), *fresh = randoms(N * R, 1), last = INFINITY;
        for (int size = 5; size <= 20; size += 5) {
            int subset[20], count;
            double weight[20], error;
            tss_cubature_def d = tss_cubature_def_default();
            d.count = size;
            assert_int_equal(
                tss_cubature_select(n, s.e, s.work, &d, N, z, subset, weight, &count, &error),
                TSS_OK);
            assert_true(count >= 1 && count <= size);
            for (int i = 0; i < count; i++) {
                assert_true(weight[i] > 0);
                if (i) assert_true(subset[i] > subset[i - 1]);
            }
            // The reported error is the true one; more cells make it smaller; it holds at other z.
            assert_true(fabs(subset_error(&s, n, count, subset, weight, N, z) - error) < 1e-9);
            assert_true(error < last);
            last = error;
            // Least squares: no weight can be changed for the better.
            for (int i = 0; i < count; i++)
                for (double f = 0.98; f < 1.03; f += 0.04) {
                    double keep = weight[i];
                    weight[i] *= f;
                    assert_true(subset_error(&s, n, count, subset, weight, N, z) > error);
                    weight[i] = keep;
                }
            if (size < 20) continue;
            // Against as many cells spread evenly, each for its share of the volume.
            int even[20];
            double share[20], other = subset_error(&s, n, count, subset, weight, N, fresh);
            for (int i = 0; i < 20; i++) even[i] = i * s.cells / 20, share[i] = s.cells / 20.0;
            double plain = subset_error(&s, n, 20, even, share, N, fresh);
            print_message(
                "cubature, %dD: 20 of %d cells, error %.3f, at other samples %.3f, evenly spread "
                "%.3f\n",
                dim, s.cells, error, other, plain);
            assert_true(other < 0.6 * plain && error < 0.2);
        }
        // All cells may be chosen: the optimum is exact; a subset of candidates is kept to; tol
        // stops early.
        int all[200], count;
        double w[200], error;
        tss_cubature_def d = tss_cubature_def_default();
        assert_int_equal(tss_cubature_select(n, s.e, s.work, &d, N, z, all, w, &count, &error),
                         TSS_OK);
        assert_true(error < 1e-6);
        d.tol = 0.3;
        assert_int_equal(tss_cubature_select(n, s.e, s.work, &d, N, z, all, w, &count, &error),
                         TSS_OK);
        assert_true(error <= 0.3 && count < 20);
        d.tol = 0, d.candidates = 10, d.seed = 3;
        assert_int_equal(tss_cubature_select(n, s.e, s.work, &d, N, z, all, w, &count, &error),
                         TSS_OK);
        assert_true(count <= 10 && error > 1e-3);
        d.count = 0;
        assert_int_equal(tss_cubature_select(n, s.e, s.work, &d, N, z, all, w, &count, &error),
                         TSS_ERROR_BAD_ARGUMENT);
        d.count = 5, z[R] = NAN;  // not "no cell, no error"
        assert_int_equal(tss_cubature_select(n, s.e, s.work, &d, N, z, all, w, &count, &error),
                         TSS_ERROR_BAD_ARGUMENT);
        tss_net_destroy(n), scene_free(&s), free(z), free(fresh);
    }
}

// A new cell whose least-squares weight is exactly 0 leaves; those before it stay (0/0 otherwise).
static void test_cubature_tie(void **state) {
    (void)state;
    double A[4] = {1, 0, 0, 1}, factor[4] = {1, 0, 0, 1}, rhs[2] = {5, 0}, w[2] = {5, 0}, s[2];
    int in[2] = {0, 1};
    uint8_t out[2] = {1, 1};
    tss__cub c;
    memset(&c, 0, sizeof c);
    c.most = c.chosen = 2, c.A = A, c.L = factor, c.rhs = rhs, c.w = w, c.s = s;
    c.in = in, c.out = out;
    tss__cub_weights(&c);
    assert_int_equal(c.chosen, 1);
    assert_true(in[0] == 0 && w[0] == 5 && out[0] == 1 && out[1] == 0);
}

// ---- reduced solver -------------------------------------------------------------------------

// z moves every free coordinate by itself: Eq. (2) is then the full-space problem.
static tss_net *free_decoder(const scene *s, const int *index, int r) {
    tss_net_def d = tss_net_def_default();
    int width[2] = {r, r};
    tss_net *n;
    d.layers = 1, d.width = width, d.outputs = s->coords, d.out_base = s->X, d.out_index = index;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    double *p = tss_net_parameters(n);
    for (int i = 0; i < r * (r + 1); i++) p[i] = i % (r + 1) == 0 && i < r * r;
    return n;
}

// A cantilever under its weight, dynamic and static, against tss's Newton method with the same
// density.
static void test_reduced_solver(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int dynamic = 0; dynamic < 2; dynamic++) {
            scene s;
            grid(&s, dim, 4, 1, 1, 1.5, 0.4);
            tss_elements_def ed = def_of(&s);
            double lame[2];
            ed.E = 3e4, tss_lame(3e4, 0.35, &lame[0], &lame[1]);
            tss_elements_create(NULL, &ed, &s.e), tss_work_create(NULL, &s.work);
            int pins[8], pinned = 0, index[200], r = 0;
            for (int i = 0; i < s.nodes; i++)
                if (s.X[i * dim] == 0)
                    pins[pinned++] = i;
                else
                    for (int a = 0; a < dim; a++) index[r++] = i * dim + a;
            tss_world_def wd = tss_world_def_default();
            tss_world *w;
            wd.dim = dim, wd.dt = 0.05,
            wd.integrator = dynamic ? TSS_IMPLICIT_EULER : TSS_QUASISTATIC;
            wd.host.workers = 1, wd.tol = dynamic ? 1e-9 : 0, wd.tol_rel = 1e-7;
            assert_int_equal(tss_world_create(&wd, &w), TSS_OK);
            tss_body_def bd = tss_body_def_default();
            bd.nodes = s.nodes, bd.X = s.X, bd.cells = s.cells, bd.cell = s.cell, bd.pins = pinned,
            bd.pin = pins;
            bd.material.kind = TSS_CUSTOM_MATERIAL, bd.material.density = tss_neural_density;
            bd.material.user = lame, bd.material.has_C = 1, bd.material.E = 3e4,
            bd.material.nu = 0.35;
            assert_int_equal(tss_body_add(w, &bd, NULL), TSS_OK);
            assert_int_equal(tss_world_prepare(w), TSS_OK);
            double mass[200], force[200];
            for (int i = 0; i < s.coords; i++) {
                mass[i] = tss_world_masses(w)[i / dim];
                force[i] = mass[i] * wd.gravity[i % dim];
            }
            tss_net *n = free_decoder(&s, index, r);
            tss_reduced_def d = tss_reduced_def_default();
            tss_reduced *sim;
            d.decoder = n, d.elements = s.e, d.mass = mass, d.h = dynamic ? 0.05 : 0, d.eps = 1e-8,
            d.ftol = 0, d.tol = 1e-11;
            assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
            tss_reduced_set_force(sim, force);
            double moved = 0, gap = 0;
            for (int step = 0; step < (dynamic ? 6 : 1); step++) {
                tss_reduced_info info;
                assert_int_equal(tss_world_step(w, NULL), TSS_OK);
                assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
                assert_true(info.gradient < 1e-6);
                for (int i = 0; i < s.coords; i++) {
                    gap = fmax(gap, fabs(tss_reduced_x(sim)[i] - tss_world_positions(w)[i]));
                    moved = fmax(moved, fabs(tss_reduced_x(sim)[i] - s.X[i]));
                }
            }
            print_message("reduced, %dD, %s: moved %.3f m, off by %.1e m\n", dim,
                          dynamic ? "dynamic" : "static", moved, gap);
            assert_true(moved > 0.1 && gap < 1e-8 && gap > 0);
            tss_reduced_destroy(sim), tss_world_destroy(w), tss_net_destroy(n), scene_free(&s);
        }
}

// The four exits, a minimum of a nonlinear decoder, and no allocation in a step.
static void test_reduced_exits(void **state) {
    (void)state;
    enum { R = 3 };
    scene s;
    scene_make(&s, 3, 2, 1, 1);
    tss_net *n = decoder_of(&s, R, TSS_SILU, 1, 12);
    double *force = randoms((size_t)s.coords, 0.1), start[R] = {1, -0.5, 0.3};
    tss_host h = tss_host_default();
    h.alloc = stingy_alloc, h.free = stingy_free, h.log = keep_log, h.workers = 1;
    for (int kind = 0; kind < TSS_EXITS; kind++) {
        tss_reduced_def d = tss_reduced_def_default();
        tss_reduced_info info;
        tss_reduced *sim;
        d.decoder = n, d.elements = s.e, d.mass = s.mass, d.start = start, d.eps = 1e-7, d.ftol = 0;
        d.solver = TSS_LBFGS;
        if (kind == TSS_EXIT_SADDLE) d.eps = 0, d.ftol = 0.5;
        if (kind == TSS_EXIT_LINE_SEARCH) d.eps = 0, d.max_line = 1;
        if (kind == TSS_EXIT_ITERATIONS) d.max_iterations = 2;
        int limit = 0;
        for (allowance = 0; tss_reduced_create(&h, &d, &sim) == TSS_ERROR_NO_MEMORY;
             allowance = ++limit)
            assert_int_equal(held, 0);
        assert_true(sim && limit >= 2);
        tss_reduced_set_force(sim, force);
        allowance = 0;
        assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
        assert_int_equal(info.exit, kind);
        assert_int_equal(tss_reduced_exits(sim)[kind], 1);
        // What is reported is E and its gradient at z, whatever was tried last.
        double x[200], z[R], z_end[R], E[3];
        memcpy(z_end, tss_reduced_z(sim), sizeof z_end);
        for (int side = -1; side <= 1; side++) {
            for (int i = 0; i < R; i++)
                z[i] = tss_reduced_z(sim)[i] + (i == kind % R ? 1e-3 * side : 0);
            tss_net_forward(n, s.work, 1, z, x);
            E[side + 1] = tss_elements_potential(s.e, x, NULL);
            for (int i = 0; side == 0 && i < s.coords; i++)
                assert_true(fabs(x[i] - tss_reduced_x(sim)[i]) < 1e-14);
            double x0[200];
            tss_net_forward(n, s.work, 1, start, x0);
            for (int i = 0; i < s.coords; i++)
                E[side + 1] += s.mass[i] * pow(x[i] - x0[i], 2) / (2 * d.h * d.h) - force[i] * x[i];
        }
        assert_true(fabs(E[1] - info.energy) < 1e-9 * (1 + fabs(E[1])));
        if (kind == TSS_EXIT_CONVERGED)
            assert_true(info.gradient <= d.eps && E[1] < E[0] && E[1] < E[2]);
        for (int k = 0; k < 5; k++)
            assert_int_equal(tss_reduced_step(sim, NULL), TSS_OK);  // allowance is 0
        tss_reduced_destroy(sim);
        assert_int_equal(held, 0);
        if (kind != TSS_EXIT_SADDLE && kind != TSS_EXIT_CONVERGED) continue;
        // So many iterations and no tolerances: the same z.
        memcpy(z, z_end, sizeof z);
        d.eps = d.ftol = 0, d.max_iterations = info.iterations, allowance = 100;
        assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_OK);
        tss_reduced_set_force(sim, force);
        assert_int_equal(tss_reduced_step(sim, &info), TSS_OK);
        assert_int_equal(info.exit, TSS_EXIT_ITERATIONS);
        assert_memory_equal(tss_reduced_z(sim), z, sizeof z);
        tss_reduced_destroy(sim);
    }
    tss_reduced_def d = tss_reduced_def_default();
    tss_reduced *sim;
    allowance = 100, d.decoder = n, d.elements = s.e;
    assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(logged, "masses"));
    d.h = 0, d.memory = 0;
    assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_ERROR_BAD_ARGUMENT);
    d.memory = 5, start[0] = NAN;
    assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_OK);
    assert_int_equal(tss_reduced_set(sim, start), TSS_ERROR_BAD_STATE);
    // z is finite, f(z) is not: nothing changes either.
    const double far[R] = {1e308, 1e308, -1e308};
    double x[200];
    tss_net_parameters(n)[0] = tss_net_parameters(n)[1] = 10;
    memcpy(x, tss_reduced_x(sim), (size_t)s.coords * sizeof *x);
    assert_int_equal(tss_reduced_set(sim, far), TSS_ERROR_BAD_STATE);
    assert_memory_equal(x, tss_reduced_x(sim), (size_t)s.coords * sizeof *x);
    for (int i = 0; i < R; i++) assert_true(tss_reduced_z(sim)[i] == 0);
    tss_reduced_destroy(sim);
    d.start = start;
    assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_ERROR_BAD_ARGUMENT), assert_null(sim);
    d.start = far;
    assert_int_equal(tss_reduced_create(&h, &d, &sim), TSS_ERROR_BAD_ARGUMENT), assert_null(sim);
    assert_non_null(strstr(logged, "start"));
    assert_int_equal(held, 0);
    tss_net_destroy(n), scene_free(&s), free(force);
}

// ---- learning -------------------------------------------------------------------------------

static void bend(const scene *s, double a, double b,
                 double *x) {  // a bar bent by a and stretched by b
    for (int i = 0; i < s->nodes; i++) {
        double X = s->X[i * 2] * (1 + b), Y = s->X[i * 2 + 1] - 0.15, t = a * X;
        double c = fabs(a) < 1e-9 ? X : sin(t) / a, d = fabs(a) < 1e-9 ? 0 : (1 - cos(t)) / a;
        x[i * 2] = c - Y * sin(t), x[i * 2 + 1] = d + Y * cos(t) + 0.15;
    }
}

// Columns that span the frames' displacements, orthonormal in M: Gram–Schmidt on the longest rest.
static int span_of(const double *frames, int count, const scene *s, int most, double *B) {
    size_t n = (size_t)s->coords;
    double *rest = doubles((size_t)count * n);
    int k = 0;
    for (int f = 0; f < count; f++)
        for (size_t i = 0; i < n; i++)
            rest[(size_t)f * n + i] = frames[(size_t)f * n + i] - s->X[i];
    for (; k < most; k++) {
        int best = 0;
        double longest = 0;
        for (int f = 0; f < count; f++) {
            double l = dot(rest + (size_t)f * n, rest + (size_t)f * n, n);
            if (l > longest) longest = l, best = f;
        }
        if (longest < 1e-12) break;
        double *u = doubles(n);
        for (size_t i = 0; i < n; i++)
            u[i] = rest[(size_t)best * n + i] / sqrt(longest),
            B[i * (size_t)most + (size_t)k] = u[i];
        for (int f = 0; f < count; f++) {
            double c = dot(rest + (size_t)f * n, u, n);
            for (size_t i = 0; i < n; i++) rest[(size_t)f * n + i] -= c * u[i];
        }
        free(u);
    }
    free(rest);
    return k;
}

// An autoencoder with two numbers on bars that bend and stretch, then with the Lipschitz loss on.
static void test_autoencoder(void **state) {
    (void)state;
    enum { FRAMES = 150, P = 6, R = 2 };
    scene s;
    grid(&s, 2, 8, 2, 0, 1.5, 0.3);
    tss_elements_def ed = def_of(&s);
    tss_elements_create(NULL, &ed, &s.e), tss_work_create(NULL, &s.work);
    double *frames = doubles((size_t)(FRAMES * s.coords)), *B = doubles((size_t)(s.coords * P)),
           spread = 0;
    for (int f = 0; f < FRAMES; f++) bend(&s, 1.5 * rnd(), 0.15 * rnd(), frames + f * s.coords);
    assert_int_equal(span_of(frames, FRAMES, &s, P, B), P);
    for (int i = 0; i < FRAMES * s.coords; i++)
        spread += pow(frames[i] - s.X[i % s.coords], 2) / FRAMES;
    int dw[4] = {R, 24, 24, P}, ew[4] = {P, 24, 24, R};
    tss_net_def dd = tss_net_def_default(), de = dd;
    dd.layers = de.layers = 3, dd.width = dw, de.width = ew, dd.seed = 1, de.seed = 2;
    dd.outputs = de.inputs = s.coords, dd.out_matrix = de.in_matrix = B,
    dd.out_base = de.in_base = s.X;
    tss_model m = {NULL, NULL, NULL, {{0}}, 0};
    assert_int_equal(tss_net_create(NULL, &dd, &m.decoder), TSS_OK);
    assert_int_equal(tss_net_create(NULL, &de, &m.encoder), TSS_OK);
    tss_training_def d = tss_training_def_default();
    d.model = &m, d.elements = s.e, d.frames = frames, d.frame_count = FRAMES;
    d.adam.rate = 3e-3, d.adam.decay = 0.5, d.adam.decay_every = 800;
    double loss[2], lip[2], *z = doubles(FRAMES * R);
    for (int phase = 0; phase < 2; phase++) {
        tss_training *t;
        tss_training_info info;
        assert_int_equal(tss_training_create(NULL, &d, &t), TSS_OK);
        for (int k = 0; k < (phase ? 800 : 2500); k++) tss_training_step(t, &info);
        tss_training_destroy(t);
        tss_loss_reconstruction(m.decoder, m.encoder, s.work, NULL, FRAMES, frames, 1, &loss[phase],
                                NULL, NULL);
        tss_net_forward(m.encoder, s.work, FRAMES, frames, z);
        tss_lipschitz_estimate(m.decoder, s.e, s.work, 2, FRAMES, z, &lip[phase]);
        print_message("autoencoder, phase %d: relative error %.2e, Lip %g\n", phase,
                      sqrt(loss[phase] / spread), lip[phase]);
        d.lipschitz_weight = 0.3, d.lipschitz.estimator = TSS_LIPSCHITZ_U;
    }
    assert_true(sqrt(loss[0] / spread) < 0.03);
    assert_true(lip[1] < lip[0] / 2 && sqrt(loss[1] / spread) < 0.05);
    tss_model_free(&m), scene_free(&s), free(frames), free(B), free(z);
}

// A bar held and pressed together at both ends, without data (Eq. 4); then Eq. 10.
static void test_unsupervised(void **state) {
    (void)state;
    enum { R = 2, B = 64 };
    scene s;
    grid(&s, 2, 8, 2, 0, 1.5, 0.3);
    tss_elements_def ed = def_of(&s);
    ed.E = 100;
    tss_elements_create(NULL, &ed, &s.e), tss_work_create(NULL, &s.work);
    int width[4] = {R, 24, 24, 0}, index[64];
    double base[64];
    for (int i = 0; i < s.nodes; i++) {
        base[2 * i] = 0.9 * s.X[2 * i], base[2 * i + 1] = s.X[2 * i + 1];
        for (int a = 0; i % 9 != 0 && i % 9 != 8 && a < 2; a++) index[width[3]++] = 2 * i + a;
    }
    tss_net_def nd = tss_net_def_default();
    nd.layers = 3, nd.width = width, nd.activation = TSS_SILU, nd.seed = 6;
    nd.outputs = s.coords, nd.out_base = base, nd.out_index = index;
    tss_model m = {NULL, NULL, NULL, {{0}}, 0};
    assert_int_equal(tss_net_create(NULL, &nd, &m.decoder), TSS_OK);
    tss_training_def d = tss_training_def_default();
    d.model = &m, d.elements = s.e, d.lambda = 2, d.sigma = 0.4, d.ramp = 800;
    d.adam.rate = 2e-3, d.adam.decay = 0.5, d.adam.decay_every = 1000;
    double z[B * R], loss[4], parts[4][2], lip[4], mean[4];
    unsigned char *middle = NULL;
    size_t bytes = 0;
    for (int i = 0; i < B * R; i++) z[i] = tss_rng_normal(&rng);
    for (int phase = 0; phase < 4;
         phase++) {  // the start, vanilla, more of it, Lipschitz in its place
        tss_training *t;
        tss_lipschitz_def ld = tss_lipschitz_def_default();
        if (phase == 2) middle = saved(&m, &bytes);
        if (phase == 3) {
            tss_model_free(&m);
            assert_int_equal(tss_model_load(NULL, middle, bytes, &m, NULL, 0), TSS_OK);
            d.lipschitz_weight = 3, d.lipschitz.estimator = TSS_LIPSCHITZ_U;
        }
        assert_int_equal(tss_training_create(NULL, &d, &t), TSS_OK);
        for (int k = 0; k < (phase == 0 ? 0 : phase == 1 ? 2500 : 1200); k++)
            tss_training_step(t, NULL);
        tss_training_destroy(t);
        tss_loss_unsupervised(m.decoder, s.e, s.work, NULL, d.lambda, d.sigma, d.eps, B, z, 1,
                              &loss[phase], parts[phase], NULL);
        tss_lipschitz_estimate(m.decoder, s.e, s.work, 2, B, z, &lip[phase]);
        tss_loss_lipschitz(m.decoder, s.e, s.work, &ld, B, z, NULL, 1, &mean[phase], NULL, NULL);
        print_message("unsupervised, phase %d: L_C %.4f = %.4f + λ %.4f, L_LS %g, Lip %g\n", phase,
                      loss[phase], parts[phase][0], parts[phase][1], mean[phase], lip[phase]);
    }
    assert_true(loss[1] < 0.5 * loss[0]);
    assert_true(mean[3] < mean[2] / 10 && lip[3] < lip[2] / 3);
    assert_true(loss[3] < 1.05 * loss[2]);  // what it costs
    free(middle);
    tss_model_free(&m), scene_free(&s);
}

static int setup(void **state) {
    (void)state;
    rng = tss_rng_seed(1);
    return 0;
}

int main(void) {
#define T(f) cmocka_unit_test_setup(f, setup)
    const struct CMUnitTest tests[] = {
        T(test_activations),  T(test_forward),       T(test_initial),        T(test_backward),
        T(test_net_jets),     T(test_potential),     T(test_subset),         T(test_element_jets),
        T(test_density),      T(test_reduced),       T(test_losses),         T(test_loss_values),
        T(test_held),         T(test_held_training), T(test_change_z),       T(test_unbiased),
        T(test_threads),      T(test_adam),          T(test_files),          T(test_paths),
        T(test_resume),       T(test_refusals),      T(test_no_memory),      T(test_huge_gradient),
        T(test_cubature_tie), T(test_cubature),      T(test_reduced_solver), T(test_reduced_exits),
        T(test_autoencoder),  T(test_unsupervised),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
