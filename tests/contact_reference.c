// contact_reference FILE...: checks distances, barrier, mollifier, friction and additive CCD
// against a table of numbers computed with another library, one line a state:
//   kind, inputs n, outputs m, inputs..., outputs...
// Kinds: pp pe pt ee (squared distance, gradient, Hessian of the printed case) · b (barrier) ·
// m (edge-edge mollifier) · f (friction) · aptccd aeeccd (time of impact).
// A row passes if |ours - theirs| <= 1e-9 max|row| for all of its outputs; the closest distance may
// also be smaller than the printed case's; a time of impact must not be later than the true one,
// which is computed here from the coplanarity cubic in extended precision. Prints numbers a file
// and a kind; exit 1 if a row fails or a file is unreadable or malformed.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <errno.h>
#include <stdio.h>
#include <stdlib.h>

enum { MAX_IN = 24, MAX_OUT = 158, KINDS = 9, MAX_LINE = 1 << 16 };

static const struct row_kind {
    const char *name;
    int inputs, outputs;
} kinds[KINDS] = {{"pp", 6, 43},  {"pe", 9, 92}, {"pt", 12, 158},   {"ee", 12, 158},  {"b", 2, 3},
                  {"m", 13, 158}, {"f", 2, 4},   {"aptccd", 24, 2}, {"aeeccd", 24, 2}};

typedef struct stats {
    int passed, failed;
    double worst;        // largest |ours − theirs| / max|row|
    int smaller, early;  // closest distance below the printed; CCD stops without a collision
    double lead;         // largest (true − ours) time of impact
} stats;

// Largest |a − b| relative to the largest |b|.
static double row_error(const double *a, const double *b, int n) {
    double error = 0, size = 0;
    for (int i = 0; i < n; i++) {
        double d = fabs(a[i] - b[i]);
        if (!(d <= error)) error = d;  // not a number is an error too
        if (fabs(b[i]) > size) size = fabs(b[i]);
    }
    return size > 0 ? error / size : error;
}

static double check_distance(tss_ipc_kind kind, const double *in, const double *out, stats *s) {
    double ours[157];
    int feature = kind == TSS_IPC_POINT_POINT ? 0 : (int)out[0], n = 3 * tss_ipc_pair_nodes(kind);
    const double *theirs = kind == TSS_IPC_POINT_POINT ? out : out + 1;
    ours[0] = tss_ipc_feature_distance(kind, 3, feature, in, ours + 1, ours + 1 + n);
    double error = row_error(ours, theirs, 1 + n + n * n);
    // Our own choice of the closest feature: the same distance, or a smaller one.
    double closest = tss_ipc_distance(kind, 3, in, NULL);
    if (closest < theirs[0] * (1 - 1e-6)) s->smaller++;
    if (closest > theirs[0] * (1 + 1e-6)) error = 1;
    return error;
}

// --- the true time of impact -------------------------------------------------------------------

typedef long double real;

static void at_time(const double *in, real t, real p[4][3]) {
    for (int i = 0; i < 12; i++) p[i / 3][i % 3] = (1 - t) * in[i] + t * in[12 + i];
}
static void sub(const real *a, const real *b, real *o) {
    for (int i = 0; i < 3; i++) o[i] = a[i] - b[i];
}
static void cross(const real *a, const real *b, real *o) {
    for (int i = 0; i < 3; i++)
        o[i] = a[(i + 1) % 3] * b[(i + 2) % 3] - a[(i + 2) % 3] * b[(i + 1) % 3];
}
static real dot(const real *a, const real *b) { return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]; }

// Volume spanned by the four points: a cubic in t.
static real volume(const double *in, real t) {
    real p[4][3], a[3], b[3], c[3], n[3];
    at_time(in, t, p);
    sub(p[1], p[0], a), sub(p[2], p[0], b), sub(p[3], p[0], c);
    cross(a, b, n);
    return dot(n, c);
}

// Do the coplanar primitives meet at t? (parameters inside, to rounding)
static int meet(int edges, const double *in, real t) {
    real p[4][3], e[3], f[3], w[3], n[3], u[3], v[3], tiny = 1e-12L;
    at_time(in, t, p);
    if (edges) {
        sub(p[1], p[0], e), sub(p[3], p[2], f), sub(p[2], p[0], w);
        cross(e, f, n), cross(w, f, u), cross(w, e, v);
        real s = dot(u, n) / dot(n, n), r = dot(v, n) / dot(n, n);
        return s >= -tiny && s <= 1 + tiny && r >= -tiny && r <= 1 + tiny;
    }
    sub(p[2], p[1], e), sub(p[3], p[1], f), sub(p[0], p[1], w);
    cross(e, f, n), cross(w, f, u), cross(e, w, v);
    real s = dot(u, n) / dot(n, n), r = dot(v, n) / dot(n, n);
    return s >= -tiny && r >= -tiny && s + r <= 1 + tiny;
}

