// Tests of the elastic energies: derivatives against central differences, values against long
// double, projections against a dense eigen-solver written here, filters against evaluation.
#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"

// --- random numbers: splitmix64, seed printed ---

static uint64_t seed = 20260611;

static double uniform(double lo, double hi) {
    uint64_t z = (seed += 0x9E3779B97F4A7C15u);
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return lo + (hi - lo) * (double)((z ^ (z >> 31)) >> 11) * 0x1p-53;
}

static void rotation(int d, double *R) {
    if (d == 2) {
        double a = uniform(-3.2, 3.2);
        R[0] = R[3] = cos(a), R[1] = -sin(a), R[2] = sin(a);
        return;
    }
    double q[4], n = 0;
    for (int i = 0; i < 4; i++) q[i] = uniform(-1, 1), n += q[i] * q[i];
    for (int i = 0; i < 4; i++) q[i] /= sqrt(n);
    double w = q[0], x = q[1], y = q[2], z = q[3];
    double M[9] = {1 - 2 * (y * y + z * z), 2 * (x * y - w * z),     2 * (x * z + w * y),
                   2 * (x * y + w * z),     1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
                   2 * (x * z - w * y),     2 * (y * z + w * x),     1 - 2 * (x * x + y * y)};
    memcpy(R, M, sizeof M);
}

static void multiply(int d, const double *A, const double *B, int transpose_b, double *C) {
    double T[9];
    for (int r = 0; r < d; r++)
        for (int c = 0; c < d; c++) {
            T[r * d + c] = 0;
            for (int k = 0; k < d; k++)
                T[r * d + c] += A[r * d + k] * (transpose_b ? B[c * d + k] : B[k * d + c]);
        }
    memcpy(C, T, (size_t)(d * d) * sizeof *C);
}

// --- states: deformation gradients a test goes through ---

enum {
    REST,
    RANDOM,
    EQUAL,
    HALF_TURN,
    NEARLY_FLAT,
    VERY_FLAT,
    STRETCHED,
    TINY,
    INVERTED,
    FLAT,
    STATES
};
static const char *const state_name[] = {
    "rest",      "random",    "equal stretches", "half turn", "nearly flat",
    "very flat", "stretched", "tiny strain",     "inverted",  "flat"};

static void state(int d, int which, double *F) {
    double U[9], V[9], s[3] = {1, 1, 1};
    rotation(d, U), rotation(d, V);
    for (int i = 0; i < d; i++) {
        if (which == RANDOM || which == HALF_TURN || which == INVERTED) s[i] = uniform(0.5, 1.8);
        if (which == EQUAL) s[i] = 1.3;
        if (which == STRETCHED) s[i] = i ? 0.3 : 6;
        if (which == TINY) s[i] = 1 + uniform(-1e-6, 1e-6);
    }
    if (which == NEARLY_FLAT || which == VERY_FLAT) s[0] = 1.1, s[1] = 0.9;
    if (which == NEARLY_FLAT) s[d - 1] = 1e-2;
    if (which == VERY_FLAT) s[d - 1] = 1e-5;
    if (which == INVERTED) s[d - 1] *= -0.8;
    if (which == FLAT) s[d - 1] = 0;
    if (which == REST) memcpy(V, U, sizeof U);
    if (which == HALF_TURN) {
        // U = V diag(−1, −1, 1): a rotation by π of a stretched body.
        memcpy(U, V, sizeof U);
        for (int r = 0; r < d; r++) U[r * d] *= -1, U[r * d + 1] *= -1;
    }
    for (int r = 0; r < d; r++)
        for (int c = 0; c < d; c++) U[r * d + c] *= s[c];
    multiply(d, U, V, 1, F);
    if (which == REST)
        for (int i = 0; i < d * d; i++) F[i] = i % (d + 1) ? 0 : 1;
}

static int allowed(tss_material_kind kind, int which) {
    return which < INVERTED || kind != TSS_NEO_HOOKEAN;
}

// --- a handful of separate cells with random rest shapes, x = F X per cell ---

#define CELLS 19
typedef struct scene {
    int d;
    tss_host host;
    tss_ctx ctx;
    int node[CELLS * 4];
    double X[CELLS * 12], x[CELLS * 12], F[CELLS * 9];
    tss__elastic *e;
} scene;

static double det_of(int d, const double *A) {
    if (d == 2) return A[0] * A[3] - A[1] * A[2];
    return A[0] * (A[4] * A[8] - A[5] * A[7]) - A[1] * (A[3] * A[8] - A[5] * A[6]) +
           A[2] * (A[3] * A[7] - A[4] * A[6]);
}

static void set_state(scene *s, int which) {
    const int d = s->d;
    for (int c = 0; c < CELLS; c++) {
        double *F = s->F + c * d * d, shift[3] = {uniform(-1, 1), uniform(-1, 1), uniform(-1, 1)};
        state(d, which, F);
        for (int k = 0; k <= d; k++)
            for (int r = 0; r < d; r++) {
                double v = which == REST ? 0 : shift[r];
                for (int m = 0; m < d; m++) v += F[r * d + m] * s->X[(c * (d + 1) + k) * d + m];
                s->x[(c * (d + 1) + k) * d + r] = v;
            }
    }
}

static void scene_create(scene *s, int d, const tss_material *m) {
    memset(s, 0, sizeof *s);
    s->d = d;
    s->host = tss_host_default();
    s->ctx.host = &s->host;
    s->ctx.dim = d;
    for (int c = 0; c < CELLS; c++) {
        double D[9];
        do {
            for (int k = 0; k <= d; k++)
                for (int r = 0; r < d; r++)
                    s->X[(c * (d + 1) + k) * d + r] = uniform(-0.2, 0.2) + (k == r + 1 ? 0.8 : 0);
            if (c == 0)  // the reference cell, Dm = I: nodes show ∂²psi/∂F² itself
                for (int k = 0; k <= d; k++)
                    for (int r = 0; r < d; r++) s->X[k * d + r] = k == r + 1;
            for (int k = 0; k < d; k++)
                for (int r = 0; r < d; r++)
                    D[r * d + k] = s->X[(c * (d + 1) + k + 1) * d + r] - s->X[c * (d + 1) * d + r];
        } while (det_of(d, D) < 0.1);
        for (int k = 0; k <= d; k++) s->node[c * (d + 1) + k] = c * (d + 1) + k;
    }
    assert_int_equal(
        tss__elastic_create(&s->host, d, CELLS, s->node, s->X, m, NULL, NULL, NULL, &s->e, NULL),
        TSS_OK);
}

static void scene_destroy(scene *s) { tss__elastic_destroy(s->e, &s->host); }

static tss_ids one(int id) {
    tss_ids i;
    i.first = id, i.count = 1, i.list = NULL;
    return i;
}

static tss_ids first(int count) {
    tss_ids i = one(0);
    i.count = count;
    return i;
}

static tss_ids all(void) { return first(CELLS); }

static double norm(const double *v, int n) {
    double s = 0;
    for (int i = 0; i < n; i++) s += v[i] * v[i];
    return sqrt(s);
}

// --- the densities once more, in long double and by stretches ---

typedef long double ld;

// Eigenvalues of symmetric 3 × 3 in long double, Jacobi.
static void eigen3(ld A[3][3]) {
    for (int sweep = 0; sweep < 30; sweep++)
        for (int p = 0; p < 3; p++)
            for (int q = p + 1; q < 3; q++) {
                if (A[p][q] == 0) continue;
                ld th = (A[q][q] - A[p][p]) / (2 * A[p][q]);
                ld t = (th < 0 ? -1 : 1) / (fabsl(th) + sqrtl(th * th + 1)),
                   c = 1 / sqrtl(t * t + 1);
                ld sn = t * c;
                for (int i = 0; i < 3; i++) {
                    ld x = A[i][p], y = A[i][q];
                    A[i][p] = c * x - sn * y, A[i][q] = sn * x + c * y;
                }
                for (int i = 0; i < 3; i++) {
                    ld x = A[p][i], y = A[q][i];
                    A[p][i] = c * x - sn * y, A[q][i] = sn * x + c * y;
                }
            }
}

