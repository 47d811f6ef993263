// Contact in a real world: blocks that fall on each other, an obstacle and a plane, with friction.
// Every accepted iterate is checked for intersections by tests that know nothing of the barrier.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
// cmocka.h needs the three above.
#include <cmocka.h>

enum { GRID = 4, NODES = GRID * GRID * GRID, CELLS = 6 * (GRID - 1) * (GRID - 1) * (GRID - 1) };

typedef struct block {
    double X[3 * NODES];
    int cell[4 * CELLS];
} block;

// A block of (GRID − 1)³ cubes of six tets each, or GRID² nodes and triangles in 2D.
static void make_block(block *b, double size, const double at[3], double turn) {
    static const int path[6][2] = {{1, 2}, {1, 4}, {2, 1}, {2, 4}, {4, 1}, {4, 2}};
    int n = 0, c = 0;
    for (int k = 0; k < GRID; k++)
        for (int j = 0; j < GRID; j++)
            for (int i = 0; i < GRID; i++) {
                double x = size * i / (GRID - 1) - size / 2, z = size * k / (GRID - 1) - size / 2;
                b->X[n++] = at[0] + cos(turn) * x - sin(turn) * z;
                b->X[n++] = at[1] + size * j / (GRID - 1);
                b->X[n++] = at[2] + sin(turn) * x + cos(turn) * z;
            }
    for (int k = 0; k + 1 < GRID; k++)
        for (int j = 0; j + 1 < GRID; j++)
            for (int i = 0; i + 1 < GRID; i++)
                for (int t = 0; t < 6; t++) {
                    int corner[4] = {0, path[t][0], path[t][0] | path[t][1], 7}, v[4];
                    for (int q = 0; q < 4; q++)
                        v[q] = (i + (corner[q] & 1)) + GRID * (j + (corner[q] >> 1 & 1)) +
                               GRID * GRID * (k + (corner[q] >> 2));
                    int odd =
                        t == 0 || t == 3 || t == 4;  // parity of the path: keep volumes positive
                    b->cell[c++] = v[0], b->cell[c++] = v[odd ? 1 : 2],
                    b->cell[c++] = v[odd ? 2 : 1], b->cell[c++] = v[3];
                }
}

typedef struct scene {
    tss_world *w;
    tss_ipc *contact;
    int iterates, intersections;
} scene;

static void on_iterate(const double *x0, const double *x1, void *ctx) {
    scene *s = (scene *)ctx;
    tss_ctx c;
    (void)x0;
    memset(&c, 0, sizeof c);
    c.dim = 3, c.X = tss_world_rest(s->w), c.nodes = tss_world_nodes(s->w),
    c.body = (const int *)s->contact->body_of.p;
    s->iterates++;
    if (s->contact->body_of.p)
        s->intersections += tss__ipc_intersections(s->contact, &c, x1, NULL, NULL);
}

static void make_scene(scene *s, int workers, tss_linear linear) {
    tss_world_def wd = tss_world_def_default();
    memset(s, 0, sizeof *s);
    wd.dt = 0.01, wd.on_iterate = on_iterate, wd.on_iterate_ctx = s, wd.host.workers = workers;
    wd.linear = linear;
    assert_int_equal(tss_world_create(&wd, &s->w), TSS_OK);
    static block b;
    const double at[3][3] = {{0, 0.02, 0}, {0.05, 0.55, 0.03}, {-0.04, 1.08, 0}};
    for (int i = 0; i < 3; i++) {
        tss_body_def d = tss_body_def_default();
        make_block(&b, 0.5, at[i], 0.4 * i);
        d.nodes = NODES, d.X = b.X, d.cells = CELLS, d.cell = b.cell;
        d.velocity[1] = -3;
        tss_result r = tss_body_add(s->w, &d, NULL);
        if (r != TSS_OK) print_message("%s\n", tss_world_error(s->w));
        assert_int_equal(r, TSS_OK);
    }
    tss_ipc_def id = tss_ipc_def_default();
    tss_ipc_plane floor_plane = {{0, 0, 0}, {0, 1, 0}, 0.5};
    id.mu = 0.3, id.planes = 1, id.plane = &floor_plane, id.dhat = 0.01;
    assert_int_equal(tss_ipc_add(s->w, &id, &s->contact), TSS_OK);
}

