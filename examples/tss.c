/* tss: runs scenes without writing C.

   tss run SCENE [-o DIR] [--steps N] [--threads N] [--budget-ms T] [--frames png,vtu,obj]
                 [--every K] [--resume FILE] [--assets DIR] [--set key=value]... [--check]
   tss check SCENE [--assets DIR] [--set key=value]...
   tss --version | --help

   SCENE is JSON or a script of the IPC reference code; scene.h lists every key. run leaves in DIR
   (out/NAME) stats.csv: a row a step; frames/NNNN.png, vtu/ with frames.pvd, obj/: one each K steps;
   checkpoint.bin and report.html. It ends with the 64-bit hash of positions and velocities: the same
   for any number of threads. --check hands every accepted iterate to an independent judge
   (tests/checker.h). check is the doctor: it says what is wrong with a scene, and takes no step.

   EXIT  0 well; 1 the doctor found an error; 2 a file, key or option is at fault; 3 a step did not
   meet its tolerance; 4 the judge found a violation or could not decide.

   >>options  >>run  >>judge  >>frames  >>stats  >>checkpoints  >>summary  >>main              */
#define _POSIX_C_SOURCE 200809L
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_io.h"
#include "tss_shapes.h"

#define SCENE_IMPLEMENTATION
#include "scene.h"
#define VIEW_IMPLEMENTATION
#include "view.h"
#define REPORT_IMPLEMENTATION
#include "report.h"

#include "checker.h"

#include <errno.h>
#include <float.h>
#include <sys/stat.h>
#include <time.h>
#include <unistd.h>
#ifdef _OPENMP
#include <omp.h>
#endif

// ---------------------------------------------------------------------------------------------
// >>options
// ---------------------------------------------------------------------------------------------

#define MAX_SETS 256

typedef struct options {
    const char *command, *scene, *assets, *frames, *resume;
    char out[512];
    const char *set[MAX_SETS];
    int sets, steps, threads, every, check;
    double budget_ms;
} options;

static int usage(FILE *to) {
    fputs(
        "usage: tss run SCENE [-o DIR] [--steps N] [--threads N] [--budget-ms T]\n"
        "               [--frames png,vtu,obj] [--every K] [--resume FILE] [--assets DIR]\n"
        "               [--set key=value]... [--check]\n"
        "       tss check SCENE [--assets DIR] [--set key=value]...\n"
        "       tss --version\n",
        to);
    return to == stdout ? 0 : 2;
}

static int version(void) {
    printf("tss: %s, %s, %s, cJSON %s, pictures %s\n",
#if !defined(TSS_NO_OPENMP) && defined(_OPENMP)
           "OpenMP",
#else
           "serial",
#endif
#ifdef TSS_NO_SIMD
           "plain loops",
#else
           "SIMD",
#endif
#ifdef TSS_NO_METIS
           "built-in ordering",
#else
           "METIS",
#endif
           cJSON_Version(),
#ifdef VIEW_NO_PNG
           "as PPM"
#else
           "as PNG"
#endif
    );
    return 0;
}

static int whole(const char *text, int least, int *out) {
    char *end;
    long v = strtol(text, &end, 10);
    if (*text == 0 || *end || v < least || v > 1000000000) return 0;
    *out = (int)v;
    return 1;
}

static int complain(const char *what, const char *value, const char *expected) {
    fprintf(stderr, "tss: %s %s: expected %s\n", what, value, expected);
    return 0;
}

// One option and its value; 0: bad.
static int take(options *o, const char *name, const char *value) {
    static const struct {
        const char *name;
        int least;
        size_t to;
    } counts[] = {{"--steps", 0, offsetof(options, steps)},
                  {"--threads", 1, offsetof(options, threads)},
                  {"--every", 1, offsetof(options, every)}};
    if (!value) return complain(name, "", "a value");
    for (size_t k = 0; k < sizeof counts / sizeof *counts; k++)
        if (strcmp(name, counts[k].name) == 0)
            return whole(value, counts[k].least, (int *)(void *)((char *)o + counts[k].to)) ||
                   complain(name, value,
                            counts[k].least ? "a whole number >= 1" : "a whole number >= 0");
    if (strcmp(name, "-o") == 0) return snprintf(o->out, sizeof o->out, "%s", value) > 0;
    if (strcmp(name, "--assets") == 0) return o->assets = value, 1;
    if (strcmp(name, "--frames") == 0) return o->frames = value, 1;
    if (strcmp(name, "--resume") == 0) return o->resume = value, 1;
    if (strcmp(name, "--set") == 0)
        return o->sets < MAX_SETS ? (o->set[o->sets++] = value, 1)
                                  : complain(name, value, "no more than 256");
    if (strcmp(name, "--budget-ms") == 0)
        return tss_parse_double(value, strlen(value), &o->budget_ms) == TSS_OK && o->budget_ms > 0
                   ? 1
                   : complain(name, value, "milliseconds > 0");
    return complain("option", name, "one of those `tss --help` lists");
}

static int read_options(int argc, char **argv, options *o) {
    memset(o, 0, sizeof *o);
    o->steps = -1;
    o->command = argv[1];
    for (int k = 2; k < argc; k++) {
        if (strcmp(argv[k], "--check") == 0)
            o->check = 1;
        else if (argv[k][0] == '-' && argv[k][1]) {
            if (!take(o, argv[k], argv[k + 1])) return 0;
            k++;
        } else if (!o->scene)
            o->scene = argv[k];
        else
            return complain("argument", argv[k], "one scene");
    }
    return o->scene ? 1 : complain(o->command, "", "a scene");
}

// ---------------------------------------------------------------------------------------------
// >>run
// ---------------------------------------------------------------------------------------------

// What a row of stats.csv holds; `i` is the step's info, `c` what contact counted.
#define COLUMNS(X)                                                                                \
    X(step, r->step) X(time, i->time) X(status, i->status) X(newton, i->newton)                   \
    X(linear_iters, i->linear_iterations) X(enriched_nodes, i->enriched_nodes) X(nodes, i->nodes)  \
    X(active_modes, i->active_modes) X(modes, i->modes) X(contacts, i->contacts)                   \
    X(residual_max, i->residual_max) X(residual_mean, i->residual_mean) X(min_J, i->min_J)         \
    X(min_distance, i->min_distance) X(seconds, i->seconds) X(decrement, i->decrement)             \
    X(target_left, i->target_left) X(min_alpha, i->min_alpha)                                      \
    X(factorizations, i->factorizations) X(energy_s, i->phase_seconds[TSS_PHASE_ENERGY])           \
    X(gradient_s, i->phase_seconds[TSS_PHASE_GRADIENT])                                            \
    X(hessian_s, i->phase_seconds[TSS_PHASE_HESSIAN])                                              \
    X(assemble_s, i->phase_seconds[TSS_PHASE_ASSEMBLE])                                            \
    X(linear_s, i->phase_seconds[TSS_PHASE_LINEAR])                                                \
    X(collision_s, i->phase_seconds[TSS_PHASE_COLLISION])                                          \
    X(other_s, i->phase_seconds[TSS_PHASE_OTHER]) X(bytes, i->bytes)                               \
    X(allocations, i->allocations) CONTACT_COLUMNS(X)

