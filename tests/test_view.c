// Pictures and the report page: the rasteriser against areas and depths known in closed form, the
// maps' luminance, PNG files read back with libpng, the page's tags, escapes and numbers, and what
// is said when a file cannot be written.
#include <setjmp.h>
#include <stdarg.h>
#include <stddef.h>
#include <stdint.h>

#include <cmocka.h>

#define VIEW_IMPLEMENTATION
#include "../examples/view.h"
#define REPORT_IMPLEMENTATION
#include "../examples/report.h"
#include "page.h"

#ifdef _OPENMP
#include <omp.h>
#endif

enum { W = 320, H = 240 };

// A flat picture whose world units are pixels, y up, the origin in the lower left corner.
static view *pixel_view(view_look *look) {
    view *v = view_create(W, H);
    assert_non_null(v);
    view_camera c;
    memset(&c, 0, sizeof c);
    c.at[0] = c.eye[0] = 0.5 * W, c.at[1] = c.eye[1] = 0.5 * H, c.eye[2] = 10, c.up[1] = 1,
    c.height = H;
    *look = view_look_2d();
    look->ground = 0;
    for (int i = 0; i < 3; i++) look->top[i] = look->bottom[i] = 0;
    view_begin(v, &c, look);
    return v;
}

static view_style plain(float r, float g, float b) {
    view_style s = view_style_default();
    s.colour[0] = r, s.colour[1] = g, s.colour[2] = b;
    return s;
}

// Covered area in pixels of white on black.
static double area(const view_image *im) {
    double sum = 0;
    for (int i = 0; i < im->width * im->height; i++)
        sum += (double)view__to_linear((float)im->rgb[3 * i] / 255);
    return sum;
}

static const unsigned char *at(const view_image *im, int x, int y) {
    return im->rgb + 3 * (y * im->width + x);
}

static void test_triangle_area(void **state) {
    (void)state;
    view_look look;
    view *v = pixel_view(&look);
    view_style s = plain(1, 1, 1);
    unsigned seed = 12345;
    for (int round = 0; round < 12; round++) {
        double x[9];
        int t[3] = {0, 1, 2};
        for (int i = 0; i < 9; i++) {
            seed = seed * 1664525u + 1013904223u;
            x[i] = i % 3 == 2 ? 0 : 10 + (seed >> 8) / 16777216.0 * (i % 3 ? H - 20 : W - 20);
        }
        view_begin(v, &v->camera, &look);
        assert_true(view_add_mesh(v, x, 3, t, 1, &s));
        view_image im = view_render(v);
        double ux = x[3] - x[0], uy = x[4] - x[1], vx = x[6] - x[0], vy = x[7] - x[1];
        double exact = 0.5 * fabs(ux * vy - uy * vx);
        double edge = hypot(ux, uy) + hypot(vx, vy) + hypot(ux - vx, uy - vy);
        // Each pixel on the edge is off by less than an eighth, at random.
        if (fabs(area(&im) - exact) > 1 + 0.02 * edge)
            fail_msg("seed 12345 round %d: %g not %g", round, area(&im), exact);
    }
    view_destroy(v);
}

// Two triangles that share an edge cover each sample once: a fan of white slivers leaves no crack
// and no black sample inside, at any of 8 samples a pixel.
static void test_watertight(void **state) {
    (void)state;
    view_look look;
    view *v = pixel_view(&look);
    view_style s = plain(1, 1, 1);
    enum { N = 97 };
    double x[3 * (N + 1)] = {161.3, 118.7, 0};
    int t[3 * N];
    for (int i = 0; i < N; i++) {
        x[3 * i + 3] = 161.3 + 400 * cos(2 * VIEW__PI * i / N),
                  x[3 * i + 4] = 118.7 + 400 * sin(2 * VIEW__PI * i / N);
        x[3 * i + 5] = 0;
        t[3 * i] = 0, t[3 * i + 1] = 1 + i, t[3 * i + 2] = 1 + (i + 1) % N;
    }
    assert_true(view_add_mesh(v, x, N + 1, t, N, &s));
    view_image im = view_render(v);
    for (int i = 0; i < 3 * W * H; i++) assert_int_equal(im.rgb[i], 255);
    view_destroy(v);
}

