// What TSS_NO_* leave out is refused by name, and what is left works. tests/run.sh (nodeps) builds
// this file with each switch alone, with all at once, and without any: then nothing is refused.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"

#include <math.h>
#include <string.h>

#ifdef TSS_NO_2D
enum { NO_2D = 1 };
#else
enum { NO_2D = 0 };
#endif
#ifdef TSS_NO_3D
enum { NO_3D = 1 };
#else
enum { NO_3D = 0 };
#endif
#ifdef TSS_NO_MATERIALS
enum { NO_MATERIALS = 1 };
#else
enum { NO_MATERIALS = 0 };
#endif
#ifdef TSS_NO_DAMPING
enum { NO_DAMPING = 1 };
#else
enum { NO_DAMPING = 0 };
#endif
#ifdef TSS_NO_THIN
enum { NO_THIN = 1 };
#else
enum { NO_THIN = 0 };
#endif
#ifdef TSS_NO_FRICTION
enum { NO_FRICTION = 1 };
#else
enum { NO_FRICTION = 0 };
#endif
#ifdef TSS_NO_EIGEN
enum { NO_EIGEN = 1 };
#else
enum { NO_EIGEN = 0 };
#endif

static char logged[400];
static void keep_log(tss_log_level level, const char *message, void *ctx) {
    (void)ctx;
    if (level == TSS_LOG_ERROR) strncpy(logged, message, sizeof logged - 1);
}

static tss_host host_with_log(void) {
    tss_host h = tss_host_default();
    h.log = keep_log, logged[0] = 0;
    return h;
}

static tss_world *world(int dim) {
    tss_world_def d = tss_world_def_default();
    tss_world *w = NULL;
    d.host = host_with_log(), d.dim = dim;
    assert_int_equal(tss_world_create(&d, &w), TSS_OK);
    return w;
}

static const double X3[24] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 1, 1, 0, 0, 0, 1, 1, 0, 1, 0, 1, 1, 1, 1, 1};
static const int tets[24] = {0, 1, 3, 7, 0, 5, 1, 7, 0, 3, 2, 7, 0, 2, 6, 7, 0, 4, 5, 7, 0, 6, 4, 7};
static const double X2[8] = {0, 0, 1, 0, 0, 1, 1, 1};
static const int triangles[6] = {0, 1, 3, 0, 3, 2};

// A unit cube or square, its lower side at 0.
static tss_body_def unit(int dim) {
    tss_body_def d = tss_body_def_default();
    d.nodes = dim == 3 ? 8 : 4, d.X = dim == 3 ? X3 : X2;
    d.cells = dim == 3 ? 6 : 2, d.cell = dim == 3 ? tets : triangles;
    return d;
}

static int some_dim(void) { return NO_3D ? 2 : 3; }

// The call was refused because of a switch that its message names, or did what it says.
static void expect(int left_out, tss_result got, tss_result refusal, const char *message, const char *name) {
    assert_int_equal(got, left_out ? refusal : TSS_OK);
    if (left_out) assert_non_null(strstr(message, name));
}

static void test_dimensions(void **state) {
    (void)state;
    for (int dim = 2; dim <= 3; dim++) {
        tss_world_def d = tss_world_def_default();
        tss_world *w = NULL;
        d.host = host_with_log(), d.dim = dim;
        tss_result r = tss_world_create(&d, &w);
        expect(dim == 2 ? NO_2D : NO_3D, r, TSS_ERROR_BAD_ARGUMENT, logged, dim == 2 ? "TSS_NO_2D" : "TSS_NO_3D");
        assert_true((w == NULL) == (r != TSS_OK));
        tss_world_destroy(w);
    }
}

static void stiff(void *user, int dim, int count, const int *cell, const double *F, double *psi, double *P, double *C) {
    (void)user, (void)cell, (void)C;
    for (int k = 0; k < count; k++) {
        if (psi) psi[k] = 0;
        for (int i = 0; i < dim * dim; i++) {
            double u = F[k * dim * dim + i] - (i % (dim + 1) == 0);
            if (psi) psi[k] += 0.5 * 1e5 * u * u;
            if (P) P[k * dim * dim + i] = 1e5 * u;
        }
    }
}

static void test_materials(void **state) {
    (void)state;
    for (int kind = 0; kind < TSS_MATERIAL_KINDS; kind++) {
        tss_world *w = world(some_dim());
        tss_body_def d = unit(some_dim());
        d.material.kind = (tss_material_kind)kind, d.material.density = stiff;
        tss_result r = tss_body_add(w, &d, NULL);
        expect(NO_MATERIALS && kind != TSS_NEO_HOOKEAN, r, TSS_ERROR_BAD_MATERIAL, tss_world_error(w), "TSS_NO_MATERIALS");
        assert_int_equal(tss_world_nodes(w), r == TSS_OK ? d.nodes : 0);
        if (r == TSS_OK) assert_int_equal(tss_world_step(w, NULL), TSS_OK);
        tss_world_destroy(w);
    }
}

static void test_damping(void **state) {
    (void)state;
    tss_world *w = world(some_dim());
    tss_body_def d = unit(some_dim());
    d.material.damping = 0.01;
    tss_result r = tss_body_add(w, &d, NULL);
    expect(NO_DAMPING, r, TSS_ERROR_BAD_MATERIAL, tss_world_error(w), "TSS_NO_DAMPING");
    if (r == TSS_OK) assert_int_equal(tss_world_step(w, NULL), TSS_OK);
    tss_world_destroy(w);
}

static void destroy(tss_result r, tss_energy_def *e, const tss_host *host) {
    if (r == TSS_OK) e->destroy(e->user, host);
    *e = tss_energy_def_default();
}

