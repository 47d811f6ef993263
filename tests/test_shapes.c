// tss_shapes.h: volumes, orientation, watertightness, dihedral angles, determinism.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_io.h"
#include "tss_shapes.h"

#include <math.h>
#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#include <cmocka.h>

#define PI 3.14159265358979323846

// Euler characteristic V − E + F, and every edge shared by two triangles that run through it in
// opposite directions (closed) or at most two (sheet). Returns border edges.
typedef struct half { int a, b; } half;

static int half_order(const void *p, const void *q) {
    const half *x = (const half *)p, *y = (const half *)q;
    return x->a != y->a ? (x->a < y->a ? -1 : 1) : x->b != y->b ? (x->b < y->b ? -1 : 1) : 0;
}

static int border_edges(const tss_mesh *s, int *euler) {
    int n = 3 * s->triangles, border = 0;
    half *h = (half *)malloc((size_t)n * sizeof *h);
    for (int i = 0; i < n; i++) {
        h[i].a = s->triangle[i];
        h[i].b = s->triangle[i - i % 3 + (i + 1) % 3];
    }
    qsort(h, (size_t)n, sizeof *h, half_order);
    for (int i = 0; i < n; i++) {
        // the same direction twice: not an oriented manifold
        if (i) assert_true(half_order(&h[i - 1], &h[i]) != 0);
        half back = {h[i].b, h[i].a};
        if (!bsearch(&back, h, (size_t)n, sizeof *h, half_order)) border++;
    }
    *euler = s->nodes - (n + border) / 2 + s->triangles;
    free(h);
    return border;
}

static double enclosed(const tss_mesh *s) {
    double v = 0;
    for (int t = 0; t < s->triangles; t++) {
        const double *a = s->x + 3 * s->triangle[3 * t], *b = s->x + 3 * s->triangle[3 * t + 1],
                     *c = s->x + 3 * s->triangle[3 * t + 2];
        v += (a[0] * (b[1] * c[2] - b[2] * c[1]) + a[1] * (b[2] * c[0] - b[0] * c[2]) +
              a[2] * (b[0] * c[1] - b[1] * c[0])) / 6;
    }
    return v;
}

// No problem of any kind; closed oriented surface around the same volume; returns the volume.
static double assert_solid(const tss_mesh *m, int euler) {
    tss_mesh_report r;
    tss_mesh s;
    int chi;
    assert_int_equal(tss_mesh_check(m, &r), TSS_OK);
    assert_int_equal(r.problems, 0);
    assert_int_equal(tss_mesh_surface(m, &s), TSS_OK);
    assert_int_equal(tss_mesh_drop_unreferenced(&s, NULL), TSS_OK);
    assert_int_equal(border_edges(&s, &chi), 0);
    if (chi != euler) fail_msg("Euler characteristic %d, expected %d", chi, euler);
    assert_true(fabs(enclosed(&s) - r.volume) < 1e-12 * (1 + r.volume));
    tss_mesh_free(&s);
    return r.volume;
}

static void test_named_shapes(void **state) {
    (void)state;
    for (int k = 0; k < TSS_SHAPE_COUNT; k++) {
        tss_shape_def d = tss_shape_def_default((tss_shape_kind)k);
        tss_mesh m;
        double low, high, a[3], b[3];
        assert_int_equal(tss_shape_find(tss_shape_name(d.kind)), k);
        assert_int_equal(tss_shape_make(NULL, &d, &m), TSS_OK);
        tss_mesh_dihedral(&m, &low, &high);
        tss_mesh_bounds(&m, a, b);
        double v = assert_solid(&m, k == TSS_SHAPE_TORUS ? 0 : 2);
        print_message("%-10s %6d nodes %6d tets  volume %.4f  dihedral %.1f..%.1f\n",
                      tss_shape_name(d.kind), m.nodes, m.tets, v, low, high);
        assert_true(low >= 10 && high <= 165);
        for (int c = 0; c < 3; c++) assert_true(a[c] > -0.51 && b[c] < 0.51);
        tss_mesh_free(&m);
    }
    assert_int_equal(tss_shape_find("nonsense"), TSS_SHAPE_COUNT);
}

static double exact_volume(tss_shape_kind k, double r) {
    switch (k) {
        case TSS_SHAPE_BALL: return PI / 6;
        case TSS_SHAPE_ELLIPSOID: return 4 * PI / 3 * 0.5 * 0.5 * r * (0.25 + 0.25 * r);
        case TSS_SHAPE_CYLINDER: return PI * r * r;
        case TSS_SHAPE_CAPSULE: return PI * r * r * (1 - 2 * r) + 4 * PI / 3 * r * r * r;
        case TSS_SHAPE_TORUS: return 2 * PI * PI * (0.5 - r) * r * r;
        default: return PI * r * r / 3;  // cone
    }
}

