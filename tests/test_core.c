// The core against closed forms and invariants: free fall, momentum, patch test, convergence of
// elements and integrators, static compression, determinism, checkpoints, bad input.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"

// ---- scenes -----------------------------------------------------------------------------------

typedef struct grid {
    int dim, nodes, cells;
    double *X;
    int *cell;
} grid;

static int grid_id(const int *n, int i, int j, int k) { return (k * (n[1] + 1) + j) * (n[0] + 1) + i; }

// A box of n[0] × n[1] × n[2] cubes of six tets (2D: squares of two triangles), sides L.
static grid grid_make(int dim, const int *n, const double *L) {
    static const int kuhn[6][4] = {{0, 1, 2, 6}, {0, 2, 3, 6}, {0, 3, 7, 6},
                                   {0, 7, 4, 6}, {0, 4, 5, 6}, {0, 5, 1, 6}};
    static const int pair[2][3] = {{0, 1, 2}, {0, 2, 3}};
    static const int corner[8][3] = {{0, 0, 0}, {1, 0, 0}, {1, 1, 0}, {0, 1, 0},
                                     {0, 0, 1}, {1, 0, 1}, {1, 1, 1}, {0, 1, 1}};
    grid g;
    int m[3] = {n[0], n[1], dim == 3 ? n[2] : 0}, per = dim == 3 ? 6 : 2;
    g.dim = dim;
    g.nodes = (m[0] + 1) * (m[1] + 1) * (m[2] + 1);
    g.cells = per * m[0] * m[1] * (dim == 3 ? m[2] : 1);
    g.X = (double *)malloc((size_t)(g.nodes * dim) * sizeof(double));
    g.cell = (int *)malloc((size_t)(g.cells * (dim + 1)) * sizeof(int));
    assert_true(g.X && g.cell);
    int c = 0;
    for (int k = 0; k <= m[2]; k++)
        for (int j = 0; j <= m[1]; j++)
            for (int i = 0; i <= m[0]; i++) {
                double *p = g.X + grid_id(m, i, j, k) * dim;
                p[0] = L[0] * i / m[0], p[1] = L[1] * j / m[1];
                if (dim == 3) p[2] = L[2] * k / m[2];
                if (i == m[0] || j == m[1] || (dim == 3 && k == m[2])) continue;
                for (int t = 0; t < per; t++)
                    for (int a = 0; a <= dim; a++) {
                        const int *v = corner[dim == 3 ? kuhn[t][a] : pair[t][a]];
                        g.cell[c++] = grid_id(m, i + v[0], j + v[1], k + v[2]);
                    }
            }
    return g;
}

static void grid_free(grid *g) { free(g->X), free(g->cell); }

static tss_body_def grid_body(const grid *g) {
    tss_body_def d = tss_body_def_default();
    d.nodes = g->nodes, d.X = g->X, d.cells = g->cells, d.cell = g->cell;
    return d;
}

static tss_world *make_world(tss_world_def d) {
    tss_world *w = NULL;
    assert_int_equal(tss_world_create(&d, &w), TSS_OK);
    return w;
}

static tss_body add_body(tss_world *w, const tss_body_def *d) {
    tss_body b = -1;
    tss_result r = tss_body_add(w, d, &b);
    if (r != TSS_OK) print_error("%s\n", tss_world_error(w));
    assert_int_equal(r, TSS_OK);
    return b;
}

static tss_step_info step(tss_world *w) {
    tss_step_info info;
    tss_result r = tss_world_step(w, &info);
    if (r != TSS_OK) print_error("%s\n", tss_world_error(w));
    assert_int_equal(r, TSS_OK);
    if (info.status != TSS_STEP_CONVERGED) print_error("%s: %s\n", tss_status_text(info.status), info.message);
    assert_int_equal(info.status, TSS_STEP_CONVERGED);
    return info;
}

static void near(double a, double b, double tol) {
    if (!(fabs(a - b) <= tol)) print_error("%.17g is not within %.3g of %.17g\n", a, tol, b);
    assert_true(fabs(a - b) <= tol);
}

// ---- dynamics ---------------------------------------------------------------------------------

// Free fall: BDF2 and Newmark are exact for constant acceleration once started; implicit Euler has
// the closed form y = −g h² n(n+1)/2.
static void test_free_fall(void **state) {
    (void)state;
    int n[3] = {2, 2, 2};
    double L[3] = {1, 1, 1};
    grid g = grid_make(3, n, L);
    for (int in = TSS_BDF2; in <= TSS_NEWMARK; in++) {
        tss_world_def d = tss_world_def_default();
        d.integrator = (tss_integrator)in, d.dt = 0.01, d.tol = 1e-9;
        tss_world *w = make_world(d);
        tss_body_def b = grid_body(&g);
        add_body(w, &b);
        double y = 0, v = 0, yp = 0, vp = 0, h = d.dt, a = -9.80665;
        for (int s = 0; s < 20; s++) {
            step(w);
            double v1 = in == TSS_BDF2 && s > 0 ? (4 * v - vp + 2 * h * a) / 3 : v + h * a;
            double y1 = in == TSS_BDF2 && s > 0 ? (4 * y - yp + 2 * h * v1) / 3
                        : in == TSS_NEWMARK    ? y + h * v + h * h / 2 * a
                                               : y + h * v1;
            yp = y, vp = v, y = y1, v = v1;
        }
        for (int i = 0; i < g.nodes; i++) {
            near(tss_world_positions(w)[3 * i + 1], g.X[3 * i + 1] + y, 1e-12);
            near(tss_world_velocities(w)[3 * i + 1], v, 1e-9);
        }
        tss_world_destroy(w);
    }
    grid_free(&g);
}

