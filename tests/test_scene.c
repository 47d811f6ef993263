// test_scene: scene.h reads what it should, names what it refuses, and moves things exactly.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
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
                                       cmocka_unit_test(test_two_dimensions)};
    return cmocka_run_group_tests(tests, with_meshes, without_meshes);
}
