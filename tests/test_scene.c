// test_scene: scene.h reads what it should, names what it refuses, and moves things exactly.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"
#include "tss_io.h"
#include "tss_shapes.h"
#define SCENE_IMPLEMENTATION
#include "scene.h"

#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
// cmocka wants the headers above first
#include <cmocka.h>

#define PI 3.14159265358979323846

static void near_to(double a, double b, double tol) {
    if (!(fabs(a - b) <= tol)) fail_msg("%.17g is not %.17g (tolerance %g)", a, b, tol);
}

static void read_ok(scene *s, const char *text) {
    scene_error e;
    if (!scene_parse(s, "t.json", text, NULL, NULL, 0, &e)) fail_msg("%s", e.text);
}

// The message must hold every one of the parts (NULL ends them).
static void refused(const char *text, const char *part, const char *part2) {
    scene s;
    scene_error e;
    if (scene_parse(&s, "t.json", text, NULL, NULL, 0, &e)) fail_msg("was not refused: %s", text);
    if (!strstr(e.text, part) || (part2 && !strstr(e.text, part2)) || !strstr(e.text, "t.json"))
        fail_msg("\"%s\" does not say \"%s\" and \"%s\"", e.text, part, part2 ? part2 : "");
}

static tss_world *build(scene *s) {
    scene_error e;
    tss_world *w;
    tss_ipc *ipc;
    tss_host host = tss_host_default();
    host.workers = 1;
    if (!scene_build(s, &host, NULL, NULL, &w, &ipc, &e)) fail_msg("%s", e.text);
    return w;
}

static void steps(scene *s, tss_world *w, int n) {
    scene_error e;
    for (int k = 0; k < n; k++) {
        tss_step_info info;
        if (!scene_drive(s, w, &e)) fail_msg("%s", e.text);
        assert_int_equal(tss_world_step(w, &info), TSS_OK);
        if (info.status != TSS_STEP_CONVERGED)
            fail_msg("%s: %s", tss_status_text(info.status), info.message);
    }
}

// ---------------------------------------------------------------------------------------------

static void test_defaults(void **state) {
    scene s;
    (void)state;
    read_ok(&s, "{}");
    tss_world_def d = tss_world_def_default();
    assert_int_equal(s.world.dim, 3);
    assert_true(s.world.dt == d.dt && s.solver.tol_rel == d.tol_rel && s.contact.dhat_rel == 1e-3);
    assert_int_equal(s.world.integrator, TSS_BDF2);
    scene_free(&s);
}

static void test_values(void **state) {
    scene s;
    (void)state;
    read_ok(
        &s,
        "{\"world\": {\"dt\": 0.02, \"steps\": 7, \"gravity\": [1, 2, 3], \"integrator\": "
        "\"quasistatic\"},"
        "\"solver\": {\"tol\": 1e-4, \"linear\": \"pcg\", \"max_iterations\": 9},"
        "\"contact\": {\"dhat\": 0.01, \"mu\": 0.3, \"self\": false},"
        "\"planes\": [{\"origin\": [0, -1, 0], \"normal\": [0, 0, 2], \"mu\": 0.7}],"
        "\"bodies\": [{\"shape\": {\"kind\": \"box\", \"lower\": [0, 0, 0], \"upper\": [1, 1, 1],"
        "  \"cells\": [2, 3, 4]}, \"scale\": 2, \"rotate\": [0, 0, 90], \"translate\": [5, 0, 0],"
        "  \"material\": {\"kind\": \"stvk\", \"E\": 7, \"nu\": 0.1, \"rho\": 3},"
        "  \"angular_velocity\": [0, 180, 0], \"mu\": 0.2, \"color\": [0, 0.5, 1]}],"
        "\"frames\": {\"size\": [64, 48], \"field\": \"J\"}, \"run\": {\"check\": true}}");
    assert_true(s.world.dt == 0.02 && s.world.gravity[2] == 3 && s.solver.tol == 1e-4);
    assert_int_equal(s.world.steps, 7);
    assert_int_equal(s.world.integrator, TSS_QUASISTATIC);
    assert_int_equal(s.solver.linear, TSS_LINEAR_PCG);
    assert_int_equal(s.contact.self, 0);
    assert_true(s.plane[0].normal[2] == 1 && s.plane[0].mu == 0.7);
    assert_int_equal(s.body[0].mesh.nodes, 3 * 4 * 5);
    assert_int_equal(s.body[0].material.kind, TSS_STVK);
    near_to(s.body[0].angular[1], PI, 1e-15);
    assert_int_equal(s.frames.width, 64);
    assert_int_equal(s.frames.field, SCENE_FIELD_J);
    assert_int_equal(s.run.check, 1);
    // 2 [0,1]³ turned by 90° about z, then moved: x in 5 − 2 .. 5, y in 0 .. 2
    double lo[3], hi[3];
    tss_mesh_bounds(&s.body[0].mesh, lo, hi);
    near_to(lo[0], 3, 1e-12), near_to(hi[0], 5, 1e-12), near_to(lo[1], 0, 1e-12),
        near_to(hi[1], 2, 1e-12);
    scene_free(&s);
}

#define BOX "\"shape\": {\"kind\": \"box\", \"cells\": 1}"