static ld psi_reference(tss_material_kind kind, int d, const ld F[3][3], ld mu, ld la) {
    ld C[3][3], G[3][3], s[3], E2 = 0, s3 = 0;  // s3 = ‖F‖² − 3, jj = J − 1: from F − I
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) G[i][k] = F[i][k] - (i == k);
    for (int i = 0; i < 3; i++) {
        s3 += 2 * G[i][i];
        for (int k = 0; k < 3; k++) {
            s3 += G[i][k] * G[i][k], C[i][k] = 0;
            for (int m = 0; m < 3; m++) C[i][k] += F[m][i] * F[m][k];
        }
    }
    const ld jj = G[0][0] + G[1][1] + G[2][2] + G[0][0] * G[1][1] - G[0][1] * G[1][0] +
                  G[0][0] * G[2][2] - G[0][2] * G[2][0] + G[1][1] * G[2][2] - G[1][2] * G[2][1] +
                  G[0][0] * (G[1][1] * G[2][2] - G[1][2] * G[2][1]) -
                  G[0][1] * (G[1][0] * G[2][2] - G[1][2] * G[2][0]) +
                  G[0][2] * (G[1][0] * G[2][1] - G[1][1] * G[2][0]);
    const ld J = 1 + jj;
    for (int i = 0; i < 3; i++)
        for (int k = 0; k < 3; k++) E2 += (C[i][k] - (i == k)) * (C[i][k] - (i == k)) / 4;
    if (kind == TSS_NEO_HOOKEAN)
        return mu / 2 * s3 - mu * log1pl(jj) + la / 2 * log1pl(jj) * log1pl(jj);
    if (kind == TSS_STVK) return mu * E2 + la / 8 * s3 * s3;
    if (kind == TSS_STABLE_NEO_HOOKEAN) {
        // (J − a)² − (1 − a)² = (J − 1)(J + 1 − 2a)
        ld m = 4 * mu / 3, l = la + 5 * mu / 6, a = 1 + m / l - m / (4 * l);
        return m / 2 * s3 + l / 2 * jj * (J + 1 - 2 * a) - m / 2 * log1pl(s3 / 4);
    }
    if (kind == TSS_LINEAR) {
        ld e2 = 0, t = 0;
        for (int i = 0; i < 3; i++) {
            t += F[i][i] - 1;
            for (int j = 0; j < 3; j++) {
                ld v = (F[i][j] + F[j][i]) / 2 - (i == j);
                e2 += v * v;
            }
        }
        return mu * e2 + la / 2 * t * t;
    }
    eigen3(C);
    int least = 0;
    // In 2D the third stretch is 1 by itself; a reflection shows in the smaller of the others.
    for (int i = 1; i < d; i++)
        if (C[i][i] < C[least][least]) least = i;
    // The smallest from J: a square root of a rounded 0 would be 1e-10.
    ld others = 1;
    for (int i = 0; i < 3; i++)
        if (i != least) s[i] = sqrtl(C[i][i]), others *= s[i];
    s[least] = J / others;
    ld sum = 0;
    for (int i = 0; i < 3; i++) sum += (s[i] - 1) * (s[i] - 1);
    return mu * sum + la / 2 * (J - 1) * (J - 1);
}

// volume · psi of a cell from its node positions, all in long double.
static ld value_reference(const scene *s, int c, ld *magnitude) {
    const int d = s->d;
    ld D[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}}, X[3][3] = {{1, 0, 0}, {0, 1, 0}, {0, 0, 1}};
    ld I[3][3], F[3][3], mu = s->e->material.E / (2 * (1 + (ld)s->e->material.nu));
    ld nu = s->e->material.nu, la = s->e->material.E * nu / ((1 + nu) * (1 - 2 * nu)), strain = 0;
    for (int k = 0; k < d; k++)
        for (int r = 0; r < d; r++) {
            X[r][k] = (ld)s->X[(c * (d + 1) + k + 1) * d + r] - s->X[c * (d + 1) * d + r];
            D[r][k] = (ld)s->x[(c * (d + 1) + k + 1) * d + r] - s->x[c * (d + 1) * d + r];
        }
    ld det = 0;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            int a = (j + 1) % 3, b = (j + 2) % 3, p = (i + 1) % 3, q = (i + 2) % 3;
            I[i][j] = X[a][p] * X[b][q] - X[a][q] * X[b][p];
        }
    for (int i = 0; i < 3; i++) det += X[0][i] * I[i][0];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            F[i][j] = 0;
            for (int k = 0; k < 3; k++) F[i][j] += D[i][k] * I[k][j] / det;
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            ld v = -(i == j);
            for (int k = 0; k < 3; k++) v += F[k][i] * F[k][j];
            strain += v * v;
        }
    ld vol = det / (d == 3 ? 6 : 2);
    *magnitude = vol * (mu + la) * sqrtl(strain);
    return vol * psi_reference(s->e->material.kind, d, (const ld(*)[3])F, mu, la);
}

#define FOR_ALL(kind, d)                                   \
    for (int kind = 0; kind < TSS_CUSTOM_MATERIAL; kind++) \
        for (int d = 2; d <= 3; d++)

static tss_material material_of(int kind, double E) {
    tss_material m = tss_material_default();
    m.kind = (tss_material_kind)kind;
    m.E = E, m.nu = 0.35;
    return m;
}

static void test_values(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        scene s;
        scene_create(&s, d, &m);
        for (int w = 0; w < STATES; w++) {
            if (!allowed(m.kind, w)) continue;
            double out[CELLS];
            set_state(&s, w);
            tss__elastic_value(s.e, &s.ctx, s.x, all(), out);
            for (int c = 0; c < CELLS; c++) {
                ld scale, v = value_reference(&s, c, &scale);
                // Rounding of x and F is amplified by 1/J in the logarithm of a flat cell.
                double tol = 1e-13 * (double)scale *
                                 (w == VERY_FLAT     ? 1e3
                                  : w == NEARLY_FLAT ? 3
                                                     : 1) +
                             1e-13 * fabs((double)v);
                if (w == REST) tol = 1e-25;
                if (!(fabs((double)(out[c] - v)) <= tol))
                    print_message("%s, kind %d, %dD: %.17g for %.17Lg, off %g of %g\n",
                                  state_name[w], kind, d, out[c], v, (double)(out[c] - v), tol);
                assert_true(fabs((double)(out[c] - v)) <= tol);
            }
        }
        scene_destroy(&s);
    }
}

// Best agreement of central differences with the gradient over a sweep of steps, relative to the
// larger of the gradient and the force scale.
static void check_gradient(const scene *s, int c, int w) {
    const int d = s->d, n = d * (d + 1);
    double g[12], x[CELLS * 12], best = 1e300, fd[12];
    int equal = 1;
    tss__elastic_gradient(s->e, &s->ctx, s->x, one(c), g);
    const double scale = norm(g, n) + 1e-3 * s->e->material.E * tss__vol_of(s->e, c);
    for (double step = 1e-2; step > 1e-10; step *= 0.25) {
        memcpy(x, s->x, sizeof x);
        for (int i = 0; i < n; i++) {
            double plus, minus, *xi = x + c * n + i, keep = *xi;
            *xi = keep + step, tss__elastic_value(s->e, &s->ctx, x, one(c), &plus);
            *xi = keep - step, tss__elastic_value(s->e, &s->ctx, x, one(c), &minus);
            *xi = keep;
            fd[i] = (plus - minus) / (2 * step) - g[i];
            if (fd[i] != 0) equal = 0;
        }
        const double err = norm(fd, n) / scale;
        if (err < best) best = err;
    }
    if (!(best < 2e-7))
        print_message("gradient: %s, kind %d, %dD, cell %d: off %g\n", state_name[w],
                      s->e->material.kind, d, c, best);
    assert_true(best < 2e-7);
    if (w != REST) assert_false(equal);
}