static void test_volume_converges(void **state) {
    (void)state;
    // smooth shapes: second order; with sharp edges: at least first
    for (int k = TSS_SHAPE_BALL; k <= TSS_SHAPE_CONE; k++) {
        double error[2];
        for (int i = 0; i < 2; i++) {
            tss_shape_def d = tss_shape_def_default((tss_shape_kind)k);
            tss_mesh m;
            tss_mesh_report r;
            d.cells = 15 << i;
            assert_int_equal(tss_shape_make(NULL, &d, &m), TSS_OK);
            assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
            error[i] = fabs(r.volume - exact_volume(d.kind, d.ratio)) / exact_volume(d.kind, d.ratio);
            tss_mesh_free(&m);
        }
        print_message("%-10s error %.2e -> %.2e, order %.2f\n", tss_shape_name((tss_shape_kind)k),
                      error[0], error[1], log2(error[0] / error[1]));
        int smooth = k != TSS_SHAPE_CYLINDER && k != TSS_SHAPE_CONE;
        assert_true(error[0] / error[1] > (smooth ? 3 : 1.7));
    }
}

// Random signs and cuts: every stencil, far worse than any surface.
static double random_field(const double x[3], void *ctx) {
    uint64_t h = *(const uint64_t *)ctx;
    for (int c = 0; c < 3; c++) {
        if (fabs(x[c]) > 0.9) return 1;
        h ^= (uint64_t)(int64_t)floor(x[c] * 1e7 + 0.5) * 0x9E3779B97F4A7C15u;
        h ^= h >> 29;
        h *= 0xBF58476D1CE4E5B9u;
        h ^= h >> 32;
    }
    return (double)(h >> 11) / 9007199254740992.0 - 0.5;
}

static void test_stuffing_quality(void **state) {
    (void)state;
    const double lower[3] = {-1, -1, -1}, upper[3] = {1, 1, 1};
    double least = 180, most = 0;
    for (uint64_t seed = 1; seed <= 3; seed++) {
        tss_mesh m;
        tss_mesh_report r;
        double low, high;
        assert_int_equal(tss_shape_implicit(NULL, random_field, &seed, lower, upper, 0.07, &m),
                         TSS_OK);
        assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
        assert_int_equal(r.problems, 0);
        tss_mesh_dihedral(&m, &low, &high);
        if (low < least) least = low;
        if (high > most) most = high;
        tss_mesh_free(&m);
    }
    print_message("random fields (seeds 1..3): dihedral angles %.2f..%.2f\n", least, most);
    assert_true(least >= 10 && most <= 165);
}

static double never(const double x[3], void *ctx) {
    (void)x, (void)ctx;
    return 1;
}
static double always(const double x[3], void *ctx) {
    (void)x, (void)ctx;
    return -1;
}

static void test_bad_arguments(void **state) {
    (void)state;
    const double lower[3] = {0, 0, 0}, upper[3] = {1, 1, 1};
    const int n[3] = {1, 1, 1}, none[3] = {1, 0, 1};
    tss_mesh m;
    tss_shape_def d = tss_shape_def_default(TSS_SHAPE_BALL);
    assert_int_equal(tss_shape_implicit(NULL, never, NULL, lower, upper, 0.2, &m), TSS_ERROR_EMPTY);
    assert_int_equal(tss_shape_implicit(NULL, always, NULL, lower, upper, 0.2, &m),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_shape_implicit(NULL, never, NULL, upper, lower, 0.2, &m),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_shape_implicit(NULL, never, NULL, lower, upper, 1e-9, &m),
                     TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_shape_implicit(NULL, never, NULL, lower, upper, NAN, &m),
                     TSS_ERROR_BAD_ARGUMENT);
    d.cookie = 0;
    assert_int_equal(tss_shape_make(NULL, &d, &m), TSS_ERROR_BAD_ARGUMENT);
    d = tss_shape_def_default(TSS_SHAPE_TORUS);
    d.ratio = 0.5;
    assert_int_equal(tss_shape_make(NULL, &d, &m), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_shape_box(NULL, lower, upper, none, 5, NULL, &m), TSS_ERROR_BAD_ARGUMENT);
    assert_int_equal(tss_shape_box(NULL, lower, upper, n, 7, NULL, &m), TSS_ERROR_BAD_ARGUMENT);
    assert_true(m.nodes == 0 && m.x == NULL);
}