static void test_refusals(void **state) {
    (void)state;
    refused("{\"wold\": {}}", "wold", "did you mean \"world\"?");
    refused("{\"world\": {\"stepz\": 3}}", "world.stepz", "did you mean \"steps\"?");
    refused("{\"world\": {\"zzzzzzzzz\": 3}}", "expected one of", "gravity");
    refused("{\"world\": {\"dt\": 0}}", "world.dt is 0", "> 0");
    refused("{\"world\": {\"dt\": \"fast\"}}", "world.dt is \"fast\"", "a number > 0");
    refused("{\"world\": {\"dim\": 4}}", "world.dim", "from 2 to 3");
    refused("{\"world\": {\"steps\": 1.5}}", "world.steps", "whole");
    refused("{\"world\": {\"gravity\": [1]}}", "world.gravity", "2 to 3 numbers");
    refused("{\"world\": {\"integrator\": \"bdf3\"}}", "world.integrator",
            "did you mean \"bdf2\"?");
    refused("{\"world\": 3}", "world is 3", "{ }");
    refused("{\"world\": {\"dt\": 1, \"dt\": 2}}", "world.dt is given twice", NULL);
    refused("{\"contact\": {\"self\": 1}}", "contact.self", "true or false");
    refused("{\n\"world\": {\"dt\": 0.1},\n\"solver\" {}\n}", "t.json:3", "not JSON");
    refused("{\"bodies\": {}}", "bodies", "[ ]");
    refused("{\"bodies\": [{}]}", "bodies[0]", "\"mesh\" or \"shape\"");
    refused("{\"bodies\": [{\"mesh\": \"no-such.msh\"}]}", "bodies[0]", "no-such.msh");
    refused("{\"bodies\": [{\"shape\": {\"kind\": \"bal\"}}]}", "bodies[0].shape.kind",
            "did you mean \"ball\"?");
    refused("{\"bodies\": [{\"shape\": {}}]}", "bodies[0].shape.kind is missing", NULL);
    refused("{\"bodies\": [{\"shape\": {\"kind\": \"box\", \"radius\": 1}}]}", "shape.radius",
            "no meaning");
    refused("{\"bodies\": [{\"shape\": {\"kind\": \"box\", \"grade\": [1, 0, 1]}}]}", "shape.grade",
            "1e-3 to 1e3");
    refused("{\"bodies\": [{\"shape\": {\"kind\": \"box\", \"grade\": [1, 2]}}]}", "shape.grade", NULL);
    refused("{\"bodies\": [{\"shape\": {\"kind\": \"ball\", \"grade\": [1, 2, 1]}}]}", "shape.grade",
            "no meaning");
    refused("{\"bodies\": [{\"shape\": {\"kind\": \"sheet\"}}]}", "bodies[0]",
            "\"obstacle\": true");
    refused("{\"bodies\": [{" BOX ", \"scale\": 0}]}", "bodies[0].scale", "other than 0");
    refused("{\"bodies\": [{" BOX ", \"material\": {\"nu\": 0.5}}]}", "bodies[0].material.nu",
            "0.4999");
    refused("{\"bodies\": [{" BOX ", \"color\": [2, 0, 0]}]}", "bodies[0].color", "0 to 1");
    refused("{\"bodies\": [{" BOX ", \"pins\": [{\"lower\": [2, 2, 2]}]}]}", "bodies[0].pins[0]",
            "no node");
    refused("{\"bodies\": [{" BOX ", \"pins\": [{\"axes\": \"xw\"}]}]}", "pins[0].axes", "xyz");
    refused("{\"bodies\": [{" BOX ", \"obstacle\": true, \"pins\": [{}]}]}",
            "obstacle has a motion", NULL);
    refused("{\"bodies\": [{" BOX
            ", \"motion\": {\"velocity\": [1, 0, 0], \"keyframes\": [{\"time\": 0}]}}]}",
            "motion.velocity", "keyframes");
    refused("{\"bodies\": [{" BOX
            ", \"motion\": {\"keyframes\": [{\"time\": 1}, {\"time\": 1}]}}]}",
            "keyframes[1].time", "more than");
    refused("{\"planes\": [{\"normal\": [0, 0, 0]}]}", "planes[0].normal", "direction");
    refused("{\"frames\": {\"size\": [8, 8]}}", "frames.size", "pixels");
    refused("{\"frames\": {\"field\": \"eror\"}}", "frames.field", "did you mean \"error\"?");
}

static void test_set(void **state) {
    static const char *const set[] = {"world.dt=0.5", "bodies.0.material.E=9",
                                      "frames.field=velocity"};
    static const char *const bad[] = {"world.dtt=0.5"}, *const wrong[] = {"nonsense"};
    const char *text = "{\"world\": {\"dt\": 0.1}, \"bodies\": [{" BOX "}]}";
    scene s;
    scene_error e;
    (void)state;
    assert_true(scene_parse(&s, "t.json", text, NULL, set, 3, &e));
    assert_true(s.world.dt == 0.5 && s.body[0].material.E == 9 &&
                s.frames.field == SCENE_FIELD_VELOCITY);
    scene_free(&s);
    assert_false(scene_parse(&s, "t.json", text, NULL, bad, 1, &e));
    assert_non_null(strstr(e.text, "did you mean \"dt\""));
    assert_false(scene_parse(&s, "t.json", text, NULL, wrong, 1, &e));
    assert_non_null(strstr(e.text, "key=value"));
}

// ---------------------------------------------------------------------------------------------

static void test_pose(void **state) {
    scene_motion m;
    double x[3] = {3, 1, 2}, y[3], r0 = 0, r1 = 0;
    (void)state;
    memset(&m, 0, sizeof m);
    m.pivot[0] = 1, m.pivot[1] = 1, m.velocity[1] = 10, m.angular[2] = PI / 2;
    // a quarter turn about z through (1, 1): (3, 1) → (1, 3), and 10 up
    scene_pose(&m, 1, x, y);
    near_to(y[0], 1, 1e-14), near_to(y[1], 13, 1e-14), assert_true(y[2] == 2);
    // any axis: distance to the pivot stays, over many turns
    m.angular[0] = 11, m.angular[1] = -7, m.velocity[1] = 0;
    scene_pose(&m, 321.7, x, y);
    for (int c = 0; c < 3; c++)
        r0 += (x[c] - m.pivot[c]) * (x[c] - m.pivot[c]),
            r1 += (y[c] - m.pivot[c]) * (y[c] - m.pivot[c]);
    near_to(r1, r0, 1e-13);
    // the axis itself does not move
    for (int c = 0; c < 3; c++) x[c] = m.pivot[c] + 0.3 * m.angular[c];
    scene_pose(&m, 12.3, x, y);
    for (int c = 0; c < 3; c++) near_to(y[c], x[c], 1e-13);
}

static void test_keyframes(void **state) {
    scene s;
    double x[3] = {1, 0, 0}, y[3];
    (void)state;
    read_ok(&s,
            "{\"bodies\": [{\"shape\": {\"kind\": \"sheet\", \"cells\": 1}, \"obstacle\": true, "
            "\"motion\":"
            "{\"pivot\": [0, 0, 0], \"keyframes\": [{\"time\": 1}, {\"time\": 3, \"translate\": "
            "[0, 4, 0],"
            "\"rotate\": [0, 0, 180]}]}}]}");
    const scene_motion *m = &s.body[0].motion;
    scene_pose(m, 0.5, x, y);  // before the first: as there
    assert_true(y[0] == 1 && y[1] == 0);
    scene_pose(m, 2, x, y);  // half way: a quarter turn, 2 up
    near_to(y[0], 0, 1e-15), near_to(y[1], 3, 1e-15);
    scene_pose(m, 9, x, y);
    near_to(y[0], -1, 1e-15), near_to(y[1], 4, 1e-15);
    scene_free(&s);
}

#define ROD                                                                                      \
    "\"shape\": {\"kind\": \"box\", \"lower\": [0, 0, 0], \"upper\": [1, 0.2, 0.2], \"cells\": " \
    "[5, 1, 1]}"
#define QUIET                                                                                    \
    "\"world\": {\"dt\": 0.1, \"gravity\": [0, 0, 0], \"integrator\": \"euler\"}, \"contact\": " \
    "{\"enabled\": false}"

// One end turns a quarter about its own middle: exactly there after 10 steps, and not before 0.5 s.
static void test_pin_motion(void **state) {
    scene s;
    (void)state;
    read_ok(&s,
            "{" QUIET ", \"bodies\": [{" ROD
            ", \"pins\": [{\"upper\": [0, 1, 1]}, {\"lower\": [1, 0, 0],"
            "\"motion\": {\"angular_velocity\": [90, 0, 0], \"start\": 0.5, \"end\": 1.5}}]}]}");
    assert_int_equal(s.body[0].pins, 2);
    assert_int_equal(s.body[0].pin[1].nodes, 4);
    tss_world *w = build(&s);
    const scene_pin *p = &s.body[0].pin[1];
    const double *X = s.body[0].mesh.x;
    steps(&s, w, 5);
    for (int i = 0; i < p->nodes; i++)
        for (int c = 0; c < 3; c++)
            assert_true(tss_world_positions(w)[3 * p->node[i] + c] == X[3 * p->node[i] + c]);
    steps(&s, w, 12);
    for (int i = 0; i < p->nodes; i++) {
        const double *x = tss_world_positions(w) + 3 * p->node[i], *x0 = X + 3 * p->node[i];
        near_to(x[0], x0[0], 1e-12);
        near_to(x[1] - 0.1, -(x0[2] - 0.1), 1e-9);
        near_to(x[2] - 0.1, x0[1] - 0.1, 1e-9);
    }
    tss_world_destroy(w);
    scene_free(&s);
}

