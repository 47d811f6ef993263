/* scene.h: scenes in words (for the example programs; needs cJSON)

   #define SCENE_IMPLEMENTATION    // in one .c file, after tss.h, tss_ipc.h, tss_subspace.h,
                                   // tss_io.h, tss_shapes.h
   #include "scene.h"

   scene s;
   scene_error why;
   if (!scene_read(&s, "drop.json", NULL, NULL, 0, &why)) fprintf(stderr, "%s\n", why.text);
   tss_world *w;
   tss_ipc *contact;
   if (!scene_build(&s, NULL, NULL, NULL, &w, &contact, &why)) ...   // bodies, contact, pins
   for (int k = 0; k < s.world.steps; k++) {
       scene_drive(&s, w, &why);    // targets and forces of the step to come
       tss_world_step(w, NULL);
   }
   tss_world_destroy(w);
   scene_free(&s);

   Two languages, one struct: JSON (a file whose first character is '{'), and the scripts of the IPC
   reference code (anything else). A key that is not listed here is refused by name. Lengths in
   metres, angles in degrees, y is up. Vectors are [x, y, z], in 2D also [x, y].

   KEYS OF A JSON SCENE (default)
   world.dim               2 or 3 (3)
   world.dt                time step, s (0.01)
   world.steps             number of steps (100)
   world.gravity           m/s² ([0, -9.80665, 0])
   world.integrator        bdf2 | euler | newmark | quasistatic (bdf2)
   solver.tol              stop when |d|/h is below this, m/s (0: use tol_rel)
   solver.tol_rel          the same over the diagonal of the soft bodies' box, 1/s (1e-2)
   solver.max_iterations   Newton iterates a step (2000)
   solver.linear           auto | direct | pcg (auto)
   solver.pcg_tol          relative residual of the linear solve (1e-5)
   solver.pcg_iterations   bound on its iterations (10000)
   solver.mode             adaptive | subspace | full (adaptive if a body has a basis, else full);
                           in full, bases are not made
   solver.error_nodes      below this, the oracle's error asks for no nodes (0.5)
   solver.error_modes      nor for modes (0.5)
   solver.progress         more progress than this needs no help (1e-4)
   solver.downdate         what moves less than this share of the body's diagonal a second apart
                           from its modes leaves, 1/s (0.1; 0: nothing leaves)
   solver.keep             steps that what was activated stays at least (2)
   solver.partitions       groups of nodes in all (0: one for each 100 nodes)
   solver.oracle           ring | literal (ring)
   solver.secant           bfgs | frozen | exact (bfgs)
   solver.schur            auto | pcg | direct (auto)
   solver.newton_residual  measure a full-space Newton step at the end of each step (false)
   contact.enabled         bodies and planes touch (true)
   contact.dhat            distance at which contact begins, m (0: use dhat_rel)
   contact.dhat_rel        the same over the diagonal (1e-3)
   contact.dhat_edge       with dhat_rel: at most this share of the shortest surface edge (0.5)
   contact.mu              friction where nothing else is said (0)
   contact.eps_v           slower than this sticks, m/s (0: use eps_v_rel)
   contact.eps_v_rel       the same over the diagonal, 1/s (1e-3)
   contact.kappa           barrier stiffness (0: adapts)
   contact.friction_iterations   solves a step for the lagged friction (1)
   contact.self            a body touches itself (true)
   bodies[]                soft bodies and obstacles
    .name                  for messages (mesh or shape, and number)
    .mesh                  file: .msh .mesh .node .obj .ply .seg; beside the scene, under --assets
    .shape                 instead of mesh, see below
    .scale .rotate .translate   number or vector (1); Rx Ry Rz, degrees; m. In this order
    .shell                 a surface of triangles as cloth, with `neural` alone: {thickness, m; bending:
                           k of its hinges, J (0)}
    .obstacle              its surface moves as told (false); surfaces, segments, points must be
    .material              {kind, E, nu, rho, damping}: neo_hookean | stable_neo_hookean |
                           fixed_corotated | stvk | linear (neo_hookean), Pa (1e5), (0.4),
                           kg/m³ (1000), stiffness-proportional damping time, s (0)
    .regions[]             {lower, upper, metres: as in pins; material: {E, nu, rho}}: of the cells
                           whose centroid is in the box; later ones outweigh earlier ones
    .basis                 one or a list of {kind: affine | quadratic | skinning | biharmonic |
                           eigen | pod; count: handles or modes (16); initial: blocks active from
                           the start (by kind; -1: all); heterogeneous: skinning knows the cells'
                           stiffness (false); tol: of eigenpairs (1e-8); cache: file, read if it
                           fits, else written; snapshots: of pod: files that `tss run --snapshots`
                           wrote, found as meshes are}
    .velocity .angular_velocity   at the start, m/s, and degrees/s about the middle of its box
    .pins[]                {lower, upper: box, 0..1 of the body's; metres: true: in metres;
                           axes: "xyz"; motion; release: free outside the motion's time (false)}
    .forces[]              {lower, upper, metres; force: total, N; acceleration: m/s²; start, end}
    .motion                of an obstacle, or of a whole soft body
    .mu                    friction of this body (contact.mu)
    .color                 [r, g, b], 0..1
   motion                  {velocity m/s, angular_velocity degrees/s, pivot (middle of the box),
                           start (0), end (never), keyframes}; keyframes: [{time, translate,
                           rotate: degrees, along the axis}, ...] are joined by straight lines
   shape                   {kind, ...}, then the body's scale, rotate, translate
    ball ellipsoid cylinder capsule torus cone koosh roller spikes spring anvil mushroom fist hand
    peak hull dinosaur elephant bunny
                           solids about 1 m across: cells (over 1 m), count, ratio: tss_shapes.h
    box                    lower, upper, cells (each axis), split 5 | 6; grade: last cell's size over
                           the first's, each axis (1)
    terrain                lower, upper, cells; height and wave: of its hills, m
    sheet hills            surfaces at y = 0: lower, upper, cells (x, z); hills: height, wave
    spike_sheet            lower, upper, cells, height
    ball_surface           radius, count: edges a side
    box_surface            lower, upper, cells
    cone_surface           radius, height, count: sides
    segments points        lower, upper; count: rows, cells: pieces; cells: points an axis
    rectangle disc         2D: lower, upper, cells; radius, count: rings
   planes[]                {origin ([0, 0, 0]), normal ([0, 1, 0]), mu (contact.mu)}: half-spaces
   camera                  {azimuth (30), elevation (18), fov (32, 0: parallel), zoom (1), distance
                           (0: sees everything), target (middle of the scene)}
   frames                  {size: [w, h] ([960, 640]), field: none | J | velocity | strain |
                           enriched | error | progress (enriched if adaptive, else none),
                           range: [low, high], wireframe: 0..1 (0)}
   run                     {check (false), every (1), budget_ms (0), frames: "png,vtu,obj" ("")}
   neural                  of the first body, for `tss neural` (neural.h):
    .system                supervised | unsupervised (supervised)
    .r .hidden .activation inputs of the decoder (8), widths ([200, 200]), elu | silu | softplus | gelu
    .start                 positions at the start over the rest's, each axis, about its middle (1)
    .script                what happens to the body, at random: {handles, pulls, hold: [least, most]
                           steps from target to target ([10, 20]), length: steps of a sequence (60),
                           train, test: sequences (10, 2), seed (1), stride: quasi-static, steps of
                           the script in one of a subspace (1), validate: evaluate on sequences
                           behind those of training, not on the tests (false), settle: steps that
                           full space takes alone before a subspace starts, at rest, nearest to it (0)}
     .handles[]            {lower, upper, metres: nodes, as in pins; translate, rotate: [[low x, y, z],
                           [high]], m, and degrees along the axis, about the middle of the nodes}
     .ball                 walks as handles do: {radius, m; center: [[low x, y, z], [high]], m, from low;
                           stiffness: of its penalty, N/m³; margin: m (0)}
     .pulls[]              {lower, upper, metres; force: total, N, each axis within ± this}
    .pca                   {tol: largest distance of a node over the longest side (1e-3), most (300), scale (false)}
    .train                 vanilla: {steps (20000), batch (64), rate (1e-3), rate_end (1e-5), warmup
                           (0), lambda (1), sigma (1), eps (1e-8), ramp (0), start: random | linear,
                           supervised: the networks begin as the r best modes (random)}
    .lipschitz             {steps (5000), weight (1e-3), batch (16), rate (1e-4), rate_end (1e-6),
                           warmup (0), order (2), estimator: exact | uv | u (u), probes (1), undivided
                           (false), through_encoder (true), relative: L_LS in units
                           of the spread of z, supervised (false), handles: L_LS and Eq. 7 of P with
                           handles where the frames have them, supervised (true), window: L_LS of
                           groups of frames this near under one's handles (0: off), whiten: in
                           coordinates in which the mean Hessian of the base is 1 (false), whiten_at: frames |
                           solver: at the states of this mean (frames), whiten_end: once more, by the
                           harmonic mean of the trained decoder's, supervised (false), unit: J,
                           the whitened Hessian in the z that the phase ends with (1), cubature: cells,
                           0: all (0), samples: that choose them (64)}
    .solver                of a step: {kind: bfgs | lbfgs | newton (bfgs), tol: of bfgs (1e-4), of the
                           others eps (1e-5), ftol (2.2e-9), memory (10), max_line (128), max_iterations
                           (1024), cubature: cells at run time, 0: all (0),
                           stretch: evaluate steps vanilla and linear in z times this (1)}
    .samples               of Eq. 7 (256)

   IPC SCRIPTS  time density stiffness energy timeIntegration dampingStiff dampingRatio
   turnOffGravity dHat epsv tuning fricIterAmt tol size rotateModel halfSpace ground meshCO shapes
   shapeMatrix selfCollisionOn selfCollisionOff selfFric section script; view zoom cameraTracking
   playBackSpeed warmStart constraintSolver are skipped with a warning. Differences: rotations of
   moving things are exact, not composed step by step; barrier stiffness is always found by tss.

   ERRORS  Functions return 1, or 0 and a sentence: file, key or line, and what was expected.
   MEMORY  malloc. THREADS  One scene, one thread.

   >>scene  >>scene_tools  >>scene_keys  >>scene_meshes  >>scene_bases  >>scene_json  >>scene_neural
   >>scene_script
   >>scene_snapshots  >>scene_build  >>scene_drive                                                */
#ifndef SCENE_H
#define SCENE_H

#if !defined(TSS_SUBSPACE_H) || !defined(TSS_IO_H) || !defined(TSS_SHAPES_H)
#error "include tss.h, tss_ipc.h, tss_subspace.h, tss_io.h and tss_shapes.h before scene.h"
#endif

#ifdef __cplusplus
extern "C" {
#endif

#ifndef SCENE_API
#define SCENE_API extern
#endif

// ---------------------------------------------------------------------------------------------
// >>scene (public)
// ---------------------------------------------------------------------------------------------

typedef struct scene_error {
    char text[1024];
} scene_error;

typedef struct scene_keyframe {
    double time, translate[3], rotate[3];  // s, m, rad (vector along the axis)
} scene_keyframe;

// A rigid motion: velocity · τ, and a turn of angular · τ about pivot; τ runs from start to end.
typedef struct scene_motion {
    int moves;  // 0: there is none
    double start, end, velocity[3], angular[3], pivot[3];
    int has_pivot;  // 0: the middle of the box of what moves
    scene_keyframe *keyframe;
    int keyframes;
} scene_motion;

typedef struct scene_pin {
    int *node, nodes;  // of the body
    unsigned axes;     // bit c: coordinate c
    int release;       // free before the motion's start and after its end
    scene_motion motion;
} scene_pin;

typedef struct scene_force {
    int *node, nodes;
    double force[3], acceleration[3], start, end;
} scene_force;

#define SCENE_PATH 512  // bytes of a file name

// A basis as in tss_basis_def; it is made by scene_build.
typedef struct scene_basis {
    int kind, count, heterogeneous;
    int initial;  // −2: chosen by kind
    double tol;
    char cache[SCENE_PATH];        // "": none
    char (*snapshot)[SCENE_PATH];  // files
    int snapshots;
    tss_basis id;  // after scene_build, −1: not made
} scene_basis;

typedef struct scene_body {
    char name[80];
    tss_mesh mesh;           // x: positions at the start
    double *rest;            // nodes × 3; NULL: mesh.x
    int obstacle, collider;  // collider: a script's meshCO
    tss_material material;
    double shell, bending;  // thickness, m, 0: not a shell; k of its hinges, J. For `neural` alone
    double *E, *nu, *rho;  // of each cell; NULL: material's
    scene_basis *basis;
    int bases;
    double velocity[3], angular[3], mu;  // mu < 0: contact.mu
    float color[3];                      // color[0] < 0: chosen by number
    scene_pin *pin;
    scene_force *force;
    int pins, forces;
    scene_motion motion;
    tss_body id;  // after scene_build
    int first;    // its first node in the world
} scene_body;

typedef struct scene_plane {
    double origin[3], normal[3], mu;
} scene_plane;

// Nodes that are told where to be, at random within a box of six parameters: translation, rotation.
typedef struct scene_handle {
    int *node, nodes;  // of the body
    double translate[2][3], rotate[2][3];  // low and high; m, rad
} scene_handle;

typedef struct scene_pull {
    int *node, nodes;
    double force[3];  // N, the most of each axis
} scene_pull;

#define SCENE_HIDDEN 16

typedef struct scene_neural {
    int given, unsupervised, r, hidden[SCENE_HIDDEN], layers, activation, samples;  // layers: hidden
    double start[3];
    struct {
        scene_handle *handle;
        scene_pull *pull;
        int handles, pulls, length, train, test, seed, stride, validate, settle;
        double hold[2];
        struct {  // radius 0: none
            double radius, center[2][3], stiffness, margin;
        } ball;
    } script;
    struct {
        double tol;
        int most, scale;
    } pca;
    struct {
        int steps, batch, warmup, ramp, start;
        double rate, rate_end, lambda, sigma, eps;
    } train;
    struct {
        int steps, batch, warmup, order, estimator, probes, undivided, through_encoder, relative, handles, window, cubature, samples, whiten, whiten_at, whiten_end;
        double rate, rate_end, weight, unit;
    } lipschitz;
    struct {
        int kind, memory, max_line, max_iterations, cubature;
        double tol, eps, ftol, stretch;
    } solver;
} scene_neural;

typedef enum scene_field {
    SCENE_FIELD_NONE,
    SCENE_FIELD_J,
    SCENE_FIELD_VELOCITY,
    SCENE_FIELD_STRAIN,
    SCENE_FIELD_ENRICHED,
    SCENE_FIELD_ERROR,
    SCENE_FIELD_PROGRESS,
    SCENE_FIELD_AUTO  // enriched if the scene is adaptive, else none
} scene_field;
typedef enum scene_script {
    SCENE_SCRIPT_NONE,
    SCENE_SCRIPT_FALL,
    SCENE_SCRIPT_DRAGRIGHT,
    SCENE_SCRIPT_TWIST,
    SCENE_SCRIPT_STRETCH,
    SCENE_SCRIPT_SQUASH
} scene_script;

// Nodes that move as told, and how far they have come.
typedef struct scene_driven {
    int body, count, *node;  // node: of the world
    double *from;            // count × 3: where the motion starts
    double clock;            // s moved so far
    int state;               // 0: not yet or free, 1: driven, 2: let go for good
    int release;             // free before the motion's start and after its end
    int gated;               // moves while the script's condition holds
    scene_motion motion;
} scene_driven;

typedef struct scene {
    char file[256];
    struct {
        int dim, steps, integrator;
        double dt, gravity[3];
    } world;
    struct {
        double tol, tol_rel, pcg_tol;
        int max_iterations, linear, pcg_iterations, newton_residual;
        int mode;  // tss_mode, −1: adaptive if a body has a basis, else full
        double error_nodes, error_modes, progress, downdate;
        int keep, partitions, oracle, secant, schur;
    } solver;
    struct {
        int enabled, friction_iterations, self, between;  // between: shapes touch each other
        double dhat, dhat_rel, dhat_edge, mu, eps_v, eps_v_rel, kappa;
    } contact;
    scene_body *body;
    scene_plane *plane;
    int bodies, planes;
    struct {
        double azimuth, elevation, fov, zoom, distance, target[3];
        int has_target;
    } camera;
    struct {
        int width, height, field, has_range;
        double range[2], wireframe;
    } frames;
    struct {
        int check, every;
        double budget_ms;
        char frames[40];
    } run;
    scene_script script;
    char *warnings;  // lines, or NULL
    scene_driven *driven;
    int drivens;
    char *forces_on;  // one a force, in the order of the bodies
    scene_neural neural;
} scene;

// assets: where mesh files are looked for first (NULL: beside the scene). set: "key=value" lines,
// as in "world.dt=0.02" or "bodies.0.material.E=1e6", that replace what the file says.
SCENE_API int scene_read(scene *s, const char *path, const char *assets, const char *const *set,
                         int sets, scene_error *error);
// The same from memory; name stands for the file in messages.
SCENE_API int scene_parse(scene *s, const char *name, const char *text, const char *assets,
                          const char *const *set, int sets, scene_error *error);
SCENE_API void scene_free(scene *s);  // a zeroed scene is allowed

// The mode that scene_build uses.
SCENE_API tss_mode scene_mode(const scene *s);
// A prepared world. host, on_iterate and ipc may be NULL. *out is NULL on error. A scene may be
// built several times (the worlds are alike); scene_drive then needs scene_state for each world.
SCENE_API int scene_build(scene *s, const tss_host *host,
                          void (*on_iterate)(const double *, const double *, void *), void *ctx,
                          tss_world **out, tss_ipc **ipc, scene_error *error);
// Sets the targets and forces of the step that comes next. Call it before each step.
SCENE_API int scene_drive(scene *s, tss_world *w, scene_error *error);
// How far the motions are: saved beside the world's checkpoint. Returns the bytes it takes, or 0 if
// data does not fit this scene; with data NULL only the size.
SCENE_API size_t scene_state(scene *s, void *data, size_t size, int save);
// Positions of all nodes go to a file as number `number`, ascending from 0, which starts it anew.
// bodies[].basis.snapshots reads it.
SCENE_API int scene_snapshot(const char *path, const tss_world *w, int number, scene_error *error);
// Where a motion puts a point after it has run for clock seconds.
SCENE_API void scene_pose(const scene_motion *m, double clock, const double *from, double *out);

#ifdef __cplusplus
}
#endif
#endif  // SCENE_H

#if defined(SCENE_IMPLEMENTATION) && !defined(SCENE_IMPLEMENTATION_DONE)
#define SCENE_IMPLEMENTATION_DONE