static void test_gradients(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        scene s;
        scene_create(&s, d, &m);
        for (int w = 0; w < STATES; w++) {
            if (!allowed(m.kind, w)) continue;
            set_state(&s, w);
            for (int c = 0; c < CELLS; c++) check_gradient(&s, c, w);
        }
        scene_destroy(&s);
    }
}

static void check_hessian(const scene *s, int c, int w) {
    const int d = s->d, n = d * (d + 1);
    double H[144], x[CELLS * 12], best = 1e300, D[144];
    int equal = 1;
    tss__elastic_hessian(s->e, &s->ctx, s->x, one(c), 0, H);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) assert_true(H[i * n + j] == H[j * n + i]);
    for (double step = 1e-2; step > 1e-10; step *= 0.25) {
        memcpy(x, s->x, sizeof x);
        for (int j = 0; j < n; j++) {
            double plus[12], minus[12], *xj = x + c * n + j, keep = *xj;
            *xj = keep + step, tss__elastic_gradient(s->e, &s->ctx, x, one(c), plus);
            *xj = keep - step, tss__elastic_gradient(s->e, &s->ctx, x, one(c), minus);
            *xj = keep;
            for (int i = 0; i < n; i++) {
                D[i * n + j] = (plus[i] - minus[i]) / (2 * step) - H[i * n + j];
                if (D[i * n + j] != 0) equal = 0;
            }
        }
        const double err = norm(D, n * n) / norm(H, n * n);
        if (err < best) best = err;
    }
    const double tol = w == VERY_FLAT ? 1e-6 : 1e-7;  // differences of 1/sigma² at sigma = 1e-5
    if (!(best < tol))
        print_message("hessian: %s, kind %d, %dD, cell %d: off %g\n", state_name[w],
                      s->e->material.kind, d, c, best);
    assert_true(best < tol);
    if (s->e->material.kind != TSS_LINEAR) assert_false(equal);
}

static void test_hessians(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        scene s;
        scene_create(&s, d, &m);
        for (int w = 0; w < STATES; w++) {
            if (!allowed(m.kind, w)) continue;
            set_state(&s, w);
            for (int c = 0; c < CELLS; c++) check_hessian(&s, c, w);
        }
        scene_destroy(&s);
    }
}

// Classical Jacobi (largest element first), in long double: independent of the library's.
static void clamp_reference(int n, double *A) {
    static ld T[144], Q[144];
    for (int i = 0; i < n * n; i++) T[i] = A[i], Q[i] = i % (n + 1) == 0;
    for (int it = 0; it < 4000; it++) {
        int p = 0, q = 1;
        for (int i = 0; i < n; i++)
            for (int j = i + 1; j < n; j++)
                if (fabsl(T[i * n + j]) > fabsl(T[p * n + q])) p = i, q = j;
        if (T[p * n + q] == 0) break;
        ld th = (T[q * n + q] - T[p * n + p]) / (2 * T[p * n + q]);
        ld t = (th < 0 ? -1 : 1) / (fabsl(th) + sqrtl(th * th + 1)), c = 1 / sqrtl(t * t + 1),
           s = t * c;
        for (int i = 0; i < n; i++) {
            ld x = T[i * n + p], y = T[i * n + q];
            T[i * n + p] = c * x - s * y, T[i * n + q] = s * x + c * y;
            x = Q[i * n + p], y = Q[i * n + q];
            Q[i * n + p] = c * x - s * y, Q[i * n + q] = s * x + c * y;
        }
        for (int i = 0; i < n; i++) {
            ld x = T[p * n + i], y = T[q * n + i];
            T[p * n + i] = c * x - s * y, T[q * n + i] = s * x + c * y;
        }
        T[p * n + q] = T[q * n + p] = 0;
    }
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) {
            ld v = 0;
            for (int k = 0; k < n; k++)
                if (T[k * n + k] > 0) v += T[k * n + k] * Q[i * n + k] * Q[j * n + k];
            A[i * n + j] = (double)v;
        }
}

// ∂²psi/∂F² times volume out of the Hessian of the reference cell, and back.
static void stretch_from_nodes(int d, const double *H, double *C) {
    const int n = d * (d + 1), dd = d * d;
    for (int r = 0; r < d; r++)
        for (int m = 0; m < d; m++)
            for (int c = 0; c < d; c++)
                for (int k = 0; k < d; k++)
                    C[(r * d + m) * dd + c * d + k] = H[((m + 1) * d + r) * n + (k + 1) * d + c];
}

static void test_projection(void **unused) {
    (void)unused;
    int projected = 0;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        scene s;
        scene_create(&s, d, &m);
        for (int w = 0; w < STATES; w++) {
            if (!allowed(m.kind, w)) continue;
            // A fixed-corotated cell that is just flat has no unique rotation in 2D.
            for (int trial = 0; trial < 20; trial++) {
                double H[144], P[144], C[81], D[81], K[81];
                set_state(&s, w);
                tss__elastic_hessian(s.e, &s.ctx, s.x, one(0), 0, H);
                tss__elastic_hessian(s.e, &s.ctx, s.x, one(0), 1, P);
                stretch_from_nodes(d, H, C);
                stretch_from_nodes(d, P, D);
                memcpy(K, C, sizeof K);
                clamp_reference(d * d, C);
                double scale = norm(K, d * d * d * d), moved = 0, off = 0;
                for (int i = 0; i < d * d * d * d; i++) {
                    moved = fmax(moved, fabs(C[i] - K[i]));
                    off = fmax(off, fabs(C[i] - D[i]));
                }
                if (moved > 1e-6 * scale) projected++;
                if (!(off <= 1e-9 * scale))
                    print_message("projection: %s, kind %d, %dD: off %g\n", state_name[w], kind, d,
                                  off / scale);
                assert_true(off <= 1e-9 * scale);
            }
        }
        scene_destroy(&s);
    }
    assert_true(projected > 300);
}

static void test_rigid_motion(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        if (kind == TSS_LINEAR) continue;
        tss_material m = material_of(kind, 1e5);
        scene s;
        scene_create(&s, d, &m);
        set_state(&s, RANDOM);
        double v0[CELLS], v1[CELLS], g0[CELLS * 12], g1[CELLS * 12], R[9], y[CELLS * 12];
        rotation(d, R);
        for (int i = 0; i < CELLS * (d + 1); i++)
            for (int r = 0; r < d; r++) {
                y[i * d + r] = 0.3 * (r + 1);
                for (int k = 0; k < d; k++) y[i * d + r] += R[r * d + k] * s.x[i * d + k];
            }
        tss__elastic_value(s.e, &s.ctx, s.x, all(), v0),
            tss__elastic_value(s.e, &s.ctx, y, all(), v1);
        tss__elastic_gradient(s.e, &s.ctx, s.x, all(), g0);
        tss__elastic_gradient(s.e, &s.ctx, y, all(), g1);
        for (int c = 0; c < CELLS; c++) assert_true(fabs(v0[c] - v1[c]) <= 1e-12 * fabs(v0[c]));
        for (int i = 0; i < CELLS * (d + 1); i++)
            for (int r = 0; r < d; r++) {
                double t = 0;
                for (int k = 0; k < d; k++) t += R[r * d + k] * g0[i * d + k];
                assert_true(fabs(t - g1[i * d + r]) <= 1e-12 * norm(g0, CELLS * d * (d + 1)));
            }
        scene_destroy(&s);
    }
}