#define CONTACT_COLUMNS(X)                                                                        \
    X(candidates, c.candidates) X(kept, c.kept) X(active, c.active) X(frictional, c.frictional)    \
    X(kappa, c.kappa) X(dhat, c.dhat)

typedef enum column {
#define COLUMN(id, value) COL_##id,
    COLUMNS(COLUMN)
#undef COLUMN
        COLUMN_COUNT
} column;

static const char *const column_names[] = {
#define COLUMN(id, value) #id,
    COLUMNS(COLUMN)
#undef COLUMN
};

typedef struct row {
    double v[COLUMN_COUNT];
} row;

typedef struct run {
    options o;
    scene s;
    scene_error why;
    tss_world *w;
    tss_ipc *ipc;
    int step, failed;  // failed: steps that did not converge
    char worst[300];   // the first of them
    row *rows;
    int row_count;
    FILE *csv;
    int png, vtu, obj, terminal;
    view *view;
    view_camera camera;
    double *x3, *field;         // positions with three coordinates; the scalar to show
    tss_mesh all, skin;         // for .vtu and .obj
    char **pictures, **states;  // files written
    double *picture_times, *state_times;
    int picture_count, state_count;
    check *judge, *lenient;  // lenient: cells whose material has no barrier
    unsigned char *kinematic;
    int *node_body;
    int *skin_first;  // triangles of each body in skin: skin_first[b] .. skin_first[b + 1]
    double *halfspaces;
    double started;
} run;

