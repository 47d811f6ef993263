// Shells: values against formulas in lengths and angles, every derivative against differences,
// rigid motion, a cylinder, shares of hinges in subsets.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_neural.h"
#include <stdio.h>

static tss_rng rng;
static double rnd(void) { return 2 * tss_rng_uniform(&rng) - 1; }

static double dot(const double *a, const double *b, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += a[i] * b[i];
    return s;
}

static double distance(const double *a, const double *b, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += (a[i] - b[i]) * (a[i] - b[i]);
    return sqrt(s);
}

enum { NX = 4, NY = 3, NODES = (NX + 1) * (NY + 1), N = 3 * NODES, CELLS = 2 * NX * NY };

typedef struct sheet {
    double X[N];
    int cell[3 * CELLS];
    tss_elements_def def;
    tss_elements *e;
    tss_work *work;
} sheet;

static const double WIDE = 0.3, LONG = 0.4;  // of a rectangle

// A grid in the plane z = 0, bumpy by the size given; cells turn both ways round.
static void sheet_def(sheet *s, double bumps) {
    memset(s, 0, sizeof *s);
    for (int i = 0; i < NODES; i++) {
        s->X[3 * i] = WIDE * (i % (NX + 1)) + bumps * rnd();
        s->X[3 * i + 1] = LONG * (i / (NX + 1)) + bumps * rnd(), s->X[3 * i + 2] = bumps * rnd();
    }
    for (int b = 0; b < NX * NY; b++) {
        int at = b / NX * (NX + 1) + b % NX;
        int t[6] = {at, at + 1, at + NX + 2, at, at + NX + 2, at + NX + 1};
        if (b % 3 == 0) t[1] = at + NX + 2, t[2] = at + 1;
        memcpy(s->cell + 6 * b, t, sizeof t);
    }
    s->def = tss_elements_def_default();
    s->def.nodes = NODES, s->def.X = s->X, s->def.cells = CELLS, s->def.cell = s->cell;
    s->def.E = 40, s->def.nu = 0.3, s->def.shell = 0.02, s->def.bending = 0.03;
}

static void sheet_make(sheet *s, double bumps) {
    sheet_def(s, bumps);
    assert_int_equal(tss_elements_create(NULL, &s->def, &s->e), TSS_OK);
    assert_int_equal(tss_work_create(NULL, &s->work), TSS_OK);
}

static void sheet_free(sheet *s) { tss_elements_destroy(s->e), tss_work_destroy(s->work); }

// ---- the same energy from lengths and angles, in long double ----------------------------------

typedef long double real;

static void edge_of(const double *x, int a, int b, real *e) {
    for (int r = 0; r < 3; r++) e[r] = (real)x[3 * b + r] - (real)x[3 * a + r];
}
static real dot3(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }
static void cross3(const real *a, const real *b, real *o) {
    o[0] = a[1] * b[2] - a[2] * b[1], o[1] = a[2] * b[0] - a[0] * b[2],
    o[2] = a[0] * b[1] - a[1] * b[0];
}

// First fundamental form of a triangle: e·e, e·f, f·f.
static void metric(const double *x, const int *v, real *m) {
    real e[3], f[3];
    edge_of(x, v[0], v[1], e), edge_of(x, v[0], v[2], f);
    m[0] = dot3(e, e), m[1] = dot3(e, f), m[2] = dot3(f, f);
}

// tr(M M₀⁻¹) is ‖F‖², the root of the ratio of determinants is J.
static real membrane(const sheet *s, const double *x, int k) {
    double mu, la;
    real m[3], m0[3];
    tss_lame(s->def.E, s->def.nu, &mu, &la);
    metric(x, s->cell + 3 * k, m), metric(s->X, s->cell + 3 * k, m0);
    real det = m0[0] * m0[2] - m0[1] * m0[1], l = la + mu, alpha = 1 + mu / l;
    real trace = (m[0] * m0[2] - 2 * m[1] * m0[1] + m[2] * m0[0]) / det;
    real J = sqrtl((m[0] * m[2] - m[1] * m[1]) / det);
    real psi = (real)mu / 2 * trace + l / 2 * (J - alpha) * (J - alpha);
    real rest = (real)mu + l / 2 * (1 - alpha) * (1 - alpha);
    return (real)s->def.shell * sqrtl(det) / 2 * (psi - rest);
}