static void test_pile(void **unused) {
    (void)unused;
    uint64_t hash[2];
    for (int run = 0; run < 2; run++) {
        scene s;
        tss_step_info info;
        int contacts = 0, newton = 0;
        make_scene(&s, run ? 3 : 1, TSS_LINEAR_AUTO);
        double least = HUGE_VAL;
        for (int i = 0; i < 60; i++) {
            assert_int_equal(tss_world_step(s.w, &info), TSS_OK);
            if (info.status != TSS_STEP_CONVERGED)
                print_message("    step %d: %s\n", i, info.message);
            assert_int_equal(info.status, TSS_STEP_CONVERGED);
            newton += info.newton, least = fmin(least, info.min_distance);
            int count;
            assert_int_equal(tss_ipc_contacts(s.contact, 0, NULL, &count), TSS_OK);
            contacts += count;
        }
        tss_ipc_info now;
        tss_ipc_get_info(s.contact, &now);
        print_message(
            "    %d iterates in 60 steps, %d contacts, least distance %.2e, kappa %.3g of "
            "%.3g..%.3g\n",
            newton, contacts, least, now.kappa, now.kappa_min, now.kappa_max);
        assert_true(contacts > 100 && least > 0 && s.iterates >= newton && s.intersections == 0);
        for (int i = 0; i < tss_world_nodes(s.w); i++)
            assert_true(tss_world_positions(s.w)[3 * i + 1] > 0);
        hash[run] = tss_world_hash(s.w);
        tss_world_destroy(s.w);
    }
    assert_true(hash[0] == hash[1]);
}

// The world's own derivative check on contact and friction in mid-pile.
static void test_energy_check(void **unused) {
    (void)unused;
    scene s;
    tss_step_info info;
    tss_energy_report report;
    make_scene(&s, 1, TSS_LINEAR_AUTO);
    for (int i = 0; i < 20; i++) assert_int_equal(tss_world_step(s.w, &info), TSS_OK);
    assert_int_equal(tss_energy_check(s.w, s.contact->barrier, &report), TSS_OK);
    print_message("    contact: gradient %.1e, Hessian %.1e, least eigenvalue %.1e\n",
                  report.gradient_error, report.hessian_error, report.psd_min);
    assert_true(report.gradient_error < 1e-5 && report.psd_min > -1e-9);
    tss_world_destroy(s.w);
}

// A resumed run takes the same bits: contact carries nothing over but κ, and the checkpoint holds
// the ordering of the Cholesky factorisation.
static void test_resume(void **unused) {
    (void)unused;
    scene a, b;
    tss_step_info info;
    make_scene(&a, 1, TSS_LINEAR_DIRECT), make_scene(&b, 1, TSS_LINEAR_DIRECT);
    for (int i = 0; i < 15; i++) assert_int_equal(tss_world_step(a.w, &info), TSS_OK);
    size_t size = tss_world_save(a.w, NULL, 0);
    void *data = malloc(size);
    assert_true(tss_world_save(a.w, data, size) == size);
    assert_int_equal(tss_world_prepare(b.w), TSS_OK);
    assert_int_equal(tss_world_load(b.w, data, size), TSS_OK);
    for (int i = 0; i < 5; i++) {
        assert_int_equal(tss_world_step(a.w, &info), TSS_OK);
        assert_int_equal(tss_world_step(b.w, &info), TSS_OK);
        assert_true(tss_world_hash(a.w) == tss_world_hash(b.w));
    }
    free(data);
    tss_world_destroy(a.w), tss_world_destroy(b.w);
}

