/* test_checker.c: who judges the judge

   The predicates against 128-bit integers; paths against hand-made cases, dense sampling and the
   exact answers of public CCD queries (folder in TSS_CCD_DATA; skipped without it); scenes in
   which one vertex is pushed through, so that a checker that sees nothing fails here.           */
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>
#include <setjmp.h>
#include <cmocka.h>

#include "checker.h"

__extension__ typedef __int128 big;

// ---------------------------------------------------------------------------------------------
// Random numbers: splitmix64, seeded by each test and printed.
// ---------------------------------------------------------------------------------------------

static uint64_t t_seed;

static void t_start(uint64_t seed) {
    t_seed = seed;
    print_message("seed %llu\n", (unsigned long long)seed);
}

static uint64_t t_bits(void) {
    uint64_t z = (t_seed += 0x9e3779b97f4a7c15u);
    z = (z ^ (z >> 30)) * 0xbf58476d1ce4e5b9u;
    z = (z ^ (z >> 27)) * 0x94d049bb133111ebu;
    return z ^ (z >> 31);
}

static int64_t t_int(int64_t m) { return (int64_t)(t_bits() % (uint64_t)(2 * m + 1)) - m; }
static double t_real(void) { return ldexp((double)(t_bits() >> 11), -52) - 1; }

// ---------------------------------------------------------------------------------------------
// Predicates
// ---------------------------------------------------------------------------------------------

static int t_sign(big v) { return (v > 0) - (v < 0); }

static int t_orient2d(int64_t p[3][2]) {
    return t_sign((big)(p[0][0] - p[2][0]) * (p[1][1] - p[2][1]) -
                  (big)(p[0][1] - p[2][1]) * (p[1][0] - p[2][0]));
}

static int t_orient3d(int64_t p[4][3]) {
    big d[3][3];
    int i, k;
    for (i = 0; i < 3; i++)
        for (k = 0; k < 3; k++) d[i][k] = p[i + 1][k] - p[0][k];
    return t_sign(d[0][0] * (d[1][1] * d[2][2] - d[1][2] * d[2][1]) +
                  d[0][1] * (d[1][2] * d[2][0] - d[1][0] * d[2][2]) +
                  d[0][2] * (d[1][0] * d[2][1] - d[1][1] * d[2][0]));
}

// Near-collinear and near-coplanar points on a grid: a combination of the others, then one step.
static void predicates_match_integers(void **state) {
    int n, i, k, zero = 0, exact = 0;
    (void)state;
    t_start(1);
    for (n = 0; n < 200000; n++) {
        int64_t p2[3][2], p3[4][3], s = t_int(3), t = t_int(3), m = (int64_t)1 << (n % 35 + 2);
        int shift = n % 7 * -17;
        double x2[3][2], x3[4][3];
        for (i = 0; i < 3; i++)
            for (k = 0; k < 3; k++) p3[i][k] = t_int(m);
        for (k = 0; k < 3; k++)
            p3[3][k] = p3[0][k] + s * (p3[1][k] - p3[0][k]) + t * (p3[2][k] - p3[0][k]) +
                       (n % 3 ? t_int(1) : 0);
        for (i = 0; i < 2; i++)
            for (k = 0; k < 2; k++) p2[i][k] = t_int(m);
        for (k = 0; k < 2; k++)
            p2[2][k] = p2[0][k] + s * (p2[1][k] - p2[0][k]) + (n % 3 ? t_int(1) : 0);
        for (i = 0; i < 3; i++)
            for (k = 0; k < 2; k++) x2[i][k] = ldexp((double)p2[i][k], shift);
        for (i = 0; i < 4; i++)
            for (k = 0; k < 3; k++) x3[i][k] = ldexp((double)p3[i][k], shift);
        assert_int_equal(check_orient2d(x2[0], x2[1], x2[2]), t_orient2d(p2));
        assert_int_equal(check_orient3d(x3[0], x3[1], x3[2], x3[3]), t_orient3d(p3));
        // The exact stage by itself, which the filter usually hides.
        assert_int_equal(check__orient3d_exact(x3[0], x3[1], x3[2], x3[3]), t_orient3d(p3));
        zero += t_orient3d(p3) == 0;
        exact++;
    }
    assert_true(zero > exact / 10 && zero < exact);
}

// The classic picture: points within 256 ulps of the diagonal through 12 and 24.
static void predicates_one_ulp(void **state) {
    const double q[2] = {12, 12}, r[2] = {24, 24};
    const int64_t one = (int64_t)1 << 53;
    int i, j, wrong = 0;
    (void)state;
    for (i = 0; i < 256; i++)
        for (j = 0; j < 256; j++) {
            double p[2];
            int64_t g[3][2];
            double naive;
            p[0] = 0.5 + ldexp(i, -53), p[1] = 0.5 + ldexp(j, -53);
            // Half-ulp steps above 0.5 do not exist: only even ones are doubles.
            g[0][0] = (int64_t)ldexp(p[0], 53), g[0][1] = (int64_t)ldexp(p[1], 53);
            g[1][0] = g[1][1] = 12 * one, g[2][0] = g[2][1] = 24 * one;
            // Three orders: the filter sees different roundings.
            assert_int_equal(check_orient2d(p, q, r), t_orient2d(g));
            assert_int_equal(check_orient2d(q, r, p), t_orient2d(g));
            assert_int_equal(check_orient2d(r, p, q), t_orient2d(g));
            naive = (q[0] - p[0]) * (r[1] - p[1]) - (q[1] - p[1]) * (r[0] - p[0]);
            wrong += (naive > 0) - (naive < 0) != t_orient2d(g);
        }
    // The plain formula does fail here: the case is worth testing.
    assert_true(wrong > 1000);
}