// Released nodes are free: a body whose pins let go falls.
static void test_release(void **state) {
    scene s;
    (void)state;
    read_ok(&s,
            "{\"world\": {\"dt\": 0.1, \"integrator\": \"euler\"}, \"contact\": {\"enabled\": "
            "false}, \"bodies\":"
            "[{" BOX ", \"pins\": [{\"release\": true, \"motion\": {\"end\": 0.3}}]}]}");
    tss_world *w = build(&s);
    steps(&s, w, 3);
    for (int i = 0; i < 8; i++)
        assert_true(tss_world_positions(w)[3 * i + 1] == s.body[0].mesh.x[3 * i + 1]);
    steps(&s, w, 1);
    for (int i = 0; i < 8; i++)
        near_to(tss_world_positions(w)[3 * i + 1], s.body[0].mesh.x[3 * i + 1] - 0.0980665, 1e-6);
    tss_world_destroy(w);
    scene_free(&s);
}

// A motion that starts late takes the nodes from where they have fallen to.
static void test_capture(void **state) {
    scene s;
    double y[4];
    (void)state;
    read_ok(
        &s,
        "{\"world\": {\"dt\": 0.1, \"integrator\": \"euler\"}, \"contact\": {\"enabled\": false},"
        "\"bodies\": [{" BOX
        ", \"pins\": [{\"lower\": [0, 1, 0], \"release\": true, \"motion\":"
        "{\"start\": 0.2, \"end\": 0.4, \"velocity\": [0, 1, 0]}}]}]}");
    const int *top = s.body[0].pin[0].node;
    tss_world *w = build(&s);
    assert_int_equal(s.body[0].pin[0].nodes, 4);
    steps(&s, w, 2);
    for (int i = 0; i < 4; i++) y[i] = tss_world_positions(w)[3 * top[i] + 1];
    near_to(y[0], 0.5 - 3 * 0.0980665, 1e-6);
    steps(&s, w, 2);
    for (int i = 0; i < 4; i++) near_to(tss_world_positions(w)[3 * top[i] + 1], y[i] + 0.2, 1e-9);
    tss_world_destroy(w);
    scene_free(&s);
}

// Implicit Euler under a constant acceleration a: v = a t, and the force stops at its end.
static void test_forces(void **state) {
    scene s;
    double v[3] = {0, 0, 0}, mass = 0;
    (void)state;
    read_ok(&s, "{" QUIET ", \"bodies\": [{" BOX
                ", \"forces\": [{\"acceleration\": [0, 3, 0], \"end\": 0.4},"
                "{\"force\": [2000, 0, 0], \"start\": 0.2}]}]}");
    tss_world *w = build(&s);
    steps(&s, w, 10);
    for (int i = 0; i < 8; i++) {
        mass += tss_world_masses(w)[i];
        for (int c = 0; c < 3; c++)
            v[c] += tss_world_masses(w)[i] * tss_world_velocities(w)[3 * i + c];
    }
    near_to(mass, 1000, 1e-9);
    near_to(v[1] / mass, 3 * 0.4, 1e-6);
    near_to(v[0] / mass, 2 * 0.8, 1e-6);
    tss_world_destroy(w);
    scene_free(&s);
}

static void test_spin(void **state) {
    scene s;
    (void)state;
    read_ok(&s, "{" QUIET ", \"bodies\": [{" BOX
                ", \"velocity\": [1, 0, 0], \"angular_velocity\": [0, 0, 180]}]}");
    tss_world *w = build(&s);
    for (int i = 0; i < 8; i++) {
        const double *x = s.body[0].mesh.x + 3 * i, *v = tss_world_velocities(w) + 3 * i;
        near_to(v[0], 1 - PI * x[1], 1e-12), near_to(v[1], PI * x[0], 1e-12),
            near_to(v[2], 0, 1e-12);
    }
    tss_world_destroy(w);
    scene_free(&s);
}

// A moving plate, contact and friction: 8 steps are the same bits as 4, a checkpoint, and 4 more
// elsewhere.
static void test_resume(void **state) {
    const char *text =
        "{\"world\": {\"dt\": 0.02}, \"contact\": {\"mu\": 0.3}, \"bodies\": [{" BOX
        ", \"pins\":"
        "[{\"upper\": [0, 1, 1], \"release\": true, \"motion\": {\"velocity\": [0, 0.5, 0],"
        "\"start\": 0.02, \"end\": 0.1}}], \"forces\": [{\"acceleration\": [1, 0, 0]}]},"
        "{\"shape\": {\"kind\": \"sheet\", \"cells\": 1}, \"scale\": 3, \"translate\": [0, -0.51, "
        "0],"
        "\"obstacle\": true, \"motion\": {\"velocity\": [0, 0.2, 0], \"angular_velocity\": [0, 90, "
        "0]}}]}";
    scene a, b;
    (void)state;
    read_ok(&a, text), read_ok(&b, text);
    tss_world *w = build(&a), *u = build(&b);
    steps(&a, w, 4);
    size_t n = tss_world_save(w, NULL, 0), m = scene_state(&a, NULL, 0, 1);
    char *data = (char *)malloc(n + m);
    assert_true(tss_world_save(w, data, n) == n && scene_state(&a, data + n, m, 1) == m);
    steps(&a, w, 4);
    assert_int_equal(tss_world_load(u, data, n), TSS_OK);
    assert_true(scene_state(&b, data + n, m, 0) == m);
    assert_true(scene_state(&b, data + n, m - 1, 0) == 0);
    steps(&b, u, 4);
    assert_true(tss_world_hash(w) == tss_world_hash(u));
    free(data);
    tss_world_destroy(w), tss_world_destroy(u);
    scene_free(&a), scene_free(&b);
}

// ---------------------------------------------------------------------------------------------

