/* tss: runs scenes without writing C.

   tss run SCENE [-o DIR] [--steps N] [--threads N] [--budget-ms T] [--frames png,vtu,obj]
                 [--every K] [--resume FILE] [--assets DIR] [--set key=value]... [--check]
                 [--mode adaptive|subspace|full] [--snapshots FILE]
                 [--color enriched|error|progress|speed|J|strain|none]
   tss compare SCENE [-o DIR] [--steps N] [--free-steps M] [--from STEP] [--repeat K] ...
   tss compare --sweep SCENE [--nodes LIST] [--modes LIST] [--tols LIST] [--name NAME] ...
   tss modes SCENE [-o DIR] [--count K] ...
   tss check SCENE [--assets DIR] [--set key=value]...
   tss neural train|run|evaluate|measure|bridge SCENE [-o DIR] [--seed N] [--minutes M]
              [--method vanilla|lipschitz] [--threads N] [--set key=value]...
   tss --version | --help

   SCENE is JSON or a script of the IPC reference code; scene.h lists every key. run leaves in DIR
   (out/NAME) stats.csv: a row a step; frames/NNNN.png, vtu/ with frames.pvd, obj/: one each K steps;
   checkpoint.bin and report.html. It ends with the 64-bit hash of positions and velocities: the same
   for any number of threads. --check hands every accepted iterate to an independent judge
   (tests/checker.h). --snapshots keeps positions each K steps, for a basis of kind pod. check is
   the doctor: it says what is wrong with a scene, which parts of the library the scene uses, and the
   build that leaves out the others; it takes no step. modes lists and draws bases.

   compare --sweep: error against run time over solvers and tolerances, sweep.h.
   neural: neural subspaces, neural.h.
   compare takes each step from the same state in full space (direct, pcg, auto) and adaptively;
   then M steps freely. DIR/compare.csv has a row a step. Its last line:
       error E speedup S best B final F
   E: the largest over the steps of max ‖x − x_full‖ / max ‖x_full − x_t‖, max over the nodes that
   are free to move; S, B: time of the direct solver and of the best full one (smallest total) over
   that of the adaptive one; F: largest distance of a node after the M free steps from where the
   direct solver has it, over the diagonal of the soft bodies.

   EXIT  0 well; 1 the doctor found an error; 2 a file, key or option is at fault; 3 a step did not
   meet its tolerance; 4 the judge found a violation or could not decide.

   >>options  >>run  >>judge  >>frames  >>stats  >>checkpoints  >>summary  >>stepping  >>compare
   >>modes  >>main                                                                             */
#define _POSIX_C_SOURCE 200809L
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"
#include "tss_neural.h"
#include "tss_io.h"
#include "tss_shapes.h"

#define REPORT_IMPLEMENTATION
#include "report.h"
#define CURVES_IMPLEMENTATION
#include "curves.h"
#define SCENE_IMPLEMENTATION
#include "scene.h"
#define VIEW_IMPLEMENTATION
#include "view.h"

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
    const char *command, *scene, *assets, *frames, *resume, *snapshots;
    char out[512], mode[80], color[80];  // mode, color: as key=value
    const char *set[MAX_SETS];
    const char *nodes, *modes, *tols, *name;  // of a sweep
    int sets, steps, threads, every, check, repeat, from, free_steps, count, sweep;
    double budget_ms, minutes;
    const char *action, *method;  // of neural
    int seed, no_full;
} options;