static void test_box(void **state) {
    (void)state;
    const double lower[3] = {-1, 0, 2}, upper[3] = {1, 3, 4}, grade[3] = {4, 1, 0.25};
    const int n[3] = {4, 3, 5};
    for (int split = 5; split <= 6; split++)
        for (int graded = 0; graded < 2; graded++) {
            tss_mesh m;
            assert_int_equal(tss_shape_box(NULL, lower, upper, n, split, graded ? grade : NULL, &m),
                             TSS_OK);
            assert_int_equal(m.tets, split * 60);
            assert_true(fabs(assert_solid(&m, 2) - 12) < 1e-12);
            if (graded) {
                double first = m.x[3] - m.x[0], last = m.x[12] - m.x[9];
                assert_true(fabs(last / first - 4) < 1e-12);
            }
            tss_mesh_free(&m);
        }
}

static double slope(double x, double z, void *ctx) {
    (void)ctx;
    return 2 + x + 0.5 * z;
}

static void test_terrain_and_sheets(void **state) {
    (void)state;
    const double lower[3] = {0, 0, 0}, upper[3] = {1, 1, 1};
    const int n[3] = {6, 2, 5};
    tss_mesh m;
    tss_mesh_report r;
    int chi;
    assert_int_equal(tss_shape_terrain_block(NULL, lower, upper, n, slope, NULL, &m), TSS_OK);
    assert_true(fabs(assert_solid(&m, 2) - 2.75) < 1e-12);
    tss_mesh_free(&m);
    // hills dip below the block's floor: refused
    assert_int_equal(tss_shape_terrain_block(NULL, lower, upper, n, tss_shape_hills, NULL, &m),
                     TSS_ERROR_BAD_ARGUMENT);
    for (int k = 0; k < 2; k++) {
        tss_result e = k ? tss_shape_spike_sheet(NULL, lower, upper, 6, 5, 0.3, &m)
                         : tss_shape_grid(NULL, lower, upper, 6, 5, tss_shape_hills, NULL, &m);
        assert_int_equal(e, TSS_OK);
        assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
        assert_int_equal(r.problems, 0);
        assert_int_equal(border_edges(&m, &chi), 22);
        assert_int_equal(chi, 1);
        for (int t = 0; t < m.triangles; t++) {  // all look up
            const double *a = m.x + 3 * m.triangle[3 * t], *b = m.x + 3 * m.triangle[3 * t + 1],
                         *c = m.x + 3 * m.triangle[3 * t + 2];
            assert_true((b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2]) > 0);
        }
        tss_mesh_free(&m);
    }
}

static void test_closed_surfaces(void **state) {
    (void)state;
    const double lower[3] = {0, 0, 0}, upper[3] = {1, 2, 3};
    const int n[3] = {2, 3, 4};
    const double exact[3] = {4 * PI / 3 * 8, 6, 0.25 * PI * 2 / 3};
    for (int k = 0; k < 3; k++) {
        tss_mesh m;
        int chi;
        tss_mesh_report r;
        tss_result e = k == 0   ? tss_shape_ball_surface(NULL, 2, 40, &m)
                       : k == 1 ? tss_shape_box_surface(NULL, lower, upper, n, &m)
                                : tss_shape_cone_surface(NULL, 0.5, 2, 400, &m);
        assert_int_equal(e, TSS_OK);
        assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
        assert_int_equal(r.problems, 0);
        assert_int_equal(border_edges(&m, &chi), 0);
        assert_int_equal(chi, 2);
        assert_true(fabs(enclosed(&m) / exact[k] - 1) < 2e-3);
        tss_mesh_free(&m);
    }
}

static void test_flat(void **state) {
    (void)state;
    const double lower[2] = {0, 1}, upper[2] = {2, 4};
    double area[2];
    for (int k = 0; k < 3; k++) {
        tss_mesh m;
        tss_mesh_report r;
        int chi;
        tss_result e = k == 2 ? tss_shape_rectangle(NULL, lower, upper, 5, 4, &m)
                              : tss_shape_disc(NULL, 1, 8 << k, &m);
        assert_int_equal(e, TSS_OK);
        assert_int_equal(m.dim, 2);
        assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
        assert_int_equal(r.problems, 0);
        assert_true(border_edges(&m, &chi) > 0);
        assert_int_equal(chi, 1);
        if (k == 2) assert_true(fabs(r.volume - 6) < 1e-12);
        else area[k] = PI - r.volume;
        tss_mesh_free(&m);
    }
    assert_true(area[0] / area[1] > 3.8 && area[0] / area[1] < 4.2);  // second order
}

