// bench_ipcenergy A.ply B.ply: one Newton iterate's worth of contact work between two states of a
// cloth: wall seconds, 2 threads, best of 5. A world that only has a surface stands in for tss.h.
#define TSS_IMPLEMENTATION
#include "mock_world.h"
#include "tss_ipc.h"

#include <stdlib.h>
#include <time.h>

struct tss_world { tss_host host; int n, tris, edges; double *x, *y; int *tri, *edge, *point; uint8_t *kind; tss_energy_def def; };
tss_result tss_world_surface(const tss_world *w, tss_surface *o) { tss_surface s = {w->n, w->edges, w->tris, w->point, w->edge, w->tri, 1}; *o = s; return TSS_OK; }
tss_energy_def tss_energy_def_default(void) { tss_energy_def d; memset(&d, 0, sizeof d); return d; }
tss_result tss_energy_add(tss_world *w, const tss_energy_def *d, tss_energy *o) { w->def = *d, *o = 0; return TSS_OK; }
tss_result tss_energy_remove(tss_world *w, tss_energy e) { (void)e; w->def.destroy(w->def.user, &w->host); return TSS_OK; }
const tss_host *tss_world_host(const tss_world *w) { return &w->host; }
int tss_world_dim(const tss_world *w) { (void)w; return 3; }
int tss_world_nodes(const tss_world *w) { return w->n; }
const double *tss_world_positions(const tss_world *w) { return w->x; }
const double *tss_world_rest(const tss_world *w) { return w->x; }
const uint8_t *tss_world_kinds(const tss_world *w) { return w->kind; }

static double now(void) { struct timespec t; timespec_get(&t, TIME_UTC); return (double)t.tv_sec + 1e-9 * (double)t.tv_nsec; }
static uint32_t big(FILE *f) { unsigned char b[4]; if (fread(b, 1, 4, f) != 4) exit(1); return (uint32_t)b[0] << 24 | (uint32_t)b[1] << 16 | (uint32_t)b[2] << 8 | b[3]; }
static int by_edge(const void *a, const void *b) { const int *p = (const int *)a, *q = (const int *)b; return p[0] != q[0] ? (p[0] > q[0]) - (p[0] < q[0]) : (p[1] > q[1]) - (p[1] < q[1]); }
static double *read_ply(const char *name, tss_world *w) {
    char line[256]; FILE *f = fopen(name, "rb"); if (!f) exit(1);
    while (fgets(line, sizeof line, f) && strncmp(line, "end_header", 10)) { sscanf(line, "element vertex %d", &w->n); sscanf(line, "element face %d", &w->tris); }
    double *x = (double *)malloc(24 * (size_t)w->n); w->tri = (int *)malloc(12 * (size_t)w->tris);
    for (int i = 0; i < 3 * w->n; i++) { uint32_t u = big(f); float v; memcpy(&v, &u, 4); x[i] = v; }
    for (int i = 0; i < w->tris; i++) { fgetc(f); for (int k = 0; k < 3; k++) w->tri[3 * i + k] = (int)big(f); }
    fclose(f); return x;
}

static tss_ctx ctx; static tss_stencils s; static tss_world w; static double *d_, *out_; static int what_;
static void block(int b, int worker, void *arg) {
    (void)worker, (void)arg; static const int width[3] = {1, 12, 144}; double buf[64 * 144];
    tss_ids ids = {64 * b, s.count - 64 * b < 64 ? s.count - 64 * b : 64, NULL};
    if (what_ == 0) w.def.value(w.def.user, &ctx, w.x, ids, buf); else if (what_ == 1) w.def.gradient(w.def.user, &ctx, w.x, ids, buf); else w.def.hessian(w.def.user, &ctx, w.x, ids, 1, buf);
    double sum = 0; for (int i = 0; i < ids.count * width[what_]; i += 13) sum += buf[i]; out_[b] = sum;
}

