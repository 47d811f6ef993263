// Every header in one translation unit, as the unit that carries the implementation.
#define TSS_IMPLEMENTATION
#include "tss.h"
#include "tss_ipc.h"
#include "tss_subspace.h"
#include "tss_neural.h"
#include "tss_io.h"
#include "tss_shapes.h"
