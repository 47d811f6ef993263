// Every result code and every status through the public API; every allocation of a world with
// contact failed in turn; the list of bad input that test_core.c leaves out.
//
// An error must change nothing: a test keeps the world's whole checkpoint (positions, velocities,
// targets, loads, what energies remember) from before the call and compares it byte by byte after.
// Figures to compare with are the undisturbed run's own bits, so any difference is a fault.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <cmocka.h>

#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_io.h"

// ---- which codes have been produced -----------------------------------------------------------

static int result_seen[TSS_RESULT_COUNT], status_seen[TSS_STATUS_COUNT];

static void expect(tss_result got, tss_result want) {
    if (got != want) print_error("got '%s'\n", tss_result_text(got));
    assert_int_equal(got, want);
    result_seen[want] = 1;
}

// Runs last: a code added to the tables of tss.h fails here until a test above produces it.
static void test_all_seen(void **state) {
    (void)state;
#define NAME(id, text) #id,
    static const char *const result[] = {TSS_RESULTS(NAME)}, *const status[] = {TSS_STATUSES(NAME)};
#undef NAME
    int missing = 0;
    for (int k = 0; k < TSS_RESULT_COUNT; k++) {
        if (!result_seen[k]) print_error("no test produces %s\n", result[k]), missing++;
        for (int j = 0; j < k; j++)
            assert_string_not_equal(tss_result_text((tss_result)k), tss_result_text((tss_result)j));
    }
    for (int k = 0; k < TSS_STATUS_COUNT; k++) {
        if (!status_seen[k]) print_error("no test produces %s\n", status[k]), missing++;
        for (int j = 0; j < k; j++)
            assert_string_not_equal(tss_status_text((tss_status)k), tss_status_text((tss_status)j));
    }
    assert_int_equal(missing, 0);
    assert_string_equal(tss_result_text(TSS_RESULT_COUNT), "unknown result");
    assert_string_equal(tss_status_text(TSS_STATUS_COUNT), "unknown");
}

// ---- scenes -----------------------------------------------------------------------------------

typedef struct box {
    double X[24];
    int cell[24];
} box;

// The cube lower + side·[0, 1]³ in six tets about its diagonal; node = x + 2 y + 4 z.
static box make_box(double x, double y, double z, double side) {
    static const int tet[24] = {0, 1, 3, 7, 0, 5, 1, 7, 0, 3, 2, 7, 0, 2, 6, 7, 0, 4, 5, 7, 0, 6, 4, 7};
    const double lower[3] = {x, y, z};
    box b;
    for (int i = 0; i < 8; i++)
        for (int c = 0; c < 3; c++) b.X[3 * i + c] = lower[c] + side * (i >> c & 1);
    memcpy(b.cell, tet, sizeof tet);
    return b;
}

static tss_body_def box_body(const box *b, const char *name) {
    tss_body_def d = tss_body_def_default();
    d.name = name, d.nodes = 8, d.X = b->X, d.cells = 6, d.cell = b->cell;
    return d;
}

static const int square[6] = {0, 1, 2, 0, 2, 3};

// A horizontal square of two triangles facing up.
static tss_body_def ground(double *X, double y, double half) {
    const double at[12] = {-half, y, -half, -half, y, half, half, y, half, half, y, -half};
    tss_body_def d = tss_body_def_default();
    memcpy(X, at, sizeof at);
    d.kind = TSS_BODY_OBSTACLE, d.name = "ground", d.nodes = 4, d.X = X;
    d.triangles = 2, d.triangle = square;
    return d;
}

static tss_world *make_world(tss_world_def d) {
    tss_world *w = NULL;
    assert_int_equal(tss_world_create(&d, &w), TSS_OK);
    return w;
}

static tss_world *one_box(tss_world_def d) {
    box b = make_box(0, 0, 0, 1);
    tss_body_def def = box_body(&b, "blob");
    tss_world *w = make_world(d);
    assert_int_equal(tss_body_add(w, &def, NULL), TSS_OK);
    return w;
}

static void says(const char *text, const char *what) {
    if (!strstr(text, what)) print_error("'%s' does not say '%s'\n", text, what);
    assert_non_null(strstr(text, what));
}

// ---- nothing changes --------------------------------------------------------------------------

typedef struct picture {
    uint64_t hash;
    int nodes, bodies;
    double time, *x;
    size_t size;
    void *all;
} picture;

static picture take(const tss_world *w) {
    picture p;
    size_t wide = (size_t)(tss_world_nodes(w) * tss_world_dim(w)) * sizeof(double);
    p.hash = tss_world_hash(w), p.nodes = tss_world_nodes(w), p.bodies = tss_world_bodies(w);
    p.time = tss_world_time(w), p.size = tss_world_save(w, NULL, 0);
    p.x = (double *)malloc(wide + 1), p.all = malloc(p.size);
    assert_true(p.x && p.all);
    if (wide > 0) memcpy(p.x, tss_world_positions(w), wide);
    assert_true(tss_world_save(w, p.all, p.size) == p.size);
    return p;
}

static void drop(picture *p) {
    free(p->x), free(p->all);
    p->x = NULL, p->all = NULL;
}

// prepares: the call prepares the world first, which may give a checkpoint more or fewer parts.
static int same(const tss_world *w, const picture *p, int prepares) {
    picture q = take(w);
    size_t wide = (size_t)(q.nodes * tss_world_dim(w)) * sizeof(double);
    int ok = q.hash == p->hash && q.time == p->time && q.nodes == p->nodes && q.bodies == p->bodies;
    ok = ok && memcmp(q.x, p->x, wide) == 0 && (q.size == p->size || prepares);
    ok = ok && (q.size != p->size || memcmp(q.all, p->all, q.size) == 0);
    drop(&q);
    return ok;
}

static void unchanged(const tss_world *w, picture *p) {
    assert_true(same(w, p, 0));
    drop(p);
}

// The call fails with this code, says what is wrong, and leaves the world alone.
#define REFUSED(w, call, want, text)                                                              \
    do {                                                                                          \
        picture before_ = take(w);                                                                \
        expect(call, want);                                                                       \
        says(tss_world_error(w), text);                                                           \
        unchanged(w, &before_);                                                                   \
    } while (0)

// ---- memory that fails ------------------------------------------------------------------------

typedef struct memory {
    int64_t calls, fail_at;  // the call that fails (1 is the first; 0: none)
    int to_the_end;          // 1: all later ones fail too, until memory_back
    int64_t refused, live, bytes;
} memory;

enum { HEAD = 64 };  // in front of each block: what was asked for

static void *memory_alloc(size_t bytes, size_t align, void *ctx) {
    memory *m = (memory *)ctx;
    assert_true(align <= HEAD);
    m->calls++;
    if (m->fail_at > 0 && (m->to_the_end ? m->calls >= m->fail_at : m->calls == m->fail_at)) {
        m->refused++;
        return NULL;
    }
    size_t room = (bytes + 2 * HEAD - 1) / HEAD * HEAD;
    char *p = (char *)aligned_alloc(HEAD, room);
    assert_non_null(p);
    memcpy(p, &bytes, sizeof bytes);
    memset(p + HEAD, 0xa5, bytes);  // nobody may rely on zeros
    m->live++, m->bytes += (int64_t)bytes;
    return p + HEAD;
}