// A free spinning, wobbling body keeps its momenta: linear to rounding, angular to the tolerance of
// the solve times the integrator's own error (implicit Euler and BDF2 damp; Newmark hardly does).
static void test_momentum(void **state) {
    (void)state;
    int n[3] = {3, 2, 2};
    double L[3] = {1, 0.5, 0.5};
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.gravity[1] = 0, d.dt = 1e-3, d.tol = 1e-10, d.integrator = TSS_NEWMARK;
    tss_world *w = make_world(d);
    tss_body_def b = grid_body(&g);
    double *v0 = (double *)malloc((size_t)(3 * g.nodes) * sizeof(double));
    for (int i = 0; i < g.nodes; i++) {  // spin about z, drift, and a stretching motion
        v0[3 * i] = -3 * g.X[3 * i + 1] + 0.3 + 0.5 * g.X[3 * i];
        v0[3 * i + 1] = 3 * g.X[3 * i], v0[3 * i + 2] = 0.1;
    }
    b.v0 = v0;
    add_body(w, &b);
    double P[2][3], A[2][3];
    for (int when = 0; when < 2; when++) {
        for (int c = 0; c < 3; c++) P[when][c] = A[when][c] = 0;
        const double *x = tss_world_positions(w), *v = tss_world_velocities(w), *m = tss_world_masses(w);
        for (int i = 0; i < g.nodes; i++)
            for (int c = 0; c < 3; c++) {
                int e = (c + 1) % 3, f = (c + 2) % 3;
                P[when][c] += m[i] * v[3 * i + c];
                A[when][c] += m[i] * (x[3 * i + e] * v[3 * i + f] - x[3 * i + f] * v[3 * i + e]);
            }
        for (int s = 0; when == 0 && s < 100; s++) step(w);
    }
    for (int c = 0; c < 3; c++) {
        near(P[1][c], P[0][c], 1e-8 * 250);
        near(A[1][c], A[0][c], 2e-4 * fabs(A[0][2]));  // O(h²) per unit of time
    }
    tss_world_destroy(w);
    free(v0);
    grid_free(&g);
}

// Position error of a vibrating bar against a run with a 16 times shorter step.
static double vibration(tss_integrator in, double h, double until) {
    int n[3] = {2, 1, 1};
    double L[3] = {1, 0.4, 0.4};
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.integrator = in, d.dt = h, d.tol = 1e-11, d.gravity[1] = 0, d.linear = TSS_LINEAR_DIRECT;
    tss_world *w = make_world(d);
    tss_body_def b = grid_body(&g);
    double *x0 = (double *)malloc((size_t)(3 * g.nodes) * sizeof(double));
    for (int k = 0; k < 3 * g.nodes; k++) x0[k] = g.X[k] * (k % 3 == 0 ? 1.05 : 1);
    b.x0 = x0, b.material.E = 2e3, b.material.nu = 0.3;
    add_body(w, &b);
    for (int s = 0; s < (int)(until / h + 0.5); s++) step(w);
    double x = tss_world_positions(w)[3 * (g.nodes - 1)];
    tss_world_destroy(w);
    free(x0);
    grid_free(&g);
    return x;
}

static void test_order(void **state) {
    (void)state;
    double until = 0.064, ref = vibration(TSS_NEWMARK, 6.25e-5, until);
    struct { tss_integrator in; double low, high; } kind[3] = {
        {TSS_IMPLICIT_EULER, 0.8, 1.2}, {TSS_BDF2, 1.8, 2.2}, {TSS_NEWMARK, 1.8, 2.2}};
    for (int k = 0; k < 3; k++) {
        double h = kind[k].in == TSS_IMPLICIT_EULER ? 5e-4 : 2e-3;
        double e1 = fabs(vibration(kind[k].in, h, until) - ref), e2 = fabs(vibration(kind[k].in, h / 2, until) - ref);
        double order = log2(e1 / e2);
        print_message("integrator %d: errors %.3g %.3g, order %.2f\n", (int)kind[k].in, e1, e2, order);
        assert_true(order > kind[k].low && order < kind[k].high);
    }
}

// ---- statics ----------------------------------------------------------------------------------

