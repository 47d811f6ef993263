// Tests of the contact mathematics: derivatives against central differences (also where pairs are
// degenerate), invariance, the projection against a dense eigen-solver, CCD against sampling with
// an independent distance.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
// cmocka.h needs the three above.
#include <cmocka.h>

// --- random numbers and small helpers ----------------------------------------------------------

static uint64_t seed_state;

static double uniform(double lo, double hi) {  // splitmix64
    uint64_t z = (seed_state += 0x9e3779b97f4a7c15ULL);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9ULL;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebULL;
    return lo + (hi - lo) * (double)((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

static void reseed(uint64_t seed) {
    seed_state = seed;
    print_message("    seed %llu\n", (unsigned long long)seed);
}

static double norm_max(const double *a, int n) {
    double m = 0;
    for (int i = 0; i < n; i++) m = fmax(m, fabs(a[i]));
    return m;
}

typedef void function(const double *x, double *out, void *arg);

// Smallest max|FD − J| / max|J| over step sizes; J is m × n (row per input), f gives m' = outs.
// The two must not agree to the last bit everywhere: that would be the code checked by itself.
static double derivative_error(function *f, void *arg, const double *x, int ins, int outs,
                               const double *J, double scale) {
    double best = HUGE_VAL, lo[12], hi[12], y[12], size = norm_max(J, ins * outs);
    int same = size > 0;
    for (double h = 1e-2 * scale; h > 1e-9 * scale; h *= 0.1) {
        double worst = 0;
        for (int i = 0; i < ins; i++) {
            memcpy(y, x, (size_t)ins * sizeof *y);
            y[i] = x[i] + h, f(y, hi, arg);
            y[i] = x[i] - h, f(y, lo, arg);
            for (int k = 0; k < outs; k++) {
                double fd = (hi[k] - lo[k]) / (2 * h);
                worst = fmax(worst, fabs(fd - J[i * outs + k]));
                if (fd != J[i * outs + k]) same = 0;
            }
        }
        best = fmin(best, worst);
    }
    assert_false(same);
    return best / fmax(size, 1e-9);  // energies and distances here are about 1e-3 and more
}

static void random_rotation(double Q[9]) {
    double q[4], n = 0;
    for (int i = 0; i < 4; i++) q[i] = uniform(-1, 1), n += q[i] * q[i];
    for (int i = 0; i < 4; i++) q[i] /= sqrt(n);
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double R[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                   2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                   2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    memcpy(Q, R, sizeof R);
}

static void rotate(const double Q[9], const double *x, int n, double *out) {
    for (int i = 0; i < n; i++)
        for (int a = 0; a < 3; a++)
            out[3 * i + a] =
                Q[3 * a] * x[3 * i] + Q[3 * a + 1] * x[3 * i + 1] + Q[3 * a + 2] * x[3 * i + 2];
}

// --- states ------------------------------------------------------------------------------------

typedef struct state {
    tss_ipc_kind kind;
    int dim;
    double x[12];
    const char *name;
} state;

// Pairs that are degenerate or sit on a border between features.
static const state special[] = {
    {TSS_IPC_EDGE_EDGE, 3, {0, 0, 0, 1, 0, 0, 0.3, 0.2, 0, 1.3, 0.2, 0}, "parallel edges"},
    {TSS_IPC_EDGE_EDGE,
     3,
     {0, 0, 0, 1, 0, 0, 0.1, 0.2, 0, 0.7, 0.2, 1e-9},
     "nearly parallel edges"},
    {TSS_IPC_EDGE_EDGE, 3, {0, 0, 0, 1, 0, 0, 0.1, 0.2, 0, 0.7, 0.22, 0.01}, "small angle"},
    {TSS_IPC_EDGE_EDGE, 3, {0, 0, 0, 1, 0, 0, 1.2, 0, 0, 2, 0, 0}, "collinear edges"},
    {TSS_IPC_EDGE_EDGE, 3, {0, 0, 0, 1, 0, 0, 0, 0, 0.2, 0, 1, 0.2}, "crossing at ends"},
    {TSS_IPC_EDGE_EDGE, 3, {0, 0, 0, 1, 0, 0, 0.5, 0, 0.2, 0.5, 1, 0.2}, "end over inside"},
    {TSS_IPC_EDGE_EDGE, 3, {0, 0, 0, 1, 0, 0, 0.5, -0.3, 0.2, 0.4, 0.7, 0.25}, "inside"},
    {TSS_IPC_EDGE_EDGE,
     3,
     {0, 0, 0, 0, 0, 0, 0.5, -0.3, 0.2, 0.4, 0.7, 0.25},
     "edge without length"},
    {TSS_IPC_POINT_TRIANGLE, 3, {0.2, 0.3, 0.1, 0, 0, 0, 1, 0, 0, 0, 1, 0}, "over the inside"},
    {TSS_IPC_POINT_TRIANGLE, 3, {0.5, 0, 0.1, 0, 0, 0, 1, 0, 0, 0, 1, 0}, "over an edge"},
    {TSS_IPC_POINT_TRIANGLE, 3, {0, 0, 0.1, 0, 0, 0, 1, 0, 0, 0, 1, 0}, "over a corner"},
    {TSS_IPC_POINT_TRIANGLE,
     3,
     {0.5, -0.1, 0, 0, 0, 0, 1, 0, 0, 0, 1, 0},
     "in the plane, beside an edge"},
    {TSS_IPC_POINT_TRIANGLE, 3, {-0.1, -0.1, 0.02, 0, 0, 0, 1, 0, 0, 0, 1, 0}, "beyond a corner"},
    {TSS_IPC_POINT_TRIANGLE,
     3,
     {0.4, 0.1, 0.1, 0, 0, 0, 1, 0, 0, 0.5, 1e-7, 0},
     "nearly flat triangle"},
    {TSS_IPC_POINT_TRIANGLE, 3, {0.4, 0.1, 0.1, 0, 0, 0, 1, 0, 0, 2, 0, 0}, "flat triangle"},
    {TSS_IPC_POINT_TRIANGLE,
     3,
     {0.4, 0.1, 0.1, 0, 0, 0, 0, 0, 0, 0, 0, 0},
     "triangle without size"},
    {TSS_IPC_POINT_EDGE, 3, {0, 0.1, 0.1, 0, 0, 0, 1, 0, 0}, "over an end"},
    {TSS_IPC_POINT_EDGE, 3, {0.3, 0.1, 0.1, 0, 0, 0, 1, 0, 0}, "over the inside"},
    {TSS_IPC_POINT_EDGE, 3, {-0.1, 0, 0, 0, 0, 0, 1, 0, 0}, "on the line beyond the end"},
    {TSS_IPC_POINT_EDGE, 2, {0, 0.1, 0, 0, 1, 0}, "2D, over an end"},
    {TSS_IPC_POINT_EDGE, 2, {0.3, 0.1, 0, 0, 1, 0.05}, "2D, over the inside"},
    {TSS_IPC_POINT_EDGE, 2, {1.1, 0.05, 0, 0, 1, 0.05}, "2D, beyond the end"},
    {TSS_IPC_POINT_POINT, 3, {0.1, 0.1, 0.1, 0, 0, 0}, "points"},
    {TSS_IPC_POINT_POINT, 2, {0.1, 0.1, 0, 0}, "2D points"},
};
enum { SPECIALS = sizeof special / sizeof *special };

// The i-th state: the special ones, then random ones of size 1 at distances below about 0.3.
static state state_of(int i) {
    if (i < SPECIALS) return special[i];
    static const tss_ipc_kind kinds[6] = {TSS_IPC_EDGE_EDGE,  TSS_IPC_POINT_TRIANGLE,
                                          TSS_IPC_POINT_EDGE, TSS_IPC_POINT_POINT,
                                          TSS_IPC_POINT_EDGE, TSS_IPC_POINT_POINT};
    state s = {kinds[i % 6], i % 6 < 4 ? 3 : 2, {0}, "random"};
    do
        for (int k = 0; k < 12; k++) s.x[k] = uniform(-0.5, 0.5);
    while (tss_ipc_distance(s.kind, s.dim, s.x, NULL) > 0.09);
    return s;
}

// --- distances ---------------------------------------------------------------------------------

typedef struct feature_arg {
    const state *s;
    int feature;
} feature_arg;

static void distance_value(const double *x, double *out, void *arg) {
    const feature_arg *a = (const feature_arg *)arg;
    out[0] = tss_ipc_feature_distance(a->s->kind, a->s->dim, a->feature, x, NULL, NULL);
}
static void distance_gradient(const double *x, double *out, void *arg) {
    const feature_arg *a = (const feature_arg *)arg;
    tss_ipc_feature_distance(a->s->kind, a->s->dim, a->feature, x, out, NULL);
}

// Every feature's own formula, at random states.
static void test_feature_derivatives(void **unused) {
    (void)unused;
    reseed(1);
    static const int features[4] = {9, 7, 3, 1};
    for (int i = SPECIALS; i < SPECIALS + 600; i++) {
        state s = state_of(i);
        int n = tss_ipc_pair_nodes(s.kind) * s.dim;
        feature_arg a = {&s, i % features[s.kind]};
        double g[12], H[144];
        double d = tss_ipc_feature_distance(s.kind, s.dim, a.feature, s.x, g, H);
        assert_true(d >= 0);
        assert_true(derivative_error(distance_value, &a, s.x, n, 1, g, 1) < 1e-7);
        assert_true(derivative_error(distance_gradient, &a, s.x, n, n, H, 1) < 1e-6);
    }
}

// The closest distance is C¹ across features wherever the closest points are unique.
static void test_gradient_across_features(void **unused) {
    (void)unused;
    for (int i = 0; i < SPECIALS; i++) {
        const state *s = &special[i];
        // Not unique: parallel edges that overlap. Not differentiable to first order in steps of
        // the sweep: a nearly flat triangle's height is 1e-7, and a triangle or an edge without
        // size gets one from any step.
        if (strstr(s->name, "parallel") || strstr(s->name, "flat") || strstr(s->name, "without"))
            continue;
        int n = tss_ipc_pair_nodes(s->kind) * s->dim;
        feature_arg a = {s, TSS_IPC_CLOSEST};
        double g[12];
        tss_ipc_feature_distance(s->kind, s->dim, TSS_IPC_CLOSEST, s->x, g, NULL);
        assert_true(derivative_error(distance_value, &a, s->x, n, 1, g, 1) < 1e-6);
    }
}

static double length2(const double *a, const double *b, int dim) {
    double s = 0;
    for (int i = 0; i < dim; i++) s += (a[i] - b[i]) * (a[i] - b[i]);
    return s;
}

// Squared distance at parameters (s, t) of a pair: the only thing the search below knows.
static double at_parameters(tss_ipc_kind kind, int dim, const double *x, double s, double t) {
    double a[3] = {0}, b[3] = {0};
    for (int i = 0; i < dim; i++) {
        double p[4];
        for (int k = 0; k < 4; k++) p[k] = k < tss_ipc_pair_nodes(kind) ? x[k * dim + i] : 0;
        switch (kind) {
            case TSS_IPC_EDGE_EDGE:
                a[i] = p[0] + s * (p[1] - p[0]), b[i] = p[2] + t * (p[3] - p[2]);
                break;
            case TSS_IPC_POINT_TRIANGLE:  // t runs from t0's side to the opposite edge
                a[i] = p[0], b[i] = p[1] + s * ((p[2] - p[1]) + t * (p[3] - p[2]));
                break;
            case TSS_IPC_POINT_EDGE:
                a[i] = p[0], b[i] = p[1] + s * (p[2] - p[1]);
                break;
            default:
                a[i] = p[0], b[i] = p[1];
                break;
        }
    }
    return length2(a, b, dim);
}

// Minimum over s for given t by golden section: convex along every line of the primitives.
static double search_s(tss_ipc_kind kind, int dim, const double *x, double t, int steps) {
    const double golden = 0.6180339887498949;
    double lo = 0, hi = 1, s0 = 1 - golden, s1 = golden;
    double f0 = at_parameters(kind, dim, x, s0, t), f1 = at_parameters(kind, dim, x, s1, t);
    double best = fmin(at_parameters(kind, dim, x, 0, t), at_parameters(kind, dim, x, 1, t));
    for (int i = 0; i < steps; i++) {
        if (f0 < f1)
            hi = s1, s1 = s0, f1 = f0, s0 = hi - golden * (hi - lo),
            f0 = at_parameters(kind, dim, x, s0, t);
        else
            lo = s0, s0 = s1, f0 = f1, s1 = lo + golden * (hi - lo),
            f1 = at_parameters(kind, dim, x, s1, t);
    }
    return fmin(best, fmin(f0, f1));
}

// Distance by nested search, independent of the library: the minimum over s is quasi-convex in t.
static double search_distance(tss_ipc_kind kind, int dim, const double *x, int steps) {
    const double golden = 0.6180339887498949;
    double lo = 0, hi = 1, t0 = 1 - golden, t1 = golden;
    double f0 = search_s(kind, dim, x, t0, steps), f1 = search_s(kind, dim, x, t1, steps);
    double best = fmin(search_s(kind, dim, x, 0, steps), search_s(kind, dim, x, 1, steps));
    for (int i = 0; i < steps && kind <= TSS_IPC_POINT_TRIANGLE; i++) {
        if (f0 < f1)
            hi = t1, t1 = t0, f1 = f0, t0 = hi - golden * (hi - lo),
            f0 = search_s(kind, dim, x, t0, steps);
        else
            lo = t0, t0 = t1, f0 = f1, t1 = lo + golden * (hi - lo),
            f1 = search_s(kind, dim, x, t1, steps);
    }
    return fmin(best, fmin(f0, f1));
}

static void test_distance_against_search(void **unused) {
    (void)unused;
    reseed(2);
    for (int i = 0; i < SPECIALS + 600; i++) {
        state s = state_of(i);
        double c[4], r[3] = {0, 0, 0}, sum = 0;
        double d = tss_ipc_distance(s.kind, s.dim, s.x, c),
               found = search_distance(s.kind, s.dim, s.x, 45);
        assert_true(fabs(d - found) <= 1e-8 * found + 1e-15);
        // The coefficients give the shortest vector and do not see a translation.
        for (int k = 0; k < tss_ipc_pair_nodes(s.kind); k++) {
            sum += c[k];
            for (int a = 0; a < s.dim; a++) r[a] += c[k] * s.x[k * s.dim + a];
        }
        assert_true(fabs(sum) < 1e-14);
        assert_true(fabs(r[0] * r[0] + r[1] * r[1] + r[2] * r[2] - d) <= 1e-9 * d + 1e-15);
    }
}

static void test_invariance(void **unused) {
    (void)unused;
    reseed(3);
    for (int i = SPECIALS; i < SPECIALS + 300; i++) {
        state s = state_of(i);
        if (s.dim == 2) continue;
        int m = tss_ipc_pair_nodes(s.kind);
        double Q[9], y[12], g[12], gy[12], Qg[12], shift[3];
        random_rotation(Q);
        rotate(Q, s.x, m, y);
        for (int a = 0; a < 3; a++) shift[a] = uniform(-3, 3);
        for (int k = 0; k < 3 * m; k++) y[k] += shift[k % 3];
        int f = tss_ipc_closest(s.kind, 3, s.x);
        double d = tss_ipc_feature_distance(s.kind, 3, f, s.x, g, NULL);
        double dy = tss_ipc_feature_distance(s.kind, 3, f, y, gy, NULL);
        assert_true(fabs(d - dy) < 1e-13);
        rotate(Q, g, m, Qg);
        for (int k = 0; k < 3 * m; k++)
            assert_true(fabs(Qg[k] - gy[k]) < 1e-11 * (1 + norm_max(g, 12)));
    }
}

// --- scalar functions --------------------------------------------------------------------------

static void barrier_value(const double *x, double *out, void *arg) {
    out[0] = tss_ipc_barrier(x[0], *(const double *)arg, NULL, NULL);
}
static void barrier_slope(const double *x, double *out, void *arg) {
    tss_ipc_barrier(x[0], *(const double *)arg, out, NULL);
}

static void test_barrier(void **unused) {
    (void)unused;
    double dhat = 1e-6, b1, b2;
    for (double d = 1e-18; d < 0.999e-6; d *= 1.7) {
        tss_ipc_barrier(d, dhat, &b1, &b2);
        assert_true(derivative_error(barrier_value, &dhat, &d, 1, 1, &b1, d) < 1e-7);
        assert_true(derivative_error(barrier_slope, &dhat, &d, 1, 1, &b2, d) < 1e-7);
        assert_true(b1 < 0 && b2 > 0);
        // Convex in the distance itself: what the projected Hessian's rank rests on.
        assert_true(2 * b1 + 4 * d * b2 > 0);
    }
    // C² at d̂, zero beyond, infinite at contact.
    assert_true(tss_ipc_barrier(dhat * (1 - 1e-12), dhat, &b1, &b2) < 1e-40);
    assert_true(fabs(b1) < 1e-28 && fabs(b2) < 1e-10);
    assert_true(tss_ipc_barrier(dhat, dhat, &b1, &b2) == 0 && b1 == 0 && b2 == 0);
    assert_true(tss_ipc_barrier(1, dhat, &b1, &b2) == 0 && b1 == 0 && b2 == 0);
    assert_true(isinf(tss_ipc_barrier(0, dhat, &b1, &b2)) && b1 < 0 && isinf(b1));
    assert_true(isinf(tss_ipc_barrier(-1, dhat, NULL, NULL)));
}

static void test_log(void **unused) {
    (void)unused;
    reseed(4);
    double worst = 0;
    for (int i = 0; i < 200000; i++) {
        double z = i % 2 ? exp(uniform(-700, 700)) : 1 + uniform(-0.5, 0.5), y = log(z);
        double ulp = nextafter(fabs(y), HUGE_VAL) - fabs(y);
        worst = fmax(worst, fabs(tss__ipc_log(z) - y) / ulp);
    }
    print_message("    log differs from the C library's by at most %.1f ulp\n", worst);
    assert_true(worst <= 2);
    assert_true(tss__ipc_log(1) == 0);
}

static void friction_f0(const double *x, double *out, void *arg) {
    double f[4];
    tss_ipc_friction(x[0], *(const double *)arg, f);
    out[0] = f[0];
}
static void friction_f1(const double *x, double *out, void *arg) {
    double f[4];
    tss_ipc_friction(x[0], *(const double *)arg, f);
    out[0] = f[1];
}

static void test_friction(void **unused) {
    (void)unused;
    double eps = 1e-3, f[4], left[4], right[4];
    for (double y = 1e-5; y < 0.99e-3; y *= 1.3) {
        tss_ipc_friction(y, eps, f);
        assert_true(derivative_error(friction_f0, &eps, &y, 1, 1, &f[1], fmin(y, eps - y)) < 1e-7);
        assert_true(derivative_error(friction_f1, &eps, &y, 1, 1, &f[2], fmin(y, eps - y)) < 1e-7);
        assert_true(fabs(f[3] * y - f[1]) < 1e-14 && f[1] > 0 && f[1] < 1 && f[2] > 0);
    }
    tss_ipc_friction(eps * (1 - 1e-12), eps, left);
    tss_ipc_friction(eps, eps, right);
    for (int i = 0; i < 2; i++) assert_true(fabs(left[i] - right[i]) < 1e-11);
    tss_ipc_friction(0, eps, f);
    assert_true(f[1] == 0 && f[3] == 2 / eps);
    tss_ipc_friction(5, eps, f);
    assert_true(f[0] == 5 && f[1] == 1 && f[2] == 0);
}

static void mollifier_value(const double *x, double *out, void *arg) {
    out[0] = tss_ipc_mollifier(x, *(const double *)arg, NULL, NULL);
}
static void mollifier_gradient(const double *x, double *out, void *arg) {
    tss_ipc_mollifier(x, *(const double *)arg, out, NULL);
}

static void test_mollifier(void **unused) {
    (void)unused;
    reseed(5);
    for (int i = 0; i < 200; i++) {
        double x[12], g[12], H[144];
        for (int k = 0; k < 12; k++) x[k] = uniform(-0.5, 0.5);
        double eps = uniform(0.5, 4);
        double m = tss_ipc_mollifier(x, eps, g, H);
        assert_true(m >= 0 && m <= 1);
        if (m > 0.98) continue;  // m′′ jumps at 1: the larger steps would cross it
        assert_true(derivative_error(mollifier_value, &eps, x, 12, 1, g, 0.1) < 1e-6);
        assert_true(derivative_error(mollifier_gradient, &eps, x, 12, 12, H, 0.1) < 1e-6);
    }
    double parallel[12] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 2, 1, 0}, g[12];
    assert_true(tss_ipc_mollifier(parallel, tss_ipc_mollifier_eps(parallel), g, NULL) == 0);
    assert_true(norm_max(g, 12) == 0);
    assert_true(fabs(tss_ipc_mollifier_eps(parallel) - 4e-3) < 1e-17);
}

static void test_tangents(void **unused) {
    (void)unused;
    reseed(6);
    for (int i = 0; i < 500; i++) {
        double n[3], t[6], size = 0;
        for (int a = 0; a < 3; a++)
            n[a] = i < 6 ? (a == i / 2 ? (i % 2 ? -1.0 : 1.0) : 0.0) : uniform(-1, 1);
        for (int a = 0; a < 3; a++) size += n[a] * n[a];
        for (int a = 0; a < 3; a++) n[a] /= sqrt(size);
        tss_ipc_tangents(3, n, t);
        for (int a = 0; a < 3; a++) {
            int b = (a + 1) % 3, c = (a + 2) % 3;
            assert_true(fabs(t[b] * t[3 + c] - t[c] * t[3 + b] - n[a]) < 1e-14);
        }
        assert_true(fabs(length2(t, t + 3, 3) - 2) < 1e-14);
    }
    double n[2] = {0.6, 0.8}, t[2];
    tss_ipc_tangents(2, n, t);
    assert_true(t[0] == -0.8 && t[1] == 0.6);
}

// --- one pair's energy: m b in lanes -----------------------------------------------------------

typedef struct energy_arg {
    const state *s;
    const double *X;
    double dhat;
} energy_arg;

static const int in_order[4] = {0, 1, 2, 3};

static tss__eight job(const energy_arg *a, const double *x, double *out) {
    tss__eight e;
    memset(&e, 0, sizeof e);
    e.kind = a->s->kind, e.dim = a->s->dim, e.count = 1;
    e.arity = tss_ipc_pair_nodes(e.kind);
    e.x = x, e.X = a->X, e.dhat = a->dhat;
    e.node[0] = in_order, e.scale[0] = 3, e.out[0] = out;
    return e;
}
static void energy_value(const double *x, double *out, void *arg) {
    tss__eight e = job((const energy_arg *)arg, x, out);
    tss__eight_value(&e, NULL);
}
static void energy_gradient(const double *x, double *out, void *arg) {
    tss__eight e = job((const energy_arg *)arg, x, out);
    tss__eight_gradient(&e);
}
static void energy_hessian(const double *x, int psd, double *out, energy_arg *a) {
    tss__eight e = job(a, x, out);
    tss__eight_hessian(&e, psd);
}

static int is_mollified(const state *s, const double *X) {
    double eps;
    if (s->kind != TSS_IPC_EDGE_EDGE) return 0;
    eps = tss_ipc_mollifier_eps(X);
    return tss_ipc_mollifier(s->x, eps, NULL, NULL) < 1;
}

// Where the second derivative jumps (a feature's border) only the gradient can be compared.
static int on_border(const state *s) {
    return !strcmp(s->name, "crossing at ends") || strstr(s->name, "over a") ||
           strstr(s->name, "end over") || strstr(s->name, "collinear") ||
           strstr(s->name, "parallel") || strstr(s->name, "flat") || strstr(s->name, "without") ||
           strstr(s->name, "on the line");
}

static void test_energy_derivatives(void **unused) {
    (void)unused;
    reseed(7);
    int mollified = 0, hessians = 0;
    for (int i = 0; i < SPECIALS + 900; i++) {
        state s = state_of(i);
        if (strstr(s.name, "flat") || strstr(s.name, "without")) continue;
        int n = tss_ipc_pair_nodes(s.kind) * s.dim;
        double X[12], v, g[12], H[144];
        // Long at rest in a third of the cases: then the mollifier is at work at any angle.
        for (int k = 0; k < 12; k++) X[k] = (i % 3 == 0 ? 8 : 1) * s.x[k];
        energy_arg a = {&s, X, 4 * tss_ipc_distance(s.kind, s.dim, s.x, NULL)};
        double near = sqrt(a.dhat) / 2;
        energy_value(s.x, &v, &a);
        energy_gradient(s.x, g, &a);
        energy_hessian(s.x, 0, H, &a);
        assert_true(v >= 0 && isfinite(v));
        mollified += is_mollified(&s, X);
        // Overlapping parallel edges are smooth thanks to the mollifier (m = 0 to second order).
        double e1 = derivative_error(energy_value, &a, s.x, n, 1, g, near);
        if (e1 >= 1e-5) print_message("    state %d (%s): %.2e\n", i, s.name, e1);
        assert_true(e1 < 1e-5);
        if (on_border(&s)) continue;
        double e2 = derivative_error(energy_gradient, &a, s.x, n, n, H, near);
        // A border may lie inside the larger steps: only the smaller ones count then.
        if (e2 >= 1e-4) print_message("    state %d (%s): %.2e\n", i, s.name, e2);
        assert_true(e2 < 1e-4);
        hessians++;
    }
    print_message("    %d mollified, %d Hessians\n", mollified, hessians);
    assert_true(mollified > 40 && hessians > 800);
}

// --- projection --------------------------------------------------------------------------------

// Cyclic Jacobi on a full symmetric n × n matrix, plain and slow: A = V diag(w) Vᵀ.
static void dense_eigen(int n, double *A, double *V) {
    for (int i = 0; i < n * n; i++) V[i] = i / n == i % n;
    for (int sweep = 0; sweep < 60; sweep++)
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                if (A[p * n + q] == 0) continue;
                double phi = 0.5 * atan2(2 * A[p * n + q], A[q * n + q] - A[p * n + p]);
                double c = cos(phi), s = sin(phi);
                for (int k = 0; k < n; k++) {
                    double a = A[k * n + p], b = A[k * n + q];
                    A[k * n + p] = c * a - s * b, A[k * n + q] = s * a + c * b;
                }
                for (int k = 0; k < n; k++) {
                    double a = A[p * n + k], b = A[q * n + k];
                    A[p * n + k] = c * a - s * b, A[q * n + k] = s * a + c * b;
                    a = V[k * n + p], b = V[k * n + q];
                    V[k * n + p] = c * a - s * b, V[k * n + q] = s * a + c * b;
                }
            }
}

static void dense_project(int n, const double *H, double *P) {
    double A[144], V[144];
    memcpy(A, H, (size_t)(n * n) * sizeof *A);
    dense_eigen(n, A, V);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            P[i * n + j] = 0;
            for (int k = 0; k < n; k++)
                P[i * n + j] += fmax(A[k * n + k], 0) * V[i * n + k] * V[j * n + k];
        }
}

static void test_projection(void **unused) {
    (void)unused;
    reseed(8);
    double worst = 0;
    int mollified = 0, positive = 0;
    for (int i = 0; i < SPECIALS + 3000; i++) {
        state s = state_of(i);
        int n = tss_ipc_pair_nodes(s.kind) * s.dim;
        double X[12], H[144], P[144], ours[144];
        for (int k = 0; k < 12; k++) X[k] = (i % 3 == 0 ? 8 : 1) * s.x[k];
        // From almost touching d̂ to a distance of a hundredth of it.
        double reach = pow(10, uniform(0.001, 4));
        energy_arg a = {&s, X, reach * tss_ipc_distance(s.kind, s.dim, s.x, NULL)};
        energy_hessian(s.x, 0, H, &a);
        energy_hessian(s.x, 1, ours, &a);
        dense_project(n, H, P);
        double size = norm_max(H, n * n), error = 0;
        for (int k = 0; k < n * n; k++) error = fmax(error, fabs(ours[k] - P[k]));
        for (int k = 0; k < n * n; k++) assert_true(ours[k] == ours[(k % n) * n + k / n]);
        worst = fmax(worst, error / size);
        if (error > 1e-9 * size)
            print_message("    state %d (%s): %.2e\n", i, s.name, error / size);
        assert_true(error <= 1e-9 * size);
        mollified += is_mollified(&s, X);
        positive += norm_max(P, n * n) > 0;
    }
    print_message("    worst error %.1e of the largest entry, %d mollified\n", worst, mollified);
    assert_true(mollified > 100 && positive > 2900);
}

// Eight lanes give the same bits as one at a time, and unused nodes' rows are zero.
static void test_lanes(void **unused) {
    (void)unused;
    reseed(9);
    double x[96], X[96], out[8][256], one[256];
    int node[8][4];
    for (int round = 0; round < 60; round++)
        for (int kind = 0; kind < 4; kind++)
            for (int what = 0; what < 3; what++) {
                tss__eight e;
                memset(&e, 0, sizeof e);
                e.kind = (tss_ipc_kind)kind, e.dim = 3, e.arity = 4, e.x = x, e.X = X;
                e.dhat = 0.05, e.count = 1 + round % 8;
                int size = what == 0 ? 1 : what == 1 ? 12 : 144;
                for (int k = 0; k < 96; k++) x[k] = uniform(-0.3, 0.3), X[k] = x[k] * (1 + k % 5);
                for (int l = 0; l < 8; l++) {
                    for (int i = 0; i < 4; i++)
                        node[l][i] = i < tss_ipc_pair_nodes(e.kind) ? 4 * l + i : -1;
                    e.node[l] = node[l], e.scale[l] = uniform(1, 2), e.out[l] = out[l];
                }
                what == 0   ? tss__eight_value(&e, NULL)
                : what == 1 ? tss__eight_gradient(&e)
                            : tss__eight_hessian(&e, 1);
                for (int l = 0; l < e.count; l++) {
                    tss__eight f = e;
                    f.count = 1, f.node[0] = e.node[l], f.scale[0] = e.scale[l], f.out[0] = one;
                    what == 0   ? tss__eight_value(&f, NULL)
                    : what == 1 ? tss__eight_gradient(&f)
                                : tss__eight_hessian(&f, 1);
                    assert_memory_equal(one, out[l], (size_t)size * sizeof *one);
                    for (int k = 0; k < size && what > 0; k++)
                        if ((what == 1 ? k : k % 12) >= 3 * tss_ipc_pair_nodes(e.kind))
                            assert_true(out[l][k] == 0);
                }
            }
}

// --- continuous collision detection ------------------------------------------------------------

static double distance_at(const state *s, const double *d, double t) {
    double y[12];
    for (int i = 0; i < 12; i++) y[i] = s->x[i] + t * d[i];
    return search_distance(s->kind, s->dim, y, 36);
}

// A collision at a known time: two points of the primitives meet at t_hit.
static void make_hit(const state *s, double t_hit, double *d) {
    int m = tss_ipc_pair_nodes(s->kind), first = s->kind == TSS_IPC_EDGE_EDGE ? 2 : 1;
    double w[4], sum[2] = {0, 0}, gap[3] = {0, 0, 0};
    for (int i = 0; i < m; i++) w[i] = uniform(0.05, 1), sum[i >= first] += w[i];
    for (int i = 0; i < m; i++) w[i] /= sum[i >= first];
    for (int i = 0; i < m * s->dim; i++) d[i] = uniform(-1, 1);
    for (int i = 0; i < m; i++)
        for (int a = 0; a < s->dim; a++)
            gap[a] +=
                (i < first ? 1 : -1) * w[i] * (s->x[i * s->dim + a] + t_hit * d[i * s->dim + a]);
    for (int i = 0; i < first * s->dim; i++) d[i] -= gap[i % s->dim] / t_hit;
}

static void test_ccd_known_hits(void **unused) {
    (void)unused;
    reseed(10);
    double lead = 0, mean = 0;
    int iterations, total = 0, cases = 3000;
    for (int i = 0; i < cases; i++) {
        state s = state_of(SPECIALS + i);
        double d[12] = {0}, t_hit = uniform(0.01, 0.99), speed = i % 7 == 0 ? 1e8 : 1;
        make_hit(&s, t_hit, d);
        for (int k = 0; k < 12; k++) d[k] *= speed;
        double t = tss_ipc_ccd(s.kind, s.dim, s.x, d, 0.01, 1, 0, &iterations);
        assert_true(t < t_hit / speed * (1 + 1e-14));
        lead = fmax(lead, t_hit - t * speed), mean += t_hit - t * speed, total += iterations;
    }
    print_message("    ahead of the constructed hit: mean %.3f, most %.3f; %.1f iterations\n",
                  mean / cases, lead, (double)total / cases);
}

// On [0, t] no sample comes nearer than the slack allows; at t the slack is nearly used up.
static void test_ccd_against_sampling(void **unused) {
    (void)unused;
    reseed(11);
    const double slack = 0.1;
    int hits = 0, free_ways = 0;
    for (int i = 0; i < 400; i++) {
        state s = state_of(i < 2 * SPECIALS ? i % SPECIALS : i);
        double d[12] = {0};
        for (int k = 0; k < 12; k++) d[k] = uniform(-0.5, 0.5);
        double t = tss_ipc_ccd(s.kind, s.dim, s.x, d, slack, 1, 0, NULL),
               d0 = sqrt(distance_at(&s, d, 0));
        assert_true(t > 0 && t <= 1);
        for (int k = 0; k <= 60; k++)
            assert_true(sqrt(distance_at(&s, d, t * k / 60)) >= slack * d0 * (1 - 1e-6));
        if (t < 1) assert_true(sqrt(distance_at(&s, d, t)) <= 1.11 * slack * d0);
        t < 1 ? hits++ : free_ways++;
    }
    print_message("    %d stopped, %d free\n", hits, free_ways);
    assert_true(hits > 40 && free_ways > 100);
}

static void test_ccd_extremes(void **unused) {
    (void)unused;
    state s = {TSS_IPC_POINT_TRIANGLE, 3, {0.2, 0.2, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0}, ""};
    double d[12] = {0};
    int iterations;
    // No motion, common motion, motion apart, sliding past.
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL) == 1);
    for (int k = 0; k < 12; k++) d[k] = k % 3 == 0 ? 1e12 : 3;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, &iterations) == 1 && iterations == 1);
    memset(d, 0, sizeof d), d[2] = 1;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 5, 0, NULL) == 5);
    memset(d, 0, sizeof d), d[0] = 100;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL) == 1);
    // Head on: stops where the slack says.
    memset(d, 0, sizeof d), d[2] = -1;
    double t = tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 2, 0, NULL);
    assert_true(t <= 0.9 && t > 0.9 - 1e-12);
    // A very large velocity, a very small distance, a large common velocity.
    d[2] = -1e30;
    t = tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL);
    assert_true(t > 0 && t <= 0.9e-30);
    s.x[2] = 1e-13, d[2] = -1;
    t = tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL);
    assert_true(t > 0.8e-13 && t < 1e-13);
    s.x[2] = 1;
    for (int k = 0; k < 12; k++) d[k] = 1e8;
    d[2] -= 2;
    t = tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL);
    assert_true(t > 0.449 && t < 0.4501);
    // Touching, not finite, no time to go.
    s.x[2] = 0;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL) == 0);
    s.x[2] = 1, d[4] = NAN;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL) == 0);
    d[4] = HUGE_VAL;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL) == 0);
    d[4] = 0;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 0, 0, NULL) == 0);
    s.x[2] = NAN;
    assert_true(tss_ipc_ccd(s.kind, 3, s.x, d, 0.1, 1, 0, NULL) == 0);
}