#include <cjson/cJSON.h>
#include <errno.h>
#include <limits.h>
#include <math.h>
#include <stdarg.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#ifdef __cplusplus
extern "C" {
#endif

#define SCENE__RADIAN (3.14159265358979323846 / 180)
// Half a millionth of a step: times are sums of dt.
#define SCENE__SLACK 5e-7

// ---------------------------------------------------------------------------------------------
// >>scene_tools (private)
// ---------------------------------------------------------------------------------------------

static int scene__fail(scene_error *e, const char *format, ...) {
    va_list args;
    if (!e) return 0;
    va_start(args, format);
    vsnprintf(e->text, sizeof e->text, format, args);
    va_end(args);
    return 0;
}

// Zeroed room for one more element of an array; NULL: no memory, and the array is as it was.
static void *scene__grow(void *array, int count, size_t size, scene_error *e) {
    char *p = (char *)realloc(array, ((size_t)count + 1) * size);
    if (!p) return scene__fail(e, "out of memory"), (void *)NULL;
    memset(p + (size_t)count * size, 0, size);
    return p;
}

static void scene__warn(scene *s, const char *format, ...) {
    char line[400];
    va_list args;
    va_start(args, format);
    vsnprintf(line, sizeof line, format, args);
    va_end(args);
    size_t old = s->warnings ? strlen(s->warnings) : 0, more = strlen(line) + 2;
    char *p = (char *)realloc(s->warnings, old + more);
    if (!p) return;
    snprintf(p + old, more, "%s\n", line);
    s->warnings = p;
}

static char *scene__file(const char *path, scene_error *e) {
    errno = 0;
    FILE *f = fopen(path, "rb");
    char *text = NULL;
    long size = -1;
    if (f && fseek(f, 0, SEEK_END) == 0 && (size = ftell(f)) >= 0 && size < LONG_MAX && fseek(f, 0, SEEK_SET) == 0)
        text = (char *)malloc((size_t)size + 1);
    if (text && fread(text, 1, (size_t)size, f) != (size_t)size) {
        free(text);
        text = NULL;
    }
    int why = size == LONG_MAX ? EISDIR : errno;
    if (text) text[size] = 0;
    if (f) fclose(f);
    if (!text) scene__fail(e, "%s: cannot be read%s%s, expected a scene (JSON or IPC script)", path, why ? ": " : "", why ? strerror(why) : "");
    return text;
}

// R = I + sin a K + (1 − cos a) K², K the cross product with the unit axis.
static void scene__turn(const double *angle, double *R) {
    double a = sqrt(angle[0] * angle[0] + angle[1] * angle[1] + angle[2] * angle[2]);
    double s = sin(a), c = 1 - cos(a), u[3] = {0, 0, 0};
    for (int i = 0; i < 3 && a > 0; i++) u[i] = angle[i] / a;
    for (int i = 0; i < 3; i++)
        for (int j = 0; j < 3; j++) R[3 * i + j] = (i == j ? 1 - c : 0) + c * u[i] * u[j];
    R[1] -= s * u[2], R[2] += s * u[1], R[3] += s * u[2];
    R[5] -= s * u[0], R[6] -= s * u[1], R[7] += s * u[0];
}

static void scene__box(const double *x, int n, double *lo, double *hi) {
    for (int i = 0; i < n; i++)
        for (int c = 0; c < 3; c++) {
            lo[c] = fmin(lo[c], x[3 * i + c]);
            hi[c] = fmax(hi[c], x[3 * i + c]);
        }
}

static void scene__box_empty(double *lo, double *hi) {
    for (int c = 0; c < 3; c++) lo[c] = INFINITY, hi[c] = -INFINITY;
}

static void scene__middle(const double *x, int n, double *out) {
    double lo[3], hi[3];
    scene__box_empty(lo, hi);
    scene__box(x, n, lo, hi);
    for (int c = 0; c < 3; c++) out[c] = n > 0 ? 0.5 * (lo[c] + hi[c]) : 0;
}

static void scene__key_pose(const scene_motion *m, double t, double *move, double *turn) {
    int k = 0, last = m->keyframes - 1;
    while (k < last && m->keyframe[k + 1].time <= t) k++;
    const scene_keyframe *a = &m->keyframe[k], *b = &m->keyframe[k < last ? k + 1 : k];
    double w = b->time > a->time ? (t - a->time) / (b->time - a->time) : 0;
    w = w < 0 ? 0 : w > 1 ? 1 : w;
    for (int c = 0; c < 3; c++) {
        move[c] = (1 - w) * a->translate[c] + w * b->translate[c];
        turn[c] = (1 - w) * a->rotate[c] + w * b->rotate[c];
    }
}

void scene_pose(const scene_motion *m, double clock, const double *from, double *out) {
    double move[3], turn[3], R[9], d[3];
    if (m->keyframes > 0) scene__key_pose(m, clock, move, turn);
    for (int c = 0; c < 3 && m->keyframes == 0; c++) {
        move[c] = m->velocity[c] * clock;
        turn[c] = m->angular[c] * clock;
    }
    scene__turn(turn, R);
    for (int c = 0; c < 3; c++) d[c] = from[c] - m->pivot[c];
    // Without a turn the difference to the pivot must not be rounded in.
    int turns = turn[0] != 0 || turn[1] != 0 || turn[2] != 0;
    for (int c = 0; c < 3; c++)
        out[c] = (turns ? m->pivot[c] + R[3 * c] * d[0] + R[3 * c + 1] * d[1] + R[3 * c + 2] * d[2]
                        : from[c]) +
                 move[c];
}

// ---------------------------------------------------------------------------------------------
// >>scene_keys (private)
// A table says what keys an object may have, of what type and in what range, and where they go.
// What is not in the file keeps the value it had.
// ---------------------------------------------------------------------------------------------

typedef struct scene__reader {
    scene *s;
    scene_error *error;
    const char *assets;
    char where[160];  // "bodies[2].material", for messages
} scene__reader;

typedef enum scene__type {
    SCENE__NUMBER,    // double, lo..hi
    SCENE__POSITIVE,  // double, > 0
    SCENE__COUNT,     // int, lo..hi
    SCENE__FLAG,      // true or false → int
    SCENE__VECTOR,    // 3 doubles; two numbers leave the third
    SCENE__DEGREES,   // the same, stored in radians
    SCENE__PAIR,      // 2 doubles
    SCENE__SIZE,      // 2 ints, lo..hi
    SCENE__COLOR,     // 3 floats, 0..1
    SCENE__TEXT,      // char[], hi bytes
    SCENE__WORD,      // one of words → its number, int
    SCENE__CALL       // read
} scene__type;

typedef int scene__read_fn(scene__reader *r, const cJSON *value, void *base);

typedef struct scene__key {
    const char *name;
    scene__type type;
    size_t offset;
    double lo, hi;
    const char *const *words;
    scene__read_fn *read;
} scene__key;

#define SCENE__NUM(type_, field, name, lo, hi)                                                     \
    {name, SCENE__NUMBER, offsetof(type_, field), lo, hi, NULL, NULL}
#define SCENE__POS(type_, field, name)                                                             \
    {name, SCENE__POSITIVE, offsetof(type_, field), 0, 0, NULL, NULL}
#define SCENE__INT(type_, field, name, lo, hi)                                                     \
    {name, SCENE__COUNT, offsetof(type_, field), lo, hi, NULL, NULL}
#define SCENE__OF(kind, type_, field, name) {name, kind, offsetof(type_, field), 0, 0, NULL, NULL}
#define SCENE__STR(type_, field, name, size)                                                       \
    {name, SCENE__TEXT, offsetof(type_, field), 0, size, NULL, NULL}
#define SCENE__ONE(type_, field, name, words)                                                      \
    {name, SCENE__WORD, offsetof(type_, field), 0, 0, words, NULL}
#define SCENE__FUN(name, fn) {name, SCENE__CALL, 0, 0, 0, NULL, fn}
#define SCENE__END {NULL, SCENE__NUMBER, 0, 0, 0, NULL, NULL}

static const char *const scene__integrators[] = {"bdf2", "euler", "newmark", "quasistatic", NULL};
static const char *const scene__linears[] = {"auto", "direct", "pcg", NULL};
static const char *const scene__fields[] = {"none",     "J",     "velocity", "strain",
                                            "enriched", "error", "progress", NULL};
static const char *const scene__modes[] = {"adaptive", "subspace", "full", NULL};
static const char *const scene__oracles[] = {"ring", "literal", NULL};
static const char *const scene__secants[] = {"bfgs", "frozen", "exact", NULL};
static const char *const scene__schurs[] = {"auto", "pcg", "direct", NULL};
static const char *const scene__bases[] = {"affine", "quadratic", "skinning", "biharmonic",
                                           "eigen",  "pod",       NULL};
static const char *const scene__materials[] = {
    "neo_hookean", "stable_neo_hookean", "fixed_corotated", "stvk", "linear", NULL};

// Letters to change, add or drop to make b of a, at most 99.
static int scene__distance(const char *a, const char *b) {
    int row[64], n = (int)strlen(b);
    if (n > 62 || strlen(a) > 62) return 99;
    for (int j = 0; j <= n; j++) row[j] = j;
    for (int i = 0; a[i]; i++) {
        int diagonal = row[0];
        row[0] = i + 1;
        for (int j = 0; j < n; j++) {
            int keep = diagonal + (a[i] != b[j]),
                other = 1 + (row[j] < row[j + 1] ? row[j] : row[j + 1]);
            diagonal = row[j + 1];
            row[j + 1] = keep < other ? keep : other;
        }
    }
    return row[n];
}

// ": did you mean X?" when a name is near, else the list of all; names ends with NULL.
static void scene__suggest(const char *word, const char *const *names, char *out, size_t size) {
    int best = 99;
    const char *near = NULL;
    size_t used = 0;
    for (int k = 0; names[k]; k++) {
        int d = scene__distance(word, names[k]);
        if (d < best) best = d, near = names[k];
    }
    // A third of the letters wrong is still a slip.
    if (near && 3 * best <= (int)strlen(near) + 2) {
        snprintf(out, size, "did you mean \"%s\"?", near);
        return;
    }
    used = (size_t)snprintf(out, size, "expected one of");
    for (int k = 0; names[k] && used + 1 < size; k++)
        used += (size_t)snprintf(out + used, size - used, "%s %s", k ? "," : "", names[k]);
}

// Appends ".name" or "[k]" to where; returns what to hand to scene__leave.
static size_t scene__enter(scene__reader *r, const char *name, int k) {
    size_t n = strlen(r->where);
    if (name)
        snprintf(r->where + n, sizeof r->where - n, "%s%s", n ? "." : "", name);
    else
        snprintf(r->where + n, sizeof r->where - n, "[%d]", k);
    return n;
}

static void scene__leave(scene__reader *r, size_t n) { r->where[n] = 0; }

static int scene__expected(scene__reader *r, const cJSON *v, const char *what) {
    char *got = cJSON_PrintUnformatted(v);
    if (got && strlen(got) > 60) memcpy(got + 56, "...", 4);
    scene__fail(r->error, "%s: %s is %s, expected %s", r->s->file, r->where, got ? got : "?", what);
    cJSON_free(got);
    return 0;
}

static int scene__is_number(const cJSON *v) {
    return cJSON_IsNumber(v) && isfinite(v->valuedouble);
}

static int scene__read_number(scene__reader *r, const cJSON *v, const scene__key *k, double *out) {
    char what[120];
    double d = scene__is_number(v) ? v->valuedouble : 0;
    int ok = scene__is_number(v);
    if (k->type == SCENE__POSITIVE) {
        snprintf(what, sizeof what, "a number > 0");
        ok = ok && d > 0;
    } else {
        ok = ok && d >= k->lo && d <= k->hi && (k->type != SCENE__COUNT || d == floor(d));
        snprintf(what, sizeof what, "a%s number", k->type == SCENE__COUNT ? " whole" : "");
        size_t n = strlen(what);
        if (k->hi < 1e300)
            snprintf(what + n, sizeof what - n, " from %g to %g", k->lo, k->hi);
        else if (k->lo > -1e300)
            snprintf(what + n, sizeof what - n, " >= %g", k->lo);
    }
    *out = d;
    return ok ? 1 : scene__expected(r, v, what);
}

// least..most numbers; returns how many, 0 on error.
static int scene__read_numbers(scene__reader *r, const cJSON *v, int least, int most, double *out) {
    char what[60];
    int n = cJSON_IsArray(v) ? cJSON_GetArraySize(v) : 0, ok = n >= least && n <= most;
    for (int i = 0; ok && i < n; i++) {
        const cJSON *e = cJSON_GetArrayItem(v, i);
        ok = scene__is_number(e);
        out[i] = e->valuedouble;
    }
    if (ok) return n;
    if (least == most)
        snprintf(what, sizeof what, "%d numbers in [ ]", least);
    else
        snprintf(what, sizeof what, "%d to %d numbers in [ ]", least, most);
    return scene__expected(r, v, what);
}

static int scene__read_word(scene__reader *r, const cJSON *v, const char *const *words, int *out) {
    char hint[300];
    for (int k = 0; cJSON_IsString(v) && words[k]; k++)
        if (strcmp(words[k], v->valuestring) == 0) return *out = k, 1;
    if (!cJSON_IsString(v)) return scene__expected(r, v, "a word in \" \"");
    scene__suggest(v->valuestring, words, hint, sizeof hint);
    return scene__fail(r->error, "%s: %s is \"%.60s\": %s", r->s->file, r->where, v->valuestring,
                       hint);
}

static int scene__read_text(scene__reader *r, const cJSON *v, const scene__key *k, char *out) {
    if (!cJSON_IsString(v) || strlen(v->valuestring) >= (size_t)k->hi) {
        char what[60];
        snprintf(what, sizeof what, "a text in \" \" of less than %d letters", (int)k->hi);
        return scene__expected(r, v, what);
    }
    snprintf(out, (size_t)k->hi, "%s", v->valuestring);
    return 1;
}

static int scene__read_group(scene__reader *r, const cJSON *v, const scene__key *k, char *to) {
    double n[3] = {0, 0, 0};
    if (k->type == SCENE__VECTOR || k->type == SCENE__DEGREES) {
        double *out = (double *)(void *)to, unit = k->type == SCENE__DEGREES ? SCENE__RADIAN : 1;
        int got = scene__read_numbers(r, v, 2, 3, n);
        for (int c = 0; c < got; c++) out[c] = unit * n[c];
        return got > 0;
    }
    if (!scene__read_numbers(r, v, k->type == SCENE__COLOR ? 3 : 2, k->type == SCENE__COLOR ? 3 : 2,
                             n))
        return 0;
    if (k->type == SCENE__PAIR) memcpy(to, n, 2 * sizeof *n);
    for (int c = 0; k->type == SCENE__COLOR && c < 3; c++) {
        if (!(n[c] >= 0 && n[c] <= 1)) return scene__expected(r, v, "red, green, blue from 0 to 1");
        ((float *)(void *)to)[c] = (float)n[c];
    }
    for (int c = 0; k->type == SCENE__SIZE && c < 2; c++) {
        if (!(n[c] >= k->lo && n[c] <= k->hi && n[c] == floor(n[c])))
            return scene__expected(r, v, "two whole numbers of pixels, 16 to 8192");
        ((int *)(void *)to)[c] = (int)n[c];
    }
    return 1;
}

static int scene__read_value(scene__reader *r, const cJSON *v, const scene__key *k, void *base) {
    char *to = (char *)base + k->offset;
    double d = 0;
    switch (k->type) {
        case SCENE__NUMBER:
        case SCENE__POSITIVE:
            return scene__read_number(r, v, k, (double *)(void *)to);
        case SCENE__COUNT:
            if (!scene__read_number(r, v, k, &d)) return 0;
            return *(int *)(void *)to = (int)d, 1;
        case SCENE__FLAG:
            if (!cJSON_IsBool(v)) return scene__expected(r, v, "true or false");
            return *(int *)(void *)to = cJSON_IsTrue(v) ? 1 : 0, 1;
        case SCENE__TEXT:
            return scene__read_text(r, v, k, to);
        case SCENE__WORD:
            return scene__read_word(r, v, k->words, (int *)(void *)to);
        case SCENE__CALL:
            return k->read(r, v, base);
        default:
            return scene__read_group(r, v, k, to);
    }
}

static int scene__unknown(scene__reader *r, const char *key, const scene__key *keys) {
    const char *names[48];
    char hint[500];
    int n = 0;
    for (; keys[n].name && n < 47; n++) names[n] = keys[n].name;
    names[n] = NULL;
    scene__suggest(key, names, hint, sizeof hint);
    return scene__fail(r->error, "%s: %s%s%.60s: no such key; %s", r->s->file, r->where,
                       r->where[0] ? "." : "", key, hint);
}

static int scene__read_object(scene__reader *r, const cJSON *object, const scene__key *keys,
                              void *base) {
    if (!cJSON_IsObject(object)) return scene__expected(r, object, "keys in { }");
    for (const cJSON *v = object->child; v; v = v->next) {
        const scene__key *k = keys;
        while (k->name && strcmp(k->name, v->string) != 0) k++;
        if (!k->name) return scene__unknown(r, v->string, keys);
        size_t n = scene__enter(r, v->string, 0);
        for (const cJSON *u = object->child; u != v; u = u->next)
            if (strcmp(u->string, v->string) == 0)
                return scene__fail(r->error, "%s: %s is given twice", r->s->file, r->where);
        if (!scene__read_value(r, v, k, base)) return 0;
        scene__leave(r, n);
    }
    return 1;
}

// Calls read for each element of an array.
static int scene__read_array(scene__reader *r, const cJSON *array, scene__read_fn *read,
                             void *base) {
    int i = 0;
    if (!cJSON_IsArray(array)) return scene__expected(r, array, "a list in [ ]");
    for (const cJSON *v = array->child; v; v = v->next) {
        size_t n = scene__enter(r, NULL, i++);
        if (!read(r, v, base)) return 0;
        scene__leave(r, n);
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>scene_meshes (private)
// ---------------------------------------------------------------------------------------------

typedef struct scene__shape {
    int kind, cells[3], count, split;
    double lower[3], upper[3], grade[3], ratio, radius, height, wave;
    unsigned given;  // bit k: key k of scene__shape_keys was there
} scene__shape;

typedef struct scene__hills {
    double height, wave;
} scene__hills;

static double scene__height(double x, double z, void *ctx) {
    const scene__hills *h = (const scene__hills *)ctx;
    return h->height * tss_shape_hills(x / h->wave, z / h->wave, NULL);
}

// Generated shapes that are not solids by name, and the keys each takes (bits).
enum {
    SCENE__CELLS = 1,
    SCENE__LOWER = 2,
    SCENE__UPPER = 4,
    SCENE__N = 8,
    SCENE__RATIO = 16,
    SCENE__RADIUS = 32,
    SCENE__HEIGHT = 64,
    SCENE__WAVE = 128,
    SCENE__SPLIT = 256,
    SCENE__GRADE = 512
};
#define SCENE__BOX (SCENE__LOWER | SCENE__UPPER | SCENE__CELLS)
#define SCENE__SHAPES(X)                                                                          \
    X(BOX, "box", SCENE__BOX | SCENE__SPLIT | SCENE__GRADE)                                       \
    X(TERRAIN, "terrain", SCENE__BOX | SCENE__HEIGHT | SCENE__WAVE)                               \
    X(SHEET, "sheet", SCENE__BOX)                                                                 \
    X(HILLS, "hills", SCENE__BOX | SCENE__HEIGHT | SCENE__WAVE)                                   \
    X(SPIKE_SHEET, "spike_sheet", SCENE__BOX | SCENE__HEIGHT)                                     \
    X(BALL_SURFACE, "ball_surface", SCENE__RADIUS | SCENE__N)                                     \
    X(BOX_SURFACE, "box_surface", SCENE__BOX)                                                     \
    X(CONE_SURFACE, "cone_surface", SCENE__RADIUS | SCENE__HEIGHT | SCENE__N)                     \
    X(SEGMENTS, "segments", SCENE__BOX | SCENE__N)                                                \
    X(POINTS, "points", SCENE__BOX)                                                               \
    X(RECTANGLE, "rectangle", SCENE__BOX)                                                         \
    X(DISC, "disc", SCENE__RADIUS | SCENE__N)

enum {
    SCENE__SHAPE_FIRST = TSS_SHAPE_COUNT - 1,
#define SCENE__ENUM(id, name, keys) SCENE__SHAPE_##id,
    SCENE__SHAPES(SCENE__ENUM)
#undef SCENE__ENUM
};

static const char *const scene__shape_names[] = {
#define SCENE__NAME(id, name, cells, count, ratio) name,
    TSS_SHAPES(SCENE__NAME)
#undef SCENE__NAME
#define SCENE__NAME(id, name, keys) name,
        SCENE__SHAPES(SCENE__NAME)
#undef SCENE__NAME
            NULL};

static const unsigned scene__shape_uses[] = {
#define SCENE__NAME(id, name, keys) keys,
    SCENE__SHAPES(SCENE__NAME)
#undef SCENE__NAME
};

static int scene__read_cells(scene__reader *r, const cJSON *v, void *base) {
    scene__shape *d = (scene__shape *)base;
    double n[3];
    int got = 1;
    if (scene__is_number(v))
        n[0] = v->valuedouble;
    else
        got = scene__read_numbers(r, v, 1, 3, n);
    for (int c = 0; got && c < 3; c++) {
        double k = n[c < got ? c : got - 1];
        if (!(k >= 1 && k <= 1000 && k == floor(k)))
            return scene__expected(r, v, "whole numbers from 1 to 1000");
        d->cells[c] = (int)k;
    }
    return got > 0;
}

static int scene__read_grade(scene__reader *r, const cJSON *v, void *base) {
    double *grade = ((scene__shape *)base)->grade;
    if (scene__read_numbers(r, v, 3, 3, grade) != 3) return 0;
    for (int c = 0; c < 3; c++)
        if (!(grade[c] >= 1e-3 && grade[c] <= 1e3))
            return scene__expected(r, v, "numbers from 1e-3 to 1e3");
    return 1;
}

static const scene__key scene__shape_keys[] = {
    SCENE__FUN("cells", scene__read_cells),
    SCENE__OF(SCENE__VECTOR, scene__shape, lower, "lower"),
    SCENE__OF(SCENE__VECTOR, scene__shape, upper, "upper"),
    SCENE__INT(scene__shape, count, "count", 1, 10000),
    SCENE__NUM(scene__shape, ratio, "ratio", 0, 0.5),
    SCENE__POS(scene__shape, radius, "radius"),
    SCENE__NUM(scene__shape, height, "height", 0, 1e9),
    SCENE__POS(scene__shape, wave, "wave"),
    SCENE__INT(scene__shape, split, "split", 5, 6),
    SCENE__FUN("grade", scene__read_grade),
    SCENE__ONE(scene__shape, kind, "kind", scene__shape_names),
    SCENE__END};

static int scene__read_shape(scene__reader *r, const cJSON *v, scene__shape *d) {
    memset(d, 0, sizeof *d);
    d->kind = -1, d->split = 5, d->radius = 0.5, d->height = 1, d->wave = 1, d->ratio = -1;
    for (int c = 0; c < 3; c++) d->lower[c] = -0.5, d->upper[c] = 0.5, d->grade[c] = 1;
    if (!scene__read_object(r, v, scene__shape_keys, d)) return 0;
    if (d->kind < 0) return scene__fail(r->error, "%s: %s.kind is missing", r->s->file, r->where);
    unsigned uses = d->kind < TSS_SHAPE_COUNT ? SCENE__CELLS | SCENE__N | SCENE__RATIO
                                              : scene__shape_uses[d->kind - TSS_SHAPE_COUNT];
    for (int k = 0; k < 10; k++)
        if (!(uses >> k & 1) && cJSON_GetObjectItemCaseSensitive(v, scene__shape_keys[k].name))
            return scene__fail(r->error, "%s: %s.%s has no meaning for a \"%s\"", r->s->file,
                               r->where, scene__shape_keys[k].name, scene__shape_names[d->kind]);
    for (int c = 0; c < 3 && d->cells[c] == 0; c++)
        if (d->kind >= TSS_SHAPE_COUNT) d->cells[c] = 8;
    return 1;
}

static tss_result scene__make_solid(const scene__shape *d, tss_mesh *out) {
    tss_shape_def def = tss_shape_def_default((tss_shape_kind)d->kind);
    if (d->cells[0] > 0) def.cells = d->cells[0];
    if (d->count > 0) def.count = d->count;
    if (d->ratio >= 0) def.ratio = d->ratio;
    return tss_shape_make(NULL, &def, out);
}

static tss_result scene__make_shape(const scene__shape *d, tss_mesh *out) {
    const double *lo = d->lower, *hi = d->upper, lo2[2] = {lo[0], lo[2]}, hi2[2] = {hi[0], hi[2]};
    const int *n = d->cells, count = d->count > 0 ? d->count : 8;
    scene__hills hills = {d->height, d->wave};
    switch (d->kind) {
        case SCENE__SHAPE_BOX:
            return tss_shape_box(NULL, lo, hi, n, d->split, d->grade, out);
        case SCENE__SHAPE_TERRAIN:
            return tss_shape_terrain_block(NULL, lo, hi, n, scene__height, &hills, out);
        case SCENE__SHAPE_SHEET:
            return tss_shape_grid(NULL, lo2, hi2, n[0], n[2], NULL, NULL, out);
        case SCENE__SHAPE_HILLS:
            return tss_shape_grid(NULL, lo2, hi2, n[0], n[2], scene__height, &hills, out);
        case SCENE__SHAPE_SPIKE_SHEET:
            return tss_shape_spike_sheet(NULL, lo2, hi2, n[0], n[2], d->height, out);
        case SCENE__SHAPE_BALL_SURFACE:
            return tss_shape_ball_surface(NULL, d->radius, count, out);
        case SCENE__SHAPE_BOX_SURFACE:
            return tss_shape_box_surface(NULL, lo, hi, n, out);
        case SCENE__SHAPE_CONE_SURFACE:
            return tss_shape_cone_surface(NULL, d->radius, d->height, count, out);
        case SCENE__SHAPE_SEGMENTS:
            return tss_shape_segments(NULL, lo, hi, count, n[0], out);
        case SCENE__SHAPE_POINTS:
            return tss_shape_points(NULL, lo, hi, n, out);
        case SCENE__SHAPE_RECTANGLE:
            return tss_shape_rectangle(NULL, lo, hi, n[0], n[1], out);
        case SCENE__SHAPE_DISC:
            return tss_shape_disc(NULL, d->radius, count, out);
        default:
            return scene__make_solid(d, out);
    }
}

static int scene__exists(const char *path) {
    FILE *f = fopen(path, "rb");
    if (f) fclose(f);
    return f != NULL;
}

// Under assets, beside the scene, in the folder above it, or as it stands.
static void scene__find(const scene__reader *r, const char *name, char *path, size_t size) {
    const char *slash = strrchr(r->s->file, '/');
    int dir = slash ? (int)(slash - r->s->file) : 1;
    const char *file = slash ? r->s->file : ".";
    if (name[0] != '/') {
        if (r->assets && (snprintf(path, size, "%s/%s", r->assets, name), scene__exists(path)))
            return;
        if (snprintf(path, size, "%.*s/%s", dir, file, name), scene__exists(path)) return;
        if (snprintf(path, size, "%.*s/../%s", dir, file, name), scene__exists(path)) return;
    }
    snprintf(path, size, "%s", name);
}

static int scene__load(scene__reader *r, const char *name, tss_mesh *out) {
    char path[1024];
    tss_io_error why;
    scene__find(r, name, path, sizeof path);
    if (tss_mesh_read(NULL, path, out, &why) == TSS_OK) return 1;
    if (why.line > 0)
        return scene__fail(r->error, "%s: %s: %s:%lld: %s", r->s->file, r->where, why.file,
                           why.line, why.message);
    return scene__fail(r->error, "%s: %s: %s: %s%s", r->s->file, r->where, name, why.message,
                       r->assets ? "" : " (--assets DIR says where meshes are)");
}

static int scene__less_pair(const void *a, const void *b) {
    const int *p = (const int *)a, *q = (const int *)b;
    return p[0] != q[0] ? (p[0] > q[0]) - (p[0] < q[0]) : (p[1] > q[1]) - (p[1] < q[1]);
}

// 2D: the edges that belong to one triangle only, 2 × *count nodes.
static int *scene__boundary_edges(const tss_mesh *m, int *count) {
    int n = 3 * m->triangles, kept = 0;
    int *pair = (int *)malloc(((size_t)n + 1) * 2 * sizeof *pair);
    for (int k = 0; pair && k < n; k++) {
        int a = m->triangle[k], b = m->triangle[k - k % 3 + (k + 1) % 3];
        pair[2 * k] = a < b ? a : b, pair[2 * k + 1] = a < b ? b : a;
    }
    if (pair) qsort(pair, (size_t)n, 2 * sizeof *pair, scene__less_pair);
    for (int k = 0; pair && k < n; k++) {
        int twin = (k > 0 && scene__less_pair(pair + 2 * k, pair + 2 * k - 2) == 0) ||
                   (k + 1 < n && scene__less_pair(pair + 2 * k, pair + 2 * k + 2) == 0);
        if (!twin) memmove(pair + 2 * kept++, pair + 2 * k, 2 * sizeof *pair);
    }
    *count = kept;
    return pair;
}

// 2D: replaces a mesh by its outline.
static int scene__outline(tss_mesh *m) {
    tss_mesh line;
    int count, *edge = scene__boundary_edges(m, &count);
    int ok = edge && tss_mesh_alloc(NULL, 2, m->nodes, 0, 0, count, 0, &line) == TSS_OK;
    if (ok) {
        memcpy(line.x, m->x, 3 * (size_t)m->nodes * sizeof *line.x);
        memcpy(line.edge, edge, 2 * (size_t)count * sizeof *line.edge);
        tss_mesh_free(m);
        *m = line;
    }
    free(edge);
    return ok;
}

typedef struct scene__region {
    double lower[3], upper[3];
    int metres;   // 0: 0..1 of the body's box
    int surface;  // 1: only nodes of its surface
} scene__region;

static scene__region scene__everywhere(void) {
    scene__region where;
    memset(&where, 0, sizeof where);
    for (int c = 0; c < 3; c++) where.lower[c] = -1e300, where.upper[c] = 1e300;
    return where;
}

// lo, hi: the box that the region's 0..1 stand for.
static int scene__inside(const scene__region *where, const double *lo, const double *hi,
                         const double *x) {
    for (int c = 0; c < 3; c++) {
        // Slack: 1 must select the last layer whatever the rounding of lo + 1·(hi − lo).
        double size = hi[c] - lo[c], slack = where->metres ? 0 : 1e-9 * size;
        double a = where->metres ? where->lower[c] : lo[c] + where->lower[c] * size;
        double b = where->metres ? where->upper[c] : lo[c] + where->upper[c] * size;
        if (!(x[c] >= a - slack && x[c] <= b + slack)) return 0;
    }
    return 1;
}

// The nodes of a mesh that are in a box, NULL on no memory.
static int *scene__select(const tss_mesh *m, const scene__region *where, int *count) {
    double lo[3], hi[3];
    int *node = (int *)malloc(((size_t)m->nodes + 1) * sizeof *node);
    char *on = (char *)calloc((size_t)m->nodes + 1, 1);
    tss_mesh surface;
    *count = 0;
    if (where->surface && m->tets > 0 && tss_mesh_surface(m, &surface) == TSS_OK) {
        for (int k = 0; on && k < 3 * surface.triangles; k++) on[surface.triangle[k]] = 1;
        tss_mesh_free(&surface);
    } else if (on) {
        memset(on, 1, (size_t)m->nodes);
    }
    scene__box_empty(lo, hi);
    scene__box(m->x, m->nodes, lo, hi);
    for (int i = 0; node && on && i < m->nodes; i++)
        if (on[i] && scene__inside(where, lo, hi, m->x + 3 * i)) node[(*count)++] = i;
    free(on);
    return node;
}

// ---------------------------------------------------------------------------------------------
// >>scene_bases (private)
// ---------------------------------------------------------------------------------------------

static int scene__add_snapshot(scene__reader *r, const cJSON *v, void *base) {
    scene_basis *b = (scene_basis *)base;
    if (!cJSON_IsString(v) || strlen(v->valuestring) >= SCENE_PATH / 2)
        return scene__expected(r, v, "a file name in \" \"");
    void *p = scene__grow(b->snapshot, b->snapshots, sizeof *b->snapshot, r->error);
    if (!p) return 0;
    b->snapshot = (char(*)[SCENE_PATH])p;
    scene__find(r, v->valuestring, b->snapshot[b->snapshots++], SCENE_PATH);
    return 1;
}

static int scene__read_snapshots(scene__reader *r, const cJSON *v, void *base) {
    return cJSON_IsString(v) ? scene__add_snapshot(r, v, base)
                             : scene__read_array(r, v, scene__add_snapshot, base);
}

// The first four are not for every kind.
static const scene__key scene__basis_keys[] = {
    SCENE__INT(scene_basis, count, "count", 1, 1e6),
    SCENE__OF(SCENE__FLAG, scene_basis, heterogeneous, "heterogeneous"),
    SCENE__POS(scene_basis, tol, "tol"),
    SCENE__FUN("snapshots", scene__read_snapshots),
    SCENE__INT(scene_basis, initial, "initial", -1, 1e6),
    SCENE__STR(scene_basis, cache, "cache", SCENE_PATH),
    SCENE__ONE(scene_basis, kind, "kind", scene__bases),
    SCENE__END};

// Bit k: key k above has a meaning.
static const unsigned scene__basis_uses[] = {0, 0, 1 | 2 | 4, 1, 1 | 4, 1 | 8};

static int scene__read_one_basis(scene__reader *r, const cJSON *v, void *base) {
    scene_body *b = (scene_body *)base;
    void *p = scene__grow(b->basis, b->bases, sizeof *b->basis, r->error);
    if (!p) return 0;
    b->basis = (scene_basis *)p;
    scene_basis *to = &b->basis[b->bases++];
    to->kind = to->id = -1, to->count = 16, to->initial = -2, to->tol = 1e-8;
    if (!scene__read_object(r, v, scene__basis_keys, to)) return 0;
    if (to->kind < 0) return scene__fail(r->error, "%s: %s.kind is missing", r->s->file, r->where);
    for (int k = 0; k < 4; k++)
        if (!(scene__basis_uses[to->kind] >> k & 1) &&
            cJSON_GetObjectItemCaseSensitive(v, scene__basis_keys[k].name))
            return scene__fail(r->error, "%s: %s.%s has no meaning for kind \"%s\"", r->s->file,
                               r->where, scene__basis_keys[k].name, scene__bases[to->kind]);
    if (to->kind == TSS_BASIS_POD && to->snapshots == 0)
        return scene__fail(r->error,
                           "%s: %s.snapshots is missing, expected files that "
                           "`tss run --snapshots` wrote",
                           r->s->file, r->where);
    return 1;
}

// base: a scene_body, or a raw one, which begins with it. What is given replaces what was there.
static int scene__read_basis(scene__reader *r, const cJSON *v, void *base) {
    return cJSON_IsArray(v) ? scene__read_array(r, v, scene__read_one_basis, base)
                            : scene__read_one_basis(r, v, base);
}

static int scene__check_bases(scene__reader *r, const scene_body *b) {
    if (b->obstacle && b->bases)
        return scene__fail(r->error, "%s: %s.basis: %s is an obstacle, expected a soft body",
                           r->s->file, r->where, b->name);
    for (int k = 0; k < b->bases; k++) {
        const scene_basis *p = &b->basis[k];
        int most = p->kind == TSS_BASIS_EIGEN ? r->s->world.dim * b->mesh.nodes : b->mesh.nodes;
        if (!(scene__basis_uses[p->kind] & 1) || p->kind == TSS_BASIS_POD || p->count <= most)
            continue;
        return scene__fail(r->error,
                           "%s: %s.basis[%d].count is %d, expected at most %d: %s has "
                           "%d nodes",
                           r->s->file, r->where, k, p->count, most, b->name, b->mesh.nodes);
    }
    return 1;
}

static void scene__bases_free(scene_body *b) {
    for (int k = 0; k < b->bases; k++) free(b->basis[k].snapshot);
    free(b->basis);
    b->basis = NULL, b->bases = 0;
}

// ---------------------------------------------------------------------------------------------
// >>scene_json (private)
// ---------------------------------------------------------------------------------------------

static const scene__key scene__world_keys[] = {
    SCENE__INT(scene, world.dim, "dim", 2, 3),
    SCENE__POS(scene, world.dt, "dt"),
    SCENE__INT(scene, world.steps, "steps", 0, 1e9),
    SCENE__OF(SCENE__VECTOR, scene, world.gravity, "gravity"),
    SCENE__ONE(scene, world.integrator, "integrator", scene__integrators),
    SCENE__END};

static const scene__key scene__solver_keys[] = {
    SCENE__NUM(scene, solver.tol, "tol", 0, 1e300),
    SCENE__POS(scene, solver.tol_rel, "tol_rel"),
    SCENE__INT(scene, solver.max_iterations, "max_iterations", 1, 1e9),
    SCENE__ONE(scene, solver.linear, "linear", scene__linears),
    SCENE__POS(scene, solver.pcg_tol, "pcg_tol"),
    SCENE__INT(scene, solver.pcg_iterations, "pcg_iterations", 1, 1e9),
    SCENE__OF(SCENE__FLAG, scene, solver.newton_residual, "newton_residual"),
    SCENE__ONE(scene, solver.mode, "mode", scene__modes),
    SCENE__NUM(scene, solver.error_nodes, "error_nodes", 0, 1e300),
    SCENE__NUM(scene, solver.error_modes, "error_modes", 0, 1e300),
    SCENE__NUM(scene, solver.progress, "progress", 0, 1e300),
    SCENE__NUM(scene, solver.downdate, "downdate", 0, 1e300),
    SCENE__INT(scene, solver.keep, "keep", 0, 1e9),
    SCENE__INT(scene, solver.partitions, "partitions", 0, 1e9),
    SCENE__ONE(scene, solver.oracle, "oracle", scene__oracles),
    SCENE__ONE(scene, solver.secant, "secant", scene__secants),
    SCENE__ONE(scene, solver.schur, "schur", scene__schurs),
    SCENE__END};

static const scene__key scene__contact_keys[] = {
    SCENE__OF(SCENE__FLAG, scene, contact.enabled, "enabled"),
    SCENE__NUM(scene, contact.dhat, "dhat", 0, 1e300),
    SCENE__POS(scene, contact.dhat_rel, "dhat_rel"),
    SCENE__NUM(scene, contact.dhat_edge, "dhat_edge", 0, 1e300),
    SCENE__NUM(scene, contact.mu, "mu", 0, 1e6),
    SCENE__NUM(scene, contact.eps_v, "eps_v", 0, 1e300),
    SCENE__POS(scene, contact.eps_v_rel, "eps_v_rel"),
    SCENE__NUM(scene, contact.kappa, "kappa", 0, 1e300),
    SCENE__INT(scene, contact.friction_iterations, "friction_iterations", 1, 1e6),
    SCENE__OF(SCENE__FLAG, scene, contact.self, "self"),
    SCENE__END};

static const scene__key scene__frames_keys[] = {
    {"size", SCENE__SIZE, offsetof(scene, frames.width), 16, 8192, NULL, NULL},
    SCENE__ONE(scene, frames.field, "field", scene__fields),
    SCENE__OF(SCENE__PAIR, scene, frames.range, "range"),
    SCENE__NUM(scene, frames.wireframe, "wireframe", 0, 1),
    SCENE__END};

static const scene__key scene__run_keys[] = {
    SCENE__OF(SCENE__FLAG, scene, run.check, "check"),
    SCENE__INT(scene, run.every, "every", 1, 1e9),
    SCENE__NUM(scene, run.budget_ms, "budget_ms", 0, 1e12),
    SCENE__STR(scene, run.frames, "frames", sizeof(((scene *)0)->run.frames)), SCENE__END};

static const scene__key scene__camera_keys[] = {
    SCENE__NUM(scene, camera.azimuth, "azimuth", -1e6, 1e6),
    SCENE__NUM(scene, camera.elevation, "elevation", -90, 90),
    SCENE__NUM(scene, camera.fov, "fov", 0, 150),
    SCENE__POS(scene, camera.zoom, "zoom"),
    SCENE__NUM(scene, camera.distance, "distance", 0, 1e300),
    SCENE__OF(SCENE__VECTOR, scene, camera.target, "target"),
    SCENE__END};

static const scene__key scene__keyframe_keys[] = {
    SCENE__NUM(scene_keyframe, time, "time", 0, 1e300),
    SCENE__OF(SCENE__VECTOR, scene_keyframe, translate, "translate"),
    SCENE__OF(SCENE__DEGREES, scene_keyframe, rotate, "rotate"), SCENE__END};

static int scene__read_keyframe(scene__reader *r, const cJSON *v, void *base) {
    scene_motion *m = (scene_motion *)base;
    void *p = scene__grow(m->keyframe, m->keyframes, sizeof *m->keyframe, r->error);
    if (!p) return 0;
    m->keyframe = (scene_keyframe *)p;
    scene_keyframe *k = &m->keyframe[m->keyframes++];
    if (!scene__read_object(r, v, scene__keyframe_keys, k)) return 0;
    if (m->keyframes > 1 && !(k->time > k[-1].time))
        return scene__fail(r->error, "%s: %s.time is %g, expected more than the %g before it",
                           r->s->file, r->where, k->time, k[-1].time);
    return 1;
}

static int scene__read_keyframes(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_array(r, v, scene__read_keyframe, base);
}

static const scene__key scene__motion_keys[] = {
    SCENE__OF(SCENE__VECTOR, scene_motion, velocity, "velocity"),
    SCENE__OF(SCENE__DEGREES, scene_motion, angular, "angular_velocity"),
    SCENE__OF(SCENE__VECTOR, scene_motion, pivot, "pivot"),
    SCENE__NUM(scene_motion, start, "start", 0, 1e300),
    SCENE__NUM(scene_motion, end, "end", 0, 1e300),
    SCENE__FUN("keyframes", scene__read_keyframes),
    SCENE__END};

static int scene__read_motion(scene__reader *r, const cJSON *v, scene_motion *m) {
    m->moves = 1, m->end = INFINITY;
    if (!scene__read_object(r, v, scene__motion_keys, m)) return 0;
    m->has_pivot = cJSON_GetObjectItemCaseSensitive(v, "pivot") != NULL;
    if (m->keyframes > 0)
        for (int k = 0; k < 2 + 2; k++) {
            static const char *const plain[] = {"velocity", "angular_velocity", "start", "end"};
            if (cJSON_GetObjectItemCaseSensitive(v, plain[k]))
                return scene__fail(r->error, "%s: %s.%s: keyframes already say how it moves",
                                   r->s->file, r->where, plain[k]);
        }
    return 1;
}

// A body as it stands in the file, before its mesh is made.
typedef struct scene__raw {
    scene_body b;
    char mesh[512];
    scene__shape shape;
    int has_shape;
    double scale[3], rotate[3], translate[3];
    const cJSON *pins, *forces, *regions;
} scene__raw;

typedef struct scene__box_item {  // an element of pins or forces
    scene__region where;
    char axes[8];
    int release;
    scene_motion motion;
    double force[3], acceleration[3], start, end;
} scene__box_item;

static int scene__read_raw_shape(scene__reader *r, const cJSON *v, void *base) {
    scene__raw *w = (scene__raw *)base;
    w->has_shape = 1;
    return scene__read_shape(r, v, &w->shape);
}

static int scene__read_scale(scene__reader *r, const cJSON *v, void *base) {
    scene__raw *w = (scene__raw *)base;
    int one = scene__is_number(v), got = one ? 1 : scene__read_numbers(r, v, 2, 3, w->scale);
    for (int c = 0; one && c < 3; c++) w->scale[c] = v->valuedouble;
    for (int c = 0; got && c < 3; c++)
        if (w->scale[c] == 0) return scene__expected(r, v, "numbers other than 0");
    return got > 0;
}

static const scene__key scene__material_keys[] = {
    SCENE__ONE(scene_body, material.kind, "kind", scene__materials),
    SCENE__POS(scene_body, material.E, "E"),
    SCENE__NUM(scene_body, material.nu, "nu", -0.999, 0.4999),
    SCENE__POS(scene_body, material.rho, "rho"),
    SCENE__NUM(scene_body, material.damping, "damping", 0, 1e300),
    SCENE__END};

static int scene__read_material(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__material_keys,
                              base);  // b is the first member of a raw body
}

static const scene__key scene__shell_keys[] = {
    SCENE__POS(scene_body, shell, "thickness"), SCENE__NUM(scene_body, bending, "bending", 0, 1e300), SCENE__END};

static int scene__read_shell(scene__reader *r, const cJSON *v, void *base) {
    scene_body *b = (scene_body *)base;
    if (!scene__read_object(r, v, scene__shell_keys, b)) return 0;
    return b->shell > 0 || scene__expected(r, v, "a thickness, m");
}

static int scene__read_body_motion(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_motion(r, v, &((scene_body *)base)->motion);
}

static int scene__keep_pins(scene__reader *r, const cJSON *v, void *base) {
    (void)r;
    return ((scene__raw *)base)->pins = v, 1;
}

static int scene__keep_forces(scene__reader *r, const cJSON *v, void *base) {
    (void)r;
    return ((scene__raw *)base)->forces = v, 1;
}

static int scene__keep_regions(scene__reader *r, const cJSON *v, void *base) {
    (void)r;
    return ((scene__raw *)base)->regions = v, 1;
}

static const scene__key scene__body_keys[] = {
    SCENE__STR(scene__raw, b.name, "name", sizeof(((scene_body *)0)->name)),
    SCENE__STR(scene__raw, mesh, "mesh", sizeof(((scene__raw *)0)->mesh)),
    SCENE__FUN("shape", scene__read_raw_shape),
    SCENE__FUN("scale", scene__read_scale),
    SCENE__OF(SCENE__VECTOR, scene__raw, rotate, "rotate"),
    SCENE__OF(SCENE__VECTOR, scene__raw, translate, "translate"),
    SCENE__FUN("material", scene__read_material),
    SCENE__FUN("shell", scene__read_shell),
    SCENE__OF(SCENE__VECTOR, scene__raw, b.velocity, "velocity"),
    SCENE__OF(SCENE__DEGREES, scene__raw, b.angular, "angular_velocity"),
    SCENE__FUN("pins", scene__keep_pins),
    SCENE__FUN("forces", scene__keep_forces),
    SCENE__FUN("regions", scene__keep_regions),
    SCENE__FUN("basis", scene__read_basis),
    SCENE__OF(SCENE__FLAG, scene__raw, b.obstacle, "obstacle"),
    SCENE__FUN("motion", scene__read_body_motion),
    SCENE__NUM(scene__raw, b.mu, "mu", 0, 1e6),
    SCENE__OF(SCENE__COLOR, scene__raw, b.color, "color"),
    SCENE__END};

// What may be set on a body that a script has placed.
static const scene__key scene__late_keys[] = {
    SCENE__FUN("material", scene__read_material),
    SCENE__FUN("basis", scene__read_basis),
    SCENE__OF(SCENE__VECTOR, scene_body, velocity, "velocity"),
    SCENE__OF(SCENE__DEGREES, scene_body, angular, "angular_velocity"),
    SCENE__NUM(scene_body, mu, "mu", 0, 1e6),
    SCENE__OF(SCENE__COLOR, scene_body, color, "color"),
    SCENE__END};

static int scene__read_item_motion(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_motion(r, v, &((scene__box_item *)base)->motion);
}

#define SCENE__WHERE                                                     \
    SCENE__OF(SCENE__VECTOR, scene__box_item, where.lower, "lower"),     \
        SCENE__OF(SCENE__VECTOR, scene__box_item, where.upper, "upper"), \
        SCENE__OF(SCENE__FLAG, scene__box_item, where.metres, "metres")
static const scene__key scene__pin_keys[] = {
    SCENE__WHERE, SCENE__STR(scene__box_item, axes, "axes", 8),
    SCENE__OF(SCENE__FLAG, scene__box_item, release, "release"),
    SCENE__FUN("motion", scene__read_item_motion), SCENE__END};
static const scene__key scene__force_keys[] = {
    SCENE__WHERE,
    SCENE__OF(SCENE__VECTOR, scene__box_item, force, "force"),
    SCENE__OF(SCENE__VECTOR, scene__box_item, acceleration, "acceleration"),
    SCENE__NUM(scene__box_item, start, "start", 0, 1e300),
    SCENE__NUM(scene__box_item, end, "end", 0, 1e300),
    SCENE__END};

static scene__box_item scene__item(void) {
    scene__box_item it;
    memset(&it, 0, sizeof it);
    it.where = scene__everywhere();
    it.end = INFINITY;
    snprintf(it.axes, sizeof it.axes, "xyz");
    return it;
}

static int scene__nobody(scene__reader *r, const scene_body *b) {
    return scene__fail(r->error,
                       "%s: %s: no node of %s is in this box (lower and upper are 0..1 of the "
                       "body's box unless metres is true)",
                       r->s->file, r->where, b->name);
}

static int scene__add_pin(scene_body *b, const scene__box_item *it, int *node, int nodes,
                          unsigned axes, scene_error *e) {
    void *p = scene__grow(b->pin, b->pins, sizeof *b->pin, e);
    if (!p) {
        free(node);
        return 0;
    }
    b->pin = (scene_pin *)p;
    scene_pin *to = &b->pin[b->pins++];
    to->node = node, to->nodes = nodes, to->axes = axes, to->release = it->release,
    to->motion = it->motion;
    return 1;
}

static int scene__add_force(scene_body *b, const scene__box_item *it, int *node, int nodes,
                            scene_error *e) {
    void *p = scene__grow(b->force, b->forces, sizeof *b->force, e);
    if (!p) {
        free(node);
        return 0;
    }
    b->force = (scene_force *)p;
    scene_force *to = &b->force[b->forces++];
    to->node = node, to->nodes = nodes, to->start = it->start, to->end = it->end;
    memcpy(to->force, it->force, sizeof to->force);
    memcpy(to->acceleration, it->acceleration, sizeof to->acceleration);
    return 1;
}

static int scene__read_pin(scene__reader *r, const cJSON *v, void *base) {
    scene_body *b = (scene_body *)base;
    scene__box_item it = scene__item();
    unsigned axes = 0;
    int nodes, *node;
    int ok = scene__read_object(r, v, scene__pin_keys, &it);
    for (const char *c = it.axes; ok && *c; c++)
        if (*c < 'x' || *c > 'z')
            ok = scene__fail(r->error, "%s: %s.axes is \"%s\", expected some of xyz", r->s->file,
                             r->where, it.axes);
        else
            axes |= 1u << (*c - 'x');
    node = ok ? scene__select(&b->mesh, &it.where, &nodes) : NULL;
    if (ok && node && nodes > 0) return scene__add_pin(b, &it, node, nodes, axes, r->error);
    free(it.motion.keyframe);
    free(node);
    return !ok ? 0 : node ? scene__nobody(r, b) : scene__fail(r->error, "out of memory");
}

static int scene__read_force(scene__reader *r, const cJSON *v, void *base) {
    scene_body *b = (scene_body *)base;
    scene__box_item it = scene__item();
    int nodes;
    if (!scene__read_object(r, v, scene__force_keys, &it)) return 0;
    int *node = scene__select(&b->mesh, &it.where, &nodes);
    if (node && nodes > 0) return scene__add_force(b, &it, node, nodes, r->error);
    free(node);
    return node ? scene__nobody(r, b) : scene__fail(r->error, "out of memory");
}

typedef struct scene__region_item {
    scene__region where;
    double E, nu, rho;
} scene__region_item;

static const scene__key scene__region_material_keys[] = {
    SCENE__POS(scene__region_item, E, "E"),
    SCENE__NUM(scene__region_item, nu, "nu", -0.999, 0.4999),
    SCENE__POS(scene__region_item, rho, "rho"), SCENE__END};

static int scene__read_region_material(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__region_material_keys, base);
}

static const scene__key scene__region_keys[] = {
    SCENE__OF(SCENE__VECTOR, scene__region_item, where.lower, "lower"),
    SCENE__OF(SCENE__VECTOR, scene__region_item, where.upper, "upper"),
    SCENE__OF(SCENE__FLAG, scene__region_item, where.metres, "metres"),
    SCENE__FUN("material", scene__read_region_material), SCENE__END};

// Per-cell arrays, filled with the body's material when there are none yet.
static int scene__cell_arrays(scene_body *b, int cells) {
    double **to[3] = {&b->E, &b->nu, &b->rho};
    const double all[3] = {b->material.E, b->material.nu, b->material.rho};
    for (int k = 0; k < 3; k++) {
        if (*to[k]) continue;
        *to[k] = (double *)malloc(((size_t)cells + 1) * sizeof **to[k]);
        for (int i = 0; *to[k] && i < cells; i++) (*to[k])[i] = all[k];
    }
    return b->E && b->nu && b->rho;
}

static void scene__centroid(const tss_mesh *m, const int *cell, int size, double *out) {
    for (int c = 0; c < 3; c++) out[c] = 0;
    for (int k = 0; k < size; k++)
        for (int c = 0; c < 3; c++) out[c] += m->x[3 * cell[k] + c] / size;
}

static int scene__read_region(scene__reader *r, const cJSON *v, void *base) {
    scene_body *b = (scene_body *)base;
    const tss_mesh *m = &b->mesh;
    int flat = r->s->world.dim == 2, cells = flat ? m->triangles : m->tets, found = 0;
    const int *cell = flat ? m->triangle : m->tet;
    scene__region_item it = {scene__everywhere(), b->material.E, b->material.nu, b->material.rho};
    double lo[3], hi[3], at[3];
    if (!scene__read_object(r, v, scene__region_keys, &it)) return 0;
    if (!cJSON_GetObjectItemCaseSensitive(v, "material"))
        return scene__fail(r->error, "%s: %s.material is missing", r->s->file, r->where);
    if (!scene__cell_arrays(b, cells)) return scene__fail(r->error, "out of memory");
    scene__box_empty(lo, hi);
    scene__box(m->x, m->nodes, lo, hi);
    for (int k = 0; k < cells; k++) {
        scene__centroid(m, cell + k * (flat ? 3 : 4), flat ? 3 : 4, at);
        if (!scene__inside(&it.where, lo, hi, at)) continue;
        b->E[k] = it.E, b->nu[k] = it.nu, b->rho[k] = it.rho, found++;
    }
    return found ? 1
                 : scene__fail(r->error,
                               "%s: %s: no cell of %s has its centroid in this box "
                               "(lower and upper are 0..1 of the body's box unless metres is "
                               "true)",
                               r->s->file, r->where, b->name);
}

// Makes a raw body's mesh: scale, rotate, translate; an obstacle keeps its surface only.
static int scene__body_mesh(scene__reader *r, scene__raw *w) {
    tss_mesh *m = &w->b.mesh, surface;
    double R[9] = {w->scale[0], 0, 0, 0, w->scale[1], 0, 0, 0, w->scale[2]}, zero[3] = {0, 0, 0};
    if (w->mesh[0] && w->has_shape)
        return scene__fail(r->error, "%s: %s has a mesh and a shape, expected one of them",
                           r->s->file, r->where);
    if (!w->mesh[0] && !w->has_shape)
        return scene__fail(r->error, "%s: %s has no mesh, expected \"mesh\" or \"shape\"",
                           r->s->file, r->where);
    if (w->mesh[0]) {
        if (!scene__load(r, w->mesh, m)) return 0;
    } else {
        tss_result made = scene__make_shape(&w->shape, m);
        if (made != TSS_OK)
            return scene__fail(r->error, "%s: %s.shape: %s: %s", r->s->file, r->where,
                               scene__shape_names[w->shape.kind], tss_result_text(made));
    }
    tss_mesh_transform(m, R, zero);
    tss_mesh_rotate(m, w->rotate[0], w->rotate[1], w->rotate[2]);
    tss_mesh_translate(m, w->translate[0], w->translate[1], w->translate[2]);
    if (w->b.obstacle && m->tets > 0) {
        if (tss_mesh_surface(m, &surface) != TSS_OK) return scene__fail(r->error, "out of memory");
        tss_mesh_free(m);
        *m = surface;
    }
    if (w->b.obstacle && r->s->world.dim == 2 && m->triangles > 0 && !scene__outline(m))
        return scene__fail(r->error, "out of memory");
    return tss_mesh_drop_unreferenced(m, NULL) == TSS_OK ? 1
                                                         : scene__fail(r->error, "out of memory");
}

static int scene__body_check(scene__reader *r, const scene_body *b) {
    const tss_mesh *m = &b->mesh;
    int cells = r->s->world.dim == 3 ? m->tets : m->triangles;
    if (r->s->world.dim == 2 && m->dim == 3)
        for (int i = 0; i < m->nodes; i++)
            if (m->x[3 * i + 2] != 0)
                return scene__fail(r->error, "%s: %s: node %d has z = %g, expected 0 in 2D",
                                   r->s->file, r->where, i, m->x[3 * i + 2]);
    if (b->shell > 0 && (b->obstacle || r->s->world.dim != 3 || m->tets > 0 || m->triangles == 0))
        return scene__fail(r->error, "%s: %s.shell: expected a soft surface of triangles in 3D (shape \"sheet\", or a mesh)",
                           r->s->file, r->where);
    if (!b->obstacle && cells == 0 && b->shell == 0)
        return scene__fail(
            r->error, "%s: %s: %s has no %s; surfaces and segments need \"obstacle\": true",
            r->s->file, r->where, b->name, r->s->world.dim == 3 ? "tets" : "triangles");
    if (b->obstacle && (b->pins || b->forces))
        return scene__fail(r->error, "%s: %s: an obstacle has a motion, not pins or forces",
                           r->s->file, r->where);
    return scene__check_bases(r, b);
}

static void scene__body_free(scene_body *b) {
    for (int k = 0; k < b->pins; k++) {
        free(b->pin[k].node);
        free(b->pin[k].motion.keyframe);
    }
    for (int k = 0; k < b->forces; k++) free(b->force[k].node);
    free(b->pin), free(b->force), free(b->rest), free(b->motion.keyframe);
    free(b->E), free(b->nu), free(b->rho);
    scene__bases_free(b);
    tss_mesh_free(&b->mesh);
}

// Moves b into the scene, or frees it.
static scene_body *scene__add_body(scene *s, scene_body *b, scene_error *e) {
    void *p = scene__grow(s->body, s->bodies, sizeof *s->body, e);
    if (!p) return scene__body_free(b), (scene_body *)NULL;
    s->body = (scene_body *)p;
    s->body[s->bodies] = *b;
    return &s->body[s->bodies++];
}

static void scene__body_default(scene_body *b) {
    memset(b, 0, sizeof *b);
    b->material = tss_material_default();
    b->mu = -1;
    b->color[0] = -1;
}

static int scene__read_body(scene__reader *r, const cJSON *v, void *base) {
    scene *s = (scene *)base;
    scene__raw w;
    memset(&w, 0, sizeof w);
    scene__body_default(&w.b);
    for (int c = 0; c < 3; c++) w.scale[c] = 1;
    int ok = scene__read_object(r, v, scene__body_keys, &w);
    if (ok && !w.b.name[0])
        snprintf(w.b.name, sizeof w.b.name, "%.60s %d",
                 w.has_shape ? scene__shape_names[w.shape.kind] : w.mesh, s->bodies);
    ok = ok && scene__body_mesh(r, &w);
    if (ok && w.b.obstacle && w.regions)
        ok = scene__fail(r->error, "%s: %s.regions: an obstacle has no cells", s->file, r->where);
    for (int k = 0; ok && k < 3; k++) {
        static const char *const name[] = {"pins", "forces", "regions"};
        static scene__read_fn *const read[] = {scene__read_pin, scene__read_force,
                                               scene__read_region};
        const cJSON *list = k == 0 ? w.pins : k == 1 ? w.forces : w.regions;
        size_t n = scene__enter(r, name[k], 0);
        if (list) ok = scene__read_array(r, list, read[k], &w.b);
        if (ok) scene__leave(r, n);
    }
    ok = ok && scene__body_check(r, &w.b);
    if (!ok) return scene__body_free(&w.b), 0;
    return scene__add_body(s, &w.b, r->error) != NULL;
}

static const scene__key scene__plane_keys[] = {
    SCENE__OF(SCENE__VECTOR, scene_plane, origin, "origin"),
    SCENE__OF(SCENE__VECTOR, scene_plane, normal, "normal"),
    SCENE__NUM(scene_plane, mu, "mu", 0, 1e6), SCENE__END};

static scene_plane *scene__add_plane(scene *s, scene_error *e) {
    void *p = scene__grow(s->plane, s->planes, sizeof *s->plane, e);
    if (!p) return NULL;
    s->plane = (scene_plane *)p;
    s->plane[s->planes].normal[1] = 1;
    s->plane[s->planes].mu = -1;
    return &s->plane[s->planes++];
}

// Makes the normal a unit vector; 0 if it has no direction.
static int scene__unit(double *n) {
    double l = sqrt(n[0] * n[0] + n[1] * n[1] + n[2] * n[2]);
    for (int c = 0; c < 3; c++) n[c] /= l;
    return l > 0;
}

static int scene__read_plane(scene__reader *r, const cJSON *v, void *base) {
    scene_plane *p = scene__add_plane((scene *)base, r->error);
    if (!p || !scene__read_object(r, v, scene__plane_keys, p)) return 0;
    return scene__unit(p->normal)
               ? 1
               : scene__fail(r->error, "%s: %s.normal is 0, expected a direction", r->s->file,
                             r->where);
}

static int scene__read_world(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__world_keys, base);
}
static int scene__read_solver(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__solver_keys, base);
}
static int scene__read_contact(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__contact_keys, base);
}
static int scene__read_run(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__run_keys, base);
}
static int scene__read_frames(scene__reader *r, const cJSON *v, void *base) {
    ((scene *)base)->frames.has_range |= cJSON_GetObjectItemCaseSensitive(v, "range") != NULL;
    return scene__read_object(r, v, scene__frames_keys, base);
}
static int scene__read_camera(scene__reader *r, const cJSON *v, void *base) {
    ((scene *)base)->camera.has_target |= cJSON_GetObjectItemCaseSensitive(v, "target") != NULL;
    return scene__read_object(r, v, scene__camera_keys, base);
}
static int scene__read_planes(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_array(r, v, scene__read_plane, base);
}

