/* bench_figures.c: the claims of paper A's figures, measured on the scenes
   examples/scenes/fig*.json

   cc -O3 ... bench/bench_figures.c -lcjson -lmetis -lm
   bench_figures SCENES NAME...            one line a figure: `fig9 coarse 0.31 fine 0.29 ...`
   bench_figures SCENES --small NAME...    smaller meshes; also `ok NAME` or `FAILED NAME: why`
   bench_figures SCENES --small all

   Exit code: 0, 1 a claim failed, 2 a scene could not be run. Reference everywhere: the full-space
   solver on the same mesh, or the same solver with one key changed. */
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"
#include "tss_io.h"
#include "tss_shapes.h"
#define SCENE_IMPLEMENTATION
#include "scene.h"

#include <stdio.h>
#include <time.h>

#define MAX_KEYS 24

static double now(void *ctx) {
    struct timespec t;
    (void)ctx;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec;
}

// ---------------------------------------------------------------------------------------------
// >>runs: a scene with some keys changed, and what happened in it
// ---------------------------------------------------------------------------------------------

typedef struct keys {
    const char *key[MAX_KEYS];
    int count;
} keys;

typedef struct run {
    scene s;
    scene_error why;
    tss_world *w;
    tss_ipc *ipc;
    tss_subspace *sub;  // NULL: full space
    tss_step_info info;
    double *first;    // n × dim: the first accepted move of the step, x₁ − x₀
    int catch_first;  // 1: it is wanted
    int most;         // enriched nodes, the largest of all steps
    int least_modes, most_modes, newton, bad;
    double enriched_sum, seconds;
    int steps;
} run;

static const char *scenes;  // folder
static int small_;          // 1: smaller meshes, and claims are judged
static int failures;

static void catch_move(const double *x0, const double *x1, void *ctx) {
    run *r = (run *)ctx;
    if (!r->catch_first) return;
    size_t n = (size_t)(tss_world_nodes(r->w) * tss_world_dim(r->w));
    for (size_t k = 0; k < n; k++) r->first[k] = x1[k] - x0[k];
    r->catch_first = 0;
}

static void stop(const run *r, const char *what) {
    fprintf(stderr, "%s: %s\n", what, r->why.text[0] ? r->why.text : tss_world_error(r->w));
    exit(2);
}

static void add(keys *k, const char *key) {
    if (k->count < MAX_KEYS) k->key[k->count++] = key;
}

// k: keys; NULL: none. The world is ready for its first step.
static void open_run(run *r, const char *name, const keys *k) {
    char path[512];
    memset(r, 0, sizeof *r);
    r->least_modes = INT32_MAX;
    snprintf(path, sizeof path, "%s/%s.json", scenes, name);
    tss_host host = tss_host_default();
    host.clock = now;
    if (!scene_read(&r->s, path, NULL, k ? k->key : NULL, k ? k->count : 0, &r->why) ||
        !scene_build(&r->s, &host, catch_move, r, &r->w, &r->ipc, &r->why))
        stop(r, name);
    r->sub = tss_subspace_of(r->w);
    r->first =
        (double *)calloc((size_t)(tss_world_nodes(r->w) * tss_world_dim(r->w)), sizeof(double));
    if (!r->first) stop(r, "out of memory");
}

static void close_run(run *r) {
    tss_world_destroy(r->w);
    scene_free(&r->s);
    free(r->first);
}

static void step(run *r) {
    if (!scene_drive(&r->s, r->w, &r->why) || tss_world_step(r->w, &r->info) != TSS_OK)
        stop(r, "step");
    const tss_step_info *i = &r->info;
    if (i->enriched_nodes > r->most) r->most = i->enriched_nodes;
    if (i->active_modes > r->most_modes) r->most_modes = i->active_modes;
    if (i->active_modes < r->least_modes) r->least_modes = i->active_modes;
    r->newton += i->newton, r->bad += i->status != TSS_STEP_CONVERGED, r->seconds += i->seconds;
    r->enriched_sum += (double)i->enriched_nodes / i->nodes, r->steps++;
}

static void advance(run *r, int steps) {
    for (int k = 0; k < steps; k++) step(r);
}

static void whole(run *r, const char *name, const keys *k) {
    open_run(r, name, k);
    advance(r, r->s.world.steps);
}