// Patch test: affine motion of the boundary of an irregular mesh; the inside follows it exactly.
static void test_patch(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        int n[3] = {3, 3, 3};
        double L[3] = {1, 1, 1};
        static const double F[9] = {1.1, 0.2, -0.05, 0.03, 0.95, 0.1, 0, -0.1, 1.05};
        grid g = grid_make(dim, n, L);
        for (int i = 0; i < g.nodes; i++)  // push the inner nodes off the lattice
            for (int c = 0; c < dim; c++) {
                int inside = 1;
                for (int a = 0; a < dim; a++)
                    inside &= g.X[i * dim + a] > 1e-9 && g.X[i * dim + a] < 1 - 1e-9;
                if (inside) g.X[i * dim + c] += 0.05 * sin(12.0 * i + 5 * c);
            }
        tss_world_def d = tss_world_def_default();
        d.dim = dim, d.integrator = TSS_QUASISTATIC, d.tol = 1e-8, d.gravity[1] = 0;
        tss_world *w = make_world(d);
        tss_body_def b = grid_body(&g);
        add_body(w, &b);
        for (int i = 0; i < g.nodes; i++) {
            double t[3] = {0, 0, 0};
            int edge = 0;
            for (int r = 0; r < dim; r++) {
                edge |= g.X[i * dim + r] < 1e-9 || g.X[i * dim + r] > 1 - 1e-9;
                for (int c = 0; c < dim; c++) t[r] += F[r * 3 + c] * g.X[i * dim + c];
            }
            if (edge) assert_int_equal(tss_node_target(w, i, t), TSS_OK);
        }
        step(w);
        step(w);
        for (int i = 0; i < g.nodes; i++)
            for (int r = 0; r < dim; r++) {
                double t = 0;
                for (int c = 0; c < dim; c++) t += F[r * 3 + c] * g.X[i * dim + c];
                near(tss_world_positions(w)[i * dim + r], t, 1e-9);
            }
        tss_world_destroy(w);
        grid_free(&g);
    }
}

// A bar on rollers pressed to 80 %: homogeneous deformation; lateral stretch and stress solve two
// scalar equations of the Neo-Hookean law, found here by bisection.
static void test_compression(void **state) {
    (void)state;
    int n[3] = {3, 2, 2};
    double L[3] = {2, 1, 1}, E = 1e5, nu = 0.3, s1 = 0.8, mu, la;
    tss_lame(E, nu, &mu, &la);
    double lo = 0.9, hi = 1.3;
    for (int k = 0; k < 100; k++) {  // dpsi/ds2 = mu (s2 − 1/s2) + la ln(J)/s2 = 0
        double s2 = 0.5 * (lo + hi), f = mu * (s2 - 1 / s2) + la * log(s1 * s2 * s2) / s2;
        if (f > 0) hi = s2; else lo = s2;
    }
    double P = mu * (s1 - 1 / s1) + la * log(s1 * lo * lo) / s1;  // nominal stress
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.integrator = TSS_QUASISTATIC, d.tol = 1e-8, d.gravity[1] = 0;
    tss_world *w = make_world(d);
    tss_body_def b = grid_body(&g);
    b.material.E = E, b.material.nu = nu;
    add_body(w, &b);
    for (int i = 0; i < g.nodes; i++) {
        const double *X = g.X + 3 * i;
        assert_int_equal(tss_node_pin(w, i, (X[0] == 0 ? 1u : 0) | (X[1] == 0 ? 2u : 0) | (X[2] == 0 ? 4u : 0)), TSS_OK);
        double f[3] = {0, 0, 0};  // the force of the nominal stress on the end face, lumped by area
        if (X[0] != L[0]) continue;
        int tris = 0;
        for (int c = 0; c < g.cells; c++) {
            int on = 0, me = 0;
            for (int a = 0; a < 4; a++) on += g.X[3 * g.cell[4 * c + a]] == L[0], me |= g.cell[4 * c + a] == i;
            tris += on == 3 && me;
        }
        f[0] = P * tris * (1.0 / (n[1] * n[2])) / 2 / 3;
        assert_int_equal(tss_node_force(w, i, f), TSS_OK);
    }
    step(w);
    for (int i = 0; i < g.nodes; i++) {
        near(tss_world_positions(w)[3 * i], s1 * g.X[3 * i], 1e-6);
        near(tss_world_positions(w)[3 * i + 1], lo * g.X[3 * i + 1], 1e-6);
    }
    tss_world_destroy(w);
    grid_free(&g);
}

