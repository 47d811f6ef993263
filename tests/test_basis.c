// Bases of a body: eigenfunctions against cosines and against a dense Jacobi eigensolver written
// here, on matrices assembled here; orthonormality, partition of unity and optimality by plain
// sums; bits under threads, scaling and the cache.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_io.h"
#include "tss_shapes.h"
#ifndef TSS_BASES_FRAGMENT
#include "tss_subspace.h"
#else
#include "sub_bases.h"
#endif

static const double PI = 3.14159265358979323846;

static uint64_t rng_state = 88172645463325252ull;
static double rnd(void) {  // xorshift64, in (−1, 1)
    rng_state ^= rng_state << 13, rng_state ^= rng_state >> 7, rng_state ^= rng_state << 17;
    return (double)(rng_state >> 11) / 4503599627370496.0 - 1;
}

static double *doubles(int count) {
    double *p = (double *)calloc((size_t)count + 1, sizeof *p);
    assert_non_null(p);
    return p;
}

// ---- bodies ---------------------------------------------------------------------------------

typedef struct body {
    tss_host host;
    int dim, nodes, cells;
    int *cell;
    double *X, *mass, *mu, *lambda;
    uint8_t *fixed;
} body;

// Gradients of the hat functions by Cramer's rule from the inverse of the edge matrix.
static double gradients(const body *b, int k, double g[4][3]) {
    double a[3][6];
    int d = b->dim;
    const int *c = b->cell + k * (d + 1);
    double det = 1;
    for (int i = 0; i < d; i++)
        for (int j = 0; j < d; j++) {
            a[i][j] = b->X[c[i + 1] * d + j] - b->X[c[0] * d + j];
            a[i][d + j] = i == j;
        }
    for (int p = 0; p < d; p++) {  // Gauss–Jordan with row exchange
        int best = p;
        for (int i = p + 1; i < d; i++) best = fabs(a[i][p]) > fabs(a[best][p]) ? i : best;
        if (best != p) det = -det;
        for (int j = 0; j < 2 * d; j++) {
            double t = a[p][j];
            a[p][j] = a[best][j], a[best][j] = t;
        }
        det *= a[p][p];
        for (int j = 2 * d - 1; j >= p; j--) a[p][j] /= a[p][p];
        for (int i = 0; i < d; i++)
            for (int j = 2 * d - 1; i != p && j >= p; j--) a[i][j] -= a[i][p] * a[p][j];
    }
    for (int j = 0; j < d; j++) {
        g[0][j] = 0;
        for (int i = 0; i < d; i++) g[i + 1][j] = a[j][d + i], g[0][j] -= a[j][d + i];
    }
    return fabs(det) / (d == 3 ? 6 : 2);
}

static body body_of(int dim, int nodes, const double *x3, int cells, const int *cell, double E,
                    double nu, double rho) {
    body b;
    memset(&b, 0, sizeof b);
    b.host = tss_host_default(), b.host.workers = 1;
    b.dim = dim, b.nodes = nodes, b.cells = cells;
    b.X = doubles(nodes * dim), b.mass = doubles(nodes);
    b.mu = doubles(cells), b.lambda = doubles(cells);
    b.cell = (int *)calloc((size_t)(cells * (dim + 1)), sizeof(int));
    b.fixed = (uint8_t *)calloc((size_t)nodes, 1);
    assert_true(b.cell && b.fixed);
    memcpy(b.cell, cell, (size_t)(cells * (dim + 1)) * sizeof(int));
    for (int i = 0; i < nodes; i++)
        for (int a = 0; a < dim; a++) b.X[i * dim + a] = x3[3 * i + a];
    for (int k = 0; k < cells; k++) {
        double g[4][3], v = gradients(&b, k, g);
        tss_lame(E, nu, &b.mu[k], &b.lambda[k]);
        for (int a = 0; a <= dim; a++) b.mass[b.cell[k * (dim + 1) + a]] += rho * v / (dim + 1);
    }
    return b;
}

static body box(double lx, double ly, double lz, int nx, int ny, int nz, double nu) {
    tss_mesh m;
    double lo[3] = {0, 0, 0}, hi[3] = {lx, ly, lz};
    int n[3] = {nx, ny, nz};
    assert_int_equal(tss_shape_box(NULL, lo, hi, n, 6, NULL, &m), TSS_OK);
    body b = body_of(3, m.nodes, m.x, m.tets, m.tet, 1e5, nu, 1000);
    tss_mesh_free(&m);
    return b;
}

static body rectangle(double lx, double ly, int nx, int ny, double nu) {
    tss_mesh m;
    double lo[2] = {0, 0}, hi[2] = {lx, ly};
    assert_int_equal(tss_shape_rectangle(NULL, lo, hi, nx, ny, &m), TSS_OK);
    body b = body_of(2, m.nodes, m.x, m.triangles, m.triangle, 1e5, nu, 1000);
    tss_mesh_free(&m);
    return b;
}

// `count` copies side by side, 10 m apart.
static body copies(const body *one, int count) {
    int n = one->nodes, m = one->cells, s = one->dim + 1;
    double *x = doubles(3 * n * count);
    int *cell = (int *)calloc((size_t)(m * s * count), sizeof(int));
    for (int c = 0; c < count; c++) {
        for (int i = 0; i < n; i++)
            for (int a = 0; a < one->dim; a++)
                x[3 * (c * n + i) + a] = one->X[i * one->dim + a] + (a == 0 ? 10.0 * c : 0);
        for (int k = 0; k < m * s; k++) cell[c * m * s + k] = one->cell[k] + c * n;
    }
    body b = body_of(one->dim, n * count, x, m * count, cell, 1e5, 0.3, 1000);
    free(x), free(cell);
    return b;
}

static void drop(body *b) {
    free(b->cell), free(b->X), free(b->mass), free(b->mu), free(b->lambda), free(b->fixed);
}

static tss__sub_mesh view(const body *b) {
    tss__sub_mesh m;
    memset(&m, 0, sizeof m);
    m.host = &b->host, m.dim = b->dim, m.nodes = b->nodes, m.cells = b->cells, m.cell = b->cell;
    m.X = b->X, m.mass = b->mass, m.mu = b->mu, m.lambda = b->lambda, m.fixed = b->fixed;
    return m;
}

static tss__basis build(const body *b, tss_basis_def d) {
    tss__sub_mesh m = view(b);
    tss__basis out;
    char error[240] = "";
    tss_result r = tss__basis_build(&m, &d, &out, error, sizeof error);
    if (r != TSS_OK) print_message("%s\n", error);
    assert_int_equal(r, TSS_OK);
    return out;
}

static void expect(const body *b, tss_basis_def d, tss_result want, const char *words) {
    tss__sub_mesh m = view(b);
    tss__basis out;
    char error[240] = "";
    assert_int_equal(tss__basis_build(&m, &d, &out, error, sizeof error), want);
    if (!strstr(error, words)) fail_msg("\"%s\" does not say \"%s\"", error, words);
    assert_true(!out.value && !out.weight && !out.first && out.bytes == 0);
    assert_int_equal(tss__basis_build(&m, &d, &out, NULL, 0), want);
}