static void memory_free(void *p, size_t bytes, void *ctx) {
    memory *m = (memory *)ctx;
    size_t had;
    memcpy(&had, (char *)p - HEAD, sizeof had);
    assert_true(had == bytes);  // the host is told the size it gave
    m->live--, m->bytes -= (int64_t)bytes;
    free((char *)p - HEAD);
}

static void memory_back(memory *m) { m->fail_at = 0; }

static tss_host memory_host(memory *m) {
    tss_host h = tss_host_default();
    h.alloc = memory_alloc, h.free = memory_free, h.memory_ctx = m, h.workers = 1;
    return h;
}

// ---- results ----------------------------------------------------------------------------------

static void test_ok(void **state) {
    (void)state;
    tss_world *w = one_box(tss_world_def_default());
    uint64_t hash = tss_world_hash(w);
    expect(tss_world_step(w, NULL), TSS_OK);
    assert_true(tss_world_hash(w) != hash);
    assert_string_equal(tss_world_error(w), "");
    tss_world_destroy(w);
}

static void test_result_no_memory(void **state) {
    (void)state;
    memory m;
    memset(&m, 0, sizeof m);
    tss_world_def d = tss_world_def_default();
    d.host = memory_host(&m);
    tss_world *w = one_box(d);
    box b = make_box(5, 0, 0, 1);
    tss_body_def def = box_body(&b, "late");
    m.fail_at = m.calls + 1, m.to_the_end = 1;
    REFUSED(w, tss_body_add(w, &def, NULL), TSS_ERROR_NO_MEMORY, "memory");
    memory_back(&m);
    expect(tss_body_add(w, &def, NULL), TSS_OK);
    tss_world_destroy(w);
    assert_true(m.live == 0 && m.bytes == 0);
}

static void test_result_bad_argument(void **state) {
    (void)state;
    tss_world *w = one_box(tss_world_def_default());
    const double gravity[3] = {0, -1, 0};
    tss_energy_def none = tss_energy_def_default();
    none.name = "bare", none.arity = 2;
    tss_ipc_def ipc = tss_ipc_def_default();
    ipc.friction_iterations = 0;
    tss_ipc *contact = (tss_ipc *)(uintptr_t)1;
    REFUSED(w, tss_world_set_dt(w, -1), TSS_ERROR_BAD_ARGUMENT, "dt = -1");
    REFUSED(w, tss_world_set_tol(w, 0), TSS_ERROR_BAD_ARGUMENT, "tol = 0");
    REFUSED(w, tss_node_target(w, 3, NULL), TSS_ERROR_BAD_ARGUMENT, "node 3");
    REFUSED(w, tss_node_force(w, 4, NULL), TSS_ERROR_BAD_ARGUMENT, "node 4");
    REFUSED(w, tss_node_drag(w, 5, gravity, -2), TSS_ERROR_BAD_ARGUMENT, "stiffness -2");
    REFUSED(w, tss_body_teleport(w, 0, NULL, NULL), TSS_ERROR_BAD_ARGUMENT, "blob");
    REFUSED(w, tss_energy_add(w, &none, NULL), TSS_ERROR_BAD_ARGUMENT, "bare: lists");
    REFUSED(w, tss_world_step_for(w, 1, NULL), TSS_ERROR_BAD_ARGUMENT, "clock");
    REFUSED(w, tss_ipc_add(w, &ipc, &contact), TSS_ERROR_BAD_ARGUMENT, "friction_iterations");
    assert_null(contact);
    tss_embedding *e = (tss_embedding *)(uintptr_t)1;
    REFUSED(w, tss_embedding_create(w, 0, NULL, 2, &e), TSS_ERROR_BAD_ARGUMENT, "2 points");
    assert_null(e);
    tss_world_destroy(w);
}

static void test_result_bad_state(void **state) {
    (void)state;
    const double bad[24] = {0, NAN, 0}, inf[3] = {0, 0, INFINITY};
    tss_world *w = one_box(tss_world_def_default());
    expect(tss_world_step(w, NULL), TSS_OK);
    REFUSED(w, tss_node_force(w, 1, bad), TSS_ERROR_BAD_STATE, "force: component 1");
    REFUSED(w, tss_node_target(w, 1, inf), TSS_ERROR_BAD_STATE, "target: component 2");
    REFUSED(w, tss_node_drag(w, 1, bad, 3), TSS_ERROR_BAD_STATE, "component 1");
    REFUSED(w, tss_body_target(w, 0, bad), TSS_ERROR_BAD_STATE, "blob: component 1");
    REFUSED(w, tss_body_teleport(w, 0, bad, NULL), TSS_ERROR_BAD_STATE, "blob: component 1");
    REFUSED(w, tss_body_teleport(w, 0, tss_world_rest(w), bad), TSS_ERROR_BAD_STATE, "component 1");
    REFUSED(w, tss_world_set_gravity(w, bad), TSS_ERROR_BAD_STATE, "gravity: component 1");
    tss_embedding *e = NULL;
    REFUSED(w, tss_embedding_create(w, 0, bad, 1, &e), TSS_ERROR_BAD_STATE, "point: component 1");
    assert_null(e);
    expect(tss_world_step(w, NULL), TSS_OK);
    tss_world_destroy(w);
}

static void test_result_not_found(void **state) {
    (void)state;
    const double at[3] = {0, 0, 0};
    tss_world *w = one_box(tss_world_def_default());
    tss_body_info info;
    tss_energy_report report;
    REFUSED(w, tss_body_remove(w, 1), TSS_ERROR_NOT_FOUND, "no body 1");
    REFUSED(w, tss_body_target(w, -1, NULL), TSS_ERROR_NOT_FOUND, "no body -1");
    REFUSED(w, tss_body_teleport(w, 9, at, NULL), TSS_ERROR_NOT_FOUND, "no body 9");
    REFUSED(w, tss_node_pin(w, 8, 7), TSS_ERROR_NOT_FOUND, "no node 8, expected 0..7");
    REFUSED(w, tss_node_force(w, -1, at), TSS_ERROR_NOT_FOUND, "no node -1");
    expect(tss_world_prepare(w), TSS_OK);
    REFUSED(w, tss_energy_check(w, 77, &report), TSS_ERROR_NOT_FOUND, "no energy 77");
    REFUSED(w, tss_energy_remove(w, 77), TSS_ERROR_NOT_FOUND, "no energy 77");
    expect(tss_body_get(w, 1, &info), TSS_ERROR_NOT_FOUND);
    tss_world_destroy(w);
}

// No soft body: nothing to simulate, with and without an obstacle; everything else still answers.
static void test_result_empty(void **state) {
    (void)state;
    double X[12];
    tss_body_def d = ground(X, 0, 1);
    for (int obstacles = 0; obstacles < 2; obstacles++) {
        tss_world *w = make_world(tss_world_def_default());
        if (obstacles) assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
        tss_step_info info;
        tss_check_report report;
        REFUSED(w, tss_world_prepare(w), TSS_ERROR_EMPTY, "no soft body");
        REFUSED(w, tss_world_step(w, &info), TSS_ERROR_EMPTY, "no soft body");
        expect(tss_world_check(w, &report), TSS_OK);
        assert_int_equal(report.errors, 1);
        says(report.issue[0].text, "no soft body");
        REFUSED(w, tss_world_energy(w, NULL, NULL), TSS_ERROR_EMPTY, "no soft body");
        assert_true(tss_world_time(w) == 0);
        tss_world_destroy(w);
    }
}