// The angle at the edge (a, b) between the triangles with c and d, without an orientation.
static real angle(const double *x, int a, int b, int c, int d) {
    real e[3], f[3], g[3], n[3], m[3];
    edge_of(x, a, b, e), edge_of(x, a, c, f), edge_of(x, a, d, g);
    cross3(e, f, n), cross3(g, e, m);
    real across[3];  // its length and a sign: the arc cosine would lose half of the digits
    cross3(n, m, across);
    real size = atan2l(sqrtl(dot3(across, across)), dot3(n, m));
    return dot3(n, g) > 0 ? -size : size;
}

static real total(const sheet *s, const double *x, double *hinges) {
    real P = 0, B = 0, m[3];
    for (int k = 0; k < CELLS; k++) P += membrane(s, x, k);
    for (int k = 0; k < 3 * CELLS; k++)
        for (int j = 0; j < k / 3 * 3; j++) {
            const int *v = s->cell + k / 3 * 3, *w = s->cell + j / 3 * 3;
            int a = v[k % 3], b = v[(k + 1) % 3], p = w[j % 3], q = w[(j + 1) % 3];
            if (!((a == p && b == q) || (a == q && b == p))) continue;
            real area = 0, e[3];
            metric(s->X, v, m), area += sqrtl(m[0] * m[2] - m[1] * m[1]) / 2;
            metric(s->X, w, m), area += sqrtl(m[0] * m[2] - m[1] * m[1]) / 2;
            edge_of(s->X, a, b, e);
            real turn = angle(x, a, b, v[(k + 2) % 3], w[(j + 2) % 3]) -
                        angle(s->X, a, b, v[(k + 2) % 3], w[(j + 2) % 3]);
            B += (real)s->def.bending * turn * turn * 3 * dot3(e, e) / area;
        }
    if (hinges) *hinges = (double)B;
    return P + B;
}

static void test_values(void **state) {
    (void)state;
    for (int k = 0; k < 8; k++) {
        sheet s;
        sheet_make(&s, k % 2 ? 0.05 : 0);
        double x[N], size = k < 2 ? 1e-3 : 0.1, bent;
        for (int i = 0; i < N; i++) x[i] = s.X[i] + size * rnd();
        double P = tss_elements_potential(s.e, x, NULL), Q = (double)total(&s, x, &bent);
        if (!(fabs(P - Q) < 1e-11 * Q && Q > 0 && bent > 0 && bent < Q))
            fail_msg("%d: P is %.17g, expected %.17g, hinges %g", k, P, Q, bent);
        assert_true(fabs(tss_elements_potential(s.e, s.X, NULL)) < 1e-25);
        sheet_free(&s);
    }
}

// ---- derivatives ----------------------------------------------------------------------------

typedef struct jet_args {
    const sheet *s;
    int k;
    double x[N], x1[3 * N], x2[N], C[9], beta[3], alpha, gamma;
} jet_args;

// alpha P + Σ beta_a P_a + gamma P_2.
static double seeded(const jet_args *j) {
    double P, P1[3], P2;
    assert_int_equal(tss_elements_jets(j->s->e, j->k, j->x, j->x1, j->C, j->x2, &P, P1, &P2, 0,
                                       NULL, 0, NULL, NULL, NULL),
                     TSS_OK);
    return j->alpha * P + dot(j->beta, P1, j->k) + j->gamma * P2;
}

static double slope_at(jet_args *j, double *at, const double *from, const double *d, int n,
                       double h) {
    double up, down;
    for (int i = 0; i < n; i++) at[i] = from[i] + h * d[i];
    up = seeded(j);
    for (int i = 0; i < n; i++) at[i] = from[i] - h * d[i];
    down = seeded(j);
    memcpy(at, from, (size_t)n * sizeof *at);
    return (up - down) / (2 * h);
}