static void test_depth_order(void **state) {
    (void)state;
    view_look look;
    view *v = pixel_view(&look);
    // Red in front on the left, green on the right: they cross at x = 160. Drawn in both orders.
    double a[12] = {60, 60, 2, 260, 60, -2, 260, 180, -2, 60, 180, 2};
    double b[12] = {60, 60, -2, 260, 60, 2, 260, 180, 2, 60, 180, -2};
    int t[6] = {0, 1, 2, 0, 2, 3};
    view_style red = plain(1, 0, 0), green = plain(0, 1, 0);
    for (int order = 0; order < 2; order++) {
        view_begin(v, &v->camera, &look);
        assert_true(view_add_mesh(v, order ? b : a, 4, t, 2, order ? &green : &red));
        assert_true(view_add_mesh(v, order ? a : b, 4, t, 2, order ? &red : &green));
        view_image im = view_render(v);
        assert_int_equal(at(&im, 157, 120)[0], 255);
        assert_int_equal(at(&im, 157, 120)[1], 0);
        assert_int_equal(at(&im, 162, 120)[0], 0);
        assert_int_equal(at(&im, 162, 120)[1], 255);
        assert_int_equal(at(&im, 50, 120)[0], 0);
    }
    view_destroy(v);
}

// Perspective: a square of side 1 at distance 4 under a field of view of 2 atan(1/4) is H/2 high.
static void test_perspective_and_clip(void **state) {
    (void)state;
    view_look look;
    view *v = pixel_view(&look);
    view_camera c;
    memset(&c, 0, sizeof c);
    c.eye[2] = 4, c.up[1] = 1, c.fov = 2 * atan(0.25) * 180 / VIEW__PI;
    double x[12] = {-.5, -.5, 0, .5, -.5, 0, .5, .5, 0, -.5, .5, 0};
    int t[6] = {0, 1, 2, 0, 2, 3};
    view_style s = plain(1, 1, 1);
    view_begin(v, &c, &look);
    assert_true(view_add_mesh(v, x, 4, t, 2, &s));
    view_image im = view_render(v);
    assert_true(fabs(area(&im) - H / 2 * (H / 2)) < 60);
    // A floor that passes below and behind the eye fills the lower half, up to the horizon.
    double y[12] = {-1e6, -1, 1e6, 1e6, -1, 1e6, 1e6, -1, -1e6, -1e6, -1, -1e6};
    view_begin(v, &c, &look);
    assert_true(view_add_mesh(v, y, 4, t, 2, &s));
    im = view_render(v);
    assert_true(fabs(area(&im) - W * H / 2) < W);
    assert_int_equal(at(&im, 160, 239)[0], 255);
    assert_int_equal(at(&im, 160, 110)[0], 0);
    view_destroy(v);
}

static void test_camera_fits(void **state) {
    (void)state;
    view *v = view_create(W, H);
    double lo[3] = {-3, 1, 2}, hi[3] = {5, 2, 9};
    for (int k = 0; k < 36; k++) {
        view_axis up = (view_axis)(k % 3);
        view_look look = view_look_default();
        view_camera c = view_camera_fit(lo, hi, 37 * k, -80 + 5 * k, k % 2 ? 40 : 0, up, W, H);
        view_begin(v, &c, &look);
        double most = 0;
        for (int j = 0; j < 8; j++) {
            double d[3], p[3], x, y, q;
            for (int i = 0; i < 3; i++) d[i] = (j >> i & 1 ? hi[i] : lo[i]) - c.eye[i];
            p[0] = view__dot(d, v->right), p[1] = view__dot(d, v->up),
            p[2] = view__dot(d, v->forward);
            view__project(v, p, &x, &y, &q);
            assert_true(p[2] > 0);
            most = fmax(most, fmax(fabs(x / (0.5 * W) - 1), fabs(y / (0.5 * H) - 1)));
        }
        assert_true(most < 1 && most > 0.8);  // all inside, and the picture well used
    }
    view_destroy(v);
}