// Exponents far apart, where 128 bits do not reach: signs known by construction.
static void predicates_wide_exponents(void **state) {
    double e;
    (void)state;
    for (e = 1e-16; e > 1e-110; e *= 1e-7) {
        double a[3] = {0, 0, 0}, b[3] = {1e10, 1e10, 0}, c[3] = {-3e5, 7, 0}, d[3] = {3, 3, 0};
        d[2] = e;
        // b × c points up: (1e10, 1e10) × (-3e5, 7) = 7e10 + 3e15 > 0
        assert_int_equal(check_orient3d(a, b, c, d), 1);
        d[2] = -e;
        assert_int_equal(check_orient3d(a, b, c, d), -1);
        a[1] = e;
        assert_int_equal(check_orient2d(a, b, d), -1);
        a[1] = -e;
        assert_int_equal(check_orient2d(a, b, d), 1);
        a[1] = 0;
        assert_int_equal(check_orient2d(a, b, d), 0);
    }
}

// The orientation of a moving pair halfway, on even grid points: that of the midpoints.
static void moving_orientation_is_exact(void **state) {
    int n, i, k, zero = 0;
    (void)state;
    t_start(10);
    for (n = 0; n < 20000; n++) {
        int64_t m = (int64_t)1 << (n % 30 + 4), p[4][3], s = t_int(2), t = t_int(2);
        check__pair q;
        memset(&q, 0, sizeof q);
        q.dim = 3, q.na = 1, q.nb = 3;
        for (k = 0; k < 3; k++) {
            for (i = 0; i < 3; i++) p[i][k] = t_int(m);
            p[3][k] = p[0][k] + s * (p[1][k] - p[0][k]) + t * (p[2][k] - p[0][k]) + (n % 3 == 0);
            for (i = 0; i < 4; i++) {
                int64_t d = t_int(m);
                q.x[0][i][k] = (double)(p[i][k] - d);
                q.x[1][i][k] = (double)(p[i][k] + d);
            }
        }
        assert_int_equal(check__pair_orient(&q, 0.5), t_orient3d(p));
        zero += t_orient3d(p) == 0;
    }
    assert_true(zero > 2000 && zero < 18000);
}

// Segments and triangles on a small grid, many degenerate, against rational arithmetic: both are
// closed convex sets, so they are disjoint exactly if one of few separating functionals is
// positive; here instead the meeting parameter is solved by integers.
static int t_in_triangle(int64_t p[3], int64_t a[3], int64_t b[3], int64_t c[3], int64_t w) {
    // p/w in the closed nondegenerate triangle, known to be in its plane: no cross product of an
    // edge and the point opposes the normal.
    int64_t *v[3], n[3];
    int i, k;
    v[0] = a, v[1] = b, v[2] = c;
    for (k = 0; k < 3; k++) {
        int u = (k + 1) % 3, z = (k + 2) % 3;
        n[k] = (b[u] - a[u]) * (c[z] - a[z]) - (b[z] - a[z]) * (c[u] - a[u]);
    }
    for (i = 0; i < 3; i++) {
        int64_t *q = v[i], *r = v[(i + 1) % 3];
        big s = 0;
        for (k = 0; k < 3; k++) {
            int u = (k + 1) % 3, z = (k + 2) % 3;
            s += (big)n[k] * ((big)(r[u] - q[u]) * (p[z] - w * q[z]) -
                              (big)(r[z] - q[z]) * (p[u] - w * q[u]));
        }
        if (s < 0) return 0;
    }
    return 1;
}

static void segment_triangle_on_grid(void **state) {
    int n, i, k, hits = 0, judged = 0;
    (void)state;
    t_start(2);
    for (n = 0; n < 300000; n++) {
        int64_t p[5][3], m[3], o[4][3], g = n % 2 ? 2 : 5;
        double x[5][3];
        int64_t sp, sq, w;
        int truth;
        for (i = 0; i < 5; i++)
            for (k = 0; k < 3; k++) p[i][k] = t_int(g), x[i][k] = (double)p[i][k] * 0.25;
        for (k = 0; k < 3; k++) {
            int u = (k + 1) % 3, z = (k + 2) % 3;
            m[k] = (p[3][u] - p[2][u]) * (p[4][z] - p[2][z]) -
                   (p[3][z] - p[2][z]) * (p[4][u] - p[2][u]);
        }
        sp = sq = 0;
        for (k = 0; k < 3; k++) sp += m[k] * (p[0][k] - p[2][k]), sq += m[k] * (p[1][k] - p[2][k]);
        if (sp == 0 && sq == 0) continue;  // coplanar: next test
        // The line meets the plane at (sq p - sp q)/(sq - sp).
        w = sq - sp;
        for (k = 0; k < 3; k++) o[0][k] = sq * p[0][k] - sp * p[1][k];
        if (w < 0) {
            w = -w;
            for (k = 0; k < 3; k++) o[0][k] = -o[0][k];
        }
        truth = !((sp > 0 && sq > 0) || (sp < 0 && sq < 0)) &&
                t_in_triangle(o[0], p[2], p[3], p[4], w);
        assert_int_equal(check_segment_meets_triangle(x[0], x[1], x[2], x[3], x[4]), truth);
        hits += truth;
        judged++;
    }
    assert_true(hits > judged / 50);
}