// Before prepare there is no surface; contacts belong to a step, and to the nodes it was taken with.
static void test_result_not_prepared(void **state) {
    (void)state;
    tss_world *w = one_box(tss_world_def_default());
    tss_surface s;
    tss_ipc *contact;
    tss_ipc_def ipc = tss_ipc_def_default();
    expect(tss_world_surface(w, &s), TSS_ERROR_NOT_PREPARED);
    assert_int_equal(s.points, 0);
    assert_int_equal(tss_ipc_add(w, &ipc, &contact), TSS_OK);
    box b = make_box(5, 0, 0, 1);
    tss_body_def def = box_body(&b, "late");
    for (int late = 0; late < 2; late++) {
        int count = 7;
        double out[3 * 16];
        REFUSED(w, tss_ipc_contacts(contact, 0, NULL, &count), TSS_ERROR_NOT_PREPARED, "contact");
        assert_int_equal(count, 0);
        REFUSED(w, tss_ipc_forces(contact, out), TSS_ERROR_NOT_PREPARED, "contact");
        REFUSED(w, tss_ipc_pressures(contact, out), TSS_ERROR_NOT_PREPARED, "contact");
        REFUSED(w, tss_ipc_touches(contact, 0, NULL, &count), TSS_ERROR_NOT_PREPARED, "contact");
        if (late) break;
        expect(tss_world_step(w, NULL), TSS_OK);
        expect(tss_ipc_contacts(contact, 0, NULL, &count), TSS_OK);
        assert_int_equal(tss_body_add(w, &def, NULL), TSS_OK);  // more nodes than contact knows of
    }
    tss_world_destroy(w);
}

// Bodies that intersect at the start: the pair is named, the doctor says the same.
static void test_result_intersection(void **state) {
    (void)state;
    box a = make_box(0, 0, 0, 1), b = make_box(0.6, 0.7, 0.8, 1), c = make_box(9, 0, 0, 1);
    tss_body_def far = box_body(&c, "far"), left = box_body(&a, "left"), right = box_body(&b, "right");
    tss_world *w = make_world(tss_world_def_default());
    tss_ipc_def ipc = tss_ipc_def_default();
    tss_check_report report;
    assert_int_equal(tss_body_add(w, &far, NULL), TSS_OK);
    assert_int_equal(tss_body_add(w, &left, NULL), TSS_OK);
    assert_int_equal(tss_body_add(w, &right, NULL), TSS_OK);
    assert_int_equal(tss_ipc_add(w, &ipc, NULL), TSS_OK);
    expect(tss_world_prepare(w), TSS_OK);
    REFUSED(w, tss_world_step(w, NULL), TSS_ERROR_INTERSECTION, "body 1");
    says(tss_world_error(w), "body 2");
    assert_null(strstr(tss_world_error(w), "body 0"));
    expect(tss_world_check(w, &report), TSS_OK);
    assert_true(report.errors > 0);
    for (int k = 0; k < report.count; k++) {
        if (report.issue[k].severity != TSS_SEVERITY_ERROR || strstr(report.issue[k].text, "in all")) continue;
        says(report.issue[k].text, "body 1"), says(report.issue[k].text, "body 2");
    }
    for (int k = 0; k < 24; k++) b.X[k] += 2;  // apart: the same world steps
    assert_int_equal(tss_body_teleport(w, 2, b.X, NULL), TSS_OK);
    expect(tss_world_step(w, NULL), TSS_OK);
    tss_world_destroy(w);
}

// A pivot of −1 in the middle; the factor is void afterwards, the structure still serves.
static void test_result_singular(void **state) {
    (void)state;
    double a[4] = {4, 2, 2, 1}, b[1] = {1};  // rank one
    int bad = 7;
    expect(tss_dense_chol_factor(2, a, 2, &bad), TSS_ERROR_SINGULAR);
    assert_int_equal(bad, 1);
    tss_host h = tss_host_default();
    tss_chol_def def = tss_chol_def_default();
    tss_chol_info info;
    tss_chol *c;
    int64_t row[4] = {0, 1, 2, 3};
    int col[3] = {0, 1, 2};
    double val[3] = {2, -1, 3}, x[3] = {2, 4, 6};
    tss_bcsr A;
    memset(&A, 0, sizeof A);
    A.n = 3, A.d = 1, A.row = row, A.col = col, A.val = val, A.pattern = 1;
    assert_int_equal(tss_chol_create(&h, &def, &c), TSS_OK);
    expect(tss_chol_factor(c, &A, NULL, NULL), TSS_ERROR_NOT_PREPARED);
    assert_int_equal(tss_chol_analyze(c, &A, NULL), TSS_OK);
    expect(tss_chol_factor(c, &A, NULL, NULL), TSS_ERROR_SINGULAR);
    tss_chol_get_info(c, &info);
    assert_int_equal(info.bad_row, 1);
    expect(tss_chol_solve(c, b, 1), TSS_ERROR_NOT_PREPARED);
    assert_true(b[0] == 1);
    val[1] = 1;
    expect(tss_chol_factor(c, &A, NULL, NULL), TSS_OK);
    expect(tss_chol_solve(c, x, 1), TSS_OK);
    assert_true(fabs(x[0] - 1) < 1e-15 && fabs(x[1] - 4) < 1e-15 && fabs(x[2] - 2) < 1e-15);
    tss_chol_destroy(c);
}

static void test_result_file(void **state) {
    (void)state;
    tss_mesh m;
    tss_io_error why;
    expect(tss_mesh_read(NULL, "no/such/mesh.msh", &m, &why), TSS_ERROR_FILE);
    assert_true(m.nodes == 0 && !m.x && !m.tet);
    assert_string_equal(why.file, "no/such/mesh.msh");
    says(why.message, "cannot open");
    expect(tss_mesh_read(NULL, ".", &m, &why), TSS_ERROR_FILE);  // opens, cannot be read
    assert_true(m.nodes == 0 && !m.x);
}

static void test_result_format(void **state) {
    (void)state;
    tss_world *w = one_box(tss_world_def_default());
    expect(tss_world_step(w, NULL), TSS_OK);
    size_t size = tss_world_save(w, NULL, 0);
    char *data = (char *)malloc(size);
    assert_true(data && tss_world_save(w, data, size) == size);
    expect(tss_world_step(w, NULL), TSS_OK);
    REFUSED(w, tss_world_load(w, data, 5), TSS_ERROR_FORMAT, "5 bytes");
    REFUSED(w, tss_world_load(w, data, size - 1), TSS_ERROR_FORMAT, "cut short");
    data[0] ^= 1;
    REFUSED(w, tss_world_load(w, data, size), TSS_ERROR_FORMAT, "version");
    free(data);
    tss_world_destroy(w);
    tss_mesh m;
    tss_io_error why;
    const char *text = "v 0 0 0\nv 1 0 0\nf 1 2 x\n";
    expect(tss_mesh_parse(NULL, TSS_MESH_OBJ, "t.obj", text, strlen(text), &m, &why), TSS_ERROR_FORMAT);
    assert_true(why.line == 3 && m.nodes == 0 && !m.x);
    assert_string_equal(why.file, "t.obj");
}