// Tip deflection of a cantilever under its own weight against Euler–Bernoulli: linear tets are too
// stiff and approach from below, the error falling with refinement.
static void test_cantilever(void **state) {
    (void)state;
    double L[3] = {1, 0.1, 0.1}, E = 1e7, rho = 1000, g0 = 0.05, last = 0;
    double exact = rho * g0 * 0.01 * 1 / (8 * E * (0.1 * 0.1 * 0.1 * 0.1 / 12));
    for (int k = 1; k <= 4; k *= 2) {
        int n[3] = {20 * k, 2 * k, 2 * k};
        grid g = grid_make(3, n, L);
        tss_world_def d = tss_world_def_default();
        d.integrator = TSS_QUASISTATIC, d.tol = 1e-9, d.gravity[1] = -g0;
        tss_world *w = make_world(d);
        tss_body_def b = grid_body(&g);
        b.material.E = E, b.material.nu = 0.0, b.material.rho = rho;
        add_body(w, &b);
        for (int i = 0; i < g.nodes; i++)
            if (g.X[3 * i] == 0) tss_node_pin(w, i, 7);
        step(w);
        int tip = g.nodes - 1;
        double y = g.X[3 * tip + 1] - tss_world_positions(w)[3 * tip + 1];
        print_message("cantilever %2d cells along: %.4f of Euler-Bernoulli\n", n[0], y / exact);
        assert_true(y > last && y < 1.02 * exact);
        last = y;
        tss_world_destroy(w);
        grid_free(&g);
    }
    near(last / exact, 1, 0.10);
}

// ---- shells -----------------------------------------------------------------------------------

// A cloth of membrane and hinge energies, hung by two corners: derivatives agree with differences,
// it sags below its corners and keeps its area within a few per cent.
static void test_cloth(void **state) {
    (void)state;
    enum { N = 6, NODES = (N + 1) * (N + 1) };
    double X[3 * NODES];
    int tri[6 * N * N], t = 0;
    for (int i = 0; i < NODES; i++) X[3 * i] = i % (N + 1) / (double)N, X[3 * i + 1] = 0, X[3 * i + 2] = i / (N + 1) / (double)N;
    for (int j = 0; j < N; j++)
        for (int i = 0; i < N; i++) {
            int a = j * (N + 1) + i, q[6] = {a, a + N + 1, a + 1, a + 1, a + N + 1, a + N + 2};
            for (int k = 0; k < 6; k++) tri[t++] = q[k];
        }
    tss_world *w = make_world(tss_world_def_default());
    tss_body_def b = tss_body_def_default();
    b.nodes = NODES, b.X = X, b.triangles = t / 3, b.triangle = tri, b.thickness = 1e-3, b.material.rho = 300;
    int pins[2] = {0, N};
    b.pins = 2, b.pin = pins;
    add_body(w, &b);
    tss_membrane_def md = tss_membrane_def_default();
    md.triangles = t / 3, md.node = tri, md.X = X, md.thickness = 1e-3, md.material.E = 1e6;
    tss_energy_def e;
    tss_energy membrane, hinge;
    assert_int_equal(tss_membrane_energy(tss_world_host(w), &md, &e), TSS_OK);
    assert_int_equal(tss_energy_add(w, &e, &membrane), TSS_OK);
    tss_hinge_def hd = tss_hinge_def_default();
    int hinges[4 * 6 * N * N], m = 0;
    for (int i = 0; i < t; i++)  // edge a → b of one triangle that is b → a of another
        for (int j = 0; j < t; j++) {
            int a = tri[i], b2 = tri[i / 3 * 3 + (i + 1) % 3];
            if (a > b2 || tri[j] != b2 || tri[j / 3 * 3 + (j + 1) % 3] != a) continue;
            hinges[m++] = a, hinges[m++] = b2;
            hinges[m++] = tri[i / 3 * 3 + (i + 2) % 3], hinges[m++] = tri[j / 3 * 3 + (j + 2) % 3];
        }
    hd.hinges = m / 4, hd.node = hinges, hd.X = X;
    assert_int_equal(tss_hinge_energy(tss_world_host(w), &hd, &e), TSS_OK);
    assert_int_equal(tss_energy_add(w, &e, &hinge), TSS_OK);
    for (int s = 0; s < 40; s++) step(w);
    const double *x = tss_world_positions(w);
    double area = 0, lowest = 0;
    for (int k = 0; k < t / 3; k++) area += tss__triangle_area(x + 3 * tri[3 * k], x + 3 * tri[3 * k + 1], x + 3 * tri[3 * k + 2]);
    for (int i = 0; i < NODES; i++) lowest = fmin(lowest, x[3 * i + 1]);
    assert_true(lowest < -0.3 && lowest > -1.5);
    near(area, 1, 0.05);
    tss_energy_report r;
    assert_int_equal(tss_energy_check(w, membrane, &r), TSS_OK);
    assert_true(r.gradient_error < 1e-5 && r.gradient_error > 0 && r.psd_min > -1e-9);
    assert_int_equal(tss_energy_check(w, hinge, &r), TSS_OK);
    assert_true(r.gradient_error < 1e-4 && r.psd_min > -1e-9);
    tss_world_destroy(w);
}

// ---- kinematic nodes --------------------------------------------------------------------------

