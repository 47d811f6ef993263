/* bench_stability.c: stiff, fast, thin, tight and degenerate cases in every mode, judged on every
   accepted iterate by the independent checker (tests/checker.h)

   cc -O3 ... -I. -Iexamples -Itests bench/bench_stability.c -lcjson -lmetis -lm
   bench_stability OUT NAME...            rows of OUT/stability.csv, stiffness.csv, rigid.csv
   bench_stability OUT --small NAME...    fewer cases and steps; `ok NAME` or `FAILED NAME: why`

   NAME: a case, the first letters of several, `stiffness`, `fine_stiffness`, `rigid`, or `all`. Rows that a file
   already has are not run again. Exit code: 0, 1 a guarantee or claim failed, 2 a case cannot be run.

   COLUMNS OF stability.csv
   steps            taken; fewer than planned where a row ran out of its Newton iterates (LIMIT)
   status           converged, or the worst status of any step (order in `worse`)
   newton_*         iterates a step; linear_max: iterations of conjugate gradients in a step, 0: direct
   min_J            smallest of all accepted iterates, by the checker
   min_distance     smallest of the ends of steps, m; empty: nothing came nearer than d-hat
   path_ok          1: no intersection, passing through or inversion on any segment between iterates
   finite           1: every position and velocity was finite after every step
   energy_drift     (T + V at the end) / (at the start) - 1, of bodies that nothing touches or pulls
   momentum_drift   the larger of |p - p0| / s and |L - L0| / (s l/2), s = sqrt(2 M (T0 + V0)), l the
                    diagonal, L about the first centre of mass; of the same bodies and of collisions
                    without obstacles
   seconds          of the steps, the checker's time taken off                                        */
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"
#include "tss_io.h"
#include "tss_shapes.h"
#define SCENE_IMPLEMENTATION
#include "scene.h"

#include "checker.h"

#include <errno.h>
#include <stdio.h>
#include <sys/stat.h>
#include <time.h>

#define MAX_KEYS 32
#define LIMIT 6000        // Newton iterates of a row; a case that needs more is cut short, and says so
#define TEXT 16384
#define TOLERANCE "solver.tol_rel=1e-3"  // ten times below the library's default

static const char *out;   // folder
static int small_;        // 1: claims are judged
static int failures;