// ---- dense reference ------------------------------------------------------------------------

// K of the Laplacian (elastic 0; weighted by the cells if asked) or of elasticity, dense, here.
static double *dense_stiffness(const body *b, int elastic, int weighted) {
    int d = elastic ? b->dim : 1, N = b->nodes * d, s = b->dim + 1;
    double *K = doubles(N * N), g[4][3];
    for (int k = 0; k < b->cells; k++) {
        double v = gradients(b, k, g), mu = b->mu[k], la = b->lambda[k];
        double kappa = weighted ? la + (b->dim == 3 ? 4 : 3) * mu : 1;
        for (int p = 0; p < s; p++)
            for (int q = 0; q < s; q++) {
                int i = b->cell[k * s + p], j = b->cell[k * s + q];
                double dot = 0;
                for (int a = 0; a < b->dim; a++) dot += g[p][a] * g[q][a];
                if (!elastic) K[i + j * N] += v * kappa * dot;
                for (int a = 0; elastic && a < d; a++)
                    for (int c = 0; c < d; c++)
                        K[i * d + a + (j * d + c) * N] +=
                            v * (la * g[p][a] * g[q][c] + mu * g[p][c] * g[q][a] +
                                 (a == c ? mu * dot : 0));
            }
    }
    return K;
}

// Eigenvalues of a symmetric matrix by cyclic Jacobi rotations, ascending.
static void jacobi(int n, double *A, double *value) {
    for (int sweep = 0; sweep < 60; sweep++) {
        double off = 0, all = 0;
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) {
                all += A[i + j * n] * A[i + j * n];
                if (i != j) off += A[i + j * n] * A[i + j * n];
            }
        if (off <= 1e-30 * all) break;
        for (int p = 0; p < n; p++)
            for (int q = p + 1; q < n; q++) {
                if (A[p + q * n] == 0) continue;
                double z = (A[q + q * n] - A[p + p * n]) / (2 * A[p + q * n]);
                double t = (z < 0 ? -1 : 1) / (fabs(z) + sqrt(z * z + 1));
                double c = 1 / sqrt(t * t + 1), s = t * c;
                for (int k = 0; k < n; k++) {
                    double x = A[k + p * n], y = A[k + q * n];
                    A[k + p * n] = c * x - s * y, A[k + q * n] = s * x + c * y;
                }
                for (int k = 0; k < n; k++) {
                    double x = A[p + k * n], y = A[q + k * n];
                    A[p + k * n] = c * x - s * y, A[q + k * n] = s * x + c * y;
                }
            }
    }
    for (int i = 0; i < n; i++) value[i] = A[i + i * n];
    for (int i = 0; i < n; i++)
        for (int j = i; j > 0 && value[j] < value[j - 1]; j--) {
            double t = value[j];
            value[j] = value[j - 1], value[j - 1] = t;
        }
}

// Eigenvalues of K u = λ M u on the free unknowns; returns how many.
static int dense_values(const body *b, int d, const double *K, double *value) {
    int N = b->nodes * d, n = 0;
    int *map = (int *)calloc((size_t)N, sizeof(int));
    for (int i = 0; i < N; i++)
        if (!b->fixed[i / d]) map[n++] = i;
    double *A = doubles(n * n);
    for (int i = 0; i < n; i++)
        for (int j = 0; j < n; j++)
            A[i + j * n] = K[map[i] + map[j] * N] / sqrt(b->mass[map[i] / d] * b->mass[map[j] / d]);
    jacobi(n, A, value);
    free(A), free(map);
    return n;
}

static int by_value(const void *a, const void *b) {
    double x = *(const double *)a, y = *(const double *)b;
    return (x > y) - (x < y);
}

// ---- eigenfunctions -------------------------------------------------------------------------

// (π²/ρ) Σ (k_a / L_a)² of a box without supports, ascending.
static int cosines(const double *L, double *value) {
    int count = 0;
    for (int i = 0; i < 8; i++)
        for (int j = 0; j < 8; j++)
            for (int k = 0; k < 8; k++)
                value[count++] = PI * PI / 1000 *
                                 (i * i / (L[0] * L[0]) + j * j / (L[1] * L[1]) +
                                  k * k / (L[2] * L[2]));
    qsort(value, (size_t)count, sizeof *value, by_value);
    return count;
}

static void test_box(void **state) {
    (void)state;
    double L[3] = {1, 0.7, 0.45}, exact[512], error[2][12];
    cosines(L, exact);
    for (int r = 0; r < 2; r++) {
        body b = box(L[0], L[1], L[2], 10 << r, 8 << r, 6 << r, 0.3);
        tss__basis s = build(&b, tss_basis_skinning(12));
        assert_int_equal(s.blocks, 13);
        assert_int_equal(s.initial, 6);
        assert_true(s.eigenvalue[0] == 0 && s.residual <= 1e-8);
        for (int k = 0; k < 12; k++) error[r][k] = fabs(s.eigenvalue[k + 1] / exact[k + 1] - 1);
        tss__basis_free(&b.host, &s);
        drop(&b);
    }
    for (int k = 0; k < 12; k++) assert_true(error[1][k] < 0.02);
    // Second order: a quarter of the error (higher ones lie so close together that they mix).
    for (int k = 0; k < 6; k++)
        assert_true(error[0][k] / error[1][k] > 3.6 && error[0][k] / error[1][k] < 4.4);
}

static void test_rod(void **state) {
    (void)state;
    // Free rod, ν = 0: longitudinal modes (kπ/L)² E/ρ, and (2/h)² sin²(kπh/2L) E/ρ of a chain of
    // lumped masses h apart; among the bending modes, those whose motion is along the axis.
    for (int dim = 2; dim <= 3; dim++) {
        body b = dim == 2 ? rectangle(1, 0.05, 40, 2, 0) : box(1, 0.05, 0.05, 40, 2, 2, 0);
        tss__basis s = build(&b, tss_basis_eigen(dim == 2 ? 20 : 30));
        int rigid = dim == 2 ? 3 : 6, found = 0, n = b.nodes;
        for (int k = 0; k < s.blocks; k++) {
            double axial = 0, total = 0;
            for (int i = 0; i < n * dim; i++) {
                double u = s.value[i * s.columns + k];
                total += b.mass[i / dim] * u * u;
                if (i % dim == 0) axial += b.mass[i / dim] * u * u;
            }
            assert_true(fabs(total / s.mass - 1) < 1e-12);
            assert_true(k < rigid ? s.eigenvalue[k] == 0 : s.eigenvalue[k] > 0);
            if (k < rigid || axial < 0.9 * total) continue;
            found++;
            double exact = found * PI * found * PI * 100, wave = 80 * sin(found * PI / 80);
            assert_true(fabs(s.eigenvalue[k] / (wave * wave * 100) - 1) < 0.005);
            assert_true(found > 2 || fabs(s.eigenvalue[k] / exact - 1) < 0.005);
        }
        assert_true(found >= 2);
        // Rigid: no edge changes its length to first order.
        for (int c = 0; c < b.cells; c++)
            for (int p = 0; p <= dim; p++)
                for (int k = 0; k < rigid; k++) {
                    int i = b.cell[c * (dim + 1)], j = b.cell[c * (dim + 1) + p];
                    double stretch = 0;
                    for (int a = 0; a < dim; a++)
                        stretch += (b.X[i * dim + a] - b.X[j * dim + a]) *
                                   (s.value[(i * dim + a) * s.columns + k] -
                                    s.value[(j * dim + a) * s.columns + k]);
                    assert_true(fabs(stretch) < 1e-13);
                }
        tss__basis_free(&b.host, &s);
        drop(&b);
    }
}