// A checkpoint of another scene, and one whose contact part is not contact's (same sizes): in both
// cases the whole of the world stays as it was.
static void test_result_mismatch(void **state) {
    (void)state;
    tss_world *one = one_box(tss_world_def_default()), *two = one_box(tss_world_def_default());
    box b = make_box(3, 0, 0, 1);
    tss_body_def d = box_body(&b, "more");
    tss_ipc_def ipc = tss_ipc_def_default();
    ipc.kappa = 1e8;
    assert_int_equal(tss_body_add(two, &d, NULL), TSS_OK);
    expect(tss_world_step(one, NULL), TSS_OK);
    picture p = take(two);
    REFUSED(one, tss_world_load(one, p.all, p.size), TSS_ERROR_MISMATCH, "16 nodes");
    drop(&p);
    assert_int_equal(tss_ipc_add(two, &ipc, NULL), TSS_OK);
    for (int s = 0; s < 2; s++) expect(tss_world_step(two, NULL), TSS_OK);
    p = take(two);
    for (int s = 0; s < 2; s++) expect(tss_world_step(two, NULL), TSS_OK);
    char *at = (char *)p.all, *kappa = NULL;
    for (size_t k = 0; k + sizeof ipc.kappa <= p.size; k++)
        if (memcmp(at + k, &ipc.kappa, sizeof ipc.kappa) == 0) kappa = at + k;
    assert_non_null(kappa);
    const double negative = -1;
    memcpy(kappa, &negative, sizeof negative);  // no barrier has such a stiffness
    REFUSED(two, tss_world_load(two, p.all, p.size), TSS_ERROR_MISMATCH, "energy");
    memcpy(kappa, &ipc.kappa, sizeof ipc.kappa);
    expect(tss_world_load(two, p.all, p.size), TSS_OK);
    assert_true(tss_world_hash(two) == p.hash);
    drop(&p);
    tss_world_destroy(one), tss_world_destroy(two);
}

// ---- statuses ---------------------------------------------------------------------------------

// A potential s·x with a made-up curvature and step filter on every node of a box: what a solver
// may meet.
typedef struct trap {
    double slope, lie, curvature, open;  // gradient: lie · slope; the filter lets `open` pass
    int node[8];
} trap;

static tss_result trap_lists(void *user, const tss_ctx *c, const double *x, const double *d,
                             double t_max, tss_stencils *out) {
    (void)c, (void)x, (void)d, (void)t_max;
    out->count = 8, out->node = ((trap *)user)->node, out->pattern = 1;
    return TSS_OK;
}

static int trap_id(tss_ids ids, int k) { return ids.list ? ids.list[k] : ids.first + k; }

static void trap_value(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const trap *t = (const trap *)user;
    for (int k = 0; k < ids.count; k++) out[k] = t->slope * x[t->node[trap_id(ids, k)] * c->dim];
}

static void trap_gradient(void *user, const tss_ctx *c, const double *x, tss_ids ids, double *out) {
    const trap *t = (const trap *)user;
    (void)x;
    memset(out, 0, (size_t)(ids.count * c->dim) * sizeof *out);
    for (int k = 0; k < ids.count; k++) out[k * c->dim] = t->lie * t->slope;
}

static void trap_hessian(void *user, const tss_ctx *c, const double *x, tss_ids ids, int psd, double *out) {
    const trap *t = (const trap *)user;
    (void)x, (void)psd;
    memset(out, 0, (size_t)(ids.count * c->dim * c->dim) * sizeof *out);
    for (int k = 0; k < ids.count; k++)  // one node alone bends down
        out[k * c->dim * c->dim] = trap_id(ids, k) == 6 ? t->curvature : 0;
}

static double trap_step(void *user, const tss_ctx *c, const double *x, const double *d, double t_max,
                        int *culprit) {
    const trap *t = (const trap *)user;
    (void)c, (void)x, (void)d;
    *culprit = 4;
    return t->open < t_max ? t->open : t_max;
}

static void trap_describe(void *user, const tss_ctx *c, int id, char *text, size_t size) {
    (void)user, (void)c;
    snprintf(text, size, "gate %d", id);
}

static tss_energy add_trap(tss_world *w, trap *t) {
    tss_energy_def d = tss_energy_def_default();
    tss_energy id;
    for (int i = 0; i < 8; i++) t->node[i] = i;
    d.name = "trap", d.arity = 1, d.user = t, d.lists = trap_lists, d.value = trap_value;
    d.gradient = trap_gradient, d.hessian = trap_hessian, d.max_step = trap_step;
    d.describe = trap_describe;
    assert_int_equal(tss_energy_add(w, &d, &id), TSS_OK);
    return id;
}

// A step with this outcome: time goes on, the state is finite, and the message says why.
static tss_step_info outcome(tss_world *w, double budget, tss_status want, const char *text) {
    tss_step_info info;
    double time = tss_world_time(w);
    expect(budget > 0 ? tss_world_step_for(w, budget, &info) : tss_world_step(w, &info), TSS_OK);
    if (info.status != want) print_error("%s: %s\n", tss_status_text(info.status), info.message);
    assert_int_equal(info.status, want);
    status_seen[want] = 1;
    says(info.message, text);
    assert_true(fabs(tss_world_time(w) - time - 0.01) < 1e-12 && info.time == tss_world_time(w));
    for (int k = 0; k < 3 * tss_world_nodes(w); k++) assert_true(isfinite(tss_world_positions(w)[k]));
    assert_true(info.min_J > 0);
    return info;
}

static void test_status_converged(void **state) {
    (void)state;
    tss_world *w = one_box(tss_world_def_default());
    tss_step_info info = outcome(w, 0, TSS_STEP_CONVERGED, "");
    assert_string_equal(info.message, "");
    tss_world_destroy(w);
}

// One iterate for a soft cube hung by four corners; more, and the same step converges.
static void test_status_iterations(void **state) {
    (void)state;
    for (int most = 1; most <= 100; most += 99) {
        tss_world_def d = tss_world_def_default();
        d.max_iterations = most, d.tol = 1e-9, d.gravity[1] = -3000;
        tss_world *w = one_box(d);
        for (int i = 0; i < 8; i += 2) assert_int_equal(tss_node_pin(w, i, 7), TSS_OK);
        if (most == 1) {
            tss_step_info info = outcome(w, 0, TSS_STEP_ITERATIONS, "1 iterates taken");
            assert_true(info.newton == 1 && info.decrement > 1e-9);
        } else {
            outcome(w, 0, TSS_STEP_CONVERGED, "");
        }
        tss_world_destroy(w);
    }
}

static double ticking(void *ctx) { return *(double *)ctx += 1e-3; }  // every look takes 1 ms

static void test_status_budget(void **state) {
    (void)state;
    double now = 0;
    tss_world_def d = tss_world_def_default();
    d.tol = 1e-9, d.gravity[1] = -3000, d.host.clock = ticking, d.host.clock_ctx = &now;
    tss_world *w = one_box(d);
    for (int i = 0; i < 8; i += 2) assert_int_equal(tss_node_pin(w, i, 7), TSS_OK);
    tss_step_info info = outcome(w, 8e-3, TSS_STEP_BUDGET, "time is up");
    assert_true(info.newton >= 1);
    outcome(w, 1e6, TSS_STEP_CONVERGED, "");
    tss_world_destroy(w);
}