// Any list of ids gives the bits of the whole range, whatever shares its eight lanes.
static void test_lists(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        const int n = d * (d + 1);
        scene s;
        double *big = (double *)malloc(CELLS * 144 * sizeof *big), v[CELLS], g[CELLS * 12];
        double part[TSS_BATCH * 144];
        scene_create(&s, d, &m);
        for (int w = 0; w < STATES; w++) {
            if (!allowed(m.kind, w)) continue;
            // Cells in different states side by side: some need a projection, some do not.
            double mixed[CELLS * 12];
            for (int k = 0; k < 3; k++) {
                set_state(&s, k == 0 ? w : k == 1 ? RANDOM : TINY);
                for (int c = k; c < CELLS; c += 3)
                    memcpy(mixed + c * n, s.x + c * n, (size_t)n * sizeof *mixed);
            }
            tss__elastic_value(s.e, &s.ctx, mixed, all(), v);
            tss__elastic_gradient(s.e, &s.ctx, mixed, all(), g);
            tss__elastic_hessian(s.e, &s.ctx, mixed, all(), 1, big);
            for (int trial = 0; trial < 4; trial++) {
                int list[TSS_BATCH];
                tss_ids ids;
                ids.first = 0, ids.list = list, ids.count = 1 + (int)uniform(0, TSS_BATCH - 1);
                for (int k = 0; k < ids.count; k++) list[k] = (int)uniform(0, CELLS);
                if (trial == 3) {  // a range that starts in the middle of a block
                    ids.list = NULL, ids.first = 3, ids.count = CELLS - 3;
                    for (int k = 0; k < ids.count; k++) list[k] = 3 + k;
                }
                tss__elastic_value(s.e, &s.ctx, mixed, ids, part);
                for (int k = 0; k < ids.count; k++) assert_memory_equal(part + k, v + list[k], 8);
                tss__elastic_gradient(s.e, &s.ctx, mixed, ids, part);
                for (int k = 0; k < ids.count; k++)
                    assert_memory_equal(part + k * n, g + list[k] * n, 8 * (size_t)n);
                tss__elastic_hessian(s.e, &s.ctx, mixed, ids, 1, part);
                for (int k = 0; k < ids.count; k++)
                    assert_memory_equal(part + k * n * n, big + list[k] * n * n,
                                        8 * (size_t)(n * n));
            }
        }
        free(big);
        scene_destroy(&s);
    }
}

static double ulps(double got, ld want) {
    int ex;
    frexp((double)want, &ex);
    return (double)(fabsl(got - want) / ldexpl(1, ex - 53));
}

static void test_logarithm(void **unused) {
    (void)unused;
    double worst = 0, worst1 = 0, tail_worst = 0;
    for (int i = 0; i < 2000000; i++) {
        double x = i % 2 ? exp(uniform(-700, 700)) : 1 + uniform(-0.6, 1.5), tail;
        double y = i % 4 < 2 ? (i % 4 ? 1 : -1) * exp(uniform(-80, -0.01)) : uniform(-0.9999, 9);
        worst = fmax(worst, ulps(tss__log(x), logl(x)));
        worst1 = fmax(worst1, ulps(tss__log1p(y, &tail), log1pl(y)));
        if (fabs(y) < 0.25 && fabs(y) > 1e-100) {
            // y − log1p(y) by its series where the difference would cancel.
            ld t = (ld)y - log1pl(y);
            if (fabs(y) < 1e-3) {
                t = 0;
                for (int k = 12; k >= 2; k--) t += (k % 2 ? -1 : 1) * powl(y, k) / k;
            }
            tail_worst = fmax(tail_worst, ulps(tail, t));
        }
    }
    print_message("log %.2f ulp, log1p %.2f ulp, x - log1p %.2f ulp\n", worst, worst1, tail_worst);
    assert_true(worst < 1.0 && worst1 < 1.5 && tail_worst < 4);
    // The same bits eight at a time as one by one.
    double x[8], y[8];
    for (int l = 0; l < 8; l++) x[l] = exp(uniform(-5, 5));
    TSS__EACH_LANE (l) y[l] = tss__log(x[l]) + tss__rsqrt(x[l]);
    for (int l = 0; l < 8; l++) {
        volatile double one_x = x[l];
        double z = tss__log(one_x) + tss__rsqrt(one_x);
        assert_memory_equal(&z, y + l, 8);
        assert_true(fabs(tss__rsqrt(x[l]) * sqrt(x[l]) - 1) < 1e-15);
    }
}

// At 1e12 Pa and strains of 1e-9 the energy is right to the rounding of its strain.
static void test_stiff(void **unused) {
    (void)unused;
    const int kinds[] = {TSS_NEO_HOOKEAN, TSS_STABLE_NEO_HOOKEAN, TSS_STVK, TSS_FIXED_COROTATED};
    for (int k = 0; k < 4; k++)
        for (int d = 2; d <= 3; d++) {
            tss_material m = material_of(kinds[k], 1e12);
            scene s;
            double out[CELLS];
            scene_create(&s, d, &m);
            // Displacements of 1e-9 exact in binary, so that x itself adds no rounding.
            for (int i = 0; i < CELLS * (d + 1) * d; i++) {
                s.X[i] = ldexp(rint(ldexp(s.X[i], 20)), -20);
                s.x[i] = s.X[i] + ldexp(rint(uniform(-64, 64)), -36);
            }
            tss__elastic_destroy(s.e, &s.host);
            assert_int_equal(tss__elastic_create(&s.host, d, CELLS, s.node, s.X, &m, NULL, NULL,
                                                 NULL, &s.e, NULL),
                             TSS_OK);
            tss__elastic_value(s.e, &s.ctx, s.x, all(), out);
            double worst = 0;
            for (int c = 0; c < CELLS; c++) {
                ld scale, v = value_reference(&s, c, &scale);
                // F is off by a few eps; the energy by mu |delta| times that.
                worst = fmax(worst, (double)(fabsl(out[c] - v) / scale));
            }
            print_message("kind %d %dD: error %.2g of (mu + lambda) |strain|\n", kinds[k], d,
                          worst);
            assert_true(worst < 4e-15);
            scene_destroy(&s);
        }
}

static ld det_at(const scene *s, int c, const double *d, ld t) {
    ld A[9];
    const int n = s->d;
    for (int k = 0; k < n; k++)
        for (int r = 0; r < n; r++) {
            int i = (c * (n + 1) + k + 1) * n + r, o = c * (n + 1) * n + r;
            A[k * n + r] = ((ld)s->x[i] - s->x[o]) + t * ((ld)d[i] - d[o]);
        }
    if (n == 2) return A[0] * A[3] - A[1] * A[2];
    return A[0] * (A[4] * A[8] - A[5] * A[7]) - A[1] * (A[3] * A[8] - A[5] * A[6]) +
           A[2] * (A[3] * A[7] - A[4] * A[6]);
}

// Never past the root, and up to it.
static void test_filter(void **unused) {
    (void)unused;
    int limited = 0, open = 0;
    for (int d = 2; d <= 3; d++) {
        tss_material m = material_of(TSS_NEO_HOOKEAN, 1e5);
        const double keep = d == 3 ? 0.2 : 0.1;
        scene s;
        scene_create(&s, d, &m);
        for (int trial = 0; trial < 400; trial++) {
            double dir[CELLS * 12], size = exp(uniform(-4, 4)),
                                    t_max = trial % 2 ? 1 : uniform(0.1, 3);
            int culprit;
            set_state(&s, trial % 5 == 0 ? NEARLY_FLAT : trial % 5 == 1 ? VERY_FLAT : RANDOM);
            for (int i = 0; i < CELLS * (d + 1) * d; i++) dir[i] = size * uniform(-1, 1);
            if (trial % 7 == 0)  // every cell shrinks to a point: a double or triple root at 1
                for (int i = 0, n = d * (d + 1); i < CELLS * n; i++)
                    dir[i] = s.x[i / n * n + i % d] - s.x[i];
            if (trial % 11 == 0)
                for (int i = 0; i < CELLS * (d + 1) * d; i++) dir[i] = size;
            double t = tss__elastic_max_step(s.e, &s.ctx, s.x, dir, t_max, &culprit);
            assert_true(t > 0 && t <= t_max);
            for (int c = 0; c < CELLS; c++) {
                ld d0 = det_at(&s, c, dir, 0);
                for (int k = 0; k <= 200; k++)
                    assert_true(det_at(&s, c, dir, (ld)t * k / 200) >= keep * d0 * (1 - 1e-9L));
            }
            if (culprit < 0)
                assert_true(t == t_max), open++;
            else {
                ld d0 = det_at(&s, culprit, dir, 0);
                assert_true(det_at(&s, culprit, dir, (ld)t * (1 + 1e-6L)) <=
                            keep * d0 * (1 + 1e-4L));
                limited++;
            }
        }
        scene_destroy(&s);
    }
    print_message("%d limited, %d open\n", limited, open);
    assert_true(limited > 100 && open > 50);
}