static int usage(FILE *to) {
    fputs(
        "usage: tss run SCENE [-o DIR] [--steps N] [--threads N] [--budget-ms T]\n"
        "               [--frames png,vtu,obj] [--every K] [--resume FILE] [--assets DIR]\n"
        "               [--set key=value]... [--check] [--mode adaptive|subspace|full]\n"
        "               [--snapshots FILE] [--color enriched|error|progress|speed|J|strain|none]\n"
        "       tss compare SCENE [-o DIR] [--steps N] [--free-steps M] [--from STEP] [--repeat "
        "K]\n"
        "               [--threads N] [--assets DIR] [--set key=value]...\n"
        "       tss compare --sweep SCENE [--nodes 1,0.5,...] [--modes 0.5,...] [--tols m/s,...]\n"
        "               [--name NAME], and the options of compare\n"
        "       tss modes SCENE [-o DIR] [--count K] [--assets DIR] [--set key=value]...\n"
        "       tss check SCENE [--assets DIR] [--set key=value]...\n"
        "       tss neural train|run|evaluate|measure|bridge SCENE [-o DIR] [--seed N] [--minutes M]\n"
        "               [--method vanilla|lipschitz] [--steps N] [--no-full] [--threads N] [--set key=value]...\n"
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
    fprintf(stderr, "tss: %s%s%s: expected %s\n", what, *value ? " " : "", value, expected);
    return 0;
}

// Commands; those of neural are its actions.
enum { RUN = 1, CHECK = 2, COMPARE = 4, MODES = 8, TRAIN = 16, PLAY = 32, EVALUATE = 64, MEASURE = 128, BRIDGE = 256 };
enum { NEURAL = TRAIN | PLAY | EVALUATE | MEASURE | BRIDGE, ALL = RUN | CHECK | COMPARE | MODES | NEURAL };
static const char *const command_names[] = {"run", "check", "compare", "modes", "neural", NULL};
static const char *const actions[] = {"train", "run", "evaluate", "measure", "bridge", NULL};

typedef enum option_kind { FLAG, COUNT, POSITIVE, WORD, OTHER } option_kind;  // COUNT >= 0, POSITIVE >= 1; OTHER: see take

typedef struct option {
    const char *name;
    int commands;  // that take it
    option_kind kind;
    size_t to;
} option;

static const option option_table[] = {
    {"--set", ALL, OTHER, 0},
    {"--assets", ALL, WORD, offsetof(options, assets)},
    {"--threads", ALL, POSITIVE, offsetof(options, threads)},
    {"-o", ALL & ~CHECK, OTHER, 0},
    {"--steps", RUN | COMPARE | PLAY | EVALUATE | BRIDGE, COUNT, offsetof(options, steps)},
    {"--mode", RUN | CHECK, OTHER, 0},
    {"--color", RUN | CHECK, OTHER, 0},
    {"--frames", RUN, WORD, offsetof(options, frames)},
    {"--every", RUN, POSITIVE, offsetof(options, every)},
    {"--budget-ms", RUN, OTHER, 0},
    {"--resume", RUN, WORD, offsetof(options, resume)},
    {"--snapshots", RUN, WORD, offsetof(options, snapshots)},
    {"--check", RUN, FLAG, offsetof(options, check)},
    {"--from", COMPARE, COUNT, offsetof(options, from)},
    {"--free-steps", COMPARE, COUNT, offsetof(options, free_steps)},
    {"--repeat", COMPARE | EVALUATE | BRIDGE, POSITIVE, offsetof(options, repeat)},
    {"--sweep", COMPARE, FLAG, offsetof(options, sweep)},
    {"--nodes", COMPARE, WORD, offsetof(options, nodes)},
    {"--modes", COMPARE, WORD, offsetof(options, modes)},
    {"--tols", COMPARE, WORD, offsetof(options, tols)},
    {"--name", COMPARE | NEURAL, WORD, offsetof(options, name)},
    {"--count", MODES, POSITIVE, offsetof(options, count)},
    {"--seed", NEURAL, COUNT, offsetof(options, seed)},
    {"--minutes", TRAIN, OTHER, 0},
    {"--method", TRAIN, OTHER, 0},
    {"--no-full", EVALUATE, FLAG, offsetof(options, no_full)}};

enum { OPTIONS = sizeof option_table / sizeof *option_table };

static int unknown(const char *what, const char *name, const char *const *names) {
    char text[200];
    scene__suggest(name, names, text, sizeof text);
    int near = strncmp(text, "did", 3) == 0;
    fprintf(stderr, "tss: no such %s: %s%s%s (`tss --help` lists all)\n", what, name, near ? "; " : "", near ? text : "");
    return 0;
}

// The option of a name that this command takes, or NULL, with a complaint.
static const option *find_option(const options *o, int command, const char *name) {
    const char *names[OPTIONS + 1] = {NULL};
    char takers[300] = "";
    const option *found = NULL;
    for (int k = 0; k < OPTIONS; k++) {
        names[k] = option_table[k].name;
        if (strcmp(name, names[k]) == 0) found = &option_table[k];
    }
    if (!found) return unknown("option", name, names), NULL;
    if (found->commands & command) return found;
    for (int k = 0; k < 9; k++)  // the first four are commands, the others actions of neural
        if (found->commands & 1 << k) {
            size_t used = strlen(takers);
            snprintf(takers + used, sizeof takers - used, "%s`tss %s%s`", used ? ", " : "", k < 4 ? "" : "neural ", k < 4 ? command_names[k] : actions[k - 4]);
        }
    fprintf(stderr, "tss: %s: `tss %s%s%s` does not take it; expected %s\n", name, o->command, o->action ? " " : "", o->action ? o->action : "", takers);
    return NULL;
}

static int add_set(options *o, const char *line) {
    return o->sets < MAX_SETS ? (o->set[o->sets++] = line, 1)
                              : complain("--set", line, "no more than 256");
}

// An option that is short for --set key=value; text is where the line stays.
static int take_key(options *o, const char *key, const char *value, char text[80]) {
    if (snprintf(text, 80, "%s=%s", key, value) >= 80) return complain(key, value, "a shorter word");
    return add_set(o, text);
}

static int take_color(options *o, const char *value) {
    static const char *const names[] = {"none",     "speed", "J",       "strain",
                                        "enriched", "error", "progress"};
    for (size_t k = 0; k < sizeof names / sizeof *names; k++)
        if (strcmp(value, names[k]) == 0)
            return take_key(o, "frames.field", k == 1 ? "velocity" : value, o->color);
    return complain("--color", value, "enriched, error, progress, speed, J, strain or none");
}

// One option and its value; 0: bad.
static int take(options *o, const option *p, const char *value) {
    void *to = (char *)o + p->to;
    const char *name = p->name;
    if (!value) return complain(name, "", "a value");
    if (p->kind == WORD) return memcpy(to, &value, sizeof value), 1;
    if (p->kind == COUNT) return whole(value, 0, (int *)to) || complain(name, value, "a whole number >= 0");
    if (p->kind == POSITIVE) return whole(value, 1, (int *)to) || complain(name, value, "a whole number >= 1");
    if (strcmp(name, "-o") == 0) return snprintf(o->out, sizeof o->out, "%s", value) > 0;
    if (strcmp(name, "--mode") == 0) return take_key(o, "solver.mode", value, o->mode);
    if (strcmp(name, "--color") == 0) return take_color(o, value);
    if (strcmp(name, "--set") == 0) return add_set(o, value);
    if (strcmp(name, "--method") == 0)
        return o->method = value, strcmp(value, "vanilla") == 0 || strcmp(value, "lipschitz") == 0 ||
                                      complain(name, value, "vanilla or lipschitz");
    double *number = strcmp(name, "--minutes") == 0 ? &o->minutes : &o->budget_ms;
    return (tss_parse_double(value, strlen(value), number) == TSS_OK && *number > 0) ||
           complain(name, value, number == &o->minutes ? "minutes > 0" : "milliseconds > 0");
}

static int read_options(int argc, char **argv, int command, options *o) {
    int sweeps = 0;
    memset(o, 0, sizeof *o);
    o->steps = o->free_steps = -1, o->repeat = 1;
    o->nodes = "1,0.5,0.2,0.1,0.05,0.02", o->modes = "0.5,0.05";
    o->command = argv[1];
    int first = 2;
    if (command == NEURAL) {
        int k = 0;
        o->action = argc > 2 ? argv[2] : "";
        while (actions[k] && strcmp(o->action, actions[k]) != 0) k++;
        if (!actions[k]) return complain("neural", o->action, "train, run, evaluate, measure or bridge");
        command = TRAIN << k, first = 3;
    }
    for (int k = first; k < argc; k++) {
        if (argv[k][0] == '-' && argv[k][1]) {
            char *equals = argv[k][1] == '-' ? strchr(argv[k], '=') : NULL;  // --name=value
            if (equals) *equals = 0;
            const option *p = find_option(o, command, argv[k]);
            if (!p) return 0;
            sweeps |= p->to == offsetof(options, nodes) || p->to == offsetof(options, modes) || p->to == offsetof(options, tols);
            if (p->kind == FLAG) {
                if (equals) return complain(p->name, "", "no value");
                *(int *)(void *)((char *)o + p->to) = 1;
                continue;
            }
            if (!take(o, p, equals ? equals + 1 : argv[k + 1])) return 0;
            k += !equals;
        } else if (!o->scene)
            o->scene = argv[k];
        else
            return complain("argument", argv[k], "one scene");
    }
    if (sweeps && !o->sweep) return complain("--nodes, --modes, --tols", "", "--sweep beside them");
    return o->scene ? 1 : complain(o->command, "", "a scene");
}

// ---------------------------------------------------------------------------------------------
// >>run
// ---------------------------------------------------------------------------------------------

// What a row of stats.csv holds; `i` is the step's info, `c` what contact counted.
#define COLUMNS(X)                                                                                 \
    X(step, r->step)                                                                               \
    X(time, i->time) X(status, i->status) X(newton, i->newton) X(                                  \
        linear_iters, i->linear_iterations) X(enriched_nodes, i->enriched_nodes)                   \
        X(nodes, i->nodes) X(active_modes, i->active_modes) X(modes, i->modes) X(                  \
            contacts, i->contacts) X(residual_max, i->residual_max)                                \
            X(residual_mean, i->residual_mean) X(residual_newton, i->residual_newton) X(           \
                oracle_error, i->oracle_error) X(min_J, i->min_J) X(min_distance, i->min_distance) \
                X(seconds, i->seconds) X(decrement, i->decrement) X(target_left, i->target_left)   \
                    X(min_alpha, i->min_alpha) X(factorizations, i->factorizations)                \
                        X(energy_s, i->phase_seconds[TSS_PHASE_ENERGY])                            \
                            X(gradient_s, i->phase_seconds[TSS_PHASE_GRADIENT])                    \
                                X(hessian_s, i->phase_seconds[TSS_PHASE_HESSIAN])                  \
                                    X(assemble_s, i->phase_seconds[TSS_PHASE_ASSEMBLE])            \
                                        X(linear_s, i->phase_seconds[TSS_PHASE_LINEAR])            \
                                            X(collision_s, i->phase_seconds[TSS_PHASE_COLLISION])  \
                                                X(oracle_s, i->phase_seconds[TSS_PHASE_ORACLE])    \
                                                    X(other_s, i->phase_seconds[TSS_PHASE_OTHER])  \
                                                        X(bytes, i->bytes)                         \
                                                            X(allocations, i->allocations)         \
                                                                CONTACT_COLUMNS(X)

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
    tss_subspace *sub;            // NULL: full space
    int step, snapshots, failed;  // failed: steps that did not converge
    char worst[300];   // the first of them
    row *rows;
    int row_count;
    FILE *csv;
    int png, vtu, obj, terminal;
    view *view;
    view_camera camera;
    double *x3, *field;         // positions with three coordinates; the scalar to show
    double shown[2];            // its range, of error and progress
    double *oracle;             // what the oracle knows of each node, for .vtu
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

// What -o says, or out/ and the scene's name.
static const char *out_folder(run *r) {
    const char *name = strrchr(r->o.scene, '/');
    name = name ? name + 1 : r->o.scene;
    if (!r->o.out[0])
        snprintf(r->o.out, sizeof r->o.out, "out/%.*s", (int)strcspn(name, "."), name);
    return r->o.out;
}

static int open_folders(run *r) {
    const char *sub[] = {"frames", "vtu", "obj"};
    int on[] = {r->png, r->vtu, r->obj};
    char path[600];
    if (!make_folder(r, out_folder(r))) return 0;
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
    if (!r->kinematic) return;
    const uint8_t *kind = tss_world_kinds(r->w);
    for (int i = 0; i < tss_world_nodes(r->w); i++) r->kinematic[i] = kind[i] != TSS_NODE_FREE;
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
static void fill_cells(run *r) {
    int n = tss_world_nodes(r->w), dim = r->s.world.dim;
    double *weight = (double *)need((size_t)n, sizeof *weight), D[9];
    memset(r->field, 0, (size_t)n * sizeof *r->field);
    for (int b = 0; b < r->s.bodies; b++) {
        tss_body_info info;
        if (r->s.body[b].obstacle || tss_body_get(r->w, r->s.body[b].id, &info) != TSS_OK) continue;
        const int *cell = tss_body_cells(r->w, r->s.body[b].id);
        for (int k = 0; k < info.cells; k++, cell += dim + 1) {
            double value = cell_field(r, cell),
                   vol = fabs(edges_of(tss_world_rest(r->w), cell, dim, D));
            for (int i = 0; i <= dim; i++) r->field[cell[i]] += vol * value, weight[cell[i]] += vol;
        }
    }
    for (int i = 0; i < n; i++) r->field[i] /= weight[i];
    free(weight);
}

static void fill_speed(run *r) {
    int dim = r->s.world.dim;
    const double *v = tss_world_velocities(r->w);
    for (int i = 0; i < tss_world_nodes(r->w); i++) {
        double s = 0;
        for (int c = 0; c < dim; c++) s += v[dim * i + c] * v[dim * i + c];
        r->field[i] = sqrt(s);
    }
}

// Decimal logarithms; where the oracle did not look there is no number.
static void fill_log(run *r, const double *value) {
    double *lo = &r->shown[0], *hi = &r->shown[1];
    *lo = INFINITY, *hi = 0;
    for (int i = 0; i < tss_world_nodes(r->w); i++) {
        r->field[i] = value[i] > 0 ? log10(value[i]) : NAN;
        if (value[i] > 0) *lo = fmin(*lo, value[i]), *hi = fmax(*hi, value[i]);
    }
    if (!(*lo <= *hi)) *lo = *hi = 0;
}

// The oracle's fields at the state that is shown: the last iterate of a step that converged had
// little left to ask about. Where the question fails, the fields of that iterate are shown.
static void ask_oracle(run *r, tss_subspace_info *sub) {
    if (tss_subspace_query(r->w) != TSS_OK)
        fprintf(stderr, "oracle: %s\n", tss_world_error(r->w));
    tss_subspace_get_info(r->sub, sub);
}

static void fill_field(run *r) {
    tss_subspace_info sub;
    int field = r->s.frames.field;
    memset(&sub, 0, sizeof sub);
    if (r->sub && (field == SCENE_FIELD_ERROR || field == SCENE_FIELD_PROGRESS))
        ask_oracle(r, &sub);
    else if (r->sub)
        tss_subspace_get_info(r->sub, &sub);
    switch (r->s.frames.field) {
        case SCENE_FIELD_VELOCITY:
            fill_speed(r);
            break;
        case SCENE_FIELD_ENRICHED:
            for (int i = 0; i < tss_world_nodes(r->w); i++)
                r->field[i] = sub.enriched && sub.enriched[i];
            break;
        case SCENE_FIELD_ERROR:
        case SCENE_FIELD_PROGRESS: {
            const double *v = r->s.frames.field == SCENE_FIELD_ERROR ? sub.error : sub.progress;
            if (v) fill_log(r, v);
            break;
        }
        default:
            fill_cells(r);
    }
}

// Error and progress: whole decades around what is there, at most six.
static void log_range(const run *r, double *lo, double *hi) {
    const double *range = r->s.frames.has_range ? r->s.frames.range : r->shown;
    *hi = range[1] > 0 ? log10(range[1]) : 0, *lo = range[0] > 0 ? log10(range[0]) : *hi - 6;
    if (r->s.frames.has_range) return;
    *hi = ceil(*hi), *lo = fmax(floor(*lo), *hi - 6);
    if (*lo >= *hi) *lo = *hi - 1;
}

static int log_field(const run *r) {
    return r->s.frames.field == SCENE_FIELD_ERROR || r->s.frames.field == SCENE_FIELD_PROGRESS;
}

static void field_range(const run *r, double *lo, double *hi) {
    if (log_field(r)) {
        log_range(r, lo, hi);
        return;
    }
    *lo = r->s.frames.field == SCENE_FIELD_J ? 0.5 : 0;
    *hi = r->s.frames.field == SCENE_FIELD_J        ? 1.5
          : r->s.frames.field == SCENE_FIELD_STRAIN ? 0.5
                                                    : 1;
    if (r->s.frames.has_range) *lo = r->s.frames.range[0], *hi = r->s.frames.range[1];
}

static view_map field_map(const run *r) {
    return r->s.frames.field == SCENE_FIELD_J ? VIEW_MAP_BALANCE
           : log_field(r)                     ? VIEW_MAP_EMBER
                                              : VIEW_MAP_SEA;
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
        style.map = field_map(r);
        field_range(r, &style.lo, &style.hi);
        if (r->s.frames.field == SCENE_FIELD_ENRICHED)
            style.lo = 0, style.hi = 1, style.darken = 0.9f;
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

static void label_frame(const run *r, view_image *im) {
    char line[160], unit[40];
    const char *name = strrchr(r->o.scene, '/'), *field = scene__fields[r->s.frames.field];
    double lo, hi;
    tss_subspace_info sub;
    int n = snprintf(line, sizeof line, "step %d   t = %.3f s", r->step, tss_world_time(r->w));
    size_t left = sizeof line - (size_t)n;
    if (r->s.frames.field == SCENE_FIELD_ENRICHED) {
        tss_subspace_get_info(r->sub, &sub);
        snprintf(line + n, left, "   enriched (dark) %d of %d nodes, %d modes", sub.enriched_nodes,
                 sub.nodes, sub.active_modes);
    } else if (log_field(r)) {
        snprintf(line + n, left, "   %s %.2e to %.2e", field, r->shown[0], r->shown[1]);
    }
    view_label(im, name ? name + 1 : r->o.scene, line);
    if (r->s.frames.field == SCENE_FIELD_NONE || r->s.frames.field == SCENE_FIELD_ENRICHED) return;
    field_range(r, &lo, &hi);
    snprintf(unit, sizeof unit, "%s%s", log_field(r) ? "log10 " : "", field);
    view_colour_bar(im, field_map(r), lo, hi, unit);
}

// The scene at x3, coloured by field; rgb NULL: no memory.
static view_image render_scene(run *r) {
    double lo[3], hi[3];
    view_look look = scene_look(r);
    scene_box(r, lo, hi);
    view_begin(r->view, &r->camera, &look);
    for (int b = 0; b < r->s.bodies; b++) draw_body(r, b);
    for (int k = 0; k < r->s.planes; k++)
        if (r->s.world.dim == 2 || !level(&r->s.plane[k])) draw_plane(r, &r->s.plane[k], lo, hi);
    return view_render(r->view);
}

static int draw_frame(run *r) {
    char path[700];
    view_error why;
    view_image im = render_scene(r);
    if (!im.rgb) return fail(r, "out of memory for a picture");
    label_frame(r, &im);
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

// What the oracle knows of each node; returns how many fields went to out.
static int oracle_fields(run *r, tss_field out[4]) {
    static const char *const name[] = {"enriched", "group", "error", "progress"};
    int n = tss_world_nodes(r->w);
    tss_subspace_info sub;
    if (!r->sub) return 0;
    ask_oracle(r, &sub);
    if (!r->oracle) r->oracle = (double *)need(4 * (size_t)n, sizeof(double));
    for (int i = 0; i < n; i++) {
        r->oracle[i] = sub.enriched ? sub.enriched[i] : 0;
        r->oracle[n + i] = sub.group ? sub.group[i] : -1;
        r->oracle[2 * n + i] = sub.error ? sub.error[i] : 0;
        r->oracle[3 * n + i] = sub.progress ? sub.progress[i] : 0;
    }
    for (int k = 0; k < 4; k++) {
        out[k].name = name[k], out[k].values = r->oracle + (size_t)k * (size_t)n;
        out[k].components = 1, out[k].on_cells = 0;
    }
    return 4;
}

static int write_state(run *r) {
    char path[700];
    tss_io_error why;
    int shown = r->s.frames.field;
    int field = shown != SCENE_FIELD_NONE && shown < SCENE_FIELD_ENRICHED;
    tss_field fields[6] = {{"velocity", tss_world_velocities(r->w), r->s.world.dim, 0},
                           {shown == SCENE_FIELD_VELOCITY ? "speed"
                            : field                       ? scene__fields[shown]
                                                          : "",
                            r->field, 1, 0}};
    field += r->vtu ? oracle_fields(r, fields + 1 + field) : 0;
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
    printf("step %d t %.4f %s newton %d contacts %d residual %.3g min_J %.3g distance %.3g %.3f s",
           r->step, i->time, tss_status_text(i->status), i->newton, i->contacts, i->residual_max,
           i->min_J, i->min_distance, i->seconds);
    if (r->sub)
        printf(" modes %d/%d enriched %d/%d", i->active_modes, i->modes, i->enriched_nodes,
               i->nodes);
    printf("\n");
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
    if (r->sub) {
        double nodes, nodes_max, modes, modes_max;
        totals(r, COL_enriched_nodes, &nodes, &nodes_max);
        totals(r, COL_active_modes, &modes, &modes_max);
        printf("enriched nodes %.1f (most %.0f), active modes %.1f (most %.0f)\n", nodes, nodes_max,
               modes, modes_max);
    }
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
    memset(series, 0, sizeof series);
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

static void report_subspace(report *p, const run *r) {
    static const column modes[] = {COL_active_modes}, nodes[] = {COL_enriched_nodes},
                        error[] = {COL_oracle_error};
    char of[60];
    tss_subspace_info sub;
    tss_subspace_get_info(r->sub, &sub);
    report_plot a = report_plot_default("Active modes", "time, s", "modes");
    snprintf(of, sizeof of, "of %d", sub.modes);
    a.zero = 1, a.note = of;
    plot(p, r, a, modes, 1);
    a = report_plot_default("Enriched nodes", "time, s", "nodes");
    snprintf(of, sizeof of, "of %d", sub.nodes);
    a.zero = 1, a.note = of;
    plot(p, r, a, nodes, 1);
    a = report_plot_default("Largest error of a node that is not enriched", "time, s", "error");
    a.log_y = 1;
    plot(p, r, a, error, 1);
}

static void report_plots(report *p, const run *r) {
    static const column work[] = {COL_newton}, touch[] = {COL_contacts},
                        error[] = {COL_residual_max, COL_residual_mean}, gap[] = {COL_min_distance},
                        J[] = {COL_min_J},
                        phase[] = {COL_energy_s, COL_gradient_s,  COL_hessian_s, COL_assemble_s,
                                   COL_linear_s, COL_collision_s, COL_oracle_s,  COL_other_s};
    report_plot a = report_plot_default("Newton iterates", "time, s", "iterates a step");
    a.zero = 1;
    plot(p, r, a, work, 1);
    if (r->sub) report_subspace(p, r);
    a = report_plot_default("Contacts", "time, s", "active pairs");
    a.zero = 1;
    plot(p, r, a, touch, 1);
    a = report_plot_default("Where the time goes", "time, s", "seconds a step");
    a.stacked = 1;
    plot(p, r, a, phase, 8);
    a = report_plot_default("Residual", "time, s", "m/s");
    a.log_y = 1;
    plot(p, r, a, error, 2);
    a = report_plot_default("Least distance between surfaces", "time, s", "m");
    a.log_y = 1;
    plot(p, r, a, gap, 1);
    plot(p, r, report_plot_default("Least J (volume over rest volume)", "time, s", "J"), J, 1);
}

static void report_scene(report *p, const run *r) {
    static const char *const names[] = {"bodies",
                                        "nodes",
                                        "cells",
                                        "surface triangles",
                                        "step, s",
                                        "integrator",
                                        "threads",
                                        "state",
                                        "solver",
                                        "bases: modes, groups of nodes",
                                        "setup, s; held by the solver, MB"};
    char text[11][60];
    const char *values[11];
    tss_subspace_info sub;
    memset(&sub, 0, sizeof sub);
    if (r->sub) tss_subspace_get_info(r->sub, &sub);
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
    snprintf(text[8], 60, "%s", scene__modes[scene_mode(&r->s)]);
    snprintf(text[9], 60, "%d: %d, %d", sub.bases, sub.modes, sub.groups);
    snprintf(text[10], 60, "%.3f; %.1f", sub.setup_seconds, 1e-6 * (double)sub.bytes);
    for (int k = 0; k < 11; k++) values[k] = text[k];
    report_table(p, "Scene", names, values, r->sub ? 11 : 9);
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
    if (r->sub) {
        totals(r, COL_enriched_nodes, &n, &n_max);
        snprintf(text, sizeof text, "%.1f, most %.0f of %.0f", n, n_max,
                 r->row_count > 0 ? r->rows[0].v[COL_nodes] : 0);
        report_status(p, "Enriched nodes", text, REPORT_INFO);
    }
    if (judged)
        report_status(p, "Independent judge", sound ? "no violation" : "violations",
                      sound ? REPORT_GOOD : REPORT_BAD);
    report_frames(p, (const char *const *)r->pictures, NULL, r->picture_count, 8);
    if (r->row_count > 0) report_plots(p, r);
    report_scene(p, r);
    return report_end(p, r->o.out, &why) ? 1 : fail(r, "%s", why.message);
}

// ---------------------------------------------------------------------------------------------
// >>stepping
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
    if (r->s.frames.has_range && log_field(r) &&
        !(r->s.frames.range[0] > 0 && r->s.frames.range[1] > r->s.frames.range[0]))
        return fail(r,
                    "%s: frames.range is [%g, %g], expected 0 < low < high: %s is drawn on a "
                    "logarithmic scale",
                    r->o.scene, r->s.frames.range[0], r->s.frames.range[1],
                    scene__fields[r->s.frames.field]);
    return read_formats(r);
}

// What frames show when the scene does not say it.
static int choose_field(run *r) {
    int *field = &r->s.frames.field;
    if (*field == SCENE_FIELD_AUTO)
        *field = scene_mode(&r->s) == TSS_MODE_ADAPTIVE ? SCENE_FIELD_ENRICHED : SCENE_FIELD_NONE;
    return *field < SCENE_FIELD_ENRICHED || scene_mode(&r->s) != TSS_MODE_FULL
               ? 1
               : fail(r, "%s: frames.field is \"%s\", which full space does not have", r->o.scene,
                      scene__fields[*field]);
}

static int build_world(run *r, tss_world **w, tss_ipc **ipc) {
    tss_host host = tss_host_default();
    host.clock = now, host.log = print_log, host.workers = r->o.threads;
#ifdef _OPENMP
    if (r->o.threads > 0)
        omp_set_num_threads(r->o.threads);  // pictures and the judge use OpenMP themselves
#endif
    if (!scene_build(&r->s, &host, judge_iterate, r, w, ipc, &r->why)) return 0;
    r->o.threads = tss_workers(&host);
    return 1;
}

static int step_world(run *r, tss_world *w, int step, tss_step_info *info) {
    if (!scene_drive(&r->s, w, &r->why)) return 0;
    mark_kinematic(r);
    tss_result e = r->s.run.budget_ms > 0 ? tss_world_step_for(w, 1e-3 * r->s.run.budget_ms, info)
                                          : tss_world_step(w, info);
    return e == TSS_OK ? 1
                       : fail(r, "%s: step %d: %s", r->o.scene, step,
                              tss_world_error(w)[0] ? tss_world_error(w) : tss_result_text(e));
}

static int take_steps(run *r) {
    tss_step_info info;
    if (!r->o.resume && !write_frame(r)) return 0;
    while (r->step < r->s.world.steps) {
        if (!step_world(r, r->w, r->step + 1, &info)) return 0;
        r->step++;
        record(r, &info);
        if (r->step % r->s.run.every != 0 && r->step != r->s.world.steps) continue;
        if (!write_frame(r) || !write_checkpoint(r)) return 0;
        if (r->o.snapshots && !scene_snapshot(r->o.snapshots, r->w, r->snapshots++, &r->why))
            return 0;
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
    free(r->x3), free(r->field), free(r->oracle), free(r->kinematic), free(r->node_body),
        free(r->skin_first), free(r->halfspaces);
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
    if (!read_scene(r) || !choose_field(r) || !build_world(r, &r->w, &r->ipc) || !open_folders(r))
        return 2;
    if (r->s.neural.given) fprintf(stderr, "tss: %s: `neural` is for `tss neural`; `run` steps the bodies alone\n", r->o.scene);
    r->sub = tss_subspace_of(r->w);
    if (r->o.resume && !read_checkpoint(r)) return 2;
    if (!open_stats(r) || !open_frames(r)) return 2;
    int sound = run_judged(r);
    if (sound == 0) return 2;
    if (!write_report(r, r->s.run.check, sound > 0)) return 2;
    print_summary(r);
    return sound < 0 ? 4 : r->failed ? 3 : 0;
}

// Bases are there by now; what is left to say is where they have less than was asked for.
static void check_bases(const run *r) {
    for (int b = 0; b < r->s.bodies; b++)
        for (int k = 0; k < r->s.body[b].bases; k++) {
            const scene_basis *p = &r->s.body[b].basis[k];
            tss_basis_info info;
            if (p->id < 0 || tss_basis_get(r->w, p->id, &info) != TSS_OK) continue;
            if (p->kind == TSS_BASIS_POD && info.functions < p->count)
                printf("%s: note: bodies[%d].basis[%d]: the snapshots give %d modes, not %d\n",
                       r->o.scene, b, k, info.functions, p->count);
            if (p->initial > info.blocks)
                printf("%s: note: bodies[%d].basis[%d].initial is %d, but there are %d blocks\n",
                       r->o.scene, b, k, p->initial, info.blocks);
        }
}

static int has_bases(const scene *s) {
    for (int k = 0; k < s->bodies; k++)
        if (s->body[k].bases > 0) return 1;
    return 0;
}

// What the scene asks of the library, and the build that leaves out the rest (docs/leave_out.md).
static void print_part(const char *name, int used, const char *why, const char *flag, char *flags,
                       size_t size) {
    printf("%s: %s (%s)\n", name, used ? "used" : "not used", why);
    size_t at = strlen(flags);
    if (!used && flag) snprintf(flags + at, size - at, " -DTSS_NO_%s", flag);
}

static int has_friction(const scene *s) {
    int any = s->contact.mu > 0;
    for (int k = 0; k < s->bodies; k++) any |= s->body[k].mu > 0;
    for (int k = 0; k < s->planes; k++) any |= s->plane[k].mu > 0;
    return s->contact.enabled && any;
}

// Kinds of what bodies are made of and how they move, as bits.
enum { OTHER_MATERIAL = 1, DAMPED = 2, BY_CELL = 4, SCRIPTED = 8, BASIS = 16, SOLVED_BASIS = 32 };

static int traits(const scene *s) {
    int all = s->script != SCENE_SCRIPT_NONE ? SCRIPTED : 0;
    for (int k = 0; k < s->bodies; k++) {
        const scene_body *b = &s->body[k];
        if (b->motion.moves) all |= SCRIPTED;
        for (int i = 0; i < b->pins; i++)
            if (b->pin[i].motion.moves) all |= SCRIPTED;
        if (b->obstacle) continue;
        if (b->material.kind != TSS_NEO_HOOKEAN) all |= OTHER_MATERIAL;
        if (b->material.damping > 0) all |= DAMPED;
        if (b->E || b->nu) all |= BY_CELL;
        for (int i = 0; i < b->bases && scene_mode(s) != TSS_MODE_FULL; i++) {
            int kind = b->basis[i].kind;
            all |= kind == TSS_BASIS_AFFINE || kind == TSS_BASIS_QUADRATIC ? BASIS : BASIS | SOLVED_BASIS;
        }
    }
    return all;
}

static void print_parts(const scene *s) {
    const int contact = s->contact.enabled, friction = has_friction(s), all = traits(s), flat = s->world.dim == 2;
    const char *full = has_bases(s) ? "solver.mode is full" : "no body has a basis";
    char flags[400] = "";
    print_part("2D", flat, flat ? "world.dim is 2" : "world.dim is 3", "2D", flags, sizeof flags);
    print_part("3D", !flat, flat ? "world.dim is 2" : "world.dim is 3", "3D", flags, sizeof flags);
    print_part("contact", contact, contact ? "contact.enabled" : "contact.enabled is false", NULL, flags, sizeof flags);
    print_part("self-contact", contact && s->contact.self,
               !contact ? "no contact" : s->contact.self ? "contact.self" : "contact.self is false", NULL, flags, sizeof flags);
    print_part("friction", friction, !contact ? "no contact" : friction ? "mu > 0" : "mu is 0 everywhere", "FRICTION",
               flags, sizeof flags);
    print_part("subspace", (all & BASIS) != 0, all & BASIS ? "a body has a basis" : full, NULL, flags, sizeof flags);
    print_part("bases that solve for modes", (all & SOLVED_BASIS) != 0,
               all & SOLVED_BASIS ? "skinning, biharmonic, eigen or pod"
               : all & BASIS      ? "all are affine or quadratic"
                                  : full,
               "EIGEN", flags, sizeof flags);
    print_part("materials but Neo-Hookean", (all & OTHER_MATERIAL) != 0,
               all & OTHER_MATERIAL ? "material.kind" : "all are neo_hookean", "MATERIALS", flags, sizeof flags);
    print_part("materials by cell", (all & BY_CELL) != 0, all & BY_CELL ? "regions" : "no regions", NULL, flags, sizeof flags);
    print_part("damping", (all & DAMPED) != 0, all & DAMPED ? "material.damping > 0" : "material.damping is 0 everywhere",
               "DAMPING", flags, sizeof flags);
    print_part("membranes, hinges, springs", 0, "scenes have none", "THIN", flags, sizeof flags);
    print_part("scripted nodes", (all & SCRIPTED) != 0, all & SCRIPTED ? "a motion or script" : "nothing has a motion",
               NULL, flags, sizeof flags);
    printf("this scene needs: cc -O3 -march=native -fopenmp%s scene.c -lmetis -lm (headers tss.h%s%s)\n", flags,
           contact ? " tss_ipc.h" : "", all & BASIS ? " tss_subspace.h" : "");
}

static int command_check(run *r) {
    static const char *const words[] = {"note", "warning", "error"};
    tss_check_report c;
    tss_result e;
    if (!read_scene(r)) return 2;
    if (!build_world(r, &r->w, &r->ipc)) return 1;
    if ((e = tss_world_check(r->w, &c)) != TSS_OK)
        return fail(r, "%s: %s", r->o.scene,
                    tss_world_error(r->w)[0] ? tss_world_error(r->w) : tss_result_text(e)),
               1;
    for (int k = 0; k < c.count; k++)
        printf("%s: %s: %s\n", r->o.scene, words[c.issue[k].severity], c.issue[k].text);
    if (c.errors + c.warnings + c.notes > c.count)
        printf("... and %d more\n", c.errors + c.warnings + c.notes - c.count);
    check_bases(r);
    printf("%s: %d bodies, %d nodes, %d steps of %g s: %d errors, %d warnings\n", r->o.scene,
           r->s.bodies, tss_world_nodes(r->w), r->s.world.steps, r->s.world.dt, c.errors,
           c.warnings);
    print_parts(&r->s);
    return c.errors > 0;
}

// ---------------------------------------------------------------------------------------------
// >>compare
// One world a solver, all built alike. Before each step every world takes over the state of the
// direct one; what the adaptive one has activated stays with it.
// ---------------------------------------------------------------------------------------------

enum { DIRECT, PCG, AUTO, ADAPTIVE, SOLVERS };

typedef struct contender {
    tss_world *w;
    tss_step_info info;
    double seconds, total;  // of this step (best of the repetitions), of all
    void *kept;             // checkpoint before the step
} contender;

typedef struct contest {
    contender c[SOLVERS];
    void *motions;         // of the scene, before the step
    double *x_t, *x_free;  // start of the step; the direct solver's end of the free steps
    double error, worst_seconds;
    int steps, free_steps, failed;
    FILE *csv;
} contest;

static void *save_world(const tss_world *w, size_t *size) {
    *size = tss_world_save(w, NULL, 0);
    void *data = need(*size, 1);
    (void)tss_world_save(w, data, *size);
    return data;
}

static int load_world(run *r, tss_world *w, const void *data, size_t size) {
    tss_result e = tss_world_load(w, data, size);
    return e == TSS_OK ? 1 : fail(r, "%s: %s", r->o.scene, tss_world_error(w));
}

static void *save_motions(run *r) {
    size_t size = scene_state(&r->s, NULL, 0, 1);
    void *data = need(size, 1);
    (void)scene_state(&r->s, data, size, 1);
    return data;
}

static void load_motions(run *r, void *data) {
    (void)scene_state(&r->s, data, scene_state(&r->s, NULL, 0, 0), 0);
}

// The adaptive world last: it leaves the numbers of the bases in the scene.
static int build_contenders(run *r, contest *t) {
    static const int linear[] = {TSS_LINEAR_DIRECT, TSS_LINEAR_PCG, TSS_LINEAR_AUTO};
    int mode = r->s.solver.mode, own = r->s.solver.linear;
    tss_ipc *ipc;
    if (!has_bases(&r->s))
        return fail(r, "%s: no body has a basis: nothing to compare", r->o.scene);
    for (int k = 0; k < SOLVERS; k++) {
        r->s.solver.linear = k < ADAPTIVE ? linear[k] : own;
        r->s.solver.mode = k < ADAPTIVE                ? (int)TSS_MODE_FULL
                           : mode == TSS_MODE_SUBSPACE ? mode
                                                       : (int)TSS_MODE_ADAPTIVE;
        if (!build_world(r, &t->c[k].w, &ipc)) return 0;
    }
    return 1;
}

// The direct solver's way to step `from`; then all stand there.
static int run_ahead(run *r, contest *t) {
    size_t size;
    for (int k = 0; k < r->o.from; k++) {
        if (!step_world(r, t->c[DIRECT].w, k + 1, &t->c[DIRECT].info)) return 0;
        fprintf(stderr, "compare: on the way to step %d: %d\n", r->o.from, k + 1);
    }
    if (r->o.from == 0) return 1;
    void *data = save_world(t->c[DIRECT].w, &size);
    int ok = 1;
    for (int k = 1; ok && k < SOLVERS; k++) ok = load_world(r, t->c[k].w, data, size);
    free(data);
    return ok;
}

// max ‖x − y‖ over the nodes that are free to move, or all.
static double farthest(const tss_world *w, const double *x, const double *y, int all) {
    int dim = tss_world_dim(w);
    const uint8_t *kind = tss_world_kinds(w);
    double most = 0;
    for (int i = 0; i < tss_world_nodes(w); i++) {
        double s = 0;
        for (int c = 0; c < dim; c++)
            s += (x[dim * i + c] - y[dim * i + c]) * (x[dim * i + c] - y[dim * i + c]);
        if (all || kind[i] == TSS_NODE_FREE) most = fmax(most, s);
    }
    return sqrt(most);
}

// All solvers in turn, so that what slows the machine down slows them all.
static int repeat_step(run *r, contest *t, int step, const size_t *size) {
    for (int k = 0; k < SOLVERS; k++) t->c[k].seconds = INFINITY;
    for (int i = 0; i < r->o.repeat; i++)
        for (int k = 0; k < SOLVERS; k++) {
            contender *c = &t->c[k];
            if (i > 0 && !load_world(r, c->w, c->kept, size[k])) return 0;
            load_motions(r, t->motions);
            if (!step_world(r, c->w, step, &c->info)) return 0;
            c->seconds = fmin(c->seconds, c->info.seconds);
        }
    for (int k = 0; k < SOLVERS; k++) t->c[k].total += t->c[k].seconds;
    return 1;
}

static int compare_step(run *r, contest *t, int step) {
    tss_world *direct = t->c[DIRECT].w;
    size_t size[SOLVERS], wide = (size_t)tss_world_nodes(direct) * (size_t)tss_world_dim(direct);
    memcpy(t->x_t, tss_world_positions(direct), wide * sizeof(double));
    t->motions = save_motions(r);
    int ok = 1;
    for (int k = 1; ok && k < SOLVERS; k++) {
        tss_result e = tss_world_copy_state(t->c[k].w, direct);
        if (e != TSS_OK) ok = fail(r, "%s: %s", r->o.scene, tss_result_text(e));
    }
    for (int k = 0; ok && k < SOLVERS && r->o.repeat > 1; k++)
        t->c[k].kept = save_world(t->c[k].w, &size[k]);
    ok = ok && repeat_step(r, t, step, size);
    for (int k = 0; k < SOLVERS; k++) free(t->c[k].kept), t->c[k].kept = NULL;
    free(t->motions);
    t->motions = NULL;
    return ok;
}

static double step_error(const contest *t) {
    const tss_world *w = t->c[DIRECT].w;
    const double *full = tss_world_positions(w), *x = tss_world_positions(t->c[ADAPTIVE].w);
    double off = farthest(w, x, full, 0), way = farthest(w, full, t->x_t, 0);
    return off > 0 ? off / way : 0;
}

static double best_of(const contest *t, int total) {
    double best = INFINITY;
    for (int k = 0; k < ADAPTIVE; k++) best = fmin(best, total ? t->c[k].total : t->c[k].seconds);
    return best;
}

static void compare_row(const contest *t, int step, double error) {
    const tss_step_info *f = &t->c[DIRECT].info, *a = &t->c[ADAPTIVE].info;
    double share = a->nodes > 0 ? (double)a->enriched_nodes / a->nodes : 0;
    fprintf(
        t->csv,
        "%d,%.10g,%.10g,%.6g,%.6g,%.6g,%.6g,%.6g,%d,%d,%.6g,%d,%d,%d,%d,%d,%d,%.6g,%.6g,%s,%s\n",
        step, f->time, error, t->c[DIRECT].seconds, t->c[PCG].seconds, t->c[AUTO].seconds,
        best_of(t, 0), t->c[ADAPTIVE].seconds, a->enriched_nodes, a->nodes, share, a->active_modes,
        a->modes, f->newton, a->newton, f->contacts, a->contacts, f->residual_max, a->residual_max,
        tss_status_text(f->status), tss_status_text(a->status));
    fflush(t->csv);
    printf("%6d %10.3e %9.4f %9.4f %9.4f %8.2f%% %6d %5d %5d %8d %10.3e %10.3e\n", step, error,
           t->c[DIRECT].seconds, best_of(t, 0), t->c[ADAPTIVE].seconds, 100 * share,
           a->active_modes, f->newton, a->newton, a->contacts, f->residual_max, a->residual_max);
    fflush(stdout);
}

static int open_compare(run *r, contest *t) {
    char path[700];
    size_t wide = (size_t)tss_world_nodes(t->c[DIRECT].w) * (size_t)r->s.world.dim;
    t->x_t = (double *)need(wide, sizeof(double)), t->x_free = (double *)need(wide, sizeof(double));
    snprintf(path, sizeof path, "%s/compare.csv", r->o.out);
    t->csv = fopen(path, "w");
    if (!t->csv) return fail(r, "%s: cannot be written: %s", path, strerror(errno));
    fputs(
        "step,time,error,direct_s,pcg_s,auto_s,best_s,adaptive_s,enriched_nodes,nodes,"
        "enriched_share,active_modes,modes,newton_full,newton_adaptive,contacts_full,"
        "contacts_adaptive,residual_full,residual_adaptive,status_full,status_adaptive\n",
        t->csv);
    printf("%6s %10s %9s %9s %9s %9s %6s %5s %5s %8s %10s %10s\n", "step", "error", "direct s",
           "best s", "adaptive", "enriched", "modes", "full", "adap.", "contacts", "res. full",
           "res. adap.");
    return 1;
}

// Part 1: every step from the same state. The direct solver's way is kept where the free steps end.
static int compare_steps(run *r, contest *t) {
    tss_world *direct = t->c[DIRECT].w;
    size_t bytes = (size_t)tss_world_nodes(direct) * (size_t)r->s.world.dim * sizeof(double);
    double started = now(NULL);
    memcpy(t->x_free, tss_world_positions(direct), bytes);
    for (int k = 1; k <= t->steps; k++) {
        if (!compare_step(r, t, r->o.from + k)) return 0;
        double error = step_error(t), spent = now(NULL) - started;
        t->error = fmax(t->error, error);
        t->failed += t->c[DIRECT].info.status != TSS_STEP_CONVERGED ||
                     t->c[ADAPTIVE].info.status != TSS_STEP_CONVERGED;
        compare_row(t, r->o.from + k, error);
        if (k == t->free_steps) memcpy(t->x_free, tss_world_positions(direct), bytes);
        fprintf(stderr, "compare: step %d of %d, %.0f s, about %.0f s left\n", k, t->steps, spent,
                spent * (t->steps - k) / k);
    }
    for (int k = t->steps + 1; k <= t->free_steps; k++) {
        if (!step_world(r, direct, r->o.from + k, &t->c[DIRECT].info)) return 0;
        t->failed += t->c[DIRECT].info.status != TSS_STEP_CONVERGED;
    }
    if (t->free_steps > t->steps) memcpy(t->x_free, tss_world_positions(direct), bytes);
    return 1;
}

// Part 2: the adaptive solver's own way. start, motions: from where part 1 began.
static int compare_free(run *r, contest *t, const void *start, size_t size, void *motions,
                        double *final) {
    contender *a = &t->c[ADAPTIVE];
    if (!load_world(r, a->w, start, size)) return 0;
    load_motions(r, motions);
    for (int k = 1; k <= t->free_steps; k++) {
        if (!step_world(r, a->w, r->o.from + k, &a->info)) return 0;
        t->failed += a->info.status != TSS_STEP_CONVERGED;
        fprintf(stderr, "compare: free step %d of %d\n", k, t->free_steps);
    }
    *final = farthest(a->w, tss_world_positions(a->w), t->x_free, 1) / tss_world_diagonal(a->w);
    return 1;
}

static int compare(run *r, contest *t) {
    double final = 0;
    size_t size;
    t->steps = r->o.steps >= 0 ? r->o.steps : r->s.world.steps - r->o.from;
    t->free_steps = r->o.free_steps >= 0 ? r->o.free_steps : t->steps;
    if (t->steps < 1)
        return fail(r, "%s: --from %d leaves no step to compare (the scene has %d)", r->o.scene,
                    r->o.from, r->s.world.steps);
    if (!build_contenders(r, t) || !make_folder(r, out_folder(r)) || !run_ahead(r, t) ||
        !open_compare(r, t))
        return 0;
    void *start = save_world(t->c[ADAPTIVE].w, &size), *motions = save_motions(r);
    int ok = compare_steps(r, t) && compare_free(r, t, start, size, motions, &final);
    free(start), free(motions);
    if (!ok) return 0;
    printf("%d steps: direct %.3f s, pcg %.3f s, auto %.3f s, adaptive %.3f s; not converged: %d\n",
           t->steps, t->c[DIRECT].total, t->c[PCG].total, t->c[AUTO].total, t->c[ADAPTIVE].total,
           t->failed);
    printf("error %.4g speedup %.4g best %.4g final %.4g\n", t->error,
           t->c[DIRECT].total / t->c[ADAPTIVE].total, best_of(t, 1) / t->c[ADAPTIVE].total, final);
    return 1;
}

#include "sweep.h"
#include "neural.h"

static int command_compare(run *r) {
    contest t;
    if (r->o.sweep) return command_sweep(r);
    memset(&t, 0, sizeof t);
    int ok = read_scene(r) && compare(r, &t);
    for (int k = 0; k < SOLVERS; k++) tss_world_destroy(t.c[k].w), free(t.c[k].kept);
    if (t.csv) fclose(t.csv);
    free(t.motions), free(t.x_t), free(t.x_free);
    return !ok ? 2 : t.failed ? 3 : 0;
}

// ---------------------------------------------------------------------------------------------
// >>modes
// Each basis: a table, a contact sheet of its functions on the deformed body, and a .vtu with them.
// ---------------------------------------------------------------------------------------------

// What is drawn of a basis: a scalar function by its column of the second coordinate.
typedef struct gallery {
    tss_basis_info info;
    int body, number, shown, stride, scalar;
    double *u;  // shown × nodes × dim
} gallery;

static int open_gallery(run *r, int body, int number, gallery *g) {
    const scene_body *b = &r->s.body[body];
    int dim = r->s.world.dim, most = r->o.count > 0 ? r->o.count : 12;
    memset(g, 0, sizeof *g);
    if (tss_basis_get(r->w, b->basis[number].id, &g->info) != TSS_OK)
        return fail(r, "%s: bodies[%d].basis[%d] is not there", r->o.scene, body, number);
    g->body = body, g->number = number;
    g->scalar = g->info.modes == dim * g->info.functions;
    // Of weights times {1, X} the weights are shown.
    int weights = b->basis[number].kind == TSS_BASIS_SKINNING && g->info.blocks > 0 &&
                  g->info.functions % g->info.blocks == 0;
    g->stride = weights ? g->info.functions / g->info.blocks : 1;
    g->shown = g->info.functions / g->stride < most ? g->info.functions / g->stride : most;
    size_t wide = (size_t)b->mesh.nodes * (size_t)dim;
    g->u = (double *)need((size_t)g->shown * wide, sizeof(double));
    for (int k = 0; k < g->shown; k++) {
        int at = k * g->stride * (g->scalar ? dim : 1) + g->scalar;
        if (tss_basis_mode(r->w, b->basis[number].id, at, g->u + (size_t)k * wide) != TSS_OK)
            return fail(r, "%s: bodies[%d].basis[%d]: mode %d cannot be had", r->o.scene, body,
                        number, at);
    }
    return 1;
}

static void print_gallery(const run *r, const gallery *g) {
    const tss_basis_info *i = &g->info;
    const scene_body *b = &r->s.body[g->body];
    printf("bodies[%d].basis[%d] of %s: %s, %d nodes\n", g->body, g->number, b->name,
           scene__bases[b->basis[g->number].kind], b->mesh.nodes);
    printf("  blocks %d (%d active), functions %d, modes %d, residual %.3g, %.3f s, %.2f MB, %s\n",
           i->blocks, i->active_blocks, i->functions, i->modes, i->residual, i->seconds,
           1e-6 * (double)i->bytes, i->cached ? "cached" : "computed");
    if (i->eigenvalue) printf("  %6s %14s\n", "block", "eigenvalue");
    for (int k = 0; i->eigenvalue && k < i->blocks; k++)
        printf("  %6d %14.6g\n", k, i->eigenvalue[k]);
}

// The body moved along u by at most an eighth of its box, coloured by u: the signed value of a
// scalar function, the length of a vector. color: nodes.
static void bend(const run *r, const gallery *g, const double *u, double *x, double *color) {
    const tss_mesh *m = &r->s.body[g->body].mesh;
    int dim = r->s.world.dim;
    double lo[3], hi[3], size = 0, most = 0;
    scene__box_empty(lo, hi);
    scene__box(m->x, m->nodes, lo, hi);
    for (int c = 0; c < 3; c++) size += (hi[c] - lo[c]) * (hi[c] - lo[c]);
    for (int i = 0; i < m->nodes; i++) {
        double s = 0;
        for (int c = 0; c < dim; c++) s += u[dim * i + c] * u[dim * i + c];
        most = fmax(most, sqrt(s));
        color[i] = g->scalar ? u[dim * i + 1] : sqrt(s);
    }
    double scale = most > 0 ? 1 / most : 0;
    for (int i = 0; i < m->nodes; i++) {
        color[i] *= scale;
        for (int c = 0; c < 3; c++)
            x[3 * i + c] =
                m->x[3 * i + c] + (c < dim ? 0.125 * sqrt(size) * scale * u[dim * i + c] : 0);
    }
}

static view_camera body_camera(const run *r, int body) {
    const tss_mesh *m = &r->s.body[body].mesh;
    double lo[3], hi[3], size = 0;
    scene__box_empty(lo, hi);
    scene__box(m->x, m->nodes, lo, hi);
    for (int c = 0; c < r->s.world.dim; c++) size = fmax(size, hi[c] - lo[c]);
    for (int c = 0; c < r->s.world.dim; c++) lo[c] -= 0.15 * size, hi[c] += 0.15 * size;
    return r->s.world.dim == 2
               ? view_camera_fit_2d(lo, hi, r->s.frames.width, r->s.frames.height)
               : view_camera_fit(lo, hi, r->s.camera.azimuth, r->s.camera.elevation,
                                 r->s.camera.fov, VIEW_UP_Y, r->s.frames.width, r->s.frames.height);
}

// One picture; rgb NULL: no memory.
static view_image draw_mode(run *r, const gallery *g, const double *u) {
    const tss_mesh *m = &r->s.body[g->body].mesh;
    int flat = r->s.world.dim == 2, first = r->skin_first[g->body];
    int n = flat ? m->triangles : r->skin_first[g->body + 1] - first;
    double *x = (double *)need(4 * (size_t)m->nodes, sizeof *x), *color = x + 3 * (size_t)m->nodes;
    int *local = (int *)need(3 * (size_t)n, sizeof *local);
    view_look look = flat ? view_look_2d() : view_look_default();
    view_camera camera = body_camera(r, g->body);
    view_style style = view_style_default();
    bend(r, g, u, x, color);
    for (int k = 0; k < 3 * n; k++)
        local[k] =
            flat ? m->triangle[k] : r->skin.triangle[3 * first + k] - r->s.body[g->body].first;
    style.scalar = color, style.lo = g->scalar ? -1 : 0, style.hi = 1;
    style.map = g->scalar ? VIEW_MAP_BALANCE : VIEW_MAP_SEA, style.wire = 0.15f;
    look.ground = 0;
    view_begin(r->view, &camera, &look);
    view_add_mesh(r->view, x, m->nodes, local, n, &style);
    view_image im = view_render(r->view), small = {0, 0, NULL};
    if (im.rgb) small = view_image_shrink(&im, im.width / 2);
    free(x), free(local);
    return small;
}

static int draw_gallery(run *r, const gallery *g) {
    size_t wide = (size_t)r->s.body[g->body].mesh.nodes * (size_t)r->s.world.dim;
    view_image *im = (view_image *)need((size_t)g->shown, sizeof *im), sheet = {0, 0, NULL};
    char(*text)[60] = (char(*)[60])need((size_t)g->shown, sizeof *text), path[700];
    const char **label = (const char **)need((size_t)g->shown, sizeof *label);
    view_error why = {""};
    int ok = 1;
    for (int k = 0; ok && k < g->shown; k++) {
        im[k] = draw_mode(r, g, g->u + (size_t)k * wide);
        ok = im[k].rgb != NULL;
        snprintf(text[k], sizeof *text, "function %d", k * g->stride);
        if (g->info.eigenvalue && g->info.functions == g->stride * g->info.blocks)
            snprintf(text[k], sizeof *text, "block %d, eigenvalue %.4g", k, g->info.eigenvalue[k]);
        label[k] = text[k];
    }
    snprintf(path, sizeof path, "%s/modes_%d_%d.png", r->o.out, g->body, g->number);
    if (ok) sheet = view_image_sheet(im, g->shown, g->shown < 4 ? g->shown : 4, 6, label);
    ok = sheet.rgb != NULL && view_write_png(path, &sheet, &why);
    for (int k = 0; k < g->shown; k++) view_image_free(&im[k]);
    view_image_free(&sheet);
    free(im), free(text), free((void *)label);
    return ok ? 1 : fail(r, "%s", why.message[0] ? why.message : "out of memory for a picture");
}

static int write_gallery(run *r, const gallery *g) {
    const tss_mesh *m = &r->s.body[g->body].mesh;
    size_t wide = (size_t)m->nodes * (size_t)r->s.world.dim;
    tss_field *f = (tss_field *)need((size_t)g->shown, sizeof *f);
    char(*name)[40] = (char(*)[40])need((size_t)g->shown, sizeof *name), path[700];
    tss_io_error why;
    for (int k = 0; k < g->shown; k++) {
        snprintf(name[k], sizeof *name, "function %04d", k * g->stride);
        f[k].name = name[k], f[k].values = g->u + (size_t)k * wide;
        f[k].components = r->s.world.dim;
    }
    snprintf(path, sizeof path, "%s/modes_%d_%d.vtu", r->o.out, g->body, g->number);
    int ok = tss_mesh_write_vtu(m, m->x, path, f, g->shown, 0, &why) == TSS_OK;
    free(f), free(name);
    return ok ? 1 : fail(r, "%s: %s", why.file, why.message);
}

static int command_modes(run *r) {
    if (!read_scene(r)) return 2;
    if (!has_bases(&r->s)) return fail(r, "%s: no body has a basis", r->o.scene), 2;
    if (scene_mode(&r->s) == TSS_MODE_FULL) r->s.solver.mode = TSS_MODE_SUBSPACE;
    r->s.frames.field = SCENE_FIELD_NONE, r->png = 1, r->vtu = r->obj = 0;
    if (!build_world(r, &r->w, &r->ipc) || !make_folder(r, out_folder(r)) || !open_frames(r))
        return 2;
    for (int b = 0; b < r->s.bodies; b++)
        for (int k = 0; k < r->s.body[b].bases; k++) {
            gallery g;
            int ok = open_gallery(r, b, k, &g);
            if (ok) print_gallery(r, &g);
            ok = ok && draw_gallery(r, &g) && write_gallery(r, &g);
            free(g.u);
            if (!ok) return 2;
        }
    return 0;
}

// ---------------------------------------------------------------------------------------------
// >>main
// ---------------------------------------------------------------------------------------------

int main(int argc, char **argv) {
    static run r;
    if (argc >= 2 && strcmp(argv[1], "--version") == 0) return version();
    for (int k = 1; k < argc; k++)
        if (strcmp(argv[k], "--help") == 0 || strcmp(argv[k], "-h") == 0) return usage(stdout);
    static int (*const commands[])(run *r) = {command_run, command_check, command_compare, command_modes, command_neural};
    int which = 0;
    while (command_names[which] && argc >= 2 && strcmp(argv[1], command_names[which]) != 0) which++;
    if (argc < 2) return usage(stderr);
    if (!command_names[which]) return unknown("command", argv[1], command_names), 2;
    if (!read_options(argc, argv, which == 4 ? NEURAL : 1 << which, &r.o)) return 2;
    int code = commands[which](&r);
    if (r.why.text[0]) fprintf(stderr, "tss: %s\n", r.why.text);
    run_free(&r);
    return code;
}