// A gradient that points up the hill, and a gate that lets nothing pass: no step is taken, and who
// forbade it is named. Without the trap the world goes on.
static void test_status_stalled(void **state) {
    (void)state;
    for (int gate = 0; gate < 2; gate++) {
        tss_world *w = one_box(tss_world_def_default());
        trap t = {gate ? 0.0 : 1e9, -1, 0, gate ? 0.0 : 1.0, {0}};
        tss_energy id = add_trap(w, &t);
        picture before = take(w);
        outcome(w, 0, TSS_STEP_STALLED, gate ? "gate 4" : "no decrease");
        assert_memory_equal(tss_world_positions(w), before.x, 24 * sizeof(double));
        drop(&before);
        assert_int_equal(tss_energy_remove(w, id), TSS_OK);
        outcome(w, 0, TSS_STEP_CONVERGED, "");
        tss_world_destroy(w);
    }
}

// A scripted node that may go half of its way at a time.
static void test_status_targets(void **state) {
    (void)state;
    tss_world_def d = tss_world_def_default();
    d.max_iterations = 1;
    tss_world *w = one_box(d);
    trap t = {0, 1, 0, 0.5, {0}};
    add_trap(w, &t);
    double to[3] = {0.1, 0, 0};
    assert_int_equal(tss_node_target(w, 0, to), TSS_OK);
    tss_step_info info = outcome(w, 0, TSS_STEP_TARGETS, "gate 4");
    assert_true(info.target_left > 0.04 && info.target_left < 0.1);
    double at = tss_world_positions(w)[0];
    assert_true(fabs(0.1 - at - info.target_left) < 1e-12);
    t.open = 1;
    assert_int_equal(tss_world_set_tol(w, 10), TSS_OK);  // so that one iterate will do
    outcome(w, 0, TSS_STEP_CONVERGED, "");
    assert_true(tss_world_positions(w)[0] == to[0]);
    tss_world_destroy(w);
}

// One node's curvature is −1e9 where the others have 1e3: no multiple of the mean diagonal mends it.
static void test_status_linear(void **state) {
    (void)state;
    tss_world_def d = tss_world_def_default();
    d.linear = TSS_LINEAR_DIRECT;
    tss_world *w = one_box(d);
    trap t = {0, 1, -1e9, 1, {0}};
    tss_energy id = add_trap(w, &t);
    picture before = take(w);
    outcome(w, 0, TSS_STEP_LINEAR, "node 6 of blob");
    assert_memory_equal(tss_world_positions(w), before.x, 24 * sizeof(double));
    drop(&before);
    assert_int_equal(tss_energy_remove(w, id), TSS_OK);
    outcome(w, 0, TSS_STEP_CONVERGED, "");
    tss_world_destroy(w);
}

// ---- bad input --------------------------------------------------------------------------------
// test_core.c has, in 3D: inverted, degenerate, duplicate, unreferenced, out of range, a node twice
// in a cell, NaN in X and x0, E <= 0, nu >= 0.5, rho <= 0, an inverted start, millimetres.
// test_ipcworld.c: a start that intersects in 3D. test_io.c: files, coincident nodes of a mesh.

static void bad_body(int dim, const tss_body_def *d, tss_result want, const char *text) {
    tss_world_def wd = tss_world_def_default();
    wd.dim = dim;
    tss_world *w = make_world(wd);
    tss_body b = 7;
    REFUSED(w, tss_body_add(w, d, &b), want, text);
    assert_int_equal(b, -1);
    tss_world_destroy(w);
}

static void test_bad_cells(void **state) {
    (void)state;
    double P[8] = {0, 0, 1, 0, 0, 1, 1, 1}, Q[8];
    int ok2[6] = {0, 1, 2, 1, 3, 2}, turned[6] = {0, 2, 1, 1, 3, 2}, twice[6] = {0, 1, 2, 2, 0, 1};
    tss_body_def flat = tss_body_def_default(), d;
    flat.name = "flat", flat.nodes = 4, flat.X = P, flat.cells = 2, flat.cell = ok2;
    d = flat, d.cell = turned, bad_body(2, &d, TSS_ERROR_BAD_MESH, "flat: cell 0 is inverted");
    d = flat, d.cell = twice, d.nodes = 3, bad_body(2, &d, TSS_ERROR_BAD_MESH, "cells 0 and 1");
    d = flat, d.cells = 1, bad_body(2, &d, TSS_ERROR_BAD_MESH, "node 3 belongs to no cell");
    memcpy(Q, P, sizeof Q), Q[6] = 0.5, Q[7] = 0.5;
    d = flat, d.X = Q, bad_body(2, &d, TSS_ERROR_BAD_MESH, "cell 1 is degenerate");
    d = flat, d.triangles = 1, d.triangle = ok2, bad_body(2, &d, TSS_ERROR_BAD_MESH, "in 2D");
    d = flat, d.cells = -1, bad_body(2, &d, TSS_ERROR_BAD_ARGUMENT, "-1 cells");
    d = flat, d.cell = NULL, bad_body(2, &d, TSS_ERROR_BAD_ARGUMENT, "no array");
    d = flat, d.nodes = INT32_MAX, bad_body(2, &d, TSS_ERROR_BAD_ARGUMENT, "too many");

    box b = make_box(0, 0, 0, 1);
    tss_body_def cube = box_body(&b, "cube");
    int cell[24], list[4] = {0, 1, -1, 3};
    memcpy(cell, b.cell, sizeof cell), cell[9] = -3;
    d = cube, d.cell = cell, bad_body(3, &d, TSS_ERROR_BAD_MESH, "cell 2 names node -3");
    d = cube, d.segments = 2, d.segment = list, bad_body(3, &d, TSS_ERROR_BAD_MESH, "segment 1 names node -1");
    d = cube, d.points = 3, d.point = list, bad_body(3, &d, TSS_ERROR_BAD_MESH, "point 2 names node -1");
    d = cube, d.pins = 3, d.pin = list, bad_body(3, &d, TSS_ERROR_BAD_MESH, "pin 2 names node -1");
    d = cube, d.cells = 0, bad_body(3, &d, TSS_ERROR_BAD_MESH, "needs cells");

    // Three tets on one face: no solid has such a boundary.
    double X[18] = {0, 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0.3, 0.3, 2, 0.3, 0.3, -1};
    int three[12] = {0, 1, 2, 3, 0, 1, 2, 4, 0, 2, 1, 5};
    d = tss_body_def_default(), d.name = "book", d.nodes = 6, d.X = X, d.cells = 3, d.cell = three;
    bad_body(3, &d, TSS_ERROR_BAD_MESH, "nodes 0 1 2 are a face of 3 cells");
}