// Blocks run backwards: results of the parallel passes may not depend on the order.
static void backwards(int blocks, tss_task *task, void *arg, void *ctx) {
    (void)ctx;
    for (int b = blocks - 1; b >= 0; b--) task(b, 0, arg);
}

static void test_order(void **unused) {
    (void)unused;
    enum { N = 5000 };
    double *X = (double *)malloc(N * 12 * sizeof *X), *x = (double *)malloc(N * 12 * sizeof *x);
    double *dir = (double *)malloc(N * 12 * sizeof *dir), t[2], J[2];
    int *node = (int *)malloc(N * 4 * sizeof *node), who[2], least[2];
    for (int i = 0; i < N * 4; i++) {
        node[i] = i;
        for (int r = 0; r < 3; r++) {
            X[i * 3 + r] = i % 4 == r + 1;
            x[i * 3 + r] = X[i * 3 + r] + uniform(-0.1, 0.1);
            // Every cell but a few in the third block of tasks moves little.
            dir[i * 3 + r] = uniform(-1, 1) * (i / 4 % 1024 < 1020 ? 0.01 : 1);
        }
    }
    tss_material m = material_of(TSS_NEO_HOOKEAN, 1e5);
    for (int k = 0; k < 2; k++) {
        tss_host host = tss_host_default();
        tss_ctx ctx;
        tss__elastic *e;
        memset(&ctx, 0, sizeof ctx);
        ctx.host = &host;
        if (k) host.parallel_for = backwards;
        assert_int_equal(tss__elastic_create(&host, 3, N, node, X, &m, NULL, NULL, NULL, &e, NULL),
                         TSS_OK);
        t[k] = tss__elastic_max_step(e, &ctx, x, dir, 1, who + k);
        J[k] = tss__elastic_min_J(e, &host, x, least + k);
        tss__elastic_destroy(e, &host);
    }
    assert_memory_equal(t, t + 1, 8);
    assert_memory_equal(J, J + 1, 8);
    assert_int_equal(who[0], who[1]);
    assert_int_equal(least[0], least[1]);
    assert_true(t[0] < 1 && who[0] >= 0 && J[0] > 0 && J[0] < 1);
    free(X), free(x), free(dir), free(node);
}

static void test_min_J(void **unused) {
    (void)unused;
    for (int d = 2; d <= 3; d++) {
        tss_material m = material_of(TSS_STVK, 1e5);
        scene s;
        scene_create(&s, d, &m);
        set_state(&s, INVERTED);
        int cell, want = 0;
        for (int c = 1; c < CELLS; c++)
            if (det_of(d, s.F + c * d * d) < det_of(d, s.F + want * d * d)) want = c;
        double J = tss__elastic_min_J(s.e, &s.host, s.x, &cell);
        assert_int_equal(cell, want);
        assert_true(fabs(J - det_of(d, s.F + want * d * d)) < 1e-13);
        scene_destroy(&s);
    }
}

static void test_barrier(void **unused) {
    (void)unused;
    for (int d = 2; d <= 3; d++) {
        tss_material m = material_of(TSS_NEO_HOOKEAN, 1e5);
        scene s;
        double out[CELLS];
        scene_create(&s, d, &m);
        set_state(&s, INVERTED);
        tss__elastic_value(s.e, &s.ctx, s.x, all(), out);
        for (int c = 0; c < CELLS; c++) assert_true(out[c] == HUGE_VAL);
        memset(s.x, 0, sizeof s.x);
        tss__elastic_value(s.e, &s.ctx, s.x, all(), out);
        for (int c = 0; c < CELLS; c++) assert_true(out[c] == HUGE_VAL);
        tss_energy_def def = tss__elastic_def(s.e);
        assert_true((def.flags & TSS_ENERGY_J_BARRIER) && def.max_step);
        scene_destroy(&s);
    }
}

// A user's density: Neo-Hookean once more, by the plain formulas.
static void my_density(void *user, int d, int count, const int *cell, const double *F, double *psi,
                       double *P, double *C) {
    const tss_material *m = (const tss_material *)user;
    double mu, la;
    (void)cell;
    tss_lame(m->E, m->nu, &mu, &la);
    for (int k = 0; k < count; k++, F += d * d) {
        double J = det_of(d, F), I[9], n2 = 0, y = log(J);
        for (int i = 0; i < d * d; i++) n2 += F[i] * F[i];
        for (int r = 0; r < d; r++)  // I = F⁻ᵀ
            for (int c = 0; c < d; c++) {
                int a = (r + 1) % 3, b = (r + 2) % 3, p = (c + 1) % 3, q = (c + 2) % 3;
                if (d == 3)
                    I[r * 3 + c] = (F[a * 3 + p] * F[b * 3 + q] - F[a * 3 + q] * F[b * 3 + p]) / J;
                else
                    I[r * 2 + c] = ((r + c) % 2 ? -1 : 1) * F[(1 - r) * 2 + 1 - c] / J;
            }
        if (psi) psi[k] = mu / 2 * (n2 - d) - mu * y + la / 2 * y * y;
        for (int i = 0; i < d * d; i++) {
            if (P) P[k * d * d + i] = mu * (F[i] - I[i]) + la * y * I[i];
            if (C)
                for (int j = 0; j < d * d; j++)
                    C[(k * d * d + i) * d * d + j] =
                        (i == j) * mu + la * I[i] * I[j] +
                        (mu - la * y) * I[j / d * d + i % d] * I[i / d * d + j % d];
        }
    }
}

static void test_custom(void **unused) {
    (void)unused;
    for (int has_C = 0; has_C < 2; has_C++)
        for (int d = 2; d <= 3; d++) {
            const int n = d * (d + 1);
            tss_material m = material_of(TSS_NEO_HOOKEAN, 1e5), u = m;
            scene s, c;
            u.kind = TSS_CUSTOM_MATERIAL, u.density = my_density, u.user = &m, u.has_C = has_C;
            u.barrier = 1;
            uint64_t keep = seed;
            scene_create(&s, d, &m);
            seed = keep;
            scene_create(&c, d, &u);
            const int states[] = {RANDOM, EQUAL, STRETCHED, NEARLY_FLAT};
            for (int w = 0; w < 4; w++)
                for (int psd = 0; psd < 2; psd++) {
                    double a[CELLS * 144], b[CELLS * 144];
                    set_state(&s, states[w]);
                    tss__elastic_value(s.e, &s.ctx, s.x, all(), a);
                    tss__elastic_value(c.e, &c.ctx, s.x, all(), b);
                    for (int i = 0; i < CELLS; i++)
                        assert_true(fabs(a[i] - b[i]) <= 1e-12 * fabs(a[i]));
                    tss__elastic_gradient(s.e, &s.ctx, s.x, all(), a);
                    tss__elastic_gradient(c.e, &c.ctx, s.x, all(), b);
                    double scale = norm(a, CELLS * n);
                    for (int i = 0; i < CELLS * n; i++)
                        assert_true(fabs(a[i] - b[i]) <= 1e-12 * scale);
                    tss__elastic_hessian(s.e, &s.ctx, s.x, all(), psd, a);
                    tss__elastic_hessian(c.e, &c.ctx, s.x, all(), psd, b);
                    scale = norm(a, CELLS * n * n);
                    for (int i = 0; i < CELLS * n * n; i++)
                        assert_true(fabs(a[i] - b[i]) <= (has_C ? 1e-12 : 2e-6) * scale);
                }
            set_state(&s, INVERTED);
            double v[CELLS];
            tss__elastic_value(c.e, &c.ctx, s.x, all(), v);
            assert_true(v[0] == HUGE_VAL);
            assert_non_null(tss__elastic_def(c.e).max_step);
            scene_destroy(&s), scene_destroy(&c);
        }
}

