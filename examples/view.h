/* view.h: pictures of meshes without a graphics card (for the example programs)

   #define VIEW_IMPLEMENTATION        // in one .c file; link -lpng -lm (or define VIEW_NO_PNG)
   #include "view.h"

   view *v = view_create(960, 640);
   view_camera cam = view_camera_fit(lo, hi, 35, 20, 35, VIEW_UP_Y, 960, 640);
   view_look look = view_look_default();
   look.ground = 1;
   view_begin(v, &cam, &look);
   view_style s = view_style_default();
   view_add_mesh(v, x, nodes, triangles, count, &s);
   view_image im = view_render(v);                    // pixels belong to v until its next call
   view_label(&im, "armadillo on spikes", "step 12   t = 0.30 s");
   view_error why;
   if (!view_write_png("frame.png", &im, &why)) fprintf(stderr, "%s\n", why.message);
   view_destroy(v);

   WHAT IT DRAWS  Triangle meshes (one colour, darkened by a scalar or chosen by it; mesh edges),
   segments as tubes, points as balls, a ground plane with a grid that fades out; text, a colour
   bar, contact sheets. A key light with soft shadows (harder near contact), a fill light, a sky,
   ambient occlusion; 2D meshes unlit, seen from above.

   METHOD  A visibility buffer of 8 samples a pixel; each triangle is shaded once in each pixel it
   is seen in. Shadows: percentage closer soft shadows; occlusion: scalable ambient obscurance.
   Both are sampled in a 4 x 4 pattern and gathered across surfaces of like position and normal.

   CONVENTIONS  x is nodes x 3 doubles, triangles 3 ints each, 0-based. Images are 8-bit sRGB, rows
   from the top. Colours in structs are sRGB, 0..1. Angles in degrees.

   ERRORS  Functions return 1, or 0 and (where there is a view_error) a sentence that names the
   file. A view that ran out of memory draws what it has; view_render then gives rgb == NULL.
   Triangles with a vertex that is not finite are left out.

   MEMORY  malloc; kept in the view from frame to frame. THREADS  One view, one thread; OpenMP
   inside when compiled with it. The pixels do not depend on the number of threads.

   >>types  >>scene  >>image  >>colour  >>vectors  >>camera  >>store  >>raster  >>surface
   >>shadow  >>gather  >>shade  >>render  >>font  >>pixels  >>text  >>overlay  >>files            */
#ifndef VIEW_H
#define VIEW_H

#include <stddef.h>

#ifdef __cplusplus
extern "C" {
#endif

#ifndef VIEW_API
#define VIEW_API extern
#endif

// ---------------------------------------------------------------------------------------------
// >>types (public)
// ---------------------------------------------------------------------------------------------

typedef struct view view;

typedef struct view_error {
    char message[512];
} view_error;

// width x height x 3 bytes, rows from the top.
typedef struct view_image {
    int width, height;
    unsigned char *rgb;
} view_image;

typedef enum view_axis { VIEW_UP_X, VIEW_UP_Y, VIEW_UP_Z } view_axis;

typedef struct view_camera {
    double eye[3], at[3], up[3];
    double fov;     // vertical, degrees; 0: orthographic
    double height;  // orthographic: world units from the bottom to the top of the picture
} view_camera;

// Colour maps made by formula in OKLab: the first two rise evenly in lightness.
typedef enum view_map {
    VIEW_MAP_SEA,      // violet, blue, green, yellow
    VIEW_MAP_EMBER,    // black, violet, red, pale yellow
    VIEW_MAP_BALANCE,  // blue, white, red: for values of two signs
    VIEW_MAP_COUNT
} view_map;

typedef struct view_look {
    int flat;                  // 1: colours as they are, no light, shadow or occlusion (2D)
    int ground;                // 1: draw the ground plane
    view_axis up;              // its normal
    double ground_height;      // its place along up
    double grid;               // spacing of its lines; 0: from the camera; < 0: no lines
    double light_azimuth;      // of the key light, from the camera's, to the right
    double light_elevation;    // above the ground
    double shadow, occlusion;  // strengths, 0..1
    float top[3], bottom[3];   // background
} view_look;

typedef struct view_style {
    float colour[3];
    const double *scalar;  // one a node, through map; NULL: colour. Not finite: grey
    double lo, hi;         // the scalars at the map's ends
    view_map map;
    float darken;   // > 0: the scalar darkens colour by up to this share, instead of map; 0..1
    double crease;  // smooth shading across edges bent less than this; 0: flat facets
    float wire;     // opacity of the mesh edges, 0..1
    float wire_colour[3];
} view_style;

// ---------------------------------------------------------------------------------------------
// >>scene (public)
// ---------------------------------------------------------------------------------------------

// 16 <= width, height <= 8192. NULL: no memory or bad size.
VIEW_API view *view_create(int width, int height);
VIEW_API void view_destroy(view *v);  // NULL is allowed

VIEW_API view_look view_look_default(void);
VIEW_API view_look view_look_2d(void);  // flat, paper-white, grid on the plane z = ground_height
VIEW_API view_style view_style_default(void);

// A camera that sees the whole box. azimuth 0 looks along -z (up y) or +y (up z), positive moves
// the camera to its right; fov 0: orthographic. Works for flat and for empty (point) boxes.
VIEW_API view_camera view_camera_fit(const double lo[3], const double hi[3], double azimuth,
                                     double elevation, double fov, view_axis up, int width,
                                     int height);
// Looks down -z at the box, x to the right, y up.
VIEW_API view_camera view_camera_fit_2d(const double lo[3], const double hi[3], int width,
                                        int height);
// Grows the box lo, hi by n points; start with lo > hi. Points that are not finite are skipped.
VIEW_API void view_box_add(double lo[3], double hi[3], const double *x, int n);

// Starts a picture: forgets all objects.
VIEW_API void view_begin(view *v, const view_camera *camera, const view_look *look);
// Everything is copied. style NULL: the default. Indices outside 0..nodes-1: 0 and nothing drawn.
VIEW_API int view_add_mesh(view *v, const double *x, int nodes, const int *triangles, int count,
                           const view_style *style);
// Tubes of the given radius; <= 0: two pixels wide at the camera's target.
VIEW_API int view_add_segments(view *v, const double *x, int nodes, const int *segments, int count,
                               double radius, const view_style *style);
// Balls; indices NULL: the first count nodes. radius <= 0: three pixels at the camera's target.
VIEW_API int view_add_points(view *v, const double *x, int nodes, const int *indices, int count,
                             double radius, const view_style *style);
// Draws. The pixels belong to the view and live until its next call; rgb NULL: no memory.
VIEW_API view_image view_render(view *v);

// ---------------------------------------------------------------------------------------------
// >>image (public)
// ---------------------------------------------------------------------------------------------

// t is clamped to 0..1 (not finite: grey); rgb is sRGB, 0..1.
VIEW_API void view_map_colour(view_map map, double t, float rgb[3]);

// Zeroed; rgb NULL: no memory or bad size. Free with view_image_free.
VIEW_API view_image view_image_alloc(int width, int height);
VIEW_API void view_image_free(view_image *image);
// A smaller copy (box filter in linear light) of the given width, the same shape.
VIEW_API view_image view_image_shrink(const view_image *image, int width);
// A contact sheet: images of one size in rows, with a gap; labels NULL, or one a picture.
VIEW_API view_image view_image_sheet(const view_image *images, int count, int columns, int gap,
                                     const char *const *labels);

// size: height of the capitals in pixels; x, y: left end of the baseline. ASCII; others as a box.
VIEW_API void view_text(view_image *image, double x, double y, double size, const float rgb[3],
                        const char *text);
VIEW_API double view_text_width(double size, const char *text);
// Title and a smaller line below it in the upper left corner; either may be NULL.
VIEW_API void view_label(view_image *image, const char *title, const char *line);
// A bar at the right edge with a label above and round numbers beside it.
VIEW_API void view_colour_bar(view_image *image, view_map map, double lo, double hi,
                              const char *label);

// With VIEW_NO_PNG: writes .ppm instead (the suffix .png is replaced).
VIEW_API int view_write_png(const char *path, const view_image *image, view_error *error);
VIEW_API int view_write_ppm(const char *path, const view_image *image, view_error *error);

#ifdef __cplusplus
}
#endif
#endif  // VIEW_H

#if defined(VIEW_IMPLEMENTATION) && !defined(VIEW_IMPLEMENTATION_DONE)
#define VIEW_IMPLEMENTATION_DONE

#include <errno.h>
#include <float.h>
#include <limits.h>
#include <math.h>
#include <stdint.h>
#include <stdio.h>
#include <stdlib.h>
#include <string.h>
#ifndef VIEW_NO_PNG
#include <png.h>
#endif