static void test_light_and_shadow(void **state) {
    (void)state;
    view *v = view_create(W, H);
    double lo[3] = {-2, 0, -2}, hi[3] = {2, 1, 2};
    view_camera c = view_camera_fit(lo, hi, 0, 35, 35, VIEW_UP_Y, W, H);
    view_look look = view_look_default();
    look.ground = 1, look.grid = -1, look.light_azimuth = -90, look.light_elevation = 45;
    double x[12] = {-.5, 1, -.5, .5, 1, -.5, .5, 1, .5, -.5, 1, .5};
    int t[6] = {0, 1, 2, 0, 2, 3};
    view_style s = plain(1, 1, 1);
    int lum[2][2];
    for (int with = 0; with < 2; with++) {
        view_begin(v, &c, &look);
        if (with) assert_true(view_add_mesh(v, x, 4, t, 2, &s));
        view_image im = view_render(v);
        // Light from the left at 45 degrees: a plate at height 1 shades the ground one unit right.
        for (int k = 0; k < 2; k++) {
            double g[3] = {k ? -1.0 : 1.0, 0, 0}, d[3], p[3], px, py, q;
            for (int i = 0; i < 3; i++) d[i] = g[i] - c.eye[i];
            p[0] = view__dot(d, v->right), p[1] = view__dot(d, v->up),
            p[2] = view__dot(d, v->forward);
            view__project(v, p, &px, &py, &q);
            lum[with][k] = at(&im, (int)px, (int)py)[1];
        }
    }
    assert_true(lum[1][0] < lum[0][0] - 40);
    assert_true(abs(lum[1][1] - lum[0][1]) <= 2);
    view_destroy(v);
}

// No acne: a lit sphere alone, under a light that faces it, is as bright as without shadows.
static void test_no_acne(void **state) {
    (void)state;
    view *v = view_create(W, H);
    double o[3] = {0, 0, 0}, lo[3] = {-1, -1, -1}, hi[3] = {1, 1, 1}, worst = 0;
    view_camera c = view_camera_fit(lo, hi, 20, 30, 35, VIEW_UP_Y, W, H);
    static unsigned char kept[3 * W * H];
    view_style s = plain(.8f, .8f, .8f);
    for (int k = 0; k < 2; k++) {
        view_look look = view_look_default();
        look.light_azimuth = 0, look.light_elevation = 30, look.shadow = 1 - k, look.occlusion = 0;
        view_begin(v, &c, &look);
        assert_true(view_add_points(v, o, 1, NULL, 1, 1, &s));
        view_image im = view_render(v);
        for (int i = 0; i < 3 * W * H; i++)
            if (k == 0)
                kept[i] = im.rgb[i];
            else
                worst = fmax(worst, abs(kept[i] - im.rgb[i]));
    }
    assert_true(worst <= 12);
    view_destroy(v);
}

static void test_threads(void **state) {
    (void)state;
#ifdef _OPENMP
    view *v = view_create(W, H);
    double x[30];
    int e[18];
    for (int i = 0; i < 10; i++) x[3 * i] = cos(i), x[3 * i + 1] = 0.1 * i, x[3 * i + 2] = sin(i);
    for (int i = 0; i < 9; i++) e[2 * i] = i, e[2 * i + 1] = i + 1;
    static unsigned char kept[3 * W * H];
    for (int n = 1; n <= 4; n++) {
        view_look look = view_look_default();
        look.ground = 1;
        view_begin(v, &v->camera, &look);
        assert_true(view_add_segments(v, x, 10, e, 9, 0.1, NULL));
        omp_set_num_threads(n);
        view_image im = view_render(v);
        if (n == 1)
            memcpy(kept, im.rgb, sizeof kept);
        else
            assert_memory_equal(kept, im.rgb, sizeof kept);
    }
    view_destroy(v);
#else
    skip();
#endif
}

static void test_bad_meshes(void **state) {
    (void)state;
    view_look look;
    view *v = pixel_view(&look);
    double x[9] = {0, 0, 0, 100, 0, 0, 0, NAN, 0};
    int bad[3] = {0, 1, 3}, low[3] = {0, -1, 2}, good[3] = {0, 1, 2}, same[3] = {1, 1, 1};
    assert_false(view_add_mesh(v, x, 3, bad, 1, NULL));
    assert_false(view_add_mesh(v, x, 3, low, 1, NULL));
    assert_false(view_add_points(v, x, 3, bad, 3, 1, NULL));
    assert_false(view_add_segments(v, x, 3, bad + 1, 1, 1, NULL));
    assert_true(view_add_mesh(v, x, 0, bad, 0, NULL));
    assert_int_equal(v->triangles, 0);
    // Not finite, and no area: accepted, not drawn.
    assert_true(view_add_mesh(v, x, 3, good, 1, NULL));
    assert_true(view_add_mesh(v, x, 3, same, 1, NULL));
    view_image im = view_render(v);
    for (int i = 0; i < 3 * W * H; i++) assert_int_equal(im.rgb[i], 0);
    assert_null(view_create(4, 100));
    view_destroy(v);
    view_destroy(NULL);
}