// C's positive part, by Jacobi on C itself: the sum over positive eigenvalues.
static void positive_part(int n, double *C) {
    double T[81], Q[81];
    memcpy(T, C, (size_t)(n * n) * sizeof *T);
    tss__eigen_dense(n, T, Q);
    for (int i = 0; i < n * n; i++) {
        C[i] = 0;
        for (int k = 0; k < n; k++) C[i] += fmax(T[k * n + k], 0) * Q[i / n * n + k] * Q[i % n * n + k];
    }
}

// Clamping between F's principal axes is clamping: any symmetric C, and F at rest but for rounding
// (all axes alike), turned, flat, a line, nothing, inverted. A C that is positive stays as it is.
static void test_custom_clamp(void **unused) {
    (void)unused;
    const double turned[9] = {0, -1, 0, 1, 0, 0, 0, 0, 1};
    for (int d = 2; d <= 3; d++)
        for (int kind = 0; kind < 7; kind++)
            for (int trial = 0; trial < 20; trial++) {
                const int n = d * d;
                double F[9], C[81], D[81], most = 0, size = 0;
                for (int i = 0; i < 9; i++) {
                    double u = uniform(-1, 1), one = i % 4 == 0;
                    F[i] = kind == 0 ? one + 1e-16 * u : kind == 1 ? turned[i] * (1 + 1e-9 * u)
                           : kind == 2 ? (i / 3 < 2) * u : kind == 3 ? (i / 3 == 1) * u
                           : kind == 4 ? 0 : kind == 5 ? one * (i == 4 ? -1 : 1) : u;
                }
                for (int i = 0; i < n; i++)
                    for (int j = 0; j <= i; j++) C[n * i + j] = C[n * j + i] = uniform(-1, 1);
                memcpy(D, C, sizeof C);
                positive_part(n, C);
                tss__custom_clamp(d, F, D);
                for (int i = 0; i < n * n; i++) most = fmax(most, fabs(C[i] - D[i])), size = fmax(size, fabs(C[i]));
                assert_true(most <= 1e-13 * size);
                for (int i = 0; i < n; i++) C[n * i + i] += 1e-3;
                memcpy(D, C, sizeof C);
                tss__custom_clamp(d, F, D);
                assert_memory_equal(C, D, (size_t)(n * n) * sizeof *C);
            }
}

static void test_per_cell(void **unused) {
    (void)unused;
    double E[CELLS], nu[CELLS], v[CELLS], g[CELLS * 12], w, h[12];
    tss_material m = material_of(TSS_NEO_HOOKEAN, 1e5);
    scene s;
    scene_create(&s, 3, &m);
    set_state(&s, RANDOM);
    for (int c = 0; c < CELLS; c++) E[c] = 1e4 * (c + 1), nu[c] = 0.02 * c;
    tss__elastic *e;
    assert_int_equal(tss__elastic_create(&s.host, 3, CELLS, s.node, s.X, &m, E, nu, NULL, &e, NULL),
                     TSS_OK);
    tss__elastic_value(e, &s.ctx, s.x, all(), v);
    tss__elastic_gradient(e, &s.ctx, s.x, all(), g);
    for (int c = 0; c < CELLS; c++) {
        tss__elastic *f;
        m.E = E[c], m.nu = nu[c];
        assert_int_equal(
            tss__elastic_create(&s.host, 3, CELLS, s.node, s.X, &m, NULL, NULL, NULL, &f, NULL),
            TSS_OK);
        tss__elastic_value(f, &s.ctx, s.x, one(c), &w);
        tss__elastic_gradient(f, &s.ctx, s.x, one(c), h);
        assert_memory_equal(&w, v + c, 8);
        assert_memory_equal(h, g + c * 12, sizeof h);
        tss__elastic_destroy(f, &s.host);
    }
    tss__elastic_destroy(e, &s.host);
    scene_destroy(&s);
}

// Uniaxial strain and simple shear of a small cube's worth: the linear limit of every density.
static void test_linear_limit(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        const int n = d * (d + 1);
        double mu, la, H[144];
        scene s;
        tss_lame(m.E, m.nu, &mu, &la);
        scene_create(&s, d, &m);
        set_state(&s, REST);
        tss__elastic_hessian(s.e, &s.ctx, s.x, one(0), 0, H);
        const double vol = d == 3 ? 1.0 / 6 : 0.5;
        assert_true(fabs(H[d * n + d] / vol - (2 * mu + la)) < 1e-9 * m.E);  // dF_00 twice
        assert_true(fabs(H[d * n + 2 * d + 1] / vol - la) < 1e-9 * m.E);     // dF_00, dF_11
        assert_true(fabs(H[(d + 1) * n + d + 1] / vol - mu) < 1e-9 * m.E);   // dF_10 twice
        assert_true(fabs(H[(d + 1) * n + 2 * d] / vol - mu) < 1e-9 * m.E);   // dF_10, dF_01
        scene_destroy(&s);
    }
}

// Every allocation fails in turn; all are given back.
typedef struct counter {
    int left;
    size_t live;
} counter;

static void *count_alloc(size_t bytes, size_t align, void *ctx) {
    counter *c = (counter *)ctx;
    (void)align;
    if (c->left-- <= 0) return NULL;
    c->live += bytes;
    return aligned_alloc(64, (bytes + 63) / 64 * 64);
}

static void count_free(void *ptr, size_t bytes, void *ctx) {
    ((counter *)ctx)->live -= bytes;
    free(ptr);
}

static void test_errors(void **unused) {
    (void)unused;
    tss_material m = material_of(TSS_NEO_HOOKEAN, 1e5);
    scene s;
    tss__elastic *e;
    int bad, flat[4] = {0, 1, 2, 2}, turned[4] = {0, 2, 1, 3};
    scene_create(&s, 3, &m);
    tss_host host = tss_host_default();
    counter count = {0, 0};
    host.alloc = count_alloc, host.free = count_free, host.memory_ctx = &count;
    for (int k = 0; k < 20; k++) {
        count.left = k;
        tss_result r =
            tss__elastic_create(&host, 3, CELLS, s.node, s.X, &m, NULL, NULL, NULL, &e, &bad);
        if (r == TSS_OK) break;
        assert_int_equal(r, TSS_ERROR_NO_MEMORY);
        assert_null(e);
        assert_int_equal(count.live, 0);
    }
    assert_non_null(e);
    tss__elastic_destroy(e, &host);
    assert_int_equal(count.live, 0);
    count.left = 100;
#define CREATE(node, mat) \
    tss__elastic_create(&host, 3, 1, node, s.X, mat, NULL, NULL, NULL, &e, &bad)
    assert_int_equal(CREATE(flat, &m), TSS_ERROR_BAD_MESH);
    assert_int_equal(bad, 0);
    assert_int_equal(CREATE(turned, &m), TSS_ERROR_BAD_MESH);
    tss_material n = m;
    n.nu = 0.5, assert_int_equal(CREATE(s.node, &n), TSS_ERROR_BAD_MATERIAL);
    n = m, n.E = 0, assert_int_equal(CREATE(s.node, &n), TSS_ERROR_BAD_MATERIAL);
    n = m, n.E = nan(""), assert_int_equal(CREATE(s.node, &n), TSS_ERROR_BAD_MATERIAL);
    n = m, n.damping = -1, assert_int_equal(CREATE(s.node, &n), TSS_ERROR_BAD_MATERIAL);
    n = m, n.rho = -1, assert_int_equal(CREATE(s.node, &n), TSS_ERROR_BAD_MATERIAL);
    n = m, n.kind = TSS_CUSTOM_MATERIAL;
    assert_int_equal(CREATE(s.node, &n), TSS_ERROR_BAD_MATERIAL);
    assert_int_equal(CREATE(NULL, &m), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(count.live, 0);
    char text[80];
    tss__elastic_describe(s.e, &s.ctx, 12, text, sizeof text);
    assert_string_equal(text, "tet 12 of body 0 (nodes 48 49 50 51)");
    scene_destroy(&s);
}

// --- thin energies and damping: through the public hook alone ---

// Gradient and Hessian of stencil id by central differences over a sweep of steps.
static void check_energy(const char *what, tss_energy_def *e, const tss_ctx *ctx, const double *x,
                         int nodes, int id, double tol) {
    const int d = ctx->dim, n = e->arity * d, size = nodes * d;
    double g[24], H[24 * 24], y[256], best_g = 1e300, best_H = 1e300;
    tss_stencils list;
    assert_int_equal(e->lists(e->user, ctx, x, NULL, 0, &list), TSS_OK);
    assert_true(size <= 256 && id < list.count);
    const int *node = list.node + id * e->arity;
    e->gradient(e->user, ctx, x, one(id), g);
    e->hessian(e->user, ctx, x, one(id), 0, H);
    int equal = 1;
    for (double step = 1e-2; step > 1e-9; step *= 0.25) {
        double dg[24], dH[24 * 24];
        memcpy(y, x, (size_t)size * sizeof *y);
        for (int j = 0; j < n; j++) {
            double *v = y + node[j / d] * d + j % d, keep = *v, plus, minus, gp[24], gm[24];
            *v = keep + step;
            e->value(e->user, ctx, y, one(id), &plus), e->gradient(e->user, ctx, y, one(id), gp);
            *v = keep - step;
            e->value(e->user, ctx, y, one(id), &minus), e->gradient(e->user, ctx, y, one(id), gm);
            *v = keep;
            dg[j] = (plus - minus) / (2 * step) - g[j];
            for (int i = 0; i < n; i++) dH[i * n + j] = (gp[i] - gm[i]) / (2 * step) - H[i * n + j];
        }
        if (norm(dg, n) > 0 || norm(dH, n * n) > 0) equal = 0;
        best_g = fmin(best_g, norm(dg, n)), best_H = fmin(best_H, norm(dH, n * n));
    }
    best_g /= norm(g, n) + 1e-2 * norm(H, n * n), best_H /= norm(H, n * n);
    if (!(best_g < tol && best_H < tol))
        print_message("%s %d: gradient off %g, Hessian off %g\n", what, id, best_g, best_H);
    assert_true(best_g < tol && best_H < tol);
    assert_false(equal);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++) assert_true(H[i * n + j] == H[j * n + i]);
}