static void test_segments_points(void **state) {
    (void)state;
    const double lower[3] = {0, 1, 2}, upper[3] = {1, 1, 4};
    const int n[3] = {2, 1, 3};
    tss_mesh m;
    tss_mesh_report r;
    assert_int_equal(tss_shape_segments(NULL, lower, upper, 3, 2, &m), TSS_OK);
    assert_true(m.edges == 6 && m.nodes == 9 && m.x[24] == 1 && m.x[26] == 4);
    assert_int_equal(tss_mesh_check(&m, &r), TSS_OK);
    assert_int_equal(r.problems, 0);
    tss_mesh_free(&m);
    assert_int_equal(tss_shape_points(NULL, lower, upper, n, &m), TSS_OK);
    assert_true(m.points == 6 && m.x[15] == 1 && m.x[16] == 1 && m.x[17] == 4);
    tss_mesh_free(&m);
}

static void test_transforms(void **state) {
    (void)state;
    const double lower[3] = {0, 0, 0}, upper[3] = {1, 2, 3};
    const int n[3] = {1, 1, 1};
    tss_mesh m, c;
    double a[3], b[3];
    assert_int_equal(tss_shape_box(NULL, lower, upper, n, 6, NULL, &m), TSS_OK);
    tss_mesh_rotate(&m, 0, 0, 90);  // x → y, y → −x
    tss_mesh_bounds(&m, a, b);
    assert_true(a[0] == -2 && b[0] == 0 && a[1] == 0 && b[1] == 1 && b[2] == 3);
    tss_mesh_rotate(&m, 0, 0, -90);
    tss_mesh_rotate(&m, 90, 0, 90);  // z first: (x,y,z) → (−y,x,z) → (−y,−z,x)
    tss_mesh_bounds(&m, a, b);
    assert_true(a[0] == -2 && a[1] == -3 && b[2] == 1);
    assert_true(fabs(assert_solid(&m, 2) - 6) < 1e-12);
    tss_mesh_scale(&m, -2, 1, 1);  // a reflection keeps tets positive
    assert_true(fabs(assert_solid(&m, 2) - 12) < 1e-12);
    tss_mesh_translate(&m, 10, 0, 0);
    assert_int_equal(tss_mesh_merge(&m, &m, &c), TSS_OK);
    assert_true(c.nodes == 16 && c.tets == 12 && c.tet[24] == m.tet[0] + 8);
    tss_mesh_bounds(&c, a, b);
    assert_true(a[0] == 10 && b[0] == 14);
    tss_mesh_free(&c);
    tss_mesh_free(&m);
}

typedef struct counter { long calls, live, fail_at; } counter;

static void *counting_alloc(size_t bytes, size_t align, void *ctx) {
    counter *c = (counter *)ctx;
    (void)align;
    if (++c->calls == c->fail_at) return NULL;
    c->live++;
    return malloc(bytes);
}
static void counting_free(void *p, size_t bytes, void *ctx) {
    (void)bytes;
    ((counter *)ctx)->live--;
    free(p);
}

static void test_every_allocation_and_bits(void **state) {
    (void)state;
    counter c;
    tss_host h = tss_host_default();
    tss_shape_def d = tss_shape_def_default(TSS_SHAPE_KOOSH);
    tss_mesh m, again;
    d.cells = 12;  // coarse: tips come off, so that the largest piece is taken
    d.ratio = 0.03;
    memset(&c, 0, sizeof c);
    h.alloc = counting_alloc, h.free = counting_free, h.memory_ctx = &c;
    assert_int_equal(tss_shape_make(&h, &d, &m), TSS_OK);
    long total = c.calls;
    for (long k = 1; k <= total; k++) {
        memset(&c, 0, sizeof c);
        c.fail_at = k;
        assert_int_equal(tss_shape_make(&h, &d, &again), TSS_ERROR_NO_MEMORY);
        assert_true(c.live == 0 && again.nodes == 0);
    }
    assert_int_equal(tss_shape_make(NULL, &d, &again), TSS_OK);
    assert_int_equal(m.nodes, again.nodes);
    assert_memory_equal(m.x, again.x, (size_t)m.nodes * 24);
    assert_memory_equal(m.tet, again.tet, (size_t)m.tets * 16);
    tss_mesh_free(&m);
    tss_mesh_free(&again);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_named_shapes), cmocka_unit_test(test_volume_converges),
        cmocka_unit_test(test_stuffing_quality), cmocka_unit_test(test_bad_arguments),
        cmocka_unit_test(test_box), cmocka_unit_test(test_terrain_and_sheets),
        cmocka_unit_test(test_closed_surfaces), cmocka_unit_test(test_flat),
        cmocka_unit_test(test_segments_points), cmocka_unit_test(test_transforms),
        cmocka_unit_test(test_every_allocation_and_bits),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
