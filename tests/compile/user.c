// The other translation unit: declarations only.
#include "tss.h"
#include "tss_ipc.h"
#include "tss_io.h"
#include "tss_shapes.h"

int main(void) {
    tss_world_def def = tss_world_def_default();
    tss_world *w = NULL;
    tss_ipc_def contact = tss_ipc_def_default();
    if (tss_world_create(&def, &w) != TSS_OK || tss_ipc_add(w, &contact, NULL) != TSS_OK) return 1;
    tss_world_destroy(w);
    return 0;
}