static void check_slope(jet_args *j, double *at, const double *bar, int n, const char *name) {
    double d[3 * N], from[3 * N], best = INFINITY, exact;
    for (int i = 0; i < n; i++) d[i] = rnd(), from[i] = at[i];
    exact = dot(bar, d, n);
    for (double h = 1e-2; h > 1e-7; h *= 0.3)
        best = fmin(best, fabs(slope_at(j, at, from, d, n, h) - exact));
    if (!(best < 1e-8 * (1 + fabs(exact)) && best > 0))
        fail_msg("%s: slope %g is off by %g", name, exact, best);
}

static void test_jets(void **state) {
    (void)state;
    for (int trial = 0; trial < 4; trial++) {
        sheet s;
        sheet_make(&s, 0.05);
        jet_args j;
        memset(&j, 0, sizeof j);
        j.s = &s, j.k = 3;
        for (int i = 0; i < N; i++) j.x[i] = s.X[i] + 0.05 * rnd(), j.x2[i] = 0.3 * rnd();
        for (int i = 0; i < 3 * N; i++) j.x1[i] = 0.3 * rnd();
        for (int a = 0; a < 3; a++)
            for (int b = 0; b <= a; b++) j.C[3 * a + b] = j.C[3 * b + a] = rnd();
        // The gradient of P; values of the jet: P along a parabola.
        double g[N] = {0}, P, P1[3], P2, best1 = INFINITY, best2 = INFINITY;
        P = tss_elements_potential(s.e, j.x, g);
        j.alpha = 1, check_slope(&j, j.x, g, N, "gradient");
        double C1[9] = {1};
        assert_int_equal(tss_elements_jets(s.e, 3, j.x, j.x1, C1, j.x2, &P, P1, &P2, 0, NULL, 0,
                                           NULL, NULL, NULL),
                         TSS_OK);
        for (double h = 1e-2; h > 1e-5; h *= 0.5) {
            double up[N], down[N], a, b;
            for (int i = 0; i < N; i++) {
                up[i] = j.x[i] + h * j.x1[i] + h * h / 2 * j.x2[i];
                down[i] = j.x[i] - h * j.x1[i] + h * h / 2 * j.x2[i];
            }
            a = tss_elements_potential(s.e, up, NULL), b = tss_elements_potential(s.e, down, NULL);
            best1 = fmin(best1, fabs((a - b) / (2 * h) - P1[0]));
            best2 = fmin(best2, fabs((a - 2 * P + b) / (h * h) - P2));
        }
        assert_true(best1 < 1e-7 * (1 + fabs(P1[0])) && best2 < 1e-4 * (1 + fabs(P2)));
        // The adjoints of each part, and of all.
        for (int part = 0; part < 3; part++) {
            double bar[N] = {0}, bar1[3 * N] = {0}, bar2[N] = {0};
            j.alpha = part == 2 ? rnd() : 0, j.gamma = part == 0 ? 0 : rnd();
            for (int a = 0; a < 3; a++) j.beta[a] = part == 1 ? 0 : rnd();
            assert_int_equal(tss_elements_jets(s.e, 3, j.x, j.x1, j.C, j.x2, NULL, NULL, NULL,
                                               j.alpha, j.beta, j.gamma, bar, bar1, bar2),
                             TSS_OK);
            check_slope(&j, j.x, bar, N, "x");
            check_slope(&j, j.x1, bar1, 3 * N, "x1");
            if (part) check_slope(&j, j.x2, bar2, N, "x2");
        }
        sheet_free(&s);
    }
}