static double distance3(const double *a, const double *b) {
    double s = 0;
    for (int c = 0; c < 3; c++) s += (a[c] - b[c]) * (a[c] - b[c]);
    return sqrt(s);
}

// Largest distance of a node between two runs over the diagonal of the soft bodies.
static double apart(const run *a, const run *b) {
    const double *x = tss_world_positions(a->w), *y = tss_world_positions(b->w);
    double most = 0;
    for (int i = 0; i < tss_world_nodes(a->w); i++)
        most = fmax(most, distance3(x + 3 * i, y + 3 * i));
    return most / tss_world_diagonal(a->w);
}

static double share(const run *r) { return (double)r->most / r->info.nodes; }

static void judge(const char *name, int holds) {
    if (!small_) return;
    printf(holds ? "ok      %s\n" : "FAILED  %s\n", name);
    failures += !holds;
    fflush(stdout);
}

// Keys for the size: `little` ones when meshes are to be small.
static keys sized(const char *a, const char *b, const char *c) {
    keys k = {{NULL}, 0};
    const char *all[3] = {a, b, c};
    for (int i = 0; i < 3 && small_; i++)
        if (all[i]) add(&k, all[i]);
    return k;
}

// ---------------------------------------------------------------------------------------------
// >>figures
// ---------------------------------------------------------------------------------------------

// Fig. 2: modes alone miss the contacts; a few nodes more and the full solution is met.
static void fig2(void) {
    keys k = sized("bodies.0.shape.cells=16", "world.steps=14", NULL);
    run full, modes, adaptive;
    whole(&adaptive, "fig2_spikes", &k);
    add(&k, "solver.mode=\"full\"");
    whole(&full, "fig2_spikes", &k);
    k.key[k.count - 1] = "solver.mode=\"subspace\"";
    whole(&modes, "fig2_spikes", &k);
    double a = apart(&adaptive, &full), m = apart(&modes, &full);
    double dofs = (3.0 * adaptive.most + adaptive.most_modes) / (3.0 * adaptive.info.nodes);
    printf("fig2 modes_only %.3g adaptive %.3g ratio %.3g dofs_most %.3f dofs_mean %.3f\n", m, a,
           a / m, dofs, adaptive.enriched_sum / adaptive.steps);
    judge("fig2: a tenth of the error of modes alone, with fewer unknowns than full space",
          a <= 0.1 * m && dofs < 0.7);
    close_run(&full), close_run(&modes), close_run(&adaptive);
}

typedef struct tip {
    double x[3];
    int node;     // of the ball, the lowest
    double size;  // the ball's diameter
} tip;

static tip lowest(const run *r, int body) {
    tip t = {{0, 0, 0}, r->s.body[body].first, 0};
    const double *x = tss_world_positions(r->w);
    double top = -1e30;
    for (int i = r->s.body[body].first; i < r->s.body[body].first + r->s.body[body].mesh.nodes;
         i++) {
        if (x[3 * i + 1] < x[3 * t.node + 1]) t.node = i;
        top = fmax(top, x[3 * i + 1]);
    }
    memcpy(t.x, x + 3 * t.node, sizeof t.x);
    t.size = top - t.x[1];
    return t;
}