// Primitives of size 1 at a small distance that move straight apart are free to go: a direction with the
// rounding of their far ends in it would not separate them. Of the random ones some are flat or thin.
static void test_ccd_near_and_apart(void **unused) {
    (void)unused;
    reseed(13);
    int stuck = 0, cases = 0;
    for (int i = 0; i < 12000; i++) {
        tss_ipc_kind kind = (tss_ipc_kind)(i % 3);
        double n[3], u[3], v[3], x[12], d[12] = {0}, dist = pow(10, uniform(-11, -6)), l = 0, un = 0, vn = 0;
        for (int a = 0; a < 3; a++) n[a] = uniform(-1, 1), u[a] = uniform(-1, 1), v[a] = uniform(-1, 1);
        for (int a = 0; a < 3; a++) l += n[a] * n[a];
        for (int a = 0; a < 3; a++) n[a] /= sqrt(l);
        for (int a = 0; a < 3; a++) un += u[a] * n[a], vn += v[a] * n[a];
        for (int a = 0; a < 3; a++) u[a] -= un * n[a], v[a] -= vn * n[a];
        int border = i / 3 % 2;  // over the inside, or over the border of a triangle
        for (int a = 0; a < 3; a++) {
            x[a] = dist * n[a], d[a] = n[a];
            if (kind == TSS_IPC_EDGE_EDGE) {
                x[a] -= .4 * u[a], x[3 + a] = dist * n[a] + .6 * u[a], d[3 + a] = n[a];
                x[6 + a] = -.3 * v[a], x[9 + a] = .7 * v[a];
            } else {
                x[3 + a] = -.3 * u[a] - (border ? 0 : .3) * v[a], x[6 + a] = .7 * u[a] - (border ? 0 : .3) * v[a];
                x[9 + a] = border ? .2 * u[a] + v[a] : -.3 * u[a] + .7 * v[a];
            }
        }
        if (!(tss_ipc_distance(kind, 3, x, NULL) > 0.01 * dist * dist)) continue;
        cases++, stuck += tss_ipc_ccd(kind, 3, x, d, 0.2, 1, 0, NULL) == 0;
    }
    print_message("    %d of %d held\n", stuck, cases);
    assert_true(cases > 10000 && stuck < cases / 200);
}