// A script's bodies are there already: {"0": {...}} from --set bodies.0.material.E=...
static int scene__read_bodies(scene__reader *r, const cJSON *v, void *base) {
    scene *s = (scene *)base;
    if (!cJSON_IsObject(v) || s->bodies == 0)
        return scene__read_array(r, v, scene__read_body, base);
    for (const cJSON *b = v->child; b; b = b->next) {
        char *end;
        long k = strtol(b->string, &end, 10);
        if (*end || k < 0 || k >= s->bodies)
            return scene__fail(r->error, "%s: bodies.%s: no such body, expected 0 to %d", s->file,
                               b->string, s->bodies - 1);
        size_t n = scene__enter(r, NULL, (int)k);
        if (cJSON_GetObjectItemCaseSensitive(b, "basis")) scene__bases_free(&s->body[k]);
        if (!scene__read_object(r, b, scene__late_keys, &s->body[k]) ||
            !scene__check_bases(r, &s->body[k]))
            return 0;
        scene__leave(r, n);
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>scene_neural (private)
// Read when the bodies are there: its boxes choose nodes of the first one.
// ---------------------------------------------------------------------------------------------

static const char *const scene__systems[] = {"supervised", "unsupervised", NULL};
static const char *const scene__whiten_states[] = {"frames", "solver", NULL};
static const char *const scene__net_starts[] = {"random", "linear", NULL};
static const char *const scene__activations[] = {"elu", "silu", "softplus", "gelu", NULL};
static const char *const scene__estimators[] = {"exact", "uv", "u", NULL};
// In the order of tss_reduced_method.
static const char *const scene__reduced_solvers[] = {"bfgs", "lbfgs", "newton", NULL};

typedef struct scene__handle_item {
    scene__region where;
    scene_handle h;
    scene_pull p;
} scene__handle_item;

// [[x, y, z], [x, y, z]], the first nowhere above the second.
static int scene__read_range(scene__reader *r, const cJSON *v, double unit, double out[2][3]) {
    if (!cJSON_IsArray(v) || cJSON_GetArraySize(v) != 2)
        return scene__expected(r, v, "[[low x, y, z], [high x, y, z]]");
    for (int k = 0; k < 2; k++) {
        size_t n = scene__enter(r, NULL, k);
        if (!scene__read_numbers(r, cJSON_GetArrayItem(v, k), 2, 3, out[k])) return 0;
        scene__leave(r, n);
    }
    for (int c = 0; c < 3; c++) {
        if (out[0][c] > out[1][c]) return scene__expected(r, v, "low <= high on each axis");
        out[0][c] *= unit, out[1][c] *= unit;
    }
    return 1;
}

static int scene__read_translate(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_range(r, v, 1, ((scene__handle_item *)base)->h.translate);
}
static int scene__read_rotate(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_range(r, v, SCENE__RADIAN, ((scene__handle_item *)base)->h.rotate);
}

#define SCENE__HANDLE_WHERE                                                 \
    SCENE__OF(SCENE__VECTOR, scene__handle_item, where.lower, "lower"),     \
        SCENE__OF(SCENE__VECTOR, scene__handle_item, where.upper, "upper"), \
        SCENE__OF(SCENE__FLAG, scene__handle_item, where.metres, "metres")
static const scene__key scene__handle_keys[] = {
    SCENE__HANDLE_WHERE, SCENE__FUN("translate", scene__read_translate),
    SCENE__FUN("rotate", scene__read_rotate), SCENE__END};
static const scene__key scene__pull_keys[] = {
    SCENE__HANDLE_WHERE, SCENE__OF(SCENE__VECTOR, scene__handle_item, p.force, "force"), SCENE__END};

static int *scene__handle_nodes(scene__reader *r, const cJSON *v, const scene__key *keys,
                                scene__handle_item *it, int *nodes) {
    const scene_body *b = &r->s->body[0];
    memset(it, 0, sizeof *it);
    it->where = scene__everywhere();
    if (!scene__read_object(r, v, keys, it)) return NULL;
    int *node = scene__select(&b->mesh, &it->where, nodes);
    if (node && *nodes > 0) return node;
    if (node) scene__nobody(r, b);
    if (!node) scene__fail(r->error, "out of memory");
    free(node);
    return NULL;
}

static int scene__read_handle(scene__reader *r, const cJSON *v, void *base) {
    scene_neural *n = (scene_neural *)base;
    scene__handle_item it;
    int nodes, *node = scene__handle_nodes(r, v, scene__handle_keys, &it, &nodes);
    void *p = node ? scene__grow(n->script.handle, n->script.handles, sizeof *n->script.handle, r->error) : NULL;
    if (!p) return free(node), 0;
    n->script.handle = (scene_handle *)p;
    it.h.node = node, it.h.nodes = nodes;
    n->script.handle[n->script.handles++] = it.h;
    return 1;
}

static int scene__read_pull(scene__reader *r, const cJSON *v, void *base) {
    scene_neural *n = (scene_neural *)base;
    scene__handle_item it;
    int nodes, *node = scene__handle_nodes(r, v, scene__pull_keys, &it, &nodes);
    void *p = node ? scene__grow(n->script.pull, n->script.pulls, sizeof *n->script.pull, r->error) : NULL;
    if (!p) return free(node), 0;
    n->script.pull = (scene_pull *)p;
    it.p.node = node, it.p.nodes = nodes;
    n->script.pull[n->script.pulls++] = it.p;
    return 1;
}

static int scene__read_handles(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_array(r, v, scene__read_handle, base);
}
static int scene__read_pulls(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_array(r, v, scene__read_pull, base);
}

static int scene__read_hidden(scene__reader *r, const cJSON *v, void *base) {
    scene_neural *n = (scene_neural *)base;
    double width[SCENE_HIDDEN];
    n->layers = scene__read_numbers(r, v, 1, SCENE_HIDDEN, width);
    for (int k = 0; k < n->layers; k++) {
        n->hidden[k] = (int)width[k];
        if (!(width[k] >= 1 && width[k] <= 1e5 && width[k] == floor(width[k])))
            return scene__expected(r, v, "whole numbers from 1 to 100000 in [ ]");
    }
    return n->layers > 0;
}

static int scene__read_ball_center(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_range(r, v, 1, ((scene_neural *)base)->script.ball.center);
}
static const scene__key scene__ball_keys[] = {
    SCENE__POS(scene_neural, script.ball.radius, "radius"),
    SCENE__FUN("center", scene__read_ball_center),
    SCENE__POS(scene_neural, script.ball.stiffness, "stiffness"),
    SCENE__NUM(scene_neural, script.ball.margin, "margin", 0, 1e300),
    SCENE__END};
static int scene__read_ball(scene__reader *r, const cJSON *v, void *base) {
    const scene_neural *n = (const scene_neural *)base;
    if (!scene__read_object(r, v, scene__ball_keys, base)) return 0;
    return (n->script.ball.radius > 0 && n->script.ball.stiffness > 0) || scene__expected(r, v, "a radius, m, and a stiffness, N/m\xc2\xb3");
}

static const scene__key scene__script_keys[] = {
    SCENE__FUN("ball", scene__read_ball),
    SCENE__FUN("handles", scene__read_handles),
    SCENE__FUN("pulls", scene__read_pulls),
    SCENE__OF(SCENE__PAIR, scene_neural, script.hold, "hold"),
    SCENE__INT(scene_neural, script.length, "length", 1, 1e6),
    SCENE__INT(scene_neural, script.train, "train", 1, 1e6),
    SCENE__INT(scene_neural, script.test, "test", 1, 1e6),
    SCENE__INT(scene_neural, script.seed, "seed", 0, 1e9),
    SCENE__INT(scene_neural, script.stride, "stride", 1, 1e6),
    SCENE__OF(SCENE__FLAG, scene_neural, script.validate, "validate"),
    SCENE__INT(scene_neural, script.settle, "settle", 0, 1e6),
    SCENE__END};
static const scene__key scene__pca_keys[] = {
    SCENE__POS(scene_neural, pca.tol, "tol"), SCENE__INT(scene_neural, pca.most, "most", 1, 2000),
    SCENE__OF(SCENE__FLAG, scene_neural, pca.scale, "scale"), SCENE__END};
static const scene__key scene__train_keys[] = {
    SCENE__ONE(scene_neural, train.start, "start", scene__net_starts),
    SCENE__INT(scene_neural, train.steps, "steps", 1, 1e9),
    SCENE__INT(scene_neural, train.batch, "batch", 2, 1e5),
    SCENE__POS(scene_neural, train.rate, "rate"),
    SCENE__POS(scene_neural, train.rate_end, "rate_end"),
    SCENE__INT(scene_neural, train.warmup, "warmup", 0, 1e9),
    SCENE__NUM(scene_neural, train.lambda, "lambda", 0, 1e300),
    SCENE__POS(scene_neural, train.sigma, "sigma"),
    SCENE__NUM(scene_neural, train.eps, "eps", 0, 1),
    SCENE__INT(scene_neural, train.ramp, "ramp", 0, 1e9),
    SCENE__END};
static const scene__key scene__lipschitz_keys[] = {
    SCENE__INT(scene_neural, lipschitz.steps, "steps", 1, 1e9),
    SCENE__INT(scene_neural, lipschitz.batch, "batch", 2, 1e5),
    SCENE__NUM(scene_neural, lipschitz.weight, "weight", 0, 1e300),
    SCENE__POS(scene_neural, lipschitz.rate, "rate"),
    SCENE__POS(scene_neural, lipschitz.rate_end, "rate_end"),
    SCENE__INT(scene_neural, lipschitz.warmup, "warmup", 0, 1e9),
    SCENE__INT(scene_neural, lipschitz.order, "order", 0, 2),
    SCENE__ONE(scene_neural, lipschitz.estimator, "estimator", scene__estimators),
    SCENE__INT(scene_neural, lipschitz.probes, "probes", 1, 1000),
    SCENE__OF(SCENE__FLAG, scene_neural, lipschitz.undivided, "undivided"),
    SCENE__OF(SCENE__FLAG, scene_neural, lipschitz.through_encoder, "through_encoder"),
    SCENE__OF(SCENE__FLAG, scene_neural, lipschitz.relative, "relative"),
    SCENE__OF(SCENE__FLAG, scene_neural, lipschitz.handles, "handles"),
    SCENE__INT(scene_neural, lipschitz.window, "window", 0, 1e6),
    SCENE__OF(SCENE__FLAG, scene_neural, lipschitz.whiten, "whiten"),
    SCENE__OF(SCENE__FLAG, scene_neural, lipschitz.whiten_end, "whiten_end"),
    SCENE__ONE(scene_neural, lipschitz.whiten_at, "whiten_at", scene__whiten_states),
    SCENE__NUM(scene_neural, lipschitz.unit, "unit", 1e-9, 1e9),
    SCENE__INT(scene_neural, lipschitz.cubature, "cubature", 0, 1e6),
    SCENE__INT(scene_neural, lipschitz.samples, "samples", 1, 1e5),
    SCENE__END};
static const scene__key scene__reduced_keys[] = {
    SCENE__ONE(scene_neural, solver.kind, "kind", scene__reduced_solvers),
    SCENE__NUM(scene_neural, solver.tol, "tol", 0, 1),
    SCENE__NUM(scene_neural, solver.eps, "eps", 0, 1e300),
    SCENE__NUM(scene_neural, solver.ftol, "ftol", 0, 1),
    SCENE__INT(scene_neural, solver.memory, "memory", 1, 64),
    SCENE__INT(scene_neural, solver.max_line, "max_line", 1, 1e6),
    SCENE__INT(scene_neural, solver.max_iterations, "max_iterations", 1, 1e9),
    SCENE__INT(scene_neural, solver.cubature, "cubature", 0, 1e6),
    SCENE__NUM(scene_neural, solver.stretch, "stretch", 1e-6, 1e6),
    SCENE__END};

static int scene__read_script_of(scene__reader *r, const cJSON *v, void *base) {
    const scene_neural *n = (const scene_neural *)base;
    if (!scene__read_object(r, v, scene__script_keys, base)) return 0;
    return n->script.hold[0] >= 1 && n->script.hold[0] <= n->script.hold[1]
               ? 1
               : scene__expected(r, v, "hold: [least, most] steps, 1 <= least <= most");
}
static int scene__read_pca(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__pca_keys, base);
}
static int scene__read_train(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__train_keys, base);
}
static int scene__read_lipschitz(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__lipschitz_keys, base);
}
static int scene__read_reduced(scene__reader *r, const cJSON *v, void *base) {
    return scene__read_object(r, v, scene__reduced_keys, base);
}