int main(int argc, char **argv) {
    if (argc < 3) return 1;
    w.y = read_ply(argv[2], &w), w.x = read_ply(argv[1], &w), w.host = tss_host_default(), w.host.workers = 2;
    w.edge = (int *)malloc(24 * (size_t)w.tris); int *all = (int *)malloc(24 * (size_t)w.tris);
    for (int i = 0; i < 3 * w.tris; i++) { int a = w.tri[i], b = w.tri[i / 3 * 3 + (i + 1) % 3]; all[2 * i] = a < b ? a : b, all[2 * i + 1] = a < b ? b : a; }
    qsort(all, (size_t)(3 * w.tris), 8, by_edge);
    for (int i = 0; i < 3 * w.tris; i++) if (!i || by_edge(all + 2 * i, all + 2 * i - 2)) { w.edge[2 * w.edges] = all[2 * i], w.edge[2 * w.edges++ + 1] = all[2 * i + 1]; }
    w.point = (int *)malloc(4 * (size_t)w.n), w.kind = (uint8_t *)calloc((size_t)w.n, 1); double *mass = (double *)malloc(8 * (size_t)w.n); int *body = (int *)calloc((size_t)w.n, 4); d_ = (double *)malloc(24 * (size_t)w.n);
    double lo[3] = {1e9, 1e9, 1e9}, hi[3] = {-1e9, -1e9, -1e9}, diag = 0;
    for (int i = 0; i < w.n; i++) { w.point[i] = i, mass[i] = 1e-5; for (int a = 0; a < 3; a++) lo[a] = fmin(lo[a], w.x[3 * i + a]), hi[a] = fmax(hi[a], w.x[3 * i + a]), d_[3 * i + a] = w.y[3 * i + a] - w.x[3 * i + a]; }
    for (int a = 0; a < 3; a++) diag += (hi[a] - lo[a]) * (hi[a] - lo[a]);
    ctx.host = &w.host, ctx.dim = 3, ctx.nodes = w.n, ctx.h = 0.01, ctx.ah2 = 1e-4, ctx.diagonal = sqrt(diag), ctx.X = ctx.x_t = ctx.x_tilde = w.x, ctx.v_t = d_, ctx.mass = mass, ctx.kind = w.kind, ctx.body = body, ctx.topology = 1;
    tss_ipc_def def = tss_ipc_def_default(); def.dhat = 1e-3 * ctx.diagonal; tss_ipc *p; tss_ipc_info info;
    if (tss_ipc_add(&w, &def, &p)) return 1;
    double best[8]; for (int i = 0; i < 8; i++) best[i] = 1e9; double step = 0; int who = -1;
    for (int k = 0; k < 5; k++) {
        double t[9]; t[0] = now(); p->active_known = 0; w.def.begin_step(p, &ctx);
        t[1] = now(); w.def.lists(p, &ctx, w.x, NULL, 0, &s); out_ = (double *)malloc(8 * (size_t)(s.count / 64 + 1));
        for (what_ = 0; what_ < 3; what_++) { t[2 + what_] = now(); tss_parallel(&w.host, (s.count + 63) / 64, block, NULL); }
        t[5] = now(); w.def.lists(p, &ctx, w.x, d_, 1, &s);
        t[6] = now(); step = w.def.max_step(p, &ctx, w.x, d_, 1, &who); for (int i = 0; i < 3 * w.n; i++) out_ = out_, w.y[i] = w.x[i] + step * d_[i];
        t[7] = now(); w.def.after_iterate(p, &ctx, w.x, w.y); t[8] = now(); free(out_);
        for (int i = 0; i < 8; i++) best[i] = fmin(best[i], t[i + 1] - t[i]);
    }
    tss_ipc_get_info(p, &info);
    const char *name[8] = {"begin_step (search at x, kappa)", "lists at x (known)", "value", "gradient", "PSD Hessian", "lists on the sweep", "max_step", "after_iterate (active at new x)"};
    for (int i = 0; i < 8; i++) printf("%-34s %.4f s\n", name[i], best[i]);
    printf("candidates %d, kept %d, active %d, step %.6f, bytes %.0f MB, dhat %g\n", info.candidates, info.kept, info.active, step, (double)info.bytes / 1e6, info.dhat);
    tss_energy_remove(&w, 0); return 0;
}