// Largest ‖K u − λ M u‖ / (‖K‖ ‖u‖) of the columns, and their M-orthonormality.
static void check_pairs(const body *b, int d, const double *K, const double *U, int columns,
                        const double *lambda, const tss__basis *s) {
    int N = b->nodes * d;
    double norm = 0;
    for (int i = 0; i < N * N; i++) norm = fmax(norm, fabs(K[i]));
    for (int k = 0; k < columns; k++) {
        double worst = 0, largest = 0;
        for (int i = 0; i < N; i++) {
            double r = -lambda[k] * b->mass[i / d] * U[i * columns + k];
            for (int j = 0; j < N; j++) r += K[i + j * N] * U[j * columns + k];
            if (!b->fixed[i / d]) worst = fmax(worst, fabs(r));
            if (b->fixed[i / d]) assert_true(U[i * columns + k] == 0);
            largest = fmax(largest, fabs(U[i * columns + k]));
        }
        assert_true(worst < 1e-9 * norm * largest);
        for (int l = 0; l <= k; l++) {
            double dot = 0;
            for (int i = 0; i < N; i++)
                dot += b->mass[i / d] * U[i * columns + k] * U[i * columns + l];
            assert_true(fabs(dot / s->mass - (k == l)) < 1e-12);
        }
    }
}

static void check_dense(body *b, int elastic, int weighted, int count) {
    int d = elastic ? b->dim : 1;
    double *K = dense_stiffness(b, elastic, weighted), *value = doubles(b->nodes * d);
    int n = dense_values(b, d, K, value), any = 0;
    for (int i = 0; i < b->nodes; i++) any |= b->fixed[i];
    if (!count) count = n - (!elastic && !any);
    tss_basis_def def = elastic ? tss_basis_eigen(count) : tss_basis_skinning(count);
    def.heterogeneous = weighted;
    tss__basis s = build(b, def);
    assert_int_equal(s.blocks, count + (!elastic && !any));
    for (int k = 0; k < s.blocks; k++)
        assert_true(fabs(s.eigenvalue[k] - value[k]) < 1e-9 * value[k] + 1e-12 * value[n - 1]);
    check_pairs(b, d, K, elastic ? s.value : s.weight, s.blocks, s.eigenvalue, &s);
    tss__basis_free(&b->host, &s);
    free(K), free(value);
}

static void test_dense(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int held = 0; held < 4; held++) {
            body b = dim == 2 ? rectangle(1, 0.6, 6, 5, 0.3) : box(1, 0.8, 0.6, 3, 3, 2, 0.3);
            for (int k = 0; k < b.cells; k++) {
                double f = pow(10, rnd());
                b.mu[k] *= f, b.lambda[k] *= f;
            }
            // None; one node (rotations stay free); a few; half.
            for (int i = 0; i < b.nodes; i++)
                b.fixed[i] = held == 1 ? i == 0 : held == 2 ? i % 9 == 0 : held == 3 && i % 2 == 0;
            check_dense(&b, 0, 0, 5), check_dense(&b, 0, 1, 5), check_dense(&b, 0, 1, 0);
            check_dense(&b, 1, 0, 9), check_dense(&b, 1, 0, 0);
            drop(&b);
        }
}

static void test_many_modes(void **state) {
    (void)state;
    // A cube: every eigenvalue of the continuum comes in up to six copies; dense reference.
    body b = box(1, 1, 1, 5, 5, 5, 0.3);
    check_dense(&b, 0, 0, 64);
    drop(&b);
}

static void test_pieces(void **state) {
    (void)state;
    body one = box(1, 1.1, 1.2, 2, 2, 2, 0.3), b = copies(&one, 20);
    double *K = dense_stiffness(&one, 0, 0), value[27];
    assert_int_equal(dense_values(&one, 1, K, value), 27);
    // 20 constants (one the constant), then each eigenvalue of one box twenty times.
    tss__basis s = build(&b, tss_basis_skinning(64));
    for (int k = 0; k < 65; k++) {
        double want = k < 20 ? 0 : value[k / 20];
        assert_true(fabs(s.eigenvalue[k] - want) < 1e-9 * value[1]);
    }
    for (int k = 0; k < 20; k++)  // constant on each piece, orthogonal to those before
        for (int i = 0; i < b.nodes; i++)
            assert_true(s.weight[i * 65 + k] == s.weight[i / one.nodes * one.nodes * 65 + k]);
    for (int k = 0; k < 20; k++)
        for (int l = 0; l <= k; l++) {
            double dot = 0;
            for (int i = 0; i < b.nodes; i++)
                dot += b.mass[i] * s.weight[i * 65 + k] * s.weight[i * 65 + l];
            assert_true(fabs(dot / s.mass - (k == l)) < 1e-12);
        }
    tss__basis_free(&b.host, &s);
    s = build(&b, tss_basis_eigen(130));
    for (int k = 0; k < 130; k++) assert_true(k < 120 ? s.eigenvalue[k] == 0 : s.eigenvalue[k] > 1);
    tss__basis_free(&b.host, &s);
    // Fewer asked for than there are constants.
    s = build(&b, tss_basis_skinning(3));
    for (int k = 0; k < 4; k++) assert_true(s.eigenvalue[k] == 0);
    tss__basis_free(&b.host, &s);
    // One piece held: 19 constants, none on it.
    b.fixed[4] = 1;
    s = build(&b, tss_basis_skinning(20));
    assert_int_equal(s.blocks, 20);
    for (int k = 0; k < 20; k++) assert_true(k < 19 ? s.eigenvalue[k] == 0 : s.eigenvalue[k] > 0);
    for (int k = 0; k < 19; k++) assert_true(s.weight[k] == 0);
    tss__basis_free(&b.host, &s);
    expect(&b, tss_basis_biharmonic(18), TSS_ERROR_BAD_ARGUMENT, "19 pieces");
    s = build(&b, tss_basis_biharmonic(25));
    int seen[20] = {0};
    for (int k = 0; k < 25; k++) seen[s.handle[k] / one.nodes]++;
    for (int p = 0; p < 20; p++) assert_true(p == 0 || seen[p] >= 1);
    tss__basis_free(&b.host, &s);
    free(K), drop(&b), drop(&one);
}