static const scene__key scene__neural_keys[] = {
    SCENE__ONE(scene_neural, unsupervised, "system", scene__systems),
    SCENE__INT(scene_neural, r, "r", 1, 1000),
    SCENE__FUN("hidden", scene__read_hidden),
    SCENE__ONE(scene_neural, activation, "activation", scene__activations),
    SCENE__OF(SCENE__VECTOR, scene_neural, start, "start"),
    SCENE__FUN("script", scene__read_script_of),
    SCENE__FUN("pca", scene__read_pca),
    SCENE__FUN("train", scene__read_train),
    SCENE__FUN("lipschitz", scene__read_lipschitz),
    SCENE__FUN("solver", scene__read_reduced),
    SCENE__INT(scene_neural, samples, "samples", 2, 1e5),
    SCENE__END};

static void scene__neural_defaults(scene_neural *n) {
    n->r = 8, n->hidden[0] = n->hidden[1] = 200, n->layers = 2, n->samples = 256;
    for (int c = 0; c < 3; c++) n->start[c] = 1;
    n->script.hold[0] = 10, n->script.hold[1] = 20;
    n->script.length = 60, n->script.train = 10, n->script.test = 2, n->script.seed = n->script.stride = 1;
    n->pca.tol = 1e-3, n->pca.most = 300;
    n->train.steps = 20000, n->train.batch = 64, n->train.rate = 1e-3, n->train.rate_end = 1e-5;
    n->train.lambda = n->train.sigma = 1, n->train.eps = 1e-8;
    n->lipschitz.steps = 5000, n->lipschitz.batch = 16, n->lipschitz.rate = 1e-4;
    n->lipschitz.rate_end = 1e-6, n->lipschitz.weight = 1e-3, n->lipschitz.order = 2;
    n->lipschitz.estimator = 2, n->lipschitz.probes = 1, n->lipschitz.through_encoder = 1;
    n->lipschitz.samples = 64, n->lipschitz.handles = 1, n->lipschitz.unit = 1;
    n->solver.tol = 1e-4, n->solver.eps = 1e-5, n->solver.ftol = 2.2e-9;
    n->solver.stretch = 1, n->solver.memory = 10, n->solver.max_line = 128, n->solver.max_iterations = 1024;
}