// Ends turned against each other by 144° in one step: targets met exactly, nothing inverted.
static void test_twist(void **state) {
    (void)state;
    int n[3] = {8, 2, 2};
    double L[3] = {1, 0.2, 0.2};
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.dt = 2, d.gravity[1] = 0, d.integrator = TSS_IMPLICIT_EULER;
    tss_world *w = make_world(d);
    tss_body_def b = grid_body(&g);
    add_body(w, &b);
    for (int i = 0; i < g.nodes; i++) {
        double *X = g.X + 3 * i, side = X[0] == 0 ? -1 : X[0] == 1 ? 1 : 0, a = side * 0.8 * 3.14159265358979;
        double t[3] = {X[0], 0.1 + cos(a) * (X[1] - 0.1) - sin(a) * (X[2] - 0.1),
                       0.1 + sin(a) * (X[1] - 0.1) + cos(a) * (X[2] - 0.1)};
        if (side != 0) assert_int_equal(tss_node_target(w, i, t), TSS_OK);
    }
    tss_step_info info = step(w);
    assert_true(info.target_left == 0);
    assert_true(info.min_J > 0);
    print_message("twist by 2 x 144 degrees: %d iterates, min J %.3f\n", info.newton, info.min_J);
    tss_world_destroy(w);
    grid_free(&g);
}

// ---- state ------------------------------------------------------------------------------------

static void reversed(int blocks, tss_task *task, void *arg, void *ctx) {
    int workers = *(int *)ctx;
    for (int b = blocks - 1; b >= 0; b--) task(b, b % workers, arg);
}

static uint64_t run_hash(int workers, int own_tasks, tss_linear linear) {
    int n[3] = {8, 4, 4};
    double L[3] = {1, 0.5, 0.5};
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.host.workers = workers, d.linear = linear;
    if (own_tasks) d.host.parallel_for = reversed, d.host.parallel_ctx = &workers;
    tss_world *w = make_world(d);
    tss_body_def b = grid_body(&g);
    add_body(w, &b);
    for (int i = 0; i < g.nodes; i++)
        if (g.X[3 * i] == 0) tss_node_pin(w, i, 7);
    for (int s = 0; s < 5; s++) step(w);
    uint64_t h = tss_world_hash(w);
    tss_world_destroy(w);
    grid_free(&g);
    return h;
}

static void test_same_bits(void **state) {
    (void)state;
    for (int linear = TSS_LINEAR_AUTO; linear <= TSS_LINEAR_PCG; linear++) {
        uint64_t h = run_hash(1, 0, (tss_linear)linear);
        assert_true(h == run_hash(2, 0, (tss_linear)linear));
        assert_true(h == run_hash(3, 0, (tss_linear)linear));
        assert_true(h == run_hash(3, 1, (tss_linear)linear));
    }
}

static void test_checkpoint(void **state) {
    (void)state;
    int n[3] = {4, 2, 2};
    double L[3] = {1, 0.5, 0.5};
    grid g = grid_make(3, n, L);
    tss_world *w[2];
    for (int k = 0; k < 2; k++) {
        w[k] = make_world(tss_world_def_default());
        tss_body_def b = grid_body(&g);
        b.pins = 1;
        int pin = 0;
        b.pin = &pin;
        add_body(w[k], &b);
        assert_int_equal(tss_world_prepare(w[k]), TSS_OK);
    }
    for (int s = 0; s < 4; s++) step(w[0]);
    size_t size = tss_world_save(w[0], NULL, 0);
    char *data = (char *)malloc(size);
    assert_int_equal(tss_world_save(w[0], data, size - 1), 0);
    assert_int_equal(tss_world_save(w[0], data, size), size);
    assert_int_equal(tss_world_load(w[1], data, size), TSS_OK);
    assert_true(tss_world_hash(w[0]) == tss_world_hash(w[1]));
    uint64_t allocations = 0;
    for (int s = 0; s < 10; s++) step(w[0]);
    uint64_t hash = tss_world_hash(w[0]);
    for (int s = 0; s < 10; s++) step(w[1]);
    assert_true(hash == tss_world_hash(w[1]));
    assert_int_equal(tss_world_load(w[0], data, size), TSS_OK);  // replayed: nothing is allocated
    for (int s = 0; s < 10; s++) allocations += step(w[0]).allocations;
    assert_true(hash == tss_world_hash(w[0]));
    assert_int_equal(allocations, 0);
    for (size_t cut = 0; cut < size; cut += size / 7 + 1)
        assert_int_equal(tss_world_load(w[1], data, cut), TSS_ERROR_FORMAT);
    data[0] ^= 1;
    assert_int_equal(tss_world_load(w[1], data, size), TSS_ERROR_FORMAT);
    assert_true(hash == tss_world_hash(w[1]));
    free(data);
    tss_world_destroy(w[0]), tss_world_destroy(w[1]);
    grid_free(&g);
}

// ---- the rest of the interface ----------------------------------------------------------------