// More copies of an eigenvalue than a block of the eigensolver has columns: the lowest of one box
// fifteen times, of which sixteen functions behind the constants take all, and one of the next.
static void test_copies(void **state) {
    (void)state;
    body one = box(1, 1.1, 1.2, 5, 5, 5, 0.3), b = copies(&one, 15);
    double *K = dense_stiffness(&one, 0, 0), *value = doubles(one.nodes);
    dense_values(&one, 1, K, value);
    tss__basis s = build(&b, tss_basis_skinning(14 + 16));
    for (int k = 0; k <= 30; k++)
        assert_true(fabs(s.eigenvalue[k] - value[k / 15]) < 1e-9 * value[1]);
    tss__basis_free(&b.host, &s);
    s = build(&b, tss_basis_skinning(14 + 10));
    for (int k = 0; k <= 24; k++)
        assert_true(fabs(s.eigenvalue[k] - value[k / 15]) < 1e-9 * value[1]);
    tss__basis_free(&b.host, &s);
    free(K), free(value), drop(&b), drop(&one);
}

// ---- blocks ---------------------------------------------------------------------------------

static void check_orthonormal(const body *b, const tss__basis *s, int dropped) {
    int columns = s->columns, zero = 0;
    double *f = doubles(b->nodes * columns);
    int *all = (int *)calloc((size_t)s->blocks, sizeof(int));
    for (int k = 0; k < s->blocks; k++) all[k] = k;
    tss__basis_rows(s, b->X, b->dim, NULL, b->nodes, all, s->blocks, f, columns);
    for (int k = 0; k < s->blocks; k++)
        for (int p = s->first[k]; p < s->first[k + 1]; p++)
            for (int q = s->first[k]; q <= p; q++) {
                double dot = 0;
                for (int i = 0; i < b->nodes; i++)
                    dot += b->mass[i] * f[i * columns + p] * f[i * columns + q];
                if (p == q && dot == 0) zero++;
                else assert_true(fabs(dot / s->mass - (p == q)) < 1e-10);
            }
    for (int i = 0; i < b->nodes; i++)
        for (int p = 0; b->fixed[i] && p < columns; p++) assert_true(f[i * columns + p] == 0);
    assert_int_equal(zero, dropped);
    free(f), free(all);
}

static void test_blocks(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++)
        for (int held = 0; held < 2; held++) {
            body b = dim == 2 ? rectangle(1, 0.6, 8, 5, 0.3) : box(1, 0.8, 0.6, 4, 3, 3, 0.3);
            for (int i = 0; i < b.nodes * dim; i++) b.X[i] += i % dim ? -300 : 1000;
            for (int i = 0; held && i < b.nodes; i++) b.fixed[i] = i % 7 == 0;
            tss__basis s = build(&b, tss_basis_affine());
            assert_int_equal(s.columns, dim + 1);
            check_orthonormal(&b, &s, 0);
            // Every function is affine: the third order differences along a line of nodes vanish.
            int at[3] = {0, 1, 2}, block = 0;
            double f[3][4];
            if (!held) tss__basis_rows(&s, b.X, dim, at, 3, &block, 1, f[0], 4);
            for (int k = 0; !held && k <= dim; k++)
                assert_true(fabs(f[0][k] - 2 * f[1][k] + f[2][k]) < 1e-10);
            tss__basis_free(&b.host, &s);
            s = build(&b, tss_basis_quadratic());
            assert_int_equal(s.columns, dim == 2 ? 6 : 10);
            assert_int_equal(s.initial, 2);
            check_orthonormal(&b, &s, 0);
            tss__basis_free(&b.host, &s);
            s = build(&b, tss_basis_skinning(10));
            check_orthonormal(&b, &s, 0);
            // Kept as weights: n × blocks doubles and little else.
            size_t weights = 8u * (size_t)(b.nodes * s.blocks);
            assert_true(s.bytes < weights + 200u * (size_t)s.blocks + 100u);
            tss__basis_free(&b.host, &s);
            drop(&b);
        }
    // Two free nodes carry two of the four affine functions.
    body b = box(1, 1, 1, 1, 1, 1, 0.3);
    for (int i = 2; i < 8; i++) b.fixed[i] = 1;
    tss__basis s = build(&b, tss_basis_affine());
    check_orthonormal(&b, &s, 2);
    tss__basis_free(&b.host, &s), drop(&b);
}

// A quadratic basis holds every product of coordinates: project one and look at what is left.
static void test_quadratic(void **state) {
    (void)state;
    body b = box(1, 0.8, 0.6, 4, 3, 3, 0.3);
    tss__basis s = build(&b, tss_basis_quadratic());
    int n = b.nodes, cols = s.columns;
    double *G = doubles(cols * cols), *rhs = doubles(cols), left = 0;
    for (int p = 0; p < cols; p++)
        for (int i = 0; i < n; i++) {
            const double *x = b.X + 3 * i;
            rhs[p] += s.value[i * cols + p] * (x[0] * x[1] - 3 * x[2] * x[2] + x[1]);
            for (int q = 0; q < cols; q++)
                G[p + q * cols] += s.value[i * cols + p] * s.value[i * cols + q];
        }
    assert_int_equal(tss_dense_chol_factor(cols, G, cols, NULL), TSS_OK);
    tss_dense_chol_solve(cols, G, cols, rhs, cols, 1);
    for (int i = 0; i < n; i++) {
        const double *x = b.X + 3 * i;
        double f = x[0] * x[1] - 3 * x[2] * x[2] + x[1];
        for (int p = 0; p < cols; p++) f -= s.value[i * cols + p] * rhs[p];
        left = fmax(left, fabs(f));
    }
    assert_true(left < 1e-12);
    free(G), free(rhs);
    tss__basis_free(&b.host, &s), drop(&b);
}

// ---- biharmonic -----------------------------------------------------------------------------

static void test_biharmonic(void **state) {
    (void)state;
    for (int held = 0; held < 2; held++) {
        body b = box(1, 0.8, 0.6, 5, 4, 3, 0.3);
        int n = b.nodes, H = 12;
        for (int i = 0; held && i < n; i++) b.fixed[i] = b.X[3 * i] == 0;
        tss__basis s = build(&b, tss_basis_biharmonic(H));
        double *L = dense_stiffness(&b, 0, 0), worst = 0;
        assert_int_equal(s.initial, H);
        for (int i = 0; i < n; i++) {
            double sum = 0;
            for (int k = 0; k < H; k++) {
                double w = s.value[i * H + k] / s.value[s.handle[k] * H + k];
                sum += w;
                for (int j = 0; j < H; j++)
                    if (s.handle[j] == i) assert_true(w == (j == k));
                if (b.fixed[i]) assert_true(w == 0);
            }
            worst = fmax(worst, fabs(sum - 1));
        }
        // 1 is of no energy and takes the values of the sum at the handles: they are the same.
        assert_true(held ? worst > 0.1 : worst < 1e-10);
        // Optimal: the energy's derivative at every node but handles and fixed ones is 0.
        for (int k = 0; k < H; k++) {
            double *Lw = doubles(n), *Q = doubles(n), scale = 0;
            for (int j = 0; j < n; j++)
                for (int i = 0; i < n; i++) Lw[i] += L[i + j * n] * s.value[j * H + k];
            for (int j = 0; j < n; j++)
                for (int i = 0; i < n; i++) Q[i] += L[i + j * n] * Lw[j] / b.mass[j];
            for (int i = 0; i < n; i++) scale = fmax(scale, fabs(Q[i]));
            for (int i = 0; i < n; i++) {
                int free_node = !b.fixed[i];
                for (int j = 0; j < H; j++) free_node &= s.handle[j] != i;
                if (free_node) assert_true(fabs(Q[i]) < 1e-10 * scale);
            }
            free(Lw), free(Q);
        }
        check_orthonormal(&b, &s, 0);
        free(L), tss__basis_free(&b.host, &s), drop(&b);
    }
    // A handle at every node: each function is its own node.
    body b = rectangle(1, 1, 2, 2, 0.3);
    tss__basis s = build(&b, tss_basis_biharmonic(b.nodes));
    for (int i = 0; i < b.nodes; i++)
        for (int k = 0; k < b.nodes; k++)
            assert_true((s.value[i * b.nodes + k] > 0) == (s.handle[k] == i));
    tss__basis_free(&b.host, &s), drop(&b);
}

