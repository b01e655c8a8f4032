/* several.c once more, for processors of four numbers at once. The digits are the same: lanes never meet, and no
   operation is contracted. Not with gcc on Windows, which does not align so wide numbers on the stack there. */
#define LANES 4
#define SOLVE_SEVERAL solve_several_wide
#define SOURCE "several.c"
#include "wide.h"

#ifdef WIDE
#include <cpuid.h>

int four_at_once = 0;

/* The compilers' own __builtin_cpu_supports is not there, or always says no, in some of them. */
__attribute__((constructor)) static void look(void) {
    unsigned a, b, c, d, low, high;
    if (!__get_cpuid(1, &a, &b, &c, &d) || !(c & bit_OSXSAVE) || !(c & bit_AVX)) return;
    __asm__("xgetbv" : "=a"(low), "=d"(high) : "c"(0));
    if ((low & 6) != 6 || !__get_cpuid_count(7, 0, &a, &b, &c, &d)) return; /* 6: the system keeps wide registers */
    four_at_once = (b & bit_AVX2) != 0;
}
#else
#include "several.h"

int four_at_once = 0;

void solve_several_wide(const Task *task, One *states, int64_t count) { solve_several_narrow(task, states, count); }
#endif