// Points carried by cells follow any affine motion exactly, also just outside the body.
static void test_embedding(void **state) {
    (void)state;
    int n[3] = {3, 2, 2};
    double L[3] = {1, 1, 1}, x[3 * 48];
    static const double F[9] = {1.2, 0.1, 0, -0.1, 0.9, 0.2, 0.05, 0, 1.1};
    grid g = grid_make(3, n, L);
    tss_world *w = make_world(tss_world_def_default());
    tss_body_def b = grid_body(&g);
    add_body(w, &b);
    const double p[9] = {0.31, 0.77, 0.5, 0.999, 0.001, 0.4, 1.05, 0.5, 0.5};
    tss_embedding *e = NULL;
    assert_int_equal(tss_embedding_create(w, 5, p, 3, &e), TSS_ERROR_NOT_FOUND);
    assert_int_equal(tss_embedding_create(w, 0, p, 3, &e), TSS_OK);
    for (int k = 0; k < 3 * g.nodes; k++) {
        x[k] = 0.3 * (k % 3);
        for (int c = 0; c < 3; c++) x[k] += F[k % 3 * 3 + c] * g.X[k / 3 * 3 + c];
    }
    assert_int_equal(tss_body_teleport(w, 0, x, NULL), TSS_OK);
    float out[9];
    tss_embedding_update(e, w, out);
    for (int k = 0; k < 9; k++) {
        double want = 0.3 * (k % 3);
        for (int c = 0; c < 3; c++) want += F[k % 3 * 3 + c] * p[k / 3 * 3 + c];
        near((double)out[k], want, 1e-6);
    }
    tss_world_destroy(w);
    tss_embedding_destroy(e);  // may outlive its world
    grid_free(&g);
}

// A body hung on a dragged node: at rest the spring is as long as its weight demands. A removed
// body stays where it was, and the rest goes on.
static void test_drag_and_remove(void **state) {
    (void)state;
    int n[3] = {2, 2, 2};
    double L[3] = {0.1, 0.1, 0.1};
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.integrator = TSS_IMPLICIT_EULER;
    tss_world *w = make_world(d);
    tss_body_def b = grid_body(&g);
    b.material.E = 1e6, b.material.damping = 0.05;
    tss_body first = add_body(w, &b), second = add_body(w, &b);
    double at[3] = {0.05, 0.1, 0.05};
    int node = grid_id(n, 1, 2, 1);
    assert_int_equal(tss_node_drag(w, node, at, -1), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_node_drag(w, node, at, 200), TSS_OK);
    assert_int_equal(tss_body_remove(w, second), TSS_OK);
    assert_int_equal(tss_body_remove(w, second), TSS_ERROR_NOT_FOUND);
    for (int s = 0; s < 400; s++) step(w);
    near(at[1] - tss_world_positions(w)[3 * node + 1], 1 * 9.80665 / 200, 2e-3);  // 1 kg
    tss_body_info info;
    assert_int_equal(tss_body_get(w, second, &info), TSS_OK);
    assert_true(info.removed);
    for (int k = 0; k < 3 * g.nodes; k++)
        assert_true(tss_world_positions(w)[3 * info.first_node + k] == g.X[k]);
    double y = tss_world_positions(w)[3 * node + 1];
    assert_int_equal(tss_node_drag(w, node, at, 0), TSS_OK);  // let go: it falls
    for (int s = 0; s < 10; s++) step(w);
    assert_true(tss_world_positions(w)[3 * node + 1] < y - 0.02);
    (void)first;
    tss_world_destroy(w);
    grid_free(&g);
}

static double ticking(void *ctx) { return *(double *)ctx += 1e-3; }  // every look takes 1 ms

// A budget stops a step early with a feasible state; a long one changes nothing.
static void test_budget(void **state) {
    (void)state;
    int n[3] = {4, 2, 2};
    double L[3] = {1, 0.5, 0.5}, now = 0;
    grid g = grid_make(3, n, L);
    tss_world_def d = tss_world_def_default();
    d.tol = 1e-9, d.dt = 0.05;
    tss_world *w = make_world(d);
    assert_int_equal(tss_world_step_for(w, 1, NULL), TSS_ERROR_BAD_ARGUMENT);  // no clock
    tss_world_destroy(w);
    d.host.clock = ticking, d.host.clock_ctx = &now;
    uint64_t hash[2];
    for (int run = 0; run < 2; run++) {
        w = make_world(d);
        tss_body_def b = grid_body(&g);
        add_body(w, &b);
        for (int i = 0; i < g.nodes; i++)
            if (g.X[3 * i] == 0) tss_node_pin(w, i, 7);
        tss_step_info info;
        for (int s = 0; s < 3; s++) {
            if (run == 0) assert_int_equal(tss_world_step(w, &info), TSS_OK);
            if (run == 1) assert_int_equal(tss_world_step_for(w, 1e6, &info), TSS_OK);
            assert_int_equal(info.status, TSS_STEP_CONVERGED);
        }
        hash[run] = tss_world_hash(w);
        assert_int_equal(tss_world_step_for(w, 8e-3, &info), TSS_OK);
        assert_int_equal(info.status, TSS_STEP_BUDGET);
        assert_true(info.newton >= 1 && info.min_J > 0);
        tss_world_destroy(w);
    }
    assert_true(hash[0] == hash[1]);
    grid_free(&g);
}