// Fig. 4, 8: at the first contact 𝒢 is highest and ℰ lowest at the tip, where the full Newton step
// is small.
static void fig4(void) {
    keys k = sized("bodies.0.shape.cells=12", NULL, NULL);
    run r, full;
    tss_subspace_info i;
    open_run(&r, "fig4_cone", &k);
    do step(&r);
    while (r.info.contacts == 0 && r.steps < r.s.world.steps);
    if (tss_subspace_query(r.w) != TSS_OK) stop(&r, "query");
    tss_subspace_get_info(r.sub, &i);
    add(&k, "solver.mode=\"full\"");
    open_run(&full, "fig4_cone", &k);
    if (tss_world_copy_state(full.w, r.w) != TSS_OK) stop(&full, "copy");
    full.catch_first = 1;
    step(&full);
    tip t = lowest(&r, 0);
    const double *x = tss_world_positions(r.w), zero[3] = {0, 0, 0};
    int first = r.s.body[0].first, n = r.s.body[0].mesh.nodes, worst = first, low = first,
        moved = first;
    double reach = 0, near = 0, tip_move = 0;
    int inside = 0;
    for (int j = first; j < first + n; j++) {
        if (i.error[j] > i.error[worst]) worst = j;
        if (i.progress[j] < i.progress[low]) low = j;
        if (distance3(full.first + 3 * j, zero) > distance3(full.first + 3 * moved, zero))
            moved = j;
        inside += i.enriched[j] != 0;
        if (i.enriched[j])
            near += distance3(x + 3 * j, t.x) / t.size,
                reach = fmax(reach, distance3(x + 3 * j, t.x) / t.size);
    }
    tip_move = distance3(full.first + 3 * t.node, zero) / distance3(full.first + 3 * moved, zero);
    double we = distance3(x + 3 * worst, t.x) / t.size, wp = distance3(x + 3 * low, t.x) / t.size;
    double wm = distance3(x + 3 * moved, t.x) / t.size;
    printf("fig4 error_max %.3g at %.3f progress_min %.2e at %.3f enriched %d of %d within %.3f\n",
           i.error[worst], we, i.progress[low], wp, inside, n, reach);
    printf("fig8 newton_step_at_tip %.3f of_the_largest_at %.3f\n", tip_move, wm);
    judge("fig4: highest error and lowest progress at the tip, enriched nodes there",
          we < 0.2 && wp < 0.2 && i.error[worst] > 0.5 && i.progress[low] < 1e-4 && inside > 0 &&
              near / inside < 0.4);
    judge("fig8: the full-space Newton step is largest elsewhere", tip_move < 0.9 && wm > 0.2);
    close_run(&r), close_run(&full);
}

// Fig. 5: a deformed cube that slides as a whole: error above the threshold, nothing enriched.
static void fig5(void) {
    keys k = sized("bodies.0.shape.cells=[6,6,6]", NULL, NULL);
    run r;
    tss_subspace_info i;
    double error = 0, strain = 0;
    int enriched = 0;
    open_run(&r, "fig5_ramp", &k);
    for (int s = 0; s < r.s.world.steps; s++) {
        step(&r);
        if (2 * s < r.s.world.steps) continue;
        enriched = r.info.enriched_nodes > enriched ? r.info.enriched_nodes : enriched;
        if (s + 1 < r.s.world.steps) continue;
        if (tss_subspace_query(r.w) != TSS_OK) stop(&r, "query");
        tss_subspace_get_info(r.sub, &i);
        for (int j = 0; j < r.info.nodes; j++) error = fmax(error, i.error[j]);
    }
    strain = 1 - r.info.min_J;
    const double *v = tss_world_velocities(r.w);
    printf("fig5 error %.3g enriched_second_half %d compressed %.3f speed %.3f\n", error, enriched,
           strain, sqrt(v[0] * v[0] + v[1] * v[1] + v[2] * v[2]));
    judge("fig5: slides with an error above the threshold and nothing enriched",
          error > 0.5 && enriched == 0);
    close_run(&r);
}

// Volume of the enriched nodes over the body's; *groups: how many hold such nodes.
static double volume(const run *r, int body, int *groups) {
    tss_subspace_info i;
    double in = 0, all = 0;
    const double *m = tss_world_masses(r->w);
    tss_subspace_get_info(r->sub, &i);
    char *seen = (char *)calloc((size_t)i.groups + 1, 1);
    if (!seen) stop(r, "out of memory");
    *groups = 0;
    for (int j = r->s.body[body].first; j < r->s.body[body].first + r->s.body[body].mesh.nodes;
         j++) {
        all += m[j];
        if (!i.enriched[j]) continue;
        in += m[j];
        if (i.group[j] >= 0) *groups += !seen[i.group[j]], seen[i.group[j]] = 1;
    }
    free(seen);
    return in / all;
}

// Mean enriched volume of the last three steps of the cube; *groups: enriched at the end. mesh,
// extra: keys, or NULL.
static double cube(const char *mesh, const char *extra, int *groups) {
    keys k = {{NULL}, 0};
    run r;
    double sum = 0;
    if (mesh) add(&k, mesh);
    if (extra) add(&k, extra);
    open_run(&r, "fig9_cube", &k);
    for (int s = 0; s < r.s.world.steps; s++) {
        step(&r);
        double v = volume(&r, 0, groups);
        sum += s + 3 < r.s.world.steps ? 0 : v / 3;
    }
    close_run(&r);
    return sum;
}