static int scene__read_neural(scene__reader *r, const cJSON *v) {
    scene *s = r->s;
    scene_neural *n = &s->neural;
    size_t at = scene__enter(r, "neural", 0);
    if (s->bodies == 0)
        return scene__fail(r->error, "%s: neural: expected a body in bodies[]", s->file);
    scene__neural_defaults(n);
    n->given = 1;
    if (!scene__read_object(r, v, scene__neural_keys, n)) return 0;
    scene__leave(r, at);
    // Nodes were chosen by the rest shape; then the body is put where it starts.
    scene_body *b = &s->body[0];
    double mid[3];
    size_t count = 3 * (size_t)b->mesh.nodes;
    if (b->rest || (n->start[0] == 1 && n->start[1] == 1 && n->start[2] == 1)) return 1;
    b->rest = (double *)malloc(count * sizeof(double) + 1);
    if (!b->rest) return scene__fail(r->error, "out of memory");
    memcpy(b->rest, b->mesh.x, count * sizeof(double));
    scene__middle(b->rest, b->mesh.nodes, mid);
    for (size_t i = 0; i < count; i++)
        b->mesh.x[i] = mid[i % 3] + n->start[i % 3] * (b->rest[i] - mid[i % 3]);
    return 1;
}

static int scene__keep_neural(scene__reader *r, const cJSON *v, void *base) {
    (void)r, (void)v, (void)base;
    return 1;
}

static const scene__key scene__root_keys[] = {SCENE__FUN("world", scene__read_world),
                                              SCENE__FUN("solver", scene__read_solver),
                                              SCENE__FUN("contact", scene__read_contact),
                                              SCENE__FUN("bodies", scene__read_bodies),
                                              SCENE__FUN("planes", scene__read_planes),
                                              SCENE__FUN("camera", scene__read_camera),
                                              SCENE__FUN("frames", scene__read_frames),
                                              SCENE__FUN("run", scene__read_run),
                                              SCENE__FUN("neural", scene__keep_neural),
                                              SCENE__END};

// world.dim decides how bodies are read, wherever it stands in the file.
static int scene__read_root(scene__reader *r, const cJSON *root) {
    const cJSON *world = cJSON_GetObjectItemCaseSensitive(root, "world");
    const cJSON *dim = world ? cJSON_GetObjectItemCaseSensitive(world, "dim") : NULL;
    if (dim && cJSON_IsNumber(dim) && dim->valueint == 2) r->s->world.dim = 2;
    if (!scene__read_object(r, root, scene__root_keys, r->s)) return 0;
    const cJSON *neural = cJSON_GetObjectItemCaseSensitive(root, "neural");
    for (int k = 0; k < r->s->bodies; k++)
        if (r->s->body[k].shell > 0 && (!neural || k > 0))
            return scene__fail(r->error, "%s: bodies[%d].shell: expected on the first body of a scene with \"neural\"", r->s->file, k);
    return neural ? scene__read_neural(r, neural) : 1;
}

// The member or element that `name` stands for; made if there is none.
static cJSON *scene__member(cJSON *at, const char *name) {
    if (cJSON_IsArray(at)) {
        char *end;
        long k = strtol(name, &end, 10);
        return *end || k < 0 ? NULL : cJSON_GetArrayItem(at, (int)k);
    }
    cJSON *m = cJSON_GetObjectItemCaseSensitive(at, name);
    return m ? m : cJSON_IsObject(at) ? cJSON_AddObjectToObject(at, name) : NULL;
}

// Puts one "a.b.2.c=value" into the tree. A value that is no JSON is a text.
static int scene__set(cJSON *root, const char *line, const char *file, scene_error *e) {
    char path[200];
    const char *equals = strchr(line, '=');
    if (!equals || equals == line || (size_t)(equals - line) >= sizeof path)
        return scene__fail(e, "--set %s: expected key=value, as in world.dt=0.02", line);
    memcpy(path, line, (size_t)(equals - line));
    path[equals - line] = 0;
    cJSON *at = root;
    char *name = path, *dot;
    for (; at && (dot = strchr(name, '.')) != NULL; name = dot + 1) {
        *dot = 0;
        at = scene__member(at, name);
    }
    if (!at || !(cJSON_IsObject(at) || cJSON_IsArray(at)))
        return scene__fail(e, "%s: --set %s: there is no such place", file, line);
    cJSON *value = cJSON_Parse(equals + 1);
    if (!value) value = cJSON_CreateString(equals + 1);
    if (cJSON_IsArray(at)) {
        char *end;
        long k = strtol(name, &end, 10);
        if (!*end && k >= 0 && cJSON_ReplaceItemInArray(at, (int)k, value)) return 1;
        cJSON_Delete(value);
        return scene__fail(e, "%s: --set %s: there is no such element", file, line);
    }
    cJSON_DeleteItemFromObjectCaseSensitive(at, name);
    return cJSON_AddItemToObject(at, name, value) ? 1 : scene__fail(e, "out of memory");
}

static int scene__line_of(const char *text, const char *at) {
    int line = 1;
    for (const char *c = text; c < at && *c; c++) line += *c == '\n';
    return line;
}

static cJSON *scene__tree(const char *name, const char *text, const char *const *set, int sets,
                          scene_error *e) {
    const char *end = NULL;
    cJSON *root = text ? cJSON_ParseWithOpts(text, &end, 1) : cJSON_CreateObject();
    if (!root) {
        scene__fail(e, "%s:%d: this is not JSON, near \"%.20s\"", name, scene__line_of(text, end),
                    end ? end : "");
        return NULL;
    }
    for (int k = 0; k < sets; k++)
        if (!scene__set(root, set[k], name, e)) {
            cJSON_Delete(root);
            return NULL;
        }
    return root;
}

// ---------------------------------------------------------------------------------------------
// >>scene_script (private)
// The scripts of the IPC reference code: a line is a word and its arguments. Shapes are placed
// when the whole file is known (rotateModel, size, then the named script).
// ---------------------------------------------------------------------------------------------

#define SCENE__WORDS 64

typedef struct scene__ipc {
    scene__reader r;
    const char *at;  // what is left of the text
    int line, words;
    char text[1024], *word[SCENE__WORDS];
    double duration, density, E, nu, size, axis[3], degrees, damping_stiff, damping_ratio, beta;
    int energy;  // a scene__materials number
} scene__ipc;

static int scene__script_fail(scene__ipc *p, const char *what) {
    return scene__fail(p->r.error, "%s:%d: %s: %s", p->r.s->file, p->line,
                       p->words ? p->word[0] : "end of file", what);
}