static double luminance(view_map map, double t) {
    float c[3];
    view_map_colour(map, t, c);
    for (int i = 0; i < 3; i++) assert_true(c[i] >= 0 && c[i] <= 1);
    return 0.2126 * (double)view__to_linear(c[0]) + 0.7152 * (double)view__to_linear(c[1]) +
           0.0722 * (double)view__to_linear(c[2]);
}

static void test_maps(void **state) {
    (void)state;
    for (int m = 0; m < 2; m++)
        for (int i = 1; i <= 256; i++)
            assert_true(luminance((view_map)m, i / 256.0) >
                        luminance((view_map)m, (i - 1) / 256.0));
    for (int i = 1; i <= 128; i++) {  // rises to the middle, falls from it
        assert_true(luminance(VIEW_MAP_BALANCE, i / 256.0) >
                    luminance(VIEW_MAP_BALANCE, (i - 1) / 256.0));
        assert_true(luminance(VIEW_MAP_BALANCE, 0.5 + i / 256.0) <
                    luminance(VIEW_MAP_BALANCE, 0.5 + (i - 1) / 256.0));
    }
    float a[3], b[3];
    view_map_colour(VIEW_MAP_SEA, 7, a), view_map_colour(VIEW_MAP_SEA, 1, b);
    assert_memory_equal(a, b, sizeof a);
    view_map_colour(VIEW_MAP_SEA, NAN, a);
    assert_true(a[0] == a[1] && a[1] == a[2]);
}

// The mapped scalar is the colour of the map, flat and per node.
static void test_scalar_colour(void **state) {
    (void)state;
    view_look look;
    view *v = pixel_view(&look);
    double x[12] = {0, 0, 0, W, 0, 0, W, H, 0, 0, H, 0}, f[4] = {2, 4, 4, 2};
    int t[6] = {0, 1, 2, 0, 2, 3};
    view_style s = view_style_default();
    s.scalar = f, s.lo = 2, s.hi = 4, s.map = VIEW_MAP_EMBER;
    assert_true(view_add_mesh(v, x, 4, t, 2, &s));
    view_image im = view_render(v);
    for (int i = 5; i < W; i += 31) {
        float c[3];
        view_map_colour(VIEW_MAP_EMBER, (i + 0.5) / W, c);
        for (int k = 0; k < 3; k++)
            assert_true(fabs(255.0 * (double)c[k] - at(&im, i, 100)[k]) <= 1.5);
    }
    view_destroy(v);
}

static void test_text_and_images(void **state) {
    (void)state;
    float white[3] = {1, 1, 1};
    view_image im = view_image_alloc(200, 60);
    view_text(&im, 10, 40, 18, white, "Hello, 12");
    double ink = area(&im), wide = view_text_width(18, "Hello, 12");
    assert_true(ink > 150 && ink < 1200 && wide > 60 && wide < 180);
    for (int y = 0; y < 60; y++) assert_int_equal(at(&im, 10 + (int)wide + 5, y)[0], 0);
    for (int c = 33; c < 127; c++) {  // every glyph leaves ink, also half out of the picture
        char one[2] = {(char)c, 0};
        view_image g = view_image_alloc(24, 24);
        view_text(&g, 6, 16, 12, white, one);
        assert_true(area(&g) > 1);
        view_text(&g, -3, 2, 12, white, one);
        view_image_free(&g);
    }
    view_text(&im, NAN, 0, 12, white, "x");
    memset(im.rgb, 100, 3 * 200 * 60);
    view_image small = view_image_shrink(&im, 70), both[2] = {small, small};
    assert_int_equal(small.width, 70);
    assert_int_equal(small.height, 21);
    for (int i = 0; i < 3 * 70 * 21; i++) assert_int_equal(small.rgb[i], 100);
    view_image sheet = view_image_sheet(both, 2, 2, 4, NULL);
    assert_int_equal(sheet.width, 2 * 74 + 4);
    assert_int_equal(at(&sheet, 4 + 74, 4)[0], 100);
    assert_int_equal(at(&sheet, 76, 10)[0], 255);
    both[1] = im;  // of another size
    assert_null(view_image_sheet(both, 2, 2, 4, NULL).rgb);
    view_colour_bar(&sheet, VIEW_MAP_SEA, 1, 1, "same"), view_label(&sheet, "title", NULL);
    view_image_free(&small), view_image_free(&im), view_image_free(&sheet);
}

// ---------------------------------------------------------------------------------------------

static view_image noise(void) {
    view_image im = view_image_alloc(37, 23);
    unsigned seed = 7;
    for (int i = 0; i < 3 * 37 * 23; i++)
        seed = seed * 1664525u + 1013904223u, im.rgb[i] = (unsigned char)(seed >> 24);
    return im;
}

