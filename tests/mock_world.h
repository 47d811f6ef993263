// tss.h with a world that a test makes up: bodies of triangles (3D) or segments (2D) and the
// callbacks of its energies, without a solver. The real world's functions get other names.
#define tss_world real_world
#define tss_world_fail real_world_fail
#define tss_world_surface real_world_surface
#define tss_energy_def_default real_energy_def_default
#define tss_energy_add real_energy_add
#define tss_energy_remove real_energy_remove
#define tss_world_host real_world_host
#define tss_world_dim real_world_dim
#define tss_world_nodes real_world_nodes
#define tss_world_positions real_world_positions
#define tss_world_rest real_world_rest
#define tss_world_kinds real_world_kinds
#include "tss.h"
#undef tss_world
#undef tss_world_fail
#undef tss_world_surface
#undef tss_energy_def_default
#undef tss_energy_add
#undef tss_energy_remove
#undef tss_world_host
#undef tss_world_dim
#undef tss_world_nodes
#undef tss_world_positions
#undef tss_world_rest
#undef tss_world_kinds

typedef struct tss_world tss_world;
tss_result tss_world_surface(const tss_world *w, tss_surface *out);
tss_energy_def tss_energy_def_default(void);
tss_result tss_energy_add(tss_world *w, const tss_energy_def *def, tss_energy *out);
tss_result tss_energy_remove(tss_world *w, tss_energy e);
const tss_host *tss_world_host(const tss_world *w);
int tss_world_dim(const tss_world *w);
int tss_world_nodes(const tss_world *w);
const double *tss_world_positions(const tss_world *w);
const double *tss_world_rest(const tss_world *w);
const uint8_t *tss_world_kinds(const tss_world *w);

tss_result tss_world_fail(tss_world *w, tss_result r, const char *format, ...);
tss_result tss_world_fail(tss_world *w, tss_result r, const char *format, ...) {
    (void)w, (void)format;
    return r;
}