// ---- bad input --------------------------------------------------------------------------------

static void expect_bad(const tss_body_def *d, tss_result want, const char *says) {
    tss_world *w = make_world(tss_world_def_default());
    tss_body b = 7;
    assert_int_equal(tss_body_add(w, d, &b), want);
    assert_int_equal(b, -1);
    if (!strstr(tss_world_error(w), says)) print_error("'%s' does not say '%s'\n", tss_world_error(w), says);
    assert_non_null(strstr(tss_world_error(w), says));
    assert_int_equal(tss_world_bodies(w), 0);
    assert_int_equal(tss_world_nodes(w), 0);
    tss_world_destroy(w);
}

static void test_bad_bodies(void **state) {
    (void)state;
    double X[15] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 1, 1, 1};
    int tet[8] = {0, 1, 2, 3, 1, 2, 3, 4}, bad[8], triangle[3] = {0, 1, 9};
    double E[2] = {1e5, -1}, nu[2] = {0.3, 0.5}, rho[2] = {1000, 0};
    tss_body_def ok = tss_body_def_default(), d;
    ok.nodes = 5, ok.X = X, ok.cells = 2, ok.cell = tet, ok.name = "blob";
    d = ok, d.cookie = 0, expect_bad(&d, TSS_ERROR_BAD_ARGUMENT, "tss_body_def_default");
    d = ok, d.nodes = 0, expect_bad(&d, TSS_ERROR_EMPTY, "no nodes");
    memcpy(bad, tet, sizeof bad), bad[0] = 1, bad[1] = 0, d = ok, d.cell = bad;
    expect_bad(&d, TSS_ERROR_BAD_MESH, "blob: cell 0 is inverted");
    memcpy(bad, tet, sizeof bad), bad[5] = 77;
    expect_bad(&d, TSS_ERROR_BAD_MESH, "cell 1 names node 77, expected 0..4");
    memcpy(bad, tet, sizeof bad), bad[3] = 0;
    expect_bad(&d, TSS_ERROR_BAD_MESH, "cell 0 names node 0 twice");
    memcpy(bad, tet, 4 * sizeof(int)), memcpy(bad + 4, tet, 4 * sizeof(int));
    d = ok, d.cell = bad, d.nodes = 4, expect_bad(&d, TSS_ERROR_BAD_MESH, "cells 0 and 1 have the same nodes");
    d = ok, d.cells = 1, expect_bad(&d, TSS_ERROR_BAD_MESH, "node 4 belongs to no cell");
    double Y[15];
    memcpy(Y, X, sizeof Y), Y[11] = 0, d = ok, d.X = Y, d.nodes = 4, d.cells = 1;
    expect_bad(&d, TSS_ERROR_BAD_MESH, "cell 0 is degenerate");
    memcpy(Y, X, sizeof Y), Y[7] = NAN, d = ok, d.X = Y;
    expect_bad(&d, TSS_ERROR_BAD_STATE, "rest position of node 2 is nan");
    d = ok, d.x0 = Y, expect_bad(&d, TSS_ERROR_BAD_STATE, "position of node 2");
    d = ok, d.material.E = 0, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "E = 0 Pa");
    d = ok, d.material.nu = 0.5, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "nu = 0.5");
    d = ok, d.material.rho = -1, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "rho = -1");
    d = ok, d.E = E, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "cell 1: E = -1");
    d = ok, d.nu = nu, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "cell 1: nu = 0.5");
    d = ok, d.rho = rho, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "cell 1: rho = 0");
    d = ok, d.kind = TSS_BODY_OBSTACLE, expect_bad(&d, TSS_ERROR_BAD_MESH, "not cells");
    d = ok, d.triangles = 1, d.triangle = triangle, expect_bad(&d, TSS_ERROR_BAD_MESH, "triangle 0 names node 9");
    d = ok, d.material.damping = -1, expect_bad(&d, TSS_ERROR_BAD_MATERIAL, "damping");
}

static void test_bad_worlds(void **state) {
    (void)state;
    tss_world_def ok = tss_world_def_default(), d;
    tss_world *w = (tss_world *)(uintptr_t)1;
    d = ok, d.cookie = 0, assert_int_equal(tss_world_create(&d, &w), TSS_ERROR_BAD_ARGUMENT);
    assert_null(w);
    d = ok, d.dim = 4, assert_int_equal(tss_world_create(&d, &w), TSS_ERROR_BAD_ARGUMENT);
    d = ok, d.dt = 0, assert_int_equal(tss_world_create(&d, &w), TSS_ERROR_BAD_ARGUMENT);
    d = ok, d.gravity[0] = NAN, assert_int_equal(tss_world_create(&d, &w), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_world_create(NULL, &w), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_world_create(&ok, &w), TSS_OK);
    assert_int_equal(tss_world_step(w, NULL), TSS_ERROR_EMPTY);
    assert_non_null(strstr(tss_world_error(w), "no soft body"));
    tss_check_report report;
    assert_int_equal(tss_world_check(w, &report), TSS_OK);
    assert_int_equal(report.errors, 1);
    double t[3] = {0, 0, 0};
    assert_int_equal(tss_node_target(w, 0, t), TSS_ERROR_NOT_FOUND);
    assert_int_equal(tss_body_remove(w, 3), TSS_ERROR_NOT_FOUND);
    assert_int_equal(tss_energy_remove(w, 99), TSS_ERROR_NOT_FOUND);
    tss_world_destroy(w);
    tss_world_destroy(NULL);
}