static void test_png(void **state) {
    (void)state;
    view_image im = noise();
    view_error e;
#ifdef VIEW_NO_PNG
    assert_true(view_write_png("test_view_out.png", &im, &e));
    char *s = slurp("test_view_out.ppm");
    assert_memory_equal(s, "P6\n37 23\n255\n", 13);
    assert_memory_equal(s + 13, im.rgb, 3 * 37 * 23);
    free(s), remove("test_view_out.ppm");
#else
    assert_true(view_write_png("test_view_out.png", &im, &e));
    png_image p;
    memset(&p, 0, sizeof p);
    p.version = PNG_IMAGE_VERSION;
    assert_true(png_image_begin_read_from_file(&p, "test_view_out.png"));
    p.format = PNG_FORMAT_RGB;
    assert_int_equal(p.width, 37);
    assert_int_equal(p.height, 23);
    static unsigned char back[3 * 37 * 23];
    assert_true(png_image_finish_read(&p, NULL, back, 0, NULL));
    assert_memory_equal(back, im.rgb, sizeof back);
    remove("test_view_out.png");
#endif
    view_image_free(&im);
}

static void test_unwritable(void **state) {
    (void)state;
    view_image im = noise(), none = {3, 3, NULL};
    view_error e;
    assert_false(view_write_png("no/such/folder/a.png", &im, &e));
    assert_non_null(strstr(e.message, "no/such/folder/a.p"));
    assert_false(view_write_ppm("no/such/folder/a.ppm", &im, &e));
    assert_false(view_write_png("test_view_none.png", &none, &e));
    assert_non_null(strstr(e.message, "empty"));
    assert_false(view_write_png("no/such/folder/a.png", &im, NULL));
#ifdef __linux__
    assert_false(view_write_ppm("/dev/full", &im, &e));  // opens, takes nothing
    assert_non_null(strstr(e.message, "/dev/full"));
#endif
    view_image_free(&im);
    report_error r;
    assert_false(report_end(report_begin("x", NULL), "no/such/folder", &r));
    assert_non_null(strstr(r.message, "no/such/folder/report.html"));
    report *p = report_begin("x", NULL);
    const char *paths[1] = {"missing.png"};
    report_frames(p, paths, NULL, 1, 3);
    assert_false(report_end(p, ".", &r));
    assert_non_null(strstr(r.message, "missing.png"));
    remove("report.html");
    assert_false(report_end(NULL, ".", &r));
}

static void test_report(void **state) {
    (void)state;
    enum { N = 2000 };
    static double t[N], a[N], b[N], gap[N];
    for (int i = 0; i < N; i++)
        t[i] = 0.01 * i, a[i] = 1 + sin(0.01 * i), b[i] = 0.5,
        gap[i] = i % 100 ? pow(10, -3 - 2 * sin(0.02 * i)) : 0;
    a[1234] = 77;  // a spike that thinning must keep
    report *r = report_begin("<script>alert(\"1 & 2\")</script>", "it's a 'test'");
    report_status(r, "R & D", "<fine>", REPORT_GOOD);
    report_heading(r, "Head <1>"), report_text(r, "a < b & c > d");
    const char *names[2] = {"dt", "file"}, *values[2] = {"0.01 s", "a\"b\"<c>&.msh"};
    report_table(r, "Scene & more", names, values, 2);
    report_series s[3] = {{"one <a>", t, a, N, NULL, REPORT_SOLID, 0},
                          {"two & b", t, b, N, NULL, REPORT_SOLID, 0},
                          {"gap", NULL, gap, N, NULL, REPORT_SOLID, 0}};
    report_plot p = report_plot_default("lines <&>", "time, s", "n"), q = p, l = p;
    q.stacked = 1, l.log_y = 1, l.markers = 1, l.note = "a note";
    report_add_plot(r, &p, s, 2), report_add_plot(r, &q, s, 2), report_add_plot(r, &l, s + 2, 1);
    double none[2] = {NAN, NAN}, one[1] = {3};
    report_series empty = {"none", NULL, none, 2, NULL, REPORT_SOLID, 0},
                  single = {"one", NULL, one, 1, NULL, REPORT_SOLID, 0},
                  zero = {"zero", NULL, NULL, 0, NULL, REPORT_SOLID, 0};
    report_add_plot(r, &p, &empty, 1), report_add_plot(r, &p, &single, 1),
        report_add_plot(r, &p, &zero, 1);
    report_add_plot(r, &l, &empty, 1), report_add_plot(r, &q, &zero, 1);
#ifndef VIEW_NO_PNG
    view_image im = noise();
    view_error e;
    const char *paths[9], *shown[9] = {"f0", "f1", "f2", "f3", "f4", "f5", "f6", "f7", "f8"};
    for (int i = 0; i < 9; i++) paths[i] = "test_view_frame.png";
    assert_true(view_write_png(paths[0], &im, &e));
    report_frames(r, paths, shown, 9, 3);
    view_image_free(&im), remove(paths[0]);
#endif
    report_error why;
    if (!report_end(r, ".", &why)) fail_msg("%s", why.message);
    char *h = slurp("report.html");
    check_tags(h);
    assert_null(strstr(h, "<script"));
    assert_null(strstr(h, "nan"));
    assert_null(strstr(h, ">inf<"));
    assert_non_null(strstr(h, "&lt;script&gt;alert(&quot;1 &amp; 2&quot;)"));
    assert_non_null(strstr(h, "a&quot;b&quot;&lt;c&gt;&amp;.msh"));
    assert_non_null(strstr(h, "20 values not drawn"));
    assert_null(strstr(h, "http:"));  // self-contained
    assert_true(strlen(h) < 400000);
#ifndef VIEW_NO_PNG
    assert_non_null(strstr(h, "data:image/png;base64,iVBORw0KGgo"));
    assert_true(strstr(h, ">f0<") && strstr(h, ">f4<") && strstr(h, ">f8<") && !strstr(h, ">f3<"));
#endif
    free(h), remove("report.html");
}