// Coplanar configurations: a plane set carried into space by an integer map; truth from the plane.
static void coplanar_matches_plane(void **state) {
    int n, i, k, hits = 0, touch = 0;
    (void)state;
    t_start(3);
    for (n = 0; n < 100000; n++) {
        double y[5][2], x[5][3], a[2][3];
        int truth, seg;
        for (i = 0; i < 5; i++)
            for (k = 0; k < 2; k++) y[i][k] = (double)t_int(3);
        for (i = 0; i < 2; i++)
            for (k = 0; k < 3; k++) a[i][k] = (double)t_int(4);
        if (a[0][0] * a[1][1] == a[0][1] * a[1][0] && a[0][1] * a[1][2] == a[0][2] * a[1][1] &&
            a[0][2] * a[1][0] == a[0][0] * a[1][2])
            continue;
        for (i = 0; i < 5; i++)
            for (k = 0; k < 3; k++) x[i][k] = y[i][0] * a[0][k] + y[i][1] * a[1][k] + 7;
        seg = check_segments_meet2d(y[0], y[1], y[2], y[3]);
        assert_int_equal(check_segments_meet3d(x[0], x[1], x[2], x[3]), seg);
        assert_int_equal(check_point_on_triangle(x[0], x[2], x[3], x[4]),
                         check__point_in_triangle2d(y[0], y[2], y[3], y[4]));
        truth = seg || check_segments_meet2d(y[0], y[1], y[3], y[4]) ||
                check_segments_meet2d(y[0], y[1], y[4], y[2]) ||
                check__point_in_triangle2d(y[0], y[2], y[3], y[4]);
        assert_int_equal(check_segment_meets_triangle(x[0], x[1], x[2], x[3], x[4]), truth);
        hits += truth, touch += seg;
    }
    assert_true(hits > 10000 && touch > 5000);
}

// Segments in the plane against rationals: parameters of the crossing solved by integers.
static void segments2d_on_grid(void **state) {
    int n, i, k, hits = 0;
    (void)state;
    t_start(4);
    for (n = 0; n < 200000; n++) {
        int64_t p[4][2], u[2], v[2], r[2], det, s, t;
        double x[4][2];
        int truth;
        for (i = 0; i < 4; i++)
            for (k = 0; k < 2; k++) p[i][k] = t_int(4), x[i][k] = (double)p[i][k] / 8;
        for (k = 0; k < 2; k++)
            u[k] = p[1][k] - p[0][k], v[k] = p[3][k] - p[2][k], r[k] = p[2][k] - p[0][k];
        det = u[0] * v[1] - u[1] * v[0];
        if (det == 0) continue;
        s = (r[0] * v[1] - r[1] * v[0]) * (det > 0 ? 1 : -1);
        t = (r[0] * u[1] - r[1] * u[0]) * (det > 0 ? 1 : -1);
        det = det > 0 ? det : -det;
        truth = s >= 0 && s <= det && t >= 0 && t <= det;
        assert_int_equal(check_segments_meet2d(x[0], x[1], x[2], x[3]), truth);
        hits += truth;
    }
    assert_true(hits > 10000);
}

// ---------------------------------------------------------------------------------------------
// Paths of one pair
// ---------------------------------------------------------------------------------------------

static check__pair t_pair(int dim, int na, int nb) {
    check__pair p;
    memset(&p, 0, sizeof p);
    p.dim = dim, p.na = na, p.nb = nb;
    return p;
}

static void t_put(check__pair *p, int i, double x, double y, double z, double dx, double dy,
                  double dz) {
    p->x[0][i][0] = x, p->x[0][i][1] = y, p->x[0][i][2] = z;
    p->x[1][i][0] = x + dx, p->x[1][i][1] = y + dy, p->x[1][i][2] = z + dz;
}

static check__pair t_point_over_triangle(double x, double y, double z, double dx, double dy,
                                         double dz, double height) {
    check__pair p = t_pair(3, 1, 3);
    t_put(&p, 0, x, y, z, dx, dy, dz);
    t_put(&p, 1, 0, 0, height, 0, 0, 0);
    t_put(&p, 2, 1, 0, height, 0, 0, 0);
    t_put(&p, 3, 0, 1, height, 0, 0, 0);
    return p;
}

static void path_tunnelling(void **state) {
    double speed;
    (void)state;
    for (speed = 1; speed < 2e7; speed *= 10) {
        check__pair p = t_point_over_triangle(0.3, 0.3, 0.7 * speed, 0, 0, -speed, 0);
        check__answer a = check__pair_path(&p, INFINITY);
        assert_int_equal(a.verdict, CHECK_COLLIDES);
        assert_true(a.t0 <= 0.7 && 0.7 <= a.t1);
        // Just beside the long edge: x + y = 1 + 1e-6.
        p = t_point_over_triangle(0.5, 0.5 + 1e-6, 0.7 * speed, 0, 0, -speed, 0);
        a = check__pair_path(&p, INFINITY);
        assert_int_equal(a.verdict, CHECK_CLEAR);
        assert_true(a.low > 0.93e-6 / sqrt(2.0) && a.low < 1e-6 / sqrt(2.0) * (1 + 1e-9));
    }
}