// Random pairs of all sizes, and parallel, flat, coplanar, zero-length and close ones: never nearer than
// the slack allows, by the distance at sampled times.
static void ccd_hard_case(int i, double *x, double *d, double *size) {
    tss_ipc_kind kind = (tss_ipc_kind)(i % 3);
    *size = pow(10, 4 * uniform(-1, 1));
    for (int k = 0; k < 12; k++) x[k] = uniform(-1, 1), d[k] = uniform(-1, 1) * pow(10, 2 * uniform(-1, 1));
    double q = uniform(-2, 2), thin = 1e-4 * pow(10, uniform(-9, 3)), near = pow(10, uniform(-8, 0)), coef[4], r[3] = {0};
    int form = i / 3 % 8;
    for (int a = 0; a < 3; a++) {
        if (form == 1) x[9 + a] = x[6 + a] + (x[3 + a] - x[a]) * q;
        if (form == 2) x[9 + a] = x[6 + a] + (x[3 + a] - x[a]) + thin * uniform(-1, 1);
        if (form == 4) x[3 + a] = x[a];
        if (form == 5) x[9 + a] = .5 * (x[3 + a] + x[6 + a]);
    }
    for (int k = 0; k < 4 && form == 3; k++) x[3 * k + 2] = .5;
    if (form == 6) {
        tss_ipc_distance(kind, 3, x, coef);
        for (int k = 0; k < tss_ipc_pair_nodes(kind); k++)
            for (int a = 0; a < 3; a++) r[a] += coef[k] * x[3 * k + a];
        for (int a = 0; a < 3; a++) {
            x[a] -= r[a] * (1 - near);
            if (kind == TSS_IPC_EDGE_EDGE) x[3 + a] -= r[a] * (1 - near);
        }
    }
    for (int k = 0; k < 12; k++) x[k] *= *size, d[k] *= *size;
}