// First root of the cubic at which the primitives meet; 2: none in [0, 1].
static real true_impact(int edges, const double *in) {
    // The cubic from four values, the ends of its monotone pieces from the derivative.
    real f0 = volume(in, 0), f1 = volume(in, 1), fm = volume(in, -1), f2 = volume(in, 2);
    real d = f0, b = (f1 + fm) / 2 - f0, a = (f2 - f0 - 4 * b - (f1 - fm)) / 6,
         c = (f1 - fm) / 2 - a;
    real cut[4] = {0, 1, 1, 1}, disc = b * b - 3 * a * c;
    int cuts = 1;
    if (disc > 0) {
        real q = -(b + (b < 0 ? -1 : 1) * sqrtl(disc));
        real r[2] = {q / (3 * a), c / q};
        if (r[0] > r[1]) {
            real x = r[0];
            r[0] = r[1];
            r[1] = x;
        }
        for (int i = 0; i < 2; i++)
            if (r[i] > cut[cuts - 1] && r[i] < 1) cut[cuts++] = r[i];
    }
    cut[cuts] = 1;
    for (int i = 0; i < cuts; i++) {
        real lo = cut[i], hi = cut[i + 1];
        real at = ((a * lo + b) * lo + c) * lo + d, end = ((a * hi + b) * hi + c) * hi + d;
        if ((at > 0) == (end > 0)) continue;
        for (int k = 0; k < 80; k++) {
            real mid = (lo + hi) / 2, fmid = ((a * mid + b) * mid + c) * mid + d;
            if ((fmid > 0) == (at > 0))
                lo = mid;
            else
                hi = mid;
        }
        if (meet(edges, in, lo)) return lo;
    }
    return 2;
}

static double check_ccd(int edges, const double *in, const double *out, stats *s) {
    const double slack = 0.1;
    tss_ipc_kind kind = edges ? TSS_IPC_EDGE_EDGE : TSS_IPC_POINT_TRIANGLE;
    double move[12], then[12];
    for (int i = 0; i < 12; i++) move[i] = in[12 + i] - in[i];
    double ours = tss_ipc_ccd(kind, 3, in, move, slack, 1, 0, NULL);
    double truth = (double)true_impact(edges, in);
    // Later than the true one, or silent about a collision the table knows of: wrong.
    if (ours > truth || (out[0] != 0 && out[1] < 1 && truth <= 1 && ours >= 1)) return 1;
    if (ours < 1 && truth > 1) s->early++;
    if (truth <= 1) s->lead = fmax(s->lead, truth - ours);
    // It may stop only where the distance is nearly down to the slack.
    for (int i = 0; i < 12; i++) then[i] = in[i] + ours * move[i];
    double left = sqrt(tss_ipc_distance(kind, 3, then, NULL) / tss_ipc_distance(kind, 3, in, NULL));
    return ours < 1 && left > 1.2 * slack ? 1 : 0;
}

static double check_row(int kind, const double *in, const double *out, stats *s) {
    double ours[158];
    switch (kind) {
        case 0:
            return check_distance(TSS_IPC_POINT_POINT, in, out, s);
        case 1:
            return check_distance(TSS_IPC_POINT_EDGE, in, out, s);
        case 2:
            return check_distance(TSS_IPC_POINT_TRIANGLE, in, out, s);
        case 3:
            return check_distance(TSS_IPC_EDGE_EDGE, in, out, s);
        case 4:
            ours[0] = tss_ipc_barrier(in[0], in[1], ours + 1, ours + 2);
            return row_error(ours, out, 3);
        case 5: {
            // ‖ea × eb‖² has no function of its own: from the printed edges.
            double e[3], f[3], n[3];
            for (int i = 0; i < 3; i++) e[i] = in[3 + i] - in[i], f[i] = in[9 + i] - in[6 + i];
            for (int i = 0; i < 3; i++) {
                int j = (i + 1) % 3, k = (i + 2) % 3;
                n[i] = e[j] * f[k] - e[k] * f[j];
            }
            ours[0] = n[0] * n[0] + n[1] * n[1] + n[2] * n[2];
            ours[1] = tss_ipc_mollifier(in, in[12], ours + 2, ours + 14);
            return row_error(ours, out, 158);
        }
        case 6:
            tss_ipc_friction(in[0], in[1], ours);
            return row_error(ours, out, 4);
        default:
            return check_ccd(kind == 8, in, out, s);
    }
}

// --- the file ----------------------------------------------------------------------------------