// Projected Hessian: no negative eigenvalue beyond rounding; equal to the exact one where that has
// none.
static void check_psd(tss_energy_def *e, const tss_ctx *ctx, const double *x, int id) {
    const int n = e->arity * ctx->dim;
    double H[24 * 24], C[24 * 24];
    e->hessian(e->user, ctx, x, one(id), 1, H);
    memcpy(C, H, sizeof(double) * (size_t)(n * n));
    clamp_reference(n, C);
    for (int i = 0; i < n * n; i++) assert_true(fabs(C[i] - H[i]) <= 1e-11 * norm(H, n * n));
}

static void check_lists(tss_energy_def *e, const tss_ctx *ctx, const double *x, int count) {
    const int n = e->arity * ctx->dim;
    const size_t bytes = sizeof(double) * (size_t)(count * n * n);
    double *a = (double *)malloc(bytes), *b = (double *)malloc(bytes);
    int list[TSS_BATCH];
    tss_ids whole = {0, count, NULL}, ids = {0, count, list};
    for (int k = 0; k < count; k++) list[k] = (k * 7 + 3) % count;
    e->value(e->user, ctx, x, whole, a), e->value(e->user, ctx, x, ids, b);
    for (int k = 0; k < count; k++) assert_memory_equal(b + k, a + list[k], 8);
    e->gradient(e->user, ctx, x, whole, a), e->gradient(e->user, ctx, x, ids, b);
    for (int k = 0; k < count; k++) assert_memory_equal(b + k * n, a + list[k] * n, 8 * (size_t)n);
    e->hessian(e->user, ctx, x, whole, 1, a), e->hessian(e->user, ctx, x, ids, 1, b);
    for (int k = 0; k < count; k++)
        assert_memory_equal(b + k * n * n, a + list[k] * n * n, 8 * (size_t)(n * n));
    free(a), free(b);
}

#define SHEETS 11
static void test_membrane(void **unused) {
    (void)unused;
    tss_host host = tss_host_default();
    tss_ctx ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.host = &host, ctx.dim = 3;
    for (int kind = 0; kind < 2; kind++) {
        double X[SHEETS * 9], x[SHEETS * 9];
        int node[SHEETS * 3];
        for (int i = 0; i < SHEETS * 9; i++) X[i] = uniform(-1, 1);
        for (int i = 0; i < SHEETS * 3; i++) node[i] = i;
        tss_membrane_def def = tss_membrane_def_default();
        tss_energy_def e;
        def.triangles = SHEETS, def.node = node, def.X = X, def.thickness = 0.01;
        def.material.kind = kind ? TSS_STVK : TSS_NEO_HOOKEAN;
        assert_int_equal(tss_membrane_energy(&host, &def, &e), TSS_OK);
        for (int w = REST; w < INVERTED; w++) {
            if (w == VERY_FLAT) continue;
            // x = F [rest, rotated anywhere in space]: F of the plane from the states above.
            for (int t = 0; t < SHEETS; t++) {
                double F[9];
                state(3, w, F);
                for (int k = 0; k < 3; k++)
                    for (int r = 0; r < 3; r++) {
                        x[t * 9 + k * 3 + r] = 0;
                        for (int m = 0; m < 3; m++)
                            x[t * 9 + k * 3 + r] += F[r * 3 + m] * X[t * 9 + k * 3 + m];
                    }
            }
            for (int t = 0; t < SHEETS; t++) {
                check_energy("membrane", &e, &ctx, x, SHEETS * 3, t,
                             w == NEARLY_FLAT ? 1e-5 : 2e-6);
                check_psd(&e, &ctx, x, t);
            }
            check_lists(&e, &ctx, x, SHEETS);
        }
        // Uniform stretch by s: the closed form.
        const double s = 1.25, mu = 1e5 / 2.8, la = 1e5 * 0.4 / (1 - 0.16);
        double v[SHEETS];
        for (int i = 0; i < SHEETS * 9; i++) x[i] = s * X[i];
        e.value(e.user, &ctx, x, first(SHEETS), v);
        for (int t = 0; t < SHEETS; t++) {
            const double *p = X + t * 9;
            double a[3], b[3], n[3];
            for (int r = 0; r < 3; r++) a[r] = p[3 + r] - p[r], b[r] = p[6 + r] - p[r];
            tss__cross(a, b, n);
            double E = (s * s - 1) / 2, lj = 2 * log(s);
            double psi = kind ? mu * 2 * E * E + la / 2 * 4 * E * E
                              : mu / 2 * (2 * s * s - 2) - mu * lj + la / 2 * lj * lj;
            assert_true(fabs(v[t] - psi * 0.01 * norm(n, 3) / 2) < 1e-11 * v[t]);
        }
        e.destroy(e.user, &host);
    }
    // A triangle without area is refused.
    double X[9] = {0, 0, 0, 1, 1, 1, 2, 2, 2};
    int node[3] = {0, 1, 2};
    tss_membrane_def def = tss_membrane_def_default();
    tss_energy_def e;
    def.triangles = 1, def.node = node, def.X = X;
    assert_int_equal(tss_membrane_energy(&host, &def, &e), TSS_ERROR_BAD_MESH);
    def.material.kind = TSS_LINEAR;
    assert_int_equal(tss_membrane_energy(&host, &def, &e), TSS_ERROR_BAD_MATERIAL);
    node[1] = -1;
    assert_int_equal(tss_membrane_energy(&host, &def, &e), TSS_ERROR_BAD_ARGUMENT);
}

