// ccd_queries FILE...: runs continuous collision queries with exact answers. Eight rows a query,
// each x, y, z as numerator, denominator pairs and the answer (1 = collides): edge-edge files
// (name contains "edge-edge") ea0 ea1 eb0 eb1 at t = 0, then at t = 1; vertex-face files v f0 f1
// f2. A query passes unless it collides and we call the way free; a collision reported where there
// is none is allowed for a conservative method, and counted. Prints numbers a file; exit 1 if a
// collision was missed or a file is unreadable or malformed.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"

#include <ctype.h>
#include <errno.h>
#include <stdio.h>
#include <stdlib.h>

// Any collision counts here, not the room that is left (a simulation takes 0.1 or more).
#define SLACK 0.0

typedef struct stats {
    int queries, collisions, missed, false_alarms, inexact, most_iterations;
    double iterations, farthest;  // distance left at the time returned, of all false alarms
} stats;

// An integer of any length, to extended precision. Returns the first character after it, or NULL.
static const char *read_integer(const char *at, long double *out) {
    const char *digits = at + (*at == '-' || *at == '+');
    char *end;
    if (!isdigit((unsigned char)*digits)) return NULL;
    *out = strtold(at, &end);
    for (const char *c = digits; c < end; c++)
        if (!isdigit((unsigned char)*c)) return NULL;
    return end;
}

// One row: three fractions and the answer. Returns NULL or what is wrong.
static const char *read_row(const char *line, double x[3], int *answer, int *inexact) {
    const char *at = line;
    for (int i = 0; i < 3; i++) {
        long double num, den;
        at = read_integer(at, &num);
        if (!at || *at != ',') return "expected a numerator";
        at = read_integer(at + 1, &den);
        if (!at || *at != ',') return "expected a denominator";
        if (!(den > 0)) return "expected a denominator above 0";
        x[i] = (double)(num / den);
        if (!isfinite(x[i])) return "a coordinate is too large";
        *inexact |= (long double)x[i] != num / den;
        at++;
    }
    if ((*at != '0' && *at != '1') || at[1 + strspn(at + 1, " \r\n")] != 0)
        return "expected the answer, 0 or 1, at the end of the row";
    *answer = *at == '1';
    return NULL;
}

static void run_query(tss_ipc_kind kind, double x[2][12], int answer, stats *s) {
    double d[12], then[12];
    int iterations;
    for (int i = 0; i < 12; i++) d[i] = x[1][i] - x[0][i];
    double t = tss_ipc_ccd(kind, 3, x[0], d, SLACK, 1, 1000, &iterations);
    int hit = t < 1;
    s->queries++, s->collisions += answer;
    s->missed += answer && !hit, s->false_alarms += !answer && hit;
    for (int i = 0; i < 12; i++) then[i] = x[0][i] + t * d[i];
    double left = sqrt(tss_ipc_distance(kind, 3, then, NULL));
    if (!answer && hit && left > s->farthest) s->farthest = left;
    s->iterations += iterations;
    if (iterations > s->most_iterations) s->most_iterations = iterations;
}

static int run_rows(FILE *f, const char *name, tss_ipc_kind kind, stats *s) {
    char line[1024];
    double x[2][12];
    int number = 0, rows = 0, answer = 0;
    while (fgets(line, sizeof line, f)) {
        int now, inexact = 0;
        number++;
        if (line[strspn(line, " \r\n")] == 0) continue;
        int row = rows++ % 8;
        const char *wrong = strchr(line, '\n') || feof(f)
                                ? read_row(line, &x[row / 4][3 * (row % 4)], &now, &inexact)
                                : "the row is too long";
        if (!wrong && row > 0 && now != answer) wrong = "the answer differs within a query";
        if (wrong) {
            fprintf(stderr, "%s:%d: %s\n", name, number, wrong);
            return 0;
        }
        answer = now, s->inexact += inexact;
        if (row == 7) run_query(kind, x, answer, s);
    }
    if (ferror(f)) {
        fprintf(stderr, "%s: %s\n", name, strerror(errno));
        return 0;
    }
    if (rows == 0 || rows % 8) {
        fprintf(stderr, "%s: %d rows, expected a multiple of 8\n", name, rows);
        return 0;
    }
    return 1;
}

static int run_file(const char *name, stats *s) {
    int edges = strstr(name, "edge-edge") != NULL;
    if (!edges && !strstr(name, "vertex-face")) {
        fprintf(stderr, "%s: the name says neither edge-edge nor vertex-face\n", name);
        return 0;
    }
    FILE *f = fopen(name, "r");
    if (!f) {
        fprintf(stderr, "%s: cannot be opened: %s\n", name, strerror(errno));
        return 0;
    }
    int ok = run_rows(f, name, edges ? TSS_IPC_EDGE_EDGE : TSS_IPC_POINT_TRIANGLE, s);
    fclose(f);
    return ok;
}

static void print_stats(const char *name, const stats *s) {
    int free_ways = s->queries - s->collisions;
    printf(
        "%s\n  %d queries, %d collide: %d missed; %d of %d free ones called colliding (%.2f %%), "
        "at distances of at most %.1e; iterations %.1f on average, at most %d",
        name, s->queries, s->collisions, s->missed, s->false_alarms, free_ways,
        free_ways ? 100.0 * s->false_alarms / free_ways : 0, s->farthest,
        s->queries ? s->iterations / s->queries : 0, s->most_iterations);
    if (s->inexact) printf("; %d rows are not doubles and were rounded", s->inexact);
    printf("\n");
}

int main(int argc, char **argv) {
    stats sum;
    int unread = 0;
    memset(&sum, 0, sizeof sum);
    if (argc < 2) {
        fprintf(stderr, "usage: ccd_queries FILE...\n");
        return 1;
    }
    for (int i = 1; i < argc; i++) {
        stats s;
        memset(&s, 0, sizeof s);
        unread += !run_file(argv[i], &s);
        if (s.queries) print_stats(argv[i], &s);
        sum.queries += s.queries, sum.collisions += s.collisions, sum.missed += s.missed;
        sum.false_alarms += s.false_alarms, sum.iterations += s.iterations;
        sum.inexact += s.inexact;
        if (s.farthest > sum.farthest) sum.farthest = s.farthest;
        if (s.most_iterations > sum.most_iterations) sum.most_iterations = s.most_iterations;
    }
    print_stats("all files", &sum);
    printf("%d passed, %d failed\n", sum.queries - sum.missed, sum.missed + unread);
    return sum.missed || unread ? 1 : 0;
}