// Fig. 9: what is enriched depends on the material, not on the mesh. Graded: cells grow threefold
// upwards and twofold across, so that no two sides of the spike see the same mesh.
static void fig9(void) {
    int g[4];
    double coarse = cube("bodies.0.shape.cells=[16,16,16]", NULL, g);
    double fine = cube("bodies.0.shape.cells=[22,22,22]", NULL, g + 1);
    double graded =
        cube("bodies.0.shape.cells=[18,18,18]", "bodies.0.shape.grade=[2,3,2]", g + 2);
    double stiff = cube("bodies.0.shape.cells=[16,16,16]", "bodies.0.material.E=1e8", g + 3);
    double least = fmin(coarse, fmin(fine, graded)), most = fmax(coarse, fmax(fine, graded));
    printf("fig9 coarse %.3f fine %.3f graded %.3f stiff %.3f spread %.2f groups %d %d %d\n",
           coarse, fine, graded, stiff, most / least, g[0], g[1], g[2]);
    judge("fig9: alike on three meshes, at twenty groups or more, none when stiff",
          least > 0 && most <= 1.25 * least && stiff == 0 && g[0] >= 20 && g[1] >= 20 &&
              g[2] >= 20);
}

// Fig. 10: bending modes come in at contact, none before.
static void fig10(void) {
    keys k = sized("bodies.0.shape.cells=[30,4,4]", NULL, NULL);
    run r;
    int before = 0;
    open_run(&r, "fig10_beam", &k);
    do step(&r), before = r.info.contacts == 0 ? r.info.active_modes : before;
    while (r.info.contacts == 0);
    advance(&r, r.s.world.steps - r.steps);
    printf("fig10 modes_before %d modes_most %d of %d enriched_most %.3f\n", before, r.most_modes,
           r.info.modes, share(&r));
    judge("fig10: modes join at contact", before == 12 && r.most_modes > 12);
    close_run(&r);
}

// Fig. 11: downdating keeps the motion with a fraction of the unknowns.
static void fig11(void) {
    keys k = sized("bodies.0.shape.cells=[16,3,8]", "bodies.1.shape.cells=14", "world.steps=20");
    run with, without;
    whole(&with, "fig11_roller", &k);
    add(&k, "solver.downdate=0");
    whole(&without, "fig11_roller", &k);
    double a = with.enriched_sum / with.steps, b = without.enriched_sum / without.steps,
           d = apart(&with, &without);
    printf("fig11 apart %.2e enriched %.3f without %.3f seconds %.1f without %.1f speedup %.2f\n",
           d, a, b, with.seconds, without.seconds, without.seconds / with.seconds);
    judge("fig11: the same motion with fewer unknowns", d < 0.01 && a < 0.6 * b);
    close_run(&with), close_run(&without);
}

// Mean of the full-space residual over the five steps with the most Newton iterates among those that
// begin in contact; *part: share enriched there, *modes: active there. The step of the impact itself
// is left out: at 0.01 it has strains below the threshold left over, and a residual above the
// tolerance (see throughout).
static double hardest(const char *extra, const char *also, double *part, double *modes) {
    keys k = sized("bodies.0.shape.cells=22", "world.steps=8", NULL);
    double res[64], count[64], en[64], mo[64], sum = 0;
    run r;
    int n = 0, taken[64] = {0};
    add(&k, extra), add(&k, also);
    open_run(&r, "fig12_boat", &k);
    for (int s = 0; s < r.s.world.steps && n < 64; s++) {
        int touching = r.info.contacts > 0;
        step(&r);
        if (!touching) continue;
        res[n] = r.info.residual_newton, count[n] = r.info.newton;
        en[n] = (double)r.info.enriched_nodes / r.info.nodes, mo[n++] = r.info.active_modes;
    }
    if (n < 5) stop(&r, "fewer than five steps in contact");
    *part = *modes = 0;
    for (int q = 0; q < 5; q++) {
        int best = -1;
        for (int s = 0; s < n; s++)
            if (!taken[s] && (best < 0 || count[s] > count[best])) best = s;
        taken[best] = 1, sum += res[best] / 5, *part += en[best] / 5, *modes += mo[best] / 5;
    }
    close_run(&r);
    return sum;
}