static void test_bad_numbers(void **state) {
    (void)state;
    box b = make_box(0, 0, 0, 1), c = b;
    double v[24] = {0}, nu[6] = {0.3, 0.3, 0.3, -1, 0.3, 0.3};
    tss_body_def cube = box_body(&b, "cube"), d;
    c.X[4] = -INFINITY, v[10] = NAN;
    d = cube, d.X = c.X, bad_body(3, &d, TSS_ERROR_BAD_STATE, "cube: rest position of node 1 is -inf");
    d = cube, d.x0 = c.X, bad_body(3, &d, TSS_ERROR_BAD_STATE, "cube: position of node 1 is -inf");
    d = cube, d.v0 = v, bad_body(3, &d, TSS_ERROR_BAD_STATE, "velocity of node 3");
    d = cube, d.velocity[1] = NAN, bad_body(3, &d, TSS_ERROR_BAD_STATE, "velocity");
    d = cube, d.material.E = -1, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "cube: E = -1 Pa");
    d = cube, d.material.E = NAN, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "cube: E = ");
    d = cube, d.material.E = INFINITY, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "cube: E = inf");
    d = cube, d.material.nu = 0.7, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "nu = 0.7");
    d = cube, d.material.nu = -1, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "nu = -1");
    d = cube, d.material.nu = NAN, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "nu = ");
    d = cube, d.nu = nu, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "cube, cell 3: nu = -1");
    d = cube, d.material.rho = 0, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "rho = 0");
    d = cube, d.material.damping = NAN, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "damping");
    d = cube, d.material.kind = TSS_CUSTOM_MATERIAL, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "density");
    d = cube, d.material.kind = TSS_MATERIAL_KINDS, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "kind");
    d = cube, d.cells = 0, d.nodes = 4, d.triangles = 2, d.triangle = square, d.thickness = 0;
    bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "thickness = 0");
    d.thickness = NAN, bad_body(3, &d, TSS_ERROR_BAD_MATERIAL, "thickness");
}

// In 2D the crossing edges are named; behind a plane, the node and the plane.
static void test_bad_starts(void **state) {
    (void)state;
    double A[6] = {0, 0, 1, 0, 0, 1}, B[6] = {0.3, 0.3, 1.3, 0.3, 0.3, 1.3};
    int tri[3] = {0, 1, 2};
    tss_world_def wd = tss_world_def_default();
    wd.dim = 2;
    tss_world *w = make_world(wd);
    tss_body_def d = tss_body_def_default();
    tss_ipc_def ipc = tss_ipc_def_default();
    d.nodes = 3, d.X = A, d.cells = 1, d.cell = tri;
    assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
    d.X = B, assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
    assert_int_equal(tss_ipc_add(w, &ipc, NULL), TSS_OK);
    expect(tss_world_prepare(w), TSS_OK);
    REFUSED(w, tss_world_step(w, NULL), TSS_ERROR_INTERSECTION, "of body 0 crosses edge");
    says(tss_world_error(w), "of body 1");
    tss_world_destroy(w);

    w = one_box(tss_world_def_default());
    tss_ipc_plane plane = {{0, 0.2, 0}, {0, 2, 0}, 0};
    tss_check_report report;
    ipc.planes = 1, ipc.plane = &plane;
    assert_int_equal(tss_ipc_add(w, &ipc, NULL), TSS_OK);
    expect(tss_world_prepare(w), TSS_OK);
    REFUSED(w, tss_world_step(w, NULL), TSS_ERROR_INTERSECTION, "0.2 m behind plane 0");
    says(tss_world_error(w), "node 0 of body 0");
    expect(tss_world_check(w, &report), TSS_OK);
    assert_true(report.errors > 0);
    tss_world_destroy(w);
}

// An obstacle through a body counts as well; two obstacles through each other harm nobody.
static void test_bad_obstacles(void **state) {
    (void)state;
    for (int through = 0; through < 2; through++) {
        double X[12], Y[12];
        tss_body_def low = ground(X, through ? 0.5 : -0.5, 3), turned = ground(Y, 0, 3);
        for (int i = 0; i < 4; i++) Y[3 * i + 1] = Y[3 * i] - 20, Y[3 * i] = 0.1 * i;  // upright
        tss_world *w = one_box(tss_world_def_default());
        tss_ipc_def ipc = tss_ipc_def_default();
        assert_int_equal(tss_body_add(w, &low, NULL), TSS_OK);
        for (int i = 0; i < 4; i++) Y[3 * i + 1] += 19.5;
        assert_int_equal(tss_body_add(w, &turned, NULL), TSS_OK);
        assert_int_equal(tss_ipc_add(w, &ipc, NULL), TSS_OK);
        for (int i = 0; i < 4; i++) Y[3 * i] += 5 * (i + 1), Y[3 * i + 2] += 0.01 * i;
        assert_int_equal(tss_body_teleport(w, 2, Y, NULL), TSS_OK);
        expect(tss_world_prepare(w), TSS_OK);
        if (through)
            REFUSED(w, tss_world_step(w, NULL), TSS_ERROR_INTERSECTION, "of body 0");
        else
            expect(tss_world_step(w, NULL), TSS_OK);
        tss_world_destroy(w);
    }
}

// Millimetres under SI constants: the doctor says so and by how much to scale; scaled, it is silent.
static void test_millimetres(void **state) {
    (void)state;
    for (int scaled = 0; scaled < 2; scaled++) {
        box b = make_box(0, 0, 0, scaled ? 0.1 : 100);
        tss_body_def d = box_body(&b, "bracket");
        tss_world *w = make_world(tss_world_def_default());
        tss_check_report report;
        assert_int_equal(tss_body_add(w, &d, NULL), TSS_OK);
        expect(tss_world_prepare(w), TSS_OK);
        picture before = take(w);
        expect(tss_world_check(w, &report), TSS_OK);
        unchanged(w, &before);
        assert_int_equal(report.errors, 0);
        assert_int_equal(report.warnings, !scaled);
        if (!scaled) {
            assert_int_equal(report.issue[0].severity, TSS_SEVERITY_WARNING);
            says(report.issue[0].text, "bracket is 173.2 m long");
            says(report.issue[0].text, "millimetres"), says(report.issue[0].text, "0.001");
        }
        tss_world_destroy(w);
    }
}

// ---- every allocation of a world with contact -------------------------------------------------
// Two damped boxes of two materials fall on a scripted obstacle and past a plane, with friction, a
// scripted node, a spring between the two and a dragged node; a third body comes late and one goes.
// A run is a list of calls. Where memory fails within a call, it must say so and change nothing; it
// is then made again with memory back, and all bits from there on are those of an undisturbed run.

typedef struct run {
    tss_world *w;
    tss_ipc *contact;
    tss_embedding *points;
    tss_energy spring;
    tss_linear linear;
    memory *m;
    uint64_t answers;  // what the queries answered
} run;

static tss_result run_create(run *r) {
    tss_world_def d = tss_world_def_default();
    d.host = memory_host(r->m), d.linear = r->linear;
    tss_result q = tss_world_create(&d, &r->w);
    assert_true((q == TSS_OK) == (r->w != NULL));
    return q;
}

static tss_result run_body(run *r, int which) {
    static const double E[6] = {1e5, 2e5, 1e5, 2e5, 1e5, 2e5};
    double X[12];
    const double lift[3] = {0.03, 0.57, 1.1};  // d̂ = 0.02: contact begins within a step
    if (which == 3) {
        tss_body_def d = ground(X, 0, 2);
        return tss_body_add(r->w, &d, NULL);
    }
    box b = make_box(0.03 * which, lift[which], 0.02 * which, 0.5);
    tss_body_def d = box_body(&b, which == 0 ? "low" : which == 1 ? "high" : "late");
    d.velocity[1] = -1.5, d.velocity[0] = 0.5, d.material.damping = 0.002;
    if (which == 1) d.material.kind = TSS_STABLE_NEO_HOOKEAN, d.E = E;
    return tss_body_add(r->w, &d, NULL);
}