// ---- POD and given columns ------------------------------------------------------------------

static void test_pod(void **state) {
    (void)state;
    body b = box(1, 0.8, 0.6, 4, 3, 3, 0.3);
    enum { S = 11 };
    int N = b.nodes * 3;
    double *x = doubles(N * S), *field = doubles(N * 3), G[S * S], value[S];
    for (int i = 0; i < 3 * N; i++) field[i] = rnd();
    for (int j = 0; j < S; j++) {
        double c[3] = {rnd(), 0.1 * rnd(), 0.01 * rnd()};
        for (int i = 0; i < N; i++)
            x[j * N + i] = b.X[i] + c[0] * field[i] + c[1] * field[N + i] + c[2] * field[2 * N + i];
    }
    tss__basis s = build(&b, tss_basis_pod(x, S, 8));
    assert_int_equal(s.blocks, 3);  // the rank
    // The mean squares are the eigenvalues of the snapshots' Gram matrix.
    for (int j = 0; j < S; j++)
        for (int k = 0; k < S; k++) {
            G[j + k * S] = 0;
            for (int i = 0; i < N; i++)
                G[j + k * S] += b.mass[i / 3] * (x[j * N + i] - b.X[i]) * (x[k * N + i] - b.X[i]);
        }
    jacobi(S, G, value);
    for (int k = 0; k < 3; k++)
        assert_true(fabs(s.eigenvalue[k] * (double)S * s.mass / value[S - 1 - k] - 1) < 1e-9);
    // Orthonormal, and the snapshots lie in their span.
    for (int j = 0; j < S; j++) {
        double c[3] = {0, 0, 0};
        for (int k = 0; k < 3; k++)
            for (int i = 0; i < N; i++)
                c[k] += b.mass[i / 3] * s.value[i * 3 + k] * (x[j * N + i] - b.X[i]) / s.mass;
        for (int i = 0; i < N; i++) {
            double left = x[j * N + i] - b.X[i];
            for (int k = 0; k < 3; k++) left -= c[k] * s.value[i * 3 + k];
            assert_true(fabs(left) < 1e-13);
        }
    }
    tss__basis_free(&b.host, &s);
    s = build(&b, tss_basis_pod(x, S, 2));
    assert_int_equal(s.blocks, 2);
    tss__basis_free(&b.host, &s);
    b.fixed[5] = 1;
    s = build(&b, tss_basis_pod(x, S, 5));
    for (int k = 0; k < s.columns; k++) assert_true(s.value[15 * s.columns + k] == 0);
    tss__basis_free(&b.host, &s);
    b.fixed[5] = 0;
    for (int j = 0; j < S; j++) memcpy(x + j * N, b.X, (size_t)N * sizeof *x);
    expect(&b, tss_basis_pod(x, S, 2), TSS_ERROR_BAD_ARGUMENT, "do not move");
    x[7] = NAN;
    expect(&b, tss_basis_pod(x, S, 2), TSS_ERROR_BAD_ARGUMENT, "snapshots: row 0, column 7");
    expect(&b, tss_basis_pod(NULL, S, 2), TSS_ERROR_BAD_ARGUMENT, "without snapshots");
    free(x), free(field), drop(&b);
}

static void refresh(void *user, const tss_ctx *c, int first_node, int nodes, double *columns) {
    (void)user, (void)c, (void)first_node, (void)nodes, (void)columns;
}

static void test_given(void **state) {
    (void)state;
    body b = box(1, 1, 1, 2, 2, 2, 0.3);
    int n = b.nodes, block[5] = {0, 0, 1, 2, 2}, gap[5] = {0, 0, 2, 2, 2};
    int down[5] = {0, 1, 0, 1, 1}, late[5] = {1, 1, 1, 1, 1};
    double *a = doubles(n * 15);
    for (int i = 0; i < n * 15; i++) a[i] = rnd();
    tss__basis s = build(&b, tss_basis_arrays(5, a, NULL, block));
    assert_true(!s.vector && s.blocks == 3 && s.columns == 5 && s.initial == 3);
    assert_true(s.first[1] == 2 && s.first[2] == 3 && s.first[3] == 5);
    assert_memory_equal(s.value, a, (size_t)(n * 5) * sizeof *a);
    int node[2] = {7, 3}, active[2] = {2, 0};
    double out[2][6];
    tss__basis_rows(&s, b.X, 3, node, 2, active, 2, out[0], 6);
    for (int k = 0; k < 2; k++)
        for (int c = 0; c < 4; c++)
            assert_true(out[k][c] == a[node[k] * 5 + (c < 2 ? 3 + c : c - 2)]);
    tss__basis_free(&b.host, &s);
    s = build(&b, tss_basis_arrays(5, NULL, a, NULL));
    assert_true(s.vector && s.blocks == 5 && s.columns == 5);
    assert_memory_equal(s.value, a, (size_t)(n * 15) * sizeof *a);
    tss__basis_free(&b.host, &s);
    s = build(&b, tss_basis_custom(4, NULL, refresh, NULL));
    assert_true(s.vector && s.blocks == 4 && s.value);
    tss__basis_free(&b.host, &s);
    expect(&b, tss_basis_arrays(5, a, NULL, gap), TSS_ERROR_BAD_ARGUMENT, "2 is in block 2");
    expect(&b, tss_basis_arrays(5, a, NULL, down), TSS_ERROR_BAD_ARGUMENT, "2 is in block 0");
    expect(&b, tss_basis_arrays(5, a, NULL, late), TSS_ERROR_BAD_ARGUMENT, "0 is in block 1");
    expect(&b, tss_basis_arrays(5, a, a, NULL), TSS_ERROR_BAD_ARGUMENT, "one of the two");
    expect(&b, tss_basis_arrays(5, NULL, NULL, NULL), TSS_ERROR_BAD_ARGUMENT, "one of the two");
    expect(&b, tss_basis_custom(4, NULL, NULL, NULL), TSS_ERROR_BAD_ARGUMENT, "without refresh");
    tss_basis_def both = tss_basis_custom(4, NULL, refresh, NULL);
    both.vectors = a;
    expect(&b, both, TSS_ERROR_BAD_ARGUMENT, "custom basis with arrays");
    a[11] = INFINITY;
    expect(&b, tss_basis_arrays(5, a, NULL, NULL), TSS_ERROR_BAD_ARGUMENT, "column 1 is inf");
    expect(&b, tss_basis_arrays(5, NULL, a, NULL), TSS_ERROR_BAD_ARGUMENT, "vectors: row 2");
    free(a), drop(&b);
}