// A unit cube of six tets and a flat square, beside the test.
static void write_meshes(void) {
    static const double lo[3] = {0, 0, 0}, hi[3] = {1, 1, 1};
    static const int n[3] = {1, 1, 1};
    tss_mesh cube;
    assert_int_equal(tss_shape_box(NULL, lo, hi, n, 6, NULL, &cube), TSS_OK);
    FILE *f = fopen("scene_cube.mesh", "w");
    assert_non_null(f);
    fprintf(f, "MeshVersionFormatted 2\nDimension 3\nVertices\n%d\n", cube.nodes);
    for (int i = 0; i < cube.nodes; i++)
        fprintf(f, "%g %g %g 0\n", cube.x[3 * i], cube.x[3 * i + 1], cube.x[3 * i + 2]);
    fprintf(f, "Tetrahedra\n%d\n", cube.tets);
    for (int i = 0; i < cube.tets; i++)
        fprintf(f, "%d %d %d %d 0\n", cube.tet[4 * i] + 1, cube.tet[4 * i + 1] + 1,
                cube.tet[4 * i + 2] + 1, cube.tet[4 * i + 3] + 1);
    fprintf(f, "End\n");
    fclose(f);
    tss_mesh_free(&cube);
    f = fopen("scene_square.obj", "w");
    assert_non_null(f);
    fprintf(f, "v 0 0 0\nv 1 0 0\nv 1 0 1\nv 0 0 1\nf 1 3 2\nf 1 4 3\n");
    fclose(f);
    f = fopen("scene_edge.seg", "w");
    assert_non_null(f);
    fprintf(f, "v 0 0 0\nv 1 0 0\ns 1 2\n");
    fclose(f);
}

static int with_meshes(void **state) {
    (void)state;
    write_meshes();
    return 0;
}

static int without_meshes(void **state) {
    (void)state;
    return remove("scene_cube.mesh") | remove("scene_square.obj") | remove("scene_edge.seg");
}

#define CUBE(x, y, z) "scene_cube.mesh " #x " " #y " " #z "  0 0 0  1 1 1"

static void test_script_values(void **state) {
    scene s;
    (void)state;
    read_ok(&s, "# a comment\nenergy FCR\ntime 5 0.1\ndensity 500\nstiffness 1e6 0.3  # Pa\n"
                "tuning 2\n1e-4\n5e-1\n"
                "tol 1\n1e-3\nepsv 2e-3\nselfFric 0.25\nfricIterAmt 3\nturnOffGravity\n"
                "dampingRatio 0.4\n"
                "shapes input 2\n" CUBE(0, 0, 0) " material 2000 1e8 0.2 initVel 1 2 3 0 0 90\n"
                CUBE(3, 0, 0) "\n"
                "halfSpace 0 -1 0  0 2 0  50 0.7\nground 0.1 -2\nview perspective\n"
                "section SQP QP\ntime 10 5e-3\ntol 1\n1\nsection end\n");
    assert_int_equal(s.world.steps, 50);
    assert_int_equal(s.world.integrator, TSS_IMPLICIT_EULER);
    assert_true(s.world.dt == 0.1 && s.world.gravity[1] == 0 && s.contact.dhat_rel == 0.5 &&
                s.solver.tol_rel == 1e-3);
    assert_true(s.contact.eps_v_rel == 2e-3 && s.contact.mu == 0.25 && s.contact.dhat_edge == 0);
    assert_int_equal(s.contact.friction_iterations, 3);
    assert_int_equal(s.bodies, 2);
    assert_int_equal(s.body[0].material.kind, TSS_FIXED_COROTATED);
    assert_true(s.body[0].material.E == 1e8 && s.body[0].material.rho == 2000 &&
                s.body[0].velocity[2] == 3);
    assert_true(s.body[1].material.E == 1e6 && s.body[1].material.rho == 500 &&
                s.body[1].material.nu == 0.3);
    near_to(s.body[0].angular[2], PI / 2, 1e-15);
    near_to(s.body[0].material.damping, 0.75 * 0.4 * 0.1, 1e-15);
    assert_int_equal(s.planes, 2);
    assert_true(s.plane[0].normal[1] == 1 && s.plane[0].mu == 0.7 && s.plane[1].origin[1] == -2 &&
                s.plane[1].mu == 0.1);
    assert_non_null(strstr(s.warnings, "view is skipped"));
    scene_free(&s);
}

// Two cubes, 4 wide in x: size 1 scales by 1/4 to the origin; fall lifts by half the diagonal;
// meshCO stays.
static void test_script_places(void **state) {
    scene s;
    double lo[3], hi[3], lift = 0.5 * sqrt(1 + 2.0 / 16);
    (void)state;
    read_ok(&s, "size 1\nscript fall\nshapes input 2\n" CUBE(2, 5, 1) "\n" CUBE(5, 5, 1) "\n"
                "meshCO scene_square.obj 0.5 -1 0.25  10  50 0.5 rotate 0 0 90\n");
    assert_int_equal(s.bodies, 3);
    tss_mesh_bounds(&s.body[0].mesh, lo, hi);
    near_to(lo[0], 0, 1e-15), near_to(hi[0], 0.25, 1e-15), near_to(lo[1], lift, 1e-15),
        near_to(hi[1], lift + 0.25, 1e-15);
    tss_mesh_bounds(&s.body[1].mesh, lo, hi);
    near_to(lo[0], 0.75, 1e-15), near_to(hi[0], 1, 1e-15);
    tss_mesh_bounds(&s.body[2].mesh, lo, hi);
    // its mean at the origin, 10 across, turned from the x–z into the y–z plane
    near_to(lo[0], 0.5, 1e-14), near_to(hi[0], 0.5, 1e-14), near_to(lo[1], -6, 1e-13),
        near_to(hi[1], 4, 1e-13);
    near_to(lo[2], -4.75, 1e-13), near_to(hi[2], 5.25, 1e-13);
    assert_true(s.body[2].collider && s.body[2].obstacle && s.body[2].mu == 0.5);
    scene_free(&s);
}

// The diagonal is that of the rest shape: rotateModel turns only where the body starts.
static void test_script_rotates(void **state) {
    scene s;
    double lo[3], hi[3];
    (void)state;
    read_ok(&s, "rotateModel 0 0 1 45\nshapes input 1\n" CUBE(0, 0, 0) "\n");
    tss_mesh_bounds(&s.body[0].mesh, lo, hi);
    near_to(hi[0] - lo[0], sqrt(2.0), 1e-14);
    tss_world *w = build(&s);
    near_to(tss_world_diagonal(w), sqrt(3.0), 1e-14);
    tss_world_destroy(w);
    scene_free(&s);
}

static void test_script_matrix(void **state) {
    scene s;
    double lo[3], hi[3];
    (void)state;
    read_ok(&s, "script DCOSegBedSquash\nshapes input 1\n" CUBE(0.5, 1.5, 0.5) "\n"
                "shapeMatrix input 2 1 2\n"
                "scene_edge.seg 1 1 1  0 0 90  1 1 1\nshapeMatrix input 2 1 2  0 3 0\n"
                "scene_edge.seg 1 1 1  0 0 90  1 1 1\n"
                "time 1 0.25\nturnOffGravity\n");
    assert_int_equal(s.bodies, 9);
    tss_mesh_bounds(&s.body[4].mesh, lo, hi);  // the last of the first four: (1, 0, 1), standing
    near_to(lo[0], 1, 1e-15), near_to(lo[1], 0, 1e-15), near_to(hi[1], 1, 1e-15),
        near_to(lo[2], 1, 1e-15);
    tss_mesh_bounds(&s.body[5].mesh, lo, hi);
    near_to(lo[1], 3, 1e-15);
    tss_world *w = build(&s);
    assert_int_equal(s.drivens, 4);  // shapes 5 to 8 of 9
    steps(&s, w, 1);
    near_to(tss_world_positions(w)[3 * s.body[5].first + 1], 2.75, 1e-12);
    near_to(tss_world_positions(w)[3 * s.body[1].first + 1], 0, 0);
    tss_world_destroy(w);
    scene_free(&s);
}