#ifdef __cplusplus
extern "C" {
#endif

#define VIEW__PI 3.14159265358979323846
#define VIEW__SAMPLES 8
#define VIEW__BAND 32         // rows of one piece of work: never depends on the threads
#define VIEW__TILE 16         // divides VIEW__BAND: a tile belongs to one piece of work
#define VIEW__SHADOW 2048     // texels along a side of the shadow map
#define VIEW__COARSE 64       // cells along a side of its table of highest points
#define VIEW__LIGHT_BANDS 16  // pieces of work in the shadow map
#define VIEW__TAPS 9          // light samples a pixel; 16 pixels share them
#define VIEW__REACH 0.10f     // most of the picture's height that occlusion looks across
#define VIEW__NONE (-1)       // ids of what is not a triangle
#define VIEW__GROUND (-2)

// Subpixel sample positions in sixteenths: no two share a row or a column, so that nearly
// horizontal and nearly vertical edges get all nine grey levels.
static const float view__sample[VIEW__SAMPLES][2] = {
    {1 / 16.0f, -3 / 16.0f},  {-1 / 16.0f, 3 / 16.0f}, {5 / 16.0f, 1 / 16.0f},
    {-3 / 16.0f, -5 / 16.0f}, {-5 / 16.0f, 5 / 16.0f}, {-7 / 16.0f, -1 / 16.0f},
    {3 / 16.0f, 7 / 16.0f},   {7 / 16.0f, -7 / 16.0f}};

// One surface's look, in linear light.
typedef struct view__object {
    float colour[3], wire_colour[3], wire, darken;
    int mapped, map, gloss;
} view__object;

// What a pixel's centre sees, in view space; and the light that reaches it.
typedef struct view__pixel {
    float p[3], n[3];  // p[2] < 0: background (or ground too far to be lit apart)
    float lit, open;   // 1: no shadow; 1: no occlusion
} view__pixel;

// A triangle ready to be rasterised: pixels (a multiple of 1/256) and nearness.
typedef struct view__screen {
    double x[3], y[3], q[3];
    int id, y0, y1;
} view__screen;

struct view {
    int width, height, failed;
    view_camera camera;
    view_look look;
    // scene: grown and kept
    double *x;      // vertices × 3, world
    float *scalar;  // vertices: place in the colour map, NaN = none
    int *triangle;  // triangles × 3
    int *owner;     // triangles: object
    float *normal;  // triangles × 9: corner normals, world
    view__object *object;
    size_t vertices, x_cap, scalar_cap, triangles, triangle_cap, owner_cap, normal_cap;
    size_t objects, object_cap;
    // frame
    double *p, *m;  // vertices × 3: view space (right, up, forward); shadow map
    view__screen *screen;
    size_t p_cap, m_cap, screens, screen_cap;
    float *q;  // samples: nearness, larger is nearer
    int *id;   // samples: triangle or VIEW__NONE, VIEW__GROUND
    view__pixel *pixel;
    unsigned char *rgb;
    float *shadow, *coarse;
    unsigned char *tile;  // of VIEW__TILE pixels: flags
    int tiles_x, tiles_y;
    // camera, in world axes
    double right[3], up[3], forward[3], extent, scale, near_z;
    float light[3], fill[3], above[3];  // view space, unit
    float ground_n[3], ground_d, ground_u[3], ground_v[3], ground_o[2], centre[3];
    double ground_q[3];  // nearness of the ground: a x + b y + c
    int ground;
    double light_u[3], light_v[3], light_w[3], light_o[3], light_r;  // shadow map, view space
    float top[3], bottom[3], grid;
    float tap[16][VIEW__TAPS][2];
    float lut[VIEW_MAP_COUNT][257][3];
    unsigned char encode[4097];
};

// ---------------------------------------------------------------------------------------------
// >>colour (private)
// Maps are curves in OKLCh (Ottosson 2020): lightness straight or peaked, hue turning evenly,
// chroma cut where the screen's gamut ends. Light is added in linear sRGB.
// ---------------------------------------------------------------------------------------------

static float view__clamp(float x, float lo, float hi) { return x < lo ? lo : x > hi ? hi : x; }

static float view__to_linear(float c) {
    return c <= 0.04045f ? c / 12.92f : powf((c + 0.055f) / 1.055f, 2.4f);
}

static float view__to_srgb(float c) {
    return c <= 0.0031308f ? 12.92f * c : 1.055f * powf(c, 1.0f / 2.4f) - 0.055f;
}

static int view__in_gamut(const double c[3]) {
    for (int i = 0; i < 3; i++)
        if (c[i] < -1e-9 || c[i] > 1 + 1e-9) return 0;
    return 1;
}

static void view__oklch(double light, double chroma, double hue, double c[3]) {
    double a = chroma * cos(hue * VIEW__PI / 180), b = chroma * sin(hue * VIEW__PI / 180);
    double l = light + 0.3963377774 * a + 0.2158037573 * b;
    double m = light - 0.1055613458 * a - 0.0638541728 * b;
    double s = light - 0.0894841775 * a - 1.2914855480 * b;
    l = l * l * l, m = m * m * m, s = s * s * s;
    c[0] = 4.0767416621 * l - 3.3077115913 * m + 0.2309699292 * s;
    c[1] = -1.2684380046 * l + 2.6097574011 * m - 0.3413193965 * s;
    c[2] = -0.0041960863 * l - 0.7034186147 * m + 1.7076147010 * s;
}

void view_map_colour(view_map map, double t, float rgb[3]) {
    rgb[0] = rgb[1] = rgb[2] = 0.6f;
    if (!(t - t == 0)) return;
    t = t < 0 ? 0 : t > 1 ? 1 : t;
    double light = 0.30 + 0.62 * t, hue = 308 - 203 * t, bend = 2 * t - 1;
    double chroma = 0.13 + 0.07 * t * t;
    if (map == VIEW_MAP_EMBER) {
        light = 0.17 + 0.80 * t, hue = 283 + 162 * t;
        chroma = 0.06 + 0.17 * sin(VIEW__PI * pow(t, 0.85));
    } else if (map == VIEW_MAP_BALANCE) {
        light = 0.95 - 0.47 * pow(fabs(bend), 1.25), hue = bend < 0 ? 255 : 27;
        chroma = 0.19 * pow(fabs(bend), 0.9);
    }
    // The largest chroma on the screen, by bisection: 24 halvings are below one part in 10^7.
    double c[3], lo = 0, hi = chroma;
    view__oklch(light, hi, hue, c);
    for (int i = 0; i < 24 && !(i == 0 && view__in_gamut(c)); i++) {
        double mid = 0.5 * (lo + hi);
        view__oklch(light, mid, hue, c);
        if (view__in_gamut(c))
            lo = mid;
        else
            hi = mid;
        view__oklch(light, lo, hue, c);
    }
    for (int i = 0; i < 3; i++) rgb[i] = view__to_srgb(view__clamp((float)c[i], 0, 1));
}

static void view__linear3(const float in[3], float out[3]) {
    for (int i = 0; i < 3; i++) out[i] = view__to_linear(view__clamp(in[i], 0, 1));
}

static void view__patterns(view *v);

static void view__tables(view *v) {
    for (int m = 0; m < VIEW_MAP_COUNT; m++)
        for (int i = 0; i <= 256; i++) {
            float c[3];
            view_map_colour((view_map)m, i / 256.0, c);
            view__linear3(c, v->lut[m][i]);
        }
    for (int i = 0; i <= 4096; i++)
        v->encode[i] = (unsigned char)(255 * view__to_srgb((float)i / 4096) + 0.5f);
}

// ---------------------------------------------------------------------------------------------
// >>vectors (private)
// ---------------------------------------------------------------------------------------------

static double view__dot(const double a[3], const double b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void view__cross(const double a[3], const double b[3], double c[3]) {
    double x = a[1] * b[2] - a[2] * b[1], y = a[2] * b[0] - a[0] * b[2];
    c[2] = a[0] * b[1] - a[1] * b[0], c[0] = x, c[1] = y;
}

// A vector of no length becomes z: every caller needs some direction.
static void view__unit(double a[3]) {
    double l = sqrt(view__dot(a, a));
    if (!(l > 1e-300)) a[0] = a[1] = 0, a[2] = l = 1;
    for (int i = 0; i < 3; i++) a[i] /= l;
}

static float view__dotf(const float a[3], const float b[3]) {
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2];
}

static void view__unitf(float a[3]) {
    float l = sqrtf(view__dotf(a, a));
    if (!(l > 1e-30f)) a[0] = a[1] = 0, a[2] = l = 1;
    for (int i = 0; i < 3; i++) a[i] /= l;
}

// World direction to view space.
static void view__turn(const view *v, const double a[3], float out[3]) {
    out[0] = (float)view__dot(a, v->right);
    out[1] = (float)view__dot(a, v->up);
    out[2] = (float)view__dot(a, v->forward);
}

static float view__smooth(float lo, float hi, float x) {
    float t = view__clamp((x - lo) / (hi - lo), 0, 1);
    return t * t * (3 - 2 * t);
}

// 1, 2 or 5 times a power of ten, the smallest not below x.
static double view__nice(double x) {
    if (!(x > 1e-300) || x > 1e300) return 1;
    double p = pow(10, floor(log10(x)));
    double m = x / p;  // the tolerance lets 2.0000001 be 2
    return p * (m <= 1.0001 ? 1 : m <= 2.0001 ? 2 : m <= 5.0001 ? 5 : 10);
}

typedef void view__work(view *v, int band);

static void view__bands(view *v, view__work *work, int count) {
#ifdef _OPENMP
#pragma omp parallel for schedule(dynamic, 1)
#endif
    for (int band = 0; band < count; band++) work(v, band);
}

// ---------------------------------------------------------------------------------------------
// >>camera (private)
// ---------------------------------------------------------------------------------------------

void view_box_add(double lo[3], double hi[3], const double *x, int n) {
    for (int i = 0; i < n; i++) {
        const double *p = x + 3 * (size_t)i;
        if (!(p[0] - p[0] == 0 && p[1] - p[1] == 0 && p[2] - p[2] == 0)) continue;
        for (int k = 0; k < 3; k++) {
            if (p[k] < lo[k]) lo[k] = p[k];
            if (p[k] > hi[k]) hi[k] = p[k];
        }
    }
}

static void view__axes(const view_camera *c, double right[3], double up[3], double forward[3]) {
    for (int i = 0; i < 3; i++) forward[i] = c->at[i] - c->eye[i];
    view__unit(forward);
    view__cross(forward, c->up, right);
    // Looking along up: any right will do.
    if (view__dot(right, right) < 1e-12) {
        double other[3] = {fabs(forward[0]) < 0.5 ? 1.0 : 0.0, fabs(forward[0]) < 0.5 ? 0.0 : 1.0,
                           0};
        view__cross(forward, other, right);
    }
    view__unit(right);
    view__cross(right, forward, up);
}

// Half sizes of the picture seen by the box's corners: the camera's target moves to the middle of
// what is seen, the distance to the nearest from which all of it is seen.
static void view__fit_pass(view_camera *c, const double lo[3], const double hi[3], double aspect,
                           double tan_y, double *distance) {
    double r[3], u[3], f[3], least[2] = {DBL_MAX, DBL_MAX}, most[2] = {-DBL_MAX, -DBL_MAX};
    double back = 0, tan_x = tan_y * aspect;
    view__axes(c, r, u, f);
    for (int k = 0; k < 8; k++) {
        double p[3];
        for (int i = 0; i < 3; i++) p[i] = (k >> i & 1 ? hi[i] : lo[i]) - c->at[i];
        double x = view__dot(p, r), y = view__dot(p, u), z = view__dot(p, f);
        double need = fmax(fabs(x) / tan_x, fabs(y) / tan_y) - z;
        double sx = c->fov > 0 ? x / (*distance + z) : x, sy = c->fov > 0 ? y / (*distance + z) : y;
        back = fmax(back, need);
        least[0] = fmin(least[0], sx), most[0] = fmax(most[0], sx);
        least[1] = fmin(least[1], sy), most[1] = fmax(most[1], sy);
    }
    double s = c->fov > 0 ? *distance : 1;
    for (int i = 0; i < 3; i++)
        c->at[i] += 0.5 * s * ((least[0] + most[0]) * r[i] + (least[1] + most[1]) * u[i]);
    if (c->fov > 0) *distance = back;
    c->height = fmax(most[1] - least[1], (most[0] - least[0]) / aspect);
    for (int i = 0; i < 3; i++) c->eye[i] = c->at[i] - *distance * f[i];
}

view_camera view_camera_fit(const double lo[3], const double hi[3], double azimuth,
                            double elevation, double fov, view_axis up, int width, int height) {
    view_camera c;
    memset(&c, 0, sizeof c);
    double a = azimuth * VIEW__PI / 180, e = elevation * VIEW__PI / 180, size = 0;
    double low[3], high[3];
    for (int i = 0; i < 3; i++) {
        low[i] = lo[i] <= hi[i] ? lo[i] : 0, high[i] = lo[i] <= hi[i] ? hi[i] : 0;
        size = fmax(size, high[i] - low[i]), c.at[i] = 0.5 * (low[i] + high[i]);
    }
    if (!(size > 0)) size = 1;
    // Toward the camera: azimuth 0 is +z for up y, -y for up z, and cyclically for up x.
    int k = (int)up, front = k == 1 ? 2 : k == 2 ? 1 : 0;
    double toward[3] = {0, 0, 0};
    if (k == 0) front = 1;
    int side = 3 - k - front;
    double sign = k == 2 ? -1.0 : 1.0;
    toward[k] = sin(e), toward[front] = sign * cos(a) * cos(e), toward[side] = sin(a) * cos(e);
    c.up[k] = 1, c.fov = fov > 0 ? fov : 0;
    if (fabs(elevation) > 89.9) c.up[k] = 0, c.up[front] = -sign;
    double distance = 4 * size, margin = 1.10;
    double tan_y = fov > 0 ? tan(0.5 * fov * VIEW__PI / 180) / margin : 1;
    for (int i = 0; i < 3; i++) c.eye[i] = c.at[i] + distance * toward[i];
    // Each pass moves the target by what perspective made uneven: a contraction, 8 are plenty.
    for (int i = 0; i < 8; i++)
        view__fit_pass(&c, low, high, (double)width / height, tan_y, &distance);
    c.height = c.height > 0 ? margin * c.height : size;
    if (distance <= 0) distance = 4 * size;
    for (int i = 0; i < 3; i++) c.eye[i] = c.at[i] + distance * toward[i];
    return c;
}

view_camera view_camera_fit_2d(const double lo[3], const double hi[3], int width, int height) {
    view_camera c = view_camera_fit(lo, hi, 0, 0, 0, VIEW_UP_Y, width, height);
    c.height *= 1.12;  // room for the label
    return c;
}

view_look view_look_default(void) {
    view_look l;
    memset(&l, 0, sizeof l);
    l.up = VIEW_UP_Y;
    l.light_azimuth = -48, l.light_elevation = 52;
    l.shadow = 1, l.occlusion = 1;
    l.top[0] = 0.80f, l.top[1] = 0.84f, l.top[2] = 0.89f;
    l.bottom[0] = 0.94f, l.bottom[1] = 0.945f, l.bottom[2] = 0.95f;
    return l;
}

view_look view_look_2d(void) {
    view_look l = view_look_default();
    l.flat = 1, l.ground = 1, l.up = VIEW_UP_Z;
    for (int i = 0; i < 3; i++) l.top[i] = l.bottom[i] = 0.975f;
    return l;
}

view_style view_style_default(void) {
    view_style s;
    memset(&s, 0, sizeof s);
    s.colour[0] = 0.36f, s.colour[1] = 0.60f, s.colour[2] = 0.80f;
    s.hi = 1, s.crease = 40;
    s.wire_colour[0] = 0.06f, s.wire_colour[1] = 0.09f, s.wire_colour[2] = 0.14f;
    return s;
}

// ---------------------------------------------------------------------------------------------
// >>store (private)
// Objects are copied into one list of vertices and triangles with corner normals.
// ---------------------------------------------------------------------------------------------

static int view__grow(view *v, void *at, size_t *cap, size_t need, size_t size) {
    void *p, *q = NULL;
    if (need <= *cap) return 1;
    size_t n = need + need / 2 + 64;
    memcpy(&p, at, sizeof p);  // at: the address of a pointer to some type
    if (n <= (size_t)INT_MAX && n <= SIZE_MAX / size) q = realloc(p, n * size);
    if (!q) {
        v->failed = 1;
        return 0;
    }
    memcpy(at, &q, sizeof q);
    *cap = n;
    return 1;
}

static int view__reserve(view *v, size_t vertices, size_t triangles) {
    size_t n = v->vertices + vertices, m = v->triangles + triangles;
    return view__grow(v, &v->x, &v->x_cap, n, 3 * sizeof(double)) &&
           view__grow(v, &v->scalar, &v->scalar_cap, n, sizeof(float)) &&
           view__grow(v, &v->triangle, &v->triangle_cap, m, 3 * sizeof(int)) &&
           view__grow(v, &v->owner, &v->owner_cap, m, sizeof(int)) &&
           view__grow(v, &v->normal, &v->normal_cap, m, 9 * sizeof(float)) &&
           view__grow(v, &v->object, &v->object_cap, v->objects + 1, sizeof(view__object));
}

view *view_create(int width, int height) {
    if (width < 16 || height < 16 || width > 8192 || height > 8192) return NULL;
    view *v = (view *)calloc(1, sizeof(view));
    if (!v) return NULL;
    size_t n = (size_t)width * (size_t)height;
    v->width = width, v->height = height;
    v->tiles_x = (width + VIEW__TILE - 1) / VIEW__TILE,
    v->tiles_y = (height + VIEW__TILE - 1) / VIEW__TILE;
    v->tile = (unsigned char *)malloc((size_t)v->tiles_x * (size_t)v->tiles_y);
    v->q = (float *)malloc(n * VIEW__SAMPLES * sizeof(float));
    v->id = (int *)malloc(n * VIEW__SAMPLES * sizeof(int));
    v->pixel = (view__pixel *)malloc(n * sizeof(view__pixel));
    v->rgb = (unsigned char *)malloc(3 * n);
    v->shadow = (float *)malloc(sizeof(float) * VIEW__SHADOW * VIEW__SHADOW);
    v->coarse = (float *)malloc(2 * sizeof(float) * VIEW__COARSE * VIEW__COARSE);
    if (!v->q || !v->id || !v->pixel || !v->rgb || !v->shadow || !v->coarse || !v->tile) {
        view_destroy(v);
        return NULL;
    }
    view__tables(v);
    view__patterns(v);
    double lo[3] = {-1, -1, -1}, hi[3] = {1, 1, 1};
    view_camera c = view_camera_fit(lo, hi, 30, 20, 35, VIEW_UP_Y, width, height);
    view_look look = view_look_default();
    view_begin(v, &c, &look);
    return v;
}

void view_destroy(view *v) {
    if (!v) return;
    free(v->x), free(v->scalar), free(v->triangle), free(v->owner), free(v->normal);
    free(v->object), free(v->p), free(v->m), free(v->screen), free(v->q), free(v->id),
        free(v->pixel);
    free(v->rgb), free(v->shadow), free(v->coarse), free(v->tile), free(v);
}

void view_begin(view *v, const view_camera *camera, const view_look *look) {
    v->camera = *camera, v->look = *look;
    v->vertices = v->triangles = v->objects = 0;
    v->failed = 0;
    view__axes(camera, v->right, v->up, v->forward);
    double d[3];
    for (int i = 0; i < 3; i++) d[i] = camera->at[i] - camera->eye[i];
    double distance = sqrt(view__dot(d, d)), tall = camera->height;
    double t = tan(0.5 * camera->fov * VIEW__PI / 180);
    if (camera->fov > 0) tall = 2 * distance * t;
    // extent: half the height seen at the target; scale: ray slope (or world units) a pixel.
    v->extent = tall > 0 ? 0.5 * tall : 1;
    v->scale = camera->fov > 0 ? 2 * t / v->height : 2 * v->extent / v->height;
    v->near_z = 1e-3 * (distance > 0 ? distance : 1);
}

static int view__add_object(view *v, const view_style *s, int gloss) {
    view__object *o = &v->object[v->objects];
    view__linear3(s->colour, o->colour);
    view__linear3(s->wire_colour, o->wire_colour);
    o->wire = view__clamp(s->wire, 0, 1);
    o->mapped = s->scalar != NULL, o->gloss = gloss;
    o->darken = view__clamp(s->darken, 0, 1);
    o->map = (unsigned)s->map < VIEW_MAP_COUNT ? (int)s->map : 0;
    return (int)v->objects++;
}

static float view__place(const view_style *s, int node) {
    if (!s->scalar) return 0;
    double t = s->hi > s->lo || s->hi < s->lo ? (s->scalar[node] - s->lo) / (s->hi - s->lo) : 0.5;
    if (!(s->scalar[node] - s->scalar[node] == 0)) return NAN;
    return (float)(t < 0 ? 0 : t > 1 ? 1 : t);
}

static void view__face(const double *x, const int *t, double n[3]) {
    double a[3], b[3];
    for (int i = 0; i < 3; i++) {
        a[i] = x[3 * (size_t)t[1] + (size_t)i] - x[3 * (size_t)t[0] + (size_t)i];
        b[i] = x[3 * (size_t)t[2] + (size_t)i] - x[3 * (size_t)t[0] + (size_t)i];
    }
    view__cross(a, b, n);
}

// Corner normal: the area-weighted sum of the faces around the node that are bent from this face
// by less than the crease angle. start, list: faces of each node.
static void view__corners(const double *x, const int *triangles, int count, const int *start,
                          const int *list, const double *face, double crease, float *normal) {
    double least = cos((crease < 180 ? crease : 180) * VIEW__PI / 180);
    (void)x;
    for (int t = 0; t < count; t++)
        for (int c = 0; c < 3; c++) {
            const double *f = face + 4 * (size_t)t;
            double n[3] = {f[0], f[1], f[2]};
            int node = triangles[3 * (size_t)t + (size_t)c];
            for (int k = start[node]; k < start[node + 1] && crease > 0; k++) {
                const double *g = face + 4 * (size_t)list[k];
                if (list[k] == t || view__dot(f, g) < least * f[3] * g[3]) continue;
                for (int i = 0; i < 3; i++) n[i] += g[i];
            }
            view__unit(n);
            for (int i = 0; i < 3; i++)
                normal[9 * (size_t)t + 3 * (size_t)c + (size_t)i] = (float)n[i];
        }
}

static int view__normals(const double *x, int nodes, const int *triangles, int count, double crease,
                         float *normal) {
    int *start = (int *)calloc((size_t)nodes + 2, sizeof(int));
    int *list = (int *)malloc(3 * (size_t)count * sizeof(int) + 1);
    double *face = (double *)malloc(4 * (size_t)count * sizeof(double) + 1);
    int ok = start && list && face;
    if (ok) {
        // Faces by node: counts shifted by two, so that filling leaves start[] in place.
        for (int i = 0; i < 3 * count; i++) start[triangles[i] + 2]++;
        for (int i = 0; i < nodes; i++) start[i + 2] += start[i + 1];
        for (int i = 0; i < 3 * count; i++) list[start[triangles[i] + 1]++] = i / 3;
        for (int t = 0; t < count; t++) {
            double *f = face + 4 * (size_t)t;
            view__face(x, triangles + 3 * (size_t)t, f);
            f[3] = sqrt(view__dot(f, f));
        }
        view__corners(x, triangles, count, start, list, face, crease, normal);
    }
    free(start), free(list), free(face);
    return ok;
}

int view_add_mesh(view *v, const double *x, int nodes, const int *triangles, int count,
                  const view_style *style) {
    view_style d = view_style_default();
    const view_style *s = style ? style : &d;
    if (nodes <= 0 || count <= 0 || count > INT_MAX / 9 || nodes > INT_MAX / 4)
        return nodes == 0 || count == 0;
    for (int i = 0; i < 3 * count; i++)
        if (triangles[i] < 0 || triangles[i] >= nodes) return 0;
    if (!view__reserve(v, (size_t)nodes, (size_t)count)) return 0;
    if (!view__normals(x, nodes, triangles, count, s->crease, v->normal + 9 * v->triangles)) {
        v->failed = 1;
        return 0;
    }
    int object = view__add_object(v, s, 1), base = (int)v->vertices;
    memcpy(v->x + 3 * v->vertices, x, 3 * (size_t)nodes * sizeof(double));
    for (int i = 0; i < nodes; i++) v->scalar[v->vertices + (size_t)i] = view__place(s, i);
    for (int i = 0; i < 3 * count; i++)
        v->triangle[3 * v->triangles + (size_t)i] = base + triangles[i];
    for (int t = 0; t < count; t++) v->owner[v->triangles + (size_t)t] = object;
    v->vertices += (size_t)nodes, v->triangles += (size_t)count;
    return 1;
}

// One vertex of a generated surface; returns its number.
static int view__vertex(view *v, const double p[3], float scalar) {
    memcpy(v->x + 3 * v->vertices, p, 3 * sizeof(double));
    v->scalar[v->vertices] = scalar;
    return (int)v->vertices++;
}

static void view__corner(view *v, int object, const int t[3], const double *const n[3]) {
    for (int c = 0; c < 3; c++) {
        v->triangle[3 * v->triangles + (size_t)c] = t[c];
        for (int i = 0; i < 3; i++)
            v->normal[9 * v->triangles + (size_t)(3 * c + i)] = (float)n[c][i];
    }
    v->owner[v->triangles++] = object;
}

// A ball of 6 x 12 facets, smooth.
static void view__ball(view *v, const double c[3], double r, float scalar, int object) {
    enum { ROWS = 6, COLUMNS = 12 };
    double n[(ROWS + 1) * COLUMNS][3];
    int id[(ROWS + 1) * COLUMNS];
    for (int i = 0; i < (ROWS + 1) * COLUMNS; i++) {
        double a = VIEW__PI * (i / COLUMNS) / ROWS, b = 2 * VIEW__PI * (i % COLUMNS) / COLUMNS;
        double p[3];
        n[i][0] = sin(a) * cos(b), n[i][1] = cos(a), n[i][2] = sin(a) * sin(b);
        for (int k = 0; k < 3; k++) p[k] = c[k] + r * n[i][k];
        id[i] = view__vertex(v, p, scalar);
    }
    for (int i = 0; i < ROWS; i++)
        for (int j = 0; j < COLUMNS; j++) {
            int a = i * COLUMNS + j, b = i * COLUMNS + (j + 1) % COLUMNS;
            int one[3] = {id[a], id[b], id[b + COLUMNS]},
                two[3] = {id[a], id[b + COLUMNS], id[a + COLUMNS]};
            const double *n1[3] = {n[a], n[b], n[b + COLUMNS]};
            const double *n2[3] = {n[a], n[b + COLUMNS], n[a + COLUMNS]};
            view__corner(v, object, one, n1);
            view__corner(v, object, two, n2);
        }
}

// A tube of 10 facets without ends: the balls close it.
static void view__tube(view *v, const double a[3], const double b[3], double r, const float s[2],
                       int object) {
    enum { SIDES = 10 };
    double d[3], e[3], f[3], n[SIDES][3];
    int id[SIDES][2];
    for (int i = 0; i < 3; i++) d[i] = b[i] - a[i];
    view__unit(d);
    double other[3] = {fabs(d[0]) < 0.6 ? 1.0 : 0.0, fabs(d[0]) < 0.6 ? 0.0 : 1.0, 0};
    view__cross(d, other, e);
    view__unit(e);
    view__cross(d, e, f);
    for (int j = 0; j < SIDES; j++) {
        double p[3], q[3], g = 2 * VIEW__PI * j / SIDES;
        for (int i = 0; i < 3; i++) {
            n[j][i] = cos(g) * e[i] + sin(g) * f[i];
            p[i] = a[i] + r * n[j][i], q[i] = b[i] + r * n[j][i];
        }
        id[j][0] = view__vertex(v, p, s[0]), id[j][1] = view__vertex(v, q, s[1]);
    }
    for (int j = 0; j < SIDES; j++) {
        int k = (j + 1) % SIDES, one[3] = {id[j][0], id[k][0], id[k][1]};
        int two[3] = {id[j][0], id[k][1], id[j][1]};
        const double *n1[3] = {n[j], n[k], n[k]}, *n2[3] = {n[j], n[k], n[j]};
        view__corner(v, object, one, n1);
        view__corner(v, object, two, n2);
    }
}

int view_add_points(view *v, const double *x, int nodes, const int *indices, int count,
                    double radius, const view_style *style) {
    view_style d = view_style_default();
    const view_style *s = style ? style : &d;
    if (count <= 0 || nodes <= 0) return count == 0 || nodes == 0;
    for (int i = 0; i < count; i++) {
        int node = indices ? indices[i] : i;
        if (node < 0 || node >= nodes) return 0;
    }
    if (!view__reserve(v, 84 * (size_t)count, 144 * (size_t)count)) return 0;
    double r = radius > 0 ? radius : 3 * 2 * v->extent / v->height;
    int object = view__add_object(v, s, 0);
    for (int i = 0; i < count; i++) {
        int node = indices ? indices[i] : i;
        view__ball(v, x + 3 * (size_t)node, r, view__place(s, node), object);
    }
    return 1;
}

int view_add_segments(view *v, const double *x, int nodes, const int *segments, int count,
                      double radius, const view_style *style) {
    view_style d = view_style_default();
    const view_style *s = style ? style : &d;
    if (count <= 0 || nodes <= 0) return count == 0 || nodes == 0;
    for (int i = 0; i < 2 * count; i++)
        if (segments[i] < 0 || segments[i] >= nodes) return 0;
    // A tube each and a ball at both ends: shared ends are drawn twice, which does not show.
    if (!view__reserve(v, (20 + 168) * (size_t)count, (20 + 288) * (size_t)count)) return 0;
    double r = radius > 0 ? radius : 2.0 * v->extent / v->height;
    int object = view__add_object(v, s, 0);
    for (int i = 0; i < count; i++) {
        int a = segments[2 * i], b = segments[2 * i + 1];
        float t[2] = {view__place(s, a), view__place(s, b)};
        view__tube(v, x + 3 * (size_t)a, x + 3 * (size_t)b, r, t, object);
        view__ball(v, x + 3 * (size_t)a, r, t[0], object);
        view__ball(v, x + 3 * (size_t)b, r, t[1], object);
    }
    return 1;
}

// ---------------------------------------------------------------------------------------------
// >>raster (private)
// Nearness q is 1/z (perspective) or -z (orthographic): affine on the screen, so the ground is
// three numbers. Vertices are snapped to 1/256 pixel and edge functions formed exactly in double;
// two triangles that share an edge get values that differ in sign only, also after rounding to
// float, and the top-left rule gives a sample on the edge to one of them: no cracks.
// ---------------------------------------------------------------------------------------------

static void view__project(const view *v, const double p[3], double *x, double *y, double *q) {
    double s = v->camera.fov > 0 ? 1 / (p[2] * v->scale) : 1 / v->scale;
    *x = 0.5 * v->width + p[0] * s;
    *y = 0.5 * v->height - p[1] * s;
    *q = v->camera.fov > 0 ? 1 / p[2] : -p[2];
}

static int view__clip_plane(double (*poly)[3], int n, const double plane[3], double at) {
    double out[16][3];
    int m = 0;
    for (int i = 0; i < n && m < 14; i++) {
        const double *a = poly[i], *b = poly[(i + 1) % n];
        double da = view__dot(a, plane) - at, db = view__dot(b, plane) - at;
        if (da >= 0) memcpy(out[m++], a, sizeof out[0]);
        if ((da >= 0) != (db >= 0)) {
            for (int k = 0; k < 3; k++) out[m][k] = a[k] + da / (da - db) * (b[k] - a[k]);
            m++;
        }
    }
    memcpy(poly, out, (size_t)m * sizeof out[0]);
    return m;
}

// Cuts a triangle to what is before the camera and, if it reaches far beyond the picture, to three
// pictures' width: so that snapped coordinates stay small enough for exact edge functions.
static int view__clip(const view *v, double (*poly)[3]) {
    double nearest[3] = {0, 0, 1};
    int n = 3, far_out = 0, perspective = v->camera.fov > 0;
    if (perspective) n = view__clip_plane(poly, n, nearest, v->near_z);
    for (int i = 0; i < n; i++) {
        double x, y, q;
        view__project(v, poly[i], &x, &y, &q);
        far_out |= !(fabs(x) < 16000 && fabs(y) < 16000);
    }
    for (int k = 0; k < 4 && far_out && n > 0; k++) {
        double half = 1.5 * v->scale * (k < 2 ? v->width : v->height), plane[3] = {0, 0, 0};
        plane[k / 2] = k & 1 ? 1 : -1;
        if (perspective) plane[2] = half;
        n = view__clip_plane(poly, n, plane, perspective ? 0 : -half);
    }
    return n;
}

static void view__emit(view *v, double (*poly)[3], int n, int id) {
    for (int k = 1; k + 1 < n; k++) {
        int corner[3] = {0, k, k + 1};
        view__screen *s = &v->screen[v->screens];
        double least = DBL_MAX, most = -DBL_MAX;
        for (int c = 0; c < 3; c++) {
            double x, y;
            view__project(v, poly[corner[c]], &x, &y, &s->q[c]);
            s->x[c] = floor(256 * x + 0.5) / 256, s->y[c] = floor(256 * y + 0.5) / 256;
            least = fmin(least, s->y[c]), most = fmax(most, s->y[c]);
        }
        if (most < 0 || least > v->height) continue;
        s->id = id, s->y0 = least < 0 ? 0 : (int)least;
        s->y1 = most > v->height - 1 ? v->height - 1 : (int)most;
        v->screens++;
    }
}

static int view__transform(view *v) {
    if (!view__grow(v, &v->p, &v->p_cap, v->vertices, 3 * sizeof(double))) return 0;
    for (size_t i = 0; i < v->vertices; i++) {
        double d[3];
        for (size_t k = 0; k < 3; k++) d[k] = v->x[3 * i + k] - v->camera.eye[k];
        v->p[3 * i] = view__dot(d, v->right);
        v->p[3 * i + 1] = view__dot(d, v->up);
        v->p[3 * i + 2] = view__dot(d, v->forward);
    }
    v->screens = 0;
    for (size_t t = 0; t < v->triangles; t++) {
        double poly[16][3], sum = 0;
        for (size_t c = 0; c < 3; c++) {
            memcpy(poly[c], v->p + 3 * (size_t)v->triangle[3 * t + c], sizeof poly[0]);
            sum += poly[c][0] + poly[c][1] + poly[c][2];
        }
        if (!(sum - sum == 0)) continue;
        if (!view__grow(v, &v->screen, &v->screen_cap, v->screens + 16, sizeof(view__screen)))
            return 0;
        view__emit(v, poly, view__clip(v, poly), (int)t);
    }
    return 1;
}

// Edge functions and nearness of one triangle: value at the origin, slopes; turned so that the
// inside is positive. Returns 0 when it covers nothing.
typedef struct view__edges {
    double a[4], b[4], c[4];  // three edges, then nearness
    float limit[3], q_lo, q_hi;
} view__edges;

static int view__edge_setup(const view__screen *s, view__edges *e) {
    double area =
        (s->x[1] - s->x[0]) * (s->y[2] - s->y[0]) - (s->x[2] - s->x[0]) * (s->y[1] - s->y[0]);
    if (area == 0) return 0;
    double turn = area > 0 ? 1 : -1;
    for (int i = 0; i < 3; i++) {
        int j = (i + 1) % 3, k = (i + 2) % 3;
        e->a[i] = turn * (s->y[j] - s->y[k]), e->b[i] = turn * (s->x[k] - s->x[j]);
        e->c[i] = -(e->a[i] * s->x[j] + e->b[i] * s->y[j]);
        // Top-left rule: a sample exactly on such an edge is inside.
        int own = e->a[i] > 0 || (e->a[i] == 0 && e->b[i] > 0);
        e->limit[i] = own ? -1e-30f : 0;
    }
    e->a[3] = e->b[3] = e->c[3] = 0;
    for (int i = 0; i < 3; i++) {
        double w = s->q[i] / fabs(area);
        e->a[3] += w * e->a[i], e->b[3] += w * e->b[i], e->c[3] += w * e->c[i];
    }
    e->q_lo = (float)fmin(s->q[0], fmin(s->q[1], s->q[2]));
    e->q_hi = (float)fmax(s->q[0], fmax(s->q[1], s->q[2]));
    return 1;
}

// The columns that row y can touch: from each edge, with a pixel to spare.
static void view__span(const view__edges *e, int y, int width, int *x0, int *x1) {
    double lo = 0, hi = width - 1;
    for (int i = 0; i < 3; i++) {
        double most = e->c[i] + fmax(e->b[i] * y, e->b[i] * (y + 1));
        if (e->a[i] > 0)
            lo = fmax(lo, -most / e->a[i] - 1);
        else if (e->a[i] < 0)
            hi = fmin(hi, -most / e->a[i]);
        else if (most < 0)
            hi = -1;
    }
    *x0 = lo > width ? width : (int)lo;
    *x1 = hi < 0 ? -1 : (int)hi;
}

static void view__raster(view *v, const view__screen *s, int y0, int y1) {
    view__edges e;
    float d[4][VIEW__SAMPLES];
    if (!view__edge_setup(s, &e)) return;
    for (int i = 0; i < 4; i++)
        for (int k = 0; k < VIEW__SAMPLES; k++)
            d[i][k] =
                (float)(e.a[i] * (double)view__sample[k][0] + e.b[i] * (double)view__sample[k][1]);
    for (int y = y0; y <= y1; y++) {
        int x0, x1;
        view__span(&e, y, v->width, &x0, &x1);
        for (int x = x0; x <= x1; x++) {
            size_t at = ((size_t)y * (size_t)v->width + (size_t)x) * VIEW__SAMPLES;
            float *q = v->q + at, f[4];
            int *id = v->id + at;
            for (int i = 0; i < 4; i++)
                f[i] = (float)(e.a[i] * (x + 0.5) + e.b[i] * (y + 0.5) + e.c[i]);
            for (int k = 0; k < VIEW__SAMPLES; k++) {
                float z = f[3] + d[3][k];
                z = z < e.q_lo ? e.q_lo : z;
                z = z > e.q_hi ? e.q_hi : z;
                int in = (f[0] + d[0][k] > e.limit[0]) & (f[1] + d[1][k] > e.limit[1]) &
                         (f[2] + d[2][k] > e.limit[2]) & (z > q[k]);
                q[k] = in ? z : q[k];
                id[k] = in ? s->id : id[k];
            }
        }
    }
}

// Fills a band with the background and the ground.
static void view__clear(view *v, int y0, int y1) {
    for (int y = y0; y <= y1; y++)
        for (int x = 0; x < v->width; x++) {
            size_t at = ((size_t)y * (size_t)v->width + (size_t)x) * VIEW__SAMPLES;
            for (size_t k = 0; k < VIEW__SAMPLES; k++) {
                double q = v->ground_q[0] * (x + 0.5 + (double)view__sample[k][0]) +
                           v->ground_q[1] * (y + 0.5 + (double)view__sample[k][1]) + v->ground_q[2];
                int hit = v->ground && (q > 0 || !(v->camera.fov > 0));
                // In 2D the ground is paper: behind everything.
                v->q[at + k] = hit && !v->look.flat ? (float)q : -FLT_MAX;
                v->id[at + k] = hit ? VIEW__GROUND : VIEW__NONE;
            }
        }
}

static void view__visible_band(view *v, int band) {
    int y0 = band * VIEW__BAND, y1 = y0 + VIEW__BAND - 1;
    if (y1 > v->height - 1) y1 = v->height - 1;
    view__clear(v, y0, y1);
    for (size_t i = 0; i < v->screens; i++) {
        const view__screen *s = &v->screen[i];
        if (s->y1 < y0 || s->y0 > y1) continue;
        view__raster(v, s, s->y0 > y0 ? s->y0 : y0, s->y1 < y1 ? s->y1 : y1);
    }
}

// ---------------------------------------------------------------------------------------------
// >>surface (private)
// From a pixel and a triangle to the point seen: the ray meets the triangle's plane.
// ---------------------------------------------------------------------------------------------

static void view__ray(const view *v, float px, float py, float o[3], float d[3]) {
    float x = (px - 0.5f * (float)v->width) * (float)v->scale;
    float y = (0.5f * (float)v->height - py) * (float)v->scale;
    int perspective = v->camera.fov > 0;
    o[0] = perspective ? 0 : x, o[1] = perspective ? 0 : y, o[2] = 0;
    d[0] = perspective ? x : 0, d[1] = perspective ? y : 0, d[2] = 1;
}

static void view__along(const view *v, float px, float py, float z, float p[3]) {
    float o[3], d[3];
    view__ray(v, px, py, o, d);
    for (int i = 0; i < 3; i++) p[i] = o[i] + z * d[i];
}

// Point p, unit facet normal n toward the eye, barycentrics (clamped into the triangle, since the
// centre of a pixel may lie outside one that covers some of its samples).
static void view__hit(const view *v, int id, float px, float py, float p[3], float n[3],
                      float bary[3]) {
    float o[3], d[3];
    double e1[3], e2[3], g[3], r[3], w[3], od[3], dd[3];
    const int *t = v->triangle + 3 * (size_t)id;
    const double *a = v->p + 3 * (size_t)t[0], *b = v->p + 3 * (size_t)t[1],
                 *c = v->p + 3 * (size_t)t[2];
    view__ray(v, px, py, o, d);
    for (int i = 0; i < 3; i++)
        od[i] = (double)o[i], dd[i] = (double)d[i], e1[i] = b[i] - a[i], e2[i] = c[i] - a[i],
        r[i] = od[i] - a[i];
    view__cross(e1, e2, g);
    double den = view__dot(g, dd), gg = view__dot(g, g);
    // Seen edge on: any point of it will do.
    double s = fabs(den) > 1e-12 * sqrt(gg * view__dot(dd, dd)) ? -view__dot(g, r) / den : a[2];
    for (int i = 0; i < 3; i++) r[i] += s * dd[i];
    view__cross(r, e2, w);
    double u = gg > 0 ? view__dot(w, g) / gg : 0;
    view__cross(e1, r, w);
    double x = gg > 0 ? view__dot(w, g) / gg : 0;
    double k[3] = {1 - u - x, u, x}, sum = 0;
    for (int i = 0; i < 3; i++) sum += k[i] = k[i] > 0 ? k[i] : 0;
    for (int i = 0; i < 3; i++) {
        bary[i] = sum > 0 ? (float)(k[i] / sum) : 1.0f / 3;
        n[i] = gg > 0 ? (float)(g[i] / sqrt(gg) * (den > 0 ? -1 : 1)) : 0;
    }
    for (int i = 0; i < 3; i++)
        p[i] = bary[0] * (float)a[i] + bary[1] * (float)b[i] + bary[2] * (float)c[i];
}

static void view__ground_at(const view *v, float px, float py, float p[3]) {
    double q = v->ground_q[0] * (double)px + v->ground_q[1] * (double)py + v->ground_q[2];
    int perspective = v->camera.fov > 0;
    double z = perspective ? 1 / (q > 1e-30 ? q : 1e-30) : -q;
    view__along(v, px, py, (float)z, p);
}

// Distance along the ground from below the camera's target, in half heights of the picture.
static float view__far_out(const view *v, const float p[3]) {
    float d[3] = {p[0] - v->centre[0], p[1] - v->centre[1], p[2] - v->centre[2]};
    float up = view__dotf(d, v->ground_n), rest = view__dotf(d, d) - up * up;
    return sqrtf(rest > 0 ? rest : 0) / (float)v->extent;
}

static void view__ground_setup(view *v) {
    double axis[3] = {0, 0, 0}, u[3] = {0, 0, 0}, w[3] = {0, 0, 0};
    int k = (int)v->look.up, perspective = v->camera.fov > 0;
    axis[k] = 1, u[(k + 1) % 3] = 1, w[(k + 2) % 3] = 1;
    view__turn(v, axis, v->above);
    view__turn(v, axis, v->ground_n);
    view__turn(v, u, v->ground_u);
    view__turn(v, w, v->ground_v);
    double d = v->look.ground_height - v->camera.eye[k], s = v->scale;
    double n0 = (double)v->ground_n[0] * s, n1 = (double)v->ground_n[1] * s,
           n2 = (double)v->ground_n[2];
    double by = perspective ? d : n2;
    v->ground_d = (float)d;
    // From below, or seen edge on, there is no ground.
    v->ground = v->look.ground && d < 0 && fabs(by) > 1e-9 * v->extent;
    if (!perspective && v->ground) v->ground = n2 < -1e-6;
    if (v->ground) {
        double end = perspective ? n2 : -d;
        v->ground_q[0] = n0 / by, v->ground_q[1] = -n1 / by;
        v->ground_q[2] = (-0.5 * n0 * v->width + 0.5 * n1 * v->height + end) / by;
    }
    v->ground_o[0] = (float)v->camera.eye[(k + 1) % 3],
    v->ground_o[1] = (float)v->camera.eye[(k + 2) % 3];
    double step = v->look.grid > 0 ? v->look.grid : view__nice(v->extent / 6);
    v->grid = v->look.grid < 0 ? 0 : (float)step;
    double at[3];
    for (int i = 0; i < 3; i++) at[i] = v->camera.at[i] - v->camera.eye[i];
    view__turn(v, at, v->centre);
    view__linear3(v->look.top, v->top);
    view__linear3(v->look.bottom, v->bottom);
}

// ---------------------------------------------------------------------------------------------
// >>shadow (private)
// A map of the highest surface along the light, over a square that holds all that is drawn (or,
// of a very large scene, what is near the camera's target).
// ---------------------------------------------------------------------------------------------

static void view__direction(const view *v, double azimuth, double elevation, double out[3]) {
    double axis[3] = {0, 0, 0}, back[3], side[3], dir[3];
    double a = azimuth * VIEW__PI / 180, e = elevation * VIEW__PI / 180;
    axis[(int)v->look.up] = 1;
    for (int i = 0; i < 3; i++) back[i] = -v->forward[i];
    double h = view__dot(back, axis);
    if (fabs(h) > 0.999)
        for (int i = 0; i < 3; i++) back[i] = -v->up[i];
    h = view__dot(back, axis);
    for (int i = 0; i < 3; i++) back[i] -= h * axis[i];
    view__unit(back);
    for (int i = 0; i < 3; i++) side[i] = v->right[i];
    for (int i = 0; i < 3; i++)
        dir[i] = cos(e) * (cos(a) * back[i] + sin(a) * side[i]) + sin(e) * axis[i];
    view__unit(dir);
    out[0] = view__dot(dir, v->right), out[1] = view__dot(dir, v->up),
    out[2] = view__dot(dir, v->forward);
}

static void view__lights(view *v) {
    double f[3], lo[3] = {DBL_MAX, DBL_MAX, DBL_MAX}, hi[3] = {-DBL_MAX, -DBL_MAX, -DBL_MAX};
    view__direction(v, v->look.light_azimuth, v->look.light_elevation, v->light_w);
    view__direction(v, v->look.light_azimuth + 115, 18, f);
    for (int i = 0; i < 3; i++) v->light[i] = (float)v->light_w[i], v->fill[i] = (float)f[i];
    double other[3] = {fabs(v->light_w[0]) < 0.6 ? 1.0 : 0.0, fabs(v->light_w[0]) < 0.6 ? 0.0 : 1.0,
                       0};
    view__cross(v->light_w, other, v->light_u);
    view__unit(v->light_u);
    view__cross(v->light_w, v->light_u, v->light_v);
    view_box_add(lo, hi, v->p, (int)v->vertices);
    double r = 0;
    for (int i = 0; i < 3; i++) {
        double half = lo[i] <= hi[i] ? 0.5 * (hi[i] - lo[i]) : 0.5;
        v->light_o[i] = lo[i] <= hi[i] ? 0.5 * (hi[i] + lo[i]) : 0;
        r += half * half;
    }
    v->light_r = 1.02 * sqrt(r) + 1e-9 * v->extent;
    if (v->light_r > 4 * v->extent) {
        v->light_r = 4 * v->extent;
        for (int i = 0; i < 3; i++) v->light_o[i] = (double)v->centre[i];
    }
}

static void view__to_map(const view *v, const double p[3], double m[3]) {
    double d[3], s = 0.5 * VIEW__SHADOW / v->light_r;
    for (int i = 0; i < 3; i++) d[i] = p[i] - v->light_o[i];
    m[0] = 0.5 * VIEW__SHADOW + s * view__dot(d, v->light_u);
    m[1] = 0.5 * VIEW__SHADOW + s * view__dot(d, v->light_v);
    m[2] = view__dot(d, v->light_w);
}

// Highest of the map and one triangle, in the rows y0..y1 of the map.
static void view__shadow_triangle(view *v, double (*m)[3], int y0, int y1) {
    double ax = m[1][0] - m[0][0], ay = m[1][1] - m[0][1], bx = m[2][0] - m[0][0],
           by = m[2][1] - m[0][1];
    double area = ax * by - ay * bx;
    double low = fmin(m[0][1], fmin(m[1][1], m[2][1])),
           high = fmax(m[0][1], fmax(m[1][1], m[2][1]));
    if (!(fabs(area) > 1e-12) || high < y0 || low > y1 + 1) return;
    if (low > y0) y0 = (int)low;
    if (high < y1) y1 = (int)high;
    for (int y = y0; y <= y1; y++) {
        double lo = DBL_MAX, hi = -DBL_MAX, at = y + 0.5;
        for (int i = 0; i < 3; i++) {
            const double *p = m[i], *q = m[(i + 1) % 3];
            if ((p[1] <= at) == (q[1] <= at)) continue;
            double x = p[0] + (at - p[1]) / (q[1] - p[1]) * (q[0] - p[0]);
            lo = fmin(lo, x), hi = fmax(hi, x);
        }
        int x0 = lo > VIEW__SHADOW ? VIEW__SHADOW : lo < 0 ? 0 : (int)ceil(lo - 0.5);
        int x1 = hi < 0 ? -1 : hi > VIEW__SHADOW ? VIEW__SHADOW - 1 : (int)floor(hi - 0.5);
        for (int x = x0; x <= x1 && x < VIEW__SHADOW; x++) {
            double u = ((x + 0.5 - m[0][0]) * by - (at - m[0][1]) * bx) / area;
            double w = (ax * (at - m[0][1]) - ay * (x + 0.5 - m[0][0])) / area;
            float h = (float)(m[0][2] + u * (m[1][2] - m[0][2]) + w * (m[2][2] - m[0][2]));
            float *to = &v->shadow[(size_t)y * VIEW__SHADOW + (size_t)x];
            if (h > *to) *to = h;
        }
    }
}

static void view__coarse_row(view *v, int row) {
    int cell = VIEW__SHADOW / VIEW__COARSE;
    for (int x = 0; x < VIEW__COARSE; x++) {
        float most = -FLT_MAX;
        for (int j = row * cell; j < (row + 1) * cell; j++)
            for (int k = x * cell; k < (x + 1) * cell; k++) {
                float h = v->shadow[(size_t)j * VIEW__SHADOW + (size_t)k];
                most = h > most ? h : most;
            }
        v->coarse[row * VIEW__COARSE + x] = most;
    }
}

static void view__shadow_band(view *v, int band) {
    int rows = VIEW__SHADOW / VIEW__LIGHT_BANDS, y0 = band * rows, y1 = y0 + rows - 1;
    for (size_t i = (size_t)y0 * VIEW__SHADOW; i < (size_t)(y1 + 1) * VIEW__SHADOW; i++)
        v->shadow[i] = -FLT_MAX;
    for (size_t i = 0; i < v->triangles; i++) {
        double m[3][3];
        const int *t = v->triangle + 3 * i;
        double a = v->m[3 * (size_t)t[0] + 1], b = v->m[3 * (size_t)t[1] + 1],
               c = v->m[3 * (size_t)t[2] + 1];
        if ((a < y0 && b < y0 && c < y0) || (a > y1 + 1 && b > y1 + 1 && c > y1 + 1)) continue;
        for (size_t k = 0; k < 3; k++) memcpy(m[k], v->m + 3 * (size_t)t[k], sizeof m[0]);
        view__shadow_triangle(v, m, y0, y1);
    }
    int cells = VIEW__COARSE / VIEW__LIGHT_BANDS;
    for (int row = band * cells; row < (band + 1) * cells; row++) view__coarse_row(v, row);
}

// Highest of each cell and its neighbours: a fragment above it all is lit without looking further.
static void view__coarse_spread(view *v) {
    int n = VIEW__COARSE;
    float *out = v->coarse + n * n;
    for (int i = 0; i < n * n; i++) {
        int x = i % n, y = i / n;
        out[i] = v->coarse[i];
        for (int j = y > 0 ? y - 1 : 0; j <= y + 1 && j < n; j++)
            for (int k = x > 0 ? x - 1 : 0; k <= x + 1 && k < n; k++)
                if (v->coarse[j * n + k] > out[i]) out[i] = v->coarse[j * n + k];
    }
}

static int view__lights_on(view *v) {
    view__lights(v);
    if (!view__grow(v, &v->m, &v->m_cap, v->vertices, 3 * sizeof(double))) return 0;
    for (size_t i = 0; i < v->vertices; i++) view__to_map(v, v->p + 3 * i, v->m + 3 * i);
    view__bands(v, view__shadow_band, VIEW__LIGHT_BANDS);
    view__coarse_spread(v);
    return 1;
}

// Share of a disk of taps, turned by the pixel's place in the pattern, that the light reaches. The
// disk is as wide as the sun's disk seen past the mean blocker, and lies in the surface's plane
// (gu, gv: rise of that plane a texel), so that a slope does not shade itself.
static float view__shadow_at(const view *v, const float p[3], const float n[3], int pattern) {
    double pd[3], m[3];
    float nl = view__dotf(n, v->light);
    if (nl <= 0) return 0;
    float texel = (float)(2 * v->light_r / VIEW__SHADOW);
    for (int i = 0; i < 3; i++) pd[i] = (double)(p[i] + 1.2f * texel * n[i]);
    view__to_map(v, pd, m);
    if (!(m[0] >= 1 && m[1] >= 1 && m[0] < VIEW__SHADOW - 1 && m[1] < VIEW__SHADOW - 1)) return 1;
    int cell = VIEW__SHADOW / VIEW__COARSE;
    float top =
        v->coarse[VIEW__COARSE * VIEW__COARSE + (int)m[1] / cell * VIEW__COARSE + (int)m[0] / cell];
    float h0 = (float)m[2], bias = 0.5f * texel;
    if (top <= h0 + bias) return 1;
    double nd[3] = {(double)n[0], (double)n[1], (double)n[2]};
    // The slope is cut where the light grazes: there the cosine makes the surface dark anyway.
    float steep = 1 / (nl > 0.2f ? nl : 0.2f);
    float gu = -(float)view__dot(nd, v->light_u) * steep * texel;
    float gv = -(float)view__dot(nd, v->light_v) * steep * texel;
    // First where light may be blocked (searching as wide as the highest thing could shade) ...
    float soft = 0.075f, reach = soft * (top - h0) / texel, most = 0.9f * (float)cell;
    reach = view__clamp(reach, 2, most);
    float blockers = 0, rise = 0, lit = 0;
    for (int pass = 0; pass < 2; pass++) {
        for (int i = 0; i < VIEW__TAPS; i++) {
            float du = reach * v->tap[pattern][i][0], dv = reach * v->tap[pattern][i][1];
            int x = (int)((float)m[0] + du), y = (int)((float)m[1] + dv);
            if (x < 0 || y < 0 || x >= VIEW__SHADOW || y >= VIEW__SHADOW) {
                lit += (float)pass;
                continue;
            }
            float over =
                v->shadow[(size_t)y * VIEW__SHADOW + (size_t)x] - (h0 + gu * du + gv * dv) - bias;
            if (pass == 0 && over > 0) blockers++, rise += over;
            if (pass == 1 && over <= 0) lit++;
        }
        if (pass == 0 && blockers == 0) return 1;
        // ... then as wide as the blockers found there make the penumbra.
        if (pass == 0) reach = view__clamp(soft * (rise / blockers) / texel, 1.6f, most);
    }
    return lit / VIEW__TAPS;
}

// ---------------------------------------------------------------------------------------------
// >>gather (private)
// One surface point a pixel with its light, then a filter that uses only like surfaces. The
// sampling pattern repeats every 4 pixels and the filter is 4 wide: it sees each pattern once.
// ---------------------------------------------------------------------------------------------

// Taps of a sunflower disk, turned and stretched 16 ways.
static void view__patterns(view *v) {
    static const int order[16] = {0, 8, 2, 10, 12, 4, 14, 6, 3, 11, 1, 9, 15, 7, 13, 5};
    for (int k = 0; k < 16; k++)
        for (int i = 0; i < VIEW__TAPS; i++) {
            double turn = 2 * VIEW__PI * order[k] / 16, shift = (order[(k + 5) % 16] + 0.5) / 16;
            double r = sqrt((i + shift) / VIEW__TAPS), a = 2.399963229728653 * i + turn;
            v->tap[k][i][0] = (float)(r * cos(a)), v->tap[k][i][1] = (float)(r * sin(a));
        }
}

// Flags of a tile.
#define VIEW__OBJECT 1  // sees a triangle
#define VIEW__NEAR 2    // has such a tile within the reach of occlusion
#define VIEW__PLAIN 4   // every pixel is fully lit and open

static void view__surface_pixel(view *v, int x, int y) {
    size_t at = (size_t)y * (size_t)v->width + (size_t)x;
    view__pixel *out = &v->pixel[at];
    int id = v->id[at * VIEW__SAMPLES];
    float bary[3], px = (float)x + 0.5f, py = (float)y + 0.5f;
    out->lit = out->open = 1, out->p[2] = -1;
    if (id == VIEW__GROUND) {
        view__ground_at(v, px, py, out->p);
        memcpy(out->n, v->ground_n, sizeof out->n);
        if (view__far_out(v, out->p) > 6) out->p[2] = -1;
    } else if (id != VIEW__NONE) {
        view__hit(v, id, px, py, out->p, out->n, bary);
        v->tile[y / VIEW__TILE * v->tiles_x + x / VIEW__TILE] = VIEW__OBJECT;
    }
}

static void view__surface_band(view *v, int band) {
    int y0 = band * VIEW__BAND, y1 = y0 + VIEW__BAND < v->height ? y0 + VIEW__BAND : v->height;
    for (int y = y0; y < y1; y++)
        for (int x = 0; x < v->width; x++) view__surface_pixel(v, x, y);
}

// Marks what may be occluded: plain ground never occludes plain ground.
static void view__tiles_near(view *v) {
    int reach = (int)(VIEW__REACH * (float)v->height) / VIEW__TILE + 1;
    for (int y = 0; y < v->tiles_y; y++)
        for (int x = 0; x < v->tiles_x; x++) {
            if (!(v->tile[y * v->tiles_x + x] & VIEW__OBJECT)) continue;
            for (int j = y > reach ? y - reach : 0; j <= y + reach && j < v->tiles_y; j++)
                for (int i = x > reach ? x - reach : 0; i <= x + reach && i < v->tiles_x; i++)
                    v->tile[j * v->tiles_x + i] |= VIEW__NEAR;
        }
}

// Scalable ambient obscurance (McGuire, Mara, Luebke 2012), its radius r in world units.
static float view__open_at(const view *v, const view__pixel *at, int x, int y, int pattern) {
    float r = (float)(0.16 * v->extent), scale = (float)v->scale;
    float reach = r / (v->camera.fov > 0 ? scale * at->p[2] : scale);
    float most = VIEW__REACH * (float)v->height;
    if (reach < 1) return 1;
    if (reach > most) reach = most;
    float sum = 0, r2 = r * r, bias = 0.02f * r, fx = (float)x + 0.5f, fy = (float)y + 0.5f;
    for (int i = 0; i < VIEW__TAPS; i++) {
        float tx = fx + reach * v->tap[pattern][i][0], ty = fy + reach * v->tap[pattern][i][1];
        if (tx < 0 || ty < 0 || tx >= (float)v->width || ty >= (float)v->height) continue;
        const view__pixel *s = &v->pixel[(size_t)(int)ty * (size_t)v->width + (size_t)(int)tx];
        float q[3] = {s->p[0] - at->p[0], s->p[1] - at->p[1], s->p[2] - at->p[2]};
        float vv = view__dotf(q, q), vn = view__dotf(q, at->n) - bias, f = r2 - vv;
        if (f > 0 && vn > 0 && s->p[2] >= 0) sum += f * f * f * vn / (vv + 0.01f * r2);
    }
    float open = 1 - 3.0f * sum * r / (r2 * r2 * r2 * VIEW__TAPS);
    return open > 0 ? open : 0;
}

// Returns whether the pixel is fully lit and open.
static int view__light_pixel(view *v, int x, int y, int near_by) {
    view__pixel *s = &v->pixel[(size_t)y * (size_t)v->width + (size_t)x];
    int pattern = (x & 3) + 4 * (y & 3);
    if (s->p[2] < 0) return 1;
    if (v->look.shadow > 0) s->lit = view__shadow_at(v, s->p, s->n, pattern);
    if (v->look.occlusion > 0 && near_by) s->open = view__open_at(v, s, x, y, pattern);
    return s->lit == 1 && s->open == 1;
}

static void view__light_band(view *v, int band) {
    int y0 = band * VIEW__BAND, y1 = y0 + VIEW__BAND < v->height ? y0 + VIEW__BAND : v->height;
    for (int ty = y0; ty < y1; ty += VIEW__TILE)
        for (int tx = 0; tx < v->width; tx += VIEW__TILE) {
            unsigned char *tile = &v->tile[ty / VIEW__TILE * v->tiles_x + tx / VIEW__TILE];
            int plain = 1;
            for (int y = ty; y < ty + VIEW__TILE && y < y1; y++)
                for (int x = tx; x < tx + VIEW__TILE && x < v->width; x++)
                    plain &= view__light_pixel(v, x, y, *tile & VIEW__NEAR);
            if (plain) *tile |= VIEW__PLAIN;
        }
}

// Are all pixels that the filter around x, y can see fully lit and open?
static int view__plain(const view *v, int x0, int y0, int x1, int y1) {
    int a = x0 / VIEW__TILE, b = x1 / VIEW__TILE, c = y0 / VIEW__TILE * v->tiles_x,
        d = y1 / VIEW__TILE * v->tiles_x;
    return v->tile[c + a] & v->tile[c + b] & v->tile[d + a] & v->tile[d + b] & VIEW__PLAIN;
}

// Light at a fragment: the mean over the 4 x 4 pixels around whose points lie in its plane and
// face its way. A fragment that no pixel's centre sees takes a plain mean.
static void view__gather(const view *v, int x, int y, const float p[3], const float n[3],
                         float *lit, float *open) {
    float sum = 0, a = 0, b = 0, sa = 0, sb = 0, count = 0;
    float per = 1 / (4 * (float)v->scale * (v->camera.fov > 0 ? p[2] : 1));
    int x0 = x > 0 ? x - 1 : 0, x1 = x + 2 < v->width ? x + 2 : v->width - 1;
    int y0 = y > 0 ? y - 1 : 0, y1 = y + 2 < v->height ? y + 2 : v->height - 1;
    *lit = *open = 1;
    if (view__plain(v, x0, y0, x1, y1)) return;
    for (int j = y0; j <= y1; j++)
        for (int i = x0; i <= x1; i++) {
            const view__pixel *s = &v->pixel[(size_t)j * (size_t)v->width + (size_t)i];
            if (s->p[2] < 0) continue;
            float q[3] = {s->p[0] - p[0], s->p[1] - p[1], s->p[2] - p[2]};
            float off = fabsf(view__dotf(q, n)) * per, face = view__dotf(n, s->n);
            sa += s->lit, sb += s->open, count++;
            if (off >= 1 || face <= 0.5f) continue;
            float w = (1 - off) * (face - 0.5f);
            sum += w, a += w * s->lit, b += w * s->open;
        }
    if (sum > 1e-4f)
        *lit = a / sum, *open = b / sum;
    else if (count > 0)
        *lit = sa / count, *open = sb / count;
}

// ---------------------------------------------------------------------------------------------
// >>shade (private)
// Diffuse from a warm key, a cool fill and a sky that is lighter above; a small highlight. A
// shoulder above 0.75 keeps bright parts from clipping.
// ---------------------------------------------------------------------------------------------

static void view__background(const view *v, float y, float c[3]) {
    float t = view__smooth(0, 1, y / (float)v->height);
    for (int i = 0; i < 3; i++) c[i] = v->top[i] + t * (v->bottom[i] - v->top[i]);
}

// libm's floor is a call where the processor is not known to round by itself.
static float view__floor(float x) {
    if (!(fabsf(x) < 1e9f)) return x;
    float t = (float)(int)x;
    return t > x ? t - 1 : t;
}

// Share of the interval of width f around t covered by lines of width w at the integers.
static float view__line(float t, float w, float f) {
    float a = t + 0.5f * f + 0.5f * w, b = t - 0.5f * f + 0.5f * w;
    float fa = view__floor(a), fb = view__floor(b);
    float in_a = a - fa < w ? a - fa : w, in_b = b - fb < w ? b - fb : w;
    return (fa * w + in_a - fb * w - in_b) / f;
}

static float view__grid(const view *v, float px, float py, const float p[3]) {
    float here[3][2], q[3];
    if (!(v->grid > 0)) return 0;
    for (int k = 0; k < 3; k++) {
        if (k == 0)
            memcpy(q, p, sizeof q);
        else
            view__ground_at(v, px + (k == 1 ? 1.0f : 0.0f), py + (k == 2 ? 1.0f : 0.0f), q);
        here[k][0] = (view__dotf(q, v->ground_u) + v->ground_o[0]) / v->grid;
        here[k][1] = (view__dotf(q, v->ground_v) + v->ground_o[1]) / v->grid;
    }
    float gone = 1;
    for (int i = 0; i < 2; i++) {
        float f = fabsf(here[1][i] - here[0][i]) + fabsf(here[2][i] - here[0][i]);
        f = view__clamp(f, 1e-5f, 1e3f);
        float w = f > 0.012f ? fminf(f, 0.05f) : 0.012f;
        gone *= 1 - view__line(here[0][i], w, f) * view__smooth(0.7f, 0.15f, f);
    }
    return 1 - gone;
}

// The ground is the background, darkened by the share of light that does not reach it: no horizon.
static void view__shade_ground(const view *v, int x, int y, float px, float py, float c[3]) {
    float p[3], lit = 1, open = 1;
    view__ground_at(v, px, py, p);
    view__background(v, py, c);
    float far_out = view__far_out(v, p);
    float near_by = 1 - view__smooth(1.6f, v->look.flat ? 50.0f : 6.0f, far_out);
    if (near_by <= 0) return;
    if (!v->look.flat) view__gather(v, x, y, p, v->ground_n, &lit, &open);
    float shadow = (float)v->look.shadow * (1 - lit),
          closed = (float)v->look.occlusion * (1 - open);
    float key = 0.62f * (1 - shadow), rest = 0.38f * (1 - 0.9f * closed);
    float pool = v->look.flat ? 0.0f : 0.05f * (1 - view__smooth(0, 3, far_out));
    float line = 1 - (v->look.flat ? 0.13f : 0.16f) * near_by * view__grid(v, px, py, p);
    float tint[3] = {1.03f, 1.0f, 0.955f}, cool[3] = {0.94f, 1.0f, 1.09f};
    for (int i = 0; i < 3; i++) {
        float light = v->look.flat
                          ? 1
                          : (key * tint[i] + rest * cool[i]) / (0.62f * tint[i] + 0.38f * cool[i]);
        c[i] *= (1 + near_by * (light - 1)) * line * (1 + pool);
    }
}

static void view__albedo(const view *v, const view__object *o, const int *t, const float bary[3],
                         float c[3]) {
    memcpy(c, o->colour, 3 * sizeof(float));
    if (!o->mapped) return;
    float s = 0;
    for (int i = 0; i < 3; i++) s += bary[i] * v->scalar[t[i]];
    if (!(s >= 0 && s <= 1.001f)) {
        c[0] = c[1] = c[2] = 0.32f;
        return;
    }
    for (int i = 0; i < 3 && o->darken > 0; i++) c[i] *= 1 - o->darken * (s < 1 ? s : 1);
    if (o->darken > 0) return;
    float f = 256 * (s < 1 ? s : 1);
    int k = f < 255 ? (int)f : 255;
    for (int i = 0; i < 3; i++)
        c[i] = v->lut[o->map][k][i] +
               (f - (float)k) * (v->lut[o->map][k + 1][i] - v->lut[o->map][k][i]);
}

// How much of the pixel the triangle's edges cover: distance on the screen to each edge. Lines get
// fainter where the mesh gets finer than the screen can show.
static float view__wire(const view *v, const int *t, float px, float py) {
    double s[3][2], q;
    for (int i = 0; i < 3; i++) {
        const double *p = v->p + 3 * (size_t)t[i];
        if (v->camera.fov > 0 && p[2] <= v->near_z) return 0;
        view__project(v, p, &s[i][0], &s[i][1], &q);
    }
    double cover = 0, thin = DBL_MAX, half = 0.55 * v->height / 640;
    for (int i = 0; i < 3; i++) {
        const double *a = s[i], *b = s[(i + 1) % 3], *c = s[(i + 2) % 3];
        double ex = b[0] - a[0], ey = b[1] - a[1], l = sqrt(ex * ex + ey * ey);
        if (!(l > 1e-9)) return 0;
        double d = fabs(ex * ((double)py - a[1]) - ey * ((double)px - a[0])) / l;
        thin = fmin(thin, fabs(ex * (c[1] - a[1]) - ey * (c[0] - a[0])) / l);
        cover = fmax(cover, half + 0.5 - d);
    }
    return view__clamp((float)cover, 0, 1) *
           view__smooth(1.5f, 9, (float)thin * 640 / (float)v->height);
}

static float view__shoulder(float x) {
    return x <= 0.75f ? x : 0.75f + 0.25f * (1 - expf(-(x - 0.75f) / 0.25f));
}

static void view__light(const view *v, const float p[3], const float n[3], float lit, float open,
                        int gloss, float c[3]) {
    static const float key_c[3] = {1.02f, 0.97f, 0.89f}, fill_c[3] = {0.16f, 0.19f, 0.24f};
    static const float sky_c[3] = {0.40f, 0.44f, 0.50f}, low_c[3] = {0.25f, 0.235f, 0.215f};
    float eye[3] = {-p[0], -p[1], -p[2]}, half[3];
    if (!(v->camera.fov > 0)) eye[0] = eye[1] = 0, eye[2] = -1;
    view__unitf(eye);
    for (int i = 0; i < 3; i++) half[i] = eye[i] + v->light[i];
    view__unitf(half);
    float nl = fmaxf(0, view__dotf(n, v->light)), nf = fmaxf(0, view__dotf(n, v->fill));
    float up = 0.5f + 0.5f * view__dotf(n, v->above), nh = fmaxf(0, view__dotf(n, half));
    float edge = 1 - fmaxf(0, view__dotf(n, eye)), dim = open * (0.6f + 0.4f * open);
    edge *= edge, edge *= edge;
    float n4 = nh * nh * nh * nh, n16 = n4 * n4 * n4 * n4, shine = n16 * n16 * n4 * nl * lit;
    for (int i = 0; i < 3; i++) {
        float sky = low_c[i] + up * (sky_c[i] - low_c[i]);
        float light = key_c[i] * nl * lit + fill_c[i] * nf * (0.4f + 0.6f * open) + sky * dim;
        c[i] = c[i] * light;
        if (gloss) c[i] += 0.16f * shine + 0.07f * edge * dim * (0.3f + up);
    }
}

static void view__shade_triangle(const view *v, int x, int y, int id, float px, float py,
                                 float c[3]) {
    float p[3], facet[3], bary[3], n[3] = {0, 0, 0}, lit = 1, open = 1;
    const int *t = v->triangle + 3 * (size_t)id;
    const view__object *o = &v->object[v->owner[id]];
    view__hit(v, id, px, py, p, facet, bary);
    view__albedo(v, o, t, bary, c);
    if (!v->look.flat) {
        double w[3] = {0, 0, 0};
        for (size_t k = 0; k < 3; k++)
            for (size_t i = 0; i < 3; i++)
                w[i] += (double)(bary[k] * v->normal[9 * (size_t)id + 3 * k + i]);
        view__turn(v, w, n);
        view__unitf(n);
        // Both sides are seen: the normal turns with the facet.
        if (view__dotf(n, facet) < 0)
            for (int i = 0; i < 3; i++) n[i] = -n[i];
        view__gather(v, x, y, p, facet, &lit, &open);
        lit = 1 - (float)v->look.shadow * (1 - lit),
        open = 1 - (float)v->look.occlusion * (1 - open);
        view__light(v, p, n, lit, open, o->gloss, c);
    }
    if (o->wire > 0) {
        float w = o->wire * view__wire(v, t, px, py);
        for (int i = 0; i < 3; i++)
            c[i] += w * ((v->look.flat ? 1.0f : 0.7f) * o->wire_colour[i] - c[i]);
    }
}

// Each surface seen in the pixel is shaded once, at the middle of its samples, and weighs as many
// samples as it has.
static void view__shade_pixel(view *v, int x, int y) {
    size_t at = (size_t)y * (size_t)v->width + (size_t)x;
    const int *id = v->id + at * VIEW__SAMPLES;
    float sum[3] = {0, 0, 0};
    unsigned done = 0;
    for (int k = 0; k < VIEW__SAMPLES; k++) {
        if (done >> k & 1) continue;
        float sx = 0, sy = 0, count = 0, c[3];
        for (int j = k; j < VIEW__SAMPLES; j++)
            if (id[j] == id[k])
                done |= 1u << j, sx += view__sample[j][0], sy += view__sample[j][1], count++;
        float px = (float)x + 0.5f + sx / count, py = (float)y + 0.5f + sy / count;
        if (id[k] == VIEW__NONE)
            view__background(v, py, c);
        else if (id[k] == VIEW__GROUND)
            view__shade_ground(v, x, y, px, py, c);
        else
            view__shade_triangle(v, x, y, id[k], px, py, c);
        for (int i = 0; i < 3; i++)
            sum[i] += count * (v->look.flat || id[k] < 0 ? c[i] : view__shoulder(c[i]));
    }
    for (int i = 0; i < 3; i++) {
        float c = view__clamp(sum[i] / VIEW__SAMPLES, 0, 1);
        v->rgb[3 * at + (size_t)i] = v->encode[(int)(4096 * c + 0.5f)];
    }
}

static void view__shade_band(view *v, int band) {
    int y0 = band * VIEW__BAND, y1 = y0 + VIEW__BAND < v->height ? y0 + VIEW__BAND : v->height;
    for (int y = y0; y < y1; y++)
        for (int x = 0; x < v->width; x++) view__shade_pixel(v, x, y);
}

// ---------------------------------------------------------------------------------------------
// >>render (private)
// ---------------------------------------------------------------------------------------------

view_image view_render(view *v) {
    view_image im = {v->width, v->height, NULL};
    int bands = (v->height + VIEW__BAND - 1) / VIEW__BAND;
    if (v->failed || !view__transform(v)) return im;
    view__ground_setup(v);
    view__bands(v, view__visible_band, bands);
    if (!v->look.flat) {
        if (!view__lights_on(v)) return im;
        memset(v->tile, 0, (size_t)v->tiles_x * (size_t)v->tiles_y);
        view__bands(v, view__surface_band, bands);
        view__tiles_near(v);
        view__bands(v, view__light_band, bands);
    }
    view__bands(v, view__shade_band, bands);
    im.rgb = v->rgb;
    return im;
}

// ---------------------------------------------------------------------------------------------
// >>font (private)
// Drawn for this program: strokes on a grid 9 high (baseline 2, small letters to 6, capitals to 8),
// points as digit pairs, strokes parted by spaces. "~" begins a curve: a quadratic B-spline that
// starts and ends in its end points. The first digit is the glyph's width.
// ---------------------------------------------------------------------------------------------

static const char *const view__glyphs[95] = {"2",
                                             "0 0804 0202",
                                             "2 0807 2827",
                                             "4 1218 3238 0444 0646",
                                             "4 ~473838181615353413 12",
                                             "4 0248 0718271607 2334433223",
                                             "4 42061718362602",
                                             "0 0807",
                                             "1 ~19070111",
                                             "1 ~09171101",
                                             "4 2327 0644 0446",
                                             "4 0545 2337",
                                             "0 ~020201",
                                             "2 0525",
                                             "0 0202",
                                             "3 0138",
                                             "3 ~05083832020505",
                                             "3 072822",
                                             "3 ~0708383502 0232",
                                             "3 ~0708383515 ~1535320203",
                                             "3 22280434",
                                             "3 380805 ~051535320203",
                                             "3 ~3738080232350504",
                                             "3 083812",
                                             "3 ~150508383515 ~150502323515",
                                             "3 ~0302323808053536",
                                             "0 0505 0202",
                                             "0 0505 0201",
                                             "3 370533",
                                             "3 0444 0646",
                                             "3 073503",
                                             "3 ~070838351514 1212",
                                             "4 ~34351514134344 48080242",
                                             "4 022842 1535",
                                             "4 0208 ~082848452505 ~052545422202",
                                             "4 ~474808024243",
                                             "4 0208 ~082848422202",
                                             "4 48080242 0535",
                                             "4 480802 0535",
                                             "4 ~474808024245 4525",
                                             "4 0208 4248 0545",
                                             "0 0208",
                                             "3 ~3834320203",
                                             "4 0208 4804 1542",
                                             "3 080232",
                                             "4 0208244842",
                                             "4 02084248",
                                             "4 ~280802424828",
                                             "4 0208 ~082848442404",
                                             "4 ~280802424828 2442",
                                             "4 0208 ~082848442404 2442",
                                             "4 ~4748080545420203",
                                             "4 0848 2228",
                                             "4 ~080402424448",
                                             "4 082248",
                                             "6 0812375268",
                                             "4 0248 0842",
                                             "4 082548 2522",
                                             "4 08480242",
                                             "1 19090111",
                                             "3 0831",
                                             "1 09191101",
                                             "2 061826",
                                             "3 0131",
                                             "1 0817",
                                             "3 3632 ~36060232",
                                             "3 0208 ~06363202",
                                             "3 ~353606023233",
                                             "3 3238 ~36060232",
                                             "3 0434 ~343606023233",
                                             "2 ~28181512 0626",
                                             "3 ~36060232 ~36323000",
                                             "3 0208 ~0406363432",
                                             "0 0206 0808",
                                             "1 ~16111000 1818",
                                             "3 0208 3603 1432",
                                             "0 0208",
                                             "4 0206 ~0406262422 ~2426464442",
                                             "3 0206 ~0406363432",
                                             "3 ~040636320204",
                                             "3 0006 ~06363202",
                                             "3 3036 ~36060232",
                                             "2 0206 ~040626",
                                             "3 ~3536060434320203",
                                             "2 ~18131222 0626",
                                             "3 3632 ~0604023234",
                                             "4 062246",
                                             "4 0612253246",
                                             "3 0236 0632",
                                             "4 0622 4610",
                                             "3 06360232",
                                             "1 ~19150501 ~05151111",
                                             "0 0109",
                                             "1 ~09051501",
                                             "3 ~04062436"};

// ---------------------------------------------------------------------------------------------
// >>pixels (private)
// ---------------------------------------------------------------------------------------------

view_image view_image_alloc(int width, int height) {
    view_image im = {0, 0, NULL};
    if (width <= 0 || height <= 0 || width > 65500 || height > 65500) return im;
    im.rgb = (unsigned char *)calloc((size_t)width * (size_t)height, 3);
    if (im.rgb) im.width = width, im.height = height;
    return im;
}

void view_image_free(view_image *image) {
    free(image->rgb);
    image->rgb = NULL, image->width = image->height = 0;
}

static void view__blend(view_image *im, int x, int y, const float rgb[3], float alpha) {
    if (x < 0 || y < 0 || x >= im->width || y >= im->height || !(alpha > 0)) return;
    unsigned char *p = im->rgb + 3 * ((size_t)y * (size_t)im->width + (size_t)x);
    for (int i = 0; i < 3; i++) {
        float c = (float)p[i] + alpha * (255 * rgb[i] - (float)p[i]);
        p[i] = (unsigned char)(view__clamp(c, 0, 255) + 0.5f);
    }
}

// Mean in linear light of the box [x0, x1) x [y0, y1) of the source's pixels, its ends in parts.
static void view__box(const view_image *im, const float *linear, double x0, double x1, double y0,
                      double y1, unsigned char *out) {
    double sum[3] = {0, 0, 0}, area = 0;
    for (int y = (int)y0; y < im->height && y < y1; y++)
        for (int x = (int)x0; x < im->width && x < x1; x++) {
            const unsigned char *p = im->rgb + 3 * ((size_t)y * (size_t)im->width + (size_t)x);
            double w = (fmin(x + 1, x1) - fmax(x, x0)) * (fmin(y + 1, y1) - fmax(y, y0));
            for (int i = 0; i < 3; i++) sum[i] += w * (double)linear[p[i]];
            area += w;
        }
    for (int i = 0; i < 3; i++)
        out[i] = (unsigned char)(255 * view__to_srgb((float)(area > 0 ? sum[i] / area : 0)) + 0.5f);
}

view_image view_image_shrink(const view_image *image, int width) {
    view_image out = {0, 0, NULL};
    float linear[256];
    if (!image->rgb || width <= 0) return out;
    if (width > image->width) width = image->width;
    double step = (double)image->width / width;
    int height = (int)(image->height / step + 0.5);
    out = view_image_alloc(width, height > 0 ? height : 1);
    for (int i = 0; i < 256; i++) linear[i] = view__to_linear((float)i / 255);
    for (int y = 0; y < out.height; y++)
        for (int x = 0; x < out.width; x++)
            view__box(image, linear, x * step, (x + 1) * step, y * step, (y + 1) * step,
                      out.rgb + 3 * ((size_t)y * (size_t)out.width + (size_t)x));
    return out;
}

view_image view_image_sheet(const view_image *images, int count, int columns, int gap,
                            const char *const *labels) {
    static const float ink[3] = {0.13f, 0.16f, 0.20f};
    view_image out = {0, 0, NULL};
    if (count <= 0 || columns <= 0 || gap < 0) return out;
    if (columns > count) columns = count;
    int w = images[0].width, h = images[0].height, rows = (count + columns - 1) / columns;
    for (int i = 0; i < count; i++)
        if (!images[i].rgb || images[i].width != w || images[i].height != h) return out;
    if (w > 65500 / columns - gap || h > 65500 / rows - gap) return out;
    out = view_image_alloc(columns * (w + gap) + gap, rows * (h + gap) + gap);
    if (!out.rgb) return out;
    memset(out.rgb, 255, 3 * (size_t)out.width * (size_t)out.height);
    for (int i = 0; i < count; i++) {
        int x0 = gap + i % columns * (w + gap), y0 = gap + i / columns * (h + gap);
        for (int y = 0; y < h; y++)
            memcpy(out.rgb + 3 * ((size_t)(y0 + y) * (size_t)out.width + (size_t)x0),
                   images[i].rgb + 3 * (size_t)y * (size_t)w, 3 * (size_t)w);
        double size = fmax(7, h / 30.0);
        if (labels && labels[i]) view_text(&out, x0 + size, y0 + h - size, size, ink, labels[i]);
    }
    return out;
}

// ---------------------------------------------------------------------------------------------
// >>text (private)
// Distance from each pixel to the nearest stroke; ink where it is less than half the pen, a light
// halo around, so that dark letters are read on dark things.
// ---------------------------------------------------------------------------------------------

typedef struct view__pen {
    float *far_out;  // pixels: distance to the nearest stroke
    int x0, y0, width, height;
    double x, y, unit, reach;
} view__pen;

static void view__stroke(view__pen *pen, const double a[2], const double b[2]) {
    double ax = pen->x + pen->unit * a[0], ay = pen->y - pen->unit * (a[1] - 2);
    double bx = pen->x + pen->unit * b[0], by = pen->y - pen->unit * (b[1] - 2);
    double dx = bx - ax, dy = by - ay, l = dx * dx + dy * dy;
    int x0 = (int)floor(fmin(ax, bx) - pen->reach) - pen->x0,
        x1 = (int)ceil(fmax(ax, bx) + pen->reach) - pen->x0;
    int y0 = (int)floor(fmin(ay, by) - pen->reach) - pen->y0,
        y1 = (int)ceil(fmax(ay, by) + pen->reach) - pen->y0;
    for (int y = y0 < 0 ? 0 : y0; y <= y1 && y < pen->height; y++)
        for (int x = x0 < 0 ? 0 : x0; x <= x1 && x < pen->width; x++) {
            double px = x + pen->x0 + 0.5 - ax, py = y + pen->y0 + 0.5 - ay;
            double t = l > 0 ? fmin(1, fmax(0, (px * dx + py * dy) / l)) : 0;
            double d = sqrt((px - t * dx) * (px - t * dx) + (py - t * dy) * (py - t * dy));
            float *to = &pen->far_out[(size_t)y * (size_t)pen->width + (size_t)x];
            if ((float)d < *to) *to = (float)d;
        }
}

// One stroke of n points: straight pieces, or the arcs of a quadratic B-spline in 6 chords each.
static void view__strokes(view__pen *pen, double (*p)[2], int n, int curve) {
    if (!curve || n < 3) {
        for (int i = 0; i + 1 < n; i++) view__stroke(pen, p[i], p[i + 1]);
        return;
    }
    for (int i = 1; i + 1 < n; i++) {
        double a[2], b[2], last[2], at[2];
        for (int k = 0; k < 2; k++) {
            a[k] = i == 1 ? p[0][k] : 0.5 * (p[i - 1][k] + p[i][k]);
            b[k] = i + 2 == n ? p[n - 1][k] : 0.5 * (p[i][k] + p[i + 1][k]);
            last[k] = a[k];
        }
        for (int j = 1; j <= 6; j++) {
            double t = j / 6.0;
            for (int k = 0; k < 2; k++)
                at[k] = (1 - t) * (1 - t) * a[k] + 2 * t * (1 - t) * p[i][k] + t * t * b[k];
            view__stroke(pen, last, at);
            memcpy(last, at, sizeof last);
        }
    }
}

// The next letter's glyph; UTF-8's continuation bytes are passed over.
static const char *view__glyph(const char **text) {
    unsigned char c = (unsigned char)*(*text)++;
    while (((unsigned char)**text & 0xC0) == 0x80) (*text)++;
    return c >= 32 && c < 127 ? view__glyphs[c - 32] : "3 0232380802";
}

static void view__letter(view__pen *pen, const char *g) {
    double p[24][2];
    for (g++; *g;) {
        int n = 0, curve = 0;
        while (*g == ' ') g++;
        if (*g == '~') curve = 1, g++;
        for (; g[0] >= '0' && g[0] <= '9' && g[1] && n < 24; g += 2, n++)
            p[n][0] = g[0] - '0', p[n][1] = g[1] - '0';
        if (n > 0)
            view__strokes(pen, p, n, curve);
        else if (*g)
            break;
    }
}

double view_text_width(double size, const char *text) {
    double w = 0;
    while (*text) w += view__glyph(&text)[0] - '0' + 1.9;
    return w > 0 ? (w - 1.9) * size / 6 : 0;
}

void view_text(view_image *image, double x, double y, double size, const float rgb[3],
               const char *text) {
    view__pen pen;
    double half = fmax(0.62, 0.066 * size), halo = fmax(1.5, 0.28 * size);
    if (!image->rgb || !(size > 0) || !(size < 1000) || !(fabs(x) < 1e5) || !(fabs(y) < 1e5))
        return;
    pen.x = x, pen.y = y, pen.unit = size / 6, pen.reach = half + halo + 1;
    pen.x0 = (int)floor(x - pen.reach), pen.y0 = (int)floor(y - 1.2 * size - pen.reach);
    pen.width = (int)(fmin(view_text_width(size, text), image->width - pen.x0) + 2 * pen.reach) + 2;
    pen.height = (int)(1.6 * size + 2 * pen.reach) + 2;
    if (pen.width <= 0) return;
    size_t n = (size_t)pen.width * (size_t)pen.height;
    pen.far_out = (float *)malloc(n * sizeof(float));
    if (!pen.far_out) return;
    for (size_t i = 0; i < n; i++) pen.far_out[i] = 1e9f;
    while (*text) {
        const char *g = view__glyph(&text);
        view__letter(&pen, g);
        pen.x += (g[0] - '0' + 1.9) * pen.unit;
    }
    float dark = rgb[0] + rgb[1] + rgb[2] < 1.5f ? 1.0f : 0.0f, other[3] = {dark, dark, dark};
    for (size_t i = 0; i < n; i++) {
        int px = pen.x0 + (int)(i % (size_t)pen.width), py = pen.y0 + (int)(i / (size_t)pen.width);
        float d = pen.far_out[i] - (float)half, fade = view__clamp(1 - d / (float)halo, 0, 1);
        view__blend(image, px, py, other, 0.5f * fade * fade);
        view__blend(image, px, py, rgb, view__clamp(0.5f - d, 0, 1));
    }
    free(pen.far_out);
}

// ---------------------------------------------------------------------------------------------
// >>overlay (private)
// ---------------------------------------------------------------------------------------------

static const float view__ink[3] = {0.12f, 0.15f, 0.19f}, view__grey[3] = {0.30f, 0.34f, 0.40f};

void view_label(view_image *image, const char *title, const char *line) {
    double s = image->height / 640.0, y = 36 * s;
    if (title) view_text(image, 24 * s, y, 13.5 * s, view__ink, title);
    if (title) y += 22 * s;
    if (line) view_text(image, 24 * s, y, 9.5 * s, view__grey, line);
}

// Three digits; C's own numbers have a comma in some locales.
static void view__number(double x, char text[32]) {
    snprintf(text, 32, "%.3g", fabs(x) < 1e-300 ? 0.0 : x);
    for (char *c = text; *c; c++)
        if (*c == ',') *c = '.';
}

static void view__tick(view_image *im, double x, double y, double s, double value) {
    char text[32];
    view__number(value, text);
    for (int i = 0; i < (int)(5 * s); i++) view__blend(im, (int)x + i, (int)y, view__ink, 0.8f);
    view_text(im, x + 9 * s, y + 4.25 * s, 8.5 * s, view__grey, text);
}

void view_colour_bar(view_image *image, view_map map, double lo, double hi, const char *label) {
    double s = image->height / 640.0, x0 = image->width - 84 * s, h = 230 * s;
    double y0 = 0.5 * (image->height - h), w = 13 * s;
    if (!image->rgb || !(h > 4)) return;
    for (int y = (int)y0; y < (int)(y0 + h); y++)
        for (int x = (int)x0 - 1; x <= (int)(x0 + w); x++) {
            float c[3];
            view_map_colour(map, 1 - (y + 0.5 - floor(y0)) / h, c);
            int edge =
                x == (int)x0 - 1 || x == (int)(x0 + w) || y == (int)y0 || y == (int)(y0 + h) - 1;
            view__blend(image, x, y, edge ? view__ink : c, edge ? 0.55f : 1);
        }
    view__tick(image, x0 + w + 1, y0, s, hi);
    view__tick(image, x0 + w + 1, y0 + h - 1, s, lo);
    // Round numbers in between, a line of text away from the ends.
    double step = view__nice(fabs(hi - lo) / 4), low = fmin(lo, hi), high = fmax(lo, hi);
    for (int i = 0; i < 8 && high - low > 1e-12 * fabs(high); i++) {
        double value = (ceil(low / step) + i) * step, y = y0 + h * (hi - value) / (hi - lo);
        if (value < high && y > y0 + 22 * s && y < y0 + h - 22 * s)
            view__tick(image, x0 + w + 1, y, s, value);
    }
    // The label ends at the right margin when it is wider than the bar's place.
    if (!label) return;
    double lw = view_text_width(9.5 * s, label), lx = fmin(x0, image->width - 20 * s - lw);
    view_text(image, lx, y0 - 14 * s, 9.5 * s, view__ink, label);
}

// ---------------------------------------------------------------------------------------------
// >>files (private)
// ---------------------------------------------------------------------------------------------

static int view__fail(view_error *error, const char *path, const char *doing, const char *why) {
    if (error)
        snprintf(error->message, sizeof error->message, "%.300s: %s: %.150s", path, doing, why);
    return 0;
}

static FILE *view__open(const char *path, const view_image *im, view_error *error) {
    if (error) error->message[0] = 0;
    if (!im->rgb || im->width <= 0 || im->height <= 0) {
        view__fail(error, path, "cannot write", "the picture is empty (no memory to draw it?)");
        return NULL;
    }
    FILE *f = fopen(path, "wb");
    if (!f) view__fail(error, path, "cannot write", strerror(errno));
    return f;
}

// An incomplete file is left where it is: the path may name a device, which must not be removed.
static int view__close(FILE *f, int ok, const char *path, view_error *error) {
    int bad = ferror(f), shut = fclose(f);
    if (ok && (bad || shut))
        return view__fail(error, path, "cannot write", "the disk is full or broken");
    return ok;
}

int view_write_ppm(const char *path, const view_image *image, view_error *error) {
    FILE *f = view__open(path, image, error);
    if (!f) return 0;
    size_t n = 3 * (size_t)image->width * (size_t)image->height;
    fprintf(f, "P6\n%d %d\n255\n", image->width, image->height);
    int ok = fwrite(image->rgb, 1, n, f) == n;
    if (!ok) view__fail(error, path, "cannot write", strerror(errno));
    return view__close(f, ok, path, error);
}

#ifdef VIEW_NO_PNG

int view_write_png(const char *path, const view_image *image, view_error *error) {
    char other[1024];
    size_t n = strlen(path);
    if (n > 4 && strcmp(path + n - 4, ".png") == 0) n -= 4;
    if (n + 5 > sizeof other)
        return view__fail(error, path, "cannot write", "the name is too long");
    memcpy(other, path, n);
    memcpy(other + n, ".ppm", 5);
    return view_write_ppm(other, image, error);
}

#else

typedef struct view__png {
    const char *path;
    view_error *error;
} view__png;

static void view__png_error(png_structp png, png_const_charp message) {
    view__png *p = (view__png *)png_get_error_ptr(png);
    view__fail(p->error, p->path, "cannot write", message);
    longjmp(png_jmpbuf(png), 1);
}

static void view__png_warning(png_structp png, png_const_charp message) {
    (void)png, (void)message;
}

static int view__png_write(png_structp png, png_infop info, FILE *f, const view_image *im) {
    if (setjmp(png_jmpbuf(png))) return 0;
    png_init_io(png, f);
    png_set_IHDR(png, info, (png_uint_32)im->width, (png_uint_32)im->height, 8, PNG_COLOR_TYPE_RGB,
                 PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
    png_set_sRGB(png, info, PNG_sRGB_INTENT_PERCEPTUAL);
    // Paeth and level 5: within a few per cent of the smallest file in a third of the time.
    png_set_filter(png, 0, PNG_FILTER_PAETH);
    png_set_compression_level(png, 5);
    png_write_info(png, info);
    for (int y = 0; y < im->height; y++)
        png_write_row(png, im->rgb + 3 * (size_t)y * (size_t)im->width);
    png_write_end(png, info);
    return 1;
}

int view_write_png(const char *path, const view_image *image, view_error *error) {
    view__png p = {path, error};
    FILE *f = view__open(path, image, error);
    if (!f) return 0;
    png_structp png =
        png_create_write_struct(PNG_LIBPNG_VER_STRING, &p, view__png_error, view__png_warning);
    png_infop info = png ? png_create_info_struct(png) : NULL;
    int ok = info ? view__png_write(png, info, f, image) : 0;
    if (!info) view__fail(error, path, "cannot write", "no memory for the PNG writer");
    if (png) png_destroy_write_struct(&png, info ? &info : NULL);
    return view__close(f, ok, path, error);
}

#endif  // VIEW_NO_PNG

#ifdef __cplusplus
}
#endif
#endif  // VIEW_IMPLEMENTATION
