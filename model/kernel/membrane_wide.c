/* membrane.c once more, as several_wide.c is several.c, with the same digits: its loops take four points at once. */
#define SOLVE solve_wide
#define SOURCE "membrane.c"
#include "wide.h"

#ifndef WIDE
#include "membrane.c"
#endif