// Both ends turn about the x axis through the middle at 0.4π rad/s, the left one backwards.
static void test_script_twist(void **state) {
    scene s;
    (void)state;
    read_ok(&s,
            "script twist\nturnOffGravity\nshapes input 1\nscene_cube.mesh 0 0 0  0 0 0  4 1 "
            "1\ntime 1 0.25\n");
    tss_world *w = build(&s);
    steps(&s, w, 2);
    for (int i = 0; i < 8; i++) {
        const double *x0 = s.body[0].mesh.x + 3 * i, *x = tss_world_positions(w) + 3 * i;
        double a = (x0[0] > 2 ? 1 : -1) * 0.4 * PI * 0.5, y = x0[1] - 0.5, z = x0[2] - 0.5;
        near_to(x[0], x0[0], 1e-12);
        near_to(x[1] - 0.5, cos(a) * y - sin(a) * z, 1e-9);
        near_to(x[2] - 0.5, sin(a) * y + cos(a) * z, 1e-9);
    }
    tss_world_destroy(w);
    scene_free(&s);
}

// 1 m/s until the left end is past −0.28: steps start at 0, −0.1, −0.2; at −0.3 it stands.
static void test_script_stretch(void **state) {
    scene s;
    (void)state;
    read_ok(&s,
            "script stretchAndPause\nturnOffGravity\nshapes input 1\nscene_cube.mesh 0 0 0  0 0 0  "
            "4 1 1\ntime 1 0.1\n");
    tss_world *w = build(&s);
    steps(&s, w, 6);
    for (int i = 0; i < 8; i++)
        near_to(tss_world_positions(w)[3 * i], s.body[0].mesh.x[3 * i] > 2 ? 4.3 : -0.3, 1e-9);
    tss_world_destroy(w);
    scene_free(&s);
}

// The right end drags the cube past the square, then lets go.
static void test_script_dragright(void **state) {
    scene s;
    (void)state;
    read_ok(&s, "script dragright\nturnOffGravity\nshapes input 1\n" CUBE(0, 0, 0) "\ntime 1 0.5\n"
                "meshCO scene_square.obj -0.2 -5 0  1  50 0\n");
    tss_world *w = build(&s);
    steps(&s, w, 1);
    assert_int_equal(s.drivens, 1);
    assert_int_equal(s.driven[0].state, 1);
    for (int k = 0; k < 4 && s.driven[0].state == 1; k++) steps(&s, w, 1);
    assert_int_equal(s.driven[0].state, 2);
    for (int i = 0; i < 8; i++) assert_int_equal(tss_world_kinds(w)[i], TSS_NODE_FREE);
    tss_world_destroy(w);
    scene_free(&s);
}

// DBC: only while its time lasts, only nodes of its box (in the file's frame, before the shape is
// turned).
static void test_script_boundary(void **state) {
    scene s;
    (void)state;
    read_ok(&s,
            "turnOffGravity\ntime 1 0.1\nshapes input 1\nscene_cube.mesh 0 0 0  0 0 90  1 1 1 "
            "DBC -0.1 -0.1 -0.1 0.1 1.1 1.1  0 1 0  0 0 0  0 0.25 NBC 0.9 -1 -1 1.1 2 2  0 0 5\n");
    assert_int_equal(s.body[0].pins, 1);
    assert_int_equal(s.body[0].pin[0].nodes, 4);
    assert_int_equal(s.body[0].forces, 1);
    for (int i = 0; i < 4; i++)
        near_to(s.body[0].mesh.x[3 * s.body[0].pin[0].node[i] + 1], 0, 1e-15);
    tss_world *w = build(&s);
    steps(&s, w, 3);  // starts at 0, 0.1, 0.2
    for (int i = 0; i < 4; i++)
        near_to(tss_world_positions(w)[3 * s.body[0].pin[0].node[i] + 1], 0.3, 1e-9);
    steps(&s, w, 1);
    assert_int_equal(tss_world_kinds(w)[s.body[0].pin[0].node[0]], TSS_NODE_FREE);
    tss_world_destroy(w);
    scene_free(&s);
}

static void test_script_refusals(void **state) {
    (void)state;
    refused("density 1000\nstifness 1 0.4\n", "t.json:2", "did you mean \"stiffness\"?");
    refused("script tiwst\n", "t.json:1", "did you mean \"twist\"?");
    refused("time 5\n", "t.json:1: time", "argument 2");
    refused("energy XX\n", "NH or FCR", NULL);
    refused("stiffness 1e5 0.5\n", "nu < 0.5", NULL);
    refused("timeIntegration NM 0.3 0.6\n", "beta = 0.25", NULL);
    refused("shapes input 1\nno.mesh 0 0 0 0 0 0 1 1 1\n", "line 2", "no.mesh");
    refused("shapes input 1\n" CUBE(0, 0, 0) " materail 1 2 3\n", "t.json:2",
            "did you mean \"material\"?");
    refused("shapes input 2\n" CUBE(0, 0, 0) "\n", "one line a shape", NULL);
    refused("tol 2\n1e-3\n", "more numbers", NULL);
}

// 2D: an obstacle is the outline of its triangles; pins and planes work.
static void test_two_dimensions(void **state) {
    scene s;
    tss_surface f;
    (void)state;
    read_ok(&s,
            "{\"world\": {\"dim\": 2, \"dt\": 0.05}, \"bodies\": [{\"shape\": {\"kind\": "
            "\"rectangle\", \"cells\": 2},"
            "\"translate\": [0, 1.6]}, {\"shape\": {\"kind\": \"disc\", \"count\": 3}, "
            "\"obstacle\": true}],"
            "\"planes\": [{\"origin\": [0, -1], \"normal\": [0, 1]}]}");
    tss_world *w = build(&s);
    assert_int_equal(tss_world_surface(w, &f), TSS_OK);
    assert_int_equal(f.edges, 8 + 18);
    steps(&s, w, 2);
    tss_world_destroy(w);
    scene_free(&s);
    refused("{\"world\": {\"dim\": 2}, \"bodies\": [{" BOX "}]}", "bodies[0]", "z = ");
}

// ---------------------------------------------------------------------------------------------