// Largest full-space residual of all steps, the impact included; *part: share enriched in it.
static double throughout(const char *extra, double *part) {
    keys k = sized("bodies.0.shape.cells=22", "world.steps=8", NULL);
    double most = 0;
    run r;
    add(&k, extra), add(&k, "solver.error_modes=0.5");
    open_run(&r, "fig12_boat", &k);
    *part = 0;
    for (int s = 0; s < r.s.world.steps; s++) {
        step(&r);
        if (r.info.residual_newton < most) continue;
        most = r.info.residual_newton, *part = (double)r.info.enriched_nodes / r.info.nodes;
    }
    close_run(&r);
    return most;
}

// Fig. 12: the thresholds trade nodes and modes for the full-space residual.
static void fig12(void) {
    static const char *const nodes[] = {"solver.error_nodes=10", "solver.error_nodes=1",
                                        "solver.error_nodes=0.3", "solver.error_nodes=0.1",
                                        "solver.error_nodes=0.01"};
    static const char *const modal[] = {"solver.error_modes=10", "solver.error_modes=0.5",
                                        "solver.error_modes=0.02"};
    double res[5], part[5], modes[5], mr[3], mp[3], mm[3];
    int falls = 1, grows = 1;
    for (int k = 0; k < 5; k++) {
        res[k] = hardest(nodes[k], "solver.error_modes=0.5", &part[k], &modes[k]);
        printf("fig12 %s enriched %.3f modes %.0f residual %.2e\n", nodes[k] + 7, part[k], modes[k],
               res[k]);
        fflush(stdout);
        if (k) falls &= res[k] <= res[k - 1], grows &= part[k] >= part[k - 1];
    }
    for (int k = 0; k < 3; k++) {
        mr[k] = hardest(modal[k], "solver.error_nodes=0.5", &mp[k], &mm[k]);
        printf("fig12 %s enriched %.3f modes %.0f residual %.2e\n", modal[k] + 7, mp[k], mm[k],
               mr[k]);
        fflush(stdout);
    }
    double all_part[2], all[2] = {throughout("solver.error_nodes=0.01", all_part),
                                  throughout("solver.error_nodes=0.005", all_part + 1)};
    for (int k = 0; k < 2; k++)
        printf("fig12 all_steps error_nodes=%s worst_residual %.2e enriched %.3f\n",
               k ? "0.005" : "0.01", all[k], all_part[k]);
    judge("fig12: residual falls and nodes grow with the nodal threshold", falls && grows);
    judge("fig12: at 0.01 the full-space tolerance is met in the steps that begin in contact",
          res[4] <= 1e-3 && part[4] > 0.95);
    judge("fig12: at 0.005 it is met in every step, the impact included", all[1] <= 1e-3);
    judge("fig12: modes grow with the modal threshold",
          mm[0] <= mm[1] && mm[1] <= mm[2] && mm[2] > mm[0]);
}

// Fig. 13: one step from the middle of an adaptive run, against full space.
static void fig13(void) {
    keys k = sized("bodies.0.shape.cells=16", "bodies.1.shape.cells=12", "world.steps=16");
    run r, full;
    open_run(&r, "fig13_city", &k);
    advance(&r, r.s.world.steps - 1);
    add(&k, "solver.mode=\"full\"");
    open_run(&full, "fig13_city", &k);
    if (tss_world_copy_state(full.w, r.w) != TSS_OK) stop(&full, "copy");
    size_t nd = (size_t)(3 * tss_world_nodes(r.w));
    double *start = (double *)malloc(nd * sizeof *start), most = 0, sum = 0, move = 0;
    if (!start) stop(&r, "out of memory");
    memcpy(start, tss_world_positions(r.w), nd * sizeof *start);
    step(&r), step(&full);
    const double *x = tss_world_positions(r.w), *y = tss_world_positions(full.w);
    int worst = 0, n = tss_world_nodes(r.w);
    for (int i = 0; i < n; i++) {
        double e = distance3(x + 3 * i, y + 3 * i);
        if (e > most) most = e, worst = i;
        sum += e / n, move = fmax(move, distance3(y + 3 * i, start + 3 * i));
    }
    double *force = (double *)malloc(nd * sizeof *force), deep = INFINITY, zero[3] = {0, 0, 0};
    if (!force || tss_ipc_forces(full.ipc, force) != TSS_OK) stop(&full, "forces");
    for (int i = 0; i < n; i++)
        if (distance3(force + 3 * i, zero) > 0)
            deep = fmin(deep, distance3(y + 3 * i, y + 3 * worst));
    deep /= tss_world_diagonal(r.w);
    printf(
        "fig13 error_max %.3e m mean %.3e m of_motion %.3f from_a_contact %.3f enriched %.3f "
        "newton %d full %d\n",
        most, sum, most / move, deep, (double)r.info.enriched_nodes / r.info.nodes, r.info.newton,
        full.info.newton);
    judge("fig13: the error of a step is largest by a contact and small elsewhere",
          deep < 0.05 && sum < 0.05 * most);
    free(start), free(force);
    close_run(&r), close_run(&full);
}

