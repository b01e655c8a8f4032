/* Which kernel this is: library.py asks before it uses anything else of it. */
#include "version.h"

#define TEXT_OF(token) #token
#define TEXT(macro) TEXT_OF(macro)

int64_t dea_kernel_version(void) { return DEA_KERNEL_VERSION; }

/* What it was compiled from: first digits of the sources' SHA-256 (library.py, sources_digest). */
const char *dea_kernel_sources(void) { return TEXT(DEA_KERNEL_SOURCES); }

/* What compiled it: cc, or ziglang. */
const char *dea_kernel_compiler(void) { return TEXT(DEA_KERNEL_COMPILER); }