static void test_subspace_values(void **state) {
    scene s;
    tss_subspace_def d = tss_subspace_def_default();
    (void)state;
    read_ok(&s, "{\"bodies\": [{" BOX "}]}");
    assert_int_equal(scene_mode(&s), TSS_MODE_FULL);
    assert_true(s.solver.error_nodes == d.error_nodes && s.solver.error_modes == d.error_modes &&
                s.solver.progress == d.progress && s.solver.downdate == d.downdate);
    assert_true(s.solver.keep == d.keep && s.solver.partitions == d.partitions);
    scene_free(&s);
    read_ok(&s,
            "{\"solver\": {\"error_nodes\": 0.1, \"error_modes\": 0.2, \"progress\": 0.3,"
            "\"downdate\": 0.4, \"keep\": 5, \"partitions\": 6, \"oracle\": \"literal\","
            "\"secant\": \"exact\", \"schur\": \"direct\", \"newton_residual\": true},"
            "\"bodies\": [{" BOX ", \"basis\": {\"kind\": \"affine\"}}]}");
    tss_subspace_def u = scene__subspace_def(&s);
    assert_int_equal(scene_mode(&s), TSS_MODE_ADAPTIVE);
    assert_true(u.error_nodes == 0.1 && u.error_modes == 0.2 && u.progress == 0.3 &&
                u.downdate == 0.4);
    assert_true(u.keep == 5 && u.partitions == 6 && u.mode == TSS_MODE_ADAPTIVE);
    assert_true(u.oracle == TSS_ORACLE_LITERAL && u.secant == TSS_SECANT_EXACT &&
                u.schur == TSS_SCHUR_DIRECT);
    assert_true(scene__world_def(&s, NULL).newton_residual == 1);
    assert_int_equal(s.bodies, 1);
    assert_int_equal(s.body[0].bases, 1);
    scene_free(&s);
}

static void test_mode_words(void **state) {
    static const char *const mode[] = {"adaptive", "subspace", "full"};
    char text[100];
    scene s;
    (void)state;
    for (int k = 0; k < 3; k++) {
        snprintf(text, sizeof text, "{\"solver\": {\"mode\": \"%s\"}}", mode[k]);
        read_ok(&s, text);
        assert_int_equal(scene_mode(&s), k);
        scene_free(&s);
    }
    assert_true(TSS_MODE_ADAPTIVE == 0 && TSS_MODE_SUBSPACE == 1 && TSS_MODE_FULL == 2);
}

#define BASIS(keys) "{\"bodies\": [{" BOX ", \"basis\": " keys "}]}"

static void test_basis_values(void **state) {
    scene s;
    (void)state;
    read_ok(&s, BASIS("[{\"kind\": \"skinning\", \"count\": 3, \"heterogeneous\": true,"
                      "\"initial\": -1, \"cache\": \"a.modes\", \"tol\": 1e-5},"
                      "{\"kind\": \"eigen\", \"count\": 20}, {\"kind\": \"quadratic\"},"
                      "{\"kind\": \"biharmonic\", \"count\": 8}]"));
    const scene_basis *b = s.body[0].basis;
    assert_int_equal(s.body[0].bases, 4);
    tss_basis_def d = scene__basis_def(b), own = tss_basis_skinning(3);
    assert_true(d.kind == TSS_BASIS_SKINNING && d.count == 3 && d.heterogeneous == 1 &&
                d.initial == -1 && d.tol == 1e-5 && strcmp(d.cache, "a.modes") == 0);
    assert_true(d.cookie == own.cookie && own.initial == tss_basis_skinning(3).initial);
    d = scene__basis_def(b + 1);
    assert_true(d.kind == TSS_BASIS_EIGEN && d.count == 20 && !d.cache && d.tol == 1e-8);
    assert_int_equal(scene__basis_def(b + 2).kind, TSS_BASIS_QUADRATIC);
    assert_int_equal(scene__basis_def(b + 3).kind, TSS_BASIS_BIHARMONIC);
    scene_free(&s);
    read_ok(&s, BASIS("{\"kind\": \"pod\", \"snapshots\": [\"a.snp\", \"b.snp\"]}"));
    assert_int_equal(s.body[0].basis[0].snapshots, 2);
    assert_string_equal(s.body[0].basis[0].snapshot[1], "b.snp");
    assert_int_equal(s.body[0].basis[0].count, 16);
    scene_free(&s);
}

static void test_basis_refusals(void **state) {
    (void)state;
    refused("{\"solver\": {\"mode\": \"adaptiv\"}}", "solver.mode", "did you mean \"adaptive\"?");
    refused("{\"solver\": {\"oracle\": \"delphi\"}}", "solver.oracle", "ring");
    refused("{\"solver\": {\"secant\": \"sr1\"}}", "solver.secant", "bfgs");
    refused("{\"solver\": {\"schur\": \"dirct\"}}", "solver.schur", "did you mean \"direct\"?");
    refused("{\"solver\": {\"error_nodes\": -1}}", "solver.error_nodes", ">= 0");
    refused("{\"solver\": {\"error_modes\": true}}", "solver.error_modes", "a number");
    refused("{\"solver\": {\"progress\": -1e-9}}", "solver.progress", ">= 0");
    refused("{\"solver\": {\"downdate\": -1}}", "solver.downdate", ">= 0");
    refused("{\"solver\": {\"keep\": 1.5}}", "solver.keep", "whole");
    refused("{\"solver\": {\"partitions\": -1}}", "solver.partitions", "whole");
    refused("{\"solver\": {\"newton_residual\": 1}}", "solver.newton_residual", "true or false");
    refused(BASIS("3"), "bodies[0].basis is 3", "{ }");
    refused(BASIS("{}"), "bodies[0].basis.kind is missing", NULL);
    refused(BASIS("[{\"kind\": \"affine\"}, {\"kind\": \"skining\"}]"), "bodies[0].basis[1].kind",
            "did you mean \"skinning\"?");
    refused(BASIS("{\"kind\": \"skinning\", \"handles\": 3}"), "bodies[0].basis.handles",
            "no such key");
    refused(BASIS("{\"kind\": \"affine\", \"count\": 3}"), "bodies[0].basis.count", "no meaning");
    refused(BASIS("{\"kind\": \"eigen\", \"heterogeneous\": true}"),
            "bodies[0].basis.heterogeneous", "no meaning");
    refused(BASIS("{\"kind\": \"biharmonic\", \"tol\": 1}"), "bodies[0].basis.tol", "no meaning");
    refused(BASIS("{\"kind\": \"skinning\", \"snapshots\": \"a\"}"), "basis.snapshots",
            "no meaning");
    refused(BASIS("{\"kind\": \"skinning\", \"count\": 0}"), "bodies[0].basis.count is 0",
            "from 1");
    refused(BASIS("{\"kind\": \"skinning\", \"initial\": -2}"), "basis.initial", "from -1");
    refused(BASIS("{\"kind\": \"skinning\", \"tol\": 0}"), "basis.tol", "> 0");
    refused(BASIS("{\"kind\": \"skinning\", \"cache\": 3}"), "basis.cache", "a text");
    refused(BASIS("{\"kind\": \"pod\"}"), "basis.snapshots is missing", "tss run");
    refused(BASIS("{\"kind\": \"pod\", \"snapshots\": [3]}"), "basis.snapshots[0]", "file name");
    // a cube of 8 nodes
    refused(BASIS("[{\"kind\": \"skinning\", \"count\": 9}]"), "basis[0].count is 9", "at most 8");
    refused(BASIS("[{\"kind\": \"eigen\", \"count\": 25}]"), "basis[0].count is 25", "at most 24");
    refused("{\"bodies\": [{" BOX ", \"obstacle\": true, \"basis\": {\"kind\": \"affine\"}}]}",
            "bodies[0].basis", "obstacle");
}