// Splits the next line that has a word; 0 at the end of the text.
static int scene__next_line(scene__ipc *p) {
    for (p->words = 0; p->words == 0 && *p->at;) {
        size_t n = strcspn(p->at, "\n"), keep = n < sizeof p->text - 1 ? n : sizeof p->text - 1;
        memcpy(p->text, p->at, keep);
        p->text[keep] = 0;
        p->text[strcspn(p->text, "#")] = 0;
        p->at += n + (p->at[n] == '\n');
        p->line++;
        for (char *c = p->text + strspn(p->text, " \t\r"); *c && p->words < SCENE__WORDS;) {
            p->word[p->words++] = c;
            c += strcspn(c, " \t\r");
            if (*c) *c++ = 0;
            c += strspn(c, " \t\r");
        }
    }
    return p->words > 0;
}

// n numbers from word `from` on.
static int scene__numbers(scene__ipc *p, int from, int n, double *out) {
    char what[160];
    for (int k = 0; k < n; k++) {
        const char *w = from + k < p->words ? p->word[from + k] : "";
        if (*w == '+') w++;
        if (tss_parse_double(w, strlen(w), &out[k]) == TSS_OK) continue;
        snprintf(what, sizeof what, "argument %d is \"%.40s\", expected a number", from + k, w);
        return scene__script_fail(p, what);
    }
    return 1;
}

// The numbers that follow, on this line or on later ones.
static int scene__more_numbers(scene__ipc *p, int n, double *out) {
    int k = 2, line_words = p->words;
    for (int i = 0; i < n; i++, k++) {
        if (k >= line_words) {
            if (!scene__next_line(p)) return scene__script_fail(p, "expected more numbers");
            k = 0, line_words = p->words;
        }
        if (!scene__numbers(p, k, 1, &out[i])) return 0;
    }
    return 1;
}

static int scene__do_energy(scene__ipc *p) {
    const char *w = p->words > 1 ? p->word[1] : "";
    p->energy = strcmp(w, "FCR") == 0 ? TSS_FIXED_COROTATED : TSS_NEO_HOOKEAN;
    return p->energy || strcmp(w, "NH") == 0 ? 1 : scene__script_fail(p, "expected NH or FCR");
}

static int scene__do_time(scene__ipc *p) {
    double v[2];
    if (!scene__numbers(p, 1, 2, v)) return 0;
    if (!(v[0] >= 0 && v[1] > 0))
        return scene__script_fail(p, "expected duration >= 0 and step > 0");
    p->duration = v[0], p->r.s->world.dt = v[1];
    return 1;
}

static int scene__do_density(scene__ipc *p) {
    if (!scene__numbers(p, 1, 1, &p->density)) return 0;
    return p->density > 0 ? 1 : scene__script_fail(p, "expected a density > 0");
}

static int scene__do_stiffness(scene__ipc *p) {
    double v[2];
    if (!scene__numbers(p, 1, 2, v)) return 0;
    p->E = v[0], p->nu = v[1];
    return v[0] > 0 && v[1] > -1 && v[1] < 0.5
               ? 1
               : scene__script_fail(p, "expected E > 0 and -1 < nu < 0.5");
}

static int scene__do_integration(scene__ipc *p) {
    double v[2] = {0.25, 0.5};
    const char *w = p->words > 1 ? p->word[1] : "";
    if (strcmp(w, "BE") == 0) return p->r.s->world.integrator = TSS_IMPLICIT_EULER, 1;
    if (strcmp(w, "NM") != 0) return scene__script_fail(p, "expected BE or NM");
    p->r.s->world.integrator = TSS_NEWMARK;
    if (p->words > 2 && !scene__numbers(p, 2, 2, v)) return 0;
    return v[0] == 0.25 && v[1] == 0.5
               ? 1
               : scene__script_fail(p, "only beta = 0.25, gamma = 0.5 can be had");
}

static int scene__do_damping_stiff(scene__ipc *p) {
    if (!scene__numbers(p, 1, 1, &p->damping_stiff)) return 0;
    return p->damping_stiff = fmax(p->damping_stiff, 0), 1;
}

static int scene__do_damping_ratio(scene__ipc *p) {
    if (!scene__numbers(p, 1, 1, &p->damping_ratio)) return 0;
    return p->damping_ratio = fmin(fmax(p->damping_ratio, 0), 1), 1;
}

static int scene__do_no_gravity(scene__ipc *p) { return p->r.s->world.gravity[1] = 0, 1; }

static int scene__positive(scene__ipc *p, double *to) {
    if (!scene__numbers(p, 1, 1, to)) return 0;
    return *to > 0 ? 1 : scene__script_fail(p, "expected a number > 0");
}

static int scene__do_dhat(scene__ipc *p) { return scene__positive(p, &p->r.s->contact.dhat_rel); }
static int scene__do_epsv(scene__ipc *p) { return scene__positive(p, &p->r.s->contact.eps_v_rel); }

// Numbers: stiffness (found by tss instead), dhat, its end, an epsilon, epsv, its end.
static int scene__do_tuning(scene__ipc *p) {
    double v[16] = {0}, n;
    if (!scene__numbers(p, 1, 1, &n)) return 0;
    if (!(n >= 0 && n <= 16 && n == floor(n)))
        return scene__script_fail(p, "expected a count up to 16");
    if (!scene__more_numbers(p, (int)n, v)) return 0;
    if (n > 1 && v[1] > 0) p->r.s->contact.dhat_rel = v[1];
    if (n > 4 && v[4] > 0) p->r.s->contact.eps_v_rel = v[4];
    return 1;
}

static int scene__do_tol(scene__ipc *p) {
    double v[16] = {0}, n;
    if (!scene__numbers(p, 1, 1, &n)) return 0;
    if (!(n >= 0 && n <= 16 && n == floor(n)))
        return scene__script_fail(p, "expected a count up to 16");
    if (!scene__more_numbers(p, (int)n, v)) return 0;
    if (n > 0 && !(v[0] > 0)) return scene__script_fail(p, "expected a tolerance > 0");
    if (n > 0) p->r.s->solver.tol_rel = v[0];
    return 1;
}

static int scene__do_friction_iterations(scene__ipc *p) {
    double n;
    if (!scene__numbers(p, 1, 1, &n)) return 0;
    // 0 means until it settles; a hundred solves are as good.
    return p->r.s->contact.friction_iterations = n > 0 ? (int)fmin(n, 1e6) : 100, 1;
}

static int scene__do_size(scene__ipc *p) { return scene__numbers(p, 1, 1, &p->size); }

static int scene__do_rotate(scene__ipc *p) {
    double v[4];
    if (!scene__numbers(p, 1, 4, v)) return 0;
    memcpy(p->axis, v, sizeof p->axis);
    p->degrees = v[3];
    return scene__unit(p->axis) ? 1 : scene__script_fail(p, "the axis is 0");
}

static int scene__do_half_space(scene__ipc *p) {
    double v[8];
    if (!scene__numbers(p, 1, 8, v)) return 0;
    scene_plane *h = scene__add_plane(p->r.s, p->r.error);
    if (!h) return 0;
    for (int c = 0; c < 3; c++) h->origin[c] = v[c], h->normal[c] = v[3 + c];
    h->mu = v[7];
    return scene__unit(h->normal) && h->mu >= 0
               ? 1
               : scene__script_fail(p, "expected a normal and friction >= 0");
}

static int scene__do_ground(scene__ipc *p) {
    double v[2];
    if (!scene__numbers(p, 1, 2, v)) return 0;
    scene_plane *h = scene__add_plane(p->r.s, p->r.error);
    if (!h) return 0;
    h->origin[1] = v[1], h->mu = v[0];
    return h->mu >= 0 ? 1 : scene__script_fail(p, "expected friction >= 0");
}

static int scene__do_self_on(scene__ipc *p) {
    return p->r.s->contact.self = p->r.s->contact.between = 1;
}
static int scene__do_self_off(scene__ipc *p) {
    return p->r.s->contact.self = p->r.s->contact.between = 0, 1;
}

static int scene__do_self_friction(scene__ipc *p) {
    double mu;
    if (!scene__numbers(p, 1, 1, &mu)) return 0;
    return p->r.s->contact.mu = fmax(mu, 0), 1;
}

static void scene__body_named(scene__ipc *p, scene_body *b, const char *path) {
    const char *slash = strrchr(path, '/');
    scene__body_default(b);
    snprintf(b->name, sizeof b->name, "%.60s %d", slash ? slash + 1 : path, p->r.s->bodies);
}

static int scene__body_load(scene__ipc *p, scene_body *b, const char *path) {
    snprintf(p->r.where, sizeof p->r.where, "line %d", p->line);
    if (!scene__load(&p->r, path, &b->mesh)) return 0;
    p->r.where[0] = 0;
    return 1;
}

// meshCO file origin(3) scale stiffness friction [rotate x y z]: about its vertices' mean, largest
// extent `scale`, mean moved to origin.
static int scene__do_collider(scene__ipc *p) {
    double v[6], turn[3] = {0, 0, 0}, mean[3] = {0, 0, 0}, lo[3], hi[3], size = 0;
    scene_body b;
    if (p->words < 2) return scene__script_fail(p, "expected a file");
    if (!scene__numbers(p, 2, 6, v)) return 0;
    if (p->words > 8 && strcmp(p->word[8], "rotate") == 0 && !scene__numbers(p, 9, 3, turn))
        return 0;
    if (!(v[3] > 0 && v[5] >= 0))
        return scene__script_fail(p, "expected scale > 0 and friction >= 0");
    scene__body_named(p, &b, p->word[1]);
    if (!scene__body_load(p, &b, p->word[1])) return 0;
    b.obstacle = b.collider = 1, b.mu = v[5];
    scene__box_empty(lo, hi);
    scene__box(b.mesh.x, b.mesh.nodes, lo, hi);
    for (int i = 0; i < b.mesh.nodes; i++)
        for (int c = 0; c < 3; c++) mean[c] += b.mesh.x[3 * i + c] / b.mesh.nodes;
    for (int c = 0; c < 3; c++) size = fmax(size, hi[c] - lo[c]);
    if (!(size > 0)) return scene__body_free(&b), scene__script_fail(p, "the mesh has no extent");
    tss_mesh_translate(&b.mesh, -mean[0], -mean[1], -mean[2]);
    tss_mesh_rotate(&b.mesh, turn[0], turn[1], turn[2]);
    tss_mesh_scale(&b.mesh, v[3] / size, v[3] / size, v[3] / size);
    tss_mesh_translate(&b.mesh, v[0], v[1], v[2]);
    tss_mesh_drop_unreferenced(&b.mesh, NULL);
    return scene__add_body(p->r.s, &b, p->r.error) != NULL;
}

static void scene__turning(scene_motion *m, const double *velocity, const double *degrees) {
    m->moves = 1;
    if (m->end == 0) m->end = INFINITY;
    for (int c = 0; c < 3; c++) {
        if (velocity) m->velocity[c] = velocity[c];
        if (degrees) m->angular[c] = degrees[c] * SCENE__RADIAN;
    }
}

// DBC lower(3) upper(3) velocity(3) degrees/s(3) [start [end]]: surface nodes, file's frame.
// NBC lower(3) upper(3) acceleration(3) [start [end]]
static int scene__boundary(scene__ipc *p, scene_body *b, int k, int *used) {
    int dirichlet = p->word[k][0] == 'D', n = dirichlet ? 12 : 9, nodes;
    double v[12], range[2] = {0, INFINITY};
    scene__box_item it = scene__item();
    if (!scene__numbers(p, k + 1, n, v)) return 0;
    *used = n + 1;
    for (int i = 0; i < 2 && k + *used < p->words; i++) {
        const char *w = p->word[k + *used];
        if (tss_parse_double(w, strlen(w), &range[i]) != TSS_OK) break;
        ++*used;
    }
    memcpy(it.where.lower, v, sizeof it.where.lower);
    memcpy(it.where.upper, v + 3, sizeof it.where.upper);
    it.where.surface = it.release = 1;
    it.start = it.motion.start = range[0], it.end = it.motion.end = range[1];
    memcpy(it.acceleration, v + 6, sizeof it.acceleration);
    if (dirichlet) scene__turning(&it.motion, v + 6, v + 9);
    int *node = scene__select(&b->mesh, &it.where, &nodes);
    if (!node) return scene__fail(p->r.error, "out of memory");
    if (nodes > 0)
        return dirichlet ? scene__add_pin(b, &it, node, nodes, 7, p->r.error)
                         : scene__add_force(b, &it, node, nodes, p->r.error);
    free(node);
    scene__warn(p->r.s, "%s:%d: no node is in the box of this %s", p->r.s->file, p->line,
                p->word[k]);
    return 1;
}

static int scene__shape_option(scene__ipc *p, scene_body *b, int k, int *used) {
    const char *w = p->word[k];
    double v[6];
    *used = 4;
    if (strcmp(w, "material") == 0) {
        if (!scene__numbers(p, k + 1, 3, v)) return 0;
        if (!(v[0] > 0 && v[1] > 0)) return 1;  // as in the reference: the default then
        b->material.rho = v[0], b->material.E = v[1], b->material.nu = v[2];
        return v[2] > -1 && v[2] < 0.5 ? 1
                                       : scene__script_fail(p, "material: expected -1 < nu < 0.5");
    }
    if (strcmp(w, "initVel") == 0) {
        *used = 7;
        if (!scene__numbers(p, k + 1, 6, v)) return 0;
        for (int c = 0; c < 3; c++) b->velocity[c] = v[c], b->angular[c] = v[3 + c] * SCENE__RADIAN;
        return 1;
    }
    if (strcmp(w, "linearVelocity") == 0 || strcmp(w, "angularVelocity") == 0) {
        if (!scene__numbers(p, k + 1, 3, v)) return 0;
        scene__turning(&b->motion, *w == 'l' ? v : NULL, *w == 'a' ? v : NULL);
        return 1;
    }
    if (strcmp(w, "DBC") == 0 || strcmp(w, "NBC") == 0) return scene__boundary(p, b, k, used);
    static const char *const known[] = {
        "material", "initVel", "linearVelocity", "angularVelocity", "DBC", "NBC", NULL};
    char hint[200];
    scene__suggest(w, known, hint, sizeof hint);
    return scene__fail(p->r.error, "%s:%d: no such option of a shape: \"%.40s\"; %s", p->r.s->file,
                       p->line, w, hint);
}

// file translation(3) degrees(3) scale(3) [options]: x ← R (s ∘ x) + t.
static int scene__shape_line(scene__ipc *p, scene_body *b, double *v) {
    double S[9] = {0}, zero[3] = {0, 0, 0};
    scene__body_named(p, b, p->word[0]);
    b->material.E = 0;  // the scene's, when the whole file is known
    if (!scene__numbers(p, 1, 9, v) || !scene__body_load(p, b, p->word[0])) return 0;
    tss_mesh_drop_unreferenced(&b->mesh, NULL);
    b->obstacle = b->mesh.tets == 0;
    for (int k = 10, used = 0; k < p->words; k += used)
        if (!scene__shape_option(p, b, k, &used)) return scene__body_free(b), 0;
    for (int c = 0; c < 3; c++) S[4 * c] = v[6 + c];
    tss_mesh_transform(&b->mesh, S, zero);
    tss_mesh_rotate(&b->mesh, v[3], v[4], v[5]);
    tss_mesh_translate(&b->mesh, v[0], v[1], v[2]);
    return 1;
}

static int scene__do_shapes(scene__ipc *p) {
    double n, v[9];
    if (p->words < 3 || strcmp(p->word[1], "input") != 0)
        return scene__script_fail(p, "expected `input N`");
    if (!scene__numbers(p, 2, 1, &n)) return 0;
    for (int k = 0; k < (int)n; k++) {
        scene_body b;
        if (!scene__next_line(p)) return scene__script_fail(p, "expected one line a shape");
        if (!scene__shape_line(p, &b, v) || !scene__add_body(p->r.s, &b, p->r.error)) return 0;
    }
    return 1;
}

// A copy of b, moved.
static int scene__repeat(scene__ipc *p, const scene_body *b, double x, double y, double z) {
    scene_body c = *b;
    tss_mesh none;
    c.pin = NULL, c.force = NULL, c.pins = c.forces = 0;
    memset(&none, 0, sizeof none);
    none.dim = b->mesh.dim;
    if (tss_mesh_merge(&b->mesh, &none, &c.mesh) != TSS_OK)
        return scene__fail(p->r.error, "out of memory");
    tss_mesh_translate(&c.mesh, x, y, z);
    char *number = strrchr(c.name, ' ');
    if (number) snprintf(number, sizeof c.name - (size_t)(number - c.name), " %d", p->r.s->bodies);
    return scene__add_body(p->r.s, &c, p->r.error) != NULL;
}

// shapeMatrix input nx ny nz [x y z], then a shape whose translation is the grid's spacing.
static int scene__do_matrix(scene__ipc *p) {
    double n[3], at[3] = {0, 0, 0}, v[9];
    scene_body b;
    if (p->words < 5 || strcmp(p->word[1], "input") != 0)
        return scene__script_fail(p, "expected `input nx ny nz [x y z]`");
    if (!scene__numbers(p, 2, 3, n) ||
        (p->words > 5 && !scene__numbers(p, 5, p->words > 8 ? 3 : p->words - 5, at)))
        return 0;
    if (!(n[0] >= 0 && n[1] >= 0 && n[2] >= 0 && n[0] * n[1] * n[2] <= 1e6))
        return scene__script_fail(p, "expected three counts, at most a million shapes");
    if (!scene__next_line(p)) return scene__script_fail(p, "expected the shape on the next line");
    if (!scene__shape_line(p, &b, v)) return 0;
    int ok = !b.pins && !b.forces ? 1 : scene__script_fail(p, "DBC and NBC cannot be repeated");
    for (int i = 0; ok && i < (int)n[0]; i++)
        for (int j = 0; ok && j < (int)n[1]; j++)
            for (int k = 0; ok && k < (int)n[2]; k++)
                ok = scene__repeat(p, &b, at[0] + v[0] * (i - 1), at[1] + v[1] * (j - 1),
                                   at[2] + v[2] * (k - 1));
    scene__body_free(&b);
    return ok;
}

// Sections of other solvers are skipped to `section end` or to the end of the file.
static int scene__do_section(scene__ipc *p) {
    for (int k = 1; k < p->words; k++)
        if (strcmp(p->word[k], "end") == 0 || strcmp(p->word[k], "IP") == 0 ||
            strcmp(p->word[k], "interiorPoint") == 0)
            return 1;
    while (scene__next_line(p))
        if (p->words > 1 && strcmp(p->word[0], "section") == 0 && strcmp(p->word[1], "end") == 0)
            return 1;
    return 1;
}

static const char *const scene__scripts[] = {"null",      "fallNoShift",     "fall",
                                             "dragright", "twist",           "stretchAndPause",
                                             "DCOFix",    "DCOSegBedSquash", NULL};

static int scene__do_script(scene__ipc *p) {
    static const scene_script which[] = {
        SCENE_SCRIPT_NONE,  SCENE_SCRIPT_NONE,    SCENE_SCRIPT_FALL, SCENE_SCRIPT_DRAGRIGHT,
        SCENE_SCRIPT_TWIST, SCENE_SCRIPT_STRETCH, SCENE_SCRIPT_NONE, SCENE_SCRIPT_SQUASH};
    char hint[300], what[400];
    const char *w = p->words > 1 ? p->word[1] : "";
    for (int k = 0; scene__scripts[k]; k++)
        if (strcmp(scene__scripts[k], w) == 0) return p->r.s->script = which[k], 1;
    scene__suggest(w, scene__scripts, hint, sizeof hint);
    snprintf(what, sizeof what, "no script is called \"%.40s\"; %s", w, hint);
    return scene__script_fail(p, what);
}

static int scene__do_skip(scene__ipc *p) {
    scene__warn(p->r.s, "%s:%d: %s is skipped", p->r.s->file, p->line, p->word[0]);
    return 1;
}

typedef struct scene__command {
    const char *name;
    int (*run)(scene__ipc *p);
} scene__command;