// Two tetrahedra pushed into each other: no step starts, and the pair is named.
static void test_bad_start(void **unused) {
    (void)unused;
    double X[12] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1}, Y[12];
    int tet[4] = {0, 1, 2, 3};
    tss_world_def wd = tss_world_def_default();
    tss_world *w;
    assert_int_equal(tss_world_create(&wd, &w), TSS_OK);
    tss_body_def b = tss_body_def_default();
    b.nodes = 4, b.X = X, b.cells = 1, b.cell = tet, b.name = "left";
    assert_int_equal(tss_body_add(w, &b, NULL), TSS_OK);
    for (int k = 0; k < 12; k++) Y[k] = X[k] + 0.1;
    b.X = Y, b.name = "right";
    assert_int_equal(tss_body_add(w, &b, NULL), TSS_OK);
    tss_ipc_def c = tss_ipc_def_default();
    assert_int_equal(tss_ipc_add(w, &c, NULL), TSS_OK);
    assert_int_equal(tss_world_step(w, NULL), TSS_ERROR_INTERSECTION);
    print_message("    %s\n", tss_world_error(w));
    assert_non_null(strstr(tss_world_error(w), "triangle"));
    c.slack = 2;
    assert_int_equal(tss_ipc_add(w, &c, NULL), TSS_ERROR_BAD_ARGUMENT);
    assert_non_null(strstr(tss_world_error(w), "slack"));
    tss_world_destroy(w);
}

// A block on a slope: stays above the friction angle's coefficient, slides below it.
static void test_slope(void **unused) {
    (void)unused;
    double moved[2];
    for (int run = 0; run < 2; run++) {
        static block b;
        const double origin[3] = {0, 0.011, 0};
        const double slope = 0.3;  // tan of the angle
        scene s;
        memset(&s, 0, sizeof s);
        tss_world_def wd = tss_world_def_default();
        wd.dt = 0.01, wd.gravity[0] = 9.81 * sin(atan(slope)),
        wd.gravity[1] = -9.81 * cos(atan(slope)), wd.tol = 1e-4;
        assert_int_equal(tss_world_create(&wd, &s.w), TSS_OK);
        tss_body_def d = tss_body_def_default();
        make_block(&b, 0.5, origin, 0);
        d.nodes = NODES, d.X = b.X, d.cells = CELLS, d.cell = b.cell, d.material.E = 1e7;
        assert_int_equal(tss_body_add(s.w, &d, NULL), TSS_OK);
        tss_ipc_def id = tss_ipc_def_default();
        tss_ipc_plane plane = {{0, 0, 0}, {0, 1, 0}, run ? 0.2 : 0.4};
        id.planes = 1, id.plane = &plane, id.dhat = 0.01;
        assert_int_equal(tss_ipc_add(s.w, &id, &s.contact), TSS_OK);
        tss_step_info info;
        for (int i = 0; i < 100; i++) {
            assert_int_equal(tss_world_step(s.w, &info), TSS_OK);
            assert_int_equal(info.status, TSS_STEP_CONVERGED);
        }
        moved[run] = 0;
        for (int i = 0; i < NODES; i++)
            moved[run] += (tss_world_positions(s.w)[3 * i] - b.X[3 * i]) / NODES;
        double force[3 * NODES], sum[3] = {0};
        assert_int_equal(tss_ipc_forces(s.contact, force), TSS_OK);
        for (int i = 0; i < 3 * NODES; i++) sum[i % 3] += force[i];
        double weight = 125 * 9.81;
        print_message("    mu %.1f: moved %.4f m in 1 s; force %.3f %.3f of the weight\n", plane.mu,
                      moved[run], sum[0] / weight, sum[1] / weight);
        tss_world_destroy(s.w);
    }
    // Sliding: a = g (sin − mu cos), about ½ a t².
    double a = 9.81 * (sin(atan(0.3)) - 0.2 * cos(atan(0.3)));
    assert_true(fabs(moved[1] - 0.5 * a) < 0.15 * 0.5 * a);
    assert_true(moved[0] < 0.02);
}