static void test_hinge(void **unused) {
    (void)unused;
    tss_host host = tss_host_default();
    tss_ctx ctx;
    memset(&ctx, 0, sizeof ctx);
    ctx.host = &host, ctx.dim = 3;
    enum { N = 9 };
    double X[N * 12], x[N * 12], rest[N];
    int node[N * 4];
    const double angles[N] = {0, 1e-7, 0.3, -0.3, 1.5, -1.5, 3.0, -3.0, 0.7};
    for (int i = 0; i < N; i++) {
        const double base[12] = {0, 0, 0, 1, 0, 0, 0.4, 0.9, 0, 0.6, -0.7, 0};
        double R[9], fold[12];
        rotation(3, R);
        memcpy(fold, base, sizeof fold);
        // Wing 3 turned about the edge by the angle: up, towards the normals, for a positive one.
        fold[10] = -0.7 * cos(angles[i]), fold[11] = 0.7 * sin(angles[i]);
        for (int k = 0; k < 4; k++) {
            node[i * 4 + k] = i * 4 + k;
            for (int r = 0; r < 3; r++) {
                X[i * 12 + k * 3 + r] = base[k * 3 + r];
                x[i * 12 + k * 3 + r] = 0.2 * r;
                for (int m = 0; m < 3; m++) x[i * 12 + k * 3 + r] += R[r * 3 + m] * fold[k * 3 + m];
            }
        }
        rest[i] = i == 8 ? -0.5 : 0.1;
    }
    for (int own = 0; own < 2; own++) {
        tss_hinge_def def = tss_hinge_def_default();
        tss_energy_def e;
        double v[N];
        def.hinges = N, def.node = node, def.X = X, def.stiffness = 2;
        if (own) def.rest_angle = rest;
        assert_int_equal(tss_hinge_energy(&host, &def, &e), TSS_OK);
        e.value(e.user, &ctx, x, first(N), v);
        for (int i = 0; i < N; i++) {
            // Areas 0.45 and 0.35, edge 1.
            const double t = angles[i] - (own ? rest[i] : 0), w = 2 * 3 / 0.8;
            const double turn = t > 3.14159265358979323846 ? t - 2 * 3.14159265358979323846 : t < -3.14159265358979323846 ? t + 2 * 3.14159265358979323846 : t;
            assert_true(fabs(v[i] - 0.5 * w * turn * turn) <= 1e-12 + 1e-12 * v[i]);
            check_energy("hinge", &e, &ctx, x, N * 4, i, 1e-6);
            check_psd(&e, &ctx, x, i);
        }
        check_lists(&e, &ctx, x, N);
        e.destroy(e.user, &host);
    }
    tss_hinge_def def = tss_hinge_def_default();
    tss_energy_def e;
    int flat[4] = {0, 1, 1, 2};
    def.hinges = 1, def.node = flat, def.X = X;
    assert_int_equal(tss_hinge_energy(&host, &def, &e), TSS_ERROR_BAD_MESH);
}

static void test_spring(void **unused) {
    (void)unused;
    tss_host host = tss_host_default();
    for (int d = 2; d <= 3; d++) {
        tss_ctx ctx;
        enum { N = 9 };
        double X[N * 6], x[N * 6], L[N], k[N];
        int node[N * 2];
        memset(&ctx, 0, sizeof ctx);
        ctx.host = &host, ctx.dim = d;
        for (int i = 0; i < N * 2 * d; i++) X[i] = uniform(-1, 1), x[i] = uniform(-1, 1);
        for (int i = 0; i < N; i++) L[i] = i ? uniform(0, 2) : 0, k[i] = uniform(1, 9);
        for (int i = 0; i < 2 * N; i++) node[i] = i;
        tss_spring_def def = tss_spring_def_default();
        tss_energy_def e;
        def.dim = d, def.springs = N, def.node = node, def.rest_length = L, def.stiffnesses = k;
        assert_int_equal(tss_spring_energy(&host, &def, &e), TSS_OK);
        for (int i = 0; i < N; i++)
            check_energy("spring", &e, &ctx, x, 2 * N, i, 1e-6), check_psd(&e, &ctx, x, i);
        check_lists(&e, &ctx, x, N);
        e.destroy(e.user, &host);
        // At rest by X: no energy, no force.
        double v[N], g[N * 6];
        def.rest_length = NULL, def.X = X;
        assert_int_equal(tss_spring_energy(&host, &def, &e), TSS_OK);
        e.value(e.user, &ctx, X, first(N), v);
        e.gradient(e.user, &ctx, X, first(N), g);
        for (int i = 0; i < N; i++) assert_true(v[i] == 0);
        for (int i = 0; i < N * 2 * d; i++) assert_true(g[i] == 0);
        e.destroy(e.user, &host);
        k[3] = 0;
        assert_int_equal(tss_spring_energy(&host, &def, &e), TSS_ERROR_BAD_MATERIAL);
    }
}

static void test_damping(void **unused) {
    (void)unused;
    FOR_ALL(kind, d) {
        tss_material m = material_of(kind, 1e5);
        const int n = d * (d + 1);
        double xt[CELLS * 12], x[CELLS * 12], H[CELLS * 144], H2[CELLS * 144], v[CELLS],
            g[CELLS * 12];
        scene s;
        tss_energy_def e;
        m.damping = 0.02;
        scene_create(&s, d, &m);
        assert_int_equal(tss__damping_create(&s.host, s.e, &e), TSS_OK);
        set_state(&s, RANDOM);
        memcpy(xt, s.x, sizeof xt);
        s.ctx.x_t = xt, s.ctx.h = 0.005;
        assert_int_equal(e.begin_step(e.user, &s.ctx), TSS_OK);
        e.value(e.user, &s.ctx, xt, all(), v), e.gradient(e.user, &s.ctx, xt, all(), g);
        for (int c = 0; c < CELLS; c++) assert_true(v[c] == 0);
        for (int i = 0; i < CELLS * n; i++) assert_true(g[i] == 0);
        for (int i = 0; i < CELLS * n; i++) x[i] = xt[i] + uniform(-0.1, 0.1);
        // The elastic Hessian of x_t, times damping/h, gives all three.
        tss__elastic_hessian(s.e, &s.ctx, xt, all(), 1, H);
        e.hessian(e.user, &s.ctx, x, all(), 1, H2);
        e.value(e.user, &s.ctx, x, all(), v), e.gradient(e.user, &s.ctx, x, all(), g);
        for (int c = 0; c < CELLS; c++) {
            double sum = 0, scale = 4 * norm(H + c * n * n, n * n);
            for (int i = 0; i < n; i++) {
                double f = 0;
                for (int j = 0; j < n; j++) {
                    const int at = c * n * n + i * n + j;
                    assert_true(fabs(4 * H[at] - H2[at]) <= 1e-12 * scale);
                    f += 4 * H[at] * (x[c * n + j] - xt[c * n + j]);
                }
                assert_true(fabs(f - g[c * n + i]) <= 1e-12 * scale);
                sum += 0.5 * f * (x[c * n + i] - xt[c * n + i]);
            }
            assert_true(fabs(sum - v[c]) <= 1e-12 * scale && v[c] >= 0);
        }
        check_lists(&e, &s.ctx, x, CELLS);
        // Shift and turn by a velocity field: a rigid velocity is not damped.
        for (int i = 0; i < CELLS * n; i++) x[i] = xt[i] + 0.1;
        e.value(e.user, &s.ctx, x, all(), v);
        for (int c = 0; c < CELLS; c++) assert_true(v[c] < 1e-20 * m.E);
        e.destroy(e.user, &s.host);
        scene_destroy(&s);
    }
}

int main(void) {
    print_message("seed %llu\n", (unsigned long long)seed);
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_logarithm),  cmocka_unit_test(test_values),
        cmocka_unit_test(test_gradients),  cmocka_unit_test(test_hessians),
        cmocka_unit_test(test_projection), cmocka_unit_test(test_rigid_motion),
        cmocka_unit_test(test_lists),      cmocka_unit_test(test_stiff),
        cmocka_unit_test(test_filter),     cmocka_unit_test(test_min_J),
        cmocka_unit_test(test_barrier),    cmocka_unit_test(test_custom),
        cmocka_unit_test(test_custom_clamp),
        cmocka_unit_test(test_per_cell),   cmocka_unit_test(test_linear_limit),
        cmocka_unit_test(test_errors),     cmocka_unit_test(test_membrane),
        cmocka_unit_test(test_hinge),      cmocka_unit_test(test_spring),
        cmocka_unit_test(test_damping),    cmocka_unit_test(test_order),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