static const scene__command scene__commands[] = {{"energy", scene__do_energy},
                                                 {"time", scene__do_time},
                                                 {"density", scene__do_density},
                                                 {"stiffness", scene__do_stiffness},
                                                 {"timeIntegration", scene__do_integration},
                                                 {"dampingStiff", scene__do_damping_stiff},
                                                 {"dampingRatio", scene__do_damping_ratio},
                                                 {"turnOffGravity", scene__do_no_gravity},
                                                 {"dHat", scene__do_dhat},
                                                 {"epsv", scene__do_epsv},
                                                 {"tuning", scene__do_tuning},
                                                 {"tol", scene__do_tol},
                                                 {"fricIterAmt", scene__do_friction_iterations},
                                                 {"size", scene__do_size},
                                                 {"rotateModel", scene__do_rotate},
                                                 {"halfSpace", scene__do_half_space},
                                                 {"ground", scene__do_ground},
                                                 {"meshCO", scene__do_collider},
                                                 {"shapes", scene__do_shapes},
                                                 {"shapeMatrix", scene__do_matrix},
                                                 {"selfCollisionOn", scene__do_self_on},
                                                 {"selfCollisionOff", scene__do_self_off},
                                                 {"selfFric", scene__do_self_friction},
                                                 {"section", scene__do_section},
                                                 {"script", scene__do_script},
                                                 {"warmStart", scene__do_skip},
                                                 {"constraintSolver", scene__do_skip},
                                                 {"view", scene__do_skip},
                                                 {"zoom", scene__do_skip},
                                                 {"cameraTracking", scene__do_skip},
                                                 {"playBackSpeed", scene__do_skip}};
#define SCENE__COMMANDS ((int)(sizeof scene__commands / sizeof *scene__commands))

static int scene__command_line(scene__ipc *p) {
    const char *names[SCENE__COMMANDS + 1];
    char hint[700];
    for (int k = 0; k < SCENE__COMMANDS; k++) {
        if (strcmp(scene__commands[k].name, p->word[0]) == 0) return scene__commands[k].run(p);
        names[k] = scene__commands[k].name;
    }
    names[SCENE__COMMANDS] = NULL;
    scene__suggest(p->word[0], names, hint, sizeof hint);
    return scene__fail(p->r.error, "%s:%d: no such keyword: \"%.40s\"; %s", p->r.s->file, p->line,
                       p->word[0], hint);
}

// The box of all shapes; meshCO is not one.
static void scene__shapes_box(const scene *s, int soft_only, double *lo, double *hi) {
    scene__box_empty(lo, hi);
    for (int k = 0; k < s->bodies; k++) {
        const scene_body *b = &s->body[k];
        if (b->collider || (soft_only && b->obstacle)) continue;
        scene__box(soft_only && b->rest ? b->rest : b->mesh.x, b->mesh.nodes, lo, hi);
    }
}

// rotateModel: about half the extent of the box (as the reference does), the rest shape stays.
static int scene__rotate_model(scene__ipc *p) {
    double lo[3], hi[3];
    scene_motion turn;
    scene *s = p->r.s;
    memset(&turn, 0, sizeof turn);
    scene__shapes_box(s, 0, lo, hi);
    for (int c = 0; c < 3; c++) {
        turn.angular[c] = p->axis[c] * p->degrees * SCENE__RADIAN;
        turn.pivot[c] = 0.5 * (hi[c] - lo[c]);
    }
    for (int k = 0; k < s->bodies; k++) {
        scene_body *b = &s->body[k];
        size_t bytes = 3 * (size_t)b->mesh.nodes * sizeof(double);
        if (b->collider) continue;
        b->rest = (double *)malloc(bytes + 1);
        if (!b->rest) return scene__fail(p->r.error, "out of memory");
        memcpy(b->rest, b->mesh.x, bytes);
        for (int i = 0; i < b->mesh.nodes; i++)
            scene_pose(&turn, 1, b->rest + 3 * i, b->mesh.x + 3 * i);
    }
    return 1;
}

// size: the box's largest extent becomes s, its lower corner the origin.
static void scene__resize(scene__ipc *p) {
    double lo[3], hi[3], extent = 0, f;
    scene *s = p->r.s;
    scene__shapes_box(s, 0, lo, hi);
    for (int c = 0; c < 3; c++) extent = fmax(extent, hi[c] - lo[c]);
    if (!(p->size > 0) || !(extent > 0) || !isfinite(extent)) return;
    f = p->size / extent;
    for (int k = 0; k < s->bodies; k++) {
        scene_body *b = &s->body[k];
        for (int i = 0; i < 3 * b->mesh.nodes && !b->collider; i++) {
            b->mesh.x[i] = f * (b->mesh.x[i] - lo[i % 3]);
            if (b->rest) b->rest[i] = f * (b->rest[i] - lo[i % 3]);
        }
    }
}

// fall and dragright: up by half the box's diagonal.
static void scene__lift(scene *s) {
    double lo[3], hi[3], d = 0;
    scene__shapes_box(s, 0, lo, hi);
    for (int c = 0; c < 3; c++) d += (hi[c] - lo[c]) * (hi[c] - lo[c]);
    for (int k = 0; k < s->bodies; k++)
        for (int i = 0; i < s->body[k].mesh.nodes && !s->body[k].collider; i++)
            s->body[k].mesh.x[3 * i + 1] += 0.5 * sqrt(d);
}

static int scene__place(scene__ipc *p) {
    scene *s = p->r.s;
    double h = s->world.dt, damping = p->damping_stiff / (h * h);
    // The reference damps by (dampingStiff / h³) H dx, that is by a time dampingStiff / h²; dampingRatio r
    // stands for dampingStiff = 3/4 r h³. Newmark's potential is multiplied by β = 1/4, damping is not.
    if (p->damping_ratio > 0) damping = 0.75 * p->damping_ratio * h;
    if (s->world.integrator == TSS_NEWMARK) damping *= 4;
    s->world.steps = (int)ceil(p->duration / h * (1 - 1e-12));
    for (int k = 0; k < s->bodies; k++) {
        scene_body *b = &s->body[k];
        b->material.kind = (tss_material_kind)p->energy;
        b->material.damping = damping;
        if (!(b->material.E > 0))
            b->material.E = p->E, b->material.nu = p->nu, b->material.rho = p->density;
    }
    if (p->degrees != 0 && !scene__rotate_model(p)) return 0;
    scene__resize(p);
    if (s->script == SCENE_SCRIPT_FALL || s->script == SCENE_SCRIPT_DRAGRIGHT) scene__lift(s);
    return 1;
}