static tss_result run_contact(run *r) {
    tss_ipc_def d = tss_ipc_def_default();
    tss_ipc_plane plane = {{-0.02, 0, 0}, {1, 0, 0}, 0.2};
    tss_ipc_body body = {1, 0.4, -1};
    tss_ipc_pair pair = {0, 2, 0, 0.3};
    d.mu = 0.3, d.dhat = 0.02, d.friction_iterations = 2;
    d.planes = 1, d.plane = &plane, d.bodies = 1, d.body = &body, d.pairs = 1, d.pair = &pair;
    tss_result q = tss_ipc_add(r->w, &d, &r->contact);
    assert_true((q == TSS_OK) == (r->contact != NULL));
    return q;
}

// A spring from the top of the lower to the top of the higher box.
static tss_result run_spring(run *r) {
    static const int node[2] = {7, 15};
    static const double length[1] = {0.45};
    tss_spring_def d = tss_spring_def_default();
    tss_energy_def e = tss_energy_def_default();
    d.springs = 1, d.node = node, d.rest_length = length, d.stiffness = 300;
    tss_result q = tss_spring_energy(tss_world_host(r->w), &d, &e);
    if (q != TSS_OK) return tss_world_fail(r->w, q, "spring: %s", tss_result_text(q));
    q = tss_energy_add(r->w, &e, &r->spring);
    if (q != TSS_OK) e.destroy(e.user, tss_world_host(r->w));  // it stays the caller's
    return q;
}

static tss_result run_check(run *r) {
    tss_check_report report;
    tss_result q = tss_world_check(r->w, &report);
    if (q == TSS_OK && report.errors) print_error("%s\n", report.issue[0].text);
    return q == TSS_OK && report.errors ? TSS_ERROR_INTERSECTION : q;
}

static tss_result run_step(run *r, int with_info) {
    tss_step_info info;
    memset(&info, 0, sizeof info);
    tss_result q = tss_world_step(r->w, with_info ? &info : NULL);
    if (q == TSS_OK && with_info) {
        if (info.status != TSS_STEP_CONVERGED) print_error("%s\n", info.message);
        assert_int_equal(info.status, TSS_STEP_CONVERGED);
    }
    return q;
}

static void run_move(run *r) {  // setters that take no memory
    double X[12], to[3];
    const double *x = tss_world_positions(r->w);
    for (int k = 0; k < 12; k++) X[k] = x[3 * 16 + k] + (k % 3 == 1 ? 0.002 : 0);
    assert_int_equal(tss_body_target(r->w, 2, X), TSS_OK);
    for (int c = 0; c < 3; c++) to[c] = x[3 * 13 + c] + (c == 2 ? 0.004 : -0.003);
    assert_int_equal(tss_node_target(r->w, 13, to), TSS_OK);
}

static uint64_t mix(uint64_t h, const void *data, size_t size) {
    const unsigned char *p = (const unsigned char *)data;
    for (size_t k = 0; k < size; k++) h = (h ^ p[k]) * 1099511628211u;
    return h;
}

static tss_result run_queries(run *r, int which) {
    double out[3 * 64], K = 0, P = 0;
    float at[6];
    tss_ipc_contact contact[200];
    tss_ipc_touch touch[20];
    int count = 0, n = tss_world_nodes(r->w);
    const double point[6] = {0.1, 0.1, 0.1, 0.4, 0.4, 0.9};
    uint64_t h = r->answers;
    tss_result q;
    memset(out, 0, sizeof out);
    switch (which) {
        case 0: q = tss_ipc_contacts(r->contact, 200, contact, &count); break;
        case 1: q = tss_ipc_forces(r->contact, out); break;
        case 2: q = tss_ipc_pressures(r->contact, out); break;
        case 3: q = tss_ipc_touches(r->contact, 20, touch, &count); break;
        case 4: q = tss_world_gradient(r->w, out); break;
        case 5: q = tss_world_energy(r->w, &K, &P); break;
        default: q = tss_embedding_create(r->w, 0, point, 2, &r->points); break;
    }
    if (q != TSS_OK) return q;
    if (which == 0) assert_true(count > 0 && count < 200), h = mix(h, contact, (size_t)count * sizeof *contact);
    if (which == 3) assert_true(count > 0 && count < 20), h = mix(h, touch, (size_t)count * sizeof *touch);
    if (which > 5) tss_embedding_update(r->points, r->w, at), h = mix(h, at, sizeof at);
    h = mix(h, out, (size_t)(3 * n) * sizeof *out);
    h = mix(mix(h, &K, sizeof K), &P, sizeof P);
    r->answers = h;
    return TSS_OK;
}

static tss_result run_reload(run *r) {
    size_t size = tss_world_save(r->w, NULL, 0);
    void *data = malloc(size);
    assert_true(data && tss_world_save(r->w, data, size) == size);
    tss_result q = tss_world_load(r->w, data, size);
    free(data);
    return q;
}

static tss_result run_drag(run *r) {
    const double to[3] = {0.1, 0.8, 0.1};
    return tss_node_drag(r->w, 3, to, 50);
}

static tss_result run_energies(run *r) {
    tss_energy_report report;
    return tss_energy_check(r->w, r->spring, &report);
}

// Call number `at`; *done when there are no more.
static tss_result run_call(run *r, int at, int *done) {
    *done = 0;
    switch (at) {
        case 0: return run_create(r);
        case 1: return run_body(r, 0);
        case 2: return run_body(r, 1);
        case 3: return run_body(r, 3);
        case 4: return run_contact(r);
        case 5: return run_spring(r);
        case 6: return run_check(r);
        case 7: return tss_world_prepare(r->w);
        case 8: return run_step(r, 1);
        case 9: return run_step(r, 0);
        case 10: return run_step(r, 1);
        case 11: return run_drag(r);
        case 12: return run_step(r, 0);
        case 20: return run_reload(r);
        case 21: return run_step(r, 1);
        case 22: return run_energies(r);
        case 23: return run_body(r, 2);
        case 24: return tss_world_prepare(r->w);
        case 25: return run_step(r, 1);
        case 26: return tss_body_remove(r->w, 1);
        case 27: return tss_world_prepare(r->w);
        case 28: return run_step(r, 0);
        case 29: return run_step(r, 1);
        default: break;
    }
    if (at > 12 && at < 20) return run_queries(r, at - 13);
    *done = 1;
    return TSS_OK;
}

// Something a setter does before call `at`, once.
static void run_before(run *r, int at) {
    if ((at >= 8 && at <= 10) || at == 12 || at == 21) run_move(r);
}

typedef struct trace {  // of an undisturbed run
    uint64_t hash[64], answers;
    int calls;
    size_t size;
    void *last;  // checkpoint at the end
} trace;