// ---- bits -----------------------------------------------------------------------------------

static int same(const void *a, const void *b, size_t bytes) {
    return (!a && !b) || (a && b && !memcmp(a, b, bytes));
}

static int same_basis(const tss__basis *a, const tss__basis *b) {
    size_t blocks = (size_t)a->blocks, q = (size_t)(a->dim + 1), n = (size_t)a->nodes;
    size_t values = n * (size_t)(a->vector ? a->dim : 1) * (size_t)a->columns;
    return a->blocks == b->blocks && a->columns == b->columns && a->vector == b->vector &&
           a->bytes == b->bytes && a->mass == b->mass && a->residual == b->residual &&
           a->iterations == b->iterations && a->initial == b->initial &&
           same(a->center, b->center, sizeof a->center) &&
           same(a->first, b->first, (blocks + 1) * sizeof(int)) &&
           same(a->handle, b->handle, blocks * sizeof(int)) &&
           same(a->eigenvalue, b->eigenvalue, blocks * sizeof(double)) &&
           same(a->weight, b->weight, n * blocks * sizeof(double)) &&
           same(a->transform, b->transform, blocks * q * q * sizeof(double)) &&
           same(a->value, b->value, values * sizeof(double));
}

enum { KINDS = 6 };

// One def of each kind that computes; snapshots for POD from x (5 of them).
static tss_basis_def def_of(int k, const double *x) {
    switch (k) {
        case 0: return tss_basis_affine();
        case 1: return tss_basis_quadratic();
        case 2: return tss_basis_skinning(20);
        case 3: return tss_basis_biharmonic(20);
        case 4: return tss_basis_eigen(20);
        default: return tss_basis_pod(x, 5, 4);
    }
}

static double *snapshots_of(const body *b, double scale) {
    int N = b->nodes * b->dim;
    double *x = doubles(5 * N);
    for (int j = 0; j < 5; j++)
        for (int i = 0; i < N; i++)
            x[j * N + i] = b->X[i] + scale * ldexp((double)((i * (j + 3)) % 64 - 32), -9);
    return x;
}

typedef struct shuffler {
    int mode, workers;
} shuffler;

// Blocks in reversed (1) or strided (2) order on pretended workers.
static void shuffled_for(int blocks, tss_task *task, void *arg, void *ctx) {
    const shuffler *s = (const shuffler *)ctx;
    int step = 7919;
    while (blocks % step == 0) step += 2;
    for (int b = 0; b < blocks; b++) {
        int shuffled = (int)((int64_t)b * step % blocks);
        int k = s->mode == 1 ? blocks - 1 - b : s->mode == 2 ? shuffled : b;
        task(k, (k * 5 + b) % s->workers, arg);
    }
}

static void test_threads(void **state) {
    (void)state;
    body b = box(1, 0.8, 0.6, 10, 8, 7, 0.3);
    double *x = snapshots_of(&b, 1);
    for (int k = 0; k < KINDS; k++) {
        b.host = tss_host_default(), b.host.workers = 1;
        tss__basis one = build(&b, def_of(k, x));
        for (int run = 0; run < 4; run++) {
            shuffler s = {run, 3};
            b.host = tss_host_default(), b.host.workers = 4;  // run 0: OpenMP
            if (run) b.host.parallel_for = shuffled_for, b.host.parallel_ctx = &s;
            if (run) b.host.workers = s.workers;
            tss__basis many = build(&b, def_of(k, x));
            assert_true(same_basis(&one, &many));
            tss__basis_free(&b.host, &many);
        }
        tss__basis_free(&b.host, &one);
    }
    free(x), drop(&b);
}

static void test_signs(void **state) {
    (void)state;
    body b = box(1, 1, 1, 4, 4, 4, 0.3);
    double *x = snapshots_of(&b, 1);
    for (int k = 2; k < KINDS; k++) {
        tss__basis s = build(&b, def_of(k, x));
        int N = b.nodes * (s.vector ? 3 : 1), columns = s.weight ? s.blocks : s.columns;
        const double *U = s.weight ? s.weight : s.value;
        for (int c = s.weight ? 1 : 0; k != 3 && c < columns; c++) {
            double largest = 0;
            int i = 0;
            if (k == 4 && c < 6) continue;  // rigid modes: as written down
            for (int r = 0; r < N; r++) largest = fmax(largest, fabs(U[r * columns + c]));
            while (fabs(U[i * columns + c]) < (1 - 1e-6) * largest) i++;
            assert_true(U[i * columns + c] > 0);
        }
        tss__basis_free(&b.host, &s);
    }
    free(x), drop(&b);
}

// Exact ratio of two arrays of numbers.
static void check_ratio(size_t count, const double *a, const double *b, double ratio) {
    for (size_t i = 0; a && i < count; i++) assert_true(b[i] == a[i] * ratio);
}

static void test_scaling(void **state) {
    (void)state;
    const int power[4][3] = {{3, 0, 0}, {0, 5, 0}, {0, 0, -7}, {-9, -3, 11}};
    body b = box(1, 0.75, 0.625, 5, 4, 3, 0.3);
    for (int held = 0; held < 2; held++)
        for (int k = 0; k < KINDS * 4; k++) {
            const int *p = power[k % 4];
            double L = ldexp(1, p[0]), M = ldexp(1, p[1]), S = ldexp(1, p[2]);
            for (int i = 0; held && i < 9; i++) b.fixed[3 * i] = 1;
            double *x = snapshots_of(&b, 1);
            tss_basis_def d = def_of(k / 4, x);
            d.heterogeneous = 1;
            tss__basis s = build(&b, d);
            body c = box(1, 0.75, 0.625, 5, 4, 3, 0.3);
            memcpy(c.fixed, b.fixed, (size_t)b.nodes);
            for (int i = 0; i < 3 * b.nodes; i++) c.X[i] = b.X[i] * L;
            for (int i = 0; i < b.nodes; i++) c.mass[i] = b.mass[i] * M;
            for (int i = 0; i < b.cells; i++) c.mu[i] = b.mu[i] * S, c.lambda[i] = b.lambda[i] * S;
            for (int i = 0; i < 15 * b.nodes; i++) x[i] *= L;
            tss__basis t = build(&c, d);
            size_t n = (size_t)b.nodes, blocks = (size_t)s.blocks;
            double unit = k / 4 == 5 ? L * L : k / 4 == 4 || k / 4 == 2 ? S * L / M : 1;
            assert_true(s.blocks == t.blocks && s.columns == t.columns && t.mass == s.mass * M);
            check_ratio(3, s.center, t.center, L);
            check_ratio(n * blocks, s.weight, t.weight, 1);
            check_ratio(n * (s.vector ? 3 : 1) * (size_t)s.columns, s.value, t.value, 1);
            check_ratio(blocks, s.eigenvalue, t.eigenvalue, unit);
            for (size_t e = 0; s.transform && e < blocks * 16; e++)
                assert_true(t.transform[e] == s.transform[e] / (e % 4 ? L : 1));
            tss__basis_free(&b.host, &s), tss__basis_free(&c.host, &t);
            free(x), drop(&c);
        }
    drop(&b);
}