// steps: until the deepest compression.
static double jello(const char *E, const char *steps) {
    keys k = sized("bodies.0.shape.cells=[14,7,14]", "bodies.1.shape.cells=11", NULL);
    run r;
    add(&k, E), add(&k, steps);
    whole(&r, "fig14_jello", &k);
    printf("fig14 E %s enriched_most %.3f modes_most %d of %d\n", strchr(E, '=') + 1, share(&r),
           r.most_modes, r.info.modes);
    double part = share(&r);
    close_run(&r);
    return part;
}

// Fig. 14: the stiffer the jello, the fewer nodes.
static void fig14(void) {
    double soft = jello("bodies.0.material.E=1e5", "world.steps=22");
    double rubber = jello("bodies.0.material.E=1e6", "world.steps=10");
    double stiff = jello("bodies.0.material.E=1e9", "world.steps=10");
    judge("fig14: enrichment falls with stiffness, to none",
          soft > rubber && rubber > 0 && stiff == 0);
}

// Share enriched when 25 ms have passed; the fist meets the head after 5.5 ms.
static double fist(const char *dt, const char *steps) {
    keys k = sized("bodies.0.shape.cells=12", "bodies.1.shape.cells=12", NULL);
    run r;
    add(&k, dt), add(&k, steps);
    whole(&r, "fig15_fist", &k);
    double part = (double)r.info.enriched_nodes / r.info.nodes;
    printf("fig15 %s enriched_end %.3f most %.3f mean %.3f newton %.1f\n", dt + 6, part, share(&r),
           r.enriched_sum / r.steps, (double)r.newton / r.steps);
    fflush(stdout);
    close_run(&r);
    return part;
}

// Fig. 15: shorter steps resolve the shock that crosses the head, with more nodes.
static void fig15(void) {
    double a = fist("world.dt=5e-3", "world.steps=5"), b = fist("world.dt=5e-4", "world.steps=50");
    judge("fig15: a step ten times shorter asks for more nodes", a < b);
    if (!small_) fist("world.dt=5e-5", "world.steps=500");
}

// Fig. 17: the better the basis, the fewer nodes.
static void fig17(void) {
    static const char *const basis[] = {
        "bodies.0.basis={\"kind\": \"skinning\", \"count\": 15, \"initial\": -1}",
        "bodies.0.basis={\"kind\": \"biharmonic\", \"count\": 64, \"initial\": -1}",
        "bodies.0.basis={\"kind\": \"eigen\", \"count\": 48, \"initial\": -1}"};
    static const char *const name[] = {"skinning", "biharmonic", "eigen"};
    double mean[3];
    for (int b = 0; b < 3; b++) {
        keys k = sized("bodies.0.shape.cells=[40,4,4]", NULL, NULL);
        run r;
        add(&k, basis[b]);
        whole(&r, "fig10_beam", &k);
        mean[b] = r.enriched_sum / r.steps;
        printf("fig17 %s modes %d enriched_mean %.3f most %.3f\n", name[b], r.info.modes, mean[b],
               share(&r));
        close_run(&r);
    }
    judge("fig17: skinning needs fewer nodes than biharmonic, that fewer than eigenmodes",
          mean[0] < mean[1] && mean[1] < mean[2]);
}