// The plain gradient: of each stencil the bits of the hyper-dual one, of the sum against differences
// of `total`, also where nodes coincide and a hinge is folded.
static void test_plain(void **state) {
    (void)state;
    for (int trial = 0; trial < 12; trial++) {
        sheet s;
        double x[N], g[N] = {0}, h[N] = {0}, P = 0, most = 0;
        sheet_make(&s, 0.05);
        double size = trial < 4 ? 1e-3 : trial < 8 ? 0.05 : 0.5;
        for (int i = 0; i < N; i++) x[i] = s.X[i] + size * rnd();
        if (trial == 11) memcpy(x + 3, x, 3 * sizeof *x), x[N - 1] = x[N - 4] = 0.3;
        for (int k = 0; k < s.e->cells + s.e->hinges; k++) {
            double at[12], plain[12];
            tss__hd dual[12];
            int count;
            const int *v = tss__shell_nodes(s.e, s.e->cell, s.e->hinge, k, &count);
            tss__shell_gather(x, v, count, at);
            double a = tss__plain_stencil(s.e, k, at, plain);
            double b = tss__shell_stencil(s.e, k, at, NULL, NULL, dual);
            P += a;
            assert_true(a == b && isfinite(a));
            for (int i = 0; i < 3 * count; i++) {
                assert_true(plain[i] == dual[i].v && isfinite(plain[i]));
                h[3 * v[i / 3] + i % 3] += plain[i];
            }
        }
        double Q = tss_elements_potential(s.e, x, g);
        assert_true(fabs(P - Q) < 1e-13 * P && distance(g, h, N) == 0);
        double size_g = sqrt(dot(g, g, N));
        for (int i = 0; trial < 11 && i < N; i++) {
            double best = INFINITY;
            for (double d = 1e-3; d > 1e-7; d *= 0.3) {
                double y[N], up, down;
                memcpy(y, x, sizeof y);
                y[i] = x[i] + d, up = (double)total(&s, y, NULL), d = y[i] - x[i];
                y[i] = x[i] - d, down = (double)total(&s, y, NULL);
                best = fmin(best, fabs((up - down) / (2 * d) - g[i]));
            }
            most = fmax(most, best);
        }
        if (trial < 11 && !(most > 0 && most < 2e-7 * size_g))
            fail_msg("trial %d: off by %g of %g", trial, most, size_g);
        sheet_free(&s);
    }
}

static tss_net *decoder_of(const sheet *s, int r) {
    tss_net_def d = tss_net_def_default();
    int width[3] = {r, 6, 5};
    double B[N * 5];
    for (int i = 0; i < N * 5; i++) B[i] = 0.1 * rnd();
    d.layers = 2, d.width = width, d.activation = TSS_SILU, d.outputs = N, d.out_base = s->X,
    d.out_matrix = B;
    tss_net *n;
    assert_int_equal(tss_net_create(NULL, &d, &n), TSS_OK);
    return n;
}

// A subset through a decoder: the Hessian against differences of the gradient and against
// polarised jets; the reduced solver sees the same energy.
static void test_decoder(void **state) {
    (void)state;
    enum { R = 3 };
    for (int kind = 0; kind < 2; kind++) {
        sheet s;
        int subset[3] = {2, 3, 17};
        double weight[3] = {2, 3, 1.5}, z[R], g[R], H[R * R], up[R], down[R], x[N], E;
        sheet_def(&s, 0.05);
        if (kind) s.def.subset = subset, s.def.count = 3, s.def.weight = weight;
        assert_int_equal(tss_elements_create(NULL, &s.def, &s.e), TSS_OK);
        assert_int_equal(tss_work_create(NULL, &s.work), TSS_OK);
        tss_net *n = decoder_of(&s, R);
        for (int a = 0; a < R; a++) z[a] = rnd();
        assert_int_equal(tss_reduced_potential(n, s.e, s.work, 1, z, &E, g, H), TSS_OK);
        tss_net_forward(n, s.work, 1, z, x);
        assert_true(fabs(tss_elements_potential(s.e, x, NULL) - E) < 1e-13 * E);
        for (int a = 0; a < R; a++) {
            double keep = z[a], best = INFINITY;
            for (double h = 1e-2; h > 1e-6; h *= 0.2) {
                double gap = 0;
                z[a] = keep + h, tss_reduced_potential(n, s.e, s.work, 1, z, NULL, up, NULL);
                z[a] = keep - h, tss_reduced_potential(n, s.e, s.work, 1, z, NULL, down, NULL);
                z[a] = keep;
                for (int b = 0; b < R; b++) gap += fabs((up[b] - down[b]) / (2 * h) - H[a * R + b]);
                best = fmin(best, gap);
            }
            assert_true(best < 1e-8);
            for (int b = 0; b < R; b++) {
                double u[R] = {0}, v[R] = {0}, uv;
                u[a] = 1, v[b] = 1;
                tss_reduced_second(n, s.e, s.work, 1, z, u, v, &uv);
                assert_true(fabs(uv - H[a * R + b]) < 1e-11);
            }
        }
        tss_reduced_def d = tss_reduced_def_default();
        tss_reduced *sim;
        double g2[R], H2[R * R];
        d.decoder = n, d.elements = s.e, d.h = 0, d.solver = TSS_PROJECTED_NEWTON;
        assert_int_equal(tss_reduced_create(NULL, &d, &sim), TSS_OK);
        tss__reduced_prepare(sim);
        assert_true(fabs(tss__reduced_energy(sim, z, g2, NULL) - E) < 1e-12 * E);
        assert_true(distance(g, g2, R) < 1e-12);
        tss__reduced_energy(sim, z, g2, H2);
        assert_true(distance(H, H2, R * R) < 1e-11);
        tss_reduced_destroy(sim), tss_net_destroy(n), sheet_free(&s);
    }
}