// Reads n numbers, each after a comma. Returns the rest of the line or NULL.
static const char *read_numbers(const char *at, int n, double *out) {
    for (int i = 0; i < n; i++) {
        char *end;
        if (*at != ',') return NULL;
        out[i] = strtod(at + 1, &end);
        if (end == at + 1 || !isfinite(out[i])) return NULL;
        at = end;
    }
    return at;
}

// The row's kind, or −1; reason says what was expected.
static int read_row(const char *line, double *in, double *out, char *reason, size_t size) {
    int kind = 0;
    size_t length = strcspn(line, ",\r\n");
    while (kind < KINDS &&
           (strlen(kinds[kind].name) != length || strncmp(line, kinds[kind].name, length) != 0))
        kind++;
    if (kind == KINDS) {
        snprintf(reason, size, "unknown kind '%.*s'", (int)(length < 20 ? length : 20), line);
        return -1;
    }
    double counts[2];
    const char *at = read_numbers(line + length, 2, counts);
    if (!at || counts[0] != kinds[kind].inputs || counts[1] != kinds[kind].outputs) {
        snprintf(reason, size, "'%s' needs %d inputs and %d outputs", kinds[kind].name,
                 kinds[kind].inputs, kinds[kind].outputs);
        return -1;
    }
    at = read_numbers(at, kinds[kind].inputs, in);
    if (at) at = read_numbers(at, kinds[kind].outputs, out);
    if (!at || at[strspn(at, " \r\n")] != 0) {
        snprintf(reason, size, "expected %d finite numbers",
                 kinds[kind].inputs + kinds[kind].outputs);
        return -1;
    }
    return kind;
}

// A printed feature outside its range would read beyond the tables.
static int feature_in_range(int kind, const double *out) {
    static const int count[4] = {1, 3, 7, 9};
    return kind == 0 || kind > 3 ||
           (out[0] >= 0 && out[0] < count[kind] && out[0] == floor(out[0]));
}

static int check_file(const char *name, stats all[KINDS], char *line) {
    FILE *f = fopen(name, "r");
    double in[MAX_IN], out[MAX_OUT];
    int number = 0, rows = 0;
    if (!f) {
        fprintf(stderr, "%s: cannot be opened: %s\n", name, strerror(errno));
        return 0;
    }
    while (fgets(line, MAX_LINE, f)) {
        char reason[160];
        number++;
        if (line[strspn(line, " \r\n")] == 0) continue;
        int kind = read_row(line, in, out, reason, sizeof reason);
        if (kind >= 0 && !feature_in_range(kind, out)) {
            snprintf(reason, sizeof reason, "no such case: %g", out[0]);
            kind = -1;
        }
        if (kind < 0) {
            fprintf(stderr, "%s:%d: %s\n", name, number, reason);
            fclose(f);
            return 0;
        }
        double error = check_row(kind, in, out, &all[kind]);
        int ok = error <= 1e-9;
        if (!(error <= all[kind].worst)) all[kind].worst = error;
        all[kind].passed += ok, all[kind].failed += !ok, rows++;
        if (!ok) printf("%s:%d: %s differs by %.2e\n", name, number, kinds[kind].name, error);
    }
    int bad = ferror(f) || rows == 0;
    if (bad) fprintf(stderr, "%s: %s\n", name, rows ? strerror(errno) : "no rows");
    fclose(f);
    return !bad;
}

static void print_stats(const char *name, const stats *all) {
    printf("%s\n", name);
    for (int k = 0; k < KINDS; k++) {
        const stats *s = &all[k];
        if (!(s->passed + s->failed)) continue;
        printf("  %-7s %4d passed %3d failed", kinds[k].name, s->passed, s->failed);
        if (k < 7) printf("  worst relative error %.1e", s->worst);
        if (k >= 1 && k <= 3)
            printf("  closest feature nearer than the printed one: %d", s->smaller);
        if (k >= 7)
            printf("  ahead of the true time by at most %.3f, stops without collision: %d", s->lead,
                   s->early);
        printf("\n");
    }
}

int main(int argc, char **argv) {
    int passed = 0, failed = 0, unread = 0;
    char *line = (char *)malloc(MAX_LINE);
    if (argc < 2 || !line) {
        fprintf(stderr, argc < 2 ? "usage: contact_reference FILE...\n" : "no memory\n");
        free(line);
        return 1;
    }
    for (int i = 1; i < argc; i++) {
        stats all[KINDS];
        memset(all, 0, sizeof all);
        unread += !check_file(argv[i], all, line);
        print_stats(argv[i], all);
        for (int k = 0; k < KINDS; k++) passed += all[k].passed, failed += all[k].failed;
    }
    free(line);
    printf("%d passed, %d failed\n", passed, failed + unread);
    return failed || unread ? 1 : 0;
}