// The message must hold both parts, and no world is left.
static void not_built(const char *text, const char *part, const char *part2) {
    scene s;
    scene_error e;
    tss_world *w;
    read_ok(&s, text);
    if (scene_build(&s, NULL, NULL, NULL, &w, NULL, &e)) fail_msg("was built: %s", text);
    assert_null(w);
    if (!strstr(e.text, part) || !strstr(e.text, part2) || !strstr(e.text, "t.json"))
        fail_msg("\"%s\" does not say \"%s\" and \"%s\"", e.text, part, part2);
    scene_free(&s);
}

static void write_bytes(const char *path, const void *data, size_t size) {
    FILE *f = fopen(path, "wb");
    assert_non_null(f);
    assert_true(fwrite(data, 1, size, f) == size);
    fclose(f);
}

#define POD BASIS("{\"kind\": \"pod\", \"snapshots\": \"scene_x.snp\"}")

// The file as its banner says: magic, nodes, dim, count, then the positions, step by step.
static void test_snapshots(void **state) {
    scene s;
    scene_error e;
    uint64_t head[4];
    double x[2][24], kept[2][24];
    (void)state;
    read_ok(&s, "{\"bodies\": [{" BOX "}]}");
    tss_world *w = build(&s);
    for (int k = 0; k < 2; k++) {
        steps(&s, w, 1);
        memcpy(x[k], tss_world_positions(w), sizeof x[k]);
        if (!scene_snapshot("scene_x.snp", w, k, &e)) fail_msg("%s", e.text);
    }
    FILE *f = fopen("scene_x.snp", "rb");
    assert_non_null(f);
    assert_true(fread(head, sizeof head, 1, f) == 1 && fread(kept, sizeof kept, 1, f) == 1);
    assert_true(fgetc(f) == EOF);
    fclose(f);
    assert_memory_equal(head, "tss snp1", 8);
    assert_true(head[1] == 8 && head[2] == 3 && head[3] == 2);
    assert_memory_equal(kept, x, sizeof x);
    assert_false(scene_snapshot("no/such/folder.snp", w, 0, &e));
    assert_non_null(strstr(e.text, "no/such/folder.snp"));
    tss_world_destroy(w);
    scene_free(&s);
    // In full mode no basis is made, and the file is not looked for.
    remove("scene_x.snp");
    not_built(POD, "bodies[0].basis[0].snapshots[0]", "scene_x.snp cannot be read");
    read_ok(&s, "{\"solver\": {\"mode\": \"full\"}, \"bodies\": [{" BOX
                ", \"basis\": {\"kind\": "
                "\"pod\", \"snapshots\": \"scene_x.snp\"}}]}");
    w = build(&s);
    assert_null(tss_subspace_of(w));
    tss_world_destroy(w);
    scene_free(&s);
}

// Snapshots of a space of three dimensions (the translations) give three modes.
static void test_pod(void **state) {
    scene s;
    scene_error e;
    tss_basis_info info;
    double moved[24];
    (void)state;
    read_ok(&s, "{\"contact\": {\"enabled\": false}, \"bodies\": [{" BOX "}]}");
    tss_world *w = build(&s);
    for (int k = 0; k < 5; k++) {
        for (int i = 0; i < 24; i++) moved[i] = tss_world_rest(w)[i] + (k + 1) * (i % 3 == k % 3);
        assert_int_equal(tss_body_teleport(w, s.body[0].id, moved, NULL), TSS_OK);
        if (!scene_snapshot("scene_x.snp", w, k, &e)) fail_msg("%s", e.text);
    }
    tss_world_destroy(w);
    scene_free(&s);
    read_ok(&s, POD);
    w = build(&s);
    assert_int_equal(tss_basis_get(w, s.body[0].basis[0].id, &info), TSS_OK);
    assert_int_equal(info.kind, TSS_BASIS_POD);
    assert_int_equal(info.functions, 3);
    tss_world_destroy(w);
    scene_free(&s);
    remove("scene_x.snp");
}

static void test_snapshot_refusals(void **state) {
    struct {
        char magic[8];
        uint64_t nodes, dim, count;
        double x[48];
    } f;
    const char *key = "bodies[0].basis[0].snapshots[0]";
    (void)state;
    memset(&f, 0, sizeof f);
    memcpy(f.magic, "tss snp1", 8);
    f.nodes = 8, f.dim = 3, f.count = 2;
    write_bytes("scene_x.snp", &f, sizeof f - 8);
    not_built(POD, key, "ends in snapshot 2 of 2");
    write_bytes("scene_x.snp", &f, 20);
    not_built(POD, key, "is no file that");
    f.count = 0, write_bytes("scene_x.snp", &f, sizeof f);
    not_built(POD, key, "0 snapshots");
    f.count = 2, f.nodes = 9, write_bytes("scene_x.snp", &f, sizeof f);
    not_built(POD, key, "9 nodes in 3 dimensions, this scene has 8 in 3");
    f.nodes = 8, f.dim = 2, write_bytes("scene_x.snp", &f, sizeof f);
    not_built(POD, key, "8 nodes in 2 dimensions");
    f.dim = 3, f.magic[0] = 'T', write_bytes("scene_x.snp", &f, sizeof f);
    not_built(POD, key, "is no file that");
    remove("scene_x.snp");
    not_built("{\"solver\": {\"mode\": \"subspace\"}, \"bodies\": [{" BOX "}]}", "solver.mode",
              "no body has a basis");
}

// Masses against densities times volumes; Lamé parameters against the formulas of E and nu.
static void test_regions(void **state) {
    scene s;
    double sum = 0, mu, lambda, rho;
    (void)state;
    read_ok(&s,
            "{\"bodies\": [{\"shape\": {\"kind\": \"box\", \"cells\": [4, 2, 2]}, \"regions\": ["
            "{\"upper\": [0.5, 1, 1], \"material\": {\"rho\": 3000, \"E\": 7}},"
            "{\"upper\": [-0.25, 1, 1], \"metres\": true, \"material\": {\"nu\": 0.25}}],"
            "\"material\": {\"rho\": 1000, \"E\": 10, \"nu\": 0}}]}");
    tss_world *w = build(&s);
    for (int i = 0; i < tss_world_nodes(w); i++) sum += tss_world_masses(w)[i];
    // a quarter of the cube is in both regions, and the later one has the body's density
    near_to(sum, 0.25 * 1000 + 0.25 * 3000 + 0.5 * 1000, 1e-9);
    const int *cell = tss_body_cells(w, 0);
    for (int k = 0; k < s.body[0].mesh.tets; k++) {
        double x = 0;
        for (int c = 0; c < 4; c++) x += tss_world_rest(w)[3 * cell[4 * k + c]] / 4;
        double E = x < -0.25 || x > 0 ? 10 : 7, nu = x < -0.25 ? 0.25 : 0;
        assert_int_equal(tss_body_cell_material(w, 0, k, &mu, &lambda, &rho), TSS_OK);
        near_to(mu, E / (2 * (1 + nu)), 1e-12);
        near_to(lambda, E * nu / ((1 + nu) * (1 - 2 * nu)), 1e-12);
        near_to(rho, x < -0.25 || x > 0 ? 1000 : 3000, 1e-9);
    }
    tss_world_destroy(w);
    scene_free(&s);
    refused("{\"bodies\": [{" BOX ", \"regions\": [{\"lower\": [2, 2, 2], \"material\": {}}]}]}",
            "bodies[0].regions[0]", "no cell");
    refused("{\"bodies\": [{" BOX ", \"regions\": [{}]}]}", "regions[0].material is missing", NULL);
    refused("{\"bodies\": [{" BOX ", \"regions\": [{\"material\": {\"kind\": \"stvk\"}}]}]}",
            "regions[0].material.kind", "no such key");
    refused("{\"bodies\": [{" BOX ", \"regions\": [{\"material\": {\"nu\": 0.5}}]}]}",
            "regions[0].material.nu", "0.4999");
    refused("{\"bodies\": [{" BOX ", \"regions\": {}}]}", "bodies[0].regions", "[ ]");
    refused("{\"bodies\": [{" BOX ", \"obstacle\": true, \"regions\": [{\"material\": {}}]}]}",
            "bodies[0].regions", "obstacle");
}