static int scene__read_script(scene__reader *r, const char *text) {
    scene__ipc *p = (scene__ipc *)calloc(1, sizeof *p);
    if (!p) return scene__fail(r->error, "out of memory");
    p->r = *r;
    p->at = text;
    p->duration = 5, p->density = 1000, p->E = 1e5, p->nu = 0.4, p->energy = TSS_NEO_HOOKEAN;
    r->s->world.dt = 0.025, r->s->world.integrator = TSS_IMPLICIT_EULER;
    r->s->contact.dhat_edge = 0;  // dHat is what the script says
    int ok = 1;
    while (ok && scene__next_line(p)) ok = scene__command_line(p);
    ok = ok && scene__place(p);
    free(p);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>scene_snapshots (private)
// A head, then positions, nodes × dim doubles a snapshot, as this machine writes them.
// ---------------------------------------------------------------------------------------------

typedef struct scene__snapshots {
    char magic[8];
    uint64_t nodes, dim, count;
} scene__snapshots;

static const char scene__snapshot_magic[8] = {'t', 's', 's', ' ', 's', 'n', 'p', '1'};

int scene_snapshot(const char *path, const tss_world *w, int number, scene_error *error) {
    scene__snapshots head;
    size_t size = (size_t)tss_world_nodes(w) * (size_t)tss_world_dim(w);
    FILE *f = fopen(path, number > 0 ? "r+b" : "wb");
    memcpy(head.magic, scene__snapshot_magic, sizeof head.magic);
    head.nodes = (uint64_t)tss_world_nodes(w), head.dim = (uint64_t)tss_world_dim(w);
    head.count = (uint64_t)number + 1;
    // The count last: a file that was cut short still says what it has.
    int ok = f && (number > 0 || fwrite(&head, sizeof head, 1, f) == 1);
    ok = ok && fseek(f, 0, SEEK_END) == 0 &&
         fwrite(tss_world_positions(w), sizeof(double), size, f) == size;
    ok = ok && fseek(f, 0, SEEK_SET) == 0 && fwrite(&head, sizeof head, 1, f) == 1;
    if (f) ok = fclose(f) == 0 && ok;
    return ok ? 1 : scene__fail(error, "%s: cannot be written: %s", path, strerror(errno));
}

// Opens a file of snapshots of this world; NULL and why it does not fit.
static FILE *scene__open_snapshots(const char *path, const tss_world *w, scene__snapshots *head,
                                   char *why, size_t size) {
    FILE *f = fopen(path, "rb");
    int n = tss_world_nodes(w), dim = tss_world_dim(w);
    why[0] = 0;
    if (!f)
        snprintf(why, size, "cannot be read: %s", strerror(errno));
    else if (fread(head, sizeof *head, 1, f) != 1 ||
             memcmp(head->magic, scene__snapshot_magic, sizeof head->magic) != 0)
        snprintf(why, size, "is no file that `tss run --snapshots` wrote");
    else if (head->nodes != (uint64_t)n || head->dim != (uint64_t)dim)
        snprintf(why, size, "is of %llu nodes in %llu dimensions, this scene has %d in %d",
                 (unsigned long long)head->nodes, (unsigned long long)head->dim, n, dim);
    else if (head->count < 1 || head->count > 1000000)
        snprintf(why, size, "says it has %llu snapshots, expected 1 to 1000000",
                 (unsigned long long)head->count);
    if (f && why[0]) fclose(f);
    return why[0] ? NULL : f;
}

// Appends a body's part of each snapshot of one file to x; *count of them so far.
static int scene__read_snapshot_file(const scene_body *b, const char *path, const tss_world *w,
                                     double **x, int *count, char *why, size_t size) {
    scene__snapshots head;
    size_t dim = (size_t)tss_world_dim(w), all = (size_t)tss_world_nodes(w) * dim;
    size_t own = (size_t)b->mesh.nodes * dim, first = (size_t)b->first * dim;
    FILE *f = scene__open_snapshots(path, w, &head, why, size);
    if (!f) return 0;
    double *row = (double *)malloc((all + 1) * sizeof *row);
    double *to = (double *)realloc(*x, ((size_t)*count + head.count) * own * sizeof *to);
    if (to) *x = to;
    for (uint64_t k = 0; row && to && k < head.count && !why[0]; k++) {
        if (fread(row, sizeof *row, all, f) != all)
            snprintf(why, size, "ends in snapshot %llu of %llu", (unsigned long long)k + 1,
                     (unsigned long long)head.count);
        else
            memcpy(to + own * (size_t)(*count)++, row + first, own * sizeof *row);
    }
    if (!row || !to) snprintf(why, size, "out of memory");
    free(row);
    fclose(f);
    return !why[0];
}

// ---------------------------------------------------------------------------------------------
// >>scene_build (private)
// ---------------------------------------------------------------------------------------------

static void scene__subspace_defaults(scene *s) {
    tss_subspace_def d = tss_subspace_def_default();
    s->solver.mode = -1;
    s->solver.error_nodes = d.error_nodes, s->solver.error_modes = d.error_modes;
    s->solver.progress = d.progress, s->solver.downdate = d.downdate;
    s->solver.keep = d.keep, s->solver.partitions = d.partitions;
    s->solver.oracle = (int)d.oracle, s->solver.secant = (int)d.secant,
    s->solver.schur = (int)d.schur;
}

static void scene__defaults(scene *s, const char *file) {
    tss_world_def d = tss_world_def_default();
    memset(s, 0, sizeof *s);
    snprintf(s->file, sizeof s->file, "%s", file);
    s->world.dim = 3, s->world.steps = 100, s->world.dt = d.dt,
    s->world.integrator = (int)d.integrator;
    memcpy(s->world.gravity, d.gravity, sizeof s->world.gravity);
    s->solver.tol_rel = d.tol_rel, s->solver.pcg_tol = d.pcg_tol, s->solver.linear = (int)d.linear;
    s->solver.max_iterations = d.max_iterations, s->solver.pcg_iterations = d.pcg_iterations;
    scene__subspace_defaults(s);
    s->contact.enabled = s->contact.self = s->contact.between = s->contact.friction_iterations = 1;
    s->contact.dhat_edge = tss_ipc_def_default().dhat_edge;
    s->contact.dhat_rel = s->contact.eps_v_rel = 1e-3;
    s->camera.azimuth = 30, s->camera.elevation = 18, s->camera.fov = 32, s->camera.zoom = 1;
    s->frames.width = 960, s->frames.height = 640, s->frames.field = SCENE_FIELD_AUTO;
    s->run.every = 1;
}

int scene_parse(scene *s, const char *name, const char *text, const char *assets,
                const char *const *set, int sets, scene_error *error) {
    scene__reader r;
    int json = text[strspn(text, " \t\r\n")] == '{';
    scene__defaults(s, name);
    memset(&r, 0, sizeof r);
    r.s = s, r.error = error, r.assets = assets;
    int ok = json ? 1 : scene__read_script(&r, text);
    // A script's --set lines make a small JSON scene that is read on top.
    cJSON *root = ok ? scene__tree(name, json ? text : NULL, set, sets, error) : NULL;
    ok = root && scene__read_root(&r, root);
    cJSON_Delete(root);
    if (!ok) scene_free(s);
    return ok;
}

int scene_read(scene *s, const char *path, const char *assets, const char *const *set, int sets,
               scene_error *error) {
    memset(s, 0, sizeof *s);
    char *text = scene__file(path, error);
    int ok = text && scene_parse(s, path, text, assets, set, sets, error);
    free(text);
    return ok;
}

static void scene__drivens_free(scene *s) {
    for (int k = 0; k < s->drivens; k++) {
        free(s->driven[k].node);
        free(s->driven[k].from);
    }
    free(s->driven);
    free(s->forces_on);
    s->driven = NULL, s->forces_on = NULL, s->drivens = 0;
}

void scene_free(scene *s) {
    scene__drivens_free(s);
    for (int k = 0; k < s->bodies; k++) scene__body_free(&s->body[k]);
    for (int k = 0; k < s->neural.script.handles; k++) free(s->neural.script.handle[k].node);
    for (int k = 0; k < s->neural.script.pulls; k++) free(s->neural.script.pull[k].node);
    free(s->neural.script.handle), free(s->neural.script.pull);
    free(s->body), free(s->plane), free(s->warnings);
    memset(s, 0, sizeof *s);
}

static int scene__world_fail(scene_error *e, const scene *s, const tss_world *w, tss_result r) {
    const char *why = w ? tss_world_error(w) : NULL;
    return scene__fail(e, "%s: %s", s->file, why && why[0] ? why : tss_result_text(r));
}

// n × 3 → n × dim
static double *scene__pack(const double *x, int n, int dim) {
    double *p = (double *)malloc(((size_t)n + 1) * (size_t)dim * sizeof *p);
    for (int i = 0; p && i < n; i++)
        for (int c = 0; c < dim; c++) p[i * dim + c] = x[3 * i + c];
    return p;
}

// v + ω × (x − middle), n × dim; NULL and *ok = 1 when all of it is v.
static double *scene__velocities(const scene_body *b, int dim, int *ok) {
    double c[3], u[3], turns = fabs(b->angular[0]) + fabs(b->angular[1]) + fabs(b->angular[2]);
    const double *w = b->angular;
    double *v =
        turns > 0 ? (double *)malloc(((size_t)b->mesh.nodes + 1) * (size_t)dim * sizeof *v) : NULL;
    *ok = v || turns == 0;
    scene__middle(b->mesh.x, b->mesh.nodes, c);
    for (int i = 0; v && i < b->mesh.nodes; i++) {
        const double *x = b->mesh.x + 3 * i;
        double d[3] = {x[0] - c[0], x[1] - c[1], x[2] - c[2]};
        u[0] = w[1] * d[2] - w[2] * d[1], u[1] = w[2] * d[0] - w[0] * d[2],
        u[2] = w[0] * d[1] - w[1] * d[0];
        for (int k = 0; k < dim; k++) v[i * dim + k] = b->velocity[k] + u[k];
    }
    return v;
}

static void scene__surface_def(const scene_body *b, tss_body_def *d) {
    d->kind = TSS_BODY_OBSTACLE;
    d->triangles = b->mesh.triangles, d->triangle = b->mesh.triangle;
    d->segments = b->mesh.edges, d->segment = b->mesh.edge;
    d->points = b->mesh.points, d->point = b->mesh.point;
}

static int scene__add_to_world(const scene *s, scene_body *b, tss_world *w, scene_error *e) {
    int dim = s->world.dim, ok;
    tss_body_def d = tss_body_def_default();
    tss_body_info info;
    double *X = scene__pack(b->rest ? b->rest : b->mesh.x, b->mesh.nodes, dim);
    double *x = scene__pack(b->mesh.x, b->mesh.nodes, dim), *v = scene__velocities(b, dim, &ok);
    d.name = b->name, d.nodes = b->mesh.nodes, d.X = X, d.x0 = x, d.v0 = v;
    d.material = b->material, d.E = b->E, d.nu = b->nu, d.rho = b->rho;
    memcpy(d.velocity, b->velocity, sizeof d.velocity);
    if (b->obstacle) {
        scene__surface_def(b, &d);
    } else if (b->shell > 0) {
        d.triangles = b->mesh.triangles, d.triangle = b->mesh.triangle, d.thickness = b->shell;
    } else {
        d.cells = dim == 3 ? b->mesh.tets : b->mesh.triangles;
        d.cell = dim == 3 ? b->mesh.tet : b->mesh.triangle;
    }
    tss_result r = X && x && ok ? tss_body_add(w, &d, &b->id) : TSS_ERROR_NO_MEMORY;
    if (r == TSS_OK) r = tss_body_get(w, b->id, &info);
    if (r == TSS_OK) b->first = info.first_node;
    free(X), free(x), free(v);
    return r == TSS_OK ? 1 : scene__world_fail(e, s, w, r);
}

// Nodes (of the body; NULL: all) that shall move.
static scene_driven *scene__add_driven(scene *s, int body, const int *node, int nodes,
                                       const scene_motion *m, scene_error *e) {
    const scene_body *b = &s->body[body];
    void *p = scene__grow(s->driven, s->drivens, sizeof *s->driven, e);
    if (!p) return NULL;
    s->driven = (scene_driven *)p;
    scene_driven *d = &s->driven[s->drivens++];
    d->body = body, d->count = node ? nodes : b->mesh.nodes, d->motion = *m;
    d->node = (int *)malloc(((size_t)d->count + 1) * sizeof *d->node);
    d->from = (double *)malloc(((size_t)d->count + 1) * 3 * sizeof *d->from);
    if (!d->node || !d->from) return scene__fail(e, "out of memory"), (scene_driven *)NULL;
    for (int i = 0; i < d->count; i++) {
        int k = node ? node[i] : i;
        d->node[i] = b->first + k;
        memcpy(d->from + 3 * i, b->mesh.x + 3 * k, 3 * sizeof(double));
    }
    if (!m->has_pivot) scene__middle(d->from, d->count, d->motion.pivot);
    return d;
}

static int scene__add_pins(scene *s, int k, tss_world *w, scene_error *e) {
    scene_body *b = &s->body[k];
    if (b->motion.moves) {
        scene_driven *d = scene__add_driven(s, k, NULL, 0, &b->motion, e);
        if (!d) return 0;
        d->state = 1;
    }
    for (int i = 0; i < b->pins; i++) {
        const scene_pin *p = &b->pin[i];
        if (p->motion.moves) {
            scene_driven *d = scene__add_driven(s, k, p->node, p->nodes, &p->motion, e);
            if (!d) return 0;
            d->release = p->release, d->state = !p->release;
        }
        for (int j = 0; j < p->nodes && !p->release; j++) {
            tss_result r = tss_node_pin(w, b->first + p->node[j], p->axes);
            if (r != TSS_OK) return scene__world_fail(e, s, w, r);
        }
    }
    return 1;
}

// The nodes of body k whose x is below (side < 0) or above the given fraction of the box's x range.
static int scene__drive_end(scene *s, int k, const double *x, double lo, double hi, double part,
                            int side, const scene_motion *m, scene_error *e) {
    int n = 0, nodes = s->body[k].mesh.nodes;
    int *node = (int *)malloc(((size_t)nodes + 1) * sizeof *node);
    for (int i = 0; node && i < nodes; i++) {
        double at = x[3 * i];
        int left = at<lo + (hi - lo) * part, right = at> hi - (hi - lo) * part;
        if (side < 0 ? left : right && !left) node[n++] = i;
    }
    scene_driven *d = node && n > 0 ? scene__add_driven(s, k, node, n, m, e) : NULL;
    if (d) d->gated = d->state = 1;
    free(node);
    return !node ? scene__fail(e, "out of memory") : n == 0 || d;
}

static int scene__script_ends(scene *s, scene_error *e) {
    double lo[3], hi[3], rest_lo[3], rest_hi[3],
        part = s->script == SCENE_SCRIPT_DRAGRIGHT ? 0.04 : 0.01;
    int ok = 1;
    scene__shapes_box(s, 0, lo, hi);
    scene__shapes_box(s, 1, rest_lo, rest_hi);
    for (int k = 0; ok && k < s->bodies; k++) {
        const scene_body *b = &s->body[k];
        for (int side = -1; ok && side <= 1 && !b->collider; side += 2) {
            scene_motion m;
            memset(&m, 0, sizeof m);
            m.moves = m.has_pivot = 1, m.end = INFINITY;
            for (int c = 0; c < 3; c++) m.pivot[c] = 0.5 * (rest_lo[c] + rest_hi[c]);
            if (s->script == SCENE_SCRIPT_TWIST)
                m.angular[0] = side * 72 * SCENE__RADIAN;  // 0.4π rad/s
            if (s->script == SCENE_SCRIPT_STRETCH) m.velocity[0] = side;
            if (s->script == SCENE_SCRIPT_DRAGRIGHT) m.velocity[0] = 0.5;
            if (s->script == SCENE_SCRIPT_DRAGRIGHT && side < 0) continue;
            ok = scene__drive_end(s, k, b->mesh.x, lo[0], hi[0], part, side, &m, e);
        }
    }
    return ok;
}

// Shapes are numbered without meshCO; the later half of them squashes.
static int scene__later_half(const scene *s, int body) {
    int shapes = 0, number = 0;
    for (int k = 0; k < s->bodies; k++) {
        if (k == body) number = shapes;
        shapes += !s->body[k].collider;
    }
    return number >= (shapes + 1) / 2;
}

static int scene__add_script(scene *s, scene_error *e) {
    if (s->script == SCENE_SCRIPT_NONE || s->script == SCENE_SCRIPT_FALL) return 1;
    if (s->script != SCENE_SCRIPT_SQUASH) return scene__script_ends(s, e);
    for (int k = 0; k < s->bodies; k++) {
        const scene_body *b = &s->body[k];
        if (b->collider || !b->obstacle || !scene__later_half(s, k)) continue;
        scene_motion m;
        memset(&m, 0, sizeof m);
        m.moves = 1, m.end = INFINITY, m.velocity[1] = -1;
        scene_driven *d = scene__add_driven(s, k, NULL, 0, &m, e);
        if (!d) return 0;
        d->gated = d->state = 1;
    }
    return 1;
}

static tss_world_def scene__world_def(const scene *s, const tss_host *host) {
    tss_world_def d = tss_world_def_default();
    if (host) d.host = *host;
    d.dim = s->world.dim, d.dt = s->world.dt, d.integrator = (tss_integrator)s->world.integrator;
    memcpy(d.gravity, s->world.gravity, sizeof d.gravity);
    d.tol = s->solver.tol, d.tol_rel = s->solver.tol_rel,
    d.max_iterations = s->solver.max_iterations;
    d.linear = (tss_linear)s->solver.linear;
    d.pcg_tol = s->solver.pcg_tol, d.pcg_iterations = s->solver.pcg_iterations;
    d.newton_residual = s->solver.newton_residual;
    return d;
}

// The diagonal of the box of the soft bodies at rest, as tss measures it.
static double scene__diagonal(const scene *s) {
    double lo[3], hi[3], d = 0;
    scene__shapes_box(s, 1, lo, hi);
    for (int c = 0; c < s->world.dim; c++) d += (hi[c] - lo[c]) * (hi[c] - lo[c]);
    return sqrt(d);
}

// A script's selfCollisionOff: shapes pass through each other; planes and meshCO stay.
static tss_ipc_pair *scene__exclude_shapes(const scene *s, int *count) {
    size_t n = (size_t)s->bodies;
    tss_ipc_pair *pair = (tss_ipc_pair *)calloc(n * n + 1, sizeof *pair);
    *count = 0;
    for (int a = 0; pair && a < s->bodies; a++)
        for (int b = a + 1; b < s->bodies; b++) {
            if (s->body[a].collider || s->body[b].collider) continue;
            pair[*count].a = s->body[a].id, pair[*count].b = s->body[b].id;
            pair[*count].exclude = 1, pair[(*count)++].mu = -1;
        }
    return pair;
}

static tss_ipc_def scene__contact_def(const scene *s) {
    tss_ipc_def d = tss_ipc_def_default();
    d.dhat = s->contact.dhat, d.dhat_rel = s->contact.dhat_rel, d.dhat_edge = s->contact.dhat_edge;
    d.kappa = s->contact.kappa, d.mu = s->contact.mu, d.self_contact = s->contact.self;
    d.friction_iterations = s->contact.friction_iterations;
    d.eps_v = s->contact.eps_v > 0 ? s->contact.eps_v : s->contact.eps_v_rel * scene__diagonal(s);
    return d;
}

static int scene__add_contact(scene *s, tss_world *w, tss_ipc **ipc, scene_error *e) {
    tss_ipc_def d = scene__contact_def(s);
    tss_ipc_plane *plane = (tss_ipc_plane *)calloc((size_t)s->planes + 1, sizeof *plane);
    tss_ipc_body *body = (tss_ipc_body *)calloc((size_t)s->bodies + 1, sizeof *body);
    tss_ipc_pair *pair = NULL;
    int ok = plane && body;
    for (int k = 0; ok && k < s->planes; k++) {
        memcpy(plane[k].origin, s->plane[k].origin, sizeof plane[k].origin);
        memcpy(plane[k].normal, s->plane[k].normal, sizeof plane[k].normal);
        plane[k].mu = s->plane[k].mu < 0 ? s->contact.mu : s->plane[k].mu;
    }
    for (int k = 0; ok && k < s->bodies; k++)
        if (s->body[k].mu >= 0) {
            body[d.bodies].body = s->body[k].id, body[d.bodies].mu = s->body[k].mu;
            body[d.bodies++].self_contact = -1;
        }
    if (ok && !s->contact.between) ok = (pair = scene__exclude_shapes(s, &d.pairs)) != NULL;
    d.plane = plane, d.planes = s->planes, d.body = body, d.pair = pair;
    tss_result r = ok ? tss_ipc_add(w, &d, ipc) : TSS_ERROR_NO_MEMORY;
    free(plane), free(body), free(pair);
    return r == TSS_OK ? 1 : scene__world_fail(e, s, w, r);
}

tss_mode scene_mode(const scene *s) {
    if (s->solver.mode >= 0) return (tss_mode)s->solver.mode;
    for (int k = 0; k < s->bodies; k++)
        if (s->body[k].bases > 0) return TSS_MODE_ADAPTIVE;
    return TSS_MODE_FULL;
}

static tss_subspace_def scene__subspace_def(const scene *s) {
    tss_subspace_def d = tss_subspace_def_default();
    d.mode = scene_mode(s);
    d.error_nodes = s->solver.error_nodes, d.error_modes = s->solver.error_modes;
    d.progress = s->solver.progress, d.downdate = s->solver.downdate;
    d.keep = s->solver.keep, d.partitions = s->solver.partitions;
    d.oracle = (tss_oracle)s->solver.oracle, d.secant = (tss_secant)s->solver.secant,
    d.schur = (tss_schur)s->solver.schur, d.pcg_tol = s->solver.pcg_tol;
    return d;
}

static tss_basis_def scene__basis_def(const scene_basis *b) {
    tss_basis_def d = b->kind == TSS_BASIS_QUADRATIC    ? tss_basis_quadratic()
                      : b->kind == TSS_BASIS_SKINNING   ? tss_basis_skinning(b->count)
                      : b->kind == TSS_BASIS_BIHARMONIC ? tss_basis_biharmonic(b->count)
                      : b->kind == TSS_BASIS_EIGEN      ? tss_basis_eigen(b->count)
                                                        : tss_basis_affine();
    d.heterogeneous = b->heterogeneous, d.tol = b->tol;
    d.cache = b->cache[0] ? b->cache : NULL;
    if (b->initial > -2) d.initial = b->initial;
    return d;
}

static int scene__add_basis(const scene *s, int body, int number, tss_world *w, scene_error *e) {
    const scene_body *owner = &s->body[body];
    scene_basis *b = &owner->basis[number];
    double *x = NULL;
    int count = 0;
    char why[200] = "";
    for (int k = 0; k < b->snapshots; k++)
        if (!scene__read_snapshot_file(owner, b->snapshot[k], w, &x, &count, why, sizeof why)) {
            free(x);
            return scene__fail(e, "%s: bodies[%d].basis[%d].snapshots[%d]: %s %s", s->file, body,
                               number, k, b->snapshot[k], why);
        }
    tss_basis_def d = scene__basis_def(b);
    if (b->kind == TSS_BASIS_POD) {
        tss_basis_def pod = tss_basis_pod(x, count, b->count);
        if (b->initial > -2) pod.initial = b->initial;
        pod.cache = d.cache, d = pod;
    }
    tss_result r = tss_basis_add(w, owner->id, &d, &b->id);
    free(x);
    if (r == TSS_OK) return 1;
    return scene__fail(e, "%s: bodies[%d].basis[%d] (%s): %s", s->file, body, number,
                       scene__bases[b->kind],
                       tss_world_error(w)[0] ? tss_world_error(w) : tss_result_text(r));
}

// Nodes that a script moves are not pinned; a basis must find them scripted. In full mode, too:
// the worlds of one scene are alike.
static tss_result scene__mark_driven(const scene *s, tss_world *w) {
    tss_result r = TSS_OK;
    for (int k = 0; k < s->drivens; k++) {
        const scene_driven *d = &s->driven[k];
        if (d->state != 1 || s->body[d->body].obstacle) continue;
        for (int i = 0; i < d->count && r == TSS_OK; i++)
            r = tss_node_target(w, d->node[i], d->from + 3 * i);
    }
    return r;
}

static int scene__add_bases(const scene *s, tss_world *w, scene_error *e) {
    tss_subspace_def d = scene__subspace_def(s);
    int bases = 0;
    for (int k = 0; k < s->bodies; k++) {
        bases += s->body[k].bases;
        for (int i = 0; i < s->body[k].bases; i++) s->body[k].basis[i].id = -1;
    }
    tss_result r = bases > 0 ? scene__mark_driven(s, w) : TSS_OK;
    if (d.mode == TSS_MODE_FULL) return r == TSS_OK ? 1 : scene__world_fail(e, s, w, r);
    if (bases == 0)
        return scene__fail(e, "%s: solver.mode is \"%s\", but no body has a basis", s->file,
                           scene__modes[d.mode]);
    if (r == TSS_OK) r = tss_world_prepare(w);
    if (r == TSS_OK) r = tss_subspace_add(w, &d, NULL);
    if (r != TSS_OK) return scene__world_fail(e, s, w, r);
    for (int k = 0; k < s->bodies; k++)
        for (int i = 0; i < s->body[k].bases; i++)
            if (!scene__add_basis(s, k, i, w, e)) return 0;
    return 1;
}

int scene_build(scene *s, const tss_host *host,
                void (*on_iterate)(const double *, const double *, void *), void *ctx,
                tss_world **out, tss_ipc **ipc, scene_error *error) {
    tss_world_def d = scene__world_def(s, host);
    tss_world *w = NULL;
    int forces = 0;
    *out = NULL;
    if (ipc) *ipc = NULL;
    d.on_iterate = on_iterate, d.on_iterate_ctx = ctx;
    tss_result r = tss_world_create(&d, &w);
    if (r != TSS_OK) return scene__world_fail(error, s, NULL, r);
    scene__drivens_free(s);
    int ok = 1;
    for (int k = 0; ok && k < s->bodies; k++) {
        ok = scene__add_to_world(s, &s->body[k], w, error) && scene__add_pins(s, k, w, error);
        forces += s->body[k].forces;
    }
    ok = ok && scene__add_script(s, error);
    if (ok && s->contact.enabled) ok = scene__add_contact(s, w, ipc, error);
    ok = ok && scene__add_bases(s, w, error);
    s->forces_on = (char *)calloc((size_t)forces + 1, 1);
    if (ok && !s->forces_on) ok = scene__fail(error, "out of memory");
    if (ok && (r = tss_world_ready(w)) != TSS_OK) ok = scene__world_fail(error, s, w, r);
    if (ok)
        *out = w;
    else
        tss_world_destroy(w);
    return ok;
}

// ---------------------------------------------------------------------------------------------
// >>scene_drive (private)
// ---------------------------------------------------------------------------------------------

// Coordinate c of the nodes of those bodies that `of` accepts: smallest and largest.
static void scene__range(const scene *s, const tss_world *w, int (*of)(const scene *, int), int c,
                         double *lo, double *hi) {
    const double *x = tss_world_positions(w);
    *lo = INFINITY, *hi = -INFINITY;
    for (int k = 0; k < s->bodies; k++)
        for (int i = 0; i < s->body[k].mesh.nodes && of(s, k); i++) {
            double v = x[(s->body[k].first + i) * s->world.dim + c];
            *lo = fmin(*lo, v), *hi = fmax(*hi, v);
        }
}

static int scene__is_collider(const scene *s, int k) { return s->body[k].collider; }
static int scene__is_shape(const scene *s, int k) { return !s->body[k].collider; }
static int scene__is_upper(const scene *s, int k) {
    return s->body[k].obstacle && scene__later_half(s, k);
}
static int scene__is_lower(const scene *s, int k) {
    return s->body[k].obstacle && !s->body[k].collider && !scene__later_half(s, k);
}

// What the script does in the step to come: 1 moves, 0 stands still, −1 lets go.
static int scene__gate(const scene *s, const tss_world *w) {
    double lo, hi, other, far;
    if (s->script == SCENE_SCRIPT_DRAGRIGHT) {
        scene__range(s, w, scene__is_collider, 0, &other, &far);
        scene__range(s, w, scene__is_shape, 0, &lo, &hi);
        return lo > far ? -1 : 1;
    }
    if (s->script == SCENE_SCRIPT_SQUASH) {
        scene__range(s, w, scene__is_upper, 1, &lo, &hi);
        scene__range(s, w, scene__is_lower, 1, &other, &far);
        return lo - far > 0.1;
    }
    // The first node of the left end tells where it is.
    for (int k = 0; k < s->drivens && s->script == SCENE_SCRIPT_STRETCH; k++)
        if (s->driven[k].gated && s->driven[k].motion.velocity[0] < 0)
            return tss_world_positions(w)[s->driven[k].node[0] * s->world.dim] >= -0.28;
    return 1;
}

static tss_result scene__free_nodes(const scene *s, const scene_driven *d, tss_world *w) {
    tss_result r = TSS_OK;
    if (s->body[d->body].obstacle) return tss_body_target(w, s->body[d->body].id, NULL);
    for (int i = 0; i < d->count && r == TSS_OK; i++) r = tss_node_pin(w, d->node[i], 0);
    return r;
}

static void scene__capture(const scene *s, scene_driven *d, const tss_world *w) {
    const double *x = tss_world_positions(w);
    for (int i = 0; i < d->count; i++)
        for (int c = 0; c < s->world.dim; c++)
            d->from[3 * i + c] = x[d->node[i] * s->world.dim + c];
    if (!d->motion.has_pivot) scene__middle(d->from, d->count, d->motion.pivot);
}

// Brings a motion's clock to the end of the step to come; 0: not driven in this step.
static int scene__advance(const scene *s, scene_driven *d, const tss_world *w, int gate) {
    double t = tss_world_time(w), h = s->world.dt, slack = SCENE__SLACK * h;
    const scene_motion *m = &d->motion;
    if (d->state == 2 || (d->gated && gate < 0)) return 0;
    if (d->gated) return d->clock += gate > 0 ? h : 0, 1;
    if (m->keyframes > 0) return d->clock = t + h, 1;
    if (!d->release) return d->clock = fmax(fmin(t + h, m->end) - m->start, 0), 1;
    if (t < m->start - slack || t >= m->end - slack) return 0;
    if (d->state == 0) scene__capture(s, d, w);
    return d->clock = d->state ? d->clock + h : h, 1;
}

static tss_result scene__drive_one(const scene *s, scene_driven *d, tss_world *w, int gate) {
    double to[3];
    tss_result r = TSS_OK;
    int on = scene__advance(s, d, w, gate);
    if (!on && d->state == 1) r = scene__free_nodes(s, d, w);
    if (!on) return d->state = d->state == 1 ? 2 : d->state, r;
    d->state = 1;
    for (int i = 0; i < d->count && r == TSS_OK; i++) {
        scene_pose(&d->motion, d->clock, d->from + 3 * i, to);
        r = tss_node_target(w, d->node[i], to);
    }
    return r;
}

// Sums the forces that act, and hands over those of all nodes that have any.
static tss_result scene__apply_forces(const scene *s, tss_world *w) {
    int n = tss_world_nodes(w), k = 0;
    double *f = (double *)calloc((size_t)n + 1, 3 * sizeof *f);
    char *has = (char *)calloc((size_t)n + 1, 1);
    tss_result r = f && has ? TSS_OK : TSS_ERROR_NO_MEMORY;
    for (int b = 0; b < s->bodies && r == TSS_OK; b++)
        for (int j = 0; j < s->body[b].forces; j++, k++) {
            const scene_force *g = &s->body[b].force[j];
            for (int i = 0; i < g->nodes; i++) {
                int at = s->body[b].first + g->node[i];
                has[at] = 1;
                for (int c = 0; c < 3 && s->forces_on[k]; c++)
                    f[3 * at + c] +=
                        g->force[c] / g->nodes + g->acceleration[c] * tss_world_masses(w)[at];
            }
        }
    for (int i = 0; i < n && r == TSS_OK; i++)
        if (has[i]) r = tss_node_force(w, i, f + 3 * i);
    free(f), free(has);
    return r;
}

static tss_result scene__drive_forces(scene *s, tss_world *w) {
    double t = tss_world_time(w), slack = SCENE__SLACK * s->world.dt;
    int k = 0, changed = 0;
    for (int b = 0; b < s->bodies; b++)
        for (int j = 0; j < s->body[b].forces; j++, k++) {
            const scene_force *g = &s->body[b].force[j];
            char on = t >= g->start - slack && t < g->end - slack;
            changed |= on != s->forces_on[k];
            s->forces_on[k] = on;
        }
    return changed ? scene__apply_forces(s, w) : TSS_OK;
}

int scene_drive(scene *s, tss_world *w, scene_error *error) {
    int gate = scene__gate(s, w);
    tss_result r = scene__drive_forces(s, w);
    for (int k = 0; k < s->drivens && r == TSS_OK; k++)
        r = scene__drive_one(s, &s->driven[k], w, gate);
    if (r == TSS_OK) r = tss_world_prepare(w);  // kinds of nodes may have changed
    return r == TSS_OK ? 1 : scene__world_fail(error, s, w, r);
}

static void scene__copy(char *data, size_t *at, void *value, size_t bytes, int save) {
    if (data && save) memcpy(data + *at, value, bytes);
    if (data && !save) memcpy(value, data + *at, bytes);
    *at += bytes;
}

size_t scene_state(scene *s, void *data, size_t size, int save) {
    size_t at = 0, need = 0;
    int forces = 0;
    for (int k = 0; k < s->bodies; k++) forces += s->body[k].forces;
    for (int k = 0; k < s->drivens; k++)
        need += sizeof(int) + (4 + 3 * (size_t)s->driven[k].count) * sizeof(double);
    need += sizeof need;
    if (data && size != need) return 0;
    for (int k = 0; data && k < s->drivens; k++) {
        scene_driven *d = &s->driven[k];
        scene__copy((char *)data, &at, &d->state, sizeof d->state, save);
        scene__copy((char *)data, &at, &d->clock, sizeof d->clock, save);
        scene__copy((char *)data, &at, d->motion.pivot, sizeof d->motion.pivot, save);
        scene__copy((char *)data, &at, d->from, 3 * (size_t)d->count * sizeof(double), save);
    }
    size_t mark = need;
    scene__copy((char *)data, &at, &mark, sizeof mark, save);
    // Neither on nor off: the next scene_drive hands them over anew.
    if (data && !save && s->forces_on) memset(s->forces_on, 2, (size_t)forces);
    return mark == need ? need : 0;
}

#ifdef __cplusplus
}
#endif
#endif  // SCENE_IMPLEMENTATION