// A block on a plane that is tilted slowly up to tan = 0.5. μ = 0.5 holds it: full friction, reached
// at the smoothing's ε_v, equals the weight's part along the slope, so the few ε_v it crept at while
// the plane still turned neither grow nor shrink. μ = 0.49 does not hold it: a = g (sin − 0.49 cos).
static void test_slope_limit(void **unused) {
    (void)unused;
    const double sine = sin(atan(0.5)), cosine = cos(atan(0.5)), g = 9.81;
    for (int run = 0; run < 2; run++) {
        static block b;
        const double origin[3] = {0, 0.008, 0}, mu = run ? 0.49 : 0.5;
        tss_world *w;
        tss_ipc *contact;
        tss_ipc_info ipc;
        tss_step_info info;
        tss_world_def wd = tss_world_def_default();
        wd.gravity[1] = -g, wd.tol = 1e-6, wd.integrator = TSS_IMPLICIT_EULER;
        assert_int_equal(tss_world_create(&wd, &w), TSS_OK);
        tss_body_def d = tss_body_def_default();
        make_block(&b, 0.5, origin, 0);
        d.nodes = NODES, d.X = b.X, d.cells = CELLS, d.cell = b.cell;
        d.material.E = 1e7, d.material.damping = 0.01;
        assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
        tss_ipc_plane plane = {{0, 0, 0}, {0, 1, 0}, mu};
        tss_ipc_def id = tss_ipc_def_default();
        id.planes = 1, id.plane = &plane, id.dhat = 0.01;
        assert_int_equal(tss_ipc_add(w, &id, &contact), TSS_OK);
        for (int i = 0; i < 300; i++) {
            double angle = atan(0.5) * fmax(0, fmin(1, (i - 100) / 180.0));
            double tilted[3] = {g * sin(angle), -g * cos(angle), 0};
            assert_int_equal(tss_world_set_gravity(w, tilted), TSS_OK);
            assert_int_equal(tss_world_step(w, NULL), TSS_OK);
        }
        double v = 0, before = 0;
        for (int i = 0; i < NODES; i++) before += tss_world_velocities(w)[3 * i] / NODES;
        for (int i = 0; i < 100; i++) {
            assert_int_equal(tss_world_step(w, &info), TSS_OK);
            assert_int_equal(info.status, TSS_STEP_CONVERGED);
        }
        double base = 0;  // the base alone: the rest also turns a little as the load moves downhill
        for (int i = 0; i < NODES; i++) {
            v += tss_world_velocities(w)[3 * i] / NODES;
            if (b.X[3 * i + 1] == origin[1]) base += tss_world_velocities(w)[3 * i] / (GRID * GRID);
        }
        tss_ipc_get_info(contact, &ipc);
        print_message("    mu %.2f: base %.3g m/s after 1 s, eps_v %.3g; all %.3g, free %.3g\n", mu, base,
                      ipc.eps_v, v - before, g * (sine - mu * cosine));
        if (run == 0) assert_true(fabs(v - before) < ipc.eps_v && base < 5 * ipc.eps_v);
        double a = g * (sine - mu * cosine);
        if (run == 1) assert_true(fabs(v - before - a) < 0.1 * a);
        // Pressure on the ground: the weight's normal part over the base.
        double pressure[NODES], most = 0;
        assert_int_equal(tss_ipc_pressures(contact, pressure), TSS_OK);
        for (int i = 0; i < NODES; i++) most = fmax(most, pressure[i]);
        double mean = 1000 * 0.5 * g * cosine;
        assert_true(most > 0.8 * mean && most < 4 * mean);
        tss_world_destroy(w);
    }
}

int main(void) {
    const struct CMUnitTest tests[] = {cmocka_unit_test(test_pile),
                                       cmocka_unit_test(test_energy_check),
                                       cmocka_unit_test(test_resume), cmocka_unit_test(test_slope), cmocka_unit_test(test_bad_start),
                                       cmocka_unit_test(test_slope_limit)};
    return cmocka_run_group_tests(tests, NULL, NULL);
}