// A script's bodies get theirs by --set; its moving nodes are scripted before the basis is made.
static void test_script_basis(void **state) {
    static const char *const set[] = {"bodies.0.basis={\"kind\": \"skinning\", \"count\": 2}"};
    static const char *const many[] = {"bodies.0.basis={\"kind\": \"skinning\", \"count\": 20}"};
    const char *text = "shapes input 2\n" CUBE(0, 0, 0) "\n" CUBE(3, 0, 0) "\nscript twist\n";
    scene s;
    scene_error e;
    (void)state;
    if (!scene_parse(&s, "t.txt", text, NULL, set, 1, &e)) fail_msg("%s", e.text);
    assert_int_equal(s.body[0].bases, 1);
    assert_int_equal(scene_mode(&s), TSS_MODE_ADAPTIVE);
    tss_world *w = build(&s);
    int scripted = 0;
    for (int i = 0; i < 8; i++) scripted += tss_world_kinds(w)[i] == TSS_NODE_SCRIPTED;
    assert_int_equal(scripted, 4);  // the left side
    tss_world_destroy(w);
    scene_free(&s);
    assert_false(scene_parse(&s, "t.txt", text, NULL, many, 1, &e));
    assert_non_null(strstr(e.text, "bodies[0].basis[0].count is 20"));
}

#define SOFT                                                                                     \
    "\"world\": {\"dt\": 0.02}, \"bodies\": [{\"shape\": {\"kind\": \"box\", \"cells\": 3},"     \
    "\"translate\": [0, 0.51, 0], \"material\": {\"E\": 2e4}, \"pins\": [{\"upper\": [0, 1, 1]," \
    "\"release\": true, \"motion\": {\"velocity\": [0, 1, 0], \"end\": 0.06}}],"                 \
    "\"forces\": [{\"acceleration\": [3, 0, 0], \"start\": 0.02, \"end\": 0.05}],"               \
    "\"basis\": {\"kind\": \"affine\"}}], \"planes\": [{}]}"

// With an error bound of 0 every node is enriched: the full-space solver's way, within tolerance.
static void test_adaptive_at_zero(void **state) {
    scene a, f;
    double most = 0;
    (void)state;
    read_ok(&a,
            "{\"solver\": {\"error_nodes\": 0, \"error_modes\": 0, \"progress\": 1e9, \"tol\": "
            "1e-7}," SOFT);
    read_ok(&f, "{\"solver\": {\"mode\": \"full\", \"tol\": 1e-7}," SOFT);
    tss_world *wa = build(&a), *wf = build(&f);
    assert_non_null(tss_subspace_of(wa));
    assert_null(tss_subspace_of(wf));
    steps(&a, wa, 6), steps(&f, wf, 6);
    for (int i = 0; i < 3 * tss_world_nodes(wa); i++)
        most = fmax(most, fabs(tss_world_positions(wa)[i] - tss_world_positions(wf)[i]));
    near_to(most, 0, 1e-6);
    tss_world_destroy(wa), tss_world_destroy(wf);
    scene_free(&a), scene_free(&f);
}

// One scene, two worlds in turn, against two scenes with a world each.
static void test_two_worlds(void **state) {
    const char *text = "{\"solver\": {\"mode\": \"full\"}," SOFT;
    scene s, one;
    (void)state;
    read_ok(&s, text), read_ok(&one, text);
    tss_world *w = build(&s), *u = build(&s), *alone = build(&one);
    size_t size = scene_state(&s, NULL, 0, 1);
    void *before = malloc(size);
    for (int k = 0; k < 6; k++) {
        assert_true(scene_state(&s, before, size, 1) == size);
        steps(&s, w, 1);
        assert_true(scene_state(&s, before, size, 0) == size);
        steps(&s, u, 1);
    }
    steps(&one, alone, 6);
    assert_true(tss_world_hash(w) == tss_world_hash(alone));
    assert_true(tss_world_hash(u) == tss_world_hash(alone));
    free(before);
    tss_world_destroy(w), tss_world_destroy(u), tss_world_destroy(alone);
    scene_free(&s), scene_free(&one);
}

int main(void) {
    const struct CMUnitTest tests[] = {cmocka_unit_test(test_defaults),
                                       cmocka_unit_test(test_values),
                                       cmocka_unit_test(test_refusals),
                                       cmocka_unit_test(test_set),
                                       cmocka_unit_test(test_pose),
                                       cmocka_unit_test(test_keyframes),
                                       cmocka_unit_test(test_pin_motion),
                                       cmocka_unit_test(test_release),
                                       cmocka_unit_test(test_capture),
                                       cmocka_unit_test(test_forces),
                                       cmocka_unit_test(test_spin),
                                       cmocka_unit_test(test_resume),
                                       cmocka_unit_test(test_script_values),
                                       cmocka_unit_test(test_script_places),
                                       cmocka_unit_test(test_script_rotates),
                                       cmocka_unit_test(test_script_matrix),
                                       cmocka_unit_test(test_script_twist),
                                       cmocka_unit_test(test_script_stretch),
                                       cmocka_unit_test(test_script_dragright),
                                       cmocka_unit_test(test_script_boundary),
                                       cmocka_unit_test(test_script_refusals),
                                       cmocka_unit_test(test_two_dimensions),
                                       cmocka_unit_test(test_subspace_values),
                                       cmocka_unit_test(test_mode_words),
                                       cmocka_unit_test(test_basis_values),
                                       cmocka_unit_test(test_basis_refusals),
                                       cmocka_unit_test(test_snapshots),
                                       cmocka_unit_test(test_pod),
                                       cmocka_unit_test(test_snapshot_refusals),
                                       cmocka_unit_test(test_regions),
                                       cmocka_unit_test(test_script_basis),
                                       cmocka_unit_test(test_adaptive_at_zero),
                                       cmocka_unit_test(test_two_worlds)};
    return cmocka_run_group_tests(tests, with_meshes, without_meshes);
}