static void test_ccd_hard_cases(void **unused) {
    (void)unused;
    reseed(14);
    int free_ways = 0;
    for (int i = 0; i < 60000; i++) {
        tss_ipc_kind kind = (tss_ipc_kind)(i % 3);
        double x[12], d[12], y[12], size;
        ccd_hard_case(i, x, d, &size);
        double t = tss_ipc_ccd(kind, 3, x, d, .2, 1, 0, NULL), d0 = sqrt(tss_ipc_distance(kind, 3, x, NULL));
        if (!(d0 > 1e-9 * size)) continue;
        assert_true(t > 0);
        free_ways += t == 1;
        for (int k = 1; k <= 20; k++) {
            double at = k == 20 ? t : t * k / 20;
            for (int j = 0; j < 12; j++) y[j] = x[j] + at * d[j];
            assert_true(sqrt(tss_ipc_distance(kind, 3, y, NULL)) >= .2 * (1 - 1e-6) * d0);
        }
    }
    assert_true(free_ways > 1000 && free_ways < 50000);
}

// The iteration cap returns the time reached, which is safe: below what more iterations give.
static void test_ccd_cap(void **unused) {
    (void)unused;
    reseed(12);
    int earlier = 0;
    for (int i = 0; i < 500; i++) {
        state s = state_of(SPECIALS + i);
        double d[12] = {0}, last = 0;
        make_hit(&s, uniform(0.1, 0.9), d);
        for (int cap = 1; cap <= 8; cap++) {
            int iterations;
            double t = tss_ipc_ccd(s.kind, s.dim, s.x, d, 1e-3, 1, cap, &iterations);
            assert_true(t >= last && iterations <= cap);
            earlier += t > last && last > 0;
            last = t;
        }
    }
    assert_true(earlier > 100);
}