static double now(void *ctx) {
    struct timespec t;
    (void)ctx;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// Errors come back as results.
static void print_log(tss_log_level level_, const char *message, void *ctx) {
    (void)ctx;
    if (level_ == TSS_LOG_WARNING) fprintf(stderr, "tss: %s\n", message);
}

static int fail(run *r, const char *format, ...) {
    va_list args;
    va_start(args, format);
    vsnprintf(r->why.text, sizeof r->why.text, format, args);
    va_end(args);
    return 0;
}

static void *need(size_t count, size_t size) {
    void *p = calloc(count + 1, size);
    if (p) return p;
    fprintf(stderr, "tss: out of memory\n");
    exit(2);
}

static char *copy_text(const char *text) {
    char *p = (char *)need(strlen(text) + 1, 1);
    strcpy(p, text);
    return p;
}

// One more element; the array doubles when its count is a power of two.
static void *extend(void *array, int count, size_t size) {
    if (count & (count - 1)) return array;
    void *p = realloc(array, (count ? 2 * (size_t)count : 1) * size);
    if (p) return p;
    fprintf(stderr, "tss: out of memory\n");
    exit(2);
}

// Makes DIR and the folders above it.
static int make_folder(run *r, const char *path) {
    char part[600];
    snprintf(part, sizeof part, "%s", path);
    for (char *c = part + 1;; c++) {
        char keep = *c;
        if (keep != '/' && keep != 0) continue;
        *c = 0;
        if (mkdir(part, 0777) != 0 && errno != EEXIST)
            return fail(r, "%s: cannot be made: %s", part, strerror(errno));
        *c = keep;
        if (keep == 0) return 1;
    }
}

static int open_folders(run *r) {
    const char *name = strrchr(r->o.scene, '/'), *sub[] = {"frames", "vtu", "obj"};
    int on[] = {r->png, r->vtu, r->obj};
    char path[600];
    name = name ? name + 1 : r->o.scene;
    if (!r->o.out[0])
        snprintf(r->o.out, sizeof r->o.out, "out/%.*s", (int)strcspn(name, "."), name);
    if (!make_folder(r, r->o.out)) return 0;
    for (int k = 0; k < 3; k++) {
        snprintf(path, sizeof path, "%s/%s", r->o.out, sub[k]);
        if (on[k] && !make_folder(r, path)) return 0;
    }
    return 1;
}

static int read_formats(run *r) {
    for (const char *c = r->s.run.frames; *c;) {
        size_t n = strcspn(c, ",");
        if (n == 3 && strncmp(c, "png", 3) == 0)
            r->png = 1;
        else if (n == 3 && strncmp(c, "vtu", 3) == 0)
            r->vtu = 1;
        else if (n == 3 && strncmp(c, "obj", 3) == 0)
            r->obj = 1;
        else
            return fail(r, "%s: run.frames is \"%s\", expected some of png,vtu,obj", r->o.scene,
                        r->s.run.frames);
        c += n + (c[n] == ',');
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>judge
// ---------------------------------------------------------------------------------------------

static void judge_iterate(const double *x0, const double *x1, void *ctx) {
    run *r = (run *)ctx;
    if (r->judge) check_segment(r->judge, x0, x1);
    if (r->lenient) check_segment(r->lenient, x0, x1);
}

static int barrier(const scene_body *b) { return b->material.kind == TSS_NEO_HOOKEAN; }

static int pair_order(const void *a, const void *b) { return memcmp(a, b, 2 * sizeof(int)); }

// Edges of the surface that belong to no triangle. Returns how many went to out.
static int loose_edges(const tss_surface *f, int *out) {
    int n = 0, (*edge)[2] = (int(*)[2])need((size_t)f->triangles * 3, sizeof *edge);
    for (int k = 0; k < 3 * f->triangles; k++) {
        int a = f->triangle[k], b = f->triangle[k - k % 3 + (k + 1) % 3];
        edge[k][0] = a < b ? a : b, edge[k][1] = a < b ? b : a;
    }
    qsort(edge, (size_t)f->triangles * 3, sizeof *edge, pair_order);
    for (int k = 0; k < f->edges; k++) {
        int a = f->edge[2 * k], b = f->edge[2 * k + 1], key[2] = {a < b ? a : b, a < b ? b : a};
        if (bsearch(key, edge, (size_t)f->triangles * 3, sizeof *edge, pair_order)) continue;
        out[2 * n] = a, out[2 * n + 1] = b;
        n++;
    }
    free(edge);
    return n;
}

static int gather_cells(const run *r, int with_barrier, int *out) {
    int n = 0, size = r->s.world.dim + 1;
    for (int k = 0; k < r->s.bodies; k++) {
        const scene_body *b = &r->s.body[k];
        tss_body_info info;
        if (b->obstacle || barrier(b) != with_barrier || tss_body_get(r->w, b->id, &info) != TSS_OK)
            continue;
        const int *cell = tss_body_cells(r->w, b->id);
        for (int i = 0; i < size * info.cells; i++) out[n++] = cell[i];
    }
    return n / size;
}

static void mark_kinematic(run *r) {
    const uint8_t *kind = tss_world_kinds(r->w);
    for (int i = 0; r->kinematic && i < tss_world_nodes(r->w); i++)
        r->kinematic[i] = kind[i] != TSS_NODE_FREE;
}

static void judge_planes(run *r, check_mesh *m) {
    int dim = r->s.world.dim;
    r->halfspaces = (double *)need((size_t)r->s.planes * 6, sizeof(double));
    for (int k = 0; k < r->s.planes; k++)
        for (int c = 0; c < dim; c++) {
            r->halfspaces[(2 * k) * dim + c] = r->s.plane[k].origin[c];
            r->halfspaces[(2 * k + 1) * dim + c] = r->s.plane[k].normal[c];
        }
    m->halfspaces = r->halfspaces, m->n_halfspaces = r->s.planes;
}

// The judge borrows cells until it ends; the caller frees them.
static int judge_begin(run *r, int *cells[2], int *edges) {
    tss_surface f;
    check_mesh m;
    int n = tss_world_nodes(r->w);
    memset(&m, 0, sizeof m);
    if (tss_world_surface(r->w, &f) != TSS_OK)
        return fail(r, "%s: %s", r->o.scene, tss_world_error(r->w));
    m.dim = r->s.world.dim, m.nodes = n, m.rest = tss_world_rest(r->w);
    m.cells = cells[1], m.n_cells = gather_cells(r, 1, cells[1]);
    if (r->s.contact.enabled) {
        m.triangles = f.triangle, m.n_triangles = f.triangles;
        m.edges = edges, m.n_edges = loose_edges(&f, edges);
        m.points = f.point, m.n_points = f.points;
    }
    m.body = r->node_body, m.kinematic = r->kinematic, m.self_contact = r->s.contact.self;
    if (r->s.contact.enabled) judge_planes(r, &m);
    r->judge = check_begin(&m, tss_world_positions(r->w));
    m.cells = cells[0], m.n_cells = gather_cells(r, 0, cells[0]);
    m.n_triangles = m.n_edges = m.n_points = m.n_halfspaces = 0;
    if (m.n_cells > 0) r->lenient = check_begin(&m, tss_world_positions(r->w));
    return r->judge ? 1 : fail(r, "out of memory");
}

// Prints the verdict; 1 if there is no violation.
static int judge_end(run *r) {
    char text[400];
    check_report a = check_end(r->judge), b = check__report_empty();
    if (r->lenient) b = check_end(r->lenient);
    r->judge = r->lenient = NULL;
    long bad = a.intersections + a.collisions + a.halfspaces + a.breaks + a.range;
    printf("checked %ld segments: %ld intersections, %ld undecided, %ld inversions, min J %.4g\n",
           a.segments, bad, a.undecided, a.inversions, fmin(a.min_J, b.min_J));
    if (!a.ok) printf("  first: %s\n", check_describe(&a, text, sizeof text));
    if (b.inversions + b.undecided > 0)
        printf("  %ld inversions and %ld undecided in materials that allow them\n", b.inversions,
               b.undecided);
    return a.ok;
}

// ---------------------------------------------------------------------------------------------
// >>frames
// ---------------------------------------------------------------------------------------------

static const float body_colors[][3] = {
    {0.91f, 0.52f, 0.32f}, {0.33f, 0.62f, 0.78f}, {0.55f, 0.72f, 0.40f}, {0.86f, 0.70f, 0.34f},
    {0.66f, 0.50f, 0.74f}, {0.84f, 0.45f, 0.55f}, {0.40f, 0.70f, 0.66f}, {0.72f, 0.60f, 0.48f}};
static const float obstacle_color[3] = {0.56f, 0.58f, 0.62f};

static void positions3(run *r) {
    const double *x = tss_world_positions(r->w);
    int dim = r->s.world.dim;
    for (int i = 0; i < tss_world_nodes(r->w); i++)
        for (int c = 0; c < 3; c++) r->x3[3 * i + c] = c < dim ? x[dim * i + c] : 0;
}

// Columns are edges from the cell's first node.
static double edges_of(const double *x, const int *cell, int dim, double *D) {
    for (int c = 0; c < 3; c++)
        for (int k = 0; k < 3; k++)
            D[3 * c + k] =
                c < dim && k < dim ? x[dim * cell[k + 1] + c] - x[dim * cell[0] + c] : c == k;
    return D[0] * (D[4] * D[8] - D[5] * D[7]) - D[1] * (D[3] * D[8] - D[5] * D[6]) +
           D[2] * (D[3] * D[7] - D[4] * D[6]);
}

// sqrt(2/3 dev E : dev E), E = (FᵀF − I)/2: the equivalent strain.
static double equivalent_strain(const double *X, const double *x, const int *cell, int dim) {
    double R[9], D[9], inv[9], F[9], E[9], trace = 0, sum = 0, det = edges_of(X, cell, dim, R);
    (void)edges_of(x, cell, dim, D);
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) {
            int a = (j + 1) % 3, b = (j + 2) % 3, c = (i + 1) % 3, d = (i + 2) % 3;
            inv[3 * i + j] = (R[3 * a + c] * R[3 * b + d] - R[3 * a + d] * R[3 * b + c]) / det;
        }
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            F[3 * i + j] =
                D[3 * i] * inv[j] + D[3 * i + 1] * inv[3 + j] + D[3 * i + 2] * inv[6 + j];
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++)
            E[3 * i + j] =
                0.5 * (F[i] * F[j] + F[3 + i] * F[3 + j] + F[6 + i] * F[6 + j] - (i == j));
    trace = (E[0] + E[4] + E[8]) / 3;
    for (int i = 0; i < 9; i++)
        sum += (E[i] - (i % 4 == 0 ? trace : 0)) * (E[i] - (i % 4 == 0 ? trace : 0));
    return sqrt(2.0 / 3 * sum);
}

static double cell_field(const run *r, const int *cell) {
    const double *X = tss_world_rest(r->w), *x = tss_world_positions(r->w);
    double D[9];
    int dim = r->s.world.dim;
    if (r->s.frames.field == SCENE_FIELD_STRAIN) return equivalent_strain(X, x, cell, dim);
    return edges_of(x, cell, dim, D) / edges_of(X, cell, dim, D);
}

// Cell values go to their nodes, weighted by rest volume; nodes of obstacles are not a number.
static void fill_field(run *r) {
    int n = tss_world_nodes(r->w), dim = r->s.world.dim;
    const double *v = tss_world_velocities(r->w);
    double *weight = (double *)need((size_t)n, sizeof *weight), D[9];
    for (int i = 0; i < n; i++) {
        double s = 0;
        for (int c = 0; c < dim; c++) s += v[dim * i + c] * v[dim * i + c];
        r->field[i] = r->s.frames.field == SCENE_FIELD_VELOCITY ? sqrt(s) : 0;
    }
    for (int b = 0; b < r->s.bodies && r->s.frames.field != SCENE_FIELD_VELOCITY; b++) {
        tss_body_info info;
        if (r->s.body[b].obstacle || tss_body_get(r->w, r->s.body[b].id, &info) != TSS_OK) continue;
        const int *cell = tss_body_cells(r->w, r->s.body[b].id);
        for (int k = 0; k < info.cells; k++, cell += dim + 1) {
            double value = cell_field(r, cell),
                   vol = fabs(edges_of(tss_world_rest(r->w), cell, dim, D));
            for (int i = 0; i <= dim; i++) r->field[cell[i]] += vol * value, weight[cell[i]] += vol;
        }
    }
    for (int i = 0; i < n && r->s.frames.field != SCENE_FIELD_VELOCITY; i++)
        r->field[i] /= weight[i];
    free(weight);
}

static void field_range(const run *r, double *lo, double *hi) {
    *lo = r->s.frames.field == SCENE_FIELD_J ? 0.5 : 0;
    *hi = r->s.frames.field == SCENE_FIELD_J        ? 1.5
          : r->s.frames.field == SCENE_FIELD_STRAIN ? 0.5
                                                    : 1;
    if (r->s.frames.has_range) *lo = r->s.frames.range[0], *hi = r->s.frames.range[1];
}

static view_style body_style(const run *r, int b) {
    const scene_body *body = &r->s.body[b];
    view_style style = view_style_default();
    const float *c = body->color[0] >= 0 ? body->color
                     : body->obstacle    ? obstacle_color
                                         : body_colors[b % 8];
    memcpy(style.colour, c, sizeof style.colour);
    style.wire = (float)r->s.frames.wireframe;
    style.crease = body->obstacle ? 30 : 50;
    if (r->s.frames.field != SCENE_FIELD_NONE && !body->obstacle) {
        style.scalar = r->field + body->first;
        style.map = r->s.frames.field == SCENE_FIELD_J ? VIEW_MAP_BALANCE : VIEW_MAP_SEA;
        field_range(r, &style.lo, &style.hi);
    }
    return style;
}

static void draw_body(run *r, int b) {
    const scene_body *body = &r->s.body[b];
    const tss_mesh *m = &body->mesh;
    const double *x = r->x3 + 3 * (size_t)body->first;
    view_style style = body_style(r, b);
    int first = r->skin_first[b], *local;
    int n = r->s.world.dim == 2 ? m->triangles : r->skin_first[b + 1] - first;
    local = (int *)need(3 * (size_t)n, sizeof *local);
    for (int k = 0; k < 3 * n; k++)
        local[k] =
            r->s.world.dim == 2 ? m->triangle[k] : r->skin.triangle[3 * first + k] - body->first;
    view_add_mesh(r->view, x, m->nodes, local, n, &style);
    if (body->obstacle) view_add_segments(r->view, x, m->nodes, m->edge, m->edges, 0, &style);
    if (body->obstacle) view_add_points(r->view, x, m->nodes, m->point, m->points, 0, &style);
    free(local);
}

static int level(const scene_plane *p) { return p->normal[1] > 0.9999; }

// A half-space that is not the ground is a large square (2D: a line) in its plane.
static void draw_plane(run *r, const scene_plane *p, const double *lo, const double *hi) {
    static const int square[6] = {0, 1, 2, 0, 2, 3}, line[2] = {0, 1};
    double size = 0, mid[3], u[3], t[3], x[12], along = 0;
    const double *n = p->normal;
    view_style style = view_style_default();
    memcpy(style.colour, obstacle_color, sizeof style.colour);
    for (int c = 0; c < 3; c++) mid[c] = 0.5 * (lo[c] + hi[c]), size = fmax(size, hi[c] - lo[c]);
    // The middle of the scene, on the plane; u and t span it.
    for (int c = 0; c < 3; c++) along += (mid[c] - p->origin[c]) * n[c];
    double flat[3] = {fabs(n[2]) > 0.9, 0, fabs(n[2]) <= 0.9};
    for (int c = 0; c < 3; c++) {
        int a = (c + 1) % 3, b = (c + 2) % 3;
        u[c] = n[a] * flat[b] - n[b] * flat[a];
    }
    (void)scene__unit(u);
    for (int c = 0; c < 3; c++)
        t[c] = n[(c + 1) % 3] * u[(c + 2) % 3] - n[(c + 2) % 3] * u[(c + 1) % 3];
    for (int k = 0; k < 4; k++)
        for (int c = 0; c < 3; c++)
            x[3 * k + c] = mid[c] - along * n[c] +
                           size * ((k == 0 || k == 3 ? -1 : 1) * u[c] + (k < 2 ? -1 : 1) * t[c]);
    if (r->s.world.dim == 2) {
        for (int c = 0; c < 3; c++)
            x[c] = mid[c] - along * n[c] - 2 * size * u[c],
            x[3 + c] = mid[c] - along * n[c] + 2 * size * u[c];
        view_add_segments(r->view, x, 2, line, 1, 0, &style);
    } else {
        view_add_mesh(r->view, x, 4, square, 2, &style);
    }
}

// The box the camera sees: soft bodies, and obstacles and ground as far as they are near them.
static void scene_box(const run *r, double *lo, double *hi) {
    double size = 0, at_lo[3] = {INFINITY, INFINITY, INFINITY},
           at_hi[3] = {-INFINITY, -INFINITY, -INFINITY};
    for (int c = 0; c < 3; c++) lo[c] = INFINITY, hi[c] = -INFINITY;
    for (int b = 0; b < r->s.bodies; b++)
        if (!r->s.body[b].obstacle)
            view_box_add(lo, hi, r->x3 + 3 * (size_t)r->s.body[b].first, r->s.body[b].mesh.nodes);
        else
            view_box_add(at_lo, at_hi, r->x3 + 3 * (size_t)r->s.body[b].first,
                         r->s.body[b].mesh.nodes);
    for (int c = 0; c < 3; c++) size = fmax(size, hi[c] - lo[c]);
    for (int c = 0; c < 3; c++) {
        double a = lo[c], b = hi[c];
        if (at_lo[c] < a) lo[c] = fmax(at_lo[c], a - 0.6 * size);
        if (at_hi[c] > b) hi[c] = fmin(at_hi[c], b + 0.6 * size);
    }
    for (int k = 0; k < r->s.planes; k++)
        if (level(&r->s.plane[k]))
            lo[1] = fmax(fmin(lo[1], r->s.plane[k].origin[1]), lo[1] - 2 * size);
}

static void place_camera(run *r) {
    double lo[3], hi[3], mid, d[3], l = 0;
    scene_box(r, lo, hi);
    for (int c = 0; c < 3; c++) {
        mid = r->s.camera.has_target ? r->s.camera.target[c] : 0.5 * (lo[c] + hi[c]);
        double half = 0.5 * (hi[c] - lo[c]) / r->s.camera.zoom;
        lo[c] = mid - half, hi[c] = mid + half;
    }
    if (r->s.world.dim == 2) {
        r->camera = view_camera_fit_2d(lo, hi, r->s.frames.width, r->s.frames.height);
        return;
    }
    r->camera = view_camera_fit(lo, hi, r->s.camera.azimuth, r->s.camera.elevation, r->s.camera.fov,
                                VIEW_UP_Y, r->s.frames.width, r->s.frames.height);
    for (int c = 0; c < 3; c++) d[c] = r->camera.eye[c] - r->camera.at[c], l += d[c] * d[c];
    for (int c = 0; c < 3 && r->s.camera.distance > 0; c++)
        r->camera.eye[c] = r->camera.at[c] + d[c] * r->s.camera.distance / sqrt(l);
}

static view_look scene_look(const run *r) {
    view_look look = r->s.world.dim == 2 ? view_look_2d() : view_look_default();
    look.ground = r->s.world.dim == 2 ? look.ground : 0;
    for (int k = r->s.planes - 1; k >= 0 && r->s.world.dim == 3; k--)
        if (level(&r->s.plane[k])) look.ground = 1, look.ground_height = r->s.plane[k].origin[1];
    return look;
}

static void remember(char ***files, double **times, int *count, const char *path, double time) {
    *files = (char **)extend(*files, *count, sizeof **files);
    *times = (double *)extend(*times, *count, sizeof **times);
    (*files)[*count] = copy_text(path);
    (*times)[(*count)++] = time;
}

static int draw_frame(run *r) {
    double lo[3], hi[3], low, high;
    char path[700], line[100];
    view_error why;
    view_look look = scene_look(r);
    const char *name = strrchr(r->o.scene, '/');
    scene_box(r, lo, hi);
    view_begin(r->view, &r->camera, &look);
    for (int b = 0; b < r->s.bodies; b++) draw_body(r, b);
    for (int k = 0; k < r->s.planes; k++)
        if (r->s.world.dim == 2 || !level(&r->s.plane[k])) draw_plane(r, &r->s.plane[k], lo, hi);
    view_image im = view_render(r->view);
    if (!im.rgb) return fail(r, "out of memory for a picture");
    snprintf(line, sizeof line, "step %d   t = %.3f s", r->step, tss_world_time(r->w));
    view_label(&im, name ? name + 1 : r->o.scene, line);
    field_range(r, &low, &high);
    if (r->s.frames.field != SCENE_FIELD_NONE)
        view_colour_bar(&im, r->s.frames.field == SCENE_FIELD_J ? VIEW_MAP_BALANCE : VIEW_MAP_SEA,
                        low, high, scene__fields[r->s.frames.field]);
    snprintf(path, sizeof path, "%s/frames/%04d.png", r->o.out, r->step);
    if (!view_write_png(path, &im, &why)) return fail(r, "%s", why.message);
    remember(&r->pictures, &r->picture_times, &r->picture_count, path, tss_world_time(r->w));
    return 1;
}

// One mesh of everything for .vtu, its surface for .obj and for pictures.
static int build_meshes(run *r) {
    int dim = r->s.world.dim, n = tss_world_nodes(r->w), tets = 0, tris = 0, edges = 0, points = 0;
    for (int b = 0; b < r->s.bodies; b++) {
        const tss_mesh *m = &r->s.body[b].mesh;
        int soft = !r->s.body[b].obstacle;
        tets += soft && dim == 3 ? m->tets : 0;
        tris += soft && dim == 3 ? 0 : m->triangles;
        edges += soft ? 0 : m->edges, points += soft ? 0 : m->points;
    }
    if (tss_mesh_alloc(NULL, dim, n, tets, tris, edges, points, &r->all) != TSS_OK)
        return fail(r, "out of memory");
    tets = tris = edges = points = 0;
    for (int b = 0; b < r->s.bodies; b++) {
        const tss_mesh *m = &r->s.body[b].mesh;
        int soft = !r->s.body[b].obstacle, first = r->s.body[b].first;
        for (int k = 0; soft && dim == 3 && k < 4 * m->tets; k++)
            r->all.tet[4 * tets + k] = first + m->tet[k];
        for (int k = 0; !(soft && dim == 3) && k < 3 * m->triangles; k++)
            r->all.triangle[3 * tris + k] = first + m->triangle[k];
        for (int k = 0; !soft && k < 2 * m->edges; k++)
            r->all.edge[2 * edges + k] = first + m->edge[k];
        for (int k = 0; !soft && k < m->points; k++) r->all.point[points + k] = first + m->point[k];
        for (int k = 0; soft && dim == 3 && k < m->tets; k++) r->all.tet_region[tets + k] = b;
        for (int k = 0; !(soft && dim == 3) && k < m->triangles; k++)
            r->all.triangle_region[tris + k] = b;
        tets += soft && dim == 3 ? m->tets : 0;
        tris += soft && dim == 3 ? 0 : m->triangles;
        edges += soft ? 0 : m->edges, points += soft ? 0 : m->points;
    }
    return 1;
}

// Surface triangles, sorted by body.
static int build_skin(run *r) {
    tss_surface f;
    if (tss_world_surface(r->w, &f) != TSS_OK)
        return fail(r, "%s: %s", r->o.scene, tss_world_error(r->w));
    int flat = r->s.world.dim == 2, tris = flat ? r->all.triangles : f.triangles,
        n = tss_world_nodes(r->w);
    if (tss_mesh_alloc(NULL, r->s.world.dim, n, 0, tris, flat ? f.edges : r->all.edges,
                       r->all.points, &r->skin) != TSS_OK)
        return fail(r, "out of memory");
    r->skin_first = (int *)need((size_t)r->s.bodies + 1, sizeof(int));
    int at = 0;
    for (int b = 0; b < r->s.bodies; b++) {
        int lo = r->s.body[b].first, hi = lo + r->s.body[b].mesh.nodes;
        r->skin_first[b] = at;
        for (int k = 0; k < f.triangles; k++)
            if (f.triangle[3 * k] >= lo && f.triangle[3 * k] < hi)
                memcpy(r->skin.triangle + 3 * at++, f.triangle + 3 * k, 3 * sizeof(int));
    }
    r->skin_first[r->s.bodies] = at;
    if (flat) memcpy(r->skin.triangle, r->all.triangle, 3 * (size_t)tris * sizeof(int));
    if (flat)
        memcpy(r->skin.edge, f.edge, 2 * (size_t)f.edges * sizeof(int));
    else if (r->all.edges)
        memcpy(r->skin.edge, r->all.edge, 2 * (size_t)r->all.edges * sizeof(int));
    if (r->all.points) memcpy(r->skin.point, r->all.point, (size_t)r->all.points * sizeof(int));
    return 1;
}

static int write_state(run *r) {
    char path[700];
    tss_io_error why;
    int field = r->s.frames.field != SCENE_FIELD_NONE;
    tss_field fields[2] = {{"velocity", tss_world_velocities(r->w), r->s.world.dim, 0},
                           {scene__fields[r->s.frames.field], r->field, 1, 0}};
    snprintf(path, sizeof path, "%s/vtu/%04d.vtu", r->o.out, r->step);
    if (r->vtu && tss_mesh_write_vtu(&r->all, r->x3, path, fields, 1 + field, 0, &why) != TSS_OK)
        return fail(r, "%s: %s", why.file, why.message);
    // Names in the .pvd are relative to it.
    if (r->vtu)
        remember(&r->states, &r->state_times, &r->state_count, path + strlen(r->o.out) + 1,
                 tss_world_time(r->w));
    snprintf(path, sizeof path, "%s/obj/%04d.obj", r->o.out, r->step);
    if (r->obj && tss_mesh_write_obj(&r->skin, r->x3, path, &why) != TSS_OK)
        return fail(r, "%s: %s", why.file, why.message);
    snprintf(path, sizeof path, "%s/frames.pvd", r->o.out);
    if (r->vtu && tss_write_pvd(NULL, path, (const char *const *)r->states, r->state_times,
                                r->state_count, &why) != TSS_OK)
        return fail(r, "%s: %s", why.file, why.message);
    return 1;
}

static int write_frame(run *r) {
    if (!r->png && !r->vtu && !r->obj) return 1;
    positions3(r);
    if (r->s.frames.field != SCENE_FIELD_NONE) fill_field(r);
    return (!r->png || draw_frame(r)) && write_state(r);
}

static int open_frames(run *r) {
    size_t n = (size_t)tss_world_nodes(r->w);
    r->x3 = (double *)need(3 * n, sizeof(double));
    r->field = (double *)need(n, sizeof(double));
    if (!build_meshes(r) || !build_skin(r)) return 0;
    positions3(r);
    place_camera(r);
    if (r->png) r->view = view_create(r->s.frames.width, r->s.frames.height);
    return !r->png || r->view ? 1 : fail(r, "out of memory for pictures");
}

// ---------------------------------------------------------------------------------------------
// >>stats
// ---------------------------------------------------------------------------------------------

static void write_header(FILE *f) {
    for (int k = 0; k < COLUMN_COUNT; k++) fprintf(f, "%s%s", k ? "," : "", column_names[k]);
    fputc('\n', f);
}

static void write_row(FILE *f, const row *w) {
    for (int k = 0; k < COLUMN_COUNT; k++) {
        if (k) fputc(',', f);
        if (k == COL_status)
            fputs(tss_status_text((tss_status)(int)w->v[k]), f);
        else
            fprintf(f, "%.10g", w->v[k]);
    }
    fputc('\n', f);
    fflush(f);
}

// A line of an earlier run's stats.csv; 0 if it is none.
static int parse_row(char *line, row *w) {
    for (int k = 0; k < COLUMN_COUNT; k++) {
        char *end = line;
        if (k == COL_status) {
            end += strcspn(line, ",\n");
            w->v[k] = 0;
            for (int s = 0; s < TSS_STATUS_COUNT; s++) {
                const char *text = tss_status_text((tss_status)s);
                if (strlen(text) == (size_t)(end - line) &&
                    strncmp(text, line, (size_t)(end - line)) == 0)
                    w->v[k] = s;
            }
        } else {
            w->v[k] = strtod(line, &end);
        }
        if (end == line || *end != (k + 1 < COLUMN_COUNT ? ',' : '\n')) return 0;
        line = end + 1;
    }
    return 1;
}

static void keep_row(run *r, const row *w) {
    r->rows = (row *)extend(r->rows, r->row_count, sizeof *r->rows);
    r->rows[r->row_count++] = *w;
}

// A resumed run keeps the rows up to where it starts.
static int open_stats(run *r) {
    char path[700], line[4096];
    row w;
    snprintf(path, sizeof path, "%s/stats.csv", r->o.out);
    FILE *old = r->o.resume ? fopen(path, "r") : NULL;
    while (old && fgets(line, sizeof line, old))
        if (parse_row(line, &w) && w.v[COL_step] <= r->step) keep_row(r, &w);
    if (old) fclose(old);
    r->csv = fopen(path, "w");
    if (!r->csv) return fail(r, "%s: cannot be written: %s", path, strerror(errno));
    write_header(r->csv);
    for (int k = 0; k < r->row_count; k++) write_row(r->csv, &r->rows[k]);
    return 1;
}

static void print_bar(const run *r, const tss_step_info *i) {
    char bar[33];
    int steps = r->s.world.steps, done = steps > 0 ? 32 * r->step / steps : 32;
    double spent = now(NULL) - r->started,
           left = r->step > 0 ? spent * (steps - r->step) / r->step : 0;
    for (int k = 0; k < 32; k++) bar[k] = k < done ? '#' : '.';
    bar[32] = 0;
    printf("\r[%s] %d/%d  t %.3f s  newton %d  contacts %d  %.2f s/step  %.0f s left   ", bar,
           r->step, steps, i->time, i->newton, i->contacts, i->seconds, left);
    if (r->step == steps) printf("\n");
    fflush(stdout);
}

static void record(run *r, const tss_step_info *i) {
    row w;
    tss_ipc_info c;
    memset(&c, 0, sizeof c);
    if (r->ipc) tss_ipc_get_info(r->ipc, &c);
#define COLUMN(id, value) w.v[COL_##id] = (double)(value);
    COLUMNS(COLUMN)
#undef COLUMN
    keep_row(r, &w);
    write_row(r->csv, &w);
    if (i->status != TSS_STEP_CONVERGED && r->failed++ == 0)
        snprintf(r->worst, sizeof r->worst, "step %d (%s): %s", r->step, tss_status_text(i->status),
                 i->message);
    if (r->terminal) {
        print_bar(r, i);
        return;
    }
    printf(
        "step %d t %.4f %s newton %d contacts %d residual %.3g min_J %.3g distance %.3g %.3f s\n",
        r->step, i->time, tss_status_text(i->status), i->newton, i->contacts, i->residual_max,
        i->min_J, i->min_distance, i->seconds);
}

// ---------------------------------------------------------------------------------------------
// >>checkpoints
// A header, the scene's state, the world's; written beside its place and renamed.
// ---------------------------------------------------------------------------------------------

typedef struct checkpoint {
    char magic[8];
    uint64_t step, scene_bytes, world_bytes;
} checkpoint;

static const char checkpoint_magic[8] = {'t', 's', 's', ' ', 'r', 'u', 'n', '1'};

static int write_checkpoint(run *r) {
    char path[700], part[720];
    checkpoint c;
    memcpy(c.magic, checkpoint_magic, sizeof c.magic);
    c.step = (uint64_t)r->step, c.scene_bytes = scene_state(&r->s, NULL, 0, 1);
    c.world_bytes = tss_world_save(r->w, NULL, 0);
    char *data = (char *)need(c.scene_bytes + c.world_bytes, 1);
    size_t total = c.scene_bytes + c.world_bytes;
    snprintf(path, sizeof path, "%s/checkpoint.bin", r->o.out);
    snprintf(part, sizeof part, "%s.part", path);
    int ok = scene_state(&r->s, data, c.scene_bytes, 1) > 0 &&
             tss_world_save(r->w, data + c.scene_bytes, c.world_bytes) > 0;
    FILE *f = ok ? fopen(part, "wb") : NULL;
    ok = f && fwrite(&c, sizeof c, 1, f) == 1 && fwrite(data, 1, total, f) == total;
    if (f) ok = fclose(f) == 0 && ok;
    free(data);
    if (!ok || rename(part, path) != 0)
        return fail(r, "%s: cannot be written: %s", path, strerror(errno));
    return 1;
}

static int read_checkpoint(run *r) {
    checkpoint c;
    FILE *f = fopen(r->o.resume, "rb");
    if (!f) return fail(r, "%s: cannot be read: %s", r->o.resume, strerror(errno));
    int ok = fread(&c, sizeof c, 1, f) == 1 &&
             memcmp(c.magic, checkpoint_magic, sizeof c.magic) == 0 &&
             c.scene_bytes == scene_state(&r->s, NULL, 0, 0) && c.world_bytes < ((uint64_t)1 << 40);
    char *data = ok ? (char *)need(c.scene_bytes + c.world_bytes, 1) : NULL;
    ok = ok && fread(data, 1, c.scene_bytes + c.world_bytes, f) == c.scene_bytes + c.world_bytes;
    fclose(f);
    ok = ok && scene_state(&r->s, data, c.scene_bytes, 0) > 0;
    tss_result e =
        ok ? tss_world_load(r->w, data + c.scene_bytes, c.world_bytes) : TSS_ERROR_MISMATCH;
    free(data);
    if (e != TSS_OK)
        return fail(r, "%s: %s (expected a checkpoint of this scene)", r->o.resume,
                    tss_result_text(e));
    r->step = (int)c.step;
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>summary
// ---------------------------------------------------------------------------------------------

static void totals(const run *r, column k, double *mean, double *max) {
    *mean = *max = 0;
    for (int i = 0; i < r->row_count; i++) {
        *mean += r->rows[i].v[k] / r->row_count;
        *max = fmax(*max, r->rows[i].v[k]);
    }
}

static double smallest(const run *r, column k) {
    double v = INFINITY;
    for (int i = 0; i < r->row_count; i++) v = fmin(v, r->rows[i].v[k]);
    return v;
}

static void print_summary(const run *r) {
    double s, s_max, n, n_max, res, res_max;
    totals(r, COL_seconds, &s, &s_max);
    totals(r, COL_newton, &n, &n_max);
    totals(r, COL_residual_max, &res, &res_max);
    printf(
        "%d steps, %d converged; %.3f s a step (worst %.3f); %.1f Newton iterates a step (worst "
        "%.0f)\n",
        r->row_count, r->row_count - r->failed, s, s_max, n, n_max);
    printf("worst residual %.3g m/s, least J %.4g, least distance %.3g m\n", res_max,
           smallest(r, COL_min_J), smallest(r, COL_min_distance));
    if (r->failed) printf("not converged: %s\n", r->worst);
    printf("state %016llx\n", (unsigned long long)tss_world_hash(r->w));
}

static double *column_of(const run *r, column k) {
    double *v = (double *)need((size_t)r->row_count, sizeof *v);
    for (int i = 0; i < r->row_count; i++) v[i] = r->rows[i].v[k];
    return v;
}

// One plot over time; nothing is drawn for the end of the list (-1).
static void plot(report *p, const run *r, report_plot look, const column *which, int count) {
    report_series series[8];
    double *x = column_of(r, COL_time), *y[8];
    for (int k = 0; k < count; k++) {
        y[k] = column_of(r, which[k]);
        series[k].name = column_names[which[k]];
        series[k].x = x, series[k].y = y[k], series[k].count = r->row_count;
    }
    report_add_plot(p, &look, series, count);
    for (int k = 0; k < count; k++) free(y[k]);
    free(x);
}

static void report_plots(report *p, const run *r) {
    static const column work[] = {COL_newton}, touch[] = {COL_contacts},
                        error[] = {COL_residual_max, COL_residual_mean}, gap[] = {COL_min_distance},
                        J[] = {COL_min_J},
                        phase[] = {COL_energy_s, COL_gradient_s,  COL_hessian_s, COL_assemble_s,
                                   COL_linear_s, COL_collision_s, COL_other_s};
    report_plot a = report_plot_default("Newton iterates", "time, s", "iterates a step");
    a.zero = 1;
    plot(p, r, a, work, 1);
    a = report_plot_default("Contacts", "time, s", "active pairs");
    a.zero = 1;
    plot(p, r, a, touch, 1);
    a = report_plot_default("Where the time goes", "time, s", "seconds a step");
    a.stacked = 1;
    plot(p, r, a, phase, 7);
    a = report_plot_default("Residual", "time, s", "m/s");
    a.log_y = 1;
    plot(p, r, a, error, 2);
    a = report_plot_default("Least distance between surfaces", "time, s", "m");
    a.log_y = 1;
    plot(p, r, a, gap, 1);
    plot(p, r, report_plot_default("Least J (volume over rest volume)", "time, s", "J"), J, 1);
}

static void report_scene(report *p, const run *r) {
    static const char *const names[] = {"bodies",  "nodes",      "cells",   "surface triangles",
                                        "step, s", "integrator", "threads", "state"};
    char text[8][60];
    const char *values[8];
    int obstacles = 0;
    for (int b = 0; b < r->s.bodies; b++) obstacles += r->s.body[b].obstacle;
    snprintf(text[0], 60, "%d soft, %d obstacles, %d planes", r->s.bodies - obstacles, obstacles,
             r->s.planes);
    snprintf(text[1], 60, "%d", tss_world_nodes(r->w));
    snprintf(text[2], 60, "%d", r->s.world.dim == 3 ? r->all.tets : r->all.triangles);
    snprintf(text[3], 60, "%d", r->skin.triangles);
    snprintf(text[4], 60, "%g", r->s.world.dt);
    snprintf(text[5], 60, "%s", scene__integrators[r->s.world.integrator]);
    snprintf(text[6], 60, "%d", r->o.threads);
    snprintf(text[7], 60, "%016llx", (unsigned long long)tss_world_hash(r->w));
    for (int k = 0; k < 8; k++) values[k] = text[k];
    report_table(p, "Scene", names, values, 8);
}

static int write_report(run *r, int judged, int sound) {
    double s, s_max, n, n_max;
    char text[120];
    report_error why;
    const char *name = strrchr(r->o.scene, '/');
    report *p = report_begin(name ? name + 1 : r->o.scene, NULL);
    totals(r, COL_seconds, &s, &s_max);
    totals(r, COL_newton, &n, &n_max);
    snprintf(text, sizeof text, "%d of %d steps", r->row_count - r->failed, r->row_count);
    report_status(p, "Converged", text, r->failed ? REPORT_WARN : REPORT_GOOD);
    snprintf(text, sizeof text, "%.3f s, worst %.3f s", s, s_max);
    report_status(p, "A step takes", text, REPORT_INFO);
    snprintf(text, sizeof text, "%.1f, worst %.0f", n, n_max);
    report_status(p, "Newton iterates a step", text, REPORT_INFO);
    if (judged)
        report_status(p, "Independent judge", sound ? "no violation" : "violations",
                      sound ? REPORT_GOOD : REPORT_BAD);
    report_frames(p, (const char *const *)r->pictures, NULL, r->picture_count, 8);
    if (r->row_count > 0) report_plots(p, r);
    report_scene(p, r);
    return report_end(p, r->o.out, &why) ? 1 : fail(r, "%s", why.message);
}

// ---------------------------------------------------------------------------------------------
// >>main
// ---------------------------------------------------------------------------------------------

// What the command line says outweighs the scene.
static int read_scene(run *r) {
    if (!scene_read(&r->s, r->o.scene, r->o.assets, r->o.set, r->o.sets, &r->why)) return 0;
    if (r->s.warnings) fputs(r->s.warnings, stderr);
    if (r->o.steps >= 0) r->s.world.steps = r->o.steps;
    if (r->o.every > 0) r->s.run.every = r->o.every;
    if (r->o.budget_ms > 0) r->s.run.budget_ms = r->o.budget_ms;
    if (r->o.check) r->s.run.check = 1;
    if (r->o.frames && strlen(r->o.frames) >= sizeof r->s.run.frames)
        return fail(r, "--frames %s: expected some of png,vtu,obj", r->o.frames);
    if (r->o.frames) snprintf(r->s.run.frames, sizeof r->s.run.frames, "%s", r->o.frames);
    return read_formats(r);
}

static int build_world(run *r) {
    tss_host host = tss_host_default();
    host.clock = now, host.log = print_log, host.workers = r->o.threads;
#ifdef _OPENMP
    if (r->o.threads > 0)
        omp_set_num_threads(r->o.threads);  // pictures and the judge use OpenMP themselves
#endif
    if (!scene_build(&r->s, &host, judge_iterate, r, &r->w, &r->ipc, &r->why)) return 0;
    r->o.threads = tss_workers(&host);
    return 1;
}

static int take_step(run *r, tss_step_info *info) {
    if (!scene_drive(&r->s, r->w, &r->why)) return 0;
    mark_kinematic(r);
    tss_result e = r->s.run.budget_ms > 0
                       ? tss_world_step_for(r->w, 1e-3 * r->s.run.budget_ms, info)
                       : tss_world_step(r->w, info);
    return e == TSS_OK
               ? 1
               : fail(r, "%s: step %d: %s", r->o.scene, r->step + 1,
                      tss_world_error(r->w)[0] ? tss_world_error(r->w) : tss_result_text(e));
}

static int take_steps(run *r) {
    tss_step_info info;
    if (!r->o.resume && !write_frame(r)) return 0;
    while (r->step < r->s.world.steps) {
        if (!take_step(r, &info)) return 0;
        r->step++;
        record(r, &info);
        if (r->step % r->s.run.every != 0 && r->step != r->s.world.steps) continue;
        if (!write_frame(r) || !write_checkpoint(r)) return 0;
    }
    return 1;
}

static void run_free(run *r) {
    if (r->judge) (void)check_end(r->judge);
    if (r->lenient) (void)check_end(r->lenient);
    if (r->csv) fclose(r->csv);
    for (int k = 0; k < r->picture_count; k++) free(r->pictures[k]);
    for (int k = 0; k < r->state_count; k++) free(r->states[k]);
    free(r->pictures), free(r->states), free(r->picture_times), free(r->state_times), free(r->rows);
    free(r->x3), free(r->field), free(r->kinematic), free(r->node_body), free(r->skin_first),
        free(r->halfspaces);
    tss_mesh_free(&r->all);
    tss_mesh_free(&r->skin);
    view_destroy(r->view);
    tss_world_destroy(r->w);
    scene_free(&r->s);
}

// Memory the judge borrows: cells without and with a barrier, loose edges.
static int run_judged(run *r) {
    tss_surface f;
    size_t n = (size_t)tss_world_nodes(r->w);
    if (!r->s.run.check) return take_steps(r);
    if (tss_world_surface(r->w, &f) != TSS_OK) return fail(r, "%s", tss_world_error(r->w));
    size_t cells = 4 * (size_t)(r->all.tets + r->all.triangles);
    int *cell[2] = {(int *)need(cells, sizeof(int)), (int *)need(cells, sizeof(int))};
    int *edges = (int *)need(2 * (size_t)f.edges, sizeof(int));
    r->kinematic = (unsigned char *)need(n, 1), r->node_body = (int *)need(n, sizeof(int));
    mark_kinematic(r);
    for (int b = 0; b < r->s.bodies; b++)
        for (int i = 0; i < r->s.body[b].mesh.nodes; i++) r->node_body[r->s.body[b].first + i] = b;
    int ok = judge_begin(r, cell, edges) && take_steps(r);
    if (ok && !judge_end(r)) ok = -1;
    if (r->judge) (void)check_end(r->judge);
    if (r->lenient) (void)check_end(r->lenient);
    r->judge = r->lenient = NULL;
    free(cell[0]), free(cell[1]), free(edges);
    return ok;
}

static int command_run(run *r) {
    r->terminal = isatty(1), r->started = now(NULL);
    if (!read_scene(r) || !build_world(r) || !open_folders(r)) return 2;
    if (r->o.resume && !read_checkpoint(r)) return 2;
    if (!open_stats(r) || !open_frames(r)) return 2;
    int sound = run_judged(r);
    if (sound == 0) return 2;
    if (!write_report(r, r->s.run.check, sound > 0)) return 2;
    print_summary(r);
    return sound < 0 ? 4 : r->failed ? 3 : 0;
}

static int command_check(run *r) {
    static const char *const words[] = {"note", "warning", "error"};
    tss_check_report c;
    tss_result e;
    if (!read_scene(r)) return 2;
    if (!build_world(r)) return 1;
    if ((e = tss_world_check(r->w, &c)) != TSS_OK)
        return fail(r, "%s: %s", r->o.scene,
                    tss_world_error(r->w)[0] ? tss_world_error(r->w) : tss_result_text(e)),
               1;
    for (int k = 0; k < c.count; k++)
        printf("%s: %s: %s\n", r->o.scene, words[c.issue[k].severity], c.issue[k].text);
    if (c.errors + c.warnings + c.notes > c.count)
        printf("... and %d more\n", c.errors + c.warnings + c.notes - c.count);
    printf("%s: %d bodies, %d nodes, %d steps of %g s: %d errors, %d warnings\n", r->o.scene,
           r->s.bodies, tss_world_nodes(r->w), r->s.world.steps, r->s.world.dt, c.errors,
           c.warnings);
    return c.errors > 0;
}

int main(int argc, char **argv) {
    static run r;
    if (argc >= 2 && strcmp(argv[1], "--version") == 0) return version();
    if (argc >= 2 && (strcmp(argv[1], "--help") == 0 || strcmp(argv[1], "-h") == 0))
        return usage(stdout);
    if (argc < 2 || (strcmp(argv[1], "run") != 0 && strcmp(argv[1], "check") != 0))
        return usage(stderr);
    if (!read_options(argc, argv, &r.o)) return 2;
    int code = strcmp(r.o.command, "run") == 0 ? command_run(&r) : command_check(&r);
    if (r.why.text[0]) fprintf(stderr, "tss: %s\n", r.why.text);
    run_free(&r);
    return code;
}