// The koosh with one basis against the positions of the full-space run, steps × nodes × 3. Returns
// the largest distance of a node in any step over the diagonal; *mean: share enriched.
static double koosh(const char *name, const char *basis, const double *full, double *mean) {
    keys k = sized("bodies.0.shape.cells=16", NULL, NULL);
    run r;
    double most = 0;
    if (basis) add(&k, basis);
    open_run(&r, "fig18_koosh", &k);
    size_t n = (size_t)tss_world_nodes(r.w);
    for (int s = 0; s < r.s.world.steps; s++) {
        step(&r);
        const double *x = tss_world_positions(r.w), *y = full + 3 * n * (size_t)s;
        for (size_t i = 0; i < n; i++) most = fmax(most, distance3(x + 3 * i, y + 3 * i));
    }
    most /= tss_world_diagonal(r.w);
    *mean = r.enriched_sum / r.steps;
    printf("fig18 %s modes %d apart %.4f enriched_mean %.3f most %.3f newton %.1f\n", name,
           r.info.modes, most, *mean, share(&r), (double)r.newton / r.steps);
    fflush(stdout);
    close_run(&r);
    return most;
}

// Fig. 18: modes made for smooth bodies do not serve tentacles; those of snapshots come closer to
// full space, and still need nodes.
static void fig18(void) {
    keys k = sized("bodies.0.shape.cells=16", NULL, NULL);
    const char *file = "fig18.snp";
    char pod[600];
    run full;
    add(&k, "solver.mode=\"full\"");
    open_run(&full, "fig18_koosh", &k);
    size_t nd = 3 * (size_t)tss_world_nodes(full.w);
    double *x = (double *)malloc(nd * (size_t)full.s.world.steps * sizeof *x), nodes, modes;
    if (!x) stop(&full, "out of memory");
    for (int s = 0; s < full.s.world.steps; s++) {
        step(&full);
        memcpy(x + nd * (size_t)s, tss_world_positions(full.w), nd * sizeof *x);
        if (!scene_snapshot(file, full.w, s, &full.why)) stop(&full, "snapshots");
    }
    snprintf(
        pod, sizeof pod,
        "bodies.0.basis={\"kind\": \"pod\", \"count\": 11, \"initial\": -1, \"snapshots\": \"%s\"}",
        file);
    double skin = koosh("skinning", NULL, x, &nodes), snap = koosh("pod", pod, x, &modes);
    judge("fig18: modes of snapshots come closer to full space with fewer nodes, not with none",
          snap < 0.25 * skin && modes < nodes && modes > 0.05);
    remove(file);
    free(x), close_run(&full);
}

// A pile of bodies that deform as affine: the modal system is block-sparse.
static void pile(void) {
    keys k = sized("world.steps=8", NULL, NULL);
    run r;
    tss_subspace_info i;
    whole(&r, "pile", &k);
    tss_subspace_get_info(r.sub, &i);
    printf(
        "pile bodies %d nodes %d modes %d enriched_most %.3f newton %.1f seconds_a_step %.3f "
        "not_converged %d\n",
        i.bodies, r.info.nodes, i.modes, share(&r), (double)r.newton / r.steps, r.seconds / r.steps,
        r.bad);
    judge("pile: a hundred bodies, every step converged",
          i.bodies == 100 && r.bad == 0 && r.info.contacts > 50);
    close_run(&r);
}

// ---------------------------------------------------------------------------------------------
// >>main
// ---------------------------------------------------------------------------------------------

static const struct {
    const char *name;
    void (*measure)(void);
} figures[] = {{"fig2", fig2},   {"fig4", fig4},   {"fig5", fig5},   {"fig9", fig9},
               {"fig10", fig10}, {"fig11", fig11}, {"fig12", fig12}, {"fig13", fig13},
               {"fig14", fig14}, {"fig15", fig15}, {"fig17", fig17}, {"fig18", fig18},
               {"pile", pile}};

int main(int argc, char **argv) {
    int found = 0;
    if (argc < 3) {
        fputs("usage: bench_figures SCENES [--small] NAME... | all\n", stderr);
        return 2;
    }
    scenes = argv[1];
    for (int k = 2; k < argc; k++) {
        if (strcmp(argv[k], "--small") == 0) small_ = 1;
        for (size_t f = 0; f < sizeof figures / sizeof *figures; f++) {
            if (strcmp(argv[k], "all") != 0 && strcmp(argv[k], figures[f].name) != 0) continue;
            figures[f].measure();
            found++, fflush(stdout);
        }
    }
    return found == 0 ? 2 : failures > 0;
}