// ---- mechanics ------------------------------------------------------------------------------

static void rotation(double *Q) {  // of a random quaternion
    double q[4] = {rnd(), rnd(), rnd(), rnd()}, l = dot(q, q, 4);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            static const int sign[3][3] = {{0, -1, 1}, {1, 0, -1}, {-1, 1, 0}};
            double even = i == j ? q[0] * q[0] - dot(q + 1, q + 1, 3) : 0;
            double odd = i == j ? 0 : sign[i][j] * q[0] * q[1 + (3 - i - j)];
            Q[3 * i + j] = (even + 2 * (q[1 + i] * q[1 + j] + odd)) / l;
        }
}

static void test_rigid(void **state) {
    (void)state;
    for (int trial = 0; trial < 5; trial++) {
        sheet s;
        sheet_make(&s, 0.05);
        double x[N], y[N], Q[9], g[N] = {0}, h[N] = {0}, turned[N], force[3] = {0}, torque[3] = {0};
        double c[3] = {rnd(), rnd(), rnd()}, size = 0;
        rotation(Q);
        for (int i = 0; i < N; i++) x[i] = s.X[i] + 0.05 * rnd();
        for (int i = 0; i < NODES; i++)
            for (int r = 0; r < 3; r++) y[3 * i + r] = c[r] + dot(Q + 3 * r, x + 3 * i, 3);
        double P = tss_elements_potential(s.e, x, g), P2 = tss_elements_potential(s.e, y, h);
        for (int i = 0; i < NODES; i++)
            for (int r = 0; r < 3; r++) {
                int p = 3 * i + (r + 1) % 3, q = 3 * i + (r + 2) % 3;
                turned[3 * i + r] = dot(Q + 3 * r, g + 3 * i, 3), force[r] += g[3 * i + r];
                torque[r] += x[p] * g[q] - x[q] * g[p], size = fmax(size, fabs(g[3 * i + r]));
            }
        assert_true(fabs(P - P2) < 1e-12 * P && distance(turned, h, N) < 1e-12 * size);
        for (int r = 0; r < 3; r++)
            assert_true(fabs(force[r]) < 1e-13 * size && fabs(torque[r]) < 1e-13 * size);
        // The rest state, turned: no energy, no force.
        for (int i = 0; i < NODES; i++)
            for (int r = 0; r < 3; r++) y[3 * i + r] = c[r] + dot(Q + 3 * r, s.X + 3 * i, 3);
        memset(h, 0, sizeof h);
        assert_true(tss_elements_potential(s.e, y, h) < 1e-24);
        for (int i = 0; i < N; i++) assert_true(fabs(h[i]) < 1e-12);
        sheet_free(&s);
    }
}