static void path_grazing_by_one_ulp(void **state) {
    const double h = 0.3;
    check__pair p;
    (void)state;
    // Sliding above the triangle's plane by one ulp, in it, and below it.
    p = t_point_over_triangle(-1, 0.25, nextafter(h, 1), 3, 0, 0, h);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    p = t_point_over_triangle(-1, 0.25, nextafter(h, 0), 3, 0, 0, h);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    p = t_point_over_triangle(-1, 0.25, h, 3, 0, 0, h);
    assert_true(check__pair_path(&p, INFINITY).verdict != CHECK_CLEAR);
    // Stops one ulp above, on, one ulp below.
    p = t_point_over_triangle(0.25, 0.25, 1, 0, 0, 0, h);
    p.x[1][0][2] = nextafter(h, 1);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    p.x[1][0][2] = h;
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
    p.x[1][0][2] = nextafter(h, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
    // Passes the plane outside the edge y = 0 by one step, and on it.
    p = t_point_over_triangle(0.25, -1e-17, 1, 0, 0, -2, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    p = t_point_over_triangle(0.25, 0, 1, 0, 0, -2, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
    // On the triangle's vertex, at t = 1/2.
    p = t_point_over_triangle(0, 0, 1, 0, 0, -2, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
}

static void path_edges(void **state) {
    check__pair p = t_pair(3, 2, 2);
    (void)state;
    t_put(&p, 0, -1, 0, 1, 0, 0, -2);
    t_put(&p, 1, 1, 0, 1, 0, 0, -2);
    t_put(&p, 2, 0, -1, 0.125, 0, 0, 0);
    t_put(&p, 3, 0, 1, 0.125, 0, 0, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
    // End to end, missing by 1e-9.
    t_put(&p, 0, 1e-9, 0, 1, 0, 0, -2);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    // End on edge.
    t_put(&p, 0, 0, 0, 1, 0, 0, -2);
    assert_true(check__pair_path(&p, INFINITY).verdict != CHECK_CLEAR);
    // Parallel, meeting; parallel, sliding past one another at 1e-12.
    t_put(&p, 0, 0, -1, 1, 0, 0, -2);
    t_put(&p, 1, 0, 1, 1, 0, 0, -2);
    assert_true(check__pair_path(&p, INFINITY).verdict != CHECK_CLEAR);
    t_put(&p, 0, 1e-12, -1, 1, 0, 0, -2);
    t_put(&p, 1, 1e-12, 1, 1, 0, 0, -2);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    // Collinear, end towards end, short of it by 1/8 and into it.
    t_put(&p, 0, 0, 4, 0.125, 0, -1.875, 0);
    t_put(&p, 1, 0, 3, 0.125, 0, -1.875, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    t_put(&p, 0, 0, 4, 0.125, 0, -2, 0);
    t_put(&p, 1, 0, 3, 0.125, 0, -2, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
}

static void path_plane(void **state) {
    check__pair p = t_pair(2, 1, 2);
    (void)state;
    t_put(&p, 0, 0.3, 1, 0, 0, -1e6, 0);
    t_put(&p, 1, 0, 0, 0, 0, 0, 0);
    t_put(&p, 2, 1, 0.1, 0, 0, 0, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_COLLIDES);
    t_put(&p, 0, 1 + 1e-12, 1, 0, 0, -1e6, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    t_put(&p, 2, 1, 0, 0, 0, 0, 0);
    t_put(&p, 0, -5, 5e-324 + 1e-110, 0, 10, 0, 0);
    assert_int_equal(check__pair_path(&p, INFINITY).verdict, CHECK_CLEAR);
    t_put(&p, 0, -5, 0, 0, 10, 0, 0);
    assert_true(check__pair_path(&p, INFINITY).verdict != CHECK_CLEAR);
}

static double t_distance(const check__pair *p, double t) {
    double n[2][3];
    return check__directions(p, t, n);
}

// Distance by brute force: no case analysis, a grid over both primitives, refined.
static double t_distance_slow(const check__pair *p, double t) {
    double x[4][3], best = INFINITY, cu = 0.5, cv = 0.5, h = 0.5;
    int i, k, a, b, level;
    for (i = 0; i < p->na + p->nb; i++)
        for (k = 0; k < 3; k++) x[i][k] = (1 - t) * p->x[0][i][k] + t * p->x[1][i][k];
    for (level = 0; level < 40; level++) {
        double mu = cu, mv = cv;
        for (a = -4; a <= 4; a++)
            for (b = -4; b <= 4; b++) {
                double u = check__clamp(cu + h * a / 4), v = check__clamp(cv + h * b / 4), d = 0;
                if (p->nb == 3 && u + v > 1) v = 1 - u;
                for (k = 0; k < 3; k++) {
                    double q = p->nb == 3
                        ? x[0][k] - x[1][k] - u * (x[2][k] - x[1][k]) - v * (x[3][k] - x[1][k])
                        : p->na == 2 ? x[0][k] + u * (x[1][k] - x[0][k]) - x[2][k] -
                                       v * (x[3][k] - x[2][k])
                                     : x[0][k] - x[1][k] - u * (x[2][k] - x[1][k]);
                    d += q * q;
                }
                if (d < best) best = d, mu = u, mv = v;
            }
        cu = mu, cv = mv, h *= 0.7;
    }
    return sqrt(best);
}

static void distances_match_grid(void **state) {
    int n, i, k;
    (void)state;
    t_start(5);
    for (n = 0; n < 600; n++) {
        check__pair p = n % 3 == 0 ? t_pair(3, 1, 3) : n % 3 == 1 ? t_pair(3, 2, 2)
                                                                  : t_pair(2, 1, 2);
        double d, slow;
        for (i = 0; i < p.na + p.nb; i++)
            for (k = 0; k < p.dim; k++) p.x[0][i][k] = p.x[1][i][k] = t_real();
        d = t_distance(&p, 0), slow = t_distance_slow(&p, 0);
        assert_true(fabs(d - slow) < 1e-4);
    }
}

// Random motions. Clear: no sample comes closer than the proven bound. Collides: the distance
// vanishes within the named interval. Undecided: never.
static void random_paths_match_sampling(void **state) {
    int n, i, k, count[3] = {0, 0, 0};
    (void)state;
    t_start(6);
    for (n = 0; n < 30000; n++) {
        check__pair p = n % 3 == 0 ? t_pair(3, 1, 3) : n % 3 == 1 ? t_pair(3, 2, 2)
                                                                  : t_pair(2, 1, 2);
        double scale = ldexp(1, (int)(n % 5) * -8), least = INFINITY, speed = 0;
        int samples = 64;
        check__answer a;
        for (i = 0; i < p.na + p.nb; i++)
            for (k = 0; k < p.dim; k++) {
                p.x[0][i][k] = 100 * (n % 2) + scale * t_real();
                p.x[1][i][k] = p.x[0][i][k] + scale * t_real() * (n % 4 + 1);
                speed = fmax(speed, 4 * fabs(p.x[1][i][k] - p.x[0][i][k]));
            }
        a = check__pair_path(&p, INFINITY);
        count[a.verdict]++;
        for (i = 0; i <= samples; i++) least = fmin(least, t_distance(&p, (double)i / samples));
        if (a.verdict == CHECK_CLEAR) {
            assert_true(a.low > 0 && a.low <= least * (1 + 1e-12) + 1e-12 * scale);
            assert_true(a.low <= a.high * (1 + 1e-12));
        } else {
            // A crossing that was claimed wrongly shrinks to a time of mere coplanarity.
            double at;
            check__sharpen(&p, &a);
            at = fmin(t_distance(&p, 0.5 * (a.t0 + a.t1)), t_distance(&p, a.t0));
            assert_true(a.t1 - a.t0 < 1e-6 || t_distance(&p, a.t1) == 0);
            assert_true(fmin(at, t_distance(&p, a.t1)) <= 1e-6 * speed + 1e-12 * scale);
        }
        // A sampled sign change of the orientation inside must not be called clear.
        if (least < 1e-3 * scale / samples && a.verdict == CHECK_CLEAR) assert_true(a.low < least);
    }
    print_message("clear %d, undecided %d, collide %d\n", count[0], count[1], count[2]);
    assert_int_equal(count[CHECK_UNDECIDED], 0);
    assert_true(count[CHECK_CLEAR] > 5000 && count[CHECK_COLLIDES] > 3000);
}

// Collisions by construction: a contact at a chosen time and place, then moved apart backwards.
static void made_collisions_are_found(void **state) {
    int n, i, k, count[3] = {0, 0, 0};
    (void)state;
    t_start(7);
    for (n = 0; n < 30000; n++) {
        int tri = n % 2;
        check__pair p = tri ? t_pair(3, 1, 3) : t_pair(3, 2, 2);
        double t = 0.5 + 0.45 * t_real(), u = 0.5 + 0.4 * t_real(), v = 0.5 + 0.4 * t_real();
        double y[4][3];
        for (i = 0; i < 4; i++)
            for (k = 0; k < 3; k++) y[i][k] = t_real();
        if (tri) u *= 0.5, v *= 0.5;
        for (k = 0; k < 3; k++) {
            if (tri) y[0][k] = y[1][k] + u * (y[2][k] - y[1][k]) + v * (y[3][k] - y[1][k]);
            else y[0][k] = (y[2][k] + v * (y[3][k] - y[2][k]) - u * y[1][k]) / (1 - u);
        }
        for (i = 0; i < 4; i++)
            for (k = 0; k < 3; k++) {
                double w = t_real() * (n % 3 == 0 ? 100 : 1);
                p.x[0][i][k] = y[i][k] - t * w;
                p.x[1][i][k] = y[i][k] + (1 - t) * w;
            }
        count[check__pair_path(&p, INFINITY).verdict]++;
    }
    print_message("clear %d, undecided %d, collide %d\n", count[0], count[1], count[2]);
    // Transversal contacts in the interior survive the rounding of their positions.
    assert_int_equal(count[CHECK_COLLIDES], 30000);
}

// ---------------------------------------------------------------------------------------------
// Cells
// ---------------------------------------------------------------------------------------------

static void cells_along_paths(void **state) {
    int n, i, k, count[3] = {0, 0, 0};
    (void)state;
    t_start(8);
    for (n = 0; n < 30000; n++) {
        int dim = 2 + n % 2, bad = 0;
        check__pair p = t_pair(dim, 1, dim);
        check__answer a;
        double low = INFINITY;
        for (i = 0; i <= dim; i++)
            for (k = 0; k < dim; k++) {
                p.x[0][i][k] = (i == k + 1) + 0.2 * t_real();
                p.x[1][i][k] = (i == k + 1) + (1 + n % 3) * 0.5 * t_real();
            }
        if (check__pair_orient(&p, 0) <= 0) continue;
        a = check__cell_path(&p, 1);
        for (i = 0; i <= 256; i++) {
            double r[3][3], bound = check__rows(r, &p, i / 256.0), d;
            d = check__det(r[0], r[1], r[2]);
            low = fmin(low, d);
            bad |= d < -bound;
        }
        count[a.verdict]++;
        if (bad) assert_int_equal(a.verdict, CHECK_COLLIDES);
        if (a.verdict == CHECK_CLEAR) assert_true(a.low > 0 && a.low <= low * (1 + 1e-12));
        if (a.verdict == CHECK_COLLIDES)
            assert_true(check__pair_orient(&p, a.t0) <= 0 || check__pair_orient(&p, a.t1) <= 0);
    }
    assert_int_equal(count[CHECK_UNDECIDED], 0);
    assert_true(count[CHECK_CLEAR] > 3000 && count[CHECK_COLLIDES] > 3000);
}

// Turned inside out and back within one segment: both ends are sound, the middle is not. And
// flattened by the exact amount, or one ulp short of it.
static void cells_between_good_ends(void **state) {
    check__pair p = t_pair(2, 1, 2);
    (void)state;
    t_put(&p, 0, 0, 0, 0, 0, 0, 0);
    t_put(&p, 1, 1, 0, 0, -2, 0, 0);
    t_put(&p, 2, 0, 1, 0, 0, -2, 0);
    // Point reflection: det = (1 - 2t)², a double root at t = 1/2.
    assert_int_equal(check__cell_path(&p, 1).verdict, CHECK_COLLIDES);
    // One factor shifted: (1 - 2t)(1.5 - 2t) is negative in between only.
    t_put(&p, 2, 0, 1.5, 0, 0, -2, 0);
    assert_int_equal(check__cell_path(&p, 1).verdict, CHECK_COLLIDES);
    t_put(&p, 1, 1, 0, 0, 0, 0, 0);
    t_put(&p, 2, 0, 1, 0, 0, 0, 0);
    p.x[1][2][1] = nextafter(0, 1);
    p.x[1][2][1] = 1e-100;
    assert_int_equal(check__cell_path(&p, 1).verdict, CHECK_CLEAR);
    p.x[1][2][1] = 0;
    assert_int_equal(check__cell_path(&p, 1).verdict, CHECK_COLLIDES);
}

// ---------------------------------------------------------------------------------------------
// Scenes
// ---------------------------------------------------------------------------------------------

// Two n × n sheets of triangles, the second `gap` above the first.
typedef struct t_sheets {
    check_mesh mesh;
    int *tri, *body;
    double *x, *y;
} t_sheets;

static t_sheets t_make_sheets(int n, double gap) {
    t_sheets s;
    int side = n + 1, per = side * side, i, j, b, f = 0;
    memset(&s, 0, sizeof s);
    s.tri = (int *)malloc((size_t)(12 * n * n) * sizeof(int));
    s.body = (int *)malloc((size_t)(2 * per) * sizeof(int));
    s.x = (double *)malloc((size_t)(6 * per) * sizeof(double));
    s.y = (double *)malloc((size_t)(6 * per) * sizeof(double));
    assert_true(s.tri && s.body && s.x && s.y);
    for (b = 0; b < 2; b++)
        for (i = 0; i < side; i++)
            for (j = 0; j < side; j++) {
                int v = b * per + i * side + j, q[6], k;
                s.body[v] = b;
                s.x[3 * v] = (double)i / n + 0.31 * b / n;
                s.x[3 * v + 1] = (double)j / n + 0.17 * b / n;
                s.x[3 * v + 2] = gap * b;
                q[0] = v, q[1] = v + side, q[2] = v + side + 1;
                q[3] = v, q[4] = v + side + 1, q[5] = v + 1;
                for (k = 0; k < 6 && i < n && j < n; k++) s.tri[f++] = q[k];
            }
    memcpy(s.y, s.x, (size_t)(6 * per) * sizeof(double));
    s.mesh.dim = 3;
    s.mesh.nodes = 2 * per;
    s.mesh.triangles = s.tri;
    s.mesh.n_triangles = f / 3;
    s.mesh.body = s.body;
    s.mesh.self_contact = 1;
    return s;
}

static void t_free_sheets(t_sheets *s) {
    free(s->tri);
    free(s->body);
    free(s->x);
    free(s->y);
}

static int t_has(const check_offender *o, int node) {
    int i, found = 0;
    for (i = 0; i < o->n_nodes; i++) found |= o->nodes[i] == node;
    return found;
}

// A good path is clear; the same with one vertex pushed through is not, and the vertex is named;
// pushed through and back, only the path can tell.
static void scene_catches_one_vertex(void **state) {
    const int n = 12, culprit = 6 * 13 + 5 + 169;
    t_sheets s = t_make_sheets(n, 0.1);
    size_t bytes = (size_t)(3 * s.mesh.nodes) * sizeof(double);
    double *z = (double *)malloc(bytes);
    char text[256];
    check_report r;
    check *c;
    int i;
    (void)state;
    assert_non_null(z);
    for (i = s.mesh.nodes / 2; i < s.mesh.nodes; i++) s.y[3 * i + 2] -= 0.0999, s.y[3 * i] += 0.4;
    s.mesh.reach = 0.05;
    c = check_begin(&s.mesh, s.x);
    assert_true(check_segment(c, s.x, s.y));
    r = check_end(c);
    assert_true(r.ok && r.segments == 1 && r.states == 2 && r.pairs > 1000);
    assert_true(r.distance_low > 0.94e-4 && r.distance_low < 1e-4 + 1e-9);
    assert_true(r.distance_high > 1e-4 - 1e-9 && r.distance_high < 1.06e-4);

    memcpy(z, s.y, bytes);
    z[3 * culprit + 2] -= 0.001;
    c = check_begin(&s.mesh, s.x);
    assert_true(check_segment(c, s.x, s.y));
    assert_false(check_segment(c, s.y, z));
    r = check_end(c);
    check_describe(&r, text, sizeof text);
    print_message("%s\n", text);
    assert_true(!r.ok && r.collisions > 0 && r.intersections > 0 && r.undecided == 0);
    assert_true(t_has(&r.first, culprit) && r.first.segment == 1 && r.first.on_path);
    assert_true(r.first.body[0] != r.first.body[1]);
    assert_true(r.first.t0 > 0.1 - 1e-6 && r.first.t1 < 1);
    {
        check__pair p;
        check__pair_load(&p, 3, 1, 3, s.y, z, r.first.nodes);
        assert_true(t_distance(&p, 0.5 * (r.first.t0 + r.first.t1)) < 1e-9);
    }
    assert_non_null(strstr(text, "segment 1"));
    assert_true(r.first.t1 - r.first.t0 < 1e-6);

    // Down past the lower sheet and out beside it: both states are sound.
    memcpy(z, s.y, bytes);
    for (i = s.mesh.nodes / 2; i < s.mesh.nodes; i++) z[3 * i + 2] -= 1;
    c = check_begin(&s.mesh, NULL);
    assert_true(check_state(c, s.x) && check_state(c, z));
    assert_false(check_path(c, s.x, z));
    r = check_end(c);
    assert_true(r.intersections == 0 && r.collisions > 100 && r.undecided == 0);

    // The same motion of two kinematic bodies, and of ignored pairs, is not judged.
    {
        unsigned char *kin = (unsigned char *)malloc((size_t)s.mesh.nodes);
        assert_non_null(kin);
        memset(kin, 1, (size_t)s.mesh.nodes);
        s.mesh.kinematic = kin;
        c = check_begin(&s.mesh, s.x);
        assert_true(check_segment(c, s.x, z));
        assert_int_equal(check_end(c).pairs, 0);
        free(kin);
        s.mesh.kinematic = NULL;
    }
    free(z);
    t_free_sheets(&s);
}

// Breaks of the polyline are seen bitwise; -0 is not 0; NaN and infinity are named.
static void scene_breaks_and_range(void **state) {
    t_sheets s = t_make_sheets(2, 0.5);
    check_report r;
    check *c = check_begin(&s.mesh, s.x);
    (void)state;
    s.y[4] = nextafter(s.y[4], 9);
    assert_true(check_segment(c, s.x, s.y));
    assert_false(check_segment(c, s.x, s.y));
    r = check_end(c);
    assert_true(r.breaks == 1 && r.first.kind == CHECK_BREAK && !r.ok && r.collisions == 0);
    s.y[5] = NAN;
    c = check_begin(&s.mesh, s.x);
    assert_false(check_segment(c, s.x, s.y));
    r = check_end(c);
    assert_true(r.range > 0 && r.first.kind == CHECK_RANGE && !r.ok);
    t_free_sheets(&s);
}

static void scene_plane(void **state) {
    // Two triangles with boundaries, a half-space below, a loose point.
    static const int cells[6] = {0, 1, 2, 3, 4, 5};
    static const int edges[12] = {0, 1, 1, 2, 2, 0, 3, 4, 4, 5, 5, 3};
    static const int body[7] = {0, 0, 0, 1, 1, 1, 2}, point = 6;
    static const double ground[4] = {0, -1, 0, 1};
    double x[14] = {0, 0, 1, 0, 0, 1, 0, 2, 1, 2, 0, 3, -1, 0.5}, y[14];
    check_mesh m;
    check_report r;
    check *c;
    (void)state;
    memset(&m, 0, sizeof m);
    m.dim = 2, m.nodes = 7, m.rest = x, m.cells = cells, m.n_cells = 2, m.edges = edges;
    m.n_edges = 6, m.points = &point, m.n_points = 1, m.halfspaces = ground, m.n_halfspaces = 1;
    m.body = body, m.self_contact = 1;
    memcpy(y, x, sizeof y);
    y[7] = y[9] = 1.0625, y[11] = 2.0625, y[12] = -0.0625;
    c = check_begin(&m, x);
    assert_true(check_segment(c, x, y));
    y[12] = 2;  // the loose point flies through body 0
    assert_false(check_path(c, x, y));
    r = check_end(c);
    assert_true(r.collisions == 2 && r.first.kind == CHECK_POINT_EDGE && r.min_J == 1);
    assert_true(r.first.nodes[0] == 6 && r.first.body[0] == 2 && r.first.body[1] == 0);
    // On the ground is not inside it.
    memcpy(y, x, sizeof y);
    y[1] = -1;
    c = check_begin(&m, x);
    assert_false(check_segment(c, x, y));
    r = check_end(c);
    assert_true(r.halfspaces > 0 && r.first.kind == CHECK_POINT_HALFSPACE);
    y[1] = nextafter(-1, 0);
    c = check_begin(&m, x);
    assert_true(check_segment(c, x, y));
    (void)check_end(c);
    // A cell turned over; the state of its crossing neighbour.
    memcpy(y, x, sizeof y);
    y[4] = 0.5, y[5] = -0.5;
    c = check_begin(&m, x);
    assert_false(check_segment(c, x, y));
    r = check_end(c);
    assert_true(r.inversions == 2 && r.first.kind == CHECK_INVERSION && r.first.index == 0);
    assert_true(fabs(r.min_J + 0.5) < 1e-15);
    memcpy(y, x, sizeof y);
    y[5] = 2.5;
    c = check_begin(&m, NULL);
    assert_false(check_state(c, y));
    r = check_end(c);
    assert_true(r.intersections > 0 && r.first.kind == CHECK_EDGE_EDGE);
}

// Loose segments and points in space; pairs within one body only with self contact.
static void scene_loose_primitives(void **state) {
    static const int tri[3] = {0, 1, 2}, edges[6] = {3, 4, 5, 6, 0, 1}, point = 7;
    int body[8] = {0, 0, 0, 1, 1, 2, 2, 3};
    double x[24] = {0, 0, 0, 1, 0, 0, 0, 1, 0, -1, 0, 3, 1, 0, 3, 0, -1, 2, 0, 1, 2, .25, .25, 1};
    double y[24];
    check_mesh m;
    check_report r;
    check *c;
    (void)state;
    memset(&m, 0, sizeof m);
    m.dim = 3, m.nodes = 8, m.triangles = tri, m.n_triangles = 1, m.edges = edges, m.n_edges = 3;
    m.points = &point, m.n_points = 1, m.body = body, m.self_contact = 1;
    c = check_begin(&m, x);
    assert_true(c->edges.count == 5 && c->loose_edges.count == 2 && c->loose_points.count == 1);
    memcpy(y, x, sizeof y);
    y[11] = y[14] = 2;  // segment laid on segment
    assert_false(check_state(c, y));
    assert_true(c->report.intersections == 1 && c->report.first.kind == CHECK_EDGE_EDGE);
    y[11] = y[14] = 1.5;  // through it
    assert_true(check_state(c, y));
    assert_false(check_path(c, x, y));
    assert_int_equal(c->report.collisions, 1);
    memcpy(y, x, sizeof y);
    y[23] = 0;  // point laid on the triangle, then through it
    assert_false(check_state(c, y));
    assert_int_equal(c->report.intersections, 2);
    y[23] = -1;
    assert_true(check_state(c, y));
    assert_false(check_path(c, x, y));
    r = check_end(c);
    assert_true(r.collisions == 2 && r.intersections == 2 && r.undecided == 0 && !r.ok);
    body[7] = 0;
    m.self_contact = 0;
    c = check_begin(&m, x);
    assert_true(check_segment(c, x, y));
    r = check_end(c);
    assert_true(r.ok && r.collisions == 0);
}

// The tree finds exactly the overlapping pairs that a double loop finds.
static void tree_finds_all_pairs(void **state) {
    t_sheets s = t_make_sheets(15, 0.02);
    int i, j;
    long want = 0;
    double bi[6], bj[6];
    check_report r;
    check *c;
    (void)state;
    t_start(9);
    for (i = 0; i < 3 * s.mesh.nodes; i++) s.x[i] += 0.02 * t_real(), s.y[i] += 0.05 * t_real();
    c = check_begin(&s.mesh, NULL);
    for (i = 0; i < c->points.count; i++)
        for (j = 0; j < c->triangles.count; j++) {
            int v[4];
            v[0] = c->points.nodes[i];
            memcpy(v + 1, s.tri + 3 * j, 3 * sizeof(int));
            check__box(v, 1, 3, s.x, s.y, 0, bi);
            check__box(v + 1, 3, 3, s.x, s.y, 0, bj);
            want += check__overlap(bi, bj) && !check__ignored(c, v, 1, 3);
        }
    for (i = 0; i < c->edges.count; i++)
        for (j = i + 1; j < c->edges.count; j++) {
            int v[4];
            memcpy(v, c->edges.nodes + 2 * i, 2 * sizeof(int));
            memcpy(v + 2, c->edges.nodes + 2 * j, 2 * sizeof(int));
            check__box(v, 2, 3, s.x, s.y, 0, bi);
            check__box(v + 2, 2, 3, s.x, s.y, 0, bj);
            want += check__overlap(bi, bj) && !check__ignored(c, v, 2, 2);
        }
    // Edges of a sheet of 15 x 15 halved squares: each once.
    assert_int_equal(c->edges.count, 2 * (3 * 15 * 15 + 2 * 15));
    assert_int_equal(c->points.count, 2 * 16 * 16);
    (void)check_path(c, s.x, s.y);
    r = check_end(c);
    assert_true(want > 1000);
    assert_int_equal(r.pairs, want);
    t_free_sheets(&s);
}

// ---------------------------------------------------------------------------------------------
// Public queries with exact answers; their coordinates are doubles written as fractions.
// ---------------------------------------------------------------------------------------------

// Reads one row; 0 at the end. The value is exact if the denominator is a power of two and the
// numerator has at most 53 bits, which the caller is told.
static int t_row(FILE *f, double *x, int *truth, int *exact) {
    char line[1024], *at = line;
    int k, e;
    if (!fgets(line, sizeof line, f)) return 0;
    for (k = 0; k < 3; k++) {
        double num = strtod(at, &at), den;
        at += *at == ',';
        den = strtod(at, &at);
        at += *at == ',';
        if (frexp(den, &e) != 0.5 || fabs(num) > 9007199254740992.0) *exact = 0;
        x[k] = num / den;
    }
    *truth = (int)strtol(at, NULL, 10);
    return 1;
}

static int t_query_file(const char *name, int edges, long *count) {
    FILE *f = fopen(name, "r");
    int row = 0, truth, exact = 1, missed = 0;
    double x[8][3];
    check__pair p = edges ? t_pair(3, 2, 2) : t_pair(3, 1, 3);
    if (!f) return -1;
    while (t_row(f, x[row % 8], &truth, &exact)) {
        check_verdict v;
        if (++row % 8) continue;
        memcpy(p.x[0], x, 4 * sizeof x[0]);
        memcpy(p.x[1], x + 4, 4 * sizeof x[0]);
        v = check__pair_path(&p, INFINITY).verdict;
        count[truth ? 3 + (int)v : (int)v]++;
        count[6] += !exact;
        missed += truth && v == CHECK_CLEAR;
        missed += !truth && v == CHECK_COLLIDES && exact;
        exact = 1;
    }
    fclose(f);
    return missed;
}

static void public_queries(void **state) {
    static const char *const set[] = {"erleben-cube-cliff-edges", "erleben-spikes",
                                      "erleben-wedges", "unit-tests"};
    const char *folder = getenv("TSS_CCD_DATA");
    long count[7] = {0, 0, 0, 0, 0, 0, 0};
    int i, missed = 0, files = 0;
    (void)state;
    if (!folder) skip();
    for (i = 0; i < 16; i++) {
        char name[1024];
        int edges = i / 4 % 2, m;
        (void)snprintf(name, sizeof name, "%s/%s_%s_data_0_%d.csv", folder, set[i % 4],
                       edges ? "edge-edge" : "vertex-face", i / 8);
        m = t_query_file(name, edges, count);
        files += m >= 0;
        if (m > 0) print_message("%s: %d wrong\n", name, m);
        missed += m > 0 ? m : 0;
    }
    print_message("%d files; no collision: %ld clear, %ld undecided, %ld collides; collision: "
                  "%ld clear, %ld undecided, %ld collides; %ld inexact\n", files, count[0],
                  count[1], count[2], count[3], count[4], count[5], count[6]);
    assert_true(files > 0);
    assert_int_equal(missed, 0);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(predicates_match_integers), cmocka_unit_test(predicates_one_ulp),
        cmocka_unit_test(predicates_wide_exponents), cmocka_unit_test(segment_triangle_on_grid),
        cmocka_unit_test(coplanar_matches_plane),    cmocka_unit_test(segments2d_on_grid),
        cmocka_unit_test(path_tunnelling),           cmocka_unit_test(path_grazing_by_one_ulp),
        cmocka_unit_test(path_edges),                cmocka_unit_test(path_plane),
        cmocka_unit_test(distances_match_grid),      cmocka_unit_test(random_paths_match_sampling),
        cmocka_unit_test(made_collisions_are_found), cmocka_unit_test(cells_along_paths),
        cmocka_unit_test(cells_between_good_ends),   cmocka_unit_test(scene_catches_one_vertex),
        cmocka_unit_test(scene_breaks_and_range),    cmocka_unit_test(scene_plane),
        cmocka_unit_test(moving_orientation_is_exact), cmocka_unit_test(scene_loose_primitives),
        cmocka_unit_test(tree_finds_all_pairs),      cmocka_unit_test(public_queries),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