static void test_ccd_plane(void **unused) {
    (void)unused;
    double o[3] = {0, 1, 0}, n[3] = {0, 2, 0}, x[3] = {5, 3, 1}, d[3] = {1, -4, 0};
    double t = tss_ipc_ccd_plane(3, x, d, o, n, 0.2, 1);
    assert_true(t <= 0.4 && t > 0.4 - 1e-12);
    d[1] = 4;
    assert_true(tss_ipc_ccd_plane(3, x, d, o, n, 0.2, 1) == 1);
    d[1] = 0;
    assert_true(tss_ipc_ccd_plane(3, x, d, o, n, 0.2, 1) == 1);
    x[1] = 1;
    assert_true(tss_ipc_ccd_plane(3, x, d, o, n, 0.2, 1) == 0);
    x[1] = 0;
    assert_true(tss_ipc_ccd_plane(3, x, d, o, n, 0.2, 1) == 0);
    x[1] = 3, d[1] = NAN;
    assert_true(tss_ipc_ccd_plane(3, x, d, o, n, 0.2, 1) == 0);
    double o2[2] = {0, 0}, n2[2] = {1, 0}, x2[2] = {1, 7}, d2[2] = {-10, 0};
    t = tss_ipc_ccd_plane(2, x2, d2, o2, n2, 0.1, 1);
    assert_true(t <= 0.09 && t > 0.09 - 1e-12);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_feature_derivatives),
        cmocka_unit_test(test_gradient_across_features),
        cmocka_unit_test(test_distance_against_search),
        cmocka_unit_test(test_invariance),
        cmocka_unit_test(test_barrier),
        cmocka_unit_test(test_log),
        cmocka_unit_test(test_friction),
        cmocka_unit_test(test_mollifier),
        cmocka_unit_test(test_tangents),
        cmocka_unit_test(test_energy_derivatives),
        cmocka_unit_test(test_projection),
        cmocka_unit_test(test_lanes),
        cmocka_unit_test(test_ccd_known_hits),
        cmocka_unit_test(test_ccd_against_sampling),
        cmocka_unit_test(test_ccd_extremes),
        cmocka_unit_test(test_ccd_near_and_apart),
        cmocka_unit_test(test_ccd_hard_cases),
        cmocka_unit_test(test_ccd_cap),
        cmocka_unit_test(test_ccd_plane),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