// True if what memory refused during the call came out of it as an error, and nothing changed.
static int run_failed_well(run *r, int at, tss_result q, int64_t refused, const picture *before) {
    if (r->m->refused == refused) return q == TSS_OK;
    if (q != TSS_ERROR_NO_MEMORY) {
        print_error("call %d: memory ran out and it said '%s'\n", at, tss_result_text(q));
        return 0;
    }
    if (!r->w) return 1;
    const char *why = tss_world_error(r->w);
    if (!strstr(why, "memory") && !strstr(why, tss_result_text(TSS_ERROR_NO_MEMORY))) {
        print_error("call %d: '%s' does not speak of memory\n", at, why);
        return 0;
    }
    if (at == 0) return 1;  // there was none before
    if (same(r->w, before, at == 6 || at == 7 || at == 24 || at == 27)) return 1;
    print_error("call %d: failed and left another world\n", at);
    return 0;
}

// One run. Returns the number of faults; *ran 1 if no allocation failed. want NULL: fills got.
static int run_all(memory *m, tss_linear linear, const trace *want, trace *got, int *ran) {
    run r;
    int faults = 0;
    memset(&r, 0, sizeof r);
    r.m = m, r.linear = linear;
    for (int at = 0, done = 0; !done && !faults; at++) {
        picture before;
        memset(&before, 0, sizeof before);
        if (r.w) {
            run_before(&r, at);
            before = take(r.w);
        }
        int64_t refused = m->refused;
        tss_result q = run_call(&r, at, &done);
        faults += !run_failed_well(&r, at, q, refused, &before);
        drop(&before);
        if (m->refused > refused) memory_back(m);
        if (q != TSS_OK) q = run_call(&r, at, &done);
        if (q != TSS_OK) print_error("call %d again: %s\n", at, tss_result_text(q)), faults++;
        uint64_t hash = r.w ? tss_world_hash(r.w) : 0;
        if (got) got->hash[at] = hash, got->calls = at;
        if (want && want->hash[at] != hash) print_error("call %d: other bits after it was made again\n", at), faults++;
    }
    if (!faults && want && r.answers != want->answers) print_error("queries answer otherwise\n"), faults++;
    if (r.w) {
        picture p = take(r.w);
        if (!faults && want && (p.size != want->size || memcmp(p.all, want->last, p.size) != 0))
            print_error("another checkpoint at the end\n"), faults++;
        if (got) got->answers = r.answers, got->size = p.size, got->last = p.all, p.all = NULL;
        drop(&p);
    }
    tss_embedding_destroy(r.points);
    tss_world_destroy(r.w);
    *ran = m->refused == 0;
    if (m->live != 0 || m->bytes != 0)
        print_error("%lld blocks, %lld bytes leaked\n", (long long)m->live, (long long)m->bytes), faults++;
    return faults;
}

// Allocation k alone, and k with all after it. A run makes about 400; `all`: each k up to 300, then
// (the later steps' are of the same places as the first ones') every 7th; else every 7th.
static void no_memory(tss_linear linear, int all) {
    trace clean;
    memory m;
    int faults = 0, ran = 0, tried = 0;
    memset(&clean, 0, sizeof clean), memset(&m, 0, sizeof m);
    assert_int_equal(run_all(&m, linear, NULL, &clean, &ran), 0);
    int64_t calls = m.calls;
    assert_true(ran && clean.calls > 25 && calls > 100);
    memset(&m, 0, sizeof m);
    assert_int_equal(run_all(&m, linear, &clean, NULL, &ran), 0);  // the bits are its own again
    for (int to_the_end = 0; to_the_end < 2; to_the_end++) {
        ran = 0;
        for (int64_t k = 1; !ran; k += all && k < 300 ? 1 : 7, tried++) {
            memset(&m, 0, sizeof m);
            m.fail_at = k, m.to_the_end = to_the_end;
            int bad = run_all(&m, linear, &clean, NULL, &ran);
            if (bad) print_error("  allocation %lld%s\n", (long long)k, to_the_end ? " and all after it" : "");
            faults += bad > 0;
            assert_true(k <= calls + 7);
        }
    }
    print_message("    %lld allocations, %d runs, %d with faults\n", (long long)calls, tried, faults);
    free(clean.last);
    assert_int_equal(faults, 0);
}

// A hard landing, resumed after each step in a second world: whatever contact remembers of the
// steps before is in the checkpoint.
static void test_resume_landing(void **state) {
    (void)state;
    tss_world *w[2];
    for (int k = 0; k < 2; k++) {
        double X[12];
        tss_world_def wd = tss_world_def_default();
        wd.linear = TSS_LINEAR_DIRECT, wd.tol_rel = 1e-4;
        box b = make_box(0, 0.06, 0, 0.5);
        tss_body_def d = box_body(&b, "box"), low = ground(X, 0, 2);
        tss_ipc_def ipc = tss_ipc_def_default();
        w[k] = make_world(wd);
        d.velocity[1] = -8, d.material.E = 1e6, ipc.dhat = 0.02;
        assert_int_equal(tss_body_add(w[k], &d, NULL), TSS_OK);
        assert_int_equal(tss_body_add(w[k], &low, NULL), TSS_OK);
        assert_int_equal(tss_ipc_add(w[k], &ipc, NULL), TSS_OK);
        expect(tss_world_prepare(w[k]), TSS_OK);
    }
    int other = 0;
    for (int s = 0; s < 30; s++) {
        expect(tss_world_step(w[0], NULL), TSS_OK);
        picture p = take(w[0]);
        expect(tss_world_load(w[1], p.all, p.size), TSS_OK);
        drop(&p);
        expect(tss_world_step(w[0], NULL), TSS_OK);
        expect(tss_world_step(w[1], NULL), TSS_OK);
        other += tss_world_hash(w[0]) != tss_world_hash(w[1]);
    }
    assert_int_equal(other, 0);
    tss_world_destroy(w[0]), tss_world_destroy(w[1]);
}

static void test_no_memory_direct(void **state) {
    (void)state;
    no_memory(TSS_LINEAR_DIRECT, 1);
}

static void test_no_memory_auto(void **state) {
    (void)state;
    no_memory(TSS_LINEAR_AUTO, 0);
}

static void test_no_memory_pcg(void **state) {
    (void)state;
    no_memory(TSS_LINEAR_PCG, 0);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_ok),
        cmocka_unit_test(test_result_no_memory),
        cmocka_unit_test(test_result_bad_argument),
        cmocka_unit_test(test_result_bad_state),
        cmocka_unit_test(test_result_not_found),
        cmocka_unit_test(test_result_empty),
        cmocka_unit_test(test_result_not_prepared),
        cmocka_unit_test(test_result_intersection),
        cmocka_unit_test(test_result_singular),
        cmocka_unit_test(test_result_file),
        cmocka_unit_test(test_result_format),
        cmocka_unit_test(test_result_mismatch),
        cmocka_unit_test(test_status_converged),
        cmocka_unit_test(test_status_iterations),
        cmocka_unit_test(test_status_budget),
        cmocka_unit_test(test_status_stalled),
        cmocka_unit_test(test_status_targets),
        cmocka_unit_test(test_status_linear),
        cmocka_unit_test(test_bad_cells),
        cmocka_unit_test(test_bad_numbers),
        cmocka_unit_test(test_bad_starts),
        cmocka_unit_test(test_bad_obstacles),
        cmocka_unit_test(test_millimetres),
        cmocka_unit_test(test_resume_landing),
        cmocka_unit_test(test_no_memory_direct),
        cmocka_unit_test(test_no_memory_auto),
        cmocka_unit_test(test_no_memory_pcg),
        cmocka_unit_test(test_all_seen),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