static void test_far(void **state) {
    (void)state;
    // 4 km off on a grid of 2^-12 m: the same body to the last bit of its edges.
    body b = box(1, 0.75, 0.5, 8, 6, 4, 0.3), c = box(1, 0.75, 0.5, 8, 6, 4, 0.3);
    for (int i = 0; i < 3 * b.nodes; i++) c.X[i] += i % 3 ? -2048 : 4096;
    tss__basis s = build(&b, tss_basis_skinning(12)), t = build(&c, tss_basis_skinning(12));
    for (int k = 1; k < 13; k++) assert_true(fabs(t.eigenvalue[k] / s.eigenvalue[k] - 1) < 1e-10);
    check_orthonormal(&c, &t, 0);
    tss__basis_free(&b.host, &s), tss__basis_free(&c.host, &t);
    drop(&b), drop(&c);
}

// ---- cache ----------------------------------------------------------------------------------

static int warnings;
static void count_log(tss_log_level level, const char *message, void *ctx) {
    (void)ctx;
    warnings += level == TSS_LOG_WARNING && strstr(message, "cannot be kept") != NULL;
}

static size_t slurp(const char *path, unsigned char **data) {
    FILE *f = fopen(path, "rb");
    assert_non_null(f);
    *data = (unsigned char *)malloc(1 << 22);
    size_t size = fread(*data, 1, 1 << 22, f);
    fclose(f);
    return size;
}

static void spill(const char *path, const unsigned char *data, size_t size) {
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    assert_int_equal(fwrite(data, 1, size, f), size);
    fclose(f);
}

static void test_cache(void **state) {
    (void)state;
    char path[64];
    snprintf(path, sizeof path, "test_basis_%p.tmp", (void *)path);
    body b = box(1, 0.8, 0.6, 3, 3, 3, 0.3);
    double *x = snapshots_of(&b, 1);
    for (int k = 2; k < KINDS; k++) {
        tss_basis_def d = def_of(k, x);
        tss__basis plain = build(&b, d);
        d.cache = path;
        remove(path);
        tss__basis first = build(&b, d), second = build(&b, d);
        assert_true(!plain.cached && !first.cached && second.cached);
        assert_true(same_basis(&plain, &first) && same_basis(&plain, &second));
        tss__basis_free(&b.host, &first), tss__basis_free(&b.host, &second);
        // A change of def or mesh is noticed; what only names blocks is not a change.
        for (int change = 0; change < 5; change++) {
            tss_basis_def e = d;
            double *spot = change == 1 ? &b.X[3 * b.nodes - 1] : change == 2 ? &b.mass[3] : NULL;
            double kept = spot ? *spot : 0;
            if (change == 0) e.count--;
            if (spot) *spot *= 1 + 1e-15;
            if (change == 3) b.fixed[2] = 1;
            if (change == 4) e.initial = 2;
            tss__basis t = build(&b, e);
            assert_int_equal(t.cached, change == 4);
            tss__basis_free(&b.host, &t);
            if (spot) *spot = kept;
            b.fixed[2] = 0;
            t = build(&b, d);  // put back
            tss__basis_free(&b.host, &t);
        }
        // Damage: bytes changed, cut off, added. Never taken, always mended.
        unsigned char *data;
        size_t size = slurp(path, &data);
        for (int trial = 0; trial < 60; trial++) {
            size_t at = (size_t)((rnd() + 1) / 2 * (double)(size - 1));
            if (trial < 20) at = (size_t)(6 * trial);  // the head
            size_t length = trial % 3 == 1 ? at : size + (trial % 3 == 2);
            data[size] = 7;
            if (trial % 3 == 0) data[at] ^= (unsigned char)(1 << trial % 8);
            spill(path, data, length);
            if (trial % 3 == 0) data[at] ^= (unsigned char)(1 << trial % 8);
            tss__basis t = build(&b, d), u = build(&b, d);
            assert_true(!t.cached && u.cached && same_basis(&plain, &t) && same_basis(&plain, &u));
            tss__basis_free(&b.host, &t), tss__basis_free(&b.host, &u);
        }
        free(data);
        tss__basis_free(&b.host, &plain);
    }
    remove(path);
    tss_basis_def d = tss_basis_skinning(3);
    d.cache = "no/such/directory/cache";
    b.host.log = count_log, warnings = 0;
    tss__basis s = build(&b, d);
    assert_int_equal(warnings, 1);
    tss__basis_free(&b.host, &s);
    free(x), drop(&b);
}

// ---- errors, memory -------------------------------------------------------------------------

static void test_errors(void **state) {
    (void)state;
    body b = box(1, 1, 1, 2, 2, 2, 0.3);
    double keep;
    tss_basis_def d = tss_basis_skinning(4);
    d.cookie = 0;
    expect(&b, d, TSS_ERROR_BAD_ARGUMENT, "cookie");
    d = tss_basis_skinning(4), d.kind = TSS_BASIS_KINDS;
    expect(&b, d, TSS_ERROR_BAD_ARGUMENT, "kind 8");
    d = tss_basis_skinning(4), d.initial = -2;
    expect(&b, d, TSS_ERROR_BAD_ARGUMENT, "initial");
    d = tss_basis_skinning(4), d.tol = 0;
    expect(&b, d, TSS_ERROR_BAD_ARGUMENT, "tol");
    d.tol = NAN;
    expect(&b, d, TSS_ERROR_BAD_ARGUMENT, "tol");
    d.tol = 1e-19;
    expect(&b, d, TSS_ERROR_SINGULAR, "asked for");
    expect(&b, tss_basis_skinning(0), TSS_ERROR_BAD_ARGUMENT, "count is 0");
    expect(&b, tss_basis_eigen(-3), TSS_ERROR_BAD_ARGUMENT, "count is -3");
    expect(&b, tss_basis_skinning(27), TSS_ERROR_BAD_ARGUMENT, "27 handles");
    expect(&b, tss_basis_biharmonic(28), TSS_ERROR_BAD_ARGUMENT, "28 handles");
    expect(&b, tss_basis_eigen(82), TSS_ERROR_BAD_ARGUMENT, "81 unknowns");
    tss__basis s = build(&b, tss_basis_skinning(26));
    tss__basis_free(&b.host, &s);
    keep = b.mu[3], b.mu[3] = -1;
    expect(&b, tss_basis_eigen(4), TSS_ERROR_BAD_MATERIAL, "cell 3");
    b.mu[3] = keep;
    keep = b.mass[5], b.mass[5] = NAN;
    expect(&b, tss_basis_affine(), TSS_ERROR_BAD_MATERIAL, "node 5");
    b.mass[5] = 0;
    expect(&b, tss_basis_skinning(2), TSS_ERROR_BAD_MATERIAL, "node 5");
    b.mass[5] = keep;
    keep = b.X[7], b.X[7] = INFINITY;
    expect(&b, tss_basis_affine(), TSS_ERROR_BAD_STATE, "node 2");
    b.X[7] = keep;
    int node = b.cell[1];
    b.cell[1] = b.cell[0];
    expect(&b, tss_basis_biharmonic(2), TSS_ERROR_BAD_MESH, "cell 0");
    b.cell[1] = node;
    int cells = b.cells;
    b.cells = 0;
    expect(&b, tss_basis_skinning(2), TSS_ERROR_BAD_MESH, "needs cells");
    s = build(&b, tss_basis_affine());  // needs none
    tss__basis_free(&b.host, &s);
    b.cells = cells;
    memset(b.fixed, 1, (size_t)b.nodes);
    expect(&b, tss_basis_affine(), TSS_ERROR_BAD_ARGUMENT, "all 27");
    memset(b.fixed, 0, (size_t)b.nodes);
    int nodes = b.nodes;
    b.nodes = 0;
    expect(&b, tss_basis_affine(), TSS_ERROR_EMPTY, "no nodes");
    b.nodes = nodes;
    drop(&b);
}