static void test_thin(void **state) {
    (void)state;
    static const int face[3] = {0, 1, 2}, hinge[4] = {0, 1, 2, 3}, spring[2] = {0, 1};
    static const double X[12] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 1, -1, 0};
    tss_host host = host_with_log();
    tss_energy_def e = tss_energy_def_default();
    tss_membrane_def m = tss_membrane_def_default();
    m.triangles = 1, m.node = face, m.X = X;
    tss_result r = tss_membrane_energy(&host, &m, &e);
    expect(NO_THIN || NO_3D, r, TSS_ERROR_BAD_ARGUMENT, logged, NO_THIN ? "TSS_NO_THIN" : "TSS_NO_3D");
    destroy(r, &e, &host);
    tss_hinge_def h = tss_hinge_def_default();
    h.hinges = 1, h.node = hinge, h.X = X, logged[0] = 0;
    r = tss_hinge_energy(&host, &h, &e);
    expect(NO_THIN || NO_3D, r, TSS_ERROR_BAD_ARGUMENT, logged, NO_THIN ? "TSS_NO_THIN" : "TSS_NO_3D");
    destroy(r, &e, &host);
    for (int dim = 2; dim <= 3; dim++) {
        tss_spring_def s = tss_spring_def_default();
        s.springs = 1, s.node = spring, s.X = X, s.dim = dim, logged[0] = 0;
        r = tss_spring_energy(&host, &s, &e);
        expect(NO_THIN || (dim == 2 ? NO_2D : NO_3D), r, TSS_ERROR_BAD_ARGUMENT, logged,
               NO_THIN ? "TSS_NO_THIN" : dim == 2 ? "TSS_NO_2D" : "TSS_NO_3D");
        destroy(r, &e, &host);
    }
}

// mu in each of the four places where it may stand. Without it contact works in every build.
static void test_friction(void **state) {
    (void)state;
    for (int place = 0; place <= 4; place++) {
        tss_world *w = world(some_dim());
        tss_body_def d = unit(some_dim());
        tss_ipc_def c = tss_ipc_def_default();
        tss_ipc_plane plane = {{0, -0.001, 0}, {0, 1, 0}, 0};
        tss_ipc_body body = {0, -1, -1};
        tss_ipc_pair pair = {0, 0, 0, -1};
        d.velocity[0] = 0.1;
        assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
        c.planes = c.bodies = c.pairs = 1, c.plane = &plane, c.body = &body, c.pair = &pair;
        *(place == 1 ? &c.mu : place == 2 ? &plane.mu : place == 3 ? &body.mu : &pair.mu) = place ? 0.3 : 0;
        tss_result r = tss_ipc_add(w, &c, NULL);
        expect(NO_FRICTION && place > 0, r, TSS_ERROR_BAD_ARGUMENT, tss_world_error(w), "TSS_NO_FRICTION");
        tss_step_info info;
        for (int k = 0; k < 5; k++) assert_int_equal(tss_world_step(w, &info), TSS_OK);
        double low = 1;
        for (int i = 0; i < d.nodes; i++) low = fmin(low, tss_world_positions(w)[i * some_dim() + 1]);
        if (r == TSS_OK) assert_true(low > -0.001);   // not through the plane
        if (r != TSS_OK) assert_true(low < -0.005);  // refused: nothing was added, it falls
        tss_world_destroy(w);
    }
}

static void test_bases(void **state) {
    (void)state;
    double snapshots[2 * 24];
    const int dim = some_dim(), nd = dim == 3 ? 24 : 8;
    for (int i = 0; i < 2 * nd; i++) snapshots[i] = (dim == 3 ? X3 : X2)[i % nd] * (i < nd ? 1 : 1.1);
    const tss_basis_def all[] = {tss_basis_affine(), tss_basis_quadratic(), tss_basis_skinning(2),
                                 tss_basis_biharmonic(2), tss_basis_eigen(2), tss_basis_pod(snapshots, 2, 1)};
    for (int k = 0; k < 6; k++) {
        tss_world *w = world(dim);
        tss_body_def d = unit(dim);
        assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
        tss_result r = tss_basis_add(w, 0, &all[k], NULL);
        expect(NO_EIGEN && k >= 2, r, TSS_ERROR_BAD_ARGUMENT, tss_world_error(w), "TSS_NO_EIGEN");
        assert_int_equal(tss_world_bases(w), r == TSS_OK);
        assert_int_equal(tss_world_step(w, NULL), TSS_OK);
        tss_world_destroy(w);
    }
}

// The public queries of pairs that only 3D has: not a number, and no step is proven.
static void test_pairs(void **state) {
    (void)state;
    const double x[12] = {0, 0, 0, 1, 0, 0, 0.3, 0.5, -1, 0.3, 0.5, 1}, d[12] = {0, 1};
    double s = tss_ipc_distance(TSS_IPC_EDGE_EDGE, 3, x, NULL);
    double t = tss_ipc_ccd(TSS_IPC_EDGE_EDGE, 3, x, d, 0.1, 1, 0, NULL);
    if (NO_3D) {
        assert_true(isnan(s));
        assert_true(t == 0);
    } else {
        assert_true(fabs(s - 0.25) < 1e-15);
        assert_true(t > 0.2);
    }
    const double y[6] = {0, 0.5, -1, 0, 1, 0};
    assert_true(fabs(tss_ipc_distance(TSS_IPC_POINT_EDGE, 2, y, NULL) - 0.25) < 1e-15);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_dimensions), cmocka_unit_test(test_materials), cmocka_unit_test(test_damping),
        cmocka_unit_test(test_thin),       cmocka_unit_test(test_friction),  cmocka_unit_test(test_bases),
        cmocka_unit_test(test_pairs),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