// A cell inside out at the start of a barrier material cannot be stepped; it is named.
static void test_bad_start(void **state) {
    (void)state;
    double X[12] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1}, x0[12];
    int tet[4] = {0, 1, 2, 3};
    memcpy(x0, X, sizeof x0), x0[11] = -1;
    tss_world *w = make_world(tss_world_def_default());
    tss_body_def b = tss_body_def_default();
    b.nodes = 4, b.X = X, b.cells = 1, b.cell = tet, b.x0 = x0;
    add_body(w, &b);
    assert_int_equal(tss_world_step(w, NULL), TSS_ERROR_BAD_STATE);
    assert_non_null(strstr(tss_world_error(w), "tet 0"));
    tss_check_report report;
    assert_int_equal(tss_world_check(w, &report), TSS_OK);
    assert_int_equal(report.errors, 1);
    assert_int_equal(tss_body_teleport(w, 0, X, NULL), TSS_OK);
    step(w);
    tss_world_destroy(w);
}

// A mesh drawn in millimetres is 1,000 times too large.
static void test_millimetres(void **state) {
    (void)state;
    int n[3] = {2, 2, 2};
    double L[3] = {200, 100, 100};
    grid g = grid_make(3, n, L);
    tss_world *w = make_world(tss_world_def_default());
    tss_body_def b = grid_body(&g);
    add_body(w, &b);
    tss_check_report report;
    assert_int_equal(tss_world_check(w, &report), TSS_OK);
    assert_int_equal(report.warnings, 1);
    assert_non_null(strstr(report.issue[0].text, "millimetres"));
    tss_world_destroy(w);
    grid_free(&g);
}

// ---- memory -----------------------------------------------------------------------------------

typedef struct failing {
    long left, live;
} failing;

static void *fail_alloc(size_t bytes, size_t align, void *ctx) {
    failing *f = (failing *)ctx;
    if (f->left-- <= 0) return NULL;
    f->live++;
    return aligned_alloc(align, (bytes + align - 1) / align * align);
}

static void fail_free(void *p, size_t bytes, void *ctx) {
    (void)bytes;
    ((failing *)ctx)->live--;
    free(p);
}

// Every allocation fails in turn: a clean error, nothing leaked, and once memory is back the same
// calls go through.
static void test_no_memory(void **state) {
    (void)state;
    int n[3] = {2, 1, 1};
    double L[3] = {1, 0.5, 0.5};
    grid g = grid_make(3, n, L);
    int done = 0;
    for (long k = 0; !done && k < 2000; k++) {
        failing f = {k, 0};
        tss_world_def d = tss_world_def_default();
        d.host.alloc = fail_alloc, d.host.free = fail_free, d.host.memory_ctx = &f;
        tss_world *w = NULL;
        tss_result r = tss_world_create(&d, &w);
        tss_body_def b = grid_body(&g);
        b.material.damping = 0.01;
        if (r == TSS_OK) r = tss_body_add(w, &b, NULL);
        if (r == TSS_OK) r = tss_world_step(w, NULL);
        assert_true(r == TSS_OK || r == TSS_ERROR_NO_MEMORY);
        done = r == TSS_OK;
        if (w && !done) {
            f.left = 1 << 30;
            if (tss_world_bodies(w) == 0) assert_int_equal(tss_body_add(w, &b, NULL), TSS_OK);
            step(w);
        }
        tss_world_destroy(w);
        assert_int_equal(f.live, 0);
    }
    assert_true(done);
    grid_free(&g);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_free_fall),   cmocka_unit_test(test_momentum),
        cmocka_unit_test(test_order),       cmocka_unit_test(test_patch),
        cmocka_unit_test(test_compression), cmocka_unit_test(test_cantilever),
        cmocka_unit_test(test_twist),       cmocka_unit_test(test_cloth),
        cmocka_unit_test(test_bad_start),   cmocka_unit_test(test_embedding),
        cmocka_unit_test(test_drag_and_remove), cmocka_unit_test(test_budget),
              cmocka_unit_test(test_same_bits),
        cmocka_unit_test(test_checkpoint),  cmocka_unit_test(test_bad_bodies),
        cmocka_unit_test(test_bad_worlds),  cmocka_unit_test(test_millimetres),
        cmocka_unit_test(test_no_memory),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
