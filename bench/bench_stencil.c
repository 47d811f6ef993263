/* bench_stencil.c: stencil descent against Newton's method as a mesh is refined (paper A, Fig. 3)

   cc -O2 -std=c11 bench/bench_stencil.c -lm && ./a.out [CELLS...]

   A bar of length 1 m, fixed on the left, pulled by a force on its right end; one implicit Euler
   step from rest. Cells carry a 1D Neo-Hookean energy, nodes inertia. Stencil descent: cell after
   cell, one Newton step on the cell's two nodes with the Hessian of all that touches them, line
   search; a sweep over all cells counts as one iteration (Lan et al. 2023, second order). Newton:
   all nodes at once, line search. Both stop when no node is farther from the solution than TOL of
   the largest displacement; the solution is Newton's, run until nothing changes. */
#include <math.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#define TOL 1e-3
#define MOST 2000000

typedef struct bar {
    int n;  // cells; nodes 0..n, node 0 is fixed
    double h, rest, mu, lambda, mass, force;
} bar;

static double psi(const bar *b, double F) {
    double l = log(F);
    return F > 0 ? 0.5 * b->mu * (F * F - 1) - b->mu * l + 0.5 * b->lambda * l * l : INFINITY;
}
static double psi1(const bar *b, double F) { return b->mu * (F - 1 / F) + b->lambda * log(F) / F; }
static double psi2(const bar *b, double F) {
    return b->mu * (1 + 1 / (F * F)) + b->lambda * (1 - log(F)) / (F * F);
}

// Energy of cells from..to − 1 and nodes p..q, h²-scaled, at rest X_i = i·rest.
static double energy(const bar *b, const double *x, int from, int to, int p, int q) {
    double e = 0, h2 = b->h * b->h;
    for (int c = from; c < to; c++) e += h2 * b->rest * psi(b, (x[c + 1] - x[c]) / b->rest);
    for (int i = p; i <= q; i++) {
        double u = x[i] - i * b->rest;
        e += 0.5 * b->mass * (i == b->n ? 0.5 : 1) * u * u - (i == b->n ? h2 * b->force * x[i] : 0);
    }
    return e;
}

static double gradient(const bar *b, const double *x, int i) {
    double h2 = b->h * b->h, g = b->mass * (i == b->n ? 0.5 : 1) * (x[i] - i * b->rest);
    g += h2 * psi1(b, (x[i] - x[i - 1]) / b->rest);
    return i < b->n ? g - h2 * psi1(b, (x[i + 1] - x[i]) / b->rest) : g - h2 * b->force;
}

static double stiffness(const bar *b, const double *x, int c) {
    return b->h * b->h * fmax(psi2(b, (x[c + 1] - x[c]) / b->rest), 0) / b->rest;
}

static double diagonal(const bar *b, const double *x, int i) {
    double k = b->mass * (i == b->n ? 0.5 : 1) + stiffness(b, x, i - 1);
    return i < b->n ? k + stiffness(b, x, i) : k;
}

// x += t d with the first t = 1, ½, … that lowers the energy around; nodes p..q move.
static void search(const bar *b, double *x, const double *d, int p, int q) {
    double old[2], *keep = q - p < 2 ? old : (double *)malloc((size_t)(q - p + 1) * sizeof *keep);
    int to = q < b->n ? q + 1 : b->n;
    if (!keep) exit(1);
    memcpy(keep, x + p, (size_t)(q - p + 1) * sizeof *keep);
    double e0 = energy(b, x, p - 1, to, p, q);
    for (double t = 1; t > 1e-12; t *= 0.5) {
        for (int i = p; i <= q; i++) x[i] = keep[i - p] + t * d[i - p];
        if (energy(b, x, p - 1, to, p, q) <= e0) break;
    }
    if (keep != old) free(keep);
}

static void sweep(const bar *b, double *x) {
    for (int c = 0; c < b->n; c++) {
        double d[2], k = stiffness(b, x, c);
        int i = c, j = c + 1;
        double gj = gradient(b, x, j), hj = diagonal(b, x, j);
        if (i == 0) {
            d[0] = -gj / hj;
            search(b, x, d, 1, 1);
            continue;
        }
        double gi = gradient(b, x, i), hi = diagonal(b, x, i), det = hi * hj - k * k;
        d[0] = -(hj * gi + k * gj) / det, d[1] = -(k * gi + hi * gj) / det;
        search(b, x, d, i, j);
    }
}

// Thomas' algorithm; w: 3 (n + 1).
static void newton(const bar *b, double *x, double *w) {
    double *d = w, *up = w + b->n + 1, *y = up + b->n + 1;
    for (int i = 1; i <= b->n; i++) {
        double low = i > 1 ? -stiffness(b, x, i - 1) : 0;
        double pivot = diagonal(b, x, i) - (i > 1 ? low * up[i - 1] : 0);
        up[i] = i < b->n ? -stiffness(b, x, i) / pivot : 0;
        y[i] = (-gradient(b, x, i) - (i > 1 ? low * y[i - 1] : 0)) / pivot;
    }
    d[b->n] = y[b->n];
    for (int i = b->n - 1; i > 0; i--) d[i] = y[i] - up[i] * d[i + 1];
    search(b, x, d + 1, 1, b->n);
}

static double farthest(const double *x, const double *y, int n) {
    double most = 0;
    for (int i = 1; i <= n; i++) most = fmax(most, fabs(x[i] - y[i]));
    return most;
}

static void reset(const bar *b, double *x) {
    for (int i = 0; i <= b->n; i++) x[i] = i * b->rest;
}

// Iterations of one method until within tol of x*.
static int count(const bar *b, double *x, const double *best, double tol, double *w) {
    int k = 0;
    reset(b, x);
    for (; k < MOST && farthest(x, best, b->n) > tol; k++) w ? newton(b, x, w) : sweep(b, x);
    return k;
}

static int row(int n) {
    bar b = {n, 0.1, 1.0 / n, 1e5 / 2.8, 1e5 * 0.4 / (1.4 * 0.2), 1000.0 / n, 4e4};
    double *x = (double *)calloc(5 * (size_t)(n + 1), sizeof *x);
    if (!x) return 0;
    double *best = x + n + 1, *w = best + n + 1;
    reset(&b, best);
    for (int k = 0; k < 60; k++) newton(&b, best, w);
    reset(&b, x);
    double moved = farthest(x, best, n);
    int ns = count(&b, x, best, TOL * moved, w), ss = count(&b, x, best, TOL * moved, NULL);
    printf("%d,%d,%d,%.4f\n", n, ns, ss, moved);
    free(x);
    return 1;
}

int main(int argc, char **argv) {
    static const int cells[] = {10, 20, 40, 80, 160, 320, 640};
    puts("cells,newton,stencil_sweeps,moved_m");
    for (int k = 1; k < argc; k++)
        if (atoi(argv[k]) < 2 || !row(atoi(argv[k]))) return 1;
    for (size_t k = 0; argc < 2 && k < sizeof cells / sizeof *cells; k++)
        if (!row(cells[k])) return 1;
    return 0;
}