// Rolled up along the lines of the grid by phi a line: no stretch, W = Σ k φ² 3 L² / (W L).
static void test_cylinder(void **state) {
    (void)state;
    for (double phi = -1.2; phi < 1.3; phi += 0.3) {
        sheet s;
        sheet_make(&s, 0);
        double x[N], at[2] = {0, 0}, turn = 0, line[NX + 1][2] = {{0}};
        for (int i = 0; i < NX; i++) {
            at[0] += WIDE * cos(turn), at[1] += WIDE * sin(turn), turn += phi;
            line[i + 1][0] = at[0], line[i + 1][1] = at[1];
        }
        for (int i = 0; i < NODES; i++) {
            x[3 * i] = line[i % (NX + 1)][0], x[3 * i + 1] = s.X[3 * i + 1];
            x[3 * i + 2] = line[i % (NX + 1)][1];
        }
        double exact = (NX - 1) * NY * 0.03 * phi * phi * 3 * LONG / WIDE;
        assert_true(fabs(tss_elements_potential(s.e, x, NULL) - exact) < 1e-13 * (1 + exact));
        // As a rest shape it has no energy, and flat has as much.
        sheet r = s;
        r.def.X = x;
        assert_int_equal(tss_elements_create(NULL, &r.def, &r.e), TSS_OK);
        assert_true(tss_elements_potential(r.e, x, NULL) < 1e-25);
        assert_true(fabs(tss_elements_potential(r.e, s.X, NULL) - exact) < 1e-13 * (1 + exact));
        tss_elements_destroy(r.e), sheet_free(&s);
    }
}

// Stretched by a and b in its plane: thickness · area · Ψ(diag(a, b)).
static void test_stretch(void **state) {
    (void)state;
    sheet s;
    double mu, la, x[N];
    sheet_make(&s, 0);
    tss_lame(40, 0.3, &mu, &la);
    for (double a = 0.5; a < 2; a += 0.25)
        for (double b = 0.5; b < 2; b += 0.25) {
            for (int i = 0; i < NODES; i++) {
                double X = a * s.X[3 * i], Y = b * s.X[3 * i + 1];
                x[3 * i] = 0.6 * X, x[3 * i + 1] = Y, x[3 * i + 2] = 0.8 * X;
            }
            double l = la + mu, j = a * b - 1 - mu / l;
            double psi = mu / 2 * (a * a + b * b - 2) + l / 2 * (j * j - mu * mu / (l * l));
            double exact = 0.02 * NX * WIDE * NY * LONG * psi;
            assert_true(fabs(tss_elements_potential(s.e, x, NULL) - exact) < 1e-13);
        }
    // All in one point, and folded over: finite.
    double g[N] = {0};
    memset(x, 0, sizeof x);
    assert_true(isfinite(tss_elements_potential(s.e, x, g)) && isfinite(dot(g, g, N)));
    for (int i = 0; i < NODES; i++)
        x[3 * i] = fabs(s.X[3 * i] - 2 * WIDE), x[3 * i + 1] = s.X[3 * i + 1];
    assert_true(isfinite(tss_elements_potential(s.e, x, g)) && isfinite(dot(g, g, N)));
    sheet_free(&s);
}

// ---- subsets --------------------------------------------------------------------------------