// Nodes in no cell: the eigenproblem leaves them out, the constant takes them along.
static void test_idle(void **state) {
    (void)state;
    body b = box(1, 1, 1, 3, 3, 3, 0.3), c = box(1, 1, 1, 3, 3, 3, 0.3);
    double *X = doubles(3 * (b.nodes + 1)), *mass = doubles(b.nodes + 1);
    memcpy(X, b.X, (size_t)(3 * b.nodes) * sizeof *X);
    memcpy(mass, b.mass, (size_t)b.nodes * sizeof *X);
    X[3 * b.nodes] = 0.5;
    free(b.X), free(b.mass), free(b.fixed);
    b.X = X, b.mass = mass, b.nodes++, b.fixed = (uint8_t *)calloc((size_t)b.nodes, 1);
    tss__basis s = build(&b, tss_basis_skinning(5)), t = build(&c, tss_basis_skinning(5));
    for (int k = 0; k < 6; k++) {
        assert_true(fabs(s.eigenvalue[k] - t.eigenvalue[k]) <= 1e-12 * t.eigenvalue[5]);
        assert_true(s.weight[(b.nodes - 1) * 6 + k] == (k == 0));
    }
    tss__basis_free(&b.host, &s), tss__basis_free(&c.host, &t);
    s = build(&b, tss_basis_biharmonic(5)), t = build(&b, tss_basis_eigen(9));
    for (int k = 0; k < 5; k++) assert_true(s.handle[k] != b.nodes - 1);
    tss__basis_free(&b.host, &s), tss__basis_free(&c.host, &t);
    drop(&b), drop(&c);
}

// An allocator that fails at allocation number fail_at and counts what is out.
typedef struct counter {
    int64_t calls, fail_at, live, bytes;
} counter;

static void *counted_alloc(size_t bytes, size_t align, void *ctx) {
    counter *c = (counter *)ctx;
    if (++c->calls == c->fail_at) return NULL;
    void *p = aligned_alloc(align, (bytes + align - 1) / align * align);
    assert_non_null(p);
    memset(p, 0xa5, bytes);
    c->live++, c->bytes += (int64_t)bytes;
    return p;
}

static void counted_free(void *p, size_t bytes, void *ctx) {
    counter *c = (counter *)ctx;
    c->live--, c->bytes -= (int64_t)bytes;
    free(p);
}

static void test_memory(void **state) {
    (void)state;
    body b = box(1, 1, 1, 3, 2, 2, 0.3);
    double *x = snapshots_of(&b, 1);
    for (int k = 0; k < KINDS + 1; k++) {
        counter c = {0, 0, 0, 0};
        b.host = tss_host_default(), b.host.workers = 1;
        b.host.alloc = counted_alloc, b.host.free = counted_free, b.host.memory_ctx = &c;
        tss_basis_def d = k < KINDS ? def_of(k, x) : tss_basis_arrays(2, x, NULL, NULL);
        tss__basis s = build(&b, d);
        assert_true((size_t)c.bytes == s.bytes);
        tss__basis_free(&b.host, &s);
        assert_true(c.live == 0 && c.bytes == 0);
        int64_t calls = c.calls;
        for (int64_t fail = 1; fail <= calls; fail++) {
            tss__sub_mesh m = view(&b);
            c.calls = 0, c.fail_at = fail;
            assert_int_equal(tss__basis_build(&m, &d, &s, NULL, 0), TSS_ERROR_NO_MEMORY);
            assert_true(c.live == 0 && c.bytes == 0);
        }
    }
    free(x), drop(&b);
}

// ---- dense eigensolver ----------------------------------------------------------------------

static void test_symmetric(void **state) {
    (void)state;
    for (int n = 1; n <= 60; n += n < 8 ? 1 : 13) {
        double *A = doubles(n * n), *V = doubles(n * n), *d = doubles(n), *work = doubles(3 * n);
        // The second difference: 2 − 2 cos(kπ/(n+1)).
        for (int i = 0; i < n; i++)
            for (int j = 0; j < n; j++) A[i + j * n] = i == j ? 2 : abs(i - j) == 1 ? -1 : 0;
        memcpy(V, A, (size_t)(n * n) * sizeof *A);
        assert_true(tss__symmetric_eigen(n, V, d, work));
        for (int k = 0; k < n; k++)
            assert_true(fabs(d[k] - 2 + 2 * cos((n - k) * PI / (n + 1))) < 1e-13);
        // Random low rank plus multiples of 1: clusters. Against A V = V D.
        for (int i = 0; i < n * n; i++) A[i] = 0;
        for (int r = 0; r < n / 3; r++) {
            double *v = d;
            for (int i = 0; i < n; i++) v[i] = rnd();
            for (int i = 0; i < n * n; i++) A[i] += v[i % n] * v[i / n];
        }
        memcpy(V, A, (size_t)(n * n) * sizeof *A);
        assert_true(tss__symmetric_eigen(n, V, d, work));
        for (int k = 0; k < n; k++)
            for (int i = 0; i < n; i++) {
                double s = -d[k] * V[i + k * n], dot = -(i == k);
                for (int j = 0; j < n; j++)
                    s += A[i + j * n] * V[j + k * n], dot += V[j + i * n] * V[j + k * n];
                assert_true(fabs(s) < 1e-13 * (1 + d[0]) && fabs(dot) < 1e-13);
                assert_true(k == 0 || d[k] <= d[k - 1]);
            }
        free(A), free(V), free(d), free(work);
    }
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_symmetric),  cmocka_unit_test(test_box),
        cmocka_unit_test(test_rod),        cmocka_unit_test(test_dense),
        cmocka_unit_test(test_many_modes), cmocka_unit_test(test_pieces),
        cmocka_unit_test(test_copies),
        cmocka_unit_test(test_blocks),     cmocka_unit_test(test_quadratic),
        cmocka_unit_test(test_biharmonic), cmocka_unit_test(test_pod),
        cmocka_unit_test(test_given),      cmocka_unit_test(test_threads),
        cmocka_unit_test(test_signs),      cmocka_unit_test(test_scaling),
        cmocka_unit_test(test_far),        cmocka_unit_test(test_cache),
        cmocka_unit_test(test_errors),     cmocka_unit_test(test_idle),
        cmocka_unit_test(test_memory),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