static double now(void *ctx) {
    struct timespec t;
    (void)ctx;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

static void die(const char *what, const char *why) {
    fprintf(stderr, "bench_stability: %s: %s\n", what, why);
    exit(2);
}

static void *need(size_t count, size_t size) {
    void *p = calloc(count + 1, size);
    if (!p) die("memory", "none left");
    return p;
}

// ---------------------------------------------------------------------------------------------
// >>meshes: what no shape gives; written to OUT as Medit files and read as scenes read them
// ---------------------------------------------------------------------------------------------

static void write_mesh(const char *name, const double *x, int nodes, const int *tet, int tets) {
    char path[600];
    snprintf(path, sizeof path, "%s/%s.mesh", out, name);
    FILE *f = fopen(path, "w");
    if (!f) die(path, strerror(errno));
    fprintf(f, "MeshVersionFormatted 2\nDimension 3\nVertices\n%d\n", nodes);
    for (int i = 0; i < nodes; i++)
        fprintf(f, "%.17g %.17g %.17g 0\n", x[3 * i], x[3 * i + 1], x[3 * i + 2]);
    fprintf(f, "Tetrahedra\n%d\n", tets);
    for (int k = 0; k < tets; k++)
        fprintf(f, "%d %d %d %d 0\n", tet[4 * k] + 1, tet[4 * k + 1] + 1, tet[4 * k + 2] + 1,
                tet[4 * k + 3] + 1);
    fprintf(f, "End\n");
    if (fclose(f) != 0) die(path, strerror(errno));
}

// Smallest dihedral angle of a tet, degrees.
static double least_dihedral(const double *x, const int *tet, int tets) {
    double least = 180;
    for (int k = 0; k < tets; k++) {
        double n[4][3];
        for (int f = 0; f < 4; f++) {
            const double *a = x + 3 * tet[4 * k + (f + 1) % 4], *b = x + 3 * tet[4 * k + (f + 2) % 4],
                         *c = x + 3 * tet[4 * k + (f + 3) % 4], *o = x + 3 * tet[4 * k + f];
            double u[3], v[3], w[3], l = 0, s = 0;
            for (int i = 0; i < 3; i++) u[i] = b[i] - a[i], v[i] = c[i] - a[i], w[i] = o[i] - a[i];
            for (int i = 0; i < 3; i++) {
                n[f][i] = u[(i + 1) % 3] * v[(i + 2) % 3] - u[(i + 2) % 3] * v[(i + 1) % 3];
                l += n[f][i] * n[f][i], s += n[f][i] * w[i];
            }
            for (int i = 0; i < 3; i++) n[f][i] *= (s > 0 ? -1 : 1) / sqrt(l);
        }
        for (int f = 0; f < 4; f++)
            for (int g = 0; g < f; g++) {
                double c = n[f][0] * n[g][0] + n[f][1] * n[g][1] + n[f][2] * n[g][2];
                least = fmin(least, 180 - acos(fmax(-1, fmin(1, c))) * 57.29577951308232);
            }
    }
    return least;
}

// A cube of 20 cm whose fourth layer of cells is so thin that its tets have dihedral angles of 1 degree.
static void slivers(void) {
    static const double y[7] = {0, 0.05, 0.1, 0.15, 0.15043, 0.175, 0.2};
    const double lower[3] = {-0.1, 0, -0.1}, upper[3] = {0.1, 6, 0.1};
    const int n[3] = {4, 6, 4};
    tss_mesh m;
    if (tss_shape_box(NULL, lower, upper, n, 6, NULL, &m) != TSS_OK) die("slivers", "no mesh");
    for (int i = 0; i < m.nodes; i++) m.x[3 * i + 1] = y[(int)(m.x[3 * i + 1] + 0.5)];
    double angle = least_dihedral(m.x, m.tet, m.tets);
    if (!(angle > 0.1 && angle <= 1)) die("slivers", "the mesh has no dihedral angle of 1 degree");
    write_mesh("slivers", m.x, m.nodes, m.tet, m.tets);
    tss_mesh_free(&m);
}

// Exact corners on the axes, so that a corner stands over a corner to the last bit.
static void octahedron(void) {
    static const double x[21] = {0,   0, 0, 0.1, 0, 0,    -0.1, 0,   0, 0, 0.1,
                                 0,   0, -0.1, 0, 0, 0, 0.1, 0, 0, -0.1};
    static const int tet[32] = {0, 1, 3, 5, 0, 3, 2, 5, 0, 2, 4, 5, 0, 4, 1, 5,
                                0, 3, 1, 6, 0, 2, 3, 6, 0, 4, 2, 6, 0, 1, 4, 6};
    write_mesh("octahedron", x, 7, tet, 8);
}

// A bar along z with a square cross-section that stands on its corner: edges exactly along z.
static void ridge(void) {
    const double lower[3] = {0, 0, -0.15}, upper[3] = {1, 1, 0.15};
    const int n[3] = {2, 2, 6};
    tss_mesh m;
    if (tss_shape_box(NULL, lower, upper, n, 6, NULL, &m) != TSS_OK) die("ridge", "no mesh");
    for (int i = 0; i < m.nodes; i++) {
        double u = m.x[3 * i], v = m.x[3 * i + 1];
        m.x[3 * i] = 0.0625 * (u - v), m.x[3 * i + 1] = 0.0625 * (u + v);
    }
    write_mesh("ridge", m.x, m.nodes, m.tet, m.tets);
    tss_mesh_free(&m);
}

// ---------------------------------------------------------------------------------------------
// >>cases
// Every soft body has a basis, which full space does not use. Keys as in examples/scene.h.
// ---------------------------------------------------------------------------------------------

#define SKIN "\"basis\": {\"kind\": \"skinning\", \"count\": 6}"
#define AFFINE "\"basis\": {\"kind\": \"affine\"}"
#define MATERIAL "\"material\": {\"E\": 1e5, \"nu\": 0.4, \"rho\": 1000}"
#define GROUND "\"planes\": [{}]"
#define FREE "\"gravity\": [0, 0, 0]"
#define BOX(name, lower, upper, cells, rest)                                                       \
    "{\"name\": \"" name "\", \"shape\": {\"kind\": \"box\", \"lower\": " lower ", \"upper\": " upper    \
    ", \"cells\": " cells "}, " MATERIAL ", " rest "}"

// Fig. 16: a rubber hand on a bed of spikes.
static const char hand[] =
    "{\"world\": {\"steps\": 14}, \"contact\": {\"mu\": 0.2}, \"bodies\": ["
    "{\"name\": \"hand\", \"shape\": {\"kind\": \"hand\", \"cells\": 16}, \"rotate\": [90, 0, 0],"
    " \"translate\": [0, 0.37, 0], \"velocity\": [0, -1, 0],"
    " \"material\": {\"E\": 1e6, \"nu\": 0.45, \"rho\": 1000}, " SKIN "},"
    "{\"name\": \"spikes\", \"shape\": {\"kind\": \"spikes\", \"cells\": 16, \"count\": 4, \"ratio\": 0.09},"
    " \"pins\": [{\"upper\": [1, 0.1, 1]}],"
    " \"material\": {\"E\": 1e6, \"nu\": 0.4, \"rho\": 1000}, " SKIN "}]}";

static const char block[] = "{\"world\": {\"steps\": 30}, \"contact\": {\"mu\": 0.3}, \"bodies\": [" BOX(
    "block", "[-0.1, 0.01, -0.1]", "[0.1, 0.21, 0.1]", "[7, 7, 7]",
    "\"velocity\": [0, -1, 0], " SKIN) "], " GROUND "}";

static const char two[] =
    "{\"world\": {\"steps\": 40}, \"contact\": {\"mu\": 0.3}, \"bodies\": [" BOX(
        "lower", "[-0.1, 0.002, -0.1]", "[0.1, 0.202, 0.1]", "[4, 4, 4]", SKIN) ", " BOX(
        "upper", "[-0.08, 0.204, -0.08]", "[0.08, 0.364, 0.08]", "[3, 3, 3]",
        SKIN) "], " GROUND "}";

static const char bar[] =
    "{\"world\": {\"dt\": 0.02, \"steps\": 50, " FREE "}, \"bodies\": [" BOX(
        "bar", "[-0.5, -0.05, -0.05]", "[0.5, 0.05, 0.05]", "[28, 4, 4]",
        SKIN ", \"pins\": [{\"upper\": [0, 1, 1]}, {\"lower\": [1, 0, 0]}]") "]}";

static const char press[] =
    "{\"world\": {\"dt\": 0.02, \"steps\": 50}, \"contact\": {\"mu\": 0.3}, \"bodies\": [" BOX(
        "block", "[-0.1, 0.001, -0.1]", "[0.1, 0.201, 0.1]", "[7, 7, 7]",
        SKIN) ", {\"name\": \"plate\", \"shape\": {\"kind\": \"box_surface\", \"lower\": [-0.6, 0, -0.6],"
              " \"upper\": [0.6, 0.05, 0.6], \"cells\": 2}, \"translate\": [0, 0.202, 0], \"obstacle\": true,"
              " \"motion\": {\"velocity\": [0, -0.182, 0], \"end\": 1}}], " GROUND "}";

static const char ball[] = "{\"world\": {\"steps\": 40, " FREE "}, \"bodies\": [" BOX(
    "cube", "[-0.1, -0.1, -0.1]", "[0.1, 0.1, 0.1]", "[4, 4, 4]", SKIN) "]}";

static const char slope[] =
    "{\"world\": {\"steps\": 40}, \"bodies\": [" BOX(
        "block", "[-0.1, 0.001, -0.1]", "[0.1, 0.101, 0.1]", "[4, 2, 4]",
        SKIN ", \"rotate\": [0, 0, -25]") "], \"planes\": [{\"normal\": [0.42261826174069944, 0.9063077870366499, 0]}]}";

static const char knives[] =
    "{\"world\": {\"steps\": 30}, \"contact\": {\"mu\": 0.3}, \"bodies\": [" BOX(
        "sheet", "[-0.3, 0.1, -0.3]", "[0.3, 0.105, 0.3]", "[14, 1, 14]",
        "\"velocity\": [0, -1, 0], " SKIN) ", {\"name\": \"knives\", \"shape\": {\"kind\": \"segments\","
                                           " \"lower\": [-0.2, 0.09, -0.4], \"upper\": [0.2, 0.09, 0.4],"
                                           " \"count\": 3, \"cells\": 1}, \"obstacle\": true}]}";

// A block in a slot of planes, another above: every gap is 1e-6 of the diagonal of the two, 0.49 m.
static const char tight[] =
    "{\"world\": {\"steps\": 20}, \"contact\": {\"mu\": 0.3}, \"bodies\": [" BOX(
        "lower", "[-0.1, 4.9e-7, -0.1]", "[0.1, 0.2, 0.1]", "[4, 4, 4]", SKIN) ", " BOX(
        "upper", "[-0.1, 0.20000049, -0.1]", "[0.1, 0.4, 0.1]", "[4, 4, 4]", SKIN) "],"
    " \"planes\": [{}, {\"origin\": [-0.10000049, 0, 0], \"normal\": [1, 0, 0]},"
    " {\"origin\": [0.10000049, 0, 0], \"normal\": [-1, 0, 0]},"
    " {\"origin\": [0, 0, -0.10000049], \"normal\": [0, 0, 1]}, {\"origin\": [0, 0, 0.10000049], \"normal\": [0, 0, -1]}]}";

static const char parallel[] =
    "{\"world\": {\"steps\": 40}, \"contact\": {\"mu\": 0.3}, \"bodies\": ["
    "{\"name\": \"lower\", \"mesh\": \"ridge.mesh\", " MATERIAL ", " SKIN ", \"pins\": [{\"upper\": [1, 0.3, 1]}]},"
    "{\"name\": \"upper\", \"mesh\": \"ridge.mesh\", \"translate\": [0, 0.126, 0], " MATERIAL ", " SKIN "}]}";

static const char corner_corner[] =
    "{\"world\": {\"steps\": 40}, \"contact\": {\"mu\": 0.3}, \"bodies\": ["
    "{\"name\": \"lower\", \"mesh\": \"octahedron.mesh\", " MATERIAL ", " AFFINE ", \"pins\": [{\"upper\": [1, 0.3, 1]}]},"
    "{\"name\": \"upper\", \"mesh\": \"octahedron.mesh\", \"translate\": [0, 0.201, 0], " MATERIAL ", " AFFINE "}]}";

static const char corner_edge[] =
    "{\"world\": {\"steps\": 40}, \"contact\": {\"mu\": 0.3}, \"bodies\": ["
    "{\"name\": \"lower\", \"mesh\": \"ridge.mesh\", " MATERIAL ", " SKIN ", \"pins\": [{\"upper\": [1, 0.3, 1]}]},"
    "{\"name\": \"upper\", \"mesh\": \"octahedron.mesh\", \"translate\": [0, 0.226, 0.01], " MATERIAL ", " AFFINE "}]}";

static const char sliver_drop[] =
    "{\"world\": {\"steps\": 30}, \"contact\": {\"mu\": 0.3}, \"bodies\": [{\"name\": \"block\","
    " \"mesh\": \"slivers.mesh\", \"translate\": [0, 0.01, 0], \"velocity\": [0, -1, 0], " MATERIAL ", " SKIN "}], " GROUND "}";

// count blocks of 10 cm, one above the other, each exactly over the one below. E = 1e9 Pa: a column of
// width w buckles under its own weight at a height of (7.84 E w^2 / (12 rho g))^(1/3), 0.9 m at 1e6 Pa
// 8.7 m at 1e9 Pa. The gaps are just wider than d-hat: narrower ones are loaded springs.
static char *stack(int count) {
    char *text = (char *)need(TEXT, 1);
    size_t at = (size_t)snprintf(text, TEXT, "{\"world\": {\"steps\": 1000}, \"contact\": {\"mu\": 0.5, \"dhat\": 2e-4}, \"bodies\": [");
    for (int k = 0; k < count && at < TEXT; k++)
        at += (size_t)snprintf(text + at, TEXT - at,
                               "%s{\"name\": \"block %d\", \"shape\": {\"kind\": \"box\", \"lower\": [-0.05, 0, -0.05],"
                               " \"upper\": [0.05, 0.1, 0.05], \"cells\": [2, 2, 2]}, \"translate\": [0, %.17g, 0],"
                               " \"material\": {\"E\": 1e9, \"nu\": 0.4, \"rho\": 1000}, " AFFINE "}",
                               k ? ", " : "", k, 2.1e-4 + 0.10021 * k);
    if (at >= TEXT || (size_t)snprintf(text + at, TEXT - at, "], " GROUND "}") >= TEXT - at)
        die("stack", "text too long");
    return text;
}

enum { FLIES = 1, TOUCHES = 2 };  // energy and momentum are kept; momentum alone

typedef struct run run;

typedef struct test {
    const char *name, *scene, *keys;  // keys: "a=1; b=2"
    int small_steps;                  // 0: not in the small version
    unsigned kept;
    void (*pose)(run *r);             // before the first step; NULL
    const char *(*claim)(run *r);     // after the last; NULL or what failed
} test;

struct run {
    const test *t;
    int mode;  // tss_mode
    scene s;
    scene_error why;
    tss_world *w;
    tss_ipc *ipc;
    check *judge;
    check_report verdict;
    int *body, *cells, *edges;
    unsigned char *kinematic;
    double *halfspaces, *start;
    double checking;  // s
    int *newton, steps, linear, finite, bad, untrue;  // untrue: converged above the tolerance
    tss_status worst;
    tss_step_info info;
    double distance, seconds, energy[2], momentum[2][6], mass;
    char message[320];
};

// Squeezed into a layer of a thousandth of its height: every J is 1e-3, nothing intersects.
static void flatten(run *r) {
    int n = tss_world_nodes(r->w);
    double *x = (double *)need(3 * (size_t)n, sizeof *x);
    memcpy(x, tss_world_positions(r->w), 3 * (size_t)n * sizeof *x);
    for (int i = 0; i < n; i++) x[3 * i + 1] *= 1e-3;
    if (tss_body_teleport(r->w, 0, x, NULL) != TSS_OK) die("flat", tss_world_error(r->w));
    free(x);
}

#define OMEGA 20.0  // rad/s

static void mass_center(const tss_world *w, double *center) {
    const double *x = tss_world_positions(w), *m = tss_world_masses(w);
    double mass = 0;
    memset(center, 0, 3 * sizeof *center);
    for (int i = 0; i < tss_world_nodes(w); i++) {
        mass += m[i];
        for (int c = 0; c < 3; c++) center[c] += m[i] * x[3 * i + c];
    }
    for (int c = 0; c < 3 && mass > 0; c++) center[c] /= mass;
}

// The velocities of a rigid rotation about the axis z through the centre of mass.
static void spin(run *r) {
    int n = tss_world_nodes(r->w);
    const double *x = tss_world_positions(r->w);
    double *v = (double *)need(3 * (size_t)n, sizeof *v), c[3];
    mass_center(r->w, c);
    for (int i = 0; i < n; i++)
        v[3 * i] = -OMEGA * (x[3 * i + 1] - c[1]), v[3 * i + 1] = OMEGA * (x[3 * i] - c[0]);
    if (tss_body_teleport(r->w, 0, x, v) != TSS_OK) die("spin", tss_world_error(r->w));
    free(v);
}

// Largest relative change of an edge's length in the body.
static double stretched(const run *r) {
    const double *x = tss_world_positions(r->w), *X = tss_world_rest(r->w);
    tss_body_info b;
    double most = 0;
    if (tss_body_get(r->w, 0, &b) != TSS_OK) return INFINITY;
    const int *cell = tss_body_cells(r->w, 0);
    for (int k = 0; k < 4 * b.cells; k++)
        for (int e = k + 1; e < k - k % 4 + 4; e++) {
            double l = 0, L = 0;
            for (int c = 0; c < 3; c++) {
                l += pow(x[3 * cell[k] + c] - x[3 * cell[e] + c], 2);
                L += pow(X[3 * cell[k] + c] - X[3 * cell[e] + c], 2);
            }
            most = fmax(most, fabs(sqrt(l / L) - 1));
        }
    return most;
}

// The centrifugal strain of a body of half diagonal R is about rho omega^2 R^2 / E = 1000 * 400 * 0.02
// / 1e7 = 8e-4; 2e-3 leaves room for its distribution. Energy is never gained.
static const char *keeps_shape(run *r) {
    double s = stretched(r);
    printf("spin %s stretched %.2e\n", r->mode == TSS_MODE_FULL ? "full" : r->mode == TSS_MODE_ADAPTIVE ? "adaptive" : "subspace", s);
    if (!(s < 2e-3)) return "the spinning body does not keep its shape";
    return r->energy[1] <= r->energy[0] * (1 + 1e-3) ? NULL : "energy was gained";
}

// No block leaves its place: sideways by a hundredth of its width, and at the end nothing moves.
static const char *stands_still(run *r) {
    const double *x = tss_world_positions(r->w), *v = tss_world_velocities(r->w);
    double side = 0, speed = 0;
    for (int i = 0; i < tss_world_nodes(r->w); i++) {
        side = fmax(side, hypot(x[3 * i] - r->start[3 * i], x[3 * i + 2] - r->start[3 * i + 2]));
        for (int c = 0; c < 3; c++) speed = fmax(speed, fabs(v[3 * i + c]));
    }
    printf("stack moved_sideways %.2e m speed_at_end %.2e m/s\n", side, speed);
    if (!(side < 1e-2)) return "a block of the stack moved sideways";
    return speed < 1e-1 ? NULL : "the stack moves";
}

static const test tests[] = {
    {"E_1e2", hand, "bodies.1.material.E=1e2", 6, 0, NULL, NULL},
    {"E_1e3", hand, "bodies.1.material.E=1e3", 0, 0, NULL, NULL},
    {"E_1e4", hand, "bodies.1.material.E=1e4", 0, 0, NULL, NULL},
    {"E_1e5", hand, "bodies.1.material.E=1e5", 0, 0, NULL, NULL},
    {"E_1e6", hand, "bodies.1.material.E=1e6", 0, 0, NULL, NULL},
    {"E_1e7", hand, "bodies.1.material.E=1e7", 0, 0, NULL, NULL},
    {"E_1e8", hand, "bodies.1.material.E=1e8", 0, 0, NULL, NULL},
    {"E_1e9", hand, "bodies.1.material.E=1e9", 0, 0, NULL, NULL},
    {"E_1e10", hand, "bodies.1.material.E=1e10", 0, 0, NULL, NULL},
    {"E_1e11", hand, "bodies.1.material.E=1e11", 0, 0, NULL, NULL},
    {"E_1e12", hand, "bodies.1.material.E=1e12", 6, 0, NULL, NULL},
    {"all_E_1e2", hand, "bodies.1.material.E=1e2; bodies.0.material.E=1e2", 0, 0, NULL, NULL},
    {"all_E_1e12", hand, "bodies.1.material.E=1e12; bodies.0.material.E=1e12", 0, 0, NULL, NULL},
    {"ratio_1e7_one_body", block,
     "bodies.0.material.E=1e4; bodies.0.regions=[{\"upper\": [0.5, 1, 1], \"material\": {\"E\": 1e11}}]", 20, 0, NULL, NULL},
    {"ratio_1e7_soft_below", two, "bodies.0.material.E=1e4; bodies.1.material.E=1e11", 20, 0, NULL, NULL},
    {"ratio_1e7_soft_above", two, "bodies.0.material.E=1e11; bodies.1.material.E=1e4", 0, 0, NULL, NULL},
    {"nu_0.49", block, "bodies.0.material.nu=0.49", 0, 0, NULL, NULL},
    {"nu_0.499", block, "bodies.0.material.nu=0.499", 0, 0, NULL, NULL},
    {"nu_0.4999", block, "bodies.0.material.nu=0.4999", 20, 0, NULL, NULL},
    {"nu_-0.9", block, "bodies.0.material.nu=-0.9", 3, 0, NULL, NULL},
    {"h_1e-5", block, "world.dt=1e-5; bodies.0.translate=[0, -0.0096, 0]; world.steps=100", 80, 0, NULL, NULL},
    {"h_1e-4", block, "world.dt=1e-4; bodies.0.translate=[0, -0.0096, 0]; world.steps=100", 0, 0, NULL, NULL},
    {"h_1e-3", block, "world.dt=1e-3; bodies.0.translate=[0, -0.0096, 0]; world.steps=60", 0, 0, NULL, NULL},
    {"h_1e-2", block, "world.dt=1e-2", 0, 0, NULL, NULL},
    {"h_1e-1", block, "world.dt=1e-1", 0, 0, NULL, NULL},
    {"h_1", block, "world.dt=1; world.steps=20; solver.tol_rel=1e-4", 0, 0, NULL, NULL},
    {"h_2", block, "world.dt=2; world.steps=20; solver.tol_rel=1e-4", 5, 0, NULL, NULL},
    {"impact_1", block, "world.dt=1e-3; world.steps=50", 0, 0, NULL, NULL},
    {"impact_10", block, "world.dt=1e-3; bodies.0.velocity=[0, -10, 0]", 0, 0, NULL, NULL},
    {"impact_100", block, "world.dt=1e-3; bodies.0.velocity=[0, -100, 0]; bodies.0.material.E=1e6", 10, 0, NULL, NULL},
    {"impact_1000", block, "world.dt=1e-3; bodies.0.velocity=[0, -1000, 0]; bodies.0.material.E=1e6", 8, 0, NULL, NULL},
    {"impact_1000_short", block, "world.dt=1e-5; bodies.0.velocity=[0, -1000, 0]; bodies.0.material.E=1e6; world.steps=40", 0, 0, NULL, NULL},
    {"impact_bodies_1000", two,
     "world.dt=1e-4; world.gravity=[0, 0, 0]; bodies.1.velocity=[0, -1000, 0]; bodies.0.material.E=1e7;"
     "bodies.1.material.E=1e7; planes=[]; contact.mu=0; world.steps=20", 0, TOUCHES, NULL, NULL},
    {"density_1e6_heavy_above", two, "bodies.0.material.E=1e8; bodies.0.material.rho=1; bodies.1.material.rho=1e6; bodies.1.material.E=1e8", 10, 0, NULL, NULL},
    {"density_1e6_heavy_below", two, "bodies.1.material.rho=1; bodies.0.material.rho=1e6; bodies.0.material.E=1e8", 0, 0, NULL, NULL},
    {"size_1e-4", block, "bodies.0.scale=5e-4; world.dt=1e-3; bodies.0.velocity=[0, -1e-3, 0]; bodies.0.translate=[0, -4e-6, 0]", 10, 0, NULL, NULL},
    {"size_1e-2", block, "bodies.0.scale=5e-2; bodies.0.velocity=[0, -0.1, 0]", 0, 0, NULL, NULL},
    {"size_1", block, "bodies.0.scale=5; bodies.0.material.E=1e6", 0, 0, NULL, NULL},
    {"size_1e2", block, "bodies.0.scale=5e2; bodies.0.velocity=[0, -10, 0]; bodies.0.material.E=1e8; world.dt=0.1", 0, 0, NULL, NULL},
    {"size_1e4", block, "bodies.0.scale=5e4; bodies.0.velocity=[0, -100, 0]; bodies.0.material.E=1e10; world.dt=1", 10, 0, NULL, NULL},
    {"compress_to_0.1", press, "", 50, 0, NULL, NULL},
    {"twist_4_turns", bar,
     "bodies.0.pins.0.motion={\"angular_velocity\": [-720, 0, 0]}; bodies.0.pins.1.motion={\"angular_velocity\": [720, 0, 0]}", 0, 0, NULL, NULL},
    {"twist_10_turns", bar,
     "world.steps=100; bodies.0.pins.0.motion={\"angular_velocity\": [-900, 0, 0], \"velocity\": [0.1, 0, 0]};"
     "bodies.0.pins.1.motion={\"angular_velocity\": [900, 0, 0], \"velocity\": [-0.1, 0, 0]}", 0, 0, NULL, NULL},
    {"stretch_to_5", bar, "bodies.0.pins.0.motion={\"velocity\": [-2, 0, 0]}; bodies.0.pins.1.motion={\"velocity\": [2, 0, 0]}", 50, 0, NULL, NULL},
    {"flat", ball, "world.dt=1e-3", 10, TOUCHES, flatten, NULL},
    {"sliver_1_degree", sliver_drop, "", 15, 0, NULL, NULL},
    {"graded_1000", block, "bodies.0.shape.cells=[4, 12, 4]; bodies.0.shape.grade=[1, 1000, 1]", 10, 0, NULL, NULL},
    {"knife_edges", knives, "", 6, 0, NULL, NULL},
    {"tight_1e-6", tight, "", 6, 0, NULL, NULL},
    {"tight_1e-6_small_dhat", tight, "contact.dhat_rel=2e-6", 0, 0, NULL, NULL},
    {"parallel_edges", parallel, "", 20, 0, NULL, NULL},
    {"coplanar_stack", NULL, "world.steps=100", 20, 0, NULL, stands_still},
    {"corner_over_corner", corner_corner, "", 20, 0, NULL, NULL},
    {"corner_over_edge", corner_edge, "", 20, 0, NULL, NULL},
    {"mu_0", slope, "contact.mu=0", 0, 0, NULL, NULL},
    {"mu_0.2", slope, "contact.mu=0.2", 0, 0, NULL, NULL},
    {"mu_0.5", slope, "contact.mu=0.5", 0, 0, NULL, NULL},
    {"mu_1", slope, "contact.mu=1", 0, 0, NULL, NULL},
    {"mu_3", slope, "contact.mu=3", 10, 0, NULL, NULL},
    {"stack_20", NULL, "", 60, 0, NULL, stands_still},
    {"spin", ball, "bodies.0.material.E=1e7; world.dt=2e-3; solver.tol_rel=1e-4; world.steps=100", 40, FLIES, spin, keeps_shape},
    {"spin_newmark", ball, "bodies.0.material.E=1e7; world.dt=2e-3; solver.tol_rel=1e-4; world.integrator=\"newmark\"; world.steps=100", 0, FLIES, spin, keeps_shape},
};

// ---------------------------------------------------------------------------------------------
// >>rows
// ---------------------------------------------------------------------------------------------

static const char *const modes[] = {"full", "adaptive", "subspace"};
static const tss_mode mode_of[] = {TSS_MODE_FULL, TSS_MODE_ADAPTIVE, TSS_MODE_SUBSPACE};

// The worse of two statuses: a solver that failed, then one that stalled, then one that ran out.
static tss_status worse(tss_status a, tss_status b) {
    static const tss_status order[] = {TSS_STEP_CONVERGED, TSS_STEP_BUDGET, TSS_STEP_ITERATIONS,
                                       TSS_STEP_TARGETS, TSS_STEP_STALLED, TSS_STEP_LINEAR};
    int i = 0, j = 0;
    while (order[i] != a) i++;
    while (order[j] != b) j++;
    return order[i > j ? i : j];
}

static void judge_iterate(const double *x0, const double *x1, void *ctx) {
    run *r = (run *)ctx;
    double t = now(NULL);
    if (r->judge) check_segment(r->judge, x0, x1);
    r->checking += now(NULL) - t;
}

// Surface edges that belong to no triangle: those of obstacles made of segments.
static int loose_edges(const tss_surface *f, int *edges) {
    int n = 0;
    for (int k = 0; k < f->edges; k++) {
        int a = f->edge[2 * k], b = f->edge[2 * k + 1], found = 0;
        for (int t = 0; t < f->triangles && !found; t++) {
            const int *v = f->triangle + 3 * t;
            found = (v[0] == a || v[1] == a || v[2] == a) && (v[0] == b || v[1] == b || v[2] == b);
        }
        if (!found) edges[2 * n] = a, edges[2 * n + 1] = b, n++;
    }
    return n;
}

// All bodies of the table are of the material with a barrier: each of their cells is judged.
static void begin_judge(run *r) {
    tss_surface f;
    check_mesh m;
    size_t n = (size_t)tss_world_nodes(r->w), cells = 0;
    memset(&m, 0, sizeof m);
    r->body = (int *)need(n, sizeof(int)), r->kinematic = (unsigned char *)need(n, 1);
    for (int pass = 0; pass < 2; pass++) {
        cells = 0;
        for (int b = 0; b < tss_world_bodies(r->w); b++) {
            tss_body_info i;
            if (tss_body_get(r->w, b, &i) != TSS_OK) die(r->t->name, tss_world_error(r->w));
            for (int k = 0; k < i.nodes; k++) r->body[i.first_node + k] = b;
            if (pass && i.cells) memcpy(r->cells + 4 * cells, tss_body_cells(r->w, b), 4 * (size_t)i.cells * sizeof(int));
            cells += (size_t)i.cells;
        }
        if (!pass) r->cells = (int *)need(4 * cells, sizeof(int));
    }
    if (tss_world_surface(r->w, &f) != TSS_OK) die(r->t->name, tss_world_error(r->w));
    r->edges = (int *)need(2 * (size_t)f.edges, sizeof(int));
    r->halfspaces = (double *)need(6 * (size_t)r->s.planes, sizeof(double));
    for (int k = 0; k < r->s.planes; k++) {
        memcpy(r->halfspaces + 6 * k, r->s.plane[k].origin, 3 * sizeof(double));
        memcpy(r->halfspaces + 6 * k + 3, r->s.plane[k].normal, 3 * sizeof(double));
    }
    m.dim = 3, m.nodes = (int)n, m.rest = tss_world_rest(r->w);
    m.cells = r->cells, m.n_cells = (int)cells;
    m.triangles = f.triangle, m.n_triangles = f.triangles;
    m.edges = r->edges, m.n_edges = loose_edges(&f, r->edges);
    m.points = f.point, m.n_points = f.points;
    m.halfspaces = r->halfspaces, m.n_halfspaces = r->s.planes;
    m.body = r->body, m.kinematic = r->kinematic, m.self_contact = 1;
    r->judge = check_begin(&m, tss_world_positions(r->w));
    if (!r->judge) die(r->t->name, "out of memory");
}

// Total energy, and linear and angular momentum about the first centre of mass.
static void measure(run *r, int end, const double *center) {
    const double *x = tss_world_positions(r->w), *v = tss_world_velocities(r->w), *m = tss_world_masses(r->w);
    double T, V, *p = r->momentum[end];
    if (tss_world_energy(r->w, &T, &V) != TSS_OK) die(r->t->name, tss_world_error(r->w));
    r->energy[end] = T + V, r->mass = 0;
    for (int i = 0; i < tss_world_nodes(r->w); i++) {
        r->mass += m[i];
        for (int c = 0; c < 3; c++) {
            int a = (c + 1) % 3, b = (c + 2) % 3;
            p[c] += m[i] * v[3 * i + c];
            p[3 + c] += m[i] * ((x[3 * i + a] - center[a]) * v[3 * i + b] - (x[3 * i + b] - center[b]) * v[3 * i + a]);
        }
    }
}

static int all_finite(const tss_world *w) {
    const double *x = tss_world_positions(w), *v = tss_world_velocities(w);
    for (int k = 0; k < 3 * tss_world_nodes(w); k++)
        if (!isfinite(x[k]) || !isfinite(v[k])) return 0;
    return 1;
}

static int split_keys(char *text, const char **key, int count) {
    for (char *k = strtok(text, ";"); k; k = strtok(NULL, ";")) {
        while (*k == ' ') k++;
        if (!*k) continue;
        if (count >= MAX_KEYS) die(k, "too many keys");
        key[count++] = k;
    }
    return count;
}

static void open_run(run *r, const test *t, int mode) {
    char mode_key[64], keys[2048];
    const char *key[MAX_KEYS];
    char *made = t->scene ? NULL : stack(strcmp(t->name, "stack_20") == 0 ? 20 : 5);
    memset(r, 0, sizeof *r);
    r->t = t, r->mode = mode_of[mode], r->finite = 1, r->distance = INFINITY;
    snprintf(mode_key, sizeof mode_key, "solver.mode=\"%s\"", modes[mode]);
    snprintf(keys, sizeof keys, "%s", t->keys);
    key[0] = mode_key;
    key[1] = TOLERANCE;
    int n = 2;
    if (small_ && (t->scene == block || t->scene == press)) key[n++] = "bodies.0.shape.cells=[4, 4, 4]";
    if (small_ && t->scene == bar) key[n++] = "bodies.0.shape.cells=[16, 3, 3]";
    if (small_ && t->scene == hand) key[n++] = "bodies.0.shape.cells=12", key[n++] = "bodies.1.shape.cells=14";
    n = split_keys(keys, key, n);
    tss_host host = tss_host_default();
    host.clock = now;
    if (!scene_parse(&r->s, t->name, t->scene ? t->scene : made, out, key, n, &r->why) ||
        !scene_build(&r->s, &host, judge_iterate, r, &r->w, &r->ipc, &r->why))
        die(t->name, r->why.text);
    if (t->pose) t->pose(r);
    if (tss_world_prepare(r->w) != TSS_OK) die(t->name, tss_world_error(r->w));
    begin_judge(r);
    size_t nd = 3 * (size_t)tss_world_nodes(r->w);
    r->start = (double *)need(nd, sizeof(double));
    memcpy(r->start, tss_world_positions(r->w), nd * sizeof(double));
    free(made);
}

static void close_run(run *r) {
    tss_world_destroy(r->w);
    scene_free(&r->s);
    free(r->body), free(r->kinematic), free(r->cells), free(r->edges), free(r->halfspaces);
    free(r->start), free(r->newton);
}

static void advance(run *r) {
    double before = r->checking;
    if (!scene_drive(&r->s, r->w, &r->why)) die(r->t->name, r->why.text);
    const uint8_t *kind = tss_world_kinds(r->w);
    for (int i = 0; i < tss_world_nodes(r->w); i++) r->kinematic[i] = kind[i] != TSS_NODE_FREE;
    if (tss_world_step(r->w, &r->info) != TSS_OK) die(r->t->name, tss_world_error(r->w));
    r->seconds += r->info.seconds - (r->checking - before);
    if (worse(r->worst, r->info.status) != r->worst)
        snprintf(r->message, sizeof r->message, "step %d: %s", r->steps, r->info.message);
    r->worst = worse(r->worst, r->info.status);
    r->bad += r->info.status != TSS_STEP_CONVERGED;
    r->newton[r->steps++] = r->info.newton;
    if (r->info.linear_iterations > r->linear) r->linear = r->info.linear_iterations;
    r->distance = fmin(r->distance, r->info.min_distance);
    r->finite &= all_finite(r->w);
    // What "converged" says: the last direction, and what scripted nodes lack, are below the tolerance.
    double tol = r->s.solver.tol_rel * tss_world_diagonal(r->w);
    if (r->info.status == TSS_STEP_CONVERGED)
        r->untrue += !(r->info.decrement <= tol * (1 + 1e-9) && r->info.target_left <= tol * r->s.world.dt);
}

static int ascending(const void *a, const void *b) { return *(const int *)a - *(const int *)b; }

static double largest3(const double *a, const double *b, double *scale) {
    double s = 0;
    for (int c = 0; c < 3; c++) s += pow(a[c] - b[c], 2);
    return sqrt(s) / *scale;
}

// Takes the steps and judges them; *why: NULL or what failed.
static void take_steps(run *r, int steps, const char **why) {
    double center[3];
    int total = 0;
    mass_center(r->w, center);
    measure(r, 0, center);
    r->newton = (int *)need((size_t)steps, sizeof(int));
    while (r->steps < steps && total < LIMIT) advance(r), total += r->info.newton;
    measure(r, 1, center);
    *why = r->t->claim ? r->t->claim(r) : NULL;
    r->verdict = check_end(r->judge);
    r->judge = NULL;
    qsort(r->newton, (size_t)r->steps, sizeof(int), ascending);
    if (!r->verdict.ok) *why = "the path is not sound";
    if (!r->finite) *why = "a number is not finite";
    if (r->untrue) *why = "a step says converged above its tolerance";
}

static void print_optional(FILE *f, int defined, double value) {
    if (defined && isfinite(value)) fprintf(f, "%.4g", value);
    fputc(',', f);
}

static void write_row(FILE *f, run *r, int mode) {
    double s = sqrt(2 * r->mass * r->energy[0]), l = s * tss_world_diagonal(r->w) / 2;
    int n = r->steps;
    fprintf(f, "%s,%s,%d,%s,%g,%d,%d,%.4g,", r->t->name, modes[mode], n, tss_status_text(r->worst),
            n ? 0.5 * (r->newton[(n - 1) / 2] + r->newton[n / 2]) : 0, n ? r->newton[n - 1] : 0,
            r->linear, r->verdict.min_J);
    print_optional(f, 1, r->distance);
    fprintf(f, "%d,%d,", r->verdict.ok, r->finite);
    print_optional(f, r->t->kept == FLIES, r->energy[1] / r->energy[0] - 1);
    print_optional(f, r->t->kept != 0,
                   fmax(largest3(r->momentum[0], r->momentum[1], &s), largest3(r->momentum[0] + 3, r->momentum[1] + 3, &l)));
    fprintf(f, "%.3g\n", r->seconds);
    fflush(f);
}

// ---------------------------------------------------------------------------------------------
// >>files
// ---------------------------------------------------------------------------------------------

// Opens OUT/name for more rows; a new file gets its header.
static FILE *table(const char *name, const char *columns) {
    char path[600];
    snprintf(path, sizeof path, "%s/%s", out, name);
    FILE *f = fopen(path, "a+");
    if (!f) die(path, strerror(errno));
    fseek(f, 0, SEEK_END);
    if (ftell(f) == 0) {
        char cpu[256] = "unknown";
        FILE *info = fopen("/proc/cpuinfo", "r");
        while (info && fgets(cpu, sizeof cpu, info))
            if (strncmp(cpu, "model name", 10) == 0) break;
        if (info) fclose(info);
        char *colon = strchr(cpu, ':');
        cpu[strcspn(cpu, "\n")] = 0;
        const char *threads = getenv("OMP_NUM_THREADS");
        fprintf(f, "# bench/stability.sh%s; machine:%s; OMP_NUM_THREADS=%s\n%s\n", small_ ? " --small" : "",
                colon ? colon + 1 : " unknown", threads ? threads : "unset", columns);
        fflush(f);
    }
    return f;
}

// 1: a line of f begins so.
static int has_row(FILE *f, const char *start) {
    char line[1024];
    int found = 0;
    rewind(f);
    while (!found && fgets(line, sizeof line, f)) found = strncmp(line, start, strlen(start)) == 0;
    fseek(f, 0, SEEK_END);
    return found;
}

static void judge(const char *name, const char *why) {
    if (!why) printf("ok      stability: %s\n", name);
    else printf("FAILED  stability: %s: %s\n", name, why), failures++;
    fflush(stdout);
}

#define COLUMNS                                                                                    \
    "case,mode,steps,status,newton_median,newton_max,linear_max,min_J,min_distance,path_ok,finite," \
    "energy_drift,momentum_drift,seconds"

static void run_case(const test *t) {
    FILE *f = table("stability.csv", COLUMNS);
    const char *why = NULL;
    for (int mode = 0; mode < 3; mode++) {
        char start[128], text[400];
        snprintf(start, sizeof start, "%s,%s,", t->name, modes[mode]);
        if (!small_ && has_row(f, start)) continue;
        const char *failed = NULL;
        run r;
        open_run(&r, t, mode);
        int steps = small_ ? t->small_steps : r.s.world.steps;
        take_steps(&r, steps, &failed);
        write_row(f, &r, mode);
        if (r.bad || failed) printf("note %s %s: %d of %d steps not converged; %s%s%s\n", t->name, modes[mode], r.bad, r.steps, r.message, failed ? "; " : "", failed ? failed : "");
        if (!r.verdict.ok) printf("note %s %s: %s\n", t->name, modes[mode], check_describe(&r.verdict, text, sizeof text));
        fflush(stdout);
        if (failed) why = failed, failures += !small_;
        close_run(&r);
    }
    if (small_) judge(t->name, why);
    fclose(f);
}

// ---------------------------------------------------------------------------------------------
// >>stiffness
// Fig. 16: the frame in which a rubber hand lies on spikes of 1e6 Pa, then a few steps with spikes from
// 1e4 to 1e12 Pa: by our solver, by full Cholesky and by full conjugate gradients. `fine_stiffness` is the
// same with a threshold of 0.1 in place of the default 0.5: up to most nodes are solved for. Counts are of the
// first run, times the least of the repeats, which are interleaved.
// ---------------------------------------------------------------------------------------------

enum { SOLVERS = 3, STIFFNESSES = 9, FRAME = 14, FRAME_STEPS = 3, REPEATS = 3 };

typedef struct solve {
    int newton, linear, factorizations, enriched;
    double linear_seconds, seconds;
    tss_status status;
} solve;

static const char *const solver_name[SOLVERS] = {"adaptive", "direct", "pcg"};
static const char *const solver_keys[SOLVERS] = {
    "", "solver.mode=\"full\"; solver.linear=\"direct\"", "solver.mode=\"full\"; solver.linear=\"pcg\""};

// Without a judge: the rows E_* are those that are judged.
static void open_hand(run *r, const char *more, double E) {
    char keys[512], stiff[64];
    const char *key[MAX_KEYS];
    int n = 0;
    memset(r, 0, sizeof *r);
    snprintf(keys, sizeof keys, "%s", more);
    snprintf(stiff, sizeof stiff, "bodies.1.material.E=%g", E);
    key[n++] = TOLERANCE, key[n++] = stiff;
    if (!small_) key[n++] = "bodies.0.shape.cells=22", key[n++] = "bodies.1.shape.cells=20";
    n = split_keys(keys, key, n);
    tss_host host = tss_host_default();
    host.clock = now;
    if (!scene_parse(&r->s, "hand", hand, NULL, key, n, &r->why) ||
        !scene_build(&r->s, &host, NULL, NULL, &r->w, &r->ipc, &r->why))
        die("hand", r->why.text);
}

static void plain_step(run *r) {
    if (!scene_drive(&r->s, r->w, &r->why)) die("hand", r->why.text);
    if (tss_world_step(r->w, &r->info) != TSS_OK) die("hand", tss_world_error(r->w));
}

static void solve_from(const run *frame, double E, const char *keys, int repeat, solve *out_) {
    run r;
    solve s;
    memset(&s, 0, sizeof s);
    open_hand(&r, keys, E);
    if (tss_world_copy_state(r.w, frame->w) != TSS_OK) die("hand", tss_world_error(r.w));
    for (int k = 0; k < FRAME_STEPS; k++) {
        plain_step(&r);
        s.newton += r.info.newton, s.linear += r.info.linear_iterations;
        s.factorizations += r.info.factorizations, s.enriched = r.info.enriched_nodes;
        s.linear_seconds += r.info.phase_seconds[TSS_PHASE_LINEAR], s.seconds += r.info.seconds;
        s.status = worse(s.status, r.info.status);
    }
    if (repeat) s.linear_seconds = fmin(s.linear_seconds, out_->linear_seconds), s.seconds = fmin(s.seconds, out_->seconds);
    *out_ = s;
    tss_world_destroy(r.w);
    scene_free(&r.s);
}

static void stiffness(const char *name, const char *ours) {
    char file[64];
    snprintf(file, sizeof file, "%s.csv", name);
    FILE *f = table(file, "E,solver,newton,linear_iters,linear_seconds,total_seconds,status");
    run frame;
    double first = 0, growth = 0, slowest = 0;
    open_hand(&frame, "", 1e6);
    for (int k = 0; k < FRAME; k++) plain_step(&frame);
    if (frame.info.contacts == 0) die("stiffness", "the frame has no contact");
    for (int k = 0; k < STIFFNESSES; k++) {
        double E = pow(10, 4 + k);
        char start[64];
        solve s[SOLVERS];
        snprintf(start, sizeof start, "%g,adaptive,", E);
        if (has_row(f, start) || (small_ && k % 4)) continue;
        for (int repeat = 0; repeat < REPEATS; repeat++)
            for (int p = 0; p < SOLVERS; p++) 
                if (repeat == 0 || p != 2) solve_from(&frame, E, p ? solver_keys[p] : ours, repeat, s + p);
        for (int p = 0; p < SOLVERS; p++)
            fprintf(f, "%g,%s,%d,%d,%.4g,%.4g,%s\n", E, solver_name[p], s[p].newton, s[p].linear,
                    s[p].linear_seconds, s[p].seconds, tss_status_text(s[p].status));
        double count = (double)s[0].linear / s[0].newton, ratio = s[0].linear_seconds / s[1].linear_seconds;
        if (k == 0) first = count;
        growth = fmax(growth, count / first), slowest = fmax(slowest, ratio);
        printf("%s E %g linear_iterations_a_newton ours %.1f pcg %.1f factorizations %d enriched %d of %d time_of_cholesky %.3f newton %d %d %d\n",
               name, E, count, (double)s[2].linear / s[2].newton, s[0].factorizations, s[0].enriched,
               frame.info.nodes, ratio, s[0].newton, s[1].newton, s[2].newton);
        fflush(f), fflush(stdout);
    }
    printf("%s growth %.2f slowest %.3f of full Cholesky\n", name, growth, slowest);
    if (small_) judge(name, !(first > 0 && growth <= 5) ? "linear iterations grow more than fivefold" : NULL);
    tss_world_destroy(frame.w);
    scene_free(&frame.s);
    fclose(f);
}

// ---------------------------------------------------------------------------------------------
// >>rigid
// A cube that spins freely, against the closed form of a rigid body: x0 turned by omega t about the
// centre of mass. Softer bodies bulge and lag behind; the difference falls as 1/E until the error of
// the integrator is left, which is of second order: a quarter of it at half the step.
// The tolerance is small because what a step leaves of a velocity adds up over the steps.
// ---------------------------------------------------------------------------------------------

enum { RIGIDS = 7 };

static double from_rigid(const run *r, double angle) {
    const double *x = tss_world_positions(r->w), *x0 = r->start;
    double most = 0, c[3], ca = cos(angle), sa = sin(angle);
    mass_center(r->w, c);
    for (int i = 0; i < tss_world_nodes(r->w); i++) {
        double u = x0[3 * i] - c[0], v = x0[3 * i + 1] - c[1];
        most = fmax(most, sqrt(pow(c[0] + ca * u - sa * v - x[3 * i], 2) +
                               pow(c[1] + sa * u + ca * v - x[3 * i + 1], 2) +
                               pow(x0[3 * i + 2] - x[3 * i + 2], 2)));
    }
    return most / tss_world_diagonal(r->w);
}

// Distance from the rigid body after a turn of 2 rad, over the diagonal; < 0: the row was there before.
static double rigid_row(FILE *f, double E, int mode, double h, const char **why) {
    char keys[512], start[96];
    run r;
    test t = {"rigid", ball, keys, 0, FLIES, spin, NULL};
    snprintf(start, sizeof start, "%g,%s,%g,", E, modes[mode], h);
    if (!small_ && has_row(f, start)) return -1;
    snprintf(keys, sizeof keys, "bodies.0.material.E=%g; world.dt=%g; solver.tol_rel=1e-8", E, h);
    open_run(&r, &t, mode);
    const char *failed = NULL;
    take_steps(&r, (int)(2 / (OMEGA * h) + 0.5), &failed);
    double angle = OMEGA * tss_world_time(r.w), apart = from_rigid(&r, angle);
    fprintf(f, "%s%d,%s,%.6g,%.4g,%.3g\n", start, r.steps, tss_status_text(r.worst), angle, apart, r.seconds);
    fflush(f);
    printf("rigid E %g %s h %g apart %.3e %s\n", E, modes[mode], h, apart, tss_status_text(r.worst));
    if (failed) *why = failed;
    close_run(&r);
    return apart;
}

static void rigid(void) {
    FILE *f = table("rigid.csv", "E,mode,h,steps,status,angle,apart,seconds");
    const char *why = NULL;
    for (int mode = 0; mode < 3; mode++) {
        double last = INFINITY, first = 0;
        for (int k = 0; k < RIGIDS; k++) {
            double apart = small_ && k % 2 ? -1 : rigid_row(f, pow(10, 5 + k), mode, 5e-4, &why);
            if (apart < 0) continue;
            // A tenth: what is left of it at 1e10 Pa and above is the rounding of the steps.
            if (!(apart < 1.1 * last)) why = "a stiffer body is farther from the rigid one";
            if (k == 0) first = apart;
            last = apart;
        }
        double half = rigid_row(f, pow(10, 4 + RIGIDS), mode, 2.5e-4, &why);
        if (half >= 0 && first > 0 && !(last < 0.02 * first && half < 0.3 * last))
            why = "the stiffest body does not approach the rigid one";
    }
    if (small_) judge("rigid", why);
    else if (why) printf("note rigid: %s\n", why), failures++;
    fclose(f);
}

// ---------------------------------------------------------------------------------------------
// >>main
// ---------------------------------------------------------------------------------------------

static int chosen(const char *name, int argc, char **argv) {
    for (int k = 2; k < argc; k++)
        if (strcmp(argv[k], "all") == 0 || strncmp(argv[k], name, strlen(argv[k])) == 0) return 1;
    return 0;
}

int main(int argc, char **argv) {
    int found = 0;
    if (argc < 3) {
        fputs("usage: bench_stability OUT [--small] NAME... | all\n", stderr);
        return 2;
    }
    out = argv[1];
    for (int k = 2; k < argc; k++) small_ |= strcmp(argv[k], "--small") == 0;
    if (mkdir(out, 0777) != 0 && errno != EEXIST) die(out, strerror(errno));
    slivers(), octahedron(), ridge();
    for (size_t k = 0; k < sizeof tests / sizeof *tests; k++) {
        if (!chosen(tests[k].name, argc, argv)) continue;
        found++;
        if (!small_ || tests[k].small_steps) run_case(&tests[k]);
    }
    // The small meshes have nothing enriched at the default threshold.
    if (chosen("stiffness", argc, argv)) found++, small_ ? (void)0 : stiffness("stiffness", "");
    if (chosen("fine_stiffness", argc, argv)) found++, stiffness("fine_stiffness", "solver.error_nodes=0.1");
    if (chosen("rigid", argc, argv)) rigid(), found++;
    return found == 0 ? 2 : failures > 0;
}