// One cell at a time adds up to the whole; the selection among all cells finds weights that are
// exact, and what it reports holds for elements made of them.
static void test_subsets(void **state) {
    (void)state;
    enum { R = 3, SAMPLES = 6 };
    sheet s;
    sheet_make(&s, 0.05);
    double x[N], g[N] = {0}, h[N] = {0}, P, Q = 0, z[SAMPLES * R], a[R], b[R];
    for (int i = 0; i < N; i++) x[i] = s.X[i] + 0.05 * rnd();
    P = tss_elements_potential(s.e, x, g);
    for (int k = 0; k < CELLS; k++) {
        tss_elements_def d = s.def;
        tss_elements *one;
        d.subset = &k, d.count = 1;
        assert_int_equal(tss_elements_create(NULL, &d, &one), TSS_OK);
        Q += tss_elements_potential(one, x, h);
        tss_elements_destroy(one);
    }
    assert_true(fabs(P - Q) < 1e-13 * P && distance(g, h, N) < 1e-13);
    tss_net *n = decoder_of(&s, R);
    for (int i = 0; i < SAMPLES * R; i++) z[i] = rnd();
    for (int most = 5; most <= CELLS; most += CELLS - 5) {
        int subset[CELLS], count;
        double weight[CELLS], error, gap = 0;
        tss_cubature_def c = tss_cubature_def_default();
        c.count = most;
        assert_int_equal(
            tss_cubature_select(n, s.e, s.work, &c, SAMPLES, z, subset, weight, &count, &error),
            TSS_OK);
        tss_elements_def d = s.def;
        tss_elements *few;
        d.subset = subset, d.count = count, d.weight = weight;
        assert_int_equal(tss_elements_create(NULL, &d, &few), TSS_OK);
        for (int t = 0; t < SAMPLES; t++) {
            tss_reduced_potential(n, s.e, s.work, 1, z + R * t, NULL, a, NULL);
            tss_reduced_potential(n, few, s.work, 1, z + R * t, NULL, b, NULL);
            gap += pow(distance(a, b, R), 2) / dot(a, a, R) / SAMPLES;
        }
        print_message("shell, %d of %d cells: error %.2e, by elements %.2e\n", count, CELLS, error,
                      sqrt(gap));
        assert_true(fabs(sqrt(gap) - error) < 1e-9 && error < (most == CELLS ? 1e-5 : 1));
        tss_elements_destroy(few);
    }
    tss_net_destroy(n), sheet_free(&s);
}

static char logged[256];
static int allowance;
static size_t held;
static void keep_log(tss_log_level level, const char *text, void *ctx) {
    (void)level, (void)ctx;
    snprintf(logged, sizeof logged, "%s", text);
}
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

static void test_refusals(void **state) {
    (void)state;
    sheet s;
    sheet_def(&s, 0);
    tss_host h = tss_host_default();
    tss_elements *e;
    tss_elements_def d = s.def;
    h.alloc = stingy_alloc, h.free = stingy_free, h.log = keep_log, allowance = 100;
    int book[9] = {0, 1, 5, 1, 0, 6, 0, 1, 7}, flat[3] = {0, 1, 2};
#define REFUSED(change, result, word)                          \
    d = s.def, change;                                         \
    assert_int_equal(tss_elements_create(&h, &d, &e), result); \
    assert_null(e), assert_int_equal(held, 0);                 \
    assert_non_null(strstr(logged, word)), logged[0] = 0
    REFUSED(d.shell = -1, TSS_ERROR_BAD_MATERIAL, "shell");
    REFUSED(d.bending = NAN, TSS_ERROR_BAD_MATERIAL, "bending");
    REFUSED(d.dim = 2, TSS_ERROR_BAD_ARGUMENT, "in space");
    REFUSED(d.shell = 0, TSS_ERROR_BAD_ARGUMENT, "needs a shell");
    REFUSED((d.cells = 3, d.cell = book), TSS_ERROR_BAD_MESH, "more than two");
    REFUSED((d.cells = 1, d.cell = flat), TSS_ERROR_BAD_MESH, "flat");
    REFUSED((d.cells = 1, d.cell = flat, d.bending = 0), TSS_ERROR_BAD_MESH, "flat");
    int done = 0;
    for (int limit = 0; !done && limit < 20; limit++) {
        allowance = limit;
        done = tss_elements_create(&h, &s.def, &e) == TSS_OK;
        assert_true(done ? limit == 5 : e == NULL && held == 0);
    }
    assert_true(done);
    tss_elements_destroy(e);
    assert_int_equal(held, 0);
}

static int setup(void **state) {
    (void)state;
    rng = tss_rng_seed(9);
    return 0;
}

int main(void) {
#define T(f) cmocka_unit_test_setup(f, setup)
    const struct CMUnitTest tests[] = {
        T(test_values),  T(test_jets),     T(test_plain),   T(test_decoder),  T(test_rigid),
        T(test_cylinder), T(test_stretch), T(test_subsets), T(test_refusals),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