// Base64 against the examples of RFC 4648, section 10; numbers with a point and rounded.
static void test_encodings(void **state) {
    (void)state;
    static const char *const pair[7][2] = {{"", ""},
                                           {"f", "Zg=="},
                                           {"fo", "Zm8="},
                                           {"foo", "Zm9v"},
                                           {"foob", "Zm9vYg=="},
                                           {"fooba", "Zm9vYmE="},
                                           {"foobar", "Zm9vYmFy"}};
    for (int i = 0; i < 7; i++) {
        report *r = report_begin("", NULL);
        report__base64(r, &r->body, (const unsigned char *)pair[i][0], strlen(pair[i][0]));
        assert_string_equal(r->body.at ? r->body.at : "", pair[i][1]);
        r->body.size = 0;
        report__format(r, &r->body, "%f %f %d %s", -0.126, 12.0, 7, "<");
        assert_string_equal(r->body.at, "-0.13 12.00 7 &lt;");
        assert_true(report_end(r, ".", NULL));
    }
    remove("report.html");
}

static void test_ticks(void **state) {
    (void)state;
    double tick[12];
    report__axis a = {0, 1, 0, 100, 0}, l = {-6.2, 2.1, 0, 100, 1}, s = {0, 1.2, 0, 100, 1};
    assert_int_equal(report__ticks(&a, 5, tick), 6);
    for (int i = 0; i < 6; i++) assert_true(fabs(tick[i] - 0.2 * i) < 1e-12);
    int n = report__ticks(&l, 5, tick);
    assert_true(n >= 4 && n <= 9);
    for (int i = 0; i < n; i++)
        assert_true(fabs(log10(tick[i]) - floor(log10(tick[i]) + 0.5)) < 1e-9);
    assert_int_equal(report__ticks(&s, 5, tick), 4);  // 1 2 5 10
    assert_true(fabs(report__pixel(&l, 1e-3) - 100 * 3.2 / 8.3) < 1e-9);
}

int main(void) {
    const struct CMUnitTest tests[] = {
        cmocka_unit_test(test_triangle_area), cmocka_unit_test(test_watertight),
        cmocka_unit_test(test_depth_order),   cmocka_unit_test(test_perspective_and_clip),
        cmocka_unit_test(test_camera_fits),   cmocka_unit_test(test_light_and_shadow),
        cmocka_unit_test(test_no_acne),       cmocka_unit_test(test_threads),
        cmocka_unit_test(test_bad_meshes),    cmocka_unit_test(test_maps),
        cmocka_unit_test(test_scalar_colour), cmocka_unit_test(test_text_and_images),
        cmocka_unit_test(test_png),           cmocka_unit_test(test_unwritable),
        cmocka_unit_test(test_report),        cmocka_unit_test(test_encodings),
        cmocka_unit_test(test_ticks),
    };
    return cmocka_run_group_tests(tests, NULL, NULL);
}
